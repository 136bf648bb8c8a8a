"""Pictures into files: whole or not at all, and the same bytes each time."""

import io
import os
import tempfile
from pathlib import Path

from matplotlib.figure import Figure

from dragrig.config.errors import OutputError
from dragrig.figures.style import drawing

FORMATS = {".png": {"Software": "dragrig"}, ".svg": {"Date": None, "Creator": "dragrig"}}
"""File names' endings that can be written, and what the file says of itself: never when it was made."""


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
        raise OutputError(f"{path}: cannot be written ({error.strerror}); check the folder.") from error
    return path


def _put(content: bytes, path: Path) -> None:
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    unfinished = Path(name)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
