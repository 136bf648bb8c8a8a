"""Cogging or pitch error of the drive."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, Location, MotorEffect, PositionForm, Values, phase, shape, size

PITCHES_MM = tuple(round(float(1 / wave), 3) for wave in np.linspace(1 / 20, 1.0, 40))
"""From 20 to 1 mm, evenly in wavenumber: over a stroke of 20 mm neighbours differ by at most half a period."""


class VelocityRipple(MotorEffect):
    """The stage deviates from its command by a sine of its position."""

    id = "velocity_ripple"
    location = Location.MOTOR
    coordinate = Coordinate.POSITION
    summary = "Cogging or pitch error makes the stage's velocity ripple with its position."
    visible_in = "position against command, at the same positions in every run"
    source = "Gieras, Piech and Tomczuk, Linear Synchronous Motors, chapter 3 (detent force)"
    period_parameter = "pitch_mm"
    position_form = PositionForm.RIPPLE
    parameters = (
        size("amplitude_mm", "mm", 0.03, 0.0, 1.0, "amplitude in position"),
        shape("pitch_mm", "mm", 5.0, 0.5, 50.0, "length of a period", grid=PITCHES_MM),
        phase("phase_rad", "rad", 0.0, -np.pi, np.pi, "where a run starts"),
    )

    def stage_position(self, time_s: FloatArray, command_mm: FloatArray, values: Values) -> FloatArray:
        phase = values["phase_rad"]
        ripple = np.sin(2 * np.pi * command_mm / values["pitch_mm"] + phase) - np.sin(phase)
        return np.asarray(command_mm + values["amplitude_mm"] * ripple)
