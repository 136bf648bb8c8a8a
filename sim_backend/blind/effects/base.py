"""What a hidden effect is: a frozen value with an amplitude, shape parameters, and hooks where it acts."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Annotated, ClassVar, Self, get_type_hints
from zlib import crc32

import numpy as np

from dragrig.sim_backend.blind.motion import Floats, Motion
from dragrig.sim_backend.blind.programme import RunPlan

DRAG = frozenset({"drag"})
SLIDING = frozenset({"drag", "coulomb"})
TISSUE = frozenset({"drag", "relaxation"})
EVERY = frozenset({"drag", "coulomb", "relaxation", "blank"})
STILL_MM_S = 0.05
"""Width of the change of sign about standstill."""


@dataclass(frozen=True, slots=True)
class Draw:
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


Phase = Annotated[float, Draw(0.0, 2 * np.pi)]


@dataclass(frozen=True, slots=True)
class Scene:
    """One run as an effect sees it.

    `session_s` holds the session's time at every sample, `command` and `motion` the commanded and the true motion.
    """

    run: RunPlan
    seed: int
    command: Motion
    motion: Motion

    @property
    def session_s(self) -> Floats:
        """Time since the session began [s], shape `(N,)`."""
        return self.run.start_s + self.motion.t

    @property
    def direction(self) -> Floats:
        """Sign of the true velocity, smooth about standstill, shape `(N,)`."""
        return np.tanh(self.motion.v / STILL_MM_S)

    @property
    def speed(self) -> Floats:
        """Absolute velocity [mm/s], shape `(N,)`."""
        return np.abs(self.motion.v)

    def random(self, purpose: str) -> np.random.Generator:
        """Return the random numbers of this run for one purpose, the same whenever they are asked for."""
        return np.random.default_rng((self.seed, self.run.order, crc32(purpose.encode())))


@dataclass(frozen=True, slots=True)
class Parts:
    """Forces on the capsule [mN]: elastic, viscous, Coulomb, and the normal force, each of shape `(N,)`."""

    elastic: Floats
    viscous: Floats
    coulomb: Floats
    normal: Floats


@dataclass(frozen=True, slots=True)
class Effect:
    """A hidden effect; subclasses override the hooks of the place where it acts.

    `name` is the catalogue's id, or one that the catalogue does not have; `form` the functional form. Parameters are
    fields annotated with the `Draw` they come from; `amplitude` is the one that the size scales.
    """

    amplitude: float

    name: ClassVar[str]
    form: ClassVar[str]
    kinds: ClassVar[frozenset[str]] = EVERY
    rank: ClassVar[int] = 0
    """Order in the chain from the force to the record: 0 mechanics, 1 sensor, 2 amplifier, 3 acquisition."""
    channel: ClassVar[str] = "force"

    def motion(self, motion: Motion, scene: Scene) -> Motion:
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

    def passing(self, scene: Scene) -> Floats:
        """Return the speed that decides where the wall is in contact [mm/s], shape `(N,)`."""
        return scene.speed

    def contact(self, where: Floats, speed: Floats) -> Floats:
        """Return the share of the pressure left at x / L = `where` at a speed [mm/s]; the two broadcast."""
        return np.ones(np.broadcast_shapes(where.shape, speed.shape))

    def friction(self, scene: Scene) -> Floats | float:
        """Return the relative change of μ, shape `(N,)`."""
        return 0.0

    def grip(self, direction: Floats, scene: Scene) -> Floats:
        """Return the share of the Coulomb force that acts, with its sign, shape `(N,)`."""
        return direction

    def pull(self, parts: Parts, scene: Scene) -> Floats | float:
        """Return a force on the capsule beyond the model [mN], shape `(N,)`."""
        return 0.0

    def sensor(self, force: Floats, scene: Scene) -> Floats:
        """Return the force that is recorded [mN] where `force` acts, shape `(N,)`."""
        return force

    def position(self, position: Floats, force: Floats, scene: Scene) -> Floats:
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


def _range(cls: type[Effect], name: str, hint: object) -> Draw:
    for extra in getattr(hint, "__metadata__", ()):
        if isinstance(extra, Draw):
            return extra
    raise TypeError(f"{cls.__name__}.{name} does not say what range it is drawn from")
