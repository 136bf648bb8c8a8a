"""The friction model's parameters: what the simulator assumes of gut and capsule, and effects beyond the nominal model.

A model that was identified or diagnosed carries a summary of where its values come from; a simulation does not need it.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, ModelWrapValidatorHandler, model_serializer, model_validator

from dragrig.config.errors import SettingsError
from dragrig.config.settings import Settings


class EffectSettings(Settings):
    """An effect that is switched on. Its parameters stand beside the id, in a file as here; the usual for none."""

    id: str = Field(min_length=1)
    parameters: Mapping[str, float] = {}

    @model_validator(mode="wrap")
    @classmethod
    def _gather_parameters(cls, data: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if not isinstance(data, Mapping):
            return handler(data)
        given = data.get("parameters", {})
        rest = {key: value for key, value in data.items() if key not in cls.model_fields}
        if rest and isinstance(given, Mapping):
            own = {key: value for key, value in data.items() if key not in rest}
            data = {**own, "parameters": {**given, **rest}}
        return handler(data)

    @model_serializer
    def _beside_the_id(self) -> dict[str, str | float]:
        return {"id": self.id, **self.parameters}


def parse_effects(given: Sequence[str | EffectSettings]) -> tuple[EffectSettings, ...]:
    """Return effects as they are typed, `stribeck` or `stribeck:ratio=0.4,speed_mm_s=2`, or as they are.

    Raises
    ------
    SettingsError
        For a text that is not of this form.
    """
    return tuple(one if isinstance(one, EffectSettings) else _parse_effect(one) for one in _as_sequence(given))


def _as_sequence(given: Sequence[str | EffectSettings]) -> Sequence[str | EffectSettings]:
    return (given,) if isinstance(given, str | EffectSettings) else given


def _parse_effect(text: str) -> EffectSettings:
    name, colon, listed = text.partition(":")
    values: dict[str, float] = {}
    for part in listed.split(",") if colon else ():
        key, _, value = part.partition("=")
        number = _finite_number(value)
        if not name.strip() or not key.strip() or number is None:
            raise SettingsError(
                f"--effect {text}: is not of the form id:parameter=number,…, as in stribeck:ratio=0.4,speed_mm_s=2."
            )
        values[key.strip()] = number
    if not name.strip():
        raise SettingsError(f"--effect {text}: names no effect; dragrig gap effects lists them.")
    return EffectSettings(id=name.strip(), parameters=values)


def _finite_number(text: str) -> float | None:
    try:
        number = float(text)
    except ValueError:
        return None
    return number if abs(number) < float("inf") else None


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


class IdentificationSummary(Settings):
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


class DiagnosisSummary(Settings):
    """A diagnosis in short.

    `nominal` holds the parameters of the nominal model as they were refitted without the effects, so that what the
    effects are worth can be measured on other runs; `promised` the share of the gap that they closed.
    """

    specimen: str
    verdict: str
    effects: tuple[str, ...]
    probability: float
    runs: int
    promised: float | None = None
    nominal: Mapping[str, float] = {}


Polynomial = Annotated[tuple[float, ...], Field(min_length=1, max_length=5)]
"""Coefficients of a polynomial in the strain (1 being 100 %), highest power first, up to the fourth."""


class WallPolynomials(Settings):
    """Each element of the wall against strain; springs in kPa, dampers in kPa·s."""

    E1: Polynomial
    E2: Polynomial
    E3: Polynomial
    eta1: Polynomial
    eta2: Polynomial


class FrictionModelSettings(Settings):
    """Choices and scales of the friction model; the defaults are the paper's."""

    name: str = "paper"
    wall: Literal["eq14", "table1", "polynomial"] = "eq14"
    """Wall parameters: Eq. 14, the least-squares quadratic through Table 1, or polynomials of one's own."""
    wall_polynomials: WallPolynomials | None = None
    """What wall polynomial evaluates."""
    viscous: Literal["published", "newtonian"] = "published"
    """Reading of Eq. 10: δ v with δ in mN·s/mm, or δ (v/d) S with δ in Pa·s."""
    friction_coefficient: float = Field(default=0.082, ge=0, le=2)
    """The paper's μ."""
    mucus_thickness_mm: float = Field(default=0.030, gt=0, le=1)
    """The paper's d."""
    side_contact_mm: float = Field(default=20.0, ge=0, le=200)
    """How far behind the equator the wall still touches (section 3.3 of the paper)."""
    regularisation_mm_s: float = Field(default=0.05, gt=0, le=10)
    """Speed over which Coulomb friction turns its sign."""
    stiffness_scale: float = Field(default=1.0, gt=0, le=10)
    """Multiplies E1, E2, E3, η1 and η2 alike."""
    e1_scale: float = Field(default=1.0, gt=0, le=10)
    e2_scale: float = Field(default=1.0, gt=0, le=10)
    e3_scale: float = Field(default=1.0, gt=0, le=10)
    eta1_scale: float = Field(default=1.0, gt=0, le=10)
    eta2_scale: float = Field(default=1.0, gt=0, le=10)
    mucus_scale: float = Field(default=1.0, ge=0, le=10)
    """Multiplies the apparent viscosity."""
    force_gain: float = Field(default=1.0, gt=0, le=10)
    """True gain of the force channel over its calibration."""
    insertion_dwell_scale: float = Field(default=1.0, gt=0, le=10)
    """True age of the contact at the first sample over the noted one."""
    contact_angle_offset_deg: float = Field(default=0.0, gt=-30, lt=30)
    """Added to the capsule's contact angle."""
    effects: tuple[EffectSettings, ...] = ()
    """What the simulated rig has beside this model, in a file as groups [[effects]]; dragrig gap effects lists them."""
    identified: IdentificationSummary | None = None
    """Where the values come from, if from runs."""
    diagnosed: DiagnosisSummary | None = None
    """Where the effects come from, if from a diagnosis."""

    @model_validator(mode="after")
    def _has_its_polynomials(self) -> Self:
        if self.wall == "polynomial" and self.wall_polynomials is None:
            raise ValueError("wall polynomial needs a group wall_polynomials with E1, E2, E3, eta1 and eta2")
        return self
