"""Compare two sides: measure every run, pair runs of one condition, subtract, judge by noise and scatter, summarise."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import sqrt

import numpy as np

from dragrig.analysis.comparison.comparison import (
    ABOVE_REST,
    HOLD_FORCE,
    PEAK_FORCE,
    REST_FORCE,
    STEADY_FORCE,
    STEADY_SPEED,
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
    main_measures,
    run_condition,
    secondary_differences,
)
from dragrig.analysis.comparison.overlay import AlignedRuns, align_runs
from dragrig.analysis.computation import Progress, no_progress
from dragrig.analysis.estimates import NORMAL_95, Estimate, Exclusion
from dragrig.analysis.measures import RunMeasures, measure
from dragrig.analysis.segments import Mask, in_phase
from dragrig.config.errors import AnalysisError, DragrigError, reason_of
from dragrig.config.rig import NoiseSettings, VariationSettings
from dragrig.config.specimen import Fixture
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.campaigns import specimen_key
from dragrig.rig.runfile.model import PHASE_NAMES, Run

ZERO_FORCE_AT_REST_KINDS = frozenset({"blank", "coulomb", "relaxation"})
"""Kinds of run whose force is nought before the motion, so that the rest shows the sensor's zero."""
STIFFNESS_SCATTER = VariationSettings().run_stiffness
FRICTION_SCATTER = VariationSettings().run_friction
DEFAULT_ZERO_SD_MN = NoiseSettings().zero_mN
MIN_ZEROS = 3


def relative_scatter(condition: RunCondition) -> float:
    """Return the standard deviation of a run's force between repeats, as a share of it.

    2 % of stiffness, 1.5 % of the friction coefficient. A drag has both; 2 % of all of its force is a little more than
    they come to together.
    """
    if condition.signal != "force" or condition.fixture == Fixture.NONE or condition.kind == "blank":
        return 0.0
    return FRICTION_SCATTER if condition.kind == "coulomb" else STIFFNESS_SCATTER


def zero_sd(rests_mN: Iterable[float]) -> float:
    """Return the standard deviation of an unknown zero [mN] from rests that show nothing else; 3 mN for too few."""
    found = np.asarray(list(rests_mN), dtype=np.float64)
    if found.size < MIN_ZEROS:
        return DEFAULT_ZERO_SD_MN
    return sqrt(float(np.mean(found**2)))


@dataclass(frozen=True, slots=True)
class PairingCandidate:
    """A run to be paired: its file, what was done in it, on which specimen."""

    file: str
    condition: RunCondition
    specimen: str


@dataclass(frozen=True, slots=True)
class Pairing:
    """Places of the runs that belong together, in the order of A, and which have no partner, and why."""

    pairs: tuple[tuple[int, int], ...]
    alone_a: tuple[Exclusion, ...]
    alone_b: tuple[Exclusion, ...]


def pair_runs(a: Sequence[PairingCandidate], b: Sequence[PairingCandidate]) -> Pairing:
    """Pair runs of the same condition; a run on the same specimen is preferred, then the one that comes first."""
    partner: dict[int, int] = {}
    _match_runs(a, b, partner, lambda one, other: one.specimen == other.specimen)
    _match_runs(a, b, partner, lambda _one, _other: True)
    taken = set(partner.values())
    return Pairing(
        pairs=tuple(sorted(partner.items())),
        alone_a=tuple(
            Exclusion(one.file, _unpaired_reason(one, b, "B")) for at, one in enumerate(a) if at not in partner
        ),
        alone_b=tuple(
            Exclusion(one.file, _unpaired_reason(one, a, "A")) for at, one in enumerate(b) if at not in taken
        ),
    )


def _match_runs(
    a: Sequence[PairingCandidate],
    b: Sequence[PairingCandidate],
    partner: dict[int, int],
    may: Callable[[PairingCandidate, PairingCandidate], bool],
) -> None:
    taken = set(partner.values())
    for at, one in enumerate(a):
        if at in partner:
            continue
        for place, other in enumerate(b):
            if place not in taken and may(one, other) and not one.condition.differs_from(other.condition):
                partner[at] = place
                taken.add(place)
                break


def _unpaired_reason(one: PairingCandidate, others: Sequence[PairingCandidate], side: str) -> str:
    """Say why a run has no partner: no such runs, all of them taken, or what differs in the nearest."""
    if not others:
        return f"{side} has no run that can be compared"
    alike = [(other, one.condition.differs_from(other.condition)) for other in others]
    same = [other for other, differs in alike if not differs]
    if same:
        return f"{side} has only {len(same)} run{'' if len(same) == 1 else 's'} like it, and the others come first"
    nearest, differs = min(alike, key=lambda pair: (pair[0].condition.kind != one.condition.kind, len(pair[1])))
    if nearest.condition.kind != one.condition.kind:
        return f"{side} has no {one.condition.kind} run"
    return f"{side} has no {one.condition} like it; nearest is {nearest.file}: {', '.join(differs)}"


MeasuredPair = tuple[RunMeasures, RunMeasures]


def measure_differences(
    measured: MeasuredPair, condition: RunCondition, zero_mN: float, recorded: int
) -> tuple[MeasureDifference, ...]:
    """Subtract the measures of A from those of B.

    Parameters
    ----------
    zero_mN
        Standard deviation of a sensor's unknown zero, allowed for where the rest does not show it.
    recorded
        How many of the two were recorded, 2 or 1: what the model says scatters by nothing.
    """
    return tuple(_each_difference(measured, condition, zero_mN, sqrt(recorded)))


def _each_difference(
    measured: MeasuredPair, condition: RunCondition, zero_mN: float, factor: float
) -> Iterator[MeasureDifference]:
    one, other = measured
    free = condition.kind in ZERO_FORCE_AT_REST_KINDS
    share = relative_scatter(condition)
    rests = one.rest_offset, other.rest_offset
    for name, a, b in (
        (STEADY_FORCE, one.steady_force, other.steady_force),
        (PEAK_FORCE, one.peak_force, other.peak_force),
        (HOLD_FORCE, one.hold_force, other.hold_force),
    ):
        # Nothing slides in a relaxation, and the extreme of a blank run is that of its noise.
        if (condition.kind, name) in {("relaxation", STEADY_FORCE), ("blank", PEAK_FORCE)}:
            continue
        yield _force_difference(name, (a, b), rests if free else None, share, zero_mN, factor)
    if not free:
        yield _force_difference(ABOVE_REST, (one.steady_force, other.steady_force), rests, share, zero_mN, factor)
    yield _force_difference(REST_FORCE, rests, None, 0.0 if free else share, zero_mN, factor)
    yield _measure_difference(STEADY_SPEED, "mm/s", (one.speed, other.speed), 0.0)


def _force_difference(
    name: str,
    values: tuple[Estimate, Estimate],
    rests: tuple[Estimate, Estimate] | None,
    share: float,
    zero_mN: float,
    factor: float,
) -> MeasureDifference:
    if rests is None or any(rest.value is None for rest in rests):
        return _measure_difference(name, "mN", values, factor * _scatter_sd(values, share, zero_mN))
    return _measure_difference(name, "mN", values, factor * _scatter_sd(_minus_rest(values, rests), share, 0.0), rests)


def _scatter_sd(values: tuple[Estimate, Estimate], share: float, zero_mN: float) -> float:
    size = sum(abs(one.value or 0.0) for one in values) / 2
    return sqrt((share * size) ** 2 + zero_mN**2)


def _minus_rest(values: tuple[Estimate, Estimate], rests: tuple[Estimate, Estimate]) -> tuple[Estimate, Estimate]:
    a, b = (
        Estimate(None if one.value is None else one.value - (rest.value or 0.0))
        for one, rest in zip(values, rests, strict=True)
    )
    return a, b


def _measure_difference(
    name: str,
    unit: str,
    values: tuple[Estimate, Estimate],
    spread: float,
    rests: tuple[Estimate, Estimate] | None = None,
) -> MeasureDifference:
    a, b = values
    zero_a, zero_b = ((rest.value or 0.0) for rest in rests) if rests is not None else (0.0, 0.0)
    zeros = (zero_a, zero_b) if rests is not None else None
    if a.value is None or b.value is None:
        lacking = [f"{side}: {one.reason}" for side, one in (("A", a), ("B", b)) if one.value is None]
        return MeasureDifference(name, unit, a, b, zeros, spread=spread, reason="; ".join(lacking))
    value = (b.value - zero_b) - (a.value - zero_a)
    errors = [one.standard_error for one in (*values, *(rests or ()))]
    known = [error for error in errors if error is not None]
    if len(known) < len(errors):
        return MeasureDifference(name, unit, a, b, zeros, value, None, spread, "the error of one of them is not known")
    return MeasureDifference(name, unit, a, b, zeros, value, sqrt(sum(error**2 for error in known)), spread)


def motion_difference(a: Run, b: Run, overlay: AlignedRuns | None, *, b_is_model: bool) -> MotionDifference:
    """Compare the motions of two runs; a model is driven by the motion that was recorded, so that there is no other."""
    if b_is_model:
        return MotionDifference(following_error(a), None, None, None)
    if overlay is None:
        return MotionDifference(following_error(a), following_error(b), None, None)
    miss = overlay.position_b - overlay.position_a
    miss = miss[np.isfinite(miss)]
    if not miss.size:
        return MotionDifference(following_error(a), following_error(b), None, None)
    miss = miss - miss[0]
    largest = float(miss[np.abs(miss).argmax()])
    return MotionDifference(following_error(a), following_error(b), float(np.sqrt(np.mean(miss**2))), largest)


def following_error(run: Run) -> FollowingError | None:
    """Return position minus command while in motion; None where no command but the position itself was recorded."""
    trace = run.trace
    position, command = (np.asarray(one, dtype=np.float64) for one in (trace.position, trace.command))
    moving = (trace.phase > Phase.REST) & (trace.phase < Phase.HOLD) & np.isfinite(position) & np.isfinite(command)
    if np.array_equal(command, position) or not moving.any():
        return None
    error = position - command
    largest = float(error[moving][np.abs(error[moving]).argmax()])
    return FollowingError(float(np.sqrt(np.mean(error[moving] ** 2))), largest, _following_lag(run, error, moving))


def _following_lag(run: Run, error: FloatArray, moving: Mask) -> float | None:
    steady = moving & in_phase(run.trace, Phase.STEADY)
    if np.count_nonzero(steady) < 2:
        return None
    time, command = run.trace.time[steady], run.trace.command[steady]
    took = float(time[-1] - time[0])
    speed = float(command[-1] - command[0]) / took if took > 0 else 0.0
    return -float(np.mean(error[steady])) / speed if speed else None


MIN_PAIRS_FOR_SCATTER = 3
"""Pairs whose own scatter says something of the error of their mean."""
MIN_FORCE_ERRORS = 3.0
"""Standard errors that a force must have for a difference to be told as a share of it."""


def group_differences(pairs: Iterable[RunPair]) -> tuple[GroupDifference, ...]:
    """Average the main measures of the pairs of one condition; the largest differences, in standard errors, first."""
    groups: list[list[RunPair]] = []
    for pair in pairs:
        home = next((one for one in groups if not one[0].condition.differs_from(pair.condition)), None)
        if home is None:
            groups.append([pair])
        else:
            home.append(pair)
    found = [one for group in groups for one in _group_measures(group)]
    return tuple(sorted(found, key=lambda one: one.times_error, reverse=True))


def _group_measures(group: Sequence[RunPair]) -> list[GroupDifference]:
    squares = [(one.samples, one.rms_mN) for pair in group for one in pair.phases if one.phase == "all"]
    samples = sum(count for count, _ in squares)
    rms = sqrt(sum(count * value**2 for count, value in squares) / samples) if samples else None
    condition = group[0].condition
    found = []
    for name in main_measures(condition.kind):
        told = [one for pair in group for one in pair.differences if one.measure == name and one.noise is not None]
        if told:
            found.append(_mean_difference(condition, told, rms))
    return found


def _mean_difference(
    condition: RunCondition, told: Sequence[MeasureDifference], rms_mN: float | None
) -> GroupDifference:
    count = len(told)
    values = np.array([one.value or 0.0 for one in told])
    noise = sqrt(sum((one.noise or 0.0) ** 2 for one in told)) / count
    error = sqrt(sum((one.error or 0.0) ** 2 for one in told)) / count
    if count >= MIN_PAIRS_FOR_SCATTER:
        error = max(error, float(values.std(ddof=1)) / sqrt(count))
    a = float(np.mean([one.compared[0] or 0.0 for one in told]))
    mean = float(values.mean())
    return GroupDifference(
        condition=condition,
        measure=told[0].measure,
        pairs=count,
        a=a,
        b=a + mean,
        value=mean,
        noise=noise,
        error=error,
        relative=mean / abs(a) if abs(a) > MIN_FORCE_ERRORS * error else None,
        rms_mN=rms_mN,
    )


FALSE_POSITIVE_RATE = 0.05
MIN_REPORTED_LAG_S = 0.0005
MIN_REPORTED_ERROR_MM = 0.01
"""Following errors below both are not worth a sentence."""


def comparison_sentences(comparison: Comparison) -> tuple[str, ...]:
    """Say what was compared, whether it differs, where most, and what each kind of run says."""
    return (
        _overview(comparison),
        *_overall_judgement(comparison),
        *_clearest_group(comparison.groups),
        *(_measure_sentence(name, groups) for name, groups in _by_measure(comparison.groups)),
        *_motion_sentences(comparison.pairs),
        *_zero_sentence(comparison),
    )


def _overview(comparison: Comparison) -> str:
    count = len(comparison.pairs)
    if comparison.b.is_model:
        runs = f"{count} run{_plural(count)} of A ({comparison.a.name})"
        return f"{runs} against the friction model, on the recorded motion (B)."
    alone = ((comparison.alone_a, "A"), (comparison.alone_b, "B"))
    said = " and ".join(f"{len(found)} of {name}" for found, name in alone if found)
    without = f"; without a partner: {said}" if said else ""
    return f"{count} pair{_plural(count)} of runs, A from {comparison.a.name}, B from {comparison.b.name}{without}."


def _overall_judgement(comparison: Comparison) -> Iterator[str]:
    told = [one for pair in comparison.pairs for one in pair.main if one.verdict is not DifferenceVerdict.UNKNOWN]
    if not told:
        yield "No force of any pair can be told, so that nothing can be said of the difference."
        return
    beyond = sum(one.verdict is DifferenceVerdict.BEYOND for one in told)
    words = "noise and run-to-run scatter explain"
    names = list(dict.fromkeys(one.measure.removesuffix(" force") for one in told))
    forces = f"{', '.join(names)} force{_plural(len(told))}"
    chance = FALSE_POSITIVE_RATE * len(told)
    expected = f"; of equal runs about {chance:.0f} would" if chance >= 1 else ""
    if beyond == 0:
        yield f"None of {len(told)} {forces} differs by more than {words}."
    else:
        yield f"{beyond} of {len(told)} {forces} differ{'s' if beyond == 1 else ''} by more than {words}{expected}."


def _clearest_group(groups: Sequence[GroupDifference]) -> Iterator[str]:
    if len(groups) > 1 and groups[0].verdict is DifferenceVerdict.BEYOND:
        one = groups[0]
        yield (
            f"Clearest: {one.condition}, {one.measure} {one.a:.1f} against {one.b:.1f} mN, "
            f"{one.value:+.1f} ± {NORMAL_95 * one.error:.1f} mN{_percent_text(one.relative)}."
        )


def _measure_sentence(name: str, groups: Sequence[GroupDifference]) -> str:
    beyond = [one for one in groups if one.verdict is DifferenceVerdict.BEYOND]
    mean = sum(one.value for one in groups) / len(groups)
    error = sqrt(sum(one.error**2 for one in groups)) / len(groups)
    level = [one.relative for one in groups if one.relative is not None and abs(one.a) > NORMAL_95 * one.error]
    percent = _percent_text(sum(level) / len(level)) if level else ""
    if not beyond:
        if abs(mean) > NORMAL_95 * error:
            offset = _offset_text(mean)
            return f"{name}: no condition differs by itself, but over all of them B is {offset} on average{percent}."
        return f"{name}: no difference beyond noise and scatter; on average {mean:+.1f} ± {NORMAL_95 * error:.1f} mN."
    values = [one.value for one in beyond]
    count = f"in {len(beyond)} of {len(groups)} conditions" if len(groups) > 1 else f"{_condition_range(beyond)}"
    if min(values) > 0 or max(values) < 0:
        low, high = sorted(values, key=abs)[0], sorted(values, key=abs)[-1]
        span = f"{abs(high):.1f}" if len(values) == 1 else f"{abs(low):.1f} to {abs(high):.1f}"
        average = f"; {mean:+.1f} mN on average" if len(groups) > 1 else ""
        side = "above" if high > 0 else "below"
        return f"{name}: B lies {side} A {count}, by {span} mN{average}{percent}."
    above, below = ([one for one in beyond if one.value * sign > 0] for sign in (1, -1))
    return (
        f"{name}: B lies above A {_condition_range(above)}, by up to {max(values):.1f} mN, "
        f"and below it {_condition_range(below)}, by up to {-min(values):.1f} mN."
    )


def _condition_range(groups: Sequence[GroupDifference]) -> str:
    """Say at which speeds or strains some conditions lie: at 0.5 to 2 mm/s."""
    strains = [100 * one.condition.shear_strain for one in groups if one.condition.shear_strain is not None]
    speeds = [one.condition.speed_mm_s for one in groups if one.condition.speed_mm_s is not None]
    values, unit = (strains, "%") if strains else (speeds, "mm/s")
    if not values:
        return f"in {len(groups)}"
    low, high = min(values), max(values)
    return f"at {low:.3g} {unit}" if low == high else f"at {low:.3g} to {high:.3g} {unit}"


def _offset_text(mean: float) -> str:
    return f"{abs(mean):.1f} mN {'above' if mean > 0 else 'below'} A"


def _by_measure(groups: Iterable[GroupDifference]) -> Iterator[tuple[str, list[GroupDifference]]]:
    """Gather the groups of one kind and measure, in the order in which the first of them comes."""
    found: dict[str, list[GroupDifference]] = {}
    for one in groups:
        found.setdefault(f"{one.condition.kind}, {one.measure}", []).append(one)
    yield from found.items()


def _motion_sentences(pairs: Sequence[RunPair]) -> Iterator[str]:
    for name, found in (("A", [pair.motion.a for pair in pairs]), ("B", [pair.motion.b for pair in pairs])):
        followed = [one for one in found if one is not None]
        if followed:
            sentence = _following_sentence(name, followed)
            if sentence:
                yield sentence


def _following_sentence(name: str, followed: Sequence[FollowingError]) -> str:
    largest = max((one.largest_mm for one in followed), key=abs)
    lags = sorted(one.lag_s for one in followed if one.lag_s is not None)
    lag = lags[len(lags) // 2] if lags else 0.0
    if abs(largest) < MIN_REPORTED_ERROR_MM and abs(lag) < MIN_REPORTED_LAG_S:
        return ""
    late = (
        f" and comes {1e3 * abs(lag):.1f} ms {'late' if lag > 0 else 'early'}" if abs(lag) >= MIN_REPORTED_LAG_S else ""
    )
    return f"Motion of {name}: the position strays from the command by up to {abs(largest):.3g} mm{late}."


def _zero_sentence(comparison: Comparison) -> Iterator[str]:
    kinds = sorted({pair.condition.kind for pair in comparison.pairs} - ZERO_FORCE_AT_REST_KINDS)
    if kinds:
        yield (
            f"Zeros of {' and '.join(kinds)} runs are not taken off, for their rest is not free of force; "
            f"{comparison.zero_mN:.1f} mN a run is allowed for them."
        )


def _percent_text(relative: float | None) -> str:
    return "" if relative is None else f" ({100 * relative:+.0f} %)"


def _plural(count: int) -> str:
    return "" if count == 1 else "s"


@dataclass(frozen=True, slots=True, eq=False)
class _MeasuredRun:
    """A run that was looked at once; its samples are not kept."""

    source: ComparedRun
    condition: RunCondition
    measures: RunMeasures


def compare_sides(a: ComparedSide, b: ComparedSide, progress: Progress = no_progress) -> Comparison:
    """Compare two sides.

    Raises
    ------
    AnalysisError
        When no run of one has a partner in the other.
    """
    total = len(a.runs) + 2 * len(b.runs)
    seen_a, spoilt_a = _measure_side(a, lambda done: progress(done, total))
    seen_b, spoilt_b = _measure_side(b, lambda done: progress(len(a.runs) + done, total))
    a, b = replace(a, left_out=(*a.left_out, *spoilt_a)), replace(b, left_out=(*b.left_out, *spoilt_b))
    pairing = _pair_with_model(seen_a, seen_b) if b.is_model else pair_runs(_candidates(seen_a), _candidates(seen_b))
    if not pairing.pairs:
        raise AnalysisError(_no_pair_message(a, b, pairing))
    pairing = _without_unpaired_of_single_run(pairing, a, b)
    recorded = (*seen_a, *(() if b.is_model else seen_b))
    zero_mN = zero_sd(_rest_offsets(recorded))
    pairs = []
    for done, (place, other) in enumerate(pairing.pairs):
        progress(len(a.runs) + len(b.runs) + done, total)
        pairs.append(_compare_pair(seen_a[place], seen_b[other], zero_mN, b_is_model=b.is_model))
    progress(total, total)
    whole = Comparison(
        a,
        b,
        tuple(pairs),
        pairing.alone_a,
        pairing.alone_b,
        zero_mN,
        group_differences(pairs),
        tuple(_comparison_remarks(a, b, pairs)),
    )
    return replace(whole, sentences=comparison_sentences(whole))


def _measure_side(side: ComparedSide, progress: Callable[[int], None]) -> tuple[list[_MeasuredRun], list[Exclusion]]:
    seen, spoilt = [], []
    for done, source in enumerate(side.runs):
        progress(done)
        try:
            run = source.read()
        except DragrigError as fault:
            spoilt.append(Exclusion(source.file, reason_of(fault).removeprefix(f"{source.info.path}: ")))
            continue
        if not np.isfinite(run.trace.force).any():
            spoilt.append(Exclusion(source.file, "none of its samples is a number"))
            continue
        measures = measure(run)
        seen.append(_MeasuredRun(source, run_condition(run), _without_errors(measures) if side.is_model else measures))
    return seen, spoilt


def _without_errors(measures: RunMeasures) -> RunMeasures:
    """Give a model's measures no error: they have no noise, and what varies in them is the model itself."""

    def exact(one: Estimate) -> Estimate:
        return one if one.value is None else Estimate(one.value, 0.0)

    return replace(
        measures,
        steady_force=exact(measures.steady_force),
        rest_offset=exact(measures.rest_offset),
        peak_force=exact(measures.peak_force),
        hold_force=exact(measures.hold_force),
    )


def _candidates(seen: Sequence[_MeasuredRun]) -> list[PairingCandidate]:
    return [PairingCandidate(one.source.file, one.condition, specimen_key(one.source.info)) for one in seen]


def _pair_with_model(real: Sequence[_MeasuredRun], simulated: Sequence[_MeasuredRun]) -> Pairing:
    place = {one.source.info.path: at for at, one in enumerate(simulated)}
    pairs = tuple((at, place[one.source.info.path]) for at, one in enumerate(real) if one.source.info.path in place)
    return Pairing(pairs, (), ())


def _without_unpaired_of_single_run(pairing: Pairing, a: ComparedSide, b: ComparedSide) -> Pairing:
    """Where one run is meant, all others of a campaign are without a partner, and nobody wants to be told."""
    return replace(
        pairing,
        alone_a=() if len(b.runs) + len(b.left_out) == 1 else pairing.alone_a,
        alone_b=() if len(a.runs) + len(a.left_out) == 1 else pairing.alone_b,
    )


def _rest_offsets(seen: Sequence[_MeasuredRun]) -> Iterator[float]:
    for one in seen:
        rest = one.measures.rest_offset.value
        if one.condition.kind in ZERO_FORCE_AT_REST_KINDS and rest is not None:
            yield rest


def _compare_pair(one: _MeasuredRun, other: _MeasuredRun, zero_mN: float, *, b_is_model: bool) -> RunPair:
    a, b = one.source.read(), other.source.read()
    said = [f"{side}: {seen.source.remark}" for side, seen in (("A", one), ("B", other)) if seen.source.remark]
    said += secondary_differences(a.info, b.info)
    ways = [seen.measures.speed.value for seen in (one, other)]
    if ways[0] is not None and ways[1] is not None and ways[0] * ways[1] < 0:
        said.append("A and B move in opposite directions, so that their forces are not to be compared as they stand")
    overlay = None
    try:
        overlay = align_runs(a, b)
        said += overlay.remarks
    except AnalysisError as fault:
        said.append(reason_of(fault))
    measured = one.measures, other.measures
    found = measure_differences(measured, one.condition, zero_mN, recorded=1 if b_is_model else 2)
    zeros = next(
        (each.zeros for each in found if each.zeros is not None and one.condition.kind in ZERO_FORCE_AT_REST_KINDS),
        None,
    )
    lost = sum(int(np.count_nonzero(~np.isfinite(run.trace.force))) for run in (a, b))
    if lost:
        said.append(f"{lost} samples are missing (NaN) and were left out")
    return RunPair(
        condition=one.condition,
        a=one.source,
        b=other.source,
        shift_s=None if overlay is None else overlay.shift_s,
        differences=found,
        phases=() if overlay is None else tuple(phase_differences(overlay, zeros)),
        motion=motion_difference(a, b, overlay, b_is_model=b_is_model),
        remarks=tuple(said),
        b_is_model=b_is_model,
    )


def phase_differences(overlay: AlignedRuns, zeros: tuple[float, float] | None) -> Iterator[PhaseDifference]:
    """Sum up the difference of the filtered traces, zeros taken off where they are known, by phase and in all."""
    zero_a, zero_b = zeros or (0.0, 0.0)
    difference = (overlay.force_b - zero_b) - (overlay.force_a - zero_a)
    told = np.isfinite(difference)
    masks = [(name, overlay.together & (overlay.phase_a == number)) for number, name in enumerate(PHASE_NAMES)]
    for name, mask in (*masks, ("all", np.ones_like(told))):
        value, time = difference[mask & told], overlay.time_s[mask & told]
        if value.size:
            at = int(np.abs(value).argmax())
            rms = float(np.sqrt(np.mean(value**2)))
            yield PhaseDifference(name, value.size, float(value.mean()), rms, float(value[at]), float(time[at]))


def _no_pair_message(a: ComparedSide, b: ComparedSide, pairing: Pairing) -> str:
    alone = "; ".join(f"{one.what}: {one.reason}" for one in (*pairing.alone_a, *a.left_out, *b.left_out)[:3])
    return f"{a.name} and {b.name}: no run of one has a partner in the other ({alone or 'nothing was recorded'})."


def _comparison_remarks(a: ComparedSide, b: ComparedSide, pairs: Sequence[RunPair]) -> Iterator[str]:
    twins = [] if b.is_model else [p for p in pairs if p.a.info.header.run_id == p.b.info.header.run_id]
    altered = sum(any(phase.rms_mN > 0 for phase in pair.phases) for pair in twins)
    if same := len(twins) - altered:
        which = "every run" if same == len(pairs) else f"{same} of {len(pairs)} pairs"
        yield f"A and B are the same recording in {which}: it is compared with itself"
    if altered:
        which = "every run" if altered == len(pairs) else f"{altered} of {len(pairs)} pairs"
        yield f"A and B carry the same run id in {which} although their forces differ: one is an altered copy"
    for side, name in ((a, "A"), (b, "B")):
        if len(side.specimens) > 1 and not (side.is_model):
            yield f"{name} holds runs of several specimens: {', '.join(side.specimens)}"
    mixed = sum(specimen_key(pair.a.info) != specimen_key(pair.b.info) for pair in pairs)
    if mixed:
        yield (
            f"{mixed} of {len(pairs)} pairs are of different specimens, which differ in stiffness and friction by far "
            "more than repeats do"
        )
    for remark in dict.fromkeys(remark for pair in pairs for remark in pair.remarks):
        count = sum(remark in pair.remarks for pair in pairs)
        yield remark if count == len(pairs) else f"{remark} ({count} of {len(pairs)} pairs)"
