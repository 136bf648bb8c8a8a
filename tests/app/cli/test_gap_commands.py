"""`dragrig gap diagnose` and `dragrig gap evaluate`: what cannot be done is told in words, before any work."""

import shutil
from pathlib import Path

import pytest

import dragrig
from dragrig.analysis.gap import DiagnosisOptions
from dragrig.api.gap import diagnosis_options, save_amended_model
from dragrig.cli import main
from dragrig.config.errors import SettingsError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.settings import read_settings_file
from dragrig.present.diagnosis import diagnosis_document
from dragrig.present.html_page import render_page
from places import CAMPAIGN


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    return Path(shutil.copytree(CAMPAIGN, tmp_path / "campaign"))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--without", "stribek"], "did you mean stribeck?"),
        (["--tolerance", "-1"], "tolerance -1: a tolerance is a force in mN from 0 on"),
        (["--tolerance", "nan"], "'nan' is not a number"),
        (["--workers", "0"], "at least one worker"),
        (["--nominal", "capsul"], "did you mean capsule?"),
        (["--nominal", "gone.toml"], "gone.toml: there is no such file"),
        (["--report", "gone/report.html"], "there is no folder gone; make it"),
        (["--save-model", "gone/model.toml"], "there is no folder gone; make it"),
    ],
)
def test_what_cannot_be_asked_for_is_told_in_one_sentence(
    arguments: list[str], text: str, campaign: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["gap", "diagnose", str(campaign), "--quiet", *arguments]) == 2
    output = capsys.readouterr()
    assert text in output.err
    assert len(output.err.strip().splitlines()) == 1
    assert output.out == ""


def test_a_file_that_is_there_is_not_replaced_unasked(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine = campaign / "mine.html"
    mine.write_text("precious")
    assert main(["gap", "diagnose", str(campaign), "--quiet", "--report", str(mine)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert mine.read_text() == "precious"


@pytest.mark.parametrize("command", [["diagnose"], ["evaluate", "paper"]])
def test_folders_without_runs_are_told(command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gap", *command, str(tmp_path), "--quiet"]) == 2
    assert "no run file" in capsys.readouterr().err
    assert main(["gap", *command, str(tmp_path / "gone"), "--quiet"]) == 2
    assert "there is no such folder" in capsys.readouterr().err


def test_what_is_no_model_cannot_be_evaluated(
    campaign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text("[[steps]]\nkind = 'drag'\n")
    assert main(["gap", "evaluate", str(plan), str(campaign)]) == 2
    assert "steps is not a known key" in capsys.readouterr().err
    run = tmp_path / "run.toml"
    shutil.copy(campaign / "010-drag.h5", run)
    assert main(["gap", "evaluate", str(run), str(campaign)]) == 2
    assert "dragrig: " in capsys.readouterr().err


def test_options_have_the_engines_defaults() -> None:
    assert diagnosis_options((), None).tolerance_mN == DiagnosisOptions().tolerance_mN
    assert diagnosis_options(("folds", "folds"), 0.0) == DiagnosisOptions(excluded=("folds",), tolerance_mN=0.0)
    with pytest.raises(SettingsError):
        diagnosis_options(("",), None)


def test_the_saved_model_runs_the_simulator(tmp_path: Path) -> None:
    from dataclasses import replace

    from diagnoses import NO_GAP, STRIBECK, without_pictures

    amended = FrictionModelSettings.model_validate(
        {"name": "amended", "effects": [{"id": "stribeck", "ratio": 0.4, "speed_mm_s": 2.0}]}
    )
    path = save_amended_model(replace(STRIBECK, model=amended), tmp_path / "amended.toml")
    assert path is not None
    assert read_settings_file(FrictionModelSettings, path) == amended
    slow = ["speed_mm_s=0.5", "travel_mm=2", "way_back=stay", "rig.sampling.rate_hz=200"]
    with_it, without = (dragrig.simulate("drag", model=entry, assignments=slow)[0] for entry in (path, "paper"))
    steady = with_it.trace.phase == 2
    assert with_it.trace.force[steady].mean() > without.trace.force[steady].mean() + 5
    assert save_amended_model(NO_GAP, tmp_path / "none.toml") is None
    assert not (tmp_path / "none.toml").exists()
    assert "gap evaluate" in render_page(without_pictures(diagnosis_document(STRIBECK, model=str(path))))
