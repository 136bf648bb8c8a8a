"""Hidden effects by id: those of the catalogue in other functional forms, and some that it does not have."""

from collections.abc import Mapping
from types import MappingProxyType

from dragrig.sim_backend.blind.effects import gut as organ
from dragrig.sim_backend.blind.effects import gut as session
from dragrig.sim_backend.blind.effects import gut as wall
from dragrig.sim_backend.blind.effects import instrument as drive
from dragrig.sim_backend.blind.effects import instrument as sensor
from dragrig.sim_backend.blind.effects import interface, outside
from dragrig.sim_backend.blind.effects import interface as slip
from dragrig.sim_backend.blind.effects import outside as outside_position
from dragrig.sim_backend.blind.effects.base import HiddenEffect


def _by_name(*groups: tuple[type[HiddenEffect], ...]) -> Mapping[str, tuple[type[HiddenEffect], ...]]:
    names: dict[str, tuple[type[HiddenEffect], ...]] = {}
    for form in (form for group in groups for form in group):
        names[form.name] = (*names.get(form.name, ()), form)
    return MappingProxyType(names)


CATALOGUE = _by_name(
    wall.WALL_FORMS,
    interface.INTERFACE_FORMS,
    slip.SLIP_FORMS,
    organ.ORGAN_FORMS,
    session.SESSION_FORMS,
    sensor.SENSOR_FORMS,
    drive.DRIVE_FORMS,
)
"""Forms of every effect of the vocabulary."""
OUTSIDE = _by_name(outside.OUTSIDE_FORCE_FORMS, outside_position.OUTSIDE_POSITION_FORMS)
"""Forms of the effects that the vocabulary does not have."""
