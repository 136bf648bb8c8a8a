"""Faults of the card and of what is wired to it, in motion: real nidaqmx over gRPC before the card's double."""

from collections.abc import Callable, Sequence
from ctypes.util import find_library
from pathlib import Path

import numpy as np
import pytest
from nidaqmx.constants import AcquisitionType, TaskMode
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

from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.dialects.base import Halt
from dragrig.rig.runfile import read_campaign
from dragrig.rig.runfile.model import RunStatus


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
    assert_goes_on(faulty_rig, ended.folder)


@pytest.mark.parametrize(
    ("fault", "faults", "assignments", "then"),
    [
        ("encoder stuck", {"encoder_stuck": True}, SOON_STUCK, assert_goes_on),
        ("force over range", {"force_added_mN": 9950.0}, (), assert_goes_on),
        ("force over the limit", {"force_added_mN": RIG.guard.force_limit_mN + 500.0}, (), None),
        ("force sensor's wire broken", {"sensor_open": True}, (), None),
        ("force input dead", {"force_constant_V": 4.9}, (), assert_goes_on),
        ("encoder loses counts", {"encoder_added_counts": -400}, (), assert_goes_on),
        ("encoder's error line", {"encoder_error": True}, (), assert_goes_on),
        ("card delivers no samples", {"card_stalled": True}, SOON_STALE, None),
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
    assert_goes_on(faulty_rig, ended.folder)


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
    assert_goes_on(faulty_rig, ended.folder)


@pytest.mark.skipif(find_library("nidaqmx") is not None, reason="this computer has NI's driver")
def test_without_ni_driver_nothing_moves_and_one_sentence_says_what_to_install(faulty_rig: Bench) -> None:
    before = faulty_rig.look()
    ended = begin(faulty_rig, assignments=["rig.hardware.card.server=''"]).end()
    assert ended.exit_code == 5
    assert sentence("driver missing").fullmatch(ended.message), ended.message
    assert faulty_rig.look() == before
    assert not ended.folder.exists()
    again = begin(faulty_rig).end()
    assert (again.status, len(read_campaign(again.folder).runs)) == (RunStatus.COMPLETE, 1)
