"""What a residual is above all a function of, asked of runs that take no part in the answer.

Each domain predicts a run's residual from the other runs, bin by bin of its own coordinate. What is periodic with a
phase of its own in each run cannot be predicted so: there a sine of one period for all runs is added to a constant.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from dragrig.analysis.gap.where.bands import BANDS_HZ, band_excess
from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.analysis.gap.where.periodic import periodic_share
from dragrig.analysis.gap.where.predicting import CONSTANT, Table, accounted, coordinates
from dragrig.rig.profile import Phase

FAST_HZ = 10.0
"""From here on a disturbance is one of frequency."""

RINGING_S = 0.3
"""How long after a change of velocity its transient is looked for."""

DOMAINS = ("speed", "position", "time", "session", "frequency", "strain", "transient")


def domain_scores(blocks: Sequence[ResidualBlocks]) -> Mapping[str, float]:
    """Return which part of the residuals' squares each domain accounts for, 0 to 1."""
    table = Table.of(blocks)
    seen = coordinates(blocks)
    scores = {name: max(accounted(table, one) for one in seen[name]) for name in seen}
    in_position, in_time = periodic_share(blocks)
    scores["position"] = max(scores["position"], scores[CONSTANT] + in_position)
    scores["session"] = max(scores["session"], scores[CONSTANT] + in_time)
    total = sum(float((one.weight * one.deviation**2).sum()) for one in blocks)
    fast = sum(_fast(one) for one in blocks)
    scores["frequency"] = fast / (total + fast) if fast > 0 else 0.0
    scores["transient"] = sum(_transient(one) for one in blocks) / total if total > 0 else 0.0
    return {name: float(np.clip(scores[name], 0.0, 1.0)) for name in DOMAINS}


def _fast(one: ResidualBlocks) -> float:
    return float(np.maximum(band_excess(one)[np.array(BANDS_HZ[:-1]) >= FAST_HZ], 0.0).sum())


def _transient(one: ResidualBlocks) -> float:
    """Return the excess while the velocity changes and shortly after, above what the run has elsewhere."""
    changing = (one.phase == Phase.ACCELERATE) | (one.phase == Phase.DECELERATE)
    if not changing.any():
        return 0.0
    changes = one.time_s[changing]
    after = one.time_s[:, None] - changes
    near = ((after >= 0) & (after < RINGING_S)).any(axis=1)
    elsewhere = one.excess[~near].sum() / max(float(one.weight[~near].sum()), 1e-9)
    return max(float(one.excess[near].sum() - max(elsewhere, 0.0) * one.weight[near].sum()), 0.0)
