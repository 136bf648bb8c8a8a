"""Device interfaces that real and simulated rigs implement: stage, sampler, clock, and the backend that holds them.

A block is immutable and passes guard, recorder and viewers in that order. Positions of the stage are absolute (after
homing); positions inside a block are relative to where the run started. The refusals of every stage before it moves
(travel, speed, acceleration, an end in motion) are checked here, with run-up and run-down included.
"""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from enum import StrEnum
from math import isfinite, nan
from threading import Event as Signal
from typing import Protocol, runtime_checkable

import numpy as np

from dragrig.config import (
    Calibration,
    Capsule,
    DeviceError,
    Fixture,
    FrictionModelSettings,
    RigCheck,
    RigSettings,
    Specimen,
    StageSettings,
    reason_of,
)
from dragrig.rig.profile import AnyFloatArray, MotionExtremes, MotionProfile
from dragrig.rig.runfile import RecordedChannel

__all__ = ["RigCheck"]  # stored in a record of the lab, for those who know backends alone

MAX_BLOCK_S = 0.05
"""Longest block, so that the guard never sees older data than this."""
STANDSTILL_SPEED_MM_S = 1e-6
"""Rounding of a profile's end speed."""


class TripCause(StrEnum):
    """The limits that trip the guard."""

    START_UP = "start-up"
    POSITION = "position"
    SPEED = "speed"
    FORCE = "force"
    FOLLOWING_ERROR = "following error"
    STALE_DATA = "stale data"
    NOT_A_NUMBER = "not a number"
    DRIVE_FAULT = "drive fault"
    CARD_FAULT = "card fault"
    EMERGENCY_STOP = "emergency stop"
    LIMIT_SWITCH_LOW = "lower limit switch"
    LIMIT_SWITCH_HIGH = "upper limit switch"
    SENSOR_OVERLOAD = "sensor overload"
    SENSOR_OPEN = "sensor open circuit"
    SENSOR_DEAD = "sensor dead"
    ENCODER_SILENT = "encoder silent"
    NO_MOTION = "no motion"
    ENCODER_JUMP = "encoder jump"
    ENCODER_ERROR = "encoder error"
    OVERRUN = "overrun"
    WATCHDOG = "watchdog"


@dataclass(frozen=True, slots=True)
class Trip:
    """A condition that forbids motion: its kind, and a message without a full stop."""

    cause: TripCause
    message: str


@dataclass(frozen=True, slots=True)
class RawReading:
    """Statistics of unscaled samples."""

    force_V: float
    force_V_sd: float
    """`force_V`, `force_V_sd`: mean and standard deviation of the force input [V]."""
    samples: int
    """Number of samples."""
    counts_begin: int
    counts_end: int
    """`counts_begin`, `counts_end`: the encoder's count at the first and the last sample, rising where the stage moves
    up.
    """
    counts_span: int = 0
    """From the encoder's lowest to its highest count."""
    force_mN: float = nan
    """Mean force by the calibration in force; NaN where the sampler does not say."""
    force_noise_V: float = nan
    """Noise of the force input from millisecond to millisecond [V]; NaN where the sampler does not say."""
    fault: Trip | None = None
    """What the force input showed of the sensor: overloaded, unplugged or dead."""

    @classmethod
    def of(cls, force_V: AnyFloatArray, counts: AnyFloatArray, force_mN: float = nan) -> "RawReading":
        """Summarise volts and counts, both of shape `(n,)`."""
        return cls(
            force_V=float(np.mean(force_V, dtype=np.float64)),
            force_V_sd=float(np.std(force_V, dtype=np.float64)),
            samples=len(force_V),
            counts_begin=round(float(counts[0])),
            counts_end=round(float(counts[-1])),
            counts_span=round(float(np.ptp(counts))),
            force_mN=force_mN,
        )


class TravelEnd(StrEnum):
    """An end of the stage's travel."""

    LOW = "low"
    HIGH = "high"


class Contact(StrEnum):
    """How the capsule touches the gut during a run."""

    SLIDING = "sliding"
    STICKING = "sticking"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Acquisition:
    """One motion with synchronous sampling, with the facts that a simulated rig needs of it."""

    run_id: str
    order: int
    """`run_id`, `order`: identity of the run; a simulated rig draws its noise from the session's seed and `order`."""
    kind: str
    profile: MotionProfile
    """The commanded motion, from standstill, relative to the stage's position when armed."""
    capsule: Capsule
    specimen: Specimen
    fixture: Fixture
    contact: Contact
    insertion_dwell_s: float
    """Age of the contact at the first sample."""
    shear_strain: float = 0.0
    """With `Contact.STICKING`: the strain whose wall parameters apply."""
    sheared_from: float = 0.0
    """With `Contact.STICKING`: the strain at the first sample, relaxed for `insertion_dwell_s`."""
    recorded: bool = True
    """Whether it becomes a run file; tares and moves to a start do not."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Consecutive samples of all channels, arrays of shape `(n,)`, read-only.

    `first_index` counts from the run's first sample and includes lost samples: where it is beyond the end of the block
    before, the samples between are lost. `fault` is a detection of the sampler itself: an overrun, a sensor overloaded
    or cut off.
    """

    first_index: int
    channels: Mapping[str, AnyFloatArray]
    fault: Trip | None = None

    @property
    def samples(self) -> int:
        """Number of samples."""
        return len(next(iter(self.channels.values())))

    @property
    def end_index(self) -> int:
        """Index of the next block's first sample when nothing is lost."""
        return self.first_index + self.samples


@dataclass(frozen=True, slots=True)
class StageLimits:
    """The abilities of a stage; positions are absolute."""

    lowest_mm: float
    highest_mm: float
    speed_mm_s: float
    acceleration_mm_s2: float


@dataclass(frozen=True, slots=True)
class StageState:
    """State of the stage; `fault` is None when nothing forbids motion."""

    position_mm: float
    enabled: bool
    homed: bool
    moving: bool
    fault: Trip | None = None
    drive_mm: float = nan
    """Position by the drive's own encoder, whose zero may be elsewhere; NaN where there is none."""


class Clock(Protocol):
    """Time as a device: a simulated one advances at once."""

    def now(self) -> datetime:
        """Time of day, with offset."""

    def monotonic(self) -> float:
        """Seconds from an arbitrary start; never goes back."""

    def sleep(self, duration_s: float, cancel: Signal) -> bool:
        """Wait; return False at once when `cancel` is set before the time is over."""


class Stage(Protocol):
    """One axis. Every method raises `DeviceError` when the drive refuses."""

    @property
    def limits(self) -> StageLimits:
        """The abilities of the stage."""

    def enable(self) -> None:
        """Switch the drive on and hold the position."""

    def home(self) -> None:
        """Find the origin of absolute positions."""

    def move(self, profile: MotionProfile) -> None:
        """Begin to follow a profile from the present position; time 0 is the sampler's first sample."""

    @property
    def start_uncertainty_s(self) -> float:
        """Uncertainty of time 0 of the last motion against the first sample; 0 where they share a clock."""

    def await_end(self, cancel: Signal) -> None:
        """Wait until the motion begun last is over: a drive may come to its end after the last sample.

        Returns early once `cancel` is set or `fault` reports something. Raises `DeviceError` when it still moves after
        the time for which the guard may see no sample.
        """

    def stop(self) -> None:
        """Brake to a standstill at once. Must be safe to call at any time, also twice."""

    def override_limit(self, side: TravelEnd) -> None:
        """Let the next motion begin although the limit switch of this side is pressed: away from it.

        Until that motion is over, `fault` ignores this switch alone, and a position beyond the soft limit of this side
        forbids no motion back.
        """

    def disable(self) -> None:
        """Switch the drive off."""

    def state(self) -> StageState:
        """Return position and state."""

    @property
    def fault(self) -> Trip | None:
        """The fault that drive and switches report, or None; read at every block, so it must not block."""


@runtime_checkable
class SupportsMotionTrial(Protocol):
    """A stage that has to show by its first motion that command, drive and encoder agree."""

    @property
    def trial_due(self) -> bool:
        """Whether that is still to come."""

    def prove_motion(self) -> None:
        """Move by a millimetre and compare, if it is due; raises `DeviceError` when the three do not agree."""


@runtime_checkable
class CountsLateReplies(Protocol):
    """A stage that tells how often its drive answered late."""

    @property
    def late_replies(self) -> int:
        """How many replies came late so far, and were good all the same; must not block."""


class Sampler(Protocol):
    """Hardware-timed acquisition of force, position and further channels."""

    @property
    def sample_rate_hz(self) -> float:
        """Samples per second of every channel."""

    @property
    def channels(self) -> tuple[RecordedChannel, ...]:
        """Channels of each block: `force` and `position`, then others."""

    @property
    def force_range_mN(self) -> tuple[float, float]:
        """Smallest and largest force within the range of sensor and converter."""

    def arm(self, acquisition: Acquisition) -> None:
        """Prepare an acquisition of the profile's length."""

    def start(self) -> None:
        """Take the first sample now."""

    def read(self, cancel: Signal) -> Block | None:
        """Return the next block, at most `MAX_BLOCK_S` long; None once the profile is over or `cancel` is set.

        After `Stage.stop` a sampler still returns the samples until the stage stands still, then None.
        Raises `StaleDataError` when no sample arrives in time, another `DeviceError` when the device fails.
        """

    def stop(self) -> None:
        """End the acquisition and release its resources. Must be safe to call at any time, also twice."""

    def measure(self, duration_s: float, cancel: Signal | None = None) -> RawReading:
        """Sample without motion and return raw volts and counts, for a calibration; soon after `cancel` is set.

        Raises `DeviceError` while an acquisition is armed, and when the device fails.
        """


@runtime_checkable
class Backend(Protocol):
    """A rig: its devices, its clock and its name in run files."""

    @property
    def name(self) -> str:
        """Name that the run files carry: simulated, hardware, …."""

    @property
    def stage(self) -> Stage:
        """The axis."""

    @property
    def sampler(self) -> Sampler:
        """The acquisition."""

    @property
    def needs_hands(self) -> bool:
        """Whether a person must be at the rig, to check it before the guard is reset and to do manual steps."""

    @property
    def clock(self) -> Clock:
        """The clock of this rig."""

    def description(self) -> Mapping[str, str | float | int | bool]:
        """Return attributes of `/entry/run` that describe the devices: sensor_serial, seed, …."""

    def examine(self) -> Iterator[RigCheck]:
        """Check every device in turn without motion, connecting each when it is due."""

    def close(self) -> None:
        """Release every device. Must be safe to call twice."""


@runtime_checkable
class SupportsBenchActions(Protocol):
    """A backend that simulates manual actions at the bench: the doubles of the hardware."""

    def hang(self, load_mN: float) -> None:
        """Put a load on the force sensor, in place of the one before."""

    def push(self, distance_mm: float, within_s: float) -> None:
        """Push the carriage, switched off, by a signed distance, now or during the next measurement."""

    def press(self, switch: str, *, on: bool) -> None:
        """Press a switch, as named in `hardware.card.lines`, or release it."""


@dataclass(frozen=True, slots=True)
class IdleReading:
    """Force and position while nothing is acquired; None where one is not known."""

    force_mN: float | None
    position_mm: float | None
    """Absolute; None before the stage is homed."""
    problem: str = ""
    """What forbids motion, or why nothing could be read; empty when all is well."""

    @property
    def text(self) -> str:
        """A line for a person."""
        force = "unknown" if self.force_mN is None else f"{self.force_mN:z.1f} mN"
        position = "unknown" if self.position_mm is None else f"{self.position_mm:.3f} mm"
        return f"force {force}, position {position}" + (f"; {self.problem}" if self.problem else "")


def read_idle(backend: Backend, duration_s: float) -> IdleReading:
    """Read force and position without motion, as a person sees them who mounts a specimen.

    Only while nothing is armed, and from the thread that would arm.

    Parameters
    ----------
    duration_s
        The force is the mean over this time; 0 takes one sample, and no time of a simulated clock.
    """
    try:
        state, raw = backend.stage.state(), backend.sampler.measure(duration_s)
    except DeviceError as error:
        return IdleReading(None, None, reason_of(error))
    return IdleReading(
        force_mN=raw.force_mN if isfinite(raw.force_mN) else None,
        position_mm=state.position_mm if state.homed else None,
        problem="" if state.fault is None else state.fault.message,
    )


@dataclass(slots=True)
class RigMemory:
    """The state that a simulated rig keeps from one opening to the next, as a real one does by itself; empty at first.

    It belongs to the program that opens the rig, again and again, and to one opening at a time.
    """

    kept: object = None


@dataclass(frozen=True, slots=True)
class BackendRequest:
    """Argument of a backend's factory.

    The factory is named by an entry point of the group `dragrig.backends`: a callable that takes a request and
    returns a `Backend`, raising `SettingsError` or `DeviceError`.
    """

    rig: RigSettings
    model: FrictionModelSettings
    real_time: bool = False
    """Whether a simulated clock runs in real time."""
    origin: datetime | None = None
    """Time of day at which a simulated session begins; None for now."""
    calibrations: Mapping[str, Calibration] = field(default_factory=dict)
    """The valid calibrations, by quantity (force, encoder)."""
    connect: bool = True
    """Whether to connect the devices at once; `Backend.examine` connects those that it checks."""
    pace: float = 1.0
    """Pace of a double of the hardware; 1 is real time, 10 ten times faster."""
    first_run_at: datetime | None = None
    """When the campaign's first run began, in a resumed session."""
    memory: RigMemory = field(default_factory=RigMemory, compare=False)


def with_utc_offset(origin: datetime | None) -> datetime:
    """Return `origin`, or now, as a time with its offset from UTC; a time without one is local."""
    if origin is None:
        return datetime.now().astimezone()
    return origin if origin.tzinfo is not None else origin.astimezone()


class WallClock:
    """A clock in real time; its time of day may begin at another moment."""

    def __init__(self, origin: datetime | None = None) -> None:
        self._origin = with_utc_offset(origin)
        self._begun_s = time.perf_counter()

    def now(self) -> datetime:
        """Time of day, with offset."""
        return self._origin + timedelta(seconds=self.monotonic())

    def monotonic(self) -> float:
        """Seconds since the clock was made."""
        return time.perf_counter() - self._begun_s

    def sleep(self, duration_s: float, cancel: Signal) -> bool:
        """Wait; return False within milliseconds when `cancel` is set before the time is over."""
        return not (cancel.wait(duration_s) if duration_s > 0 else cancel.is_set())


def stage_limits(settings: StageSettings) -> StageLimits:
    """Return the limits in the settings."""
    return StageLimits(
        lowest_mm=settings.lowest_mm,
        highest_mm=settings.highest_mm,
        speed_mm_s=settings.max_speed_mm_s,
        acceleration_mm_s2=settings.max_accel_mm_s2,
    )


def limits_with_override(limits: StageLimits, override: TravelEnd | None, origin_mm: float) -> StageLimits:
    """Return the limits of a move off an overridden limit switch, which begins beyond the soft limit."""
    match override:
        case TravelEnd.LOW:
            return replace(limits, lowest_mm=min(limits.lowest_mm, origin_mm))
        case TravelEnd.HIGH:
            return replace(limits, highest_mm=max(limits.highest_mm, origin_mm))
        case None:
            return limits


def limit_violations(
    extremes: MotionExtremes, origin_mm: float, limits: StageLimits, tolerance_mm: float = 1e-9
) -> Iterator[str]:
    """Yield each limit that a motion would exceed, run-up and run-down included, as the end of a sentence.

    Parameters
    ----------
    origin_mm
        Absolute position where the motion begins.
    tolerance_mm
        Allowance beyond the ends of travel: rounding, or a count or two of an encoder.
    """
    lowest_mm, highest_mm = origin_mm + extremes.lowest_mm, origin_mm + extremes.highest_mm
    # Written so that a NaN is refused too.
    if not (lowest_mm >= limits.lowest_mm - tolerance_mm and highest_mm <= limits.highest_mm + tolerance_mm):
        yield (
            f"would move from {lowest_mm:g} to {highest_mm:g} mm, outside the stage's travel of "
            f"{limits.lowest_mm:g} to {limits.highest_mm:g} mm (stage.lowest_mm and highest_mm "
            "of the rig file); change travel_mm or start_mm"
        )
    for quantity, unit, value, limit, key in (
        ("a speed", "mm/s", extremes.speed_mm_s, limits.speed_mm_s, "max_speed_mm_s"),
        ("an acceleration", "mm/s²", extremes.acceleration_mm_s2, limits.acceleration_mm_s2, "max_accel_mm_s2"),
    ):
        if not value <= limit * (1 + 1e-9):
            yield f"would reach {quantity} of {value:g} {unit}, over the limit of {limit:g} {unit} (stage.{key})"


def require_within_limits(profile: MotionProfile, origin_mm: float, limits: StageLimits, tolerance_mm: float) -> None:
    """Raise `DeviceError` for a profile that violates a limit, as of `limit_violations`, or does not end at rest."""
    for violation in limit_violations(profile.extremes(), origin_mm, limits, tolerance_mm):
        raise DeviceError(f"the stage refuses a motion from {origin_mm:g} mm that {violation}.")
    if not abs(float(profile.velocity(profile.duration_s))) <= STANDSTILL_SPEED_MM_S:
        raise DeviceError("the stage refuses a profile that ends in motion: let it end at a standstill.")
