"""Cells of text as numbers: decimal mark and mark of thousands by the evidence of all cells of a table."""

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dragrig.analysis import Mask
from dragrig.analysis.importing.clocks import RowTimes, read_clock
from dragrig.analysis.importing.foreign import ForeignColumn, InvalidCell
from dragrig.analysis.importing.units import canonical_unit
from dragrig.config import ImportDataError
from dragrig.rig import FloatArray

if TYPE_CHECKING:
    import pyarrow as pa

MIN_MARKED_CELLS = 20
"""So many numbers with three digits behind a mark, beside some without it, are thousands: of decimals that are written
without their last zeros, one in ten would have two digits."""
HEAD_ROWS = 10_000

_DIGITS = "[\\d.,'’\u00a0\u202f\u2009 ]*\\d[\\d.,'’\u00a0\u202f\u2009]*"
VALUE: str = (
    rf"^(?:[-+]?{_DIGITS}(?:[eE][-+]?\d+)?(?: ?[A-Za-zµμ°%]{{1,4}})?|[-+]?(?i:nan|inf(?:inity)?)"
    r"|\d[\d:/., +-]*[:/-][\d:/., +-]*(?:[tT][\d:.,+-]*)?(?: ?[aApP]\.?[mM]\.?|Z)?"
    r"|\d{1,2}[-. ][A-Za-zäéûôç]{3,9}[-. ,]+\d{2,4}.*|P[\dDT][\dDTHMS.]*|-?\d+ days?.*)$"
)
"""Numbers with any marks, and with a unit, dates, times of day, lengths of time."""
NO_VALUE: str = r"^(?i:[-–*#?]+|#?n/?a|null|none|ov(?:e?r)?[a-z]*|o\.?l\.?|sat[a-z]*|err[a-z]*|invalid|missing|)$"
"""Marks of a missing value."""


@dataclass(frozen=True, slots=True)
class NumberMarks:
    """Decimal mark, and mark of thousands where there is one."""

    decimal: str = "."
    thousands: str = ""


def matches(texts: "pa.StringArray", pattern: str) -> Mask:
    """Return which cells a regular expression (of RE2) matches."""
    import pyarrow.compute as pc

    return np.from_dlpack(pc.match_substring_regex(texts, pattern).cast("uint8")).astype(np.bool_)


def are_filled(texts: "pa.StringArray") -> Mask:
    """Return which cells are not empty."""
    import pyarrow.compute as pc

    return np.asarray(np.from_dlpack(pc.binary_length(texts)) > 0, dtype=np.bool_)


def are_values(texts: "pa.StringArray") -> Mask:
    """Return which cells look like a number, a date or a time."""
    import pyarrow.compute as pc

    # Nearly all cells are of digits and marks alone; the expression is ten times slower.
    odd = are_filled(pc.ascii_trim(pc.ascii_ltrim(texts, "+-"), "0123456789.,"))
    result = are_filled(texts) & ~odd
    result[odd] = matches(texts.filter(arrow_mask(odd)), VALUE)
    bare = are_filled(texts) & ~are_filled(pc.ascii_trim(texts, "+-.,"))
    return np.asarray(result & ~bare, dtype=np.bool_)


def column_of_texts(name: str, units: str, texts: Sequence[str]) -> ForeignColumn:
    """Return a column of numbers, dates or times in cells of text, by the evidence of these alone."""
    import pyarrow as pa
    import pyarrow.compute as pc

    cells = pc.utf8_trim_whitespace(pa.array(texts, pa.string()))
    return text_column(name, units, cells, number_marks(f"column {name!r}", [cells])[0])[0]


def number_marks(
    place: str, columns: "Sequence[pa.StringArray]", stated: str = "", parting: str = ","
) -> tuple[NumberMarks, ...]:
    """Find decimal mark and mark of thousands of each column, from all numbers of a table.

    Parameters
    ----------
    parting
        Marks that may part thousands though nothing but whole numbers beside them says so.

    Raises
    ------
    ImportDataError
        Where the numbers of a column contradict each other, or leave it open.
    """
    import pyarrow.compute as pc

    for decimal, other in (".,", ",."):
        if stated or any(pc.any(pc.match_substring(column, other)).as_py() for column in columns):
            continue
        # Only the first rows of a long file that has one mark alone, if they say enough.
        head = sum((_mark_evidence(column.slice(0, HEAD_ROWS), decimal) for column in columns), Counter())
        if head["decimal"]:
            return (NumberMarks(decimal),) * len(columns)
    evidence = [{mark: _mark_evidence(column, mark) for mark in ".,"} for column in columns]
    counts = {mark: sum((seen[mark] for seen in evidence), Counter()) for mark in ".,"}
    if not stated and counts["."]["decimal"] and counts[","]["decimal"]:
        # Of a workbook's columns, one may be numbers and the next text.
        return tuple(_marks(place, seen, "", {mark for mark in ".," if seen[mark]["open"]}) for seen in evidence)
    beside = zip(columns, evidence, strict=True) if any(counts[mark]["open"] for mark in parting) else ()
    whole = [seen for column, seen in beside if matches(column, r"^[-+]?\d+$").any()]
    asked = {mark for mark in parting if any(not seen[mark] for seen in whole)}
    return (_marks(place, counts, stated, asked),) * len(columns)


def _marks(place: str, counts: Mapping[str, "Counter[str]"], stated: str, asked: Collection[str]) -> NumberMarks:
    point, comma = counts["."], counts[","]
    if not stated and point["decimal"] and comma["decimal"]:
        raise ImportDataError(
            f"{place}: has decimal commas in {comma['decimal']} cells and decimal points in {point['decimal']}; state "
            "the decimal mark."
        )
    for thousands, decimal in (",.", ".,"):
        seen = counts[thousands]
        is_open = seen["open"] and not seen["decimal"] and not counts[decimal]["decimal"] and thousands in asked
        is_mixed = seen["open"] and seen["whole"] and not seen["decimal"] and stated != thousands
        if not stated and not seen["thousands"] and (seen["open"] < MIN_MARKED_CELLS if is_mixed else is_open):
            raise ImportDataError(
                f"{place}: {thousands!r} may be the decimal mark or part thousands, in {seen['open']} cells; state the "
                "decimal mark."
            )
        is_other = counts[decimal]["decimal"] and seen["open"] and not seen["decimal"]
        if seen["thousands"] or is_mixed or is_other or (stated == decimal and is_open):
            return NumberMarks(decimal, thousands)
    return NumberMarks(stated or ("," if comma["decimal"] or comma["open"] else "."))


def _mark_evidence(texts: "pa.StringArray", mark: str) -> "Counter[str]":
    """Count the cells whose mark is decimal for certain, or of thousands, or either, and whole ones beside these."""
    import pyarrow.compute as pc

    m, o = re.escape(mark), re.escape("," if mark == "." else ".")
    marked = texts.filter(pc.match_substring(texts, mark))
    if not len(marked):
        return Counter()
    one_mark = rf"\d*{m}(?:\d{{0,2}}|\d{{4,}})|(?:0\d*|\d{{4,}}|){m}\d{{3}}"
    parted = rf"[1-9]\d{{0,2}}(?:{m}\d{{3}})"
    found = {
        "decimal": rf"(?:{one_mark}|\d{{1,3}}(?:{o}\d{{3}})+{m}\d*)(?:[eE][-+]?\d+)?",
        "thousands": rf"(?:{parted}{{2,}}(?:{o}\d*)?|{parted}+{o}\d*)",
        "open": parted,
    }
    counts = Counter({kind: int(matches(marked, f"^[-+]?{pattern}$").sum()) for kind, pattern in found.items()})
    if counts["open"]:
        counts["whole"] = int(matches(texts, r"^[-+]?[1-9]\d{0,2}$").sum())
    return counts


def remarks_on_marks(marks: Sequence[NumberMarks]) -> tuple[str, ...]:
    """Tell that a mark was taken for one of thousands."""
    seen = dict.fromkeys(known.thousands for known in marks if known.thousands)
    return tuple(f"{'commas' if mark == ',' else 'points'} part thousands: 1{mark}000 is a thousand" for mark in seen)


def text_column(
    name: str, units: str, texts: "pa.StringArray", marks: NumberMarks
) -> tuple[ForeignColumn, RowTimes | None]:
    """Return a column of cells of text as numbers, with the first cell that is none; or as the clock that it is."""
    import pyarrow as pa
    import pyarrow.compute as pc

    is_filled = are_filled(texts)
    if marks == NumberMarks() or (marks == NumberMarks(",") and not pc.any(pc.match_substring(texts, ".")).as_py()):
        try:
            plain = texts if marks.decimal == "." else pc.replace_substring(texts, ",", ".")
            return ForeignColumn(name, units, _numbers(plain, is_filled)), None
        except pa.ArrowInvalid:
            pass  # some cell is no plain number: the rules below say which
    # Accounting programs write the sign behind the number.
    texts = pc.replace_substring_regex(texts, r"^([\d.,]+) ?-$", r"-\1")
    t, d = re.escape(marks.thousands), re.escape(marks.decimal)
    whole = rf"\d{{1,3}}(?:{t}\d{{3}})+|\d+" if t else r"\d+"
    parted = "\\d{1,3}(?:['’\u00a0\u202f\u2009 ]\\d{3})+"
    number = rf"^[-+]?(?:(?:{whole}|{parted}){d}?\d*(?:[eE][-+]?\d+)?|{d}\d+(?:[eE][-+]?\d+)?|(?i:nan|inf(?:inity)?))$"
    is_number = matches(texts, number)
    wrong = np.flatnonzero(is_filled & ~is_number)
    if wrong.size and (clock := read_clock(texts)) is not None:
        return clock.column(name), clock
    if wrong.size and (unit := _unit_in_all(texts.filter(arrow_mask(is_filled)))):
        return text_column(name, unit, pc.utf8_rtrim(texts, f" {unit}"), marks)
    bad = InvalidCell(int(wrong[0]), texts[int(wrong[0])].as_py()) if wrong.size else None
    for mark in f"{marks.thousands}'’\u00a0\u202f\u2009 ":
        texts = pc.replace_substring(texts, mark, "")
    texts = texts if marks.decimal == "." else pc.replace_substring(texts, marks.decimal, ".")
    return ForeignColumn(name, units, _numbers(texts, is_number), bad), None


def _unit_in_all(texts: "pa.StringArray") -> str:
    """Return the unit that stands behind the number in all cells; empty without any."""
    unit = re.sub(r"^.*[\d.,]\s*", "", texts[0].as_py())
    is_unit = (
        unit.strip("-+") and canonical_unit(unit) is not None and matches(texts, rf"\d[.,]?\s*{re.escape(unit)}$").all()
    )
    return unit if is_unit else ""


def _numbers(texts: "pa.StringArray", is_number: Mask) -> FloatArray:
    """Return the cells of a mask as numbers, and NaN for the others.

    Arrow's scalars and its conversion to NumPy, which this does without, would load pandas.
    """
    import pyarrow.compute as pc

    values = np.full(len(texts), np.nan)
    # Arrow reads no number with a leading plus.
    plain = pc.ascii_ltrim(texts.filter(arrow_mask(is_number)), "+")
    values[is_number] = np.from_dlpack(pc.cast(plain, "float64"))
    return values


def arrow_mask(mask: Mask) -> "pa.BooleanArray":
    """Return a mask as Arrow's."""
    import pyarrow as pa

    bits = pa.py_buffer(np.packbits(mask, bitorder="little").tobytes())
    return pa.BooleanArray.from_buffers(pa.bool_(), len(mask), [None, bits])
