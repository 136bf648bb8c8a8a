"""A sparse law of an unexplained gap: few terms, selected by their prediction of held-out runs.

Selection runs forward, exchanges terms, then goes backward. All scores come from products of terms by fold, so that
one candidate costs microseconds.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from math import floor, log10

import numpy as np
import numpy.typing as npt

from dragrig.analysis import set_values
from dragrig.analysis.gap.diagnosis import GapLocation
from dragrig.analysis.gap.excess import ResidualBlocks, has_session_clock
from dragrig.rig import BoolArray, FloatArray, IndexArray, Phase

DOMINANT_SHARE, NOTABLE_SHARE, NEGLIGIBLE_SHARE = 0.8, 0.1, 0.05
"""Shares of the excess that count as nearly all of it, as worth naming, and as negligible."""

PHASE_SPANS: Mapping[str, frozenset[Phase]] = {
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
"""Groups of phases, the smallest first."""


@dataclass(frozen=True, slots=True, eq=False)
class GapRegion:
    """The blocks in which a gap is."""

    channel: str
    kinds: tuple[str, ...]
    """`channel`, `kinds`: its channel, and kinds of run."""
    blocks: tuple[ResidualBlocks, ...]
    """Runs of these kinds, this channel alone."""
    masks: tuple[BoolArray, ...]
    """Which blocks of each run are in these phases."""
    excess: float
    """Excess of the whole campaign, other channels and kinds included."""

    @property
    def unit(self) -> str:
        """Unit in which residuals are reported."""
        return "µm" if self.channel == "position" else "mN"

    @property
    def unit_factor(self) -> float:
        """Factor from the channel's unit to that unit."""
        return 1000.0 if self.channel == "position" else 1.0


def gap_region(where: GapLocation, blocks: Sequence[ResidualBlocks]) -> GapRegion:
    """Return the blocks with all but a negligible share of the gap."""
    shares = where.location("channel").shares
    channels = list(dict.fromkeys(run.channel for run in blocks))
    channel = max(channels, key=lambda name: shares.get(name, 0.0))
    kinds = kinds_with_excess(where, blocks, NOTABLE_SHARE)
    selected = tuple(run for run in blocks if run.channel == channel and run.kind in kinds)
    phases = np.array(sorted(PHASE_SPANS.get(phase_span(where), frozenset(Phase))), dtype=np.uint8)
    masks = tuple(np.isin(run.phase, phases) for run in selected)
    return GapRegion(channel, kinds, selected, masks, sum(float(run.excess.sum()) for run in blocks))


def kinds_with_excess(where: GapLocation, blocks: Sequence[ResidualBlocks], min_share: float) -> tuple[str, ...]:
    """Return the kinds of run with at least this share of the excess, or the one with most."""
    shares = where.location("protocol").shares
    kinds = sorted(dict.fromkeys(run.kind for run in blocks), key=lambda kind: -shares.get(kind, 0.0))
    return tuple(kind for rank, kind in enumerate(kinds) if rank == 0 or shares.get(kind, 0.0) >= min_share)


def phase_span(where: GapLocation) -> str:
    """Return the smallest group of phases with all but a negligible share of the gap; empty for all phases."""
    shares = where.location("phase").shares
    for name, phases in PHASE_SPANS.items():
        if sum(shares.get(phase.name.lower(), 0.0) for phase in phases) >= 1 - NEGLIGIBLE_SHARE:
            return name
    return ""


MIN_LOG_SPEED_MM_S = 0.05
"""Speed below which the logarithm of the speed is constant."""
MIN_VARIATION = 1e-3
"""Terms with a smaller relative variation are constant."""

SYMBOL_UNITS: Mapping[str, str] = {
    "v": "speed v in mm/s",
    "x": "position x in mm",
    "t": "time since the start t in s",
    "T": "session time T in min",
    "n": "run count n",
    "ε": "strain ε",
    "F": "measured force F in mN",
}
"""Meaning and unit of the symbols."""


@dataclass(frozen=True, slots=True, eq=False)
class TermLibrary:
    """Terms at `N` blocks."""

    names: tuple[str, ...]
    """Names of the `M` terms."""
    factors: FloatArray
    """Number of factors of each term, shape `(M,)`."""
    values: FloatArray
    """Values of the terms, shape `(N, M)`."""
    residual: FloatArray
    weight: FloatArray
    """`residual`, `weight`: residual [the region's unit], and the weight of its square, at most 1 over the expected
    mean square for all blocks of a run together. Shape `(N,)`.
    """
    run: IndexArray
    """Index of the run, shape `(N,)`."""


def term_library(region: GapRegion) -> TermLibrary:
    """Return the constant and all terms that vary in a region."""
    runs_in_order = sorted({(blocks.session_s or 0.0, blocks.run_id) for blocks in region.blocks})
    order = {name: number for number, (_, name) in enumerate(runs_in_order)}
    excluded = _excluded_variables(region)
    columns: dict[str, FloatArray] = {}
    for name, variable in _variables(order).items():
        if not name.startswith(excluded):
            columns[name] = np.concatenate(
                [variable(blocks)[mask] for blocks, mask in zip(region.blocks, region.masks, strict=True)]
            )
    simple = {name: values for name, values in columns.items() if name == "1" or _varies(values)}
    linear = [name for name in simple if name != "1" and not name.endswith("²")]
    products = {
        f"{factor}·{other_factor}": simple[factor] * simple[other_factor]
        for factor, other_factor in combinations(linear, 2)
    }
    pairs = {name: values for name, values in products.items() if _varies(values) and name != "v·ln(v)"}
    terms = {**simple, **pairs}
    masked = list(zip(region.blocks, region.masks, strict=True))
    return TermLibrary(
        names=tuple(terms),
        factors=np.array([2.0 if name in pairs or name.endswith("²") else 1.0 for name in terms]),
        values=np.stack(list(terms.values()), axis=1),
        residual=region.unit_factor * np.concatenate([blocks.residual[mask] for blocks, mask in masked]),
        weight=np.concatenate(
            [(blocks.weight / (region.unit_factor * blocks.noise_sd) ** 2)[mask] for blocks, mask in masked]
        ),
        run=np.concatenate([np.full(np.count_nonzero(mask), number) for number, (_, mask) in enumerate(masked)]),
    )


def _varies(values: FloatArray) -> bool:
    return bool(np.ptp(values) > MIN_VARIATION * abs(values).max())


def _excluded_variables(region: GapRegion) -> tuple[str, ...]:
    """Return variables without meaning here: speed and travel of sheared walls, force or session where unknown."""
    sheared = all(blocks.strain > 0 for blocks in region.blocks)
    unknown = any(blocks.force_mN is None for blocks in region.blocks)
    undated = not has_session_clock(region.blocks)
    excluded = (("v", "ln(v)", "x") if sheared else (), ("F",) if unknown else (), ("T", "n") if undated else ())
    return tuple(name for names in excluded for name in names)


def _variables(order: Mapping[str, int]) -> Mapping[str, Callable[[ResidualBlocks], FloatArray]]:
    return {
        "1": lambda blocks: np.ones_like(blocks.residual),
        "v": block_speed,
        "ln(v)": lambda blocks: np.log(np.maximum(block_speed(blocks), MIN_LOG_SPEED_MM_S)),
        "v²": lambda blocks: block_speed(blocks) ** 2,
        "ε": lambda blocks: np.full_like(blocks.residual, blocks.strain),
        "ε²": lambda blocks: np.full_like(blocks.residual, blocks.strain**2),
        "x": lambda blocks: np.abs(blocks.position_mm),
        "x²": lambda blocks: blocks.position_mm**2,
        "t": time_since_start,
        "T": lambda blocks: ((blocks.session_s or 0.0) + blocks.time_s) / 60.0,
        "n": lambda blocks: np.full_like(blocks.residual, order[blocks.run_id]),
        "F": lambda blocks: np.zeros_like(blocks.residual) if blocks.force_mN is None else blocks.force_mN,
    }


def block_speed(blocks: ResidualBlocks) -> FloatArray:
    """Return the speed [mm/s], the commanded one where steady, shape `(B,)`."""
    if blocks.residual.size < 2:
        return np.full_like(blocks.residual, blocks.speed_mm_s)
    local = np.abs(np.gradient(blocks.position_mm, blocks.time_s))
    changing = (blocks.phase == Phase.ACCELERATE) | (blocks.phase == Phase.DECELERATE)
    steady = np.where(blocks.phase == Phase.STEADY, blocks.speed_mm_s, 0.0)
    return np.where(changing, np.clip(local, 0.0, blocks.speed_mm_s), steady)


def time_since_start(blocks: ResidualBlocks) -> FloatArray:
    """Return the time since the motion began [s], 0 before, shape `(B,)`."""
    begun = blocks.phase != Phase.REST
    return np.maximum(blocks.time_s - blocks.time_s[begun][0], 0.0) if begun.any() else np.zeros_like(blocks.time_s)


MAX_TERMS, EXHAUSTIVE_SIZE = 4, 3
TERM_RIDGE = 1e-7
"""Relative ridge that separates terms which are equal in all runs."""

TermIndices = tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class FoldProducts:
    """Weighted products of `M` terms and the residual in `K` folds, terms scaled to norm 1."""

    gram: FloatArray
    moment: FloatArray
    squares: FloatArray
    """`gram`, `moment`, `squares`: terms with terms, terms with residual, residual with itself; shapes `(K, M, M)`,
    `(K, M)` and `(K,)`.
    """

    def without(self, fold: int) -> "FoldProducts":
        """Leave a fold out."""
        others = np.arange(self.squares.size) != fold
        return FoldProducts(self.gram[others], self.moment[others], self.squares[others])


def held_out_chi2(products: FoldProducts, subsets: npt.NDArray[np.intp]) -> FloatArray:
    """Return the remaining squares of `S` subsets of `k` terms in each held-out fold, `(S, k)` to `(S, K)`."""
    if not subsets.shape[1]:
        return np.broadcast_to(products.squares, (subsets.shape[0], products.squares.size))
    rows, columns = subsets[:, :, None], subsets[:, None, :]
    gram, moment = products.gram[:, rows, columns], products.moment[:, subsets]
    other_gram = gram.sum(axis=0) - gram + TERM_RIDGE * np.eye(subsets.shape[1])
    coefficients = np.linalg.solve(other_gram, (moment.sum(axis=0) - moment)[..., None])[..., 0]
    explained = 2 * np.einsum("fsk,fsk->fs", coefficients, moment)
    remaining = products.squares[:, None] - explained + np.einsum("fsi,fsij,fsj->fs", coefficients, gram, coefficients)
    return np.asarray(remaining.T)


def select_terms(products: FoldProducts, penalty: FloatArray) -> TermIndices:
    """Return the terms with the smallest held-out squares plus penalties, shape `(M,)`.

    All pairs and triples of the cheapest terms are tried, too: two terms may explain a residual that neither explains
    alone.
    """
    chosen: TermIndices = ()
    best: tuple[TermIndices, float] = (chosen, float(products.squares.sum()))
    cheapest = np.flatnonzero(penalty == penalty.min()).tolist()
    for size in range(1, min(MAX_TERMS, penalty.size) + 1):
        subsets = [(*chosen, index) for index in range(penalty.size) if index not in chosen]
        subsets += combinations(cheapest, size) if size <= EXHAUSTIVE_SIZE else ()
        chosen, cost = _exchange_terms(products, penalty, *_best_subset(products, penalty, subsets))
        best = min(best, (chosen, cost), key=lambda pair: pair[1])
    chosen, cost = best
    while len(chosen) > 1:
        subsets_without = [tuple(index for index in chosen if index != dropped) for dropped in chosen]
        subset, subset_cost = _best_subset(products, penalty, subsets_without)
        if subset_cost >= cost:
            break
        chosen, cost = subset, subset_cost
    return tuple(sorted(chosen))


def _exchange_terms(
    products: FoldProducts, penalty: FloatArray, chosen: TermIndices, cost: float
) -> tuple[TermIndices, float]:
    """Replace each term before the last one by another if that lowers the cost."""
    for place in range(len(chosen) - 1):
        others = (*chosen[:place], *chosen[place + 1 :])
        subset, subset_cost = _best_subset(
            products, penalty, [(*others, index) for index in range(penalty.size) if index not in others]
        )
        if subset_cost < cost:
            chosen, cost = subset, subset_cost
    return chosen, cost


def _best_subset(products: FoldProducts, penalty: FloatArray, subsets: list[TermIndices]) -> tuple[TermIndices, float]:
    index = np.array(subsets, dtype=np.intp)
    cost = held_out_chi2(products, index).sum(axis=1) + penalty[index].sum(axis=1)
    best = int(np.argmin(cost))
    return subsets[best], float(cost[best])


LAW_FOLDS, MIN_CONDITIONS = 6, 3
MIN_LAW_SHARE = 0.5
"""Share of the excess that a law must explain in held-out runs."""
TERM_PENALTY = 0.015
"""Share of the excess that each factor of a term must explain."""
MIN_EXCESS_SIGMAS = 3.0
"""Smallest excess for a law, in standard deviations; that of a run's mean square is at most √2."""


@dataclass(frozen=True, slots=True)
class GapLaw:
    """A sparse expression of a gap."""

    terms: tuple[str, ...]
    coefficients: tuple[float, ...]
    sd: tuple[float, ...]
    """`terms`, `coefficients`, `sd`: names of the terms, and their coefficients with standard deviations robust to
    dependence within runs.
    """
    unit: str
    """Unit of the expression."""
    held_out_share: float
    """Share of the whole excess that it explains in held-out runs, terms and coefficients chosen without them."""

    @property
    def text(self) -> str:
        """The expression, coefficients rounded to their standard deviations."""
        text = ""
        for name, value, sd in zip(self.terms, self.coefficients, self.sd, strict=True):
            sign = " − " if value < 0 else " + "
            text += (sign if text else sign.strip().replace("+", "")) + _rounded_to_sd(abs(value), sd)
            text += "" if name == "1" else f"·{name}"
        factors = {
            symbol.removesuffix("²").removeprefix("ln(").removesuffix(")") for symbol in "·".join(self.terms).split("·")
        }
        symbols = [symbol for symbol in SYMBOL_UNITS if symbol in factors]
        return f"{text} [{self.unit}]" + "".join(f", {SYMBOL_UNITS[symbol]}" for symbol in symbols)


def fit_gap_law(region: GapRegion) -> GapLaw | None:
    """Return a law that explains at least half of a gap in held-out runs; None for no such law.

    Folds are whole conditions (kind, speed and strain): a law must predict conditions that it has not seen. Terms are
    selected anew for each fold.
    """
    folds = condition_folds(region.blocks)
    if folds is None:
        return None
    terms = term_library(region)
    by_run, scale = _products_by_run(terms, len(region.blocks))
    weight = sum(float(blocks.weight[mask].sum()) for blocks, mask in zip(region.blocks, region.masks, strict=True))
    excess = max(region.excess, float(by_run.squares.sum()) - weight)
    if excess < MIN_EXCESS_SIGMAS * np.sqrt(2 * len(region.blocks)):
        return None
    products = _products_by_fold(by_run, folds)
    penalty = TERM_PENALTY * excess * terms.factors
    choices = [select_terms(products.without(index), penalty) for index in range(products.squares.size)]
    remaining = sum(
        float(held_out_chi2(products, np.array([chosen], dtype=np.intp))[0, index])
        for index, chosen in enumerate(choices)
    )
    share = (float(products.squares.sum()) - remaining) / excess
    chosen = select_terms(products, penalty)
    if share < MIN_LAW_SHARE or not chosen:
        return None
    coefficients, sd = _robust_coefficients(by_run, chosen)
    names = tuple(terms.names[index] for index in chosen)
    scales = scale[list(chosen)]
    scaled, scaled_sd = (tuple((values / scales).tolist()) for values in (coefficients, sd))
    return GapLaw(names, scaled, scaled_sd, region.unit, min(share, 1.0))


def condition_folds(blocks: Sequence[ResidualBlocks]) -> IndexArray | None:
    """Return the fold of each run, whole conditions together and adjacent ones apart; None for too few conditions."""
    speeds, strains = set_values(run.speed_mm_s for run in blocks), set_values(run.strain for run in blocks)
    conditions = list(zip((run.kind for run in blocks), speeds, strains, strict=True))
    number = {condition: index for index, condition in enumerate(sorted(set(conditions)))}
    if len(number) < MIN_CONDITIONS:
        return None
    return np.array([number[condition] % min(LAW_FOLDS, len(number)) for condition in conditions], dtype=np.intp)


def _products_by_run(terms: TermLibrary, runs: int) -> tuple[FoldProducts, FloatArray]:
    """Return the products of each run, and the scale of each term."""
    root = np.sqrt(terms.weight)
    columns = root[:, None] * terms.values
    scale = np.linalg.norm(columns, axis=0)
    columns, residual = columns / scale, root * terms.residual
    bounds = np.searchsorted(terms.run, np.arange(runs + 1))
    slices = [slice(low, high) for low, high in pairwise(bounds.tolist())]
    gram = np.stack([columns[rows].T @ columns[rows] for rows in slices])
    moment = np.stack([columns[rows].T @ residual[rows] for rows in slices])
    return FoldProducts(gram, moment, np.array([residual[rows] @ residual[rows] for rows in slices])), scale


def _products_by_fold(by_run: FoldProducts, fold: IndexArray) -> FoldProducts:
    member = (np.arange(int(fold.max()) + 1)[:, None] == fold).astype(np.float64)
    gram = np.tensordot(member, by_run.gram, axes=1)
    return FoldProducts(gram, member @ by_run.moment, member @ by_run.squares)


def _robust_coefficients(by_run: FoldProducts, chosen: TermIndices) -> tuple[FloatArray, FloatArray]:
    """Return scaled coefficients with sandwich standard deviations, blocks of a run dependent."""
    index = np.array(chosen)
    gram, moment = by_run.gram[:, index[:, None], index], by_run.moment[:, index]
    inverse = np.linalg.inv(gram.sum(axis=0) + 1e-12 * np.eye(index.size))
    coefficients = inverse @ moment.sum(axis=0)
    scores = moment - gram @ coefficients
    runs = scores.shape[0]
    covariance = inverse @ (scores.T @ scores) @ inverse * runs / max(runs - index.size, 1)
    return coefficients, np.sqrt(np.maximum(np.diag(covariance), 0.0))


def _rounded_to_sd(value: float, sd: float) -> str:
    """Round to the first digit of the standard deviation, to the second one if the first is 1."""
    last = floor(log10(sd)) if sd > 0 else floor(log10(max(value, 1e-12))) - 3
    last -= int(sd / 10**last < 2)
    # An amount that is smaller than its uncertainty still shows its first digit.
    last = min(last, floor(log10(value))) if value > 0 else last
    return f"{round(value, -last):.{max(-last, 0)}f}"
