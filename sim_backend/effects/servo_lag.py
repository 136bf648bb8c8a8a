"""A stage that lags behind its command, and overshoots it."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Coordinate, Location, MotorEffect, PositionForm, Values, resonator, shape, size


class ServoLag(MotorEffect):
    """A position loop with natural frequency and damping, whose lag `2 ζ / ω` feed-forward may reduce.

    `lag_s` is the lag at constant speed. It cannot exceed `2 ζ / ω`: for a larger lag the frequency is lowered.
    """

    id = "servo_lag"
    location = Location.MOTOR
    coordinate = Coordinate.TRANSIENT
    summary = "The stage lags behind its command and overshoots at the end."
    visible_in = "position against command, in proportion to speed"
    source = "second-order servo loop with velocity feed-forward; Ellis, Control System Design Guide"
    confused_with = ("channel_latency",)
    position_form = PositionForm.RESPONSE
    parameters = (
        size("lag_s", "s", 0.01, 0.0, 0.5, "time behind the command at constant speed"),
        shape("frequency_hz", "Hz", 20.0, 0.3, 100.0, "natural frequency of the loop", grid=(1.0, 2.0, 4.0, 8.0, 16.0)),
        shape("damping", "1", 0.7, 0.1, 0.95, "share of critical", grid=(0.35, 0.8), bounds=(0.001, 0.999)),
    )

    def stage_position(self, time_s: FloatArray, command_mm: FloatArray, values: Values) -> FloatArray:
        lag, damping = values["lag_s"], values["damping"]
        frequency = values["frequency_hz"]
        if lag > 0:
            frequency = min(frequency, damping / (np.pi * lag))
        share = lag * np.pi * frequency / damping
        behind = command_mm - resonator(time_s, command_mm, frequency, damping)
        return np.asarray(command_mm - share * behind)
