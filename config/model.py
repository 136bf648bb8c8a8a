"""What the simulator assumes of gut and capsule: the parameters of the friction model."""

from typing import Literal

from pydantic import Field

from dragrig.config.base import Settings


class FrictionModelSettings(Settings):
    """Choices and scales of the friction model; the defaults are the paper's."""

    name: str = "paper"
    wall: Literal["eq14", "table1"] = "eq14"
    """Wall parameters: the polynomials of Eq. 14, or the least-squares quadratic through Table 1."""
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
