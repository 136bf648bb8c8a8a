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
        number = {name: index for index, name in enumerate(dict.fromkeys(run.run_id for run in blocks))}
        return cls(
            np.concatenate([np.full(run.residual.size, number[run.run_id]) for run in blocks]),
            np.concatenate([run.weight for run in blocks]),
            np.concatenate([run.deviation for run in blocks]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class DomainCoordinate:
    """What a domain knows of each block: a bin, and how the residual is scaled in it."""

    bins: IndexArray
    scale: FloatArray


def cross_predicted_share(table: BlockTable, coordinate: DomainCoordinate) -> float:
    """Return which part of the squares the other runs' bins predict, weighted; below 0 where they mislead.

    In each bin the residual is a factor times the scale; the factor comes by least squares from the other runs.
    """
    runs = int(table.run.max()) + 1
    cell = np.unique(coordinate.bins * runs + table.run, return_inverse=True)
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
    group = _per_block(blocks, [_group_index(blocks, run) for run in blocks])
    ones = np.ones(group.size)
    strain = np.concatenate([np.full(run.residual.size, run.strain or 1.0) for run in blocks])
    phase = np.concatenate([run.phase.astype(np.intp) for run in blocks])
    speed = _per_block(blocks, np.unique([run.speed_mm_s for run in blocks], return_inverse=True)[1].tolist())
    position = np.concatenate([_position_bins(run) for run in blocks])
    time = np.concatenate([_time_bins(run) for run in blocks])
    neighbours = [_per_block(blocks, _session_pairs(blocks, shift)) for shift in (0, 1)]
    sheared = _per_block(blocks, [int(run.contact is Contact.STICKING) for run in blocks]) > 0
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
    return np.concatenate([np.full(run.residual.size, value) for run, value in zip(blocks, number, strict=True)])


def _group_index(blocks: Sequence[ResidualBlocks], run: ResidualBlocks) -> int:
    names = list(dict.fromkeys((run_blocks.channel, run_blocks.kind) for run_blocks in blocks))
    return names.index((run.channel, run.kind))


def _session_pairs(blocks: Sequence[ResidualBlocks], shift: int) -> list[int]:
    """Return the number of the pair of neighbours in the session that a run belongs to, within its kind."""
    ranks = []
    for run in blocks:
        before = sum(o.kind == run.kind and o.channel == run.channel and o.session_s < run.session_s for o in blocks)
        ranks.append((before + shift) // 2)
    return ranks


def _position_bins(blocks: ResidualBlocks) -> IndexArray:
    """Return the bin along the stroke; rests and holds are apart, as they say nothing of the stroke."""
    along = 2 + np.floor(np.abs(blocks.position_mm) / POSITION_BIN_MM).astype(np.intp)
    return np.where(blocks.phase == Phase.REST, 0, np.where(blocks.phase == Phase.HOLD, 1, along))


def _time_bins(blocks: ResidualBlocks) -> IndexArray:
    """Return the bin of the time since the last start or stop, on a logarithmic scale; the rest has one of its own."""
    held = blocks.phase == Phase.HOLD
    begun = blocks.phase != Phase.REST
    start = blocks.time_s[begun][0] if begun.any() else 0.0
    stop = blocks.time_s[held][0] if held.any() else np.inf
    since = np.where(held, blocks.time_s - stop, blocks.time_s - start)
    bins = np.searchsorted(np.geomspace(0.01, 300.0, TIME_BINS), np.maximum(since, 0.0))
    return np.where(begun, 1 + bins + held * (TIME_BINS + 2), 0)


def _combined_index(*parts: IndexArray) -> IndexArray:
    """Return one number for each combination."""
    joined = parts[0]
    for values in parts[1:]:
        joined = joined * (int(values.max()) + 1) + values
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
    steady = [np.abs(run.position_mm[run.phase == Phase.STEADY]) for run in blocks]
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
    total = sum(float((run.weight * run.deviation**2).sum()) for run in blocks)
    waves = trial_wavenumbers(blocks)
    in_position, in_time = np.zeros(waves.size), np.zeros(FREQUENCIES_HZ.size)
    if total <= 0:
        return in_position, in_time
    for run in blocks:
        steady, begun = run.phase == Phase.STEADY, run.phase != Phase.REST
        in_position += _sine_power(run, np.abs(run.position_mm), steady, waves)
        in_time += _sine_power(run, run.time_s, begun, FREQUENCIES_HZ)
    return in_position / total, in_time / total


def best_wavenumber(blocks: Sequence[ResidualBlocks]) -> float:
    """Return the wave number per mm of which a sine accounts for most, told as exactly as runs tell it."""
    waves, result = trial_wavenumbers(blocks), periodic_shares(blocks)[0]
    at = int(result.argmax())
    low, high = waves[max(at - 1, 0)], waves[min(at + 1, waves.size - 1)]
    near = np.linspace(low, high, REFINEMENT_POINTS)
    moving = [(run, run.phase == Phase.STEADY) for run in blocks]
    taken = np.sum([_sine_power(run, np.abs(run.position_mm), steady, near) for run, steady in moving], axis=0)
    return float(near[int(taken.argmax())])


def _sine_power(blocks: ResidualBlocks, coordinate: FloatArray, inside: BoolArray, rates: FloatArray) -> FloatArray:
    """Return the squares that a sine of each rate accounts for, beyond a straight line, in a part of a run."""
    if np.count_nonzero(inside) < MIN_SINE_BLOCKS:
        return np.zeros_like(rates)
    at, deviation, weight = coordinate[inside], blocks.deviation[inside], blocks.weight[inside]
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
    scores = {name: max(cross_predicted_share(table, coordinate) for coordinate in seen[name]) for name in seen}
    in_position, in_time = best_periodic_shares(blocks)
    scores["position"] = max(scores["position"], scores[CONSTANT_DOMAIN] + in_position)
    scores["session"] = max(scores["session"], scores[CONSTANT_DOMAIN] + in_time)
    total = sum(float((run.weight * run.deviation**2).sum()) for run in blocks)
    fast = sum(_fast_excess(run) for run in blocks)
    scores["frequency"] = fast / (total + fast) if fast > 0 else 0.0
    scores["transient"] = sum(_transient_excess(run) for run in blocks) / total if total > 0 else 0.0
    return {name: float(np.clip(scores[name], 0.0, 1.0)) for name in DOMAINS}


def _fast_excess(blocks: ResidualBlocks) -> float:
    return float(np.maximum(band_excess(blocks)[np.array(BANDS_HZ[:-1]) >= FAST_HZ], 0.0).sum())


def _transient_excess(blocks: ResidualBlocks) -> float:
    """Return the excess while the velocity changes and shortly after, above what the run has elsewhere."""
    changing = (blocks.phase == Phase.ACCELERATE) | (blocks.phase == Phase.DECELERATE)
    if not changing.any():
        return 0.0
    changes = blocks.time_s[changing]
    after = blocks.time_s[:, None] - changes
    near = ((after >= 0) & (after < TRANSIENT_S)).any(axis=1)
    elsewhere = blocks.excess[~near].sum() / max(float(blocks.weight[~near].sum()), 1e-9)
    return max(float(blocks.excess[near].sum() - max(elsewhere, 0.0) * blocks.weight[near].sum()), 0.0)


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
    found = [permutation_test(axis, runs.kind_index, generator) for axis in axes]
    tests = [
        largest_excess_p(blocks),
        overall_p(runs.energy, generator),
        *(significance.min_p for significance in found if significance.p.size),
    ]
    p = min(1.0, len(tests) * min(tests))
    there = p < ALPHA if present is None else present
    whole = float(np.maximum(runs.energy, 0.0).sum())
    scores = domain_scores(blocks) if there else {}
    return GapLocation(
        present=there,
        p=p,
        rms=_root_of_excess(float(runs.energy.mean())),
        locations=tuple(
            _axis_location(axis, significance, whole, there) for axis, significance in zip(axes, found, strict=True)
        ),
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
    time = axis.duration.sum(axis=0)
    rms = np.sqrt(np.maximum(np.divide(axis.energy.sum(axis=0), time, out=np.zeros_like(time), where=time > 0), 0.0))
    bins = tuple(
        _axis_bin(axis, number, float(shares[number]), float(rms[number]), tested) for number in range(shares.size)
    )
    if not axis.ordered or total <= 0:
        return AxisLocation(axis.name, bins, covered, None, None, 0.0, 1.0, tested.min_p)
    first, last = _narrowest_window(shares)
    low, high = float(axis.edges[first, 0]), float(axis.edges[last, 1])
    share = float(shares[first : last + 1].sum())
    return AxisLocation(axis.name, bins, covered, low, high, share, tested.of_window(first, last), tested.min_p)


def _axis_bin(axis: ExcessAxis, number: int, share: float, rms: float, tested: Significance) -> AxisBin:
    p = tested.of_window(number, number)
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
    for run in blocks:
        for phase in np.unique(run.phase).tolist():
            inside = run.phase == phase
            key = run.channel, run.kind, phase
            more = np.array([run.excess[inside].sum(), run.weight[inside].sum()])
            excess[key] = excess.get(key, np.zeros(2)) + more
    places = dict.fromkeys((run.channel, run.kind) for run in blocks)
    return tuple(
        PhaseCell(channel, kind, name, _root_of_excess(float(result[0] / result[1])) if result is not None else None)
        for channel, kind in places
        for phase, name in enumerate(PHASE_NAMES)
        for result in [excess.get((channel, kind, phase))]
    )


def _root_of_excess(energy: float) -> float:
    return float(np.sqrt(max(energy, 0.0)))


def attribute_to_effects(
    location: GapLocation, blocks: Sequence[ResidualBlocks], added: Sequence[FloatArray]
) -> GapLocation:
    """Return shares of what named effects add, where the residuals of the campaign have no excess to share out.

    A change of a few per cent from run to run is as large as repeatability in each block, and still plain over a
    session. The p-values stay those of the residuals.

    Parameters
    ----------
    location
        What the residuals say.
    blocks
        They.
    added
        What the effects add, block by block, to each of the first of these [the channel's unit].
    """
    if not location.present or any(location.location("channel").shares.values()):
        return location
    shown = [replace(run, explained=more) for run, more in zip(blocks, added, strict=False)]
    where = localise([*shown, *blocks[len(shown) :]], present=True, seed=location.seed)
    pairs = zip(location.locations, where.locations, strict=True)
    return replace(where, p=location.p, locations=tuple(_with_residual_p(*pair) for pair in pairs))


def _with_residual_p(location: AxisLocation, shown: AxisLocation) -> AxisLocation:
    bins = tuple(_bin_with_residual_p(*pair) for pair in zip(location.bins, shown.bins, strict=True))
    return replace(shown, bins=bins, p=location.p, min_p=location.min_p)


def _bin_with_residual_p(axis_bin: AxisBin, shown: AxisBin) -> AxisBin:
    return replace(shown, p=axis_bin.p)
