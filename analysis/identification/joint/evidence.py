"""What each run contributes to a joint fit: block means, their covariance, and what differs from run to run."""

from collections.abc import Callable, Collection, Hashable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.identification.blocks import Blocks, divide
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.analysis.nominal.protocol import NominalModel, Prediction, Predictor
from dragrig.rig.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """One channel of one run: `B` blocks, and the model prepared for it."""

    experiment: Experiment
    channel: str
    predictor: Predictor
    blocks: Blocks

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
        root = _factor(self.noise_root @ self.noise_root.T, sd)
        return _whitened(root, self.noise_root @ self.own)

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


def gather(experiments: Sequence[Experiment], nominal: NominalModel, longest_mm: float = np.inf) -> Iterator[Evidence]:
    """Prepare every channel of every run that the model predicts, in blocks no longer than so many mm.

    Raises `AnalysisError` as the model's `prepare`.
    """
    for experiment in experiments:
        for channel, predictor in nominal.prepare(experiment).items():
            blocks = divide(experiment, channel, predictor.events_s, jumps=True, longest_mm=longest_mm)
            yield Evidence(experiment, channel, predictor, blocks)


def whitening(
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
    root = _factor(noise(), uncertainty) if near is None else near.noise_root
    columns = prediction.varying * sds[:, None]
    if zero_sd > 0:
        columns = np.vstack((np.full((1, len(root)), zero_sd), columns))
    return _whitened(root, columns.T)


def _whitened(root: FloatArray, columns: FloatArray) -> Whitening:
    """Lay out a run's covariance from its factor and from what its zero and factors change, shape `(B, k)`."""
    from scipy.linalg import solve_triangular

    own = np.asarray(solve_triangular(root, columns, lower=True))
    left, sizes, _ = np.linalg.svd(own, full_matrices=False)
    return Whitening(root, own, np.asarray(left), 1 - 1 / np.sqrt(1 + sizes**2))


def _factor(covariance: FloatArray, uncertainty: FloatArray) -> FloatArray:
    from scipy.linalg import cholesky

    covariance[np.diag_indices_from(covariance)] += uncertainty**2
    return np.asarray(cholesky(covariance, lower=True, overwrite_a=True))
