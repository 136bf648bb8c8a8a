"""The content of a run file, as values. Units: mm, s, mN; names as in the file."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Self

import numpy as np

from dragrig.rig import AnyFloatArray, FloatArray, Phase, PhaseArray

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure

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
    for `entry`), without `NX_class`, `default` and the writer's own.
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
    """The facts known once the last sample has been taken."""

    status: RunStatus
    reason: str = ""
    end_time: datetime | None = None
    checks: Mapping[str, Attribute] = field(default_factory=dict)


def as_html(result: object) -> str:
    """Return a result as notebooks show it; how is told by an entry point of the group `dragrig.views`."""
    (entry,) = entry_points(group="dragrig.views", name="html")
    show: Callable[[object], str] = entry.load()
    return show(result)


@dataclass(frozen=True, slots=True, repr=False)
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

    def __repr__(self) -> str:
        protocol = self.header.protocol
        main = ", ".join(f"{key}={protocol[key]}" for key in ("speed_mm_s", "shear_strain") if key in protocol)
        specimen, begun = self.header.specimen.get("name", ""), f"{self.header.start_time:%Y-%m-%d %H:%M:%S}"
        duration = f"{self.samples / self.header.sample_rate_hz:g} s"
        return f"<run {', '.join(filter(None, (self.kind, main, str(specimen), begun, duration, self.status.value)))}>"


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
    def phase_names(self) -> np.ndarray[tuple[int], np.dtype[np.str_]]:
        """Name of the phase of each sample."""
        return np.array(PHASE_NAMES)[self.phase]

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


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Run:
    """A run file, read whole."""

    info: RunInfo
    trace: Trace
    events: tuple[RunEvent, ...] = ()
    filtered: FilteredTrace | None = None

    def __repr__(self) -> str:
        return repr(self.info)

    _repr_html_ = as_html

    def plot(self, *, filtered: bool = True, motor_force: bool = False) -> "Figure":
        """Draw force, position and speed with the phases, as `dragrig show` does.

        Parameters
        ----------
        filtered
            Whether the filtered force is drawn over the raw one.
        motor_force
            Whether the motor's force is added, where it was recorded.
        """
        (entry,) = entry_points(group="dragrig.views", name="run_figure")
        if "ipykernel" in sys.modules:  # a notebook shows figures once the backend that draws them is loaded
            import matplotlib.pyplot as plt

            plt.switch_backend(plt.rcParams["backend"])
        draw: Callable[..., Figure] = entry.load()
        return draw(self, filtered=filtered, motor_force=motor_force)

    def to_pandas(self) -> "pd.DataFrame":
        """Return the samples as a table by time, names with their units: force_mN, position_mm, …, and the phase."""
        import pandas as pd

        columns = {f"{name}_{units.replace('/', '_')}": values for name, (values, units) in self.columns().items()}
        phases = pd.Categorical(self.trace.phase_names, categories=list(PHASE_NAMES))
        return pd.DataFrame({**columns, "phase": phases}, index=pd.Index(self.trace.time, name="time_s"))

    def to_xarray(self) -> "xr.Dataset":
        """Return the samples as a dataset over time, units in `attrs`, the phase a coordinate, with all known facts.

        Raises
        ------
        ImportError
            Where xarray is not installed.
        """
        try:
            import xarray as xr
        except ImportError as error:
            raise ImportError("xarray is not installed here: pip install xarray.") from error

        header = self.info.header
        columns = self.columns().items()
        groups = {"protocol": header.protocol, "capsule": header.capsule, "specimen": header.specimen}
        known = {f"{group}_{key}": value for group, values in groups.items() for key, value in values.items()}
        return xr.Dataset(
            {name: ("time", values, {"units": units} if units else {}) for name, (values, units) in columns},
            {"time": ("time", self.trace.time, {"units": "s"}), "phase": ("time", self.trace.phase_names)},
            {**known, "run_id": header.run_id, "kind": self.info.kind, "start_time": header.start_time.isoformat()},
        )

    def columns(self) -> dict[str, tuple[AnyFloatArray, str]]:
        """Return every quantity with its unit, the filtered ones as `force_filtered`."""
        trace, filtered = self.trace, self.filtered
        columns = {name: (values, trace.units.get(name, "")) for name, values in trace.channels.items()}
        columns["command"] = (trace.command, "mm")
        if filtered is not None and filtered.time.shape == trace.time.shape:
            columns |= {
                f"{name}_filtered": (values, filtered.units.get(name, "")) for name, values in filtered.channels.items()
            }
        return columns
