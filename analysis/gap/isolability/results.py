"""What runs can tell apart, as frozen values."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations
from statistics import median

from dragrig.analysis.gap.seen import SEEN

CLOSE = 0.17
"""A rival that leaves no more of an effect's squares than this is hardly told from it.

The best fit of the catalogue's forms leaves up to 0.41 of the norm of what a foreign form of the same effect does
(`bench/forms.py`), hence 0.17 of its squares.
"""


@dataclass(frozen=True, slots=True)
class Visibility:
    """How clearly runs show an effect.

    Attributes
    ----------
    channel
        Where it is seen: `force`, `position`, or `spectrum` for a line that block means take out.
    d_prime
        At its usual size, median over its shapes: the norm of its whitened signature once nuisances are taken out.
    usual, least, unit
        The usual size, and the smallest that would be seen, median over its shapes; None where no run shows it.
    least_mN
        Root mean square of the smallest where it acts; None in the position.
    """

    effect: str
    channel: str
    d_prime: float
    usual: float
    least: float | None
    unit: str
    least_mN: float | None = None


@dataclass(frozen=True, slots=True)
class Pair:
    """Two effects and how far apart they are.

    Attributes
    ----------
    sin2
        sin² of the angle between what the two can do: the least over the shapes of both, signs kept where there is one.
    typical_sin2
        What the second leaves of the first in the median over the first's shapes, and the other way round.
    d_prime
        d′ between the two with each at its usual size in turn, median over its shapes, the other at its best.
    confused
        Whether these runs hardly tell them apart.
    """

    effects: tuple[str, str]
    channel: str
    sin2: float
    typical_sin2: tuple[float, float]
    d_prime: tuple[float, float]
    confused: bool

    @property
    def separation(self) -> float:
        """The smaller d′ of the two."""
        return min(self.d_prime)


@dataclass(frozen=True, slots=True)
class Isolability:
    """What some runs can tell apart.

    Attributes
    ----------
    source
        Plan or campaign.
    planned
        Whether the runs are yet to be made.
    runs
        Number of runs by kind, of those that a diagnosis uses.
    duration_s
        Rig time with rests and ways back; None where it is not known.
    effects
        How clearly each is seen; those of the force stand so that near ones are neighbours.
    pairs
        All pairs within a channel, the closest first.
    remarks
        What was not looked at, a sentence each.
    """

    source: str
    planned: bool
    runs: Mapping[str, int]
    duration_s: float | None
    effects: tuple[Visibility, ...]
    pairs: tuple[Pair, ...]
    remarks: tuple[str, ...] = ()

    def of_channel(self, channel: str) -> tuple[Visibility, ...]:
        """Return the effects of a channel that runs show, in their order."""
        return tuple(one for one in self.effects if one.channel == channel and one.least is not None)

    @property
    def unseen(self) -> tuple[str, ...]:
        """Effects that no run shows at their usual size."""
        return tuple(one.effect for one in self.effects if one.least is None or one.d_prime < SEEN)

    @property
    def confused(self) -> tuple[Pair, ...]:
        """Pairs that these runs hardly tell apart, the closest first."""
        return tuple(one for one in self.pairs if one.confused)

    def pair(self, one: str, other: str) -> Pair | None:
        """Return two effects' pair; None where they are not of one channel."""
        return next((each for each in self.pairs if set(each.effects) == {one, other}), None)

    def summary(self) -> Mapping[str, float]:
        """Return what two plans are compared by, of the force's effects."""
        pairs = [one for one in self.pairs if one.channel == "force"]
        seen = self.of_channel("force")
        ratios = [one.least / abs(one.usual) for one in seen if one.least is not None]
        return {
            "pairs": len(pairs),
            "confused": sum(one.confused for one in pairs),
            "below_half": sum(one.sin2 < 0.5 for one in pairs),
            "least_sin2": min((one.sin2 for one in pairs), default=float("nan")),
            "median_sin2": median([one.sin2 for one in pairs]) if pairs else float("nan"),
            "least_d_prime": min((one.separation for one in pairs), default=float("nan")),
            "median_d_prime": median([one.separation for one in pairs]) if pairs else float("nan"),
            "median_least_over_usual": median(ratios) if ratios else float("nan"),
            "largest_least_over_usual": max(ratios, default=float("nan")),
        }


def pairs_of(names: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Yield every pair once."""
    return combinations(names, 2)
