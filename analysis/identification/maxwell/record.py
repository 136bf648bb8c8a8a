"""One relaxation run made ready for the fit."""

from dataclasses import dataclass

import numpy as np

from dragrig.analysis.identification.blocks import Blocks, divide
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.config.errors import AnalysisError
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Contact
from dragrig.sim_backend.friction.maxwell import MaxwellBranches, strain_at
from dragrig.sim_backend.friction.motion import Pieces

LEAST_PEAK = 0.5
"""Share of the samples about the peak that must be valid."""
PEAK_S = 0.02
FEWEST_AFTER = 50
"""Least valid samples after the ramp."""
LEAST_WAY_MM = 0.01
"""A shorter way between rests is an encoder that wavers, and no motion."""


@dataclass(frozen=True, slots=True, eq=False)
class ShearRecord:
    """A relaxation: measured motion, block means of the force, and what a branch of 1 kPa would show in them.

    Attributes
    ----------
    ramp_s
        When the ramp begins and ends.
    rested
        Whether there is a rest before it that shows the sensor's zero.
    hold_s
        Time from the ramp's end to the last valid sample.
    """

    file: str
    shear_strain: float
    area_mm2: float
    thickness_mm: float
    pieces: Pieces
    blocks: Blocks
    ramp_s: tuple[float, float]
    rested: bool
    hold_s: float
    step_s: float

    @classmethod
    def of(cls, experiment: Experiment) -> "ShearRecord":
        """Make a run ready; raises `AnalysisError` with the reason where it cannot say anything of the wall."""
        if experiment.contact is not Contact.STICKING:
            raise AnalysisError(f"{experiment.file}: nothing was sheared, the specimen's fixture is none")
        capsule = experiment.capsule
        turns = _bends(experiment)
        if turns.size < 2:
            raise AnalysisError(f"{experiment.file}: it has no ramp, the position stays where it is")
        ramp = float(turns[0]), float(turns[-1])
        hold_s = _held(experiment, ramp)
        return cls(
            file=experiment.file,
            shear_strain=experiment.shear_strain,
            area_mm2=float(np.pi) * capsule.diameter_mm * capsule.length_mm,
            thickness_mm=experiment.wall_thickness_mm,
            pieces=experiment.followed.pieces(),
            blocks=divide(experiment, "force", turns, jumps=False),
            ramp_s=ramp,
            rested=bool(experiment.valid[experiment.time_s < ramp[0]].any()),
            hold_s=hold_s,
            step_s=1 / experiment.run.trace.sample_rate_hz,
        )

    def spring(self) -> FloatArray:
        """Mean force of a spring of 1 kPa in each block [mN], shape `(n,)`."""
        return self.area_mm2 * self.blocks.of(strain_at(self.pieces, self.thickness_mm, self.blocks.nodes_s))

    def branches(self, times_s: FloatArray) -> FloatArray:
        """Mean force of Maxwell branches of 1 kPa and these time constants [mN], shape `(B, n)`."""
        return self.area_mm2 * self.blocks.of(self._prepared(times_s).at(self.blocks.nodes_s))

    def forces_at(self, times_s: FloatArray, moduli: FloatArray, spring: float, time_s: FloatArray) -> FloatArray:
        """Force of spring and branches [mN] at any times of the run."""
        branches = np.tensordot(moduli, self._prepared(times_s).at(time_s), axes=1)
        return np.asarray(self.area_mm2 * (spring * strain_at(self.pieces, self.thickness_mm, time_s) + branches))

    def _prepared(self, times_s: FloatArray) -> MaxwellBranches:
        return MaxwellBranches.through(1 / times_s, self.pieces, self.thickness_mm)


def _bends(experiment: Experiment) -> FloatArray:
    """Return when the motion begins, bends and ends; empty where it does not move."""
    motion = experiment.motion
    place, moves = motion.position(motion.breaks_s), np.pad((motion.signs != 0).astype(np.int8), 1)
    begins, ends = np.flatnonzero(np.diff(moves) > 0), np.flatnonzero(np.diff(moves) < 0)
    ways = [(begin, end) for begin, end in zip(begins, ends, strict=True) if _way(place[begin : end + 1])]
    return np.concatenate([np.zeros(0), *(motion.breaks_s[begin : end + 1] for begin, end in ways)])


def _way(place_mm: FloatArray) -> bool:
    return bool(np.ptp(place_mm) >= LEAST_WAY_MM)


def _held(experiment: Experiment, ramp_s: tuple[float, float]) -> float:
    time, valid = experiment.time_s, experiment.valid
    begin, end = ramp_s
    held = np.flatnonzero(valid & (time > end))
    if held.size < FEWEST_AFTER:
        raise AnalysisError(
            f"{experiment.file}: only {held.size} usable samples follow the ramp, too few to see the wall relax"
        )
    peak = (time > end - min(0.5 * (end - begin), PEAK_S)) & (time < end + PEAK_S)
    if np.mean(valid[peak]) < LEAST_PEAK:
        raise AnalysisError(f"{experiment.file}: the samples about the peak are clipped or missing (NaN)")
    return float(time[held[-1]]) - end
