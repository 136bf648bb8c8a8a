"""What a run file holds, as values. Units: mm, s, mN; names as in the file."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Literal, Self

from dragrig.rig import AnyFloatArray, FloatArray, Phase, PhaseArray

Attribute = str | float | int | bool
"""What an attribute of the file can be; NumPy scalars become these on reading."""

PHASE_NAMES = tuple(phase.name.lower() for phase in Phase)


class RunStatus(StrEnum):
    """How a run ended; `recording` occurs only in a file that is still being written."""

    RECORDING = "recording"
    COMPLETE = "complete"
    ABORTED = "aborted"
    TRIPPED = "tripped"
    FAILED = "failed"
    RECOVERED = "recovered"


@dataclass(frozen=True, slots=True)
class RecordedChannel:
    """One recorded quantity: dataset name, unit and number type; float32 holds 24 bits, more than a rig's converter."""

    name: str
    units: str
    dtype: Literal["float32", "float64"] = "float32"


@dataclass(frozen=True, slots=True)
class RunHeader:
    """Everything known before the first sample.

    `entry`, `protocol`, `capsule` and `specimen` hold the attributes of the groups of the same name (`/entry/run`
    for `entry`), without `NX_class`, `default` and what the writer sets itself.
    """

    run_id: str
    start_time: datetime
    order: int
    backend: str
    kind: str
    sample_rate_hz: float
    channels: tuple[RecordedChannel, ...]
    entry: Mapping[str, Attribute] = field(default_factory=dict)
    protocol: Mapping[str, Attribute] = field(default_factory=dict)
    capsule: Mapping[str, Attribute] = field(default_factory=dict)
    specimen: Mapping[str, Attribute] = field(default_factory=dict)
    settings_toml: str = ""


@dataclass(frozen=True, slots=True)
class RunEvent:
    """Something that happened at a time of the run's own clock."""

    time_s: float
    kind: str
    message: str

    @classmethod
    def gap(cls, begin_index: int, end_index: int, rate_hz: float) -> Self:
        """Return the event of lost samples, from the first lost one to the next that came."""
        lost = end_index - begin_index
        return cls(begin_index / rate_hz, "gap", f"{lost} samples lost, {lost / rate_hz:.6g} s")


@dataclass(frozen=True, slots=True)
class RunEnding:
    """What is known once the last sample has been taken."""

    status: RunStatus
    reason: str = ""
    end_time: datetime | None = None
    checks: Mapping[str, Attribute] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RunInfo:
    """A run file without its samples."""

    path: Path
    format_version: int
    status: RunStatus
    header: RunHeader
    samples: int
    reason: str = ""
    end_time: datetime | None = None
    checks: Mapping[str, Attribute] = field(default_factory=dict)
    raw_sha256: str = ""

    @property
    def kind(self) -> str:
        """Kind of protocol: drag, relaxation, coulomb, blank, return, motion, …."""
        return self.header.kind

    @property
    def is_sentinel(self) -> bool:
        """Whether it was made to see how far the specimen has drifted."""
        return self.header.entry.get("role") == "sentinel"


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """The samples of a run, each array of shape `(N,)` and read-only.

    `signal` names the channel that the run is about: force, or motor_force for a stage alone. `channels` holds every
    recorded quantity except time, command and phase, by name.
    """

    sample_rate_hz: float
    signal: str
    time: FloatArray
    command: AnyFloatArray
    phase: PhaseArray
    channels: Mapping[str, AnyFloatArray]
    units: Mapping[str, str]

    @property
    def force(self) -> AnyFloatArray:
        """Measured force [mN], as calibrated, never filtered."""
        return self.channels[self.signal]

    @property
    def position(self) -> AnyFloatArray:
        """Encoder position [mm] relative to where the run started."""
        return self.channels["position"]


@dataclass(frozen=True, slots=True, eq=False)
class FilteredTrace:
    """A filtered trace stored beside the raw one, with the filter's parameters; arrays of shape `(N,)`, read-only."""

    time: FloatArray
    channels: Mapping[str, FloatArray]
    parameters: Mapping[str, Attribute]
    units: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """A run file, read whole."""

    info: RunInfo
    trace: Trace
    events: tuple[RunEvent, ...] = ()
    filtered: FilteredTrace | None = None
