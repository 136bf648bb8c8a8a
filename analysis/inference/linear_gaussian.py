"""Parameters of a nominal model from many runs: block means, Gaussian noise and priors, linearised and iterated.

The runs' own zeros and factors are Gaussian and enter linearly, so that they are integrated out: they are part of
each run's covariance. That covariance is linearised around the present prediction and held while the parameters are
fitted, then linearised again, until nothing moves; so a weaker model cannot buy itself a smaller error.
"""

from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from math import sqrt
from typing import TypeVar

import numpy as np

from dragrig.analysis.inference.blocks import BlockMeans, average_in_blocks
from dragrig.analysis.inference.noise import NoiseModel, estimate_noise
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.models.nominal_model import NominalModel, Parameter, Prediction, Predictor
from dragrig.analysis.selection import RunSelection
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class PriorScales:
    """The way from `z`, standard normal beforehand, to values: `nominal + sd z`, or `nominal · exp(sd z)`."""

    nominal: FloatArray
    sd: FloatArray
    positive: BoolArray

    @classmethod
    def of(cls, parameters: Sequence[Parameter]) -> "PriorScales":
        """Take nominal values and priors."""
        positive = np.array([one.positive for one in parameters])
        sd = np.array([one.prior_sd for one in parameters], dtype=np.float64)
        width = np.where(positive, np.sqrt(np.log1p(sd**2)), sd)
        return cls(np.array([one.nominal for one in parameters], dtype=np.float64), width, positive)

    def values(self, z: FloatArray) -> FloatArray:
        """Return the values at `z`, shape `(P,)`."""
        with np.errstate(over="ignore"):
            grown = self.nominal * np.exp(np.where(self.positive, self.sd * z, 0.0))
        return np.asarray(np.where(self.positive, grown, self.nominal + self.sd * z))

    def slopes(self, values: FloatArray) -> FloatArray:
        """Return dvalue/dz, shape `(P,)`."""
        return np.asarray(np.where(self.positive, values * self.sd, self.sd))


@dataclass(frozen=True, slots=True, eq=False)
class ChannelBlocks:
    """One channel of one run: `B` blocks, and the model prepared for it."""

    experiment: Experiment
    channel: str
    predictor: Predictor
    blocks: BlockMeans

    @property
    def likeness(self) -> Hashable:
        """What is equal where the same is predicted of the same blocks, whatever was measured in them."""
        blocks = self.blocks
        layout = (blocks.start_s, blocks.end_s, blocks.samples, blocks.nodes_s)
        return self.channel, self.predictor.likeness, tuple(one.tobytes() for one in layout)

    def predict(self, values: FloatArray) -> Prediction:
        """Predict the means of the blocks."""
        found = self.predictor.predict(values, self.blocks.nodes_s)
        return Prediction(self.blocks.of(found.total), self.blocks.of(found.varying))

    def uncertainty(self, values: FloatArray) -> FloatArray:
        """Return how well they can be predicted, one standard deviation."""
        found = self.predictor.uncertainty(values, self.blocks.nodes_s)
        return np.asarray(np.sqrt(self.blocks.of(found**2)))

    def sensitivities(self, values: FloatArray, without: Collection[str] = ()) -> FloatArray:
        """Return their derivatives, shape `(P, B)`; those by the parameters that are left out mean nothing."""
        return self.blocks.of(self.predictor.sensitivities_without(without, values, self.blocks.nodes_s))


@dataclass(frozen=True, slots=True, eq=False)
class Whitening:
    """What makes a run's residuals independent and of unit variance when the model holds.

    The covariance holds noise, what the measured motion leaves uncertain, and the priors of the run's own zero and
    factors.

    Attributes
    ----------
    noise_root
        Lower Cholesky factor of the covariance of noise and of what the motion leaves uncertain, `(B, B)`.
    own
        Zero and factors as whitened signatures times their prior standard deviations, `(B, 1 + V)` or `(B, V)`.
    left, shrinkage
        Directions of `own`, `(B, k)`, and by how much residuals along them shrink.
    """

    noise_root: FloatArray
    own: FloatArray
    left: FloatArray
    shrinkage: FloatArray

    def of_noise(self, values: FloatArray) -> FloatArray:
        """Whiten against noise alone, `(B,)` or `(B, m)`."""
        from scipy.linalg import solve_triangular

        return np.asarray(solve_triangular(self.noise_root, values, lower=True))

    def whole(self, values: FloatArray) -> FloatArray:
        """Whiten against everything, `(B,)` or `(B, m)`."""
        plain = self.of_noise(values)
        along = self.left.T @ plain
        scale = self.shrinkage if along.ndim == 1 else self.shrinkage[:, None]
        return np.asarray(plain - self.left @ (scale * along))

    def doubting(self, sd: FloatArray) -> "Whitening":
        """Return what whitens where each block is uncertain by so much more, one standard deviation, shape `(B,)`."""
        root = _noise_root(self.noise_root @ self.noise_root.T, sd)
        return _whitening_of(root, self.noise_root @ self.own)

    def own_of(self, residual: FloatArray, slopes: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the run's zero and factors in prior standard deviations, and their covariance.

        Parameters
        ----------
        residual
            Measured minus predicted block means, shape `(B,)`.
        slopes, covariance
            Derivatives of the prediction by the parameters, shape `(B, P)`, and the parameters' covariance: what is
            not known of them is not known of a run's own values either.
        """
        precision = np.eye(self.own.shape[1]) + self.own.T @ self.own
        whitened = self.own.T @ self.of_noise(np.column_stack((residual, slopes)))
        along = np.asarray(np.linalg.solve(precision, whitened), dtype=np.float64)
        found, by_parameters = along[:, 0], along[:, 1:]
        whole = np.linalg.inv(precision) + by_parameters @ covariance @ by_parameters.T
        return found, np.asarray(whole, dtype=np.float64)


def prepare_channels(
    experiments: Sequence[Experiment], nominal: NominalModel, longest_mm: float = np.inf
) -> Iterator[ChannelBlocks]:
    """Prepare every channel of every run that the model predicts, in blocks no longer than so many mm.

    Raises `AnalysisError` as the model's `prepare`.
    """
    for experiment in experiments:
        for channel, predictor in nominal.prepare(experiment).items():
            blocks = average_in_blocks(experiment, channel, predictor.events_s, jumps=True, longest_mm=longest_mm)
            yield ChannelBlocks(experiment, channel, predictor, blocks)


def run_whitening(
    noise: Callable[[], FloatArray],
    prediction: Prediction,
    uncertainty: FloatArray,
    zero_sd: float,
    sds: FloatArray,
    near: Whitening | None = None,
) -> Whitening:
    """Lay out the covariance of a run around a prediction.

    Parameters
    ----------
    noise
        Gives the covariance of the noise of the block means, shape `(B, B)`, where it is needed.
    prediction, uncertainty
        What the run's blocks should be, and how well that can be said of each, one standard deviation, shape `(B,)`.
    zero_sd
        Standard deviation of the run's zero; 0 for a channel that has none.
    sds
        Standard deviations of the model's variations, shape `(V,)`.
    near
        One with the same noise and uncertainty, whose factor is taken over.
    """
    root = _noise_root(noise(), uncertainty) if near is None else near.noise_root
    columns = prediction.varying * sds[:, None]
    if zero_sd > 0:
        columns = np.vstack((np.full((1, len(root)), zero_sd), columns))
    return _whitening_of(root, columns.T)


def _whitening_of(root: FloatArray, columns: FloatArray) -> Whitening:
    """Lay out a run's covariance from its factor and from what its zero and factors change, shape `(B, k)`."""
    from scipy.linalg import solve_triangular

    own = np.asarray(solve_triangular(root, columns, lower=True))
    left, sizes, _ = np.linalg.svd(own, full_matrices=False)
    return Whitening(root, own, np.asarray(left), 1 - 1 / np.sqrt(1 + sizes**2))


def _noise_root(covariance: FloatArray, uncertainty: FloatArray) -> FloatArray:
    from scipy.linalg import cholesky

    covariance[np.diag_indices_from(covariance)] += uncertainty**2
    return np.asarray(cholesky(covariance, lower=True, overwrite_a=True))


Found = TypeVar("Found")
STIFFNESS_VARIATION = "stiffness"
"""The variation of what is stiffness."""
ZERO_WIDENING = 2.0
"""A zero's standard deviation is at least this times the median distance from 0 that is seen."""


@dataclass(frozen=True, eq=False)
class JointProblem:
    """Everything that a joint fit is made of, prepared.

    What is computed of one piece of evidence is the very same object for all that are alike.
    """

    nominal: NominalModel
    scales: PriorScales
    evidence: tuple[ChannelBlocks, ...]
    noises: tuple[NoiseModel, ...]
    zero_sds: tuple[float, ...]
    sds: FloatArray

    @classmethod
    def of(cls, selection: RunSelection, nominal: NominalModel, longest_mm: float = np.inf) -> "JointProblem":
        """Prepare all runs, in blocks no longer than so many mm of the way.

        Raises `AnalysisError` where the model predicts nothing of any of them.
        """
        evidence = tuple(prepare_channels(selection.experiments, nominal, longest_mm))
        if not evidence:
            kinds = ", ".join(sorted({one.kind for one in selection.experiments}))
            recorded = ", ".join(sorted({name for one in selection.experiments for name in one.run.trace.channels}))
            raise AnalysisError(
                f"the model {nominal.name} predicts nothing of these runs ({kinds}), which recorded {recorded}; name "
                "another model with --nominal."
            )
        channels = dict.fromkeys(one.channel for one in evidence)
        noises = {name: estimate_noise(selection.experiments, name) for name in channels}
        zeros = {name: _zero_sd(evidence, name, nominal) for name in channels}
        return cls(
            nominal,
            PriorScales.of(nominal.parameters),
            evidence,
            tuple(noises[one.channel] for one in evidence),
            tuple(zeros[one.channel] for one in evidence),
            np.array([one.sd for one in nominal.variations], dtype=np.float64),
        )

    @cached_property
    def alike(self) -> tuple[int, ...]:
        """For each piece of evidence the first of which the same is predicted, under the same noise."""
        first: dict[Hashable, int] = {}
        pieces = enumerate(zip(self.evidence, self.noises, self.zero_sds, strict=True))
        return tuple(first.setdefault((one.likeness, noise, zero), number) for number, (one, noise, zero) in pieces)

    def _once(self, found: Callable[[int], Found]) -> list[Found]:
        """Return something of each piece of evidence by its number, computed once for those that are alike."""
        known = {number: found(number) for number in sorted(set(self.alike))}
        return [known[number] for number in self.alike]

    def predictions(self, z: FloatArray) -> list[Prediction]:
        """Return the predicted block means, one for each piece of evidence.

        Raises `AnalysisError`, as `uncertainties` and `derivatives` do, where the model gives no finite number.
        """
        values = self.scales.values(z)
        found = self._once(lambda number: self.evidence[number].predict(values))
        for one, predicted in zip(self.evidence, found, strict=True):
            self._require_numbers(one, predicted.total, predicted.varying)
        return found

    def uncertainties(self, z: FloatArray) -> list[FloatArray]:
        """Return how well block means can be predicted, one standard deviation."""
        values = self.scales.values(z)
        found = self._once(lambda number: self.evidence[number].uncertainty(values))
        for one, uncertainty in zip(self.evidence, found, strict=True):
            self._require_numbers(one, uncertainty)
        return found

    def whitenings(
        self,
        predictions: Sequence[Prediction],
        uncertainties: Sequence[FloatArray],
        near: Sequence[Whitening] | None = None,
    ) -> tuple[Whitening, ...]:
        """Lay out every run's covariance around what is predicted.

        `near` are those of the same uncertainties around another prediction, where there are any.
        """

        def one(number: int) -> Whitening:
            noise = partial(_noise_covariance, self.evidence[number], self.noises[number])
            before = None if near is None else near[number]
            predicted, uncertainty = predictions[number], uncertainties[number]
            return run_whitening(noise, predicted, uncertainty, self.zero_sds[number], self.sds, before)

        return tuple(self._once(one))

    def stiffened(self, number: int, predicted: Prediction, more: FloatArray, near: Whitening) -> Whitening:
        """Lay out a run's covariance anew where a part of its force that is not predicted is stiffness too.

        Parameters
        ----------
        more
            That part of its block means, shape `(B,)`.
        near
            Its covariance without.
        """
        stiff = np.array([one.name == STIFFNESS_VARIATION for one in self.nominal.variations])
        varying = predicted.varying + np.outer(stiff, more)
        stiffer = Prediction(predicted.total, varying)
        return run_whitening(lambda: near.noise_root, stiffer, more, self.zero_sds[number], self.sds, near)

    def derivatives(self, z: FloatArray, without: Collection[str] = ()) -> list[FloatArray]:
        """Return the derivatives of block means by `z`, shape `(B, P)` for each piece of evidence.

        Those by parameters that are left `without` mean nothing.
        """
        values = self.scales.values(z)
        slopes = self.scales.slopes(values)
        found = self._once(lambda number: (self.evidence[number].sensitivities(values, without) * slopes[:, None]).T)
        for one, derivatives in zip(self.evidence, found, strict=True):
            self._require_numbers(one, derivatives)
        return found

    def _require_numbers(self, one: ChannelBlocks, *predicted: FloatArray) -> None:
        if not all(np.isfinite(values).all() for values in predicted):
            raise AnalysisError(
                f"the model {self.nominal.name} gives NaN or infinity for {one.channel} of {one.experiment.file} at "
                "values that the fit came to; give its parameters narrower priors, or mend the model."
            )


def _noise_covariance(one: ChannelBlocks, noise: NoiseModel) -> FloatArray:
    return noise.covariance(one.blocks.start_s, one.blocks.end_s, one.blocks.samples)


def _zero_sd(evidence: Sequence[ChannelBlocks], channel: str, nominal: NominalModel) -> float:
    """Return what the model says of a channel's zero, or more where the first samples of its runs lie further off."""
    usual = float(nominal.zero_sd.get(channel, 0.0))
    if usual == 0.0:
        return 0.0
    values = np.array([one.nominal for one in nominal.parameters])
    found = [float(one.blocks.mean[0] - one.predict(values).total[0]) for one in evidence if one.channel == channel]
    return max(usual, ZERO_WIDENING * float(np.median(np.abs(found))))


MAX_PASSES = 12
CONVERGED_MOVE = 0.05
"""A pass that moves no parameter by more than this, in units of its error, is the last."""
COVARIANCE_UPDATES = 4
"""So many passes lay the covariance out anew; a model that does not hold may go on for ever otherwise."""
NEWTON_RANGE = 3.0
"""Less than this of its error from the minimum, the linearised problem is the problem."""
LINE_SEARCH_FRACTIONS = (1.0, 0.5, 0.25, 0.1)
"""Shares of a step of which none makes the squares smaller where it is the last: they jump where a bend of the motion
comes to the equator within a block, and a minimum at such a jump has no slope of 0 to be told by."""
FIRST_PASS_EVALUATIONS, MAX_EVALUATIONS = 2, 8
"""Evaluations within a pass."""
PARAMETER_BOUND = 6.0
"""How far from what was known beforehand a parameter may go, in standard deviations of the prior."""
DERIVATIVE_REUSE_RANGE = 0.05
"""Derivatives are taken anew where a parameter has moved by more than this: its value's share, or prior widths."""
MISFIT_THRESHOLD = 1.1
"""Squares per degree of freedom above which the model is taken to leave more than noise."""


@dataclass(frozen=True, slots=True, eq=False)
class JointSolution:
    """Where the fit came to.

    Attributes
    ----------
    z
        Parameters in units of their priors, shape `(P,)`.
    covariance
        Of `z` given the runs, shape `(P, P)`.
    whitenings, slopes
        For each piece of evidence: what whitens it, and the derivatives of its block means by `z`, shape `(B, P)`.
    misfit
        By how much the runs' squares exceed what noise explains; the runs were given less weight by as much, so that
        what is known beforehand keeps its own. 1 where the model holds.
    converged
        Whether the optimiser and the passes did; `why` says why not.
    steps
        How often derivatives were taken.
    """

    z: FloatArray
    covariance: FloatArray
    whitenings: tuple[Whitening, ...]
    slopes: tuple[FloatArray, ...]
    misfit: float
    converged: bool
    steps: int
    why: str = ""


class _ModelCache:
    """The model's latest predictions and derivatives, which passes and steps share. Belongs to one `solve_joint`."""

    def __init__(self, problem: JointProblem) -> None:
        self._problem = problem
        self._predicted_at: FloatArray | None = None
        self._predictions: list[Prediction] = []
        self._derivatives_at: FloatArray | None = None
        self._derivatives: list[FloatArray] = []
        self._uncertain_at: FloatArray | None = None
        self._uncertainties: list[FloatArray] = []
        self.steps = 0

    def predictions(self, z: FloatArray) -> list[Prediction]:
        if self._predicted_at is None or not np.array_equal(z, self._predicted_at):
            self._predictions, self._predicted_at = self._problem.predictions(z), z.copy()
        return self._predictions

    def residuals(self, z: FloatArray) -> list[FloatArray]:
        pairs = zip(self._problem.evidence, self.predictions(z), strict=True)
        return [predicted.total - one.blocks.mean for one, predicted in pairs]

    def derivatives(self, z: FloatArray) -> list[FloatArray]:
        if self._derivatives_at is None or self._is_far(z, self._derivatives_at):
            self._derivatives, self._derivatives_at = self._problem.derivatives(z), z.copy()
            self.steps += 1
        return self._derivatives

    def whitenings(self, z: FloatArray) -> tuple[Whitening, ...]:
        if self._uncertain_at is None or self._is_far(z, self._uncertain_at):
            self._uncertainties, self._uncertain_at = self._problem.uncertainties(z), z.copy()
        return self._problem.whitenings(self.predictions(z), self._uncertainties)

    def renew(self, z: FloatArray) -> None:
        """Take the derivatives right here."""
        if self._derivatives_at is None or not np.array_equal(z, self._derivatives_at):
            self._derivatives_at = None
            self.derivatives(z)

    def _is_far(self, z: FloatArray, from_z: FloatArray) -> bool:
        return bool(np.max(np.abs(z - from_z) * np.minimum(self._problem.scales.sd, 1.0)) > DERIVATIVE_REUSE_RANGE)


def is_at_bound(z: FloatArray) -> BoolArray:
    """Tell which parameters are as far from what was known beforehand as they may go."""
    return np.asarray(np.abs(z) >= PARAMETER_BOUND - 1e-3)


@dataclass(frozen=True, slots=True, eq=False)
class _LeastSquaresPass:
    """Least squares under one covariance: residuals of the runs and of the priors, and their derivatives by `z`."""

    evaluations: _ModelCache
    whitenings: tuple[Whitening, ...]
    misfit: float

    def residuals(self, z: FloatArray) -> FloatArray:
        return np.concatenate((self._weighted(self.evaluations.residuals(z)), z))

    def squares(self, z: FloatArray) -> float:
        residuals = self.residuals(z)
        return float(residuals @ residuals)

    def jacobian(self, z: FloatArray) -> FloatArray:
        return np.concatenate((self._weighted(self.evaluations.derivatives(z)), np.eye(len(z))))

    def newton(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the step to the minimum of the linearised problem within the bounds, and the covariance there."""
        slopes = self.jacobian(z)
        gradient, curvature = slopes.T @ self.residuals(z), slopes.T @ slopes
        free = ~is_at_bound(z) | (z * gradient > 0)
        step = np.zeros_like(z)
        step[free] = -np.linalg.solve(curvature[np.ix_(free, free)], gradient[free])
        return step, np.asarray(np.linalg.inv(curvature), dtype=np.float64)

    def lower(self, z: FloatArray, step: FloatArray) -> FloatArray | None:
        """Return the furthest place along a step, of some, where the squares are lower than at `z`."""
        here = self.squares(z)
        places = (np.clip(z + share * step, -PARAMETER_BOUND, PARAMETER_BOUND) for share in LINE_SEARCH_FRACTIONS)
        return next((place for place in places if self.squares(place) < here), None)

    def _weighted(self, each: Sequence[FloatArray]) -> FloatArray:
        return _whiten_all(self.whitenings, each) / sqrt(self.misfit)


def solve_joint(problem: JointProblem) -> JointSolution:
    """Find the most probable parameters."""
    from scipy.optimize import least_squares

    found = _ModelCache(problem)
    z, misfit, why = np.zeros(len(problem.scales.nominal)), np.inf, ""
    for turn in range(MAX_PASSES):
        if turn < COVARIANCE_UPDATES:
            whitenings = found.whitenings(z)
            # Far from the truth the runs would outshout the priors and lead astray: they gain weight as they are
            # explained.
            before, misfit = misfit, _misfit(_whiten_all(whitenings, found.residuals(z)))
        else:
            before = misfit
            found.renew(z)
        now = _LeastSquaresPass(found, whitenings, misfit)
        step, covariance = now.newton(z)
        moves = float(np.max(np.abs(step) / np.sqrt(np.diag(covariance))))
        if moves < CONVERGED_MOVE and abs(misfit / before - 1) < CONVERGED_MOVE:
            z, why = z + step, ""
            break
        if turn >= COVARIANCE_UPDATES and moves < NEWTON_RANGE:
            lower = now.lower(z, step)
            if lower is None:
                why = ""
                break
            step = lower - z
        why = f"after {turn + 1} passes a parameter still moves by {moves:.2g} of its error"
        if moves < NEWTON_RANGE:
            z = np.clip(z + step, -PARAMETER_BOUND, PARAMETER_BOUND)
            continue
        # The first pass only has to come near: its covariance was laid out around the nominal values.
        most = MAX_EVALUATIONS if turn else FIRST_PASS_EVALUATIONS
        fit = least_squares(
            now.residuals,
            z,
            now.jacobian,
            bounds=(-PARAMETER_BOUND, PARAMETER_BOUND),
            max_nfev=most,
            ftol=1e-7,
            xtol=2e-3,
            gtol=1e-6,
        )
        z = fit.x
    slopes = tuple(found.derivatives(z))
    return JointSolution(z, covariance, whitenings, slopes, misfit, converged=not why, steps=found.steps, why=why)


def _whiten_all(whitenings: Sequence[Whitening], each: Sequence[FloatArray]) -> FloatArray:
    return np.concatenate([white.whole(values) for white, values in zip(whitenings, each, strict=True)])


def _misfit(whitened: FloatArray) -> float:
    """Return the runs' squares per block where these exceed what noise explains, 1 where they do not."""
    share = float(whitened @ whitened) / max(len(whitened), 1)
    return share if share > MISFIT_THRESHOLD else 1.0
