"""What is looked at: the residual of a run's channel in blocks, beside what noise and repeatability let one expect."""

from dataclasses import dataclass

import numpy as np

from dragrig.rig.arrays import FloatArray, PhaseArray
from dragrig.rig.devices import Contact


@dataclass(frozen=True, slots=True, eq=False)
class BandPower:
    """Mean squares of a steady phase, its mean taken off, by the bands of `BANDS_HZ`.

    Attributes
    ----------
    shown
        What the residual has [the channel's unit squared], shape `(bands,)`.
    expected
        What noise has.
    """

    shown: FloatArray
    expected: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ResidualBlocks:
    """What the nominal model, refitted, leaves of one channel of one run: means over `B` blocks.

    Attributes
    ----------
    run_id
        The run; its channels share it.
    channel
        `force` or `position`.
    kind
        The run's protocol.
    contact
        How capsule and gut met.
    speed_mm_s
        Commanded top speed.
    strain
        Commanded shear strain; 0 where nothing is sheared.
    session_s
        The first sample on the session's clock.
    residual
        Measured less model [the channel's unit], shape `(B,)`.
    noise_sd
        What it is expected to be without a gap: noise, repeatability and tolerance in one standard deviation.
    width_s
        Durations of the blocks.
    time_s
        Their middles, from the first sample on.
    phase
        Their phases.
    position_mm
        Where the stage is, from the first sample on.
    bands
        The steady phase by frequency, from the whole trace; from the blocks where it is missing.
    origin_mm
        Where on the rig the run begins.
    level_mN
        The force that was measured, shape `(B,)`, where it is at hand.
    explained
        What an effect that is known to be there adds to the residual [the channel's unit], shape `(B,)`: it is looked
        at instead of the residual, and all of it is excess.
    """

    run_id: str
    channel: str
    kind: str
    contact: Contact
    speed_mm_s: float
    strain: float
    session_s: float
    residual: FloatArray
    noise_sd: FloatArray
    width_s: FloatArray
    time_s: FloatArray
    phase: PhaseArray
    position_mm: FloatArray
    bands: BandPower | None = None
    level_mN: FloatArray | None = None
    explained: FloatArray | None = None
    origin_mm: float = 0.0

    def __post_init__(self) -> None:
        """Raise `ValueError` for arrays of unequal lengths and for noise or widths that are not positive."""
        level = self.residual if self.level_mN is None else self.level_mN
        arrays = (self.residual, self.noise_sd, self.width_s, self.time_s, self.phase, self.position_mm, level)
        if len({one.shape for one in arrays}) != 1 or self.residual.ndim != 1 or not self.residual.size:
            raise ValueError(f"Blocks of run {self.run_id} differ in their number, or there are none")
        if not (np.isfinite(self.residual).all() and (self.noise_sd > 0).all() and (self.width_s > 0).all()):
            raise ValueError(f"Blocks of run {self.run_id} need finite residuals, positive noise and positive widths")

    @property
    def deviation(self) -> FloatArray:
        """The residual, or what is explained of it, over what is expected of it, shape `(B,)`."""
        looked_at = self.residual if self.explained is None else self.explained
        return np.asarray(looked_at / self.noise_sd)

    @property
    def weight(self) -> FloatArray:
        """Each block's part of the run's duration, shape `(B,)`."""
        return np.asarray(self.width_s / self.width_s.sum())

    @property
    def excess(self) -> FloatArray:
        """Each block's part of the run's mean square above the expected one, in units of it, shape `(B,)`."""
        return np.asarray(self.weight * (self.deviation**2 - (self.explained is None)))
