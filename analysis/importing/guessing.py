"""Columns that say of themselves what they are."""

from dragrig.analysis.importing.foreign import ForeignTable
from dragrig.analysis.importing.mapping import ColumnMap, ColumnSource
from dragrig.analysis.importing.units import KNOWN, TARGETS, canonical


def guess_columns(table: ForeignTable) -> ColumnMap:
    """Map the columns that are called like a quantity and state a unit of its kind: `force_N`, `Time (ms)`."""
    found: dict[str, ColumnSource] = {}
    for quantity, target in TARGETS.items():
        called = [one for one in table.columns if one.label.casefold() == quantity and one.bad is None]
        if len(called) == 1 and canonical(called[0].units) in KNOWN[target]:
            found[quantity] = ColumnSource(column=called[0].name, unit=called[0].units)
    return ColumnMap.model_validate(found)
