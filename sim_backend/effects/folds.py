"""Circular folds of the mucosa."""

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

WAVELENGTHS_MM = tuple(round(1 / float(one), 3) for one in np.linspace(1 / 20, 1 / 1.5, 40))
"""Evenly spaced in wavenumber: over 40 mm no wavelength is more than a third of a period from one of them."""


class Folds(ForceEffect):
    """f_e and f_c are modulated by `depth · sin(2π · position / wavelength + phase)`."""

    id: ClassVar[str] = "folds"
    called: ClassVar[str] = "circular folds"
    place: ClassVar[EffectLocation] = EffectLocation.WALL
    domain: ClassVar[EffectCoordinate] = EffectCoordinate.POSITION
    summary: ClassVar[str] = "Circular folds modulate the force periodically in position."
    exposes: ClassVar[str] = "the spectrum of drag runs against position, at the same wavelength at all speeds"
    source: ClassVar[str] = (
        "plicae circulares pass the capsule one by one; first harmonic of a wall whose stiffness is periodic along it, "
        "anatomy in Gray's Anatomy (2015), small intestine"
    )
    aliases: ClassVar[tuple[str, ...]] = ("velocity_ripple",)
    parameters: ClassVar[tuple[EffectParameter, ...]] = (
        EffectParameter("depth", "1", ParameterRole.SIZE, 0.1, 0.0, 1.0, "amplitude over the nominal force"),
        EffectParameter(
            "wavelength_mm", "mm", ParameterRole.SHAPE, 4.0, 1.2, 25.0, "distance of the folds", tried=WAVELENGTHS_MM
        ),
        EffectParameter("phase_rad", "rad", ParameterRole.PHASE, 0.0, -3.15, 3.15, "of the sine where the run begins"),
    )

    def added(self, scene: RunState, values: Mapping[str, float]) -> FloatArray:
        """Return the modulation."""
        if not scene.closed:
            return np.zeros_like(scene.time_s)
        angle = 2 * np.pi * scene.position_mm / values["wavelength_mm"] + values["phase_rad"]
        return np.asarray((scene.f_e + scene.f_c) * values["depth"] * np.sin(angle))


EFFECT = Folds()
