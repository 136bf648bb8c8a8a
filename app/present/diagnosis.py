"""A gap diagnosis laid out for a reader: where the gap is, which hypothesis explains it, how far it shrinks."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import floor, isfinite
from typing import TYPE_CHECKING

from dragrig.analysis.estimates import EstimatedQuantity
from dragrig.analysis.gap.diagnosis import (
    Diagnosis,
    GapReduction,
    NextExperiment,
    NextRun,
    R2BeforeAfter,
    RankedHypothesis,
    UnexplainedGap,
    Verdict,
)
from dragrig.analysis.gap.diagnosis_text import (
    NO_GAP,
    as_sentence,
    axis_texts,
    calibration_sentence,
    capitalise,
    count_text,
    detection_limit_sentence,
    display_name,
    domain_sentence,
    effect_description,
    is_stated_verdict,
    percent_text,
    probability_text,
    shrink_sentences,
    verdict_sentences,
)
from dragrig.analysis.paper import published as printed
from dragrig.present.document import (
    Cell,
    Column,
    Table,
    decimals,
    general_format,
    interval_text,
    p_value_text,
    rounded_to_error,
    significant,
    unit_text,
)
from dragrig.present.identification import JsonObject, finite_or_none, left_out_json
from dragrig.present.terminal import terminal_table
from dragrig.sim_backend.effects.base import catalogue

if TYPE_CHECKING:
    from rich.console import RenderableType

from dragrig.present.document import InlineFigure
from dragrig.present.html_page import render_template

DIAGNOSIS_FORMAT, DIAGNOSIS_VERSION = "dragrig-gap", 1

PROBABILITY_STEPS = 1_000_000
"""Probabilities are told in millionths."""


def diagnosis_json(
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
        "format": DIAGNOSIS_FORMAT,
        "version": DIAGNOSIS_VERSION,
        "campaign": {
            "specimen": one.specimen,
            "nominal": one.nominal,
            "runs": one.runs,
            "used_for_fit": [ids.get(file, file) for file in one.used_for_fit],
            "held_out": [ids.get(file, file) for file in one.held_out],
            "left_out": left_out_json(one.left_out),
        },
        "verdict": one.verdict.value,
        "in_words": list(verdict_sentences(one)),
        "effects": list(one.effects),
        "ranking": _ranking_json(one.ranking),
        "confusable_with": list(one.confusable_with),
        "residual_unknown": one.residual_unknown,
        "unknown": None if one.unknown is None else _unknown_gap_json(one.unknown),
        "would_have_seen_mN": finite_or_none(one.detection_limit_mN),
        "tolerance_mN": finite_or_none(one.tolerance_mN),
        "where": _finite_values(one.where.document()),
        "shrink": None if one.shrink is None else shrink_json(one.shrink),
        "model": model,
        "next_experiment": _next_run_json(one.next_experiment),
        "cannot_answer": list(one.limitations),
        "remarks": list(one.remarks),
        "calibration": one.calibration,
        "evidence": None if one.decision_inputs is None else one.decision_inputs.document(),
        "timings_s": _finite_values(one.timings_s),
    }


def shrink_report_json(shrink: GapReduction) -> Mapping[str, object]:
    """Return how far the gap shrinks as JSON of its own."""
    return {"format": DIAGNOSIS_FORMAT, "version": DIAGNOSIS_VERSION, "shrink": shrink_json(shrink)}


def next_experiment_json(found: NextExperiment | None) -> Mapping[str, object]:
    """Return the runs to make next as JSON of their own."""
    runs = () if found is None else found.runs
    return {
        "format": "dragrig-next",
        "version": DIAGNOSIS_VERSION,
        "why": None if found is None else found.reason,
        "minutes": None if found is None else finite_or_none(found.minutes),
        "tried": 0 if found is None else found.compared,
        "runs": [_planned_run_json(one) for one in runs],
    }


def _next_run_json(found: NextExperiment | None) -> JsonObject | None:
    return None if found is None else {**_planned_run_json(found.runs[0]), "tried": found.compared, "why": found.reason}


def _planned_run_json(one: NextRun) -> JsonObject:
    return {
        "protocol": one.step.kind,
        **{name: _finite_values(value) for name, value in one.settings.items()},
        "wait_s": finite_or_none(one.step.wait_s),
        "repeats": one.step.repeats,
        "minutes": finite_or_none(one.minutes),
        "between": [one.after.truth, one.after.rival or NO_GAP],
        "d_prime": {"before": finite_or_none(one.before.d_prime), "after": finite_or_none(one.after.d_prime)},
        "left": {
            "before": finite_or_none(one.before.remaining_share),
            "after": finite_or_none(one.after.remaining_share),
        },
    }


def shrink_json(shrink: GapReduction) -> JsonObject:
    """Return how far the gap shrinks as a part of the report."""
    one = shrink
    return {
        "gap_before_mN": finite_or_none(one.gap_before_mN),
        "gap_after_mN": finite_or_none(one.gap_after_mN),
        "noise_floor_mN": finite_or_none(one.noise_floor_mN),
        "closed": finite_or_none(one.closed),
        "closed_95ci": None if one.closed_95ci is None else [finite_or_none(end) for end in one.closed_95ci],
        "boundary_mm_s": finite_or_none(one.boundary_mm_s),
        "r2_eq15": _before_after_json(one.r2_eq15),
        "r2_corr": _before_after_json(one.r2_corr),
        "runs": list(one.runs),
    }


def round_probabilities(probabilities: Sequence[float]) -> tuple[float, ...]:
    """Round probabilities to millionths that sum to 1, by largest remainders; what is no number counts as 0."""
    known = [max(one, 0.0) if isfinite(one) else 0.0 for one in probabilities]
    total = sum(known)
    if not total > 0:
        return tuple(0.0 for _ in known)
    exact = [PROBABILITY_STEPS * one / total for one in known]
    steps = [floor(one) for one in exact]
    by_remainder = sorted(range(len(exact)), key=lambda at: steps[at] - exact[at])
    for at in by_remainder[: PROBABILITY_STEPS - sum(steps)]:
        steps[at] += 1
    return tuple(one / PROBABILITY_STEPS for one in steps)


def _ranking_json(ranking: Iterable[RankedHypothesis]) -> list[JsonObject]:
    known = tuple(ranking)
    return [
        {
            "hypothesis": one.hypothesis,
            "probability": probability,
            "parameters": {quantity.name: _parameter_json(quantity) for quantity in one.parameters},
            "held_out_improvement": finite_or_none(one.held_out_improvement),
        }
        for one, probability in zip(known, round_probabilities([one.probability for one in known]), strict=True)
    ]


def _parameter_json(one: EstimatedQuantity) -> JsonObject:
    interval = [finite_or_none(end) for end in one.interval]
    return {
        "value": finite_or_none(one.value),
        "sd": finite_or_none(one.standard_error),
        "unit": one.unit,
        "interval_95": interval,
    }


def _before_after_json(one: R2BeforeAfter) -> JsonObject:
    return {
        "before": {"below": finite_or_none(one.before_below), "above": finite_or_none(one.before_above)},
        "after": {"below": finite_or_none(one.after_below), "above": finite_or_none(one.after_above)},
    }


def _unknown_gap_json(one: UnexplainedGap) -> JsonObject:
    return {
        "lives_in": one.location,
        "shape": one.dependence,
        "expression": one.expression or None,
        "held_out": finite_or_none(one.held_out_share),
    }


def _finite_values(value: object) -> object:
    """Return a value of tables and lists with null in place of numbers that JSON does not know."""
    match value:
        case Mapping():
            return {str(key): _finite_values(one) for key, one in value.items()}
        case list() | tuple():
            return [_finite_values(one) for one in value]
        case float():
            return finite_or_none(value)
        case _:
            return value


PROBABILITY_COLUMN = Column("probability", "probability", decimals(3))


def diagnosis_tables(diagnosis: Diagnosis) -> dict[str, Table]:
    """Return all tables by name; one that has nothing to say has no rows."""
    made = (
        _location_table(diagnosis),
        _ranking_table(diagnosis),
        _parameter_table(diagnosis),
        _r2_table(diagnosis),
        _runs_table(diagnosis),
    )
    return {table.name: table for table in made}


def _location_table(diagnosis: Diagnosis) -> Table:
    columns = (Column("axis", "axis"), Column("where", "most of it"), Column("p", "p", significant(2)))
    rows = tuple((one.axis, one.where, one.p) for one in axis_texts(diagnosis.where))
    return Table("where", "p: chance of this without a gap", columns, rows)


def _ranking_table(diagnosis: Diagnosis) -> Table:
    columns = (
        Column("name", "hypothesis"),
        Column("hypothesis", "id"),
        PROBABILITY_COLUMN,
        Column("held_out_improvement", "takes away, held out", lambda value: f"{100 * value:.0f} %".replace("-", "−")),
    )
    ranked = sorted(diagnosis.ranking, key=lambda one: -one.probability)
    rows = tuple(
        (capitalise(display_name(one.hypothesis)), one.hypothesis, one.probability, one.held_out_improvement)
        for one in ranked
    )
    return Table("ranking", "Held out: part of the excess squares, on runs not in the fit", columns, rows)


def _parameter_table(diagnosis: Diagnosis) -> Table:
    columns = (
        Column("parameter", "parameter"),
        Column("value", "value", significant(3)),
        Column("low", "95 % from", significant(3)),
        Column("high", "to", significant(3)),
        Column("unit", "unit"),
        Column("meaning", "what it is"),
    )
    found = next((one for one in diagnosis.ranking if is_stated_verdict(one, diagnosis)), None)
    rows = tuple(
        (
            one.name,
            one.value,
            *one.interval,
            "" if one.unit == "1" else one.unit,
            _parameter_meaning(one.name, diagnosis),
        )
        for one in (() if found is None else found.parameters)
    )
    return Table("parameters", "How large it is, fitted again with all parameters of the specimen", columns, rows)


def _parameter_meaning(parameter: str, diagnosis: Diagnosis) -> str:
    """Return what a parameter is; nothing where several effects have one of its name."""
    known = [catalogue()[one] for one in diagnosis.effects if one in catalogue()]
    found = [each.meaning for effect in known for each in effect.parameters if parameter.endswith(each.name)]
    return found[0] if len(found) == 1 else ""


def _r2_table(diagnosis: Diagnosis) -> Table:
    shrink = diagnosis.shrink
    at = printed.BOUNDARY_MM_S if shrink is None or shrink.boundary_mm_s is None else shrink.boundary_mm_s
    columns = (
        Column("form", "R² of steady drag"),
        Column("model", "model"),
        Column("below", f"up to {at:g} mm/s", decimals(4)),
        Column("above", "above", decimals(4)),
    )
    rows = () if shrink is None else _r2_table_rows(shrink, named=bool(diagnosis.effects))
    caption = "The paper's values are quoted: its measurements, on another gut, are not in its text"
    return Table("shrink", caption, columns, rows)


def _r2_table_rows(shrink: GapReduction, *, named: bool) -> tuple[tuple[Cell, ...], ...]:
    forms = (("ratio of Eq. 15", shrink.r2_eq15), ("squared correlation", shrink.r2_corr))
    return (
        *(row for name, one in forms for row in _r2_before_after(name, one)[: 2 if named else 1]),
        ("as the paper prints it", "the paper's", printed.R2_BELOW, printed.R2_ABOVE),
    )


def _r2_before_after(name: str, one: R2BeforeAfter) -> tuple[tuple[Cell, ...], ...]:
    before = (name, "without the effect", one.before_below, one.before_above)
    return before, (name, "with it", one.after_below, one.after_above)


def _runs_table(diagnosis: Diagnosis) -> Table:
    columns = (Column("part", "part in it"), Column("runs", "runs", general_format), Column("files", "files"))
    fitted, held = set(diagnosis.used_for_fit), set(diagnosis.held_out)
    parts = {
        "fit, and judged on in turn": fitted & held,
        "fit": fitted - held,
        "judged on only": held - fitted,
    }
    used = tuple((part, len(files), ", ".join(sorted(files))) for part, files in parts.items() if files)
    left_out = tuple((f"left out: {one.reason}", 1, one.what) for one in diagnosis.left_out)
    return Table("runs", f"Of specimen {diagnosis.specimen}", columns, (*used, *left_out))


MAX_RANKED = 8
"""So many hypotheses are told; the others are in the JSON."""

MAX_LEFT_OUT = 12


def diagnosis_parts(diagnosis: "Diagnosis") -> "Iterator[RenderableType]":
    """Yield all that a diagnosis says, the verdict first."""
    yield "\n".join(verdict_sentences(diagnosis))
    if diagnosis.effects:
        yield "\n".join(map(effect_description, diagnosis.effects))
    yield _confidence_text(diagnosis)
    yield from _location_parts(diagnosis)
    yield _ranking_part(diagnosis)
    yield from _parameter_parts(diagnosis)
    if diagnosis.shrink is not None:
        yield from shrink_parts(diagnosis.shrink, named=bool(diagnosis.effects))
    if diagnosis.limitations:
        yield _titled_lines("These runs cannot answer", map(as_sentence, diagnosis.limitations))
    if diagnosis.next_experiment is not None:
        yield f"To run next\n  {diagnosis.next_experiment.reason}"
    if diagnosis.left_out:
        yield _titled_lines("Left out", _left_out_lines({one.what: one.reason for one in diagnosis.left_out}))
    if diagnosis.remarks:
        yield "\n".join(f"! {one}" for one in diagnosis.remarks)


def shrink_parts(shrink: "GapReduction", *, named: bool = True) -> "Iterator[RenderableType]":
    """Yield how far the gap shrinks, and R² in both forms beside the paper's; before only where no effect is named."""
    yield "\n".join(shrink_sentences(shrink, named=named))
    forms = (("Eq. 15", shrink.r2_eq15), ("correlation²", shrink.r2_corr))
    if all(value is None for _, one in forms for value in _r2_values(one)):
        return
    rows = [row for name, one in forms for row in list(_r2_rows_text(name, one))[: 2 if named else 1]]
    paper = ("the paper, its own gut", "", f"{printed.R2_BELOW:.4f}", f"{printed.R2_ABOVE:.4f}")
    at = printed.BOUNDARY_MM_S if shrink.boundary_mm_s is None else shrink.boundary_mm_s
    header = ("", "", f"up to {at:g} mm/s", "above")
    title = "R² of steady drag; the paper's is quoted, its measurements are not in its text"
    yield terminal_table(title, header, [*rows, paper], (2, 3))


def _confidence_text(diagnosis: "Diagnosis") -> str:
    seen = "" if diagnosis.verdict is Verdict.NO_GAP else f" {detection_limit_sentence(diagnosis)}"
    used = count_text(diagnosis.runs, "run")
    fitted = f"{len(diagnosis.used_for_fit)} in the fit, {len(diagnosis.held_out)} held out in turn"
    return (
        f"{calibration_sentence(diagnosis)}{seen}\n"
        f"Specimen {diagnosis.specimen}, nominal model {diagnosis.nominal}: {used}, {fitted}. "
        f"What is below {diagnosis.tolerance_mN:g} mN does not matter (--tolerance)."
    )


def _location_parts(diagnosis: "Diagnosis") -> "Iterator[RenderableType]":
    rows = [
        (one.axis, one.where, p_value_text(one.p) if isfinite(one.p) else "") for one in axis_texts(diagnosis.where)
    ]
    if rows:
        title = "Where: shares of what is above noise and scatter of repeats; p is the chance without a gap"
        yield terminal_table(title, ("", "", ""), rows)
    yield domain_sentence(diagnosis.where)


def _ranking_part(diagnosis: "Diagnosis") -> "RenderableType":
    ranked = sorted(diagnosis.ranking, key=lambda one: -one.probability)
    rows = [(one.hypothesis, probability_text(one.probability), _held_out_text(one), display_name(one.hypothesis))
            for one in ranked[:MAX_RANKED]]  # fmt: skip
    more = len(ranked) - len(rows)
    title = "Which" + (f", the first {MAX_RANKED} of {len(ranked)}" if more else "")
    return terminal_table(title, ("hypothesis", "probability", "takes away, held out", ""), rows, (1, 2))


def _parameter_parts(diagnosis: "Diagnosis") -> "Iterator[RenderableType]":
    found = next((one for one in diagnosis.ranking if is_stated_verdict(one, diagnosis)), None)
    if found is None or not found.parameters:
        return
    rows = [(one.name, rounded_to_error(one.value, one.standard_error), interval_text(one), unit_text(one.unit))
            for one in found.parameters]  # fmt: skip
    yield terminal_table("How large", ("parameter", "value", "95 % interval", ""), rows, (1, 2))


def _held_out_text(one: "RankedHypothesis") -> str:
    return "" if one.held_out_improvement is None else percent_text(one.held_out_improvement)


def _r2_rows_text(name: str, one: "R2BeforeAfter") -> Iterator[tuple[str, str, str, str]]:
    yield name, "before", _four_decimals(one.before_below), _four_decimals(one.before_above)
    yield "", "after", _four_decimals(one.after_below), _four_decimals(one.after_above)


def _r2_values(one: "R2BeforeAfter") -> "tuple[float | None, ...]":
    return one.before_below, one.before_above, one.after_below, one.after_above


def _four_decimals(value: float | None) -> str:
    return "-" if value is None or not isfinite(value) else f"{value:.4f}"


def _left_out_lines(reasons: Mapping[str, str]) -> Iterator[str]:
    for place, (what, reason) in enumerate(reasons.items()):
        if place == MAX_LEFT_OUT:
            yield f"and {len(reasons) - MAX_LEFT_OUT} more"
            return
        yield f"{what}: {reason}"


def _titled_lines(title: str, lines: Iterator[str]) -> str:
    return "\n".join((title, *(f"  {one}" for one in lines)))


def inline_diagnosis_figures(diagnosis: Diagnosis) -> dict[str, InlineFigure]:
    """Draw all figures; runs are missing where the diagnosis has no views of them."""
    from dragrig.present.diagnosis_figures import (
        before_after_figure,
        location_figure,
        ranking_figure,
        representative_runs,
    )
    from dragrig.present.figure_files import inline_figure

    drawn = {
        "where": inline_figure(
            location_figure(diagnosis.where),
            "A map of channels, protocols and phases; below it, shares of the excess along speed, position, session, "
            "strain and frequency.",
            "Above, how far each channel exceeds what is expected of it, in standard deviations, and how much of the "
            "residual each domain accounts for. Below, shares of the excess, in colour where they stand out.",
        ),
        "ranking": inline_figure(
            ranking_figure(diagnosis),
            "Horizontal bars: the probability of each hypothesis, the most probable first.",
            "Probability of each hypothesis that is not next to impossible.",
        ),
    }
    views = representative_runs(diagnosis.traces)
    if views:
        floor = None if diagnosis.shrink is None else diagnosis.shrink.noise_floor_mN
        drawn["before-after"] = inline_figure(
            before_after_figure(views, floor, named=bool(diagnosis.effects)),
            "A row for each run: left, the measurement and what the model says; right, what is left of it.",
            "Drags at the lowest, a middle and the highest speed, and of each other kind the run that the model "
            "without an effect explains worst. The grey band is noise and scatter of repeats.",
        )
    return drawn


def diagnosis_page(diagnosis: Diagnosis, source: str = "", model: str | None = None) -> str:
    """Return the report as one HTML page.

    Parameters
    ----------
    source
        The campaign.
    model
        The file that the amended model was written to; None where there is none.
    """
    verdict, *more = verdict_sentences(diagnosis)
    return render_template(
        "gap.html",
        {
            "title": f"Gap diagnosis: {diagnosis.specimen}",
            "verdict": verdict,
            "more": more,
            "effects": [effect_description(one) for one in diagnosis.effects],
            "meaning": calibration_sentence(diagnosis),
            "seen": "" if diagnosis.verdict is Verdict.NO_GAP else detection_limit_sentence(diagnosis),
            "cannot_answer": [as_sentence(one) for one in diagnosis.limitations],
            "settings": _diagnosis_settings(diagnosis, source),
            "where": domain_sentence(diagnosis.where),
            "shrink": ()
            if diagnosis.shrink is None
            else shrink_sentences(diagnosis.shrink, named=bool(diagnosis.effects)),
            "unknown": diagnosis.unknown,
            "remarks_": diagnosis.remarks,
            "model": model,
            "diagnosis": diagnosis,
            "tables": diagnosis_tables(diagnosis),
            "pictures": inline_diagnosis_figures(diagnosis),
        },
    )


def _diagnosis_settings(diagnosis: Diagnosis, source: str) -> dict[str, str]:
    used = len({*diagnosis.used_for_fit, *diagnosis.held_out})
    told = {
        "Campaign": source,
        "Specimen": diagnosis.specimen,
        "Nominal model": diagnosis.nominal,
        "Runs": f"{used} used, {len(diagnosis.left_out)} left out",
        "Too small to matter": f"below {diagnosis.tolerance_mN:g} mN (--tolerance)",
    }
    return {name: value for name, value in told.items() if value}
