"""The runs of either side of a comparison, and which are left out and why."""

from collections.abc import Iterable, Mapping
from datetime import datetime
from functools import partial
from pathlib import Path

from dragrig.analysis.comparison.resimulated import simulated_again
from dragrig.analysis.comparison.results import Side, Source
from dragrig.analysis.identification.results import LeftOut, counted
from dragrig.config.errors import AnalysisError, RunFileError, plain
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.runfile import campaign, read_info, read_mark, read_run
from dragrig.rig.runfile.campaigns import specimen_key
from dragrig.rig.runfile.model import Run, RunInfo, Status

SLID_OVER = "it is a way back, through wall that the stroke before has just slid over; the model takes each run alone"


def side_of(path: Path, specimen: str | None = None) -> Side:
    """Look at one side: a campaign's folder, or a run file.

    A run that is named itself is meant, whatever its mark or its ending says; both are told.

    Raises
    ------
    RunFileError
        When there is no such folder or file, or a file cannot be read.
    AnalysisError
        When a folder holds no run that can be used, or several specimens and not the one that is named.
    """
    if not path.is_dir():
        return _of_file(path)
    found = campaign(path)
    left_out = [LeftOut(one.name, plain(fault).removeprefix(f"{one}: ")) for one, fault in found.unreadable]
    left_out += [LeftOut(one.name, "it is a recording that was not finished") for one in found.recordings]
    marks = {one: mark.reason for one, mark in found.marks.items()}
    return _usable(str(path), _named(path), found.runs, specimen, left_out, marks)


def side_of_runs(runs: Iterable[Run], name: str) -> Side:
    """Do the same with runs in memory."""
    held = list(runs)
    if len(held) == 1:
        return Side(name, (Source(held[0].info, partial(_itself, held[0]), _ended(held[0].info)),), (), _names(held))
    sources = tuple(Source(run.info, partial(_itself, run)) for run in held if not _ended(run.info))
    left_out = tuple(LeftOut(run.info.path.name, _ended(run.info)) for run in held if _ended(run.info))
    if not sources:
        raise AnalysisError(f"{name}: holds no complete run; give runs that ended as planned.")
    return Side(name, sources, left_out, _names(held))


def side_of_model(real: Side, model: FrictionModelSettings, name: str) -> Side:
    """Put the friction model on the other side: every run simulated again on its own motion."""
    first = min((one.info.header.start_time for one in real.runs), default=None)
    strokes = [one for one in real.runs if one.info.kind != "return"]
    sources = [Source(one.info, partial(_read_as_model, one, model, first)) for one in strokes]
    left_out = [LeftOut(one.file, SLID_OVER) for one in real.runs if one.info.kind == "return"]
    return Side(f"model {name}", tuple(sources), tuple(left_out), real.specimens, is_model=True)


def _of_file(path: Path) -> Side:
    if not path.exists():
        raise RunFileError(f"{path}: there is no such file or folder; check the path.")
    info, mark = read_info(path), read_mark(path)
    said = [f"it is marked bad: {mark.reason}"] if mark is not None else []
    said += [_ended(info)] if _ended(info) else []
    return Side(_named(path), (Source(info, partial(read_run, path), "; ".join(said)),), (), (specimen_key(info),))


def _usable(
    where: str,
    name: str,
    infos: Iterable[RunInfo],
    specimen: str | None,
    left_out: list[LeftOut],
    marks: Mapping[Path, str],
) -> Side:
    chosen = _of_specimen(list(infos), specimen, where)
    sources = []
    for info in chosen:
        reason = f"it is marked bad: {marks[info.path]}" if info.path in marks else _ended(info)
        if reason:
            left_out.append(LeftOut(info.path.name, reason))
        else:
            sources.append(Source(info, partial(read_run, info.path)))
    if not sources:
        why = f" ({counted(left_out)})" if left_out else ""
        raise AnalysisError(f"{where}: holds no run that can be compared{why}.")
    return Side(name, tuple(sources), tuple(left_out), tuple(dict.fromkeys(map(specimen_key, chosen))))


def _of_specimen(infos: list[RunInfo], specimen: str | None, where: str) -> list[RunInfo]:
    """Take the runs of one specimen; a side that has only one is taken as it is."""
    names = {word for one in infos for word in (specimen_key(one), str(one.header.specimen.get("name")))}
    if specimen is None or (specimen not in names and len({specimen_key(one) for one in infos}) < 2):
        return infos
    if specimen not in names:
        raise AnalysisError(f"{where}: has no run of specimen {specimen!r}, only of {', '.join(sorted(names))}.")
    return [one for one in infos if specimen in {specimen_key(one), str(one.header.specimen.get("name"))}]


def _ended(info: RunInfo) -> str:
    if info.status is Status.COMPLETE:
        return ""
    return f"it is {info.status.value}, not complete" + (f" ({info.reason})" if info.reason else "")


def _read_as_model(source: Source, model: FrictionModelSettings, first_run_at: datetime | None) -> Run:
    return simulated_again(source.read(), model, first_run_at)


def _itself(run: Run) -> Run:
    return run


def _names(runs: Iterable[Run]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(specimen_key(run.info) for run in runs))


def _named(path: Path) -> str:
    return path.resolve().name
