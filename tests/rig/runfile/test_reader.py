"""Reading run files: what is whole is read, everything else refused by name and never worse."""

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dragrig.config.errors import OutputError, RunFileError
from dragrig.rig.runfile import (
    finish,
    read_campaign,
    read_info,
    read_run,
    run_file_name,
    store_filtered,
    verify,
    write_run,
)
from dragrig.rig.runfile.hdf5 import find_damaged_text
from dragrig.rig.runfile.model import FilteredTrace, RecordedChannel, RunEvent, RunStatus
from places import CAMPAIGN
from property_tests import examples
from runfiles import START, arrays, as_version_1, header, record

PRACTICE_FILES = sorted(CAMPAIGN.glob("*.h5"))
REQUIRED_ATTRIBUTES = [
    ("/", "NX_class"), ("/", "default"), ("/entry", "NX_class"), ("/entry", "default"),
    ("/entry/run", "format"), ("/entry/run", "format_version"), ("/entry/run", "run_id"),
    ("/entry/run", "start_time"), ("/entry/run", "order"), ("/entry/run", "status"), ("/entry/run", "backend"),
    ("/entry/trace", "NX_class"), ("/entry/trace", "signal"), ("/entry/trace", "axes"),
    ("/entry/trace", "sample_rate_hz"),
    ("/entry/trace/time", "units"), ("/entry/trace/force", "units"), ("/entry/trace/position", "units"),
    ("/entry/trace/command", "units"), ("/entry/trace/phase", "names"),
    ("/entry/protocol", "kind"), ("/entry/protocol", "speed_mm_s"), ("/entry/protocol", "hold_s"),
    ("/entry/capsule", "diameter_mm"), ("/entry/capsule", "length_mm"), ("/entry/capsule", "mass_g"),
    ("/entry/capsule", "contact_angle_deg"),
    ("/entry/specimen", "name"), ("/entry/specimen", "wall_thickness_mm"), ("/entry/specimen", "fixture"),
]  # fmt: skip
REQUIRED_OBJECTS = [
    "/entry", "/entry/run", "/entry/trace", "/entry/protocol", "/entry/capsule", "/entry/specimen", "/entry/trace/time",
    "/entry/trace/force", "/entry/trace/position", "/entry/trace/command", "/entry/trace/phase",
]  # fmt: skip


def whole(path: Path, samples: int = 400) -> Path:
    return write_run(path, header(), arrays(0, samples), events=[RunEvent(0.1, "phase", "accelerate ±")])


def refused(path: Path) -> str:
    with pytest.raises(RunFileError) as caught:
        read_run(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize("path", PRACTICE_FILES, ids=lambda path: path.stem)
def test_files_by_others_are_read(path: Path) -> None:
    run = read_run(path)
    with h5py.File(path) as file:
        trace = file["entry/trace"]
        assert run.info.samples == len(trace["time"])
        assert run.info.kind == file["entry/protocol"].attrs["kind"]
        np.testing.assert_array_equal(run.trace.force, trace["force"][:])
        np.testing.assert_array_equal(run.trace.time, trace["time"][:])
    assert run.trace.units["position"] == "mm"
    assert read_info(path) == run.info


def test_files_of_the_first_format_are_read_filtered_and_recovered(tmp_path: Path) -> None:
    path = whole(tmp_path / "run.h5")
    today = read_run(path)
    old = read_run(as_version_1(path))
    assert old.info == replace(today.info, format_version=1)
    assert old.events == today.events
    store_filtered(
        path, FilteredTrace(old.trace.time, {"force": old.trace.time}, {}), [RunEvent(0.2, "filter", "short")]
    )
    assert [event.kind for event in read_run(path).events] == ["phase", "filter"]
    assert read_info(path) == old.info
    cut = record(tmp_path / "cut.h5", 300)
    made = finish(as_version_1(cut))
    assert verify(made).holds
    assert read_info(made).format_version == 2
    assert read_info(made).checks == {"rest_offset_mN": 1.5, "clipped": False}
    assert read_info(made).header.settings_toml == header().settings_toml


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    given_header, given_arrays = header(order=3), arrays(0, 400)
    event = RunEvent(0.25, "phase", "accelerate ±")
    path = write_run(
        tmp_path / "run.h5", given_header, given_arrays, events=[event], status=RunStatus.ABORTED, reason="Ctrl-C",
        end_time=START, checks={"rest_offset_mN": 1.5, "clipped": True, "lost_samples": 2},
    )  # fmt: skip
    run = read_run(path)
    assert run.info.header == replace(given_header, protocol={**given_header.protocol, "speed_mm_s": 1.0})
    assert (run.info.status, run.info.reason, run.info.end_time) == (RunStatus.ABORTED, "Ctrl-C", START)
    assert run.info.checks == {"rest_offset_mN": 1.5, "clipped": True, "lost_samples": 2}
    assert run.events == (event,)
    for name, values in given_arrays.items():
        columns = {"time": run.trace.time, "command": run.trace.command, "phase": run.trace.phase, **run.trace.channels}
        np.testing.assert_array_equal(columns[name], values)
        assert columns[name].dtype == values.dtype
        assert not columns[name].flags.writeable


def test_numbers_keep_all_their_digits(tmp_path: Path) -> None:
    given_arrays = {**arrays(0, 10), "force": np.linspace(0, 1, 10) / 3}
    channels = (
        RecordedChannel("force", "mN", "float64"),
        RecordedChannel("position", "mm"),
        RecordedChannel("motor_force", "mN"),
    )
    path = write_run(tmp_path / "run.h5", replace(header(), channels=channels), given_arrays)
    np.testing.assert_array_equal(read_run(path).trace.force, given_arrays["force"])


def test_a_stage_alone_is_about_its_motor_force(tmp_path: Path) -> None:
    alone = replace(
        header(kind="motion"), channels=(RecordedChannel("position", "mm"), RecordedChannel("motor_force", "mN"))
    )
    given_arrays = {name: values for name, values in arrays(0, 50).items() if name != "force"}
    trace = read_run(write_run(tmp_path / "run.h5", alone, given_arrays)).trace
    assert trace.signal == "motor_force"
    np.testing.assert_array_equal(trace.force, given_arrays["motor_force"])


@pytest.mark.parametrize(("place", "name"), REQUIRED_ATTRIBUTES)
def test_a_missing_attribute_is_named(tmp_path: Path, place: str, name: str) -> None:
    path = whole(tmp_path / "run.h5")
    with h5py.File(path, "r+") as file:
        del file[place].attrs[name]
    message = refused(path)
    assert name in message
    assert place in message


@pytest.mark.parametrize("place", REQUIRED_OBJECTS)
def test_a_missing_part_is_named(tmp_path: Path, place: str) -> None:
    path = whole(tmp_path / "run.h5")
    with h5py.File(path, "r+") as file:
        del file[place]
    assert f"{place} is missing" in refused(path)


def set_attribute(place: str, name: str, value: object) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file[place].attrs[name] = value

    return change


def set_values(name: str, values: object) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        trace = file["entry/trace"]
        attributes = dict(trace[name].attrs)
        del trace[name]
        trace[name] = values
        trace[name].attrs.update(attributes)

    return change


def lose_one_time(values: list[float]) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        file["entry/trace/time"][5:7] = values

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_attribute("/entry/run", "format", "other"), "format"),
        (set_attribute("/entry/run", "format_version", 3), "newer"),
        (set_attribute("/entry/run", "format_version", "one"), "format_version"),
        (set_attribute("/entry/run", "format_version", 0), "format_version"),
        (set_attribute("/entry/run", "status", "fine"), "status"),
        (set_attribute("/entry/run", "start_time", "2026-05-04T09:30:00"), "offset"),
        (set_attribute("/entry/run", "start_time", "yesterday"), "start_time"),
        (set_attribute("/entry/run", "order", -1), "order"),
        (set_attribute("/entry/run", "order", 1.5), "order"),
        (set_attribute("/entry/run", "run_id", "seven"), "UUID"),
        (set_attribute("/entry/trace", "sample_rate_hz", float("nan")), "sample_rate_hz"),
        (set_attribute("/entry/trace", "sample_rate_hz", 0.0), "sample_rate_hz"),
        (set_attribute("/entry/trace", "signal", "weight"), "signal"),
        (set_attribute("/entry/trace/force", "units", "N"), "'N' instead of 'mN'"),
        (set_attribute("/entry/trace/phase", "names", ["a", "b"]), "names"),
        (set_attribute("/entry/specimen", "fixture", "glue"), "fixture"),
        (set_attribute("/entry/capsule", "mass_g", "heavy"), "mass_g"),
        (set_attribute("/entry/capsule", "mass_g", float("inf")), "mass_g"),
        (lose_one_time([np.nan, 0.006]), "NaN"),
        (lose_one_time([0.006, 0.005]), "rise"),
        (set_values("force", np.zeros(399, "f4")), "399 samples"),
        (set_values("force", np.zeros((400, 2), "f4")), "/entry/trace/force"),
        (set_values("force", np.zeros(400, "i4")), "int32"),
        (set_values("phase", np.full(400, 9, "u1")), "phase"),
        (set_values("phase", np.zeros(400, "i8")), "uint8"),
        (set_values("position", "text"), "/entry/trace/position"),
    ],
)
def test_what_breaks_the_format_is_named(tmp_path: Path, change: Callable[[h5py.File], None], message: str) -> None:
    path = whole(tmp_path / "run.h5")
    with h5py.File(path, "r+") as file:
        change(file)
    assert message in refused(path)


def test_a_shape_that_the_file_cannot_hold_asks_for_no_memory(tmp_path: Path) -> None:
    path = whole(tmp_path / "run.h5")
    with h5py.File(path, "r+") as file:
        trace = file["entry/trace"]
        for name in list(trace):
            attributes, dtype = dict(trace[name].attrs), trace[name].dtype
            del trace[name]
            trace.create_dataset(name, shape=(1 << 48,), chunks=(1 << 20,), dtype=dtype).attrs.update(attributes)
    assert "does not hold" in refused(path)


@pytest.mark.parametrize("content", [b"", b"time,force\n0,1\n", b"\x89HDF\r\n\x1a\n" + bytes(40)])
def test_foreign_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "run.h5"
    path.write_bytes(content)
    refused(path)


def test_foreign_hdf5_and_missing_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    assert "no such file" in refused(path)
    with h5py.File(path, "w") as file:
        file["x"] = [1, 2, 3]
    assert "/entry is missing" in refused(path)


@settings(max_examples=examples(120), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(keep=st.floats(0, 1), own=st.booleans())
def test_a_cut_file_is_refused(tmp_path: Path, keep: float, own: bool) -> None:
    source = tmp_path / "whole.h5"
    if not own:
        source = PRACTICE_FILES[0]
    elif not source.exists():
        whole(source)
    raw = source.read_bytes()
    path = tmp_path / "run.h5"
    path.write_bytes(raw[: int(keep * (len(raw) - 1))])
    refused(path)


changes = st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=30)


@settings(max_examples=examples(250), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(changes=changes, own=st.booleans(), within=st.sampled_from([3000, 20_000, 1 << 30]))
def test_damaged_bytes_are_read_or_refused_but_never_worse(
    tmp_path: Path, changes: list[tuple[float, int]], own: bool, within: int
) -> None:
    source = tmp_path / "whole.h5"
    if not own:
        source = CAMPAIGN / "010-drag.h5"
    elif not source.exists():
        whole(source)
    raw = bytearray(source.read_bytes())
    for place, value in changes:
        raw[int(place * min(len(raw), within))] = value
    path = tmp_path / "run.h5"
    path.write_bytes(raw)
    with suppress(RunFileError):
        read_run(path)


def test_damage_that_hangs_or_kills_hdf5_is_caught_before(tmp_path: Path) -> None:
    raw = bytearray((CAMPAIGN / "010-drag.h5").read_bytes())
    heap = raw.index(b"GCOL")
    stuck, greedy = bytearray(raw), bytearray(raw)
    stuck[heap + 16 : heap + 32] = bytes(16)  # a free object of no size: the library never gets past it
    reference = raw.index(b"\x06\0\0\0" + heap.to_bytes(8, "little") + b"\x01\0\0\0")  # NXroot
    greedy[reference : reference + 4] = b"\xff" * 4  # text of 4 GB
    for damaged in (stuck, greedy):
        path = tmp_path / "run.h5"
        path.write_bytes(damaged)
        assert "its text is damaged" in refused(path)


@pytest.mark.parametrize("own", [True, False], ids=["of today", "of the first version"])
def test_text_of_gigabytes_that_lies_nowhere_is_caught_before(own: bool, tmp_path: Path) -> None:
    raw = (whole(tmp_path / "whole.h5") if own else CAMPAIGN / "010-drag.h5").read_bytes()
    heaps = [found.start().to_bytes(8, "little") for found in re.finditer(b"GCOL", raw)]
    of_text = [found.start() for found in re.finditer(rb"\x19\x01[\0\1]\0\x10\0\0\0\x10", raw)]
    references = [place - 4 for at in of_text for heap in heaps if (place := raw.find(heap, at, at + 64)) > 0]
    assert len(references) >= 15
    path = tmp_path / "run.h5"
    for reference in references:
        damaged = bytearray(raw)
        damaged[reference : reference + 12] = b"\x42\xff\xff\xff" + (1 << 40).to_bytes(8, "little")
        path.write_bytes(damaged)
        assert find_damaged_text(path) == reference
    assert "its text is damaged" in refused(path)


@pytest.mark.parametrize("dataset", ["/entry/run/settings", "/entry/run/words"])
def test_a_dataset_with_text_of_gigabytes_is_caught_before(dataset: str, tmp_path: Path) -> None:
    path = whole(tmp_path / "run.h5")
    with h5py.File(path, "r+") as file:
        if dataset in file:
            del file[dataset]
        kind = np.dtype([("time", "<f8"), ("word", h5py.string_dtype())])
        if dataset.endswith("words"):
            file[dataset] = np.array([(0.0, "a"), (1.0, "b")], kind)
            at = file[dataset].id.get_offset() + 24 + 8
        else:
            file[dataset] = "text"
            at = file[dataset].id.get_offset()
    raw = bytearray(path.read_bytes())
    raw[at : at + 12] = b"\x42\xff\xff\xff" + (1 << 40).to_bytes(8, "little")
    path.write_bytes(raw)
    assert f"its text is damaged at byte {at}" in refused(path)


def test_nothing_is_written_over(tmp_path: Path) -> None:
    path = whole(tmp_path / "run.h5")
    before = path.read_bytes()
    with pytest.raises(OutputError, match="already"):
        whole(path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.h5"]


@pytest.mark.parametrize(
    ("broken_header", "broken_arrays", "message"),
    [
        (replace(header(), capsule={}), {}, "diameter_mm"),
        (replace(header(), protocol={}), {}, "speed_mm_s"),
        (
            replace(header(), channels=(RecordedChannel("force", "N"), RecordedChannel("position", "mm"))),
            {},
            "'N' instead of 'mN'",
        ),
        (replace(header(), channels=(RecordedChannel("position", "mm"),)), {}, "motor_force"),
        (replace(header(), start_time=START.replace(tzinfo=None)), {}, "offset"),
        (header(), {"time": np.zeros(20)}, "rise"),
        (header(), {"force": np.zeros(19, "f4")}, "shape"),
        (header(), {"phase": np.full(20, 5, "u1")}, "phase"),
        (header(), {"extra": np.zeros(20)}, "extra"),
    ],
)
def test_what_could_not_be_read_back_is_not_written(
    tmp_path: Path, broken_header: object, broken_arrays: dict[str, object], message: str
) -> None:
    with pytest.raises(RunFileError, match=message):
        write_run(tmp_path / "run.h5", broken_header, {**arrays(0, 20), **broken_arrays})  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_an_unwritable_folder_is_reported_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written to"):
        whole(tmp_path / "missing" / "run.h5")


def test_names_sort_by_time_and_refuse_odd_kinds() -> None:
    assert run_file_name(START, "drag", 7) == "20260504-093000-drag-007.h5"
    with pytest.raises(OutputError, match=r"\.\./x"):
        run_file_name(START, "../x", 0)


def test_a_folder_of_files_by_others_is_a_campaign(tmp_path: Path) -> None:
    for path in PRACTICE_FILES:
        shutil.copy(path, tmp_path)
    (tmp_path / "000-broken.h5").write_bytes(b"nothing")
    campaign = read_campaign(tmp_path)
    orders = [run.header.order for run in campaign.runs]
    assert len(campaign.runs) == len(PRACTICE_FILES)
    assert orders == sorted(orders)
    assert [path.name for path, _ in campaign.unreadable] == ["000-broken.h5"]


def test_the_package_loads_h5py_only_when_needed() -> None:
    code = "import sys, dragrig.rig.runfile, dragrig.rig.devices; sys.exit('h5py' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
