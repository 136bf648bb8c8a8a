"""Access to the card through NI-DAQmx, locally or over an NI gRPC device server, and its errors as plain sentences.

The status codes are those of NIDAQmx.h, listed in `nidaqmx.error_codes`.
"""

import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from socket import gethostname
from threading import Lock
from typing import TYPE_CHECKING, TypeVar

import nidaqmx
import nidaqmx.system
from nidaqmx.errors import (
    DaqError,
    DaqFunctionNotSupportedError,
    DaqNotFoundError,
    DaqNotSupportedError,
    Error,
    RpcError,
)

from dragrig.config import CardSettings, DeviceError, StaleDataError

if TYPE_CHECKING:
    import grpc

SERVER_TIMEOUT_S = 5.0
"""Far longer than any read waits, and than a card takes to be programmed over a network."""
_UNLIMITED_MESSAGES = (("grpc.max_receive_message_length", -1), ("grpc.max_send_message_length", -1))
"""A long read exceeds the 4 MB that gRPC allows a message by default."""

_STOOD_STILL_S = 0.1
"""How much later than its time limit a call ends where not the server was silent, but this program stood still."""
_REPEATABLE = ("ReadDigital", "WriteDigital", "Get", "Set")
"""Beginnings of the calls that may be made twice."""

CallT = TypeVar("CallT")


class Connection:
    """The connection to one card, shared by all tasks on it. Any thread may call any method.

    Parameters
    ----------
    server_timeout_s
        How long a call of a gRPC device server may take before the server counts as gone.
    """

    def __init__(self, card: CardSettings, server_timeout_s: float = SERVER_TIMEOUT_S) -> None:
        self.card = card
        self._server_timeout_s = server_timeout_s
        self._lock = Lock()
        self._channel: grpc.Channel | None = None

    def task(self, role: str = "") -> nidaqmx.Task:
        """Return a new task, which its caller closes; raises the driver's errors.

        Parameters
        ----------
        role
            Purpose of the task. A server keeps the tasks of a program that was killed; by its role the task that this
            computer left there is found and closed first. Without a role it is not.
        """
        if not self.card.server:
            return nidaqmx.Task()
        name = re.sub(r"\W", "_", f"dragrig_{gethostname()}_{self.card.device}_{role}") if role else ""
        options = self._options(name)
        if name:
            nidaqmx.Task(name, grpc_options=options).close()
        return nidaqmx.Task(name, grpc_options=options)

    def device(self) -> nidaqmx.system.Device:
        """Return the card's device object; the driver checks whether it exists only when a property is read."""
        return nidaqmx.system.Device(self.card.device, grpc_options=self._options())

    def terminal(self, name: str) -> str:
        """Return a terminal or channel with the device name in front: `Dev1/ai0`."""
        return f"{self.card.device}/{name}"

    def close(self) -> None:
        """Disconnect from the server; the next task connects again."""
        with self._lock:
            channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()

    def _options(self, session: str = "") -> nidaqmx.GrpcSessionOptions | None:
        if not self.card.server:
            return None
        with self._lock:
            if self._channel is None:
                self._channel = _open_channel(self.card.server, self._server_timeout_s)
            return nidaqmx.GrpcSessionOptions(self._channel, session)


def _open_channel(server: str, timeout_s: float) -> "grpc.Channel":
    """Return a channel on which every call fails that has not returned in time, as if the server were gone."""
    try:
        import grpc
    except ImportError as error:
        raise DeviceError(
            "hardware.card.server names a computer, and gRPC is needed to reach it: install dragrig[grpc]."
        ) from error

    class TimeLimit(grpc.ClientCallDetails):
        timeout = timeout_s  # grpc leaves the call's other details as they are

    class CallTimeout(grpc.UnaryUnaryClientInterceptor):  # type: ignore[type-arg]  # generic in its stubs only
        def intercept_unary_unary(
            self,
            continuation: Callable[[grpc.ClientCallDetails, object], CallT],
            client_call_details: grpc.ClientCallDetails,
            request: object,
        ) -> CallT:
            began_s = time.monotonic()
            outcome = continuation(TimeLimit(), request)
            method = str(client_call_details.method).rpartition("/")[2]
            stood_still = time.monotonic() - began_s > timeout_s + _STOOD_STILL_S
            if stood_still and method.startswith(_REPEATABLE) and _time_was_up(outcome):
                return continuation(TimeLimit(), request)
            return outcome

    channel = grpc.insecure_channel(server, options=_UNLIMITED_MESSAGES)
    return grpc.intercept_channel(channel, CallTimeout())


def _time_was_up(outcome: object) -> bool:
    import grpc

    return isinstance(outcome, grpc.RpcError) and outcome.code() is grpc.StatusCode.DEADLINE_EXCEEDED


def has_lost_reply(error: RpcError) -> bool:
    """Whether a server's reply did not come in time, so that its samples may be lost with it."""
    return getattr(error.rpc_code, "name", "") == "DEADLINE_EXCEEDED"


OVERWRITTEN_CODE = -200279
"""Samples were overwritten in the buffer before they were read."""
READ_TIMEOUT_CODE = -200284
"""A read timed out; what had arrived is there."""

_UNPLUGGED = (
    "card {device} does not answer any more while {doing}: it was unplugged or lost its power; check it, restart \
the computer if it stays away, and look for it in NI MAX (NI-DAQmx {code})."
)
_RESERVED = (
    "card {device} is taken by another program while {doing}: close whatever uses it (another dragrig, LabVIEW, \
test panels of NI MAX) and try again (NI-DAQmx {code})."
)
_TOO_SLOW = "card {device} lost samples while {doing}, because this computer did not read them in time: end other \
programs, or lower sampling.rate_hz (NI-DAQmx {code})."
_TOO_FAST = "card {device} cannot sample so fast while {doing}: lower sampling.rate_hz, or leave out some of \
hardware.card.inputs (NI-DAQmx {code})."
_NO_TERMINAL = (
    "card {device} has no such terminal while {doing}: check the channels, counters, PFI terminals and lines \
under hardware.card against its pinout ({message}; NI-DAQmx {code})."
)
_UNKNOWN_ERROR = "card {device} failed while {doing}: {message} (NI-DAQmx {code}); look at it in NI MAX."

_MESSAGES = {
    -200220: "no card is called {device} (hardware.card.device): look up its name in NI MAX, or put the card in \
(NI-DAQmx {code}).",
    **dict.fromkeys((-201003, -88705, -88708, -200324, -50101), _UNPLUGGED),
    **dict.fromkeys((-50103, -200022, -200587, -201105, -89137), _RESERVED),
    **dict.fromkeys(
        (-200361, -200141, -200010, -209829, -200714, -200613, -200222, -200283, OVERWRITTEN_CODE), _TOO_SLOW
    ),
    **dict.fromkeys((-200332, -200081, -200019), _TOO_FAST),
    **dict.fromkeys((-200170, -200431, -200430, -89120, -89125), _NO_TERMINAL),
}


@contextmanager
def driver_errors_wrapped(card: CardSettings, doing: str) -> Iterator[None]:
    """Turn the driver's errors inside into a `DeviceError`.

    Parameters
    ----------
    doing
        The present action, to follow the word while: "it is armed", "it samples", ….
    """
    try:
        yield
    except driver_errors() as error:
        raise device_error(error, card, doing) from error


def driver_errors() -> tuple[type[Exception], ...]:
    """Return the errors that a call of `nidaqmx` may raise; gRPC's own error only where gRPC is in use."""
    grpc = sys.modules.get("grpc")
    return (Error,) if grpc is None else (Error, grpc.RpcError)


def device_error(error: Exception, card: CardSettings, doing: str) -> DeviceError:
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
            text = _MESSAGES.get(error.error_code, _UNKNOWN_ERROR).format(
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


def no_samples_error(card: CardSettings, silent_s: float) -> StaleDataError:
    """Return the error of a card that answers, but delivers no sample."""
    return StaleDataError(
        f"card {card.device} delivered no sample for {silent_s:g} s (guard.stale_data_s): check its sample clock, and "
        "whether this computer is overloaded."
    )


def _first_sentence(error: Exception) -> str:
    first = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
    return first.split(". ")[0].rstrip(".")
