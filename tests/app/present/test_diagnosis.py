"""A diagnosis as text, as JSON and as a page, for each verdict."""

import json
import re
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from math import inf, nan
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from diagnoses import (
    ALL,
    NO_GAP,
    RIPPLE_AND_AGEING,
    STRIBECK,
    STRIBECK_ALONE,
    TOGETHER,
    UNKNOWN,
    page_file,
    shrink,
    without_pictures,
)
from dragrig.analysis import RETURN_REASON, Exclusion, percent_text
from dragrig.analysis.gap.diagnosis import Diagnosis, R2BeforeAfter, RankedHypothesis, display_name
from dragrig.analysis.gap.features import DecisionInputs
from dragrig.present.diagnosis import (
    campaigns_document,
    diagnosis_document,
    diagnosis_json,
    round_probabilities,
    shrink_json,
)
from dragrig.present.diagnosis_figures import (
    before_after_figure,
    diagnosis_speed_figure,
    location_figure,
    ranking_figure,
    representative_runs,
)
from dragrig.present.diagnosis_sentences import shrink_sentences
from dragrig.present.document import Document, Figure
from dragrig.present.html_page import render_page
from dragrig.present.numbers import p_value_text, to_json_value
from dragrig.present.terminal import document_text
from dragrig.scoring import score_exam
from dragrig.sim_backend.effects.base import catalogue
from property_tests import thorough

CASES = pytest.mark.parametrize("diagnosis", ALL.values(), ids=ALL)


def text(diagnosis: Diagnosis) -> str:
    return document_text(diagnosis_document(diagnosis))


@cache
def plain_page(diagnosis: Diagnosis, source: str = "", model: str | None = None) -> str:
    """The page without its pictures."""
    return render_page(without_pictures(diagnosis_document(diagnosis, source=source, model=model)))


def page_words(diagnosis: Diagnosis) -> str:
    return words(plain_page(diagnosis))


def words(html: str) -> str:
    names: list[str] = []

    class Reader(HTMLParser):
        hidden = False

        def handle_starttag(self, tag: str, attrs: object) -> None:
            self.hidden = tag in {"style", "script"}

        def handle_data(self, data: str) -> None:
            if not self.hidden:
                names.append(data)

    Reader().feed(html)
    return " ".join(" ".join(names).replace("\u00a0", " ").split())


def test_what_was_left_out_of_the_search_is_not_called_inseparable() -> None:
    inputs = DecisionInputs(block_count=8000, chi2=20_000.0, excluded=("adhesion",))
    sentence = text(replace(STRIBECK, confusable_with=("adhesion",), decision_inputs=inputs))
    assert f"would hardly tell it from {display_name('adhesion')}, left out of the search." in " ".join(
        sentence.split()
    )
    assert "with these runs" not in sentence


FIRST = {
    "effect": "Most likely: Stribeck friction (probability 0.93).",
    "no_gap": "No gap (probability 0.97): an effect above 2.1 mN would have been detected.",
    "unknown": "A gap that no effect of the catalogue explains (probability 0.88).",
    "several": "Stribeck friction and velocity ripple act together (probability above 0.99).",
}


@pytest.mark.parametrize("verdict", ALL)
def test_the_verdict_comes_first_in_plain_words(verdict: str) -> None:
    assert text(ALL[verdict]).splitlines()[0] == FIRST[verdict]
    html = plain_page(ALL[verdict])
    heading = re.search(r"<h1>(.*?)</h1>", html)
    assert heading is not None
    assert heading[1].replace("\u00a0", " ") == FIRST[verdict]


def test_what_cannot_be_told_apart_or_answered_is_said() -> None:
    for sentence in (text(STRIBECK), page_words(ALL["effect"])):
        assert "Adhesion and film depletion cannot be distinguished from it with these runs." in sentence
        assert "No relaxation is held long enough" in sentence
        assert "018-drag.h5" in sentence
        assert "the gut slipped off the foam" in sentence
        assert "Calibrated on 400 simulated campaigns" in sentence
        assert "An effect above 2.1 mN would have been detected." in sentence
    assert "cannot be distinguished" not in text(NO_GAP)
    assert "Part of the gap remains that no effect" in text(TOGETHER)
    assert "4.1 mN · x / 40 mm" in text(UNKNOWN)
    assert "4.1 mN · x / 40 mm" in page_words(ALL["unknown"])


def test_probabilities_that_nothing_calibrated_are_not_passed_off_as_chances() -> None:
    bare = replace(STRIBECK, calibration="")
    for sentence in (text(bare), page_words(bare)):
        assert "not calibrated" in sentence
        assert "nine were right" not in sentence


def test_a_verdict_is_never_certain() -> None:
    sure = replace(STRIBECK, ranking=(RankedHypothesis("stribeck", 1.0), RankedHypothesis("no_gap", 0.0)))
    assert text(sure).startswith("Most likely: Stribeck friction (probability above 0.99).")
    assert re.search(r"no_gap +below 0\.01", text(sure))


def test_how_much_stands_beside_what_the_paper_prints() -> None:
    sentence = text(STRIBECK)
    assert "99.3 % of the gap closes (95 % interval: 98.5 % to 99.8 %)." in sentence
    assert re.search(r"ratio +0\.410 +0\.312 to 0\.508", sentence)
    assert re.search(r"Eq\. 15 +without the effect +0\.7000 +0\.4000", sentence)
    assert re.search(r"Eq\. 15 +with it +0\.9800 +0\.9700", sentence)
    assert re.search(r"correlation² +without the effect +0\.8000 +–", sentence)
    assert re.search(r"in the paper +0\.8769 +0\.1666", sentence)
    html = page_words(ALL["effect"])
    assert "0.8769 0.1666" in html
    assert "as printed" in html


def test_no_share_closes_where_there_is_no_gap() -> None:
    assert "too close to noise to say" in text(NO_GAP)
    assert "% of the gap closes" not in text(NO_GAP)
    assert " after " not in text(NO_GAP)
    assert not re.search(r"\bwith it\b", page_words(ALL["no_gap"]))
    assert re.search(r"\bwith it\b", page_words(ALL["effect"]))
    worse = replace(shrink(), closed=-0.2, closed_95ci=(-0.4, 0.1))
    assert "−20 % of the gap closes (95 % interval: −40 % to 10 %): it grows." in text(replace(STRIBECK, shrink=worse))


def test_more_than_all_of_a_gap_is_the_whole_of_it() -> None:
    beyond = replace(shrink(), closed=1.01, closed_95ci=(1.0, 1.05))
    sentence = shrink_sentences(beyond)[1]
    assert sentence == "The whole gap closes (101 %; 95 % interval: 100 % to 105 %): the residual is below noise."


def test_one_set_of_numbers_says_what_share_of_a_gap_is_explained() -> None:
    wide = replace(shrink(), closed=0.24, closed_95ci=(-10.6, 0.9991))
    told = text(replace(STRIBECK, budget=STRIBECK_ALONE, shrink=wide))
    assert "83 % is Stribeck friction" in told
    assert "9.1 mN without the effect, 1.6 mN with it" in told
    assert "24 %" not in told
    assert "closes" not in told
    table = campaigns_document([("first", replace(STRIBECK, budget=STRIBECK_ALONE, shrink=wide), "")]).sections[0]
    assert "24 %" not in document_text(Document(title="", sections=(table,)))
    nearly = replace(shrink(), closed=0.99996, closed_95ci=(0.9999, 1.0001))
    assert shrink_sentences(nearly)[1] == "Above 99.9 % of the gap closes (95 % interval: above 99.9 %)."
    none_named = text(replace(UNKNOWN, shrink=shrink()))
    assert re.search(r"Eq\. 15 +model +0\.7000", none_named)
    assert "without the effect" not in none_named


@pytest.mark.parametrize(
    ("score", "words"),
    [
        (0.71, "is mainly a function of speed, which explains 71 % of it on held-out runs."),
        (0.24, "depends most on speed, which explains 24 % of it on held-out runs."),
        (0.01, "The gap does not follow speed, position, strain or time alone."),
    ],
)
def test_a_coordinate_that_explains_little_is_not_called_the_main_one(score: float, words: str) -> None:
    where = replace(STRIBECK.where, domain_scores={"speed": score})
    assert words in text(replace(STRIBECK, where=where))
    title = location_figure(where).texts[0].get_text()
    assert title.endswith("above all a matter of speed") == (score > 0.5)


@pytest.mark.parametrize(
    ("share", "words"),
    [
        (0.71, "71 %"),
        (0.993, "99.3 %"),
        (0.9996, "above 99.9 %"),
        (1.0, "100 %"),
        (0.0001, "below 0.1 %"),
        (-0.001, "0 %"),
        (-10.6, "−1060 %"),
        (nan, "an unknown share"),
    ],
)
def test_shares_are_never_rounded_to_all_or_nothing(share: float, words: str) -> None:
    assert percent_text(share) == words


def test_where_it_is_stands_in_words_with_the_chance_of_it() -> None:
    for sentence in (text(STRIBECK), page_words(ALL["effect"])):
        assert re.search(r"protocol +drag 90 %, coulomb 10 % ", sentence)
        assert re.search(r"speed +0\.5 to 2 mm/s: 79 % ", sentence)
        assert re.search(r"session +.*\(not significant\) ", sentence)
        assert "strain" not in text(STRIBECK).split("Which")[0]
        assert "mainly a function of speed, which explains 71 %" in sentence
    assert "Nowhere does the residual exceed noise" in text(NO_GAP)
    location = replace(STRIBECK.where.location("speed_mm_s"), low=2.0, high=2.0)
    here = replace(STRIBECK, where=replace(STRIBECK.where, locations=(location,)))
    assert "at 2 mm/s: 79 %" in text(here)


def test_a_place_has_one_p_value_in_table_and_figure() -> None:
    where = STRIBECK.where
    document = diagnosis_document(STRIBECK)
    table = next(table for table in document.tables() if table.name == "location")
    in_table = {row[0].text: row[2].text for row in table.cells}
    assert in_table["anywhere"] == p_value_text(where.p)
    assert in_table["anywhere"] in location_figure(where).texts[1].get_text()
    drawn = {axes.get_title(loc="left"): axes.get_xlabel() for axes in location_figure(where).axes}
    for title, axis in {"Speed (mm/s)": "speed", "Position (mm)": "position", "Frequency (Hz)": "frequency"}.items():
        assert drawn[title].endswith(f", {in_table[axis]}")


def test_a_gap_at_no_place_beyond_chance_is_not_said_to_be_at_one() -> None:
    nowhere = tuple(replace(location, p=0.2) for location in STRIBECK.where.locations)
    here = replace(STRIBECK, where=replace(STRIBECK.where, locations=nowhere, p=0.2))
    rows = [row for row in text(here).splitlines() if re.match("(channel|protocol|phase|speed|session) ", row)]
    assert len(rows) == 5
    assert all("(not significant)" in row for row in rows)
    assert location_figure(here.where).texts[0].get_text().startswith("A gap in the force, at no place beyond chance")
    assert "(not significant)" not in next(row for row in text(STRIBECK).splitlines() if row.startswith("speed "))


@CASES
def test_the_conclusion_and_its_probability_are_the_first_two_sentences_and_a_figure_follows(
    diagnosis: Diagnosis,
) -> None:
    document = diagnosis_document(diagnosis)
    assert "probability" in " ".join((document.answer, *document.lead[:1]))
    first = document.content[0]
    assert diagnosis.budget is None or isinstance(first.content[0], Figure)


def test_nothing_is_cut_off_in_a_pipe() -> None:
    answer = text(STRIBECK)
    assert "…" not in answer
    assert max(map(len, answer.splitlines())) > 100


@pytest.mark.parametrize("verdict", [name if name == "several" else thorough(name) for name in ALL])
def test_a_page_stands_alone(verdict: str, shared_folder: Path) -> None:
    html = page_file(verdict, shared_folder).read_text("utf-8")
    assert not re.search(r'(src|href)="(?!data:|#)', html)
    assert html.count('role="img"') == 4
    assert "nan" not in words(html).lower().split()


def test_a_page_escapes_what_comes_from_files() -> None:
    odd = replace(STRIBECK, traces=(), specimen="<b>gut</b>", remarks=("<script>1</script>",))
    html = render_page(without_pictures(diagnosis_document(odd, source="<i>runs</i>")))
    assert "<b>gut" not in html
    assert "<script>1" not in html
    assert "<i>runs" not in html


def test_a_page_without_views_or_model_says_so_by_silence() -> None:
    html = plain_page(replace(STRIBECK, traces=(), model=None))
    assert html.count('role="img"') == 2
    assert "dragrig gap evaluate" not in html
    assert "dragrig gap evaluate mine.toml" in plain_page(STRIBECK, model="mine.toml")


class Strict(BaseModel):
    model_config = ConfigDict(extra="allow", strict=True)


class CampaignPart(Strict):
    runs: int
    used_for_fit: list[str]
    held_out: list[str]


class ParameterPart(Strict):
    value: float
    sd: float
    unit: str


class RankedPart(Strict):
    hypothesis: str
    probability: float = Field(ge=0, le=1)
    parameters: dict[str, ParameterPart]
    held_out_improvement: float | None


class RangePart(Strict):
    low: float | None
    high: float | None
    share: float


class WherePart(Strict):
    channel: dict[str, float]
    protocol: dict[str, float]
    phase: dict[str, float]
    speed_mm_s: RangePart
    position: RangePart
    session: RangePart
    strain: RangePart
    band_hz: RangePart
    domain: str


class SidesPart(Strict):
    below: float | None
    above: float | None


class ModelsPart(Strict):
    before: SidesPart
    after: SidesPart


class ShrinkPart(Strict):
    gap_before_mN: float
    gap_after_mN: float
    noise_floor_mN: float
    closed: float | None
    closed_95ci: list[float] | None
    boundary_mm_s: float | None
    r2_eq15: ModelsPart
    r2_corr: ModelsPart


class BudgetPart(Strict):
    cause: str
    channel: str
    share: float
    share_95ci: list[float] | None
    rms_mN: float | None
    presence: float | None
    what: str | None
    not_separable_from: list[str]


class Report(Strict):
    format: str = Field(pattern="^dragrig-gap$")
    version: int = Field(ge=2, le=2)
    campaign: CampaignPart
    verdict: str = Field(pattern="^(effect|several|no_gap|unknown)$")
    effects: list[str]
    ranking: list[RankedPart]
    confusable_with: list[str]
    residual_unknown: bool
    presence: dict[str, float]
    budget: list[BudgetPart]
    would_have_seen_mN: float | None
    where: WherePart
    shrink: ShrinkPart | None
    model: str | None
    next_experiment: None


@pytest.mark.parametrize(
    "diagnosis",
    [*ALL.values(), replace(STRIBECK, budget=STRIBECK_ALONE), replace(TOGETHER, budget=RIPPLE_AND_AGEING)],
    ids=[*ALL, "one part", "two parts"],
)
def test_json_is_a_gap_report(diagnosis: Diagnosis) -> None:
    sentence = json.dumps(
        to_json_value(diagnosis_json(diagnosis, model="amended.toml", run_ids={"000-drag.h5": "id-0"})), allow_nan=False
    )
    read = Report.model_validate_json(sentence)
    assert read.model == "amended.toml"
    assert read.campaign.used_for_fit[:2] == ["id-0", "001-drag.h5"]
    assert sum(hypothesis.probability for hypothesis in read.ranking) == pytest.approx(1.0, abs=1e-6)
    assert read.effects == list(diagnosis.effects)
    assert set(read.effects) <= set(catalogue())
    truth = {"verdict": diagnosis.verdict.value, "effects": list(diagnosis.effects)}
    assert len(read.budget) == (0 if diagnosis.budget is None else 3)
    assert not score_exam([("made up", truth, json.loads(sentence))]).missed


def test_json_tells_parameters_with_their_unit() -> None:
    message = diagnosis_json(STRIBECK)
    ranking = TypeAdapter(list[RankedPart]).validate_python(message["ranking"])
    assert ranking[0].parameters["ratio"].sd == pytest.approx(0.05)
    assert ranking[0].parameters["speed_mm_s"].unit == "mm/s"
    assert message["unknown"] is None
    assert diagnosis_json(UNKNOWN)["shrink"] is None


def test_json_knows_no_nan_and_no_infinity() -> None:
    ill = replace(
        STRIBECK,
        detection_limit_mN=inf,
        ranking=(
            RankedHypothesis("stribeck", nan, (replace(STRIBECK.ranking[0].parameters[0], standard_error=nan),), nan),
        ),
        where=replace(STRIBECK.where, p=nan, domain_scores={"speed": nan}),
        shrink=replace(shrink(), closed=nan, r2_eq15=R2BeforeAfter(nan, inf, -inf, None)),
        timings_s={"fit": nan},
    )
    answer = json.loads(json.dumps(to_json_value(diagnosis_json(ill)), allow_nan=False))
    assert answer["would_have_seen_mN"] is None
    assert answer["shrink"]["closed"] is None
    assert answer["where"]["p"] is None
    assert answer["shrink"] == json.loads(json.dumps(to_json_value(shrink_json(ill.shrink or shrink()))))
    assert "nan" not in text(ill).lower().split()
    assert "the detection limit of these runs is not known" in text(ill).lower()
    drawings = [figure.drawing for figure in diagnosis_document(ill).figures()]
    assert all(not isinstance(drawing, str) and drawing().axes for drawing in drawings)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=40).filter(lambda shares: sum(shares) > 1e-9))
def test_rounded_probabilities_still_sum_to_one(shares: list[float]) -> None:
    answer = round_probabilities(shares)
    assert sum(answer) == pytest.approx(1.0, abs=1e-9)
    assert all(abs(a - b / sum(shares)) <= 2e-6 for a, b in zip(answer, shares, strict=True))
    assert all(0 <= value <= 1 for value in answer)


def test_runs_are_shown_at_low_middle_and_high_speed_and_one_of_each_other_kind() -> None:
    chosen = representative_runs(STRIBECK.traces)
    assert [traces.label for traces in chosen] == [
        "drag at 0.5 mm/s", "drag at 10 mm/s", "drag at 60 mm/s",
        "relaxation at 200 %", "blank run at 40 mm/s", "Coulomb friction at 0.5 mm/s",
    ]  # fmt: skip
    figure = before_after_figure(chosen, 1.4)
    assert len(figure.axes) == 2 * len(chosen)
    assert len(figure.axes[0].lines) == len(before_after_figure(chosen, 1.4, named=False).axes[0].lines) + 1
    fast = figure.axes[4].get_xlim()
    assert fast[0] > 0.5
    assert fast[1] < 3.0


def test_steady_forces_stand_beside_the_model_before_and_after() -> None:
    above, below = diagnosis_speed_figure(STRIBECK.traces, 1.4).axes
    assert above.get_xscale() == "log"
    drags = sorted({view.steady for view in STRIBECK.traces if view.kind == "drag"}, key=lambda level: level.speed_mm_s)
    lines = [np.asarray(line.get_ydata(), dtype=float).tolist() for line in above.lines]
    assert [level.measured_mN for level in drags] in [pytest.approx(line) for line in lines]
    for number, words in enumerate(("model before", "model after")):
        assert [level.models_mN[number] for level in drags] in [pytest.approx(line) for line in lines]
        assert words in [text.get_text() for text in above.texts]
    gaps = [level.measured_mN - level.models_mN[0] for level in drags]
    assert gaps in [pytest.approx(np.asarray(line.get_ydata(), dtype=float).tolist()) for line in below.lines]
    alone = diagnosis_speed_figure(STRIBECK.traces, named=False).axes[0]
    assert "model after" not in [text.get_text() for text in alone.texts]


def test_the_ranking_marks_the_verdict_and_what_cannot_be_told_from_it() -> None:
    axes = ranking_figure(TOGETHER).axes[0]
    assert (
        next(get_yticklabel.get_text() for get_yticklabel in axes.get_yticklabels())
        == "Velocity ripple and Stribeck friction"
    )
    colours = [patch.get_facecolor() for patch in ranking_figure(STRIBECK).axes[0].patches]
    assert colours[0] != colours[1] == colours[2] != colours[3]


@pytest.mark.parametrize("effect", sorted(catalogue()))
def test_every_effect_has_a_name_for_a_sentence(effect: str) -> None:
    name = catalogue()[effect].name
    assert name
    assert "_" not in name
    assert text(replace(STRIBECK, effects=(effect,), confusable_with=()))


def test_a_page_says_whether_its_runs_were_simulated() -> None:
    badge = '<span class="badge simulated">simulated</span>'
    assert badge in plain_page(replace(STRIBECK, backends=("simulated",)))
    assert 'class="badge' not in plain_page(replace(STRIBECK, backends=()))
    assert '<span class="badge hardware">hardware</span>' in plain_page(replace(STRIBECK, backends=("hardware",)))


def test_ways_back_that_were_left_out_are_one_row() -> None:
    ways_back = tuple(Exclusion(f"{number:03d}-return.h5", RETURN_REASON) for number in range(19))
    document = diagnosis_document(replace(STRIBECK, left_out=ways_back))
    left_out = next(table for table in document.tables() if table.name == "left-out")
    assert len(left_out.rows) == 1
