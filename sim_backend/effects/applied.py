"""Effects that are switched on, put together from the command to what the file says.

The command goes through the motor effects; the forces of wall and interface are added to the nominal one; then come the
force gain and the sensor effects, link by link from the payload to the channel's clock; the position goes through the
encoder effects. Within each step ids decide the order, and the settings between two of one id.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dragrig.config.effects import EffectSettings
from dragrig.config.errors import SettingsError
from dragrig.config.loading import nearest
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Effect, EncoderEffect, ForceEffect, MotorEffect, SensorEffect
from dragrig.sim_backend.effects.catalogue import find_effect
from dragrig.sim_backend.effects.scene import Scene

FINEST_HZ = 2000.0
"""Effects are computed at the sample rate, but not faster than this; from one time to the next they go straight."""
MOST_TIMES = 250_000
"""Longer runs are computed at fewer times a second, so that memory lasts."""
NOMINAL = "capsule"
"""The nominal model that the simulated rig has."""


@dataclass(frozen=True, slots=True)
class SwitchedOn:
    """An effect with the values of all its parameters."""

    effect: Effect
    values: Mapping[str, float]


def switched_on(settings: FrictionModelSettings) -> tuple[SwitchedOn, ...]:
    """Return the effects that a model has, with the usual values of what it does not name.

    Raises
    ------
    SettingsError
        For an effect or a parameter that there is not, a value that cannot be, and an effect of another model.
    """
    return tuple(_switched_on(one) for one in settings.effects)


def _switched_on(given: EffectSettings) -> SwitchedOn:
    effect = find_effect(given.id)
    if effect.nominal not in {"", NOMINAL}:
        raise SettingsError(
            f"effect {effect.id}: belongs to the model {effect.nominal}, which is not the simulated rig's."
        )
    known = {one.name: one for one in effect.parameters}
    for name, value in given.parameters.items():
        if name not in known:
            raise SettingsError(f"effect {effect.id}: has no parameter {name}; {nearest(name, list(known))}")
        if not known[name].allows(value):
            parameter = known[name]
            usual = f"{parameter.low:g} to {parameter.high:g} {'' if parameter.unit == '1' else parameter.unit}".strip()
            raise SettingsError(f"effect {effect.id}: {name} = {value:g} cannot be; usual are {usual}.")
    return SwitchedOn(effect, {**effect.usual, **given.parameters})


@dataclass(frozen=True, slots=True)
class Chain:
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
    def of(cls, settings: FrictionModelSettings) -> "Chain":
        """Put the effects of a model in order; raises `SettingsError` as `switched_on`."""
        found = sorted(switched_on(settings), key=lambda one: one.effect.id)
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

    def load(self, scene: Scene) -> FloatArray:
        """Return the true force on the capsule [mN], shape `(n,)`."""
        return np.asarray(sum((effect.added(scene, values) for effect, values in self.gut), scene.nominal))

    def shown(self, scene: Scene, load_mN: FloatArray, force_gain: float) -> FloatArray:
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


def computing_rate_hz(rate_hz: float, duration_s: float) -> float:
    """Return at how many times a second effects are computed for a run of this length and sample rate."""
    return min(rate_hz, FINEST_HZ, MOST_TIMES / max(duration_s, 1.0))


def even_times(duration_s: float, rate_hz: float) -> FloatArray:
    """Return times from 0 on at a rate, and the end [s]."""
    whole = max(int(np.ceil(duration_s * rate_hz - 1e-6)), 1)
    return np.append(np.arange(whole) / rate_hz, max(duration_s, 1e-6))
