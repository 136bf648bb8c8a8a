"""Readers of foreign files: text tables in any dialect, spreadsheets, MATLAB, Parquet, TDMS, NumPy and JSON files."""

import codecs
import csv
import io
import json
import re
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date, datetime
from datetime import time as time_of_day
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dragrig.analysis import EXPORT_FORMAT_KEY
from dragrig.analysis.importing.foreign import (
    ForeignColumn,
    ForeignTable,
    ImportSettings,
    InvalidCell,
    canonical_unit,
    split_unit,
)
from dragrig.config import ImportDataError, suggestion
from dragrig.rig import find_excess, refuse_foreign_storage

if TYPE_CHECKING:
    import h5py
    import pyarrow as pa

DELIMITERS = ("\t", ";", "|", ",", " ")
"""In the order of preference when two fit equally well; a space stands for any white space."""
SAMPLED_LINES = 400
"""Lines from all over a file that tell its dialect."""
SAMPLED_BYTES = 4096
MAX_MATRIX_COLUMNS = 64
"""A matrix with more columns is an image or a grid, not a table."""

MAX_MAT_LINKS = 1_000_000
"""MATLAB stores every cell of an array under a name of its own."""
MAX_UNPACKED_BYTES = 2 << 30
"""Largest size of a packed file's content: 250 kS/s of a force and a position for nine minutes."""
MAX_UNPACKED_TEXT_BYTES = MAX_UNPACKED_BYTES // 16
"""The same of a spreadsheet, whose cells take some sixteen times their text."""

SPREADSHEET_ENDINGS = frozenset({".xlsx", ".xlsm", ".xls", ".ods"})
_UNSUPPORTED_ENDINGS = {
    ".h5": "a run file needs no import; export other HDF5 files as CSV or MAT",
    ".hdf5": "export it as CSV or MAT",
    ".nxs": "export it as CSV or MAT",
}
_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\d*[.,]\d+)([eE][-+]?\d+)?|[-+]?(nan|inf(inity)?)", re.IGNORECASE)
_COMMENT = re.compile(r"\s*(#|%|//)\s?")
_EXPORT_LINE = re.compile(r"# ([\w-]+): (.*)")


def read_foreign(path: Path, settings: ImportSettings | None = None) -> ForeignTable:
    """Read a measurement by its ending: .mat, .parquet, .tdms, .npz, .json, a spreadsheet, or text under any other.

    Raises `ImportDataError` when the file cannot be read, or holds no table.
    """
    settings = settings or ImportSettings()
    if not path.is_file():
        raise ImportDataError(f"{path}: there is no such file; give the path of a measurement.")
    ending = path.suffix.lower()
    if ending in _UNSUPPORTED_ENDINGS:
        raise ImportDataError(f"{path}: {ending} files are not read; {_UNSUPPORTED_ENDINGS[ending]}.")
    if path.stat().st_size == 0:
        raise ImportDataError(f"{path}: is empty; give a file with a table of numbers.")
    readers: Mapping[str, Callable[[], ForeignTable]] = {
        ".mat": lambda: read_mat(path, settings.table),
        ".parquet": lambda: read_parquet(path),
        ".pq": lambda: read_parquet(path),
        ".tdms": lambda: read_tdms(path, settings.table),
        ".npz": lambda: read_npz(path),
        ".json": lambda: read_json(path, settings.table),
        **dict.fromkeys(SPREADSHEET_ENDINGS, lambda: read_spreadsheet(path, settings)),
    }
    if ending in readers:
        return readers[ending]()
    return read_text(path, settings.encoding, settings.delimiter, settings.decimal, settings.header_lines)


# Text tables: encoding, dialect, cells.


@dataclass(frozen=True, slots=True)
class TextDialect:
    """Layout of a text table: delimiter, index of the first line of numbers, names and units (or none) by column."""

    delimiter: str
    first_row: int
    names: tuple[str, ...]
    units: tuple[str, ...]


def read_text(
    path: Path, encoding: str = "", delimiter: str = "", decimal: str = "", header_lines: int | None = None
) -> ForeignTable:
    """Read a text table; parameters that are not given are detected.

    Raises `ImportDataError` when there is no table, its rows differ in width, or its decimal mark is ambiguous.
    """
    return _table_of_lines(path, read_lines(path, encoding), delimiter, decimal, header_lines)


def _table_of_lines(
    path: Path, lines: Sequence[str], delimiter: str, decimal: str, header_lines: int | None
) -> ForeignTable:
    dialect = detect_dialect(path, lines, delimiter, header_lines)
    rows = [number for number in range(dialect.first_row, len(lines)) if lines[number].strip()]
    if not rows:
        raise ImportDataError(f"{path}: has no rows of numbers after its header; give a file with data.")
    columns = _parse_rows(path, lines, rows, dialect, decimal)
    gapless = len(rows) == rows[-1] - rows[0] + 1
    preamble = tuple(lines[: dialect.first_row])
    return ForeignTable(
        path,
        columns,
        lines=range(rows[0] + 1, rows[-1] + 2) if gapless else tuple(number + 1 for number in rows),
        preamble=preamble,
        export=_export_preamble(preamble),
    )


def read_lines(path: Path, encoding: str = "") -> list[str]:
    """Read a text file's lines, with line ends of any system; `encoding` overrides the detected one.

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
    if "\0" in text:
        raise ImportDataError(f"{path}: is binary, not text; MAT, Parquet and TDMS files are recognised by ending.")
    return text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n").split("\n")


def detect_encoding(data: bytes) -> str:
    """Return the encoding of a text file: by its byte order mark, else UTF-16 by its zero bytes, UTF-8, or cp1252.

    Tables of numbers hold too few letters for a statistical guess: charset-normalizer takes `[µN]` in cp1252 for Big5
    (docs/decisions/0009).
    """
    for mark, encoding in _BYTE_ORDER_MARKS:
        if data.startswith(mark):
            return encoding
    sample = data[:SAMPLED_BYTES]
    if sample[1::2].count(0) > len(sample) // 4:
        return "utf-16-le"
    if sample[::2].count(0) > len(sample) // 4:
        return "utf-16-be"
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def detect_dialect(
    path: Path, lines: Sequence[str], delimiter: str = "", header_lines: int | None = None
) -> TextDialect:
    """Find delimiter, first row, names and units; a stated delimiter or number of header lines is taken as it is.

    The delimiter is the one that gives the most columns of numbers, then the largest share of such columns.

    Raises `ImportDataError` when there is no table of numbers.
    """
    after_header = lines[header_lines or 0 :]
    spread = after_header[:: max(1, len(after_header) // SAMPLED_LINES)]
    sample = [line for line in spread if line.strip() and not _COMMENT.match(line)]
    shapes = {candidate: _table_shape(sample, candidate) for candidate in ([delimiter] if delimiter else DELIMITERS)}
    chosen, (width, numeric) = max(
        shapes.items(), key=lambda item: (len(item[1][1]), len(item[1][1]) / max(item[1][0], 1))
    )
    if not numeric:
        raise ImportDataError(
            f"{path}: holds no table of numbers with columns separated by tab, semicolon, bar, comma or white space; "
            "state delimiter and header_lines if it does."
        )
    first = header_lines if header_lines is not None else _first_row(lines, chosen, width, numeric)
    while first < len(lines) and not lines[first].strip():
        first += 1
    return TextDialect(chosen, first, *_header(lines[:first], chosen, width))


def split_cells(line: str, delimiter: str) -> list[str]:
    """Split a line into cells, without the white space and quotes around them."""
    if delimiter == " ":
        return line.split()
    if '"' in line:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]
    return [cell.strip() for cell in line.split(delimiter)]


def is_number(cell: str) -> bool:
    """Whether a cell is a number with either decimal mark."""
    return _NUMBER.fullmatch(cell) is not None


def _table_shape(sample: Sequence[str], delimiter: str) -> tuple[int, tuple[int, ...]]:
    """Most common number of cells per line, and the columns that are mostly numbers."""
    rows = [row for row in (split_cells(line, delimiter) for line in sample) if any(map(is_number, row))]
    if not rows:
        return 0, ()
    width = Counter(map(len, rows)).most_common(1)[0][0]
    cells_by_column = zip(*(row for row in rows if len(row) == width), strict=True)
    surplus = (sum(1 if is_number(cell) else -1 for cell in cells if cell) for cells in cells_by_column)
    return width, tuple(column for column, majority in enumerate(surplus) if majority > 0)


def _first_row(lines: Sequence[str], delimiter: str, width: int, numeric: Sequence[int]) -> int:
    """First line with numbers in at least half of the columns of numbers, or with nothing in them but numbers."""
    for number, line in enumerate(lines):
        if not line.strip() or _COMMENT.match(line):
            continue
        cells = split_cells(line, delimiter)
        numbers = sum(column < len(cells) and is_number(cells[column]) for column in numeric)
        only_numbers = len(cells) == width and numbers == sum(map(bool, cells))
        if numbers and (only_numbers or 2 * numbers >= len(numeric)):
            return number
    return len(lines)


def _header(lines: Sequence[str], delimiter: str, width: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units from the last lines before the table that have its width."""
    rows = [cells for line in lines if any(cells := _header_cells(line, delimiter, width))]
    if not rows:
        return (), ()
    if len(rows) > 1 and _are_units(rows[-1]) and not _are_units(rows[-2]):
        return tuple(rows[-2]), tuple(rows[-1])
    return tuple(rows[-1]), ()


def _header_cells(line: str, delimiter: str, width: int) -> list[str]:
    """Cells of a line as wide as the table, up to empty cells or one missing cell at its end; else none."""
    cells = split_cells(_COMMENT.sub("", line, count=1), delimiter)
    while len(cells) > width and not cells[-1]:
        cells.pop()
    missing = width - len(cells)
    if missing and not (missing == 1 and delimiter != " " and width > 2):
        return []
    return cells + [""] * missing


def _are_units(cells: Sequence[str]) -> bool:
    filled = [cell for cell in cells if cell]
    return bool(filled) and all(canonical_unit(cell) is not None for cell in filled)


def _parse_rows(
    path: Path, lines: Sequence[str], rows: Sequence[int], dialect: TextDialect, decimal: str
) -> tuple[ForeignColumn, ...]:
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    delimiter = dialect.delimiter
    body = "\n".join(" ".join(lines[row].split()) if delimiter == " " else lines[row] for row in rows)
    if "+" in body:
        # Arrow reads no number with a leading plus.
        body = re.sub(rf'((?:^|{re.escape(delimiter)})\s*"?)\+(?=[\d.,])', r"\1", body, flags=re.MULTILINE)
    decimal = decimal or _decimal_mark(path, body, delimiter)
    width = len(split_cells(lines[rows[0]], delimiter))
    try:
        data = body.encode("utf-8", "surrogatepass")
        table = arrow_csv.read_csv(
            io.BytesIO(data),
            # One block, so that a column's type is inferred from all of its rows.
            arrow_csv.ReadOptions(
                column_names=[str(column) for column in range(width)], block_size=min(len(data) + 1, 2**31 - 1)
            ),
            arrow_csv.ParseOptions(delimiter=delimiter, ignore_empty_lines=False),
            arrow_csv.ConvertOptions(decimal_point=decimal, null_values=[""], true_values=[], false_values=[]),
        )
    except pa.ArrowInvalid as error:
        raise _ragged_row_error(path, lines, rows, delimiter, width) from error
    if width > 1 and table.column(width - 1).null_count == len(rows):
        width -= 1  # each line ends with a delimiter
    names, units = _names_and_units(dialect, width)
    return tuple(
        _text_column(name, unit, table.column(column), decimal)
        for column, (name, unit) in enumerate(zip(names, units, strict=True))
    )


def _decimal_mark(path: Path, body: str, delimiter: str) -> str:
    has_comma, has_point = "," in body and (delimiter != "," or '"' in body), "." in body
    if not (has_comma and has_point):
        return "," if has_comma else "."
    edge = re.escape(delimiter)
    commas, points = (
        len(re.findall(rf'(?:^|{edge})\s*"?[-+]?{pattern}(?:[eE][-+]?\d+)?"?\s*(?=$|{edge})', body, re.MULTILINE))
        for pattern in (r"\d*,\d+", r"\d*\.\d*")
    )
    if commas and points:
        raise ImportDataError(
            f"{path}: has decimal commas in {commas} cells and decimal points in {points}; state the decimal mark."
        )
    return "," if commas else "."


def _ragged_row_error(
    path: Path, lines: Sequence[str], rows: Sequence[int], delimiter: str, width: int
) -> ImportDataError:
    for row in rows:
        cells = len(split_cells(lines[row], delimiter))
        if cells != width:
            return ImportDataError(
                f"{path}: line {row + 1} has {cells} cells where the first row has {width}; correct or remove it, or "
                "state delimiter and header_lines."
            )
    return ImportDataError(f"{path}: holds quotes that do not match; remove them.")


def _names_and_units(dialect: TextDialect, width: int) -> tuple[list[str], list[str]]:
    names: list[str] = []
    units: list[str] = []
    for column in range(width):
        name = (dialect.names[column] if column < len(dialect.names) else "") or f"column {column + 1}"
        name = name if name not in names else f"{name} ({column + 1})"
        unit = dialect.units[column] if column < len(dialect.units) else ""
        names.append(name)
        units.append(canonical_unit(unit) or unit or split_unit(name)[1] or "")
    return names, units


def _text_column(name: str, units: str, cells: "pa.ChunkedArray", decimal: str) -> ForeignColumn:
    """Numbers of a column, or its first cell that is none."""
    import pyarrow as pa

    if pa.types.is_null(cells.type):
        return ForeignColumn(name, units, np.full(len(cells), np.nan))
    if pa.types.is_integer(cells.type) or pa.types.is_floating(cells.type):
        return ForeignColumn(name, units, np.asarray(cells.cast(pa.float64()).to_numpy(), dtype=np.float64))
    texts = ["" if cell is None else str(cell).strip() for cell in cells.to_pylist()]
    if (clock := _clock_column(name, texts)) is not None:
        return clock
    wrong_mark = "." if decimal == "," else ","
    invalid = (row for row, text in enumerate(texts) if not is_number(text) or wrong_mark in text)
    first = next(invalid, 0)
    return ForeignColumn(name, units, np.full(len(cells), np.nan), InvalidCell(first, texts[first]))


def _clock_column(name: str, texts: Sequence[str]) -> ForeignColumn | None:
    """Return dates and times, or times of day, as seconds since the first one; None for anything else."""
    first = next((text for text in texts if text), "")
    is_time_of_day = first[2:3] == ":"
    try:
        # A time of day counts as one of the first day; after midnight the clock begins anew.
        moments = [
            datetime.fromisoformat(f"{'0001-01-01T' if is_time_of_day else ''}{text.replace(',', '.')}")
            if text
            else None
            for text in texts
        ]
        begin = next(moment for moment in moments if moment is not None)
        seconds = np.array([np.nan if moment is None else (moment - begin).total_seconds() for moment in moments])
    except (StopIteration, TypeError, ValueError):
        return None
    if is_time_of_day:
        steps = np.diff(seconds, prepend=seconds[:1])
        return ForeignColumn(name, "s", seconds + 86_400.0 * np.cumsum(steps < -43_200.0))
    return ForeignColumn(name, "s", seconds, begins_at=begin if begin.tzinfo is not None else begin.astimezone())


def _export_preamble(preamble: Sequence[str]) -> dict[str, object]:
    """Metadata in the comment lines that an exported run begins with."""
    entries = {match[1]: match[2] for line in preamble if (match := _EXPORT_LINE.fullmatch(line))}
    if EXPORT_FORMAT_KEY not in entries:
        return {}
    try:
        return {key: json.loads(value) for key, value in entries.items()}
    except ValueError:
        return {}


# Binary tables: columns by the variable, struct or group that holds them, of which the largest is the table.

GroupedColumns = list[tuple[str, ForeignColumn]]


def read_parquet(path: Path) -> ForeignTable:
    """Read a Parquet file; raises `ImportDataError` when it is none."""
    import pyarrow as pa
    from pyarrow import parquet

    with _damage_reported(path, "Parquet"):
        metadata = parquet.read_metadata(path)
        _require_bounded(path, 8 * metadata.num_rows * metadata.num_columns)
        table = parquet.read_table(path)
    columns = GroupedColumns()
    for column, cells in zip(table.schema, table.columns, strict=True):
        units = (column.metadata or {}).get(b"units", b"").decode("utf-8", "replace")
        numeric = pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
        values = cells.to_numpy() if numeric else np.array(cells.to_pylist(), dtype=object)
        columns.append(("", _array_column(column.name, values, units)))
    export = (table.schema.metadata or {}).get(b"dragrig", b"")
    return _foreign_table(path, columns, export=export.decode("utf-8", "replace"))


def read_spreadsheet(path: Path, settings: ImportSettings) -> ForeignTable:
    """Read a sheet of a workbook (.xlsx, .xls, .ods), the largest one or that named as the table.

    Raises `ImportDataError` when it cannot be read, or holds no table of numbers.
    """
    from python_calamine import CalamineWorkbook

    with _damage_reported(path, "spreadsheet"):
        _require_bounded(path, _zipped_bytes(path), MAX_UNPACKED_TEXT_BYTES)
        book = CalamineWorkbook.from_path(str(path))
        sheets = {name: book.get_sheet_by_name(name).to_python(skip_empty_area=False) for name in book.sheet_names}
    if settings.table and settings.table not in sheets:
        raise ImportDataError(
            f"{path}: there is no sheet {settings.table!r}; {suggestion(settings.table, list(sheets))}"
        )
    name = settings.table or max(sheets, key=lambda sheet: len(sheets[sheet]), default="")
    lines = ["\t".join(_cell_text(cell) for cell in row) for row in sheets.get(name, [])]
    if not any(line.strip() for line in lines):
        raise ImportDataError(f"{path}: is empty; give a file with a table of numbers.")
    return _table_of_lines(path, lines, "\t", ".", settings.header_lines)


def _cell_text(cell: object) -> str:
    return cell.isoformat() if isinstance(cell, date | time_of_day) else str(cell).replace("\t", " ").replace("\n", " ")


def read_json(path: Path, table: str = "") -> ForeignTable:
    """Read a JSON file: a list of records, lists by column, or `columns` and `data`.

    Raises `ImportDataError` when it is none of these.
    """
    try:
        content: object = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise ImportDataError(f"{path}: is no JSON file ({error}); export it anew or as CSV.") from error
    if isinstance(content, dict) and {"columns", "data"} <= set(content):
        content = [dict(zip(content["columns"], row, strict=False)) for row in content["data"]]
    if isinstance(content, list) and all(isinstance(row, dict) for row in content):
        names = dict.fromkeys(str(name) for row in content for name in row)
        content = {name: [row.get(name) for row in content] for name in names}
    columns = list(_json_columns("", content if isinstance(content, dict) else {}))
    return _foreign_table(path, columns, table)


def _json_columns(group: str, tree: Mapping[str, object]) -> Iterator[tuple[str, ForeignColumn]]:
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _json_columns(f"{group}.{name}" if group else name, value)
        elif isinstance(value, list) and value:
            is_numeric = all(item is None or isinstance(item, int | float) for item in value)
            texts = [] if is_numeric else ["" if item is None else str(item) for item in value]
            numbers = np.array([np.nan if item is None else item for item in value]) if is_numeric else np.array(texts)
            yield group, _clock_column(name, texts) or _array_column(name, numbers)


def read_npz(path: Path) -> ForeignTable:
    """Read a NumPy archive; raises `ImportDataError` when it is none."""
    with _damage_reported(path, "NumPy"), path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        _require_bounded(path, _zipped_bytes(path))
        arrays = {str(name): archive[name] for name in archive.files}
    export = str(arrays.pop("metadata", ""))
    return _foreign_table(path, list(_grouped_columns("", arrays)), export=export)


def read_mat(path: Path, table: str = "") -> ForeignTable:
    """Read a MAT file of version 5 or 7.3; raises `ImportDataError` when it is none.

    Parameters
    ----------
    table
        Variable or struct whose columns are meant; the largest when empty.
    """
    import h5py
    from scipy.io import loadmat

    with _damage_reported(path, "MAT"):
        if h5py.is_hdf5(path):
            with h5py.File(path, "r") as file:
                if (excess := find_excess(file, MAX_MAT_LINKS)) is not None:
                    raise ValueError(excess)
                refuse_foreign_storage(file)
                _require_bounded(path, _hdf5_bytes(file))
                variables = _hdf5_tree(file)
        else:
            _require_bounded(path, _mat5_bytes(path))
            contents = loadmat(path, simplify_cells=True)
            variables = {str(name): value for name, value in contents.items() if not str(name).startswith("__")}
    run = variables.get("run")
    export = str(run.get("metadata_json", "")) if isinstance(run, dict) else ""
    return _foreign_table(path, list(_grouped_columns("", variables)), table, export=export)


def read_tdms(path: Path, table: str = "") -> ForeignTable:
    """Read a TDMS file; raises `ImportDataError` when it is none.

    Parameters
    ----------
    table
        Group whose channels are meant; the largest when empty.
    """
    from nptdms import TdmsFile

    columns = GroupedColumns()
    increments: dict[str, set[float]] = {}
    with _damage_reported(path, "TDMS"):
        groups = TdmsFile.read_metadata(path).groups()
        _require_bounded(path, 8 * sum(len(channel) for group in groups for channel in group.channels()))
        for group in TdmsFile.read(path).groups():
            for channel in group.channels():
                units = str(channel.properties.get("unit_string") or channel.properties.get("NI_UnitDescription") or "")
                columns.append((group.name, _array_column(channel.name, np.asarray(channel[:]), units)))
                increments.setdefault(group.name, set()).add(float(channel.properties.get("wf_increment", 0.0)))
    return _foreign_table(path, columns, table, increments)


@contextmanager
def _damage_reported(path: Path, file_kind: str) -> Iterator[None]:
    """Readers report damage as almost any class of exception; each means the same to the user."""
    try:
        yield
    except ImportDataError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.strerror:
            raise ImportDataError(f"{path}: cannot be read ({error.strerror}); check the path.") from error
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ImportDataError(
            f"{path}: is damaged or no {file_kind} file ({reason:.100}); export it anew or as CSV."
        ) from error


def _require_bounded(path: Path, unpacked_bytes: int, limit_bytes: int | None = None) -> None:
    """Refuse a packed file before it fills the memory; raises `ImportDataError`."""
    limit_bytes = MAX_UNPACKED_BYTES if limit_bytes is None else limit_bytes
    if unpacked_bytes > limit_bytes:
        raise ImportDataError(
            f"{path}: unpacks to {unpacked_bytes / 1e9:.1f} GB or more, and {limit_bytes / 1e9:.1f} GB is the limit; "
            "export fewer columns or a shorter piece."
        )


def _zipped_bytes(path: Path) -> int:
    if not zipfile.is_zipfile(path):
        return path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        return sum(entry.file_size for entry in archive.infolist())


def _hdf5_bytes(group: "h5py.Group") -> int:
    import h5py

    sizes = [0]
    group.visititems(lambda _, item: sizes.append(item.nbytes if isinstance(item, h5py.Dataset) else 0))
    return sum(sizes)


def _mat5_bytes(path: Path) -> int:
    """Unpack the compressed elements of a MAT file of version 5 piece by piece, and return their size up to the limit.

    MathWorks, MAT-File Format: a header of 128 bytes whose last two tell the byte order; then elements, each with its
    type (15: compressed) and its number of bytes in front.
    """
    total = 0
    with path.open("rb") as file:
        order = "<" if file.read(_MAT5_HEADER_BYTES)[-2:] == b"IM" else ">"
        while len(tag := file.read(8)) == 8 and total <= MAX_UNPACKED_BYTES:
            kind, size = struct.unpack(f"{order}II", tag)
            body = file.read(size)
            if kind != _MAT5_COMPRESSED:
                total += size
                continue
            unpacker = zlib.decompressobj()
            while body and not unpacker.eof and total <= MAX_UNPACKED_BYTES:
                total += len(unpacker.decompress(body, 1 << 20))
                body = unpacker.unconsumed_tail
    return total


_MAT5_HEADER_BYTES, _MAT5_COMPRESSED = 128, 15


def _hdf5_tree(group: "h5py.Group") -> dict[str, object]:
    """Nested variables of a MAT file of version 7.3; MATLAB stores matrices there column by column."""
    import h5py

    tree: dict[str, object] = {}
    for name, item in group.items():
        if isinstance(item, h5py.Group):
            if not name.startswith("#"):
                tree[name] = _hdf5_tree(item)
        elif item.attrs.get("MATLAB_class") == b"char":
            tree[name] = "".join(map(chr, np.asarray(item[()]).T.ravel().tolist()))
        elif item.dtype.kind in "fiub" and "MATLAB_empty" not in item.attrs:
            tree[name] = np.squeeze(np.asarray(item[()]).T)
    return tree


def _grouped_columns(group: str, variables: Mapping[str, object]) -> Iterator[tuple[str, ForeignColumn]]:
    for name, value in variables.items():
        path = f"{group}.{name}" if group else name
        if isinstance(value, dict):
            yield from _grouped_columns(path, value)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
            if value.ndim == 1:
                yield group, _array_column(name, value)
            elif value.ndim == 2 and 1 < min(value.shape) <= MAX_MATRIX_COLUMNS:
                columns = value if value.shape[0] >= value.shape[1] else value.T
                for number, column in enumerate(columns.T, start=1):
                    yield path, _array_column(f"{name}[{number}]", column)


def _array_column(name: str, values: npt.NDArray[np.generic], units: str = "") -> ForeignColumn:
    if values.dtype.kind == "M":
        seconds = np.divide(np.subtract(values, values[:1]), np.timedelta64(1, "s"))
        return ForeignColumn(name, "s", np.asarray(seconds, dtype=np.float64))
    units = canonical_unit(units) or units or split_unit(name)[1] or ""
    if values.dtype.kind in "fiub":
        # A damaged file may hold NaN that signal, which are NaN all the same, and more than a float64 takes.
        with np.errstate(invalid="ignore", over="ignore"):
            return ForeignColumn(name, units, np.asarray(values, dtype=np.float64))
    return ForeignColumn(name, units, np.full(len(values), np.nan), InvalidCell(0, "".join(map(str, values[:1]))))


def _foreign_table(
    path: Path,
    columns: GroupedColumns,
    table: str = "",
    increments_s: Mapping[str, Collection[float]] | None = None,
    export: str = "",
) -> ForeignTable:
    """Take the columns of one group and one length: of the stated group, and with the most values."""
    groups: dict[tuple[str, int], list[ForeignColumn]] = {}
    for group, column in columns:
        groups.setdefault((group, len(column.values)), []).append(column)
    if not groups:
        raise ImportDataError(f"{path}: holds no columns of numbers; give a file with data.")
    wanted = [key for key in groups if not table or key[0] == table]
    if not wanted:
        known = sorted({group for group, _ in groups if group})
        hint = suggestion(table, known) if known else "leave its name out."
        raise ImportDataError(f"{path}: there is no table {table!r}; {hint}")
    group, rows = largest = max(wanted, key=lambda key: key[1] * len(groups[key]))
    if not rows:
        raise ImportDataError(f"{path}: holds columns without any rows; give a file with data.")
    try:
        metadata = json.loads(export) if export else {}
    except ValueError:
        metadata = {}
    is_export = isinstance(metadata, dict) and EXPORT_FORMAT_KEY in metadata
    steps = list((increments_s or {}).get(group, ()))
    return ForeignTable(
        path,
        tuple(groups[largest]),
        sample_rate_hz=1 / steps[0] if len(steps) == 1 and steps[0] > 0 else None,
        export=metadata if is_export else {},
    )
