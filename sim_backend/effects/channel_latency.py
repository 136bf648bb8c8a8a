"""Force and position that are not sampled at the same instant."""

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import (
    Channel,
    Coordinate,
    EffectParameter,
    Location,
    MeasuringLink,
    PositionForm,
    Role,
    SensorEffect,
    Values,
)
from dragrig.sim_backend.effects.run_state import RunState


class ChannelLatency(SensorEffect):
    """The force channel shows the force of `latency` ago, or of a little later where that is negative."""

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
    parameters = (EffectParameter("latency_s", "s", Role.SIZE, 0.008, -0.1, 0.1, "force behind position"),)

    def measured_force(self, run: RunState, force_mN: FloatArray, values: Values) -> FloatArray:
        """Return the force at another time; outside of the run it is as at its ends."""
        return np.asarray(np.interp(run.time_s - values["latency_s"], run.time_s, force_mN))


EFFECT = ChannelLatency()
