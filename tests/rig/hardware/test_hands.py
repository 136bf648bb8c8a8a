"""What a person does at the real rig, on the doubles of its devices: jogs, overrides, touching off, calibrating."""

import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

from dragrig.config.errors import DeviceError, TrippedError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import GuardSettings, RigSettings
from dragrig.rig.calibration import fit_encoder, fit_force
from dragrig.rig.devices import BackendRequest, TravelEnd, TripCause
from dragrig.rig.engine import Engine
from dragrig.rig.guard import Guard
from dragrig.rig.hardware.drive.position_mode import PositionModeStage
from dragrig.rig.hardware.lines import CardLines, SwitchStates
from dragrig.rig.hardware.sync import MotionSamplingSync
from dragrig.rig.manual import ManualControl, measure_loads, measure_pushed_travel
from dragrig.rig.operator import Answer, Prompt
from dragrig.rig.reading import Reading
from dragrig.rig.runfile.model import RunStatus
from dragrig.sim_backend.doubles.backend import DoubleBackend
from dragrig.sim_backend.doubles.simulated_bench import FaultInjector
from driving import Room, until
from engine_clients import hold_the_interpreter
from property_tests import thorough
from simulated import acquire, stroke

PACE = 3.0
# On a busy machine a start can be late, and so can samples and replies.
RIG = RigSettings.model_validate(
    {
        "hardware": {"drive": {"homing_speed_mm_s": 50.0, "reply_s": 2.0, "silence_s": 5.0}, "hang_s": 2.0},
        "guard": {"following_error_mm": 50.0, "encoder_silent_mm": 50.0, "stale_data_s": 5.0},
        "stage": {"start_mm": 5.0},
    }
)


@dataclass
class Bench:
    """An open double, and a person who does what is asked of hands."""

    backend: DoubleBackend
    faults: FaultInjector
    guard: Guard
    engine: Engine
    prompts: list[Prompt]

    def __post_init__(self) -> None:
        self.manual = ManualControl(self.backend, self.guard, self.engine, self)

    def ask(self, prompt: Prompt) -> Answer:
        self.prompts.append(prompt)
        return Answer.DONE

    def homes(self, *, over: bool) -> None:
        pass


@pytest.fixture(scope="module")
def room() -> Iterator[Room[DoubleBackend]]:
    room = Room(lambda: DoubleBackend(BackendRequest(RIG, FrictionModelSettings(), pace=PACE)))
    yield room
    room.clear()


@pytest.fixture
def bench(room: Room[DoubleBackend]) -> Iterator[Bench]:
    """A rig that stands switched off, and whose guard is tripped."""
    backend, guard = room.rig(), Guard(RIG.guard, 0.001)
    yield Bench(backend, backend.bench.faults, guard, Engine(backend, RIG, guard), [])
    backend.bench.faults.clear()
    backend.sampler.stop()
    backend.stage.stop()
    until(lambda: not backend.bench.moving)
    backend.stage.disable()
    backend.stage.enable()
    backend.stage.home()
    backend.stage.disable()


@contextmanager
def another(room: Room[DoubleBackend], rig: RigSettings, guard_settings: GuardSettings = RIG.guard) -> Iterator[Bench]:
    """A rig of other settings, homed."""
    room.clear()
    backend = DoubleBackend(BackendRequest(rig, FrictionModelSettings()))
    try:
        guard = Guard(guard_settings, 0.001)
        made = Bench(backend, backend.bench.faults, guard, Engine(backend, rig, guard), [])
        made.manual.reset()
        made.manual.home()
        yield made
    finally:
        backend.close()


@pytest.mark.parametrize(("late_s", "busy_s"), [(0.5, 0.0), (0.15, 0.1)], ids=["stopped before", "sets out meanwhile"])
def test_a_drive_that_sets_out_too_late_is_not_called_a_silent_encoder(
    room: Room[DoubleBackend], late_s: float, busy_s: float
) -> None:
    with another(room, RIG, RIG.guard.model_copy(update={"encoder_silent_mm": 0.4})) as late:
        late.faults.inject(drive_starts_late_s=late_s)
        stop = late.backend.stage.stop

        def stop_on_a_busy_computer() -> None:
            time.sleep(busy_s)
            stop()

        late.backend.stage.stop = stop_on_a_busy_computer  # type: ignore[method-assign]
        with pytest.raises(TrippedError, match=r"no motion: neither drive nor encoder moved for \d+ ms"):
            late.manual.jog(20.0, 20.0)
        assert late.manual.trip is not None
        assert late.manual.trip.cause is TripCause.NO_MOTION


def test_a_motion_that_is_not_over_long_after_its_time_is_stopped_and_said(room: Room[DoubleBackend]) -> None:
    hardware = RIG.hardware.model_copy(update={"hang_s": 10.0})
    rig = RIG.model_copy(update={"hardware": hardware, "guard": RIG.guard.model_copy(update={"stale_data_s": 3.0})})
    with another(room, rig, rig.guard) as late:
        late.faults.inject(drive_starts_late_s=15.0)
        with pytest.raises(DeviceError, match="had not made its motion 3 s after"):
            late.manual.jog(5.0)
        assert late.manual.position_mm < 1.0
        assert not late.backend.stage.state().moving


def test_a_program_that_stood_still_for_longer_than_the_buffer_says_that_samples_are_lost(
    room: Room[DoubleBackend],
) -> None:
    card = RIG.hardware.card.model_copy(update={"buffer_s": 1.0})
    hardware = RIG.hardware.model_copy(update={"card": card, "hang_s": 0.5})
    # The driver's smallest buffer holds 100,000 samples.
    sampling = RIG.sampling.model_copy(update={"rate_hz": 100_000.0})
    rig = RIG.model_copy(update={"hardware": hardware, "sampling": sampling})
    stood_still: list[int] = []

    def stand_still(reading: Reading) -> None:
        if reading.channels["position"][-1] > 0.5 and not stood_still:
            stood_still.append(reading.end_index)
            hold_the_interpreter(1.5)

    with another(room, rig, rig.guard) as late:
        outcome = late.engine.acquire(acquire(stroke(travel_mm=10.0, speed_mm_s=5.0)), view=stand_still)
    # Where the computer stands still for longer, the motion is over by then, and its end is lost.
    assert outcome.status in {RunStatus.TRIPPED, RunStatus.FAILED}
    lost = re.search(r"(?:overrun: |the last )(\d+) samples", outcome.reason)
    assert lost is not None, outcome.reason
    assert int(lost[1]) >= 30_000


def test_a_person_homes_jogs_and_gets_off_a_limit_switch(bench: Bench) -> None:
    manual = bench.manual
    manual.reset()
    manual.home()
    assert manual.jog(10.0, 20.0) == pytest.approx(10.0, abs=0.01)
    bench.faults.inject(limit_high_pressed=True)
    with pytest.raises((TrippedError, DeviceError), match="upper limit switch"):
        manual.jog(5.0)
    with pytest.raises(TrippedError, match="upper limit switch"):
        manual.reset()
    begin = manual.position_mm
    assert manual.jog(-1.0, override=TravelEnd.HIGH) == pytest.approx(begin - 1.0, abs=0.01)
    assert manual.trip is not None
    assert manual.trip.cause is TripCause.LIMIT_SWITCH_HIGH
    bench.faults.inject(e_stop_pressed=True)
    with pytest.raises(TrippedError, match="emergency stop"):
        manual.jog(-1.0, override=TravelEnd.HIGH)
    bench.faults.clear()
    manual.reset()
    manual.jog(-1.0)
    checks = [prompt for prompt in bench.prompts if "Check the rig" in prompt.text or "origin" in prompt.text]
    assert len(checks) >= 5
    assert all(prompt.hands for prompt in checks)


def test_a_switch_seen_late_after_a_motion_off_it_is_not_taken_for_a_motion_onto_it(
    room: Room[DoubleBackend], monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = RIG.hardware.card.lines.model_copy(update={"heartbeat_s": 1.0})
    card = RIG.hardware.card.model_copy(update={"lines": lines})
    rig = RIG.model_copy(update={"hardware": RIG.hardware.model_copy(update={"card": card})})
    stands, late_looks, stopped_by = threading.Event(), list[bool](), list[str]()
    set_moving, read_switches, stop = MotionSamplingSync.set_moving, CardLines.read_switches, PositionModeStage.stop

    def note_standstill(sync: MotionSamplingSync, moving: bool) -> None:
        set_moving(sync, moving)
        (stands.clear if moving else stands.set)()

    def read_late(lines: CardLines) -> SwitchStates:
        if threading.current_thread().name == "drive power" and not stands.is_set():
            late_looks.append(stands.wait(2.0))
        return read_switches(lines)

    def note_stop(stage: PositionModeStage) -> None:
        stopped_by.append(threading.current_thread().name)
        stop(stage)

    monkeypatch.setattr(MotionSamplingSync, "set_moving", note_standstill)
    monkeypatch.setattr(PositionModeStage, "stop", note_stop)
    with another(room, rig, rig.guard) as made:
        made.manual.jog(10.0, 20.0)
        made.faults.inject(limit_high_pressed=True)
        begin = made.manual.position_mm
        # Polls that come late have the switches looked at in between, by the thread that keeps the power.
        made.faults.inject(drive_reply_late_s=0.05)
        monkeypatch.setattr(CardLines, "read_switches", read_late)
        assert made.manual.jog(-1.0, override=TravelEnd.HIGH) == pytest.approx(begin - 1.0, abs=0.01)
    assert any(late_looks)
    assert set(stopped_by) == {threading.current_thread().name}


@pytest.mark.parametrize("late_s", [thorough(0.06), 0.4])
def test_a_drive_that_starts_late_still_comes_to_the_end_of_its_motion(bench: Bench, late_s: float) -> None:
    manual = bench.manual
    manual.reset()
    manual.home()
    bench.faults.inject(drive_starts_late_s=late_s)
    assert manual.jog(5.0) == pytest.approx(5.0, abs=0.01)
    assert manual.jog(-2.0) == pytest.approx(3.0, abs=0.01)


def test_a_person_touches_off(bench: Bench) -> None:
    bench.manual.reset()
    touch_off = bench.manual.touch_off(25.0, 2.0, 10.0, back_mm=1.0)
    assert 0.0 <= touch_off.position_mm < 5.0
    assert abs(touch_off.force_mN) >= 25.0
    # The stage of the doubles moves in real time, and is late on a busy machine.
    until(lambda: bench.manual.position_mm == pytest.approx(max(touch_off.position_mm - 1.0, 0.0), abs=0.02))


def test_known_weights_give_back_what_the_sensor_is_wired_for(bench: Bench) -> None:
    bench.manual.reset()
    points = list(measure_loads(bench.backend, RIG, bench.manual, (0.0, 20.0, 50.0, 100.0), 2, 0.5))
    line = fit_force([point.load_mN for point in points], [point.reading.force_V for point in points])
    assert abs(line.gain - RIG.hardware.card.force.per_V) < 5 * line.gain_error + 1.0
    assert line.residual < RIG.force_sensor.accuracy_mN
    with pytest.raises(DeviceError, match="overloaded"):
        list(measure_loads(bench.backend, RIG, bench.manual, (0.0, 2000.0), 1, 0.1))


def test_a_known_push_gives_back_the_length_of_a_count(bench: Bench) -> None:
    bench.manual.reset()
    points = list(measure_pushed_travel(bench.backend, bench.manual, (20.0, -20.0, 20.0), 1.0))
    line = fit_encoder([point.travel_mm for point in points], [point.counts for point in points])
    assert line.gain == pytest.approx(1e-3 * RIG.encoder.resolution_um, rel=1e-3)


def test_a_program_that_hangs_in_motion_is_stopped_and_told_why(room: Room[DoubleBackend]) -> None:
    with another(room, RIG.model_copy(update={"hardware": RIG.hardware.model_copy(update={"hang_s": 0.5})})) as bench:

        def hang(reading: Reading) -> None:
            if reading.end_index > 300 and not hung:
                hung.append(bench.manual.position_mm)
                until(lambda: not bench.backend.bench.moving)

        hung: list[float] = []
        outcome = bench.engine.acquire(acquire(stroke(100.0, 20.0, 400.0)), view=hang)
        assert outcome.status == "tripped"
        assert outcome.reason.startswith("watchdog: ")
        assert hung[0] <= bench.manual.position_mm < 95.0
        bench.manual.reset()
        assert bench.manual.trip is None
