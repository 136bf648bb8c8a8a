"""Tables in containers of named arrays: NumPy, Parquet, Arrow and JSON files, and the common part of all containers.

A container is a tree of named arrays. Arrays of one length under one node are a table, and so are channels, nodes of an
array each; a matrix of another length is a table of its own; structs and cells in a list are numbered nodes. All else
is named in the remarks.
"""

import json
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dragrig.analysis.importing.cells import column_of_texts
from dragrig.analysis.importing.clocks import moments_column
from dragrig.analysis.importing.file_kinds import FileKind, damage_reported, require_bounded, zipped_bytes
from dragrig.analysis.importing.foreign import ForeignColumn, ForeignTable
from dragrig.analysis.importing.units import canonical_unit, split_unit
from dragrig.config import ImportDataError

if TYPE_CHECKING:
    import pyarrow as pa

MAX_MATRIX_COLUMNS = 64
"""A matrix with more columns is an image or a grid, not a table."""
MIN_LABELLED_ROWS = 8
"""Objects of objects that are a table though their names are no numbers or dates."""
_NUMBERS = (int, float, np.bool_, np.number, type(None))
_SINGLE = (*_NUMBERS, str, bytes)
_ROW_LABEL = re.compile(r"-?\d+(\.\d+)?(e[-+]\d+)?|\d{4}-\d\d-\d\d.*")

Array = npt.NDArray[np.generic]
Node = Mapping[str, object]
"""Children by name: nodes, arrays, lists, single values, `Unread`."""


@dataclass(frozen=True, slots=True)
class Unread:
    """A child that becomes no column, and why: `is a MATLAB datetime, …`."""

    why: str


@dataclass(slots=True)
class Found:
    """The content of a container: named tables, and remarks on all that is in none of them."""

    tables: list[ForeignTable] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    values: list[str] = field(default_factory=list)
    """Single values, as `gain = 2.0`."""

    def finished(self, path: Path) -> tuple[ForeignTable, ...]:
        """Return the tables with all remarks.

        Raises `ImportDataError` when there is no table of numbers, or none of them has any rows.
        """
        remarks = [*self.remarks, *(f"table {table.name!r} has no rows" for table in self.tables if not table.rows)]
        if self.values:
            remarks.append(f"single values, which are no columns: {', '.join(self.values):.600}")
        if not any(table.rows for table in self.tables):
            kind = "columns without any rows" if self.tables else "no columns of numbers"
            why = f" ({'; '.join(remarks):.600})" if remarks else ""
            raise ImportDataError(f"{path}: holds {kind}{why}; give a file with data.")
        return tuple(replace(table, remarks=tuple(remarks)) for table in self.tables if table.rows)


def tables_of(path: Path, tree: Node) -> tuple[ForeignTable, ...]:
    """Return all tables of a container's content, as `Found.finished` does."""
    found = Found()
    _collect(found, path, "", tree)
    return found.finished(path)


def array_column(name: str, values: Array | Sequence[object], units: str = "") -> ForeignColumn:
    """Return a column of numbers, dates, durations or texts; of a list, None is a missing value."""
    if isinstance(values, np.ndarray) and values.dtype.kind in "Mm":
        return moments_column(name, values)
    units = canonical_unit(units) or units or split_unit(name)[1] or ""
    if isinstance(values, np.ndarray) and values.dtype.kind in "fiub":
        # A damaged file may hold NaN that signal, which are NaN all the same, and more than a float64 takes.
        with np.errstate(invalid="ignore", over="ignore"):
            return ForeignColumn(name, units, np.asarray(values, dtype=np.float64))
    items: Sequence[object] = values.tolist() if isinstance(values, np.ndarray) else values
    if _are(_NUMBERS, items):
        return ForeignColumn(name, units, np.array(items, dtype=np.float64))
    return column_of_texts(name, units, [_text(item) for item in items])


def _are(kinds: tuple[type, ...], items: Iterable[object]) -> bool:
    """Whether all items are of these kinds; a million items have few types."""
    return all(issubclass(kind, kinds) for kind in set(map(type, items)))


def _text(item: object) -> str:
    return item.decode("utf-8", "replace") if isinstance(item, bytes) else "" if item is None else str(item).strip()


def _collect(found: Found, path: Path, place: str, node: Node) -> None:
    """Add the tables at a node, and then those below it."""
    columns: dict[int, list[ForeignColumn]] = {}
    matrices: list[tuple[str, Array]] = []
    nodes: list[tuple[str, Node]] = []
    for name, value in (child for item in node.items() for child in _expanded(*item)):
        full = _below(place, name)
        match value:
            case Mapping():
                nodes.append((full, value))
            case np.ndarray() if value.ndim == 2:
                matrices.append((name, value))
            case np.ndarray() | list():
                columns.setdefault(len(value), []).append(array_column(name, value))
            case Unread(why):
                found.remarks.append(f"{full!r} {why}" if full else f"the file {why}")
            case _:
                found.values.append(f"{full!r}"[1:-1] + f" = {value!r:.40}")
    nodes = [(full, child) for full, child in nodes if not _add_channel(columns, full.removeprefix(f"{place}."), child)]
    for name, matrix in matrices:
        rows = next((size for size in matrix.shape if size in columns), max(matrix.shape))
        upright = matrix if matrix.shape[0] == rows else matrix.T
        numbered = [array_column(_numbered(name, k), values) for k, values in enumerate(upright.T, start=1)]
        if rows in columns:
            columns[rows] += numbered
        else:
            found.tables.append(ForeignTable(path, tuple(numbered), name=_below(place, name)))
    largest = max(columns, key=lambda rows: rows * len(columns[rows]), default=0)
    for rows, group in columns.items():
        own = place if rows == largest else _below(place, group[0].name)
        found.tables.append(ForeignTable(path, tuple(group), name=own))
    for full, child in nodes:
        _collect(found, path, full, child)


def _add_channel(columns: dict[int, list[ForeignColumn]], name: str, node: Node) -> bool:
    """Add a node of one array if it is a channel: states its unit, or is as long as others; return whether it is."""
    stated = {key.casefold(): value for key, value in node.items()}
    arrays = [value for value in node.values() if not isinstance(value, _SINGLE)]
    if len(arrays) != 1 or not isinstance(arrays[0], np.ndarray | list) or np.ndim(arrays[0]) != 1:
        return False
    units = str(stated.get("unit", stated.get("units", "")))
    if not units and len(arrays[0]) not in columns:
        return False
    own_name = str(stated.get("name", stated.get("label", "")) or name)
    columns.setdefault(len(arrays[0]), []).append(array_column(own_name, arrays[0], units))
    return True


def _below(place: str, name: str) -> str:
    return f"{place}.{name}" if place and name else place or name


def _expanded(name: str, value: object) -> Iterator[tuple[str, object]]:
    """Yield a child as it is, or as a node if it is a list of records, or the items of a list as numbered children."""
    if isinstance(value, np.ndarray):
        value = {part: value[part] for part in value.dtype.names} if value.dtype.names else _plain_array(value)
    elif isinstance(value, list) and len(value) == 1:
        yield from _expanded(name, value[0])
        return
    if not isinstance(value, list) or _are(_SINGLE, value):
        yield name, value
    elif (table := _as_table(name, value)) is not None:
        yield from _expanded(name, table)
    else:
        for number, item in enumerate(value, start=1):
            yield from _expanded(_numbered(name, number), item)


def _plain_array(array: Array) -> object:
    if array.size == 1:
        return array.item()
    is_table = array.ndim == 1 or (array.ndim == 2 and 0 < min(array.shape) <= MAX_MATRIX_COLUMNS)
    if is_table and array.dtype.kind in "fiubMmUS":
        return array
    return Unread(f"is an array of {' × '.join(map(str, array.shape))} ({array.dtype}), not a table")


def _as_table(name: str, items: Sequence[object]) -> Node | Array | None:
    """Take a list of records, or of lists of one length, as a table; None when its items are tables themselves."""
    records = [_flat(item) for item in items if isinstance(item, Mapping)]
    lists = [list(item) for item in items if isinstance(item, list | np.ndarray) and np.ndim(item) == 1]
    if len(records) == len(items):
        return _of_records(records)
    is_even = len(lists) == len(items) and len(set(map(len, lists))) == 1
    return _of_lists(name, lists) if is_even and _are(_SINGLE, chain.from_iterable(lists)) else None


def _of_records(records: Sequence[Node]) -> Node | None:
    cells = chain.from_iterable(record.values() for record in records)
    if not _are(_SINGLE, cells):
        cells = chain.from_iterable(record.values() for record in records)
        vectors = [cell for cell in cells if not isinstance(cell, _SINGLE)]
        if any(not isinstance(cell, list | np.ndarray) or len(cell) >= len(records) for cell in vectors):
            return None
        records = [_spread(record) for record in records]
    return {key: [row.get(key) for row in records] for key in dict.fromkeys(chain.from_iterable(records))}


def _of_lists(name: str, lists: Sequence[Sequence[object]]) -> Node | Array:
    heading = lists[0]
    if len(lists) > 2 and all(isinstance(cell, str) for cell in heading) and len(set(heading)) == len(heading):
        return {str(key): list(cells) for key, cells in zip(heading, zip(*lists[1:], strict=True), strict=True)}
    try:
        return np.array(lists, dtype=np.float64)
    except ValueError:
        upright = lists if len(lists) >= len(heading) else list(zip(*lists, strict=True))
        return {_numbered(name, k): list(cells) for k, cells in enumerate(zip(*upright, strict=True), start=1)}


def _flat(record: Node) -> Node:
    if dict not in set(map(type, record.values())):
        return record
    flat: dict[str, object] = {}
    for name, value in record.items():
        flat |= (
            {f"{name}.{key}": cell for key, cell in _flat(value).items()} if isinstance(value, dict) else {name: value}
        )
    return flat


def _spread(record: Node) -> dict[str, object]:
    spread: dict[str, object] = {}
    for name, value in record.items():
        cells = enumerate(value, start=1) if isinstance(value, list | np.ndarray) else None
        spread |= {name: value} if cells is None else {_numbered(name, k): cell for k, cell in cells}
    return spread


def _numbered(name: str, number: int) -> str:
    """Name one of many; in brackets the number could be a unit."""
    return f"{name}.{number}" if name else f"column {number}"


def read_numpy(path: Path) -> tuple[ForeignTable, ...]:
    """Read a NumPy array or archive; raises `ImportDataError` when it is none, or holds no table."""
    with damage_reported(path, "NumPy"), path.open("rb") as file:
        if not zipfile.is_zipfile(file):
            return tables_of(path, {"": _numpy_array(lambda: np.load(path, allow_pickle=False))})
        require_bounded(path, zipped_bytes(path))
        with np.load(path, allow_pickle=False) as archive:
            arrays = {str(name): _numpy_array(partial(archive.__getitem__, name)) for name in archive.files}
        return tables_of(path, arrays)


def _numpy_array(load: Callable[[], Array]) -> Array | Unread:
    try:
        return load()
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise
        return Unread("holds Python objects, which can run code when they are opened; save it as numbers")


def read_arrow(path: Path, kind: FileKind) -> tuple[ForeignTable, ...]:
    """Read a Parquet, Feather or Arrow file; raises `ImportDataError` when it is none."""
    import pyarrow as pa
    from pyarrow import dataset, fs

    with damage_reported(path, kind):
        form = "parquet" if kind is FileKind.PARQUET else "ipc"
        source = dataset.dataset(str(path.absolute()), format=form, filesystem=fs.LocalFileSystem())
        require_bounded(path, 8 * source.count_rows() * len(source.schema))
        table = source.to_table()
        while any(pa.types.is_struct(column.type) for column in table.schema):
            table = table.flatten()
        columns: list[ForeignColumn] = []
        found = Found()
        for column, cells in zip(table.schema, table.columns, strict=True):
            known = column.metadata or {}
            units = (known.get(b"units") or known.get(b"unit") or b"").decode("utf-8", "replace")
            if (values := _arrow_column(column.name, cells, units)) is None:
                found.remarks.append(f"column {column.name!r} holds {column.type}, not numbers")
            else:
                columns.append(values)
        found.tables = [ForeignTable(path, tuple(columns))] if columns else []
        return found.finished(path)


def _arrow_column(name: str, cells: "pa.ChunkedArray", units: str) -> ForeignColumn | None:
    import pyarrow as pa

    types = pa.types
    if types.is_dictionary(cells.type):
        cells = cells.cast(cells.type.value_type)
    kind = cells.type
    if types.is_timestamp(kind) or types.is_date(kind) or types.is_duration(kind):
        return moments_column(name, cells.to_numpy(), UTC if getattr(kind, "tz", None) else None)
    if types.is_null(kind) or types.is_string(kind) or types.is_large_string(kind) or types.is_time(kind):
        return array_column(name, cells.to_pylist(), units)
    if types.is_primitive(kind) or types.is_decimal(kind):
        return array_column(name, cells.cast(pa.float64(), safe=False).to_numpy(), units)
    return None


def read_json(path: Path) -> tuple[ForeignTable, ...]:
    """Read JSON, of one value or a value for each line: records, lists by column, and all that pandas writes.

    Raises `ImportDataError` when it is none of these.
    """
    with damage_reported(path, "JSON"):
        data = path.read_bytes()
        text = data.decode(json.detect_encoding(data))
        try:
            content = json.loads(text, object_pairs_hook=_unique_names)
        except json.JSONDecodeError as error:
            if error.msg != "Extra data":
                raise
            content = list(_json_lines(path, text))
        return tables_of(path, {"": _oriented(content)})


def _json_lines(path: Path, text: str) -> Iterator[object]:
    for number, line in enumerate(text.split("\n"), start=1):
        try:
            if line.strip():
                yield json.loads(line, object_pairs_hook=_unique_names)
        except json.JSONDecodeError as error:
            what = f"line {number} is no JSON value ({error.msg})"
            raise ImportDataError(f"{path}: {what}; correct or remove it.") from error


def _unique_names(pairs: list[tuple[str, object]]) -> dict[str, object]:
    content = dict(pairs)
    if len(content) == len(pairs):
        return content
    return dict(zip(unique([name for name, _ in pairs]), (value for _, value in pairs), strict=True))


def _oriented(value: object) -> object:
    """Turn frames as pandas writes them, anywhere in JSON, into lists by column."""
    if isinstance(value, list):
        return [_frame(item) for item in value]
    frame = _frame(value)
    if not isinstance(value, dict) or frame is not value:
        return frame
    if (crossed := _crossed(value)) is not None:
        return crossed
    return {name: _oriented(item) for name, item in value.items()}


def _frame(value: object) -> object:
    """Turn the orients `split` and `table` into lists by column and records; all else stays as it is."""
    match value:
        case {"schema": {"fields": _}, "data": list(records)}:
            return records
        case {"columns": list(names), "data": list(rows), **others}:
            by_column = zip(*rows, strict=True) if rows else [()] * len(names)
            texts = unique([".".join(map(str, name)) if isinstance(name, list) else str(name) for name in names])
            columns = dict(zip(texts, map(list, by_column), strict=True))
            labels = others.get("index")
            return (_row_labels(labels) if isinstance(labels, list) else {}) | columns
    return value


def _crossed(value: Mapping[str, object]) -> Node | None:
    """Turn the orients `columns` and `index`, objects of objects of equal names, into lists by column."""
    inner = [item for item in value.values() if isinstance(item, dict)]
    if not inner or len(inner) < len(value) or any(item.keys() != inner[0].keys() for item in inner):
        return None
    if not inner[0] or not _are(_SINGLE, chain.from_iterable(item.values() for item in inner)):
        return None
    are_labels = [all(map(_ROW_LABEL.fullmatch, names)) for names in (value, inner[0])]
    if not any(are_labels) and max(len(value), len(inner[0])) < MIN_LABELLED_ROWS:
        return None
    by_row = are_labels[0] if are_labels[0] != are_labels[1] else len(value) > len(inner[0])
    if by_row:
        return _row_labels(list(value)) | {name: [item[name] for item in inner] for name in inner[0]}
    names = list(inner[0])
    columns = {name: [item[label] for label in names] for name, item in zip(value, inner, strict=True)}
    return _row_labels(names) | columns


def _row_labels(labels: Sequence[object]) -> dict[str, list[object]]:
    """Return labels of rows as a column, unless they only count the rows."""
    counted = [str(row) for row in range(len(labels))]
    return {} if [str(label) for label in labels] == counted else {"index": list(labels)}


def unique(names: Sequence[str]) -> list[str]:
    """Return names of which the second of the same gets its number from 1 behind it."""
    return [name if name not in names[:at] else f"{name} ({at + 1})" for at, name in enumerate(names)]
