"""A stage that lags behind its command, and overshoots it."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import (
    EffectCoordinate,
    EffectLocation,
    EffectParameter,
    MotorEffect,
    ParameterRole,
)
from dragrig.sim_backend.effects.dynamics import resonator


class ServoLag(MotorEffect):
    """A position loop with natural frequency and damping, of whose lag `2 ζ / ω` feed-forward may take a share off.

    The lag is that at constant speed. A loop never lags more than `2 ζ / ω`, so that for a larger lag its frequency
    is what makes it so.
    """

    id: ClassVar[str] = "servo_lag"
    place: ClassVar[EffectLocation] = EffectLocation.MOTOR
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.TRANSIENT
    summary: ClassVar[str] = "The stage lags behind its command and overshoots at the end."
    exposes: ClassVar[str] = "position against command, in proportion to speed"
    source: ClassVar[str] = "second-order servo loop with velocity feed-forward; Ellis, Control System Design Guide"
    aliases: ClassVar[tuple[str, ...]] = ("channel_latency",)
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("lag_s", "s", ParameterRole.SIZE, 0.01, 0.0, 0.5, "time behind the command at constant speed"),
        EffectParameter(
            "frequency_hz", "Hz", ParameterRole.SHAPE, 20.0, 0.3, 100.0, "of the loop", tried=(1.0, 2.0, 4.0, 8.0, 16.0)
        ),
        EffectParameter(
            "damping",
            "1",
            ParameterRole.SHAPE,
            0.7,
            0.1,
            0.95,
            "share of critical",
            tried=(0.35, 0.8),
            possible=(0.001, 0.999),
        ),
    )

    def moved(self, time_s: FloatArray, command_mm: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the position of the loop."""
        lag, damping = values["lag_s"], values["damping"]
        frequency = values["frequency_hz"]
        if lag > 0:
            frequency = min(frequency, damping / (np.pi * lag))
        share = lag * np.pi * frequency / damping
        behind = command_mm - resonator(time_s, command_mm, frequency, damping)
        return np.asarray(command_mm - share * behind)


EFFECT = ServoLag()
