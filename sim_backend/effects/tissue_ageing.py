"""A wall whose stiffness drifts with session time."""

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Coordinate, EffectParameter, ForceEffect, Location, Role, Values
from dragrig.sim_backend.effects.run_state import RunState

REFERENCE_S = 3600.0
"""Session time at which its size is named."""


class TissueAgeing(ForceEffect):
    """Stiffness changes by `change` in the first hour, as `1 − exp(−time / constant)`: a line for a long constant."""

    id = "tissue_ageing"
    location = Location.SPECIMEN
    coordinate = Coordinate.SESSION
    summary = "Stiffness drifts with session time, as the tissue dries or loses its tone."
    visible_in = "a trend across relaxation and drag runs with their start time"
    source = (
        "power law in time for water and tone lost post mortem; data in Nicolle and Palierne, "
        "Journal of the Mechanical Behavior of Biomedical Materials 3 (2010) 630"
    )
    confused_with = ("preconditioning",)
    parameters = (
        EffectParameter("change", "1", Role.SIZE, 0.2, -0.9, 3.0, "relative change of stiffness in the first hour"),
        EffectParameter(
            "power",
            "1",
            Role.SHAPE,
            1.0,
            0.2,
            8.0,
            "power of the session's time: below 1 it slows down, above it sets in late",
            grid=(0.35, 0.7, 1.4, 2.8),
        ),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        """Return the force of the stiffness that is added."""
        aged = (np.maximum(run.session_s, 0.0) / REFERENCE_S) ** values["power"]
        return np.asarray(run.stiff * values["change"] * aged)


EFFECT = TissueAgeing()
