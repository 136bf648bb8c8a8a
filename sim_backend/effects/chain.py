"""Active effects combined from the command to the recorded channels.

The command goes through the motor effects; the forces of wall and interface are added to the nominal one; then come the
force gain and the sensor effects, in their order from the payload to the channel's clock; the position goes through the
encoder effects. Within each step ids decide the order, and the order of the settings between two of one id.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from dragrig.config.errors import SettingsError
from dragrig.config.friction_model import EffectSettings, FrictionModelSettings
from dragrig.config.settings import suggestion
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Channel, Effect, Values, find_effect
from dragrig.sim_backend.effects.run_state import RunState

MAX_RATE_HZ = 2000.0
"""Effects are computed at the sample rate, but not faster than this; between times they are interpolated linearly."""
MAX_TIMES = 250_000
"""Longer runs are computed at fewer times a second, so that memory suffices."""
SIMULATED_NOMINAL = "capsule"
"""The nominal model that the simulated rig has."""


@dataclass(frozen=True, slots=True)
class ActiveEffect:
    """An effect with the values of all its parameters."""

    effect: Effect
    values: Values


def active_effects(settings: FrictionModelSettings) -> tuple[ActiveEffect, ...]:
    """Return the effects that a model has, with default values of the parameters that it does not name.

    Raises
    ------
    SettingsError
        For an unknown effect or parameter, an impossible value, and an effect of another model.
    """
    return tuple(_active_effect(entry) for entry in settings.effects)


def _active_effect(entry: EffectSettings) -> ActiveEffect:
    effect = find_effect(entry.id)
    if effect.nominal not in {"", SIMULATED_NOMINAL}:
        raise SettingsError(
            f"effect {effect.id}: belongs to the model {effect.nominal}, which is not the simulated rig's."
        )
    parameters = {parameter.name: parameter for parameter in effect.parameters}
    for name, value in entry.parameters.items():
        if name not in parameters:
            raise SettingsError(f"effect {effect.id}: has no parameter {name}; {suggestion(name, list(parameters))}")
        parameter = parameters[name]
        if not parameter.allows(value):
            unit = "" if parameter.unit == "1" else f" {parameter.unit}"
            raise SettingsError(
                f"effect {effect.id}: {name} = {value:g} is not possible; "
                f"usual are {parameter.low:g} to {parameter.high:g}{unit}."
            )
    return ActiveEffect(effect, {**effect.defaults, **entry.parameters})


@dataclass(frozen=True, slots=True)
class EffectChain:
    """Effects in the order in which they act; none by default."""

    effects: tuple[ActiveEffect, ...] = ()

    @classmethod
    def of(cls, settings: FrictionModelSettings) -> "EffectChain":
        """Put the effects of a model in order; raises `SettingsError` as `active_effects`."""
        return cls().with_effects(sorted(active_effects(settings), key=lambda active: active.effect.id))

    def with_effects(self, further: Iterable[ActiveEffect]) -> "EffectChain":
        """Return the chain with further effects, which act after those of the same link."""
        return EffectChain(tuple(sorted((*self.effects, *further), key=lambda active: active.effect.link)))

    def only(self, condition: Callable[[Effect], bool]) -> "EffectChain":
        """Return the effects that meet a condition."""
        return EffectChain(tuple(active for active in self.effects if condition(active.effect)))

    @property
    def moves_stage(self) -> bool:
        """Whether the stage goes elsewhere than commanded."""
        return any(active.effect.moves_stage for active in self.effects)

    @property
    def changes_position(self) -> bool:
        """Whether the recorded position differs from the command."""
        return any(active.effect.channel is Channel.POSITION for active in self.effects)

    def stage_position(self, time_s: FloatArray, command_mm: FloatArray) -> FloatArray:
        """Return where the stage is [mm] when it is commanded to be elsewhere, shapes `(n,)`."""
        for active in self.effects:
            command_mm = active.effect.stage_position(time_s, command_mm, active.values)
        return command_mm

    def load(self, run: RunState) -> FloatArray:
        """Return the true force on the capsule [mN], shape `(n,)`."""
        gut = (active for active in self.effects if active.effect.in_gut)
        return np.asarray(sum((active.effect.added_force(run, active.values) for active in gut), run.nominal))

    def measured_force(self, run: RunState, load_mN: FloatArray, force_gain: float) -> FloatArray:
        """Return what the force channel shows [mN] of a true force, shapes `(n,)`, without noise."""
        force = force_gain * load_mN
        for active in self.effects:
            force = active.effect.measured_force(run, force, active.values)
        return force

    def counted_position(self, time_s: FloatArray, position_mm: FloatArray) -> FloatArray:
        """Return the position that is counted [mm] of a true one, shapes `(n,)`."""
        for active in self.effects:
            position_mm = active.effect.counted_position(time_s, position_mm, active.values)
        return position_mm


def evaluation_rate_hz(rate_hz: float, duration_s: float) -> float:
    """Return at how many times a second effects are computed for a run of this length and sample rate."""
    return min(rate_hz, MAX_RATE_HZ, MAX_TIMES / max(duration_s, 1.0))


def evaluation_times(duration_s: float, rate_hz: float) -> FloatArray:
    """Return times from 0 on at a rate, and the end [s]."""
    whole = max(int(np.ceil(duration_s * rate_hz - 1e-6)), 1)
    return np.append(np.arange(whole) / rate_hz, max(duration_s, 1e-6))
