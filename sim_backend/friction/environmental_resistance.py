"""Environmental resistance f_e of a contact history (Eq. 9): quadrature over contact ages, interpolation in time.

Gauss–Legendre panels are geometric in contact age and Chebyshev panels geometric in time, because the fast branch
relaxes within milliseconds of first contact.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PPoly

from dragrig.rig.arrays import FloatArray, read_only
from dragrig.sim_backend.friction.contact_history import ContactHistory, ContactStroke, WallSegment
from dragrig.sim_backend.friction.motion import Motion
from dragrig.sim_backend.friction.wall import HemisphereContact


@dataclass(frozen=True, slots=True)
class QuadratureRule:
    """Nodes per panel.

    Attributes
    ----------
    ages
        Gauss–Legendre nodes of a panel of contact ages.
    times
        Chebyshev nodes of a panel of times.
    """

    ages: int
    times: int


FINE_RULE = QuadratureRule(10, 8)
COUNTED_RULE = QuadratureRule(4, 5)
"""For a motion measured in encoder counts, whose many bends divide the panels anyway: a rippling force differs by
0.03 mN r.m.s. from that of the fine rule, where a sensor's noise is 1 mN or more."""


def quadrature_rule(motion: Motion) -> QuadratureRule:
    """Return the rule for a motion."""
    return COUNTED_RULE if motion.counted else FINE_RULE


@cache
def gauss_legendre(nodes: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes and weights of the quadrature on (0, 1)."""
    at, weights = np.polynomial.legendre.leggauss(nodes)
    at, weights = 0.5 * (1 + at), 0.5 * weights
    read_only(at)
    read_only(weights)
    return at, weights


@cache
def chebyshev_nodes(nodes: int) -> tuple[FloatArray, FloatArray]:
    """Return nodes on (0, 1), and the matrix from values there to coefficients of ascending powers."""
    at = 0.5 * (1 - np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes))
    to_powers = np.asarray(np.linalg.inv(np.vander(at, increasing=True)))
    read_only(at)
    read_only(to_powers)
    return at, to_powers


FIRST_TIME_PANEL = 0.3
"""Width of the first panel after an event, in relaxation times of the fastest branch."""

TIME_PANEL_RATIO = 2.0
"""Ratio of the ends of successive panels, counted from the event."""


def time_panel_edges(begin_s: float, end_s: float, fastest_rate: float) -> FloatArray:
    """Return the ends of panels from `begin_s` to `end_s`, shortest at the beginning."""
    first = FIRST_TIME_PANEL / fastest_rate
    count = max(0, int(np.ceil(np.log((end_s - begin_s) / first) / np.log(TIME_PANEL_RATIO))))
    inner = begin_s + first * TIME_PANEL_RATIO ** np.arange(count)
    return np.concatenate(([begin_s], inner[inner < end_s], [end_s]))


def interpolate_panels(
    evaluate: Callable[[FloatArray], FloatArray], edges_s: FloatArray, nodes_per_panel: int
) -> PPoly:
    """Interpolate `evaluate`, from times of shape `(n,)` to values of shape `(…, n)`, between strictly rising edges.

    The nodes lie inside the panels, so that `evaluate` is never called at a jump.
    """
    nodes, to_powers = chebyshev_nodes(nodes_per_panel)
    width = np.diff(edges_s)
    times = edges_s[:-1, None] + width[:, None] * nodes
    at_nodes = evaluate(times.ravel())
    values = at_nodes.reshape(*at_nodes.shape[:-1], *times.shape)
    coefficients = (values @ to_powers.T) / width[:, None] ** np.arange(nodes.size)
    return PPoly(np.moveaxis(coefficients, (-1, -2), (0, 1))[::-1], edges_s)


LoadDensity: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]
"""Load per length of the contact from contact coordinates and ages of one shape; may add axes in front."""

FIRST_AGE_PANEL = 0.5
"""Width of the freshest panel, in relaxation times of the fastest branch."""

AGE_PANEL_RATIO = 5.0
"""Ratio of the ages at end and start of a panel."""

MIN_PANEL_S = 1e-12
"""Panels shorter than this are left out."""


@dataclass(frozen=True, slots=True, eq=False)
class EnvironmentalResistance:
    """f_e at any time of a contact history, exact except for the quadrature."""

    contact: HemisphereContact
    history: ContactHistory
    ages_s: FloatArray
    nodes: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, contact: HemisphereContact, history: ContactHistory, rule: QuadratureRule) -> "EnvironmentalResistance":
        """Set the panels, geometric in contact age."""
        longest = float(history.motion.breaks_s[-1])
        ages = age_panel_edges(contact.fastest_rate, longest)
        return cls(contact, history, ages, *gauss_legendre(rule.ages))

    def force(self, stroke: ContactStroke, time_s: FloatArray) -> FloatArray:
        """Return f_e [mN] at times of shape `(n,)` within a stroke, with the stroke's sign."""
        return self._integrate(self.contact.axial_load, stroke, time_s)

    def log_derivatives(self, stroke: ContactStroke, time_s: FloatArray) -> FloatArray:
        """Return derivatives of f_e [mN] by the logarithms of E1, E2, E3, η1 and η2, shape `(5, n)`."""
        return self._integrate(self.contact.axial_load_log_derivatives, stroke, time_s)

    def _integrate(self, load: LoadDensity, stroke: ContactStroke, time_s: FloatArray) -> FloatArray:
        position = self.history.motion.position(time_s)
        parts = [
            (self._inserted if segment.direction == 0 else self._passed)(load, stroke, segment, time_s, position)
            for segment in stroke.segments
        ]
        return np.asarray(stroke.direction * sum(parts[1:], start=parts[0]))

    def _inserted(
        self,
        load: LoadDensity,
        stroke: ContactStroke,
        segment: WallSegment,
        time_s: FloatArray,
        position_mm: FloatArray,
    ) -> FloatArray:
        """Return the contribution of wall in contact since the insertion, which all has the same age."""
        ends = [self.history.contact_coordinate(stroke, z, position_mm) for z in (segment.rear_mm, segment.front_mm)]
        low, high = np.sort(np.clip(ends, 0.0, self.contact.length_mm), axis=0)
        rows = np.flatnonzero(high > low)
        width = 0.5 * (high - low)[rows, None]
        nodes = np.concatenate((self.nodes, 1 + self.nodes))
        weights = np.concatenate((self.weights, self.weights))
        x = low[rows, None] + width * nodes
        per_row = (load(x, self.history.dwell_s + time_s[rows, None]) @ weights) * width[:, 0]
        total = np.zeros((*per_row.shape[:-1], time_s.size))
        total[..., rows] = per_row
        return total

    def _passed(
        self,
        load: LoadDensity,
        stroke: ContactStroke,
        segment: WallSegment,
        time_s: FloatArray,
        position_mm: FloatArray,
    ) -> FloatArray:
        """Return the contribution of wall that a stroke passed, integrated over the time of passing."""
        youngest, oldest = self._age_limits(stroke, segment, time_s, position_mm)
        breaks = self.history.motion.breaks_s[segment.first + 1 : segment.last + 1]
        edges = np.concatenate(
            (np.broadcast_to(self.ages_s, (time_s.size, self.ages_s.size)), time_s[:, None] - breaks), axis=1
        )
        edges = np.sort(np.clip(edges, youngest[:, None], oldest[:, None]), axis=1)
        rows, columns = np.nonzero(np.diff(edges, axis=1) > MIN_PANEL_S)
        begin = edges[rows, columns]
        width = edges[rows, columns + 1] - begin
        age = begin[:, None] + width[:, None] * self.nodes
        passed, velocity = self.history.motion.state_within_interval(time_s[rows, None] - age)
        z = passed if segment.direction > 0 else passed - self.history.reach_mm
        x = np.clip(self.history.contact_coordinate(stroke, z, position_mm[rows, None]), 0.0, self.contact.length_mm)
        return _sum_by_row(((load(x, age) * np.abs(velocity)) @ self.weights) * width, rows, time_s.size)

    def _age_limits(
        self, stroke: ContactStroke, segment: WallSegment, time_s: FloatArray, position_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the least and greatest age of a segment's part under the hemisphere, equal where there is none."""
        covered = [self.history.wall_point(stroke, x, position_mm) for x in (0.0, self.contact.length_mm)]
        ends = np.clip(covered, segment.rear_mm, segment.front_mm)
        ages = time_s - self.history.contact_time(segment, ends)
        empty = ends[0] == ends[1]
        youngest, oldest = np.sort(np.maximum(ages, 0.0), axis=0)
        return youngest, np.where(empty, youngest, oldest)


def _sum_by_row(values: FloatArray, rows: npt.NDArray[np.intp], size: int) -> FloatArray:
    """Sum values, shape `(…, r)`, by row number, shape `(…, size)`."""
    if values.ndim == 1:
        return np.bincount(rows, values, minlength=size).astype(float)
    return np.stack([_sum_by_row(component, rows, size) for component in values])


def age_panel_edges(fastest_rate: float, longest_s: float) -> FloatArray:
    """Return the ends of quadrature panels in age, from 0 to at least `longest_s`."""
    first = FIRST_AGE_PANEL / fastest_rate
    count = max(1, int(np.ceil(np.log(max(longest_s, first) / first) / np.log(AGE_PANEL_RATIO))) + 1)
    return np.concatenate(([0.0], first * AGE_PANEL_RATIO ** np.arange(count)))
