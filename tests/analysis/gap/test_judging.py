"""What a verdict makes of numbers: clear cases, and what holds in all of them."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dragrig.analysis.gap.classifier import judge, unknown_by_excess_alone, with_verdict
from dragrig.analysis.gap.diagnosis import NO_GAP, UNKNOWN, Classification, Verdict
from dragrig.analysis.gap.features import EXCHANGE, DecisionInputs, HypothesisSummary, NonparametricLaw
from dragrig.analysis.gap.isolability import DEFAULT_TOLERANCE_MN
from property_tests import examples

BLOCKS = 8000
NOISE = 8010.0
"""Squares that noise alone leaves of so many blocks."""
LOUD = 20_000.0


def hypothesis_of(
    name: str, chi2: float, change_mN: float = 5.0, with_form_error: float | None = None, before: float = LOUD
) -> HypothesisSummary:
    left = chi2 if with_form_error is None else with_form_error
    return HypothesisSummary((name,), chi2, left, change_mN, llr=0.5 * (before - chi2), chi2_without=before)


def case(chi2: float, *tried: HypothesisSummary, **more: object) -> DecisionInputs:
    return replace(DecisionInputs(BLOCKS, chi2, tried), **more)


def verdict_on(inputs: DecisionInputs, tolerance_mN: float) -> Classification:
    return judge(inputs, tolerance_mN).verdict


def pulled_by_a_cable(name: str) -> DecisionInputs:
    """Another form takes most of a very large gap; what it leaves is twenty times the noise, more than a free law."""
    whole = 333.0 * BLOCKS
    hypothesis = hypothesis_of(name, 154.0 * BLOCKS, 50.0, with_form_error=20.0 * BLOCKS, before=whole)
    return case(whole, hypothesis, laws=law_that_leaves(10.0 * BLOCKS))


def law_that_leaves(chi2: float) -> tuple[NonparametricLaw, ...]:
    """The best free law beside the nominal model, as every diagnosis has one."""
    return (NonparametricLaw("speed", chi2, 5.0),)


def beside(first: str, second: str, gain: float, left: float) -> HypothesisSummary:
    return HypothesisSummary((first, second), NOISE, NOISE, 5.0, llr=gain, chi2_without=left)


def test_what_was_left_out_although_it_resembles_what_is_named_stays_in_doubt() -> None:
    inputs = case(LOUD, hypothesis_of("stribeck", NOISE), excluded=("adhesion", "folds"))
    assert verdict_on(inputs, DEFAULT_TOLERANCE_MN).confusable_with == ("adhesion",)
    assert verdict_on(case(NOISE, excluded=("adhesion",)), DEFAULT_TOLERANCE_MN).confusable_with == ()


def test_two_are_not_named_in_the_place_of_one_that_was_left_out() -> None:
    both = case(
        LOUD, hypothesis_of("force_drift", 11_000.0), beside("force_drift", "mesentery_tether", 1400.0, 11_000.0)
    )
    assert set(verdict_on(both, DEFAULT_TOLERANCE_MN).effects) == {"force_drift", "mesentery_tether"}
    classification = verdict_on(replace(both, excluded=("film_depletion",)), DEFAULT_TOLERANCE_MN)
    assert (classification.effects, classification.confusable_with) == (("force_drift",), ("film_depletion",))
    assert (
        verdict_on(replace(both, excluded=("stribeck",)), DEFAULT_TOLERANCE_MN).effects
        == verdict_on(both, DEFAULT_TOLERANCE_MN).effects
    )


@pytest.mark.parametrize(
    ("inputs", "verdict", "effects"),
    [
        (case(NOISE), Verdict.NO_GAP, ()),
        (case(NOISE, hypothesis_of("folds", NOISE - 12, before=NOISE)), Verdict.NO_GAP, ()),
        (case(LOUD), Verdict.UNKNOWN, ()),
        (case(LOUD, hypothesis_of("folds", 0.9 * LOUD), laws=law_that_leaves(0.7 * LOUD)), Verdict.UNKNOWN, ()),
        (pulled_by_a_cable("force_drift"), Verdict.UNKNOWN, ()),
        (
            case(LOUD, hypothesis_of("stribeck", NOISE), hypothesis_of("adhesion", 14_000.0)),
            Verdict.EFFECT,
            ("stribeck",),
        ),
        (case(LOUD, hypothesis_of("stribeck", 9000.0, with_form_error=NOISE)), Verdict.EFFECT, ("stribeck",)),
        (
            case(LOUD, hypothesis_of("stribeck", 11_000.0), beside("stribeck", "folds", 1400.0, 11_000.0)),
            Verdict.SEVERAL,
            ("stribeck", "folds"),
        ),
        (
            case(LOUD, hypothesis_of("stribeck", NOISE), beside("stribeck", "folds", 6.0, NOISE)),
            Verdict.EFFECT,
            ("stribeck",),
        ),
        (case(NOISE, mains_llr=400.0), Verdict.EFFECT, ("mains_hum",)),
        (case(NOISE, mains_llr=400.0, excluded=("mains_hum",)), Verdict.UNKNOWN, ()),
        (case(NOISE, line_llr=400.0), Verdict.UNKNOWN, ()),
        (case(LOUD, hypothesis_of("stribeck", NOISE), mains_llr=400.0), Verdict.SEVERAL, ("stribeck", "mains_hum")),
        (case(NOISE, position=(("servo_lag", 0.99), ("velocity_ripple", 0.7)), has_position_error=True), Verdict.EFFECT,
         ("servo_lag",)),
        (case(NOISE, position=(("servo_lag", 0.5),), has_position_error=True), Verdict.UNKNOWN, ()),
        (case(NOISE, has_position_error=True), Verdict.UNKNOWN, ()),
        (
            case(LOUD, hypothesis_of("stribeck", NOISE), position=(("encoder_scale", 0.999),), has_position_error=True,
                 competition={"stribeck": 0.99}),
            Verdict.SEVERAL,
            ("stribeck", "encoder_scale"),
        ),
    ],
)  # fmt: skip
def test_clear_cases(inputs: DecisionInputs, verdict: Verdict, effects: tuple[str, ...]) -> None:
    classification = verdict_on(inputs, DEFAULT_TOLERANCE_MN)
    assert (classification.verdict, classification.effects) == (verdict, effects)
    best = "+".join(effects) or {Verdict.NO_GAP: NO_GAP, Verdict.UNKNOWN: UNKNOWN}[verdict]
    assert max(classification.probabilities, key=lambda name: classification.probabilities[name]) == best


def test_an_effect_as_large_as_it_can_be_is_named_only_if_it_explains_all_there_is() -> None:
    def at_its_limit(chi2: float) -> DecisionInputs:
        return case(LOUD, replace(hypothesis_of("stribeck", chi2, with_form_error=NOISE), at_limit=True))

    assert verdict_on(at_its_limit(NOISE + 200.0), DEFAULT_TOLERANCE_MN).effects == ("stribeck",)
    assert verdict_on(at_its_limit(11_000.0), DEFAULT_TOLERANCE_MN).verdict is Verdict.UNKNOWN


def test_beside_a_lagging_stage_an_effect_is_named_that_most_explanations_share() -> None:
    """None of three explanations is likely enough on its own, but all have the tether."""
    tether = HypothesisSummary(("mesentery_tether",), 12_000.0, 9500.0, 50.0, llr=50_000.0, chi2_without=110_000.0)
    further = [
        HypothesisSummary(("mesentery_tether", label), 10_000.0, 9000.0, 50.0, llr=60.0, chi2_without=12_000.0)
        for label in ("stribeck", "force_hysteresis")
    ]
    inputs = case(110_000.0, tether, *further, position=(("servo_lag", 0.99),), has_position_error=True)
    alone = verdict_on(replace(inputs, position=(), has_position_error=False), DEFAULT_TOLERANCE_MN)
    assert max(alone.probabilities.values()) < 0.6
    competition = {"mesentery_tether": 0.99, "stribeck": 0.3, "force_hysteresis": 0.3}
    classification = verdict_on(replace(inputs, competition=competition), DEFAULT_TOLERANCE_MN)
    assert classification.effects == ("mesentery_tether", "servo_lag")
    both, one_alone = (classification.probabilities[name] for name in ("mesentery_tether+servo_lag", "servo_lag"))
    assert one_alone < both < 0.99


def test_beside_a_wrong_scale_one_of_two_that_look_alike_is_named_and_the_other_said() -> None:
    """Neither is likely enough on its own, but one of them acts."""
    alike = (hypothesis_of("stribeck", NOISE), hypothesis_of("adhesion", NOISE + 500))
    inputs = case(LOUD, *alike, position=(("encoder_scale", 0.99),), has_position_error=True)
    alone = verdict_on(replace(inputs, position=(), has_position_error=False), DEFAULT_TOLERANCE_MN)
    assert max(alone.probabilities.values()) < 0.6
    competition = {"stribeck": 0.8, "adhesion": 0.2}
    classification = verdict_on(replace(inputs, competition=competition), DEFAULT_TOLERANCE_MN)
    assert classification.effects == ("stribeck", "encoder_scale")
    assert classification.confusable_with == ("adhesion",)
    assert sum(classification.probabilities.values()) == pytest.approx(1.0)


def test_an_effect_too_small_to_matter_is_no_gap() -> None:
    clear = hypothesis_of("stribeck", NOISE, change_mN=0.2, before=9000.0)
    assert verdict_on(case(9000.0, clear), 0.5).verdict is Verdict.NO_GAP
    assert verdict_on(case(9000.0, clear), 0.1).effects == ("stribeck",)


def test_two_that_explain_alike_are_told_as_confusable() -> None:
    classification = verdict_on(
        case(LOUD, hypothesis_of("stribeck", NOISE), hypothesis_of("adhesion", NOISE + 10)), DEFAULT_TOLERANCE_MN
    )
    assert {*classification.effects, *classification.confusable_with} == {"stribeck", "adhesion"}
    assert max(classification.probabilities.values()) < 0.7
    apart = verdict_on(
        case(LOUD, hypothesis_of("stribeck", NOISE), hypothesis_of("adhesion", 15_000.0)), DEFAULT_TOLERANCE_MN
    )
    assert apart.confusable_with == ()
    assert apart.probabilities["stribeck"] > 0.9


NAMES = st.sampled_from(["stribeck", "adhesion", "folds", "force_drift", "tissue_ageing", "arm_compliance"])
GAINS = st.floats(0.0, 1e5)
SHARES = st.floats(-1.0, 1.0)


@st.composite
def everything(draw: st.DrawFn) -> DecisionInputs:
    blocks = draw(st.integers(100, 20_000))
    squares = blocks * draw(st.floats(0.3, 50.0))
    left = st.floats(0.2, 1.05).map(lambda share: share * squares)
    periodic = draw(st.booleans())
    names = draw(st.lists(NAMES, max_size=3, unique=True))
    changed = st.floats(0.0, 50.0)
    tried = [
        HypothesisSummary((name,), draw(left), draw(left), draw(changed), periodic, draw(GAINS), squares)
        for name in names
    ]
    for name in draw(st.lists(st.just("peristalsis"), max_size=1 if names else 0)):
        both = (names[0], name)
        tried.append(HypothesisSummary(both, draw(left), draw(left), draw(changed), True, draw(GAINS), draw(left)))
    position = draw(st.lists(st.tuples(st.sampled_from(["servo_lag", "encoder_scale"]), SHARES), max_size=2))
    remaining = dict(position)
    return DecisionInputs(
        blocks, squares, tuple(tried), draw(GAINS), draw(GAINS),
        tuple(sorted(remaining.items(), key=lambda pair: -pair[1])), bool(remaining) or draw(st.booleans()),
        draw(st.sampled_from([(), ("mains_hum",)])),
    )  # fmt: skip


@settings(max_examples=examples(300), deadline=None)
@given(everything(), st.floats(0.0, 10.0))
def test_probabilities_are_shared_out_and_agree_with_the_verdict(inputs: DecisionInputs, tolerance_mN: float) -> None:
    classification = verdict_on(inputs, tolerance_mN)
    assert sum(classification.probabilities.values()) == pytest.approx(1.0)
    assert all(0.0 <= value <= 1.0 for value in classification.probabilities.values())
    assert classification == verdict_on(inputs, tolerance_mN)
    named = classification.verdict in {Verdict.EFFECT, Verdict.SEVERAL}
    assert bool(classification.effects) == named
    assert (len(classification.effects) > 1) == (classification.verdict is Verdict.SEVERAL)
    assert set(classification.effects).isdisjoint(inputs.excluded)
    assert set(classification.confusable_with).isdisjoint(classification.effects)
    if named:
        assert "+".join(classification.effects) in classification.probabilities
        assert not any("+" in name for name in classification.confusable_with)


def test_an_excess_that_nothing_predicts_is_told_from_one_that_a_law_does() -> None:
    louder = 1.2 * BLOCKS
    unexplained, by_speed = (
        case(louder, laws=laws) for laws in ((), (NonparametricLaw("speed", louder - 400.0, 5.0),))
    )
    for inputs, alone in ((unexplained, True), (by_speed, False), (case(NOISE), False)):
        classification = verdict_on(inputs, DEFAULT_TOLERANCE_MN)
        assert (classification.verdict is Verdict.UNKNOWN) is (inputs.chi2 == louder)
        assert unknown_by_excess_alone(inputs, classification, DEFAULT_TOLERANCE_MN) is alone
    unknown = verdict_on(unexplained, DEFAULT_TOLERANCE_MN)
    noise = with_verdict(unknown, Verdict.NO_GAP)
    assert noise.verdict is Verdict.NO_GAP
    assert noise.probabilities[NO_GAP] == unknown.probabilities[UNKNOWN]


def competed(inputs: DecisionInputs, by_model: float = 0.0, **probabilities: float) -> DecisionInputs:
    competition = {name.replace("exchange", EXCHANGE): value for name, value in probabilities.items()}
    return replace(inputs, competition=competition, by_model=dict.fromkeys(probabilities, by_model))


def test_an_effect_is_named_that_is_one_question_with_the_models_own_laws() -> None:
    stiffer = case(LOUD, hypothesis_of("preconditioning", 12_000.0), laws=law_that_leaves(10_500.0))
    assert 0.3 < verdict_on(stiffer, DEFAULT_TOLERANCE_MN).marginal("preconditioning") < 0.8
    apart, shared = (judge(competed(stiffer, by_model, preconditioning=0.02), 0.5) for by_model in (0.0, 0.9))
    assert apart.verdict.verdict is Verdict.UNKNOWN
    assert shared.verdict.effects == ("preconditioning",)
    assert apart.presence["preconditioning"] < 0.5 < shared.presence["preconditioning"]
    # That it is this one is no likelier.
    assert shared.verdict.probabilities == pytest.approx(apart.verdict.probabilities)


def test_beside_a_sure_exchange_nothing_is_named_that_comes_with_a_function_of_the_session() -> None:
    both = case(LOUD, hypothesis_of("tissue_ageing", 11_000.0), beside("tissue_ageing", "adhesion", 1400.0, 11_000.0))
    same, exchanged = (
        judge(competed(both, exchange=value, tissue_ageing=0.0, adhesion=0.0), 0.5).verdict for value in (0.9, 0.9999)
    )
    assert set(same.effects) == {"tissue_ageing", "adhesion"}
    assert (exchanged.verdict, exchanged.effects) == (Verdict.UNKNOWN, ())
    found = judge(competed(both, exchange=0.9999, tissue_ageing=0.0, adhesion=0.99), 0.5).verdict
    assert found.effects == ("adhesion",)


def test_no_effect_is_likelier_to_be_there_than_a_gap() -> None:
    judgement = judge(competed(case(NOISE), wall_lift_off=0.999), 0.5)
    assert judgement.presence["wall_lift_off"] <= 1.0 - judgement.verdict.probabilities[NO_GAP]


@pytest.mark.parametrize(("excess_left", "verdict"), [(0.03, Verdict.EFFECT), (0.4, Verdict.UNKNOWN)])
def test_what_is_not_established_gives_way_to_an_effect_that_explains_as_much(
    excess_left: float, verdict: Verdict
) -> None:
    best = replace(hypothesis_of("stribeck", NOISE), not_established="these runs do not tell it from another force")
    rival = hypothesis_of("force_hysteresis", NOISE + excess_left * (LOUD - NOISE))
    classification = verdict_on(case(LOUD, best, rival), DEFAULT_TOLERANCE_MN)
    assert classification.verdict is verdict
    assert "stribeck" not in classification.effects
    assert classification.probabilities["stribeck"] < 0.1
    assert sum(classification.probabilities.values()) == pytest.approx(1.0)
