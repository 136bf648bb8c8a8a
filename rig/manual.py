"""Moving the stage by hand: reset, homing, jogs, and touching off; guarded as every motion, and not recorded."""

from dataclasses import dataclass
from math import copysign, isfinite

from dragrig.config.errors import DeviceError, SettingsError
from dragrig.rig.by_hand import ByHand
from dragrig.rig.devices import Contact, Side, StageLimits
from dragrig.rig.people import Prompt
from dragrig.rig.profile import MotionProfile, Phase, still, trapezoid
from dragrig.rig.readiness import HOMING, positioning, reset
from dragrig.rig.reading import Reading
from dragrig.rig.touching import ContactSeeker

SPEED_MM_S = 10.0
"""Of a jog that names none."""
OVERRIDE_SPEED_MM_S = 2.0
"""The most that a jog off a limit switch may do."""
_REST_S = 1.0
_SETTLE_S = 0.3
_APPROACH_ACCEL_S = 0.1
"""An approach takes so long to its speed, because the sensor feels the capsule's mass when it is faster."""


@dataclass(frozen=True, slots=True)
class Touched:
    """A contact: its absolute position, and the change of the force that told it."""

    position_mm: float
    force_mN: float


class Manual(ByHand):
    """What a person may do with an open rig between runs; belongs to one thread, as the engine's `acquire`.

    Every method raises `AbortedError` when the person, or whoever calls `Engine.abort`, says so, `TrippedError` when
    the guard is latched or trips, and `DeviceError` when a device refuses.
    """

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
            self.require_armed()
        self.ask(Prompt(HOMING, hands=self._backend.needs_hands))
        if override is None:
            self._backend.stage.enable()
            self._backend.stage.home()
            return self.position_mm
        with self.freed(override):
            self._backend.stage.enable()
            self._backend.stage.home()
        return self.position_mm

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
        require_jog(distance_mm, speed, override, self._backend.stage.limits)
        profile = self.stroke(distance_mm, speed)
        if override is not None:
            return self._jog_off(override, distance_mm, speed, profile)
        self.make_ready()
        self.require_within(self.position_mm + distance_mm)
        self.ask(Prompt(self.way(distance_mm, speed), hands=False))
        self.go("jog", profile)
        return self.position_mm

    def travel(self, distance_mm: float, speed_mm_s: float) -> float:
        """Move as `jog` does; return how far the encoder, as it is calibrated now, says that the stage went [mm]."""
        self.require_armed()
        shown_mm = 0.0

        def follow(reading: Reading) -> bool:
            nonlocal shown_mm
            shown_mm = float(reading.channels["position"][-1])
            return False

        self.require_within(self.position_mm + distance_mm)
        self.ask(Prompt(self.way(distance_mm, speed_mm_s), hands=False))
        profile = self.stroke(distance_mm, speed_mm_s)
        self.go(
            "calibration", MotionProfile.from_pieces((*profile.pieces(), still(_SETTLE_S, Phase.HOLD))), until=follow
        )
        return shown_mm

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
        require_approach(force_mN, speed_mm_s, most_mm, back_mm, self._backend.stage.limits)
        self.make_ready()
        begin_mm = self.position_mm
        self.require_within(begin_mm + most_mm)
        after = f", then back by {back_mm:g} mm, but no further than to where it began" if back_mm else ""
        text = f"{self.way(most_mm, speed_mm_s)} at most, until the force has changed by {force_mN:g} mN{after}"
        self.ask(Prompt(text, hands=self._backend.needs_hands))
        found = self._approach(force_mN, speed_mm_s, most_mm)
        if back_mm:
            away_mm = copysign(max(abs(found.position_mm) - back_mm, 0.0), most_mm)
            way_mm = begin_mm + away_mm - self.position_mm
            self.go("positioning", positioning(way_mm, self._backend.stage.limits))
        return Touched(begin_mm + found.position_mm, found.force_mN)

    def _approach(self, force_mN: float, speed_mm_s: float, most_mm: float) -> Touched:
        accel = min(speed_mm_s / _APPROACH_ACCEL_S, self._backend.stage.limits.acceleration_mm_s2)
        pieces = (still(_REST_S, Phase.REST), *trapezoid(most_mm, speed_mm_s, accel))
        seeker = ContactSeeker(force_mN, self._backend.sampler.sample_rate_hz)
        self.go("touch-off", MotionProfile.from_pieces(pieces), Contact.SLIDING, seeker)
        if seeker.position_mm is None:
            raise DeviceError(
                f"there is no contact within {abs(most_mm):g} mm: the force changed by {seeker.change_mN:.1f} mN, "
                f"where {force_mN:g} mN are sought."
            )
        return Touched(seeker.position_mm, seeker.change_mN)

    def _jog_off(self, side: Side, distance_mm: float, speed_mm_s: float, profile: MotionProfile) -> float:
        stage = self._backend.stage
        text = f"Look at the rig. {self.way(distance_mm, speed_mm_s)}, its {side} limit switch overridden"
        self.ask(Prompt(text, hands=self._backend.needs_hands))
        with self.freed(side):
            stage.enable()
            self.go("jog", profile)
        return self.position_mm


def require_jog(distance_mm: float, speed_mm_s: float | None, override: Side | None, limits: StageLimits) -> None:
    """Raise `SettingsError` for a jog that cannot be, wherever the stage is."""
    if not isfinite(distance_mm) or distance_mm == 0:
        raise SettingsError(f"distance_mm = {distance_mm:g}: is no way to go.")
    if speed_mm_s is not None:
        require_speed(speed_mm_s, limits)
    if override is None:
        return
    if (distance_mm > 0) is not (override is Side.LOW):
        raise SettingsError(f"distance_mm = {distance_mm:g}: goes onto the {override} limit switch, not off it.")
    if speed_mm_s is not None and speed_mm_s > OVERRIDE_SPEED_MM_S:
        raise SettingsError(
            f"speed_mm_s = {speed_mm_s:g}: off a limit switch the stage goes at up to {OVERRIDE_SPEED_MM_S:g} mm/s."
        )


def require_approach(force_mN: float, speed_mm_s: float, most_mm: float, back_mm: float, limits: StageLimits) -> None:
    """Raise `SettingsError` for a touching off that cannot be, wherever the stage is."""
    if not (isfinite(force_mN) and force_mN > 0):
        raise SettingsError(f"force_mN = {force_mN:g}: must be more than 0; a change to either side counts.")
    require_speed(speed_mm_s, limits)
    if not isfinite(most_mm) or most_mm == 0:
        raise SettingsError(f"most_mm = {most_mm:g}: is no way to go.")
    if not (isfinite(back_mm) and back_mm >= 0):
        raise SettingsError(f"back_mm = {back_mm:g}: must be 0 or more; it counts away from the contact.")


def require_speed(speed_mm_s: float, limits: StageLimits) -> None:
    """Raise `SettingsError` for a speed that the stage cannot have."""
    if not 0 < speed_mm_s <= limits.speed_mm_s:
        raise SettingsError(
            f"speed_mm_s = {speed_mm_s:g}: must be more than 0, and {limits.speed_mm_s:g} at most "
            "(stage.max_speed_mm_s of the rig file)."
        )
