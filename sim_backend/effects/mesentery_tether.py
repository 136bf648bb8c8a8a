"""A mesentery, or a fixture, that pulls back late in the stroke."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, ForceEffect, Location, RunState, Values, shape, size

REFERENCE_MM = 10.0
"""Distance beyond the onset that its force refers to."""


class MesenteryTether(ForceEffect):
    """Beyond an onset it pulls with `force · ((distance − onset) / 10 mm)^power`, moving or not."""

    id = "mesentery_tether"
    location = Location.WALL
    coordinate = Coordinate.POSITION
    summary = "The mesentery or the fixture pulls back late in the stroke."
    visible_in = "growth beyond some position of drag runs, and its remainder in the hold"
    source = "toe and linear region of a slack membrane taken up; Fung, Biomechanics (1993), chapter 7"
    confused_with = ("film_depletion", "force_drift")
    similar_to = ("folds", "peristalsis")
    free_law = "place in the gut"
    parameters = (
        size("force_mN", "mN", 10.0, 0.0, 300.0, "pull 10 mm beyond the onset"),
        shape("onset_mm", "mm", 10.0, 0.0, 200.0, "distance at which it begins", grid=(0.0, 10.0, 18.0, 25.0, 31.0)),
        shape("power", "1", 1.0, 1.0, 4.0, "power of the growth", grid=(1.0, 2.0)),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        if not run.gut_closed:
            return np.zeros_like(run.time_s)
        position = run.position_mm
        taken_up = np.maximum(np.abs(position) - values["onset_mm"], 0.0) / REFERENCE_MM
        return np.asarray(values["force_mN"] * np.sign(position) * taken_up ** values["power"])
