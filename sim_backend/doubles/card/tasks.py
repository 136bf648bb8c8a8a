"""The tasks of the card's double and their sampled data: resources, sample clocks, triggers, buffers, waveforms.

Counts of the encoder are its own, four a period, 0 at its index pulse. One lock guards all.
"""

import math
import threading
import time
from bisect import bisect_left
from dataclasses import dataclass, field

import numpy as np
from nidaqmx.constants import AcquisitionType, ChannelType, ReadRelativeTo
from nidaqmx.error_codes import DAQmxErrors as Status

from dragrig.rig import FloatArray
from dragrig.sim_backend.doubles.card import pci6229
from dragrig.sim_backend.doubles.card.pci6229 import CardError, EncoderChannel, VirtualChannel
from dragrig.sim_backend.doubles.simulated_bench import SimulatedBench

_MIN_WAIT_S = 2e-4
INDEX_HYSTERESIS_COUNTS = -20
"""Where the index pulse is when it is passed downwards: its place is repeatable from one side only."""


class AnalogSource:
    """Volts of analog inputs, as the converter reads them; 0 where nothing is wired."""

    def __init__(self, bench: SimulatedBench, channels: list[VirtualChannel], rate_hz: float) -> None:
        self._bench = bench
        self.rate_hz = rate_hz
        card = bench.rig.hardware.card
        signals = {settings.channel.lower(): settings.name for settings in card.inputs}
        signals[card.force.channel.lower()] = "force_V"
        self._signals = [(signals.get(channel.physical), channel.range_V) for channel in channels]

    def total(self) -> int:
        """Return how many samples per channel were taken."""
        return self._bench.available()

    def fetch(self, first: int, end: int) -> list[FloatArray]:
        """Return volts of each channel."""
        samples = self._bench.sample(first, end)
        wired = [samples[signal] if signal is not None else np.zeros(end - first) for signal, _ in self._signals]
        seen = pci6229.with_ghosts(wired, pci6229.convert_interval(self.rate_hz, len(wired)))
        return [pci6229.quantised(volts, range_V) for volts, (_, range_V) in zip(seen, self._signals, strict=True)]


@dataclass(frozen=True, slots=True)
class LatchClock:
    """The analog inputs' sample clock, as a counter receives it."""

    rate_hz: float
    origin: int
    """The encoder's count at the inputs' first sample."""
    skipped: int
    """Samples that the inputs had taken when the counter was started."""


class EncoderCounter:
    """A counter from its start on, and the samples that the analog inputs' clock latched of it."""

    def __init__(self, bench: SimulatedBench, encoder: EncoderChannel, channel: VirtualChannel) -> None:
        self._bench = bench
        self._encoder = encoder
        wired = bench.rig.hardware.card.encoder
        a, b, z = pci6229.encoder_terminals(channel)
        terminals = (wired.a.lower(), wired.b.lower())
        # Swapped terminals count backwards; other terminals carry no signal.
        self._sense = {terminals: 1, terminals[::-1]: -1}.get((a, b), 0)
        self._index = (
            encoder.index
            and bool(wired.z)
            and z == wired.z.lower()
            and encoder.index_phase is pci6229.INDEX_PHASES[bench.faults.active.index_phase]
        )
        self._index_count = 0
        self._start_count = self._last_count = count_now(bench)
        self._indexed = False
        self._indexed_from: int | None = None
        self._searched_to = 0
        self._held = np.zeros(0)
        self._held_first = self._base = 0
        self._clock: LatchClock | None = None

    @property
    def rate_hz(self) -> float:
        """Samples per second that come at present."""
        return self._clock.rate_hz if self._clock is not None else 0.0

    def position_m(self) -> float:
        """Return the present position."""
        count = self._last_count if self._bench.faults.active.encoder_stuck else count_now(self._bench)
        self._pass_over(count)
        return float(self._positions(np.array([count]), 0 if self._indexed else 1)[0])

    def set_clock(self, clock: LatchClock) -> None:
        """Latch a sample at each edge of the inputs' clock from here on."""
        self._pass_over(clock.origin)
        if self._indexed and self._indexed_from is None:
            self._indexed_from = self._base
        self._clock = clock

    def end_clock(self, oldest: int) -> int:
        """Hold the counts latched since `oldest`, as the inputs' clock stops; return the first sample that is held."""
        total = self.total()
        first = min(max(oldest, self._held_first), total)
        self._held = self._counts(first, total)
        self._held_first, self._base, self._clock = first, total, None
        return first

    def total(self) -> int:
        """Return how many samples were latched since the counter was started."""
        if self._clock is None:
            return self._base
        return self._base + max(self._bench.available() - self._clock.skipped, 0)

    def fetch(self, first: int, end: int) -> list[FloatArray]:
        """Return latched positions."""
        counts = self._counts(first, end)
        if self._index and self._indexed_from is None:
            self._search_index(end)
        until = end if self._indexed_from is None else self._indexed_from
        return [self._positions(counts, until - first)]

    def _counts(self, first: int, end: int) -> FloatArray:
        held = self._held[max(first - self._held_first, 0) : max(end - self._held_first, 0)]
        if end <= self._base or self._clock is None:
            return held
        shift = self._clock.skipped - self._base
        latched = self._bench.sample(max(first, self._base) + shift, end + shift)["encoder_counts"] + self._clock.origin
        return latched if first >= self._base else np.concatenate([held, latched])

    def _positions(self, counts: FloatArray, indexed_from: int) -> FloatArray:
        encoder = self._encoder
        before = encoder.start_m + self._sense * (counts - self._start_count) * encoder.count_m
        if indexed_from >= len(counts):
            return np.asarray(before)
        after = encoder.index_m + self._sense * (counts - self._index_count) * encoder.count_m
        return np.where(np.arange(len(counts)) < indexed_from, before, after)

    def _pass_over(self, count: int) -> None:
        if self._index and (self._last_count < 0) != (count < 0):
            self._indexed = True
            self._index_count = INDEX_HYSTERESIS_COUNTS if count < 0 else 0
        self._last_count = count

    def _search_index(self, end: int) -> None:
        first = max(self._searched_to, self._held_first)
        counts = np.concatenate([[self._last_count], self._counts(first, end)])
        crossings = np.flatnonzero(np.diff(counts < 0))
        self._last_count, self._searched_to = int(counts[-1]), end
        if len(crossings):
            self._indexed = True
            self._indexed_from = first + int(crossings[0])


def count_now(bench: SimulatedBench) -> int:
    """Return the encoder's present count."""
    return int(bench.counts(np.array([bench.position_mm()]))[0])


class InputBuffer:
    """The buffer of one running task. The caller of a method holds the engine's `changed`.

    Parameters
    ----------
    size
        Samples per channel that the buffer holds; a sample that was not read in time is overwritten.
    """

    def __init__(
        self, engine: "TaskEngine", task: "CardTask", source: AnalogSource | EncoderCounter, size: int
    ) -> None:
        self._engine, self._task = engine, task
        self.source = source
        self.position = 0
        """Index of the next sample of a relative read."""
        self._size = size
        self._stalled_at: int | None = None
        self._lost_before = 0
        self._short_reads = 0

    def total(self) -> int:
        """Return how many samples per channel reached the buffer."""
        return self.source.total() if self._stalled_at is None else self._stalled_at

    def oldest(self) -> int:
        """Return the first sample that the buffer still holds."""
        return max(self.total() - self._size, self._lost_before, 0)

    def stall(self, stalled: bool) -> None:
        """Let no further sample reach the buffer, or at once all that were taken meanwhile."""
        if stalled != (self._stalled_at is not None):
            self._stalled_at = self.total() if stalled else None

    def forget_before(self, index: int) -> None:
        """Lose everything before a sample."""
        self._lost_before = max(self._lost_before, index)

    def read(self, first: int, samples: int, timeout_s: float, short_reads: int) -> tuple[int, CardError | None]:
        """Wait for samples from an index on, and advance the position by those that came.

        Returns
        -------
        int, CardError or None
            The index after the last sample that came, and why it is not all that was requested.

        Raises
        ------
        CardError
            When the first sample was overwritten (−200279), or the card is gone.
        """
        self._engine.check_running(self._task)
        wanted = samples
        if self._short_reads < short_reads:
            self._short_reads += 1
            wanted = samples // 2
        deadline_s = math.inf if timeout_s < 0 else time.perf_counter() + timeout_s
        while True:
            if first < self.oldest():
                raise CardError(
                    Status.SAMPLES_NO_LONGER_AVAILABLE,
                    "The application is not able to keep up with the hardware acquisition: the sample to be read was "
                    f"overwritten.\n\nSample: {first}\nOldest Sample in Buffer: {self.oldest()}",
                )
            missing = first + wanted - self.total()
            left_s = deadline_s - time.perf_counter()
            if missing <= 0 or left_s <= 0:
                break
            rate_hz = self.source.rate_hz if self._stalled_at is None else 0.0
            due_s = max(missing / (rate_hz * self._engine.bench.clock.pace), _MIN_WAIT_S) if rate_hz > 0 else math.inf
            wait_s = min(left_s, due_s)
            self._engine.changed.wait(None if math.isinf(wait_s) else wait_s)
            self._engine.check_running(self._task)
        self.position = max(min(first + wanted, self.total()), first)
        arrived = self.position - first
        if arrived == samples:
            return self.position, None
        return self.position, CardError(
            Status.SAMPLES_NOT_YET_AVAILABLE,
            "Some or all of the samples requested have not yet been acquired.\n\n"
            f"Samples Requested: {samples}\nSamples There: {arrived}",
            arrived,
        )


class OutputWaveform:
    """Voltages of an analog output on a clock, generated once each. Times are readings of the bench's clock.

    Parameters
    ----------
    size
        Samples that the buffer holds.
    """

    def __init__(self, size: int, rate_hz: float) -> None:
        self.size = size
        self.rate_hz = rate_hz
        self.written = 0
        self.began_s: float | None = None
        """When the first sample was generated."""
        self._ring = np.zeros(size)

    def generated(self, now_s: float) -> int:
        """Return how many samples were generated."""
        return min(self._due(now_s), self.written)

    def ran_empty(self, now_s: float) -> bool:
        """Whether a sample was due that had not been written."""
        return self._due(now_s) > self.written

    def space(self, now_s: float) -> int:
        """Return how many samples can be written."""
        return self.size - (self.written - self.generated(now_s))

    def write(self, volts: FloatArray) -> None:
        """Append samples, at most the space."""
        self._ring[(self.written + np.arange(len(volts))) % self.size] = volts
        self.written += len(volts)

    def buffered(self) -> FloatArray:
        """Return the values written before the start."""
        return self._ring[: self.written]

    def voltage(self, now_s: float) -> float | None:
        """Return the present voltage; None before the first sample."""
        generated = self.generated(now_s)
        return float(self._ring[(generated - 1) % self.size]) if generated else None

    def _due(self, now_s: float) -> int:
        return 0 if self.began_s is None else math.floor((now_s - self.began_s) * self.rate_hz) + 1


@dataclass(frozen=True, slots=True)
class SampleClock:
    """A task's sample clock; `source` is empty for the card's own."""

    rate_hz: float
    source: str
    buffer_size: int


@dataclass(slots=True, eq=False)
class CardTask:
    """A task: its configuration, and its state. Only the `TaskEngine` changes it, under its lock."""

    handle: int
    name: str
    channels: list[VirtualChannel] = field(default_factory=list)
    encoder: EncoderChannel | None = None
    clock: SampleClock | None = None
    relative_to: int = ReadRelativeTo.CURRENT_READ_POSITION.value
    offset: int = 0
    input_buffer: int = 0
    output_buffer: int = 0
    trigger: str = ""
    reserved: bool = False
    running: bool = False
    origin_count: int = 0
    buffer: InputBuffer | None = None
    counter: EncoderCounter | None = None
    waveform: OutputWaveform | None = None

    @property
    def kind(self) -> ChannelType | None:
        """The kind of its channels; None without channels."""
        return self.channels[0].kind if self.channels else None

    def failure(self, code: Status, sentence: str, samples: int = 0) -> CardError:
        """Return an error that names the task."""
        return CardError(code, f"{sentence}\n\nTask Name: {self.name}", samples)


class TaskEngine:
    """Tasks on a bench.

    Any thread may call the functions of the driver's clients; the caller of any other method holds `changed`.

    Parameters
    ----------
    bench
        The parts that the card is wired to.
    """

    def __init__(self, bench: SimulatedBench) -> None:
        self.bench = bench
        self.card = bench.rig.hardware.card
        self.changed = threading.Condition()
        self.tasks: dict[int, CardTask] = {}
        self._handles = 0
        self._holders: dict[str, CardTask] = {}
        self._lost_samples = bench.faults.active.overwritten_samples
        bench.faults.subscribe(self._apply_faults)

    @property
    def now_s(self) -> float:
        """The bench's clock."""
        return self.bench.clock.monotonic()

    def create_task(self, name: str) -> int:
        """Return the handle of a new task; an empty name lets the driver choose one."""
        with self.changed:
            if any(task.name == name for task in self.tasks.values()):
                raise CardError(Status.DUPLICATE_TASK, f"Specified task name is already in use.\n\nTask Name: {name}")
            self._handles += 1
            self.tasks[self._handles] = CardTask(self._handles, name or f"_unnamedTask<{self._handles - 1}>")
            return self._handles

    def task(self, handle: int, kind: ChannelType | None = None) -> CardTask:
        """Return a task, whose channels must be of `kind` if that is not None."""
        task = self.tasks.get(handle)
        if task is None:
            raise CardError(Status.INVALID_TASK, "Task specified is invalid or does not exist.")
        if kind is not None and task.kind is not kind:
            code = (
                Status.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK if task.kind is None else Status.INVALID_PHYS_CHAN_TYPE
            )
            raise task.failure(code, "Task has no channels that can do this.")
        return task

    def idle_task(self, handle: int) -> CardTask:
        """Return a task that may be configured."""
        task = self.task(handle)
        if task.running:
            raise task.failure(
                Status.CAN_NOT_PERFORM_OP_WHILE_TASK_RUNNING,
                "Specified operation cannot be performed while the task is running.",
            )
        return task

    def check_card(self, *, listed: bool = False) -> None:
        """Raise the fault that keeps the card silent; with `listed`, also when the driver knows no such card."""
        faults, device = self.bench.faults.active, f"\n\nDevice: {self.card.device}"
        if faults.card_gone:
            raise CardError(
                Status.DRIVER_DEVICE_GUID_NOT_FOUND_ROUTING,
                f"The specified device is not present or is not active.{device}",
            )
        if faults.card_unplugged:
            raise CardError(
                Status.DEV_CANNOT_BE_ACCESSED,
                "Device cannot be accessed. Possible causes: it is no longer present in the system, not powered, or "
                f"the computer woke up from sleep.{device}",
            )
        if listed and faults.card_absent:
            raise CardError(Status.INVALID_DEVICE_ID, f"Device identifier is invalid.{device}")

    def add(self, handle: int, channels: list[VirtualChannel]) -> CardTask:
        """Add channels to a task, all of one kind, each once."""
        self.check_card(listed=True)
        task = self.idle_task(handle)
        for channel in channels:
            if any(channel.name == present.name for present in task.channels):
                raise task.failure(Status.CHAN_ALREADY_IN_TASK, f"Channel is in the task already: {channel.name}")
            if task.kind not in {None, channel.kind}:
                raise task.failure(Status.INVALID_PHYS_CHAN_TYPE, f"Channel {channel.name} is of another kind.")
        task.channels.extend(channels)
        return task

    def cfg_samp_clk_timing(self, handle: int, source: str, rate_hz: float, mode: int, samples: int) -> None:
        """Give a task a continuous sample clock at the nearest rate that the card can make."""
        with self.changed:
            task = self.idle_task(handle)
            if not rate_hz > 0:
                raise task.failure(Status.INVALID_ATTRIBUTE_VALUE, f"Sample rate must be above 0, not {rate_hz:g}.")
            if task.kind not in {ChannelType.ANALOG_INPUT, ChannelType.ANALOG_OUTPUT, ChannelType.COUNTER_INPUT}:
                raise task.failure(
                    Status.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK, "Task has no channels with a sample clock."
                )
            place = pci6229.find_terminal(source, self.card.device) if source and source != "OnboardClock" else ""
            if task.kind is not ChannelType.COUNTER_INPUT:
                is_input = task.kind is ChannelType.ANALOG_INPUT
                max_hz = pci6229.AI_MAX_RATE_HZ / len(task.channels) if is_input else pci6229.AO_MAX_RATE_HZ
                rate_hz = pci6229.nearest_rate(rate_hz)
                if rate_hz > max_hz * (1 + 1e-9):
                    single = len(task.channels) == 1
                    code = Status.SAMP_RATE_TOO_HIGH if single else Status.SAMPLE_RATE_NUM_CHANS_CONVERT_PERIOD_COMBO
                    raise task.failure(code, f"Sample rate {rate_hz:g} Hz is above the possible {max_hz:g} Hz.")
            if mode != AcquisitionType.CONTINUOUS.value:
                raise task.failure(Status.INVALID_ATTRIBUTE_VALUE, f"Sample mode {mode} is not supported by this task.")
            task.clock = SampleClock(rate_hz, place, _default_buffer(rate_hz, samples))

    def cfg_dig_edge_start_trig(self, handle: int, source: str) -> None:
        """Let the start of the analog inputs start a task."""
        with self.changed:
            task, place = self.idle_task(handle), pci6229.find_terminal(source, self.card.device)
            if task.kind is not ChannelType.ANALOG_OUTPUT or place != pci6229.AI_START_TRIGGER:
                raise task.failure(
                    Status.ATTR_NOT_SUPPORTED,
                    f"Only outputs can be triggered here, by {pci6229.AI_START_TRIGGER}, not by {place}.",
                )
            task.trigger = place

    def reserve(self, task: CardTask) -> None:
        """Assign to a task the resources that it needs of the card; raises `CardError` when another task has them."""
        self.check_card(listed=True)
        if task.kind is None:
            raise task.failure(Status.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK, "Task has no channels.")
        if task.kind is ChannelType.COUNTER_INPUT and task.clock is not None and not task.clock.source:
            raise task.failure(Status.EXT_SAMP_CLK_SRC_NOT_SPECIFIED, "The counter has no sample clock of its own.")
        resources = _required_resources(task)
        for resource in resources:
            if self._holders.get(resource, task) is not task or self.bench.faults.active.card_reserved:
                is_line = task.kind is ChannelType.DIGITAL_OUTPUT
                raise task.failure(
                    Status.DIG_LINES_RESERVED_OR_UNAVAILABLE if is_line else Status.PAL_RESOURCE_RESERVED,
                    f"The specified resource is reserved.\n\nDevice: {self.card.device}\nResource: {resource}",
                )
        self._holders.update(dict.fromkeys(resources, task))

    def start(self, handle: int) -> None:
        """Start a task."""
        with self.changed:
            task = self.idle_task(handle)
            self.reserve(task)
            if task.kind is ChannelType.ANALOG_INPUT and task.clock is not None:
                self._start_inputs(task, task.clock)
            elif task.kind is ChannelType.COUNTER_INPUT:
                self._start_counter(task)
            elif task.waveform is not None and not task.trigger:
                self._begin_waveform(task, self.now_s)
            task.running = True
            self.changed.notify_all()

    def stop(self, handle: int) -> None:
        """Stop a task, release its resources, keep its configuration."""
        with self.changed:
            self.end(self.task(handle))
            self.check_card()

    def clear_task(self, handle: int) -> None:
        """Stop a task, release its resources and forget it."""
        with self.changed:
            task = self.task(handle)
            task.reserved = False
            self.end(task)
            del self.tasks[handle]

    def end(self, task: CardTask) -> None:
        """Stop a task; resources that it did not reserve explicitly are released."""
        if task.running and task.kind is ChannelType.ANALOG_INPUT and task.buffer is not None:
            for latched in self.tasks.values():
                if latched.counter is not None and latched.buffer is not None and latched.counter.rate_hz > 0:
                    oldest = max(latched.buffer.oldest(), latched.buffer.position)
                    latched.buffer.forget_before(latched.counter.end_clock(oldest))
            self.bench.end_sampling()
        if task.running and task.waveform is not None:
            volts = task.waveform.voltage(self.now_s)
            if volts is not None:
                self.hold_voltage(task.channels[0], volts)
        task.running, task.buffer, task.counter, task.waveform = False, None, None, None
        if not task.reserved:
            self._holders = {resource: holder for resource, holder in self._holders.items() if holder is not task}
        self.changed.notify_all()

    def check_running(self, task: CardTask) -> None:
        """Raise when the card is gone or the task was stopped."""
        self.check_card()
        if not task.running:
            raise task.failure(
                Status.RUNTIME_ABORTING_ROUTING, "The operation was stopped before it could be completed."
            )

    def hold_voltage(self, channel: VirtualChannel, volts: float) -> None:
        """Let an output hold a voltage."""
        self.bench.put_out(channel.physical, np.array([volts]), 0.0, self.now_s)

    def announce(self, task: CardTask, volts: FloatArray, first: int) -> None:
        """Tell the bench of voltages of a waveform that has begun, the first of them its sample `first`."""
        waveform = task.waveform
        if waveform is not None and waveform.began_s is not None and len(volts):
            due_s = waveform.began_s + first / waveform.rate_hz
            self.bench.put_out(task.channels[0].physical, np.array(volts), waveform.rate_hz, due_s)

    def _begin_waveform(self, task: CardTask, at_s: float) -> None:
        if task.waveform is not None and task.waveform.began_s is None:
            if not task.waveform.written:
                raise task.failure(Status.SAMPLES_CAN_NOT_YET_BE_WRITTEN, "No samples were written to generate.")
            task.waveform.began_s = at_s
            self.announce(task, task.waveform.buffered(), 0)

    def _start_inputs(self, task: CardTask, clock: SampleClock) -> None:
        task.origin_count = count_now(self.bench)
        self.bench.begin_sampling(clock.rate_hz)
        for output in self.tasks.values():
            if output.running and output.trigger:
                self._begin_waveform(output, self.bench.began_s)
        task.buffer = self._input_buffer(task, AnalogSource(self.bench, task.channels, clock.rate_hz), clock)
        for latched in self.tasks.values():
            if latched.counter is not None and _follows_inputs(latched):
                latched.counter.set_clock(LatchClock(clock.rate_hz, task.origin_count, 0))

    def _start_counter(self, task: CardTask) -> None:
        if task.encoder is None:
            return
        task.counter = EncoderCounter(self.bench, task.encoder, task.channels[0])
        if task.clock is None:
            return
        task.buffer = self._input_buffer(task, task.counter, task.clock)
        inputs = self._holders.get("ai")
        if _follows_inputs(task) and inputs is not None and inputs.buffer is not None:
            source = inputs.buffer.source
            task.counter.set_clock(LatchClock(source.rate_hz, inputs.origin_count, source.total()))

    def _input_buffer(self, task: CardTask, source: AnalogSource | EncoderCounter, clock: SampleClock) -> InputBuffer:
        buffer = InputBuffer(self, task, source, task.input_buffer or clock.buffer_size)
        buffer.stall(self.bench.faults.active.card_stalled)
        return buffer

    def _apply_faults(self) -> None:
        with self.changed:
            faults = self.bench.faults.active
            lost, self._lost_samples = faults.overwritten_samples - self._lost_samples, faults.overwritten_samples
            for task in self.tasks.values():
                if task.buffer is not None:
                    task.buffer.stall(faults.card_stalled)
                    if lost > 0:
                        task.buffer.forget_before(task.buffer.position + lost)
            self.changed.notify_all()


def _required_resources(task: CardTask) -> list[str]:
    if task.kind is ChannelType.ANALOG_INPUT:
        return ["ai"]
    if task.kind is ChannelType.DIGITAL_INPUT:
        return []
    places = [channel.physical for channel in task.channels]
    return ["ao", *places] if task.kind is ChannelType.ANALOG_OUTPUT and task.clock is not None else places


def _follows_inputs(task: CardTask) -> bool:
    return task.clock is not None and task.clock.source == pci6229.AI_SAMPLE_CLOCK


def _default_buffer(rate_hz: float, samples: int) -> int:
    """Return the driver's buffer of a continuous task (NI-DAQmx Help, "How Is Buffer Size Determined?")."""
    return max((1_000, 10_000, 100_000, 1_000_000)[bisect_left((100.0, 10_000.0, 1_000_000.0), rate_hz)], samples)
