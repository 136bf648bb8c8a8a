"""Numbers and tables as a person reads them."""

import re
from collections.abc import Iterable, Sequence

from dragrig.wording import duration, size

__all__ = ["columns", "duration", "number", "size"]


def number(value: float | None, digits: int = 3) -> str:
    """Spell a number; nothing for one that is not there."""
    return "" if value is None or value != value else f"{value:.{digits}g}"  # noqa: PLR0124  # NaN


def columns(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
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
