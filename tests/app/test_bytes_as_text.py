"""Bytes that are no UTF-8: a file may be called so, and no text may be made of it; each is said in one sentence."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import click
import h5py
import numpy as np
import pytest

import dragrig
from dragrig.cli import main
from dragrig.cli.commands import LazyGroup, TypedText, dragrig_group
from dragrig.cli.console import run_command_line
from dragrig.config import Settings
from dragrig.config.errors import DragrigError, OutputError, RunFileError, SettingsError
from dragrig.rig import mark_bad, write_run
from dragrig.rig.runfile import read_info, read_run
from dragrig.rig.runfile.campaigns import write_note
from places import DATA
from property_tests import thorough

BYTES = b"k\xe4".decode("utf-8", "surrogateescape")
FOREIGN_MAP = ("--map", "time=Time", "--map", "force=Force", "--map", "position=Position")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a campaign, one run and one table whose names are no UTF-8."""
    monkeypatch.chdir(tmp_path)
    campaign = tmp_path / f"c{BYTES}"
    try:
        shutil.copytree(DATA / "campaign", campaign)
    except (OSError, UnicodeError):
        pytest.skip("this system allows no such names")
    shutil.copy(DATA / "campaign" / "014-drag.h5", campaign / f"{BYTES}.h5")
    shutil.copy(DATA / "foreign" / "every-across-gap.csv", tmp_path / f"{BYTES}.csv")
    return tmp_path


def commands(group: click.Group, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    context = click.Context(group)
    for name in group.list_commands(context):
        found = group.get_command(context, name)
        assert found is not None
        if isinstance(found, click.Group):
            yield from commands(found, (*words, name))
        else:
            yield (*words, name), found


def typed_texts() -> Iterator[tuple[str, ...]]:
    for words, found in commands(dragrig_group):
        for parameter in found.params:
            if isinstance(parameter.type, click.types.StringParamType):
                yield (*words, *parameter.opts[:1]) if isinstance(parameter, click.Option) else words


@pytest.mark.parametrize("words", sorted(set(typed_texts())), ids=" ".join)
def test_every_text_that_is_typed_is_refused_in_one_sentence(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, BYTES, BYTES]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1, said
    assert "'k\\udce4' names no file, and holds bytes that are no UTF-8; type it anew" in said


def test_all_commands_take_texts_by_one_type() -> None:
    kinds = {
        type(parameter.type)
        for _, found in commands(dragrig_group)
        for parameter in found.params
        if isinstance(parameter.type, click.types.StringParamType)
    }
    assert kinds == {TypedText}
    assert isinstance(dragrig_group, LazyGroup)


@pytest.mark.parametrize(
    "words",
    [
        ("import", f"{BYTES}.csv", *FOREIGN_MAP),
        ("mark", f"c{BYTES}/{BYTES}.h5", "--note", "blew over", "--bad", "slipped"),
        ("filter", f"c{BYTES}/{BYTES}.h5"),
        ("export", f"c{BYTES}/{BYTES}.h5", "--format", "mat", "--out", f"x{BYTES}"),
        thorough(("export", f"c{BYTES}", "--format", "eln", "--out", f"x{BYTES}")),
        ("info", f"c{BYTES}", "--json"),
        ("info", f"*{BYTES}/*{BYTES}.h5"),
        ("list", "."),
        ("list", ".", "--json"),
        ("find", "."),
        ("table", f"c{BYTES}"),
        ("table", f"c{BYTES}", "--json"),
        thorough(("compare", f"c{BYTES}/{BYTES}.h5", f"c{BYTES}/014-drag.h5", "--out", f"cmp{BYTES}")),
        thorough(("identify", f"c{BYTES}", "--out", f"i{BYTES}")),
        ("report", f"c{BYTES}/{BYTES}.h5", "--out", f"r{BYTES}"),
        ("watch", f"c{BYTES}", "--once"),
        ("recover", f"c{BYTES}"),
        ("init", f"lab{BYTES}"),
    ],
    ids=lambda words: ascii(" ".join(words)),
)
def test_files_of_such_names_are_worked_on(
    folder: Path, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 0, ascii(capsys.readouterr().err)


def test_an_imported_run_says_in_text_what_file_it_was(folder: Path) -> None:
    dragrig.import_run(folder / f"{BYTES}.csv", folder / "back.h5", columns={"time": "Time", "force": "Force"})
    header = read_info(folder / "back.h5").header
    assert header.entry["import_source"] == "k\\udce4.csv"
    assert header.specimen["name"] == "k\\udce4"


def test_a_text_that_is_taken_for_the_name_of_a_file_is_refused_when_it_is_stored(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A note may be spelt as a file that is there, or with a star."""
    for note in (f"{BYTES}.csv", f"*{BYTES}"):
        assert main(["mark", f"c{BYTES}/014-drag.h5", "--note", note]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert "cannot be written, as the text holds bytes that are no UTF-8" in said
    assert not list(folder.rglob("*.note.txt*"))


def test_what_no_command_foresaw_is_one_sentence_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    class Name(Settings):
        name: str

    for unforeseen in (lambda: (tmp_path / "a").write_text(BYTES, "utf-8"), lambda: Name(name=BYTES)):
        assert run_command_line(click.Command("c", callback=unforeseen), []) == 2
        assert "'k\\udce4' holds bytes that are no UTF-8" in capsys.readouterr().err
    assert run_command_line(click.Command("c", callback=lambda: "µ".encode("ascii")), []) == 1, "a bug as any other"


def test_python_refuses_texts_before_anything_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["init", "lab"]) == 0
    monkeypatch.chdir(tmp_path / "lab")
    made = set((tmp_path / "lab").rglob("*"))
    calls = (
        lambda: dragrig.run("drag", backend="simulated", operator=BYTES),
        lambda: dragrig.run("drag", backend="simulated", note=BYTES),
        lambda: dragrig.touch_off(5.0, backend="simulated", operator=BYTES),
        lambda: dragrig.calibrate_force([0, 10, 20], backend="simulated", operator=BYTES),
        lambda: dragrig.calibrate_encoder(10.0, backend="simulated", note=BYTES),
    )
    for call in calls:
        with pytest.raises(SettingsError, match="holds bytes that are no UTF-8; type it anew"):
            call()
    assert set((tmp_path / "lab").rglob("*")) == made


def test_marks_notes_and_runs_of_such_texts_are_not_written(tmp_path: Path) -> None:
    path = Path(shutil.copy(DATA / "campaign" / "014-drag.h5", tmp_path))
    run = read_run(path)
    header = replace(run.info.header, entry={**run.info.header.entry, "note": BYTES})
    columns = {"time": run.trace.time, "command": run.trace.command, "phase": run.trace.phase, **run.trace.channels}
    attempts: tuple[tuple[type[DragrigError], object], ...] = (
        (OutputError, lambda: mark_bad(path, BYTES)),
        (OutputError, lambda: write_note(path, BYTES)),
        (RunFileError, lambda: write_run(tmp_path / "a.h5", header, columns)),
    )
    for error, attempt in attempts:
        assert callable(attempt)
        with pytest.raises(error, match="holds bytes that are no UTF-8"):
            attempt()
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_texts_in_a_run_file_that_are_no_utf8_are_read_as_far_as_they_are(tmp_path: Path) -> None:
    path = Path(shutil.copy(DATA / "campaign" / "014-drag.h5", tmp_path))
    with h5py.File(path, "r+") as file:
        file["entry"].attrs.create("note", b"gr\xfc\xdf dich", dtype=h5py.string_dtype("utf-8"))
    note = str(read_info(path).header.entry["note"])
    assert note.encode("utf-8").decode().startswith("gr")
    assert note.endswith(" dich")
    with h5py.File(path, "r+") as file:
        trace = file["entry/trace"]
        trace.create_dataset(b"k\xe4", data=np.zeros(len(trace["time"]))).attrs["units"] = "V"
    with pytest.raises(RunFileError, match=r"the name b'k\\xe4' in /entry/trace is no UTF-8"):
        read_info(path)
