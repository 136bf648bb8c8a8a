"""The guided look at the rig's wiring, and who is asked for it: each wrong wire is found by what a person does."""

import io
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

import pytest
from serial.tools.list_ports import comports

from dragrig import api
from dragrig.cli import main
from dragrig.config.errors import AbortedError, PlanError, TrippedError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import CommissioningRecord, RigCheck, RigSettings
from dragrig.rig.commissioning import (
    PUSH_MM,
    LiveView,
    Watched,
    judge_press,
    judge_push,
    judge_rest,
    judge_switch,
    look_at_rig,
    read_commissioning,
    wiring_key,
    write_commissioning,
)
from dragrig.rig.devices import BackendRequest
from dragrig.rig.guard import Guard
from dragrig.rig.hardware.backend import HardwareBackend
from dragrig.rig.operator import Answer, NullOperator, Prompt, reset_guard
from dragrig.setup import create_lab, resolve_rig
from dragrig.sim_backend.doubles.backend import DoubleBackend
from dragrig.sim_backend.doubles.simulated_bench import FaultInjector
from property_tests import thorough
from rig_faults import Bench

PACE = 20.0
COUNT_MM = 0.001


def view(counts: int = 0, force_mN: float = 0.0, *pressed: str) -> LiveView:
    return LiveView(force_mN / 1000.0, force_mN, counts, frozenset(pressed))


def watched(*views: LiveView, before: LiveView | None = None) -> Watched:
    return Watched(before or view(), views)


def pushed(*counts: int) -> RigCheck:
    return judge_push(watched(*map(view, counts)), COUNT_MM, reversed_counts=False)


@pytest.mark.parametrize(
    ("counts", "said"),
    [
        ((0, 0), "does not count"),
        ((1, 0, 1, 0), "one of A and B does not arrive"),
        ((-9000, -20000), "encoder.reversed = true"),
        ((2000, 5000), "off by a factor of about 4"),
        ((40000, 80000), "off by a factor of about 0.25"),
    ],
)
def test_a_push_tells_what_is_wrong_with_the_encoder(counts: tuple[int, ...], said: str) -> None:
    result = pushed(*counts)
    assert not result.passed
    assert said in result.detail


@pytest.mark.parametrize("travel_mm", [14.0, PUSH_MM, 30.0])
def test_a_push_judged_by_eye_is_right(travel_mm: float) -> None:
    assert pushed(round(1000 * travel_mm)).passed


def test_a_press_tells_a_dead_and_an_inverted_sensor_from_a_good_one() -> None:
    def pressed(*forces: float) -> RigCheck:
        return judge_press(watched(*(view(0, force) for force in forces)), accuracy_mN=5.0)

    assert pressed(0.0, 300.0, 2.0).passed
    assert "bridge" in pressed(0.5, 4.0, -3.0).detail
    inverted = pressed(1.0, -300.0, 1.0)
    assert not inverted.passed
    assert "fell by 300 mN" in inverted.detail


@pytest.mark.parametrize(
    ("seen", "before", "said"),
    [
        ([()], (), "nothing changed on port1/line2"),
        ([("limit_high",), ()], (), "upper limit switch changed in its place"),
        ([("limit_low", "e_stop"), ()], (), "e-stop changed with it"),
        ([(), ("limit_low",)], ("limit_low",), "normally open"),
    ],
)
def test_a_press_of_a_switch_tells_its_wiring(seen: list[tuple[str, ...]], before: tuple[str, ...], said: str) -> None:
    views = [view(0, 0.0, *pressed) for pressed in seen]
    result = judge_switch(watched(*views, before=view(0, 0.0, *before)), "limit_low", "port1/line2")
    assert not result.passed
    assert said in result.detail


def test_a_switch_pressed_at_rest_is_said() -> None:
    assert judge_rest(view()).passed
    assert "e-stop and lower limit switch" in judge_rest(view(0, 0.0, "limit_low", "e_stop")).detail


def found(faults: FaultInjector, rig: RigSettings | None = None) -> dict[str, RigCheck]:
    settings = rig or RigSettings()
    # On a busy computer the card's samples come late too.
    settings = settings.model_copy(update={"guard": settings.guard.model_copy(update={"stale_data_s": 5.0})})
    request = BackendRequest(settings, FrictionModelSettings(), connect=False, pace=PACE)
    backend = DoubleBackend(request, faults)
    try:
        return {finding.name: finding for finding in look_at_rig(backend, settings, lambda _: Answer.DONE)}
    finally:
        backend.close()


def test_a_rig_that_is_wired_as_it_should_be_passes() -> None:
    result = found(FaultInjector())
    assert list(result) == [
        "switches at rest", "encoder", "force", "e-stop", "lower limit switch", "upper limit switch",
        "serial port", "enable", "relay", "watchdog", "enable in motion", "watchdog in motion",
    ]  # fmt: skip
    assert all(finding.passed for finding in result.values()), result


@pytest.mark.parametrize(
    ("fault", "failed", "said"),
    [
        thorough("switches_swapped", {"lower limit switch", "upper limit switch"}, "in its place"),
        (
            "switches_normally_open",
            {"switches at rest", "e-stop", "lower limit switch", "upper limit switch", "enable"},
            "normally open",
        ),
        thorough("enable_not_wired", {"enable", "enable in motion"}, "stays on"),
        thorough("encoder_stuck", {"encoder"}, "does not count"),
    ],
)
def test_wrong_wires_of_the_bench_are_found_and_nothing_else(fault: str, failed: set[str], said: str) -> None:
    faults = FaultInjector()
    faults.inject(**{fault: True})
    result = found(faults)
    assert {name for name, finding in result.items() if not finding.passed} == failed
    assert said in " ".join(result[name].detail for name in failed)


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    create_lab(tmp_path / "lab")
    monkeypatch.chdir(tmp_path / "lab")
    return tmp_path / "lab"


def test_the_command_stores_what_it_found_and_ends_without_a_person(
    lab: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    unwired = (f"rig.hardware.card.lines.{line}=" for line in ("enable", "limit_low", "limit_high"))
    command = ["check", "--live", "--backend", "hardware", "--double", *(f"--set={line}" for line in unwired)]
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    assert main(command) == AbortedError.exit_code
    assert read_commissioning(lab) is None
    capsys.readouterr()
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n" * 10))
    assert main([*command, "--operator", "A. Person", "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["signals"]) == 9
    record = read_commissioning(lab)
    assert record is not None
    assert (record.operator, record.made_on, record.passed) == ("A. Person", "hardware double", True)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["check", "drag", "--live"], "leave the plan out"),
        (["check", "--operator", "A"], "--live"),
        (["check", "--live"], "no wires to look at"),
    ],
)
def test_a_look_without_wires_or_with_a_plan_is_refused(
    lab: Path, arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    assert said in capsys.readouterr().err


class Hand(NullOperator):
    """Does at the bench in another process what a prompt asks, and lets go before it answers."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench

    def ask(self, prompt: Prompt) -> Answer:
        for words, faults, released in (
            ("force sensor", {"force_added_mN": 400.0}, {"force_added_mN": 0.0}),
            ("e-stop", {"e_stop_pressed": True}, {"e_stop_pressed": False}),
            ("lower limit", {"limit_low_pressed": True}, {"limit_low_pressed": False}),
        ):
            if words in prompt.text and prompt.look is not None:
                self._bench.inject(**faults)
                assert prompt.look().text
                prompt.look()
                self._bench.inject(**released)
        return Answer.DONE


@contextmanager
def without_record(lab: Path) -> Iterator[None]:
    record = lab / "commissioning.toml"
    record.unlink(missing_ok=True)
    try:
        yield
    finally:
        record.unlink(missing_ok=True)


@pytest.mark.thorough
def test_a_press_that_is_over_before_the_answer_counts(faulty_rig: Bench) -> None:
    with without_record(faulty_rig.lab):
        record = api.commission(person=Hand(faulty_rig), rig=str(faulty_rig.lab / "rig.toml"))
    passed = {signal.name: signal.passed for signal in record.signals}
    assert passed == {
        "switches at rest": True, "encoder": False, "force": True, "e-stop": True,
        "lower limit switch": True, "upper limit switch": False, "serial port": True,
        "enable": True, "relay": True, "watchdog": True, "enable in motion": True, "watchdog in motion": True,
    }  # fmt: skip


class Cautious(NullOperator):
    """Goes on without a look at the wires, and ends the session when the rig is to be checked."""

    def __init__(self, look_first: bool = False) -> None:
        self.asked: list[str] = []
        self._look_first = look_first

    def ask(self, prompt: Prompt) -> Answer:
        self.asked.append(prompt.text)
        return Answer.DONE if "check --live" in prompt.text and not self._look_first else Answer.ABORT


def asked(bench: Bench, person: Cautious, *assignments: str) -> int:
    rig, folder = bench.lab / "rig.toml", bench.folder()
    with suppress(AbortedError):
        api.run(bench.lab / "plan.toml", out=folder, rig=rig, person=person, assignments=assignments)
    assert not list(folder.glob("*.h5"))
    return sum("check --live" in text for text in person.asked)


def test_the_real_rig_asks_once_for_a_look_and_again_when_wires_change(faulty_rig: Bench) -> None:
    with without_record(faulty_rig.lab):
        person = Cautious(look_first=True)
        assert asked(faulty_rig, person) == 1
        assert "until the drive has heard nothing for 5 s" in person.asked[0]
        assert "untried, and without it by up to 18.0 mm" in person.asked[0]
        assert asked(faulty_rig, Cautious()) == 1
        assert asked(faulty_rig, Cautious()) == 0
        assert asked(faulty_rig, Cautious(), "rig.hardware.card.encoder.z=") == 1


def found_lacking(rig: str, *names: str) -> CommissioningRecord:
    """What a look stores that found some signals wrong."""
    return CommissioningRecord(
        made_at=datetime.now().astimezone(),
        made_on="hardware",
        wiring=wiring_key(resolve_rig(rig=rig).rig),
        signals=tuple(RigCheck(name=name, passed=False, detail="does not work") for name in names),
    )


def test_a_look_that_found_faults_is_asked_about_and_what_it_found_stays(faulty_rig: Bench) -> None:
    with without_record(faulty_rig.lab):
        record = found_lacking(str(faulty_rig.lab / "rig.toml"), "encoder")
        write_commissioning(faulty_rig.lab, record)
        person = Cautious()
        assert asked(faulty_rig, person) == 1
        assert "found faults (encoder)" in " ".join(person.asked)
        assert asked(faulty_rig, Cautious()) == 0
        stored = read_commissioning(faulty_rig.lab)
        assert stored is not None
        assert stored.signals == record.signals


class Agreeing(NullOperator):
    """Does whatever is asked."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def ask(self, prompt: Prompt) -> Answer:
        self.asked.append(prompt.text)
        return Answer.DONE


def test_a_look_that_finds_nothing_wired_has_long_fast_runs_refused_and_the_record_says_why(faulty_rig: Bench) -> None:
    rig, plan = str(faulty_rig.lab / "rig.toml"), faulty_rig.lab / "plan.toml"
    far = ("travel_mm=130",)
    with without_record(faulty_rig.lab):
        before = api.check(plan, rig=rig, assignments=far)
        assert before.findings == ()
        assert "untried" in " ".join(before.remarks)
        assert "without it by up to 130.0 mm" in " ".join(before.remarks)
        write_commissioning(faulty_rig.lab, found_lacking(rig, "enable", "watchdog", "watchdog in motion"))
        person, folder = Agreeing(), faulty_rig.folder()
        with pytest.raises(PlanError, match=r"speed to 2\.9 mm/s"):
            api.run(plan, rig=rig, out=folder, person=person, assignments=far)
        assert person.asked == []
        assert not folder.exists()
        assert api.check(plan, rig=rig, assignments=(*far, "speed_mm_s=2.9")).findings == ()
        (way,) = (check for check in api.examine(rig=rig) if check.name == "way without program")
        assert not way.passed


def test_another_wiring_has_another_key_and_another_speed_has_not() -> None:
    rig = RigSettings()
    changed = {"hardware": {"card": {"lines": {"e_stop": "port1/line4"}}}}
    assert wiring_key(RigSettings.model_validate(changed)) != wiring_key(rig)
    assert wiring_key(RigSettings.model_validate({"stage": {"max_speed_mm_s": 50.0}})) == wiring_key(rig)


def test_the_drive_is_checked_without_a_card() -> None:
    faults = FaultInjector()
    faults.inject(card_absent=True)
    backend = DoubleBackend(BackendRequest(RigSettings(), FrictionModelSettings(), connect=False), faults)
    try:
        result = {check.name: check for check in backend.examine()}
    finally:
        backend.close()
    assert not result["card"].passed
    assert result["drive"].passed
    assert "without the card" in result["drive"].detail


def test_a_pressed_limit_switch_names_the_way_off_it() -> None:
    faults = FaultInjector()
    faults.inject(limit_high_pressed=True)
    backend = DoubleBackend(BackendRequest(RigSettings(), FrictionModelSettings(), pace=PACE), faults)

    class Person(NullOperator):
        def ask(self, prompt: Prompt) -> Answer:
            return Answer.DONE

    try:
        with pytest.raises(TrippedError, match=r"jog -2 --override-limit high"):
            reset_guard(backend, Guard(RigSettings().guard, 0.001), Person())
    finally:
        backend.close()


def test_a_port_that_is_not_there_is_found_with_those_that_are() -> None:
    ports = [found.device for found in comports()]
    for port, there in (
        ("/dev/no-such-port", False),
        ("socket://10.0.0.2:4001", True),
        *((name, True) for name in ports),
    ):
        hardware = {"drive": {"port": port}}
        rig = RigSettings.model_validate({"hardware": hardware})
        finding = HardwareBackend(BackendRequest(rig, FrictionModelSettings(), connect=False)).check_port()
        assert (finding.name, finding.passed) == ("serial port", there)
        assert all(name in finding.detail for name in (port, *ports))
