"""Which tables of a foreign file become runs, what is told of the others, and each sentence on what is not read."""

import gzip
import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from datetime import date, time, timedelta
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather, parquet

from dragrig.analysis.importing import file_kinds
from dragrig.analysis.importing.import_settings import ImportSettings
from dragrig.analysis.importing.readers import cell_text, read_foreign, text_of
from dragrig.config import ImportDataError

MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
RELATIONS = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
PACKAGE = "http://schemas.openxmlformats.org/package/2006"
SHEETS = "application/vnd.openxmlformats-officedocument.spreadsheetml"
ROWS = (("t", "F"), (0.0, 1.5), (0.1, 2.5), (0.2, 3.5), (0.3, 4.5))


def workbook(path: Path, sheets: Mapping[str, Sequence[Sequence[float | str]]]) -> Path:
    """Write a workbook of texts and numbers."""
    with zipfile.ZipFile(path, "w") as archive:
        names = list(enumerate(sheets, 1))
        kinds = "".join(
            f'<Override PartName="/xl/worksheets/sheet{number}.xml" ContentType="{SHEETS}.worksheet+xml"/>'
            for number, _ in names
        )
        archive.writestr(
            "[Content_Types].xml",
            f'<Types xmlns="{PACKAGE}/content-types"><Default Extension="rels" '
            'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
            f'<Override PartName="/xl/workbook.xml" ContentType="{SHEETS}.sheet.main+xml"/>{kinds}</Types>',
        )
        archive.writestr("_rels/.rels", relations({"rId1": ("officeDocument", "xl/workbook.xml")}))
        archive.writestr(
            "xl/_rels/workbook.xml.rels",
            relations({f"rId{number}": ("worksheet", f"worksheets/sheet{number}.xml") for number, _ in names}),
        )
        entries = "".join(f'<sheet name="{name}" sheetId="{n}" r:id="rId{n}"/>' for n, name in names)
        archive.writestr(
            "xl/workbook.xml", f'<workbook xmlns="{MAIN}" xmlns:r="{RELATIONS}"><sheets>{entries}</sheets></workbook>'
        )
        for number, name in names:
            rows = "".join(f"<row>{''.join(map(cell, row))}</row>" for row in sheets[name])
            archive.writestr(
                f"xl/worksheets/sheet{number}.xml",
                f'<worksheet xmlns="{MAIN}"><sheetData>{rows}</sheetData></worksheet>',
            )
    return path


def cell(value: float | str) -> str:
    if isinstance(value, str):
        return f'<c t="inlineStr"><is><t>{value}</t></is></c>'
    return f"<c><v>{value}</v></c>"


def relations(targets: Mapping[str, tuple[str, str]]) -> str:
    inside = "".join(
        f'<Relationship Id="{key}" Type="{RELATIONS}/{kind}" Target="{target}"/>'
        for key, (kind, target) in targets.items()
    )
    return f'<Relationships xmlns="{PACKAGE}/relationships">{inside}</Relationships>'


def refusal(path: Path, **settings: object) -> str:
    """Return the sentence with which a file is refused, without its path."""
    with pytest.raises(ImportDataError) as caught:
        read_foreign(path, ImportSettings.model_validate(settings))
    return str(caught.value).removeprefix(f"{path}: ")


def longer(rows: Sequence[Sequence[float | str]], times: int) -> list[Sequence[float | str]]:
    return [rows[0], *[(number / 10, float(number)) for number in range(times)]]


def test_sheets_with_the_columns_of_the_largest_are_read_and_the_others_told(tmp_path: Path) -> None:
    path = workbook(
        tmp_path / "run.xlsx",
        {
            "first": ROWS,
            "notes": (("a person",), ("was here",)),
            "second": longer(ROWS, 6),
            "wide": (("x", "y", "z"), (1.0, 2.0, 3.0), (2.0, 3.0, 4.0), (3.0, 4.0, 5.0)),
            "short": ROWS[:3],
            "empty": (),
        },
    )
    first, second = read_foreign(path)
    assert [(table.name, table.rows) for table in (first, second)] == [("first", 4), ("second", 6)]
    assert first.path == path
    np.testing.assert_array_equal(first.column("F").values, [1.5, 2.5, 3.5, 4.5])
    assert first.remarks == (
        "sheet 'notes' was not read: it holds no table of numbers",
        "table 'wide' was not read (3 columns, 3 rows; --table names it)",
        "table 'short' was not read (2 columns, 2 rows; --table names it)",
    )
    assert second.remarks == ()


def test_a_table_is_taken_by_its_name(tmp_path: Path) -> None:
    path = workbook(tmp_path / "run.xlsx", {"first": ROWS, "second": longer(ROWS, 6)})
    (table,) = read_foreign(path, ImportSettings(table="first"))
    assert (table.name, table.rows) == ("first", 4)
    assert refusal(path, table="frist") == "there is no table 'frist'; did you mean first?"
    assert refusal(path, table="x") == "there is no table 'x'; known are first, second."
    alone = tmp_path / "run.csv"
    alone.write_text("t,F\n0,1\n1,2\n2,3\n")
    assert refusal(alone, table="x") == "there is no table 'x'; it holds a single table; leave the name out."


def test_the_only_table_is_read_however_short_it_is(tmp_path: Path) -> None:
    path = workbook(tmp_path / "run.xlsx", {"first": ROWS[:3]})
    (table,) = read_foreign(path)
    assert (table.rows, table.remarks) == (2, ())


def test_a_workbook_without_numbers_is_refused(tmp_path: Path) -> None:
    texts = (("a person",), ("was here",))
    path = workbook(tmp_path / "run.xlsx", {"first": texts, "second": texts})
    assert refusal(path) == "no sheet holds a table of numbers; give a file with data."
    alone = workbook(tmp_path / "alone.xlsx", {"first": texts})
    assert refusal(alone) == refusal(path, table="first") != refusal(path)
    nothing = workbook(tmp_path / "nothing.xlsx", {"first": ()})
    assert refusal(nothing) == "no sheet holds a table of numbers; give a file with data."


def test_a_sheet_whose_cells_hold_whole_lines_is_read_as_text(tmp_path: Path) -> None:
    lines = [(f"{number / 10};{number}",) for number in range(5)]
    path = workbook(tmp_path / "run.xlsx", {"first": [("t;F",), *lines]})
    (table,) = read_foreign(path)
    assert [column.name for column in table.columns] == ["t", "F"]
    np.testing.assert_array_equal(table.column("F").values, np.arange(5.0))


@pytest.mark.parametrize(
    ("ending", "options", "sentence"),
    [
        ("xlsx", {"encoding": "utf-8"}, "--encoding is for text files, and this is none; leave it out."),
        (
            "xlsx",
            {"encoding": "utf-8", "delimiter": "tab"},
            "--encoding, --delimiter is for text files, and this is none; leave it out.",
        ),
        (
            "npy",
            {"encoding": "utf-8", "delimiter": "tab", "decimal": ",", "header_lines": 2},
            "--encoding, --delimiter, --decimal, --header-lines is for text files, and this is none; leave it out.",
        ),
        ("npy", {"header_lines": 0}, "--header-lines is for text files, and this is none; leave it out."),
    ],
)
def test_options_of_text_are_refused_for_what_is_none(
    tmp_path: Path, ending: str, options: dict[str, object], sentence: str
) -> None:
    path = tmp_path / f"run.{ending}"
    if ending == "xlsx":
        workbook(path, {"first": ROWS})
    else:
        np.save(path, np.ones((4, 2)))
    assert refusal(path, **options) == sentence


def test_a_workbook_may_have_header_lines_and_a_decimal_mark(tmp_path: Path) -> None:
    path = workbook(tmp_path / "run.xlsx", {"first": [("of", "Monday"), *ROWS]})
    (table,) = read_foreign(path, ImportSettings.model_validate({"header_lines": 1, "decimal": "."}))
    assert [column.name for column in table.columns] == ["t", "F"]


def test_a_file_that_is_not_there_or_empty_is_said(tmp_path: Path) -> None:
    assert refusal(tmp_path / "run.csv") == "there is no such file; give the path of a measurement."
    for content in (b"", b"\r\n\t \0"):
        (tmp_path / "run.csv").write_bytes(content)
        assert refusal(tmp_path / "run.csv") == "is empty; give a file with a table of numbers."
        with pytest.raises(ImportDataError, match=r"run.csv: is empty; give a file with a table of numbers.$"):
            text_of(tmp_path / "run.csv")
    with pytest.raises(ImportDataError) as caught:
        text_of(tmp_path)
    why = "Permission denied" if os.name == "nt" else "Is a directory"
    assert str(caught.value) == f"{tmp_path}: cannot be read ({why}); check the path."


def test_a_packed_file_is_named_as_it_was_given(tmp_path: Path) -> None:
    path = tmp_path / "run.csv.gz"
    path.write_bytes(gzip.compress(gzip.compress(b"t,F\n0,1\n")))
    assert refusal(path) == "is packed twice; unpack it once."
    path.write_bytes(gzip.compress(b"t,F\n0,1\n1,2\n2,3\n"))
    (table,) = read_foreign(path)
    assert (table.path, table.rows) == (path, 3)


@pytest.mark.parametrize(
    ("content", "encoding", "found"),
    [
        ("t,µ\n".encode("utf-8-sig"), "", "t,µ\n"),
        ("t,µ\n".encode("cp1252"), "cp1252", "t,µ\n"),
        (b"t,F\n\0\0", "utf-8", "t,F\n"),
        ("\ufefft\ufeff".encode(), "utf-8", "t\ufeff"),
        (b"t,F\nX", "utf-8", "t,F\nX"),
    ],
)
def test_text_is_read_without_its_mark_and_what_a_logger_left(
    tmp_path: Path, content: bytes, encoding: str, found: str
) -> None:
    path = tmp_path / "run.csv"
    path.write_bytes(content)
    assert text_of(path, encoding) == found


@pytest.mark.parametrize(
    ("content", "encoding", "sentence"),
    [
        (
            b"t,F\n0,1\n0,\xb5\n\xb5",
            "utf-8",
            "line 3 is not text in the encoding utf-8; state the right one, such as cp1252 or utf-16.",
        ),
        (b"t", "klingon", "the encoding 'klingon' is not known; give one such as utf-8, cp1252 or utf-16."),
        (b"t,F\n0,1\n0,\x001\n\0", "utf-8", "line 3 holds a NUL byte, which is no text; remove it, or export anew."),
    ],
)
def test_what_is_no_text_is_said_with_its_line(tmp_path: Path, content: bytes, encoding: str, sentence: str) -> None:
    path = tmp_path / "run.csv"
    path.write_bytes(content)
    with pytest.raises(ImportDataError) as caught:
        text_of(path, encoding)
    assert str(caught.value) == f"{path}: {sentence}"


@pytest.mark.parametrize(
    ("cell_value", "text"),
    [
        (timedelta(hours=26, minutes=3, seconds=4.25), "26:03:04.250000"),
        (timedelta(seconds=59.5), "0:00:59.500000"),
        (timedelta(minutes=60), "1:00:00.000000"),
        (date(2026, 5, 4), "2026-05-04"),
        (time(9, 15, 0, 500_000), "09:15:00.500000"),
        (1.5, "1.5"),
        ("a\t b\nc", "a b c"),
        ("", ""),
    ],
)
def test_cells_become_text_as_a_person_writes_it(cell_value: object, text: str) -> None:
    assert cell_text(cell_value) == text


def test_tables_within_a_sheet_carry_its_name(tmp_path: Path) -> None:
    twice = [*ROWS, (), *ROWS]
    path = workbook(tmp_path / "run.xlsx", {"none": (("x",),), "first": twice, "second": ROWS})
    first, again, second = read_foreign(path)
    assert [table.name for table in (first, again, second)] == ["first, block 1", "first, block 2", "second"]
    assert first.remarks == ("sheet 'none' was not read: it holds no table of numbers",)


def test_a_workbook_that_is_damaged_or_too_large_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = workbook(tmp_path / "run.xlsx", {"first": ROWS})
    monkeypatch.setattr(file_kinds, "MAX_UNPACKED_TEXT_BYTES", 10)
    assert refusal(path).startswith("unpacks to 0.0 GB or more, and 0.0 GB is the limit;")
    monkeypatch.undo()
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content[:9] if name == "xl/workbook.xml" else content)
    assert re.fullmatch(r"is damaged or no spreadsheet file \(.*\); export it anew or as CSV\.", refusal(path))


def test_feather_and_parquet_are_read_as_what_they_are(tmp_path: Path) -> None:
    table = pa.table({"t": [0.0, 0.1, 0.2], "F": [1.0, 2.0, 3.0]})
    feather.write_feather(table, tmp_path / "run.feather")
    parquet.write_table(table, tmp_path / "run.parquet")
    for name in ("run.feather", "run.parquet"):
        (found,) = read_foreign(tmp_path / name)
        np.testing.assert_array_equal(found.column("F").values, [1.0, 2.0, 3.0])
