"""The kinds of run there are, and sweeps over their parameters."""

from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from itertools import product
from math import prod
from pkgutil import iter_modules

from dragrig.config.errors import PlanError
from dragrig.config.loading import nearest, parse
from dragrig.rig import protocols
from dragrig.rig.protocols.base import Protocol

MOST_RUNS = 10_000
"""More than a year of rig time, and what memory bears."""


@cache
def kinds() -> Mapping[str, type[Protocol]]:
    """Return every kind of run by its name: each module of this package may define some."""
    for module in iter_modules(protocols.__path__):
        import_module(f"{protocols.__name__}.{module.name}")
    found = _concrete(Protocol)  # type: ignore[type-abstract]  # only its subclasses are taken
    return {one.kind: one for one in sorted(found, key=lambda one: one.kind)}


def swept(kind: str, parameters: Mapping[str, object], source: str, own_keys: tuple[str, ...]) -> tuple[Protocol, ...]:
    """Make one protocol for each combination of the values that are given as lists, the last key fastest.

    Parameters
    ----------
    source
        Where the step comes from, for error messages.
    own_keys
        Keys that a step may have besides the protocol's, for the hint at a misspelt one.

    Raises
    ------
    PlanError
        For an unknown kind or key.
    SettingsError
        For a value that is not allowed.
    """
    if kind not in kinds():
        raise PlanError(f"{source}: kind = {kind!r} is not a kind of run; {nearest(kind, list(kinds()))}")
    protocol = kinds()[kind]
    known = list(protocol.model_fields)
    for key in parameters:
        if key not in known:
            raise PlanError(f"{source}: {key} is not a key of a {kind} step; {nearest(key, [*known, *own_keys])}")
    return tuple(parse(protocol, combination, source) for combination in _combinations(protocol, parameters, source))


def _combinations(
    protocol: type[Protocol], parameters: Mapping[str, object], source: str
) -> Iterator[dict[str, object]]:
    for key, value in parameters.items():
        if value == [] or any(isinstance(one, bool) for one in (value if isinstance(value, list) else [value])):
            raise PlanError(f"{source}: {key} = {value!r} is no number and no list of numbers.")
    choices = [
        value if isinstance(value, list) and protocol.model_fields[key].annotation in (float, int) else [value]
        for key, value in parameters.items()
    ]
    if prod(len(values) for values in choices) > MOST_RUNS:
        raise PlanError(f"{source}: the lists make more than {MOST_RUNS} runs; shorten them.")
    for values in product(*choices):
        yield dict(zip(parameters, values, strict=True))


def _concrete(base: type[Protocol]) -> Iterator[type[Protocol]]:
    for one in base.__subclasses__():
        if hasattr(one, "kind"):
            yield one
        yield from _concrete(one)
