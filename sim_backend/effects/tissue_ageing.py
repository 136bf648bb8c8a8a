"""A wall whose stiffness drifts with session time."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, ForceEffect, Location, RunState, Values, shape, size

REFERENCE_S = 3600.0
"""Session time that its size refers to."""


class TissueAgeing(ForceEffect):
    """Stiffness changes by `change` in the first hour, as a power of the session's time."""

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
        size("change", "1", 0.2, -0.9, 3.0, "relative change of stiffness in the first hour"),
        shape(
            "power",
            "1",
            1.0,
            0.2,
            8.0,
            "power of the session's time: below 1 the drift slows down, above 1 it sets in late",
            grid=(0.35, 0.7, 1.4, 2.8),
        ),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        aged = (np.maximum(run.session_s, 0.0) / REFERENCE_S) ** values["power"]
        return np.asarray(run.stiffness_force * values["change"] * aged)
