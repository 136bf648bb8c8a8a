"""Where a model's values come from when runs were identified; kept beside them, never needed to simulate."""

from pydantic import Field

from dragrig.config.base import Settings


class IdentifiedValue(Settings):
    """A number of a fit with its 95 % interval; `learnt` is the share of the prior's width that runs took away.

    One that is not `determined` is no more than what was known before.
    """

    name: str
    unit: str = "1"
    value: float
    standard_error: float = Field(ge=0)
    low: float
    high: float
    learnt: float | None = None
    determined: bool = True


class IdentifiedSettings(Settings):
    """An identification in short."""

    campaign: str
    specimen: str
    runs: int = Field(ge=1)
    software: str
    converged: bool
    chi2_per_degree: float
    parameters: tuple[IdentifiedValue, ...] = ()
    """All parameters of the fit; those of which the runs say nothing keep the nominal value in the settings."""
    combinations: tuple[IdentifiedValue, ...] = ()
    correlation: tuple[tuple[float, ...], ...] = ()
    """Between the parameters, in their order."""
