"""Force and position that are not sampled at the same instant."""

import numpy as np

from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import (
    Channel,
    Coordinate,
    Location,
    MeasuringLink,
    PositionForm,
    RunState,
    SensorEffect,
    Values,
    size,
)


class ChannelLatency(SensorEffect):
    """The force channel lags the position by `latency`, or leads it where that is negative."""

    id = "channel_latency"
    location = Location.ACQUISITION
    coordinate = Coordinate.TRANSIENT
    summary = "Force and position are not sampled at the same instant."
    visible_in = "fast transients: force against measured position at starts and stops"
    link = MeasuringLink.CLOCK
    source = "pure delay between channels; Bendat and Piersol, Random Data, section 5.1"
    confused_with = ("arm_compliance",)
    similar_to = ("arm_compliance", "payload_inertia")
    abrupt = True
    channels = (Channel.FORCE, Channel.POSITION)
    position_form = PositionForm.DELAY
    parameters = (size("latency_s", "s", 0.008, -0.1, 0.1, "delay of the force behind the position"),)

    def measured_force(self, run: RunState, force_mN: FloatArray, values: Values) -> FloatArray:
        """Return the delayed force; beyond the ends of the run it is constant."""
        return np.asarray(np.interp(run.time_s - values["latency_s"], run.time_s, force_mN))
