"""Run files as the window shows them: campaigns, settings, filtered traces, steady forces, export."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dragrig.analysis.campaign_table import TableRow, table_row
from dragrig.analysis.savgol import SavgolSettings, default_filter_settings, filter_run
from dragrig.analysis.segments import gap_starts
from dragrig.api.evaluate import ExportFormatName
from dragrig.api.evaluate import export as export_runs
from dragrig.config.errors import RunFileError
from dragrig.rig.arrays import AnyFloatArray
from dragrig.rig.runfile import read_campaign, read_info, read_mark, read_run
from dragrig.rig.runfile.model import Run, RunInfo

FORMATS: Mapping[str, ExportFormatName] = {"CSV": "csv", "Parquet": "parquet", "MATLAB": "mat", "NumPy": "npz"}
"""Export formats by name."""
_MAX_DEPTH = 3


@dataclass(frozen=True, slots=True)
class ShownRun:
    """A run file in the browser, with all its settings."""

    path: Path
    order: int
    label: str
    status: str
    bad: str
    start: str
    settings: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class ShownCampaign:
    """A folder of run files; `problems` lists the files that cannot be read."""

    folder: Path
    runs: tuple[ShownRun, ...]
    problems: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ShownTrace:
    """A run's trace at even times, NaN for lost samples; arrays of shape `(N,)`."""

    path: Path
    label: str
    rate_hz: float
    start_s: float
    channels: Mapping[str, npt.NDArray[np.float32]]
    filtered: Mapping[str, npt.NDArray[np.float32]]
    units: Mapping[str, str]


def campaigns_below(folder: Path) -> tuple[Path, ...]:
    """Return this folder and those below that hold run files, in descending order of name."""
    found = {path.parent for depth in range(_MAX_DEPTH) for path in folder.glob("*/" * depth + "*.h5")}
    return tuple(sorted(found, reverse=True))


def shown_campaign(folder: Path) -> ShownCampaign:
    """Read the runs' settings of a campaign; raises `RunFileError`."""
    campaign = read_campaign(folder)
    runs = tuple(
        _shown_run(info, mark.reason if (mark := campaign.marks.get(info.path)) else "") for info in campaign.runs
    )
    problems = (*(str(error) for _, error in campaign.unreadable),
                *(f"{path}: is being recorded, or was left by a crash; dragrig recover finishes it"
                  for path in campaign.recordings))  # fmt: skip
    return ShownCampaign(folder, runs, problems)


def shown_trace(path: Path, window_s: float | None = None, order: int | None = None) -> ShownTrace:
    """Read a run's trace and filter it; raises `RunFileError`, and `AnalysisError` for an impossible filter."""
    info = read_info(path)
    run = read_run(path, info)
    rate = run.trace.sample_rate_hz
    default = default_filter_settings(rate)
    window = default.window_s if window_s is None else window_s
    samples = default.window_samples if window is None else None
    settings = SavgolSettings(window, samples, default.order if order is None else order)
    smooth = filter_run(run, settings).trace
    indices, length = _even_grid(run)
    return ShownTrace(
        path=path,
        label=_run_label(info),
        rate_hz=rate,
        start_s=float(run.trace.time[0]) if len(run.trace.time) else 0.0,
        channels={name: _on_even_grid(values, indices, length) for name, values in run.trace.channels.items()},
        filtered={name: _on_even_grid(values, indices, length) for name, values in smooth.channels.items()},
        units={**run.trace.units, **smooth.units},
    )


def steady_rows(paths: Sequence[Path]) -> tuple[TableRow, ...]:
    """Measure runs; an unreadable file has a row with the error."""
    return tuple(map(_steady_row, paths))


def export_shown_runs(paths: Sequence[Path], folder: Path, kind: ExportFormatName) -> tuple[Path, ...]:
    """Export runs to a folder; raises `OutputError`, `RunFileError`."""
    written: list[Path] = []
    for path in paths:
        written.extend(export_runs(path, folder, format=kind))
    return tuple(written)


def _steady_row(path: Path) -> TableRow:
    try:
        mark = read_mark(path)
        return table_row(read_run(path), mark.reason if mark else None)
    except RunFileError as error:
        return TableRow(path.name, status="unreadable", remark=str(error))


def _shown_run(info: RunInfo, bad: str) -> ShownRun:
    header = info.header
    settings = {"file": info.path.name, "status": info.status.value, "reason": info.reason, "backend": header.backend,
                "samples": str(info.samples), "rate": f"{header.sample_rate_hz:g} Hz"}  # fmt: skip
    for group in (header.protocol, header.capsule, header.specimen, header.entry, info.checks):
        settings |= {key: f"{value:g}" if isinstance(value, float) else str(value) for key, value in group.items()}
    start = f"{header.start_time:%Y-%m-%d %H:%M:%S}"
    return ShownRun(info.path, header.order, _run_label(info), info.status.value, bad, start, settings)


def _run_label(info: RunInfo) -> str:
    protocol = info.header.protocol
    speed, strain = protocol.get("speed_mm_s"), protocol.get("shear_strain")
    value = f" {speed:g} mm/s" if isinstance(speed, int | float) else ""
    value = f" {100 * strain:g} %" if isinstance(strain, int | float) else value
    return f"{info.header.order}  {info.kind}{value}"


def _even_grid(run: Run) -> tuple[npt.NDArray[np.intp], int]:
    """Return each sample's index on an even time axis, and the length of that axis."""
    time, rate = run.trace.time, run.trace.sample_rate_hz
    if len(time) == 0 or len(gap_starts(time, rate)) == 0:
        return np.arange(len(time)), len(time)
    indices = np.maximum.accumulate(np.rint((time - time[0]) * rate).astype(np.intp))
    return indices, int(indices[-1]) + 1


def _on_even_grid(values: AnyFloatArray, indices: npt.NDArray[np.intp], length: int) -> npt.NDArray[np.float32]:
    if len(indices) == length:
        return np.asarray(values, dtype=np.float32)
    even = np.full(length, np.nan, np.float32)
    even[indices] = values
    return even
