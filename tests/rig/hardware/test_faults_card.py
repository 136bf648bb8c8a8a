"""Faults of the card and of what is wired to it, in motion: real nidaqmx before the card's double."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from nidaqmx.constants import AcquisitionType, TaskMode

import dragrig as api
from dragrig.cli import main
from dragrig.config.rig import Calibration
from dragrig.rig.calibration import append_calibration
from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.dialects.base import Halt
from dragrig.rig.runfile.model import RunStatus
from property_tests import thorough
from rig_faults import (
    FAR_MM,
    RIG,
    SOON_STALE,
    SOON_STUCK,
    TRAVEL_MM,
    Bench,
    assert_goes_on,
    assert_kept,
    assert_reported,
    assert_stopped,
    begin,
    only_run,
    sentence,
)

pytestmark = pytest.mark.usefixtures("finished_here")


def test_a_card_unplugged_in_motion_leaves_the_stage_stopped_by_serial(faulty_rig: Bench) -> None:
    running = begin(faulty_rig)
    struck = running.inject(card_unplugged=True)
    seen = running.person.samples
    ended = running.end()
    run = only_run(ended.folder)
    assert (ended.status, ended.exit_code) == (RunStatus.FAILED, 5)
    assert_stopped(struck, ended.stage, Halt.STOP)
    assert not ended.stage.enabled
    assert_kept(run, seen)
    assert_reported("card unplugged in motion", ended, run)


@pytest.mark.parametrize(
    ("fault", "faults", "assignments", "then"),
    [
        thorough("encoder stuck", {"encoder_stuck": True}, SOON_STUCK, None),
        thorough("force over range", {"force_added_mN": 9950.0}, (), assert_goes_on),
        thorough("force over the limit", {"force_added_mN": RIG.guard.force_limit_mN + 500.0}, (), None),
        thorough("force sensor's wire broken", {"sensor_open": True}, (), None),
        thorough("force input dead", {"force_constant_V": 4.9}, (), None),
        thorough("encoder loses counts", {"encoder_added_counts": -400}, (), assert_goes_on),
        thorough("encoder's error line", {"encoder_error": True}, (), assert_goes_on),
        thorough("card delivers no samples", {"card_stalled": True}, SOON_STALE, None),
    ],
)
def test_what_the_samples_show_stops_the_stage(
    faulty_rig: Bench,
    fault: str,
    faults: dict[str, float],
    assignments: Sequence[str],
    then: Callable[[Bench, Path], None] | None,
) -> None:
    running = begin(faulty_rig, assignments=assignments)
    struck = running.inject(**faults)
    seen = running.person.samples
    ended = running.end()
    run = only_run(ended.folder)
    assert (ended.status, ended.exit_code) == (RunStatus.TRIPPED, 4), ended.message
    assert_stopped(struck, ended.stage, Halt.STOP, FAR_MM if assignments else TRAVEL_MM)
    assert_kept(run, seen)
    assert_reported(fault, ended, run)
    if then is not None:
        then(faulty_rig, ended.folder)


@pytest.fixture
def calibrated(faulty_rig: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A lab folder of the same rig, calibrated with the sensor's noise."""
    for file in ("rig.toml", "plan.toml"):
        (tmp_path / file).write_text((faulty_rig.lab / file).read_text("utf-8"), "utf-8")
    for quantity, gain, noise_uV in (("force", RIG.hardware.card.force.per_V, 700.0), ("encoder", 0.001, 0.0)):
        entry = Calibration(
            id=quantity, made_at=datetime.now().astimezone(), quantity=quantity, gain=gain, noise_uV=noise_uV
        )
        append_calibration(tmp_path, entry)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("faults", "check", "words"),
    [
        thorough({"force_constant_V": 1e-9}, "force sensor", "repeats 0.000 V"),
        ({"force_constant_V": 4.9}, "force sensor", "repeats 4.900 V"),
        ({"force_dead": True}, "force sensor", "of noise at"),
        thorough({"force_rail_V": 5.0, "force_added_mN": 7000.0}, "force sensor", "of noise at 5.00"),
        thorough({"sensor_open": True}, "force sensor", "the end of its range"),
        thorough({"force_tone_mN": 200.0, "force_tone_hz": 16_000.0}, "aliases", "tone of 16000 Hz"),
        ({"encoder_jitter_counts": 200}, "encoder", "while nothing moved"),
        ({"encoder_error": True}, "switches", "read head reports an error"),
    ],
)
def test_a_check_finds_what_the_signals_show_at_rest(
    faulty_rig: Bench,
    calibrated: Path,
    capsys: pytest.CaptureFixture[str],
    faults: Mapping[str, float],
    check: str,
    words: str,
) -> None:
    faulty_rig.inject(**faults)
    assert main(["check", "--json"]) != 0
    failed = {row["what"]: row["detail"] for row in json.loads(capsys.readouterr().out) if not row["fine"]}
    # With the error line down the drive is not examined either.
    assert set(failed) - {"drive"} == {check}
    assert words in failed[check]


def test_a_check_of_an_untouched_rig_finds_nothing(
    faulty_rig: Bench, calibrated: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", "--json"]) == 0
    details = {row["what"]: row["detail"] for row in json.loads(capsys.readouterr().out)}
    assert "a dead input has less than" in details["force sensor"]
    assert details["sampling rate"].startswith("1000 Hz where 1000 are asked, 25 samples of the card each")


@pytest.mark.thorough
def test_an_amplifier_that_goes_off_trips_a_calibrated_rig(faulty_rig: Bench, calibrated: Path) -> None:
    running = begin(faulty_rig, rig=calibrated / "rig.toml")
    struck = running.inject(force_dead=True)
    ended = running.end()
    assert (ended.status, ended.exit_code) == (RunStatus.TRIPPED, 4), ended.message
    assert_stopped(struck, ended.stage, Halt.STOP)
    assert_reported("force amplifier off", ended, only_run(ended.folder))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("faults", "check", "finding"),
    [
        ({"force_dead": True}, ("force_response", "none"), "force dead"),
        ({"encoder_lost_share": 0.01}, ("encoder_mismatch_mm", -0.18), "encoder -0.18 mm off"),
    ],
)
def test_what_only_a_whole_run_shows_is_marked_in_its_file_and_in_the_table(
    faulty_rig: Bench, faults: Mapping[str, float], check: tuple[str, object], finding: str
) -> None:
    faulty_rig.inject(**faults)
    ended = begin(faulty_rig).end()
    assert (ended.status, ended.exit_code) == (RunStatus.COMPLETE, 0), ended.message
    assert only_run(ended.folder).info.checks[check[0]] == check[1]
    assert finding in set(api.table(ended.folder)["checks"])


@pytest.mark.thorough
def test_a_cable_that_floats_from_mid_stroke_on_is_marked_in_file_and_table(faulty_rig: Bench) -> None:
    running = begin(faulty_rig)
    running.inject(force_floats_mN=350.0, force_floats_hum_mN=50.0)
    ended = running.end()
    assert (ended.status, ended.exit_code) == (RunStatus.COMPLETE, 0), ended.message
    run = only_run(ended.folder)
    noted = "\n".join(running.person.noted)
    for fault in ("force cable pulled, input floats", "force cable pulled, force goes on over a stop"):
        assert sentence(fault).search(noted), noted
    checks = run.info.checks
    assert float(checks["noise_after_mN"]) == pytest.approx(35.0, rel=0.1)
    assert checks["force_response"] == "none to a stop"
    (told,) = set(api.table(ended.folder)["checks"])
    assert re.fullmatch(r"force does not follow, noise of 3\d\.\d mN began", told)


@pytest.mark.thorough
@pytest.mark.parametrize("late_s", [0.03, 0.06])
def test_the_files_uncertainty_of_the_start_covers_a_drive_that_sets_out_late(faulty_rig: Bench, late_s: float) -> None:
    faulty_rig.inject(drive_starts_late_s=late_s)
    ended = begin(faulty_rig).end()
    assert ended.exit_code == 0, ended.message
    run = only_run(ended.folder)
    moved_s = [
        float(run.trace.time[np.flatnonzero(np.abs(path) > 0.01)[0]])
        for path in (run.trace.command, run.trace.position)
    ]
    stated_s = float(run.info.header.entry["command_t0_uncertainty_s"])
    assert moved_s[1] - moved_s[0] >= 0.8 * late_s
    assert stated_s >= moved_s[1] - moved_s[0] - 0.002


@pytest.mark.thorough
def test_a_file_has_the_rate_that_the_card_really_makes(faulty_rig: Bench) -> None:
    ended = begin(faulty_rig, assignments=["rig.sampling.rate_hz=3000"]).end()
    assert ended.exit_code == 0, ended.message
    run = only_run(ended.folder)
    real_hz = 20e6 / 833 / 8
    assert run.info.header.sample_rate_hz == pytest.approx(real_hz, rel=1e-12)
    assert run.trace.time[-1] == pytest.approx((run.info.samples - 1) / real_hz, rel=1e-9)
    steady = (run.trace.position > 5.0) & (run.trace.position < 15.0)
    speed_mm_s = np.polyfit(run.trace.time[steady], run.trace.position[steady], 1)[0]
    assert speed_mm_s == pytest.approx(6.0, rel=2e-4)


def test_an_overrun_trips_with_its_gap_recorded(faulty_rig: Bench) -> None:
    running = begin(faulty_rig)
    struck = running.inject(overwritten_samples=25 * 210)
    ended = running.end()
    run = only_run(ended.folder)
    assert (ended.status, ended.exit_code) == (RunStatus.TRIPPED, 4), ended.message
    assert_stopped(struck, ended.stage, Halt.STOP)
    assert_reported("overrun", ended, run)
    steps = np.rint(np.diff(run.trace.time) * 1000.0).astype(int)
    (gap,) = steps[steps != 1]
    assert gap > 200
    assert run.info.checks["lost_samples"] == gap - 1
    assert [event.message.split()[0] for event in run.events if event.kind == "gap"] == [str(gap - 1)]


@pytest.mark.thorough
def test_a_timeout_with_partial_data_costs_nothing(faulty_rig: Bench) -> None:
    running = begin(faulty_rig)
    running.inject(short_reads=3)
    ended = running.end()
    assert (ended.status, ended.exit_code, ended.message) == (RunStatus.COMPLETE, 0, "")
    run = only_run(ended.folder)
    assert run.info.checks["lost_samples"] == 0
    assert_kept(run, round(run.trace.time[-1] * 1000) + 1)
    assert ended.stage.halt is Halt.TARGET


def test_a_card_that_another_program_has_is_left_to_it(faulty_rig: Bench) -> None:
    connection = Connection(faulty_rig.doubles.rig().hardware.card)
    with connection.task("another program's") as task:
        task.ai_channels.add_ai_voltage_chan("Dev1/ai0")
        task.timing.cfg_samp_clk_timing(1000.0, sample_mode=AcquisitionType.CONTINUOUS)
        task.control(TaskMode.TASK_RESERVE)
        ended = begin(faulty_rig).end()
        assert ended.exit_code == 5
        assert sentence("card taken by another program").fullmatch(ended.message), ended.message
        assert not ended.stage.moving
        assert not ended.stage.enabled
        assert task.name
    connection.close()
