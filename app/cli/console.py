"""Common to all commands: output, errors as one sentence and an exit code, progress, batches of files."""

import codecs
import errno
import io
import json
import os
import re
import sys
import tempfile
import time
import traceback
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Self, TypeVar

import click

from dragrig.analysis import printable
from dragrig.config import NO_TEXT, AbortedError, DragrigError, is_text
from dragrig.end_signals import EndSignals
from dragrig.present import TimeLeft, to_json_value

if TYPE_CHECKING:
    from rich.console import ConsoleRenderable, RenderableType
    from rich.progress import Progress as RichProgress
    from rich.progress import Task, TaskID

    from dragrig.analysis import Progress
    from dragrig.present import Document


QUIET = "dragrig.quiet"
"""Key in a click context's `meta`: whether only results and errors are printed."""

BUG = 1
BAD_INPUT = 2
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}


def echo(text: str = "", *, err: bool = False, newline: bool = True) -> None:
    """Print a text; characters that would drive the terminal are written out.

    Everything that commands print goes through here, or through the text of `rich` (`present.terminal`), which does
    the same: texts of files and names of files may hold anything.
    """
    click.echo(printable(text), err=err, nl=newline)  # noqa: TID251  # this is where


def print_json(value: object, *, indent: int | None = 2) -> None:
    """Print a result as JSON on standard output, on one line without `indent`: NaN and infinities as null."""
    echo(json.dumps(to_json_value(value), indent=indent, allow_nan=False))


def print_document(document: "Document", *, as_json: bool) -> None:
    """Print a result's document on standard output, as JSON or as text."""
    from dragrig.present import terminal

    if as_json:
        print_json(document.data)
    else:
        terminal.print_document(document)


def print_warning(sentence: str) -> None:
    """Print a message needed even with --quiet, such as a missing copy; from any thread."""
    with suppress(OSError):  # the terminal may be closed; the work goes on
        echo(f"\n{sentence}", err=True)


def write_report(
    document: "Document", path: Path | None, *sources: str | Path, overwrite: bool, progress: "Progress | None" = None
) -> None:
    """Write the page of a result of some campaigns or runs, where one is wanted; it is for a screen in any form."""
    if path is None:
        return
    from dragrig.analysis import no_progress
    from dragrig.present import FigureForm, drawn, figure_form, render_page, write_text

    with figure_form(FigureForm()):
        write_text(render_page(drawn(document, progress or no_progress), *sources), path, overwrite=overwrite)


def print_written(*, as_json: bool, **files: Path | None) -> None:
    """Print where files were written, below a result that is not printed as JSON."""
    for name, path in files.items():
        if path is not None and not as_json:
            echo(f"{name:8}{display_path(path)}")


def print_remark(text: str) -> None:
    """Print a remark on standard error, unless --quiet."""
    if not is_quiet():
        echo(text, err=True)


def is_quiet() -> bool:
    """Whether the running command prints results and errors only."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(QUIET, False))


def run_command_line(command: click.Command, arguments: Sequence[str] | None) -> int:
    """Run a command and return its exit code; an error is printed as one sentence."""
    _open_closed_streams()
    _replace_unencodable()
    with EndSignals(last=arguments is None) as signals:
        try:
            returned = command.main(args=arguments, prog_name="dragrig", standalone_mode=False)
            sys.stdout.flush()
        except SystemExit:
            return 0  # click's exit when the reader of standard output has closed it, as `head` does
        except KeyboardInterrupt:
            return print_error(*_sentence_and_code(click.Abort()))
        except Exception as error:  # noqa: BLE001  # the last place where an error can become a sentence
            if isinstance(error, OSError) and _is_reader_gone(error):
                return 0
            known = isinstance(error, DragrigError | click.ClickException)
            # Libraries make errors of their own of Ctrl-C.
            return print_error(*_sentence_and_code(click.Abort() if signals.interrupted and not known else error))
        return returned if isinstance(returned, int) else 0


def _open_closed_streams() -> None:
    """Give a program that was started without standard output or error somewhere to print to."""
    nowhere = None
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            nowhere = nowhere or Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115  # lives as the process does
            setattr(sys, name, nowhere)


def _sentence_and_code(error: Exception) -> tuple[str, int]:
    code = BAD_INPUT
    match error:
        case DragrigError():
            sentence, code = str(error), error.exit_code
        case click.Abort():
            sentence, code = "aborted", AbortedError.exit_code
        case click.ClickException():
            sentence = _usage_sentence(error)
        case OSError() if error.filename is not None:
            sentence = f"{error.filename}: {error.strerror}; check the path and who may use it"
        case OSError() if error.errno in _FULL:
            # Files are written by code that names them.
            sentence = f"standard output takes no more ({error.strerror}); make room, or print elsewhere"
        case ValueError() if foreign := _bytes_as_text(error):
            sentence = f"{foreign!r:.60} {NO_TEXT}"
        case MemoryError():
            sentence = "not enough memory; use fewer samples, or close other programs"
        case _:
            sentence, code = _bug_sentence(error), BUG
    return sentence, code


def _bytes_as_text(error: ValueError) -> str:
    """Return the text that could not be stored, where an error says that it holds bytes that are no UTF-8; else ""."""
    if isinstance(error, UnicodeEncodeError):
        return "" if is_text(error.object) else error.object
    from pydantic import ValidationError

    details = error.errors(include_url=False) if isinstance(error, ValidationError) else []
    return next((str(detail["input"]) for detail in details if detail["type"] == "string_unicode"), "")


def print_error(sentence: str, code: int = BAD_INPUT) -> int:
    """Print an error as one line on standard error; return the exit code."""
    line = " ".join(sentence.splitlines())
    echo(f"dragrig: {line}{'' if line.endswith(('.', '?')) else '.'}", err=True)
    return code


def _usage_sentence(error: click.ClickException) -> str:
    if not isinstance(error, click.UsageError) or error.ctx is None:
        return error.format_message()
    path = error.ctx.command_path.removeprefix("dragrig").strip()
    where = f"{path}: " if path else ""
    if isinstance(error, click.NoSuchOption):
        from dragrig.config import suggestion

        known = [
            name for option in error.ctx.command.get_params(error.ctx) for name in option.opts if name.startswith("--")
        ]
        return f"{where}{error.option_name} is not an option; {suggestion(error.option_name, known)}"
    message = error.format_message()
    if message.endswith("?") or " known are " in message:
        return where + message
    return f"{where}{message.rstrip('.')}; see {error.ctx.command_path} --help."


OWN_FILE_FOLDERS = (("sim_backend", "effects"), ("rig", "protocols"))
"""Where files of one's own are put: effects and kinds of run, with the folders' names in the package."""


def _own_file_place(error: Exception) -> str:
    """Return file and line of a mistake in a file that a person may have added; empty for any other."""
    if isinstance(error, SyntaxError) and error.filename:
        places = [(error.filename, error.lineno or 1)]
    else:
        frames = traceback.extract_tb(error.__traceback__)
        places = [(frame.filename, frame.lineno or 1) for frame in reversed(frames)]
    for name, line in places:
        path = Path(name).resolve()
        is_base = path.name in {"__init__.py", "base.py", "run_state.py"}
        if path.parts[-3:-1] in OWN_FILE_FOLDERS and not is_base:
            return f"{path}, line {line}"
    return ""


def _bug_sentence(error: Exception) -> str:
    if place := _own_file_place(error):
        message = error.msg if isinstance(error, SyntaxError) else f"{type(error).__name__}: {error}"
        return f"{place}: {message[:200]}; correct this file, or take it out of its folder"
    text = "".join(traceback.format_exception(error))
    with tempfile.NamedTemporaryFile(
        "w", prefix="dragrig-bug-", suffix=".log", delete=False, encoding="utf-8"
    ) as report:
        report.write(printable(f"{sys.argv}\n{sys.version}\n\n{text}"))
    return f"a bug ({type(error).__name__}: {str(error)[:120]}); please report it with the details in {report.name}."


_LIKE = {
    **dict.fromkeys("−–─▬", "-"), **dict.fromkeys("“”″", '"'), **dict.fromkeys("’′", "'"), **dict.fromkeys("█▓░●", "#"),
    "○": "o", "μ": "µ", "µ": "u", "≥": ">=", "≤": "<=", "≈": "~", "±": "+-", "×": "x", "·": "*", "•": "*", "→": "->",
    "←": "<-", "│": "|", "°": " deg", "√": "sqrt",
}  # fmt: skip
"""What says the same where a console lacks a sign; Greek letters have their names, and Unicode knows of others."""
_GREEK = re.compile(r"GREEK (SMALL|CAPITAL) LETTER (\w+)")


def legible(text: str, encoding: str) -> str:
    """Return a text in the letters that an encoding has; a character without any likeness is a question mark."""
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        if len(text) > 1:
            return "".join(legible(letter, encoding) for letter in text)
        like = _LIKE.get(text) or unicodedata.normalize("NFKC", text)
        if like == text and (greek := _GREEK.fullmatch(unicodedata.name(text, ""))):
            like = greek[2].lower() if greek[1] == "SMALL" else greek[2].capitalize()
        return legible(like, encoding) if like != text else "?"
    return text


def _replace_unencodable() -> None:
    """Show letters of the same meaning in place of those that the console lacks (− and μ on cp1252)."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            encoding = stream.encoding if stream.isatty() else _redirected_encoding() or stream.encoding
            codecs.register_error(f"dragrig.{encoding}", partial(_legible, encoding))
            stream.reconfigure(encoding=encoding, errors=f"dragrig.{encoding}")


def _redirected_encoding() -> str:
    """Return the console's encoding, in which PowerShell, `more` and `type` take redirected output; else empty."""
    if sys.platform == "win32" and not sys.flags.utf8_mode and "PYTHONIOENCODING" not in os.environ:
        import ctypes

        with suppress(LookupError):  # without a console, and for a code page that Python lacks
            return codecs.lookup(f"cp{ctypes.WinDLL('kernel32').GetConsoleOutputCP()}").name
    return ""


def _legible(encoding: str, error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return legible(error.object[error.start : error.end], encoding), error.end


def _is_reader_gone(error: OSError) -> bool:
    """Whether standard output was closed by its reader."""
    if error.errno not in {errno.EPIPE, errno.EINVAL}:  # Windows says EINVAL
        return False
    try:
        sys.stdout.flush()
    except OSError:
        # What is still buffered would raise again at interpreter exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


def display_path(path: Path) -> str:
    """Return a path as text, relative where it lies below the working folder."""
    try:
        return str(path.absolute().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def join_path(folder: str, name: str) -> str:
    """Return the path of a file in a folder as text, as `Path` writes it."""
    return name if folder == "." else os.path.join(folder, name)  # noqa: PTH118  # of 100,000 files


ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")
FileProgress = Callable[[int, int], None]
"""Called with how much of the work on one file is done, and of how much."""

SILENT_FIRST_S = 1.0
"""Shorter tasks show no progress."""
_FIRST_LINE_S = 5.0
_MAX_LINE_INTERVAL_S = 60.0


class ProgressMeter:
    """Progress on standard error: a bar with the time left on a terminal, else a line now and then.

    The text `above` stands above the bar, drawn anew with it. Nothing is shown in the first second, nor with
    `quiet` (default: that of the running command). Any thread may advance it, one at a time.
    """

    def __init__(
        self,
        label: str,
        total: float = 1.0,
        *,
        quiet: bool | None = None,
        above: "ConsoleRenderable | None" = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._label = label
        self._total = total
        self._done = 0.0
        self._clock = clock
        self._started = clock()
        self._paused_at: float | None = None
        self._above = above
        self._shown = not (is_quiet() if quiet is None else quiet)
        self._bar: tuple[RichProgress, TaskID] | None = None
        self._left = TimeLeft()
        self._next_line_s = _FIRST_LINE_S

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.pause()

    def pause(self) -> None:
        """Remove the bar, and stop the clock; the next step shows it again."""
        self._paused_at = self._paused_at or self._clock()
        if self._bar is not None:
            self._bar[0].stop()
            self._bar = None

    def advance(self, amount: float = 1.0, label: str | None = None) -> None:
        """Add to the finished part of the total, and name the present work."""
        self._done += amount
        self._label = self._label if label is None else label
        if self._paused_at is not None:
            self._started += self._clock() - self._paused_at
            self._paused_at = None
        elapsed_s = self._clock() - self._started
        self._left.at(self._done / self._total if self._total > 0 else 1.0, elapsed_s)
        if not self._shown or elapsed_s < SILENT_FIRST_S:
            return
        with self._silent_once_closed():
            # Once there is a bar, standard error is rich's, which before version 14 says that it is no terminal.
            if self._bar is None and not sys.stderr.isatty():
                self._print_line(elapsed_s)
                return
            if self._bar is None:
                self._bar = _start_bar(self._total, self._above, self._time_left)
            progress, task = self._bar
            progress.update(task, completed=self._done, total=self._total, description=printable(self._label))

    def to(self, done: float, label: str | None = None) -> None:
        """Set how much of the total is done."""
        self.advance(done - self._done, label)

    def at(self, done: float, total: float) -> None:
        """Set the finished part, and the total."""
        self._total = total
        self.to(done)

    def say(self, text: str) -> None:
        """Print a remark on standard error, above the bar."""
        if not self._shown:
            return
        with self._silent_once_closed():
            if self._bar is not None:
                self._bar[0].console.print(printable(text), markup=False, highlight=False, soft_wrap=True)
            else:
                echo(text, err=True)

    def _print_line(self, elapsed_s: float) -> None:
        if elapsed_s < self._next_line_s or not 0 < self._done < self._total:
            return
        self._next_line_s = elapsed_s + min(elapsed_s, _MAX_LINE_INTERVAL_S)
        left = self._time_left()
        echo(f"{self._label}: {100 * self._done / self._total:.0f} %{left and f', {left}'}", err=True)

    def _time_left(self) -> str:
        return self._left.text(self._clock() - self._started)

    @contextmanager
    def _silent_once_closed(self) -> Iterator[None]:
        """Continue silently once standard error is closed: a run must not end because its terminal is gone."""
        try:
            yield
        except OSError:
            self._shown = False


def _start_bar(
    total: float, above: "ConsoleRenderable | None", time_left: Callable[[], str]
) -> "tuple[RichProgress, TaskID]":
    from rich.console import Console
    from rich.progress import BarColumn, Progress, ProgressColumn, TaskProgressColumn, TextColumn
    from rich.text import Text

    class BarBelow(Progress):
        def get_renderables(self) -> "Iterator[RenderableType]":
            if above is not None:
                yield above
            yield from super().get_renderables()

    class LeftColumn(ProgressColumn):
        def render(self, task: "Task") -> Text:
            del task
            return Text(time_left())

    progress = BarBelow(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        LeftColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    task = progress.add_task("", total=total)
    progress.start()
    return progress, task


def with_progress(items: Sequence[ItemT], label: str) -> Iterator[ItemT]:
    """Iterate with progress."""
    for item, _ in with_file_progress(items, label):
        yield item


def with_file_progress(items: Sequence[ItemT], label: str) -> Iterator[tuple[ItemT, FileProgress]]:
    """Iterate with progress; each item comes with a function to report how far the work on it is."""
    with ProgressMeter(label, len(items)) as meter:
        for number, item in enumerate(items):

            def report(done: int, total: int, before: int = number) -> None:
                meter.to(before + done / max(total, 1))

            yield item, report
            meter.to(number + 1, f"{label} ({number + 1} of {len(items)})")


class FileBatch:
    """Files to work on one by one; those that fail are reported at the end."""

    def __init__(self, paths: Sequence[Path], label: str) -> None:
        self._paths = paths
        self._label = label
        self._failures: list[DragrigError] = []

    @classmethod
    def from_good_runs(cls, inputs: Sequence[str], label: str) -> "FileBatch":
        """Collect the named run files without those marked bad, which are reported."""
        from dragrig.run_inputs import good_runs

        runs = good_runs(inputs)
        for path, reason in runs.left_out.items():
            print_remark(f"{path}: left out, marked bad: {reason}")
        return cls(runs.paths, label)

    def process(self, action: Callable[[Path, FileProgress], ResultT]) -> Iterator[tuple[Path, ResultT]]:
        """Apply an action to each file, with progress; yields each file that succeeded with its result."""
        for path, progress in with_file_progress(self._paths, self._label):
            try:
                result = action(path, progress)
            except DragrigError as error:
                self._failures.append(error)
            else:
                yield path, result

    def close(self) -> None:
        """Print the failures; the command then ends with the exit code of the first failure."""
        for error in self._failures:
            print_error(str(error))
        if self._failures:
            click.get_current_context().exit(self._failures[0].exit_code)
