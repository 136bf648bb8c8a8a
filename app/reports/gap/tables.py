"""The tables of a gap report."""

from dragrig.analysis.gap.results import BeforeAfter, Diagnosis, Shrink
from dragrig.analysis.gap.sentences import capital, is_verdict, name_of
from dragrig.analysis.gap.where_words import places
from dragrig.analysis.paper import printed
from dragrig.reports.tabular import Cell, Column, Table, digits, plainly
from dragrig.reports.tabular import places as decimals
from dragrig.sim_backend.effects.catalogue import catalogue

PROBABILITY = Column("probability", "probability", decimals(3))


def tables(diagnosis: Diagnosis) -> dict[str, Table]:
    """Return all tables by name; one that has nothing to say has no rows."""
    made = (_where(diagnosis), _ranking(diagnosis), _parameters(diagnosis), _shrink(diagnosis), _runs(diagnosis))
    return {table.name: table for table in made}


def _where(diagnosis: Diagnosis) -> Table:
    columns = (Column("axis", "axis"), Column("where", "most of it"), Column("p", "p", digits(2)))
    rows = tuple((one.axis, one.where, one.p) for one in places(diagnosis.where))
    return Table("where", "p: chance of this without a gap", columns, rows)


def _ranking(diagnosis: Diagnosis) -> Table:
    columns = (
        Column("name", "hypothesis"),
        Column("hypothesis", "id"),
        PROBABILITY,
        Column("held_out_improvement", "takes away, held out", lambda value: f"{100 * value:.0f} %".replace("-", "−")),
    )
    ranked = sorted(diagnosis.ranking, key=lambda one: -one.probability)
    rows = tuple(
        (capital(name_of(one.hypothesis)), one.hypothesis, one.probability, one.held_out_improvement) for one in ranked
    )
    return Table("ranking", "Held out: part of the excess squares, on runs not in the fit", columns, rows)


def _parameters(diagnosis: Diagnosis) -> Table:
    columns = (
        Column("parameter", "parameter"),
        Column("value", "value", digits(3)),
        Column("low", "95 % from", digits(3)),
        Column("high", "to", digits(3)),
        Column("unit", "unit"),
        Column("meaning", "what it is"),
    )
    found = next((one for one in diagnosis.ranking if is_verdict(one, diagnosis)), None)
    rows = tuple(
        (one.name, one.value, *one.interval, "" if one.unit == "1" else one.unit, _meaning(one.name, diagnosis))
        for one in (() if found is None else found.parameters)
    )
    return Table("parameters", "How large it is, fitted again with all parameters of the specimen", columns, rows)


def _meaning(parameter: str, diagnosis: Diagnosis) -> str:
    """Return what a parameter is; nothing where several effects have one of its name."""
    known = [catalogue()[one] for one in diagnosis.effects if one in catalogue()]
    found = [each.meaning for effect in known for each in effect.parameters if parameter.endswith(each.name)]
    return found[0] if len(found) == 1 else ""


def _shrink(diagnosis: Diagnosis) -> Table:
    shrink = diagnosis.shrink
    at = printed.BOUNDARY_MM_S if shrink is None or shrink.boundary_mm_s is None else shrink.boundary_mm_s
    columns = (
        Column("form", "R² of steady drag"),
        Column("model", "model"),
        Column("below", f"up to {at:g} mm/s", decimals(4)),
        Column("above", "above", decimals(4)),
    )
    rows = () if shrink is None else _r2_rows(shrink, named=bool(diagnosis.effects))
    caption = "The paper's values are quoted: its measurements, on another gut, are not in its text"
    return Table("shrink", caption, columns, rows)


def _r2_rows(shrink: Shrink, *, named: bool) -> tuple[tuple[Cell, ...], ...]:
    forms = (("ratio of Eq. 15", shrink.r2_eq15), ("squared correlation", shrink.r2_corr))
    return (
        *(row for name, one in forms for row in _before_after(name, one)[: 2 if named else 1]),
        ("as the paper prints it", "the paper's", printed.R2_BELOW, printed.R2_ABOVE),
    )


def _before_after(name: str, one: BeforeAfter) -> tuple[tuple[Cell, ...], ...]:
    before = (name, "without the effect", one.before_below, one.before_above)
    return before, (name, "with it", one.after_below, one.after_above)


def _runs(diagnosis: Diagnosis) -> Table:
    columns = (Column("part", "part in it"), Column("runs", "runs", plainly), Column("files", "files"))
    fitted, held = set(diagnosis.used_for_fit), set(diagnosis.held_out)
    parts = {
        "fit, and judged on in turn": fitted & held,
        "fit": fitted - held,
        "judged on only": held - fitted,
    }
    used = tuple((part, len(files), ", ".join(sorted(files))) for part, files in parts.items() if files)
    left_out = tuple((f"left out: {one.reason}", 1, one.what) for one in diagnosis.left_out)
    return Table("runs", f"Of specimen {diagnosis.specimen}", columns, (*used, *left_out))
