"""What DAQmx's write calls do, and the voltages that result."""

import math
import time
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.sim_backend.doubles.card import generating
from dragrig.sim_backend.doubles.card.daqmx import CardError, ChannelKind, Code, Fill, Regeneration
from dragrig.sim_backend.doubles.card.engine import Engine
from dragrig.sim_backend.doubles.card.reading import bit_of
from dragrig.sim_backend.doubles.card.tasks import Task, Timing
from dragrig.sim_backend.doubles.card.waveform import Waveform

_Flat: TypeAlias = npt.NDArray[np.bool_] | npt.NDArray[np.int64]


class Writing:
    """The write calls; see `Card` for what they take."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def lines(self, handle: int, samples: int, auto_start: bool, layout: int, data: BoolArray) -> int:
        """Set levels, one element a line."""
        with self._engine.changed:
            task = self._ready(handle, ChannelKind.DIGITAL_OUTPUT, auto_start)
            width = max(len(channel.lines) for channel in task.channels)
            last = _last(np.asarray(data).reshape(-1), samples, len(task.channels), width, layout)
            for channel, levels in zip(task.channels, last, strict=True):
                for line, high in zip(channel.lines, levels.tolist(), strict=False):
                    self._engine.bench.write_line(line, bool(high))
            return samples

    def words(self, handle: int, samples: int, auto_start: bool, layout: int, data: list[int]) -> int:
        """Set levels, one word a channel."""
        with self._engine.changed:
            task = self._ready(handle, ChannelKind.DIGITAL_OUTPUT, auto_start)
            last = _last(np.asarray(data, dtype=np.int64), samples, len(task.channels), 1, layout)
            for channel, word in zip(task.channels, last[:, 0].tolist(), strict=True):
                for line in channel.lines:
                    self._engine.bench.write_line(line, bool(int(word) >> bit_of(line, channel.lines) & 1))
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
                        Code.INVALID_VOLTAGE,
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

    def _ready(self, handle: int, kind: ChannelKind, auto_start: bool) -> Task:
        task = self._engine.task(handle, kind)
        self._engine.touch()
        if not task.running and not auto_start:
            raise CardError(
                Code.WRITE_NOT_STARTED,
                "Write cannot be performed when the auto start input is false and the task is not running.\n\n"
                f"Task Name: {task.name}",
            )
        if not task.running:
            self._engine.start(task)
            self._engine.stop(task)
        return task

    def _buffered(self, task: Task, timing: Timing, volts: FloatArray, auto_start: bool, timeout_s: float) -> int:
        self._engine.touch()
        if task.waveform is None:
            size = task.output_buffer or max(volts.shape[1], 1)
            regenerates = task.regeneration == Regeneration.ALLOWED
            task.waveform = Waveform(len(task.channels), size, timing.rate_hz, regenerates, timing.limit)
        written = self._append(task, task.waveform, volts, timeout_s)
        if auto_start and not task.running:
            self._engine.start(task)
        return written

    def _append(self, task: Task, waveform: Waveform, volts: FloatArray, timeout_s: float) -> int:
        deadline_s = math.inf if timeout_s < 0 else time.perf_counter() + timeout_s
        written, samples = 0, int(volts.shape[1])
        while True:
            now_s = self._engine.now_s
            if waveform.used_up(now_s):
                self._engine.stop(task)
                raise CardError(
                    Code.REGENERATION_STOPPED,
                    "The generation has stopped to prevent the regeneration of old samples: new ones were not written "
                    f"in time.\n\nTask Name: {task.name}",
                    written,
                )
            part = volts[:, written : written + waveform.space(now_s)]
            first = waveform.written
            waveform.write(part)
            generating.tell(task, part, first, self._engine.hear)
            written += int(part.shape[1])
            left_s = deadline_s - time.perf_counter()
            if written == samples:
                return written
            if left_s <= 0 or not task.running:
                raise CardError(
                    Code.SAMPLES_CANNOT_YET_BE_WRITTEN,
                    f"Attempted to write more samples than the buffer has space for.\n\nTask Name: {task.name}",
                    written,
                )
            due_s = min(samples - written, waveform.size) / (waveform.rate_hz * self._engine.bench.clock.pace)
            self._engine.changed.wait(min(left_s, max(due_s, 1e-3)))
            self._engine.still_runs(task)()


def _by_channel(flat: FloatArray, samples: int, channels: int, layout: int) -> FloatArray:
    if samples < 1 or flat.size < samples * channels:
        raise CardError(
            Code.NUMBER_OF_CHANNELS,
            f"{flat.size} values were given for {samples} samples of {channels} channels.",
        )
    flat = flat[: samples * channels]
    return flat.reshape(channels, samples) if layout == Fill.BY_CHANNEL else flat.reshape(samples, channels).T


def _last(flat: _Flat, samples: int, channels: int, width: int, layout: int) -> npt.NDArray[np.int64]:
    if samples < 1 or flat.size < samples * channels * width:
        raise CardError(
            Code.NUMBER_OF_CHANNELS, f"{flat.size} values were given for {samples} samples of {channels} channels."
        )
    shape = (channels, samples, width) if layout == Fill.BY_CHANNEL else (samples, channels, width)
    levels = flat[: samples * channels * width].astype(np.int64).reshape(shape)
    return np.asarray(levels[:, -1] if layout == Fill.BY_CHANNEL else levels[-1])
