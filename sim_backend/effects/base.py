"""The declarations of an effect, the catalogue of all effects, and active effects combined to a chain.

An effect declares where it acts, its parameters with units and priors, its source, and how a diagnosis finds it; its
hooks make its changes. Everything else in the program goes by these declarations and hooks: no other module knows an
effect by its id, by a parameter's name or by its class. The catalogue holds every effect
class of this package's modules.

In a chain the command goes through the motor effects; the forces of wall and interface are added to the nominal one;
then come the force gain and the sensor effects, in their order from the payload to the channel's clock; the position
goes through the encoder effects. Within each step ids decide the order, and the order of the settings between two of
one id.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from functools import cache, partial
from importlib import import_module
from pkgutil import iter_modules
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from dragrig.config import EffectSettings, FrictionModelSettings, ModelSettings, SettingsError, suggestion
from dragrig.rig import FloatArray
from dragrig.sim_backend import effects
from dragrig.sim_backend.effects.run_state import RunState

Values = Mapping[str, float]
"""Values of an effect's parameters by name."""


class Location(StrEnum):
    """Where an effect acts."""

    WALL = "wall"
    INTERFACE = "interface"
    SPECIMEN = "specimen"
    FORCE_SENSOR = "force sensor"
    MOTOR = "motor"
    ACQUISITION = "acquisition"


class Coordinate(StrEnum):
    """The coordinate that an effect is above all a function of."""

    SPEED = "speed"
    POSITION = "position"
    TIME = "time"
    SESSION = "session"
    FREQUENCY = "frequency"
    STRAIN = "strain"
    TRANSIENT = "transient"


class Channel(StrEnum):
    """Channel of a run that shows an effect."""

    FORCE = "force"
    POSITION = "position"


class MeasuringLink(IntEnum):
    """Where a sensor effect sits in the chain from capsule to file; the lowest acts first, ids decide among equals."""

    PAYLOAD = 0
    ARM = 1
    CELL = 2
    AMPLIFIER = 3
    CLOCK = 4


class PositionForm(StrEnum):
    """Free form of the position error by which a diagnosis recognises an effect."""

    SCALE = "scale"
    """In proportion to the distance travelled."""
    RESPONSE = "response"
    """A linear response to the command."""
    DELAY = "delay"
    """The command at another time."""
    RIPPLE = "ripple"
    """Periodic in position."""
    PLAY = "play"
    """Left behind by a fixed way after each reversal."""


class Role(StrEnum):
    """The role of a parameter in an effect."""

    SIZE = "size"
    """How large the effect is: at 0 there is none, and what it changes grows in proportion or nearly so."""
    SHAPE = "shape"
    """How it depends on speed, position, time, …."""
    PHASE = "phase"
    """Where in its period something periodic begins [rad]."""


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """A parameter of an effect."""

    name: str
    unit: str
    """`name`, `unit`: as in settings, the unit in the name where there is one; `1` for none."""
    default: float
    """A plain case of the effect that runs show clearly."""
    low: float
    high: float
    """`low`, `high`: prior range. A size whose sign is not known has a negative `low`."""
    meaning: str
    """A few words for tables."""
    role: Role
    """Size, shape or phase; every effect has exactly one size, and at most one phase."""
    grid: tuple[float, ...] = ()
    """For a shape: the values that a diagnosis starts from, within the prior range; `default` alone where empty."""
    bounds: tuple[float, float] | None = None
    """Least and greatest possible value; without them, the parameter keeps the sign of the prior range."""

    @property
    def start_values(self) -> tuple[float, ...]:
        """Values that a diagnosis starts from."""
        return self.grid or (self.default,)

    def allows(self, value: float) -> bool:
        """Whether a value is possible, within the prior range or far beyond it."""
        if self.bounds is not None:
            return self.bounds[0] <= value <= self.bounds[1]
        return self.low < 0 or value > 0 or (self.low == 0 and value == 0)


size = partial(EffectParameter, role=Role.SIZE)
shape = partial(EffectParameter, role=Role.SHAPE)
phase = partial(EffectParameter, role=Role.PHASE)


class Effect(ABC):
    """A candidate for a gap between the simulated and the real rig.

    Derive from `ForceEffect`, `SensorEffect`, `MotorEffect` or `EncoderEffect`, one class in one file. Everything is a
    pure function; values of parameters are passed by name.
    """

    id: ClassVar[str]
    location: ClassVar[Location]
    coordinate: ClassVar[Coordinate]
    summary: ClassVar[str]
    """One sentence: what it is."""
    visible_in: ClassVar[str]
    """Which runs and phases show it."""
    source: ClassVar[str]
    """Where the form comes from."""
    parameters: ClassVar[tuple[EffectParameter, ...]]
    display_name: ClassVar[str] = ""
    """Its name inside a sentence; the id with spaces where empty."""
    nominal: ClassVar[str] = ""
    """Nominal model that it belongs to alone; empty for any."""

    channels: ClassVar[tuple[Channel, ...]] = (Channel.FORCE,)
    """Channels that may show it, the one in which a diagnosis looks for it first."""
    link: ClassVar[MeasuringLink] = MeasuringLink.CELL
    in_gut: ClassVar[bool] = False
    """Whether it acts on capsule and gut, so that a rig without them cannot have it."""
    moves_stage: ClassVar[bool] = False
    """Whether the stage goes elsewhere than commanded, not only its record."""

    confused_with: ClassVar[tuple[str, ...]] = ()
    """Ids of effects that runs hardly tell from this one."""
    similar_to: ClassVar[tuple[str, ...]] = ()
    """Ids of effects that act on the same: what another form of one leaves, the other may pass for."""
    abrupt: ClassVar[bool] = False
    """Whether it acts where the force is steepest, so that another form of it leaves much unexplained."""
    period_parameter: ClassVar[str] = ""
    """For what is periodic: name of the parameter that sets the length of a period, or its frequency."""
    origin_parameter: ClassVar[str] = ""
    """For what is periodic on the machine, not along a run: name of the parameter from which its phase counts [mm]."""
    spectral_line: ClassVar[bool] = False
    """Whether a diagnosis finds it as a line at the mains' frequency, of amplitude `size` and frequency `period`."""
    position_form: ClassVar[PositionForm | None] = None
    """Free form of the position error by which a diagnosis recognises it; None where the position shows nothing."""
    free_law: ClassVar[str] = ""
    """Nonparametric law that the effect itself is an example of; empty where none is."""

    @property
    def name(self) -> str:
        """Its name inside a sentence."""
        return self.display_name or self.id.replace("_", " ")

    @property
    def channel(self) -> Channel:
        """Channel in which a diagnosis looks for it first."""
        return self.channels[0]

    @property
    def belongs_to_gut(self) -> bool:
        """Whether it acts in the gut, and not in the rig that measures it."""
        return self.location in {Location.WALL, Location.INTERFACE, Location.SPECIMEN}

    @property
    def has_force_signature(self) -> bool:
        """Whether a diagnosis finds it by its signature in the force: not as a spectral line, not in the position."""
        return self.channel is Channel.FORCE and not self.spectral_line

    @property
    def size(self) -> EffectParameter:
        """How large it is."""
        return next(parameter for parameter in self.parameters if parameter.role is Role.SIZE)

    @property
    def phase(self) -> EffectParameter | None:
        """Where its period begins; None where it is not periodic."""
        return next((parameter for parameter in self.parameters if parameter.role is Role.PHASE), None)

    @property
    def period(self) -> EffectParameter | None:
        """How long its period is, or its frequency; None where it is not periodic."""
        return next((parameter for parameter in self.parameters if parameter.name == self.period_parameter), None)

    @property
    def periodic_in_session(self) -> bool:
        """Whether it is periodic in session time."""
        return self.phase is not None and self.coordinate is Coordinate.SESSION

    @property
    def shapes(self) -> tuple[EffectParameter, ...]:
        """Parameters of its form."""
        return tuple(parameter for parameter in self.parameters if parameter.role is Role.SHAPE)

    @property
    def defaults(self) -> Values:
        """Default values of all parameters."""
        return {parameter.name: parameter.default for parameter in self.parameters}

    @property
    def varies_in_session(self) -> bool:
        """Whether it depends on when in the session a run is made; if not, repeats of a run show it alike."""
        return self.coordinate is Coordinate.SESSION

    def added_force(self, run: RunState, values: Values) -> FloatArray:
        """Return the true force that is added [mN], shape `(n,)`; zeros where the effect does not act.

        The sign is the run's: positive resists motion towards positive position.
        """
        return np.zeros_like(run.time_s)

    def measured_force(self, run: RunState, force_mN: FloatArray, values: Values) -> FloatArray:
        """Return the channel's reading [mN] of a force at the run's times, shape `(n,)`."""
        return force_mN

    def stage_position(self, time_s: FloatArray, command_mm: FloatArray, values: Values) -> FloatArray:
        """Return where the stage is [mm] at rising times, commanded to be elsewhere, shapes `(n,)`.

        Positions count from the first sample. Between times the command is taken as a straight line.
        """
        return command_mm

    def counted_position(self, time_s: FloatArray, position_mm: FloatArray, values: Values) -> FloatArray:
        """Return the recorded position [mm], counted from the first sample, of a true one, shapes `(n,)`."""
        return position_mm

    def force_change(self, run: RunState, values: Values, gain: float = 1.0) -> FloatArray:
        """Return by how much it changes the nominal force that the channel shows [mN], shape `(n,)`."""
        nominal = gain * run.nominal
        return gain * self.added_force(run, values) + (self.measured_force(run, nominal, values) - nominal)

    def position_change(self, time_s: FloatArray, command_mm: FloatArray, values: Values) -> FloatArray:
        """Return the position error [mm] that it makes of a command, shapes `(n,)`."""
        stage_mm = self.stage_position(time_s, command_mm, values)
        return np.asarray(self.counted_position(time_s, stage_mm, values) - command_mm)


class ForceEffect(Effect):
    """An effect in wall, interface or specimen: a force on the capsule beside the nominal one."""

    in_gut = True

    @abstractmethod
    def added_force(self, run: RunState, values: Values) -> FloatArray:
        """Return the true force that is added [mN]."""


class SensorEffect(Effect):
    """An effect in the force sensor or its acquisition: the channel's reading of a force."""

    @abstractmethod
    def measured_force(self, run: RunState, force_mN: FloatArray, values: Values) -> FloatArray:
        """Return the channel's reading of a force [mN]."""


class MotorEffect(Effect):
    """An effect in the motor: where the stage goes when it is commanded."""

    channels = (Channel.POSITION,)
    moves_stage = True

    @abstractmethod
    def stage_position(self, time_s: FloatArray, command_mm: FloatArray, values: Values) -> FloatArray:
        """Return where the stage is [mm]."""


class EncoderEffect(Effect):
    """An effect in how the position is recorded."""

    channels = (Channel.POSITION,)

    @abstractmethod
    def counted_position(self, time_s: FloatArray, position_mm: FloatArray, values: Values) -> FloatArray:
        """Return the recorded position [mm]."""


@cache
def catalogue() -> Mapping[str, Effect]:
    """Return all effects by id, in order of their ids."""
    modules = [import_module(f"{effects.__name__}.{module.name}") for module in iter_modules(effects.__path__)]
    declared = (value for module in modules for value in vars(module).values() if isinstance(value, type))
    effects_by_id = {kind.id: kind() for kind in declared if issubclass(kind, Effect) and hasattr(kind, "id")}
    return MappingProxyType(dict(sorted(effects_by_id.items())))


def find_effect(effect_id: str) -> Effect:
    """Return an effect by id; raises `SettingsError` for one that the catalogue does not have."""
    known = catalogue()
    if effect_id not in known:
        raise SettingsError(f"effect {effect_id}: is not in the catalogue; {suggestion(effect_id, list(known))}")
    return known[effect_id]


def hum_effect() -> Effect:
    """Return the effect that a diagnosis finds as a line at the mains' frequency."""
    (hum,) = (effect for effect in catalogue().values() if effect.spectral_line)
    return hum


def confusable_effects(effect_id: str) -> frozenset[str]:
    """Return the effects that runs hardly tell from this one, as either declares; none for an unknown id."""
    return _related(effect_id, {effect.id: effect.confused_with for effect in catalogue().values()})


def similar_effects(effect_id: str) -> frozenset[str]:
    """Return the effects that act on the same as this one, as either declares; none for an unknown id."""
    return _related(effect_id, {effect.id: effect.similar_to for effect in catalogue().values()})


def _related(effect_id: str, relations: Mapping[str, Iterable[str]]) -> frozenset[str]:
    declared_by_others = (effect for effect, related in relations.items() if effect_id in related)
    return frozenset({*relations.get(effect_id, ()), *declared_by_others})


MAX_RATE_HZ = 2000.0
"""Effects are computed at the sample rate, but not faster than this; between times they are interpolated linearly."""
MAX_TIMES = 250_000
"""Longer runs are computed at fewer times a second, so that memory suffices."""
SIMULATED_NOMINAL = "capsule"
"""The nominal model that the simulated rig has."""


@dataclass(frozen=True, slots=True)
class ActiveEffect:
    """An effect with the values of all its parameters."""

    effect: Effect
    values: Values


def active_effects(settings: ModelSettings) -> tuple[ActiveEffect, ...]:
    """Return the effects that a model has, with default values of the parameters that it does not name.

    Raises `SettingsError` for an unknown effect or parameter, an impossible value, and an effect that the friction
    model cannot have.
    """
    active = tuple(_active_effect(entry) for entry in settings.effects)
    if isinstance(settings, FrictionModelSettings):
        for effect in (active_effect.effect for active_effect in active):
            if effect.nominal not in {"", SIMULATED_NOMINAL}:
                raise SettingsError(
                    f"effect {effect.id}: belongs to the model {effect.nominal}, which is not the simulated rig's."
                )
    return active


def _active_effect(entry: EffectSettings) -> ActiveEffect:
    effect = find_effect(entry.id)
    parameters = {parameter.name: parameter for parameter in effect.parameters}
    for name, value in entry.parameters.items():
        if name not in parameters:
            raise SettingsError(f"effect {effect.id}: has no parameter {name}; {suggestion(name, list(parameters))}")
        parameter = parameters[name]
        if not parameter.allows(value):
            unit = "" if parameter.unit == "1" else f" {parameter.unit}"
            raise SettingsError(
                f"effect {effect.id}: {name} = {value:g} is not possible; "
                f"usual are {parameter.low:g} to {parameter.high:g}{unit}."
            )
    return ActiveEffect(effect, {**effect.defaults, **entry.parameters})


@dataclass(frozen=True, slots=True)
class EffectChain:
    """Effects in the order in which they act; none by default."""

    effects: tuple[ActiveEffect, ...] = ()

    @classmethod
    def of(cls, settings: ModelSettings) -> "EffectChain":
        """Put the effects of a model in order; raises `SettingsError` as `active_effects`."""
        return cls().with_effects(sorted(active_effects(settings), key=lambda active: active.effect.id))

    def with_effects(self, further: Iterable[ActiveEffect]) -> "EffectChain":
        """Return the chain with further effects, which act after those of the same link."""
        return EffectChain(tuple(sorted((*self.effects, *further), key=lambda active: active.effect.link)))

    def only(self, condition: Callable[[Effect], bool]) -> "EffectChain":
        """Return the effects that meet a condition."""
        return EffectChain(tuple(active for active in self.effects if condition(active.effect)))

    @property
    def moves_stage(self) -> bool:
        """Whether the stage goes elsewhere than commanded."""
        return any(active.effect.moves_stage for active in self.effects)

    @property
    def changes_position(self) -> bool:
        """Whether the recorded position differs from the command."""
        return any(active.effect.channel is Channel.POSITION for active in self.effects)

    def stage_position(self, time_s: FloatArray, command_mm: FloatArray) -> FloatArray:
        """Return where the stage is [mm] when it is commanded to be elsewhere, shapes `(n,)`."""
        for active in self.effects:
            command_mm = active.effect.stage_position(time_s, command_mm, active.values)
        return command_mm

    def load(self, run: RunState) -> FloatArray:
        """Return the true force on the capsule [mN], shape `(n,)`."""
        gut = (active for active in self.effects if active.effect.in_gut)
        return np.asarray(sum((active.effect.added_force(run, active.values) for active in gut), run.nominal))

    def measured_force(self, run: RunState, load_mN: FloatArray, force_gain: float) -> FloatArray:
        """Return the force channel's reading [mN] of a true force, shapes `(n,)`, without noise."""
        force = force_gain * load_mN
        for active in self.effects:
            force = active.effect.measured_force(run, force, active.values)
        return force

    def counted_position(self, time_s: FloatArray, position_mm: FloatArray) -> FloatArray:
        """Return the position that is counted [mm] of a true one, shapes `(n,)`."""
        for active in self.effects:
            position_mm = active.effect.counted_position(time_s, position_mm, active.values)
        return position_mm


def evaluation_rate_hz(rate_hz: float, duration_s: float) -> float:
    """Return at how many times a second effects are computed for a run of this length and sample rate."""
    return min(rate_hz, MAX_RATE_HZ, MAX_TIMES / max(duration_s, 1.0))


def evaluation_times(duration_s: float, rate_hz: float) -> FloatArray:
    """Return times from 0 on at a rate, and the end [s]."""
    whole = max(int(np.ceil(duration_s * rate_hz - 1e-6)), 1)
    return np.append(np.arange(whole) / rate_hz, max(duration_s, 1e-6))
