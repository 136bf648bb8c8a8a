"""Environmental resistance f_e of a contact history, by Gauss–Legendre quadrature over contact ages (Eq. 9)."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from dragrig.rig.arrays import FloatArray, read_only
from dragrig.sim_backend.friction.contact import HemisphereContact
from dragrig.sim_backend.friction.history import ContactHistory, Segment, Stroke

NODES = 10
"""Gauss–Legendre nodes per panel."""

FIRST_PANEL = 0.5
"""Width of the freshest panel, in relaxation times of the fastest branch."""

PANEL_RATIO = 5.0
"""How much older each panel's end is than its start."""

SLIVER_S = 1e-12
"""Panels shorter than this are left out."""


@dataclass(frozen=True, slots=True, eq=False)
class EnvironmentalResistance:
    """f_e at any time of a contact history, exact but for the quadrature."""

    contact: HemisphereContact
    history: ContactHistory
    ages_s: FloatArray
    nodes: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, contact: HemisphereContact, history: ContactHistory, nodes: int = NODES) -> "EnvironmentalResistance":
        """Lay out the panels: geometric in age, as the fast branch relaxes within milliseconds of first contact."""
        longest = float(history.motion.breaks_s[-1])
        ages = panel_ages(contact.fastest_rate, longest)
        return cls(contact, history, ages, *gauss_legendre(nodes))

    def at(self, stroke: Stroke, time_s: FloatArray) -> FloatArray:
        """f_e [mN] at times of shape `(n,)` within a stroke, of the stroke's sign."""
        position = self.history.motion.position(time_s)
        total = np.zeros_like(time_s)
        for segment in (*stroke.found, stroke.fresh):
            if segment.direction == 0:
                total += self._inserted(stroke, segment, time_s, position)
            else:
                total += self._passed(stroke, segment, time_s, position)
        return stroke.direction * total

    def _inserted(self, stroke: Stroke, segment: Segment, time_s: FloatArray, position_mm: FloatArray) -> FloatArray:
        """Contribution of wall that has been in contact since the insertion: one age for all of it."""
        ends = [self.history.travelled(stroke, z, position_mm) for z in (segment.rear_mm, segment.front_mm)]
        low, high = np.sort(np.clip(ends, 0.0, self.contact.length_mm), axis=0)
        rows = np.flatnonzero(high > low)
        width = 0.5 * (high - low)[rows, None]
        nodes = np.concatenate((self.nodes, 1 + self.nodes))
        weights = np.concatenate((self.weights, self.weights))
        x = low[rows, None] + width * nodes
        load = self.contact.axial_load(x, self.history.dwell_s + time_s[rows, None])
        total = np.zeros_like(time_s)
        total[rows] = (load @ weights) * width[:, 0]
        return total

    def _passed(self, stroke: Stroke, segment: Segment, time_s: FloatArray, position_mm: FloatArray) -> FloatArray:
        """Contribution of wall that a stroke passed, integrated over the time of passing."""
        youngest, oldest = self._age_limits(stroke, segment, time_s, position_mm)
        breaks = self.history.motion.breaks_s[segment.first + 1 : segment.last + 1]
        edges = np.concatenate(
            (np.broadcast_to(self.ages_s, (time_s.size, self.ages_s.size)), time_s[:, None] - breaks), axis=1
        )
        edges = np.sort(np.clip(edges, youngest[:, None], oldest[:, None]), axis=1)
        rows, columns = np.nonzero(np.diff(edges, axis=1) > SLIVER_S)
        begin = edges[rows, columns]
        width = edges[rows, columns + 1] - begin
        age = begin[:, None] + width[:, None] * self.nodes
        passed, velocity = self.history.motion.along(time_s[rows, None] - age)
        z = passed if segment.direction > 0 else passed - self.history.reach_mm
        x = np.clip(self.history.travelled(stroke, z, position_mm[rows, None]), 0.0, self.contact.length_mm)
        load = self.contact.axial_load(x, age) * np.abs(velocity)
        return np.bincount(rows, (load @ self.weights) * width, minlength=time_s.size).astype(float)

    def _age_limits(
        self, stroke: Stroke, segment: Segment, time_s: FloatArray, position_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Youngest and oldest age of the part of a segment that the hemisphere covers, equal where there is none."""
        covered = [self.history.wall_at(stroke, x, position_mm) for x in (0.0, self.contact.length_mm)]
        ends = np.clip(covered, segment.rear_mm, segment.front_mm)
        ages = time_s - self.history.begin(segment, ends)
        empty = ends[0] == ends[1]
        youngest, oldest = np.sort(np.maximum(ages, 0.0), axis=0)
        return youngest, np.where(empty, youngest, oldest)


def panel_ages(fastest_rate: float, longest_s: float) -> FloatArray:
    """Return the ends of quadrature panels in age, from 0 to at least `longest_s`."""
    first = FIRST_PANEL / fastest_rate
    count = max(1, int(np.ceil(np.log(max(longest_s, first) / first) / np.log(PANEL_RATIO))) + 1)
    return np.concatenate(([0.0], first * PANEL_RATIO ** np.arange(count)))


@cache
def gauss_legendre(nodes: int) -> tuple[FloatArray, FloatArray]:
    """Nodes and weights of the quadrature on (0, 1)."""
    at, weights = np.polynomial.legendre.leggauss(nodes)
    at, weights = 0.5 * (1 + at), 0.5 * weights
    read_only(at)
    read_only(weights)
    return at, weights
