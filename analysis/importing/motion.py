"""Phases of a foreign measurement, where its position tells them."""

import numpy as np
import numpy.typing as npt

from dragrig.analysis.gaps import finite_runs
from dragrig.analysis.savgol import SavgolSettings, smooth
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import FloatArray, PhaseArray
from dragrig.rig.profile import Phase

WINDOW_S = 0.05
FEWEST_SAMPLES = 7
MOVING = 0.05
"""Part of the top speed above which the stage is moving."""
STEADY = 0.1
"""How far a speed may be off the plateau and still be steady."""
SHORTEST_PLATEAU = 0.5
"""Part of the motion that must be steady, for it to be one move at one speed."""


def detect_phases(position: FloatArray, sample_rate_hz: float, gaps: npt.ArrayLike = ()) -> PhaseArray | None:
    """Find rest, run-up, steady sliding, run-down and hold of a single move at one speed.

    Parameters
    ----------
    position
        Shape `(N,)`, any unit.
    gaps
        Index of each first sample after a gap.

    Returns
    -------
    PhaseArray or None
        None where the position shows no single move with a plateau of speed between standstills.
    """
    window = max(FEWEST_SAMPLES, 2 * int(WINDOW_S * sample_rate_hz / 2) + 1)
    try:
        setting = SavgolSettings(window_samples=window, order=1, derivative=1)
        speed = smooth(position, sample_rate_hz, setting, gaps).values
    except AnalysisError:
        return None
    if not np.isfinite(speed).all():
        return None
    moving = np.abs(speed) > MOVING * np.quantile(np.abs(speed), 0.98)
    runs = [(start, stop) for start, stop in _runs(moving) if stop - start > window]
    if len(runs) != 1 or (runs[0][0] == 0 and runs[0][1] == len(speed)):
        return None
    start, stop = runs[0]
    plateau = float(np.median(speed[start:stop]))
    steady = _runs(np.abs(speed[start:stop] - plateau) < STEADY * abs(plateau))
    first, last = max(steady, key=lambda run: run[1] - run[0], default=(0, 0))
    if last - first < SHORTEST_PLATEAU * (stop - start):
        return None
    phase = np.full(len(position), int(Phase.REST), dtype=np.uint8)
    phase[start : start + first] = int(Phase.ACCELERATE)
    phase[start + first : start + last] = int(Phase.STEADY)
    phase[start + last : stop] = int(Phase.DECELERATE)
    phase[stop:] = int(Phase.HOLD)
    return phase


def _runs(true: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    return list(finite_runs(np.where(true, 0.0, np.nan)))
