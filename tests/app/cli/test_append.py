"""`dragrig run --append`: further runs in a campaign, of the same specimen or another, and what is refused."""

import json
import shutil
from datetime import timedelta
from pathlib import Path

import h5py
import pytest

import dragrig
from dragrig.analysis import pool_campaigns, select_runs, table_rows
from dragrig.cli import main
from dragrig.config import OutputError, RunFileError, SettingsError, TrippedError
from dragrig.rig import mark_bad
from dragrig.rig.runfile import Recorder, read_campaign
from dragrig.rig.runfile.campaigns import read_session_records
from dragrig.session_state import session_lock
from runfiles import header
from simulated import QUICK

pytestmark = pytest.mark.usefixtures("finished_here")
SLOW = (*QUICK, "speed_mm_s=5")


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("first") / "c"
    dragrig.run("drag", out=folder, assignments=(*QUICK, "specimen.id=P7", "specimen.wall_thickness_mm=2.0"))
    return folder


@pytest.fixture
def campaign(first: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(first, tmp_path / "c"))


def days_later(folder: Path, days: float) -> None:
    """Have a campaign's runs be made so many days ago."""
    for info in read_campaign(folder).runs:
        with h5py.File(info.path, "r+") as file:
            run = file["entry/run"] if "entry/run" in file else file["entry"]
            for name in ("start_time", "end_time"):
                moment = info.header.start_time if name == "start_time" else info.end_time
                assert moment is not None
                if name in run.attrs:
                    run.attrs[name] = (moment - timedelta(days=days)).isoformat()


def test_appended_runs_go_on_with_numbers_specimen_and_settings(campaign: Path) -> None:
    told: list[str] = []
    made = dragrig.run("drag", append=campaign, tell=told.append, operator="Ben", assignments=SLOW)
    runs = sorted(read_campaign(campaign).runs, key=lambda run: run.header.order)
    assert made.folder == campaign
    assert [run.header.order for run in runs] == [0, 1, 2, 3]
    assert len({run.header.run_id for run in runs}) == 4
    assert {run.header.specimen["id"] for run in runs} == {"P7"}
    assert {run.header.specimen["wall_thickness_mm"] for run in runs} == {2.0}
    assert runs[2].header.protocol["speed_mm_s"] == 5
    assert runs[2].header.start_time > (runs[1].end_time or runs[1].header.start_time)
    records, damaged = read_session_records(campaign)
    assert ([record.first_order for record in records], damaged) == ([0, 2], ())
    assert records[1].operator == "Ben"
    assert not told


def test_a_resumed_campaign_makes_the_missing_runs_of_the_appended_plan(campaign: Path) -> None:
    assignments = ("speed_mm_s=[5.0, 10.0]", *QUICK)
    made = dragrig.run("drag", append=campaign, assignments=(*assignments, "rig.guard.force_limit_mN=50"))
    with pytest.raises(TrippedError):
        made.session.require()
    told: list[str] = []
    patient = (*SLOW, "rig.guard.force_limit_mN=8000")
    again = dragrig.run("drag", append=campaign, tell=told.append, assignments=patient)
    assert [run.order for run in again.session.runs] == [3, 4]
    assert "4 runs of the plan drag before it are missing" in told[-1]
    mark_bad(again.files[0], "slipped")
    resumed = dragrig.resume(campaign)
    assert [(run.order, run.run.protocol.kind) for run in resumed.session.runs] == [(5, "drag"), (6, "return")]
    assert dragrig.resume(campaign).session.runs == ()


TWO = (*QUICK, "speed_mm_s=[5.0, 10.0]")


@pytest.fixture(scope="module")
def two_drags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("two") / "c"
    dragrig.run("drag", out=folder, assignments=TWO)
    return folder


@pytest.mark.parametrize(
    ("meanwhile", "files", "number"),
    [
        ("damaged", 1, 4),
        pytest.param("damaged", 4, 4, marks=pytest.mark.thorough),
        pytest.param("away", 3, 1, marks=pytest.mark.thorough),
        ("away", 4, 1),
    ],
)
def test_files_that_are_restored_leave_no_run_of_a_later_plan_out(
    meanwhile: str, files: int, number: int, two_drags: Path, tmp_path: Path
) -> None:
    campaign = Path(shutil.copytree(two_drags, tmp_path / "c"))
    lost = sorted(campaign.glob("*.h5"), key=lambda path: path.name[-6:])[-files:]
    for path in lost:
        path.write_bytes(b"no run") if meanwhile == "damaged" else path.unlink()
    told: list[str] = []
    made = dragrig.run("drag", append=campaign, tell=told.append, assignments=(*TWO, "rig.guard.force_limit_mN=50"))
    assert [run.order for run in made.session.runs] == [number]
    assert (meanwhile == "damaged") == ("cannot be read" in told[0])
    for path in lost:
        shutil.copy(two_drags / path.name, path)
    resumed = dragrig.resume(campaign, assignments=("rig.guard.force_limit_mN=8000",))
    assert [run.run.index for run in resumed.session.runs] == [0, 1, 2, 3]
    assert dragrig.resume(campaign).session.runs == ()


def test_a_left_recording_keeps_its_number(campaign: Path) -> None:
    (campaign / "20260504-093000-drag-041.recording.h5").write_bytes(b"no recording")
    made = dragrig.run("drag", append=campaign, assignments=SLOW)
    assert [run.order for run in made.session.runs] == [42, 43]


def test_a_sentinel_is_compared_with_the_campaigns_first(tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(
        """name = "s"
sentinel = { every = 1, kind = "drag", speed_mm_s = 10.0, travel_mm = 12.0, hold_s = 0.5 }
[[steps]]
kind = "drag"
speed_mm_s = 10.0
travel_mm = 12.0
hold_s = 0.5
way_back = "by_hand"
""",
        "utf-8",
    )
    rarely = ("rig.sampling.rate_hz=200",)
    dragrig.run(plan, out=tmp_path / "c", assignments=rarely).session.require()
    dragrig.run(plan, append=tmp_path / "c", assignments=rarely).session.require()
    drifts = [row.drift_percent for row in table_rows(tmp_path / "c") if row.role == "sentinel"]
    assert drifts[0] is None, drifts
    assert None not in drifts[1:]


def test_another_day_is_said_and_counts_as_age(campaign: Path) -> None:
    days_later(campaign, 1)
    told: list[str] = []
    dragrig.run("drag", append=campaign, tell=told.append, assignments=SLOW)
    assert "ended 24.0 h ago; the runs count as of the same specimen P7" in told[0]
    selection = select_runs(campaign)
    (remark,) = [remark for remark in selection.remarks if "sessions" in remark]
    assert "2 sessions, with breaks of 24.0 h before" in remark


def test_another_specimen_is_kept_apart(campaign: Path) -> None:
    told: list[str] = []
    fresh = ("specimen.id=P8", "specimen.wall_thickness_mm=3.0")
    dragrig.run("drag", append=campaign, tell=told.append, assignments=(*SLOW, *fresh))
    assert "The runs are of specimen P8; those of P7" in told[0]
    assert len(select_runs(campaign, "P8").experiments) == 1
    with pytest.raises(SettingsError, match=r"several specimens \(P7, P8\); say which one is on the rig"):
        dragrig.run("drag", append=campaign, assignments=SLOW)
    made = dragrig.run("drag", append=campaign, assignments=(*SLOW, "specimen.id=P7"))
    infos = {run.path: run for run in read_campaign(campaign).runs}
    assert {infos[path].header.specimen["wall_thickness_mm"] for path in made.files} == {2.0}


@pytest.mark.parametrize(
    ("choices", "words"),
    [
        ({"assignments": ("rig.force_sensor.range_mN=20000",)}, "force_sensor.range_mN is 20000.0, not"),
        ({"assignments": ("rig.simulated.seed=7",)}, "simulated.seed is 7, not"),
        ({"assignments": ("specimen.wall_thickness_mm=3.0",)}, "a fresh piece needs an id of its own"),
        ({"effects": ["stribeck:ratio=0.4"]}, "follows another friction model"),
        ({"backend": "hardware", "double": True}, "not on the double of hardware"),
    ],
)
def test_what_does_not_suit_the_campaign_is_refused_before_anything_moves(
    campaign: Path, choices: dict[str, object], words: str
) -> None:
    before = sorted(campaign.glob("*.*"))
    with pytest.raises(SettingsError, match=words):
        dragrig.run("drag", append=campaign, **choices)  # type: ignore[arg-type]
    assert sorted(campaign.glob("*.*")) == before


def test_a_folder_that_is_no_campaign_or_in_use_or_read_only_is_refused(
    campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dragrig.campaign_session.FINISHING_S", 0.1)
    monkeypatch.setattr("dragrig.session_state.LOCK_TIMEOUT_S", 0.1)
    with pytest.raises(OutputError, match="there is no such campaign"):
        dragrig.run("drag", append=tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunFileError, match="is no campaign that could go on"):
        dragrig.run("drag", append=tmp_path / "empty")
    with Recorder(campaign / "20260504-093000-drag-009.h5", header(order=9)), pytest.raises(OutputError, match="being"):
        dragrig.run("drag", append=campaign)
    with session_lock(campaign), pytest.raises(OutputError, match="another session of this campaign is running"):
        dragrig.run("drag", append=campaign)


def test_the_command_takes_a_plan_and_no_other_folder(
    campaign: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["run", "drag", "--append", "c", "--yes", "--json", *(word for item in SLOW for word in ("--set", item))]
    assert main(words) == 0
    made = json.loads(capsys.readouterr().out)
    assert (made["folder"], [row["order"] for row in made["runs"]]) == ("c", [2, 3])
    assert main([*words, "--out", "d"]) == 2
    assert "--append names the folder" in capsys.readouterr().err
    assert main(["run", "--append", "c"]) == 2
    assert "Name a plan" in capsys.readouterr().err


def test_a_copy_counts_once_and_a_copy_of_a_bad_run_never(campaign: Path) -> None:
    dragrig.run("drag", append=campaign, assignments=SLOW)
    drags = [run for run in read_campaign(campaign).runs if run.kind == "drag"]
    for run in drags:
        shutil.copy(run.path, run.path.with_name(f"copied {run.path.name}"))
    mark_bad(drags[0].path, "slipped")
    selection = select_runs(campaign)
    assert [experiment.run.info.header.run_id for experiment in selection.experiments] == [drags[1].header.run_id]
    reasons = {exclusion.item: exclusion.reason for exclusion in selection.left_out}
    assert reasons[f"copied {drags[0].path.name}"].endswith("which is marked bad: slipped")
    assert "counts once" in " ".join(reasons.values())
    counting = [row.run_id for row in table_rows(campaign) if row.counts and row.kind == "drag"]
    assert counting == [drags[1].header.run_id]


def test_of_campaigns_together_a_run_counts_once_and_a_mark_in_any_of_them(campaign: Path, tmp_path: Path) -> None:
    second = Path(shutil.copytree(campaign, tmp_path / "second"))
    dragrig.run("drag", append=second, assignments=SLOW)
    (drag,) = [run.path for run in read_campaign(campaign).runs if run.kind == "drag"]
    both = pool_campaigns([campaign, second, campaign])
    assert [len(pooled.campaign.runs) for pooled in both] == [2, 2]
    assert [copy.item for copy in both[1].copies] == [run.path.name for run in read_campaign(campaign).runs]
    assert both[1].copies[0].reason == f"it is the same run as {drag}, which counts once"
    mark_bad(second / drag.name, "slipped")
    assert list(pool_campaigns([campaign, second])[0].campaign.marks) == [drag]
