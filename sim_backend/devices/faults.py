"""Faults of a simulated rig, for tests and demonstrations: no user setting can cause one.

All times count from the acquisition's first sample.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Acquisition, TravelEnd
from dragrig.rig.profile import TIME_TOLERANCE_S


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
    """A force on the sensor beside the gut's."""

    at_s: float
    force_mN: float
    duration_s: float = 0.1


@dataclass(frozen=True, slots=True)
class LimitSwitch:
    """A limit switch that is pressed from an absolute position on, whatever acquisition is under way."""

    side: TravelEnd
    at_mm: float

    def pressed(self, position_mm: float) -> bool:
        """Whether a stage at this absolute position presses it."""
        return position_mm <= self.at_mm if self.side is TravelEnd.LOW else position_mm >= self.at_mm


def every_acquisition(acquisition: Acquisition) -> bool:
    """Select all acquisitions, tares and return strokes included."""
    del acquisition
    return True


@dataclass(frozen=True, slots=True)
class Faults:
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

    def during(self, acquisition: Acquisition) -> "Faults":
        """Return the faults of one acquisition."""
        return self if self.affects(acquisition) else NO_FAULTS

    def encoder_time(self, time_s: FloatArray) -> FloatArray:
        """Return the times whose positions the encoder reports."""
        return time_s if self.stuck_encoder is None else np.minimum(time_s, self.stuck_encoder.at_s)

    def position_error(self, time_s: FloatArray) -> FloatArray | float:
        """Return the deviation of the stage from its profile [mm]."""
        if self.follow_error is None:
            return 0.0
        share = (time_s - self.follow_error.at_s) / self.follow_error.ramp_s
        return np.asarray(self.follow_error.error_mm * np.clip(share, 0.0, 1.0))

    def extra_force(self, time_s: FloatArray) -> FloatArray | float:
        """Return the additional force on the sensor [mN]."""
        if self.force_spike is None:
            return 0.0
        since = time_s - self.force_spike.at_s + TIME_TOLERANCE_S
        return np.where((since >= 0) & (since < self.force_spike.duration_s), self.force_spike.force_mN, 0.0)


NO_FAULTS = Faults()
