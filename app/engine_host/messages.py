"""What a client and the host of an engine tell each other: small frozen values, sent as pickles between two of us."""

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from dragrig.config.plan import Plan
from dragrig.pacing import Pace
from dragrig.rig.people import Answer
from dragrig.rig.runfile.model import PHASE_NAMES, Status
from dragrig.rigs import RigChoices

__all__ = ["PHASE_NAMES", "Answer", "Pace", "Status"]  # what messages hold, for clients that know no rig

SILENCE_S = 20.0
"""A client that says nothing for so long is taken for dead; one whose interpreter is held for seconds is not."""
BEAT_S = 1.0
"""How often a client is to say that it lives."""


@dataclass(frozen=True, slots=True)
class RigTerms:
    """Which rig a host is for; none means the usual, as of `dragrig.examine`."""

    rig: Path | None = None
    model: str | Path | None = None
    backend: str | None = None
    double: bool = False
    assignments: tuple[str, ...] = ()
    pace: Pace | None = None

    def choices(self) -> RigChoices:
        """Return the terms as keyword arguments."""
        return {
            "rig": self.rig,
            "model": self.model,
            "backend": self.backend,
            "double": self.double,
            "assignments": self.assignments,
        }


@dataclass(frozen=True, slots=True)
class Job:
    """A session to carry out.

    Attributes
    ----------
    number
        What its client calls it.
    resume
        Folder of a campaign to go on with, in place of the plan.
    mirror
        Folder that is to hold a second copy of each finished file.
    """

    number: int
    plan: Plan | str
    operator: str = ""
    note: str = ""
    pace: Pace | None = None
    out: Path | None = None
    resume: Path | None = None
    mirror: Path | None = None


@dataclass(frozen=True, slots=True)
class Start:
    """Carry out a session."""

    job: Job


@dataclass(frozen=True, slots=True)
class Abort:
    """Stop the stage now, and end the session in good order."""

    reason: str


@dataclass(frozen=True, slots=True)
class Reply:
    """An answer to the question of this number."""

    question: int
    answer: Answer


@dataclass(frozen=True, slots=True)
class Examine:
    """Look at every device; nothing moves."""


@dataclass(frozen=True, slots=True)
class Reset:
    """Reset the guard's latch, if every condition is clear."""


@dataclass(frozen=True, slots=True)
class Beat:
    """The client lives."""


@dataclass(frozen=True, slots=True)
class Leave:
    """End the process, once the session under way has been ended."""


Request: TypeAlias = Start | Abort | Reply | Examine | Reset | Beat | Leave


@dataclass(frozen=True, slots=True)
class Ready:
    """The host is up."""

    pid: int


@dataclass(frozen=True, slots=True)
class Device:
    """What a look at one device found."""

    what: str
    fine: bool
    detail: str


@dataclass(frozen=True, slots=True)
class Examined:
    """What a look at the rig found; `error` where it could not be finished."""

    devices: tuple[Device, ...]
    error: str = ""


@dataclass(frozen=True, slots=True)
class Latched:
    """What the guard is latched on; empty when it is armed."""

    reason: str


@dataclass(frozen=True, slots=True)
class RunLine:
    """A run of a session as a list shows it."""

    index: int
    summary: str
    wait_s: float
    duration_s: float


@dataclass(frozen=True, slots=True)
class Began:
    """A session starts with these runs still to make."""

    job: int
    runs: tuple[RunLine, ...]
    real_time: bool


@dataclass(frozen=True, slots=True)
class Waiting:
    """Nothing moves for a while."""

    duration_s: float
    why: str


@dataclass(frozen=True, slots=True)
class RunBegan:
    """A run starts."""

    run: RunLine
    order: int


@dataclass(frozen=True, slots=True)
class RunEnded:
    """A run ended; `warnings` is what the checks right after it saw."""

    run: RunLine
    order: int
    status: Status
    reason: str
    samples: int
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Asked:
    """A question for the person at the rig; `hands` when something has to be done or looked at there."""

    question: int
    text: str
    can_redo: bool
    can_skip: bool
    hands: bool


@dataclass(frozen=True, slots=True)
class InMirror:
    """How many files have an equal in the mirror, and which have none, each with why."""

    folder: Path
    copied: int
    missing: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class Warned:
    """Something that a person has to know at once and that stops nothing."""

    sentence: str


@dataclass(frozen=True, slots=True)
class Ended:
    """A session is over; `status` is none where it never began, and `reason` says why."""

    job: int
    status: Status | None
    reason: str
    folder: Path | None = None
    mirror: InMirror | None = None


@dataclass(frozen=True, slots=True)
class Refused:
    """What was asked cannot be done, in a person's words."""

    sentence: str


@dataclass(frozen=True, slots=True)
class Lost:
    """The host's process is gone; the client's own word, no message of the host's."""

    exit_code: int | None


Event: TypeAlias = (
    Ready | Examined | Latched | Began | Waiting | RunBegan | RunEnded | Asked | Warned | Ended | Refused | Lost
)
