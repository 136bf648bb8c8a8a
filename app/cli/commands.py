"""The table of all commands, and the click groups that load a command's module when it is called."""

from collections.abc import Mapping
from glob import has_magic
from importlib import import_module
from os.path import lexists
from typing import Any, NamedTuple

import click

from dragrig import __version__
from dragrig.cli.console import echo


class CommandEntry(NamedTuple):
    """A command: its `module:attribute` within `dragrig.cli`, and its line in the overview."""

    location: str
    summary: str


Sections = Mapping[str, Mapping[str, CommandEntry]]
SECTIONS: Sections = {
    "Measure": {
        "demo": CommandEntry(
            "measure_commands:demo_command", "Run a short programme on the simulated rig: run files, CSV, figures."
        ),
        "init": CommandEntry(
            "measure_commands:init_command", "Make a lab folder: rig settings, data root, calibration history."
        ),
        "check": CommandEntry("measure_commands:check_command", "Check a plan, or the rig's devices; nothing moves."),
        "home": CommandEntry("stage_commands:home_command", "Find the stage's origin."),
        "jog": CommandEntry("stage_commands:jog_command", "Move the stage by a distance."),
        "touch-off": CommandEntry(
            "stage_commands:touch_off_command", "Approach until the force changes; plans can start from there."
        ),
        "calibrate": CommandEntry(
            "stage_commands:calibrate_group", "Calibrate force sensor or encoder; stored in the lab's history."
        ),
        "run": CommandEntry("measure_commands:run_command", "Carry out a plan and write one run file per run."),
        "watch": CommandEntry(
            "look_commands:watch_command", "Show the progress of a running campaign from another process."
        ),
        "recover": CommandEntry("measure_commands:recover_command", "Finish the run files of a crashed session."),
        "gui": CommandEntry("measure_commands:gui_command", "Open the window: run plans, view runs, diagnose."),
    },
    "Evaluate": {
        "list": CommandEntry("look_commands:list_command", "List the campaigns of a folder."),
        "find": CommandEntry(
            "look_commands:find_command", "Find runs by specimen, kind, operator, date and mark, in all campaigns."
        ),
        "info": CommandEntry("run_file_commands:info_command", "Show the contents of run files."),
        "table": CommandEntry(
            "look_commands:table_command", "Tabulate a campaign: a line per run, and means per speed."
        ),
        "compare": CommandEntry(
            "look_commands:compare_command", "Compare two campaigns, two runs, or either with the friction model."
        ),
        "gap": CommandEntry(
            "commands:gap_group", "Diagnose where and why measurements differ from the friction model."
        ),
        "report": CommandEntry("look_commands:report_command", "Write a report on a run or a campaign, one HTML file."),
        "show": CommandEntry(
            "look_commands:show_command", "Plot runs: force, raw and filtered, position and speed, with the phases."
        ),
        "model": CommandEntry(
            "model_commands:model_command", "Print and plot the steady forces that the friction model predicts."
        ),
        "robot": CommandEntry(
            "model_commands:robot_command",
            "Simulate a capsule robot in the gut, choose its drive, price the gap in mm/s.",
        ),
        "paper": CommandEntry(
            "model_commands:paper_command", "Simulate the paper's programme, identify it, and write a report."
        ),
    },
    "Process": {
        "identify": CommandEntry(
            "model_commands:identify_command", "Identify a specimen's parameters from its runs, with their uncertainty."
        ),
        "mark": CommandEntry(
            "run_file_commands:mark_command", "Mark runs as bad, remove the mark, or write a note on them."
        ),
        "filter": CommandEntry(
            "run_file_commands:filter_command",
            "Smooth runs with a Savitzky–Golay filter, stored beside the raw trace.",
        ),
        "import": CommandEntry("run_file_commands:import_command", "Convert other measurements to run files."),
        "export": CommandEntry("run_file_commands:export_command", "Write runs as CSV, Parquet, MAT or NPZ."),
    },
}
"""Commands by section; the overview must not load them."""

GAP_SECTIONS: Sections = {
    "Commands": {
        "diagnose": CommandEntry(
            "gap_commands:diagnose_command",
            "Diagnose where a campaign differs from the model, which effect causes it, and its size.",
        ),
        "evaluate": CommandEntry(
            "gap_commands:evaluate_command", "Evaluate how far an amended model closes the gap on fresh runs."
        ),
        "next": CommandEntry(
            "gap_commands:next_command", "Recommend the runs that best separate the remaining hypotheses."
        ),
        "settle": CommandEntry("gap_commands:settle_command", "Make runs until the gap is settled."),
        "isolability": CommandEntry(
            "gap_commands:isolability_command", "Show which effects a plan or a campaign can tell apart."
        ),
        "blind": CommandEntry("gap_commands:blind_command", "Test the diagnosis on campaigns with hidden effects."),
        "calibrate": CommandEntry(
            "gap_commands:gap_calibrate_command", "Calibrate the verdict on campaigns with hidden effects."
        ),
        "effects": CommandEntry(
            "gap_commands:effects_command",
            "List the effects: where each acts, its parameters, and the runs in which it is visible.",
        ),
    },
}


class TypedText(click.types.StringParamType):
    """A text on the command line: what is no UTF-8 can be no more than the name of a file that is there."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the text; fails for bytes that no file could hold, and that name none."""
        from dragrig.config import NO_TEXT, is_text

        text = super().convert(value, param, ctx)
        if not (is_text(text) or has_magic(text) or lexists(text)):
            self.fail(f"{text!r:.60} names no file, and {NO_TEXT}", param, ctx)
        return text


def _typed_as_text(command: click.Command) -> click.Command:
    """Have a command, and those of a group, take every text as `TypedText`."""
    for parameter in command.params:
        if parameter.type is click.STRING:
            parameter.type = TypedText()
    if isinstance(command, click.Group) and not isinstance(command, LazyGroup):
        for inner in command.commands.values():
            _typed_as_text(inner)
    return command


class LazyGroup(click.Group):
    """A group that loads the module of a command when it is called.

    Parameters
    ----------
    sections
        Commands by section.
    """

    def __init__(self, *args: Any, sections: Sections, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self._sections = sections

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of all commands, in the order of the overview."""
        del ctx
        return [name for commands in self._sections.values() for name in commands]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Load a command."""
        del ctx
        entry = next((commands[cmd_name] for commands in self._sections.values() if cmd_name in commands), None)
        if entry is None:
            return None
        module, attribute = entry.location.split(":")
        command: object = getattr(import_module(f"dragrig.cli.{module}"), attribute)
        if not isinstance(command, click.Command):
            raise TypeError(f"dragrig.cli.{entry.location} is not a click command")
        return _typed_as_text(command)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the named command; the error for an unknown one suggests the nearest."""
        if args and not args[0].startswith("-") and args[0] not in self.list_commands(ctx):
            from dragrig.config import suggestion

            raise click.UsageError(f"{args[0]} is not a command; {suggestion(args[0], self.list_commands(ctx))}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the overview without loading any command."""
        del ctx
        for section, commands in self._sections.items():
            with formatter.section(section):
                formatter.write_dl([(name, command.summary) for name, command in commands.items()])


@click.group(
    name="dragrig",
    cls=LazyGroup,
    sections=SECTIONS,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, message="dragrig %(version)s")
@click.pass_context
def dragrig_group(ctx: click.Context) -> None:
    """Run a linear-motor drag tester, real or simulated, and analyse what it records."""
    if ctx.invoked_subcommand is None:
        echo(ctx.get_help())


@click.group("gap", cls=LazyGroup, sections=GAP_SECTIONS, invoke_without_command=True)
@click.pass_context
def gap_group(ctx: click.Context) -> None:
    """Diagnose where and why measurements differ from the friction model."""
    if ctx.invoked_subcommand is None:
        echo(ctx.get_help())
