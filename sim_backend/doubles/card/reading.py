"""What DAQmx's read calls do."""

from collections.abc import Callable

import numpy as np

from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.sim_backend.doubles.card.channels import encoder_of
from dragrig.sim_backend.doubles.card.counter import Counter
from dragrig.sim_backend.doubles.card.daqmx import CardError, ChannelKind, Code, Fill
from dragrig.sim_backend.doubles.card.engine import Engine
from dragrig.sim_backend.doubles.card.inputs import AnalogSource
from dragrig.sim_backend.doubles.card.streams import Stream
from dragrig.sim_backend.doubles.card.tasks import Task

_ALL = -1
_DIGITAL = (ChannelKind.DIGITAL_INPUT, ChannelKind.DIGITAL_OUTPUT)


class Reading:
    """The read calls; see `Card` for what they take."""

    def __init__(self, engine: Engine) -> None:
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
        read(handle, 1, timeout_s, Fill.BY_CHANNEL, out)
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
            laid = levels if fill == Fill.BY_CHANNEL else levels.swapaxes(0, 1)
            out.reshape(-1)[: laid.size] = laid.reshape(-1)
            return wanted, width

    def words(self, handle: int, samples: int, fill: int) -> list[int]:
        """Read levels, one word a channel."""
        with self._engine.changed:
            task = self._ready(handle)
            words = [
                sum(self._engine.bench.read_line(line) << bit_of(line, channel.lines) for line in channel.lines)
                for channel in task.channels
            ]
            wanted = max(samples, 1)
            return [word for word in words for _ in range(wanted)] if fill == Fill.BY_CHANNEL else words * wanted

    def _ready(self, handle: int) -> Task:
        task = self._engine.task(handle, *_DIGITAL)
        self._engine.touch()
        return task

    def _buffered(self, task: Task, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        self._engine.touch()
        started = not task.running
        if started:
            if not task.auto_start:
                raise CardError(Code.READ_NOT_STARTED, f"Task was not started.\n\nTask Name: {task.name}")
            self._engine.start(task)
        stream = task.stream
        if stream is None:
            raise CardError(Code.NO_SAMPLE_CLOCK, f"Task has no buffer.\n\nTask Name: {task.name}")
        channels = len(task.channels)
        wanted = self._all(task, stream, out.size // channels) if samples == _ALL else samples
        if wanted * channels > out.size:
            raise _too_small(out.size)
        span = stream.wait(wanted, timeout_s, task.position, self._engine.bench.mishaps.now.short_reads)
        if span.end > span.first:
            _lay(stream.source.fetch(span.first, span.end), fill, out)
        if started and stream.done and stream.position >= stream.total():
            self._engine.stop(task)
        if span.failure is not None:
            raise span.failure
        return span.end - span.first

    def _all(self, task: Task, stream: Stream, room: int) -> int:
        until = stream.total() if stream.limit is None else stream.limit
        return min(max(until - stream.begins(task.position), 0), room)

    def _on_demand(
        self,
        task: Task,
        samples: int,
        fill: int,
        out: FloatArray,
        read: Callable[[Task, int], list[FloatArray]],
    ) -> int:
        wanted = max(samples, 1)
        if wanted * len(task.channels) > out.size:
            raise _too_small(out.size)
        self._engine.touch()
        started = not task.running
        if started:
            self._engine.start(task)
        try:
            _lay(read(task, wanted), fill, out)
        finally:
            if started and task.running:
                self._engine.stop(task)
        return wanted

    def _volts_now(self, task: Task, samples: int) -> list[FloatArray]:
        bench, rate_hz = self._engine.bench, self._engine.bench.rig.sampling.rate_hz
        source = AnalogSource(bench, task.channels, rate_hz)
        bench.begin_sampling(rate_hz)
        try:
            stream = Stream(
                source, samples, samples, bench.clock.pace, self._engine.changed, self._engine.still_runs(task)
            )
            span = stream.wait(samples, -1.0, task.position, 0)
            return source.fetch(span.first, span.end)
        finally:
            bench.end_sampling()

    def _position_now(self, task: Task, samples: int) -> list[FloatArray]:
        counter = task.counter or Counter(
            self._engine.bench, encoder_of(task.channels[0], self._engine.bench.rig.hardware.card)
        )
        return [np.array([counter.now() for _ in range(samples)])]


def bit_of(line: str, lines: tuple[str, ...]) -> int:
    """Return the bit of a channel's word that a line has: its number in its port, when all are of one port."""
    ports = {one.partition("/")[0] for one in lines}
    return int(line.rpartition("line")[2]) if len(ports) == 1 else lines.index(line)


def _lay(rows: list[FloatArray], fill: int, out: FloatArray) -> None:
    # Fewer samples than asked for lie together at the array's beginning, not at the places of a full read.
    flat, samples = out.reshape(-1), len(rows[0])
    for place, row in enumerate(rows):
        if fill == Fill.BY_CHANNEL:
            flat[place * samples : (place + 1) * samples] = row
        else:
            flat[place : samples * len(rows) : len(rows)] = row


def _too_small(size: int) -> CardError:
    return CardError(Code.READ_BUFFER_TOO_SMALL, f"Buffer is too small to fit read data.\n\nElements: {size}")
