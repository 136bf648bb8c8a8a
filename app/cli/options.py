"""Options and arguments that several commands share, as decorators."""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Literal, ParamSpec, TypeVar, cast

import click

from dragrig.cli.console import QUIET, display_path, echo, print_json, print_remark

if TYPE_CHECKING:
    from dragrig.api import MoveResult
    from dragrig.rig import TravelEnd
    from dragrig.setup import RigChoices

    class StageOptions(RigChoices):
        """The arguments that `rig_session` adds."""

        pace: "Pace | None"

    class OperatorOptions(StageOptions):
        """The arguments of `rig_session`, and `--operator`."""

        operator: str

    class CalibrationOptions(OperatorOptions):
        """The arguments of `rig_session` and `session_notes`."""

        note: str


P = ParamSpec("P")
R = TypeVar("R")
Pace = Literal["fast", "real"] | float
"""The same as `dragrig.setup.Pace`, which `dragrig --help` must not load."""


class Number(click.ParamType[float]):
    """A number as the window reads it: 1.5 and 1,5 alike, and no mark of thousands.

    Parameters
    ----------
    lowest, highest
        Allowed range.
    """

    name = "number"

    def __init__(self, lowest: float = -math.inf, highest: float = math.inf) -> None:
        self._lowest, self._highest = lowest, highest

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return the number; raises `click.BadParameter`."""
        from dragrig.config import NumberRange, SettingsError, read_number

        if isinstance(value, int | float):
            return float(value)
        try:
            return read_number(str(value), NumberRange(lowest=self._lowest, highest=self._highest))
        except SettingsError as error:
            self.fail(str(error).removesuffix("."), param, ctx)


NUMBER = Number()


def numbers(context: click.Context, parameter: click.Parameter, value: str) -> tuple[float, ...]:
    """Return the numbers of an option, separated by commas."""
    from dragrig.config import SettingsError, read_numbers

    try:
        return read_numbers(value, tight=True)
    except SettingsError as error:
        raise click.BadParameter(str(error).removesuffix("."), context, parameter) from None


as_json = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
"""Adds `--json`, as the argument `as_json`."""
inputs = click.argument("inputs", metavar="RUN…", nargs=-1, required=True)
"""Adds the argument `inputs`: run files, patterns and folders."""


def _require_writable(context: click.Context, parameter: click.Parameter, value: Path | None) -> Path | None:
    del parameter
    if value is not None:
        from dragrig.present import require_writable

        require_writable(value, overwrite=bool(context.params.get("overwrite")))
    return value


def written_file(option: str, metavar: str, text: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Add the name of a file to write, refused before any work where it cannot be written; beside `overwrite`."""
    return click.option(option, metavar=metavar, type=click.Path(path_type=Path), callback=_require_writable, help=text)


report = written_file("--report", "FILE.html", "Write the report to this file.")
without = click.option(
    "--without", metavar="EFFECT", multiple=True, help="Leave an effect out of the catalogue; repeatable."
)
measured_specimen = click.option(
    "--specimen", metavar="NAME", help="Name or id, where there are several (default: the most measured)."
)
"""Adds `--specimen`, as the argument `specimen`: one of those whose runs are examined."""
overwrite = click.option("--overwrite", is_flag=True, is_eager=True, help="Replace existing files.")
yes = click.option(
    "--yes", "-y", is_flag=True, help="Answer prompts with done, but on a real rig those for hands or eyes."
)
override_limit = click.option(
    "--override-limit",
    "override",
    type=click.Choice(["low", "high"]),
    help="Move although this side's limit switch is pressed; everything else stays guarded.",
)
"""Adds `--override-limit`, as the argument `override`."""


def _set_quiet(context: click.Context, parameter: click.Parameter, value: bool) -> None:
    del parameter
    context.meta[QUIET] = value


quiet = click.option(
    "--quiet", "-q", is_flag=True, expose_value=False, callback=_set_quiet, help="Show no progress, no remarks."
)


def effects(text: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Add `--effect`, as the argument `effects`."""
    return click.option("--effect", "effects", metavar="ID[:KEY=VALUE,…]", multiple=True, help=text)


_RIG_OPTIONS = (
    click.option("--rig", metavar="F|NAME", help="Rig settings (default: the lab folder's, else the shipped bench)."),
    click.option("--model", metavar="F|NAME", help="Friction model of the simulated rig (default: paper)."),
    click.option("--backend", metavar="NAME", help="Backend (default: that of the rig settings)."),
    click.option("--double", is_flag=True, help="Use the backend's double, which simulates the hardware."),
)
_SETTINGS_OPTIONS = (
    *_RIG_OPTIONS[:1],
    click.option("--specimen", metavar="F|NAME", help="Specimen (default: jejunum)."),
    *_RIG_OPTIONS[1:2],
    effects("Add an effect to the simulated rig, as listed by dragrig gap effects; repeatable."),
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


def settings(function: Callable[P, R]) -> Callable[P, R]:
    """Add the settings of a plan: rig, specimen, model, effects, capsule, backend, double and `--set`."""
    for option in reversed(_SETTINGS_OPTIONS):
        function = option(function)
    return function


def rig(function: Callable[P, R]) -> Callable[P, R]:
    """Add the choice of the rig: rig, model, backend, double and `--set`."""
    for option in reversed((*_RIG_OPTIONS, _SET_RIG_OPTION)):
        function = option(function)
    return function


def _parse_pace(context: click.Context, parameter: click.Parameter, value: str | None) -> Pace | None:
    names: dict[str | None, Pace | None] = {"fast": "fast", "real": "real", None: None}
    if value in names:
        return names[value]
    from dragrig.config import SettingsError, read_number

    try:
        return read_number(value or "")
    except SettingsError:
        text = f"{value!r} is neither fast, real, nor a number of times faster"
        raise click.BadParameter(text, context, parameter) from None


pace = click.option(
    "--pace",
    metavar="fast|real|N",
    callback=_parse_pace,
    help="Simulated rig: fast (default) or real time. Double: real time (default) or N times faster.",
)


def session_notes(place: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Add `--operator` and `--note`, stored with the command's runs."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        function = click.option("--note", metavar="TEXT", default="", help=f"Note, stored {place}.")(function)
        operator = f"Operator's name, stored {place}."
        return click.option("--operator", metavar="NAME", default="", help=operator)(function)

    return decorate


def inputs_or_newest(function: Callable[P, R]) -> Callable[P, R]:
    """Add the argument `inputs`: run files, patterns and folders; without any the newest campaign."""
    return _or_newest("inputs", "[RUN…]", function)


def campaigns(function: Callable[P, R]) -> Callable[P, R]:
    """Add `campaigns`, folders, and `listing`, the runs that are named of one; by default the newest campaign."""

    @wraps(function)
    def of_named(*arguments: P.args, **settings: P.kwargs) -> R:
        from dragrig.run_inputs import named_campaigns

        settings["campaigns"], settings["listing"] = named_campaigns(cast("tuple[str, ...]", settings["campaigns"]))
        return function(*arguments, **settings)

    return _or_newest("campaigns", "[CAMPAIGN…]", of_named)


def _or_newest(name: str, metavar: str, function: Callable[P, R]) -> Callable[P, R]:
    @wraps(function)
    def with_default(*arguments: P.args, **settings: P.kwargs) -> R:
        if not settings[name]:
            from dragrig.run_inputs import newest_campaign

            folder = display_path(newest_campaign())
            print_remark(f"{folder} is the newest campaign:")
            settings[name] = (folder,)
        return function(*arguments, **settings)

    return click.argument(name, metavar=metavar, nargs=-1)(with_default)


def workers(tasks: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Add `--workers` and `--scheduler` for tasks of this name."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        cluster = f"Address of a Dask cluster's scheduler, on whose workers the {tasks} are processed."
        function = click.option("--scheduler", metavar="ADDRESS", help=cluster)(function)
        local = f"Processes that work on the {tasks} in parallel (default: the number of cores)."
        return click.option("--workers", metavar="N", type=int, help=local)(function)

    return decorate


def require_single_campaign(count: int, **files: Path | None) -> None:
    """Raise `SettingsError` where a file for one campaign is named and there are several campaigns."""
    from dragrig.config import SettingsError

    for name, path in files.items():
        if path is not None:
            option = "--" + name.replace("_", "-")
            raise SettingsError(f"{option} {path}: takes a single campaign, not {count}; name one.")


def require_all_succeeded(done: str, campaigns: int, reasons: Sequence[str]) -> None:
    """Raise `AnalysisError` with the first reason why campaigns failed, where any did."""
    from dragrig.config import AnalysisError

    if reasons:
        more = f"; and {len(reasons) - 1} more" if reasons[1:] else ""
        raise AnalysisError(f"{len(reasons)} of {campaigns} campaigns were not {done}: {reasons[0].rstrip('.')}{more}.")


def picture_form(function: Callable[P, R]) -> Callable[P, R]:
    """Add `--column` and `--picture-format`; the command draws and writes its pictures in that form."""

    @wraps(function)
    def in_form(*arguments: P.args, **settings: P.kwargs) -> R:
        from dragrig.present import FigureForm, figure_form

        meta = click.get_current_context().meta
        width = meta.get(_COLUMN)
        with figure_form(FigureForm(None if width is None else _column_mm(width), f".{meta.get(_FORMAT, 'png')}")):
            return function(*arguments, **settings)

    column = click.option(
        "--column",
        metavar="single|double|MM",
        expose_value=False,
        callback=_remember(_COLUMN),
        help="Pictures for a journal, 85, 180 or so many mm wide; no title, 600 dpi.",
    )
    picture_format = click.option(
        "--picture-format",
        type=click.Choice(("png", "svg", "pdf")),
        expose_value=False,
        callback=_remember(_FORMAT),
        help="Format of pictures whose names are not given (default: png).",
    )
    return column(picture_format(in_form))


_COLUMN, _FORMAT = "dragrig.column", "dragrig.picture_format"
_MIN_COLUMN_MM, _MAX_COLUMN_MM = 60.0, 300.0


def _column_mm(text: str) -> float:
    """Return the width of pictures that `--column` names; raises `SettingsError`."""
    from dragrig.config import NumberRange, SettingsError, read_number
    from dragrig.present import DOUBLE_COLUMN_MM, SINGLE_COLUMN_MM

    named = {"single": SINGLE_COLUMN_MM, "double": DOUBLE_COLUMN_MM}
    if text in named:
        return named[text]
    with suppress(SettingsError):
        return read_number(text, NumberRange("mm", _MIN_COLUMN_MM, _MAX_COLUMN_MM))
    raise SettingsError(
        f"--column {text}: is single, double, or a width from {_MIN_COLUMN_MM:g} to {_MAX_COLUMN_MM:g} mm, as 88."
    )


def _remember(key: str) -> Callable[[click.Context, click.Parameter, str | None], None]:
    def remember(context: click.Context, parameter: click.Parameter, value: str | None) -> None:
        del parameter
        if value is not None:
            context.meta[key] = value

    return remember


def figures(function: Callable[P, R]) -> Callable[P, R]:
    """Add `--figures DIR`, as the argument `figures`, and the form of pictures."""
    text = "Write the figures to this folder."
    return click.option("--figures", metavar="DIR", type=click.Path(path_type=Path), help=text)(picture_form(function))


def out(text: str, default: str | None = None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Add `--out DIR`, as the argument `out`."""
    shown = default is not None
    folder = click.Path(path_type=Path)
    return click.option("--out", "-o", metavar="DIR", type=folder, default=default, show_default=shown, help=text)


def make_folder(folder: Path) -> Path:
    """Make the folder of `--out` where it does not exist; raises `OutputError`."""
    from dragrig.config import OutputError

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: no folder can be made here ({error.strerror}); name another.") from error
    return folder


def rig_session(function: Callable[P, R]) -> Callable[P, R]:
    """Add the options of all commands that move the stage by hand or calibrate."""
    return rig(pace(yes(as_json(quiet(function)))))


def limit_side(name: str | None) -> "TravelEnd | None":
    """Return the side that `--override-limit` names."""
    from dragrig.rig import TravelEnd

    return None if name is None else TravelEnd(name)


def print_move(move: "MoveResult", *, as_json: bool) -> None:
    """Print the stage's position, and why the guard is still tripped."""
    if as_json:
        print_json(move)
        return
    echo(f"{move.position_mm:.3f} mm")
    if move.trip is not None:
        print_remark(f"The guard stays tripped: {move.trip.message}.")
