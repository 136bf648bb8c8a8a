"""Doing the same to many run files: one that fails does not keep the others from being done."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import click

from dragrig.cli.console import complain, say
from dragrig.cli.progress import tracked_within
from dragrig.config.errors import DragrigError

ResultT = TypeVar("ResultT")
Within = Callable[[int, int], None]
"""Tells how far the work on one file is."""


class Batch:
    """Files to work on; gathers what fails."""

    def __init__(self, paths: Sequence[Path], label: str) -> None:
        self._paths = paths
        self._label = label
        self._failures: list[DragrigError] = []

    @classmethod
    def of_good_runs(cls, inputs: Sequence[str], label: str) -> "Batch":
        """Gather the run files that are named, and say which were left out because they are marked bad."""
        from dragrig.inputs import good_runs

        found = good_runs(inputs)
        for path, reason in found.left_out.items():
            say(f"{path}: left out, marked bad: {reason}")
        return cls(found.paths, label)

    def each(self, action: Callable[[Path, Within], ResultT]) -> Iterator[tuple[Path, ResultT]]:
        """Do it to each file, with progress; what a file's error says is told at the end."""
        for path, within in tracked_within(self._paths, self._label):
            try:
                done = action(path, within)
            except DragrigError as error:
                self._failures.append(error)
            else:
                yield path, done

    def close(self) -> None:
        """Tell what failed; the command then ends with the exit code of the first failure."""
        for error in self._failures:
            complain(str(error))
        if self._failures:
            click.get_current_context().exit(self._failures[0].exit_code)
