"""What an identification says, as values; every number stands with its uncertainty or is missing with the reason."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from dragrig.analysis.estimates import Estimate
from dragrig.rig.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class Quantity:
    """An identified number; `interval` holds the true one with 95 % confidence."""

    name: str
    unit: str
    value: float
    standard_error: float
    interval: tuple[float, float]

    @property
    def half_width(self) -> float:
        """Half of the interval, relative to the value."""
        low, high = self.interval
        return 0.5 * (high - low) / abs(self.value) if self.value else float("inf")


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A run, or a part of the result, that is not used, and why."""

    what: str
    reason: str


@dataclass(frozen=True, slots=True)
class ElementsTest:
    """Whether five elements suffice: what a third Maxwell branch would explain besides.

    Attributes
    ----------
    suffices
        None where the run cannot tell.
    p_value
        Chance of at least such an improvement by noise alone.
    third_time_s, third_force_mN
        Time constant of the branch that explains most, and its force when the hold begins.
    sentence
        The same in words.
    """

    suffices: bool | None
    p_value: float | None
    third_time_s: float | None
    third_force_mN: float | None
    sentence: str


@dataclass(frozen=True, slots=True, eq=False)
class RelaxationFit:
    """The five elements of one relaxation run.

    Attributes
    ----------
    file, shear_strain
        Which run, and the strain it went to.
    elements
        E1, E2, E3 [kPa], eta1, eta2 [kPa·s], in this order; empty where the run supports none, with the reason
        in `remark`.
    times
        Time constants η1/E1 and η2/E2 [s].
    correlation
        Between the elements, shape `(5, 5)`.
    zero
        The sensor's zero [mN].
    chi2, degrees
        Squared whitened residuals and their degrees of freedom.
    """

    file: str
    shear_strain: float
    elements: tuple[Quantity, ...] = ()
    times: tuple[Quantity, ...] = ()
    correlation: FloatArray | None = None
    zero: Estimate = field(default_factory=Estimate)
    chi2: float | None = None
    degrees: int = 0
    test: ElementsTest | None = None
    converged: bool = False
    remark: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class StrainLaw:
    """One element against shear strain, by least squares as in Eq. 14.

    `coefficients` belong to the highest power first, with `covariance` between them; `r2` is the share of the
    scatter over strains that the polynomial explains, None where it runs through all points.
    """

    element: str
    unit: str
    strains: tuple[float, ...]
    coefficients: tuple[float, ...]
    covariance: FloatArray
    r2: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Relaxation:
    """All relaxation runs of a specimen, and how the elements depend on strain."""

    fits: tuple[RelaxationFit, ...]
    laws: tuple[StrainLaw, ...]
    remarks: tuple[str, ...] = ()


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


@dataclass(frozen=True, slots=True, eq=False)
class Identified(Quantity):
    """A parameter of the joint fit.

    Attributes
    ----------
    prior
        Its 95 % interval before any run.
    learnt
        Share of the prior's width that the runs took away, 0 where they say nothing of it.
    """

    prior: tuple[float, float] = (float("nan"), float("nan"))
    learnt: float = 0.0
    meaning: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class RunResidual:
    """How the joint fit leaves one run: whitened squares per degree of freedom, zero and factors of the run."""

    file: str
    kind: str
    channel: str
    blocks: int
    chi2: float
    rms_mN: float
    zero: Estimate
    factors: Mapping[str, Estimate]


@dataclass(frozen=True, slots=True, eq=False)
class JointFit:
    """Everything at once: the nominal model's parameters from all runs of a specimen.

    Attributes
    ----------
    parameters, combinations
        Posterior of each parameter, and of the products that the model names.
    correlation
        Between the parameters, shape `(P, P)`, their order.
    chi2, degrees, p_value
        Whitened squares, run factors and priors included, their degrees of freedom, and the chance of as many.
    converged
        Whether the optimiser did; where not, no interval holds.
    steps
        How often the model was evaluated with its derivatives.
    """

    nominal: str
    parameters: tuple[Identified, ...]
    combinations: tuple[Quantity, ...]
    correlation: FloatArray
    runs: tuple[RunResidual, ...]
    chi2: float
    degrees: int
    p_value: float
    converged: bool
    steps: int
    remarks: tuple[str, ...] = ()

    @property
    def values(self) -> Mapping[str, float]:
        """The parameters' values by name."""
        return {one.name: one.value for one in self.parameters}


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """All that a campaign says of one specimen; parts that it does not support are None, with the reason."""

    specimen: str
    used: tuple[str, ...]
    left_out: tuple[LeftOut, ...]
    joint: JointFit | None
    relaxation: Relaxation | None
    coulomb: Coulomb | None
    drag: Drag | None
    remarks: tuple[str, ...] = ()
