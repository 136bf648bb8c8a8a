"""The group of all commands, which loads a command's module when the command is called."""

from collections.abc import Mapping
from importlib import import_module
from typing import ClassVar

import click

from dragrig import __version__

SECTIONS: Mapping[str, Mapping[str, str]] = {
    "Measure": {
        "demo": "Run a short programme on the simulated rig: run files, CSV, pictures.",
        "init": "Make a lab folder: rig settings, data root, calibration history.",
        "check": "Say what a plan would do, or look at the rig; nothing moves.",
        "home": "Find the stage's origin.",
        "jog": "Move the stage by a distance.",
        "touch-off": "Approach until the force changes; plans may count from there.",
        "calibrate": "Calibrate force sensor or encoder; kept in the lab's history.",
        "run": "Carry out a plan and write one run file per run.",
        "watch": "Follow a running campaign from another process.",
        "recover": "Finish the runs that a crash left behind.",
        "gui": "Show the window: run, look, diagnose.",
    },
    "Look": {
        "info": "Say what run files hold.",
        "table": "Tabulate a campaign: a line per run, and means per speed.",
        "compare": "Compare two campaigns, two runs, or either with the friction model.",
        "gap": "Say what the friction model leaves out on a rig or a gut.",
        "report": "Write a report on a run or a campaign, one HTML file.",
        "show": "Draw runs: force, raw and filtered, position and speed, with the phases.",
        "model": "Print and draw what the friction model says of steady sliding.",
        "paper": "Simulate the paper's programme, identify it, and write a report.",
    },
    "Work": {
        "identify": "Identify a specimen's parameters from its runs, with their uncertainty.",
        "mark": "Mark runs as bad, or take the mark back; everything later honours it.",
        "filter": "Smooth runs with a Savitzky–Golay filter, stored beside the raw trace.",
        "import": "Turn measurements from elsewhere into run files.",
        "export": "Write runs as CSV, Parquet, MAT or NPZ.",
    },
}
"""Commands by section, with the line that the overview shows; the overview must not load them."""

_MODULES = {"import": "import_", "filter": "filter_", "touch-off": "touch_off"}


class LazyGroup(click.Group):
    """A group that knows its commands by name alone: all of them, unless a derived one has its own.

    Attributes
    ----------
    sections
        Commands by section, with the line that the overview shows.
    package
        Where each command's module is.
    """

    sections: ClassVar[Mapping[str, Mapping[str, str]]] = SECTIONS
    package: ClassVar[str] = "dragrig.cli"

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of all commands, in the order of the overview."""
        del ctx
        return [name for commands in self.sections.values() for name in commands]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Load one command."""
        if cmd_name not in self.list_commands(ctx):
            return None
        module = import_module(f"{self.package}.{_MODULES.get(cmd_name, cmd_name)}")
        command = module.command
        if not isinstance(command, click.Command):
            raise TypeError(f"{module.__name__}.command is not a click command")
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that the arguments name; an unknown one is answered with the nearest."""
        if args and not args[0].startswith("-") and args[0] not in self.list_commands(ctx):
            from dragrig.config.loading import nearest

            raise click.UsageError(f"{args[0]} is not a command; {nearest(args[0], self.list_commands(ctx))}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the overview without loading any command."""
        del ctx
        for section, commands in self.sections.items():
            with formatter.section(section):
                formatter.write_dl(list(commands.items()))


@click.group(
    name="dragrig",
    cls=LazyGroup,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, message="dragrig %(version)s")
@click.pass_context
def group(ctx: click.Context) -> None:
    """Run a linear-motor drag tester, real or simulated, and make sense of what it records."""
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())
