"""A diagnosis from run files to the answer: nothing, an effect, two, something that nobody knows, and the way back."""

import json
from pathlib import Path

import pytest
from hidden import hidden, simulated

from dragrig.analysis.gap.diagnose import DiagnosisOptions, diagnose
from dragrig.analysis.gap.diagnosis import Diagnosis, Verdict
from dragrig.analysis.gap.run_selection import choose_runs
from dragrig.analysis.models.capsule_model import MODEL, CapsuleModel
from dragrig.analysis.selection import RunSelection
from dragrig.api.diagnose import save_amended_model
from dragrig.config.friction_model import FrictionModelSettings, parse_effects
from dragrig.present.diagnosis import diagnosis_json

PRACTICE = Path(__file__).parent / "data" / "campaign"
NUMBERED = {path.name.split("-")[1].removesuffix(".h5"): path for path in sorted(PRACTICE.glob("*.h5"))}


@pytest.fixture(scope="module")
def stribeck(tmp_path_factory: pytest.TempPathFactory) -> RunSelection:
    return hidden(tmp_path_factory.mktemp("stribeck"), 12, "stribeck")


@pytest.fixture(scope="module")
def found(stribeck: RunSelection) -> Diagnosis:
    return diagnose(stribeck, MODEL)


def probability(diagnosis: Diagnosis, hypothesis: str) -> float:
    return sum(one.probability for one in diagnosis.ranking if one.hypothesis == hypothesis)


def test_a_campaign_without_a_gap_says_what_would_have_been_seen(tmp_path: Path) -> None:
    nothing = diagnose(hidden(tmp_path, 11), MODEL)
    assert nothing.verdict is Verdict.NO_GAP
    assert (nothing.effects, nothing.model) == ((), None)
    assert probability(nothing, "no_gap") > 0.5
    assert 0.1 < nothing.would_have_seen_mN < 10
    assert set(nothing.where.location("channel").shares.values()) == {0.0}
    assert nothing.shrink is not None
    assert nothing.shrink.closed is None


def test_an_effect_is_named_with_its_size_and_closes_the_gap(found: Diagnosis) -> None:
    assert (found.verdict, found.effects) == (Verdict.EFFECT, ("stribeck",))
    first = found.ranking[0]
    assert (first.hypothesis, first.probability > 0.5) == ("stribeck", True)
    assert sum(one.probability for one in found.ranking) == pytest.approx(1.0)
    ratio = next(one for one in first.parameters if one.name == "ratio")
    assert 0 < ratio.standard_error < 0.5 * ratio.value
    assert found.where.location("channel").shares["force"] > 0.9
    assert found.shrink is not None
    assert found.shrink.closed is not None
    assert found.shrink.closed > 0.9
    assert found.shrink.gap_after_mN < 0.5 * found.shrink.gap_before_mN


def test_without_the_right_effect_the_answer_is_less_sure(stribeck: RunSelection, found: Diagnosis) -> None:
    other = diagnose(stribeck, MODEL, DiagnosisOptions(without=("stribeck",)))
    assert "stribeck" not in {one.hypothesis for one in other.ranking}
    if other.verdict is not Verdict.UNKNOWN:
        assert set(other.effects) <= {"adhesion", "film_depletion", "wall_lift_off"}
        assert other.ranking[0].probability < min(0.85, found.ranking[0].probability)
        assert other.confusable_with or other.residual_unknown
    assert other.unknown is not None
    assert "drag" in other.unknown.lives_in


def test_what_no_effect_explains_is_unknown_and_has_a_place(tmp_path: Path) -> None:
    told = diagnose(hidden(tmp_path, 18, "stick_slip"), MODEL)
    assert (told.verdict, told.effects, told.model) == (Verdict.UNKNOWN, (), None)
    assert told.unknown is not None
    assert "force" in told.unknown.lives_in
    assert "drag" in told.unknown.lives_in


def test_a_table_that_shakes_slower_than_the_blocks_is_no_mere_noise(tmp_path: Path) -> None:
    """Noise is measured at rest, where the table shakes too: it must not pass for noise of the sensor."""
    shaken = diagnose(hidden(tmp_path, 29, "table_vibration"), MODEL)
    assert shaken.verdict is Verdict.UNKNOWN
    assert shaken.unknown is not None
    assert "swing at about 3.5 Hz" in shaken.unknown.shape
    assert "stands still" in shaken.unknown.lives_in
    assert shaken.where.location("channel").shares["force"] > 0.9


def test_a_wrong_encoder_is_found_in_the_position(tmp_path: Path) -> None:
    told = diagnose(hidden(tmp_path, 14, "encoder_scale"), MODEL)
    assert told.effects == ("encoder_scale",)
    assert told.where.location("channel").shares["position"] > 0.9
    assert told.model is not None
    assert [one.id for one in told.model.effects] == ["encoder_scale"]


def test_two_effects_are_both_named(tmp_path: Path) -> None:
    told = diagnose(hidden(tmp_path, 20, "arm_compliance", "film_depletion"), MODEL)
    assert told.verdict is Verdict.SEVERAL
    assert set(told.effects) == {"arm_compliance", "film_depletion"}
    assert told.ranking[0].hypothesis == "+".join(told.effects)


def test_the_amended_simulator_has_no_gap_to_its_own_model(found: Diagnosis, tmp_path: Path) -> None:
    from dragrig.config.settings import load_settings

    path = save_amended_model(found, tmp_path / "amended.toml")
    assert path is not None
    amended = load_settings(FrictionModelSettings, path)
    assert [one.id for one in amended.effects] == ["stribeck"]
    rig = parse_effects(["encoder_scale", "servo_lag", "mains_hum"])
    everything = amended.model_copy(update={"effects": (*amended.effects, *rig)})
    runs = simulated(everything)
    again = diagnose(runs, CapsuleModel(everything))
    assert again.verdict is Verdict.NO_GAP
    assert probability(again, "no_gap") > 0.9


@pytest.mark.parametrize(
    ("kinds", "said"),
    [
        (("relaxation",), {"Without drag runs", "Without Coulomb runs"}),
        (("drag",), {"Without relaxations", "Without blank runs"}),
        (("relaxation", "coulomb", "drag"), {"Without blank runs"}),
    ],
)
def test_what_few_kinds_of_run_cannot_answer_is_said(kinds: tuple[str, ...], said: set[str]) -> None:
    runs = [one for one in choose_runs(PRACTICE).experiments if one.kind in kinds]
    told = diagnose(choose_runs(one.run for one in runs), MODEL)
    assert told.runs == len(runs)
    for one in said:
        assert any(sentence.startswith(one) for sentence in told.cannot_answer)
    assert json.loads(json.dumps(diagnosis_json(told)))["verdict"] == told.verdict


@pytest.mark.parametrize("kind", sorted(NUMBERED))
def test_a_single_run_is_diagnosed_as_far_as_it_goes(kind: str) -> None:
    one = next(one for one in choose_runs(PRACTICE).experiments if one.kind == kind)
    told = diagnose(choose_runs([one.run]), MODEL)
    assert (told.runs, told.held_out, told.shrink) == (1, (), None)
    assert any("none can be kept back" in sentence for sentence in told.cannot_answer)
    assert sum(one.probability for one in told.ranking) == pytest.approx(1.0)
    json.dumps(diagnosis_json(told))


def test_the_same_runs_give_the_same_answer() -> None:
    first, second = (dict(diagnosis_json(diagnose(choose_runs(PRACTICE), MODEL))) for _ in range(2))
    assert first.pop("timings_s") != second.pop("timings_s")
    assert json.dumps(first) == json.dumps(second)
