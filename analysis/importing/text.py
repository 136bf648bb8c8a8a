"""Tables from text files: CSV, TSV, columns apart by white space."""

import io
import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from dragrig.analysis.importing.dialect import Dialect, detect, split
from dragrig.analysis.importing.encodings import read_lines
from dragrig.analysis.importing.foreign import BadCell, ForeignColumn, ForeignTable
from dragrig.analysis.importing.units import canonical, unit_of_name
from dragrig.config.errors import ImportDataError

_EXPORTED = re.compile(r"# ([\w-]+): (.*)")
_DECIMAL_COMMA = r"^[-+]?\d*,\d+([eE][-+]?\d+)?$"
_DECIMAL_POINT = r"^[-+]?\d*\.\d*([eE][-+]?\d+)?$"


def read_text(
    path: Path, encoding: str = "", delimiter: str = "", decimal: str = "", header_lines: int | None = None
) -> ForeignTable:
    """Read a text table; what is not given is detected.

    Raises
    ------
    ImportDataError
        When there is no table, its rows differ in width, or its decimal mark is ambiguous.
    """
    lines = read_lines(path, encoding)
    dialect = detect(path, lines, delimiter, header_lines)
    rows = [k for k in range(dialect.first_row, len(lines)) if lines[k].strip()]
    if not rows:
        raise ImportDataError(f"{path}: has no rows of numbers after its header; give a file with data.")
    cells = _cells(path, lines, rows, dialect)
    mark = decimal or _decimal_mark(path, cells)
    names, units = _labels(dialect, cells)
    columns = tuple(_column(name, unit, cell, mark) for name, unit, cell in zip(names, units, cells, strict=True))
    whole = len(rows) == rows[-1] - rows[0] + 1
    return ForeignTable(
        path,
        columns,
        lines=range(rows[0] + 1, rows[-1] + 2) if whole else tuple(k + 1 for k in rows),
        preamble=tuple(lines[: dialect.first_row]),
        export=_exported(lines[: dialect.first_row]),
    )


def _cells(path: Path, lines: Sequence[str], rows: Sequence[int], dialect: Dialect) -> list[pa.Array]:
    """Cells of all rows as text, one array for each column."""
    kept = [lines[k] for k in rows]
    if dialect.delimiter == " ":
        kept = [" ".join(line.split()) for line in kept]
    width = len(split(kept[0], dialect.delimiter))
    names = [str(k) for k in range(width)]
    body = "\n".join(kept).encode("utf-8", "surrogatepass")
    try:
        table = csv.read_csv(
            io.BytesIO(body),
            csv.ReadOptions(column_names=names, block_size=max(1 << 20, 2 * max(map(len, kept)))),
            csv.ParseOptions(delimiter=dialect.delimiter, ignore_empty_lines=False),
            csv.ConvertOptions(column_types=dict.fromkeys(names, pa.string()), strings_can_be_null=False),
        )
    except pa.ArrowInvalid as error:
        raise _ragged(path, lines, rows, dialect, width) from error
    columns = [pc.utf8_trim_whitespace(column.combine_chunks()) for column in table.columns]
    if width > 1 and pc.all(pc.equal(columns[-1], "")).as_py():
        columns.pop()  # each line ends with a delimiter
    return columns


def _ragged(path: Path, lines: Sequence[str], rows: Sequence[int], dialect: Dialect, width: int) -> ImportDataError:
    for k in rows:
        found = len(split(lines[k], dialect.delimiter))
        if found != width:
            return ImportDataError(
                f"{path}: line {k + 1} has {found} cells where the first row has {width}; correct or remove it, or "
                "state delimiter and header_lines."
            )
    return ImportDataError(f"{path}: holds quotes that do not match; remove them.")


def _decimal_mark(path: Path, columns: Sequence[pa.Array]) -> str:
    held = [[_any(column, mark) for mark in ",."] for column in columns]
    if not all(map(any, zip(*held, strict=True))):
        return "," if any(comma for comma, _ in held) else "."
    commas, points = (
        sum(pc.sum(pc.match_substring_regex(column, pattern)).as_py() or 0 for column in columns)
        for pattern in (_DECIMAL_COMMA, _DECIMAL_POINT)
    )
    if commas and points:
        raise ImportDataError(
            f"{path}: has decimal commas in {commas} cells and decimal points in {points}; state the decimal mark."
        )
    return "," if commas else "."


def _any(cells: pa.Array, text: str) -> bool:
    return bool(pc.any(pc.match_substring(cells, text)).as_py())


def _labels(dialect: Dialect, cells: Sequence[pa.Array]) -> tuple[list[str], list[str]]:
    width = len(cells)
    given = [*dialect.names[:width], *[""] * (width - len(dialect.names))]
    names: list[str] = []
    for k, own in enumerate(given):
        name = own or f"column {k + 1}"
        names.append(name if name not in names else f"{name} ({k + 1})")
    units = [canonical(unit) or unit for unit in dialect.units[:width]]
    units += [""] * (width - len(units))
    return names, [unit or unit_of_name(name)[1] or "" for name, unit in zip(names, units, strict=True)]


def _column(name: str, units: str, cells: pa.Array, decimal: str) -> ForeignColumn:
    """Turn cells into numbers; a cell is missing when it is empty."""
    plain = pc.replace_substring_regex(cells, r"^\+", "") if _any(cells, "+") else cells
    if decimal == ",":
        if _any(plain, "."):
            plain = pc.if_else(pc.match_substring(plain, "."), "a point where commas are decimal marks", plain)
        plain = pc.replace_substring(plain, ",", ".", max_replacements=1)
    filled = pc.if_else(pc.equal(plain, ""), None, plain)
    try:
        numbers = pc.cast(filled, pa.float64())
    except pa.ArrowInvalid:
        return ForeignColumn(name, units, np.full(len(cells), np.nan), _first_bad(cells, filled))
    values = np.asarray(numbers.to_numpy(zero_copy_only=False), dtype=np.float64)
    return ForeignColumn(name, units, values)


def _first_bad(cells: pa.Array, filled: pa.Array) -> BadCell:
    """Find the first cell that is no number, by halving."""
    start, stop = 0, len(filled)
    while stop - start > 1:
        middle = (start + stop) // 2
        try:
            pc.cast(filled[start:middle], pa.float64())
        except pa.ArrowInvalid:
            stop = middle
        else:
            start = middle
    return BadCell(start, str(cells[start].as_py()))


def _exported(preamble: Sequence[str]) -> dict[str, object]:
    """Read back the comment lines that an export of ours begins with."""
    found = {match[1]: match[2] for line in preamble if (match := _EXPORTED.fullmatch(line))}
    if "dragrig-export" not in found:
        return {}
    try:
        return {key: json.loads(value) for key, value in found.items()}
    except ValueError:
        return {}
