"""`dragrig touch-off`."""

from typing import Unpack

import click

from dragrig.cli import by_hand, options
from dragrig.cli.console import result, result_json, say


@click.command("touch-off")
@click.option("--force", "force_mN", metavar="MN", type=float, default=20.0, show_default=True, help="Change sought.")
@click.option("--speed", "speed_mm_s", metavar="MM/S", type=float, default=1.0, show_default=True, help="Of the way.")
@click.option(
    "--most",
    "most_mm",
    metavar="MM",
    type=float,
    default=20.0,
    show_default=True,
    help="Go so far at most; negative goes down.",
)
@click.option("--back", "back_mm", metavar="MM", type=float, default=0.0, show_default=True, help="Go back by so much.")
@click.option("--operator", metavar="NAME", default="", help="Who is at the rig; kept with the contact.")
@options.rig
@options.pace
@by_hand.yes
@options.as_json
@options.quiet
def command(
    force_mN: float,
    speed_mm_s: float,
    most_mm: float,
    back_mm: float,
    operator: str,
    pace: options.Pace | None,
    yes: bool,
    as_json: bool,
    **rig: Unpack[options.RigOptions],
) -> None:
    """Approach slowly until the force has changed against its value at rest; says before how far, and asks.

    The contact is kept in the lab folder. With stage.start_from = "contact" in the rig settings, start_mm of plans
    counts from it; limits stay absolute.
    """
    from dragrig import api
    from dragrig.cli.operator import Terminal

    with Terminal(yes=yes) as person:
        found = api.touch_off(
            most_mm,
            force_mN=force_mN,
            speed_mm_s=speed_mm_s,
            back_mm=back_mm,
            operator=operator,
            pace=pace,
            person=person,
            **rig,
        )
    if as_json:
        result_json(found.model_dump())
    else:
        result(f"contact at {found.position_mm:.3f} mm, where the force changed by {found.force_mN:.1f} mN")
        say("Kept as contact.toml in the lab folder.")
