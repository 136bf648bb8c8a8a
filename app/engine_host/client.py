"""Starts the engine host, sends it requests and reads its events; nothing here blocks on the host."""

import multiprocessing
from collections.abc import Iterator
from contextlib import suppress

from dragrig.engine_host.messages import (
    RING_SAMPLES,
    SILENCE_TIMEOUT_S,
    Event,
    Heartbeat,
    HostLost,
    LiveRingReader,
    Request,
    RigSelection,
    StopHost,
    shared_memory,
)
from dragrig.engine_host.server import serve

_CLOSE_TIMEOUT_S = 30.0
"""A stage that moves is stopped and its run finished before the process ends."""


class EngineClient:
    """A host in a process of its own, and the way to it; belongs to one thread.

    Parameters
    ----------
    silence_s
        How long the host waits for a sign of life; `beat` is one, as any request.
    samples
        Size of the ring that live samples come through.
    """

    def __init__(self, rig: RigSelection, silence_s: float = SILENCE_TIMEOUT_S, samples: int = RING_SAMPLES) -> None:
        context = multiprocessing.get_context("spawn")
        memory = shared_memory(context, samples)
        self._connection, theirs = context.Pipe()
        self.live = LiveRingReader(memory)
        self._lost = False
        # Not a daemon, which would be killed with us in place of ending in good order.
        self._process = context.Process(
            target=serve, args=(theirs, memory, rig, silence_s), name="dragrig-engine", daemon=False
        )
        self._process.start()
        # Our copy of its end has to go, or it would never notice that we are gone.
        theirs.close()

    @property
    def pid(self) -> int | None:
        """Process id of the host."""
        return self._process.pid

    @property
    def lost(self) -> bool:
        """Whether the host is gone."""
        return self._lost

    def ask(self, request: Request) -> None:
        """Send a request; one to a host that is gone is dropped, and `events` tells of the loss."""
        with suppress(OSError):
            self._connection.send(request)

    def beat(self) -> None:
        """Say that we live."""
        self.ask(Heartbeat())

    def events(self) -> Iterator[Event]:
        """Yield what the host said since the last time; `HostLost` once when it is gone."""
        try:
            while not self._lost and self._connection.poll(0):
                event: Event = self._connection.recv()
                yield event
        except (EOFError, OSError):
            self._lost = True
            self._process.join(5.0)
            yield HostLost(self._process.exitcode)

    def close(self, within_s: float = _CLOSE_TIMEOUT_S) -> None:
        """End the host: a session under way is stopped and its run finished first."""
        self.ask(StopHost())
        self._process.join(within_s)
        self._lost = True
        self._connection.close()
