"""The first motion after connecting: a short pulse that shows wrong wires and settings before anything runs away."""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager

import pytest

from dragrig.config.errors import DeviceError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import BackendRequest, TravelEnd
from dragrig.rig.engine import Engine
from dragrig.rig.guard import Guard
from dragrig.rig.hardware.backend import HardwareBackend
from dragrig.rig.hardware.dialects.base import Command
from dragrig.rig.hardware.drive.position_mode import PositionModeStage
from dragrig.rig.hardware.drive.trial import PULSE_MM, Pulse
from dragrig.rig.manual import ManualControl
from dragrig.rig.operator import Answer, NullOperator, Prompt
from dragrig.rig.profile import Piece
from dragrig.sim_backend.doubles.backend import DoubleBackend
from dragrig.sim_backend.doubles.c_library import installed
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.card.tasks import INDEX_HYSTERESIS_COUNTS
from dragrig.sim_backend.doubles.drive_double import DriveDouble
from dragrig.sim_backend.doubles.protocol_double import DoublePort
from dragrig.sim_backend.doubles.simulated_bench import SWITCH_OFFSET_MM, DoubleClock, FaultInjector, SimulatedBench
from driving import until
from property_tests import thorough
from simulated import NEVER, settings, stroke
from voltage_bench import VoltageRig, velocity_rig, voltage_rig

FAULTS: list[tuple[dict[str, object], str]] = [
    ({"encoder_swapped": True}, "A and B of the encoder are swapped.*PFI8 and PFI10"),
    ({"encoder_scale": 4.0}, r"resolution is wrong by a factor of 4: .*about 0\.25 instead of 1"),
    ({"encoder_scale": 0.1}, "resolution is wrong by a factor of 0.1: .*about 10 instead of 1"),
    ({"encoder_stuck": True}, "encoder does not count: .*line receiver"),
    ({"carriage_blocked": True}, "nothing moves: .*motor's power"),
]
BY_VOLTAGE = [
    *(fault for fault in FAULTS if fault[0].keys() & {"encoder_swapped", "encoder_stuck"}),
    ({"velocity_swapped": True}, "polarity is wrong: told to move by -1.000 mm.*exchange the two wires of ao0"),
    ({"velocity_swapped": True, "encoder_swapped": True}, "A and B of the encoder are swapped"),
]
MAX_TRAVEL_MM = 2.5 * PULSE_MM
RIG = settings(
    stage={"start_mm": 10.0, "highest_mm": 70.0},
    hardware={"drive": {"homing_speed_mm_s": 20.0, "reply_s": 2.0, "silence_s": 5.0}, "hang_s": 5.0},
    guard={"following_error_mm": 50.0, "encoder_silent_mm": 50.0, "stale_data_s": 5.0},
)


@contextmanager
def position_rig(rig: RigSettings = RIG, pace: float = 1.0) -> Iterator[DoubleBackend]:
    backend = DoubleBackend(BackendRequest(rig, FrictionModelSettings(), pace=pace), FaultInjector())
    try:
        yield backend
    finally:
        backend.bench.faults.clear()
        backend.close()


def homing(direction: str, rig: RigSettings = RIG, **drive_settings: float) -> RigSettings:
    drive = rig.hardware.drive.model_copy(update={"homing_direction": direction, **drive_settings})
    return rig.model_copy(update={"hardware": rig.hardware.model_copy(update={"drive": drive})})


def place_beside_switch(backend: DoubleBackend, direction: str, distance_mm: float) -> float:
    """Place the stage at a distance inside of its homing switch; negative: beyond. Return the place."""
    stage = RIG.stage
    low = direction == "low"
    at_mm = stage.lowest_mm - SWITCH_OFFSET_MM if low else stage.highest_mm + SWITCH_OFFSET_MM
    at_mm += distance_mm if low else -distance_mm
    backend.bench.place(at_mm)
    if distance_mm <= 0:
        backend.stage.override_limit(TravelEnd(direction))  # type: ignore[attr-defined]
    return at_mm


def wrong(backend: DoubleBackend | VoltageRig, faults: dict[str, object], message: str) -> None:
    """Homing ends after a pulse, in words, and nothing else moves the stage; another try ends in the same way."""
    bench, stage = backend.bench, backend.stage
    bench.faults.clear()
    stage.disable()
    bench.place(20.0)
    bench.faults.inject(**faults)
    stage.enable()
    with pytest.raises(DeviceError, match=message):
        stage.home()
    until(lambda: not bench.moving)
    assert abs(bench.position_mm() - 20.0) <= MAX_TRAVEL_MM
    with pytest.raises(DeviceError, match=r"home it|first motion"):
        stage.move(stroke(travel_mm=5.0))
    assert abs(bench.position_mm() - 20.0) <= 2 * MAX_TRAVEL_MM


def test_a_drive_that_homes_by_itself_is_stopped_after_a_millimetre() -> None:
    with position_rig() as backend:
        for faults, message in FAULTS:
            wrong(backend, faults, message)


@pytest.mark.parametrize("faulty", [BY_VOLTAGE, thorough([fault for fault in FAULTS if fault not in BY_VOLTAGE])])
def test_a_voltage_the_wrong_way_round_moves_by_a_millimetre(faulty: list[tuple[dict[str, object], str]]) -> None:
    with voltage_rig() as backend:
        for faults, message in faulty:
            wrong(backend, faults, message)
        # Once the cause is gone homing comes to its end.
        backend.bench.faults.clear()
        backend.stage.disable()
        backend.bench.place(5.0)
        backend.ready()
        assert backend.bench.position_mm() == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("direction", ["low", "high"])
def test_a_drive_that_homes_the_wrong_way_is_stopped_within_millimetres(direction: str) -> None:
    with position_rig(homing(direction)) as backend:
        bench, stage = backend.bench, backend.stage
        for from_switch_mm in (9.0, 0.4, 0.0):
            begin_mm = place_beside_switch(backend, direction, from_switch_mm)
            bench.faults.inject(homing_reversed=True)
            stage.enable()
            with pytest.raises(DeviceError, match=f"the drive homes the wrong way.*homing_direction is '{direction}'"):
                stage.home()
            until(lambda: not bench.moving)
            # From the switch itself either way may be right, until a pulse has led off it.
            assert abs(bench.position_mm() - begin_mm) <= MAX_TRAVEL_MM * (1 if from_switch_mm else 2)
            with pytest.raises(DeviceError, match="home it"):
                stage.move(stroke(travel_mm=5.0))
            stage.disable()


def test_a_drive_that_was_homed_and_is_set_otherwise_since_does_not_run_to_the_far_end() -> None:
    with position_rig() as backend:
        bench = backend.bench
        backend.stage.enable()
        backend.stage.home()
        bench.place(20.0)
        bench.faults.inject(homing_reversed=True)
        with pytest.raises(DeviceError, match="homes the wrong way"):
            backend.stage.home()
        until(lambda: not bench.moving)
        assert abs(bench.position_mm() - 20.0) <= 2 * MAX_TRAVEL_MM


@pytest.mark.parametrize("direction", ["low", "high"])
@pytest.mark.parametrize("from_switch_mm", [thorough(0.6), thorough(0.05), 0.0, thorough(-0.5)])
def test_homing_that_begins_beside_or_on_its_switch_is_no_wrong_way(direction: str, from_switch_mm: float) -> None:
    with position_rig(homing(direction, homing_speed_mm_s=100.0)) as backend:
        place_beside_switch(backend, direction, from_switch_mm)
        backend.stage.enable()
        backend.stage.home()
        assert backend.stage.state().homed
        assert backend.stage.fault is None


@pytest.mark.parametrize("swapped", [thorough(False), True])
def test_homing_by_voltage_to_the_upper_end_knows_its_direction(swapped: bool) -> None:
    with voltage_rig(homing("high", velocity_rig())) as backend:
        backend.bench.place(50.0)
        backend.bench.faults.inject(velocity_swapped=swapped)
        backend.stage.enable()
        if swapped:
            with pytest.raises(DeviceError, match=r"polarity is wrong: told to move by \+1.000 mm"):
                backend.stage.home()
            backend.await_standstill()
            assert abs(backend.bench.position_mm() - 50.0) <= MAX_TRAVEL_MM
        else:
            backend.stage.prove_motion()
            assert backend.bench.position_mm() == pytest.approx(51.0, abs=0.1)


def test_a_stage_that_is_homed_is_proved_where_it_stands_and_left_there() -> None:
    bench = SimulatedBench(RIG, FrictionModelSettings(), DoubleClock(5.0))
    with DriveDouble(bench) as drive, DoublePort(drive) as port, installed(Card(bench)):
        drive_settings = RIG.hardware.drive.model_copy(update={"port": port.address})
        rig = RIG.model_copy(update={"hardware": RIG.hardware.model_copy(update={"drive": drive_settings})})

        @contextmanager
        def program() -> Iterator[PositionModeStage]:
            with closing(HardwareBackend(BackendRequest(rig, FrictionModelSettings()), bench.clock)) as backend:
                backend.connect()
                assert isinstance(backend.stage, PositionModeStage)
                yield backend.stage

        with program() as stage:
            stage.enable()
            stage.home()
        bench.place(60.0)
        before = len([request for request in drive.requests if request.command is Command.GO])
        with program() as stage:
            stage.enable()
            stage.prove_motion()
            stage.prove_motion()
        goes = [request.value for request in drive.requests if request.command is Command.GO][before:]
        assert goes == pytest.approx([60.0 + PULSE_MM, 60.0])
        assert bench.position_mm() == pytest.approx(60.0, abs=1e-3)
        bench.faults.inject(limit_high_pressed=True)
        with program() as stage:
            stage.override_limit(TravelEnd.HIGH)
            stage.enable()
            stage.move(stroke(travel_mm=-2.0, speed_mm_s=2.0))
            stage.await_end(NEVER)
            until(lambda: not bench.moving)
        # The pulse led away from the switch, so that the move began where it ended.
        assert bench.position_mm() == pytest.approx(60.0 - PULSE_MM - 2.0, abs=0.01)


def test_whoever_resets_the_guard_is_told_of_the_pulse_once() -> None:
    class Hands(NullOperator):
        def __init__(self) -> None:
            self.texts: list[str] = []

        def ask(self, prompt: Prompt) -> Answer:
            self.texts.append(prompt.text)
            return Answer.DONE

    with position_rig(pace=5.0) as backend:
        guard, hands = Guard(RIG.guard, 0.001), Hands()
        manual = ManualControl(backend, guard, Engine(backend, RIG, guard), hands)
        manual.reset()
        backend.bench.faults.inject(encoder_scale=2.0)
        with pytest.raises(DeviceError, match="factor of 2"):
            manual.jog(5.0)
        backend.bench.faults.clear()
        manual.reset()
        assert manual.jog(5.0) == pytest.approx(5.0, abs=0.01)
        manual.reset()
        assert ["1 mm" in text for text in hands.texts if "The guard is then reset" in text] == [True, True, False]


def test_a_stop_during_the_pulse_ends_it_and_proves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    with position_rig() as backend:
        backend.bench.place(20.0)
        backend.stage.enable()
        follow = backend.bench.follow

        def follow_and_be_stopped(pieces: Sequence[Piece]) -> None:
            follow(pieces)
            backend.stage.stop()

        monkeypatch.setattr(backend.bench, "follow", follow_and_be_stopped)
        with pytest.raises(DeviceError, match="stopped"):
            backend.stage.home()
        assert backend.stage.trial_due  # type: ignore[attr-defined]
        until(lambda: not backend.bench.moving)
        assert backend.bench.position_mm() > 20.0 - MAX_TRAVEL_MM


@pytest.mark.parametrize(
    ("pulse", "word"),
    [
        (Pulse(1.0, 1.0, 1.0), ""),
        (Pulse(None, -0.97, -0.99), ""),
        (Pulse(1.0, 0.02, 1.0), "reports no motion"),
        (Pulse(-1.0, 1.0, 1.0), "turn round its direction"),
        (Pulse(None, 1.0, 1.24), "factor of 1.2"),
        (Pulse(None, 1.08, 1.08, homes_astray=True), "homes the wrong way"),
    ],
)
def test_a_pulse_says_what_is_wrong(pulse: Pulse, word: str) -> None:
    problem = pulse.problem(RIG)
    assert word in problem
    assert bool(word) is bool(problem)


def test_a_velocity_scale_that_is_wrong_is_named_with_the_right_one() -> None:
    assert "per_V should be about 5 instead of 10" in Pulse(1.0, 0.5, 0.5).problem(velocity_rig())


def test_the_index_is_searched_in_the_quarter_that_is_set() -> None:
    def rig(phase: str) -> RigSettings:
        made = velocity_rig(encoder={"z_phase": phase})
        return made.model_copy(update={"stage": made.stage.model_copy(update={"highest_mm": 15.0})})

    with voltage_rig(rig("a_high_b_high")) as backend:
        backend.bench.faults.inject(index_phase="a_low_b_high")
        backend.stage.enable()
        with pytest.raises(DeviceError, match=r"before the index pulse was found.*z_phase"):
            backend.stage.home()
        backend.await_standstill()
        assert backend.stage.fault is None
    with voltage_rig(rig("a_low_b_high")) as backend:
        backend.bench.faults.inject(index_phase="a_low_b_high")
        backend.ready()
        assert backend.bench.position_mm() == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("start_mm", [thorough(-2.5), thorough(-2.0), 6.0])
def test_the_index_is_passed_from_one_side_wherever_homing_begins(start_mm: float) -> None:
    assert abs(INDEX_HYSTERESIS_COUNTS) > 10
    with voltage_rig() as backend:
        backend.bench.place(start_mm)
        backend.ready()
        backend.clock.sleep(1.0, NEVER)
        state = backend.stage.state()
        assert backend.bench.position_mm() - state.position_mm == pytest.approx(0.0, abs=0.003)
