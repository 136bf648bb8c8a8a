"""Where a gap is, as values and as the JSON of a gap report."""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Bin:
    """A bin of an axis.

    Attributes
    ----------
    name
        Its name, empty where the ends say it.
    low, high
        Its ends in the axis' unit; None where it has a name.
    share
        Its part of the excess on this axis; all are 0 where there is no gap.
    rms
        Root of the mean excess in it, in standard deviations of what is expected.
    p
        Chance that it stands out so without a gap, familywise over the axis.
    """

    name: str
    low: float | None
    high: float | None
    share: float
    rms: float
    p: float


@dataclass(frozen=True, slots=True)
class Location:
    """One axis.

    Attributes
    ----------
    name
        As in the report.
    bins
        All of them, whose shares sum to 1 or are all 0.
    covered
        Part of the whole excess that lies on this axis; where it is small there are no shares.
    low, high
        The narrowest neighbouring bins that have most of the excess; None without a gap and where bins have no order.
    share
        Their part.
    p
        Chance that they stand out so without a gap.
    least_p
        The smallest p-value on the axis.
    """

    name: str
    bins: tuple[Bin, ...]
    covered: float
    low: float | None
    high: float | None
    share: float
    p: float
    least_p: float

    @property
    def shares(self) -> Mapping[str, float]:
        """Shares of the bins that have a name."""
        return {one.name: one.share for one in self.bins if one.name}

    def document(self) -> Mapping[str, object]:
        """Return it as the report has it."""
        if self.shares:
            return {name: round(share, 4) for name, share in self.shares.items()}
        bins = [{"low": one.low, "high": one.high, "share": round(one.share, 4), "p": round(one.p, 4)}
                for one in self.bins]  # fmt: skip
        return {
            "covered": round(min(self.covered, 1.0), 4),
            "low": self.low,
            "high": self.high,
            "share": round(self.share, 4),
            "p": round(self.p, 4),
            "bins": bins,
        }


@dataclass(frozen=True, slots=True)
class Cell:
    """One channel in one phase of one protocol: root of the mean excess, in standard deviations; None if never seen."""

    channel: str
    protocol: str
    phase: str
    rms: float | None


@dataclass(frozen=True, slots=True)
class Where:
    """Where a gap is.

    Attributes
    ----------
    present
        Whether there is one.
    p
        Chance of so much excess, or of so much of it in one place, without a gap.
    rms
        Root of the mean excess of all runs, in standard deviations of what is expected.
    locations
        All axes.
    cells
        Channel, protocol and phase at once.
    domain
        What the residual is above all a function of; empty without a gap.
    domain_scores
        How much of the residual each domain accounts for in runs that took no part, 0 to 1.
    permutations, seed
        Of the p-values.
    runs
        How many runs it was looked for in: with one, nothing was permuted and no other run predicts it.
    """

    present: bool
    p: float
    rms: float
    locations: tuple[Location, ...]
    cells: tuple[Cell, ...]
    domain: str
    domain_scores: Mapping[str, float]
    permutations: int
    seed: int
    runs: int = 0

    def location(self, name: str) -> Location:
        """Return an axis by name; raises `KeyError` for one that there is not."""
        found = {one.name: one for one in self.locations}
        return found[name]

    def document(self) -> Mapping[str, object]:
        """Return it as the report's `where`."""
        named = {one.name: {each.name: round(each.p, 4) for each in one.bins} for one in self.locations if one.shares}
        return {
            **{one.name: one.document() for one in self.locations},
            "domain": self.domain,
            "domain_scores": {name: round(score, 4) for name, score in self.domain_scores.items()},
            "p": round(self.p, 4),
            "p_of": named,
            "excess_sd": round(self.rms, 3),
            "permutations": self.permutations,
            "seed": self.seed,
        }
