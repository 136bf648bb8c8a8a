"""A campaign prepared for a diagnosis, its linearisation with the effects as candidates, and fits within it.

All columns that may explain a residual are whitened by run. Least squares with priors, Gauss-Newton steps, the ranking
of the dictionary, held-out scores and forward selection work on the Gram matrices of this design alone.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from itertools import product
from math import atan2, hypot, pi

import numpy as np

from dragrig.analysis import (
    ANGLE_PARAMETER,
    FRICTION_VARIATION,
    STIFFNESS_VARIATION,
    UNKNOWN_FORCE_MN,
    JointProblem,
    Whitening,
)
from dragrig.analysis.gap.run_data import RunData, smooth_modulations
from dragrig.config import EffectSettings, ModelSettings
from dragrig.rig import BoolArray, Contact, FloatArray, IndexArray
from dragrig.sim_backend.effects import (
    ActiveEffect,
    Channel,
    Effect,
    EffectChain,
    EffectParameter,
    Location,
    Role,
    RunState,
)


@dataclass(frozen=True, slots=True, eq=False)
class EffectVariant:
    """An effect with one combination of its shape parameters, its size at the default."""

    effect: Effect
    """The effect."""
    values: Mapping[str, float]
    """Values of all parameters."""
    is_quadrature: bool = False
    """For a periodic effect: whether it is the variant before it, shifted by a quarter of a period."""

    @property
    def one_signed(self) -> bool:
        """Whether the amplitude can have one sign only."""
        return self.effect.size.low >= 0 and self.effect.phase is None


def variants_of(effects: Sequence[Effect]) -> tuple[EffectVariant, ...]:
    """Return the dictionary: all variants of the effects that act on the force channel."""
    return tuple(variant for effect in effects if effect.channel is Channel.FORCE for variant in _variants(effect))


def _variants(effect: Effect) -> Iterator[EffectVariant]:
    grids = [parameter.start_values for parameter in effect.shapes]
    for combination in product(*grids):
        values = {
            **effect.defaults,
            **{parameter.name: value for parameter, value in zip(effect.shapes, combination, strict=True)},
        }
        phase = effect.phase
        if phase is None:
            yield EffectVariant(effect, values)
            continue
        yield EffectVariant(effect, {**values, phase.name: 0.0})
        yield EffectVariant(effect, {**values, phase.name: 0.5 * pi}, is_quadrature=True)


def forms_of(dictionary: Sequence[EffectVariant]) -> Iterator[tuple[int, ...]]:
    """Yield the indices of each form of the effects: of one variant, or of both quadratures of a periodic one."""
    for number, variant in enumerate(dictionary):
        if not variant.is_quadrature:
            is_periodic = number + 1 < len(dictionary) and dictionary[number + 1].is_quadrature
            yield (number, number + 1) if is_periodic else (number,)


def signature(variant: EffectVariant, scene: RunState, gain: float) -> FloatArray:
    """Return the change of the measured force by a variant at its default size, shape `(n,)`."""
    return variant.effect.force_change(scene, variant.values, gain)


def signatures(
    variants: Sequence[EffectVariant], scene: RunState, gain: float, repeated: FloatArray | None = None
) -> FloatArray:
    """Return the signatures of variants in one run, shape `(S, n)`.

    Parameters
    ----------
    repeated
        Signatures in a run that this run repeats; only those that vary within the session are computed again.
    """
    rows = np.empty((len(variants), scene.time_s.size)) if repeated is None else repeated.copy()
    for row, variant in zip(rows, variants, strict=True):
        if repeated is None or variant.effect.varies_in_session:
            row[:] = signature(variant, scene, gain)
    return rows


DERIVATIVE_STEP = 0.02
"""Step of a numerical derivative, relative to the value or its default."""
PERIOD_STEP = 1e-5
"""The same of a period on the machine, of which runs may hold thousands."""
SHAPE_PRIOR_SD = 0.5
"""Prior standard deviation of a shape parameter, relative."""
PHASE_PRIOR_SD_RAD = 2.0
MIN_SIZE_FACTOR = 0.2
AT_LIMIT_RATIO = 0.99
MAX_RELATIVE_STEP = 0.35
"""Largest relative change of a shape parameter in one fit step; of a phase twice as much, in rad."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """An effect with values of its parameters, as a hypothesis assumes it."""

    effect: Effect
    values: Mapping[str, float]

    @property
    def settings(self) -> EffectSettings:
        """The effect as in a friction model's settings."""
        return EffectSettings(id=self.effect.id, parameters=dict(self.values))

    @property
    def fitted_parameters(self) -> tuple[EffectParameter, ...]:
        """Parameters to be fitted: size, phase, and shape parameters that have a grid."""
        return tuple(
            parameter
            for parameter in self.effect.parameters
            if parameter.role is not Role.SHAPE or len(parameter.grid) > 1
        )

    @property
    def at_limit(self) -> bool:
        """Whether the size is at its bound. A bound of 1 does not count: a share may well be all of it."""
        size = self.effect.size
        value = self.values[size.name]
        return size.high != 1.0 and (
            value >= AT_LIMIT_RATIO * size.high or (size.low < 0 and value <= AT_LIMIT_RATIO * size.low)
        )

    def prior_sds(self) -> FloatArray:
        """Return prior standard deviations of the fitted parameters; wide ones for the size."""
        return np.array([self._prior_sd(parameter) for parameter in self.fitted_parameters])

    def step_bounds(self) -> tuple[FloatArray, FloatArray]:
        """Return the most negative and most positive steps of the fitted parameters, shape `(p,)` each."""
        low, high = zip(*(self._step_bounds_of(parameter) for parameter in self.fitted_parameters), strict=True)
        return np.array(low), np.array(high)

    def moved(self, steps: FloatArray) -> "Candidate":
        """Return the candidate after a step of its fitted parameters, limited to the step bounds."""
        within = np.clip(steps, *self.step_bounds())
        moved = {
            parameter.name: self.values[parameter.name] + step
            for parameter, step in zip(self.fitted_parameters, within.tolist(), strict=True)
        }
        return replace(self, values={**self.values, **moved})

    def _step_bounds_of(self, parameter: EffectParameter) -> tuple[float, float]:
        value = self.values[parameter.name]
        if parameter.role is Role.PHASE:
            return -2 * MAX_RELATIVE_STEP, 2 * MAX_RELATIVE_STEP
        if parameter.role is Role.SIZE:
            # A step that overshoots must not reach size 0, where the shape parameters have no influence.
            low = parameter.low if parameter.low < 0 else max(parameter.low, MIN_SIZE_FACTOR * value)
            return low - value, parameter.high - value
        max_step = MAX_RELATIVE_STEP * max(abs(value), 1e-3 * abs(parameter.high))
        return max(parameter.low - value, -max_step), min(parameter.high - value, max_step)

    def derivative_step(self, parameter: EffectParameter) -> float:
        """Return the step of the numerical derivative by a parameter."""
        value = self.values[parameter.name]
        if parameter.role is Role.PHASE:
            return DERIVATIVE_STEP
        if parameter.role is Role.SIZE:
            return DERIVATIVE_STEP * max(abs(value), 0.05 * abs(parameter.default))
        if self.effect.origin_parameter and parameter == self.effect.period:
            return PERIOD_STEP * value
        step = DERIVATIVE_STEP * max(abs(value), 1e-3 * abs(parameter.high))
        return step if value + step <= parameter.high else -step

    def _prior_sd(self, parameter: EffectParameter) -> float:
        if parameter.role is Role.SIZE:
            return 10.0 * max(abs(parameter.high), abs(parameter.low), abs(parameter.default))
        if parameter.role is Role.PHASE:
            return PHASE_PRIOR_SD_RAD
        return SHAPE_PRIOR_SD * max(abs(self.values[parameter.name]), 1e-3 * abs(parameter.high))


KNOWN_SHARE = 0.01
"""A block is unknown from this share of the uncertainty of an unknown force on: a ten-thousandth of its time."""


def chain_with(candidates: Sequence[Candidate], known: EffectChain) -> EffectChain:
    """Return the effects of the nominal model together with candidates."""
    by_id = sorted(candidates, key=lambda candidate: candidate.effect.id)
    return known.with_effects(ActiveEffect(candidate.effect, candidate.values) for candidate in by_id)


def added_force(chain: EffectChain, scene: RunState, gain: float) -> FloatArray:
    """Return the change of the measured force by a chain of effects, shape `(n,)`."""
    return np.asarray(chain.measured_force(scene, chain.load(scene), gain) - gain * scene.nominal)


def parameter_derivatives(
    candidates: Sequence[Candidate], known: EffectChain, scene: RunState, gain: float
) -> FloatArray:
    """Return derivatives of the measured force by the candidates' fitted parameters in turn, shape `(E, n)`."""
    baseline = added_force(chain_with(candidates, known), scene, gain)
    rows = []
    for index, candidate in enumerate(candidates):
        for parameter in candidate.fitted_parameters:
            step = candidate.derivative_step(parameter)
            values = {**candidate.values, parameter.name: candidate.values[parameter.name] + step}
            changed = [*candidates]
            changed[index] = replace(candidate, values=values)
            rows.append((added_force(chain_with(changed, known), scene, gain) - baseline) / step)
    return np.array(rows).reshape(len(rows), baseline.size)


@dataclass(frozen=True, eq=False)
class Study(ABC):
    """The force of a campaign's runs, prepared for a diagnosis; subclasses adapt a nominal model."""

    problem: JointProblem
    """Block data, noise and priors."""
    runs: tuple[RunData, ...]
    """Data of each run."""
    effects: tuple[Effect, ...]
    """Candidate effects on the force channel."""

    @abstractmethod
    def scene(self, number: int, z: FloatArray) -> tuple[RunState, float]:
        """Return the state of a run that effects act on, and the gain of the force sensor."""

    def scenes(self, z: FloatArray) -> Iterator[tuple[RunState, float]]:
        """Yield `scene` of each run; repeats share all but their place in the session with the first."""
        first: dict[int, tuple[RunState, float]] = {}
        for number, (run, first_run) in enumerate(zip(self.runs, self.problem.representatives, strict=True)):
            if first_run == number:
                first[number] = self.scene(number, z)
                yield first[number]
                continue
            scene, gain = first[first_run]
            order = run.experiment.run.info.header.order
            origin_mm = run.experiment.origin_mm
            yield replace(scene, session_start_s=run.session_start_s, order=order, origin_mm=origin_mm), gain

    @abstractmethod
    def limitations(self) -> Iterator[str]:
        """Yield the questions that these runs and this model cannot answer, a sentence each."""

    @property
    def chain(self) -> EffectChain:
        """Effects that the nominal model already contains; none by default."""
        return EffectChain()

    @property
    def only_condition(self) -> str:
        """The condition of the runs in words where they have no other; else empty."""
        one = len({run.condition for run in self.runs}) == 1 and all(run.is_one_condition for run in self.runs)
        return self.runs[0].condition_text if one else ""

    @property
    def initial_z(self) -> FloatArray:
        """Nominal parameters, in prior standard deviations, from which a diagnosis starts: the prior mean."""
        return np.zeros(len(self.parameter_names))

    def model_errors(self, number: int, scene: RunState) -> FloatArray:
        """Return the change of the force by each model error direction, shape `(D, n)`; none by default."""
        del number
        return np.zeros((0, scene.time_s.size))

    def prediction_sds(self, z: FloatArray) -> list[FloatArray]:
        """Return the uncertainty of each run's predicted block means beside noise, one standard deviation, `(B,)`."""
        return self.problem.uncertainties(z)

    def informative_blocks(self, number: int, motion_sd: FloatArray) -> BoolArray:
        """Return which blocks count for the size of a gap: those known from the motion better than a sample's noise.

        Where no block is that certain, as in a motion that is nowhere steady, those that are as certain as usual count.

        Parameters
        ----------
        motion_sd
            Uncertainty of each block from the measured motion [mN], shape `(B,)`.
        """
        noise = float(np.hypot(self.problem.noises[number].white, self.runs[number].block_data.moving_white))
        known = motion_sd <= noise
        predicted = motion_sd[motion_sd < KNOWN_SHARE * UNKNOWN_FORCE_MN]
        return known if known.any() or not predicted.size else motion_sd <= float(np.median(predicted))

    def amended_settings(self, z: FloatArray) -> ModelSettings | None:
        """Return the model with fitted values, to which found effects can be added; None by default."""
        del z
        return None

    def untried_lookalikes(self, design: "Design") -> int:
        """Return how many effects that could not be tried may look like a design's candidates; 0 by default."""
        del design
        return 0

    def naming_obstacle(self, design: "Design") -> str:
        """Return why these runs do not establish a design's candidates, though they fit; nothing by default."""
        del design
        return ""

    @property
    def channel(self) -> str:
        """Name of the force channel that is explained."""
        return self.problem.channels[0].channel

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the nominal parameters."""
        return tuple(parameter.name for parameter in self.problem.nominal.parameters)

    @cached_property
    def variants(self) -> tuple[EffectVariant, ...]:
        """Dictionary of all variants of all candidate effects."""
        return variants_of(self.effects)

    @cached_property
    def modulations(self) -> tuple[FloatArray, ...]:
        """Smooth functions by which a real effect may deviate from the catalogue, per run, shape `(K, B)`."""
        return smooth_modulations(self.runs)

    def values(self, z: FloatArray) -> Mapping[str, float]:
        """Return nominal parameters by name from `z`, in prior standard deviations."""
        return dict(zip(self.parameter_names, self.problem.scales.values(z).tolist(), strict=True))


def problem_of_runs(problem: JointProblem, indices: Sequence[int]) -> JointProblem:
    """Return the problem restricted to some runs, in that order."""
    return replace(
        problem,
        channels=tuple(problem.channels[index] for index in indices),
        noises=tuple(problem.noises[index] for index in indices),
        zero_sds=tuple(problem.zero_sds[index] for index in indices),
    )


ANGLE_SECANT_SD = 0.6
"""Half width of the secant, in prior standard deviations of the contact angle."""
WALL_PLACES = (Location.WALL, Location.SPECIMEN)
"""Effects here act as stiffness where the capsule sticks, and scatter from run to run with the wall's stiffness."""
MODULATION_PRIOR_SD = 0.2
"""Prior of each modulation: relative deviation of a real effect from the catalogue's form."""


class ColumnKind(StrEnum):
    """Kind of a column of a design."""

    NOMINAL = "nominal"
    MODEL_ERROR = "detail"
    EFFECT = "effect"
    MODULATION = "foreign"
    VARIANT = "shape"


@dataclass(frozen=True, slots=True, eq=False)
class RunDesign:
    """Rows of a design that belong to one run."""

    residual: FloatArray
    """Measured minus predicted block means [mN], shape `(B,)`."""
    columns: FloatArray
    """Derivatives of the prediction, not whitened, shape `(B, C)`."""
    effect_force: FloatArray
    """Force of the candidates, without effects of the nominal model, shape `(B,)`."""
    predicted: FloatArray
    """Prediction of the nominal model, shape `(B,)`."""
    motion_sd: FloatArray
    """Uncertainty from motion and integration steps, one standard deviation, shape `(B,)`."""
    whitening: Whitening
    """Transformation that makes its blocks independent with unit variance."""


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """A campaign, linearised around a point."""

    z: FloatArray
    candidates: tuple[Candidate, ...]
    """`z`, `candidates`: the point: nominal parameters in prior standard deviations, and candidate effects."""
    runs: tuple[RunDesign, ...]
    """Rows of each run."""
    column_kinds: tuple[ColumnKind, ...]
    """Kind of each of the `C` columns."""
    prior_mean: FloatArray
    prior_precision: FloatArray
    """`prior_mean`, `prior_precision`: prior of the columns' coefficients, shape `(C,)`; 0 for variants, which are
    tried one at a time.
    """
    grams: tuple[FloatArray, ...]
    """Gram matrix of residual (first) and columns, whitened, for each run, shape `(1 + C, 1 + C)`."""
    block_counts: tuple[int, ...]
    """Number of blocks of each run."""
    variants: tuple[EffectVariant, ...]
    """The dictionary, in the order of the columns of kind `VARIANT`."""

    @property
    def log_det(self) -> float:
        """Log determinant of all runs' covariances, which depend on the prediction."""
        whitenings = [run.whitening for run in self.runs]
        noise = sum(2 * float(np.log(np.diag(whitening.noise_root)).sum()) for whitening in whitenings)
        return noise - sum(2 * float(np.log1p(-whitening.shrinkage).sum()) for whitening in whitenings)

    def columns_of(self, *kinds: ColumnKind) -> IndexArray:
        """Return the indices of the columns of these kinds."""
        return np.array([index for index, kind in enumerate(self.column_kinds) if kind in kinds], dtype=np.intp)

    def run_columns(self, kind: ColumnKind) -> list[FloatArray]:
        """Return the columns of a kind for each run, shape `(B, c)`."""
        indices = self.columns_of(kind)
        return [run.columns[:, indices] for run in self.runs]

    @property
    def run_rows(self) -> list[slice]:
        """Return the place of each run's blocks among those of all runs."""
        ends = np.cumsum([run.residual.size for run in self.runs]).tolist()
        return [slice(end - run.residual.size, end) for run, end in zip(self.runs, ends, strict=True)]

    @property
    def whitenings(self) -> tuple[Whitening, ...]:
        """Whitening of each run."""
        return tuple(run.whitening for run in self.runs)

    def with_columns(self, *kinds: ColumnKind) -> "Design":
        """Return the design with the columns of these kinds alone, to save memory."""
        columns = self.columns_of(*kinds)
        rows = np.concatenate(([0], 1 + columns))
        return replace(
            self,
            runs=tuple(replace(run, columns=run.columns[:, columns]) for run in self.runs),
            column_kinds=tuple(self.column_kinds[index] for index in columns.tolist()),
            prior_mean=self.prior_mean[columns],
            prior_precision=self.prior_precision[columns],
            grams=tuple(gram[np.ix_(rows, rows)] for gram in self.grams),
            variants=self.variants if ColumnKind.VARIANT in kinds else (),
        )

    def total_gram(self, runs: Sequence[int] | None = None) -> FloatArray:
        """Return the sum of the Gram matrices of some runs, by default of all."""
        indices = range(len(self.grams)) if runs is None else runs
        total = np.zeros_like(self.grams[0])
        for index in indices:
            total += self.grams[index]
        return total


def linearise(
    study: Study,
    z: FloatArray,
    candidates: Sequence[Candidate] = (),
    *,
    reference: Design | None = None,
    modulated: bool = False,
    dictionary: bool = False,
) -> Design:
    """Linearise a campaign around a point.

    Parameters
    ----------
    reference
        Design around a nearby point whose derivatives and uncertainties are reused; default: computed anew.
    modulated
        Whether to add columns for modulations of the candidates' forces.
    dictionary
        Whether to add a column for each variant of each effect.
    """
    problem = study.problem
    predictions = problem.predictions(z)
    uncertainties = study.prediction_sds(z) if reference is None else [run.motion_sd for run in reference.runs]
    whitenings = problem.whitenings(predictions, uncertainties, None if reference is None else reference.whitenings)
    by_nominal = _nominal_derivatives(study, z) if reference is None else reference.run_columns(ColumnKind.NOMINAL)
    reference_model_errors = None if reference is None else reference.run_columns(ColumnKind.MODEL_ERROR)
    run_designs, grams, signatures_by_run = [], [], dict[int, FloatArray]()
    wall = chain_with(candidates, study.chain).only(lambda effect: effect.location in WALL_PLACES)
    interface = study.chain.only(lambda effect: effect.location is Location.INTERFACE)
    for number, (run_data, (scene, gain)) in enumerate(zip(study.runs, study.scenes(z), strict=True)):
        separate = [added_force(chain_with([candidate], study.chain), scene, gain) for candidate in candidates]
        nominal_effects = added_force(study.chain, scene, gain)
        combined = (
            added_force(chain_with(candidates, study.chain), scene, gain)
            if len(separate) > 1
            else sum(separate, nominal_effects * 0)
        )
        effects = run_data.block_means(combined if separate else nominal_effects)
        candidate_force = run_data.block_means(combined - nominal_effects) if separate else 0.0 * effects
        if reference_model_errors is None:
            model_errors = gain * run_data.block_means(study.model_errors(number, scene))
        else:
            model_errors = reference_model_errors[number].T
        rows = [model_errors]
        rows.append(run_data.block_means(parameter_derivatives(candidates, study.chain, scene, gain)))
        if modulated:
            rows += [study.modulations[number] * run_data.block_means(values - nominal_effects) for values in separate]
        if dictionary:
            first_run = problem.representatives[number]
            of_first = signatures_by_run.pop(first_run, None)
            variant_signatures = signatures(study.variants, scene, gain, of_first)
            # At the nodes of all blocks they are large: kept only for runs that follow.
            if first_run in problem.representatives[number + 1 :]:
                signatures_by_run[first_run] = variant_signatures if of_first is None else of_first
            rows.append(run_data.block_means(variant_signatures))
        whitening = whitenings[number]
        is_sticking = run_data.experiment.contact is Contact.STICKING
        varying_chain, variation = (wall, STIFFNESS_VARIATION) if is_sticking else (interface, FRICTION_VARIATION)
        if varying_chain.effects:
            force = run_data.block_means(added_force(varying_chain, scene, gain))
            whitening = problem.with_varying_force(number, predictions[number], variation, force, whitening)
        residual = run_data.block_data.blocks.mean - predictions[number].total - effects
        columns = np.column_stack((by_nominal[number], *(values.T for values in rows)))
        predicted, uncertain = predictions[number].total, uncertainties[number]
        run_designs.append(RunDesign(residual, columns, candidate_force, predicted, uncertain, whitening))
        grams.append(whitening.gram(np.column_stack((residual, columns))))
    priors = _column_priors(z, len(model_errors), candidates, len(study.modulations[0]) if modulated else 0)
    variants = study.variants if dictionary else ()
    kinds, mean, precision = zip(*priors, *[(ColumnKind.VARIANT, 0.0, 0.0)] * len(variants), strict=True)
    return Design(
        z=z,
        candidates=tuple(candidates),
        runs=tuple(run_designs),
        column_kinds=kinds,
        prior_mean=np.array(mean),
        prior_precision=np.array(precision),
        grams=tuple(grams),
        block_counts=tuple(len(run.residual) for run in run_designs),
        variants=variants,
    )


def _nominal_derivatives(study: Study, z: FloatArray) -> list[FloatArray]:
    """Return the derivatives of block means by `z`; a secant for the contact angle.

    With the contact angle, the moments shift at which friction jumps (when a bend of the motion reaches the equator). A
    tangent misses these jumps, and a fit that follows it stops beside the minimum.
    """
    derivatives = study.problem.derivatives(z, without=(ANGLE_PARAMETER,))
    if ANGLE_PARAMETER not in study.parameter_names:
        return derivatives
    column = study.parameter_names.index(ANGLE_PARAMETER)
    sides = []
    for side in (1.0, -1.0):
        shifted = z.copy()
        shifted[column] += side * ANGLE_SECANT_SD
        sides.append(study.problem.predictions(shifted))
    for derivative, above, below in zip(derivatives, *sides, strict=True):
        derivative[:, column] = (above.total - below.total) / (2 * ANGLE_SECANT_SD)
    return derivatives


def _column_priors(
    z: FloatArray, model_errors: int, candidates: Sequence[Candidate], modulations: int
) -> list[tuple[ColumnKind, float, float]]:
    priors = [(ColumnKind.NOMINAL, -value, 1.0) for value in z.tolist()]
    priors += [(ColumnKind.MODEL_ERROR, 0.0, 1.0)] * model_errors
    for candidate in candidates:
        priors += [(ColumnKind.EFFECT, 0.0, sd**-2) for sd in candidate.prior_sds().tolist()]
    priors += [(ColumnKind.MODULATION, 0.0, MODULATION_PRIOR_SD**-2)] * (modulations * len(candidates))
    return priors


RELATIVE_RIDGE = 1e-10
"""Relative ridge against collinear columns."""
NUISANCES = (ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT, ColumnKind.MODULATION)


@dataclass(frozen=True, slots=True, eq=False)
class LeastSquaresFit:
    """Posterior mode of the coefficients of some columns."""

    columns: IndexArray
    """Indices of the columns."""
    coefficients: FloatArray
    covariance: FloatArray
    """`coefficients`, `covariance`: coefficients and their posterior covariance, shapes `(c,)` and `(c, c)`."""
    chi2: float
    """Remaining chi-square, priors included."""


def fit_columns(design: Design, total: FloatArray, *kinds: ColumnKind) -> LeastSquaresFit:
    """Fit the columns of these kinds to runs whose Gram matrices sum to `total`."""
    columns = design.columns_of(*kinds)
    mean, precision = design.prior_mean[columns], design.prior_precision[columns]
    rows = 1 + columns
    gram = total[np.ix_(rows, rows)]
    precision_matrix = gram + np.diag(precision + RELATIVE_RIDGE * np.diag(gram))
    moment = total[rows, 0] + precision * mean
    covariance = np.asarray(np.linalg.inv(precision_matrix), dtype=np.float64)
    coefficients = covariance @ moment
    chi2 = float(total[0, 0] + np.sum(precision * mean**2) - moment @ coefficients)
    return LeastSquaresFit(columns, coefficients, covariance, chi2)


def nominal_residuals(design: Design) -> list[FloatArray]:
    """Return the residuals of each run after a fit of the nominal model to all runs, shape `(B,)` [mN]."""
    solution = fit_columns(design, design.total_gram(), ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR)
    return [run.residual - run.columns[:, solution.columns] @ solution.coefficients for run in design.runs]


def fit_bounded(
    design: Design, total: FloatArray, bounds: tuple[FloatArray, FloatArray], *kinds: ColumnKind
) -> FloatArray:
    """Return the posterior mode of the columns of these kinds within bounds, shape `(c,)`."""
    from scipy.optimize import lsq_linear

    columns = design.columns_of(*kinds)
    mean, precision = design.prior_mean[columns], design.prior_precision[columns]
    gram = total[np.ix_(1 + columns, 1 + columns)]
    scale = 1.0 / np.sqrt(np.diag(gram) + precision + 1e-300)
    moment = scale * (total[1 + columns, 0] + precision * mean)
    precision_matrix = scale[:, None] * (gram + np.diag(precision)) * scale + RELATIVE_RIDGE * np.eye(len(columns))
    root = np.linalg.cholesky(precision_matrix)
    low, high = (np.minimum(bounds[0], -1e-9) / scale, np.maximum(bounds[1], 1e-9) / scale)
    solution = lsq_linear(root.T, np.linalg.solve(root, moment), (low, high), method="bvls")
    return np.asarray(solution.x * scale, dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class ProjectedDictionary:
    """The dictionary with nuisances projected out."""

    chi2: float
    """Chi-square that the nuisances leave."""
    moment: FloatArray
    gram: FloatArray
    """`moment`, `gram`: products of the variants with the residual and with each other, shapes `(S,)` and `(S, S)`."""

    def without(self, variants: Sequence[int]) -> "ProjectedDictionary":
        """Project out some of the variants, too."""
        index = list(variants)
        own = self.gram[np.ix_(index, index)]
        ridge = 1e-9 * (np.trace(own) + 1e-300) * np.eye(len(index))
        solved = np.linalg.solve(own + ridge, np.column_stack((self.moment[index], self.gram[index])))
        return ProjectedDictionary(
            self.chi2 - float(self.moment[index] @ solved[:, 0]),
            self.moment - self.gram[:, index] @ solved[:, 0],
            self.gram - self.gram[:, index] @ solved[:, 1:],
        )


def project_dictionary(design: Design, total: FloatArray, *kinds: ColumnKind) -> ProjectedDictionary:
    """Project the columns of these kinds out of residual and dictionary."""
    complement = schur_complement(design, total, design.columns_of(*kinds), 1 + design.columns_of(ColumnKind.VARIANT))
    return ProjectedDictionary(float(complement[0, 0]), complement[0, 1:], complement[1:, 1:])


def schur_complement(
    design: Design,
    total: FloatArray,
    columns: IndexArray,
    retained_rows: IndexArray,
    column_rows: IndexArray | None = None,
) -> FloatArray:
    """Return the products of residual (first) and other rows after columns of a design are projected out.

    Parameters
    ----------
    total
        Gram matrix of the residual (first), the columns, and other rows.
    columns
        Indices of the columns to project out, within their priors.
    retained_rows
        Other `k` rows of `total` to retain; the result has shape `(1 + k, 1 + k)`.
    column_rows
        Rows of the columns in `total`; default: as in the design.
    """
    mean, precision = design.prior_mean[columns], design.prior_precision[columns]
    projected, retained = 1 + columns if column_rows is None else column_rows, np.concatenate(([0], retained_rows))
    gram, cross = total[np.ix_(projected, projected)], total[np.ix_(projected, retained)]
    cross[:, 0] += precision * mean
    solved = np.linalg.solve(gram + np.diag(precision + RELATIVE_RIDGE * np.diag(gram)), cross)
    complement = total[np.ix_(retained, retained)] - cross.T @ solved
    complement[0, 0] += np.sum(precision * mean**2)
    return np.asarray(complement)


MAX_STEP_SD = 3.0
"""Largest step of a nominal parameter, in prior standard deviations."""
MAX_DEVIATION_SD = 4.5
"""Largest deviation of a nominal parameter from its prior mean, in prior standard deviations."""
CONVERGED_STEP_SD = 0.1
"""Converged when every nominal parameter moves by less than this."""


@dataclass(frozen=True, slots=True, eq=False)
class ParameterPoint:
    """Nominal parameters in prior standard deviations, and candidate effects."""

    z: FloatArray
    candidates: tuple[Candidate, ...] = ()


def gauss_newton(study: Study, start: ParameterPoint, steps: int, reference: Design | None = None) -> ParameterPoint:
    """Return the point that Gauss-Newton steps lead to.

    Parameters
    ----------
    steps
        Maximum number of steps.
    reference
        Design around a nearby point whose derivatives are kept; default: new ones in each step.
    """
    point = start
    for _ in range(steps):
        design = linearise(study, point.z, point.candidates, reference=reference)
        after = gauss_newton_step(design)
        moved = float(np.abs(after.z - point.z).max())
        point = after
        if moved < CONVERGED_STEP_SD and not point.candidates:
            break
    return point


def gauss_newton_step(design: Design) -> ParameterPoint:
    """Return the point that one bounded step from a design's point leads to."""
    kinds = (ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT)
    nominal = (
        np.maximum(-MAX_STEP_SD, -MAX_DEVIATION_SD - design.z),
        np.minimum(MAX_STEP_SD, MAX_DEVIATION_SD - design.z),
    )
    free = np.full(len(design.columns_of(ColumnKind.MODEL_ERROR)), np.inf)
    bounds = [nominal, (-free, free), *(candidate.step_bounds() for candidate in design.candidates)]
    low, high = (np.concatenate(side) for side in zip(*bounds, strict=True))
    steps_of_all = fit_bounded(design, design.total_gram(), (low, high), *kinds)
    z = np.clip(design.z + steps_of_all[: len(design.z)], -MAX_DEVIATION_SD, MAX_DEVIATION_SD)
    steps = steps_of_all[len(design.z) + len(free) :]
    candidates = []
    for candidate in design.candidates:
        own_steps, steps = steps[: len(candidate.fitted_parameters)], steps[len(candidate.fitted_parameters) :]
        candidates.append(candidate.moved(own_steps))
    return ParameterPoint(z, tuple(candidates))


def misfit_here(design: Design) -> float:
    """Return −2 log posterior density at a design's nominal parameters, but for a constant."""
    at_point = fit_columns(design, design.total_gram(), ColumnKind.MODEL_ERROR).chi2
    return at_point + float(design.z @ design.z) + design.log_det


def gain_of_step(design: Design) -> float:
    """Return by how much a step of the nominal parameters would lower chi-square, priors included."""
    after = fit_columns(design, design.total_gram(), ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR).chi2
    return misfit_here(design) - design.log_det - after


def joint_fit(design: Design, variants: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Fit nuisances and some variants together; return nominal parameters and the variants' amplitudes."""
    columns = np.concatenate((design.columns_of(*NUISANCES), design.columns_of(ColumnKind.VARIANT)[list(variants)]))
    rows = 1 + columns
    total = design.total_gram()
    precision, mean = design.prior_precision[columns], design.prior_mean[columns]
    precision_matrix = total[np.ix_(rows, rows)] + np.diag(precision + 1e-10 * np.diag(total)[rows])
    coefficients = np.linalg.solve(precision_matrix, total[rows, 0] + precision * mean)
    count = len(design.columns_of(ColumnKind.NOMINAL))
    z = np.clip(
        design.z + np.clip(coefficients[:count], -MAX_STEP_SD - 1, MAX_STEP_SD + 1), -MAX_DEVIATION_SD, MAX_DEVIATION_SD
    )
    return z, coefficients[len(coefficients) - len(variants) :]


@dataclass(frozen=True, slots=True, eq=False)
class RankedEffect:
    """The best variant of an effect."""

    effect: str
    llr: float
    """Log likelihood ratio: half the chi-square difference."""
    d_prime_per_unit: float
    """d′ of the effect at its default size: the norm of its signature with nuisances projected out."""
    variants: tuple[int, ...]
    """Indices in the dictionary; two for a periodic effect."""
    amplitude: FloatArray
    """Their coefficients, in default sizes."""

    def candidate(self, dictionary: Sequence[EffectVariant], amplitude: FloatArray | None = None) -> Candidate:
        """Return the effect with the parameters of this variant and a size from the amplitude."""
        variant = dictionary[self.variants[0]]
        effect, fitted = variant.effect, self.amplitude if amplitude is None else amplitude
        values = dict(variant.values)
        phase = effect.phase
        if phase is None:
            values[effect.size.name] *= float(fitted[0])
        else:
            values[effect.size.name] *= hypot(*fitted.tolist())
            values[phase.name] = atan2(float(fitted[1]), float(fitted[0]))
        size = values[effect.size.name]
        values[effect.size.name] = float(np.clip(size, effect.size.low, effect.size.high))
        return Candidate(effect, values)


def rank_effects(projected: ProjectedDictionary, dictionary: Sequence[EffectVariant]) -> tuple[RankedEffect, ...]:
    """Return the best variant of every effect, by decreasing log likelihood ratio."""
    best: dict[str, RankedEffect] = {}
    for ranked in _scored_variants(projected, dictionary):
        if ranked.effect not in best or ranked.llr > best[ranked.effect].llr:
            best[ranked.effect] = ranked
    return tuple(sorted(best.values(), key=lambda ranked: -ranked.llr))


def score_variants(projected: ProjectedDictionary, dictionary: Sequence[EffectVariant]) -> FloatArray:
    """Return the log likelihood ratio of each variant, of a periodic one with its quadrature, shape `(S,)`."""
    values = np.zeros(len(dictionary))
    for ranked in _scored_variants(projected, dictionary):
        values[list(ranked.variants)] = ranked.llr
    return values


def _scored_variants(projected: ProjectedDictionary, dictionary: Sequence[EffectVariant]) -> Iterator[RankedEffect]:
    products = np.diag(projected.gram)
    for index in forms_of(dictionary):
        form = slice(index[0], index[-1] + 1)
        variant = dictionary[index[0]]
        gram, moment = projected.gram[form, form], projected.moment[form]
        strength = float(products[form].mean())
        if strength <= 1e-9:
            continue
        amplitude = np.asarray(np.linalg.solve(gram + 1e-9 * strength * np.eye(len(index)), moment), dtype=np.float64)
        llr = 0.5 * float(moment @ amplitude)
        if variant.one_signed and amplitude[0] < 0:
            llr, amplitude = 0.0, 0.0 * amplitude
        yield RankedEffect(variant.effect.id, llr, float(np.sqrt(strength)), index, amplitude)
