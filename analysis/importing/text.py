"""A text file is preamble, heading, units and rows, and this again: one description, fitted to the whole of it.

Cells that look like values (numbers, dates, times) tell rows from everything else, column by column over all lines.
Between two stretches of rows stand either a few lines that are left out, with a remark, or the heading of a further
table.
"""

import csv
import io
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dragrig.analysis import ImportSettings, Mask
from dragrig.analysis.importing.cells import (
    NO_VALUE,
    VALUE,
    NumberMarks,
    are_filled,
    are_values,
    arrow_mask,
    matches,
    number_marks,
    remarks_on_marks,
    text_column,
)
from dragrig.analysis.importing.clocks import RowTimes, joined
from dragrig.analysis.importing.foreign import ForeignColumn, ForeignTable
from dragrig.analysis.importing.units import canonical_unit, split_unit
from dragrig.config import ImportDataError

if TYPE_CHECKING:
    import pyarrow as pa

_LVM_END = "***End_of_Header***"
_LVM_ABSCISSA = "X_Value"
DELIMITERS = ("\t", ";", "|", ",", " ")
"""In the order of preference when two fit equally well; a space stands for any white space."""
SAMPLED_LINES = 400
"""Lines from all over a file that tell its delimiter."""
MIN_FURTHER_ROWS = 3
"""Fewer rows apart from a table are none of their own: two numbers in a preamble, a footer."""
TOLD_LINES = 3
_IS_VALUE = re.compile(VALUE)
_HAS_NO_VALUE = re.compile(NO_VALUE)
_SINGLE = re.compile(
    r"[-+]?(\d+\.?\d*|\d*[.,]\d+|\d{1,3}([.,'’\u00a0\u202f]\d{3})+[.,]?\d*)(e[-+]?\d+)?( ?[a-zµμ°%]{1,4})?"
    r"|[-+]?(nan|inf(inity)?)"
    r"|\d{1,4}[-/.][a-zäéûôç\d]{1,9}[-/.]\d{1,4}([t ][^,;|\t]*)?|\d{1,4}:\d\d[^,;|\t]*(,\d+)?",
    re.IGNORECASE,
)
"""A value that holds no delimiter: a number with either decimal mark, a date, a time."""
_PARTED = re.compile(r"\d [-+.,]?\d")
_BLANK_THOUSANDS = re.compile(r"[-+]?\d{1,3}( \d{3})+([.,]\d*)?")
_COMMENT = re.compile(r"\s*(#|%|//)\s?")
_QUOTED = re.compile(r'"[^"\n]*"')
_BROKEN_CELL = re.compile(r'(?:^|(?<=[,;\t|]))"[^"]{0,200}\n[^"]{0,200}"(?=[,;\t|]|$)', re.MULTILINE)
_HEADING_WORD = re.compile(r"[^\s\[(]+(?:\s*(?:\[[^\]]*\]|\([^)]*\)))?")
_BREAK = "\x1e"


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Lines of a file, and the number of each, counted from 1."""

    texts: list[str]
    numbers: npt.NDArray[np.intp]

    @classmethod
    def of(cls, text: str) -> "_Lines":
        text = text.replace("\r\n", "\n").replace("\r", "\n").replace("\u2212", "-")
        if '"' not in text or not _BROKEN_CELL.search(text):
            texts = text.split("\n")
            return cls(texts, np.arange(1, len(texts) + 1))
        broken = _BROKEN_CELL.sub(lambda cell: cell[0].replace("\n", _BREAK), text).split("\n")
        ends = np.cumsum([line.count(_BREAK) + 1 for line in broken])
        return cls([line.replace(_BREAK, " ") for line in broken], ends)


@dataclass(frozen=True, slots=True)
class _Heading:
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()


def text_tables(path: Path, text: str, settings: ImportSettings) -> tuple[ForeignTable, ...]:
    """Read all tables of a text.

    Raises `ImportDataError` when there is none, its rows differ in width, or its decimal mark is ambiguous.
    """
    lines = _Lines.of(text)
    delimiter = settings.delimiter_mark or _found_delimiter(lines.texts[settings.header_lines or 0 :])
    tables = _Fit(path, lines, delimiter, settings).tables() if delimiter else ()
    if not tables:
        raise ImportDataError(
            f"{path}: holds no table of numbers with columns separated by tab, semicolon, bar, comma or white space; "
            "state delimiter and header_lines if it does."
        )
    return tables


def split_cells(line: str, delimiter: str) -> list[str]:
    """Split a line into cells, without the white space and quotes around them."""
    if delimiter == " ":
        return line.split()
    if '"' in line:
        return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))]
    return [cell.strip() for cell in line.split(delimiter)]


def _found_delimiter(lines: Sequence[str]) -> str:
    """Return the delimiter that gives the most columns of values in the most rows, then the largest share of them."""
    spread = lines[:: max(1, len(lines) // SAMPLED_LINES)]
    sample = [line for line in spread if line.strip() and not _COMMENT.match(line)]
    shapes = {mark: _shape(sample, mark) for mark in DELIMITERS}
    most = max((rows for _, numeric, rows in shapes.values() if len(numeric) > 1), default=0)

    def fit(mark: str) -> tuple[bool, bool, int, bool, float]:
        width, numeric, rows = shapes[mark]
        # Tabs hold empty cells, which white space would swallow, unless it parts the numbers within them.
        whole = mark != " " and not any(
            _PARTED.search(cell) and not _is_single(cell, mark) for line in sample for cell in split_cells(line, mark)
        )
        # Columns that only a few lines have are those of a preamble; tabs never part columns by chance.
        is_tab = mark == "\t" and whole and len(numeric) > 1
        return 10 * rows > most, is_tab, len(numeric), whole, len(numeric) / max(width, 1)

    best = max(DELIMITERS, key=fit)
    return best if shapes[best][1] else ""


def _shape(sample: Sequence[str], delimiter: str) -> tuple[int, tuple[int, ...], int]:
    """Return the most common number of cells per line, the columns that are mostly values, and the number of lines."""
    cells = (split_cells(line, delimiter) for line in sample)
    rows = [row for row in cells if any(_is_single(cell, delimiter) for cell in row)]
    if not rows:
        return 0, (), 0
    (width, count), *_ = Counter(map(len, rows)).most_common(1)
    cells_by_column = zip(*(row for row in rows if len(row) == width), strict=True)
    surplus = (sum(1 if _is_single(cell, delimiter) else -1 for cell in cells if cell) for cells in cells_by_column)
    return width, tuple(column for column, majority in enumerate(surplus) if majority > 0), count


def _is_single(cell: str, delimiter: str) -> bool:
    """Whether a cell is one value; a blank parts thousands where blanks and decimal commas do not part columns."""
    return bool(_SINGLE.fullmatch(cell) or (delimiter in "\t;|" and _BLANK_THOUSANDS.fullmatch(cell)))


class _Fit:
    """The description of a text file, found table by table: the widest spread first, then the remainder."""

    def __init__(self, path: Path, lines: _Lines, delimiter: str, settings: ImportSettings) -> None:
        self._path, self._lines, self._delimiter, self._settings = path, lines, delimiter, settings
        self._widths = _widths(lines.texts, delimiter)
        self._comments: dict[int, str] = {}
        self._in_table = np.zeros(len(lines.texts), dtype=np.bool_)
        self._in_table[: settings.header_lines or 0] = True

    def tables(self) -> tuple[ForeignTable, ...]:
        """Return all tables, in the order of the file."""
        found: list[ForeignTable] = []
        while (rows := self._rows(first=not found)) is not None:
            self._in_table[rows[0]] = True
            found += self._blocks(*rows)
        found.sort(key=lambda table: table.lines[0] if table.lines else 0)
        if len(found) == 1:
            return tuple(found)
        names = Counter(table.name for table in found if table.name)
        return tuple(
            table if names[table.name] == 1 else replace(table, name=f"block {number}")
            for number, table in enumerate(found, start=1)
        )

    def _rows(self, *, first: bool) -> "tuple[npt.NDArray[np.intp], Sequence[pa.StringArray]] | None":
        """Return the lines of all rows as wide as most are, and their cells; None where too few are left."""
        free = np.flatnonzero(~self._in_table & (self._widths > 0))
        sample = self._texts(free[:: max(1, len(free) // SAMPLED_LINES)])
        width, numeric, _ = _shape(sample, self._delimiter)
        if not numeric or not (first or (numeric[0] == 0 and len(numeric) > 1)):
            return None
        for line in free[self._widths[free] == width + 1].tolist():
            self._part_comment(line)
        lines = free[self._widths[free] == width]
        columns = _parsed(self._path, self._texts(lines), self._delimiter, width)
        is_row = _rows_among(columns)
        if not is_row.sum() >= (1 if first else MIN_FURTHER_ROWS):
            return None
        return lines[is_row], [column.filter(arrow_mask(is_row)) for column in columns]

    def _texts(self, lines: npt.NDArray[np.intp]) -> Sequence[str]:
        begin, end = (int(lines[0]), int(lines[-1]) + 1) if lines.size else (0, 0)
        if end - begin == len(lines):
            return self._lines.texts[begin:end]
        return [self._lines.texts[line] for line in lines.tolist()]

    def _part_comment(self, line: int) -> None:
        """Take text behind the last column out of a row, so that it is told."""
        row, _, comment = self._lines.texts[line].rpartition(self._delimiter)
        values = [cell for cell in split_cells(row, self._delimiter) if cell]
        if self._delimiter != " " and values and all(map(_SINGLE.fullmatch, values)) and not _SINGLE.fullmatch(comment):
            self._lines.texts[line] = row
            self._comments[line] = comment.strip()
            self._widths[line] -= 1

    def _blocks(self, rows: npt.NDArray[np.intp], all_cells: "Sequence[pa.StringArray]") -> Iterator[ForeignTable]:
        """Cut the rows where a heading stands between them, or a line that stood before the first of them as well."""
        width = len(all_cells)
        parting = ",." if self._delimiter == ";" else ","
        marks = number_marks(str(self._path), all_cells, self._settings.decimal, parting)
        cuts, left_out = self._cuts(rows, width)
        if len(cuts) > 1 and len(rows) - cuts[-1] < MIN_FURTHER_ROWS:
            # A table of results, as a preamble may hold one too.
            left_out += range(rows[cuts[-1] - 1] + 1, rows[-1] + 1)
            rows, left_out = (
                rows[: cuts.pop()],
                sorted(line for line in set(left_out) if self._lines.texts[line].strip()),
            )
        heading, behind = _Heading(), 0
        for begin, end in pairwise((*cuts, len(rows))):
            if end - begin < MIN_FURTHER_ROWS and len(rows) > 2 * (end - begin):
                continue
            preamble = tuple(self._lines.texts[behind : max(int(rows[begin]), self._settings.header_lines or 0)])
            cells = [column.slice(begin, end - begin) for column in all_cells]
            found = _heading(preamble, self._delimiter, width) or heading
            heading = self._placed(found if found.units or found.names != heading.names else heading, cells)
            table, clocks = self._table(rows[begin:end], cells, heading, marks)
            inside = [line for line in left_out if rows[begin] < line <= (rows[end] if end < len(rows) else np.inf)]
            remarks = (*self._told(inside), *table.remarks)
            table = _with_joined_clock(replace(table, preamble=preamble, remarks=remarks), clocks)
            yield from _side_by_side(_with_stated_waveform(table), heading.names, self._delimiter)
            behind = int(rows[end - 1]) + 1

    def _table(
        self,
        rows: npt.NDArray[np.intp],
        cells: "Sequence[pa.StringArray]",
        heading: _Heading,
        marks: Sequence[NumberMarks],
    ) -> tuple[ForeignTable, tuple[RowTimes | None, ...]]:
        """Return the table of some rows, and the clock that each of its columns is."""
        numbers = self._lines.numbers[rows]
        is_gapless = numbers[-1] - numbers[0] == len(numbers) - 1
        columns, clocks = _columns(heading, cells, marks)
        lines = range(int(numbers[0]), int(numbers[-1]) + 1) if is_gapless else tuple(numbers.tolist())
        remarks = (*self._told_comments(rows), *remarks_on_marks(marks))
        return ForeignTable(self._path, columns, lines=lines, remarks=remarks), clocks

    def _placed(self, heading: _Heading, cells: "Sequence[pa.StringArray]") -> _Heading:
        """Find the column without a name, where a heading has one name too few; raises `ImportDataError`."""
        if not heading.names or len(heading.names) == len(cells):
            return heading
        if not are_values(cells[-1]).any():
            return heading
        first = text_column("", "", cells[0], NumberMarks())[0].values
        if np.array_equal(first, first[0] + np.arange(len(first))) or not np.isfinite(first).any():
            return _Heading(("", *heading.names), ("", *heading.units) if heading.units else ())
        raise ImportDataError(
            f"{self._path}: has {len(heading.names)} names for {len(cells)} columns, so that names cannot be placed; "
            "add the missing one to the heading."
        )

    def _cuts(self, rows: npt.NDArray[np.intp], width: int) -> tuple[list[int], list[int]]:
        """Return the places in `rows` at which a table begins, and the lines that belong to none."""
        texts = self._lines.texts
        seen = {_skeleton(line) for line in texts[: rows[0]] if line.strip()}
        cuts, left_out = [0], []
        for place in np.flatnonzero(np.diff(rows) > 1).tolist():
            between = [line for line in range(rows[place] + 1, rows[place + 1]) if texts[line].strip()]
            told = [texts[line] for line in between if not _COMMENT.match(texts[line])]
            marks = {_skeleton(line) for line in told}
            if _heading(told, self._delimiter, width) or marks & seen:
                cuts.append(place + 1)
            elif ragged := [line for line in between if self._is_ragged(line)]:
                if len(ragged) < MIN_FURTHER_ROWS:
                    raise self._ragged_error(ragged[0], width)
                cuts.append(place + 1)
            else:
                left_out += between
        left_out += [
            line for line in range(rows[-1] + 1, len(texts)) if texts[line].strip() and not self._in_table[line]
        ]
        return cuts, left_out

    def _is_ragged(self, line: int) -> bool:
        """Whether a line is of values alone, though it has not the width of the rows."""
        cells = [cell for cell in split_cells(self._lines.texts[line], self._delimiter) if cell]
        return bool(cells) and all(_IS_VALUE.match(cell) or _HAS_NO_VALUE.match(cell) for cell in cells)

    def _ragged_error(self, line: int, width: int) -> ImportDataError:
        cells = len(split_cells(self._lines.texts[line], self._delimiter))
        return ImportDataError(
            f"{self._path}: line {self._lines.numbers[line]} has {cells} cells where the first row has {width}; "
            "correct or remove it, or state delimiter and header_lines."
        )

    def _told(self, left_out: Sequence[int]) -> Iterator[str]:
        if not left_out:
            return
        first, last = (self._lines.numbers[line] for line in (left_out[0], left_out[-1]))
        place = f"line {first} is" if len(left_out) == 1 else f"{len(left_out)} lines from {first} to {last} are"
        quoted = ", ".join(repr(self._lines.texts[line].strip()[:60]) for line in left_out[:TOLD_LINES])
        yield f"{place} no rows and left out: {quoted}{', …' if len(left_out) > TOLD_LINES else ''}"

    def _told_comments(self, rows: npt.NDArray[np.intp]) -> Iterator[str]:
        lines = [row for row in rows.tolist() if row in self._comments] if self._comments else []
        if lines:
            said = (f"line {self._lines.numbers[line]} {self._comments[line]!r:.60}" for line in lines[:TOLD_LINES])
            yield f"rows with text behind, {len(lines)}: {', '.join(said)}{', …' if len(lines) > TOLD_LINES else ''}"


def _widths(lines: Sequence[str], delimiter: str) -> npt.NDArray[np.intp]:
    """Return the number of cells of each line; 0 for empty lines and comments."""
    if delimiter == " ":
        widths = np.array([len(line.split()) for line in lines], dtype=np.intp)
    else:
        widths = np.array([line.count(delimiter) for line in lines], dtype=np.intp) + 1
    unusual = [number for number, line in enumerate(lines) if line[:1] in "#%/ \t" or '"' in line]
    for number in unusual:
        line = lines[number]
        if not line.strip() or _COMMENT.match(line):
            widths[number] = 0
        elif '"' in line and delimiter != " ":
            widths[number] = _QUOTED.sub("", line).count(delimiter) + 1
    return widths


def _parsed(path: Path, lines: Sequence[str], delimiter: str, width: int) -> "tuple[pa.StringArray, ...]":
    """Return the cells of lines, column by column, without the white space around them."""
    import pyarrow as pa
    import pyarrow.compute as pc
    from pyarrow import csv as arrow_csv

    names = [str(column) for column in range(width)]
    body = "\n".join(" ".join(line.split()) for line in lines) if delimiter == " " else "\n".join(lines)
    data = body.encode("utf-8", "surrogatepass")
    try:
        table = arrow_csv.read_csv(
            io.BytesIO(data),
            arrow_csv.ReadOptions(column_names=names, block_size=min(len(data) + 1, 2**31 - 1)),
            arrow_csv.ParseOptions(delimiter=delimiter, ignore_empty_lines=False),
            arrow_csv.ConvertOptions(column_types=dict.fromkeys(names, pa.string()), strings_can_be_null=False),
        )
    except pa.ArrowInvalid:
        table = None
    if table is None or len(table) != len(lines):
        raise ImportDataError(f"{path}: holds quotes that do not match; remove them.")
    return tuple(pc.utf8_trim_whitespace(column.combine_chunks()) for column in table.columns)


def _rows_among(columns: "Sequence[pa.StringArray]") -> Mask:
    """Return which lines are rows.

    A row has a value, or a mark of a missing one, in the first column that is mostly values, and values in half of the
    others that are filled; among rows, it may have marks of missing values alone.
    """
    is_value = np.array([are_values(column) for column in columns])
    is_filled = np.array([are_filled(column) for column in columns])
    value_columns = np.flatnonzero(2 * is_value.sum(axis=1) > (is_filled & is_value.any(axis=0)).sum(axis=1))
    if not value_columns.size:
        return np.zeros(len(columns[0]), dtype=np.bool_)
    values = is_value[value_columns].sum(axis=0)
    filled = is_filled[value_columns].sum(axis=0)
    in_column = is_value[value_columns].sum(axis=1)
    first = value_columns[np.argmax(2 * in_column >= in_column.max())]
    in_first = is_value[first].copy()
    in_first[~is_value[first]] = matches(columns[first].filter(arrow_mask(~is_value[first])), NO_VALUE)
    is_row = in_first & (values > 0) & (2 * values >= filled)
    known = np.flatnonzero(is_row)
    for line in np.flatnonzero(in_first & (values == 0) & (filled > 0)).tolist():
        cells = (columns[column][line].as_py() for column in value_columns.tolist())
        is_row[line] = known.size and known[0] < line < known[-1] and all(map(_HAS_NO_VALUE.match, cells))
    return np.asarray(is_row)


def _skeleton(line: str) -> str:
    """Return a line without its numbers, by which marks of blocks are known again."""
    return re.sub(r"[\d.,+-]+", "0", line.strip().casefold())


def _columns(
    heading: _Heading, cells: "Sequence[pa.StringArray]", marks: Sequence[NumberMarks]
) -> tuple[tuple[ForeignColumn, ...], tuple[RowTimes | None, ...]]:
    """Return the columns of a table, and the clock that each is."""
    columns: list[ForeignColumn] = []
    clocks: list[RowTimes | None] = []
    for number, texts in enumerate(cells):
        name = heading.names[number] if number < len(heading.names) else ""
        unit = heading.units[number] if number < len(heading.units) else ""
        if not name and number == len(cells) - 1 and not are_filled(texts).any():
            continue  # each line ends with a delimiter
        name = name or f"column {number + 1}"
        column, clock = text_column(
            name, canonical_unit(unit) or unit or split_unit(name)[1] or "", texts, marks[number]
        )
        columns.append(column)
        clocks.append(clock)
    return tuple(columns), tuple(clocks)


def _heading(lines: Sequence[str], delimiter: str, width: int) -> _Heading | None:
    """Return names and units of the last lines that have the width of the table and no values; None without any.

    Above a line of units, or of marks that a logger adds, stand the names.
    """
    if lines and lines[0].lstrip('"').startswith("TOA5"):
        # Campbell Scientific, TOA5: file, names, units, kinds of processing.
        lines = lines[:3]
    rows = [cells for line in lines if any(cells := _heading_cells(line, delimiter, width))]
    if not rows:
        return None
    if len(rows) > 1 and _are_units(rows[-1]) and not _are_units(rows[-2]):
        return _Heading(tuple(rows[-2]), tuple(cell.strip("[]()") for cell in rows[-1]))
    return _Heading(tuple(rows[-1]))


def _heading_cells(line: str, delimiter: str, width: int) -> list[str]:
    """Return the cells of a line as wide as the table, up to empty ones or a missing one at its end; else none."""
    line = _COMMENT.sub("", line, count=1)
    cells = split_cells(line, delimiter)
    if delimiter == " " and len(cells) != width:
        spaced = [cell for cell in re.split(r"\s*\t\s*|\s{2,}", line.strip()) if cell]
        cells = spaced if len(spaced) == width else _HEADING_WORD.findall(line)
    while len(cells) > width and not cells[-1]:
        cells.pop()
    if len(cells) == width + 1 and delimiter != " " and width > 1:
        # Behind the last column of numbers a heading may name one of remarks that no line has.
        cells.pop()
    missing = width - len(cells)
    is_short = missing == 1 and delimiter != " " and width > 2
    is_row = any(map(_is_measured, cells)) or all(map(_HAS_NO_VALUE.match, cells))
    if (missing and not is_short) or is_row:
        return []
    return cells


def _is_measured(cell: str) -> bool:
    """Whether a cell begins with a digit and looks like a value, and is no name such as `1st`."""
    word = re.fullmatch(r"\d+([A-Za-z]{2,})", cell)
    return cell[:1].isdigit() and bool(_IS_VALUE.match(cell)) and (word is None or canonical_unit(word[1]) is not None)


def _are_units(cells: Sequence[str]) -> bool:
    filled = [cell for cell in cells if cell]
    known = sum(canonical_unit(cell) is not None for cell in filled)
    bracketed = all(cell[:1] in "[(" and cell[-1:] in "])" for cell in filled)
    return bool(filled) and (bracketed or 2 * known >= len(filled))


def _with_joined_clock(table: ForeignTable, clocks: Sequence[RowTimes | None]) -> ForeignTable:
    """Make a date and a time of day in columns of their own one clock."""
    known = [(number, clock) for number, clock in enumerate(clocks) if clock is not None]
    dates, times = [each for each in known if each[1].is_date], [each for each in known if each[1].is_time_of_day]
    if len(dates) != 1 or len(times) != 1:
        return table
    ((date_at, date),), ((time_at, time),) = dates, times
    columns = list(table.columns)
    columns[time_at] = joined(date, time).column(columns[time_at].name)
    told = f"columns {columns[date_at].name!r} and {columns[time_at].name!r} are one clock"
    del columns[date_at]
    return replace(table, columns=tuple(columns), remarks=(*table.remarks, told))


def _side_by_side(table: ForeignTable, names: Sequence[str], delimiter: str) -> Iterator[ForeignTable]:
    """Part tables that stand beside each other: the same names again, with or without an empty column between them."""
    wide = len(table.columns)
    for width, gap in (
        (width, gap) for width in range(2, wide // 2 + 1 if len(names) == wide else 0) for gap in (0, 1)
    ):
        starts = range(0, wide - width + 1, width + gap)
        between = [table.columns[start + width] for start in starts if start + width < wide] if gap else []
        is_same = all(names[start : start + width] == names[:width] for start in starts)
        is_parted = not any(column.bad or np.isfinite(column.values).any() for column in between)
        if len(starts) < 2 or starts[-1] + width != wide or not is_same or not is_parted:
            continue
        titles = [f"columns {start + 1} to {start + width}" for start in starts]
        for line in table.preamble:
            cells = split_cells(line, delimiter)
            above = [cells[start] for start in starts if start < len(cells) and cells[start]]
            titles = above if len(set(above)) == len(starts) else titles
        for start, title in zip(starts, titles, strict=True):
            columns = table.columns[start : start + width]
            yield replace(table, columns=columns, name=title)
        return
    yield table


def _with_stated_waveform(table: ForeignTable) -> ForeignTable:
    """Apply the head of a segment of a LabVIEW measurement file (.lvm); a table of another file is returned as it is.

    `X_Columns` decides whether there is one column of abscissae, one for each channel, or none, where rows follow each
    other at `Delta_X` (NI, Specification for the LabVIEW Measurement File).
    """
    if not any(line.startswith(_LVM_END) for line in table.preamble):
        return table
    stated = _stated_in_lvm(table)
    units = iter(stated.get("Y_Unit_Label", ()))
    is_time = all(dimension in {"", "Time"} for dimension in stated.get("X_Dimension", ()))
    columns, abscissa = [], None
    for column in table.columns:
        if column.name != _LVM_ABSCISSA:
            unit = next(units, "") if not column.units else column.units
            columns.append(replace(column, units=canonical_unit(unit) or unit))
        elif not np.isfinite(column.values).any() and column.bad is None:
            continue
        elif abscissa is None or not np.array_equal(abscissa, column.values, equal_nan=True):
            abscissa = column.values
            columns.append(replace(column, units=column.units or ("s" if is_time else "")))
    steps = {float(step.replace(",", ".")) for step in stated.get("Delta_X", ()) if step}
    rate = 1 / min(steps) if abscissa is None and len(steps) == 1 and min(steps) > 0 else None
    return replace(table, columns=tuple(columns), sample_rate_hz=rate, begins_at=_begin_of_lvm(stated))


def _stated_in_lvm(table: ForeignTable) -> Mapping[str, tuple[str, ...]]:
    """Return the values of each key, that of a segment before that of the file."""
    marks = ("\t" if "\t" in line else "," for line in table.preamble)
    cells = [[cell.strip() for cell in line.split(mark)] for line, mark in zip(table.preamble, marks, strict=True)]
    return {key: tuple(value for value in values if value) for key, *values in cells if key and key != _LVM_END}


def _begin_of_lvm(stated: Mapping[str, tuple[str, ...]]) -> datetime | None:
    """Return the start of the first channel; LabVIEW writes local time, with up to 18 digits behind the second."""
    day, time = (next(iter(stated.get(key, ())), "") for key in ("Date", "Time"))
    whole, _, fraction = time.replace(",", ".").partition(".")
    try:
        return datetime.fromisoformat(f"{day.replace('/', '-')}T{whole}.{f'{fraction:0<6.6}'}").astimezone()
    except (ValueError, OSError):  # Windows knows no local time before 1970
        return None
