"""Which runs of a campaign an analysis may use, and why the others are excluded."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dragrig.analysis.computation import Progress, no_progress
from dragrig.analysis.estimates import Exclusion, summarise_exclusions
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.segments import at_rest
from dragrig.config.errors import AnalysisError, RunFileError
from dragrig.rig.devices import Contact
from dragrig.rig.runfile.campaigns import Campaign, specimen_key
from dragrig.rig.runfile.model import Run, RunInfo, RunStatus

MAX_INVALID_SHARE = 0.2
"""A run more of whose samples are clipped or missing is left out; fewer are left out of the run."""
MAX_BRIDGE_ERROR_MM = 0.05
"""Where samples are missing the motion is taken for straight; it may be wrong by this."""
BRIDGE_SPEED_WINDOW_S = 0.03
"""So long before and after missing samples the speed is looked at."""
MIN_WRONG_SIGN_MN = 10.0
"""A force along the motion by more than this is no noise and no zero, but a wrong sign."""
BLANK_KIND = "blank"
MAX_UNTOUCHED_MN = 20.0
"""A capsule that nothing touches does not take as much, whatever the stage does."""
MIN_MOVING_MM_S = 0.05
SHEARED_SHARE = 0.5
FORCE_CHANNEL = "force"


def unusable_reason(experiment: Experiment) -> str | None:
    """Return why a run cannot be used, None where it can."""
    if not experiment.valid.size:
        return "it has no samples"
    bad = 1.0 - float(np.mean(experiment.valid))
    if bad > MAX_INVALID_SHARE:
        return f"{bad:.0%} of its samples are clipped or missing (NaN)"
    if not np.isfinite(experiment.run.trace.position).any():
        return "its positions are missing (NaN), so that its motion is not known"
    try:
        _ = experiment.motion, experiment.fixture
    except AnalysisError as fault:
        return str(fault).removeprefix(f"{experiment.file}: ")
    checks: tuple[Callable[[Experiment], str | None], ...] = (_constant_force, _motion_in_gap, _wrong_sign)
    return next((reason for reason in (check(experiment) for check in checks) if reason), None)


def partial_loss_remarks(experiment: Experiment) -> Iterator[str]:
    """Yield what of a run is not used."""
    bad = int(np.count_nonzero(~experiment.valid))
    if bad:
        yield f"{experiment.file}: {bad} samples are clipped or missing (NaN) and were left out"


def _constant_force(experiment: Experiment) -> str | None:
    values = experiment.run.trace.force[experiment.valid]
    if experiment.contact is not Contact.NONE and float(np.ptp(values)) == 0.0:
        return "its force never changes, so that nothing was measured; check the sensor's cable and channel"
    return None


def _motion_in_gap(experiment: Experiment) -> str | None:
    """Say so where the stage speeds up or slows down while samples are missing: what it did then is not known."""
    position = np.asarray(experiment.run.trace.position, dtype=np.float64)
    seen = np.isfinite(position)
    time, position = experiment.time_s[seen], position[seen]
    steps = np.diff(time)
    for at in np.flatnonzero(steps > 1.5 / experiment.run.trace.sample_rate_hz).tolist():
        before = np.searchsorted(time, time[at] - BRIDGE_SPEED_WINDOW_S)
        after = np.searchsorted(time, time[at + 1] + BRIDGE_SPEED_WINDOW_S) - 1
        if at == before or after == at + 1:
            continue
        chord = (position[at + 1] - position[at]) / steps[at]
        entering = (position[at] - position[before]) / (time[at] - time[before])
        leaving = (position[after] - position[at + 1]) / (time[after] - time[at + 1])
        # A parabola with these slopes at its ends strays from its chord by a quarter of this.
        unknown = 0.25 * steps[at] * max(abs(entering - chord), abs(leaving - chord))
        if unknown > MAX_BRIDGE_ERROR_MM:
            return (
                f"samples are missing for {steps[at]:.3g} s at {time[at]:.3g} s while its stage changes speed, so "
                "that its motion is not known"
            )
    return None


def _wrong_sign(experiment: Experiment) -> str | None:
    """Say so where the force cannot be friction on what the run says was there."""
    against = _mean_opposing_force(experiment)
    if against is None:
        return None
    if experiment.contact is Contact.NONE:
        if experiment.kind == BLANK_KIND or abs(against) < MAX_UNTOUCHED_MN:
            return None
        return f"its fixture is none, yet moving takes {against:.0f} mN: something held the capsule"
    if against > -MIN_WRONG_SIGN_MN:
        return None
    return (
        f"its force points along the motion ({-against:.0f} mN) instead of against it: force or position has the "
        "wrong sign"
    )


def _mean_opposing_force(experiment: Experiment) -> float | None:
    """Return the mean force [mN] against the motion, that at rest taken off."""
    trace = experiment.run.trace
    rest = at_rest(trace) & experiment.valid
    if FORCE_CHANNEL not in trace.channels or not rest.any():
        return None
    force = np.asarray(trace.channels[FORCE_CHANNEL], dtype=np.float64)
    usable = experiment.valid & np.isfinite(force)
    if experiment.contact is Contact.STICKING:
        shear = experiment.position(experiment.time_s)
        way = np.where(np.abs(shear) > SHEARED_SHARE * np.abs(shear).max(), np.sign(shear), 0.0)
    else:
        velocity = experiment.velocity(experiment.time_s)
        way = np.where(np.abs(velocity) > MIN_MOVING_MM_S, np.sign(velocity), 0.0)
    moving = usable & (way != 0)
    if not moving.any():
        return None
    return float(np.mean((force[moving] - float(np.mean(force[rest & usable]))) * way[moving]))


RETURN_KIND = "return"


@dataclass(frozen=True, slots=True)
class RunSelection:
    """Runs of one specimen in the order in which it lived through them, and what was left out."""

    specimen: str
    experiments: tuple[Experiment, ...]
    left_out: tuple[Exclusion, ...] = ()
    remarks: tuple[str, ...] = field(default=())

    def of_kind(self, *kinds: str) -> tuple[Experiment, ...]:
        """Return the runs of these kinds."""
        return tuple(one for one in self.experiments if one.kind in kinds)


RunFilter = Callable[[Sequence[RunInfo]], Sequence[RunInfo]]


def select_runs(
    campaign: Path | Campaign,
    specimen: str | None = None,
    progress: Progress = no_progress,
    choice: RunFilter | None = None,
) -> RunSelection:
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

    found = runfile.read_campaign(campaign) if isinstance(campaign, Path) else campaign
    folder = found.folder
    left_out = [Exclusion(path.name, str(fault).removeprefix(f"{path}: ")) for path, fault in found.unreadable]
    left_out += [Exclusion(path.name, "it is a recording that was not finished") for path in found.recordings]
    marks = {path: mark.reason for path, mark in found.marks.items()}
    if not found.runs and left_out:
        raise AnalysisError(f"{folder}: holds no run that can be read ({summarise_exclusions(left_out)}).")
    chosen = _runs_of_specimen(found.runs, specimen, folder)
    runs: list[Run] = []
    reasons = {info.path: _exclusion_reason(info, marks) for info in chosen}
    left_out += [Exclusion(path.name, reason) for path, reason in reasons.items() if reason]
    usable: Sequence[RunInfo] = [info for info in chosen if reasons[info.path] is None]
    usable = usable if choice is None else choice(usable)
    for done, info in enumerate(usable):
        progress(done, len(usable))
        try:
            runs.append(runfile.read_run(info.path, info))
        except RunFileError as fault:
            left_out.append(Exclusion(info.path.name, str(fault).removeprefix(f"{info.path}: ")))
    progress(len(usable), len(usable))
    return _usable_selection(specimen_key(chosen[0]), runs, left_out, str(folder))


def select_loaded_runs(runs: Iterable[Run], specimen: str | None = None) -> RunSelection:
    """Do the same with runs in memory; raises `AnalysisError` as `select_runs`, and where two have one file name."""
    whole = tuple(runs)
    twice = [name for name, count in Counter(run.info.path.name for run in whole).items() if count > 1]
    if twice:
        raise AnalysisError(f"these runs: several are called {twice[0]}; identify one campaign at a time.")
    chosen = _runs_of_specimen([run.info for run in whole], specimen, Path("these runs"))
    reasons = {info.path: _exclusion_reason(info, {}) for info in chosen}
    left_out = [Exclusion(path.name, reason) for path, reason in reasons.items() if reason]
    usable = [run for run in whole if reasons.get(run.info.path, "of another specimen") is None]
    return _usable_selection(specimen_key(chosen[0]), usable, left_out, "these runs")


def _runs_of_specimen(infos: Iterable[RunInfo], specimen: str | None, where: Path) -> list[RunInfo]:
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


def _exclusion_reason(info: RunInfo, marks: Mapping[Path, str]) -> str | None:
    if info.path in marks:
        return f"it is marked bad: {marks[info.path]}"
    if info.status is not RunStatus.COMPLETE:
        return f"it is {info.status.value}, not complete"
    if info.kind == RETURN_KIND:
        return "it is a way back, through wall that the stroke before has just slid over"
    return None


def _usable_selection(specimen: str, runs: Iterable[Run], left_out: Iterable[Exclusion], where: str) -> RunSelection:
    kept: list[Experiment] = []
    dropped, remarks = list(left_out), list[str]()
    for experiment in map(Experiment, runs):
        reason = unusable_reason(experiment)
        if reason is not None:
            dropped.append(Exclusion(experiment.file, reason))
            continue
        kept.append(experiment)
        remarks += partial_loss_remarks(experiment)
    if not kept:
        raise AnalysisError(f"{where}: no run can be used ({summarise_exclusions(dropped)}).")
    return RunSelection(specimen, tuple(kept), tuple(dropped), tuple(remarks))
