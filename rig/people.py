"""What a session needs of people: answers to prompts, and eyes."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Protocol

from dragrig.rig.acquiring import Outcome
from dragrig.rig.programme import PlannedRun, Programme
from dragrig.rig.reading import Reading


class Answer(StrEnum):
    """What a person can say to a prompt."""

    DONE = "done"
    REDO = "redo"
    """Make the run before once more; its file is marked bad."""
    SKIP = "skip"
    """Leave out what this prompt prepares: the runs up to the next prompt of the plan."""
    ABORT = "abort"


@dataclass(frozen=True, slots=True)
class Prompt:
    """A request to a person.

    Attributes
    ----------
    run
        The run that it is about, if it is about one.
    hands
        Whether somebody has to do something, or look, at the rig: nothing but a person may answer then.
    """

    text: str
    run: PlannedRun | None = None
    can_redo: bool = False
    can_skip: bool = False
    hands: bool = True


class Operator(Protocol):
    """The person at the rig."""

    def ask(self, prompt: Prompt) -> Answer:
        """Put a prompt and wait for the answer."""
        ...


class Watcher(Protocol):
    """Whoever follows a session; called on the session's thread, so it must be quick."""

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        """Tell that a session starts, which runs it has to make, and whether waits take their time."""
        ...

    def waits(self, duration_s: float, why: str) -> None:
        """Tell that nothing moves for a while."""
        ...

    def run_begins(self, run: PlannedRun, order: int) -> None:
        """Tell that a run starts."""
        ...

    def reads(self, reading: Reading) -> None:
        """Show a block that was just recorded."""
        ...

    def run_ends(self, run: PlannedRun, outcome: Outcome) -> None:
        """Tell how a run ended, with its checks."""
        ...


class Nobody:
    """An operator without hands, and a watcher who does not look: for dry runs in a program."""

    def ask(self, prompt: Prompt) -> Answer:
        """Say done where no hands are needed, and abort where they are."""
        return Answer.ABORT if prompt.hands else Answer.DONE

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        """Look away."""

    def waits(self, duration_s: float, why: str) -> None:
        """Look away."""

    def run_begins(self, run: PlannedRun, order: int) -> None:
        """Look away."""

    def reads(self, reading: Reading) -> None:
        """Look away."""

    def run_ends(self, run: PlannedRun, outcome: Outcome) -> None:
        """Look away."""


@dataclass(frozen=True, slots=True)
class RunResult:
    """One run of a session: where its file will be, and how it ended."""

    run: PlannedRun
    order: int
    outcome: Outcome
    path: Path | None
