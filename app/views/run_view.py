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
"""Formats of an export by the name a person knows."""
_MAX_DEPTH = 3


@dataclass(frozen=True, slots=True)
class ShownRun:
    """A run file in a list; `settings` is all that it says of itself."""

    path: Path
    order: int
    words: str
    status: str
    bad: str
    start: str
    settings: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class ShownCampaign:
    """A folder of run files; `problems` tells of the files that cannot be read."""

    folder: Path
    runs: tuple[ShownRun, ...]
    problems: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ShownTrace:
    """A run's trace, even in time: lost samples are NaN; arrays of shape `(N,)`."""

    path: Path
    words: str
    rate_hz: float
    start_s: float
    channels: Mapping[str, npt.NDArray[np.float32]]
    filtered: Mapping[str, npt.NDArray[np.float32]]
    units: Mapping[str, str]


def campaigns_below(folder: Path) -> tuple[Path, ...]:
    """Return the folders that hold run files, this one and those some levels below, the newest names first."""
    found = {path.parent for depth in range(_MAX_DEPTH) for path in folder.glob("*/" * depth + "*.h5")}
    return tuple(sorted(found, reverse=True))


def shown_campaign(folder: Path) -> ShownCampaign:
    """Read what a campaign's runs say of themselves; raises `RunFileError`."""
    found = read_campaign(folder)
    runs = tuple(_shown_run(info, mark.reason if (mark := found.marks.get(info.path)) else "") for info in found.runs)
    problems = (*(str(error) for _, error in found.unreadable),
                *(f"{path}: is being recorded, or was left by a crash; dragrig recover finishes it"
                  for path in found.recordings))  # fmt: skip
    return ShownCampaign(folder, runs, problems)


def shown_trace(path: Path, window_s: float | None = None, order: int | None = None) -> ShownTrace:
    """Read a run's trace and filter it; raises `RunFileError`, and `AnalysisError` for a filter that cannot be."""
    info = read_info(path)
    run = read_run(path, info)
    rate = run.trace.sample_rate_hz
    usual = default_filter_settings(rate)
    window = usual.window_s if window_s is None else window_s
    samples = usual.window_samples if window is None else None
    settings = SavgolSettings(window, samples, usual.order if order is None else order)
    smooth = filter_run(run, settings).trace
    place, length = _even_grid(run)
    return ShownTrace(
        path=path,
        words=_run_label(info),
        rate_hz=rate,
        start_s=float(run.trace.time[0]) if len(run.trace.time) else 0.0,
        channels={name: _on_even_grid(values, place, length) for name, values in run.trace.channels.items()},
        filtered={name: _on_even_grid(values, place, length) for name, values in smooth.channels.items()},
        units={**run.trace.units, **smooth.units},
    )


def steady_rows(paths: Sequence[Path]) -> tuple[TableRow, ...]:
    """Measure runs; a file that cannot be read has a row that says so."""
    return tuple(map(_steady_row, paths))


def export_shown_runs(paths: Sequence[Path], folder: Path, kind: ExportFormatName) -> tuple[Path, ...]:
    """Write runs for other programs into a folder; raises `OutputError`, `RunFileError`."""
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
    told = f" {speed:g} mm/s" if isinstance(speed, int | float) else ""
    told = f" {100 * strain:g} %" if isinstance(strain, int | float) else told
    return f"{info.header.order}  {info.kind}{told}"


def _even_grid(run: Run) -> tuple[npt.NDArray[np.intp], int]:
    """Return where each sample lies on an even time axis, and how long that is."""
    time, rate = run.trace.time, run.trace.sample_rate_hz
    if len(time) == 0 or len(gap_starts(time, rate)) == 0:
        return np.arange(len(time)), len(time)
    place = np.maximum.accumulate(np.rint((time - time[0]) * rate).astype(np.intp))
    return place, int(place[-1]) + 1


def _on_even_grid(values: AnyFloatArray, place: npt.NDArray[np.intp], length: int) -> npt.NDArray[np.float32]:
    if len(place) == length:
        return np.asarray(values, dtype=np.float32)
    laid = np.full(length, np.nan, np.float32)
    laid[place] = values
    return laid
