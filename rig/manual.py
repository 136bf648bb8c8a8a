"""Moving the stage by hand: reset, homing, jogs and touch-off; guarded like every motion, and not recorded.

A calibration is measured by hand as well: known weights on the sensor, known travels of the stage.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from math import copysign, isfinite
from uuid import uuid4

import numpy as np

from dragrig.config import (
    Capsule,
    DeviceError,
    Fixture,
    RigSettings,
    SettingsError,
    Specimen,
    TrippedError,
    find_settings,
    number_text,
)
from dragrig.rig.devices import (
    Acquisition,
    Backend,
    Contact,
    RawReading,
    StageLimits,
    SupportsBenchActions,
    TravelEnd,
    Trip,
)
from dragrig.rig.engine import AcquisitionOutcome, Engine, require_agreement, require_complete
from dragrig.rig.guard import LIMIT_SWITCH_CAUSES, Guard
from dragrig.rig.operator import (
    HOMING_PROMPT,
    Operator,
    Prompt,
    await_standstill,
    confirm,
    enable_and_home,
    find_origin,
    positioning_profile,
    reset_guard,
)
from dragrig.rig.profile import FloatArray, MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.rig.reading import Reading

STANDARD_GRAVITY = 9.80665
"""Weight of a gram [mN]."""
JOG_SPEED_MM_S = 10.0
"""Default speed of a jog."""
MAX_OVERRIDE_SPEED_MM_S = 2.0
"""Highest speed of a jog off a limit switch."""
_JOG_ACCEL_MM_S2 = 200.0
_REST_BEFORE_APPROACH_S = 1.0
_HOLD_AFTER_TRAVEL_S = 0.3
_HOLD_AFTER_JOG_S = 0.1
"""For drive and encoder to be compared at rest."""
_APPROACH_RAMP_S = 0.1
"""Run-up of an approach: in a shorter one, the force sensor would respond to the capsule's inertia."""
_RELAXED_CONTACT_S = 3600.0
"""Age of a simulated contact before a manual motion: nothing relaxes any more."""
_AVERAGING_S = 0.01
_MIN_FORCE_TO_NOISE = 5.0
"""A change of less than so many standard deviations of the averaged force would be detected in noise."""


class ContactDetector:
    """Detects the contact from the readings of an approach that begins at rest; forces are averages over 10 ms.

    Parameters
    ----------
    force_mN
        Change of the force, of either sign, that is a contact.
    """

    def __init__(self, force_mN: float, rate_hz: float) -> None:
        self._force_mN = force_mN
        self._window = max(1, round(_AVERAGING_S * rate_hz))
        self._at_rest: list[FloatArray] = []
        self._rest_mN: float | None = None
        self._force: FloatArray = np.zeros(0)
        self._position: FloatArray = np.zeros(0)
        self.position_mm: float | None = None
        """Position of the contact relative to the start of the approach; None before it is detected."""
        self.change_mN = 0.0
        """Change of the force at the contact; before it, the largest so far."""

    def __call__(self, reading: Reading) -> bool:
        """Take the next reading; return whether the contact is detected.

        Raises `SettingsError` when the noise at rest is too large for the force.
        """
        resting = reading.phase == Phase.REST
        force = reading.channels["force"].astype(np.float64)
        self._at_rest.append(force[resting])
        if resting.all():
            return False
        rest_mN = self._force_at_rest() if self._rest_mN is None else self._rest_mN
        self._force = np.concatenate((self._force, force[~resting]))
        self._position = np.concatenate((self._position, reading.channels["position"][~resting].astype(np.float64)))
        if len(self._force) < self._window:
            return False
        change = self._averages(self._force) - rest_mN
        beyond = np.flatnonzero(np.abs(change) >= self._force_mN)
        index = int(beyond[0]) if beyond.size else int(np.abs(change).argmax())
        if beyond.size or abs(change[index]) > abs(self.change_mN):
            self.change_mN = float(change[index])
        if beyond.size:
            self.position_mm = float(self._position[index + self._window // 2])
        first = len(self._force) - (self._window - 1)
        self._force, self._position = self._force[first:], self._position[first:]
        return bool(beyond.size)

    def _force_at_rest(self) -> float:
        force = np.concatenate(self._at_rest)
        min_force_mN = _MIN_FORCE_TO_NOISE * float(self._averages(force).std())
        if self._force_mN < min_force_mN:
            raise SettingsError(
                f"force_mN = {self._force_mN:g}: is within the noise at rest; choose at least {min_force_mN:.1f} mN."
            )
        self._rest_mN = float(force.mean())
        return self._rest_mN

    def _averages(self, force: FloatArray) -> FloatArray:
        return np.convolve(force, np.full(self._window, 1.0 / self._window), "valid")


@dataclass(frozen=True, slots=True)
class DetectedContact:
    """A contact: its absolute position, and the change of the force there."""

    position_mm: float
    force_mN: float


class ManualControl:
    """Motions of an open rig by hand, between runs; belongs to one thread, as the engine's `acquire`.

    Every method raises `AbortedError` when the person, or `Engine.abort`, ends it, `TrippedError` when the guard is
    tripped or trips, and `DeviceError` when a device refuses.
    """

    def __init__(self, backend: Backend, guard: Guard, engine: Engine, operator: Operator) -> None:
        self._backend, self._guard, self._engine, self._operator = backend, guard, engine, operator
        self._order = 0

    @property
    def trip(self) -> Trip | None:
        """The trip that the guard is latched on; None when it is armed."""
        return self._guard.trip

    @property
    def position_mm(self) -> float:
        """Absolute position of the stage."""
        return self._backend.stage.state().position_mm

    def confirm(self, prompt: Prompt) -> None:
        """Show a prompt; any answer but done raises `AbortedError`."""
        confirm(self._operator, prompt)
        self._engine.require_not_aborted()

    def reset(self) -> None:
        """Reset the guard; where hands are needed, once a person has checked the rig.

        The drive is switched off for it, which clears its latched alarms.
        """
        self._backend.stage.disable()
        reset_guard(self._backend, self._guard, self._operator)
        self._engine.require_not_aborted()

    def make_ready(self) -> None:
        """Switch the drive on, and find the origin unless it is known; where hands are needed, a person confirms."""
        self._guard.require_armed()
        enable_and_home(self._backend, self._operator)
        self._engine.require_not_aborted()

    def home(self, override: TravelEnd | None = None) -> float:
        """Find the origin, known before or not, once the person confirms; return the stage's position then [mm].

        Parameters
        ----------
        override
            Side of the pressed limit switch, as of `jog`: a stage that does not know its position cannot jog.
        """
        if override is None:
            self._guard.require_armed()
        self.confirm(Prompt(HOMING_PROMPT, hands=self._backend.needs_hands))
        with self._overridden(override) if override is not None else nullcontext():
            self._backend.stage.enable()
            find_origin(self._backend.stage, self._operator)
        return self.position_mm

    def jog(self, distance_mm: float, speed_mm_s: float | None = None, override: TravelEnd | None = None) -> float:
        """Move by a signed distance, once the person confirms; return the stage's position then [mm].

        Parameters
        ----------
        speed_mm_s
            None for 10 mm/s, or the highest speed allowed if that is less.
        override
            Side of the pressed limit switch: it alone is overridden, for this one slow jog away from it. The guard
            need not be reset before, and is tripped again afterwards if the switch still is pressed.

        Raises
        ------
        SettingsError
            For a distance or a speed that is not allowed.
        """
        stage = self._backend.stage
        default = JOG_SPEED_MM_S if override is None else MAX_OVERRIDE_SPEED_MM_S
        speed = min(default, stage.limits.speed_mm_s) if speed_mm_s is None else speed_mm_s
        require_jog(distance_mm, speed, override, stage.limits)
        profile = self._stroke(distance_mm, speed, _HOLD_AFTER_JOG_S)
        if override is not None:
            self._require_pressed(override)
            text = (
                f"Check the rig. {self._move_text(distance_mm, speed)}, its {LIMIT_SWITCH_CAUSES[override]} overridden"
            )
            self.confirm(Prompt(text, hands=self._backend.needs_hands))
            with self._overridden(override):
                stage.enable()
                require_agreement(self._acquire("jog", profile))
            return self.position_mm
        self.make_ready()
        self._require_within_travel(self.position_mm + distance_mm)
        self.confirm(Prompt(self._move_text(distance_mm, speed), hands=False))
        require_agreement(self._acquire("jog", profile))
        return self.position_mm

    def travel(self, distance_mm: float, speed_mm_s: float) -> float:
        """Move as `jog` does; return the travel that the encoder, with its present calibration, shows [mm]."""
        self._guard.require_armed()
        shown_mm = 0.0

        def follow(reading: Reading) -> bool:
            nonlocal shown_mm
            shown_mm = float(reading.channels["position"][-1])
            return False

        self._require_within_travel(self.position_mm + distance_mm)
        self.confirm(Prompt(self._move_text(distance_mm, speed_mm_s), hands=False))
        profile = self._stroke(distance_mm, speed_mm_s, _HOLD_AFTER_TRAVEL_S)
        self._acquire("calibration", profile, stop_when=follow)
        return shown_mm

    def touch_off(self, force_mN: float, speed_mm_s: float, most_mm: float, back_mm: float = 0.0) -> DetectedContact:
        """Approach slowly until the force has changed against its value at rest, once the person confirms.

        Parameters
        ----------
        force_mN
            Change of the force that is a contact.
        most_mm
            Signed distance to move at most.
        back_mm
            Distance from the contact to which the stage retracts at the end, but no further than its start; 0 for none.

        Raises
        ------
        SettingsError
            For values that are not allowed, and for a force within the noise.
        DeviceError
            When there is no contact within `most_mm`.
        """
        limits = self._backend.stage.limits
        require_touch_off(force_mN, speed_mm_s, most_mm, back_mm, limits)
        self.make_ready()
        begin_mm = self.position_mm
        self._require_within_travel(begin_mm + most_mm)
        retraction = f", then back by {number_text(back_mm)} mm, but no further than its start" if back_mm else ""
        move = self._move_text(most_mm, speed_mm_s)
        text = f"{move} at most, until the force has changed by {number_text(force_mN)} mN{retraction}"
        self.confirm(Prompt(text, hands=self._backend.needs_hands))
        accel = min(speed_mm_s / _APPROACH_RAMP_S, limits.acceleration_mm_s2)
        rest = stationary_piece(_REST_BEFORE_APPROACH_S, Phase.REST)
        profile = MotionProfile.from_pieces((rest, *trapezoid(most_mm, speed_mm_s, accel)))
        detector = ContactDetector(force_mN, self._backend.sampler.sample_rate_hz)
        self._acquire("touch-off", profile, Contact.SLIDING, detector)
        contact_mm = detector.position_mm
        if contact_mm is None:
            raise DeviceError(
                f"no contact within {abs(most_mm):g} mm: the force changed by {detector.change_mN:.1f} mN, and "
                f"{force_mN:g} mN are needed."
            )
        if back_mm:
            end_mm = begin_mm + copysign(max(abs(contact_mm) - back_mm, 0.0), most_mm)
            way_back = positioning_profile(end_mm - self.position_mm, limits)
            require_agreement(self._acquire("positioning", way_back))
        return DetectedContact(begin_mm + contact_mm, detector.change_mN)

    def measure(self, duration_s: float) -> RawReading:
        """Read the sensors without motion; ends soon after `Engine.abort`."""
        reading = self._backend.sampler.measure(duration_s, self._engine.cancelled)
        self._engine.require_not_aborted()
        return reading

    @contextmanager
    def _overridden(self, side: TravelEnd) -> Iterator[None]:
        """Override the pressed limit switch of a side for one motion; every other condition must be clear.

        Afterwards the guard is tripped again if the switch still is pressed, and in any case if the motion failed.
        """
        stage = self._backend.stage
        self._require_pressed(side)
        stage.override_limit(side)
        still_tripped = self._guard.override(side, stage.state())
        if still_tripped is not None:
            stage.disable()
            raise TrippedError(f"{still_tripped.message}; only the {LIMIT_SWITCH_CAUSES[side]} is overridden.")
        try:
            yield
        except BaseException:
            self._guard.latch(
                Trip(LIMIT_SWITCH_CAUSES[side], f"the move off the {LIMIT_SWITCH_CAUSES[side]} ended early")
            )
            raise
        self._guard.reset(stage.state())

    def _require_pressed(self, side: TravelEnd) -> None:
        """Raise unless the limit switch of a side, and nothing else, forbids motion."""
        fault, switch = self._backend.stage.state().fault, LIMIT_SWITCH_CAUSES[side]
        if fault is None:
            raise DeviceError(f"the {switch} is not pressed, so there is nothing to override.")
        if fault.cause is not switch:
            raise TrippedError(f"{fault.message}; only the {switch} can be overridden here.")

    def _move_text(self, distance_mm: float, speed_mm_s: float) -> str:
        state = self._backend.stage.state()
        # The very numbers that are sent: one that is rounded would announce another motion.
        moves = f"The stage moves by {'+' if distance_mm > 0 else ''}{number_text(distance_mm)} mm"
        speed = f"at {number_text(speed_mm_s)} mm/s"
        if not state.homed:
            return f"{moves} {speed} from where it stands"
        begin_mm = state.position_mm
        return f"{moves} {speed}, from {begin_mm:.3f} to {begin_mm + distance_mm:.3f} mm"

    def _acquire(
        self,
        kind: str,
        profile: MotionProfile,
        contact: Contact = Contact.NONE,
        stop_when: Callable[[Reading], bool] | None = None,
    ) -> AcquisitionOutcome:
        """Make a motion, guarded, until it is over or `stop_when` returns True; raises for any other end."""
        acquisition = Acquisition(
            run_id=str(uuid4()),
            order=self._order,
            kind=kind,
            profile=profile,
            capsule=find_settings(Capsule, "capsule", "none" if contact is Contact.NONE else "drag"),
            specimen=Specimen(name="none"),
            fixture=Fixture.NONE if contact is Contact.NONE else Fixture.FOAM,
            contact=contact,
            insertion_dwell_s=_RELAXED_CONTACT_S,
        )
        self._order += 1
        outcome = self._engine.acquire(acquisition, stop_when=stop_when)
        await_standstill(self._backend)
        require_complete(outcome)
        return outcome

    def _stroke(self, distance_mm: float, speed_mm_s: float, hold_s: float) -> MotionProfile:
        accel = min(_JOG_ACCEL_MM_S2, self._backend.stage.limits.acceleration_mm_s2)
        hold = stationary_piece(hold_s, Phase.HOLD)
        return MotionProfile.from_pieces((*trapezoid(distance_mm, speed_mm_s, accel), hold))

    def _require_within_travel(self, end_mm: float) -> None:
        limits = self._backend.stage.limits
        if not limits.lowest_mm <= end_mm <= limits.highest_mm:
            raise SettingsError(
                f"the stage would move to {end_mm:g} mm, outside its travel of {limits.lowest_mm:g} to "
                f"{limits.highest_mm:g} mm (stage.lowest_mm and highest_mm of the rig file)."
            )


def require_jog(distance_mm: float, speed_mm_s: float | None, override: TravelEnd | None, limits: StageLimits) -> None:
    """Raise `SettingsError` for a jog that is not allowed at any position."""
    if not isfinite(distance_mm) or distance_mm == 0:
        raise SettingsError(f"distance_mm = {distance_mm:g}: must be a distance other than 0.")
    _require_shorter_than_travel("distance_mm", distance_mm, limits)
    if speed_mm_s is not None:
        require_speed(speed_mm_s, limits)
    if override is None:
        return
    if (distance_mm > 0) is not (override is TravelEnd.LOW):
        raise SettingsError(
            f"distance_mm = {distance_mm:g}: moves onto the {LIMIT_SWITCH_CAUSES[override]}, not off it."
        )
    if speed_mm_s is not None and speed_mm_s > MAX_OVERRIDE_SPEED_MM_S:
        raise SettingsError(
            f"speed_mm_s = {speed_mm_s:g}: off a limit switch the limit is {MAX_OVERRIDE_SPEED_MM_S:g} mm/s."
        )


def _require_shorter_than_travel(name: str, distance_mm: float, limits: StageLimits) -> None:
    travel_mm = limits.highest_mm - limits.lowest_mm
    if abs(distance_mm) > travel_mm:
        raise SettingsError(
            f"{name} = {distance_mm:g}: the stage travels {travel_mm:g} mm at most, from {limits.lowest_mm:g} to "
            f"{limits.highest_mm:g} mm (stage.lowest_mm and highest_mm of the rig file)."
        )


def require_touch_off(force_mN: float, speed_mm_s: float, most_mm: float, back_mm: float, limits: StageLimits) -> None:
    """Raise `SettingsError` for a touch-off that is not allowed at any position."""
    if not (isfinite(force_mN) and force_mN > 0):
        raise SettingsError(f"force_mN = {force_mN:g}: must be more than 0; a change of either sign counts.")
    require_speed(speed_mm_s, limits)
    if not isfinite(most_mm) or most_mm == 0:
        raise SettingsError(f"most_mm = {most_mm:g}: must be a distance other than 0.")
    _require_shorter_than_travel("most_mm", most_mm, limits)
    if not (isfinite(back_mm) and back_mm >= 0):
        raise SettingsError(f"back_mm = {back_mm:g}: must be 0 or more; it counts away from the contact.")


def require_speed(speed_mm_s: float, limits: StageLimits) -> None:
    """Raise `SettingsError` for a speed beyond the stage's limit."""
    if not 0 < speed_mm_s <= limits.speed_mm_s:
        raise SettingsError(
            f"speed_mm_s = {speed_mm_s:g}: must be more than 0, and {limits.speed_mm_s:g} at most "
            "(stage.max_speed_mm_s of the rig file)."
        )


@dataclass(frozen=True, slots=True)
class LoadReading:
    """A weight on the sensor [g], its load [mN], and the sensor's reading."""

    weight_g: float
    load_mN: float
    reading: RawReading


@dataclass(frozen=True, slots=True)
class TravelReading:
    """A known travel [mm], and the encoder's counts over it."""

    travel_mm: float
    counts: float


def measure_loads(
    backend: Backend,
    rig: RigSettings,
    manual: ManualControl,
    weights_g: Sequence[float],
    repeats: int,
    duration_s: float,
) -> Iterator[LoadReading]:
    """Have each weight hung on the sensor, up and down alternately, and read the sensor.

    Raises `DeviceError` when the sensor is overloaded, `AbortedError` when the person aborts.
    """
    for repeat in range(repeats):
        for weight_g in weights_g if repeat % 2 == 0 else weights_g[::-1]:
            action = f"Hang {number_text(weight_g)} g on the sensor" if weight_g else "Take every weight off the sensor"
            manual.confirm(Prompt(f"{action} and let it hang still", hands=backend.needs_hands))
            if isinstance(backend, SupportsBenchActions):
                backend.hang(weight_g * STANDARD_GRAVITY)
            reading = manual.measure(duration_s)
            if not abs(reading.force_V) < rig.hardware.card.force.overload_V:
                raise DeviceError(
                    f"at {weight_g:g} g the sensor gives {reading.force_V:.3f} V, where it counts as overloaded: take "
                    "lighter weights, or check its wires."
                )
            yield LoadReading(weight_g, weight_g * STANDARD_GRAVITY, reading)


def measure_driven_travel(
    manual: ManualControl,
    count_mm: float,
    travel_mm: float,
    speed_mm_s: float,
    measured_mm: Sequence[float],
    repeats: int,
) -> Iterator[TravelReading]:
    """Drive the stage back and forth, and yield the encoder's counts over each stroke of known travel.

    Parameters
    ----------
    count_mm
        Length of a count in the sampler's present calibration.
    measured_mm
        Measured travel of every forward stroke; empty to trust the drive's travel, in both directions.
    """
    manual.make_ready()
    for repeat in range(repeats):
        forward = manual.travel(travel_mm, speed_mm_s) / count_mm
        yield TravelReading(measured_mm[repeat] if measured_mm else travel_mm, forward)
        backward = manual.travel(-travel_mm, speed_mm_s) / count_mm
        if not measured_mm:
            yield TravelReading(-travel_mm, backward)


def measure_pushed_travel(
    backend: Backend, manual: ManualControl, travels_mm: Sequence[float], duration_s: float
) -> Iterator[TravelReading]:
    """Have the stage, switched off, pushed by known travels, and yield the encoder's counts."""
    backend.stage.disable()
    for travel_mm in travels_mm:
        travel = f"{number_text(abs(travel_mm))} mm {'up' if travel_mm > 0 else 'down'}"
        text = f"The stage is off. After this answer, push it {travel} against a gauge, within {duration_s:g} s"
        manual.confirm(Prompt(text, hands=backend.needs_hands))
        if isinstance(backend, SupportsBenchActions):
            backend.push(travel_mm, duration_s)
        reading = manual.measure(duration_s)
        yield TravelReading(travel_mm, reading.counts_end - reading.counts_begin)
