"""Moving the stage by hand: reset, homing, jogs, and touching off; guarded as every motion, and not recorded."""

from collections.abc import Callable
from dataclasses import dataclass
from math import copysign, isfinite
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
from dragrig.rig.profile import MotionProfile, Phase, still, trapezoid
from dragrig.rig.readiness import HOMING, confirm, make_ready, positioning, reset
from dragrig.rig.reading import Reading
from dragrig.rig.touching import ContactSeeker
from dragrig.rig.trips import Trip

SPEED_MM_S = 10.0
"""Of a jog that names none."""
OVERRIDE_SPEED_MM_S = 2.0
"""The most that a jog off a limit switch may do."""
_ACCEL_MM_S2 = 200.0
_REST_S = 1.0
_RELAXED_S = 3600.0
"""Age of whatever a simulated rig has in touch before a motion by hand: nothing of it relaxes any more."""
_APPROACH_ACCEL_S = 0.1
"""An approach takes so long to its speed, because the sensor feels the capsule's mass when it is faster."""


@dataclass(frozen=True, slots=True)
class Touched:
    """A contact: its absolute position, and the change of the force that told it."""

    position_mm: float
    force_mN: float


class Manual:
    """What a person may do with an open rig between runs; belongs to one thread, as the engine's `acquire`.

    Every method raises `AbortedError` when the person, or whoever calls `Engine.abort`, says so, `TrippedError` when
    the guard is latched or trips, and `DeviceError` when a device refuses.
    """

    def __init__(self, backend: Backend, guard: Guard, engine: Engine, operator: Operator) -> None:
        self._backend, self._guard, self._engine, self._operator = backend, guard, engine, operator
        self._made = 0

    @property
    def trip(self) -> Trip | None:
        """What the guard is tripped on; None when it is armed."""
        return self._guard.trip

    def reset(self) -> None:
        """Reset the guard; where hands are needed, once a person has looked at the rig.

        The drive is switched off for it, which clears what it has latched.
        """
        self._backend.stage.disable()
        reset(self._backend, self._guard, self._operator)
        self._go_on()

    def home(self, override: Side | None = None) -> float:
        """Find the origin, known before or not, once the person agrees; return where the stage then is [mm].

        Parameters
        ----------
        override
            Side whose limit switch is pressed, as of `jog`: a stage that does not know where it is cannot jog.
        """
        if override is None:
            self._require_armed()
        self._confirm(Prompt(HOMING, hands=self._backend.needs_hands))
        if override is not None:
            self._free(override)
        self._backend.stage.enable()
        self._backend.stage.home()
        if override is not None:
            self._guard.reset(self._backend.stage.state())
        return self._position_mm

    def jog(self, distance_mm: float, speed_mm_s: float | None = None, override: Side | None = None) -> float:
        """Move by a signed distance, once the person agrees; return where the stage then is [mm].

        Parameters
        ----------
        speed_mm_s
            10 mm/s unless given, or as fast as it may.
        override
            Side whose limit switch is pressed: it alone is freed, for this one slow jog away from it. The guard need
            not be reset before, and is latched again afterwards if the switch still is pressed.

        Raises
        ------
        SettingsError
            For a distance or a speed that cannot be.
        """
        usual = SPEED_MM_S if override is None else OVERRIDE_SPEED_MM_S
        speed = min(usual, self._backend.stage.limits.speed_mm_s) if speed_mm_s is None else speed_mm_s
        _require_positive("speed_mm_s", speed)
        if not isfinite(distance_mm) or distance_mm == 0:
            raise SettingsError(f"distance_mm = {distance_mm:g}: is no way to go.")
        accel = min(_ACCEL_MM_S2, self._backend.stage.limits.acceleration_mm_s2)
        profile = MotionProfile.from_pieces(trapezoid(distance_mm, speed, accel))
        if override is not None:
            return self._jog_off(override, distance_mm, speed, profile)
        self._make_ready()
        self._require_within(self._position_mm + distance_mm)
        self._confirm(Prompt(self._way(distance_mm, speed), hands=False))
        self._go("jog", profile)
        return self._position_mm

    def touch_off(self, force_mN: float, speed_mm_s: float, most_mm: float, back_mm: float = 0.0) -> Touched:
        """Approach slowly until the force has changed against its value at rest, once the person agrees.

        Parameters
        ----------
        force_mN
            Change of the force that is a contact.
        most_mm
            Signed distance to go at most.
        back_mm
            How far before the contact the stage goes back to at the end, but no further than where it began; it stays
            where it stopped for 0.

        Raises
        ------
        SettingsError
            For values that cannot be, and for a force that is lost in the noise.
        DeviceError
            When there is no contact within `most_mm`.
        """
        _require_positive("force_mN", force_mN)
        _require_positive("speed_mm_s", speed_mm_s)
        if not isfinite(most_mm) or most_mm == 0 or not 0 <= back_mm < float("inf"):
            raise SettingsError(f"most_mm = {most_mm:g}, back_mm = {back_mm:g}: is no way to go there and back.")
        self._make_ready()
        begin_mm = self._position_mm
        self._require_within(begin_mm + most_mm)
        after = f", then back to {back_mm:g} mm before that" if back_mm else ""
        text = f"{self._way(most_mm, speed_mm_s)} at most, until the force has changed by {force_mN:g} mN{after}"
        self._confirm(Prompt(text, hands=self._backend.needs_hands))
        found = self._approach(force_mN, speed_mm_s, most_mm)
        if back_mm:
            away_mm = copysign(max(abs(found.position_mm) - back_mm, 0.0), most_mm)
            way_mm = begin_mm + away_mm - self._position_mm
            self._go("positioning", positioning(way_mm, self._backend.stage.limits))
        return Touched(begin_mm + found.position_mm, found.force_mN)

    def _approach(self, force_mN: float, speed_mm_s: float, most_mm: float) -> Touched:
        accel = min(speed_mm_s / _APPROACH_ACCEL_S, self._backend.stage.limits.acceleration_mm_s2)
        pieces = (still(_REST_S, Phase.REST), *trapezoid(most_mm, speed_mm_s, accel))
        seeker = ContactSeeker(force_mN, self._backend.sampler.sample_rate_hz)
        self._go("touch-off", MotionProfile.from_pieces(pieces), Contact.SLIDING, seeker)
        if seeker.position_mm is None:
            raise DeviceError(
                f"there is no contact within {abs(most_mm):g} mm: the force changed by {seeker.change_mN:.1f} mN, "
                f"where {force_mN:g} mN are sought."
            )
        return Touched(seeker.position_mm, seeker.change_mN)

    def _jog_off(self, side: Side, distance_mm: float, speed_mm_s: float, profile: MotionProfile) -> float:
        stage = self._backend.stage
        if (distance_mm > 0) is not (side is Side.LOW):
            raise SettingsError(f"distance_mm = {distance_mm:g}: goes onto the {side} limit switch, not off it.")
        if speed_mm_s > OVERRIDE_SPEED_MM_S:
            raise SettingsError(
                f"speed_mm_s = {speed_mm_s:g}: off a limit switch the stage goes at up to {OVERRIDE_SPEED_MM_S:g} mm/s."
            )
        text = f"Look at the rig. {self._way(distance_mm, speed_mm_s)}, its {side} limit switch overridden"
        self._confirm(Prompt(text, hands=self._backend.needs_hands))
        self._free(side)
        stage.enable()
        self._go("jog", profile)
        self._guard.reset(stage.state())
        return self._position_mm

    def _free(self, side: Side) -> None:
        stage = self._backend.stage
        fault = stage.state().fault
        if fault is None or fault.cause not in SWITCHES.values():
            raise DeviceError(f"the {side} limit switch is not pressed, so there is nothing to override.")
        stage.override_limit(side)
        still_tripped = self._guard.override(side, stage.state())
        if still_tripped is not None:
            stage.disable()
            raise TrippedError(f"{still_tripped.message}; only the {side} limit switch is overridden.")

    @property
    def _position_mm(self) -> float:
        return self._backend.stage.state().position_mm

    def _way(self, distance_mm: float, speed_mm_s: float) -> str:
        begin_mm = self._position_mm
        return f"The stage goes from {begin_mm:.3f} to {begin_mm + distance_mm:.3f} mm at {speed_mm_s:g} mm/s"

    def _go(
        self,
        kind: str,
        profile: MotionProfile,
        contact: Contact = Contact.NONE,
        until: Callable[[Reading], bool] | None = None,
    ) -> None:
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
        require_complete(self._engine.acquire(acquisition, until=until))

    def _make_ready(self) -> None:
        self._require_armed()
        make_ready(self._backend, self._operator)
        self._go_on()

    def _confirm(self, prompt: Prompt) -> None:
        confirm(self._operator, prompt)
        self._go_on()

    def _go_on(self) -> None:
        if self._engine.cancelled.is_set():
            raise AbortedError(self._engine.abort_reason or "aborted")

    def _require_armed(self) -> None:
        if self._guard.trip is not None:
            raise TrippedError(f"the guard is tripped: {self._guard.trip.message}; clear the cause and reset it.")

    def _require_within(self, end_mm: float) -> None:
        limits = self._backend.stage.limits
        if not limits.lowest_mm <= end_mm <= limits.highest_mm:
            raise SettingsError(
                f"the stage would go to {end_mm:g} mm, where it may go from {limits.lowest_mm:g} to "
                f"{limits.highest_mm:g} mm (stage.lowest_mm and highest_mm of the rig file)."
            )


def _require_positive(key: str, value: float) -> None:
    if not (isfinite(value) and value > 0):
        raise SettingsError(f"{key} = {value:g}: must be more than 0.")
