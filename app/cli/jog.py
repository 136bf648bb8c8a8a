"""`dragrig jog`."""

from typing import Unpack

import click

from dragrig.cli import by_hand, options


@click.command("jog", context_settings={"ignore_unknown_options": True})
@click.argument("distance_mm", metavar="MM", type=float)
@click.option("--speed", "speed_mm_s", metavar="MM/S", type=float, help="10 unless given; 2 off a limit switch.")
@by_hand.override
@options.rig
@options.pace
@by_hand.yes
@options.as_json
@options.quiet
def command(
    distance_mm: float,
    speed_mm_s: float | None,
    override: str | None,
    pace: options.Pace | None,
    yes: bool,
    as_json: bool,
    **rig: Unpack[options.RigOptions],
) -> None:
    """Move the stage by MM, as 5 or -2.5; says before from where to where, and asks.

    Guarded as a run is, and not recorded. Prints where the stage then is.
    """
    from dragrig import api
    from dragrig.cli.operator import Terminal

    with Terminal(yes=yes) as person:
        moved = api.jog(distance_mm, speed_mm_s, override=by_hand.side(override), pace=pace, person=person, **rig)
    by_hand.tell(moved, as_json=as_json)
