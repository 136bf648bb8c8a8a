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

from dragrig.analysis.gap.diagnosis import GapLocation
from dragrig.analysis.gap.excess import ResidualBlocks
from dragrig.rig.arrays import BoolArray, FloatArray, IndexArray
from dragrig.rig.profile import Phase

DOMINANT_SHARE, NOTABLE_SHARE, NEGLIGIBLE_SHARE = 0.8, 0.1, 0.05
"""Shares of the excess that are most of it, a part to be named, and as good as nothing."""

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
"""Phases that belong together, the fewest first."""


@dataclass(frozen=True, slots=True, eq=False)
class GapRegion:
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


def gap_region(where: GapLocation, blocks: Sequence[ResidualBlocks]) -> GapRegion:
    """Return the blocks that have all of the gap but what is as good as nothing."""
    shares = where.location("channel").shares
    channels = list(dict.fromkeys(one.channel for one in blocks))
    channel = max(channels, key=lambda name: shares.get(name, 0.0))
    kinds = kinds_with_excess(where, blocks, NOTABLE_SHARE)
    found = tuple(one for one in blocks if one.channel == channel and one.kind in kinds)
    span = phase_span(where)
    phases = np.array(sorted(PHASE_SPANS.get(span, frozenset(Phase))), dtype=np.uint8)
    inside = tuple(np.isin(one.phase, phases) for one in found)
    return GapRegion(channel, kinds, span, found, inside, sum(float(one.excess.sum()) for one in blocks))


def kinds_with_excess(where: GapLocation, blocks: Sequence[ResidualBlocks], least: float) -> tuple[str, ...]:
    """Return the kinds of run that have at least this share of the excess, or the one that has most."""
    shares = where.location("protocol").shares
    seen = sorted(dict.fromkeys(one.kind for one in blocks), key=lambda kind: -shares.get(kind, 0.0))
    return tuple(kind for at, kind in enumerate(seen) if at == 0 or shares.get(kind, 0.0) >= least)


def phase_span(where: GapLocation) -> str:
    """Return the fewest phases that have all of the gap but what is as good as nothing; empty for all of them."""
    shares = where.location("phase").shares
    for name, phases in PHASE_SPANS.items():
        if sum(shares.get(one.name.lower(), 0.0) for one in phases) >= 1 - NEGLIGIBLE_SHARE:
            return name
    return ""


MIN_LOG_SPEED_MM_S = 0.05
"""Where the logarithm of the speed ends."""
MIN_VARIATION = 1e-3
"""Terms that vary by less than this part of themselves are constant."""

SYMBOL_UNITS: Mapping[str, str] = {
    "v": "speed v in mm/s",
    "x": "position x in mm",
    "t": "time since the start t in s",
    "T": "session time T in min",
    "n": "run count n",
    "ε": "strain ε",
    "F": "measured force F in mN",
}
"""What the symbols are."""


@dataclass(frozen=True, slots=True, eq=False)
class TermLibrary:
    """Terms at `N` blocks.

    Attributes
    ----------
    names
        Of the `M` terms.
    factors
        Number of factors of each term, shape `(M,)`.
    values
        Shape `(N, M)`.
    residual, weight
        What is to be explained [the part's unit], and what its square counts: all blocks of a run together at most 1
        over the expected mean square. Shape `(N,)`.
    run
        Number of the run, shape `(N,)`.
    """

    names: tuple[str, ...]
    factors: FloatArray
    values: FloatArray
    residual: FloatArray
    weight: FloatArray
    run: IndexArray


def term_library(part: GapRegion) -> TermLibrary:
    """Return all terms that vary, and 1, at the blocks of a part."""
    starts = sorted({(one.session_s, one.run_id) for one in part.blocks})
    order = {name: number for number, (_, name) in enumerate(starts)}
    leave = _excluded_variables(part)
    columns: dict[str, FloatArray] = {}
    for name, of in _variables(order).items():
        if not name.startswith(leave):
            columns[name] = np.concatenate([of(one)[at] for one, at in zip(part.blocks, part.inside, strict=True)])
    simple = {name: one for name, one in columns.items() if name == "1" or _varies(one)}
    bare = [name for name in simple if name != "1" and not name.endswith("²")]
    products = {f"{one}·{other}": simple[one] * simple[other] for one, other in combinations(bare, 2)}
    pairs = {name: one for name, one in products.items() if _varies(one) and name != "v·ln(v)"}
    terms = {**simple, **pairs}
    inside = list(zip(part.blocks, part.inside, strict=True))
    return TermLibrary(
        names=tuple(terms),
        factors=np.array([2.0 if name in pairs or name.endswith("²") else 1.0 for name in terms]),
        values=np.stack(list(terms.values()), axis=1),
        residual=part.scale * np.concatenate([one.residual[at] for one, at in inside]),
        weight=np.concatenate([(one.weight / (part.scale * one.noise_sd) ** 2)[at] for one, at in inside]),
        run=np.concatenate([np.full(np.count_nonzero(at), number) for number, (_, at) in enumerate(inside)]),
    )


def _varies(values: FloatArray) -> bool:
    return bool(np.ptp(values) > MIN_VARIATION * abs(values).max())


def _excluded_variables(part: GapRegion) -> tuple[str, ...]:
    """Return variables that say nothing here: speed and way where walls are sheared, force where it is not known."""
    sheared = all(one.strain > 0 for one in part.blocks)
    unknown = any(one.level_mN is None for one in part.blocks)
    return (*(("v", "ln(v)", "x") if sheared else ()), *(("F",) if unknown else ()))


def _variables(order: Mapping[str, int]) -> Mapping[str, Callable[[ResidualBlocks], FloatArray]]:
    return {
        "1": lambda one: np.ones_like(one.residual),
        "v": block_speed,
        "ln(v)": lambda one: np.log(np.maximum(block_speed(one), MIN_LOG_SPEED_MM_S)),
        "v²": lambda one: block_speed(one) ** 2,
        "ε": lambda one: np.full_like(one.residual, one.strain),
        "ε²": lambda one: np.full_like(one.residual, one.strain**2),
        "x": lambda one: np.abs(one.position_mm),
        "x²": lambda one: one.position_mm**2,
        "t": time_since_start,
        "T": lambda one: (one.session_s + one.time_s) / 60.0,
        "n": lambda one: np.full_like(one.residual, order[one.run_id]),
        "F": lambda one: np.zeros_like(one.residual) if one.level_mN is None else one.level_mN,
    }


def block_speed(one: ResidualBlocks) -> FloatArray:
    """Return the speed [mm/s], as commanded where it is steady, shape `(B,)`."""
    if one.residual.size < 2:
        return np.full_like(one.residual, one.speed_mm_s)
    local = np.abs(np.gradient(one.position_mm, one.time_s))
    changing = (one.phase == Phase.ACCELERATE) | (one.phase == Phase.DECELERATE)
    steady = np.where(one.phase == Phase.STEADY, one.speed_mm_s, 0.0)
    return np.where(changing, np.clip(local, 0.0, one.speed_mm_s), steady)


def time_since_start(one: ResidualBlocks) -> FloatArray:
    """Return the time since the motion began [s], 0 before, shape `(B,)`."""
    begun = one.phase != Phase.REST
    return np.maximum(one.time_s - one.time_s[begun][0], 0.0) if begun.any() else np.zeros_like(one.time_s)


MAX_TERMS, EXHAUSTIVE_SIZE = 4, 3
TERM_RIDGE = 1e-7
"""Keeps terms that are the same in all runs apart; parts of the terms' squares."""

TermIndices = tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class FoldProducts:
    """Weighted products of `M` terms and the residual in `K` folds, terms scaled to one.

    Attributes
    ----------
    gram, moment, square
        Term with term, term with residual, residual with itself; shapes `(K, M, M)`, `(K, M)` and `(K,)`.
    """

    gram: FloatArray
    moment: FloatArray
    square: FloatArray

    def without(self, fold: int) -> "FoldProducts":
        """Leave a fold out."""
        kept = np.arange(self.square.size) != fold
        return FoldProducts(self.gram[kept], self.moment[kept], self.square[kept])

    def predicted(self, terms: TermIndices, fold: int) -> float:
        """Return the squares that are left in a fold by coefficients from the others."""
        return float(held_out_chi2(self, np.array([terms], dtype=np.intp))[0, fold])


def held_out_chi2(products: FoldProducts, subsets: npt.NDArray[np.intp]) -> FloatArray:
    """Return the squares that each of `S` subsets of `k` terms leaves in each fold, shape `(S, k)` to `(S, K)`."""
    if not subsets.shape[1]:
        return np.broadcast_to(products.square, (subsets.shape[0], products.square.size))
    rows, columns = subsets[:, :, None], subsets[:, None, :]
    gram, moment = products.gram[:, rows, columns], products.moment[:, subsets]
    others = gram.sum(axis=0) - gram + TERM_RIDGE * np.eye(subsets.shape[1])
    from_others = np.linalg.solve(others, (moment.sum(axis=0) - moment)[..., None])[..., 0]
    explained = 2 * np.einsum("fsk,fsk->fs", from_others, moment)
    left = products.square[:, None] - explained + np.einsum("fsi,fsij,fsj->fs", from_others, gram, from_others)
    return np.asarray(left.T)


def select_terms(products: FoldProducts, price: FloatArray) -> TermIndices:
    """Return the terms that together leave least in the folds, each at its price in squares, shape `(M,)`.

    All pairs and threes of the cheapest terms are looked at too: two may tell what neither tells alone.
    """
    chosen: TermIndices = ()
    best: tuple[TermIndices, float] = (chosen, float(products.square.sum()))
    cheapest = np.flatnonzero(price == price.min()).tolist()
    for size in range(1, min(MAX_TERMS, price.size) + 1):
        more = [(*chosen, one) for one in range(price.size) if one not in chosen]
        more += combinations(cheapest, size) if size <= EXHAUSTIVE_SIZE else ()
        chosen, cost = _exchange_terms(products, price, *_best_subset(products, price, more))
        best = min(best, (chosen, cost), key=lambda one: one[1])
    chosen, cost = best
    while len(chosen) > 1:
        fewer = [tuple(one for one in chosen if one != left) for left in chosen]
        found, at = _best_subset(products, price, fewer)
        if at >= cost:
            break
        chosen, cost = found, at
    return tuple(sorted(chosen))


def _exchange_terms(
    products: FoldProducts, price: FloatArray, chosen: TermIndices, cost: float
) -> tuple[TermIndices, float]:
    """Put another term in the place of each that came before the last one, if that leaves less."""
    for place in range(len(chosen) - 1):
        kept = (*chosen[:place], *chosen[place + 1 :])
        found, at = _best_subset(products, price, [(*kept, one) for one in range(price.size) if one not in kept])
        if at < cost:
            chosen, cost = found, at
    return chosen, cost


def _best_subset(products: FoldProducts, price: FloatArray, subsets: list[TermIndices]) -> tuple[TermIndices, float]:
    index = np.array(subsets, dtype=np.intp)
    cost = held_out_chi2(products, index).sum(axis=1) + price[index].sum(axis=1)
    at = int(np.argmin(cost))
    return subsets[at], float(cost[at])


LAW_FOLDS, MIN_CONDITIONS = 6, 3
MIN_LAW_SHARE = 0.5
"""Part of the excess that a law must explain in runs that took no part."""
TERM_PENALTY = 0.015
"""Part of the excess that each factor of a term must explain."""
MIN_EXCESS_SIGMAS = 3.0
"""An excess below so many of its standard deviations is not worth a law; a run's mean square has √2 at most."""


@dataclass(frozen=True, slots=True)
class GapLaw:
    """An expression of a gap.

    Attributes
    ----------
    terms, coefficients, sd
        Names of the terms, and their coefficients with standard deviations that hold for runs as wholes.
    unit
        Of the expression.
    held_out
        Part of the whole excess that it explains, terms and coefficients chosen without the runs it is asked of.
    """

    terms: tuple[str, ...]
    coefficients: tuple[float, ...]
    sd: tuple[float, ...]
    unit: str
    held_out: float

    @property
    def text(self) -> str:
        """The expression in words and numbers, coefficients as exact as they are known."""
        said = ""
        for name, value, sd in zip(self.terms, self.coefficients, self.sd, strict=True):
            sign = " − " if value < 0 else " + "
            said += (sign if said else sign.strip().replace("+", "")) + _rounded_to_sd(abs(value), sd)
            said += "" if name == "1" else f"·{name}"
        factors = {
            one.removesuffix("²").removeprefix("ln(").removesuffix(")") for one in "·".join(self.terms).split("·")
        }
        symbols = [one for one in SYMBOL_UNITS if one in factors]
        return f"{said} [{self.unit}]" + "".join(f", {SYMBOL_UNITS[one]}" for one in symbols)


def fit_gap_law(part: GapRegion) -> GapLaw | None:
    """Return a law that explains at least half of a gap in runs that took no part, if there is one.

    Folds are whole conditions (kind, speed and strain), so that a law has to predict those that it has not seen.
    Terms are chosen anew for each fold that it is judged on.
    """
    fold = condition_folds(part.blocks)
    if fold is None:
        return None
    terms = term_library(part)
    by_run, scale = _products_by_run(terms, len(part.blocks))
    inside = sum(float(one.weight[at].sum()) for one, at in zip(part.blocks, part.inside, strict=True))
    excess = max(part.excess, float(by_run.square.sum()) - inside)
    if excess < MIN_EXCESS_SIGMAS * np.sqrt(2 * len(part.blocks)):
        return None
    products = _products_by_fold(by_run, fold)
    price = TERM_PENALTY * excess * terms.factors
    parts = [(select_terms(products.without(one), price), one) for one in range(products.square.size)]
    left = sum(products.predicted(chosen, one) for chosen, one in parts)
    share = (float(products.square.sum()) - left) / excess
    chosen = select_terms(products, price)
    if share < MIN_LAW_SHARE or not chosen:
        return None
    value, sd = _robust_coefficients(by_run, chosen)
    names = tuple(terms.names[one] for one in chosen)
    unscaled = scale[list(chosen)]
    return GapLaw(names, _as_floats(value / unscaled), _as_floats(sd / unscaled), part.unit, min(share, 1.0))


def condition_folds(blocks: Sequence[ResidualBlocks]) -> IndexArray | None:
    """Return the fold of each run, whole conditions together and neighbours apart; None for too few conditions."""
    conditions = [(one.kind, one.speed_mm_s, one.strain) for one in blocks]
    number = {one: at for at, one in enumerate(sorted(set(conditions)))}
    if len(number) < MIN_CONDITIONS:
        return None
    return np.array([number[one] % min(LAW_FOLDS, len(number)) for one in conditions], dtype=np.intp)


def _products_by_run(terms: TermLibrary, runs: int) -> tuple[FoldProducts, FloatArray]:
    """Return the products run by run, and the scale of each term."""
    root = np.sqrt(terms.weight)
    columns = root[:, None] * terms.values
    scale = np.linalg.norm(columns, axis=0)
    columns, residual = columns / scale, root * terms.residual
    bounds = np.searchsorted(terms.run, np.arange(runs + 1))
    slices = [slice(low, high) for low, high in pairwise(bounds.tolist())]
    gram = np.stack([columns[one].T @ columns[one] for one in slices])
    moment = np.stack([columns[one].T @ residual[one] for one in slices])
    return FoldProducts(gram, moment, np.array([residual[one] @ residual[one] for one in slices])), scale


def _products_by_fold(by_run: FoldProducts, fold: IndexArray) -> FoldProducts:
    member = (np.arange(int(fold.max()) + 1)[:, None] == fold).astype(np.float64)
    gram = np.tensordot(member, by_run.gram, axes=1)
    return FoldProducts(gram, member @ by_run.moment, member @ by_run.square)


def _robust_coefficients(by_run: FoldProducts, chosen: TermIndices) -> tuple[FloatArray, FloatArray]:
    """Return scaled coefficients and standard deviations, blocks of one run taken as dependent (sandwich)."""
    index = np.array(chosen)
    gram, moment = by_run.gram[:, index[:, None], index], by_run.moment[:, index]
    inverse = np.linalg.inv(gram.sum(axis=0) + 1e-12 * np.eye(index.size))
    value = inverse @ moment.sum(axis=0)
    slopes = moment - gram @ value
    runs = slopes.shape[0]
    spread = inverse @ (slopes.T @ slopes) @ inverse * runs / max(runs - index.size, 1)
    return value, np.sqrt(np.maximum(np.diag(spread), 0.0))


def _as_floats(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(one) for one in values)


def _rounded_to_sd(value: float, sd: float) -> str:
    """Round to the first digit of the standard deviation, to the second where that is a 1."""
    last = floor(log10(sd)) if sd > 0 else floor(log10(max(value, 1e-12))) - 3
    last -= int(sd / 10**last < 2)
    # An amount that is smaller than its uncertainty still shows its first digit.
    last = min(last, floor(log10(value))) if value > 0 else last
    return f"{round(value, -last):.{max(-last, 0)}f}"
