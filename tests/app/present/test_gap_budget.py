"""The budget of a gap in words, as bars, as a table, as a picture and as JSON."""

import json
import re
from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Text

from diagnoses import (
    NO_GAP,
    RIPPLE_AND_AGEING,
    STRIBECK,
    STRIBECK_ALONE,
    TOGETHER,
    UNKNOWN,
    budget,
    entry,
    without_pictures,
)
from dragrig.analysis import capitalise
from dragrig.analysis.gap.diagnosis import Diagnosis, GapBudget, RunContributions
from dragrig.present.diagnosis import campaigns_document, diagnosis_document, diagnosis_json
from dragrig.present.diagnosis_figures import BAR_THICKNESS, budget_figure, runs_showing_parts
from dragrig.present.diagnosis_sentences import verdict_sentences
from dragrig.present.drawing import figure_style, lay_out
from dragrig.present.gap_budget import (
    ChannelBudget,
    budget_bars,
    budget_json,
    budget_sentences,
    budgets_by_channel,
    part_name,
)
from dragrig.present.html_page import render_page
from dragrig.present.numbers import to_json_value
from dragrig.present.terminal import BAR_WIDTH, document_text
from property_tests import thorough

UNNAMED = budget(entry("unexplained", 1.0, 12.0, None, what="tissue_ageing, place"))
CROWDED = budget(
    entry("hyperelastic_wall", 0.34, rivals=("wall_lift_off",)),
    entry("model", 0.31, what="parameters of the model"),
    entry("specimen", 0.15, what="gain of a run"),
    entry("stribeck", 0.07),
    entry("folds", 0.04),
    entry("adhesion", 0.012),
    entry("encoder_scale", -0.03),
    entry("unexplained", 0.108, 4.0, None),
)
CHANNELS = budget(
    entry("stribeck", 0.8),
    entry("unexplained", 0.2, 5.0, None),
    entry("velocity_ripple", 0.9, None, channel="position"),
    entry("unexplained", 0.1, None, None, channel="position"),
)
TOO_MUCH = budget(entry("stribeck", 1.04), entry("unexplained", -0.04, 0.0, None))
BUDGETS = {
    "two": RIPPLE_AND_AGEING,
    "one": STRIBECK_ALONE,
    "none": UNNAMED,
    "many": CROWDED,
    "channels": CHANNELS,
    "over": TOO_MUCH,
}
EACH = pytest.mark.parametrize("given_budget", BUDGETS.values(), ids=BUDGETS)


def drawn(in_the_line: str) -> pytest.MarkDecorator:
    """Draw one of the budgets in the test line, and the others among the thorough tests."""
    values = [value if name == in_the_line else thorough(value) for name, value in BUDGETS.items()]
    return pytest.mark.parametrize("given_budget", values, ids=BUDGETS)


def diagnosed(given_budget: GapBudget | None) -> Diagnosis:
    return replace(TOGETHER, budget=given_budget)


def text(diagnosis: Diagnosis) -> str:
    return document_text(diagnosis_document(diagnosis))


def plain_page(diagnosis: Diagnosis) -> str:
    """The page without its pictures."""
    return render_page(without_pictures(diagnosis_document(diagnosis))).replace("\u00a0", " ")


def test_the_first_sentence_says_what_the_gap_is_made_of() -> None:
    assert {name: budget_sentences(given_budget) for name, given_budget in BUDGETS.items()} == {
        "two": (
            "Of a gap of 12 mN, 55 % is velocity ripple, 20 % tissue ageing or preconditioning; 25 % is unexplained.",
        ),
        "one": (
            "Of a gap of 12 mN, 83 % is Stribeck friction or adhesion, 6 % the model itself; 11 % is unexplained.",
        ),
        "none": ("Of a gap of 12 mN, nothing is explained.",),
        "many": (
            "Of a gap of 12 mN, 34 % is hyperelastic wall or wall lift-off, 31 % the model itself, 15 % the specimen "
            "itself, 7 % Stribeck friction, 5 % others; 11 % is unexplained.",
            "None of it is encoder scale: that runs against the gap (−3 %).",
        ),
        "channels": (
            "Of a gap of 12 mN in the force, 80 % is Stribeck friction; 20 % is unexplained.",
            "Of the gap in the position, 90 % is velocity ripple; 10 % is unexplained.",
        ),
        "over": ("Of a gap of 12 mN, all is Stribeck friction.",),
    }
    assert budget_sentences(None) == ()


def test_small_parts_and_a_rest_below_nothing_are_not_named() -> None:
    both = budget(entry("stribeck", 0.6), entry("folds", 0.44), entry("unexplained", -0.04, 0.0, None))
    assert budget_sentences(both) == (
        "Of a gap of 12 mN, 60 % is Stribeck friction, 44 % circular folds; nothing is left unexplained.",
    )
    little = budget(entry("stribeck", 0.01), entry("unexplained", 0.99, 12.0, None))
    assert budget_sentences(little) == ("Of a gap of 12 mN, 99 % is unexplained.",)


def test_the_budget_stands_before_the_verdict() -> None:
    diagnosis = diagnosed(RIPPLE_AND_AGEING)
    sentences = [*budget_sentences(RIPPLE_AND_AGEING), *verdict_sentences(diagnosis)]
    assert text(diagnosis).splitlines()[: len(sentences)] == sentences
    assert f"<h1>{sentences[0]}</h1>" in plain_page(diagnosis)
    assert diagnosis_json(diagnosis)["in_words"] == tuple(sentences)


@pytest.mark.parametrize("given_budget", [None, budget()], ids=["not made", "empty"])
def test_without_a_gap_there_is_no_bar(given_budget: GapBudget | None) -> None:
    diagnosis = replace(NO_GAP, budget=given_budget)
    assert text(diagnosis).splitlines()[0] == verdict_sentences(diagnosis)[0]
    document = diagnosis_document(diagnosis)
    assert "budget" not in [section.name for section in document.content]
    assert "budget" not in [figure.name for figure in document.figures()]
    data = diagnosis_json(diagnosis)
    assert data["budget"] == []
    assert data["presence"] == ({} if given_budget is None else given_budget.presence)


@EACH
def test_the_budget_in_json_sums_to_one_in_each_channel(given_budget: GapBudget) -> None:
    parts = json.loads(json.dumps(to_json_value(diagnosis_json(diagnosed(given_budget))), allow_nan=False))["budget"]
    told = [(part["channel"], part["cause"]) for part in parts]
    assert sorted(told) == sorted((part.channel, part.cause) for part in given_budget.entries)
    for channel in {part["channel"] for part in parts}:
        here = [part for part in parts if part["channel"] == channel]
        assert here[-1]["cause"] == "unexplained"
        assert {"where", "depends_on", "law"} <= here[-1].keys()
        assert sum(part["share"] for part in here) == pytest.approx(1.0, abs=1e-3)


def test_json_tells_each_part() -> None:
    ripple, ageing, rest = budget_json(diagnosed(RIPPLE_AND_AGEING))
    runs = {run.file: run.rms("velocity_ripple") for run in RIPPLE_AND_AGEING.runs}
    assert ripple == {
        "cause": "velocity_ripple",
        "channel": "force",
        "share": 0.5512,
        "share_95ci": [0.4912, 0.6012],
        "rms_mN": 8.9,
        "presence": 0.98,
        "what": None,
        "not_separable_from": (),
        "largest_in": {"run": "000-drag.h5", "rms": pytest.approx(runs["000-drag.h5"]), "unit": "mN"},
    }
    assert runs["000-drag.h5"] == max(runs.values())
    named = diagnosis_json(diagnosed(RIPPLE_AND_AGEING), run_ids={"000-drag.h5": "id-0"})["budget"]
    assert isinstance(named, list)
    assert named[0]["largest_in"]["run"] == "id-0"
    assert "largest_in" not in rest
    assert budget_json(diagnosed(replace(RIPPLE_AND_AGEING, runs=())))[0]["largest_in"] is None
    assert ageing["not_separable_from"] == ("preconditioning",)
    assert rest["where"] == {"in_words": "It lives in the hold after the stop"}
    assert (rest["depends_on"], rest["law"], rest["presence"]) == ("speed", None, None)


def test_json_tells_where_a_gap_without_a_name_is() -> None:
    (rest,) = budget_json(replace(UNKNOWN, budget=UNNAMED))
    assert rest["where"] == {
        "channel": {"force": 0.98, "position": 0.02},
        "protocol": {"drag": 0.9, "coulomb": 0.1, "relaxation": 0.0, "blank": 0.0},
        "phase": {"rest": 0.0, "accelerate": 0.1, "steady": 0.9, "decelerate": 0.0, "hold": 0.0},
        "in_words": "It lives in the steady force of drag runs, from 0.5 to 5 mm/s",
    }
    assert (rest["depends_on"], rest["resembles"]) == ("session, place", ["tissue_ageing"])
    assert rest["law"] == "4.1 mN · x / 40 mm − 1.2 mN · ln(v / 1 mm/s)"
    assert "Best described by tissue ageing and place; not established" in text(replace(UNKNOWN, budget=UNNAMED))
    silent = replace(UNKNOWN, budget=budget(entry("unexplained", 1.0, 12.0, None)))
    assert budget_json(silent)[0]["depends_on"] == "speed"


def test_what_is_left_in_one_channel_is_not_told_of_the_other() -> None:
    _, force, _, position = budget_json(diagnosed(CHANNELS))
    assert force["where"]
    assert not position["where"]


def test_a_budget_knows_no_nan() -> None:
    ill = replace(entry("stribeck", 0.7, nan, nan), share_95ci=(nan, inf))
    broken = replace(budget(ill, entry("adhesion", nan), entry("unexplained", 0.3, None, None)), gap_mN=nan)
    diagnosis = diagnosed(broken)
    first, *_ = json.loads(json.dumps(to_json_value(diagnosis_json(diagnosis)), allow_nan=False))["budget"]
    assert (first["share_95ci"], first["rms_mN"], first["presence"]) == (None, None, None)
    assert text(diagnosis).startswith("Of the gap, 70 % is Stribeck friction; 30 % is unexplained.")
    for shown in (text(diagnosis), re.sub(r"<[^>]*>", " ", plain_page(diagnosis))):
        assert "nan" not in shown.lower().split()
    assert budget_figure(broken).axes


def test_the_table_has_every_part_with_its_numbers() -> None:
    shown = text(diagnosed(CROWDED))
    assert re.search(r"Hyperelastic wall or wall lift-off +34 % +28 % to 39 % +5\.0 +0\.98 +The muscular", shown)
    assert re.search(r"The model itself +31 % .* 0\.98 +The nominal model's parameters are off", shown)
    assert re.search(
        r"The specimen itself +15 % .* 0\.98 +Runs or specimens differ more than usual, by a factor", shown
    )
    assert re.search(r"Encoder scale +−3 % +−9 % to 2 % ", shown)
    assert re.search(r"Adhesion +1 % ", shown)
    assert re.search(r"Unexplained +11 % ", shown)
    assert not re.search(r"channel +part of the gap", shown)
    assert re.search(r"position +Velocity ripple +90 % +84 % to 95 % +– +0\.98", text(diagnosed(CHANNELS)))


def test_an_interval_has_the_digits_that_it_takes() -> None:
    close = with_intervals(OWN, (0.9981, 1.0002), (-0.0002, 0.0019))
    assert re.search(r"The model itself +80 % +99\.8 % to 100\.0 %", text(diagnosed(close)))
    assert re.search(r"The model itself +80 % +\d+\.\d ", text(diagnosed(with_intervals(OWN, (1.0, 1.0), (0.0, 0.0)))))


def test_shares_of_runs_that_were_fitted_are_called_so() -> None:
    assert "in the position are of the runs that were fitted" in plain_page(diagnosed(CHANNELS))
    assert "in the position are of the runs" not in plain_page(diagnosed(RIPPLE_AND_AGEING))
    few, held_out = diagnosed(replace(RIPPLE_AND_AGEING, held_out=False)), diagnosed(RIPPLE_AND_AGEING)
    assert "too few runs to hold any out" in text(few)
    assert "too few runs to hold any out" not in text(held_out)
    assert "took no part in the fit" in plain_page(held_out)
    assert "took no part in the fit" not in plain_page(few)


@EACH
def test_a_bar_in_the_terminal_is_as_wide_as_its_parts(given_budget: GapBudget) -> None:
    lines = text(diagnosed(given_budget)).splitlines()
    drawn = [line.strip() for line in lines if line.strip() and set(line.strip()) <= set("█▓░")]
    for line, bar in zip(drawn, budget_bars(given_budget), strict=True):
        whole = max(1.0, sum(part.share for part in bar.parts))
        assert len(line) == pytest.approx(BAR_WIDTH * sum(part.share for part in bar.parts) / whole, abs=1.0)
        widths = [len(run[0]) for run in re.finditer(r"█+|▓+|░+", line)]
        assert widths == pytest.approx([BAR_WIDTH * part.share / whole for part in bar.parts], abs=1.5)
        for part in bar.parts:
            named = [line for line in lines if f"{part.name} {part.size}" in line and line[:2] == "  "]
            assert named
            assert len(named[0]) <= 80


@EACH
def test_whole_per_cent_sum_up_and_are_the_same_in_bar_table_and_sentence(given_budget: GapBudget) -> None:
    shown, sentences = text(diagnosed(given_budget)), " ".join(budget_sentences(given_budget))
    for here, bar in zip(budgets_by_channel(given_budget), budget_bars(given_budget), strict=True):
        opposed = sum(entry.share for entry in here.opposed)
        assert sum(here.percents.values()) == pytest.approx(100 * (1 - opposed), abs=0.5)
        for part in bar.parts:
            if part.size == "all":
                assert f"all is {part.name}." in sentences
                continue
            assert part.size == f"{here.percents[cause_of(part.name, here)]} %"
            assert part.size in sentences or "nothing is explained" in sentences
            assert part.name == "others" or re.search(f"{re.escape(capitalise(part.name))} +{part.size} ", shown)


def cause_of(name: str, here: ChannelBudget) -> str:
    return next((entry.cause for entry in here.shown if part_name(entry) == name), name)


OWN = budget(entry("model", 0.8, what="laws of the model"), entry("unexplained", 0.2, 4.0, None), gap_mN=50.2)
MIXED = budget(
    entry("specimen", 0.4, what="gain of a run"), entry("model", 0.35), entry("unexplained", 0.25, 4.0, None)
)
BESIDE = budget(entry("specimen", 0.93), entry("stribeck", 0.05), entry("unexplained", 0.02, 4.0, None))


def test_a_gap_of_the_model_or_the_specimen_is_called_theirs() -> None:
    assert budget_sentences(OWN)[0] == (
        "The gap is mostly the nominal model's own: of 50 mN, 80 % is the model itself; 20 % is unexplained."
    )
    assert budget_sentences(MIXED)[0].startswith(
        "The gap is mostly the nominal model's and the specimen's own: of 12 mN, 40 % is the specimen itself, 35 % "
    )
    assert budget_sentences(BESIDE)[0].startswith(
        "The gap is the specimen's own: of 12 mN, 93 % is the specimen itself"
    )
    unsure = replace(OWN, entries=(replace(OWN.entries[0], share_95ci=(-0.05, 0.9)), OWN.entries[1]))
    assert budget_sentences(unsure)[0].startswith("Of a gap of 50 mN, 80 % is the model itself")
    in_both = budget(*OWN.entries, entry("servo_lag", 1.0, channel="position"), gap_mN=nan)
    assert budget_sentences(in_both)[0] == (
        "The gap is mostly the nominal model's own: of the gap in the force, 80 % is the model itself; "
        "20 % is unexplained."
    )


def test_a_gap_of_the_models_own_is_not_called_unknown() -> None:
    diagnosis = replace(UNKNOWN, budget=OWN)
    assert verdict_sentences(diagnosis)[:2] == (
        "No effect of the catalogue is established (probability 0.88 for none).",
        "The gap lives in the steady force of drag runs, from 0.5 to 5 mm/s.",
    )
    assert "A gap that no effect" not in text(diagnosis) + plain_page(diagnosis)
    assert diagnosis_json(diagnosis)["verdict"] == "unknown"
    rows = document_text(campaigns_document([("a", diagnosis, ""), ("b", UNKNOWN, "")]))
    assert re.search(r"a +the nominal model's own +0\.88", rows)
    assert re.search(r"b +unknown +0\.88", rows)


def test_where_the_whole_gap_is_is_not_said_of_a_rest() -> None:
    lives = "It lives in the steady force of drag runs"
    assert not re.search(f"Unexplained .*{lives}", text(replace(UNKNOWN, budget=OWN)))
    assert re.search(
        f"Unexplained .*{lives}", text(replace(UNKNOWN, budget=budget(entry("unexplained", 1.0, 12.0, None))))
    )


def test_an_effect_that_is_not_sure_is_called_probable() -> None:
    unsure = budget(entry("stribeck", 0.7, presence=0.64), entry("model", 0.1, presence=0.6), entry("unexplained", 0.2))
    assert budget_sentences(unsure) == (
        "Of a gap of 12 mN, 70 % is probably Stribeck friction, 10 % the model itself; 20 % is unexplained.",
    )


def test_the_probability_of_a_single_effect_is_that_it_is_there() -> None:
    (first, *_) = verdict_sentences(replace(STRIBECK, budget=STRIBECK_ALONE))
    assert (
        first == "Most likely: Stribeck friction (probability 0.98 that it is there, 0.93 that it is the only effect)."
    )
    same = replace(STRIBECK_ALONE, presence={"stribeck": 0.931})
    assert verdict_sentences(replace(STRIBECK, budget=same))[0].endswith("(probability 0.93).")
    assert verdict_sentences(replace(STRIBECK, budget=replace(same, presence={})))[0].endswith("(probability 0.93).")


def test_a_single_effect_is_told_with_the_model_in_its_place() -> None:
    (part,) = (
        replace(part, not_separable_from=("model",)) for part in STRIBECK_ALONE.entries if part.cause == "stribeck"
    )
    shared = replace(STRIBECK, budget=replace(STRIBECK_ALONE, entries=(part, *STRIBECK_ALONE.entries[1:])))
    assert part_name(part) == "Stribeck friction or the model itself"
    assert verdict_sentences(shared)[:2] == (
        "Most likely: Stribeck friction (probability 0.98 that it is there, or the model itself is off, 0.93 that it "
        "is the only effect).",
        "Adhesion, film depletion and the nominal model itself cannot be distinguished from it with these runs.",
    )
    assert diagnosis_json(shared)["shared_with"] == {"stribeck": ("model",)}


def with_intervals(given_budget: GapBudget, *intervals: tuple[float, float]) -> GapBudget:
    entries = [replace(one, share_95ci=ends) for one, ends in zip(given_budget.entries, intervals, strict=True)]
    return replace(given_budget, entries=tuple(entries))


def test_shares_are_stated_as_surely_as_the_runs_fix_them() -> None:
    rough = with_intervals(OWN, (0.51, 0.86), (0.14, 0.49))
    assert budget_sentences(rough)[1:] == (
        "The shares are rough: the model itself 51 % to 86 %, unexplained 14 % to 49 %.",
    )
    vague = with_intervals(OWN, (-0.66, 1.31), (-0.31, 1.66))
    assert budget_sentences(vague) == (
        "Of a gap of 50 mN, these runs leave open how much is the model itself.",
        "The shares are rough: the model itself −66 % to 131 %, unexplained −31 % to 166 %; "
        "above 100 % a part overshoots the gap.",
    )
    (part,) = budget_bars(vague)[0].parts
    assert (part.name, part.share, part.size, part.hatched) == ("the model itself or unexplained", 1.0, "100 %", True)
    overshot = with_intervals(TOO_MUCH, (0.75, 1.84), (-0.84, 0.25))
    assert budget_sentences(overshot)[0] == "Of a gap of 12 mN, at least 75 % is Stribeck friction."
    assert [(part.name, part.share, part.size) for part in budget_bars(overshot)[0].parts] == [
        ("Stribeck friction", 0.75, "at least 75 %"),
        ("Stribeck friction or unexplained", 0.25, "25 %"),
    ]


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("laws of the model", "The nominal model's laws are off"),
        ("parameters of the model in relaxations", "The nominal model's parameters are off in relaxations"),
        (
            "parameters of the model, parameters of the model in relaxations, laws of the model in relaxations",
            "The nominal model's parameters are off, and in relaxations parameters and laws beyond that",
        ),
        ("", "The nominal model's own parameters or structure are off"),
    ],
)
def test_what_of_the_model_is_off_is_said_in_plain_words(what: str, words: str) -> None:
    shown = text(diagnosed(budget(entry("model", 0.8, what=what), entry("unexplained", 0.2, 4.0, None))))
    assert re.search(rf"The model itself .* {words} *\n", shown)


def test_two_sizes_of_a_gap_are_told_apart() -> None:
    assert "Gap (50 mN): what the causes add" in plain_page(replace(STRIBECK, budget=OWN))
    assert "what the causes add" not in plain_page(replace(STRIBECK, budget=replace(OWN, gap_mN=9.5)))


@drawn("channels")
def test_the_picture_cuts_the_gap_by_its_shares(given_budget: GapBudget) -> None:
    figure = budget_figure(given_budget)
    with figure_style():
        lay_out(figure)
    bars = budget_bars(given_budget)
    rows = [axes for axes in figure.axes if any(isinstance(patch, Rectangle) for patch in axes.patches)]
    for axes, bar in zip(rows, bars, strict=True):
        cut = [patch for patch in axes.patches if isinstance(patch, Rectangle)]
        assert {patch.get_height() for patch in cut} == {BAR_THICKNESS}
        assert [patch.get_width() for patch in cut] == pytest.approx([100 * part.share for part in bar.parts])
        assert [bool(patch.get_hatch()) for patch in cut] == [part.hatched for part in bar.parts]
        ends = [patch.get_x() + patch.get_width() for patch in cut]
        assert [patch.get_x() for patch in cut] == pytest.approx([0.0, *ends[:-1]])
        assert axes.get_xlim() == pytest.approx((0.0, max(100.0, ends[-1])))
        names = " ".join(label.get_text() for label in axes.texts).replace("\n", " ")
        assert all(f"{part.name} {part.size}" in names for part in bar.parts)
        boxes = [Text.get_window_extent(label) for label in axes.texts]
        assert not any(one.overlaps(other) for number, one in enumerate(boxes) for other in boxes[number + 1 :]), (
            "names cover each other"
        )
    shown = [runs_showing_parts(given_budget.runs, here) for here in budgets_by_channel(given_budget)]
    assert len(figure.axes) == len(rows) + sum(map(len, shown))


def panels_of(figure: Figure) -> list[Axes]:
    return [axes for axes in figure.axes if axes.get_xlabel() == "Time (s)"]


def test_the_picture_shows_the_gap_of_a_run_and_its_parts_in_the_colours_of_the_bar() -> None:
    panel = panels_of(budget_figure(STRIBECK_ALONE))[0]
    run = next(run for run in STRIBECK_ALONE.runs if run.file == "000-drag.h5")
    gap, *parts, _ = panel.lines
    assert panel.get_title(loc="left") == "Drag, 0.5 mm/s"
    assert max(gap.get_ydata()) == pytest.approx(max(run.gap))
    assert [max(part.get_ydata()) for part in parts] == pytest.approx(
        [max(run.parts[cause]) for cause in ("stribeck", "model")]
    )
    assert [part.get_color() for part in parts] == [part.colour for part in budget_bars(STRIBECK_ALONE)[0].parts[:2]]
    assert gap.get_color() not in {part.colour for part in budget_bars(CROWDED)[0].parts}
    (words,) = panel.texts
    assert words.get_text() == f"Stribeck friction or adhesion: {run.rms('stribeck'):.0f} mN"
    assert words.get_color() == parts[0].get_color()
    assert len(panels_of(budget_figure(UNNAMED))[0].lines) == 2, "the rest is not drawn"
    assert not panels_of(budget_figure(replace(RIPPLE_AND_AGEING, runs=())))


@drawn("many")
def test_words_above_the_runs_do_not_cover_each_other(given_budget: GapBudget) -> None:
    long = tuple(replace(run, label="200 % strain", kind="relaxation") for run in given_budget.runs)
    figure = budget_figure(replace(given_budget, runs=long))
    with figure_style():
        lay_out(figure)
    panels = panels_of(figure)
    words = [label for axes in panels for label in (*axes.texts, axes.get_legend()) if label is not None]
    titles = [child for axes in panels for child in axes.get_children() if isinstance(child, Text) and child.get_text()]
    boxes = [one.get_window_extent() for one in dict.fromkeys((*words, *titles))]
    assert len(boxes) > 2 * len(panels)
    assert not any(one.overlaps(other) for number, one in enumerate(boxes) for other in boxes[number + 1 :])
    assert not any("…" in label.get_text() for label in (*titles, *figure.texts))


def run_with(file: str, kind: str, **sizes: float) -> RunContributions:
    """Return a run whose parts have these root mean squares, and whose gap is their sum."""
    ones = np.ones(4)
    parts = {cause: size * ones for cause, size in sizes.items()}
    gap = np.asarray(sum(sizes.values()) * ones)
    return RunContributions(file, kind, f"run {file}", "force", "mN", np.arange(4.0), ones, np.arange(4.0), gap, parts)


def test_each_part_is_shown_in_the_run_where_it_is_largest_and_no_run_twice() -> None:
    parts = budget(entry("stribeck", 0.5), entry("folds", 0.3), entry("unexplained", 0.2, 4.0, None))
    (here,) = budgets_by_channel(parts)
    runs = (
        run_with("a", "drag", stribeck=3.0, folds=1.0),
        run_with("b", "drag", stribeck=9.0, folds=4.0),
        run_with("c", "relaxation", stribeck=1.0, folds=9.0),
        run_with("d", "relaxation", stribeck=2.0, folds=1.0),
        run_with("e", "blank", stribeck=0.1, folds=2.0),
    )
    chosen = runs_showing_parts(runs, here)
    assert [(shown.run.file, shown.part.cause) for shown in chosen if shown.part is not None] == [
        ("b", "stribeck"),
        ("c", "folds"),
        ("a", "stribeck"),
    ]
    # Where it misleads the fit most, a part is not shown if another kind of run shows it nearly as well.
    misled = replace(runs[2], kind="drag"), run_with("f", "coulomb", stribeck=0.2, folds=3.0)
    assert [shown.run.file for shown in runs_showing_parts((*runs[:2], *misled), here)][:2] == ["b", "f"]
    assert [shown.run.file for shown in runs_showing_parts(runs[:1], here)] == ["a"]
    repeats = (replace(runs[0], label="run b"), runs[1], run_with("g", "drag", stribeck=1.0))
    assert [shown.run.file for shown in runs_showing_parts(repeats, here)] == ["b", "g", "a"]
    assert runs_showing_parts((), here) == ()


def test_a_run_where_the_effect_does_not_act_is_no_panel_of_it() -> None:
    (here,) = budgets_by_channel(budget(entry("stribeck", 0.9), entry("unexplained", 0.1, 4.0, None)))
    leaks = replace(run_with("relaxation", "relaxation", stribeck=13.0), acting_mN={"stribeck": 0.0})
    acts = replace(run_with("slow", "coulomb", stribeck=5.0), acting_mN={"stribeck": 9.0})
    assert [shown.run.file for shown in runs_showing_parts((leaks, acts), here)] == ["slow"]


def test_a_gap_without_a_name_is_shown_where_it_is_largest() -> None:
    (here,) = budgets_by_channel(UNNAMED)
    runs = tuple(run_with(f"{size:g}", "drag", place=size) for size in (1.0, 5.0, 3.0, 2.0))
    assert [(shown.run.file, shown.part) for shown in runs_showing_parts(runs, here)] == [
        ("5", None),
        ("3", None),
        ("2", None),
    ]
    (hum,) = budgets_by_channel(budget(entry("mains_hum", 0.9), entry("unexplained", 0.1, 4.0, None)))
    assert runs_showing_parts(runs, hum) == (), "block means do not show a spectral line"


def test_a_page_draws_the_bar_with_its_hatching() -> None:
    document = diagnosis_document(diagnosed(RIPPLE_AND_AGEING))
    html = render_page(without_pictures(document, but="budget"))
    assert html.count('role="img"') == 5
    used = set(re.findall(r"url\(#([\w.:-]+)\)", html))
    assert used
    assert used <= set(re.findall(r'id="([\w.:-]+)"', html))
    hatching = re.search(r"<pattern.*?</pattern>", html)
    assert hatching is not None
    assert re.search(r'fill="#[0-9a-f]{6}"', hatching[0])
