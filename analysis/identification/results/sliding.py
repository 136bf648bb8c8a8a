"""What sliding runs say: the friction coefficient, and the drag against speed."""

from dataclasses import dataclass

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.identification.results.quantity import Quantity


@dataclass(frozen=True, slots=True)
class CoulombRun:
    """The friction coefficient of one run in the vacuum fixture.

    Attributes
    ----------
    force
        Mean steady force of the filtered trace along the motion, zero taken off [mN]; a backward speed is negative.
    mu
        All of it ascribed to Coulomb friction, as the paper does.
    mu_without_viscous
        With the model's viscous friction taken off first.
    viscous_mN, viscous_share
        That friction, and its share of the force.
    """

    file: str
    speed_mm_s: float
    weight_mN: float
    force: Estimate
    mu: Estimate
    mu_without_viscous: Estimate
    viscous_mN: float
    viscous_share: float | None


@dataclass(frozen=True, slots=True)
class Coulomb:
    """The friction coefficient from all Coulomb runs, weighted; missing with the reason where there is none."""

    runs: tuple[CoulombRun, ...]
    mu: Estimate
    mu_without_viscous: Estimate
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class SpeedPoint:
    """The steady drag at one speed, repeats averaged, beside the model's parts [mN].

    Forces count along the motion, so that friction is positive both ways; a backward speed is negative.
    """

    speed_mm_s: float
    runs: int
    force: Estimate
    f_e_mN: float
    f_v_mN: float
    f_c_mN: float

    @property
    def model_mN(self) -> float:
        """The model's sum."""
        return self.f_e_mN + self.f_v_mN + self.f_c_mN


@dataclass(frozen=True, slots=True)
class LogLaw:
    """Steady drag as intercept + slope · ln(v / 1 mm/s), weighted least squares.

    `lack_of_fit_p` is the chance of at least such deviations by the points' errors alone.
    """

    intercept: Quantity
    slope: Quantity
    correlation: float
    r2: float
    lack_of_fit_p: float | None


@dataclass(frozen=True, slots=True)
class Boundary:
    """The speed above which model and measurement part ways, if the points show one.

    `interval` holds the speeds that the points do not exclude with 95 % confidence; `p_value` is the chance of at least
    such a difference between bands without any boundary.
    """

    speed_mm_s: float | None
    interval: tuple[float, float] | None
    p_value: float | None
    sentence: str


@dataclass(frozen=True, slots=True)
class Determination:
    """R² of the model over a band of speeds, in both of the paper's forms; None for fewer than three speeds.

    `eq15` is the ratio of Eq. 15, which can exceed 1; `correlation` the squared correlation.
    """

    band: str
    speeds: int
    eq15: float | None
    correlation: float | None


@dataclass(frozen=True, slots=True)
class Drag:
    """The steady drag against speed."""

    points: tuple[SpeedPoint, ...]
    log_law: LogLaw | None
    boundary: Boundary | None
    determination: tuple[Determination, ...] = ()
    remarks: tuple[str, ...] = ()
