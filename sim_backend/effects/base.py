"""What an effect declares, and the catalogue of all effects.

An effect declares where it acts, its parameters with units and priors, its source, and what it changes. The catalogue
is every module of this package that has an `EFFECT`.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from types import MappingProxyType
from typing import ClassVar

from dragrig.config.errors import SettingsError
from dragrig.config.settings import suggestion
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend import effects
from dragrig.sim_backend.effects.run_state import RunState


class EffectLocation(StrEnum):
    """Where an effect acts."""

    WALL = "wall"
    INTERFACE = "interface"
    SPECIMEN = "specimen"
    FORCE_SENSOR = "force sensor"
    MOTOR = "motor"
    ACQUISITION = "acquisition"


class ParameterRole(StrEnum):
    """What a parameter is to an effect."""

    SIZE = "size"
    """How large the effect is: at 0 there is none, and what it changes grows in proportion or nearly so."""
    SHAPE = "shape"
    """How it depends on speed, position, time, …."""
    PHASE = "phase"
    """Where in its period something periodic begins [rad]."""


class MeasuringLink(IntEnum):
    """Where an effect sits in the chain from capsule to file; the first acts first, ids decide among equals."""

    PAYLOAD = 0
    ARM = 1
    CELL = 2
    AMPLIFIER = 3
    CLOCK = 4


class EffectCoordinate(StrEnum):
    """What an effect is above all a function of."""

    SPEED = "speed"
    POSITION = "position"
    TIME = "time"
    SESSION = "session"
    FREQUENCY = "frequency"
    STRAIN = "strain"
    TRANSIENT = "transient"


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """A parameter of an effect.

    Attributes
    ----------
    name, unit
        As in settings, the unit in the name where there is one; `1` for none.
    role
        Size, shape or phase; every effect has exactly one size, and at most one phase.
    usual
        Value unless one is given; a plain case of the effect that runs show clearly.
    low, high
        Prior range. A size whose sign is not known has a negative `low`.
    meaning
        A few words for tables.
    tried
        For a shape: the values that a diagnosis looks at, from its prior range; `usual` alone unless given.
    possible
        Least and greatest value that can be at all; unless given, what has the sign of the prior range.
    """

    name: str
    unit: str
    role: ParameterRole
    usual: float
    low: float
    high: float
    meaning: str
    tried: tuple[float, ...] = ()
    possible: tuple[float, float] | None = None

    def allows(self, value: float) -> bool:
        """Whether a value can be at all, within the prior range or far beyond it."""
        if self.possible is not None:
            return self.possible[0] <= value <= self.possible[1]
        return self.low < 0 or value > 0 or (self.low == 0 and value == 0)


class Effect(ABC):
    """A candidate for a gap between the simulated and the real rig.

    Derive from `ForceEffect`, `SensorEffect`, `MotorEffect` or `EncoderEffect`, one class in one file with an instance
    `EFFECT`. Everything is a pure function; values of parameters travel by name.
    """

    id: ClassVar[str]
    place: ClassVar[EffectLocation]
    domain: ClassVar[EffectCoordinate]
    summary: ClassVar[str]
    """One sentence: what it is."""
    exposes: ClassVar[str]
    """Which runs and phases show it."""
    source: ClassVar[str]
    """Where the form comes from."""
    parameters: ClassVar[tuple[EffectParameter, ...]]
    aliases: ClassVar[tuple[str, ...]] = ()
    """Effects that runs hardly tell from this one."""
    nominal: ClassVar[str] = ""
    """Nominal model that it belongs to alone; empty for any."""
    called: ClassVar[str] = ""
    """What a person calls it inside a sentence; unless given its id with spaces."""

    @property
    def name(self) -> str:
        """What a person calls it."""
        return self.called or self.id.replace("_", " ")

    @property
    def size(self) -> EffectParameter:
        """How large it is."""
        return next(one for one in self.parameters if one.role is ParameterRole.SIZE)

    @property
    def phase(self) -> EffectParameter | None:
        """Where its period begins; None for what is not periodic."""
        return next((one for one in self.parameters if one.role is ParameterRole.PHASE), None)

    @property
    def shapes(self) -> tuple[EffectParameter, ...]:
        """What it depends on."""
        return tuple(one for one in self.parameters if one.role is ParameterRole.SHAPE)

    @property
    def usual(self) -> Mapping[str, float]:
        """Usual values of all parameters."""
        return {one.name: one.usual for one in self.parameters}

    @property
    def of_session(self) -> bool:
        """Whether it depends on when in the session a run is made; if not, repeats of a run show it alike."""
        return self.domain is EffectCoordinate.SESSION

    @property
    def channel(self) -> str:
        """Channel that it shows in."""
        return "force"


class ForceEffect(Effect):
    """An effect in wall, interface or specimen: a force on the capsule beside the nominal one."""

    @abstractmethod
    def added(self, scene: RunState, values: Mapping[str, float]) -> FloatArray:
        """Return the true force that is added [mN], shape `(n,)`; zeros where the effect does not act.

        The sign is the scene's: positive resists motion towards positive position.
        """


class SensorEffect(Effect):
    """An effect in the force sensor or its acquisition: what is shown of a force."""

    link: ClassVar[MeasuringLink] = MeasuringLink.CELL

    @abstractmethod
    def shown(self, scene: RunState, force_mN: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return what the channel shows [mN] of a force at the scene's times, shape `(n,)`."""


class MotorEffect(Effect):
    """An effect in the motor: how the stage moves when it is told to."""

    @property
    def channel(self) -> str:
        """Channel that it shows in."""
        return "position"

    @abstractmethod
    def moved(self, time_s: FloatArray, command_mm: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return where the stage is [mm] at rising times, from where it is told to be, shapes `(n,)`.

        Positions count from the first sample. Between times the command is taken as a straight line.
        """


class EncoderEffect(Effect):
    """An effect in how the position is recorded."""

    @property
    def channel(self) -> str:
        """Channel that it shows in."""
        return "position"

    @abstractmethod
    def recorded(self, time_s: FloatArray, position_mm: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the recorded position [mm], counted from the first sample, of a true one, shapes `(n,)`."""


@cache
def catalogue() -> Mapping[str, Effect]:
    """Return all effects by id, in order of their ids."""
    names = sorted(f"{effects.__name__}.{one.name}" for one in iter_modules(effects.__path__) if not one.ispkg)
    found = [getattr(import_module(name), "EFFECT", None) for name in names]
    return MappingProxyType({one.id: one for one in found if isinstance(one, Effect)})


def find_effect(name: str) -> Effect:
    """Return an effect by id; raises `SettingsError` for one that the catalogue does not have."""
    known = catalogue()
    if name not in known:
        raise SettingsError(f"effect {name}: is not in the catalogue; {suggestion(name, list(known))}")
    return known[name]


def confusable_effects(name: str) -> frozenset[str]:
    """Return the effects that are hardly told from one, as either's entry says; none for what is no effect."""
    known = catalogue()
    own = known[name].aliases if name in known else ()
    return frozenset({*own, *(other for other, one in known.items() if name in one.aliases)})
