"""Faults of the drive, its cable and its switches, in motion: real pyserial before the drive's double."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from dragrig.rig.engine import AcquisitionOutcome
from dragrig.rig.hardware.dialects.base import Halt
from dragrig.rig.programme import PlannedRun
from dragrig.rig.runfile import read_campaign
from dragrig.rig.runfile.model import RunStatus
from property_tests import thorough
from rig_faults import (
    FAR_MM,
    SOON_CUT_OFF,
    SOON_SILENT,
    SOON_UNANSWERED,
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


@pytest.mark.parametrize(
    ("fault", "faults", "halt", "assignments", "then"),
    [
        thorough("serial replies late", {"drive_reply_late_s": 8.0}, Halt.STOP, SOON_UNANSWERED, assert_goes_on),
        thorough("serial replies garbled", {"drive_garbled": True}, Halt.STOP, SOON_UNANSWERED, None),
        thorough("serial adapter gone in motion", {"drive_unplugged": True}, Halt.SILENCE, SOON_SILENT, assert_goes_on),
        ("serial plug pulled in motion", {"drive_cut_off": True}, Halt.SILENCE, SOON_CUT_OFF, None),
        thorough("drive alarm", {"drive_alarm": "overheating"}, Halt.ALARM, (), assert_goes_on),
        ("e-stop pressed", {"e_stop_pressed": True}, Halt.EMERGENCY_STOP, (), None),
        thorough("limit switch pressed", {"limit_high_pressed": True}, Halt.LIMIT_SWITCH, (), None),
    ],
)
def test_what_the_drive_or_its_cable_does_ends_the_run(
    faulty_rig: Bench,
    fault: str,
    faults: dict[str, Any],
    halt: Halt,
    assignments: Sequence[str],
    then: Callable[[Bench, Path], None] | None,
) -> None:
    running = begin(faulty_rig, assignments=assignments)
    struck = running.inject(**faults)
    seen = running.person.samples
    ended = running.end()
    run = only_run(ended.folder)
    assert (ended.status, ended.exit_code) == (RunStatus.TRIPPED, 4), ended.message
    assert_stopped(struck, ended.stage, halt, FAR_MM if assignments else TRAVEL_MM)
    assert not ended.stage.enabled
    assert_kept(run, seen)
    assert_reported(fault, ended, run)
    stopped = [event.message for event in run.events if event.kind == "stopped"]
    # A drive stops by itself at an alarm, of which a busy program may hear only then.
    assert stopped or halt is Halt.ALARM
    assert all("mm after the stop" in message for message in stopped)
    if then is not None:
        then(faulty_rig, ended.folder)


@pytest.mark.thorough
def test_a_drive_that_sets_out_too_late_is_no_silent_encoder(faulty_rig: Bench) -> None:
    running = begin(faulty_rig, assignments=["rig.guard.encoder_silent_mm=0.4", "rig.guard.encoder_silent_s=0.2"])

    def hold_back(run: PlannedRun, order: int) -> None:
        faulty_rig.inject(drive_starts_late_s=1.5)

    running.person.run_begins = hold_back  # type: ignore[method-assign]
    ended = running.end()
    run = only_run(ended.folder)
    assert (ended.status, ended.exit_code) == (RunStatus.TRIPPED, 4), ended.message
    assert_reported("drive sets out too late", ended, run)
    assert not ended.stage.moving
    assert_goes_on(faulty_rig, ended.folder)


@pytest.mark.parametrize(
    ("row", "fault"),
    [("clean-up fails, card", "card_unplugged"), thorough("clean-up fails, serial", "drive_unplugged")],
)
def test_a_clean_up_step_that_fails_keeps_no_other_from_being_made(faulty_rig: Bench, row: str, fault: str) -> None:
    running = begin(faulty_rig, assignments=["travel_mm=4"])

    def break_it(run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        faulty_rig.inject(**{fault: True})

    running.person.run_ends = break_it  # type: ignore[method-assign]
    ended = running.end()
    (info,) = read_campaign(ended.folder).runs
    assert info.status is RunStatus.COMPLETE
    assert (ended.status, ended.exit_code) == (RunStatus.FAILED, 5)
    assert sentence(row).fullmatch(ended.message), ended.message
    assert not ended.stage.moving
    assert not ended.stage.enabled
    assert_goes_on(faulty_rig, ended.folder)
