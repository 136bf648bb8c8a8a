"""Whether an amended model keeps its promise on fresh runs: the size of its effects there, and how far the gap closes.

The question is not whether the amended model predicts better than the model it came from, whose parameters were fitted
to runs with the gap in them, but whether its effects are there. The specimen's parameters are therefore fitted to the
fresh runs anew, without the effects and with them, by the same likelihood and under the same prior; each model has run
factors of its own. The effects have a factor on their promised size: 1 where the promise is kept, 0 where they are
absent, 2 where they are twice as large.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from dragrig.analysis import NORMAL_95, RunSelection, nominal_model, session_starts, single_blas_thread
from dragrig.analysis.gap.design import Candidate, Design, Study, added_force, linearise
from dragrig.analysis.gap.diagnosis import GapReduction, RunTraces
from dragrig.analysis.gap.gap_reduction import (
    MAX_OWN_SIGMAS,
    MIN_GAP_OVER_FLOOR,
    RunGap,
    closed_share,
    gap_of_run,
    position_sums,
    reduction_over_runs,
    run_weights,
    traces_of_run,
)
from dragrig.analysis.gap.position_channel import (
    PositionErrors,
    position_errors,
    position_weights,
    predicted_position_error,
)
from dragrig.analysis.gap.spectral_lines import detectable_line_amplitude, find_spectral_lines, without_hum
from dragrig.analysis.gap.studies import prepare_study
from dragrig.config import AnalysisError, EffectSettings, ModelSettings
from dragrig.rig import Contact, FloatArray
from dragrig.sim_backend.effects import (
    ActiveEffect,
    Channel,
    Coordinate,
    Effect,
    EffectChain,
    active_effects,
    hum_effect,
)

SIZE_GRID = (-1.0, -0.5, 0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0)
"""Relative sizes at which an effect is tried: the force is not linear in the size of every effect, as of a delay."""
SIZE_LIMITS = (-5.0, 10.0)
"""Sizes beyond these, and of effects that the runs do not show, are not told apart."""
SIZE_PRIOR_SD = 10.0
"""Prior of an effect's relative size: so wide that it only keeps resampled runs that show nothing from diverging."""
KEPT_SIZES, OTHER_SIZES = (0.71, 1.41), (0.5, 2.0)
"""Relative sizes between which a promise is kept, and sizes that the interval of a kept one excludes.

The former are nearer in ratio to the promised size than to half or twice of it. What a catalogue's form misses of an
effect moved the size on other speeds by up to 23 % in 40 simulated campaigns with other forms than the catalogue's.
"""
MIN_HUM_LLR = 8.0
"""A mains line of this log likelihood ratio is detected."""
MIN_EXPLAINED = 0.25
"""Effects that explain less than this share of chi-square beyond noise are not what is wrong with the runs.

Not the share of the squares in mN: what two relaxations of some newtons are off by, as repeats are, outweighs there all
other runs.
"""


class PromiseVerdict(StrEnum):
    """Whether an amended model keeps its promise on fresh runs."""

    KEPT = "KEPT"
    NOT_KEPT = "NOT_KEPT"
    NO_POWER = "NO_POWER"


@dataclass(frozen=True, slots=True)
class RelativeEffectSize:
    """The size of an effect in fresh runs, relative to the size that the model promises."""

    effect: str
    size: float
    low: float
    """Lower end of the 95 % interval, over whole runs."""
    high: float
    """Upper end."""
    d_prime: float
    """Detectability of the promised effect in these runs, the specimen's parameters and run factors being unknown."""

    @property
    def verdict(self) -> PromiseVerdict:
        """Whether the effect is there at its promised size."""
        if KEPT_SIZES[0] <= self.size <= KEPT_SIZES[1]:
            sure = OTHER_SIZES[0] < self.low and self.high < OTHER_SIZES[1]
            return PromiseVerdict.KEPT if sure else PromiseVerdict.NO_POWER
        return PromiseVerdict.NO_POWER if self.low <= 1.0 <= self.high else PromiseVerdict.NOT_KEPT


@dataclass(frozen=True, slots=True)
class ModelEvaluation:
    """What fresh runs say of an amended model."""

    reduction: GapReduction
    promised: float | None
    """Share of the gap that the diagnosis promised to close, from held-out runs; None where it gave none."""
    promised_95ci: tuple[float, float] | None
    achieved: float | None
    """Share of the gap that the model closes in these runs, as a share of the gap or, where there is none, of the
    smallest gap that counts; negative where the model is worse than without its effects. None for an effect that acts
    beside the averages of the force (hum)."""
    achieved_95ci: tuple[float, float] | None
    explained: float | None
    """Share of chi-square beyond noise that the effects explain, the specimen's parameters and each run's own factors
    fitted under their priors without the effects and with them; None where chi-square shows no gap that matters."""
    sizes: tuple[RelativeEffectSize, ...]
    """Relative size of each effect."""
    traces: tuple[RunTraces, ...] = ()
    """Each run beside what the model says without and with the effects."""
    backends: tuple[str, ...] = ()
    """Where the runs come from."""
    diagnosed_runs: int = 0
    """Runs that were left out because they took part in the diagnosis."""

    @property
    def verdict(self) -> PromiseVerdict:
        """Whether the promise is kept: every effect has its size, and the gap closes."""
        verdicts = {size.verdict for size in self.sizes}
        for verdict in (PromiseVerdict.NOT_KEPT, PromiseVerdict.NO_POWER):
            if verdict in verdicts:
                return verdict
        if self.explained is not None and self.explained < MIN_EXPLAINED:
            return PromiseVerdict.NOT_KEPT
        # Effects that made held-out runs of the diagnosis worse promise nothing that could be kept.
        return PromiseVerdict.NO_POWER if self.promised is not None and self.promised <= 0 else PromiseVerdict.KEPT


@single_blas_thread()
def evaluate(selection: RunSelection, model: ModelSettings) -> ModelEvaluation:
    """Evaluate an amended model on fresh runs.

    Raises
    ------
    AnalysisError
        Where the model has no effects, or predicts nothing of these runs, or all of them took part in its diagnosis.
    """
    effects = active_effects(model)
    if not effects:
        raise AnalysisError(f"model {model.name} has no effects: there is nothing to evaluate.")
    given, selection = selection, without_diagnosed(selection, model)
    if session_starts(selection.experiments) is None:
        # Without a clock nothing is known of the session, neither the presence nor the absence of such an effect.
        unseen = [active.effect for active in effects if active.effect.coordinate is Coordinate.SESSION]
        ids = {effect.id for effect in unseen}
        model = model.model_copy(update={"effects": tuple(entry for entry in model.effects if entry.id not in ids)})
    else:
        unseen = []
    forces = ForceEvaluation.of(selection, model)
    sizes = [*forces.sizes(), *map(unseen_effect_size, unseen)]
    gaps = forces.gaps()
    reduction = reduction_over_runs(gaps)
    achieved: float | None
    interval: tuple[float, float] | None
    achieved, interval = closed_share(np.array([gap.sums for gap in gaps]))
    errors = [run for run in position_errors(selection.experiments) if run.error_mm.size]
    for active in effects:
        if active.effect.channel is Channel.POSITION:
            candidate = Candidate(active.effect, active.values)
            sizes.append(size_in_position(candidate, errors))
            if len(effects) == 1 and errors:
                achieved, interval = closed_share(position_sums(candidate, errors, predicted_position_error))
                reduction = replace(reduction, closed=achieved, closed_95ci=interval)
        elif active.effect.id == hum_effect().id:
            sizes.append(_size_of_hum(active.effect, active.values, selection))
            if len(effects) == 1:
                achieved, interval = None, None
    promise = (model.diagnosed.promised, model.diagnosed.promised_95ci) if model.diagnosed else (None, None)
    return ModelEvaluation(
        reduction,
        *promise,
        achieved,
        interval,
        forces.explained_share(),
        tuple(sizes),
        tuple(map(traces_of_run, gaps)),
        selection.backends,
        len(given.experiments) - len(selection.experiments),
    )


def without_diagnosed(selection: RunSelection, model: ModelSettings) -> RunSelection:
    """Return the runs that took no part in the diagnosis: what a model was made from always keeps its promise."""
    diagnosed = frozenset(model.diagnosed.run_ids) if model.diagnosed else frozenset()
    fresh = tuple(entry for entry in selection.experiments if entry.run.info.header.run_id not in diagnosed)
    if not fresh:
        raise AnalysisError(
            f"all {len(selection.experiments)} runs took part in the diagnosis that made model {model.name}, and can "
            "confirm nothing; name fresh runs of the same specimen."
        )
    return replace(selection, experiments=fresh)


@dataclass(frozen=True, eq=False)
class ForceEvaluation:
    """Fresh runs linearised about the amended model, and the force of each effect in them at several sizes."""

    study: Study
    amended: Design
    effects: tuple[ActiveEffect, ...]
    """Effects that act on the average force."""
    grids: tuple[tuple[float, ...], ...]
    """Relative sizes at which each effect is tried, 0 and 1 among them."""
    forces: tuple[tuple[FloatArray, ...], ...]
    """Block means of the force of all effects in each run, each effect in turn at the sizes of its grid and the others
    as promised, shape `(S, B)`."""
    promised_forces: tuple[FloatArray, ...]
    """The same with all effects as promised, shape `(B,)`."""

    @classmethod
    def of(cls, selection: RunSelection, model: ModelSettings) -> "ForceEvaluation":
        """Return what runs say of the effects of an amended model that act on the force."""
        study = prepare_study(selection, nominal_model(model), ())
        z = study.initial_z
        acting = tuple(
            active
            for active in active_effects(model)
            if active.effect.channel is not Channel.POSITION and active.effect.id != hum_effect().id
        )
        scenes = [(run, *scene) for run, scene in zip(study.runs, study.scenes(z), strict=True)]

        def force(settings: ModelSettings) -> list[FloatArray]:
            chain = without_hum(EffectChain.of(settings))
            return [np.asarray(run.block_means(added_force(chain, scene, gain))) for run, scene, gain in scenes]

        grids = tuple(tuple(size for size in SIZE_GRID if is_allowed_size(active, size)) for active in acting)
        resized = [
            [force(resized_model(model, active.effect, size)) for size in grid]
            for active, grid in zip(acting, grids, strict=True)
        ]
        return cls(
            study=study,
            amended=linearise(study, z),
            effects=acting,
            grids=grids,
            forces=tuple(
                tuple(np.array([by_size[number] for by_size in sizes]) for sizes in resized)
                for number in range(len(scenes))
            ),
            promised_forces=tuple(force(model)),
        )

    def sizes(self) -> Iterator[RelativeEffectSize]:
        """Yield the relative size of each effect: where chi-square is least, the other effects' sizes being free."""
        random = np.random.default_rng(0)
        samples = run_weights(len(self.forces), random)
        for number, active in enumerate(self.effects):
            grid, grams = self.grids[number], self._grams(number)
            value, standard_error = best_size(grid, grams.sum(axis=1), self._precision)
            resampled = [
                best_size(grid, np.einsum("r,srij->sij", weights, grams), self._precision)[0] for weights in samples
            ]
            low, high = np.quantile(resampled, (0.025, 0.975)).tolist()
            statistical = NORMAL_95 * standard_error
            yield RelativeEffectSize(
                active.effect.id,
                value,
                min(low, value - statistical),
                max(high, value + statistical),
                self._d_prime(number),
            )

    @property
    def _precision(self) -> FloatArray:
        """Prior precision of the other effects' sizes and of the specimen's parameters."""
        return np.concatenate((np.full(len(self.effects) - 1, SIZE_PRIOR_SD**-2), self.amended.prior_precision))

    def _promised_force(self, number: int, run: int) -> FloatArray:
        """Return what an effect adds at its promised size, shape `(B,)`."""
        return np.asarray(self.promised_forces[run] - self.forces[run][number][self.grids[number].index(0.0)])

    def _columns(self, number: int, run: int) -> FloatArray:
        """Return the force of the other effects, and by the specimen's parameters, shape `(B, E - 1 + P)`."""
        others = [self._promised_force(other, run) for other in range(len(self.effects)) if other != number]
        return np.column_stack((*others, self.amended.runs[run].columns))

    def _grams(self, number: int) -> FloatArray:
        """Return whitened products of residual and columns by size of an effect and run, shape `(S, R, n, n)`."""
        products = []
        for run, (design, forces) in enumerate(zip(self.amended.runs, self.forces, strict=True)):
            residuals = design.residual + self.promised_forces[run] - forces[number]
            white = design.whitening.whiten(np.column_stack((residuals.T, self._columns(number, run))))
            residual, columns = np.split(white, [len(residuals)], axis=1)
            by_size = [np.column_stack((values, columns)) for values in residual.T]
            products.append([values.T @ values for values in by_size])
        return np.array(products).transpose(1, 0, 2, 3)

    def _d_prime(self, number: int) -> float:
        """Return the norm of the promised effect beyond what specimen, other effects and runs can take up."""
        products = []
        for run, design in enumerate(self.amended.runs):
            columns = self._promised_force(number, run), self._columns(number, run)
            products.append(design.whitening.gram(np.column_stack(columns)))
        return float(np.sqrt(max(refitted_chi2(np.sum(products, axis=0), self._precision), 0.0)))

    def refitted(self, *, with_effects: bool) -> list[FloatArray]:
        """Return the residuals of each run, the specimen's parameters fitted, `(B,)`."""
        residuals = [
            design.residual if with_effects else design.residual + force
            for design, force in zip(self.amended.runs, self.promised_forces, strict=True)
        ]
        pairs = list(zip(self.amended.runs, residuals, strict=True))
        products = [design.whitening.gram(np.column_stack((residual, design.columns))) for design, residual in pairs]
        total = np.sum(products, axis=0)
        coefficients = np.linalg.solve(total[1:, 1:] + np.diag(self.amended.prior_precision), total[1:, 0])
        return [np.asarray(residual - design.columns @ coefficients) for design, residual in pairs]

    def explained_share(self) -> float | None:
        """Return the share of chi-square beyond noise that the effects explain; None without a gap that matters."""
        if not self.effects:
            return None
        before, after = (
            sum(
                float(np.sum(design.whitening.whiten(residual) ** 2))
                for design, residual in zip(self.amended.runs, self.refitted(with_effects=with_effects), strict=True)
            )
            for with_effects in (False, True)
        )
        blocks = sum(design.residual.size for design in self.amended.runs)
        return (before - after) / (before - blocks) if before > MIN_GAP_OVER_FLOOR**2 * blocks else None

    def gaps(self) -> list[RunGap]:
        """Return residuals without and with the effects, the specimen's parameters fitted to these runs for each.

        The own factors of a sliding run are limited as where the promise was made, or a run at constant speed would
        take the whole effect for its own scatter. Those of a relaxation are limited by their prior alone, as in the
        fit: relaxations of some newtons that are off by more than a firm limit would outweigh all other runs.
        """
        before, after = (self.refitted(with_effects=with_effects) for with_effects in (False, True))
        return [
            gap_of_run(
                run,
                self.study.problem.noises[number],
                design.motion_sd,
                (before[number], design.whitening),
                (after[number], design.whitening),
                self.study.problem.zero_sds[number],
                self.study.informative_blocks(number, design.motion_sd),
                np.inf if run.experiment.contact is Contact.STICKING else MAX_OWN_SIGMAS,
            )
            for number, (run, design) in enumerate(zip(self.study.runs, self.amended.runs, strict=True))
        ]


def is_allowed_size(active: ActiveEffect, relative: float) -> bool:
    """Whether the parameter of an effect's size may have this size, relative to the promised one."""
    parameter = active.effect.size
    return relative in {0.0, 1.0} or parameter.allows(relative * active.values[parameter.name])


def resized_model(model: ModelSettings, effect: Effect, relative: float) -> ModelSettings:
    """Return the model with an effect at a relative size; without the effect where that is 0."""

    def parameters(settings: EffectSettings) -> Mapping[str, float]:
        values = {**effect.defaults, **settings.parameters}
        return {**values, effect.size.name: relative * values[effect.size.name]}

    effects = tuple(
        settings.model_copy(update={"parameters": parameters(settings)}) if settings.id == effect.id else settings
        for settings in model.effects
        if settings.id != effect.id or relative
    )
    return model.model_copy(update={"effects": effects})


def refitted_chi2(gram: FloatArray, precision: FloatArray) -> float:
    """Return chi-square of the first column, the others fitted under their prior."""
    moments = gram[1:, 0]
    return float(gram[0, 0] - moments @ np.linalg.solve(gram[1:, 1:] + np.diag(precision), moments))


def best_size(grid: Sequence[float], grams: FloatArray, precision: FloatArray) -> tuple[float, float]:
    """Return the size at which chi-square is least, and its standard error, by a parabola through the lowest sizes."""
    chi2 = np.array([refitted_chi2(gram, precision) for gram in grams])
    lowest = int(np.clip(np.argmin(chi2), 1, len(grid) - 2))
    near = slice(lowest - 1, lowest + 2)
    curvature, slope, _ = np.polyfit(grid[near], chi2[near], 2).tolist()
    if curvature <= 0:
        return 0.0, SIZE_PRIOR_SD
    size = float(np.clip(-slope / (2 * curvature), *SIZE_LIMITS))
    return size, min(1.0 / float(np.sqrt(curvature)), SIZE_PRIOR_SD)


def size_in_position(candidate: Candidate, runs: Sequence[PositionErrors]) -> RelativeEffectSize:
    """Return the size of an effect on the position relative to the promised one, with its interval over runs."""
    predictions = [predicted_position_error(candidate, run) for run in runs]
    # Weighted as in the fit of a diagnosis: an effect that grows otherwise with speed than the catalogue's has another
    # size in the fastest runs, which would decide alone.
    weights = [position_weights(run) ** 2 for run in runs]
    products = np.array(
        [
            (prediction @ (weight * prediction), prediction @ (weight * run.error_mm))
            for prediction, weight, run in zip(predictions, weights, runs, strict=True)
        ]
    )
    if not runs or not products[:, 0].any():
        return unseen_effect_size(candidate.effect)
    power, moment = (run_weights(len(runs), np.random.default_rng(0)) @ products).T
    low, high = np.quantile(moment / np.maximum(power, 1e-12), (0.025, 0.975)).tolist()
    total, along = products.sum(axis=0).tolist()
    variance = float(np.mean([run.noise_variance for run in runs]))
    squares = sum(float(prediction @ prediction) for prediction in predictions)
    return RelativeEffectSize(
        candidate.effect.id, along / max(total, 1e-12), low, high, float(np.sqrt(squares / variance))
    )


def unseen_effect_size(effect: Effect) -> RelativeEffectSize:
    """Return the size of an effect of which these runs show nothing, neither its presence nor its absence."""
    return RelativeEffectSize(effect.id, 0.0, *SIZE_LIMITS, 0.0)


def _size_of_hum(effect: Effect, values: Mapping[str, float], selection: RunSelection) -> RelativeEffectSize:
    """Return the amplitude of the mains line in these runs against the promised one."""
    channel = "force"
    promised = values[effect.size.name]
    detectable = detectable_line_amplitude(selection.experiments, channel, MIN_HUM_LLR)
    if detectable is None or promised <= 0:
        return unseen_effect_size(effect)
    amplitude = find_spectral_lines(selection.experiments, channel).mains.amplitude
    half = detectable / promised
    size = amplitude / promised
    return RelativeEffectSize(
        effect.id, size, size - half, size + half, promised / detectable * float(np.sqrt(2 * MIN_HUM_LLR))
    )
