"""Stops that come before anything moves: between a person's word and the first motion, or while it is planned."""

import threading
import time
from dataclasses import replace

import pytest

from dragrig.config.errors import DeviceError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import CardSettings, HardwareSettings, RigSettings
from dragrig.rig.devices import BackendRequest
from dragrig.rig.engine import Engine
from dragrig.rig.guard import Guard
from dragrig.rig.hardware.backend import HardwareBackend, RigLock
from dragrig.rig.hardware.dialects.base import Command, Halt, Parameter, Request
from dragrig.rig.hardware.dialects.base import Status as DriveStatus
from dragrig.rig.hardware.drive.position_mode import PositionModeStage
from dragrig.rig.hardware.drive.stage_base import Movement
from dragrig.rig.profile import MotionProfile
from dragrig.rig.runfile.model import RunStatus
from driving import driven, linked, until
from simulated import acquire, session, settings, stroke


@pytest.mark.parametrize("command", [Command.HOME, Command.GO])
def test_a_stop_while_limits_are_written_drops_the_motion(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    with driven() as rig:
        rig.ready()
        before = sum(request.command is command for request in rig.drive.requests)
        write = rig.link.set_and_verify

        def stopped_meanwhile(parameter: Parameter, value: float, key: str) -> None:
            if parameter is Parameter.SILENCE_S:
                rig.stage.stop()
            write(parameter, value, key)

        monkeypatch.setattr(rig.link, "set_and_verify", stopped_meanwhile)
        if command is Command.HOME:
            with pytest.raises(DeviceError, match="stopped first"):
                rig.stage.home()
        else:
            rig.stage.move(stroke())
        until(lambda: not rig.sync.moving)
        assert sum(request.command is command for request in rig.drive.requests) == before


def test_a_switch_pressed_while_limits_are_written_stops_what_follows(monkeypatch: pytest.MonkeyPatch) -> None:
    with driven(wired=True) as rig:
        rig.ready()
        rig.bench.place(60.0)
        write = rig.link.set_and_verify

        def pressed_meanwhile(parameter: Parameter, value: float, key: str) -> None:
            if parameter is Parameter.SILENCE_S:
                rig.bench.faults.inject(limit_high_pressed=True)
                assert rig.stage.state().fault is not None
            write(parameter, value, key)

        monkeypatch.setattr(rig.link, "set_and_verify", pressed_meanwhile)
        with pytest.raises(DeviceError, match="upper limit switch"):
            rig.stage.home()
        assert rig.bench.position_mm() > 30.0
        assert not rig.drive.status.homed


def test_nothing_moves_once_an_end_was_requested(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = settings()
    backend = session(rig)
    guard = Guard(rig.guard)
    guard.reset(backend.stage.state())
    moved: list[MotionProfile] = []
    monkeypatch.setattr(backend.stage, "move", moved.append)
    engine = Engine(backend, rig, guard)
    engine.abort("Ctrl-C")
    outcome = engine.acquire(acquire(stroke()))
    assert (outcome.status, outcome.reason, outcome.samples) == (RunStatus.ABORTED, "Ctrl-C", 0)
    assert not moved


class Interrupted(threading.Event):
    """An event that a second signal meets while the first one sets it."""

    engine: Engine | None = None

    def set(self) -> None:
        with self._cond:  # type: ignore[attr-defined]  # what a thread holds inside `set`
            if self.engine is not None:
                self.engine.abort("again")
        super().set()


def test_a_second_signal_inside_the_first_one_hangs_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dragrig.rig.engine.Signal", Interrupted)
    rig = settings()
    engine = Engine(session(rig), rig, Guard(rig.guard))
    assert isinstance(engine.cancelled, Interrupted)
    engine.cancelled.engine = engine
    signalled = threading.Thread(target=engine.abort, args=("first",), daemon=True)
    signalled.start()
    signalled.join(600.0)
    assert not signalled.is_alive()
    assert engine.abort_reason == "first"
    assert engine.cancelled.is_set()


def test_a_look_does_not_touch_a_rig_that_another_program_is_at() -> None:
    rig = RigSettings(hardware=HardwareSettings(card=CardSettings(device="TakenByAnother")))
    backend = HardwareBackend(replace(BackendRequest(rig, FrictionModelSettings()), connect=False))
    with RigLock(rig.hardware):
        findings = list(backend.examine())
        backend.close()
    assert [(finding.name, finding.passed) for finding in findings] == [("owner", False)]


def test_an_emergency_stop_between_two_motions_stays_until_the_drive_was_switched_off() -> None:
    with driven(wired=True) as rig:
        rig.ready()
        rig.bench.faults.inject(e_stop_pressed=True)
        until(lambda: rig.stage.fault is not None)
        rig.bench.faults.clear()
        with pytest.raises(DeviceError, match="emergency stop"):
            rig.stage.move(stroke())
        rig.stage.disable()
        rig.stage.enable()
        assert rig.stage.state().fault is None


def test_an_emergency_stop_let_go_before_the_drive_is_switched_on_forbids_nothing() -> None:
    with driven(wired=True) as rig:
        rig.bench.faults.inject(e_stop_pressed=True)
        until(lambda: rig.stage.fault is not None)
        rig.bench.faults.clear()
        rig.stage.enable()


def test_what_moves_already_is_stopped_before_the_heartbeat_begins() -> None:
    with driven() as rig:
        rig.ready()
        for parameter, value in ((Parameter.SPEED_MM_S, 20.0), (Parameter.ACCELERATION_MM_S2, 500.0)):
            rig.drive.act(Request(Command.SET, parameter, value))
        rig.drive.act(Request(Command.GO, value=140.0))
        later = PositionModeStage(rig.devices)
        try:
            until(lambda: not rig.bench.moving)
            assert rig.drive.status.halt is Halt.STOP
            assert rig.bench.position_mm() < 130.0
        finally:
            later.close()


def test_a_drive_that_sets_out_late_is_not_taken_for_one_that_has_arrived() -> None:
    with linked() as (_, link):
        movement = Movement(link, link.stop_count)
        movement.mark_started()
        movement.mark_complete()
        now_s = time.monotonic()
        stood = DriveStatus(enabled=True, homed=True, moving=False, halt=Halt.LIMIT_SWITCH)
        arrived, moves = replace(stood, halt=Halt.TARGET), replace(stood, moving=True)
        assert movement.stop_trip(stood, now_s) is None
        assert not movement.is_over(arrived, now_s)
        assert movement.stop_trip(stood, now_s + 1.0) is not None
        assert movement.is_over(arrived, now_s + 1.0)
        assert movement.stop_trip(moves, now_s) is None
        assert movement.stop_trip(stood, now_s) is not None
        assert movement.is_over(arrived, now_s)
