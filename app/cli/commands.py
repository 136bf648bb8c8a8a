"""The table of all commands, and the click groups that load a command's module when it is called."""

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

LOCATIONS: Mapping[str, str] = {
    "demo": "measure_commands:demo_command",
    "init": "measure_commands:init_command",
    "check": "measure_commands:check_command",
    "home": "stage_commands:home_command",
    "jog": "stage_commands:jog_command",
    "touch-off": "stage_commands:touch_off_command",
    "calibrate": "stage_commands:calibrate_group",
    "run": "measure_commands:run_command",
    "watch": "watch:watch_command",
    "recover": "measure_commands:recover_command",
    "gui": "measure_commands:gui_command",
    "info": "run_file_commands:info_command",
    "table": "look_commands:table_command",
    "compare": "look_commands:compare_command",
    "gap": "commands:gap_group",
    "report": "look_commands:report_command",
    "show": "look_commands:show_command",
    "model": "model_commands:model_command",
    "paper": "model_commands:paper_command",
    "identify": "identify:identify_command",
    "mark": "run_file_commands:mark_command",
    "filter": "run_file_commands:filter_command",
    "import": "run_file_commands:import_command",
    "export": "run_file_commands:export_command",
}
"""Where each command is: a module of `dragrig.cli`, and its attribute."""

GAP_SECTIONS: Mapping[str, Mapping[str, str]] = {
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
GAP_LOCATIONS: Mapping[str, str] = {
    "diagnose": "gap_commands:diagnose_command",
    "evaluate": "gap_commands:evaluate_command",
    "next": "gap_commands:next_command",
    "isolability": "gap_commands:isolability_command",
    "blind": "exam_commands:blind_command",
    "calibrate": "exam_commands:gap_calibrate_command",
    "effects": "gap_commands:effects_command",
}


class LazyGroup(click.Group):
    """A group that knows its commands by name alone and loads the module of the one that is called.

    Attributes
    ----------
    sections
        Commands by section, with the line that the overview shows.
    locations
        `module:attribute` of each command, the module within `dragrig.cli`.
    """

    sections: ClassVar[Mapping[str, Mapping[str, str]]] = SECTIONS
    locations: ClassVar[Mapping[str, str]] = LOCATIONS

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of all commands, in the order of the overview."""
        del ctx
        return [name for commands in self.sections.values() for name in commands]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Load one command."""
        del ctx
        if cmd_name not in self.locations:
            return None
        module, attribute = self.locations[cmd_name].split(":")
        command: object = getattr(import_module(f"dragrig.cli.{module}"), attribute)
        if not isinstance(command, click.Command):
            raise TypeError(f"dragrig.cli.{module}.{attribute} is not a click command")
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that the arguments name; an unknown one is answered with the nearest."""
        if args and not args[0].startswith("-") and args[0] not in self.list_commands(ctx):
            from dragrig.config.settings import suggestion

            raise click.UsageError(f"{args[0]} is not a command; {suggestion(args[0], self.list_commands(ctx))}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the overview without loading any command."""
        del ctx
        for section, commands in self.sections.items():
            with formatter.section(section):
                formatter.write_dl(list(commands.items()))


class GapGroup(LazyGroup):
    """The commands about the gap."""

    sections: ClassVar[Mapping[str, Mapping[str, str]]] = GAP_SECTIONS
    locations: ClassVar[Mapping[str, str]] = GAP_LOCATIONS


@click.group(
    name="dragrig",
    cls=LazyGroup,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, message="dragrig %(version)s")
@click.pass_context
def dragrig_group(ctx: click.Context) -> None:
    """Run a linear-motor drag tester, real or simulated, and make sense of what it records."""
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


@click.group("gap", cls=GapGroup, invoke_without_command=True)
@click.pass_context
def gap_group(ctx: click.Context) -> None:
    """Say what the friction model leaves out: the catalogue of candidate effects, and which of them runs show."""
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())
