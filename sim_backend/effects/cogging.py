"""Detent force of a motor: magnets that prefer some positions."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, ForceEffect, Location, RunState, Values, phase, shape, size


class Cogging(ForceEffect):
    """The motor's force has a sine of the position on the machine, whatever the speed and the direction."""

    id = "cogging"
    location = Location.MOTOR
    coordinate = Coordinate.POSITION
    summary = "The motor's magnets prefer some positions: its force is periodic in position."
    visible_in = "the motor force against position, at the same places of the machine in every run"
    source = "Gieras, Piech and Tomczuk, Linear Synchronous Motors, chapter 3 (detent force)"
    nominal = "drive"
    period_parameter = "pitch_mm"
    origin_parameter = "from_mm"
    parameters = (
        size("amplitude_mN", "mN", 50.0, 0.0, 1e5, "amplitude of the force"),
        shape("pitch_mm", "mm", 10.0, 0.05, 100.0, "length of a period", grid=(2.5, 5.0, 10.0, 20.0, 40.0)),
        phase("phase_rad", "rad", 0.0, -np.pi, np.pi, "of the sine at `from_mm`"),
        shape("from_mm", "mm", 0.0, -1e6, 1e6, "place on the machine that the phase refers to"),
    )

    @property
    def varies_in_session(self) -> bool:
        """Repeats may begin elsewhere on the machine."""
        return True

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        """Return the added force at the places of the run."""
        if not run.sliding:
            return np.zeros_like(run.time_s)
        place_mm = run.origin_mm + run.position_mm - values["from_mm"]
        return np.asarray(
            values["amplitude_mN"] * np.sin(2 * np.pi * place_mm / values["pitch_mm"] + values["phase_rad"])
        )
