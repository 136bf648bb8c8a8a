"""What a position error is a function of: free forms of every effect that acts on the position, judged held out.

A free form asks whether the error can be such an effect at all, whatever its law: a linear response to the command
(a servo that lags), a function of the distance (an encoder's scale), a periodic one (a ripple), the command itself at
another time (a latency).
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis.gap.position.errors import PositionErrors
from dragrig.rig.arrays import FloatArray

DELAYS_S = (0.002, 0.004, 0.008, 0.016, 0.03, 0.05, 0.08, 0.12, 0.2, 0.35, 0.6)
"""Delays of the command that a linear response is made of."""
LAG_POWERS = (0.0, 0.4, 0.8)
"""Powers of the top speed that a lag may grow with: motors run out of voltage."""
SPEED_MM_S, LEAST_SPEED_MM_S = 20.0, 0.1
LATENCIES_S = np.concatenate((-np.geomspace(0.1, 0.0005, 24), np.geomspace(0.0005, 0.1, 24)))
LOWEST_PER_MM, HIGHEST_PER_MM, STROKE_MM, QUARTER = 1 / 30, 1 / 0.6, 45.0, 0.25
"""Wave numbers of a ripple: over a stroke, or over all that runs reach, neighbours differ by a quarter of a period."""
BENT, LONG_WAVE_PER_MM, BEHIND = 0.9, 1 / 15, 0.02
"""Where a scale explains so much, a ripple of longer waves than this stands so far behind it."""
HARMONICS = 3
FOLDS = 4
RIDGE = 1e-6

Columns = Callable[[PositionErrors], FloatArray]


@dataclass(frozen=True, slots=True)
class Family:
    """How well one free form explains the errors.

    Attributes
    ----------
    effect
        Effect that it stands for.
    held_out
        Share of the weighted squares that it explains in runs that took no part.
    shape
        Wave number per mm, or latency in s; 0 for what has none.
    """

    effect: str
    held_out: float
    shape: float = 0.0


FAMILIES = ("encoder_scale", "servo_lag", "channel_latency", "velocity_ripple")


def families(runs: Sequence[PositionErrors], effects: Collection[str] = FAMILIES) -> tuple[Family, ...]:
    """Return all families, or those of some effects, the best first."""
    last_s = max(one.session_s for one in runs) + 1.0

    def stretched(one: PositionErrors) -> FloatArray:
        # In motion throughout, a bend is a speed that was not kept.
        bent = 0.0 if one.entering_mm_s else one.command_mm**2 / 40.0
        return np.column_stack((one.command_mm, bent + 0.0 * one.command_mm, one.command_mm * one.session_s / last_s))

    scale = Family("encoder_scale", _held_out(runs, stretched))

    def ripple() -> Family:
        found = _ripple(runs)
        if scale.held_out <= BENT or found.shape >= LONG_WAVE_PER_MM:
            return found
        # Waves as long as half a stroke follow any bend of a scale.
        return replace(found, held_out=min(found.held_out, scale.held_out - BEHIND))

    forms: tuple[Callable[[], Family], ...] = (lambda: scale, lambda: _lag(runs), lambda: _latency(runs), ripple)
    found = [form() for effect, form in zip(FAMILIES, forms, strict=True) if effect in effects]
    return tuple(sorted(found, key=lambda one: -one.held_out))


def _lag(runs: Sequence[PositionErrors]) -> Family:
    """Try linear responses whose times are the same in all runs, or grow with a power of their top speed."""

    def response(power: float) -> Columns:
        def columns(one: PositionErrors) -> FloatArray:
            slower = (max(one.top_speed_mm_s, LEAST_SPEED_MM_S) / SPEED_MM_S) ** power
            return one.late(slower * np.array(DELAYS_S)) - one.late(np.zeros(1))

        return columns

    return Family("servo_lag", max(_held_out(runs, response(power)) for power in LAG_POWERS))


def _latency(runs: Sequence[PositionErrors]) -> Family:
    """Try the command at other times, one at a time."""

    def late(latencies_s: FloatArray) -> Columns:
        return lambda one: one.late(latencies_s) - one.late(np.zeros(1))

    squares, along = np.zeros(LATENCIES_S.size), np.zeros(LATENCIES_S.size)
    for one in runs:
        weight = _weight(one)
        column = one.from_zero(late(LATENCIES_S)(one)) * weight[:, None]
        squares += np.einsum("bl,bl->l", column, column)
        along += (one.error_mm * weight) @ column
    best = float(LATENCIES_S[int((along**2 / (squares + 1e-300)).argmax())])
    return Family("channel_latency", _held_out(runs, late(np.array([best]))), best)


def _ripple(runs: Sequence[PositionErrors]) -> Family:
    """Try one ripple with its harmonics, and another beside it."""
    first = _wave(runs, ())
    second = _wave(runs, (first,))
    held_out = max(_held_out(runs, _waves((first,))), _held_out(runs, _waves((first, second))))
    return Family("velocity_ripple", held_out, first)


def _wave(runs: Sequence[PositionErrors], before: tuple[float, ...]) -> float:
    """Return the wave number per mm that explains most of what is left beside others."""
    weights = [_weight(one) for one in runs]
    errors = [one.error_mm * weight for one, weight in zip(runs, weights, strict=True)]
    if before:
        bases = [one.from_zero(_waves(before)(one)) * each[:, None] for one, each in zip(runs, weights, strict=True)]
        basis = np.concatenate(bases)
        found = _fitted(basis.T @ basis, basis.T @ np.concatenate(errors))[0]
        errors = [error - each @ found for error, each in zip(errors, bases, strict=True)]
    places = [one.origin_mm + one.command_mm for one in runs]
    reach = max(float(one.max()) for one in places) - min(float(one.min()) for one in places)
    step = QUARTER / max(reach, STROKE_MM)
    waves_per_mm = np.arange(LOWEST_PER_MM, HIGHEST_PER_MM, step)
    near = float(waves_per_mm[int(_powers(runs, errors, weights, waves_per_mm).argmax())])
    tried: list[float] = np.linspace(near - step, near + step, 9).tolist()
    return max(tried, key=lambda wave: _explained(runs, _waves((*before, wave))))


def _powers(
    runs: Sequence[PositionErrors],
    errors: Sequence[FloatArray],
    weights: Sequence[FloatArray],
    waves_per_mm: FloatArray,
) -> FloatArray:
    """Return what each wave takes of the squares on its own, shape `(W,)`."""
    gram, along = np.zeros((waves_per_mm.size, 2, 2)), np.zeros((waves_per_mm.size, 2))
    for one, error, weight in zip(runs, errors, weights, strict=True):
        turned = one.from_zero(_periodic(one, waves_per_mm)) * weight[:, None]
        pair = turned[:, : waves_per_mm.size], turned[:, waves_per_mm.size :]
        for i, j in ((0, 0), (0, 1), (1, 1)):
            gram[:, i, j] += np.einsum("bw,bw->w", pair[i], pair[j])
        along += (error @ turned).reshape(2, -1).T
    gram[:, 1, 0] = gram[:, 0, 1]
    scale = np.sqrt(np.diagonal(gram, axis1=1, axis2=2)) + 1e-150
    scaled = gram / (scale[:, :, None] * scale[:, None, :]) + RIDGE * np.eye(2)
    found = np.linalg.solve(scaled, (along / scale)[:, :, None])[:, :, 0] / scale
    return np.asarray(np.sum(found * along, axis=1))


def _waves(waves_per_mm: tuple[float, ...]) -> Columns:
    def columns(one: PositionErrors) -> FloatArray:
        return _periodic(one, np.outer(waves_per_mm, np.arange(1, HARMONICS + 1)).ravel())

    return columns


def _periodic(one: PositionErrors, waves_per_mm: FloatArray) -> FloatArray:
    """Return cosines and sines of the place on the rig, nothing where the run begins, shape `(B, 2 W)`."""
    begin = 2 * np.pi * one.origin_mm * waves_per_mm
    turned = 2 * np.pi * (one.origin_mm + one.command_mm)[:, None] * waves_per_mm
    return np.hstack((np.cos(turned) - np.cos(begin), np.sin(turned) - np.sin(begin)))


def _weight(one: PositionErrors) -> FloatArray:
    """Let runs count alike, whatever their speed, but those without an error for little."""
    rms = float(np.sqrt(np.mean(one.error_mm**2)))
    return np.full_like(one.error_mm, 1.0 / ((rms + one.count_mm) * np.sqrt(one.error_mm.size)))


def _grams(runs: Sequence[PositionErrors], columns: Columns) -> Iterator[tuple[FloatArray, FloatArray, float]]:
    for one in runs:
        weight = _weight(one)
        basis, error = one.from_zero(columns(one)) * weight[:, None], one.error_mm * weight
        yield basis.T @ basis, basis.T @ error, float(error @ error)


def _fitted(gram: FloatArray, along: FloatArray) -> tuple[FloatArray, float]:
    scale = np.sqrt(np.diag(gram)) + 1e-150
    scaled = gram / np.outer(scale, scale) + RIDGE * np.eye(len(scale))
    found = np.linalg.solve(scaled, along / scale) / scale
    return found, float(found @ along)


def _explained(runs: Sequence[PositionErrors], columns: Columns) -> float:
    grams, along, squares = zip(*_grams(runs, columns), strict=True)
    taken = _fitted(np.sum(grams, axis=0), np.sum(along, axis=0))[1]
    return taken / max(float(sum(squares)), 1e-300)


def _held_out(runs: Sequence[PositionErrors], columns: Columns) -> float:
    parts = list(_grams(runs, columns))
    folds = min(FOLDS, len(parts))
    if folds < 2:
        return _explained(runs, columns)
    left = whole = 0.0
    for fold in range(folds):
        fitted = [part for number, part in enumerate(parts) if number % folds != fold]
        found, _ = _fitted(np.sum([one[0] for one in fitted], axis=0), np.sum([one[1] for one in fitted], axis=0))
        for gram, along, squares in parts[fold::folds]:
            left += squares - 2 * float(found @ along) + float(found @ gram @ found)
            whole += squares
    return 1.0 - left / max(whole, 1e-300)
