"""What each effect would change in each run, for every shape that it may have: the dictionary of a diagnosis."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import pi

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Effect, ForceEffect, SensorEffect
from dragrig.sim_backend.effects.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
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


def shapes_of(effects: Sequence[Effect]) -> tuple[Shape, ...]:
    """Return every shape that a diagnosis looks at, those of the force channel."""
    return tuple(shape for effect in effects if isinstance(effect, ForceEffect | SensorEffect) for shape in _of(effect))


def _of(effect: Effect) -> Iterator[Shape]:
    grids = [one.tried or (one.usual,) for one in effect.shapes]
    for chosen in product(*grids):
        values = {**effect.usual, **{one.name: value for one, value in zip(effect.shapes, chosen, strict=True)}}
        phase = effect.phase
        if phase is None:
            yield Shape(effect, values)
            continue
        yield Shape(effect, {**values, phase.name: 0.0})
        yield Shape(effect, {**values, phase.name: 0.5 * pi}, quarter=True)


def signature(shape: Shape, scene: Scene, gain: float) -> FloatArray:
    """Return what the channel shows more with the effect at its usual size, shape `(n,)`."""
    effect = shape.effect
    if isinstance(effect, ForceEffect):
        return gain * effect.added(scene, shape.values)
    if isinstance(effect, SensorEffect):
        force = gain * scene.nominal
        return effect.shown(scene, force, shape.values) - force
    return np.zeros_like(scene.time_s)


def signatures(shapes: Sequence[Shape], scene: Scene, gain: float, before: FloatArray | None = None) -> FloatArray:
    """Return the signatures of shapes in one run, shape `(S, n)`.

    Parameters
    ----------
    before
        Those in a run that this one repeats, of which only what depends on the session is computed again.
    """
    whole = np.empty((len(shapes), scene.time_s.size)) if before is None else before.copy()
    for row, shape in zip(whole, shapes, strict=True):
        if before is None or shape.effect.of_session:
            row[:] = signature(shape, scene, gain)
    return whole
