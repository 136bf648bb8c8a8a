"""Wall and capsule of one run: moduli, geometry, and the pressure of wall of a given age."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import cos, pi, radians, sin

import numpy as np

from dragrig.sim_backend.blind.effects.base import Effect
from dragrig.sim_backend.blind.motion import Floats
from dragrig.sim_backend.blind.programme import WALL_MM
from dragrig.sim_backend.blind.specimen import Rough, Specimen, Variation

RADIUS_MM = 6.45
MASS_G = 50.1
GRAVITY_M_S2 = 9.80665
_QUADRATICS = {
    "E1": (-0.1617, -0.3175, 3.348),
    "E2": (0.1729, -1.078, 2.078),
    "E3": (0.1653, -0.9792, 1.877),
    "eta1": (-0.01386, 0.03667, 0.0442),
    "eta2": (0.0185, -0.2205, 0.6971),
}
"""Equation (14) of the paper: kPa, and kPa s, against strain."""


@dataclass(frozen=True)
class Gut:
    """The gut about the capsule in one run, effects that act in the tissue included."""

    specimen: Specimen
    variation: Variation
    rough: Rough
    effects: Sequence[Effect]
    ageing: float
    """Factor on stiffness from effects that act from run to run."""

    @cached_property
    def angle(self) -> float:
        """Contact angle [rad]."""
        return radians(self.specimen.angle_deg + self.rough.angle_deg)

    @cached_property
    def length_mm(self) -> float:
        """Length of the contact along the axis."""
        return RADIUS_MM * sin(self.angle)

    @cached_property
    def area_mm2(self) -> float:
        """Area of the contact, S."""
        return 2 * pi * RADIUS_MM**2 * sin(self.angle)

    def diameter_mm(self, x: Floats) -> Floats:
        """Return the wall's inner diameter at `x` along the contact."""
        return 2 * np.sqrt(RADIUS_MM**2 - (self.length_mm - x) ** 2)

    def strain(self, x: Floats) -> Floats:
        """Return the circumferential strain at `x`."""
        free = 2 * RADIUS_MM * cos(self.angle)
        return (self.diameter_mm(x) - free) / free

    def moduli(self, strain: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Return E1, E2, E3 [kPa] and the time constants of the two branches [s] at a strain."""
        five = self.specimen.five
        E1, E2, E3, eta1, eta2 = (
            np.polyval(one, strain) * scale for one, scale in zip(_QUADRATICS.values(), five, strict=True)
        )
        scale = self.specimen.stiffness * self.variation.stiffness * self.ageing * self._bend(strain)
        first, second, third = scale.copy(), scale.copy(), scale.copy()
        for effect in self.effects:
            one, two, three = effect.branches(strain)
            first, second, third = first * one, second * two, third * three
        return E1 * first, E2 * second, E3 * third, eta1 / E1, eta2 / E2

    def tail(self, age: Floats, strain: Floats) -> Floats:
        """Return what effects add to the stress at an age and a strain, as a part of E3."""
        if not self.effects:
            return np.zeros_like(age)
        return np.asarray(np.sum([effect.tail(age, strain) for effect in self.effects], axis=0))

    def pressure(self, x: Floats, age: Floats) -> Floats:
        """Return the wall's pressure [kPa] at `x`, first touched `age` seconds ago."""
        strain = self.strain(x)
        E1, E2, E3, tau1, tau2 = self.moduli(strain)
        stress = E1 * np.exp(-age / tau1) + E2 * np.exp(-age / tau2) + E3 * (1 + self.tail(age, strain))
        return 2 * WALL_MM * strain * stress / self.diameter_mm(x)

    def _bend(self, strain: Floats) -> Floats:
        if not self.rough.shape:
            return np.ones_like(strain)
        bent = {"linear": strain - 1, "arched": 2 * (strain - 1) ** 2 - 1, "wave": np.sin(np.pi * (strain - 0.5))}
        return np.asarray(1 + self.rough.shape * bent[self.rough.shape_form])
