"""Parameters of the five-element wall: Eq. 14, Table 1, and where the two disagree."""

from collections.abc import Iterator
from dataclasses import astuple, dataclass, fields
from functools import cache
from typing import Literal

import numpy as np
import numpy.typing as npt

from dragrig.config.errors import SettingsError
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray, read_only

WallKind = Literal["eq14", "table1"]
"""Which published parameter set applies."""

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
    """Springs E1, E2, E3 [kPa] and dampers η1, η2 [kPa·s], each of the shape of the strain they are for."""

    E1: FloatArray
    E2: FloatArray
    E3: FloatArray
    eta1: FloatArray
    eta2: FloatArray

    @property
    def positive(self) -> bool:
        """Whether E1, E2, η1 and η2 are all above 0 and E3 is not below, as a wall must have it."""
        above = min(float(np.min(one)) for one in (self.E1, self.E2, self.eta1, self.eta2))
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
class Disagreement:
    """One entry of Table 1 beside what Eq. 14 and the quadratic through Table 1 say of it.

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
    return WallParameters(*((a * eps + b) * eps + c for a, b, c in _coefficients(kind)))


def model_wall(model: FrictionModelSettings, strain: npt.ArrayLike) -> WallParameters:
    """Return the wall parameters of a model at any strain, its polynomials and its scales included."""
    if model.wall != "polynomial":
        return wall_parameters(model.wall, strain).scaled(model)
    if model.wall_polynomials is None:
        raise SettingsError(f"Model {model.name!r} has wall polynomial but no wall_polynomials; give it some")
    eps = np.asarray(strain, dtype=float)
    laws = model.wall_polynomials
    rows = (laws.E1, laws.E2, laws.E3, laws.eta1, laws.eta2)
    return WallParameters(*(np.asarray(np.polyval(row, eps)) for row in rows)).scaled(model)


def disagreement() -> tuple[Disagreement, ...]:
    """Compare Eq. 14 and the quadratic through Table 1 with each of its 20 entries."""
    return tuple(_disagreements())


def _disagreements() -> Iterator[Disagreement]:
    polynomial = astuple(wall_parameters("eq14", TABLE1_STRAIN))
    quadratic = astuple(wall_parameters("table1", TABLE1_STRAIN))
    names = [field.name for field in fields(WallParameters)]
    for column, strain in enumerate(TABLE1_STRAIN):
        for row, name in enumerate(names):
            entry, eq14, fitted = TABLE1[row][column], float(polynomial[row][column]), float(quadratic[row][column])
            yield Disagreement(strain, name, entry, eq14, eq14 / entry - 1, fitted, fitted / entry - 1)


def _coefficients(kind: WallKind) -> FloatArray:
    return np.array(EQ14) if kind == "eq14" else _table1_coefficients()


@cache
def _table1_coefficients() -> FloatArray:
    coefficients = np.polyfit(TABLE1_STRAIN, np.transpose(TABLE1), 2).T
    read_only(coefficients)
    return np.asarray(coefficients)
