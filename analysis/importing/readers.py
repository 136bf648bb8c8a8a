"""Reading a foreign file, whatever it is: all its tables, of which those with the columns of the largest are taken."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import date, timedelta
from datetime import time as time_of_day
from functools import partial
from pathlib import Path

from dragrig.analysis.importing import file_kinds
from dragrig.analysis.importing.containers import read_arrow, read_json, read_numpy
from dragrig.analysis.importing.file_kinds import (
    PACKED,
    FileKind,
    damage_reported,
    detect_encoding,
    file_kind,
    require_bounded,
    unpacked,
    zipped_bytes,
)
from dragrig.analysis.importing.foreign import ForeignTable
from dragrig.analysis.importing.import_settings import ImportSettings
from dragrig.analysis.importing.matlab import read_mat, read_mat73
from dragrig.analysis.importing.tdms import read_tdms
from dragrig.analysis.importing.text import text_tables
from dragrig.config import ImportDataError, suggestion

MIN_TABLE_ROWS = 3
"""A table with fewer rows is no recording, where there are others."""
TEXT_OPTIONS = ("encoding", "delimiter", "decimal", "header_lines")


def read_foreign(path: Path, settings: ImportSettings | None = None) -> tuple[ForeignTable, ...]:
    """Read the tables of a measurement that become runs: the named table, or those with the columns of the largest.

    All else in the file is named in the remarks of the first table.

    Raises `ImportDataError` when the file cannot be read, or holds no table.
    """
    settings = settings or ImportSettings()
    tables = _all_tables(path, settings)
    if settings.table:
        named = tuple(table for table in tables if table.name == settings.table)
        if not named:
            known = [table.name for table in tables if table.name]
            hint = suggestion(settings.table, known) if known else "it holds a single table; leave the name out."
            raise ImportDataError(f"{path}: there is no table {settings.table!r}; {hint}")
        return named
    largest = max(tables, key=lambda table: table.rows * len(table.columns))
    alike = [table for table in tables if table.shape == largest.shape and table.rows >= MIN_TABLE_ROWS] or [largest]
    told = tuple(
        f"table {table.name!r} was not read ({len(table.columns)} columns, {table.rows} rows; --table names it)"
        for table in tables
        if table not in alike
    )
    return (replace(alike[0], remarks=(*alike[0].remarks, *told)), *alike[1:])


def text_of(path: Path, encoding: str = "") -> str:
    """Read a text file; `encoding` overrides the detected one.

    Raises `ImportDataError` when the file cannot be read, is empty, or is not text of this encoding.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ImportDataError(f"{path}: cannot be read ({error.strerror}); check the path.") from error
    if not data.strip(b"\r\n\t \0"):
        raise ImportDataError(f"{path}: is empty; give a file with a table of numbers.")
    encoding = encoding or detect_encoding(data)
    try:
        text = data.decode(encoding)
    except LookupError:
        raise ImportDataError(
            f"{path}: the encoding {encoding!r} is not known; give one such as utf-8, cp1252 or utf-16."
        ) from None
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ImportDataError(
            f"{path}: line {line} is not text in the encoding {encoding}; state the right one, such as cp1252 or "
            "utf-16."
        ) from error
    text = text.rstrip("\0")  # a logger without power leaves them
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        raise ImportDataError(f"{path}: line {line} holds a NUL byte, which is no text; remove it, or export anew.")
    return text.removeprefix("\ufeff")


def _all_tables(path: Path, settings: ImportSettings) -> Sequence[ForeignTable]:
    if not path.is_file():
        raise ImportDataError(f"{path}: there is no such file; give the path of a measurement.")
    if path.stat().st_size == 0:
        raise ImportDataError(f"{path}: is empty; give a file with a table of numbers.")
    kind = file_kind(path)
    if kind not in PACKED:
        return _tables_of_kind(path, kind, settings)
    with unpacked(path, kind) as content:
        try:
            tables = _tables_of_kind(content, file_kind(content), settings)
        except ImportDataError as error:
            raise ImportDataError(str(error).replace(str(content), str(path))) from error
    return [replace(table, path=path) for table in tables]


def _tables_of_kind(path: Path, kind: FileKind, settings: ImportSettings) -> Sequence[ForeignTable]:
    if kind is FileKind.TEXT:
        return text_tables(path, text_of(path, settings.encoding), settings)
    if kind is FileKind.WORKBOOK:
        _refuse_options(path, settings, ("encoding", "delimiter"))
        return read_workbook(path, settings)
    _refuse_options(path, settings, TEXT_OPTIONS)
    readers: Mapping[FileKind, Callable[[Path], Sequence[ForeignTable]]] = {
        FileKind.MAT: read_mat,
        FileKind.MAT73: read_mat73,
        FileKind.PARQUET: partial(read_arrow, kind=kind),
        FileKind.ARROW: partial(read_arrow, kind=kind),
        FileKind.TDMS: read_tdms,
        FileKind.NUMPY: read_numpy,
        FileKind.JSON: read_json,
    }
    if kind in PACKED:
        raise ImportDataError(f"{path}: is packed twice; unpack it once.")
    return readers[kind](path)


def _refuse_options(path: Path, settings: ImportSettings, names: Sequence[str]) -> None:
    """Raise `ImportDataError` for a stated option that has no say in a file of this kind."""
    stated = [f"--{name.replace('_', '-')}" for name in names if getattr(settings, name) not in {"", None}]
    if stated:
        raise ImportDataError(f"{path}: {', '.join(stated)} is for text files, and this is none; leave it out.")


def read_workbook(path: Path, settings: ImportSettings) -> tuple[ForeignTable, ...]:
    """Read all sheets of a workbook (.xlsx, .xls, .ods); those without a table of numbers are told.

    Raises `ImportDataError` when it cannot be read, or no sheet holds a table of numbers.
    """
    from python_calamine import CalamineWorkbook

    with damage_reported(path, "spreadsheet"):
        require_bounded(path, zipped_bytes(path), file_kinds.MAX_UNPACKED_TEXT_BYTES)
        book = CalamineWorkbook.from_path(str(path))
        sheets = {name: book.get_sheet_by_name(name).to_python(skip_empty_area=False) for name in book.sheet_names}
    by_tabs = settings.model_copy(update={"delimiter": "tab"})
    tables, told = list[ForeignTable](), list[str]()
    for name, rows in sheets.items():
        text = "\n".join("\t".join(cell_text(cell) for cell in row) for row in rows)
        if not text.strip():
            continue
        in_one_column = all(sum(map(bool, row)) <= 1 for row in rows)
        try:
            found = text_tables(path, text, settings if in_one_column else by_tabs)
        except ImportDataError:
            if settings.table == name or len(sheets) == 1:
                raise
            told.append(f"sheet {name!r} was not read: it holds no table of numbers")
            continue
        tables += [replace(table, name=f"{name}, {table.name}" if table.name else name) for table in found]
    if not tables:
        raise ImportDataError(f"{path}: no sheet holds a table of numbers; give a file with data.")
    return (replace(tables[0], remarks=(*tables[0].remarks, *told)), *tables[1:])


def cell_text(cell: object) -> str:
    """Return a workbook's cell as text: a duration in hours, minutes and seconds, a date as ISO 8601 has it."""
    if isinstance(cell, timedelta):
        minutes, seconds = divmod(cell.total_seconds(), 60)
        return f"{int(minutes // 60)}:{int(minutes % 60):02}:{seconds:09.6f}"
    return cell.isoformat() if isinstance(cell, date | time_of_day) else re.sub(r"\s+", " ", str(cell))
