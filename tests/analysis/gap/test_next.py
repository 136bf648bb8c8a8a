"""`dragrig gap next`: which runs to make next, and whether they keep what is promised of them."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

import dragrig
from diagnosed import UNADVISED
from diagnoses import STRIBECK
from dragrig.analysis.gap.candidate_runs import RigLimits, full_grid, plan_of_next_runs, short_grid
from dragrig.analysis.gap.diagnose import diagnose
from dragrig.analysis.gap.diagnosis import NextExperiment, NextRun
from dragrig.analysis.gap.run_data import choose_runs
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.api.gap import save_next_plan
from dragrig.cli import main
from dragrig.config.plan import Plan, PlanStep
from dragrig.config.settings import to_toml
from dragrig.config.specimen import Specimen
from dragrig.present.diagnosis import diagnosis_document, diagnosis_json
from dragrig.present.document import Document
from dragrig.present.html_page import render_page
from dragrig.present.numbers import to_json_value
from dragrig.present.terminal import document_text
from dragrig.sim_backend.blind import RunList, draw_campaign, write_campaign
from dragrig.sim_backend.effects import catalogue
from listed_runs import table

DRAGS = {"kind": "drag", "speed_mm_s": [1.0, 4.0, 30.0], "travel_mm": 20.0}
BETWEEN = ("stribeck", "adhesion")
OTHERS = tuple(name for name in catalogue() if name not in BETWEEN)
SPECIMEN = Specimen(name="jejunum")


def plan(*steps: dict[str, object]) -> Plan:
    return Plan.model_validate({"name": "tried", "steps": steps})


@pytest.fixture(scope="module")
def coarse_grid() -> Iterator[None]:
    """Compare every sixth of the candidate runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dragrig.analysis.gap.next_run.full_grid", lambda specimen: full_grid(specimen)[::6])
        yield


@pytest.fixture(scope="module")
def next_experiment(coarse_grid: None) -> NextExperiment:
    next_experiment = dragrig.gap_next(plan(DRAGS), between=BETWEEN, minutes=5.0)
    assert next_experiment is not None
    return next_experiment


def test_what_is_recommended_keeps_its_promise(next_experiment: NextExperiment) -> None:
    # Tack needs the closed gut: an open one tells it from friction that falls with speed.
    assert next_experiment.runs[0].step.kind == "coulomb"
    assert next_experiment.open_bits is not None
    told = sum(run.gain_bits or 0.0 for run in next_experiment.runs)
    assert 0.4 * next_experiment.open_bits < told < next_experiment.open_bits
    before = dragrig.gap_isolability(plan(DRAGS), without=OTHERS).pair(*BETWEEN)
    more = plan_of_next_runs(next_experiment)
    both = Plan(name="both", steps=(*plan(DRAGS).steps, *more.steps))
    after = dragrig.gap_isolability(both, without=OTHERS).pair(*BETWEEN)
    assert before is not None
    assert after is not None
    assert after.sin2 > 2 * before.sin2
    assert after.separation > 1.5 * before.separation


def test_no_run_is_advised_where_nothing_is_open(coarse_grid: None) -> None:
    relaxations = {"kind": "relaxation", "shear_strain": [0.5, 2.0], "hold_s": 10.0}
    both = plan(relaxations, DRAGS)
    assert dragrig.gap_next(both, between=("folds", "hyperelastic_wall"), minutes=5.0) is None


@pytest.fixture(scope="module")
def few_runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("few")
    drags = [table("drag", 200.0 * number, speed_mm_s=speed) for number, speed in enumerate((20.0, 5.0, 60.0), 1)]
    few = RunList.of("few", [table("relaxation", 0.0, hold_s=60.0), *drags])
    write_campaign(draw_campaign(115, effects=["wall_seam"], size=0.3), folder, runs=few)
    return folder


@pytest.mark.thorough
def test_time_that_is_left_is_spent_where_the_answer_is_in_doubt(few_runs: Path) -> None:
    first, second, *_ = diagnose(choose_runs(few_runs), MODEL, UNADVISED).ranking
    assert first.probability < 0.9
    assert "unknown" in {first.hypothesis, second.hypothesis}
    next_experiment = dragrig.gap_next(few_runs, minutes=5.0)
    assert next_experiment is not None
    assert next_experiment.minutes > 2.5
    gains = [run.gain_bits or 0.0 for run in next_experiment.runs]
    assert min(gains) > 0
    assert sum(gains) <= (next_experiment.open_bits or 0.0)


def test_rig_time_and_limits_are_kept(next_experiment: NextExperiment) -> None:
    assert 0 < next_experiment.minutes <= 5.0
    checked = dragrig.check(plan_of_next_runs(next_experiment))
    assert not checked.findings
    # A plan's orders and prompts change no run, so that it takes as long as was said.
    assert checked.duration_s / 60 == pytest.approx(next_experiment.minutes, rel=1e-6)
    slow = RigLimits(travel_mm=20.0, speed_mm_s=10.0, accel_mm_s2=400.0)
    remaining = [candidate.run.profile.extremes() for candidate in full_grid(SPECIMEN) if slow.allow(candidate)]
    assert remaining
    assert all(extremes.speed_mm_s <= 10 and extremes.highest_mm <= 20 for extremes in remaining)
    assert len(short_grid(SPECIMEN)) < len(full_grid(SPECIMEN))


def test_the_plan_file_is_run(next_experiment: NextExperiment, tmp_path: Path) -> None:
    file = tmp_path / "next.toml"
    assert save_next_plan(next_experiment, file) == file
    made = dragrig.simulate(file)
    kinds = [run.info.kind for run in made if run.info.kind != "return"]
    wanted = [next_run.step.kind for next_run in next_experiment.runs for _ in range(next_run.step.repeats)]
    assert sorted(kinds) == sorted(wanted)


def test_runs_of_one_fixture_stand_together_and_ask_for_hands_once() -> None:
    settings = {"travel_mm": 40.0, "accel_mm_s2": 400.0}
    steps = [
        PlanStep(kind="drag", parameters={"speed_mm_s": 5.0, **settings}),
        PlanStep(kind="coulomb", parameters={"speed_mm_s": 1.0, **settings}),
        PlanStep(kind="motion", parameters={"strokes": [{"travel_mm": 40.0, "speed_mm_s": 20.0}]}),
        PlanStep(kind="drag", parameters={"speed_mm_s": 20.0, **settings}),
        PlanStep(kind="relaxation", parameters={"shear_strain": 2.0, "hold_s": 20.0}),
    ]
    made = plan_of_next_runs(NextExperiment(tuple(NextRun(step, 1.0, 0.2) for step in steps), 9, "Because."))
    assert [step.kind for step in made.steps] == ["relaxation", "coulomb", "drag", "motion"]
    assert [bool(step.prompt) for step in made.steps] == [True, True, True, False]
    assert made.steps[2].parameters["speed_mm_s"] == [5.0, 20.0]


def test_a_diagnosis_tells_it_in_text_page_and_json(next_experiment: NextExperiment) -> None:
    diagnosis = replace(STRIBECK, next_experiment=next_experiment)
    text = json.loads(json.dumps(to_json_value(diagnosis_json(diagnosis)), allow_nan=False))["next_experiment"]
    assert text["protocol"] == "coulomb"
    assert text["speed_mm_s"] > 0
    assert text["why"] == next_experiment.reason
    assert text["gain_bits"] > 0
    assert "best tells adhesion from Stribeck friction" in next_experiment.reason or (
        "best tells Stribeck friction from adhesion" in next_experiment.reason
    )
    assert "bit" not in next_experiment.reason
    document = diagnosis_document(diagnosis)
    assert next_experiment.reason in document_text(document)
    assert "What to run next" in render_page(without_figures(document))
    assert "What to run next" not in render_page(without_figures(diagnosis_document(STRIBECK)))


def without_figures(document: Document) -> Document:
    """A document's sections that need no drawing."""
    return replace(document, sections=tuple(section for section in document.sections if section.name == "confidence"))


def test_the_command_prints_json_and_refuses_what_is_no_effect(
    tmp_path: Path, coarse_grid: None, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = tmp_path / "mine.toml", tmp_path / "next.toml"
    file.write_text(to_toml(plan(DRAGS)), "utf-8")
    command = ["gap", "next", str(file), "--quiet"]
    assert main([*command, "--json", "--minutes", "2", "--between", *BETWEEN, "--save-plan", str(out)]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["format"] == "dragrig-next"
    assert answer["minutes"] <= 2
    assert main(["check", str(out)]) == 0
    capsys.readouterr()
    assert main([*command, "--between", "stribek", "adhesion"]) == 2
    assert "stribeck" in capsys.readouterr().err
    assert main([*command, "--between", "adhesion", "adhesion"]) == 2
    assert "differ" in capsys.readouterr().err
    assert main([*command, "--minutes", "0"]) == 2
    assert "minutes 0" in capsys.readouterr().err
    assert main([*command, "--between", "extra_relaxation", "payload_inertia", "--save-plan", str(out)]) == 2
    assert "--overwrite" in capsys.readouterr().err
