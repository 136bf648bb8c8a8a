"""Which runs of a campaign an identification may use, and why the others are left out."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dragrig.analysis.identification.results import LeftOut, counted
from dragrig.analysis.identification.spoilt import spoilt, spoilt_in_part
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.progress import Progress, silent
from dragrig.config.errors import AnalysisError, RunFileError
from dragrig.rig.runfile.campaigns import Campaign, specimen_key
from dragrig.rig.runfile.model import Run, RunInfo, Status

SLIDES_BACK = "return"


@dataclass(frozen=True, slots=True)
class Selection:
    """Runs of one specimen in the order in which it lived through them, and what was left out."""

    specimen: str
    experiments: tuple[Experiment, ...]
    left_out: tuple[LeftOut, ...] = ()
    remarks: tuple[str, ...] = field(default=())

    def of_kind(self, *kinds: str) -> tuple[Experiment, ...]:
        """Return the runs of these kinds."""
        return tuple(one for one in self.experiments if one.kind in kinds)


Choice = Callable[[Sequence[RunInfo]], Sequence[RunInfo]]


def select(
    campaign: Path | Campaign, specimen: str | None = None, progress: Progress = silent, choice: Choice | None = None
) -> Selection:
    """Read the runs of a campaign that can be used.

    Parameters
    ----------
    campaign
        Its folder, or what `rig.runfile.campaign` just said of it.
    specimen
        Name or id of the specimen that is meant; needed where the folder holds several.
    choice
        Which of the usable runs are read; all unless given.

    Raises
    ------
    RunFileError
        When there is no such folder.
    AnalysisError
        When it holds no usable run, or runs of several specimens and none was named.
    """
    from dragrig.rig import runfile

    found = runfile.campaign(campaign) if isinstance(campaign, Path) else campaign
    folder = found.folder
    left_out = [LeftOut(path.name, str(fault).removeprefix(f"{path}: ")) for path, fault in found.unreadable]
    left_out += [LeftOut(path.name, "it is a recording that was not finished") for path in found.recordings]
    marks = {path: mark.reason for path, mark in found.marks.items()}
    if not found.runs and left_out:
        raise AnalysisError(f"{folder}: holds no run that can be read ({counted(left_out)}).")
    chosen = _of_one_specimen(found.runs, specimen, folder)
    runs: list[Run] = []
    reasons = {info.path: _not_usable(info, marks) for info in chosen}
    left_out += [LeftOut(path.name, reason) for path, reason in reasons.items() if reason]
    usable: Sequence[RunInfo] = [info for info in chosen if reasons[info.path] is None]
    usable = usable if choice is None else choice(usable)
    for done, info in enumerate(usable):
        progress(done, len(usable))
        try:
            runs.append(runfile.read_run(info.path, info))
        except RunFileError as fault:
            left_out.append(LeftOut(info.path.name, str(fault).removeprefix(f"{info.path}: ")))
    progress(len(usable), len(usable))
    return _selection(specimen_key(chosen[0]), runs, left_out, str(folder))


def select_from(runs: Iterable[Run], specimen: str | None = None) -> Selection:
    """Do the same with runs in memory; raises `AnalysisError` as `select`, and where two have one file name."""
    whole = tuple(runs)
    twice = [name for name, count in Counter(run.info.path.name for run in whole).items() if count > 1]
    if twice:
        raise AnalysisError(f"these runs: several are called {twice[0]}; identify one campaign at a time.")
    chosen = _of_one_specimen([run.info for run in whole], specimen, Path("these runs"))
    reasons = {info.path: _not_usable(info, {}) for info in chosen}
    left_out = [LeftOut(path.name, reason) for path, reason in reasons.items() if reason]
    usable = [run for run in whole if reasons.get(run.info.path, "of another specimen") is None]
    return _selection(specimen_key(chosen[0]), usable, left_out, "these runs")


def _of_one_specimen(infos: Iterable[RunInfo], specimen: str | None, where: Path) -> list[RunInfo]:
    groups: dict[str, list[RunInfo]] = {}
    for info in infos:
        groups.setdefault(specimen_key(info), []).append(info)
    if not groups:
        raise AnalysisError(f"{where}: holds no run file that can be read; name the folder of a campaign.")
    meant = [key for key, group in groups.items() if specimen in (key, str(group[0].header.specimen.get("name")))]
    if specimen is not None and not meant:
        raise AnalysisError(f"{where}: has no run of specimen {specimen!r}, only of {', '.join(sorted(groups))}.")
    if len(meant) > 1:
        raise AnalysisError(
            f"{where}: several specimens are called {specimen}; name one of {', '.join(sorted(meant))}."
        )
    if specimen is None and len(groups) > 1:
        counted = ", ".join(f"{key} ({len(group)})" for key, group in sorted(groups.items()))
        raise AnalysisError(
            f"{where}: holds runs of several specimens, whose parameters differ: {counted}; name one with --specimen."
        )
    return groups[meant[0] if meant else next(iter(groups))]


def _not_usable(info: RunInfo, marks: Mapping[Path, str]) -> str | None:
    if info.path in marks:
        return f"it is marked bad: {marks[info.path]}"
    if info.status is not Status.COMPLETE:
        return f"it is {info.status.value}, not complete"
    if info.kind == SLIDES_BACK:
        return "it is a way back, through wall that the stroke before has just slid over"
    return None


def _selection(specimen: str, runs: Iterable[Run], left_out: Iterable[LeftOut], where: str) -> Selection:
    kept: list[Experiment] = []
    dropped, remarks = list(left_out), list[str]()
    for experiment in map(Experiment, runs):
        reason = spoilt(experiment)
        if reason is not None:
            dropped.append(LeftOut(experiment.file, reason))
            continue
        kept.append(experiment)
        remarks += spoilt_in_part(experiment)
    if not kept:
        raise AnalysisError(f"{where}: no run can be used ({counted(dropped)}).")
    return Selection(specimen, tuple(kept), tuple(dropped), tuple(remarks))
