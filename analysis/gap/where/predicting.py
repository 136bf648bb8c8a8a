"""How well a run's residual follows from the other runs', bin by bin of some coordinate."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gap.where.axes import IndexArray
from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Contact
from dragrig.rig.profile import Phase

CONSTANT = "constant"
"""What a residual would be a function of that is the same in all runs of a kind."""

POSITION_MM, TIMES = 1.0, 24
"""Width of the bins along the stroke, and number of bins from 10 ms to 300 s after a start or stop."""


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """All blocks one below the other: number of the run, weight, residual over what is expected."""

    run: IndexArray
    weight: FloatArray
    deviation: FloatArray

    @classmethod
    def of(cls, blocks: Sequence[ResidualBlocks]) -> "Table":
        """Stack the blocks."""
        number = {name: index for index, name in enumerate(dict.fromkeys(one.run_id for one in blocks))}
        return cls(
            np.concatenate([np.full(one.residual.size, number[one.run_id]) for one in blocks]),
            np.concatenate([one.weight for one in blocks]),
            np.concatenate([one.deviation for one in blocks]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Coordinate:
    """What a domain knows of each block: a bin, and how the residual is scaled in it."""

    bin: IndexArray
    scale: FloatArray


def accounted(table: Table, coordinate: Coordinate) -> float:
    """Return which part of the squares the other runs' bins predict, weighted; below 0 where they mislead.

    In each bin the residual is a factor times the scale; the factor comes by least squares from the other runs.
    """
    runs = int(table.run.max()) + 1
    cell = np.unique(coordinate.bin * runs + table.run, return_inverse=True)
    keys = cell[0]
    product = np.bincount(cell[1], table.weight * coordinate.scale * table.deviation)
    square = np.bincount(cell[1], table.weight * coordinate.scale**2)
    bins = np.unique(keys // runs, return_inverse=True)[1]
    others = np.bincount(bins, product)[bins] - product
    scales = np.bincount(bins, square)[bins] - square
    factor = np.divide(others, scales, out=np.zeros_like(others), where=scales > 1e-9 * square)
    left = table.deviation - factor[cell[1]] * coordinate.scale
    total = float((table.weight * table.deviation**2).sum())
    return 1 - float((table.weight * left**2).sum()) / total if total > 0 else 0.0


def coordinates(blocks: Sequence[ResidualBlocks]) -> Mapping[str, tuple[Coordinate, ...]]:
    """Return what is tried for each domain that runs can predict."""
    group = _stacked(blocks, [_group(blocks, one) for one in blocks])
    ones = np.ones(group.size)
    strain = np.concatenate([np.full(one.residual.size, one.strain or 1.0) for one in blocks])
    phase = np.concatenate([one.phase.astype(np.intp) for one in blocks])
    speed = _stacked(blocks, np.unique([one.speed_mm_s for one in blocks], return_inverse=True)[1].tolist())
    position = np.concatenate([_position(one) for one in blocks])
    time = np.concatenate([_time(one) for one in blocks])
    neighbours = [_stacked(blocks, _pairs(blocks, shift)) for shift in (0, 1)]
    sheared = _stacked(blocks, [int(one.contact is Contact.STICKING) for one in blocks]) > 0
    return {
        CONSTANT: (Coordinate(_joined(group, phase), ones),),
        "speed": (Coordinate(_joined(group, phase, speed), np.where(sheared, 0.0, 1.0)),),
        "position": (Coordinate(_joined(group, position), np.where(sheared, 0.0, 1.0)),),
        "time": (Coordinate(_joined(group, time), ones), Coordinate(_joined(group, time), strain)),
        "session": tuple(Coordinate(_joined(group, phase, pair), ones) for pair in neighbours),
        "strain": (Coordinate(_joined(group, time), np.where(sheared, strain**2, 0.0)),),
    }


def _stacked(blocks: Sequence[ResidualBlocks], number: Sequence[int]) -> IndexArray:
    """Return a number of each run for each of its blocks."""
    return np.concatenate([np.full(one.residual.size, value) for one, value in zip(blocks, number, strict=True)])


def _group(blocks: Sequence[ResidualBlocks], one: ResidualBlocks) -> int:
    names = list(dict.fromkeys((other.channel, other.kind) for other in blocks))
    return names.index((one.channel, one.kind))


def _pairs(blocks: Sequence[ResidualBlocks], shift: int) -> list[int]:
    """Return the number of the pair of neighbours in the session that a run belongs to, within its kind."""
    ranks = []
    for one in blocks:
        before = sum(o.kind == one.kind and o.channel == one.channel and o.session_s < one.session_s for o in blocks)
        ranks.append((before + shift) // 2)
    return ranks


def _position(one: ResidualBlocks) -> IndexArray:
    """Return the bin along the stroke; rests and holds are apart, as they say nothing of the stroke."""
    along = 2 + np.floor(np.abs(one.position_mm) / POSITION_MM).astype(np.intp)
    return np.where(one.phase == Phase.REST, 0, np.where(one.phase == Phase.HOLD, 1, along))


def _time(one: ResidualBlocks) -> IndexArray:
    """Return the bin of the time since the last start or stop, on a logarithmic scale; the rest has one of its own."""
    held = one.phase == Phase.HOLD
    begun = one.phase != Phase.REST
    start = one.time_s[begun][0] if begun.any() else 0.0
    stop = one.time_s[held][0] if held.any() else np.inf
    since = np.where(held, one.time_s - stop, one.time_s - start)
    bins = np.searchsorted(np.geomspace(0.01, 300.0, TIMES), np.maximum(since, 0.0))
    return np.where(begun, 1 + bins + held * (TIMES + 2), 0)


def _joined(*parts: IndexArray) -> IndexArray:
    """Return one number for each combination."""
    joined = parts[0]
    for part in parts[1:]:
        joined = joined * (int(part.max()) + 1) + part
    return np.asarray(joined)
