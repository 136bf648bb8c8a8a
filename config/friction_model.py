"""The friction model's parameters: assumptions on gut and capsule, and effects beyond the nominal model.

A model that was identified or diagnosed carries a summary of where its values come from; a simulation does not need it.
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal, Self

from pydantic import Field, model_serializer, model_validator

from dragrig.config.errors import SettingsError
from dragrig.config.settings import GatheredSettings, Settings, parse
from dragrig.config.typed_numbers import read_number


class EffectSettings(GatheredSettings):
    """An effect that is switched on, with its parameters; those not listed have their default values."""

    id: str = Field(min_length=1)
    parameters: Mapping[str, float] = {}

    @model_serializer
    def _beside_the_id(self) -> dict[str, str | float]:
        return {"id": self.id, **self.parameters}


def parse_effects(effects: Sequence[str | EffectSettings]) -> tuple[EffectSettings, ...]:
    """Return effects from settings or from text, `stribeck` or `stribeck:ratio=0.4,speed_mm_s=2`.

    Raises `SettingsError` for a text that is not of this form.
    """
    sequence = (effects,) if isinstance(effects, str | EffectSettings) else effects
    return tuple(effect if isinstance(effect, EffectSettings) else _parse_effect(effect) for effect in sequence)


def _parse_effect(text: str) -> EffectSettings:
    name, colon, assignments = text.partition(":")
    values: dict[str, float] = {}
    for assignment in assignments.split(",") if colon else ():
        key, _, value = assignment.partition("=")
        try:
            values[key.strip()] = read_number(value)
        except SettingsError:
            key = ""
        if not (name.strip() and key.strip()):
            raise SettingsError(
                f"effect {text}: is not of the form id:parameter=number,…, as in stribeck:ratio=0.4,speed_mm_s=2."
            )
    if not name.strip():
        raise SettingsError(f"effect {text}: names no effect; dragrig gap effects lists them.")
    return parse(EffectSettings, {"id": name.strip(), "parameters": values}, f"effect {text}")


class IdentifiedValue(Settings):
    """A fitted number with its 95 % interval.

    `learnt` is the fraction by which the runs narrowed the prior; a value that is not `determined` is the prior's.
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
    """Summary of an identification."""

    campaign: str
    specimen: str
    runs: int = Field(ge=1)
    software: str
    converged: bool
    chi2_per_degree: float
    parameters: tuple[IdentifiedValue, ...] = ()
    """All parameters of the fit; those that the runs do not determine keep the nominal value in the settings."""
    combinations: tuple[IdentifiedValue, ...] = ()
    correlation: tuple[tuple[float, ...], ...] = ()
    """Between the parameters, in their order."""


class DiagnosisSummary(Settings):
    """Summary of a diagnosis.

    `nominal` holds the parameters of the nominal model refitted without the effects, so that the effects' contribution
    can be measured on other runs; `promised` is the share of the gap that they closed, with its 95 % interval.
    `run_ids` are the runs that took part, which can confirm nothing.
    """

    specimen: str
    verdict: str
    effects: tuple[str, ...]
    probability: float
    runs: int
    promised: float | None = None
    promised_95ci: tuple[float, float] | None = None
    nominal: Mapping[str, float] = {}
    run_ids: tuple[str, ...] = ()


Polynomial = Annotated[tuple[float, ...], Field(min_length=1, max_length=5)]
"""Coefficients of a polynomial in the strain (1 being 100 %), highest power first, up to the fourth."""


class WallPolynomials(Settings):
    """Elements of the wall as functions of strain; springs in kPa, dampers in kPa·s."""

    E1: Polynomial
    E2: Polynomial
    E3: Polynomial
    eta1: Polynomial
    eta2: Polynomial


class FrictionModelSettings(Settings):
    """Choices and scales of the friction model; the defaults are the paper's."""

    name: str = "paper"
    wall: Literal["eq14", "table1", "polynomial"] = "eq14"
    """Wall parameters: Eq. 14, the least-squares quadratic through Table 1, or your own polynomials."""
    wall_polynomials: WallPolynomials | None = None
    """Polynomials of the wall `polynomial`."""
    viscous: Literal["published", "newtonian"] = "published"
    """Reading of Eq. 10: δ v with δ in mN·s/mm, or δ (v/d) S with δ in Pa·s."""
    friction_coefficient: float = Field(default=0.082, ge=0, le=2)
    """The paper's μ."""
    mucus_thickness_mm: float = Field(default=0.030, gt=0, le=1)
    """The paper's d."""
    side_contact_mm: float = Field(default=20.0, ge=0, le=200)
    """Length behind the equator that the wall still touches (section 3.3 of the paper)."""
    regularisation_mm_s: float = Field(default=0.05, gt=0, le=10)
    """Speed range over which Coulomb friction changes its sign."""
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
    """True gain of the force channel relative to its calibration."""
    insertion_dwell_scale: float = Field(default=1.0, gt=0, le=10)
    """True age of the contact at the first sample relative to the recorded one."""
    contact_angle_offset_deg: float = Field(default=0.0, gt=-30, lt=30)
    """Added to the capsule's contact angle."""
    effects: tuple[EffectSettings, ...] = ()
    """Effects of the simulated rig beyond this model, as groups [[effects]] in a file; see dragrig gap effects."""
    identified: IdentificationSummary | None = None
    """The identification that the values come from."""
    diagnosed: DiagnosisSummary | None = None
    """The diagnosis that the effects come from."""

    @model_validator(mode="before")
    @classmethod
    def _is_of_the_friction_model(cls, data: object) -> object:
        if isinstance(data, Mapping) and "nominal" in data:
            raise ValueError(
                f"this is an amended model of {data['nominal']}, which the simulated rig does not have; it serves "
                "dragrig gap evaluate, and --nominal of gap diagnose"
            )
        return data

    @model_validator(mode="after")
    def _has_its_polynomials(self) -> Self:
        if self.wall == "polynomial" and self.wall_polynomials is None:
            raise ValueError("wall polynomial needs a group wall_polynomials with E1, E2, E3, eta1 and eta2")
        return self

    def with_values(self, values: Mapping[str, float]) -> Self:
        """Return the model with other values of some parameters, which no identification gave."""
        return self.model_copy(update={**values, "identified": None})


class AmendedModelSettings(Settings):
    """A model other than the friction model, with the values and the effects that a diagnosis found."""

    name: str = "amended"
    nominal: str = Field(min_length=1)
    """The model without effects: the name of an installed one, as `drive`, or the file of one of your own."""
    parameters: Mapping[str, float]
    """Value of each of its parameters."""
    effects: tuple[EffectSettings, ...] = ()
    """Effects beyond the model, as groups [[effects]] in a file."""
    diagnosed: DiagnosisSummary | None = None
    """The diagnosis that values and effects come from."""

    def with_values(self, values: Mapping[str, float]) -> Self:
        """Return the model with other values of some parameters."""
        return self.model_copy(update={"parameters": {**self.parameters, **values}})


ModelSettings = FrictionModelSettings | AmendedModelSettings
"""Settings of a model with which a campaign is compared, and of what a diagnosis makes of it."""
