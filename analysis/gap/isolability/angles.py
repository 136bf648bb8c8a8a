"""Angles between what effects can do to the force of a campaign, nuisances removed."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby

import numpy as np

from dragrig.analysis.gap.design import Design, Part
from dragrig.analysis.gap.explanation import in_time
from dragrig.analysis.gap.signatures import Shape
from dragrig.analysis.gap.solving import NUISANCES, TINY, project
from dragrig.rig.arrays import FloatArray

LEAST_STRENGTH = 1e-6
"""Whitened squares below this are nothing."""


@dataclass(frozen=True, slots=True)
class Form:
    """One shape of an effect; what is periodic has two columns a quarter of a period apart."""

    effect: str
    shapes: tuple[int, ...]
    one_sided: bool
    d_prime: float


@dataclass(frozen=True, eq=False)
class Angles:
    """All forms that runs show, and the angles between them.

    Attributes
    ----------
    forms
        Those that leave anything beside nuisances.
    cos2
        Share of each form's squares that each other form takes away, phases averaged over, shape `(F, F)`.
    """

    forms: tuple[Form, ...]
    cos2: FloatArray

    @classmethod
    def of(cls, design: Design) -> "Angles":
        """Compute them from a design with its dictionary."""
        gram = project(design, design.total(), *NUISANCES).gram
        forms = tuple(_forms(design.shapes, gram))
        basis = _orthonormal(forms, gram)
        products = basis @ gram @ basis.T
        starts = np.concatenate(([0], np.cumsum([len(one.shapes) for one in forms])[:-1])).astype(np.intp)
        if not forms:
            return cls((), np.zeros((0, 0)))
        counts = np.array([len(one.shapes) for one in forms], dtype=np.float64)
        squares = np.add.reduceat(np.add.reduceat(products**2, starts, axis=0), starts, axis=1) / counts[:, None]
        one_sided = np.array([one.one_sided for one in forms])
        opposed = products[np.ix_(starts, starts)] < 0
        squares[opposed & one_sided[:, None] & one_sided[None, :]] = 0.0
        for number, form in enumerate(forms):
            if in_time(design.shapes[form.shapes[0]].effect):
                free = _with_free_phases(design, form.shapes, basis)
                squares[:, number] = np.maximum(squares[:, number], np.add.reduceat(free, starts) / counts)
        return cls(forms, np.clip(squares, 0.0, 1.0))

    @cached_property
    def effects(self) -> tuple[str, ...]:
        """Effects that are seen, in the catalogue's order."""
        return tuple(dict.fromkeys(one.effect for one in self.forms))

    def of_effect(self, name: str) -> list[int]:
        """Return the numbers of an effect's forms."""
        return [number for number, one in enumerate(self.forms) if one.effect == name]

    def sin2(self, truth: str, rival: str) -> FloatArray:
        """Return what the best of a rival's forms leaves of each form of an effect, shape `(forms,)`."""
        return np.asarray(1.0 - self.cos2[np.ix_(self.of_effect(truth), self.of_effect(rival))].max(axis=1))

    def d_primes(self, name: str) -> FloatArray:
        """Return d′ of an effect's forms at the usual size, shape `(forms,)`."""
        return np.array([self.forms[one].d_prime for one in self.of_effect(name)])


def _forms(shapes: Sequence[Shape], gram: FloatArray) -> list[Form]:
    found = []
    for _, group in groupby(enumerate(shapes), key=lambda pair: (pair[1].effect.id, pair[1].twin)):
        index = tuple(number for number, _ in group)
        strength = float(np.mean(np.diag(gram)[list(index)]))
        if strength > LEAST_STRENGTH:
            first = shapes[index[0]]
            found.append(Form(first.effect.id, index, first.signed, float(np.sqrt(strength))))
    return found


def _orthonormal(forms: Sequence[Form], gram: FloatArray) -> FloatArray:
    """Return what makes the columns of each form orthonormal, shape `(columns of all forms, S)`."""
    rows = []
    for one in forms:
        index = list(one.shapes)
        own = gram[np.ix_(index, index)]
        root = np.linalg.cholesky(own + 1e-9 * np.trace(own) * np.eye(len(index)))
        made = np.zeros((len(index), len(gram)))
        made[:, index] = np.linalg.inv(root)
        rows.append(made)
    return np.concatenate(rows) if rows else np.zeros((0, len(gram)))


def _with_free_phases(design: Design, pair: Sequence[int], basis: FloatArray) -> FloatArray:
    """Return the share of each orthonormal column that a pair takes away with an amplitude and phase in every run.

    What is periodic in time may lose its phase from run to run; a diagnosis allows for it, and so may be misled by it.
    """
    nuisances, shapes = 1 + design.of(*NUISANCES), 1 + design.of(Part.SHAPE)
    own = shapes[list(pair)]
    total = design.total()
    gram = total[np.ix_(nuisances, nuisances)]
    whole = gram + np.diag(design.prior_precision[nuisances - 1] + TINY * np.diag(gram))
    grams = [one for one in design.grams if np.trace(one[np.ix_(own, own)]) > LEAST_STRENGTH]
    by_nuisance = np.concatenate([one[np.ix_(nuisances, own)] for one in grams], axis=1)
    taken = np.linalg.solve(whole, by_nuisance)
    each = np.zeros((by_nuisance.shape[1],) * 2)
    for place, one in enumerate(grams):
        at = slice(2 * place, 2 * place + 2)
        each[at, at] = one[np.ix_(own, own)]
    each -= by_nuisance.T @ taken
    across = np.concatenate([one[np.ix_(shapes, own)] for one in grams], axis=1)
    along = basis @ (across - total[np.ix_(shapes, nuisances)] @ taken)
    each += 1e-9 * np.trace(each) / len(each) * np.eye(len(each))
    return np.asarray(np.sum(along * np.linalg.solve(each, along.T).T, axis=1))
