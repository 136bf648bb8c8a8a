"""Kinds of run: a validated description that yields its motion. Every subclass in this package is one."""

import json
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from itertools import product
from math import prod
from pkgutil import iter_modules
from typing import ClassVar, Self

from pydantic import Field, model_validator

from dragrig.config import Fixture, PlanError, Settings, Specimen, parse, suggestion
from dragrig.rig import Attribute, Contact, MotionProfile, Phase, Piece, stationary_piece, trapezoid

MAX_RUNS = 10_000
"""Of a step: more than a year of rig time, and as many as fit into memory."""


class RunProtocol(Settings):
    """A kind of run as a value: its parameters, and the motion that follows from them.

    A new kind is a subclass in a module of this package, and is discovered by itself.
    """

    kind: ClassVar[str]
    fixture: ClassVar[Fixture]
    """What holds the gut by default."""
    contact: ClassVar[Contact]
    capsule: ClassVar[str]
    """Name of the default capsule."""

    rest_s: float = Field(default=1.0, ge=0, le=3600)
    """Standstill before the motion."""
    hold_s: float = Field(default=3.0, ge=0, le=7200)
    """Standstill after the motion."""

    @abstractmethod
    def moves(self, specimen: Specimen) -> tuple[Piece, ...]:
        """Return the motion between rest and hold."""

    def profile(self, specimen: Specimen) -> MotionProfile:
        """Return the whole motion of the run on a specimen."""
        rest, hold = stationary_piece(self.rest_s, Phase.REST), stationary_piece(self.hold_s, Phase.HOLD)
        return MotionProfile.from_pieces((rest, *self.moves(specimen), hold))

    def strain(self) -> float:
        """Return the shear strain that the run goes to; 0 for a capsule that slides."""
        return 0.0

    def attributes(self) -> Mapping[str, Attribute]:
        """Return the run file's protocol attributes: kind and every parameter; lists become JSON text."""
        parameters = self.model_dump(mode="json")
        return {"kind": self.kind} | {
            key: value if isinstance(value, str | float | int) else json.dumps(value)
            for key, value in parameters.items()
        }

    def summary(self) -> str:
        """Return a few words that distinguish this run from the others of its plan."""
        return self.kind


class StrokeProtocol(RunProtocol):
    """One stroke at constant speed."""

    speed_mm_s: float = Field(ge=1e-4, le=5000)
    """Constant speed of the stroke."""
    travel_mm: float = Field(default=40.0, ge=-5000, le=5000)
    """Length of the stroke, run-up and run-down included; negative moves backward."""
    accel_mm_s2: float = Field(default=400.0, ge=0.01, le=100_000)
    """Acceleration of run-up and run-down."""

    @model_validator(mode="after")
    def _reaches_its_speed(self) -> Self:
        ramps_mm = self.speed_mm_s**2 / self.accel_mm_s2
        if ramps_mm >= abs(self.travel_mm):
            raise ValueError(
                f"travel_mm = {self.travel_mm:g} is too short for speed_mm_s = {self.speed_mm_s:g}: run-up and "
                f"run-down at accel_mm_s2 = {self.accel_mm_s2:g} alone take {ramps_mm:g} mm"
            )
        return self

    def moves(self, specimen: Specimen) -> tuple[Piece, ...]:
        """Return one trapezoid."""
        del specimen
        return trapezoid(self.travel_mm, self.speed_mm_s, self.accel_mm_s2)

    def summary(self) -> str:
        """Return kind and speed, and the direction where it is backward."""
        return f"{self.kind} {self.speed_mm_s:g} mm/s" + (" backward" if self.travel_mm < 0 else "")


@cache
def protocol_kinds() -> Mapping[str, type[RunProtocol]]:
    """Return every kind of run by its name, from all modules of this package."""
    for module in iter_modules(__path__):
        import_module(f"{__name__}.{module.name}")
    protocols = _concrete_subclasses(RunProtocol)  # type: ignore[type-abstract]  # only its subclasses are returned
    return {protocol.kind: protocol for protocol in sorted(protocols, key=lambda protocol: protocol.kind)}


def _concrete_subclasses(base: type[RunProtocol]) -> Iterator[type[RunProtocol]]:
    for subclass in base.__subclasses__():
        if hasattr(subclass, "kind"):
            yield subclass
        yield from _concrete_subclasses(subclass)


def expand_sweep(
    kind: str, parameters: Mapping[str, object], source: str, step_keys: tuple[str, ...]
) -> tuple[RunProtocol, ...]:
    """Make one protocol for each combination of the values in lists, the last key fastest.

    Parameters
    ----------
    source
        Where the step comes from, for error messages.
    step_keys
        Keys that a step may have besides the protocol's, for the hint at a misspelt one.

    Raises
    ------
    PlanError
        For an unknown kind or key.
    SettingsError
        For a value that is not allowed.
    """
    if kind not in protocol_kinds():
        raise PlanError(f"{source}: kind = {kind!r} is not a kind of run; {suggestion(kind, list(protocol_kinds()))}")
    protocol = protocol_kinds()[kind]
    known = list(protocol.model_fields)
    for key, value in parameters.items():
        if key not in known:
            raise PlanError(f"{source}: {key} is not a key of a {kind} step; {suggestion(key, [*known, *step_keys])}")
        if value == [] or any(isinstance(item, bool) for item in (value if isinstance(value, list) else [value])):
            raise PlanError(f"{source}: {key} = {value!r} is no number and no list of numbers.")
    choices = [
        value if isinstance(value, list) and protocol.model_fields[key].annotation in (float, int) else [value]
        for key, value in parameters.items()
    ]
    if prod(len(values) for values in choices) > MAX_RUNS:
        raise PlanError(f"{source}: the lists make more than {MAX_RUNS} runs; shorten them.")
    return tuple(parse(protocol, dict(zip(parameters, values, strict=True)), source) for values in product(*choices))
