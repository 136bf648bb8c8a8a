"""Starts the engine host, sends it requests and reads its events; nothing here blocks on the host."""

import multiprocessing
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing.connection import Connection

from dragrig.engine_host import messages

_CLOSE_TIMEOUT_S = 30.0
"""Time for a moving stage to stop and its run to be finished."""


def _serve(
    connection: "Connection[messages.Event, messages.Request]",
    memory: messages.RingMemory,
    rig: messages.RigSelection,
    silence: messages.SilenceLimits,
) -> None:
    """Load the engine and host it: the host's process does, the client's never."""
    from dragrig.engine_host.server import serve

    serve(connection, memory, rig, silence)


class EngineClient:
    """Starts a host process and talks to it; belongs to one thread.

    Parameters
    ----------
    silence
        How long the host goes on without a request; `beat` is one, due every `HEARTBEAT_S`. A program that cannot give
        it while it computes says so here, and sees itself to it that the stage can be stopped.
    """

    def __init__(self, rig: messages.RigSelection, silence: messages.SilenceLimits = messages.SILENCE_LIMITS) -> None:
        context = multiprocessing.get_context("spawn")
        memory = messages.shared_memory(context)
        self._connection, host_end = context.Pipe()
        self.live = messages.LiveRingReader(memory)
        self.lost = False
        """Whether the host is gone."""
        # Not a daemon, which would be killed with this process in place of ending in good order.
        self._process = context.Process(
            target=_serve, args=(host_end, memory, rig, silence), name="dragrig-engine", daemon=False
        )
        self._process.start()
        # Without this the host would never notice that this process is gone.
        host_end.close()

    @property
    def pid(self) -> int | None:
        """Process id of the host."""
        return self._process.pid

    def ask(self, request: messages.Request) -> None:
        """Send a request; to a lost host it is dropped, and `events` yields the loss."""
        with suppress(OSError):
            self._connection.send(request)

    def beat(self) -> None:
        """Send a sign of life."""
        self.ask(messages.Heartbeat())

    def events(self) -> Iterator[messages.Event]:
        """Yield new events; `HostLost` once when the host is gone."""
        try:
            while not self.lost and self._connection.poll(0):
                event: messages.Event = self._connection.recv()
                yield event
        except (EOFError, OSError):
            self.lost = True
            self._process.join(5.0)
            yield messages.HostLost(self._process.exitcode)

    def close(self, within_s: float = _CLOSE_TIMEOUT_S) -> None:
        """End the host; a running session is stopped and its run finished first."""
        self.ask(messages.StopHost())
        self._process.join(within_s)
        self.lost = True
        self._connection.close()
