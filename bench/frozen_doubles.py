"""What is kept of a run on the doubles of the hardware, whose motion begins with the jitter of a serial line.

Command, phase and time are the same in every call and are kept as digests; force and position only as means over each
phase that lasts, within what the jitter of some milliseconds does to them.
"""

from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np
from frozen_values import Cleaner, Json, digest
from numpy.typing import NDArray

LASTS_S = 0.4
"""Phases of at least this duration have a mean."""

WITHIN = {
    "command_t0_uncertainty_s": 0.2,
    "following_error_mm": 1.0,
    "insertion_dwell_s": 1.0,
    "origin_mm": 0.01,
    "rest_noise_mN": 0.3,
    "rest_offset_mN": 3.0,
    "slip_time_s": 1.0,
}
"""What an attribute may differ by from call to call."""

FORCE_WITHIN_MN, POSITION_WITHIN_MM, MOVING_WITHIN_MM = 3.0, 0.02, 1.0
"""While it moves, a stage that was sent off milliseconds late is behind by up to what the guard allows."""
RESTING = ("0", "4")
"""Phases in which the stage stands: rest and hold."""
EXACT = ("command", "phase", "time")
LEFT_OUT = ("entry/run/settings", "entry/run/events")
"""Settings are those of the simulated runs and name a port; events carry the time of the jitter."""


def double_run(path: Path, cleaner: Cleaner) -> Json:
    """Return what is the same in every call of a run on the doubles."""
    result: dict[str, Json] = {}
    with h5py.File(path) as file:

        def visit(name: str, node: h5py.Group | h5py.Dataset) -> None:
            result[f"{name} attributes"] = _attributes(cleaner.value(dict(node.attrs)))
            if isinstance(node, h5py.Dataset) and name not in LEFT_OUT:
                result[name] = _dataset(name.rpartition("/")[2], node, file["entry/trace"])

        file.visititems(visit)
    return result


def _attributes(values: Json) -> Json:
    assert isinstance(values, Mapping)
    return {key: {"about": value, "within": WITHIN[key]} if key in WITHIN else value for key, value in values.items()}


def _dataset(name: str, node: h5py.Dataset, trace: h5py.Group) -> Json:
    if name in EXACT:
        return digest(node[()])
    means = _means(node[()], trace["phase"][()], float(trace.attrs["sample_rate_hz"]))
    about: dict[str, Json] = {phase: {"about": mean, "within": _within(name, phase)} for phase, mean in means.items()}
    return {"dtype": str(node.dtype), "means": about}


def _within(name: str, phase: str) -> float:
    if name != "position":
        return FORCE_WITHIN_MN
    return POSITION_WITHIN_MM if phase in RESTING else MOVING_WITHIN_MM


def _means(values: NDArray[np.float32], phases: NDArray[np.uint8], rate_hz: float) -> dict[str, float]:
    """Return the mean of each phase that lasts, without the first and last tenth of it."""
    result = {}
    for phase in np.unique(phases):
        chosen = np.flatnonzero(phases == phase)
        edge = chosen.size // 10
        if chosen.size >= LASTS_S * rate_hz:
            result[str(phase)] = float(values[chosen[edge : chosen.size - edge]].mean(dtype=np.float64))
    return result
