"""Effects as candidates: the dictionary of their signatures, and the derivatives of the force by their parameters."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import pi

import numpy as np

from dragrig.config.friction_model import EffectSettings
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import ActiveEffect, Channel, Effect, EffectChain, EffectParameter, Role
from dragrig.sim_backend.effects.run_state import RunState


@dataclass(frozen=True, slots=True, eq=False)
class EffectVariant:
    """One shape of an effect: values of all its parameters, its size at the usual.

    Attributes
    ----------
    effect
        The effect.
    values
        All parameters.
    quarter
        For what is periodic: whether it is a quarter of a period late.
    """

    effect: Effect
    values: Mapping[str, float]
    quarter: bool = False

    @property
    def signed(self) -> bool:
        """Whether the amplitude has one sign only."""
        return self.effect.size.low >= 0 and self.effect.phase is None

    @property
    def twin(self) -> tuple[tuple[str, float], ...]:
        """What it shares with the same shape a quarter of a period late."""
        phase = self.effect.phase
        return tuple((name, value) for name, value in self.values.items() if phase is None or name != phase.name)


def variants_of(effects: Sequence[Effect]) -> tuple[EffectVariant, ...]:
    """Return every shape that a diagnosis looks at, those of the force channel."""
    return tuple(shape for effect in effects if effect.channel is Channel.FORCE for shape in _variants(effect))


def _variants(effect: Effect) -> Iterator[EffectVariant]:
    grids = [one.start_values for one in effect.shapes]
    for chosen in product(*grids):
        values = {**effect.defaults, **{one.name: value for one, value in zip(effect.shapes, chosen, strict=True)}}
        phase = effect.phase
        if phase is None:
            yield EffectVariant(effect, values)
            continue
        yield EffectVariant(effect, {**values, phase.name: 0.0})
        yield EffectVariant(effect, {**values, phase.name: 0.5 * pi}, quarter=True)


def signature(shape: EffectVariant, scene: RunState, gain: float) -> FloatArray:
    """Return what the channel shows more with the effect at its usual size, shape `(n,)`."""
    return shape.effect.force_change(scene, shape.values, gain)


def signatures(
    shapes: Sequence[EffectVariant], scene: RunState, gain: float, before: FloatArray | None = None
) -> FloatArray:
    """Return the signatures of shapes in one run, shape `(S, n)`.

    Parameters
    ----------
    before
        Those in a run that this one repeats, of which only what depends on the session is computed again.
    """
    whole = np.empty((len(shapes), scene.time_s.size)) if before is None else before.copy()
    for row, shape in zip(whole, shapes, strict=True):
        if before is None or shape.effect.varies_in_session:
            row[:] = signature(shape, scene, gain)
    return whole


DERIVATIVE_STEP = 0.02
"""Step of a derivative, relative to the value or to what is usual."""
SHAPE_PRIOR_SD = 0.5
"""Prior standard deviation of a shape's values, relative."""
PHASE_PRIOR_SD_RAD = 2.0
MIN_SIZE_FACTOR = 0.2
AT_LIMIT_RATIO = 0.99
MAX_RELATIVE_STEP = 0.35
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
        return tuple(one for one in self.effect.parameters if one.role is not Role.SHAPE or len(one.grid) > 1)

    @property
    def at_limit(self) -> bool:
        """Whether its size is at an end of what can be; a share of all of something may well be all of it."""
        size = self.effect.size
        value = self.values[size.name]
        return size.high != 1.0 and (
            value >= AT_LIMIT_RATIO * size.high or (size.low < 0 and value <= AT_LIMIT_RATIO * size.low)
        )

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
            return -2 * MAX_RELATIVE_STEP, 2 * MAX_RELATIVE_STEP
        if one.role is Role.SIZE:
            # A step that overshoots must not end at nothing, where no shape matters any more.
            low = one.low if one.low < 0 else max(one.low, MIN_SIZE_FACTOR * now)
            return low - now, one.high - now
        most = MAX_RELATIVE_STEP * max(abs(now), 1e-3 * abs(one.high))
        return max(one.low - now, -most), min(one.high - now, most)

    def step(self, one: EffectParameter) -> float:
        """Return the step that a derivative by a parameter is taken with."""
        value = self.values[one.name]
        if one.role is Role.PHASE:
            return DERIVATIVE_STEP
        if one.role is Role.SIZE:
            return DERIVATIVE_STEP * max(abs(value), 0.05 * abs(one.default))
        step = DERIVATIVE_STEP * max(abs(value), 1e-3 * abs(one.high))
        return step if value + step <= one.high else -step

    def _prior_sd(self, one: EffectParameter) -> float:
        if one.role is Role.SIZE:
            return 10.0 * max(abs(one.high), abs(one.low), abs(one.default))
        if one.role is Role.PHASE:
            return PHASE_PRIOR_SD_RAD
        return SHAPE_PRIOR_SD * max(abs(self.values[one.name]), 1e-3 * abs(one.high))


def chain_with(candidates: Sequence[Candidate], before: EffectChain) -> EffectChain:
    """Return the chain of effects that a model has already and of those thought to act."""
    by_id = sorted(candidates, key=lambda candidate: candidate.effect.id)
    return before.with_effects(ActiveEffect(candidate.effect, candidate.values) for candidate in by_id)


def added_force(chain: EffectChain, scene: RunState, gain: float) -> FloatArray:
    """Return what effects add to the force that the channel would show without them, shape `(n,)`."""
    return np.asarray(chain.measured_force(scene, chain.load(scene), gain) - gain * scene.nominal)


def parameter_derivatives(
    candidates: Sequence[Candidate], before: EffectChain, scene: RunState, gain: float
) -> FloatArray:
    """Return derivatives of what is shown by the candidates' fitted parameters in turn, shape `(E, n)`."""
    now = added_force(chain_with(candidates, before), scene, gain)
    rows = []
    for index, candidate in enumerate(candidates):
        for one in candidate.fitted:
            step = candidate.step(one)
            values = {**candidate.values, one.name: candidate.values[one.name] + step}
            changed = [*candidates]
            changed[index] = replace(candidate, values=values)
            rows.append((added_force(chain_with(changed, before), scene, gain) - now) / step)
    return np.array(rows).reshape(len(rows), now.size)
