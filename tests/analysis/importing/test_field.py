"""Text and workbooks as people have them: each file of the field, and siblings of its kind."""

import ctypes
import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import dragrig
from dragrig.analysis import ImportedRun
from dragrig.config.errors import DragrigError, ImportDataError
from dragrig.rig import Run
from places import DATA
from property_tests import examples

FIELD = DATA / "field"
BEGIN = datetime(2026, 5, 4, 9, 15, tzinfo=UTC)
BY_NAME = {"time": "Time", "force": "Force", "position": "Position"}
STATED = {"time": "Time:s", "force": "Force:N", "position": "Position:mm"}
WAVE = {"force": "Force", "position": "Position"}
LVM = {**BY_NAME, "time": "X_Value"}
MACH = {"time": "Time", "force": "Fx", "position": "Position (x)"}


@dataclass(frozen=True)
class Case:
    file: str
    columns: Mapping[str, str]
    options: Mapping[str, object]
    runs: int = 1
    remark: str = ""
    begin: datetime | None = None
    samples: int = 200
    rate_hz: float = 100.0
    force: tuple[float, float] = (50.0, 131.34)
    travel: float = 5.0


CASES = [
    Case("03-tab-empty-column.txt", {"time": "1:s", "force": "2:N", "position": "4:mm"}, {}, remark="'Spare' is empty"),
    Case("04-tab-stated.txt", BY_NAME, {"delimiter": "tab"}, remark="'Remark' is empty"),
    Case("04-tab-stated.txt", BY_NAME, {"delimiter": "\t"}),
    Case("05-thousands-us.csv", BY_NAME, {}, remark="commas part thousands", samples=100,
         force=(900, 1197), travel=1.98),
    Case("06-minutes-seconds.csv", BY_NAME, {}, remark="read as minutes and seconds"),
    Case("06-minutes-seconds-whole.csv", BY_NAME, {}, remark="read as minutes and seconds", rate_hz=1),
    Case("07-clock-of-whole-seconds.csv", BY_NAME, {"sample_rate_hz": 10}, begin=BEGIN, samples=300, rate_hz=10,
         force=(58.41, 133.63), travel=20),
    Case("08-epoch-ns.csv", BY_NAME, {}, remark="integers above 2^53"),
    Case("08-int-above-2p53-unmapped.csv", BY_NAME, {}, remark="integers above 2^53"),
    Case("09-dst-spring.csv", BY_NAME, {}, remark="clocks were changed at row 101"),
    Case("09-dst-fall.csv", BY_NAME, {}, remark="clocks were changed at row 101"),
    Case("11-side-by-side.xlsx", BY_NAME, {}, runs=2),
    Case("11-three-specimens.xlsx", BY_NAME, {}, runs=3, remark="table 'Results' was not read"),
    Case("13-unit-row-unknown-unit.csv", BY_NAME, {}),
    Case("13-toa5.csv", {**BY_NAME, "time": "TIMESTAMP"}, {}, begin=BEGIN),
    Case("14-lvm-one.lvm", LVM, {}, begin=BEGIN.replace(microsecond=500_000)),
    Case("14-lvm-no-x.lvm", {"force": "Force", "position": "Position"}, {}, begin=BEGIN.replace(microsecond=500_000)),
    Case("14-lvm-two-segments.lvm", LVM, {}, runs=2, begin=BEGIN.replace(microsecond=500_000)),
    Case("15-blocks-end-mark.txt", MACH, {}, remark="'<END DATA>'"),
    Case("15-blocks-two.txt", MACH, {}, runs=2),
    Case("16-cycles-time-restarts.csv", BY_NAME, {}, runs=2, remark="the clock begins anew"),
    Case("17-footer.csv", BY_NAME, {},
         remark="3 lines from 203 to 205 are no rows and left out: 'Peak force [N];0.132'"),
    Case("17-footer.xlsx", BY_NAME, {}, remark="line 203 is no rows"),
    Case("17-footer-comment.csv", BY_NAME, {}, remark="'# end of data'"),
    Case("17-comment-inside.csv", BY_NAME, {}, remark="'# operator: second stroke'"),
    Case("18-missing-dashes.csv", BY_NAME, {"missing": "gap"}, remark="1 row without a number left", samples=199),
    Case("18-missing-ovld.csv", BY_NAME, {"missing": "gap"}, remark="1 samples lost", samples=199),
    Case("18-missing-blank.csv", BY_NAME, {"missing": "gap"}, remark="1 samples lost", samples=199),
    Case("19-date-de.csv", BY_NAME, {}, begin=BEGIN),
    Case("19-date-us.csv", BY_NAME, {}, begin=BEGIN),
    Case("19-date-and-time-columns.csv", BY_NAME, {}, begin=BEGIN, remark="'Date' and 'Time' are one clock"),
    Case("19-elapsed-h-mm-ss.csv", BY_NAME, {}),
    Case("19-duration-cells.xlsx", BY_NAME, {}),
    Case("23-epoch-s.csv", {**BY_NAME, "time": "time"}, {}, begin=BEGIN, remark="Unix time in s"),
    Case("23-epoch-s.csv", {**BY_NAME, "time": "time:s"}, {}, begin=BEGIN),
    Case("24-newline-in-header.csv", BY_NAME, {}),
    Case("25-unicode-minus.csv", BY_NAME, {}, force=(-50.0, -131.34)),
    Case("27-map-against-stated-unit.csv", {"time": "Time:s", "force": "Force:N", "position": "Position:mm"}, {},
         remark="'Force [kN]' states kN, the map N: the map counts"),
    Case("29-micros-rollover.csv", {**BY_NAME, "time": "micros:us"}, {}, remark="a counter of 32 bits"),
    Case("30-fixed-width-names.txt", BY_NAME, {}),
    Case("30-preamble-with-numbers.csv", {"time": "Time", "force": "Force"}, {}, travel=np.nan),
    Case("31-one-column.xlsx", BY_NAME, {}),
    Case("02-tdms-ai-and-counter-groups.tdms", WAVE, {}, begin=BEGIN),
    Case("02-tdms-start-time.tdms", WAVE, {}, begin=BEGIN.replace(microsecond=500_000), samples=150,
         remark="150 common rows", force=(130.43, 131.34)),
    Case("02-tdms-start-offset.tdms", WAVE, {}, begin=BEGIN.replace(microsecond=500_000), samples=150,
         force=(130.43, 131.34)),
    Case("11-two-groups.tdms", {"force": "Force:N", "position": "Position:mm"}, {"sample_rate_hz": 100}, runs=2),
    Case("11-two-trials.mat", STATED, {}, runs=2),
    Case("20-timestamps.parquet", BY_NAME, {}, begin=BEGIN),
    Case("20-pandas-index.parquet", {**BY_NAME, "time": "__index_level_0__"}, {}, begin=BEGIN),
    Case("20-iso-text.parquet", BY_NAME, {}, begin=BEGIN),
    Case("20-decimal.parquet", BY_NAME, {}),
    Case("20-datetime64.npz", {**STATED, "time": "Time"}, {}, begin=BEGIN),
    Case("20-timestamps.tdms", BY_NAME, {}, begin=BEGIN),
    Case("21-pandas-default.json", STATED, {}),
    Case("21-lines.jsonl", STATED, {}),
    Case("22-record-array.npz", STATED, {}),
    Case("22-struct-array.mat", STATED, {}, runs=2),
    # 740107.385 is the fifth of May, since datenum(2000, 1, 1) is 730486.
    Case("23-datenum.mat", {**STATED, "time": "Time"}, {}, begin=BEGIN.replace(day=5), remark="MATLAB datenum"),
    Case("23-epoch-ms.json", {**STATED, "time": "ts"}, {}, begin=BEGIN, remark="Unix time in ms"),
    Case("31-packed.csv.gz", BY_NAME, {}),
    Case("31-tab-text.xls", BY_NAME, {}),
    Case("31-workbook.csv", BY_NAME, {}),
]  # fmt: skip


def told(run: ImportedRun) -> str:
    return "\n".join(event.message for event in run.events)


@pytest.fixture(autouse=True)
def in_utc(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TZ", "UTC")
    if sys.platform == "win32":
        ctypes.CDLL("ucrtbase")._tzset()
    else:
        time.tzset()


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.file)
def test_files_of_the_field_become_the_runs_that_they_are(tmp_path: Path, case: Case) -> None:
    imported = dragrig.import_runs(FIELD / case.file, tmp_path, case.columns, **case.options)
    assert len(imported) == case.runs
    assert case.remark in told(imported[0])
    run = dragrig.load(imported[0].path)
    assert len(run.trace.force) == case.samples
    assert run.info.header.sample_rate_hz == pytest.approx(case.rate_hz, rel=1e-9)
    # Some files of the field have more digits than the table that tells what is right.
    np.testing.assert_allclose(run.trace.force[[0, -1]], case.force, atol=0.01)
    np.testing.assert_allclose(run.trace.position[[0, -1]], np.array([0, 1]) * case.travel, atol=1e-3)
    if case.begin is not None:
        assert run.info.header.start_time == case.begin
    if case.runs > 1 and not case.file.startswith("15"):
        assert dragrig.load(imported[1].path).trace.force[0] in (pytest.approx(50), pytest.approx(100))


@pytest.mark.parametrize(
    ("file", "columns", "options", "message"),
    [
        ("10-NM-torque.csv", {**BY_NAME, "force": "Torque"}, {}, "may be Nm or nm"),
        ("10-NM-position.csv", BY_NAME, {}, "may be Nm or nm"),
        ("18-missing-ovld.csv", BY_NAME, {}, "line 52, column 'Force [N]' holds 'OVLD'.*--missing gap"),
        ("18-missing-blank.csv", BY_NAME, {}, "line 52, column 'Force [N]' has no number.*--missing gap"),
        ("07-clock-of-whole-seconds.csv", BY_NAME, {}, "several rows have the time 0 s.*state sample_rate_hz"),
        ("03-tab-empty-column.txt", BY_NAME, {"delimiter": "colon"}, "delimiter"),
        ("15-blocks-two.txt", MACH, {"table": "block 3"}, "there is no table 'block 3'; did you mean block"),
    ],
)
def test_questions_of_the_field_are_asked_in_one_sentence(
    tmp_path: Path, file: str, columns: Mapping[str, str], options: Mapping[str, object], message: str
) -> None:
    with pytest.raises(DragrigError, match=message.replace("[", r"\[").replace("]", r"\]")) as raised:
        dragrig.import_runs(FIELD / file, tmp_path, columns, **options)
    assert "\n" not in str(raised.value)
    assert not list(tmp_path.iterdir())


def test_a_clock_of_whole_seconds_is_averaged_second_by_second(tmp_path: Path) -> None:
    source = FIELD / "07-clock-of-whole-seconds.csv"
    run = dragrig.load(dragrig.import_run(source, tmp_path, BY_NAME, resample_hz=1).path)
    rows = np.loadtxt(source, delimiter=",", skiprows=1, usecols=1)
    stamps = np.array([line.split(",")[0][-2:] for line in source.read_text().splitlines()[1:]]).astype(int)
    np.testing.assert_allclose(
        run.trace.force, [1e3 * rows[stamps == second].mean() for second in range(30)], rtol=1e-9
    )


def test_a_block_among_several_can_be_named(tmp_path: Path) -> None:
    run = dragrig.import_run(FIELD / "15-blocks-two.txt", tmp_path, MACH, table="block 2")
    assert "Velocity, mm/s:\t10" in dragrig.load(run.path).info.header.entry["import_preamble"]


FORCE = [50.0 + 0.25 * k for k in range(120)]


def lines(
    stamp: "Sequence[str] | None" = None, mark: str = ";", head: str = "Time [s];Force [N];Position [mm]"
) -> list[str]:
    stamps = stamp or [f"{k / 100:.2f}" for k in range(120)]
    rows = [mark.join((stamps[k], f"{FORCE[k] / 1000:.5f}", f"{k / 50:.2f}")) for k in range(120)]
    return [head.replace(";", mark), *rows] if head else rows


def read(
    folder: Path, text: "str | Sequence[str]", columns: Mapping[str, str] = BY_NAME, **options: object
) -> list[Run]:
    source = folder / "sibling.csv"
    source.write_text(text if isinstance(text, str) else "\n".join(text), encoding="utf-8")
    out = folder / "runs"
    out.mkdir(exist_ok=True)
    return [dragrig.load(run.path) for run in dragrig.import_runs(source, out, columns, **options)]


def stamps_of(form: str) -> list[str]:
    return [form.format(f"{k / 100:05.2f}") for k in range(120)]


@pytest.mark.parametrize(
    ("form", "begin"),
    [
        ("2026-05-04T09:15:{}Z", BEGIN),
        ("2026-05-04 11:15:{}+02:00", BEGIN),
        ("2026/05/04 09:15:{}", BEGIN),
        ("2026-05-04 09:15:{} UTC", BEGIN),
        ("04.05.26 09:15:{}", BEGIN),
        ("4.5.2026 9:15:{}", BEGIN),
        ("04-May-2026 09:15:{}", BEGIN),
        ("04-Jun-2026 09:15:{}", BEGIN.replace(month=6)),
        ("05/14/2026 09:15:{}", BEGIN.replace(day=14)),
        ("14/05/2026 09:15:{}", BEGIN.replace(day=14)),
        ("5/4/2026 9:15:{} AM", BEGIN),
        ("5/4/2026 9:15:{} PM", BEGIN.replace(hour=21)),
        ("5/4/2026 12:15:{} a.m.", BEGIN.replace(hour=0)),
    ],
)
def test_dates_of_many_countries_are_one_moment(tmp_path: Path, form: str, begin: datetime) -> None:
    (run,) = read(tmp_path, lines(stamps_of(form), head="Time;Force [N];Position [mm]"))
    assert run.info.header.start_time == begin
    np.testing.assert_allclose(run.trace.time, np.arange(120) / 100)


def test_a_date_that_leaves_day_and_month_open_is_no_date(tmp_path: Path) -> None:
    (run,) = read(tmp_path, lines(stamps_of("05/04/2026 09:15:{}"), head="Time;Force [N];Position [mm]"))
    assert run.info.header.start_time != BEGIN
    assert any("may have day or month first" in event.message for event in run.events)


@pytest.mark.parametrize("form", ["{}", "9:15:{} PM", "0 days 00:00:{}", "30:59:{}", "15:{}"])
def test_times_without_a_date_are_elapsed_times(tmp_path: Path, form: str) -> None:
    stamps = [form.format(f"{k / 100:05.2f}") for k in range(120)]
    (run,) = read(tmp_path, lines(stamps, head="Time;Force [N];Position [mm]"), {**BY_NAME, "time": "1:s"})
    np.testing.assert_allclose(run.trace.time, np.arange(120) / 100)


def test_a_clock_goes_on_over_midnight(tmp_path: Path) -> None:
    stamps = [f"23:59:{59 + k / 100:05.2f}" if k < 100 else f"00:00:{(k - 100) / 100:05.2f}" for k in range(120)]
    (run,) = read(tmp_path, lines(stamps, head="Time;Force [N];Position [mm]"))
    np.testing.assert_allclose(run.trace.time, np.arange(120) / 100)


@pytest.mark.parametrize(
    ("first", "step", "unit", "remark"),
    [
        (1_777_886_100, 0.01, "", "Unix time in s"),
        (1_777_886_100_000, 10, "", "Unix time in ms"),
        (1_777_886_100_000_000, 10_000, "", "Unix time in µs"),
        (1_777_886_100_000_000_000, 10_000_000, "", "Unix time in ns"),
        (3_860_730_900, 0.01, "s", "LabVIEW time in s"),
        (740_106.385416666664, 0.01 / 86_400, "", "MATLAB datenum in d"),
        (46_146.385416666664, 0.01 / 86_400, "d", "serial date of a spreadsheet in d"),
    ],
)
def test_counts_since_a_fixed_moment_are_dates(
    tmp_path: Path, first: float, step: float, unit: str, remark: str
) -> None:
    stamps = [f"{first + k * step:.11f}" if isinstance(step, float) else str(first + k * step) for k in range(120)]
    (run,) = read(tmp_path, lines(stamps, head="t;Force [N];Position [mm]"), {**BY_NAME, "time": f"t:{unit}"})
    assert abs((run.info.header.start_time - BEGIN).total_seconds()) < 1e-4
    assert run.info.header.sample_rate_hz == pytest.approx(100)
    assert any(remark in event.message for event in run.events)


def test_an_elapsed_time_is_no_date_and_days_need_their_unit(tmp_path: Path) -> None:
    days = lines([f"{46_146.4 + k / 8_640_000:.10f}" for k in range(120)], head="t;Force [N];Position [mm]")
    with pytest.raises(ImportDataError, match="does not state its unit"):
        read(tmp_path, days, {**BY_NAME, "time": "t"})
    milliseconds = lines([str(1_777_886_100_000 + 10 * k) for k in range(120)], head="t;Force [N];Position [mm]")
    with pytest.raises(ImportDataError, match="is not in s: time is Unix time in ms"):
        read(tmp_path, milliseconds, {**BY_NAME, "time": "t:s"})


@given(bits=st.sampled_from([16, 24, 32]), start=st.integers(0, 2**32), step=st.integers(1, 300), signed=st.booleans())
@settings(max_examples=examples(40), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_counter_goes_on_over_its_wraps(tmp_path: Path, bits: int, start: int, step: int, signed: bool) -> None:
    from dragrig.analysis.importing.clocks import unwrapped

    true = start % 2**bits + step * np.arange(400)
    counted = (true + 2 ** (bits - 1)) % 2**bits - 2 ** (bits - 1) if signed else true % 2**bits
    values, remark = unwrapped(counted.astype(np.float64))
    assert np.array_equal(np.diff(values), np.full(399, float(step)))
    assert bool(remark) == bool((np.diff(counted) < 0).any())


@pytest.mark.parametrize("restart", [50, 40])
def test_a_clock_that_begins_anew_is_no_counter_that_wraps(tmp_path: Path, restart: int) -> None:
    stamps = [f"{(k % restart) * 10}" for k in range(120)]
    runs = read(tmp_path, lines(stamps, head="t [ms];Force [N];Position [mm]"), {**BY_NAME, "time": "t"})
    assert [len(run.trace.force) for run in runs] == ([50, 50, 20] if restart == 50 else [40, 40, 40])
    assert [run.info.header.order for run in runs] == [0, 1, 2]


@pytest.mark.parametrize(
    ("parted", "remark"), [("1,050.5", ""), ("1.050,5", ""), ("1'050.5", ""), ("1\u202f050,5", ""), ("1 050,5", "")]
)
def test_marks_of_thousands_are_known_by_the_whole_column(tmp_path: Path, parted: str, remark: str) -> None:
    thousands, decimal = parted[1], parted[5]
    force = [950.5 + k for k in range(120)]
    cells = [f"{value:,.1f}".replace(",", "T").replace(".", decimal).replace("T", thousands) for value in force]
    rows = [f"{k / 100:.2f}".replace(".", decimal) + f";{cell}" for k, cell in enumerate(cells)]
    (run,) = read(tmp_path, ["Time [s];Force [mN]", *rows], {"time": "Time", "force": "Force"})
    assert run.trace.force.tolist() == force


def test_a_mark_that_may_be_either_is_asked_about_and_taken_as_stated(tmp_path: Path) -> None:
    table = ["Time [s];Force [mN]", *(f"{k};{996 + k:,}" for k in range(10))]
    columns = {"time": "Time", "force": "Force"}
    with pytest.raises(ImportDataError, match="may be the decimal mark or part thousands, in 6 cells"):
        read(tmp_path, table, columns)
    assert read(tmp_path, table, columns, decimal=".")[0].trace.force[-1] == 1005
    assert read(tmp_path, table, columns, decimal=",")[0].trace.force[-1] == pytest.approx(1.005)


def test_three_decimals_in_every_cell_are_no_thousands(tmp_path: Path) -> None:
    table = ["Time [s];Force [mN]", *(f"{1 + k / 1000:.3f};{2 + k / 100:.3f}".replace(".", ",") for k in range(100))]
    (run,) = read(tmp_path, table, {"time": "Time", "force": "Force"})
    assert run.trace.force[0] == 2
    assert run.info.header.sample_rate_hz == pytest.approx(1000)


@pytest.mark.parametrize(
    "between",
    [
        ["", "Step,2", "Time [s];Force [N];Position [mm]"],
        ["[Cycle 2]"],
        ["", "Time;Force;Position", "s;N;mm"],
        ["<END>", "<MOVE 2>", "Time [s];Force [N];Position [mm]"],
    ],
)
def test_what_stands_before_a_block_and_again_begins_another(tmp_path: Path, between: list[str]) -> None:
    runs = read(tmp_path, ["[Cycle 1]", *lines(), *between, *lines(head="")])
    assert [len(run.trace.force) for run in runs] == [120, 120]
    assert all(run.trace.force[0] == pytest.approx(50) for run in runs)


def test_lines_among_rows_are_left_out_and_named(tmp_path: Path) -> None:
    table = lines()
    (run,) = read(tmp_path, [*table[:60], "operator: paused", *table[60:], "", "Statistics;Force;Position", "Max;79;2"])
    (remark,) = (event.message for event in run.events if "no rows" in event.message)
    assert "'operator: paused'" in remark
    assert "'Max;79;2'" in remark
    assert len(run.trace.force) == 120


def test_a_row_of_another_width_is_refused_within_and_told_at_the_end(tmp_path: Path) -> None:
    table = lines()
    with pytest.raises(ImportDataError, match="line 61 has 2 cells where the first row has 3"):
        read(tmp_path, [*table[:60], "0.595;0.1", *table[60:]])
    (run,) = read(tmp_path, [*table, "1.20;0.0"])
    assert any("'1.20;0.0'" in event.message for event in run.events)


def test_a_table_of_another_shape_is_named(tmp_path: Path) -> None:
    other = ["", "Temperature log", "Time [s];T [C]", *(f"{k};37.0" for k in range(20))]
    (run,) = read(tmp_path, [*lines(), *other])
    assert any("was not read (2 columns, 20 rows" in event.message for event in run.events)


@pytest.mark.parametrize("count_from", [0, 1])
def test_a_heading_without_a_name_for_the_row_numbers_is_placed_right(tmp_path: Path, count_from: int) -> None:
    table = ["Time,Force,Position", *(f"{k + count_from},{row}" for k, row in enumerate(lines(mark=",", head="")))]
    (run,) = read(tmp_path, table, {"time": "Time:s", "force": "Force:N", "position": "Position:mm"})
    np.testing.assert_allclose(run.trace.force, FORCE)


def test_a_heading_that_cannot_be_placed_is_refused(tmp_path: Path) -> None:
    table = ["Time;Force;Position", *(f"{row};{k % 7}" for k, row in enumerate(lines(head="")))]
    with pytest.raises(ImportDataError, match="3 names for 4 columns"):
        read(tmp_path, table)


def test_names_that_occur_twice_are_asked_about(tmp_path: Path) -> None:
    table = lines(head="Time [s];Force [N];Force [N]")
    with pytest.raises(ImportDataError, match=r"could be 'Force \[N\]' \(number 2\) or 'Force \[N\]' \(number 3\)"):
        read(tmp_path, table, {"time": "Time", "force": "Force"})
    (run,) = read(tmp_path, table, {"time": "Time", "force": "2"})
    np.testing.assert_allclose(run.trace.force, FORCE)


def test_cells_with_their_unit_are_numbers(tmp_path: Path) -> None:
    rows = [f"{k / 100:.2f} s;{FORCE[k] / 1000:.5f} N;{k / 50:.2f} mm" for k in range(120)]
    (run,) = read(tmp_path, ["Time;Force;Position", *rows])
    np.testing.assert_allclose(run.trace.force, FORCE)


def test_an_encoder_that_wraps_goes_on(tmp_path: Path) -> None:
    rows = [f"{k / 100:.2f};{FORCE[k] / 1000:.5f};{(65_000 + 10 * k) % 65_536}" for k in range(120)]
    (run,) = read(tmp_path, ["Time [s];Force [N];Encoder", *rows], {**BY_NAME, "position": "Encoder:counts*0.001"})
    np.testing.assert_allclose(run.trace.position, np.arange(120) / 100, atol=1e-9)


@pytest.mark.parametrize(
    ("unit", "turn", "low"), [("deg", 360, 0), ("deg", 360, -180), ("rad", 2 * np.pi, 0), ("rev", 1, 0)]
)
def test_an_angle_goes_on_from_turn_to_turn_there_and_back(tmp_path: Path, unit: str, turn: float, low: float) -> None:
    angle = turn * np.concatenate((np.linspace(0.3, 2.7, 60), np.linspace(2.7, 0.4, 60)))
    shown = [f"{k / 100:.2f};{FORCE[k] / 1000:.5f};{(a - low) % turn + low:.3f}" for k, a in enumerate(angle)]
    columns = {**BY_NAME, "position": f"Angle:{unit}"}
    (run,) = read(tmp_path, ["Time [s];Force [N];Angle", *shown], columns, radius_mm=10.0)
    np.testing.assert_allclose(run.trace.position, (angle - angle[0]) * 2 * np.pi / turn * 10, atol=0.07)
    assert any("an angle is continued over" in event.message for event in run.events)


def test_rows_without_a_number_keep_their_place_at_a_stated_rate(tmp_path: Path) -> None:
    rows = ["OVLD;0" if k in {40, 41} else f"{FORCE[k] / 1000:.5f};{k / 50:.2f}" for k in range(120)]
    (run,) = read(
        tmp_path, ["Force [N];Position [mm]", *rows], {"force": "Force", "position": "Position"},
        sample_rate_hz=100, missing="gap",
    )  # fmt: skip
    assert run.trace.time[40] == pytest.approx(0.42)


def test_one_run_is_asked_for_where_a_file_holds_several(tmp_path: Path) -> None:
    with pytest.raises(ImportDataError, match=r"holds 2 runs .*'block 1', 'block 2'"):
        dragrig.import_run(FIELD / "15-blocks-two.txt", tmp_path, MACH)


def force_of(
    table: str | Sequence[str], tmp_path: Path, columns: Mapping[str, str] = BY_NAME, **options: object
) -> Run:
    """Import a table of the usual trace, and check that it is this, but for the samples of a gap."""
    (run,) = read(tmp_path, table, columns, **options)
    places = np.rint(run.trace.time * 100).astype(int)
    np.testing.assert_allclose(run.trace.force, np.array(FORCE)[places], rtol=1e-9)
    np.testing.assert_allclose(run.trace.position, places / 50, atol=1e-9)
    return run


def with_row(place: int, row: str) -> list[str]:
    table = lines()
    table[place] = row
    return table


@pytest.mark.parametrize(
    ("table", "samples"),
    [
        (with_row(41, "---;---;---"), 119),
        (with_row(41, "0.40;inf;0.80"), 119),
        (with_row(41, "0.40;9.90E+37;0.80"), 119),
        (with_row(41, "0.40;0.06;0.80;touched, 2 mm"), 120),
        ([*lines(), "", "Peak [N];At [s];At [mm]", "0.079;1.19;2.38"], 120),
        (["MTS793|MPT|ENU|1|2|.|/|:|1|0|0|A", "", *lines(mark="\t")], 120),
        (["Time;Force;Position", "----;-----;--------", "s;N;mm", *lines(head="")], 120),
        ([line if k else "Time [s];Force [N];Position [mm]" for k, line in enumerate(
            line.replace(".", ",", 1) for line in lines())], 120),
        ([f"{line};inf" if k == 9 else f"{line};Aux" if not k else f"{line};1" for k, line in enumerate(lines())], 120),
        ([f"{line};Unix [s]" if not k else f"{line};{1_777_886_100 + k}" for k, line in enumerate(lines())], 120),
        ([f"{'Source;CH1' if k == 5 else 'Length;2' if k < 20 else ';'};;{row}" for k, row in enumerate(lines())], 120),
    ],
    ids=["row-of-marks", "infinite", "scpi-overload", "comment-behind", "results-below", "other-mark-above", "ruled",
         "mark-by-column", "infinite-beside", "unix-beside", "preamble-beside"],
)  # fmt: skip
def test_siblings_of_the_field_are_the_trace_that_they_hold(tmp_path: Path, table: list[str], samples: int) -> None:
    numbered = {"time": "4:s", "force": "5:N", "position": "6:mm"}
    columns = {"time": "1:s", "force": "2:N", "position": "3:mm"} if len(table[-1].split(";")) != 6 else numbered
    assert len(force_of(table, tmp_path, columns, missing="gap").trace.force) == samples


@pytest.mark.parametrize(
    ("table", "remark"),
    [
        (with_row(41, "0.40;0.06;0.80;touched, 2 mm"), "rows with text behind, 1: line 42 'touched, 2 mm'"),
        ([*lines(), "", "Peak [N];At [s];At [mm]", "0.079;1.19;2.38"], "'0.079;1.19;2.38'"),
        ([f"{line};Unix [s]" if not k else f"{line};{1_777_886_100 + k}" for k, line in enumerate(lines())],
         "too much for s: stored without a unit"),
    ],
)  # fmt: skip
def test_what_stands_beside_and_below_rows_is_told(tmp_path: Path, table: list[str], remark: str) -> None:
    (run,) = read(tmp_path, table)
    assert any(remark in event.message for event in run.events)


def test_a_sign_behind_the_number_is_its_sign(tmp_path: Path) -> None:
    table = ["Time [s];Force [N]", *(f"{k / 100:.2f};{FORCE[k] / 1000:.5f}-" for k in range(120))]
    (run,) = read(tmp_path, table, {"time": "Time", "force": "Force:N"})
    np.testing.assert_allclose(run.trace.force, -np.array(FORCE))


@pytest.mark.parametrize("mark", [",", "."])
def test_thousands_that_nothing_tells_from_decimals_are_asked_about(tmp_path: Path, mark: str) -> None:
    table = ["Time [s];Force [mN]", *(f"{k};{1000 + k:,}".replace(",", mark) for k in range(60))]
    columns = {"time": "Time", "force": "Force"}
    with pytest.raises(ImportDataError, match="may be the decimal mark or part thousands, in 60 cells"):
        read(tmp_path, table, columns)
    assert read(tmp_path, table, columns, decimal=mark)[0].trace.force[-1] == pytest.approx(1.059)
    assert read(tmp_path, table, columns, decimal=".,".replace(mark, ""))[0].trace.force[-1] == 1059


@pytest.mark.parametrize(
    ("stamps", "runs"),
    [
        ([f"{0.37 * (k >= 60) + k % 60 / 100:.2f}" for k in range(120)], [60, 60]),
        ([f"{(k - 30 * (k >= 60)) / 100:.2f}" for k in range(120)], [60, 60]),
        ([f"{(k + 3570) // 60 % 60:02}:{(k + 3570) % 60:02}" for k in range(120)], [120]),
        ([f"09:15:{k // 100:02}:{k % 100 * 10:03}" for k in range(120)], [120]),
        ([f"{k / 600:.4f} min" for k in range(120)], [120]),
    ],
)
def test_clocks_begin_anew_anywhere_or_go_on(tmp_path: Path, stamps: list[str], runs: list[int]) -> None:
    imported = read(tmp_path, lines(stamps), {**BY_NAME, "time": "1"})
    assert [len(run.trace.force) for run in imported] == runs
    rate_hz = imported[0].info.header.sample_rate_hz
    assert min(abs(rate_hz / known - 1) for known in (1, 10, 100)) < 1e-9


@pytest.mark.parametrize("last", ["0.50;0.079;2.38", "1.18;0.079;2.38"])
def test_a_single_row_that_goes_back_is_no_recording(tmp_path: Path, last: str) -> None:
    with pytest.raises(ImportDataError, match="time goes back at line 122"):
        read(tmp_path, [*lines(), last])
    falling = lines([f"{-k / 100:.2f}" for k in range(120)])
    with pytest.raises(ImportDataError, match="time goes back at line 3"):
        read(tmp_path, falling)


def test_a_day_that_is_written_once_holds_for_the_rows_below_it(tmp_path: Path) -> None:
    stamps = [f"{'2026-05-04' if k == 0 else ''};09:15:{k / 100:05.2f}" for k in range(120)]
    run = force_of(lines(stamps, head="Date;Time;Force [N];Position [mm]"), tmp_path)
    assert run.info.header.start_time == BEGIN


def test_units_above_the_first_of_equal_headings_hold_for_all(tmp_path: Path) -> None:
    block = ["Time;Force;Position", *lines(head="")]
    runs = read(tmp_path, [block[0], "s;N;mm", *block[1:], *block])
    assert [run.trace.force[-1] for run in runs] == [pytest.approx(FORCE[-1])] * 2


def test_a_count_of_unix_time_with_a_hole_is_a_date(tmp_path: Path) -> None:
    stamps = ["" if k == 40 else str(1_777_886_100_000 + 10 * k) for k in range(120)]
    table = lines(stamps, head="t;Force [N];Position [mm]")
    assert force_of(table, tmp_path, {**BY_NAME, "time": "t"}, missing="gap").info.header.start_time == BEGIN


def test_zeros_behind_a_text_are_no_part_of_it(tmp_path: Path) -> None:
    force_of("\n".join(lines()) + "\n" + "\0" * 512, tmp_path)
    with pytest.raises(ImportDataError, match="line 3 holds a NUL byte"):
        read(tmp_path, "\n".join(lines()).replace("0.01;", "0.01\0;", 1))


def test_a_quote_that_joins_lines_is_refused(tmp_path: Path) -> None:
    table = lines()
    table[7] = f'"{table[7]}'
    table[60] = table[60].replace(";", '";', 1)
    with pytest.raises(ImportDataError, match="quotes that do not match"):
        read(tmp_path, table)


def test_a_stamp_far_from_the_others_is_not_filled_up_to(tmp_path: Path) -> None:
    with pytest.raises(ImportDataError, match=r"would make 9e\+07 samples of 120 rows.*line 121"):
        read(tmp_path, with_row(120, "9000000;0.079;2.38"), resample_hz=10)


def test_an_ordinal_is_a_name(tmp_path: Path) -> None:
    force_of(["1st;Force;Position", *lines(head="")], tmp_path, {**STATED, "time": "1st:s"})


def test_channels_in_nodes_of_their_own_are_a_table(tmp_path: Path) -> None:
    data = {
        "t": [k / 100 for k in range(120)],
        "F": [value / 1000 for value in FORCE],
        "x": [k / 50 for k in range(120)],
    }
    columns = {"time": "t:s", "force": "F:N", "position": "x:mm"}
    units = {"t": "s", "F": "N", "x": "mm"}
    listed = [{"name": name, "unit": units[name], "data": cells} for name, cells in data.items()]
    below = {"t": data["t"], "F": {"values": data["F"], "n": 1}, "x": {"values": data["x"], "n": 1}}
    force_of(json.dumps({"channels": listed}), tmp_path, {name: column[0] for name, column in columns.items()})
    (tmp_path / "runs").rename(tmp_path / "first")
    force_of(json.dumps(below), tmp_path, columns)


def test_thousands_parted_by_blanks_do_not_part_the_columns_of_a_tab_table(tmp_path: Path) -> None:
    rows = [f"{k / 100:.2f}\t{950 + k:,}\t{k}".replace(",", " ") for k in range(120)]
    (run,) = read(
        tmp_path, ["Time [s]\tForce [mN]\tPosition [mm]", *rows], {"time": "1", "force": "2", "position": "3"}
    )
    assert run.trace.force.tolist() == [950 + k for k in range(120)]


def test_a_remark_that_comes_twice_among_the_rows_begins_no_table(tmp_path: Path) -> None:
    table = lines()
    runs = read(tmp_path, [*table[:40], "paused", *table[40:80], "paused", *table[80:]])
    assert [len(run.trace.force) for run in runs] == [120]


def test_columns_that_have_numbers_in_no_common_row_are_refused(tmp_path: Path) -> None:
    rows = [f"{k / 100};{'' if k % 2 else 1.5};{k if k % 2 else ''}" for k in range(50)]
    with pytest.raises(ImportDataError, match="no row has a number in all mapped columns"):
        read(tmp_path, ["Time [s];Force [N];Position [mm]", *rows], missing="gap")


@pytest.mark.parametrize("day", ["14-05-2026", "14/05/2026", "14.05.2026", "2026-05-14"])
def test_a_day_in_any_form_completes_the_times_beside_it(tmp_path: Path, day: str) -> None:
    stamps = [f"{day};09:15:{k / 100:05.2f}" for k in range(120)]
    (run,) = read(tmp_path, lines(stamps, head="Date;Time;Force [N];Position [mm]"))
    assert run.info.header.start_time == BEGIN.replace(day=14)
