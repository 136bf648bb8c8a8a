"""Readers of foreign files: text tables in any dialect, MATLAB, Parquet, TDMS and NumPy files."""

import io
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from dragrig.analysis.importing.foreign import ForeignColumn, ForeignTable, InvalidCell, canonical_unit, split_unit
from dragrig.analysis.importing.mapping import ImportSettings
from dragrig.analysis.importing.text_dialect import TextDialect, detect_dialect, read_lines, split_cells
from dragrig.config.errors import ImportDataError
from dragrig.config.settings import suggestion

_EXPORT_LINE = re.compile(r"# ([\w-]+): (.*)")
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
    dialect = detect_dialect(path, lines, delimiter, header_lines)
    rows = [k for k in range(dialect.first_row, len(lines)) if lines[k].strip()]
    if not rows:
        raise ImportDataError(f"{path}: has no rows of numbers after its header; give a file with data.")
    cells = _split_rows(path, lines, rows, dialect)
    mark = decimal or _decimal_mark(path, cells)
    names, units = _names_and_units(dialect, cells)
    columns = tuple(_text_column(name, unit, cell, mark) for name, unit, cell in zip(names, units, cells, strict=True))
    whole = len(rows) == rows[-1] - rows[0] + 1
    return ForeignTable(
        path,
        columns,
        lines=range(rows[0] + 1, rows[-1] + 2) if whole else tuple(k + 1 for k in rows),
        preamble=tuple(lines[: dialect.first_row]),
        export=_export_preamble(lines[: dialect.first_row]),
    )


def _split_rows(path: Path, lines: Sequence[str], rows: Sequence[int], dialect: TextDialect) -> list[pa.Array]:
    """Cells of all rows as text, one array for each column."""
    kept = [lines[k] for k in rows]
    if dialect.delimiter == " ":
        kept = [" ".join(line.split()) for line in kept]
    width = len(split_cells(kept[0], dialect.delimiter))
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
        raise _ragged_row_error(path, lines, rows, dialect, width) from error
    columns = [pc.utf8_trim_whitespace(column.combine_chunks()) for column in table.columns]
    if width > 1 and pc.all(pc.equal(columns[-1], "")).as_py():
        columns.pop()  # each line ends with a delimiter
    return columns


def _ragged_row_error(
    path: Path, lines: Sequence[str], rows: Sequence[int], dialect: TextDialect, width: int
) -> ImportDataError:
    for k in rows:
        found = len(split_cells(lines[k], dialect.delimiter))
        if found != width:
            return ImportDataError(
                f"{path}: line {k + 1} has {found} cells where the first row has {width}; correct or remove it, or "
                "state delimiter and header_lines."
            )
    return ImportDataError(f"{path}: holds quotes that do not match; remove them.")


def _decimal_mark(path: Path, columns: Sequence[pa.Array]) -> str:
    held = [[_contains(column, mark) for mark in ",."] for column in columns]
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


def _contains(cells: pa.Array, text: str) -> bool:
    return bool(pc.any(pc.match_substring(cells, text)).as_py())


def _names_and_units(dialect: TextDialect, cells: Sequence[pa.Array]) -> tuple[list[str], list[str]]:
    width = len(cells)
    given = [*dialect.names[:width], *[""] * (width - len(dialect.names))]
    names: list[str] = []
    for k, own in enumerate(given):
        name = own or f"column {k + 1}"
        names.append(name if name not in names else f"{name} ({k + 1})")
    units = [canonical_unit(unit) or unit for unit in dialect.units[:width]]
    units += [""] * (width - len(units))
    return names, [unit or split_unit(name)[1] or "" for name, unit in zip(names, units, strict=True)]


def _text_column(name: str, units: str, cells: pa.Array, decimal: str) -> ForeignColumn:
    """Turn cells into numbers; a cell is missing when it is empty."""
    plain = pc.replace_substring_regex(cells, r"^\+", "") if _contains(cells, "+") else cells
    if decimal == ",":
        if _contains(plain, "."):
            plain = pc.if_else(pc.match_substring(plain, "."), "a point where commas are decimal marks", plain)
        plain = pc.replace_substring(plain, ",", ".", max_replacements=1)
    filled = pc.if_else(pc.equal(plain, ""), None, plain)
    try:
        numbers = pc.cast(filled, pa.float64())
    except pa.ArrowInvalid:
        return ForeignColumn(name, units, np.full(len(cells), np.nan), _first_invalid(cells, filled))
    values = np.asarray(numbers.to_numpy(zero_copy_only=False), dtype=np.float64)
    return ForeignColumn(name, units, values)


def _first_invalid(cells: pa.Array, filled: pa.Array) -> InvalidCell:
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
    return InvalidCell(start, str(cells[start].as_py()))


def _export_preamble(preamble: Sequence[str]) -> dict[str, object]:
    """Read back the comment lines that an export of ours begins with."""
    found = {match[1]: match[2] for line in preamble if (match := _EXPORT_LINE.fullmatch(line))}
    if "dragrig-export" not in found:
        return {}
    try:
        return {key: json.loads(value) for key, value in found.items()}
    except ValueError:
        return {}


MAX_MATRIX_COLUMNS = 64
"""A matrix with more columns than this is no table."""
METADATA_KEY = b"dragrig"


@dataclass(frozen=True, slots=True, eq=False)
class _NamedArray:
    """A named row of values; `group` is what it stood in."""

    group: str
    name: str
    values: npt.NDArray[np.generic]
    units: str = ""


def read_parquet(path: Path) -> ForeignTable:
    """Read a Parquet file; raises `ImportDataError` when it is none."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        table = parquet.read_table(path)
    except (OSError, pa.ArrowException) as error:
        raise _damaged_file(path, "Parquet", error) from error
    vectors = []
    for field, column in zip(table.schema, table.columns, strict=True):
        units = (field.metadata or {}).get(b"units", b"").decode("utf-8", "replace")
        numeric = pa.types.is_integer(field.type) or pa.types.is_floating(field.type)
        values = column.to_numpy() if numeric else np.array(column.to_pylist(), dtype=object)
        vectors.append(_NamedArray("", field.name, values, units))
    export = (table.schema.metadata or {}).get(METADATA_KEY, b"")
    return _foreign_table(path, vectors, export=_parquet_export_metadata(export.decode("utf-8", "replace")))


def read_npz(path: Path) -> ForeignTable:
    """Read a NumPy archive; raises `ImportDataError` when it is none."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            held = {str(name): archive[name] for name in archive.files}
    except Exception as error:
        # NumPy and zipfile report damage as many classes of exception; each means the same to the user.
        raise _damaged_file(path, "NumPy", error) from error
    export = str(held.pop("metadata", ""))
    return _foreign_table(path, list(_named_arrays("", held)), export=_parquet_export_metadata(export))


def read_mat(path: Path, table: str = "") -> ForeignTable:
    """Read a MAT file of version 5 or 7.3; raises `ImportDataError` when it is none.

    Parameters
    ----------
    table
        Variable or struct whose columns are meant; those with the most values when empty.
    """
    import h5py

    try:
        held = _hdf5_tree(path) if h5py.is_hdf5(path) else _mat5_tree(path)
    except Exception as error:
        # Both readers report damage as almost any class of exception; each means the same to the user.
        raise _damaged_file(path, "MAT", error) from error
    run = held.get("run")
    export = str(run.get("metadata_json", "")) if isinstance(run, dict) else ""
    return _foreign_table(path, list(_named_arrays("", held)), table, export=_parquet_export_metadata(export))


def read_tdms(path: Path, table: str = "") -> ForeignTable:
    """Read a TDMS file; raises `ImportDataError` when it is none.

    Parameters
    ----------
    table
        Group whose channels are meant; the one with the most values when empty.
    """
    from nptdms import TdmsFile

    vectors: list[_NamedArray] = []
    increments: dict[str, set[float]] = {}
    try:
        for group in TdmsFile.read(path).groups():
            for channel in group.channels():
                units = str(channel.properties.get("unit_string") or channel.properties.get("NI_UnitDescription") or "")
                vectors.append(_NamedArray(group.name, channel.name, np.asarray(channel[:]), units))
                increments.setdefault(group.name, set()).add(float(channel.properties.get("wf_increment", 0.0)))
    except Exception as error:
        # npTDMS reports damage as almost any class of exception; each means the same to the user.
        raise _damaged_file(path, "TDMS", error) from error
    chosen, group_name = _largest_table(path, vectors, table)
    steps = increments.get(group_name, set())
    step = steps.pop() if len(steps) == 1 else 0.0
    return _foreign_table(path, chosen, sample_rate_hz=1 / step if step > 0 else None)


def _mat5_tree(path: Path) -> dict[str, object]:
    from scipy.io import loadmat

    held = loadmat(path, simplify_cells=True)
    return {str(name): value for name, value in held.items() if not str(name).startswith("__")}


def _hdf5_tree(path: Path) -> dict[str, object]:
    """Nested variables of a version 7.3 file; MATLAB stores matrices there column by column."""
    import h5py

    def tree(group: "h5py.Group") -> dict[str, object]:
        found: dict[str, object] = {}
        for name, item in group.items():
            if isinstance(item, h5py.Group):
                if not name.startswith("#"):
                    found[name] = tree(item)
            elif item.attrs.get("MATLAB_class") == b"char":
                found[name] = "".join(map(chr, np.asarray(item[()]).T.ravel().tolist()))
            elif item.dtype.kind in "fiub" and "MATLAB_empty" not in item.attrs:
                found[name] = np.squeeze(np.asarray(item[()]).T)
        return found

    with h5py.File(path, "r") as file:
        return tree(file)


def _named_arrays(group: str, held: Mapping[str, object]) -> Iterable[_NamedArray]:
    for name, value in held.items():
        if isinstance(value, dict):
            yield from _named_arrays(f"{group}.{name}" if group else name, value)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
            if value.ndim == 1:
                yield _NamedArray(group, name, value)
            elif value.ndim == 2 and 1 < min(value.shape) <= MAX_MATRIX_COLUMNS:
                columns = value if value.shape[0] >= value.shape[1] else value.T
                for k in range(columns.shape[1]):
                    yield _NamedArray(f"{group}.{name}" if group else name, f"{name}[{k + 1}]", columns[:, k])


def _largest_table(path: Path, vectors: Sequence[_NamedArray], table: str) -> tuple[list[_NamedArray], str]:
    """Vectors of one group and one length: those that are asked for, or that hold the most values."""
    groups: dict[tuple[str, int], list[_NamedArray]] = {}
    for vector in vectors:
        groups.setdefault((vector.group, len(vector.values)), []).append(vector)
    wanted = {key: found for key, found in groups.items() if not table or key[0] == table}
    if not wanted:
        known = sorted({vector.group for vector in vectors if vector.group})
        if not vectors:
            raise ImportDataError(f"{path}: holds no columns of numbers; give a file with data.")
        raise ImportDataError(
            f"{path}: there is no table {table!r}; {suggestion(table, known) if known else 'name none.'}"
        )
    (group, _), chosen = max(wanted.items(), key=lambda one: one[0][1] * len(one[1]))
    return chosen, group


def _foreign_table(
    path: Path,
    vectors: Sequence[_NamedArray],
    table: str = "",
    *,
    sample_rate_hz: float | None = None,
    export: Mapping[str, object] | None = None,
) -> ForeignTable:
    chosen, _ = _largest_table(path, vectors, table)
    if not len(chosen[0].values):
        raise ImportDataError(f"{path}: holds columns without any rows; give a file with data.")
    return ForeignTable(
        path, tuple(_array_column(vector) for vector in chosen), sample_rate_hz=sample_rate_hz, export=export or {}
    )


def _array_column(vector: _NamedArray) -> ForeignColumn:
    units = canonical_unit(vector.units) or vector.units or split_unit(vector.name)[1] or ""
    if vector.values.dtype.kind == "M":
        seconds = (vector.values - vector.values[0]) / np.timedelta64(1, "s")
        return ForeignColumn(vector.name, "s", np.asarray(seconds, dtype=np.float64))
    if vector.values.dtype.kind not in "fiub":
        bad = InvalidCell(0, str(vector.values[0]))
        return ForeignColumn(vector.name, units, np.full(len(vector.values), np.nan), bad)
    return ForeignColumn(vector.name, units, np.asarray(vector.values, dtype=np.float64))


def _parquet_export_metadata(text: str) -> dict[str, object]:
    try:
        found = json.loads(text) if text else {}
    except ValueError:
        return {}
    return found if isinstance(found, dict) and "dragrig-export" in found else {}


def _damaged_file(path: Path, what: str, error: Exception) -> ImportDataError:
    if isinstance(error, OSError) and error.strerror:
        return ImportDataError(f"{path}: cannot be read ({error.strerror}); check the path.")
    said = (str(error).splitlines() or [type(error).__name__])[0]
    return ImportDataError(f"{path}: is damaged or no {what} file ({said:.100}); export it anew or as CSV.")


_UNSUPPORTED_ENDINGS = {
    ".xlsx": "save the sheet as CSV",
    ".xls": "save the sheet as CSV",
    ".ods": "save the sheet as CSV",
    ".h5": "a run file needs no import; export other HDF5 files as CSV or MAT",
    ".hdf5": "export it as CSV or MAT",
    ".nxs": "export it as CSV or MAT",
}


def read_foreign(path: Path, settings: ImportSettings | None = None) -> ForeignTable:
    """Read a measurement by its ending: .mat, .parquet, .tdms, .npz, or text under any other.

    Raises
    ------
    ImportDataError
        When the file cannot be read, or holds no table.
    """
    settings = settings or ImportSettings()
    if not path.is_file():
        raise ImportDataError(f"{path}: there is no such file; give the path of a measurement.")
    ending = path.suffix.lower()
    if ending in _UNSUPPORTED_ENDINGS:
        raise ImportDataError(f"{path}: {ending} files are not read; {_UNSUPPORTED_ENDINGS[ending]}.")
    if path.stat().st_size == 0:
        raise ImportDataError(f"{path}: is empty; give a file with a table of numbers.")

    if ending == ".mat":
        return read_mat(path, settings.table)
    if ending in {".parquet", ".pq"}:
        return read_parquet(path)
    if ending == ".tdms":
        return read_tdms(path, settings.table)
    if ending == ".npz":
        return read_npz(path)

    return read_text(path, settings.encoding, settings.delimiter, settings.decimal, settings.header_lines)
