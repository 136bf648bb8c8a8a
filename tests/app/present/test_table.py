"""A campaign as a table."""

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from uuid import uuid4

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from scipy.stats import t

import dragrig
from dragrig.analysis.measures import (
    TableRow,
    as_frame,
    mean_over_specimens,
    mean_per_speed,
    measure,
    pooled_rows,
    table_row,
    table_rows,
)
from dragrig.cli.commands import dragrig_group
from dragrig.config.errors import RunFileError
from dragrig.present.campaign import campaign_table_document, mean_tables, steady_force_answer
from dragrig.present.document import FormattedNumber
from dragrig.present.run import measures_table
from dragrig.present.terminal import document_text
from dragrig.rig import mark_bad
from dragrig.rig.runfile import read_run
from places import CAMPAIGN, copied_runs


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    folder = tmp_path / "campaign"
    shutil.copytree(CAMPAIGN, folder)
    return folder


@pytest.fixture
def three(tmp_path: Path) -> Path:
    """A blank run and two drags at 60 mm/s."""
    return copied_runs(tmp_path / "three", "005-blank.h5", "014-drag.h5", "018-drag.h5")


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


def test_a_bad_run_is_shown_and_left_out_of_the_mean(three: Path) -> None:
    before = {(mean.kind, mean.speed_mm_s): mean for mean in mean_per_speed(table_rows(three))}
    assert before["drag", 60.0].runs == 2
    mark_bad(three / "014-drag.h5", "the gut slid off")
    rows = table_rows(three)
    bad = next(row for row in rows if row.bad)
    assert bad.order == 14
    assert bad.mark == "the gut slid off"
    after = {(mean.kind, mean.speed_mm_s): mean for mean in mean_per_speed(rows)}
    assert after["drag", 60.0].runs == 1
    second = next(row for row in rows if row.order == 18)
    assert after["drag", 60.0].steady_above_rest_mN == second.steady_above_rest_mN
    assert after["drag", 60.0].half_width_95_mN is None


def rows_of(specimen: str, *forces: float) -> list[TableRow]:
    row = TableRow("a.h5", specimen=specimen, order=0, kind="drag", speed_mm_s=5.0, status="complete")
    return [replace(row, steady_force_mN=force + 30.0, steady_above_rest_mN=force) for force in forces]


def test_repeats_give_the_mean_above_rest_with_students_interval_and_a_single_run_none() -> None:
    rows = rows_of("A", 100.0, 104.0, 99.0)
    (mean,) = mean_per_speed(rows)
    low, high = t.interval(0.95, df=2, loc=101.0, scale=np.std([100, 104, 99], ddof=1) / np.sqrt(3))
    assert mean.steady_above_rest_mN == pytest.approx(101.0)
    assert mean.half_width_95_mN == pytest.approx((high - low) / 2)
    (single,) = mean_per_speed(rows[:1])
    assert (single.runs, single.half_width_95_mN) == (1, None)
    assert len(mean_per_speed([*rows, replace(rows[0], travel_mm=-40.0)])) == 2
    left_out = [replace(rows[0], status="tripped"), replace(rows[0], steady_above_rest_mN=None),
                replace(rows[0], role="sentinel")]  # fmt: skip
    assert mean_per_speed(left_out) == ()


def at_speeds(forces: Mapping[float, Sequence[float]]) -> list[TableRow]:
    return [replace(row, speed_mm_s=speed) for speed, values in forces.items() for row in rows_of("A", *values)]


def test_two_repeats_that_agree_by_luck_have_the_scatter_of_all_speeds() -> None:
    lucky = at_speeds({0.5: (49.0, 51.0), 5.0: (98.5, 101.5), 20.0: (110.0, 110.01), 60.0: (118.0, 122.0)})
    means = mean_per_speed(lucky)
    relative = [(mean.half_width_95_mN or 0.0) / mean.steady_above_rest_mN for mean in means]
    assert relative == pytest.approx([relative[0]] * 4)
    shares = [
        np.std(values, ddof=1) / np.mean(values) for values in ((49, 51), (98.5, 101.5), (110, 110.01), (118, 122))
    ]
    assert relative[0] == pytest.approx(t.ppf(0.975, 4) * np.sqrt(np.mean(np.square(shares)) / 2))
    assert "(± 95 %, n = 2 runs)." in steady_force_answer(lucky)


def test_scatter_that_differs_between_speeds_is_not_pooled() -> None:
    apart = {1.0: (100.0, 100.1, 100.2, 99.9, 99.8, 100.0), 10.0: (90.0, 112.0, 100.0, 85.0, 118.0, 95.0)}
    calm, wild = mean_per_speed(at_speeds(apart))
    assert calm.half_width_95_mN == pytest.approx(t.ppf(0.975, 5) * np.std(apart[1.0], ddof=1) / np.sqrt(6))
    assert wild.half_width_95_mN == pytest.approx(t.ppf(0.975, 5) * np.std(apart[10.0], ddof=1) / np.sqrt(6))


def test_two_specimens_have_no_interval_of_their_mean() -> None:
    means = mean_per_speed([*rows_of("A", 100.0, 101.0), *rows_of("B", 110.0, 112.0)])
    (over,) = mean_over_specimens(means)
    assert (over.specimens, over.half_width_95_mN) == (2, None)


def test_over_specimens_n_is_the_specimens_not_the_runs() -> None:
    means = mean_per_speed([*rows_of("A", *[100.0] * 50), *rows_of("B", 110.0, 112.0), *rows_of("C", 90.0)])
    (over,) = mean_over_specimens(means)
    assert (over.specimens, over.runs) == (3, 53)
    assert over.steady_above_rest_mN == pytest.approx((100 + 111 + 90) / 3)
    low, high = t.interval(0.95, df=2, scale=np.std([100, 111, 90], ddof=1) / np.sqrt(3))
    assert over.half_width_95_mN == pytest.approx((high - low) / 2)
    assert mean_over_specimens(mean_per_speed(rows_of("A", 1.0, 2.0))) == ()
    text = document_text(campaign_table_document([*rows_of("A", 100.0, 101.0), *rows_of("B", 90.0)]))
    assert "n the specimens, not the runs" in text
    assert "90.0 (one run: no interval)" in text


def test_campaigns_are_pooled_by_the_specimens_ids(three: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    shutil.copytree(three, again)
    for path in again.glob("*.h5"):
        with h5py.File(path, "r+") as file:
            file["entry"].attrs["run_id"] = str(uuid4())
    with h5py.File(again / "014-drag.h5", "r+") as file:
        file["entry/specimen"].attrs["id"] = "pig-2"
    rows = pooled_rows([three, again, three])
    assert len(rows) == 6
    assert {row.campaign for row in rows} == {str(three), str(again)}
    (over,) = (mean for mean in mean_over_specimens(mean_per_speed(rows)) if mean.specimens == 2)
    assert (over.kind, over.speed_mm_s, over.runs) == ("drag", 60.0, 4)
    shown = CliRunner().invoke(dragrig_group, ["table", str(three), str(again), "--json"])
    assert shown.exit_code == 0, shown.output
    assert [mean["specimens"] for mean in json.loads(shown.stdout)["means_over_specimens"]].count(2) == 1
    assert len(dragrig.table([three, again])) == 6


def test_a_run_that_lies_twice_counts_once(three: Path, tmp_path: Path) -> None:
    before = mean_per_speed(table_rows(three))
    shutil.copytree(three, tmp_path / "again")
    assert mean_per_speed(pooled_rows([three, tmp_path / "again"])) == before
    shutil.copy(three / "014-drag.h5", three / "copy.h5")
    rows = table_rows(three)
    assert mean_per_speed(rows) == before
    (copy,) = (row for row in rows if row.copy_of)
    assert {copy.file, copy.copy_of} == {"014-drag.h5", "copy.h5"}
    assert "the same run as" in document_text(campaign_table_document(rows))


def test_speeds_that_differ_by_rounding_are_one_row() -> None:
    row = TableRow("a.h5", "gut", 0, "drag", speed_mm_s=0.5, steady_above_rest_mN=100.0, status="complete")  # fmt: skip
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
    signals = {
        **checks,
        "lost_samples": 0,
        "encoder_mismatch_mm": 0.4,
        "encoder_mismatch_allowed_mm": 0.06,
        "force_response": "along the motion",
    }
    told = table_row(replace(run, info=replace(run.info, checks=signals))).checks
    assert told == "encoder +0.40 mm off, force inverted"
    pulled = {**checks, "noise_after_mN": 35.0, "noise_after_allowed_mN": 3.0, "force_response": "none to a stop"}
    told = table_row(replace(run, info=replace(run.info, checks={**pulled, "lost_samples": 0}))).checks
    assert told == "force does not follow, noise of 35.0 mN began"
    sound = {**signals, "encoder_mismatch_mm": 0.05, "force_response": "resists the motion"}
    assert table_row(replace(run, info=replace(run.info, checks=sound))).checks == "ok"


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


def test_no_column_says_plus_or_minus_without_saying_what() -> None:
    present = Path(dragrig.present.__path__[0])
    bare = [path.name for path in sorted(present.glob("*.py")) if re.search(r"""["']±["']""", path.read_text("utf-8"))]
    assert bare == []


def test_a_run_tells_its_steady_force_with_the_force_at_rest_taken_off() -> None:
    run = read_run(CAMPAIGN / "014-drag.h5")
    measured = measure(run)
    rows = {row[0]: row for row in measures_table(measured).rows}
    assert isinstance(shown := rows["steady − rest"][1], FormattedNumber)
    assert measured.steady_force.value is not None
    assert measured.rest_offset.value is not None
    assert shown.value == pytest.approx(measured.steady_force.value - measured.rest_offset.value)


def test_runs_that_are_in_no_mean_are_counted() -> None:
    (row,) = rows_of("A", 100.0)
    without = replace(row, steady_force_mN=100.0, steady_above_rest_mN=None)
    assert "at rest is not known" not in mean_tables([row])[0].caption
    assert "and 2 runs whose force at rest is not known" in mean_tables([row, without, without])[0].caption
