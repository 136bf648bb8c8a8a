"""Run files named on the command line or in a call: files, patterns and folders."""

import glob
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dragrig.config.errors import RunFileError
from dragrig.rig.runfile import read_mark
from dragrig.rig.runfile.schema import RECORDING_SUFFIX


def run_files(inputs: Sequence[str | Path]) -> tuple[Path, ...]:
    """Return the run files that are named, in order and each once.

    Parameters
    ----------
    inputs
        Files, patterns as `runs/*-drag-*.h5` (not every shell expands them), and folders, which stand for
        the finished run files in them.

    Raises
    ------
    RunFileError
        For a name that stands for no file.
    """
    return tuple(dict.fromkeys(path for one in inputs for path in _matching_files(one)))


def input_files(inputs: Sequence[str | Path]) -> tuple[Path, ...]:
    """Return the files that are named, of any kind: files and patterns, in order and each once.

    Raises
    ------
    RunFileError
        For a name that stands for no file.
    """
    found = [path for one in inputs for path in ((Path(one),) if Path(one).is_dir() else _matching_files(one))]
    folder = next((path for path in found if path.is_dir()), None)
    if folder is not None:
        raise RunFileError(f"{folder}: is a folder; name the files in it, as {folder / '*.csv'}.")
    return tuple(dict.fromkeys(found))


@dataclass(frozen=True, slots=True)
class GoodRuns:
    """Run files to work on, and those that were left out because they are marked bad, with the reason."""

    paths: tuple[Path, ...]
    left_out: Mapping[Path, str]


def good_runs(inputs: Sequence[str | Path]) -> GoodRuns:
    """Return the run files that are named, without those marked bad that a folder or pattern stands for.

    A run that is named itself is meant, whatever its mark says.

    Raises
    ------
    RunFileError
        As `run_files`, and for a mark that cannot be read.
    """
    named = {Path(one) for one in inputs}
    paths = run_files(inputs)
    marks = {path: read_mark(path) for path in paths if path not in named}
    left_out = {path: mark.reason for path, mark in marks.items() if mark is not None}
    return GoodRuns(tuple(path for path in paths if path not in left_out), left_out)


def _matching_files(name: str | Path) -> Iterator[Path]:
    path = Path(name)
    if path.is_dir():
        yield from _run_files_in(path)
    elif path.exists() or not glob.has_magic(str(name)):
        yield _require_existing(path)
    else:
        matches = glob.glob(str(name), recursive=True)  # noqa: PTH207  # Path.glob refuses an absolute pattern
        found = sorted(one for one in map(Path, matches) if not _is_recording(one))
        if not found:
            raise RunFileError(f"{name}: no file fits this pattern; check it.")
        yield from found


def _run_files_in(folder: Path) -> list[Path]:
    found = sorted(one for one in folder.glob("*.h5") if not _is_recording(one))
    if found:
        return found
    if any(folder.glob(f"*{RECORDING_SUFFIX}")):
        raise RunFileError(
            f"{folder}: holds no finished run, only a recording that a crash left or that goes on right now; once "
            f"nothing records, finish it with dragrig recover {folder}."
        )
    below = sorted(one.parent.name for one in folder.glob("*/*.h5"))
    hint = f"did you mean {folder / below[-1]}?" if below else "name a campaign's folder or a run file."
    raise RunFileError(f"{folder}: holds no run files; {hint}")


def _require_existing(path: Path) -> Path:
    if not path.exists():
        raise RunFileError(f"{path}: there is no such file or folder; check the path.")
    return path


def _is_recording(path: Path) -> bool:
    return path.name.endswith(RECORDING_SUFFIX)
