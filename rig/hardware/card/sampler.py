"""The sampler of the real rig: force, position and further inputs on the card's sample clock.

A reader thread fetches samples of both tasks, pairs them by index, scales them and queues blocks; the thread that calls
`CardSampler.read` takes them from the queue.
"""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from queue import Empty, Full, Queue
from threading import Event as Signal
from threading import Lock, Thread

import numpy as np

from dragrig.config.errors import DeviceError, SettingsError
from dragrig.config.hardware import CardSettings
from dragrig.config.rig import Calibration, RigSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import MAX_BLOCK_S, Acquisition, Block, Clock, RawReading, Trip, TripCause
from dragrig.rig.hardware.card.connection import (
    Connection,
    device_error,
    driver_errors,
    driver_errors_wrapped,
    no_samples_error,
)
from dragrig.rig.hardware.card.scaling import Scaling
from dragrig.rig.hardware.card.tasks import BufferedInput, OverwrittenError, SampledTasks, metres_per_count
from dragrig.rig.hardware.sync import FirstSample, MotionSamplingSync
from dragrig.rig.runfile.model import Channel

READ_TIMEOUT_S = 0.1
"""Longest wait of one call of the driver, twice a block: shorter ones stall it, longer ones delay a stop."""


@dataclass(frozen=True, slots=True, eq=False)
class SampleBatch:
    """Consecutive samples, as views of buffers that the next fetch overwrites.

    Attributes
    ----------
    first_index
        Index of the first sample since the start.
    lost
        How many samples before it are lost.
    volts, counts
        Shape `(inputs, n)` and `(n,)`; `n` is 0 when nothing arrived in time.
    """

    first_index: int
    lost: int
    volts: FloatArray
    counts: FloatArray

    @property
    def samples(self) -> int:
        """How many samples there are of every channel."""
        return len(self.counts)


class SampleFetcher:
    """Reads both tasks block by block into buffers of its own. Belongs to one thread.

    Parameters
    ----------
    inputs
        How many analog inputs there are.
    metres_per_count
        Length that the encoder's task gives a count.
    """

    def __init__(
        self, analog: BufferedInput, encoder: BufferedInput, inputs: int, block_samples: int, metres_per_count: float
    ) -> None:
        self._analog, self._encoder = analog, encoder
        self._inputs = inputs
        self._metres_per_count = metres_per_count
        self._volts = np.empty(inputs * block_samples)
        self._counts = np.empty(block_samples)
        self._volts_held = 0
        self._counts_held = 0
        self._next = 0
        self._lost = 0

    @property
    def next_index(self) -> int:
        """Index of the next sample."""
        return self._next

    @property
    def lost(self) -> int:
        """How many samples before `next_index` are lost and not yet told by a `SampleBatch`."""
        return self._lost

    @property
    def acquired(self) -> int:
        """How many samples the card has taken."""
        return self._analog.acquired

    def fetch(self, samples: int) -> SampleBatch:
        """Return the next samples, at most `samples`, fewer or none when they do not arrive in `READ_TIMEOUT_S`.

        What one task has given and the other has not yet is kept for the next call.
        """
        try:
            if not self._volts_held:
                self._volts_held = self._analog.read(self._shaped(samples), samples, READ_TIMEOUT_S)
            missing = self._volts_held - self._counts_held
            if missing:
                into = self._counts[self._counts_held : self._volts_held]
                self._counts_held += self._encoder.read(into, missing, READ_TIMEOUT_S)
        except OverwrittenError:
            self._leap()
        return self._take()

    def _take(self) -> SampleBatch:
        came = self._volts_held if self._counts_held == self._volts_held else 0
        counts = self._counts[:came]
        # DAQmx gives lengths; a count is a whole number.
        counts /= self._metres_per_count
        np.rint(counts, out=counts)
        fetched = SampleBatch(self._next, self._lost if came else 0, self._shaped(came), counts)
        if came:
            self._next += came
            self._volts_held = self._counts_held = self._lost = 0
        return fetched

    def _leap(self) -> None:
        """Go on with the newest sample: what is between is lost."""
        newest = max(self._analog.acquired, self._encoder.acquired, self._next + 1)
        self._lost += newest - self._next
        self._next = newest
        self._volts_held = self._counts_held = 0
        self._analog.leap_to(newest)
        self._encoder.leap_to(newest)

    def _shaped(self, samples: int) -> FloatArray:
        return self._volts[: self._inputs * samples].reshape(self._inputs, samples)


def collect_samples(
    fetcher: SampleFetcher,
    samples: int,
    block_samples: int,
    stale_s: float,
    card: CardSettings,
    fed: Callable[[], None],
) -> tuple[FloatArray, FloatArray]:
    """Return the force's volts and the encoder's counts of the next samples, shape `(samples,)` each.

    Raises
    ------
    StaleDataError
        When nothing arrives for longer than `stale_s`, in the wall's time.
    """
    volts, counts = np.empty(samples), np.empty(samples)
    heard_s = time.monotonic()
    have = 0
    while have < samples:
        fed()
        fetched = fetcher.fetch(min(block_samples, samples - have))
        if fetched.samples:
            heard_s = time.monotonic()
        elif time.monotonic() - heard_s > stale_s:
            raise no_samples_error(card, stale_s)
        end = have + fetched.samples
        volts[have:end], counts[have:end] = fetched.volts[0], fetched.counts
        have = end
    return volts, counts


_QUEUE_BLOCKS = 256
"""Blocks that wait for the thread that reads; beyond them, samples wait in the card's buffer."""
_POLL_S = 0.02
_FROZEN_S = 0.1
"""A wait of `_POLL_S` that takes so long says that the whole program was frozen meanwhile."""
_POST_STOP_S = 0.02
"""How much is sampled after a stop once the stage stands."""


@dataclass(frozen=True, slots=True)
class ReadSettings:
    """How much to sample, in what blocks, and how long without samples is too long."""

    samples: int
    block_samples: int
    rate_hz: float
    stale_s: float


class ReaderThread:
    """Fetches one acquisition's samples on a thread of its own, which closes the tasks when it ends.

    Parameters
    ----------
    fetcher, close
        The started tasks' samples, and what closes the tasks. Both belong to the thread from here on.
    """

    def __init__(
        self,
        fetcher: SampleFetcher,
        scaling: Scaling,
        stretch: ReadSettings,
        coupling: MotionSamplingSync,
        card: CardSettings,
        close: Callable[[], None],
    ) -> None:
        self._fetcher, self._scaling, self._stretch, self._coupling = fetcher, scaling, stretch, coupling
        self._card, self._close = card, close
        self._ready: Queue[Block | Exception | None] = Queue(_QUEUE_BLOCKS)
        self._ending = Signal()
        self._closing_error: Exception | None = None
        self._last: int | None = None
        self._origin = 0.0
        self._over = False
        self._error: Exception | None = None
        self._heard_s = time.monotonic()
        self._thread = Thread(target=self._run, name="card reader", daemon=True)
        self._thread.start()

    def take(self, cancel: Signal, fed: Callable[[], None]) -> Block | None:
        """Return the next block; None after the last one, and once `cancel` is set or the reader told to end.

        Raises
        ------
        StaleDataError
            When no sample arrived for longer than `Stretch.stale_s`, in the wall's time.
        DeviceError
            What ended the thread; again at every call.
        """
        while not (cancel.is_set() or self._ending.is_set()):
            fed()
            if self._error is not None:
                raise self._error
            if self._over:
                return None
            asked_s = time.monotonic()
            try:
                item = self._ready.get(timeout=_POLL_S)
            except Empty:
                if time.monotonic() - asked_s < _FROZEN_S:
                    self._refuse_stale()
                else:
                    # The program itself was held up, so that nobody knows yet whether samples are there.
                    self._heard_s = time.monotonic()
                continue
            if isinstance(item, Block):
                return item
            self._over, self._error = True, item
        return None

    def end(self, longest_s: float) -> bool:
        """Have the tasks closed; return False when the driver does not return within `longest_s`.

        Raises
        ------
        DeviceError
            When the tasks could not be closed properly.
        """
        self._ending.set()
        self._thread.join(longest_s)
        if self._closing_error is not None:
            raise self._closing_error
        return not self.alive

    @property
    def alive(self) -> bool:
        """Whether the thread still runs."""
        return self._thread.is_alive()

    def _refuse_stale(self) -> None:
        silent_s = self._stretch.stale_s
        if time.monotonic() - self._heard_s > silent_s and self._ready.empty():
            raise no_samples_error(self._card, silent_s)

    def _run(self) -> None:
        failed = False
        try:
            while (block := self._next()) is not None:
                self._hand_over(block)
            self._hand_over(None)
        except Exception as error:  # noqa: BLE001  # raised again in the thread that reads
            failed = True
            self._hand_over(self._in_words(error))
        finally:
            self._close_tasks(failed)

    def _close_tasks(self, failed: bool) -> None:
        try:
            self._close()
        except Exception as error:  # noqa: BLE001  # raised again where the reader is ended
            # A card that has failed fails here once more, which says nothing new.
            self._closing_error = None if failed else self._in_words(error)

    def _next(self) -> Block | None:
        while not self._ending.is_set():
            wanted = min(self._stretch.block_samples, self._end() - self._fetcher.next_index)
            if wanted <= 0:
                self._refuse_silent_loss()
                return None
            fetched = self._fetcher.fetch(wanted)
            if fetched.samples:
                self._heard_s = time.monotonic()
                return self._block(fetched)
        return None

    def _end(self) -> int:
        """Return where sampling ends: with the profile, or once a stage that was told to stop stands."""
        if self._last is None and self._coupling.stopped:
            tail = math.ceil(_POST_STOP_S * self._stretch.rate_hz)
            if self._coupling.moving:
                return self._fetcher.next_index + self._stretch.block_samples
            self._last = max(self._fetcher.next_index, self._fetcher.acquired + tail)
        return self._stretch.samples if self._last is None else self._last

    def _block(self, fetched: SampleBatch) -> Block:
        if fetched.first_index == 0:
            self._origin = float(fetched.counts[0])
        fault = self._overrun(fetched) or self._scaling.fault(fetched.volts[0])
        return Block(fetched.first_index, self._scaling.scale(fetched.volts, fetched.counts, self._origin), fault)

    def _overrun(self, fetched: SampleBatch) -> Trip | None:
        if not fetched.lost:
            return None
        at_s = (fetched.first_index - fetched.lost) / self._stretch.rate_hz
        return Trip(
            TripCause.OVERRUN,
            f"{fetched.lost} samples from {at_s:.3f} s on are lost, because this computer did not fetch them in time",
        )

    def _refuse_silent_loss(self) -> None:
        if lost := self._fetcher.lost:
            raise DeviceError(
                f"the last {lost} samples are lost, because this computer did not fetch them in time: end other "
                "programs, or lower sampling.rate_hz."
            )

    def _in_words(self, error: Exception) -> Exception:
        return device_error(error, self._card, "it samples") if isinstance(error, driver_errors()) else error

    def _hand_over(self, item: Block | Exception | None) -> None:
        while not self._ending.is_set():
            try:
                self._ready.put(item, timeout=_POLL_S)
            except Full:
                continue
            return


MAX_AGGREGATE_RATE_HZ = 250_000
"""Samples per second that the PCI-6229 converts in all (PCI-6229 specifications)."""
_MAX_FETCH_S = MAX_BLOCK_S - 0.002
"""Leaves the guard its time, so that a condition stops the stage within one longest block."""


@dataclass(slots=True)
class _ArmedAcquisition:
    """An acquisition from arming to its end: tasks until they are started, then the reader that owns them."""

    tasks: SampledTasks
    samples: int
    started: bool = False
    reader: ReaderThread | None = None


class CardSampler:
    """Samples by the card's own clock; a thread fetches, whoever calls `read` gets blocks.

    One thread arms, starts and reads; `stop` may come from any.

    Parameters
    ----------
    calibrations
        The calibrations that hold now, by quantity (force, encoder).
    coupling, clock
        What is shared with the stage: who moves, and the time of the first sample.
    fed
        Called whenever the program shows that it waits for samples or takes them.

    Raises
    ------
    SettingsError
        When the settings ask for more than the card can convert.
    """

    def __init__(
        self,
        connection: Connection,
        rig: RigSettings,
        calibrations: Mapping[str, Calibration],
        coupling: MotionSamplingSync,
        clock: Clock,
        fed: Callable[[], None] = lambda: None,
    ) -> None:
        _refuse_excessive_rate(rig)
        self._connection, self._rig, self._coupling, self._clock, self._fed = connection, rig, coupling, clock, fed
        self._scaling = Scaling.of(rig, calibrations)
        self._rate_hz = rig.sampling.rate_hz
        # Half of what counts as stale, so that a healthy card cannot look stale.
        block_s = min(rig.sampling.block_s, _MAX_FETCH_S, rig.guard.stale_data_s / 2)
        self._block_samples = max(1, int(block_s * self._rate_hz + 1e-6))
        self._lock = Lock()
        self._armed: _ArmedAcquisition | None = None
        self._was_armed = False
        self._hung: ReaderThread | None = None

    @property
    def sample_rate_hz(self) -> float:
        """Samples per second of every channel."""
        return self._rate_hz

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Force, position, and the further inputs of the settings."""
        return self._scaling.channels

    @property
    def force_range_mN(self) -> tuple[float, float]:
        """Forces at the ends of the force input's range."""
        return self._scaling.force_range_mN

    def arm(self, acquisition: Acquisition) -> None:
        """Reserve and program the card for an acquisition of the profile's length.

        Raises
        ------
        DeviceError
            When the acquisition before was not ended with `stop`, the stage moves, or the card refuses.
        """
        if self._armed is not None:
            raise DeviceError("the sampler is still armed for the acquisition before: stop it first.")
        if self._coupling.moving:
            raise DeviceError("the sampler cannot be armed while the stage moves: wait or stop it first.")
        tasks = self._tasks("it is armed")
        self._armed = _ArmedAcquisition(tasks, acquisition.profile.samples(self._rate_hz))
        self._was_armed = True
        self._coupling.arm()

    def start(self) -> None:
        """Take the first sample now, and tell the stage when that was.

        Raises
        ------
        DeviceError
            When the sampler is not armed, was started already, or the card refuses.
        """
        armed = self._armed
        if armed is None or armed.started:
            raise DeviceError("the sampler cannot start: arm it once for each acquisition.")
        armed.started = True
        if self._coupling.stopped:
            return
        with driver_errors_wrapped(self._connection.card, "it starts"):
            armed.tasks.start(self._begin)
        with self._lock:
            if self._armed is armed:
                armed.reader = self._reader(armed)

    def read(self, cancel: Signal) -> Block | None:
        """Return the next block; None after the last one, after `stop`, and when `cancel` is set.

        Raises
        ------
        DeviceError
            When the sampler was not started, or the card fails.
        StaleDataError
            When nothing arrives for as long as `guard.stale_data_s`.
        """
        self._fed()
        armed = self._armed
        if armed is None and self._was_armed:
            return None
        if armed is None or not armed.started:
            raise DeviceError("the sampler has nothing to read: arm and start it first.")
        return None if armed.reader is None else armed.reader.take(cancel, self._fed)

    def stop(self) -> None:
        """End the acquisition and release the card. Waits no longer than a hanging driver is worth.

        Raises
        ------
        DeviceError
            When the driver does not return, or does not release the card.
        """
        with self._lock:
            armed, self._armed = self._armed, None
        self._coupling.disarm()
        if armed is None:
            return
        card = self._connection.card
        if armed.reader is None:
            with driver_errors_wrapped(card, "it is released"):
                armed.tasks.close()
        elif not armed.reader.end(self._patience_s):
            self._hung = armed.reader
            raise DeviceError(
                f"the driver of card {card.device} has not returned for {self._patience_s:g} s: the card is held until "
                "it does; restart the program, and the computer if that does not help."
            )

    def measure(self, duration_s: float) -> RawReading:
        """Sample for a while, moving nothing, and return what converter and counter say, for a calibration.

        Raises
        ------
        DeviceError
            When the sampler is armed, or the card fails.
        StaleDataError
            When nothing arrives for as long as `guard.stale_data_s`.
        """
        if self._armed is not None:
            raise DeviceError("the sampler is armed for an acquisition: stop it before a measurement.")
        with driver_errors_wrapped(self._connection.card, "it measures"):
            tasks = self._tasks("it measures")
            try:
                tasks.start(lambda start: start())
                volts, counts = collect_samples(
                    self._fetcher(tasks),
                    max(1, round(duration_s * self._rate_hz)),
                    self._block_samples,
                    self._rig.guard.stale_data_s,
                    self._connection.card,
                    self._fed,
                )
            finally:
                tasks.close()
        return RawReading.of(volts, -counts if self._connection.card.encoder.reversed else counts)

    @property
    def _patience_s(self) -> float:
        return self._rig.hardware.hang_s + 1.0

    def _tasks(self, doing: str) -> SampledTasks:
        card = self._connection.card
        if self._hung is not None and self._hung.alive:
            raise DeviceError(
                f"card {card.device} is still held by a driver that does not return: restart the program, and the "
                "computer if that does not help."
            )
        with driver_errors_wrapped(card, doing):
            return SampledTasks(self._connection, self._rig)

    def _begin(self, start: Callable[[], None]) -> None:
        before_s = self._clock.monotonic()
        start()
        after_s = self._clock.monotonic()
        self._coupling.begin(FirstSample((before_s + after_s) / 2, (after_s - before_s) / 2))

    def _fetcher(self, tasks: SampledTasks) -> SampleFetcher:
        inputs = len(self._scaling.channels) - 1
        return SampleFetcher(tasks.analog, tasks.encoder, inputs, self._block_samples, metres_per_count(self._rig))

    def _reader(self, armed: _ArmedAcquisition) -> ReaderThread:
        return ReaderThread(
            self._fetcher(armed.tasks),
            self._scaling,
            ReadSettings(armed.samples, self._block_samples, self._rate_hz, self._rig.guard.stale_data_s),
            self._coupling,
            self._connection.card,
            armed.tasks.close,
        )


def _refuse_excessive_rate(rig: RigSettings) -> None:
    inputs = 1 + len(rig.hardware.card.inputs)
    if inputs * rig.sampling.rate_hz > MAX_AGGREGATE_RATE_HZ:
        raise SettingsError(
            f"sampling.rate_hz = {rig.sampling.rate_hz:g} with {inputs} analog inputs is more than the "
            f"{MAX_AGGREGATE_RATE_HZ:,} samples per second that the card converts in all: set at most "
            f"{MAX_AGGREGATE_RATE_HZ // inputs:,}, or leave out some of hardware.card.inputs."
        )
