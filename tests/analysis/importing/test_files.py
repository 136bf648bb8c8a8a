"""Foreign measurements become run files: real ones, every format, our own exports, and what is refused."""

import re
import shutil
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pytest
from nptdms import ChannelObject, TdmsWriter
from pyarrow import parquet
from scipy.io import savemat

from dragrig.analysis import ImportSettings, import_file, parse_map
from dragrig.analysis.export import CsvStyle, ExportFormat, export_run
from dragrig.analysis.importing.containers import read_numpy
from dragrig.analysis.measures import table_row
from dragrig.analysis.savgol import filter_file
from dragrig.config.errors import ImportDataError, OutputError
from dragrig.rig.runfile import read_run, verify
from dragrig.rig.runfile.model import Run
from places import DATA

GOUGE = ("time=Time", "force=Friction:1*1000", "position=Displ")
TIME = np.arange(400) / 200
FORCE, PLACE = 0.05 + 0.01 * np.sin(TIME), 3 + 5 * TIME


def imported(path: Path, folder: Path, *maps: str, **given: object) -> Run:
    settings = ImportSettings.model_validate({"columns": parse_map(maps), **given})
    return read_run(import_file(path, folder, settings).path)


def messages(run: Run) -> str:
    return "; ".join(event.message for event in run.events)


def test_rock_gouge_at_its_own_uneven_pace_needs_a_rate(tmp_path: Path) -> None:
    source = DATA / "foreign" / "velocity-steps" / "sepiolite.txt"
    with pytest.raises(ImportDataError, match="unevenly"):
        imported(source, tmp_path, *GOUGE)
    assert not list(tmp_path.glob("*.h5"))
    run = imported(source, tmp_path, *GOUGE, resample_hz=7)
    assert run.trace.sample_rate_hz == 7
    assert run.info.header.backend == "external"
    assert 400 < np.mean(run.trace.force) < 600
    assert run.trace.units["Friction"] == "1"
    np.testing.assert_allclose(run.trace.force, 1000 * run.trace.channels["Friction"], rtol=1e-12)
    assert run.trace.units["Effective_Normal_stress"] == "MPa"
    assert "stated factor" in messages(run)
    assert "the position is used in its place" in messages(run)
    assert (run.trace.phase == 2).all()
    assert run.trace.position[0] == 0
    assert 5 < float(run.info.header.entry["origin_mm"]) < 8
    np.testing.assert_array_equal(run.trace.command, run.trace.position)


def test_basalt_is_imported_stretch_by_stretch(tmp_path: Path) -> None:
    source = DATA / "foreign" / "velocity-steps" / "basalt.txt"
    slow = imported(source, tmp_path, *GOUGE, to_s=11674.0)
    quick = imported(source, tmp_path, *GOUGE, from_s=11674.2, order=1)
    assert slow.trace.sample_rate_hz == 10.0
    assert quick.trace.sample_rate_hz == 100.0
    assert len(slow.trace.time) + len(quick.trace.time) >= 995
    assert float(quick.info.header.entry["import_time_origin_s"]) == 11674.2


def test_a_motor_is_imported_filtered_tabulated_and_exported(tmp_path: Path) -> None:
    source = DATA / "foreign" / "cogging" / "speed_test.txt"
    maps = ("time=Time:s", "motor_force=Iq:A*1000", "position=Position:rad*5")
    with pytest.raises(ImportDataError, match="rows are off an even rate of 1000 Hz"):
        imported(source, tmp_path, *maps)
    run = imported(source, tmp_path, *maps, resample_hz=1000)
    assert run.trace.signal == "motor_force"
    assert run.trace.sample_rate_hz == 1000.0
    assert run.trace.units["Iq"] == "A"
    assert {"Velocity", "Reference_Velocity", "Function_Activated", "Position"} <= set(run.trace.channels)
    assert "lie between rows that are further apart" in messages(run)
    filter_file(run.info.path)
    filtered = read_run(run.info.path).filtered
    assert filtered is not None
    speed = filtered.channels["speed"] / 5
    per_half_turn = [np.mean(np.split(entry[:1500], 3), axis=1) for entry in (speed, run.trace.channels["Velocity"])]
    np.testing.assert_allclose(*per_half_turn, rtol=0.05)
    assert table_row(read_run(run.info.path)).steady_force_mN == pytest.approx(np.mean(run.trace.force[100:]), rel=0.05)
    assert export_run(run.info.path, tmp_path, ExportFormat.PARQUET).exists()
    assert verify(run.info.path).holds


@pytest.mark.parametrize("export_format", list(ExportFormat))
@pytest.mark.parametrize("filtered", [False, True])
def test_our_own_exports_come_back_as_the_runs_they_were(
    tmp_path: Path, export_format: ExportFormat, filtered: bool
) -> None:
    path = Path(shutil.copy(DATA / "campaign" / "010-drag.h5", tmp_path))
    if filtered:
        filter_file(path)
    before = read_run(path)
    exported = export_run(path, tmp_path, export_format, CsvStyle(",", ";"))
    after = read_run(import_file(exported, tmp_path / "back.h5").path)
    for name, values in before.trace.channels.items():
        assert after.trace.channels[name].dtype == values.dtype
        np.testing.assert_array_equal(after.trace.channels[name], values)
    np.testing.assert_array_equal(after.trace.time, before.trace.time)
    np.testing.assert_array_equal(after.trace.phase, before.trace.phase)
    old, new = before.info.header, after.info.header
    assert (new.run_id, new.start_time, new.order, new.kind) == (old.run_id, old.start_time, old.order, old.kind)
    assert dict(new.protocol) == dict(old.protocol)
    assert dict(new.specimen) == dict(old.specimen)
    assert after.info.status == before.info.status
    assert after.filtered is None


def test_an_export_whose_metadata_were_changed_is_refused(tmp_path: Path) -> None:
    exported = export_run(DATA / "campaign" / "014-drag.h5", tmp_path)
    exported.write_text(exported.read_text("utf-8").replace('"complete"', '"finished"'), "utf-8")
    with pytest.raises(ImportDataError, match="metadata of an export, which were changed"):
        import_file(exported, tmp_path)


def columns() -> dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
    return {"t_ms": 1e3 * TIME, "Load": FORCE, "Weg": PLACE}


def write_mat73(path: Path) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("test/run1")
        for name, values in columns().items():
            dataset = group.create_dataset(name, data=values.reshape(1, -1))
            dataset.attrs["MATLAB_class"] = np.bytes_("double")
        text = file.create_dataset("note", data=np.array([[ord(letter)] for letter in "hello"], dtype=np.uint16))
        text.attrs["MATLAB_class"] = np.bytes_("char")
        file.create_dataset("gain", data=np.array([[2.0]]))
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(116) + bytes(8) + b"\x00\x02IM")


def write_tdms(path: Path) -> None:
    with TdmsWriter(path) as writer:
        writer.write_segment([
            *(ChannelObject("test", name, values) for name, values in columns().items()),
            ChannelObject("other", "noise", np.zeros(7)),
        ])  # fmt: skip


def write_csv(path: Path) -> None:
    rows = zip(*(values.tolist() for values in columns().values()), strict=True)
    path.write_text("\n".join([",".join(columns()), *(",".join(map(repr, row)) for row in rows)]), "utf-8")


WRITERS = {
    "v5.mat": lambda path: savemat(path, {"test": {"run1": columns(), "gain": 2.0}, "other": np.zeros((3, 3))}),
    "v73.mat": write_mat73,
    "table.parquet": lambda path: parquet.write_table(pa.table({**columns(), "who": ["me"] * 400}), path),
    "table.tdms": write_tdms,
    "table.npz": lambda path: np.savez(path, allow_pickle=False, **columns()),
    "table.csv": write_csv,
}  # fmt: skip


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_gives_the_same_run(tmp_path: Path, name: str) -> None:
    source = tmp_path / name
    WRITERS[name](source)
    run = imported(
        source, tmp_path, "time=t", "force=Load:N", "position=Weg:mm", start_time=datetime(2026, 5, 4, tzinfo=UTC)
    )
    assert run.info.path.name == "20260504-000000-motion-000.h5"
    assert run.trace.sample_rate_hz == 200
    np.testing.assert_array_equal(run.trace.force, FORCE * 1e3)
    np.testing.assert_allclose(run.trace.position, PLACE - 3, atol=1e-12)
    np.testing.assert_allclose(run.trace.time, TIME, atol=1e-12)
    assert run.info.header.entry["origin_mm"] == 3


def test_a_signalling_nan_is_no_more_than_nan(tmp_path: Path) -> None:
    force = np.arange(4, dtype=np.float32)
    force.view(np.uint32)[2] = 0x7FA00000
    np.savez(tmp_path / "run.npz", time=np.arange(4.0), force=force)
    (table,) = read_numpy(tmp_path / "run.npz")
    values = table.column("force").values
    assert np.isnan(values).tolist() == [False, False, True, False]


@pytest.mark.parametrize("name", ["v5.mat", "v73.mat", "table.parquet", "table.tdms", "table.npz"])
def test_damaged_files_are_said(tmp_path: Path, name: str) -> None:
    source = tmp_path / name
    WRITERS[name](source)
    whole = source.read_bytes()
    for content in (whole[: len(whole) // 3], b"garbage" * 50):
        source.write_bytes(content)
        with pytest.raises(ImportDataError) as raised:
            imported(source, tmp_path, "time=t", "force=Load:N")
        assert str(source) in str(raised.value)
        assert "\n" not in str(raised.value)


def test_waveform_channels_bring_their_own_clock(tmp_path: Path) -> None:
    source = tmp_path / "wave.tdms"
    with TdmsWriter(source) as writer:
        properties = {"wf_increment": 0.004, "unit_string": "N"}
        writer.write_segment([ChannelObject("daq", "Load", FORCE, properties)])
    run = imported(source, tmp_path, "force=Load")
    assert run.trace.sample_rate_hz == 250
    np.testing.assert_array_equal(run.trace.force, FORCE * 1e3)
    assert np.isnan(run.trace.position).all()
    assert "position is missing" in messages(run)


def test_a_table_among_several_can_be_named(tmp_path: Path) -> None:
    source = tmp_path / "two.tdms"
    with TdmsWriter(source) as writer:
        writer.write_segment([ChannelObject("a", "F", FORCE), ChannelObject("b", "F", np.tile(FORCE, 2))])
    with pytest.raises(ImportDataError, match=r"holds 2 runs \(tables: 'a', 'b'\)"):
        imported(source, tmp_path, "force=F:N", sample_rate_hz=100)
    assert len(imported(source, tmp_path, "force=F:N", sample_rate_hz=100, table="a", order=1).trace.time) == 400
    with pytest.raises(ImportDataError, match="there is no table 'c'"):
        imported(source, tmp_path, "force=F:N", sample_rate_hz=100, table="c")


def csv(folder: Path, text: str) -> Path:
    path = folder / "in.csv"
    path.write_text(text, "utf-8")
    return path


def test_columns_that_say_what_they_are_need_no_map(tmp_path: Path) -> None:
    rows = "\n".join(f"{k * 10},{k},{k * 100},{k}" for k in range(50))
    run = read_run(import_file(csv(tmp_path, f"time_ms,Force [N],position (um),gain\n{rows}"), tmp_path).path)
    assert run.trace.sample_rate_hz == 100
    assert run.trace.force[3] == 3000
    assert run.trace.position[3] == pytest.approx(0.3)
    assert run.trace.channels["gain"][3] == 3


def test_what_is_not_mapped_is_kept_and_what_clashes_renamed(tmp_path: Path) -> None:
    rows = "\n".join(f"{k},{k},{2 * k},ok,{'' if k == 5 else k}" for k in range(50))
    source = csv(tmp_path, f"t (s),Load (mV),force,state,extra (V)\n{rows}")
    run = imported(source, tmp_path, "time=t", "force=Load:mV*2")
    assert set(run.trace.channels) == {"force", "position", "Load", "force_as_read", "extra"}
    assert run.trace.units["extra"] == "V"
    assert np.flatnonzero(np.isnan(run.trace.channels["extra"])).tolist() == [5]
    assert "column 'state' holds text and was left out" in messages(run)


def test_a_command_of_its_own_is_kept_beside_the_position(tmp_path: Path) -> None:
    rows = "\n".join(f"{k / 10},{k},{k + 0.5},{k}" for k in range(50))
    source = csv(tmp_path, f"t,x,c,F\n{rows}")
    run = imported(source, tmp_path, "time=t:s", "position=x:mm", "command=c:mm", "force=F:mN", kind="motion")
    assert run.info.kind == "motion"
    assert run.trace.command[0] == 0.5
    assert "stands for it" not in messages(run)


ROWS = "\n".join(f"{k / 10},{k},{k}" for k in range(50))
MAP = ("time=t:s", "force=F:mN", "position=x:mm")


@pytest.mark.parametrize(
    ("text", "maps", "options", "message"),
    [
        (f"t,x,F\n{ROWS}\n5.0,50,NaN\n5.1,51,51\n", MAP, {}, "in.csv: line 52, column 'F' has no number"),
        (f"t,x,F\n{ROWS}\n5.0,fifty,50\n", MAP, {}, "in.csv: line 52, column 'x' holds 'fifty'"),
        (f"t,x,F\n{ROWS}\n4.8,48,48\n", MAP, {}, "time goes back at line 52, from 4.9 s to 4.8 s"),
        (
            f"t,x,F\n{ROWS}",
            ("time=t:s",),
            {},
            "mapped to force or motor_force (force='F':N); the columns are",
        ),
        (f"t,x,F\n{ROWS}", ("force=F:mN",), {}, "no column is mapped to time (time='t':s, or the rate"),
        (f"t,x,F\n{ROWS}", ("position=x:mm",), {}, "force or motor_force (force='F':N) and none to time ("),
        (f"t,x,F\n{ROWS}\n5.0,50,1e300\n", MAP, {}, "line 52, column 'F' holds 1e+300, and 1e+09 mN is the most"),
        (f"t,x,F\n{ROWS}", ("time=t:s", "force=G:mN"), {}, "there is no column 'G'"),
        (f"t,x,F\n{ROWS}", ("time=t:s", "force=F"), {}, "column 'F' does not state its unit; state it"),
        (f"t,x,F\n{ROWS}", ("time=t:s", "force=F:mm"), {}, "in.csv: column 'F': force in mm needs a factor"),
        (f"t,x,F\n{ROWS}", MAP, {"from_s": 90}, "no rows from 90 to inf s; its time runs from 0 to 4.9 s"),
        (f"t,x,F\n{ROWS}", ("force=F:mN",), {"from_s": 1, "sample_rate_hz": 10}, "from_s and to_s need a time column"),
        (f"t,x,F\n{ROWS}", MAP, {"sample_rate_hz": 100}, "50 rows at 100 Hz span 0.49 s, their time stamps 4.9 s"),
        ("", MAP, {}, "is empty"),
    ],
)
def test_what_cannot_be_imported_is_said_in_one_sentence_and_leaves_nothing(
    tmp_path: Path, text: str, maps: tuple[str, ...], options: dict[str, object], message: str
) -> None:
    source = csv(tmp_path, text)
    with pytest.raises(ImportDataError, match=re.escape(message)) as raised:
        imported(source, tmp_path, *maps, **options)
    assert str(source) in str(raised.value)
    assert "\n" not in str(raised.value)
    assert [path.name for path in tmp_path.iterdir()] == ["in.csv"]


def test_a_file_that_is_not_there_is_said(tmp_path: Path) -> None:
    with pytest.raises(ImportDataError, match="no such file"):
        import_file(tmp_path / "none.csv", tmp_path)


def test_nothing_is_written_over(tmp_path: Path) -> None:
    source = csv(tmp_path, f"t,x,F\n{ROWS}")
    target = tmp_path / "there.h5"
    target.write_bytes(b"precious")
    with pytest.raises(OutputError, match="there is a file already"):
        imported(source, target, *MAP)
    assert target.read_bytes() == b"precious"
    with pytest.raises(OutputError, match=r"must end in \.h5"):
        imported(source, tmp_path / "nowhere", *MAP)


def test_a_kind_that_needs_its_parameters_says_so(tmp_path: Path) -> None:
    source = csv(tmp_path, f"t,x,F\n{ROWS}")
    with pytest.raises(ImportDataError, match="needs speed_mm_s, travel_mm, accel_mm_s2, rest_s, hold_s"):
        imported(source, tmp_path, *MAP, kind="drag")
    protocol = {"speed_mm_s": 10.0, "travel_mm": 49.0, "accel_mm_s2": 400.0, "rest_s": 0.0, "hold_s": 0.0}
    assert imported(source, tmp_path, *MAP, kind="drag", protocol=protocol).info.kind == "drag"
