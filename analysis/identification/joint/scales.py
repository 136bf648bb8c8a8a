"""Parameters in units of what is known beforehand: standard normal before any run."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.nominal.protocol import Parameter
from dragrig.rig.arrays import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Scales:
    """The way from `z`, standard normal beforehand, to values: `nominal + sd z`, or `nominal · exp(sd z)`."""

    nominal: FloatArray
    sd: FloatArray
    positive: BoolArray

    @classmethod
    def of(cls, parameters: Sequence[Parameter]) -> "Scales":
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
