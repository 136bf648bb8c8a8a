"""Weights that are learnt from campaigns whose hidden effects are known, and the file that they are kept in."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import dragrig
from diagnosed import DiagnosedCampaigns
from dragrig.analysis.gap.classifier import classify
from dragrig.analysis.gap.diagnosis import UNKNOWN, Classification, Verdict
from dragrig.analysis.gap.features import (
    DecisionInputs,
    HypothesisSummary,
    VerdictCalibration,
    shipped_calibration,
)
from dragrig.analysis.gap.isolability import DEFAULT_TOLERANCE_MN, DETECTABLE_D_PRIME
from dragrig.analysis.gap.training import TrainingCase, calibrate, cross_validate, fit_presence, fit_weights
from dragrig.cli.commands import gap_command
from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.sim_backend.effects import catalogue

BLOCKS, NOISE, LOUD = 8000, 8010.0, 40_000.0
NAMES = ("stribeck", "folds", "force_drift", "arm_compliance")


def lessons(seed: int, count: int = 60) -> list[TrainingCase]:
    """Right effects leave little, wrong ones and those outside the catalogue much, each with some scatter."""
    random = np.random.default_rng(seed)
    made = []
    for number in range(count):
        right, wrong = random.permutation(NAMES)[:2].tolist()
        outside = number % 4 == 0
        left = {
            right: random.uniform(0.3, 0.6) if outside else random.uniform(0.0, 0.15),
            wrong: random.uniform(0.5, 0.9),
        }
        tried = tuple(
            HypothesisSummary((name,), squares, squares, 5.0, llr=0.5 * (LOUD - squares), chi2_without=LOUD)
            for name, squares in ((name, NOISE + share * (LOUD - NOISE)) for name, share in left.items())
        )
        hidden = frozenset[str]() if outside else frozenset({right})
        made.append(TrainingCase(DecisionInputs(BLOCKS, LOUD, tried), hidden, outside))
    quiet = HypothesisSummary(("folds",), NOISE - 10, NOISE - 12, 1.0, llr=5.0, chi2_without=NOISE)
    made += [TrainingCase(DecisionInputs(BLOCKS, NOISE, (quiet,)), frozenset())] * 10
    return made


def learnt(made: list[TrainingCase]) -> VerdictCalibration:
    return calibrate(made, DEFAULT_TOLERANCE_MN, seeds=(1,))


def test_what_was_learnt_holds_on_other_campaigns() -> None:
    calibration = learnt(lessons(1))
    right = 0
    fresh = lessons(2)
    for case in fresh:
        classification = classify(case.inputs, DEFAULT_TOLERANCE_MN, calibration)
        verdict = "unknown" if case.outside else "effect" if case.effects else "no_gap"
        right += classification.verdict.value == verdict and set(classification.effects) == case.effects
    assert right >= 0.95 * len(fresh)


def test_probabilities_are_as_often_right_as_they_say() -> None:
    calibration = learnt(lessons(1, 200))
    answer = [(classify(case.inputs, DEFAULT_TOLERANCE_MN, calibration), case) for case in lessons(3, 200)]
    chances = [max(classification.probabilities.values()) for classification, _ in answer]
    right = [set(classification.effects) == case.effects for classification, case in answer]
    assert np.mean(chances) == pytest.approx(np.mean(right), abs=0.05)


def test_explaining_less_never_makes_an_effect_the_likelier_one() -> None:
    """However few campaigns teach it, and even where these teach the contrary."""
    astray = []
    for case in lessons(4):
        best, worst = (
            sorted(case.inputs.hypotheses, key=lambda tried: tried.llr)[::-1][:2] if case.effects else (None, None)
        )
        if best is not None and worst is not None:
            astray.append(replace(case, effects=frozenset(worst.effects)))
    weights = fit_weights(astray, DEFAULT_TOLERANCE_MN)
    assert all(weight >= 0 for name, weight in weights.items() if name.startswith(("plain", "flexible")))
    assert all(weight <= 0 for name, weight in weights.items() if name.startswith(("behind", "left", "nameless")))


def test_what_is_learnt_beside_a_competition_that_knows_is_to_follow_it() -> None:
    made = lessons(7)
    doubtful = [Classification(Verdict.UNKNOWN, (), {UNKNOWN: 1.0}, ())] * len(made)

    def weight(present: float, absent: float) -> float:
        judged = []
        for case in made:
            competition = {name: present if name in case.effects else absent for name in NAMES}
            judged.append(replace(case, inputs=replace(case.inputs, competition=competition)))
        return fit_presence(judged, doubtful).competition

    assert weight(0.9, 0.1) > 1.0
    assert weight(0.1, 0.9) < 0.0


def test_no_learnt_number_is_of_a_single_effect() -> None:
    assert not [name for name in shipped_calibration().weights if any(effect in name for effect in catalogue())]


def test_nothing_is_learnt_from_nothing() -> None:
    with pytest.raises(ValueError, match="No campaign"):
        fit_weights([], DEFAULT_TOLERANCE_MN)


def exam(folder: Path, made: list[TrainingCase]) -> Path:
    """Write what `dragrig gap blind --out` keeps, as far as it is learnt from."""
    (folder / "said").mkdir(parents=True)
    (folder / "exam.json").write_text('{"cases": 70, "seed": 5, "mix": "learning"}', "utf-8")
    answers = {}
    for number, case in enumerate(made):
        verdict = "unknown" if case.outside else "effect" if case.effects else "no_gap"
        answers[f"{number:04d}"] = {"verdict": verdict, "effects": sorted(case.effects), "size": [case.size]}
        text = {"evidence": case.inputs.document()}
        (folder / "said" / f"{number:04d}.json").write_text(json.dumps(text), "utf-8")
    (folder / "answers.json").write_text(json.dumps(answers), "utf-8")
    return folder


def test_an_exam_becomes_a_file_that_is_as_good_as_what_was_learnt(tmp_path: Path) -> None:
    made = lessons(1)
    calibration = dragrig.gap_calibrate([exam(tmp_path / "learnt", made)])
    assert (calibration.seeds, calibration.cases) == ((5,), len(made))
    made_by = "dragrig gap blind --cases 70 --seed 5 --mix learning --out learnt"
    assert calibration.command == f"{made_by}; dragrig gap calibrate learnt"
    assert calibration.weights == learnt(made).weights
    assert VerdictCalibration.model_validate_json(calibration.model_dump_json()) == calibration


def test_each_part_is_judged_by_what_the_others_teach(tmp_path: Path) -> None:
    made = lessons(6)
    taught = [learnt(made[1::2]), learnt(made[::2])]
    in_turn = cross_validate(made, DEFAULT_TOLERANCE_MN, folds=2)
    assert in_turn == tuple(classify(case.inputs, DEFAULT_TOLERANCE_MN, taught[at % 2]) for at, case in enumerate(made))
    rates = {entry.name: entry for entry in dragrig.gap_cross_validate([exam(tmp_path / "learnt", made)], folds=2)}
    quiet = [
        classification
        for classification, case in zip(in_turn, made, strict=True)
        if not case.effects and not case.outside
    ]
    right = sum(classification.verdict is Verdict.NO_GAP for classification in quiet)
    assert (rates["none, no gap"].held, rates["none, no gap"].count) == (right, len(quiet))
    assert rates["full size, right name"].share > 0.9
    assert "full size, right channel" not in rates


def test_more_parts_than_campaigns_are_told_in_one_sentence(tmp_path: Path) -> None:
    folder = exam(tmp_path / "learnt", lessons(6)[:5])
    with pytest.raises(AnalysisError, match="5 campaigns cannot be divided into 6 folds; hold a larger exam"):
        dragrig.gap_cross_validate([folder], folds=6)


def test_the_command_prints_how_often_what_was_learnt_is_right(tmp_path: Path) -> None:
    folder = str(exam(tmp_path / "learnt", lessons(6)))
    result = CliRunner().invoke(gap_command, ["calibrate", folder, "--folds", "3"])
    assert result.exit_code == 0
    assert "How often verdicts learnt from the other campaigns are right" in result.output
    printed = json.loads(CliRunner().invoke(gap_command, ["calibrate", folder, "--folds", "3", "--json"]).output)
    assert printed["cross_validated"][0]["name"] == "full size, right name"
    assert "cross_validated" not in json.loads(CliRunner().invoke(gap_command, ["calibrate", folder, "--json"]).output)


def test_a_folder_without_an_exam_is_told_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(AnalysisError, match="holds no finished exam; hold one with dragrig gap blind"):
        dragrig.gap_calibrate([tmp_path])


def test_what_ships_says_where_it_comes_from() -> None:
    shipped = shipped_calibration()
    assert "dragrig gap calibrate" in shipped.command
    assert shipped.cases >= 100
    assert shipped.seeds


def test_the_smallest_effect_that_is_promised_to_be_seen_passes_the_gate() -> None:
    """An effect of d′ saves d′²/2 nats in the mean."""
    assert pytest.approx(shipped_calibration().gate.least_gain, rel=0.02) == DETECTABLE_D_PRIME**2 / 2


def test_a_calibration_of_ones_own_decides(tmp_path: Path, diagnosed: DiagnosedCampaigns) -> None:
    stern = shipped_calibration().model_copy(update={"weights": {"known": -50.0}})
    file = tmp_path / "stern.json"
    file.write_text(stern.model_dump_json(), "utf-8")
    stribeck = diagnosed["stribeck"]
    assert stribeck.diagnosis.effects == ("stribeck",)
    others = sorted(catalogue().keys() - {"stribeck"})
    assert dragrig.gap_diagnose(stribeck.runs, without=others, calibration=file).effects == ()


@pytest.mark.parametrize(("text", "answer"), [(None, "cannot be read"), ("{}", "is not what dragrig gap calibrate")])
def test_a_calibration_that_is_none_is_told_in_one_sentence(tmp_path: Path, text: str | None, answer: str) -> None:
    file = tmp_path / "some.json"
    if text is not None:
        file.write_text(text, "utf-8")
    with pytest.raises(SettingsError, match=answer):
        dragrig.gap_diagnose(tmp_path, calibration=file)
