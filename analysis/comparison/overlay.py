"""Two runs on one clock: filtered alike, interpolated where their samples do not coincide, subtracted."""

from dataclasses import dataclass

import numpy as np

from dragrig.analysis.comparison.clock import shift_between, start_of_motion
from dragrig.analysis.filtering import usual_settings
from dragrig.analysis.gaps import gap_starts
from dragrig.analysis.phases import Mask
from dragrig.analysis.savgol import SavgolSettings, smooth
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import AnyFloatArray, FloatArray, PhaseArray
from dragrig.rig.runfile.model import Run, Trace

NEARLY = 0.05
"""Rates that differ by a smaller share of a sample over the whole run are the same."""


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
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


def lay_over(a: Run, b: Run) -> Overlay:
    """Lay two runs over each other.

    Raises
    ------
    AnalysisError
        One sentence, where a run is too short for the filter or the two have no time in common.
    """
    shift = shift_between(a, b)
    start_a = (start_of_motion(a) if shift is not None else None) or 0.0
    start_b = start_a - (shift or 0.0)
    a_leads = a.trace.sample_rate_hz <= b.trace.sample_rate_hz * (1 + NEARLY / max(len(b.trace.time), 1))
    slow, start = (a.trace, start_a) if a_leads else (b.trace, start_b)
    clock = np.asarray(slow.time - start, dtype=np.float64)
    begin = max(float(run.trace.time[0]) - own for run, own in ((a, start_a), (b, start_b)))
    end = min(float(run.trace.time[-1]) - own for run, own in ((a, start_a), (b, start_b)))
    half = 0.5 / slow.sample_rate_hz
    clock = clock[(clock >= begin - half) & (clock <= end + half)]
    if clock.size < 2:
        raise AnalysisError(f"{a.info.path.name} and {b.info.path.name}: the two runs have no time in common")
    settings = usual_settings(slow.sample_rate_hz)
    window = SavgolSettings(window_s=settings.samples(slow.sample_rate_hz) / slow.sample_rate_hz)
    return Overlay(
        a=a,
        b=b,
        start_a_s=start_a,
        start_b_s=start_b,
        shift_s=shift,
        time_s=clock,
        force_a=_at(a.trace, _filtered(a, window), clock + start_a),
        force_b=_at(b.trace, _filtered(b, window), clock + start_b),
        position_a=_at(a.trace, a.trace.position, clock + start_a),
        position_b=_at(b.trace, b.trace.position, clock + start_b),
        phase_a=_phase(a.trace, clock + start_a),
        phase_b=_phase(b.trace, clock + start_b),
        remarks=tuple(_remarks(a, b, a_leads=a_leads, aligned=shift is not None)),
    )


def _filtered(run: Run, window: SavgolSettings) -> FloatArray:
    trace = run.trace
    try:
        gaps = gap_starts(trace.time, trace.sample_rate_hz)
        return smooth(trace.force, trace.sample_rate_hz, window, gaps, trace.time).values
    except AnalysisError as error:
        raise AnalysisError(f"{run.info.path.name}: {error}") from error


def _at(trace: Trace, values: AnyFloatArray, time_s: FloatArray) -> FloatArray:
    """Interpolate a channel, never across a gap; half a sample beyond the ends stands for the end."""
    own = trace.time
    inside = np.interp(time_s, own, np.asarray(values, dtype=np.float64))
    after = np.clip(np.searchsorted(own, time_s), 1, own.size - 1)
    bridged = (own[after] - own[after - 1]) * trace.sample_rate_hz > 1.5
    between = (time_s > own[after - 1]) & (time_s < own[after])
    return np.asarray(np.where(bridged & between, np.nan, inside))


def _phase(trace: Trace, time_s: FloatArray) -> PhaseArray:
    half = 0.5 / trace.sample_rate_hz
    nearest = np.clip(np.searchsorted(trace.time, time_s + half, side="right") - 1, 0, trace.time.size - 1)
    return np.asarray(trace.phase[nearest])


def _remarks(a: Run, b: Run, *, a_leads: bool, aligned: bool) -> list[str]:
    rates = a.trace.sample_rate_hz, b.trace.sample_rate_hz
    said = []
    if abs(rates[0] / rates[1] - 1) * max(len(a.trace.time), len(b.trace.time)) > NEARLY:
        fast, slow = ("B", "A") if a_leads else ("A", "B")
        said.append(
            f"A was sampled at {rates[0]:g} Hz and B at {rates[1]:g} Hz: {fast} is interpolated onto {slow}'s samples"
        )
    if not aligned:
        said.append("no start of motion shows in the positions, so that the files' own times are compared")
    return said
