"""Which runs an identification refuses to use, and that it says why."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt
import pytest

from dragrig.analysis.identification.identify import fit_jointly
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.analysis.selection import select_loaded_runs, select_runs
from dragrig.config.errors import AnalysisError
from dragrig.rig.runfile import read_run
from places import CAMPAIGN

FloatArray = npt.NDArray[np.float64]


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    return Path(shutil.copytree(CAMPAIGN, tmp_path / "campaign"))


def change(path: Path, channel: str, how: Callable[[FloatArray], npt.ArrayLike]) -> None:
    with h5py.File(path, "r+") as file:
        values = file["entry/trace"][channel]
        values[...] = how(values[()].astype(float))


def reasons(folder: Path) -> dict[str, str]:
    return {exclusion.item: exclusion.reason for exclusion in select_runs(folder).left_out}


@pytest.mark.parametrize("channel", ["force", "position"])
def test_a_run_with_a_wrong_sign_is_left_out(campaign: Path, channel: str) -> None:
    names = ["001-relaxation.h5", "008-coulomb.h5", "010-drag.h5"]
    for name in names:
        change(campaign / name, channel, np.negative)
    result = reasons(campaign)
    assert list(result) == names
    assert all("wrong sign" in reason for reason in result.values())


def test_a_run_without_position_or_force_is_left_out(campaign: Path) -> None:
    change(campaign / "010-drag.h5", "force", lambda force: np.full_like(force, np.nan))
    change(campaign / "014-drag.h5", "position", lambda position: np.full_like(position, np.nan))
    change(campaign / "018-drag.h5", "force", lambda force: np.full_like(force, 12.5))
    result = reasons(campaign)
    assert "100% of its samples" in result["010-drag.h5"]
    assert "positions are missing" in result["014-drag.h5"]
    assert "never changes" in result["018-drag.h5"]


@pytest.mark.parametrize(("begin_s", "usable"), [(1.3, True), (1.6, False)])
def test_a_gap_is_bridged_only_where_the_speed_stays(campaign: Path, begin_s: float, usable: bool) -> None:
    path = campaign / "014-drag.h5"
    with h5py.File(path, "r+") as file:
        trace = file["entry/trace"]
        time = trace["time"][()]
        remaining = (time < begin_s) | (time >= begin_s + 0.2)
        for name in list(trace):
            values, attributes = trace[name][()][remaining], dict(trace[name].attrs)
            del trace[name]
            trace.create_dataset(name, data=values).attrs.update(attributes)
    assert ("changes speed" in reasons(campaign).get(path.name, "")) is not usable


def test_backward_runs_and_untared_sensors_are_no_wrong_signs(campaign: Path) -> None:
    for channel in ("force", "position"):
        change(campaign / "010-drag.h5", channel, np.negative)
    for path in campaign.glob("*.h5"):
        change(path, "force", lambda force: force - 300.0)
    assert reasons(campaign) == {}


def test_many_runs_with_one_fault_are_told_in_one_short_sentence(campaign: Path) -> None:
    for path in campaign.glob("*.h5"):
        with h5py.File(path, "r+") as file:
            file["entry"].attrs["status"] = "aborted"
    with pytest.raises(AnalysisError, match=r"001-relaxation\.h5 and 7 more: it is aborted") as raises:
        select_runs(campaign)
    assert len(str(raises.value)) < 300


def test_a_folder_of_damaged_files_says_what_is_wrong_with_them(tmp_path: Path) -> None:
    (tmp_path / "one.h5").write_bytes(b"nothing")
    with pytest.raises(AnalysisError, match=r"one\.h5"):
        select_runs(tmp_path)


def test_a_name_that_two_specimens_share_is_not_guessed(campaign: Path) -> None:
    for path in campaign.glob("*.h5"):
        with h5py.File(path, "r+") as file:
            file["entry/specimen"].attrs["id"] = "a" if "drag" in path.name else "b"
    with pytest.raises(AnalysisError, match="several specimens are called jejunum; name one of a, b"):
        select_runs(campaign, "jejunum")
    assert len(select_runs(campaign, "b").experiments) == 3


def test_runs_in_memory_that_cannot_be_told_apart_are_refused() -> None:
    run = read_run(CAMPAIGN / "010-drag.h5")
    elsewhere = replace(run, info=replace(run.info, path=Path("other") / run.info.path.name))
    with pytest.raises(AnalysisError, match="several are called"):
        select_loaded_runs([run, elsewhere])


def test_a_drag_that_says_it_had_no_gut_is_no_blank_run(campaign: Path) -> None:
    with h5py.File(campaign / "010-drag.h5", "r+") as file:
        file["entry/specimen"].attrs["fixture"] = "none"
    assert "fixture is none, yet moving takes" in reasons(campaign)["010-drag.h5"]


def test_a_model_that_predicts_nothing_says_what_was_recorded(campaign: Path) -> None:
    for path in campaign.glob("*.h5"):
        with h5py.File(path, "r+") as file:
            trace = file["entry/trace"]
            trace.move("force", "motor_force")
            trace.attrs["signal"] = "motor_force"
    with pytest.raises(AnalysisError, match=r"recorded .*motor_force.*; name another model with --nominal"):
        fit_jointly(select_runs(campaign), MODEL)
