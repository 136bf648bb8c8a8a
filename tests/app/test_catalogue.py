"""The catalogue of a lab's runs: it answers as the run files do, whatever happens to them, to it, or to its process."""

import json
import os
import shutil
import sqlite3
import subprocess
import sys
import tracemalloc
import zlib
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import h5py
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dragrig import catalogue, run_listing
from dragrig.analysis.savgol import filter_file
from dragrig.catalogue import ask_runs
from dragrig.cli import main
from dragrig.config import RunFileError
from dragrig.rig import mark_bad, unmark
from dragrig.run_listing import FileListing, RunListing, RunQuery
from places import CAMPAIGN
from property_tests import examples, thorough

PRACTICE = sorted(CAMPAIGN.glob("*.h5"))
KEPT = {
    f"{folder}/{next(path.name for path in PRACTICE if kind in path.name)}"
    for folder, kinds in {"first": ("drag", "relaxation"), "second": ("blank", "coulomb")}.items()
    for kind in kinds
}
QUERIES = (
    RunQuery(),
    RunQuery(kind="drag"),
    RunQuery(kind="sentinel"),
    RunQuery(specimen="jejunum"),
    RunQuery(specimen="P7", kind="drag", marked=False),
    RunQuery(operator="åS"),
    RunQuery(marked=True),
    RunQuery(since=datetime(2026, 5, 4, 9, 9, tzinfo=UTC)),
    RunQuery(until=datetime(2026, 5, 4, 9, 9, tzinfo=UTC)),
    RunQuery(kind="' OR 1 --"),
)


@pytest.fixture
def settled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let files count as settled at once, as they do seconds later; tests write none twice in a tick of the clock."""
    monkeypatch.setattr(run_listing, "SETTLING_S", 0.0)


def make_lab(folder: Path, *campaigns: str) -> Path:
    """Make a lab and return its data root."""
    (folder / "runs").mkdir(parents=True)
    (folder / "rig.toml").write_text("", "utf-8")
    for name in campaigns:
        shutil.copytree(PRACTICE[0].parent, folder / "runs" / name)
    return folder / "runs"


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A lab of two campaigns of two runs, of four kinds."""
    made = make_lab(tmp_path / "lab", "first", "second")
    for path in made.rglob("*.h5"):
        if f"{path.parent.name}/{path.name}" not in KEPT:
            path.unlink()
    monkeypatch.chdir(made.parent)
    return made


@pytest.fixture
def small_root(root: Path) -> Path:
    """A lab of one campaign of one run."""
    shutil.rmtree(root / "second")
    for path in sorted(root.rglob("*.h5"))[1:]:
        path.unlink()
    return root


def catalogue_of(root: Path) -> Path:
    return root.with_name(f"{root.name}.catalogue.sqlite")


def answers(listing: RunListing) -> tuple[object, ...]:
    """Everything that can be asked."""
    found = [listing.found(query) for query in QUERIES]
    summaries = [(summary, list(summary.kinds)) for summary in listing.summaries()]
    return listing.folders(), listing.folders(with_files=True), summaries, found, listing.kinds()


def contents(listing: RunListing) -> tuple[object, ...]:
    campaign = listing.campaign()
    unreadable = [(path, str(error)) for path, error in campaign.unreadable]
    return campaign.folder, campaign.runs, dict(campaign.marks), unreadable, campaign.recordings


def remarks_on(folder: Path) -> list[str]:
    """Compare the answers of the catalogue with those of the run files; return what it remarked."""
    remarks: list[str] = []
    assert ask_runs(folder, answers, remark=remarks.append) == answers(FileListing(folder))
    for campaign in FileListing(folder).folders():
        assert ask_runs(campaign, contents, remark=remarks.append) == contents(FileListing(campaign))
    return remarks


def set_attribute(path: Path, group: str, name: str, value: object) -> None:
    with h5py.File(path, "r+") as file:
        file[group].attrs[name] = value


def overwrite_in_place(path: Path) -> None:
    """Give a file another content of the same size and dates, as a copy does that keeps dates."""
    dates, size = path.stat(), path.stat().st_size
    with h5py.File(path, "r+") as file:
        file["entry/protocol"].attrs.modify("kind", "drug")
    assert path.stat().st_size == size
    os.utime(path, ns=(dates.st_atime_ns, dates.st_mtime_ns))


def replace_by_same_size(path: Path) -> None:
    part = Path(shutil.copy2(path, path.with_suffix(".part")))
    with h5py.File(part, "r+") as file:
        file["entry/protocol"].attrs.modify("kind", "drug")
    assert part.stat().st_size == path.stat().st_size
    part.replace(path)


def make_sentinel(path: Path) -> None:
    holder = "entry/run" if "run" in h5py.File(path)["entry"] else "entry"
    set_attribute(path, holder, "role", "sentinel")
    set_attribute(path, holder, "operator", "Åsa \x1b[31m")
    set_attribute(path, "entry/specimen", "id", "P7")


Change = Callable[[Path], object]
RUN_CHANGES: dict[str, Change] = {
    "marked": lambda path: mark_bad(path, "slipped \x1b[31m"),
    "unmarked": unmark,
    "mark unreadable": lambda path: path.with_suffix(".mark.toml").write_text("bad", "utf-8"),
    "filtered": filter_file,
    "removed": Path.unlink,
    "renamed": lambda path: path.rename(path.with_name(f"again-{path.name}")),
    "sentinel": make_sentinel,
    "overwritten": overwrite_in_place,
    "replaced": replace_by_same_size,
    "damaged": lambda path: path.write_bytes(b"no run"),
    "added": lambda path: shutil.copy(path, path.with_name("new.h5")),
    "recording": lambda path: path.with_name("x.recording.h5").write_bytes(b""),
    "recovered": lambda path: path.with_name("x.recording.h5").unlink(missing_ok=True),
    "folder like a run": lambda path: path.with_name("x.h5").mkdir(exist_ok=True),
    "link to nothing": lambda path: path.with_name("gone.h5").symlink_to("nowhere"),
}
FOLDER_CHANGES: dict[str, Change] = {
    "folder renamed": lambda folder: folder.rename(folder.with_name(f"r-{folder.name}")),
    "folder moved": lambda folder: shutil.move(folder, folder.parent / "in" / "side"),
    "folder copied": lambda folder: shutil.copytree(folder, folder.parent / "copy", symlinks=True),
    "folder removed": shutil.rmtree,
    "session": lambda folder: (
        (folder.parent / "empty").mkdir() or (folder.parent / "empty" / "session-1.toml").write_text("", "utf-8")
    ),
    "no run": lambda folder: (folder / "notes.txt").write_text("", "utf-8"),
}

SEEN_IN_THE_LINE = (
    "marked", "removed", "renamed", "overwritten", "replaced", "added", "recording", "folder renamed", "folder copied"
)  # fmt: skip
"""The others are among the properties' examples too."""


def change(root: Path, what: str, place: int) -> None:
    """Change a run or a campaign in a way that may not be possible, for what it needs may be gone."""
    campaigns = [folder for folder in FileListing(root).folders() if folder.is_relative_to(root)]
    try:
        folder = campaigns[place % len(campaigns)]
        if what in FOLDER_CHANGES:
            FOLDER_CHANGES[what](folder)
        else:
            runs = sorted(path for path in folder.glob("*.h5") if path.is_file())
            RUN_CHANGES[what](runs[place % len(runs)])
    except (OSError, RunFileError, KeyError, AssertionError, ZeroDivisionError, shutil.Error):
        pass


@settings(max_examples=examples(5), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    changes=st.lists(
        st.tuples(st.sampled_from([*RUN_CHANGES, *FOLDER_CHANGES]), st.integers(0, 99)), min_size=1, max_size=4
    )
)
def test_whatever_changes_the_catalogue_answers_as_the_files(
    changes: list[tuple[str, int]], tmp_path_factory: pytest.TempPathFactory, settled: None
) -> None:
    del settled
    root = make_lab(tmp_path_factory.mktemp("lab"), "first")
    for path in PRACTICE[2:]:
        (root / "first" / path.name).unlink()
    assert remarks_on(root) == []
    for what, place in changes:
        change(root, what, place)
        assert remarks_on(root) == []
    assert catalogue_of(root).exists()


@pytest.mark.parametrize(
    "what", [what if what in SEEN_IN_THE_LINE else thorough(what) for what in (*RUN_CHANGES, *FOLDER_CHANGES)]
)
def test_every_change_is_seen(what: str, small_root: Path, settled: None) -> None:
    del settled
    if what == "overwritten" and sys.platform == "win32":
        pytest.skip("there nothing but its dates and size, which are the same, tells that a file was written to")
    remarks_on(small_root)
    before = answers(FileListing(small_root))
    change(small_root, what, 0)
    unseen = {"unmarked", "filtered", "recovered", "no run", "recording"}
    assert answers(FileListing(small_root)) != before or what in unseen
    assert remarks_on(small_root) == []


def spoil(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[4096:] = os.urandom(len(content) - 4096)
    file.write_bytes(content)


def alter(*statements: str) -> Change:
    def change_file(file: Path) -> None:
        connection = sqlite3.connect(file)
        for statement in statements:
            connection.execute(statement)
        connection.commit()
        connection.close()

    return change_file


def reword(change_content: Callable[[dict[str, Any]], object], *, files: int | None = None) -> Change:
    """Change what is known of each campaign."""

    def change_file(file: Path) -> None:
        with closing(sqlite3.connect(file)) as connection, connection:
            for id_, packed in connection.execute(
                "SELECT id, content FROM folder WHERE content IS NOT NULL"
            ).fetchall():
                content = json.loads(zlib.decompress(packed))
                changed = change_content(content)
                text = changed if isinstance(changed, bytes) else json.dumps(content).encode()
                connection.execute("UPDATE folder SET content = ? WHERE id = ?", (zlib.compress(text, 1), id_))
                if files is not None:
                    connection.execute("UPDATE folder SET files = ?", (files,))

    return change_file


def in_header(name: str, value: object) -> Change:
    return reword(lambda content: content[1][0][1]["header"].update({name: value}))


UNPACKED = 60 << 20


@pytest.mark.parametrize(
    "damage",
    [
        reword(lambda content: content[1][0][1].update(header=None)),
        thorough(in_header("specimen", None)),
        in_header("specimen", {"name": "jejunum"}),
        thorough(in_header("entry", {"operator": {"first": "A."}})),
        in_header("sample_rate_hz", "fast"),
        thorough(in_header("settings_toml", 7)),
        in_header("channels", [[1, 2, 3]]),
        thorough(in_header("start_time", "2026-05-04T09:00:00")),
        thorough(reword(lambda content: content[1][0][1].update(samples="many"))),
        reword(lambda content: content[0].append(None)),
        thorough(reword(lambda content: content.__setitem__(2, {"x": 1}))),
        reword(lambda _: b"[" * 100_000 + b"]" * 100_000),
        alter("UPDATE folder SET summary = '" + "[" * 100_000 + "'"),
        thorough(reword(lambda _: bytes(UNPACKED))),
        reword(lambda _: b"[" + b"[]," * (UNPACKED // 3) + b"1]", files=10**9),
        alter("UPDATE folder SET files = 'x'"),
    ],
    ids=["no header", "no specimen", "half a specimen", "entry", "rate", "settings", "channels", "no zone", "samples",
         "name", "error", "deep", "deep summary", "bomb", "bomb that says so", "files"],
)  # fmt: skip
def test_a_catalogue_that_somebody_reworded_is_made_again(
    damage: Change, small_root: Path, settled: None, capsys: pytest.CaptureFixture[str]
) -> None:
    del settled
    remarks_on(small_root)
    damage(catalogue_of(small_root))
    tracemalloc.start()
    try:
        remarks = remarks_on(small_root)
        assert tracemalloc.get_traced_memory()[1] < UNPACKED // 2
    finally:
        tracemalloc.stop()
    assert ["was damaged; it is made again" in remark for remark in remarks] == [True]
    assert remarks_on(small_root) == []
    assert main(["list", str(small_root)]) == 0
    assert "bug" not in capsys.readouterr().err


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.write_bytes(b"no database"),
        spoil,
        lambda file: os.truncate(file, file.stat().st_size // 2),
        alter("UPDATE folder SET content = x'00'", "UPDATE folder SET state = ''"),
        alter("UPDATE folder SET summary = '[1]'"),
        alter("DROP TABLE run", "CREATE VIEW run AS SELECT 1 AS folder, 2 AS place, x'41' AS name"),
    ],
    ids=["foreign", "garbage", "cut", "content", "summary", "view"],
)
def test_a_damaged_catalogue_is_made_again_and_said_once(damage: Change, small_root: Path, settled: None) -> None:
    del settled
    remarks_on(small_root)
    damage(catalogue_of(small_root))
    (remark,) = remarks_on(small_root)
    assert "was damaged; it is made again" in remark
    assert remarks_on(small_root) == []


@pytest.mark.parametrize(
    ("become", "why"),
    [
        (alter("PRAGMA user_version = 99"), "newer dragrig"),
        (alter("PRAGMA application_id = 7"), "another program"),
        (lambda file: (file.unlink(), file.mkdir()), "cannot be used"),
    ],
    ids=["newer", "other", "folder"],
)
def test_what_is_not_ours_is_left_alone_and_the_files_answer(become: Change, why: str, root: Path) -> None:
    ask_runs(root, answers)
    file = catalogue_of(root)
    become(file)
    before = file.read_bytes() if file.is_file() else b""
    remarks: list[str] = []
    assert ask_runs(root, answers, remark=remarks.append) == answers(FileListing(root))
    assert len(remarks) == 1
    assert why in remarks[0]
    assert (file.read_bytes() if file.is_file() else b"") == before


def test_a_catalogue_that_may_not_be_written_still_answers(
    root: Path, settled: None, close_folder: Callable[[Path], None]
) -> None:
    del settled
    remarks_on(root)
    mark_bad(next((root / "first").glob("*.h5")), "slipped")
    close_folder(root.parent)
    remarks: list[str] = []
    assert ask_runs(root, answers, remark=remarks.append) == answers(FileListing(root))
    (remark,) = remarks
    assert "cannot be written" in remark


def test_outside_of_a_lab_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(PRACTICE[0].parent, tmp_path / "runs" / "a")
    assert main(["list", "runs"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_writer_that_never_ends_is_not_waited_for_without_end(
    root: Path, settled: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    del settled
    remarks_on(root)
    monkeypatch.setattr(catalogue, "BUSY_S", 0.05)
    other = sqlite3.connect(catalogue_of(root), isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    mark_bad(next((root / "first").glob("*.h5")), "slipped")
    remarks: list[str] = []
    answered = ask_runs(root, answers, remark=remarks.append)
    assert answered == answers(FileListing(root))
    (remark,) = remarks
    assert "cannot be written (database is locked)" in remark
    other.close()


_REBUILD = """
import sys
from dragrig import catalogue, run_listing
catalogue.BATCH_S = run_listing.SETTLING_S = 0.0
from pathlib import Path
def progress(done, of):
    print(done, flush=True)
    if done:
        sys.stdin.readline()
catalogue.ask_runs(Path(sys.argv[1]), lambda listing: None, progress=progress, rebuild=True)
"""


def test_a_rebuild_killed_in_the_midst_costs_nothing_but_time(root: Path, settled: None) -> None:
    del settled
    remarks_on(root)
    words = [sys.executable, "-c", _REBUILD, str(root)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        while process.stdout.readline().strip() in {b"0"}:
            pass
        process.kill()
    assert remarks_on(root) == []


def test_an_unknown_kind_names_those_that_there_are(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["find", str(root), "--kind", "drga"]) == 0
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err == "0 runs: no run is of the kind drga; did you mean drag?\n"
    assert main(["find", str(root), "--kind", "drag", "--specimen", "Jejunmu"]) == 0
    assert capsys.readouterr().err == "0 runs: no run is of the specimen Jejunmu; did you mean jejunum?\n"
    assert main(["find", str(root), "--specimen", "JEJUNUM", "--kind", "relaxation", "--until", "2000-01-01"]) == 0
    assert capsys.readouterr().err == "0 runs\n"


def test_list_rebuilds_the_catalogue(root: Path, settled: None) -> None:
    del settled
    remarks_on(root)
    alter("UPDATE run SET name = x'41'")(catalogue_of(root))
    # Nothing has changed that would be read again.
    assert ask_runs(root, answers) != answers(FileListing(root))
    assert main(["list", "--rebuild"]) == 0
    assert remarks_on(root) == []


def test_find_prints_the_folders_of_the_campaigns_with_such_runs(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["find", str(root), "--kind", "relaxation", "--campaigns", "--quiet"]) == 0
    folders = capsys.readouterr().out.splitlines()
    assert main(["find", str(root), "--kind", "relaxation", "--quiet"]) == 0
    assert folders == list(dict.fromkeys(str(Path(run).parent) for run in capsys.readouterr().out.splitlines()))
    assert folders
