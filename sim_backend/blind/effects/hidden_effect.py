"""A hidden effect: a frozen value with an amplitude, shape parameters, and hooks where it acts.

Also the linear systems and the rate-independent hysteresis that several share, sampled with the record.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar, Self, cast
from zlib import crc32

import numpy as np

from dragrig.sim_backend.blind import Floats, RunPlan, SampledMotion
from dragrig.sim_backend.blind.effects.random_laws import LawFamily, RandomLaw

DRAG_RUNS = frozenset({"drag"})
SLIDING_RUNS = frozenset({"drag", "coulomb"})
TISSUE_RUNS = frozenset({"drag", "relaxation"})
ALL_RUNS = frozenset({"drag", "coulomb", "relaxation", "blank"})
SIGN_CHANGE_MM_S = 0.05
"""Speed over which the sign of the velocity changes at standstill."""


@dataclass(frozen=True, slots=True)
class DrawnFrom:
    """Range that a parameter is drawn from: uniform, or uniform in its logarithm, or of either sign."""

    low: float
    high: float
    log: bool = False
    signed: bool = False

    def __call__(self, random: np.random.Generator) -> float:
        """Return one value."""
        u = random.random()
        value = self.low * (self.high / self.low) ** u if self.log else self.low + (self.high - self.low) * u
        return float(value * (random.choice([-1.0, 1.0]) if self.signed else 1.0))


in_log = partial(DrawnFrom, log=True)
"""A range that a parameter is drawn from uniformly in its logarithm."""
signed = partial(DrawnFrom, signed=True)
"""A range of absolute values; the sign is drawn too."""
PHASE = DrawnFrom(0.0, 2 * np.pi)


@dataclass(frozen=True, slots=True)
class OneOf:
    """A choice with the weight of each alternative; its value is the number of the alternative, from 0."""

    weights: tuple[float, ...]

    def __call__(self, random: np.random.Generator) -> float:
        """Return one number."""
        return float(random.choice(len(self.weights), p=np.array(self.weights) / sum(self.weights)))


@dataclass(frozen=True, slots=True)
class RunConditions:
    """The facts of a run that a hidden effect may depend on: its plan, the commanded and the true motion."""

    plan: RunPlan
    seed: int
    command: SampledMotion
    motion: SampledMotion

    @property
    def session_s(self) -> Floats:
        """Time since the session began [s], shape `(N,)`."""
        return self.plan.start_s + self.motion.t

    @property
    def direction(self) -> Floats:
        """Sign of the true velocity, smooth about standstill, shape `(N,)`."""
        return np.tanh(self.motion.v / SIGN_CHANGE_MM_S)

    @property
    def speed(self) -> Floats:
        """Absolute velocity [mm/s], shape `(N,)`."""
        return np.abs(self.motion.v)

    @property
    def held_s(self) -> Floats:
        """Time since the stop [s], shape `(N,)`; 0 before it."""
        return np.maximum(self.motion.t - self.plan.bounds_s[3], 0.0)

    def random(self, purpose: str) -> np.random.Generator:
        """Return the run's random generator for one purpose, always in its initial state."""
        later = (self.plan.specimen,) if self.plan.specimen else ()
        return np.random.default_rng((self.seed, self.plan.order, crc32(purpose.encode()), *later))


@dataclass(frozen=True, slots=True)
class CapsuleForces:
    """Forces on the capsule [mN]: elastic, viscous, Coulomb, and the normal force, each of shape `(N,)`."""

    elastic: Floats
    viscous: Floats
    coulomb: Floats
    normal: Floats


@dataclass(frozen=True)
class HiddenEffect:
    """A hidden effect: a form, which overrides the hooks of the location where it acts, with values of its parameters.

    `name` is an id of the catalogue, or another for an effect outside it; `form` is the functional form. Parameters are
    attributes, drawn from `ranges` in their order; the size scales `amplitude` alone. Laws are drawn functions.
    """

    parameters: Mapping[str, float]
    laws: Mapping[str, RandomLaw] = field(default_factory=dict)

    name: ClassVar[str]
    form: ClassVar[str]
    kinds: ClassVar[frozenset[str]] = ALL_RUNS
    rank: ClassVar[int] = 0
    """Order in the chain from the force to the record: 0 mechanics, 1 sensor, 2 amplifier, 3 acquisition."""
    channel: ClassVar[str] = "force"
    weight: ClassVar[float] = 1.0
    """How often it is drawn beside other forms of its name, where a plant weighs them."""
    ranges: ClassVar[Mapping[str, DrawnFrom | OneOf | LawFamily]]

    def __getattr__(self, name: str) -> float:
        if name == "parameters" or name not in self.parameters:
            raise AttributeError(f"{type(self).__name__} has no parameter {name}")
        return self.parameters[name]

    @property
    def described(self) -> str:
        """Its form in words."""
        return self.form

    def motion(self, motion: SampledMotion, run: RunConditions) -> SampledMotion:
        """Return the true motion of the stage, from the commanded one."""
        return motion

    def stiffness(self, plan: RunPlan) -> float:
        """Return the factor on all stiffness in one run."""
        return 1.0

    def branches(self, strain: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the factors on E1, E2 and E3 at a strain, time constants kept."""
        ones = np.ones_like(strain)
        return ones, ones, ones

    def tail(self, age_s: Floats, strain: Floats) -> Floats:
        """Return the additional stress at a contact age and a strain, relative to E3."""
        return np.zeros_like(age_s)

    def passing(self, run: RunConditions) -> Floats:
        """Return the speed that determines where the wall is in contact [mm/s], shape `(N,)`."""
        return run.speed

    def contact(self, where: Floats, speed: Floats) -> Floats:
        """Return the remaining share of the pressure at x / L = `where` and a speed [mm/s]; the two broadcast."""
        return np.ones(np.broadcast_shapes(where.shape, speed.shape))

    def friction(self, run: RunConditions) -> Floats | float:
        """Return the relative change of μ, shape `(N,)`."""
        return 0.0

    def grip(self, direction: Floats, run: RunConditions) -> Floats:
        """Return the acting share of the Coulomb force, signed, shape `(N,)`."""
        return direction

    def pull(self, forces: CapsuleForces, run: RunConditions) -> Floats | float:
        """Return an additional force on the capsule [mN], shape `(N,)`."""
        return 0.0

    def sensor(self, force: Floats, run: RunConditions) -> Floats:
        """Return the recorded force [mN] of a true one, shape `(N,)`."""
        return force

    def position(self, position: Floats, force: Floats, run: RunConditions) -> Floats:
        """Return the position at the encoder [mm], shape `(N,)`."""
        return position

    def clock(self, plan: RunPlan, t: Floats, seed: int) -> Floats:
        """Return the true times of the samples [s] recorded at `t`."""
        return t

    @classmethod
    def drawn(cls, random: np.random.Generator, size: float) -> Self:
        """Draw an effect of this form; `size` scales its amplitude alone."""
        drawn_values = {name: drawn_from(random) for name, drawn_from in cls.ranges.items()}
        values = {name: value for name, value in drawn_values.items() if not isinstance(value, RandomLaw)}
        values["amplitude"] *= size
        return cls(values, {name: value for name, value in drawn_values.items() if isinstance(value, RandomLaw)})


def drawn(
    **ranges: DrawnFrom | OneOf | LawFamily | tuple[float, float],
) -> Callable[[type[HiddenEffect]], type[HiddenEffect]]:
    """Give a form the ranges of its parameters, in the order of drawing; a pair of numbers is drawn from uniformly.

    A family of laws gives the form a drawn function.
    """

    def give(form: type[HiddenEffect]) -> type[HiddenEffect]:
        form.ranges = {name: DrawnFrom(*ends) if isinstance(ends, tuple) else ends for name, ends in ranges.items()}
        return form

    return give


def hidden_form(
    hook: str, name: str, form: str, kinds: frozenset[str] = ALL_RUNS, *, rank: int = 0, channel: str = "force"
) -> Callable[[Callable[..., object]], type[HiddenEffect]]:
    """Make a form of a function: a hidden effect whose only hook, of this name, it is."""

    def make(law: Callable[..., object]) -> type[HiddenEffect]:
        described = {"name": name, "form": form, "kinds": kinds, "rank": rank, "channel": channel, hook: law}
        of_law = {"__doc__": law.__doc__, "__module__": law.__module__, "__qualname__": law.__name__}
        return cast("type[HiddenEffect]", type(law.__name__, (HiddenEffect,), described | of_law))

    return make


def second_order(values: Floats, natural: float, damping: float, t: Floats) -> Floats:
    """Return the response of ω² / (s² + 2ζωs + ω²), at rest before the first sample, input linear between samples."""
    from scipy.signal import cont2discrete, lfilter

    system = (np.array([natural**2]), np.array([1.0, 2 * damping * natural, natural**2]))
    numerator, denominator, _ = cont2discrete(system, float(t[1] - t[0]), method="foh")
    return np.asarray(lfilter(np.ravel(numerator), denominator, values))


def low_pass(values: Floats, time_s: float, damping: float, t: Floats) -> Floats:
    """Return the response of two poles at `1 / time_s`, or of a pair with less damping."""
    return second_order(values, 1 / time_s, damping, t)


def resonance(values: Floats, hertz: float, damping: float, t: Floats) -> Floats:
    """Return the force transmitted by a mass on a spring: the quasi-static part and the ringing."""
    return second_order(values, 2 * np.pi * hertz, damping, t)


def delayed(values: Floats, seconds: Floats | float, t: Floats) -> Floats:
    """Return the values of `seconds` ago; the ends are held."""
    return np.interp(t - seconds, t, values)


def first_order(values: Floats, time_s: float, t: Floats) -> Floats:
    """Return the response of one pole at `1 / time_s`, at rest before the first sample."""
    from scipy.signal import lfilter

    decay = float(np.exp(-(t[1] - t[0]) / time_s))
    return np.asarray(lfilter([1 - decay], [1.0, -decay], values))


def play_operator(values: Floats, half: float) -> Floats:
    """Return the output of a play of half-width `half`: it follows only once the gap is taken up."""
    out = np.empty_like(values)
    last = float(values[0])
    for piece, direction in _monotone_pieces(values):
        follows = values[piece] - direction * half
        out[piece] = np.maximum(last, follows) if direction > 0 else np.minimum(last, follows)
        last = float(out[piece][-1])
    return out


def dahl_operator(values: Floats, width: float) -> Floats:
    """Return Dahl's state in (−1, 1), which approaches the sign of the input's change over `width` of the input."""
    state = np.empty_like(values)
    last = 0.0
    for piece, direction in _monotone_pieces(values):
        change = np.abs(values[piece] - values[max(piece.start - 1, 0)])
        state[piece] = direction - (direction - last) * np.exp(-change / width)
        last = float(state[piece][-1])
    return state


def _monotone_pieces(values: Floats) -> Iterator[tuple[slice, int]]:
    """Yield the pieces in which the input is monotone, and their direction."""
    directions = np.sign(np.diff(values, prepend=values[0]))
    moved = np.flatnonzero(directions)
    if not moved.size:
        yield slice(0, values.size), 1
        return
    filled = directions[moved[np.clip(np.searchsorted(moved, np.arange(values.size), side="right") - 1, 0, None)]]
    starts = np.concatenate([[0], np.flatnonzero(np.diff(filled)) + 1, [values.size]])
    for start, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        yield slice(start, end), int(filled[start])
