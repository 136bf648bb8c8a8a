"""Circular folds of the mucosa."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, ForceEffect, Location, RunState, Values, phase, shape, size

WAVELENGTHS_MM = tuple(round(1 / float(wavenumber), 3) for wavenumber in np.linspace(1 / 20, 1 / 1.5, 40))
"""Evenly spaced in wavenumber: over 40 mm no wavelength is more than a third of a period from one of them."""


class Folds(ForceEffect):
    """f_e and f_c are modulated by `depth · sin(2π · position / wavelength + phase)`."""

    id = "folds"
    display_name = "circular folds"
    location = Location.WALL
    coordinate = Coordinate.POSITION
    summary = "Circular folds modulate the force periodically in position."
    visible_in = "the spectrum of drag runs against position, at the same wavelength at all speeds"
    source = (
        "plicae circulares pass the capsule one by one; first harmonic of a wall whose stiffness is periodic along it, "
        "anatomy in Gray's Anatomy (2015), small intestine"
    )
    confused_with = ("velocity_ripple",)
    similar_to = ("peristalsis",)
    period_parameter = "wavelength_mm"
    parameters = (
        size("depth", "1", 0.1, 0.0, 1.0, "amplitude over the nominal force"),
        shape("wavelength_mm", "mm", 4.0, 1.2, 25.0, "distance of the folds", grid=WAVELENGTHS_MM),
        phase("phase_rad", "rad", 0.0, -3.15, 3.15, "of the sine where the run begins"),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        if not run.gut_closed:
            return np.zeros_like(run.time_s)
        angle = 2 * np.pi * run.position_mm / values["wavelength_mm"] + values["phase_rad"]
        return np.asarray((run.f_e + run.f_c) * values["depth"] * np.sin(angle))
