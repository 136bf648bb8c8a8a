"""Moving the stage by hand on the simulated rig: reset, homing, jogs, overrides, touching off."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import pytest

from dragrig.config.errors import AbortedError, DeviceError, SettingsError, TrippedError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import TravelEnd, TripCause
from dragrig.rig.engine import Engine
from dragrig.rig.guard import Guard
from dragrig.rig.manual import ManualControl
from dragrig.rig.operator import Answer, NullOperator, Prompt
from dragrig.sim_backend.devices import SimulatedBackend
from dragrig.sim_backend.devices.simulated_backend import VirtualClock
from sim_faults import DriveFault, Faults, ForceSpike, LimitSwitch
from simulated import Handed, settings


class Asked(NullOperator):
    """A person who answers from a list, then says done."""

    def __init__(self, *answers: Answer) -> None:
        self.answers = list(answers)
        self.prompts: list[Prompt] = []

    def ask(self, prompt: Prompt) -> Answer:
        self.prompts.append(prompt)
        return self.answers.pop(0) if self.answers else Answer.DONE


@dataclass
class Bench:
    backend: SimulatedBackend
    guard: Guard
    engine: Engine
    person: Asked
    manual: ManualControl

    @property
    def at_mm(self) -> float:
        return self.backend.stage.state().position_mm


def bench(
    faults: Faults | None = None,
    *answers: Answer,
    rig: RigSettings | None = None,
    kind: Callable[..., SimulatedBackend] = SimulatedBackend,
) -> Bench:
    rig, person = rig or settings(), Asked(*answers)
    backend = kind(rig, FrictionModelSettings(), VirtualClock(datetime(2026, 5, 4, tzinfo=UTC)), faults or Faults())
    guard = Guard(rig.guard)
    engine = Engine(backend, rig, guard)
    return Bench(backend, guard, engine, person, ManualControl(backend, guard, engine, person))


def test_nothing_moves_before_the_guard_is_reset() -> None:
    rig = bench()
    for move in (rig.manual.home, lambda: rig.manual.jog(1.0), lambda: rig.manual.touch_off(20.0, 1.0, 5.0)):
        with pytest.raises(TrippedError, match="reset"):
            move()
    assert rig.person.prompts == []
    assert not rig.backend.stage.state().enabled


def test_a_jog_says_from_where_to_where_and_goes_there() -> None:
    rig = bench()
    rig.manual.reset()
    assert rig.manual.jog(12.5, 5.0) == pytest.approx(12.5, abs=0.001)
    assert rig.manual.jog(-2.0) == pytest.approx(10.5, abs=0.001)
    texts = [prompt.text for prompt in rig.person.prompts]
    assert texts == [
        "The stage moves by +12.5 mm at 5 mm/s, from 0.000 to 12.500 mm",
        "The stage moves by -2 mm at 10 mm/s, from 12.500 to 10.500 mm",
    ]
    assert not any(prompt.hands for prompt in rig.person.prompts)


def test_a_jog_that_is_not_agreed_to_moves_nothing() -> None:
    rig = bench(None, Answer.ABORT)
    rig.manual.reset()
    with pytest.raises(AbortedError):
        rig.manual.jog(5.0)
    assert rig.at_mm == 0.0


@pytest.mark.parametrize(
    ("distance", "speed", "word"),
    [
        (0.0, 5.0, "other than 0"),
        (float("nan"), 5.0, "other than 0"),
        (5.0, 0.0, "speed"),
        (5.0, -1.0, "speed"),
        (-1.0, 5.0, "0 to 150"),
        (151.0, 5.0, "0 to 150"),
    ],
)
def test_a_jog_that_cannot_be_is_refused_before_any_prompt(distance: float, speed: float, word: str) -> None:
    rig = bench()
    rig.manual.reset()
    with pytest.raises(SettingsError, match=word):
        rig.manual.jog(distance, speed)
    assert rig.person.prompts == []


def test_a_jog_faster_than_the_stage_can_go_is_refused() -> None:
    rig = bench()
    rig.manual.reset()
    with pytest.raises(SettingsError, match="100 at most"):
        rig.manual.jog(120.0, 101.0)
    assert rig.person.prompts == []


def test_an_abort_during_a_prompt_moves_nothing() -> None:
    rig = bench()
    rig.manual.reset()

    def ask(prompt: Prompt) -> Answer:
        rig.engine.abort("stop button")
        return Answer.DONE

    rig.person.ask = ask  # type: ignore[method-assign]
    with pytest.raises(AbortedError, match="stop button"):
        rig.manual.jog(5.0)
    assert rig.at_mm == 0.0


def test_jogs_are_guarded() -> None:
    rig = bench(Faults(drive_fault=DriveFault(0.3)))
    rig.manual.reset()
    with pytest.raises(TrippedError, match="overcurrent"):
        rig.manual.jog(50.0)
    assert rig.at_mm < 10.0
    with pytest.raises(TrippedError):
        rig.manual.jog(1.0)
    rig.manual.reset()
    assert rig.manual.trip is None


def test_homing_asks_and_at_a_real_rig_only_hands_may_answer() -> None:
    rig = bench()
    rig.manual.reset()
    assert rig.manual.home() == 0.0
    (prompt,) = rig.person.prompts
    assert "origin" in prompt.text
    assert not prompt.hands
    refused = bench(None, Answer.DONE, Answer.ABORT, kind=Handed)
    refused.manual.reset()
    with pytest.raises(AbortedError):
        refused.manual.home()
    assert all(prompt.hands for prompt in refused.person.prompts)
    assert not refused.backend.stage.state().homed


AT_100 = Faults(limit_switch=LimitSwitch(TravelEnd.HIGH, 100.0))


def on_the_switch(
    *answers: Answer, kind: Callable[..., SimulatedBackend] = SimulatedBackend, faults: Faults = AT_100
) -> Bench:
    rig = bench(faults, *answers, kind=kind)
    rig.manual.reset()
    with pytest.raises(TrippedError, match="upper limit switch"):
        rig.manual.jog(110.0, 50.0)
    assert 100.0 <= rig.at_mm < 104.0
    with pytest.raises(TrippedError, match="high end is pressed"):
        rig.manual.reset()
    return rig


def test_one_slow_jog_leads_off_a_pressed_switch() -> None:
    rig = on_the_switch()
    begin = rig.at_mm
    assert rig.manual.jog(-1.0, override=TravelEnd.HIGH) == pytest.approx(begin - 1.0, abs=0.001)
    assert rig.manual.trip is not None
    assert rig.manual.trip.cause is TripCause.LIMIT_SWITCH_HIGH
    with pytest.raises(TrippedError):
        rig.manual.jog(-1.0)
    rig.manual.jog(-4.0, override=TravelEnd.HIGH)
    assert rig.manual.trip is None
    rig.manual.jog(-5.0)
    with pytest.raises(DeviceError, match="nothing to override"):
        rig.manual.jog(-1.0, override=TravelEnd.HIGH)


@pytest.mark.parametrize(
    ("distance", "speed", "side", "word"),
    [
        (1.0, None, TravelEnd.HIGH, "onto"),
        (-1.0, 2.1, TravelEnd.HIGH, "limit is 2 mm/s"),
        (1.0, None, TravelEnd.LOW, "high end is pressed"),
    ],
)
def test_an_override_frees_no_more_than_it_says(
    distance: float, speed: float | None, side: TravelEnd, word: str
) -> None:
    rig = on_the_switch()
    begin = rig.at_mm
    with pytest.raises((SettingsError, TrippedError), match=word):
        rig.manual.jog(distance, speed, override=side)
    assert rig.at_mm == begin
    assert rig.manual.trip is not None


def test_an_override_that_is_not_agreed_to_frees_nothing() -> None:
    rig = on_the_switch()
    rig.person.answers = [Answer.ABORT]
    with pytest.raises(AbortedError):
        rig.manual.jog(-1.0, override=TravelEnd.HIGH)
    assert rig.backend.stage.fault is not None
    with pytest.raises(TrippedError):
        rig.manual.jog(-1.0)


def test_everything_else_stays_watched_on_the_way_off_a_switch() -> None:
    spike = replace(AT_100, force_spike=ForceSpike(0.3, 9000.0), affects=lambda acquisition: acquisition.order == 1)
    rig = on_the_switch(faults=spike)
    with pytest.raises(TrippedError, match="force of"):
        rig.manual.jog(-4.0, override=TravelEnd.HIGH)
    assert rig.at_mm > 99.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("speed", "at_s"), [(1.0, 4.0), (5.0, 2.5)])
def test_the_contact_is_where_the_force_changed(sign: float, speed: float, at_s: float) -> None:
    contact = ForceSpike(at_s, -400.0, duration_s=60.0)
    rig = bench(Faults(force_spike=contact, affects=lambda acquisition: acquisition.kind == "touch-off"))
    rig.manual.reset()
    rig.backend.stage.enable()
    rig.backend.stage.home()
    rig.manual.jog(60.0, 50.0)
    touch_off = rig.manual.touch_off(200.0, speed, sign * 20.0)
    # 1 s of rest, and 0.1 s to the speed.
    assert touch_off.position_mm == pytest.approx(60.0 + sign * speed * (at_s - 1.05), abs=0.002 * speed + 0.001)
    assert touch_off.force_mN < -200.0
    assert sign * (rig.at_mm - touch_off.position_mm) < 0.1 * speed


def test_it_retracts_as_requested_but_not_beyond_its_start() -> None:
    for back_mm, expected in ((0.5, 1.95), (30.0, 0.0)):
        rig = bench(Faults(force_spike=ForceSpike(3.5, 400.0, duration_s=1.0)))
        rig.manual.reset()
        touch_off = rig.manual.touch_off(200.0, 1.0, 20.0, back_mm)
        assert touch_off.position_mm == pytest.approx(2.45, abs=0.02)
        assert rig.at_mm == pytest.approx(expected, abs=0.02)


def test_a_contact_that_is_not_there_or_lost_in_noise_is_reported() -> None:
    rig = bench()
    rig.manual.reset()
    with pytest.raises(DeviceError, match=r"no contact within 3 mm: the force changed by .* and 5000 mN are needed"):
        rig.manual.touch_off(5000.0, 5.0, 3.0)
    noisy = bench(rig=settings(simulated={"noise": {"white_mN": 30.0}}))
    noisy.manual.reset()
    with pytest.raises(SettingsError, match="within the noise"):
        noisy.manual.touch_off(20.0, 5.0, 3.0)
    assert noisy.at_mm < 0.6


@pytest.mark.parametrize(
    ("force", "speed", "maximum", "back"),
    [
        (0.0, 1.0, 5.0, 0.0),
        (20.0, 0.0, 5.0, 0.0),
        (20.0, 1.0, 0.0, 0.0),
        (20.0, 1.0, 5.0, -1.0),
        (20.0, 1.0, 200.0, 0.0),
    ],
)
def test_values_that_cannot_be_are_refused(force: float, speed: float, maximum: float, back: float) -> None:
    rig = bench()
    rig.manual.reset()
    with pytest.raises(SettingsError):
        rig.manual.touch_off(force, speed, maximum, back)
    assert rig.person.prompts == []


def test_an_override_that_failed_leaves_nothing_free(monkeypatch: pytest.MonkeyPatch) -> None:
    rig = bench(AT_100)
    rig.manual.reset()
    with pytest.raises(TrippedError):
        rig.manual.jog(120.0, 50.0)

    def refuse() -> None:
        raise DeviceError("the drive refuses.")

    with monkeypatch.context() as patched:
        patched.setattr(rig.backend.stage, "enable", refuse)
        with pytest.raises(DeviceError, match="refuses"):
            rig.manual.jog(-1.0, override=TravelEnd.HIGH)
    at_mm = rig.at_mm
    with pytest.raises(TrippedError, match="reset"):
        rig.manual.jog(-1.0)
    assert rig.at_mm == at_mm
