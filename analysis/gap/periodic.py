"""Something periodic in time whose phase is not tied from run to run, or not yet: each run has a phase of its own."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gap.candidate import Candidate
from dragrig.analysis.gap.design import Design, Part, RunPart
from dragrig.analysis.gap.sights import Sight
from dragrig.analysis.gap.signatures import Shape, signature
from dragrig.analysis.gap.solving import NUISANCES, Fit, fit
from dragrig.analysis.gap.study import Study
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.scene import Scene

HARMONICS = 4
KEPT = 12
"""Periods about one that are looked at with all harmonics."""
SHARPNESSES = (0.0, 1.5, 4.0, 10.0)
PHASES = 24


def free_gain(design: Design, nuisances: Fit, pair: Sequence[int]) -> tuple[float, int]:
    """Return half the squares that a pair of shapes takes away with an amplitude and a phase in every run.

    Parameters
    ----------
    nuisances
        What was fitted beforehand and stays.
    pair
        Two shapes a quarter of a period apart, by their number in the dictionary.

    Returns
    -------
    gain, runs
        The runs in which the shapes are seen; without any such thing the gain is about their number.
    """
    rows = (1 + design.of(Part.SHAPE)[list(pair)]).tolist()
    columns = 1 + nuisances.columns
    gain, runs = 0.0, 0
    for gram in design.grams:
        of_pair = gram[rows]
        own = of_pair[:, rows]
        strength = float(np.trace(own))
        if strength <= 1.0:
            continue
        along = of_pair[:, 0] - of_pair[:, columns] @ nuisances.found
        gain += 0.5 * float(along @ np.linalg.solve(own + 1e-6 * strength * np.eye(2), along))
        runs += 1
    return gain, runs


@dataclass(frozen=True, slots=True, eq=False)
class Tied:
    """Something periodic in time that holds its phase through the session.

    Attributes
    ----------
    candidate
        The effect with the period and phase that explain most.
    gain
        Half the squares that any form of this period takes away, given by its first harmonics.
    """

    candidate: Candidate
    gain: float


def tied(study: Study, design: Design, shape: Shape) -> Tied:
    """Look for the period, near that of a shape, and the form that tie the runs of a session together."""
    last_s = max(float(one.coordinates.session_s.max()) for one in study.sights)
    near = shape.values[_period(shape)]
    # The strongest may be the first overtone of what repeats.
    longest = next(one for one in shape.effect.shapes if one.name == _period(shape)).high
    residuals = _residuals(study, design)
    periods = np.concatenate([_loudest(residuals, _periods(one, last_s)) for one in (near, 2 * near) if one <= longest])
    gains = _summed(residuals, periods, HARMONICS)
    best = int(gains.argmax())
    forms = _forms(shape, float(periods[best]))
    gram, product = np.zeros(len(forms)), np.zeros(len(forms))
    for one in residuals:
        rows = [signature(form, one.scene, one.gain) for form in forms]
        white = one.part.whitening.whole(one.sight.of_blocks(np.array(rows)).T)
        gram += np.sum(white**2, axis=0)
        product += one.white @ white
    taken = np.where(product > 0, product**2 / np.maximum(gram, 1e-12), 0.0)
    chosen = int(taken.argmax())
    form = forms[chosen]
    size = form.effect.size
    values = {**form.values, size.name: form.values[size.name] * max(product[chosen], 0.0) / max(gram[chosen], 1e-12)}
    values[size.name] = float(np.clip(values[size.name], size.low, size.high))
    return Tied(Candidate(form.effect, values), float(gains[best]))


@dataclass(frozen=True, slots=True, eq=False)
class _Residual:
    sight: Sight
    part: RunPart
    scene: Scene
    gain: float
    white: FloatArray


def _residuals(study: Study, design: Design) -> list[_Residual]:
    """Return what nuisances leave of the runs in a closed gut, whitened."""
    nuisances = fit(design, design.total(), *NUISANCES)
    found = []
    for number, (sight, part) in enumerate(zip(study.sights, design.parts, strict=True)):
        scene, gain = study.scene(number, design.z)
        if scene.closed:
            left = part.residual - part.columns[:, nuisances.columns] @ nuisances.found
            found.append(_Residual(sight, part, scene, gain, part.whitening.whole(left)))
    return found


def _loudest(residuals: Sequence[_Residual], periods_s: FloatArray) -> FloatArray:
    """Return the periods whose fundamental and first overtone take away most."""
    gains = _summed(residuals, periods_s, 1) + _summed(residuals, periods_s / 2, 1)
    return periods_s[np.argsort(gains)[-KEPT:]]


def _summed(residuals: Sequence[_Residual], periods_s: FloatArray, harmonics: int) -> FloatArray:
    """Return half the squares that each period takes away with so many harmonics, over all runs."""
    found = [_gains(_harmonics(one, periods_s, harmonics), one, harmonics) for one in residuals]
    grams, along = (np.sum([one[part] for one in found], axis=0) for part in (0, 1))
    return _gain(grams, along)


def _harmonics(one: _Residual, periods_s: FloatArray, harmonics: int) -> FloatArray:
    """Return cosines and sines of the session's time, shape `(periods · 2 H, B)`."""
    angle = 2 * np.pi * one.scene.session_s / periods_s[:, None]
    waves = [turn(number * angle) for number in range(1, harmonics + 1) for turn in (np.cos, np.sin)]
    return one.sight.of_blocks(np.stack(waves, axis=1).reshape(-1, angle.shape[1]))


def _gains(rows: FloatArray, one: _Residual, harmonics: int) -> tuple[FloatArray, FloatArray]:
    white = one.part.whitening.whole(rows.T).T.reshape(-1, 2 * harmonics, rows.shape[1])
    return white @ white.transpose(0, 2, 1), white @ one.white


def _gain(grams: FloatArray, along: FloatArray) -> FloatArray:
    size = np.trace(grams, axis1=1, axis2=2)[:, None, None] / grams.shape[1]
    found = np.linalg.solve(grams + (1e-6 * size + 1e-12) * np.eye(grams.shape[1]), along[:, :, None])[:, :, 0]
    return np.asarray(0.5 * np.sum(found * along, axis=1))


def _forms(shape: Shape, period_s: float) -> list[Shape]:
    effect, phase = shape.effect, shape.effect.phase
    others = [one for one in effect.shapes if one.name != _period(shape)]
    grid = SHARPNESSES if others else (0.0,)
    turns = np.linspace(-np.pi, np.pi, PHASES, endpoint=False)
    return [
        Shape(
            effect,
            {
                **shape.values,
                _period(shape): period_s,
                **{one.name: value for one in others},
                **({phase.name: float(turn)} if phase is not None else {}),
            },
        )
        for value in grid
        for turn in turns
    ]


def _period(shape: Shape) -> str:
    return next(one.name for one in shape.effect.shapes if one.name.startswith("period"))


def _periods(period_s: float, session_s: float, width: float = 0.05, most: int = 300) -> FloatArray:
    """Return periods about one, near enough to each other for a phase to hold through a session."""
    step = 0.15 * period_s**2 / max(session_s, period_s)
    count = int(np.clip(2 * width * period_s / step, 3, most))
    return np.linspace(period_s * (1 - width), period_s * (1 + width), count)
