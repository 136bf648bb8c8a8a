"""Containers of named arrays: every table, its clock, and a sentence on all that is in none of them."""

import bz2
import decimal
import gzip
import io
import json
import lzma
import pickle
import sqlite3
import zipfile
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from nptdms import ChannelObject, TdmsWriter
from pyarrow import feather, parquet
from scipy.io import savemat

from dragrig.analysis.importing import file_kinds
from dragrig.analysis.importing.containers import read_arrow, read_json, read_numpy
from dragrig.analysis.importing.file_kinds import FileKind, file_kind
from dragrig.analysis.importing.foreign import ForeignTable
from dragrig.analysis.importing.matlab import read_mat, read_mat73
from dragrig.analysis.importing.readers import read_foreign
from dragrig.analysis.importing.tdms import read_tdms
from dragrig.config.errors import ImportDataError
from places import CAMPAIGN, DATA
from property_tests import examples

FIELD = DATA / "field"
BEGIN = datetime(2026, 5, 4, 9, 15)  # noqa: DTZ001  # as the files have it, in local time
N = 100
TIME = np.arange(N) / 100
FORCE, PLACE = 0.05 + TIME, 5 * TIME
START = np.datetime64("2026-05-04T09:15:00")
Array = np.ndarray[tuple[int, ...], np.dtype[np.generic]]

READERS: Mapping[FileKind, Callable[[Path], tuple[ForeignTable, ...]]] = {
    FileKind.MAT: read_mat,
    FileKind.MAT73: read_mat73,
    FileKind.NUMPY: read_numpy,
    FileKind.JSON: read_json,
    FileKind.TDMS: read_tdms,
    FileKind.PARQUET: lambda path: read_arrow(path, FileKind.PARQUET),
    FileKind.ARROW: lambda path: read_arrow(path, FileKind.ARROW),
}


def tables(path: Path) -> dict[str, ForeignTable]:
    found = READERS[file_kind(path)](path)
    assert len({table.name for table in found}) == len(found)
    for table in found:
        assert {len(column.values) for column in table.columns} == {table.rows}
        assert len({column.name for column in table.columns}) == len(table.columns)
    return {table.name: table for table in found}


def only(path: Path) -> ForeignTable:
    (table,) = tables(path).values()
    return table


def names(table: ForeignTable) -> list[str]:
    return [column.name for column in table.columns]


def remarks(table: ForeignTable) -> str:
    return "; ".join(table.remarks)


@pytest.mark.parametrize(
    ("name", "time"),
    [
        ("20-datetime64.npz", "Time"),
        ("20-decimal.parquet", "Time"),
        ("20-iso-text.parquet", "Time"),
        ("20-pandas-index.parquet", "__index_level_0__"),
        ("20-timestamps.parquet", "Time"),
        ("20-timestamps.tdms", "Time"),
        ("21-lines.jsonl", "Time"),
        ("21-pandas-default.json", "Time"),
        ("21-pandas-index.json", "Time"),
        ("21-records-inside.json", "Time"),
        ("22-record-array.npz", "Time"),
        ("31-array.npy", "1"),
    ],
)
def test_files_from_the_field_give_the_trace_that_was_measured(name: str, time: str) -> None:
    table = only(FIELD / name)
    force, position = ("2", "3") if name.endswith("npy") else ("Force", "Position")
    assert table.rows == 200
    np.testing.assert_allclose(table.column(time).values, np.arange(200) / 100, atol=1e-9)
    np.testing.assert_allclose(table.column(force).values[[0, 1, -1]], [0.05, 0.05026, 0.13134], atol=5e-6)
    np.testing.assert_allclose(table.column(position).values[[0, -1]], [0, 5])
    has_clock = name.startswith("20-") and "decimal" not in name
    zone = UTC if name.endswith("tdms") else None
    begin = BEGIN.replace(tzinfo=zone) if zone else BEGIN.astimezone()
    assert table.column(time).begins_at == (begin if has_clock else None)


@pytest.mark.parametrize(
    ("name", "trials"),
    [
        ("11-two-trials.mat", ["trial1", "trial2"]),
        ("22-struct-array.mat", ["run.1", "run.2"]),
        ("11-two-groups.tdms", ["Test 1", "Test 2"]),
    ],
)
def test_trials_are_tables_of_one_shape(name: str, trials: list[str]) -> None:
    found = tables(FIELD / name)
    assert list(found) == trials
    first, second = found.values()
    np.testing.assert_allclose(second.column("Force").values, 2 * first.column("Force").values)
    assert names(first) == names(second)
    assert first.rows == 200


@pytest.mark.parametrize("name", ["22-datetime-v5.mat", "22-datetime-v73.mat"])
def test_references_to_a_datetime_are_no_data(name: str) -> None:
    table = only(FIELD / name)
    assert names(table) == ["Force", "Position"]
    with pytest.raises(ImportDataError, match=r"'Time' is a MATLAB datetime.*type Time = posixtime\(Time\) there"):
        table.column("Time")


def test_a_timetable_alone_is_named_with_what_to_type() -> None:
    with pytest.raises(
        ImportDataError, match=r'no columns of numbers.*MATLAB timetable.*writetimetable\(run, "run.csv"'
    ):
        read_mat(FIELD / "22-timetable-v5.mat")


def test_every_object_of_a_file_is_named(tmp_path: Path) -> None:
    one, other = ((FIELD / name).read_bytes() for name in ("22-datetime-v5.mat", "22-timetable-v5.mat"))
    (tmp_path / "run.mat").write_bytes(one + other[128:])
    said = remarks(only(tmp_path / "run.mat"))
    assert "'Time' is a MATLAB datetime" in said
    assert "'run' is a MATLAB timetable" in said


@pytest.mark.parametrize(("name", "first"), [("23-datenum.mat", 740107.38541667), ("23-epoch-ms.json", 1777886100000)])
def test_numbers_that_count_days_or_milliseconds_stay_numbers(name: str, first: float) -> None:
    assert only(FIELD / name).columns[0].values[0] == pytest.approx(first, rel=1e-13)


# TDMS


@pytest.mark.parametrize("name", ["02-tdms-start-time.tdms", "02-tdms-start-offset.tdms"])
def test_channels_are_shifted_by_their_starts(name: str) -> None:
    table = only(FIELD / name)
    assert table.rows == 150
    assert table.begins_at == datetime(2026, 5, 4, 9, 15, 0, 500_000, UTC)
    assert table.sample_rate_hz == 100
    assert table.column("Position").values[0] == 0
    assert table.column("Force").values[0] == pytest.approx(0.13043, abs=1e-5)
    assert "150 common rows were taken, without 50 of 'Force', 50 of 'Position'" in remarks(table)


def test_analog_and_counter_groups_of_one_recording_are_one_table() -> None:
    table = only(FIELD / "02-tdms-ai-and-counter-groups.tdms")
    assert (table.name, names(table), table.rows) == ("AI + CTR", ["Force", "Position"], 200)
    assert table.begins_at == BEGIN.replace(tzinfo=UTC)


def waveform(start: np.datetime64 | None = START, **properties: float | str) -> dict[str, object]:
    known = {"wf_increment": 0.01, "wf_start_offset": 0.0, "wf_samples": 1, "unit_string": "N", **properties}
    return known if start is None else {**known, "wf_start_time": start}


def later(seconds: float) -> np.datetime64:
    return START + np.timedelta64(round(seconds * 1e6), "us")


def write_tdms(folder: Path, *channels: tuple[str, str, object, dict[str, object]]) -> Path:
    path = folder / "run.tdms"
    with TdmsWriter(path) as writer:
        writer.write_segment([ChannelObject(*channel) for channel in channels])
    return path


def test_pairs_of_groups_are_joined_by_their_starts(tmp_path: Path) -> None:
    found = tables(
        write_tdms(
            tmp_path,
            ("AI 1", "F", FORCE, waveform()),
            ("CTR 1", "x", PLACE, waveform()),
            ("AI 2", "F", 2 * FORCE, waveform(later(5))),
            ("CTR 2", "x", PLACE, waveform(later(5.02))),
        )
    )
    assert {name: names(table) for name, table in found.items()} == {
        "AI 1 + CTR 1": ["F", "x"],
        "AI 2 + CTR 2": ["F", "x"],
    }
    second = found["AI 2 + CTR 2"]
    assert (second.rows, second.begins_at) == (98, datetime(2026, 5, 4, 9, 15, 5, 20_000, UTC))
    np.testing.assert_array_equal(second.column("F").values, 2 * FORCE[2:])


@pytest.mark.parametrize(
    "channels",
    [
        [("AI 1", "F", FORCE, waveform()), ("AI 2", "F", FORCE, waveform()), ("CTR", "x", PLACE, waveform())],
        [("AI", "F", FORCE, waveform(None)), ("CTR", "x", PLACE, waveform(None))],
        [("AI", "F", FORCE, waveform()), ("CTR", "x", PLACE, waveform(later(30)))],
        [("AI", "F", FORCE, waveform()), ("CTR", "x", PLACE, waveform(wf_increment=0.0101))],
        [("AI", "F", FORCE, waveform()), ("CTR", "x", PLACE[:40], waveform())],
    ],
    ids=["two ways", "no start", "half a minute apart", "another rate", "much shorter"],
)
def test_groups_that_may_be_of_several_recordings_stay_apart(
    tmp_path: Path, channels: Sequence[tuple[str, str, object, dict[str, object]]]
) -> None:
    assert list(tables(write_tdms(tmp_path, *channels))) == [group for group, *_ in channels]


def test_samples_between_those_of_another_channel_are_no_row_with_them(tmp_path: Path) -> None:
    path = write_tdms(tmp_path, ("run", "F", FORCE, waveform()), ("run", "x", PLACE, waveform(later(0.0034))))
    found = tables(path)
    assert {name: names(table) for name, table in found.items()} == {"run": ["F"], "run.x": ["x"]}
    assert "have not one clock and length, so are tables: F; x" in remarks(found["run"])


def test_channels_without_a_clock_go_with_those_that_are_as_long(tmp_path: Path) -> None:
    stamps = START + np.arange(N) * np.timedelta64(10_000, "us")
    never = np.datetime64("1904-01-01T00:00:00")
    found = tables(
        write_tdms(
            tmp_path,
            ("run", "Time", stamps, {}),
            ("run", "F", FORCE, waveform(never, wf_increment=10.0, wf_xunit_string="ms")),
            ("run", "state", ["on"] * N, {}),
            ("run", "short", PLACE[:5], {"NI_UnitDescription": "mm"}),
            ("run", "none", np.zeros(0), {}),
            ("run", "spectrum", PLACE[:7], waveform(None, wf_xunit_string="Hz")),
        )
    )
    assert names(found["run"]) == ["Time", "F", "state"]
    assert (found["run"].sample_rate_hz, found["run"].begins_at) == (100, None)
    assert found["run"].column("Time").begins_at == BEGIN.replace(tzinfo=UTC)
    assert found["run.short"].columns[0].units == "mm"
    assert found["run.spectrum"].sample_rate_hz is None
    assert "channel 'none' is empty" in remarks(found["run"])


def test_a_recording_that_was_cut_off_is_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = write_tdms(tmp_path, ("run", "F", FORCE, waveform()), ("run", "x", PLACE, waveform()))
    path.write_bytes(path.read_bytes()[:-400])
    table = only(path)
    assert table.rows == 50
    assert "the file ends in the middle of a block" in remarks(table)
    assert capfd.readouterr().err == ""


# Parquet, Feather, NumPy


def frame() -> pd.DataFrame:
    stamps = pd.date_range("2026-05-04T09:15", periods=N, freq="10ms", tz="Europe/Berlin")
    return pd.DataFrame({
        "when": stamps,
        "span": pd.to_timedelta(TIME, unit="s"),
        "state": pd.Categorical(["a", "b"] * (N // 2)),
        "is_on": TIME > 0.5,
        "exact": [decimal.Decimal("1.25")] * N,
        "pair": [[1, 2]] * N,
        "count": pd.array([2**60 + k for k in range(N)], dtype="Int64"),
        "clock": [stamp.time() for stamp in stamps],
        "comma": ["1,5", *["0,5"] * (N - 1)],
        "half": TIME.astype(np.float16),
        "gap": [None, *PLACE[1:]],
    }).set_index(pd.MultiIndex.from_arrays([[1] * N, TIME], names=["trial", "t"]))  # fmt: skip


@pytest.mark.parametrize("name", ["run.parquet", "run.feather", "run.csv"])
def test_columns_of_any_type_come_from_parquet_and_feather(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name.endswith("feather"):
        feather.write_feather(frame().reset_index(), path, compression="zstd")
    else:
        frame().to_parquet(path)
    table = only(path)
    assert set(names(table)) == {*frame().columns, "trial", "t"} - {"pair"}
    assert "column 'pair' holds list<" in remarks(table)
    values = {column.name: column.values for column in table.columns}
    assert table.column("when").begins_at == datetime(2026, 5, 4, 7, 15, tzinfo=UTC)
    for column in ("when", "span", "clock", "t"):
        np.testing.assert_allclose(values[column], TIME, atol=1e-12)
    assert [table.column(column).units for column in ("when", "span")] == ["s", "s"]
    assert values["count"][3] == float(2**60 + 3)
    assert values["exact"][0] == 1.25
    assert values["comma"].tolist()[:2] == [1.5, 0.5]
    assert values["is_on"].sum() == 49
    assert np.flatnonzero(np.isnan(values["gap"])).tolist() == [0]
    assert table.column("state").bad is not None


def test_fields_of_structs_and_nanoseconds_come_from_parquet(tmp_path: Path) -> None:
    stamps = pa.array([1_777_886_100_000_000_001 + k for k in range(N)], pa.timestamp("ns", "UTC"))
    load = pa.array([{"N": value, "ok": True} for value in FORCE.tolist()])
    parquet.write_table(pa.table({"load": load, "stamp": stamps}), tmp_path / "run.parquet")
    table = only(tmp_path / "run.parquet")
    assert names(table) == ["load.N", "load.ok", "stamp"]
    np.testing.assert_allclose(table.column("stamp").values, np.arange(N) * 1e-9, rtol=1e-12)


RECORDS = np.array(list(zip(TIME, FORCE, strict=True)), dtype=[("t", "f8"), ("F", "f4")])


def test_arrays_of_one_length_are_a_table_and_records_another(tmp_path: Path) -> None:
    np.savez(
        tmp_path / "run.npz", allow_pickle=True, t=TIME, M=np.c_[FORCE, PLACE], runs=RECORDS, rows=np.zeros((N, 1)),
        span=(TIME * 1e6).astype("m8[us]"), when=START + (TIME * 1e3).astype("m8[ms]"), gain=np.array([2.0]),
        image=np.zeros((90, 80)), grid=np.zeros((7, 3)), odd=np.array([{}, 1], dtype=object), z=np.ones(N, complex),
    )  # fmt: skip
    found = tables(tmp_path / "run.npz")
    assert {name: names(table) for name, table in found.items()} == {
        "": ["t", "span", "when", "M.1", "M.2", "rows.1"],
        "runs": ["t", "F"],
        "grid": ["grid.1", "grid.2", "grid.3"],
    }
    np.testing.assert_array_equal(found[""].column("M.2").values, PLACE)
    np.testing.assert_allclose(found[""].column("span").values, TIME, atol=1e-6)
    assert {column.units for column in found[""].columns} == {"", "s"}
    for said in (
        "'image' is an array of 90 × 80",
        "'odd' holds Python objects",
        "gain = 2.0",
        "'z' is an array of 100",
    ):
        assert said in remarks(found["runs"])


def test_an_array_file_holds_columns_records_or_a_sentence(tmp_path: Path) -> None:
    np.save(tmp_path / "records.npy", RECORDS)
    assert names(only(tmp_path / "records.npy")) == ["t", "F"]
    np.save(tmp_path / "wide.npy", np.stack([TIME, FORCE]))
    np.testing.assert_array_equal(only(tmp_path / "wide.npy").column("column 2").values, FORCE)
    np.save(tmp_path / "objects.npy", np.array([{}, 1], dtype=object))
    with pytest.raises(ImportDataError, match="holds Python objects, which can run code"):
        read_numpy(tmp_path / "objects.npy")


# MATLAB


def cell(*items: object) -> Array:
    made = np.empty(len(items), dtype=object)
    made[:] = items
    return made


def trial(rows: int, factor: float = 1) -> dict[str, Array]:
    return {"t": TIME[:rows], "F": factor * FORCE[:rows]}


def write_v5(path: Path) -> None:
    meta = {"operator": "x", "count": 3}
    savemat(path, {
        "exp": {"meta": meta, "trial": cell(trial(N), trial(50), trial(N, 2))},
        "cells": cell(trial(40), "hello"), "column": FORCE[:30, None], "row": PLACE[None, :30],
        "image": np.zeros((90, 80)), "letters": cell("a", "b"),
    })  # fmt: skip


def write_v73(path: Path) -> None:
    """As MATLAB lays a file of version 7.3 out: cells and arrays of structs are references into `#refs#`."""
    with h5py.File(path, "w", userblock_size=512) as file:
        hidden = file.create_group("#refs#")

        def put(group: h5py.Group, name: str, kind: str, data: object, **attributes: object) -> h5py.Dataset:
            dataset = group.create_dataset(name, data=np.asarray(data).T)
            dataset.attrs["MATLAB_class"] = np.bytes_(kind)
            dataset.attrs.update(attributes)
            return dataset

        def hide(kind: str, data: object) -> h5py.Reference:
            return put(hidden, f"r{len(hidden)}", kind, data).ref

        def struct(group: h5py.Group, name: str, fields: Mapping[str, Array] | None = None) -> h5py.Group:
            made = group.create_group(name)
            made.attrs["MATLAB_class"] = np.bytes_("struct")
            for field, values in (fields or {}).items():
                put(made, field, "double", values[:, None])
            return made

        def letters(text: str) -> Array:
            return np.array([[ord(letter) for letter in text]], dtype=np.uint16)

        experiment = struct(file, "exp")
        put(struct(experiment, "meta"), "count", "double", [[3.0]])
        put(experiment["meta"], "operator", "char", letters("x"))
        put(experiment["meta"], "made", "datetime", np.arange(6, dtype=np.uint32)[None], MATLAB_object_decode=3)
        trials = struct(experiment, "trial")
        for field in ("t", "F"):
            parts = [trial(N), trial(50), trial(N, 2)]
            references = [[hide("double", part[field][:, None])] for part in parts]
            trials.create_dataset(field, data=np.array(references, h5py.ref_dtype), dtype=h5py.ref_dtype)
        inside = struct(hidden, "s", trial(40)).ref
        cells = np.array([[inside], [hide("char", letters("hello"))]], h5py.ref_dtype)
        file.create_dataset("cells", data=cells, dtype=h5py.ref_dtype).attrs["MATLAB_class"] = np.bytes_("cell")
        put(file, "column", "double", FORCE[:30, None])
        put(file, "row", "double", PLACE[None, :30])
        put(file, "image", "uint8", np.zeros((90, 80), np.uint8))
        put(file, "nothing", "double", np.zeros(2, np.uint64), MATLAB_empty=1)
        put(file, "T", "table", np.arange(6, dtype=np.uint32)[None], MATLAB_object_decode=3)
        words = np.array([[hide("char", letters("a"))], [hide("char", letters("b"))]], h5py.ref_dtype)
        file.create_dataset("letters", data=words, dtype=h5py.ref_dtype).attrs["MATLAB_class"] = np.bytes_("cell")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(116) + bytes(8) + b"\x00\x02IM")


@pytest.mark.parametrize("write", [write_v5, write_v73])
def test_structs_and_cells_of_both_versions_are_tables(tmp_path: Path, write: Callable[[Path], None]) -> None:
    write(tmp_path / "run.mat")
    found = tables(tmp_path / "run.mat")
    shapes = {name: (table.rows, sorted(names(table))) for name, table in found.items()}
    assert shapes == {
        "": (30, ["column", "row"]),
        "letters": (2, ["letters"]),
        "exp.trial.1": (N, ["F", "t"]),
        "exp.trial.2": (50, ["F", "t"]),
        "exp.trial.3": (N, ["F", "t"]),
        "cells.1": (40, ["F", "t"]),
    }
    np.testing.assert_array_equal(found["exp.trial.3"].column("F").values, 2 * FORCE)
    np.testing.assert_array_equal(found[""].column("row").values, PLACE[:30])
    said = remarks(found["exp.trial.1"])
    for part in (
        "'image' is an array of 90 × 80",
        "cells.2 = 'hello'",
        "exp.meta.operator = 'x'",
        "exp.meta.count = 3",
    ):
        assert part in said
    if write is write_v73:
        assert "'T' is a MATLAB table, which only MATLAB opens; type writetable(T, \"T.csv\")" in said


def test_a_cell_with_a_row_of_names_is_a_table(tmp_path: Path) -> None:
    rows = np.empty((N + 1, 2), dtype=object)
    rows[0], rows[1:, 0], rows[1:, 1] = ("Time", "Force [N]"), TIME, FORCE
    savemat(tmp_path / "run.mat", {"read": rows})
    table = only(tmp_path / "run.mat")
    assert names(table) == ["Time", "Force [N]"]
    np.testing.assert_array_equal(table.column("Force").values, FORCE)


def test_records_and_version_4_are_read(tmp_path: Path) -> None:
    savemat(tmp_path / "records.mat", {"run": RECORDS})
    assert names(only(tmp_path / "records.mat")) == ["t", "F"]
    savemat(tmp_path / "old.mat", {"t": TIME, "F": FORCE, "M": np.c_[FORCE, PLACE]}, format="4")
    assert names(only(tmp_path / "old.mat")) == ["t", "F", "M.1", "M.2"]


def test_a_file_whose_cells_refer_to_themselves_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.mat"
    with h5py.File(path, "w") as file:
        loop = file.create_dataset("loop", (1, 2), h5py.ref_dtype)
        loop.attrs["MATLAB_class"] = np.bytes_("cell")
        loop[0, 0] = loop[0, 1] = loop.ref
    with pytest.raises(ImportDataError, match="'loop' refers to what is read already"):
        read_mat73(path)


# JSON

ORIENTS = ("split", "records", "index", "columns", "values", "table")
CELL = st.integers(-(10**6), 10**6).map(lambda number: number / 1000)


@st.composite
def frames(draw: st.DrawFn) -> pd.DataFrame:
    letters = st.characters(codec="utf-8", exclude_characters="\0")  # where pandas ends a name
    heads = draw(st.lists(st.text(letters, min_size=1, max_size=6), min_size=1, max_size=4, unique=True))
    rows = draw(st.integers(len(heads) + 1, 12))
    column = st.lists(st.one_of(CELL, st.just(float("nan"))), min_size=rows, max_size=rows)
    return pd.DataFrame({head: pd.Series(draw(column), dtype=float) for head in heads})


@settings(max_examples=examples(100), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=frames(), orient=st.sampled_from([*ORIENTS, "lines"]), index=st.sampled_from(["count", "stamps", "time"]))
def test_json_of_pandas_comes_back_in_every_orient(tmp_path: Path, data: pd.DataFrame, orient: str, index: str) -> None:
    if index == "stamps":
        data.index = pd.date_range("2026-05-04T09:15", periods=len(data), freq="10ms", tz="UTC")
    elif index == "time":
        data.index = pd.Index(np.arange(1, len(data) + 1) / 100)
    how = {"orient": "records", "lines": True} if orient == "lines" else {"orient": orient}
    path = tmp_path / "run.txt"
    path.write_text(data.to_json(date_format="iso", date_unit="us", double_precision=15, **how), "utf-8")
    table = only(path)
    for number, name in enumerate(data.columns, start=1):
        read = table.columns[number - 1 - len(data.columns)] if orient == "values" else None
        found = read or next(column for column in table.columns if column.name == name)
        np.testing.assert_array_equal(found.values, data[name].to_numpy())
    if index != "count" and orient not in {"records", "values", "lines"}:
        stamps = next(column for column in table.columns if column.name == "index")
        begin = 0.0 if index == "stamps" else 0.01
        np.testing.assert_allclose(stamps.values, begin + np.arange(len(data)) / 100, atol=1e-9)
        assert stamps.begins_at == (BEGIN.replace(tzinfo=UTC) if index == "stamps" else None)


def json_file(folder: Path, content: object) -> Path:
    path = folder / "run.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content), "utf-8")
    return path


def test_nested_records_vectors_and_integers_above_2_53_are_columns(tmp_path: Path) -> None:
    rows = [{"t": 2**60 + k, "load": {"N": k, "mV": None}, "xyz": [k, 1, 2], "text": f"{k},5"} for k in range(20)]
    table = only(json_file(tmp_path, {"run": rows}))
    assert names(table) == ["t", "load.N", "load.mV", "xyz.1", "xyz.2", "xyz.3", "text"]
    assert table.column("t").values[3] == float(2**60 + 3)
    assert np.isnan(table.column("load.mV").values).all()
    assert table.column("text").values.tolist() == [k + 0.5 for k in range(20)]


def test_several_tables_of_json_are_named(tmp_path: Path) -> None:
    table = pd.DataFrame({"t": TIME, "F": FORCE})
    content = {
        "operator": "x",
        "trials": [{"name": "a", **table.to_dict("list")}, {"name": "b", **table[:50].to_dict("list")}],
        "frame": json.loads(table.to_json(orient="split")),
        "records": table.to_dict("records"),
        "sensors": {"a": {"gain": 1, "zero": 2}, "b": {"gain": 3, "zero": 4}},
    }
    found = tables(json_file(tmp_path, content))
    assert {name: table.rows for name, table in found.items()} == {
        "trials.1": N,
        "trials.2": 50,
        "frame": N,
        "records": N,
    }
    assert "operator = 'x', trials.1.name = 'a', trials.2.name = 'b'" in remarks(found["frame"])


def test_a_name_that_occurs_twice_loses_nothing(tmp_path: Path) -> None:
    assert names(only(json_file(tmp_path, '{"F": [1, 2], "F": [3, 4]}'))) == ["F", "F (2)"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"F": 1}\n{"F": 2}\n{"F":', "line 3 is no JSON value"),
        ("[]", "columns without any rows"),
        ('{"gain": 2, "na\\nme": "x"}', r"no columns of numbers.*gain = 2, na\\nme = 'x'"),
        ("[" * 100_000, "is damaged or no JSON file"),
        ('{"F": [1, 2', "is damaged or no JSON file"),
    ],
)
def test_json_without_a_table_is_told(tmp_path: Path, content: str, message: str) -> None:
    with pytest.raises(ImportDataError, match=message) as raised:
        read_json(json_file(tmp_path, content))
    assert "\n" not in str(raised.value)


# What a file is


def zipped(name: str) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(name, "1,2")
    return buffer.getvalue()


def database(folder: Path) -> bytes:
    connection = sqlite3.connect(folder / "made.db")
    connection.execute("create table t (x)")
    connection.close()
    return (folder / "made.db").read_bytes()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (pickle.dumps({"F": FORCE}), "is a pickle, which can run code when it is opened; write it as Parquet"),
        ((FIELD / "31-html.xls").read_bytes(), "is an HTML page, as some instruments save under .xls"),
        ("<?xml version='1.0'?><Workbook xmlns='urn:schemas-microsoft-com:office:spreadsheet'>".encode("utf-16"),
         "is an XML spreadsheet; open it in a spreadsheet program"),
        (b"<?xml version='1.0'?><usi:tdm>", "the header of a DIAdem TDM file"),
        (zipped("a.csv"), "is a zip archive of a.csv; unpack it"),
        (b"PK\x03\x04", "is damaged or no complete file"),
        (b"7z\xbc\xaf\x27\x1c" + bytes(40), "is a packed archive; unpack it"),
        (b"%PDF-1.7\n", "is a document, not data"),
        (b"\x89PNG\r\n\x1a\n", "is a picture, not data"),
        (b"TDSh" + bytes(40), "is the index of a TDMS file"),
        (FORCE.tobytes(), "is of a binary kind that is not known"),
        (bytes(range(256)) * 9, "is of a binary kind that is not known"),
    ],
)  # fmt: skip
def test_what_is_not_read_is_named_whatever_it_is_called(tmp_path: Path, content: bytes, message: str) -> None:
    for ending in (".csv", ".mat", ".xls"):
        path = tmp_path / f"run{ending}"
        path.write_bytes(content)
        with pytest.raises(ImportDataError, match=message):
            read_foreign(path)


def test_databases_and_hdf5_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(database(tmp_path))
    with pytest.raises(ImportDataError, match="is a database; export its table"):
        file_kind(tmp_path / "a.csv")
    with h5py.File(tmp_path / "b.csv", "w") as file:
        file["x"] = PLACE
    with pytest.raises(ImportDataError, match="is an HDF5 file of another program; export it as CSV or MAT"):
        file_kind(tmp_path / "b.csv")
    with pytest.raises(ImportDataError, match="is a run file, which needs no import"):
        file_kind(CAMPAIGN / "010-drag.h5")


@pytest.mark.parametrize(
    "text",
    ["[Header]\n1,2\n", "[N];[mm]\n1;2\n", "PAR1,PAR2\n1,2\n", "MZ\tF\n1\t2\n", "{a}\n1\n", "<HEADER>\n1,2\n",
     "BZh9\n1\n", "µ\n1,2;3,4\n", "IM" * 100, "1,2\n3,4\n\0\0"],
)  # fmt: skip
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16", "utf-16-le"])
def test_text_is_no_other_kind(tmp_path: Path, text: str, encoding: str) -> None:
    path = tmp_path / "run.npy"
    path.write_bytes(text.encode(encoding))
    assert file_kind(path) is FileKind.TEXT


@pytest.mark.parametrize(
    ("name", "kind"),
    [("31-workbook.csv", FileKind.WORKBOOK), ("31-tab-text.xls", FileKind.TEXT), ("31-packed.csv.gz", FileKind.GZIP)],
)
def test_an_ending_tells_nothing(name: str, kind: FileKind) -> None:
    assert file_kind(FIELD / name) is kind
    (table,) = read_foreign(FIELD / name)
    assert (table.rows, table.column("Position").values[-1]) == (200, 5)


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress])
@pytest.mark.parametrize("name", ["21-lines.jsonl", "20-timestamps.parquet", "22-struct-array.mat", "31-tab-text.xls"])
def test_packed_files_are_read_as_what_is_in_them(
    tmp_path: Path, name: str, pack: Callable[[bytes], bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.csv.gz"
    content = (FIELD / name).read_bytes()
    path.write_bytes(pack(content))
    table, *_ = read_foreign(path)
    assert (table.path, table.rows) == (path, 200)
    for damaged, message in ((pack(content)[:-20], "is damaged or no"), (pack(pack(content)), "is packed twice")):
        path.write_bytes(damaged)
        with pytest.raises(ImportDataError, match=message) as raised:
            read_foreign(path)
        assert str(raised.value).startswith(f"{path}: ")
    path.write_bytes(pack(bytes(3 << 20)))
    monkeypatch.setattr(file_kinds, "MAX_UNPACKED_BYTES", 1 << 20)
    with pytest.raises(ImportDataError, match="GB is the limit"):
        read_foreign(path)
