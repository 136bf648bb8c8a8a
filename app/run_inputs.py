"""Run files named on the command line or in a call: files, patterns and folders."""

import glob
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dragrig.config import DEFAULT_DATA_ROOT, RunFileError, data_root_of
from dragrig.rig import FINISHED_SUFFIX, RECORDING_SUFFIX, Campaign, campaign_of, read_mark, read_marked


def run_files(inputs: Sequence[str | Path]) -> tuple[Path, ...]:
    """Return the named run files, in order and without duplicates.

    Parameters
    ----------
    inputs
        Files, patterns as `runs/*-drag-*.h5` (not every shell expands them), and folders, which mean their finished run
        files.

    Raises
    ------
    RunFileError
        For a name that matches no file.
    """
    return tuple(dict.fromkeys(path for name in inputs for path in _matching_files(name)))


def input_files(inputs: Sequence[str | Path]) -> tuple[Path, ...]:
    """Return the named files of any kind: files and patterns, in order and without duplicates.

    Raises
    ------
    RunFileError
        For a name that matches no file.
    """
    paths = [path for name in inputs for path in ((Path(name),) if Path(name).is_dir() else _matching_files(name))]
    for folder in (path for path in paths if path.is_dir()):
        raise RunFileError(f"{folder}: is a folder; name the files in it, as {folder / '*.csv'}.")
    return tuple(dict.fromkeys(paths))


@dataclass(frozen=True, slots=True)
class GoodRuns:
    """Run files, and those left out because they are marked bad, with the reason."""

    paths: tuple[Path, ...]
    left_out: Mapping[Path, str]


def good_runs(inputs: Sequence[str | Path]) -> GoodRuns:
    """Return the named run files without those marked bad; a run named itself counts whatever its mark.

    Raises
    ------
    RunFileError
        As `run_files`, and for a mark that cannot be read.
    """
    named = {Path(name) for name in inputs}
    paths = run_files(inputs)
    marks = {path: read_mark(path) for path in paths if path not in named}
    left_out = {path: mark.reason for path, mark in marks.items() if mark is not None}
    return GoodRuns(tuple(path for path in paths if path not in left_out), left_out)


def newest_campaign() -> Path:
    """Return the campaign whose run file is the newest in the lab's data root, outside of a lab in `runs` here.

    Raises `RunFileError` where there is none.
    """
    root = data_root_of(Path.cwd()) or Path(DEFAULT_DATA_ROOT)
    files = [path for path in root.glob(f"*/*{FINISHED_SUFFIX}") if not path.name.endswith(RECORDING_SUFFIX)]
    if not files:
        raise RunFileError(f"{root}: there is no campaign in it yet; name a campaign's folder.")
    return max(files, key=lambda path: path.stat().st_mtime_ns).parent


def named_campaigns(named: Sequence[str | Path]) -> tuple[tuple[Path, ...], Campaign | None]:
    """Return the folders of the campaigns that are named, and where run files of one are named those of its runs.

    Raises
    ------
    RunFileError
        For run files of several campaigns, or beside folders.
    """
    paths = [Path(name) for name in named]
    files = [path for path in paths if path.suffix == FINISHED_SUFFIX and path.is_file()]
    if not files:
        return tuple(paths), None
    folders = {path.parent for path in files}
    if len(folders) > 1 or any(path.is_dir() for path in paths):
        raise RunFileError(f"{files[-1]}: run files may be named of one campaign alone; name the folders of several.")
    (folder,) = folders
    return (folder,), campaign_of(folder, files, read_marked)


def _matching_files(name: str | Path) -> list[Path]:
    path = Path(name)
    if path.is_dir():
        return require_run_files(path)
    if path.exists():
        return [path]
    if not glob.has_magic(str(name)):
        raise RunFileError(f"{path}: there is no such file or folder; check the path.")
    matches = glob.glob(str(name), recursive=True)  # noqa: PTH207  # Path.glob refuses an absolute pattern
    paths = sorted(match for match in map(Path, matches) if not match.name.endswith(RECORDING_SUFFIX))
    if not paths:
        raise RunFileError(f"{name}: no file matches this pattern; check it.")
    return paths


def require_run_files(folder: Path) -> list[Path]:
    """Return the finished runs of a folder.

    Raises `RunFileError` where it has none, with the known places of runs.
    """
    paths = sorted(path for path in folder.glob("*.h5") if not path.name.endswith(RECORDING_SUFFIX))
    if paths:
        return paths
    if any(folder.glob(f"*{RECORDING_SUFFIX}")):
        raise RunFileError(
            f"{folder}: holds no finished run, only a recording that is in progress or was left by a crash; once "
            f"nothing records, finish it with dragrig recover {folder}."
        )
    below = sorted(path.parent.name for path in folder.glob("*/*.h5"))
    hint = f"did you mean {folder / below[-1]}?" if below else "name a campaign's folder or a run file."
    raise RunFileError(f"{folder}: holds no run files; {hint}")
