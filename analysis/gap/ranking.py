"""Every shape of every effect against what is left: which explains most of it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from math import atan2, hypot

import numpy as np

from dragrig.analysis.gap.candidate import Candidate
from dragrig.analysis.gap.signatures import Shape
from dragrig.analysis.gap.solving import Projected
from dragrig.rig.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Ranked:
    """The best shape of an effect.

    Attributes
    ----------
    gain
        Half the whitened squares that it takes away.
    per_unit
        d′ of the effect at its usual size: the norm of its signature once nuisances are taken out.
    shapes
        Columns of the dictionary, two for a periodic shape.
    amplitude
        Their coefficients, in usual sizes.
    """

    effect: str
    gain: float
    per_unit: float
    shapes: tuple[int, ...]
    amplitude: FloatArray

    def candidate(self, dictionary: Sequence[Shape], amplitude: FloatArray | None = None) -> Candidate:
        """Return the effect with the values of this shape, its size as fitted here or as given."""
        shape = dictionary[self.shapes[0]]
        effect, found = shape.effect, self.amplitude if amplitude is None else amplitude
        values = dict(shape.values)
        phase = effect.phase
        if phase is None:
            values[effect.size.name] *= float(found[0])
        else:
            values[effect.size.name] *= hypot(*found.tolist())
            values[phase.name] = atan2(float(found[1]), float(found[0]))
        size = values[effect.size.name]
        values[effect.size.name] = float(np.clip(size, effect.size.low, effect.size.high))
        return Candidate(effect, values)


def rank(projected: Projected, dictionary: Sequence[Shape]) -> tuple[Ranked, ...]:
    """Return the best shape of every effect, the best effect first."""
    found: dict[str, Ranked] = {}
    for one in _tried(projected, dictionary):
        if one.effect not in found or one.gain > found[one.effect].gain:
            found[one.effect] = one
    return tuple(sorted(found.values(), key=lambda one: -one.gain))


def _tried(projected: Projected, dictionary: Sequence[Shape]) -> Iterator[Ranked]:
    numbered = list(enumerate(dictionary))
    for _, group in groupby(numbered, key=lambda pair: (pair[1].effect.id, pair[1].twin)):
        index = [number for number, _ in group]
        shape = dictionary[index[0]]
        gram, along = projected.gram[np.ix_(index, index)], projected.along[index]
        strength = float(np.trace(gram)) / len(index)
        if strength <= 1e-9:
            continue
        amplitude = np.asarray(np.linalg.solve(gram + 1e-9 * strength * np.eye(len(index)), along), dtype=np.float64)
        gain = 0.5 * float(along @ amplitude)
        if shape.signed and amplitude[0] < 0:
            gain, amplitude = 0.0, 0.0 * amplitude
        yield Ranked(shape.effect.id, gain, float(np.sqrt(strength)), tuple(index), amplitude)
