"""Force on a sliding capsule, f_e + f_v + f_c (Eq. 1), at any times of a motion and at steady speed.

The steady curves are the paper's Figs. 9 (friction against speed) and 7 (skew resistance along the contact).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import groupby

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PPoly

from dragrig.config.errors import SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.specimen import Capsule
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction.contact_history import (
    ContactHistory,
    ContactStroke,
    SmoothInterval,
    join_intervals,
    smooth_intervals,
)
from dragrig.sim_backend.friction.environmental_resistance import (
    FINE_RULE,
    EnvironmentalResistance,
    QuadratureRule,
    age_panel_edges,
    gauss_legendre,
    interpolate_panels,
    time_panel_edges,
)
from dragrig.sim_backend.friction.motion import Motion
from dragrig.sim_backend.friction.wall import HemisphereContact, SidePressure

SHEAR_THINNING = 11.24
"""Shear-thinning part of the apparent viscosity in Eq. 11."""
THINNING_EXPONENT = 0.7552
"""Exponent of its decrease with the shear rate."""
VISCOSITY_PLATEAU = 0.1148
"""Apparent viscosity at high shear rates."""


def viscous_force(velocity_mm_s: FloatArray, model: FrictionModelSettings, area_mm2: float) -> FloatArray:
    """Return the viscous friction f_v [mN], of the sign and shape of the velocity.

    `published` reads Eq. 10 as δ v with δ in mN·s/mm; `newtonian` as a shear stress δ (v/d) with δ in
    Pa·s, acting on the contact surface `area_mm2`.
    """
    speed = np.abs(velocity_mm_s)
    depth = model.mucus_thickness_mm
    force = SHEAR_THINNING * depth**THINNING_EXPONENT * speed ** (1 - THINNING_EXPONENT) + VISCOSITY_PLATEAU * speed
    scale = model.mucus_scale * (1.0 if model.viscous == "published" else area_mm2 / depth * 1e-3)
    return np.asarray(np.copysign(force * scale, velocity_mm_s))


GRAVITY_M_S2 = 9.80665
"""Standard gravity; g · m/s² = mN."""

ELEMENT_SCALES = ("e1_scale", "e2_scale", "e3_scale", "eta1_scale", "eta2_scale")
"""Scales of the five elements in a model's settings."""


@dataclass(frozen=True, slots=True, eq=False)
class Components:
    """The three parts of the friction [mN], each of the shape of the times."""

    f_e: FloatArray
    f_v: FloatArray
    f_c: FloatArray

    @property
    def total(self) -> FloatArray:
        """Total friction (Eq. 1)."""
        return self.f_e + self.f_v + self.f_c


@dataclass(frozen=True, slots=True, eq=False)
class SlidingForce:
    """Friction of a sliding run, prepared for any sample times.

    `resistance` is f_e interpolated on `intervals` and `side` the radial force of the wall; both are None where the gut
    is held open and does not press. `spans` are the intervals joined for joint evaluation. `motion` gives the velocity
    where it differs from that of the history, which leaves short reversals out.
    """

    contact: HemisphereContact
    history: ContactHistory
    weight_mN: float
    intervals: tuple[SmoothInterval, ...]
    spans: tuple[SmoothInterval, ...]
    resistance: PPoly | None
    side: SidePressure | None
    motion: Motion | None = None
    rule: QuadratureRule = FINE_RULE

    @classmethod
    def of(
        cls,
        contact: HemisphereContact,
        history: ContactHistory,
        mass_g: float,
        pressing: bool,
        rule: QuadratureRule = FINE_RULE,
        motion: Motion | None = None,
    ) -> "SlidingForce":
        """Evaluate f_e at the nodes of its panels."""
        parts = tuple(smooth_intervals(history, contact.length_mm))
        environment = EnvironmentalResistance.of(contact, history, rule)
        return cls(
            contact=contact,
            history=history,
            weight_mN=mass_g * GRAVITY_M_S2,
            intervals=parts,
            spans=tuple(join_intervals(parts)),
            resistance=_interpolate_strokes(environment.force, contact.fastest_rate, parts, rule) if pressing else None,
            side=contact.side_pressure() if pressing else None,
            motion=None if motion is history.motion else motion,
            rule=rule,
        )

    def total(self, time_s: FloatArray) -> FloatArray:
        """Return f_e + f_v + f_c [mN] at any times [s]."""
        return self.components(time_s).total

    def components(self, time_s: FloatArray) -> Components:
        """Return f_e, f_v and f_c at any times [s], constant before the motion's start and after its end."""
        time = np.clip(np.asarray(time_s, dtype=float), 0.0, self.history.motion.breaks_s[-1])
        flat = time.ravel()
        order = None if bool((flat[1:] >= flat[:-1]).all()) else np.argsort(flat, kind="stable")
        rising = flat if order is None else flat[order]
        parts = np.empty((3, flat.size))
        for interval, piece in self._by_interval(rising):
            self._write_components(parts[:, piece], interval, rising[piece])
        if order is not None:
            unsorted = np.empty_like(parts)
            unsorted[:, order] = parts
            parts = unsorted
        f_e, f_v, f_c = parts.reshape(3, *time.shape)
        return Components(f_e, f_v, f_c)

    def log_derivatives(self, time_s: FloatArray) -> FloatArray:
        """Return derivatives of the total by the logarithms of E1, E2, E3, η1, η2, rising times `(n,)` to `(5, n)`."""
        slopes = np.zeros((len(ELEMENT_SCALES), time_s.size))
        if self.side is None:
            return slopes
        environment = EnvironmentalResistance.of(self.contact, self.history, self.rule)
        resistance = _interpolate_strokes(
            environment.log_derivatives, self.contact.fastest_rate, self.intervals, self.rule
        )
        time = np.clip(time_s, 0.0, self.history.motion.breaks_s[-1])
        for interval, piece in self._by_interval(time):
            at = np.array([0.5 * (interval.begin_s + interval.end_s)]) if interval.steady else time[piece]
            slopes[:, piece] = resistance(at).T
            if interval.sign or self.motion is not None:
                pressing = self.contact.side_pressure_log_derivatives(self._equator_age(interval, at))
                slopes[:, piece] += pressing * self._friction_ratio(self._velocity(time[piece]))
        return slopes

    def _by_interval(self, rising_s: FloatArray) -> Iterator[tuple[SmoothInterval, slice]]:
        begins = np.searchsorted(rising_s, np.array([span.begin_s for span in self.spans[1:]]), side="left")
        edges = [0, *begins.tolist(), rising_s.size]
        for interval, begin, end in zip(self.spans, edges[:-1], edges[1:], strict=True):
            if end > begin:
                yield interval, slice(begin, end)

    def _write_components(self, parts: FloatArray, interval: SmoothInterval, time_s: FloatArray) -> None:
        """Write f_e, f_v and f_c (Eqs. 9, 10, 12, 13); constants of the interval are evaluated once, in its middle."""
        middle = np.array([0.5 * (interval.begin_s + interval.end_s)])
        parts[0] = 0.0 if self.resistance is None else self.resistance(middle if interval.steady else time_s)
        if interval.sign == 0 and self.motion is None:
            parts[1:] = 0.0
            return
        velocity = self._velocity(middle if interval.uniform and self.motion is None else time_s)
        parts[1] = viscous_force(velocity, self.contact.model, self.contact.area_mm2)
        parts[2] = self.weight_mN
        if self.side is not None:
            parts[2] += self.side.force(self._equator_age(interval, middle if interval.steady else time_s))
        parts[2] *= self._friction_ratio(velocity)

    def _velocity(self, time_s: FloatArray) -> FloatArray:
        return (self.motion or self.history.motion).velocity(time_s)

    def _friction_ratio(self, velocity_mm_s: FloatArray) -> FloatArray:
        """Return Coulomb friction over normal force, with the sign of the velocity (Eq. 12)."""
        model = self.contact.model
        return np.asarray(model.friction_coefficient * np.tanh(velocity_mm_s / model.regularisation_mm_s))

    def _equator_age(self, interval: SmoothInterval, time_s: FloatArray) -> FloatArray:
        position = self.history.motion.position(time_s)
        at_equator = self.history.wall_point(interval.stroke, self.contact.length_mm, position)
        return np.maximum(time_s - self.history.contact_time(interval.side, at_equator), 0.0)


def _interpolate_strokes(
    evaluate: Callable[[ContactStroke, FloatArray], FloatArray],
    rate: float,
    parts: tuple[SmoothInterval, ...],
    rule: QuadratureRule,
) -> PPoly:
    """Interpolate f_e or its derivatives by strokes: one panel in steady intervals, graded panels elsewhere."""
    pieces: list[PPoly] = []
    for _, group in groupby(parts, key=lambda part: part.stroke.first):
        stroke_parts = list(group)
        edges = [np.array([stroke_parts[0].begin_s])]
        for part in stroke_parts:
            ends = [part.end_s] if part.steady else time_panel_edges(part.begin_s, part.end_s, rate)[1:]
            edges.append(np.asarray(ends))
        pieces.append(interpolate_panels(partial(evaluate, stroke_parts[0].stroke), np.concatenate(edges), rule.times))
    edges = [piece.x if index == 0 else piece.x[1:] for index, piece in enumerate(pieces)]
    return PPoly(np.concatenate([piece.c for piece in pieces], axis=1), np.concatenate(edges))


SKEW_SEARCH_POINTS = 2000
"""Points of the contact among which the largest skew resistance is sought before it is refined."""


@dataclass(frozen=True, slots=True, eq=False)
class SteadyForces:
    """Friction at steady speeds, arrays of shape `(n,)`.

    Attributes
    ----------
    f_e, f_v, f_c, total
        Environmental resistance, viscous and Coulomb friction, and their sum [mN].
    side_pressure_force
        Radial force P(L) S [mN], the part of N that the wall gives.
    max_skew, x_of_max_skew
        Largest skew resistance P(x) S [mN] on the contact, and where it is [mm].
    """

    speed_mm_s: FloatArray
    f_e: FloatArray
    f_v: FloatArray
    f_c: FloatArray
    total: FloatArray
    side_pressure_force: FloatArray
    max_skew: FloatArray
    x_of_max_skew: FloatArray


def steady_forces(
    speeds_mm_s: npt.ArrayLike, model: FrictionModelSettings, capsule: Capsule, wall_thickness_mm: float
) -> SteadyForces:
    """Friction of a capsule that has moved at constant speed for longer than its contact.

    Raises
    ------
    SettingsError
        For a speed that is not positive, or a contact that the wall parameters do not reach.
    """
    speed = _positive_speeds(speeds_mm_s)
    contact = HemisphereContact.of(capsule, wall_thickness_mm, model)
    side = contact.side_pressure().force(contact.length_mm / speed)
    f_e = _steady_resistance(contact, speed)
    f_v = viscous_force(speed, model, contact.area_mm2)
    normal = capsule.mass_g * GRAVITY_M_S2 + side
    f_c = model.friction_coefficient * normal * np.tanh(speed / model.regularisation_mm_s)
    max_skew, x_of_max_skew = _largest_skew(contact, speed)
    return SteadyForces(speed, f_e, f_v, f_c, f_e + f_v + f_c, side, max_skew, x_of_max_skew)


def skew_resistance(
    x_mm: npt.ArrayLike,
    speed_mm_s: npt.ArrayLike,
    model: FrictionModelSettings,
    capsule: Capsule,
    wall_thickness_mm: float,
) -> FloatArray:
    """Skew resistance P(x) S [mN] at contact coordinates and speeds that broadcast against each other.

    Beyond the equator, where x = L, it keeps its value for the length of the side contact; beyond that
    and before the contact it is zero (section 3.3 of the paper). Raises as `steady_forces`.
    """
    contact = HemisphereContact.of(capsule, wall_thickness_mm, model)
    x, speed = np.broadcast_arrays(np.asarray(x_mm, dtype=float), _positive_speeds(speed_mm_s))
    on_contact = np.clip(x, 0.0, contact.length_mm)
    touching = (x >= 0) & (x < contact.length_mm + model.side_contact_mm)
    return np.where(touching, _skew_resistance(contact, on_contact, speed), 0.0)


def _positive_speeds(speeds_mm_s: npt.ArrayLike) -> FloatArray:
    speed = np.asarray(speeds_mm_s, dtype=float)
    if not (np.isfinite(speed) & (speed > 0)).all():
        raise SettingsError("Steady friction needs speeds above 0 mm/s")
    return speed


def _skew_resistance(contact: HemisphereContact, x_mm: FloatArray, speed_mm_s: FloatArray) -> FloatArray:
    return contact.pressure(x_mm, x_mm / speed_mm_s) * contact.area_mm2


def _steady_resistance(contact: HemisphereContact, speed_mm_s: FloatArray) -> FloatArray:
    """Integrate Eq. 9 over the contact, in panels that are geometric in contact age."""
    nodes, weights = gauss_legendre(FINE_RULE.ages)
    ages = age_panel_edges(contact.fastest_rate, float(np.max(contact.length_mm / speed_mm_s, initial=1.0)))
    edges = np.minimum(ages * speed_mm_s[:, None], contact.length_mm)
    width = np.diff(edges, axis=1)[..., None]
    x = edges[:, :-1, None] + width * nodes
    load = contact.axial_load(x, x / speed_mm_s[:, None, None])
    return np.asarray((load * weights * width).sum(axis=(1, 2)))


def _largest_skew(contact: HemisphereContact, speed_mm_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Largest P(x) S and its x, sought twice: on the whole contact, then around the best point."""
    low, high = np.zeros_like(speed_mm_s), np.full_like(speed_mm_s, contact.length_mm)
    rows = np.arange(speed_mm_s.size)
    for _ in range(2):
        x = np.linspace(low, high, SKEW_SEARCH_POINTS, axis=1)
        skew = _skew_resistance(contact, x, speed_mm_s[:, None])
        best = skew.argmax(axis=1)
        low, high = x[rows, np.maximum(best - 1, 0)], x[rows, np.minimum(best + 1, SKEW_SEARCH_POINTS - 1)]
    return skew[rows, best], x[rows, best]
