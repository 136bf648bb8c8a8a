"""Where a gap is: excess by axis, its significance, and the variable that the residual is mainly a function of.

Each domain predicts the residual of a run from the other runs, bin by bin of its coordinate. A periodic residual with
a phase of its own in each run cannot be predicted this way: there a sine of one period for all runs is added.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis.gap.diagnosis import AxisBin, AxisLocation, GapLocation, PhaseCell
from dragrig.analysis.gap.excess import (
    BANDS_HZ,
    PERMUTATIONS,
    PHASE_NAMES,
    CampaignResiduals,
    ExcessAxis,
    ResidualBlocks,
    Significance,
    band_excess,
    excess_axes,
    largest_excess_p,
    overall_p,
    permutation_test,
)
from dragrig.rig.arrays import BoolArray, FloatArray, IndexArray
from dragrig.rig.devices import Contact
from dragrig.rig.profile import Phase

CONSTANT_DOMAIN = "constant"
"""What a residual would be a function of that is the same in all runs of a kind."""

POSITION_BIN_MM, TIME_BINS = 1.0, 24
"""Width of the bins along the stroke, and number of bins from 10 ms to 300 s after a start or stop."""


@dataclass(frozen=True, slots=True, eq=False)
class BlockTable:
    """All blocks one below the other: number of the run, weight, residual over what is expected."""

    run: IndexArray
    weight: FloatArray
    deviation: FloatArray

    @classmethod
    def of(cls, blocks: Sequence[ResidualBlocks]) -> "BlockTable":
        """Stack the blocks."""
        number = {name: index for index, name in enumerate(dict.fromkeys(one.run_id for one in blocks))}
        return cls(
            np.concatenate([np.full(one.residual.size, number[one.run_id]) for one in blocks]),
            np.concatenate([one.weight for one in blocks]),
            np.concatenate([one.deviation for one in blocks]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class DomainCoordinate:
    """What a domain knows of each block: a bin, and how the residual is scaled in it."""

    bin: IndexArray
    scale: FloatArray


def cross_predicted_share(table: BlockTable, coordinate: DomainCoordinate) -> float:
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


def domain_coordinates(blocks: Sequence[ResidualBlocks]) -> Mapping[str, tuple[DomainCoordinate, ...]]:
    """Return what is tried for each domain that runs can predict."""
    group = _per_block(blocks, [_group_index(blocks, one) for one in blocks])
    ones = np.ones(group.size)
    strain = np.concatenate([np.full(one.residual.size, one.strain or 1.0) for one in blocks])
    phase = np.concatenate([one.phase.astype(np.intp) for one in blocks])
    speed = _per_block(blocks, np.unique([one.speed_mm_s for one in blocks], return_inverse=True)[1].tolist())
    position = np.concatenate([_position_bins(one) for one in blocks])
    time = np.concatenate([_time_bins(one) for one in blocks])
    neighbours = [_per_block(blocks, _session_pairs(blocks, shift)) for shift in (0, 1)]
    sheared = _per_block(blocks, [int(one.contact is Contact.STICKING) for one in blocks]) > 0
    return {
        CONSTANT_DOMAIN: (DomainCoordinate(_combined_index(group, phase), ones),),
        "speed": (DomainCoordinate(_combined_index(group, phase, speed), np.where(sheared, 0.0, 1.0)),),
        "position": (DomainCoordinate(_combined_index(group, position), np.where(sheared, 0.0, 1.0)),),
        "time": (
            DomainCoordinate(_combined_index(group, time), ones),
            DomainCoordinate(_combined_index(group, time), strain),
        ),
        "session": tuple(DomainCoordinate(_combined_index(group, phase, pair), ones) for pair in neighbours),
        "strain": (DomainCoordinate(_combined_index(group, time), np.where(sheared, strain**2, 0.0)),),
    }


def _per_block(blocks: Sequence[ResidualBlocks], number: Sequence[int]) -> IndexArray:
    """Return a number of each run for each of its blocks."""
    return np.concatenate([np.full(one.residual.size, value) for one, value in zip(blocks, number, strict=True)])


def _group_index(blocks: Sequence[ResidualBlocks], one: ResidualBlocks) -> int:
    names = list(dict.fromkeys((other.channel, other.kind) for other in blocks))
    return names.index((one.channel, one.kind))


def _session_pairs(blocks: Sequence[ResidualBlocks], shift: int) -> list[int]:
    """Return the number of the pair of neighbours in the session that a run belongs to, within its kind."""
    ranks = []
    for one in blocks:
        before = sum(o.kind == one.kind and o.channel == one.channel and o.session_s < one.session_s for o in blocks)
        ranks.append((before + shift) // 2)
    return ranks


def _position_bins(one: ResidualBlocks) -> IndexArray:
    """Return the bin along the stroke; rests and holds are apart, as they say nothing of the stroke."""
    along = 2 + np.floor(np.abs(one.position_mm) / POSITION_BIN_MM).astype(np.intp)
    return np.where(one.phase == Phase.REST, 0, np.where(one.phase == Phase.HOLD, 1, along))


def _time_bins(one: ResidualBlocks) -> IndexArray:
    """Return the bin of the time since the last start or stop, on a logarithmic scale; the rest has one of its own."""
    held = one.phase == Phase.HOLD
    begun = one.phase != Phase.REST
    start = one.time_s[begun][0] if begun.any() else 0.0
    stop = one.time_s[held][0] if held.any() else np.inf
    since = np.where(held, one.time_s - stop, one.time_s - start)
    bins = np.searchsorted(np.geomspace(0.01, 300.0, TIME_BINS), np.maximum(since, 0.0))
    return np.where(begun, 1 + bins + held * (TIME_BINS + 2), 0)


def _combined_index(*parts: IndexArray) -> IndexArray:
    """Return one number for each combination."""
    joined = parts[0]
    for part in parts[1:]:
        joined = joined * (int(part.max()) + 1) + part
    return np.asarray(joined)


WAVENUMBERS_PER_MM = np.geomspace(1 / 20, 1.0, 120)
FREQUENCIES_HZ = np.geomspace(1 / 30, 3.0, 120)
WAVENUMBER_SPACING, MAX_FINE_WAVENUMBERS = 0.4, 200
"""Beyond these, wave numbers lie so many waves over the longest run apart, and are so many at most."""
REFINEMENT_POINTS = 41
"""So many rates about the best one are tried to tell it exactly."""
MIN_SINE_BLOCKS = 8
"""Least blocks for a sine."""

MIN_PERIODS = 2.0
"""Fewest periods of a sine that a run must hold to have a say on it."""


def best_periodic_shares(blocks: Sequence[ResidualBlocks]) -> tuple[float, float]:
    """Return which part of all squares the best sine accounts for, in position and in time."""
    in_position, in_time = periodic_shares(blocks)
    return float(in_position.max()), float(in_time.max())


def trial_wavenumbers(blocks: Sequence[ResidualBlocks]) -> FloatArray:
    """Return the wave numbers per mm that are tried: the usual ones, and shorter waves as far as blocks show them."""
    steady = [np.abs(one.position_mm[one.phase == Phase.STEADY]) for one in blocks]
    steady = [one for one in steady if one.size >= MIN_SINE_BLOCKS and np.ptp(one) > 0]
    if not steady:
        return WAVENUMBERS_PER_MM
    shortest = float(np.median([np.median(np.diff(np.sort(one))) for one in steady]))
    step = WAVENUMBER_SPACING / max(float(np.ptp(one)) for one in steady)
    last = float(WAVENUMBERS_PER_MM[-1])
    highest = min(0.5 / max(shortest, 1e-9), last + MAX_FINE_WAVENUMBERS * step)
    return np.concatenate((WAVENUMBERS_PER_MM, np.arange(last + step, highest, step)))


def periodic_shares(blocks: Sequence[ResidualBlocks]) -> tuple[FloatArray, FloatArray]:
    """Return that part for a sine of each of `trial_wavenumbers` in position, and of `FREQUENCIES_HZ` in time."""
    total = sum(float((one.weight * one.deviation**2).sum()) for one in blocks)
    waves = trial_wavenumbers(blocks)
    in_position, in_time = np.zeros(waves.size), np.zeros(FREQUENCIES_HZ.size)
    if total <= 0:
        return in_position, in_time
    for one in blocks:
        steady, begun = one.phase == Phase.STEADY, one.phase != Phase.REST
        in_position += _sine_power(one, np.abs(one.position_mm), steady, waves)
        in_time += _sine_power(one, one.time_s, begun, FREQUENCIES_HZ)
    return in_position / total, in_time / total


def best_wavenumber(blocks: Sequence[ResidualBlocks]) -> float:
    """Return the wave number per mm of which a sine accounts for most, told as exactly as runs tell it."""
    waves, found = trial_wavenumbers(blocks), periodic_shares(blocks)[0]
    at = int(found.argmax())
    low, high = waves[max(at - 1, 0)], waves[min(at + 1, waves.size - 1)]
    near = np.linspace(low, high, REFINEMENT_POINTS)
    moving = [(one, one.phase == Phase.STEADY) for one in blocks]
    taken = np.sum([_sine_power(one, np.abs(one.position_mm), steady, near) for one, steady in moving], axis=0)
    return float(near[int(taken.argmax())])


def _sine_power(one: ResidualBlocks, coordinate: FloatArray, inside: BoolArray, rates: FloatArray) -> FloatArray:
    """Return the squares that a sine of each rate accounts for, beyond a straight line, in a part of a run."""
    if np.count_nonzero(inside) < MIN_SINE_BLOCKS:
        return np.zeros_like(rates)
    at, deviation, weight = coordinate[inside], one.deviation[inside], one.weight[inside]
    root = np.sqrt(weight)
    line = np.linalg.qr(np.stack((root, root * (at - at.mean())), axis=1))[0]
    left = root * deviation
    left = left - line @ (line.T @ left)
    wave = np.exp(-2j * np.pi * rates[:, None] * at) @ (root * left)
    share = 2 * np.abs(wave) ** 2 / weight.sum()
    widest = float(np.diff(np.sort(at)).max())
    allowed = (rates * np.ptp(at) >= MIN_PERIODS) & (rates * widest < 0.5)
    return np.where(allowed, np.minimum(share, float(left @ left)), 0.0)


FAST_HZ = 10.0
"""From here on a disturbance is one of frequency."""

TRANSIENT_S = 0.3
"""How long after a change of velocity its transient is looked for."""

DOMAINS = ("speed", "position", "time", "session", "frequency", "strain", "transient")


def domain_scores(blocks: Sequence[ResidualBlocks]) -> Mapping[str, float]:
    """Return which part of the residuals' squares each domain accounts for, 0 to 1."""
    table = BlockTable.of(blocks)
    seen = domain_coordinates(blocks)
    scores = {name: max(cross_predicted_share(table, one) for one in seen[name]) for name in seen}
    in_position, in_time = best_periodic_shares(blocks)
    scores["position"] = max(scores["position"], scores[CONSTANT_DOMAIN] + in_position)
    scores["session"] = max(scores["session"], scores[CONSTANT_DOMAIN] + in_time)
    total = sum(float((one.weight * one.deviation**2).sum()) for one in blocks)
    fast = sum(_fast_excess(one) for one in blocks)
    scores["frequency"] = fast / (total + fast) if fast > 0 else 0.0
    scores["transient"] = sum(_transient_excess(one) for one in blocks) / total if total > 0 else 0.0
    return {name: float(np.clip(scores[name], 0.0, 1.0)) for name in DOMAINS}


def _fast_excess(one: ResidualBlocks) -> float:
    return float(np.maximum(band_excess(one)[np.array(BANDS_HZ[:-1]) >= FAST_HZ], 0.0).sum())


def _transient_excess(one: ResidualBlocks) -> float:
    """Return the excess while the velocity changes and shortly after, above what the run has elsewhere."""
    changing = (one.phase == Phase.ACCELERATE) | (one.phase == Phase.DECELERATE)
    if not changing.any():
        return 0.0
    changes = one.time_s[changing]
    after = one.time_s[:, None] - changes
    near = ((after >= 0) & (after < TRANSIENT_S)).any(axis=1)
    elsewhere = one.excess[~near].sum() / max(float(one.weight[~near].sum()), 1e-9)
    return max(float(one.excess[near].sum() - max(elsewhere, 0.0) * one.weight[near].sum()), 0.0)


MAIN_SHARE = 0.8
"""Part of the excess that is most of it."""

MIN_COVERED_SHARE = 0.05
"""An axis on which less of the whole excess lies has no shares: relaxations know nothing of speed, drags of strain."""

MIN_SINGLE_RUN_SCORE = 0.3
"""One run is said to be a function of what accounts for more than this of it: no other run confirms it."""

ALPHA = 0.05
"""Chance of calling noise a gap."""


def localise(blocks: Sequence[ResidualBlocks], present: bool | None = None, seed: int = 0) -> GapLocation:
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
    runs = CampaignResiduals.of(blocks)
    generator = np.random.default_rng(seed)
    axes = excess_axes(runs)
    found = [permutation_test(axis, runs.stratum, generator) for axis in axes]
    tests = [largest_excess_p(blocks), overall_p(runs.energy, generator), *(one.least for one in found if one.p.size)]
    p = min(1.0, len(tests) * min(tests))
    there = p < ALPHA if present is None else present
    whole = float(np.maximum(runs.energy, 0.0).sum())
    scores = domain_scores(blocks) if there else {}
    return GapLocation(
        present=there,
        p=p,
        rms=_root_of_excess(float(runs.energy.mean())),
        locations=tuple(_axis_location(axis, one, whole, there) for axis, one in zip(axes, found, strict=True)),
        cells=_phase_cells(blocks),
        domain=_main_domain(scores, MIN_SINGLE_RUN_SCORE if len(runs.ids) == 1 else 0.0),
        domain_scores=scores,
        permutations=PERMUTATIONS,
        seed=seed,
        runs=len(runs.ids),
    )


def _main_domain(scores: Mapping[str, float], least: float) -> str:
    best = max(scores, key=lambda name: scores[name], default="")
    return best if best and scores[best] > least else ""


def _axis_location(axis: ExcessAxis, tested: Significance, whole: float, there: bool) -> AxisLocation:
    energy = np.maximum(axis.energy.sum(axis=0), 0.0)
    covered = float(energy.sum()) / whole if whole > 0 else 0.0
    energy *= there and covered >= MIN_COVERED_SHARE
    total = float(energy.sum())
    shares = energy / total if total > 0 else np.zeros_like(energy)
    time = axis.time.sum(axis=0)
    rms = np.sqrt(np.maximum(np.divide(axis.energy.sum(axis=0), time, out=np.zeros_like(time), where=time > 0), 0.0))
    bins = tuple(
        _axis_bin(axis, number, float(shares[number]), float(rms[number]), tested) for number in range(shares.size)
    )
    if not axis.ordered or total <= 0:
        return AxisLocation(axis.name, bins, covered, None, None, 0.0, 1.0, tested.least)
    first, last = _narrowest_window(shares)
    low, high = float(axis.edges[first, 0]), float(axis.edges[last, 1])
    share = float(shares[first : last + 1].sum())
    return AxisLocation(axis.name, bins, covered, low, high, share, tested.of(first, last), tested.least)


def _axis_bin(axis: ExcessAxis, number: int, share: float, rms: float, tested: Significance) -> AxisBin:
    p = tested.of(number, number)
    if not axis.ordered:
        return AxisBin(axis.labels[number], None, None, share, rms, p)
    low, high = axis.edges[number].tolist()
    return AxisBin("", low, high, share, rms, p)


def _narrowest_window(shares: FloatArray) -> tuple[int, int]:
    """Return first and last of the fewest neighbouring bins that have most; of equally few those that have more."""
    until = np.append(0.0, np.cumsum(shares))
    first, last = np.triu_indices(shares.size)
    within = until[last + 1] - until[first]
    enough = np.flatnonzero(within >= MAIN_SHARE - 1e-9)
    best = min(enough.tolist(), key=lambda at: (int(last[at] - first[at]), -float(within[at])))
    return int(first[best]), int(last[best])


def _phase_cells(blocks: Sequence[ResidualBlocks]) -> tuple[PhaseCell, ...]:
    excess: dict[tuple[str, str, int], FloatArray] = {}
    for one in blocks:
        for phase in np.unique(one.phase).tolist():
            inside = one.phase == phase
            key = one.channel, one.kind, phase
            more = np.array([one.excess[inside].sum(), one.weight[inside].sum()])
            excess[key] = excess.get(key, np.zeros(2)) + more
    places = dict.fromkeys((one.channel, one.kind) for one in blocks)
    return tuple(
        PhaseCell(channel, kind, name, _root_of_excess(float(found[0] / found[1])) if found is not None else None)
        for channel, kind in places
        for phase, name in enumerate(PHASE_NAMES)
        for found in [excess.get((channel, kind, phase))]
    )


def _root_of_excess(energy: float) -> float:
    return float(np.sqrt(max(energy, 0.0)))


def attribute_to_effects(
    found: GapLocation, blocks: Sequence[ResidualBlocks], added: Sequence[FloatArray]
) -> GapLocation:
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
    where = localise([*shown, *blocks[len(shown) :]], present=True, seed=found.seed)
    pairs = zip(found.locations, where.locations, strict=True)
    return replace(where, p=found.p, locations=tuple(_with_residual_p(*pair) for pair in pairs))


def _with_residual_p(found: AxisLocation, shown: AxisLocation) -> AxisLocation:
    bins = tuple(_bin_with_residual_p(*pair) for pair in zip(found.bins, shown.bins, strict=True))
    return replace(shown, bins=bins, p=found.p, least_p=found.least_p)


def _bin_with_residual_p(found: AxisBin, shown: AxisBin) -> AxisBin:
    return replace(shown, p=found.p)
