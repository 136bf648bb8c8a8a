"""By how much runs on one specimen differ anyway: from run to run, and by the unknown zero of the sensor."""

from collections.abc import Iterable
from math import sqrt

import numpy as np

from dragrig.analysis.comparison.conditions import Condition
from dragrig.config.rig import NoiseSettings, VariationSettings
from dragrig.config.specimen import Fixture

FORCE_FREE_AT_REST = frozenset({"blank", "coulomb", "relaxation"})
"""Kinds of run whose force is nought before the motion, so that the rest shows the sensor's zero."""
STIFFNESS = VariationSettings().run_stiffness
FRICTION = VariationSettings().run_friction
USUAL_ZERO_MN = NoiseSettings().zero_mN
FEWEST_ZEROS = 3


def relative_spread(condition: Condition) -> float:
    """Return the standard deviation of a run's force between repeats, as a share of it.

    2 % of stiffness, 1.5 % of the friction coefficient. A drag has both; 2 % of all of its force is a little more than
    they come to together.
    """
    if condition.signal != "force" or condition.fixture == Fixture.NONE or condition.kind == "blank":
        return 0.0
    return FRICTION if condition.kind == "coulomb" else STIFFNESS


def zero_spread(rests_mN: Iterable[float]) -> float:
    """Return the standard deviation of an unknown zero [mN] from rests that show nothing else; 3 mN for too few."""
    found = np.asarray(list(rests_mN), dtype=np.float64)
    if found.size < FEWEST_ZEROS:
        return USUAL_ZERO_MN
    return sqrt(float(np.mean(found**2)))
