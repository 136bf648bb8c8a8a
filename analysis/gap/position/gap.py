"""How far a gap of the position shrinks."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dragrig.analysis.gap.candidate import Candidate
from dragrig.analysis.gap.position.errors import PositionErrors
from dragrig.analysis.gap.position.finding import PositionFinding, strayed
from dragrig.analysis.gap.results import Shrink

RESAMPLED = 1000


def position_gap(found: PositionFinding, force: Shrink) -> Shrink:
    """Return a shrink whose closed share is that of the position's errors; the force's sizes stay as they are."""
    if found.candidate is None:
        return force
    return closed_in_position(found.candidate, found.runs, force)


def closed_in_position(candidate: Candidate, runs: Sequence[PositionErrors], force: Shrink, seed: int = 0) -> Shrink:
    """Do the same for an effect and runs that took no part in its fit."""
    floor = np.array([one.quantisation_mm**2 + one.noise_mm**2 for one in runs])
    before = np.array([float(np.mean(one.error_mm**2)) for one in runs]) - floor
    after = np.array([float(np.mean((one.error_mm - strayed(candidate, one)) ** 2)) for one in runs]) - floor

    def share(rows: Sequence[int] | np.ndarray) -> float:
        return float(1.0 - after[rows].mean() / max(before[rows].mean(), 1e-12))

    everything = np.arange(len(runs))
    drawn = np.random.default_rng(seed).integers(len(runs), size=(RESAMPLED, len(runs)))
    low, high = np.quantile([share(one) for one in drawn], (0.025, 0.975)).tolist()
    return replace(force, closed=share(everything), closed_95ci=(low, high))
