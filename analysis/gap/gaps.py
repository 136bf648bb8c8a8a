"""How large a gap is: residuals of runs in plain mN, beside the floor of noise and repeatability."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gap.results import BeforeAfter, Shrink
from dragrig.analysis.gap.sights import Sight
from dragrig.analysis.identification.determination import PAPERS_BOUNDARY_MM_S, TOLERANCE, eq15, squared_correlation
from dragrig.analysis.identification.joint.evidence import Whitening
from dragrig.analysis.identification.noise import Noise
from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.rig.profile import Phase

RESAMPLED = 1000
LEAST_GAP = 1.2
"""A gap below this many floors is none that could be closed."""
FEWEST_POINTS = 3


@dataclass(frozen=True, slots=True, eq=False)
class RunGap:
    """One run before and after.

    Attributes
    ----------
    before, after
        Residuals of the block means, the run's own zero taken off [mN], shape `(B,)`.
    modelled_before, modelled_after
        Steady force of a drag that was predicted; None for other runs.
    steady
        The one that was measured.
    width_s
        Duration of each block as far as it counts, shape `(B,)`.
    floor
        Mean square of noise, and of what the motion leaves uncertain.
    """

    sight: Sight
    before: FloatArray
    after: FloatArray
    floor: float
    white: float
    steady: tuple[float, float, float] | None
    width_s: FloatArray

    @property
    def squares(self) -> FloatArray:
        """Duration, and mean squares before, after and of the floor times duration, shape `(4,)`."""
        width = self.width_s
        duration = float(width.sum())
        before, after = (float(width @ one**2) + duration * self.white**2 for one in (self.before, self.after))
        return np.array([duration, before, after, self.floor * duration])


def run_gap(
    sight: Sight,
    noise: Noise,
    motion_sd: FloatArray,
    before: tuple[FloatArray, Whitening],
    after: tuple[FloatArray, Whitening],
    zero_sd: float,
    counted: BoolArray | None = None,
) -> RunGap:
    """Compare residuals of a run, each with what whitens it, shapes `(B,)`.

    What the run differs by from its repeats is no gap: its own factors, as the model with the effect has them and no
    further than repeats scatter, are taken off both, and its zero as each model has it. Of the blocks those count that
    are `counted`, all unless said.
    """
    width = sight.coordinates.width_s
    if counted is not None and counted.any():
        width = np.where(counted, width, 0.0)
    share = width / width.sum()
    floor = noise.white**2 + noise.slow**2 + float(share @ motion_sd**2)
    scatter = own_factors(*after, zero_sd)
    cleared = [residual - scatter - own_zero(residual - scatter, white, zero_sd) for residual, white in (before, after)]
    within = noise.white * float(np.sqrt(max(1.0 - float(share @ (1.0 / sight.evidence.blocks.samples)), 0.0)))
    return RunGap(sight, cleared[0], cleared[1], floor, within, _steady(sight, cleared[0], cleared[1]), width)


def own_factors(residual: FloatArray, whitening: Whitening, zero_sd: float, furthest: float = np.inf) -> FloatArray:
    """Return what the run's own factors make of it [mN], shape `(B,)`, none beyond so many standard deviations."""
    own = whitening.own
    precision = np.eye(own.shape[1]) + own.T @ own
    found = np.linalg.solve(precision, own.T @ whitening.of_noise(residual))
    found = np.clip(found, -furthest, furthest)
    if zero_sd > 0:
        found[0] = 0.0
    return np.asarray(whitening.noise_root @ (own @ found))


def own_zero(residual: FloatArray, whitening: Whitening, zero_sd: float) -> float:
    """Return the run's own zero [mN], its own factors being free too."""
    if zero_sd <= 0:
        return 0.0
    own = whitening.own
    precision = np.eye(own.shape[1]) + own.T @ own
    return zero_sd * float(np.linalg.solve(precision, own.T @ whitening.of_noise(residual))[0])


def shrink_of(gaps: Sequence[RunGap], seed: int = 0) -> Shrink:
    """Return how far the gap shrinks over runs, with an interval by resampling whole runs."""
    rows = np.array([one.squares for one in gaps])
    closed = _closed(rows.sum(axis=0))
    interval = None
    if closed is not None and len(gaps) > 2:
        drawn = np.random.default_rng(seed).integers(len(gaps), size=(RESAMPLED, len(gaps)))
        resampled = [one for one in (_closed(rows[index].sum(axis=0), 1.0) for index in drawn) if one is not None]
        if len(resampled) > RESAMPLED // 2:
            low, high = np.quantile(resampled, (0.025, 0.975)).tolist()
            interval = (min(low, closed), max(high, closed))
    duration, before, after, floor = rows.sum(axis=0).tolist()
    points = [(one.sight.condition[1], *one.steady) for one in gaps if one.steady is not None]
    sides = _sides(points)
    both = all(len(side) >= 1 for side in sides)
    return Shrink(
        gap_before_mN=float(np.sqrt(before / duration)),
        gap_after_mN=float(np.sqrt(after / duration)),
        noise_floor_mN=float(np.sqrt(floor / duration)),
        closed=closed,
        closed_95ci=interval,
        boundary_mm_s=PAPERS_BOUNDARY_MM_S if both else None,
        r2_eq15=_determination(sides, "eq15"),
        r2_corr=_determination(sides, "corr"),
        runs=tuple(one.sight.file for one in gaps),
    )


def _closed(sums: FloatArray, least: float = LEAST_GAP) -> float | None:
    before, after, floor = (float(one / sums[0]) for one in sums[1:])
    if before <= least**2 * floor:
        return None
    return 1.0 - (after - floor) / (before - floor)


def _steady(sight: Sight, before: FloatArray, after: FloatArray) -> tuple[float, float, float] | None:
    """Return measured steady force of a drag and what the models make of it, before and after."""
    inside = sight.coordinates.phase == Phase.STEADY
    if sight.experiment.kind != "drag" or not inside.any():
        return None
    width = sight.coordinates.width_s[inside]
    measured = float(width @ sight.evidence.blocks.mean[inside] / width.sum())
    missed = [float(width @ one[inside] / width.sum()) for one in (before, after)]
    return measured, measured - missed[0], measured - missed[1]


Point = tuple[float, float, float, float]


def _sides(points: Sequence[Point]) -> tuple[list[Point], list[Point]]:
    highest = PAPERS_BOUNDARY_MM_S * (1 + TOLERANCE)
    return [one for one in points if one[0] <= highest], [one for one in points if one[0] > highest]


def _determination(sides: tuple[list[Point], list[Point]], form: str) -> BeforeAfter:
    found: list[float | None] = []
    for column in (2, 3):
        for side in sides:
            if len(side) < FEWEST_POINTS:
                found.append(None)
                continue
            table = np.array(side)
            compare = eq15 if form == "eq15" else squared_correlation
            found.append(compare(table[:, column], table[:, 1]))
    return BeforeAfter(found[0], found[1], found[2], found[3])
