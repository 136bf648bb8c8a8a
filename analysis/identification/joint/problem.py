"""Everything that a joint fit is made of, prepared: evidence, noise, priors."""

from collections.abc import Callable, Collection, Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TypeVar

import numpy as np

from dragrig.analysis.identification.joint.evidence import Evidence, Whitening, gather, whitening
from dragrig.analysis.identification.joint.scales import Scales
from dragrig.analysis.identification.noise import Noise, estimate_noise
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.nominal.protocol import NominalModel, Prediction
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import FloatArray

Found = TypeVar("Found")
STIFFNESS = "stiffness"
"""The variation of what is stiffness."""
WIDER = 2.0
"""A zero's standard deviation is at least this times the median distance from 0 that is seen."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Everything that a joint fit is made of, prepared.

    What is computed of one piece of evidence is the very same object for all that are alike.
    """

    nominal: NominalModel
    scales: Scales
    evidence: tuple[Evidence, ...]
    noises: tuple[Noise, ...]
    zero_sds: tuple[float, ...]
    sds: FloatArray

    @classmethod
    def of(cls, selection: Selection, nominal: NominalModel, longest_mm: float = np.inf) -> "Problem":
        """Prepare all runs, in blocks no longer than so many mm of the way.

        Raises `AnalysisError` where the model predicts nothing of any of them.
        """
        evidence = tuple(gather(selection.experiments, nominal, longest_mm))
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
            Scales.of(nominal.parameters),
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
            noise = partial(_covariance, self.evidence[number], self.noises[number])
            before = None if near is None else near[number]
            predicted, uncertainty = predictions[number], uncertainties[number]
            return whitening(noise, predicted, uncertainty, self.zero_sds[number], self.sds, before)

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
        stiff = np.array([one.name == STIFFNESS for one in self.nominal.variations])
        varying = predicted.varying + np.outer(stiff, more)
        stiffer = Prediction(predicted.total, varying)
        return whitening(lambda: near.noise_root, stiffer, more, self.zero_sds[number], self.sds, near)

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

    def _require_numbers(self, one: Evidence, *predicted: FloatArray) -> None:
        if not all(np.isfinite(values).all() for values in predicted):
            raise AnalysisError(
                f"the model {self.nominal.name} gives NaN or infinity for {one.channel} of {one.experiment.file} at "
                "values that the fit came to; give its parameters narrower priors, or mend the model."
            )


def _covariance(one: Evidence, noise: Noise) -> FloatArray:
    return noise.covariance(one.blocks.start_s, one.blocks.end_s, one.blocks.samples)


def _zero_sd(evidence: Sequence[Evidence], channel: str, nominal: NominalModel) -> float:
    """Return what the model says of a channel's zero, or more where the first samples of its runs lie further off."""
    usual = float(nominal.zero_sd.get(channel, 0.0))
    if usual == 0.0:
        return 0.0
    values = np.array([one.nominal for one in nominal.parameters])
    found = [float(one.blocks.mean[0] - one.predict(values).total[0]) for one in evidence if one.channel == channel]
    return max(usual, WIDER * float(np.median(np.abs(found))))
