"""CSV: metadata as comment lines, one line of column names, numbers with any decimal mark."""

import io
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dragrig.analysis.exporting.content import Content
from dragrig.analysis.progress import Progress
from dragrig.config.errors import AnalysisError

PIECE = 1 << 16
"""Rows that are turned into text at a time."""

DELIMITERS = {",": "comma", ";": "semicolon", "\t": "tab", "|": "bar", " ": "space"}


@dataclass(frozen=True, slots=True)
class CsvStyle:
    """How numbers and columns are told apart.

    Attributes
    ----------
    decimal
        Decimal mark, `.` or `,`.
    delimiter
        Comma, semicolon, tab, bar or space; comma, or semicolon with decimal commas, when left out.

    Raises
    ------
    AnalysisError
        When decimal mark and delimiter are the same, or not among these.
    """

    decimal: str = "."
    delimiter: str = ""

    def __post_init__(self) -> None:
        if self.decimal not in {".", ","}:
            raise AnalysisError(f"A decimal mark of {self.decimal!r} is not offered; choose . or ,")
        if not self.delimiter:
            object.__setattr__(self, "delimiter", ";" if self.decimal == "," else ",")
        if self.delimiter not in DELIMITERS:
            raise AnalysisError(
                f"A delimiter of {self.delimiter!r} is not offered; choose {', '.join(DELIMITERS.values())}."
            )
        if self.delimiter == self.decimal:
            raise AnalysisError(
                "Decimal mark and delimiter are both a comma, so that columns could not be told apart; "
                "choose ; as the delimiter."
            )


def write(part: Path, content: Content, style: CsvStyle, progress: Progress) -> None:
    """Write a CSV file, piece by piece; missing numbers are empty cells."""
    import pyarrow as pa
    from pyarrow import csv

    names = [column.name for column in content.columns]
    rows = len(content.columns[0].values)
    options = csv.WriteOptions(include_header=False, delimiter=style.delimiter, quoting_style="none")
    with part.open("wb") as file:
        for key, value in content.metadata.items():
            file.write(f"# {key}: {json.dumps(value, ensure_ascii=False)}\n".encode())
        file.write((style.delimiter.join(names) + "\n").encode())
        for start in range(0, rows, PIECE):
            progress(start, rows)
            arrays = [pa.array(_native(c.values[start : start + PIECE]), from_pandas=True) for c in content.columns]
            text = io.BytesIO()
            csv.write_csv(pa.table(arrays, names=names), text, options)
            numbers = text.getvalue()
            file.write(numbers.replace(b".", b",") if style.decimal == "," else numbers)
    progress(rows, rows)


def _native(
    values: np.ndarray[tuple[int, ...], np.dtype[np.generic]],
) -> np.ndarray[tuple[int, ...], np.dtype[np.generic]]:
    return np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("="))
