"""Parquet, MATLAB and NumPy files."""

import json
from pathlib import Path
from typing import TypeAlias

import numpy as np

from dragrig.analysis.exporting.content import Content, Json
from dragrig.analysis.progress import Progress
from dragrig.config.errors import AnalysisError

ROW_GROUP = 1 << 18
"""Rows of a Parquet file that are written at a time."""
METADATA_KEY = b"dragrig"
MAT_LIMIT_BYTES = 1 << 31
"""No variable of a version 5 MAT file can be larger."""
_LONGEST_MAT_NAME = 63

_Mat: TypeAlias = "str | float | int | bool | np.ndarray[tuple[int, ...], np.dtype[np.generic]] | dict[str, _Mat]"


def write_parquet(part: Path, content: Content, progress: Progress) -> None:
    """Write a Parquet file, row group by row group; the metadata is JSON under the schema's key `dragrig`."""
    import pyarrow as pa
    from pyarrow import parquet

    rows = len(content.columns[0].values)
    schema = pa.schema(
        [
            pa.field(c.name, pa.from_numpy_dtype(c.values.dtype), metadata={b"units": c.units.encode()})
            for c in content.columns
        ],
        metadata={METADATA_KEY: json.dumps(content.metadata).encode()},
    )
    with parquet.ParquetWriter(part, schema, compression="zstd") as writer:
        for start in range(0, rows, ROW_GROUP):
            progress(start, rows)
            arrays = [pa.array(c.values[start : start + ROW_GROUP]) for c in content.columns]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
    progress(rows, rows)


def write_npz(part: Path, content: Content) -> None:
    """Write a compressed NumPy archive: one array for each column, and `metadata` as JSON text."""
    arrays = {column.name: column.values for column in content.columns}
    with part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, metadata=np.array(json.dumps(content.metadata)), **arrays)


def write_mat(part: Path, content: Content) -> None:
    """Write a version 5 MAT file with one struct `run`: a field for each column, and the metadata.

    The metadata are there twice, as the struct `metadata` and, for reading back, as JSON text.

    Raises
    ------
    AnalysisError
        When a column is too large for the format.
    """
    from scipy.io import savemat

    for column in content.columns:
        if column.values.nbytes >= MAT_LIMIT_BYTES:
            raise AnalysisError(f"{column.name} has more than 2 GB, which a MAT file cannot hold; export to parquet.")
    fields: dict[str, _Mat] = {_mat_name(column.name): column.values for column in content.columns}
    fields["metadata"] = _struct(content.metadata)
    fields["metadata_json"] = json.dumps(content.metadata)
    savemat(str(part), {"run": fields}, appendmat=False, long_field_names=True, do_compression=True, oned_as="column")


def _struct(value: "Json | object") -> _Mat:
    if isinstance(value, dict):
        return {_mat_name(str(key)): _struct(inner) for key, inner in value.items()}
    if value is None:
        return float("nan")
    if isinstance(value, list):
        return _cell(value)
    if isinstance(value, str | bool | int | float):
        return value
    return str(value)


def _cell(items: "list[Json]") -> "np.ndarray[tuple[int, ...], np.dtype[np.generic]]":
    cell = np.empty(len(items), dtype=object)
    for k, item in enumerate(items):
        cell[k] = _struct(item)
    return cell


def _mat_name(name: str) -> str:
    """Return a name that MATLAB accepts for a field."""
    plain = "".join(letter if letter.isascii() and letter.isalnum() else "_" for letter in name)
    return (plain if plain[:1].isalpha() else f"x_{plain}")[:_LONGEST_MAT_NAME]
