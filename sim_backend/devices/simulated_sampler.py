"""The simulated sampler: force, position and motor force on one clock, handed out in blocks.

Samples are computed a chunk ahead and dropped once delivered.
"""

import math
from collections.abc import Mapping
from datetime import datetime
from threading import Event as Signal

import numpy as np

from dragrig.config.errors import DeviceError, StaleDataError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.arrays import AnyFloatArray
from dragrig.rig.devices import MAX_BLOCK_S, Acquisition, Block, Clock, RawReading
from dragrig.rig.runfile.model import Channel
from dragrig.sim_backend.devices.channels import ForceConverter, SimulatedChannels, recorded_channels
from dragrig.sim_backend.devices.faults import NO_FAULTS, Faults, LostSamples
from dragrig.sim_backend.devices.simulated_stage import PositionEncoder, SimulatedAxis, Track
from dragrig.sim_backend.devices.variability import RandomStream, random_generator

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
        lost: LostSamples | None,
    ) -> None:
        self._channels = channels
        self._total = samples
        self._block_samples = block_samples
        self._rate_hz = sample_rate_hz
        self._gap = None if lost is None else self.index(lost.at_s)
        self._gap_samples = 0 if lost is None else lost.samples
        self._next = 0
        self._track: Track | None = None
        self._origin_mm = 0.0
        self._chunk: Mapping[str, AnyFloatArray] = {}
        self._chunk_first = 0
        self._chunk_end = 0

    @property
    def next_index(self) -> int:
        """Index of the first sample not yet delivered."""
        return self._next

    def index(self, time_s: float) -> int:
        """Return the index of the first sample at or after a time."""
        return math.ceil(time_s * self._rate_hz - 1e-6)

    def set_origin(self, origin_mm: float) -> None:
        """Count positions from this absolute position."""
        self._origin_mm = origin_mm

    def follow(self, track: Track) -> None:
        """Recompute the samples not yet delivered for a new track, and end where it is stopped."""
        if track is self._track or self._next >= self._total:
            return
        self._track = track
        self._channels.follow(track)
        self._chunk_end = self._next
        if track.stopped:
            self._total = max(self._next, self.index(track.stopped_s))

    def next_end(self, limit: int | None = None) -> int:
        """Return the end of the next block, at most `limit`; `next_index` or less when there is no further block."""
        if self._next == self._gap:
            self._next += self._gap_samples
        first = self._next
        end = min(first + self._block_samples, _chunk_end(first), self._total)
        for boundary in (self._gap, limit):
            if boundary is not None and first < boundary < end:
                end = boundary
        return end

    def compute(self, end: int) -> None:
        """Compute the samples before `end` if necessary."""
        if end <= self._chunk_end:
            return
        first = self._next
        self._chunk_end = min(_chunk_end(first), self._total)
        self._chunk = self._channels.compute(first, self._chunk_end, self._origin_mm)
        self._chunk_first = first

    def take(self, end: int) -> tuple[int, Mapping[str, AnyFloatArray]]:
        """Deliver the samples before `end`: index of the first, and views of the chunk."""
        first = self._next
        delivered = slice(first - self._chunk_first, end - self._chunk_first)
        self._next = end
        return first, {name: values[delivered] for name, values in self._chunk.items()}


def _chunk_end(index: int) -> int:
    return (index // CHUNK_SAMPLES + 1) * CHUNK_SAMPLES


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
        faults: Faults = NO_FAULTS,
        first_run_at: datetime | None = None,
    ) -> None:
        self._rig = rig
        self._model = model
        self._clock = clock
        self._axis = axis
        self._faults = faults
        self._rate_hz = rig.sampling.rate_hz
        self._block_samples = max(1, int(min(rig.sampling.block_s, MAX_BLOCK_S) * self._rate_hz + 1e-6))
        self._channels = recorded_channels(rig)
        self._reader: BlockReader | None = None
        self._start_s: float | None = None
        self._silent_from: int | None = None
        self._silence_s = 0.0
        self._was_armed = False
        self._measurements = 0
        self._first_run_at = first_run_at

    @property
    def sample_rate_hz(self) -> float:
        """Samples per second of every channel."""
        return self._rate_hz

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Force, position and, where the settings ask for it, motor force."""
        return self._channels

    @property
    def force_range_mN(self) -> tuple[float, float]:
        """Least and greatest force of the sensor's converter."""
        return ForceConverter.of(self._rig.force_sensor).range_mN

    def arm(self, acquisition: Acquisition) -> None:
        """Prepare an acquisition of the profile's length.

        Raises
        ------
        DeviceError
            When the previous acquisition was not ended with `stop`, or the stage is moving.
        """
        if self._reader is not None:
            raise DeviceError("the sampler is still armed for the previous acquisition: stop it first.")
        session_start_s = self._session_start(acquisition)
        faults = self._faults.during(acquisition)
        reader = BlockReader(
            SimulatedChannels(self._rig, self._model, acquisition, faults, session_start_s),
            samples=acquisition.profile.samples(self._rate_hz),
            block_samples=self._block_samples,
            sample_rate_hz=self._rate_hz,
            lost=faults.lost_samples,
        )
        self._axis.arm(acquisition)
        stale = faults.stale_data
        self._silent_from = None if stale is None else reader.index(stale.at_s)
        self._silence_s = 0.0 if stale is None else stale.duration_s
        self._start_s = None
        self._reader = reader
        self._was_armed = True

    def start(self) -> None:
        """Take the first sample now.

        Raises
        ------
        DeviceError
            When the sampler is not armed, or was started already.
        """
        if self._reader is None or self._start_s is not None:
            raise DeviceError("the sampler cannot start: arm it once for each acquisition.")
        self._start_s = self._axis.begin_sampling()
        self._reader.set_origin(self._axis.track.origin_mm)

    def read(self, cancel: Signal) -> Block | None:
        """Return the next block once it is complete; None when there is none or `cancel` is set.

        Raises
        ------
        DeviceError
            When the sampler was not started.
        StaleDataError
            When it delivers nothing for as long as `guard.stale_data_s`.
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
            until_s = end / self._rate_hz
            if not self._clock.sleep(start_s + until_s - self._clock.monotonic(), cancel):
                return None
            if self._axis.deliver(track, until_s):
                return Block(*reader.take(end))
        return None

    def stop(self) -> None:
        """End the acquisition; a motion of the stage goes on."""
        self._reader = None
        self._axis.end_sampling()

    def measure(self, duration_s: float) -> RawReading:
        """Sample the sensor's zero and noise for a while, in volts according to the wiring in the settings.

        Raises
        ------
        DeviceError
            When the sampler is armed.
        """
        if self._reader is not None:
            raise DeviceError("the sampler is armed for an acquisition: stop it before a measurement.")
        rig, wiring = self._rig, self._rig.hardware.card.force
        encoder = PositionEncoder.of(rig.encoder)
        begin_mm = self._axis.state()[0]
        self._clock.sleep(duration_s, Signal())
        end_mm = self._axis.state()[0]
        white = random_generator(rig.simulated.seed, RandomStream.FORCE_WHITE, self._measurements, "measure")
        self._measurements += 1
        noise_mN = white.standard_normal(max(1, round(duration_s * self._rate_hz))) * rig.simulated.noise.white_mN
        force_V = ForceConverter.of(rig.force_sensor).convert(noise_mN) / wiring.per_V + wiring.zero_V
        counts = np.rint(np.array([begin_mm, end_mm]) * encoder.counts_per_mm)
        return RawReading.of(force_V, counts)

    def _session_start(self, acquisition: Acquisition) -> float:
        now = self._clock.now()
        if acquisition.recorded and self._first_run_at is None:
            self._first_run_at = now
        return 0.0 if self._first_run_at is None else (now - self._first_run_at).total_seconds()

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
