"""A campaign as a table."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dragrig.analysis.measures import TableRow, as_frame, mean_per_speed, table_row, table_rows
from dragrig.config.errors import RunFileError
from dragrig.rig.runfile import mark_bad, read_run

CAMPAIGN = Path(__file__).parent / "data" / "campaign"


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    folder = tmp_path / "campaign"
    shutil.copytree(CAMPAIGN, folder)
    return folder


def test_every_run_has_a_row_in_order(campaign: Path) -> None:
    seen: list[tuple[int, int]] = []
    rows = table_rows(campaign, lambda done, of: seen.append((done, of)))
    assert [row.order for row in rows] == [1, 5, 8, 10, 14, 18, 22, 23]
    assert [row.kind for row in rows] == ["relaxation", "blank", "coulomb", *["drag"] * 5]
    assert seen[0] == (0, 8)
    assert seen[-1] == (8, 8)
    relaxation, blank, coulomb, *drags = rows
    assert relaxation.steady_force_mN is None
    assert "no steady sliding" in relaxation.remark
    assert relaxation.shear_strain == 1.0
    assert relaxation.peak_force_mN == pytest.approx(1696, abs=5)
    assert relaxation.hold_force_mN == pytest.approx(681, abs=2)
    assert coulomb.speed_mm_s == 40.0
    assert coulomb.steady_force_mN == pytest.approx(53.8, abs=0.5)
    assert blank.rest_offset_mN == pytest.approx(blank.steady_force_mN, abs=3)
    assert all(row.steady_force_error_mN is not None and 0 < row.steady_force_error_mN < 3 for row in drags)
    assert all(row.capsule == "12.9 × 15.2 mm, 50.1 g" and row.travel_mm == 40 for row in drags)
    assert all(row.status == "complete" and not row.bad for row in rows)


def test_a_bad_run_is_shown_and_left_out_of_the_mean(campaign: Path) -> None:
    before = {(mean.kind, mean.speed_mm_s): mean for mean in mean_per_speed(table_rows(campaign))}
    assert before["drag", 60.0].runs == 2
    mark_bad(campaign / "014-drag.h5", "the gut slid off")
    rows = table_rows(campaign)
    bad = next(row for row in rows if row.bad)
    assert bad.order == 14
    assert bad.mark == "the gut slid off"
    after = {(mean.kind, mean.speed_mm_s): mean for mean in mean_per_speed(rows)}
    assert after["drag", 60.0].runs == 1
    second = next(row for row in rows if row.order == 18)
    assert after["drag", 60.0].steady_force_mN == second.steady_force_mN
    assert after["drag", 60.0].standard_error_mN == second.steady_force_error_mN


def test_repeats_are_averaged_with_the_larger_error() -> None:
    row = TableRow("a.h5", "gut", 0, "drag", speed_mm_s=5.0, steady_force_mN=100.0, steady_force_error_mN=1.0,
                   status="complete")  # fmt: skip
    (scattered,) = mean_per_speed([row, replace(row, steady_force_mN=110.0)])
    assert scattered.steady_force_mN == 105
    assert scattered.standard_error_mN == pytest.approx(5.0)
    (close,) = mean_per_speed([row, replace(row, steady_force_mN=100.1)])
    assert close.standard_error_mN == pytest.approx(np.sqrt(2) / 2)
    assert len(mean_per_speed([row, replace(row, travel_mm=-40.0)])) == 2
    assert mean_per_speed([replace(row, status="tripped"), replace(row, steady_force_mN=None)]) == ()


def test_speeds_that_differ_by_rounding_are_one_row() -> None:
    row = TableRow("a.h5", "gut", 0, "drag", speed_mm_s=0.5, steady_force_mN=100.0, steady_force_error_mN=1.0,
                   status="complete")  # fmt: skip
    speeds = (0.49999999, 0.5, 0.50000001, 0.505, 12.345)
    means = mean_per_speed([replace(row, speed_mm_s=speed) for speed in speeds])
    assert [(mean.speed_mm_s, mean.runs) for mean in means] == [(0.5, 3), (0.505, 1), (12.345, 1)]


def test_a_damaged_file_and_a_recording_get_rows_that_say_so(campaign: Path) -> None:
    (campaign / "005-blank.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    shutil.copy(campaign / "008-coulomb.h5", campaign / "099-drag.recording.h5")
    rows = {row.file: row for row in table_rows(campaign)}
    assert rows["005-blank.h5"].status == "unreadable"
    assert rows["005-blank.h5"].remark
    assert rows["099-drag.recording.h5"].status == "recording"
    assert not rows["005-blank.h5"].counts


def test_checks_are_told_in_words() -> None:
    run = read_run(CAMPAIGN / "014-drag.h5")
    checks = {"lost_samples": 3, "clipped_samples": 0, "slip_time_s": -1.0}
    assert table_row(replace(run, info=replace(run.info, checks=checks))).checks == "3 lost"
    assert table_row(replace(run, info=replace(run.info, checks={**checks, "lost_samples": 0}))).checks == "ok"
    assert table_row(run).checks == ""


def test_the_frame_has_the_fields_as_columns() -> None:
    rows = table_rows(CAMPAIGN)
    frame = as_frame(rows)
    assert len(frame) == 8
    assert frame["steady_force_mN"].dtype == np.float64
    assert np.isnan(frame["steady_force_mN"][0])
    assert frame["steady_force_mN"][4] == rows[4].steady_force_mN
    assert as_frame(mean_per_speed(rows))["runs"].sum() == 7
    assert list(as_frame([]).columns) == list(frame.columns)


def test_a_missing_folder_is_said(tmp_path: Path) -> None:
    with pytest.raises(RunFileError, match="no such folder"):
        table_rows(tmp_path / "nowhere")
