"""What every motion by hand is made of: a question, a guarded acquisition that is not recorded, an override."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from uuid import uuid4

from dragrig.config.capsule import Capsule
from dragrig.config.errors import AbortedError, DeviceError, SettingsError, TrippedError
from dragrig.config.library import find
from dragrig.config.specimen import Fixture, Specimen
from dragrig.rig.backend import Backend
from dragrig.rig.devices import Acquisition, Contact, Side
from dragrig.rig.endings import require_complete
from dragrig.rig.engine import Engine
from dragrig.rig.guard import SWITCHES, Guard
from dragrig.rig.people import Operator, Prompt
from dragrig.rig.profile import MotionProfile, trapezoid
from dragrig.rig.readiness import await_standstill, confirm, make_ready
from dragrig.rig.reading import Reading
from dragrig.rig.trips import Trip

_ACCEL_MM_S2 = 200.0
_RELAXED_S = 3600.0
"""Age of whatever a simulated rig has in touch before a motion by hand: nothing of it relaxes any more."""


class ByHand:
    """An open rig under a person's hand; belongs to one thread."""

    def __init__(self, backend: Backend, guard: Guard, engine: Engine, operator: Operator) -> None:
        self._backend, self._guard, self._engine, self._operator = backend, guard, engine, operator
        self._made = 0

    @property
    def trip(self) -> Trip | None:
        """What the guard is tripped on; None when it is armed."""
        return self._guard.trip

    def make_ready(self) -> None:
        """Switch the drive on, and find the origin unless it is known; where hands are needed, a person is asked."""
        self.require_armed()
        make_ready(self._backend, self._operator)
        self._go_on()

    def ask(self, prompt: Prompt) -> None:
        """Put a prompt; anything but done ends what is being done."""
        confirm(self._operator, prompt)
        self._go_on()

    @contextmanager
    def freed(self, side: Side) -> Iterator[None]:
        """Override the pressed limit switch of a side for one motion; everything else has to be clear.

        Afterwards the guard is latched again if the switch still is pressed, and in any case if the motion failed.
        """
        self._free(side)
        try:
            yield
        except BaseException:
            self._guard.latch(Trip(SWITCHES[side], f"the way off the {side} limit switch ended early"))
            raise
        self._guard.reset(self._backend.stage.state())

    def _free(self, side: Side) -> None:
        stage = self._backend.stage
        fault = stage.state().fault
        if fault is None:
            raise DeviceError(f"the {side} limit switch is not pressed, so there is nothing to override.")
        if fault.cause is not SWITCHES[side]:
            raise TrippedError(f"{fault.message}; the {side} limit switch alone can be overridden here.")
        stage.override_limit(side)
        still_tripped = self._guard.override(side, stage.state())
        if still_tripped is not None:
            stage.disable()
            raise TrippedError(f"{still_tripped.message}; the {side} limit switch alone is overridden.")

    @property
    def position_mm(self) -> float:
        """Absolute position of the stage."""
        return self._backend.stage.state().position_mm

    def way(self, distance_mm: float, speed_mm_s: float) -> str:
        """Say from where to where the stage would go."""
        begin_mm = self.position_mm
        return f"The stage goes from {begin_mm:.3f} to {begin_mm + distance_mm:.3f} mm at {speed_mm_s:g} mm/s"

    def go(
        self,
        kind: str,
        profile: MotionProfile,
        contact: Contact = Contact.NONE,
        until: Callable[[Reading], bool] | None = None,
    ) -> None:
        """Make a motion, guarded, until it is over or `until` says so; raises for any other end."""
        acquisition = Acquisition(
            run_id=str(uuid4()),
            order=self._made,
            kind=kind,
            profile=profile,
            capsule=find(Capsule, "capsule", "none" if contact is Contact.NONE else "drag"),
            specimen=Specimen(name="none"),
            fixture=Fixture.NONE if contact is Contact.NONE else Fixture.FOAM,
            contact=contact,
            insertion_dwell_s=_RELAXED_S,
        )
        self._made += 1
        outcome = self._engine.acquire(acquisition, until=until)
        await_standstill(self._backend)
        require_complete(outcome)

    def stroke(self, distance_mm: float, speed_mm_s: float) -> MotionProfile:
        """Return the motion over a signed distance."""
        accel = min(_ACCEL_MM_S2, self._backend.stage.limits.acceleration_mm_s2)
        return MotionProfile.from_pieces(trapezoid(distance_mm, speed_mm_s, accel))

    def _go_on(self) -> None:
        if self._engine.cancelled.is_set():
            raise AbortedError(self._engine.abort_reason or "aborted")

    def require_armed(self) -> None:
        """Raise `TrippedError` while the guard is tripped."""
        if self._guard.trip is not None:
            raise TrippedError(f"the guard is tripped: {self._guard.trip.message}; clear the cause and reset it.")

    def require_within(self, end_mm: float) -> None:
        """Raise `SettingsError` for an absolute position outside of the stage's travel."""
        limits = self._backend.stage.limits
        if not limits.lowest_mm <= end_mm <= limits.highest_mm:
            raise SettingsError(
                f"the stage would go to {end_mm:g} mm, where it may go from {limits.lowest_mm:g} to "
                f"{limits.highest_mm:g} mm (stage.lowest_mm and highest_mm of the rig file)."
            )
