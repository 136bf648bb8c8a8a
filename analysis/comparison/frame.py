"""A comparison as a table: one row for each measure of each pair."""

from collections.abc import Iterator
from math import nan
from typing import TYPE_CHECKING

from dragrig.analysis.comparison.measured import Difference
from dragrig.analysis.comparison.results import Comparison, Pair
from dragrig.analysis.estimates import NORMAL_95

if TYPE_CHECKING:
    import pandas as pd

Cell = str | float | bool
"""NaN for a number that is not there."""


def rows_of(comparison: Comparison) -> Iterator[dict[str, Cell]]:
    """Yield the rows, all with the same keys; forces in mN, speeds in mm/s, as `unit` says."""
    for pair in comparison.pairs:
        for one in pair.differences:
            yield _row(pair, one)


def as_frame(comparison: Comparison) -> "pd.DataFrame":
    """Return a data frame of the rows of `rows_of`."""
    import pandas as pd

    return pd.DataFrame(list(rows_of(comparison)))


def _row(pair: Pair, one: Difference) -> dict[str, Cell]:
    condition = pair.condition
    whole = next((each for each in pair.phases if each.phase == "all"), None)
    return {
        "kind": condition.kind,
        "speed_mm_s": _or_nan(condition.speed_mm_s),
        "shear_strain": _or_nan(condition.shear_strain),
        "travel_mm": _or_nan(condition.travel_mm),
        "a_file": pair.a.file,
        "b_file": pair.b.file,
        "shift_s": _or_nan(pair.shift_s),
        "measure": one.measure,
        "unit": one.unit,
        "a": _or_nan(one.a.value),
        "a_error": _or_nan(one.a.standard_error),
        "b": _or_nan(one.b.value),
        "b_error": _or_nan(one.b.standard_error),
        "zeros_taken_off": one.zeros is not None,
        "b_minus_a": _or_nan(one.value),
        "noise_error": _or_nan(one.noise),
        "error_with_scatter": _or_nan(one.error),
        "half_width_95": nan if one.error is None else NORMAL_95 * one.error,
        "verdict": one.verdict.value,
        "reason": one.reason,
        "trace_rms_mN": nan if whole is None else whole.rms_mN,
        "trace_largest_mN": nan if whole is None else whole.largest_mN,
        "trace_largest_at_s": nan if whole is None else whole.at_s,
        "remarks": "; ".join(pair.remarks),
    }


def _or_nan(value: float | None) -> float:
    return nan if value is None else value
