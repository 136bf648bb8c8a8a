"""Hidden effects by id: those of the catalogue in other functional forms, and some that it does not have."""

from collections.abc import Mapping
from types import MappingProxyType, ModuleType

from dragrig.sim_backend.blind.effects import drawn_forms, gut, instrument
from dragrig.sim_backend.blind.effects.hidden_effect import HiddenEffect

GROUPS = {
    "wall": ("wall_lift_off", "wall_inertia", "hyperelastic_wall", "extra_relaxation"),
    "interface": ("stribeck", "adhesion", "film_depletion"),
    "slip": ("breakaway", "presliding"),
    "organ": ("folds", "mesentery_tether", "peristalsis"),
    "session": ("tissue_ageing", "preconditioning"),
    "sensor": (
        "force_drift",
        "force_nonlinearity",
        "force_hysteresis",
        "mains_hum",
        "payload_inertia",
        "arm_compliance",
    ),
    "drive": ("servo_lag", "velocity_ripple", "channel_latency", "encoder_scale"),
}
"""Effects of the catalogue by what they act on; their order decides what a seed draws."""

RIG_GROUPS = ("sensor", "drive")
"""Groups of effects that belong to the rig; the others belong to the gut."""

EVERYWHERE = ("payload_inertia", "arm_compliance", "servo_lag", "velocity_ripple", "encoder_scale", "force_hysteresis")
IN_ONE_STROKE = ("folds", "velocity_ripple")
"""Effects that a single stroke can show; what falls or grows in one could be anything."""
IN_DRAGS = ("folds", "peristalsis", "mesentery_tether", "stribeck", "film_depletion", *EVERYWHERE)
"""Effects that show without relaxations, Coulomb and blank runs."""

FOREIGN = (
    "amplifier_saturates",
    "stick_slip",
    "current_crosstalk",
    "loose_coupling",
    "gain_switches",
    "fixture_creeps",
    "foam_resonance",
    "wall_seam",
    "thermostat_zero",
    "table_vibration",
    "missing_bits",
    "suction",
    "brake_clamps",
    "cable_loop",
    "encoder_misses",
    "stage_yields",
    "clock_off",
)
"""Effects that the catalogue does not have; their order decides what a seed draws."""


def _forms_by_name(*modules: ModuleType) -> dict[str, tuple[type[HiddenEffect], ...]]:
    """Return the forms that modules define, in the order of their definition, which decides the draws of a seed."""
    forms: dict[str, tuple[type[HiddenEffect], ...]] = {}
    for module in modules:
        for form in vars(module).values():
            if isinstance(form, type) and issubclass(form, HiddenEffect) and hasattr(form, "name"):
                forms[form.name] = (*forms.get(form.name, ()), form)
    return forms


_FORMS = _forms_by_name(gut, instrument)
CATALOGUE: Mapping[str, tuple[type[HiddenEffect], ...]] = MappingProxyType(
    {name: _FORMS[name] for names in GROUPS.values() for name in names}
)
"""Forms of every effect of the catalogue."""
OUTSIDE: Mapping[str, tuple[type[HiddenEffect], ...]] = MappingProxyType({name: _FORMS[name] for name in FOREIGN})
"""Forms of the effects that the catalogue does not have."""
DRAWN: Mapping[str, tuple[type[HiddenEffect], ...]] = MappingProxyType(_forms_by_name(drawn_forms))
"""Forms whose law is drawn at random, of every effect of the catalogue and of `outside`, one that it does not have."""


def effect_group(effect_id: str) -> str:
    """Return the group of an effect of the catalogue: two of one group are hard to tell apart."""
    return next(group for group, names in GROUPS.items() if effect_id in names)
