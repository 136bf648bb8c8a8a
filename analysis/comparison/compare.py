"""The two sides of a comparison, and how their runs are measured, paired and compared.

A side holds recorded runs, or the same runs as the friction model computes them.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from itertools import groupby
from math import sqrt
from operator import itemgetter
from pathlib import Path

import numpy as np

from dragrig.analysis import (
    FRICTION_SCATTER,
    NORMAL_95,
    RETURN_KIND,
    STIFFNESS_SCATTER,
    Estimate,
    Exclusion,
    Experiment,
    Progress,
    RunMeasures,
    acquisition_of,
    count_text,
    in_phase,
    incomplete_reason,
    join_names,
    measure,
    no_progress,
    summarise_exclusions,
    unusable_files,
    value_with_error,
)
from dragrig.analysis.comparison.comparison import (
    ABOVE_REST,
    HOLD_FORCE,
    PEAK_FORCE,
    REST_FORCE,
    STEADY_FORCE,
    STEADY_SPEED,
    AlignedRuns,
    ComparedRun,
    ComparedSide,
    Comparison,
    DifferenceVerdict,
    FollowingError,
    GroupDifference,
    MeasureDifference,
    MotionDifference,
    PhaseDifference,
    RunCondition,
    RunPair,
    align_runs,
    run_condition,
    secondary_differences,
)
from dragrig.config import (
    AnalysisError,
    DragrigError,
    Fixture,
    FrictionModelSettings,
    NoiseSettings,
    RunFileError,
    reason_of,
)
from dragrig.rig import (
    PHASE_NAMES,
    FloatArray,
    Phase,
    Run,
    RunInfo,
    read_campaign,
    read_info,
    read_mark,
    read_run,
    specimen_key,
)
from dragrig.sim_backend.effects import EffectChain, evaluation_rate_hz, evaluation_times, gut_run_state
from dragrig.sim_backend.friction import prepare

RETURN_REASON = (
    "it is a return stroke, through wall that the stroke before has just slid over; the model takes each run alone"
)


def side_from_path(path: Path, specimen: str | None = None) -> ComparedSide:
    """Take a campaign's folder or a run file as one side.

    A run file is used whatever its mark or status; both become its remark.

    Raises
    ------
    RunFileError
        When there is no such folder or file, or a file cannot be read.
    AnalysisError
        When a folder holds no usable run, or several specimens and not the named one.
    """
    name = path.resolve().name
    if not path.is_dir():
        if not path.exists():
            raise RunFileError(f"{path}: there is no such file or folder; check the path.")
        info, mark = read_info(path), read_mark(path)
        remarks = (f"it is marked bad: {mark.reason}" if mark is not None else "", incomplete_reason(info))
        run = ComparedRun(info, partial(read_run, path), "; ".join(filter(None, remarks)))
        return ComparedSide(name, (run,), (), (specimen_key(info),))
    campaign = read_campaign(path)
    left_out = unusable_files(campaign)
    chosen = _runs_of_specimen(campaign.runs, specimen, path)
    runs = []
    for info in chosen:
        mark = campaign.marks.get(info.path)
        reason = f"it is marked bad: {mark.reason}" if mark is not None else incomplete_reason(info)
        if reason:
            left_out.append(Exclusion(info.path.name, reason))
        else:
            runs.append(ComparedRun(info, partial(read_run, info.path)))
    if not runs:
        reasons = f" ({summarise_exclusions(left_out)})" if left_out else ""
        raise AnalysisError(f"{path}: holds no run that can be compared{reasons}.")
    return ComparedSide(name, tuple(runs), tuple(left_out), _specimens(chosen))


def _runs_of_specimen(infos: Sequence[RunInfo], specimen: str | None, path: Path) -> Sequence[RunInfo]:
    """Return the runs of the named specimen; all runs of a campaign that has only one specimen, whatever its name."""

    def names(info: RunInfo) -> set[str]:
        return {specimen_key(info), str(info.header.specimen.get("name"))}

    if specimen is None:
        return infos
    matching = [info for info in infos if specimen in names(info)]
    if matching or len(_specimens(infos)) < 2:
        return matching or infos
    known = sorted(set().union(*map(names, infos)))
    raise AnalysisError(f"{path}: has no run of specimen {specimen!r}, only of {', '.join(known)}.")


def side_from_runs(runs: Iterable[Run], name: str) -> ComparedSide:
    """Take runs in memory as one side; raises `AnalysisError` where none of several is complete."""
    loaded = tuple(ComparedRun(run.info, partial(_itself, run), incomplete_reason(run.info)) for run in runs)
    specimens = _specimens(run.info for run in loaded)
    if len(loaded) == 1:
        return ComparedSide(name, loaded, (), specimens)
    usable = tuple(run for run in loaded if not run.remark)
    if not usable:
        raise AnalysisError(f"{name}: holds no complete run; give runs that ended as planned.")
    left_out = tuple(Exclusion(run.file, run.remark) for run in loaded if run.remark)
    return ComparedSide(name, usable, left_out, specimens)


def model_side(recorded: ComparedSide, model: FrictionModelSettings, name: str) -> ComparedSide:
    """Take the friction model as the other side: every run simulated again on its own motion."""
    first_run_at = min((run.info.header.start_time for run in recorded.runs), default=None)

    def simulated(run: ComparedRun) -> Run:
        return resimulate(run.read(), model, first_run_at)

    return ComparedSide(
        f"model {name}",
        tuple(ComparedRun(run.info, partial(simulated, run)) for run in recorded.runs if run.info.kind != RETURN_KIND),
        tuple(Exclusion(run.file, RETURN_REASON) for run in recorded.runs if run.info.kind == RETURN_KIND),
        recorded.specimens,
        is_model=True,
    )


def resimulate(run: Run, model: FrictionModelSettings, first_run_at: datetime | None = None) -> Run:
    """Return the run with the model's force in place of the recorded one; filtered traces and checks are dropped.

    Position, command and phases stay: the model is driven by the recorded motion, so that errors of the drive
    cause no differences of the force. For the same reason effects of the model in motor and encoder are ignored.

    Parameters
    ----------
    first_run_at
        When the specimen's first run began, for effects that depend on the session's clock; default: this run.

    Raises
    ------
    AnalysisError
        One sentence, where the run lacks a part that the model needs.
    SettingsError
        Where the published wall parameters do not reach the strain of the run.
    """
    if run.trace.signal != "force":
        raise AnalysisError(f"it records {run.trace.signal}, which the friction model does not predict")
    experiment = Experiment(run)
    time_s = experiment.time_s
    if model.effects:
        started = run.info.header.start_time
        since_first_s = (started - (first_run_at or started)).total_seconds()
        chain = EffectChain.of(model)
        duration_s = float(time_s[-1])
        times = evaluation_times(duration_s, evaluation_rate_hz(run.trace.sample_rate_hz, duration_s))
        state = gut_run_state(acquisition_of(experiment), model, experiment.motion, times, since_first_s)
        force = chain.measured_force(state, chain.load(state), model.force_gain)
        force = np.asarray(np.interp(time_s, times, force))
    else:
        force = prepare(acquisition_of(experiment), model, experiment.motion).force(time_s)
    trace = replace(run.trace, channels={"force": force, "position": run.trace.position}, units=dict(run.trace.units))
    # A noise-free trace may stay at its largest value for long, without being clipped.
    info = replace(run.info, checks={"clipped_samples": 0})
    return replace(run, info=info, trace=trace, events=(), filtered=None)


def _itself(run: Run) -> Run:
    return run


def _specimens(infos: Iterable[RunInfo]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(map(specimen_key, infos)))


ZERO_FORCE_AT_REST_KINDS = frozenset({"blank", "coulomb", "relaxation"})
"""Kinds of run without force before the motion, so that the rest shows the sensor's zero."""
DEFAULT_ZERO_SD_MN = NoiseSettings().zero_mN
MIN_ZEROS = 3
MIN_PAIRS_FOR_SCATTER = 3
"""Pairs from which their own scatter estimates the error of their mean."""
MIN_FORCE_ERRORS = 3.0
"""Standard errors that a force must have for a difference to be given relative to it."""
MAX_STRETCHES = 3
"""Stretches of conditions that a sentence tells apart."""
FALSE_POSITIVE_RATE = 0.05
MIN_REPORTED_LAG_S = 0.0005
MIN_REPORTED_ERROR_MM = 0.01
"""Following errors below both are not reported."""


@dataclass(frozen=True, slots=True)
class PairingCandidate:
    """A run to be paired: its file, condition and specimen."""

    file: str
    condition: RunCondition
    specimen: str


@dataclass(frozen=True, slots=True, eq=False)
class _MeasuredRun(PairingCandidate):
    """A run after its samples were measured; they are not stored."""

    source: ComparedRun
    measures: RunMeasures


def compare_sides(a: ComparedSide, b: ComparedSide, progress: Progress = no_progress) -> Comparison:
    """Compare two sides; raises `AnalysisError` when no run of either side has a partner on the other."""
    total = len(a.runs) + 2 * len(b.runs)
    runs_a, unusable_a = _measure_side(a, lambda done: progress(done, total))
    runs_b, unusable_b = _measure_side(b, lambda done: progress(len(a.runs) + done, total))
    a, b = replace(a, left_out=(*a.left_out, *unusable_a)), replace(b, left_out=(*b.left_out, *unusable_b))
    if b.is_model:
        model_index = {run.source.info.path: index for index, run in enumerate(runs_b)}
        paths = ((index, run.source.info.path) for index, run in enumerate(runs_a))
        pairing = Pairing(tuple((index, model_index[path]) for index, path in paths if path in model_index), (), ())
    else:
        pairing = pair_runs(runs_a, runs_b)
    if not pairing.pairs:
        unused = (*pairing.alone_a, *a.left_out, *b.left_out)[:3]
        reasons = "; ".join(f"{exclusion.item}: {exclusion.reason}" for exclusion in unused) or "nothing was recorded"
        raise AnalysisError(f"{a.name} and {b.name}: no run of either has a partner in the other ({reasons}).")
    force_free = [
        run.measures.rest_offset.value
        for run in (*runs_a, *(() if b.is_model else runs_b))
        if run.condition.kind in ZERO_FORCE_AT_REST_KINDS
    ]
    zero_mN = zero_sd([rest for rest in force_free if rest is not None])
    pairs = []
    for done, (index_a, index_b) in enumerate(pairing.pairs):
        progress(len(a.runs) + len(b.runs) + done, total)
        pairs.append(_compare_pair(runs_a[index_a], runs_b[index_b], zero_mN, b_is_model=b.is_model))
    progress(total, total)
    comparison = Comparison(
        a,
        b,
        tuple(pairs),
        # Against a single run, all other runs of a campaign are without a partner, which is no news.
        () if len(b.runs) + len(b.left_out) == 1 else pairing.alone_a,
        () if len(a.runs) + len(a.left_out) == 1 else pairing.alone_b,
        zero_mN,
        group_differences(pairs),
        tuple(_comparison_remarks(a, b, pairs)),
    )
    return replace(comparison, sentences=comparison_sentences(comparison))


def _measure_side(side: ComparedSide, progress: Callable[[int], None]) -> tuple[list[_MeasuredRun], list[Exclusion]]:
    measured, unusable = [], []
    for done, source in enumerate(side.runs):
        progress(done)
        try:
            run = source.read()
        except DragrigError as error:
            unusable.append(Exclusion(source.file, reason_of(error).removeprefix(f"{source.info.path}: ")))
            continue
        if not np.isfinite(run.trace.force).any():
            unusable.append(Exclusion(source.file, "none of its samples is a number"))
            continue
        measures = measure(run)
        measures = _without_errors(measures) if side.is_model else measures
        measured.append(_MeasuredRun(source.file, run_condition(run), specimen_key(source.info), source, measures))
    return measured, unusable


def _without_errors(measures: RunMeasures) -> RunMeasures:
    """Measures of a model without errors: it has no noise, and its variations are the model itself."""

    def exact(estimate: Estimate) -> Estimate:
        return estimate if estimate.value is None else Estimate(estimate.value, 0.0)

    return replace(
        measures,
        steady_force=exact(measures.steady_force),
        rest_offset=exact(measures.rest_offset),
        peak_force=exact(measures.peak_force),
        hold_force=exact(measures.hold_force),
    )


# Pairing.


@dataclass(frozen=True, slots=True)
class Pairing:
    """Indices of paired runs, in the order of A, and the runs without a partner, and why."""

    pairs: tuple[tuple[int, int], ...]
    alone_a: tuple[Exclusion, ...]
    alone_b: tuple[Exclusion, ...]


def pair_runs(a: Sequence[PairingCandidate], b: Sequence[PairingCandidate]) -> Pairing:
    """Pair runs of the same condition; a run on the same specimen is preferred, then the first."""
    partner: dict[int, int] = {}
    for same_specimen in (True, False):
        for index_a, run_a in enumerate(a):
            if index_a in partner:
                continue
            taken = set(partner.values())
            for index_b, run_b in enumerate(b):
                if index_b in taken or (same_specimen and run_a.specimen != run_b.specimen):
                    continue
                if not run_a.condition.differs_from(run_b.condition):
                    partner[index_a] = index_b
                    break
    taken = set(partner.values())
    return Pairing(
        pairs=tuple(sorted(partner.items())),
        alone_a=tuple(
            Exclusion(run.file, _unpaired_reason(run, b, "B")) for index, run in enumerate(a) if index not in partner
        ),
        alone_b=tuple(
            Exclusion(run.file, _unpaired_reason(run, a, "A")) for index, run in enumerate(b) if index not in taken
        ),
    )


def _unpaired_reason(run: PairingCandidate, opposite: Sequence[PairingCandidate], side: str) -> str:
    if not opposite:
        return f"{side} has no run that can be compared"
    differences = [(candidate, run.condition.differs_from(candidate.condition)) for candidate in opposite]
    same = sum(not differs for _, differs in differences)
    if same:
        return f"{side} has only {count_text(same, 'run')} like it, paired with earlier runs"
    kind = run.condition.kind
    nearest, differs = min(differences, key=lambda pair: (pair[0].condition.kind != kind, len(pair[1])))
    if nearest.condition.kind != kind:
        return f"{side} has no {kind} run"
    return f"{side} has no {run.condition} like it; nearest is {nearest.file}: {', '.join(differs)}"


# Differences of a pair.


def _compare_pair(run_a: _MeasuredRun, run_b: _MeasuredRun, zero_mN: float, *, b_is_model: bool) -> RunPair:
    a, b = run_a.source.read(), run_b.source.read()
    kind = run_a.condition.kind
    remarks = [f"{side}: {run.source.remark}" for side, run in (("A", run_a), ("B", run_b)) if run.source.remark]
    remarks += secondary_differences(a.info, b.info)
    speed_a, speed_b = run_a.measures.speed.value, run_b.measures.speed.value
    if speed_a is not None and speed_b is not None and speed_a * speed_b < 0:
        remarks.append("A and B move in opposite directions, so that their forces cannot be compared as they are")
    overlay = None
    try:
        overlay = align_runs(a, b)
        remarks += overlay.remarks
    except AnalysisError as error:
        remarks.append(reason_of(error))
    differences = tuple(
        _measure_differences(run_a.measures, run_b.measures, run_a.condition, zero_mN, 1 if b_is_model else 2)
    )
    zeros = None
    if kind in ZERO_FORCE_AT_REST_KINDS:
        zeros = next((difference.zeros for difference in differences if difference.zeros is not None), None)
    missing_samples = sum(int(np.count_nonzero(~np.isfinite(run.trace.force))) for run in (a, b))
    if missing_samples:
        remarks.append(f"{missing_samples} samples are missing (NaN) and were ignored")
    return RunPair(
        condition=run_a.condition,
        a=run_a.source,
        b=run_b.source,
        shift_s=None if overlay is None else overlay.shift_s,
        differences=differences,
        phases=() if overlay is None else tuple(_phase_differences(overlay, zeros or (0.0, 0.0))),
        motion=_motion_difference(a, None if b_is_model else b, overlay),
        remarks=tuple(remarks),
        b_is_model=b_is_model,
    )


def relative_scatter(condition: RunCondition) -> float:
    """Relative standard deviation of a run's force between repeats.

    2 % of stiffness, 1.5 % of the friction coefficient. A drag has both; 2 % of all of its force is a little more than
    the two together.
    """
    if condition.signal != "force" or condition.fixture == Fixture.NONE or condition.kind == "blank":
        return 0.0
    return FRICTION_SCATTER if condition.kind == "coulomb" else STIFFNESS_SCATTER


def zero_sd(rests_mN: Iterable[float]) -> float:
    """Return the standard deviation of an unknown zero [mN] from force-free rests; the default for fewer than three."""
    rests = np.asarray(list(rests_mN), dtype=np.float64)
    return DEFAULT_ZERO_SD_MN if rests.size < MIN_ZEROS else sqrt(float(np.mean(rests**2)))


def _measure_differences(
    a: RunMeasures, b: RunMeasures, condition: RunCondition, zero_mN: float, recorded: int
) -> Iterator[MeasureDifference]:
    """Subtract the measures of A from those of B.

    Parameters
    ----------
    zero_mN
        Standard deviation of a sensor's unknown zero, allowed for where the rest does not show it.
    recorded
        How many of the two were recorded, 2 or 1: a model does not scatter.
    """
    zero_at_rest = condition.kind in ZERO_FORCE_AT_REST_KINDS
    scatter = relative_scatter(condition)
    rests = a.rest_offset, b.rest_offset
    steady = a.steady_force, b.steady_force
    # Nothing slides in a relaxation, and the extreme of a blank run is that of its noise.
    forces = {STEADY_FORCE: steady} if condition.kind != "relaxation" else {}
    forces |= {PEAK_FORCE: (a.peak_force, b.peak_force)} if condition.kind != "blank" else {}
    forces |= {HOLD_FORCE: (a.hold_force, b.hold_force)}
    rows = [(name, values, rests if zero_at_rest else None, scatter) for name, values in forces.items()]
    if not zero_at_rest:
        rows.append((ABOVE_REST, steady, rests, scatter))
    rows.append((REST_FORCE, rests, None, 0.0 if zero_at_rest else scatter))
    for name, values, offsets, share in rows:
        zeros = None if offsets is None or any(zero.value is None for zero in offsets) else offsets
        size = sum(
            abs(estimate.value - ((zero.value or 0.0) if zero else 0.0))
            for estimate, zero in zip(values, zeros or (None, None), strict=True)
            if estimate.value is not None
        )
        spread = sqrt((share * size / 2) ** 2 + (zero_mN**2 if zeros is None else 0.0))
        yield _difference(name, "mN", values, sqrt(recorded) * spread, zeros)
    yield _difference(STEADY_SPEED, "mm/s", (a.speed, b.speed), 0.0)


def _difference(
    name: str,
    unit: str,
    values: tuple[Estimate, Estimate],
    spread: float,
    rests: tuple[Estimate, Estimate] | None = None,
) -> MeasureDifference:
    a, b = values
    zeros = None if rests is None else (rests[0].value or 0.0, rests[1].value or 0.0)
    if a.value is None or b.value is None:
        reasons = [f"{side}: {estimate.reason}" for side, estimate in (("A", a), ("B", b)) if estimate.value is None]
        return MeasureDifference(name, unit, a, b, zeros, spread=spread, reason="; ".join(reasons))
    zero_a, zero_b = zeros or (0.0, 0.0)
    value = (b.value - zero_b) - (a.value - zero_a)
    variance = 0.0
    for estimate in (a, b, *(rests or ())):
        if estimate.standard_error is None:
            reason = "the error of one of them is not known"
            return MeasureDifference(name, unit, a, b, zeros, value, None, spread, reason)
        variance += estimate.standard_error**2
    return MeasureDifference(name, unit, a, b, zeros, value, sqrt(variance), spread)


def _phase_differences(overlay: AlignedRuns, zeros: tuple[float, float]) -> Iterator[PhaseDifference]:
    """Difference of the filtered traces, zeros subtracted, by phase and over the whole run."""
    difference = (overlay.force_b - zeros[1]) - (overlay.force_a - zeros[0])
    finite = np.isfinite(difference)
    masks = [(name, overlay.together & (overlay.phase_a == number)) for number, name in enumerate(PHASE_NAMES)]
    for name, mask in (*masks, ("all", np.ones_like(finite))):
        value, time = difference[mask & finite], overlay.time_s[mask & finite]
        if value.size:
            rms, largest = _rms_and_largest(value)
            at_s = float(time[np.abs(value).argmax()])
            yield PhaseDifference(name, value.size, float(value.mean()), rms, largest, at_s)


def _rms_and_largest(values: FloatArray) -> tuple[float, float]:
    with np.errstate(over="ignore"):  # a sample that nothing measures
        return float(np.sqrt(np.mean(values**2))), float(values[np.abs(values).argmax()])


def _motion_difference(a: Run, b: Run | None, overlay: AlignedRuns | None) -> MotionDifference:
    """Compare motions; a model, without one of its own, is driven by the recorded motion."""
    if b is None:
        return MotionDifference(_following_error(a))
    difference = np.zeros(0) if overlay is None else overlay.position_b - overlay.position_a
    difference = difference[np.isfinite(difference)]
    if not difference.size:
        return MotionDifference(_following_error(a), _following_error(b))
    return MotionDifference(_following_error(a), _following_error(b), *_rms_and_largest(difference - difference[0]))


def _following_error(run: Run) -> FollowingError | None:
    """Position minus command in motion; None where the recorded command is the position itself."""
    trace = run.trace
    position, command = (np.asarray(channel, dtype=np.float64) for channel in (trace.position, trace.command))
    moving = (trace.phase > Phase.REST) & (trace.phase < Phase.HOLD) & np.isfinite(position) & np.isfinite(command)
    if np.array_equal(command, position) or not moving.any():
        return None
    error = position - command
    lag_s = None
    steady = moving & in_phase(trace, Phase.STEADY)
    if np.count_nonzero(steady) >= 2:
        duration_s = float(trace.time[steady][-1] - trace.time[steady][0])
        travel = float(trace.command[steady][-1] - trace.command[steady][0])
        speed = travel / duration_s if duration_s > 0 else 0.0
        lag_s = -float(np.mean(error[steady])) / speed if speed else None
    return FollowingError(*_rms_and_largest(error[moving]), lag_s)


# Groups of pairs.


def group_differences(pairs: Iterable[RunPair]) -> tuple[GroupDifference, ...]:
    """Average the main measures of the pairs of one condition; the largest differences, in standard errors, first."""
    groups: list[list[RunPair]] = []
    for pair in pairs:
        same = next((group for group in groups if not group[0].condition.differs_from(pair.condition)), None)
        if same is None:
            groups.append([pair])
        else:
            same.append(pair)
    averaged = [difference for group in groups for difference in _average_group(group)]
    return tuple(sorted(averaged, key=lambda difference: difference.times_error, reverse=True))


def _average_group(group: Sequence[RunPair]) -> Iterator[GroupDifference]:
    traces = [phase for pair in group for phase in pair.phases if phase.phase == "all"]
    samples = sum(trace.samples for trace in traces)
    rms = sqrt(sum(trace.samples * trace.rms_mN**2 for trace in traces) / samples) if samples else None
    condition = group[0].condition
    for name in condition.main_measures:
        known = [
            difference
            for pair in group
            for difference in pair.differences
            if difference.measure == name and difference.noise is not None
        ]
        if not known:
            continue
        values = np.array([difference.value or 0.0 for difference in known])
        noise = sqrt(sum((difference.noise or 0.0) ** 2 for difference in known)) / len(known)
        error = sqrt(sum((difference.error or 0.0) ** 2 for difference in known)) / len(known)
        if len(known) >= MIN_PAIRS_FOR_SCATTER:
            error = max(error, float(values.std(ddof=1)) / sqrt(len(known)))
        a = float(np.mean([difference.compared[0] or 0.0 for difference in known]))
        mean = float(values.mean())
        relative = mean / abs(a) if abs(a) > MIN_FORCE_ERRORS * error else None
        yield GroupDifference(condition, name, len(known), a, a + mean, mean, noise, error, relative, rms)


# Words.


def comparison_sentences(comparison: Comparison) -> tuple[str, ...]:
    """Name the sides, then the conditions over which B differs from A: drags first, then each kind and measure."""
    by_measure: dict[tuple[str, str], list[GroupDifference]] = {}
    for group in comparison.groups:
        by_measure.setdefault((group.condition.kind, group.measure), []).append(group)

    def differs(groups: Iterable[GroupDifference]) -> bool:
        return any(group.verdict is DifferenceVerdict.BEYOND for group in groups)

    # What differs comes first, and of that the drags.
    patterns = {
        key: _pattern(f"{key[0].capitalize()}, {key[1]}", groups)
        for key, groups in sorted(by_measure.items(), key=lambda entry: (not differs(entry[1]), entry[0][0] != "drag"))
    }
    headline, *others = patterns.values() if differs(comparison.groups) else ("", *patterns.values())
    counts = _counts(comparison)
    return (
        _overview(comparison),
        f"{headline} ({counts})" if headline else counts,
        *others,
        *_motion_sentences(comparison.pairs),
        *_zero_sentence(comparison),
    )


def _overview(comparison: Comparison) -> str:
    count = len(comparison.pairs)
    if comparison.b.is_model:
        runs = f"{count_text(count, 'run')} of A ({comparison.a.name})"
        return f"{runs} against the friction model, on the recorded motion (B)."
    alone = ((comparison.alone_a, "A"), (comparison.alone_b, "B"))
    counts = " and ".join(f"{len(runs)} of {name}" for runs, name in alone if runs)
    without = f"; without a partner: {counts}" if counts else ""
    return f"{count_text(count, 'pair')} of runs, A from {comparison.a.name}, B from {comparison.b.name}{without}."


def _counts(comparison: Comparison) -> str:
    """Return how many forces differ, and how many would by chance alone."""
    judged = [
        difference
        for pair in comparison.pairs
        for difference in pair.main
        if difference.verdict is not DifferenceVerdict.UNKNOWN
    ]
    if not judged:
        return "No pair has a known difference of forces, so that nothing can be concluded."
    beyond = sum(difference.verdict is DifferenceVerdict.BEYOND for difference in judged)
    if beyond == 0:
        return (
            f"A and B agree: none of {count_text(len(judged), 'force')} differs by more than noise and scatter explain."
        )
    expected = FALSE_POSITIVE_RATE * len(judged)
    by_chance = f"; about {expected:.0f} would by chance" if expected >= 1 else ""
    return f"{beyond} of {len(judged)} {'differs' if beyond == 1 else 'differ'}{by_chance}."


def _pattern(name: str, groups: Sequence[GroupDifference]) -> str:
    """Return over which speeds or strains B is above A, below it, and as A."""
    ordered = sorted(groups, key=lambda group: group.condition.varied)
    sides = [(group.verdict is DifferenceVerdict.BEYOND) * (1 if group.value > 0 else -1) for group in ordered]
    if not any(sides):
        mean = sum(group.value for group in groups) / len(groups)
        error = sqrt(sum(group.error**2 for group in groups)) / len(groups)
        if abs(mean) > NORMAL_95 * error:
            offset = f"{abs(mean):.1f} mN {'above' if mean > 0 else 'below'} A"
            return f"{name}: no condition differs by itself, but over all of them B is {offset} on average."
        average = f"{'+' if mean > 0 else ''}{value_with_error(mean, NORMAL_95 * error)} mN (95 %)"
        return f"{name}: no difference beyond noise and scatter; on average {average}."
    pairs = groupby(zip(sides, ordered, strict=True), itemgetter(0))
    stretches = [(side, [group for _, group in part]) for side, part in pairs]
    if len(stretches) > MAX_STRETCHES:
        differing = [group for side, group in zip(sides, ordered, strict=True) if side]
        signs = {"above": max(sides) > 0, "below": min(sides) < 0}
        mixed = " or ".join(sign for sign, there in signs.items() if there)
        return f"{name}: B is {mixed} A in {len(differing)} of {len(ordered)} conditions, {_largest(differing)}."
    last = len(stretches) - 1
    phrases = []
    for place, (side, part) in enumerate(stretches):
        where = _range(part, from_first=place == 0, to_last=place == last)
        above = f"B is {'above' if side > 0 else 'below'} A {where}, {_largest(part)}"
        phrases.append(above if side else f"{where} they agree")
    return f"{name}: {'; '.join(phrases)}."


def _largest(groups: Sequence[GroupDifference]) -> str:
    largest = max(groups, key=lambda group: abs(group.value))
    percent = "" if largest.relative is None else f" ({100 * largest.relative:+.0f} %)"
    return f"by {'up to ' if len(groups) > 1 else ''}{abs(largest.value):.1f} mN{percent}"


def _range(groups: Sequence[GroupDifference], *, from_first: bool, to_last: bool) -> str:
    """Return the range of strains or speeds of conditions: up to 5 mm/s, from 10 mm/s on, from 0.5 to 2 mm/s."""
    (low, unit), (high, _) = groups[0].condition.varied, groups[-1].condition.varied
    if from_first != to_last:
        return f"up to {high:.3g} {unit}" if from_first else f"from {low:.3g} {unit} on"
    return f"at {low:.3g} {unit}" if low == high else f"from {low:.3g} to {high:.3g} {unit}"


def _motion_sentences(pairs: Sequence[RunPair]) -> Iterator[str]:
    for name, errors in (("A", [pair.motion.a for pair in pairs]), ("B", [pair.motion.b for pair in pairs])):
        known = [error for error in errors if error is not None]
        largest = max((error.largest_mm for error in known), key=abs, default=0.0)
        lags = sorted(error.lag_s for error in known if error.lag_s is not None)
        lag = lags[len(lags) // 2] if lags else 0.0
        is_late = abs(lag) >= MIN_REPORTED_LAG_S
        late = f" and is {1e3 * abs(lag):.1f} ms {'late' if lag > 0 else 'early'}" if is_late else ""
        if known and (is_late or abs(largest) >= MIN_REPORTED_ERROR_MM):
            yield f"Motion of {name}: the position deviates from the command by up to {abs(largest):.3g} mm{late}."


def _zero_sentence(comparison: Comparison) -> Iterator[str]:
    kinds = sorted({pair.condition.kind for pair in comparison.pairs} - ZERO_FORCE_AT_REST_KINDS)
    if kinds:
        yield (
            f"The forces of {join_names(kinds)} runs are compared as recorded, for the gut pulls already at rest: "
            f"the sensor's zero may differ by {comparison.zero_mN:.1f} mN."
        )


def _comparison_remarks(a: ComparedSide, b: ComparedSide, pairs: Sequence[RunPair]) -> Iterator[str]:
    def share(count: int) -> str:
        return "every run" if count == len(pairs) else f"{count} of {len(pairs)} pairs"

    same_run = [] if b.is_model else [p for p in pairs if p.a.info.header.run_id == p.b.info.header.run_id]
    altered = sum(any(phase.rms_mN > 0 for phase in pair.phases) for pair in same_run)
    if identical := len(same_run) - altered:
        yield f"A and B are the same recording in {share(identical)}: it is compared with itself"
    if altered:
        yield f"A and B have the same run id in {share(altered)} although their forces differ: one is an altered copy"
    for side, name in ((a, "A"), (b, "B")):
        if len(side.specimens) > 1 and not side.is_model:
            yield f"{name} holds runs of several specimens: {', '.join(side.specimens)}"
    mixed = sum(specimen_key(pair.a.info) != specimen_key(pair.b.info) for pair in pairs)
    if mixed:
        yield (
            f"{mixed} of {len(pairs)} pairs are of different specimens, which differ in stiffness and friction far "
            "more than repeats do"
        )
    for remark in dict.fromkeys(remark for pair in pairs for remark in pair.remarks):
        count = sum(remark in pair.remarks for pair in pairs)
        yield remark if count == len(pairs) else f"{remark} ({count} of {len(pairs)} pairs)"
