"""Card, drive and their bench as a process: `python -m dragrig.sim_backend.doubles.remote.serve --rig FILE`.

It prints one line of JSON with its ports (`messages.Ports`) when it is ready, and ends when its standard input is
closed, which the end of the process that started it does, or when the control socket says so.
"""

import os
import sys
import threading
from contextlib import ExitStack
from pathlib import Path
from threading import Event as Signal

import click

from dragrig.config.errors import DragrigError
from dragrig.config.library import find
from dragrig.config.loading import load
from dragrig.config.model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.hardware.dialects.base import find_dialect
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.drive.ports import SocketPort
from dragrig.sim_backend.doubles.drive.velocity import drive_double
from dragrig.sim_backend.doubles.fronts.grpc_server import CardServer
from dragrig.sim_backend.doubles.remote.control import ControlServer
from dragrig.sim_backend.doubles.remote.messages import Ports, StageLook
from dragrig.sim_backend.doubles.world.clock import DoubleClock
from dragrig.sim_backend.doubles.world.world import World


def serve(rig: RigSettings, model: FrictionModelSettings, pace: float) -> None:
    """Let the doubles live until standard input ends or the control socket says so; raises `DragrigError`."""
    end = Signal()
    wired = rig.hardware
    world = World(rig, model, DoubleClock(pace))

    def look() -> StageLook:
        status = drive.status
        return StageLook(
            position_mm=world.position_mm(),
            speed_mm_s=world.speed_mm_s(),
            moving=status.moving,
            enabled=status.enabled,
            homed=status.homed,
            halt=status.halt,
        )

    with ExitStack() as opened:
        card = opened.enter_context(CardServer(Card(world, world.put_out)))
        drive = opened.enter_context(drive_double(world, find_dialect(wired.drive.dialect), wired.drive.station))
        port = opened.enter_context(SocketPort(drive))
        control = opened.enter_context(ControlServer(world.mishaps, world.present, look, end))
        threading.Thread(target=_end_with_parent, args=(end,), name="parent", daemon=True).start()
        click.echo(Ports(card=card.port, drive=port.address, control=control.port).model_dump_json())
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
        serve(load(RigSettings, rig), find(FrictionModelSettings, "model", model), pace)
    except DragrigError as error:
        click.echo(str(error), err=True)
        sys.exit(error.exit_code)


if __name__ == "__main__":
    main()
