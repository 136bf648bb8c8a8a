"""The card's double in place of NI's C library, so that plain `nidaqmx.Task()` runs its production code on it.

The functions are real C function pointers. nidaqmx sets their argument types itself, as it does with NI's library, and
thereby refuses arrays that are not C-contiguous float64; what the double lacks, nidaqmx reports as unsupported.
"""

import ctypes
import struct
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from ctypes import POINTER, c_char_p, c_double, c_int32, c_uint32, c_uint64, c_void_p
from typing import Protocol, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt
from nidaqmx._lib import DaqFunctionImporter, lib_importer

from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.card.daqmx import WIDE_ATTRIBUTES, CardError, StatusCode, WriteAttribute
from dragrig.sim_backend.doubles.card.tasks import AttributeValue

CFunction: TypeAlias = tuple[tuple[type, ...], Callable[..., int | None]]
"""Types of the arguments, and what is called with them."""

_READ_ARGUMENTS = (c_void_p, c_int32, c_double, c_int32, c_void_p, c_uint32, POINTER(c_int32), c_void_p)
_WRITE_ARGUMENTS = (c_void_p, c_int32, c_uint32, c_double, c_int32, c_void_p, POINTER(c_int32), c_void_p)
_Element = TypeVar("_Element", bound=np.generic)
_READ_SCALAR_ARGUMENTS = (c_void_p, c_double, POINTER(c_double), c_void_p)


class _ResultPointer(Protocol):
    """A pointer to where an answer goes."""

    def __setitem__(self, index: int, value: object, /) -> None: ...


def call_functions(card: Card) -> Mapping[str, CFunction]:
    """Return the functions by their names, without DAQmx before them."""
    return {
        **_task_functions(card),
        **_channel_functions(card),
        **_read_functions(card),
        **_digital_functions(card),
        **_write_functions(card),
    }


def _task_functions(card: Card) -> Mapping[str, CFunction]:
    def create(name: bytes, handle: _ResultPointer) -> None:
        handle[0] = c_void_p(card.create_task(_decoded(name)))

    def is_done(task: int, done: _ResultPointer) -> None:
        done[0] = c_uint32(card.is_task_done(task))

    def configure(task: int, source: bytes, rate_hz: float, edge: int, quantity: int, samples: int) -> None:
        card.cfg_samp_clk_timing(task, _decoded(source), rate_hz, edge, quantity, samples)

    def trigger(task: int, source: bytes, edge: int) -> None:
        card.cfg_dig_edge_start_trig(task, _decoded(source), edge)

    return {
        "CreateTask": ((c_char_p, POINTER(c_void_p)), create),
        "ClearTask": ((c_void_p,), card.clear_task),
        "StartTask": ((c_void_p,), card.start),
        "StopTask": ((c_void_p,), card.stop),
        "TaskControl": ((c_void_p, c_int32), card.control),
        "WaitUntilTaskDone": ((c_void_p, c_double), card.wait_until_done),
        "IsTaskDone": ((c_void_p, POINTER(c_uint32)), is_done),
        "CfgSampClkTiming": ((c_void_p, c_char_p, c_double, c_int32, c_int32, c_uint64), configure),
        "CfgDigEdgeStartTrig": ((c_void_p, c_char_p, c_int32), trigger),
        "ResetDevice": ((c_char_p,), lambda device: card.reset_device(_decoded(device))),
        "SetRuntimeEnvironment": ((c_char_p, c_char_p, c_char_p, c_char_p), lambda *_: None),
    }


def _channel_functions(card: Card) -> Mapping[str, CFunction]:
    def analog_input(
        task: int, place: bytes, name: bytes, terminals: int, low: float, high: float, units: int, scale: bytes
    ) -> None:
        card.create_ai_voltage_chan(task, _decoded(place), _decoded(name), terminals, low, high, units, _decoded(scale))

    def analog_output(task: int, place: bytes, name: bytes, low: float, high: float, units: int, scale: bytes) -> None:
        card.create_ao_voltage_chan(task, _decoded(place), _decoded(name), low, high, units, _decoded(scale))

    def encoder(
        task: int,
        counter: bytes,
        name: bytes,
        decoding: int,
        z_enable: int,
        z_value: float,
        z_phase: int,
        units: int,
        distance: float,
        start: float,
        scale: bytes,
    ) -> None:
        card.create_ci_lin_encoder_chan(
            task, _decoded(counter), _decoded(name), decoding, bool(z_enable), z_value, z_phase, units, distance, start,
            _decoded(scale),
        )  # fmt: skip

    def lines_in(task: int, lines: bytes, name: bytes, grouping: int) -> None:
        card.create_di_chan(task, _decoded(lines), _decoded(name), grouping)

    def lines_out(task: int, lines: bytes, name: bytes, grouping: int) -> None:
        card.create_do_chan(task, _decoded(lines), _decoded(name), grouping)

    named = (c_void_p, c_char_p, c_char_p)
    return {
        "CreateAIVoltageChan": ((*named, c_int32, c_double, c_double, c_int32, c_char_p), analog_input),
        "CreateAOVoltageChan": ((*named, c_double, c_double, c_int32, c_char_p), analog_output),
        "CreateCILinEncoderChan": (
            (*named, c_int32, c_uint32, c_double, c_int32, c_int32, c_double, c_double, c_char_p),
            encoder,
        ),
        "CreateDIChan": ((*named, c_int32), lines_in),
        "CreateDOChan": ((*named, c_int32), lines_out),
    }


def _read_functions(card: Card) -> Mapping[str, CFunction]:
    def many(read: Callable[[int, int, float, int, FloatArray], int]) -> Callable[..., None]:
        def call(
            task: int,
            samples: int,
            timeout_s: float,
            fill: int,
            place: int,
            size: int,
            count: _ResultPointer,
            _: object,
        ) -> None:
            out = _array_at(place, size, np.float64)
            count[0] = _with_count(count, lambda: read(task, samples, timeout_s, fill, out))

        return call

    def one(read: Callable[[int, float], float]) -> Callable[..., None]:
        def call(task: int, timeout_s: float, value: _ResultPointer, _: object) -> None:
            value[0] = c_double(read(task, timeout_s))

        return call

    return {
        "ReadAnalogF64": (_READ_ARGUMENTS, many(card.read_analog_f64)),
        "ReadCounterF64Ex": (_READ_ARGUMENTS, many(card.read_counter_f64)),
        "ReadAnalogScalarF64": (_READ_SCALAR_ARGUMENTS, one(card.read_analog_scalar_f64)),
        "ReadCounterScalarF64": (_READ_SCALAR_ARGUMENTS, one(card.read_counter_scalar_f64)),
    }


def _digital_functions(card: Card) -> Mapping[str, CFunction]:
    def read_lines(
        task: int,
        samples: int,
        _timeout_s: float,
        fill: int,
        place: int,
        size: int,
        count: _ResultPointer,
        width: _ResultPointer,
        _: object,
    ) -> None:
        out = _array_at(place, size, np.bool_)
        got, lines = card.read_digital_lines(task, samples, fill, out)
        count[0], width[0] = c_int32(got), c_int32(lines)

    def read_words(
        task: int, samples: int, _timeout_s: float, fill: int, place: int, size: int, count: _ResultPointer, _: object
    ) -> None:
        words = card.read_digital_u32(task, samples, fill)[:size]
        _array_at(place, size, np.uint32)[: len(words)] = words
        count[0] = c_int32(max(samples, 1))

    def read_word(task: int, _timeout_s: float, value: _ResultPointer, _: object) -> None:
        value[0] = c_uint32(card.read_digital_u32(task, 1, 0)[0])

    def write_lines(
        task: int,
        samples: int,
        auto_start: int,
        _timeout_s: float,
        layout: int,
        place: int,
        count: _ResultPointer,
        _: object,
    ) -> None:
        lines = _write_attribute(card, task, WriteAttribute.NUM_CHANNELS) * _write_attribute(
            card, task, WriteAttribute.LINES_PER_CHANNEL
        )
        data: BoolArray = _array_at(place, samples * lines, np.bool_)
        count[0] = _with_count(count, lambda: card.write_digital_lines(task, samples, bool(auto_start), layout, data))

    def write_words(
        task: int,
        samples: int,
        auto_start: int,
        _timeout_s: float,
        layout: int,
        place: int,
        count: _ResultPointer,
        _: object,
    ) -> None:
        words = _array_at(
            place, samples * _write_attribute(card, task, WriteAttribute.NUM_CHANNELS), np.uint32
        ).tolist()
        count[0] = _with_count(count, lambda: card.write_digital_u32(task, samples, bool(auto_start), layout, words))

    def write_word(task: int, auto_start: int, _timeout_s: float, value: int, _: object) -> None:
        card.write_digital_u32(task, 1, bool(auto_start), 0, [value])

    return {
        "ReadDigitalLines": ((*_READ_ARGUMENTS[:-1], POINTER(c_int32), c_void_p), read_lines),
        "ReadDigitalU32": (_READ_ARGUMENTS, read_words),
        "ReadDigitalScalarU32": ((c_void_p, c_double, POINTER(c_uint32), c_void_p), read_word),
        "WriteDigitalLines": (_WRITE_ARGUMENTS, write_lines),
        "WriteDigitalU32": (_WRITE_ARGUMENTS, write_words),
        "WriteDigitalScalarU32": ((c_void_p, c_uint32, c_double, c_uint32, c_void_p), write_word),
    }


def _write_functions(card: Card) -> Mapping[str, CFunction]:
    def write(
        task: int,
        samples: int,
        auto_start: int,
        timeout_s: float,
        layout: int,
        place: int,
        count: _ResultPointer,
        _: object,
    ) -> None:
        volts = _array_at(place, samples * _write_attribute(card, task, WriteAttribute.NUM_CHANNELS), np.float64)
        count[0] = _with_count(
            count, lambda: card.write_analog_f64(task, samples, bool(auto_start), timeout_s, layout, volts)
        )

    def write_one(task: int, auto_start: int, timeout_s: float, value: float, _: object) -> None:
        card.write_analog_f64(task, 1, bool(auto_start), timeout_s, 0, np.array([value]))

    return {
        "WriteAnalogF64": (_WRITE_ARGUMENTS, write),
        "WriteAnalogScalarF64": ((c_void_p, c_uint32, c_double, c_double, c_void_p), write_one),
    }


def _write_attribute(card: Card, task: int, attribute: WriteAttribute) -> int:
    return int(str(card.get_attribute("write", task, attribute)))


def _with_count(count: _ResultPointer, call: Callable[[], int]) -> c_int32:
    try:
        return c_int32(call())
    except CardError as error:
        count[0] = c_int32(error.samples)
        raise


def _array_at(place: int, size: int, element: type[_Element]) -> npt.NDArray[_Element]:
    if size <= 0 or not place:
        return np.zeros(0, element)
    memory = (ctypes.c_char * (size * np.dtype(element).itemsize)).from_address(place)
    return np.frombuffer(memoryview(memory), element)


def _decoded(words: bytes | None) -> str:
    return (words or b"").decode()


_READABLE = ("Task", "Read", "Write", "Buffer", "Timing")
_SETTABLE = ("Read", "Write", "Buffer")
# A C function takes a whole number and a real one in different registers, but for Windows, where the place counts.
_VALUE_ARGUMENTS = (c_uint64,) if sys.platform == "win32" else (c_uint64, c_double)


def attribute_functions(card: Card) -> Mapping[str, CFunction]:
    """Return the functions by their names, without DAQmx before them."""
    place = (c_void_p, c_uint32)
    functions: dict[str, CFunction] = {
        "GetSystemInfoAttribute": ((c_int32, *place), _getter(card, "system", lambda: ("", ""))),
        "GetDeviceAttribute": ((c_char_p, c_int32, *place), _getter(card, "device", lambda name: (_decoded(name), ""))),
        "GetChanAttribute": (
            (c_void_p, c_char_p, c_int32, *place),
            _getter(card, "chan", lambda task, channel: (task, _decoded(channel))),
        ),
        "SetChanAttribute": ((c_void_p, c_char_p, c_int32, *_VALUE_ARGUMENTS), _setter(card, "chan", _with_channel)),
        "ResetChanAttribute": ((c_void_p, c_char_p, c_int32), _resetter(card, "chan", _with_channel)),
    }
    for name in _READABLE:
        get = _getter(card, name.lower(), lambda task: (task, ""))
        functions[f"Get{name}Attribute"] = ((c_void_p, c_int32, *place), get)
    for name in _SETTABLE:
        functions[f"Set{name}Attribute"] = (
            (c_void_p, c_int32, *_VALUE_ARGUMENTS),
            _setter(card, name.lower(), _without_channel),
        )
        functions[f"Reset{name}Attribute"] = ((c_void_p, c_int32), _resetter(card, name.lower(), _without_channel))
    return functions


def _with_channel(task: int, channel: bytes, *rest: int | float) -> "tuple[int, str, tuple[int | float, ...]]":
    return task, _decoded(channel), rest


def _without_channel(task: int, *rest: int | float) -> "tuple[int, str, tuple[int | float, ...]]":
    return task, "", rest


def _getter(card: Card, group: str, subject: Callable[..., tuple[int | str, str]]) -> Callable[..., int]:
    def get(*arguments: int) -> int:
        *whose, attribute, place, size = arguments
        whom, channel = subject(*whose)
        value = card.get_attribute(group, whom, attribute, channel)
        return _store_value(value, place, size, wide=(group, attribute) in WIDE_ATTRIBUTES)

    return get


_Split = Callable[..., "tuple[int, str, tuple[int | float, ...]]"]


def _setter(card: Card, group: str, split: _Split) -> Callable[..., None]:
    def set_(*arguments: int | float) -> None:
        task, channel, (attribute, whole, *real) = split(*arguments)
        present = card.get_attribute(group, task, int(attribute), channel)
        value = _decoded_value(present, int(whole), real[0] if real else None)
        card.set_attribute(group, task, int(attribute), value, channel)

    return set_


def _resetter(card: Card, group: str, split: _Split) -> Callable[..., None]:
    def reset(*arguments: int | float) -> None:
        task, channel, (attribute,) = split(*arguments)
        card.reset_attribute(group, task, int(attribute), channel)

    return reset


def _store_value(value: AttributeValue, place: int, size: int, *, wide: bool) -> int:
    """Write a value in the C type of its attribute; return 0, or the size that is needed when asked with size 0."""
    match value:
        case int():
            data = struct.pack("=Q" if wide else "=i" if value < 0 else "=I", value)
            needed = size
        case float():
            data, needed = struct.pack("=d", value), size
        case list():
            data, needed = struct.pack(f"={len(value)}d", *value), len(value)
        case str():
            data = value.encode() + b"\0"
            needed = len(data)
    if size < needed:
        if size == 0:
            return needed
        raise CardError(
            StatusCode.BUFFER_TOO_SMALL_FOR_STRING, f"Buffer is too small: {needed} are needed, {size} given."
        )
    ctypes.memmove(place, data, len(data))
    return 0


def _decoded_value(present: AttributeValue, whole: int, real: float | None) -> AttributeValue:
    """Return an argument as the type that the attribute has at present."""
    match present:
        case str():
            return ctypes.string_at(whole).decode()
        case bool():
            return bool(whole & 0xFFFFFFFF)
        case float():
            return real if real is not None else float(struct.unpack("=d", struct.pack("=Q", whole))[0])
        case _:
            return c_int32(whole & 0xFFFFFFFF).value


ENCODING = "utf-8"
_INTERNAL_ERROR = -200001


@contextmanager
def installed(card: Card) -> Iterator[None]:
    """Let nidaqmx find `card` in place of NI's library within the context; only one at a time in a process.

    Tasks are to be closed before it ends.
    """
    library = DaqFunctionImporter(_Library(card))
    ours = {"_windll": library, "_cdll": library, "_encoding": ENCODING}
    before = {name: getattr(lib_importer, name) for name in ours}
    try:
        for name, value in ours.items():
            setattr(lib_importer, name, value)
        yield
    finally:
        for name, value in before.items():
            setattr(lib_importer, name, value)


class _Library(ctypes.CDLL):
    """A library whose functions are callbacks; it loads nothing."""

    def __init__(self, card: Card) -> None:
        super().__init__("double of NI-DAQmx", handle=0)
        self._failure = _LastError()
        functions: Mapping[str, CFunction] = {
            **call_functions(card),
            **attribute_functions(card),
            "GetExtendedErrorInfo": ((ctypes.c_void_p, ctypes.c_uint32), self._failure.copy),
            "GetErrorString": (
                (ctypes.c_int32, ctypes.c_void_p, ctypes.c_uint32),
                self._failure.name,
            ),
        }
        # The callbacks live as long as the library: a pointer to one that was collected would crash the process.
        self._callbacks = {
            f"DAQmx{name}": ctypes.CFUNCTYPE(ctypes.c_int32, *types)(self._failure.guarded(call))
            for name, (types, call) in functions.items()
        }

    def __getitem__(self, name_or_ordinal: str | int) -> Callable[..., int]:  # type: ignore[override]
        callback = self._callbacks.get(str(name_or_ordinal))
        if callback is None:
            raise AttributeError(name_or_ordinal)
        return self._FuncPtr(ctypes.cast(callback, ctypes.c_void_p).value or 0)


class _LastError:
    """The last error in each thread, in words."""

    def __init__(self) -> None:
        self._last = threading.local()

    def guarded(self, call: Callable[..., int | None]) -> Callable[..., int]:
        """Return `call` with its errors as status codes."""

        def answer(*arguments: object) -> int:
            try:
                return call(*arguments) or 0
            except CardError as error:
                self._last.words = error.message
                return error.code
            except Exception as error:  # noqa: BLE001 - nothing can be raised through C, and silence would hide it
                self._last.words = f"The double of NI-DAQmx failed: {type(error).__name__}: {error}"
                return _INTERNAL_ERROR

        return answer

    def copy(self, place: int, size: int) -> None:
        """Write the last error's words."""
        _write_string(getattr(self._last, "words", ""), place, size)

    def name(self, code: int, place: int, size: int) -> None:
        """Write what a status code means."""
        _write_string(f"Status {code}.", place, size)


def _write_string(words: str, place: int, size: int) -> None:
    text = words.encode(ENCODING)[: size - 1] + b"\0"
    ctypes.memmove(place, text, len(text))
