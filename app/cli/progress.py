"""Progress on standard error: a bar with the time left on a terminal, a plain line now and then elsewhere."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Self, TypeVar

import click

from dragrig.cli.console import is_quiet
from dragrig.cli.wording import duration

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

ItemT = TypeVar("ItemT")

SILENT_S = 1.0
"""What takes less shows no progress."""
_FIRST_LINE_S = 5.0
_LONGEST_BETWEEN_LINES_S = 60.0


class Meter:
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
        self._line: _Bar | _Lines | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.pause()

    def pause(self) -> None:
        """Take the bar off the screen; the next step brings it back."""
        if isinstance(self._line, _Bar):
            self._line.close()
            self._line = None

    def advance(self, amount: float = 1.0, label: str | None = None) -> None:
        """Tell that so much more of the total is done, and what is being done now."""
        self._done += amount
        self._label = self._label if label is None else label
        elapsed = self._clock() - self._begun
        if not self._shown or elapsed < SILENT_S:
            return
        with self._until_nobody_looks():
            if self._line is None:
                self._line = _Bar(self._total) if sys.stderr.isatty() else _Lines(self._total)
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
            if isinstance(self._line, _Bar):
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


def tracked(items: Sequence[ItemT], label: str) -> Iterator[ItemT]:
    """Iterate with progress."""
    for item, _ in tracked_within(items, label):
        yield item


def tracked_within(items: Sequence[ItemT], label: str) -> Iterator[tuple[ItemT, Callable[[int, int], None]]]:
    """Iterate with progress; each item comes with a function that tells how far the work on it is."""
    with Meter(label, len(items), quiet=is_quiet()) as meter:
        for number, item in enumerate(items):

            def within(done: int, of: int, before: int = number) -> None:
                meter.to(before + done / max(of, 1))

            yield item, within
            meter.to(number + 1, f"{label} ({number + 1} of {len(items)})")


class _Bar:
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


class _Lines:
    def __init__(self, total: float) -> None:
        self._total = total
        self._due_s = _FIRST_LINE_S

    def show(self, label: str, done: float, elapsed_s: float) -> None:
        if elapsed_s < self._due_s or not 0 < done < self._total:
            return
        self._due_s = elapsed_s + min(elapsed_s, _LONGEST_BETWEEN_LINES_S)
        left_s = elapsed_s * max(self._total - done, 0.0) / done
        click.echo(f"{label}: {100 * done / self._total:.0f} %, {duration(left_s)} left", err=True)
