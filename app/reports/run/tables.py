"""The tables of a run's report."""

from math import floor, log10

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.measures import RunMeasures
from dragrig.reports.tabular import Cell, Column, Table, digits, places
from dragrig.rig.runfile.model import Event


def measures_table(measures: RunMeasures) -> Table:
    """Tabulate what the run says in a few numbers, each with its uncertainty or why it is missing."""
    columns = (
        Column("quantity", "quantity"),
        Column("value", "value", _as_rounded),
        Column("standard_error", "±", digits(2)),
        Column("low", "95 % from", _as_rounded),
        Column("high", "to", _as_rounded),
        Column("unit", "unit"),
        Column("remark", "how"),
    )
    peak = "" if measures.peak_time_s is None else f"at {measures.peak_time_s:.3f} s"
    rows = (
        _row("steady force", measures.steady_force, "mN", f"mean over {measures.steady_from}, as recorded"),
        _row("force at rest", measures.rest_offset, "mN", "mean before the motion"),
        _row("peak force", measures.peak_force, "mN", peak),
        _row("force at the end of the hold", measures.hold_force, "mN", "mean"),
        _row("speed", measures.speed, "mm/s", "slope of the position in the steady phase"),
    )
    return Table("measures", "± is one standard error", columns, rows)


def events_table(events: tuple[Event, ...]) -> Table:
    """Tabulate what happened during the run."""
    columns = (Column("time_s", "time, s", places(3)), Column("kind", "what"), Column("message", "in words"))
    return Table(
        "events", "By the run's own clock", columns, tuple((one.time_s, one.kind, one.message) for one in events)
    )


def _row(name: str, one: Estimate, unit: str, how: str) -> tuple[Cell, ...]:
    low, high = one.interval or (None, None)
    value, low, high = (_rounded(each, one.standard_error) for each in (one.value, low, high))
    return name, value, one.standard_error, low, high, unit, one.reason or how


def _rounded(value: float | None, error: float | None) -> float | None:
    """Round a number to the digits that its error leaves it, three decimal places at most."""
    if value is None or not error:
        return value
    return round(value, max(0, min(3, 1 - floor(log10(error)))))


def _as_rounded(value: float) -> str:
    return f"{value:.10g}".replace("-", "−")
