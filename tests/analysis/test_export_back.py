"""Exports of ours come back without a map, in every format, whole or in part, whatever their columns are called."""

import json
import shutil
import string
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pyarrow import parquet
from scipy.io import loadmat

from dragrig.analysis.export import CsvStyle, ExportFormat, ExportSelection, export_run, write_export
from dragrig.analysis.importing.exports import read_export
from dragrig.analysis.importing.import_settings import ImportSettings, parse_map
from dragrig.analysis.importing.importer import import_file, import_runs
from dragrig.analysis.savgol import SavgolSettings, filter_file
from dragrig.config.errors import ImportDataError
from dragrig.rig.runfile import Run, read_run
from dragrig.rig.runfile.model import RecordedChannel, Trace
from places import DATA
from property_tests import examples, thorough

DRAG = DATA / "campaign" / "014-drag.h5"
NASTY = (
    "左", "右", "Drück-1", "Drück_1", "drück_1", "a,b", 'a"b"', "a;b", "a\tb", "# a", "a\nb", "metadata",
    "metadata_json", "file", "allow_pickle", "args", "time_s", "force_mN", "position_mm", "end", "x_end", "_", "-", "1",
    "2024-01-01", "Zug" * 30 + "1", "Zug" * 30 + "2", "nan", "__index_level_0__", "e\u0301", "é", "µ", "μ", "😀",
    "\u202eabc", "a.npy", "columns", "force_filtered", "speed", "Time (ms)", "Force", "phase_2",
)  # fmt: skip
UNITS = (
    "",
    "V",
    "mV",
    "µm",
    "m/s²",
    "°",
    "%",
    "N,m",
    'in"',
    "a unit that is longer than any name may be in MATLAB or so",
)

names = st.lists(
    st.sampled_from(NASTY)
    | st.text(st.characters(exclude_characters="/\0", exclude_categories=["Cs"]), min_size=1, max_size=80).filter(
        lambda name: name != "."
    )
    | st.text(string.ascii_letters + "_-. ", min_size=1, max_size=4).filter(lambda name: name != "."),
    min_size=1,
    max_size=12,
    unique=True,
).map(lambda found: [name for name in found if name not in {"time", "command", "phase", "force", "position"}])
STYLES = tuple(CsvStyle(decimal, delimiter) for decimal, delimiter in (".,", ",;", ".;", ",\t", ".|", ", ", ". "))


def run_of(channels: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.generic]]], units: dict[str, str]) -> Run:
    run = read_run(DRAG)
    kept = len(next(iter(channels.values())))
    recorded = tuple(RecordedChannel(name, units[name], str(v.dtype)) for name, v in channels.items())
    header = replace(run.info.header, channels=(*run.info.header.channels, *recorded))
    trace = Trace(
        run.trace.sample_rate_hz, "force", run.trace.time[:kept], run.trace.command[:kept], run.trace.phase[:kept],
        {**{name: values[:kept] for name, values in run.trace.channels.items()}, **channels},
        {**run.trace.units, **units},
    )  # fmt: skip
    return replace(run, info=replace(run.info, header=header), trace=trace)


def assert_same(run: Run, back: Run) -> None:
    np.testing.assert_array_equal(back.trace.time, run.trace.time)
    np.testing.assert_array_equal(back.trace.command, run.trace.command)
    np.testing.assert_array_equal(back.trace.phase, run.trace.phase)
    assert set(back.trace.channels) == set(run.trace.channels)
    for name, values in run.trace.channels.items():
        assert back.trace.channels[name].dtype == values.dtype
        np.testing.assert_array_equal(back.trace.channels[name], values)
        assert back.trace.units[name] == run.trace.units[name]


@settings(max_examples=examples(40))
@given(
    found=names,
    rows=st.integers(1, 9),
    export_format=st.sampled_from(list(ExportFormat)),
    style=st.sampled_from(STYLES),
    data=st.data(),
)
@example(found=list(NASTY), rows=3, export_format=ExportFormat.MAT, style=STYLES[0], data=None)
@example(found=list(NASTY), rows=3, export_format=ExportFormat.NPZ, style=STYLES[0], data=None)
@example(found=list(NASTY), rows=3, export_format=ExportFormat.CSV, style=STYLES[-1], data=None)
def test_every_column_comes_back_under_its_own_name(
    found: list[str], rows: int, export_format: ExportFormat, style: CsvStyle, data: st.DataObject | None
) -> None:
    channels, units = {}, {}
    for number, name in enumerate(found):
        width = 32 if number % 2 else 64
        values = [number + at / 7 for at in range(rows)]
        if data is not None:
            values = data.draw(st.lists(st.floats(width=width, allow_infinity=False), min_size=rows, max_size=rows))
        channels[name] = np.array(values, dtype=f"float{width}")
        units[name] = UNITS[number % len(UNITS)] if data is None else data.draw(st.sampled_from(UNITS))
    run = run_of(channels, units) if found else read_run(DRAG)
    with TemporaryDirectory() as folder:
        written = write_export(run, Path(folder) / "export.dat", export_format, style)
        back = read_run(import_file(written, Path(folder) / "back.h5").path)
    assert_same(run, back)


def test_names_are_legal_and_the_original_ones_written_down(tmp_path: Path) -> None:
    found = ("左", "右", "Drück-1", "Drück_1", "metadata", "file", "end", "Zug" * 30 + "1", "Zug" * 30 + "2")
    run = run_of({name: np.full(5, float(number)) for number, name in enumerate(found)}, dict.fromkeys(found, ""))
    held = loadmat(write_export(run, tmp_path / "a.mat", ExportFormat.MAT), struct_as_record=False, squeeze_me=True)
    fields = set(held["run"]._fieldnames)
    assert all(name.isascii() and name.isidentifier() and len(name) <= 63 for name in fields)
    assert {"Druck_1", "Druck_1_2", "u5DE6", "u53F3", "x_end", "metadata", "metadata_2", "metadata_json"} < fields
    with np.load(write_export(run, tmp_path / "a.npz", ExportFormat.NPZ)) as archive:
        described = json.loads(str(archive["metadata"]))["columns"]
        assert {name: archive[name][0] for name, (dataset, *_) in described.items() if dataset in found} == {
            "左": 0, "右": 1, "Drück_1": 2, "Drück_1_2": 3, "metadata_2": 4, "file_2": 5, "end": 6, "Zug" * 30 + "1": 7,
            "Zug" * 30 + "2": 8,
        }  # fmt: skip
    assert {dataset for dataset, *_ in described.values()} == {"time", "force", "position", "command", "phase", *found}
    table = parquet.read_table(write_export(run, tmp_path / "a.parquet", ExportFormat.PARQUET))
    assert len({name.casefold() for name in table.column_names}) == len(table.column_names) == 5 + len(found)
    assert {"time_s", "force_mN", "position_mm", "command_mm", "phase"} < set(table.column_names)


def test_columns_of_others_take_no_name_of_ours(tmp_path: Path) -> None:
    run = run_of({"position_mm": np.full(4, 7.0), "Force_mN": np.ones(4)}, {"position_mm": "", "Force_mN": ""})
    table = parquet.read_table(write_export(run, tmp_path / "a.parquet", ExportFormat.PARQUET))
    np.testing.assert_array_equal(table["position_mm"].to_numpy(), run.trace.position)
    np.testing.assert_array_equal(table["Force_mN_2"].to_numpy(), np.ones(4))


@pytest.fixture
def broken(tmp_path: Path) -> Path:
    """A run of 95 and 73 samples at 100 Hz, with a gap between them."""
    source = tmp_path / "broken.csv"
    shutil.copy(DATA / "foreign" / "every-across-gap.csv", source)
    settings = ImportSettings(columns=parse_map(["time=Time", "force=Force", "position=Position"]))
    return import_file(source, tmp_path / "broken.h5", settings).path


@pytest.mark.parametrize("every", [1, 2, 7, 10, 73, 95, 168])
def test_no_mean_is_over_a_gap_and_no_sample_is_lost(broken: Path, every: int, tmp_path: Path) -> None:
    run = read_run(broken)
    time, force = run.trace.time, run.trace.force
    first = int(np.argmax(np.diff(time) > 0.02)) + 1
    written = export_run(
        broken, tmp_path / "part.parquet", ExportFormat.PARQUET, selection=ExportSelection(every=every)
    )
    table = parquet.read_table(written)
    stretches = [
        np.split(np.arange(*ends), range(every, ends[1] - ends[0], every)) for ends in ((0, first), (first, len(time)))
    ]
    blocks = [block for stretch in stretches for block in stretch]
    assert sum(map(len, blocks)) == len(time)
    np.testing.assert_allclose(table["time_s"].to_numpy(), [time[block].mean() for block in blocks], atol=1e-12)
    np.testing.assert_allclose(table["force_mN"].to_numpy(), [force[block].mean() for block in blocks], rtol=1e-12)
    middle = [run.trace.phase[block[(len(block) - 1) // 2]] for block in blocks]
    np.testing.assert_array_equal(table["phase"].to_numpy(), middle)
    metadata = json.loads(table.schema.metadata[b"dragrig"])
    if every > 1:
        assert metadata["rows_of_fewer_samples"] == [[row, len(b)] for row, b in enumerate(blocks) if len(b) < every]
        assert metadata["samples_averaged"] == every


PARTS = (
    ExportSelection(every=10),
    ExportSelection(every=168),
    ExportSelection(("force",)),
    ExportSelection(("force", "Drück-1")),
    ExportSelection(filtered_only=True),
    ExportSelection(("force_filtered", "position", "phase"), filtered_only=True, every=3),
)


PARTS_IN_FORMATS = [
    (part, form) if number % 3 == place % 3 else thorough(part, form)
    for number, part in enumerate(PARTS)
    for place, form in enumerate(ExportFormat)
]


@pytest.mark.parametrize(("selection", "export_format"), PARTS_IN_FORMATS, ids=str)
def test_a_part_of_a_run_comes_back_as_that_part(
    broken: Path, tmp_path: Path, export_format: ExportFormat, selection: ExportSelection
) -> None:
    filter_file(broken)
    run = read_run(broken)
    channels = {**run.trace.channels, "Drück-1": np.arange(len(run.trace.time)) / 3}
    run = replace(run, trace=replace(run.trace, channels=channels, units={**run.trace.units, "Drück-1": "bar"}))
    written = write_export(run, tmp_path / "part.dat", export_format, CsvStyle(",", " "), selection=selection)
    imported = import_file(written, tmp_path / "back.h5")
    back = read_run(imported.path)
    header = back.info.header
    assert (header.kind, header.start_time) == (run.info.kind, run.info.header.start_time)
    assert header.run_id != run.info.header.run_id
    assert back.trace.sample_rate_hz == pytest.approx(100 / selection.every)
    remarks = " ".join(event.message for event in imported.events)
    assert run.filtered is not None
    force = run.filtered.channels["force"] if selection.filtered_only else run.trace.force
    assert ("what the filter made" in remarks) is selection.filtered_only
    assert back.trace.force[0] == pytest.approx(np.mean(force[: min(selection.every, 95)]), rel=1e-6)
    assert ("Drück-1" in back.trace.channels) is (not selection.columns or "Drück-1" in selection.columns)
    assert np.isfinite(back.trace.position).all() is np.bool_("no position in the export" not in remarks)


def test_what_is_no_force_becomes_none(broken: Path, tmp_path: Path) -> None:
    filter_file(broken, SavgolSettings(window_samples=7, derivative=1))
    slopes = export_run(broken, tmp_path / "a.csv", selection=ExportSelection(filtered_only=True))
    alone = export_run(broken, tmp_path / "b.csv", selection=ExportSelection(("position",)))
    for written in (slopes, alone):
        with pytest.raises(ImportDataError, match=r"export without a force.*--columns force,position"):
            import_file(written, tmp_path)


def test_a_channel_without_a_single_number_comes_back(tmp_path: Path) -> None:
    run = run_of({"probe": np.full(4, np.nan)}, {"probe": "V"})
    selection = ExportSelection(("force", "probe"))
    for number, style in enumerate(STYLES):
        written = write_export(run, tmp_path / f"{number}.csv", ExportFormat.CSV, style, selection=selection)
        back = read_run(import_file(written, tmp_path / f"{number}.h5").path)
        assert np.isnan(back.trace.channels["probe"]).all()
        np.testing.assert_array_equal(back.trace.force, run.trace.force)


def test_a_missing_number_between_blanks_moves_no_column(tmp_path: Path) -> None:
    run = run_of({"probe": np.array([1.0, np.nan, 3.0])}, {"probe": "V"})
    written = write_export(run, tmp_path / "a.csv", ExportFormat.CSV, CsvStyle(".", " "))
    table = pd.read_csv(written, sep=r"\s+", comment="#")
    np.testing.assert_array_equal(table["probe_V"], [1, np.nan, 3])
    np.testing.assert_array_equal(table["phase"], run.trace.phase)


@pytest.mark.parametrize("export_format", list(ExportFormat))
def test_integers_beyond_those_of_a_float_are_exported_whole(tmp_path: Path, export_format: ExportFormat) -> None:
    counts = np.array([2**53 + 1, -(2**53) - 3, 2**63 - 1], dtype=np.int64)
    written = write_export(run_of({"n": counts}, {"n": ""}), tmp_path / "n.dat", export_format)
    exported = read_export(written)
    assert exported is not None
    assert exported.columns["n"].tolist() == counts.tolist()


def test_an_export_saved_by_an_editor_of_another_system_comes_back(tmp_path: Path) -> None:
    written = export_run(DRAG, tmp_path)
    written.write_bytes(b"\xef\xbb\xbf" + written.read_bytes().replace(b"\n", b"\r\n"))
    assert_same(read_run(DRAG), read_run(import_file(written, tmp_path / "back.h5").path))


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (",force_mN,", ",Force,", r"which were changed \(the columns are no longer"),
        ("\n4.812,", "\nend,", r"which were changed \(.*'end'"),
        (",4\n4.812,", ",\n4.812,", r"which were changed \(phase has no number in row 2406"),
        ("dragrig-export: 1", "dragrig-export: 9", "install a newer dragrig"),
    ],
)
def test_a_table_that_is_no_longer_that_of_its_metadata_is_refused(
    tmp_path: Path, old: str, new: str, sentence: str
) -> None:
    written = export_run(DRAG, tmp_path)
    text = written.read_text("utf-8")
    assert old in text
    written.write_text(text.replace(old, new, 1), "utf-8")
    with pytest.raises(ImportDataError, match=sentence):
        import_file(written, tmp_path / "back.h5")


def test_settings_that_an_export_makes_idle_are_named(tmp_path: Path) -> None:
    written = export_run(DRAG, tmp_path)
    (run,) = import_runs(written, tmp_path, ImportSettings(operator="Ada", split_at="rests", order=3))
    assert "not used, as an export comes back as it was: operator, split_at" in run.events[0].message
