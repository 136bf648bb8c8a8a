"""The model of the specimen in the campaign of the tests."""

import numpy as np

from dragrig.config.friction_model import FrictionModelSettings

TRUE_MODEL = FrictionModelSettings(
    friction_coefficient=0.09,
    mucus_scale=1.1382,
    stiffness_scale=1.1042,
    e1_scale=0.9294,
    e2_scale=1.0284,
    e3_scale=0.9517,
    eta1_scale=0.9675,
    eta2_scale=0.944,
    force_gain=0.9926,
    insertion_dwell_scale=43.6001 / 60.0,
    contact_angle_offset_deg=float(np.degrees(1.0492)) - 60.0,
)
"""What the answers of the campaign in `CAMPAIGN` say of its specimen."""
