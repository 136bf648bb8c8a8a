"""Encoding, delimiter and header of a text file that holds a table."""

import codecs
import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dragrig.analysis.importing.foreign import canonical_unit
from dragrig.config.errors import ImportDataError

_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_SAMPLE_BYTES = 4096


def detect_encoding(data: bytes) -> str:
    """Return the encoding of a text file.

    A byte order mark decides; without one, zero bytes at every second place mean UTF-16; otherwise it is
    UTF-8 when it can be, and cp1252 when not.
    """
    for mark, encoding in _BYTE_ORDER_MARKS:
        if data.startswith(mark):
            return encoding
    sample = data[:_SAMPLE_BYTES]
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


DELIMITERS = ("\t", ";", "|", ",", " ")
"""In the order in which they win when two would do as well; the last stands for any white space."""
_NUMBER_PATTERN = re.compile(r"[-+]?(\d+\.?\d*|\d*[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf(inity)?)", re.IGNORECASE)
_COMMENT_PATTERN = re.compile(r"\s*(#|%|//)\s?")
_SAMPLE_LINES = 400


@dataclass(frozen=True, slots=True)
class TextDialect:
    """What is known of a text table before its numbers are read.

    Attributes
    ----------
    first_row
        Index of the first line of numbers, from 0.
    names, units
        One for each column; empty where the file has none.
    """

    delimiter: str
    first_row: int
    names: tuple[str, ...]
    units: tuple[str, ...]


def split_cells(line: str, delimiter: str) -> list[str]:
    """Split a line into cells, without the white space and quotes around them."""
    if delimiter == " ":
        return line.split()
    if '"' in line:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]
    return [cell.strip() for cell in line.split(delimiter)]


def is_number(cell: str) -> bool:
    """Tell whether a cell is a number with either decimal mark."""
    return _NUMBER_PATTERN.fullmatch(cell) is not None


def detect_dialect(
    path: Path, lines: Sequence[str], delimiter: str = "", header_lines: int | None = None
) -> TextDialect:
    """Find delimiter, first row, names and units; what is given is taken as it is.

    Raises
    ------
    ImportDataError
        When there is no table of numbers.
    """
    sample = _sample_lines(lines[header_lines or 0 :])
    found = max(
        (_delimiter_score(sample, one), -rank, one) for rank, one in enumerate([delimiter] if delimiter else DELIMITERS)
    )
    (numeric, _), _, chosen = found
    if numeric == 0:
        raise ImportDataError(
            f"{path}: holds no table of numbers that could be told apart by tab, semicolon, bar, comma or white space; "
            "state delimiter and header_lines if it does."
        )
    width, numbers = _table_shape(sample, chosen)
    first = header_lines if header_lines is not None else _first_row(lines, chosen, numbers)
    while first < len(lines) and not lines[first].strip():
        first += 1
    width = max(width, 1)
    names, units = _header_rows(lines[:first], chosen, width)
    return TextDialect(chosen, first, names, units)


def _sample_lines(lines: Sequence[str]) -> list[str]:
    """Lines from all over the file, so that a preamble is a small part of them."""
    some = lines[:: max(1, len(lines) // _SAMPLE_LINES)]
    return [line for line in some if line.strip() and not _COMMENT_PATTERN.match(line)]


def _table_shape(sample: Sequence[str], delimiter: str) -> tuple[int, tuple[int, ...]]:
    """Most common number of cells, and which of them are mostly numbers."""
    rows = [split_cells(line, delimiter) for line in sample]
    with_numbers = [row for row in rows if any(map(is_number, row))]
    if not with_numbers:
        return 0, ()
    width = Counter(map(len, with_numbers)).most_common(1)[0][0]
    rows = [row for row in with_numbers if len(row) == width]
    counts = [sum(is_number(row[k]) for row in rows) for k in range(width)]
    texts = [sum(bool(row[k]) and not is_number(row[k]) for row in rows) for k in range(width)]
    return width, tuple(k for k in range(width) if counts[k] > texts[k])


def _delimiter_score(sample: Sequence[str], delimiter: str) -> tuple[int, float]:
    """How many columns of numbers a delimiter yields, then what part of all columns they are."""
    width, numbers = _table_shape(sample, delimiter)
    return len(numbers), len(numbers) / width if width else 0.0


def _first_row(lines: Sequence[str], delimiter: str, numbers: Sequence[int]) -> int:
    """First line with numbers in at least half of the columns that hold numbers."""
    for k, line in enumerate(lines):
        if not line.strip() or _COMMENT_PATTERN.match(line):
            continue
        cells = split_cells(line, delimiter)
        good = sum(column < len(cells) and is_number(cells[column]) for column in numbers)
        if good and 2 * good >= len(numbers):
            return k
    return len(lines)


def _header_rows(lines: Sequence[str], delimiter: str, width: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units from the last lines before the table, as far as they have its width."""
    rows = [cells for line in lines if line.strip() and (cells := _header_cells(line, delimiter, width))]
    if not rows:
        return (), ()
    if len(rows) > 1 and _are_units(rows[-1]) and not _are_units(rows[-2]):
        return tuple(rows[-2]), tuple(rows[-1])
    return tuple(rows[-1]), ()


def _header_cells(line: str, delimiter: str, width: int) -> list[str]:
    """Cells of a line that is as wide as the table, but for empty cells at the end; else none."""
    cells = split_cells(_COMMENT_PATTERN.sub("", line, count=1), delimiter)
    while len(cells) > width and not cells[-1]:
        cells.pop()
    missing = width - len(cells)
    if missing and not (missing == 1 and delimiter != " " and width > 2):
        return []
    return cells + [""] * missing


def _are_units(cells: Sequence[str]) -> bool:
    filled = [cell for cell in cells if cell]
    return bool(filled) and all(canonical_unit(cell) is not None for cell in filled)
