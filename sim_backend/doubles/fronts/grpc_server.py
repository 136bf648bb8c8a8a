"""A double of NI's gRPC device server on loopback, which the real `nidaqmx` reaches through `Task(grpc_options=…)`.

It speaks the service that `nidaqmx` itself was generated for; what each call does is in `grpc_calls`. As with NI's
server, a task outlives the client that made it: a client that was killed leaves its tasks running, and the next one
attaches to them by their name or finds the card reserved.
"""

from concurrent.futures import ThreadPoolExecutor
from types import TracebackType

from dragrig.config.errors import DeviceError
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.remote.messages import LOOPBACK

UNLIMITED = (("grpc.max_send_message_length", -1), ("grpc.max_receive_message_length", -1))
"""Options of the server and of a channel to it: a long read outgrows gRPC's 4 MB."""
_WORKERS = 16
"""Calls at once; a read that waits for samples takes one."""


class CardServer:
    """The server, serving from `__enter__` to `__exit__`.

    Parameters
    ----------
    card
        What the calls act on.
    port
        TCP port on loopback; 0 for any that is free.

    Raises
    ------
    DeviceError
        When gRPC is not installed or the port is taken.
    """

    def __init__(self, card: Card, port: int = 0) -> None:
        try:
            import grpc

            from dragrig.sim_backend.doubles.fronts.grpc_service import service
        except ImportError as error:
            raise DeviceError(
                f"The card's double for other processes needs gRPC ({error}): pip install dragrig[grpc]."
            ) from error
        self._server = grpc.server(
            ThreadPoolExecutor(_WORKERS, "card"),
            handlers=[service(card)],
            options=[*UNLIMITED, ("grpc.so_reuseport", 0)],
        )
        try:
            self.port = self._server.add_insecure_port(f"{LOOPBACK}:{port}")
        except RuntimeError as error:
            raise DeviceError(f"The card's double cannot listen on {LOOPBACK}:{port}; choose another port.") from error

    def __enter__(self) -> "CardServer":
        self._server.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def stop(self) -> None:
        """End every call at once, as a server that dies; safe to call twice."""
        self._server.stop(grace=None).wait()
