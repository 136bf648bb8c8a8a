"""The five-element wall: published parameters, Maxwell branches, and its contact with the capsule.

Parameter sets are Eq. 14, Table 1, or polynomials of the model. A branch is linear in its modulus, so it is evaluated
for a modulus of 1: multiply by E.

Units: mm, s, kPa, mN; kPa · mm² = mN. The contact coordinate x runs from 0, where the undisturbed gut first meets the
hemisphere, to L at its equator.
"""

from dataclasses import astuple, dataclass, fields
from functools import cache
from typing import Literal, TypeVar

import numpy as np
import numpy.typing as npt

from dragrig.config import Capsule, FrictionModelSettings, SettingsError
from dragrig.rig import FloatArray, read_only
from dragrig.sim_backend.friction.motion import ProfileMotion

WallKind = Literal["eq14", "table1"]
"""Published parameter sets."""

TABLE1_STRAIN = (0.5, 1.0, 1.5, 2.0)
"""Shear strains of Table 1."""

TABLE1 = (
    (2.926, 3.159, 2.781, 1.726),
    (1.539, 1.216, 0.948, 0.484),
    (1.422, 1.064, 0.812, 0.541),
    (0.053, 0.078, 0.067, 0.060),
    (0.561, 0.555, 0.393, 0.320),
)
"""Table 1: E1, E2, E3 [kPa], η1, η2 [kPa·s] at the strains of `TABLE1_STRAIN`."""

EQ14 = (
    (-0.1617, -0.3175, 3.348),
    (0.1729, -1.078, 2.078),
    (0.1653, -0.9792, 1.877),
    (-0.01386, 0.03667, 0.0442),
    (0.0185, -0.2205, 0.6971),
)
"""Eq. 14: coefficients of ε², ε and 1 for E1, E2, E3, η1, η2."""


@dataclass(frozen=True, slots=True, eq=False)
class WallParameters:
    """Springs E1, E2, E3 [kPa] and dampers η1, η2 [kPa·s], each of the shape of the strain."""

    E1: FloatArray
    E2: FloatArray
    E3: FloatArray
    eta1: FloatArray
    eta2: FloatArray

    @property
    def positive(self) -> bool:
        """Whether E1, E2, η1 and η2 are above 0 and E3 is not below 0, as for any physical wall."""
        above = min(float(np.min(element)) for element in (self.E1, self.E2, self.eta1, self.eta2))
        return above > 0 and float(np.min(self.E3)) >= 0

    @property
    def rates(self) -> tuple[FloatArray, FloatArray]:
        """Relaxation rates E1/η1 and E2/η2 [1/s]."""
        return self.E1 / self.eta1, self.E2 / self.eta2

    def scaled(self, model: FrictionModelSettings) -> "WallParameters":
        """Return the parameters of a specimen whose scales are those of `model`."""
        elements = (self.E1, self.E2, self.E3, self.eta1, self.eta2)
        scales = (model.e1_scale, model.e2_scale, model.e3_scale, model.eta1_scale, model.eta2_scale)
        common = model.stiffness_scale
        return WallParameters(*(element * (common * scale) for element, scale in zip(elements, scales, strict=True)))


@dataclass(frozen=True, slots=True)
class ParameterSetDifference:
    """One entry of Table 1 beside the values of Eq. 14 and of the quadratic through Table 1.

    `parameter` is E1, E2, E3 (kPa), eta1 or eta2 (kPa·s); differences are relative to Table 1.
    """

    strain: float
    parameter: str
    table1: float
    eq14: float
    eq14_difference: float
    quadratic: float
    quadratic_difference: float


def wall_parameters(kind: WallKind, strain: npt.ArrayLike) -> WallParameters:
    """Return the published wall parameters at any strain, 1 being 100 %.

    `eq14` evaluates Eq. 14; `table1` the least-squares quadratic through the four strains of Table 1.
    """
    eps = np.asarray(strain, dtype=float)
    coefficients = np.array(EQ14) if kind == "eq14" else _table1_coefficients()
    return WallParameters(*((a * eps + b) * eps + c for a, b, c in coefficients))


def model_wall(model: FrictionModelSettings, strain: npt.ArrayLike) -> WallParameters:
    """Return the wall parameters of a model at any strain, its polynomials and its scales included."""
    if model.wall != "polynomial":
        return wall_parameters(model.wall, strain).scaled(model)
    if model.wall_polynomials is None:
        raise SettingsError(f"Model {model.name!r} has wall = polynomial but no wall_polynomials; add them")
    eps = np.asarray(strain, dtype=float)
    laws = model.wall_polynomials
    rows = (laws.E1, laws.E2, laws.E3, laws.eta1, laws.eta2)
    return WallParameters(*(np.asarray(np.polyval(row, eps)) for row in rows)).scaled(model)


def parameter_set_differences() -> tuple[ParameterSetDifference, ...]:
    """Compare Eq. 14 and the quadratic through Table 1 with each of its 20 entries."""
    polynomial = astuple(wall_parameters("eq14", TABLE1_STRAIN))
    quadratic = astuple(wall_parameters("table1", TABLE1_STRAIN))
    differences = []
    for column, strain in enumerate(TABLE1_STRAIN):
        for row, field in enumerate(fields(WallParameters)):
            entry, eq14, fitted = TABLE1[row][column], float(polynomial[row][column]), float(quadratic[row][column])
            relative = eq14 / entry - 1, fitted / entry - 1
            differences.append(
                ParameterSetDifference(strain, field.name, entry, eq14, relative[0], fitted, relative[1])
            )
    return tuple(differences)


@cache
def _table1_coefficients() -> FloatArray:
    coefficients = np.polyfit(TABLE1_STRAIN, np.transpose(TABLE1), 2).T
    read_only(coefficients)
    return np.asarray(coefficients)


InexactArray = TypeVar("InexactArray", npt.NDArray[np.float64], npt.NDArray[np.complex128])


@dataclass(frozen=True, slots=True, eq=False)
class MaxwellBranches:
    """Branches of unit modulus, sheared by pieces of constant acceleration, unstressed at first."""

    rates: FloatArray
    """Relaxation rates E/η [1/s], shape `(B,)`."""
    pieces: ProfileMotion
    """The motion, `K` pieces."""
    thickness_mm: float
    """Thickness of the wall that is sheared."""
    begin: FloatArray
    """Stress over modulus of each branch at the begin of each piece, shape `(B, K)`."""

    @classmethod
    def integrate(cls, rates: FloatArray, pieces: ProfileMotion, thickness_mm: float) -> "MaxwellBranches":
        """Integrate dσ/dt = dε/dt − rate · σ through all pieces."""
        duration = np.diff(pieces.start_s)
        rate = rates[:, None]
        driven = (
            _driven_stress(rate, duration, pieces.velocity_mm_s[:-1], pieces.acceleration_mm_s2[:-1]) / thickness_mm
        )
        begin = np.zeros((rates.size, pieces.start_s.size))
        begin[:, 1:] = linear_recursion(np.exp(-rate * duration), driven)
        return cls(rates, pieces, thickness_mm, begin)

    def strain(self, time_s: FloatArray) -> FloatArray:
        """Return the shear strain since the first piece at times not before it, of the shape of `time_s`."""
        return self.pieces.position(time_s) / self.thickness_mm

    def stress(self, time_s: FloatArray) -> FloatArray:
        """Return stress over modulus at times not before the first piece; shape `(B, *time_s.shape)`."""
        flat = time_s.ravel()
        index, elapsed = self.pieces.locate(flat)
        rate = self.rates[:, None]
        relaxed = self.begin[:, index] * np.exp(-rate * elapsed)
        velocity, acceleration = self.pieces.velocity_mm_s[index], self.pieces.acceleration_mm_s2[index]
        stress = relaxed + _driven_stress(rate, elapsed, velocity, acceleration) / self.thickness_mm
        return np.asarray(stress.reshape(self.rates.size, *time_s.shape))


def linear_recursion(factor: InexactArray, addend: InexactArray) -> InexactArray:
    """Return y with y[0] = addend[0] and y[i] = factor[i] · y[i − 1] + addend[i] along the last axis, by doubling."""
    factor, total = factor.copy(), addend.copy()
    shift = 1
    while shift < total.shape[-1]:
        total[..., shift:] = total[..., shift:] + factor[..., shift:] * total[..., :-shift]
        factor[..., shift:] = factor[..., shift:] * factor[..., :-shift]
        shift *= 2
    return total


def _driven_stress(
    rate: FloatArray, elapsed_s: FloatArray, velocity: FloatArray, acceleration: FloatArray
) -> FloatArray:
    """Return stress over modulus times wall thickness of an initially unstressed branch at constant acceleration."""
    lag = -np.expm1(-rate * elapsed_s) / rate
    return np.asarray(velocity * lag + acceleration * (elapsed_s - lag) / rate)


@dataclass(frozen=True, slots=True, eq=False)
class RelaxingLoad:
    """Load of a wall in contact for a time t: `spring + fast·exp(−fast_rate·t) + slow·exp(−slow_rate·t)`.

    Loads in mN, or mN/mm along the contact; rates in 1/s.
    """

    fast: FloatArray
    fast_rate: FloatArray
    slow: FloatArray
    slow_rate: FloatArray
    spring: FloatArray

    @classmethod
    def of(cls, wall: WallParameters, per_stress: FloatArray | float) -> "RelaxingLoad":
        """Return the load of a wall strained at once, `per_stress` being load over modulus."""
        fast_rate, slow_rate = wall.rates
        return cls(wall.E1 * per_stress, fast_rate, wall.E2 * per_stress, slow_rate, wall.E3 * per_stress)

    def force(self, age_s: FloatArray) -> FloatArray:
        """Evaluate at contact ages."""
        return np.asarray(
            self.spring + self.fast * np.exp(-self.fast_rate * age_s) + self.slow * np.exp(-self.slow_rate * age_s)
        )


@dataclass(frozen=True, slots=True)
class HemisphereContact:
    """Contact of the wall with the hemisphere that leads."""

    radius_mm: float
    """Radius R of the hemisphere."""
    angle_rad: float
    """Contact angle α, the model's offset included."""
    wall_thickness_mm: float
    """Mean wall thickness λ_m."""
    model: FrictionModelSettings
    """Parameter set and scales of the wall."""

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

    @property
    def side_force_per_stress(self) -> float:
        """P(L) S over the hoop stress at the equator [mN/kPa] (Eqs. 7 and 13)."""
        return self.wall_thickness_mm / self.radius_mm * self.area_mm2

    def local_radius(self, x_mm: FloatArray) -> FloatArray:
        """Return the radius of the hemisphere at contact coordinates."""
        return np.asarray(np.sqrt(self.radius_mm**2 - (self.length_mm - x_mm) ** 2))

    def strain(self, x_mm: FloatArray) -> FloatArray:
        """Return the hoop strain at contact coordinates (Eq. 6)."""
        return np.asarray(self.local_radius(x_mm) / (self.radius_mm * np.cos(self.angle_rad)) - 1)

    def pressure(self, x_mm: FloatArray, age_s: FloatArray) -> FloatArray:
        """Return the contact pressure P [kPa] for 0 ≤ x ≤ L at a contact age (Eqs. 3 and 7)."""
        return self._hoop_stress_per_radius(x_mm, age_s) * self.wall_thickness_mm

    def axial_load(self, x_mm: FloatArray, age_s: FloatArray) -> FloatArray:
        """Return the axial force per length [mN/mm], P sin θ · 2 π R, whose integral over x is f_e (Eq. 9)."""
        slope = (2 * np.pi * self.wall_thickness_mm) * (self.length_mm - x_mm)
        return self._hoop_stress_per_radius(x_mm, age_s) * slope

    def axial_branches(self, x_mm: FloatArray) -> RelaxingLoad:
        """Return the axial load [mN/mm] as a function of contact age; `axial_load` is its value."""
        wall, per_stress = self._wall_at(x_mm)
        return RelaxingLoad.of(wall, per_stress * (2 * np.pi * self.wall_thickness_mm) * (self.length_mm - x_mm))

    def side_pressure(self) -> RelaxingLoad:
        """Return P(L) S [mN] as a function of contact age, the radial force of Eq. 13 at θ = 0."""
        strain = self.strain_at_equator
        return RelaxingLoad.of(self._parameters(np.asarray(strain)), strain * self.side_force_per_stress)

    def axial_load_log_derivatives(self, x_mm: FloatArray, age_s: FloatArray) -> FloatArray:
        """Return derivatives of the axial load by the logarithms of E1, E2, E3, η1 and η2, along a first axis of 5."""
        wall, per_stress = self._wall_at(x_mm)
        slope = per_stress * (2 * np.pi * self.wall_thickness_mm) * (self.length_mm - x_mm)
        return stress_log_derivatives(wall, age_s) * slope

    def side_pressure_log_derivatives(self, age_s: FloatArray) -> FloatArray:
        """Return derivatives of P(L) S by the logarithms of the elements, shape `(5, n)`."""
        strain = self.strain_at_equator
        per_strain = stress_log_derivatives(self._parameters(np.asarray(strain)), age_s)
        return per_strain * (strain * self.side_force_per_stress)

    def _hoop_stress_per_radius(self, x_mm: FloatArray, age_s: FloatArray) -> FloatArray:
        wall, per_stress = self._wall_at(x_mm)
        fast_rate, slow_rate = wall.rates
        stress = wall.E1 * np.exp(-age_s * fast_rate) + wall.E2 * np.exp(-age_s * slow_rate) + wall.E3
        return np.asarray(per_stress * stress)

    def _wall_at(self, x_mm: FloatArray) -> tuple[WallParameters, FloatArray]:
        """Return the wall's parameters, and strain over local radius."""
        local_radius = self.local_radius(x_mm)
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
