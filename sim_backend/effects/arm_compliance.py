"""An arm that rings after every jerk."""

from collections.abc import Mapping
from typing import ClassVar

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Domain, EffectParameter, Place, Role, SensorEffect
from dragrig.sim_backend.effects.dynamics import resonator
from dragrig.sim_backend.effects.scene import Scene


class ArmCompliance(SensorEffect):
    """A lightly damped mass on the arm, driven by the stage's acceleration."""

    id: ClassVar[str] = "arm_compliance"
    place: ClassVar[Place] = Place.FORCE_SENSOR
    domain: ClassVar[Domain] = Domain.TRANSIENT
    summary: ClassVar[str] = "The arm that carries the sensor rings after every jerk."
    exposes: ClassVar[str] = "accelerate, decelerate and what follows, blank runs included"
    source: ClassVar[str] = "damped oscillator driven by its support; Thomson, Theory of Vibration, section 3.5"
    aliases: ClassVar[tuple[str, ...]] = ("payload_inertia",)
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("mass_g", "g", Role.SIZE, 30.0, 0.0, 500.0, "mass that swings"),
        EffectParameter(
            "frequency_hz", "Hz", Role.SHAPE, 18.0, 5.0, 60.0, "resonance", tried=(6.0, 9.0, 13.0, 18.0, 26.0, 38.0)
        ),
        EffectParameter("damping", "1", Role.SHAPE, 0.05, 0.01, 0.3, "share of critical damping", tried=(0.03, 0.1)),
    )

    def shown(self, scene: Scene, force_mN: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the force with that of the mass that swings; g · mm/s² is µN."""
        driving = scene.acceleration_mm_s2 * (1e-3 * values["mass_g"])
        return force_mN + resonator(scene.time_s, driving, values["frequency_hz"], values["damping"])


EFFECT = ArmCompliance()
