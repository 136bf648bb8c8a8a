"""Which blocks a gap is in: one channel, some kinds of run, and some phases."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.analysis.gap.where.results import Where
from dragrig.rig.arrays import BoolArray
from dragrig.rig.profile import Phase

MOST, SOME, NONE = 0.8, 0.1, 0.05
"""Shares of the excess that are most of it, a part to be named, and as good as nothing."""

SPANS: Mapping[str, frozenset[Phase]] = {
    "at rest": frozenset({Phase.REST}),
    "in the hold": frozenset({Phase.HOLD}),
    "in steady motion": frozenset({Phase.STEADY}),
    "while accelerating": frozenset({Phase.ACCELERATE}),
    "while braking": frozenset({Phase.DECELERATE}),
    "while accelerating and braking": frozenset({Phase.ACCELERATE, Phase.DECELERATE}),
    "while moving": frozenset({Phase.ACCELERATE, Phase.STEADY, Phase.DECELERATE}),
    "while moving and in the hold": frozenset({Phase.ACCELERATE, Phase.STEADY, Phase.DECELERATE, Phase.HOLD}),
    "at rest and in the hold": frozenset({Phase.REST, Phase.HOLD}),
}
"""Phases that belong together, the fewest first."""


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """The blocks that a gap is in.

    Attributes
    ----------
    channel, kinds, span
        Its channel, its kinds of run, and its phases in words; no words for all phases.
    blocks
        The runs of these kinds, that channel alone.
    inside
        Which of each run's blocks are in these phases.
    excess
        Excess of the whole campaign, other channels and kinds included.
    """

    channel: str
    kinds: tuple[str, ...]
    span: str
    blocks: tuple[ResidualBlocks, ...]
    inside: tuple[BoolArray, ...]
    excess: float

    @property
    def unit(self) -> str:
        """Unit that residuals are told in."""
        return "µm" if self.channel == "position" else "mN"

    @property
    def scale(self) -> float:
        """That unit over the channel's own."""
        return 1000.0 if self.channel == "position" else 1.0


def part_of(where: Where, blocks: Sequence[ResidualBlocks]) -> Part:
    """Return the blocks that have all of the gap but what is as good as nothing."""
    shares = where.location("channel").shares
    channels = list(dict.fromkeys(one.channel for one in blocks))
    channel = max(channels, key=lambda name: shares.get(name, 0.0))
    kinds = kinds_with(where, blocks, SOME)
    found = tuple(one for one in blocks if one.channel == channel and one.kind in kinds)
    span = span_of(where)
    phases = np.array(sorted(SPANS.get(span, frozenset(Phase))), dtype=np.uint8)
    inside = tuple(np.isin(one.phase, phases) for one in found)
    return Part(channel, kinds, span, found, inside, sum(float(one.excess.sum()) for one in blocks))


def kinds_with(where: Where, blocks: Sequence[ResidualBlocks], least: float) -> tuple[str, ...]:
    """Return the kinds of run that have at least this share of the excess, or the one that has most."""
    shares = where.location("protocol").shares
    seen = sorted(dict.fromkeys(one.kind for one in blocks), key=lambda kind: -shares.get(kind, 0.0))
    return tuple(kind for at, kind in enumerate(seen) if at == 0 or shares.get(kind, 0.0) >= least)


def span_of(where: Where) -> str:
    """Return the fewest phases that have all of the gap but what is as good as nothing; empty for all of them."""
    shares = where.location("phase").shares
    for name, phases in SPANS.items():
        if sum(shares.get(one.name.lower(), 0.0) for one in phases) >= 1 - NONE:
            return name
    return ""
