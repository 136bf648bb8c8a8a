"""The PCI-6229's terminals by name, as settings spell them: without the device (NI 622x Specifications, pinout)."""

import re
from collections.abc import Iterable
from typing import Annotated

from pydantic import AfterValidator

_LARGEST_LINES = {0: 31, 1: 7, 2: 7}


def _numbered(text: str, pattern: str, largest: int) -> int | None:
    found = re.fullmatch(pattern + r"(\d{1,2})", text)
    return int(found[1]) if found and int(found[1]) <= largest else None


def _analog_input(channel: str) -> str:
    number = _numbered(channel, "ai", 31)
    if number is None or number % 16 > 7:
        raise ValueError(
            "must be the positive input of a differential pair, ai0 to ai7 or ai16 to ai23, without the device's name"
        )
    return channel


def _analog_output(channel: str) -> str:
    if _numbered(channel, "ao", 3) is None:
        raise ValueError("must be an analog output, ao0 to ao3, without the device's name")
    return channel


def _counter(name: str) -> str:
    if _numbered(name, "ctr", 1) is None:
        raise ValueError("must be a counter, ctr0 or ctr1, without the device's name")
    return name


def _input_terminal(name: str) -> str:
    if _numbered(name, "PFI", 15) is None:
        raise ValueError("must be an input terminal, PFI0 to PFI15, without the device's name")
    return name


def _line(name: str) -> str:
    port, _, number = name.removeprefix("port").partition("/line")
    port_known = name.startswith("port") and port in {str(one) for one in _LARGEST_LINES}
    if not port_known or _numbered(number, "", _LARGEST_LINES[int(port)]) is None:
        raise ValueError("must be a digital line such as port1/line0, without the device's name; empty if not wired")
    return name


def _or_empty(name: str) -> str:
    return name and _input_terminal(name)


def _line_or_empty(name: str) -> str:
    return name and _line(name)


AnalogInput = Annotated[str, AfterValidator(_analog_input)]
AnalogOutput = Annotated[str, AfterValidator(_analog_output)]
Counter = Annotated[str, AfterValidator(_counter)]
InputTerminal = Annotated[str, AfterValidator(_input_terminal)]
InputTerminalOrNone = Annotated[str, AfterValidator(_or_empty)]
LineOrNone = Annotated[str, AfterValidator(_line_or_empty)]


def pin(name: str) -> str:
    """Spell a digital line as the input terminal whose pin it shares; any other name as it is.

    Port 1 is PFI0 to PFI7, port 2 is PFI8 to PFI15.
    """
    found = re.fullmatch(r"port([12])/line(\d)", name)
    return f"PFI{8 * (int(found[1]) - 1) + int(found[2])}" if found else name


def used_twice(names: Iterable[str]) -> tuple[str, str] | None:
    """Return two of the names that are one pin of the card, if there are any; empty names are not wired."""
    seen: dict[str, str] = {}
    for name in filter(None, names):
        if pin(name) in seen:
            return seen[pin(name)], name
        seen[pin(name)] = name
    return None
