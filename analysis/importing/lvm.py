"""The head of each segment of LabVIEW's measurement files (.lvm): units, sampling interval, begin."""

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime

import numpy as np

from dragrig.analysis.importing.foreign import ForeignTable
from dragrig.analysis.importing.units import canonical_unit

_END = "***End_of_Header***"
_ABSCISSA = "X_Value"


def with_stated_waveform(table: ForeignTable) -> ForeignTable:
    """Apply a segment's header to its columns; a table of another file is returned as it is.

    `X_Columns` decides whether there is one column of abscissae, one for each channel, or none, where rows follow each
    other at `Delta_X` (NI, Specification for the LabVIEW Measurement File).
    """
    if not any(line.startswith(_END) for line in table.preamble):
        return table
    stated = _stated(table)
    units = iter(stated.get("Y_Unit_Label", ()))
    is_time = all(dimension in {"", "Time"} for dimension in stated.get("X_Dimension", ()))
    columns, abscissa = [], None
    for column in table.columns:
        if column.name != _ABSCISSA:
            unit = next(units, "") if not column.units else column.units
            columns.append(replace(column, units=canonical_unit(unit) or unit))
        elif not np.isfinite(column.values).any() and column.bad is None:
            continue
        elif abscissa is None or not np.array_equal(abscissa, column.values, equal_nan=True):
            abscissa = column.values
            columns.append(replace(column, units=column.units or ("s" if is_time else "")))
    steps = {float(step.replace(",", ".")) for step in stated.get("Delta_X", ()) if step}
    rate = 1 / min(steps) if abscissa is None and len(steps) == 1 and min(steps) > 0 else None
    return replace(table, columns=tuple(columns), sample_rate_hz=rate, begins_at=_begin(stated))


def _stated(table: ForeignTable) -> Mapping[str, tuple[str, ...]]:
    """Return the values of each key, that of a segment before that of the file."""
    marks = ("\t" if "\t" in line else "," for line in table.preamble)
    cells = [[cell.strip() for cell in line.split(mark)] for line, mark in zip(table.preamble, marks, strict=True)]
    return {key: tuple(value for value in values if value) for key, *values in cells if key and key != _END}


def _begin(stated: Mapping[str, tuple[str, ...]]) -> datetime | None:
    """Return the start of the first channel; LabVIEW writes local time, with up to 18 digits behind the second."""
    day, time = (next(iter(stated.get(key, ())), "") for key in ("Date", "Time"))
    whole, _, fraction = time.replace(",", ".").partition(".")
    try:
        return datetime.fromisoformat(f"{day.replace('/', '-')}T{whole}.{f'{fraction:0<6.6}'}").astimezone()
    except (ValueError, OSError):  # Windows knows no local time before 1970
        return None
