"""What comes after a run: filtered traces, checksums, verdicts, campaigns, and other people's viewers."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import h5py
import numpy as np
import pytest
from nexusformat.nexus import nxload

import dragrig
from dragrig.analysis import filter_file
from dragrig.config.errors import OutputError, RunFileError
from dragrig.rig import mark_bad, store_filtered, unmark, write_run
from dragrig.rig.runfile import finish, read_campaign, read_mark, read_run, verify
from dragrig.rig.runfile.filesystem import lock_run
from dragrig.rig.runfile.model import FilteredTrace, RunEnding, RunEvent, RunStatus
from dragrig.rig.runfile.writer import rewrite
from runfiles import START, arrays, header, record

NXCHECK = "from nexusformat.scripts.nxcheck import main; main()"


@pytest.fixture
def run_file(tmp_path: Path) -> Path:
    return finish(record(tmp_path / "run.h5", 2000))


def filtered(path: Path, window_s: float) -> FilteredTrace:
    trace = read_run(path).trace
    smooth = trace.force.astype(np.float64)
    smooth[:3] = np.nan
    return FilteredTrace(
        trace.time, {"force": smooth, "speed": np.gradient(trace.position, trace.time)},
        {"window_s": window_s, "order": 3, "method": "savgol"}, {"speed": "mm/s"},
    )  # fmt: skip


def test_a_filtered_trace_is_stored_beside_the_raw_one(run_file: Path) -> None:
    raw, inode = read_run(run_file), run_file.stat().st_ino
    wanted = filtered(run_file, 0.1)
    store_filtered(run_file, wanted, [RunEvent(0.5, "short", "piece of 3 samples")])
    run = read_run(run_file)
    assert run_file.stat().st_ino != inode
    assert verify(run_file).holds
    assert run.info == raw.info
    np.testing.assert_array_equal(run.trace.force, raw.trace.force)
    assert run.filtered is not None
    assert run.filtered.parameters == {"window_s": 0.1, "order": 3, "method": "savgol"}
    assert run.filtered.units == {"force": "mN", "speed": "mm/s"}
    for name, column in wanted.channels.items():
        np.testing.assert_array_equal(run.filtered.channels[name], column)
    assert run.events == (*raw.events, RunEvent(0.5, "filter", "piece of 3 samples"))


def test_filtering_again_replaces_and_does_not_grow_the_file(run_file: Path) -> None:
    store_filtered(run_file, filtered(run_file, 0.1), [RunEvent(0.5, "filter", "first")])
    size = run_file.stat().st_size
    store_filtered(run_file, filtered(run_file, 0.2), [RunEvent(0.5, "filter", "second")])
    run = read_run(run_file)
    assert run.filtered is not None
    assert run.filtered.parameters["window_s"] == 0.2
    assert [event.message for event in run.events if event.kind == "filter"] == ["second"]
    assert run_file.stat().st_size <= size + 64


def test_links_that_lead_nowhere_stay_as_they_are(run_file: Path) -> None:
    with h5py.File(run_file, "r+") as file:
        file["mine"] = h5py.SoftLink("/entry/trace/force")
        file["gone"] = file["entry/gone"] = h5py.SoftLink("/entry/gone")
    store_filtered(run_file, filtered(run_file, 0.1))
    assert verify(run_file).holds
    with h5py.File(run_file) as file:
        links = [file.get(name, getlink=True) for name in ("mine", "gone", "entry/gone")]
    assert [link.path for link in links] == ["/entry/trace/force", "/entry/gone", "/entry/gone"]


def test_a_failing_edit_changes_nothing(run_file: Path) -> None:
    before = run_file.read_bytes()

    def fail(file: h5py.File) -> None:
        del file["entry/trace/force"]
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        rewrite(run_file, fail)
    assert run_file.read_bytes() == before
    assert [entry.name for entry in run_file.parent.iterdir()] == ["run.h5"]


def test_two_writers_of_one_run_do_not_meet(run_file: Path) -> None:
    with lock_run(run_file), pytest.raises(OutputError, match="another process"):
        store_filtered(run_file, filtered(run_file, 0.1))
    with pytest.raises(RunFileError, match="recover"):
        rewrite(record(run_file.with_name("other.h5"), 10), lambda file: None)


def test_many_writers_of_one_run_take_turns_and_leave_no_lock_behind(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from dragrig.rig.runfile.filesystem import BusyError, lock_run\n"
        "run, count, made = Path(sys.argv[1]), Path(sys.argv[2]), 0\n"
        "while made < 60:\n"
        "    try:\n"
        "        with lock_run(run):\n"
        "            number = int(count.read_text())\n"
        "            count.write_text(str(number + 1))\n"
        "            made += 1\n"
        "    except BusyError:\n"
        "        pass\n"
    )
    count = tmp_path / "count"
    count.write_text("0", "utf-8")
    arguments = [sys.executable, "-c", program, str(tmp_path / "run.h5"), str(count)]
    writers = [subprocess.Popen(arguments) for _ in range(3)]
    assert [writer.wait() for writer in writers] == [0, 0, 0]
    assert count.read_text("utf-8") == "180"
    assert list(tmp_path.iterdir()) == [count]


def test_no_folder_is_made_for_a_lock(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written to"), lock_run(tmp_path / "gone" / "run.h5"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_read_only_folder_is_reported(run_file: Path, close_folder: Callable[[Path], None]) -> None:
    close_folder(run_file.parent)
    with pytest.raises(OutputError, match="cannot be written to"):
        store_filtered(run_file, filtered(run_file, 0.1))


@pytest.mark.parametrize("name", ["time", "force", "position", "motor_force", "command", "phase"])
def test_a_changed_sample_breaks_the_checksum(run_file: Path, name: str) -> None:
    assert verify(run_file).holds
    with h5py.File(run_file, "r+") as file:
        dataset = file["entry/trace"][name]
        dataset[1999] = np.nextafter(dataset[1999], 1e9) if dataset.dtype.kind == "f" else 1
    result = verify(run_file)
    assert not result.holds
    assert result.stored != result.computed


def test_the_checksum_is_of_the_samples_not_of_the_file(tmp_path: Path, run_file: Path) -> None:
    at_once = write_run(tmp_path / "at-once.h5", header(), arrays(0, 2000))
    assert verify(at_once).stored == verify(run_file).stored


def test_a_mark_is_stored_beside_the_run(run_file: Path) -> None:
    before = run_file.read_bytes()
    assert read_mark(run_file) is None
    mark_bad(run_file, "  capsule slipped out ")
    mark = read_mark(run_file)
    assert mark is not None
    assert mark.reason == "capsule slipped out"
    assert run_file.read_bytes() == before
    assert read_campaign(run_file.parent).good == ()
    mark_bad(run_file, "gut torn")
    assert read_campaign(run_file.parent).marks[run_file].reason == "gut torn"
    assert unmark(run_file)
    assert not unmark(run_file)
    assert len(read_campaign(run_file.parent).good) == 1


def test_a_verdict_needs_a_run_and_a_reason(run_file: Path) -> None:
    with pytest.raises(RunFileError, match="no such run"):
        mark_bad(run_file.with_name("none.h5"), "bad")
    with pytest.raises(OutputError, match="reason"):
        mark_bad(run_file, "  ")
    run_file.with_name("run.mark.toml").write_text("bad = [", "utf-8")
    with pytest.raises(RunFileError, match=r"run\.mark\.toml"):
        read_mark(run_file)
    assert read_campaign(run_file.parent).runs == ()


def test_a_campaign_is_in_the_order_that_each_specimen_lived_through(tmp_path: Path) -> None:
    lived = [("b", 0, 1), ("a", 5, 2), ("a", 0, 0), ("a", 0, 1), ("b", 0, 0)]
    for number, (specimen, minutes, order) in enumerate(lived):
        made = replace(header(order, specimen=specimen), start_time=START + timedelta(minutes=minutes))
        write_run(tmp_path / f"{number}.h5", made, arrays(0, 10))
    renamed = replace(header(9), specimen={**header().specimen, "id": "aa"})
    write_run(tmp_path / "5.h5", renamed, arrays(0, 10))
    record(tmp_path / "6.h5", 10)
    shutil.copy(tmp_path / "0.h5", tmp_path / "notes.txt")
    campaign = read_campaign(tmp_path)
    assert [run.path.stem for run in campaign.runs] == ["2", "3", "1", "5", "4", "0"]
    assert [path.name for path in campaign.recordings] == ["6.recording.h5"]
    assert campaign.unreadable == ()
    with pytest.raises(RunFileError, match="no such folder"):
        read_campaign(tmp_path / "none")


# nexusformat 2.1 itself sets an array's shape, which NumPy 2.5 announces to end.
@pytest.mark.filterwarnings("ignore:Setting the shape:DeprecationWarning")
def test_a_nexus_reader_opens_the_file_with_force_against_time(run_file: Path) -> None:
    store_filtered(run_file, filtered(run_file, 0.1))
    root = nxload(str(run_file))
    plot = root.get_default()
    assert plot.nxpath == "/entry/trace"
    assert plot.nxsignal.nxname == "force"
    assert plot.nxsignal.attrs["units"] == "mN"
    (axis,) = plot.nxaxes
    assert axis.nxname == "time"
    assert axis.attrs["units"] == "s"
    wanted = arrays(0, 2000)
    np.testing.assert_array_equal(plot.nxsignal.nxdata, wanted["force"])
    np.testing.assert_array_equal(axis.nxdata, wanted["time"])
    assert root["entry/filtered"].nxsignal.nxname == "force"


def test_a_nexus_tool_finds_title_times_sample_and_the_time_axis(tmp_path: Path) -> None:
    (made, _) = dragrig.run("drag", out=tmp_path / "c", operator="Ada", assignments=["speed_mm_s=20"]).files
    filter_file(made)
    with h5py.File(made) as file:
        entry = file["entry"]
        assert all("NX_class" in group.attrs for group in entry.values() if isinstance(group, h5py.Group))
        assert entry["title"].asstr()[()] == "drag of jejunum"
        assert entry["start_time"].asstr()[()] == entry["run"].attrs["start_time"]
        assert entry["end_time"].asstr()[()] == entry["run"].attrs["end_time"]
        assert entry["user/name"].asstr()[()] == "Ada"
        assert entry["sample/name"].asstr()[()] == "jejunum"
        assert {"git_revision", "python", "numpy", "h5py"} <= set(entry["provenance"].attrs)
        assert list(entry["trace"].attrs["auxiliary_signals"]) == ["motor_force", "position"]
        for group in (entry["trace"], entry["filtered"]):
            assert all(group[name].dims[0][0] == group["time"] for name in group if name != "time")
            assert all("long_name" in column.attrs for column in group.values())
    assert verify(made).holds


def test_the_check_of_nexus_files_has_nothing_to_remark(tmp_path: Path) -> None:
    given_header = replace(
        header(), entry={**header().entry, "note": "wet"}, specimen={**header().specimen, "temperature_degC": 37.0}
    )
    ending = RunEnding(RunStatus.COMPLETE, "", START, {"rest_offset_mN": 1.5})
    made = write_run(tmp_path / "run.h5", given_header, arrays(0, 2000), ending=ending)
    store_filtered(made, filtered(made, 0.1), [RunEvent(0.2, "filter", "short")])
    said = subprocess.run([sys.executable, "-c", NXCHECK, str(made)], capture_output=True, text=True, check=True).stdout
    assert "Total number of warnings: 0" in said, said
    assert "Total number of errors: 0" in said, said
