"""Lab folders and their calibration history."""

import json
from datetime import UTC, datetime
from pathlib import Path

import pytest

from dragrig.cli import main
from dragrig.config.errors import OutputError, SettingsError
from dragrig.config.lab import data_root_of
from dragrig.config.rig import Calibration, RigSettings
from dragrig.config.settings import find_settings, read_settings_file, shipped_files
from dragrig.rig import calibration
from dragrig.rig.runfile import read_campaign
from dragrig.rig.runfile.campaigns import read_note
from dragrig.rig.runfile.schema import note_path
from dragrig.settings_form import rig_settings_form
from dragrig.setup import create_lab

pytestmark = pytest.mark.usefixtures("finished_here")


def entry(name: str, quantity: str = "force") -> Calibration:
    return Calibration(id=name, made_at=datetime(2024, 5, 1, tzinfo=UTC), quantity=quantity, gain=1000.0)


def test_init_makes_a_lab_whose_rig_is_the_shipped_one(tmp_path: Path) -> None:
    assert main(["init", str(tmp_path / "lab")]) == 0
    assert read_settings_file(RigSettings, tmp_path / "lab" / "rig.toml") == find_settings(RigSettings, "rig", "bench")
    assert (tmp_path / "lab" / "runs").is_dir()
    assert calibration.read_calibrations(tmp_path / "lab") == ()


def test_no_lab_is_made_in_a_lab(tmp_path: Path) -> None:
    create_lab(tmp_path / "lab")
    with pytest.raises(OutputError, match=r"lies in the lab .*lab; use that one"):
        create_lab(tmp_path / "lab" / "runs" / "another")
    assert list((tmp_path / "lab" / "runs").iterdir()) == []


@pytest.mark.parametrize("name", ["rig.toml", "notification.toml", "calibration.jsonl"])
def test_init_writes_over_nothing(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / name).write_text("mine", "utf-8")
    assert main(["init", str(tmp_path)]) == 2
    assert name in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text("utf-8") == "mine"


def test_a_file_in_place_of_the_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("", "utf-8")
    with pytest.raises(OutputError, match="taken"):
        create_lab(tmp_path / "taken")


def test_the_history_grows_and_the_last_entry_of_a_quantity_holds(tmp_path: Path) -> None:
    create_lab(tmp_path)
    for element in (entry("a"), entry("b"), entry("c", "encoder")):
        calibration.append_calibration(tmp_path, element)
    assert [read_calibration.id for read_calibration in calibration.read_calibrations(tmp_path)] == ["a", "b", "c"]
    latest = calibration.latest_calibration(tmp_path)
    assert latest is not None
    assert latest.id == "b"


def test_entries_of_the_history_are_never_changed(tmp_path: Path) -> None:
    create_lab(tmp_path)
    history = tmp_path / "calibration.jsonl"
    torn = entry("a").model_dump_json()
    history.write_text(torn, "utf-8")
    calibration.append_calibration(tmp_path, entry("b"))
    assert history.read_text("utf-8").startswith(torn + "\n")
    with pytest.raises(SettingsError, match="in the history already"):
        calibration.append_calibration(tmp_path, entry("a"))
    assert len(calibration.read_calibrations(tmp_path)) == 2


@pytest.mark.parametrize("line", ["{", "[]", json.dumps({"id": "x"}), '{"id": NaN}', "\xff"])
def test_a_line_that_is_no_calibration_is_named(tmp_path: Path, line: str) -> None:
    (tmp_path / "calibration.jsonl").write_bytes(entry("a").model_dump_json().encode() + b"\n" + line.encode("latin-1"))
    with pytest.raises(SettingsError, match=r"calibration\.jsonl"):
        calibration.read_calibrations(tmp_path)


def test_run_files_name_the_calibration_that_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    create_lab(tmp_path)
    calibration.append_calibration(tmp_path, entry("2024-05-a"))
    calibration.append_calibration(tmp_path, entry("2024-06-b"))
    monkeypatch.chdir(tmp_path / "runs")
    assert main(["run", "drag", "--yes", "--set", "travel_mm=10", "--set", "way_back=stay"]) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    (info,) = read_campaign(folder).runs
    assert info.header.entry["calibration_id"] == "2024-06-b"
    assert capsys.readouterr().out.strip() == folder.name


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"], ids=["plain", "marked"])
def test_a_lab_whose_texts_were_saved_by_an_editor_of_windows_is_read_like_any_other(
    mark: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    create_lab(tmp_path)
    calibration.append_calibration(tmp_path, entry("2024-05-a"))
    (tmp_path / "plan.toml").write_text(shipped_files("plan")["drag"].read_text("utf-8"), "utf-8")
    (tmp_path / "rig.toml").write_text('[data]\nroot = "elsewhere"\n', "utf-8")
    for path in [path for path in tmp_path.rglob("*") if path.is_file()]:
        path.write_bytes(mark + path.read_bytes().replace(b"\n", b"\r\n"))
    monkeypatch.chdir(tmp_path)
    assert data_root_of(tmp_path) == tmp_path / "elsewhere"
    assert [past.id for past in calibration.read_calibrations(tmp_path)] == ["2024-05-a"]
    assert main(["run", "plan.toml", "--yes", "--set", "travel_mm=10", "--set", "way_back=stay"]) == 0
    (run,) = (tmp_path / "elsewhere").glob("*/*.h5")
    note_path(run).write_bytes(mark + b"wet\r\n")
    assert read_note(run) == "wet"
    capsys.readouterr()
    assert main(["list"]) == 0
    assert run.parent.name in capsys.readouterr().out
    form = rig_settings_form(tmp_path / "rig.toml")
    values = form.values()
    (place,) = [(group, field) for group, texts in enumerate(values) for field in texts if texts[field] == "elsewhere"]
    values[place[0]][place[1]] = "runs"
    form.save(values)
    assert data_root_of(tmp_path) == tmp_path / "runs"
