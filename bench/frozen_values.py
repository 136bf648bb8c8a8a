"""What a program answered, as JSON values without anything that differs from call to call.

Times, run ids, paths, versions and durations are taken out; arrays become a checksum with a few sums, from which a
small difference can be told from a large one.
"""

import csv
import hashlib
import json
import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

Json: TypeAlias = "Mapping[str, Json] | list[Json] | str | int | float | bool | None"

VOLATILE_KEYS = frozenset({
    "software",  # name and version of the program
    "timings_s",  # how long parts of a diagnosis took
    "free_bytes",  # free space of the disk
    "raw_sha256",  # over the arrays, which have checksums of their own here
    "drive_port",  # a free port of this computer
})  # fmt: skip
"""Keys and attributes that no two calls share."""

TIME = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d+)?(?:Z|[+-]\d\d:\d\d)?")
STAMP = re.compile(r"\d{8}-\d{6}(?:-\d{3}(?!\d|\.h5|\.csv))?Z?")
RUN_ID = re.compile(r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}")

SHORT = 8
"""Arrays up to this length are kept whole; of longer ones so many samples are kept."""


class Cleaner:
    """Takes out of answers what differs from call to call, and knows which run has which id.

    Parameters
    ----------
    folder
        Working folder of the calls; its path is replaced by ``<folder>``.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = str(folder)
        self._runs: dict[str, str] = {}

    def learn_runs(self, folder: Path) -> None:
        """Read the ids of the runs of a folder, so that answers name a run by its file and not by a random id."""
        for path in sorted(folder.rglob("*.h5")):
            with h5py.File(path) as file:
                run_id = str(file["entry/run" if "entry/run" in file else "entry"].attrs["run_id"])
            self._runs[run_id] = f"<{self.text(path.stem)}>"

    def text(self, text: str) -> str:
        """Return a text without times, stamps of file names, ids and paths of this call."""
        text = RUN_ID.sub(lambda match: self._runs.get(match[0], match[0]), text)
        return STAMP.sub("<stamp>", TIME.sub("<time>", text.replace(self._folder, "<folder>").replace(os.sep, "/")))

    def value(self, value: object) -> Json:
        """Return any value that JSON, TOML or an HDF5 attribute can hold, cleaned."""
        if isinstance(value, Mapping):
            pairs = ((str(key), content) for key, content in value.items())
            return {self.text(key): self.value(content) for key, content in pairs if key not in VOLATILE_KEYS}
        if isinstance(value, np.ndarray) and value.size > SHORT and value.dtype.kind in "biuf":
            return digest(value)
        if isinstance(value, np.ndarray | np.generic):
            return self.value(value.tolist())
        if isinstance(value, list | tuple):
            return [self.value(item) for item in value]
        if value is None or isinstance(value, bool | int | float):
            return value
        return self.text(value.decode() if isinstance(value, bytes) else str(value))


def digest(values: NDArray[np.generic]) -> Json:
    """Return a checksum of an array of numbers, with sums and samples that tell how far two arrays are apart."""
    finite = values[np.isfinite(values)].astype(np.float64)
    if not finite.size:
        return {"dtype": str(values.dtype), "shape": list(values.shape), "missing": int(values.size)}
    picked = np.linspace(0, finite.size - 1, min(SHORT, finite.size)).round().astype(int)
    return {
        "dtype": str(values.dtype),
        "shape": list(values.shape),
        "sha256": hashlib.sha256(np.ascontiguousarray(values).tobytes()).hexdigest()[:16],
        "missing": int(values.size - finite.size),
        "sum": float(finite.sum()),
        "sum_abs": float(np.abs(finite).sum()),
        "sum_squares": float(np.square(finite).sum()),
        "least": float(finite.min()),
        "largest": float(finite.max()),
        "samples": finite[picked].tolist(),
    }


def brief(values: Json) -> Json:
    """Return a digest without its samples, where there are thousands of arrays."""
    assert isinstance(values, Mapping)
    return {key: values[key] for key in ("shape", "sha256", "sum", "sum_abs") if key in values}


def run_file(path: Path, cleaner: Cleaner) -> Json:
    """Return all that a run file holds: attributes, digests of arrays, events, settings."""
    with h5py.File(path) as file:
        result: dict[str, Json] = {"/": cleaner.value(dict(file.attrs))}

        def visit(name: str, node: h5py.Group | h5py.Dataset) -> None:
            result[f"{name} attributes"] = cleaner.value(dict(node.attrs))
            if isinstance(node, h5py.Dataset):
                result[name] = _dataset(name, node, cleaner)

        file.visititems(visit)
    return result


def _dataset(name: str, node: h5py.Dataset, cleaner: Cleaner) -> Json:
    if name.endswith("settings"):
        return cleaner.value(tomllib.loads(node.asstr()[()]))
    values = node[()]
    if isinstance(values, np.ndarray) and values.dtype.names:
        columns = values.dtype.names
        return [cleaner.value(dict(zip(columns, row.tolist(), strict=True))) for row in values]
    return cleaner.value(values)


def traces(path: Path) -> Json:
    """Return brief digests of the arrays of a run's trace."""
    with h5py.File(path) as file:
        trace = file["entry/trace"]
        return {name: brief(digest(trace[name][()])) for name in sorted(trace)}


def runs(folder: Path, cleaner: Cleaner) -> Json:
    """Return all run files of a folder, in the order of their names."""
    return {cleaner.text(path.name): run_file(path, cleaner) for path in sorted(folder.glob("*.h5"))}


def csv_file(path: Path, cleaner: Cleaner) -> Json:
    """Return an exported table: its comments, and each column as a digest or, where it is text, as it is."""
    lines = path.read_text("utf-8").splitlines()
    notes = [line.removeprefix("# ").partition(": ") for line in lines if line.startswith("#")]
    table = list(csv.reader(line for line in lines if not line.startswith("#")))
    columns = zip(*table[1:], strict=True)
    return {
        "notes": {key: cleaner.value(_note(text)) for key, _, text in notes},
        "columns": {
            name: _column(column, cleaner) for name, column in zip(table[0], columns, strict=False)
        },
    }  # fmt: skip


def toml_file(path: Path, cleaner: Cleaner) -> Json:
    """Return what a TOML file holds; nothing where a command wrote none."""
    return cleaner.value(tomllib.loads(path.read_text("utf-8"))) if path.exists() else None


def _note(text: str) -> object:
    return tomllib.loads(json.loads(text)) if text.startswith('"#') else json.loads(text)


def _column(texts: Iterable[str], cleaner: Cleaner) -> Json:
    cells = list(texts)
    try:
        return cleaner.value(np.array([float(text) if text else np.nan for text in cells]))
    except ValueError:
        return [cleaner.text(text) for text in cells]


def exported(path: Path, cleaner: Cleaner) -> Json:
    """Return an exported file of any format."""
    if path.suffix == ".csv":
        return csv_file(path, cleaner)
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as arrays:
            return cleaner.value({name: arrays[name] for name in sorted(arrays)})
    if path.suffix == ".parquet":
        import pandas as pd

        frame = pd.read_parquet(path)
        return cleaner.value({name: frame[name].to_numpy() for name in frame.columns})
    from scipy.io import loadmat

    content = loadmat(path, simplify_cells=True)
    return cleaner.value({key: value for key, value in content.items() if not key.startswith("__")})


def documents(text: str, cleaner: Cleaner) -> Json:
    """Return what a command printed as JSON: one document, or a list of those that it printed line by line."""
    if not text.strip():
        return None
    try:
        return cleaner.value(json.loads(text))
    except json.JSONDecodeError:
        return [cleaner.value(json.loads(line)) for line in text.splitlines() if line.strip()]
