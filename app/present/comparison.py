"""A comparison laid out for a reader: pairs of runs, differences by condition, and what had no partner."""

from collections.abc import Iterable, Iterator, Mapping

from dragrig import present
from dragrig.analysis import (
    NORMAL_95,
    Comparison,
    Exclusion,
    GroupDifference,
    MeasureDifference,
    RunPair,
    capitalise,
    comparison_rows,
    rounded_to_error,
)
from dragrig.present import (
    Cell,
    Column,
    Document,
    Facts,
    Field,
    Figure,
    FormattedNumber,
    Items,
    Section,
    Table,
    attributes_json,
    decimals,
    exclusions_json,
    listed_exclusions,
    percent_difference,
    shortest,
)

MAX_BRIEF = 12
"""Conditions, pairs, and runs without a partner that a terminal lists; the page has all."""
ONE_DECIMAL = decimals(1)


def comparison_document(comparison: Comparison) -> Document:
    """Lay out a comparison; differences are B − A, forces in mN."""
    pairing, *findings = comparison.sentences
    answer, *lead = (*map(capitalise, findings), pairing)
    speed = Figure(
        "steady-force",
        "Steady force against speed of both sides, and below it their differences.",
        "Large markers are means, small ones runs; bars hold 95 %: above by Student's t over repeats, below of noise "
        "and scatter of repeats.",
        lambda: present.comparison_speed_figure(comparison),
    )
    figures = (speed,) if present.sliding_pairs(comparison) else ()
    unpaired = _exclusions("without-partner", comparison.alone_a, comparison.alone_b)
    left_out = _exclusions("left-out", comparison.a.left_out, comparison.b.left_out)
    return Document(
        title=f"{comparison.a.name} and {comparison.b.name}",
        badges=comparison.backends,
        answer=answer,
        lead=tuple(lead),
        sections=(
            Section("sides", "", (Facts({"A": comparison.a.name, "B": comparison.b.name}), *figures)),
            Section("conditions", "Largest differences first, in standard errors", (_group_table(comparison.groups),)),
            Section("pairs", "Pairs of runs", (_pair_table(comparison.pairs),)),
            Section("unpaired", "Without a partner", (unpaired,)),
            Section("excluded", "Left out", (left_out,)),
            Section("remarks", "Remarks", (Items(comparison.remarks, remarks=True),)),
        ),
        data=comparison_json(comparison),
    )


def comparison_json(comparison: Comparison) -> Mapping[str, object]:
    """Return a comparison as JSON; forces in mN."""
    return {
        "a": comparison.a.name,
        "b": comparison.b.name,
        "sentences": comparison.sentences,
        "remarks": comparison.remarks,
        "zero_allowed_mN": comparison.zero_mN,
        "measures": list(comparison_rows(comparison)),
        "pairs": [
            {
                "condition": str(pair.condition),
                "a_file": pair.a.file,
                "b_file": pair.b.file,
                **attributes_json(pair, "shift_s", "verdict", "phases", "motion", "remarks"),
            }
            for pair in comparison.pairs
        ],
        "conditions": [
            {
                "condition": str(group.condition),
                **attributes_json(group, "measure", "pairs", a="a_mN", b="b_mN", value="b_minus_a_mN"),
                **attributes_json(group, noise="noise_error_mN", error="error_with_scatter_mN"),
                **attributes_json(group, "relative", "verdict", rms_mN="trace_rms_mN"),
            }
            for group in comparison.groups
        ],
        "without_partner": {"a": comparison.alone_a, "b": comparison.alone_b},
        "left_out": {"a": exclusions_json(comparison.a.left_out), "b": exclusions_json(comparison.b.left_out)},
    }


def _group_table(groups: Iterable[GroupDifference]) -> Table:
    return Table.of(
        "conditions-table",
        "",
        groups,
        Field("condition", "condition", lambda group: str(group.condition)),
        Field("measure", "measure", lambda group: group.measure),
        Field("pairs", "pairs", lambda group: group.pairs, shortest()),
        Field("a_mN", "A, mN", lambda group: group.a, ONE_DECIMAL),
        Field("b_mN", "B, mN", lambda group: group.b, ONE_DECIMAL),
        Field("difference_mN", "B − A", lambda group: _difference_cell(group.value, NORMAL_95 * group.error)),
        Field("half_width_mN", "± 95 %", lambda group: _half_width_cell(NORMAL_95 * group.error)),
        Field(
            "relative", "relative", lambda group: "" if group.relative is None else group.relative, percent_difference
        ),
        Field("errors", "standard errors", lambda group: group.times_error, shortest(2)),
        Field("verdict", "", lambda group: group.verdict.value),
        Field("rms_mN", "rms, mN", lambda group: group.rms_mN, ONE_DECIMAL),
        brief_rows=MAX_BRIEF,
    )


def _pair_table(pairs: Iterable[RunPair]) -> Table:
    columns = (
        Column("condition", "condition"),
        Column("a_file", "A"),
        Column("b_file", "B"),
        Column("measure", "measure"),
        Column("a_mN", "A, mN", ONE_DECIMAL),
        Column("b_mN", "B, mN", ONE_DECIMAL),
        Column("difference_mN", "B − A"),
        Column("half_width_mN", "± 95 %"),
        Column("verdict", ""),
        Column("rms_mN", "rms, mN", ONE_DECIMAL),
        Column("largest_mN", "largest, mN", ONE_DECIMAL),
        Column("at_s", "at, s", decimals(2)),
        Column("phase", "phase"),
    )
    return Table(
        "pairs-table", "", columns, tuple(row for pair in pairs for row in _pair_rows(pair)), brief_rows=MAX_BRIEF
    )


def _pair_rows(pair: RunPair) -> Iterator[tuple[Cell, ...]]:
    whole = next((phase for phase in pair.phases if phase.phase == "all"), None)
    trace: tuple[Cell, ...] = ("", "", "", "")
    if whole is not None:
        names = (phase.phase for phase in pair.phases if phase.at_s == whole.at_s and phase.phase != "all")
        trace = (whole.rms_mN, whole.largest_mN, whole.at_s, next(names, ""))
    for place, measure in enumerate(pair.main):
        head = (str(pair.condition), pair.a.file, pair.b.file) if place == 0 else ("", "", "")
        tail = trace if place == 0 else ("", "", "", "")
        yield *head, measure.measure, *_difference_cells(measure), *tail


def _difference_cells(measure: MeasureDifference) -> tuple[Cell, ...]:
    half_width = None if measure.error is None else NORMAL_95 * measure.error
    verdict = measure.reason if measure.value is None else measure.verdict.value
    return *measure.compared, _difference_cell(measure.value, half_width), _half_width_cell(half_width), verdict


def _difference_cell(value: float | None, half_width: float | None) -> FormattedNumber:
    """Return a difference with its sign, to the second digit of half the width of its interval."""
    return FormattedNumber(value, ("+" if value and value > 0 else "") + rounded_to_error(value, half_width))


def _half_width_cell(half_width: float | None) -> FormattedNumber:
    return FormattedNumber.rounded(half_width, half_width)


def _exclusions(name: str, excluded_a: Iterable[Exclusion], excluded_b: Iterable[Exclusion]) -> Table:
    columns = (Column("side", "side"), Column("what", "what"), Column("reason", "reason"))
    rows = tuple(
        (side, exclusion.item, exclusion.reason)
        for side, exclusions in (("A", excluded_a), ("B", excluded_b))
        for exclusion in listed_exclusions(tuple(exclusions))
    )
    return Table(name, "", columns, rows, brief_rows=MAX_BRIEF)
