"""Terminal output of results: sentences, and tables that wrap in a narrow window."""

import sys
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import RenderableType

PIPE_WIDTH = 200
"""Columns where nobody's window limits them: in files and pipes."""


def print_parts(parts: "Iterable[RenderableType]") -> None:
    """Print sentences and tables on standard output, an empty line between them; on a terminal the first is bold."""
    from rich.console import Console

    console = Console(file=sys.stdout, width=None if sys.stdout.isatty() else PIPE_WIDTH, highlight=False)
    for place, part in enumerate(parts):
        if place:
            console.print()
        style = "bold" if place == 0 and isinstance(part, str) else None
        console.print(part, markup=False, style=style, soft_wrap=isinstance(part, str))


def terminal_table(
    title: str, header: Sequence[str], rows: Iterable[Sequence[str]], numbers: Sequence[int] = ()
) -> "RenderableType":
    """Return a table without lines below its title; `numbers` are the columns whose cells stand to the right."""
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    made = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), show_header=any(header), header_style="none")
    for place, name in enumerate(header):
        made.add_column(Text(name), justify="right" if place in numbers else "left", overflow="fold")
    for row in rows:
        made.add_row(*(Text(cell) for cell in row))
    return Group(Text(title, style="bold"), made)
