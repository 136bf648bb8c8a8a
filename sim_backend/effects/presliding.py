"""Friction that builds up over a deflection of the interface, and stays locked in at standstill."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import (
    EffectCoordinate,
    EffectLocation,
    EffectParameter,
    ForceEffect,
    ParameterRole,
)
from dragrig.sim_backend.effects.dynamics import bristle_deflection
from dragrig.sim_backend.effects.run_state import RunState, normal_force


class Presliding(ForceEffect):
    """A share of f_c becomes `μ N z`, with z a bristle's deflection over its steady one."""

    id: ClassVar[str] = "presliding"
    called: ClassVar[str] = "presliding friction"
    place: ClassVar[EffectLocation] = EffectLocation.INTERFACE
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.TRANSIENT
    summary: ClassVar[str] = (
        "Friction builds up over a bristle deflection instead of at once, and stays locked in at standstill."
    )
    exposes: ClassVar[str] = "the first tenths of a millimetre, and the hold after stopping, of Coulomb and drag runs"
    source: ClassVar[str] = (
        "Dahl, Aerospace Corporation report TOR-0158(3107-18)-1 (1968); bristles of Canudas de Wit et al., "
        "IEEE Transactions on Automatic Control 40 (1995) 419"
    )
    aliases: ClassVar[tuple[str, ...]] = ("breakaway", "force_hysteresis")
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("share", "1", ParameterRole.SIZE, 0.6, 0.0, 1.0, "share of Coulomb friction that builds up so"),
        EffectParameter(
            "deflection_mm",
            "mm",
            ParameterRole.SHAPE,
            0.1,
            0.01,
            2.0,
            "distance over which it does",
            tried=(0.03, 0.06, 0.12, 0.25, 0.5),
        ),
    )

    def added(self, scene: RunState, values: Mapping[str, float]) -> FloatArray:
        """Return the friction of the bristles beside that of the share that they take."""
        if not scene.sliding:
            return np.zeros_like(scene.time_s)
        bristles = bristle_deflection(scene.motion, scene.time_s, values["deflection_mm"])
        friction = scene.friction_coefficient * normal_force(scene) * bristles
        return np.asarray(values["share"] * (friction - scene.f_c))


EFFECT = Presliding()
