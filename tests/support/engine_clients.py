"""Clients of an engine's host: they hear what it says, may be held, and may be processes that are killed."""

import ctypes
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path

from dragrig.config.plan import Plan
from dragrig.engine_host.client import EngineClient
from dragrig.engine_host.messages import (
    Event,
    GuardState,
    PromptReply,
    PromptShown,
    ResetGuard,
    RigSelection,
    SessionFinished,
    SessionJob,
    SilenceLimits,
)
from dragrig.rig.operator import Answer
from loaded_processes import loaded_processes

PATIENCE_S = 600.0
"""Machines that test are busy."""
PATIENT = SilenceLimits(PATIENCE_S, PATIENCE_S)


def plan(speed_mm_s: float = 20.0, travel_mm: float = 10.0, runs: int = 1, prompt: str = "", **keys: object) -> Plan:
    step = {
        "kind": "drag",
        "speed_mm_s": speed_mm_s,
        "travel_mm": travel_mm,
        "rest_s": 0.2,
        "hold_s": 0.2,
        "repeats": runs,
        "wait_s": 0.0,
        "prompt": prompt,
        "way_back": "stay",
    }
    return Plan.model_validate({"name": "short", "steps": [{**step, **keys}]})


class Listener:
    """A client that remembers all it was told and answers what it is asked, unless `answer` is none."""

    def __init__(self, client: EngineClient) -> None:
        self.client = client
        self.heard: list[Event] = []
        self.answer: Answer | None = Answer.DONE

    def armed(self) -> "Listener":
        """Forget what was heard and seen, and reset the guard."""
        self.client.ask(ResetGuard())
        self.until(GuardState, lambda event: event == GuardState(""))
        self.heard, self.answer = [], Answer.DONE
        self.client.live.read()
        return self

    def until(self, kind: type[Event], wanted: Callable[[Event], bool] = lambda _: True) -> Event:
        """Wait for an event of a kind that has not been waited for yet."""
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            self.client.beat()
            for event in self.client.events():
                self.heard.append(event)
                if isinstance(event, PromptShown) and self.answer is not None:
                    self.client.ask(PromptReply(event.question, self.answer))
                if isinstance(event, kind) and wanted(event):
                    return event
            time.sleep(0.005)
        raise AssertionError(f"no {kind.__name__} within {PATIENCE_S:g} s, but {self.heard}")

    def until_samples(self, count: int) -> int:
        """Wait until so many samples of a run have come to the screen; return how many have."""
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            self.client.beat()
            fresh = self.client.live.read()
            if fresh is not None and fresh.first_index + len(fresh.force) >= count:
                return fresh.first_index + len(fresh.force)
            time.sleep(0.005)
        raise AssertionError(f"no {count} samples within {PATIENCE_S:g} s")


@contextmanager
def listening(rig: RigSelection | None = None, silence: SilenceLimits = PATIENT) -> Iterator[Listener]:
    """A host, and a client that hears it; the guard is reset."""
    client = EngineClient(rig or RigSelection(backend="simulated"), silence)
    try:
        listener = Listener(client)
        listener.until(GuardState)
        yield listener.armed()
    finally:
        client.close()


def hold_the_interpreter(duration_s: float) -> None:
    """Sleep with the interpreter's lock taken: no other thread of this process runs meanwhile."""
    if sys.platform == "win32":
        ctypes.PyDLL("kernel32").Sleep(round(1000 * duration_s))
    else:
        ctypes.PyDLL(None).usleep(round(1e6 * duration_s))


def killed_client(folder: Path, connection: "Connection[int, int]") -> None:
    """Be the client that is killed: say the host's process once its run of a minute moves, and wait."""
    with loaded_processes(), listening() as listener:
        listener.client.ask(SessionJob(1, plan(10.0 / 60.0, 10.0), pace="real", out=folder))
        listener.until_samples(400)
        connection.send(listener.client.pid)
        listener.until(SessionFinished)
