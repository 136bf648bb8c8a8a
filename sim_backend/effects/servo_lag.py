"""A stage that lags behind its command, and overshoots it."""

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import (
    Coordinate,
    EffectParameter,
    Location,
    MotorEffect,
    PositionForm,
    Role,
    Values,
)
from dragrig.sim_backend.effects.dynamics import resonator


class ServoLag(MotorEffect):
    """A position loop with natural frequency and damping, of whose lag `2 ζ / ω` feed-forward may take a share off.

    The lag is that at constant speed. A loop never lags more than `2 ζ / ω`, so that for a larger lag its frequency
    is what makes it so.
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
        EffectParameter("lag_s", "s", Role.SIZE, 0.01, 0.0, 0.5, "time behind the command at constant speed"),
        EffectParameter(
            "frequency_hz", "Hz", Role.SHAPE, 20.0, 0.3, 100.0, "of the loop", grid=(1.0, 2.0, 4.0, 8.0, 16.0)
        ),
        EffectParameter(
            "damping",
            "1",
            Role.SHAPE,
            0.7,
            0.1,
            0.95,
            "share of critical",
            grid=(0.35, 0.8),
            bounds=(0.001, 0.999),
        ),
    )

    def stage_position(self, time_s: FloatArray, command_mm: FloatArray, values: Values) -> FloatArray:
        """Return the position of the loop."""
        lag, damping = values["lag_s"], values["damping"]
        frequency = values["frequency_hz"]
        if lag > 0:
            frequency = min(frequency, damping / (np.pi * lag))
        share = lag * np.pi * frequency / damping
        behind = command_mm - resonator(time_s, command_mm, frequency, damping)
        return np.asarray(command_mm - share * behind)


EFFECT = ServoLag()
