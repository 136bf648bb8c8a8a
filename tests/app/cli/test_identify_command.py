"""`dragrig identify`: from a folder of runs to numbers, and to a model that the simulator loads."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import dragrig
from dragrig.cli import main
from dragrig.config.errors import AnalysisError
from dragrig.rig import mark_bad
from dragrig.rig.runfile import read_run
from dragrig.rig.runfile.model import Run
from places import CAMPAIGN, copied_runs
from property_tests import thorough


@pytest.fixture
def few(tmp_path: Path) -> Path:
    """A Coulomb run and two drags, which take a third of the time."""
    return copied_runs(tmp_path / "few", "008-coulomb.h5", "010-drag.h5", "018-drag.h5")


@pytest.mark.parametrize("kinds", [("coulomb", "drag"), thorough(("relaxation", "coulomb", "drag"))], ids=len)
def test_the_model_that_was_identified_runs_the_simulator(
    kinds: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = {"relaxation": "001-relaxation.h5", "coulomb": "008-coulomb.h5", "drag": "010-drag.h5"}
    campaign = copied_runs(tmp_path / "one-of-each", *(runs[kind] for kind in kinds))
    assert main(["identify", str(campaign), "--quiet"]) == 0
    output = capsys.readouterr().out
    assert "friction_coefficient" in output
    assert "Left out" not in output
    model = campaign / "identified" / "model.toml"
    assert {path.name for path in model.parent.iterdir()} == {
        "model.toml", "joint-fit.png", *(f"{kind}.png" for kind in kinds if kind != "coulomb"),
    }  # fmt: skip
    (drag, *_) = dragrig.simulate("drag", model=model, assignments=["speed_mm_s=30", "way_back=stay"])
    steady = drag.trace.force[drag.trace.phase == 2][-100:].mean()
    measured = read_run(campaign / "010-drag.h5").trace
    assert steady == pytest.approx(measured.force[measured.phase == 2][-100:].mean(), rel=0.1)


def test_a_second_call_replaces_nothing(tmp_path: Path) -> None:
    campaign = copied_runs(tmp_path / "campaign", "008-coulomb.h5")
    first = campaign / "identified" / "model.toml"
    first.parent.mkdir()
    first.write_text("of the first call", "utf-8")
    assert main(["identify", str(campaign), "--quiet"]) == 0
    assert [path.name for path in first.parent.iterdir()] == [first.name]
    assert first.read_text("utf-8") == "of the first call"
    assert (campaign / "identified-2" / "model.toml").is_file()


def test_json_holds_every_number_with_its_interval(few: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["identify", str(few), "--json", "--quiet"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["joint"]["converged"] is True
    assert answer["files"] == []
    assert not (few / "identified").exists()


def test_a_model_file_is_never_replaced_unasked(few: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = tmp_path / "mine.toml"
    model.write_text("precious")
    assert main(["identify", str(few), "--save-model", str(model), "--json", "--quiet"]) == 2
    assert model.read_text() == "precious"
    assert "--overwrite" in capsys.readouterr().err


def test_fitted_walls_are_the_specimens_own(tmp_path: Path) -> None:
    runs = dragrig.simulate(
        "relaxation",
        assignments=["shear_strain=[0.5, 2.0]", "model.wall='table1'", "rig.sampling.rate_hz=200"],
    )
    identification = dragrig.identify(runs, wall="fitted")
    assert identification.model.wall == "polynomial"
    stiffness = identification.parameters.loc["stiffness_scale"]
    assert stiffness["low"] < 1.0 < stiffness["high"]


def test_missing_kinds_are_said_and_give_no_number() -> None:
    identification = dragrig.identify([read_run(CAMPAIGN / "008-coulomb.h5")])
    assert any("no usable drag" in remark for remark in identification.result.remarks)
    learnt = identification.parameters["learnt"]
    assert learnt.loc["contact_angle_offset_deg"] < 0.05
    assert identification.model.contact_angle_offset_deg == 0.0
    assert learnt.loc["friction_coefficient"] > 0.5
    assert learnt.loc["stiffness_scale"] < 0.01
    assert identification.result.relaxation is not None
    assert not identification.result.relaxation.fits


def test_runs_marked_bad_are_left_out_with_the_reason(few: Path) -> None:
    bad = few / "018-drag.h5"
    mark_bad(bad, "the gut slipped off the foam")
    identification = dragrig.identify(few)
    assert [(exclusion.item, exclusion.reason) for exclusion in identification.result.left_out] == [
        (bad.name, "it is marked bad: the gut slipped off the foam")
    ]


def changed(run: Run, force: np.ndarray) -> Run:
    return replace(run, trace=replace(run.trace, channels={**run.trace.channels, "force": force}))


def test_nan_and_clipped_samples_are_left_out() -> None:
    run = read_run(CAMPAIGN / "010-drag.h5")
    force = np.array(run.trace.force)
    force[1000:1040] = np.nan
    force[1500:1510] = force.max() + 1.0
    others = (read_run(path) for path in CAMPAIGN.glob("*.h5") if path.name != "010-drag.h5")
    identification = dragrig.identify([*others, changed(run, force)])
    assert any("010-drag.h5: 50 samples" in remark for remark in identification.result.remarks)
    assert 0.9 < identification.result.joint.chi2 / identification.result.joint.degrees < 1.1


def test_specimens_that_are_mixed_are_not_averaged(few: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = Path(shutil.copy(few / "010-drag.h5", few / "099-drag.h5"))
    with h5py.File(path, "r+") as file:
        file["entry/specimen"].attrs["name"] = "ileum"
    assert main(["identify", str(few), "--quiet"]) == 2
    assert "several specimens" in capsys.readouterr().err
    with pytest.raises(AnalysisError, match="several specimens"):
        dragrig.identify(few)
    assert dragrig.identify(few, specimen="ileum").result.used == ("099-drag.h5",)


def test_a_folder_without_runs_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["identify", str(tmp_path)]) == 2
    assert "no run file" in capsys.readouterr().err


def test_runs_that_determine_nothing_give_no_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    campaign = copied_runs(tmp_path / "campaign", "005-blank.h5")
    assert main(["identify", str(campaign), "--quiet"]) == 0
    assert "These runs determine NONE of its parameters" in capsys.readouterr().out
    assert not (campaign / "identified" / "model.toml").exists()
    assert main(["identify", str(campaign), "--quiet", "--json", "--save-model", str(campaign / "mine.toml")]) == 2
    assert "determine no parameter" in capsys.readouterr().err


def test_a_fit_that_does_not_converge_ends_with_2_and_no_model(
    few: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in few.glob("*-drag.h5"):
        path.unlink()
    monkeypatch.setattr("dragrig.analysis.linear_gaussian.MAX_PASSES", 1)
    # Without --json there are pictures beside the model.
    assert main(["identify", str(few), "--quiet", "--json"]) == 2
    output = capsys.readouterr()
    assert "did not converge" in output.err
    assert len(output.err.strip().splitlines()) == 1
    assert json.loads(output.out)["joint"]["parameters"]["friction_coefficient"]["interval_95"] is None
    assert not (few / "identified" / "model.toml").exists()
