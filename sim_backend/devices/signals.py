"""The channels of one acquisition as the devices report them, computed for any stretch of samples."""

from collections.abc import Mapping

import numpy as np

from dragrig.config.model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.arrays import AnyFloatArray, read_only
from dragrig.rig.devices import Acquisition
from dragrig.rig.profile import MotionProfile
from dragrig.rig.runfile.model import Channel
from dragrig.sim_backend.devices.axis import Track
from dragrig.sim_backend.devices.course import AffectedCourse, Course, NominalCourse
from dragrig.sim_backend.devices.faults import Faults
from dragrig.sim_backend.devices.instruments import Converter, Encoder, motor_force
from dragrig.sim_backend.devices.noise import force_noise, motor_noise
from dragrig.sim_backend.devices.variation import draw_run
from dragrig.sim_backend.effects.applied import Chain


def recorded_channels(rig: RigSettings) -> tuple[Channel, ...]:
    """Return the channels that the settings ask for."""
    always = (Channel("force", "mN"), Channel("position", "mm"))
    return (*always, Channel("motor_force", "mN")) if rig.sampling.motor_force else always


class Signals:
    """What force sensor, encoder and motor show during one acquisition.

    The noise belongs to the index of a sample and not to the motion, so a stop does not change it.

    Parameters
    ----------
    model
        The session's model; the run's own variation is drawn from it here.
    session_start_s
        The first sample on the session's clock.
    """

    def __init__(
        self,
        rig: RigSettings,
        model: FrictionModelSettings,
        acquisition: Acquisition,
        faults: Faults,
        session_start_s: float = 0.0,
    ) -> None:
        simulated, rate = rig.simulated, rig.sampling.rate_hz
        self._rig = rig
        self._acquisition = acquisition
        self._faults = faults
        self._model = draw_run(model, simulated.variation, simulated.seed, acquisition.order)
        self._converter = Converter.of(rig.force_sensor)
        self._encoder = Encoder.of(rig.encoder)
        self._force_noise = force_noise(simulated.noise, simulated.seed, acquisition, rate)
        self._motor_noise = motor_noise(simulated.motor, simulated.seed, acquisition)
        self._chain = Chain.of(model) if model.effects else None
        self._session_start_s = session_start_s
        self._profile = acquisition.profile
        self._course = self._course_of(acquisition.profile)

    def follow(self, track: Track) -> None:
        """Compute from here on for another motion; nothing is done when it is the present one."""
        if track.profile is not self._profile:
            self._profile = track.profile
            self._course = self._course_of(track.profile)

    def compute(self, first: int, end: int, origin_mm: float) -> Mapping[str, AnyFloatArray]:
        """Return all channels from sample `first` to before `end`, read-only; `first` never goes back."""
        time = np.arange(first, end) / self._rig.sampling.rate_hz
        now = self._course.at(time, self._faults.encoder_time(time))
        channels: dict[str, AnyFloatArray] = {}
        force = now.force_mN + self._force_noise.read(first, end)
        force += self._faults.extra_force(time)
        channels["force"] = self._converter.convert(force)
        position = now.counted_mm
        position += self._faults.position_error(time)
        channels["position"] = self._encoder.record(position, origin_mm)
        if self._rig.sampling.motor_force:
            motor = motor_force(self._rig.simulated.motor, now.motion, now.load_mN)
            motor += self._motor_noise.read(first, end)
            channels["motor_force"] = motor.astype(np.float32)
        for array in channels.values():
            read_only(array)
        return channels

    def _course_of(self, profile: MotionProfile) -> Course:
        if self._chain is None:
            return NominalCourse.of(self._acquisition, self._model, profile)
        rate_hz = self._rig.sampling.rate_hz
        return AffectedCourse.of(self._acquisition, self._model, profile, self._chain, rate_hz, self._session_start_s)
