"""Cogging or pitch error of the drive."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import (
    EffectCoordinate,
    EffectLocation,
    EffectParameter,
    MotorEffect,
    ParameterRole,
)

PITCHES_MM = tuple(round(float(1 / wave), 3) for wave in np.linspace(1 / 20, 1.0, 40))
"""From 20 to 1 mm, evenly in waves per mm: a stroke of 20 mm tells neighbours apart no better than half."""


class VelocityRipple(MotorEffect):
    """The stage is ahead of its command, or behind it, by a sine of where it is."""

    id: ClassVar[str] = "velocity_ripple"
    place: ClassVar[EffectLocation] = EffectLocation.MOTOR
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.POSITION
    summary: ClassVar[str] = "Cogging or pitch error makes the stage's velocity ripple with its position."
    exposes: ClassVar[str] = "position against command, at the same places in every run"
    source: ClassVar[str] = "Gieras, Piech and Tomczuk, Linear Synchronous Motors, chapter 3 (detent force)"
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("amplitude_mm", "mm", ParameterRole.SIZE, 0.03, 0.0, 1.0, "amplitude in position"),
        EffectParameter("pitch_mm", "mm", ParameterRole.SHAPE, 5.0, 0.5, 50.0, "length of a period", tried=PITCHES_MM),
        EffectParameter("phase_rad", "rad", ParameterRole.PHASE, 0.0, -np.pi, np.pi, "where a run starts"),
    )

    def moved(self, time_s: FloatArray, command_mm: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Return the position with the ripple, which is nothing at the start."""
        del time_s
        phase = values["phase_rad"]
        ripple = np.sin(2 * np.pi * command_mm / values["pitch_mm"] + phase) - np.sin(phase)
        return np.asarray(command_mm + values["amplitude_mm"] * ripple)


EFFECT = VelocityRipple()
