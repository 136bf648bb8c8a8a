"""What all runs say together."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.identification.results.quantity import Quantity
from dragrig.rig.arrays import FloatArray

DETERMINED = 0.1
"""A number of whose prior width the runs took away less than this is not known from them."""
DOUBTFUL = 0.01
"""Below this chance of as large residuals a model does not hold."""


@dataclass(frozen=True, slots=True, eq=False)
class Identified(Quantity):
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
        return self.learnt >= DETERMINED


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
    parameters: tuple[Identified, ...]
    combinations: tuple[Identified, ...]
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
        return self.converged and not self.p_value < DOUBTFUL

    @property
    def values(self) -> Mapping[str, float]:
        """The parameters' values by name."""
        return {one.name: one.value for one in self.parameters}
