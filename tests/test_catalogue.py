"""The catalogue of a lab's runs: it answers as the run files do, whatever happens to them, to it, and to its process."""

import os
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import h5py
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dragrig import catalogue
from dragrig.analysis.savgol import filter_file
from dragrig.catalogue import FileListing, RunListing, RunQuery, ask_runs
from dragrig.config import RunFileError
from dragrig.rig.runfile import mark_bad, unmark

PRACTICE = sorted((Path(__file__).parent / "data" / "campaign").glob("*.h5"))
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
    monkeypatch.setattr(catalogue, "SETTLING_S", 0.0)


def make_lab(folder: Path, *campaigns: str) -> Path:
    """Make a lab and return its data root."""
    (folder / "runs").mkdir(parents=True)
    (folder / "rig.toml").write_text("", "utf-8")
    for name in campaigns:
        shutil.copytree(PRACTICE[0].parent, folder / "runs" / name)
    return folder / "runs"


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A lab of two campaigns."""
    made = make_lab(tmp_path / "lab", "first", "second")
    monkeypatch.chdir(made.parent)
    return made


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


@settings(max_examples=5, suppress_health_check=[HealthCheck.function_scoped_fixture])
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


@pytest.mark.parametrize("what", [*RUN_CHANGES, *FOLDER_CHANGES])
def test_every_change_is_seen(what: str, root: Path, settled: None) -> None:
    del settled
    for path in (*(root / "first").iterdir(), *(root / "second").iterdir()):
        if path.name not in {PRACTICE[0].name, PRACTICE[1].name}:
            path.unlink()
    remarks_on(root)
    before = answers(FileListing(root))
    change(root, what, 0)
    assert answers(FileListing(root)) != before or what in {"unmarked", "filtered", "recovered", "no run", "recording"}
    assert remarks_on(root) == []
