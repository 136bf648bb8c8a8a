"""Mains pick-up in the force channel."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import (
    Coordinate,
    Location,
    MeasuringLink,
    RunState,
    SensorEffect,
    Values,
    phase,
    shape,
    size,
)


class MainsHum(SensorEffect):
    """A sine at the mains frequency; as no run starts in step with the mains, its phase differs from run to run."""

    id = "mains_hum"
    location = Location.FORCE_SENSOR
    coordinate = Coordinate.FREQUENCY
    summary = "The force channel picks up the mains' frequency."
    visible_in = "all phases of every run, rest included"
    link = MeasuringLink.AMPLIFIER
    source = "Horowitz and Hill, The Art of Electronics, chapter 8 (interference)"
    period_parameter = "frequency_hz"
    spectral_line = True
    parameters = (
        size("amplitude_mN", "mN", 5.0, 0.0, 100.0, "amplitude"),
        shape("frequency_hz", "Hz", 50.0, 45.0, 65.0, "mains frequency", grid=(50.0, 60.0)),
        phase("phase_rad", "rad", 0.0, -np.pi, np.pi, "at the session's first sample"),
    )

    @property
    def varies_in_session(self) -> bool:
        """Its phase differs from run to run."""
        return True

    def measured_force(self, run: RunState, force_mN: FloatArray, values: Values) -> FloatArray:
        """Return the force with the hum on the session's clock."""
        angle = 2 * np.pi * values["frequency_hz"] * run.session_s + values["phase_rad"]
        return np.asarray(force_mN + values["amplitude_mN"] * np.sin(angle))
