"""Mucus that is wiped off as the capsule travels."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import (
    Coordinate,
    ForceEffect,
    Location,
    RunState,
    Values,
    distance_travelled,
    shape,
    size,
)

REFERENCE_MM = 40.0
"""Distance that its size refers to."""


class FilmDepletion(ForceEffect):
    """f_c grows by `ratio` over the first 40 mm, as `1 − exp(−distance / length)`; linear for a long length."""

    id = "film_depletion"
    location = Location.INTERFACE
    coordinate = Coordinate.POSITION
    summary = "Mucus is wiped off as the capsule travels, so that friction grows with distance."
    visible_in = "the slope along the stroke of Coulomb and drag runs, the same in position at all speeds"
    source = (
        "film worn off with sliding distance, Archard, Journal of Applied Physics 24 (1953) 981; "
        "running-in towards boundary friction, Blau, Tribology International 38 (2005) 1007"
    )
    confused_with = ("force_drift", "mesentery_tether")
    parameters = (
        size("ratio", "1", 0.3, 0.0, 3.0, "growth of friction over 40 mm"),
        shape(
            "length_mm", "mm", 20.0, 2.0, 500.0, "distance over which it saturates", grid=(4.0, 8.0, 16.0, 32.0, 300.0)
        ),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        depleted = -np.expm1(-distance_travelled(run.motion, run.time_s) / values["length_mm"])
        return np.asarray(run.f_c * values["ratio"] * depleted / -np.expm1(-REFERENCE_MM / values["length_mm"]))
