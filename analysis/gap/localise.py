"""Where a gap is: excess by axis, its significance, and the variable that the residual is mainly a function of.

Each domain predicts the residual of a run from the other runs, bin by bin of its coordinate. A periodic residual with
a phase of its own in each run cannot be predicted this way: there a sine of one period for all runs is added.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis import set_values
from dragrig.analysis.gap.diagnosis import ALPHA, AxisBin, AxisLocation, GapLocation, PhaseCell
from dragrig.analysis.gap.excess import (
    BANDS_HZ,
    PERMUTATIONS,
    PHASE_NAMES,
    SESSION_AXIS,
    CampaignResiduals,
    ExcessAxis,
    ResidualBlocks,
    Significance,
    band_excess,
    excess_axes,
    has_session_clock,
    largest_excess_p,
    overall_p,
    permutation_test,
)
from dragrig.rig import BoolArray, Contact, FloatArray, IndexArray, Phase

CONSTANT_DOMAIN = "constant"
"""Pseudo-domain of a residual that is the same in all runs of a kind."""

POSITION_BIN_MM, TIME_BINS = 1.0, 24
"""Width of the bins along the stroke, and number of bins from 10 ms to 300 s after a start or stop."""


@dataclass(frozen=True, slots=True, eq=False)
class BlockTable:
    """All blocks stacked: index of the run, weight, deviation."""

    run: IndexArray
    weight: FloatArray
    deviation: FloatArray

    @classmethod
    def of(cls, blocks: Sequence[ResidualBlocks]) -> "BlockTable":
        """Stack the blocks of all runs."""
        number = {name: index for index, name in enumerate(dict.fromkeys(run.run_id for run in blocks))}
        return cls(
            np.concatenate([np.full(run.residual.size, number[run.run_id]) for run in blocks]),
            np.concatenate([run.weight for run in blocks]),
            np.concatenate([run.deviation for run in blocks]),
        )


DomainCoordinate = tuple[IndexArray, FloatArray]
"""Bin of each block along a domain's coordinate, and a scale of the residual in it."""


def cross_predicted_share(table: BlockTable, bins: IndexArray, scale: FloatArray) -> float:
    """Return the weighted share of the squares that other runs' bins predict; negative where they mislead.

    In each bin the residual is a factor times the scale, fitted to the other runs by least squares.
    """
    runs = int(table.run.max()) + 1
    keys, cell = np.unique(bins * runs + table.run, return_inverse=True)
    product = np.bincount(cell, table.weight * scale * table.deviation)
    square = np.bincount(cell, table.weight * scale**2)
    bin_of_cell = np.unique(keys // runs, return_inverse=True)[1]
    moment = np.bincount(bin_of_cell, product)[bin_of_cell] - product
    squares = np.bincount(bin_of_cell, square)[bin_of_cell] - square
    factor = np.divide(moment, squares, out=np.zeros_like(moment), where=squares > 1e-9 * square)
    residual = table.deviation - factor[cell] * scale
    total = float((table.weight * table.deviation**2).sum())
    return 1 - float((table.weight * residual**2).sum()) / total if total > 0 else 0.0


def domain_coordinates(blocks: Sequence[ResidualBlocks]) -> Mapping[str, tuple[DomainCoordinate, ...]]:
    """Return the coordinates of each domain that other runs can predict."""
    groups = list(dict.fromkeys((run.channel, run.kind) for run in blocks))
    group = _per_block(blocks, [groups.index((run.channel, run.kind)) for run in blocks])
    ones = np.ones(group.size)
    strain = np.concatenate([np.full(run.residual.size, run.strain or 1.0) for run in blocks])
    phase = np.concatenate([run.phase.astype(np.intp) for run in blocks])
    speed = _per_block(blocks, np.unique(set_values(run.speed_mm_s for run in blocks), return_inverse=True)[1].tolist())
    position = np.concatenate([_position_bins(run) for run in blocks])
    time = np.concatenate([_time_bins(run) for run in blocks])
    shifts = (0, 1) if has_session_clock(blocks) else ()
    neighbours = [_per_block(blocks, _session_pairs(blocks, shift)) for shift in shifts]
    sheared = _per_block(blocks, [int(run.contact is Contact.STICKING) for run in blocks]) > 0
    return {
        CONSTANT_DOMAIN: ((_combined_index(group, phase), ones),),
        "speed": ((_combined_index(group, phase, speed), np.where(sheared, 0.0, 1.0)),),
        "position": ((_combined_index(group, position), np.where(sheared, 0.0, 1.0)),),
        "time": tuple((_combined_index(group, time), scale) for scale in (ones, strain)),
        "session": tuple((_combined_index(group, phase, pair), ones) for pair in neighbours),
        "strain": ((_combined_index(group, time), np.where(sheared, strain**2, 0.0)),),
    }


def _per_block(blocks: Sequence[ResidualBlocks], number: Sequence[int]) -> IndexArray:
    """Repeat a number of each run for each of its blocks."""
    return np.concatenate([np.full(run.residual.size, value) for run, value in zip(blocks, number, strict=True)])


def _session_pairs(blocks: Sequence[ResidualBlocks], shift: int) -> list[int]:
    """Return the index of the pair of consecutive runs of a kind that each run belongs to."""
    ranks = []
    for run in blocks:
        started = run.session_s or 0.0
        before = sum(o.kind == run.kind and o.channel == run.channel and (o.session_s or 0.0) < started for o in blocks)
        ranks.append((before + shift) // 2)
    return ranks


def _position_bins(blocks: ResidualBlocks) -> IndexArray:
    """Return the bin along the stroke; rests and holds have bins of their own."""
    along = 2 + np.floor(np.abs(blocks.position_mm) / POSITION_BIN_MM).astype(np.intp)
    return np.where(blocks.phase == Phase.REST, 0, np.where(blocks.phase == Phase.HOLD, 1, along))


def _time_bins(blocks: ResidualBlocks) -> IndexArray:
    """Return the logarithmic bin of the time since the last start or stop; rests have a bin of their own."""
    held = blocks.phase == Phase.HOLD
    begun = blocks.phase != Phase.REST
    start = blocks.time_s[begun][0] if begun.any() else 0.0
    stop = blocks.time_s[held][0] if held.any() else np.inf
    since = np.where(held, blocks.time_s - stop, blocks.time_s - start)
    bins = np.searchsorted(np.geomspace(0.01, 300.0, TIME_BINS), np.maximum(since, 0.0))
    return np.where(begun, 1 + bins + held * (TIME_BINS + 2), 0)


def _combined_index(*parts: IndexArray) -> IndexArray:
    """Return a unique index for each combination of indices."""
    joined = parts[0]
    for values in parts[1:]:
        joined = joined * (int(values.max()) + 1) + values
    return np.asarray(joined)


WAVENUMBERS_PER_MM = np.geomspace(1 / 20, 1.0, 120)
FREQUENCIES_HZ = np.geomspace(1 / 30, 3.0, 120)
WAVENUMBER_SPACING, MAX_FINE_WAVENUMBERS = 0.4, 200
"""Spacing of further wave numbers in waves over the longest run, and their largest number."""
REFINEMENT_POINTS = 41
"""Number of wave numbers that refine the best one."""
MIN_SINE_BLOCKS = 8
"""Fewest blocks for a sine."""

MIN_PERIODS = 2.0
"""Fewest periods of a sine in a run that contributes to it."""


def trial_wavenumbers(blocks: Sequence[ResidualBlocks]) -> FloatArray:
    """Return the trial wave numbers per mm: the standard ones, and shorter waves that the blocks resolve."""
    steady = [np.abs(run.position_mm[run.phase == Phase.STEADY]) for run in blocks]
    steady = [positions for positions in steady if positions.size >= MIN_SINE_BLOCKS and np.ptp(positions) > 0]
    if not steady:
        return WAVENUMBERS_PER_MM
    shortest = float(np.median([np.median(np.diff(np.sort(positions))) for positions in steady]))
    step = WAVENUMBER_SPACING / max(float(np.ptp(positions)) for positions in steady)
    last = float(WAVENUMBERS_PER_MM[-1])
    highest = min(0.5 / max(shortest, 1e-9), last + MAX_FINE_WAVENUMBERS * step)
    return np.concatenate((WAVENUMBERS_PER_MM, np.arange(last + step, highest, step)))


STROKE_SPEED_SHARE, MIN_TURNS, STROKE_OVERTONES, MAX_DETUNING = 0.1, 3, 5, 0.1
"""A stroke is faster than this share of the highest speed; a motion of so many turns is periodic, and so is what it
makes, with so many overtones, at frequencies that differ by less than this from its own or one over the turns."""


def periodic_shares(blocks: Sequence[ResidualBlocks]) -> tuple[FloatArray, FloatArray]:
    """Return the share of all squares that a sine explains.

    One of each of `trial_wavenumbers` in position, and of `FREQUENCIES_HZ` in time, but for those of a run's strokes.
    """
    total = sum(float((run.weight * run.deviation**2).sum()) for run in blocks)
    waves = trial_wavenumbers(blocks)
    in_position, in_time = np.zeros(waves.size), np.zeros(FREQUENCIES_HZ.size)
    if total <= 0:
        return in_position, in_time
    for run in blocks:
        steady, begun = run.phase == Phase.STEADY, run.phase != Phase.REST
        in_position += _sine_power(run, np.abs(run.position_mm), steady, waves)
        in_time += _sine_power(run, run.time_s, begun, FREQUENCIES_HZ) * ~_are_of_strokes(run)
    return in_position / total, in_time / total


def _are_of_strokes(blocks: ResidualBlocks) -> BoolArray:
    """Return which of `FREQUENCIES_HZ` are those of a motion there and back, or its overtones."""
    velocity = np.gradient(blocks.position_mm, blocks.time_s)
    moving = np.abs(velocity) > STROKE_SPEED_SHARE * np.abs(velocity).max()
    forth, time_s = velocity[moving] > 0, blocks.time_s[moving]
    turns_s = (0.5 * (time_s[1:] + time_s[:-1]))[forth[1:] != forth[:-1]]
    if turns_s.size < MIN_TURNS:
        return np.zeros(FREQUENCIES_HZ.size, dtype=np.bool_)
    ratio = FREQUENCIES_HZ * 2.0 * np.median(np.diff(turns_s))
    nearest = np.clip(np.round(ratio), 1, STROKE_OVERTONES)
    return np.asarray(np.abs(ratio - nearest) < max(MAX_DETUNING, 1.0 / turns_s.size))


def best_wavenumber(blocks: Sequence[ResidualBlocks]) -> float:
    """Return the wave number per mm of the best sine, refined."""
    waves, shares = trial_wavenumbers(blocks), periodic_shares(blocks)[0]
    index = int(shares.argmax())
    low, high = waves[max(index - 1, 0)], waves[min(index + 1, waves.size - 1)]
    near = np.linspace(low, high, REFINEMENT_POINTS)
    steady = (_sine_power(run, np.abs(run.position_mm), run.phase == Phase.STEADY, near) for run in blocks)
    powers = np.sum(list(steady), axis=0)
    return float(near[int(powers.argmax())])


def _sine_power(blocks: ResidualBlocks, coordinate: FloatArray, inside: BoolArray, rates: FloatArray) -> FloatArray:
    """Return the squares that a sine of each rate explains beyond a straight line, in a part of a run."""
    if np.count_nonzero(inside) < MIN_SINE_BLOCKS:
        return np.zeros_like(rates)
    coordinates, deviation, weight = coordinate[inside], blocks.deviation[inside], blocks.weight[inside]
    root = np.sqrt(weight)
    line = np.linalg.qr(np.stack((root, root * (coordinates - coordinates.mean())), axis=1))[0]
    residual = root * deviation
    residual = residual - line @ (line.T @ residual)
    max_gap = float(np.diff(np.sort(coordinates)).max())
    allowed = (rates * np.ptp(coordinates) >= MIN_PERIODS) & (rates * max_gap < 0.5)
    angles, summed = 2 * np.pi * rates[allowed, None] * coordinates, root * residual
    powers = np.zeros_like(rates)
    powers[allowed] = 2 * ((np.cos(angles) @ summed) ** 2 + (np.sin(angles) @ summed) ** 2) / weight.sum()
    return np.minimum(powers, float(residual @ residual))


FAST_HZ = 10.0
"""Residuals faster than this belong to the frequency domain."""

TRANSIENT_S = 0.3
"""Time after a change of velocity that counts as transient."""

DOMAINS = ("speed", "position", "time", "session", "frequency", "strain", "transient")


def domain_scores(blocks: Sequence[ResidualBlocks]) -> Mapping[str, float]:
    """Return the share of the residuals' squares that each domain explains, 0 to 1."""
    table = BlockTable.of(blocks)
    coordinates = domain_coordinates(blocks)
    scores = {
        name: max((cross_predicted_share(table, *coordinate) for coordinate in coordinates[name]), default=0.0)
        for name in coordinates
    }
    in_position, in_time = (float(shares.max()) for shares in periodic_shares(blocks))
    scores["position"] = max(scores["position"], scores[CONSTANT_DOMAIN] + in_position)
    # Without a clock, and in a single run, nothing distinguishes session time from time within the run.
    periodic_domain = "session" if has_session_clock(blocks) and len({run.run_id for run in blocks}) > 1 else "time"
    scores[periodic_domain] = max(scores[periodic_domain], scores[CONSTANT_DOMAIN] + in_time)
    total = sum(float((run.weight * run.deviation**2).sum()) for run in blocks)
    is_fast = np.array(BANDS_HZ[:-1]) >= FAST_HZ
    fast = sum(float(np.maximum(band_excess(run)[is_fast], 0.0).sum()) for run in blocks)
    scores["frequency"] = fast / (total + fast) if fast > 0 else 0.0
    scores["transient"] = sum(_transient_excess(run) for run in blocks) / total if total > 0 else 0.0
    if not has_session_clock(blocks):
        del scores["session"]
    return {name: float(np.clip(scores[name], 0.0, 1.0)) for name in DOMAINS if name in scores}


def _transient_excess(blocks: ResidualBlocks) -> float:
    """Return the excess during and shortly after changes of velocity, above that of the rest of the run."""
    changing = (blocks.phase == Phase.ACCELERATE) | (blocks.phase == Phase.DECELERATE)
    if not changing.any():
        return 0.0
    changes = blocks.time_s[changing]
    after = blocks.time_s[:, None] - changes
    near = ((after >= 0) & (after < TRANSIENT_S)).any(axis=1)
    elsewhere = blocks.excess[~near].sum() / max(float(blocks.weight[~near].sum()), 1e-9)
    return max(float(blocks.excess[near].sum() - max(elsewhere, 0.0) * blocks.weight[near].sum()), 0.0)


MAIN_SHARE = 0.8
"""Share of the excess that counts as most of it."""

MIN_COVERED_SHARE = 0.05
"""Smallest covered share of the excess for an axis to have shares: relaxations have no speed, drags no strain."""

MIN_SINGLE_RUN_SCORE = 0.3
"""Smallest score of a domain for a single run, which no other run confirms."""


def localise(blocks: Sequence[ResidualBlocks], present: bool | None = None, seed: int = 0) -> GapLocation:
    """Locate where residuals of a campaign exceed noise and repeatability.

    Within a run, excess is weighted by duration; every run counts equally.

    Parameters
    ----------
    blocks
        Residuals of each run and channel.
    present
        Whether there is a gap, if decided elsewhere; default: by the p-value.
    seed
        Seed of the permutations.

    Raises
    ------
    ValueError
        When there are no blocks.
    """
    if not blocks:
        raise ValueError("There are no residuals to localise")
    runs = CampaignResiduals.of(blocks)
    generator = np.random.default_rng(seed)
    axes = excess_axes(runs)
    significances = [permutation_test(axis, runs.kind_index, generator) for axis in axes]
    tests = [
        largest_excess_p(blocks),
        overall_p(runs.energy, generator),
        *(significance.min_p for significance in significances if significance.p.size),
    ]
    p = min(1.0, len(tests) * min(tests))
    gap_present = p < ALPHA if present is None else present
    total = float(np.maximum(runs.energy, 0.0).sum())
    scores = domain_scores(blocks) if gap_present else {}
    domain = max(scores, key=lambda name: scores[name], default="")
    locations = [
        _axis_location(axis, significance, total, gap_present)
        for axis, significance in zip(axes, significances, strict=True)
    ]
    if not has_session_clock(blocks):
        locations.append(AxisLocation(SESSION_AXIS, (), 0.0, None, None, 0.0, 1.0))
    min_score = MIN_SINGLE_RUN_SCORE if len(runs.ids) == 1 else 0.0
    return GapLocation(
        present=gap_present,
        p=p,
        rms=_root_of_excess(float(runs.energy.mean())),
        locations=tuple(locations),
        cells=_phase_cells(blocks),
        domain=domain if scores.get(domain, 0.0) > min_score else "",
        domain_scores=scores,
        permutations=PERMUTATIONS,
        seed=seed,
        runs=len(runs.ids),
    )


def _axis_location(
    axis: ExcessAxis, significance: Significance, total_excess: float, gap_present: bool
) -> AxisLocation:
    energy = np.maximum(axis.energy.sum(axis=0), 0.0)
    covered = float(energy.sum()) / total_excess if total_excess > 0 else 0.0
    energy *= gap_present and covered >= MIN_COVERED_SHARE
    total = float(energy.sum())
    shares = energy / total if total > 0 else np.zeros_like(energy)
    time = axis.duration.sum(axis=0)
    rms = np.sqrt(np.maximum(np.divide(axis.energy.sum(axis=0), time, out=np.zeros_like(time), where=time > 0), 0.0))
    bins = tuple(
        _axis_bin(axis, number, float(shares[number]), float(rms[number]), significance)
        for number in range(shares.size)
    )
    if not axis.ordered or total <= 0:
        return AxisLocation(axis.name, bins, covered, None, None, 0.0, significance.min_p)
    first, last = _narrowest_window(shares)
    low, high = float(axis.edges[first, 0]), float(axis.edges[last, 1])
    share = float(shares[first : last + 1].sum())
    return AxisLocation(axis.name, bins, covered, low, high, share, significance.window_p(first, last))


def _axis_bin(axis: ExcessAxis, number: int, share: float, rms: float, significance: Significance) -> AxisBin:
    p = significance.window_p(number, number)
    if not axis.ordered:
        return AxisBin(axis.labels[number], None, None, share, rms, p)
    low, high = axis.edges[number].tolist()
    return AxisBin("", low, high, share, rms, p)


def _narrowest_window(shares: FloatArray) -> tuple[int, int]:
    """Return first and last of the fewest adjacent bins with most of the excess; of equal ones those with more."""
    cumulative = np.append(0.0, np.cumsum(shares))
    first, last = np.triu_indices(shares.size)
    contained = cumulative[last + 1] - cumulative[first]
    enough = np.flatnonzero(contained >= MAIN_SHARE - 1e-9)
    best = min(enough.tolist(), key=lambda index: (int(last[index] - first[index]), -float(contained[index])))
    return int(first[best]), int(last[best])


def _phase_cells(blocks: Sequence[ResidualBlocks]) -> tuple[PhaseCell, ...]:
    excess: dict[tuple[str, str, int], FloatArray] = {}
    for run in blocks:
        for phase in np.unique(run.phase).tolist():
            inside = run.phase == phase
            key = run.channel, run.kind, phase
            sums = np.array([run.excess[inside].sum(), run.weight[inside].sum()])
            excess[key] = excess.get(key, np.zeros(2)) + sums
    groups = dict.fromkeys((run.channel, run.kind) for run in blocks)
    return tuple(
        PhaseCell(
            channel,
            kind,
            name,
            _root_of_excess(float(sums_of_cell[0] / sums_of_cell[1])) if sums_of_cell is not None else None,
        )
        for channel, kind in groups
        for phase, name in enumerate(PHASE_NAMES)
        for sums_of_cell in [excess.get((channel, kind, phase))]
    )


def _root_of_excess(energy: float) -> float:
    return float(np.sqrt(max(energy, 0.0)))


def attribute_to_effects(
    location: GapLocation, blocks: Sequence[ResidualBlocks], added: Sequence[FloatArray]
) -> GapLocation:
    """Return the shares of named effects where the residuals have no excess to locate.

    A change of a few per cent from run to run is as large as repeatability in each block, and yet significant over a
    session. The p-values stay those of the residuals.

    Parameters
    ----------
    location
        Location from the residuals.
    blocks
        The residuals.
    added
        Contribution of the effects to each of the first of these, by block [the channel's unit].
    """
    if not location.present or any(location.location("channel").shares.values()):
        return location
    shown = [replace(run, explained=contribution) for run, contribution in zip(blocks, added, strict=False)]
    where = localise([*shown, *blocks[len(shown) :]], present=True, seed=location.seed)
    axes = []
    for residual, effect in zip(location.locations, where.locations, strict=True):
        bins = tuple(replace(bin_, p=own.p) for bin_, own in zip(effect.bins, residual.bins, strict=True))
        axes.append(replace(effect, bins=bins, p=residual.p))
    return replace(where, p=location.p, locations=tuple(axes))
