"""The PCI-6229's double: what NI's driver does with it, call for call, on a `Bench`.

The C library and the gRPC server are thin interfaces to it. Handles are positive integers. Every method raises
`CardError`, which carries the driver's status code; any thread may call any method.
"""

import math
import time
from collections.abc import Callable

from nidaqmx.utils import flatten_channel_string, unflatten_channel_string

from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.sim_backend.doubles.card import engine as generating
from dragrig.sim_backend.doubles.card import pci6229
from dragrig.sim_backend.doubles.card import tasks as channels
from dragrig.sim_backend.doubles.card.daqmx import (
    BufferAttribute,
    CardError,
    ChannelAttribute,
    ChannelKind,
    DeviceAttribute,
    ReadAttribute,
    ReadRelativeTo,
    Regeneration,
    StatusCode,
    SystemAttribute,
    TaskAction,
    TaskAttribute,
    TimingAttribute,
    WriteAttribute,
)
from dragrig.sim_backend.doubles.card.engine import OutputListener, TaskEngine, ignore_output
from dragrig.sim_backend.doubles.card.streams import Bench
from dragrig.sim_backend.doubles.card.tasks import (
    AttributeValue,
    CardTask,
    VirtualChannel,
    checked_sample_clock,
    set_property,
)
from dragrig.sim_backend.doubles.card.transfers import ReadCalls, WriteCalls

_M_SERIES_CATEGORY, _PCI_BUS = 14643, 12582


def driver_attributes(engine: TaskEngine) -> dict[int, AttributeValue]:
    """Return the driver's version and what it knows."""
    trouble = engine.bench.faults.active
    missing = trouble.card_absent or trouble.card_gone or trouble.card_unplugged
    return {
        **dict(
            zip(
                (SystemAttribute.MAJOR, SystemAttribute.MINOR, SystemAttribute.UPDATE),
                pci6229.DRIVER_VERSION,
                strict=True,
            )
        ),
        SystemAttribute.DEVICES: "" if missing else engine.wiring.device,
        SystemAttribute.TASKS: "",
        SystemAttribute.CHANNELS: "",
        SystemAttribute.SCALES: "",
    }


def device_attributes(engine: TaskEngine, name: str) -> dict[int, AttributeValue]:
    """Return what the card is and has; raises `CardError` when the driver knows no device of that name."""
    device = engine.wiring.device
    if name.lower() != device.lower():
        raise CardError(StatusCode.INVALID_DEVICE, f"Device identifier is invalid.\n\nDevice Specified: {name}")
    engine.find()

    def listed(names: tuple[str, ...]) -> str:
        return ", ".join(f"{device}/{one}" for one in names)

    lines, ports = listed(pci6229.LINES), listed(tuple(pci6229.PORTS))
    return {
        DeviceAttribute.PRODUCT: pci6229.PRODUCT,
        DeviceAttribute.SERIAL: pci6229.SERIAL_NUMBER,
        DeviceAttribute.PRODUCT_NUMBER: pci6229.PRODUCT_NUMBER,
        DeviceAttribute.SIMULATED: False,
        DeviceAttribute.CATEGORY: _M_SERIES_CATEGORY,
        DeviceAttribute.BUS: _PCI_BUS,
        DeviceAttribute.TERMINALS: ", ".join(f"/{device}/{one}" for one in pci6229.TERMINALS),
        DeviceAttribute.AI: listed(pci6229.AI),
        DeviceAttribute.AO: listed(pci6229.AO),
        DeviceAttribute.CI: listed(pci6229.COUNTERS),
        DeviceAttribute.CO: listed(pci6229.COUNTERS),
        DeviceAttribute.DI_LINES: lines,
        DeviceAttribute.DO_LINES: lines,
        DeviceAttribute.DI_PORTS: ports,
        DeviceAttribute.DO_PORTS: ports,
        DeviceAttribute.AI_MAX_SINGLE_RATE: pci6229.AI_MAX_RATE_HZ,
        DeviceAttribute.AI_MAX_RATE: pci6229.AI_MAX_RATE_HZ,
        DeviceAttribute.AI_RANGES: [signed for one in pci6229.AI_RANGES_V for signed in (-one, one)],
        DeviceAttribute.AO_RANGES: [-pci6229.AO_RANGE_V, pci6229.AO_RANGE_V],
    }


_ON_DEMAND, _SAMPLE_CLOCK = 10390, 10388
_OVERWRITE_UNREAD, _KEEP_UNREAD = 10252, 10159
_AI_FIFO = 4095


class AttributeStore:
    """Attributes of one card's tasks, channels and driver. Whoever calls a method holds the engine's lock."""

    def __init__(self, engine: TaskEngine) -> None:
        self._engine = engine

    def get(self, group: str, subject: int | str, attribute: int, channel: str) -> AttributeValue:
        """Return an attribute; see `Card.get_attribute`."""
        match group:
            case "system":
                return _look_up(driver_attributes(self._engine), attribute)
            case "device":
                return _look_up(device_attributes(self._engine, str(subject)), attribute)
            case "chan":
                return self._of_channel(self._engine.task(int(subject)), channel, attribute)
            case _:
                return _look_up(self._of(group, attribute)(self._engine.task(int(subject))), attribute)

    def set(self, group: str, handle: int, attribute: int, value: AttributeValue, channel: str) -> None:
        """Set an attribute; see `Card.set_attribute`."""
        if group == "read":
            self._set_reading(self._engine.task(handle), attribute, value)
            return
        task = self._engine.idle(handle)
        match group, attribute:
            case "chan", _:
                for one in _named_channels(task, channel):
                    set_property(one, self._engine.wiring.device, attribute, value)
            case "buffer", BufferAttribute.INPUT:
                task.input_buffer = _integer(value)
            case "buffer", BufferAttribute.OUTPUT:
                task.output_buffer = _integer(value)
            case "write", WriteAttribute.REGENERATION if value in list(Regeneration):
                task.regeneration = _integer(value)
            case _:
                raise _unsupported_attribute(attribute)

    def reset(self, group: str, handle: int, attribute: int) -> None:
        """Put an attribute back; see `Card.reset_attribute`."""
        defaults: dict[tuple[str, int], AttributeValue] = {
            ("read", ReadAttribute.RELATIVE_TO): int(ReadRelativeTo.CURRENT_READ_POSITION),
            ("read", ReadAttribute.OFFSET): 0,
            ("read", ReadAttribute.OVERWRITE): _KEEP_UNREAD,
            ("read", ReadAttribute.AUTO_START): True,
            ("buffer", BufferAttribute.INPUT): 0,
            ("buffer", BufferAttribute.OUTPUT): 0,
            ("write", WriteAttribute.REGENERATION): int(Regeneration.ALLOWED),
        }
        if (group, attribute) not in defaults:
            raise _unsupported_attribute(attribute)
        self.set(group, handle, attribute, defaults[group, attribute], "")

    def _set_reading(self, task: CardTask, attribute: int, value: AttributeValue) -> None:
        match attribute:
            case ReadAttribute.RELATIVE_TO if value in list(ReadRelativeTo):
                task.position.relative_to = _integer(value)
            case ReadAttribute.OFFSET:
                task.position.offset = _integer(value)
            case ReadAttribute.OVERWRITE if value in {_OVERWRITE_UNREAD, _KEEP_UNREAD}:
                task.position.overwrite = value == _OVERWRITE_UNREAD
            case ReadAttribute.AUTO_START:
                task.auto_start = bool(value)
            case _:
                raise _unsupported_attribute(attribute)

    def _of(self, group: str, attribute: int) -> Callable[[CardTask], dict[int, AttributeValue]]:
        groups = {
            "task": self._of_task,
            "read": self._of_reading,
            "write": self._of_writing,
            "buffer": self._of_buffers,
            "timing": self._of_timing,
        }
        if group not in groups:
            raise _unsupported_attribute(attribute)
        return groups[group]

    def _of_task(self, task: CardTask) -> dict[int, AttributeValue]:
        return {
            TaskAttribute.NAME: task.name,
            TaskAttribute.CHANNELS: _channel_names(task),
            TaskAttribute.NUM_CHANNELS: len(task.channels),
            TaskAttribute.DEVICES: self._engine.wiring.device if task.channels else "",
            TaskAttribute.NUM_DEVICES: int(bool(task.channels)),
            TaskAttribute.COMPLETE: self._engine.done(task),
        }

    def _of_channel(self, task: CardTask, channel: str, attribute: int) -> AttributeValue:
        chosen = _named_channels(task, channel)[0]
        if attribute == ChannelAttribute.CI_COUNT:
            return int(task.counter.count()) if task.counter is not None else 0
        return _look_up(chosen.properties, attribute)

    def _of_reading(self, task: CardTask) -> dict[int, AttributeValue]:
        stream = task.stream
        total = stream.total() if stream is not None else 0
        available = max(total - stream.begins(task.position), 0) if stream is not None else 0
        everything = available if stream is None or stream.limit is None else stream.limit - stream.position
        return {
            ReadAttribute.RELATIVE_TO: task.position.relative_to,
            ReadAttribute.OFFSET: task.position.offset,
            ReadAttribute.OVERWRITE: _OVERWRITE_UNREAD if task.position.overwrite else _KEEP_UNREAD,
            ReadAttribute.AVAILABLE: available,
            ReadAttribute.TOTAL: total,
            ReadAttribute.POSITION: stream.position if stream is not None else 0,
            ReadAttribute.AUTO_START: task.auto_start,
            ReadAttribute.ALL_AVAILABLE: False,
            ReadAttribute.CHANNELS: _channel_names(task),
            ReadAttribute.NUM_CHANNELS: len(task.channels),
            ReadAttribute.LINES_PER_CHANNEL: _lines_per_channel(task),
            ReadAttribute.DEFAULT_SAMPLES: everything if task.timing is not None else 1,
        }

    def _of_writing(self, task: CardTask) -> dict[int, AttributeValue]:
        waveform, now_s = task.waveform, self._engine.now_s
        return {
            WriteAttribute.REGENERATION: task.regeneration,
            WriteAttribute.SPACE: waveform.space(now_s) if waveform is not None else task.output_buffer or 0,
            WriteAttribute.TOTAL: waveform.generated(now_s) if waveform is not None else 0,
            WriteAttribute.POSITION: waveform.written if waveform is not None else 0,
            WriteAttribute.NUM_CHANNELS: len(task.channels),
            WriteAttribute.LINES_PER_CHANNEL: _lines_per_channel(task),
        }

    def _of_buffers(self, task: CardTask) -> dict[int, AttributeValue]:
        output = task.waveform.size if task.waveform is not None else task.output_buffer or 0
        return {
            BufferAttribute.INPUT: task.buffer_size,
            BufferAttribute.INPUT_ONBOARD: _AI_FIFO,
            BufferAttribute.OUTPUT: output,
        }

    def _of_timing(self, task: CardTask) -> dict[int, AttributeValue]:
        timing = task.timing
        if timing is None:
            return {TimingAttribute.TYPE: _ON_DEMAND}
        return {
            TimingAttribute.RATE: timing.rate_hz,
            TimingAttribute.MAX_RATE: pci6229.AI_MAX_RATE_HZ / max(len(task.channels), 1),
            TimingAttribute.SOURCE: f"/{self._engine.wiring.device}/{timing.source or '20MHzTimebase'}",
            TimingAttribute.TYPE: _SAMPLE_CLOCK,
            TimingAttribute.QUANTITY: int(timing.quantity),
            TimingAttribute.SAMPLES: timing.samples,
        }


def _look_up(answers: dict[int, AttributeValue], attribute: int) -> AttributeValue:
    if attribute not in answers:
        raise _unsupported_attribute(attribute)
    return answers[attribute]


def _channel_names(task: CardTask) -> str:
    return str(flatten_channel_string([channel.name for channel in task.channels]))


def _lines_per_channel(task: CardTask) -> int:
    return max((len(channel.lines) for channel in task.channels), default=0)


def _named_channels(task: CardTask, names: str) -> list[VirtualChannel]:
    wanted = {name.strip().lower() for name in unflatten_channel_string(names)}
    chosen = [channel for channel in task.channels if not wanted or channel.name.lower() in wanted]
    if not chosen:
        raise CardError(
            StatusCode.INVALID_CHANNEL,
            f"Channel specified does not exist in the task.\n\nChannel Name: {names}\nTask Name: {task.name}",
        )
    return chosen


def _integer(value: AttributeValue) -> int:
    if isinstance(value, str | list):
        raise CardError(StatusCode.INVALID_ATTRIBUTE_VALUE, f"{value!r} is no number.")
    return int(value)


def _unsupported_attribute(attribute: int) -> CardError:
    return CardError(
        StatusCode.ATTRIBUTE_NOT_SUPPORTED,
        f"Specified property is not supported by the device or is not applicable to the task.\n\n"
        f"Property: {attribute:#x}",
    )


_DONE_POLL_S = 0.02


class Card:
    """One card in a computer with NI's driver.

    Parameters
    ----------
    bench
        What the card is wired to.
    listener
        Told what analog outputs do; see `generating.Listener`.
    """

    def __init__(self, bench: Bench, listener: OutputListener = ignore_output) -> None:
        self._engine = TaskEngine(bench, listener)
        self._device = self._engine.wiring.device
        self._reading = ReadCalls(self._engine)
        self._writing = WriteCalls(self._engine)
        self._answers = AttributeStore(self._engine)

    def create_task(self, name: str) -> int:
        """Return the handle of a new task; an empty name lets the driver choose one."""
        with self._engine.changed:
            return self._engine.create(name)

    def clear_task(self, task: int) -> None:
        """Stop a task, release what it holds and forget it."""
        with self._engine.changed:
            self._engine.forget(self._engine.task(task))

    def start(self, task: int) -> None:
        """Start a task."""
        with self._engine.changed:
            self._engine.start(self._engine.task(task))

    def stop(self, task: int) -> None:
        """Stop a task, release what it holds, keep its configuration."""
        with self._engine.changed:
            self._engine.stop(self._engine.task(task))
            self._engine.touch()

    def control(self, task: int, action: int) -> None:
        """Start, stop, verify, commit, reserve, unreserve or abort a task; see `daqmx.Action`."""
        with self._engine.changed:
            told = self._engine.task(task)
            match action:
                case TaskAction.START:
                    self._engine.start(told)
                case TaskAction.STOP | TaskAction.ABORT:
                    self._engine.stop(told)
                case TaskAction.RESERVE | TaskAction.COMMIT:
                    self._engine.reserve(told)
                    told.reserved = True
                case TaskAction.UNRESERVE:
                    told.reserved = False
                    self._engine.stop(told)
                case TaskAction.VERIFY:
                    self._engine.verify(told)
                case _:
                    raise CardError(StatusCode.INVALID_ATTRIBUTE_VALUE, f"There is no action {action}.")

    def is_task_done(self, task: int) -> bool:
        """Return whether a task is not running or has taken all its samples."""
        with self._engine.changed:
            return self._engine.done(self._engine.task(task))

    def wait_until_done(self, task: int, timeout_s: float) -> None:
        """Wait until a task is done; a negative timeout waits for ever."""
        with self._engine.changed:
            deadline_s = math.inf if timeout_s < 0 else time.perf_counter() + timeout_s
            told = self._engine.task(task)
            while not self._engine.done(told):
                self._engine.touch()
                if time.perf_counter() >= deadline_s:
                    raise CardError(StatusCode.NOT_DONE, f"Task is not done.\n\nTask Name: {told.name}")
                self._engine.changed.wait(_DONE_POLL_S)

    def create_ai_voltage_chan(
        self, task: int, physical: str, name: str, terminals: int, min_V: float, max_V: float, units: int, scale: str
    ) -> None:
        """Add analog inputs."""
        del scale
        self._add(task, channels.analog_inputs(self._device, physical, name, terminals, min_V, max_V, units))

    def create_ao_voltage_chan(
        self, task: int, physical: str, name: str, min_V: float, max_V: float, units: int, scale: str
    ) -> None:
        """Add analog outputs."""
        del scale
        self._add(task, channels.analog_outputs(self._device, physical, name, min_V, max_V, units))

    def create_ci_lin_encoder_chan(
        self,
        task: int,
        counter: str,
        name: str,
        decoding: int,
        z_enable: bool,
        z_value: float,
        z_phase: int,
        units: int,
        distance_per_pulse: float,
        initial_position: float,
        scale: str,
    ) -> None:
        """Add a counter that follows a linear encoder."""
        del scale
        properties: dict[int, AttributeValue] = {
            ChannelAttribute.CI_DECODING: decoding,
            ChannelAttribute.CI_Z_ENABLE: z_enable,
            ChannelAttribute.CI_Z_VALUE: z_value,
            ChannelAttribute.CI_Z_PHASE: z_phase,
            ChannelAttribute.CI_UNITS: units,
            ChannelAttribute.CI_DISTANCE_PER_PULSE: distance_per_pulse,
            ChannelAttribute.CI_INITIAL_POSITION: initial_position,
        }
        self._add(task, channels.encoder_counter(self._device, counter, name, properties))

    def create_di_chan(self, task: int, lines: str, name: str, grouping: int) -> None:
        """Add digital inputs."""
        self._add(task, channels.digital_lines(self._device, lines, name, grouping, ChannelKind.DIGITAL_INPUT))

    def create_do_chan(self, task: int, lines: str, name: str, grouping: int) -> None:
        """Add digital outputs."""
        self._add(task, channels.digital_lines(self._device, lines, name, grouping, ChannelKind.DIGITAL_OUTPUT))

    def cfg_samp_clk_timing(
        self, task: int, source: str, rate_hz: float, edge: int, quantity: int, samples: int
    ) -> None:
        """Give a task a sample clock; see `daqmx.Quantity`."""
        del edge
        with self._engine.changed:
            told = self._engine.idle(task)
            told.timing = checked_sample_clock(told, self._device, source, rate_hz, quantity, samples)

    def cfg_dig_edge_start_trig(self, task: int, source: str, _edge: int) -> None:
        """Let an edge of a terminal start a task."""
        with self._engine.changed:
            generating.arm_start_trigger(self._engine.idle(task), self._device, source)

    def read_analog_f64(self, task: int, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        """Read volts into `out`, C-contiguous of any shape; return the samples per channel.

        `samples` −1 reads what is there (a finite task: all), a negative timeout waits for ever. On an error the
        samples read so far are in `out`, and their number in `CardError.samples`.
        """
        return self._reading.analog(task, samples, timeout_s, fill, out)

    def read_counter_f64(self, task: int, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        """Read positions into `out`, otherwise as `read_analog_f64`."""
        return self._reading.counter(task, samples, timeout_s, fill, out)

    def read_analog_scalar_f64(self, task: int, timeout_s: float) -> float:
        """Read one sample of a task with one channel."""
        return self._reading.scalar(self._reading.analog, task, timeout_s)

    def read_counter_scalar_f64(self, task: int, timeout_s: float) -> float:
        """Read one position."""
        return self._reading.scalar(self._reading.counter, task, timeout_s)

    def read_digital_lines(self, task: int, samples: int, fill: int, out: BoolArray) -> tuple[int, int]:
        """Read levels, one element a line; return samples per channel and lines per channel."""
        return self._reading.lines(task, samples, fill, out)

    def read_digital_u32(self, task: int, samples: int, fill: int) -> list[int]:
        """Return one word per channel, line 0 in bit 0."""
        return self._reading.words(task, samples, fill)

    def write_digital_lines(self, task: int, samples: int, auto_start: bool, layout: int, data: BoolArray) -> int:
        """Set levels, one element a line; return the samples written per channel."""
        return self._writing.lines(task, samples, auto_start, layout, data)

    def write_digital_u32(self, task: int, samples: int, auto_start: bool, layout: int, data: list[int]) -> int:
        """Set levels, one word per channel; return the samples written per channel."""
        return self._writing.words(task, samples, auto_start, layout, data)

    def write_analog_f64(
        self, task: int, samples: int, auto_start: bool, timeout_s: float, layout: int, data: FloatArray
    ) -> int:
        """Set voltages, or add to a waveform; return the samples written per channel."""
        return self._writing.analog(task, samples, auto_start, timeout_s, layout, data)

    def get_attribute(self, group: str, subject: int | str, attribute: int, channel: str = "") -> AttributeValue:
        """Return an attribute.

        Parameters
        ----------
        group
            Which of DAQmx's `Get…Attribute` asks: task, chan, read, write, buffer, timing, device or system.
        subject
            A task's handle; the name of a device or physical channel; anything for the system.
        channel
            Virtual channels, for `chan`.
        """
        with self._engine.changed:
            return self._answers.get(group, subject, attribute, channel)

    def set_attribute(self, group: str, task: int, attribute: int, value: AttributeValue, channel: str = "") -> None:
        """Set an attribute of a task or its channels."""
        with self._engine.changed:
            self._answers.set(group, task, attribute, value, channel)

    def reset_attribute(self, group: str, task: int, attribute: int, channel: str = "") -> None:
        """Put an attribute back to what the driver has for it."""
        del channel
        with self._engine.changed:
            self._answers.reset(group, task, attribute)

    def reset_device(self, device: str) -> None:
        """Abort the device's tasks and put it into its initial state."""
        with self._engine.changed:
            self._answers.get("device", device, DeviceAttribute.PRODUCT, "")
            for task in self._engine.tasks.values():
                task.reserved = False
                self._engine.stop(task)

    def voltage(self, output: str) -> float:
        """Return what an analog output, such as ao0, is at now; it holds its last voltage when its task ends."""
        return self._writing.voltage(output)

    def _add(self, task: int, added: list[VirtualChannel]) -> None:
        with self._engine.changed:
            self._engine.find()
            self._engine.idle(task).add(added)
