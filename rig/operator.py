"""The person at the rig: prompts and answers, and what is confirmed before and after motion.

Before motion: the guard's reset and homing. After it: stop, standstill, drive off.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from threading import Event as Signal
from typing import Protocol

from dragrig.config.errors import AbortedError, TrippedError
from dragrig.rig.devices import Backend, StageLimits
from dragrig.rig.engine import AcquisitionOutcome, attempt
from dragrig.rig.guard import Guard
from dragrig.rig.profile import MotionProfile, trapezoid
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


class SessionObserver(Protocol):
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

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        """Tell how a run ended, with its checks."""
        ...


class NullOperator:
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

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        """Look away."""


@dataclass(frozen=True, slots=True)
class RunResult:
    """One run of a session: where its file will be, and how it ended."""

    run: PlannedRun
    order: int
    outcome: AcquisitionOutcome
    path: Path | None


START_TOLERANCE_MM = 0.005
HOMING_PROMPT = "The stage goes to the end of its travel to find its origin: take the capsule out of its way"
_MAX_STANDSTILL_WAIT_S = 10.0
"""How long a stage is waited for to stand."""
_DRIVE_MAY_BE_ON = "and the rig could not be left as usual: see that its drive is switched off"
_POSITIONING_SPEED_MM_S = 20.0
_POSITIONING_ACCEL_MM_S2 = 200.0


def reset_guard(backend: Backend, guard: Guard, operator: Operator) -> None:
    """Reset the guard; where hands are needed, once a person has looked at the rig.

    Raises
    ------
    AbortedError
        When the person says so.
    TrippedError
        When a condition still stands.
    """
    if backend.needs_hands:
        text = "Look at the rig: is its way free, are all hands out, the e-stop in reach? Then the guard is reset"
        confirm(operator, Prompt(text))
    if backend.stage.state().fault is not None:
        # Switched off, a drive forgets the alarm that was seen to meanwhile; one that still stands comes back.
        backend.stage.disable()
    still_tripped = guard.reset(backend.stage.state())
    if still_tripped is not None:
        raise TrippedError(f"{still_tripped.message}; the guard stays tripped until that is seen to.")


def enable_and_home(backend: Backend, operator: Operator) -> None:
    """Switch the drive on, and find the origin unless it is known; where hands are needed, a person is asked before.

    Raises
    ------
    AbortedError
        When the person says so.
    DeviceError
        When the drive refuses.
    """
    backend.stage.enable()
    if not backend.stage.state().homed:
        if backend.needs_hands:
            confirm(operator, Prompt(HOMING_PROMPT))
        backend.stage.home()


def confirm(operator: Operator, prompt: Prompt) -> None:
    """Put a prompt; anything but done raises `AbortedError`."""
    if operator.ask(prompt) is not Answer.DONE:
        raise AbortedError("ended at a prompt.")


def park(backend: Backend, ended_for: str = "") -> list[str]:
    """Stop everything and switch the drive off once the stage stands; return what went wrong.

    What ended a session, if anything did, mostly keeps it from ending well too. Its own words are the ones that help,
    so that after it nothing is told but what has to be done by hand.
    """
    # Switched off in motion, a stage coasts.
    steps = (backend.stage.stop, backend.sampler.stop, lambda: await_standstill(backend), backend.stage.disable)
    failures = [text for step in steps if (text := attempt(step))]
    return [_DRIVE_MAY_BE_ON] if failures and ended_for else failures


def await_standstill(backend: Backend) -> None:
    """Wait until the stage stands, which may be a moment after its last sample; for 10 s at most."""
    until = backend.clock.monotonic() + _MAX_STANDSTILL_WAIT_S
    while backend.stage.state().moving and backend.clock.monotonic() < until:
        backend.clock.sleep(0.01, Signal())


def positioning_profile(way_mm: float, limits: StageLimits) -> MotionProfile:
    """Return the motion that brings the stage elsewhere, quietly."""
    speed = min(_POSITIONING_SPEED_MM_S, limits.speed_mm_s)
    accel = min(_POSITIONING_ACCEL_MM_S2, limits.acceleration_mm_s2)
    return MotionProfile.from_pieces(trapezoid(way_mm, speed, accel))
