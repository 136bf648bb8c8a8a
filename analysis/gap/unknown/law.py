"""A law of a gap: few terms that predict runs that took no part."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import floor, log10

import numpy as np

from dragrig.analysis.gap.unknown.part import Part
from dragrig.analysis.gap.unknown.selecting import Products, Terms, choose_terms
from dragrig.analysis.gap.unknown.terms import UNITS, Library, library
from dragrig.analysis.gap.where.axes import IndexArray
from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.rig.arrays import FloatArray

FOLDS, FEWEST_CONDITIONS = 6, 3
LEAST_SHARE = 0.5
"""Part of the excess that a law must explain in runs that took no part."""
PRICE = 0.015
"""Part of the excess that each factor of a term must explain."""
SIGMAS = 3.0
"""An excess below so many of its standard deviations is not worth a law; a run's mean square has √2 at most."""


@dataclass(frozen=True, slots=True)
class Law:
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
            said += (sign if said else sign.strip().replace("+", "")) + _rounded(abs(value), sd)
            said += "" if name == "1" else f"·{name}"
        factors = {
            one.removesuffix("²").removeprefix("ln(").removesuffix(")") for one in "·".join(self.terms).split("·")
        }
        symbols = [one for one in UNITS if one in factors]
        return f"{said} [{self.unit}]" + "".join(f", {UNITS[one]}" for one in symbols)


def find_law(part: Part) -> Law | None:
    """Return a law that explains at least half of a gap in runs that took no part, if there is one.

    Folds are whole conditions (kind, speed and strain), so that a law has to predict those that it has not seen.
    Terms are chosen anew for each fold that it is judged on.
    """
    fold = folds(part.blocks)
    if fold is None:
        return None
    terms = library(part)
    by_run, scale = _products(terms, len(part.blocks))
    inside = sum(float(one.weight[at].sum()) for one, at in zip(part.blocks, part.inside, strict=True))
    excess = max(part.excess, float(by_run.square.sum()) - inside)
    if excess < SIGMAS * np.sqrt(2 * len(part.blocks)):
        return None
    products = _joined(by_run, fold)
    price = PRICE * excess * terms.factors
    parts = [(choose_terms(products.without(one), price), one) for one in range(products.square.size)]
    left = sum(products.predicted(chosen, one) for chosen, one in parts)
    share = (float(products.square.sum()) - left) / excess
    chosen = choose_terms(products, price)
    if share < LEAST_SHARE or not chosen:
        return None
    value, sd = _coefficients(by_run, chosen)
    names = tuple(terms.names[one] for one in chosen)
    unscaled = scale[list(chosen)]
    return Law(names, _plain(value / unscaled), _plain(sd / unscaled), part.unit, min(share, 1.0))


def folds(blocks: Sequence[ResidualBlocks]) -> IndexArray | None:
    """Return the fold of each run, whole conditions together and neighbours apart; None for too few conditions."""
    conditions = [(one.kind, one.speed_mm_s, one.strain) for one in blocks]
    number = {one: at for at, one in enumerate(sorted(set(conditions)))}
    if len(number) < FEWEST_CONDITIONS:
        return None
    return np.array([number[one] % min(FOLDS, len(number)) for one in conditions], dtype=np.intp)


def _products(terms: Library, runs: int) -> tuple[Products, FloatArray]:
    """Return the products run by run, and the scale of each term."""
    root = np.sqrt(terms.weight)
    columns = root[:, None] * terms.values
    scale = np.linalg.norm(columns, axis=0)
    columns, residual = columns / scale, root * terms.residual
    bounds = np.searchsorted(terms.run, np.arange(runs + 1))
    slices = [slice(low, high) for low, high in pairwise(bounds.tolist())]
    gram = np.stack([columns[one].T @ columns[one] for one in slices])
    moment = np.stack([columns[one].T @ residual[one] for one in slices])
    return Products(gram, moment, np.array([residual[one] @ residual[one] for one in slices])), scale


def _joined(by_run: Products, fold: IndexArray) -> Products:
    member = (np.arange(int(fold.max()) + 1)[:, None] == fold).astype(np.float64)
    gram = np.tensordot(member, by_run.gram, axes=1)
    return Products(gram, member @ by_run.moment, member @ by_run.square)


def _coefficients(by_run: Products, chosen: Terms) -> tuple[FloatArray, FloatArray]:
    """Return scaled coefficients and standard deviations, blocks of one run taken as dependent (sandwich)."""
    index = np.array(chosen)
    gram, moment = by_run.gram[:, index[:, None], index], by_run.moment[:, index]
    inverse = np.linalg.inv(gram.sum(axis=0) + 1e-12 * np.eye(index.size))
    value = inverse @ moment.sum(axis=0)
    slopes = moment - gram @ value
    runs = slopes.shape[0]
    spread = inverse @ (slopes.T @ slopes) @ inverse * runs / max(runs - index.size, 1)
    return value, np.sqrt(np.maximum(np.diag(spread), 0.0))


def _plain(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(one) for one in values)


def _rounded(value: float, sd: float) -> str:
    """Round to the first digit of the standard deviation, to the second where that is a 1."""
    last = floor(log10(sd)) if sd > 0 else floor(log10(max(value, 1e-12))) - 3
    last -= int(sd / 10**last < 2)
    # An amount that is smaller than its uncertainty still shows its first digit.
    last = min(last, floor(log10(value))) if value > 0 else last
    return f"{round(value, -last):.{max(-last, 0)}f}"
