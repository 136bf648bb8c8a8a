"""An order in which effects that are hardly told apart are neighbours."""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np


def neighbours(names: Sequence[str], sin2: Mapping[frozenset[str], float]) -> tuple[str, ...]:
    """Order names by average linkage of their angles, the leaves turned so that near ones are neighbours."""
    from scipy.cluster.hierarchy import leaves_list, linkage

    if len(names) < 3:
        return tuple(names)
    apart = np.array([np.sqrt(sin2[frozenset(pair)]) for pair in combinations(names, 2)])
    order: list[int] = leaves_list(linkage(apart, "average", optimal_ordering=True)).tolist()
    return tuple(names[one] for one in order)
