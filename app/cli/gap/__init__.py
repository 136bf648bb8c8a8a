"""`dragrig gap`: what the friction model leaves out; one module of this package per command."""

from collections.abc import Mapping
from typing import ClassVar

import click

from dragrig.cli.lazy import LazyGroup


class GapGroup(LazyGroup):
    """The commands about the gap."""

    sections: ClassVar[Mapping[str, Mapping[str, str]]] = {
        "Commands": {
            "diagnose": "Say where a campaign differs from the model, which effect that is, and how large.",
            "evaluate": "Say how far an amended model closes the gap on fresh runs.",
            "next": "Say which runs to make next, to separate what is hardly told apart.",
            "isolability": "Say which effects a plan or a campaign can tell apart.",
            "blind": "Say how often the diagnosis is right on campaigns whose effect is hidden.",
            "calibrate": "Learn from such campaigns when a verdict is to be given.",
            "effects": "List the catalogue: where each effect acts, its parameters, what shows it.",
        },
    }
    package: ClassVar[str] = "dragrig.cli.gap"


@click.group("gap", cls=GapGroup, invoke_without_command=True)
@click.pass_context
def command(ctx: click.Context) -> None:
    """Say what the friction model leaves out: the catalogue of candidate effects, and which of them runs show."""
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())
