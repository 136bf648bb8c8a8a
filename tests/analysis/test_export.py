"""Exports: what is written can be read back by others, exactly."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nptdms import TdmsFile
from pyarrow import parquet
from scipy.io import loadmat

from dragrig.analysis.export import (
    CsvStyle,
    ExportFormat,
    ExportSelection,
    column_name,
    export_campaign,
    export_content,
    export_run,
    write_export,
)
from dragrig.analysis.savgol import filter_file
from dragrig.config.errors import AnalysisError, OutputError, RunFileError
from dragrig.rig import mark_bad
from dragrig.rig.runfile import finish, read_run
from ending import was_killed
from places import CAMPAIGN
from runfiles import record

COLUMNS = ["time_s", "force_mN", "force_filtered_mN", "speed_mm_s", "position_mm", "command_mm", "phase"]


@pytest.fixture
def filtered(tmp_path: Path) -> Path:
    path = Path(shutil.copy(CAMPAIGN / "014-drag.h5", tmp_path))
    filter_file(path)
    return path


@pytest.mark.parametrize(
    ("decimal", "delimiter"), [(".", ""), (",", ""), (".", ";"), (",", "\t"), (".", "|"), (",", " ")]
)
def test_csv_is_read_back_exactly_in_every_style(filtered: Path, decimal: str, delimiter: str) -> None:
    style = CsvStyle(decimal, delimiter)
    written = export_run(filtered, filtered.parent, ExportFormat.CSV, style)
    assert written == filtered.with_suffix(".csv")
    names, *rows = [line.split(style.delimiter) for line in written.read_text("utf-8").splitlines() if line[0] != "#"]
    assert names == COLUMNS
    numbers = np.array([[float(cell.replace(decimal, ".")) for cell in row] for row in rows]).T
    frame = dict(zip(names, numbers, strict=True))
    run = read_run(filtered)
    assert run.filtered is not None
    np.testing.assert_array_equal(frame["time_s"], run.trace.time)
    np.testing.assert_array_equal(frame["force_mN"].astype(np.float32), run.trace.force)
    np.testing.assert_array_equal(frame["speed_mm_s"], run.filtered.channels["speed"])
    np.testing.assert_array_equal(frame["phase"], run.trace.phase)


def test_means_have_no_digits_of_rounding(filtered: Path) -> None:
    """The mean of ten times at a kilohertz is 0.0045, not 0.0045000000000000005."""
    run = read_run(filtered)
    times = np.arange(len(run.trace.time)) / 1000
    target = filtered.with_name("means.csv")
    content = replace(run, trace=replace(run.trace, time=times, sample_rate_hz=1000.0))
    write_export(content, target, ExportFormat.CSV, selection=ExportSelection(every=10))
    rows = [line.split(",") for line in target.read_text("utf-8").splitlines() if line[0] != "#"][1:]
    whole = len(times) // 10
    assert [row[0] for row in rows[:whole]] == [repr(round(0.0045 + 0.01 * at, 4)) for at in range(whole)]
    force = run.trace.force[: 10 * whole].astype(np.float64).reshape(-1, 10).mean(axis=1)
    np.testing.assert_array_equal(np.array([row[1] for row in rows[:whole]], np.float32), force.astype(np.float32))


def test_csv_says_first_what_the_run_is(filtered: Path) -> None:
    lines = export_run(filtered, filtered.parent).read_text("utf-8").splitlines()
    text = dict(line.removeprefix("# ").split(": ", 1) for line in lines if line.startswith("# "))
    assert json.loads(text["dragrig-export"]) == 1
    assert json.loads(text["kind"]) == "drag"
    assert json.loads(text["protocol"])["speed_mm_s"] == 60.0
    assert json.loads(text["filter"])["window_s"] == 0.05
    assert json.loads(text["columns"])["force_filtered_mN"] == ["filtered/force", "mN", "float64"]


def test_missing_values_are_empty_cells(filtered: Path) -> None:
    run = read_run(filtered)
    force = np.array(run.trace.force)
    force[3] = np.nan
    run = replace(run, trace=replace(run.trace, channels={**run.trace.channels, "force": force}))
    target = filtered.with_name("holes.csv")
    write_export(run, target, ExportFormat.CSV)
    lines = [line for line in target.read_text("utf-8").splitlines() if not line.startswith("#")]
    assert lines[4].split(",")[1] == ""


def test_parquet_carries_units_and_metadata(filtered: Path) -> None:
    written = export_run(filtered, filtered.parent, ExportFormat.PARQUET)
    table = parquet.read_table(written)
    run = read_run(filtered)
    assert table.column_names == COLUMNS
    np.testing.assert_array_equal(table["force_mN"].to_numpy(), run.trace.force)
    assert table.schema.field("position_mm").metadata[b"units"] == b"mm"
    assert json.loads(table.schema.metadata[b"dragrig"])["run_id"] == run.info.header.run_id


def test_mat_holds_one_struct(filtered: Path) -> None:
    written = export_run(filtered, filtered.parent, ExportFormat.MAT)
    run = read_run(filtered)
    held = loadmat(written, squeeze_me=True, struct_as_record=False)["run"]
    np.testing.assert_array_equal(held.force_mN, run.trace.force)
    np.testing.assert_array_equal(held.time_s, run.trace.time)
    assert held.metadata.protocol.speed_mm_s == 60
    assert held.metadata.specimen.name == "jejunum"
    assert held.metadata.kind == "drag"


def test_npz_holds_arrays_and_json(filtered: Path) -> None:
    written = export_run(filtered, filtered.parent, ExportFormat.NPZ)
    run = read_run(filtered)
    with np.load(written, allow_pickle=False) as held:
        np.testing.assert_array_equal(held["force_mN"], run.trace.force)
        assert json.loads(str(held["metadata"]))["order"] == 14
        assert set(held) == {*COLUMNS, "metadata"}


def test_tdms_has_a_channel_with_its_unit_for_each_column(filtered: Path) -> None:
    written = export_run(filtered, filtered.parent, ExportFormat.TDMS)
    run, held = read_run(filtered), TdmsFile.read(written)
    assert [channel.name for channel in held["run"].channels()] == COLUMNS
    assert held["run"]["force_mN"].properties["unit_string"] == "mN"
    np.testing.assert_array_equal(held["run"]["force_mN"][:], run.trace.force)
    assert json.loads(held.properties["dragrig"])["run_id"] == run.info.header.run_id


def test_an_unfiltered_run_is_exported_without_filtered_columns(tmp_path: Path) -> None:
    content = export_content(read_run(CAMPAIGN / "014-drag.h5"))
    assert [column.name for column in content.columns] == ["time_s", "force_mN", "position_mm", "command_mm", "phase"]
    assert content.metadata["filter"] == {}


def test_units_make_names_that_any_program_takes() -> None:
    assert column_name("speed", "mm/s") == "speed_mm_s"
    assert column_name("force", "mN/s^1") == "force_mN_s_1"
    assert column_name("Load (N)", "µm") == "Load_N_um"
    assert column_name("flag", "") == "flag"


@pytest.mark.parametrize("export_format", list(ExportFormat))
def test_nothing_is_written_over_unless_told(filtered: Path, export_format: ExportFormat) -> None:
    target = filtered.with_name("mine")
    target.write_text("mine", "utf-8")
    with pytest.raises(OutputError, match="exists already"):
        export_run(filtered, target, export_format)
    assert target.read_text("utf-8") == "mine"
    export_run(filtered, target, export_format, overwrite=True)
    assert target.stat().st_size > 10_000
    assert [path.name for path in filtered.parent.iterdir() if path.suffix == ".part"] == []


def test_the_run_file_itself_is_never_written_over(filtered: Path) -> None:
    with pytest.raises(OutputError, match="the run file itself"):
        export_run(filtered, filtered, overwrite=True)
    assert read_run(filtered).info.kind == "drag"


def test_a_failing_export_leaves_what_was_there(filtered: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = filtered.with_name("old.csv")
    target.write_text("old", "utf-8")

    def full(_done: int, _of: int) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OutputError, match=r"old\.csv: could not be written \(No space left on device\)"):
        export_run(filtered, target, overwrite=True, progress=full)
    assert target.read_text("utf-8") == "old"
    assert not list(filtered.parent.glob("*.part"))


def test_an_export_that_is_killed_leaves_nothing_that_stays(tmp_path: Path) -> None:
    run = finish(record(tmp_path / "long.h5", 300_000))
    command = [sys.executable, "-m", "dragrig", "export", run.name]
    heard = () if sys.platform == "win32" else (signal.SIGINT, signal.SIGTERM)  # which kill there
    for number in (*heard, None):
        with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE) as exporting:
            while not list(tmp_path.glob(".long.csv.*.part")):
                assert exporting.poll() is None
                time.sleep(0.002)
            exporting.kill() if number is None else exporting.send_signal(number)
            _, errors = exporting.communicate()
        assert b"Traceback" not in errors
        assert was_killed(exporting.returncode) if number is None else exporting.returncode == 3
        assert len(list(tmp_path.glob("*.part"))) == (number is None)
        assert not (tmp_path / "long.csv").exists()
    # The next export into the folder removes what is left, once it can be nobody's; nobody's else.
    (part,) = tmp_path.glob("*.part")
    (tmp_path / ".own.part").write_text("mine")
    short, own = finish(record(tmp_path / "short.h5", 1000)), tmp_path / ".own.part"
    for age_s, stays in ((30.0, True), (3600.0, False)):
        for path in (part, own):
            os.utime(path, (time.time() - age_s,) * 2)
        export_run(short, tmp_path / "other.csv", overwrite=True)
        assert part.exists() is stays
    assert sorted(path.name for path in tmp_path.iterdir()) == [own.name, "long.h5", "other.csv", "short.h5"]


@pytest.mark.parametrize(("decimal", "delimiter"), [(",", ","), (".", "."), (";", ","), (".", "x"), (".", "1")])
def test_styles_that_cannot_be_read_back_are_refused(decimal: str, delimiter: str) -> None:
    with pytest.raises(AnalysisError):
        CsvStyle(decimal, delimiter)


def test_a_campaign_is_exported_whole_without_its_bad_runs(tmp_path: Path) -> None:
    campaign, out = tmp_path / "campaign", tmp_path / "out" / "here"
    shutil.copytree(CAMPAIGN, campaign)
    mark_bad(campaign / "008-coulomb.h5", "the pump had stopped")
    (campaign / "005-blank.h5").write_bytes(b"nothing")
    done = export_campaign(campaign, out, ExportFormat.PARQUET)
    assert len(done) == 6
    assert sorted(path.name for path in out.iterdir()) == sorted(path.name for path in done)
    assert not {"008-coulomb", "005-blank"} & {path.stem for path in done}
    with pytest.raises(OutputError, match="exists already"):
        export_campaign(campaign, out, ExportFormat.PARQUET)
    assert len(export_campaign(campaign, out, ExportFormat.PARQUET, overwrite=True)) == 6


def test_places_that_cannot_be_are_said(filtered: Path, tmp_path: Path) -> None:
    with pytest.raises(RunFileError, match="no such file"):
        export_run(tmp_path / "no.h5", tmp_path)
    with pytest.raises(OutputError, match="could not be written"):
        export_run(filtered, tmp_path / "no" / "folder.csv")


def test_a_folder_that_takes_no_files_is_said(
    filtered: Path, tmp_path: Path, close_folder: Callable[[Path], None]
) -> None:
    closed = tmp_path / "closed"
    closed.mkdir()
    close_folder(closed)
    with pytest.raises(OutputError, match="could not be written"):
        export_run(filtered, closed)
