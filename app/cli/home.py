"""`dragrig home`."""

from typing import Unpack

import click

from dragrig.cli import by_hand, options


@click.command("home")
@by_hand.override
@options.rig
@options.pace
@by_hand.yes
@options.as_json
@options.quiet
def command(
    override: str | None, pace: options.Pace | None, yes: bool, as_json: bool, **rig: Unpack[options.RigOptions]
) -> None:
    """Find the stage's origin; says before what will move, and asks.

    Prints where the stage then is.
    """
    from dragrig import api
    from dragrig.cli.operator import Terminal

    with Terminal(yes=yes) as person:
        by_hand.tell(api.home(override=by_hand.side(override), pace=pace, person=person, **rig), as_json=as_json)
