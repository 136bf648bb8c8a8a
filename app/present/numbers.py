"""Times, sizes, numbers and text columns as a person reads them."""

import re
from collections.abc import Iterable, Sequence


def duration_text(seconds: float) -> str:
    """Spell a time: 850 ms, 12.3 s, 4 min 10 s, 2 h 05 min."""
    if seconds < 1:
        return f"{1000 * seconds:.0f} ms"
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def size_text(count: float) -> str:
    """Spell a number of bytes: 820 B, 4.2 kB, 31 MB."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if count >= 10 or unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


def number_text(value: float | None, digits: int = 3) -> str:
    """Spell a number; nothing for one that is not there."""
    return "" if value is None or value != value else f"{value:.{digits}g}"  # noqa: PLR0124  # NaN


def text_columns(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Lay out a table as text: numbers to the right, words to the left, two spaces between columns."""
    table = [tuple(row) for row in rows]
    widths = [max(len(cell) for cell in column) for column in zip(header, *table, strict=True)]
    right = [_is_numeric(column) for column in zip(*table, strict=True)] if table else [False] * len(header)
    lines = []
    for row in (tuple(header), *table):
        cells = [
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(row, widths, right, strict=True)
        ]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def _is_numeric(cells: Sequence[str]) -> bool:
    return all(_NUMBER.fullmatch(cell) for cell in cells if cell)


_NUMBER = re.compile(r"[-−+±]?[\d.,]+(e[-+]?\d+)?( .*)?")
"""A number, with a unit or whatever follows a space."""
