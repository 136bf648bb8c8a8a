"""What a diagnosis says, as text for a terminal."""

from collections.abc import Iterator, Mapping
from math import isfinite
from typing import TYPE_CHECKING

from dragrig.analysis.gap.results import Verdict
from dragrig.analysis.gap.sentences import (
    chance_in_words,
    counted,
    is_verdict,
    meaning_of_probabilities,
    name_of,
    percent,
    sentence,
    shrink_sentences,
    verdict_sentences,
    what_it_is,
    would_have_seen,
)
from dragrig.analysis.gap.where_words import places, where_sentence
from dragrig.analysis.paper import printed
from dragrig.cli.gap.printing import table
from dragrig.cli.precision import chance, interval_of, to_error, unit_of

if TYPE_CHECKING:
    from rich.console import RenderableType

    from dragrig.analysis.gap.results import BeforeAfter, Diagnosis, Ranked, Shrink

MOST_RANKED = 8
"""So many hypotheses are told; the others are in the JSON."""
MOST_FILES = 12


def diagnosis_parts(diagnosis: "Diagnosis") -> "Iterator[RenderableType]":
    """Yield all that a diagnosis says, the verdict first."""
    yield "\n".join(verdict_sentences(diagnosis))
    if diagnosis.effects:
        yield "\n".join(map(what_it_is, diagnosis.effects))
    yield _honestly(diagnosis)
    yield from _where(diagnosis)
    yield _ranking(diagnosis)
    yield from _parameters(diagnosis)
    if diagnosis.shrink is not None:
        yield from shrink_parts(diagnosis.shrink, named=bool(diagnosis.effects))
    if diagnosis.cannot_answer:
        yield _lines("These runs cannot answer", map(sentence, diagnosis.cannot_answer))
    if diagnosis.next_experiment is not None:
        yield f"To run next\n  {diagnosis.next_experiment.why}"
    if diagnosis.left_out:
        yield _lines("Left out", _left_out({one.what: one.reason for one in diagnosis.left_out}))
    if diagnosis.remarks:
        yield "\n".join(f"! {one}" for one in diagnosis.remarks)


def shrink_parts(shrink: "Shrink", *, named: bool = True) -> "Iterator[RenderableType]":
    """Yield how far the gap shrinks, and R² in both forms beside the paper's; before only where no effect is named."""
    yield "\n".join(shrink_sentences(shrink, named=named))
    forms = (("Eq. 15", shrink.r2_eq15), ("correlation²", shrink.r2_corr))
    if all(value is None for _, one in forms for value in _all_of(one)):
        return
    rows = [row for name, one in forms for row in list(_r2(name, one))[: 2 if named else 1]]
    paper = ("the paper, its own gut", "", f"{printed.R2_BELOW:.4f}", f"{printed.R2_ABOVE:.4f}")
    at = printed.BOUNDARY_MM_S if shrink.boundary_mm_s is None else shrink.boundary_mm_s
    header = ("", "", f"up to {at:g} mm/s", "above")
    title = "R² of steady drag; the paper's is quoted, its measurements are not in its text"
    yield table(title, header, [*rows, paper], (2, 3))


def _honestly(diagnosis: "Diagnosis") -> str:
    seen = "" if diagnosis.verdict is Verdict.NO_GAP else f" {would_have_seen(diagnosis)}"
    used = counted(diagnosis.runs, "run")
    fitted = f"{len(diagnosis.used_for_fit)} in the fit, {len(diagnosis.held_out)} held out in turn"
    return (
        f"{meaning_of_probabilities(diagnosis)}{seen}\n"
        f"Specimen {diagnosis.specimen}, nominal model {diagnosis.nominal}: {used}, {fitted}. "
        f"What is below {diagnosis.tolerance_mN:g} mN does not matter (--tolerance)."
    )


def _where(diagnosis: "Diagnosis") -> "Iterator[RenderableType]":
    rows = [(one.axis, one.where, chance(one.p) if isfinite(one.p) else "") for one in places(diagnosis.where)]
    if rows:
        title = "Where: shares of what is above noise and scatter of repeats; p is the chance without a gap"
        yield table(title, ("", "", ""), rows)
    yield where_sentence(diagnosis.where)


def _ranking(diagnosis: "Diagnosis") -> "RenderableType":
    ranked = sorted(diagnosis.ranking, key=lambda one: -one.probability)
    rows = [(one.hypothesis, chance_in_words(one.probability), _held_out(one), name_of(one.hypothesis))
            for one in ranked[:MOST_RANKED]]  # fmt: skip
    more = len(ranked) - len(rows)
    title = "Which" + (f", the first {MOST_RANKED} of {len(ranked)}" if more else "")
    return table(title, ("hypothesis", "probability", "takes away, held out", ""), rows, (1, 2))


def _parameters(diagnosis: "Diagnosis") -> "Iterator[RenderableType]":
    found = next((one for one in diagnosis.ranking if is_verdict(one, diagnosis)), None)
    if found is None or not found.parameters:
        return
    rows = [(one.name, to_error(one.value, one.standard_error), interval_of(one), unit_of(one.unit))
            for one in found.parameters]  # fmt: skip
    yield table("How large", ("parameter", "value", "95 % interval", ""), rows, (1, 2))


def _held_out(one: "Ranked") -> str:
    return "" if one.held_out_improvement is None else percent(one.held_out_improvement)


def _r2(name: str, one: "BeforeAfter") -> Iterator[tuple[str, str, str, str]]:
    yield name, "before", _four(one.before_below), _four(one.before_above)
    yield "", "after", _four(one.after_below), _four(one.after_above)


def _all_of(one: "BeforeAfter") -> "tuple[float | None, ...]":
    return one.before_below, one.before_above, one.after_below, one.after_above


def _four(value: float | None) -> str:
    return "-" if value is None or not isfinite(value) else f"{value:.4f}"


def _left_out(reasons: Mapping[str, str]) -> Iterator[str]:
    for place, (what, reason) in enumerate(reasons.items()):
        if place == MOST_FILES:
            yield f"and {len(reasons) - MOST_FILES} more"
            return
        yield f"{what}: {reason}"


def _lines(title: str, lines: Iterator[str]) -> str:
    return "\n".join((title, *(f"  {one}" for one in lines)))
