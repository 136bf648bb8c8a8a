"""How simulated specimens and runs differ from the model's values."""

import math

import numpy as np

from dragrig.config.model import FrictionModelSettings
from dragrig.config.rig import VariationSettings
from dragrig.sim_backend.devices.noise import Stream, generator

BETWEEN_SPECIMENS = {
    "stiffness_scale": 0.15,
    "e1_scale": 0.07,
    "e2_scale": 0.07,
    "e3_scale": 0.07,
    "eta1_scale": 0.07,
    "eta2_scale": 0.07,
    "friction_coefficient": 0.12,
    "mucus_scale": 0.20,
    "force_gain": 0.005,
    "insertion_dwell_scale": 0.25,
}
"""Relative standard deviations between specimens, by name in the model's settings."""

CONTACT_ANGLE_DEG = 0.7
"""Standard deviation of the contact angle between specimens."""

FURTHEST = 3.0
"""Draws are clipped at this many standard deviations."""


def vary(nominal: float, relative_deviation: float, normal: float) -> float:
    """Return `nominal` times a lognormal factor of mean 1 and this relative standard deviation.

    `normal` is the standard normal draw, clipped at `FURTHEST`.
    """
    width = math.sqrt(math.log1p(relative_deviation**2))
    return nominal * math.exp(width * min(max(normal, -FURTHEST), FURTHEST) - 0.5 * width**2)


def draw_specimen(model: FrictionModelSettings, seed: int) -> FrictionModelSettings:
    """Return the model of one specimen out of many: lognormal factors, and a clipped normal contact angle."""
    normals = generator(seed, Stream.SPECIMEN).standard_normal(len(BETWEEN_SPECIMENS) + 1)
    drawn = {
        name: vary(float(getattr(model, name)), deviation, float(normal))
        for (name, deviation), normal in zip(BETWEEN_SPECIMENS.items(), normals, strict=False)
    }
    turn = CONTACT_ANGLE_DEG * float(np.clip(normals[-1], -FURTHEST, FURTHEST))
    drawn["contact_angle_offset_deg"] = model.contact_angle_offset_deg + turn
    return model.model_copy(update=drawn)


def draw_run(
    model: FrictionModelSettings, variation: VariationSettings, seed: int, order: int
) -> FrictionModelSettings:
    """Return the model of one run on a specimen: lognormal factors on stiffness and friction coefficient."""
    stiffness, friction = generator(seed, Stream.RUN, order).standard_normal(2)
    return model.model_copy(
        update={
            "stiffness_scale": vary(model.stiffness_scale, variation.run_stiffness, float(stiffness)),
            "friction_coefficient": vary(model.friction_coefficient, variation.run_friction, float(friction)),
        }
    )
