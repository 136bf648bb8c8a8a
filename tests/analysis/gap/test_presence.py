"""Which causes are there, given all others, and how they share the gap: also where nothing, or something else, is."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from diagnosed import SECRETS, UNADVISED, DiagnosedCampaigns, trying
from dragrig.analysis.gap import DiagnosisOptions
from dragrig.analysis.gap.budget import CausesOfGap, likely_explanations
from dragrig.analysis.gap.classifier import combined_presence, restate
from dragrig.analysis.gap.design import Candidate
from dragrig.analysis.gap.diagnose import diagnose
from dragrig.analysis.gap.diagnosis import (
    NO_GAP,
    UNEXPLAINED,
    UNKNOWN,
    BudgetEntry,
    Classification,
    Diagnosis,
    GapBudget,
    Verdict,
)
from dragrig.analysis.gap.evaluation import PromiseVerdict, evaluate
from dragrig.analysis.gap.features import EXCHANGE, DecisionInputs, shipped_calibration
from dragrig.analysis.gap.forward_selection import search_effects
from dragrig.analysis.gap.position_channel import (
    analyse_position,
    contribution_to_position,
    position_errors,
    predicted_position_error,
)
from dragrig.analysis.gap.presence import Cause, CauseKind, Competition, Presence, prepare_competition, presence_of
from dragrig.analysis.gap.run_data import choose_runs
from dragrig.analysis.gap.studies import prepare_study
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.analysis.selection import RunSelection
from dragrig.config.friction_model import FrictionModelSettings, parse_effects
from dragrig.sim_backend.blind import draw_campaign, write_campaign
from dragrig.sim_backend.effects import Coordinate, catalogue, find_effect
from hidden import hidden, thinned, without_clock
from places import CAMPAIGN
from property_tests import thorough


def budget_of(diagnosis: Diagnosis) -> GapBudget:
    assert diagnosis.budget is not None
    return diagnosis.budget


def shares(budget: GapBudget) -> Mapping[str, float]:
    return {entry.cause: entry.share for entry in budget.entries}


def test_without_a_gap_nothing_is_there_and_nothing_is_shared(diagnosed: DiagnosedCampaigns) -> None:
    diagnosis = diagnosed["nothing"].diagnosis
    budget = budget_of(diagnosis)
    assert diagnosis.verdict is Verdict.NO_GAP
    assert budget.entries == ()
    assert budget.runs == ()
    assert max(budget.presence.values()) < 0.2


def test_a_single_effect_is_there_alone_and_has_nearly_all_of_the_gap(diagnosed: DiagnosedCampaigns) -> None:
    diagnosis = diagnosed["stribeck"].diagnosis
    budget = budget_of(diagnosis)
    assert diagnosis.effects == ("stribeck",)
    assert set(budget.presence) == set(catalogue())
    assert budget.presence["stribeck"] > 0.9
    assert sorted(budget.presence.values())[-2] < 0.5
    assert shares(budget)["stribeck"] == pytest.approx(1.0, abs=0.2)
    assert sum(shares(budget).values()) == pytest.approx(1.0)
    entry = budget.entries[0]
    assert entry.share_95ci is not None
    assert entry.share_95ci[0] <= entry.share <= entry.share_95ci[1]
    assert_runs_add_up(budget)


@pytest.mark.parametrize("campaign", ["two effects", thorough("two effects of all")])
def test_two_effects_share_the_gap_as_the_plant_has_them(campaign: str, diagnosed: DiagnosedCampaigns) -> None:
    diagnosis = diagnosed[campaign].diagnosis
    effects = set(SECRETS[campaign].effects)
    assert set(diagnosis.effects) == effects
    budget = budget_of(diagnosis)
    assert min(shares(budget)[name] for name in effects) > 0.1
    assert abs(shares(budget)[UNEXPLAINED]) < 0.2
    assert_runs_add_up(budget)


def assert_runs_add_up(budget: GapBudget) -> None:
    """The parts that each run shows are those whose shares and sizes the budget states."""
    # A run shows means over blocks, in which nothing of the mains is left.
    named = [entry for entry in budget.entries if entry.cause not in {UNEXPLAINED, "mains_hum"}]
    duration = sum(run.width_s.sum() for run in budget.runs)
    moments = [sum(run.width_s @ (run.parts[entry.cause] * run.gap) for run in budget.runs) for entry in named]
    squares = [sum(run.width_s @ run.parts[entry.cause] ** 2 for run in budget.runs) for entry in named]
    gap_square = budget.gap_mN**2 * duration
    assert [entry.share for entry in named] == pytest.approx([moment / gap_square for moment in moments])
    assert [entry.rms_mN for entry in named] == pytest.approx([np.sqrt(square / duration) for square in squares])
    assert all(run.unit == "mN" and run.time_s.shape == run.gap.shape for run in budget.runs)


@pytest.mark.thorough
def test_what_no_catalogue_has_is_an_unnamed_law(diagnosed: DiagnosedCampaigns) -> None:
    diagnosis = diagnosed["unknown law"].diagnosis
    budget = budget_of(diagnosis)
    laws = {name: value for name, value in inputs_of(diagnosis).competition.items() if name.startswith("place")}
    assert max(laws.values()) > 0.5
    assert diagnosis.effects == ()
    assert shares(budget)[UNEXPLAINED] > 0.5


@pytest.mark.thorough
def test_an_exchange_that_nobody_recorded_is_found_with_its_run_and_no_effect_named(tmp_path: Path) -> None:
    secret = draw_campaign(61010, effects=[], conditions=["exchanged, not recorded"])
    write_campaign(secret, tmp_path)
    diagnosis = diagnose(choose_runs(tmp_path), MODEL, UNADVISED)
    budget = budget_of(diagnosis)
    assert diagnosis.effects == ()
    assert inputs_of(diagnosis).competition[EXCHANGE] > 0.999
    before = sum(run.specimen == 0 for run in secret.runs)
    assert EXCHANGE + f" after run {before}" in {word for entry in budget.entries for word in entry.what.split(", ")}


@pytest.mark.thorough
def test_both_errors_of_a_position_are_named(tmp_path: Path) -> None:
    effects = ["encoder_scale", "velocity_ripple"]
    write_campaign(thinned(draw_campaign(71012, effects=effects, size=[1.0, 1.0], plant="drawn")), tmp_path)
    diagnosis = diagnose(choose_runs(tmp_path), MODEL, UNADVISED)
    assert (diagnosis.verdict, set(diagnosis.effects)) == (Verdict.SEVERAL, set(effects))
    budget = budget_of(diagnosis)
    assert min(budget.presence[name] for name in effects) > 0.9
    assert max(value for name, value in budget.presence.items() if name not in effects) < 0.5


@pytest.mark.parametrize(
    ("seed", "effect", "size"),
    [
        pytest.param(71000, "velocity_ripple", 1.0, marks=pytest.mark.thorough),
        (71001, "velocity_ripple", 1 / 3),
        pytest.param(71064, "velocity_ripple", 1.0, marks=pytest.mark.thorough),
        pytest.param(71004, "servo_lag", 1 / 3, marks=pytest.mark.thorough),
        pytest.param(71007, "encoder_scale", 1 / 3, marks=pytest.mark.thorough),
    ],
)
def test_a_ripple_is_found_whatever_its_amplitude_does_with_speed(
    tmp_path: Path, seed: int, effect: str, size: float
) -> None:
    """In the first three campaigns it acts in motion alone, or above a speed; in the others there is none."""
    write_campaign(thinned(draw_campaign(seed, effects=[effect], size=size, plant="drawn"), 2), tmp_path)
    best = analyse_position(choose_runs(tmp_path).experiments, tuple(catalogue().values())).model_classes[0]
    assert best.effect == effect
    assert best.held_out_share > 0.8


@pytest.mark.parametrize(
    ("share", "rms_mN", "interval", "left"),
    [
        (0.4, 5.0, (0.2, 0.6), True),
        (0.1, 5.0, (0.05, 0.2), False),
        (0.4, 0.3, (0.2, 0.6), False),
        (0.4, 5.0, (-0.1, 0.8), False),
    ],
)
def test_something_is_left_where_the_rest_is_surely_there_large_and_matters(
    share: float, rms_mN: float, interval: tuple[float, float], left: bool
) -> None:
    rest = BudgetEntry(UNEXPLAINED, "force", share, interval, rms_mN)
    budget = GapBudget({}, (BudgetEntry("folds", "force", 1.0 - share, None, 8.0), rest), 10.0, held_out=True)
    assert budget.leaves_more_than(0.15, 0.5) is left


def classified(**probabilities: float) -> Classification:
    named = {name.replace("__", "+"): value for name, value in probabilities.items()}
    return Classification(Verdict.UNKNOWN, (), named, ())


def test_named_effects_are_named_together() -> None:
    classification = classified(stribeck=0.6, no_gap=0.1, unknown=0.3)
    restated = restate(classification, {"stribeck": 0.9, "adhesion": 0.7, "folds": 0.1}, ["adhesion", "stribeck"])
    assert (restated.verdict, restated.effects) == (Verdict.SEVERAL, ("stribeck", "adhesion"))
    assert max(restated.probabilities, key=lambda name: restated.probabilities[name]) == "stribeck+adhesion"
    assert sum(restated.probabilities.values()) == pytest.approx(1.0)
    assert restated.probabilities[NO_GAP] == pytest.approx(0.1)


@pytest.mark.parametrize(("no_gap", "verdict"), [(0.9, Verdict.NO_GAP), (0.1, Verdict.UNKNOWN)])
def test_without_an_effect_present_nothing_is_named(no_gap: float, verdict: Verdict) -> None:
    restated = restate(classified(stribeck=0.9 - 0.9 * no_gap, no_gap=no_gap), {"stribeck": 0.3, "folds": 0.01}, [])
    assert (restated.verdict, restated.effects) == (verdict, ())
    stated = {Verdict.NO_GAP: NO_GAP, Verdict.UNKNOWN: UNKNOWN}[verdict]
    assert restated.probabilities[stated] == max(restated.probabilities.values())


def test_beside_a_spectral_line_the_probabilities_still_sum_to_one() -> None:
    classification = replace(
        classified(sensor_hum=0.5, sensor_hum__stribeck=0.3, no_gap=0.05, unknown=0.15), effects=("sensor_hum",)
    )
    restated = restate(classification, {"stribeck": 0.9}, ["stribeck"])
    assert restated.effects == ("stribeck", "sensor_hum")
    assert sum(restated.probabilities.values()) == pytest.approx(1.0)


def causes(selection: RunSelection) -> set[str]:
    tried = [effect for effect in catalogue().values() if effect.id in {"tissue_ageing", "force_drift", "stribeck"}]
    study = prepare_study(selection, MODEL, tried)
    return {cause.name for cause in prepare_competition(search_effects(study)).causes}


@pytest.fixture(scope="module")
def ageing(tmp_path_factory: pytest.TempPathFactory) -> RunSelection:
    return hidden(tmp_path_factory.mktemp("ageing"), 20, "tissue_ageing", every=7)


def test_without_a_clock_nothing_of_the_session_competes(ageing: RunSelection) -> None:
    of_session = {effect.id for effect in catalogue().values() if effect.coordinate is Coordinate.SESSION}
    assert {"session", "tissue_ageing", "stribeck"} <= causes(ageing)
    assert not causes(without_clock(ageing)) & {"session", *of_session}


def test_an_effect_of_the_session_cannot_be_judged_without_a_clock(ageing: RunSelection) -> None:
    model = FrictionModelSettings(effects=parse_effects(["tissue_ageing"]))
    (size,) = evaluate(without_clock(ageing), model).sizes
    assert (size.verdict, size.d_prime) == (PromiseVerdict.NO_POWER, 0.0)
    (known,) = evaluate(ageing, model).sizes
    assert known.d_prime > 0.0


@pytest.mark.parametrize(
    "options", [trying("force_hysteresis", "stribeck", "adhesion"), thorough(UNADVISED)], ids=["of some", "of all"]
)
def test_what_one_run_does_not_tell_from_a_force_in_motion_is_not_named(
    options: DiagnosisOptions, tmp_path: Path
) -> None:
    write_campaign(draw_campaign(75040, effects=("force_hysteresis",), conditions=("one run",)), tmp_path)
    diagnosis = diagnose(choose_runs(tmp_path), MODEL, options)
    assert (diagnosis.verdict, budget_of(diagnosis).presence) == (Verdict.OPEN, {})
    assert diagnosis.likeliest is not None
    assert diagnosis.likeliest.verdict is Verdict.UNKNOWN
    assert budget_of(diagnosis.likeliest).presence["force_hysteresis"] < 0.1
    (hypothesis,) = [entry for entry in inputs_of(diagnosis).hypotheses if entry.effects == ("force_hysteresis",)]
    assert "do not tell it from a force that changes" in hypothesis.not_established


def inputs_of(diagnosis: Diagnosis) -> DecisionInputs:
    assert diagnosis.decision_inputs is not None
    return diagnosis.decision_inputs


def compared(**log_odds: float) -> Presence:
    """Return the presence of causes by sets of them, whose names are joined by `__`."""
    kinds = {
        "hyperelastic_wall": CauseKind.EFFECT, "preconditioning": CauseKind.EFFECT, "stribeck": CauseKind.EFFECT,
        "laws of the model in relaxations": CauseKind.MODEL, "parameters of the model": CauseKind.MODEL,
        EXCHANGE: CauseKind.EXCHANGE,
    }  # fmt: skip
    short = {name.split()[0]: number for number, name in enumerate(kinds)}
    names = [Cause(name, kind, np.zeros(0, dtype=np.intp), np.zeros(0), (1.0,)) for name, kind in kinds.items()]
    sets = {tuple((short[name], 0) for name in key.split("__")): value for key, value in log_odds.items()}
    return presence_of(names, sets)


def test_the_model_is_in_the_place_of_what_acts_there_as_a_function_of_the_same() -> None:
    assert compared(laws=0.0).by_model == {"hyperelastic_wall": 1.0, "preconditioning": 1.0}
    assert compared(parameters__stribeck=0.0).by_model == {"hyperelastic_wall": 1.0, "preconditioning": 0.0}
    both = compared(hyperelastic_wall__laws=0.0, hyperelastic_wall=0.0, laws=0.0, stribeck=0.0)
    assert both.probabilities["hyperelastic_wall"] == pytest.approx(0.5)
    assert both.by_model == pytest.approx({"hyperelastic_wall": 0.25, "preconditioning": 0.5})
    assert compared(laws__exchange=0.0).by_model == {"hyperelastic_wall": 1.0, "preconditioning": 0.0}


def test_presence_grows_with_either_estimate() -> None:
    weights = shipped_calibration().presence

    def present(classifier: float, competition: float) -> float:
        on_force = classified(stribeck=classifier, no_gap=1 - classifier)
        return combined_presence(on_force, {"stribeck": competition, "place": 0.9}, weights)["stribeck"]

    grid = np.array([[present(old, new) for new in (0.1, 0.5, 0.9)] for old in (0.05, 0.5, 0.95)])
    assert np.all(np.diff(grid, axis=0) > 0)
    assert np.all(np.diff(grid, axis=1) > 0)
    assert present(1.0, 0.0) / (1.0 - present(1.0, 0.0)) < 0.1 * present(1.0, 1.0) / (1.0 - present(1.0, 1.0))
    assert present(0.0, 1.0) < 0.5


def causes_that_may_be(presence_of_effects: Mapping[str, float]) -> CausesOfGap:
    """Return a competition that is sure of both effects and of a wrong nominal model, and says what all say of them."""
    names = [*presence_of_effects, "laws of the model"]
    kinds = [*(CauseKind.EFFECT for _ in presence_of_effects), CauseKind.MODEL]
    columns = [np.array([number]) for number in range(len(names))]
    causes = tuple(
        Cause(name, kind, own, np.ones(1), (1.0,)) for name, kind, own in zip(names, kinds, columns, strict=True)
    )
    together = tuple((number, 0) for number in range(len(names)))
    presence = Presence(
        dict.fromkeys(names, 1.0), dict(zip(names, kinds, strict=True)), {(): 0.0, together: 50.0, together[:1]: 10.0}
    )
    competition = Competition(causes, np.zeros((1, 1)))
    return CausesOfGap(competition, presence, presence_of_effects)  # type: ignore[arg-type]


def test_intervals_know_of_explanations_without_what_may_not_be_there() -> None:
    established = {"folds": 0.97, "adhesion": 0.6}
    causes = causes_that_may_be(established)
    chosen = ((0, 0), (1, 0), (2, 0))
    weights = likely_explanations(causes, chosen, established)

    def probability(number: int) -> float:
        return sum(weight for key, weight in weights.items() if number in {index for index, _ in key})

    assert sum(weights.values()) == pytest.approx(1.0)
    assert probability(0) == pytest.approx(1.0)
    assert probability(1) == pytest.approx(0.6)
    assert probability(2) == pytest.approx(0.5)


@pytest.mark.parametrize(("share", "expected"), [(2.5, 2.5), (-1.0, 0.0)], ids=["other amplitude", "other sign"])
def test_what_an_effect_adds_to_the_position_has_an_amplitude_in_each_run(share: float, expected: float) -> None:
    campaign = CAMPAIGN
    runs = position_errors(choose_runs(campaign, None).experiments)
    moving = next(run for run in runs if run.top_speed_mm_s > 1)
    lag = find_effect("servo_lag")
    candidate = Candidate(lag, lag.defaults)
    alone = predicted_position_error(candidate, moving)
    assert np.abs(alone).max() > 0
    added = contribution_to_position(candidate, replace(moving, error_mm=share * alone))
    assert np.allclose(added, expected * alone)
