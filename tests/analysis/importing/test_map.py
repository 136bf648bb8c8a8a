"""Which column is what, and its units."""

import tomllib

import pytest
from pydantic import ValidationError

from dragrig.analysis.importing.import_settings import ColumnSource, ImportSettings, parse_map
from dragrig.analysis.importing.units import canonical_unit, split_unit, unit_scale
from dragrig.config.errors import ImportDataError
from dragrig.config.settings import to_toml


@pytest.mark.parametrize(
    ("text", "column", "unit", "factor", "offset"),
    [
        ("force=Load (N):N", "Load (N)", "N", None, 0),
        ('force="a:b":N', "a:b", "N", None, 0),
        ("force=3:mV*12.5", "3", "mV", 12.5, 0),
        ("force = Ch1 : mV * -2e-1 + 3", "Ch1", "mV", -0.2, 3),
        ("force=Friction:1*1000", "Friction", "1", 1000, 0),
        ("force=Load", "Load", "", None, 0),
        ("force=Load:*2", "Load", "", 2, 0),
        ("force=Load:N-5", "Load", "N", None, -5),
        ("force=Iq:A*40000", "Iq", "A", 40000, 0),
    ],
)
def test_a_map_from_the_command_line(text: str, column: str, unit: str, factor: float | None, offset: float) -> None:
    assert parse_map([text]).force == ColumnSource(column=column, unit=unit, factor=factor, offset=offset)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["force"], "not of the form QUANTITY=COLUMN:UNIT"),
        (["force="], "not of the form"),
        (["farce=Load:N"], "'farce' is not a quantity; did you mean force?"),
        (["force=1:N", "force=2:N"], "mapped twice"),
        (["force=Load:N*2*3"], "not of the form UNIT"),
        (["force=Load:N*1.2.3"], "number that cannot be read"),
        (["force=Load:N*0"], "factor of 0"),
    ],
)
def test_a_map_that_is_wrong_is_said_in_one_sentence(texts: list[str], message: str) -> None:
    with pytest.raises(ImportDataError, match=message) as raised:
        parse_map(texts)
    assert "\n" not in str(raised.value)


def test_the_same_map_from_toml() -> None:
    settings = ImportSettings(columns=parse_map(["time=Zeit:ms", "force=3:mV*12.5"]), decimal=",", kind="drag")
    assert ImportSettings.model_validate(tomllib.loads(to_toml(settings))) == settings
    written = tomllib.loads(
        '[columns]\ntime = {column = "Zeit", unit = "ms"}\nforce = {column = "3", unit = "mV", factor = 12.5}'
    )
    assert ImportSettings.model_validate(written).columns == settings.columns


@pytest.mark.parametrize(
    "wrong",
    [
        {"sample_rate_hz": 5, "resample_hz": 5},
        {"from_s": 3, "to_s": 3},
        {"decimal": ",", "delimiter": ","},
        {"sample_rate_hz": 0},
        {"columns": {"force": {"column": "x", "factor": float("nan")}}},
        {"kind": "Drag Test"},
        {"columnz": {}},
    ],
)
def test_settings_that_contradict_themselves_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        ImportSettings.model_validate(wrong)


@pytest.mark.parametrize(
    ("quantity", "unit", "value", "ours"),
    [
        ("time", "ms", 1500, 1.5), ("time", "min", 2, 120), ("time", "µs", 5, 5e-6),
        ("force", "N", 0.25, 250), ("force", "gf", 100, 980.665), ("force", "kgf", 0.001, 9.80665),
        ("force", "mN", 3, 3), ("force", "lbf", 1, 4448.2216152605), ("motor_force", "kN", 1e-3, 1000),
        ("position", "µm", 2500, 2.5), ("position", "m", 0.02, 20), ("command", "in", 1, 25.4),
        ("temperature", "K", 310.15, 37), ("temperature", "°F", 98.6, 37),
    ],
)  # fmt: skip
def test_units_become_ours(quantity: str, unit: str, value: float, ours: float) -> None:
    assert unit_scale(quantity, unit, None, 0.0).apply([value])[0] == pytest.approx(ours, rel=1e-12)


def test_a_factor_calibrates_and_an_offset_comes_last() -> None:
    assert unit_scale("force", "mV", 12.5, -3.0).apply([2.0])[0] == 22
    assert unit_scale("force", "N", -1.0, 1.0).apply([2.0])[0] == -1999
    assert unit_scale("position", "rad", 5.0, 0.0).apply([2.0])[0] == 10


def test_a_unit_that_changes_nothing_keeps_every_bit() -> None:
    assert unit_scale("force", "mN", None, 0.0).apply([-0.0, 0.1]).tolist() == [-0.0, 0.1]


@pytest.mark.parametrize(
    ("quantity", "unit", "message"),
    [
        ("force", "mm", r"force in mm needs a factor, as in force=COLUMN:mm\*12.5.*allowed are mN, N"),
        ("force", "mV", "force in mV needs a factor"),
        ("force", "Nn", "force in 'Nn' is not understood; allowed are mN, N, kN"),
        ("time", "N", "time in N needs a factor"),
    ],
)
def test_a_wrong_unit_is_said_with_what_is_allowed(quantity: str, unit: str, message: str) -> None:
    with pytest.raises(ImportDataError, match=message):
        unit_scale(quantity, unit, None, 0.0)


@pytest.mark.parametrize(
    ("text", "unit"),
    [("microns", "µm"), ("μm", "µm"), ("[N]", "N"), ("(°C)", "degC"), ("sec", "s"), ("MN", None), ("Mn", None),
     ("mPa", None), ("MPa", "MPa"), ("-", "1"), ("foo", None)],
)  # fmt: skip
def test_spellings_of_units(text: str, unit: str | None) -> None:
    assert canonical_unit(text) == unit


@pytest.mark.parametrize(
    ("name", "label", "unit"),
    [
        ("Load [N]", "Load", "N"), ("Time(s)", "Time", "s"), ("Weg / mm", "Weg", "mm"), ("force_mN", "force", "mN"),
        ("Time, s", "Time", "s"), ("speed_mm_s", "speed", "mm/s"), ("Function Activated", "Function Activated", None),
        ("in_situ", "in_situ", None), ("Load (cell 3)", "Load (cell 3)", None),
    ],
)  # fmt: skip
def test_units_in_the_names_of_columns(name: str, label: str, unit: str | None) -> None:
    assert split_unit(name) == (label, unit)
