"""Sparse regression by what terms predict of runs that took no part: forward, exchanging, and backward again.

Everything is reckoned from the products of the terms within each fold, so that one candidate costs microseconds.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from dragrig.rig.arrays import FloatArray

MOST_TERMS, LARGEST_ALL = 4, 3
RIDGE = 1e-7
"""Keeps terms that are the same in all runs apart; parts of the terms' squares."""

Terms = tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Products:
    """Weighted products of `M` terms and the residual in `K` folds, terms scaled to one.

    Attributes
    ----------
    gram, moment, square
        Term with term, term with residual, residual with itself; shapes `(K, M, M)`, `(K, M)` and `(K,)`.
    """

    gram: FloatArray
    moment: FloatArray
    square: FloatArray

    def without(self, fold: int) -> "Products":
        """Leave a fold out."""
        kept = np.arange(self.square.size) != fold
        return Products(self.gram[kept], self.moment[kept], self.square[kept])

    def predicted(self, terms: Terms, fold: int) -> float:
        """Return the squares that are left in a fold by coefficients from the others."""
        return float(held_out(self, np.array([terms], dtype=np.intp))[0, fold])


def held_out(products: Products, subsets: npt.NDArray[np.intp]) -> FloatArray:
    """Return the squares that each of `S` subsets of `k` terms leaves in each fold, shape `(S, k)` to `(S, K)`."""
    if not subsets.shape[1]:
        return np.broadcast_to(products.square, (subsets.shape[0], products.square.size))
    rows, columns = subsets[:, :, None], subsets[:, None, :]
    gram, moment = products.gram[:, rows, columns], products.moment[:, subsets]
    others = gram.sum(axis=0) - gram + RIDGE * np.eye(subsets.shape[1])
    from_others = np.linalg.solve(others, (moment.sum(axis=0) - moment)[..., None])[..., 0]
    explained = 2 * np.einsum("fsk,fsk->fs", from_others, moment)
    left = products.square[:, None] - explained + np.einsum("fsi,fsij,fsj->fs", from_others, gram, from_others)
    return np.asarray(left.T)


def choose_terms(products: Products, price: FloatArray) -> Terms:
    """Return the terms that together leave least in the folds, each at its price in squares, shape `(M,)`.

    All pairs and threes of the cheapest terms are looked at too: two may tell what neither tells alone.
    """
    chosen: Terms = ()
    best: tuple[Terms, float] = (chosen, float(products.square.sum()))
    cheapest = np.flatnonzero(price == price.min()).tolist()
    for size in range(1, min(MOST_TERMS, price.size) + 1):
        more = [(*chosen, one) for one in range(price.size) if one not in chosen]
        more += combinations(cheapest, size) if size <= LARGEST_ALL else ()
        chosen, cost = _exchanged(products, price, *_best(products, price, more))
        best = min(best, (chosen, cost), key=lambda one: one[1])
    chosen, cost = best
    while len(chosen) > 1:
        fewer = [tuple(one for one in chosen if one != left) for left in chosen]
        found, at = _best(products, price, fewer)
        if at >= cost:
            break
        chosen, cost = found, at
    return tuple(sorted(chosen))


def _exchanged(products: Products, price: FloatArray, chosen: Terms, cost: float) -> tuple[Terms, float]:
    """Put another term in the place of each that came before the last one, if that leaves less."""
    for place in range(len(chosen) - 1):
        kept = (*chosen[:place], *chosen[place + 1 :])
        found, at = _best(products, price, [(*kept, one) for one in range(price.size) if one not in kept])
        if at < cost:
            chosen, cost = found, at
    return chosen, cost


def _best(products: Products, price: FloatArray, subsets: list[Terms]) -> tuple[Terms, float]:
    index = np.array(subsets, dtype=np.intp)
    cost = held_out(products, index).sum(axis=1) + price[index].sum(axis=1)
    at = int(np.argmin(cost))
    return subsets[at], float(cost[at])
