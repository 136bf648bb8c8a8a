"""The client as a session's operator and watcher."""

from collections.abc import Sequence
from itertools import count

from dragrig.engine_host.listening import Ear, Mouth
from dragrig.engine_host.live import LiveWriter
from dragrig.engine_host.messages import Answer, Asked, Began, RunBegan, RunEnded, RunLine, Waiting
from dragrig.rig.acquiring import Outcome
from dragrig.rig.people import Prompt
from dragrig.rig.programme import PlannedRun, Programme
from dragrig.rig.reading import Reading


class RemotePerson:
    """Asks and tells somebody in another process; tells never wait, asks wait for the answer or the end."""

    def __init__(self, mouth: Mouth, ear: Ear, live: LiveWriter) -> None:
        self._mouth, self._ear, self._live = mouth, ear, live
        self._numbers = count(1)
        self._job = self._order = 0

    def takes(self, job: int) -> None:
        """Say which session is told of from here on."""
        self._job = job

    def ask(self, prompt: Prompt) -> Answer:
        """Put a prompt and wait for the answer; abort when the session is to end."""
        question = next(self._numbers)
        asked = Asked(question, prompt.text, prompt.can_redo, prompt.can_skip, prompt.hands)
        return self._ear.await_answer(question, lambda: self._mouth.say(asked))

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        """Tell which runs are still to be made."""
        del programme
        self._mouth.say(Began(self._job, tuple(map(_line, pending)), real_time))

    def waits(self, duration_s: float, why: str) -> None:
        """Tell that nothing moves for a while."""
        self._mouth.say(Waiting(duration_s, why))

    def run_begins(self, run: PlannedRun, order: int) -> None:
        """Tell that a run starts."""
        self._order = order
        self._live.begin()
        self._mouth.say(RunBegan(_line(run), order))

    def reads(self, reading: Reading) -> None:
        """Put a block where a screen may find it."""
        self._live.put(reading)

    def run_ends(self, run: PlannedRun, outcome: Outcome) -> None:
        """Tell how a run ended."""
        warnings = tuple(outcome.checks.warnings)
        self._mouth.say(RunEnded(_line(run), self._order, outcome.status, outcome.reason, outcome.samples, warnings))


def _line(run: PlannedRun) -> RunLine:
    return RunLine(run.index, run.protocol.summary(), run.wait_s, run.duration_s)
