"""An exam of the gap diagnosis laid out for a reader: rates, detection, calibration, promised shrink."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import isfinite
from typing import TYPE_CHECKING

from dragrig import present
from dragrig.analysis import UNKNOWN, percent_text
from dragrig.present import (
    Column,
    Document,
    Facts,
    Field,
    Figure,
    FormattedNumber,
    Section,
    Table,
    Text,
    TextKind,
    attributes_json,
    decimals,
    shortest,
)
from dragrig.scoring import ExamScore, ProbabilityCalibration, PromiseScore, Rate, wilson_rate

if TYPE_CHECKING:
    from dragrig.analysis.gap import VerdictCalibration

MAX_WRONG_VERDICTS = 40
"""Wrong verdicts that a terminal lists."""


def exam_document(score: ExamScore, cases: int, seed: int, answers_sha256: str) -> Document:
    """Lay out an exam; `answers_sha256` is the seal of its answers."""
    answer, *procedure = _exam_sentences(score, cases, seed, answers_sha256)
    return Document(
        title=f"Exam of the gap diagnosis: {cases} campaigns",
        badges=("simulated",),
        answer=answer,
        sections=(
            _rates_section(score),
            _confusion_section(score),
            _detection_section(score),
            _calibration_section(score),
            _promises_section(score),
            Section(
                "procedure",
                "6. How it was held",
                (
                    Text(" ".join(procedure), TextKind.CAUTION),
                    Facts({"Campaigns": str(cases), "Seed": str(seed), "SHA-256 of the answers": answers_sha256}),
                ),
            ),
        ),
        data=score_json(score),
    )


def calibration_document(calibration: "VerdictCalibration", cross_validated: Sequence[Rate] | None) -> Document:
    """Lay out what was learnt from exams, and how often verdicts are right in cross-validation."""
    gate = calibration.gate
    columns = (Column("feature", "feature"), Column("weight", "weight", decimals(2, signed=True)))
    seeds = ", ".join(map(str, calibration.seeds))
    return Document(
        title=f"Learnt from {calibration.cases} campaigns with hidden effects (seeds {seeds}).",
        lead=(
            f"Probability of a gap is 0.5 where an effect explains Δχ²/2 = {gate.least_gain:.1f}, or where "
            f"{gate.least_left:.1%} of χ² stays unexplained.",
        ),
        sections=(
            Section(
                "weights",
                "Weights of the features of an explanation",
                (Table("weights", "", columns, tuple(sorted(calibration.weights.items()))),),
            ),
            Section(
                "cross-validation",
                "Cross-validation",
                (
                    rates_table(
                        "cross-validated",
                        "How often verdicts learnt from the other campaigns are right",
                        cross_validated or (),
                    ),
                ),
            ),
        ),
        data={
            **calibration.model_dump(mode="json"),
            **({} if cross_validated is None else {"cross_validated": [rate_json(rate) for rate in cross_validated]}),
        },
    )


def rates_table(name: str, caption: str, rates: Iterable[Rate]) -> Table:
    """Tabulate how often something held, each rate that has cases with its Wilson interval."""
    return Table.of(
        name,
        caption,
        (rate for rate in rates if rate.count),
        Field("rate", "rate", lambda rate: rate.name),
        Field("held", "held", lambda rate: rate.held, shortest()),
        Field("count", "of", lambda rate: rate.count, shortest()),
        Field("share", "share", lambda rate: rate.share, decimals(2)),
        Field("interval_95", "95 % interval", lambda rate: _interval(rate.low, rate.high)),
    )


def _exam_sentences(score: ExamScore, cases: int, seed: int, answers_sha256: str) -> Iterator[str]:
    count = sum(map(sum, score.confusion.counts))
    confident = score["all, wrong above 0.8"].held
    wrong = f"{confident or 'no'} wrong verdict{'' if confident == 1 else 's'} above probability 0.8"
    right = wilson_rate("right", [case < count - len(score.missed) for case in range(count)])
    interval = f" (95 % interval {percent_text(right.low)} to {percent_text(right.high)})" if count else ""
    yield f"{right.held} of {count} verdicts are right{interval}; {wrong}."
    yield (
        f"{cases} campaigns of the blind plant, seed {seed}. Their answers were sealed before any was diagnosed, with "
        f"SHA-256 {answers_sha256[:16]}…, and each was diagnosed by a process that had access to its runs alone."
    )
    yield (
        "Intervals hold 95 % (Wilson). They say how certain a rate is for simulated campaigns like these; a real rig "
        "may differ from all of them."
    )


def _rates_section(score: ExamScore) -> Section:
    withheld = rates_table("withheld", "", score.withheld)
    explanation = (
        "Campaigns with one effect were diagnosed again with that effect taken out of the catalogue. Right is then "
        "unknown, or a near-alias that is named with doubt: with a probability below 0.5, or beside others that are "
        "indistinguishable from it."
    )
    return Section(
        "rates",
        "1. How often the diagnosis is right",
        (
            Text(
                "Less is better of “a name above 0.5” and “wrong above 0.8”, more of all others.", TextKind.EXPLANATION
            ),
            rates_table("rates", "", score.rates),
            Section(
                "withheld",
                "Where the true effect is withheld from the catalogue",
                (Text(explanation, TextKind.EXPLANATION), withheld) if withheld else (),
            ),
        ),
    )


def _confusion_section(score: ExamScore) -> Section:
    return Section(
        "confusion",
        "2. Wrong verdicts",
        (
            Figure(
                "confusion",
                "A table of counts: the verdict, by the hidden effect.",
                "Of an effect at a tenth of its size, no gap is right too; unknown is right where the catalogue does "
                "not have what is hidden.",
                lambda: present.exam_confusion_figure(score.confusion),
            ),
            missed_table(score),
        ),
    )


def missed_table(score: ExamScore) -> Table:
    """Tabulate the cases whose verdict is not right."""
    return Table.of(
        "not-right",
        "Every verdict that is not right" if score.missed else "",
        score.missed,
        Field("case", "case", lambda case: case.name),
        Field("truth", "truth", lambda case: case.answer.truth or ", ".join(case.answer.effects)),
        Field("form", "form", lambda case: ", ".join(case.answer.form)),
        Field("size", "size", lambda case: ", ".join(f"{size:.2g}" for size in case.answer.size)),
        Field("said", "verdict", lambda case: "+".join(case.diagnosis.effects) or case.diagnosis.verdict),
        Field("probability", "probability", lambda case: f"{case.diagnosis.probability:.2f}"),
        brief_rows=MAX_WRONG_VERDICTS,
    )


def _detection_section(score: ExamScore) -> Section:
    table = Table.of(
        "detection",
        "Single effects by size, with 95 % intervals",
        score.detection,
        Field(
            "d_prime",
            "d′ of the hidden effect",
            lambda size: _range(size.low, size.high) if isfinite(size.high) else f"above {size.low:g}",
        ),
        Field("effects", "effects", lambda size: size.seen.count, shortest()),
        Field("seen", "gap detected", lambda size: _share(size.seen)),
        Field("named", "right name", lambda size: _share(size.named)),
        Field("misled", "wrong name", lambda size: _share(size.misled)),
    )
    figure = Figure(
        "detection",
        "Three curves over the size of an effect: gap detected, right name, wrong name.",
        "Numbers above: campaigns of the bin. Bars hold 95 % (Wilson). Campaigns whose nominal model is slightly "
        "wrong are left out.",
        lambda: present.exam_detection_figure(score.detection),
    )
    return Section("detection", "3. How small an effect may be", (figure, table) if score.detection else ())


def _calibration_section(score: ExamScore) -> Section:
    if not score.calibration.reliability:
        return Section("calibration", "", ())
    return Section(
        "calibration",
        "4. How well the probabilities are calibrated",
        (
            *map(Text, _calibration_sentences(score.calibration)),
            Figure(
                "reliability",
                "Points near a diagonal: the share of right verdicts over their probability.",
                "A point above its band: more verdicts are right than was stated; below it, fewer.",
                lambda: present.exam_reliability_figure(score.calibration),
            ),
            Table.of(
                "reliability",
                "Verdicts by their probability",
                score.calibration.reliability,
                Field("probability", "probability", lambda verdicts: _range(verdicts.low, verdicts.high)),
                Field("count", "verdicts", lambda verdicts: verdicts.count, shortest()),
                Field("share", "right", lambda verdicts: verdicts.share, decimals(2)),
                Field("band_95", "expected, 95 %", lambda verdicts: _interval(*verdicts.band)),
            ),
        ),
    )


def _calibration_sentences(calibration: ProbabilityCalibration) -> Iterator[str]:
    if isfinite(calibration.brier_skill):
        yield (
            f"Brier score of all hypotheses {calibration.brier:.3f}, against {calibration.brier_base_rate:.3f} for "
            f"always stating the base rates of this exam: skill {calibration.brier_skill:.2f}."
        )
    if isfinite(calibration.verdict_brier_skill):
        yield (
            f"Brier score of the verdict's probability {calibration.verdict_brier:.3f}, against "
            f"{calibration.verdict_brier_base_rate:.3f} for always stating the share of right verdicts: skill "
            f"{calibration.verdict_brier_skill:.2f}. The more verdicts are right, the less skill can be gained here."
        )


def _promises_section(score: ExamScore) -> Section:
    if not score.promises.outcomes:
        return Section("promises", "", ())
    return Section(
        "promises",
        "5. Predicted and achieved gap reduction",
        (
            *map(Text, _promise_sentences(score.promises)),
            Figure(
                "promises",
                "Points near a diagonal: the achieved share of the gap over the predicted one.",
                "One point per campaign. On the line, the prediction was right; below it, less of the gap closed.",
                lambda: present.exam_promises_figure(score.promises),
            ),
        ),
    )


def _promise_sentences(promises: PromiseScore) -> Iterator[str]:
    fresh = "fresh runs of the same specimen at other speeds and strains"
    right = promises.right_difference
    where_right = f", and by {right:.3f} where the name is right" if isfinite(right) else ""
    yield (
        f"Predicted and achieved share of the gap that closes, over {len(promises.outcomes)} campaigns with {fresh}: "
        f"they differ by {promises.difference:.3f} in the median{where_right}."
    )
    if promises.closed.count:
        yield f"Of the right names at full size and at a third, {_of(promises.closed)} close 90 % of the gap there."
    if promises.kept.count:
        yield f"On the fresh runs {_of(promises.kept)} of these right names keep their promise."
    if promises.within.count:
        yield (
            f"In {_of(promises.within)} the achieved share lies in the predicted 95 % interval. That interval is over "
            "the runs of one session; other speeds, strains and another session add to it. The coverage of parameters "
            "cannot be checked: the plant's forms differ from the catalogue's, so that no true value exists."
        )


def score_json(score: ExamScore) -> Mapping[str, object]:
    """Return the score for JSON."""
    promises = score.promises
    return {
        "rates": [rate_json(rate) for rate in score.rates],
        "withheld": [rate_json(rate) for rate in score.withheld],
        "detection": [
            {
                "d_prime": {"low": size.low, "high": size.high},
                "gap_seen": rate_json(size.seen),
                "right_name": rate_json(size.named),
                "wrong_name": rate_json(size.misled),
            }
            for size in score.detection
        ],
        "confusion": attributes_json(score.confusion, "hidden", "counts", predicted="said"),
        "calibration": score.calibration,
        "promises": {
            **attributes_json(promises, difference="median_absolute_difference", outcomes="campaigns"),
            "median_absolute_difference_right": promises.right_difference,
            "within_interval": rate_json(promises.within),
            "closed_90": rate_json(promises.closed),
            "kept": rate_json(promises.kept),
        },
        "not_right": [
            {
                "case": case.name,
                **attributes_json(case.answer, "truth", "form", "size"),
                "d_prime": case.d_prime,
                **attributes_json(case.diagnosis, "verdict", "effects", "probability"),
            }
            for case in score.missed
        ],
    }


def rate_json(rate: Rate) -> Mapping[str, object]:
    """Return a rate as JSON; its share and interval are null where there are no cases."""
    return {
        **attributes_json(rate, "name", "held", "count", "share"),
        "interval_95": [rate.low, rate.high] if rate.count else None,
    }


def _range(low: float, high: float) -> str:
    return f"{low:g} to {high:g}"


def _interval(low: float, high: float) -> str:
    return f"{low:.2f} to {high:.2f}"


def _share(rate: Rate) -> FormattedNumber:
    if not rate.count:
        return FormattedNumber(None, UNKNOWN)
    return FormattedNumber(rate.share, f"{rate.share:.2f} ({_interval(rate.low, rate.high)})")


def _of(rate: Rate) -> str:
    return f"{rate.held} of {rate.count} ({_interval(rate.low, rate.high)})"
