"""An exam of the gap diagnosis laid out for a reader: rates, detection, calibration, promised shrink."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from math import isfinite
from typing import TYPE_CHECKING

from dragrig.present.document import Cell, Column, Table, decimals, general_format
from dragrig.present.exam_figures import (
    exam_confusion_figure,
    exam_detection_figure,
    exam_promises_figure,
    exam_rates_figure,
    exam_reliability_figure,
)
from dragrig.present.terminal import terminal_table
from dragrig.scoring import ExamScore, ProbabilityCalibration, PromiseScore, Rate, ScoredCase, missed_cells

if TYPE_CHECKING:
    from rich.console import RenderableType

    from dragrig.scoring import DetectionBin

from dragrig.present.document import InlineFigure
from dragrig.present.figure_files import inline_figure
from dragrig.present.html_page import render_template
from dragrig.rig.session import software_version
from dragrig.scoring import DetectionBin


def exam_sentences(score: ExamScore, cases: int, seed: int, answers_sha256: str) -> Iterator[str]:
    """Sum an exam up: how many verdicts were right, what misled, and how that was made sure of."""
    told = score.confusion
    count = sum(map(sum, told.counts))
    wrong = score["all, wrong above 0.8"]
    yield f"{count - len(score.missed)} of {count} verdicts are right; {wrong.held} mislead with more than 0.8."
    yield (
        f"{cases} campaigns of the blind plant, seed {seed}. Their answers were sealed before any was diagnosed, with "
        f"sha256 {answers_sha256[:16]}…, and each was diagnosed by a process that was given its runs alone."
    )
    yield (
        "Intervals hold 95 % (Wilson). They say how certain a rate is for campaigns like these: simulated ones, of "
        "which a real rig is none."
    )


def calibration_sentences(one: ProbabilityCalibration) -> Iterator[str]:
    """Say how good the probabilities are."""
    if isfinite(one.skill):
        yield (
            f"Brier score of all hypotheses {one.brier:.3f}, against {one.brier_base:.3f} for always stating how often "
            f"each is true in this exam: a skill of {one.skill:.2f}."
        )
    if isfinite(one.verdict_skill):
        yield (
            f"Of the verdict's probability alone {one.verdict_brier:.3f}, against {one.verdict_base:.3f} for always "
            f"stating the share of right verdicts: a skill of {one.verdict_skill:.2f}. The better a diagnosis, the "
            "less there is left to win here."
        )


def promise_sentences(one: PromiseScore) -> Iterator[str]:
    """Say what came of the promised shrink."""
    fresh = "fresh runs of the same specimen at other speeds and strains"
    yield (
        f"Promised and achieved share of the gap that closes, over {len(one.outcomes)} campaigns with {fresh}: they "
        f"differ by {one.difference:.3f} in the median{_right_difference_text(one)}."
    )
    if one.closed.count:
        yield f"Of the right names at full size and at a third, {_rate_text(one.closed)} close 90 % of the gap there."
    if one.within.count:
        yield (
            f"In {_rate_text(one.within)} the achieved share lies in the promised 95 % interval. That interval is over "
            "the runs of one session; what other speeds, strains and another session change comes on top of it. "
            "The coverage of parameters cannot be checked: the plant's forms differ from the catalogue's, so that no "
            "true value exists."
        )


def _right_difference_text(one: PromiseScore) -> str:
    return f", and by {one.right_difference:.3f} where the name is right" if isfinite(one.right_difference) else ""


def _rate_text(one: Rate) -> str:
    return f"{one.held} of {one.count} ({one.low:.2f} to {one.high:.2f})"


ScoreJson = dict[str, object]


def score_json(score: ExamScore) -> ScoreJson:
    """Return all that a score says, without any NaN or infinity."""
    one = score.calibration
    return {
        "rates": [rate_json(each) for each in score.rates],
        "withheld": [rate_json(each) for each in score.withheld],
        "detection": [
            {
                "d_prime": {"low": each.low, "high": _finite_float(each.high)},
                "gap_seen": rate_json(each.seen),
                "right_name": rate_json(each.named),
                "wrong_name": rate_json(each.misled),
            }
            for each in score.detection
        ],
        "confusion": asdict(score.confusion),
        "calibration": {
            "brier": _finite_float(one.brier),
            "brier_base_rate": _finite_float(one.brier_base),
            "brier_skill": _finite_float(one.skill),
            "verdict_brier": _finite_float(one.verdict_brier),
            "verdict_brier_base_rate": _finite_float(one.verdict_base),
            "verdict_brier_skill": _finite_float(one.verdict_skill),
            "reliability": [{**asdict(each), "share": each.share} for each in one.bins],
        },
        "promises": {
            "median_absolute_difference": _finite_float(score.promises.difference),
            "median_absolute_difference_right": _finite_float(score.promises.right_difference),
            "within_interval": rate_json(score.promises.within),
            "closed_90": rate_json(score.promises.closed),
            "campaigns": [asdict(each) for each in score.promises.outcomes],
        },
        "not_right": [_wrong_verdict_json(each) for each in score.missed],
    }


def rate_json(rate: Rate) -> ScoreJson:
    """Return a rate; its share and interval are None where there are no cases."""
    return {
        "name": rate.name,
        "held": rate.held,
        "count": rate.count,
        "share": _finite_float(rate.share),
        "interval_95": [_finite_float(rate.low), _finite_float(rate.high)] if rate.count else None,
    }


def _wrong_verdict_json(case: ScoredCase) -> ScoreJson:
    return {
        "case": case.name,
        "truth": case.answer.truth,
        "form": list(case.answer.form),
        "size": list(case.answer.size),
        "d_prime": case.d_prime,
        "verdict": case.diagnosis.verdict,
        "effects": list(case.diagnosis.effects),
        "probability": case.diagnosis.probability,
    }


def _finite_float(value: float) -> float | None:
    return value if isfinite(value) else None


RATE_HEADER: Sequence[str] = ("", "held", "share", "95 % interval")

RATE_NUMBER_COLUMNS = (1, 2, 3)


def rate_row(one: "Rate") -> tuple[str, ...]:
    """Return a rate's name, how often it held, its share and its interval."""
    if not one.count:
        return one.name, "no case", "", ""
    return one.name, f"{one.held} of {one.count}", f"{one.share:.2f}", f"{one.low:.2f} to {one.high:.2f}"


MAX_WRONG_VERDICTS = 40


def exam_parts(found: ExamScore, cases: int, seed: int, answers_sha256: str) -> "Iterator[RenderableType]":
    """Yield all that an exam says, the sentence that sums it up first."""
    yield "\n".join(exam_sentences(found, cases, seed, answers_sha256))
    yield terminal_table(
        "How often the diagnosis is right", RATE_HEADER, map(rate_row, found.rates), RATE_NUMBER_COLUMNS
    )
    if any(one.count for one in found.withheld):
        title = "Where the true effect is taken out of the catalogue"
        yield terminal_table(
            title, RATE_HEADER, map(rate_row, (one for one in found.withheld if one.count)), RATE_NUMBER_COLUMNS
        )
    if found.detection:
        yield _detection_part(found.detection)
    if found.calibration.bins:
        yield "\n".join(calibration_sentences(found.calibration))
        yield _reliability_part(found.calibration)
    if found.promises.outcomes:
        yield "\n".join(promise_sentences(found.promises))
    if found.missed:
        header = ("case", "truth", "form", "size", "said", "probability")
        more = (
            f", the first {MAX_WRONG_VERDICTS} of {len(found.missed)}" if len(found.missed) > MAX_WRONG_VERDICTS else ""
        )
        yield terminal_table(
            f"Not right{more}", header, [missed_cells(one) for one in found.missed[:MAX_WRONG_VERDICTS]], (5,)
        )


def _detection_part(bins: "Sequence[DetectionBin]") -> "RenderableType":
    header = ("d′", "effects", "a gap is seen", "the right name", "a wrong name")
    rows = [
        (
            f"{one.low:g} to {one.high:g}" if isfinite(one.high) else f"above {one.low:g}",
            str(one.seen.count),
            _share_text(one.seen),
            _share_text(one.named),
            _share_text(one.misled),
        )
        for one in bins
    ]
    return terminal_table("Detection against size (d′ of the hidden effect)", header, rows, (1, 2, 3, 4))


def _reliability_part(calibration: "ProbabilityCalibration") -> "RenderableType":
    header = ("probability", "verdicts", "right", "would be right, 95 %")
    rows = [
        (
            f"{one.low:g} to {one.high:g}",
            str(one.count),
            f"{one.share:.2f}",
            f"{one.band[0]:.2f} to {one.band[1]:.2f}",
        )
        for one in calibration.bins
    ]
    return terminal_table("Reliability: verdicts by their probability", header, rows, (1, 2))


def _share_text(one: "Rate") -> str:
    return f"{one.share:.2f} ({one.low:.2f} to {one.high:.2f})"


TWO_DECIMALS = decimals(2)


def exam_tables(score: ExamScore) -> dict[str, Table]:
    """Return all tables by name; one that has nothing to say has no rows."""
    made = (
        _rates_table("rates", "Each with its 95 % interval (Wilson)", score.rates),
        _rates_table("withheld", "Single effects, diagnosed with the true one taken out", score.withheld),
        _detection_table(score),
        _reliability_table(score),
        _wrong_verdict_table(score),
    )
    return {table.name: table for table in made}


def _rates_table(name: str, caption: str, rates: Sequence[Rate]) -> Table:
    columns = (
        Column("rate", "what"),
        Column("held", "held", general_format),
        Column("count", "of", general_format),
        Column("share", "share", TWO_DECIMALS),
        Column("low", "95 % from", TWO_DECIMALS),
        Column("high", "to", TWO_DECIMALS),
    )
    rows = tuple((one.name, one.held, one.count, one.share, one.low, one.high) for one in rates if one.count)
    return Table(name, caption, columns, rows)


def _detection_table(score: ExamScore) -> Table:
    columns = (
        Column("d_prime", "d′"),
        Column("effects", "effects", general_format),
        Column("seen", "a gap is seen", TWO_DECIMALS),
        Column("named", "the right name", TWO_DECIMALS),
        Column("misled", "a wrong name", TWO_DECIMALS),
    )
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (
            f"{one.low:g} to {one.high:g}" if isfinite(one.high) else f"above {one.low:g}",
            one.seen.count,
            one.seen.share,
            one.named.share,
            one.misled.share,
        )
        for one in score.detection
    )
    return Table("detection", "Single effects by size", columns, rows)


def _reliability_table(score: ExamScore) -> Table:
    columns = (
        Column("from", "probability from", TWO_DECIMALS),
        Column("to", "to", TWO_DECIMALS),
        Column("count", "verdicts", general_format),
        Column("share", "right", TWO_DECIMALS),
        Column("band_low", "would be, 95 % from", TWO_DECIMALS),
        Column("band_high", "to", TWO_DECIMALS),
    )
    rows = tuple((one.low, one.high, one.count, one.share, *one.band) for one in score.calibration.bins)
    return Table("reliability", "Verdicts by their probability", columns, rows)


def _wrong_verdict_table(score: ExamScore) -> Table:
    names = ("case", "truth", "form", "size", "said", "probability")
    rows = tuple(missed_cells(one) for one in score.missed)
    return Table("not-right", "Every verdict that is not right", tuple(Column(one, one) for one in names), rows)


def inline_exam_figures(score: ExamScore) -> dict[str, InlineFigure]:
    """Draw all figures; those without anything to show are missing."""
    drawn = {
        "rates": inline_figure(
            exam_rates_figure((*score.rates, *score.withheld)),
            "A row for each rate: its share and its interval.",
            "Of “a name above 0.5” and “wrong above 0.8” less is better; of all others, more.",
        ),
        "confusion": inline_figure(
            exam_confusion_figure(score.confusion),
            "A table of counts: what was said, by what was hidden.",
            "Of an effect at a tenth of its size, no gap is right too; unknown is right where the catalogue does not "
            "have what is hidden.",
        ),
    }
    if score.detection:
        drawn["detection"] = inline_figure(
            exam_detection_figure(score.detection),
            "Three curves over the size of an effect: a gap is seen, the right name, a wrong name.",
            "Numbers above: campaigns of the bin. Bars hold 95 % (Wilson). Campaigns whose nominal model is slightly "
            "wrong are left out.",
        )
    if score.calibration.bins:
        drawn["reliability"] = inline_figure(
            exam_reliability_figure(score.calibration),
            "Points near a diagonal: the share of right verdicts over their probability.",
            "A point above its band: more verdicts are right than was stated; below it, fewer.",
        )
    if score.promises.outcomes:
        drawn["promises"] = inline_figure(
            exam_promises_figure(score.promises),
            "Points near a diagonal: the achieved share of the gap over the promised one.",
            "A campaign each. On the line, a promise was kept; below it, it was not.",
        )
    return drawn


def exam_page(score: ExamScore, cases: int, seed: int, answers_sha256: str) -> str:
    """Return the report on an exam as one HTML page."""
    summary, *honestly = exam_sentences(score, cases, seed, answers_sha256)
    return render_template(
        "blind.html",
        {
            "title": f"Exam of the gap diagnosis: {cases} campaigns",
            "software": software_version(),
            "summary": summary,
            "honestly": honestly,
            "settings": {"Campaigns": str(cases), "Seed": str(seed), "Answers' sha256": answers_sha256},
            "calibration": list(calibration_sentences(score.calibration)),
            "promises": list(promise_sentences(score.promises)) if score.promises.outcomes else [],
            "tables": exam_tables(score),
            "pictures": inline_exam_figures(score),
        },
    )
