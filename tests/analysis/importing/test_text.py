"""Tables from text, in every dialect that instruments write."""

import codecs
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from dragrig.analysis.importing.foreign import ForeignTable
from dragrig.analysis.importing.import_settings import ImportSettings
from dragrig.analysis.importing.readers import read_foreign
from dragrig.config.errors import ImportDataError
from places import DATA
from property_tests import examples

FOREIGN = DATA / "foreign"


@dataclass(frozen=True)
class Dialect:
    decimal: str
    delimiter: str
    encoding: str
    bom: bytes
    line_end: str
    units_row: bool
    preamble: tuple[str, ...]
    trailing: bool


def written(dialect: Dialect, names: list[str], rows: list[list[float]]) -> bytes:
    end = dialect.delimiter if dialect.trailing else ""
    join = dialect.delimiter.join
    lines = [*dialect.preamble, join(names) + end]
    if dialect.units_row:
        lines.append(join(["s", "N", "µm", "°C"][: len(names)]) + end)
    lines += [join(repr(value).replace(".", dialect.decimal) for value in row) + end for row in rows]
    return dialect.bom + dialect.line_end.join([*lines, ""]).encode(dialect.encoding)


def read_one(path: Path, **how: object) -> ForeignTable:
    (table,) = read_foreign(path, ImportSettings.model_validate(how))
    return table


def read(folder: Path, content: str | bytes, **how: object) -> ForeignTable:
    path = folder / "table.txt"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_one(path, **how)


NUMBER = st.one_of(
    st.floats(allow_nan=False, allow_infinity=False), st.floats(-1e3, 1e3), st.integers(-9, 9).map(float)
)
ENCODINGS = [
    ("utf-8", b""), ("utf-8", codecs.BOM_UTF8), ("cp1252", b""), ("utf-16-le", codecs.BOM_UTF16_LE),
    ("utf-16-be", codecs.BOM_UTF16_BE), ("utf-16-le", b""), ("utf-16-be", b""),
]  # fmt: skip


@st.composite
def tables(draw: st.DrawFn) -> tuple[Dialect, list[str], list[list[float]]]:
    decimal = draw(st.sampled_from(".,"))
    delimiter = draw(st.sampled_from([entry for entry in ("\t", ";", ",", "|", " ") if entry != decimal]))
    encoding, bom = draw(st.sampled_from(ENCODINGS))
    width = draw(st.integers(2, 4))
    names = ["Zeit", "Kraft", "Weg", "Temperatur"][:width]
    preamble = draw(st.sampled_from([(), ("Prüfstand 7, Lauf 3",), ("Datum: 3.5.2024", "Größe = 12,5 mm", "")]))
    dialect = Dialect(
        decimal, delimiter, encoding, bom, draw(st.sampled_from(["\n", "\r\n", "\r"])), draw(st.booleans()), preamble,
        trailing=delimiter != " " and draw(st.booleans()),
    )  # fmt: skip
    rows = draw(st.lists(st.lists(NUMBER, min_size=width, max_size=width), min_size=2, max_size=12))
    return dialect, names, rows


@settings(max_examples=examples(300), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(tables())
def test_any_table_in_any_dialect_is_read_back_exactly(
    tmp_path: Path, case: tuple[Dialect, list[str], list[list[float]]]
) -> None:
    dialect, names, rows = case
    table = read(tmp_path, written(dialect, names, rows))
    assert [column.name for column in table.columns] == names
    if dialect.units_row:
        assert [column.units for column in table.columns] == ["s", "N", "µm", "degC"][: len(names)]
    for k, column in enumerate(table.columns):
        assert column.bad is None
        assert column.values.tolist() == [row[k] for row in rows]
    assert table.place(0) == f"line {len(dialect.preamble) + 2 + dialect.units_row}"


@pytest.mark.parametrize(
    ("text", "names", "units", "first_column"),
    [
        ("1,2\n3,4\n", ["column 1", "column 2"], ["", ""], [1, 3]),
        ("t x\n 0  1.5\n 1   2.5\n", ["t", "x"], ["", ""], [0, 1]),
        ("Zeit [s];Kraft [mN]\n0,5;1\n1,5;2\n", ["Zeit [s]", "Kraft [mN]"], ["s", "mN"], [0.5, 1.5]),
        ("Time(s)\tDispl(microns)\n1\t2\n2\t3\n", ["Time(s)", "Displ(microns)"], ["s", "µm"], [1, 2]),
        ("# time_s, speed_mm_s\n0, 1.5\n1, 2.5\n", ["time_s", "speed_mm_s"], ["s", "mm/s"], [0, 1]),
        ('"t","F"\n"1,5","2,5"\n"3,5","4"\n', ["t", "F"], ["", ""], [1.5, 3.5]),
        ("t,F\n+1.5,-2e-3\n.5,7\n", ["t", "F"], ["", ""], [1.5, 0.5]),
        ("F,F\n1,2\n3,4\n", ["F", "F"], ["", ""], [1, 3]),
        ("t;F\n0;0\n1;0\n2;0,5\n", ["t", "F"], ["", ""], [0, 1, 2]),
    ],
)
def test_headers_and_numbers_as_instruments_write_them(
    tmp_path: Path, text: str, names: list[str], units: list[str], first_column: list[float]
) -> None:
    table = read(tmp_path, text)
    assert [column.name for column in table.columns] == names
    assert [column.units for column in table.columns] == units
    assert table.columns[0].values.tolist() == first_column


def test_empty_cells_are_missing_and_empty_lines_are_not_rows(tmp_path: Path) -> None:
    table = read(tmp_path, "a\tb\tc\n1\t\t3\n\n4\t5\t\n")
    np.testing.assert_array_equal(table.columns[1].values, [np.nan, 5])
    np.testing.assert_array_equal(table.columns[2].values, [3, np.nan])
    assert table.place(1) == "line 4"


def test_a_column_of_text_stands_beside_numbers(tmp_path: Path) -> None:
    table = read(tmp_path, "when;t;F\nnoon;0,1;3\nlater;0,2;4\n")
    assert table.columns[0].bad is not None
    assert table.columns[1].values.tolist() == [0.1, 0.2]


@pytest.mark.parametrize("bad_row", [0, 1, 57, 99])
def test_text_among_numbers_is_said_with_line_and_column(tmp_path: Path, bad_row: int) -> None:
    rows = [f"{k},{k}.5" for k in range(100)]
    rows[bad_row] = f"{bad_row},overload"
    table = read(tmp_path, "\n".join(["t,Load (N)", *rows]))
    with pytest.raises(
        ImportDataError, match=rf"table\.txt: line {bad_row + 2}, column 'Load \(N\)' holds 'overload' instead"
    ):
        table.numbers(table.column("Load"), whole=True)


def test_missing_values_are_said_with_their_line(tmp_path: Path) -> None:
    table = read(tmp_path, "t,F\n1,2\n3,\n4,nan\n")
    with pytest.raises(ImportDataError, match="line 3, column 'F' has no number"):
        table.numbers(table.columns[1], whole=True)
    assert np.isnan(table.numbers(table.columns[1], whole=False)).sum() == 2


def test_columns_are_found_by_name_label_and_number_and_the_nearest_is_named(tmp_path: Path) -> None:
    table = read(tmp_path, "Time (s),Load (N),Weg\n1,2,3\n2,3,4\n")
    assert table.column("load").name == "Load (N)"
    assert table.column("Load (N)").name == "Load (N)"
    assert table.column(3).name == "Weg"
    with pytest.raises(ImportDataError, match=r"there is no column 'Loat \(N\)'; did you mean Load \(N\)\?"):
        table.column("Loat (N)")
    with pytest.raises(ImportDataError, match="there is no column '4'"):
        table.column(4)


@pytest.mark.parametrize(
    ("content", "how", "message"),
    [
        ("", {}, "is empty"),
        ("\n \n", {}, "is empty"),
        ("hello world\nfoo\n", {}, "holds no table of numbers"),
        ("t;F\n1,5;2\n1.5;3\n", {}, "decimal commas in 1 cells and decimal points in 1"),
        ("t;F\n1;2\n3\n4;5\n", {}, "line 3 has 1 cells where the first row has 2"),
        ("t;F\n", {}, "holds no table of numbers"),
        (b"t;F\n1;2\n\x81;3\n", {}, "line 3 is not text in the encoding cp1252"),
        ("t;F\n1;2\n", {"encoding": "utf-99"}, "encoding 'utf-99' is not known"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0", {}, "is a picture"),
        ("t;F\n1;2\n", {"delimiter": ","}, "no table|column"),
    ],
)
def test_what_is_no_table_is_refused_in_one_sentence(
    tmp_path: Path, content: str | bytes, how: dict[str, str], message: str
) -> None:
    with pytest.raises(ImportDataError, match=message) as raised:
        read(tmp_path, content, **how)
    assert "table.txt" in str(raised.value)
    assert "\n" not in str(raised.value)


def test_what_is_stated_is_taken_as_stated(tmp_path: Path) -> None:
    stated = read(tmp_path, "a;b\n1.2345;5\n2.345;6\n", decimal=",")
    with pytest.raises(ImportDataError, match=r"holds '1\.2345' instead of a number"):
        stated.numbers(stated.columns[0], whole=True)
    assert read(tmp_path, "1,5\n3,4\n", delimiter=";").columns[0].values.tolist() == [1.5, 3.4]
    latin = "Größe;F\n1;2\n3;4\n".encode("cp850")
    assert read(tmp_path, latin, encoding="cp850").columns[0].name == "Größe"


@settings(max_examples=examples(300), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.one_of(st.binary(max_size=200), st.text('0123456789.,;\t \n-+eEnNaA"#µ', max_size=200).map(str.encode)))
@example(b"1-1-1000")
@example(b"31.12.9999 10:00:00;1\n31.12.9999 10:00:01;2\n")
def test_no_bytes_bring_anything_but_a_table_or_a_sentence(tmp_path: Path, content: bytes) -> None:
    text = ""
    try:
        text = f"{read(tmp_path, content).rows} rows"
    except ImportDataError as error:
        text = str(error)
    assert text != "0 rows"
    assert "\n" not in text


def test_real_files_are_read_without_being_told_how() -> None:
    gouge = read_one(FOREIGN / "velocity-steps" / "sepiolite.txt")
    assert [(column.label, column.units) for column in gouge.columns] == [
        ("Time", "s"), ("Displ", "µm"), ("Friction", ""), ("Effective_Normal_stress", "MPa"),
    ]  # fmt: skip
    assert gouge.rows == 700
    motor = read_one(FOREIGN / "cogging" / "speed_test.txt")
    assert [column.name for column in motor.columns][:3] == ["Time", "Position", "Velocity"]
    assert motor.columns[1].values[0] == -6.28915
