"""Active effects combined from the command to the recorded channels.

The command goes through the motor effects; the forces of wall and interface are added to the nominal one; then come the
force gain and the sensor effects, in their order from the payload to the channel's clock; the position goes through the
encoder effects. Within each step ids decide the order, and the order of the settings between two of one id.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dragrig.config.errors import SettingsError
from dragrig.config.friction_model import EffectSettings, FrictionModelSettings
from dragrig.config.settings import suggestion
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Effect, EncoderEffect, ForceEffect, MotorEffect, SensorEffect, find_effect
from dragrig.sim_backend.effects.run_state import RunState

MAX_RATE_HZ = 2000.0
"""Effects are computed at the sample rate, but not faster than this; from one time to the next they go straight."""
MAX_TIMES = 250_000
"""Longer runs are computed at fewer times a second, so that memory lasts."""
SIMULATED_NOMINAL = "capsule"
"""The nominal model that the simulated rig has."""


@dataclass(frozen=True, slots=True)
class ActiveEffect:
    """An effect with the values of all its parameters."""

    effect: Effect
    values: Mapping[str, float]


def active_effects(settings: FrictionModelSettings) -> tuple[ActiveEffect, ...]:
    """Return the effects that a model has, with the usual values of what it does not name.

    Raises
    ------
    SettingsError
        For an effect or a parameter that there is not, a value that cannot be, and an effect of another model.
    """
    return tuple(_active_effect(one) for one in settings.effects)


def _active_effect(given: EffectSettings) -> ActiveEffect:
    effect = find_effect(given.id)
    if effect.nominal not in {"", SIMULATED_NOMINAL}:
        raise SettingsError(
            f"effect {effect.id}: belongs to the model {effect.nominal}, which is not the simulated rig's."
        )
    known = {one.name: one for one in effect.parameters}
    for name, value in given.parameters.items():
        if name not in known:
            raise SettingsError(f"effect {effect.id}: has no parameter {name}; {suggestion(name, list(known))}")
        if not known[name].allows(value):
            parameter = known[name]
            usual = f"{parameter.low:g} to {parameter.high:g} {'' if parameter.unit == '1' else parameter.unit}".strip()
            raise SettingsError(f"effect {effect.id}: {name} = {value:g} cannot be; usual are {usual}.")
    return ActiveEffect(effect, {**effect.usual, **given.parameters})


@dataclass(frozen=True, slots=True)
class EffectChain:
    """Effects in the order in which they act.

    Attributes
    ----------
    motor, gut, sensor, encoder
        Each effect of the kind with its values.
    """

    motor: tuple[tuple[MotorEffect, Mapping[str, float]], ...]
    gut: tuple[tuple[ForceEffect, Mapping[str, float]], ...]
    sensor: tuple[tuple[SensorEffect, Mapping[str, float]], ...]
    encoder: tuple[tuple[EncoderEffect, Mapping[str, float]], ...]

    @classmethod
    def of(cls, settings: FrictionModelSettings) -> "EffectChain":
        """Put the effects of a model in order; raises `SettingsError` as `active_effects`."""
        found = sorted(active_effects(settings), key=lambda one: one.effect.id)
        sensor = [(one.effect, one.values) for one in found if isinstance(one.effect, SensorEffect)]
        return cls(
            motor=tuple((one.effect, one.values) for one in found if isinstance(one.effect, MotorEffect)),
            gut=tuple((one.effect, one.values) for one in found if isinstance(one.effect, ForceEffect)),
            sensor=tuple(sorted(sensor, key=lambda one: one[0].link)),
            encoder=tuple((one.effect, one.values) for one in found if isinstance(one.effect, EncoderEffect)),
        )

    def moved(self, time_s: FloatArray, command_mm: FloatArray) -> FloatArray:
        """Return where the stage is [mm] when it is told to be somewhere, shapes `(n,)`."""
        for effect, values in self.motor:
            command_mm = effect.moved(time_s, command_mm, values)
        return command_mm

    def load(self, scene: RunState) -> FloatArray:
        """Return the true force on the capsule [mN], shape `(n,)`."""
        return np.asarray(sum((effect.added(scene, values) for effect, values in self.gut), scene.nominal))

    def shown(self, scene: RunState, load_mN: FloatArray, force_gain: float) -> FloatArray:
        """Return what the force channel shows [mN] of a true force, shapes `(n,)`, without noise."""
        force = force_gain * load_mN
        for effect, values in self.sensor:
            force = effect.shown(scene, force, values)
        return force

    def recorded(self, time_s: FloatArray, position_mm: FloatArray) -> FloatArray:
        """Return the position that is counted [mm] of a true one, shapes `(n,)`."""
        for effect, values in self.encoder:
            position_mm = effect.recorded(time_s, position_mm, values)
        return position_mm


def evaluation_rate_hz(rate_hz: float, duration_s: float) -> float:
    """Return at how many times a second effects are computed for a run of this length and sample rate."""
    return min(rate_hz, MAX_RATE_HZ, MAX_TIMES / max(duration_s, 1.0))


def evaluation_times(duration_s: float, rate_hz: float) -> FloatArray:
    """Return times from 0 on at a rate, and the end [s]."""
    whole = max(int(np.ceil(duration_s * rate_hz - 1e-6)), 1)
    return np.append(np.arange(whole) / rate_hz, max(duration_s, 1e-6))
