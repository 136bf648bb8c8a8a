"""Findings on the pressure along the contact: its history, its maximum, and how it becomes one force."""

from collections.abc import Callable, Iterator

import numpy as np

from dragrig.analysis.paper.finding import Finding, Number, percent, spelled
from dragrig.analysis.paper.printed import CAPSULE, HIGHEST_MM_S, LOWEST_MM_S, MODEL, WALL_THICKNESS_MM
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.friction import WallParameters, steady_forces
from dragrig.sim_backend.friction.contact import HemisphereContact
from dragrig.sim_backend.friction.wall import model_wall

SPEED_MM_S = 20.0
POINTS = 20_001


def findings() -> Iterator[Finding]:
    """Yield the findings."""
    yield _history()
    yield _pointwise()
    yield _maximum()


def _contact() -> HemisphereContact:
    return HemisphereContact.of(CAPSULE, WALL_THICKNESS_MM, MODEL)


def _along() -> tuple[FloatArray, FloatArray]:
    """Return x on the contact and the hoop strain there, shape `(POINTS,)`."""
    contact = _contact()
    x = np.linspace(0.0, contact.length_mm, POINTS)
    radius = np.sqrt(contact.radius_mm**2 - (contact.length_mm - x) ** 2)
    return x, radius / (contact.radius_mm * np.cos(contact.angle_rad)) - 1


def by_superposition(speed_mm_s: float) -> float:
    """Hoop stress at the equator [kPa] when each branch is integrated along the growing strain, parameters of ε(L)."""
    x, strain = _along()
    wall = model_wall(MODEL, float(strain[-1]))
    age = (x[-1] - x) / speed_mm_s
    growth, middle = np.diff(strain), 0.5 * (age[:-1] + age[1:])
    stress = float(wall.E3 * strain[-1])
    for modulus, rate in zip((wall.E1, wall.E2), wall.rates, strict=True):
        stress += float(modulus * (growth @ np.exp(-middle * rate)))
    return stress


def as_published(speed_mm_s: float) -> float:
    """Hoop stress at the equator [kPa] by Eq. 4."""
    x, strain = _along()
    wall = model_wall(MODEL, float(strain[-1]))
    age = float(x[-1]) / speed_mm_s
    fast, slow = wall.rates
    return float(strain[-1] * (wall.E1 * np.exp(-age * fast) + wall.E2 * np.exp(-age * slow) + wall.E3))


def _history() -> Finding:
    speeds = (LOWEST_MM_S, SPEED_MM_S, HIGHEST_MM_S)
    numbers, ratios = [], []
    for speed in speeds:
        published, integrated = as_published(speed), by_superposition(speed)
        ratios.append(integrated / published - 1)
        numbers += [
            Number(f"stress at the equator by Eq. 4, {speed:g} mm/s", published, "kPa"),
            Number(f"the same elements along the strain's history, {speed:g} mm/s", integrated, "kPa"),
        ]
    by_speed = ", ".join(f"{percent(ratio)} at {speed:g} mm/s" for ratio, speed in zip(ratios, speeds, strict=True))
    return Finding(
        "strain-history",
        "A growing strain is treated as a step",
        "Eqs. 3 and 4",
        "Eq. 3 holds for a strain applied at once; Eq. 4 puts t = x / v into it for wall whose strain grows from 0 to "
        "ε(x) on its way.",
        tuple(numbers),
        "Eq. 4 lets all of the strain relax since the first touch, though part of it came later. Integrating the same "
        f"elements along the path raises the stress at the equator by {by_speed}.",
        "The simulator follows Eq. 4, with the contact age in place of x / v; relaxation runs are integrated through "
        "their ramp.",
    )


def _pointwise() -> Finding:
    contact = _contact()
    x, _ = _along()
    point = contact.pressure(x, x / SPEED_MM_S) * contact.area_mm2 * (contact.length_mm - x) / contact.radius_mm
    top = int(point.argmax())
    f_e = float(steady_forces([SPEED_MM_S], MODEL, CAPSULE, WALL_THICKNESS_MM).f_e[0])
    return Finding(
        "pointwise",
        "Eq. 9 is a different force at every point",
        "Eq. 9",
        "The environmental resistance is P(x) S sin θ; which x is meant is not said.",
        (
            Number(f"largest P S sin θ, {SPEED_MM_S:g} mm/s", float(point[top]), "mN", 4),
            Number("where", float(x[top]), "mm"),
            Number("P S sin θ at the equator", float(point[-1]), "mN"),
            Number("mean of P S sin θ over the contact", float(np.trapezoid(point, x) / x[-1]), "mN"),
            Number("integral of P sin θ over the surface", f_e, "mN"),
        ),
        f"At {SPEED_MM_S:g} mm/s it is {spelled(point[top])} mN at x = {spelled(x[top], 2)} mm and 0 at the equator. "
        f"Since S = 2 π R L, its mean over x is exactly the integral of the pressure's axial part over the contact, "
        f"{spelled(f_e)} mN.",
        "f_e is the integral; the pointwise curve P(x) S is drawn in Fig. 7.",
    )


def _maximum() -> Finding:
    speeds = np.geomspace(LOWEST_MM_S, HIGHEST_MM_S, 200)
    at = steady_forces(speeds, MODEL, CAPSULE, WALL_THICKNESS_MM).x_of_max_skew
    length = _contact().length_mm
    constant = model_wall(MODEL, 0.5)
    where = {
        "moduli that fall with strain, no relaxation": _top(lambda strain: model_wall(MODEL, strain), np.inf),
        "moduli that fall with strain, fully relaxed": _top(lambda strain: model_wall(MODEL, strain), 0.0),
        "constant moduli, no relaxation": _top(lambda _: constant, np.inf),
        "constant moduli, fully relaxed": _top(lambda _: constant, 0.0),
        f"constant moduli, relaxing at {SPEED_MM_S:g} mm/s": _top(lambda _: constant, SPEED_MM_S),
    }
    fresh, relaxed, *_, aged = where.values()
    return Finding(
        "maximum",
        "The skew resistance peaks inside the contact, for another reason than given",
        "Section 3.3, Fig. 7, Eqs. 4 and 7",
        "The maximum lies before the point of largest strain; the strain rate's influence on the stress is named as "
        "the reason.",
        (
            Number("contact length L, where the strain is largest", length, "mm"),
            Number(f"nearest maximum, {LOWEST_MM_S:g} … {HIGHEST_MM_S:g} mm/s", float(at.min()), "mm"),
            Number(f"farthest maximum, {LOWEST_MM_S:g} … {HIGHEST_MM_S:g} mm/s", float(at.max()), "mm"),
            *(Number(f"x of the maximum: {case}", value, "mm") for case, value in where.items()),
        ),
        f"It lies at {spelled(at.min(), 2)} to {spelled(at.max(), 2)} mm of {spelled(length)} mm. No strain rate "
        "enters "
        "Eqs. 4 and 7; two other things bring the maximum forward. The moduli fall with strain: this alone moves it to "
        f"{spelled(relaxed)} mm in relaxed wall (in fresh wall it stays at {spelled(fresh)} mm). And wall further back "
        f"has been relaxing for longer: with constant moduli this alone moves it to {spelled(aged)} mm at "
        f"{SPEED_MM_S:g} mm/s.",
        "The curve and its maximum are computed for any speed, and drawn.",
    )


def _top(wall: Callable[[FloatArray], WallParameters], speed_mm_s: float) -> float:
    """Return the x at which P is largest; a speed of 0 is relaxed wall, an infinite one fresh wall."""
    x, strain = _along()
    moduli = wall(strain)
    fast, slow = moduli.rates
    age = np.full_like(x, np.inf) if speed_mm_s == 0 else x / speed_mm_s
    stress = strain * (moduli.E1 * np.exp(-age * fast) + moduli.E2 * np.exp(-age * slow) + moduli.E3)
    return float(x[(stress / (1 + strain)).argmax()])
