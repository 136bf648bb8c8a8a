"""Tables from MATLAB, Parquet, TDMS and NumPy files."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dragrig.analysis.importing.foreign import BadCell, ForeignColumn, ForeignTable
from dragrig.analysis.importing.units import canonical, unit_of_name
from dragrig.config.errors import ImportDataError
from dragrig.config.loading import nearest

MOST_COLUMNS = 64
"""A matrix with more columns than this is no table."""
METADATA_KEY = b"dragrig"


@dataclass(frozen=True, slots=True, eq=False)
class _Vector:
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
        raise _damaged(path, "Parquet", error) from error
    vectors = []
    for field, column in zip(table.schema, table.columns, strict=True):
        units = (field.metadata or {}).get(b"units", b"").decode("utf-8", "replace")
        numeric = pa.types.is_integer(field.type) or pa.types.is_floating(field.type)
        values = column.to_numpy() if numeric else np.array(column.to_pylist(), dtype=object)
        vectors.append(_Vector("", field.name, values, units))
    export = (table.schema.metadata or {}).get(METADATA_KEY, b"")
    return _table(path, vectors, export=_json(export.decode("utf-8", "replace")))


def read_npz(path: Path) -> ForeignTable:
    """Read a NumPy archive; raises `ImportDataError` when it is none."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            held = {str(name): archive[name] for name in archive.files}
    except Exception as error:
        # NumPy and zipfile report damage as many classes of exception; each means the same to the user.
        raise _damaged(path, "NumPy", error) from error
    export = str(held.pop("metadata", ""))
    return _table(path, list(_vectors("", held)), export=_json(export))


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
        raise _damaged(path, "MAT", error) from error
    run = held.get("run")
    export = str(run.get("metadata_json", "")) if isinstance(run, dict) else ""
    return _table(path, list(_vectors("", held)), table, export=_json(export))


def read_tdms(path: Path, table: str = "") -> ForeignTable:
    """Read a TDMS file; raises `ImportDataError` when it is none.

    Parameters
    ----------
    table
        Group whose channels are meant; the one with the most values when empty.
    """
    from nptdms import TdmsFile

    vectors: list[_Vector] = []
    increments: dict[str, set[float]] = {}
    try:
        for group in TdmsFile.read(path).groups():
            for channel in group.channels():
                units = str(channel.properties.get("unit_string") or channel.properties.get("NI_UnitDescription") or "")
                vectors.append(_Vector(group.name, channel.name, np.asarray(channel[:]), units))
                increments.setdefault(group.name, set()).add(float(channel.properties.get("wf_increment", 0.0)))
    except Exception as error:
        # npTDMS reports damage as almost any class of exception; each means the same to the user.
        raise _damaged(path, "TDMS", error) from error
    chosen, group_name = _chosen(path, vectors, table)
    steps = increments.get(group_name, set())
    step = steps.pop() if len(steps) == 1 else 0.0
    return _table(path, chosen, sample_rate_hz=1 / step if step > 0 else None)


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


def _vectors(group: str, held: Mapping[str, object]) -> Iterable[_Vector]:
    for name, value in held.items():
        if isinstance(value, dict):
            yield from _vectors(f"{group}.{name}" if group else name, value)
        elif isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
            if value.ndim == 1:
                yield _Vector(group, name, value)
            elif value.ndim == 2 and 1 < min(value.shape) <= MOST_COLUMNS:
                columns = value if value.shape[0] >= value.shape[1] else value.T
                for k in range(columns.shape[1]):
                    yield _Vector(f"{group}.{name}" if group else name, f"{name}[{k + 1}]", columns[:, k])


def _chosen(path: Path, vectors: Sequence[_Vector], table: str) -> tuple[list[_Vector], str]:
    """Vectors of one group and one length: those that are asked for, or that hold the most values."""
    groups: dict[tuple[str, int], list[_Vector]] = {}
    for vector in vectors:
        groups.setdefault((vector.group, len(vector.values)), []).append(vector)
    wanted = {key: found for key, found in groups.items() if not table or key[0] == table}
    if not wanted:
        known = sorted({vector.group for vector in vectors if vector.group})
        if not vectors:
            raise ImportDataError(f"{path}: holds no columns of numbers; give a file with data.")
        raise ImportDataError(
            f"{path}: there is no table {table!r}; {nearest(table, known) if known else 'name none.'}"
        )
    (group, _), chosen = max(wanted.items(), key=lambda one: one[0][1] * len(one[1]))
    return chosen, group


def _table(
    path: Path,
    vectors: Sequence[_Vector],
    table: str = "",
    *,
    sample_rate_hz: float | None = None,
    export: Mapping[str, object] | None = None,
) -> ForeignTable:
    chosen, _ = _chosen(path, vectors, table)
    if not len(chosen[0].values):
        raise ImportDataError(f"{path}: holds columns without any rows; give a file with data.")
    return ForeignTable(
        path, tuple(_column(vector) for vector in chosen), sample_rate_hz=sample_rate_hz, export=export or {}
    )


def _column(vector: _Vector) -> ForeignColumn:
    units = canonical(vector.units) or vector.units or unit_of_name(vector.name)[1] or ""
    if vector.values.dtype.kind == "M":
        seconds = (vector.values - vector.values[0]) / np.timedelta64(1, "s")
        return ForeignColumn(vector.name, "s", np.asarray(seconds, dtype=np.float64))
    if vector.values.dtype.kind not in "fiub":
        bad = BadCell(0, str(vector.values[0]))
        return ForeignColumn(vector.name, units, np.full(len(vector.values), np.nan), bad)
    return ForeignColumn(vector.name, units, np.asarray(vector.values, dtype=np.float64))


def _json(text: str) -> dict[str, object]:
    try:
        found = json.loads(text) if text else {}
    except ValueError:
        return {}
    return found if isinstance(found, dict) and "dragrig-export" in found else {}


def _damaged(path: Path, what: str, error: Exception) -> ImportDataError:
    if isinstance(error, OSError) and error.strerror:
        return ImportDataError(f"{path}: cannot be read ({error.strerror}); check the path.")
    said = (str(error).splitlines() or [type(error).__name__])[0]
    return ImportDataError(f"{path}: is damaged or no {what} file ({said:.100}); export it anew or as CSV.")
