"""Options and arguments that several commands share, as decorators."""

from collections.abc import Callable
from pathlib import Path
from typing import ParamSpec, TypedDict, TypeVar

import click

from dragrig.cli.console import QUIET

P = ParamSpec("P")
R = TypeVar("R")


def as_json(function: Callable[P, R]) -> Callable[P, R]:
    """Add `--json`, passed on as `as_json`."""
    return click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")(function)


def quiet(function: Callable[P, R]) -> Callable[P, R]:
    """Add `--quiet`: results and errors only."""
    return click.option(
        "--quiet", "-q", is_flag=True, expose_value=False, callback=_keep_quiet, help="Show no progress, no remarks."
    )(function)


def _keep_quiet(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    del parameter
    context.meta[QUIET] = value


_SETTINGS = (
    click.option("--rig", metavar="F|NAME", help="Rig settings; the lab folder's, or the shipped bench."),
    click.option("--specimen", metavar="F|NAME", help="Specimen; jejunum unless given."),
    click.option("--model", metavar="F|NAME", help="Friction model of the simulated rig; paper unless given."),
    click.option("--capsule", metavar="F|NAME", help="Capsule of every step, in place of the plan's."),
    click.option("--backend", metavar="NAME", help="Backend; the rig's own unless given."),
    click.option(
        "--set",
        "assignments",
        metavar="KEY=VALUE",
        multiple=True,
        help="Change a key of every step that has it, or rig.…, model.…, specimen.…, plan.…; repeatable.",
    ),
)


class SettingsOptions(TypedDict):
    """What `settings` adds; it fits `dragrig.setup.Choices`, which the command line's start must not load."""

    rig: str | None
    specimen: str | None
    model: str | None
    capsule: str | None
    backend: str | None
    assignments: tuple[str, ...]


def settings(function: Callable[P, R]) -> Callable[P, R]:
    """Add what says with which settings a plan runs: rig, specimen, model, capsule, backend and `--set`."""
    for option in reversed(_SETTINGS):
        function = option(function)
    return function


def inputs(function: Callable[P, R]) -> Callable[P, R]:
    """Add the argument `inputs`: run files, patterns and folders."""
    return click.argument("inputs", metavar="RUN…", nargs=-1, required=True)(function)


def out(what: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Add `--out DIR`, passed on as `out`."""
    return click.option("--out", "-o", metavar="DIR", type=click.Path(path_type=Path), help=what)


def overwrite(function: Callable[P, R]) -> Callable[P, R]:
    """Add `--overwrite`."""
    return click.option("--overwrite", is_flag=True, help="Replace files that are there already.")(function)


def made_folder(folder: Path) -> Path:
    """Make the folder that `--out` names unless it is there; raises `OutputError`."""
    from dragrig.config.errors import OutputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: no folder can be made here ({error.strerror}); name another.") from error
    return folder
