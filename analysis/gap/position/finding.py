"""What the position channel says: whether the stage was where it was told to be, and if not, which effect it is."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gap.candidate import Candidate
from dragrig.analysis.gap.position.errors import PositionErrors, position_errors
from dragrig.analysis.gap.position.families import Family, families
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Effect, EncoderEffect, MotorEffect, Role

STEPS = 60


@dataclass(frozen=True, slots=True, eq=False)
class PositionFinding:
    """The position channel of a campaign.

    Attributes
    ----------
    runs
        Errors of each run.
    present
        Whether any run strays from its command by more than the encoder's counts.
    families
        Free forms with the share each explains, the best first; empty without a gap.
    candidate
        The best effect of the catalogue with its parameters fitted; None without one.
    standard_errors
        Of its fitted parameters.
    """

    runs: tuple[PositionErrors, ...]
    present: bool
    families: tuple[Family, ...] = ()
    candidate: Candidate | None = None
    standard_errors: tuple[float, ...] = ()

    @property
    def recorded_wrongly(self) -> bool:
        """Whether the stage was where it was told to be and only its record was not."""
        return bool(self.families) and self.families[0].effect in {"encoder_scale", "channel_latency"}


def find_position(experiments: Sequence[Experiment], effects: Sequence[Effect]) -> PositionFinding:
    """Look at the position errors of a campaign; `effects` are the candidates."""
    runs = position_errors(experiments)
    if not any(one.strays for one in runs):
        return PositionFinding(runs, present=False)
    known = {one.id: one for one in effects}
    found = tuple(one for one in families(runs) if one.effect in known)
    if not found:
        return PositionFinding(runs, present=True)
    effect = known[found[0].effect]
    if not isinstance(effect, MotorEffect | EncoderEffect):
        return PositionFinding(runs, present=True, families=found)
    candidate, errors = fitted(runs, effect, found[0])
    return PositionFinding(runs, present=True, families=found, candidate=candidate, standard_errors=errors)


def strayed(candidate: Candidate, one: PositionErrors) -> FloatArray:
    """Return the position error that an effect makes of a run, shape `(B,)` [mm]."""
    effect, values = candidate.effect, dict(candidate.values)
    if isinstance(effect, MotorEffect):
        if effect.phase is not None and one.origin_mm:
            # What is periodic stays where it is on the rig, wherever a run begins.
            pitch_mm = next(value for name, value in values.items() if name.startswith("pitch"))
            values[effect.phase.name] += 2 * np.pi * one.origin_mm / pitch_mm
        return one.from_zero(effect.moved(one.time_s, one.command_mm, values) - one.command_mm)
    if isinstance(effect, EncoderEffect):
        return one.from_zero(effect.recorded(one.time_s, one.command_mm, values) - one.command_mm)
    return np.zeros_like(one.time_s)


def fitted(runs: Sequence[PositionErrors], effect: Effect, family: Family) -> tuple[Candidate, tuple[float, ...]]:
    """Fit the catalogue's own form, from the best of the shapes that it tries; return it with standard errors."""
    from scipy.optimize import least_squares

    start = min(_starts(effect, family), key=lambda one: float(np.sum(_misfit(one, runs) ** 2)))
    free = start.fitted
    scale = np.array([max(abs(start.values[one.name]), 0.05 * abs(one.usual), 1e-4) for one in free])

    def at(scaled: FloatArray) -> Candidate:
        values = {one.name: float(value) for one, value in zip(free, scaled * scale, strict=True)}
        limited = {
            one.name: values[one.name]
            if one.role is Role.PHASE
            else float(np.clip(values[one.name], one.low, one.high))
            for one in free
        }
        return Candidate(effect, {**start.values, **limited})

    def misfit(scaled: FloatArray) -> FloatArray:
        return _misfit(at(scaled), runs)

    first = np.array([start.values[one.name] for one in free]) / scale
    found = least_squares(misfit, first, max_nfev=STEPS, diff_step=[1e-3] * len(free))
    squares = 2 * float(found.cost) / max(len(found.fun) - len(free), 1)
    slopes = np.asarray(found.jac, dtype=np.float64)
    covariance = np.asarray(np.linalg.pinv(slopes.T @ slopes), dtype=np.float64) * squares
    errors = (np.sqrt(np.maximum(np.diag(covariance), 0.0)) * scale).tolist()
    return at(found.x), tuple(errors)


def _starts(effect: Effect, family: Family) -> list[Candidate]:
    from itertools import product

    grids = [_tried(effect, one.name, one.tried or (one.usual,), family) for one in effect.shapes]
    sizes = (0.3, 1.0, 3.0) if effect.size.low >= 0 else (-1.0, 1.0)
    turns = np.linspace(-np.pi, np.pi, 8, endpoint=False) if effect.phase is not None else (0.0,)
    starts = []
    for *shapes, size, turn in product(*grids, sizes, turns):
        values = {**effect.usual, **{one.name: value for one, value in zip(effect.shapes, shapes, strict=True)}}
        values[effect.size.name] = float(np.clip(size * effect.size.usual, effect.size.low, effect.size.high))
        if effect.phase is not None:
            values[effect.phase.name] = float(turn)
        starts.append(Candidate(effect, values))
    return starts


def _tried(effect: Effect, name: str, tried: tuple[float, ...], family: Family) -> tuple[float, ...]:
    del effect
    return (1.0 / family.shape,) if name.startswith("pitch") and family.shape > 0 else tried


def _misfit(candidate: Candidate, runs: Sequence[PositionErrors]) -> FloatArray:
    parts = []
    for one in runs:
        weight = 1.0 / ((np.sqrt(np.mean(one.error_mm**2)) + 0.001) * np.sqrt(one.error_mm.size))
        parts.append((one.error_mm - strayed(candidate, one)) * weight)
    return np.concatenate(parts)
