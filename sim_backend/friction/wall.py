"""The five-element wall: its published parameters, and its Maxwell branches integrated exactly through a motion.

Parameter sets are Eq. 14, Table 1, or polynomials of the model. A branch is linear in its modulus, so it is evaluated
for a modulus of 1: multiply by E.
"""

from dataclasses import astuple, dataclass, fields
from functools import cache
from typing import Literal, TypeVar

import numpy as np
import numpy.typing as npt

from dragrig.config.errors import SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray, read_only
from dragrig.sim_backend.friction.motion import Pieces

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
        common = model.stiffness_scale
        return WallParameters(
            self.E1 * (common * model.e1_scale),
            self.E2 * (common * model.e2_scale),
            self.E3 * (common * model.e3_scale),
            self.eta1 * (common * model.eta1_scale),
            self.eta2 * (common * model.eta2_scale),
        )


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
    """Branches of unit modulus, sheared by pieces of constant acceleration, unstressed at first.

    Attributes
    ----------
    rates
        Relaxation rates E/η [1/s], shape `(B,)`.
    pieces
        The motion, `K` pieces.
    thickness_mm
        Thickness of the wall that is sheared.
    begin
        Stress over modulus of each branch at the begin of each piece, shape `(B, K)`.
    """

    rates: FloatArray
    pieces: Pieces
    thickness_mm: float
    begin: FloatArray

    @classmethod
    def integrate(cls, rates: FloatArray, pieces: Pieces, thickness_mm: float) -> "MaxwellBranches":
        """Integrate dσ/dt = dε/dt − rate · σ through all pieces."""
        duration = np.diff(pieces.start_s)
        rate = rates[:, None]
        driven = (
            _driven_stress(rate, duration, pieces.velocity_mm_s[:-1], pieces.acceleration_mm_s2[:-1]) / thickness_mm
        )
        begin = np.zeros((rates.size, pieces.start_s.size))
        begin[:, 1:] = linear_recursion(np.exp(-rate * duration), driven)
        return cls(rates, pieces, thickness_mm, begin)

    def stress(self, time_s: FloatArray) -> FloatArray:
        """Return stress over modulus at times not before the first piece; shape `(B, *time_s.shape)`."""
        flat = time_s.ravel()
        index, elapsed = locate_pieces(self.pieces, flat)
        rate = self.rates[:, None]
        relaxed = self.begin[:, index] * np.exp(-rate * elapsed)
        velocity, acceleration = self.pieces.velocity_mm_s[index], self.pieces.acceleration_mm_s2[index]
        stress = relaxed + _driven_stress(rate, elapsed, velocity, acceleration) / self.thickness_mm
        return np.asarray(stress.reshape(self.rates.size, *time_s.shape))


def shear_strain(pieces: Pieces, thickness_mm: float, time_s: FloatArray) -> FloatArray:
    """Return the shear strain since the first piece at times not before it, of the shape of `time_s`."""
    index, elapsed = locate_pieces(pieces, time_s)
    velocity, acceleration = pieces.velocity_mm_s[index], pieces.acceleration_mm_s2[index]
    return np.asarray((pieces.position_mm[index] + (velocity + 0.5 * acceleration * elapsed) * elapsed) / thickness_mm)


def locate_pieces(pieces: Pieces, time_s: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Return the piece that each time lies in, and the time since that piece began."""
    index = np.maximum(np.searchsorted(pieces.start_s, time_s, side="right") - 1, 0)
    return index, np.asarray(time_s - pieces.start_s[index])


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
