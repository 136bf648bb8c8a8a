"""The card's double in place of NI's C library, so that plain `nidaqmx.Task()` runs its production code on it.

The functions are real C function pointers. nidaqmx sets their argument types itself, as it does with NI's library, and
thereby refuses arrays that are not C-contiguous float64; functions that the double lacks, nidaqmx reports as
unsupported.
"""

import ctypes
import struct
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from ctypes import POINTER, c_char_p, c_double, c_int32, c_uint32, c_uint64, c_void_p
from dataclasses import dataclass
from functools import partial
from itertools import compress
from typing import Protocol, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt
from nidaqmx._lib import DaqFunctionImporter, lib_importer
from nidaqmx.error_codes import DAQmxErrors as Status

from dragrig.rig import FloatArray
from dragrig.sim_backend.doubles.card import WIDE_ATTRIBUTES, Attribute, AttributeValue, Card, CardError

CFunction: TypeAlias = tuple[tuple[type, ...], Callable[..., int | None]]
"""Types of the arguments, and what is called with them."""

ENCODING = "utf-8"
_INTERNAL_ERROR = -200001
_READ_ARGUMENTS = (c_void_p, c_int32, c_double, c_int32, c_void_p, c_uint32, POINTER(c_int32), c_void_p)
_WRITE_ARGUMENTS = (c_void_p, c_int32, c_uint32, c_double, c_int32, c_void_p, POINTER(c_int32), c_void_p)
# A C function takes integers and floating-point numbers in different registers; on Windows only the position counts.
_VALUE_ARGUMENTS = (c_uint64,) if sys.platform == "win32" else (c_uint64, c_double)
_Element = TypeVar("_Element", bound=np.generic)


@contextmanager
def installed(card: Card) -> Iterator[None]:
    """Let nidaqmx find `card` in place of NI's library within the context; only one at a time in a process.

    Tasks must be closed before it ends.
    """
    library = DaqFunctionImporter(_Library(card))
    replaced = {"_windll": library, "_cdll": library, "_encoding": ENCODING}
    originals = {name: getattr(lib_importer, name) for name in replaced}
    try:
        for name, value in replaced.items():
            setattr(lib_importer, name, value)
        yield
    finally:
        for name, value in originals.items():
            setattr(lib_importer, name, value)


class _Library(ctypes.CDLL):
    """A library whose functions are callbacks; it loads nothing."""

    def __init__(self, card: Card) -> None:
        super().__init__("double of NI-DAQmx", handle=0)
        self._last_error = threading.local()
        functions: Mapping[str, CFunction] = {
            **_task_functions(card),
            **_transfer_functions(card),
            **_attribute_functions(card),
            "GetExtendedErrorInfo": ((c_void_p, c_uint32), self._copy_last_error),
            "SetRuntimeEnvironment": ((c_char_p, c_char_p, c_char_p, c_char_p), lambda *_: None),
        }
        # The callbacks live as long as the library: a pointer to a collected one would crash the process.
        self._callbacks = {
            f"DAQmx{name}": ctypes.CFUNCTYPE(c_int32, *types)(partial(self._status, call))
            for name, (types, call) in functions.items()
        }

    def __getitem__(self, name_or_ordinal: str | int) -> Callable[..., int]:  # type: ignore[override]
        callback = self._callbacks.get(str(name_or_ordinal))
        if callback is None:
            raise AttributeError(name_or_ordinal)
        return self._FuncPtr(ctypes.cast(callback, c_void_p).value or 0)

    def _status(self, call: Callable[..., int | None], *arguments: object) -> int:
        """Return the result of a call, and its errors as status codes."""
        try:
            return call(*arguments) or 0
        except CardError as error:
            self._last_error.message = error.message
            return error.code
        except Exception as error:  # noqa: BLE001 - nothing can be raised through C, and silence would hide it
            self._last_error.message = f"The double of NI-DAQmx failed: {type(error).__name__}: {error}"
            return _INTERNAL_ERROR

    def _copy_last_error(self, place: int, size: int) -> None:
        text = getattr(self._last_error, "message", "").encode(ENCODING)[: size - 1] + b"\0"
        ctypes.memmove(place, text, len(text))


class _Result(Protocol):
    """A pointer to where a result goes."""

    def __setitem__(self, index: int, value: object, /) -> None: ...


@dataclass(frozen=True, slots=True)
class _Unused:
    """An argument of a C function that the double does without."""

    type: type


def _task_functions(card: Card) -> Mapping[str, CFunction]:
    def create(name: bytes, handle: _Result) -> None:
        handle[0] = c_void_p(card.create_task(_decoded(name)))

    def passed(method: Callable[..., None], *arguments: type | _Unused) -> CFunction:
        """Return a function that passes a task and its other arguments to a method, except unused ones."""
        types = tuple(kind.type if isinstance(kind, _Unused) else kind for kind in arguments)
        used = [not isinstance(kind, _Unused) for kind in arguments]

        def call(task: int, *values: bytes | float | None) -> None:
            decoded = (_decoded(value) if isinstance(value, bytes | None) else value for value in values)
            method(task, *compress(decoded, used))

        return (c_void_p, *types), call

    named = (c_char_p, c_char_p)
    unused_number, unused_text = _Unused(c_int32), _Unused(c_char_p)
    encoder = (unused_number, c_uint32, c_double, c_int32, unused_number, c_double, c_double, unused_text)
    volts = (c_double, c_double, unused_number, unused_text)
    return {
        "CreateTask": ((c_char_p, POINTER(c_void_p)), create),
        "ClearTask": passed(card.clear_task),
        "StartTask": passed(card.start),
        "StopTask": passed(card.stop),
        "TaskControl": passed(card.control, c_int32),
        "CfgSampClkTiming": passed(card.cfg_samp_clk_timing, c_char_p, c_double, unused_number, c_int32, c_uint64),
        "CfgDigEdgeStartTrig": passed(card.cfg_dig_edge_start_trig, c_char_p, unused_number),
        "CreateAIVoltageChan": passed(card.create_ai_voltage_chan, *named, c_int32, *volts),
        "CreateAOVoltageChan": passed(card.create_ao_voltage_chan, *named, *volts),
        "CreateCILinEncoderChan": passed(card.create_ci_lin_encoder_chan, *named, *encoder),
        "CreateDIChan": passed(card.create_di_chan, *named, c_int32),
        "CreateDOChan": passed(card.create_do_chan, *named, c_int32),
    }


def _transfer_functions(card: Card) -> Mapping[str, CFunction]:
    def read(call: Callable[[int, int, float, int, FloatArray], int]) -> Callable[..., None]:
        def read_array(
            task: int, samples: int, timeout_s: float, fill: int, place: int, size: int, *out: _Result
        ) -> None:
            with _partial_count(out[0]):
                out[0][0] = c_int32(call(task, samples, timeout_s, fill, _array_at(place, size, np.float64)))

        return read_array

    def read_lines(
        task: int, samples: int, _timeout_s: float, _fill: int, place: int, size: int, *out: _Result
    ) -> None:
        count, lines_per_channel, _ = out
        count[0] = c_int32(card.read_digital_lines(task, samples, _array_at(place, size, np.bool_)))
        lines_per_channel[0] = c_int32(1)

    def write_lines(
        task: int, samples: int, auto_start: int, _timeout_s: float, _layout: int, place: int, *out: _Result
    ) -> None:
        data = _array_at(place, samples * int(str(card.get_attribute(task, Attribute.WRITE_NUM_CHANNELS))), np.bool_)
        out[0][0] = c_int32(card.write_digital_lines(task, samples, bool(auto_start), data))

    def write_volts(
        task: int, samples: int, auto_start: int, timeout_s: float, _layout: int, place: int, *out: _Result
    ) -> None:
        with _partial_count(out[0]):
            volts = _array_at(place, samples, np.float64)
            out[0][0] = c_int32(card.write_analog_f64(task, bool(auto_start), timeout_s, volts))

    return {
        "ReadAnalogF64": (_READ_ARGUMENTS, read(card.read_analog_f64)),
        "ReadCounterF64Ex": (_READ_ARGUMENTS, read(card.read_counter_f64)),
        "ReadDigitalLines": ((*_READ_ARGUMENTS[:-1], POINTER(c_int32), c_void_p), read_lines),
        "WriteDigitalLines": (_WRITE_ARGUMENTS, write_lines),
        "WriteAnalogF64": (_WRITE_ARGUMENTS, write_volts),
    }


def _attribute_functions(card: Card) -> Mapping[str, CFunction]:
    """Return the functions for attributes.

    In C they take any number of arguments; nidaqmx passes whose attribute it is, which attribute, and then a value, or
    a place for it and the place's size.
    """

    def get(*arguments: int | float | bytes) -> int:
        *owner, attribute, place, size = arguments
        subject, channel = _owner(owner)
        value = card.get_attribute(subject, int(attribute), channel)
        return _store_value(value, int(place), int(size), wide=int(attribute) in WIDE_ATTRIBUTES)

    def set_(*arguments: int | float | bytes) -> None:
        count = len(_VALUE_ARGUMENTS)
        (*owner, attribute), values = arguments[:-count], arguments[-count:]
        subject, channel = _owner(owner)
        number, task = int(attribute), int(subject)
        value = _decoded_value(card.get_attribute(task, number, channel), int(values[0]), float(values[-1]))
        card.set_attribute(task, number, value, channel)

    place = (c_void_p, c_uint32)
    owners: dict[str, tuple[type, ...]] = {
        "SystemInfo": (),
        "Device": (c_char_p,),
        "Chan": (c_void_p, c_char_p),
        **dict.fromkeys(("Task", "Read", "Write", "Buffer", "Timing"), (c_void_p,)),
    }
    return {
        **{f"Get{name}Attribute": ((*owner, c_int32, *place), get) for name, owner in owners.items()},
        **{
            f"Set{name}Attribute": ((*owners[name], c_int32, *_VALUE_ARGUMENTS), set_)
            for name in ("Chan", "Read", "Write", "Buffer")
        },
    }


def _owner(arguments: list[int | float | bytes]) -> tuple[int | str, str]:
    """Return the subject of an attribute and its channel."""
    match arguments:
        case [bytes(device)]:
            return _decoded(device), ""
        case [int(task), *channel]:
            return task, "".join(_decoded(name) for name in channel if isinstance(name, bytes))
        case _:
            return "", ""


def _store_value(value: AttributeValue, place: int, size: int, *, wide: bool) -> int:
    """Write a value in the C type of its attribute; return 0, or the size that is needed when called with size 0."""
    match value:
        case int():
            data = struct.pack("=Q" if wide else "=i" if value < 0 else "=I", value)
            needed = size
        case float():
            data, needed = struct.pack("=d", value), size
        case _:
            data = str(value).encode() + b"\0"
            needed = len(data)
    if size < needed:
        if size == 0:
            return needed
        raise CardError(Status.BUFFER_TOO_SMALL_FOR_STRING, f"Buffer is too small: {needed} are needed, {size} given.")
    ctypes.memmove(place, data, len(data))
    return 0


def _decoded_value(present: AttributeValue, whole: int, real: float) -> AttributeValue:
    """Return an argument in the type that the attribute has at present."""
    match present:
        case str():
            return ctypes.string_at(whole).decode()
        case bool():
            return bool(whole & 0xFFFFFFFF)
        case float():
            return real if len(_VALUE_ARGUMENTS) > 1 else float(struct.unpack("=d", struct.pack("=Q", whole))[0])
        case _:
            return c_int32(whole & 0xFFFFFFFF).value


@contextmanager
def _partial_count(count: _Result) -> Iterator[None]:
    """Report how many samples were transferred before an error."""
    try:
        yield
    except CardError as error:
        count[0] = c_int32(error.samples)
        raise


def _array_at(place: int, size: int, element: type[_Element]) -> npt.NDArray[_Element]:
    if size <= 0 or not place:
        return np.zeros(0, element)
    memory = (ctypes.c_char * (size * np.dtype(element).itemsize)).from_address(place)
    return np.frombuffer(memoryview(memory), element)


def _decoded(text: bytes | None) -> str:
    return (text or b"").decode()
