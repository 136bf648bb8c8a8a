"""The catalogue: every module of this package that has an `EFFECT`."""

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from types import MappingProxyType

from dragrig.config.errors import SettingsError
from dragrig.config.loading import nearest
from dragrig.sim_backend import effects
from dragrig.sim_backend.effects.base import Effect


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
        raise SettingsError(f"effect {name}: is not in the catalogue; {nearest(name, list(known))}")
    return known[name]


def near_aliases(name: str) -> frozenset[str]:
    """Return the effects that are hardly told from one, as either's entry says; none for what is no effect."""
    known = catalogue()
    own = known[name].aliases if name in known else ()
    return frozenset({*own, *(other for other, one in known.items() if name in one.aliases)})
