"""NI-DAQmx's C functions, but for attributes: their arguments' types, and what they do on the card's double."""

import ctypes
from collections.abc import Callable, Mapping
from ctypes import POINTER, c_char_p, c_double, c_int32, c_uint32, c_uint64, c_void_p
from typing import Protocol, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.sim_backend.doubles.card.attributes import Write
from dragrig.sim_backend.doubles.card.card import Card, CardError

CFunction: TypeAlias = tuple[tuple[type, ...], Callable[..., int | None]]
"""Types of the arguments, and what is called with them."""

_READ = (c_void_p, c_int32, c_double, c_int32, c_void_p, c_uint32, POINTER(c_int32), c_void_p)
_WRITE = (c_void_p, c_int32, c_uint32, c_double, c_int32, c_void_p, POINTER(c_int32), c_void_p)
_Element = TypeVar("_Element", bound=np.generic)
_SCALAR = (c_void_p, c_double, POINTER(c_double), c_void_p)


class _Place(Protocol):
    """A pointer to where an answer goes."""

    def __setitem__(self, index: int, value: object, /) -> None: ...


def call_functions(card: Card) -> Mapping[str, CFunction]:
    """Return the functions by their names, without DAQmx before them."""
    return {
        **_of_tasks(card),
        **_of_channels(card),
        **_of_reading(card),
        **_of_digital_lines(card),
        **_of_writing(card),
    }


def _of_tasks(card: Card) -> Mapping[str, CFunction]:
    def create(name: bytes, handle: _Place) -> None:
        handle[0] = c_void_p(card.create_task(_text(name)))

    def is_done(task: int, done: _Place) -> None:
        done[0] = c_uint32(card.is_task_done(task))

    def configure(task: int, source: bytes, rate_hz: float, edge: int, quantity: int, samples: int) -> None:
        card.cfg_samp_clk_timing(task, _text(source), rate_hz, edge, quantity, samples)

    def trigger(task: int, source: bytes, edge: int) -> None:
        card.cfg_dig_edge_start_trig(task, _text(source), edge)

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
        "ResetDevice": ((c_char_p,), lambda device: card.reset_device(_text(device))),
        "SetRuntimeEnvironment": ((c_char_p, c_char_p, c_char_p, c_char_p), lambda *_: None),
    }


def _of_channels(card: Card) -> Mapping[str, CFunction]:
    def analog_input(
        task: int, place: bytes, name: bytes, terminals: int, low: float, high: float, units: int, scale: bytes
    ) -> None:
        card.create_ai_voltage_chan(task, _text(place), _text(name), terminals, low, high, units, _text(scale))

    def analog_output(task: int, place: bytes, name: bytes, low: float, high: float, units: int, scale: bytes) -> None:
        card.create_ao_voltage_chan(task, _text(place), _text(name), low, high, units, _text(scale))

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
            task, _text(counter), _text(name), decoding, bool(z_enable), z_value, z_phase, units, distance, start,
            _text(scale),
        )  # fmt: skip

    def lines_in(task: int, lines: bytes, name: bytes, grouping: int) -> None:
        card.create_di_chan(task, _text(lines), _text(name), grouping)

    def lines_out(task: int, lines: bytes, name: bytes, grouping: int) -> None:
        card.create_do_chan(task, _text(lines), _text(name), grouping)

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


def _of_reading(card: Card) -> Mapping[str, CFunction]:
    def many(read: Callable[[int, int, float, int, FloatArray], int]) -> Callable[..., None]:
        def call(
            task: int, samples: int, timeout_s: float, fill: int, place: int, size: int, count: _Place, _: object
        ) -> None:
            out = _array(place, size, np.float64)
            count[0] = _counted(count, lambda: read(task, samples, timeout_s, fill, out))

        return call

    def one(read: Callable[[int, float], float]) -> Callable[..., None]:
        def call(task: int, timeout_s: float, value: _Place, _: object) -> None:
            value[0] = c_double(read(task, timeout_s))

        return call

    return {
        "ReadAnalogF64": (_READ, many(card.read_analog_f64)),
        "ReadCounterF64Ex": (_READ, many(card.read_counter_f64)),
        "ReadAnalogScalarF64": (_SCALAR, one(card.read_analog_scalar_f64)),
        "ReadCounterScalarF64": (_SCALAR, one(card.read_counter_scalar_f64)),
    }


def _of_digital_lines(card: Card) -> Mapping[str, CFunction]:
    def read_lines(
        task: int, samples: int, _timeout_s: float, fill: int, place: int, size: int, count: _Place, width: _Place,
        _: object,
    ) -> None:  # fmt: skip
        out = _array(place, size, np.bool_)
        got, lines = card.read_digital_lines(task, samples, fill, out)
        count[0], width[0] = c_int32(got), c_int32(lines)

    def read_words(
        task: int, samples: int, _timeout_s: float, fill: int, place: int, size: int, count: _Place, _: object
    ) -> None:
        words = card.read_digital_u32(task, samples, fill)[:size]
        _array(place, size, np.uint32)[: len(words)] = words
        count[0] = c_int32(max(samples, 1))

    def read_word(task: int, _timeout_s: float, value: _Place, _: object) -> None:
        value[0] = c_uint32(card.read_digital_u32(task, 1, 0)[0])

    def write_lines(
        task: int, samples: int, auto_start: int, _timeout_s: float, layout: int, place: int, count: _Place, _: object
    ) -> None:
        lines = _whole(card, task, Write.NUM_CHANNELS) * _whole(card, task, Write.LINES_PER_CHANNEL)
        data: BoolArray = _array(place, samples * lines, np.bool_)
        count[0] = _counted(count, lambda: card.write_digital_lines(task, samples, bool(auto_start), layout, data))

    def write_words(
        task: int, samples: int, auto_start: int, _timeout_s: float, layout: int, place: int, count: _Place, _: object
    ) -> None:
        words = _array(place, samples * _whole(card, task, Write.NUM_CHANNELS), np.uint32).tolist()
        count[0] = _counted(count, lambda: card.write_digital_u32(task, samples, bool(auto_start), layout, words))

    def write_word(task: int, auto_start: int, _timeout_s: float, value: int, _: object) -> None:
        card.write_digital_u32(task, 1, bool(auto_start), 0, [value])

    return {
        "ReadDigitalLines": ((*_READ[:-1], POINTER(c_int32), c_void_p), read_lines),
        "ReadDigitalU32": (_READ, read_words),
        "ReadDigitalScalarU32": ((c_void_p, c_double, POINTER(c_uint32), c_void_p), read_word),
        "WriteDigitalLines": (_WRITE, write_lines),
        "WriteDigitalU32": (_WRITE, write_words),
        "WriteDigitalScalarU32": ((c_void_p, c_uint32, c_double, c_uint32, c_void_p), write_word),
    }


def _of_writing(card: Card) -> Mapping[str, CFunction]:
    def write(
        task: int, samples: int, auto_start: int, timeout_s: float, layout: int, place: int, count: _Place, _: object
    ) -> None:
        volts = _array(place, samples * _whole(card, task, Write.NUM_CHANNELS), np.float64)
        count[0] = _counted(
            count, lambda: card.write_analog_f64(task, samples, bool(auto_start), timeout_s, layout, volts)
        )

    def write_one(task: int, auto_start: int, timeout_s: float, value: float, _: object) -> None:
        card.write_analog_f64(task, 1, bool(auto_start), timeout_s, 0, np.array([value]))

    return {
        "WriteAnalogF64": (_WRITE, write),
        "WriteAnalogScalarF64": ((c_void_p, c_uint32, c_double, c_double, c_void_p), write_one),
    }


def _whole(card: Card, task: int, attribute: Write) -> int:
    return int(str(card.get_attribute("write", task, attribute)))


def _counted(count: _Place, call: Callable[[], int]) -> c_int32:
    try:
        return c_int32(call())
    except CardError as error:
        count[0] = c_int32(error.samples)
        raise


def _array(place: int, size: int, element: type[_Element]) -> npt.NDArray[_Element]:
    if size <= 0 or not place:
        return np.zeros(0, element)
    memory = (ctypes.c_char * (size * np.dtype(element).itemsize)).from_address(place)
    return np.frombuffer(memoryview(memory), element)


def _text(words: bytes | None) -> str:
    return (words or b"").decode()
