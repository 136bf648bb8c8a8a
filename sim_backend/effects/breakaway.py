"""An aged contact that takes more force to start."""

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
from dragrig.sim_backend.effects.run_state import RunState


class Breakaway(ForceEffect):
    """f_c grows by `ratio · exp(−distance / slip)` over the distance since the start."""

    id: ClassVar[str] = "breakaway"
    called: ClassVar[str] = "breakaway friction"
    place: ClassVar[EffectLocation] = EffectLocation.INTERFACE
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.TRANSIENT
    summary: ClassVar[str] = "An aged contact needs more force to start and loses it over a short slip."
    exposes: ClassVar[str] = "the first tenths of a millimetre of Coulomb and drag runs"
    source: ClassVar[str] = (
        "contact ageing renewed over a memory length; Dieterich, Journal of Geophysical Research 84 (1979) 2161; "
        "Baumberger and Caroli, Advances in Physics 55 (2006) 279"
    )
    aliases: ClassVar[tuple[str, ...]] = ("presliding",)
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter(
            "ratio", "1", ParameterRole.SIZE, 0.5, 0.0, 5.0, "friction at the start over Coulomb friction, less 1"
        ),
        EffectParameter(
            "slip_mm", "mm", ParameterRole.SHAPE, 0.2, 0.02, 2.0, "slip that loses it", tried=(0.05, 0.1, 0.2, 0.4, 0.8)
        ),
    )

    def added(self, scene: RunState, values: Mapping[str, float]) -> FloatArray:
        """Return the friction of the aged contact."""
        return np.asarray(scene.f_c * values["ratio"] * np.exp(-scene.stance.slid_mm / values["slip_mm"]))


EFFECT = Breakaway()
