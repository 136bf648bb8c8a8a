"""An effect with values of its parameters, and what a small change of each does to the shown force."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.config.effects import EffectSettings
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.applied import Chain
from dragrig.sim_backend.effects.base import (
    Effect,
    EffectParameter,
    EncoderEffect,
    ForceEffect,
    MotorEffect,
    Role,
    SensorEffect,
)
from dragrig.sim_backend.effects.scene import Scene

STEP = 0.02
"""Step of a derivative, relative to the value or to what is usual."""
SHAPE_SD = 0.5
"""Prior standard deviation of a shape's values, relative."""
PHASE_SD = 2.0
LEAST_FACTOR = 0.2
NEAR_END = 0.99
LONGEST_STEP = 0.35
"""So far a shape may move in one step of a fit, relative; a phase, in rad, twice as far."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """An effect that is thought to act."""

    effect: Effect
    values: Mapping[str, float]

    @property
    def settings(self) -> EffectSettings:
        """As a model's settings have it."""
        return EffectSettings(id=self.effect.id, parameters=dict(self.values))

    @property
    def fitted(self) -> tuple[EffectParameter, ...]:
        """Parameters that runs are to determine: the size, a phase, and shapes of which several are tried."""
        return tuple(one for one in self.effect.parameters if one.role is not Role.SHAPE or len(one.tried) > 1)

    @property
    def at_limit(self) -> bool:
        """Whether its size is at an end of what can be; a share of all of something may well be all of it."""
        size = self.effect.size
        value = self.values[size.name]
        return size.high != 1.0 and (value >= NEAR_END * size.high or (size.low < 0 and value <= NEAR_END * size.low))

    def prior_sds(self) -> FloatArray:
        """Return prior standard deviations of the fitted parameters, wide ones for the size."""
        return np.array([self._prior_sd(one) for one in self.fitted])

    def reach(self) -> tuple[FloatArray, FloatArray]:
        """Return the least and the largest steps that its fitted parameters may make at once, shape `(p,)` each."""
        low, high = zip(*(self._reach(one) for one in self.fitted), strict=True)
        return np.array(low), np.array(high)

    def moved(self, steps: FloatArray) -> "Candidate":
        """Return the candidate after a step of its fitted parameters, kept within its reach."""
        within = np.clip(steps, *self.reach())
        moved = {one.name: self.values[one.name] + step for one, step in zip(self.fitted, within.tolist(), strict=True)}
        return replace(self, values={**self.values, **moved})

    def _reach(self, one: EffectParameter) -> tuple[float, float]:
        now = self.values[one.name]
        if one.role is Role.PHASE:
            return -2 * LONGEST_STEP, 2 * LONGEST_STEP
        if one.role is Role.SIZE:
            # A step that overshoots must not end at nothing, where no shape matters any more.
            low = one.low if one.low < 0 else max(one.low, LEAST_FACTOR * now)
            return low - now, one.high - now
        most = LONGEST_STEP * max(abs(now), 1e-3 * abs(one.high))
        return max(one.low - now, -most), min(one.high - now, most)

    def step(self, one: EffectParameter) -> float:
        """Return the step that a derivative by a parameter is taken with."""
        value = self.values[one.name]
        if one.role is Role.PHASE:
            return STEP
        if one.role is Role.SIZE:
            return STEP * max(abs(value), 0.05 * abs(one.usual))
        step = STEP * max(abs(value), 1e-3 * abs(one.high))
        return step if value + step <= one.high else -step

    def _prior_sd(self, one: EffectParameter) -> float:
        if one.role is Role.SIZE:
            return 10.0 * max(abs(one.high), abs(one.low), abs(one.usual))
        if one.role is Role.PHASE:
            return PHASE_SD
        return SHAPE_SD * max(abs(self.values[one.name]), 1e-3 * abs(one.high))


def chain_of(candidates: Sequence[Candidate], before: Chain) -> Chain:
    """Return the chain of effects that a model has already and of those thought to act."""
    pairs = [(one.effect, one.values) for one in sorted(candidates, key=lambda one: one.effect.id)]
    sensor = [*before.sensor, *((effect, values) for effect, values in pairs if isinstance(effect, SensorEffect))]
    return Chain(
        motor=(*before.motor, *((effect, values) for effect, values in pairs if isinstance(effect, MotorEffect))),
        gut=(*before.gut, *((effect, values) for effect, values in pairs if isinstance(effect, ForceEffect))),
        sensor=tuple(sorted(sensor, key=lambda one: one[0].link)),
        encoder=(*before.encoder, *((effect, values) for effect, values in pairs if isinstance(effect, EncoderEffect))),
    )


def added(chain: Chain, scene: Scene, gain: float) -> FloatArray:
    """Return what effects add to the force that the channel would show without them, shape `(n,)`."""
    return np.asarray(chain.shown(scene, chain.load(scene), gain) - gain * scene.nominal)


def slopes(candidates: Sequence[Candidate], before: Chain, scene: Scene, gain: float) -> FloatArray:
    """Return derivatives of what is shown by the candidates' fitted parameters in turn, shape `(E, n)`."""
    now = added(chain_of(candidates, before), scene, gain)
    rows = []
    for index, candidate in enumerate(candidates):
        for one in candidate.fitted:
            step = candidate.step(one)
            values = {**candidate.values, one.name: candidate.values[one.name] + step}
            changed = [*candidates]
            changed[index] = replace(candidate, values=values)
            rows.append((added(chain_of(changed, before), scene, gain) - now) / step)
    return np.array(rows).reshape(len(rows), now.size)
