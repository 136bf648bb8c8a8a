"""Before and after motion: the guard's reset, the way to the origin, the way to where a run begins, and the end."""

from threading import Event as Signal

from dragrig.config.errors import AbortedError, TrippedError
from dragrig.rig.acquiring import attempt
from dragrig.rig.backend import Backend
from dragrig.rig.devices import StageLimits
from dragrig.rig.guard import Guard
from dragrig.rig.people import Answer, Operator, Prompt
from dragrig.rig.profile import MotionProfile, trapezoid

IN_PLACE_MM = 0.005
HOMING = "The stage goes to the end of its travel to find its origin: take the capsule out of its way"
_STANDSTILL_S = 10.0
"""How long a stage is waited for to stand."""
_LEFT_ON = "and the rig could not be left as usual: see that its drive is switched off"
_POSITIONING_SPEED_MM_S = 20.0
_POSITIONING_ACCEL_MM_S2 = 200.0


def reset(backend: Backend, guard: Guard, operator: Operator) -> None:
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


def make_ready(backend: Backend, operator: Operator) -> None:
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
            confirm(operator, Prompt(HOMING))
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
    return [_LEFT_ON] if failures and ended_for else failures


def await_standstill(backend: Backend) -> None:
    """Wait until the stage stands, which may be a moment after its last sample; for 10 s at most."""
    until = backend.clock.monotonic() + _STANDSTILL_S
    while backend.stage.state().moving and backend.clock.monotonic() < until:
        backend.clock.sleep(0.01, Signal())


def positioning(way_mm: float, limits: StageLimits) -> MotionProfile:
    """Return the motion that brings the stage elsewhere, quietly."""
    speed = min(_POSITIONING_SPEED_MM_S, limits.speed_mm_s)
    accel = min(_POSITIONING_ACCEL_MM_S2, limits.acceleration_mm_s2)
    return MotionProfile.from_pieces(trapezoid(way_mm, speed, accel))
