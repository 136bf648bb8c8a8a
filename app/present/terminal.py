"""Documents in a terminal: sentences, tables and bars; other figures are left to pages and files."""

import io
import sys
from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import TYPE_CHECKING

from dragrig.analysis import printable
from dragrig.present import Bar, BarPart, Block, Code, Document, Facts, Figure, Items, Section, Table, Text, TextKind

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.text import Text as RichText

PIPE_WIDTH = 200
"""Columns where no window limits them: in files and pipes."""
BAR_WIDTH, NAMES_WIDTH = 60, 76
"""Columns of a whole, and of the names below it, so that both stay within 80."""


def print_document(document: Document) -> None:
    """Print a document on standard output; a table wraps where the window is narrow."""
    from rich.console import Console

    width = None if sys.stdout.isatty() else PIPE_WIDTH
    _print(document, Console(file=sys.stdout, width=width, highlight=False))


def document_text(document: Document, width: int = PIPE_WIDTH) -> str:
    """Return a document as it is printed."""
    from rich.console import Console

    text = io.StringIO()
    _print(document, Console(file=text, width=width, highlight=False))
    return text.getvalue()


def rich_text(text: str, style: str = "") -> "RichText":
    """Return a text for rich; what would drive the terminal instead of being read is written out."""
    from rich.text import Text as RichText

    return RichText(printable(text), style=style)


def _print(document: Document, console: "Console") -> None:
    from rich.text import Text as RichText

    head = [document.source] if document.source and not document.answer else []
    head += [f"! {document.problem}"] if document.problem else []
    lines = [*head, *document.lead]
    console.print(rich_text(_plain(document.answer or document.title), "bold"), soft_wrap=True)
    for line in lines:
        console.print(rich_text(_plain(line)), soft_wrap=True)
    for section in document.content:
        for part in _section(section, 0, console.width):
            console.print(part, soft_wrap=isinstance(part, RichText))


def _section(section: Section, level: int, width: int) -> "Iterator[RenderableType]":
    """Yield a blank line, the heading and the blocks; nothing of a section that a terminal leaves out."""
    parts: list[RenderableType] = []
    for block in section.content:
        if isinstance(block, Table) and block.caption and parts:
            parts.append(rich_text(""))
        parts += _block(block, level, width)
    if section.collapsed or not parts:
        return
    yield rich_text("")
    if section.heading:
        yield rich_text(section.heading, "bold" if level == 0 else "underline")
    yield from parts


def _block(block: Block, level: int, width: int) -> "Iterator[RenderableType]":
    match block:
        case Text() if block.kind is not TextKind.EXPLANATION:
            yield rich_text(_plain(block.text))
        case Items():
            mark = "! " if block.remarks else "  "
            yield from (rich_text(f"{mark}{_plain(item)}") for item in block.items[: block.brief])
            if block.brief is not None and len(block.items) > block.brief:
                yield rich_text(f"  and {len(block.items) - block.brief} more")
        case Facts():
            width = max(map(len, block.values))
            yield from (rich_text(f"  {name:{width}}  {value}") for name, value in block.values.items() if value)
        case Code():
            yield from (rich_text(f"  {line}") for line in block.text.splitlines())
        case Table():
            yield from _table(block, width)
        case Section():
            yield from _section(block, level + 1, width)
        case Figure():
            yield from _bars(block.bars)


def _table(block: Table, width: int) -> "Iterator[RenderableType]":
    if block.caption:
        yield rich_text(block.caption, "italic")
    yield _aligned_table(block, width) or _wrapped_table(block)
    if block.omitted_text:
        yield rich_text(block.omitted_text)


def _aligned_table(block: Table, width: int) -> "RichText | None":
    """Lay out a table that need not wrap, in a tenth of the time that one takes which might; None where it must."""
    from rich.cells import cell_len

    headings = [column.heading for column in block.columns]
    rows = [[printable(text) for text in headings]] if any(headings) else []
    rows += [[printable(cell.text) for cell in row] for row in block.brief_cells]
    numeric = block.numeric
    lengths = [[cell_len(text) for text in row] for row in rows]
    widths = [max(column) for column in zip(*lengths, strict=True)]
    if sum(widths) + 2 * (len(widths) - 1) > width or any("\n" in text for row in rows for text in row):
        return None
    lines = (
        "  ".join(
            f"{' ' * (room - length)}{text}" if to_right else f"{text}{' ' * (room - length)}"
            for text, length, room, to_right in zip(row, row_lengths, widths, numeric, strict=True)
        ).rstrip()
        for row, row_lengths in zip(rows, lengths, strict=True)
    )
    return rich_text("\n".join(lines))


def _wrapped_table(block: Table) -> "RenderableType":
    from rich.table import Table as RichTable

    headings = [column.heading for column in block.columns]
    table = RichTable(
        box=None,
        pad_edge=False,
        padding=(0, 2, 0, 0),
        show_header=any(headings),
        header_style="none",
        title_style="none",
    )
    for heading, numeric in zip(headings, block.numeric, strict=True):
        table.add_column(rich_text(heading), justify="right" if numeric else "left", overflow="fold")
    for row in block.brief_cells:
        table.add_row(*(rich_text(cell.text) for cell in row))
    return table


def _bars(bars: Sequence[Bar]) -> "Iterator[RenderableType]":
    """Yield each whole, its bar, whose parts differ in shading as well as in colour, and their names below it."""
    for bar in bars:
        ends, whole = [0], max(1.0, sum(part.share for part in bar.parts))
        for end in accumulate(part.share for part in bar.parts):
            ends.append(max(round(BAR_WIDTH * end / whole), ends[-1] + 1))
        drawn = rich_text("  ")
        for number, part in enumerate(bar.parts):
            shade = "░" if part.hatched else "█▓"[number % 2]
            drawn.append(shade * (ends[number + 1] - ends[number]), style=part.colour)
        yield rich_text(f"  {bar.whole}:")
        yield drawn
        yield from _names_below(bar.parts, ends)


def _names_below(parts: Sequence[BarPart], starts: Sequence[int]) -> "list[RichText]":
    """Write each part's name and share from where the part begins, on the first line where there is room for it."""
    lines: list[RichText] = []
    for part, start in zip(parts, starts, strict=False):
        name = f"{part.name} {part.size}"
        place = 2 + max(0, min(start, NAMES_WIDTH - len(name)))
        line = next((line for line in lines if len(line) + 2 <= place), None)
        if line is None:
            line = rich_text("")
            lines.append(line)
        line.append(" " * (place - len(line)))
        line.append_text(rich_text(name, part.colour))
    return lines


def _plain(text: str) -> str:
    return text.replace("`", "")
