"""The position channel: recorded minus commanded position, and the effect that explains the difference.

Free-form model classes come first. They ask whether the error can be of a kind at all, whatever its law: a linear
response to the command (servo lag), a function of distance (encoder scale), a periodic one (ripple), the command at
another time (latency). Each class is scored on held-out runs; the best is then fitted in the catalogue's form.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis.gap.candidates import Candidate
from dragrig.analysis.gap.diagnosis import GapReduction
from dragrig.analysis.models.drive_model import EXTERNAL_BACKEND
from dragrig.analysis.models.experiment import MIN_COUNT_MM, Experiment, wander_noise_sd_mm
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Channel, Effect, EffectParameter, Role

MAX_BLOCKS = 400
BEFORE_S, AFTER_S = 0.05, 1.5
"""What is looked at of the rest before a motion and of the hold after it."""
RELATIVE_ROUNDING = 1e-9
MOVING_START_RATIO = 0.5
"""A record whose first speed is above this part of its highest begins in motion; a ramp starts at next to none."""
MIN_ERROR_COUNTS = 0.7
"""Errors of a run below so many counts are the encoder's."""


@dataclass(frozen=True, slots=True, eq=False)
class PositionErrors:
    """One run, in `B` blocks.

    Attributes
    ----------
    experiment
        The run.
    time_s, command_mm, velocity_mm_s
        Middles of the blocks, where the stage was told to be, and how fast; shape `(B,)`.
    error_mm
        Recorded less commanded position, its mean over the rest before the motion taken off; its mean over the record
        where this begins in motion.
    force_mN
        The force, its first value taken off; zeros where none was recorded.
    session_s
        The first sample on the session's clock.
    origin_mm
        Where it begins, from where the first run does.
    entering_mm_s
        How fast the stage was told to go already as the record begins; 0 for one that begins at rest.
    count_mm
        The encoder's count; differences smaller than this do not matter.
    noise_mm
        By how much the record wanders at rest, one standard deviation; 0 where it is from one count to the next. What a
        servo dithers by is not less in the mean of a block.
    """

    experiment: Experiment
    time_s: FloatArray
    command_mm: FloatArray
    velocity_mm_s: FloatArray
    error_mm: FloatArray
    force_mN: FloatArray
    session_s: float
    origin_mm: float = 0.0
    entering_mm_s: float = 0.0
    count_mm: float = MIN_COUNT_MM
    noise_mm: float = 0.0

    @property
    def rms_mm(self) -> float:
        """Its size beyond the encoder's quantisation and noise."""
        squares = float(np.mean(self.error_mm**2)) - self.quantisation_mm**2 / 2 - self.noise_mm**2
        return float(np.sqrt(max(squares, 0.0)))

    @property
    def strays(self) -> bool:
        """Whether it is more than the encoder's counts and noise."""
        return self.rms_mm >= self.least_mm

    @property
    def least_mm(self) -> float:
        """The least error that is seen."""
        return max(MIN_ERROR_COUNTS * self.count_mm, self.noise_mm)

    @property
    def quantisation_mm(self) -> float:
        """What its counts make a single position differ by, one standard deviation."""
        return self.count_mm / float(np.sqrt(12))

    @property
    def top_speed_mm_s(self) -> float:
        """The fastest that the stage was told to go."""
        return float(np.abs(self.velocity_mm_s).max())

    def delayed(self, delay_s: float) -> FloatArray:
        """Return the command at the blocks' middles, so much later, shape `(B,)`."""
        return self.late(np.array([delay_s]))[:, 0]

    def late(self, delays_s: FloatArray) -> FloatArray:
        """Return the command at the blocks' middles, later by each of the delays, shape `(B, D)`."""
        trace = self.experiment.run.trace
        at = self.time_s[:, None] - delays_s
        command = np.interp(at, self.experiment.time_s, np.asarray(trace.command, dtype=np.float64))
        return np.asarray(command + self.entering_mm_s * np.minimum(at - self.experiment.time_s[0], 0.0))

    def from_zero(self, strayed: FloatArray) -> FloatArray:
        """Take off what this run's zero takes off its errors, shape `(B,)` or `(B, C)`."""
        if not self.entering_mm_s:
            return strayed
        left = strayed - strayed.mean(axis=0)
        return np.where(np.abs(left) > RELATIVE_ROUNDING * np.abs(strayed).max(axis=0), left, 0.0)


def position_errors(experiments: Sequence[Experiment]) -> tuple[PositionErrors, ...]:
    """Return the position errors of all runs that move and recorded a position and a command."""
    starts = [one.run.info.header.start_time for one in experiments]
    origins = [origin_of(one) for one in experiments]
    found = []
    for experiment, start, origin in zip(experiments, starts, origins, strict=True):
        one = _errors_of_run(experiment, (start - min(starts)).total_seconds(), origin - origins[0])
        if one is not None:
            found.append(one)
    return tuple(found)


def origin_of(experiment: Experiment) -> float:
    """Return where on its machine a measurement from elsewhere begins, to the encoder's count.

    Runs of this rig begin at 0, for a ripple of the catalogue counts from the start of each run.
    """
    header = experiment.run.info.header
    said = header.entry.get("origin_mm", 0.0) if header.backend == EXTERNAL_BACKEND else 0.0
    return round(float(said), 3) if isinstance(said, int | float) and np.isfinite(said) else 0.0


def _errors_of_run(experiment: Experiment, session_s: float, origin_mm: float) -> PositionErrors | None:
    trace = experiment.run.trace
    if "position" not in trace.channels:
        return None
    position = np.asarray(trace.position, dtype=np.float64)
    command = np.asarray(trace.command, dtype=np.float64)
    time = experiment.time_s
    moves = np.flatnonzero(np.abs(np.diff(command)) > 0)
    if not moves.size or not np.isfinite(command).all():
        return None
    begin = np.searchsorted(time, time[moves[0]] - BEFORE_S)
    end = np.searchsorted(time, time[moves[-1]] + AFTER_S)
    inside = np.arange(begin, end)[np.isfinite(position[begin:end])]
    if inside.size < 8:
        return None
    rest = np.isfinite(position[: moves[0] + 1])
    zero = float(np.mean((position - command)[: moves[0] + 1][rest])) if rest.any() else 0.0
    velocity = np.gradient(command, time)
    entering = float(velocity[0]) if abs(velocity[0]) > MOVING_START_RATIO * np.abs(velocity).max() else 0.0
    if entering:
        zero = float(np.mean((position - command)[inside]))
    force = np.nan_to_num(np.asarray(trace.force, dtype=np.float64)) if "force" in trace.channels else 0.0 * time
    edges = np.unique(np.linspace(0, inside.size, min(MAX_BLOCKS, inside.size) + 1).astype(int))[:-1]
    count = np.diff(np.append(edges, inside.size))

    def means(values: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(values[inside], edges) / count)

    return PositionErrors(
        experiment,
        means(time),
        means(command - command[0]),
        means(velocity),
        means(position - command) - zero,
        means(force - force[:20].mean()),
        session_s,
        origin_mm,
        entering,
        experiment.count_mm,
        wander_noise_sd_mm(experiment.wander_mm, experiment.count_mm),
    )


DELAYS_S = (0.002, 0.004, 0.008, 0.016, 0.03, 0.05, 0.08, 0.12, 0.2, 0.35, 0.6)
"""Delays of the command that a linear response is made of."""
LAG_POWERS = (0.0, 0.4, 0.8)
"""Powers of the top speed that a lag may grow with: motors run out of voltage."""
LAG_REFERENCE_SPEED_MM_S, MIN_LAG_SPEED_MM_S = 20.0, 0.1
LATENCIES_S = np.concatenate((-np.geomspace(0.1, 0.0005, 24), np.geomspace(0.0005, 0.1, 24)))
MIN_WAVENUMBER_PER_MM, MAX_WAVENUMBER_PER_MM, RIPPLE_STROKE_MM, WAVE_SPACING_PERIODS = 1 / 30, 1 / 0.6, 45.0, 0.25
"""Wave numbers of a ripple: over a stroke, or over all that runs reach, neighbours differ by a quarter of a period."""
DOMINANT_SCALE_SHARE, LONG_WAVE_PER_MM, LONG_WAVE_HANDICAP = 0.9, 1 / 15, 0.02
"""Where a scale explains so much, a ripple of longer waves than this stands so far behind it."""
RIPPLE_HARMONICS = 3
POSITION_FOLDS = 4
POSITION_RIDGE = 1e-6

ColumnFunction = Callable[[PositionErrors], FloatArray]


@dataclass(frozen=True, slots=True)
class PositionModelClass:
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


POSITION_EFFECTS = ("encoder_scale", "servo_lag", "channel_latency", "velocity_ripple")


def score_model_classes(
    runs: Sequence[PositionErrors], effects: Collection[str] = POSITION_EFFECTS
) -> tuple[PositionModelClass, ...]:
    """Return all families, or those of some effects, the best first."""
    last_s = max(one.session_s for one in runs) + 1.0

    def stretched(one: PositionErrors) -> FloatArray:
        # In motion throughout, a bend is a speed that was not kept.
        bent = 0.0 if one.entering_mm_s else one.command_mm**2 / 40.0
        return np.column_stack((one.command_mm, bent + 0.0 * one.command_mm, one.command_mm * one.session_s / last_s))

    scale = PositionModelClass("encoder_scale", _held_out_share(runs, stretched))

    def ripple() -> PositionModelClass:
        found = _ripple_class(runs)
        if scale.held_out <= DOMINANT_SCALE_SHARE or found.shape >= LONG_WAVE_PER_MM:
            return found
        # Waves as long as half a stroke follow any bend of a scale.
        return replace(found, held_out=min(found.held_out, scale.held_out - LONG_WAVE_HANDICAP))

    forms: tuple[Callable[[], PositionModelClass], ...] = (
        lambda: scale,
        lambda: _lag_class(runs),
        lambda: _latency_class(runs),
        ripple,
    )
    found = [form() for effect, form in zip(POSITION_EFFECTS, forms, strict=True) if effect in effects]
    return tuple(sorted(found, key=lambda one: -one.held_out))


def _lag_class(runs: Sequence[PositionErrors]) -> PositionModelClass:
    """Try linear responses whose times are the same in all runs, or grow with a power of their top speed."""

    def response(power: float) -> ColumnFunction:
        def columns(one: PositionErrors) -> FloatArray:
            slower = (max(one.top_speed_mm_s, MIN_LAG_SPEED_MM_S) / LAG_REFERENCE_SPEED_MM_S) ** power
            return one.late(slower * np.array(DELAYS_S)) - one.late(np.zeros(1))

        return columns

    return PositionModelClass("servo_lag", max(_held_out_share(runs, response(power)) for power in LAG_POWERS))


def _latency_class(runs: Sequence[PositionErrors]) -> PositionModelClass:
    """Try the command at other times, one at a time."""

    def late(latencies_s: FloatArray) -> ColumnFunction:
        return lambda one: one.late(latencies_s) - one.late(np.zeros(1))

    squares, along = np.zeros(LATENCIES_S.size), np.zeros(LATENCIES_S.size)
    for one in runs:
        weight = _block_weights(one)
        column = one.from_zero(late(LATENCIES_S)(one)) * weight[:, None]
        squares += np.einsum("bl,bl->l", column, column)
        along += (one.error_mm * weight) @ column
    best = float(LATENCIES_S[int((along**2 / (squares + 1e-300)).argmax())])
    return PositionModelClass("channel_latency", _held_out_share(runs, late(np.array([best]))), best)


def _ripple_class(runs: Sequence[PositionErrors]) -> PositionModelClass:
    """Try one ripple with its harmonics, and another beside it."""
    first = _best_ripple_wavenumber(runs, ())
    second = _best_ripple_wavenumber(runs, (first,))
    held_out = max(
        _held_out_share(runs, _ripple_columns((first,))), _held_out_share(runs, _ripple_columns((first, second)))
    )
    return PositionModelClass("velocity_ripple", held_out, first)


def _best_ripple_wavenumber(runs: Sequence[PositionErrors], before: tuple[float, ...]) -> float:
    """Return the wave number per mm that explains most of what is left beside others."""
    weights = [_block_weights(one) for one in runs]
    errors = [one.error_mm * weight for one, weight in zip(runs, weights, strict=True)]
    if before:
        bases = [
            one.from_zero(_ripple_columns(before)(one)) * each[:, None] for one, each in zip(runs, weights, strict=True)
        ]
        basis = np.concatenate(bases)
        found = _ridge_solution(basis.T @ basis, basis.T @ np.concatenate(errors))[0]
        errors = [error - each @ found for error, each in zip(errors, bases, strict=True)]
    places = [one.origin_mm + one.command_mm for one in runs]
    reach = max(float(one.max()) for one in places) - min(float(one.min()) for one in places)
    step = WAVE_SPACING_PERIODS / max(reach, RIPPLE_STROKE_MM)
    waves_per_mm = np.arange(MIN_WAVENUMBER_PER_MM, MAX_WAVENUMBER_PER_MM, step)
    near = float(waves_per_mm[int(_wave_powers(runs, errors, weights, waves_per_mm).argmax())])
    tried: list[float] = np.linspace(near - step, near + step, 9).tolist()
    return max(tried, key=lambda wave: _in_sample_share(runs, _ripple_columns((*before, wave))))


def _wave_powers(
    runs: Sequence[PositionErrors],
    errors: Sequence[FloatArray],
    weights: Sequence[FloatArray],
    waves_per_mm: FloatArray,
) -> FloatArray:
    """Return what each wave takes of the squares on its own, shape `(W,)`."""
    gram, along = np.zeros((waves_per_mm.size, 2, 2)), np.zeros((waves_per_mm.size, 2))
    for one, error, weight in zip(runs, errors, weights, strict=True):
        turned = one.from_zero(_sine_columns(one, waves_per_mm)) * weight[:, None]
        pair = turned[:, : waves_per_mm.size], turned[:, waves_per_mm.size :]
        for i, j in ((0, 0), (0, 1), (1, 1)):
            gram[:, i, j] += np.einsum("bw,bw->w", pair[i], pair[j])
        along += (error @ turned).reshape(2, -1).T
    gram[:, 1, 0] = gram[:, 0, 1]
    scale = np.sqrt(np.diagonal(gram, axis1=1, axis2=2)) + 1e-150
    scaled = gram / (scale[:, :, None] * scale[:, None, :]) + POSITION_RIDGE * np.eye(2)
    found = np.linalg.solve(scaled, (along / scale)[:, :, None])[:, :, 0] / scale
    return np.asarray(np.sum(found * along, axis=1))


def _ripple_columns(waves_per_mm: tuple[float, ...]) -> ColumnFunction:
    def columns(one: PositionErrors) -> FloatArray:
        return _sine_columns(one, np.outer(waves_per_mm, np.arange(1, RIPPLE_HARMONICS + 1)).ravel())

    return columns


def _sine_columns(one: PositionErrors, waves_per_mm: FloatArray) -> FloatArray:
    """Return cosines and sines of the place on the rig, nothing where the run begins, shape `(B, 2 W)`."""
    begin = 2 * np.pi * one.origin_mm * waves_per_mm
    turned = 2 * np.pi * (one.origin_mm + one.command_mm)[:, None] * waves_per_mm
    return np.hstack((np.cos(turned) - np.cos(begin), np.sin(turned) - np.sin(begin)))


def _block_weights(one: PositionErrors) -> FloatArray:
    """Let runs count alike, whatever their speed, but those without an error for little."""
    rms = float(np.sqrt(np.mean(one.error_mm**2)))
    return np.full_like(one.error_mm, 1.0 / ((rms + one.count_mm) * np.sqrt(one.error_mm.size)))


def _weighted_products(
    runs: Sequence[PositionErrors], columns: ColumnFunction
) -> Iterator[tuple[FloatArray, FloatArray, float]]:
    for one in runs:
        weight = _block_weights(one)
        basis, error = one.from_zero(columns(one)) * weight[:, None], one.error_mm * weight
        yield basis.T @ basis, basis.T @ error, float(error @ error)


def _ridge_solution(gram: FloatArray, along: FloatArray) -> tuple[FloatArray, float]:
    scale = np.sqrt(np.diag(gram)) + 1e-150
    scaled = gram / np.outer(scale, scale) + POSITION_RIDGE * np.eye(len(scale))
    found = np.linalg.solve(scaled, along / scale) / scale
    return found, float(found @ along)


def _in_sample_share(runs: Sequence[PositionErrors], columns: ColumnFunction) -> float:
    grams, along, squares = zip(*_weighted_products(runs, columns), strict=True)
    taken = _ridge_solution(np.sum(grams, axis=0), np.sum(along, axis=0))[1]
    return taken / max(float(sum(squares)), 1e-300)


def _held_out_share(runs: Sequence[PositionErrors], columns: ColumnFunction) -> float:
    parts = list(_weighted_products(runs, columns))
    folds = min(POSITION_FOLDS, len(parts))
    if folds < 2:
        return _in_sample_share(runs, columns)
    left = whole = 0.0
    for fold in range(folds):
        fitted = [part for number, part in enumerate(parts) if number % folds != fold]
        found, _ = _ridge_solution(
            np.sum([one[0] for one in fitted], axis=0), np.sum([one[1] for one in fitted], axis=0)
        )
        for gram, along, squares in parts[fold::folds]:
            left += squares - 2 * float(found @ along) + float(found @ gram @ found)
            whole += squares
    return 1.0 - left / max(whole, 1e-300)


MAX_EVALUATIONS = 60


@dataclass(frozen=True, slots=True, eq=False)
class PositionAnalysis:
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
    families: tuple[PositionModelClass, ...] = ()
    candidate: Candidate | None = None
    standard_errors: tuple[float, ...] = ()

    @property
    def recorded_wrongly(self) -> bool:
        """Whether the stage was where it was told to be and only its record was not."""
        return bool(self.families) and self.families[0].effect in {"encoder_scale", "channel_latency"}


def analyse_position(experiments: Sequence[Experiment], effects: Sequence[Effect]) -> PositionAnalysis:
    """Look at the position errors of a campaign; `effects` are the candidates."""
    runs = position_errors(experiments)
    if not any(one.strays for one in runs):
        return PositionAnalysis(runs, present=False)
    known = {one.id: one for one in effects}
    found = tuple(one for one in score_model_classes(runs) if one.effect in known)
    if not found:
        return PositionAnalysis(runs, present=True)
    effect = known[found[0].effect]
    if effect.channel is not Channel.POSITION:
        return PositionAnalysis(runs, present=True, families=found)
    candidate, errors = fit_position_effect(runs, effect, found[0])
    return PositionAnalysis(runs, present=True, families=found, candidate=candidate, standard_errors=errors)


def predicted_position_error(candidate: Candidate, one: PositionErrors) -> FloatArray:
    """Return the position error that an effect makes of a run, shape `(B,)` [mm]."""
    effect, values = candidate.effect, dict(candidate.values)
    if effect.phase is not None and effect.period is not None and one.origin_mm:
        # What is periodic stays where it is on the rig, wherever a run begins.
        values[effect.phase.name] += 2 * np.pi * one.origin_mm / values[effect.period.name]
    return one.from_zero(effect.position_change(one.time_s, one.command_mm, values))


def fit_position_effect(
    runs: Sequence[PositionErrors], effect: Effect, family: PositionModelClass
) -> tuple[Candidate, tuple[float, ...]]:
    """Fit the catalogue's own form, from the best of the shapes that it tries; return it with standard errors."""
    from scipy.optimize import least_squares

    start = min(_start_candidates(effect, family), key=lambda one: float(np.sum(_weighted_misfit(one, runs) ** 2)))
    free = start.fitted
    scale = np.array([max(abs(start.values[one.name]), 0.05 * abs(one.default), 1e-4) for one in free])

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
        return _weighted_misfit(at(scaled), runs)

    first = np.array([start.values[one.name] for one in free]) / scale
    found = least_squares(misfit, first, max_nfev=MAX_EVALUATIONS, diff_step=[1e-3] * len(free))
    squares = 2 * float(found.cost) / max(len(found.fun) - len(free), 1)
    slopes = np.asarray(found.jac, dtype=np.float64)
    covariance = np.asarray(np.linalg.pinv(slopes.T @ slopes), dtype=np.float64) * squares
    errors = (np.sqrt(np.maximum(np.diag(covariance), 0.0)) * scale).tolist()
    return at(found.x), tuple(errors)


def _start_candidates(effect: Effect, family: PositionModelClass) -> list[Candidate]:
    from itertools import product

    grids = [_start_values(effect, parameter, family) for parameter in effect.shapes]
    sizes = (0.3, 1.0, 3.0) if effect.size.low >= 0 else (-1.0, 1.0)
    turns = np.linspace(-np.pi, np.pi, 8, endpoint=False) if effect.phase is not None else (0.0,)
    starts = []
    for *shapes, size, turn in product(*grids, sizes, turns):
        values = {**effect.defaults, **{one.name: value for one, value in zip(effect.shapes, shapes, strict=True)}}
        values[effect.size.name] = float(np.clip(size * effect.size.default, effect.size.low, effect.size.high))
        if effect.phase is not None:
            values[effect.phase.name] = float(turn)
        starts.append(Candidate(effect, values))
    return starts


def _start_values(effect: Effect, parameter: EffectParameter, family: PositionModelClass) -> tuple[float, ...]:
    known = parameter.name == effect.period_parameter and family.shape > 0
    return (1.0 / family.shape,) if known else parameter.start_values


def _weighted_misfit(candidate: Candidate, runs: Sequence[PositionErrors]) -> FloatArray:
    parts = []
    for one in runs:
        weight = 1.0 / ((np.sqrt(np.mean(one.error_mm**2)) + 0.001) * np.sqrt(one.error_mm.size))
        parts.append((one.error_mm - predicted_position_error(candidate, one)) * weight)
    return np.concatenate(parts)


POSITION_BOOTSTRAP_SAMPLES = 1000


def position_gap_reduction(found: PositionAnalysis, force: GapReduction) -> GapReduction:
    """Return a shrink whose closed share is that of the position's errors; the force's sizes stay as they are."""
    if found.candidate is None:
        return force
    return closed_share_in_position(found.candidate, found.runs, force)


def closed_share_in_position(
    candidate: Candidate, runs: Sequence[PositionErrors], force: GapReduction, seed: int = 0
) -> GapReduction:
    """Do the same for an effect and runs that took no part in its fit."""
    floor = np.array([one.quantisation_mm**2 + one.noise_mm**2 for one in runs])
    before = np.array([float(np.mean(one.error_mm**2)) for one in runs]) - floor
    after = (
        np.array([float(np.mean((one.error_mm - predicted_position_error(candidate, one)) ** 2)) for one in runs])
        - floor
    )

    def share(rows: Sequence[int] | np.ndarray) -> float:
        return float(1.0 - after[rows].mean() / max(before[rows].mean(), 1e-12))

    everything = np.arange(len(runs))
    drawn = np.random.default_rng(seed).integers(len(runs), size=(POSITION_BOOTSTRAP_SAMPLES, len(runs)))
    low, high = np.quantile([share(one) for one in drawn], (0.025, 0.975)).tolist()
    return replace(force, closed=share(everything), closed_95ci=(low, high))
