"""The run file's layout in one place: its names, attributes and units, and the names of the files beside it."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from dragrig.config import OutputError

if TYPE_CHECKING:
    import numpy as np

FORMAT = "dragrig-run"
FORMAT_VERSION = 2
FINISHED_SUFFIX = ".h5"
RECORDING_SUFFIX = ".recording.h5"
JOURNAL_SUFFIX = ".recording.journal"
LOCK_SUFFIX = ".recording.lock"
PART_SUFFIX = ".part"
MARK_SUFFIX, NOTE_SUFFIX = ".mark.toml", ".note.txt"
"""Of what a person says of a run, which may change or be withdrawn."""

ENTRY = "/entry"
RUN = "/entry/run"
TRACE = "/entry/trace"
FILTERED = "/entry/filtered"
PROTOCOL = "/entry/protocol"
CAPSULE = "/entry/capsule"
SPECIMEN = "/entry/specimen"
CHECKS = "/entry/checks"

TIME = "time"
COMMAND = "command"
PHASE = "phase"


@dataclass(frozen=True, slots=True)
class Layout:
    """The places, by version of the format, of parts that the NeXus standard has no place for."""

    version: int
    marked: str
    """Group with the attributes `format` and `format_version`."""
    run: str
    """Group with the attributes of the run, its events and settings, and what only a recording has."""

    @property
    def settings(self) -> str:
        """The full settings the run was made with, as TOML."""
        return f"{self.run}/settings"

    @property
    def events(self) -> str:
        """The table of events."""
        return f"{self.run}/events"

    @property
    def annotations(self) -> str:
        """Facts that became known during a recording, as lines of JSON."""
        return f"{self.run}/annotations"

    @property
    def valid_counts(self) -> tuple[str, str, str]:
        """How many samples, events and bytes of annotations of a recording are valid."""
        return (f"{self.run}/valid_samples", f"{self.run}/valid_events", f"{self.run}/valid_annotation_bytes")


LAYOUT = Layout(FORMAT_VERSION, RUN, RUN)
"""As files are written."""
LAYOUTS: Mapping[int, Layout] = {1: Layout(1, "/", ENTRY), FORMAT_VERSION: LAYOUT}
"""Every version that can be read; a new one is added, none is removed."""

FRAME_DATASETS = (TIME, COMMAND, PHASE)
"""The datasets of a trace that are not recorded quantities."""

SIGNALS = ("force", "motor_force")
FIXTURES = ("foam", "vacuum", "none")

UNITS: Mapping[str, str] = {
    TIME: "s",
    "force": "mN",
    "motor_force": "mN",
    "position": "mm",
    COMMAND: "mm",
    "temperature": "degC",
}
"""Units that these datasets must have; others are free."""

FIXED_ATTRIBUTES: Mapping[str, Mapping[str, str]] = {
    "/": {"NX_class": "NXroot", "default": "entry"},
    ENTRY: {"NX_class": "NXentry", "default": "trace"},
    TRACE: {"NX_class": "NXdata", "axes": "time"},
}
"""Attributes that make a NeXus viewer find the force trace; every file has them."""

NEXUS_CLASSES: Mapping[str, str] = dict.fromkeys((RUN, PROTOCOL, CAPSULE, SPECIMEN, CHECKS), "NXcollection")
"""Classes of further groups; older files without them are read all the same."""

LONG_NAMES: Mapping[str, str] = {
    TIME: "time since the first sample",
    "force": "force against the capsule",
    "motor_force": "force of the motor",
    "position": "position relative to the start",
    COMMAND: "commanded position relative to the start",
    PHASE: "phase of the motion",
    "temperature": "temperature",
}
"""Names for the axes of a viewer, to which the unit is added."""

REQUIRED_ATTRIBUTES: Mapping[str, Mapping[str, type]] = {
    RUN: {"run_id": str, "start_time": str, "order": int, "status": str, "backend": str},
    TRACE: {"signal": str, "sample_rate_hz": float},
    PROTOCOL: {"kind": str},
    CAPSULE: {"diameter_mm": float, "length_mm": float, "mass_g": float, "contact_angle_deg": float},
    SPECIMEN: {"name": str, "wall_thickness_mm": float, "fixture": str},
}

_STROKE_PARAMETERS = ("speed_mm_s", "travel_mm", "accel_mm_s2", "rest_s", "hold_s")
PARAMETERS_OF_KIND: Mapping[str, tuple[str, ...]] = {
    "drag": _STROKE_PARAMETERS,
    "coulomb": _STROKE_PARAMETERS,
    "blank": _STROKE_PARAMETERS,
    "relaxation": ("shear_strain", "ramp_speed_mm_s", "ramp_accel_mm_s2", "rest_s", "hold_s"),
}
"""Numbers that `/entry/protocol` must hold for these kinds; the other kinds are free."""

MAX_MAGNITUDES: Mapping[str, float] = {
    "_mm_s2": 1e8,
    "_mm_s": 1e6,
    "_mm": 1e6,
    "_um": 1e9,
    "_mN": 1e9,
    "_g": 1e7,
    "_deg": 360.0,
    "_degC": 1e3,
    "_s": 1e7,
    "_hz": 1e8,
}
"""Largest magnitude of a number by the unit in its name: far beyond any rig, and small enough to compute with."""
MAX_TRACE_MAGNITUDES: Mapping[str, float] = {"s": 1e7, "mm": 1e6, "mN": 1e9}
"""The same for the samples of a trace, by unit."""
MAX_ORDER = 10**9
MAX_KIND_CHARACTERS = 64
MAX_RATE_MISMATCH = 2.0
"""Factor by which the median time between samples may differ from the sample rate."""

HEADER_ATTRIBUTES: frozenset[str] = frozenset(
    {"NX_class", "default", "format", "format_version", "status", "reason", "end_time", "raw_sha256", "run_id",
     "start_time", "order", "backend"}
)  # fmt: skip
"""Attributes of the run that have fields of their own in a `RunInfo` or `RunHeader` and are not in its `entry`."""

EVENT_KIND_BYTES = 16
EVENT_MESSAGE_BYTES = 160
EVENT_FIELDS = ("time_s", "kind", "message")
FILTER_EVENT = "filter"
"""Kind of the events that the filter writes, and replaces when it is run again."""


_KIND_PATTERN = re.compile(r"[a-z][a-z0-9_-]*")
_RUN_NAME = re.compile(rf"\d{{8}}-\d{{6}}-{_KIND_PATTERN.pattern}-(?P<order>\d{{3,6}})\.")


def event_dtype() -> "np.dtype[np.void]":
    """Row of the table of events: fixed-length UTF-8, so that rows can be appended while a run is recorded."""
    import h5py
    import numpy as np

    return np.dtype(
        [
            ("time_s", "<f8"),
            ("kind", h5py.string_dtype("utf-8", EVENT_KIND_BYTES)),
            ("message", h5py.string_dtype("utf-8", EVENT_MESSAGE_BYTES)),
        ]
    )


def run_file_name(start_time: datetime, kind: str, order: int) -> str:
    """Return `YYYYmmdd-HHMMSS-KIND-NNN.h5`, in the time zone of `start_time`.

    Raises `OutputError` for a kind that is no valid file name on every system.
    """
    if not _KIND_PATTERN.fullmatch(kind):
        raise OutputError(f"the kind {kind!r} cannot name a file; use small letters, digits, - and _")
    return f"{start_time:%Y%m%d-%H%M%S}-{kind}-{order:03d}{FINISHED_SUFFIX}"


def order_in_name(path: Path) -> int | None:
    """Return the order of a run that its file's name states; None for a name that somebody else gave."""
    stated = _RUN_NAME.match(path.name)
    return None if stated is None else int(stated.group("order"))


def is_recording(path: Path) -> bool:
    """Tell whether a name is that of a recording: of a run that is not finished yet."""
    return path.name.endswith(RECORDING_SUFFIX)


def run_name(path: Path) -> str:
    """Return the stem that a run's file, its recording, lock and mark share."""
    suffixes = (RECORDING_SUFFIX, JOURNAL_SUFFIX, FINISHED_SUFFIX)
    return path.name.removesuffix(next((suffix for suffix in suffixes if path.name.endswith(suffix)), ""))


def _beside(suffix: str, path: Path) -> Path:
    return path.with_name(run_name(path) + suffix)


finished_path = partial(_beside, FINISHED_SUFFIX)
"""Path of a run's finished file."""
recording_path = partial(_beside, RECORDING_SUFFIX)
"""Path of a run's recording."""
journal_path = partial(_beside, JOURNAL_SUFFIX)
"""Path of the journal of a run's recording."""
lock_path = partial(_beside, LOCK_SUFFIX)
"""Lock file of the process that writes a run."""
mark_path = partial(_beside, MARK_SUFFIX)
"""Path of a run's mark."""
note_path = partial(_beside, NOTE_SUFFIX)
"""Path of the note on a run."""


def part_path(path: Path) -> Path:
    """Return where a file is written before it is moved into place."""
    return path.with_name(path.name + PART_SUFFIX)


@cache
def provenance() -> Mapping[str, str]:
    """Return the makers of a file: versions of this software, of Python and of the libraries, and the git revision."""
    import platform
    from importlib.metadata import version

    libraries = {name: version(name) for name in ("h5py", "numpy", "scipy")}
    return {"dragrig": version("dragrig"), "git_revision": _git_revision(), "python": platform.python_version(),
            "platform": platform.platform(), **libraries}  # fmt: skip


def _git_revision() -> str:
    """Return the revision of the clone that this software runs from; "unknown" for an installed copy."""
    import subprocess

    folder = Path(__file__).resolve().parent
    if not any((above / ".git").exists() for above in folder.parents[:3]):
        return "unknown"
    ask = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(ask, capture_output=True, text=True, timeout=5.0, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"


@cache
def software_version() -> str:
    """Return name and version of this software, for run files and reports."""
    from importlib.metadata import version

    return f"dragrig {version('dragrig')}"
