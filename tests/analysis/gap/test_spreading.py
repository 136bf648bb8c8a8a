"""Very long campaigns: which of their runs are diagnosed."""

import shutil
from collections import Counter
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from uuid import uuid4

import h5py
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dragrig.analysis.gap import run_data
from dragrig.analysis.gap.run_data import choose_runs, spread_over_session
from dragrig.rig.runfile import read_run
from dragrig.rig.runfile.model import RunHeader, RunInfo, RunStatus
from places import CAMPAIGN

START = datetime(2026, 5, 4, tzinfo=UTC)


def runs_at(speeds: list[float]) -> list[RunInfo]:
    return [
        RunInfo(
            Path(f"{order:04d}-drag.h5"), 1, RunStatus.COMPLETE,
            RunHeader(
                str(order), START + timedelta(minutes=order), order, "external", "drag", 500.0, (),
                protocol={"speed_mm_s": speed},
            ),
            1000,
        )
        for order, speed in enumerate(speeds)
    ]  # fmt: skip


@given(st.lists(st.sampled_from([0.5, 1.0, 2.0, 5.0, 60.0]), max_size=80), st.integers(5, 40))
def test_conditions_are_all_there_and_none_is_crowded_out(speeds: list[float], maximum: int) -> None:
    runs = runs_at(speeds)
    infos = spread_over_session(runs, maximum)
    assert len(infos) == min(len(runs), maximum)
    assert [info.header.order for info in infos] == sorted(info.header.order for info in infos)
    whole, some = Counter(speeds), Counter(info.header.protocol["speed_mm_s"] for info in infos)
    assert set(some) == set(whole)
    fewest = min((some[speed] for speed in whole if some[speed] < whole[speed]), default=0)
    assert all(some[speed] <= fewest + 1 for speed in whole if some[speed] < whole[speed])


def test_a_condition_is_seen_from_its_first_run_to_its_last() -> None:
    infos = spread_over_session(runs_at([1.0] * 400), 20)
    orders = [info.header.order for info in infos]
    assert (orders[0], orders[-1]) == (0, 399)
    assert max(after - before for before, after in pairwise(orders)) <= 22


def test_a_long_campaign_is_read_in_part_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_data, "MAX_RUNS", 10)
    paths = sorted(CAMPAIGN.glob("*.h5"))
    for copy in range(2):
        for path in paths:
            again = Path(shutil.copy(path, tmp_path / f"{copy:02d}-{path.name}"))
            with h5py.File(again, "r+") as file:
                file["entry"].attrs["run_id"] = str(uuid4())
    selection = choose_runs(tmp_path)
    assert len(selection.experiments) == 10
    assert any(name.startswith(f"of {2 * len(paths)} runs 10 are diagnosed") for name in selection.remarks)
    again = choose_runs([read_run(path) for path in sorted(tmp_path.glob("*.h5"))])
    assert again.remarks[-1] == selection.remarks[-1]
    assert {experiment.file for experiment in again.experiments} == {
        experiment.file for experiment in selection.experiments
    }
    assert not any("are diagnosed" in name for name in choose_runs(CAMPAIGN).remarks)
