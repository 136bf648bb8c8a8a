"""The position channel: recorded minus commanded position, and the effect that explains the difference.

Free-form model classes come first. They ask whether the error can be of a kind at all, whatever its law: a linear
response to the command (servo lag), a function of distance (encoder scale), a periodic one (ripple), the command at
another time (latency). Each class is scored on held-out runs; the best is then fitted in the catalogue's form.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from dragrig.analysis.gap.candidates import Candidate
from dragrig.analysis.gap.diagnosis import GapReduction
from dragrig.analysis.models.drive_model import EXTERNAL_BACKEND
from dragrig.analysis.models.experiment import MIN_COUNT_MM, Experiment, wander_noise_sd_mm
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Channel, Effect, PositionForm, Role, catalogue, find_effect

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
    initial_speed_mm_s
        How fast the stage was told to go already as the record begins; 0 for one that begins at rest.
    encoder_count_mm
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
    initial_speed_mm_s: float = 0.0
    encoder_count_mm: float = MIN_COUNT_MM
    noise_mm: float = 0.0

    @property
    def rms_mm(self) -> float:
        """Its size beyond the encoder's quantisation and noise."""
        squares = float(np.mean(self.error_mm**2)) - self.quantisation_mm**2 / 2 - self.noise_mm**2
        return float(np.sqrt(max(squares, 0.0)))

    @property
    def has_position_error(self) -> bool:
        """Whether it is more than the encoder's counts and noise."""
        return self.rms_mm >= self.detectable_mm

    @property
    def detectable_mm(self) -> float:
        """The least error that is seen."""
        return max(MIN_ERROR_COUNTS * self.encoder_count_mm, self.noise_mm)

    @property
    def quantisation_mm(self) -> float:
        """What its counts make a single position differ by, one standard deviation."""
        return self.encoder_count_mm / float(np.sqrt(12))

    @property
    def top_speed_mm_s(self) -> float:
        """The fastest that the stage was told to go."""
        return float(np.abs(self.velocity_mm_s).max())

    def delayed_command(self, delay_s: float) -> FloatArray:
        """Return the command at the blocks' middles, so much later, shape `(B,)`."""
        return self.delayed_commands(np.array([delay_s]))[:, 0]

    def delayed_commands(self, delays_s: FloatArray) -> FloatArray:
        """Return the command at the blocks' middles, later by each of the delays, shape `(B, D)`."""
        trace = self.experiment.run.trace
        at = self.time_s[:, None] - delays_s
        command = np.interp(at, self.experiment.time_s, np.asarray(trace.command, dtype=np.float64))
        return np.asarray(command + self.initial_speed_mm_s * np.minimum(at - self.experiment.time_s[0], 0.0))

    def zeroed(self, errors: FloatArray) -> FloatArray:
        """Take off what this run's zero takes off its errors, shape `(B,)` or `(B, C)`."""
        if not self.initial_speed_mm_s:
            return errors
        left = errors - errors.mean(axis=0)
        return np.where(np.abs(left) > RELATIVE_ROUNDING * np.abs(errors).max(axis=0), left, 0.0)


def position_errors(experiments: Sequence[Experiment]) -> tuple[PositionErrors, ...]:
    """Return the position errors of all runs that move and recorded a position and a command."""
    starts = [run.run.info.header.start_time for run in experiments]
    origins = [origin_of(run) for run in experiments]
    runs = []
    for experiment, start, origin in zip(experiments, starts, origins, strict=True):
        errors = _errors_of_run(experiment, (start - min(starts)).total_seconds(), origin - origins[0])
        if errors is not None:
            runs.append(errors)
    return tuple(runs)


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
    held_out_share
        Share of the weighted squares that it explains in runs that took no part.
    shape_value
        Wave number per mm, or latency in s; 0 for what has none.
    """

    effect: str
    held_out_share: float
    shape_value: float = 0.0


def score_model_classes(
    runs: Sequence[PositionErrors], effects: Collection[str] | None = None
) -> tuple[PositionModelClass, ...]:
    """Return all families, or those of some effects, the best first."""
    names = {effect.position_form: effect.id for effect in catalogue().values() if effect.position_form is not None}
    last_s = max(run.session_s for run in runs) + 1.0

    def stretched(run: PositionErrors) -> FloatArray:
        # In motion throughout, a bend is a speed that was not kept.
        bent = 0.0 if run.initial_speed_mm_s else run.command_mm**2 / 40.0
        return np.column_stack((run.command_mm, bent + 0.0 * run.command_mm, run.command_mm * run.session_s / last_s))

    scale = PositionModelClass(names[PositionForm.SCALE], _held_out_share(runs, stretched))

    def ripple() -> PositionModelClass:
        model_class = _ripple_class(names[PositionForm.RIPPLE], runs)
        if scale.held_out_share <= DOMINANT_SCALE_SHARE or model_class.shape_value >= LONG_WAVE_PER_MM:
            return model_class
        # Waves as long as half a stroke follow any bend of a scale.
        return replace(
            model_class, held_out_share=min(model_class.held_out_share, scale.held_out_share - LONG_WAVE_HANDICAP)
        )

    scores: Mapping[PositionForm, Callable[[], PositionModelClass]] = {
        PositionForm.SCALE: lambda: scale,
        PositionForm.RESPONSE: lambda: _lag_class(names[PositionForm.RESPONSE], runs),
        PositionForm.DELAY: lambda: _latency_class(names[PositionForm.DELAY], runs),
        PositionForm.RIPPLE: ripple,
    }
    classes = [score() for form, score in scores.items() if effects is None or names[form] in effects]
    return tuple(sorted(classes, key=lambda model_class: -model_class.held_out_share))


def _lag_class(effect: str, runs: Sequence[PositionErrors]) -> PositionModelClass:
    """Try linear responses whose times are the same in all runs, or grow with a power of their top speed."""

    def response(power: float) -> ColumnFunction:
        def columns(run: PositionErrors) -> FloatArray:
            slower = (max(run.top_speed_mm_s, MIN_LAG_SPEED_MM_S) / LAG_REFERENCE_SPEED_MM_S) ** power
            return run.delayed_commands(slower * np.array(DELAYS_S)) - run.delayed_commands(np.zeros(1))

        return columns

    return PositionModelClass(effect, max(_held_out_share(runs, response(power)) for power in LAG_POWERS))


def _latency_class(effect: str, runs: Sequence[PositionErrors]) -> PositionModelClass:
    """Try the command at other times, one at a time."""

    def late(latencies_s: FloatArray) -> ColumnFunction:
        return lambda run: run.delayed_commands(latencies_s) - run.delayed_commands(np.zeros(1))

    squares, along = np.zeros(LATENCIES_S.size), np.zeros(LATENCIES_S.size)
    for run in runs:
        weight = _block_weights(run)
        column = run.zeroed(late(LATENCIES_S)(run)) * weight[:, None]
        squares += np.einsum("bl,bl->l", column, column)
        along += (run.error_mm * weight) @ column
    best = float(LATENCIES_S[int((along**2 / (squares + 1e-300)).argmax())])
    return PositionModelClass(effect, _held_out_share(runs, late(np.array([best]))), best)


def _ripple_class(effect: str, runs: Sequence[PositionErrors]) -> PositionModelClass:
    """Try one ripple with its harmonics, and another beside it."""
    first = _best_ripple_wavenumber(runs, ())
    second = _best_ripple_wavenumber(runs, (first,))
    held_out = max(
        _held_out_share(runs, _ripple_columns((first,))), _held_out_share(runs, _ripple_columns((first, second)))
    )
    return PositionModelClass(effect, held_out, first)


def _best_ripple_wavenumber(runs: Sequence[PositionErrors], known_wavenumbers: tuple[float, ...]) -> float:
    """Return the wave number per mm that explains most of what is left beside others."""
    weights = [_block_weights(run) for run in runs]
    errors = [run.error_mm * weight for run, weight in zip(runs, weights, strict=True)]
    if known_wavenumbers:
        bases = [
            run.zeroed(_ripple_columns(known_wavenumbers)(run)) * values[:, None]
            for run, values in zip(runs, weights, strict=True)
        ]
        basis = np.concatenate(bases)
        result = _ridge_solution(basis.T @ basis, basis.T @ np.concatenate(errors))[0]
        errors = [error - values @ result for error, values in zip(errors, bases, strict=True)]
    places = [run.origin_mm + run.command_mm for run in runs]
    reach = max(float(array.max()) for array in places) - min(float(array.min()) for array in places)
    step = WAVE_SPACING_PERIODS / max(reach, RIPPLE_STROKE_MM)
    waves_per_mm = np.arange(MIN_WAVENUMBER_PER_MM, MAX_WAVENUMBER_PER_MM, step)
    near = float(waves_per_mm[int(_wave_powers(runs, errors, weights, waves_per_mm).argmax())])
    tried: list[float] = np.linspace(near - step, near + step, 9).tolist()
    return max(tried, key=lambda wave: _in_sample_share(runs, _ripple_columns((*known_wavenumbers, wave))))


def _wave_powers(
    runs: Sequence[PositionErrors],
    errors: Sequence[FloatArray],
    weights: Sequence[FloatArray],
    waves_per_mm: FloatArray,
) -> FloatArray:
    """Return what each wave takes of the squares on its own, shape `(W,)`."""
    gram, along = np.zeros((waves_per_mm.size, 2, 2)), np.zeros((waves_per_mm.size, 2))
    for run, error, weight in zip(runs, errors, weights, strict=True):
        turned = run.zeroed(_sine_columns(run, waves_per_mm)) * weight[:, None]
        pair = turned[:, : waves_per_mm.size], turned[:, waves_per_mm.size :]
        for i, j in ((0, 0), (0, 1), (1, 1)):
            gram[:, i, j] += np.einsum("bw,bw->w", pair[i], pair[j])
        along += (error @ turned).reshape(2, -1).T
    gram[:, 1, 0] = gram[:, 0, 1]
    scale = np.sqrt(np.diagonal(gram, axis1=1, axis2=2)) + 1e-150
    scaled = gram / (scale[:, :, None] * scale[:, None, :]) + POSITION_RIDGE * np.eye(2)
    result = np.linalg.solve(scaled, (along / scale)[:, :, None])[:, :, 0] / scale
    return np.asarray(np.sum(result * along, axis=1))


def _ripple_columns(waves_per_mm: tuple[float, ...]) -> ColumnFunction:
    def columns(run: PositionErrors) -> FloatArray:
        return _sine_columns(run, np.outer(waves_per_mm, np.arange(1, RIPPLE_HARMONICS + 1)).ravel())

    return columns


def _sine_columns(run: PositionErrors, waves_per_mm: FloatArray) -> FloatArray:
    """Return cosines and sines of the place on the rig, nothing where the run begins, shape `(B, 2 W)`."""
    begin = 2 * np.pi * run.origin_mm * waves_per_mm
    turned = 2 * np.pi * (run.origin_mm + run.command_mm)[:, None] * waves_per_mm
    return np.hstack((np.cos(turned) - np.cos(begin), np.sin(turned) - np.sin(begin)))


def _block_weights(run: PositionErrors) -> FloatArray:
    """Let runs count alike, whatever their speed, but those without an error for little."""
    rms = float(np.sqrt(np.mean(run.error_mm**2)))
    return np.full_like(run.error_mm, 1.0 / ((rms + run.encoder_count_mm) * np.sqrt(run.error_mm.size)))


def _weighted_products(
    runs: Sequence[PositionErrors], columns: ColumnFunction
) -> Iterator[tuple[FloatArray, FloatArray, float]]:
    for run in runs:
        weight = _block_weights(run)
        basis, error = run.zeroed(columns(run)) * weight[:, None], run.error_mm * weight
        yield basis.T @ basis, basis.T @ error, float(error @ error)


def _ridge_solution(gram: FloatArray, along: FloatArray) -> tuple[FloatArray, float]:
    scale = np.sqrt(np.diag(gram)) + 1e-150
    scaled = gram / np.outer(scale, scale) + POSITION_RIDGE * np.eye(len(scale))
    result = np.linalg.solve(scaled, along / scale) / scale
    return result, float(result @ along)


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
        result, _ = _ridge_solution(
            np.sum([pair[0] for pair in fitted], axis=0), np.sum([pair[1] for pair in fitted], axis=0)
        )
        for gram, along, squares in parts[fold::folds]:
            left += squares - 2 * float(result @ along) + float(result @ gram @ result)
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
    has_position_error
        Whether any run strays from its command by more than the encoder's counts.
    model_classes
        Free forms with the share each explains, the best first; empty without a gap.
    candidate
        The best effect of the catalogue with its parameters fitted; None without one.
    standard_errors
        Of its fitted parameters.
    """

    runs: tuple[PositionErrors, ...]
    has_position_error: bool
    model_classes: tuple[PositionModelClass, ...] = ()
    candidate: Candidate | None = None
    standard_errors: tuple[float, ...] = ()

    @property
    def is_recording_error(self) -> bool:
        """Whether the stage was where it was told to be and only its record was not."""
        return bool(self.model_classes) and not find_effect(self.model_classes[0].effect).moves_stage


def analyse_position(experiments: Sequence[Experiment], effects: Sequence[Effect]) -> PositionAnalysis:
    """Look at the position errors of a campaign; `effects` are the candidates."""
    runs = position_errors(experiments)
    if not any(run.has_position_error for run in runs):
        return PositionAnalysis(runs, has_position_error=False)
    known = {candidate_effect.id: candidate_effect for candidate_effect in effects}
    model_classes = tuple(model_class for model_class in score_model_classes(runs) if model_class.effect in known)
    if not model_classes:
        return PositionAnalysis(runs, has_position_error=True)
    effect = known[model_classes[0].effect]
    if effect.channel is not Channel.POSITION:
        return PositionAnalysis(runs, has_position_error=True, model_classes=model_classes)
    candidate, errors = fit_position_effect(runs, effect, model_classes[0])
    return PositionAnalysis(
        runs, has_position_error=True, model_classes=model_classes, candidate=candidate, standard_errors=errors
    )


def predicted_position_error(candidate: Candidate, run: PositionErrors) -> FloatArray:
    """Return the position error that an effect makes of a run, shape `(B,)` [mm]."""
    effect, values = candidate.effect, dict(candidate.values)
    if effect.phase is not None and effect.period is not None and run.origin_mm:
        # What is periodic stays where it is on the rig, wherever a run begins.
        values[effect.phase.name] += 2 * np.pi * run.origin_mm / values[effect.period.name]
    return run.zeroed(effect.position_change(run.time_s, run.command_mm, values))


def fit_position_effect(
    runs: Sequence[PositionErrors], effect: Effect, model_class: PositionModelClass
) -> tuple[Candidate, tuple[float, ...]]:
    """Fit the catalogue's own form, from the best of the shapes that it tries; return it with standard errors."""
    from scipy.optimize import least_squares

    start = min(
        _start_candidates(effect, model_class),
        key=lambda candidate: float(np.sum(_weighted_misfit(candidate, runs) ** 2)),
    )
    free = start.fitted_parameters
    scale = np.array(
        [max(abs(start.values[parameter.name]), 0.05 * abs(parameter.default), 1e-4) for parameter in free]
    )

    def at(scaled: FloatArray) -> Candidate:
        values = {parameter.name: float(value) for parameter, value in zip(free, scaled * scale, strict=True)}
        limited = {
            parameter.name: values[parameter.name]
            if parameter.role is Role.PHASE
            else float(np.clip(values[parameter.name], parameter.low, parameter.high))
            for parameter in free
        }
        return Candidate(effect, {**start.values, **limited})

    def misfit(scaled: FloatArray) -> FloatArray:
        return _weighted_misfit(at(scaled), runs)

    first = np.array([start.values[parameter.name] for parameter in free]) / scale
    solution = least_squares(misfit, first, max_nfev=MAX_EVALUATIONS, diff_step=[1e-3] * len(free))
    squares = 2 * float(solution.cost) / max(len(solution.fun) - len(free), 1)
    slopes = np.asarray(solution.jac, dtype=np.float64)
    covariance = np.asarray(np.linalg.pinv(slopes.T @ slopes), dtype=np.float64) * squares
    errors = (np.sqrt(np.maximum(np.diag(covariance), 0.0)) * scale).tolist()
    return at(solution.x), tuple(errors)


def _start_candidates(effect: Effect, model_class: PositionModelClass) -> list[Candidate]:
    grids = [
        (1.0 / model_class.shape_value,)
        if parameter.name == effect.period_parameter and model_class.shape_value > 0
        else parameter.start_values
        for parameter in effect.shapes
    ]
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


def _weighted_misfit(candidate: Candidate, runs: Sequence[PositionErrors]) -> FloatArray:
    parts = []
    for run in runs:
        weight = 1.0 / ((np.sqrt(np.mean(run.error_mm**2)) + 0.001) * np.sqrt(run.error_mm.size))
        parts.append((run.error_mm - predicted_position_error(candidate, run)) * weight)
    return np.concatenate(parts)


POSITION_BOOTSTRAP_SAMPLES = 1000


def position_gap_reduction(position: PositionAnalysis, force: GapReduction) -> GapReduction:
    """Return a shrink whose closed share is that of the position's errors; the force's sizes stay as they are."""
    if position.candidate is None:
        return force
    return closed_share_in_position(position.candidate, position.runs, force)


def closed_share_in_position(
    candidate: Candidate, runs: Sequence[PositionErrors], force: GapReduction, seed: int = 0
) -> GapReduction:
    """Do the same for an effect and runs that took no part in its fit."""
    floor = np.array([run.quantisation_mm**2 + run.noise_mm**2 for run in runs])
    before = np.array([float(np.mean(run.error_mm**2)) for run in runs]) - floor
    after = (
        np.array([float(np.mean((run.error_mm - predicted_position_error(candidate, run)) ** 2)) for run in runs])
        - floor
    )

    def share(rows: Sequence[int] | np.ndarray) -> float:
        return float(1.0 - after[rows].mean() / max(before[rows].mean(), 1e-12))

    everything = np.arange(len(runs))
    drawn = np.random.default_rng(seed).integers(len(runs), size=(POSITION_BOOTSTRAP_SAMPLES, len(runs)))
    low, high = np.quantile([share(one) for one in drawn], (0.025, 0.975)).tolist()
    return replace(force, closed=share(everything), closed_95ci=(low, high))
