"""What all commands share: output, progress bars, interrupts, errors as one sentence and an exit code."""

import errno
import json
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self, TypeVar

import click

from dragrig.config.errors import AbortedError, DragrigError
from dragrig.present.json_values import to_json_value
from dragrig.present.numbers import duration_text

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


QUIET = "dragrig.quiet"
"""Key in a click context's `meta`: whether only results and errors are wanted."""

BUG = 1
BAD_INPUT = 2


def print_result(text: str) -> None:
    """Print a result on standard output."""
    click.echo(text)


def print_json(value: object) -> None:
    """Print a result as JSON on standard output: dataclasses as objects, NaN and infinities as null."""
    click.echo(json.dumps(to_json_value(value), indent=2, allow_nan=False))


def print_remark(text: str) -> None:
    """Tell the person something that is no result, on standard error, unless they asked for quiet."""
    if not is_quiet():
        click.echo(text, err=True)


def is_quiet() -> bool:
    """Whether the running command was asked to print results and errors only."""
    context = click.get_current_context(silent=True)
    return context is not None and bool(context.meta.get(QUIET, False))


def run_command_line(command: click.Command, arguments: Sequence[str] | None) -> int:
    """Run a command and return its exit code; whatever goes wrong is told in one sentence."""
    _replace_unencodable()
    try:
        returned = command.main(args=arguments, prog_name="dragrig", standalone_mode=False)
        sys.stdout.flush()
    except SystemExit:
        return 0  # click's way out when whoever read our standard output has closed it, as `head` does
    except Exception as error:  # noqa: BLE001  # the last place where a person can be told in a sentence
        return _report_error(error)
    return returned if isinstance(returned, int) else 0


def _report_error(error: Exception) -> int:
    if isinstance(error, OSError) and _is_reader_gone(error):
        return 0
    return print_error(*_sentence_and_code(error))


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
        case MemoryError():
            sentence = "there is not enough memory for this; take fewer samples, or close other programs"
        case _:
            sentence, code = _bug_sentence(error), BUG
    return sentence, code


def print_error(sentence: str, code: int = BAD_INPUT) -> int:
    """Tell what is wrong in one line on standard error; return the exit code."""
    line = " ".join(sentence.splitlines())
    click.echo(f"dragrig: {line}{'' if line.endswith(('.', '?')) else '.'}", err=True)
    return code


def _usage_sentence(error: click.ClickException) -> str:
    if not isinstance(error, click.UsageError) or error.ctx is None:
        return error.format_message()
    path = error.ctx.command_path.removeprefix("dragrig").strip()
    where = f"{path}: " if path else ""
    if isinstance(error, click.NoSuchOption):
        from dragrig.config.settings import suggestion

        known = [name for one in error.ctx.command.get_params(error.ctx) for name in one.opts if name.startswith("--")]
        return f"{where}{error.option_name} is not an option; {suggestion(error.option_name, known)}"
    message = error.format_message()
    if message.endswith("?") or " known are " in message:
        return where + message
    return f"{where}{message.rstrip('.')}; see {error.ctx.command_path} --help."


def _bug_sentence(error: Exception) -> str:
    text = "".join(traceback.format_exception(error))
    with tempfile.NamedTemporaryFile(
        "w", prefix="dragrig-bug-", suffix=".log", delete=False, encoding="utf-8"
    ) as report:
        report.write(f"{sys.argv}\n{sys.version}\n\n{text}")
    return f"a bug ({type(error).__name__}: {str(error)[:120]}); please report it with the details in {report.name}."


def _replace_unencodable() -> None:
    """Let a console that lacks a character (μ on cp1252) show a stand-in for it."""
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="replace")


def _is_reader_gone(error: OSError) -> bool:
    """Whether the last of our standard output found nobody who reads it."""
    if error.errno not in {errno.EPIPE, errno.EINVAL}:  # Windows says EINVAL
        return False
    try:
        sys.stdout.flush()
    except OSError:
        # What is still buffered would raise again when the interpreter ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return True
    return False


def display_path(path: Path) -> str:
    """Spell a path for a person: relative where it lies below the working folder."""
    try:
        return str(path.absolute().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


ItemT = TypeVar("ItemT")

SILENT_FIRST_S = 1.0
"""What takes less shows no progress."""
_FIRST_LINE_S = 5.0
_MAX_LINE_INTERVAL_S = 60.0


class ProgressMeter:
    """How far a task is; silent for its first second, and altogether when it is told to be quiet.

    Any thread may advance it, one at a time.
    """

    def __init__(self, label: str, total: float, *, quiet: bool, clock: Callable[[], float] = time.monotonic) -> None:
        self._label = label
        self._total = total
        self._done = 0.0
        self._clock = clock
        self._begun = clock()
        self._shown = not quiet
        self._line: _ProgressBar | _ProgressLines | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.pause()

    def pause(self) -> None:
        """Take the bar off the screen; the next step brings it back."""
        if isinstance(self._line, _ProgressBar):
            self._line.close()
            self._line = None

    def advance(self, amount: float = 1.0, label: str | None = None) -> None:
        """Tell that so much more of the total is done, and what is being done now."""
        self._done += amount
        self._label = self._label if label is None else label
        elapsed = self._clock() - self._begun
        if not self._shown or elapsed < SILENT_FIRST_S:
            return
        with self._until_nobody_looks():
            if self._line is None:
                self._line = _ProgressBar(self._total) if sys.stderr.isatty() else _ProgressLines(self._total)
            self._line.show(self._label, self._done, elapsed)

    def to(self, done: float, label: str | None = None) -> None:
        """Tell how much of the total is done altogether."""
        self.advance(done - self._done, label)

    def at(self, done: float, of: float) -> None:
        """Tell how far the task is when the total is known only now."""
        self._total = of
        self.to(done)

    def say(self, text: str) -> None:
        """Print a remark on standard error, above the bar where there is one."""
        if not self._shown:
            return
        with self._until_nobody_looks():
            if isinstance(self._line, _ProgressBar):
                self._line.say(text)
            else:
                click.echo(text, err=True)

    @contextmanager
    def _until_nobody_looks(self) -> Iterator[None]:
        """Go on in silence once standard error is closed: a run must not end because nobody watches it."""
        try:
            yield
        except OSError:
            self._shown = False


def with_progress(items: Sequence[ItemT], label: str) -> Iterator[ItemT]:
    """Iterate with progress."""
    for item, _ in with_file_progress(items, label):
        yield item


def with_file_progress(items: Sequence[ItemT], label: str) -> Iterator[tuple[ItemT, Callable[[int, int], None]]]:
    """Iterate with progress; each item comes with a function that tells how far the work on it is."""
    with ProgressMeter(label, len(items), quiet=is_quiet()) as meter:
        for number, item in enumerate(items):

            def within(done: int, of: int, before: int = number) -> None:
                meter.to(before + done / max(of, 1))

            yield item, within
            meter.to(number + 1, f"{label} ({number + 1} of {len(items)})")


class _ProgressBar:
    def __init__(self, total: float) -> None:
        self._progress, self._task = _rich_progress(total)
        self._progress.start()

    def show(self, label: str, done: float, elapsed_s: float) -> None:
        del elapsed_s
        self._progress.update(self._task, completed=done, description=label)

    def say(self, text: str) -> None:
        self._progress.console.print(text, markup=False, highlight=False, soft_wrap=True)

    def close(self) -> None:
        self._progress.stop()


def _rich_progress(total: float) -> "tuple[Progress, TaskID]":
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    progress = Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    return progress, progress.add_task("", total=total)


class _ProgressLines:
    def __init__(self, total: float) -> None:
        self._total = total
        self._due_s = _FIRST_LINE_S

    def show(self, label: str, done: float, elapsed_s: float) -> None:
        if elapsed_s < self._due_s or not 0 < done < self._total:
            return
        self._due_s = elapsed_s + min(elapsed_s, _MAX_LINE_INTERVAL_S)
        left_s = elapsed_s * max(self._total - done, 0.0) / done
        click.echo(f"{label}: {100 * done / self._total:.0f} %, {duration_text(left_s)} left", err=True)


ResultT = TypeVar("ResultT")
FileProgress = Callable[[int, int], None]
"""Tells how far the work on one file is."""


class FileBatch:
    """Files to work on; gathers what fails."""

    def __init__(self, paths: Sequence[Path], label: str) -> None:
        self._paths = paths
        self._label = label
        self._failures: list[DragrigError] = []

    @classmethod
    def of_good_runs(cls, inputs: Sequence[str], label: str) -> "FileBatch":
        """Gather the run files that are named, and say which were left out because they are marked bad."""
        from dragrig.run_inputs import good_runs

        found = good_runs(inputs)
        for path, reason in found.left_out.items():
            print_remark(f"{path}: left out, marked bad: {reason}")
        return cls(found.paths, label)

    def each(self, action: Callable[[Path, FileProgress], ResultT]) -> Iterator[tuple[Path, ResultT]]:
        """Do it to each file, with progress; what a file's error says is told at the end."""
        for path, within in with_file_progress(self._paths, self._label):
            try:
                done = action(path, within)
            except DragrigError as error:
                self._failures.append(error)
            else:
                yield path, done

    def close(self) -> None:
        """Tell what failed; the command then ends with the exit code of the first failure."""
        for error in self._failures:
            print_error(str(error))
        if self._failures:
            click.get_current_context().exit(self._failures[0].exit_code)
