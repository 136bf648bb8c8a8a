"""Contact of capsule and wall: geometry, and the pressure of a wall of known contact age.

Units: mm, s, kPa, mN; kPa · mm² = mN. The contact coordinate x runs from 0, where the undisturbed gut first meets the
hemisphere, to L at its equator.
"""

from dataclasses import dataclass

import numpy as np

from dragrig.config.errors import SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Capsule
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.wall import WallParameters, model_wall


@dataclass(frozen=True, slots=True)
class SidePressure:
    """P(L) S [mN] of a wall in contact for a time t: `spring + fast·exp(−fast_rate·t) + slow·exp(−slow_rate·t)`."""

    spring: float
    fast: float
    fast_rate: float
    slow: float
    slow_rate: float

    def force(self, age_s: FloatArray) -> FloatArray:
        """Evaluate at contact ages."""
        return np.asarray(
            self.spring + self.fast * np.exp(-self.fast_rate * age_s) + self.slow * np.exp(-self.slow_rate * age_s)
        )


@dataclass(frozen=True, slots=True)
class HemisphereContact:
    """Contact of the wall with the hemisphere that leads.

    Attributes
    ----------
    radius_mm
        Radius R of the hemisphere.
    angle_rad
        Contact angle α, the model's offset included.
    wall_thickness_mm
        Mean wall thickness λ_m.
    model
        Parameter set and scales of the wall.
    """

    radius_mm: float
    angle_rad: float
    wall_thickness_mm: float
    model: FrictionModelSettings

    @classmethod
    def of(cls, capsule: Capsule, wall_thickness_mm: float, model: FrictionModelSettings) -> "HemisphereContact":
        """Build from settings; SettingsError where the wall's parameters are not positive at its strain."""
        angle = capsule.contact_angle_deg + model.contact_angle_offset_deg
        if not 0 < angle < 90:
            raise SettingsError(
                f"contact_angle_deg of capsule {capsule.name!r} plus contact_angle_offset_deg of model {model.name!r} "
                f"is {angle:g}°; it must lie between 0° and 90°"
            )
        contact = cls(0.5 * capsule.diameter_mm, float(np.radians(angle)), wall_thickness_mm, model)
        strain = np.linspace(0.0, contact.strain_at_equator, 64)
        if not model_wall(model, strain).positive:
            raise SettingsError(
                f"A contact angle of {angle:g}° (capsule {capsule.name!r}, model {model.name!r}) strains the wall by "
                f"{contact.strain_at_equator:.0%}, where parameters of wall {model.wall} are not positive; "
                + ("correct its wall_polynomials" if model.wall == "polynomial" else "use a smaller angle")
            )
        return contact

    @property
    def length_mm(self) -> float:
        """Axial length of the contact, L = R sin α."""
        return float(self.radius_mm * np.sin(self.angle_rad))

    @property
    def area_mm2(self) -> float:
        """Contact surface S = 2 π R² sin α (Eq. 8)."""
        return 2 * np.pi * self.radius_mm * self.length_mm

    @property
    def strain_at_equator(self) -> float:
        """Largest hoop strain, ε(L) (Eq. 6)."""
        return float(1 / np.cos(self.angle_rad) - 1)

    @property
    def fastest_rate(self) -> float:
        """Largest relaxation rate on the contact [1/s]."""
        rates = self._parameters(np.linspace(0.0, self.strain_at_equator, 64)).rates
        return float(max(rates[0].max(), rates[1].max()))

    def pressure(self, x_mm: FloatArray, age_s: FloatArray) -> FloatArray:
        """Return the contact pressure P [kPa] for 0 ≤ x ≤ L at a contact age (Eqs. 3 and 7)."""
        return self._hoop_stress_per_radius(x_mm, age_s) * self.wall_thickness_mm

    def axial_load(self, x_mm: FloatArray, age_s: FloatArray) -> FloatArray:
        """Return the axial force per length [mN/mm], P sin θ · 2 π R, whose integral over x is f_e (Eq. 9)."""
        slope = (2 * np.pi * self.wall_thickness_mm) * (self.length_mm - x_mm)
        return self._hoop_stress_per_radius(x_mm, age_s) * slope

    def side_pressure(self) -> SidePressure:
        """Return P(L) S as a function of contact age, the radial force of Eq. 13 at θ = 0."""
        strain = self.strain_at_equator
        wall = self._parameters(np.asarray(strain))
        per_stress = strain * self.wall_thickness_mm / self.radius_mm * self.area_mm2
        fast_rate, slow_rate = wall.rates
        return SidePressure(
            spring=float(wall.E3) * per_stress,
            fast=float(wall.E1) * per_stress,
            fast_rate=float(fast_rate),
            slow=float(wall.E2) * per_stress,
            slow_rate=float(slow_rate),
        )

    def axial_load_log_derivatives(self, x_mm: FloatArray, age_s: FloatArray) -> FloatArray:
        """Return derivatives of the axial load by the logarithms of E1, E2, E3, η1 and η2, along a first axis of 5."""
        wall, per_stress = self._wall_at(x_mm)
        slope = per_stress * (2 * np.pi * self.wall_thickness_mm) * (self.length_mm - x_mm)
        return stress_log_derivatives(wall, age_s) * slope

    def side_pressure_log_derivatives(self, age_s: FloatArray) -> FloatArray:
        """Return derivatives of P(L) S by the logarithms of the elements, shape `(5, n)`."""
        strain = self.strain_at_equator
        per_stress = strain * self.wall_thickness_mm / self.radius_mm * self.area_mm2
        return stress_log_derivatives(self._parameters(np.asarray(strain)), age_s) * per_stress

    def _hoop_stress_per_radius(self, x_mm: FloatArray, age_s: FloatArray) -> FloatArray:
        wall, per_stress = self._wall_at(x_mm)
        fast_rate, slow_rate = wall.rates
        stress = wall.E1 * np.exp(-age_s * fast_rate) + wall.E2 * np.exp(-age_s * slow_rate) + wall.E3
        return np.asarray(per_stress * stress)

    def _wall_at(self, x_mm: FloatArray) -> tuple[WallParameters, FloatArray]:
        """Return the wall's parameters, and strain over local radius."""
        local_radius = np.sqrt(self.radius_mm**2 - (self.length_mm - x_mm) ** 2)
        strain = local_radius * (1 / (self.radius_mm * np.cos(self.angle_rad))) - 1
        return self._parameters(strain), np.asarray(strain / local_radius)

    def _parameters(self, strain: FloatArray) -> WallParameters:
        return model_wall(self.model, strain)


def stress_log_derivatives(wall: WallParameters, age_s: FloatArray) -> FloatArray:
    """Return the derivatives of a relaxing stress per strain by the logarithms of E1, E2, E3, η1 and η2."""
    fast_age, slow_age = (age_s * rate for rate in wall.rates)
    fast, slow = wall.E1 * np.exp(-fast_age), wall.E2 * np.exp(-slow_age)
    spring = np.broadcast_to(wall.E3, fast.shape)
    by_fast, by_slow = fast * fast_age, slow * slow_age
    return np.stack((fast - by_fast, slow - by_slow, spring, by_fast, by_slow))
