"""Play and friction in the force chain: what is shown depends on where the force comes from."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import (
    EffectCoordinate,
    EffectLocation,
    EffectParameter,
    ParameterRole,
    SensorEffect,
)
from dragrig.sim_backend.effects.run_state import RunState
from dragrig.sim_backend.friction.wall import linear_recursion


class ForceHysteresis(SensorEffect):
    """A force that rises is shown too low by `half_width`, one that falls too high; a reversal takes `reversal` mN."""

    id: ClassVar[str] = "force_hysteresis"
    called: ClassVar[str] = "hysteresis of the force sensor"
    place: ClassVar[EffectLocation] = EffectLocation.FORCE_SENSOR
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.TRANSIENT
    summary: ClassVar[str] = "Play or friction in the force chain holds back what is shown of a change of force."
    exposes: ClassVar[str] = "reversals of the force, small signals, the hold after a stop"
    source: ClassVar[str] = (
        "Dahl, A solid friction model, Aerospace Corporation TOR-0158 (1968), with force as its path"
    )
    aliases: ClassVar[tuple[str, ...]] = ("presliding",)
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("half_width_mN", "mN", ParameterRole.SIZE, 8.0, 0.0, 200.0, "half the width of the loop"),
        EffectParameter(
            "reversal_mN",
            "mN",
            ParameterRole.SHAPE,
            10.0,
            0.5,
            300.0,
            "change of force that turns it",
            tried=(5.0, 50.0),
        ),
    )

    def shown(self, scene: RunState, force_mN: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the force less what is held back, which starts at nothing."""
        del scene
        change = np.diff(force_mN, prepend=force_mN[:1])
        kept = np.exp(-np.abs(change) / values["reversal_mN"])
        held = linear_recursion(kept, np.sign(change) * (1 - kept))
        return np.asarray(force_mN - values["half_width_mN"] * held)


EFFECT = ForceHysteresis()
