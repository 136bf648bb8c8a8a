"""Weights and thresholds of a verdict, learnt from campaigns whose hidden effects are known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gap.calibration import OF_EFFECT, Gate
from dragrig.analysis.gap.evidence import Evidence
from dragrig.analysis.gap.weighing import hypotheses, largest_gain
from dragrig.rig.arrays import FloatArray

ELSEWHERE = frozenset({"servo_lag", "velocity_ripple", "encoder_scale", "mains_hum"})
"""Effects that the weights know nothing of: they are found on the position, or as a line."""
RIDGE, RIDGE_OF_EFFECT = 0.02, 0.5
"""Prior precisions of a weight: of a feature, and of a single effect's, of which there are few campaigns each."""
GATE = Gate(least_gain=18.0, gain_width=3.0, least_left=0.075, left_width=0.012)
"""What is thought of the thresholds beforehand: the best of all shapes reaches a gain of 8 in noise alone, and seldom
more than 15 where the nominal model is a little wrong."""
GATE_SD = 0.03
"""How well that is known, relative."""
WORTH = 11.0
"""A campaign teaches which effect it is if any takes away so many half squares."""

SPEAKS_FOR = ("plain", "flexible", "further: share", "further: over", "further: gain", "further: worse")
SPEAKS_AGAINST = ("known, in", "behind", "left", "nameless", "further: alike", "third")
"""How features begin whose sense is known beforehand: what explains more is never the less likely for it."""


@dataclass(frozen=True, slots=True)
class Lesson:
    """What was found in a campaign, and what was hidden in it.

    Attributes
    ----------
    effects
        Hidden effects of the catalogue.
    outside
        Whether an effect was hidden that the catalogue does not have.
    size
        The smallest size of the hidden effects; small ones teach nothing about when a gap is seen.
    """

    evidence: Evidence
    effects: frozenset[str]
    outside: bool = False
    size: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class _Choice:
    """Features of the hypotheses of one campaign, shape `(H, F)`, and which is right (H where none is)."""

    features: FloatArray
    right: int


def learn_weights(lessons: Sequence[Lesson], tolerance_mN: float) -> dict[str, float]:
    """Return the weights that make the right choices most probable: penalised maximum likelihood.

    Raises
    ------
    ValueError
        When no lesson teaches a choice.
    """
    from scipy.optimize import minimize

    weighed = [(one, hypotheses(one.evidence, tolerance_mN)) for one in lessons if _teaches_choice(one, tolerance_mN)]
    tried = [(one, found) for one, found in weighed if found]
    if not tried:
        raise ValueError("There is no campaign among these whose force teaches which effect it is")
    names = sorted({name for _, found in tried for one in found for name in one.features})
    choices = []
    for lesson, found in tried:
        rows = [[one.features.get(name, 0.0) for name in names] for one in found]
        choices.append(_Choice(np.array(rows), _right(lesson, [one.effects for one in found])))
    ridge = np.array([RIDGE_OF_EFFECT if name.startswith(OF_EFFECT) else RIDGE for name in names])

    def loss(weights: FloatArray) -> tuple[float, FloatArray]:
        total, slope = 0.5 * float(np.sum(ridge * weights**2)), ridge * weights
        for one in choices:
            utilities = np.append(one.features @ weights, 0.0)
            shares = np.exp(utilities - utilities.max())
            shares /= shares.sum()
            total -= float(np.log(shares[one.right] + 1e-300))
            pulled = shares[:-1].copy()
            if one.right < len(pulled):
                pulled[one.right] -= 1.0
            slope = slope + one.features.T @ pulled
        return total, slope

    bounds = [_bounds(name) for name in names]
    best = minimize(loss, np.zeros(len(names)), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 2000})
    return {name: round(float(weight), 4) for name, weight in zip(names, best.x, strict=True)}


def _bounds(feature: str) -> tuple[float | None, float | None]:
    """Return between what the weight of a feature may be."""
    return 0.0 if feature.startswith(SPEAKS_FOR) else None, 0.0 if feature.startswith(SPEAKS_AGAINST) else None


def learn_gate(lessons: Sequence[Lesson], tolerance_mN: float, least_size: float = 0.2) -> Gate:
    """Return the thresholds that tell campaigns with a gap from those without most probably."""
    from scipy.optimize import minimize

    rows = [
        (*_signs(one.evidence, tolerance_mN), bool(one.effects or one.outside))
        for one in lessons
        if not one.evidence.strays and not one.effects & ELSEWHERE and (not one.effects or one.size >= least_size)
    ]
    gain, left, there = (np.array(column) for column in zip(*rows, strict=True))

    def loss(steps: FloatArray) -> float:
        gate = _gate(steps)
        seen = np.maximum(
            _logistic((gain - gate.least_gain) / gate.gain_width), _logistic((left - gate.least_left) / gate.left_width)
        )
        within = np.clip(seen, 1e-3, 1.0 - 1e-3)
        return -float(np.sum(np.log(np.where(there, within, 1.0 - within)))) + 0.5 * float(np.sum(steps**2))

    found = minimize(loss, np.zeros(4), method="Nelder-Mead", options={"maxiter": 2000})
    return _gate(np.asarray(found.x, dtype=np.float64))


def _gate(steps: FloatArray) -> Gate:
    values = [value * float(np.exp(GATE_SD * step)) for value, step in zip(_values(GATE), steps, strict=True)]
    gain, width, left, left_width = (round(value, 4) for value in values)
    return Gate(least_gain=gain, gain_width=width, least_left=left, left_width=left_width)


def _values(gate: Gate) -> tuple[float, ...]:
    return gate.least_gain, gate.gain_width, gate.least_left, gate.left_width


def _signs(found: Evidence, tolerance_mN: float) -> tuple[float, float]:
    return largest_gain(found, tolerance_mN), found.excess / max(found.blocks, 1)


def _logistic(values: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(values, -40.0, 40.0))))


def _teaches_choice(one: Lesson, tolerance_mN: float) -> bool:
    """Whether it is the force that is to be explained, and anything explains some of it."""
    of_force = one.effects - ELSEWHERE
    tried = [each.gain for each in one.evidence.tried if each.changed_mN >= tolerance_mN]
    return (bool(of_force) or (one.outside and not one.evidence.strays)) and max(tried, default=0.0) > WORTH


def _right(lesson: Lesson, tried: Sequence[tuple[str, ...]]) -> int:
    """Return which explanation has just the hidden effects, else the most of them and no other, else none."""
    hidden = lesson.effects - ELSEWHERE
    if lesson.outside:
        return len(tried)
    fitting = [number for number, one in enumerate(tried) if set(one) <= hidden]
    return max(fitting, key=lambda number: len(tried[number]), default=len(tried))
