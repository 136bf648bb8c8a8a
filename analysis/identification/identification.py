"""What an identification says, as values; every number has its uncertainty or is missing with the reason."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from dragrig.analysis.estimates import Estimate, EstimatedQuantity, Exclusion
from dragrig.rig.arrays import FloatArray

MIN_LEARNT = 0.1
"""A number of whose prior width the runs took away less than this is not known from them."""
MIN_P_VALUE = 0.01
"""Below this chance of as large residuals a model does not hold."""


@dataclass(frozen=True, slots=True, eq=False)
class ParameterEstimate(EstimatedQuantity):
    """A parameter of the joint fit, or a product of some.

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

    @property
    def determined(self) -> bool:
        """Whether the runs say anything of it."""
        return self.learnt >= MIN_LEARNT


@dataclass(frozen=True, slots=True, eq=False)
class RunResidual:
    """How the joint fit leaves one run: whitened squares per degree of freedom, and what is the run's own.

    `zero` is missing where the model gives the channel none; `factors` and `offsets` are its variations, by name.
    """

    file: str
    kind: str
    channel: str
    blocks: int
    chi2: float
    rms_mN: float
    zero: Estimate
    factors: Mapping[str, Estimate]
    offsets: Mapping[str, Estimate] = field(default_factory=dict)


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
        Whitened squares, run factors and priors included, their degrees of freedom, and the chance of as many; NaN
        where no run shows its noise.
    converged
        Whether the optimiser did; where not, no interval holds.
    steps
        How often the model was evaluated with its derivatives.
    """

    nominal: str
    parameters: tuple[ParameterEstimate, ...]
    combinations: tuple[ParameterEstimate, ...]
    correlation: FloatArray
    runs: tuple[RunResidual, ...]
    chi2: float
    degrees: int
    p_value: float
    converged: bool
    steps: int
    remarks: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether the fit converged and leaves no more than noise and repeatability explain."""
        return self.converged and not self.p_value < MIN_P_VALUE

    @property
    def values(self) -> Mapping[str, float]:
        """The parameters' values by name."""
        return {one.name: one.value for one in self.parameters}


@dataclass(frozen=True, slots=True)
class ThirdBranchTest:
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
    elements: tuple[EstimatedQuantity, ...] = ()
    times: tuple[EstimatedQuantity, ...] = ()
    correlation: FloatArray | None = None
    zero: Estimate = field(default_factory=Estimate)
    chi2: float | None = None
    degrees: int = 0
    test: ThirdBranchTest | None = None
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
class RelaxationResult:
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
class CoulombResult:
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

    intercept: EstimatedQuantity
    slope: EstimatedQuantity
    correlation: float
    r2: float
    lack_of_fit_p: float | None


@dataclass(frozen=True, slots=True)
class SpeedBoundary:
    """The speed above which model and measurement part ways, if the points show one.

    `interval` holds the speeds that the points do not exclude with 95 % confidence; `p_value` is the chance of at least
    such a difference between bands without any boundary.
    """

    speed_mm_s: float | None
    interval: tuple[float, float] | None
    p_value: float | None
    sentence: str


@dataclass(frozen=True, slots=True)
class SpeedBandR2:
    """R² of the model over a band of speeds, in both of the paper's forms; None for fewer than three speeds.

    `eq15` is the ratio of Eq. 15, which can exceed 1; `correlation` the squared correlation.
    """

    band: str
    speeds: int
    eq15: float | None
    correlation: float | None


@dataclass(frozen=True, slots=True)
class DragResult:
    """The steady drag against speed."""

    points: tuple[SpeedPoint, ...]
    log_law: LogLaw | None
    boundary: SpeedBoundary | None
    determination: tuple[SpeedBandR2, ...] = ()
    remarks: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """All that a campaign says of one specimen; parts that it does not support are None, with the reason."""

    specimen: str
    used: tuple[str, ...]
    left_out: tuple[Exclusion, ...]
    joint: JointFit | None
    relaxation: RelaxationResult | None
    coulomb: CoulombResult | None
    drag: DragResult | None
    remarks: tuple[str, ...] = ()
