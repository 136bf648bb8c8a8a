"""`dragrig run` as a process: files, prompts, Ctrl-C, trips, resuming, exit codes."""

import io
import json
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dragrig import campaign_session as campaigns
from dragrig.cli import main
from dragrig.config import RIG_FILE
from dragrig.hosted_session import SessionOptions
from dragrig.rig import mark_bad
from dragrig.rig.operator import NullOperator
from dragrig.rig.runfile import Recorder, read_campaign, read_run
from dragrig.rig.runfile.model import RunInfo, RunStatus
from dragrig.setup import resolve
from loaded_processes import command
from runfiles import header

QUICK = ("drag", "--set", "travel_mm=10", "--set", "hold_s=0.5")
INTERPRETER = sys.executable


class Runner:
    """Calls `dragrig run` in this process and reads what it prints."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch, self._capsys = monkeypatch, capsys

    def __call__(self, *words: str, typed: str = "") -> Any:
        answer = self.json_answer(*words, typed=typed)
        return json.loads(answer.out)

    def json_answer(self, *words: str, typed: str = "", code: int = 0) -> Any:
        self._monkeypatch.setattr(sys, "stdin", io.StringIO(typed))
        got = main(["run", *words, "--json"])
        output = self._capsys.readouterr()
        assert got == code, output.err
        return output


@pytest.fixture
def run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], finished_here: None
) -> Runner:
    monkeypatch.chdir(tmp_path)
    return Runner(monkeypatch, capsys)


@pytest.fixture(scope="module")
def made_once(tmp_path_factory: pytest.TempPathFactory, finished_here: None) -> Path:
    folder = tmp_path_factory.mktemp("made") / "c"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder.parent)
        assert main(["run", *QUICK, "--yes", "--out", "c", "--quiet"]) == 0
    return folder


@pytest.fixture
def campaign(made_once: Path, tmp_path: Path) -> Path:
    """The folder `c` of a quick drag and its way back."""
    return Path(shutil.copytree(made_once, tmp_path / "c"))


def statuses(folder: Path) -> list[tuple[str, RunStatus]]:
    return [(entry.kind, entry.status) for entry in read_campaign(folder).runs]


def test_two_dry_runs_of_one_second_have_folders_of_their_own(run: Runner, tmp_path: Path) -> None:
    setup = resolve("drag", assignments=[QUICK[2], QUICK[4]])
    terms = SessionOptions(tmp_path, origin=datetime(2026, 5, 4, 9, tzinfo=UTC))
    made = [campaigns.start_campaign(setup, None, terms, NullOperator()).folder.name for _ in range(3)]
    assert made == ["20260504-090000-drag", "20260504-090000-drag-2", "20260504-090000-drag-3"]


def test_a_plan_becomes_one_file_a_run(run: Runner, tmp_path: Path) -> None:
    made = run(*QUICK, "--yes", "--operator", "Ada", "--note", "first", "--capsule", "smooth")
    folder = tmp_path / made["folder"]
    assert folder.parent == tmp_path / "runs"
    assert folder.name.endswith("-drag")
    assert statuses(folder) == [("drag", RunStatus.COMPLETE), ("return", RunStatus.COMPLETE)]
    first: RunInfo = read_campaign(folder).runs[0]
    assert (first.header.entry["operator"], first.header.entry["note"]) == ("Ada", "first")
    assert first.header.capsule["name"] == "smooth"
    assert [Path(row["file"]).name for row in made["runs"]] == [entry.path.name for entry in read_campaign(folder).runs]
    assert made["runs"][0]["checks"]["lost_samples"] == 0


def test_a_session_is_made_again_from_a_run_file_alone(run: Runner, tmp_path: Path) -> None:
    changed = ("--set", "rig.simulated.seed=5", "--set", "model.friction_coefficient=0.1", "--set", "wait_s=7")
    first = run(*QUICK, *changed, "--yes", "--out", "first")
    again = run(first["runs"][1]["file"], "--yes", "--out", "again")
    for row, second in zip(first["runs"], again["runs"], strict=True):
        before, after = read_run(tmp_path / row["file"]), read_run(tmp_path / second["file"])
        for name, channel in before.trace.channels.items():
            np.testing.assert_array_equal(after.trace.channels[name], channel)


def test_a_lab_runs_a_stored_rig_within_its_own_limits_and_says_so(run: Runner, tmp_path: Path) -> None:
    made = run(*QUICK, "--yes", "--out", "c", "--set", "rig.stage.max_speed_mm_s=60")
    file = made["runs"][0]["file"]
    (tmp_path / RIG_FILE).write_text("[stage]\nhighest_mm = 60.0\n[guard]\nforce_limit_mN = 100.0\n", "utf-8")
    again = run.json_answer(file, "--yes", "--out", "again", code=4)
    assert "limit of 100 mN" in json.loads(again.out)["reason"]
    assert "guard.force_limit_mN is 100 in this lab, not 8000 as then." in again.err
    assert "stage.highest_mm is 60 in this lab, not 150 as then." in again.err
    assert "max_speed" not in again.err
    assert resolve(tmp_path / file, folder=tmp_path).rig.stage.max_speed_mm_s == 60
    refused = run.json_answer(file, "--yes", "--out", "refused", "--set", "travel_mm=30", code=2).err
    assert "60" in refused
    mark_bad(tmp_path / file, "capsule slipped off")
    resumed = run.json_answer("--resume", "c", "--yes", code=4)
    assert "guard.force_limit_mN is 100 in this lab, not 8000 as then." in resumed.err


def test_a_torn_session_record_leaves_the_one_before(run: Runner, campaign: Path) -> None:
    record, newer = next((campaign).glob("session-*")), campaign / "session-20990101-000000Z.toml"
    newer.write_bytes(record.read_bytes()[:300])
    mark_bad(read_campaign(campaign).runs[0].path, "capsule slipped off")
    resumed = run.json_answer("--resume", "c", "--yes")
    assert newer.name in resumed.err
    assert "The session before it counts." in resumed.err
    for path in (campaign).glob("session-*"):
        path.write_bytes(b"plan = [")
    assert newer.name in run.json_answer("--resume", "c", "--yes", code=2).err


def test_prompts_are_answered_on_standard_input(run: Runner, tmp_path: Path) -> None:
    entry = (*QUICK, "--set", "prompt_each=true", "--set", "repeats=3", "--set", "way_back=by_hand")
    made = run(*entry, "--out", "c", typed="done\nredo\nd\nd\nskip\nd\n")
    orders = [(row["order"], row["status"]) for row in made["runs"]]
    assert orders == [(0, "complete"), (1, "complete"), (2, "complete")]
    campaign = read_campaign(tmp_path / "c")
    assert [campaign.marks[entry.path].reason for entry in campaign.runs if entry.path in campaign.marks] == [
        "repeated at the operator's request"
    ]


def test_without_an_answer_the_session_ends_with_a_reason(run: Runner) -> None:
    answer = run.json_answer(*QUICK, code=3)
    assert json.loads(answer.out)["status"] == "aborted"
    assert "--yes" in answer.err
    assert "the session ended early" in answer.err


def test_quiet_leaves_the_result_alone(run: Runner) -> None:
    assert run.json_answer(*QUICK, "--yes", "--quiet").err == ""


SLOW = ("drag", "--yes", "--pace", "real", "--set", "wait_s=0", "--set", "rest_s=0.2", "--set", "speed_mm_s=2")


@pytest.fixture
def waiting(tmp_path: Path) -> Iterator["subprocess.Popen[str]"]:
    process = subprocess.Popen(
        [INTERPRETER, "-m", "dragrig", "run", *SLOW, "--out", "c", "--json"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def until_it_records(folder: Path) -> Path:
    deadline = time.monotonic() + 600
    while time.monotonic() < deadline:
        paths = list(folder.glob("*.recording.h5"))
        if paths and time.time() - paths[0].stat().st_ctime < 5 and paths[0].stat().st_size > 20_000:
            return paths[0]
        time.sleep(0.02)
    raise AssertionError("nothing was recorded")


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C reaches a whole console there")
def test_ctrl_c_stops_the_stage_within_a_tenth_of_a_second(waiting: "subprocess.Popen[str]", tmp_path: Path) -> None:
    until_it_records(tmp_path / "c")
    time.sleep(0.8)  # into the steady phase
    sent = datetime.now(UTC)
    waiting.send_signal(signal.SIGINT)
    answer, remarks = waiting.communicate()
    assert waiting.returncode == 3, remarks
    assert json.loads(answer)["status"] == "aborted"
    (info,) = read_campaign(tmp_path / "c").runs
    assert (info.status, info.reason) == (RunStatus.ABORTED, "Ctrl-C")
    run = read_run(info.path)
    last_moved_s = float(run.trace.time[1:][np.diff(run.trace.position) > 0.0005][-1])
    (noticed_s,) = (event.time_s for event in run.events if event.kind == "stop")
    assert abs(last_moved_s - noticed_s) < 0.1
    # The rig's time lags behind the wall's on a busy machine, by far less than the twenty seconds that are left.
    assert abs((info.header.start_time - sent).total_seconds() + noticed_s) < 10.0


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C reaches a whole console there")
def test_a_ctrl_c_that_is_held_counts_once(waiting: "subprocess.Popen[str]", tmp_path: Path) -> None:
    until_it_records(tmp_path / "c")
    while waiting.poll() is None:
        waiting.send_signal(signal.SIGINT)
        time.sleep(0.01)
    answer, remarks = waiting.communicate()
    assert waiting.returncode == 3, remarks
    assert json.loads(answer)["status"] == "aborted"
    assert "Traceback" not in remarks
    (info,) = read_campaign(tmp_path / "c").runs
    assert (info.status, info.reason) == (RunStatus.ABORTED, "Ctrl-C")


def test_a_tripped_campaign_can_be_resumed(run: Runner, tmp_path: Path) -> None:
    words = (*QUICK, "--yes", "--out", "c")
    answer = run.json_answer(*words, "--set", "rig.guard.force_limit_mN=100", code=4)
    made = json.loads(answer.out)
    assert made["status"] == "tripped"
    assert "limit of 100 mN" in made["reason"]
    assert "limit of 100 mN" in answer.err
    again = run("--resume", "c", "--yes", "--set", "rig.guard.force_limit_mN=8000")
    assert [(row["order"], row["kind"]) for row in again["runs"]] == [(1, "drag"), (2, "return")]
    starts = [entry.header.start_time for entry in read_campaign(tmp_path / "c").runs]
    assert starts == sorted(starts)
    sessions = sorted((tmp_path / "c").glob("session-*"))
    assert run("--resume", "c")["runs"] == []  # nothing is left, so nobody is asked
    assert sorted((tmp_path / "c").glob("session-*")) == sessions
    assert "only rig" in run.json_answer("--resume", "c", "--yes", "--set", "speed_mm_s=3", code=2).err


def test_a_crashed_campaign_can_be_resumed(run: Runner, tmp_path: Path) -> None:
    with command("run", *SLOW, "--out", str(tmp_path / "c"), "--quiet"):
        recording = until_it_records(tmp_path / "c")
    again = run("--resume", "c", "--yes")
    assert not recording.exists()
    assert statuses(tmp_path / "c") == [
        ("drag", RunStatus.RECOVERED),
        ("drag", RunStatus.COMPLETE),
        ("return", RunStatus.COMPLETE),
    ]
    assert again["status"] == "complete"


def test_a_campaign_that_is_being_recorded_is_left_alone(
    run: Runner, campaign: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dragrig.campaign_session.FINISHING_S", 0.1)
    before = sorted((campaign).iterdir())
    with Recorder(campaign / "20260504-093000-drag-009.h5", header(order=9)):
        assert "is being recorded; go on" in run.json_answer("--resume", "c", "--yes", code=2).err
    assert [path for path in sorted((campaign).iterdir()) if "009" not in path.name] == before


def test_a_run_marked_bad_is_made_again(run: Runner, campaign: Path) -> None:
    mark_bad(read_campaign(campaign).runs[0].path, "capsule slipped off")
    made = run("--resume", "c", "--yes")
    assert [row["kind"] for row in made["runs"]] == ["drag", "return"]
    *before, again, _ = sorted(read_campaign(campaign).runs, key=lambda first: first.header.order)
    assert all(entry.end_time is not None and entry.end_time < again.header.start_time for entry in before)


SLOW_THEN_QUICK = """
name = "two"
[[steps]]
kind = "blank"
speed_mm_s = [1.8, 40.0]
travel_mm = 6.0
rest_s = 0.5
hold_s = 0.5
wait_s = 0.0
way_back = "stay"
"""


def test_the_progress_of_a_repeated_first_run_is_shown(run: Runner, tmp_path: Path) -> None:
    (tmp_path / "two.toml").write_text(SLOW_THEN_QUICK, "utf-8")
    run("two.toml", "--yes", "--out", "c")
    mark_bad(read_campaign(tmp_path / "c").runs[0].path, "capsule slipped off")
    errors = run.json_answer("--resume", "c", "--yes", "--pace", "real").err
    assert re.search(r"1 of 1: run 2, blank 1.8 mm/s: \d+ %, (less than )?\d+ s left", errors), errors


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ((), "name a plan"),
        (("drag", "--resume", "c"), "leave the plan out"),
        (("--resume", "c", "--specimen", "jejunum"), "leave out --specimen"),
        (("--resume", "c"), "there is no such"),
        (("--resume", "."), "session-"),
        (("drag", "--backend", "simulatd"), "did you mean simulated?"),
        (("drag", "--pace", "slow"), "--pace"),
        (("drag", "--out", "taken"), "taken"),
        (("drag", "--out", "taken/below"), "taken"),
        (("drag", "--set", "travel_mm=140"), "outside the stage's travel"),
        (("drag", "--set", "rig.recording.reserve_mb=1e9"), "MB in reserve"),
        pytest.param(
            ("drag", "--out", "/proc/self/x"),
            "/proc/self/x: no runs can be written here",
            marks=pytest.mark.skipif(sys.platform != "linux", reason="of Linux"),
        ),
    ],
)
def test_an_impossible_plan_is_reported_before_anything_moves(
    run: Runner, tmp_path: Path, words: tuple[str, ...], sentence: str
) -> None:
    (tmp_path / "taken").write_text("mine", "utf-8")
    errors = run.json_answer(*words, "--yes", code=2).err
    assert sentence.lower() in errors.lower()
    assert errors.count("\n") == 1
    assert (tmp_path / "taken").read_text("utf-8") == "mine"
    assert not (tmp_path / "runs").exists()


def test_a_campaign_is_not_written_into_twice(run: Runner, campaign: Path) -> None:
    before = sorted((campaign).iterdir())
    assert "--resume" in run.json_answer(*QUICK, "--yes", "--out", "c", code=2).err
    assert sorted((campaign).iterdir()) == before


def test_a_backend_that_an_entry_point_adds_can_fail_in_words(
    run: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = tmp_path / "site"
    (site / "broken-1.dist-info").mkdir(parents=True)
    (site / "broken-1.dist-info" / "METADATA").write_text("Name: broken\nVersion: 1\n", "utf-8")
    (site / "broken-1.dist-info" / "entry_points.txt").write_text("[dragrig.backends]\nbroken = broken:open_it\n")
    (site / "broken.py").write_text("def open_it(request):\n    raise OSError('no drive at COM3')\n", "utf-8")
    monkeypatch.syspath_prepend(site)
    errors = run.json_answer("drag", "--yes", "--backend", "broken", code=5).err
    assert "no drive at COM3" in errors
    assert errors.count("\n") == 1
