"""The next run where the position strays: whether it tells apart what the runs so far do not."""

from dataclasses import replace
from pathlib import Path

import pytest

import dragrig
from diagnosed import UNADVISED, trying
from dragrig.analysis.gap import DiagnosisOptions
from dragrig.analysis.gap.candidate_runs import ExperimentBudget, motion_grid, short_grid
from dragrig.analysis.gap.diagnose import diagnose
from dragrig.analysis.gap.diagnosis import Diagnosis, NextExperiment, Verdict
from dragrig.analysis.gap.next_run import NO_NEW_MOTION, recommend_position_run
from dragrig.analysis.gap.position_channel import PositionAnalysis, analyse_position
from dragrig.analysis.gap.run_data import choose_runs
from dragrig.analysis.gap.studies import CapsuleStudy
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.api.gap import save_next_plan
from dragrig.cli import main
from dragrig.config.plan import Plan
from dragrig.config.specimen import Specimen
from dragrig.rig.runfile.model import Run
from dragrig.sim_backend.effects.base import catalogue
from property_tests import thorough

SCALE = "encoder_scale:scale_error=0.003"
LONG_RIPPLE = "velocity_ripple:pitch_mm=20,amplitude_mm=0.03"
THIN = {"kind": "drag", "speed_mm_s": [5.0, 20.0], "travel_mm": 6.0}
FULL = {"kind": "drag", "speed_mm_s": [2.0, 20.0, 40.0], "travel_mm": 20.0}
ONE_RUN = ExperimentBudget()
OF_POSITION = replace(
    UNADVISED, excluded=tuple(effect.id for effect in catalogue().values() if effect.has_force_signature)
)
"""A diagnosis that tries no effect on the force."""
ADVISED_OF_POSITION = replace(OF_POSITION, next_runs=ONE_RUN)
MIXED = ("velocity_ripple:pitch_mm=5,amplitude_mm=0.03", "servo_lag:lag_s=0.004", "encoder_scale")


@pytest.fixture(autouse=True)
def coarse_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare every fourth of the candidate runs for the force."""
    monkeypatch.setattr("dragrig.analysis.gap.next_run.short_grid", lambda specimen: short_grid(specimen)[::4])


def plan(*steps: dict[str, object], seed: int = 3) -> Plan:
    return Plan.model_validate({"name": "tried", "seed": seed, "steps": steps})


def diagnosis_of(runs: tuple[Run, ...], options: DiagnosisOptions | None = None) -> Diagnosis:
    return diagnose(choose_runs(runs), MODEL, options)


def found_in(runs: tuple[Run, ...]) -> PositionAnalysis:
    return analyse_position(choose_runs(runs).experiments, list(catalogue().values()))


def advised_for_position(runs: tuple[Run, ...], diagnosis: Diagnosis) -> NextExperiment | None:
    """The advice for the position alone: that for the force may tell more per minute of few runs."""
    probabilities = {entry.hypothesis: entry.probability for entry in diagnosis.ranking}
    return recommend_position_run(CapsuleStudy.of(choose_runs(runs), MODEL, ()), found_in(runs), probabilities, ONE_RUN)


def margin(position: PositionAnalysis, truth: str) -> float:
    """By how much the truth explains more than any other effect."""
    shares = {model_class.effect: model_class.held_out_share for model_class in position.model_classes}
    return shares.pop(truth) - max(shares.values())


@pytest.mark.parametrize("effect", [SCALE, thorough(LONG_RIPPLE)])
def test_short_strokes_are_followed_by_the_run_that_tells_scale_from_ripple(effect: str, tmp_path: Path) -> None:
    truth = effect.split(":", 1)[0]
    thin = dragrig.simulate(plan(THIN), effects=[effect])
    advised = advised_for_position(thin, diagnosis_of(thin, OF_POSITION))
    assert advised is not None
    (run,) = advised.runs
    assert set(run.about) == {"encoder_scale", "velocity_ripple"}
    assert (run.gain_bits or 0.0) > 0.05
    file = save_next_plan(advised, tmp_path / "next.toml")
    assert main(["check", str(file)]) == 0
    more = dragrig.simulate(file, effects=[effect])
    again = dragrig.simulate(plan({**THIN, "repeats": 2}, seed=9), effects=[effect])
    with_it, repeated = found_in((*thin, *more)), found_in((*thin, *again))
    assert with_it.model_classes[0].effect == truth
    assert with_it.model_classes[0].held_out_share > 0.99
    assert margin(with_it, truth) > max(0.05, 2 * margin(repeated, truth))


@pytest.mark.thorough
def test_the_plan_file_of_a_campaign_that_strays_is_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    campaign, out = tmp_path / "thin", tmp_path / "next.toml"
    dragrig.simulate(plan(THIN), out=campaign, effects=[SCALE])
    assert main(["gap", "next", str(campaign), "--quiet", "--minutes", "3", "--save-plan", str(out)]) == 0
    assert "it is expected to settle" in capsys.readouterr().out
    assert main(["check", str(out)]) == 0


@pytest.mark.thorough
def test_no_run_is_advised_for_what_is_told_apart_already() -> None:
    runs = dragrig.simulate(plan({**FULL, "travel_mm": 12.0}), effects=["velocity_ripple"])
    settled = diagnosis_of(runs, OF_POSITION)
    assert settled.effects == ("velocity_ripple",)
    assert advised_for_position(runs, settled) is None


def test_what_no_run_tells_apart_is_said() -> None:
    lag = diagnosis_of(
        dragrig.simulate(plan({**FULL, "travel_mm": 10.0}), effects=["servo_lag:lag_s=0.01,frequency_hz=60"]),
        replace(trying("servo_lag", "channel_latency", "stribeck"), next_runs=ONE_RUN),
    )
    assert {*lag.effects, *lag.confusable_with} >= {"servo_lag", "channel_latency"}
    assert any(name.startswith("No candidate run would distinguish") for name in lag.limitations)


def test_what_has_no_name_is_looked_at_where_the_stage_has_not_moved_yet() -> None:
    unnamed = diagnosis_of(dragrig.simulate(plan(FULL), effects=MIXED), ADVISED_OF_POSITION)
    assert unnamed.verdict is Verdict.UNKNOWN
    assert unnamed.next_experiment is not None
    (run,) = unnamed.next_experiment.runs
    assert run.settings["accel_mm_s2"] == 2000.0
    assert "no run so far comes near its" in unnamed.next_experiment.reason
    assert "acceleration" in unnamed.next_experiment.reason


@pytest.mark.parametrize("every", [6, thorough(1)])
def test_no_new_motion_is_advised_where_the_stage_has_made_them_all(
    every: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    grid = motion_grid(Specimen(name="jejunum"))[::every]
    ways = [candidate.step.model_copy(update={"repeats": 1}) for candidate in grid]
    monkeypatch.setattr("dragrig.analysis.gap.next_run.motion_grid", lambda *_, **__: grid)
    everything = Plan(name="all", seed=4, steps=tuple(ways))
    covered = diagnosis_of(dragrig.simulate(everything, effects=MIXED), ADVISED_OF_POSITION)
    assert covered.verdict is Verdict.UNKNOWN
    assert NO_NEW_MOTION in covered.limitations


def test_the_more_doubtful_question_comes_first() -> None:
    steps = {**FULL, "speed_mm_s": [1.0, 4.0, 30.0], "travel_mm": 10.0}
    both = diagnosis_of(
        dragrig.simulate(plan(steps), effects=["stribeck:ratio=0.4,speed_mm_s=2", SCALE]),
        replace(trying("stribeck", "adhesion", "encoder_scale", "velocity_ripple"), next_runs=ONE_RUN),
    )
    assert both.verdict is Verdict.SEVERAL
    assert "encoder_scale" in both.effects
    assert both.next_experiment is not None
    (run,) = both.next_experiment.runs
    assert "stribeck" in run.about
