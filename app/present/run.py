"""A run laid out for a reader: measures, checks, events, settings."""

from collections.abc import Mapping
from math import floor, log10
from typing import Final

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.measures import RunMeasures, measure
from dragrig.present.document import Cell, Column, InlineFigure, Table, decimals, general_format, significant
from dragrig.present.drawing import (
    run_problem,
    run_title,
)
from dragrig.present.figure_files import inline_figure
from dragrig.present.html_page import render_template
from dragrig.present.run_figures import (
    run_figure,
)
from dragrig.rig.runfile.model import Attribute, Run, RunEvent, RunInfo

UNIT_SUFFIXES: Final = {
    "_mm_s2": "mm/s²",
    "_mm_s": "mm/s",
    "_mm2": "mm²",
    "_deg": "°",
    "_kPa": "kPa",
    "_um": "µm",
    "_mN": "mN",
    "_mm": "mm",
    "_hz": "Hz",
    "_g": "g",
    "_s": "s",
}
"""Endings of names and the units that they stand for, longer ones first."""

_ATTRIBUTE_LABELS: Final = {"accel": "acceleration", "mass": "mass", "rest": "rest before", "hold": "hold after"}

_TIME_FORMAT: Final = "%Y-%m-%d %H:%M:%S %z"


def attribute_texts(values: Mapping[str, Attribute]) -> dict[str, str]:
    """Return attributes as a person reads them: `speed_mm_s = 5.0` as "speed": "5 mm/s"."""
    return {_attribute_label(name): _attribute_text(name, value) for name, value in values.items() if value != ""}


def check_texts(checks: Mapping[str, Attribute]) -> dict[str, str]:
    """Say what was looked at right after the run, each with what was seen."""
    told = {key: value for key, value in checks.items() if key not in {"slip_time_s", "following_error_mm"}}
    words = attribute_texts({key: float(f"{one:.3g}") if isinstance(one, float) else one for key, one in told.items()})
    following, slip = checks.get("following_error_mm"), checks.get("slip_time_s")
    if isinstance(following, int | float):
        words["largest distance from the command"] = f"{1000 * following:.1f} µm"
    if isinstance(slip, int | float):
        words["slip during the hold"] = f"at {slip:.1f} s" if slip >= 0 else "none seen"
    return words


def recording_texts(info: RunInfo) -> dict[str, str]:
    """Say when, by whom and with what a run was recorded."""
    header, entry = info.header, info.header.entry
    told = {
        "Run": header.run_id,
        "Began": f"{header.start_time:{_TIME_FORMAT}}",
        "Ended": "" if info.end_time is None else f"{info.end_time:{_TIME_FORMAT}}",
        "Operator": str(entry.get("operator", "")),
        "Note": str(entry.get("note", "")),
        "Plan": str(entry.get("plan", "")),
        "Samples": f"{info.samples} at {general_format(header.sample_rate_hz)} Hz",
        "Channels": ", ".join(f"{one.name} ({one.units})" for one in header.channels),
        "Software": str(entry.get("software", "")),
        "SHA-256 of the samples": info.raw_sha256,
    }
    return {name: value for name, value in told.items() if value}


def further_attribute_texts(info: RunInfo) -> dict[str, str]:
    """Say what else stands in the file's head."""
    said = {"operator", "note", "plan", "software"}
    return attribute_texts({key: value for key, value in info.header.entry.items() if key not in said})


def _attribute_label(name: str) -> str:
    ending = _unit_suffix(name)
    bare = name.removesuffix(ending)
    return _ATTRIBUTE_LABELS.get(bare, bare.replace("_", " "))


def _attribute_text(name: str, value: Attribute) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    unit = UNIT_SUFFIXES.get(_unit_suffix(name), "")
    number = str(value) if isinstance(value, int) else general_format(value)
    if name == "shear_strain":
        return f"{general_format(100 * value)} %"
    return f"{number}{'' if unit == '°' else ' '}{unit}".rstrip()


def _unit_suffix(name: str) -> str:
    return next((one for one in UNIT_SUFFIXES if name.endswith(one) and name != one[1:]), "")


def measures_table(measures: RunMeasures) -> Table:
    """Tabulate what the run says in a few numbers, each with its uncertainty or why it is missing."""
    columns = (
        Column("quantity", "quantity"),
        Column("value", "value", _ten_significant),
        Column("standard_error", "±", significant(2)),
        Column("low", "95 % from", _ten_significant),
        Column("high", "to", _ten_significant),
        Column("unit", "unit"),
        Column("remark", "how"),
    )
    peak = "" if measures.peak_time_s is None else f"at {measures.peak_time_s:.3f} s"
    rows = (
        _measure_row("steady force", measures.steady_force, "mN", f"mean over {measures.steady_from}, as recorded"),
        _measure_row("force at rest", measures.rest_offset, "mN", "mean before the motion"),
        _measure_row("peak force", measures.peak_force, "mN", peak),
        _measure_row("force at the end of the hold", measures.hold_force, "mN", "mean"),
        _measure_row("speed", measures.speed, "mm/s", "slope of the position in the steady phase"),
    )
    return Table("measures", "± is one standard error", columns, rows)


def events_table(events: tuple[RunEvent, ...]) -> Table:
    """Tabulate what happened during the run."""
    columns = (Column("time_s", "time, s", decimals(3)), Column("kind", "what"), Column("message", "in words"))
    return Table(
        "events", "By the run's own clock", columns, tuple((one.time_s, one.kind, one.message) for one in events)
    )


def _measure_row(name: str, one: Estimate, unit: str, how: str) -> tuple[Cell, ...]:
    low, high = one.interval or (None, None)
    value, low, high = (_round_to_error(each, one.standard_error) for each in (one.value, low, high))
    return name, value, one.standard_error, low, high, unit, one.reason or how


def _round_to_error(value: float | None, error: float | None) -> float | None:
    """Round a number to the digits that its error leaves it, three decimal places at most."""
    if value is None or not error:
        return value
    return round(value, max(0, min(3, 1 - floor(log10(error)))))


def _ten_significant(value: float) -> str:
    return f"{value:.10g}".replace("-", "−")


def run_page(run: Run, bad_reason: str | None = None) -> str:
    """Return the report on a run as one HTML page.

    Parameters
    ----------
    bad_reason
        Why somebody marked the run bad; None when nobody did.
    """
    info = run.info
    tables = {one.name: one for one in (measures_table(measure(run)), events_table(run.events))}
    return render_template(
        "run.html",
        {
            "title": run_title(info),
            "info": info,
            "trouble": run_problem(info, bad_reason),
            "recorded": recording_texts(info),
            "checks": check_texts(info.checks),
            "protocol": attribute_texts(info.header.protocol),
            "capsule": attribute_texts(info.header.capsule),
            "specimen": attribute_texts(info.header.specimen),
            "further": further_attribute_texts(info),
            "tables": tables,
            "pictures": {"run": inline_run_figure(run, bad_reason)},
        },
    )


def inline_run_figure(run: Run, bad_reason: str | None = None) -> InlineFigure:
    """Draw a run, force over position and speed."""
    return inline_figure(
        run_figure(run, bad_reason=bad_reason),
        f"{run_title(run.info)}: force, position and speed against time, with the phases of the motion.",
        "Force as recorded (light) and filtered, position beside its command, and speed; shaded, the motion's phases.",
    )
