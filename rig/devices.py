"""What a rig is made of: small protocols that real and simulated devices both fulfil.

A block is immutable and passes guard, recorder and viewers in that order. Positions of the stage are
absolute (after homing); positions inside a block are relative to where the run started.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from threading import Event as Signal
from typing import Protocol

from dragrig.config.capsule import Capsule
from dragrig.config.specimen import Fixture, Specimen
from dragrig.rig.arrays import AnyFloatArray
from dragrig.rig.profile import MotionProfile
from dragrig.rig.raw import RawReading
from dragrig.rig.runfile.model import Channel
from dragrig.rig.trips import Trip

LONGEST_BLOCK_S = 0.05
"""No block spans more than this, so that the guard never sees older data than this."""


class Side(StrEnum):
    """An end of the stage's travel."""

    LOW = "low"
    HIGH = "high"


class Contact(StrEnum):
    """How capsule and gut meet during a run."""

    SLIDING = "sliding"
    STICKING = "sticking"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Acquisition:
    """One stretch of synchronous motion and sampling, with what a simulated rig must know of it.

    Attributes
    ----------
    run_id, order
        Identity of the run; a simulated rig draws its noise from the session's seed and `order`.
    profile
        The commanded motion, from standstill, relative to the stage's position when armed.
    fixture, contact
        What holds the gut and whether the capsule slides in it, sticks to it or touches nothing.
    shear_strain
        With `Contact.STICKING`: the strain whose wall parameters apply.
    sheared_from
        With `Contact.STICKING`: the strain at the first sample, relaxed for `insertion_dwell_s`.
    insertion_dwell_s
        Age of the contact at the first sample.
    recorded
        Whether it becomes a run file; tares and ways to a start do not.
    """

    run_id: str
    order: int
    kind: str
    profile: MotionProfile
    capsule: Capsule
    specimen: Specimen
    fixture: Fixture
    contact: Contact
    insertion_dwell_s: float
    shear_strain: float = 0.0
    sheared_from: float = 0.0
    recorded: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Consecutive samples of all channels, arrays of shape `(n,)`, read-only.

    `first_index` counts from the run's first sample and includes lost samples, so that a block whose
    `first_index` is larger than the end of the block before says how many were lost. `fault` is what the sampler
    itself has seen go wrong: an overrun, a sensor overloaded or cut off.
    """

    first_index: int
    channels: Mapping[str, AnyFloatArray]
    fault: Trip | None = None

    @property
    def samples(self) -> int:
        """How many samples the block holds."""
        return len(next(iter(self.channels.values())))

    @property
    def end_index(self) -> int:
        """Index that the first sample of the next block has when nothing is lost."""
        return self.first_index + self.samples


@dataclass(frozen=True, slots=True)
class StageLimits:
    """What the stage can do; positions are absolute."""

    lowest_mm: float
    highest_mm: float
    speed_mm_s: float
    acceleration_mm_s2: float


@dataclass(frozen=True, slots=True)
class StageState:
    """A look at the stage. `fault` is None when nothing forbids motion."""

    position_mm: float
    enabled: bool
    homed: bool
    moving: bool
    fault: Trip | None = None


class Clock(Protocol):
    """Time as a device: a simulated one advances at once."""

    def now(self) -> datetime:
        """Time of day, with offset."""
        ...

    def monotonic(self) -> float:
        """Seconds from an arbitrary start; never goes back."""
        ...

    def sleep(self, duration_s: float, cancel: Signal) -> bool:
        """Wait; return False at once when `cancel` is set before the time is over."""
        ...


class Stage(Protocol):
    """One axis. Every method raises `DeviceError` when the drive refuses."""

    @property
    def limits(self) -> StageLimits:
        """What the stage can do."""
        ...

    def enable(self) -> None:
        """Switch the drive on and hold the position."""
        ...

    def home(self) -> None:
        """Find the origin of absolute positions."""
        ...

    def move(self, profile: MotionProfile) -> None:
        """Begin to follow a profile from the present position; time 0 is the sampler's first sample."""
        ...

    @property
    def start_uncertainty_s(self) -> float:
        """How far time 0 of the last motion may be off the first sample; 0 where the two are one."""
        ...

    def stop(self) -> None:
        """Brake to a standstill now, whatever is under way. Must be safe to call at any time, twice too."""
        ...

    def override_limit(self, side: Side) -> None:
        """Let the next motion begin, away from it, although the limit switch of this side is pressed.

        `fault` does not tell of that switch until the motion is over, of everything else as ever, and a position
        beyond the soft limit of this side forbids no motion back.
        """
        ...

    def disable(self) -> None:
        """Switch the drive off."""
        ...

    def state(self) -> StageState:
        """Where the stage is and how it is."""
        ...

    @property
    def fault(self) -> Trip | None:
        """What drive and switches report, None when nothing; asked at every block, so it must wait for nobody."""
        ...


class Sampler(Protocol):
    """Hardware-timed acquisition of force, position and further channels."""

    @property
    def sample_rate_hz(self) -> float:
        """Samples per second of every channel."""
        ...

    @property
    def channels(self) -> tuple[Channel, ...]:
        """What each block holds: `force` and `position`, then further ones."""
        ...

    @property
    def force_range_mN(self) -> tuple[float, float]:
        """Least and greatest force that the sensor and its converter can tell."""
        ...

    def arm(self, acquisition: Acquisition) -> None:
        """Prepare an acquisition of the profile's length."""
        ...

    def start(self) -> None:
        """Take the first sample now."""
        ...

    def read(self, cancel: Signal) -> Block | None:
        """Return the next block, at most `LONGEST_BLOCK_S` long; None once the profile is over or `cancel` is set.

        After `Stage.stop` a sampler still yields what was sampled until the stage stood still, then None.
        Raises `StaleDataError` when no sample arrives in time, another `DeviceError` when the device fails.
        """
        ...

    def stop(self) -> None:
        """End the acquisition and release what it holds. Must be safe to call at any time, twice too."""
        ...

    def measure(self, duration_s: float) -> RawReading:
        """Sample for a while, moving nothing, and return what converter and counter say, for a calibration.

        Raises `DeviceError` while an acquisition is armed, and when the device fails.
        """
        ...
