"""A stage that lags behind its command, and overshoots it."""

from collections.abc import Mapping
from typing import ClassVar

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Domain, EffectParameter, MotorEffect, Place, Role
from dragrig.sim_backend.effects.dynamics import resonator


class ServoLag(MotorEffect):
    """The position loop as a damped oscillator that follows the command, `2 ζ / ω` behind."""

    id: ClassVar[str] = "servo_lag"
    place: ClassVar[Place] = Place.MOTOR
    domain: ClassVar[Domain] = Domain.TRANSIENT
    summary: ClassVar[str] = "The stage lags behind its command and overshoots at the end."
    exposes: ClassVar[str] = "position against command, in proportion to speed"
    source: ClassVar[str] = "second-order servo loop; Ellis, Control System Design Guide, chapter 3"
    aliases: ClassVar[tuple[str, ...]] = ()
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("lag_s", "s", Role.SIZE, 0.01, 0.0, 0.1, "time behind the command at constant speed"),
        EffectParameter("damping", "1", Role.SHAPE, 0.7, 0.2, 0.95, "share of critical", tried=(0.3, 0.5, 0.7, 0.9)),
    )

    def moved(self, time_s: FloatArray, command_mm: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the position of the loop."""
        lag, damping = values["lag_s"], values["damping"]
        if lag <= 0:
            return command_mm.copy()
        return resonator(time_s, command_mm, damping / (3.141592653589793 * lag), damping)


EFFECT = ServoLag()
