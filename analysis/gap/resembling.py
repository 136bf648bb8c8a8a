"""Whether what an effect of the sensor adds may as well be friction that changes along the way, as far as runs show."""

from collections.abc import Sequence

import numpy as np

from dragrig.analysis.gap.design import Design, Part
from dragrig.analysis.gap.sights import Sight
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import Phase

ALIKE = 0.8
"""Part of an effect's whitened squares, the model's own parameters free, from which on it is the same."""
LENGTHS = 8
"""Ways, from a hundredth of the longest on, over which friction may evolve."""
POWERS = (1, 2, 3)


def like_friction(design: Design, sights: Sequence[Sight]) -> bool:
    """Tell whether the candidates of a design add what a smooth function of the way, the same in all runs, adds too.

    Friction has the sign of the motion and is not there at rest. Runs at several speeds, in both directions or with
    rests tell it from what is a function of time or of the force.
    """
    added = np.concatenate([part.whitening.whole(part.added) for part in design.parts])
    if not np.any(added):
        return False
    rows = []
    longest = max(float(np.ptp(one.coordinates.position_mm)) for one in sights)
    for sight, part in zip(sights, design.parts, strict=True):
        own = np.hstack((part.columns[:, design.of(Part.NOMINAL)], _along(sight, longest)))
        rows.append(part.whitening.whole(own))
    columns = np.concatenate(rows)
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0] / size[size > 0]
    nominal = np.concatenate([part.whitening.whole(part.columns[:, design.of(Part.NOMINAL)]) for part in design.parts])
    beside = _left(nominal, added)
    return bool(beside > 0 and _left(columns, added) < (1 - ALIKE) * beside)


def _left(columns: FloatArray, values: FloatArray) -> float:
    found = np.linalg.lstsq(columns, values, rcond=1e-10)[0]
    return float(np.sum((values - columns @ found) ** 2))


def _along(sight: Sight, longest_mm: float) -> FloatArray:
    """Return smooth functions of the way with the sign of the motion, shape `(B, K)`."""
    at = sight.coordinates
    way = np.abs(at.position_mm - at.position_mm[0]) / max(longest_mm, 1e-12)
    slow = np.sign(sight.experiment.velocity(at.time_s))
    # The smallest speeds are rests to an encoder of 1 µm; a steady motion goes its run's way all the same.
    sign = np.where(at.phase == Phase.STEADY, _heading(sight), slow)
    shapes = [way**power for power in POWERS] + [np.exp(-way / length) for length in np.geomspace(0.01, 1, LENGTHS)]
    return np.asarray(sign[:, None] * np.stack(shapes, axis=1))


def _heading(sight: Sight) -> float:
    position = sight.coordinates.position_mm
    return float(np.sign(position[-1] - position[0])) or 1.0
