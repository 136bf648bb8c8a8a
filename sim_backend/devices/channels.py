"""The channels of one simulated acquisition: from motion and load to what force sensor, encoder and motor report."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import ForceSensorSettings, MotorSettings, RigSettings
from dragrig.config.specimen import Capsule, Fixture, Specimen
from dragrig.rig.arrays import AnyFloatArray, FloatArray, read_only
from dragrig.rig.devices import Acquisition, Contact
from dragrig.rig.profile import MotionProfile, Phase, stationary_piece, trapezoid
from dragrig.rig.runfile.model import Channel
from dragrig.sim_backend.devices.faults import Faults
from dragrig.sim_backend.devices.simulated_stage import PositionEncoder, StageMotion, Track, evaluate_profile
from dragrig.sim_backend.devices.variability import draw_run_model, force_noise, motor_noise
from dragrig.sim_backend.effects.chain import EffectChain, evaluation_rate_hz, evaluation_times
from dragrig.sim_backend.effects.run_state import gut_run_state
from dragrig.sim_backend.friction import prepare
from dragrig.sim_backend.friction.motion import ProfileMotion
from dragrig.sim_backend.friction.prepared import PreparedForce
from dragrig.sim_backend.friction.recorded_motion import RecordedMotion

BEARING_SPEED_MM_S = 0.05
"""Speed over which the Coulomb friction of the stage's bearing changes sign."""

MN_PER_G_MM_S2 = 1e-3
"""Millinewtons that accelerate one gram by one mm/s²."""


@dataclass(frozen=True, slots=True)
class ForceConverter:
    """The force sensor's A/D converter: `2^bits` codes over both signs of the range."""

    step_mN: float
    lowest_code: int
    highest_code: int

    @classmethod
    def of(cls, settings: ForceSensorSettings) -> "ForceConverter":
        """Return the converter of the settings."""
        half = 2 ** (settings.bits - 1)
        return cls(step_mN=settings.range_mN / half, lowest_code=-half, highest_code=half - 1)

    @property
    def range_mN(self) -> tuple[float, float]:
        """Least and greatest output, in single precision as recorded."""
        ends = np.array([self.lowest_code * self.step_mN, self.highest_code * self.step_mN], dtype=np.float32)
        return float(ends[0]), float(ends[1])

    def convert(self, force_mN: FloatArray) -> npt.NDArray[np.float32]:
        """Return the force in steps of the converter, clipped at its range; `force_mN` is overwritten."""
        force_mN /= self.step_mN
        np.rint(force_mN, out=force_mN)
        np.clip(force_mN, self.lowest_code, self.highest_code, out=force_mN)
        force_mN *= self.step_mN
        return force_mN.astype(np.float32)


def motor_force(settings: MotorSettings, motion: StageMotion, load_mN: FloatArray) -> FloatArray:
    """Return the motor's force [mN]: inertia, bearing friction, offset and load."""
    force = np.tanh(motion.velocity / BEARING_SPEED_MM_S)
    force *= settings.coulomb_mN
    force += settings.offset_mN
    force += settings.viscous_mN_s_mm * motion.velocity
    force += (settings.moving_mass_g * MN_PER_G_MM_S2) * motion.acceleration
    force += load_mN
    return force


@dataclass(frozen=True, slots=True, eq=False)
class NoiseFreeSamples:
    """Motion, forces and position at `n` times before noise and converters, new arrays of shape `(n,)`.

    Attributes
    ----------
    motion
        Motion of the stage.
    counted_mm
        Position before it is rounded to counts.
    force_mN
        Force that the channel shows.
    load_mN
        True force on the capsule.
    """

    motion: StageMotion
    counted_mm: FloatArray
    force_mN: FloatArray
    load_mN: FloatArray


class RunResponse(Protocol):
    """How rig and gut respond to the profile of an acquisition."""

    def at(self, time_s: FloatArray, counted_s: FloatArray) -> NoiseFreeSamples:
        """Return the samples at rising times, the counted position at others if the encoder is stuck."""
        ...


@dataclass(frozen=True, slots=True)
class NominalResponse:
    """Response without effects: the stage follows its profile, the gut is the nominal model's."""

    profile: MotionProfile
    friction: PreparedForce

    @classmethod
    def of(cls, acquisition: Acquisition, model: FrictionModelSettings, profile: MotionProfile) -> "NominalResponse":
        """Prepare the friction for a profile."""
        return cls(profile, prepare(replace(acquisition, profile=profile), model))

    def at(self, time_s: FloatArray, counted_s: FloatArray) -> NoiseFreeSamples:
        """Return the profile's motion and the model's force."""
        motion = evaluate_profile(self.profile, time_s)
        counted = motion if counted_s is time_s else evaluate_profile(self.profile, counted_s)
        force = self.friction.force(time_s)
        return NoiseFreeSamples(motion, counted.position, force, force / self.friction.force_gain)


@dataclass(frozen=True, slots=True, eq=False)
class ResponseWithEffects:
    """Response with effects, computed once at fixed times from the first sample on, whatever the size of blocks.

    Attributes
    ----------
    path
        The stage's motion.
    time_s, counted_mm, force_mN, load_mN
        Times, and the channels at them, shape `(n,)`.
    """

    path: ProfileMotion | RecordedMotion
    time_s: FloatArray
    counted_mm: FloatArray
    force_mN: FloatArray
    load_mN: FloatArray

    @classmethod
    def of(
        cls,
        acquisition: Acquisition,
        model: FrictionModelSettings,
        profile: MotionProfile,
        chain: EffectChain,
        rate_hz: float,
        session_start_s: float,
    ) -> "ResponseWithEffects":
        """Compute the response to a commanded profile; the times depend on the acquisition alone."""
        time = evaluation_times(profile.duration_s, evaluation_rate_hz(rate_hz, acquisition.profile.duration_s))
        path: ProfileMotion | RecordedMotion = ProfileMotion.of(profile)
        position = path.position(time)
        if chain.moves_stage:
            position = chain.stage_position(time, position)
            path = RecordedMotion.computed(time, position)
        run = gut_run_state(replace(acquisition, profile=profile), model, path, time, session_start_s)
        load = chain.load(run)
        return cls(
            path=path,
            time_s=time,
            counted_mm=chain.counted_position(time, position),
            force_mN=chain.measured_force(run, load, model.force_gain),
            load_mN=load,
        )

    def at(self, time_s: FloatArray, counted_s: FloatArray) -> NoiseFreeSamples:
        """Return the computed response, linearly interpolated."""
        pieces = self.path.pieces()
        index = np.maximum(np.searchsorted(pieces.start_s, time_s, side="right") - 1, 0)
        acceleration = np.asarray(pieces.acceleration_mm_s2[index])
        return NoiseFreeSamples(
            motion=StageMotion(self.path.position(time_s), self.path.velocity(time_s), acceleration),
            counted_mm=np.asarray(np.interp(counted_s, self.time_s, self.counted_mm)),
            force_mN=np.asarray(np.interp(time_s, self.time_s, self.force_mN)),
            load_mN=np.asarray(np.interp(time_s, self.time_s, self.load_mN)),
        )


def recorded_channels(rig: RigSettings) -> tuple[Channel, ...]:
    """Return the channels that the settings ask for."""
    always = (Channel("force", "mN"), Channel("position", "mm"))
    return (*always, Channel("motor_force", "mN")) if rig.sampling.motor_force else always


class SimulatedChannels:
    """Readings of force sensor, encoder and motor during one acquisition.

    The noise is a function of the sample's index, not of the motion, so that a stop does not change it.

    Parameters
    ----------
    model
        The session's model; the run's variation is drawn around it here.
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
        self._model = draw_run_model(model, simulated.variation, simulated.seed, acquisition.order)
        self._converter = ForceConverter.of(rig.force_sensor)
        self._encoder = PositionEncoder.of(rig.encoder)
        self._force_noise = force_noise(simulated.noise, simulated.seed, acquisition, rate)
        self._motor_noise = motor_noise(simulated.motor, simulated.seed, acquisition)
        self._chain = EffectChain.of(model) if model.effects else None
        self._session_start_s = session_start_s
        self._profile = acquisition.profile
        self._response = self._response_to(acquisition.profile)

    def follow(self, track: Track) -> None:
        """Compute further samples for another motion, if it differs from the present one."""
        if track.profile is not self._profile:
            self._profile = track.profile
            self._response = self._response_to(track.profile)

    def compute(self, first: int, end: int, origin_mm: float) -> Mapping[str, AnyFloatArray]:
        """Return all channels from sample `first` to before `end`, read-only; `first` never goes back."""
        time = np.arange(first, end) / self._rig.sampling.rate_hz
        ideal = self._response.at(time, self._faults.encoder_time(time))
        channels: dict[str, AnyFloatArray] = {}
        force = ideal.force_mN + self._force_noise.read(first, end)
        force += self._faults.extra_force(time)
        channels["force"] = self._converter.convert(force)
        position = ideal.counted_mm
        position += self._faults.position_error(time)
        channels["position"] = self._encoder.record(position, origin_mm)
        if self._rig.sampling.motor_force:
            motor = motor_force(self._rig.simulated.motor, ideal.motion, ideal.load_mN)
            motor += self._motor_noise.read(first, end)
            channels["motor_force"] = motor.astype(np.float32)
        for array in channels.values():
            read_only(array)
        return channels

    def _response_to(self, profile: MotionProfile) -> RunResponse:
        if self._chain is None:
            return NominalResponse.of(self._acquisition, self._model, profile)
        rate_hz = self._rig.sampling.rate_hz
        return ResponseWithEffects.of(
            self._acquisition, self._model, profile, self._chain, rate_hz, self._session_start_s
        )


STEADY_TRAVEL_MM = 40.0
STEADY_RAMP_MM = 1.0
STEADY_RATE_HZ = 1000.0
STEADY_DWELL_S = 60.0


def steady_effect_forces(
    speeds_mm_s: FloatArray, model: FrictionModelSettings, capsule: Capsule, wall_thickness_mm: float
) -> FloatArray:
    """Return what the model's effects add to the force that the channel shows [mN], shape `(n,)` as the speeds.

    The mean over the last half of a drag of 40 mm that is the first run on its specimen.

    Raises
    ------
    SettingsError
        For impossible effects, or a contact angle beyond the range of the wall parameters.
    """
    specimen = Specimen(name="steady", wall_thickness_mm=wall_thickness_mm)
    return np.array([_mean_added_force(speed, model, capsule, specimen) for speed in speeds_mm_s.tolist()])


def _mean_added_force(speed_mm_s: float, model: FrictionModelSettings, capsule: Capsule, specimen: Specimen) -> float:
    move = trapezoid(STEADY_TRAVEL_MM, speed_mm_s, speed_mm_s**2 / (2 * STEADY_RAMP_MM))
    profile = MotionProfile.from_pieces((stationary_piece(1.0, Phase.REST), *move))
    drag = Acquisition("", 0, "drag", profile, capsule, specimen, Fixture.FOAM, Contact.SLIDING, STEADY_DWELL_S)
    half = (STEADY_TRAVEL_MM - 2 * STEADY_RAMP_MM) / speed_mm_s / 2
    end = 1.0 + 2 * STEADY_RAMP_MM / speed_mm_s + 2 * half
    time = np.linspace(end - half, end, 501)
    with_effects = ResponseWithEffects.of(drag, model, profile, EffectChain.of(model), STEADY_RATE_HZ, 0.0)
    nominal = NominalResponse.of(drag, model, profile)
    return float(np.mean(with_effects.at(time, time).force_mN - nominal.at(time, time).force_mN))
