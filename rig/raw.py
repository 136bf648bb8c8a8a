"""What the converter and the counter say before any calibration: what calibrations are made from."""

from dataclasses import dataclass

import numpy as np

from dragrig.rig.arrays import AnyFloatArray


@dataclass(frozen=True, slots=True)
class RawReading:
    """A stretch of samples that nobody has scaled.

    Attributes
    ----------
    force_V, force_V_sd
        Mean and standard deviation of the force input [V].
    samples
        How many samples they are of.
    counts_begin, counts_end
        The encoder's count at the first and the last sample, upwards where the stage goes up.
    """

    force_V: float
    force_V_sd: float
    samples: int
    counts_begin: int
    counts_end: int

    @classmethod
    def of(cls, force_V: AnyFloatArray, counts: AnyFloatArray) -> "RawReading":
        """Sum up volts and counts, both of shape `(n,)`."""
        return cls(
            force_V=float(np.mean(force_V, dtype=np.float64)),
            force_V_sd=float(np.std(force_V, dtype=np.float64)),
            samples=len(force_V),
            counts_begin=round(float(counts[0])),
            counts_end=round(float(counts[-1])),
        )
