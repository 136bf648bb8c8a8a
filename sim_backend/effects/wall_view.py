"""The wall as effects see it: point by point on the hemisphere that leads, or sheared under a capsule that sticks."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.contact import HemisphereContact
from dragrig.sim_backend.friction.history import ContactHistory
from dragrig.sim_backend.friction.maxwell import MaxwellBranches, strain_at
from dragrig.sim_backend.friction.sticking import StickingForce
from dragrig.sim_backend.friction.wall import WallParameters, model_wall

POINTS = 32
"""Points of the wall; they crowd where it is first touched, as the fast branch relaxes within milliseconds."""


@dataclass(frozen=True, eq=False)
class WallView:
    """`m` points of the wall on the leading hemisphere, at `n` times."""

    contact: HemisphereContact
    history: ContactHistory
    time_s: FloatArray

    @cached_property
    def _nodes(self) -> tuple[FloatArray, FloatArray]:
        at, weights = np.polynomial.legendre.leggauss(POINTS)
        at, weights = 0.5 * (1 + at), 0.5 * weights
        length = self.contact.length_mm
        return length * at**2, length * 2 * at * weights

    @property
    def x_mm(self) -> FloatArray:
        """Contact coordinate, from first touch (0) to the equator (L), shape `(m,)`."""
        return self._nodes[0]

    @cached_property
    def strain(self) -> FloatArray:
        """Hoop strain (Eq. 6), shape `(m,)`."""
        return np.asarray(self._local_radius / (self.contact.radius_mm * np.cos(self.contact.angle_rad)) - 1)

    @property
    def strain_at_equator(self) -> float:
        """The largest of it."""
        return self.contact.strain_at_equator

    @cached_property
    def age_s(self) -> FloatArray:
        """Contact age of each point, shape `(n, m)`."""
        return self._ages(self.x_mm)

    @cached_property
    def equator_age_s(self) -> FloatArray:
        """Contact age at the equator, shape `(n,)`."""
        return np.asarray(self._ages(np.array([self.contact.length_mm]))[:, 0])

    @cached_property
    def parameters(self) -> WallParameters:
        """Elements of the wall at each point, shape `(m,)` each."""
        return model_wall(self.contact.model, self.strain)

    @cached_property
    def equator_parameters(self) -> WallParameters:
        """Elements of the wall at the equator."""
        return model_wall(self.contact.model, np.asarray(self.strain_at_equator))

    def coarse_resistance(self, panels: int) -> FloatArray:
        """Return f_e [mN] without sign, `(n,)`, by midpoints of so many panels each on fresh wall and on that found."""
        length = self.contact.length_mm
        fresh = np.minimum(self._renewed_mm, length)[:, None]
        middle = (np.arange(panels) + 0.5) / panels
        x_mm = np.hstack((fresh * middle, fresh + (length - fresh) * middle))
        panel = np.repeat(np.hstack((fresh, length - fresh)) / panels, panels, axis=1)
        return np.asarray(np.sum(self.contact.axial_load(x_mm, self._ages(x_mm)) * panel, axis=1))

    def resistance(self, stress_kPa: FloatArray) -> FloatArray:
        """f_e [mN], without sign, of a hoop stress at each point and time, shape `(n, m)` to `(n,)` (Eqs. 7 and 9)."""
        weights = self._nodes[1] * self._slope / self._local_radius
        return np.asarray(stress_kPa @ weights)

    def pressing(self, stress_kPa: FloatArray) -> FloatArray:
        """P(L) S [mN] of a hoop stress at the equator, shape `(n,)` (Eqs. 7 and 13)."""
        contact = self.contact
        return np.asarray(stress_kPa * (contact.wall_thickness_mm / contact.radius_mm * contact.area_mm2))

    @cached_property
    def _local_radius(self) -> FloatArray:
        contact = self.contact
        return np.asarray(np.sqrt(contact.radius_mm**2 - (contact.length_mm - self.x_mm) ** 2))

    @cached_property
    def _slope(self) -> FloatArray:
        return np.asarray((2 * np.pi * self.contact.wall_thickness_mm) * (self.contact.length_mm - self.x_mm))

    @cached_property
    def _time(self) -> FloatArray:
        return np.clip(self.time_s, 0.0, float(self.history.motion.breaks_s[-1]))

    @cached_property
    def _of_stroke(self) -> npt.NDArray[np.intp]:
        """Number of the stroke at each time."""
        ends = [float(self.history.motion.breaks_s[one.last + 1]) for one in self.history.strokes]
        return np.minimum(np.searchsorted(ends, self._time, side="left"), len(ends) - 1)

    @property
    def _renewed_mm(self) -> FloatArray:
        """Way since the stroke began: so much of the contact is fresh wall."""
        motion = self.history.motion
        began = motion.position(np.array([float(motion.breaks_s[one.first]) for one in self.history.strokes]))
        return np.abs(motion.position(self._time) - began[self._of_stroke])

    def _ages(self, x_mm: FloatArray) -> FloatArray:
        """Return contact ages at the same points at all times, shape `(m,)`, or at others each time, shape `(n, m)`."""
        motion = self.history.motion
        x_mm = np.broadcast_to(x_mm, (self._time.size, x_mm.shape[-1]))
        begun = np.full(x_mm.shape, -self.history.dwell_s)
        for number, stroke in enumerate(self.history.strokes):
            rows = np.flatnonzero(self._of_stroke == number)
            z = self.history.wall_at(stroke, x_mm[rows], motion.position(self._time[rows])[:, None])
            came = np.full(z.shape, -self.history.dwell_s)
            for segment in (*stroke.found, stroke.fresh):
                inside = (z >= segment.rear_mm) & (z <= segment.front_mm)
                came[inside] = self.history.begin(segment, z[inside])
            begun[rows] = came
        return np.asarray(np.maximum(self._time[:, None] - begun, 0.0))


@dataclass(frozen=True, eq=False)
class ShearView:
    """The wall under a capsule that sticks, at `n` times."""

    force: StickingForce
    time_s: FloatArray
    target_strain: float
    """Strain that the run goes to, whose elements the wall has from the beginning."""

    @property
    def area_mm2(self) -> float:
        """Sheared surface: stress times this is force."""
        return self.force.area_mm2

    @cached_property
    def strain(self) -> FloatArray:
        """Shear strain, shape `(n,)`."""
        branches = self.force.branches
        return np.asarray(self.force.sheared_from + strain_at(branches.pieces, branches.thickness_mm, self._time))

    @cached_property
    def stresses(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Stress [kPa] in fast branch, slow branch and spring, shape `(n,)` each."""
        fast, slow = self.force.branches.at(self._time)
        return self.force.moduli[0] * fast, self.force.moduli[1] * slow, self.force.spring * self.strain

    @property
    def moduli(self) -> tuple[float, float, float]:
        """E1, E2 and E3 [kPa] at the strain of the run."""
        return float(self.force.moduli[0]), float(self.force.moduli[1]), self.force.spring

    @property
    def rates(self) -> tuple[float, float]:
        """Relaxation rates E1/η1 and E2/η2 [1/s]."""
        fast, slow = self.force.branches.rates.tolist()
        return fast, slow

    def branch(self, rate: float) -> FloatArray:
        """Stress over modulus of a further Maxwell branch with this relaxation rate [1/s], shape `(n,)`."""
        branches = self.force.branches
        further = MaxwellBranches.through(np.array([rate]), branches.pieces, branches.thickness_mm)
        return np.asarray(further.at(self._time)[0])

    @property
    def _time(self) -> FloatArray:
        return np.clip(self.time_s, 0.0, self.force.duration_s)
