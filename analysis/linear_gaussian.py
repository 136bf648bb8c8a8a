"""Parameters of a nominal model from many runs: block means, Gaussian noise and priors, linearised and iterated.

The runs' own zeros and factors are Gaussian and enter linearly, so that they are integrated out: they are part of
each run's covariance. That covariance is linearised around the present prediction and held while the parameters are
fitted, then linearised again, until nothing moves; so a weaker model cannot buy itself a smaller error.
"""

from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache, cached_property
from math import sqrt
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np

from dragrig.analysis.models import Experiment, NominalModel, Parameter, Prediction, Predictor
from dragrig.analysis.noise import (
    BlockMeans,
    NoiseModel,
    RepeatDifference,
    added_white_in_motion,
    average_in_blocks,
    estimate_noise,
    solve_lower,
)
from dragrig.analysis.selection import RunSelection
from dragrig.config import AnalysisError
from dragrig.rig import BoolArray, Contact, FloatArray

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

ItemT = TypeVar("ItemT")


@contextmanager
def single_blas_thread() -> Iterator[None]:
    """Let BLAS work in the caller's thread alone.

    Fits are made of many small matrices. Two threads that take turns at them are no faster on an idle machine, and
    four times slower where anything else runs.
    """
    with blas_libraries().limit(limits=1, user_api="blas"):
        yield


@cache
def blas_libraries() -> "ThreadpoolController":
    """Look once for the BLAS of NumPy and of SciPy, which can only be limited once it is loaded."""
    import scipy.linalg  # noqa: F401  # it brings a BLAS of its own
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


STIFFNESS_VARIATION, FRICTION_VARIATION = "stiffness", "friction"
"""Names of the run-to-run variations that multiply the stiff part of the force, and friction."""
ZERO_WIDENING = 2.0
"""A zero's standard deviation is at least this times the median distance from 0 that the runs show."""
MAX_PASSES = 12
CONVERGED_MOVE = 0.05
"""A pass that moves no parameter by more than this, in units of its error, is the last."""
COVARIANCE_UPDATES = 4
"""Passes that linearise the covariance again; with a model that does not hold it may go on for ever otherwise."""
NEWTON_RANGE = 3.0
"""Within this many errors of the minimum, the linearised problem is solved in place of the problem."""
LINE_SEARCH_FRACTIONS = (1.0, 0.5, 0.25, 0.1)
"""Fractions of a late step that are tried; stop when none lowers χ². It jumps where a bend of the motion
reaches the equator within a block, and a minimum at such a jump has no gradient of 0."""
FIRST_PASS_EVALUATIONS, MAX_EVALUATIONS = 2, 8
"""Of the optimiser within a pass; the first only has to come near, under a covariance around nominal values."""
PARAMETER_BOUND = 6.0
"""Largest distance of a parameter from its nominal value, in prior standard deviations."""
DERIVATIVE_REUSE_RANGE = 0.05
"""Derivatives are reused while no parameter moves further: relative to its value, or in prior widths."""
MISFIT_THRESHOLD = 1.1
"""χ² per degree of freedom above which the model leaves more than noise."""


@dataclass(frozen=True, slots=True, eq=False)
class PriorScales:
    """Maps `z`, standard normal a priori, to parameter values: `nominal + sd z`, or `nominal · exp(sd z)`."""

    nominal: FloatArray
    sd: FloatArray
    positive: BoolArray

    @classmethod
    def of(cls, parameters: Sequence[Parameter]) -> "PriorScales":
        """Take nominal values and priors."""
        positive = np.array([parameter.positive for parameter in parameters])
        sd = np.array([parameter.prior_sd for parameter in parameters], dtype=np.float64)
        nominal = np.array([parameter.nominal for parameter in parameters], dtype=np.float64)
        return cls(nominal, np.where(positive, np.sqrt(np.log1p(sd**2)), sd), positive)

    def values(self, z: FloatArray) -> FloatArray:
        """Return the values at `z`, shape `(P,)`."""
        with np.errstate(over="ignore"):
            grown = self.nominal * np.exp(np.where(self.positive, self.sd * z, 0.0))
        return np.asarray(np.where(self.positive, grown, self.nominal + self.sd * z))

    def deviations(self, values: FloatArray) -> FloatArray:
        """Return `z` of values, shape `(P,)`: the inverse of `values`."""
        growth = np.where(self.positive, values, 1.0) / np.where(self.positive, self.nominal, 1.0)
        return np.asarray(np.where(self.positive, np.log(growth), values - self.nominal) / self.sd)

    def slopes(self, values: FloatArray) -> FloatArray:
        """Return dvalue/dz, shape `(P,)`."""
        return np.asarray(np.where(self.positive, values * self.sd, self.sd))


RIPPLE_OUT_OF_STEP = 0.3
"""Part of a line along the way that is not in step with it: its form and wavelength are not known exactly."""


@dataclass(frozen=True, slots=True)
class MovingLine:
    """A line in the spectrum of a channel while the stage moves, as of a drive's controller."""

    amplitude: float
    """Its amplitude, in the channel's unit."""
    frequency_hz: float = 0.0
    wavelength_mm: float = 0.0
    """`frequency_hz`, `wavelength_mm`: its frequency, or 0 and the travel from one wave to the next."""

    def sds(self, width_s: FloatArray, speed_mm_s: FloatArray) -> FloatArray:
        """Return its part in means over some time at some speed, one standard deviation; its phase is not known.

        A line along the way is in step with it, but for `RIPPLE_OUT_OF_STEP` of it.
        """
        hertz = self.frequency_hz if self.wavelength_mm == 0.0 else speed_mm_s / self.wavelength_mm
        # The envelope of |sinc|: whether a mean holds a whole number of waves is chance.
        share = 1.0 / np.maximum(np.pi * hertz * width_s, 1.0)
        random = 1.0 if self.wavelength_mm == 0.0 else RIPPLE_OUT_OF_STEP
        return np.asarray(np.sqrt(0.5) * random * self.amplitude * share * (speed_mm_s > 0))

    def waves(self, place_mm: FloatArray, extent_mm: FloatArray, moves: BoolArray) -> FloatArray:
        """Return the means of a line along the way over stretches of it, in both phases, shape `(B, 2)` or `(B, 0)`."""
        if self.wavelength_mm == 0.0:
            return np.zeros((place_mm.size, 0))
        angle = 2 * np.pi * place_mm / self.wavelength_mm
        size = self.amplitude * np.sinc(extent_mm / self.wavelength_mm) * moves
        return np.stack((size * np.cos(angle), size * np.sin(angle)), axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class ChannelBlocks:
    """One channel of one run: its `B` block means, and the model prepared for it."""

    experiment: Experiment
    channel: str
    predictor: Predictor
    blocks: BlockMeans
    moving_white: float = 0.0
    """White noise that motion adds, standard deviation of one sample in the channel's unit."""
    moving_line: MovingLine | None = None
    """Line that motion adds."""

    @property
    def equivalence_key(self) -> Hashable:
        """Equal where the model predicts the same for the same blocks, whatever was measured in them."""
        blocks = self.blocks
        layout = (blocks.start_s, blocks.end_s, blocks.samples, blocks.nodes_s)
        return (
            self.channel,
            self.moving_white,
            self.moving_line,
            self.predictor.equivalence_key,
            tuple(array.tobytes() for array in layout),
        )

    def predict(self, values: FloatArray) -> Prediction:
        """Predict the means of the blocks."""
        prediction = self.predictor.predict(values, self.blocks.nodes_s)
        return Prediction(self.blocks.of(prediction.total), self.blocks.of(prediction.varying))

    def uncertainty(self, values: FloatArray) -> FloatArray:
        """Return how well they can be predicted, one standard deviation."""
        at_nodes = self.predictor.uncertainty(values, self.blocks.nodes_s)
        of_motion = np.hypot(np.sqrt(self.blocks.of(at_nodes**2)), self._jitter_uncertainty(values))
        if self.moving_white == 0.0 and self.moving_line is None:
            return of_motion
        speed = np.abs(self.experiment.velocity(self.blocks.middle_s))
        if self.moving_line is not None:
            of_motion = np.hypot(of_motion, self.moving_line.sds(self.blocks.end_s - self.blocks.start_s, speed))
        return np.hypot(of_motion, self.moving_white * (speed > 0) / np.sqrt(self.blocks.samples))

    @property
    def line_signatures(self) -> FloatArray:
        """The possible part of a line along the way in the blocks, in units of its prior, shape `(B, k)`."""
        if self.moving_line is None:
            return np.zeros((self.blocks.mean.size, 0))
        start_s, end_s = self.blocks.start_s, self.blocks.end_s
        extent_mm = np.abs(self.experiment.position(end_s) - self.experiment.position(start_s))
        moves = np.abs(self.experiment.velocity(self.blocks.middle_s)) > 0
        return self.moving_line.waves(self.experiment.position(self.blocks.middle_s), extent_mm, moves)

    def _jitter_uncertainty(self, values: FloatArray) -> FloatArray:
        """Return the standard deviation from a clock whose times scatter, where the prediction changes fast."""
        nodes_s, jitter_s = self.blocks.nodes_s, self.experiment.clock_jitter_s
        if jitter_s == 0.0:
            return np.zeros_like(self.blocks.mean)
        last_s = float(self.experiment.time_s[-1])
        early, late = (
            self.predictor.predict(values, np.clip(nodes_s + shift_s, 0.0, last_s)).total
            for shift_s in (-jitter_s, jitter_s)
        )
        return np.asarray(np.sqrt(self.blocks.of((0.5 * (late - early)) ** 2) / self.blocks.samples))

    def sensitivities(self, values: FloatArray, without: Collection[str] = ()) -> FloatArray:
        """Return their derivatives, shape `(P, B)`; rows of the parameters in `without` are not computed."""
        return self.blocks.of(self.predictor.sensitivities_without(without, values, self.blocks.nodes_s))


def prepare_channels(
    experiments: Sequence[Experiment], nominal: NominalModel, longest_mm: float = np.inf
) -> Iterator[ChannelBlocks]:
    """Prepare every channel of every run that the model predicts, in blocks no longer than `longest_mm` of travel.

    Raises `AnalysisError` as the model's `prepare`.
    """
    for experiment in experiments:
        for channel, predictor in nominal.prepare(experiment).items():
            events_s, jumps = predictor.events_s, predictor.jumps
            blocks = average_in_blocks(experiment, channel, events_s, jumps=jumps, longest_mm=longest_mm)
            yield ChannelBlocks(experiment, channel, predictor, blocks)


@dataclass(frozen=True, slots=True, eq=False)
class Whitening:
    """Makes a run's residuals independent and of unit variance when the model holds.

    The covariance holds noise, the uncertainty of the measured motion, and the priors of the run's own effects: its
    zero and the factors of the model's variations.
    """

    noise_root: FloatArray
    """Lower Cholesky factor of the covariance of noise and motion uncertainty, `(B, B)`."""
    run_effects: FloatArray
    """Whitened signatures of zero and factors times their prior standard deviations, `(B, 1 + V)` or `(B, V)`."""
    directions: FloatArray
    shrinkage: FloatArray
    """`directions`, `shrinkage`: orthonormal directions of `run_effects`, `(B, k)`, and by how much residuals along
    them shrink.
    """

    @classmethod
    def of(cls, noise_root: FloatArray, signatures: FloatArray) -> "Whitening":
        """Whiten with a noise factor and the signatures of the run's effects, shape `(B, k)`."""
        run_effects = solve_lower(noise_root, signatures)
        directions, sizes, _ = np.linalg.svd(run_effects, full_matrices=False)
        return cls(noise_root, run_effects, np.asarray(directions), 1 - 1 / np.sqrt(1 + sizes**2))

    def whiten_noise(self, values: FloatArray) -> FloatArray:
        """Whiten against noise alone, `(B,)` or `(B, m)`."""
        return solve_lower(self.noise_root, values)

    def whiten(self, values: FloatArray) -> FloatArray:
        """Whiten against the whole covariance, `(B,)` or `(B, m)`."""
        whitened = self.whiten_noise(values)
        along = self.directions.T @ whitened
        return np.asarray(whitened - self.directions @ (self.shrinkage * along.T).T)

    def gram(self, values: FloatArray) -> FloatArray:
        """Return the products of whitened columns with each other, shape `(B, m)` to `(m, m)`."""
        total = np.zeros((values.shape[1],) * 2)
        self.add_gram(total, values)
        return total

    def add_gram(self, total: FloatArray, values: FloatArray) -> None:
        """Add these products; a column of zeros, as of an effect that does not act in the run, takes no time."""
        acting = np.flatnonzero(values.any(axis=0))
        white = self.whiten(values[:, acting])
        total[np.ix_(acting, acting)] += white.T @ white

    def with_form_error(self, sd: FloatArray) -> "Whitening":
        """Add an independent error to each block mean, one standard deviation, shape `(B,)`."""
        return Whitening.of(_noise_root(self.noise_root @ self.noise_root.T, sd), self.noise_root @ self.run_effects)

    def posterior_run_effects(
        self, residual: FloatArray, slopes: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the run's zero and factors in prior standard deviations, and their covariance.

        Parameters
        ----------
        residual
            Measured minus predicted block means, shape `(B,)`.
        slopes, covariance
            Derivatives of the prediction by the parameters, shape `(B, P)`, and the parameters' covariance, whose
            uncertainty is passed on to the run's own values.
        """
        precision = np.eye(self.run_effects.shape[1]) + self.run_effects.T @ self.run_effects
        projected = self.run_effects.T @ self.whiten_noise(np.column_stack((residual, slopes)))
        solved = np.asarray(np.linalg.solve(precision, projected), dtype=np.float64)
        by_parameters = solved[:, 1:]
        total = np.linalg.inv(precision) + by_parameters @ covariance @ by_parameters.T
        return solved[:, 0], np.asarray(total, dtype=np.float64)


def _noise_root(covariance: FloatArray, uncertainty: FloatArray) -> FloatArray:
    from scipy.linalg import cholesky

    covariance[np.diag_indices_from(covariance)] += uncertainty**2
    return np.asarray(cholesky(covariance, lower=True, overwrite_a=True))


@dataclass(frozen=True, eq=False)
class JointProblem:
    """All inputs of a joint fit, prepared.

    The computation of a channel is the very same object for all channels that are equivalent.
    """

    nominal: NominalModel
    scales: PriorScales
    channels: tuple[ChannelBlocks, ...]
    noises: tuple[NoiseModel, ...]
    zero_sds: tuple[float, ...]
    variation_sds: FloatArray

    @classmethod
    def of(cls, selection: RunSelection, nominal: NominalModel, longest_mm: float = np.inf) -> "JointProblem":
        """Prepare all runs, in blocks no longer than `longest_mm` of travel.

        Raises `AnalysisError` where the model predicts nothing of any of them.
        """
        experiments = selection.experiments
        channels = tuple(prepare_channels(experiments, nominal, longest_mm))
        if not channels:
            kinds = ", ".join(sorted({experiment.kind for experiment in experiments}))
            recorded = ", ".join(sorted({name for experiment in experiments for name in experiment.run.trace.channels}))
            raise AnalysisError(
                f"the model {nominal.name} predicts nothing of these runs ({kinds}), which recorded {recorded}; name "
                "another model with --nominal."
            )
        names = dict.fromkeys(blocks.channel for blocks in channels)
        noises = {
            name: estimate_noise(experiments, name, repeats=repeat_differences(channels, name, nominal))
            for name in names
        }
        added = {name: added_white_in_motion(experiments, name) for name in names}
        channels = tuple(replace(blocks, moving_white=added[blocks.channel]) for blocks in channels)
        zero_sds = {name: _zero_sd(channels, name, nominal) for name in names}
        return cls(
            nominal,
            PriorScales.of(nominal.parameters),
            channels,
            tuple(noises[blocks.channel] for blocks in channels),
            tuple(zero_sds[blocks.channel] for blocks in channels),
            np.array([variation.sd for variation in nominal.variations], dtype=np.float64),
        )

    @cached_property
    def representatives(self) -> tuple[int, ...]:
        """For each channel the first that is equivalent: the same is predicted, under the same noise."""
        first: dict[Hashable, int] = {}
        return tuple(
            first.setdefault((blocks.equivalence_key, noise, zero_sd), number)
            for number, (blocks, noise, zero_sd) in enumerate(
                zip(self.channels, self.noises, self.zero_sds, strict=True)
            )
        )

    def _once(self, compute: Callable[[int], ItemT]) -> list[ItemT]:
        """Compute something for each channel by its number, once for equivalent ones."""
        computed = {number: compute(number) for number in sorted(set(self.representatives))}
        return [computed[number] for number in self.representatives]

    @cached_property
    def _noise_covariances(self) -> list[FloatArray]:
        """Covariance of the noise of each channel's block means, shape `(B, B)`."""

        def covariance(number: int) -> FloatArray:
            blocks = self.channels[number].blocks
            return self.noises[number].covariance(blocks.start_s, blocks.end_s, blocks.samples)

        return self._once(covariance)

    def predictions(self, z: FloatArray) -> list[Prediction]:
        """Predict the block means of each channel.

        Raises `AnalysisError`, as `uncertainties` and `derivatives` do, where the model gives no finite number.
        """
        values = self.scales.values(z)
        predictions = self._once(lambda number: self.channels[number].predict(values))
        self._require_finite([(prediction.total, prediction.varying) for prediction in predictions])
        return predictions

    def uncertainties(self, z: FloatArray) -> list[FloatArray]:
        """Return how well block means can be predicted, one standard deviation."""
        values = self.scales.values(z)
        uncertainties = self._once(lambda number: self.channels[number].uncertainty(values))
        self._require_finite([(uncertainty,) for uncertainty in uncertainties])
        return uncertainties

    def derivatives(self, z: FloatArray, without: Collection[str] = ()) -> list[FloatArray]:
        """Return the derivatives of block means by `z`, shape `(B, P)` for each channel.

        Columns of the parameters in `without` are not computed.
        """
        values = self.scales.values(z)
        slopes = self.scales.slopes(values)
        derivatives = self._once(
            lambda number: (self.channels[number].sensitivities(values, without) * slopes[:, None]).T
        )
        self._require_finite([(derivative,) for derivative in derivatives])
        return derivatives

    def whitenings(
        self,
        predictions: Sequence[Prediction],
        uncertainties: Sequence[FloatArray],
        near: Sequence[Whitening] | None = None,
    ) -> tuple[Whitening, ...]:
        """Linearise every run's covariance around its prediction.

        `near` are the whitenings with the same uncertainties around another prediction, whose noise factors are reused.
        """

        def whitening(number: int) -> Whitening:
            if near is None:
                root = _noise_root(self._noise_covariances[number].copy(), uncertainties[number])
            else:
                root = near[number].noise_root
            varying = predictions[number].varying
            return Whitening.of(root, self._run_signatures(number, varying))

        return tuple(self._once(whitening))

    def with_varying_force(
        self, number: int, predicted: Prediction, variation: str, force: FloatArray, near: Whitening
    ) -> Whitening:
        """Linearise a run's covariance again where a force is added that varies from run to run.

        Parameters
        ----------
        variation
            Name of the run's own factor that multiplies the force.
        force
            Block means of that force, shape `(B,)`.
        near
            The whitening without it.
        """
        multiplied = np.array([factor.name == variation for factor in self.nominal.variations])
        varying = predicted.varying + np.outer(multiplied, force)
        return Whitening.of(near.noise_root, self._run_signatures(number, varying))

    def _run_signatures(self, number: int, varying: FloatArray) -> FloatArray:
        """Signatures of a run's own deviations, times their prior sd: zero, factors, and a line in motion."""
        zero = np.full((varying.shape[1], int(self.zero_sds[number] > 0)), self.zero_sds[number])
        factors = (varying * self.variation_sds[:, None]).T
        return np.column_stack((zero, factors, self.channels[number].line_signatures))

    def _require_finite(self, arrays: Sequence[tuple[FloatArray, ...]]) -> None:
        for blocks, channel_arrays in zip(self.channels, arrays, strict=True):
            if not all(np.isfinite(values).all() for values in channel_arrays):
                raise AnalysisError(
                    f"the model {self.nominal.name} gives NaN or infinity for {blocks.channel} of "
                    f"{blocks.experiment.file} at values within the fit's bounds; give its parameters narrower priors, "
                    "or correct the model."
                )


MIN_REPEAT_BLOCK_S, MIN_REPEAT_BLOCKS = 0.02, 20
"""Shorter blocks follow an event, whose instant differs by a part of a sample between repeats."""
MIN_SIGNATURE_SHARE = 1e-6
"""Smaller singular values of the signatures of zero and factors are of columns that depend on each other."""


def repeat_differences(
    channels: Sequence[ChannelBlocks], channel: str, nominal: NominalModel
) -> tuple[RepeatDifference, ...]:
    """Return the differences of successive repeats of a sliding run.

    Repeats of a specimen that sticks are left out: it is strained again before it has recovered.
    """
    values = np.array([parameter.nominal for parameter in nominal.parameters])
    latest: dict[Hashable, ChannelBlocks] = {}
    differences = []
    for blocks in channels:
        if blocks.channel != channel or blocks.experiment.contact is Contact.STICKING:
            continue
        before, latest[blocks.equivalence_key] = latest.get(blocks.equivalence_key), blocks
        if before is None:
            continue
        layout = blocks.blocks
        long = layout.end_s - layout.start_s >= MIN_REPEAT_BLOCK_S
        if np.count_nonzero(long) >= MIN_REPEAT_BLOCKS:
            signatures = np.vstack((np.ones(long.size), blocks.predict(values).varying))[:, long].T
            directions, sizes, _ = np.linalg.svd(signatures, full_matrices=False)
            differences.append(
                RepeatDifference(
                    layout.start_s[long],
                    layout.end_s[long],
                    layout.samples[long],
                    layout.mean[long] - before.blocks.mean[long],
                    np.asarray(directions[:, sizes > MIN_SIGNATURE_SHARE * sizes[0]]),
                )
            )
    return tuple(differences)


def _zero_sd(channels: Sequence[ChannelBlocks], channel: str, nominal: NominalModel) -> float:
    """Prior of a channel's zero by the model, widened where the first samples of its runs lie further off."""
    prior_sd = float(nominal.zero_sd.get(channel, 0.0))
    if prior_sd == 0.0:
        return 0.0
    values = np.array([parameter.nominal for parameter in nominal.parameters])
    offsets = [
        float(blocks.blocks.mean[0] - blocks.predict(values).total[0])
        for blocks in channels
        if blocks.channel == channel
    ]
    return max(prior_sd, ZERO_WIDENING * float(np.median(np.abs(offsets))))


MIN_TOLD_WIDENING = 1.5
"""A prior of a zero that is widened by less is not told."""


def zero_remarks(problem: JointProblem) -> Iterator[str]:
    """Yield where runs begin further off than the model's zero allows, so that its prior was widened."""
    taken = {blocks.channel: sd for blocks, sd in zip(problem.channels, problem.zero_sds, strict=True)}
    for channel, sd in taken.items():
        stated = float(problem.nominal.zero_sd.get(channel, 0.0))
        if sd > MIN_TOLD_WIDENING * stated:
            yield (
                f"the first samples of {channel.replace('_', ' ')} lie further from the prediction than a zero known "
                f"to {stated:.3g} mN (zero_sd_mN) allows: the zero was taken as known to {sd:.3g} mN"
            )


@dataclass(frozen=True, slots=True, eq=False)
class JointSolution:
    """The most probable parameters."""

    z: FloatArray
    """Parameters in units of their priors, shape `(P,)`."""
    covariance: FloatArray
    """Of `z` given the runs, shape `(P, P)`."""
    whitenings: tuple[Whitening, ...]
    slopes: tuple[FloatArray, ...]
    """`whitenings`, `slopes`: for each channel: its whitening, and the derivatives of its block means by `z`, shape
    `(B, P)`.
    """
    misfit: float
    """χ² per block where it exceeds what noise explains, else 1; the runs' weight was divided by it, so that the priors
    keep theirs.
    """
    converged: bool
    """Whether optimiser and passes did; `why` says why not."""
    steps: int
    """Evaluations of the derivatives."""
    why: str = ""


class _ModelCache:
    """The model's latest predictions and derivatives, shared by passes and steps of one `solve_joint`."""

    def __init__(self, problem: JointProblem) -> None:
        self._problem = problem
        self._latest: dict[str, tuple[FloatArray, object]] = {}
        self.steps = 0

    def _reuse(self, compute: Callable[[FloatArray], ItemT], z: FloatArray, reach: float) -> ItemT:
        """Evaluate a method of the problem at `z`, unless no parameter moved by more than `reach` since it last was."""
        name = compute.__name__
        at, result = self._latest.get(name, (None, None))
        scale = np.minimum(self._problem.scales.sd, 1.0)
        if at is None or np.max(np.abs(z - at) * scale) > reach:
            result = compute(z)
            self._latest[name] = z.copy(), result
            self.steps += int(name == "derivatives")
        return cast("ItemT", result)

    def residuals(self, z: FloatArray) -> list[FloatArray]:
        predictions = self._reuse(self._problem.predictions, z, 0.0)
        pairs = zip(self._problem.channels, predictions, strict=True)
        return [prediction.total - blocks.blocks.mean for blocks, prediction in pairs]

    def derivatives(self, z: FloatArray, reach: float = DERIVATIVE_REUSE_RANGE) -> list[FloatArray]:
        return self._reuse(self._problem.derivatives, z, reach)

    def whitenings(self, z: FloatArray) -> tuple[Whitening, ...]:
        uncertainties = self._reuse(self._problem.uncertainties, z, DERIVATIVE_REUSE_RANGE)
        return self._problem.whitenings(self._reuse(self._problem.predictions, z, 0.0), uncertainties)


def is_at_bound(z: FloatArray) -> BoolArray:
    """Which parameters are at the bound of the fit."""
    return np.asarray(np.abs(z) >= PARAMETER_BOUND - 1e-3)


@dataclass(frozen=True, slots=True, eq=False)
class _LeastSquaresPass:
    """Least squares under one covariance: whitened residuals of runs and priors, and their derivatives by `z`."""

    cache: _ModelCache
    whitenings: tuple[Whitening, ...]
    misfit: float

    def residuals(self, z: FloatArray) -> FloatArray:
        return np.concatenate((self._weighted(self.cache.residuals(z)), z))

    def jacobian(self, z: FloatArray) -> FloatArray:
        return np.concatenate((self._weighted(self.cache.derivatives(z)), np.eye(len(z))))

    def chi2(self, z: FloatArray) -> float:
        residuals = self.residuals(z)
        return float(residuals @ residuals)

    def newton_step(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Step to the minimum of the linearised problem within the bounds, and the covariance there."""
        jacobian = self.jacobian(z)
        gradient, curvature = jacobian.T @ self.residuals(z), jacobian.T @ jacobian
        free = ~is_at_bound(z) | (z * gradient > 0)
        step = np.zeros_like(z)
        step[free] = -np.linalg.solve(curvature[np.ix_(free, free)], gradient[free])
        return step, np.asarray(np.linalg.inv(curvature), dtype=np.float64)

    def line_search(self, z: FloatArray, step: FloatArray, *, lowest: bool = False) -> FloatArray | None:
        """Longest fraction of a step that lowers χ², or the one that lowers it most."""
        chi2 = self.chi2(z)
        places = [np.clip(z + share * step, -PARAMETER_BOUND, PARAMETER_BOUND) for share in LINE_SEARCH_FRACTIONS]
        if lowest:
            values = [self.chi2(place) for place in places]
            return places[int(np.argmin(values))] if min(values) < chi2 else None
        return next((place for place in places if self.chi2(place) < chi2), None)

    def _weighted(self, by_channel: Sequence[FloatArray]) -> FloatArray:
        return _whiten_all(self.whitenings, by_channel) / sqrt(self.misfit)


def solve_joint(problem: JointProblem) -> JointSolution:
    """Find the most probable parameters."""
    from scipy.optimize import least_squares

    cache = _ModelCache(problem)
    z, misfit, why = np.zeros(len(problem.scales.nominal)), np.inf, ""
    last_move = np.zeros_like(z)
    for number in range(MAX_PASSES):
        before = misfit
        if number < COVARIANCE_UPDATES:
            whitenings = cache.whitenings(z)
            # Far from the truth the runs would outweigh the priors and mislead: they gain weight as the misfit falls.
            whitened = _whiten_all(whitenings, cache.residuals(z))
            share = float(whitened @ whitened) / max(len(whitened), 1)
            misfit = share if share > MISFIT_THRESHOLD else 1.0
        else:
            cache.derivatives(z, 0.0)
        present = _LeastSquaresPass(cache, whitenings, misfit)
        step, covariance = present.newton_step(z)
        moves = step / np.sqrt(np.diag(covariance))
        largest = int(np.abs(moves).argmax())
        move = float(np.abs(moves[largest]))
        if move < CONVERGED_MOVE and abs(misfit / before - 1) < CONVERGED_MOVE:
            z, why = z + step, ""
            break
        if number >= COVARIANCE_UPDATES and move < NEWTON_RANGE:
            # Steps to and fro across a minimum are too long, as in the logarithm of a mass beside a large misfit.
            to_and_fro = bool(moves[largest] * last_move[largest] < 0)
            last_move = moves
            lower = present.line_search(z, step, lowest=to_and_fro)
            if lower is None:
                why = ""
                break
            step = lower - z
        why = f"after {number + 1} passes a parameter still moves by {move:.2g} of its error"
        if move < NEWTON_RANGE:
            z = np.clip(z + step, -PARAMETER_BOUND, PARAMETER_BOUND)
            continue
        fit = least_squares(
            present.residuals,
            z,
            present.jacobian,
            bounds=(-PARAMETER_BOUND, PARAMETER_BOUND),
            max_nfev=MAX_EVALUATIONS if number else FIRST_PASS_EVALUATIONS,
            ftol=1e-7,
            xtol=2e-3,
            gtol=1e-6,
        )
        z = fit.x
    slopes = tuple(cache.derivatives(z))
    return JointSolution(z, covariance, whitenings, slopes, misfit, converged=not why, steps=cache.steps, why=why)


def _whiten_all(whitenings: Sequence[Whitening], by_channel: Sequence[FloatArray]) -> FloatArray:
    pairs = zip(whitenings, by_channel, strict=True)
    return np.concatenate([whitening.whiten(values) for whitening, values in pairs])
