"""The position channel: recorded minus commanded position, and the effect that explains the difference.

Free-form model classes come first. They ask whether the error can be of a kind at all, whatever its law: a linear
response to the command (servo lag), a function of distance (encoder scale), a periodic one (ripple), the command at
another time (latency), a way left behind at each reversal (play). Each class is scored on held-out runs; the best is
then fitted in the catalogue's form.
"""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from dragrig.analysis import MIN_COUNT_MM, MOTOR_FORCE_CHANNEL, Experiment, session_starts, wander_noise_sd_mm
from dragrig.analysis.gap.design import Candidate
from dragrig.rig import BoolArray, FloatArray
from dragrig.sim_backend.effects import (
    Channel,
    Effect,
    PositionForm,
    Role,
    behind_by_play,
    catalogue,
    find_effect,
)

MAX_BLOCKS = 400
BEFORE_S, AFTER_S = 0.05, 1.5
"""Time of rest before a motion and of hold after it that is evaluated."""
RELATIVE_ROUNDING = 1e-9
MOVING_START_RATIO = 0.5
"""A record whose first speed exceeds this fraction of its highest begins in motion; a ramp starts near 0."""
JITTER_CHANCE_SIGMAS = 4.0
"""A mean square of the clock's errors is larger than expected by so many of its standard deviations by chance."""
MIN_ERROR_COUNTS = 0.7
"""Errors below this number of counts are the encoder's."""


@dataclass(frozen=True, slots=True, eq=False)
class PositionErrors:
    """Position errors of one run, in `B` blocks."""

    experiment: Experiment
    """The run."""
    time_s: FloatArray
    command_mm: FloatArray
    velocity_mm_s: FloatArray
    """`time_s`, `command_mm`, `velocity_mm_s`: middles of the blocks, commanded position and speed; shape `(B,)`."""
    error_mm: FloatArray
    """Recorded minus commanded position, minus its mean over the rest before the motion (over the whole record where it
    begins in motion).
    """
    session_s: float | None
    """Time of the first sample on the session clock; None without a clock."""
    origin_mm: float = 0.0
    """Where the run begins, relative to the first run."""
    initial_speed_mm_s: float = 0.0
    """Commanded speed at the first sample; 0 for a record that begins at rest."""
    encoder_count_mm: float = MIN_COUNT_MM
    """Encoder count; smaller differences do not matter."""
    noise_mm: float = 0.0
    """Standard deviation of the record at rest; 0 for wandering by one count. Dither of a servo does not average out in
    blocks.
    """
    jitter_mm: float = 0.0
    """Rms error of the blocks from a clock whose sampling times scatter."""
    jitter_chance_mm: float = 0.0
    """Root of what the mean square error of few blocks exceeds that of the clock by, by chance."""

    @property
    def rms_mm(self) -> float:
        """Rms error beyond quantisation and noise."""
        squares = float(np.mean(self.error_mm**2)) - self.quantisation_mm**2 / 2 - self.noise_mm**2 - self.jitter_mm**2
        return float(np.sqrt(max(squares, 0.0)))

    @property
    def has_position_error(self) -> bool:
        """Whether the error exceeds counts and noise."""
        return self.rms_mm >= self.detectable_mm

    @property
    def detectable_mm(self) -> float:
        """Smallest detectable error."""
        return max(MIN_ERROR_COUNTS * self.encoder_count_mm, self.noise_mm, self.jitter_mm, self.jitter_chance_mm)

    @property
    def noise_variance(self) -> float:
        """Variance of the error of a block from counts, noise and clock [mm²]."""
        return self.quantisation_mm**2 + self.noise_mm**2 + self.jitter_mm**2

    @property
    def quantisation_mm(self) -> float:
        """Standard deviation of a single position from quantisation."""
        return self.encoder_count_mm / float(np.sqrt(12))

    @property
    def top_speed_mm_s(self) -> float:
        """Highest commanded speed."""
        return float(np.abs(self.velocity_mm_s).max())

    def delayed_command(self, delay_s: float) -> FloatArray:
        """Return the command at the blocks' middles, delayed, shape `(B,)`."""
        return self.delayed_commands(np.array([delay_s]))[:, 0]

    def delayed_commands(self, delays_s: FloatArray) -> FloatArray:
        """Return the command at the blocks' middles, for several delays, shape `(B, D)`."""
        trace = self.experiment.run.trace
        times = self.time_s[:, None] - delays_s
        command = np.interp(times, self.experiment.time_s, np.asarray(trace.command, dtype=np.float64))
        return np.asarray(command + self.initial_speed_mm_s * np.minimum(times - self.experiment.time_s[0], 0.0))

    def delayed_forces(self, channel: str, delays_s: FloatArray) -> FloatArray:
        """Return a force at the blocks' middles minus its first value, for several delays, shape `(B, D)`."""
        force = np.nan_to_num(np.asarray(self.experiment.run.trace.channels[channel], dtype=np.float64))
        times = self.time_s[:, None] - delays_s
        return np.asarray(np.interp(times, self.experiment.time_s, force - force[:20].mean()))

    def zeroed(self, errors: FloatArray) -> FloatArray:
        """Subtract the mean as from this run's errors, shape `(B,)` or `(B, C)`."""
        if not self.initial_speed_mm_s:
            return errors
        centred = errors - errors.mean(axis=0)
        return np.where(np.abs(centred) > RELATIVE_ROUNDING * np.abs(errors).max(axis=0), centred, 0.0)


def position_errors(experiments: Sequence[Experiment]) -> tuple[PositionErrors, ...]:
    """Return the position errors of all moving runs with recorded position and command."""
    starts = session_starts(experiments) or [None] * len(experiments)
    origins = [origin_of(run) for run in experiments]
    runs = []
    for experiment, start, origin in zip(experiments, starts, origins, strict=True):
        errors = _errors_of_run(experiment, start, origin - origins[0])
        if errors is not None:
            runs.append(errors)
    return tuple(runs)


def origin_of(experiment: Experiment) -> float:
    """Return where on its machine an imported measurement begins, to the encoder count.

    Runs of this rig begin at 0: a ripple of the catalogue is relative to the start of each run.
    """
    return round(experiment.origin_mm, 3) if experiment.imported else 0.0


def _errors_of_run(experiment: Experiment, session_s: float | None, origin_mm: float) -> PositionErrors | None:
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
    initial_speed = float(velocity[0]) if abs(velocity[0]) > MOVING_START_RATIO * np.abs(velocity).max() else 0.0
    if initial_speed:
        zero = float(np.mean((position - command)[inside]))
    edges = np.unique(np.linspace(0, inside.size, min(MAX_BLOCKS, inside.size) + 1).astype(int))[:-1]
    count = np.diff(np.append(edges, inside.size))

    def means(values: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(values[inside], edges) / count)

    jitter_variance = experiment.clock_jitter_s**2 * means(velocity**2) / count
    return PositionErrors(
        experiment,
        means(time),
        means(command - command[0]),
        means(velocity),
        means(position - command) - zero,
        session_s,
        origin_mm,
        initial_speed,
        experiment.count_mm,
        wander_noise_sd_mm(experiment.wander_mm, experiment.count_mm),
        float(np.sqrt(np.mean(jitter_variance))),
        float(np.sqrt(JITTER_CHANCE_SIGMAS * np.sqrt(2.0 * np.sum(jitter_variance**2)) / count.size)),
    )


DELAYS_S = (0.002, 0.004, 0.008, 0.016, 0.03, 0.05, 0.08, 0.12, 0.2, 0.35, 0.6)
"""Delays of the command that make up a linear response."""
LAG_POWERS = (0.0, 0.4, 0.8)
"""Powers of the top speed with which a lag may grow, as motors run out of voltage."""
LAG_REFERENCE_SPEED_MM_S, MIN_LAG_SPEED_MM_S = 20.0, 0.1
LATENCIES_S = np.concatenate((-np.geomspace(0.1, 0.0005, 24), np.geomspace(0.0005, 0.1, 24)))
MIN_WAVENUMBER_PER_MM, MAX_WAVENUMBER_PER_MM, RIPPLE_STROKE_MM, WAVE_SPACING_PERIODS = 1 / 30, 1 / 0.6, 45.0, 0.25
"""Trial wave numbers of a ripple: adjacent ones differ by a quarter of a period over the travel."""
MAX_TRIED_WAVES = 20_000
"""Those of a way of three metres."""
DOMINANT_SCALE_SHARE, LONG_WAVE_PER_MM, LONG_WAVE_HANDICAP = 0.9, 1 / 15, 0.02
"""Where a scale explains this share, a ripple with longer waves than this ranks behind it by the handicap."""
PLAYS_MM, SHARES_TAKEN_UP = np.geomspace(0.003, 5.0, 30), (0.0, 0.25, 0.5, 0.75, 1.0)
MIN_SPEED_SHARE = 0.01
"""Slower commands than this share of the highest are rounding."""
RIPPLE_HARMONICS = 3
STEADY_SPEED_RATIO, MIN_STEADY_BLOCKS, STEADY_TREND_DEGREE = 0.95, 20, 2
"""Steady motion is above this fraction of the run's highest speed; there each run may have a trend of its own."""
MIN_STEADY_RIPPLE_SHARE = 0.2
"""Share of the squares about the trends of steady motion that a single wave of all runs explains where the stage
ripples: at least 0.25 in simulated ripples of any form, alone or beside a lag, at most 0.1 elsewhere."""
MIN_SHARE_BESIDE_RIPPLE, MIN_HELD_OUT_BESIDE_RIPPLE = 0.02, 0.7
"""A ripple explains and leaves at least this share of the squares where another error acts beside it, which explains at
least that share of what is left."""
POSITION_FOLDS = 4
POSITION_RIDGE = 1e-6

ColumnFunction = Callable[[PositionErrors], FloatArray]


@dataclass(frozen=True, slots=True)
class PositionModelClass:
    """Held-out score of a free-form model class of the position error."""

    effect: str
    """Effect that it stands for."""
    held_out_share: float
    """Share of the weighted squares that it explains in held-out runs."""
    shape_value: float = 0.0
    """Wave number per mm, latency in s, or play in mm; 0 for others."""


def score_model_classes(
    runs: Sequence[PositionErrors], effects: Collection[str] | None = None
) -> tuple[PositionModelClass, ...]:
    """Return all model classes, or those of some effects, by decreasing held-out share."""
    names = {effect.position_form: effect.id for effect in catalogue().values() if effect.position_form is not None}
    last_s = max(run.session_s or 0.0 for run in runs) + 1.0

    def stretched(run: PositionErrors) -> FloatArray:
        # In motion throughout, curvature is a speed error.
        curvature = 0.0 if run.initial_speed_mm_s else run.command_mm**2 / 40.0
        return np.column_stack(
            (run.command_mm, curvature + 0.0 * run.command_mm, run.command_mm * (run.session_s or 0.0) / last_s)
        )

    scale = PositionModelClass(names[PositionForm.SCALE], _held_out_share(runs, stretched))

    def ripple() -> PositionModelClass:
        model_class = _ripple_class(names[PositionForm.RIPPLE], runs)
        if scale.held_out_share <= DOMINANT_SCALE_SHARE or model_class.shape_value >= LONG_WAVE_PER_MM:
            return model_class
        # Waves as long as half a stroke fit any curvature of a scale.
        return replace(
            model_class, held_out_share=min(model_class.held_out_share, scale.held_out_share - LONG_WAVE_HANDICAP)
        )

    scores: dict[PositionForm, Callable[[], PositionModelClass]] = {
        PositionForm.SCALE: lambda: scale,
        PositionForm.RESPONSE: lambda: _lag_class(names[PositionForm.RESPONSE], runs),
        PositionForm.DELAY: lambda: _latency_class(names[PositionForm.DELAY], runs),
        PositionForm.RIPPLE: ripple,
    }
    velocity = np.concatenate([run.velocity_mm_s for run in runs])
    # No play shows where the command goes one way.
    if min(velocity.max(), -velocity.min()) > MIN_SPEED_SHARE * float(np.abs(velocity).max()):
        scores |= {PositionForm.PLAY: lambda: _play_class(names[PositionForm.PLAY], runs)}
    if effects is None or names[PositionForm.RIPPLE] in effects:
        steady = SteadyRipple.of(runs)
        if steady is not None and steady.is_there:
            scores |= {PositionForm.RIPPLE: lambda: _in_steady_motion(ripple(), steady, runs)}
    classes = [score() for form, score in scores.items() if effects is None or names[form] in effects]
    return tuple(sorted(classes, key=lambda model_class: -model_class.held_out_share))


def _in_steady_motion(
    model_class: PositionModelClass, steady: "SteadyRipple", runs: Sequence[PositionErrors]
) -> PositionModelClass:
    """Return the score of a ripple with an amplitude and an offset in motion of each run's own, if that is higher."""
    left = _weighted_squares([_without_offset(run) for run in steady.runs], runs) / _weighted_squares(runs, runs)
    if 1.0 - left <= model_class.held_out_share:
        return model_class
    return replace(model_class, held_out_share=1.0 - left, shape_value=steady.wave_per_mm)


def error_beside_ripple(
    runs: Sequence[PositionErrors], classes: Sequence[PositionModelClass]
) -> tuple[PositionModelClass, PositionModelClass, float] | None:
    """Return a ripple in steady motion, another error beside it, and the share that both explain; None for fewer."""
    ripple = next((entry for entry in classes if find_effect(entry.effect).position_form is PositionForm.RIPPLE), None)
    steady = SteadyRipple.of(runs)
    others = {entry.effect for entry in classes if entry is not ripple}
    if ripple is None or steady is None or not steady.is_there or not others:
        return None
    beside = score_model_classes(steady.runs, others)[0]
    left = _weighted_squares(steady.runs, runs) / _weighted_squares(runs, runs)
    both_matter = MIN_SHARE_BESIDE_RIPPLE <= left <= 1.0 - MIN_SHARE_BESIDE_RIPPLE
    if beside.held_out_share < MIN_HELD_OUT_BESIDE_RIPPLE or not both_matter:
        return None
    return ripple, beside, 1.0 - left * (1.0 - beside.held_out_share)


def _lag_class(effect: str, runs: Sequence[PositionErrors]) -> PositionModelClass:
    """Score linear responses with delays equal in all runs, or growing with a power of the top speed."""

    def response(power: float) -> ColumnFunction:
        def columns(run: PositionErrors) -> FloatArray:
            factor = (max(run.top_speed_mm_s, MIN_LAG_SPEED_MM_S) / LAG_REFERENCE_SPEED_MM_S) ** power
            return run.delayed_commands(factor * np.array(DELAYS_S)) - run.delayed_commands(np.zeros(1))

        return columns

    return PositionModelClass(effect, max(_held_out_share(runs, response(power)) for power in LAG_POWERS))


def _latency_class(effect: str, runs: Sequence[PositionErrors]) -> PositionModelClass:
    """Score the command at another time."""

    def delayed(latencies_s: FloatArray) -> ColumnFunction:
        return lambda run: run.delayed_commands(latencies_s) - run.delayed_commands(np.zeros(1))

    squares, moments = np.zeros(LATENCIES_S.size), np.zeros(LATENCIES_S.size)
    for run in runs:
        weight = position_weights(run)
        column = run.zeroed(delayed(LATENCIES_S)(run)) * weight[:, None]
        squares += np.einsum("bl,bl->l", column, column)
        moments += (run.error_mm * weight) @ column
    best = float(LATENCIES_S[int((moments**2 / (squares + 1e-300)).argmax())])
    return PositionModelClass(effect, _held_out_share(runs, delayed(np.array([best]))), best)


def _play_class(effect: str, runs: Sequence[PositionErrors]) -> PositionModelClass:
    """Score a play that is taken up by some share as runs begin."""

    def column(play: tuple[float, float]) -> ColumnFunction:
        return lambda run: behind_by_play(run.command_mm, *play)[:, None]

    plays = product(PLAYS_MM.tolist(), SHARES_TAKEN_UP)
    best = max(plays, key=lambda play: _in_sample_share(runs, column(play)))
    return PositionModelClass(effect, _held_out_share(runs, column(best)), best[0])


def _ripple_class(effect: str, runs: Sequence[PositionErrors]) -> PositionModelClass:
    """Score one ripple with harmonics, and two."""
    first = _best_ripple_wavenumber(runs, ())
    second = _best_ripple_wavenumber(runs, (first,))
    held_out = max(
        _held_out_share(runs, _ripple_columns((first,))), _held_out_share(runs, _ripple_columns((first, second)))
    )
    return PositionModelClass(effect, held_out, first)


def _best_ripple_wavenumber(runs: Sequence[PositionErrors], known_wavenumbers: tuple[float, ...]) -> float:
    """Return the wave number per mm that explains most of the residual beside known ones."""
    weights = [position_weights(run) for run in runs]
    errors = [run.error_mm * weight for run, weight in zip(runs, weights, strict=True)]
    if known_wavenumbers:
        bases = [
            run.zeroed(_ripple_columns(known_wavenumbers)(run)) * values[:, None]
            for run, values in zip(runs, weights, strict=True)
        ]
        basis = np.concatenate(bases)
        coefficients = _ridge_solution(basis.T @ basis, basis.T @ np.concatenate(errors))[0]
        errors = [error - values @ coefficients for error, values in zip(errors, bases, strict=True)]
    places = [run.origin_mm + run.command_mm for run in runs]
    reach = max(float(array.max()) for array in places) - min(float(array.min()) for array in places)
    step = WAVE_SPACING_PERIODS / max(reach, RIPPLE_STROKE_MM)
    # Over a longer way a ripple is looked for less finely: a damaged command would otherwise take all memory.
    step = max(step, (MAX_WAVENUMBER_PER_MM - MIN_WAVENUMBER_PER_MM) / MAX_TRIED_WAVES)
    waves_per_mm = np.arange(MIN_WAVENUMBER_PER_MM, MAX_WAVENUMBER_PER_MM, step)
    coarse = float(waves_per_mm[int(_wave_powers(runs, errors, weights, waves_per_mm).argmax())])
    refined: list[float] = np.linspace(coarse - step, coarse + step, 9).tolist()
    return max(refined, key=lambda wave: _in_sample_share(runs, _ripple_columns((*known_wavenumbers, wave))))


def _wave_powers(
    runs: Sequence[PositionErrors],
    errors: Sequence[FloatArray],
    weights: Sequence[FloatArray],
    waves_per_mm: FloatArray,
) -> FloatArray:
    """Return the squares that each wave explains alone, shape `(W,)`."""
    gram, moments = np.zeros((waves_per_mm.size, 2, 2)), np.zeros((waves_per_mm.size, 2))
    for run, error, weight in zip(runs, errors, weights, strict=True):
        waves = run.zeroed(_sine_columns(run, waves_per_mm)) * weight[:, None]
        pair = waves[:, : waves_per_mm.size], waves[:, waves_per_mm.size :]
        for i, j in ((0, 0), (0, 1), (1, 1)):
            gram[:, i, j] += np.einsum("bw,bw->w", pair[i], pair[j])
        moments += (error @ waves).reshape(2, -1).T
    gram[:, 1, 0] = gram[:, 0, 1]
    scale = np.sqrt(np.diagonal(gram, axis1=1, axis2=2)) + 1e-150
    scaled = gram / (scale[:, :, None] * scale[:, None, :]) + POSITION_RIDGE * np.eye(2)
    coefficients = np.linalg.solve(scaled, (moments / scale)[:, :, None])[:, :, 0] / scale
    return np.asarray(np.sum(coefficients * moments, axis=1))


def _ripple_columns(waves_per_mm: tuple[float, ...]) -> ColumnFunction:
    def columns(run: PositionErrors) -> FloatArray:
        return _sine_columns(run, np.outer(waves_per_mm, np.arange(1, RIPPLE_HARMONICS + 1)).ravel())

    return columns


def _sine_columns(run: PositionErrors, waves_per_mm: FloatArray) -> FloatArray:
    """Return cosines and sines of the position on the machine, 0 at the begin of the run, shape `(B, 2 W)`."""
    initial_phase = 2 * np.pi * run.origin_mm * waves_per_mm
    phase = 2 * np.pi * (run.origin_mm + run.command_mm)[:, None] * waves_per_mm
    return np.hstack((np.cos(phase) - np.cos(initial_phase), np.sin(phase) - np.sin(initial_phase)))


@dataclass(frozen=True, slots=True, eq=False)
class SteadyRipple:
    """A wave along the stroke that all runs share in steady motion, whatever its amplitude in each."""

    wave_per_mm: float
    share: float
    """Share of the squares about the trends of steady motion that it explains."""
    rms_mm: float
    """Root mean square of it in steady motion, where it is largest."""
    runs: tuple[PositionErrors, ...]
    """The runs without it."""

    @property
    def is_there(self) -> bool:
        """Whether the stage ripples, with a wave that is no end of the range, where trends end up, and above counts."""
        visible = self.rms_mm >= max(run.detectable_mm for run in self.runs)
        return visible and self.share >= MIN_STEADY_RIPPLE_SHARE and self.wave_per_mm > LONG_WAVE_PER_MM

    @classmethod
    def of(cls, runs: Sequence[PositionErrors]) -> "SteadyRipple | None":
        """Find the wave that explains most of steady motion; None where no run has any."""
        steady = [_SteadyMotion.of(run) for run in runs]
        found = [motion for motion in steady if motion is not None]
        if not found:
            return None
        step = WAVE_SPACING_PERIODS / RIPPLE_STROKE_MM
        waves_per_mm = np.arange(LONG_WAVE_PER_MM, MAX_WAVENUMBER_PER_MM, step)
        coarse = float(waves_per_mm[int(_steady_powers(found, waves_per_mm).argmax())])
        refined = np.linspace(max(coarse - step, LONG_WAVE_PER_MM), coarse + step, 9)
        powers = _steady_powers(found, refined)
        wave = float(refined[int(powers.argmax())])
        squares = [float(motion.error_mm @ motion.error_mm) for motion in found]
        share = float(powers.max()) / max(sum(squares), 1e-300)
        return cls(wave, share, float(np.sqrt(share * max(squares))), _without_wave(runs, steady, wave))


@dataclass(frozen=True, slots=True, eq=False)
class _SteadyMotion:
    """Steady motion of a run, every quantity about its trend and divided by the root of the number of blocks."""

    place_mm: FloatArray
    trend: FloatArray
    error_mm: FloatArray

    @classmethod
    def of(cls, run: PositionErrors) -> "_SteadyMotion | None":
        steady = np.abs(run.velocity_mm_s) > STEADY_SPEED_RATIO * run.top_speed_mm_s
        if np.count_nonzero(steady) < MIN_STEADY_BLOCKS:
            return None
        place = (run.origin_mm + run.command_mm)[steady]
        trend = np.linalg.qr(np.vander(place - place.mean(), STEADY_TREND_DEGREE + 1))[0]
        motion = cls(place, trend, run.error_mm[steady])
        return replace(motion, error_mm=motion.about_trend(run.error_mm[steady]))

    def about_trend(self, values: FloatArray) -> FloatArray:
        """Return values `(B,)` or `(B, C)` about their trends, divided by the root of B."""
        return np.asarray((values - self.trend @ (self.trend.T @ values)) / np.sqrt(len(self.place_mm)))

    def waves(self, waves_per_mm: FloatArray) -> FloatArray:
        """Return cosines and sines about their trends, shape `(B, 2 W)`."""
        phase = 2 * np.pi * self.place_mm[:, None] * waves_per_mm
        return self.about_trend(np.hstack((np.cos(phase), np.sin(phase))))


def _steady_powers(steady: Sequence[_SteadyMotion], waves_per_mm: FloatArray) -> FloatArray:
    """Return the squares that each wave explains alone, with one amplitude and phase in all runs, shape `(W,)`."""
    gram, moments = np.zeros((waves_per_mm.size, 2, 2)), np.zeros((waves_per_mm.size, 2))
    for motion in steady:
        waves = motion.waves(waves_per_mm).reshape(-1, 2, waves_per_mm.size)
        gram += np.einsum("biw,bjw->wij", waves, waves)
        moments += np.einsum("b,biw->wi", motion.error_mm, waves)
    ridge = POSITION_RIDGE * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 1e-150
    return np.asarray(np.einsum("wi,wi->w", np.linalg.solve(gram + ridge, moments[:, :, None])[:, :, 0], moments))


def _without_wave(
    runs: Sequence[PositionErrors], steady: Sequence[_SteadyMotion | None], wave_per_mm: float
) -> tuple[PositionErrors, ...]:
    """Subtract a wave with harmonics from all runs, its amplitude each run's own.

    It may begin at its value at rest, or at zero where the stage ripples in motion alone; the choice with the smaller
    residual is taken.
    """
    waves = np.asarray(wave_per_mm * np.arange(1, RIPPLE_HARMONICS + 1), dtype=np.float64)
    columns = [None if motion is None else motion.waves(waves) for motion in steady]
    pairs = [(values, motion) for values, motion in zip(columns, steady, strict=True) if motion and values is not None]
    gram = np.sum([values.T @ values for values, _ in pairs], axis=0)
    moment = np.sum([values.T @ motion.error_mm for values, motion in pairs], axis=0)
    form = _ridge_solution(gram, moment)[0]
    from_rest, in_motion = list[PositionErrors](), list[PositionErrors]()
    for run, values, motion in zip(runs, columns, steady, strict=True):
        amplitude = 1.0
        if values is not None and motion is not None:
            wave = values @ form
            amplitude = float(wave @ motion.error_mm) / max(float(wave @ wave), 1e-300)
        phase = 2 * np.pi * (run.origin_mm + run.command_mm)[:, None] * waves
        ripple = amplitude * (np.hstack((np.cos(phase), np.sin(phase))) @ form)
        moves = _moves(run)
        from_rest.append(replace(run, error_mm=run.error_mm - run.zeroed(ripple - ripple[0])))
        in_motion.append(replace(run, error_mm=run.error_mm - run.zeroed(ripple * moves)))
    if _weighted_squares(from_rest, runs) < _weighted_squares(in_motion, runs):
        return tuple(from_rest)
    return tuple(in_motion)


def _moves(run: PositionErrors) -> BoolArray:
    return np.asarray(np.abs(run.velocity_mm_s) > (1 - STEADY_SPEED_RATIO) * run.top_speed_mm_s)


def _without_offset(run: PositionErrors) -> PositionErrors:
    """Subtract the mean error of the motion from it."""
    moves = _moves(run)
    return replace(run, error_mm=run.error_mm - moves * (run.error_mm[moves].mean() if moves.any() else 0.0))


def _weighted_squares(runs: Sequence[PositionErrors], weighted_as: Sequence[PositionErrors]) -> float:
    """Return the sum of squares with the weights of other errors of these runs, at least the smallest number."""
    pairs = zip(runs, weighted_as, strict=True)
    return max(sum(float(np.sum((run.error_mm * position_weights(original)) ** 2)) for run, original in pairs), 1e-300)


def position_weights(run: PositionErrors) -> FloatArray:
    """Weight runs equally whatever their speed, and runs without errors little."""
    rms = float(np.sqrt(np.mean(run.error_mm**2)))
    return np.full_like(run.error_mm, 1.0 / ((rms + run.encoder_count_mm) * np.sqrt(run.error_mm.size)))


def _weighted_products(
    runs: Sequence[PositionErrors], columns: ColumnFunction
) -> Iterator[tuple[FloatArray, FloatArray, float]]:
    for run in runs:
        weight = position_weights(run)
        basis, error = run.zeroed(columns(run)) * weight[:, None], run.error_mm * weight
        yield basis.T @ basis, basis.T @ error, float(error @ error)


def _ridge_solution(gram: FloatArray, moment: FloatArray) -> tuple[FloatArray, float]:
    scale = np.sqrt(np.diag(gram)) + 1e-150
    scaled = gram / np.outer(scale, scale) + POSITION_RIDGE * np.eye(len(scale))
    coefficients = np.linalg.solve(scaled, moment / scale) / scale
    return coefficients, float(coefficients @ moment)


def _in_sample_share(runs: Sequence[PositionErrors], columns: ColumnFunction) -> float:
    grams, moments, squares = zip(*_weighted_products(runs, columns), strict=True)
    explained = _ridge_solution(np.sum(grams, axis=0), np.sum(moments, axis=0))[1]
    return explained / max(float(sum(squares)), 1e-300)


def _held_out_share(runs: Sequence[PositionErrors], columns: ColumnFunction) -> float:
    products = list(_weighted_products(runs, columns))
    folds = min(POSITION_FOLDS, len(products))
    if folds < 2:
        return _in_sample_share(runs, columns)
    remaining = total = 0.0
    for fold in range(folds):
        others = [products_of_run for number, products_of_run in enumerate(products) if number % folds != fold]
        coefficients, _ = _ridge_solution(
            np.sum([item[0] for item in others], axis=0), np.sum([item[1] for item in others], axis=0)
        )
        for gram, moment, squares in products[fold::folds]:
            remaining += squares - 2 * float(coefficients @ moment) + float(coefficients @ gram @ coefficients)
            total += squares
    return 1.0 - remaining / max(total, 1e-300)


MIN_POSITION_SHARE, POSITION_SHARE_WIDTH = 0.7, 0.04
"""Held-out share of the position error that an effect explains: midpoint and width of the logistic."""
POSITION_RIVAL_SLOPE = 400.0
"""Weight of a rival: exp(-slope · difference of the held-out shares)."""
MAX_EVALUATIONS = 60


@dataclass(frozen=True, slots=True, eq=False)
class PositionAnalysis:
    """Result of the position channel."""

    runs: tuple[PositionErrors, ...]
    """Errors of each run."""
    has_position_error: bool
    """Whether any run deviates from its command by more than counts and noise."""
    model_classes: tuple[PositionModelClass, ...] = ()
    """Model classes by decreasing held-out share; empty without errors."""
    candidate: Candidate | None = None
    """Best effect of the catalogue with fitted parameters; None for none."""
    standard_errors: tuple[float, ...] = ()
    """Standard errors of its fitted parameters."""
    together: tuple[str, ...] = ()
    """Two effects that act together, the ripple last; empty for fewer."""
    share_together: float = 0.0
    """Share of the weighted squares that they explain."""
    yielding: "Yielding | None" = None
    """How the stage gives way to a force, which the errors of the runs are without; None where it does not."""

    @property
    def is_recording_error(self) -> bool:
        """Whether the stage followed its command and only the record is wrong."""
        likely = self.together or tuple(model_class.effect for model_class in self.model_classes[:1])
        return bool(likely) and not any(find_effect(effect).moves_stage for effect in likely)

    @property
    def shares(self) -> tuple[tuple[str, float], ...]:
        """Share that each effect explains, and two together, their names joined with `+`; the highest first."""
        entries = [(model_class.effect, model_class.held_out_share) for model_class in self.model_classes]
        if self.together:
            entries.append(("+".join(self.together), self.share_together))
        return tuple(sorted(entries, key=lambda entry: -entry[1]))


YIELDING_DELAYS_S = np.array([0.0, 0.004, 0.008, 0.016, 0.03, 0.05, 0.08])
"""Delays of the force that make up the response to it of a position loop from 20 Hz on."""
MAX_YIELDING_MM = {MOTOR_FORCE_CHANNEL: np.inf, "force": 0.2}
"""Position loops give way to the force of a gut by less: half a kilogram held at 20 Hz, to 1.6 N. The motor's own force
is what the loop makes of the error, however large."""
YIELDING_FORM_ERROR = 0.15
"""Share of the way that a stage gives way by that another response than the fitted one may leave; 8 to 10 % are left of
loops of 20 to 70 Hz."""


@dataclass(frozen=True, slots=True)
class Yielding:
    """How far a stage gives way to the force, as position loops do: no gap where the motion is the recorded one."""

    channel: str
    """The force that it gives way to: of the sensor, or of the motor."""
    held_out_share: float
    """Share of the weighted squares of the position errors, in held-out runs."""
    most_mm: float
    """Largest way in any run."""
    um_per_N: float
    """Way per force."""
    lag_s: float
    """Mean delay of the way after the force."""
    left: tuple[PositionErrors, ...]
    """The runs with the errors that are left."""


def stage_yielding(runs: Sequence[PositionErrors]) -> Yielding | None:
    """Return how far the stage gives way; None where it does not, or further than loops do, or force is missing."""
    found = (_yielding_to(channel, runs) for channel in MAX_YIELDING_MM)
    return max((way for way in found if way is not None), key=lambda way: way.held_out_share, default=None)


def _yielding_to(channel: str, runs: Sequence[PositionErrors]) -> Yielding | None:
    if any(channel not in run.experiment.run.trace.channels for run in runs):
        return None

    def response(run: PositionErrors) -> FloatArray:
        return run.delayed_forces(channel, YIELDING_DELAYS_S)

    grams, moments, _ = zip(*_weighted_products(runs, response), strict=True)
    coefficients = _ridge_solution(np.sum(grams, axis=0), np.sum(moments, axis=0))[0]
    ways, compliance = [run.zeroed(response(run) @ coefficients) for run in runs], -float(coefficients.sum())
    most = max(float(np.abs(way).max()) for way in ways)
    if compliance <= 0 or most > MAX_YIELDING_MM[channel]:
        return None
    left = tuple(
        replace(
            run,
            error_mm=run.error_mm - way,
            noise_mm=float(np.hypot(run.noise_mm, YIELDING_FORM_ERROR * np.sqrt(np.mean(way**2)))),
        )
        for run, way in zip(runs, ways, strict=True)
    )
    lag_s = -float(coefficients @ YIELDING_DELAYS_S) / compliance
    return Yielding(channel, _held_out_share(runs, response), most, 1e6 * compliance, lag_s, left)


def analyse_position(experiments: Sequence[Experiment], effects: Sequence[Effect]) -> PositionAnalysis:
    """Analyse the position errors of a campaign; `effects` are the candidates."""
    runs = position_errors(experiments)
    if not any(run.has_position_error for run in runs):
        return PositionAnalysis(runs, has_position_error=False)
    known = {candidate_effect.id: candidate_effect for candidate_effect in effects}
    model_classes = tuple(model_class for model_class in score_model_classes(runs) if model_class.effect in known)
    yielding = stage_yielding(runs)
    best = max((model_class.held_out_share for model_class in model_classes), default=0.0)
    if yielding is not None and yielding.held_out_share <= best:
        yielding = None
    if yielding is not None:
        runs = yielding.left
        if not any(run.has_position_error for run in runs):
            return PositionAnalysis(runs, has_position_error=False, yielding=yielding)
        model_classes = tuple(model_class for model_class in score_model_classes(runs) if model_class.effect in known)
    analysis = PositionAnalysis(runs, has_position_error=True, model_classes=model_classes, yielding=yielding)
    if not model_classes:
        return analysis
    effect = known[model_classes[0].effect]
    pair = error_beside_ripple(runs, model_classes)
    if pair is not None:
        ripple, beside, share = pair
        analysis = replace(analysis, together=(beside.effect, ripple.effect), share_together=share)
    if effect.channel is not Channel.POSITION:
        return analysis
    candidate, errors = fit_position_effect(runs, effect, model_classes[0])
    return replace(analysis, candidate=candidate, standard_errors=errors)


def predicted_position_error(candidate: Candidate, run: PositionErrors) -> FloatArray:
    """Return the position error of a run caused by an effect, shape `(B,)` [mm]."""
    effect, values = candidate.effect, dict(candidate.values)
    if effect.phase is not None and effect.period is not None and run.origin_mm:
        # A periodic error is fixed to the machine, wherever a run begins.
        values[effect.phase.name] += 2 * np.pi * run.origin_mm / values[effect.period.name]
    return run.zeroed(effect.position_change(run.time_s, run.command_mm, values))


def fit_position_effect(
    runs: Sequence[PositionErrors], effect: Effect, model_class: PositionModelClass
) -> tuple[Candidate, tuple[float, ...]]:
    """Fit the catalogue's form of an effect from its best start values; return it with standard errors."""
    from scipy.optimize import least_squares

    start = min(
        _start_candidates(effect, model_class),
        key=lambda candidate: float(np.sum(_weighted_misfit(candidate, runs) ** 2)),
    )
    parameters = start.fitted_parameters
    scale = np.array(
        [max(abs(start.values[parameter.name]), 0.05 * abs(parameter.default), 1e-4) for parameter in parameters]
    )

    def candidate_at(scaled: FloatArray) -> Candidate:
        limited = {
            parameter.name: value if parameter.role is Role.PHASE else min(max(value, parameter.low), parameter.high)
            for parameter, value in zip(parameters, (scaled * scale).tolist(), strict=True)
        }
        return Candidate(effect, {**start.values, **limited})

    def misfit(scaled: FloatArray) -> FloatArray:
        return _weighted_misfit(candidate_at(scaled), runs)

    first = np.array([start.values[parameter.name] for parameter in parameters]) / scale
    solution = least_squares(misfit, first, max_nfev=MAX_EVALUATIONS, diff_step=[1e-3] * len(parameters))
    variance = 2 * float(solution.cost) / max(len(solution.fun) - len(parameters), 1)
    jacobian = np.asarray(solution.jac, dtype=np.float64)
    covariance = np.asarray(np.linalg.pinv(jacobian.T @ jacobian), dtype=np.float64) * variance
    errors = (np.sqrt(np.maximum(np.diag(covariance), 0.0)) * scale).tolist()
    return candidate_at(solution.x), tuple(errors)


def _start_candidates(effect: Effect, model_class: PositionModelClass) -> list[Candidate]:
    grids = [
        (1.0 / model_class.shape_value,)
        if parameter.name == effect.period_parameter and model_class.shape_value > 0
        else parameter.start_values
        for parameter in effect.shapes
    ]
    sizes: tuple[float, ...] = (0.3, 1.0, 3.0) if effect.size.low >= 0 else (-1.0, 1.0)
    if effect.position_form is PositionForm.PLAY and model_class.shape_value > 0:
        sizes = tuple(factor * model_class.shape_value / effect.size.default for factor in (0.8, 1.0, 1.25))
    phases = np.linspace(-np.pi, np.pi, 8, endpoint=False) if effect.phase is not None else (0.0,)
    starts = []
    for *shapes, size, phase_rad in product(*grids, sizes, phases):
        values = {**effect.defaults, **{shape.name: value for shape, value in zip(effect.shapes, shapes, strict=True)}}
        values[effect.size.name] = float(np.clip(size * effect.size.default, effect.size.low, effect.size.high))
        if effect.phase is not None:
            values[effect.phase.name] = float(phase_rad)
        starts.append(Candidate(effect, values))
    return starts


def _weighted_misfit(candidate: Candidate, runs: Sequence[PositionErrors]) -> FloatArray:
    residuals = []
    for run in runs:
        weight = 1.0 / ((np.sqrt(np.mean(run.error_mm**2)) + 0.001) * np.sqrt(run.error_mm.size))
        residuals.append((run.error_mm - predicted_position_error(candidate, run)) * weight)
    return np.concatenate(residuals)


def contribution_to_position(candidate: Candidate, run: PositionErrors) -> FloatArray:
    """Return the part of an effect in the position of a run, with an amplitude of the run's own, shape `(B,)` [mm].

    Real effects grow otherwise with the speed than the catalogue's; none acts against its own sign.
    """
    predicted = predicted_position_error(candidate, run)
    along = float(predicted @ run.error_mm)
    return np.asarray(predicted * (max(along, 0.0) / max(float(predicted @ predicted), 1e-300)))
