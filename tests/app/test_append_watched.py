"""`dragrig watch` and `dragrig recover` on a campaign that goes on: an appended session, and one that is killed."""

import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import dragrig
from dragrig.campaign_session import append_to_campaign
from dragrig.cli import main
from dragrig.config.errors import PlanError
from dragrig.hosted_session import SessionOptions
from dragrig.rig import RunEnding, RunStatus, read_campaign
from dragrig.rig.runfile import Recorder
from dragrig.session_state import STATE_FILE, is_session_running
from dragrig.watch import CampaignState, CampaignWatch
from loaded_processes import command
from runfiles import START, header
from simulated import QUICK

pytestmark = pytest.mark.usefixtures("finished_here")


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return dragrig.run("drag", out=tmp_path_factory.mktemp("first") / "c", assignments=QUICK).folder


@pytest.fixture
def campaign(first: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(first, tmp_path / "c"))


@pytest.fixture(scope="module")
def killed(first: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CampaignState]:
    """A campaign whose session was killed while it recorded an appended drag, and what was seen just before."""
    campaign = Path(shutil.copytree(first, tmp_path_factory.mktemp("killed") / "c"))
    return campaign, killed_in_the_appended_part(campaign)


def killed_in_the_appended_part(campaign: Path) -> CampaignState:
    """Append a drag that holds for long, and kill its session while it is recorded; return what was seen before."""
    words = ["run", "drag", "--append", str(campaign), "--yes", "--pace", "real"]
    settings = ("hold_s=100", "wait_s=0", *QUICK[::2])
    watch = CampaignWatch(campaign)
    with command(*words, *(word for item in settings for word in ("--set", item))) as session:
        while (state := watch.look()).recording is None or not state.recording.samples:
            assert session.is_alive()
            time.sleep(0.05)
    return state


def test_a_campaign_that_goes_on_has_not_ended_while_its_session_is_prepared(campaign: Path) -> None:
    assert CampaignWatch(campaign).look().over
    seen: list[CampaignState] = []
    options = SessionOptions(Path(), begun=lambda _abort, _folder: seen.append(CampaignWatch(campaign).look()))
    append_to_campaign("drag", campaign, options, None, assignments=QUICK)
    assert [(state.doing, state.status, state.over) for state in seen] == [("preparing", "", False)]
    state = CampaignWatch(campaign).look()
    assert (state.doing, state.status, state.run, state.runs) == ("ended", "complete", 2, 2)
    assert [run.order for run in state.finished] == [0, 1, 2, 3]


def test_a_session_that_is_refused_leaves_the_end_of_the_one_before(campaign: Path) -> None:
    before = (campaign / STATE_FILE).read_bytes()
    with pytest.raises(PlanError, match="travel_mm"):
        dragrig.run("drag", append=campaign, assignments=["travel_mm=5000"])
    assert (campaign / STATE_FILE).read_bytes() == before
    (campaign / STATE_FILE).unlink()
    with pytest.raises(PlanError):
        dragrig.run("drag", append=campaign, assignments=["travel_mm=5000"])
    assert not (campaign / STATE_FILE).exists()


def test_a_session_killed_in_the_appended_part_is_told_recovered_and_gone_on_with(
    killed: tuple[Path, CampaignState], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    campaign, state = Path(shutil.copytree(killed[0], tmp_path / "c")), killed[1]
    assert state.recording is not None
    assert (state.doing, state.run, state.runs, state.recording.order) == ("recording", 1, 2, 2)
    assert [run.order for run in state.finished] == [0, 1]
    assert main(["watch", str(campaign), "--once"]) == 0
    assert "its process is gone; dragrig recover finishes its recording" in capsys.readouterr().out
    assert main(["recover", str(campaign)]) == 0
    assert "drag-002.h5" in capsys.readouterr().out
    told = CampaignWatch(campaign).look()
    assert (told.doing, [(run.order, run.status) for run in told.finished][2:]) == ("died", [(2, "recovered")])
    assert told.message.endswith("no recording is left unfinished, and dragrig run --resume makes the missing runs")
    resumed = dragrig.resume(campaign, pace="fast")
    assert [(run.order, run.run.protocol.kind) for run in resumed.session.runs] == [(3, "drag"), (4, "return")]
    after = CampaignWatch(campaign).look()
    assert (after.doing, after.status, after.runs) == ("ended", "complete", 2)


def test_runs_are_appended_after_a_killed_session_with_its_recording_finished_first(
    killed: tuple[Path, CampaignState], tmp_path: Path
) -> None:
    campaign = Path(shutil.copytree(killed[0], tmp_path / "c"))
    told: list[str] = []
    made = dragrig.run("drag", append=campaign, tell=told.append, assignments=QUICK)
    assert [run.order for run in made.session.runs] == [3, 4]
    assert "2 runs of the plan drag before it are missing" in told[-1]
    statuses = {run.header.order: run.status for run in read_campaign(campaign).runs}
    assert statuses == {**dict.fromkeys(range(5), RunStatus.COMPLETE), 2: RunStatus.RECOVERED}
    assert not list(campaign.glob("*.recording*"))
    assert CampaignWatch(campaign).look().status == "complete"


def test_a_campaign_goes_on_once_the_last_recording_of_a_killed_session_is_finished(campaign: Path) -> None:
    recorder = Recorder(campaign / "20260504-093000-drag-002.h5", header(order=2))

    def close_once_the_campaign_goes_on() -> None:
        while not is_session_running(campaign):
            time.sleep(0.001)
        recorder.close(RunEnding(RunStatus.ABORTED, "killed", START))

    with ThreadPoolExecutor(1) as finisher:
        closed = finisher.submit(close_once_the_campaign_goes_on)
        made = dragrig.run("drag", append=campaign, assignments=QUICK)
        closed.result()
    assert [run.order for run in made.session.runs] == [3, 4]
    assert {run.header.order for run in read_campaign(campaign).runs} == {0, 1, 2, 3, 4}
