"""MAT files of version 4 to 7, by SciPy, and of version 7.3, which are HDF5, as trees of named arrays.

Objects (datetime, table, timetable, string …) are kept in a format of their own that MathWorks does not publish; in
their place stand numbers that refer to it. They are named, with the words to type in MATLAB.
"""

import re
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dragrig.analysis.importing import file_kinds
from dragrig.analysis.importing.containers import Unread, tables_of
from dragrig.analysis.importing.file_kinds import damage_reported, require_bounded
from dragrig.analysis.importing.foreign import ForeignTable
from dragrig.config import ImportDataError
from dragrig.rig import refuse_foreign_storage

if TYPE_CHECKING:
    import h5py

_HEADER_BYTES, _COMPRESSED = 128, 15
_NO_TABLE = "is a function or a sparse matrix, not a table"
_HDF5_CLASS = re.compile(r"(double|single|logical|char|cell|struct|u?int(8|16|32|64))?")
_IN_MATLAB: Mapping[str, str] = {
    "datetime": "{0} = posixtime({0})",
    "duration": "{0} = seconds({0})",
    "calendarDuration": "{0} = seconds(time({0}))",
    "string": "{0} = cellstr({0})",
    "categorical": "{0} = cellstr({0})",
    "table": 'writetable({0}, "{0}.csv")',
    "timetable": 'writetimetable({0}, "{0}.csv")',
    "timeseries": '{0} = struct("Time", {0}.Time, "Data", {0}.Data)',
}


def read_mat(path: Path) -> tuple[ForeignTable, ...]:
    """Read a MAT file of version 4 to 7; raises `ImportDataError` when it is none, or holds no table."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabOpaque, varmats_from_mat

    with damage_reported(path, "MAT"), path.open("rb") as file:
        is_version_4 = 0 in file.read(4)
        require_bounded(path, path.stat().st_size if is_version_4 else unpacked_bytes(path))
        file.seek(0)
        # One by one: objects have their names elsewhere, and would replace each other.
        streams = [file] if is_version_4 else [stream for _, stream in varmats_from_mat(file)]
        variables: dict[str, object] = {}
        # The stubs of SciPy before 1.18 know paths alone, and its objects have their names among their fields.
        for name, value in (item for stream in streams for item in loadmat(stream).items()):  # type: ignore[arg-type]
            if name and not name.startswith("__"):
                named_within = isinstance(value, MatlabOpaque) and "s0" in (value.dtype.names or ())
                own_name = value["s0"].item().decode() if named_within else name
                variables[own_name] = _plain(own_name, value)
        return tables_of(path, variables)


def _plain(name: str, value: object) -> object:
    """Turn SciPy's form of a variable into dicts, lists, arrays and single values."""
    from scipy.io.matlab import MatlabFunction, MatlabOpaque
    from scipy.sparse import issparse

    if isinstance(value, MatlabOpaque):
        before_1_18 = "s2" in (value.dtype.names or ())
        return _object(name, value["s2"].item().decode() if before_1_18 else str(value["_Class"].item()))
    if isinstance(value, MatlabFunction) or issparse(value) or not isinstance(value, np.ndarray):
        return Unread(_NO_TABLE)
    if value.dtype.names:
        elements: list[object] = []
        for number, one in enumerate(value.ravel(order="F"), start=1):
            own = name if value.size == 1 else f"{name}({number})"
            elements.append({key: _plain(f"{own}.{key}", one[key]) for key in value.dtype.names})
        return elements[0] if value.size == 1 else elements
    if value.dtype != object:
        return value.item() if value.size == 1 else np.squeeze(value)
    if value.ndim == 2 and min(value.shape) > 1:
        return [[_plain(name, cell) for cell in row] for row in value]
    return [_plain(name, cell) for cell in value.ravel()]


def _object(name: str, kind: str) -> Unread:
    """Return the words that make data of an object, named as MATLAB does."""
    command = _IN_MATLAB.get(kind, "{0} = struct({0})").format(name)
    return Unread(f"is a MATLAB {kind}, which only MATLAB opens; type {command} there and save or import that")


def unpacked_bytes(path: Path) -> int:
    """Unpack the compressed elements of a MAT file of version 5 piece by piece, and return their size up to the limit.

    MathWorks, MAT-File Format: a header of 128 bytes whose last two tell the byte order; then elements, each with its
    type (15: compressed) and its number of bytes in front.
    """
    total = 0
    with path.open("rb") as file:
        order = "<" if file.read(_HEADER_BYTES)[-2:] == b"IM" else ">"
        while len(tag := file.read(8)) == 8 and total <= file_kinds.MAX_UNPACKED_BYTES:
            kind, size = struct.unpack(f"{order}II", tag)
            body = file.read(size)
            if kind != _COMPRESSED:
                total += size
                continue
            unpacker = zlib.decompressobj()
            while body and not unpacker.eof and total <= file_kinds.MAX_UNPACKED_BYTES:
                total += len(unpacker.decompress(body, 1 << 20))
                body = unpacker.unconsumed_tail
    return total


def read_mat73(path: Path) -> tuple[ForeignTable, ...]:
    """Read a MAT file of version 7.3; raises `ImportDataError` when it is none, or holds no table."""
    import h5py

    with damage_reported(path, "MAT"), h5py.File(path, "r") as file:
        refuse_foreign_storage(file)
        sizes = [0]
        file.visititems(lambda _, item: sizes.append(item.nbytes if isinstance(item, h5py.Dataset) else 0))
        require_bounded(path, sum(sizes))
        variables = _Hdf5Variables(path).group(file)
        return tables_of(path, variables)


class _Hdf5Variables:
    """Reads variables as MATLAB writes them: matrices by column, cells and arrays of structs as references."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read: set[int] = set()

    def group(self, group: "h5py.Group", place: str = "") -> dict[str, object]:
        return {name: self._value(f"{place}{name}", item) for name, item in group.items() if not name.startswith("#")}

    def _value(self, name: str, item: "h5py.Group | h5py.Dataset") -> object:
        import h5py

        kind = item.attrs.get("MATLAB_class", b"").decode()
        address = h5py.h5o.get_info(item.id).addr
        if "MATLAB_empty" in item.attrs:
            return np.empty(0)
        if address in self._read:
            raise ImportDataError(f"{self._path}: {name!r} refers to what is read already; save it anew in MATLAB.")
        self._read.add(address)
        if "MATLAB_sparse" in item.attrs or kind == "function_handle":
            return Unread(_NO_TABLE)
        if "MATLAB_object_decode" in item.attrs or not _HDF5_CLASS.fullmatch(kind):
            return _object(name, kind or "object")
        return self._struct(name, item) if isinstance(item, h5py.Group) else self._array(name, kind, item)

    def _array(self, name: str, kind: str, item: "h5py.Dataset") -> object:
        import h5py

        values = np.asarray(item[()]).T
        if h5py.check_ref_dtype(item.dtype):
            cells = [[self._value(name, item.file[cell]) for cell in row] for row in np.atleast_2d(values)]
            return cells if min(len(cells), len(cells[0])) > 1 else [cell for row in cells for cell in row]
        if kind == "char":
            rows = ["".join(map(chr, row)) for row in np.atleast_2d(values).tolist()]
            return rows[0] if len(rows) == 1 else rows
        return Unread("holds complex numbers") if item.dtype.names == ("real", "imag") else np.squeeze(values)

    def _struct(self, place: str, group: "h5py.Group") -> object:
        """Return a struct as dict, or an array of structs, whose fields are references, as list of dicts."""
        import h5py

        fields = {
            name: item[()].ravel()
            for name, item in group.items()
            if isinstance(item, h5py.Dataset) and h5py.check_ref_dtype(item.dtype) and "MATLAB_class" not in item.attrs
        }
        if not fields or len(fields) < len(group):
            return self.group(group, f"{place}.")
        columns = [
            [self._value(f"{place}({number}).{name}", group.file[cell]) for number, cell in enumerate(cells, start=1)]
            for name, cells in fields.items()
        ]
        return [dict(zip(fields, row, strict=True)) for row in zip(*columns, strict=True)]
