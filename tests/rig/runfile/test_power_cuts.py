"""A power cut costs the last moments of a run, never the run."""

import random
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dragrig.cli import main
from dragrig.config.errors import OutputError
from dragrig.rig import left_recordings, recover
from dragrig.rig.runfile import finisher, read_run
from dragrig.rig.runfile.finisher import RecoveryOutcome
from dragrig.rig.runfile.journal import FrameKind, Journal, read_frames
from dragrig.rig.runfile.recorder import create_recording
from dragrig.rig.runfile.schema import journal_path
from power_cuts import Recorded, lost_s, record_on_emulated_disk
from runfiles import arrays, header, record

MAX_LAG_S = 0.3
CUTS = 6


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    return record_on_emulated_disk(tmp_path_factory.mktemp("recorded"), seed=1, max_lag_s=MAX_LAG_S)


def test_a_power_cut_at_any_moment_costs_the_last_moments_only(recorded: Recorded, tmp_path: Path) -> None:
    draw = random.Random(1)
    lost: list[float] = []
    for number in range(CUTS):
        folder = tmp_path / str(number)
        folder.mkdir()
        lost.append(lost_s(recorded, draw.uniform(recorded.begun_s, recorded.ended_s), folder, draw))
    stall_s = float(np.diff([at_s for at_s, _ in recorded.offers]).max())
    assert max(lost) <= 0.25 + MAX_LAG_S + stall_s, lost


def test_a_power_cut_before_the_first_sample_leaves_nothing_that_recover_complains_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "recorded").mkdir()
    recorded = record_on_emulated_disk(tmp_path / "recorded", seed=2, max_lag_s=0.5, duration_s=0.1)
    draw, empty = random.Random(2), 0
    # On a busy machine the moments with a journal and without a sample are few.
    for number in range(60 * CUTS):
        if number >= 3 * CUTS and empty:
            break
        folder = tmp_path / str(number)
        folder.mkdir()
        recorded.disk.cut(draw.uniform(recorded.begun_s, recorded.offers[0][0]), folder, draw)
        left = left_recordings(folder)
        assert main(["recover", str(folder)]) == 0
        printed = capsys.readouterr()
        if left and not (folder / "run.h5").exists():
            empty += 1
            assert "run.recording.h5: the power went before a sample of it was taken; its empty journal" in printed.err
            assert list(folder.iterdir()) == []
        assert main(["recover", str(folder)]) == 0
        assert "nothing to recover" in capsys.readouterr().err
    assert empty


def test_a_journal_whose_beginning_alone_is_damaged_stays(tmp_path: Path) -> None:
    left = record(tmp_path / "run.h5", 2500)
    left.unlink()
    journal = journal_path(left)
    content = journal.read_bytes()
    journal.write_bytes(content[:100] + bytes(50) + content[150:])
    (recovered,) = recover(tmp_path)
    assert recovered.outcome is RecoveryOutcome.LEFT
    assert journal.exists()


@given(
    bodies=st.lists(st.binary(max_size=60), min_size=1, max_size=6),
    offset=st.integers(min_value=0),
    damage=st.sampled_from(["cut", "zeros", "other"]),
)
def test_a_damaged_journal_is_read_up_to_the_damage(
    tmp_path_factory: pytest.TempPathFactory, bodies: list[bytes], offset: int, damage: str
) -> None:
    path = tmp_path_factory.mktemp("journal") / "run.recording.journal"
    journal = Journal(path, bodies[0])
    ends = [path.stat().st_size]
    for body in bodies[1:]:
        journal.append(FrameKind.ANNOTATIONS, body)
        ends.append(path.stat().st_size)
    journal.close()
    whole = path.read_bytes()
    at = offset % len(whole)
    if damage == "cut":
        path.write_bytes(whole[:at])
    else:
        changed = bytes(len(whole) - at) if damage == "zeros" else bytes(byte ^ 0x5A for byte in whole[at:])
        path.write_bytes(whole[:at] + changed)
    first_changed = next((i for i, byte in enumerate(path.read_bytes()) if byte != whole[i]), len(path.read_bytes()))
    sound = [body for body, end in zip(bodies, ends, strict=True) if end <= first_changed]
    assert [body for _, body in read_frames(path)] == sound


def test_frames_of_an_older_journal_behind_the_end_are_no_part_of_this_one(tmp_path: Path) -> None:
    journals = {name: Journal(tmp_path / name, b"image") for name in ("old", "new")}
    journals["old"].append(FrameKind.ANNOTATIONS, b"first")
    journals["old"].append(FrameKind.ANNOTATIONS, b"second")
    journals["new"].append(FrameKind.ANNOTATIONS, b"other")
    for journal in journals.values():
        journal.close()
    old, new = ((tmp_path / name).read_bytes() for name in ("old", "new"))
    assert len(old) > len(new)
    (tmp_path / "new").write_bytes(new + old[len(new) :])
    assert [kind for kind, _ in read_frames(tmp_path / "new")] == [FrameKind.EMPTY_RECORDING, FrameKind.ANNOTATIONS]


def test_the_journal_alone_brings_a_run_back(tmp_path: Path) -> None:
    left = record(tmp_path / "run.h5", 2500)
    left.unlink()
    (recovered,) = recover(tmp_path)
    assert (recovered.outcome, recovered.samples) == (RecoveryOutcome.FINISHED, 2500)
    run = read_run(tmp_path / "run.h5")
    np.testing.assert_array_equal(run.trace.channels["force"], arrays(0, 2500)["force"])
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.h5"]


def test_a_recording_without_its_journal_is_finished_all_the_same(tmp_path: Path) -> None:
    journal_path(record(tmp_path / "run.h5", 2500)).unlink()
    (recovered,) = recover(tmp_path)
    assert (recovered.outcome, recovered.samples) == (RecoveryOutcome.FINISHED, 2500)


def test_nothing_is_removed_before_the_run_file_was_read_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record(tmp_path / "run.h5", 2500)
    whole = finisher.write_ending

    def damaging(file: object, *rest: object) -> None:
        whole(file, *rest)  # type: ignore[arg-type]
        file["/entry/trace/force"][1000] = -1.0  # type: ignore[index]

    monkeypatch.setattr(finisher, "write_ending", damaging)
    (recovered,) = recover(tmp_path)
    assert recovered.outcome is RecoveryOutcome.LEFT
    assert "does not return what was written" in recovered.message
    assert not (tmp_path / "run.h5").exists()
    monkeypatch.undo()
    assert [result.samples for result in recover(tmp_path)] == [2500]


def test_a_recording_that_cannot_be_made_leaves_no_journal(tmp_path: Path) -> None:
    path = tmp_path / "run.recording.h5"
    path.mkdir()
    with pytest.raises((OSError, OutputError)):
        create_recording(path, header())
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
