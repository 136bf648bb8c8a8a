"""Size of the gap before and after an explanation: residuals, noise floor, held-out runs and closed share."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis.computation import single_blas_thread
from dragrig.analysis.gap.candidates import Candidate
from dragrig.analysis.gap.design import ColumnKind, Design, Study, linearise
from dragrig.analysis.gap.diagnosis import GapReduction, R2BeforeAfter
from dragrig.analysis.gap.excess import ResidualBlocks
from dragrig.analysis.gap.forward_selection import ForceSearchResult
from dragrig.analysis.gap.hypothesis_fit import HypothesisFit
from dragrig.analysis.gap.linear_fit import NUISANCES, RankedEffect, fit_columns, project_dictionary, rank_effects
from dragrig.analysis.gap.position_channel import PositionErrors, closed_share_in_position, origin_of, position_errors
from dragrig.analysis.gap.run_data import RunData, commanded_phase, run_data_of
from dragrig.analysis.gap.spectral_lines import SpectralLine
from dragrig.analysis.gap.studies import CapsuleStudy
from dragrig.analysis.identification.speed_dependence import (
    PAPER_BOUNDARY_MM_S,
    SPEED_TOLERANCE,
    r2_eq15,
    squared_correlation,
)
from dragrig.analysis.inference.linear_gaussian import Whitening
from dragrig.analysis.inference.noise import NoiseModel
from dragrig.analysis.models.capsule_model import CapsuleModel
from dragrig.analysis.selection import RunSelection
from dragrig.config.errors import AnalysisError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.rig.arrays import BoolArray, FloatArray, IndexArray
from dragrig.rig.profile import Phase
from dragrig.sim_backend.effects.base import Channel, active_effects

BOOTSTRAP_SAMPLES = 1000
MIN_GAP_OVER_FLOOR = 1.2
"""A gap below this many floors is none that could be closed."""
MIN_POINTS = 3


@dataclass(frozen=True, slots=True, eq=False)
class RunGap:
    """One run before and after.

    Attributes
    ----------
    before, after
        Residuals of the block means, the run's own zero taken off [mN], shape `(B,)`.
    modelled_before, modelled_after
        Steady force of a drag that was predicted; None for other runs.
    steady
        The one that was measured.
    duration_s
        Duration of each block as far as it counts, shape `(B,)`.
    floor_mean_square
        Mean square of noise, and of what the motion leaves uncertain.
    """

    run: RunData
    before: FloatArray
    after: FloatArray
    floor_mean_square: float
    within_block_sd: float
    steady: tuple[float, float, float] | None
    duration_s: FloatArray

    @property
    def sums(self) -> FloatArray:
        """Duration, and mean squares before, after and of the floor times duration, shape `(4,)`."""
        width = self.duration_s
        duration = float(width.sum())
        before, after = (
            float(width @ values**2) + duration * self.within_block_sd**2 for values in (self.before, self.after)
        )
        return np.array([duration, before, after, self.floor_mean_square * duration])


def gap_of_run(
    run: RunData,
    noise: NoiseModel,
    motion_sd: FloatArray,
    before: tuple[FloatArray, Whitening],
    after: tuple[FloatArray, Whitening],
    zero_sd: float,
    informative: BoolArray | None = None,
) -> RunGap:
    """Compare residuals of a run, each with what whitens it, shapes `(B,)`.

    What the run differs by from its repeats is no gap: its own factors, as the model with the effect has them and no
    further than repeats scatter, are taken off both, and its zero as each model has it. Of the blocks those count that
    are `informative`, all unless said.
    """
    width = run.coordinates.width_s
    if informative is not None and informative.any():
        width = np.where(informative, width, 0.0)
    share = width / width.sum()
    floor = noise.white**2 + noise.slow**2 + float(share @ motion_sd**2)
    scatter = run_factor_force(*after, zero_sd)
    cleared = [
        residual - scatter - run_zero_offset(residual - scatter, white, zero_sd) for residual, white in (before, after)
    ]
    within = noise.white * float(np.sqrt(max(1.0 - float(share @ (1.0 / run.block_data.blocks.samples)), 0.0)))
    return RunGap(run, cleared[0], cleared[1], floor, within, _steady_forces(run, cleared[0], cleared[1]), width)


def run_factor_force(
    residual: FloatArray, whitening: Whitening, zero_sd: float, max_sigmas: float = np.inf
) -> FloatArray:
    """Return what the run's own factors make of it [mN], shape `(B,)`, none beyond so many standard deviations."""
    own = whitening.run_effects
    precision = np.eye(own.shape[1]) + own.T @ own
    result = np.linalg.solve(precision, own.T @ whitening.whiten_noise(residual))
    result = np.clip(result, -max_sigmas, max_sigmas)
    if zero_sd > 0:
        result[0] = 0.0
    return np.asarray(whitening.noise_root @ (own @ result))


def run_zero_offset(residual: FloatArray, whitening: Whitening, zero_sd: float) -> float:
    """Return the run's own zero [mN], its own factors being free too."""
    if zero_sd <= 0:
        return 0.0
    own = whitening.run_effects
    precision = np.eye(own.shape[1]) + own.T @ own
    return zero_sd * float(np.linalg.solve(precision, own.T @ whitening.whiten_noise(residual))[0])


def reduction_over_runs(gaps: Sequence[RunGap], seed: int = 0) -> GapReduction:
    """Return how far the gap shrinks over runs, with an interval by resampling whole runs."""
    rows = np.array([gap.sums for gap in gaps])
    closed = _closed_share(rows.sum(axis=0))
    interval = None
    if closed is not None and len(gaps) > 2:
        drawn = np.random.default_rng(seed).integers(len(gaps), size=(BOOTSTRAP_SAMPLES, len(gaps)))
        resampled = [
            value for value in (_closed_share(rows[index].sum(axis=0), 1.0) for index in drawn) if value is not None
        ]
        if len(resampled) > BOOTSTRAP_SAMPLES // 2:
            low, high = np.quantile(resampled, (0.025, 0.975)).tolist()
            interval = (min(low, closed), max(high, closed))
    duration, before, after, floor = rows.sum(axis=0).tolist()
    points = [(gap.run.condition[1], *gap.steady) for gap in gaps if gap.steady is not None]
    sides = _split_at_boundary(points)
    both = all(len(side) >= 1 for side in sides)
    return GapReduction(
        gap_before_mN=float(np.sqrt(before / duration)),
        gap_after_mN=float(np.sqrt(after / duration)),
        noise_floor_mN=float(np.sqrt(floor / duration)),
        closed=closed,
        closed_95ci=interval,
        boundary_mm_s=PAPER_BOUNDARY_MM_S if both else None,
        r2_eq15=_r2_before_after(sides, "eq15"),
        r2_corr=_r2_before_after(sides, "corr"),
        runs=tuple(gap.run.file for gap in gaps),
    )


def _closed_share(sums: FloatArray, least: float = MIN_GAP_OVER_FLOOR) -> float | None:
    before, after, floor = (float(one / sums[0]) for one in sums[1:])
    if before <= least**2 * floor:
        return None
    return 1.0 - (after - floor) / (before - floor)


def _steady_forces(run: RunData, before: FloatArray, after: FloatArray) -> tuple[float, float, float] | None:
    """Return measured steady force of a drag and what the models make of it, before and after."""
    inside = run.coordinates.phase == Phase.STEADY
    if run.experiment.kind != "drag" or not inside.any():
        return None
    width = run.coordinates.width_s[inside]
    measured = float(width @ run.block_data.blocks.mean[inside] / width.sum())
    missed = [float(width @ values[inside] / width.sum()) for values in (before, after)]
    return measured, measured - missed[0], measured - missed[1]


SteadyPoint = tuple[float, float, float, float]


def _split_at_boundary(points: Sequence[SteadyPoint]) -> tuple[list[SteadyPoint], list[SteadyPoint]]:
    highest = PAPER_BOUNDARY_MM_S * (1 + SPEED_TOLERANCE)
    return [pair for pair in points if pair[0] <= highest], [pair for pair in points if pair[0] > highest]


def _r2_before_after(sides: tuple[list[SteadyPoint], list[SteadyPoint]], form: str) -> R2BeforeAfter:
    found: list[float | None] = []
    for column in (2, 3):
        for side in sides:
            if len(side) < MIN_POINTS:
                found.append(None)
                continue
            table = np.array(side)
            compare = r2_eq15 if form == "eq15" else squared_correlation
            found.append(compare(table[:, column], table[:, 1]))
    return R2BeforeAfter(found[0], found[1], found[2], found[3])


MIN_NOISE_SHARE = 0.3
"""Noise beside a line is at least this part of all noise."""
MAX_SCATTER_SIGMAS = 6.0
"""A run that differs from the others by more standard deviations than this does so for a reason."""


def nominal_residuals(design: Design) -> list[FloatArray]:
    """Return what the nominal model leaves of each run when it is fitted to all of them, shape `(B,)` [mN]."""
    solution = fit_columns(design, design.total_gram(), ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR)
    return [run.residual - run.columns[:, solution.columns] @ solution.coefficients for run in design.runs]


def force_residual_blocks(
    study: Study, design: Design, tolerance_mN: float, line: SpectralLine
) -> list[ResidualBlocks]:
    """Return the force's residuals; noise that is a line counts as a gap."""
    result = []
    for number, (run, left) in enumerate(zip(study.runs, nominal_residuals(design), strict=True)):
        run_design, noise = design.runs[number], study.problem.noises[number]
        blocks, at = run.block_data.blocks, run.coordinates
        white = np.sqrt(max(noise.white**2 - line.amplitude**2 / 2, (MIN_NOISE_SHARE * noise.white) ** 2))
        # What swings at any other frequency is not of one frequency alone, and is nearly all of the slow noise.
        slow = noise.slow if line.is_mains or not line.amplitude else MIN_NOISE_SHARE * noise.slow
        spread = white**2 / blocks.samples + slow**2 + run_design.motion_sd**2 + tolerance_mN**2
        zero_sd = study.problem.zero_sds[number]
        rest = left - run_factor_force(left, run_design.whitening, zero_sd, MAX_SCATTER_SIGMAS)
        residual = rest - run_zero_offset(rest, run_design.whitening, zero_sd)
        result.append(
            ResidualBlocks(
                run_id=run.experiment.run.info.header.run_id,
                channel=study.channel,
                kind=run.experiment.kind,
                contact=run.experiment.contact,
                speed_mm_s=float(at.top_speed_mm_s[0]),
                strain=run.experiment.shear_strain,
                session_s=run.session_start_s,
                residual=residual,
                noise_sd=np.sqrt(spread),
                duration_s=at.width_s,
                time_s=at.time_s,
                phase=at.phase.astype(np.uint8),
                position_mm=at.position_mm,
                force_mN=run_design.predicted,
                origin_mm=origin_of(run.experiment),
            )
        )
    return result


def position_residual_blocks(runs: Sequence[PositionErrors]) -> list[ResidualBlocks]:
    """Return the position errors; an encoder's count is what does not matter."""
    blocks = []
    for run in runs:
        width = np.gradient(run.time_s)
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
                    run.error_mm, np.linalg.norm([run.quantisation_mm, run.encoder_count_mm, run.noise_mm])
                ),
                duration_s=np.maximum(width, 1e-6),
                time_s=run.time_s,
                phase=commanded_phase(experiment, run.time_s).astype(np.uint8),
                position_mm=run.command_mm,
                origin_mm=origin_of(experiment),
            )
        )
    return blocks


HELD_OUT_FOLDS = 4
MIN_RUNS = 4


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutResiduals:
    """What each run shows when it took no part: residuals before and after, and whitened squares.

    Attributes
    ----------
    before, after
        Residual block means of each run [mN].
    chi2_before, chi2_after
        Their whitened squares.
    agreeing_share
        Share of the folds whose own choice was the same effect.
    """

    before: tuple[FloatArray, ...]
    after: tuple[FloatArray, ...]
    chi2_before: FloatArray
    chi2_after: FloatArray
    agreeing_share: float


def folds_by_condition(study: Study) -> tuple[tuple[int, ...], ...]:
    """Return the runs of each fold: whole conditions, those of a kind dealt out in the order of speed or strain."""
    conditions = sorted({run.condition for run in study.runs})
    dealt: dict[tuple[str, float], int] = {}
    counts: dict[str, int] = {}
    for kind, value in conditions:
        counts[kind] = counts.get(kind, -1) + 1
        dealt[kind, value] = counts[kind] % HELD_OUT_FOLDS
    members: list[list[int]] = [[] for _ in range(HELD_OUT_FOLDS)]
    for number, run in enumerate(study.runs):
        members[dealt[run.condition]].append(number)
    return tuple(tuple(one) for one in members if one)


def predict_held_out(search: ForceSearchResult, chosen: HypothesisFit | None) -> HeldOutResiduals | None:
    """Predict every run from fits to the others; None where there are too few runs.

    In each fold the choice of the effect is made anew from its own runs. Where it is another one than `chosen` has,
    the fold is predicted with that.
    """
    study, nominal = search.study, search.nominal
    folds = folds_by_condition(study)
    if len(study.runs) < MIN_RUNS or len(folds) < 2:
        return None
    runs = range(len(study.runs))
    before: dict[int, FloatArray] = {}
    after: dict[int, FloatArray] = {}
    agreed = 0
    for fold in folds:
        others = [index for index in runs if index not in fold]
        coefficients = _fit_to_runs(nominal, others, (ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR))
        before |= {index: _run_residual(nominal, index, *coefficients) for index in fold}
        own = _best_effect(nominal, others)
        same = chosen is not None and (own is None or own.effect in chosen.effects or len(chosen.effects) > 1)
        agreed += same
        if chosen is not None and same:
            coefficients = _fit_to_runs(
                chosen.design, others, (ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT)
            )
            after |= {index: _run_residual(chosen.design, index, *coefficients) for index in fold}
        elif chosen is not None and own is not None:
            coefficients = _fit_with_variants(nominal, others, own)
            after |= {index: _run_residual(nominal, index, *coefficients) for index in fold}
    if not after:
        after = before
    design = nominal if chosen is None else chosen.design
    return HeldOutResiduals(
        tuple(before[index] for index in runs),
        tuple(after[index] for index in runs),
        _whitened_chi2(nominal, before),
        _whitened_chi2(design, after),
        agreed / len(folds),
    )


def held_out_improvement(search: ForceSearchResult, fit: HypothesisFit) -> float | None:
    """Return the share of the excess that an explanation takes away on runs that took no part in its fit.

    None where there are too few runs, or no excess beyond chance.
    """
    folds = folds_by_condition(search.study)
    if len(search.study.runs) < MIN_RUNS or len(folds) < 2:
        return None
    without = with_it = 0.0
    for fold in folds:
        others = [number for number in range(len(search.study.runs)) if number not in fold]
        without += _predicted_chi2(
            search.nominal, fold, *_fit_to_runs(search.nominal, others, (ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR))
        )
        with_it += _predicted_chi2(
            fit.design,
            fold,
            *_fit_to_runs(fit.design, others, (ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT)),
        )
    excess = without - search.block_count
    return 1.0 - (with_it - search.block_count) / excess if excess > np.sqrt(2 * search.block_count) else None


def _fit_to_runs(design: Design, runs: Sequence[int], parts: tuple[ColumnKind, ...]) -> tuple[IndexArray, FloatArray]:
    solution = fit_columns(design, design.total_gram(runs), *parts)
    return solution.columns, solution.coefficients


def _run_residual(design: Design, run: int, columns: IndexArray, result: FloatArray) -> FloatArray:
    run_design = design.runs[run]
    return np.asarray(run_design.residual - run_design.columns[:, columns] @ result)


def _predicted_chi2(design: Design, runs: Sequence[int], columns: IndexArray, result: FloatArray) -> float:
    total, rows = design.total_gram(runs), 1 + columns
    return float(total[0, 0] - 2 * total[0, rows] @ result + result @ total[np.ix_(rows, rows)] @ result)


def _whitened_chi2(design: Design, residuals: Mapping[int, FloatArray]) -> FloatArray:
    parts = enumerate(design.runs)
    return np.array([float(np.sum(run.whitening.whiten(residuals[number]) ** 2)) for number, run in parts])


def _best_effect(design: Design, runs: Sequence[int]) -> RankedEffect | None:
    ranked = rank_effects(project_dictionary(design, design.total_gram(runs), *NUISANCES), design.variants)
    return ranked[0] if ranked else None


def _fit_with_variants(design: Design, runs: Sequence[int], own: RankedEffect) -> tuple[IndexArray, FloatArray]:
    shapes = design.columns_of(ColumnKind.VARIANT)[list(own.variants)]
    columns = np.concatenate((design.columns_of(ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR), shapes))
    total, rows = design.total_gram(runs), 1 + columns
    precision, mean = design.prior_precision[columns], design.prior_mean[columns]
    whole = total[np.ix_(rows, rows)] + np.diag(precision + 1e-10 * np.diag(total)[rows])
    return columns, np.linalg.solve(whole, total[rows, 0] + precision * mean)


@single_blas_thread()
def evaluate(selection: RunSelection, model: FrictionModelSettings) -> GapReduction:
    """Compare fresh runs with the specimen's model as it was without its effects, and with them.

    Nothing is fitted to the runs but each one's own zero.

    Raises
    ------
    AnalysisError
        Where the model has no effects, or predicts nothing of these runs.
    """
    if not model.effects:
        raise AnalysisError(f"model {model.name} has no effects, so that there is nothing to evaluate.")
    bare = model.model_copy(update={"effects": (), "diagnosed": None})
    before = bare.model_copy(update=dict(model.diagnosed.nominal)) if model.diagnosed else bare
    first = _capsule_study(selection, before)
    second = _on_same_blocks(_capsule_study(selection, model), first)
    start = np.zeros(len(first.parameter_names))
    design, other = linearise(first, start), linearise(second, start)
    gaps = [
        gap_of_run(
            run,
            first.problem.noises[number],
            other.runs[number].motion_sd,
            (design.runs[number].residual, design.runs[number].whitening),
            (other.runs[number].residual, other.runs[number].whitening),
            first.problem.zero_sds[number],
        )
        for number, run in enumerate(first.runs)
    ]
    shrink = reduction_over_runs(gaps)
    moved = [active for active in active_effects(model) if active.effect.channel is Channel.POSITION]
    errors = position_errors(selection.experiments)
    if len(moved) == 1 and len(model.effects) == 1 and any(run_errors.has_position_error for run_errors in errors):
        return closed_share_in_position(Candidate(moved[0].effect, moved[0].values), errors, shrink)
    return shrink


def _capsule_study(selection: RunSelection, settings: FrictionModelSettings) -> CapsuleStudy:
    return CapsuleStudy.of(selection, CapsuleModel(settings), ())


def _on_same_blocks(study: CapsuleStudy, other: CapsuleStudy) -> CapsuleStudy:
    """Let a study look at the same blocks as another one, whose model bends at other moments."""
    pairs = zip(study.problem.channels, other.problem.channels, strict=True)
    evidence = tuple(replace(mine, blocks=theirs.blocks) for mine, theirs in pairs)
    problem = replace(
        study.problem,
        channels=evidence,
        noises=other.problem.noises,
        zero_sds=other.problem.zero_sds,
    )
    return replace(study, problem=problem, runs=run_data_of(evidence))
