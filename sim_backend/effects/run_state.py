"""The state of a run that effects depend on: motion, nominal forces, contact, wall and clock at rising times.

The wall is resolved point by point on the leading hemisphere, or is sheared under a capsule that sticks. Responses that
several effects share come last: linear systems, exact at uneven times for inputs that are linear between them, distance
travelled, the deflection of a bristle, and play.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from dragrig.config import Fixture, FrictionModelSettings
from dragrig.rig import Acquisition, Contact, FloatArray
from dragrig.sim_backend.friction import (
    GRAVITY_M_S2,
    Components,
    ContactHistory,
    HemisphereContact,
    MaxwellBranches,
    Motion,
    SlidingForce,
    StickingForce,
    WallParameters,
    gauss_legendre,
    linear_recursion,
    model_wall,
    prepare,
)

ComplexArray = npt.NDArray[np.complex128]
WALL_POINTS = 32
"""Points of the wall; they crowd near first contact, because the fast branch relaxes within milliseconds."""


@dataclass(frozen=True, eq=False)
class HemisphereWall:
    """`m` points of the wall on the leading hemisphere, at `n` times."""

    contact: HemisphereContact
    history: ContactHistory
    time_s: FloatArray

    @cached_property
    def _nodes(self) -> tuple[FloatArray, FloatArray]:
        nodes, weights = gauss_legendre(WALL_POINTS)
        length = self.contact.length_mm
        return length * nodes**2, length * 2 * nodes * weights

    @property
    def x_mm(self) -> FloatArray:
        """Contact coordinate, from first touch (0) to the equator (L), shape `(m,)`."""
        return self._nodes[0]

    @cached_property
    def strain(self) -> FloatArray:
        """Hoop strain (Eq. 6), shape `(m,)`."""
        return self.contact.strain(self.x_mm)

    @property
    def strain_at_equator(self) -> float:
        """Largest hoop strain."""
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
        """Return |f_e| [mN], `(n,)`, by the midpoint rule with `panels` panels each on fresh and on inherited wall."""
        length, motion = self.contact.length_mm, self.history.motion
        begin = motion.position(np.array([float(motion.breaks_s[stroke.first]) for stroke in self.history.strokes]))
        travelled = np.abs(motion.position(self._time) - begin[self._stroke_number])
        fresh = np.minimum(travelled, length)[:, None]
        middle = (np.arange(panels) + 0.5) / panels
        x_mm = np.hstack((fresh * middle, fresh + (length - fresh) * middle))
        panel = np.repeat(np.hstack((fresh, length - fresh)) / panels, panels, axis=1)
        return np.asarray(np.sum(self.contact.axial_load(x_mm, self._ages(x_mm)) * panel, axis=1))

    def resistance(self, stress_kPa: FloatArray) -> FloatArray:
        """Return |f_e| [mN] of a hoop stress at each point and time, shape `(n, m)` to `(n,)` (Eqs. 7 and 9)."""
        slope = 2 * np.pi * self.contact.wall_thickness_mm * (self.contact.length_mm - self.x_mm)
        return np.asarray(stress_kPa @ (self._nodes[1] * slope / self.contact.local_radius(self.x_mm)))

    def side_force(self, stress_kPa: FloatArray) -> FloatArray:
        """Return P(L) S [mN] of a hoop stress at the equator, shape `(n,)` (Eqs. 7 and 13)."""
        return np.asarray(stress_kPa * self.contact.side_force_per_stress)

    @cached_property
    def _time(self) -> FloatArray:
        return np.clip(self.time_s, 0.0, float(self.history.motion.breaks_s[-1]))

    @cached_property
    def _stroke_number(self) -> npt.NDArray[np.intp]:
        """Number of the stroke at each time."""
        ends = [float(self.history.motion.breaks_s[stroke.last + 1]) for stroke in self.history.strokes]
        return np.minimum(np.searchsorted(ends, self._time, side="left"), len(ends) - 1)

    def _ages(self, x_mm: FloatArray) -> FloatArray:
        """Return contact ages `(n, m)` at contact coordinates `(m,)`, or `(n, m)` where they vary with time."""
        motion = self.history.motion
        x_mm = np.broadcast_to(x_mm, (self._time.size, x_mm.shape[-1]))
        contact_s = np.full(x_mm.shape, -self.history.dwell_s)
        for number, stroke in enumerate(self.history.strokes):
            rows = np.flatnonzero(self._stroke_number == number)
            z = self.history.wall_point(stroke, x_mm[rows], motion.position(self._time[rows])[:, None])
            stroke_contact_s = np.full(z.shape, -self.history.dwell_s)
            for segment in stroke.segments:
                inside = (z >= segment.rear_mm) & (z <= segment.front_mm)
                stroke_contact_s[inside] = self.history.contact_time(segment, z[inside])
            contact_s[rows] = stroke_contact_s
        return np.asarray(np.maximum(self._time[:, None] - contact_s, 0.0))


@dataclass(frozen=True, eq=False)
class ShearedWall:
    """The wall under a capsule that sticks, at `n` times."""

    force: StickingForce
    time_s: FloatArray
    target_strain: float
    """Strain that the run is sheared to; its elements apply from the beginning."""

    @property
    def area_mm2(self) -> float:
        """Sheared surface."""
        return self.force.area_mm2

    @cached_property
    def stresses(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Stress [kPa] in fast branch, slow branch and spring, shape `(n,)` each."""
        return self.force.stresses(self.time_s)

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
        further = MaxwellBranches.integrate(np.array([rate]), branches.pieces, branches.thickness_mm)
        return np.asarray(further.stress(np.clip(self.time_s, 0.0, self.force.duration_s))[0])


@dataclass(frozen=True, eq=False)
class SlipHistory:
    """Slip since the last start and time since the last start and stop, at `n` times."""

    slid_mm: FloatArray
    """Distance since the last start; keeps its value after a stop, 0 before the first start."""
    since_start_s: FloatArray
    """Time since the last start; 0 before the first."""
    since_stop_s: FloatArray
    """Time since the last stop; 0 in motion and before the first start."""
    heading: FloatArray
    """Direction of the present or the last motion, 1 or −1; 0 before the first start."""
    moving: FloatArray
    """1 in motion, 0 at rest."""

    @classmethod
    def of(cls, motion: Motion, time_s: FloatArray) -> "SlipHistory":
        """Follow a motion through its starts, turns and stops."""
        breaks, signs = motion.breaks_s, motion.signs.astype(np.float64)
        index = np.clip(np.searchsorted(breaks, time_s, side="right") - 1, 0, signs.size - 1)
        before = np.concatenate(([0.0], signs[:-1]))
        starts = np.where((signs != 0) & (signs != before), np.arange(signs.size), -1)
        stops = np.where((signs == 0) & (before != 0), np.arange(signs.size), -1)
        start, stop = np.maximum.accumulate(starts)[index], np.maximum.accumulate(stops)[index]
        started, stopped = start >= 0, (stop > start) & (start >= 0)
        start_s = breaks[np.maximum(start, 0)]
        slid = np.abs(motion.position(time_s) - motion.position(start_s))
        return cls(
            slid_mm=np.where(started, slid, 0.0),
            since_start_s=np.where(started, time_s - start_s, 0.0),
            since_stop_s=np.where(stopped, time_s - breaks[np.maximum(stop, 0)], 0.0),
            heading=np.where(started, signs[np.maximum(start, 0)], 0.0),
            moving=np.where(started & ~stopped, 1.0, 0.0),
        )


@dataclass(frozen=True, eq=False)
class RunState:
    """The state that an effect may depend on, at `n` rising times. Units mm, s, mN, kPa; arrays of shape `(n,)`."""

    time_s: FloatArray
    """Times from the run's first sample on."""
    session_start_s: float
    """The first sample on the clock of the specimen's session, whose 0 is the first sample of its first run."""
    order: int
    """Number of the run on the specimen, from 0."""
    contact: Contact
    fixture: Fixture
    """`contact`, `fixture`: how capsule and gut touch."""
    motion: Motion
    """The stage's motion, as measured or as simulated."""
    regularisation_mm_s: float
    """Speed over which Coulomb friction changes sign."""
    f_e: FloatArray
    f_v: FloatArray
    f_c: FloatArray
    """`f_e`, `f_v`, `f_c`: nominal parts of the sliding force, true mN; zeros where nothing slides."""
    weight_mN: float
    """The capsule's weight."""
    friction_coefficient: float
    """The nominal μ."""
    shear: FloatArray
    """Nominal force of a capsule that sticks; zeros where none does."""
    wall: HemisphereWall | None = None
    """The wall on a capsule that slides in a closed gut; None elsewhere."""
    sheared: ShearedWall | None = None
    """The wall under a capsule that sticks; None elsewhere."""
    origin_mm: float = 0.0
    """Where on its machine the run begins; 0 where that is not known."""

    @property
    def sliding(self) -> bool:
        """Whether something slides: drag and Coulomb runs."""
        return self.contact is Contact.SLIDING and self.fixture is not Fixture.NONE

    @property
    def gut_closed(self) -> bool:
        """Whether the capsule slides in a closed gut: drag runs."""
        return self.wall is not None

    @cached_property
    def nominal(self) -> FloatArray:
        """Nominal force [mN]."""
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
        """Absolute velocity."""
        return np.abs(self.velocity_mm_s)

    @cached_property
    def acceleration_mm_s2(self) -> FloatArray:
        """Acceleration, constant in pieces."""
        pieces = self.motion.pieces()
        return np.asarray(pieces.acceleration_mm_s2[pieces.locate(self.time_s)[0]])

    @cached_property
    def coulomb_sign(self) -> FloatArray:
        """Direction of Coulomb friction, −1 to 1, 0 at rest (Eq. 12 with its regularisation)."""
        return np.asarray(np.tanh(self.velocity_mm_s / self.regularisation_mm_s))

    @cached_property
    def slip(self) -> SlipHistory:
        """Slip since starts and stops."""
        return SlipHistory.of(self.motion, self.time_s)

    def relaxing_branch(self, rate: float) -> FloatArray:
        """Return the force of a further Maxwell branch of this rate [1/s] where there is neither wall nor shear: none.

        A state with a force of its own that relaxes overrides it.
        """
        del rate
        return np.zeros_like(self.time_s)

    @cached_property
    def stiffness_force(self) -> FloatArray:
        """Force in proportion to the wall's stiffness: shear, f_e, and the part of f_c that is not the weight's."""
        weight_friction_mN = self.friction_coefficient * self.weight_mN * self.coulomb_sign if self.sliding else 0.0
        return self.shear + self.f_e + self.f_c - weight_friction_mN


def gut_run_state(
    acquisition: Acquisition,
    settings: FrictionModelSettings,
    motion: Motion,
    time_s: FloatArray,
    session_start_s: float = 0.0,
    still: Motion | None = None,
) -> RunState:
    """Return the state of a run with capsule and gut.

    Parameters
    ----------
    acquisition, settings
        The run, and the nominal model of its specimen.
    motion
        The stage's motion.
    time_s
        Rising times, shape `(n,)`.
    session_start_s
        The first sample on the session's clock.
    still
        Motion for the shear of a capsule that sticks, if it differs: a recorded one without smoothing.
    """
    sticking = acquisition.contact is Contact.STICKING
    prepared = prepare(acquisition, settings, still if sticking and still is not None else motion)
    friction = prepared.friction
    zeros = np.zeros_like(time_s)
    parts = Components(zeros, zeros, zeros) if sticking else prepared.components(time_s)
    wall, sheared = None, None
    if isinstance(friction, SlidingForce) and friction.side is not None:
        wall = HemisphereWall(friction.contact, friction.history, time_s)
    if isinstance(friction, StickingForce):
        sheared = ShearedWall(friction, time_s, abs(acquisition.shear_strain))
    return RunState(
        time_s=time_s,
        session_start_s=session_start_s,
        order=acquisition.order,
        contact=acquisition.contact,
        fixture=acquisition.fixture,
        motion=motion,
        regularisation_mm_s=settings.regularisation_mm_s,
        f_e=parts.f_e,
        f_v=parts.f_v,
        f_c=parts.f_c,
        weight_mN=acquisition.capsule.mass_g * GRAVITY_M_S2,
        friction_coefficient=settings.friction_coefficient,
        shear=friction.total(time_s) if isinstance(friction, StickingForce) else zeros,
        wall=wall,
        sheared=sheared,
    )


@dataclass(frozen=True, slots=True, eq=False)
class HoopStress:
    """Nominal hoop stress [kPa] in fast branch, slow branch and spring."""

    fast: FloatArray
    slow: FloatArray
    spring: FloatArray

    @classmethod
    def of(cls, wall: WallParameters, strain: FloatArray | float, age_s: FloatArray) -> "HoopStress":
        """Return the stress after a contact age (Eq. 3); elements and strain broadcast against the ages."""
        fast_rate, slow_rate = wall.rates
        return cls(
            fast=np.asarray(strain * wall.E1 * np.exp(-age_s * fast_rate)),
            slow=np.asarray(strain * wall.E2 * np.exp(-age_s * slow_rate)),
            spring=np.asarray(strain * wall.E3 * np.ones_like(age_s)),
        )

    @classmethod
    def on_hemisphere(cls, wall: HemisphereWall) -> "HoopStress":
        """Return the stress at each time and point, shape `(n, m)`."""
        return cls.of(wall.parameters, wall.strain, wall.age_s)

    @classmethod
    def at_equator(cls, wall: HemisphereWall) -> "HoopStress":
        """Return the stress at the equator, shape `(n,)`."""
        return cls.of(wall.equator_parameters, wall.strain_at_equator, wall.equator_age_s)

    @property
    def total(self) -> FloatArray:
        """Total stress."""
        return self.fast + self.slow + self.spring


def force_of_hoop_stress(
    run: RunState, wall: HemisphereWall, stress_kPa: FloatArray, equator_kPa: FloatArray
) -> FloatArray:
    """Return f_e + f_c [mN] of an additional hoop stress, shapes `(n, m)` and `(n,)` to `(n,)` (Eqs. 9, 12 and 13)."""
    environment = np.sign(run.f_e) * wall.resistance(stress_kPa)
    return np.asarray(environment + run.friction_coefficient * run.coulomb_sign * wall.side_force(equator_kPa))


def normal_force(run: RunState) -> FloatArray:
    """Return the nominal N [mN] of a run that slides, at rest too (Eq. 13)."""
    if run.wall is None:
        return np.full_like(run.time_s, run.weight_mN)
    return np.asarray(run.weight_mN + run.wall.side_force(HoopStress.at_equator(run.wall).total))


def first_order(time_s: FloatArray, driving: FloatArray, time_constant_s: float) -> FloatArray:
    """Return y with τ y' + y = driving, in equilibrium before the first time, shapes `(n,)`."""
    change = _modal(time_s, driving - driving[0], complex(-1.0 / time_constant_s))
    return np.asarray(driving[0] + change.real / time_constant_s)


def resonator(time_s: FloatArray, driving: FloatArray, frequency_hz: float, damping: float) -> FloatArray:
    """Return y with y'' + 2 ζ ω y' + ω² y = ω² driving, in equilibrium before the first time; `damping` ζ in (0, 1)."""
    omega = 2 * np.pi * frequency_hz
    pole = omega * (-damping + 1j * np.sqrt(1 - damping**2))
    change = _modal(time_s, driving - driving[0], pole)
    return np.asarray(driving[0] + change.imag * omega**2 / pole.imag)


def _modal(time_s: FloatArray, driving: FloatArray, pole: complex) -> ComplexArray:
    """Return ∫ exp(pole (t − s)) driving(s) ds from the first time on, complex, driving linear between times."""
    step = np.diff(time_s)
    scaled = pole * step
    decay = np.exp(scaled)
    small = np.abs(scaled) < 1e-4
    safe = np.where(small, 1.0, scaled)
    whole = np.where(small, 1 + scaled / 2, (decay - 1) / safe)
    later = np.where(small, 0.5 + scaled / 6, (decay - 1 - scaled) / safe**2)
    added = step * (driving[:-1] * (whole - later) + driving[1:] * later)
    return linear_recursion(np.append(0.0, decay), np.append(0.0, added))


def distance_travelled(motion: Motion, time_s: FloatArray) -> FloatArray:
    """Return the distance travelled since the motion began, both directions added up, of the times' shape."""
    index, moved = _since_break(motion, time_s)
    steps = np.abs(np.diff(motion.position(motion.breaks_s)))
    return np.asarray(np.append(0.0, np.cumsum(steps))[index] + moved)


def bristle_deflection(motion: Motion, time_s: FloatArray, length_mm: float) -> FloatArray:
    """Return a bristle's deflection over its steady one, −1 to 1, of the times' shape.

    It starts from 0, follows the motion over a sliding distance, `length_mm · dz/ds = sign − z`, and keeps its value
    while nothing moves (Dahl).
    """
    index, moved = _since_break(motion, time_s)
    signs = motion.signs.astype(np.float64)
    decay = np.exp(-np.abs(np.diff(motion.position(motion.breaks_s))) / length_mm)
    begin = linear_recursion(np.append(0.0, decay), np.append(0.0, signs * (1 - decay)))
    share = np.exp(-moved / length_mm)
    return np.asarray(begin[index] * share + signs[index] * (1 - share))


def _since_break(motion: Motion, time_s: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Return the interval that each time lies in, and the distance travelled since that began."""
    breaks = motion.breaks_s
    time = np.clip(time_s, 0.0, breaks[-1])
    index = np.clip(np.searchsorted(breaks, time, side="right") - 1, 0, breaks.size - 2)
    return index, np.asarray(np.abs(motion.position(time) - motion.position(breaks[index])))


def behind_by_play(driving_mm: FloatArray, play_mm: float, taken_up: float) -> FloatArray:
    """Return how far a part driven through a play is behind its driver [mm], shape `(n,)`.

    It starts with 0, is left behind until the play is taken up, follows then, and is left behind anew after each
    reversal, however fast the motion is.

    Parameters
    ----------
    driving_mm
        Positions in sequence, shape `(n,)`.
    play_mm
        Width of the play.
    taken_up
        Share of it that is taken up at the begin in the direction of the first motion.
    """
    position = driving_mm - driving_mm[0]
    steps = np.diff(position)
    moving = np.flatnonzero(steps)
    if not moving.size or play_mm <= 0:
        return np.zeros_like(position)
    signs = np.sign(steps[moving])
    starts = moving[np.append(True, np.diff(signs) != 0)]
    driven = np.zeros_like(position)
    # Where it is while the play is open on either side: behind by at most so much, ahead by at most so much.
    ahead_mm = play_mm * (taken_up if signs[0] > 0 else 1.0 - taken_up)
    behind_mm = play_mm - ahead_mm
    for start, end in pairwise((*starts.tolist(), position.size - 1)):
        piece = slice(start + 1, end + 1)
        here = float(driven[start])
        rising = steps[start] > 0
        driven[piece] = (
            np.maximum(here, position[piece] - behind_mm) if rising else np.minimum(here, position[piece] + ahead_mm)
        )
    return np.asarray(driven - position)
