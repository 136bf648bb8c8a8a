"""Size of the gap before and after an explanation: residuals, noise floor, held-out runs and closed share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis import (
    SPEED_TOLERANCE,
    NoiseModel,
    Whitening,
    in_phase,
    r2_eq15,
    squared_correlation,
    steady_stretch,
)
from dragrig.analysis.gap.design import (
    NUISANCES,
    Candidate,
    ColumnKind,
    Design,
    RankedEffect,
    Study,
    fit_columns,
    nominal_residuals,
    project_dictionary,
    rank_effects,
)
from dragrig.analysis.gap.diagnosis import GapReduction, R2BeforeAfter, RunTraces, SteadyLevels
from dragrig.analysis.gap.excess import ResidualBlocks
from dragrig.analysis.gap.forward_selection import ForceSearchResult
from dragrig.analysis.gap.hypothesis_fit import HypothesisFit
from dragrig.analysis.gap.position_channel import (
    PositionAnalysis,
    PositionErrors,
    contribution_to_position,
    origin_of,
    predicted_position_error,
)
from dragrig.analysis.gap.run_data import RunData, commanded_phase
from dragrig.analysis.gap.spectral_lines import SpectralLine
from dragrig.analysis.paper import BOUNDARY_MM_S
from dragrig.rig import BoolArray, FloatArray, IndexArray, Phase

BOOTSTRAP_SAMPLES = 500
MIN_GAP_OVER_FLOOR = 1.2
"""A gap below this multiple of the floor cannot be closed."""
MIN_POINTS = 3
MAX_OWN_SIGMAS, MAX_SURELY_OWN_SIGMAS = 2.0, 4.0
"""A run's own factors, in standard deviations of the scatter between repeats: all but one run in twenty is within the
first limit. A run beyond it with and without the effect, on the same side, is off by itself, up to the second limit:
one relaxation of some newtons would else outweigh all runs in which the effect acts, the surer the more there are."""


@dataclass(frozen=True, slots=True, eq=False)
class RunGap:
    """Residuals of one run before and after an explanation."""

    run: RunData
    before: FloatArray
    after: FloatArray
    """`before`, `after`: residuals of the block means without the run's zero offset [mN], shape `(B,)`."""
    floor_mean_square: float
    """Mean square of noise and of the uncertainty from the motion."""
    within_block_sd: float
    steady: SteadyLevels | None
    duration_s: FloatArray
    """Duration of each block, 0 for blocks that do not count, shape `(B,)`."""

    @property
    def sums(self) -> FloatArray:
        """Duration, and mean squares before, after and of the floor, times duration, shape `(4,)`."""
        weights = self.duration_s
        duration = float(weights.sum())
        before, after = (
            float(weights @ values**2) + duration * self.within_block_sd**2 for values in (self.before, self.after)
        )
        return np.array([duration, before, after, self.floor_mean_square * duration])


def gap_of_run(
    run: RunData,
    noise: NoiseModel,
    motion_sd: FloatArray,
    before: tuple[FloatArray, Whitening],
    after: tuple[FloatArray, Whitening],
    zero_sd: float,
    informative: BoolArray,
    max_own_sigmas: float = MAX_OWN_SIGMAS,
) -> RunGap:
    """Compare residuals of a run before and after, each with its whitening, shapes `(B,)`.

    The offsets of a run are removed from both residuals, for each by itself: run factors within `max_own_sigmas` of
    the scatter of repeats, or further where both agree, and the zero offset. Factors of the model with the effect taken
    from both residuals would give the effect itself back as a gap that it then closes. Blocks count if `informative`.
    """
    weights = np.where(informative, run.coordinates.width_s, 0.0)
    share = weights / weights.sum()
    floor = noise.white**2 + noise.slow_sd**2 + float(share @ motion_sd**2)
    own_factors = [_own_factors(*each) for each in (before, after)]
    surely_own = np.minimum(*map(np.abs, own_factors)) > max_own_sigmas
    # Where nothing is to be fitted to a run, nothing is its own.
    surely_own &= (np.sign(own_factors[0]) == np.sign(own_factors[1])) & (max_own_sigmas > 0)
    limits = np.where(surely_own, max(max_own_sigmas, MAX_SURELY_OWN_SIGMAS), max_own_sigmas)
    residuals = [without_own(*each, zero_sd, limits) for each in (before, after)]
    within_block_sd = noise.white * float(np.sqrt(max(1.0 - float(share @ (1.0 / run.block_data.blocks.samples)), 0.0)))
    return RunGap(
        run,
        residuals[0],
        residuals[1],
        floor,
        within_block_sd,
        _steady_levels(run, residuals),
        weights,
    )


def without_own(
    residual: FloatArray, whitening: Whitening, zero_sd: float, max_sigmas: float | FloatArray
) -> FloatArray:
    """Return a residual [mN] without the offsets of the run itself, shape `(B,)`.

    These are its own factors, limited to some standard deviations, and then its zero, fitted together with them.
    """
    factors = np.clip(_own_factors(residual, whitening), -max_sigmas, max_sigmas)
    if zero_sd > 0:
        factors[0] = 0.0
    left = np.asarray(residual - whitening.noise_root @ (whitening.run_effects @ factors))
    return left - zero_sd * _own_factors(left, whitening)[0] if zero_sd > 0 else left


def _own_factors(residual: FloatArray, whitening: Whitening) -> FloatArray:
    """Return the offsets of the run itself, in standard deviations; first the zero where it is unknown."""
    run_effects = whitening.run_effects
    precision = np.eye(run_effects.shape[1]) + run_effects.T @ run_effects
    return np.asarray(np.linalg.solve(precision, run_effects.T @ whitening.whiten_noise(residual)))


def reduction_over_runs(gaps: Sequence[RunGap]) -> GapReduction:
    """Return how far the gap closes, with a bootstrap interval over whole runs."""
    rows = np.array([gap.sums for gap in gaps])
    duration, before, after, floor = rows.sum(axis=0).tolist()
    closed, interval = closed_share(rows) if before > MIN_GAP_OVER_FLOOR**2 * floor else (None, None)
    drags = [gap.steady for gap in gaps if gap.steady is not None and gap.run.experiment.kind == "drag"]
    points = [(level.speed_mm_s, level.measured_mN, *level.models_mN) for level in drags]
    highest = BOUNDARY_MM_S * (1 + SPEED_TOLERANCE)
    sides = [point for point in points if point[0] <= highest], [point for point in points if point[0] > highest]
    on_both_sides = all(len(side) >= 1 for side in sides)
    return GapReduction(
        gap_before_mN=float(np.sqrt(before / duration)),
        gap_after_mN=float(np.sqrt(after / duration)),
        noise_floor_mN=float(np.sqrt(floor / duration)),
        closed=closed,
        closed_95ci=interval if len(gaps) > 2 else None,
        boundary_mm_s=BOUNDARY_MM_S if on_both_sides else None,
        r2_eq15=_r2_before_after(sides, r2_eq15),
        r2_corr=_r2_before_after(sides, squared_correlation),
        runs=tuple(gap.run.file for gap in gaps),
    )


def run_weights(runs: int, random: np.random.Generator) -> FloatArray:
    """Return weights of the runs in each bootstrap sample, of mean 1, shape `(BOOTSTRAP_SAMPLES, runs)`.

    Whole counts would leave out an effect that few runs show, as of two relaxations, from every seventh sample; these
    weights (Rubin, The Bayesian bootstrap, 1981) leave out none.
    """
    return np.asarray(random.dirichlet(np.ones(runs), BOOTSTRAP_SAMPLES) * runs)


def closed_share(sums: FloatArray) -> tuple[float, tuple[float, float]]:
    """Return the share of the gap, or of the smallest one that counts, that closes, and its 95 % interval over runs.

    Parameters
    ----------
    sums
        Weight of each run, and its mean squares before, after and of the floor times its weight, shape `(R, 4)`.
    """

    def shares(totals: FloatArray) -> FloatArray:
        before, after, floor = totals[..., 1:].T / totals[..., 0]
        return np.asarray((before - after) / np.maximum(before - floor, (MIN_GAP_OVER_FLOOR**2 - 1) * floor))

    share, resampled = float(shares(sums.sum(axis=0))), shares(run_weights(len(sums), np.random.default_rng(0)) @ sums)
    low, high = np.quantile(resampled, (0.025, 0.975)).tolist()
    return share, (min(low, share), max(high, share))


def position_sums(
    candidate: Candidate,
    runs: Sequence[PositionErrors],
    contribution: Callable[[Candidate, PositionErrors], FloatArray],
) -> FloatArray:
    """Return the sums of `closed_share` for an effect on the position, in mm², every run weighing alike."""
    squares = [
        (float(np.mean(run.error_mm**2)), float(np.mean((run.error_mm - contribution(candidate, run)) ** 2)))
        for run in runs
    ]
    return np.array([(1.0, *pair, run.noise_variance) for pair, run in zip(squares, runs, strict=True)])


def position_gap_reduction(position: PositionAnalysis, force: GapReduction) -> GapReduction:
    """Return a reduction with the closed share of the position errors; sizes stay the force's."""
    if position.candidate is None:
        return force
    sums = position_sums(position.candidate, position.runs, predicted_position_error)
    closed, interval = closed_share(sums)
    before_um, after_um = (1e3 * np.sqrt(sums[:, 1:3].mean(axis=0))).tolist()
    return replace(force, closed=closed, closed_95ci=interval, position_um=(before_um, after_um))


def share_of_position(position: PositionAnalysis) -> tuple[float, tuple[float, float]] | None:
    """Return the share of the position errors that the fitted effect has, with its interval; None without one."""
    if position.candidate is None:
        return None
    return closed_share(position_sums(position.candidate, position.runs, contribution_to_position))


def _steady_levels(run: RunData, residuals: Sequence[FloatArray]) -> SteadyLevels | None:
    """Return the steady force that reports give, friction positive both ways, and what the models leave of it."""
    if run.experiment.kind == "relaxation":
        return None
    recorded, at = run.experiment.run, run.coordinates
    stretch, rest = steady_stretch(recorded)[0], in_phase(recorded.trace, Phase.REST)
    if not (stretch.any() and rest.any()):
        return None
    first, last = run.experiment.time_s[stretch][[0, -1]]
    weights = np.where((at.time_s >= first) & (at.time_s <= last), at.width_s, 0.0)
    if not weights.any():
        return None
    steady, resting = (float(np.mean(recorded.trace.force[mask], dtype=np.float64)) for mask in (stretch, rest))
    sign = -1 if steady < resting and recorded.info.kind != "blank" else 1
    before, after = (sign * (steady - resting - float(weights @ left / weights.sum())) for left in residuals)
    return SteadyLevels(abs(run.condition[1]), sign * (steady - resting), (before, after))


SteadyPoint = tuple[float, float, float, float]


def _r2_before_after(
    sides: tuple[list[SteadyPoint], list[SteadyPoint]], compare: Callable[[FloatArray, FloatArray], float | None]
) -> R2BeforeAfter:
    tables = [(column, np.array(side)) for column in (2, 3) for side in sides]
    enough = (compare(table[:, column], table[:, 1]) if len(table) >= MIN_POINTS else None for column, table in tables)
    return R2BeforeAfter(*enough)


MIN_NOISE_SHARE = 0.3
"""Smallest share of the noise that remains beside a spectral line."""
MAX_SCATTER_SIGMAS = 6.0
"""A run that differs from others by more standard deviations is not scatter."""


def force_residual_blocks(
    study: Study, design: Design, tolerance_mN: float, line: SpectralLine
) -> list[ResidualBlocks]:
    """Return the force residuals by block; a spectral line in the noise counts as a gap."""
    blocks_of_runs = []
    for number, (run, residual_of_run) in enumerate(zip(study.runs, nominal_residuals(design), strict=True)):
        run_design, noise = design.runs[number], study.problem.noises[number]
        blocks, coordinates = run.block_data.blocks, run.coordinates
        white = np.sqrt(max(noise.white**2 - line.amplitude**2 / 2, (MIN_NOISE_SHARE * noise.white) ** 2))
        # A line at another frequency is broad and makes up nearly all of the slow noise.
        slow = noise.slow_sd if line.is_mains or not line.amplitude else MIN_NOISE_SHARE * noise.slow_sd
        variance = white**2 / blocks.samples + slow**2 + run_design.motion_sd**2 + tolerance_mN**2
        zero_sd = study.problem.zero_sds[number]
        blocks_of_runs.append(
            ResidualBlocks(
                run_id=run.experiment.run.info.header.run_id,
                channel=study.channel,
                kind=run.experiment.kind,
                contact=run.experiment.contact,
                speed_mm_s=run.typical_speed_mm_s,
                strain=run.experiment.shear_strain,
                session_s=run.session_start_s if run.has_clock else None,
                residual=without_own(residual_of_run, run_design.whitening, zero_sd, MAX_SCATTER_SIGMAS),
                noise_sd=np.sqrt(variance),
                duration_s=coordinates.width_s,
                time_s=coordinates.time_s,
                phase=coordinates.phase.astype(np.uint8),
                position_mm=coordinates.position_mm,
                force_mN=run_design.predicted,
                origin_mm=origin_of(run.experiment),
                file=run.file,
            )
        )
    return blocks_of_runs


def position_residual_blocks(runs: Sequence[PositionErrors]) -> list[ResidualBlocks]:
    """Return the position errors by block; the encoder count is the tolerance."""
    blocks = []
    for run in runs:
        duration = np.gradient(run.time_s)
        experiment = run.experiment
        blocks.append(
            ResidualBlocks(
                run_id=experiment.run.info.header.run_id,
                channel="position",
                kind=experiment.kind,
                contact=experiment.contact,
                speed_mm_s=run.top_speed_mm_s,
                strain=experiment.shear_strain,
                session_s=run.session_s,
                residual=run.error_mm,
                noise_sd=np.full_like(
                    run.error_mm,
                    np.linalg.norm([run.quantisation_mm, run.encoder_count_mm, run.noise_mm, run.jitter_mm]),
                ),
                duration_s=np.maximum(duration, 1e-6),
                time_s=run.time_s,
                phase=commanded_phase(experiment, run.time_s).astype(np.uint8),
                position_mm=run.command_mm,
                origin_mm=origin_of(experiment),
                file=experiment.file,
            )
        )
    return blocks


HELD_OUT_FOLDS = 4
MIN_RUNS = 4


def folds_by_condition(study: Study) -> tuple[tuple[int, ...], ...]:
    """Return the runs of each fold: whole conditions, those of a kind dealt in the order of speed or strain.

    Runs of a single condition are dealt in their order. Empty where runs are too few to hold any out.
    """
    conditions = sorted({run.condition for run in study.runs})
    fold_of_condition: dict[tuple[str, float], int] = {}
    counts: dict[str, int] = {}
    for kind, value in conditions:
        counts[kind] = counts.get(kind, -1) + 1
        fold_of_condition[kind, value] = counts[kind] % HELD_OUT_FOLDS
    members: list[list[int]] = [[] for _ in range(HELD_OUT_FOLDS)]
    for number, run in enumerate(study.runs):
        members[fold_of_condition[run.condition] if len(conditions) > 1 else number % HELD_OUT_FOLDS].append(number)
    folds = tuple(tuple(fold) for fold in members if fold)
    return folds if len(study.runs) >= MIN_RUNS and len(folds) > 1 else ()


def predict_held_out(
    search: ForceSearchResult, chosen: HypothesisFit | None
) -> tuple[tuple[FloatArray, FloatArray], ...]:
    """Return the residuals [mN] of each run by fits to the others, without and with the effects; none for too few runs.

    In each fold the effect is chosen anew from the other runs; if it differs from `chosen`, the fold is predicted with
    it.
    """
    nominal, folds, runs = search.nominal, folds_by_condition(search.study), range(len(search.study.runs))
    before: dict[int, FloatArray] = {}
    after: dict[int, FloatArray] = {}
    for fold in folds:
        others = [index for index in runs if index not in fold]
        coefficients = _fit_to_runs(nominal, others, (ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR))
        before |= {index: _run_residual(nominal, index, *coefficients) for index in fold}
        projected = project_dictionary(nominal, nominal.total_gram(others), *NUISANCES)
        best = next(iter(rank_effects(projected, nominal.variants)), None)
        same = chosen is not None and (best is None or best.effect in chosen.effects or len(chosen.effects) > 1)
        if chosen is not None and same:
            coefficients = _fit_to_runs(
                chosen.design, others, (ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT)
            )
            after |= {index: _run_residual(chosen.design, index, *coefficients) for index in fold}
        elif chosen is not None and best is not None:
            coefficients = _fit_with_variants(nominal, others, best)
            after |= {index: _run_residual(nominal, index, *coefficients) for index in fold}
    return tuple((before[index], (after or before)[index]) for index in runs) if folds else ()


def held_out_improvement(search: ForceSearchResult, fit: HypothesisFit) -> float | None:
    """Return the share of the excess that a hypothesis explains on held-out runs.

    None for too few runs, or without excess beyond chance.
    """
    folds = folds_by_condition(search.study)
    if not folds:
        return None
    without = with_effects = 0.0
    for fold in folds:
        others = [number for number in range(len(search.study.runs)) if number not in fold]
        without += _predicted_chi2(
            search.nominal, fold, *_fit_to_runs(search.nominal, others, (ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR))
        )
        with_effects += _predicted_chi2(
            fit.design,
            fold,
            *_fit_to_runs(fit.design, others, (ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT)),
        )
    excess = without - search.block_count
    return 1.0 - (with_effects - search.block_count) / excess if excess > np.sqrt(2 * search.block_count) else None


def _fit_to_runs(design: Design, runs: Sequence[int], kinds: tuple[ColumnKind, ...]) -> tuple[IndexArray, FloatArray]:
    solution = fit_columns(design, design.total_gram(runs), *kinds)
    return solution.columns, solution.coefficients


def _run_residual(design: Design, run: int, columns: IndexArray, coefficients: FloatArray) -> FloatArray:
    run_design = design.runs[run]
    return np.asarray(run_design.residual - run_design.columns[:, columns] @ coefficients)


def _predicted_chi2(design: Design, runs: Sequence[int], columns: IndexArray, coefficients: FloatArray) -> float:
    total, rows = design.total_gram(runs), 1 + columns
    return float(
        total[0, 0] - 2 * total[0, rows] @ coefficients + coefficients @ total[np.ix_(rows, rows)] @ coefficients
    )


def _fit_with_variants(design: Design, runs: Sequence[int], ranked: RankedEffect) -> tuple[IndexArray, FloatArray]:
    variant_columns = design.columns_of(ColumnKind.VARIANT)[list(ranked.variants)]
    columns = np.concatenate((design.columns_of(ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR), variant_columns))
    total, rows = design.total_gram(runs), 1 + columns
    precision, mean = design.prior_precision[columns], design.prior_mean[columns]
    precision_matrix = total[np.ix_(rows, rows)] + np.diag(precision + 1e-10 * np.diag(total)[rows])
    return columns, np.linalg.solve(precision_matrix, total[rows, 0] + precision * mean)


def traces_of_run(gap: RunGap) -> RunTraces:
    """Return the curves of a run for a figure: the measurement, and the model before and after."""
    run, at = gap.run, gap.run.coordinates
    measured = run.block_data.blocks.mean
    return RunTraces(
        file=run.file,
        kind=run.experiment.kind,
        label=run.label,
        channel=run.block_data.channel,
        unit="mN",
        time_s=at.time_s,
        position_mm=at.position_mm,
        measured=measured,
        before=measured - gap.before,
        after=measured - gap.after,
        steady=gap.steady,
    )
