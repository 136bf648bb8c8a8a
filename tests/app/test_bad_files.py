"""Files that are no run files, or no longer: every command says so in one sentence and touches nothing."""

import shutil
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from dragrig.cli import main
from places import CAMPAIGN

GOOD = CAMPAIGN / "010-drag.h5"


def truncated(path: Path) -> None:
    path.write_bytes(GOOD.read_bytes()[: GOOD.stat().st_size // 2])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def text(path: Path) -> None:
    path.write_text("time,force\n0,1\n", "utf-8")


def foreign(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["data"] = [1.0, 2.0]


def newer(path: Path) -> None:
    shutil.copy(GOOD, path)
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 99


def without_force(path: Path) -> None:
    shutil.copy(GOOD, path)
    with h5py.File(path, "r+") as file:
        del file["entry/trace/force"]


def without_kind(path: Path) -> None:
    shutil.copy(GOOD, path)
    with h5py.File(path, "r+") as file:
        del file["entry/protocol"].attrs["kind"]


def with_attribute(group: str, name: str, value: float | str) -> Callable[[Path], None]:
    def spoil(path: Path) -> None:
        shutil.copy(GOOD, path)
        with h5py.File(path, "r+") as file:
            file[group].attrs[name] = value

    return spoil


def with_infinite_force(path: Path) -> None:
    shutil.copy(GOOD, path)
    with h5py.File(path, "r+") as file:
        file["entry/trace/force"][5] = np.inf


def with_a_ring_of_links(path: Path) -> None:
    shutil.copy(GOOD, path)
    with h5py.File(path, "r+") as file:
        file["entry/trace/ring"] = h5py.SoftLink("/entry/trace/ring")


def with_gigabytes_of_zeros(path: Path) -> None:
    shutil.copy(GOOD, path)
    samples, chunk = 1 << 27, 1 << 18
    with h5py.File(path, "r+") as file:
        trace = file["entry/trace"]
        for name in list(trace):
            attributes, dtype = dict(trace[name].attrs), trace[name].dtype
            del trace[name]
            made = trace.create_dataset(name, (samples,), dtype, chunks=(chunk,), compression="gzip")
            made.attrs.update({key: value for key, value in attributes.items() if not key.isupper()})
            packed = zlib.compress(bytes(chunk * dtype.itemsize))
            for first in range(0, samples, chunk):
                made.id.write_direct_chunk((first,), packed)


def with_many_settings(path: Path) -> None:
    shutil.copy(GOOD, path)
    with h5py.File(path, "r+") as file:
        if "entry/settings" in file:
            del file["entry/settings"]
        file["entry"].create_dataset("settings", (1 << 33,), h5py.string_dtype(), chunks=(1024,))


SPOILT: dict[str, tuple[Callable[[Path], None], str]] = {
    "truncated": (truncated, "bad.h5"),
    "empty": (empty, "bad.h5"),
    "text": (text, "bad.h5"),
    "foreign": (foreign, "dragrig import"),
    "newer": (newer, "99"),
    "without force": (without_force, "force"),
    "without kind": (without_kind, "kind"),
    "rate of 1e300": (with_attribute("entry/trace", "sample_rate_hz", 1e300), "sample_rate_hz"),
    "speed of −2⁶³": (with_attribute("entry/protocol", "speed_mm_s", -(2**63)), "speed_mm_s"),
    "dwell of years": (with_attribute("entry", "insertion_dwell_s", 1e9), "insertion_dwell_s"),
    "long kind": (with_attribute("entry/protocol", "kind", "k" * 60_000), "60000 characters"),
    "ring of links": (with_a_ring_of_links, "ring"),
    "gigabytes of zeros": (with_gigabytes_of_zeros, "/entry/trace claims"),
    "settings without end": (with_many_settings, "is not a single text"),
}
COMMANDS = [
    ["info", "bad.h5"],
    ["info", "bad.h5", "--verify"],
    ["filter", "bad.h5"],
    ["export", "bad.h5"],
    ["show", "bad.h5"],
    ["mark", "bad.h5", "--bad", "broken"],
]


@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
@pytest.mark.parametrize("spoilt", SPOILT)
def test_a_file_that_is_no_run_is_reported_and_left_alone(
    spoilt: str,
    arguments: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    spoil, words = SPOILT[spoilt]
    spoil(tmp_path / "bad.h5")
    before = (tmp_path / "bad.h5").read_bytes()
    assert main(arguments) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert output.err.count("\n") == 1, output.err
    assert "bad.h5" in output.err
    assert words in output.err
    assert (tmp_path / "bad.h5").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["bad.h5"]


@pytest.mark.parametrize("command", ["filter", "export", "show"])
def test_samples_that_no_rig_gives_are_refused_by_whoever_computes_with_them(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with_infinite_force(tmp_path / "bad.h5")
    assert main([command, "bad.h5"]) == 2
    assert "force holds values beyond" in capsys.readouterr().err


@pytest.mark.parametrize("spoilt", SPOILT)
def test_a_table_shows_the_good_runs_and_what_is_wrong_with_the_others(
    spoilt: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    spoil, _ = SPOILT[spoilt]
    spoil(tmp_path / "bad.h5")
    shutil.copy(GOOD, tmp_path / "good.h5")
    assert main(["table", "."]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.startswith("good.h5") and "complete" in line for line in lines)
    assert any(line.startswith("bad.h5") and "unreadable" in line for line in lines)


@pytest.mark.parametrize(
    "arguments",
    [
        ["export", "good.h5", "--out", "{}"],
        ["show", "good.h5", "--out", "{}"],
        ["run", "drag", "--yes", "--out", "{}"],
        ["demo", "--out", "{}"],
        ["init", "{}"],
    ],
    ids=lambda words: words[0],
)
@pytest.mark.parametrize("place", ["taken", "taken/below"])
def test_a_place_that_cannot_be_written_is_reported(
    place: str,
    arguments: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(GOOD, tmp_path / "good.h5")
    (tmp_path / "taken").write_text("mine", "utf-8")
    assert main([word.format(place) for word in arguments]) == 2
    answer = capsys.readouterr().err.splitlines()[-1]
    assert answer.startswith("dragrig: ")
    assert "taken" in answer
    assert (tmp_path / "taken").read_text("utf-8") == "mine"
