"""What a hidden effect is: a frozen value with an amplitude, shape parameters, and hooks where it acts.

Also the linear systems and the rate-independent hysteresis that several share, sampled with the record.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Annotated, ClassVar, Self, get_type_hints
from zlib import crc32

import numpy as np

from dragrig.sim_backend.blind.programme import Floats, RunPlan, SampledMotion

DRAG_RUNS = frozenset({"drag"})
SLIDING_RUNS = frozenset({"drag", "coulomb"})
TISSUE_RUNS = frozenset({"drag", "relaxation"})
ALL_RUNS = frozenset({"drag", "coulomb", "relaxation", "blank"})
SIGN_CHANGE_MM_S = 0.05
"""Width of the change of sign about standstill."""


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


DrawnPhase = Annotated[float, DrawnFrom(0.0, 2 * np.pi)]


@dataclass(frozen=True, slots=True)
class RunConditions:
    """One run as an effect sees it.

    `session_s` holds the session's time at every sample, `command` and `motion` the commanded and the true motion.
    """

    run: RunPlan
    seed: int
    command: SampledMotion
    motion: SampledMotion

    @property
    def session_s(self) -> Floats:
        """Time since the session began [s], shape `(N,)`."""
        return self.run.start_s + self.motion.t

    @property
    def direction(self) -> Floats:
        """Sign of the true velocity, smooth about standstill, shape `(N,)`."""
        return np.tanh(self.motion.v / SIGN_CHANGE_MM_S)

    @property
    def speed(self) -> Floats:
        """Absolute velocity [mm/s], shape `(N,)`."""
        return np.abs(self.motion.v)

    def random(self, purpose: str) -> np.random.Generator:
        """Return the random numbers of this run for one purpose, the same whenever they are asked for."""
        return np.random.default_rng((self.seed, self.run.order, crc32(purpose.encode())))


@dataclass(frozen=True, slots=True)
class CapsuleForces:
    """Forces on the capsule [mN]: elastic, viscous, Coulomb, and the normal force, each of shape `(N,)`."""

    elastic: Floats
    viscous: Floats
    coulomb: Floats
    normal: Floats


@dataclass(frozen=True, slots=True)
class HiddenEffect:
    """A hidden effect; subclasses override the hooks of the place where it acts.

    `name` is the catalogue's id, or one that the catalogue does not have; `form` the functional form. Parameters are
    fields annotated with the `DrawnFrom` they come from; `amplitude` is the one that the size scales.
    """

    amplitude: float

    name: ClassVar[str]
    form: ClassVar[str]
    kinds: ClassVar[frozenset[str]] = ALL_RUNS
    rank: ClassVar[int] = 0
    """Order in the chain from the force to the record: 0 mechanics, 1 sensor, 2 amplifier, 3 acquisition."""
    channel: ClassVar[str] = "force"

    def motion(self, motion: SampledMotion, scene: RunConditions) -> SampledMotion:
        """Return the true motion, made from what is commanded."""
        return motion

    def stiffness(self, run: RunPlan) -> float:
        """Return the factor on all stiffness in one run."""
        return 1.0

    def branches(self, strain: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the factors on E1, E2 and E3 at a strain, time constants kept."""
        one = np.ones_like(strain)
        return one, one, one

    def tail(self, age_s: Floats, strain: Floats) -> Floats:
        """Return what the stress has beyond the model at a contact age and a strain, as a part of E3."""
        return np.zeros_like(age_s)

    def passing(self, scene: RunConditions) -> Floats:
        """Return the speed that decides where the wall is in contact [mm/s], shape `(N,)`."""
        return scene.speed

    def contact(self, where: Floats, speed: Floats) -> Floats:
        """Return the share of the pressure left at x / L = `where` at a speed [mm/s]; the two broadcast."""
        return np.ones(np.broadcast_shapes(where.shape, speed.shape))

    def friction(self, scene: RunConditions) -> Floats | float:
        """Return the relative change of μ, shape `(N,)`."""
        return 0.0

    def grip(self, direction: Floats, scene: RunConditions) -> Floats:
        """Return the share of the Coulomb force that acts, with its sign, shape `(N,)`."""
        return direction

    def pull(self, parts: CapsuleForces, scene: RunConditions) -> Floats | float:
        """Return a force on the capsule beyond the model [mN], shape `(N,)`."""
        return 0.0

    def sensor(self, force: Floats, scene: RunConditions) -> Floats:
        """Return the force that is recorded [mN] where `force` acts, shape `(N,)`."""
        return force

    def position(self, position: Floats, force: Floats, scene: RunConditions) -> Floats:
        """Return the position that the encoder sees [mm], shape `(N,)`."""
        return position

    def clock(self, run: RunPlan, t: Floats, seed: int) -> Floats:
        """Return the true times of the samples [s] that are recorded at `t`."""
        return t

    @classmethod
    def drawn(cls, random: np.random.Generator, size: float) -> Self:
        """Draw an effect of this form; `size` scales its amplitude alone."""
        hints = get_type_hints(cls, include_extras=True)
        ranges = {one.name: _range(cls, one.name, hints[one.name]) for one in fields(cls)}
        values = {name: draw(random) for name, draw in ranges.items()}
        values["amplitude"] *= size
        return cls(**values)

    @property
    def parameters(self) -> Mapping[str, float]:
        """Names and values of the parameters, the amplitude among them."""
        return MappingProxyType({one.name: float(getattr(self, one.name)) for one in fields(self)})


def _range(cls: type[HiddenEffect], name: str, hint: object) -> DrawnFrom:
    for extra in getattr(hint, "__metadata__", ()):
        if isinstance(extra, DrawnFrom):
            return extra
    raise TypeError(f"{cls.__name__}.{name} does not say what range it is drawn from")


def second_order(values: Floats, natural: float, damping: float, t: Floats) -> Floats:
    """Return the answer of ω² / (s² + 2ζωs + ω²), at rest before the first sample, input linear between samples."""
    from scipy.signal import cont2discrete, lfilter

    system = (np.array([natural**2]), np.array([1.0, 2 * damping * natural, natural**2]))
    numerator, denominator, _ = cont2discrete(system, float(t[1] - t[0]), method="foh")
    return np.asarray(lfilter(np.ravel(numerator), denominator, values))


def low_pass(values: Floats, time_s: float, damping: float, t: Floats) -> Floats:
    """Return the values through two poles at `1 / time_s`, or a pair of them with less damping."""
    return second_order(values, 1 / time_s, damping, t)


def resonance(values: Floats, hertz: float, damping: float, t: Floats) -> Floats:
    """Return the values as a mass on a spring passes them on: the quasi-static part and the ringing."""
    return second_order(values, 2 * np.pi * hertz, damping, t)


def delayed(values: Floats, seconds: Floats | float, t: Floats) -> Floats:
    """Return the values as they were `seconds` ago; the ends are held."""
    return np.interp(t - seconds, t, values)


def first_order(values: Floats, time_s: float, t: Floats) -> Floats:
    """Return the values through one pole at `1 / time_s`, at rest before the first sample."""
    from scipy.signal import lfilter

    kept = float(np.exp(-(t[1] - t[0]) / time_s))
    return np.asarray(lfilter([1 - kept], [1.0, -kept], values))


def play_operator(values: Floats, half: float) -> Floats:
    """Return the output of a play of half-width `half`: it follows only once the gap is taken up."""
    out = np.empty_like(values)
    last = float(values[0])
    for piece, way in _monotone_pieces(values):
        follows = values[piece] - way * half
        out[piece] = np.maximum(last, follows) if way > 0 else np.minimum(last, follows)
        last = float(out[piece][-1])
    return out


def dahl_operator(values: Floats, width: float) -> Floats:
    """Return a state within −1 to 1 that approaches the sign of the input's motion over `width` of the input."""
    state = np.empty_like(values)
    last = 0.0
    for piece, way in _monotone_pieces(values):
        passed = np.abs(values[piece] - values[max(piece.start - 1, 0)])
        state[piece] = way - (way - last) * np.exp(-passed / width)
        last = float(state[piece][-1])
    return state


def _monotone_pieces(values: Floats) -> Iterator[tuple[slice, int]]:
    """Give the stretches in which the input goes one way, and which way."""
    ways = np.sign(np.diff(values, prepend=values[0]))
    moved = np.flatnonzero(ways)
    if not moved.size:
        yield slice(0, values.size), 1
        return
    filled = ways[moved[np.clip(np.searchsorted(moved, np.arange(values.size), side="right") - 1, 0, None)]]
    starts = np.concatenate([[0], np.flatnonzero(np.diff(filled)) + 1, [values.size]])
    for start, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        yield slice(start, end), int(filled[start])
