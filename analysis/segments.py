"""Which samples of a trace belong together: unbroken pieces, phases of the motion, clipped samples."""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from math import isfinite, radians, sin

import numpy as np
import numpy.typing as npt

from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import AnyFloatArray, FloatArray
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Attribute, Run, Trace

IndexArray = npt.NDArray[np.intp]


def gap_starts(time: FloatArray, sample_rate_hz: float) -> IndexArray:
    """Return the index of each first sample after a gap.

    Parameters
    ----------
    time
        Times of the samples [s], shape `(N,)`.
    sample_rate_hz
        Rate of the samples between the gaps. A step that differs from `1 / sample_rate_hz` by more
        than half of it is a gap.
    """
    steps = np.diff(time) * sample_rate_hz
    return np.flatnonzero(np.abs(steps - 1) > 0.5) + 1


def unbroken_slices(values: FloatArray, gaps: npt.ArrayLike = ()) -> Iterator[slice]:
    """Yield the stretches of `values` without a gap and without NaN or infinity, in order.

    Raises
    ------
    AnalysisError
        When an index in `gaps` lies outside the values.
    """
    starts = np.unique(np.asarray(gaps, dtype=np.intp))
    if starts.size and (starts[0] < 0 or starts[-1] > len(values)):
        raise AnalysisError(
            f"A gap at sample {int(starts[0] if starts[0] < 0 else starts[-1])} lies outside the {len(values)} samples "
            "of the trace; give the index of each first sample after a gap."
        )
    for begin, end in pairwise((0, *starts.tolist(), len(values))):
        for start, stop in finite_spans(values[begin:end]):
            yield slice(begin + start, begin + stop)


def finite_spans(values: FloatArray) -> Iterator[tuple[int, int]]:
    """Yield start and stop of each run of finite values."""
    finite = np.concatenate(([False], np.isfinite(values), [False]))
    edges = np.flatnonzero(finite[1:] != finite[:-1])
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


Mask = npt.NDArray[np.bool_]

FRESH_WALL_KINDS = frozenset({"drag", "return"})
"""Kinds of run in which the capsule slides into wall that it has not touched yet."""
SETTLING_S = 0.1
"""Start of the steady phase that is left out of every other kind: the stage settles at its speed."""
CREEP_S = 0.1
"""End of the rest that is left out, or a quarter of a rest that is shorter than four times as long."""
HOLD_END_S = 1.0
"""The end of the hold is its last second, or its second half when it is shorter than two."""


def in_phase(trace: Trace, phase: Phase) -> Mask:
    """Tell for each sample whether it belongs to a phase."""
    return np.asarray(trace.phase == int(phase))


def at_rest(trace: Trace) -> Mask:
    """Tell which samples show the rest before the motion.

    The last of it is left out: a stage whose jerk is limited creeps off before its phase says so, too slowly for
    the encoder, and Coulomb friction is there at once.
    """
    rest = in_phase(trace, Phase.REST)
    if not rest.any():
        return rest
    begin, end = float(trace.time[rest][0]), float(trace.time[rest][-1])
    return rest & (trace.time <= end - min(CREEP_S, (end - begin) / 4))


def contact_length_mm(capsule: Mapping[str, Attribute]) -> float:
    """Axial length of the contact on the leading hemisphere, R sin α; NaN when the capsule does not say."""
    diameter, angle = capsule.get("diameter_mm"), capsule.get("contact_angle_deg")
    if isinstance(diameter, int | float) and isinstance(angle, int | float):
        return 0.5 * float(diameter) * sin(radians(float(angle)))
    return float("nan")


def steady_stretch(run: Run) -> tuple[Mask, str]:
    """Tell which samples show steady sliding, and how that was found.

    In a drag test the wall under the leading hemisphere at the start has been touched for the whole
    dwell; the force is steady once the capsule has moved by the contact length R sin α (5.6 mm for a
    capsule of 12.9 mm and 60°), when all of it has been replaced. In every other kind only the first 0.1 s of
    the steady phase is left out.
    """
    trace = run.trace
    steady = in_phase(trace, Phase.STEADY)
    if not steady.any():
        return steady, "the run has no steady phase"
    if run.info.kind not in FRESH_WALL_KINDS:
        started = float(trace.time[steady][0])
        return steady & (trace.time >= started + SETTLING_S), f"the steady phase after its first {SETTLING_S:g} s"
    length = contact_length_mm(run.info.header.capsule)
    if not isfinite(length):
        return np.zeros_like(steady), "the capsule's diameter or contact angle is not given"
    moved = np.abs(np.asarray(trace.position, dtype=np.float64) - float(trace.position[0]))
    return steady & (moved >= length), f"the steady phase after {length:.2f} mm of travel"


def end_of_hold(trace: Trace) -> Mask:
    """Tell which samples belong to the end of the hold."""
    hold = in_phase(trace, Phase.HOLD)
    if not hold.any():
        return hold
    begin, end = float(trace.time[hold][0]), float(trace.time[hold][-1])
    return hold & (trace.time >= end - min(HOLD_END_S, (end - begin) / 2))


MAX_CHANCE_REPEATS = 4
"""So many equal samples in a row at the very top or bottom of a noisy trace do not come about by chance."""


def clipped_samples(run: Run) -> npt.NDArray[np.bool_]:
    """Tell for each sample of the signal whether it is clipped.

    Where the run's checks counted clipped samples, those at the trace's extremes are meant. A run
    without checks is judged by its trace: an extreme held for more than four samples, while the samples
    around it are noisy.
    """
    force = run.trace.force
    counted = run.info.checks.get("clipped_samples")
    found = np.zeros(len(force), dtype=np.bool_)
    if not np.isfinite(force).any() or (counted is not None and not counted):
        return found
    for extreme in (np.nanmax(force), np.nanmin(force)):
        at = np.asarray(force == extreme)
        if counted or _is_plateau_in_noise(force, at):
            found |= at
    return found


def _is_plateau_in_noise(force: AnyFloatArray, at: npt.NDArray[np.bool_]) -> bool:
    edges = np.flatnonzero(np.diff(np.concatenate(([False], at, [False])).astype(np.int8)))
    starts, stops = edges[::2], edges[1::2]
    longest = int((stops - starts).argmax())
    start, stop = int(starts[longest]), int(stops[longest])
    if stop - start <= MAX_CHANCE_REPEATS:
        return False
    nearby = np.concatenate((force[max(0, start - 50) : start], force[stop : stop + 50]))
    return len(nearby) > 1 and float(np.nanmedian(np.abs(np.diff(nearby)))) > 0
