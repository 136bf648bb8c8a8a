"""`dragrig gap`: what the friction model leaves out; one module of this package per command."""

from collections.abc import Mapping
from typing import ClassVar

import click

from dragrig.cli.lazy import LazyGroup


class GapGroup(LazyGroup):
    """The commands about the gap."""

    sections: ClassVar[Mapping[str, Mapping[str, str]]] = {
        "Commands": {
            "effects": "List the catalogue: where each effect acts, its parameters, what shows it.",
        },
    }
    package: ClassVar[str] = "dragrig.cli.gap"


@click.group("gap", cls=GapGroup, invoke_without_command=True)
@click.pass_context
def command(ctx: click.Context) -> None:
    """Say what the friction model leaves out: the catalogue of candidate effects."""
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())
