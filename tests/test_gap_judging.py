"""What a verdict makes of numbers: clear cases, and what holds in all of them."""

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dragrig.analysis.gap.classifier import NO_GAP, UNKNOWN, classify
from dragrig.analysis.gap.diagnosis import Verdict
from dragrig.analysis.gap.features import DecisionInputs, HypothesisSummary
from dragrig.analysis.gap.isolability import DEFAULT_TOLERANCE_MN

BLOCKS = 8000
NOISE = 8010.0
"""Squares that noise alone leaves of so many blocks."""
LOUD = 20_000.0


def one(
    name: str, squares: float, changed_mN: float = 5.0, flexible: float | None = None, before: float = LOUD
) -> HypothesisSummary:
    left = squares if flexible is None else flexible
    return HypothesisSummary((name,), squares, left, changed_mN, gain=0.5 * (before - squares), left=before)


def case(squares: float, *tried: HypothesisSummary, **more: object) -> DecisionInputs:
    return replace(DecisionInputs(BLOCKS, squares, tried), **more)


def pulled_by_a_cable(name: str) -> DecisionInputs:
    """Another form takes most of a very large gap, and what it leaves is still twenty times the noise."""
    whole = 333.0 * BLOCKS
    return case(whole, one(name, 154.0 * BLOCKS, 50.0, flexible=20.0 * BLOCKS, before=whole))


def beside(first: str, second: str, gain: float, left: float) -> HypothesisSummary:
    return HypothesisSummary((first, second), NOISE, NOISE, 5.0, gain=gain, left=left, rival_gain=10.0)


def test_what_was_left_out_although_it_resembles_what_is_named_stays_in_doubt() -> None:
    found = case(LOUD, one("stribeck", NOISE), without=("adhesion", "folds"))
    assert classify(found, DEFAULT_TOLERANCE_MN).confusable_with == ("adhesion",)
    assert classify(case(NOISE, without=("adhesion",)), DEFAULT_TOLERANCE_MN).confusable_with == ()


def test_two_are_not_named_in_the_place_of_one_that_was_left_out() -> None:
    both = case(LOUD, one("force_drift", 11_000.0), beside("force_drift", "mesentery_tether", 1400.0, 11_000.0))
    assert set(classify(both, DEFAULT_TOLERANCE_MN).effects) == {"force_drift", "mesentery_tether"}
    judged = classify(replace(both, without=("film_depletion",)), DEFAULT_TOLERANCE_MN)
    assert (judged.effects, judged.confusable_with) == (("force_drift",), ("film_depletion",))
    assert (
        classify(replace(both, without=("stribeck",)), DEFAULT_TOLERANCE_MN).effects
        == classify(both, DEFAULT_TOLERANCE_MN).effects
    )


@pytest.mark.parametrize(
    ("found", "verdict", "effects"),
    [
        (case(NOISE), Verdict.NO_GAP, ()),
        (case(NOISE, one("folds", NOISE - 12, before=NOISE)), Verdict.NO_GAP, ()),
        (case(LOUD), Verdict.UNKNOWN, ()),
        (case(LOUD, one("folds", 0.9 * LOUD)), Verdict.UNKNOWN, ()),
        (pulled_by_a_cable("force_drift"), Verdict.UNKNOWN, ()),
        (case(LOUD, one("stribeck", NOISE), one("adhesion", 14_000.0)), Verdict.EFFECT, ("stribeck",)),
        (case(LOUD, one("stribeck", 9000.0, flexible=NOISE)), Verdict.EFFECT, ("stribeck",)),
        (
            case(LOUD, one("stribeck", 11_000.0), beside("stribeck", "folds", 1400.0, 11_000.0)),
            Verdict.SEVERAL,
            ("stribeck", "folds"),
        ),
        (
            case(LOUD, one("stribeck", NOISE), beside("stribeck", "folds", 6.0, NOISE)),
            Verdict.EFFECT,
            ("stribeck",),
        ),
        (case(NOISE, mains_gain=400.0), Verdict.EFFECT, ("mains_hum",)),
        (case(NOISE, mains_gain=400.0, without=("mains_hum",)), Verdict.UNKNOWN, ()),
        (case(NOISE, line_gain=400.0), Verdict.UNKNOWN, ()),
        (case(LOUD, one("stribeck", NOISE), mains_gain=400.0), Verdict.SEVERAL, ("stribeck", "mains_hum")),
        (case(NOISE, position=(("servo_lag", 0.99), ("velocity_ripple", 0.7)), strays=True), Verdict.EFFECT,
         ("servo_lag",)),
        (case(NOISE, position=(("servo_lag", 0.5),), strays=True), Verdict.UNKNOWN, ()),
        (case(NOISE, strays=True), Verdict.UNKNOWN, ()),
        (
            case(LOUD, one("stribeck", NOISE), position=(("encoder_scale", 0.999),), strays=True),
            Verdict.SEVERAL,
            ("encoder_scale", "stribeck"),
        ),
    ],
)  # fmt: skip
def test_clear_cases(found: DecisionInputs, verdict: Verdict, effects: tuple[str, ...]) -> None:
    judged = classify(found, DEFAULT_TOLERANCE_MN)
    assert (judged.verdict, judged.effects) == (verdict, effects)
    best = "+".join(effects) or {Verdict.NO_GAP: NO_GAP, Verdict.UNKNOWN: UNKNOWN}[verdict]
    assert max(judged.probabilities, key=lambda name: judged.probabilities[name]) == best


def test_an_effect_as_large_as_it_can_be_is_named_only_if_it_explains_all_there_is() -> None:
    def at_its_limit(squares: float) -> DecisionInputs:
        return case(LOUD, replace(one("stribeck", squares, flexible=NOISE), at_limit=True))

    assert classify(at_its_limit(NOISE + 200.0), DEFAULT_TOLERANCE_MN).effects == ("stribeck",)
    assert classify(at_its_limit(11_000.0), DEFAULT_TOLERANCE_MN).verdict is Verdict.UNKNOWN


def test_beside_a_lagging_stage_an_effect_is_named_that_most_explanations_share() -> None:
    """None of three explanations is likely enough on its own, but all have the tether."""
    tether = HypothesisSummary(("mesentery_tether",), 12_000.0, 9500.0, 50.0, gain=50_000.0, left=110_000.0)
    further = [
        HypothesisSummary(
            ("mesentery_tether", other), 10_000.0, 9000.0, 50.0, gain=60.0, left=12_000.0, rival_gain=55.0
        )
        for other in ("stribeck", "force_hysteresis")
    ]
    found = case(110_000.0, tether, *further, position=(("servo_lag", 0.99),), strays=True)
    alone = classify(replace(found, position=(), strays=False), DEFAULT_TOLERANCE_MN)
    assert max(alone.probabilities.values()) < 0.6
    judged = classify(found, DEFAULT_TOLERANCE_MN)
    assert judged.effects == ("servo_lag", "mesentery_tether")
    both, one_alone = (judged.probabilities[name] for name in ("servo_lag+mesentery_tether", "servo_lag"))
    assert 0.6 < both < 0.99
    assert both + one_alone + judged.probabilities[UNKNOWN] == pytest.approx(1.0)


def test_beside_a_wrong_scale_one_of_two_that_look_alike_is_named_and_the_other_said() -> None:
    """Neither is likely enough on its own, but one of them acts."""
    alike = (one("stribeck", NOISE), one("adhesion", NOISE + 500))
    found = case(LOUD, *alike, position=(("encoder_scale", 0.99),), strays=True)
    alone = classify(replace(found, position=(), strays=False), DEFAULT_TOLERANCE_MN)
    assert max(alone.probabilities.values()) < 0.6
    judged = classify(found, DEFAULT_TOLERANCE_MN)
    assert judged.effects[0] == "encoder_scale"
    assert {*judged.effects[1:], *judged.confusable_with} == {"stribeck", "adhesion"}
    assert sum(judged.probabilities.values()) == pytest.approx(1.0)


def test_an_effect_too_small_to_matter_is_no_gap() -> None:
    clear = one("stribeck", NOISE, changed_mN=0.2, before=9000.0)
    assert classify(case(9000.0, clear), 0.5).verdict is Verdict.NO_GAP
    assert classify(case(9000.0, clear), 0.1).effects == ("stribeck",)


def test_two_that_explain_alike_are_told_as_confusable() -> None:
    judged = classify(case(LOUD, one("stribeck", NOISE), one("adhesion", NOISE + 10)), DEFAULT_TOLERANCE_MN)
    assert {*judged.effects, *judged.confusable_with} == {"stribeck", "adhesion"}
    assert max(judged.probabilities.values()) < 0.7
    apart = classify(case(LOUD, one("stribeck", NOISE), one("adhesion", 15_000.0)), DEFAULT_TOLERANCE_MN)
    assert apart.confusable_with == ()
    assert apart.probabilities["stribeck"] > 0.9


def test_what_is_left_beside_a_clear_effect_is_told() -> None:
    judged = classify(case(60_000.0, one("stribeck", 17_000.0, before=60_000.0)), DEFAULT_TOLERANCE_MN)
    assert judged.effects == ("stribeck",)
    assert judged.residual_unknown


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
        HypothesisSummary((name,), draw(left), draw(left), draw(changed), periodic, draw(GAINS), squares, 0.0)
        for name in names
    ]
    for name in draw(st.lists(st.just("peristalsis"), max_size=1 if names else 0)):
        both = (names[0], name)
        tried.append(
            HypothesisSummary(both, draw(left), draw(left), draw(changed), True, draw(GAINS), draw(left), draw(GAINS))
        )
    position = draw(st.lists(st.tuples(st.sampled_from(["servo_lag", "encoder_scale"]), SHARES), max_size=2))
    kept = dict(position)
    return DecisionInputs(
        blocks, squares, tuple(tried), draw(GAINS), draw(GAINS),
        tuple(sorted(kept.items(), key=lambda pair: -pair[1])), bool(kept) or draw(st.booleans()),
        draw(st.sampled_from([(), ("mains_hum",)])),
    )  # fmt: skip


@settings(max_examples=300, deadline=None)
@given(everything(), st.floats(0.0, 10.0))
def test_probabilities_are_shared_out_and_agree_with_the_verdict(found: DecisionInputs, tolerance_mN: float) -> None:
    judged = classify(found, tolerance_mN)
    assert sum(judged.probabilities.values()) == pytest.approx(1.0)
    assert all(0.0 <= one <= 1.0 for one in judged.probabilities.values())
    assert judged == classify(found, tolerance_mN)
    named = judged.verdict in {Verdict.EFFECT, Verdict.SEVERAL}
    assert bool(judged.effects) == named
    assert (len(judged.effects) > 1) == (judged.verdict is Verdict.SEVERAL)
    assert set(judged.effects).isdisjoint(found.without)
    assert set(judged.confusable_with).isdisjoint(judged.effects)
    if named:
        assert "+".join(judged.effects) in judged.probabilities
        assert not any("+" in one for one in judged.confusable_with)
