"""Two runs aligned on one clock: filtered alike, interpolated where their samples do not coincide."""

from dataclasses import dataclass

import numpy as np

from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.savgol import SavgolSettings, default_filter_settings, smooth
from dragrig.analysis.segments import Mask, gap_starts
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import AnyFloatArray, FloatArray, PhaseArray
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Run, Trace

ALIGNMENT_LEAD_S = 0.05
ALIGNMENT_TRAVEL_MM = 2.0
"""The start of the way, over which two positions are laid on each other."""
MAX_ALIGNMENT_S = 0.5
MAX_REFINEMENT_SAMPLES = 3.0
"""The recorded rest ends within so many samples of the start of motion."""
ITERATIONS = 8


def start_of_motion(run: Run) -> float | None:
    """Return the time in the file [s] at which the recorded position leaves its first rest; None where it never does.

    Where the positions cannot be used, or show no rest, it is where the phases say that the rest ends.
    """
    trace = run.trace
    if not trace.time.size:
        return None
    try:
        motion = Experiment(run).motion
    except AnalysisError:
        pass  # a spoilt position; the phases still tell
    else:
        moving = np.flatnonzero(motion.signs)
        if moving.size and moving[0] > 0:
            seen = np.flatnonzero(np.isfinite(trace.position))
            return float(trace.time[seen[0]] + motion.breaks_s[moving[0]])
        if not moving.size:
            return None
    off = np.flatnonzero((trace.phase > Phase.REST) & (trace.phase < Phase.HOLD))
    return float(trace.time[off[0]]) if off.size else None


def time_shift(a: Run, b: Run) -> float | None:
    """Return what is to be added to the times of B so that both begin to move at the same time.

    The starts are found to about a sample each; sliding the first millimetres of the two positions over each other
    by least squares makes that a small part of one.
    """
    starts = start_of_motion(a), start_of_motion(b)
    if starts[0] is None or starts[1] is None:
        return None
    shift = starts[0] - starts[1]
    limit = MAX_REFINEMENT_SAMPLES / min(a.trace.sample_rate_hz, b.trace.sample_rate_hz)
    return shift + _refine_shift(a, b, starts[0], shift, limit)


def _refine_shift(a: Run, b: Run, start_s: float, shift_s: float, limit_s: float) -> float:
    time, position = _finite_positions(a)
    other_time, other = _finite_positions(b)
    if position.size < 2 or other.size < 2:
        return 0.0
    way = np.abs(position - position[np.searchsorted(time, start_s).clip(0, time.size - 1)])
    arrived = time[(time > start_s) & (way > ALIGNMENT_TRAVEL_MM)]
    until = min(start_s + MAX_ALIGNMENT_S, float(arrived[0]) if arrived.size else np.inf)
    window = (time >= start_s - ALIGNMENT_LEAD_S) & (time <= until)
    if np.count_nonzero(window) < 4:
        return 0.0
    at, mine = time[window], position[window] - position[window][0]
    fine = 0.0
    for _ in range(ITERATIONS):
        theirs = np.interp(at - shift_s - fine, other_time, other)
        slope = np.gradient(theirs, at)
        strength = float(slope @ slope)
        if strength == 0:
            return 0.0
        # A constant between the two positions is no shift.
        miss = (theirs - theirs[0]) - mine
        fine += float(slope @ miss) / strength
    return fine if abs(fine) <= limit_s else 0.0


def _finite_positions(run: Run) -> tuple[FloatArray, FloatArray]:
    position = np.asarray(run.trace.position, dtype=np.float64)
    seen = np.isfinite(position)
    return run.trace.time[seen], position[seen]


SAME_RATE_TOLERANCE = 0.05
"""Rates that differ by a smaller share of a sample over the whole run are the same."""


@dataclass(frozen=True, slots=True, eq=False)
class AlignedRuns:
    """Two runs on one clock, which counts from the start of A's motion.

    Attributes
    ----------
    a, b
        The runs as read.
    start_a_s, start_b_s
        Times in either file that are 0 on the clock.
    shift_s
        What was added to the times of B; None where no motion shows, and the files' own times are used.
    time_s
        The clock at the samples of the slower run that both cover, shape `(N,)`.
    force_a, force_b
        Filtered signals [mN] as recorded, shape `(N,)`; NaN where samples are missing.
    position_a, position_b
        Recorded positions [mm], shape `(N,)`.
    phase_a, phase_b
        Phases of both, shape `(N,)`.
    remarks
        What was interpolated, and onto what.
    """

    a: Run
    b: Run
    start_a_s: float
    start_b_s: float
    shift_s: float | None
    time_s: FloatArray
    force_a: FloatArray
    force_b: FloatArray
    position_a: FloatArray
    position_b: FloatArray
    phase_a: PhaseArray
    phase_b: PhaseArray
    remarks: tuple[str, ...] = ()

    @property
    def together(self) -> Mask:
        """Where both runs are in the same phase, shape `(N,)`."""
        return np.asarray(self.phase_a == self.phase_b)


def align_runs(a: Run, b: Run) -> AlignedRuns:
    """Lay two runs over each other.

    Raises
    ------
    AnalysisError
        One sentence, where a run is too short for the filter or the two have no time in common.
    """
    shift = time_shift(a, b)
    start_a = (start_of_motion(a) if shift is not None else None) or 0.0
    start_b = start_a - (shift or 0.0)
    a_leads = a.trace.sample_rate_hz <= b.trace.sample_rate_hz * (1 + SAME_RATE_TOLERANCE / max(len(b.trace.time), 1))
    slow, start = (a.trace, start_a) if a_leads else (b.trace, start_b)
    clock = np.asarray(slow.time - start, dtype=np.float64)
    begin = max(float(run.trace.time[0]) - own for run, own in ((a, start_a), (b, start_b)))
    end = min(float(run.trace.time[-1]) - own for run, own in ((a, start_a), (b, start_b)))
    half = 0.5 / slow.sample_rate_hz
    clock = clock[(clock >= begin - half) & (clock <= end + half)]
    if clock.size < 2:
        raise AnalysisError(f"{a.info.path.name} and {b.info.path.name}: the two runs have no time in common")
    settings = default_filter_settings(slow.sample_rate_hz)
    window = SavgolSettings(window_s=settings.samples(slow.sample_rate_hz) / slow.sample_rate_hz)
    return AlignedRuns(
        a=a,
        b=b,
        start_a_s=start_a,
        start_b_s=start_b,
        shift_s=shift,
        time_s=clock,
        force_a=_interpolated(a.trace, _filtered_force(a, window), clock + start_a),
        force_b=_interpolated(b.trace, _filtered_force(b, window), clock + start_b),
        position_a=_interpolated(a.trace, a.trace.position, clock + start_a),
        position_b=_interpolated(b.trace, b.trace.position, clock + start_b),
        phase_a=_phase_at(a.trace, clock + start_a),
        phase_b=_phase_at(b.trace, clock + start_b),
        remarks=tuple(_alignment_remarks(a, b, a_leads=a_leads, aligned=shift is not None)),
    )


def _filtered_force(run: Run, window: SavgolSettings) -> FloatArray:
    trace = run.trace
    try:
        gaps = gap_starts(trace.time, trace.sample_rate_hz)
        return smooth(trace.force, trace.sample_rate_hz, window, gaps, trace.time).values
    except AnalysisError as error:
        raise AnalysisError(f"{run.info.path.name}: {error}") from error


def _interpolated(trace: Trace, values: AnyFloatArray, time_s: FloatArray) -> FloatArray:
    """Interpolate a channel, never across a gap; half a sample beyond the ends stands for the end."""
    own = trace.time
    inside = np.interp(time_s, own, np.asarray(values, dtype=np.float64))
    after = np.clip(np.searchsorted(own, time_s), 1, own.size - 1)
    bridged = (own[after] - own[after - 1]) * trace.sample_rate_hz > 1.5
    between = (time_s > own[after - 1]) & (time_s < own[after])
    return np.asarray(np.where(bridged & between, np.nan, inside))


def _phase_at(trace: Trace, time_s: FloatArray) -> PhaseArray:
    half = 0.5 / trace.sample_rate_hz
    nearest = np.clip(np.searchsorted(trace.time, time_s + half, side="right") - 1, 0, trace.time.size - 1)
    return np.asarray(trace.phase[nearest])


def _alignment_remarks(a: Run, b: Run, *, a_leads: bool, aligned: bool) -> list[str]:
    rates = a.trace.sample_rate_hz, b.trace.sample_rate_hz
    said = []
    if abs(rates[0] / rates[1] - 1) * max(len(a.trace.time), len(b.trace.time)) > SAME_RATE_TOLERANCE:
        fast, slow = ("B", "A") if a_leads else ("A", "B")
        said.append(
            f"A was sampled at {rates[0]:g} Hz and B at {rates[1]:g} Hz: {fast} is interpolated onto {slow}'s samples"
        )
    if not aligned:
        said.append("no start of motion shows in the positions, so that the files' own times are compared")
    return said
