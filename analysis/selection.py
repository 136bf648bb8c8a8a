"""Which runs of a campaign an analysis may use, and why the others are excluded."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from dragrig.analysis.estimates import Exclusion, Progress, no_progress, summarise_exclusions
from dragrig.analysis.models import Experiment
from dragrig.analysis.models.experiment import session_starts
from dragrig.analysis.segments import at_rest, in_phase
from dragrig.analysis.wording import count_text
from dragrig.config import AnalysisError, RunFileError, reason_of
from dragrig.rig import Campaign, Contact, Phase, Run, RunInfo, RunStatus, specimen_key

MAX_STAGE_MM = 1e9
MAX_INVALID_SHARE = 0.2
"""A run with a larger share of clipped or missing samples is excluded; up to it, the samples are."""
MAX_PULSE_RUNS_SHARE = 0.1
"""A pulse at the begin of a phase in more of the runs than this is of the motion."""
FAULT_KINDS = ((False, "impulse"), (True, "dropout"))
MAX_BRIDGE_ERROR_MM = 0.05
"""Where samples are missing the motion is taken as straight, with at most this error."""
BRIDGE_SPEED_WINDOW_S = 0.03
"""Time before and after missing samples over which the speed is measured."""
MIN_WRONG_SIGN_MN = 10.0
"""A force along the motion above this is neither noise nor a zero, but a wrong sign."""
MAX_UNTOUCHED_MN = 20.0
"""A capsule that nothing touches needs less force, however the stage moves."""
HELD_SHARE = 0.1
"""Motor forces of rests above this share of those of steady motion are those of a loop that holds."""
MIN_MOVING_MM_S = 0.05
SHEARED_SHARE = 0.5
MIN_BREAK_H = 2.0
"""A longer pause between runs is more than a lunch: the specimen lay by."""
BLANK_KIND, RETURN_KIND, FORCE_CHANNEL = "blank", "return", "force"

RETURN_REASON = "it is a return stroke, through wall that the stroke before has just slid over"
RunFilter = Callable[[Sequence[RunInfo]], Sequence[RunInfo]]


@dataclass(frozen=True, slots=True)
class RunSelection:
    """Runs of one specimen in the order of its history, and the excluded ones."""

    specimen: str
    experiments: tuple[Experiment, ...]
    left_out: tuple[Exclusion, ...] = ()
    remarks: tuple[str, ...] = field(default=())

    @property
    def backends(self) -> tuple[str, ...]:
        """Where the runs come from: `simulated`, `hardware`, `external`."""
        return tuple(sorted({experiment.run.info.header.backend for experiment in self.experiments}))

    def of_kind(self, *kinds: str) -> tuple[Experiment, ...]:
        """Return the runs of these kinds."""
        return tuple(experiment for experiment in self.experiments if experiment.kind in kinds)


def select_runs(
    campaign: Path | Campaign,
    specimen: str | None = None,
    progress: Progress = no_progress,
    choice: RunFilter | None = None,
) -> RunSelection:
    """Read the usable runs of a campaign.

    Parameters
    ----------
    campaign
        Its folder, or its listing by `rig.runfile.read_campaign`.
    specimen
        Name or id of the specimen; needed where the folder holds several.
    choice
        Picks the runs to read among the usable ones; default: all.

    Raises
    ------
    RunFileError
        When there is no such folder.
    AnalysisError
        When it holds no usable run, or runs of several specimens and none was named.
    """
    from dragrig.rig import runfile

    listing = runfile.read_campaign(campaign) if isinstance(campaign, Path) else campaign
    folder = listing.folder
    left_out = unusable_files(listing)
    if not listing.runs and left_out:
        raise AnalysisError(f"{folder}: holds no run that can be read ({summarise_exclusions(left_out)}).")
    chosen = _runs_of_specimen(listing.runs, specimen, str(folder))
    marks = {path: mark.reason for path, mark in listing.marks.items()}
    usable: Sequence[RunInfo] = _usable_infos(chosen, marks, left_out)
    usable = usable if choice is None else choice(usable)
    runs: list[Run] = []
    for done, info in enumerate(usable):
        progress(done, len(usable))
        try:
            runs.append(runfile.read_run(info.path, info))
        except RunFileError as error:
            left_out.append(Exclusion(info.path.name, reason_of(error).removeprefix(f"{info.path}: ")))
    progress(len(usable), len(usable))
    return _usable_selection(specimen_key(chosen[0]), runs, left_out, str(folder))


@dataclass(frozen=True, slots=True)
class PooledCampaign:
    """One of several campaigns that are evaluated together, without the runs that an earlier one of them has too."""

    campaign: Campaign
    copies: tuple[Exclusion, ...] = ()
    """The runs that it does not count."""


def pool_campaigns(folders: Sequence[Path]) -> tuple[PooledCampaign, ...]:
    """Read campaigns, attributes only, so that a run that lies in several of them counts once, in the first.

    A folder that is named twice is one campaign. A run that is marked bad in any of them is bad in all.

    Raises
    ------
    RunFileError
        When one of the folders is missing.
    """
    from dragrig.rig import read_campaign

    campaigns = [read_campaign(folder) for folder in {folder.resolve(): folder for folder in folders}.values()]
    marks = {
        run.header.run_id: campaign.marks[run.path]
        for campaign in campaigns
        for run in campaign.runs
        if run.path in campaign.marks
    }
    first: dict[str, Path] = {}
    pooled: list[PooledCampaign] = []
    for campaign in campaigns:
        earlier = dict(first)
        copies = [run for run in campaign.runs if run.header.run_id in earlier]
        own = tuple(run for run in campaign.runs if run.header.run_id not in earlier)
        first |= {run.header.run_id: run.path for run in own}
        bad = {run.path: marks[run.header.run_id] for run in own if run.header.run_id in marks}
        left_out = (
            Exclusion(run.path.name, f"it is the same run as {earlier[run.header.run_id]}, which counts once")
            for run in copies
        )
        pooled.append(PooledCampaign(replace(campaign, runs=own, marks=bad), tuple(left_out)))
    return tuple(pooled)


def select_loaded_runs(runs: Iterable[Run], specimen: str | None = None) -> RunSelection:
    """Select among runs in memory; raises `AnalysisError` as `select_runs`, and where two have one file name."""
    loaded = tuple(runs)
    repeated = [name for name, count in Counter(run.info.path.name for run in loaded).items() if count > 1]
    if repeated:
        raise AnalysisError(f"these runs: several are called {repeated[0]}; identify one campaign at a time.")
    chosen = _runs_of_specimen([run.info for run in loaded], specimen, "these runs")
    left_out: list[Exclusion] = []
    usable = {info.path for info in _usable_infos(chosen, {}, left_out)}
    return _usable_selection(
        specimen_key(chosen[0]), [run for run in loaded if run.info.path in usable], left_out, "these runs"
    )


def unusable_files(campaign: Campaign) -> list[Exclusion]:
    """Files of a campaign that are no finished, readable run."""
    unreadable = [
        Exclusion(path.name, reason_of(error).removeprefix(f"{path}: ")) for path, error in campaign.unreadable
    ]
    return unreadable + [Exclusion(path.name, "it is an unfinished recording") for path in campaign.recordings]


def incomplete_reason(info: RunInfo) -> str:
    """Why a run is not complete; empty for a complete one."""
    if info.status is RunStatus.COMPLETE:
        return ""
    return f"it is {info.status.value}, not complete" + (f" ({info.reason})" if info.reason else "")


def _usable_infos(infos: Iterable[RunInfo], marks: Mapping[Path, str], left_out: list[Exclusion]) -> Sequence[RunInfo]:
    """Return the runs that are not marked bad, incomplete, return strokes or copies; add the others to `left_out`.

    A copy would be fitted and held out at once, so that it counts twice in every share and interval.
    """
    usable = []
    first_of_run: dict[str, str] = {}
    infos = tuple(infos)
    marked = {info.header.run_id: (info.path, marks[info.path]) for info in infos if info.path in marks}
    for info in infos:
        reason = f"it is marked bad: {marks[info.path]}" if info.path in marks else incomplete_reason(info)
        if not reason and info.kind == RETURN_KIND:
            reason = RETURN_REASON
        if not reason and info.header.run_id in marked:
            path, why = marked[info.header.run_id]
            reason = f"it is the same run as {path.name}, which is marked bad: {why}"
        if not reason and info.header.run_id in first_of_run:
            reason = f"it is the same run as {first_of_run[info.header.run_id]}, which counts once"
        if reason:
            left_out.append(Exclusion(info.path.name, reason))
        else:
            first_of_run[info.header.run_id] = info.path.name
            usable.append(info)
    return usable


def _runs_of_specimen(infos: Iterable[RunInfo], specimen: str | None, where: str) -> list[RunInfo]:
    groups: dict[str, list[RunInfo]] = {}
    for info in infos:
        groups.setdefault(specimen_key(info), []).append(info)
    if not groups:
        raise AnalysisError(f"{where}: holds no run file that can be read; name the folder of a campaign.")
    if specimen is None and len(groups) > 1:
        counts = ", ".join(f"{key} ({len(group)})" for key, group in sorted(groups.items()))
        raise AnalysisError(
            f"{where}: holds runs of several specimens, whose parameters differ: {counts}; name one with --specimen."
        )
    if specimen is None:
        return next(iter(groups.values()))
    matching = [key for key, group in groups.items() if specimen in (key, str(group[0].header.specimen.get("name")))]
    if not matching:
        raise AnalysisError(f"{where}: has no run of specimen {specimen!r}, only of {', '.join(sorted(groups))}.")
    if len(matching) > 1:
        raise AnalysisError(
            f"{where}: several specimens are called {specimen}; name one of {', '.join(sorted(matching))}."
        )
    return groups[matching[0]]


def _usable_selection(specimen: str, runs: Iterable[Run], left_out: Iterable[Exclusion], where: str) -> RunSelection:
    usable: list[Experiment] = []
    excluded, remarks = list(left_out), list[str]()
    for experiment in _with_shared_facts([Experiment(run) for run in runs]):
        reason = unusable_reason(experiment)
        if reason is not None:
            excluded.append(Exclusion(experiment.file, reason))
            continue
        usable.append(experiment)
        if invalid := int(np.count_nonzero(~experiment.valid & ~experiment.faulty)):
            remarks.append(f"{experiment.file}: {invalid} samples are clipped or missing (NaN) and were ignored")
    if not usable:
        raise AnalysisError(f"{where}: no run can be used ({summarise_exclusions(excluded)}).")
    return RunSelection(
        specimen, tuple(usable), tuple(excluded), (*remarks, *_break_remarks(usable), *_fault_remarks(usable))
    )


def _break_remarks(experiments: Sequence[Experiment]) -> Iterator[str]:
    """Say where a specimen lay by between two sessions: its age goes on meanwhile, and nobody looked."""
    if session_starts(experiments) is None:
        return
    infos = sorted((experiment.run.info for experiment in experiments), key=lambda info: info.header.start_time)
    breaks = [
        (later, hours)
        for earlier, later in pairwise(infos)
        if (hours := (later.header.start_time - (earlier.end_time or earlier.header.start_time)).total_seconds() / 3600)
        > MIN_BREAK_H
    ]
    if breaks:
        pauses = ", ".join(f"{hours:.1f} h before {info.path.name}" for info, hours in breaks)
        yield (
            f"the runs were made in {len(breaks) + 1} sessions, with breaks of {pauses}: time goes on in a break, so "
            "that whatever changed in it (the tissue, how it was mounted again, the sensor) looks like a change with "
            "session time; a specimen that was taken out and is to count as another needs an id of its own"
        )


def _with_shared_facts(experiments: Sequence[Experiment]) -> list[Experiment]:
    """Tell each run of others: the clock's jitter, a soft loop, a drive that holds, phases without a pulse."""
    runs_with_pulse = Counter(
        phase for experiment in experiments for phase in {pulse.near_phase for pulse in experiment.pulses}
    )
    enough = max(1.0, MAX_PULSE_RUNS_SHARE * len(experiments))
    calm = frozenset(
        phase for phase, runs in runs_with_pulse.items() if phase is not None and runs <= enough < len(experiments) / 2
    )
    jitters = [jitter for experiment in experiments if (jitter := experiment.own_jitter_s) is not None]
    shared = float(np.median(jitters)) if jitters else 0.0
    soft, holds = any(experiment.gives_way for experiment in experiments), _drive_holds(experiments)
    return [
        replace(experiment, calm_phases=calm, shared_jitter_s=shared, soft_loop=soft, drive_holds=holds)
        if soft or holds or experiment.pulses or (shared and experiment.own_jitter_s is None)
        else experiment
        for experiment in experiments
    ]


def _drive_holds(experiments: Sequence[Experiment]) -> bool:
    """Whether the motor force of some rest exceeds a share of that of steady motion."""
    held = [force for experiment in experiments for force in experiment.held_forces]
    if not held:
        return False
    traces = [experiment.run.trace for experiment in experiments if experiment.held_forces]
    moving = np.concatenate([trace.channels["motor_force"][in_phase(trace, Phase.STEADY)] for trace in traces])
    return bool(moving.size) and max(map(abs, held)) > HELD_SHARE * float(np.nanmedian(np.abs(moving)))


def _fault_remarks(experiments: Iterable[Experiment]) -> Iterator[str]:
    """Say once which faults single samples have, in which runs, and how much of it."""
    faulty = [experiment for experiment in experiments if experiment.faults]
    if not faulty:
        return
    faults = [pulse for experiment in faulty for pulse in experiment.faults]
    impulses, dropouts = (
        count_text(sum(pulse.dropout == kind for pulse in faults), name) for kind, name in FAULT_KINDS
    )
    found = [text for text in (impulses, dropouts) if not text.startswith("0 ")]
    samples = sum(int(experiment.faulty.sum()) for experiment in faulty)
    runs = faulty[0].file if len(faulty) == 1 else f"{len(faulty)} runs, {faulty[0].file} the first"
    largest = max(pulse.height_mN for pulse in faults)
    yield (
        f"the force has {' and '.join(found)} of up to {largest:.3g} mN, {samples} samples in {runs}, which were "
        "ignored: no rig moves so; look for a loose contact, or for switching nearby"
    )


def unusable_reason(experiment: Experiment) -> str | None:
    """Return why the samples of a run cannot be used; None where they can."""
    if not experiment.valid.size:
        return "it has no samples"
    invalid = 1.0 - float(np.mean(experiment.valid))
    if invalid > MAX_INVALID_SHARE:
        return f"{invalid:.0%} of its samples are clipped or missing (NaN)"
    if not np.isfinite(experiment.run.trace.position).any():
        return "its positions are missing (NaN), so that its motion is not known"
    if (largest := float(np.nanmax(np.abs(experiment.run.trace.position)))) > MAX_STAGE_MM:
        return f"its positions reach {largest:.1g} mm, which no stage does"
    try:
        _ = experiment.motion, experiment.fixture
    except AnalysisError as error:
        return str(error).removeprefix(f"{experiment.file}: ")
    checks: Iterator[str | None] = (check(experiment) for check in (_constant_force, _motion_in_gap, _wrong_sign))
    return next((reason for reason in checks if reason), None)


def _constant_force(experiment: Experiment) -> str | None:
    values = experiment.run.trace.force[experiment.valid]
    measures = experiment.imported or experiment.contact is not Contact.NONE
    if measures and float(np.ptp(values)) == 0.0:
        return "its force never changes, so that nothing was measured; check the sensor's cable and channel"
    return None


def _motion_in_gap(experiment: Experiment) -> str | None:
    """Whether the stage changes speed while samples are missing: its motion is then not known."""
    time, position = experiment.recorded
    steps = np.diff(time)
    for last in np.flatnonzero(steps > 1.5 / experiment.run.trace.sample_rate_hz).tolist():
        first = last + 1
        before = np.searchsorted(time, time[last] - BRIDGE_SPEED_WINDOW_S)
        after = np.searchsorted(time, time[first] + BRIDGE_SPEED_WINDOW_S) - 1
        if last == before or after == first:
            continue
        chord = (position[first] - position[last]) / steps[last]
        entering = (position[last] - position[before]) / (time[last] - time[before])
        leaving = (position[after] - position[first]) / (time[after] - time[first])
        # A parabola with these slopes at its ends deviates from its chord by a quarter of this.
        error_mm = 0.25 * steps[last] * max(abs(entering - chord), abs(leaving - chord))
        if error_mm > MAX_BRIDGE_ERROR_MM:
            return (
                f"samples are missing for {steps[last]:.3g} s at {time[last]:.3g} s while its stage changes speed, so "
                "that its motion is not known"
            )
    return None


def _wrong_sign(experiment: Experiment) -> str | None:
    """Whether the force cannot be friction of the stated capsule."""
    opposing = _mean_opposing_force(experiment)
    if opposing is None:
        return None
    if experiment.contact is Contact.NONE:
        # A foreign measurement does not state its fixture.
        if experiment.imported or experiment.kind == BLANK_KIND or abs(opposing) < MAX_UNTOUCHED_MN:
            return None
        return f"its fixture is none, yet moving takes {opposing:.0f} mN: something held the capsule"
    if opposing > -MIN_WRONG_SIGN_MN:
        return None
    return (
        f"its force points along the motion ({-opposing:.0f} mN) instead of against it: force or position has the "
        "wrong sign"
    )


def _mean_opposing_force(experiment: Experiment) -> float | None:
    """Mean force [mN] against the motion, relative to the rest."""
    trace = experiment.run.trace
    rest = at_rest(trace) & experiment.valid
    if FORCE_CHANNEL not in trace.channels or not rest.any():
        return None
    force = np.asarray(trace.channels[FORCE_CHANNEL], dtype=np.float64)
    usable = experiment.valid & np.isfinite(force)
    if experiment.contact is Contact.STICKING:
        shear = experiment.position(experiment.time_s)
        direction = np.where(np.abs(shear) > SHEARED_SHARE * np.abs(shear).max(), np.sign(shear), 0.0)
    else:
        velocity = experiment.velocity(experiment.time_s)
        direction = np.where(np.abs(velocity) > MIN_MOVING_MM_S, np.sign(velocity), 0.0)
    moving = usable & (direction != 0)
    if not moving.any():
        return None
    return float(np.mean((force[moving] - float(np.mean(force[rest & usable]))) * direction[moving]))
