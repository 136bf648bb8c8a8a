"""`dragrig import`: from an instrument's text to a run file, and what cannot be."""

import json
import zipfile
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dragrig
from dragrig.analysis.models.experiment import Experiment
from dragrig.cli import main
from dragrig.config.errors import AnalysisError
from dragrig.rig.protocols.kinds import DragProtocol

DRAG = {"speed_mm_s": 2, "travel_mm": 4, "accel_mm_s2": 400, "rest_s": 0, "hold_s": 0}
KNOWN = ("--kind", "drag", *(word for key, value in DRAG.items() for word in ("--set", f"{key}={value}")))
MAP = ("--map", "time=1:s", "--map", "position=Weg:µm", "--map", "force=Kraft:N")


class Importer:
    """Calls `dragrig import` in a folder of its own."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *words: str, code: int = 0) -> Any:
        got = main(["import", *words])
        output = self._capsys.readouterr()
        assert got == code, output.err
        return output


@pytest.fixture
def importer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Importer:
    monkeypatch.chdir(tmp_path)
    return Importer(capsys)


def german(path: str, encoding: str = "cp1252", spoil: str = "") -> None:
    rows = [f"{0.01 * k:.2f};{20 * k};{0.1 + 0.001 * k:.4f}".replace(".", ",") for k in range(200)]
    if spoil:
        rows[100] = spoil
    Path(path).write_bytes("\r\n".join(["Zeit [s];Weg [µm];Kraft [N]", *rows, ""]).encode(encoding))


@pytest.mark.parametrize("encoding", ["cp1252", "utf-8-sig", "utf-16"])
def test_an_instruments_text_becomes_a_run(importer: Importer, encoding: str) -> None:
    german("a.csv", encoding)
    (done,) = json.loads(importer("a.csv", *MAP, *KNOWN, "--json").out)
    run = dragrig.load(done["file"])
    assert (run.info.kind, run.info.header.backend) == ("drag", "external")
    assert run.info.header.protocol["speed_mm_s"] == 2
    assert done["sample_rate_hz"] == pytest.approx(100)
    assert run.trace.force[:3] == pytest.approx([100, 101, 102])
    assert run.trace.position[:3] == pytest.approx([0, 0.02, 0.04])


def test_several_files_follow_each_other(importer: Importer) -> None:
    for name in ("a.csv", "b.csv"):
        german(name)
    importer("*.csv", *MAP, "--out", "c")
    importer("a.csv", *MAP, "--out", "c")
    runs = dragrig.campaign("c").runs
    assert sorted(run.header.order for run in runs) == [0, 1, 2]
    assert {run.header.entry["import_source"] for run in runs} == {"a.csv", "b.csv"}


def test_settings_that_come_again_stand_in_a_file(importer: Importer) -> None:
    german("a.csv")
    Path("map.toml").write_text(
        'kind = "drag"\n[columns]\ntime = {column = 1}\nforce = {column = "Kraft", unit = "N"}\n', "utf-8"
    )
    importer("a.csv", "--settings", "map.toml", "--kind", "return", "--out", "c")
    (info,) = dragrig.campaign("c").runs
    assert info.kind == "return"
    imported = dragrig.import_run("a.csv", "c", {"time": "1:s", "force": "Kraft:N"})
    assert dragrig.load(imported.path).info.header.order == 1


def pull(path: str, speed_mm_s: float = 5.0) -> None:
    """A drag of 20 mm between rests of a second, as an instrument without a command writes it."""
    time = np.arange(0.0, 2.0 + 20.0 / speed_mm_s, 0.001)
    position = np.clip(speed_mm_s * (time - 1.0), 0.0, 20.0)
    force = 0.03 + 0.08 * np.clip(position / 5.0, 0, 1) + 0.001 * np.sin(7000 * time)
    np.savetxt(path, np.c_[time, force, position], "%.6f", ",", header="t [s],Load [N],Pos [mm]", comments="")


PULL = ("--map", "time=1:s", "--map", "force=2:N", "--map", "position=3:mm", "--kind", "drag")


def test_a_measurement_with_capsule_and_wall_is_one_for_the_capsule_model(importer: Importer) -> None:
    pull("a.csv")
    importer("a.csv", *PULL, "--out", "bare")
    importer("a.csv", *PULL, "--out", "c", "--capsule", "drag", "--wall-thickness-mm", "2.1", "--specimen", "P7")
    (bare,) = (Experiment(dragrig.load(run.path)) for run in dragrig.campaign("bare").runs)
    with pytest.raises(AnalysisError, match=r"capsule \(diameter_mm, .*\), its wall's thickness, its fixture; import"):
        _ = bare.capsule
    (run,) = (Experiment(dragrig.load(run.path)) for run in dragrig.campaign("c").runs)
    assert (run.capsule.diameter_mm, run.wall_thickness_mm, run.fixture.value) == (12.9, 2.1, "foam")
    protocol = run.run.info.header.protocol
    assert (protocol["speed_mm_s"], protocol["travel_mm"]) == (5.0, pytest.approx(20.0))
    assert protocol["rest_s"] == pytest.approx(1.0, abs=0.05)
    assert any("speed_mm_s = 5" in event.message for event in run.run.events)


@pytest.mark.parametrize(
    ("first", "begins"),
    [
        ("2026-05-04T09:15:00.{:03d}", "2026-05-04T09:15:00"),
        ("2026-05-04 09:15:00.{:03d}+02:00", "2026-05-04T09:15:00+02:00"),
        ("23:59:00.{:03d}", ""),
    ],
)
def test_dates_and_times_of_day_are_a_clock(importer: Importer, first: str, begins: str) -> None:
    rows = [f"{first.format(k * 10)},{0.1 * k:.1f},0.{k}" for k in range(50)]
    Path("a.csv").write_text("\n".join(["Time,Load [N],Pos [mm]", *rows]), "utf-8")
    importer("a.csv", "--map", "time=1", "--map", "force=2:N", "--map", "position=3:mm", "--out", "c")
    (info,) = dragrig.campaign("c").runs
    assert info.header.sample_rate_hz == pytest.approx(100)
    assert ("start_time_unknown" in info.header.entry) == (not begins)
    if begins:
        assert info.header.start_time == datetime.fromisoformat(begins).astimezone()


@pytest.mark.parametrize("first", [",,", "0.00,,0.0", "0.00,,"])
def test_blanks_in_a_first_row_are_left_out_and_told(importer: Importer, first: str) -> None:
    rows = [f"{0.01 * k:.2f},{0.1 * k:.1f},0.{k}" for k in range(1, 50)]
    Path("a.csv").write_text("\n".join(["t [s],Load [N],Pos [mm]", first, *rows]), "utf-8")
    importer("a.csv", "--map", "time=t", "--map", "force=Load", "--map", "position=Pos", "--out", "c")
    (info,) = dragrig.campaign("c").runs
    assert info.samples == 49
    if first.startswith("0"):
        assert any("1 row without a number at begin" in event.message for event in dragrig.load(info.path).events)


@pytest.mark.parametrize(
    "content",
    [
        [{"t": 0.01 * k, "F": 1.0, "x": 0.1 * k} for k in range(20)],
        {"t": [0.01 * k for k in range(20)], "F": [1.0] * 20, "x": [0.1 * k for k in range(20)]},
        {"columns": ["t", "F", "x"], "data": [[0.01 * k, 1.0, 0.1 * k] for k in range(20)]},
    ],
)
def test_json_is_read_in_its_usual_forms(importer: Importer, content: object) -> None:
    Path("a.json").write_text(json.dumps(content), "utf-8")
    importer("a.json", "--map", "time=t:s", "--map", "force=F:N", "--map", "position=x:mm", "--out", "c")
    (info,) = dragrig.campaign("c").runs
    assert (info.samples, dragrig.load(info.path).trace.force[0]) == (20, 1000.0)


def write_workbook(path: Path, sheets: Mapping[str, Sequence[Sequence[str | float | datetime]]]) -> None:
    """Write the parts of a workbook (ECMA-376) that readers ask for; dates are numbers in the second style."""

    def cell(value: str | float | datetime) -> str:
        if isinstance(value, str):
            return f'<c t="inlineStr"><is><t>{value}</t></is></c>'
        if isinstance(value, datetime):
            local = value.replace(tzinfo=UTC)
            days = (local - datetime(1899, 12, 30, tzinfo=UTC)) / timedelta(days=1)
            return f'<c s="1"><v>{days!r}</v></c>'
        return f"<c><v>{value!r}</v></c>"

    main = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    link = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    numbers = range(1, len(sheets) + 1)
    listed = "".join(f'<sheet name="{name}" sheetId="{k}" r:id="r{k}"/>' for k, name in enumerate(sheets, 1))
    targets = "".join(
        f'<Relationship Id="r{k}" Type="{link}/worksheet" Target="worksheets/s{k}.xml"/>' for k in numbers
    )
    targets += f'<Relationship Id="rs" Type="{link}/styles" Target="styles.xml"/>'
    package = "http://schemas.openxmlformats.org/package/2006"
    parts = {
        "[Content_Types].xml": f'<Types xmlns="{package}/content-types"/>',
        "_rels/.rels": f'<Relationships xmlns="{package}/relationships">'
        f'<Relationship Id="r" Type="{link}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        "xl/workbook.xml": f'<workbook xmlns="{main}" xmlns:r="{link}"><sheets>{listed}</sheets></workbook>',
        "xl/_rels/workbook.xml.rels": f'<Relationships xmlns="{package}/relationships">{targets}</Relationships>',
        "xl/styles.xml": f'<styleSheet xmlns="{main}"><cellXfs><xf numFmtId="0"/><xf numFmtId="22"/></cellXfs>'
        "</styleSheet>",
    }
    for k, rows in zip(numbers, sheets.values(), strict=True):
        data = "".join(f"<row>{''.join(map(cell, row))}</row>" for row in rows)
        parts[f"xl/worksheets/s{k}.xml"] = f'<worksheet xmlns="{main}"><sheetData>{data}</sheetData></worksheet>'
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)


def test_a_workbook_is_read_with_its_dates_and_heading(importer: Importer, tmp_path: Path) -> None:
    begin = datetime.fromisoformat("2026-05-04T09:15").astimezone()
    rows = [[begin + timedelta(milliseconds=10 * k), 0.1 * k, float(k)] for k in range(50)]
    heading = [["Lab 7", "", ""], ["Time", "Load [N]", "Pos [mm]"]]
    write_workbook(tmp_path / "a.xlsx", {"notes": [["see"]], "data": [*heading, *rows]})
    importer("a.xlsx", "--map", "time=Time", "--map", "force=Load", "--map", "position=Pos", "--out", "c")
    (info,) = dragrig.campaign("c").runs
    assert (info.samples, info.header.start_time) == (50, begin)
    told = [event.message for event in dragrig.load(info.path).events]
    assert "sheet 'notes' was not read: it holds no table of numbers" in told


def test_a_long_record_becomes_a_run_for_each_motion(importer: Importer) -> None:
    time = np.arange(0.0, 16.0, 0.01)
    position = np.interp(time, [0, 1, 3, 5, 7, 9, 11, 13, 16], [0, 0, 10, 10, 0, 0, 10, 10, 10])
    np.savetxt("a.csv", np.c_[time, 0.1 + 0 * time, position], "%.6f", ",", header="t [s],F [N],x [mm]", comments="")
    importer("a.csv", "--map", "time=t", "--map", "force=F", "--map", "position=x", "--kind", "drag",
             "--split-at", "rests", "--out", "c")  # fmt: skip
    runs = sorted(dragrig.campaign("c").runs, key=lambda run: run.header.order)
    assert [round(float(run.header.protocol["travel_mm"])) for run in runs] == [10, -10, 10]
    assert [run.header.entry["origin_mm"] for run in runs] == pytest.approx([0, 10, 0], abs=0.01)
    assert [run.header.protocol["speed_mm_s"] for run in runs] == [5, 5, 5]


@pytest.mark.parametrize(
    ("place", "travels_mm", "origins_mm"),
    [
        ("reversals", [10, -10, 10, -10, 10, -5], [0, 10, 0, 10, 0, 10]),
        ("cycles", [0, 0, 5], [0, 0, 0]),
        ("4", [0, 5], [0, 0]),
    ],
)
def test_a_record_of_many_strokes_becomes_a_run_for_each_or_some_of_them(
    importer: Importer, place: str, travels_mm: list[float], origins_mm: list[float]
) -> None:
    time = np.arange(0.0, 12.3, 0.005)
    # Strokes of 2 s with standstills of 0.2 s between them, the last cut off; in counts of 0.1 mm that flicker.
    corners = np.cumsum([0.3, *[2.0, 0.2] * 6])
    position = np.interp(time, corners, [0, 10, 10, 0, 0, 10, 10, 0, 0, 10, 10, 0, 0])
    position = np.round(position + np.random.default_rng(5).normal(0, 0.03, len(time)), 1)
    np.savetxt("a.csv", np.c_[time, 0.1 + 0 * time, position], "%.6f", ",", header="t [s],F [N],x [mm]", comments="")
    importer("a.csv", "--map", "time=t", "--map", "force=F", "--map", "position=x", "--split-at", place, "--out", "c")
    runs = sorted(dragrig.campaign("c").runs, key=lambda run: run.header.order)
    positions = [dragrig.load(run.path).trace.position for run in runs]
    assert [p[-1] - p[0] for p in positions] == pytest.approx(travels_mm, abs=0.2)
    assert [run.header.entry["origin_mm"] for run in runs] == pytest.approx(origins_mm, abs=0.2)
    # Half the standstill, and the first 0.3 mm of the stroke.
    assert all(0.1 < np.argmax(np.abs(p - p[0]) > 0.3) * 0.005 < 0.22 for p in positions[1:])


def test_a_turning_rigs_angle_and_torque_become_travel_and_force(importer: Importer) -> None:
    rows = [f"{0.01 * k:.2f},{0.5 + 0.001 * k:.4f},{float(k)}" for k in range(50)]
    Path("a.csv").write_text("\n".join(["t [s],M [Nm],phi [deg]", *rows]), "utf-8")
    importer("a.csv", "--map", "time=t", "--map", "force=M", "--map", "position=phi", "--radius-mm", "25", "--out", "c")
    (info,) = dragrig.campaign("c").runs
    trace = dragrig.load(info.path).trace
    assert trace.force[0] == pytest.approx(20_000)
    assert trace.position[-1] == pytest.approx(49 * np.pi / 180 * 25)


@pytest.mark.parametrize("form", ["csv", "parquet", "mat", "npz"])
def test_what_was_exported_comes_back(importer: Importer, form: Any) -> None:
    (run,) = dragrig.simulate(DragProtocol(speed_mm_s=20, travel_mm=10, rest_s=0.2, hold_s=0.2))
    dragrig.export(run, f"run.{form}", format=form)
    importer(f"run.{form}", "--out", "c")
    (info,) = dragrig.campaign("c").runs
    assert info.header.run_id == run.info.header.run_id
    assert np.allclose(dragrig.load(info.path).trace.force, run.trace.force, atol=1e-3)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("text.csv", *MAP), "text.csv"),
        (("a.csv",), "no column is mapped"),
        (("a.csv", "--map", "forze=3:N"), "did you mean force?"),
        (("a.csv", "--map", "force"), "QUANTITY=COLUMN"),
        (("a.csv", "--map", "time=1:s", "--map", "force=Last:N"), "Last"),
        (("a.csv", "--map", "time=1:s", "--map", "force=Kraft:mV"), "factor"),
        (("a.csv", *MAP, "--set", "speed_mm_s"), "key=value"),
        (("a.csv", *MAP, "--kind", "dragg"), "dragg is no kind of run; did you mean drag?"),
        (("a.csv", *MAP, "--kind", "drag"), "needs speed_mm_s, travel_mm, accel_mm_s2, rest_s, hold_s"),
        (("a.csv", *MAP, "--decimal", "x"), "decimal"),
        (("a.csv", *MAP, "--start-time", "yesterday"), "start_time"),
        (("a.csv", *MAP, "--resample-hz", "nan"), "--resample-hz"),
        (("a.csv", *MAP, "--out", "a.csv"), "a.csv"),
        (("empty.csv", *MAP), "is empty"),
        (("binary.csv", *MAP), "binary.csv"),
        (("sheet.xlsx", *MAP), "is damaged or no complete file (File is not a zip file)"),
        (("a.csv", *MAP, "--split-at", "rests"), "shows no place for split_at = 'rests'"),
        (("a.csv", *MAP, "--split-at", "cycles"), "shows no place for split_at = 'cycles'"),
        (("a.csv", *MAP, "--split-at", "0"), "must be rests, reversals, cycles or a number of strokes, not '0'"),
        (("a.csv", "--map", "time=1:s", "--map", "force=Kraft:Nm"), "--radius-mm"),
        (("nowhere.csv", *MAP), "there is no such file"),
        ((".", *MAP), "is a folder"),
        (("a.csv", "--settings", "a.csv"), "not"),
    ],
)
def test_what_cannot_be_imported_is_told_in_one_sentence(
    importer: Importer, tmp_path: Path, words: tuple[str, ...], sentence: str
) -> None:
    german("a.csv")
    german("text.csv", spoil="1,00;see note;0,2")
    Path("empty.csv").write_bytes(b"")
    Path("binary.csv").write_bytes(bytes(range(256)) * 40)
    Path("sheet.xlsx").write_bytes(b"PK\x03\x04")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    answer = importer(*words, code=2)
    assert sentence in answer.err
    assert answer.err.count("\n") == 1, answer.err
    assert answer.out == ""
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
