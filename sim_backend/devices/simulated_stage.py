"""The simulated stage: motion profiles evaluated fast, the axis that owns the position, limits, states and faults.

The axis is shared by stage and sampler; every method may be called from any thread, and none waits for anything but the
lock, which is never held for long.
"""

import math
import threading
from bisect import bisect_right
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dragrig.config.errors import DeviceError
from dragrig.config.rig import EncoderSettings, ForceSensorSettings, MotorSettings, StageSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import (
    Acquisition,
    Clock,
    StageLimits,
    StageState,
    TravelEnd,
    Trip,
    TripCause,
    limits_with_override,
    require_within_limits,
    stage_limits,
)
from dragrig.rig.profile import MotionProfile, Phase, Piece, stationary_piece
from dragrig.sim_backend.devices.faults import NO_FAULTS, Faults


@dataclass(frozen=True, slots=True, eq=False)
class StageMotion:
    """Position [mm], velocity [mm/s] and acceleration [mm/s²], arrays of shape `(n,)`."""

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


def evaluate_profile(profile: MotionProfile, time_s: FloatArray) -> StageMotion:
    """Evaluate a profile at increasing times, piece by piece: what its own methods give, several times faster."""
    position, velocity, acceleration = (np.empty_like(time_s) for _ in range(3))
    starts = np.append(profile.start_s, profile.duration_s)
    edges = np.append(np.searchsorted(time_s, starts), len(time_s))
    edges[0] = 0
    rests_at = float(profile.position(profile.duration_s))
    positions = np.append(profile.position_mm, rests_at).tolist()
    velocities = np.append(profile.velocity_mm_s, 0.0).tolist()
    accelerations = np.append(profile.acceleration_mm_s2, 0.0).tolist()
    for piece in np.flatnonzero(np.diff(edges)).tolist():
        here = slice(edges[piece], edges[piece + 1])
        rate = accelerations[piece]
        acceleration[here] = rate
        if rate == 0.0:
            velocity[here] = velocities[piece]
            position[here] = positions[piece] + velocities[piece] * (time_s[here] - starts[piece])
            continue
        elapsed = time_s[here] - starts[piece]
        velocity[here] = velocities[piece] + rate * elapsed
        position[here] = positions[piece] + (velocities[piece] + 0.5 * rate * elapsed) * elapsed
    return StageMotion(position, velocity, acceleration)


def profile_position(profile: MotionProfile, time_s: float) -> float:
    """Position [mm] at one time, cheap enough to be asked for between any two blocks."""
    time_s = min(max(time_s, 0.0), profile.duration_s)
    piece = max(bisect_right(profile.start_s, time_s) - 1, 0)
    elapsed = time_s - profile.start_s.item(piece)
    speed = profile.velocity_mm_s.item(piece)
    rate = profile.acceleration_mm_s2.item(piece)
    return profile.position_mm.item(piece) + (speed + 0.5 * rate * elapsed) * elapsed


def standstill_profile(duration_s: float) -> MotionProfile:
    """Return a profile that stays where it is."""
    return MotionProfile.from_pieces([stationary_piece(max(duration_s, 1e-3), Phase.REST)])


def runaway_profile(
    profile: MotionProfile, at_s: float, speed_mm_s: float, until_mm: float, accel_mm_s2: float
) -> MotionProfile:
    """Return a profile that is left at `at_s` for a signed speed and ends hard at `until_mm`."""
    kept = []
    for piece, start in zip(profile.pieces(), profile.start_s.tolist(), strict=True):
        if start < at_s:
            kept.append(replace(piece, duration_s=min(piece.duration_s, at_s - start)))
    change = speed_mm_s - float(profile.velocity(at_s))
    kept.append(Piece(abs(change) / accel_mm_s2, float(np.sign(change)) * accel_mm_s2, Phase.ACCELERATE))
    reached = MotionProfile.from_pieces(kept)
    left_mm = until_mm - float(reached.position(reached.duration_s))
    kept.append(Piece(max(left_mm / speed_mm_s, 0.0), 0.0, Phase.STEADY))
    impact = 100.0 * accel_mm_s2
    kept.append(Piece(abs(speed_mm_s) / impact, -float(np.sign(speed_mm_s)) * impact, Phase.DECELERATE))
    return MotionProfile.from_pieces(kept)


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """What the stage does from an instant on: never changed, only replaced.

    Attributes
    ----------
    profile
        The motion that takes place, whatever was commanded.
    origin_mm
        Absolute position where it starts.
    ends_s
        When a stop has brought it to a standstill; infinite unless stopped.
    fails_s, fault
        When the drive faults and what it says; infinite and empty unless it does.
    over_s
        When nothing moves any more, at the latest with the end of the profile.
    """

    profile: MotionProfile
    origin_mm: float
    ends_s: float = math.inf
    fails_s: float = math.inf
    fault: str = ""
    over_s: float = math.inf

    @property
    def stopped(self) -> bool:
        """Whether a stop has been commanded."""
        return self.ends_s < math.inf


def standstill_track(position_mm: float, sample_s: float, ends_s: float = math.inf) -> Track:
    """Return a track that stays at an absolute position."""
    return Track(standstill_profile(sample_s), position_mm, ends_s, over_s=0.0)


class SimulatedAxis:
    """A track, and the reading of the clock at which it began; one that waits for a first sample has none yet."""

    def __init__(self, clock: Clock, sample_s: float, stop_accel_mm_s2: float) -> None:
        self._clock = clock
        self._sample_s = sample_s
        self._stop_accel_mm_s2 = stop_accel_mm_s2
        # Re-entrant, for a signal handler that stops the stage may interrupt the very thread that holds it.
        self._lock = threading.RLock()
        self._acquisition: Acquisition | None = None
        self._sampling = False
        self._told_s = 0.0
        self._fault: Trip | None = None
        self._track = standstill_track(0.0, sample_s)
        self._began_s: float | None = clock.monotonic()

    @property
    def track(self) -> Track:
        """What the stage does at present; a new object whenever that changes."""
        return self._track

    @property
    def acquisition(self) -> Acquisition | None:
        """What the sampler is at, from arming to its last sample."""
        return self._acquisition

    def look(self) -> tuple[float, bool, Trip | None]:
        """Return absolute position, whether a motion is under way, and the drive's fault if it has one."""
        with self._lock:
            return self._position(), self._moving(), self._latched_fault()

    @property
    def fault(self) -> Trip | None:
        """The drive's fault; None when it has none."""
        with self._lock:
            return self._latched_fault()

    def expect(self, acquisition: Acquisition) -> None:
        """Let the next motion begin with this acquisition's first sample."""
        with self._lock:
            if self._moving():
                raise DeviceError("the sampler cannot be armed while the stage moves: wait or stop it first.")
            self._acquisition = acquisition
            self._sampling = False

    def begin_sampling(self) -> float:
        """Take the first sample, let go of a motion that waits for it, and return the clock's reading."""
        with self._lock:
            if self._began_s is not None:
                self._stand_at(self._position())
            self._began_s = self._clock.monotonic()
            self._told_s = 0.0
            self._sampling = True
            return self._began_s

    def end_sampling(self) -> None:
        """Forget the acquisition; a motion under way goes on, one that still waits is dropped."""
        with self._lock:
            if self._began_s is None:
                self._stand_at(self._track.origin_mm)
            self._acquisition = None
            self._sampling = False

    def begin(self, track: Track) -> None:
        """Follow a track: now, or from the first sample when the sampler is armed.

        Raises
        ------
        DeviceError
            When the first sample is already past.
        """
        with self._lock:
            if self._sampling and self._told_s > 0:
                raise DeviceError("the stage was told to move after the first sample: start it before reading a block.")
            if self._acquisition is None:
                self._began_s = self._clock.monotonic()
                self._told_s = 0.0
            elif not self._sampling:
                self._began_s = None
            self._track = track

    def place(self, position_mm: float) -> None:
        """Stand still at a position."""
        with self._lock:
            self._stand_at(position_mm)

    def claim(self, track: Track, until_s: float) -> bool:
        """Hand out the samples before `until_s`; False when `track` is no longer what the stage does."""
        with self._lock:
            if self._track is not track:
                return False
            self._told_s = until_s
            return True

    def stop(self) -> None:
        """Brake from the later of now and the end of the samples handed out; nothing more when already stopped."""
        with self._lock:
            track = self._track
            if track.stopped:
                return
            if self._began_s is None:
                self._track = standstill_track(track.origin_mm, self._sample_s, ends_s=0.0)
                return
            now = self._elapsed()
            if not self._moving():
                self._track = replace(track, ends_s=now)
                return
            braked = track.profile.stopped(now, self._stop_accel_mm_s2, hold_s=self._sample_s)
            self._track = replace(track, profile=braked, ends_s=max(now, braked.duration_s), over_s=math.inf)

    def clear_fault(self) -> None:
        """Forget the drive's fault."""
        with self._lock:
            self._fault = None
            self._track = replace(self._track, fails_s=math.inf)

    def _stand_at(self, position_mm: float) -> None:
        self._latched_fault()
        self._track = standstill_track(position_mm, self._sample_s)
        self._began_s = self._clock.monotonic()
        self._told_s = 0.0

    def _elapsed(self) -> float:
        return 0.0 if self._began_s is None else max(self._clock.monotonic() - self._began_s, self._told_s)

    def _over(self) -> bool:
        # An acquisition ends up to half a sample before its profile.
        over_s = min(self._track.over_s, self._track.profile.duration_s)
        return self._elapsed() + 0.501 * self._sample_s >= over_s

    def _moving(self) -> bool:
        if self._began_s is None:
            return not self._track.stopped
        return not self._over()

    def _position(self) -> float:
        track = self._track
        time_s = track.profile.duration_s if self._over() and self._began_s is not None else self._elapsed()
        return track.origin_mm + profile_position(track.profile, time_s)

    def _latched_fault(self) -> Trip | None:
        if self._track.fails_s < math.inf and self._elapsed() >= self._track.fails_s:
            self._fault = Trip(TripCause.DRIVE_FAULT, f"the drive reports {self._track.fault}")
        return self._fault


BEARING_SPEED_MM_S = 0.05
"""Speed over which the Coulomb friction of the stage's bearing turns its sign."""

MN_PER_G_MM_S2 = 1e-3
"""Millinewtons that accelerate one gram by one mm/s²."""


@dataclass(frozen=True, slots=True)
class ForceConverter:
    """A force sensor's converter: `2^bits` codes over both signs of the range."""

    step_mN: float
    lowest_code: int
    highest_code: int

    @classmethod
    def of(cls, settings: ForceSensorSettings) -> "ForceConverter":
        """Return the converter that the settings name."""
        half = 2 ** (settings.bits - 1)
        return cls(step_mN=settings.range_mN / half, lowest_code=-half, highest_code=half - 1)

    @property
    def range_mN(self) -> tuple[float, float]:
        """Least and greatest force that can come out, as they come out: in single precision."""
        ends = np.array([self.lowest_code * self.step_mN, self.highest_code * self.step_mN], dtype=np.float32)
        return float(ends[0]), float(ends[1])

    def convert(self, force_mN: FloatArray) -> npt.NDArray[np.float32]:
        """Return the force in steps of the converter, clipped at its range; `force_mN` is used up."""
        force_mN /= self.step_mN
        np.rint(force_mN, out=force_mN)
        np.clip(force_mN, self.lowest_code, self.highest_code, out=force_mN)
        force_mN *= self.step_mN
        return force_mN.astype(np.float32)


@dataclass(frozen=True, slots=True)
class PositionEncoder:
    """An incremental encoder that counts from the stage's origin."""

    counts_per_mm: float

    @classmethod
    def of(cls, settings: EncoderSettings) -> "PositionEncoder":
        """Return the encoder that the settings name."""
        return cls(counts_per_mm=1000.0 / settings.resolution_um)

    def read(self, position_mm: float) -> float:
        """Return an absolute position as the encoder shows it."""
        return round(position_mm * self.counts_per_mm) / self.counts_per_mm

    def record(self, position_mm: FloatArray, origin_mm: float) -> FloatArray:
        """Return positions as counted since `origin_mm`; `position_mm`, relative to it, is used up.

        Double precision: at 300 mm, single precision would be off by 15 nm.
        """
        position_mm += origin_mm
        position_mm *= self.counts_per_mm
        np.rint(position_mm, out=position_mm)
        position_mm -= round(origin_mm * self.counts_per_mm)
        position_mm /= self.counts_per_mm
        return position_mm


def motor_force(settings: MotorSettings, motion: StageMotion, load_mN: FloatArray) -> FloatArray:
    """Return the force [mN] that the motor gives: inertia, bearing friction, offset and the load it pulls."""
    force = np.tanh(motion.velocity / BEARING_SPEED_MM_S)
    force *= settings.coulomb_mN
    force += settings.offset_mN
    force += settings.viscous_mN_s_mm * motion.velocity
    force += (settings.moving_mass_g * MN_PER_G_MM_S2) * motion.acceleration
    force += load_mN
    return force


LIMIT_TOLERANCE_MM = 1e-6
END_STOP_MM = 5.0
"""How far beyond the soft limits the hard end of the axis lies."""


class SimulatedStage:
    """One axis that follows profiles exactly, as long as no fault says otherwise."""

    def __init__(self, settings: StageSettings, axis: SimulatedAxis, encoder: PositionEncoder, faults: Faults) -> None:
        self._limits = stage_limits(settings)
        self._stop_accel_mm_s2 = settings.stop_accel_mm_s2
        self._axis = axis
        self._encoder = encoder
        self._faults = faults
        self._enabled = False
        self._homed = False
        self._override: TravelEnd | None = None
        self._override_used = False
        self._commands = threading.RLock()

    @property
    def limits(self) -> StageLimits:
        """Soft limits of travel, and the greatest speed and acceleration."""
        return self._limits

    def enable(self) -> None:
        """Switch the drive on.

        Raises
        ------
        DeviceError
            When the drive has a fault; `disable` clears it.
        """
        with self._commands:
            self._refuse_fault()
            self._enabled = True

    def home(self) -> None:
        """Go to the origin, or to the soft limit nearest to it, at once.

        Raises
        ------
        DeviceError
            When the drive is off, moving or has a fault.
        """
        with self._commands:
            self._refuse_unready()
            self._axis.place(min(max(0.0, self._limits.lowest_mm), self._limits.highest_mm))
            self._homed = True

    def move(self, profile: MotionProfile) -> None:
        """Begin to follow a profile: now, or with the first sample when the sampler is armed.

        Raises
        ------
        DeviceError
            When the drive is off, not homed, moving or has a fault, when the first sample is already past, or when
            the profile leaves the stage's limits or does not end at a standstill.
        """
        with self._commands:
            self._refuse_unready()
            if not self._homed:
                raise DeviceError("the stage does not know where it is: home it before it moves.")
            if profile.duration_s <= 0:
                return
            origin_mm, _, _ = self._axis.look()
            limits = limits_with_override(self._limits, self._overridden(moving=False), origin_mm)
            require_within_limits(profile, origin_mm, limits, LIMIT_TOLERANCE_MM)
            self._axis.begin(self._track(profile, origin_mm))
            self._override_used = self._override is not None

    @property
    def start_uncertainty_s(self) -> float:
        """0, because a motion begins with the first sample."""
        return 0.0

    def stop(self) -> None:
        """Brake to a standstill now; an acquisition under way ends there. Allowed at any time, from any thread."""
        self._axis.stop()

    def override_limit(self, side: TravelEnd) -> None:
        """Free one motion from the limit switch and the soft limit of this side."""
        with self._commands:
            self._override, self._override_used = side, False

    def disable(self) -> None:
        """Stop, switch the drive off and clear its fault."""
        self._axis.stop()
        with self._commands:
            self._axis.clear_fault()
            self._enabled = False
            self._override = None

    @property
    def fault(self) -> Trip | None:
        """What the drive reports; None when nothing."""
        if self._faults.limit_switch is None:
            return self._axis.fault
        position_mm, moving, fault = self._axis.look()
        return fault or self._pressed_switch(position_mm, moving)

    def state(self) -> StageState:
        """Where the stage is, to the encoder's resolution, and how it is."""
        position_mm, moving, fault = self._axis.look()
        fault = fault or self._pressed_switch(position_mm, moving)
        return StageState(self._encoder.read(position_mm), self._enabled, self._homed, moving, fault)

    def _pressed_switch(self, position_mm: float, moving: bool) -> Trip | None:
        switch = self._faults.limit_switch
        if switch is None or not switch.pressed(position_mm) or switch.side is self._overridden(moving):
            return None
        cause = TripCause.LIMIT_SWITCH_LOW if switch.side is TravelEnd.LOW else TripCause.LIMIT_SWITCH_HIGH
        return Trip(cause, f"the limit switch at the {switch.side} end is pressed")

    def _overridden(self, moving: bool) -> TravelEnd | None:
        return self._override if moving or not self._override_used else None

    def _refuse_fault(self) -> None:
        if fault := self.fault:
            raise DeviceError(f"{fault.message}: see to it, then switch the drive off and on.")

    def _refuse_unready(self) -> None:
        self._refuse_fault()
        if not self._enabled:
            raise DeviceError("the drive is off: enable the stage first.")
        if self._axis.look()[1]:
            raise DeviceError("the stage is still moving: wait until it stands or stop it first.")

    def _track(self, profile: MotionProfile, origin_mm: float) -> Track:
        acquisition = self._axis.acquisition
        faults = NO_FAULTS if acquisition is None else self._faults.during(acquisition)
        if faults.runaway is not None:
            away = faults.runaway
            end = self._limits.highest_mm + END_STOP_MM if away.speed_mm_s > 0 else self._limits.lowest_mm - END_STOP_MM
            accel = self._limits.acceleration_mm_s2
            profile = runaway_profile(profile, away.at_s, away.speed_mm_s, end - origin_mm, accel)
        if faults.drive_fault is None:
            return Track(profile, origin_mm)
        failing = faults.drive_fault
        braked = profile.stopped(failing.at_s, self._stop_accel_mm_s2, hold_s=profile.duration_s)
        braking_s = abs(float(profile.velocity(failing.at_s))) / self._stop_accel_mm_s2
        over_s = failing.at_s + braking_s
        return Track(braked, origin_mm, fails_s=failing.at_s, fault=failing.message, over_s=over_s)
