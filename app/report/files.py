"""Pages and tables into a folder."""

from collections.abc import Mapping
from pathlib import Path

from dragrig.config.errors import OutputError


def taken(folder: Path, names: tuple[str, ...]) -> tuple[Path, ...]:
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
