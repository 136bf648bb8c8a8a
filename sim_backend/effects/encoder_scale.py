"""An encoder whose counts times pitch is not the distance."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import (
    EffectCoordinate,
    EffectLocation,
    EffectParameter,
    EncoderEffect,
    ParameterRole,
)


class EncoderScale(EncoderEffect):
    """The recorded position is the true one times `1 + scale_error`."""

    id: ClassVar[str] = "encoder_scale"
    place: ClassVar[EffectLocation] = EffectLocation.ACQUISITION
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.POSITION
    summary: ClassVar[str] = "The encoder's counts times its pitch is not the distance."
    exposes: ClassVar[str] = "position against command, in proportion to travel"
    source: ClassVar[str] = "error of scale; Slocum, Precision Machine Design, chapter 4"
    aliases: ClassVar[tuple[str, ...]] = ("velocity_ripple",)
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("scale_error", "1", ParameterRole.SIZE, 0.002, -0.1, 0.1, "relative"),
    )

    def recorded(self, time_s: FloatArray, position_mm: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the position as it is counted."""
        del time_s
        return np.asarray(position_mm * (1 + values["scale_error"]))


EFFECT = EncoderScale()
