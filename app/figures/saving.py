"""Pictures into files: whole or not at all, and the same bytes each time."""

import io
import os
from itertools import count
from pathlib import Path

from matplotlib.figure import Figure

from dragrig.config.errors import OutputError
from dragrig.figures.style import drawing
from dragrig.rig.runfile.files import drop

FORMATS = {".png": {"Software": "dragrig"}, ".svg": {"Date": None, "Creator": "dragrig"}}
"""Endings of files that can be written, and what such a file says of itself: never when it was made."""


def save(figure: Figure, path: Path, overwrite: bool = False) -> Path:
    """Write a picture as PNG or SVG, by its name's ending, and return the path.

    Raises
    ------
    OutputError
        When the ending is another one, the file exists and may not be replaced, or the folder cannot be written to.
    """
    ending = path.suffix.lower()
    if ending not in FORMATS:
        raise OutputError(f"{path}: a picture is written as {' or '.join(FORMATS)}; change the name's ending.")
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: is there already; choose another name or say --overwrite.")
    content = io.BytesIO()
    with drawing():
        figure.savefig(content, format=ending[1:], metadata=FORMATS[ending])
    try:
        _put(content.getvalue(), path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose a folder that can.") from error
    return path


def save_in(folder: Path, name: str, figure: Figure, overwrite: bool = False) -> Path:
    """Write a picture under a name that nobody chose: where it is taken, a number is added to it.

    The folder is made if there is none. Raises as `save` does.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise OutputError(f"{folder}: is a file; name a folder for the pictures.") from error
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror}); choose another folder.") from error
    path = folder / name
    return save(figure, path if overwrite else _free(path), overwrite)


def _free(path: Path) -> Path:
    names = (path if number == 1 else path.with_stem(f"{path.stem}-{number}") for number in count(1))
    return next(name for name in names if not name.exists())


def _put(content: bytes, path: Path) -> None:
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        unfinished.write_bytes(content)
        unfinished.replace(path)
    finally:
        drop(unfinished)
