"""What DAQmx answers when asked for an attribute, and what setting one does."""

from collections.abc import Callable

from nidaqmx.utils import flatten_channel_string, unflatten_channel_string

from dragrig.sim_backend.doubles.card import pci6229
from dragrig.sim_backend.doubles.card.attributes import Buffer, Chan, Clock, OfTask, Read, Write
from dragrig.sim_backend.doubles.card.channels import set_property
from dragrig.sim_backend.doubles.card.daqmx import CardError, Code, Regeneration, RelativeTo
from dragrig.sim_backend.doubles.card.engine import Engine
from dragrig.sim_backend.doubles.card.facts import device_facts, driver_facts
from dragrig.sim_backend.doubles.card.tasks import Channel, Task, Value

_ON_DEMAND, _SAMPLE_CLOCK = 10390, 10388
_OVERWRITE, _DO_NOT_OVERWRITE = 10252, 10159
_AI_FIFO = 4095


class Answers:
    """Attributes of one card's tasks, channels and driver. Whoever calls a method holds the engine's lock."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def get(self, group: str, subject: int | str, attribute: int, channel: str) -> Value:
        """Return an attribute; see `Card.get_attribute`."""
        match group:
            case "system":
                return _found(driver_facts(self._engine), attribute)
            case "device":
                return _found(device_facts(self._engine, str(subject)), attribute)
            case "chan":
                return self._of_channel(self._engine.task(int(subject)), channel, attribute)
            case _:
                return _found(self._of(group, attribute)(self._engine.task(int(subject))), attribute)

    def set(self, group: str, handle: int, attribute: int, value: Value, channel: str) -> None:
        """Set an attribute; see `Card.set_attribute`."""
        if group == "read":
            self._set_reading(self._engine.task(handle), attribute, value)
            return
        task = self._engine.idle(handle)
        match group, attribute:
            case "chan", _:
                for one in _chosen(task, channel):
                    set_property(one, self._engine.wiring.device, attribute, value)
            case "buffer", Buffer.INPUT:
                task.input_buffer = _whole(value)
            case "buffer", Buffer.OUTPUT:
                task.output_buffer = _whole(value)
            case "write", Write.REGENERATION if value in list(Regeneration):
                task.regeneration = _whole(value)
            case _:
                raise _unknown(attribute)

    def reset(self, group: str, handle: int, attribute: int) -> None:
        """Put an attribute back; see `Card.reset_attribute`."""
        defaults: dict[tuple[str, int], Value] = {
            ("read", Read.RELATIVE_TO): int(RelativeTo.CURRENT_READ_POSITION),
            ("read", Read.OFFSET): 0,
            ("read", Read.OVERWRITE): _DO_NOT_OVERWRITE,
            ("read", Read.AUTO_START): True,
            ("buffer", Buffer.INPUT): 0,
            ("buffer", Buffer.OUTPUT): 0,
            ("write", Write.REGENERATION): int(Regeneration.ALLOWED),
        }
        if (group, attribute) not in defaults:
            raise _unknown(attribute)
        self.set(group, handle, attribute, defaults[group, attribute], "")

    def _set_reading(self, task: Task, attribute: int, value: Value) -> None:
        match attribute:
            case Read.RELATIVE_TO if value in list(RelativeTo):
                task.position.relative_to = _whole(value)
            case Read.OFFSET:
                task.position.offset = _whole(value)
            case Read.OVERWRITE if value in {_OVERWRITE, _DO_NOT_OVERWRITE}:
                task.position.overwrite = value == _OVERWRITE
            case Read.AUTO_START:
                task.auto_start = bool(value)
            case _:
                raise _unknown(attribute)

    def _of(self, group: str, attribute: int) -> Callable[[Task], dict[int, Value]]:
        groups = {
            "task": self._of_task,
            "read": self._of_reading,
            "write": self._of_writing,
            "buffer": self._of_buffers,
            "timing": self._of_timing,
        }
        if group not in groups:
            raise _unknown(attribute)
        return groups[group]

    def _of_task(self, task: Task) -> dict[int, Value]:
        return {
            OfTask.NAME: task.name,
            OfTask.CHANNELS: _names(task),
            OfTask.NUM_CHANNELS: len(task.channels),
            OfTask.DEVICES: self._engine.wiring.device if task.channels else "",
            OfTask.NUM_DEVICES: int(bool(task.channels)),
            OfTask.COMPLETE: self._engine.done(task),
        }

    def _of_channel(self, task: Task, channel: str, attribute: int) -> Value:
        chosen = _chosen(task, channel)[0]
        if attribute == Chan.CI_COUNT:
            return int(task.counter.count()) if task.counter is not None else 0
        return _found(chosen.properties, attribute)

    def _of_reading(self, task: Task) -> dict[int, Value]:
        stream = task.stream
        total = stream.total() if stream is not None else 0
        available = max(total - stream.begins(task.position), 0) if stream is not None else 0
        everything = available if stream is None or stream.limit is None else stream.limit - stream.position
        return {
            Read.RELATIVE_TO: task.position.relative_to,
            Read.OFFSET: task.position.offset,
            Read.OVERWRITE: _OVERWRITE if task.position.overwrite else _DO_NOT_OVERWRITE,
            Read.AVAILABLE: available,
            Read.TOTAL: total,
            Read.POSITION: stream.position if stream is not None else 0,
            Read.AUTO_START: task.auto_start,
            Read.ALL_AVAILABLE: False,
            Read.CHANNELS: _names(task),
            Read.NUM_CHANNELS: len(task.channels),
            Read.LINES_PER_CHANNEL: _lines_per_channel(task),
            Read.DEFAULT_SAMPLES: everything if task.timing is not None else 1,
        }

    def _of_writing(self, task: Task) -> dict[int, Value]:
        waveform, now_s = task.waveform, self._engine.now_s
        return {
            Write.REGENERATION: task.regeneration,
            Write.SPACE: waveform.space(now_s) if waveform is not None else task.output_buffer or 0,
            Write.TOTAL: waveform.generated(now_s) if waveform is not None else 0,
            Write.POSITION: waveform.written if waveform is not None else 0,
            Write.NUM_CHANNELS: len(task.channels),
            Write.LINES_PER_CHANNEL: _lines_per_channel(task),
        }

    def _of_buffers(self, task: Task) -> dict[int, Value]:
        output = task.waveform.size if task.waveform is not None else task.output_buffer or 0
        return {Buffer.INPUT: task.buffer_size, Buffer.INPUT_ONBOARD: _AI_FIFO, Buffer.OUTPUT: output}

    def _of_timing(self, task: Task) -> dict[int, Value]:
        timing = task.timing
        if timing is None:
            return {Clock.TYPE: _ON_DEMAND}
        return {
            Clock.RATE: timing.rate_hz,
            Clock.MAX_RATE: pci6229.AI_MAX_RATE_HZ / max(len(task.channels), 1),
            Clock.SOURCE: f"/{self._engine.wiring.device}/{timing.source or '20MHzTimebase'}",
            Clock.TYPE: _SAMPLE_CLOCK,
            Clock.QUANTITY: int(timing.quantity),
            Clock.SAMPLES: timing.samples,
        }


def _found(answers: dict[int, Value], attribute: int) -> Value:
    if attribute not in answers:
        raise _unknown(attribute)
    return answers[attribute]


def _names(task: Task) -> str:
    return str(flatten_channel_string([channel.name for channel in task.channels]))


def _lines_per_channel(task: Task) -> int:
    return max((len(channel.lines) for channel in task.channels), default=0)


def _chosen(task: Task, names: str) -> list[Channel]:
    wanted = {name.strip().lower() for name in unflatten_channel_string(names)}
    chosen = [channel for channel in task.channels if not wanted or channel.name.lower() in wanted]
    if not chosen:
        raise CardError(
            Code.INVALID_CHANNEL,
            f"Channel specified does not exist in the task.\n\nChannel Name: {names}\nTask Name: {task.name}",
        )
    return chosen


def _whole(value: Value) -> int:
    if isinstance(value, str | list):
        raise CardError(Code.INVALID_ATTRIBUTE_VALUE, f"{value!r} is no number.")
    return int(value)


def _unknown(attribute: int) -> CardError:
    return CardError(
        Code.ATTRIBUTE_NOT_SUPPORTED,
        f"Specified property is not supported by the device or is not applicable to the task.\n\n"
        f"Property: {attribute:#x}",
    )
