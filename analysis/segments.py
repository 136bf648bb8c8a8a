"""Which samples of a trace belong together: unbroken pieces, phases of the motion, clipped samples."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain, pairwise
from math import isfinite, radians, sin

import numpy as np
import numpy.typing as npt

from dragrig.config import AnalysisError
from dragrig.rig import Attribute, FloatArray, IndexArray, Phase, Run, Trace

Mask = npt.NDArray[np.bool_]

FRESH_WALL_KINDS = frozenset({"drag", "return"})
"""Kinds of run in which the capsule slides into wall that it has not touched yet."""
SETTLING_S = 0.1
"""Start of the steady phase that is ignored in every other kind: the stage settles at its speed."""
CREEP_S = 0.1
"""End of the rest that is ignored, at most a quarter of the rest."""
HOLD_END_S = 1.0
"""The end of the hold is its last second, at most its second half."""
MAX_CHANCE_REPEATS = 4
"""More equal samples in a row at the very top or bottom of a noisy trace do not come about by chance."""

FAULT_SIGMAS = 6.0
"""A pulse begins and ends with steps of so many times what neighbouring samples usually differ by."""
MAX_PULSE_SHARE = 0.01
"""Where more of the steps are so large, they are how the record is."""
MIN_PULSE_STEPS = 60
"""So many large steps are no reason not to look for pulses: of a ramp, in a short record."""
MAX_IMPULSE_SAMPLES = 3
MAX_DROPOUT_S, STILL_MM = 0.25, 0.1
"""Longest time for which a reading stays exactly constant and is still taken for a dropout; a drive's reads so too
while the stage moves by less."""
MIN_DROPOUT_SAMPLES, CHANCE_DROPOUTS, MAX_EQUAL_SHARE = 5, 1e-6, 0.3
"""A constant reading is a dropout where chance makes so few of its length in a record, and where no more than this
share of samples equal their neighbours: a coarse converter rests on a count as slow noise wanders."""
SHARE_BY_SLOW_NOISE = 0.1
CALM_SAMPLES, CALM_SHARE, CALM_SIGMAS = 4, 0.3, 3.0
"""Before and after a pulse so many steps are smaller than this share of it, or than so many usual ones."""
SMALL_SIGMAS, SUSPECT_SIGMAS, MAX_SMALL_SAMPLES = 6.5, 3.5, 6
"""A small pulse, or two in succession, is off a parabola through the force around it by so many standard deviations.
What is off the running median by more than the second does not belong to the force around it."""
SIDE_SAMPLES, MIN_SIDE_SAMPLES = 6, 4
"""Samples on each side that the parabola explains; at rest a constant does, near the record's end a straight line."""
SMOOTH_SIGMAS, SMOOTH_SHARE = 1.8, 0.1
"""It explains them where it leaves no more than so many standard deviations, or this share of the pulse."""
MIN_ONE_SIDED_SHARE = 0.5
"""A pulse is off straight lines through either side by this share of its height: the tip of a kink is on both."""
NEAR_EVENT_S = 0.01
"""So near to a begin or end of a phase, a pulse may be of the motion: of a mass that is accelerated, say."""
BURST_SIGMAS, MIN_BURST_S, MAX_BURST_S, BURST_WINDOW_S, MIN_CALM_S = 8.0, 0.02, 0.15, 0.4, 1.0
"""A burst is off the running median over the window by so many standard deviations; in 32 campaigns without bursts the
force came to 7. Shorter bumps are impulses, longer ones raise that median; shorter phases show no noise."""


@dataclass(frozen=True, slots=True)
class ForcePulse:
    """Samples `begin` to `end` far off those before and after them: an impulse, or a dropout of constant samples."""

    begin: int
    end: int
    height_mN: float
    dropout: bool
    near_phase: int | None
    """Number of the phase that begins near it; None where none does."""


@dataclass(frozen=True, slots=True)
class ForceBurst:
    """A bump of the force while the motion is calm, to which neither the force before it nor that after it leads."""

    duration_s: float
    height_mN: float


def attribute_number(attributes: Mapping[str, Attribute], *keys: str) -> float | None:
    """First finite number among attributes of a run; None where there is none."""
    for key in keys:
        value = attributes.get(key)
        if isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value):
            return float(value)
    return None


def gap_starts(time: FloatArray, sample_rate_hz: float) -> IndexArray:
    """Index of each first sample after a gap.

    Parameters
    ----------
    time
        Times of the samples [s], shape `(N,)`.
    sample_rate_hz
        Rate between the gaps. A step that differs from `1 / sample_rate_hz` by more than half of it is a gap.
    """
    steps = np.diff(time) * sample_rate_hz
    return np.flatnonzero(np.abs(steps - 1) > 0.5) + 1


def unbroken_slices(values: FloatArray, gaps: npt.ArrayLike = ()) -> Iterator[slice]:
    """Yield the stretches of `values` without a gap and without NaN or infinity, in order.

    Raises `AnalysisError` when an index in `gaps` lies outside the values.
    """
    starts = np.unique(np.asarray(gaps, dtype=np.intp))
    if starts.size and (starts[0] < 0 or starts[-1] > len(values)):
        raise AnalysisError(
            f"A gap at sample {int(starts[0] if starts[0] < 0 else starts[-1])} lies outside the {len(values)} samples "
            "of the trace; give the index of each first sample after a gap."
        )
    for begin, end in pairwise((0, *starts.tolist(), len(values))):
        for start, stop in mask_spans(np.isfinite(values[begin:end])):
            yield slice(begin + start, begin + stop)


def mask_spans(mask: Mask) -> list[tuple[int, int]]:
    """Start and stop of each run of true values."""
    padded = np.concatenate(([False], mask, [False]))
    edges = np.flatnonzero(padded[1:] != padded[:-1]).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def in_phase(trace: Trace, phase: Phase) -> Mask:
    """Which samples belong to a phase."""
    return np.asarray(trace.phase == int(phase))


def at_rest(trace: Trace) -> Mask:
    """Which samples show the rest before the motion.

    Its end is ignored: a stage whose jerk is limited creeps off before its phase says so, too slowly for
    the encoder, and Coulomb friction acts at once.
    """
    rest = in_phase(trace, Phase.REST)
    if not rest.any():
        return rest
    begin, end = float(trace.time[rest][0]), float(trace.time[rest][-1])
    return rest & (trace.time <= end - min(CREEP_S, (end - begin) / 4))


def steady_stretch(run: Run) -> tuple[Mask, str]:
    """Which samples show steady sliding, and in words how they were chosen.

    In a drag test the wall under the leading hemisphere at the start has been in contact for the whole
    dwell; the force is steady once the capsule has moved by the contact length R sin α (5.6 mm for a
    capsule of 12.9 mm and 60°), when all of it has been replaced. In every other kind only the first 0.1 s of
    the steady phase is ignored.
    """
    trace = run.trace
    steady = in_phase(trace, Phase.STEADY)
    if not steady.any():
        return steady, "the run has no steady phase"
    if run.info.kind not in FRESH_WALL_KINDS:
        start = float(trace.time[steady][0])
        return steady & (trace.time >= start + SETTLING_S), f"the steady phase after its first {SETTLING_S:g} s"
    capsule = run.info.header.capsule
    diameter, angle = attribute_number(capsule, "diameter_mm"), attribute_number(capsule, "contact_angle_deg")
    if diameter is None or angle is None:
        return np.zeros_like(steady), "the capsule's diameter or contact angle is not given"
    length = 0.5 * diameter * sin(radians(angle))
    travel = np.abs(np.asarray(trace.position, dtype=np.float64) - float(trace.position[0]))
    return steady & (travel >= length), f"the steady phase after {length:.2f} mm of travel"


def end_of_hold(trace: Trace) -> Mask:
    """Which samples belong to the end of the hold."""
    hold = in_phase(trace, Phase.HOLD)
    if not hold.any():
        return hold
    begin, end = float(trace.time[hold][0]), float(trace.time[hold][-1])
    return hold & (trace.time >= end - min(HOLD_END_S, (end - begin) / 2))


MAX_MEASURABLE_MN = 1e12
"""A larger force is a fault of its file; squared, it may exceed what a number holds."""


def clipped_samples(run: Run) -> Mask:
    """Which samples of the signal are clipped at the end of the sensor's range.

    Where the run's checks counted clipped samples, they are those at the trace's extremes. A run
    without checks is judged by its trace: an extreme held for more than four samples, while the samples
    around it are noisy. A value that no sensor can measure counts as clipped everywhere.
    """
    force = run.trace.force
    counted = run.info.checks.get("clipped_samples")
    clipped = np.asarray(np.abs(force) > MAX_MEASURABLE_MN)
    if not np.isfinite(force).any() or (counted is not None and not counted):
        return clipped
    for extreme in (np.nanmax(force), np.nanmin(force)):
        held = np.asarray(force == extreme)
        start, stop = max(mask_spans(held), key=lambda span: span[1] - span[0])
        around = np.concatenate((force[max(0, start - 50) : start], force[stop : stop + 50]))
        is_noisy = len(around) > 1 and float(np.nanmedian(np.abs(np.diff(around)))) > 0
        if counted or (stop - start > MAX_CHANCE_REPEATS and is_noisy):
            clipped |= held
    return clipped


def force_pulses(trace: Trace) -> tuple[ForcePulse, ...]:
    """Return the pulses of a force, which means over blocks would hide.

    Impulses are up to three samples between two large steps in opposite directions, around which the force is calm; or
    a few samples that are less far off, but clearly off the smooth force around them. Dropouts are samples that are
    exactly equal for longer than noise allows, or between two such steps.
    """
    force = np.asarray(trace.force, dtype=np.float64)
    known = np.isfinite(force)
    if np.count_nonzero(known) < 2 * MAX_SMALL_SAMPLES + 1:
        return ()
    steps = np.nan_to_num(np.diff(force))
    usual = _usual_step(steps)
    jumps = _jumps(steps, FAULT_SIGMAS * usual)
    if jumps.size > max(MAX_PULSE_SHARE * steps.size, MIN_PULSE_STEPS):
        return ()
    found = {
        span: (height, True)
        for span, is_long in _constant_spans(force, trace.sample_rate_hz)
        if (height := _height_off_median(force, *span)) > FAULT_SIGMAS * usual or is_long
    }
    found |= dict(_large_pulses(force, steps, jumps, usual, trace.sample_rate_hz))
    for begin, end in [at for at, (_, dropout) in found.items() if dropout and trace.signal == "motor_force"]:
        # The signal of a drive is constant while it holds its place.
        if abs(float(trace.position[end - 1] - trace.position[begin])) < STILL_MM:
            del found[begin, end]
    usable = known.copy()
    for begin, end in found:
        usable[begin:end] = False
    filled = np.interp(np.arange(force.size), np.flatnonzero(usable), force[usable])
    resting = in_phase(trace, Phase.REST)
    found |= {
        span: (height, False) for span, height in _small_pulses(filled, usable, resting, usual / float(np.sqrt(2.0)))
    }
    phase = np.asarray(trace.phase, dtype=np.int16)
    changes = np.flatnonzero(np.diff(phase))

    def near_phase(begin: int, end: int) -> int | None:
        near = CALM_SAMPLES + NEAR_EVENT_S * trace.sample_rate_hz + (end - begin)
        beside = changes[np.abs(changes - (begin - 1)) <= near]
        # What ends before the motion begins is not the motion's.
        return int(phase[beside[0] + 1]) if beside.size and not resting[begin : end + 1].all() else None

    return tuple(
        ForcePulse(begin, end, height, dropout, near_phase(begin, end))
        for (begin, end), (height, dropout) in sorted(found.items())
    )


def force_bursts(trace: Trace, valid: Mask) -> tuple[ForceBurst, ...]:
    """Return the bursts of a force in rest, steady motion and hold; samples that are not valid count for nothing."""
    from scipy.ndimage import median_filter

    rate, found = trace.sample_rate_hz, list[ForceBurst]()
    window, least = (2 * (round(time_s * rate) // 2) + 1 for time_s in (BURST_WINDOW_S, MIN_BURST_S))
    if np.count_nonzero(valid) < MIN_CALM_S * rate:
        return ()
    force = np.interp(np.arange(valid.size), np.flatnonzero(valid), np.asarray(trace.force, np.float64)[valid])
    calm_phases = (in_phase(trace, phase) for phase in (Phase.REST, Phase.STEADY, Phase.HOLD))
    for begin, end in chain.from_iterable(map(mask_spans, calm_phases)):
        calm = force[begin + window : end]
        if calm.size < MIN_CALM_S * rate:
            continue
        # A median over the shortest burst leaves no impulse.
        off = median_filter(calm - median_filter(calm, window), least)
        least_mN = BURST_SIGMAS * _usual_step(off)
        found += [
            ForceBurst((stop - start) / rate, float(np.abs(off[start:stop]).max()))
            for start, stop in mask_spans(np.abs(off) > least_mN)
            if stop - start <= MAX_BURST_S * rate and window // 2 < start < stop < off.size - window // 2
        ]
    return tuple(found)


def _jumps(steps: FloatArray, least: float) -> IndexArray:
    """Return which steps are large, and larger by as much than those around: on a ramp every step is large."""
    jumps = np.flatnonzero(np.abs(steps) > least)
    first_near = np.clip(jumps - CALM_SAMPLES, 0, max(steps.size - 2 * CALM_SAMPLES - 1, 0))
    around = np.minimum(first_near[:, None] + np.arange(2 * CALM_SAMPLES + 1), steps.size - 1)
    return np.asarray(jumps[np.abs(steps[jumps] - np.median(steps[around], axis=1)) > least])


def _large_pulses(
    force: FloatArray, steps: FloatArray, jumps: IndexArray, usual: float, rate_hz: float
) -> Iterator[tuple[tuple[int, int], tuple[float, bool]]]:
    """Yield begin and end of pulses between large steps, with their height and whether they are dropouts."""
    for first, last in pairwise(jumps.tolist()):
        begin, end = first + 1, last + 1
        height = _pulse_height(force, steps, begin, end, CALM_SIGMAS * usual)
        short = end - begin <= MAX_IMPULSE_SAMPLES
        is_constant = end - begin <= MAX_DROPOUT_S * rate_hz and np.ptp(force[begin:end]) == 0.0
        if height > 0.0 and (short or is_constant):
            yield (begin, end), (height, not short)


def _constant_spans(force: FloatArray, rate_hz: float) -> Iterator[tuple[tuple[int, int], bool]]:
    """Yield where a reading stays exactly constant, and whether for longer than noise and converter allow."""
    equal = np.diff(force) == 0.0
    # How often a sample that changed equals the next one: a dropout counts once, however long it is.
    changed = ~equal[:-1]
    share = float(np.mean(equal[1:][changed])) if changed.any() else 1.0
    if share > MAX_EQUAL_SHARE:
        return
    # Slow noise makes the next equal one likelier than the first.
    by_chance = 1.0 + np.log(CHANCE_DROPOUTS / force.size) / np.log(share + SHARE_BY_SLOW_NOISE)
    for begin, stop in mask_spans(equal):
        samples = stop + 1 - begin
        if MIN_DROPOUT_SAMPLES <= samples <= MAX_DROPOUT_S * rate_hz:
            yield (begin, stop + 1), samples >= by_chance


def _height_off_median(force: FloatArray, begin: int, end: int) -> float:
    """Return how far a reading is off those before it and those after it, in the median; 0 where it is between them."""
    sides = force[max(begin - SIDE_SAMPLES, 0) : begin], force[end : end + SIDE_SAMPLES]
    offs = [float(force[begin]) - float(np.nanmedian(side)) for side in sides if np.isfinite(side).any()]
    return min(map(abs, offs)) if offs and min(offs) * max(offs) > 0 else 0.0


def _small_pulses(force: FloatArray, usable: Mask, resting: Mask, sd: float) -> Iterator[tuple[tuple[int, int], float]]:
    """Yield begin and end of the samples that are off the smooth force around them, with their height."""
    from scipy.ndimage import binary_closing, median_filter

    off = np.where(usable, force - median_filter(force, 2 * MAX_SMALL_SAMPLES + 1, mode="reflect"), 0.0)
    # Hum and the counts of a converter are off the running median by more than steps tell.
    count = float(np.min(np.abs(off[off != 0]), initial=np.inf))
    sd = max(sd, 1.4826 * (float(np.median(np.abs(off[usable]))) + 0.5 * (count if np.isfinite(count) else 0.0)))
    suspect = np.abs(off) > SUSPECT_SIGMAS * sd
    around = usable & ~suspect
    # One sample that noise brings back does not end a pulse; the begin of the motion does.
    parts = [suspect & part & (off * sign > 0) for part in (resting, ~resting) for sign in (1.0, -1.0)]
    spans = [mask_spans(binary_closing(np.pad(part, 1), np.ones(3, dtype=np.bool_))[1:-1] & usable) for part in parts]
    for begin, end in sorted(set().union(*spans)):
        clearness = abs(float(off[begin:end].mean())) * np.sqrt(end - begin)
        if end - begin <= MAX_SMALL_SAMPLES and clearness > (SMALL_SIGMAS - 1.0) * sd:
            height = _height_off_smooth(force, around, resting, (begin, end), sd)
            if height > 0.0:
                yield (begin, end), height


def _height_off_smooth(force: FloatArray, usable: Mask, resting: Mask, span: tuple[int, int], sd: float) -> float:
    """Return how far samples are off the curve through those around them; 0 where these are not smooth."""
    begin, end = span
    one_sided = bool(resting[begin:end].all()) or min(begin, force.size - end) < MIN_SIDE_SAMPLES
    count = (1 + one_sided) * SIDE_SAMPLES
    first, last = max(begin - 2 * count, 0), min(end + 2 * count, force.size)
    before, after = np.flatnonzero(usable[first:begin]) + first, np.flatnonzero(usable[end:last]) + end
    near, degree = np.concatenate((before[-count:], after[:count])), 2
    if one_sided:
        near, degree = near[resting[near] == resting[begin]], 0 if resting[begin] else 1
    if near.size < 2 * MIN_SIDE_SAMPLES or (not one_sided and min(before.size, after.size) < MIN_SIDE_SAMPLES):
        return 0.0
    middle = 0.5 * (begin + end - 1)
    powers, inside = (np.vander((index - middle) / SIDE_SAMPLES, degree + 1) for index in (near, np.arange(begin, end)))
    inverse = np.linalg.pinv(powers)
    left = force[near] - powers @ (inverse @ force[near])
    offs = force[begin:end] - inside @ (inverse @ force[near])
    height = float(offs.mean())
    height_sd = sd * float(np.sqrt(1.0 / offs.size + np.sum((inside @ inverse).mean(axis=0) ** 2)))
    misfit = float(np.sqrt(np.sum(left**2) / (near.size - degree - 1)))
    smooth = misfit < max(SMOOTH_SIGMAS * sd, SMOOTH_SHARE * abs(height))
    clear = abs(height) > SMALL_SIGMAS * height_sd and bool(np.all(offs * height > 0))
    if not (smooth and clear):
        return 0.0
    for side in () if one_sided else (near[near < begin], near[near >= end]):
        level = float(np.polyfit(side - middle, force[side], 1)[1])
        if (float(force[begin:end].mean()) - level) / height < MIN_ONE_SIDED_SHARE:
            return 0.0
    return abs(height)


def _usual_step(steps: FloatArray) -> float:
    """Return the standard deviation of steps between samples, or off a median, at least the smallest one."""
    sizes = np.abs(steps)
    return max(1.4826 * float(np.median(sizes)), float(np.min(sizes[sizes > 0], initial=np.inf)))


def _pulse_height(force: FloatArray, steps: FloatArray, begin: int, end: int, usual: float) -> float:
    """Return how far samples are off those before and after, which agree and are calm; 0 where they are no pulse."""
    before, after = force[max(begin - CALM_SAMPLES, 0) : begin], force[end : end + CALM_SAMPLES]
    around = np.concatenate((np.diff(before), np.diff(after)))
    if not before.size or not after.size or around.size < CALM_SAMPLES - 1:
        return 0.0
    slope = float(np.median(around))
    entering, leaving = float(steps[begin - 1]) - slope, float(steps[end - 1]) - slope
    height = min(abs(entering), abs(leaving))
    calm_mN = max(CALM_SHARE * height, usual)
    distance = 0.5 * (before.size + after.size) + end - begin
    rise = float(np.median(after)) - float(np.median(before)) - slope * distance
    calm = float(np.abs(around - slope).max()) < calm_mN
    return height if entering * leaving < 0 and calm and abs(rise) < calm_mN else 0.0
