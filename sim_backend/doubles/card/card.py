"""The PCI-6229's double: the behaviour of NI's driver with it, call for call, on a simulated bench.

It has the calls, options and attributes that this program uses. The C library (`c_library`) is a thin interface to it,
and so is a gRPC server in the tests. Handles are positive integers. Every method raises `CardError`, which carries the
driver's status code.
"""

import math
import time
from functools import partialmethod

import numpy as np
from nidaqmx.constants import (
    ChannelType,
    EncoderZIndexPhase,
    FillMode,
    OverwriteMode,
    ReadRelativeTo,
    RegenerationMode,
    TaskMode,
)
from nidaqmx.error_codes import DAQmxErrors as Status
from nidaqmx.utils import flatten_channel_string, unflatten_channel_string

from dragrig.rig import BoolArray, FloatArray
from dragrig.sim_backend.doubles.card import pci6229
from dragrig.sim_backend.doubles.card.pci6229 import (
    Attribute,
    AttributeValue,
    CardError,
    EncoderChannel,
    VirtualChannel,
)
from dragrig.sim_backend.doubles.card.tasks import CardTask, OutputWaveform, TaskEngine

_PULSES_PER_PERIOD = 4
_MIN_WAIT_S = 1e-3
_REQUIRED_VALUES: dict[int, AttributeValue] = {
    Attribute.READ_OVERWRITE: OverwriteMode.OVERWRITE_UNREAD_SAMPLES.value,
    Attribute.WRITE_REGENERATION: RegenerationMode.DONT_ALLOW_REGENERATION.value,
}
"""Attributes of which the double supports one value."""


class Card(TaskEngine):
    """One card in a computer with NI's driver."""

    def control(self, task: int, action: int) -> None:
        """Reserve or commit a task; see `nidaqmx.constants.TaskMode`."""
        with self.changed:
            if action not in {TaskMode.TASK_RESERVE.value, TaskMode.TASK_COMMIT.value}:
                raise CardError(Status.INVALID_ATTRIBUTE_VALUE, f"The double has no task action {action}.")
            reserved = self.task(task)
            self.reserve(reserved)
            reserved.reserved = True

    def create_ai_voltage_chan(
        self, task: int, physical: str, name: str, terminals: int, min_V: float, max_V: float
    ) -> None:
        """Add analog inputs."""
        with self.changed:
            kind = ChannelType.ANALOG_INPUT
            channels = pci6229.analog_channels(self.card.device, kind, physical, name, terminals, min_V, max_V)
            self.add(task, channels)

    def create_ao_voltage_chan(self, task: int, physical: str, name: str, min_V: float, max_V: float) -> None:
        """Add analog outputs."""
        with self.changed:
            kind = ChannelType.ANALOG_OUTPUT
            self.add(task, pci6229.analog_channels(self.card.device, kind, physical, name, 0, min_V, max_V))

    def create_ci_lin_encoder_chan(
        self,
        task: int,
        counter: str,
        name: str,
        z_enable: bool,
        z_value_m: float,
        z_phase: int,
        distance_per_pulse_m: float,
        initial_position_m: float,
    ) -> None:
        """Add a counter that follows a linear encoder, with X4 decoding and in metres."""
        with self.changed:
            added = self.add(task, [pci6229.encoder_counter(self.card.device, counter, name)])
            count_m = distance_per_pulse_m / _PULSES_PER_PERIOD
            added.encoder = EncoderChannel(
                count_m, initial_position_m, bool(z_enable), z_value_m, EncoderZIndexPhase(z_phase)
            )

    def _add_lines(self, kind: ChannelType, task: int, lines: str, name: str, grouping: int) -> None:
        with self.changed:
            self.add(task, pci6229.digital_lines(self.card.device, kind, lines, name, grouping))

    create_di_chan = partialmethod(_add_lines, ChannelType.DIGITAL_INPUT)
    """Add digital inputs."""
    create_do_chan = partialmethod(_add_lines, ChannelType.DIGITAL_OUTPUT)
    """Add digital outputs."""

    def read_analog_f64(self, task: int, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        """Read volts into `out`, C-contiguous of any shape; return the samples per channel.

        A negative timeout waits for ever. On an error the samples read so far are in `out`, and their number in
        `CardError.samples`.
        """
        with self.changed:
            return self._read_buffer(self.task(task, ChannelType.ANALOG_INPUT), samples, timeout_s, fill, out)

    def read_counter_f64(self, task: int, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        """Read latched positions [m] into `out` as `read_analog_f64`, or the present one of a task without a clock."""
        with self.changed:
            counting = self.task(task, ChannelType.COUNTER_INPUT)
            if counting.clock is not None:
                return self._read_buffer(counting, samples, timeout_s, fill, out)
            self.check_card()
            if counting.counter is None:
                raise _not_started(counting)
            out.reshape(-1)[0] = counting.counter.position_m()
            return 1

    def read_digital_lines(self, task: int, samples: int, out: BoolArray) -> int:
        """Read levels, one element a line; return the samples per channel."""
        with self.changed:
            self.check_card()
            channels = self.task(task).channels
            levels = [self.bench.read_line(channel.physical) for channel in channels]
            wanted = max(samples, 1)
            if wanted * len(levels) > out.size:
                raise _array_too_small(out.size)
            out.reshape(-1)[: wanted * len(levels)] = np.repeat(levels, wanted)
            return wanted

    def write_digital_lines(self, task: int, samples: int, auto_start: bool, data: BoolArray) -> int:
        """Set levels, one element a line; return the samples written per channel."""
        with self.changed:
            written = self._started_for_write(task, ChannelType.DIGITAL_OUTPUT, auto_start)
            levels = np.asarray(data).reshape(len(written.channels), samples)[:, -1]
            for channel, high in zip(written.channels, levels.tolist(), strict=True):
                self.bench.write_line(channel.physical, bool(high))
            return samples

    def write_analog_f64(self, task: int, auto_start: bool, timeout_s: float, data: FloatArray) -> int:
        """Set the voltage of an output, or append to its waveform; return the samples written."""
        with self.changed:
            output = self.task(task, ChannelType.ANALOG_OUTPUT)
            channel, volts = output.channels[0], data.reshape(-1)
            if not np.all(np.abs(volts) <= channel.range_V):
                raise output.failure(
                    Status.INVALID_AO_DATA_WRITE,
                    "One or more values passed to the Write function are outside the range or not a number.\n\n"
                    f"Channel Name: {channel.name}\nMaximum Value: {channel.range_V:g}",
                )
            if output.clock is None:
                self._started_for_write(task, ChannelType.ANALOG_OUTPUT, auto_start)
                self.hold_voltage(channel, float(volts[-1]))
                return len(volts)
            self.check_card()
            if output.waveform is None:
                output.waveform = OutputWaveform(output.output_buffer or max(len(volts), 1), output.clock.rate_hz)
            self._append(output, output.waveform, volts, timeout_s)
            if auto_start and not output.running:
                self.start(output.handle)
            return len(volts)

    def get_attribute(self, subject: int | str, attribute: int, channel: str = "") -> AttributeValue:
        """Return an attribute.

        Parameters
        ----------
        subject
            A task's handle, the name of a device, or empty for the driver itself.
        channel
            A virtual channel of the task; default: the first.
        """
        with self.changed:
            if isinstance(subject, int):
                attributes = self._task_attributes(self.task(subject), channel)
            else:
                attributes = self._device_attributes(subject)
            if attribute not in attributes:
                raise _unsupported_attribute(attribute)
            return attributes[attribute]

    def set_attribute(self, task: int, attribute: int, value: AttributeValue, channel: str = "") -> None:
        """Set an attribute of a task or its channels."""
        with self.changed:
            changed = self.task(task)
            number = int(value) if isinstance(value, int | float) else 0
            match attribute:
                case Attribute.READ_RELATIVE_TO:
                    changed.relative_to = number
                case Attribute.READ_OFFSET:
                    changed.offset = number
                case Attribute.INPUT_BUFFER:
                    self.idle_task(task).input_buffer = number
                case Attribute.OUTPUT_BUFFER:
                    self.idle_task(task).output_buffer = number
                case _ if attribute in _REQUIRED_VALUES:
                    if value != _REQUIRED_VALUES[attribute]:
                        raise changed.failure(Status.INVALID_ATTRIBUTE_VALUE, f"The double does not support {value}.")
                case _ if changed.kind is ChannelType.COUNTER_INPUT:
                    self.idle_task(task)
                    for counter in _named_channels(changed, channel):
                        pci6229.set_property(counter, self.card.device, attribute, value)
                case _:
                    raise _unsupported_attribute(attribute)

    def _read_buffer(self, task: CardTask, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        self.check_card()
        buffer, channels = task.buffer, len(task.channels)
        if buffer is None:
            raise _not_started(task)
        if samples * channels > out.size:
            raise _array_too_small(out.size)
        origin = 0 if task.relative_to == ReadRelativeTo.FIRST_SAMPLE.value else buffer.position
        first = origin + task.offset
        end, failure = buffer.read(first, samples, timeout_s, self.bench.faults.active.short_reads)
        if end > first:
            # Fewer samples than requested lie together at the array's beginning, not at the places of a full read.
            rows = np.array(buffer.source.fetch(first, end))
            flat = rows.reshape(-1) if fill == FillMode.GROUP_BY_CHANNEL.value else rows.T.reshape(-1)
            out.reshape(-1)[: flat.size] = flat
        if failure is not None:
            raise failure
        return end - first

    def _started_for_write(self, handle: int, kind: ChannelType, auto_start: bool) -> CardTask:
        task = self.task(handle, kind)
        self.check_card()
        if not task.running:
            if not auto_start:
                raise task.failure(
                    Status.CANNOT_WRITE_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING_OR_COMMITTED,
                    "Write cannot be performed when the auto start input is false and the task is not running.",
                )
            self.start(handle)
            self.end(task)
        return task

    def _append(self, task: CardTask, waveform: OutputWaveform, volts: FloatArray, timeout_s: float) -> None:
        deadline_s = math.inf if timeout_s < 0 else time.perf_counter() + timeout_s
        written = 0
        while True:
            now_s = self.now_s
            if waveform.ran_empty(now_s):
                self.end(task)
                raise task.failure(
                    Status.GEN_STOPPED_TO_PREVENT_REGEN_OF_OLD_SAMPLES,
                    "The generation has stopped to prevent the regeneration of old samples: new ones were not written "
                    "in time.",
                    written,
                )
            part = volts[written : written + waveform.space(now_s)]
            first = waveform.written
            waveform.write(part)
            self.announce(task, part, first)
            written += len(part)
            if written == len(volts):
                return
            left_s = deadline_s - time.perf_counter()
            if left_s <= 0 or not task.running:
                raise task.failure(
                    Status.SAMPLES_CAN_NOT_YET_BE_WRITTEN,
                    "Attempted to write more samples than the buffer has space for.",
                    written,
                )
            due_s = min(len(volts) - written, waveform.size) / (waveform.rate_hz * self.bench.clock.pace)
            self.changed.wait(min(left_s, max(due_s, _MIN_WAIT_S)))
            self.check_running(task)

    def _device_attributes(self, device: str) -> dict[int, AttributeValue]:
        if device:
            if device.lower() != self.card.device.lower():
                raise CardError(
                    Status.INVALID_DEVICE_ID, f"Device identifier is invalid.\n\nDevice Specified: {device}"
                )
            self.check_card(listed=True)
            return {Attribute.DEVICE_PRODUCT: pci6229.PRODUCT, Attribute.DEVICE_SERIAL: pci6229.SERIAL_NUMBER}
        faults = self.bench.faults.active
        missing = faults.card_absent or faults.card_gone or faults.card_unplugged
        return {
            Attribute.SYSTEM_DEVICES: "" if missing else self.card.device,
            Attribute.SYSTEM_MAJOR_VERSION: pci6229.DRIVER_VERSION,
            Attribute.SYSTEM_MINOR_VERSION: 0,
            Attribute.SYSTEM_UPDATE_VERSION: 0,
        }

    def _task_attributes(self, task: CardTask, channel: str) -> dict[int, AttributeValue]:
        names = str(flatten_channel_string([channel.name for channel in task.channels]))
        buffer, waveform, now_s = task.buffer, task.waveform, self.now_s
        return {
            Attribute.TASK_NAME: task.name,
            Attribute.TASK_CHANNELS: names,
            **_clock_attributes(task),
            Attribute.READ_RELATIVE_TO: task.relative_to,
            Attribute.READ_OFFSET: task.offset,
            Attribute.READ_TOTAL: buffer.total() if buffer is not None else 0,
            Attribute.READ_POSITION: buffer.position if buffer is not None else 0,
            Attribute.READ_CHANNELS: names,
            Attribute.READ_NUM_CHANNELS: len(task.channels),
            Attribute.READ_LINES_PER_CHANNEL: 1,
            Attribute.WRITE_TOTAL: waveform.generated(now_s) if waveform is not None else 0,
            Attribute.WRITE_NUM_CHANNELS: len(task.channels),
            Attribute.WRITE_LINES_PER_CHANNEL: 1,
            Attribute.INPUT_BUFFER: task.input_buffer,
            Attribute.OUTPUT_BUFFER: task.output_buffer,
            **_REQUIRED_VALUES,
            **(_named_channels(task, channel)[0].properties if task.channels else {}),
        }


def _clock_attributes(task: CardTask) -> dict[int, AttributeValue]:
    if task.clock is None:
        return {Attribute.CLOCK_RATE: 0.0}
    rate_hz = task.clock.rate_hz
    if task.kind is not ChannelType.ANALOG_INPUT:
        return {Attribute.CLOCK_RATE: rate_hz}
    interval_s = pci6229.convert_interval(rate_hz, len(task.channels))
    return {Attribute.CLOCK_RATE: rate_hz, Attribute.CONVERT_RATE: 1.0 / interval_s}


def _named_channels(task: CardTask, names: str) -> list[VirtualChannel]:
    wanted = {name.strip().lower() for name in unflatten_channel_string(names)}
    channels = [channel for channel in task.channels if not wanted or channel.name.lower() in wanted]
    if not channels:
        raise task.failure(
            Status.INVALID_CHANNEL, f"Channel specified does not exist in the task.\n\nChannel Name: {names}"
        )
    return channels


def _not_started(task: CardTask) -> CardError:
    return task.failure(
        Status.CANNOT_READ_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING_OR_COMMITTED, "Task was not started."
    )


def _array_too_small(size: int) -> CardError:
    return CardError(Status.READ_BUFFER_TOO_SMALL, f"Buffer is too small to fit read data.\n\nElements: {size}")


def _unsupported_attribute(attribute: int) -> CardError:
    return CardError(
        Status.ATTR_NOT_SUPPORTED,
        "Specified property is not supported by the device or is not applicable to the task.\n\n"
        f"Property: {attribute:#x}",
    )
