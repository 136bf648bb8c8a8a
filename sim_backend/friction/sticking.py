"""Force on a capsule that sticks to the wall: the relaxation test (Eq. 3, integrated through the ramp)."""

from dataclasses import dataclass

import numpy as np

from dragrig.config.errors import SettingsError
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Acquisition
from dragrig.sim_backend.friction.motion import Motion, Pieces
from dragrig.sim_backend.friction.wall import wall_parameters


@dataclass(frozen=True, slots=True, eq=False)
class MaxwellBranch:
    """Spring and damper in series: modulus [kPa], rate [1/s], and its stress [kPa] as each piece begins, `(K,)`."""

    modulus: float
    rate: float
    stress: FloatArray

    @classmethod
    def through(cls, modulus: float, rate: float, pieces: Pieces, thickness_mm: float) -> "MaxwellBranch":
        """Integrate from no stress through all pieces of a shear."""
        duration = np.diff(pieces.start_s)
        driven = _driven(modulus, rate, duration, pieces.velocity_mm_s[:-1], pieces.acceleration_mm_s2[:-1])
        stress = linear_recursion(np.exp(-rate * duration), driven / thickness_mm)
        return cls(modulus, rate, np.concatenate(([0.0], stress)))


@dataclass(frozen=True, slots=True, eq=False)
class StickingForce:
    """Shear force of a run whose capsule sticks to the wall, prepared for any sample times.

    `area_mm2` is the capsule's cylindrical surface, `spring` the modulus E3 [kPa], `sheared_from` the
    strain at the first sample, at which the branches are relaxed.
    """

    run_id: str
    pieces: Pieces
    duration_s: float
    area_mm2: float
    thickness_mm: float
    sheared_from: float
    spring: float
    branches: tuple[MaxwellBranch, MaxwellBranch]

    @classmethod
    def of(cls, acquisition: Acquisition, model: FrictionModelSettings, motion: Motion) -> "StickingForce":
        """Integrate both branches with the parameters of the run's shear strain."""
        strain = abs(acquisition.shear_strain)
        wall = wall_parameters(model.wall, strain).scaled(model)
        if min(wall.E1, wall.E2, wall.eta1, wall.eta2) <= 0:
            raise SettingsError(
                f"shear_strain {strain:g} of run {acquisition.run_id!r} is beyond where {model.wall} has positive "
                "parameters; use a smaller strain, Table 1 ends at 2"
            )
        pieces = motion.pieces()
        thickness = acquisition.specimen.wall_thickness_mm
        fast, slow = (
            MaxwellBranch.through(float(modulus), float(rate), pieces, thickness)
            for modulus, rate in zip((wall.E1, wall.E2), wall.rates, strict=True)
        )
        capsule = acquisition.capsule
        return cls(
            run_id=acquisition.run_id,
            pieces=pieces,
            duration_s=float(motion.breaks_s[-1]),
            area_mm2=np.pi * capsule.diameter_mm * capsule.length_mm,
            thickness_mm=thickness,
            sheared_from=acquisition.sheared_from,
            spring=float(wall.E3),
            branches=(fast, slow),
        )

    def total(self, time_s: FloatArray) -> FloatArray:
        """Shear force [mN] at any times [s]; before the motion's start and after its end it stays as there."""
        time = np.clip(np.asarray(time_s, dtype=float), 0.0, self.duration_s)
        index = np.maximum(np.searchsorted(self.pieces.start_s, time, side="right") - 1, 0)
        elapsed = time - self.pieces.start_s[index]
        velocity, acceleration = self.pieces.velocity_mm_s[index], self.pieces.acceleration_mm_s2[index]
        position = self.pieces.position_mm[index] + (velocity + 0.5 * acceleration * elapsed) * elapsed
        stress = self.spring * (self.sheared_from + position / self.thickness_mm)
        for branch in self.branches:
            stress += branch.stress[index] * np.exp(-branch.rate * elapsed)
            stress += _driven(branch.modulus, branch.rate, elapsed, velocity, acceleration) / self.thickness_mm
        return np.asarray(stress * self.area_mm2)


def _driven(
    modulus: float, rate: float, elapsed_s: FloatArray, velocity_mm_s: FloatArray, acceleration_mm_s2: FloatArray
) -> FloatArray:
    """Stress times wall thickness that an unstressed branch takes up in a time of constant acceleration."""
    lag = -np.expm1(-rate * elapsed_s) / rate
    return np.asarray(modulus * (velocity_mm_s * lag + acceleration_mm_s2 * (elapsed_s - lag) / rate))


def linear_recursion(factor: FloatArray, addend: FloatArray) -> FloatArray:
    """Return y with y[0] = addend[0] and y[i] = factor[i] · y[i − 1] + addend[i], by doubling."""
    factor, total = factor.copy(), addend.copy()
    shift = 1
    while shift < total.size:
        total[shift:] = total[shift:] + factor[shift:] * total[:-shift]
        factor[shift:] = factor[shift:] * factor[:-shift]
        shift *= 2
    return total
