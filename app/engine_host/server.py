"""The host's process: one request after the other, and the latch that a trip leaves behind."""

import os
import signal
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

from dragrig import campaigns
from dragrig.campaigns import Made
from dragrig.config.errors import DragrigError, TrippedError
from dragrig.engine_host.listening import Ear, Mouth
from dragrig.engine_host.live import LiveWriter, Memory
from dragrig.engine_host.messages import (
    SILENCE_S,
    Device,
    Ended,
    Event,
    Examine,
    Examined,
    InMirror,
    Job,
    Latched,
    Ready,
    Refused,
    Request,
    Reset,
    RigTerms,
    Start,
    Status,
    Warned,
)
from dragrig.engine_host.person import RemotePerson
from dragrig.examining import examine
from dragrig.handling import at_the_bench
from dragrig.rigs import resolve_rig
from dragrig.sessions import Terms
from dragrig.setup import resolve

START_UP = "nobody has looked at the rig yet: its way free, hands out, the e-stop in reach"


def serve(
    connection: "Connection[Event, Request]", memory: Memory, rig: RigTerms, silence_s: float = SILENCE_S
) -> None:
    """Host an engine until the client leaves or dies; what a process of its own runs."""
    # Ctrl-C in the terminal is the client's to hear; a session under way hears it by itself.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    mouth, ear = Mouth(connection), Ear(connection, silence_s)
    Host(mouth, ear, LiveWriter(memory), rig).run()
    mouth.close()


class Host:
    """Answers requests on the process's main thread, where a session hears signals."""

    def __init__(self, mouth: Mouth, ear: Ear, live: LiveWriter, rig: RigTerms) -> None:
        self._mouth, self._ear, self._rig = mouth, ear, rig
        self._person = RemotePerson(mouth, ear, live)
        self._latched_on = START_UP

    def run(self) -> None:
        """Answer until the client is gone."""
        self._mouth.say(Ready(os.getpid()))
        self._mouth.say(Latched(self._latched_on))
        while (request := self._ear.next()) is not None:
            try:
                self._answer(request)
            except Exception as error:  # noqa: BLE001  # the client must hear of it, and the host must go on
                self._mouth.say(Refused(f"a bug ({type(error).__name__}: {error}); please report it."))

    def _answer(self, request: Request) -> None:
        match request:
            case Start(job):
                self._start(job)
            case Examine():
                self._mouth.say(self._examined())
            case Reset():
                self._reset()
            case _:
                pass

    def _start(self, job: Job) -> None:
        if self._latched_on:
            sentence = f"the guard is tripped: {self._latched_on}; see to it, then reset the guard"
            self._mouth.say(Ended(job.number, None, sentence))
            return
        self._person.takes(job.number)
        ended = Ended(job.number, Status.FAILED, "the engine met a bug")
        try:
            made = self._carry_out(job)
            ended = Ended(job.number, made.session.status, made.session.reason, made.folder, _in_mirror(made))
        except DragrigError as error:
            ended = Ended(job.number, None, str(error))
        finally:
            self._ear.stops(None)
            self._mouth.say(ended)
        if ended.status is Status.TRIPPED:
            self._latch(ended.reason)

    def _carry_out(self, job: Job) -> Made:
        terms = Terms(
            Path(),
            operator=job.operator,
            note=job.note,
            pace=job.pace,
            begun=self._ear.stops,
            mirror=job.mirror,
            tell=lambda sentence: self._mouth.say(Warned(sentence)),
        )
        if job.resume is not None:
            return campaigns.go_on(job.resume, terms, self._person)
        return campaigns.begin(resolve(job.plan, **self._rig.choices()), job.out, terms, self._person)

    def _reset(self) -> None:
        try:
            setup = resolve_rig(**self._rig.choices())
            pace = self._rig.pace if setup.double else None
            at_the_bench(lambda bench: bench.manual.reset(), setup, pace, self._person)
        except TrippedError as error:
            self._latch(str(error))
        except DragrigError as error:
            self._mouth.say(Refused(str(error)))
        else:
            self._latch("")

    def _latch(self, reason: str) -> None:
        self._latched_on = reason
        self._mouth.say(Latched(reason))

    def _examined(self) -> Examined:
        found = Examined(())
        try:
            for one in examine(**self._rig.choices()):
                found = replace(found, devices=(*found.devices, Device(one.what, one.fine, one.detail)))
        except DragrigError as error:
            return replace(found, error=str(error))
        return found


def _in_mirror(made: Made) -> InMirror | None:
    found = made.mirrored
    return None if found is None else InMirror(found.folder, len(found.copied), tuple(found.missing.items()))
