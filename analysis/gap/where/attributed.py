"""Where a gap is that is too small, block by block, to stand out of noise: where the effect that explains it acts."""

from collections.abc import Sequence
from dataclasses import replace

from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.analysis.gap.where.locate import locate
from dragrig.analysis.gap.where.results import Bin, Location, Where
from dragrig.rig.arrays import FloatArray


def attributed(found: Where, blocks: Sequence[ResidualBlocks], added: Sequence[FloatArray]) -> Where:
    """Return shares of what named effects add, where the residuals of the campaign have no excess to share out.

    A change of a few per cent from run to run is as large as repeatability in each block, and still plain over a
    session. The p-values stay those of the residuals.

    Parameters
    ----------
    found
        What the residuals say.
    blocks
        They.
    added
        What the effects add, block by block, to each of the first of these [the channel's unit].
    """
    if not found.present or any(found.location("channel").shares.values()):
        return found
    shown = [replace(one, explained=more) for one, more in zip(blocks, added, strict=False)]
    where = locate([*shown, *blocks[len(shown) :]], present=True, seed=found.seed)
    pairs = zip(found.locations, where.locations, strict=True)
    return replace(where, p=found.p, locations=tuple(_with_p(*pair) for pair in pairs))


def _with_p(found: Location, shown: Location) -> Location:
    bins = tuple(_bin(*pair) for pair in zip(found.bins, shown.bins, strict=True))
    return replace(shown, bins=bins, p=found.p, least_p=found.least_p)


def _bin(found: Bin, shown: Bin) -> Bin:
    return replace(shown, p=found.p)
