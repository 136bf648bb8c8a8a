"""A diagnosis as the JSON of a gap report, for programs."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from math import floor, isfinite

from dragrig.analysis.gap.planning.results import NextExperiment, NextRun
from dragrig.analysis.gap.results import BeforeAfter, Diagnosis, Ranked, Shrink, UnknownGap
from dragrig.analysis.gap.sentences import NO_GAP, verdict_sentences
from dragrig.analysis.identification.results import Quantity
from dragrig.identification_json import Table, finite, left_out_table

FORMAT, VERSION = "dragrig-gap", 1
STEPS = 1_000_000
"""Probabilities are told in millionths."""


def gap_document(
    diagnosis: Diagnosis, *, model: str | None = None, run_ids: Mapping[str, str] | None = None
) -> Mapping[str, object]:
    """Return a diagnosis as the JSON of a gap report, without any NaN or infinity.

    Parameters
    ----------
    model
        The file that the amended model was written to.
    run_ids
        Ids of the runs by the names of their files; a file without one is told by its name.
    """
    one, ids = diagnosis, run_ids or {}
    return {
        "format": FORMAT,
        "version": VERSION,
        "campaign": {
            "specimen": one.specimen,
            "nominal": one.nominal,
            "runs": one.runs,
            "used_for_fit": [ids.get(file, file) for file in one.used_for_fit],
            "held_out": [ids.get(file, file) for file in one.held_out],
            "left_out": left_out_table(one.left_out),
        },
        "verdict": one.verdict.value,
        "in_words": list(verdict_sentences(one)),
        "effects": list(one.effects),
        "ranking": _ranking(one.ranking),
        "confusable_with": list(one.confusable_with),
        "residual_unknown": one.residual_unknown,
        "unknown": None if one.unknown is None else _unknown(one.unknown),
        "would_have_seen_mN": finite(one.would_have_seen_mN),
        "tolerance_mN": finite(one.tolerance_mN),
        "where": _told(one.where.document()),
        "shrink": None if one.shrink is None else shrink_table(one.shrink),
        "model": model,
        "next_experiment": _next(one.next_experiment),
        "cannot_answer": list(one.cannot_answer),
        "remarks": list(one.remarks),
        "calibration": one.calibration,
        "evidence": None if one.evidence is None else asdict(one.evidence),
        "timings_s": _told(one.timings_s),
    }


def shrink_document(shrink: Shrink) -> Mapping[str, object]:
    """Return how far the gap shrinks as JSON of its own."""
    return {"format": FORMAT, "version": VERSION, "shrink": shrink_table(shrink)}


def next_document(found: NextExperiment | None) -> Mapping[str, object]:
    """Return the runs to make next as JSON of their own."""
    runs = () if found is None else found.runs
    return {
        "format": "dragrig-next",
        "version": VERSION,
        "why": None if found is None else found.why,
        "minutes": None if found is None else finite(found.minutes),
        "tried": 0 if found is None else found.tried,
        "runs": [_run(one) for one in runs],
    }


def _next(found: NextExperiment | None) -> Table | None:
    return None if found is None else {**_run(found.runs[0]), "tried": found.tried, "why": found.why}


def _run(one: NextRun) -> Table:
    return {
        "protocol": one.step.kind,
        **{name: _told(value) for name, value in one.settings.items()},
        "wait_s": finite(one.step.wait_s),
        "repeats": one.step.repeats,
        "minutes": finite(one.minutes),
        "between": [one.after.truth, one.after.rival or NO_GAP],
        "d_prime": {"before": finite(one.before.d_prime), "after": finite(one.after.d_prime)},
        "left": {"before": finite(one.before.left), "after": finite(one.after.left)},
    }


def shrink_table(shrink: Shrink) -> Table:
    """Return how far the gap shrinks as a part of the report."""
    one = shrink
    return {
        "gap_before_mN": finite(one.gap_before_mN),
        "gap_after_mN": finite(one.gap_after_mN),
        "noise_floor_mN": finite(one.noise_floor_mN),
        "closed": finite(one.closed),
        "closed_95ci": None if one.closed_95ci is None else [finite(end) for end in one.closed_95ci],
        "boundary_mm_s": finite(one.boundary_mm_s),
        "r2_eq15": _before_after(one.r2_eq15),
        "r2_corr": _before_after(one.r2_corr),
        "runs": list(one.runs),
    }


def rounded(probabilities: Sequence[float]) -> tuple[float, ...]:
    """Round probabilities to millionths that sum to 1, by largest remainders; what is no number counts as 0."""
    known = [max(one, 0.0) if isfinite(one) else 0.0 for one in probabilities]
    total = sum(known)
    if not total > 0:
        return tuple(0.0 for _ in known)
    exact = [STEPS * one / total for one in known]
    steps = [floor(one) for one in exact]
    by_remainder = sorted(range(len(exact)), key=lambda at: steps[at] - exact[at])
    for at in by_remainder[: STEPS - sum(steps)]:
        steps[at] += 1
    return tuple(one / STEPS for one in steps)


def _ranking(ranking: Iterable[Ranked]) -> list[Table]:
    known = tuple(ranking)
    return [
        {
            "hypothesis": one.hypothesis,
            "probability": probability,
            "parameters": {quantity.name: _quantity(quantity) for quantity in one.parameters},
            "held_out_improvement": finite(one.held_out_improvement),
        }
        for one, probability in zip(known, rounded([one.probability for one in known]), strict=True)
    ]


def _quantity(one: Quantity) -> Table:
    interval = [finite(end) for end in one.interval]
    return {"value": finite(one.value), "sd": finite(one.standard_error), "unit": one.unit, "interval_95": interval}


def _before_after(one: BeforeAfter) -> Table:
    return {
        "before": {"below": finite(one.before_below), "above": finite(one.before_above)},
        "after": {"below": finite(one.after_below), "above": finite(one.after_above)},
    }


def _unknown(one: UnknownGap) -> Table:
    return {
        "lives_in": one.lives_in,
        "shape": one.shape,
        "expression": one.expression or None,
        "held_out": finite(one.held_out),
    }


def _told(value: object) -> object:
    """Return a value of tables and lists with null in place of numbers that JSON does not know."""
    match value:
        case Mapping():
            return {str(key): _told(one) for key, one in value.items()}
        case list() | tuple():
            return [_told(one) for one in value]
        case float():
            return finite(value)
        case _:
            return value
