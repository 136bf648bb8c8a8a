"""A capsule robot with "internal force–static friction" drive: its housing slips and sticks as an inner mass is thrown.

The inner mass moves relative to the housing in four phases of constant acceleration, +slow, −fast, −fast, +slow, and
rests for a pause. The housing obeys `(M + m) x'' = −m s'' − F`. It sticks while the actuator's force m s'' does not
exceed the static resistance; starts are at a phase's begin, or where the wall at rest has relaxed far enough, and stops
at zero speed. Between two events the motion is a polynomial that satisfies the equation of motion at Gauss points. Once
a period ends in the state in which it began, all further ones are the same: they are copied.

Where the friction model leaves a motion to the dynamics:

* Coulomb friction has its exact sign instead of the regularised one; at rest it is whatever the balance needs, up to
  μ N.
* f_e opposes the motion, or the impending motion. Its size is that of the leading hemisphere, at rest too.
* The contact follows the capsule with a play of `REVERSAL_SLACK_MM`: in a shorter reversal the same hemisphere leads
  and the wall under it ages; in a longer one the other leads.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, field, replace
from enum import Enum, auto
from functools import cache
from itertools import groupby
from operator import itemgetter
from typing import ClassVar, Self, TypeVar

import numpy as np
from scipy.optimize import brentq

from dragrig.config import AnalysisError, FrictionModelSettings, RobotDrive, RobotSettings
from dragrig.rig import FloatArray
from dragrig.sim_backend.friction import (
    GRAVITY_M_S2,
    REVERSAL_SLACK_MM,
    HemisphereContact,
    RelaxingLoad,
    gauss_legendre,
    viscous_force,
)

MN_PER_G_MM_S2 = 1e-3
"""g · mm/s² is µN."""
NODES = 8
"""Gauss points of a panel."""
FRESH_NODES = 6
"""Gauss points of the wall that a panel brings into contact."""
INSERTED_NODES = 16
"""Gauss points of each of three parts of the wall in contact at the insertion."""
TABLE_POINTS = 2049
"""Points of a tabulated contact."""
MAX_PANEL_S = 0.06
"""Longest panel: some relaxation times of the wall's fast branch."""
MAX_TRAVEL_MM = 1.2
"""Greatest travel in a panel in the gut."""
MIN_PANEL_S = 1e-10
"""Shorter panels are skipped."""
SPEED_STEP_MM_S = 1e-4
"""Step of the speed for the slope of viscous friction."""
STIFFNESS, MAX_STIFFNESS = 10.0, 1000.0
"""Growth of the resistance with the travel in a slip [mN/mm]: a first guess for Newton's method, and a limit."""
MAX_ITERATIONS = 40
MAX_HALVINGS = 12
TRAVEL_TOLERANCE_MM, EVENT_TOLERANCE_MM = 1e-9, 3e-9
"""How far beyond the place of an event a panel may end, and how near to it a place is there."""
SPEED_TOLERANCE = 1e-9
"""Change of speed at which the iteration of a panel ends, relative to the drive's."""
REPEAT_TOLERANCE, REPEAT_SPEED = 1e-9, 1e-12
"""Difference of the wall [mm, s], and of the speed relative to the drive's, that is none, if it is twice."""
WALL_POINTS = ((1, 0.01), (2, 0.05), (3, 0.15), (5, 0.4))
"""Points that stand for the wall that a panel brings into contact, and the travel [mm] below which they suffice."""


@dataclass(frozen=True, slots=True)
class AddedForce:
    """A force beside the nominal one on a capsule that slips, by the time since the slip began [mN].

    Positive resists the slip. Beyond the last time the last force holds.
    """

    time_s: FloatArray
    forwards_mN: FloatArray
    backwards_mN: FloatArray

    def resistance(self, direction: int, since_start_s: FloatArray | float) -> FloatArray:
        """Return it at times since the start of a slip."""
        values = self.forwards_mN if direction > 0 else self.backwards_mN
        return np.asarray(np.interp(since_start_s, self.time_s, values))


@dataclass(frozen=True, slots=True, eq=False)
class _Rule:
    """Gauss points of a panel of width 1, and integrals of the polynomial through values there."""

    nodes: FloatArray
    weights: FloatArray
    integral: FloatArray
    """From 0 to each node, shape `(n, n)`."""
    double_integral: FloatArray
    within: FloatArray
    """Values at the points between 0 and each node at which fresh wall is integrated, shape `(n · f, n)`."""
    within_integral: FloatArray
    fresh_nodes: FloatArray
    fresh_weights: FloatArray
    at_end: FloatArray
    """Value at the end, shape `(n,)`."""


@cache
def _rule() -> _Rule:
    nodes, weights = gauss_legendre(NODES)
    fresh_nodes, fresh_weights = gauss_legendre(FRESH_NODES)
    within = (nodes[:, None] * fresh_nodes).ravel()
    integral = interpolation(nodes, 1)
    return _Rule(
        nodes=nodes,
        weights=weights,
        integral=integral,
        double_integral=interpolation(nodes, 2),
        within=interpolation(within, 0),
        within_integral=interpolation(within, 1),
        fresh_nodes=fresh_nodes,
        fresh_weights=fresh_weights,
        at_end=interpolation(np.ones(1), 0)[0],
    )


@cache
def _wall_points(count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return so many Gauss points of a panel, their weights, and the matrix to values there."""
    nodes, weights = gauss_legendre(count)
    return nodes, weights, interpolation(nodes, 0)


def interpolation(at: FloatArray, integrals: int) -> FloatArray:
    """Return the matrix from values at the Gauss points to their polynomial, integrated so often from 0, at places."""
    coefficients = _coefficients(integrals)
    return np.asarray(np.polynomial.legendre.legvander(2 * at - 1, coefficients.shape[0] - 1) @ coefficients)


@cache
def _coefficients(integrals: int) -> FloatArray:
    """Return the matrix from values at the Gauss points to Legendre coefficients."""
    nodes, _ = gauss_legendre(NODES)
    of_values = np.linalg.inv(np.polynomial.legendre.legvander(2 * nodes - 1, NODES - 1))
    if not integrals:
        return np.asarray(of_values)
    return np.asarray(np.polynomial.legendre.legint(of_values, integrals, lbnd=-1, scl=0.5, axis=0), dtype=np.float64)


Millimetres = TypeVar("Millimetres", float, FloatArray)


class Resistance(ABC):
    """Resistance to slip [mN] as the capsule moves; not negative. It never changes by default."""

    __slots__ = ()
    constant: ClassVar[bool] = True
    """Whether it never changes."""
    max_panel_s: ClassVar[float] = np.inf
    """Longest panel in which its changes are resolved."""
    max_travel_mm: ClassVar[float] = np.inf
    """Greatest travel in a panel."""

    @abstractmethod
    def at_rest(self) -> Callable[[float], float]:
        """Return, by time while it rests, the force that the actuator must exceed."""

    @abstractmethod
    def sliding(
        self, direction: int, start_s: float, width_s: float, position_mm: FloatArray, speed_mm_s: FloatArray
    ) -> FloatArray:
        """Return the resistance at the Gauss points of a panel."""

    def damping(self, speed_mm_s: FloatArray) -> FloatArray:
        """Return by how much it grows with the speed [mN·s/mm]."""
        return np.zeros_like(speed_mm_s)

    def way_left(self, direction: int, position_mm: float) -> float:
        """Return the distance to where the resistance jumps."""
        return np.inf

    def advance(self, slip: "Slip") -> None:  # noqa: B027 - what never changes has nothing to take over
        """Take over a finished panel of a slip."""

    def moved(self, time_s: float, way_mm: float) -> Self:
        """Return the same state so much later and further on."""
        return self

    def difference(self, before: Self) -> float:
        """Return by how much it differs, in mm and s; infinite where it is not alike."""
        return 0.0


@dataclass(slots=True)
class _HardSurface(Resistance):
    """Coulomb friction alone."""

    friction_mN: float

    def at_rest(self) -> Callable[[float], float]:
        return lambda _: self.friction_mN

    def sliding(
        self, direction: int, start_s: float, width_s: float, position_mm: FloatArray, speed_mm_s: FloatArray
    ) -> FloatArray:
        return np.full_like(speed_mm_s, self.friction_mN)


@dataclass(frozen=True, slots=True, eq=False)
class _LoadTable:
    """The axial load of a contact, its branches interpolated linearly between points of the contact."""

    length_mm: float
    lines: FloatArray
    """Each branch as value at 0 and slope of the line between a point and the next, shape `(10, p)`."""

    @classmethod
    def of(cls, contact: HemisphereContact) -> "_LoadTable":
        """Tabulate a contact; beyond its ends the load is that at the ends."""
        x = np.linspace(0.0, contact.length_mm, TABLE_POINTS)
        branches = np.stack(astuple(contact.axial_branches(x)))
        slopes = np.diff(branches, append=branches[:, -1:]) / x[1]
        return cls(contact.length_mm, np.concatenate((branches - slopes * x, slopes)))

    def at(self, x_mm: FloatArray) -> RelaxingLoad:
        """Return the load [mN/mm] at contact coordinates."""
        x = np.minimum(np.maximum(x_mm, 0.0), self.length_mm)
        lines = self.lines.take((x * ((TABLE_POINTS - 1) / self.length_mm)).astype(np.intp), axis=1)
        branches = lines[5:]
        branches *= x
        branches += lines[:5]
        return RelaxingLoad(*branches)


@dataclass(slots=True)
class _GutWall(Resistance):
    """Friction in the gut: f_e and f_v, and Coulomb friction under weight and wall.

    The wall in contact is known at points: `z_mm`, when each was touched, and the length of wall that it stands for, in
    `points`, shape `(3, n)`.
    `lead_mm` is where the front contact is; `leading` the direction whose hemisphere presses against the wall. The age
    of the wall jumps where the robot rested: at `jumps_mm`, rising, where two points of no length hold both ages.
    """

    contact: HemisphereContact
    table: _LoadTable
    side: RelaxingLoad
    weight_mN: float
    reach_mm: float
    points: FloatArray
    jumps_mm: FloatArray
    led_s: float
    """When wall was last brought into contact."""
    lead_mm: float = 0.0
    leading: int = 1
    constant: ClassVar[bool] = False
    max_panel_s: ClassVar[float] = MAX_PANEL_S
    max_travel_mm: ClassVar[float] = MAX_TRAVEL_MM

    @classmethod
    def inserted(cls, contact: HemisphereContact, weight_mN: float, dwell_s: float) -> "_GutWall":
        """Begin with a capsule that was inserted `dwell_s` ago."""
        length, side = contact.length_mm, contact.model.side_contact_mm
        nodes, weights = gauss_legendre(INSERTED_NODES)
        edges = np.array([-length - side, -side, -length, 0.0]) if side > length else np.array([-length - side, 0.0])
        widths = np.diff(np.sort(edges))
        z = (np.sort(edges)[:-1, None] + widths[:, None] * nodes).ravel()
        return cls(
            contact=contact,
            table=_LoadTable.of(contact),
            side=contact.side_pressure(),
            weight_mN=weight_mN,
            reach_mm=length + side,
            points=np.stack((z, np.full_like(z, -dwell_s), (widths[:, None] * weights).ravel())),
            jumps_mm=np.empty(0),
            led_s=-dwell_s,
        )

    def at_rest(self) -> Callable[[float], float]:
        z, touched, length = self._near()
        load = self.table.at(self._contact_coordinate(z, self.lead_mm))
        side_touched = float(self._side_touched(np.array([self.lead_mm]))[0])

        def force(time_s: float) -> float:
            environment = load.force(time_s - touched) @ length
            return float(environment + self._coulomb(np.asarray(max(time_s - side_touched, 0.0))))

        return force

    def damping(self, speed_mm_s: FloatArray) -> FloatArray:
        faster = np.maximum(speed_mm_s, 0.0) + SPEED_STEP_MM_S
        more, less = self._viscous(np.stack((faster, speed_mm_s)))
        return np.asarray((more - less) / (faster - speed_mm_s))

    def _viscous(self, speed_mm_s: FloatArray) -> FloatArray:
        """Return f_v, in proportion to the speed where it would otherwise grow infinitely steeply."""
        model = self.contact.model
        least = model.regularisation_mm_s
        share = np.minimum(speed_mm_s / least, 1.0)
        return share * viscous_force(np.maximum(speed_mm_s, least), model, self.contact.area_mm2)

    def _contact_coordinate(self, z_mm: FloatArray, lead_mm: FloatArray | float) -> FloatArray:
        return lead_mm - z_mm if self.leading > 0 else z_mm - (lead_mm - self.reach_mm)

    def _inherited(self, time_s: FloatArray, lead_mm: FloatArray) -> FloatArray:
        """Return f_e of the wall that was in contact before, at times of shape `(n,)`."""
        z, touched, length = self._near()
        x = self._contact_coordinate(z, lead_mm[:, None])
        return np.asarray(self.table.at(x).force(time_s[:, None] - touched) @ length)

    def _near(self) -> FloatArray:
        """Return the points at the leading hemisphere."""
        if self.leading > 0:
            return self.points[:, int(np.searchsorted(self.points[0], self._equator(self.lead_mm))) :]
        return self.points[:, : int(np.searchsorted(self.points[0], self._equator(self.lead_mm), side="right"))]

    def _side_touched(self, lead_mm: FloatArray) -> FloatArray:
        """Return when the wall at the equator of the leading hemisphere was touched."""
        return np.interp(self._equator(lead_mm), *self.points[:2])

    def _equator(self, lead_mm: Millimetres) -> Millimetres:
        length = self.table.length_mm
        return lead_mm - length if self.leading > 0 else lead_mm - (self.reach_mm - length)

    def _coulomb(self, age_s: FloatArray) -> FloatArray:
        """Return Coulomb friction by the age of the wall at the equator."""
        return np.asarray(self.contact.model.friction_coefficient * (self.weight_mN + self.side.force(age_s)))

    def sliding(
        self, direction: int, start_s: float, width_s: float, position_mm: FloatArray, speed_mm_s: FloatArray
    ) -> FloatArray:
        rule = _rule()
        time = start_s + width_s * rule.nodes
        lead = self._lead(direction, position_mm)
        environment = self._inherited(time, lead)
        if direction == self.leading and lead[-1] != self.lead_mm:
            environment = environment + self._fresh(width_s, speed_mm_s)
        friction = self._coulomb(np.maximum(time - self._side_touched(lead), 0.0))
        return np.asarray(environment + friction + self._viscous(speed_mm_s))

    def _lead(self, direction: int, position_mm: FloatArray) -> FloatArray:
        if direction != self.leading:
            return np.full_like(position_mm, self.lead_mm)
        if direction > 0:
            return np.maximum(position_mm, self.lead_mm)
        return np.minimum(position_mm + REVERSAL_SLACK_MM, self.lead_mm)

    def _fresh(self, width_s: float, speed_mm_s: FloatArray) -> FloatArray:
        """Return f_e of the wall that this panel brings into contact, integrated over the time of passing."""
        rule = _rule()
        speed = np.maximum(speed_mm_s, 0.0)
        passing_speed = np.maximum(rule.within @ speed, 0.0).reshape(NODES, FRESH_NODES)
        travelled = width_s * (rule.within_integral @ speed).reshape(NODES, FRESH_NODES)
        total = width_s * (rule.integral @ speed)
        x = total[:, None] - travelled
        age = width_s * rule.nodes[:, None] * (1 - rule.fresh_nodes)
        load = self.table.at(x).force(age) * passing_speed
        return np.asarray((load @ rule.fresh_weights) * (width_s * rule.nodes))

    def way_left(self, direction: int, position_mm: float) -> float:
        behind = self.lead_mm - position_mm  # between 0 and the play
        to_lead = behind if direction > 0 else REVERSAL_SLACK_MM - behind
        if direction != self.leading or to_lead > EVENT_TOLERANCE_MM:
            return to_lead
        equator, nearest = self._equator(self.lead_mm), direction * EVENT_TOLERANCE_MM
        number = int(np.searchsorted(self.jumps_mm, equator + nearest)) - (direction < 0)
        return abs(float(self.jumps_mm[number]) - equator) if 0 <= number < self.jumps_mm.size else np.inf

    def advance(self, slip: "Slip") -> None:
        direction = slip.direction
        if direction != self.leading:
            if self.way_left(direction, slip.end_mm) <= EVENT_TOLERANCE_MM:
                self.leading = direction
                self.led_s = float(self.points[1, -1 if direction > 0 else 0])
            return
        end = float(self._lead(direction, np.array([slip.end_mm]))[0])
        travel = abs(end - self.lead_mm)
        if travel <= EVENT_TOLERANCE_MM:
            return
        points = next((count for count, reach in WALL_POINTS if travel < reach), NODES)
        times, weights, values = _wall_points(points)
        position = slip.start_mm + direction * (values @ slip.travel_mm)
        length = slip.width_s * weights * np.maximum(values @ slip.speed_mm_s, 0.0)
        fresh = np.stack((self._lead(direction, position), slip.start_s + slip.width_s * times, length))
        jumps = self.jumps_mm
        if slip.start_s - self.led_s > MIN_PANEL_S:
            rested = [[self.lead_mm, self.lead_mm], [self.led_s, slip.start_s], [0.0, 0.0]]
            fresh = np.concatenate((rested, fresh), axis=1)
            jump = self.lead_mm if direction > 0 else self.lead_mm - self.reach_mm
            jumps = np.append(jumps, jump) if direction > 0 else np.insert(jumps, 0, jump)
        self.lead_mm, self.led_s = end, slip.end_s
        if direction > 0:
            kept = self.points[:, self.points[0] >= end - self.reach_mm]
            self.points, self.jumps_mm = np.hstack((kept, fresh)), jumps[jumps >= end - self.reach_mm]
        else:
            fresh[0] -= self.reach_mm
            kept = self.points[:, self.points[0] <= end]
            self.points, self.jumps_mm = np.hstack((fresh[:, ::-1], kept)), jumps[jumps <= end]

    def moved(self, time_s: float, way_mm: float) -> Self:
        return replace(
            self,
            points=self.points + np.array([[way_mm], [time_s], [0.0]]),
            jumps_mm=self.jumps_mm + way_mm,
            led_s=self.led_s + time_s,
            lead_mm=self.lead_mm + way_mm,
        )

    def difference(self, before: Self) -> float:
        sizes = [(wall.points.size, wall.jumps_mm.size, wall.leading) for wall in (self, before)]
        if sizes[0] != sizes[1]:
            return np.inf
        return max(abs(self.lead_mm - before.lead_mm), float(np.abs(self.points - before.points).max()))


@dataclass(frozen=True, slots=True, eq=False)
class Slip:
    """A panel of a slip: speeds and forces at its Gauss points, counted in the direction of the slip."""

    start_s: float
    width_s: float
    direction: int
    since_s: float
    """When the slip began."""
    start_mm: float
    start_speed_mm_s: float
    acceleration_mm_s2: FloatArray
    speed_mm_s: FloatArray
    travel_mm: FloatArray
    resistance_mN: FloatArray
    end_speed_mm_s: float
    end_travel_mm: float

    @property
    def end_s(self) -> float:
        """When it ends."""
        return self.start_s + self.width_s

    @property
    def end_mm(self) -> float:
        """Where it ends."""
        return self.start_mm + self.direction * self.end_travel_mm

    @property
    def first_stop_s(self) -> float:
        """Time from its begin to where the speed is first 0."""
        return self._time_of(lambda motion: -self.direction * motion[1], 0.0)

    def time_of(self, travel_mm: float) -> float:
        """Return the time from its begin to where it has travelled so far, within its own travel."""
        return self._time_of(lambda motion: self.direction * (motion[0] - self.start_mm), travel_mm)

    def _time_of(self, quantity: Callable[[tuple[FloatArray, ...]], FloatArray], value: float) -> float:
        """Return the time from its begin to where a quantity of its motion rises to a value; its width if never."""
        places = np.linspace(0.0, 1.0, 65)
        rising = quantity(self.at(self.start_s + self.width_s * places))
        reached = np.flatnonzero(rising[1:] >= value)
        after = int(reached[0]) + 1 if reached.size else 64
        share = (value - rising[after - 1]) / max(rising[after] - rising[after - 1], 1e-300)
        return float(self.width_s * (places[after - 1] + share * places[1]))

    @property
    def loss_uJ(self) -> float:
        """Work of the friction; mN · mm is µJ."""
        return float(self.width_s * (gauss_legendre(NODES)[1] @ (self.resistance_mN * self.speed_mm_s)))

    def moved(self, time_s: float, way_mm: float) -> "Slip":
        """Return the same slip so much later and further on."""
        return replace(
            self, start_s=self.start_s + time_s, since_s=self.since_s + time_s, start_mm=self.start_mm + way_mm
        )

    def at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return position [mm], velocity [mm/s] and friction [mN, against positive motion] at times within it."""
        place = np.clip((time_s - self.start_s) / self.width_s, 0.0, 1.0)
        speed = self.start_speed_mm_s + self.width_s * (interpolation(place, 1) @ self.acceleration_mm_s2)
        travel = self.width_s * (
            place * self.start_speed_mm_s + self.width_s * (interpolation(place, 2) @ self.acceleration_mm_s2)
        )
        friction = interpolation(place, 0) @ self.resistance_mN
        return self.start_mm + self.direction * travel, self.direction * speed, self.direction * friction


@dataclass(frozen=True, slots=True)
class Period:
    """A period of a walk; energies in µJ."""

    begin_s: float
    begin_mm: float
    end_mm: float
    forwards_mm: float
    backwards_mm: float
    """`forwards_mm`, `backwards_mm`: slip in either direction."""
    work_uJ: float
    """Work of the actuator; what it takes back is subtracted."""
    loss_uJ: float
    """Work lost to friction."""
    begin_kinetic_uJ: float
    end_kinetic_uJ: float
    first_slip: int
    """Number of its first slip in the walk."""

    def moved(self, time_s: float, way_mm: float, first_slip: int) -> "Period":
        """Return the same period so much later and further on."""
        return replace(
            self,
            begin_s=self.begin_s + time_s,
            begin_mm=self.begin_mm + way_mm,
            end_mm=self.end_mm + way_mm,
            first_slip=first_slip,
        )

    @property
    def travel_mm(self) -> float:
        """Travel of the housing."""
        return self.end_mm - self.begin_mm


def energy_error(periods: Sequence[Period]) -> float:
    """Return the work that is neither lost to friction nor kinetic, over the loss; 0 where nothing slips."""
    loss = sum(period.loss_uJ for period in periods)
    work = sum(period.work_uJ for period in periods)
    stored = periods[-1].end_kinetic_uJ - periods[0].begin_kinetic_uJ
    return abs(work - loss - stored) / loss if loss > 0 else 0.0


@dataclass(frozen=True, slots=True)
class _State:
    """All that the walk after a period depends on; time and place count from the period's end."""

    velocity_mm_s: float
    since_s: float
    resistance: Resistance

    def repeats(self, before: "_State", speed_mm_s: float) -> bool:
        """Whether it is an earlier state, speeds compared with the drive's."""
        if abs(self.velocity_mm_s - before.velocity_mm_s) > REPEAT_SPEED * speed_mm_s:
            return False
        slips_as_long = self.velocity_mm_s == 0 or abs(self.since_s - before.since_s) <= REPEAT_TOLERANCE
        return slips_as_long and self.resistance.difference(before.resistance) <= REPEAT_TOLERANCE


class _Ending(Enum):
    """Why a panel ends: the phase does or the panel is long enough, the robot stops, or the resistance jumps."""

    PHASE = auto()
    STOP = auto()
    JUMP = auto()


@dataclass(slots=True)
class Walker:
    """A robot as it walks, from rest."""

    robot: RobotSettings
    drive: RobotDrive
    resistance: Resistance
    added: AddedForce | None = None
    time_s: float = 0.0
    position_mm: float = 0.0
    velocity_mm_s: float = 0.0
    since_s: float = 0.0
    first_slip: int = 0
    """`since_s`, `first_slip`: when the present slip began, and number of the present period's first panel."""
    slips: list[Slip] = field(default_factory=list)
    periods: list[Period] = field(default_factory=list)
    may_copy: bool = True
    """Whether periods are copied once they repeat themselves."""
    settled_periods: int = 0
    """How many periods were simulated before they did; 0 where they do not yet."""
    _state: _State | None = None
    _alike: int = 0
    """State at the end of the last period, and how many periods long it has been the same."""

    def period(self) -> Period:
        """Walk for a period."""
        made = self._copied_period() if self.settled_periods else self._simulated_period()
        self.periods.append(made)
        if self.may_copy and not self.settled_periods:
            self._compare_states()
        return made

    def _copied_period(self) -> Period:
        """Repeat the last period."""
        before, time_s = self.periods[-1], self.drive.period_s
        self.first_slip = len(self.slips)
        self.slips += [slip.moved(time_s, before.travel_mm) for slip in self.slips[before.first_slip :]]
        self.time_s, self.position_mm = self.time_s + time_s, self.position_mm + before.travel_mm
        self.since_s += time_s
        self.resistance = self.resistance.moved(time_s, before.travel_mm)
        return before.moved(time_s, before.travel_mm, self.first_slip)

    def _compare_states(self) -> None:
        """Find whether the period ended in the state in which it began."""
        before, since_s = self._state, self.since_s - self.time_s
        self._state = _State(self.velocity_mm_s, since_s, self.resistance.moved(-self.time_s, -self.position_mm))
        same = before is not None and self._state.repeats(before, self.drive.peak_speed_mm_s)
        self._alike = self._alike + 1 if same else 0
        if self._alike > 1:
            self.settled_periods = len(self.periods)

    def _simulated_period(self) -> Period:
        begin_mm, begin_uJ, relative_mm_s, work = self.position_mm, self._kinetic_uJ, 0.0, 0.0
        first = self.first_slip = len(self.slips)
        begin_s = self.time_s
        # Spans of constant acceleration.
        for relative_mm_s2, phases in groupby(self.drive.phases, key=itemgetter(1)):
            duration_s = sum(duration for duration, _ in phases)
            end_s, number = self.time_s + duration_s, len(self.slips)
            self._phase(self.time_s, end_s, relative_mm_s2)
            gained = relative_mm_s2 * duration_s
            work += 0.5 * self._inner * ((relative_mm_s + gained) ** 2 - relative_mm_s**2)
            for slip in self.slips[number:]:
                relative = relative_mm_s + relative_mm_s2 * (slip.start_s + slip.width_s * _rule().nodes - self.time_s)
                power = float(_rule().weights @ (slip.acceleration_mm_s2 * relative))
                work += self._inner * slip.direction * slip.width_s * power
            relative_mm_s += gained
            self.time_s = end_s
        loss = sum(slip.loss_uJ for slip in self.slips[first:])
        forward = sum(slip.end_travel_mm for slip in self.slips[first:] if slip.direction > 0)
        backward = sum(slip.end_travel_mm for slip in self.slips[first:] if slip.direction < 0)
        return Period(
            begin_s,
            begin_mm,
            self.position_mm,
            forward,
            backward,
            work,
            loss,
            begin_uJ,
            self._kinetic_uJ,
            first,
        )

    def sample(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return position [mm], velocity [mm/s] and friction of a slip [mN] at rising times; at rest no friction."""
        position, velocity, friction = np.zeros((3, time_s.size))
        begins, ends = np.searchsorted(time_s, [(slip.start_s, slip.end_s) for slip in self.slips] or [(0, 0)]).T
        after = np.searchsorted([slip.end_s for slip in self.slips], time_s, side="right")
        position[:] = np.array([0.0, *(slip.end_mm for slip in self.slips)])[after]
        for number in np.flatnonzero(ends > begins):
            inside = slice(begins[number], ends[number])
            position[inside], velocity[inside], friction[inside] = self.slips[number].at(time_s[inside])
        return position, velocity, friction

    @property
    def _inner(self) -> float:
        return MN_PER_G_MM_S2 * self.robot.inner_mass_g

    @property
    def _total(self) -> float:
        return MN_PER_G_MM_S2 * self.robot.mass_g

    @property
    def _kinetic_uJ(self) -> float:
        """Kinetic energy while the inner mass rests in the housing."""
        return 0.5 * self._total * self.velocity_mm_s**2

    @property
    def _tolerance_mm_s(self) -> float:
        return SPEED_TOLERANCE * self.drive.peak_speed_mm_s

    def _phase(self, begin_s: float, end_s: float, relative_mm_s2: float) -> None:
        """Go through a phase of constant relative acceleration."""
        push = -self._inner * relative_mm_s2
        time = begin_s
        while end_s - time > MIN_PANEL_S:
            if self.velocity_mm_s == 0.0:
                start = self._start(push, time, end_s)
                if start is None:
                    return
                time = self.since_s = start
                direction = 1 if push > 0 else -1
            else:
                direction = 1 if self.velocity_mm_s > 0 else -1
            time = self._advance(direction, push * direction, time, end_s)

    def _start(self, push: float, time_s: float, end_s: float) -> float | None:
        """Return when the capsule at rest starts, None where it stays."""
        direction = 1 if push > 0 else -1

        if push == 0:
            return None
        resting = self.resistance.at_rest()
        added = 0.0 if self.added is None else float(self.added.resistance(direction, 0.0))

        def excess(time: float) -> float:
            return abs(push) - max(resting(time) + added, 0.0)

        if excess(time_s) > 0:
            return time_s
        if excess(end_s) <= 0:
            return None
        root, report = brentq(excess, time_s, end_s, xtol=1e-12, full_output=True)
        return float(root) if report.converged and end_s - root > MIN_PANEL_S else None

    def _advance(self, direction: int, push: float, time_s: float, end_s: float) -> float:
        """Slip for a panel, up to an event; return when it ends."""
        whole = (end_s - time_s) / max(np.ceil((end_s - time_s) / self.resistance.max_panel_s - 1e-9), 1.0)
        ahead = min(self.resistance.way_left(direction, self.position_mm), self.resistance.max_travel_mm)
        acceleration, width, ending = self._expected(direction, push, time_s, whole)
        for _ in range(MAX_ITERATIONS):
            panel = self._solve(direction, push, time_s, width, acceleration)
            halved = panel.width_s < width
            if panel.end_travel_mm > ahead + TRAVEL_TOLERANCE_MM:
                width, ending = panel.time_of(ahead), _Ending.JUMP
            elif ending is _Ending.STOP:
                if abs(panel.end_speed_mm_s) <= self._tolerance_mm_s:
                    break
                braking = float(_rule().at_end @ panel.acceleration_mm_s2)
                width = panel.width_s - panel.end_speed_mm_s / min(braking, -1e-6)
            elif panel.end_speed_mm_s < 0 or float(panel.speed_mm_s.min()) < 0:
                width, ending = panel.first_stop_s, _Ending.STOP
            elif ending is _Ending.JUMP and panel.end_travel_mm < ahead - TRAVEL_TOLERANCE_MM and not halved:
                width = panel.width_s + (ahead - panel.end_travel_mm) / max(panel.end_speed_mm_s, 1e-6)
            else:
                break
            if width > whole:
                width, ending = whole, _Ending.PHASE
            width = max(width, MIN_PANEL_S)
            # Extrapolated far, the polynomial is worse than its last value.
            places = np.minimum(_rule().nodes * (width / panel.width_s), 1.2)
            acceleration = interpolation(places, 0) @ panel.acceleration_mm_s2
        self._take(panel)
        return panel.end_s

    def _expected(
        self, direction: int, push: float, time_s: float, whole_s: float
    ) -> tuple[FloatArray, float, _Ending]:
        """Return accelerations to begin with, and how wide the next panel will be and why."""
        before = None if self.resistance.constant else self._same_slip_before(direction, time_s)
        if before is not None:
            if before.end_speed_mm_s <= 2 * self._tolerance_mm_s:
                return before.acceleration_mm_s2, before.width_s, _Ending.STOP
            if before.width_s < 0.999 * whole_s:
                return before.acceleration_mm_s2, before.width_s, _Ending.JUMP
            return before.acceleration_mm_s2, whole_s, _Ending.PHASE
        goes_on = self.velocity_mm_s != 0
        resistance = float(self.slips[-1].resistance_mN[-1]) if goes_on else self.resistance.at_rest()(time_s)
        acceleration = (push - resistance) / self._total
        stop_s = abs(self.velocity_mm_s) / -acceleration if acceleration < 0 and goes_on else np.inf
        ending = _Ending.STOP if stop_s < whole_s else _Ending.PHASE
        return np.full(NODES, acceleration), min(stop_s, whole_s), ending

    def _same_slip_before(self, direction: int, time_s: float) -> Slip | None:
        """Return the panel of the period before at the same place in its period."""
        if not self.periods:
            return None
        number = self.periods[-1].first_slip + len(self.slips) - self.first_slip
        if number >= self.first_slip:
            return None
        before = self.slips[number]
        same_place = abs(before.start_s + self.drive.period_s - time_s) < 0.1 * before.width_s
        return before if same_place and before.direction == direction else None

    def _solve(
        self, direction: int, push: float, time_s: float, width_s: float, acceleration_mm_s2: FloatArray
    ) -> Slip:
        """Solve the equation of motion at the Gauss points, by Newton's method with the slope of viscous friction.

        A panel in which that does not converge is halved.
        """
        for _ in range(MAX_HALVINGS):
            panel = self._iterate(direction, push, time_s, width_s, acceleration_mm_s2)
            if panel is not None:
                return panel
            width_s *= 0.5
        raise AnalysisError(
            f"The robot's motion at {time_s:.4f} s cannot be integrated, because the friction changes too steeply; "
            "use a model with smaller effects."
        )

    def _iterate(
        self, direction: int, push: float, time_s: float, width_s: float, acceleration_mm_s2: FloatArray
    ) -> Slip | None:
        rule = _rule()
        start_speed, acceleration = abs(self.velocity_mm_s), acceleration_mm_s2
        travel_before = speed_before = resistance_before = np.zeros(NODES)
        stiffness = STIFFNESS
        for count in range(MAX_ITERATIONS):
            speed = start_speed + width_s * (rule.integral @ acceleration)
            travel = width_s * (rule.nodes * start_speed + width_s * (rule.double_integral @ acceleration))
            position = self.position_mm + direction * travel
            resistance = self.resistance.sliding(direction, time_s, width_s, position, speed)
            if self.added is not None:
                since = time_s + width_s * rule.nodes - self.since_s
                resistance = np.maximum(resistance + self.added.resistance(direction, since), 0.0)
            wanted = (push - resistance) / self._total
            residual = float(np.abs(width_s * (rule.integral @ (wanted - acceleration))).max())
            if residual <= self._tolerance_mm_s or (self.resistance.constant and self.added is None):
                return Slip(
                    start_s=time_s,
                    width_s=width_s,
                    direction=direction,
                    since_s=self.since_s,
                    start_mm=self.position_mm,
                    start_speed_mm_s=start_speed,
                    acceleration_mm_s2=wanted,
                    speed_mm_s=start_speed + width_s * (rule.integral @ wanted),
                    travel_mm=travel,
                    resistance_mN=resistance,
                    end_speed_mm_s=float(start_speed + width_s * (rule.weights @ wanted)),
                    end_travel_mm=float(width_s * (start_speed + width_s * ((1 - rule.nodes) * rule.weights @ wanted))),
                )
            damping = self.resistance.damping(speed)
            if count:
                # The wall's stiffness, from the step before: without it each step would win but a digit.
                moved = travel - travel_before
                stiffened = resistance - resistance_before - damping * (speed - speed_before)
                square = float(moved @ moved)
                stiffness = min(max(float(moved @ stiffened) / square, 0.0), MAX_STIFFNESS) if square else stiffness
            travel_before, speed_before, resistance_before = travel, speed, resistance
            jacobian = (
                np.eye(NODES)
                + (width_s / self._total) * damping[:, None] * rule.integral
                + (width_s**2 * stiffness / self._total) * rule.double_integral
            )
            acceleration = acceleration + np.linalg.solve(jacobian, wanted - acceleration)
        return None

    def _take(self, panel: Slip) -> None:
        self.slips.append(panel)
        self.resistance.advance(panel)
        self.position_mm = panel.end_mm
        stopped = panel.end_speed_mm_s <= 2 * self._tolerance_mm_s
        self.velocity_mm_s = 0.0 if stopped else panel.direction * panel.end_speed_mm_s


def hard_ground(robot: RobotSettings) -> Resistance:
    """Return a hard surface, on which the robot has Coulomb friction alone."""
    return _HardSurface(robot.hard_friction_coefficient * robot.mass_g * GRAVITY_M_S2)


def gut(robot: RobotSettings, model: FrictionModelSettings, wall_thickness_mm: float) -> Resistance:
    """Return the gut around a robot that was inserted; raises `SettingsError` for a wall that is not positive."""
    contact = HemisphereContact.of(robot.capsule, wall_thickness_mm, model)
    dwell_s = robot.insertion_dwell_s * model.insertion_dwell_scale
    return _GutWall.inserted(contact, robot.mass_g * GRAVITY_M_S2, dwell_s)


def walk(
    robot: RobotSettings, drive: RobotDrive, surface: Resistance, periods: int, *, may_copy: bool = True
) -> Walker:
    """Return a robot that has walked from rest for some periods; none is copied without `may_copy`."""
    walker = Walker(robot, drive, surface, may_copy=may_copy)
    for _ in range(periods):
        walker.period()
    return walker
