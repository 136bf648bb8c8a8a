"""What NI-DAQmx and its gRPC server refuse, as one sentence with what to do.

The status codes are those of NIDAQmx.h, listed in `nidaqmx.error_codes`.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from nidaqmx.errors import (
    DaqError,
    DaqFunctionNotSupportedError,
    DaqNotFoundError,
    DaqNotSupportedError,
    Error,
    RpcError,
)

from dragrig.config.errors import DeviceError, StaleDataError
from dragrig.config.hardware import CardSettings

OVERWRITTEN = -200279
"""Samples were overwritten in the buffer before they were read."""
NOT_YET_THERE = -200284
"""A read timed out; what had arrived is there."""

_GONE = "card {device} does not answer any more while {doing}: it was unplugged or lost its power; check it, restart \
the computer if it stays away, and look for it in NI MAX (NI-DAQmx {code})."
_TAKEN = "card {device} is taken by another program while {doing}: close whatever uses it (another dragrig, LabVIEW, \
test panels of NI MAX) and try again (NI-DAQmx {code})."
_TOO_SLOW = "card {device} lost samples while {doing}, because this computer did not fetch them in time: end other \
programs, or lower sampling.rate_hz (NI-DAQmx {code})."
_TOO_FAST = "card {device} cannot sample so fast while {doing}: lower sampling.rate_hz, or leave out some of \
hardware.card.inputs (NI-DAQmx {code})."
_NO_TERMINAL = (
    "card {device} has no such terminal while {doing}: check the channels, counters, PFI terminals and lines \
under hardware.card against its pinout ({message}; NI-DAQmx {code})."
)
_OTHER = "card {device} failed while {doing}: {message} (NI-DAQmx {code}); look at it in NI MAX."

_SENTENCES = {
    -200220: "no card is called {device} (hardware.card.device): look up its name in NI MAX, or put the card in \
(NI-DAQmx {code}).",
    **dict.fromkeys((-201003, -88705, -88708, -200324, -50101), _GONE),
    **dict.fromkeys((-50103, -200022, -200587, -201105, -89137), _TAKEN),
    **dict.fromkeys((-200361, -200141, -200010, -209829, -200714, -200613, -200222, -200283, OVERWRITTEN), _TOO_SLOW),
    **dict.fromkeys((-200332, -200081, -200019), _TOO_FAST),
    **dict.fromkeys((-200170, -200431, -200430, -89120, -89125), _NO_TERMINAL),
}


@contextmanager
def told_in_words(card: CardSettings, doing: str) -> Iterator[None]:
    """Turn what the driver raises inside into a `DeviceError`.

    Parameters
    ----------
    doing
        What is being done, to follow the word while: "it is armed", "it samples", ….
    """
    try:
        yield
    except driver_errors() as error:
        raise in_words(error, card, doing) from error


def driver_errors() -> tuple[type[Exception], ...]:
    """Return what a call of `nidaqmx` may raise; gRPC's own error only where gRPC is in use."""
    grpc = sys.modules.get("grpc")
    return (Error,) if grpc is None else (Error, grpc.RpcError)


def in_words(error: Exception, card: CardSettings, doing: str) -> DeviceError:
    """Return a driver's error as a person's sentence."""
    device = f"{card.device} at {card.server}" if card.server else card.device
    match error:
        case DaqNotFoundError():
            text = (
                f"NI-DAQmx, the driver that card {device} needs, is not installed on this computer: install it from "
                "ni.com/downloads, name the computer that has the card in hardware.card.server, or add --double to try "
                "without a card."
            )
        case DaqNotSupportedError():
            text = (
                f"NI-DAQmx, the driver that card {device} needs, does not exist for {sys.platform}: use Windows or "
                "Linux, or name the computer that has the card in hardware.card.server."
            )
        case DaqFunctionNotSupportedError():
            text = f"the NI-DAQmx on this computer is too old for card {device}: update it from ni.com/downloads."
        case DaqError():
            text = _SENTENCES.get(error.error_code, _OTHER).format(
                device=device, doing=doing, code=error.error_code, message=_first_sentence(error)
            )
        case RpcError():
            text = (
                f"no NI gRPC device server answers at {card.server} (hardware.card.server) while {doing}: start it "
                f"there, or check address and firewall ({_first_sentence(error)})."
            )
        case _:
            text = f"card {device} failed while {doing}: {_first_sentence(error)}; look at it in NI MAX."
    return DeviceError(text)


def silent(card: CardSettings, silent_s: float) -> StaleDataError:
    """Return the error of a card that answers, but delivers no sample."""
    return StaleDataError(
        f"card {card.device} delivered no sample for {silent_s:g} s (guard.stale_data_s): check its sample clock, and "
        "whether this computer is overloaded."
    )


def _first_sentence(error: Exception) -> str:
    first = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
    return first.split(". ")[0].rstrip(".")
