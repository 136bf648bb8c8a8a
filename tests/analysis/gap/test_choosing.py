"""Which runs of a campaign a diagnosis takes, and what it says of the others."""

import shutil
from pathlib import Path

import h5py
import pytest

from dragrig.analysis.gap.run_data import choose_runs
from dragrig.rig import mark_bad
from dragrig.rig.runfile import read_run
from places import CAMPAIGN


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    return Path(shutil.copytree(CAMPAIGN, tmp_path / "campaign"))


def changed(path: Path, group: str, **attributes: str) -> str:
    with h5py.File(path, "r+") as file:
        for name, value in attributes.items():
            file[group].attrs[name] = value
    return path.name


def test_of_two_specimens_the_one_with_most_runs_is_diagnosed(campaign: Path) -> None:
    name = changed(campaign / "010-drag.h5", "entry/specimen", name="ileum")
    selection = choose_runs(campaign)
    assert selection.specimen == "jejunum"
    assert {exclusion.item: exclusion.reason for exclusion in selection.left_out}[name].startswith(
        "it is of specimen ileum; most runs"
    )
    assert [experiment.file for experiment in choose_runs(campaign, "ileum").experiments] == [name]


def test_runs_of_another_sensor_are_left_out_and_told(campaign: Path) -> None:
    paths = sorted(campaign.glob("*.h5"))
    for place, path in enumerate(paths):
        changed(path, "entry", sensor_serial="old" if place < 3 else "new", calibration_id=f"c{place % 2}")
    selection = choose_runs(campaign)
    reasons = {exclusion.item: exclusion.reason for exclusion in selection.left_out}
    assert set(reasons) == {path.name for path in paths[:3]}
    assert set(reasons.values()) == {"it was measured with force sensor old, most runs with new"}
    assert any("calibration changes during the campaign (c0, c1)" in name for name in selection.remarks)


def test_runs_marked_bad_count_for_nothing(campaign: Path) -> None:
    for path in sorted(campaign.glob("*.h5"))[:-1]:
        changed(path, "entry/specimen", name="ileum")
        mark_bad(path, "slipped")
    assert choose_runs(campaign).specimen == "jejunum"


def test_runs_that_note_no_contact_age_are_used_and_told(campaign: Path) -> None:
    with h5py.File(campaign / "010-drag.h5", "r+") as file:
        del file["entry"].attrs["insertion_dwell_s"]
    selection = choose_runs(campaign)
    assert any(name.startswith("1 of ") and "60 s are assumed" in name for name in selection.remarks)
    assert choose_runs([read_run(path) for path in sorted(campaign.glob("*.h5"))]).remarks == selection.remarks


def test_a_run_that_lies_twice_in_a_folder_counts_once(campaign: Path) -> None:
    before = choose_runs(campaign)
    shutil.copy(campaign / "010-drag.h5", campaign / "010-drag-copy.h5")
    after = choose_runs(campaign)
    ids = [experiment.run.info.header.run_id for experiment in after.experiments]
    assert len(ids) == len(set(ids)) == len(before.experiments)
    assert [left.reason for left in after.left_out if "copy" in left.reason or "010-drag" in left.what] == [
        "it is the same run as 010-drag-copy.h5, which counts once"
    ]


def test_runs_in_memory_count_once_too(campaign: Path) -> None:
    shutil.copy(campaign / "010-drag.h5", campaign / "010-drag-copy.h5")
    runs = [read_run(campaign / name) for name in ("001-relaxation.h5", "010-drag.h5", "010-drag-copy.h5")]
    assert len(choose_runs(runs).experiments) == 2


def test_the_choice_between_two_specimens_is_remarked(campaign: Path) -> None:
    changed(campaign / "010-drag.h5", "entry/specimen", name="ileum")
    remarks = choose_runs(campaign).remarks
    assert any("jejunum" in remark and "ileum (1 run)" in remark and "--specimen" in remark for remark in remarks)
    assert not any("--specimen" in remark for remark in choose_runs(campaign, "ileum").remarks)
