"""A run as effects see it: motion, nominal forces, contact and clock, at any rising times."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dragrig.config.model import FrictionModelSettings
from dragrig.config.specimen import Fixture
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Acquisition, Contact
from dragrig.sim_backend.effects.wall_view import ShearView, WallView
from dragrig.sim_backend.friction import prepare
from dragrig.sim_backend.friction.motion import Motion
from dragrig.sim_backend.friction.sliding import GRAVITY_M_S2, Components, SlidingForce
from dragrig.sim_backend.friction.sticking import StickingForce

MOVING_MM_S = 1e-6


@dataclass(frozen=True, eq=False)
class Stance:
    """Where each of `n` times stands between the starts and stops of a motion.

    Attributes
    ----------
    slid_mm
        Distance since the capsule last stood still; keeps its value after a stop, 0 before the first start.
    since_start_s
        Time since it last began to move; 0 before the first start.
    since_stop_s
        Time since it last stopped; 0 while it moves and before the first start.
    heading
        Direction of the present or the last motion, 1 or −1; 0 before the first start.
    moving
        1 while it moves, 0 while it stands.
    """

    slid_mm: FloatArray
    since_start_s: FloatArray
    since_stop_s: FloatArray
    heading: FloatArray
    moving: FloatArray

    @classmethod
    def of(cls, motion: Motion, time_s: FloatArray) -> "Stance":
        """Follow a motion through its starts, turns and stops."""
        breaks, signs = motion.breaks_s, motion.signs.astype(np.float64)
        index = np.clip(np.searchsorted(breaks, time_s, side="right") - 1, 0, signs.size - 1)
        before = np.concatenate(([0.0], signs[:-1]))
        starts = np.where((signs != 0) & (signs != before), np.arange(signs.size), -1)
        stops = np.where((signs == 0) & (before != 0), np.arange(signs.size), -1)
        start, stop = np.maximum.accumulate(starts)[index], np.maximum.accumulate(stops)[index]
        begun, ended = start >= 0, (stop > start) & (start >= 0)
        start_s = breaks[np.maximum(start, 0)]
        moved = np.abs(motion.position(time_s) - motion.position(start_s))
        return cls(
            slid_mm=np.where(begun, moved, 0.0),
            since_start_s=np.where(begun, time_s - start_s, 0.0),
            since_stop_s=np.where(ended, time_s - breaks[np.maximum(stop, 0)], 0.0),
            heading=np.where(begun, signs[np.maximum(start, 0)], 0.0),
            moving=np.where(begun & ~ended, 1.0, 0.0),
        )


@dataclass(frozen=True, eq=False)
class Scene:
    """What an effect may depend on, at `n` rising times. Units mm, s, mN, kPa; arrays of shape `(n,)`.

    Attributes
    ----------
    time_s
        Times from the run's first sample on.
    session_start_s
        The first sample on the clock of the specimen's session, whose 0 is the first sample of its first run.
    order
        Number of the run on the specimen, from 0.
    contact, fixture
        How capsule and gut meet.
    dwell_s
        Age of the contact at the first sample.
    motion
        The stage's motion, as measured or as simulated.
    regularisation_mm_s
        Speed over which Coulomb friction turns its sign.
    f_e, f_v, f_c
        Nominal parts of the sliding force, true mN; zeros where nothing slides.
    weight_mN
        The capsule's weight.
    friction_coefficient
        The nominal μ.
    shear
        Nominal force of a capsule that sticks; zeros where none does.
    wall
        The wall on the capsule, for a capsule that slides in a closed gut.
    sheared
        The wall under a capsule that sticks.
    """

    time_s: FloatArray
    session_start_s: float
    order: int
    contact: Contact
    fixture: Fixture
    dwell_s: float
    motion: Motion
    regularisation_mm_s: float
    f_e: FloatArray
    f_v: FloatArray
    f_c: FloatArray
    weight_mN: float
    friction_coefficient: float
    shear: FloatArray
    wall: WallView | None = None
    sheared: ShearView | None = None

    @property
    def sliding(self) -> bool:
        """Whether something slides: drag and Coulomb runs."""
        return self.contact is Contact.SLIDING and self.fixture is not Fixture.NONE

    @property
    def closed(self) -> bool:
        """Whether the capsule slides in a closed gut: drag runs."""
        return self.wall is not None

    @cached_property
    def nominal(self) -> FloatArray:
        """The nominal force."""
        return self.f_e + self.f_v + self.f_c + self.shear

    @cached_property
    def session_s(self) -> FloatArray:
        """Times on the session's clock."""
        return self.session_start_s + self.time_s

    @cached_property
    def position_mm(self) -> FloatArray:
        """Position, counted from the first sample."""
        return self.motion.position(self.time_s)

    @cached_property
    def velocity_mm_s(self) -> FloatArray:
        """Velocity."""
        return self.motion.velocity(self.time_s)

    @cached_property
    def speed_mm_s(self) -> FloatArray:
        """Its size."""
        return np.abs(self.velocity_mm_s)

    @cached_property
    def acceleration_mm_s2(self) -> FloatArray:
        """Acceleration, constant in pieces."""
        pieces = self.motion.pieces()
        index = np.searchsorted(pieces.start_s, self.time_s, side="right") - 1
        return np.asarray(pieces.acceleration_mm_s2[np.maximum(index, 0)])

    @cached_property
    def turning(self) -> FloatArray:
        """Direction of Coulomb friction, −1 to 1, 0 at rest (Eq. 12 with its regularisation)."""
        return np.asarray(np.tanh(self.velocity_mm_s / self.regularisation_mm_s))

    @cached_property
    def stance(self) -> Stance:
        """Starts and stops."""
        return Stance.of(self.motion, self.time_s)

    @cached_property
    def stiff(self) -> FloatArray:
        """What grows with the wall's stiffness: shear, f_e, and Coulomb friction without the weight's."""
        return self.shear + self.f_e + self.f_c - self.friction_coefficient * self.weight_mN * self._slipping

    @property
    def _slipping(self) -> FloatArray:
        return self.turning if self.sliding else np.zeros_like(self.time_s)


def gut_scene(
    acquisition: Acquisition,
    settings: FrictionModelSettings,
    motion: Motion,
    time_s: FloatArray,
    session_start_s: float = 0.0,
    still: Motion | None = None,
) -> Scene:
    """Build the scene of a run with capsule and gut.

    Parameters
    ----------
    acquisition, settings
        What the run is, and the nominal model of its specimen.
    motion
        The stage's motion.
    time_s
        Rising times, shape `(n,)`.
    session_start_s
        The first sample on the session's clock.
    still
        A motion for the shear of a capsule that sticks, where it is not the same: a recorded one without smoothing.
    """
    sticking = acquisition.contact is Contact.STICKING
    prepared = prepare(acquisition, settings, still if sticking and still is not None else motion)
    friction = prepared.friction
    nothing = np.zeros_like(time_s)
    parts = Components(nothing, nothing, nothing) if sticking else prepared.components(time_s)
    return Scene(
        time_s=time_s,
        session_start_s=session_start_s,
        order=acquisition.order,
        contact=acquisition.contact,
        fixture=acquisition.fixture,
        dwell_s=acquisition.insertion_dwell_s * settings.insertion_dwell_scale,
        motion=motion,
        regularisation_mm_s=settings.regularisation_mm_s,
        f_e=parts.f_e,
        f_v=parts.f_v,
        f_c=parts.f_c,
        weight_mN=acquisition.capsule.mass_g * GRAVITY_M_S2,
        friction_coefficient=settings.friction_coefficient,
        shear=friction.total(time_s) if isinstance(friction, StickingForce) else nothing,
        wall=_wall_of(friction, time_s) if isinstance(friction, SlidingForce) else None,
        sheared=_sheared(friction, acquisition, time_s) if isinstance(friction, StickingForce) else None,
    )


def _wall_of(friction: SlidingForce, time_s: FloatArray) -> WallView | None:
    return None if friction.side is None else WallView(friction.contact, friction.history, time_s)


def _sheared(friction: StickingForce, acquisition: Acquisition, time_s: FloatArray) -> ShearView:
    return ShearView(friction, time_s, abs(acquisition.shear_strain))
