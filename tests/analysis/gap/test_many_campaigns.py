"""Several campaigns given to one command: side by side, in their order, each as it is by itself."""

import json
import shutil
from pathlib import Path

import pytest

import dragrig
from dragrig.cli import main
from dragrig.sim_backend.effects import catalogue
from places import CAMPAIGN
from property_tests import thorough

WITHOUT = tuple(name for name in catalogue() if name != "stribeck")
OF_ONE_EFFECT = [word for name in WITHOUT for word in ("--without", name)]


@pytest.fixture
def three(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with two campaigns of few runs, the second without a relaxation, and one empty folder."""
    for name, runs in (
        ("first", ("001-relaxation", "010-drag")),
        ("second", ("008-coulomb", "014-drag")),
    ):
        (tmp_path / name).mkdir()
        for run in runs:
            shutil.copy(CAMPAIGN / f"{run}.h5", tmp_path / name)
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def lines(capsys: pytest.CaptureFixture[str]) -> list[dict[str, object]]:
    answer = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    for entry in answer:
        entry.pop("timings_s", None)
    return answer


@pytest.mark.parametrize("workers", ["1", thorough("2")])
def test_diagnoses_are_those_of_each_campaign_by_itself_whoever_makes_them(
    workers: str, three: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["gap", "diagnose", "first", "empty", "second", "--json", "--quiet", *OF_ONE_EFFECT]
    assert main([*arguments, "--workers", workers]) == 2
    answer = lines(capsys)
    assert [row["source"] for row in answer] == ["first", "empty", "second"]
    assert "no run file" in str(answer[1]["error"])
    assert main(["gap", "diagnose", "second", "--json", "--quiet", *OF_ONE_EFFECT]) == 0
    alone = json.loads(capsys.readouterr().out)
    del alone["timings_s"]
    assert {"source": "second", **alone} == answer[2]


def test_what_cannot_be_diagnosed_is_told_and_the_others_go_on(three: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gap", "diagnose", "first", "empty", "--workers", "1", *OF_ONE_EFFECT]) == 2
    output = capsys.readouterr()
    assert "no gap" in output.out
    assert "not diagnosed: empty: holds no run file" in output.out
    assert "1 of 2 campaigns were not diagnosed: empty" in output.err


@pytest.mark.parametrize("option", ["--report", "--save-model"])
def test_a_file_for_one_campaign_is_not_made_of_several(
    option: str, three: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["gap", "diagnose", "first", "second", option, "mine"]) == 2
    assert "takes a single campaign, not 2" in capsys.readouterr().err


@pytest.mark.parametrize("workers", ["1", thorough("2")])
def test_identifications_are_those_of_each_campaign_by_itself(
    workers: str, three: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["identify", "first", "empty", "second", "--quiet"]
    assert main([*arguments, "--json", "--workers", workers]) == 2
    answer = lines(capsys)
    assert [row["source"] for row in answer] == ["first", "empty", "second"]
    assert "no run file" in str(answer[1]["error"])
    assert main(["identify", "second", "--json", "--quiet"]) == 0
    assert {"source": "second", **json.loads(capsys.readouterr().out)} == answer[2]
    assert not (three / "first" / "identified").exists()


def test_identifying_several_writes_each_its_own_files(three: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(three / "first")
    (three / "second" / "014-drag.h5").unlink()
    shutil.copytree(three / "second", three / "first")
    (three / "other").mkdir()
    (three / "second").rename(three / "other" / "first")
    arguments = ["identify", "first", "other/first", "--quiet", "--out", "made", "--workers", "1"]
    assert main(arguments) == 0
    output = capsys.readouterr().out
    assert "wall stiffness" in output
    assert (three / "made" / "first" / "model.toml").is_file()
    assert (three / "made" / "first-2" / "joint-fit.png").is_file()
    assert main(["identify", "first", "other/first", "--save-model", "x.toml"]) == 2
    assert "takes a single campaign" in capsys.readouterr().err
    assert main(["identify", "first", "--scheduler", "tcp://127.0.0.1:1"]) == 2
    assert "one was given; leave it out" in capsys.readouterr().err


def test_a_calibration_that_is_named_is_used_for_all(three: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (three / "learnt.json").write_text("{}", "utf-8")
    arguments = ["gap", "diagnose", "first", "second", "--calibration", "learnt.json", "--workers", "1"]
    assert main(arguments) == 2
    assert "calibration learnt.json: is not what" in capsys.readouterr().err


def test_python_gives_the_same(three: Path) -> None:
    heard: list[tuple[int, int]] = []
    diagnose_many = dragrig.gap_diagnose_many(
        ["first", three / "empty"], workers=1, progress=lambda *now: heard.append(now), without=WITHOUT
    )
    assert diagnose_many[0].result is not None
    assert diagnose_many[0].result.verdict == "no_gap"
    assert diagnose_many[0].run_ids
    assert diagnose_many[1].result is None
    assert heard == [(0, 2), (1, 2), (2, 2)]
