"""Viscous friction of the intestinal mucus (Eqs. 10 and 11)."""

import numpy as np

from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray

THINNING = 11.24
"""Shear-thinning part of the apparent viscosity in Eq. 11."""
EXPONENT = 0.7552
"""How fast it falls with the shear rate."""
PLATEAU = 0.1148
"""Apparent viscosity at high shear rates."""


def viscous_force(velocity_mm_s: FloatArray, model: FrictionModelSettings, area_mm2: float) -> FloatArray:
    """Viscous friction f_v [mN], of the sign and shape of the velocity.

    `published` reads Eq. 10 as δ v with δ in mN·s/mm; `newtonian` as a shear stress δ (v/d) with δ in
    Pa·s, acting on the contact surface `area_mm2`.
    """
    speed = np.abs(velocity_mm_s)
    depth = model.mucus_thickness_mm
    force = THINNING * depth**EXPONENT * speed ** (1 - EXPONENT) + PLATEAU * speed
    scale = model.mucus_scale * (1.0 if model.viscous == "published" else area_mm2 / depth * 1e-3)
    return np.asarray(np.copysign(force * scale, velocity_mm_s))
