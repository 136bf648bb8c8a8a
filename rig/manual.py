"""Moving the stage by hand: reset, homing, jogs and touch-off; guarded like every motion, and not recorded."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import copysign, isfinite
from uuid import uuid4

import numpy as np

from dragrig.config.errors import AbortedError, DeviceError, SettingsError, TrippedError
from dragrig.config.settings import find_settings
from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Acquisition, Backend, Contact, StageLimits, TravelEnd, Trip
from dragrig.rig.engine import Engine, require_complete
from dragrig.rig.guard import LIMIT_SWITCH_CAUSES, Guard
from dragrig.rig.operator import (
    HOMING_PROMPT,
    Operator,
    Prompt,
    await_standstill,
    confirm,
    enable_and_home,
    positioning_profile,
    reset_guard,
)
from dragrig.rig.profile import MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.rig.reading import Reading

_AVERAGING_S = 0.01
_MIN_FORCE_TO_NOISE = 5.0
"""A change smaller than so many standard deviations of the averaged force would be found in noise."""


class ContactDetector:
    """Told every reading of an approach from rest, it says yes at the contact.

    Forces are averages over 10 ms.

    Parameters
    ----------
    force_mN
        Change of the force, to either side, that is a contact.
    """

    def __init__(self, force_mN: float, rate_hz: float) -> None:
        self._force_mN = force_mN
        self._window = max(1, round(_AVERAGING_S * rate_hz))
        self._at_rest: list[FloatArray] = []
        self._rest_mN: float | None = None
        self._force: FloatArray = np.zeros(0)
        self._position: FloatArray = np.zeros(0)
        self.position_mm: float | None = None
        """Where the contact is, relative to where the approach began; None before it is found."""
        self.change_mN = 0.0
        """Change of the force at the contact; before it, the largest so far."""

    def __call__(self, reading: Reading) -> bool:
        """Take the next reading; return whether the contact is found.

        Raises
        ------
        SettingsError
            When the noise at rest is too large for the force that is sought.
        """
        resting = reading.phase == Phase.REST
        force = reading.channels["force"].astype(np.float64)
        self._at_rest.append(force[resting])
        if resting.all():
            return False
        rest_mN = self._rest() if self._rest_mN is None else self._rest_mN
        self._force = np.concatenate((self._force, force[~resting]))
        self._position = np.concatenate((self._position, reading.channels["position"][~resting].astype(np.float64)))
        if len(self._force) < self._window:
            return False
        return self._look(self._averages(self._force) - rest_mN)

    def _rest(self) -> float:
        force = np.concatenate(self._at_rest)
        averages = self._averages(force)
        noise = float(averages.std())
        if self._force_mN < _MIN_FORCE_TO_NOISE * noise:
            raise SettingsError(
                f"force_mN = {self._force_mN:g}: is lost in the noise at rest of {noise:.1f} mN; seek at least "
                f"{_MIN_FORCE_TO_NOISE * noise:.1f} mN."
            )
        self._rest_mN = float(force.mean())
        return self._rest_mN

    def _look(self, change: FloatArray) -> bool:
        over = np.flatnonzero(np.abs(change) >= self._force_mN)
        found = int(over[0]) if over.size else int(np.abs(change).argmax())
        if over.size or abs(change[found]) > abs(self.change_mN):
            self.change_mN = float(change[found])
        if over.size:
            self.position_mm = float(self._position[found + self._window // 2])
        kept = self._window - 1
        self._force, self._position = (
            self._force[len(self._force) - kept :],
            self._position[len(self._position) - kept :],
        )
        return bool(over.size)

    def _averages(self, force: FloatArray) -> FloatArray:
        return np.convolve(force, np.full(self._window, 1.0 / self._window), "valid")


_JOG_ACCEL_MM_S2 = 200.0
_RELAXED_CONTACT_S = 3600.0
"""Age of whatever a simulated rig has in touch before a motion by hand: nothing of it relaxes any more."""


class GuardedMotion:
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
        enable_and_home(self._backend, self._operator)
        self._go_on()

    def ask(self, prompt: Prompt) -> None:
        """Put a prompt; anything but done ends what is being done."""
        confirm(self._operator, prompt)
        self._go_on()

    @contextmanager
    def freed(self, side: TravelEnd) -> Iterator[None]:
        """Override the pressed limit switch of a side for one motion; everything else has to be clear.

        Afterwards the guard is latched again if the switch still is pressed, and in any case if the motion failed.
        """
        self._free(side)
        try:
            yield
        except BaseException:
            self._guard.latch(Trip(LIMIT_SWITCH_CAUSES[side], f"the way off the {side} limit switch ended early"))
            raise
        self._guard.reset(self._backend.stage.state())

    def _free(self, side: TravelEnd) -> None:
        stage = self._backend.stage
        fault = stage.state().fault
        if fault is None:
            raise DeviceError(f"the {side} limit switch is not pressed, so there is nothing to override.")
        if fault.cause is not LIMIT_SWITCH_CAUSES[side]:
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
            capsule=find_settings(Capsule, "capsule", "none" if contact is Contact.NONE else "drag"),
            specimen=Specimen(name="none"),
            fixture=Fixture.NONE if contact is Contact.NONE else Fixture.FOAM,
            contact=contact,
            insertion_dwell_s=_RELAXED_CONTACT_S,
        )
        self._made += 1
        outcome = self._engine.acquire(acquisition, until=until)
        await_standstill(self._backend)
        require_complete(outcome)

    def stroke(self, distance_mm: float, speed_mm_s: float) -> MotionProfile:
        """Return the motion over a signed distance."""
        accel = min(_JOG_ACCEL_MM_S2, self._backend.stage.limits.acceleration_mm_s2)
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


JOG_SPEED_MM_S = 10.0
"""Of a jog that names none."""
MAX_OVERRIDE_SPEED_MM_S = 2.0
"""The most that a jog off a limit switch may do."""
_REST_BEFORE_APPROACH_S = 1.0
_HOLD_AFTER_TRAVEL_S = 0.3
_APPROACH_RAMP_S = 0.1
"""An approach takes so long to its speed, because the sensor feels the capsule's mass when it is faster."""


@dataclass(frozen=True, slots=True)
class DetectedContact:
    """A contact: its absolute position, and the change of the force that told it."""

    position_mm: float
    force_mN: float


class ManualControl(GuardedMotion):
    """What a person may do with an open rig between runs; belongs to one thread, as the engine's `acquire`.

    Every method raises `AbortedError` when the person, or whoever calls `Engine.abort`, says so, `TrippedError` when
    the guard is latched or trips, and `DeviceError` when a device refuses.
    """

    def reset(self) -> None:
        """Reset the guard; where hands are needed, once a person has looked at the rig.

        The drive is switched off for it, which clears what it has latched.
        """
        self._backend.stage.disable()
        reset_guard(self._backend, self._guard, self._operator)
        self._go_on()

    def home(self, override: TravelEnd | None = None) -> float:
        """Find the origin, known before or not, once the person agrees; return where the stage then is [mm].

        Parameters
        ----------
        override
            Side whose limit switch is pressed, as of `jog`: a stage that does not know where it is cannot jog.
        """
        if override is None:
            self.require_armed()
        self.ask(Prompt(HOMING_PROMPT, hands=self._backend.needs_hands))
        if override is None:
            self._backend.stage.enable()
            self._backend.stage.home()
            return self.position_mm
        with self.freed(override):
            self._backend.stage.enable()
            self._backend.stage.home()
        return self.position_mm

    def jog(self, distance_mm: float, speed_mm_s: float | None = None, override: TravelEnd | None = None) -> float:
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
        usual = JOG_SPEED_MM_S if override is None else MAX_OVERRIDE_SPEED_MM_S
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
            "calibration",
            MotionProfile.from_pieces((*profile.pieces(), stationary_piece(_HOLD_AFTER_TRAVEL_S, Phase.HOLD))),
            until=follow,
        )
        return shown_mm

    def touch_off(self, force_mN: float, speed_mm_s: float, most_mm: float, back_mm: float = 0.0) -> DetectedContact:
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
        require_touch_off(force_mN, speed_mm_s, most_mm, back_mm, self._backend.stage.limits)
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
            self.go("positioning", positioning_profile(way_mm, self._backend.stage.limits))
        return DetectedContact(begin_mm + found.position_mm, found.force_mN)

    def _approach(self, force_mN: float, speed_mm_s: float, most_mm: float) -> DetectedContact:
        accel = min(speed_mm_s / _APPROACH_RAMP_S, self._backend.stage.limits.acceleration_mm_s2)
        pieces = (stationary_piece(_REST_BEFORE_APPROACH_S, Phase.REST), *trapezoid(most_mm, speed_mm_s, accel))
        seeker = ContactDetector(force_mN, self._backend.sampler.sample_rate_hz)
        self.go("touch-off", MotionProfile.from_pieces(pieces), Contact.SLIDING, seeker)
        if seeker.position_mm is None:
            raise DeviceError(
                f"there is no contact within {abs(most_mm):g} mm: the force changed by {seeker.change_mN:.1f} mN, "
                f"where {force_mN:g} mN are sought."
            )
        return DetectedContact(seeker.position_mm, seeker.change_mN)

    def _jog_off(self, side: TravelEnd, distance_mm: float, speed_mm_s: float, profile: MotionProfile) -> float:
        stage = self._backend.stage
        text = f"Look at the rig. {self.way(distance_mm, speed_mm_s)}, its {side} limit switch overridden"
        self.ask(Prompt(text, hands=self._backend.needs_hands))
        with self.freed(side):
            stage.enable()
            self.go("jog", profile)
        return self.position_mm


def require_jog(distance_mm: float, speed_mm_s: float | None, override: TravelEnd | None, limits: StageLimits) -> None:
    """Raise `SettingsError` for a jog that cannot be, wherever the stage is."""
    if not isfinite(distance_mm) or distance_mm == 0:
        raise SettingsError(f"distance_mm = {distance_mm:g}: is no way to go.")
    if speed_mm_s is not None:
        require_speed(speed_mm_s, limits)
    if override is None:
        return
    if (distance_mm > 0) is not (override is TravelEnd.LOW):
        raise SettingsError(f"distance_mm = {distance_mm:g}: goes onto the {override} limit switch, not off it.")
    if speed_mm_s is not None and speed_mm_s > MAX_OVERRIDE_SPEED_MM_S:
        raise SettingsError(
            f"speed_mm_s = {speed_mm_s:g}: off a limit switch the stage goes at up to {MAX_OVERRIDE_SPEED_MM_S:g} mm/s."
        )


def require_touch_off(force_mN: float, speed_mm_s: float, most_mm: float, back_mm: float, limits: StageLimits) -> None:
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
