"""Force on a capsule that slides: f_e + f_v + f_c at any times of a motion (Eq. 1)."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import groupby

import numpy as np
from scipy.interpolate import PPoly

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.contact import HemisphereContact, SidePressure
from dragrig.sim_backend.friction.environment import EnvironmentalResistance
from dragrig.sim_backend.friction.history import ContactHistory, Stroke
from dragrig.sim_backend.friction.motion import Motion
from dragrig.sim_backend.friction.panels import graded_edges, interpolate
from dragrig.sim_backend.friction.quadrature import FINE, Rule
from dragrig.sim_backend.friction.stretches import Stretch, joined, stretches
from dragrig.sim_backend.friction.viscous import viscous_force

GRAVITY_M_S2 = 9.80665
"""Standard gravity; g · m/s² = mN."""

ELEMENTS = ("e1_scale", "e2_scale", "e3_scale", "eta1_scale", "eta2_scale")
"""Scales of the five elements in a model's settings."""


@dataclass(frozen=True, slots=True, eq=False)
class Components:
    """The three parts of the friction [mN], each of the shape of the times asked for."""

    f_e: FloatArray
    f_v: FloatArray
    f_c: FloatArray

    @property
    def total(self) -> FloatArray:
        """Their sum (Eq. 1)."""
        return self.f_e + self.f_v + self.f_c


@dataclass(frozen=True, slots=True, eq=False)
class SlidingForce:
    """Friction of a sliding run, prepared for any sample times.

    `resistance` is f_e interpolated on `stretches` and `side` the radial force of the wall; both are None where the gut
    is held open, so that it presses on nothing. `spans` are the stretches joined as far as they are evaluated at once.
    `motion` is what friction takes its velocity from where that is not the history's, which leaves the shortest ways
    back out.
    """

    contact: HemisphereContact
    history: ContactHistory
    weight_mN: float
    stretches: tuple[Stretch, ...]
    spans: tuple[Stretch, ...]
    resistance: PPoly | None
    side: SidePressure | None
    motion: Motion | None = None
    rule: Rule = FINE

    @classmethod
    def of(
        cls,
        contact: HemisphereContact,
        history: ContactHistory,
        mass_g: float,
        pressing: bool,
        rule: Rule = FINE,
        motion: Motion | None = None,
    ) -> "SlidingForce":
        """Evaluate f_e on its knots."""
        parts = tuple(stretches(history, contact.length_mm))
        environment = EnvironmentalResistance.of(contact, history, rule)
        return cls(
            contact=contact,
            history=history,
            weight_mN=mass_g * GRAVITY_M_S2,
            stretches=parts,
            spans=tuple(joined(parts)),
            resistance=_interpolated(environment.at, contact.fastest_rate, parts, rule) if pressing else None,
            side=contact.side_pressure() if pressing else None,
            motion=None if motion is history.motion else motion,
            rule=rule,
        )

    def total(self, time_s: FloatArray) -> FloatArray:
        """f_e + f_v + f_c [mN] at any times [s]."""
        return self.components(time_s).total

    def components(self, time_s: FloatArray) -> Components:
        """f_e, f_v and f_c at any times [s]; before the motion's start and after its end they stay as there."""
        time = np.clip(np.asarray(time_s, dtype=float), 0.0, self.history.motion.breaks_s[-1])
        flat = time.ravel()
        order = None if bool((flat[1:] >= flat[:-1]).all()) else np.argsort(flat, kind="stable")
        rising = flat if order is None else flat[order]
        parts = np.empty((3, flat.size))
        for stretch, piece in self._divided(rising):
            self._fill(parts[:, piece], stretch, rising[piece])
        if order is not None:
            back = np.empty_like(parts)
            back[:, order] = parts
            parts = back
        f_e, f_v, f_c = parts.reshape(3, *time.shape)
        return Components(f_e, f_v, f_c)

    def by_element(self, time_s: FloatArray) -> FloatArray:
        """Return the total's derivatives by the logarithms of E1, E2, E3, η1, η2, rising times `(n,)` to `(5, n)`."""
        slopes = np.zeros((len(ELEMENTS), time_s.size))
        if self.side is None:
            return slopes
        environment = EnvironmentalResistance.of(self.contact, self.history, self.rule)
        resistance = _interpolated(environment.by_element, self.contact.fastest_rate, self.stretches, self.rule)
        time = np.clip(time_s, 0.0, self.history.motion.breaks_s[-1])
        for stretch, piece in self._divided(time):
            at = np.array([0.5 * (stretch.begin_s + stretch.end_s)]) if stretch.steady else time[piece]
            slopes[:, piece] = resistance(at).T
            if stretch.sign or self.motion is not None:
                pressing = self.contact.side_pressure_by_element(self._equator_age(stretch, at))
                slopes[:, piece] += pressing * self._turned(self._velocity(time[piece]))
        return slopes

    def _divided(self, rising_s: FloatArray) -> Iterator[tuple[Stretch, slice]]:
        begins = np.searchsorted(rising_s, np.array([one.begin_s for one in self.spans[1:]]), side="left")
        edges = [0, *begins.tolist(), rising_s.size]
        for stretch, begin, end in zip(self.spans, edges[:-1], edges[1:], strict=True):
            if end > begin:
                yield stretch, slice(begin, end)

    def _fill(self, parts: FloatArray, stretch: Stretch, time_s: FloatArray) -> None:
        """Write f_e, f_v and f_c; what is constant in the stretch is evaluated once, in its middle."""
        middle = np.array([0.5 * (stretch.begin_s + stretch.end_s)])
        parts[0] = 0.0 if self.resistance is None else self.resistance(middle if stretch.steady else time_s)
        if stretch.sign == 0 and self.motion is None:
            parts[1:] = 0.0
            return
        velocity = self._velocity(middle if stretch.uniform and self.motion is None else time_s)
        parts[1] = viscous_force(velocity, self.contact.model, self.contact.area_mm2)
        parts[2] = self._normal_force(stretch, middle if stretch.steady else time_s)
        parts[2] *= self._turned(velocity)

    def _velocity(self, time_s: FloatArray) -> FloatArray:
        return (self.motion or self.history.motion).velocity(time_s)

    def _turned(self, velocity_mm_s: FloatArray) -> FloatArray:
        """Friction over normal force, with the sign of the velocity (Eq. 12)."""
        model = self.contact.model
        return np.asarray(model.friction_coefficient * np.tanh(velocity_mm_s / model.regularisation_mm_s))

    def _normal_force(self, stretch: Stretch, time_s: FloatArray) -> FloatArray:
        """N = m g + P(L) S [mN] (Eq. 13), with the contact age of the wall now at the equator."""
        if self.side is None:
            return np.full_like(time_s, self.weight_mN)
        return self.weight_mN + self.side.force(self._equator_age(stretch, time_s))

    def _equator_age(self, stretch: Stretch, time_s: FloatArray) -> FloatArray:
        position = self.history.motion.position(time_s)
        at_equator = self.history.wall_at(stretch.stroke, self.contact.length_mm, position)
        return np.maximum(time_s - self.history.begin(stretch.side, at_equator), 0.0)


def _interpolated(
    evaluate: Callable[[Stroke, FloatArray], FloatArray], rate: float, parts: tuple[Stretch, ...], rule: Rule
) -> PPoly:
    """Interpolate f_e, or what belongs to it, stroke by stroke: one panel where it is steady, graded ones elsewhere."""
    pieces: list[PPoly] = []
    for _, group in groupby(parts, key=lambda part: part.stroke.first):
        stroke_parts = list(group)
        edges = [np.array([stroke_parts[0].begin_s])]
        for part in stroke_parts:
            ends = [part.end_s] if part.steady else graded_edges(part.begin_s, part.end_s, rate)[1:]
            edges.append(np.asarray(ends))
        pieces.append(interpolate(partial(evaluate, stroke_parts[0].stroke), np.concatenate(edges), rule.times))
    edges = [piece.x if index == 0 else piece.x[1:] for index, piece in enumerate(pieces)]
    return PPoly(np.concatenate([piece.c for piece in pieces], axis=1), np.concatenate(edges))
