"""Export of runs to CSV, Parquet, MATLAB, NumPy and TDMS files."""

import io
import json
import re
import unicodedata
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import count, pairwise
from math import floor, isfinite, log10
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from dragrig.analysis.estimates import Progress, no_progress
from dragrig.analysis.segments import gap_starts
from dragrig.analysis.wording import printable
from dragrig.config import AnalysisError, OutputError
from dragrig.rig import PHASE_NAMES, Attribute, FloatArray, IndexArray, Run

EXPORT_FORMAT_KEY, EXPORT_PART_KEY = "dragrig-export", "dragrig-export-part"
"""First in the metadata of a whole run, and of one with columns or samples left out."""
EXPORT_FORMAT_VERSION = 1
DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab", "|": "bar", " ": "space"}
CSV_CHUNK_ROWS = 1 << 16
PARQUET_ROW_GROUP = 1 << 18
"""Rows that are written at a time."""
PARQUET_METADATA_KEY, TDMS_METADATA_KEY = b"dragrig", "dragrig"
MAT_LIMIT_BYTES = 1 << 31
"""Largest variable of a version 5 MAT file."""
MAX_MATLAB_NAME, MAX_UNIT_IN_NAME = 63, 24
MATLAB_KEYWORDS = frozenset({
    "break", "case", "catch", "classdef", "continue", "else", "elseif", "end", "for", "function", "global", "if",
    "otherwise", "parfor", "persistent", "return", "spmd", "switch", "try", "while",
})  # fmt: skip
FRAME = ("time", "force", "motor_force", "position", "command", "phase")
"""Datasets whose names no other column takes."""
MEAN_DIGITS = 15
MAX_EXACT_POWER = 22
"""Largest power of ten that a double holds exactly, so that rounding gives the double nearest to the decimal."""

Json = str | float | int | bool | None | list["Json"] | dict[str, "Json"]
MatlabValue: TypeAlias = (
    "str | float | int | bool | np.ndarray[tuple[int, ...], np.dtype[np.generic]] | dict[str, MatlabValue]"
)


class ExportFormat(StrEnum):
    """Formats of an export; the value is the file's ending as well."""

    CSV = "csv"
    PARQUET = "parquet"
    MAT = "mat"
    NPZ = "npz"
    TDMS = "tdms"


RESERVED = {
    ExportFormat.MAT: ("metadata", "metadata_json"),
    # Parameters of `numpy.savez_compressed`, which takes every array under its name.
    ExportFormat.NPZ: ("metadata", "file", "allow_pickle"),
}
"""Names that no column takes."""


@dataclass(frozen=True, slots=True, eq=False)
class ExportColumn:
    """One column of an export: `dataset` and `units` are those of the run file."""

    name: str
    dataset: str
    units: str
    values: npt.NDArray[np.generic]


@dataclass(frozen=True, slots=True, eq=False)
class ExportContent:
    """Columns, all of the same length, and metadata that any format can carry."""

    columns: tuple[ExportColumn, ...]
    metadata: Mapping[str, Json]

    def described(self) -> dict[str, Json]:
        """Metadata with `columns`: for each its dataset, the name that it had in the run file, unit and number type."""
        columns: Json = {
            column.name: [column.dataset, column.units, column.values.dtype.name] for column in self.columns
        }
        return {**self.metadata, "columns": columns}

    def legal_in(self, export_format: ExportFormat) -> "ExportContent":
        """Return the same with names that are unique and that the format allows."""
        names = _distinct_names(self.columns, RESERVED.get(export_format, ()), matlab=export_format is ExportFormat.MAT)
        columns = (replace(column, name=name) for column, name in zip(self.columns, names, strict=True))
        return replace(self, columns=tuple(columns))


def export_content(run: Run) -> ExportContent:
    """Columns of a run: time, signal, further channels, filtered channels, position, command, phase."""
    trace = run.trace
    names = [trace.signal, *(name for name in trace.channels if name not in {trace.signal, "position"})]
    columns = [_column("time", "s", trace.time)]
    columns += [_column(name, trace.units.get(name, ""), trace.channels[name]) for name in names]
    if run.filtered is not None and len(run.filtered.time) == len(trace.time):
        for name, values in run.filtered.channels.items():
            units = run.filtered.units.get(name) or ("mm/s" if name == "speed" else trace.units.get(name, ""))
            label = name if name not in trace.channels else f"{name}_filtered"
            columns.append(_column(label, units, values, f"filtered/{name}"))
    columns.append(_column("position", "mm", trace.position))
    columns.append(_column("command", "mm", trace.command))
    columns.append(ExportColumn("phase", "phase", "", trace.phase))
    names = _distinct_names(columns)
    named = (replace(column, name=name) for column, name in zip(columns, names, strict=True))
    return ExportContent(tuple(named), _metadata(run))


@dataclass(frozen=True, slots=True)
class ExportSelection:
    """The exported part of a run; time always belongs to it."""

    columns: tuple[str, ...] = ()
    """Names of columns, with or without unit (default: all)."""
    filtered_only: bool = False
    """Whether a recorded quantity is left out where the filter's is there."""
    every: int = 1
    """How many samples become one at their mean time: their mean, of the phase that of the middle sample.

    None is a mean over a gap: they are counted anew after it. Before a gap and at the end fewer become one.
    """

    def __bool__(self) -> bool:
        """Whether anything is left out."""
        return self != ExportSelection()

    def applied_to(self, content: ExportContent, path: Path) -> ExportContent:
        """Return the chosen part of an export; raises `AnalysisError` where there is no such column, or no sample."""
        if not self:
            return content
        time, *others = content.columns
        if self.filtered_only:
            filtered = {column.dataset.removeprefix("filtered/") for column in others if "/" in column.dataset}
            if not filtered:
                raise AnalysisError(f"{path}: was not filtered; run dragrig filter first.")
            others = [column for column in others if column.dataset not in filtered]
        wanted = {column.dataset for name in self.columns for column in _columns_named(name, others, path)}
        chosen = [column for column in others if not self.columns or column.dataset in wanted]
        samples = len(time.values)
        if self.every > max(samples, 1):
            raise AnalysisError(f"{path}: has {samples} samples, fewer than {self.every}; lower --every.")
        rate_hz = float(str(content.metadata["sample_rate_hz"]))
        starts = _block_starts(np.asarray(time.values, dtype=np.float64), rate_hz, self.every)
        columns = tuple(replace(column, values=self._thinned(column, starts)) for column in (time, *chosen))
        lengths = np.diff(starts, append=samples)
        shorter: Json = [[int(row), int(lengths[row])] for row in np.flatnonzero(lengths < self.every)]
        metadata = {key: value for key, value in content.metadata.items() if key != EXPORT_FORMAT_KEY}
        averaged: dict[str, Json] = {"samples_averaged": self.every, "rows_of_fewer_samples": shorter}
        return ExportContent(columns, {EXPORT_PART_KEY: EXPORT_FORMAT_VERSION, **metadata, **averaged})

    def _thinned(self, column: ExportColumn, starts: IndexArray) -> npt.NDArray[np.generic]:
        if self.every == 1 or not starts.size:
            return column.values
        lengths = np.diff(starts, append=len(column.values))
        if column.values.dtype.kind != "f":
            return np.asarray(column.values[starts + (lengths - 1) // 2])
        means = np.add.reduceat(column.values.astype(np.float64), starts) / lengths
        return np.asarray(_without_rounding_noise(means), dtype=column.values.dtype)


def _block_starts(time: FloatArray, sample_rate_hz: float, every: int) -> IndexArray:
    """Index of the first sample of each block of `every` samples, counted anew after each gap."""
    bounds = (0, *gap_starts(time, sample_rate_hz).tolist(), len(time))
    stretches = [np.arange(begin, end, every, dtype=np.intp) for begin, end in pairwise(bounds)]
    return np.concatenate(stretches)


def _without_rounding_noise(values: FloatArray) -> FloatArray:
    """Return computed numbers to the 15 digits that all doubles have, counted from the largest; raw ones stay whole."""
    largest = float(np.max(np.abs(values), initial=0.0, where=np.isfinite(values)))
    decimals = MEAN_DIGITS - 1 - floor(log10(largest)) if largest else 0
    return np.round(values, decimals) if 0 < decimals <= MAX_EXACT_POWER else values


def _columns_named(name: str, columns: Sequence[ExportColumn], path: Path) -> list[ExportColumn]:
    """Return the columns of a name: as exported or as in the run file, else as exported without the unit."""
    named = [column for column in columns if name in {column.name, column.dataset}]
    named = named or [column for column in columns if name == column.name.removesuffix(_unit_ending(column))]
    if not named:
        from dragrig.config import suggestion

        raise AnalysisError(f"{path}: has no column {name}; {suggestion(name, [column.name for column in columns])}")
    return named


def _unit_ending(column: ExportColumn) -> str:
    return column_name("", column.units).removeprefix("column")


def _distinct_names(
    columns: Sequence[ExportColumn], reserved: Sequence[str] = (), *, matlab: bool = False
) -> list[str]:
    """Return the columns' names with a number where two differ in nothing but case, or a name is reserved."""
    taken = {name.casefold() for name in reserved}
    names: dict[str, str] = {}
    for column in sorted(columns, key=lambda column: column.dataset not in FRAME):
        unit = _unit_ending(column) if len(_unit_ending(column)) <= MAX_UNIT_IN_NAME else ""
        name = _free_name(column.name.removesuffix(unit), unit, taken, matlab=matlab)
        taken.add(name.casefold())
        names[column.dataset] = name
    return [names[column.dataset] for column in columns]


def _free_name(stem: str, ending: str, taken: Collection[str], *, matlab: bool) -> str:
    candidates = (_name_of(stem, f"_{number}{ending}" if number > 1 else ending, matlab=matlab) for number in count(1))
    return next(name for name in candidates if name.casefold() not in taken)


def _name_of(stem: str, ending: str, *, matlab: bool) -> str:
    if not matlab:
        return stem + ending
    ending, plain = _ascii(ending), _ascii(stem)
    plain = plain if plain[:1].isalpha() and plain not in MATLAB_KEYWORDS else f"x_{plain}"
    return plain[: MAX_MATLAB_NAME - len(ending)] + ending


def column_name(label: str, units: str) -> str:
    """Append a unit to a column's name: force and mN become force_mN, speed and mm/s speed_mm_s."""
    unit = re.sub(r"\W+", "_", units.replace("²", "2").replace("µ", "u").replace("°", "deg")).strip("_")
    name = re.sub(r"\W+", "_", label).strip("_") or "column"
    return f"{name}_{unit}" if unit else name


def _column(label: str, units: str, values: npt.NDArray[np.generic], dataset: str = "") -> ExportColumn:
    return ExportColumn(column_name(label, units), dataset or label, units, values)


def _metadata(run: Run) -> dict[str, Json]:
    info, header = run.info, run.info.header
    return {
        EXPORT_FORMAT_KEY: EXPORT_FORMAT_VERSION,
        "run_id": header.run_id,
        "start_time": header.start_time.isoformat(),
        "end_time": info.end_time.isoformat() if info.end_time else "",
        "order": header.order,
        "kind": header.kind,
        "backend": header.backend,
        "status": info.status.value,
        "reason": info.reason,
        "sample_rate_hz": run.trace.sample_rate_hz,
        "signal": run.trace.signal,
        "phases": list(PHASE_NAMES),
        "entry": _finite_attributes(header.entry),
        "protocol": _finite_attributes(header.protocol),
        "capsule": _finite_attributes(header.capsule),
        "specimen": _finite_attributes(header.specimen),
        "checks": _finite_attributes(info.checks),
        "filter": _finite_attributes(run.filtered.parameters) if run.filtered is not None else {},
        "events": [[event.time_s, event.kind, event.message] for event in run.events],
        "settings_toml": header.settings_toml,
    }


def _finite_attributes(attributes: Mapping[str, Attribute]) -> dict[str, Json]:
    """Replace numbers that are not finite by None, which JSON can hold."""
    return {
        key: None if isinstance(value, float) and not isfinite(value) else value for key, value in attributes.items()
    }


@dataclass(frozen=True, slots=True)
class CsvStyle:
    """Decimal mark and delimiter of a CSV file.

    Raises `AnalysisError` when decimal mark and delimiter are the same, or not among these.
    """

    decimal: str = "."
    """Decimal mark, `.` or `,`."""
    delimiter: str = ""
    """Comma, semicolon, tab, bar or space; default: comma, or semicolon with decimal commas."""

    def __post_init__(self) -> None:
        if self.decimal not in {".", ","}:
            raise AnalysisError(f"A decimal mark of {self.decimal!r} is not supported; choose . or ,")
        if not self.delimiter:
            object.__setattr__(self, "delimiter", ";" if self.decimal == "," else ",")
        if self.delimiter not in DELIMITERS:
            raise AnalysisError(
                f"A delimiter of {self.delimiter!r} is not supported; choose {', '.join(DELIMITERS.values())}."
            )
        if self.delimiter == self.decimal:
            raise AnalysisError(
                "Decimal mark and delimiter are both a comma, so that columns would be ambiguous; "
                "choose ; as the delimiter."
            )


def write_csv(part: Path, content: ExportContent, style: CsvStyle, progress: Progress) -> None:
    """Write a CSV file in chunks; missing numbers are empty cells, or nan between blanks."""
    import pyarrow as pa
    from pyarrow import csv

    names = [column.name for column in content.columns]
    rows = len(content.columns[0].values)
    options = csv.WriteOptions(include_header=False, delimiter=style.delimiter, quoting_style="none")
    with part.open("wb") as file:
        for key, value in content.described().items():
            file.write(f"# {key}: {printable(json.dumps(value, ensure_ascii=False))}\n".encode())
        file.write((style.delimiter.join(names) + "\n").encode())
        for start in range(0, rows, CSV_CHUNK_ROWS):
            progress(start, rows)
            chunks = (column.values[start : start + CSV_CHUNK_ROWS] for column in content.columns)
            native = (np.ascontiguousarray(chunk, dtype=chunk.dtype.newbyteorder("=")) for chunk in chunks)
            empty_cells = style.delimiter != " "
            table = pa.table([pa.array(values, from_pandas=empty_cells) for values in native], names=names)
            text = io.BytesIO()
            csv.write_csv(table, text, options)
            numbers = text.getvalue()
            file.write(numbers.replace(b".", b",") if style.decimal == "," else numbers)
    progress(rows, rows)


def write_parquet(part: Path, content: ExportContent, progress: Progress) -> None:
    """Write a Parquet file, row group by row group; the metadata is JSON under the schema's key `dragrig`."""
    import pyarrow as pa
    from pyarrow import parquet

    rows = len(content.columns[0].values)
    schema = pa.schema(
        [
            pa.field(
                c.name, pa.from_numpy_dtype(c.values.dtype), metadata={b"units": c.units.encode("utf-8", "replace")}
            )
            for c in content.columns
        ],
        metadata={PARQUET_METADATA_KEY: json.dumps(content.described()).encode()},
    )
    with parquet.ParquetWriter(part, schema, compression="zstd") as writer:
        for start in range(0, rows, PARQUET_ROW_GROUP):
            progress(start, rows)
            arrays = [pa.array(c.values[start : start + PARQUET_ROW_GROUP]) for c in content.columns]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))
    progress(rows, rows)


def write_npz(part: Path, content: ExportContent) -> None:
    """Write a compressed NumPy archive: one array for each column, and `metadata` as JSON text."""
    arrays = {column.name: column.values for column in content.columns}
    with part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, metadata=np.array(json.dumps(content.described())), **arrays)


def write_tdms(part: Path, content: ExportContent) -> None:
    """Write a TDMS file: a channel with its unit for each column in the group `run`, and the metadata as JSON text."""
    from nptdms import ChannelObject, RootObject, TdmsWriter

    channels = [ChannelObject("run", c.name, c.values, {"unit_string": c.units}) for c in content.columns]
    with TdmsWriter(str(part)) as writer:
        writer.write_segment([RootObject({TDMS_METADATA_KEY: json.dumps(content.described())}), *channels])


def write_mat(part: Path, content: ExportContent) -> None:
    """Write a version 5 MAT file with one struct `run`: a field for each column, and the metadata.

    The metadata are stored twice, as the struct `metadata` and, for reading back, as JSON text.

    Raises `AnalysisError` when a column is too large for the format.
    """
    from scipy.io import savemat

    for column in content.columns:
        if column.values.nbytes >= MAT_LIMIT_BYTES:
            raise AnalysisError(f"{column.name} has more than 2 GB, which a MAT file cannot hold; export to parquet.")
    fields: dict[str, MatlabValue] = {column.name: column.values for column in content.columns}
    fields["metadata"] = _to_matlab(content.described())
    fields["metadata_json"] = json.dumps(content.described())
    savemat(str(part), {"run": fields}, appendmat=False, long_field_names=True, do_compression=True, oned_as="column")


def _to_matlab(value: "Json | object") -> MatlabValue:
    if isinstance(value, dict):
        fields: dict[str, MatlabValue] = {}
        for key, inner in value.items():
            fields[_free_name(str(key), "", {name.casefold() for name in fields}, matlab=True)] = _to_matlab(inner)
        return fields
    if value is None:
        return float("nan")
    if isinstance(value, list):
        cell = np.empty(len(value), dtype=object)
        for index, item in enumerate(value):
            cell[index] = _to_matlab(item)
        return cell
    if isinstance(value, bool | int | float):
        return value
    return str(value).encode("utf-8", "replace").decode()


def _ascii(text: str) -> str:
    """Return a text in letters, digits and underscores: accents go, and any other letter is written by its number."""
    letters = (letter for letter in unicodedata.normalize("NFKD", text) if not unicodedata.combining(letter))
    return "".join(
        letter if letter.isascii() and letter.isalnum() else f"u{ord(letter):X}" if letter.isalnum() else "_"
        for letter in letters
    )


def export_run(
    path: Path,
    target: Path,
    export_format: ExportFormat = ExportFormat.CSV,
    style: CsvStyle | None = None,
    *,
    selection: ExportSelection = ExportSelection(),
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> Path:
    """Export a run file.

    Parameters
    ----------
    target
        A file, or a folder in which the export gets the run's name.
    style
        Decimal mark and delimiter of a CSV file.
    selection
        Columns and samples (default: all).
    overwrite
        Whether an existing export may be replaced.

    Returns
    -------
    Path
        The file written; it appears only when it is complete.

    Raises
    ------
    RunFileError
        When the run cannot be read.
    OutputError
        When the file exists already, or cannot be written.
    """
    from dragrig.rig import read_run

    target = _target_file(path, target, export_format)
    _require_free(target, overwrite=overwrite)
    return write_export(
        read_run(path), target, export_format, style, selection=selection, overwrite=overwrite, progress=progress
    )


def export_campaign(
    folder: Path,
    target: Path,
    export_format: ExportFormat = ExportFormat.CSV,
    style: CsvStyle | None = None,
    *,
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Export the runs of a campaign that can be read and are not marked as bad into a folder, one file each.

    Raises
    ------
    RunFileError
        When there is no such campaign, or a run is damaged beyond its head.
    OutputError
        When one of the files exists already (then none is written), or the folder cannot be written.
    """
    from dragrig.rig import read_campaign

    paths = [info.path for info in read_campaign(folder).good]
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{target}: cannot be made a folder ({error.strerror}); choose another.") from error
    for path in paths:
        _require_free(_target_file(path, target, export_format), overwrite=overwrite)
    return tuple(export_run(path, target, export_format, style, overwrite=overwrite) for path in paths)


def write_export(
    run: Run,
    target: Path,
    export_format: ExportFormat,
    style: CsvStyle | None = None,
    *,
    selection: ExportSelection = ExportSelection(),
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> Path:
    """Export a run in memory; otherwise as `export_run`."""
    _require_free(target, overwrite=overwrite)
    if target.exists() and target.samefile(run.info.path):
        raise OutputError(f"{target}: is the run file itself; give the export another name.")
    with _written(target) as part:
        content = selection.applied_to(export_content(run), run.info.path).legal_in(export_format)
        match export_format:
            case ExportFormat.CSV:
                write_csv(part, content, style or CsvStyle(), progress)
            case ExportFormat.PARQUET:
                write_parquet(part, content, progress)
            case ExportFormat.MAT:
                write_mat(part, content)
            case ExportFormat.NPZ:
                write_npz(part, content)
            case ExportFormat.TDMS:
                write_tdms(part, content)
    return target


def _target_file(path: Path, target: Path, export_format: ExportFormat) -> Path:
    return target / f"{path.stem}.{export_format}" if target.is_dir() else target


def _require_free(target: Path, *, overwrite: bool) -> None:
    if target.is_dir():
        raise OutputError(f"{target}: is a folder; give the name of a file.")
    if target.exists() and not overwrite:
        raise OutputError(f"{target}: exists already; choose another name, or allow it to be replaced.")


@contextmanager
def _written(target: Path) -> Iterator[Path]:
    from dragrig.rig import written_atomically

    try:
        with written_atomically(target) as part:
            yield part
    except OSError as error:
        raise OutputError(
            f"{target}: could not be written ({error.strerror or error}); choose another folder, or make room."
        ) from error
