"""What relaxation runs say of the wall."""

from dataclasses import dataclass, field

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.identification.results.quantity import Quantity
from dragrig.rig.arrays import FloatArray


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
