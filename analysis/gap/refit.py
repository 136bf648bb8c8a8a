"""Refits with all nuisances: of the nominal model alone, and of each candidate beside it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gap.candidate import Candidate
from dragrig.analysis.gap.design import Design, Part, lay_out
from dragrig.analysis.gap.solving import NUISANCES, fit_within
from dragrig.analysis.gap.study import Study
from dragrig.rig.arrays import FloatArray

LONGEST_STEP = 3.0
"""So far a nominal parameter may move in one step, in standard deviations of its prior."""
FURTHEST = 4.5
"""So far it may be from what was known beforehand."""
STILL = 0.1
"""A step below this in all of them is the last."""


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """Nominal parameters in units of their priors, and effects."""

    z: FloatArray
    candidates: tuple[Candidate, ...] = ()


def settle(study: Study, start: Point, steps: int, near: Design | None = None) -> Point:
    """Return where Gauss–Newton steps lead from a point.

    Parameters
    ----------
    steps
        At most so many.
    near
        The campaign around a point nearby, whose derivatives are kept for all steps; taken anew in each unless given.
    """
    point = start
    for _ in range(steps):
        design = lay_out(study, point.z, point.candidates, near=near)
        after = stepped(design)
        moved = float(np.abs(after.z - point.z).max())
        point = after
        if moved < STILL and not point.candidates:
            break
    return point


def stepped(design: Design) -> Point:
    """Return the point that a design leads to, nothing in it moved further than may be."""
    parts = (Part.NOMINAL, Part.DETAIL, Part.EFFECT)
    nominal = np.maximum(-LONGEST_STEP, -FURTHEST - design.z), np.minimum(LONGEST_STEP, FURTHEST - design.z)
    free = np.full(len(design.of(Part.DETAIL)), np.inf)
    reaches = [nominal, (-free, free), *(one.reach() for one in design.candidates)]
    low, high = (np.concatenate(side) for side in zip(*reaches, strict=True))
    found = fit_within(design, design.total(), (low, high), *parts)
    z = np.clip(design.z + found[: len(design.z)], -FURTHEST, FURTHEST)
    steps = found[len(design.z) + len(free) :]
    candidates = []
    for one in design.candidates:
        own, steps = steps[: len(one.fitted)], steps[len(one.fitted) :]
        candidates.append(one.moved(own))
    return Point(z, tuple(candidates))


def joined(design: Design, shapes: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Fit nuisances and some shapes at once; return the nominal parameters and the shapes' amplitudes."""
    columns = np.concatenate((design.of(*NUISANCES), design.of(Part.SHAPE)[list(shapes)]))
    rows = 1 + columns
    total = design.total()
    precision, mean = design.prior_precision[columns], design.prior_mean[columns]
    whole = total[np.ix_(rows, rows)] + np.diag(precision + 1e-10 * np.diag(total)[rows])
    found = np.linalg.solve(whole, total[rows, 0] + precision * mean)
    nominal = len(design.of(Part.NOMINAL))
    z = np.clip(design.z + np.clip(found[:nominal], -LONGEST_STEP - 1, LONGEST_STEP + 1), -FURTHEST, FURTHEST)
    return z, found[len(found) - len(shapes) :]
