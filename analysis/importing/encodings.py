"""Text out of bytes, in whichever encoding an instrument wrote it."""

import codecs
from pathlib import Path

from dragrig.config.errors import ImportDataError

_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_SAMPLE = 4096


def detect_encoding(data: bytes) -> str:
    """Return the encoding of a text file.

    A byte order mark decides; without one, zero bytes at every second place mean UTF-16; otherwise it is
    UTF-8 when it can be, and cp1252 when not.
    """
    for mark, encoding in _MARKS:
        if data.startswith(mark):
            return encoding
    sample = data[:_SAMPLE]
    if sample[1::2].count(0) > len(sample) // 4:
        return "utf-16-le"
    if sample[::2].count(0) > len(sample) // 4:
        return "utf-16-be"
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def read_lines(path: Path, encoding: str = "") -> list[str]:
    """Read a text file's lines, of whichever system; `encoding` overrides what is detected.

    Raises
    ------
    ImportDataError
        When the file cannot be read, is empty, or is not text of this encoding.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImportDataError(f"{path}: cannot be read ({error.strerror}); check the path.") from error
    if not data.strip(b"\r\n\t \0"):
        raise ImportDataError(f"{path}: is empty; give a file with a table of numbers.")
    used = encoding or detect_encoding(data)
    try:
        text = data.decode(used)
    except LookupError:
        raise ImportDataError(
            f"{path}: the encoding {used!r} is not known; give one such as utf-8, cp1252 or utf-16."
        ) from None
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ImportDataError(
            f"{path}: line {line} is not text in the encoding {used}; state the right one, such as cp1252 or utf-16."
        ) from error
    if "\0" in text:
        raise ImportDataError(
            f"{path}: is not text but binary; MAT, Parquet and TDMS files are known by their endings."
        )
    return text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n").split("\n")
