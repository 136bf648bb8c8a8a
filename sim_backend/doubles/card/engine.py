"""The task engine of the card's double: tasks, their resources and when they run, guarded by one lock."""

import threading
from collections.abc import Callable, Iterable

import numpy as np

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.doubles.card import pci6229
from dragrig.sim_backend.doubles.card.daqmx import CardError, ChannelKind, StatusCode
from dragrig.sim_backend.doubles.card.streams import Bench, EncoderCounter, InputBuffer, LatchClock, count_now
from dragrig.sim_backend.doubles.card.tasks import AnalogSource, CardTask, encoder_decoding
from dragrig.sim_backend.doubles.fault_injection import ActiveFaults

OutputListener = Callable[[str, FloatArray, float, float], None]
"""Told an output's name, its voltages to come, their rate, and the clock's reading at which the first is put out.

At rate 0 there is one voltage, which the output holds from then on.
"""

AI_START_TRIGGER = "ai/StartTrigger"


def ignore_output(output: str, volts: FloatArray, rate_hz: float, at_s: float) -> None:
    """Listen to nothing."""
    del output, volts, rate_hz, at_s


def arm_start_trigger(task: CardTask, device: str, source: str) -> None:
    """Let an edge of a terminal start a task; raises `CardError` for one that the double cannot do."""
    place = pci6229.terminal(source, device)
    if task.kind is not ChannelKind.ANALOG_OUTPUT or place != AI_START_TRIGGER:
        raise CardError(
            StatusCode.ATTRIBUTE_NOT_SUPPORTED,
            f"Only outputs can be triggered here, by {AI_START_TRIGGER}, not by {place}.",
        )
    task.trigger = place


def start_waveform(task: CardTask, now_s: float, hear: OutputListener) -> None:
    """Begin a task's waveform, or let it wait for its trigger."""
    waveform = task.waveform
    if waveform is None:
        return
    waveform.refuse_empty()
    if not task.trigger:
        waveform.start(now_s)
        announce_voltages(task, waveform.kept(), 0, hear)


def trigger_waveforms(tasks: Iterable[CardTask], now_s: float, hear: OutputListener) -> None:
    """Begin the waveforms that wait for the inputs to start."""
    for task in tasks:
        waveform = task.waveform
        if task.running and task.trigger == AI_START_TRIGGER and waveform is not None and not waveform.has_begun:
            waveform.start(now_s)
            announce_voltages(task, waveform.kept(), 0, hear)


def announce_voltages(task: CardTask, volts: FloatArray, first: int, hear: OutputListener) -> None:
    """Tell of voltages, shape `(channels, n)`, whose first one is sample `first`; of none before the waveform began."""
    waveform = task.waveform
    if waveform is None or not waveform.has_begun or not volts.shape[1]:
        return
    for channel, row in zip(task.channels, volts, strict=True):
        hear(channel.physical, np.array(row), waveform.rate_hz, waveform.due_s(first))


def hold_last_voltage(task: CardTask, now_s: float, held_volts: dict[str, float], hear: OutputListener) -> None:
    """End a waveform: each output holds what it is at."""
    volts = task.waveform.volts(now_s) if task.waveform is not None else None
    if volts is None:
        return
    for channel, held in zip(task.channels, volts.tolist(), strict=True):
        held_volts[channel.physical] = held
        hear(channel.physical, np.array([held]), 0.0, now_s)


class TaskEngine:
    """Tasks on a bench. Whoever calls a method holds `changed`."""

    def __init__(self, bench: Bench, listener: OutputListener) -> None:
        self.bench = bench
        self.wiring = bench.rig.hardware.card
        self.changed = threading.Condition()
        self.tasks: dict[int, CardTask] = {}
        self.held_volts = dict.fromkeys(pci6229.AO, 0.0)
        self.hear = listener
        self._handles = 0
        self._holders: dict[str, CardTask] = {}
        self._lost = bench.faults.active.overwritten_samples
        bench.faults.subscribe(self._struck)

    @property
    def now_s(self) -> float:
        """The bench's clock."""
        return self.bench.clock.monotonic()

    def create(self, name: str) -> int:
        """Return the handle of a new task."""
        if any(task.name == name for task in self.tasks.values()):
            raise CardError(StatusCode.DUPLICATE_TASK, f"Specified task name is already in use.\n\nTask Name: {name}")
        self._handles += 1
        self.tasks[self._handles] = CardTask(self._handles, name or f"_unnamedTask<{self._handles - 1}>")
        return self._handles

    def task(self, handle: int, *kinds: ChannelKind) -> CardTask:
        """Return a task, whose channels must be of one of `kinds` if any is given."""
        task = self.tasks.get(handle)
        if task is None:
            raise CardError(StatusCode.INVALID_TASK, "Task specified is invalid or does not exist.")
        if kinds and task.kind is None:
            raise CardError(StatusCode.NO_CHANNELS, f"Task has no channels.\n\nTask Name: {task.name}")
        if kinds and task.kind not in kinds:
            raise CardError(
                StatusCode.CHANNEL_TYPE_MISMATCH, f"Task's channels cannot do this.\n\nTask Name: {task.name}"
            )
        return task

    def idle(self, handle: int) -> CardTask:
        """Return a task that may be configured."""
        task = self.task(handle)
        if task.running:
            raise CardError(
                StatusCode.TASK_RUNNING,
                f"Specified operation cannot be performed while the task is running.\n\nTask Name: {task.name}",
            )
        return task

    def touch(self, trouble: ActiveFaults | None = None) -> None:
        """Raise what keeps the card from answering."""
        trouble = trouble or self.bench.faults.active
        where = f"\n\nDevice: {self.wiring.device}"
        if trouble.card_gone:
            raise CardError(StatusCode.DEVICE_GONE, f"The specified device is not present or is not active.{where}")
        if trouble.card_unplugged:
            raise CardError(
                StatusCode.DEVICE_UNPLUGGED,
                "Device cannot be accessed. Possible causes: it is no longer present in the system, not powered, or "
                f"the computer woke up from sleep.{where}",
            )

    def find(self) -> None:
        """Raise when the driver knows no such device."""
        self.touch()
        if self.bench.faults.active.card_absent:
            raise CardError(
                StatusCode.INVALID_DEVICE, f"Device identifier is invalid.\n\nDevice Specified: {self.wiring.device}"
            )

    def verify(self, task: CardTask) -> None:
        """Raise what is wrong with a task's configuration."""
        self.find()
        if task.kind is None:
            raise CardError(StatusCode.NO_CHANNELS, f"Task has no channels.\n\nTask Name: {task.name}")
        if task.kind is ChannelKind.COUNTER_INPUT and task.timing is not None and not task.timing.source:
            raise CardError(
                StatusCode.NO_SAMPLE_CLOCK, f"The counter has no sample clock of its own.\n\nTask Name: {task.name}"
            )

    def reserve(self, task: CardTask) -> None:
        """Let a task have what it needs of the card; raises `CardError` when another has it."""
        self.verify(task)
        for resource in _required_resources(task):
            holder = self._holders.get(resource, task)
            if holder is not task or self.bench.faults.active.card_reserved:
                line = task.kind is ChannelKind.DIGITAL_OUTPUT
                raise CardError(
                    StatusCode.LINES_RESERVED if line else StatusCode.RESOURCE_RESERVED,
                    "The specified resource is reserved: the operation could not be completed as specified.\n\n"
                    f"Device: {self.wiring.device}\nResource: {resource}\nTask Name: {task.name}",
                )
        for resource in _required_resources(task):
            self._holders[resource] = task

    def release(self, task: CardTask) -> None:
        """Take back what a task holds."""
        self._holders = {resource: holder for resource, holder in self._holders.items() if holder is not task}

    def start(self, task: CardTask) -> None:
        """Start a task."""
        self.idle(task.handle)
        self.reserve(task)
        match task.kind:
            case ChannelKind.ANALOG_INPUT if task.timing is not None:
                self._start_inputs(task, task.timing.rate_hz)
            case ChannelKind.COUNTER_INPUT:
                self._start_counter(task)
            case ChannelKind.ANALOG_OUTPUT:
                start_waveform(task, self.now_s, self.hear)
            case _:
                pass
        task.running = True
        self.changed.notify_all()

    def stop(self, task: CardTask) -> None:
        """Stop a task; one that was not told to reserve what it needs gives it back."""
        if task.running:
            match task.kind:
                case ChannelKind.ANALOG_INPUT if task.stream is not None:
                    self._stop_inputs()
                case ChannelKind.ANALOG_OUTPUT:
                    hold_last_voltage(task, self.now_s, self.held_volts, self.hear)
                case _:
                    pass
        task.running, task.stream, task.counter, task.waveform = False, None, None, None
        if not task.reserved:
            self.release(task)
        self.changed.notify_all()

    def forget(self, task: CardTask) -> None:
        """Stop a task and forget it."""
        task.reserved = False
        self.stop(task)
        del self.tasks[task.handle]

    def done(self, task: CardTask) -> bool:
        """Return whether a task does not run or has taken or generated all its samples."""
        if not task.running:
            return True
        if task.stream is not None:
            return task.stream.done
        return task.waveform is not None and task.waveform.done(self.now_s)

    def still_runs(self, task: CardTask) -> Callable[[], None]:
        """Return a check that raises once the card is gone or the task was stopped."""

        def check() -> None:
            self.touch()
            if not task.running:
                raise CardError(
                    StatusCode.ABORTED,
                    f"The operation was stopped before it could be completed.\n\nTask Name: {task.name}",
                )

        return check

    def _start_inputs(self, task: CardTask, rate_hz: float) -> None:
        task.origin = count_now(self.bench)
        self.bench.begin_sampling(rate_hz)
        trigger_waveforms(self.tasks.values(), self.bench.began_s, self.hear)
        task.stream = self._stream(task, AnalogSource(self.bench, task.channels, rate_hz))
        for other in self._clocked_counters():
            other.clocked(LatchClock(rate_hz, task.origin, 0, task.stream.limit))

    def _start_counter(self, task: CardTask) -> None:
        task.counter = EncoderCounter(self.bench, encoder_decoding(task.channels[0], self.wiring))
        if task.timing is None:
            return
        task.stream = self._stream(task, task.counter)
        inputs = self._holders.get("ai")
        if task.timing.source == pci6229.AI_SAMPLE_CLOCK and inputs is not None and inputs.stream is not None:
            source = inputs.stream.source
            clock = LatchClock(source.rate_hz, inputs.origin, source.total(), inputs.stream.limit)
            task.counter.clocked(clock)

    def _stop_inputs(self) -> None:
        for task in self.tasks.values():
            if task.counter is not None and task.stream is not None and task.counter.rate_hz > 0:
                task.stream.forget_before(task.counter.unclocked(max(task.stream.oldest(), task.stream.position)))
        self.bench.end_sampling()

    def _clocked_counters(self) -> list[EncoderCounter]:
        return [
            task.counter
            for task in self.tasks.values()
            if task.counter is not None and task.timing is not None and task.timing.source == pci6229.AI_SAMPLE_CLOCK
        ]

    def _stream(self, task: CardTask, source: AnalogSource | EncoderCounter) -> InputBuffer:
        limit = None if task.timing is None else task.timing.limit
        pace = self.bench.clock.pace
        stream = InputBuffer(source, task.buffer_size, limit, pace, self.changed, self.still_runs(task))
        stream.stall(self.bench.faults.active.card_stalled)
        return stream

    def _struck(self) -> None:
        with self.changed:
            trouble = self.bench.faults.active
            lost, self._lost = trouble.overwritten_samples - self._lost, trouble.overwritten_samples
            for task in self.tasks.values():
                if task.stream is not None:
                    task.stream.stall(trouble.card_stalled)
                    if lost > 0:
                        task.stream.lose(lost)
            self.changed.notify_all()


def _required_resources(task: CardTask) -> tuple[str, ...]:
    match task.kind:
        case ChannelKind.ANALOG_INPUT:
            return ("ai",)
        case ChannelKind.DIGITAL_OUTPUT:
            return tuple(line for channel in task.channels for line in channel.lines)
        case ChannelKind.DIGITAL_INPUT:
            return ()
        case _:
            places = tuple(channel.physical for channel in task.channels)
            return ("ao", *places) if task.timing is not None and places[0].startswith("ao") else places
