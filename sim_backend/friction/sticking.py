"""Force on a capsule that sticks to the wall: the relaxation test (Eq. 3, integrated through the ramp)."""

from dataclasses import dataclass

import numpy as np

from dragrig.config.errors import SettingsError
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Acquisition
from dragrig.sim_backend.friction.maxwell import MaxwellBranches, strain_at
from dragrig.sim_backend.friction.motion import Motion
from dragrig.sim_backend.friction.wall import model_wall


@dataclass(frozen=True, slots=True, eq=False)
class StickingForce:
    """Shear force of a run whose capsule sticks to the wall, prepared for any sample times.

    `area_mm2` is the capsule's cylindrical surface, `spring` the modulus E3 [kPa], `sheared_from` the
    strain at the first sample, at which the branches are relaxed; `moduli` are E1 and E2 [kPa].
    """

    run_id: str
    duration_s: float
    area_mm2: float
    sheared_from: float
    spring: float
    moduli: FloatArray
    branches: MaxwellBranches

    @classmethod
    def of(cls, acquisition: Acquisition, model: FrictionModelSettings, motion: Motion) -> "StickingForce":
        """Integrate both branches with the parameters of the run's shear strain."""
        strain = abs(acquisition.shear_strain)
        wall = model_wall(model, strain)
        if not wall.positive:
            raise SettingsError(
                f"shear_strain {strain:g} of run {acquisition.run_id!r} is beyond where wall {model.wall} of model "
                f"{model.name!r} has positive parameters; use a smaller strain, Table 1 ends at 2"
            )
        pieces, thickness = motion.pieces(), acquisition.specimen.wall_thickness_mm
        capsule = acquisition.capsule
        return cls(
            run_id=acquisition.run_id,
            duration_s=float(motion.breaks_s[-1]),
            area_mm2=np.pi * capsule.diameter_mm * capsule.length_mm,
            sheared_from=acquisition.sheared_from,
            spring=float(wall.E3),
            moduli=np.array([float(wall.E1), float(wall.E2)]),
            branches=MaxwellBranches.through(np.array([float(rate) for rate in wall.rates]), pieces, thickness),
        )

    def total(self, time_s: FloatArray) -> FloatArray:
        """Shear force [mN] at any times [s]; before the motion's start and after its end it stays as there."""
        time = np.clip(np.asarray(time_s, dtype=float), 0.0, self.duration_s)
        strain = self.sheared_from + strain_at(self.branches.pieces, self.branches.thickness_mm, time)
        fast, slow = self.branches.at(time)
        return np.asarray((self.spring * strain + self.moduli[0] * fast + self.moduli[1] * slow) * self.area_mm2)
