"""Hidden effects by id: those of the catalogue in other functional forms, and some that it does not have."""

from collections.abc import Mapping
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


CATALOGUE = _by_name(
    *WALL_FORMS, *INTERFACE_FORMS, *SLIP_FORMS, *ORGAN_FORMS, *SESSION_FORMS, *SENSOR_FORMS, *DRIVE_FORMS
)
"""Forms of every effect of the catalogue; their order decides which form a seed draws."""
OUTSIDE = _by_name(*OUTSIDE_FORCE_FORMS, *OUTSIDE_POSITION_FORMS)
"""Forms of the effects that the catalogue does not have."""
