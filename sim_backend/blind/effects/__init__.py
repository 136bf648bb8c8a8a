"""Hidden effects by id: those of the catalogue in other functional forms, and some that it does not have."""

from collections.abc import Mapping
from itertools import chain
from types import MappingProxyType

from dragrig.sim_backend.blind.effects.base import HiddenEffect
from dragrig.sim_backend.blind.effects.gut import ORGAN_FORMS, SESSION_FORMS, WALL_FORMS
from dragrig.sim_backend.blind.effects.instrument import DRIVE_FORMS, SENSOR_FORMS
from dragrig.sim_backend.blind.effects.interface import INTERFACE_FORMS, SLIP_FORMS
from dragrig.sim_backend.blind.effects.outside import OUTSIDE_FORCE_FORMS, OUTSIDE_POSITION_FORMS


def _by_name(*forms: type[HiddenEffect]) -> Mapping[str, tuple[type[HiddenEffect], ...]]:
    names: dict[str, tuple[type[HiddenEffect], ...]] = {}
    for form in forms:
        names[form.name] = (*names.get(form.name, ()), form)
    return MappingProxyType(names)


GROUPS: Mapping[str, tuple[type[HiddenEffect], ...]] = MappingProxyType(
    {
        "wall": WALL_FORMS,
        "interface": INTERFACE_FORMS,
        "slip": SLIP_FORMS,
        "organ": ORGAN_FORMS,
        "session": SESSION_FORMS,
        "sensor": SENSOR_FORMS,
        "drive": DRIVE_FORMS,
    }
)
"""Forms by what they act on; the order of groups and forms decides what a seed draws."""
CATALOGUE = _by_name(*chain.from_iterable(GROUPS.values()))
"""Forms of every effect of the catalogue."""
OUTSIDE = _by_name(*OUTSIDE_FORCE_FORMS, *OUTSIDE_POSITION_FORMS)
"""Forms of the effects that the catalogue does not have."""


def effect_group(effect_id: str) -> str:
    """Return the group of an effect of the catalogue: two of one group are hard to tell apart."""
    return next(group for group, forms in GROUPS.items() if effect_id in {form.name for form in forms})
