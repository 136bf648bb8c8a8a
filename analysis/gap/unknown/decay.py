"""What dies away over a way, or over a time: an exponential beyond a straight line, with an amplitude for each run."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gap.unknown.part import Part
from dragrig.analysis.gap.unknown.trend import told
from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.rig.devices import Contact
from dragrig.rig.profile import Phase

LENGTHS = 80
FEWEST = 12
"""Least blocks of steady motion that an exponential is looked for in."""
LEAST_SHARE = 0.5
"""Part of the squares beyond a straight line from which on it is told."""
LONGEST = 0.5
"""One longer than this part of the motion is no more than a bend."""
ALIKE = 0.03
"""Way and time are not told apart where the shares that they explain differ by less."""


@dataclass(frozen=True, slots=True)
class Decay:
    """An exponential that is common to runs but for its size.

    Attributes
    ----------
    length, along_way
        Where it has fallen to 37 %: mm of the way, or s where it is one of time.
    other
        The same of the other of the two, where runs do not tell them apart; None where they do.
    start
        Its size at the begin of steady motion, median over runs [the part's unit].
    share
        Part of the squares beyond a straight line that it takes away.
    before, after
        Root mean square beyond a straight line without it and with it [the part's unit].
    """

    length: float
    along_way: bool
    other: float | None
    start: float
    share: float
    before: float
    after: float

    def words(self, unit: str) -> str:
        """Return it as a sentence."""
        way, of_way = ("along the way", "mm") if self.along_way else ("in time", "s")
        as_well, of_other = ("a time of", "s") if self.along_way else ("a way of", "mm")
        other = "" if self.other is None else f" (as these runs go, as well {as_well} {told(self.other)} {of_other})"
        start = f"{self.start:+.2g}".replace("-", "−")
        return (
            f"It dies away {way} from the begin of steady motion, {start} {unit} over {told(self.length)} {of_way}"
            f"{other}. "
            f"Beyond a straight line {told(self.before)} {unit} are left without that exponential, "
            f"{told(self.after)} {unit} with it."
        )


def decay_of(part: Part) -> Decay | None:
    """Return the exponential that steady motion shows most of; None where it explains little or is but a bend."""
    runs = [one for one in part.blocks if one.contact is not Contact.STICKING and _steady(one).sum() >= FEWEST]
    if not runs:
        return None
    way = _best(runs, [_since(one, np.abs(one.position_mm)) for one in runs])
    time = _best(runs, [_since(one, one.time_s) for one in runs])
    found, other, along = (way, time, True) if way.share >= time.share - ALIKE else (time, way, False)
    if found.share < LEAST_SHARE or found.at_end:
        return None
    return Decay(
        length=found.length,
        along_way=along,
        other=other.length if found.share - other.share < ALIKE else None,
        start=part.scale * float(np.median(found.starts)),
        share=found.share,
        before=part.scale * float(np.sqrt(found.before / len(runs))),
        after=part.scale * float(np.sqrt(found.before * (1 - found.share) / len(runs))),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    length: float
    share: float
    before: float
    starts: FloatArray
    at_end: bool


def _steady(one: ResidualBlocks) -> BoolArray:
    return np.asarray(one.phase == Phase.STEADY, dtype=np.bool_)


def _since(one: ResidualBlocks, coordinate: FloatArray) -> FloatArray:
    at = coordinate[_steady(one)]
    return np.asarray(np.abs(at - at[0]), dtype=np.float64)


def _best(runs: Sequence[ResidualBlocks], since: Sequence[FloatArray]) -> _Fit:
    span = max(float(one.max()) for one in since)
    shortest = max(min(float(np.median(np.diff(one))) for one in since), 1e-6 * span, 1e-12)
    lengths = np.geomspace(shortest, max(LONGEST * span, 2 * shortest), LENGTHS)
    before = np.zeros(len(runs))
    taken, starts = np.zeros((2, len(runs), lengths.size))
    for number, (one, at) in enumerate(zip(runs, since, strict=True)):
        inside = _steady(one)
        root = np.sqrt(one.weight[inside] / one.weight[inside].sum())
        line = np.linalg.qr(root[:, None] * np.stack((np.ones_like(at), at), axis=1))[0]
        values = root * one.residual[inside]
        waves = root[:, None] * np.exp(-at[:, None] / lengths)
        values, waves = (each - line @ (line.T @ each) for each in (values, waves))
        size = np.maximum((waves**2).sum(axis=0), 1e-12)
        along = values @ waves
        before[number] = values @ values
        taken[number], starts[number] = along**2 / size, along / size
    share = taken.sum(axis=0) / max(float(before.sum()), 1e-300)
    best = int(share.argmax())
    at_end = best in {0, lengths.size - 1}
    return _Fit(float(lengths[best]), float(share[best]), float(before.sum()), starts[:, best], at_end)
