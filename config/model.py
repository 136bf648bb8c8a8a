"""What the simulator assumes of gut and capsule: the parameters of the friction model."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from dragrig.config.base import Settings
from dragrig.config.diagnosed import DiagnosedSettings
from dragrig.config.effects import EffectSettings
from dragrig.config.identified import IdentifiedSettings

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
    identified: IdentifiedSettings | None = None
    """Where the values come from, if from runs."""
    diagnosed: DiagnosedSettings | None = None
    """Where the effects come from, if from a diagnosis."""

    @model_validator(mode="after")
    def _has_its_polynomials(self) -> Self:
        if self.wall == "polynomial" and self.wall_polynomials is None:
            raise ValueError("wall polynomial needs a group wall_polynomials with E1, E2, E3, eta1 and eta2")
        return self
