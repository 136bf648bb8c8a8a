"""What differs between specimens, rigs and runs, and is to be determined: the capsule model's parameters."""

from collections.abc import Mapping

from dragrig.analysis.nominal.protocol import Combination, Parameter, Variation
from dragrig.config.model import FrictionModelSettings

CHANNEL = "force"
BETWEEN_SPECIMENS = {
    "stiffness_scale": (0.15, "common scale of E1, E2, E3, η1, η2"),
    "e1_scale": (0.07, "scale of E1 on its own"),
    "e2_scale": (0.07, "scale of E2 on its own"),
    "e3_scale": (0.07, "scale of E3 on its own"),
    "eta1_scale": (0.07, "scale of η1 on its own"),
    "eta2_scale": (0.07, "scale of η2 on its own"),
    "friction_coefficient": (0.12, "Coulomb friction coefficient μ"),
    "mucus_scale": (0.20, "scale of the mucus' apparent viscosity"),
    "force_gain": (0.005, "true gain of the force channel"),
    "insertion_dwell_scale": (0.25, "true over noted age of the contact"),
}
"""Relative standard deviations between specimens and rigs, by name in the model's settings."""
DWELL = "insertion_dwell_scale"
ANGLE = "contact_angle_offset_deg"
ANGLE_SD_DEG = 0.7
ZERO_SD_MN = 5.0
VARIATIONS = (Variation("stiffness", 0.02), Variation("friction", 0.015))


def parameters_of(settings: FrictionModelSettings) -> tuple[Parameter, ...]:
    """Return the scales, friction coefficient, gain and contact angle, with what is known of any specimen."""
    scales = tuple(
        Parameter(name, "1", float(getattr(settings, name)), sd, meaning=meaning)
        for name, (sd, meaning) in BETWEEN_SPECIMENS.items()
    )
    angle = Parameter(
        ANGLE, "deg", settings.contact_angle_offset_deg, ANGLE_SD_DEG, False, "contact angle over the capsule's"
    )
    return (*scales, angle)


def _shown(name: str, powers: Mapping[str, float], meaning: str) -> Combination:
    return Combination(name, "1", {"force_gain": 1.0, **powers}, f"{meaning} as the force channel shows it")


def _element_shown(name: str, scale: str, symbol: str) -> Combination:
    return _shown(name, {"stiffness_scale": 1.0, scale: 1.0}, f"scale of {symbol}")


COMBINATIONS = (
    _element_shown("e1_shown", "e1_scale", "E1"),
    _element_shown("e2_shown", "e2_scale", "E2"),
    _element_shown("e3_shown", "e3_scale", "E3"),
    _element_shown("eta1_shown", "eta1_scale", "η1"),
    _element_shown("eta2_shown", "eta2_scale", "η2"),
    Combination("fast_time_scale", "1", {"eta1_scale": 1.0, "e1_scale": -1.0}, "scale of the time constant η1/E1"),
    Combination("slow_time_scale", "1", {"eta2_scale": 1.0, "e2_scale": -1.0}, "scale of the time constant η2/E2"),
    _shown("friction_shown", {"friction_coefficient": 1.0}, "friction coefficient"),
    _shown("mucus_shown", {"mucus_scale": 1.0}, "scale of the viscosity"),
)
