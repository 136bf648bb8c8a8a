"""How finely the environmental resistance is integrated, and interpolated in time."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from dragrig.rig.arrays import FloatArray, read_only
from dragrig.sim_backend.friction.motion import Motion


@dataclass(frozen=True, slots=True)
class Rule:
    """Nodes per panel.

    Attributes
    ----------
    ages
        Gauss–Legendre nodes of a panel of contact ages.
    times
        Chebyshev nodes of a panel of times.
    """

    ages: int
    times: int


FINE = Rule(10, 8)
COUNTED = Rule(4, 5)
"""For a motion that is known in counts of an encoder, whose many bends divide the panels anyway: a force that ripples
differs by 0.03 mN, root mean square, from that of the fine rule, where a sensor's noise is 1 mN or more."""


def rule_of(motion: Motion) -> Rule:
    """Return the rule that a motion deserves."""
    return COUNTED if motion.counted else FINE


@cache
def gauss_legendre(nodes: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights of the quadrature on (0, 1)."""
    at, weights = np.polynomial.legendre.leggauss(nodes)
    at, weights = 0.5 * (1 + at), 0.5 * weights
    read_only(at)
    read_only(weights)
    return at, weights


@cache
def chebyshev(nodes: int) -> tuple[FloatArray, FloatArray]:
    """Nodes on (0, 1) and the matrix from values there to coefficients of ascending powers."""
    at = 0.5 * (1 - np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes))
    to_powers = np.asarray(np.linalg.inv(np.vander(at, increasing=True)))
    read_only(at)
    read_only(to_powers)
    return at, to_powers
