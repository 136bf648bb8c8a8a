"""How the card is reached: through the driver of this computer, or through an NI gRPC device server in another."""

import re
from socket import gethostname
from threading import Lock
from types import ModuleType
from typing import TYPE_CHECKING

import nidaqmx
import nidaqmx.system

from dragrig.config.errors import DeviceError
from dragrig.config.hardware import CardSettings

if TYPE_CHECKING:
    import grpc

ANSWERS_WITHIN_S = 5.0
"""Far longer than any read waits, and than a card takes to be programmed over a network."""
_UNBOUNDED = (("grpc.max_receive_message_length", -1), ("grpc.max_send_message_length", -1))


class Connection:
    """One way to one card, shared by every task on it. Any thread may call anything.

    Parameters
    ----------
    answers_within_s
        How long a call may take at a server before it counts as gone.
    """

    def __init__(self, card: CardSettings, answers_within_s: float = ANSWERS_WITHIN_S) -> None:
        self._card = card
        self._answers_within_s = answers_within_s
        self._lock = Lock()
        self._channel: grpc.Channel | None = None

    @property
    def card(self) -> CardSettings:
        """The card's wiring."""
        return self._card

    def task(self, role: str = "") -> nidaqmx.Task:
        """Return a new task, which its caller closes; raises what the driver raises.

        Parameters
        ----------
        role
            What the task is for, one at a time each. A server keeps the tasks of a program that was killed; by its role
            the task that this computer left there is found and closed first. One without a role stays there.
        """
        if not self._card.server:
            return nidaqmx.Task()
        name = re.sub(r"\W", "_", f"dragrig_{gethostname()}_{self._card.device}_{role}") if role else ""
        options = self._options(name)
        if name:
            nidaqmx.Task(name, grpc_options=options).close()
        return nidaqmx.Task(name, grpc_options=options)

    def device(self) -> nidaqmx.system.Device:
        """Return the card as the driver knows it; whether it is there shows when it is asked something."""
        return nidaqmx.system.Device(self._card.device, grpc_options=self._options())

    def terminal(self, name: str) -> str:
        """Return a terminal or channel with the card before it: `Dev1/ai0`."""
        return f"{self._card.device}/{name}"

    def close(self) -> None:
        """Let go of the server; the next task connects again."""
        with self._lock:
            channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()

    def _options(self, session: str = "") -> nidaqmx.GrpcSessionOptions | None:
        if not self._card.server:
            return None
        grpc = _grpc()
        with self._lock:
            if self._channel is None:
                from dragrig.rig.hardware.card.deadline import Deadline

                channel = grpc.insecure_channel(self._card.server, options=_UNBOUNDED)
                self._channel = grpc.intercept_channel(channel, Deadline(self._answers_within_s))
            return nidaqmx.GrpcSessionOptions(self._channel, session)


def _grpc() -> ModuleType:
    try:
        import grpc
    except ImportError as error:
        raise DeviceError(
            "hardware.card.server names a computer, and to reach it gRPC is needed: install dragrig[grpc]."
        ) from error
    return grpc
