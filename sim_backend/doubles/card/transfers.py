"""DAQmx's read and write calls on the card's double, and the voltages and levels that result."""

import math
import time
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.sim_backend.doubles.card import engine as generating
from dragrig.sim_backend.doubles.card.daqmx import CardError, ChannelKind, FillMode, Regeneration, StatusCode
from dragrig.sim_backend.doubles.card.engine import TaskEngine
from dragrig.sim_backend.doubles.card.streams import EncoderCounter, InputBuffer, OutputWaveform
from dragrig.sim_backend.doubles.card.tasks import AnalogSource, CardTask, SampleClock, encoder_decoding

_ALL_AVAILABLE = -1
_DIGITAL_KINDS = (ChannelKind.DIGITAL_INPUT, ChannelKind.DIGITAL_OUTPUT)


class ReadCalls:
    """The read calls; see `Card` for what they take."""

    def __init__(self, engine: TaskEngine) -> None:
        self._engine = engine

    def analog(self, handle: int, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        """Read volts."""
        with self._engine.changed:
            task = self._engine.task(handle, ChannelKind.ANALOG_INPUT)
            if task.timing is not None:
                return self._buffered(task, samples, timeout_s, fill, out)
            return self._on_demand(task, samples, fill, out, self._volts_now)

    def counter(self, handle: int, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        """Read positions."""
        with self._engine.changed:
            task = self._engine.task(handle, ChannelKind.COUNTER_INPUT)
            if task.timing is not None:
                return self._buffered(task, samples, timeout_s, fill, out)
            return self._on_demand(task, samples, fill, out, self._position_now)

    def scalar(self, read: Callable[[int, int, float, int, FloatArray], int], handle: int, timeout_s: float) -> float:
        """Read one sample of a task with one channel."""
        out = np.zeros(1)
        read(handle, 1, timeout_s, FillMode.BY_CHANNEL, out)
        return float(out[0])

    def lines(self, handle: int, samples: int, fill: int, out: BoolArray) -> tuple[int, int]:
        """Read levels, one element a line."""
        with self._engine.changed:
            task = self._ready(handle)
            wanted = max(samples, 1)
            width = max(len(channel.lines) for channel in task.channels)
            if len(task.channels) * width * wanted > out.size:
                raise _too_small(out.size)
            levels = np.zeros((len(task.channels), wanted, width), dtype=bool)
            for place, channel in enumerate(task.channels):
                levels[place, :, : len(channel.lines)] = [self._engine.bench.read_line(one) for one in channel.lines]
            laid = levels if fill == FillMode.BY_CHANNEL else levels.swapaxes(0, 1)
            out.reshape(-1)[: laid.size] = laid.reshape(-1)
            return wanted, width

    def words(self, handle: int, samples: int, fill: int) -> list[int]:
        """Read levels, one word a channel."""
        with self._engine.changed:
            task = self._ready(handle)
            words = [
                sum(self._engine.bench.read_line(line) << line_bit(line, channel.lines) for line in channel.lines)
                for channel in task.channels
            ]
            wanted = max(samples, 1)
            return [word for word in words for _ in range(wanted)] if fill == FillMode.BY_CHANNEL else words * wanted

    def _ready(self, handle: int) -> CardTask:
        task = self._engine.task(handle, *_DIGITAL_KINDS)
        self._engine.touch()
        return task

    def _buffered(self, task: CardTask, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        self._engine.touch()
        started = not task.running
        if started:
            if not task.auto_start:
                raise CardError(StatusCode.READ_NOT_STARTED, f"Task was not started.\n\nTask Name: {task.name}")
            self._engine.start(task)
        stream = task.stream
        if stream is None:
            raise CardError(StatusCode.NO_SAMPLE_CLOCK, f"Task has no buffer.\n\nTask Name: {task.name}")
        channels = len(task.channels)
        wanted = self._all(task, stream, out.size // channels) if samples == _ALL_AVAILABLE else samples
        if wanted * channels > out.size:
            raise _too_small(out.size)
        span = stream.wait(wanted, timeout_s, task.position, self._engine.bench.faults.active.short_reads)
        if span.end > span.first:
            _fill_array(stream.source.fetch(span.first, span.end), fill, out)
        if started and stream.done and stream.position >= stream.total():
            self._engine.stop(task)
        if span.failure is not None:
            raise span.failure
        return span.end - span.first

    def _all(self, task: CardTask, stream: InputBuffer, room: int) -> int:
        until = stream.total() if stream.limit is None else stream.limit
        return min(max(until - stream.begins(task.position), 0), room)

    def _on_demand(
        self,
        task: CardTask,
        samples: int,
        fill: int,
        out: FloatArray,
        read: Callable[[CardTask, int], list[FloatArray]],
    ) -> int:
        wanted = max(samples, 1)
        if wanted * len(task.channels) > out.size:
            raise _too_small(out.size)
        self._engine.touch()
        started = not task.running
        if started:
            self._engine.start(task)
        try:
            _fill_array(read(task, wanted), fill, out)
        finally:
            if started and task.running:
                self._engine.stop(task)
        return wanted

    def _volts_now(self, task: CardTask, samples: int) -> list[FloatArray]:
        bench, rate_hz = self._engine.bench, self._engine.bench.rig.sampling.rate_hz
        source = AnalogSource(bench, task.channels, rate_hz)
        bench.begin_sampling(rate_hz)
        try:
            stream = InputBuffer(
                source, samples, samples, bench.clock.pace, self._engine.changed, self._engine.still_runs(task)
            )
            span = stream.wait(samples, -1.0, task.position, 0)
            return source.fetch(span.first, span.end)
        finally:
            bench.end_sampling()

    def _position_now(self, task: CardTask, samples: int) -> list[FloatArray]:
        counter = task.counter or EncoderCounter(
            self._engine.bench, encoder_decoding(task.channels[0], self._engine.bench.rig.hardware.card)
        )
        return [np.array([counter.now() for _ in range(samples)])]


def line_bit(line: str, lines: tuple[str, ...]) -> int:
    """Return the bit of a channel's word that a line has: its number in its port, when all are of one port."""
    ports = {one.partition("/")[0] for one in lines}
    return int(line.rpartition("line")[2]) if len(ports) == 1 else lines.index(line)


def _fill_array(rows: list[FloatArray], fill: int, out: FloatArray) -> None:
    # Fewer samples than asked for lie together at the array's beginning, not at the places of a full read.
    flat, samples = out.reshape(-1), len(rows[0])
    for place, row in enumerate(rows):
        if fill == FillMode.BY_CHANNEL:
            flat[place * samples : (place + 1) * samples] = row
        else:
            flat[place : samples * len(rows) : len(rows)] = row


def _too_small(size: int) -> CardError:
    return CardError(StatusCode.READ_BUFFER_TOO_SMALL, f"Buffer is too small to fit read data.\n\nElements: {size}")


_FlatLevels: TypeAlias = npt.NDArray[np.bool_] | npt.NDArray[np.int64]


class WriteCalls:
    """The write calls; see `Card` for what they take."""

    def __init__(self, engine: TaskEngine) -> None:
        self._engine = engine

    def lines(self, handle: int, samples: int, auto_start: bool, layout: int, data: BoolArray) -> int:
        """Set levels, one element a line."""
        with self._engine.changed:
            task = self._ready(handle, ChannelKind.DIGITAL_OUTPUT, auto_start)
            width = max(len(channel.lines) for channel in task.channels)
            last = _last_levels(np.asarray(data).reshape(-1), samples, len(task.channels), width, layout)
            for channel, levels in zip(task.channels, last, strict=True):
                for line, high in zip(channel.lines, levels.tolist(), strict=False):
                    self._engine.bench.write_line(line, bool(high))
            return samples

    def words(self, handle: int, samples: int, auto_start: bool, layout: int, data: list[int]) -> int:
        """Set levels, one word a channel."""
        with self._engine.changed:
            task = self._ready(handle, ChannelKind.DIGITAL_OUTPUT, auto_start)
            last = _last_levels(np.asarray(data, dtype=np.int64), samples, len(task.channels), 1, layout)
            for channel, word in zip(task.channels, last[:, 0].tolist(), strict=True):
                for line in channel.lines:
                    self._engine.bench.write_line(line, bool(int(word) >> line_bit(line, channel.lines) & 1))
            return samples

    def analog(
        self, handle: int, samples: int, auto_start: bool, timeout_s: float, layout: int, data: FloatArray
    ) -> int:
        """Set voltages, or append to a waveform."""
        with self._engine.changed:
            task = self._engine.task(handle, ChannelKind.ANALOG_OUTPUT)
            volts = _by_channel(data.reshape(-1), samples, len(task.channels), layout)
            for channel, row in zip(task.channels, volts, strict=True):
                if not np.all(np.abs(row) <= channel.range_V):
                    raise CardError(
                        StatusCode.INVALID_VOLTAGE,
                        "One or more values passed to the Write function are outside the range or not a number.\n\n"
                        f"Channel Name: {channel.name}\nMaximum Value: {channel.range_V:g}",
                    )
            if task.timing is not None:
                return self._buffered(task, task.timing, volts, auto_start, timeout_s)
            self._ready(handle, ChannelKind.ANALOG_OUTPUT, auto_start)
            for channel, held in zip(task.channels, volts[:, -1].tolist(), strict=True):
                self._engine.held_volts[channel.physical] = held
                self._engine.hear(channel.physical, np.array([held]), 0.0, self._engine.now_s)
            return samples

    def voltage(self, output: str) -> float:
        """Return what an output is at now, such as ao0."""
        with self._engine.changed:
            for task in self._engine.tasks.values():
                for place, channel in enumerate(task.channels):
                    if channel.physical == output and task.running and task.waveform is not None:
                        volts = task.waveform.volts(self._engine.now_s)
                        if volts is not None:
                            return float(volts[place])
            return self._engine.held_volts[output]

    def _ready(self, handle: int, kind: ChannelKind, auto_start: bool) -> CardTask:
        task = self._engine.task(handle, kind)
        self._engine.touch()
        if not task.running and not auto_start:
            raise CardError(
                StatusCode.WRITE_NOT_STARTED,
                "Write cannot be performed when the auto start input is false and the task is not running.\n\n"
                f"Task Name: {task.name}",
            )
        if not task.running:
            self._engine.start(task)
            self._engine.stop(task)
        return task

    def _buffered(
        self, task: CardTask, timing: SampleClock, volts: FloatArray, auto_start: bool, timeout_s: float
    ) -> int:
        self._engine.touch()
        if task.waveform is None:
            size = task.output_buffer or max(volts.shape[1], 1)
            regenerates = task.regeneration == Regeneration.ALLOWED
            task.waveform = OutputWaveform(len(task.channels), size, timing.rate_hz, regenerates, timing.limit)
        written = self._append(task, task.waveform, volts, timeout_s)
        if auto_start and not task.running:
            self._engine.start(task)
        return written

    def _append(self, task: CardTask, waveform: OutputWaveform, volts: FloatArray, timeout_s: float) -> int:
        deadline_s = math.inf if timeout_s < 0 else time.perf_counter() + timeout_s
        written, samples = 0, int(volts.shape[1])
        while True:
            now_s = self._engine.now_s
            if waveform.used_up(now_s):
                self._engine.stop(task)
                raise CardError(
                    StatusCode.REGENERATION_STOPPED,
                    "The generation has stopped to prevent the regeneration of old samples: new ones were not written "
                    f"in time.\n\nTask Name: {task.name}",
                    written,
                )
            part = volts[:, written : written + waveform.space(now_s)]
            first = waveform.written
            waveform.write(part)
            generating.announce_voltages(task, part, first, self._engine.hear)
            written += int(part.shape[1])
            left_s = deadline_s - time.perf_counter()
            if written == samples:
                return written
            if left_s <= 0 or not task.running:
                raise CardError(
                    StatusCode.SAMPLES_CANNOT_YET_BE_WRITTEN,
                    f"Attempted to write more samples than the buffer has space for.\n\nTask Name: {task.name}",
                    written,
                )
            due_s = min(samples - written, waveform.size) / (waveform.rate_hz * self._engine.bench.clock.pace)
            self._engine.changed.wait(min(left_s, max(due_s, 1e-3)))
            self._engine.still_runs(task)()


def _by_channel(flat: FloatArray, samples: int, channels: int, layout: int) -> FloatArray:
    if samples < 1 or flat.size < samples * channels:
        raise CardError(
            StatusCode.NUMBER_OF_CHANNELS,
            f"{flat.size} values were given for {samples} samples of {channels} channels.",
        )
    flat = flat[: samples * channels]
    return flat.reshape(channels, samples) if layout == FillMode.BY_CHANNEL else flat.reshape(samples, channels).T


def _last_levels(flat: _FlatLevels, samples: int, channels: int, width: int, layout: int) -> npt.NDArray[np.int64]:
    if samples < 1 or flat.size < samples * channels * width:
        raise CardError(
            StatusCode.NUMBER_OF_CHANNELS,
            f"{flat.size} values were given for {samples} samples of {channels} channels.",
        )
    shape = (channels, samples, width) if layout == FillMode.BY_CHANNEL else (samples, channels, width)
    levels = flat[: samples * channels * width].astype(np.int64).reshape(shape)
    return np.asarray(levels[:, -1] if layout == FillMode.BY_CHANNEL else levels[-1])
