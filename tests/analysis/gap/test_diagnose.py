"""A diagnosis from run files to the answer: nothing, an effect, two, something that nobody knows, and the way back."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from diagnosed import OF_SOME, SECRETS, UNADVISED, DiagnosedCampaigns, trying
from dragrig.analysis.gap import DiagnosisOptions
from dragrig.analysis.gap.diagnose import diagnose
from dragrig.analysis.gap.diagnosis import Diagnosis, Verdict
from dragrig.analysis.gap.run_data import choose_runs
from dragrig.analysis.models.capsule_model import MODEL, CapsuleModel
from dragrig.api.gap import save_amended_model
from dragrig.config.friction_model import FrictionModelSettings, parse_effects
from dragrig.present.diagnosis import campaigns_document, diagnosis_document, diagnosis_json
from dragrig.present.document import Table
from dragrig.present.numbers import to_json_value
from dragrig.rig import Phase
from hidden import hidden, simulated
from places import CAMPAIGN, DATA
from property_tests import thorough

NUMBERED = {path.name.split("-")[1].removesuffix(".h5"): path for path in sorted(CAMPAIGN.glob("*.h5"))}


@pytest.fixture
def diagnosis(diagnosed: DiagnosedCampaigns) -> Diagnosis:
    return diagnosed["stribeck"].diagnosis


def probability(diagnosis: Diagnosis, hypothesis: str) -> float:
    return sum(entry.probability for entry in diagnosis.ranking if entry.hypothesis == hypothesis)


def test_a_campaign_without_a_gap_says_what_would_have_been_seen(diagnosed: DiagnosedCampaigns) -> None:
    nothing = diagnosed["nothing"].diagnosis
    assert nothing.verdict is Verdict.NO_GAP
    assert (nothing.effects, nothing.model) == ((), None)
    assert probability(nothing, "no_gap") > 0.5
    assert 0.1 < nothing.detection_limit_mN < 10
    assert set(nothing.where.location("channel").shares.values()) == {0.0}
    assert nothing.shrink is not None
    assert nothing.shrink.closed is None


@pytest.mark.parametrize(
    "options", [trying("arm_compliance", "channel_latency", "stribeck"), thorough(UNADVISED)], ids=["of some", "of all"]
)
def test_a_stage_that_gives_way_by_less_than_a_count_has_no_compliant_arm(options: DiagnosisOptions) -> None:
    """Runs of somebody else's plant: a jerk-limited motion under a position loop that answers to the force.

    Its friction fades within some milliseconds of a stop where the command stops at once, and nothing else is wrong.
    """
    yielding = diagnose(choose_runs(DATA / "yielding_stage"), MODEL, options)
    assert (yielding.verdict, yielding.effects) == (Verdict.NO_GAP, ())
    assert probability(yielding, "arm_compliance") < 0.1


@pytest.mark.parametrize(("bursts", "verdict"), [(12, Verdict.UNKNOWN), (3, Verdict.NO_GAP)])
def test_bursts_of_the_force_are_a_gap_and_a_few_are_none(tmp_path: Path, bursts: int, verdict: Verdict) -> None:
    """Where means over blocks show none: bumps of 35 mN for 50 ms, in the midst of steady motion or hold."""
    for number, file in enumerate(sorted((DATA / "yielding_stage").glob("*.h5"))):
        copied = shutil.copy(file, tmp_path)
        with h5py.File(copied, "r+") as run:
            trace = run["entry/trace"]
            calm = np.flatnonzero(np.isin(trace["phase"], (Phase.STEADY, Phase.HOLD)))
            width = round(0.05 / float(np.diff(trace["time"][:2])[0]))
            bump = 35.0 * np.sin(np.pi * np.arange(width) / width)
            for part in range(bursts // 6 + (number < bursts % 6)):
                begin = calm[len(calm) * (2 + part) // 4]
                trace["force"][begin : begin + width] += bump
    found = diagnose(choose_runs(tmp_path), MODEL, trying("stribeck", "folds"))
    assert (found.verdict, found.effects) == (verdict, ())
    if verdict is Verdict.UNKNOWN:
        assert found.unknown is not None
        assert re.match(r"1[0-2] bursts, typically of 3\d mN for 4\d ms", found.unknown.dependence)


def test_an_effect_is_named_with_its_size_and_closes_the_gap(diagnosis: Diagnosis) -> None:
    assert (diagnosis.verdict, diagnosis.effects) == (Verdict.EFFECT, ("stribeck",))
    first = diagnosis.ranking[0]
    assert (first.hypothesis, first.probability > 0.5) == ("stribeck", True)
    assert sum(hypothesis.probability for hypothesis in diagnosis.ranking) == pytest.approx(1.0)
    ratio = next(quantity for quantity in first.parameters if quantity.name == "ratio")
    assert 0 < ratio.standard_error < 0.5 * ratio.value
    assert diagnosis.where.location("channel").shares["force"] > 0.9
    assert diagnosis.shrink is not None
    assert diagnosis.shrink.closed is not None
    assert diagnosis.shrink.closed > 0.9
    assert diagnosis.shrink.gap_after_mN < 0.5 * diagnosis.shrink.gap_before_mN


@pytest.mark.parametrize("options", [OF_SOME, thorough(UNADVISED)], ids=["of some", "of all"])
def test_without_the_right_effect_the_answer_is_less_sure(
    options: DiagnosisOptions, diagnosed: DiagnosedCampaigns
) -> None:
    runs, diagnosis = diagnosed["stribeck"].selection, diagnosed["stribeck"].diagnosis
    case = diagnose(runs, MODEL, replace(options, excluded=(*options.excluded, "stribeck")))
    assert "stribeck" not in {hypothesis.hypothesis for hypothesis in case.ranking}
    if case.verdict is not Verdict.UNKNOWN:
        assert set(case.effects) <= {"adhesion", "film_depletion", "wall_lift_off"}
        assert case.ranking[0].probability < min(0.85, diagnosis.ranking[0].probability)
        assert case.confusable_with or case.residual_unknown
    assert case.unknown is not None
    assert "drag" in case.unknown.location


@pytest.mark.parametrize("campaign", ["unknown", thorough("unknown of all")])
def test_what_no_effect_explains_is_unknown_and_has_a_place(campaign: str, diagnosed: DiagnosedCampaigns) -> None:
    diagnosis = diagnosed[campaign].diagnosis
    assert (diagnosis.verdict, diagnosis.effects, diagnosis.model) == (Verdict.UNKNOWN, (), None)
    assert diagnosis.unknown is not None
    assert "force" in diagnosis.unknown.location
    assert "drag" in diagnosis.unknown.location


@pytest.mark.thorough
def test_a_table_that_shakes_slower_than_the_blocks_is_no_mere_noise(tmp_path: Path) -> None:
    """Noise is measured at rest, where the table shakes too: it must not pass for noise of the sensor."""
    shaken = diagnose(hidden(tmp_path, 29, "table_vibration"), MODEL, UNADVISED)
    assert shaken.verdict is Verdict.UNKNOWN
    assert shaken.unknown is not None
    assert "oscillation at about 3.5 Hz" in shaken.unknown.dependence
    assert "at rest" in shaken.unknown.location
    assert shaken.where.location("channel").shares["force"] > 0.9


def test_a_wrong_encoder_is_found_in_the_position(diagnosed: DiagnosedCampaigns) -> None:
    diagnosis = diagnosed["strayed position"].diagnosis
    assert diagnosis.effects == ("encoder_scale",)
    assert diagnosis.where.location("channel").shares["position"] > 0.9
    assert diagnosis.model is not None
    assert [effect.id for effect in diagnosis.model.effects] == ["encoder_scale"]


@pytest.mark.parametrize("campaign", ["two effects", thorough("two effects of all")])
def test_two_effects_are_both_named_though_one_is_louder(campaign: str, diagnosed: DiagnosedCampaigns) -> None:
    diagnosis = diagnosed[campaign].diagnosis
    assert diagnosis.verdict is Verdict.SEVERAL
    assert set(diagnosis.effects) == set(SECRETS[campaign].effects)
    assert diagnosis.ranking[0].hypothesis == "+".join(diagnosis.effects)


@pytest.mark.thorough
def test_the_amended_simulator_has_no_gap_to_its_own_model(diagnosis: Diagnosis, tmp_path: Path) -> None:
    from dragrig.config.settings import read_settings_file

    path = save_amended_model(diagnosis, tmp_path / "amended.toml")
    assert path is not None
    amended = read_settings_file(FrictionModelSettings, path)
    assert [effect.id for effect in amended.effects] == ["stribeck"]
    rig = parse_effects(["encoder_scale", "servo_lag", "mains_hum"])
    everything = amended.model_copy(update={"effects": (*amended.effects, *rig)})
    runs = simulated(everything)
    again = diagnose(runs, CapsuleModel(everything), trying("adhesion", "force_drift", "servo_lag"))
    assert again.verdict is Verdict.NO_GAP
    assert probability(again, "no_gap") > 0.9


@pytest.mark.parametrize(
    ("kinds", "message"),
    [
        (("relaxation",), {"No drag runs", "No Coulomb runs"}),
        thorough(("drag",), {"No relaxation runs", "No blank runs"}),
        thorough(("relaxation", "coulomb", "drag"), {"No blank runs"}),
    ],
)
def test_what_few_kinds_of_run_cannot_answer_is_said(kinds: tuple[str, ...], message: set[str]) -> None:
    runs = [experiment for experiment in choose_runs(CAMPAIGN).experiments if experiment.kind in kinds]
    diagnosis = diagnose(choose_runs(experiment.run for experiment in runs), MODEL, trying("stribeck"))
    assert diagnosis.runs == len(runs)
    for name in message:
        assert any(sentence.startswith(name) for sentence in diagnosis.limitations)
    assert json.loads(json.dumps(to_json_value(diagnosis_json(diagnosis))))["verdict"] == diagnosis.verdict


SINGLE = {
    "drag": "exclude an effect above [0-9.]+ mN in a drag at [0-9.]+ mm/s, and nothing elsewhere",
    "relaxation": "exclude an effect above [0-9.]+ mN in a relaxation at [0-9.]+ % strain, and nothing elsewhere",
    "blank": "in a blank run at [0-9.]+ mm/s",
    "coulomb": "in a Coulomb run at [0-9.]+ mm/s",
}


@pytest.mark.parametrize("kind", ["drag", *(thorough(kind) for kind in ("relaxation", "blank", "coulomb"))])
def test_a_single_run_is_diagnosed_as_far_as_it_goes(kind: str) -> None:
    experiment = next(experiment for experiment in choose_runs(CAMPAIGN).experiments if experiment.kind == kind)
    diagnosis = diagnose(choose_runs([experiment.run]), MODEL, trying("stribeck", "force_drift"))
    assert (diagnosis.runs, diagnosis.held_out, diagnosis.shrink) == (1, (), None)
    assert (diagnosis.verdict, diagnosis.effects, diagnosis.ranking) == (Verdict.OPEN, (), ())
    read = json.loads(json.dumps(to_json_value(diagnosis_json(diagnosis))))
    assert (read["verdict"], read["presence"], read["budget"]) == ("open", {}, [])
    assert re.search(SINGLE[kind], read["in_words"][0])
    page = diagnosis_document(diagnosis)
    assert (page.answer, *page.lead) == tuple(read["in_words"])
    assert "ranking" not in {figure.name for figure in page.figures()}
    of_many = campaigns_document([("one run", diagnosis, "")]).sections[0].blocks[0]
    assert isinstance(of_many, Table)
    assert re.match(f"open: the runs .*{SINGLE[kind]}", str(of_many.rows[0][1]))


@pytest.mark.thorough
def test_the_same_runs_give_the_same_answer() -> None:
    first, second = (dict(diagnosis_json(diagnose(choose_runs(CAMPAIGN), MODEL))) for _ in range(2))
    assert first.pop("timings_s") != second.pop("timings_s")
    assert json.dumps(first) == json.dumps(second)
