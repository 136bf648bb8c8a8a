"""The commands that work on run files, on measured campaigns made by others and on runs of our own."""

import json
import shutil
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import dragrig
from dragrig.analysis.export import ExportSelection, export_content
from dragrig.cli import main
from dragrig.config.errors import AnalysisError
from dragrig.rig.runfile import read_mark, read_run
from places import copied_runs


class Command:
    """Calls a command in this process and reads what it prints."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def json(self, *words: str | Path, code: int = 0) -> Any:
        return json.loads(self(*words, "--json", code=code).out)

    def __call__(self, *words: str | Path, code: int = 0) -> Any:
        self._capsys.readouterr()
        got = main([str(word) for word in words])
        printed = self._capsys.readouterr()
        assert got == code, printed.err
        return printed


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Command:
    return Command(capsys)


@pytest.fixture
def practice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run of each kind."""
    monkeypatch.chdir(tmp_path)
    return copied_runs(tmp_path / "c", "001-relaxation.h5", "005-blank.h5", "008-coulomb.h5", "010-drag.h5")


def test_filter_stores_the_result_beside_the_raw_trace(command: Command, practice: Path) -> None:
    before = read_run(practice / "010-drag.h5").trace.force.copy()
    done = command.json("filter", "c", "--window-s", "0.1", "--order", "2")
    assert len(done) == len(list(practice.glob("*.h5")))
    run = dragrig.load(practice / "010-drag.h5")
    assert run.filtered is not None
    assert (run.filtered.parameters["order"], run.filtered.parameters["window_s"]) == (2, pytest.approx(0.1, rel=0.03))
    assert np.array_equal(run.trace.force, before)
    assert np.nanstd(np.diff(run.filtered.channels["force"])) < 0.2 * np.std(np.diff(before))


def test_info_says_what_is_inside_and_verifies_it(command: Command, practice: Path, finished_here: None) -> None:
    answer = command.json("info", "c")
    assert {row["kind"] for row in answer} == {"relaxation", "blank", "coulomb", "drag"}
    assert all(row["channels"]["force"] == "mN" for row in answer)
    alone = command("info", "c/010-drag.h5").out
    assert "travel 40 mm" in alone
    assert "uncertain" not in alone
    lines = command("info", "c").out.splitlines()
    assert [line.split()[0] for line in lines if line.startswith("c/")] == [row["file"] for row in answer]
    assert "dragrig info c/001-relaxation.h5 shows all of one." in lines
    (run,) = dragrig.simulate("blank", out=practice / "own", assignments=["speed_mm_s=40", "way_back=stay"])
    assert command.json("info", "c/own", "--verify")[0]["intact"] is True
    tampered = run.info.path
    tamper(tampered)
    printed = command("info", tampered, "--verify", code=2)
    assert tampered.name in printed.err


def test_a_session_that_made_no_run_is_counted_and_not_listed(
    command: Command, practice: Path, finished_here: None
) -> None:
    kept = practice.parent / "kept" / "session-1.toml"
    dragrig.simulate("blank", out=practice / "own", assignments=["way_back=stay"])
    kept.parent.mkdir()
    shutil.copy(next((practice / "own").glob("session-*.toml")), kept)
    assert command("list", ".").out.startswith("2 campaigns, and 1 without a run\n")
    assert {Path(row["folder"]).name for row in command.json("list", ".")} == {"c", "own", "kept"}
    assert "kept" not in command("list", ".").out


def tamper(path: Path) -> None:
    import h5py

    with h5py.File(path, "r+") as file:
        file["entry/trace/force"][10] += 1.0


def test_a_mark_is_honoured_by_everything_later_and_can_be_taken_back(command: Command, practice: Path) -> None:
    drag = practice / "010-drag.h5"
    command("mark", "c/010-drag.h5", "--bad", "capsule slipped off")
    mark = read_mark(drag)
    assert mark is not None
    assert mark.reason == "capsule slipped off"
    assert command.json("info", drag)[0]["bad"] == "capsule slipped off"
    row = next(row for row in command.json("table", "c")["runs"] if row["file"] == drag.name)
    assert (row["bad"], row["mark"]) == (True, "capsule slipped off")
    assert "marked bad: capsule slipped off" in command("table", "c").out
    filtered = command("filter", "c")
    assert "left out, marked bad: capsule slipped off" in filtered.err
    assert drag.name not in filtered.out
    assert drag.name in command("filter", drag).out
    assert drag.name not in [Path(row["run"]).name for row in command.json("export", "c", "--out", "x")]
    command("mark", "c", "--good")
    assert read_mark(drag) is None


def test_a_note_stays_beside_the_run_until_it_is_emptied(command: Command, practice: Path) -> None:
    drag = practice / "010-drag.h5"
    command("mark", "c/010-drag.h5", "--note", "wall looked dry")
    command("mark", "c/010-drag.h5", "--bad", "slipped")
    assert "noted" in command("info", drag).out
    assert (command.json("info", drag)[0]["noted"], command.json("info", drag)[0]["bad"]) == (
        "wall looked dry",
        "slipped",
    )
    command("mark", "c/010-drag.h5", "--good", "--note", "")
    assert [path.name for path in practice.iterdir() if path.suffix in {".txt", ".toml"}] == []


def test_nothing_is_marked_when_one_of_the_names_is_no_run(command: Command, practice: Path) -> None:
    (practice / "broken.h5").write_bytes(b"x")
    assert "broken.h5" in command("mark", "c", "--bad", "no", code=2).err
    assert list(practice.glob("*.toml")) == []


def test_table_gives_the_same_numbers_to_people_and_programs(command: Command, practice: Path) -> None:
    answer = command.json("table", "c")
    steady = {row["file"]: row for row in answer["runs"]}["010-drag.h5"]
    assert steady["steady_force_mN"] > 5 * steady["steady_force_error_mN"] > 0
    shown = command("table", "c").out
    assert f"{steady['steady_force_mN']:.2f} ± {steady['steady_force_error_mN']:.2f}" in shown
    frame = dragrig.table(practice)
    assert frame.set_index("file").loc["010-drag.h5", "steady_force_mN"] == pytest.approx(steady["steady_force_mN"])


@pytest.mark.parametrize("form", ["csv", "parquet", "mat", "npz"])
def test_export_writes_every_form_and_writes_nothing_over(command: Command, practice: Path, form: str) -> None:
    words = ("export", "c/010-drag.h5", "--format", form, "--out", "x")
    (done,) = command.json(*words)
    written = Path(done["file"])
    assert written == Path("x") / f"010-drag.{form}"
    before = written.read_bytes()
    assert "exists already" in command(*words, code=2).err
    assert written.read_bytes() == before
    command(*words, "--overwrite")


def test_a_spreadsheet_of_another_country_reads_the_export(command: Command, practice: Path) -> None:
    command("export", "c/010-drag.h5", "--decimal", ",", "--delimiter", ";", "--out", "x")
    frame = pd.read_csv("x/010-drag.csv", sep=";", decimal=",", comment="#")
    force = next(frame[name] for name in frame if name.startswith("force"))
    assert np.allclose(force, read_run(practice / "010-drag.h5").trace.force, atol=1e-3)


def test_one_bad_file_does_not_keep_the_others_from_being_done(command: Command, practice: Path) -> None:
    (practice / "000-broken.h5").write_bytes(b"not HDF5")
    good = len(list(practice.glob("*.h5"))) - 1
    printed = command("export", "c", "--out", "x", "--format", "npz", code=2)
    assert "000-broken.h5" in printed.err
    assert len(list(Path("x").glob("*.npz"))) == good


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("export", "c", "--format", "npz", "--decimal", ","), "--format csv alone"),
        (("export", "c", "--decimal", ";"), "decimal mark"),
        (("export", "c", "--decimal", ",", "--delimiter", ","), "choose ; as the delimiter"),
        (("export", "c/010-drag.h5", "--out", "taken"), "taken"),
        (("filter", "c/010-drag.h5", "--window-samples", "10"), "odd number"),
        (("filter", "c/010-drag.h5", "--window-s", "nan"), "window"),
        (("filter", "c/010-drag.h5", "--window-s", "1e9"), "window"),
        (("filter", "c/010-drag.h5", "--window-s", "1", "--window-samples", "9"), "give one of the two"),
        (("filter", "c/010-drag.h5", "--order", "99"), "order"),
        (("filter", "c/010-drag.h5", "--window-s", "abc"), "--window-s"),
        (("mark", "c/010-drag.h5"), "bad, with a reason, or good"),
        (("mark", "c/010-drag.h5", "--bad", " "), "reason"),
        (("table", "nowhere"), "nowhere"),
        (("recover", "nowhere"), "nowhere"),
        (("info", "nowhere"), "nowhere"),
        (("filter", "c/*.txt"), "pattern"),
        (("table", "empty"), "holds no run files"),
        (("show", "c/010-drag.h5", "--out", "x.gif"), "x.gif: pictures are written as .png, .svg, .pdf"),
    ],
)
def test_what_is_not_possible_is_reported_in_one_sentence(
    command: Command, practice: Path, words: tuple[str, ...], sentence: str
) -> None:
    (practice.parent / "taken").write_text("mine", "utf-8")
    (practice.parent / "empty").mkdir()
    before = {path: path.read_bytes() for path in practice.parent.rglob("*") if path.is_file()}
    printed = command(*words, code=2)
    assert sentence in printed.err
    assert printed.err.count("\n") == 1, printed.err
    assert {path: path.read_bytes() for path in practice.parent.rglob("*") if path.is_file()} == before


def test_recover_finishes_what_a_crash_left(command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert "nothing to recover" in command("recover").err
    (tmp_path / "x.recording.h5").write_bytes(b"not HDF5")
    printed = command("recover", "--json", code=2)
    assert json.loads(printed.out)[0]["outcome"] == "left"
    assert "x.recording.h5" in printed.err
    assert (tmp_path / "x.recording.h5").read_bytes() == b"not HDF5"


def test_a_reader_that_leaves_keeps_no_file_from_being_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, practice: Path
) -> None:
    def closed(text: str) -> None:
        raise BrokenPipeError(32, f"nobody reads {text!r}")

    monkeypatch.setattr("dragrig.cli.run_file_commands.echo", closed)
    main(["export", str(practice), "--out", str(tmp_path / "csv"), "-q"])
    assert len(list((tmp_path / "csv").iterdir())) == len(list(practice.glob("*.h5"))) > 1


def test_an_export_of_chosen_columns_filtered_and_averaged(command: Command, practice: Path) -> None:
    run = sorted(practice.glob("*.h5"))[0]
    command("filter", str(run))
    command("export", str(run), "--columns", "force_filtered,position", "--filtered-only", "--every", "10", "-o", "e")
    table = pd.read_csv(next(Path("e").iterdir()), comment="#")
    whole = read_run(run)
    assert list(table.columns) == ["time_s", "force_filtered_mN", "position_mm"]
    assert len(table) == -(-len(whole.trace.time) // 10)
    assert whole.filtered is not None
    assert table["force_filtered_mN"][3] == pytest.approx(whole.filtered.channels["force"][30:40].mean())
    with pytest.raises(AnalysisError, match="did you mean force_mN"):
        ExportSelection(("forze",)).applied_to(export_content(whole), run)


def test_campaigns_are_listed_and_their_runs_found(command: Command, practice: Path) -> None:
    shutil.copytree(practice, Path("below") / "d")
    first = sorted(practice.glob("*.h5"))[0]
    command("mark", str(first), "--bad", "slipped")
    listed = json.loads(command("list", "--json", ".").out)
    runs = dragrig.campaign(practice).runs
    assert [Path(entry["folder"]).name for entry in listed] == ["d", "c"]
    assert [sum(entry["kinds"].values()) for entry in listed] == [len(runs), len(runs)]
    assert [entry["bad"] for entry in listed] == [0, 1]
    kind, began = runs[0].kind, runs[-1].header.start_time

    def found(*words: str) -> set[str]:
        return {Path(line).name for line in command("find", "c", "-q", *words).out.splitlines()}

    assert found() == {run.path.name for run in runs}
    assert found("--kind", kind) == {run.path.name for run in runs if run.kind == kind}
    assert found("--bad") == {first.name}
    assert found("--good") == found() - {first.name}
    assert found("--since", began.isoformat()) == {r.path.name for r in runs if r.header.start_time >= began}
    last_day = max(run.header.start_time for run in runs).astimezone().date()
    assert found("--until", last_day.isoformat()) == found(), "the day named is one of those wanted"
    assert found("--until", (last_day - timedelta(days=4000)).isoformat()) == set()
    assert found("--date", last_day.isoformat()) == {
        run.path.name for run in runs if run.header.start_time.astimezone().date() == last_day
    }
    assert main(["find", "c", "--date", last_day.isoformat(), "--since", began.isoformat()]) == 2
    assert found("--specimen", "nobody") == set()
