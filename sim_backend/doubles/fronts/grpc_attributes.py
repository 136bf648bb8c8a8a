"""The attribute calls of NI's gRPC service: hundreds of attributes through a few dozen calls of one pattern."""

import re
from collections.abc import Callable

from google.protobuf.message import Message
from nidaqmx._stubs import nidaqmx_pb2 as pb
from session_pb2 import Session

from dragrig.sim_backend.doubles.card.card import Card, Value

Call = Callable[[Message], Message]

_NAME = re.compile("(?P<what>Get|Set|Reset)(?P<group>[A-Z][A-Za-z]+?)Attribute(Ex)?(?P<type>[A-Z][A-Za-z0-9]*)?")
_GROUPS = {
    "Task": "task",
    "Chan": "chan",
    "Read": "read",
    "Write": "write",
    "Buffer": "buffer",
    "Timing": "timing",
    "Device": "device",
    "SystemInfo": "system",
    "PhysicalChan": "physical_chan",
}


class Attributes:
    """The attributes of one card.

    Parameters
    ----------
    task
        Returns the handle of a session's task.
    """

    def __init__(self, card: Card, task: Callable[[Session], int]) -> None:
        self._card = card
        self._task = task

    def find(self, method: str) -> Call | None:
        """Return what carries out a call; None when it is none of an attribute that the card has."""
        name = _NAME.fullmatch(method)
        group = _GROUPS.get(name["group"]) if name else None
        if name is None or group is None:
            return None
        respond = message(method, "Response")
        match name["what"]:
            case "Get":
                return lambda request: _filled(respond(), self._get(group, request))
            case "Set":
                return lambda request: self._set(group, request, respond())
            case _:
                return lambda request: self._reset(group, request, respond())

    def _get(self, group: str, request: Message) -> Value:
        subject = self._handle(request) if _has(request, "task") else _text(request, "device_name", "physical_channel")
        return self._card.get_attribute(group, subject, _attribute(request), _text(request, "channel"))

    def _set(self, group: str, request: Message, response: Message) -> Message:
        value = getattr(request, _value_field(request))
        held: Value = value if isinstance(value, int | float | str) else list(value)
        self._card.set_attribute(group, self._handle(request), _attribute(request), held, _text(request, "channel"))
        return response

    def _reset(self, group: str, request: Message, response: Message) -> Message:
        self._card.reset_attribute(group, self._handle(request), _attribute(request), _text(request, "channel"))
        return response

    def _handle(self, request: Message) -> int:
        session = getattr(request, "task")  # noqa: B009 - the field is there in every message of these calls
        return self._task(session)


def message(method: str, kind: str) -> type[Message]:
    """Return the class of a call's messages; kind is Request or Response."""
    found: type[Message] = getattr(pb, method + kind)
    return found


def _filled(response: Message, value: Value) -> Message:
    if isinstance(value, list):
        getattr(response, _value_field(response)).extend(value)
    else:
        setattr(response, _value_field(response), value)
    return response


def _value_field(of: Message) -> str:
    # Enumerated values come in two fields, of which the raw one takes any number.
    return "value_raw" if _has(of, "value_raw") else "value"


def _attribute(request: Message) -> int:
    return int(getattr(request, "attribute_raw", 0))


def _text(request: Message, *fields: str) -> str:
    return next((str(getattr(request, field)) for field in fields if _has(request, field)), "")


def _has(of: Message, field: str) -> bool:
    return field in of.DESCRIPTOR.fields_by_name
