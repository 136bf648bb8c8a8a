"""The friction of one acquisition, prepared for any sample times: the capsule slides, sticks, or touches nothing.

A sliding capsule has f_e + f_v + f_c (Eq. 1); a sticking one shears the wall (relaxation test). The steady curves are
the paper's Figs. 9 (friction against speed) and 7 (skew resistance along the contact).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import groupby
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from dragrig.config import AnalysisError, Capsule, Fixture, FrictionModelSettings, SettingsError
from dragrig.rig import Acquisition, Contact, FloatArray, read_only
from dragrig.sim_backend.friction.contact import (
    COUNTED_RULE,
    FINE_RULE,
    ContactHistory,
    ContactStroke,
    EnvironmentalResistance,
    PanelPolynomials,
    QuadratureRule,
    SmoothInterval,
    age_panel_edges,
    gauss_legendre,
    interpolate_panels,
    join_intervals,
    leading_motion,
    smooth_intervals,
    time_panel_edges,
)
from dragrig.sim_backend.friction.motion import Motion, ProfileMotion
from dragrig.sim_backend.friction.wall import HemisphereContact, MaxwellBranches, RelaxingLoad, model_wall

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
    resistance: PanelPolynomials | None
    side: RelaxingLoad | None
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
        first_samples = np.searchsorted(rising_s, np.array([span.begin_s for span in self.spans[1:]]), side="left")
        edges = [0, *first_samples.tolist(), rising_s.size]
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
) -> PanelPolynomials:
    """Interpolate f_e or its derivatives by strokes: one panel in steady intervals, graded panels elsewhere."""
    pieces: list[PanelPolynomials] = []
    for _, group in groupby(parts, key=lambda part: part.stroke.first):
        stroke_parts = list(group)
        edges = [np.array([stroke_parts[0].begin_s])]
        for part in stroke_parts:
            ends = [part.end_s] if part.steady else time_panel_edges(part.begin_s, part.end_s, rate)[1:]
            edges.append(np.asarray(ends))
        pieces.append(interpolate_panels(partial(evaluate, stroke_parts[0].stroke), np.concatenate(edges), rule.times))
    edges = [piece.edges_s if index == 0 else piece.edges_s[1:] for index, piece in enumerate(pieces)]
    return PanelPolynomials(np.concatenate([piece.coefficients for piece in pieces], axis=1), np.concatenate(edges))


SKEW_SEARCH_POINTS = 2000
"""Points of the contact among which the largest skew resistance is sought before it is refined."""


@dataclass(frozen=True, slots=True, eq=False)
class SteadyFriction:
    """Friction at steady speeds, arrays of shape `(n,)`."""

    speed_mm_s: FloatArray
    f_e: FloatArray
    f_v: FloatArray
    f_c: FloatArray
    total: FloatArray
    """`f_e`, `f_v`, `f_c`, `total`: environmental resistance, viscous and Coulomb friction, and their sum [mN]."""
    side_pressure_force: FloatArray
    """Radial force P(L) S [mN], the part of N that the wall gives."""
    max_skew: FloatArray
    x_of_max_skew: FloatArray
    """`max_skew`, `x_of_max_skew`: largest skew resistance P(x) S [mN] on the contact, and where it is [mm]."""


def steady_forces(
    speeds_mm_s: npt.ArrayLike, model: FrictionModelSettings, capsule: Capsule, wall_thickness_mm: float
) -> SteadyFriction:
    """Friction of a capsule that has moved at constant speed for longer than its contact.

    Raises `SettingsError` for a speed that is not positive, or wall parameters that are not positive on the contact.
    """
    speed = _positive_speeds(speeds_mm_s)
    contact = HemisphereContact.of(capsule, wall_thickness_mm, model)
    side = contact.side_pressure().force(contact.length_mm / speed)
    f_e = _steady_resistance(contact, speed)
    f_v = viscous_force(speed, model, contact.area_mm2)
    normal = capsule.mass_g * GRAVITY_M_S2 + side
    f_c = model.friction_coefficient * normal * np.tanh(speed / model.regularisation_mm_s)
    max_skew, x_of_max_skew = _largest_skew(contact, speed)
    return SteadyFriction(speed, f_e, f_v, f_c, f_e + f_v + f_c, side, max_skew, x_of_max_skew)


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
                f"shear_strain {strain:g} of run {acquisition.run_id!r} is beyond the range in which wall {model.wall} "
                f"of model {model.name!r} has positive parameters; use a smaller strain, Table 1 ends at 2"
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
            branches=MaxwellBranches.integrate(np.array([float(rate) for rate in wall.rates]), pieces, thickness),
        )

    def stresses(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the stress [kPa] in fast branch, slow branch and spring at any times, constant beyond the motion."""
        time = np.clip(np.asarray(time_s, dtype=float), 0.0, self.duration_s)
        fast, slow = self.branches.stress(time)
        spring = self.spring * (self.sheared_from + self.branches.strain(time))
        return self.moduli[0] * fast, self.moduli[1] * slow, spring

    def total(self, time_s: FloatArray) -> FloatArray:
        """Return the shear force [mN] at any times [s], constant before the motion's start and after its end."""
        fast, slow, spring = self.stresses(time_s)
        return np.asarray((spring + fast + slow) * self.area_mm2)


NOT_NOMINAL = MappingProxyType({"effects": (), "identified": None, "diagnosed": None})
"""Settings of a model without influence on the nominal force, which would spoil it as a cache key."""
CACHE_SIZE = 128
"""Runs of a campaign whose forces are cached: predictions and effects ask for the same ones in turn."""
MAX_CACHED_TIMES = 4096
"""Components are cached for at most so many times: block means need few, a simulated run far more."""


@dataclass(frozen=True, slots=True)
class NoFriction:
    """A blank run: the capsule touches nothing."""

    def total(self, time_s: FloatArray) -> FloatArray:
        """Return zeros."""
        return np.zeros_like(time_s)

    def components(self, time_s: FloatArray) -> Components:
        """Return zeros."""
        return Components(*np.zeros((3, *np.shape(time_s))))


@dataclass(frozen=True, slots=True)
class PreparedForce:
    """The modelled force of one acquisition, without noise, at any sample times.

    The value at a time does not depend on the other times of the call.
    """

    friction: SlidingForce | StickingForce | NoFriction
    force_gain: float

    def force(self, time_s: FloatArray) -> FloatArray:
        """Return the force [mN] that the channel shows, of the shape of `time_s` [s]: friction times force gain."""
        return self.force_gain * self.friction.total(time_s)

    def components(self, time_s: FloatArray) -> Components:
        """Return the parts of the true friction [mN], without gain; AnalysisError where the capsule sticks."""
        if isinstance(self.friction, StickingForce):
            raise AnalysisError(
                f"The capsule sticks to the wall in run {self.friction.run_id!r}, so its force has no parts f_e, f_v "
                "and f_c; use the total force"
            )
        if time_s.ndim == 1 and time_s.size <= MAX_CACHED_TIMES:
            return _cached_components(self.friction, time_s.astype(np.float64, copy=False).tobytes())
        return self.friction.components(time_s)

    def log_derivatives(self, time_s: FloatArray) -> FloatArray:
        """Return derivatives of the shown force by the logarithms of the five elements, shape `(5, n)`.

        Parameters
        ----------
        time_s
            Rising times, shape `(n,)`.

        Raises
        ------
        AnalysisError
            Where the capsule does not slide.
        """
        if not isinstance(self.friction, SlidingForce):
            raise AnalysisError("The capsule does not slide, so its force has no such derivatives; use differences")
        return self.force_gain * self.friction.log_derivatives(time_s)


def prepare(acquisition: Acquisition, model: FrictionModelSettings, motion: Motion | None = None) -> PreparedForce:
    """Prepare the force of an acquisition: compute everything that does not depend on the sample times.

    Parameters
    ----------
    acquisition
        Motion, capsule, specimen, fixture, contact and dwell of the run.
    model
        Parameters and scales of the friction model.
    motion
        A motion to use in place of the acquisition's profile, such as a recorded one.

    Raises
    ------
    SettingsError
        Where the wall parameters are not positive at the strain of the contact or of the shear.
    """
    # Repeats share one force, so the key leaves the run's identity out; messages about a sticking capsule name the run.
    names_run = acquisition.contact is Contact.STICKING
    key = acquisition if names_run else replace(acquisition, run_id="", order=0)
    return _prepared(key, model.model_copy(update=NOT_NOMINAL), motion)


@lru_cache(maxsize=CACHE_SIZE)
def _cached_components(friction: SlidingForce | NoFriction, time_s: bytes) -> Components:
    components = friction.components(np.frombuffer(time_s))
    for part in (components.f_e, components.f_v, components.f_c):
        read_only(part)
    return components


@lru_cache(maxsize=CACHE_SIZE)
def _prepared(acquisition: Acquisition, model: FrictionModelSettings, motion: Motion | None) -> PreparedForce:
    if acquisition.contact is Contact.NONE or acquisition.fixture is Fixture.NONE:
        return PreparedForce(NoFriction(), model.force_gain)
    if motion is None:
        motion = ProfileMotion.of(acquisition.profile)
    if acquisition.contact is Contact.STICKING:
        return PreparedForce(StickingForce.of(acquisition, model, motion), model.force_gain)
    contact = HemisphereContact.of(acquisition.capsule, acquisition.specimen.wall_thickness_mm, model)
    reach = contact.length_mm + model.side_contact_mm
    dwell_s = acquisition.insertion_dwell_s * model.insertion_dwell_scale
    history = ContactHistory.of(leading_motion(motion), reach, dwell_s)
    pressing, mass_g = acquisition.fixture is Fixture.FOAM, acquisition.capsule.mass_g
    rule = COUNTED_RULE if motion.counted else FINE_RULE
    friction = SlidingForce.of(contact, history, mass_g, pressing, rule, motion)
    return PreparedForce(friction, model.force_gain)
