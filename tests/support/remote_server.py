"""The process of the doubles: NI's gRPC device server, the drive's port and a control socket, all on loopback.

It is started as a script with `--rig FILE`, prints one line of JSON with its ports when it is ready, and ends when its
standard input is closed, which the end of the process that started it does, or when the control socket says so.
"""

import gc
import os
import socketserver
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import asdict, fields
from pathlib import Path
from threading import Event as Signal
from types import TracebackType
from typing import Self

import click
from pydantic import JsonValue, TypeAdapter, ValidationError

from card_server import LOOPBACK, CardServer
from dragrig.config.errors import DragrigError, SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.config.settings import find_settings, read_settings_file, suggestion
from dragrig.rig.devices import Acquisition
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.drive_double import DriveDouble, make_drive_double
from dragrig.sim_backend.doubles.simulated_bench import ActiveFaults, DoubleClock, FaultInjector, SimulatedBench
from drive_ports import SocketPort
from remote_doubles import (
    REQUEST_ADAPTER,
    ControlReply,
    ControlRequest,
    DoublePorts,
    GetStageStatus,
    PresentAcquisition,
    SetFaults,
    ShutDown,
    StageStatus,
)

_FAULTS_ADAPTER = TypeAdapter(ActiveFaults)


class ControlServer:
    """Answers one JSON line with another, for any number of callers at once, while its context lasts.

    Parameters
    ----------
    faults
        What callers change.
    present, look
        What carries out the request of the same name.
    end
        Set when a caller wants the process to end.
    """

    def __init__(
        self,
        faults: FaultInjector,
        present: Callable[[Acquisition], None],
        look: Callable[[], StageStatus],
        end: Signal,
    ) -> None:
        self._faults = faults
        self._present = present
        self._look = look
        self._end = end
        self._server = _ControlSocketServer((LOOPBACK, 0), self.reply)

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

    def reply(self, line: bytes) -> ControlReply:
        """Carry out the request in a line."""
        try:
            return self._carry_out(REQUEST_ADAPTER.validate_json(line))
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(str(part) for part in first["loc"]) or "request"
            return ControlReply(error=f"Control of the doubles, {place}: {first['msg']}; see messages.py.")
        except DragrigError as error:
            return ControlReply(error=str(error))

    def _carry_out(self, request: ControlRequest) -> ControlReply:
        match request:
            case SetFaults():
                inject_faults(self._faults, request.faults)
            case PresentAcquisition():
                self._present(request.acquisition.acquisition())
            case GetStageStatus():
                return ControlReply(stage=self._look())
            case ShutDown():
                self._end.set()
        return ControlReply()


def inject_faults(faults: FaultInjector, changes: Mapping[str, JsonValue]) -> None:
    """Change the named attributes of `ActiveFaults`; raises `SettingsError` for a name or value that there is not."""
    names = [field.name for field in fields(ActiveFaults)]
    for name in changes:
        if name not in names:
            raise SettingsError(f"fault {name!r}: there is none of this name; {suggestion(name, names)}")
    try:
        faults.replace(_FAULTS_ADAPTER.validate_python({**asdict(faults.active), **changes}))
    except ValidationError as error:
        first = error.errors()[0]
        raise SettingsError(f"fault {first['loc'][0]}: {first['msg']}; see Trouble in faults.py.") from error


class _ControlSocketServer(socketserver.ThreadingTCPServer):
    daemon_threads = True

    def __init__(self, address: tuple[str, int], reply: Callable[[bytes], ControlReply]) -> None:
        self.reply = reply
        super().__init__(address, _ControlHandler)


class _ControlHandler(socketserver.StreamRequestHandler):
    server: _ControlSocketServer

    def handle(self) -> None:
        try:
            for line in self.rfile:
                self.wfile.write(self.server.reply(line).model_dump_json().encode() + b"\n")
        except OSError:
            return  # the caller went away, killed perhaps: nobody is left to answer


def stage_status(drive: DriveDouble) -> StageStatus:
    """Look at the stage of a drive's double."""
    status, bench = drive.status, drive.bench
    return StageStatus(
        position_mm=bench.position_mm(),
        speed_mm_s=bench.speed_mm_s(),
        moving=status.moving,
        enabled=status.enabled,
        homed=status.homed,
        halt=status.halt,
    )


def serve(rig: RigSettings, model: FrictionModelSettings, pace: float) -> None:
    """Let the doubles live until standard input ends or the control socket says so; raises `DragrigError`."""
    end = Signal()
    bench = SimulatedBench(rig, model, DoubleClock(pace))

    with ExitStack() as opened:
        card = opened.enter_context(CardServer(Card(bench)))
        drive = opened.enter_context(make_drive_double(bench))
        port = opened.enter_context(SocketPort(drive))
        control = opened.enter_context(ControlServer(bench.faults, bench.present, lambda: stage_status(drive), end))
        threading.Thread(target=_end_with_parent, args=(end,), name="parent", daemon=True).start()
        # A full collection would hold up every answer, on a busy machine for seconds.
        gc.collect()
        gc.freeze()
        click.echo(DoublePorts(card=card.port, drive=port.address, control=control.port).model_dump_json())
        sys.stdout.flush()
        end.wait()


def _end_with_parent(end: Signal) -> None:
    # Not through sys.stdin, whose lock a thread that waits in it would keep until after the interpreter's end.
    while os.read(0, 4096):
        pass
    end.set()


@click.command()
@click.option("--rig", type=click.Path(dir_okay=False, path_type=Path), required=True, help="Rig settings.")
@click.option("--model", default="paper", show_default=True, help="Friction model, a file or a shipped name.")
@click.option("--pace", default=1.0, show_default=True, type=click.FloatRange(0, min_open=True), help="Clock's pace.")
def main(rig: Path, model: str, pace: float) -> None:
    """Serve doubles of card and drive on loopback until standard input ends."""
    try:
        serve(read_settings_file(RigSettings, rig), find_settings(FrictionModelSettings, "model", model), pace)
    except DragrigError as error:
        click.echo(str(error), err=True)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
