"""The scorer of diagnoses."""

from io import StringIO

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from dragrig.config.errors import AnalysisError
from dragrig.gap_scoring import score


def truth(*effects: str, size: float = 1.0, outside: bool = False, rough: bool = False) -> dict[str, object]:
    verdict = "unknown" if outside else ("no_gap", "effect", "several")[min(len(effects), 2)]
    sizes = [size] * len(effects)
    return {"verdict": verdict, "effects": list(effects), "size": sizes, "nominal_slightly_wrong": rough}


def said(*effects: str, p: float = 0.9, verdict: str = "", channel: str = "force") -> dict[str, object]:
    told = verdict or ("effect" if len(effects) == 1 else "several")
    first = "+".join(effects) or told
    return {
        "verdict": told,
        "effects": list(effects),
        "ranking": [{"hypothesis": first, "probability": p}, {"hypothesis": "rest", "probability": 1 - p}],
        "where": {"channel": {"force": 0.2, "position": 0.2, channel: 0.8}},
    }


PAIRS = [
    ("right", truth("stribeck"), said("stribeck")),
    ("other name", truth("stribeck"), said("adhesion", p=0.95)),
    ("lag in the wrong channel", truth("servo_lag"), said("servo_lag", channel="force")),
    ("latency in either channel", truth("channel_latency"), said("channel_latency", channel="position")),
    ("a third", truth("folds", size=1 / 3), said("folds")),
    ("tiny, not seen", truth("folds", size=0.1), said(verdict="no_gap")),
    ("tiny, called something else", truth("folds", size=0.1), said("mains_hum", p=0.6)),
    ("nothing", truth(), said(verdict="no_gap")),
    ("false alarm", truth(), said("folds", p=0.55)),
    ("foreign", truth(outside=True), said(verdict="unknown")),
    ("foreign, named", truth(outside=True), said("folds", p=0.7)),
    ("pair", truth("folds", "servo_lag"), said("servo_lag", "folds")),
    ("half a pair", truth("folds", "servo_lag"), said("folds", p=0.95)),
    ("rough", truth("adhesion", rough=True), said("adhesion")),
    ("rough nothing", truth(rough=True), said(verdict="unknown", p=0.4)),
]


def test_every_rate_counts_what_it_says() -> None:
    found = score(PAIRS)
    counts = {one.name: (one.held, one.count) for one in found.rates}
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
    assert [case.name for case in found.missed] == [
        "other name", "tiny, called something else", "false alarm", "foreign, named", "half a pair", "rough nothing",
    ]  # fmt: skip


def test_the_interval_is_wilsons() -> None:
    pairs = [(str(at), truth("folds"), said("folds" if at else "adhesion")) for at in range(40)]
    rate = score(pairs)["full size, right name"]
    assert (rate.held, rate.count) == (39, 40)
    assert (rate.low, rate.high) == (pytest.approx(0.871, abs=0.001), pytest.approx(0.996, abs=0.001))


def test_a_rate_without_cases_is_told_as_such() -> None:
    found = score(PAIRS[:1])
    assert found["outside, unknown"].count == 0
    console = Console(width=120, record=True, file=StringIO())
    for table in found.tables():
        console.print(table)
    text = console.export_text()
    assert "0 of 0" in text
    assert "1.00" in text


def test_a_diagnosis_that_breaks_the_format_is_refused_by_name() -> None:
    with pytest.raises(AnalysisError, match=r"0007: the diagnosis cannot be scored because verdict"):
        score([("0007", truth("folds"), {"verdict": "perhaps"})])


@given(st.lists(st.sampled_from(PAIRS), min_size=1, max_size=30))
def test_rates_lie_within_their_intervals_and_do_not_depend_on_order(pairs: list[tuple[str, dict, dict]]) -> None:  # type: ignore[type-arg]
    found, turned = score(pairs), score(pairs[::-1])
    assert [(one.held, one.count) for one in found.rates] == [(one.held, one.count) for one in turned.rates]
    for one in found.rates:
        assert not one.count or one.low - 1e-9 <= one.share <= one.high + 1e-9
