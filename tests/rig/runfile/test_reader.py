"""Reading run files: what is whole is read, everything else refused by name and never worse."""

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dragrig.config.errors import OutputError, RunFileError
from dragrig.rig import read_tail, run_file_name, store_filtered, write_run
from dragrig.rig.runfile import finish, read_campaign, read_info, read_run, verify
from dragrig.rig.runfile.hdf5 import find_damaged_text
from dragrig.rig.runfile.model import FilteredTrace, RecordedChannel, RunEnding, RunEvent, RunStatus
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


@cache
def run_of(samples: int) -> bytes:
    with TemporaryDirectory() as folder:
        path = write_run(
            Path(folder) / "run.h5", header(), arrays(0, samples), events=[RunEvent(0.1, "phase", "accelerate ±")]
        )
        return path.read_bytes()


def whole(path: Path, samples: int = 400) -> Path:
    path.write_bytes(run_of(samples))
    return path


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
    checks = {"rest_offset_mN": 1.5, "clipped": True, "lost_samples": 2}
    ending = RunEnding(RunStatus.ABORTED, "Ctrl-C", START, checks)
    path = write_run(tmp_path / "run.h5", given_header, given_arrays, events=[event], ending=ending)
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


def put(place: str, **dataset: object) -> Callable[[h5py.File], None]:
    """Put a dataset in the place of what is there, or a group where none is given."""

    def change(file: h5py.File) -> None:
        if place in file:
            del file[place]
        file.create_dataset(place, **dataset) if dataset else file.create_group(place)

    return change


def lose_attribute(place: str, name: str) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        del file[place].attrs[name]

    return change


def filter_with(**columns: object) -> Callable[[h5py.File], None]:
    def change(file: h5py.File) -> None:
        for name, values in columns.items():
            file[f"/entry/filtered/{name}"] = values

    return change


EVENT_TYPE = np.dtype([("time_s", "f8"), ("kind", "S4"), ("message", "S4")])
ISO = "an ISO 8601 time with its offset"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (set_attribute("/", "default", "x"), "the attribute default of / is 'x' instead of 'entry'"),
        (set_attribute("/entry/run", "format", "other"), "the attribute format of /entry/run is not 'dragrig-run'"),
        (lose_attribute("/entry/run", "format_version"), "/entry/run lacks the attribute format_version"),
        *(
            (
                set_attribute("/entry/run", "format_version", version),
                f"the attribute format_version of /entry/run is {version!r} instead of 2",
            )
            for version in ("one", 0, 1, True, 2.0)
        ),
        (
            set_attribute("/entry/run", "status", "fine"),
            "the attribute status of /entry/run is 'fine' instead of one of recording, complete, aborted, tripped, "
            "failed, recovered",
        ),
        (
            set_attribute("/entry/run", "start_time", "2026-05-04T09:30:00"),
            f"the attribute start_time of the run is '2026-05-04T09:30:00' instead of {ISO}",
        ),
        (
            set_attribute("/entry/run", "start_time", "yesterday"),
            f"the attribute start_time of the run is 'yesterday' instead of {ISO}",
        ),
        (
            set_attribute("/entry/run", "end_time", "soon"),
            f"the attribute end_time of the run is 'soon' instead of {ISO}",
        ),
        *(
            (
                set_attribute("/entry/run", "order", order),
                f"the attribute order of /entry/run is {order} instead of a whole number from 0",
            )
            for order in (-1, 1.5, True)
        ),
        (
            set_attribute("/entry/run", "order", 2 * 10**9),
            "the attribute order of /entry/run is 2e+09, and 1e+09 is the most",
        ),
        (
            set_attribute("/entry/run", "run_id", "seven"),
            "the attribute run_id of the run is 'seven' instead of a UUID",
        ),
        (set_attribute("/entry/run", "backend", ""), "the attribute backend of /entry/run is '' instead of text"),
        (set_attribute("/entry/run", "backend", 7), "the attribute backend of /entry/run is 7 instead of text"),
        (
            set_attribute("/entry/run", "note", np.bytes_(b"a\0b")),
            "the attribute note of /entry/run holds a zero byte",
        ),
        (set_attribute("/entry/run", "x", np.zeros(257)), "the attribute x of /entry/run claims 257 values"),
        (
            set_attribute("/entry/run", "x", np.zeros(1, [("a", "f4")])),
            "the attribute x of /entry/run is neither text nor number",
        ),
        (
            set_attribute("/entry/protocol", "kind", "k" * 65),
            "the attribute kind of /entry/protocol has 65 characters",
        ),
        (
            lose_attribute("/entry/protocol", "speed_mm_s"),
            "/entry/protocol lacks the attribute speed_mm_s, which the kind drag needs",
        ),
        (lose_attribute("/entry/capsule", "mass_g"), "/entry/capsule lacks the attribute mass_g"),
        (
            set_attribute("/entry/trace", "sample_rate_hz", float("nan")),
            "the attribute sample_rate_hz of /entry/trace is nan instead of a positive number",
        ),
        (
            set_attribute("/entry/trace", "sample_rate_hz", 0.0),
            "the attribute sample_rate_hz of /entry/trace is 0.0 instead of a positive number",
        ),
        *(
            (
                set_attribute("/entry/trace", "sample_rate_hz", rate),
                f"the attribute sample_rate_hz of /entry/trace is {rate:g}, and the samples are 0.001 s apart",
            )
            for rate in (2001.0, 499.0)
        ),
        (
            set_attribute("/entry/trace", "signal", "weight"),
            "the attribute signal of /entry/trace is 'weight' instead of one of force, motor_force",
        ),
        (
            set_attribute("/entry/trace/force", "units", "N"),
            "the attribute units of /entry/trace/force is 'N' instead of 'mN'",
        ),
        (lose_attribute("/entry/trace/force", "units"), "/entry/trace/force lacks the attribute units"),
        (
            set_attribute("/entry/trace/phase", "names", ["a", "b"]),
            "the attribute names of /entry/trace/phase is not rest, accelerate, steady, decelerate, hold",
        ),
        (lose_attribute("/entry/trace/phase", "names"), "/entry/trace/phase lacks the attribute names"),
        (
            set_attribute("/entry/specimen", "fixture", "glue"),
            "the attribute fixture of /entry/specimen is 'glue' instead of one of foam, vacuum, none",
        ),
        *(
            (
                set_attribute("/entry/capsule", "mass_g", mass),
                f"the attribute mass_g of /entry/capsule is {mass!r} instead of a number",
            )
            for mass in ("heavy", float("inf"), True)
        ),
        (
            set_attribute("/entry/capsule", "length_mm", -2e6),
            "the attribute length_mm of /entry/capsule is -2e+06, and 1e+06 is the most",
        ),
        (lose_one_time([np.nan, 0.006]), "/entry/trace/time holds NaN or infinity"),
        (lose_one_time([0.006, 0.005]), "/entry/trace/time does not rise from sample to sample"),
        (lose_one_time([0.005, 0.005]), "/entry/trace/time does not rise from sample to sample"),
        (set_values("force", np.zeros(399, "f4")), "/entry/trace/force has 399 samples, /entry/trace/time 400"),
        (set_values("force", np.zeros((400, 2), "f4")), "/entry/trace/force is not a row of samples"),
        (set_values("force", np.zeros(400, "i4")), "/entry/trace/force holds int32 instead of float32 or float64"),
        (set_values("force", np.zeros(400, "f2")), "/entry/trace/force holds float16 instead of float32 or float64"),
        (set_values("force", np.full(400, 1.1e9, "f4")), "/entry/trace/force holds values beyond 1e+09"),
        (set_values("force", np.full(400, -1.1e9, "f4")), "/entry/trace/force holds values beyond 1e+09"),
        (set_values("phase", np.full(400, 9, "u1")), "/entry/trace/phase holds 9, above 4"),
        (set_values("phase", np.full(400, 5, "u1")), "/entry/trace/phase holds 5, above 4"),
        (set_values("phase", np.zeros(400, "i8")), "/entry/trace/phase holds int64 instead of uint8"),
        (set_values("position", "text"), "/entry/trace/position is not a row of samples"),
        (put("/entry/trace/motor_force"), "/entry/trace/motor_force is not a row of samples"),
        (put("/entry/trace/time"), "the dataset /entry/trace/time is missing"),
        (put("/entry/trace", data=1.0), "the group /entry/trace is missing"),
        *(
            (put("/entry/run/events", data=data), "/entry/run/events is not a table of time_s, kind, message")
            for data in (np.zeros(3), np.zeros((2, 2), EVENT_TYPE))
        ),
        (put("/entry/run/settings", data=np.zeros(2)), "/entry/run/settings is not a single text"),
        (put("/entry/filtered", data=1.0), "the group /entry/filtered is missing"),
        (put("/entry/filtered/x"), "/entry/filtered/x is not a row of numbers"),
        *(
            (filter_with(time=np.arange(3.0), force=force), "/entry/filtered/force is not a row of numbers")
            for force in (np.zeros(3, "i4"), np.zeros((3, 1)))
        ),
        (filter_with(force=np.zeros(3)), "the dataset /entry/filtered/time is missing"),
        (
            filter_with(time=np.arange(3.0), force=np.zeros(4)),
            "the datasets of /entry/filtered differ in length",
        ),
    ],
)
def test_what_breaks_the_format_is_named(tmp_path: Path, change: Callable[[h5py.File], None], sentence: str) -> None:
    path = whole(tmp_path / "run.h5")
    with h5py.File(path, "r+") as file:
        change(file)
    assert refused(path) == (
        f"{path}: {sentence}; this is not a whole run file, restore it from a copy or bring the data in with "
        "`dragrig import`"
    )


def test_a_newer_format_asks_for_a_newer_program(tmp_path: Path) -> None:
    path = whole(tmp_path / "run.h5")
    with h5py.File(path, "r+") as file:
        file["/entry/run"].attrs["format_version"] = 3
    assert refused(path) == f"{path}: has format_version 3; this dragrig reads versions up to 2, install a newer one"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_attribute("/entry/run", "order", 10**9), ""),
        (set_attribute("/entry/capsule", "length_mm", 1e6), ""),
        (set_attribute("/entry/capsule", "mass_g", 50), ""),
        (set_attribute("/entry/capsule", "mass_g", float("nan")), ""),
        (set_attribute("/entry/run", "x", np.zeros(256)), ""),
        (set_attribute("/entry/protocol", "kind", "k" * 64), ""),
        (set_attribute("/entry/trace", "sample_rate_hz", 1999.0), ""),
        (set_attribute("/entry/trace", "sample_rate_hz", 501.0), ""),
        (set_values("force", np.full(400, 0.9e9, "f4")), ""),
        (set_values("force", np.full(400, np.nan, "f4")), ""),
        (set_values("phase", np.full(400, 4, "u1")), ""),
        (put("/entry/trace/odd", data=np.full(400, 1e30)), "units"),
    ],
)
def test_what_only_just_fits_is_read(tmp_path: Path, change: Callable[[h5py.File], None], message: str) -> None:
    path = whole(tmp_path / "run.h5")
    with h5py.File(path, "r+") as file:
        change(file)
    if message:
        assert message in refused(path)
    else:
        assert read_run(path).info.samples == 400


def test_attributes_become_plain_values_and_lists_text(tmp_path: Path) -> None:
    path = whole(tmp_path / "run.h5")
    given: dict[str, object] = {
        "one": np.array([7]), "list": np.array([1.5, 2.0]), "words": ["a", "µ"], "bytes": np.bytes_(b"ab\xff"),
        "truth": True, "nothing": h5py.Empty("f"), "empty": np.zeros(0), "whole": np.uint8(3), "none": "",
    }  # fmt: skip
    with h5py.File(path, "r+") as file:
        file["/entry/run"].attrs.update(given)
    entry = read_info(path).header.entry
    assert {name: entry[name] for name in given} == {
        "one": 7, "list": "1.5, 2.0", "words": "a, µ", "bytes": "ab\ufffd", "truth": True, "nothing": "", "empty": "",
        "whole": 3,
        "none": "",
    }  # fmt: skip
    assert type(entry["truth"]) is bool
    assert type(entry["whole"]) is int


def test_the_tail_of_a_run_counts_all_of_it(tmp_path: Path) -> None:
    path = whole(tmp_path / "run.h5")
    for duration_s, samples in ((0.1, 100), (0.0004, 1), (9.0, 400)):
        tail = read_tail(path, duration_s)
        assert tail.info.samples == 400
        np.testing.assert_array_equal(tail.trace.time, arrays(400 - samples, samples)["time"])
        np.testing.assert_array_equal(tail.trace.force, arrays(400 - samples, samples)["force"])
    assert [event.kind for event in tail.events] == ["phase"]


@pytest.mark.parametrize(("counted", "samples"), [(250, 250), (-3, 0), (500, 400), (None, 400)])
def test_a_recording_is_read_as_far_as_it_says_it_is_valid(tmp_path: Path, counted: int | None, samples: int) -> None:
    path = whole(tmp_path / "run.h5")
    with h5py.File(path, "r+") as file:
        file["/entry/run"].attrs["status"] = "recording"
        if counted is not None:
            file["/entry/run/valid_samples"] = [counted]
            file["/entry/run/valid_events"] = np.array([0])
    run = read_run(path)
    assert (run.info.samples, len(run.trace.time), len(run.trace.force)) == (samples,) * 3
    assert len(run.events) == (1 if counted is None else 0)


@pytest.mark.parametrize("count", [np.zeros(2, "i4"), 1.0])
def test_a_recording_that_counts_badly_is_refused(tmp_path: Path, count: object) -> None:
    path = whole(tmp_path / "run.h5")
    with h5py.File(path, "r+") as file:
        file["/entry/run"].attrs["status"] = "recording"
        file["/entry/run/valid_samples"] = count
    assert "/entry/run/valid_samples is not a count;" in refused(path)


def test_a_filtered_trace_comes_back_with_its_units_and_parameters(tmp_path: Path) -> None:
    path = whole(tmp_path / "run.h5")
    stored = FilteredTrace(
        time=np.arange(400) / 1000, channels={"force": np.arange(400.0)}, parameters={"window_s": 0.04, "order": 2},
        units={"force": "mN"},
    )  # fmt: skip
    store_filtered(path, stored)
    found = read_run(path).filtered
    assert found is not None
    assert (found.units, dict(found.parameters)) == ({"force": "mN"}, {"window_s": 0.04, "order": 2})
    for values, given_values in ((found.time, stored.time), (found.channels["force"], stored.channels["force"])):
        np.testing.assert_array_equal(values, given_values)
    assert not found.channels["force"].flags.writeable


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
        write_run(path, header(), arrays(0, 400))
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
        write_run(tmp_path / "missing" / "run.h5", header(), arrays(0, 400))


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


def test_a_missing_attribute_of_the_first_format_is_named_where_it_was(tmp_path: Path) -> None:
    path = as_version_1(whole(tmp_path / "run.h5"))
    with h5py.File(path, "r+") as file:
        del file["/entry"].attrs["run_id"]
    assert refused(path).startswith(f"{path}: /entry lacks the attribute run_id;")


def test_a_slow_run_is_read_with_its_units(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run.h5", header(rate_hz=0.5), arrays(0, 10, rate_hz=0.5))
    trace = read_run(path).trace
    assert trace.sample_rate_hz == 0.5
    assert trace.units == {"time": "s", "command": "mm", "force": "mN", "position": "mm", "motor_force": "mN"}
