"""The simulated stage: fast evaluation of motion profiles, the axis that owns the position, limits, states and faults.

The axis is shared by stage and sampler; every method may be called from any thread, and none waits for anything but the
lock, which is never held for long.
"""

import math
import threading
from bisect import bisect_right
from dataclasses import dataclass, replace
from threading import Event as Signal

import numpy as np

from dragrig.config import DeviceError, EncoderSettings, StageSettings
from dragrig.rig import (
    Acquisition,
    Clock,
    FloatArray,
    MotionProfile,
    Phase,
    StageLimits,
    StageState,
    TravelEnd,
    Trip,
    TripCause,
    limits_with_override,
    require_within_limits,
    stage_limits,
    stationary_piece,
)


@dataclass(frozen=True, slots=True, eq=False)
class StageMotion:
    """Position [mm], velocity [mm/s] and acceleration [mm/s²], arrays of shape `(n,)`."""

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


def evaluate_profile(profile: MotionProfile, time_s: FloatArray) -> StageMotion:
    """Evaluate a profile at increasing times, piece by piece: several times faster than the profile's own methods."""
    position, velocity, acceleration = (np.empty_like(time_s) for _ in range(3))
    starts = np.append(profile.start_s, profile.duration_s)
    edges = np.append(np.searchsorted(time_s, starts), len(time_s))
    edges[0] = 0
    end_mm = float(profile.position(profile.duration_s))
    positions = np.append(profile.position_mm, end_mm).tolist()
    velocities = np.append(profile.velocity_mm_s, 0.0).tolist()
    accelerations = np.append(profile.acceleration_mm_s2, 0.0).tolist()
    for piece in np.flatnonzero(np.diff(edges)).tolist():
        inside = slice(edges[piece], edges[piece + 1])
        rate = accelerations[piece]
        acceleration[inside] = rate
        if rate == 0.0:
            velocity[inside] = velocities[piece]
            position[inside] = positions[piece] + velocities[piece] * (time_s[inside] - starts[piece])
            continue
        elapsed = time_s[inside] - starts[piece]
        velocity[inside] = velocities[piece] + rate * elapsed
        position[inside] = positions[piece] + (velocities[piece] + 0.5 * rate * elapsed) * elapsed
    return StageMotion(position, velocity, acceleration)


def profile_position(profile: MotionProfile, time_s: float) -> float:
    """Return the position [mm] at one time, fast enough to be called between any two blocks."""
    time_s = min(max(time_s, 0.0), profile.duration_s)
    piece = max(bisect_right(profile.start_s, time_s) - 1, 0)
    elapsed = time_s - profile.start_s.item(piece)
    speed = profile.velocity_mm_s.item(piece)
    rate = profile.acceleration_mm_s2.item(piece)
    return profile.position_mm.item(piece) + (speed + 0.5 * rate * elapsed) * elapsed


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The stage's motion from an instant on: never changed, only replaced."""

    profile: MotionProfile
    """The actual motion, which a fault may make differ from the command."""
    origin_mm: float
    """Absolute position where it starts."""
    stopped_s: float = math.inf
    """When a stop has brought it to a standstill; infinite without one."""
    fault_s: float = math.inf
    fault: str = ""
    """`fault_s`, `fault`: when the drive faults, and its message; infinite and empty without a fault."""
    rest_s: float = math.inf
    """When the stage is at rest, at the latest at the end of the profile."""

    @property
    def stopped(self) -> bool:
        """Whether a stop has been commanded."""
        return self.stopped_s < math.inf


def standstill_track(position_mm: float, sample_s: float, stopped_s: float = math.inf) -> Track:
    """Return a track that stays at an absolute position."""
    rest = MotionProfile.from_pieces([stationary_piece(max(sample_s, 1e-3), Phase.REST)])
    return Track(rest, position_mm, stopped_s, rest_s=0.0)


class Disturbances:
    """The disturbances of stage and sampler: none. Tests derive the faults of a rig from it; no setting can cause one.

    Times count from the first sample of an acquisition.
    """

    lost: tuple[float, int] | None = None
    """Time of the first lost sample, and number of lost samples."""
    silence: tuple[float, float] | None = None
    """Begin and duration [s] of a silence of the sampler, after which its samples come late."""

    def during(self, acquisition: Acquisition) -> "Disturbances":
        """Return the disturbances of one acquisition."""
        del acquisition
        return self

    def track(self, track: Track, limits: StageLimits, stop_accel_mm_s2: float) -> Track:
        """Return the actual track of a commanded one."""
        del limits, stop_accel_mm_s2
        return track

    def pressed_switch(self, position_mm: float) -> TravelEnd | None:
        """Return the limit switch that is pressed at an absolute position, if any."""
        del position_mm
        return None

    def encoder_time(self, time_s: FloatArray) -> FloatArray:
        """Return the times whose positions the encoder reports."""
        return time_s

    def position_error(self, time_s: FloatArray) -> FloatArray | float:
        """Return the deviation of the stage from its profile [mm]."""
        del time_s
        return 0.0

    def extra_force(self, time_s: FloatArray) -> FloatArray | float:
        """Return the additional force on the sensor [mN]."""
        del time_s
        return 0.0


UNDISTURBED = Disturbances()


class SimulatedAxis:
    """The stage's track and the clock time at which it began; None while it waits for the first sample."""

    def __init__(self, clock: Clock, sample_s: float, stop_accel_mm_s2: float) -> None:
        self._clock = clock
        self._sample_s = sample_s
        self._stop_accel_mm_s2 = stop_accel_mm_s2
        # Re-entrant: a signal handler that stops the stage may interrupt the thread that holds the lock.
        self._lock = threading.RLock()
        self._acquisition: Acquisition | None = None
        self._sampling = False
        self._delivered_s = 0.0
        self._fault: Trip | None = None
        self._track = standstill_track(0.0, sample_s)
        self._start_s: float | None = clock.monotonic()

    @property
    def track(self) -> Track:
        """The present motion; a new object whenever it changes."""
        return self._track

    @property
    def acquisition(self) -> Acquisition | None:
        """The acquisition under way, from arming to its last sample."""
        return self._acquisition

    def state(self) -> tuple[float, bool, Trip | None]:
        """Return the absolute position, whether the stage moves, and the drive's fault if any."""
        with self._lock:
            return self._position(), self._moving(), self._latched_fault()

    def arm(self, acquisition: Acquisition) -> None:
        """Let the next motion begin with this acquisition's first sample."""
        with self._lock:
            if self._moving():
                raise DeviceError(
                    "the sampler cannot be armed while the stage moves: wait until it stands, or stop it first."
                )
            self._acquisition = acquisition
            self._sampling = False

    def begin_sampling(self) -> float:
        """Take the first sample, start a motion that waits for it, and return the clock time."""
        with self._lock:
            if self._start_s is not None:
                self._rest_at(self._position())
            self._start_s = self._clock.monotonic()
            self._delivered_s = 0.0
            self._sampling = True
            return self._start_s

    def end_sampling(self) -> None:
        """Forget the acquisition; a motion under way goes on, a waiting one is dropped."""
        with self._lock:
            if self._start_s is None:
                self._rest_at(self._track.origin_mm)
            self._acquisition = None
            self._sampling = False

    def begin(self, track: Track) -> None:
        """Follow a track: now, or from the first sample when the sampler is armed.

        Raises `DeviceError` when a sample has been delivered already.
        """
        with self._lock:
            if self._sampling and self._delivered_s > 0:
                raise DeviceError("the stage was commanded to move after the first block: start it before reading one.")
            if self._acquisition is None:
                self._start_s = self._clock.monotonic()
                self._delivered_s = 0.0
            elif not self._sampling:
                self._start_s = None
            self._track = track

    def place(self, position_mm: float) -> None:
        """Come to rest at a position at once."""
        with self._lock:
            self._rest_at(position_mm)

    def deliver(self, track: Track, until_s: float) -> bool:
        """Mark the samples before `until_s` as delivered; False when `track` is no longer the present motion."""
        with self._lock:
            if self._track is not track:
                return False
            self._delivered_s = until_s
            return True

    def stop(self) -> None:
        """Brake from the later of now and the last delivered sample; without effect when stopped already."""
        with self._lock:
            track = self._track
            if track.stopped:
                return
            if self._start_s is None:
                self._track = standstill_track(track.origin_mm, self._sample_s, stopped_s=0.0)
                return
            now = self._elapsed()
            if not self._moving():
                self._track = replace(track, stopped_s=now)
                return
            braked = track.profile.stopped(now, self._stop_accel_mm_s2, hold_s=self._sample_s)
            self._track = replace(track, profile=braked, stopped_s=max(now, braked.duration_s), rest_s=math.inf)

    def clear_fault(self) -> None:
        """Clear the drive's fault."""
        with self._lock:
            self._fault = None
            self._track = replace(self._track, fault_s=math.inf)

    def _rest_at(self, position_mm: float) -> None:
        self._latched_fault()
        self._track = standstill_track(position_mm, self._sample_s)
        self._start_s = self._clock.monotonic()
        self._delivered_s = 0.0

    def _elapsed(self) -> float:
        return 0.0 if self._start_s is None else max(self._clock.monotonic() - self._start_s, self._delivered_s)

    def _at_rest(self) -> bool:
        # An acquisition ends up to half a sample before its profile.
        rest_s = min(self._track.rest_s, self._track.profile.duration_s)
        return self._elapsed() + 0.501 * self._sample_s >= rest_s

    def _moving(self) -> bool:
        if self._start_s is None:
            return not self._track.stopped
        return not self._at_rest()

    def _position(self) -> float:
        track = self._track
        time_s = track.profile.duration_s if self._at_rest() and self._start_s is not None else self._elapsed()
        return track.origin_mm + profile_position(track.profile, time_s)

    def _latched_fault(self) -> Trip | None:
        if self._track.fault_s < math.inf and self._elapsed() >= self._track.fault_s:
            self._fault = Trip(TripCause.DRIVE_FAULT, f"the drive reports {self._track.fault}")
        return self._fault


@dataclass(frozen=True, slots=True)
class PositionEncoder:
    """An incremental encoder that counts from the stage's origin."""

    counts_per_mm: float

    @classmethod
    def of(cls, settings: EncoderSettings) -> "PositionEncoder":
        """Return the encoder of the settings."""
        return cls(counts_per_mm=1000.0 / settings.resolution_um)

    def read(self, position_mm: float) -> float:
        """Return an absolute position as the encoder shows it."""
        return round(position_mm * self.counts_per_mm) / self.counts_per_mm

    def record(self, position_mm: FloatArray, origin_mm: float) -> FloatArray:
        """Return positions as counted from `origin_mm`; `position_mm`, relative to it, is overwritten.

        Double precision: at 300 mm, single precision would be off by 15 nm.
        """
        position_mm += origin_mm
        position_mm *= self.counts_per_mm
        np.rint(position_mm, out=position_mm)
        position_mm -= round(origin_mm * self.counts_per_mm)
        position_mm /= self.counts_per_mm
        return position_mm


LIMIT_TOLERANCE_MM = 1e-6


class SimulatedStage:
    """One axis that follows profiles exactly, except for disturbances."""

    start_uncertainty_s = 0.0
    """A motion begins with the first sample."""

    def __init__(
        self, settings: StageSettings, axis: SimulatedAxis, encoder: PositionEncoder, disturbances: Disturbances
    ) -> None:
        self.limits = stage_limits(settings)
        """Soft limits of travel, and the greatest speed and acceleration."""
        self._stop_accel_mm_s2 = settings.stop_accel_mm_s2
        self._axis = axis
        self._encoder = encoder
        self._disturbances = disturbances
        self._enabled = False
        self.homed = False
        """Whether the origin is known."""
        self._override: TravelEnd | None = None
        self._override_used = False
        self._commands = threading.RLock()

    def enable(self) -> None:
        """Switch the drive on.

        Raises `DeviceError` when the drive has a fault; `disable` clears it.
        """
        with self._commands:
            self._refuse_fault()
            self._enabled = True

    def home(self) -> None:
        """Go to the origin, or to the soft limit nearest to it, at once.

        Raises `DeviceError` when the drive is off, moving or has a fault.
        """
        with self._commands:
            self._refuse_unready()
            self._axis.place(min(max(0.0, self.limits.lowest_mm), self.limits.highest_mm))
            self.homed = True

    def move(self, profile: MotionProfile) -> None:
        """Begin to follow a profile: now, or with the first sample when the sampler is armed.

        Raises `DeviceError` when the drive is off, not homed, moving or has a fault, when the first sample is already
        past, or when the profile leaves the stage's limits or does not end at a standstill.
        """
        with self._commands:
            self._refuse_unready()
            if not self.homed:
                raise DeviceError("the stage is not homed: home it before it moves.")
            if profile.duration_s <= 0:
                return
            origin_mm, _, _ = self._axis.state()
            limits = limits_with_override(self.limits, self._overridden(moving=False), origin_mm)
            require_within_limits(profile, origin_mm, limits, LIMIT_TOLERANCE_MM)
            track, acquisition = Track(profile, origin_mm), self._axis.acquisition
            if acquisition is not None:
                disturbances = self._disturbances.during(acquisition)
                track = disturbances.track(track, self.limits, self._stop_accel_mm_s2)
            self._axis.begin(track)
            self._override_used = self._override is not None

    def await_end(self, cancel: Signal) -> None:
        """Return at once: a motion is over with its last sample."""

    def stop(self) -> None:
        """Brake to a standstill now; an acquisition under way ends there. Allowed at any time, from any thread."""
        self._axis.stop()

    def override_limit(self, side: TravelEnd) -> None:
        """Exempt one motion from the limit switch and the soft limit at this end."""
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
        """Fault that the drive or a limit switch reports, if any."""
        return self.state().fault

    def state(self) -> StageState:
        """Return position to the encoder's resolution, and the drive's state."""
        position_mm, moving, fault = self._axis.state()
        fault = fault or self._pressed_switch(position_mm, moving)
        return StageState(self._encoder.read(position_mm), self._enabled, self.homed, moving, fault)

    def _pressed_switch(self, position_mm: float, moving: bool) -> Trip | None:
        end = self._disturbances.pressed_switch(position_mm)
        if end is None or end is self._overridden(moving):
            return None
        cause = TripCause.LIMIT_SWITCH_LOW if end is TravelEnd.LOW else TripCause.LIMIT_SWITCH_HIGH
        return Trip(cause, f"the limit switch at the {end} end is pressed")

    def _overridden(self, moving: bool) -> TravelEnd | None:
        return self._override if moving or not self._override_used else None

    def _refuse_fault(self) -> None:
        if fault := self.fault:
            raise DeviceError(f"{fault.message}: mend its cause, then switch the drive off and on.")

    def _refuse_unready(self) -> None:
        self._refuse_fault()
        if not self._enabled:
            raise DeviceError("the drive is off: enable the stage first.")
        if self._axis.state()[1]:
            raise DeviceError("the stage is still moving: wait until it stands or stop it first.")
