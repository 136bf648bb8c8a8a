"""Options and arguments that several commands share, as decorators."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal, ParamSpec, TypedDict, TypeVar

import click

from dragrig.cli.console import QUIET, print_json, print_remark, print_result

if TYPE_CHECKING:
    from dragrig.api.stage import MoveResult
    from dragrig.rig.devices import TravelEnd


P = ParamSpec("P")
R = TypeVar("R")
Pace = Literal["fast", "real"] | float
"""As `dragrig.setup.Pace`, which the command line's start must not load."""


def as_json(function: Callable[P, R]) -> Callable[P, R]:
    """Add `--json`, passed on as `as_json`."""
    return click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")(function)


def quiet(function: Callable[P, R]) -> Callable[P, R]:
    """Add `--quiet`: results and errors only."""
    return click.option(
        "--quiet", "-q", is_flag=True, expose_value=False, callback=_set_quiet, help="Show no progress, no remarks."
    )(function)


def _set_quiet(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    del parameter
    context.meta[QUIET] = value


def effects(what: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Add `--effect`, passed on as `effects`."""
    return click.option("--effect", "effects", metavar="ID[:KEY=VALUE,…]", multiple=True, help=what)


_RIG_OPTIONS = (
    click.option("--rig", metavar="F|NAME", help="Rig settings; the lab folder's, or the shipped bench."),
    click.option("--model", metavar="F|NAME", help="Friction model of the simulated rig; paper unless given."),
    click.option("--backend", metavar="NAME", help="Backend; the rig's own unless given."),
    click.option("--double", is_flag=True, help="The backend's double: a try without the hardware."),
)
_SETTINGS_OPTIONS = (
    *_RIG_OPTIONS[:1],
    click.option("--specimen", metavar="F|NAME", help="Specimen; jejunum unless given."),
    *_RIG_OPTIONS[1:2],
    effects("What the simulated rig has beside the model, as dragrig gap effects lists it; repeatable."),
    click.option("--capsule", metavar="F|NAME", help="Capsule of every step, in place of the plan's."),
    *_RIG_OPTIONS[2:],
    click.option(
        "--set",
        "assignments",
        metavar="KEY=VALUE",
        multiple=True,
        help="Change a key of every step that has it, or rig.…, model.…, specimen.…, plan.…; repeatable.",
    ),
)
_SET_RIG_OPTION = click.option(
    "--set", "assignments", metavar="KEY=VALUE", multiple=True, help="Change rig.… or model.…; repeatable."
)


class RigOptions(TypedDict):
    """What `rig` adds; it fits `dragrig.setup.RigChoices`, which the command line's start must not load."""

    rig: str | None
    model: str | None
    backend: str | None
    double: bool
    assignments: tuple[str, ...]


class SettingsOptions(RigOptions):
    """What `settings` adds; it fits `dragrig.setup.SetupChoices`."""

    specimen: str | None
    capsule: str | None
    effects: tuple[str, ...]


def settings(function: Callable[P, R]) -> Callable[P, R]:
    """Add what says with which settings a plan runs: rig, specimen, model, effects, capsule, backend and `--set`."""
    for option in reversed(_SETTINGS_OPTIONS):
        function = option(function)
    return function


def rig(function: Callable[P, R]) -> Callable[P, R]:
    """Add what says which rig is meant: rig, model, backend, double and `--set`."""
    for option in reversed((*_RIG_OPTIONS, _SET_RIG_OPTION)):
        function = option(function)
    return function


def _parse_pace(context: click.Context, parameter: click.Parameter, value: str | None) -> Pace | None:
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
        callback=_parse_pace,
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


def require_single_campaign(count: int, **files: Path | None) -> None:
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


def make_folder(folder: Path) -> Path:
    """Make the folder that `--out` names unless it is there; raises `OutputError`."""
    from dragrig.config.errors import OutputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: no folder can be made here ({error.strerror}); name another.") from error
    return folder


def yes(function: Callable[P, R]) -> Callable[P, R]:
    """Add `--yes`."""
    said = "Answer every question with done that asks for nobody's hands or eyes at the rig."
    return click.option("--yes", "-y", is_flag=True, help=said)(function)


def override_limit(function: Callable[P, R]) -> Callable[P, R]:
    """Add `--override-limit`, passed on as `override_limit`."""
    said = "Go although this side's limit switch is pressed; everything else stays watched."
    return click.option("--override-limit", "override", type=click.Choice(["low", "high"]), help=said)(function)


def limit_side(word: str | None) -> "TravelEnd | None":
    """Return the side that `--override-limit` names."""
    from dragrig.rig.devices import TravelEnd

    return None if word is None else TravelEnd(word)


def print_move(moved: "MoveResult", *, as_json: bool) -> None:
    """Print where the stage is, and what the guard is tripped on still."""
    if as_json:
        print_json(moved)
        return
    print_result(f"{moved.position_mm:.3f} mm")
    if moved.trip is not None:
        print_remark(f"The guard stays tripped: {moved.trip.message}.")
