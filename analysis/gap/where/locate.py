"""Where a gap is: excess by axis, its significance, and its domain put together."""

from collections.abc import Mapping, Sequence

import numpy as np

from dragrig.analysis.gap.where.axes import PHASES, Axis, Runs, axes_of
from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.analysis.gap.where.domain import domain_scores
from dragrig.analysis.gap.where.permutation import PERMUTATIONS, Significance, loudest, overall, significance
from dragrig.analysis.gap.where.results import Bin, Cell, Location, Where
from dragrig.rig.arrays import FloatArray

MOST = 0.8
"""Part of the excess that is most of it."""

LEAST_COVERED = 0.05
"""An axis on which less of the whole excess lies has no shares: relaxations know nothing of speed, drags of strain."""

ALONE = 0.3
"""One run is said to be a function of what accounts for more than this of it: no other run confirms it."""

ALPHA = 0.05
"""Chance of calling noise a gap."""


def locate(blocks: Sequence[ResidualBlocks], present: bool | None = None, seed: int = 0) -> Where:
    """Say where the residuals of a campaign are larger than noise and repeatability explain.

    Within a run the excess is weighted by duration; every run counts alike, however long it is.

    Parameters
    ----------
    blocks
        Residuals of each run and channel.
    present
        Whether there is a gap, where that has been decided; otherwise `p` decides.
    seed
        Of the permutations.

    Raises
    ------
    ValueError
        When there are no blocks.
    """
    if not blocks:
        raise ValueError("There are no residuals to look at")
    runs = Runs.of(blocks)
    generator = np.random.default_rng(seed)
    axes = axes_of(runs)
    found = [significance(axis, runs.stratum, generator) for axis in axes]
    tests = [loudest(blocks), overall(runs.energy, generator), *(one.least for one in found if one.p.size)]
    p = min(1.0, len(tests) * min(tests))
    there = p < ALPHA if present is None else present
    whole = float(np.maximum(runs.energy, 0.0).sum())
    scores = domain_scores(blocks) if there else {}
    return Where(
        present=there,
        p=p,
        rms=_root(float(runs.energy.mean())),
        locations=tuple(_location(axis, one, whole, there) for axis, one in zip(axes, found, strict=True)),
        cells=_cells(blocks),
        domain=_domain(scores, ALONE if len(runs.ids) == 1 else 0.0),
        domain_scores=scores,
        permutations=PERMUTATIONS,
        seed=seed,
        runs=len(runs.ids),
    )


def _domain(scores: Mapping[str, float], least: float) -> str:
    best = max(scores, key=lambda name: scores[name], default="")
    return best if best and scores[best] > least else ""


def _location(axis: Axis, tested: Significance, whole: float, there: bool) -> Location:
    energy = np.maximum(axis.energy.sum(axis=0), 0.0)
    covered = float(energy.sum()) / whole if whole > 0 else 0.0
    energy *= there and covered >= LEAST_COVERED
    total = float(energy.sum())
    shares = energy / total if total > 0 else np.zeros_like(energy)
    time = axis.time.sum(axis=0)
    rms = np.sqrt(np.maximum(np.divide(axis.energy.sum(axis=0), time, out=np.zeros_like(time), where=time > 0), 0.0))
    bins = tuple(_bin(axis, number, float(shares[number]), float(rms[number]), tested) for number in range(shares.size))
    if not axis.ordered or total <= 0:
        return Location(axis.name, bins, covered, None, None, 0.0, 1.0, tested.least)
    first, last = _narrowest(shares)
    low, high = float(axis.edges[first, 0]), float(axis.edges[last, 1])
    share = float(shares[first : last + 1].sum())
    return Location(axis.name, bins, covered, low, high, share, tested.of(first, last), tested.least)


def _bin(axis: Axis, number: int, share: float, rms: float, tested: Significance) -> Bin:
    p = tested.of(number, number)
    if not axis.ordered:
        return Bin(axis.labels[number], None, None, share, rms, p)
    low, high = axis.edges[number].tolist()
    return Bin("", low, high, share, rms, p)


def _narrowest(shares: FloatArray) -> tuple[int, int]:
    """Return first and last of the fewest neighbouring bins that have most; of equally few those that have more."""
    until = np.append(0.0, np.cumsum(shares))
    first, last = np.triu_indices(shares.size)
    within = until[last + 1] - until[first]
    enough = np.flatnonzero(within >= MOST - 1e-9)
    best = min(enough.tolist(), key=lambda at: (int(last[at] - first[at]), -float(within[at])))
    return int(first[best]), int(last[best])


def _cells(blocks: Sequence[ResidualBlocks]) -> tuple[Cell, ...]:
    excess: dict[tuple[str, str, int], FloatArray] = {}
    for one in blocks:
        for phase in np.unique(one.phase).tolist():
            inside = one.phase == phase
            key = one.channel, one.kind, phase
            more = np.array([one.excess[inside].sum(), one.weight[inside].sum()])
            excess[key] = excess.get(key, np.zeros(2)) + more
    places = dict.fromkeys((one.channel, one.kind) for one in blocks)
    return tuple(
        Cell(channel, kind, name, _root(float(found[0] / found[1])) if found is not None else None)
        for channel, kind in places
        for phase, name in enumerate(PHASES)
        for found in [excess.get((channel, kind, phase))]
    )


def _root(energy: float) -> float:
    return float(np.sqrt(max(energy, 0.0)))
