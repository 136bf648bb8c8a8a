"""How far runs set leading hypotheses apart, before and after one run more."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from dragrig.analysis.gap.design import Design, Part
from dragrig.analysis.gap.planning.results import Contest
from dragrig.analysis.gap.signatures import Shape
from dragrig.analysis.gap.solving import NUISANCES, TINY
from dragrig.rig.arrays import FloatArray

FORM = 0.12
"""Part of an effect's squares that its real form may cost it against a wrong one."""
BY_SHARE = 14.0
"""Log odds for each share of an effect's squares that a rival leaves."""


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """An effect as it may be there: columns of the ground's shapes with amplitudes, in usual sizes."""

    effect: str
    columns: tuple[int, ...]
    amplitude: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """A contest to be decided: an effect that may be there against a rival, with how much it matters."""

    truth: Truth
    rival: str
    weight: float


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """What runs say of the shapes of some effects.

    Attributes
    ----------
    total
        Gram matrix of nuisances and shapes, whitened and summed over runs.
    precision
        Of the nuisances' priors.
    shapes
        The shapes, in the order of the last columns.
    """

    total: FloatArray
    precision: FloatArray
    shapes: tuple[Shape, ...]

    @classmethod
    def of(cls, design: Design, effects: Sequence[str]) -> "Ground":
        """Take what belongs to some effects out of a design with its dictionary."""
        rows = columns_of(design, effects)
        nuisances = design.of(*NUISANCES)
        kept = tuple(one for one in design.shapes if one.effect.id in effects)
        return cls(design.total()[np.ix_(rows, rows)], design.prior_precision[nuisances], kept)

    def with_run(self, gram: FloatArray) -> "Ground":
        """Add a run, whose Gram matrix has the same columns."""
        return replace(self, total=self.total + gram)

    def projected(self) -> FloatArray:
        """Return the products of the shapes once nuisances have taken what they can."""
        count = len(self.precision)
        own, across = self.total[:count, :count], self.total[:count, count:]
        whole = own + np.diag(self.precision + TINY * np.diag(own))
        return np.asarray(self.total[count:, count:] - across.T @ np.linalg.solve(whole, across))

    def forms(self, effect: str) -> list[tuple[int, ...]]:
        """Return the columns of each form of an effect; two for what is periodic."""
        numbered = [(number, one) for number, one in enumerate(self.shapes) if one.effect.id == effect]
        return [tuple(number for number, _ in group) for _, group in groupby(numbered, key=lambda pair: pair[1].twin)]


def columns_of(design: Design, effects: Sequence[str]) -> FloatArray:
    """Return the rows of a design's Gram matrices that hold nuisances and the shapes of some effects."""
    wanted = [place for place, one in enumerate(design.shapes) if one.effect.id in effects]
    return np.asarray(1 + np.concatenate((design.of(*NUISANCES), design.of(Part.SHAPE)[wanted])))


def contest(ground: Ground, gram: FloatArray, question: Question) -> Contest:
    """Say how far a truth is from a rival, by the ground's projected products."""
    truth = question.truth
    index = list(truth.columns)
    squares = float(truth.amplitude @ gram[np.ix_(index, index)] @ truth.amplitude)
    along = gram[:, index] @ truth.amplitude
    taken = max((_taken(ground, gram, along, form) for form in ground.forms(question.rival)), default=0.0)
    left = max(squares - taken, 0.0)
    return Contest(truth.effect, question.rival, float(np.sqrt(left)), left / max(squares, 1e-12))


def log_odds(one: Contest) -> float:
    """Return about how sure a diagnosis can be of the truth, forms being foreign and noise being there."""
    left = one.d_prime**2
    if not one.rival:
        return 0.5 * left
    squares = left / max(one.left, 1e-12)
    return BY_SHARE * one.left + 0.5 * left / (1.0 + 0.5 * FORM * squares)


def _taken(ground: Ground, gram: FloatArray, along: FloatArray, form: tuple[int, ...]) -> float:
    index = list(form)
    own = gram[np.ix_(index, index)]
    strength = float(np.trace(own))
    if strength <= 1e-9:
        return 0.0
    if ground.shapes[index[0]].signed and along[index[0]] < 0:
        return 0.0
    return float(along[index] @ np.linalg.solve(own + 1e-9 * strength * np.eye(len(index)), along[index]))
