"""The simulated stage's mechanics: the one owner of where it is, shared by stage and sampler.

Every method may be called from any thread; none waits for anything but the lock, which is never held for long.
"""

import math
import threading
from dataclasses import dataclass, replace

from dragrig.config.errors import DeviceError
from dragrig.rig.devices import Acquisition, Clock
from dragrig.rig.profile import MotionProfile
from dragrig.rig.trips import Cause, Trip
from dragrig.sim_backend.devices.kinematics import position_at, standstill


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


def standing(position_mm: float, sample_s: float, ends_s: float = math.inf) -> Track:
    """Return a track that stays at an absolute position."""
    return Track(standstill(sample_s), position_mm, ends_s, over_s=0.0)


class Axis:
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
        self._track = standing(0.0, sample_s)
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
                self._track = standing(track.origin_mm, self._sample_s, ends_s=0.0)
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
        self._track = standing(position_mm, self._sample_s)
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
        return track.origin_mm + position_at(track.profile, time_s)

    def _latched_fault(self) -> Trip | None:
        if self._track.fails_s < math.inf and self._elapsed() >= self._track.fails_s:
            self._fault = Trip(Cause.DRIVE_FAULT, f"the drive reports {self._track.fault}")
        return self._fault
