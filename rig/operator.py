"""The person at the rig: prompts and answers, and confirmations before and after motion.

Before motion: the guard's reset and homing. After it: stop, standstill, drive off.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from threading import Event as Signal
from typing import Protocol

from dragrig.config import AbortedError, TrippedError
from dragrig.rig.devices import Backend, Stage, StageLimits, SupportsMotionTrial, TravelEnd
from dragrig.rig.engine import AcquisitionOutcome, attempt
from dragrig.rig.guard import LIMIT_SWITCH_CAUSES, Guard
from dragrig.rig.profile import MotionProfile, trapezoid
from dragrig.rig.programme import PlannedRun, Programme
from dragrig.rig.reading import Reading
from dragrig.rig.sentinel import Drift

START_TOLERANCE_MM = 0.005
HOMING = "HOMING: the stage moves to the end of its travel to find its origin"
HOMING_PROMPT = "The stage moves to the end of its travel to find its origin: take the capsule out of its path"
_MAX_STANDSTILL_WAIT_S = 10.0
_DRIVE_MAY_BE_ON = "and the drive may still be on: check that it is switched off"
_POSITIONING_SPEED_MM_S = 20.0
_POSITIONING_ACCEL_MM_S2 = 200.0


class Answer(StrEnum):
    """A person's answer to a prompt."""

    DONE = "done"
    REDO = "redo"
    """Repeat the run before; its file is marked bad."""
    SKIP = "skip"
    """Skip what this prompt prepares: the runs up to the next prompt of the plan."""
    MEASURE = "measure"
    """Make the sentinel once more; its earlier file stays as it is."""
    ABORT = "abort"


class LiveReading(Protocol):
    """The readings of a rig at a moment."""

    @property
    def text(self) -> str:
        """A line for a person."""


@dataclass(frozen=True, slots=True)
class Prompt:
    """A request to a person."""

    text: str
    run: PlannedRun | None = None
    """The run that it is about, if any."""
    can_redo: bool = False
    can_skip: bool = False
    can_measure: bool = False
    hands: bool = True
    """Whether a person must do or check something at the rig: no program may answer then."""
    look: Callable[[], LiveReading] | None = field(default=None, compare=False)
    """Reads the rig while the prompt is open, force and position by default; only one thread at a time may call it."""

    @property
    def choices(self) -> tuple[Answer, ...]:
        """The answers that it takes."""
        allowed = {Answer.REDO: self.can_redo, Answer.SKIP: self.can_skip, Answer.MEASURE: self.can_measure}
        return tuple(answer for answer in Answer if allowed.get(answer, True))


@dataclass(frozen=True, slots=True)
class RunResult:
    """One run of a session: its run file, and how it ended."""

    run: PlannedRun
    order: int
    outcome: AcquisitionOutcome
    path: Path | None


class Operator(Protocol):
    """The person at the rig."""

    @property
    def attended(self) -> bool:
        """Whether a person answers prompts that need no hands; records say so where nobody does."""

    def ask(self, prompt: Prompt) -> Answer:
        """Show a prompt and wait for the answer."""

    def homes(self, *, over: bool) -> None:
        """Take that the stage moves to its origin from now on, or no longer."""


class SessionObserver(Protocol):
    """Follows a session; called on the session's thread, so it must be quick."""

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        """Take the start of a session: the runs to make, and whether it waits in real time."""

    def waits(self, run: PlannedRun, duration_s: float) -> None:
        """Take the start of a rest before a run; readings follow it where time is real."""

    def run_begins(self, run: PlannedRun, order: int) -> None:
        """Take the start of a run."""

    def reads(self, reading: Reading) -> None:
        """Take a block of a run that was just recorded, or of the rest before it, counted from its own start."""

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        """Take the end of a run, with its checks."""

    def sentinel_compared(self, drift: Drift) -> None:
        """Take a sentinel's drift, before anybody is asked about it."""


class NullOperator:
    """An operator for programs, without hands, and an observer that does nothing."""

    attended = False

    def ask(self, prompt: Prompt) -> Answer:
        """Answer done, or abort where hands are needed."""
        return Answer.ABORT if prompt.hands else Answer.DONE

    def homes(self, *, over: bool) -> None:
        """Do nothing."""

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        """Do nothing."""

    def waits(self, run: PlannedRun, duration_s: float) -> None:
        """Do nothing."""

    def run_begins(self, run: PlannedRun, order: int) -> None:
        """Do nothing."""

    def reads(self, reading: Reading) -> None:
        """Do nothing."""

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        """Do nothing."""

    def sentinel_compared(self, drift: Drift) -> None:
        """Do nothing."""


def ignore(*_: object) -> None:
    """Do nothing with a message."""


def confirm(operator: Operator, prompt: Prompt) -> None:
    """Show a prompt; any answer but done raises `AbortedError`."""
    if operator.ask(prompt) is not Answer.DONE:
        raise AbortedError("ended at a prompt.")


def reset_guard(backend: Backend, guard: Guard, operator: Operator) -> None:
    """Reset the guard; where hands are needed, once a person has checked the rig.

    Raises
    ------
    AbortedError
        When the person aborts.
    TrippedError
        When the cause of a trip is still there.
    """
    if backend.needs_hands:
        text = "Check the rig: path clear, hands out, e-stop in reach. The guard is then reset"
        if isinstance(stage := backend.stage, SupportsMotionTrial) and stage.trial_due:
            text += ", and before anything else the stage moves by 1 mm, to show that drive and encoder agree"
        confirm(operator, Prompt(text))
    if backend.stage.state().fault is not None:
        # Switched off, a drive forgets an alarm whose cause was removed meanwhile; any other comes back.
        backend.stage.disable()
    still_tripped = guard.reset(backend.stage.state())
    if still_tripped is not None:
        side = next((side for side, cause in LIMIT_SWITCH_CAUSES.items() if cause is still_tripped.cause), None)
        if side is None:
            raise TrippedError(f"{still_tripped.message}; the guard stays tripped until the cause is removed.")
        distance_mm = 2 if side is TravelEnd.LOW else -2
        raise TrippedError(
            f"{still_tripped.message}; move it off with dragrig jog {distance_mm} --override-limit {side}, or, where "
            f"it is not homed, with dragrig home --override-limit {side}."
        )


def enable_and_home(backend: Backend, operator: Operator) -> None:
    """Switch the drive on, and find the origin unless it is known; where hands are needed, a person confirms first.

    Raises `AbortedError` when the person aborts, `DeviceError` when the drive refuses.
    """
    stage = backend.stage
    stage.enable()
    if stage.state().homed:
        # Now, before a capsule is put in, which a pulse would shear.
        if isinstance(stage, SupportsMotionTrial):
            stage.prove_motion()
    else:
        if backend.needs_hands:
            confirm(operator, Prompt(HOMING_PROMPT))
        find_origin(stage, operator)


def find_origin(stage: Stage, operator: Operator) -> None:
    """Home the stage, which the operator is told; raises `DeviceError` when the drive refuses."""
    operator.homes(over=False)
    stage.home()
    operator.homes(over=True)


def park(backend: Backend, ended_for: str = "") -> list[str]:
    """Stop everything and switch the drive off once the stage stands; return the errors.

    The cause of an early end, `ended_for`, mostly makes these steps fail too. Its own message is the one that helps,
    so after it these errors become the one request that needs a person: to check the drive.
    """
    # Switched off in motion, a stage coasts.
    steps = (backend.stage.stop, backend.sampler.stop, lambda: await_standstill(backend), backend.stage.disable)
    failures = [text for step in steps if (text := attempt(step))]
    return [_DRIVE_MAY_BE_ON] if failures and ended_for else failures


def await_standstill(backend: Backend) -> None:
    """Wait until the stage stands, which may be a moment after its last sample; for 10 s at most."""
    until_s = backend.clock.monotonic() + _MAX_STANDSTILL_WAIT_S
    while backend.stage.state().moving and backend.clock.monotonic() < until_s:
        backend.clock.sleep(0.01, Signal())


def positioning_profile(travel_mm: float, limits: StageLimits) -> MotionProfile:
    """Return a gentle motion over a signed travel."""
    speed = min(_POSITIONING_SPEED_MM_S, limits.speed_mm_s)
    accel = min(_POSITIONING_ACCEL_MM_S2, limits.acceleration_mm_s2)
    return MotionProfile.from_pieces(trapezoid(travel_mm, speed, accel))
