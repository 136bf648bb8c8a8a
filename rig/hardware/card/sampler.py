"""The sampler of the real rig: force, position and further inputs on the card's sample clock.

A reader thread fetches samples of both tasks, pairs them by index, scales them and queues blocks; the thread that calls
`CardSampler.read` takes them from the queue.
"""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from queue import Empty, Full, Queue
from threading import Event as Signal
from threading import Lock, Thread

import numpy as np

from dragrig.config import Calibration, CardSettings, DeviceError, OverrunError, RigSettings, SettingsError
from dragrig.rig import MAX_BLOCK_S, Acquisition, Block, Clock, FloatArray, RawReading, Trip, TripCause
from dragrig.rig.hardware import FirstSample, MotionSamplingSync
from dragrig.rig.hardware.card.connection import (
    Connection,
    device_error,
    driver_errors,
    driver_errors_wrapped,
    no_samples_error,
)
from dragrig.rig.hardware.card.oversampling import (
    MAX_AGGREGATE_RATE_HZ,
    WINGS,
    Alias,
    AntiAliasFilter,
    OversampledFetcher,
    find_aliases,
    oversampling_factor,
)
from dragrig.rig.hardware.card.scaling import ForceInputMonitor, NoiseLimits, Scaling
from dragrig.rig.hardware.card.tasks import (
    SampleBatch,
    SampledTasks,
    SampleFetcher,
    ScanTiming,
    metres_per_count,
    read_force_alone,
)

_QUEUE_BLOCKS = 256
"""Blocks that wait for the thread that reads; beyond them, samples wait in the card's buffer."""
_POLL_S = 0.02
_CLOCK_TOLERANCE = 1e-3
"""How much faster than this computer's clock a card's may run, as a share; the PCI-6229's is right to 50 ppm."""
_POST_STOP_S = 0.02
"""How much is sampled after a stop once the stage is at rest."""


@dataclass(frozen=True, slots=True)
class ReadSettings:
    """How much to sample, in which blocks, and how long without samples counts as stale."""

    samples: int
    block_samples: int
    rate_hz: float
    stale_s: float


@dataclass(frozen=True, slots=True)
class _TimedBlock:
    block: Block
    newest_s: float
    """When its newest sample was taken, by `time.monotonic`; not later than that."""


class ReaderThread:
    """Fetches the samples of one acquisition in a thread, which closes the tasks when it ends.

    Parameters
    ----------
    fetcher, monitor, close
        The started tasks' samples, the judge of the force input, and the end of the tasks. They belong to the thread
        from here on.
    """

    def __init__(
        self,
        fetcher: SampleFetcher | OversampledFetcher,
        scaling: Scaling,
        monitor: ForceInputMonitor,
        settings: ReadSettings,
        sync: MotionSamplingSync,
        card: CardSettings,
        close: Callable[[], None],
    ) -> None:
        self._fetcher, self._scaling, self._settings, self._sync = fetcher, scaling, settings, sync
        self._card, self._monitor, self._close = card, monitor, close
        self._sensor_fault: Trip | None = None
        self._queue: Queue[_TimedBlock | Exception | None] = Queue(_QUEUE_BLOCKS)
        self._end_requested = Signal()
        self._closing_error: Exception | None = None
        self._end_index_after_stop: int | None = None
        self._origin_counts = 0.0
        self._finished = False
        self._error: Exception | None = None
        self._losing = False
        # The samples' own time, so that what is missing adds up, whether the card, the driver or this program stood
        # still: a burst of old samples does not count as news.
        self._newest_s = time.monotonic()
        self._thread = Thread(target=self._run, name="card reader", daemon=True)
        self._thread.start()

    def take(self, cancel: Signal, feed_watchdog: Callable[[], None]) -> Block | None:
        """Return the next block; None after the last one, once `cancel` is set, and after `end`.

        Raises
        ------
        StaleDataError
            When the newest sample is older than `ReadSettings.stale_s`, in wall time; `OverrunError` where those after
            it are lost. Samples that arrive later can still be read.
        DeviceError
            The error that ended the thread; again at every call.
        """
        while not (cancel.is_set() or self._end_requested.is_set()):
            feed_watchdog()
            if self._error is not None:
                raise self._error
            if self._finished:
                return None
            try:
                item = self._queue.get(timeout=_POLL_S)
            except Empty:
                self._require_fresh()
                continue
            if isinstance(item, _TimedBlock):
                return self._seen(item)
            self._finished, self._error = True, item
        return None

    def _require_fresh(self) -> None:
        now_s, stale_s = time.monotonic(), self._settings.stale_s
        if now_s - self._newest_s <= stale_s or not self._queue.empty():
            return
        self._newest_s = now_s
        if self._losing:
            raise OverrunError(
                f"samples of more than {stale_s:g} s are lost, because this computer did not read them in time: end "
                "other programs, or lower sampling.rate_hz."
            )
        raise no_samples_error(self._card, stale_s)

    def _seen(self, item: _TimedBlock) -> Block:
        """Tell the stage how new the samples are that the guard gets, and mark a block that is stale."""
        self._sync.newest_seen_s = item.newest_s
        age_s = time.monotonic() - item.newest_s
        if age_s <= self._settings.stale_s or item.block.fault is not None:
            return item.block
        message = (
            f"samples reached the guard {age_s:.2f} s late (guard.stale_data_s), because card {self._card.device} or "
            "this computer was held up: end other programs"
        )
        return replace(item.block, fault=Trip(TripCause.STALE_DATA, message))

    def end(self, timeout_s: float) -> bool:
        """Have the tasks closed; return False when the driver does not return within `timeout_s`.

        Raises `DeviceError` when the tasks could not be closed properly.
        """
        self._end_requested.set()
        self._thread.join(timeout_s)
        if self._closing_error is not None:
            raise self._closing_error
        return not self.alive

    @property
    def alive(self) -> bool:
        """Whether the thread still runs."""
        return self._thread.is_alive()

    def _run(self) -> None:
        failed = False
        try:
            while (block := self._next_block()) is not None:
                self._put(_TimedBlock(block, self._newest_s))
            self._put(None)
        except Exception as error:  # noqa: BLE001  # raised again in the thread that reads
            failed = True
            self._put(self._wrapped(error))
        finally:
            self._close_tasks(failed)

    def _close_tasks(self, failed: bool) -> None:
        try:
            self._close()
        except Exception as error:  # noqa: BLE001  # raised again by `end`
            # A card that has failed already fails here once more, which is no news.
            self._closing_error = None if failed else self._wrapped(error)

    def _next_block(self) -> Block | None:
        while not self._end_requested.is_set():
            wanted = min(self._settings.block_samples, self._end_index() - self._fetcher.next_index)
            if wanted <= 0:
                if lost := self._fetcher.lost:
                    raise DeviceError(
                        f"the last {lost} samples are lost, because this computer did not read them in time: end "
                        "other programs, or lower sampling.rate_hz."
                    )
                return None
            batch = self._fetcher.fetch(wanted)
            self._losing = not batch.samples and self._fetcher.lost > 0
            self._sensor_fault = self._monitor.add(batch.force_input) or self._sensor_fault
            if batch.samples:
                taken_s = (batch.samples + batch.lost) / self._settings.rate_hz
                self._newest_s = min(time.monotonic(), self._newest_s + taken_s * (1 + _CLOCK_TOLERANCE))
                return self._block(batch)
        return None

    def _end_index(self) -> int:
        """Return where sampling ends: at the profile's end, or once a stage that was stopped is at rest."""
        if self._end_index_after_stop is None and self._sync.stop_requested:
            if self._sync.moving:
                return self._fetcher.next_index + self._settings.block_samples
            after_stop = math.ceil(_POST_STOP_S * self._settings.rate_hz)
            self._end_index_after_stop = max(self._fetcher.next_index, self._fetcher.acquired + after_stop)
        return self._settings.samples if self._end_index_after_stop is None else self._end_index_after_stop

    def _block(self, batch: SampleBatch) -> Block:
        if batch.first_index == 0:
            self._origin_counts = float(batch.counts[0])
        fault, self._sensor_fault = self._sensor_fault, None
        if batch.lost:
            at_s = (batch.first_index - batch.lost) / self._settings.rate_hz
            fault = Trip(
                TripCause.OVERRUN,
                f"{batch.lost} samples from {at_s:.3f} s on are lost, because this computer did not read them in time",
            )
        return Block(batch.first_index, self._scaling.scale(batch.volts, batch.counts, self._origin_counts), fault)

    def _wrapped(self, error: Exception) -> Exception:
        return device_error(error, self._card, "it samples") if isinstance(error, driver_errors()) else error

    def _put(self, item: _TimedBlock | Exception | None) -> None:
        while not self._end_requested.is_set():
            try:
                self._queue.put(item, timeout=_POLL_S)
            except Full:
                continue
            return


PROBE_S = 0.2
"""How long the force input is sampled as fast as the card can, to find what would be recorded as aliases."""
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
    """Samples by the card's own clock; a thread fetches, and the caller of `read` gets blocks.

    One thread arms, starts and reads; `stop` may come from any.

    Parameters
    ----------
    calibrations
        The calibrations in force, by quantity (force, encoder).
    sync, clock
        Shared with the stage: motion state and time of the first sample, and the rig's clock.
    feed_watchdog
        Called whenever the program waits for samples or takes them.
    on_arm
        Called with each acquisition before it is prepared.

    Raises
    ------
    SettingsError
        When the settings exceed the card's aggregate sample rate.
    """

    def __init__(
        self,
        connection: Connection,
        rig: RigSettings,
        calibrations: Mapping[str, Calibration],
        sync: MotionSamplingSync,
        clock: Clock,
        feed_watchdog: Callable[[], None] = lambda: None,
        on_arm: Callable[[Acquisition], None] = lambda _: None,
    ) -> None:
        _refuse_excessive_rate(rig)
        self._connection, self._rig, self._sync, self._clock = connection, rig, sync, clock
        self._feed_watchdog, self._on_arm = feed_watchdog, on_arm
        self._scaling = Scaling.from_settings(rig, calibrations)
        self.channels, self.force_range_mN = self._scaling.channels, self._scaling.force_range_mN
        """Force, position and further inputs of the settings; and the forces at the ends of the force input's range."""
        self._alive_uV = calibrations["force"].noise_uV if "force" in calibrations else 0.0
        self.anti_alias = AntiAliasFilter.of(oversampling_factor(rig))
        """What makes recorded samples of the card's."""
        self._timing: ScanTiming | None = None
        # A block is complete once the filter has the samples after it. At most half of what counts as stale, so that a
        # healthy card cannot look stale.
        wait_s = 0.0 if self.anti_alias.factor == 1 else WINGS / rig.sampling.rate_hz
        block_s = min(rig.sampling.block_s, _MAX_FETCH_S - wait_s, rig.guard.stale_data_s / 2 - wait_s)
        self._block_samples = max(1, int(block_s * rig.sampling.rate_hz + 1e-6))
        self._lock = Lock()
        self._acquisition: _ArmedAcquisition | None = None
        self._was_armed = False
        self._hung_reader: ReaderThread | None = None

    @property
    def sample_rate_hz(self) -> float:
        """Recorded samples per second of every channel, as the card's clock, a fraction of its time base, gives them.

        Raises `DeviceError` when the card refuses to tell.
        """
        return self.timing.rate_hz / self.anti_alias.factor

    @property
    def timing(self) -> ScanTiming:
        """The card's clocks; the first time they are asked of the card, which must be idle then."""
        if self._timing is None:
            with driver_errors_wrapped(self._connection.card, "its sample clock is set"):
                tasks = self._reserved_tasks("its sample clock is set")
                tasks.close()
            return tasks.timing
        return self._timing

    def arm(self, acquisition: Acquisition) -> None:
        """Reserve and program the card for an acquisition of the profile's length.

        Raises `DeviceError` when the previous acquisition was not ended with `stop`, the stage moves, or the card
        refuses.
        """
        self._on_arm(acquisition)
        if self._acquisition is not None:
            raise DeviceError("the sampler is still armed for the previous acquisition: stop it first.")
        if self._sync.moving:
            raise DeviceError("the sampler cannot be armed while the stage moves: wait or stop it first.")
        tasks = self._reserved_tasks("it is armed")
        self._acquisition = _ArmedAcquisition(tasks, acquisition.profile.samples(self.sample_rate_hz))
        self._was_armed = True
        self._sync.arm()

    def start(self) -> None:
        """Take the first sample now, and pass its time to the stage.

        Raises `DeviceError` when the sampler is not armed, was started already, or the card refuses.
        """
        armed = self._acquisition
        if armed is None or armed.started:
            raise DeviceError("the sampler cannot start: arm it once for each acquisition.")
        armed.started = True
        if self._sync.stop_requested:
            return
        with driver_errors_wrapped(self._connection.card, "it starts"):
            armed.tasks.start(self._start_clock)
        with self._lock:
            if self._acquisition is armed:
                armed.reader = ReaderThread(
                    self._fetcher(armed.tasks),
                    self._scaling,
                    self._monitor(),
                    ReadSettings(armed.samples, self._block_samples, self.sample_rate_hz, self._rig.guard.stale_data_s),
                    self._sync,
                    self._connection.card,
                    armed.tasks.close,
                )

    def read(self, cancel: Signal) -> Block | None:
        """Return the next block; None after the last one, after `stop`, and when `cancel` is set.

        Raises
        ------
        DeviceError
            When the sampler was not started, or the card fails.
        StaleDataError
            When nothing arrives for as long as `guard.stale_data_s`.
        """
        self._feed_watchdog()
        armed = self._acquisition
        if armed is None and self._was_armed:
            return None
        if armed is None or not armed.started:
            raise DeviceError("the sampler has nothing to read: arm and start it first.")
        return None if armed.reader is None else armed.reader.take(cancel, self._feed_watchdog)

    def stop(self) -> None:
        """End the acquisition and release the card, waiting for a hung driver only for a limited time.

        Raises `DeviceError` when the driver does not return, or does not release the card.
        """
        with self._lock:
            armed, self._acquisition = self._acquisition, None
        self._sync.disarm()
        if armed is None:
            return
        card, timeout_s = self._connection.card, self._rig.hardware.hang_s + 1.0
        if armed.reader is None:
            with driver_errors_wrapped(card, "it is released"):
                armed.tasks.close()
        elif not armed.reader.end(timeout_s):
            self._hung_reader = armed.reader
            raise DeviceError(
                f"the driver of card {card.device} has not returned for {timeout_s:g} s: the card stays reserved until "
                "it does; restart the program, and the computer if that does not help."
            )

    def measure(self, duration_s: float, cancel: Signal | None = None) -> RawReading:
        """Sample for a while without moving, and return the raw voltages and counts, for a calibration.

        Once `cancel` is set, the samples until then are returned.

        Raises
        ------
        DeviceError
            When the sampler is armed, or the card fails.
        StaleDataError
            When nothing arrives for as long as `guard.stale_data_s`.
        """
        with self._sampling("it measures") as fetcher:
            samples = max(1, round(duration_s * self.sample_rate_hz))
            monitor = self._monitor()
            volts, counts, fault = self._collect(fetcher, monitor, samples, cancel)
        mean_mN = self._scaling.mN_per_V * float(np.mean(volts, dtype=np.float64)) + self._scaling.zero_mN
        reading = RawReading.of(volts, -counts if self._connection.card.encoder.reversed else counts, mean_mN)
        return replace(reading, force_noise_V=monitor.noise_V, fault=fault)

    @contextmanager
    def watch(self) -> Iterator[Callable[[], tuple[FloatArray, FloatArray]]]:
        """Sample without moving until the end of the context.

        Yields
        ------
        Returns the next block from now on: the force input's volts, and the encoder's counts since the
        beginning, rising where the stage moves up, shape `(n,)` each. Nothing is counted twice or missed between two
        calls. Raises as `measure`.

        Raises
        ------
        DeviceError
            When the sampler is armed, or the card fails.
        """
        card, stale_s = self._connection.card, self._rig.guard.stale_data_s
        sign = -1.0 if card.encoder.reversed else 1.0
        with self._sampling("it is watched") as fetcher:

            def read() -> tuple[FloatArray, FloatArray]:
                with driver_errors_wrapped(card, "it is watched"):
                    fetcher.skip_to_newest()
                    batch, until_s = fetcher.fetch(self._block_samples), time.monotonic() + stale_s
                    while not batch.samples:
                        if time.monotonic() > until_s:
                            raise no_samples_error(card, stale_s)
                        batch = fetcher.fetch(self._block_samples)
                return batch.volts[0].copy(), sign * batch.counts

            yield read

    @contextmanager
    def _sampling(self, doing: str) -> Iterator[SampleFetcher | OversampledFetcher]:
        """Sample without an acquisition until the end of the context."""
        if self._acquisition is not None:
            raise DeviceError("the sampler is armed for an acquisition: stop it before a measurement.")
        with driver_errors_wrapped(self._connection.card, doing):
            tasks = self._reserved_tasks(doing)
            try:
                tasks.start(lambda start: start())
                yield self._fetcher(tasks)
            finally:
                tasks.close()

    def probe_aliases(self) -> Alias:
        """Sample the force input alone, as fast as the card can, and return the part that a recording would fold down.

        Raises `DeviceError` when the sampler is armed, or the card fails.
        """
        if self._acquisition is not None:
            raise DeviceError("the sampler is armed for an acquisition: stop it before its input is probed.")
        with driver_errors_wrapped(self._connection.card, "its force input is probed"):
            volts, rate_hz = read_force_alone(self._connection, MAX_AGGREGATE_RATE_HZ, PROBE_S)
        if len(volts) < PROBE_S * rate_hz / 2:
            raise no_samples_error(self._connection.card, PROBE_S)
        return find_aliases(volts, rate_hz, self.anti_alias, self.sample_rate_hz)

    def _collect(
        self,
        fetcher: SampleFetcher | OversampledFetcher,
        monitor: ForceInputMonitor,
        samples: int,
        cancel: Signal | None,
    ) -> tuple[FloatArray, FloatArray, Trip | None]:
        """Return the force's volts and the encoder's counts of the next samples, shape `(samples,)` or shorter each.

        Last comes the state of the sensor as the force input showed it.
        """
        volts, counts = np.empty(samples), np.empty(samples)
        stale_s, last_data_s = self._rig.guard.stale_data_s, time.monotonic()
        collected, fault = 0, None
        while collected < samples and not (collected and cancel is not None and cancel.is_set()):
            self._feed_watchdog()
            batch = fetcher.fetch(min(self._block_samples, samples - collected))
            fault = fault or monitor.add(batch.force_input)
            if batch.samples:
                last_data_s = time.monotonic()
            elif time.monotonic() - last_data_s > stale_s:
                raise no_samples_error(self._connection.card, stale_s)
            end = collected + batch.samples
            volts[collected:end], counts[collected:end] = batch.volts[0], batch.counts
            collected = end
        return volts[:collected], counts[:collected], fault

    def _reserved_tasks(self, doing: str) -> SampledTasks:
        card = self._connection.card
        if self._hung_reader is not None and self._hung_reader.alive:
            raise DeviceError(
                f"card {card.device} is still reserved by a driver call that does not return: restart the program, and "
                "the computer if that does not help."
            )
        with driver_errors_wrapped(card, doing):
            tasks = SampledTasks(self._connection, self._rig, self._rig.sampling.rate_hz * self.anti_alias.factor)
        self._timing = tasks.timing
        return tasks

    def _start_clock(self, start: Callable[[], None]) -> None:
        before_s = self._clock.monotonic()
        start()
        after_s = self._clock.monotonic()
        self._sync.set_first_sample(FirstSample((before_s + after_s) / 2, (after_s - before_s) / 2))

    @property
    def noise_limits(self) -> NoiseLimits:
        """How little noise of the force input says that its sensor is dead; raises as `timing`."""
        return NoiseLimits(self._rig, self._alive_uV, self.timing.rate_hz)

    def _monitor(self) -> ForceInputMonitor:
        return ForceInputMonitor(self._rig, self.noise_limits, self.timing.rate_hz)

    def _fetcher(self, tasks: SampledTasks) -> SampleFetcher | OversampledFetcher:
        inputs, factor = len(self._scaling.channels) - 1, self.anti_alias.factor
        block = self._block_samples * factor + self.anti_alias.wing
        fetcher = SampleFetcher(tasks.analog, tasks.encoder, inputs, block, metres_per_count(self._rig))
        return fetcher if factor == 1 else OversampledFetcher(fetcher, self.anti_alias, inputs)


def _refuse_excessive_rate(rig: RigSettings) -> None:
    inputs, factor = 1 + len(rig.hardware.card.inputs), oversampling_factor(rig)
    if inputs * factor * rig.sampling.rate_hz > MAX_AGGREGATE_RATE_HZ:
        times = f" {factor} times" if factor > 1 else ""
        raise SettingsError(
            f"sampling.rate_hz = {rig.sampling.rate_hz:g}{times} with {inputs} analog inputs exceeds the "
            f"{MAX_AGGREGATE_RATE_HZ:,} samples per second that the card converts over all channels: set at most "
            f"{MAX_AGGREGATE_RATE_HZ // (inputs * factor):,}, or leave out some of hardware.card.inputs."
        )
