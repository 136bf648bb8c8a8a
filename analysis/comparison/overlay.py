"""Two runs aligned on one clock: filtered alike, interpolated where their samples do not coincide."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.savgol import SavgolSettings, default_filter_settings, smooth_channel
from dragrig.analysis.segments import Mask
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import AnyFloatArray, FloatArray, PhaseArray
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Run, Trace

ALIGNMENT_LEAD_S = 0.05
ALIGNMENT_TRAVEL_MM = 2.0
"""The start of the motion, over which two positions are aligned."""
MAX_ALIGNMENT_S = 0.5
MAX_REFINEMENT_SAMPLES = 3.0
"""The recorded rest ends within this many samples of the start of motion."""
ITERATIONS = 8
SAME_RATE_TOLERANCE = 0.05
"""Rates that differ by a smaller part of a sample over the whole run are equal."""


def start_of_motion(run: Run) -> float | None:
    """Return the time in the file [s] at which the recorded position leaves its first rest; None where it never does.

    Where the positions cannot be used, or show no rest, it is the end of the rest phase.
    """
    trace = run.trace
    if not trace.time.size:
        return None
    try:
        motion = Experiment(run).motion
    except AnalysisError:
        pass  # an unusable position; the phases remain
    else:
        moving = np.flatnonzero(motion.signs)
        if moving.size and moving[0] > 0:
            first = np.isfinite(trace.position).argmax()
            return float(trace.time[first] + motion.breaks_s[moving[0]])
        if not moving.size:
            return None
    in_motion = np.flatnonzero((trace.phase > Phase.REST) & (trace.phase < Phase.HOLD))
    return float(trace.time[in_motion[0]]) if in_motion.size else None


def time_shift(a: Run, b: Run) -> float | None:
    """Return the shift of B's times so that both start to move at the same time; None where either never moves.

    The starts are found to about a sample each; aligning the first millimetres of the two positions by least squares
    reduces that to a small part of a sample.
    """
    start_a, start_b = start_of_motion(a), start_of_motion(b)
    if start_a is None or start_b is None:
        return None
    shift = start_a - start_b
    limit = MAX_REFINEMENT_SAMPLES / min(a.trace.sample_rate_hz, b.trace.sample_rate_hz)
    return shift + _refine_shift(a, b, start_a, shift, limit)


def _refine_shift(a: Run, b: Run, start_s: float, shift_s: float, limit_s: float) -> float:
    time_a, position_a = _finite_positions(a)
    time_b, position_b = _finite_positions(b)
    if position_a.size < 2 or position_b.size < 2:
        return 0.0
    travel = np.abs(position_a - position_a[np.searchsorted(time_a, start_s).clip(0, time_a.size - 1)])
    beyond = time_a[(time_a > start_s) & (travel > ALIGNMENT_TRAVEL_MM)]
    until = min(start_s + MAX_ALIGNMENT_S, float(beyond[0]) if beyond.size else np.inf)
    window = (time_a >= start_s - ALIGNMENT_LEAD_S) & (time_a <= until)
    if np.count_nonzero(window) < 4:
        return 0.0
    time, reference = time_a[window], position_a[window] - position_a[window][0]
    refinement = 0.0
    for _ in range(ITERATIONS):
        shifted = np.interp(time - shift_s - refinement, time_b, position_b)
        slope = np.gradient(shifted, time)
        squared_slope = float(slope @ slope)
        if squared_slope == 0:
            return 0.0
        # A constant between the two positions is no shift.
        difference = (shifted - shifted[0]) - reference
        refinement += float(slope @ difference) / squared_slope
    return refinement if abs(refinement) <= limit_s else 0.0


def _finite_positions(run: Run) -> tuple[FloatArray, FloatArray]:
    position = np.asarray(run.trace.position, dtype=np.float64)
    finite = np.isfinite(position)
    return run.trace.time[finite], position[finite]


@dataclass(frozen=True, slots=True, eq=False)
class AlignedRuns:
    """Two runs on one clock, which counts from the start of A's motion.

    Attributes
    ----------
    a, b
        The runs as read.
    start_a_s, start_b_s
        Times in the files that are 0 on the clock.
    shift_s
        Added to the times of B; None where no motion shows, and the files' own times are used.
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
    """Align two runs by the start of their motion.

    Raises
    ------
    AnalysisError
        One sentence, where a run is too short for the filter or the two have no time in common.
    """
    shift = time_shift(a, b)
    start_a = (start_of_motion(a) if shift is not None else None) or 0.0
    start_b = start_a - (shift or 0.0)
    a_is_slower = a.trace.sample_rate_hz <= b.trace.sample_rate_hz * (
        1 + SAME_RATE_TOLERANCE / max(len(b.trace.time), 1)
    )
    slow, start = (a.trace, start_a) if a_is_slower else (b.trace, start_b)
    clock = np.asarray(slow.time - start, dtype=np.float64)
    begin = max(float(a.trace.time[0]) - start_a, float(b.trace.time[0]) - start_b)
    end = min(float(a.trace.time[-1]) - start_a, float(b.trace.time[-1]) - start_b)
    half_step = 0.5 / slow.sample_rate_hz
    clock = clock[(clock >= begin - half_step) & (clock <= end + half_step)]
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
        remarks=tuple(_alignment_remarks(a, b, a_is_slower=a_is_slower, aligned=shift is not None)),
    )


def _filtered_force(run: Run, window: SavgolSettings) -> FloatArray:
    try:
        return smooth_channel(run.trace, run.trace.force, window).values
    except AnalysisError as error:
        raise AnalysisError(f"{run.info.path.name}: {error}") from error


def _interpolated(trace: Trace, values: AnyFloatArray, time_s: FloatArray) -> FloatArray:
    """Interpolate a channel, never across a gap; half a sample beyond the ends the end value is used."""
    own_s = trace.time
    interpolated = np.interp(time_s, own_s, np.asarray(values, dtype=np.float64))
    after = np.clip(np.searchsorted(own_s, time_s), 1, own_s.size - 1)
    is_gap = (own_s[after] - own_s[after - 1]) * trace.sample_rate_hz > 1.5
    between = (time_s > own_s[after - 1]) & (time_s < own_s[after])
    return np.asarray(np.where(is_gap & between, np.nan, interpolated))


def _phase_at(trace: Trace, time_s: FloatArray) -> PhaseArray:
    half_step = 0.5 / trace.sample_rate_hz
    nearest = np.clip(np.searchsorted(trace.time, time_s + half_step, side="right") - 1, 0, trace.time.size - 1)
    return np.asarray(trace.phase[nearest])


def _alignment_remarks(a: Run, b: Run, *, a_is_slower: bool, aligned: bool) -> Iterator[str]:
    rates = a.trace.sample_rate_hz, b.trace.sample_rate_hz
    if abs(rates[0] / rates[1] - 1) * max(len(a.trace.time), len(b.trace.time)) > SAME_RATE_TOLERANCE:
        fast, slow = ("B", "A") if a_is_slower else ("A", "B")
        yield f"A was sampled at {rates[0]:g} Hz and B at {rates[1]:g} Hz: {fast} is interpolated onto {slow}'s samples"
    if not aligned:
        yield "the positions show no start of motion, so that the files' own times are compared"
