"""Faults of a simulated rig. All times count from the acquisition's first sample."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dragrig.rig.devices import Acquisition, StageLimits, TravelEnd
from dragrig.rig.profile import TIME_TOLERANCE_S, FloatArray, MotionProfile, Phase, Piece
from dragrig.sim_backend.devices.simulated_stage import Disturbances, Track

END_STOP_MM = 5.0
"""Distance from each soft limit to the hard end of the axis."""


@dataclass(frozen=True, slots=True)
class FollowError:
    """The stage falls behind its command: the position is off by a distance that builds up over `ramp_s`."""

    at_s: float
    error_mm: float
    ramp_s: float = 0.1


@dataclass(frozen=True, slots=True)
class StuckEncoder:
    """The encoder repeats one count."""

    at_s: float


@dataclass(frozen=True, slots=True)
class Runaway:
    """The stage leaves its profile and runs at a signed speed until it is stopped or hits its end."""

    at_s: float
    speed_mm_s: float


@dataclass(frozen=True, slots=True)
class StaleData:
    """The sampler delivers nothing for a while, or for good; what it sampled meanwhile comes late."""

    at_s: float
    duration_s: float = math.inf


@dataclass(frozen=True, slots=True)
class LostSamples:
    """Samples that never arrive."""

    at_s: float
    samples: int


@dataclass(frozen=True, slots=True)
class DriveFault:
    """The drive reports a fault and brakes."""

    at_s: float
    message: str = "simulated overcurrent"


@dataclass(frozen=True, slots=True)
class ForceSpike:
    """An additional force on the sensor."""

    at_s: float
    force_mN: float
    duration_s: float = 0.1


@dataclass(frozen=True, slots=True)
class LimitSwitch:
    """A limit switch that is pressed from an absolute position on, whatever acquisition is under way."""

    side: TravelEnd
    at_mm: float


def every_acquisition(acquisition: Acquisition) -> bool:
    del acquisition
    return True


@dataclass(frozen=True)
class Faults(Disturbances):
    """Faults injected into each acquisition that `affects` selects."""

    follow_error: FollowError | None = None
    stuck_encoder: StuckEncoder | None = None
    runaway: Runaway | None = None
    stale_data: StaleData | None = None
    lost_samples: LostSamples | None = None
    drive_fault: DriveFault | None = None
    force_spike: ForceSpike | None = None
    limit_switch: LimitSwitch | None = None
    affects: Callable[[Acquisition], bool] = every_acquisition

    def during(self, acquisition: Acquisition) -> Disturbances:
        return self if self.affects(acquisition) else Disturbances()

    def pressed_switch(self, position_mm: float) -> TravelEnd | None:
        switch = self.limit_switch
        if switch is None:
            return None
        low = switch.side is TravelEnd.LOW
        return switch.side if (position_mm <= switch.at_mm if low else position_mm >= switch.at_mm) else None

    def track(self, track: Track, limits: StageLimits, stop_accel_mm_s2: float) -> Track:
        profile = track.profile
        if self.runaway is not None:
            forward = self.runaway.speed_mm_s > 0
            end = limits.highest_mm + END_STOP_MM if forward else limits.lowest_mm - END_STOP_MM
            profile = runaway_profile(profile, self.runaway, end - track.origin_mm, limits.acceleration_mm_s2)
        fault = self.drive_fault
        if fault is None:
            return replace(track, profile=profile)
        braked = profile.stopped(fault.at_s, stop_accel_mm_s2, hold_s=profile.duration_s)
        braking_s = abs(float(profile.velocity(fault.at_s))) / stop_accel_mm_s2
        rest_s = fault.at_s + braking_s
        return Track(braked, track.origin_mm, fault_s=fault.at_s, fault=fault.message, rest_s=rest_s)

    @property
    def lost(self) -> tuple[float, int] | None:
        return None if self.lost_samples is None else (self.lost_samples.at_s, self.lost_samples.samples)

    @property
    def silence(self) -> tuple[float, float] | None:
        return None if self.stale_data is None else (self.stale_data.at_s, self.stale_data.duration_s)

    def encoder_time(self, time_s: FloatArray) -> FloatArray:
        return time_s if self.stuck_encoder is None else np.minimum(time_s, self.stuck_encoder.at_s)

    def position_error(self, time_s: FloatArray) -> FloatArray | float:
        if self.follow_error is None:
            return 0.0
        share = (time_s - self.follow_error.at_s) / self.follow_error.ramp_s
        return np.asarray(self.follow_error.error_mm * np.clip(share, 0.0, 1.0))

    def extra_force(self, time_s: FloatArray) -> FloatArray | float:
        if self.force_spike is None:
            return 0.0
        since = time_s - self.force_spike.at_s + TIME_TOLERANCE_S
        return np.where((since >= 0) & (since < self.force_spike.duration_s), self.force_spike.force_mN, 0.0)


def runaway_profile(profile: MotionProfile, runaway: Runaway, until_mm: float, accel_mm_s2: float) -> MotionProfile:
    """Return a profile that is left for a signed speed and hits a hard stop at `until_mm`."""
    pieces = []
    for piece, start in zip(profile.pieces(), profile.start_s.tolist(), strict=True):
        if start < runaway.at_s:
            pieces.append(replace(piece, duration_s=min(piece.duration_s, runaway.at_s - start)))
    change = runaway.speed_mm_s - float(profile.velocity(runaway.at_s))
    pieces.append(Piece(abs(change) / accel_mm_s2, float(np.sign(change)) * accel_mm_s2, Phase.ACCELERATE))
    so_far = MotionProfile.from_pieces(pieces)
    left_mm = until_mm - float(so_far.position(so_far.duration_s))
    pieces.append(Piece(max(left_mm / runaway.speed_mm_s, 0.0), 0.0, Phase.STEADY))
    impact = 100.0 * accel_mm_s2
    hard_stop = -float(np.sign(runaway.speed_mm_s)) * impact
    pieces.append(Piece(abs(runaway.speed_mm_s) / impact, hard_stop, Phase.DECELERATE))
    return MotionProfile.from_pieces(pieces)
