"""The simulated sampler: force, position and motor force of an acquisition on one clock, delivered in blocks.

From motion and load to the reports of force sensor, encoder and motor. Samples are computed a chunk ahead and dropped
once delivered.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from threading import Event as Signal
from typing import Protocol

import numpy as np
import numpy.typing as npt

from dragrig.config import (
    Capsule,
    DeviceError,
    Fixture,
    ForceSensorSettings,
    FrictionModelSettings,
    MotorSettings,
    RigSettings,
    Specimen,
    StaleDataError,
)
from dragrig.rig import (
    MAX_BLOCK_S,
    Acquisition,
    AnyFloatArray,
    Block,
    Clock,
    Contact,
    FloatArray,
    MotionProfile,
    Phase,
    RawReading,
    RecordedChannel,
    read_only,
    stationary_piece,
    trapezoid,
)
from dragrig.sim_backend.devices.simulated_stage import (
    UNDISTURBED,
    Disturbances,
    PositionEncoder,
    SimulatedAxis,
    StageMotion,
    Track,
    evaluate_profile,
)
from dragrig.sim_backend.devices.variability import (
    RandomStream,
    draw_run_model,
    force_noise,
    motor_noise,
    random_generator,
)
from dragrig.sim_backend.effects import EffectChain, evaluation_rate_hz, evaluation_times, gut_run_state
from dragrig.sim_backend.friction import PreparedForce, ProfileMotion, RecordedMotion, prepare

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
    """Motion, forces and position at `n` times before noise and converters, new arrays of shape `(n,)`."""

    motion: StageMotion
    """Motion of the stage."""
    counted_mm: FloatArray
    """Position before it is rounded to counts."""
    force_mN: FloatArray
    """Force that the channel shows."""
    load_mN: FloatArray
    """True force on the capsule."""


class RunResponse(Protocol):
    """How rig and gut respond to the profile of an acquisition."""

    def at(self, time_s: FloatArray, counted_s: FloatArray) -> NoiseFreeSamples:
        """Return the samples at rising times, the counted position at others if the encoder is stuck."""


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
    """Response with effects, computed once at fixed times from the first sample on, whatever the size of blocks."""

    path: ProfileMotion | RecordedMotion
    """The stage's motion."""
    time_s: FloatArray
    counted_mm: FloatArray
    force_mN: FloatArray
    load_mN: FloatArray
    """`time_s`, `counted_mm`, `force_mN`, `load_mN`: times, and the channels at them, shape `(n,)`."""

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
        disturbances: Disturbances,
        session_start_s: float = 0.0,
    ) -> None:
        simulated, rate = rig.simulated, rig.sampling.rate_hz
        self._rig = rig
        self._acquisition = acquisition
        self._disturbances = disturbances
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
        ideal = self._response.at(time, self._disturbances.encoder_time(time))
        channels: dict[str, AnyFloatArray] = {}
        force = ideal.force_mN + self._force_noise.read(first, end)
        force += self._disturbances.extra_force(time)
        channels["force"] = self._converter.convert(force)
        position = ideal.counted_mm
        position += self._disturbances.position_error(time)
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
    """Return the contribution of the model's effects to the force of the channel [mN], shape `(n,)` as the speeds.

    The mean over the last half of a drag of 40 mm that is the first run on its specimen.

    Raises `SettingsError` for impossible effects, or a contact angle beyond the range of the wall parameters.
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


CHUNK_SAMPLES = 16_384
"""Samples computed at once: large enough for fast arrays, small enough for the processor's cache and a prompt stop.

Chunks begin at multiples of this whatever the blocks are, so the blocks' size cannot change a value.
"""


class BlockReader:
    """The samples of one acquisition in order, used by the reading thread alone."""

    def __init__(
        self,
        channels: SimulatedChannels,
        samples: int,
        block_samples: int,
        sample_rate_hz: float,
        lost: tuple[float, int] | None,
    ) -> None:
        self._channels = channels
        self._total = samples
        self._block_samples = block_samples
        self._rate_hz = sample_rate_hz
        self._gap = None if lost is None else self.index(lost[0])
        self._gap_samples = 0 if lost is None else lost[1]
        self.next_index = 0
        """Index of the first sample not yet delivered."""
        self._track: Track | None = None
        self.origin_mm = 0.0
        """Absolute position from which positions are counted."""
        self._chunk: Mapping[str, AnyFloatArray] = {}
        self._chunk_first = 0
        self._chunk_end = 0

    def index(self, time_s: float) -> int:
        """Return the index of the first sample at or after a time."""
        return math.ceil(time_s * self._rate_hz - 1e-6)

    def follow(self, track: Track) -> None:
        """Recompute the samples not yet delivered for a new track, and end where it is stopped."""
        if track is self._track or self.next_index >= self._total:
            return
        self._track = track
        self._channels.follow(track)
        self._chunk_end = self.next_index
        if track.stopped:
            self._total = max(self.next_index, self.index(track.stopped_s))

    def next_end(self, limit: int | None = None) -> int:
        """Return the end of the next block, at most `limit`; `next_index` or less when there is no further block."""
        if self.next_index == self._gap:
            self.next_index += self._gap_samples
        first = self.next_index
        end = min(first + self._block_samples, _chunk_end(first), self._total)
        for boundary in (self._gap, limit):
            if boundary is not None and first < boundary < end:
                end = boundary
        return end

    def compute(self, end: int) -> None:
        """Compute the samples before `end` if necessary."""
        if end <= self._chunk_end:
            return
        first = self.next_index
        self._chunk_end = min(_chunk_end(first), self._total)
        self._chunk = self._channels.compute(first, self._chunk_end, self.origin_mm)
        self._chunk_first = first

    def take(self, end: int) -> tuple[int, Mapping[str, AnyFloatArray]]:
        """Deliver the samples before `end`: index of the first, and views of the chunk."""
        first = self.next_index
        delivered = slice(first - self._chunk_first, end - self._chunk_first)
        self.next_index = end
        return first, {name: values[delivered] for name, values in self._chunk.items()}


def _chunk_end(index: int) -> int:
    return (index // CHUNK_SAMPLES + 1) * CHUNK_SAMPLES


LEFT_S = 3600.0
"""How long a contact that a motion left behind goes on to relax."""


@dataclass(frozen=True, slots=True)
class LeftContact:
    """The capsule in the gut after a motion, its first sample at `begun_at`; the profile is that which was made."""

    acquisition: Acquisition
    begun_at: datetime

    def force_mN(self, model: FrictionModelSettings, now: datetime) -> float:
        """Return the nominal force of a contact that has stood since."""
        stands = stationary_piece(LEFT_S, Phase.HOLD)
        made = self.acquisition.profile
        profile = MotionProfile.from_pieces((*made.pieces(), stands))
        force = prepare(replace(self.acquisition, profile=profile), model).force
        # A simulated session may have ended in the future.
        time_s = max((now - self.begun_at).total_seconds(), made.duration_s)
        return float(force(np.array([time_s]))[0])


class SimulatedSampler:
    """Samples the axis block by block, each once the clock has passed its last sample.

    One thread arms, starts and reads; `stop` may come from any.

    Parameters
    ----------
    first_run_at
        When the first run on the specimen began, if it is past: time 0 of the session's clock.
    """

    def __init__(
        self,
        rig: RigSettings,
        model: FrictionModelSettings,
        clock: Clock,
        axis: SimulatedAxis,
        disturbances: Disturbances = UNDISTURBED,
        first_run_at: datetime | None = None,
    ) -> None:
        self._rig = rig
        self._model = model
        self._clock = clock
        self._axis = axis
        self._disturbances = disturbances
        self.sample_rate_hz = rig.sampling.rate_hz
        """Samples per second of every channel."""
        self._block_samples = max(1, int(min(rig.sampling.block_s, MAX_BLOCK_S) * self.sample_rate_hz + 1e-6))
        further = (RecordedChannel("motor_force", "mN"),) if rig.sampling.motor_force else ()
        self.channels = (RecordedChannel("force", "mN"), RecordedChannel("position", "mm"), *further)
        """Force, position and, where the settings ask for it, motor force."""
        self.force_range_mN = ForceConverter.of(rig.force_sensor).range_mN
        """Least and greatest force of the sensor's converter."""
        self._reader: BlockReader | None = None
        self._acquisition: Acquisition | None = None
        self._start_s: float | None = None
        self._silent_from: int | None = None
        self._silence_s = 0.0
        self._was_armed = False
        self._measurements = 0
        self._first_run_at = first_run_at
        self.left: LeftContact | None = None
        """The contact after the last motion; None where the capsule is clear of the gut."""
        self._hung_mN = self._push_mm = 0.0

    def arm(self, acquisition: Acquisition) -> None:
        """Prepare an acquisition of the profile's length.

        Raises `DeviceError` when the previous acquisition was not ended with `stop`, or the stage is moving.
        """
        if self._reader is not None:
            raise DeviceError("the sampler is still armed for the previous acquisition: stop it first.")
        now = self._clock.now()
        if acquisition.recorded and self._first_run_at is None:
            self._first_run_at = now
        session_start_s = (now - (self._first_run_at or now)).total_seconds()
        disturbances = self._disturbances.during(acquisition)
        reader = BlockReader(
            SimulatedChannels(self._rig, self._model, acquisition, disturbances, session_start_s),
            samples=acquisition.profile.samples(self.sample_rate_hz),
            block_samples=self._block_samples,
            sample_rate_hz=self.sample_rate_hz,
            lost=disturbances.lost,
        )
        self._axis.arm(acquisition)
        begin_s, self._silence_s = disturbances.silence or (math.inf, 0.0)
        self._silent_from = reader.index(begin_s) if math.isfinite(begin_s) else None
        self._start_s = None
        self._acquisition = acquisition
        self._reader = reader
        self._was_armed = True

    def start(self) -> None:
        """Take the first sample now.

        Raises `DeviceError` when the sampler is not armed, or was started already.
        """
        if self._reader is None or self._start_s is not None:
            raise DeviceError("the sampler cannot start: arm it once for each acquisition.")
        self._start_s = self._axis.begin_sampling()
        self._reader.origin_mm = self._axis.track.origin_mm

    def read(self, cancel: Signal) -> Block | None:
        """Return the next block once it is complete; None when there is none or `cancel` is set.

        Raises `DeviceError` when the sampler was not started, `StaleDataError` when it delivers nothing for as long as
        `guard.stale_data_s`.
        """
        reader, start_s = self._reader, self._start_s
        if reader is None and self._was_armed:
            return None
        if reader is None or start_s is None:
            raise DeviceError("the sampler has nothing to read: arm and start it first.")
        while self._reader is reader and not cancel.is_set():
            track = self._axis.track
            reader.follow(track)
            if reader.next_index == self._silent_from and not self._outlast_silence(cancel):
                return None
            end = reader.next_end(self._silent_from)
            if end <= reader.next_index:
                self._axis.end_sampling()
                return None
            reader.compute(end)
            until_s = end / self.sample_rate_hz
            if not self._clock.sleep(start_s + until_s - self._clock.monotonic(), cancel):
                return None
            if self._axis.deliver(track, until_s):
                return Block(*reader.take(end))
        return None

    def stop(self) -> None:
        """End the acquisition; a motion of the stage goes on."""
        acquisition, start_s, self._acquisition = self._acquisition, self._start_s, None
        if acquisition is not None and start_s is not None:
            made = replace(acquisition, profile=self._axis.track.profile)
            begun_at = self._clock.now() - timedelta(seconds=self._clock.monotonic() - start_s)
            self.left = None if made.contact is Contact.NONE else LeftContact(made, begun_at)
        self._reader = None
        self._axis.end_sampling()

    def hang(self, load_mN: float) -> None:
        """Put a load on the sensor, in place of the capsule and of the load before."""
        self._hung_mN, self.left = load_mN, None

    def push(self, distance_mm: float) -> None:
        """Push the stage during the next measurement."""
        self._push_mm = distance_mm

    def measure(self, duration_s: float, cancel: Signal | None = None) -> RawReading:
        """Sample the weight or pull on the sensor for a while, in volts according to the wiring in the settings.

        Raises `DeviceError` when the sampler is armed.
        """
        if self._reader is not None:
            raise DeviceError("the sampler is armed for an acquisition: stop it before a measurement.")
        rig, wiring = self._rig, self._rig.hardware.card.force
        encoder = PositionEncoder.of(rig.encoder)
        begin_mm = self._axis.state()[0]
        self._clock.sleep(duration_s, cancel or Signal())
        if self._push_mm:
            self._axis.place(begin_mm + self._push_mm)
            self._push_mm = 0.0
        end_mm = self._axis.state()[0]
        load_mN = self._hung_mN if self.left is None else self.left.force_mN(self._model, self._clock.now())
        white = random_generator(rig.simulated.seed, RandomStream.FORCE_WHITE, self._measurements, "measure")
        self._measurements += 1
        noise_mN = white.standard_normal(max(1, round(duration_s * self.sample_rate_hz))) * rig.simulated.noise.white_mN
        force_mN = ForceConverter.of(rig.force_sensor).convert(noise_mN + load_mN)
        force_V = force_mN / wiring.per_V + wiring.zero_V
        counts = np.rint(np.array([begin_mm, end_mm]) * encoder.counts_per_mm)
        return RawReading.of(force_V, counts, float(np.mean(force_mN)))

    def _outlast_silence(self, cancel: Signal) -> bool:
        limit_s = self._rig.guard.stale_data_s
        if not self._clock.sleep(min(self._silence_s, limit_s), cancel):
            return False
        if self._silence_s > limit_s:
            raise StaleDataError(
                f"the sampler delivered nothing for {limit_s:g} s (guard.stale_data_s): check its clock and cables."
            )
        self._silent_from = None
        return True
