"""The scorer of diagnoses."""

import json
from html.parser import HTMLParser
from math import inf

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dragrig.config.errors import AnalysisError
from dragrig.present.exam import exam_document, score_json
from dragrig.present.html_page import render_page
from dragrig.present.numbers import to_json_value
from dragrig.present.terminal import document_text
from dragrig.scoring import score_exam
from exams import diagnosis_record, large_exam, truth
from property_tests import thorough

PAIRS = [
    ("right", truth("stribeck"), diagnosis_record("stribeck")),
    ("other name", truth("stribeck"), diagnosis_record("adhesion", p=0.95)),
    ("lag in the wrong channel", truth("servo_lag"), diagnosis_record("servo_lag", channel="force")),
    ("latency in either channel", truth("channel_latency"), diagnosis_record("channel_latency", channel="position")),
    ("a third", truth("folds", size=1 / 3), diagnosis_record("folds")),
    ("tiny, not seen", truth("folds", size=0.1), diagnosis_record(verdict="no_gap")),
    ("tiny, called something else", truth("folds", size=0.1), diagnosis_record("mains_hum", p=0.6)),
    ("nothing", truth(), diagnosis_record(verdict="no_gap")),
    ("false alarm", truth(), diagnosis_record("folds", p=0.55)),
    ("foreign", truth(outside=True), diagnosis_record(verdict="unknown")),
    ("foreign, named", truth(outside=True), diagnosis_record("folds", p=0.7)),
    ("pair", truth("folds", "servo_lag"), diagnosis_record("servo_lag", "folds")),
    ("half a pair", truth("folds", "servo_lag"), diagnosis_record("folds", p=0.95)),
    ("rough", truth("adhesion", rough=True), diagnosis_record("adhesion")),
    ("rough nothing", truth(rough=True), diagnosis_record(verdict="unknown", p=0.4)),
]


def test_every_rate_counts_what_it_says() -> None:
    result = score_exam(PAIRS)
    counts = {rate.name: (rate.held, rate.count) for rate in result.rates}
    assert counts == {
        "full size, right name": (3, 4),
        "full size, right name alone": (3, 4),
        "full size, right channel": (3, 4),
        "a third, right name": (1, 1),
        "a tenth, right name or no gap": (1, 2),
        "none, no gap": (1, 2),
        "outside, unknown": (1, 2),
        "outside, a name above 0.5": (1, 2),
        "pair, both named": (1, 2),
        "pair, one named": (2, 2),
        "rough, right name": (1, 1),
        "rough, none, no gap": (0, 1),
        "all, wrong above 0.8": (1, 15),
        "above 0.8, right": (9, 11),
    }
    assert [case.name for case in result.missed] == [
        "other name", "tiny, called something else", "false alarm", "foreign, named", "half a pair", "rough nothing",
    ]  # fmt: skip


def test_stated_shares_and_presences_are_compared_with_the_plants_own() -> None:
    def share(cause: str, part: float, channel: str = "force", **more: object) -> dict[str, object]:
        return {"cause": cause, "share": part, "channel": channel, **more}

    truths = {
        "pair": {"budget": [share("stribeck", 0.6), share("folds", 0.4), share("servo_lag", 1.0, "position")]},
        "foreign": {"budget": [share("outside", 1.0)]},
    }
    said = {
        "pair": [share("stribeck", 0.65, share_95ci=[0.5, 0.62]), share("folds", 0.35, share_95ci=[0.3, 0.38]),
                 share("unexplained", 0.0), share("servo_lag", 0.7, "position"),
                 share("unexplained", 0.3, "position")],
        "foreign": [share("unexplained", 0.55, channel=""),
                    share("stribeck+adhesion", 0.45, channel="", not_separable_from=["film_depletion"])],
    }  # fmt: skip
    pairs = [
        ("pair", truth("stribeck", "folds", "servo_lag"),
         {**diagnosis_record("stribeck", "folds"), "budget": said["pair"],
          "presence": {"stribeck": 0.99, "folds": 0.6, "adhesion": 0.05}}),
        ("foreign", truth(outside=True),
         {**diagnosis_record(verdict="unknown"), "budget": said["foreign"], "presence": {"stribeck": 0.96}}),
        ("no truth", truth(), {**diagnosis_record(verdict="no_gap"), "budget": [share("unexplained", 1.0)]}),
    ]  # fmt: skip
    result = score_exam(pairs, budgets=truths)
    counts = {rate.name: (rate.held, rate.count) for rate in result.rates if rate.name.startswith(("bud", "pres"))}
    assert counts == {
        "budget, share within 0.1": (3, 7),
        "budget, share in its 95 % interval": (1, 2),
        "presence 0 to 0.1, there": (0, 1),
        "presence 0.5 to 0.8, there": (1, 1),
        "presence 0.95 to 1, there": (1, 2),
    }
    joint = [share("stribeck", 1.0, not_separable_from=["folds"])]
    [rate] = [
        rate
        for rate in score_exam([("pair", pairs[0][1], {**pairs[0][2], "budget": joint})], budgets=truths).rates
        if rate.name == "budget, share within 0.1"
    ]
    assert (rate.held, rate.count) == (1, 1)


def test_under_a_condition_the_condition_itself_may_be_named_and_rates_are_its_own() -> None:
    off = {**truth(rough=True), "case": "model off none", "conditions": ["laws 10 % off"],
           "also_right": ["specimen", "model"]}  # fmt: skip
    hum = {**truth(), "case": "noise none", "conditions": ["hum"], "also_right": ["mains_hum"]}
    model, rest = ({"cause": cause, "share": share} for cause, share in (("model", 0.7), ("unexplained", 0.3)))
    unknown = diagnosis_record(verdict="unknown")
    pairs = [
        ("no gap", off, diagnosis_record(verdict="no_gap")),
        ("the model", off, {**unknown, "budget": [rest, model]}),
        ("unexplained", off, {**unknown, "budget": [{**rest, "share": 0.8}, {**model, "share": 0.2}]}),
        ("no budget", off, unknown),
        ("a wall", off, {**diagnosis_record("hyperelastic_wall", p=0.9), "budget": [model]}),
        ("the hum", hum, diagnosis_record("mains_hum")),
        ("more than the hum", hum, diagnosis_record("mains_hum", "force_drift")),
        ("an effect", {**truth("folds"), "case": "noise", "conditions": ["jitter"]}, diagnosis_record("folds")),
    ]
    result = score_exam(pairs)
    counts = {rate.name: (rate.held, rate.count) for rate in result.rates if rate.count}
    assert counts == {
        "model off, none, no gap": (2, 5),
        "noise, right name": (1, 1),
        "noise, none, no gap": (1, 2),
        "all, wrong above 0.8": (4, 8),
        "above 0.8, right": (4, 8),
    }
    assert [case.name for case in result.missed] == ["unexplained", "no budget", "a wall", "more than the hum"]


def test_the_interval_is_wilsons() -> None:
    pairs = [(str(at), truth("folds"), diagnosis_record("folds" if at else "adhesion")) for at in range(40)]
    rate = score_exam(pairs)["full size, right name"]
    assert (rate.held, rate.count) == (39, 40)
    assert (rate.low, rate.high) == (pytest.approx(0.871, abs=0.001), pytest.approx(0.996, abs=0.001))


def test_a_rate_without_cases_is_left_out_of_the_table() -> None:
    result = score_exam(PAIRS[:1])
    assert result["outside, unknown"].count == 0
    text = document_text(exam_document(result, 1, 7, "0" * 64))
    assert "outside, unknown" not in text
    assert "full size, right name" in text
    assert "1.00" in text


def test_a_diagnosis_that_breaks_the_format_is_refused_by_name() -> None:
    with pytest.raises(AnalysisError, match=r"0007: the diagnosis cannot be scored because verdict"):
        score_exam([("0007", truth("folds"), {"verdict": "perhaps"})])


@given(st.lists(st.sampled_from(PAIRS), min_size=1, max_size=30))
def test_rates_lie_within_their_intervals_and_do_not_depend_on_order(pairs: list[tuple[str, dict, dict]]) -> None:  # type: ignore[type-arg]
    result, turned = score_exam(pairs), score_exam(pairs[::-1])
    assert [(rate.held, rate.count) for rate in result.rates] == [(rate.held, rate.count) for rate in turned.rates]
    for rate in result.rates:
        assert not rate.count or rate.low - 1e-9 <= rate.share <= rate.high + 1e-9


def test_without_its_effect_a_diagnosis_is_right_with_unknown_or_with_a_doubted_alias() -> None:
    arguments = {
        "unknown": diagnosis_record(verdict="unknown"),
        "alias, unsure": diagnosis_record("adhesion", p=0.45),
        "alias, sure": diagnosis_record("adhesion", p=0.7),
        "alias, others not told from it": diagnosis_record("adhesion", p=0.7, confusable=("film_depletion",)),
        "no alias": diagnosis_record("folds", p=0.4),
        "no gap": diagnosis_record(verdict="no_gap"),
    }
    pairs = [(name, truth("stribeck"), diagnosis_record("stribeck")) for name in arguments]
    arguments["tiny"], small = (
        diagnosis_record(verdict="no_gap"),
        ("tiny", truth("stribeck", size=0.1), diagnosis_record("stribeck")),
    )
    result = score_exam([*pairs, small], withheld=arguments)
    answer = {entry.name: (entry.held, entry.count) for entry in result.withheld}
    assert answer == {
        "withheld, unknown, or its near-alias with doubt": (3, 6),
        "withheld, unknown": (1, 6),
        "withheld, a name above 0.5": (2, 6),
        "withheld, a tenth: that, or no gap": (1, 1),
    }


def test_diagnoses_are_counted_by_hidden_effect() -> None:
    confusion = score_exam(PAIRS).confusion
    counts = {
        (row, column): count
        for row, answer in zip(confusion.hidden, confusion.counts, strict=True)
        for column, count in zip(confusion.predicted, answer, strict=True)
        if count
    }
    assert sum(counts.values()) == len(PAIRS)
    assert counts["stribeck", "adhesion"] == 1
    assert counts["several", "several"] == 1
    assert counts["several", "folds"] == 1
    assert counts["unknown", "folds"] == 1
    assert counts["no_gap", "unknown"] == 1
    assert confusion.hidden[-3:] == ("several", "unknown", "no_gap")


def test_detection_goes_by_size_and_leaves_rough_campaigns_out() -> None:
    pairs = [
        ("seen", truth("folds"), diagnosis_record("folds")),
        ("named wrongly", truth("folds"), diagnosis_record("adhesion")),
        ("not seen", truth("folds", size=0.1), diagnosis_record(verdict="no_gap")),
        ("rough", truth("folds", rough=True), diagnosis_record("adhesion")),
    ]
    amounts = {"seen": 40.0, "named wrongly": 30.0, "not seen": 2.0, "rough": 30.0}
    low, high = score_exam(pairs, amounts=amounts).detection
    assert (low.low, low.high, low.seen.held, low.misled.held, low.seen.count) == (0.0, 3.0, 0, 0, 1)
    assert (high.low, high.seen.held, high.named.held, high.misled.held, high.seen.count) == (25.0, 2, 1, 1, 2)


def test_probabilities_that_are_true_have_skill_and_lie_in_their_bands() -> None:
    hidden = ["folds" if number % 2 else "stribeck" for number in range(20)]
    sure = [(str(number), truth(name), diagnosis_record(name, p=1.0)) for number, name in enumerate(hidden)]
    calibration = score_exam(sure).calibration
    assert calibration.brier == pytest.approx(0.0)
    assert calibration.brier_base_rate == pytest.approx(0.5)
    assert calibration.brier_skill == pytest.approx(1.0)
    [top] = calibration.reliability
    assert (top.low, top.high, top.count, top.right, top.band) == (0.95, 1.0, 20, 20, (1.0, 1.0))
    guesses = [
        (str(at), truth("folds" if at % 2 else "stribeck"), diagnosis_record("folds", p=0.5)) for at in range(20)
    ]
    assert score_exam(guesses).calibration.brier_skill < 0.5
    [middle] = score_exam(guesses).calibration.reliability
    assert middle.band[0] <= middle.share <= middle.band[1]


def test_an_effect_too_small_to_see_may_pass_for_no_gap_in_the_brier_score() -> None:
    tiny = score_exam([("a", truth("folds", size=0.1), diagnosis_record(verdict="no_gap", p=1.0))])
    assert tiny.calibration.brier == pytest.approx(0.0)
    large = score_exam([("a", truth("folds"), diagnosis_record(verdict="no_gap", p=1.0))])
    assert large.calibration.brier == pytest.approx(2.0)


def test_promises_are_compared_where_there_was_a_gap_and_fresh_runs() -> None:
    pairs = [
        ("kept", truth("folds"), diagnosis_record("folds", closed=0.95, interval=(0.9, 0.97))),
        ("not kept", truth("folds"), diagnosis_record("folds", closed=0.95, interval=(0.94, 0.96))),
        ("wrong", truth("folds"), diagnosis_record("adhesion", closed=0.8)),
        ("no effect named", truth("folds"), diagnosis_record(verdict="unknown", closed=0.3)),
        ("no fresh runs", truth("folds"), diagnosis_record("folds", closed=0.9)),
    ]
    closed = {"kept": 0.93, "not kept": 0.65, "wrong": 0.1, "no effect named": 0.2}
    achieved = {
        name: {
            "verdict": "KEPT" if name == "kept" else "NOT_KEPT",
            "shrink": {"closed": entry, "closed_95ci": None},
        }
        for name, entry in closed.items()
    }
    promises = score_exam(pairs, achieved=achieved).promises
    assert [outcome.case for outcome in promises.outcomes] == ["kept", "not kept", "wrong"]
    assert promises.difference == pytest.approx(0.3)
    assert promises.right_difference == pytest.approx(0.16)
    assert (promises.within.held, promises.within.count) == (1, 2)
    assert (promises.closed.held, promises.closed.count) == (1, 2)
    assert (promises.kept.held, promises.kept.count) == (1, 2)


@pytest.mark.parametrize("cases", [thorough(1), 96])
def test_an_exam_is_told_as_json_text_and_page(cases: int) -> None:
    from dragrig.exam.blind_exam import BlindExam

    result = large_exam(cases)
    exam = BlindExam(cases, 4, "ab" * 32, result, {}, {"this call": 1.0})
    dumps = json.dumps(to_json_value(exam.document()), allow_nan=False)
    assert json.loads(dumps)["calibration"]["reliability"]
    assert exam.document()["confusion"] == score_json(result)["confusion"]
    document = exam_document(result, cases, 4, "ab" * 32)
    text = document_text(document)
    shown = render_page(document)
    pictures = HTMLPictures()
    pictures.feed(shown)
    assert not pictures.sources
    first = f"{cases - len(result.missed)} of {cases} verdicts are right"
    assert first in text
    assert first in shown.replace("\u00a0", " ")
    if cases > 1:
        assert pictures.drawn == 4
        assert "d′" in text
        assert any(entry.high == inf for entry in result.detection)
        assert "Where the true effect is withheld" in shown
    else:
        assert shown == render_page(exam_document(result, cases, 4, "ab" * 32))


class HTMLPictures(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.drawn = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.drawn += tag == "svg" and dict(attrs).get("class") != "glyphs"
        if tag == "img":
            self.sources.append(dict(attrs)["src"] or "")
