"""What names on a command line stand for."""

import json
import os
from contextlib import suppress
from pathlib import Path

import pytest

import dragrig
from dragrig.cli import main
from dragrig.config.errors import RunFileError
from dragrig.run_inputs import newest_campaign, run_files
from dragrig.setup import create_lab
from property_tests import thorough


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "c1"
    folder.mkdir()
    for name in ("b-drag.h5", "a-blank.h5", "c-drag.recording.h5", "notes.txt", "d[1].h5"):
        (folder / name).touch()
    return folder


def names(*inputs: str | Path) -> list[str]:
    return [path.name for path in run_files(inputs)]


def test_a_folder_stands_for_its_finished_runs(runs: Path) -> None:
    assert names("c1") == ["a-blank.h5", "b-drag.h5", "d[1].h5"]


def test_patterns_are_expanded_here(runs: Path) -> None:
    assert names("c1/*-drag*.h5") == ["b-drag.h5"]
    assert names(str(runs / "*-blank.h5")) == ["a-blank.h5"]
    assert names("**/a-*.h5") == ["a-blank.h5"]


def test_a_name_with_brackets_is_a_file_first(runs: Path) -> None:
    assert names("c1/d[1].h5") == ["d[1].h5"]


def test_each_file_counts_once(runs: Path) -> None:
    assert names("c1/b-drag.h5", "c1", "c1/b-drag.h5") == ["b-drag.h5", "a-blank.h5", "d[1].h5"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("nowhere.h5", "there is no such file or folder"),
        ("c1/*-coulomb-*.h5", "no file matches"),
        (".", "did you mean c1?"),
    ],
)
def test_an_input_that_names_nothing_is_reported(runs: Path, name: str, words: str) -> None:
    with pytest.raises(RunFileError) as caught:
        run_files([name])
    assert words in str(caught.value)


def test_a_folder_with_only_a_recording_points_to_its_recovery(tmp_path: Path) -> None:
    (tmp_path / "20260301-090000-drag-000.recording.h5").touch()
    with pytest.raises(RunFileError, match=r"dragrig recover"):
        run_files([tmp_path])


@pytest.fixture(scope="module")
def two_campaigns(tmp_path_factory: pytest.TempPathFactory, finished_here: None) -> Path:
    """Return a lab with an older and a newer campaign of two short runs each, for the module's tests to read."""
    folder = tmp_path_factory.mktemp("lab")
    create_lab(folder)
    for name, time_s in (("older", 1_000_000), ("newer", 2_000_000)):
        for run in dragrig.simulate("drag", travel_mm=10, hold_s=0.5, out=folder / "runs" / name):
            os.utime(run.info.path, (time_s, time_s))
    return folder


@pytest.fixture
def lab(two_campaigns: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return it as the working folder."""
    monkeypatch.chdir(two_campaigns)
    return two_campaigns


@pytest.mark.parametrize("command", ["table", "info", thorough("report"), "show", "identify", thorough("gap diagnose")])
def test_a_command_without_a_folder_takes_the_newest_campaign_and_says_so(
    lab: Path, capfd: pytest.CaptureFixture[str], command: str
) -> None:
    with suppress(SystemExit):
        main([*command.split(), "--json"])
    printed = capfd.readouterr()
    assert f"{Path('runs', 'newer')} is the newest campaign:" in printed.err
    assert "older" not in printed.out


def test_a_lab_without_runs_is_told_instead(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RunFileError, match="there is no campaign in it yet"):
        newest_campaign()


def test_run_files_of_one_campaign_are_the_runs_of_it_that_count(lab: Path, capfd: pytest.CaptureFixture[str]) -> None:
    drag, back = sorted(map(str, (lab / "runs" / "older").glob("*.h5")))
    assert main(["table", drag, back, "--json"]) == 0
    assert len(json.loads(capfd.readouterr().out)["runs"]) == 2
    assert main(["table", drag, "--json"]) == 0
    (row,) = json.loads(capfd.readouterr().out)["runs"]
    assert row["file"] == Path(drag).name
    assert main(["identify", drag, back, "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["used"] == [Path(drag).name]
    other = next(map(str, (lab / "runs" / "newer").glob("*.h5")))
    for command in ("table", "identify"):
        assert main([command, drag, other]) == 2
        assert "run files may be named of one campaign alone" in capfd.readouterr().err
