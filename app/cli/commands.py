"""The table of all commands, and the click groups that load a command's module when it is called."""

from collections.abc import Mapping
from glob import has_magic
from importlib import import_module
from os.path import lexists
from typing import Any

import click

from dragrig import __version__
from dragrig.cli.console import echo

Sections = Mapping[str, Mapping[str, tuple[str, str]]]
"""Commands by section: name, module within `dragrig.cli`, and line in the overview, which must not load them.

A command `touch-off` is `touch_off_command` of its module.
"""
SECTIONS: Sections = {
    "Measure": {
        "demo": ("measure_commands", "Run a short programme on the simulated rig: run files, CSV, figures."),
        "init": (
            "measure_commands",
            "Make a lab folder: settings of rig and notification, data root, calibration history.",
        ),
        "check": ("measure_commands", "Check a plan, or the rig's devices; nothing moves."),
        "home": ("stage_commands", "Find the stage's origin."),
        "jog": ("stage_commands", "Move the stage by a distance."),
        "touch-off": ("stage_commands", "Approach until the force changes; plans can start from there."),
        "calibrate": ("stage_commands", "Calibrate force sensor or encoder; stored in the lab's history."),
        "run": ("measure_commands", "Carry out a plan and write one run file per run."),
        "watch": ("look_commands", "Show the progress of a running campaign from another process."),
        "recover": ("measure_commands", "Finish the run files of a crashed session."),
        "gui": ("measure_commands", "Open the window: run plans, view runs, diagnose."),
    },
    "Evaluate": {
        "list": ("look_commands", "List the campaigns of a folder."),
        "find": ("look_commands", "Find runs by specimen, kind, operator, date and mark, in all campaigns."),
        "info": ("run_file_commands", "Show the contents of run files."),
        "table": ("look_commands", "Tabulate a campaign: a line per run, and means per speed."),
        "compare": ("look_commands", "Compare two campaigns, two runs, or either with the friction model."),
        "gap": ("commands", "Diagnose where and why measurements differ from the friction model."),
        "report": ("look_commands", "Write a report on a run or a campaign, one HTML file."),
        "show": ("look_commands", "Plot runs: force, raw and filtered, position and speed, with the phases."),
        "model": ("model_commands", "Print and plot the steady forces that the friction model predicts."),
        "robot": ("model_commands", "Simulate a capsule robot in the gut, choose its drive, price the gap in mm/s."),
        "paper": ("model_commands", "Simulate the paper's programme, identify it, and write a report."),
    },
    "Process": {
        "identify": ("model_commands", "Identify a specimen's parameters from its runs, with their uncertainty."),
        "mark": ("run_file_commands", "Mark runs as bad, remove the mark, or write a note on them."),
        "filter": ("run_file_commands", "Smooth runs with a Savitzky–Golay filter, stored beside the raw trace."),
        "import": ("run_file_commands", "Convert other measurements to run files."),
        "export": ("run_file_commands", "Write runs for other programs, campaigns for lab notebooks."),
    },
}
GAP_SECTIONS: Sections = {
    "Commands": {
        "diagnose": ("gap_commands", "Diagnose where a campaign differs from the model, and which effect causes it."),
        "evaluate": ("gap_commands", "Evaluate how far an amended model closes the gap on fresh runs."),
        "next": ("gap_commands", "Recommend the runs that best separate the remaining hypotheses."),
        "settle": ("gap_commands", "Make runs until the gap is settled."),
        "isolability": ("gap_commands", "Show which effects a plan or a campaign can tell apart."),
        "blind": ("gap_commands", "Test the diagnosis on campaigns with hidden effects."),
        "calibrate": ("gap_commands", "Calibrate the verdict on campaigns with hidden effects."),
        "effects": ("gap_commands", "List the effects: where each acts, its parameters, and the runs that show it."),
    },
}


class TypedText(click.types.StringParamType):
    """A text on the command line: bytes that are no UTF-8 can only be the name of an existing file."""

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
        command: object = getattr(import_module(f"dragrig.cli.{entry[0]}"), f"{cmd_name.replace('-', '_')}_command")
        if not isinstance(command, click.Command):
            raise TypeError(f"{cmd_name} of dragrig.cli.{entry[0]} is not a click command")
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
                formatter.write_dl([(name, summary) for name, (_, summary) in commands.items()])


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
    """Run a linear-motor drag tester, real or simulated, and analyse its records."""
    if ctx.invoked_subcommand is None:
        echo(ctx.get_help())


@click.group("gap", cls=LazyGroup, sections=GAP_SECTIONS, invoke_without_command=True)
@click.pass_context
def gap_command(ctx: click.Context) -> None:
    """Diagnose where and why measurements differ from the friction model."""
    if ctx.invoked_subcommand is None:
        echo(ctx.get_help())
