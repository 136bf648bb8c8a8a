"""Living muscle that contracts."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, ForceEffect, Location, RunState, Values, phase, shape, size

PERIODS_S = tuple(round(1 / float(frequency), 3) for frequency in np.linspace(1 / 30, 1 / 3, 60))
"""Evenly spaced in frequency: in a run of 90 s no period is more than a third of a turn from one of them."""


class Peristalsis(ForceEffect):
    """Pulses `force · exp(sharpness · (cos(2π · session time / period + phase) − 1))`, also during holds."""

    id = "peristalsis"
    location = Location.WALL
    coordinate = Coordinate.SESSION
    summary = "Living muscle contracts in pulses that are periodic in time, also during holds."
    visible_in = "the spectrum of drag runs against the session's clock"
    source = (
        "slow waves of 8 to 12 per minute in the small intestine, Huizinga and Lammers, American Journal of Physiology "
        "296 (2009) G1; pulse of von Mises form"
    )
    period_parameter = "period_s"
    parameters = (
        size("force_mN", "mN", 10.0, 0.0, 300.0, "height of a pulse"),
        shape("period_s", "s", 8.0, 2.5, 40.0, "time from pulse to pulse", grid=PERIODS_S),
        shape("sharpness", "1", 1.5, 0.0, 20.0, "higher for shorter pulses", grid=(1.5,)),
        phase("phase_rad", "rad", 0.0, -3.15, 3.15, "at the session's start"),
    )

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        """Return the pulses, which act where the gut closes on the capsule."""
        if not run.gut_closed:
            return np.zeros_like(run.time_s)
        angle = 2 * np.pi * run.session_s / values["period_s"] + values["phase_rad"]
        return np.asarray(values["force_mN"] * np.exp(values["sharpness"] * (np.cos(angle) - 1)))
