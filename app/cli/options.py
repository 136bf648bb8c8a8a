"""Options and arguments that several commands share, as decorators."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal, ParamSpec, TypedDict, TypeVar

import click

from dragrig.cli.console import QUIET

P = ParamSpec("P")
R = TypeVar("R")
Pace = Literal["fast", "real"] | float
"""As `dragrig.pacing.Pace`, which the command line's start must not load."""


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


def effects(what: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Add `--effect`, passed on as `effects`."""
    return click.option("--effect", "effects", metavar="ID[:KEY=VALUE,…]", multiple=True, help=what)


_RIG = (
    click.option("--rig", metavar="F|NAME", help="Rig settings; the lab folder's, or the shipped bench."),
    click.option("--model", metavar="F|NAME", help="Friction model of the simulated rig; paper unless given."),
    click.option("--backend", metavar="NAME", help="Backend; the rig's own unless given."),
    click.option("--double", is_flag=True, help="The backend's double: a try without the hardware."),
)
_SETTINGS = (
    *_RIG[:1],
    click.option("--specimen", metavar="F|NAME", help="Specimen; jejunum unless given."),
    *_RIG[1:2],
    effects("What the simulated rig has beside the model, as dragrig gap effects lists it; repeatable."),
    click.option("--capsule", metavar="F|NAME", help="Capsule of every step, in place of the plan's."),
    *_RIG[2:],
    click.option(
        "--set",
        "assignments",
        metavar="KEY=VALUE",
        multiple=True,
        help="Change a key of every step that has it, or rig.…, model.…, specimen.…, plan.…; repeatable.",
    ),
)
_SET_RIG = click.option(
    "--set", "assignments", metavar="KEY=VALUE", multiple=True, help="Change rig.… or model.…; repeatable."
)


class RigOptions(TypedDict):
    """What `rig` adds; it fits `dragrig.rigs.RigChoices`, which the command line's start must not load."""

    rig: str | None
    model: str | None
    backend: str | None
    double: bool
    assignments: tuple[str, ...]


class SettingsOptions(RigOptions):
    """What `settings` adds; it fits `dragrig.setup.Choices`."""

    specimen: str | None
    capsule: str | None
    effects: tuple[str, ...]


def settings(function: Callable[P, R]) -> Callable[P, R]:
    """Add what says with which settings a plan runs: rig, specimen, model, effects, capsule, backend and `--set`."""
    for option in reversed(_SETTINGS):
        function = option(function)
    return function


def rig(function: Callable[P, R]) -> Callable[P, R]:
    """Add what says which rig is meant: rig, model, backend, double and `--set`."""
    for option in reversed((*_RIG, _SET_RIG)):
        function = option(function)
    return function


def _pace(context: click.Context, parameter: click.Parameter, value: str | None) -> Pace | None:
    words: dict[str, Pace] = {"fast": "fast", "real": "real"}
    if value is None or value in words:
        return None if value is None else words[value]
    try:
        return float(value)
    except ValueError:
        said = f"{value!r} is neither fast, real, nor a number of times faster"
        raise click.BadParameter(said, context, parameter) from None


def pace(function: Callable[P, R]) -> Callable[P, R]:
    """Add `--pace`."""
    return click.option(
        "--pace",
        metavar="fast|real|N",
        callback=_pace,
        help="Of the simulated rig: fast unless given. Of a double: real unless given, or N times faster.",
    )(function)


def inputs(function: Callable[P, R]) -> Callable[P, R]:
    """Add the argument `inputs`: run files, patterns and folders."""
    return click.argument("inputs", metavar="RUN…", nargs=-1, required=True)(function)


def workers(what: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Add `--workers` and `--scheduler`, which share out pieces of work of this name."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        cluster = f"Address of a Dask cluster's scheduler, whose workers share the {what}."
        function = click.option("--scheduler", metavar="ADDRESS", help=cluster)(function)
        here = f"Processes that share the {what}, each of which has one; the cores unless given."
        return click.option("--workers", metavar="N", type=int, help=here)(function)

    return decorate


def require_one(count: int, **files: Path | None) -> None:
    """Raise `SettingsError` where a file for one campaign is asked for and several were given."""
    from dragrig.config.errors import SettingsError

    for name, path in files.items():
        if path is not None:
            option = "--" + name.replace("_", "-")
            raise SettingsError(
                f"{option} {path}: is made of one campaign, and {count} were given; diagnose that one by itself."
            )


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
