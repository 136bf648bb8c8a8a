"""NI-DAQmx's C functions for attributes, whose last arguments depend on which attribute is asked for.

In C they take any number of arguments; nidaqmx gives at most a value, or a place for it, and the place's size.
"""

import ctypes
import struct
import sys
from collections.abc import Callable, Mapping
from ctypes import c_char_p, c_double, c_int32, c_uint32, c_uint64, c_void_p

from dragrig.sim_backend.doubles.card.attributes import type_of
from dragrig.sim_backend.doubles.card.card import Card, CardError, Value
from dragrig.sim_backend.doubles.card.daqmx import Code
from dragrig.sim_backend.doubles.fronts.c_calls import CFunction

_SCALARS = {"int32": "=i", "uint32": "=I", "uint64": "=Q", "bool": "=I", "double": "=d"}
_READABLE = ("Task", "Read", "Write", "Buffer", "Timing")
_SETTABLE = ("Read", "Write", "Buffer")
# A C function takes a whole number and a real one in different registers, but for Windows, where the place counts.
_VALUE = (c_uint64,) if sys.platform == "win32" else (c_uint64, c_double)


def attribute_functions(card: Card) -> Mapping[str, CFunction]:
    """Return the functions by their names, without DAQmx before them."""
    place = (c_void_p, c_uint32)
    functions: dict[str, CFunction] = {
        "GetSystemInfoAttribute": ((c_int32, *place), _getter(card, "system", lambda: ("", ""))),
        "GetDeviceAttribute": ((c_char_p, c_int32, *place), _getter(card, "device", lambda name: (_text(name), ""))),
        "GetChanAttribute": (
            (c_void_p, c_char_p, c_int32, *place),
            _getter(card, "chan", lambda task, channel: (task, _text(channel))),
        ),
        "SetChanAttribute": ((c_void_p, c_char_p, c_int32, *_VALUE), _setter(card, "chan", _with_channel)),
        "ResetChanAttribute": ((c_void_p, c_char_p, c_int32), _resetter(card, "chan", _with_channel)),
    }
    for name in _READABLE:
        get = _getter(card, name.lower(), lambda task: (task, ""))
        functions[f"Get{name}Attribute"] = ((c_void_p, c_int32, *place), get)
    for name in _SETTABLE:
        functions[f"Set{name}Attribute"] = (
            (c_void_p, c_int32, *_VALUE),
            _setter(card, name.lower(), _without_channel),
        )
        functions[f"Reset{name}Attribute"] = ((c_void_p, c_int32), _resetter(card, name.lower(), _without_channel))
    return functions


def _with_channel(task: int, channel: bytes, *rest: int | float) -> "tuple[int, str, tuple[int | float, ...]]":
    return task, _text(channel), rest


def _without_channel(task: int, *rest: int | float) -> "tuple[int, str, tuple[int | float, ...]]":
    return task, "", rest


def _getter(card: Card, group: str, subject: Callable[..., tuple[int | str, str]]) -> Callable[..., int]:
    def get(*arguments: int) -> int:
        *whose, attribute, place, size = arguments
        kind = _known(group, attribute)
        whom, channel = subject(*whose)
        return _put(card.get_attribute(group, whom, attribute, channel), kind, place, size)

    return get


_Split = Callable[..., "tuple[int, str, tuple[int | float, ...]]"]


def _setter(card: Card, group: str, split: _Split) -> Callable[..., None]:
    def set_(*arguments: int | float) -> None:
        task, channel, (attribute, whole, *real) = split(*arguments)
        kind = _known(group, int(attribute))
        value = _value(kind, int(whole), real[0] if real else None)
        card.set_attribute(group, task, int(attribute), value, channel)

    return set_


def _resetter(card: Card, group: str, split: _Split) -> Callable[..., None]:
    def reset(*arguments: int | float) -> None:
        task, channel, (attribute,) = split(*arguments)
        card.reset_attribute(group, task, int(attribute), channel)

    return reset


def _known(group: str, attribute: int) -> str:
    kind = type_of(group, attribute)
    if kind is None:
        raise CardError(
            Code.ATTRIBUTE_NOT_SUPPORTED,
            f"Specified property is not supported by the device.\n\nProperty: {attribute:#x}",
        )
    return kind


def _put(value: Value, kind: str, place: int, size: int) -> int:
    """Write a value where it is wanted; return 0, or the size that is needed when asked with size 0."""
    if kind in _SCALARS:
        packed = struct.pack(_SCALARS[kind], value)
        ctypes.memmove(place, packed, len(packed))
        return 0
    if isinstance(value, list):
        packed, needed = struct.pack(f"={len(value)}d", *value), len(value)
    else:
        packed = str(value).encode() + b"\0"
        needed = len(packed)
    if size == 0:
        return needed
    if size < needed:
        raise CardError(Code.BUFFER_TOO_SMALL_FOR_STRING, f"Buffer is too small: {needed} are needed, {size} given.")
    ctypes.memmove(place, packed, len(packed))
    return 0


def _value(kind: str, whole: int, real: float | None) -> Value:
    match kind:
        case "string":
            return ctypes.string_at(whole).decode()
        case "double":
            return real if real is not None else float(struct.unpack("=d", struct.pack("=Q", whole))[0])
        case "bool":
            return bool(whole & 0xFFFFFFFF)
        case "int32":
            return c_int32(whole & 0xFFFFFFFF).value
        case "uint32":
            return whole & 0xFFFFFFFF
        case _:
            return whole


def _text(words: bytes | None) -> str:
    return (words or b"").decode()
