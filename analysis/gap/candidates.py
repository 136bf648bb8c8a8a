"""Effects as candidates: the dictionary of their signatures, and the derivatives of the force by their parameters."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import pi

import numpy as np

from dragrig.config import EffectSettings
from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import ActiveEffect, Channel, Effect, EffectChain, EffectParameter, Role, RunState


@dataclass(frozen=True, slots=True, eq=False)
class EffectVariant:
    """An effect with one combination of its shape parameters, its size at the default."""

    effect: Effect
    """The effect."""
    values: Mapping[str, float]
    """Values of all parameters."""
    is_quadrature: bool = False
    """For a periodic effect: whether it is shifted by a quarter of a period."""

    @property
    def one_signed(self) -> bool:
        """Whether the amplitude can have one sign only."""
        return self.effect.size.low >= 0 and self.effect.phase is None

    @property
    def quadrature_key(self) -> tuple[tuple[str, float], ...]:
        """Parameters without the phase, which are equal in both quadratures of a periodic variant."""
        phase = self.effect.phase
        return tuple((name, value) for name, value in self.values.items() if phase is None or name != phase.name)


def variants_of(effects: Sequence[Effect]) -> tuple[EffectVariant, ...]:
    """Return the dictionary: all variants of the effects that act on the force channel."""
    return tuple(variant for effect in effects if effect.channel is Channel.FORCE for variant in _variants(effect))


def _variants(effect: Effect) -> Iterator[EffectVariant]:
    grids = [parameter.start_values for parameter in effect.shapes]
    for combination in product(*grids):
        values = {
            **effect.defaults,
            **{parameter.name: value for parameter, value in zip(effect.shapes, combination, strict=True)},
        }
        phase = effect.phase
        if phase is None:
            yield EffectVariant(effect, values)
            continue
        yield EffectVariant(effect, {**values, phase.name: 0.0})
        yield EffectVariant(effect, {**values, phase.name: 0.5 * pi}, is_quadrature=True)


def signature(variant: EffectVariant, scene: RunState, gain: float) -> FloatArray:
    """Return the change of the measured force by a variant at its default size, shape `(n,)`."""
    return variant.effect.force_change(scene, variant.values, gain)


def signatures(
    variants: Sequence[EffectVariant], scene: RunState, gain: float, repeated: FloatArray | None = None
) -> FloatArray:
    """Return the signatures of variants in one run, shape `(S, n)`.

    Parameters
    ----------
    repeated
        Signatures in a run that this run repeats; only those that vary within the session are computed again.
    """
    rows = np.empty((len(variants), scene.time_s.size)) if repeated is None else repeated.copy()
    for row, variant in zip(rows, variants, strict=True):
        if repeated is None or variant.effect.varies_in_session:
            row[:] = signature(variant, scene, gain)
    return rows


DERIVATIVE_STEP = 0.02
"""Step of a numerical derivative, relative to the value or its default."""
SHAPE_PRIOR_SD = 0.5
"""Prior standard deviation of a shape parameter, relative."""
PHASE_PRIOR_SD_RAD = 2.0
MIN_SIZE_FACTOR = 0.2
AT_LIMIT_RATIO = 0.99
MAX_RELATIVE_STEP = 0.35
"""Largest relative change of a shape parameter in one fit step; of a phase twice as much, in rad."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """An effect with values of its parameters, as a hypothesis assumes it."""

    effect: Effect
    values: Mapping[str, float]

    @property
    def settings(self) -> EffectSettings:
        """The effect as in a friction model's settings."""
        return EffectSettings(id=self.effect.id, parameters=dict(self.values))

    @property
    def fitted_parameters(self) -> tuple[EffectParameter, ...]:
        """Parameters to be fitted: size, phase, and shape parameters that have a grid."""
        return tuple(
            parameter
            for parameter in self.effect.parameters
            if parameter.role is not Role.SHAPE or len(parameter.grid) > 1
        )

    @property
    def at_limit(self) -> bool:
        """Whether the size is at its bound. A bound of 1 does not count: a share may well be all of it."""
        size = self.effect.size
        value = self.values[size.name]
        return size.high != 1.0 and (
            value >= AT_LIMIT_RATIO * size.high or (size.low < 0 and value <= AT_LIMIT_RATIO * size.low)
        )

    def prior_sds(self) -> FloatArray:
        """Return prior standard deviations of the fitted parameters; wide ones for the size."""
        return np.array([self._prior_sd(parameter) for parameter in self.fitted_parameters])

    def step_bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the most negative and most positive steps of the fitted parameters, shape `(p,)` each."""
        low, high = zip(*(self._step_bounds_of(parameter) for parameter in self.fitted_parameters), strict=True)
        return np.array(low), np.array(high)

    def moved(self, steps: FloatArray) -> "Candidate":
        """Return the candidate after a step of its fitted parameters, limited to the step bounds."""
        within = np.clip(steps, *self.step_bounds())
        moved = {
            parameter.name: self.values[parameter.name] + step
            for parameter, step in zip(self.fitted_parameters, within.tolist(), strict=True)
        }
        return replace(self, values={**self.values, **moved})

    def _step_bounds_of(self, parameter: EffectParameter) -> tuple[float, float]:
        value = self.values[parameter.name]
        if parameter.role is Role.PHASE:
            return -2 * MAX_RELATIVE_STEP, 2 * MAX_RELATIVE_STEP
        if parameter.role is Role.SIZE:
            # A step that overshoots must not reach size 0, where the shape parameters have no influence.
            low = parameter.low if parameter.low < 0 else max(parameter.low, MIN_SIZE_FACTOR * value)
            return low - value, parameter.high - value
        max_step = MAX_RELATIVE_STEP * max(abs(value), 1e-3 * abs(parameter.high))
        return max(parameter.low - value, -max_step), min(parameter.high - value, max_step)

    def derivative_step(self, parameter: EffectParameter) -> float:
        """Return the step of the numerical derivative by a parameter."""
        value = self.values[parameter.name]
        if parameter.role is Role.PHASE:
            return DERIVATIVE_STEP
        if parameter.role is Role.SIZE:
            return DERIVATIVE_STEP * max(abs(value), 0.05 * abs(parameter.default))
        step = DERIVATIVE_STEP * max(abs(value), 1e-3 * abs(parameter.high))
        return step if value + step <= parameter.high else -step

    def _prior_sd(self, parameter: EffectParameter) -> float:
        if parameter.role is Role.SIZE:
            return 10.0 * max(abs(parameter.high), abs(parameter.low), abs(parameter.default))
        if parameter.role is Role.PHASE:
            return PHASE_PRIOR_SD_RAD
        return SHAPE_PRIOR_SD * max(abs(self.values[parameter.name]), 1e-3 * abs(parameter.high))


def chain_with(candidates: Sequence[Candidate], known: EffectChain) -> EffectChain:
    """Return the effects of the nominal model together with candidates."""
    by_id = sorted(candidates, key=lambda candidate: candidate.effect.id)
    return known.with_effects(ActiveEffect(candidate.effect, candidate.values) for candidate in by_id)


def added_force(chain: EffectChain, scene: RunState, gain: float) -> FloatArray:
    """Return the change of the measured force by a chain of effects, shape `(n,)`."""
    return np.asarray(chain.measured_force(scene, chain.load(scene), gain) - gain * scene.nominal)


def parameter_derivatives(
    candidates: Sequence[Candidate], known: EffectChain, scene: RunState, gain: float
) -> FloatArray:
    """Return derivatives of the measured force by the candidates' fitted parameters in turn, shape `(E, n)`."""
    baseline = added_force(chain_with(candidates, known), scene, gain)
    rows = []
    for index, candidate in enumerate(candidates):
        for parameter in candidate.fitted_parameters:
            step = candidate.derivative_step(parameter)
            values = {**candidate.values, parameter.name: candidate.values[parameter.name] + step}
            changed = [*candidates]
            changed[index] = replace(candidate, values=values)
            rows.append((added_force(chain_with(changed, known), scene, gain) - baseline) / step)
    return np.array(rows).reshape(len(rows), baseline.size)
