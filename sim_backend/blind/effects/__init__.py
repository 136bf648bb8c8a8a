"""Hidden effects by name: those of the catalogue's vocabulary in other forms, and some that it does not have."""

from collections.abc import Mapping
from types import MappingProxyType

from dragrig.sim_backend.blind.effects import (
    drive,
    interface,
    organ,
    outside,
    outside_position,
    sensor,
    session,
    slip,
    wall,
)
from dragrig.sim_backend.blind.effects.base import Effect


def _by_name(*groups: tuple[type[Effect], ...]) -> Mapping[str, tuple[type[Effect], ...]]:
    names: dict[str, tuple[type[Effect], ...]] = {}
    for form in (form for group in groups for form in group):
        names[form.name] = (*names.get(form.name, ()), form)
    return MappingProxyType(names)


CATALOGUE = _by_name(wall.FORMS, interface.FORMS, slip.FORMS, organ.FORMS, session.FORMS, sensor.FORMS, drive.FORMS)
"""Forms of every effect of the vocabulary."""
OUTSIDE = _by_name(outside.FORMS, outside_position.FORMS)
"""Forms of the effects that the vocabulary does not have."""
