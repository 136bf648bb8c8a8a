"""The one place that knows the names, attributes and units of the run file's layout."""

from collections.abc import Mapping

import numpy as np

FORMAT = "dragrig-run"
FORMAT_VERSION = 1
FINISHED_SUFFIX = ".h5"
RECORDING_SUFFIX = ".recording.h5"
LOCK_SUFFIX = ".recording.lock"
PART_SUFFIX = ".part"

ENTRY = "/entry"
TRACE = "/entry/trace"
FILTERED = "/entry/filtered"
PROTOCOL = "/entry/protocol"
CAPSULE = "/entry/capsule"
SPECIMEN = "/entry/specimen"
CHECKS = "/entry/checks"
SETTINGS = "/entry/settings"
EVENTS = "/entry/events"

TIME = "time"
COMMAND = "command"
PHASE = "phase"
FRAME = (TIME, COMMAND, PHASE)
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

REQUIRED_ATTRIBUTES: Mapping[str, Mapping[str, type]] = {
    ENTRY: {"run_id": str, "start_time": str, "order": int, "status": str, "backend": str},
    TRACE: {"signal": str, "sample_rate_hz": float},
    PROTOCOL: {"kind": str},
    CAPSULE: {"diameter_mm": float, "length_mm": float, "mass_g": float, "contact_angle_deg": float},
    SPECIMEN: {"name": str, "wall_thickness_mm": float, "fixture": str},
}

_MOVE = ("speed_mm_s", "travel_mm", "accel_mm_s2", "rest_s", "hold_s")
PARAMETERS_OF_KIND: Mapping[str, tuple[str, ...]] = {
    "drag": _MOVE,
    "coulomb": _MOVE,
    "blank": _MOVE,
    "relaxation": ("shear_strain", "ramp_speed_mm_s", "ramp_accel_mm_s2", "rest_s", "hold_s"),
}
"""Numbers that `/entry/protocol` must hold for these kinds; other kinds say what they say."""

WRITERS_ATTRIBUTES: frozenset[str] = frozenset(
    {"NX_class", "default", "status", "reason", "end_time", "raw_sha256", "run_id", "start_time", "order", "backend"}
)
"""Attributes of `/entry` that stand in a `RunInfo` or in their own fields of a `RunHeader`, not in its `entry`."""

VALID_SAMPLES = "/entry/valid_samples"
VALID_EVENTS = "/entry/valid_events"
VALID_ANNOTATION_BYTES = "/entry/valid_annotation_bytes"
ANNOTATIONS = "/entry/annotations"
"""Only in a recording: how much of it is whole, and what became known late, as lines of JSON."""

EVENT_KIND_BYTES = 16
EVENT_MESSAGE_BYTES = 160
EVENT_FIELDS = ("time_s", "kind", "message")
FILTER_EVENT = "filter"
"""Kind of the events that the filter writes and, run again, replaces."""


def event_dtype() -> np.dtype[np.void]:
    """Row of `/entry/events`: fixed-length UTF-8, so that rows can be appended while a run is recorded."""
    import h5py

    return np.dtype(
        [
            ("time_s", "<f8"),
            ("kind", h5py.string_dtype("utf-8", EVENT_KIND_BYTES)),
            ("message", h5py.string_dtype("utf-8", EVENT_MESSAGE_BYTES)),
        ]
    )
