"""How a residual goes along something: mean by mean, rising, falling, or largest in between."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gap.unknown.part import Part
from dragrig.analysis.gap.unknown.terms import since_start
from dragrig.analysis.gap.where.axes import IndexArray
from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.rig.arrays import FloatArray

MOST_BINS, FEWEST_BINS = 10, 3
ORDERED, ORDERED_TO_ITS_END = 0.85, 0.6
"""Rank correlation from which on means rise or fall; less is enough where the largest is the first or the last."""
SIGMAS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Trend:
    """Means of a residual along a coordinate.

    Attributes
    ----------
    at, mean, error
        Coordinate, mean and its standard error over runs [the part's unit], shape `(J,)` each.
    """

    at: FloatArray
    mean: FloatArray
    error: FloatArray

    @property
    def clear(self) -> bool:
        """Whether the means differ by more than their errors."""
        low, high = int(np.argmin(self.mean)), int(np.argmax(self.mean))
        return bool(np.ptp(self.mean) > SIGMAS * np.hypot(self.error[low], self.error[high]))

    @property
    def order(self) -> float:
        """Rank correlation of means and coordinate, −1 to 1."""
        ranks = np.argsort(np.argsort(self.mean))
        return float(np.corrcoef(ranks, np.arange(self.at.size))[0, 1])

    def words(self, name: str, unit: str, of: str) -> str:
        """Return how the residual goes along it; empty where its means do not differ."""
        if self.at.size < FEWEST_BINS or not self.clear:
            return ""
        peak = int(np.argmax(np.abs(self.mean)))
        at_end = peak in {0, self.at.size - 1}
        if abs(self.order) >= (ORDERED_TO_ITS_END if at_end else ORDERED):
            verb = "grows" if self.order > 0 else "falls"
            return f"{verb} with {name}, from {self._told(0, unit, of)} to {self._told(-1, unit, of)}"
        side = "highest" if self.mean[peak] > 0 else "lowest"
        return f"is {side} at about {told(self.at[peak])}{of}, {_signed(self.mean[peak])} {unit}"

    def _told(self, at: int, unit: str, of: str) -> str:
        return f"{_signed(self.mean[at])} {unit} at {told(self.at[at])}{of}"


def trend_of(part: Part, domain: str) -> Trend | None:
    """Return the means along what belongs to a domain; None for domains that have no coordinate.

    Means are over runs, each run's blocks weighted by duration; values that are commanded are kept apart, others put
    into bins with equally many blocks.
    """
    if domain not in ("speed", "position", "time", "session", "strain"):
        return None
    inside = list(zip(part.blocks, part.inside, strict=True))
    at = np.concatenate([_coordinate(one, domain)[here] for one, here in inside])
    residual = part.scale * np.concatenate([one.residual[here] for one, here in inside])
    weight = np.concatenate([one.weight[here] for one, here in inside])
    run = np.concatenate([np.full(np.count_nonzero(here), number) for number, (_, here) in enumerate(inside)])
    levels = np.unique(at)
    if levels.size > MOST_BINS:
        edges = np.unique(np.quantile(levels, np.linspace(0.0, 1.0, MOST_BINS + 1)[1:-1]))
        found = np.searchsorted(edges, at, side="right")
    else:
        found = np.searchsorted(levels, at)
    return _means(found, run, at, residual, weight)


def _coordinate(one: ResidualBlocks, domain: str) -> FloatArray:
    match domain:
        case "speed":
            return np.full_like(one.residual, one.speed_mm_s)
        case "position":
            return np.abs(one.position_mm)
        case "time":
            return since_start(one)
        case "session":
            return np.full_like(one.residual, one.session_s)
        case _:
            return np.full_like(one.residual, one.strain)


def _means(
    found: IndexArray,
    run: IndexArray,
    at: FloatArray,
    residual: FloatArray,
    weight: FloatArray,
) -> Trend:
    rows: list[Sequence[float]] = []
    for number in np.unique(found).tolist():
        here = found == number
        total = np.bincount(run[here], weight[here])
        seen = total > 0
        means = np.bincount(run[here], weight[here] * residual[here])[seen] / total[seen]
        error = float(means.std(ddof=1) / np.sqrt(means.size)) if means.size > 1 else 0.0
        rows.append((float(np.average(at[here], weights=weight[here])), float(means.mean()), error))
    table = np.array(rows)
    return Trend(table[:, 0], table[:, 1], table[:, 2])


def told(value: float) -> str:
    """Return a number with two digits, or without decimals."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"


def _signed(value: float) -> str:
    return (f"{value:+.0f}" if abs(value) >= 100 else f"{value:+.2g}").replace("-", "−")
