"""The result of an identification, as values; every number has its uncertainty or is missing with the reason."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np

from dragrig.analysis import Estimate, EstimatedQuantity, Exclusion
from dragrig.rig import FloatArray

if TYPE_CHECKING:
    from dragrig.sim_backend.friction import SteadyFriction

MIN_LEARNT = 0.1
"""Smallest reduction of the prior's width with which the runs determine a parameter."""
MAX_LACK_OF_FIT_P = 0.05
"""Significance level of the test of the logarithmic law."""
CHI2_ALERT_SD = 4.0
"""Standard deviations by which a run's χ² per degree of freedom must exceed 1 to count as more than noise."""
MIN_P_VALUE = 0.01
"""A model does not hold if residuals as large are less probable."""


@dataclass(frozen=True, slots=True, eq=False)
class ParameterEstimate(EstimatedQuantity):
    """A parameter of the joint fit, or a product of some."""

    prior: tuple[float, float] = (float("nan"), float("nan"))
    """Its 95 % interval before any run."""
    learnt: float = 0.0
    """Relative reduction of the prior's width by the runs, 0 where they do not constrain it."""
    meaning: str = ""

    @property
    def determined(self) -> bool:
        """Whether the runs determine it."""
        return self.learnt >= MIN_LEARNT


@dataclass(frozen=True, slots=True, eq=False)
class RunResidual:
    """χ² per block of one run in the joint fit, and the run's own zero and variations.

    `zero` is missing where the model has none in this channel; `factors` and `offsets` are its variations, by name.
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

    @property
    def exceeds_noise(self) -> bool:
        """Whether the residuals are larger than noise explains; the standard deviation of χ² per block is √(2/n)."""
        return self.blocks > 0 and self.chi2 > 1 + CHI2_ALERT_SD * sqrt(2 / self.blocks)


@dataclass(frozen=True, slots=True, eq=False)
class JointFit:
    """The nominal model's parameters from all runs of a specimen at once."""

    nominal: str
    parameters: tuple[ParameterEstimate, ...]
    combinations: tuple[ParameterEstimate, ...]
    """`parameters`, `combinations`: posterior of each parameter, and of the products that the model names."""
    correlation: FloatArray
    """Between the parameters, shape `(P, P)`."""
    runs: tuple[RunResidual, ...]
    chi2: float
    degrees: int
    p_value: float
    """`chi2`, `degrees`, `p_value`: χ², run factors and priors included, its degrees of freedom, and the probability of
    at least as much; NaN where no run shows its noise."""
    converged: bool
    """Whether the optimiser did; if not, the intervals are invalid."""
    steps: int
    """Evaluations of the model with its derivatives."""
    remarks: tuple[str, ...] = ()

    @property
    def holds(self) -> bool:
        """Whether the fit converged and leaves no more than noise and repeatability explain."""
        return self.converged and not self.p_value < MIN_P_VALUE

    @property
    def values(self) -> Mapping[str, float]:
        """The parameters' values by name."""
        return {parameter.name: parameter.value for parameter in self.parameters}


@dataclass(frozen=True, slots=True)
class ThirdBranchTest:
    """Whether five elements suffice, or a third Maxwell branch explains more."""

    suffices: bool | None
    """None where the run cannot decide."""
    p_value: float | None
    """Probability of at least such an improvement by noise alone."""
    third_time_s: float | None
    third_force_mN: float | None
    """`third_time_s`, `third_force_mN`: time constant of the best third branch, and its force at the start of the hold.
    """
    sentence: str
    """The result in words."""


@dataclass(frozen=True, slots=True, eq=False)
class RelaxationFit:
    """The five elements of one relaxation run."""

    file: str
    shear_strain: float
    """`file`, `shear_strain`: run and its strain."""
    elements: tuple[EstimatedQuantity, ...] = ()
    """E1, E2, E3 [kPa], eta1, eta2 [kPa·s], in this order; empty where the run supports none, with the reason in
    `remark`."""
    times: tuple[EstimatedQuantity, ...] = ()
    """Time constants η1/E1 and η2/E2 [s]."""
    correlation: FloatArray | None = None
    """Between the elements, shape `(5, 5)`."""
    zero: Estimate = field(default_factory=Estimate)
    """The sensor's zero [mN]."""
    chi2: float | None = None
    degrees: int = 0
    """`chi2`, `degrees`: χ² and its degrees of freedom."""
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
    """The friction coefficient of one run in the vacuum fixture."""

    file: str
    speed_mm_s: float
    weight_mN: float
    force: Estimate
    """Mean steady force of the filtered trace along the motion, zero subtracted [mN]; a backward speed is negative."""
    mu: Estimate
    """With all of it as Coulomb friction, as in the paper."""
    mu_without_viscous: Estimate
    """With the model's viscous friction subtracted first."""
    viscous_mN: float
    viscous_share: float | None
    """`viscous_mN`, `viscous_share`: that friction, and its share of the force."""


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

    `lack_of_fit_p` is the probability of at least such deviations by the points' errors alone.
    """

    intercept: EstimatedQuantity
    slope: EstimatedQuantity
    correlation: float
    r2: float
    lack_of_fit_p: float | None

    def force_mN(self, speed_mm_s: FloatArray) -> FloatArray:
        """Return the law's force at speeds without sign."""
        return self.intercept.value + self.slope.value * np.log(speed_mm_s)

    @property
    def deviates(self) -> bool:
        """Whether the forces deviate from the law by more than their errors."""
        return self.lack_of_fit_p is not None and self.lack_of_fit_p < MAX_LACK_OF_FIT_P


@dataclass(frozen=True, slots=True)
class SpeedBoundary:
    """The speed above which model and measurement differ, if the points show one.

    `interval` holds the speeds that the points do not exclude with 95 % confidence; `p_value` is the probability
    of at least such a bend without any boundary.
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


@dataclass(frozen=True, slots=True, eq=False)
class DragResult:
    """The steady drag against speed; `model` and `before_mN`, of the fitted and of the nominal model, are curves."""

    points: tuple[SpeedPoint, ...]
    log_law: LogLaw | None
    boundary: SpeedBoundary | None
    determination: tuple[SpeedBandR2, ...] = ()
    remarks: tuple[str, ...] = ()
    model: "SteadyFriction | None" = None
    before_mN: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Identification:
    """All results on one specimen; parts that its runs do not support are None, with the reason in `remarks`."""

    specimen: str
    used: tuple[str, ...]
    left_out: tuple[Exclusion, ...]
    joint: JointFit | None
    relaxation: RelaxationResult | None
    coulomb: CoulombResult | None
    drag: DragResult | None
    remarks: tuple[str, ...] = ()
    backends: tuple[str, ...] = ()
    """Where the runs come from: simulated, hardware, external."""
