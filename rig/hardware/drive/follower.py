"""From a commanded motion and a measured position to the speeds that a drive is told: pure reckoning, no device.

The command runs in samples of the velocity's output: sample `k` is put out at `k` over the rate.
"""

from dataclasses import dataclass, replace

import numpy as np

from dragrig.config.hardware import VelocityOutputSettings
from dragrig.config.rig import GuardSettings, StageSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import MotionProfile, Phase, still
from dragrig.rig.trips import Cause, Trip

_STANDS = MotionProfile.from_pieces([still(1.0, Phase.HOLD)])


@dataclass(frozen=True, slots=True)
class Command:
    """What the stage is to do.

    Attributes
    ----------
    profile, origin_mm
        The motion and the absolute position that it starts from; beyond its end, to stay there.
    first
        Sample of the output at which the profile is at 0; may have a fraction.
    closed
        Whether the measured position corrects the speed.
    """

    profile: MotionProfile
    origin_mm: float
    first: float
    closed: bool = True

    @property
    def end_mm(self) -> float:
        """The absolute position that it comes to."""
        return self.origin_mm + float(self.profile.position(self.profile.duration_s))

    @classmethod
    def hold(cls, position_mm: float) -> "Command":
        """Return the command to stay at a position."""
        return cls(_STANDS, position_mm, 0.0)

    def beginning(self, first: float) -> "Command":
        """Return the same command from another sample on."""
        return replace(self, first=first)

    @classmethod
    def rest(cls) -> "Command":
        """Return the command to have no speed, wherever that is."""
        return cls(_STANDS, 0.0, 0.0, closed=False)


class Follower:
    """Speeds for a drive, sample after sample. Belongs to one thread at a time.

    Each speed is the profile's, taken `lag_s` early, plus `gain_per_s` times the distance between command and
    position; neither it nor its change exceeds what the stage may do. A stop takes it to 0 at the stop's deceleration.
    """

    def __init__(self, velocity: VelocityOutputSettings, stage: StageSettings) -> None:
        self._velocity = velocity
        self._stage = stage
        self._command = Command.rest()
        self._braking = False
        self.told = 0
        """Samples for which speeds were given."""
        self._speed_mm_s = 0.0

    @property
    def command(self) -> Command:
        """What the stage is to do at present."""
        return self._command

    @property
    def braking(self) -> bool:
        """Whether it comes to a standstill, or has, since it was told to."""
        return self._braking

    @property
    def stands(self) -> bool:
        """Whether the latest speed is 0."""
        return self._speed_mm_s == 0.0

    def begin(self) -> None:
        """Count samples from 0 again, at speed 0."""
        self.told, self._speed_mm_s, self._braking = 0, 0.0, False

    def follow(self, command: Command) -> None:
        """Do something else from the next sample on."""
        self._command, self._braking = command, False

    def brake(self) -> None:
        """Come to a standstill from the next sample on, whatever the position says, and have no speed then."""
        self._command, self._braking = Command.rest(), True

    def error_mm(self, sample: float, position_mm: float) -> float:
        """Return how far the stage is behind its command while an output's sample is put out."""
        if not self._command.closed:
            return 0.0
        at_s = (sample - self._command.first) / self._velocity.rate_hz
        return float(self._command.origin_mm + self._command.profile.position(at_s) - position_mm)

    def off_command(self, sample: float, position_mm: float, error_mm: float, guard: GuardSettings) -> Trip | None:
        """Return the trip for a stage that is further off its command than the guard allows; None when it is not."""
        at_s = (sample - self._command.first) / self._velocity.rate_hz
        speed_mm_s = abs(float(self._command.profile.velocity(at_s)))
        most_mm = guard.following_error_mm + guard.following_error_per_speed_s * speed_mm_s
        if abs(error_mm) <= most_mm:
            return None
        return Trip(
            Cause.FOLLOWING_ERROR,
            f"the stage is {abs(error_mm):.2f} mm off its command at {position_mm:.2f} mm, where {most_mm:.2f} mm are "
            "allowed (guard.following_error_mm): something holds it, the encoder does not count, or "
            "hardware.drive.velocity does not fit the drive",
        )

    def is_over(self, sample: float) -> bool:
        """Whether the command's motion has ended at a sample."""
        if self._braking:
            return self.stands
        at_s = (sample - self._command.first) / self._velocity.rate_hz
        return at_s >= self._command.profile.motion_ends_s

    def speeds(self, samples: int, error_mm: float) -> FloatArray:
        """Return the next speeds [mm/s], shape `(samples,)`."""
        if self._braking:
            wanted = np.zeros(samples)
            most = self._stage.stop_accel_mm_s2
        else:
            middles_s = (self.told + np.arange(samples) + 0.5 - self._command.first) / self._velocity.rate_hz
            wanted = self._command.profile.velocity(middles_s + self._velocity.lag_s)
            wanted = wanted + self._velocity.gain_per_s * error_mm
            most = self._stage.max_accel_mm_s2
        self.told += samples
        return self._limited(wanted, most / self._velocity.rate_hz)

    def _limited(self, wanted: FloatArray, step: float) -> FloatArray:
        fastest = self._stage.max_speed_mm_s
        speed, speeds = self._speed_mm_s, np.empty_like(wanted)
        for place, target in enumerate(np.clip(wanted, -fastest, fastest).tolist()):
            speed += min(max(target - speed, -step), step)
            speeds[place] = speed
        self._speed_mm_s = speed
        return speeds
