"""Random functions with one promised property each: rising, fading, periodic, a single hump, steps, or without any.

Every draw is another function: cumulative integrals of random positive densities, mixed with powers and soft steps;
random Fourier series with uneven duty and sharpened crests. Nothing but the property is common to two draws.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dragrig.sim_backend.blind import Floats

POINTS = 129
"""Values that a function is stored by; the narrowest feature drawn, 0.03 of the axis, covers four of them."""


@dataclass(frozen=True, slots=True)
class RandomLaw:
    """A drawn function of one coordinate, by its values at equal distances."""

    values: tuple[float, ...]
    """At u = 0 … 1; a periodic law has its first value again at the end."""
    course: Literal["smooth", "periodic", "steps"] = "smooth"
    """`smooth` is monotone between neighbouring values (PCHIP) and constant beyond the ends; `periodic` has period 1;
    `steps` holds each value up to the next."""

    def __call__(self, u: Floats | float) -> Floats:
        """Return the function at `u`, of the shape of `u`."""
        from scipy.interpolate import CubicSpline, PchipInterpolator

        at, values = np.asarray(u, dtype=np.float64), np.array(self.values)
        if self.course == "steps":
            return np.asarray(values[np.clip(np.floor(at * values.size), 0, values.size - 1).astype(int)])
        grid = np.linspace(0.0, 1.0, values.size)
        if self.course == "periodic":
            return np.asarray(CubicSpline(grid, values, bc_type="periodic")(np.mod(at, 1.0)))
        return np.asarray(PchipInterpolator(grid, values)(np.clip(at, 0.0, 1.0)))


LawFamily = Callable[[np.random.Generator], RandomLaw]
"""What a law is drawn from."""


def rising(random: np.random.Generator) -> RandomLaw:
    """Draw a function that rises from 0 to 1, bent to either side or stepped."""
    return _rising(random, tilt=float(random.normal(0.0, 1.5)), stepped=0.4)


def rising_late(random: np.random.Generator) -> RandomLaw:
    """Draw a function that rises from 0 to 1 far more steeply at its end: the last third has most of the rise."""
    law = _rising(random, tilt=float(random.uniform(3.0, 6.0)), stepped=0.0)
    early = float(law(2 / 3))
    power = max(np.log(0.45) / np.log(early), 1.0)
    return RandomLaw(tuple((np.array(law.values) ** power).tolist()))


def rising_soft(random: np.random.Generator) -> RandomLaw:
    """Draw a function that rises from 0 to 1 without steps, its slope within a factor of some six."""
    return _rising(random, tilt=float(random.normal(0.0, 0.7)), stepped=0.0, rough=0.35)


def _rising(random: np.random.Generator, *, tilt: float, stepped: float, rough: float = 0.8) -> RandomLaw:
    u = np.linspace(0.0, 1.0, POINTS)
    density = np.exp(rough * _smooth_noise(random, u) + tilt * (u - 0.5))
    grown = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2)])
    parts, weights = [grown / grown[-1]], [1.0]
    if random.random() < stepped:
        for _ in range(int(random.integers(1, 4))):
            place, width = random.uniform(0.1, 0.9), 0.03 * 6.0 ** random.random()
            step = np.tanh((u - place) / width)
            parts.append((step - step[0]) / (step[-1] - step[0]))
            weights.append(float(random.uniform(0.2, 1.0)))
    values = np.maximum.accumulate(np.average(parts, axis=0, weights=weights))
    return RandomLaw(tuple((values / values[-1]).tolist()))


def _smooth_noise(random: np.random.Generator, u: Floats) -> Floats:
    """Return a stationary random function of about unit size; its correlation length is drawn too."""
    length = 0.08 * 5.0 ** random.random()
    waves = random.normal(0.0, 1 / length, 24)
    phases = random.uniform(0.0, 2 * np.pi, 24)
    return np.asarray(np.cos(np.outer(u, waves) + phases).sum(axis=1) * np.sqrt(2 / 24))


def fading(random: np.random.Generator) -> RandomLaw:
    """Draw a function that falls from 1 to 0 on u = s / (1 + s), half of it gone at s = 1; see `faded`."""
    rise = _rising(random, tilt=float(random.normal(0.0, 1.0)), stepped=0.25)
    u = np.linspace(0.0, 1.0, POINTS)
    half = float(np.interp(0.5, np.array(rise.values), u))
    # Stretched such that the half value lies at u = 0.5, where s = 1.
    power = np.log(half) / np.log(0.5)
    return RandomLaw(tuple((1 - rise(u**power)).tolist()))


def faded(law: RandomLaw, s: Floats) -> Floats:
    """Return a `fading` law at a distance, age or speed `s` over its half value, from 0 to infinity."""
    s = np.maximum(s, 0.0)
    return law(s / (1 + s))


def periodic(random: np.random.Generator) -> RandomLaw:
    """Draw a function of period 1, without mean, of the root mean square of a sine of amplitude 1.

    Random harmonics that fade with their number, a duty other than one half, and crests that may be sharpened.
    """
    turn = np.linspace(0.0, 1.0, 2 * POINTS - 1)
    # The duty: the phase runs faster over one part of the period than over the other.
    uneven, at = random.uniform(0.0, 0.9), random.random()
    warped = turn + uneven / (2 * np.pi) * (np.sin(2 * np.pi * (turn - at)) + np.sin(2 * np.pi * at))
    order, decay = np.arange(1, 9), random.uniform(0.9, 3.0)
    size = np.abs(random.normal(0.6, 0.4, order.size)) * order**-decay
    size[0] = 1.0
    wave = np.cos(2 * np.pi * np.outer(warped, order) + random.uniform(0.0, 2 * np.pi, order.size)) @ size
    if random.random() < 0.4:
        wave = np.exp(random.uniform(0.5, 1.6) * random.choice([-1.0, 1.0]) * wave)
    wave[-1] = wave[0]
    wave = wave - wave[:-1].mean()
    return RandomLaw(tuple((wave / (np.sqrt(2) * wave[:-1].std())).tolist()), "periodic")


def pulses(random: np.random.Generator) -> RandomLaw:
    """Draw pulses of period 1 from 0 to 1: a rise and a fall of their own shapes, and quiet in between."""
    turn, active = np.linspace(0.0, 1.0, 2 * POINTS - 1), random.uniform(0.25, 0.9)
    values = hump(random)(turn / active) * (turn <= active)
    values[-1] = values[0]
    return RandomLaw(tuple(values.tolist()), "periodic")


def hump(random: np.random.Generator) -> RandomLaw:
    """Draw a function that rises from 0 to 1 and falls to 0 again, at different rates."""
    u, top = np.linspace(0.0, 1.0, POINTS), random.uniform(0.25, 0.75)
    up, down = rising_soft(random), rising_soft(random)

    def eased(part: Floats) -> Floats:
        return part * part * (3 - 2 * part)

    values = np.where(u < top, eased(up(u / top)), eased(1 - down((u - top) / (1 - top))))
    return RandomLaw(tuple((values / values.max()).tolist()))


def steps(random: np.random.Generator) -> RandomLaw:
    """Draw a few levels without mean, of unit size, each held for a random stretch of the axis."""
    levels = random.normal(0.0, 1.0, POINTS)
    changes = np.cumsum(random.random(POINTS) < random.uniform(0.03, 0.12))
    if changes[0] == changes[-1]:
        # No change was drawn; a single level less its mean is rounding, not a law.
        values = np.where(np.arange(POINTS) < POINTS // 2, -1.0, 1.0)
        values = values - values.mean()
    else:
        values = levels[changes] - levels[changes].mean()
    return RandomLaw(tuple((values / values.std()).tolist()), "steps")


def wandering(random: np.random.Generator) -> RandomLaw:
    """Draw a smooth function without mean, of unit size, that is neither monotone nor periodic."""
    u = np.linspace(0.0, 1.0, POINTS)
    values = np.cos(np.outer(u, random.normal(0.0, 14.0, 24)) + random.uniform(0.0, 2 * np.pi, 24)).sum(axis=1)
    values = values - values.mean()
    return RandomLaw(tuple((values / values.std()).tolist()))
