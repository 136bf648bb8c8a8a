"""Compare two sides: measure every run, pair them, lay the pairs over each other, and sum up."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis.comparison.conditions import Condition, condition_of, further_differences
from dragrig.analysis.comparison.differences import differences
from dragrig.analysis.comparison.groups import grouped
from dragrig.analysis.comparison.motions import motion_difference
from dragrig.analysis.comparison.overlay import Overlay, lay_over
from dragrig.analysis.comparison.pairing import Candidate, Pairing, pair_up
from dragrig.analysis.comparison.results import Comparison, Pair, PhaseDifference, Side, Source
from dragrig.analysis.comparison.sentences import sentences_of
from dragrig.analysis.comparison.spread import FORCE_FREE_AT_REST, zero_spread
from dragrig.analysis.estimates import Estimate
from dragrig.analysis.identification.results import LeftOut
from dragrig.analysis.measures import RunMeasures, measure
from dragrig.analysis.progress import Progress, silent
from dragrig.config.errors import AnalysisError, DragrigError, plain
from dragrig.rig.runfile.campaigns import specimen_key
from dragrig.rig.runfile.model import PHASE_NAMES


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A run that was looked at once; its samples are not kept."""

    source: Source
    condition: Condition
    measures: RunMeasures


def compare_sides(a: Side, b: Side, progress: Progress = silent) -> Comparison:
    """Compare two sides.

    Raises
    ------
    AnalysisError
        When no run of one has a partner in the other.
    """
    total = len(a.runs) + 2 * len(b.runs)
    seen_a, spoilt_a = _look_at(a, lambda done: progress(done, total))
    seen_b, spoilt_b = _look_at(b, lambda done: progress(len(a.runs) + done, total))
    a, b = replace(a, left_out=(*a.left_out, *spoilt_a)), replace(b, left_out=(*b.left_out, *spoilt_b))
    pairing = _with_the_model(seen_a, seen_b) if b.is_model else pair_up(_candidates(seen_a), _candidates(seen_b))
    if not pairing.pairs:
        raise AnalysisError(_no_pair(a, b, pairing))
    pairing = _of_one_run(pairing, a, b)
    recorded = (*seen_a, *(() if b.is_model else seen_b))
    zero_mN = zero_spread(_zeros(recorded))
    pairs = []
    for done, (place, other) in enumerate(pairing.pairs):
        progress(len(a.runs) + len(b.runs) + done, total)
        pairs.append(_pair(seen_a[place], seen_b[other], zero_mN, b_is_model=b.is_model))
    progress(total, total)
    whole = Comparison(
        a, b, tuple(pairs), pairing.alone_a, pairing.alone_b, zero_mN, grouped(pairs), tuple(_remarks(a, b, pairs))
    )
    return replace(whole, sentences=sentences_of(whole))


def _look_at(side: Side, progress: Callable[[int], None]) -> tuple[list[_Seen], list[LeftOut]]:
    seen, spoilt = [], []
    for done, source in enumerate(side.runs):
        progress(done)
        try:
            run = source.read()
        except DragrigError as fault:
            spoilt.append(LeftOut(source.file, plain(fault).removeprefix(f"{source.info.path}: ")))
            continue
        if not np.isfinite(run.trace.force).any():
            spoilt.append(LeftOut(source.file, "none of its samples is a number"))
            continue
        measures = measure(run)
        seen.append(_Seen(source, condition_of(run), _exact(measures) if side.is_model else measures))
    return seen, spoilt


def _exact(measures: RunMeasures) -> RunMeasures:
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


def _candidates(seen: Sequence[_Seen]) -> list[Candidate]:
    return [Candidate(one.source.file, one.condition, specimen_key(one.source.info)) for one in seen]


def _with_the_model(real: Sequence[_Seen], simulated: Sequence[_Seen]) -> Pairing:
    place = {one.source.info.path: at for at, one in enumerate(simulated)}
    pairs = tuple((at, place[one.source.info.path]) for at, one in enumerate(real) if one.source.info.path in place)
    return Pairing(pairs, (), ())


def _of_one_run(pairing: Pairing, a: Side, b: Side) -> Pairing:
    """Where one run is meant, all others of a campaign are without a partner, and nobody wants to be told."""
    return replace(
        pairing,
        alone_a=() if len(b.runs) + len(b.left_out) == 1 else pairing.alone_a,
        alone_b=() if len(a.runs) + len(a.left_out) == 1 else pairing.alone_b,
    )


def _zeros(seen: Sequence[_Seen]) -> Iterator[float]:
    for one in seen:
        rest = one.measures.rest_offset.value
        if one.condition.kind in FORCE_FREE_AT_REST and rest is not None:
            yield rest


def _pair(one: _Seen, other: _Seen, zero_mN: float, *, b_is_model: bool) -> Pair:
    a, b = one.source.read(), other.source.read()
    said = [f"{side}: {seen.source.remark}" for side, seen in (("A", one), ("B", other)) if seen.source.remark]
    said += further_differences(a.info, b.info)
    ways = [seen.measures.speed.value for seen in (one, other)]
    if ways[0] is not None and ways[1] is not None and ways[0] * ways[1] < 0:
        said.append("A and B move in opposite directions, so that their forces are not to be compared as they stand")
    overlay = None
    try:
        overlay = lay_over(a, b)
        said += overlay.remarks
    except AnalysisError as fault:
        said.append(plain(fault))
    measured = one.measures, other.measures
    found = differences(measured, one.condition, zero_mN, recorded=1 if b_is_model else 2)
    zeros = next(
        (each.zeros for each in found if each.zeros is not None and one.condition.kind in FORCE_FREE_AT_REST), None
    )
    lost = sum(int(np.count_nonzero(~np.isfinite(run.trace.force))) for run in (a, b))
    if lost:
        said.append(f"{lost} samples are missing (NaN) and were left out")
    return Pair(
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


def phase_differences(overlay: Overlay, zeros: tuple[float, float] | None) -> Iterator[PhaseDifference]:
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


def _no_pair(a: Side, b: Side, pairing: Pairing) -> str:
    alone = "; ".join(f"{one.what}: {one.reason}" for one in (*pairing.alone_a, *a.left_out, *b.left_out)[:3])
    return f"{a.name} and {b.name}: no run of one has a partner in the other ({alone or 'nothing was recorded'})."


def _remarks(a: Side, b: Side, pairs: Sequence[Pair]) -> Iterator[str]:
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
