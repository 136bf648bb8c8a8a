"""The control socket of doubles in a process of their own: sets mishaps, looks at the stage, presents contacts."""

import socketserver
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields
from threading import Event as Signal
from types import TracebackType
from typing import Self

from pydantic import JsonValue, TypeAdapter, ValidationError

from dragrig.config.errors import DragrigError, SettingsError
from dragrig.config.loading import nearest
from dragrig.rig.devices import Acquisition
from dragrig.sim_backend.doubles.remote.messages import (
    LOOPBACK,
    REQUEST,
    LookAtStage,
    Present,
    Reply,
    Request,
    SetMishaps,
    ShutDown,
    StageLook,
)
from dragrig.sim_backend.doubles.world.mishaps import Mishaps, Trouble

_TROUBLE = TypeAdapter(Trouble)


class ControlServer:
    """Answers one JSON line with another, for any number of callers at once, while its context lasts.

    Parameters
    ----------
    mishaps
        What callers change.
    present, look
        What carries out the request of the same name.
    end
        Set when a caller wants the process to end.
    """

    def __init__(
        self, mishaps: Mishaps, present: Callable[[Acquisition], None], look: Callable[[], StageLook], end: Signal
    ) -> None:
        self._mishaps = mishaps
        self._present = present
        self._look = look
        self._end = end
        self._server = _Server((LOOPBACK, 0), self.reply)

    @property
    def port(self) -> int:
        """TCP port on loopback."""
        return int(self._server.server_address[1])

    def __enter__(self) -> Self:
        threading.Thread(target=self._server.serve_forever, args=(0.05,), name="control", daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._server.server_close()

    def reply(self, line: bytes) -> Reply:
        """Carry out the request in a line."""
        try:
            return self._carry_out(REQUEST.validate_json(line))
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(str(part) for part in first["loc"]) or "request"
            return Reply(error=f"Control of the doubles, {place}: {first['msg']}; see messages.py.")
        except DragrigError as error:
            return Reply(error=str(error))

    def _carry_out(self, request: Request) -> Reply:
        match request:
            case SetMishaps():
                strike(self._mishaps, request.mishaps)
            case Present():
                self._present(request.acquisition.acquisition())
            case LookAtStage():
                return Reply(stage=self._look())
            case ShutDown():
                self._end.set()
        return Reply()


def strike(mishaps: Mishaps, changes: Mapping[str, JsonValue]) -> None:
    """Change the named attributes of `Trouble`; raises `SettingsError` for a name or value that there is not."""
    names = [field.name for field in fields(Trouble)]
    for name in changes:
        if name not in names:
            raise SettingsError(f"mishap {name!r}: there is none of this name; {nearest(name, names)}")
    try:
        mishaps.become(_TROUBLE.validate_python({**asdict(mishaps.now), **changes}))
    except ValidationError as error:
        first = error.errors()[0]
        raise SettingsError(f"mishap {first['loc'][0]}: {first['msg']}; see Trouble in mishaps.py.") from error


class _Server(socketserver.ThreadingTCPServer):
    daemon_threads = True

    def __init__(self, address: tuple[str, int], reply: Callable[[bytes], Reply]) -> None:
        self.reply = reply
        super().__init__(address, _Caller)


class _Caller(socketserver.StreamRequestHandler):
    server: _Server

    def handle(self) -> None:
        try:
            for line in self.rfile:
                self.wfile.write(self.server.reply(line).model_dump_json().encode() + b"\n")
        except OSError:
            return  # the caller went away, killed perhaps: nobody is left to answer
