"""Pages, tables and texts written into files; names of the files of the paper report."""

from collections.abc import Mapping
from itertools import chain, count
from pathlib import Path

from dragrig.config.errors import OutputError


def existing_files(folder: Path, names: tuple[str, ...]) -> tuple[Path, ...]:
    """Return those of these files that are there already."""
    return tuple(folder / name for name in names if (folder / name).exists())


def write_texts(folder: Path, texts: Mapping[str, str]) -> tuple[Path, ...]:
    """Write texts under their names, replacing what is there; return the paths.

    Raises
    ------
    OutputError
        When the folder cannot be made or refuses.
    """
    paths = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            path = folder / name
            path.write_text(text, "utf-8", newline="")
            paths.append(path)
    except OSError as error:
        where = error.filename or folder
        raise OutputError(f"{where}: cannot be written ({error.strerror}); choose another folder.") from error
    return tuple(paths)


def require_writable(path: Path, *, overwrite: bool) -> None:
    """Ask before the work whether a file can be written; raises `OutputError` where it cannot."""
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; name a file.")
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: is there already; name another file, or say --overwrite.")
    if not path.absolute().parent.is_dir():
        raise OutputError(f"{path}: there is no folder {path.parent}; make it, or name another.")


def write_text(text: str, path: Path, *, overwrite: bool, make_folder: bool = False) -> Path:
    """Write one file and return its path; raises `OutputError` as `require_writable`, and where the folder refuses."""
    try:
        if make_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        require_writable(path, overwrite=overwrite)
        path.write_text(text, "utf-8", newline="\n")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another place.") from error
    return path


def unused_path(path: Path, suffix: str = "") -> Path:
    """Return the path, or one with the first free number before its suffix where it exists."""
    stem = path.name.removesuffix(suffix)
    numbered = (path.with_name(f"{stem}-{number}{suffix}") for number in count(2))
    return next(candidate for candidate in chain([path], numbered) if not candidate.exists())


PAPER_REPORT_FILE = "report.html"
PAPER_MODEL_FILE = "model.toml"
"""The identified friction model, as the simulator loads it."""
PAPER_TABLES = (
    "elements",
    "skew-maximum",
    "skew-resistance",
    "coulomb",
    "forces",
    "parameters",
    "combinations",
    "joint-runs",
    "drag",
    "determination",
    "eq15-examples",
    "findings",
)
"""Stems of the CSV files, in the order of the report."""
