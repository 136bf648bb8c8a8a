"""A score as JSON."""

from dataclasses import asdict
from math import isfinite

from dragrig.gap_scoring.rates import Rate
from dragrig.gap_scoring.records import Case
from dragrig.gap_scoring.scoring import Score

Table = dict[str, object]


def score_document(score: Score) -> Table:
    """Return all that a score says, without any NaN or infinity."""
    one = score.calibration
    return {
        "rates": [rate_table(each) for each in score.rates],
        "withheld": [rate_table(each) for each in score.withheld],
        "detection": [
            {
                "d_prime": {"low": each.low, "high": _finite(each.high)},
                "gap_seen": rate_table(each.seen),
                "right_name": rate_table(each.named),
                "wrong_name": rate_table(each.misled),
            }
            for each in score.detection
        ],
        "confusion": asdict(score.confusion),
        "calibration": {
            "brier": _finite(one.brier),
            "brier_base_rate": _finite(one.brier_base),
            "brier_skill": _finite(one.skill),
            "verdict_brier": _finite(one.verdict_brier),
            "verdict_brier_base_rate": _finite(one.verdict_base),
            "verdict_brier_skill": _finite(one.verdict_skill),
            "reliability": [{**asdict(each), "share": each.share} for each in one.bins],
        },
        "promises": {
            "median_absolute_difference": _finite(score.promises.difference),
            "median_absolute_difference_right": _finite(score.promises.right_difference),
            "within_interval": rate_table(score.promises.within),
            "closed_90": rate_table(score.promises.closed),
            "campaigns": [asdict(each) for each in score.promises.kept],
        },
        "not_right": [_missed(each) for each in score.missed],
    }


def rate_table(rate: Rate) -> Table:
    """Return a rate; its share and interval are None where there are no cases."""
    return {
        "name": rate.name,
        "held": rate.held,
        "count": rate.count,
        "share": _finite(rate.share),
        "interval_95": [_finite(rate.low), _finite(rate.high)] if rate.count else None,
    }


def _missed(case: Case) -> Table:
    return {
        "case": case.name,
        "truth": case.answer.truth,
        "form": list(case.answer.form),
        "size": list(case.answer.size),
        "d_prime": case.amount,
        "verdict": case.said.verdict,
        "effects": list(case.said.effects),
        "probability": case.said.probability,
    }


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None
