"""`dragrig gap evaluate` answers whether a promise is kept, and can fail: no effect, another one, twice the size."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from diagnosed import UNADVISED
from diagnoses import BLANK
from dragrig.analysis.gap import GapReduction, ModelEvaluation, PromiseVerdict, R2BeforeAfter, RelativeEffectSize
from dragrig.analysis.gap.diagnose import diagnose
from dragrig.analysis.gap.gap_reduction import run_weights
from dragrig.analysis.gap.run_data import choose_runs
from dragrig.analysis.models.capsule_model import MODEL as CAPSULE
from dragrig.api import gap_evaluate
from dragrig.cli import main
from dragrig.config import AnalysisError
from dragrig.present import evaluation_document, render_page
from dragrig.present.terminal import document_text
from dragrig.rig import read_info, read_run
from dragrig.sim_backend.blind import draw_campaign, parallel_session, write_campaign
from hidden import thinned
from places import CAMPAIGN, DATA
from property_tests import thorough

MODEL = DATA / "amended-breakaway.toml"
"""What `dragrig gap diagnose --save-model` wrote of the plant's campaign of this seed, which has a breakaway force."""
SEED = 900015


def fresh_session(folder: Path, effects: tuple[str, ...], size: float = 1.0) -> Path:
    """Write a second session of the same specimen with other effects at work."""
    whole = draw_campaign(SEED, effects=effects, size=size if effects else ())
    write_campaign(thinned(parallel_session(whole, "fresh"), 4), folder)
    return folder


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A second session in which the effect is there."""
    return fresh_session(tmp_path_factory.mktemp("kept"), ("breakaway",))


def evaluated(folder: Path, capsys: pytest.CaptureFixture[str], exit_code: int, *options: str) -> dict[str, object]:
    assert main(["gap", "evaluate", str(MODEL), str(folder), "--json", *options]) == exit_code
    document: dict[str, object] = json.loads(capsys.readouterr().out)
    return document


def test_a_promise_is_kept_where_the_effect_is_there(kept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    document = evaluated(kept, capsys, 0)
    assert document["verdict"] == "KEPT"
    (size,) = document["sizes"]  # type: ignore[misc]
    assert size["size_95ci"][0] <= size["size"] <= size["size_95ci"][1]
    assert size["size"] == pytest.approx(1.0, abs=0.2)
    assert document["achieved"]["closed"] > 0.9  # type: ignore[index]
    assert document["achieved"]["explained"] > 0.9  # type: ignore[index]


@pytest.mark.parametrize(
    ("effects", "size", "sentence"),
    [
        thorough(("force_drift",), 1.0, "is absent"),
        thorough(("folds",), 1.0, "is absent"),
        (("breakaway",), 2.0, "is of another size (2."),
    ],
    ids=["drift in its place", "folds in its place", "twice the size"],
)
def test_a_promise_is_not_kept_where_something_else_is_there(
    effects: tuple[str, ...], size: float, sentence: str, tmp_path: Path
) -> None:
    evaluation = gap_evaluate(MODEL, fresh_session(tmp_path, effects, size))
    assert evaluation.verdict is PromiseVerdict.NOT_KEPT
    shown = " ".join(document_text(evaluation_document(evaluation)).split())
    assert "NOT KEPT" in shown
    assert sentence in shown
    if size == 1.0:
        assert evaluation.achieved is not None
        assert evaluation.achieved < 0


def test_a_promise_that_is_not_kept_is_an_exit_code_and_a_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dragrig.present.files.svg_text", lambda _: BLANK)
    fresh, page = fresh_session(tmp_path / "fresh", ()), tmp_path / "page.html"
    document = evaluated(fresh, capsys, 1, "--report", str(page))
    assert document["verdict"] == "NOT_KEPT"
    assert all(words in page.read_text("utf-8") for words in ("NOT KEPT", "is absent"))
    assert document["achieved"]["closed"] < 0  # type: ignore[index]


@pytest.mark.thorough
def test_a_diagnosis_promises_the_size_that_its_own_runs_have(tmp_path: Path) -> None:
    """Two steps from the start values the fit of this tether is still half as large as what explains the runs best."""
    write_campaign(draw_campaign(83031, effects=("mesentery_tether",), size=1.0), tmp_path)
    found = diagnose(choose_runs(tmp_path), CAPSULE, UNADVISED)
    assert found.effects == ("mesentery_tether",)
    assert found.model is not None
    assert found.model.diagnosed is not None
    with pytest.raises(AnalysisError, match="took part in the diagnosis that made model amended"):
        gap_evaluate(found.model, tmp_path)
    forgetful = found.model.model_copy(update={"diagnosed": found.model.diagnosed.model_copy(update={"run_ids": ()})})
    (size,) = gap_evaluate(forgetful, tmp_path).sizes
    assert size.size == pytest.approx(1.0, abs=0.15)


def test_runs_that_took_part_in_the_diagnosis_confirm_nothing(
    kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known, other = (read_info(path).header.run_id for path in sorted(kept.glob("*drag*.h5"))[:2])
    assert known != other
    model = tmp_path / "model.toml"
    text = MODEL.read_text("utf-8").replace("[diagnosed]", f'[diagnosed]\nrun_ids = ["{known}"]')
    model.write_text(text, "utf-8")
    assert main(["gap", "evaluate", str(model), str(kept)]) == 0
    shown = capsys.readouterr().out
    assert "The promise is KEPT" in shown
    assert "1 run that took part in the diagnosis is left out." in shown


def test_runs_that_do_not_show_the_effect_have_no_power(
    kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    silent = tmp_path / "silent"
    silent.mkdir()
    for run in kept.glob("*relaxation*.h5"):
        shutil.copy(run, silent)
    document = evaluated(silent, capsys, 0)
    assert document["verdict"] == "NO_POWER"


def test_a_model_without_effects_promises_nothing(
    kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bare = tmp_path / "bare.toml"
    bare.write_text('name = "bare"\n', "utf-8")
    assert main(["gap", "evaluate", str(bare), str(kept)]) == 2
    assert "no effects" in capsys.readouterr().err


@pytest.mark.parametrize(
    "effect",
    [
        thorough({"id": "encoder_scale", "scale_error": 0.0}),
        thorough({"id": "mains_hum", "amplitude_mN": 0.0, "frequency_hz": 50.0}),
        {"id": "breakaway", "ratio": 0.0},
    ],
    ids=["position", "hum", "force"],
)
def test_an_effect_of_size_zero_promises_nothing_that_runs_could_show(
    effect: dict[str, str | float], tmp_path: Path
) -> None:
    model = tmp_path / "zero.toml"
    fields = ", ".join(f"{name} = {value!r}".replace("'", '"') for name, value in effect.items())
    model.write_text(f'name = "zero"\neffects = [{{ {fields} }}]\n', "utf-8")
    few = [read_run(next(CAMPAIGN.glob(f"*{kind}*.h5"))) for kind in ("relaxation", "coulomb", "drag")]
    assert gap_evaluate(model, few).verdict is PromiseVerdict.NO_POWER


def evaluation_with(explained: float | None, achieved: float) -> ModelEvaluation:
    """Return an evaluation of an effect of the promised size."""
    reduction = GapReduction(
        gap_before_mN=5.0,
        gap_after_mN=5.0,
        noise_floor_mN=1.0,
        closed=None,
        closed_95ci=None,
        boundary_mm_s=None,
        r2_eq15=R2BeforeAfter(None, None, None, None),
        r2_corr=R2BeforeAfter(None, None, None, None),
        runs=(),
    )
    size = RelativeEffectSize("folds", 1.0, 0.9, 1.1, 50.0)
    return ModelEvaluation(reduction, None, None, achieved, None, explained, (size,))


@pytest.mark.parametrize(
    ("explained", "achieved", "verdict"),
    [(0.1, 0.9, PromiseVerdict.NOT_KEPT), (0.6, -3.0, PromiseVerdict.KEPT), (None, 0.0, PromiseVerdict.KEPT)],
    ids=["explains little of the runs", "two relaxations outweigh the squares", "no gap that matters"],
)
def test_an_effect_of_the_right_size_explains_what_is_wrong(
    explained: float | None, achieved: float, verdict: PromiseVerdict
) -> None:
    assert evaluation_with(explained, achieved).verdict is verdict


def test_what_made_held_out_runs_worse_has_no_promise_to_keep() -> None:
    evaluation = replace(evaluation_with(0.9, 0.9), promised=-17.8)
    assert evaluation.verdict is PromiseVerdict.NO_POWER
    assert "no promise to keep" in document_text(evaluation_document(evaluation))


def test_the_page_says_that_its_runs_are_simulated() -> None:
    page = render_page(evaluation_document(replace(evaluation_with(0.9, 0.9), backends=("simulated",))))
    assert '<span class="badge simulated">simulated</span>' in page
    assert "KEPT" in page.split("<h1>")[1].split("</h1>")[0]


def test_no_bootstrap_sample_leaves_out_the_one_run_that_shows_an_effect() -> None:
    weights = run_weights(18, np.random.default_rng(0))
    assert weights.min() > 0
    assert np.allclose(weights.mean(axis=1), 1.0)
    assert np.var(weights) == pytest.approx(1.0, abs=0.15)
