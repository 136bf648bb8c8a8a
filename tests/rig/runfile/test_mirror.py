"""The second copy of each finished file: verified, never waited for, and honest about what is missing."""

import filecmp
import json
import os
import threading
from pathlib import Path

import pytest

import dragrig
from dragrig.analysis import filter_file
from dragrig.campaign_session import MIRROR_ANSWER_S
from dragrig.cli import main
from dragrig.config.errors import OutputError
from dragrig.rig import mark_bad, unmark
from dragrig.rig.engine import AcquisitionOutcome
from dragrig.rig.operator import NullOperator
from dragrig.rig.programme import PlannedRun
from dragrig.rig.runfile.schema import mark_path, part_path
from dragrig.rig.runfile.store import Mirror, copy_verified
from driving import until
from property_tests import thorough

FAST = ["rig.sampling.rate_hz=200", "speed_mm_s=40"]


class Mover(NullOperator):
    """Takes the mirror away once the first file is in it, and brings it back at another run's end."""

    def __init__(self, mirror: Path, first: Path, back_after: int) -> None:
        self._mirror, self._first, self._back_after = mirror, first, back_after
        self._ended = 0

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        self._ended += 1
        if self._ended == 1:
            until(lambda: any(self._first.glob("*.h5")))  # copied while nobody waits
            self._mirror.rename(self._mirror.with_name("away"))
        if self._ended == self._back_after:
            self._mirror.with_name("away").rename(self._mirror)


def test_every_finished_file_is_copied_to_the_mirror(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "second").mkdir()
    folder, mirror = tmp_path / "runs", tmp_path / "second"
    line = ["run", "blank", "--out", str(folder), "--mirror", str(mirror), "--yes", "--set", FAST[0], "--set", FAST[1]]
    assert main([*line, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)["mirror"]
    made = sorted(path.name for path in (*folder.glob("*.h5"), *folder.glob("session-*.toml")))
    assert sorted(answer["copied"]) == made == sorted(path.name for path in (mirror / "runs").iterdir())
    assert answer["missing"] == {}
    assert filecmp.cmpfiles(folder, mirror / "runs", made, shallow=False) == (made, [], [])


def test_a_vanished_mirror_is_reported_and_stops_nothing(tmp_path: Path) -> None:
    mirror, answer = tmp_path / "second", list[str]()
    mirror.mkdir()
    made = dragrig.run(
        "blank", out=tmp_path / "runs", mirror=mirror, tell=answer.append, assignments=FAST[:1],
        person=Mover(mirror, mirror / "runs", back_after=99),
    )  # fmt: skip
    made.session.require()
    assert made.mirrored is not None
    assert len(made.mirrored.copied) <= 1  # the first may be in place and yet unproven when the folder goes
    assert not made.mirrored.whole
    runs = {path.name for path in (tmp_path / "runs").glob("*.h5")}
    assert runs - set(made.mirrored.copied) <= set(made.mirrored.missing)
    assert all("there is no such folder" in why for why in made.mirrored.missing.values())
    assert any(line.startswith("NOT MIRRORED: ") and "it stays where it was made" in line for line in answer)
    assert not mirror.exists()


def test_a_returning_mirror_gets_the_missing_files(tmp_path: Path) -> None:
    mirror = tmp_path / "second"
    mirror.mkdir()
    made = dragrig.run(
        "blank", out=tmp_path / "runs", mirror=mirror, assignments=FAST[:1],
        person=Mover(mirror, mirror / "runs", back_after=3),
    )  # fmt: skip
    assert made.mirrored is not None
    assert made.mirrored.whole
    assert {path.name for path in (tmp_path / "runs").glob("*.h5")} <= set(made.mirrored.copied)


def test_the_campaigns_own_folder_is_refused_as_mirror(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is where the campaign itself goes"):
        dragrig.run("blank", out=tmp_path / "runs", mirror=tmp_path, assignments=FAST[:1])
    assert not (tmp_path / "runs").exists()


def test_resuming_mirrors_the_earlier_runs_with_their_marks_and_what_becomes_of_these(tmp_path: Path) -> None:
    (tmp_path / "second").mkdir()
    first = dragrig.run("blank", out=tmp_path / "runs", assignments=FAST)
    assert first.mirrored is None
    runs = sorted((tmp_path / "runs").glob("*.h5"))
    mark = mark_path(runs[0])
    copy = tmp_path / "second" / "runs" / mark.name
    mark_bad(runs[0], "the capsule slipped")
    for reason in ("the capsule slipped", "the specimen tore"):
        again = dragrig.resume(tmp_path / "runs", mirror=tmp_path / "second")
        assert again.mirrored is not None
        assert again.mirrored.whole, again.mirrored.missing
        assert mark.name in again.mirrored.copied
        assert reason in copy.read_text("utf-8")
        assert filecmp.cmp(mark, copy, shallow=False)
        for run in runs:
            assert filecmp.cmp(run, copy.with_name(run.name), shallow=False)
        # The copies of what is changed here are replaced by the next session.
        mark_bad(runs[0], "the specimen tore")
        filter_file(runs[0])
    unmark(runs[0])
    dragrig.resume(tmp_path / "runs", mirror=tmp_path / "second")
    assert not copy.exists()


def test_a_missing_mirror_is_reported_at_once(tmp_path: Path) -> None:
    answer: list[str] = []
    mirror = Mirror(tmp_path / "gone", "runs", answer.append)
    assert mirror.close().whole
    folder = tmp_path / "gone" / "runs"
    assert answer == [
        f"NOT MIRRORED: {folder}: there is no such folder; make it, or mount the disk; "
        "the runs are recorded all the same."
    ]


def test_a_full_mirror_leaves_no_half_file(small_disk: Path, tmp_path: Path) -> None:
    source = tmp_path / "run.h5"
    source.write_bytes(bytes(2 << 20))
    with (small_disk / "filler").open("wb") as filler:
        os.posix_fallocate(filler.fileno(), 0, 31 << 20)
    mirror = Mirror(small_disk, "runs", lambda _: None)
    mirror.submit(source)
    close = mirror.close()
    assert close.missing == {"run.h5": "No space left on device"}
    assert list((small_disk / "runs").iterdir()) == []


def test_another_file_of_the_same_name_is_never_replaced(tmp_path: Path) -> None:
    source, target = tmp_path / "run.h5", tmp_path / "second.h5"
    source.write_bytes(b"new")
    target.write_bytes(b"old")
    with pytest.raises(OutputError, match="a file of this name is there and differs"):
        copy_verified(source, target)
    assert target.read_bytes() == b"old"
    target.write_bytes(b"new")
    copy_verified(source, target)
    assert not list(tmp_path.glob("*.part"))


def test_a_mirror_out_of_reach_is_refused_before_the_session(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="there is no such folder; make it, mount the disk"):
        dragrig.run("blank", out=tmp_path / "runs", mirror=tmp_path / "gone", assignments=FAST[:1])
    assert not (tmp_path / "runs").exists()


def test_a_mirror_whose_disk_hangs_is_refused_before_the_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert MIRROR_ANSWER_S == 10.0
    monkeypatch.setattr("dragrig.campaign_session.MIRROR_ANSWER_S", 0.2)
    ended, look = threading.Event(), Path.is_dir
    hangs = tmp_path / "hangs"
    monkeypatch.setattr(Path, "is_dir", lambda path: look(path) if path != hangs else ended.wait(600))
    with pytest.raises(OutputError, match="its disk has not answered for"):
        dragrig.run("blank", out=tmp_path / "runs", mirror=hangs, assignments=FAST[:1])
    ended.set()
    assert not (tmp_path / "runs").exists()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipe can stand for a slow disk here")
# A busy machine may keep the reader of the slow one from it for a second or two.
@pytest.mark.parametrize(
    ("drained", "stall_s", "whole_s", "why"),
    [(False, 0.4, 1.5, "does not respond"), thorough(True, 4.0, 6.0, "took more than 6 s")],
    ids=["hangs", "slow"],
)
def test_a_mirror_that_is_slow_or_hangs_does_not_keep_a_session(
    tmp_path: Path, drained: bool, stall_s: float, whole_s: float, why: str
) -> None:
    source = tmp_path / "run.h5"
    source.write_bytes(bytes(16 << 20))
    (tmp_path / "second" / "runs").mkdir(parents=True)
    pipe = part_path(tmp_path / "second" / "runs" / source.name)
    os.mkfifo(pipe)
    ended = threading.Event()
    reader = threading.Thread(target=drain, args=(pipe, ended)) if drained else None
    if reader is not None:
        reader.start()
    mirror = Mirror(tmp_path / "second", "runs", lambda _: None)
    mirror.submit(source)
    report = mirror.close(max_stall_s=stall_s, max_s=whole_s)
    assert report.copied == ()
    assert why in report.missing[source.name]
    ended.set()
    if reader is not None:
        reader.join()


def drain(pipe: Path, ended: threading.Event) -> None:
    """Take 1 MB from a pipe every 0.5 s, as a slow disk would, and then all that is left."""
    with pipe.open("rb") as taken:
        while taken.read(1 << 20) and not ended.wait(0.5):
            pass
        taken.read()
