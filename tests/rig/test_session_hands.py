"""Sessions at a rig where a person has hands: what is asked, what is kept of it, and who must not answer."""

import io
import os
import sys
import threading
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest

from dragrig.cli.operator import TerminalOperator
from dragrig.config.errors import DeviceError, StaleDataError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.config.rig import RigSettings
from dragrig.config.settings import parse
from dragrig.config.specimen import Specimen
from dragrig.rig.devices import Acquisition, Block, StageLimits, Trip, TripCause
from dragrig.rig.engine import Engine
from dragrig.rig.guard import Guard
from dragrig.rig.operator import Answer, NullOperator, Prompt, positioning_profile
from dragrig.rig.programme import build_programme
from dragrig.rig.reading import Reading
from dragrig.rig.runfile.campaigns import SessionRecord, specimen_key
from dragrig.rig.runfile.model import RunStatus
from dragrig.rig.runfile.store import MemoryStore
from dragrig.rig.session import Session
from dragrig.sim_backend.devices.simulated_backend import VirtualClock
from dragrig.sim_backend.devices.simulated_stage import UNDISTURBED, Disturbances, SimulatedStage, Track
from sim_faults import Faults, ForceSpike
from simulated import NEVER, Handed, acquire, rest, settings, stroke

BEGUN = datetime(2026, 5, 4, 9, 0, tzinfo=UTC)
SPECIMEN = Specimen(name="jejunum")
DRAG: dict[str, object] = {"kind": "drag", "speed_mm_s": 20.0, "travel_mm": 20.0, "hold_s": 0.5, "prompt": "fit"}


class Present(NullOperator):
    """A person who answers from a list, then says done, and takes a while for it."""

    def __init__(self, *answers: Answer) -> None:
        self.answers = list(answers)
        self.prompts: list[Prompt] = []

    def ask(self, prompt: Prompt) -> Answer:
        self.prompts.append(prompt)
        return self.answers.pop(0) if self.answers else Answer.DONE


def at_the_rig(
    person: NullOperator, *steps: dict[str, object], faults: Disturbances = UNDISTURBED
) -> tuple[Session, MemoryStore, Handed]:
    rig, model, store = RigSettings(), FrictionModelSettings(), MemoryStore()
    plan = parse(Plan, {"name": "p", "steps": list(steps or (DRAG,))}, "p.toml")
    record = SessionRecord(begun_at=BEGUN, backend="simulated", plan=plan, specimen=SPECIMEN, model=model, rig=rig)
    backend = Handed(rig, model, VirtualClock(BEGUN), faults)
    programme = build_programme(plan, SPECIMEN, rig.stage.start_mm, "p.toml")
    return Session(backend, programme, record, store, person, person), store, backend


def test_a_person_looks_before_the_guard_is_reset_and_before_the_stage_homes() -> None:
    person = Present()
    session, store, _ = at_the_rig(person)
    assert session.run().status is RunStatus.COMPLETE
    assert [prompt.text.split()[0] for prompt in person.prompts] == ["Check", "The", "fit"]
    assert all(prompt.hands for prompt in person.prompts)
    assert len(store.runs) == 2


@pytest.mark.parametrize("agreed", [0, 1])
def test_nothing_is_switched_on_or_moves_until_they_agree(agreed: int) -> None:
    session, store, backend = at_the_rig(Present(*[Answer.DONE] * agreed, Answer.ABORT))
    result = session.run()
    assert (result.status, store.runs) == (RunStatus.ABORTED, [])
    assert not backend.stage.state().homed


def test_nobody_does_not_answer_for_a_persons_hands() -> None:
    session, store, _ = at_the_rig(NullOperator())
    assert session.run().status is RunStatus.ABORTED
    assert store.runs == []


def test_yes_answers_only_what_needs_no_hands(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    with TerminalOperator(yes=True) as person:
        assert person.ask(Prompt("Go?", hands=False)) is Answer.DONE
        assert person.ask(Prompt("Hang 20 g on the sensor")) is Answer.ABORT
    assert "hands" in capsys.readouterr().err


def test_a_plan_without_prompts_asks_for_hands_before_each_capsule_and_fixture() -> None:
    person = Present()
    relaxation: dict[str, object] = {"kind": "relaxation", "shear_strain": 1.0, "hold_s": 1.0}
    session, store, _ = at_the_rig(person, relaxation, {**DRAG, "prompt": ""})
    assert session.run().status is RunStatus.COMPLETE
    assert [prompt.text for prompt in person.prompts[2:]] == [
        "Mount capsule rough, gut in the vacuum fixture",
        "Change from capsule rough, gut in the vacuum fixture to capsule drag, gut on foam",
    ]
    assert all(prompt.hands for prompt in person.prompts)
    assert [run.info.kind for run in store.runs] == ["relaxation", "return", "drag", "return"]


def test_what_nobody_stated_of_a_real_specimen_is_recorded_as_unknown() -> None:
    session, store, _ = at_the_rig(Present())
    assert session.run().status is RunStatus.COMPLETE
    recorded = store.runs[0].info.header.specimen
    assert {key: recorded[key] for key in ("id", "excised_at", "storage", "temperature_degC")} == dict.fromkeys(
        ("id", "excised_at", "storage", "temperature_degC"), "unknown"
    )
    assert specimen_key(store.runs[0].info) == "jejunum"


def test_files_tell_when_the_capsule_went_in() -> None:
    class Slow(Present):
        def ask(self, prompt: Prompt) -> Answer:
            backend.clock.sleep(30.0, NEVER)
            return super().ask(prompt)

    person = Slow()
    session, store, backend = at_the_rig(person, DRAG, {"kind": "blank", "speed_mm_s": 40.0, "prompt": "off"})
    assert session.run().status is RunStatus.COMPLETE
    drag, back, blank, _ = store.runs
    inserted = datetime.fromisoformat(str(drag.info.header.entry["inserted_at"]))
    since = drag.info.header.start_time - inserted
    assert since == pytest.approx(
        timedelta(seconds=float(drag.info.header.entry["insertion_dwell_s"])), abs=timedelta(seconds=0.1)
    )
    assert back.info.header.entry["inserted_at"] == inserted.isoformat()
    assert "inserted_at" not in blank.info.header.entry


def test_every_run_tells_how_sure_its_start_is(monkeypatch: pytest.MonkeyPatch) -> None:
    session, store, _ = at_the_rig(Present())
    monkeypatch.setattr(SimulatedStage, "start_uncertainty_s", 0.004)
    assert session.run().status is RunStatus.COMPLETE
    assert [run.info.header.entry["command_t0_uncertainty_s"] for run in store.runs] == [0.004, 0.004]


def test_no_run_begins_elsewhere_than_its_plan_says() -> None:
    class FallsShort(Disturbances):
        def during(self, acquisition: Acquisition) -> Disturbances:
            return self if acquisition.kind == "positioning" else UNDISTURBED

        def track(self, track: Track, limits: StageLimits, stop_accel_mm_s2: float) -> Track:
            travel_mm = float(track.profile.position(track.profile.duration_s))
            return replace(track, profile=positioning_profile(travel_mm - 0.3, limits))

    session, store, _ = at_the_rig(Present(), faults=FallsShort())
    result = session.run()
    assert result.status is RunStatus.FAILED
    assert "mm, not at the start of" in result.reason
    assert len(store.runs) <= 1


def test_the_watchdogs_word_is_the_reason_even_when_samples_simply_end(monkeypatch: pytest.MonkeyPatch) -> None:
    watchdog = Trip(TripCause.WATCHDOG, "nobody looked at the data for 0.5 s")

    class HeldUp(Present):
        def reads(self, reading: Reading) -> None:
            # The terminal holds the thread: meanwhile the stage is stopped and comes to rest.
            if reading.end_index >= 1200:
                backend.stage.stop()
                backend.clock.sleep(1.0, NEVER)
                monkeypatch.setattr(SimulatedStage, "fault", watchdog)

    session, store, backend = at_the_rig(HeldUp())
    result = session.run()
    assert result.status is RunStatus.TRIPPED
    assert result.reason.startswith("watchdog: nobody looked at the data")
    assert store.runs[0].info.status is RunStatus.TRIPPED
    assert store.runs[0].info.reason == result.reason


@pytest.mark.parametrize("end", [None, StaleDataError("nothing for 0.2 s."), DeviceError("the buffer ran over.")])
def test_what_follows_from_the_watchdogs_stop_does_not_hide_it(
    end: DeviceError | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    backend = open_handed()
    engine = engine_on(backend)
    read = backend.sampler.read

    def cut_off(cancel: threading.Event) -> Block | None:
        block = read(cancel)
        if block is None or block.first_index < 400:
            return block
        monkeypatch.setattr(SimulatedStage, "fault", Trip(TripCause.WATCHDOG, "hung for 0.5 s"))
        if end is not None:
            raise end
        return None

    monkeypatch.setattr(backend.sampler, "read", cut_off)
    outcome = engine.acquire(acquire(stroke(travel_mm=100.0)))
    assert outcome.status is RunStatus.TRIPPED
    assert outcome.reason.startswith("watchdog: hung for 0.5 s")
    assert end is None or str(end).rstrip(".") in outcome.reason


def engine_on(backend: Handed) -> Engine:
    rig = settings()
    guard = Guard(rig.guard)
    backend.stage.enable()
    backend.stage.home()
    assert guard.reset(backend.stage.state()) is None
    return Engine(backend, rig, guard)


def open_handed(faults: Faults | None = None) -> Handed:
    return Handed(settings(), FrictionModelSettings(), VirtualClock(BEGUN), faults or Faults())


def test_an_acquisition_ends_in_good_order_once_it_has_what_it_sought() -> None:
    backend = open_handed()
    seen: list[Reading] = []
    engine = engine_on(backend)
    outcome = engine.acquire(
        acquire(stroke(travel_mm=100.0)), view=seen.append, stop_when=lambda reading: reading.end_index >= 1000
    )
    assert (outcome.status, outcome.reason) == (RunStatus.COMPLETE, "")
    assert outcome.samples < 1200
    assert not backend.stage.state().moving
    assert backend.stage.state().position_mm < 60.0
    assert engine.acquire(acquire(rest(0.1), order=1)).status is RunStatus.COMPLETE


def test_what_is_sought_does_not_outrank_the_guard() -> None:
    backend = open_handed(Faults(force_spike=ForceSpike(0.4, 9000.0)))
    outcome = engine_on(backend).acquire(
        acquire(stroke(travel_mm=100.0)), stop_when=lambda reading: reading.end_index >= 450
    )
    assert outcome.status is RunStatus.TRIPPED


def test_an_abort_from_elsewhere_is_one_even_while_something_is_sought() -> None:
    backend = open_handed()
    engine = engine_on(backend)

    def look(reading: Reading) -> None:
        if reading.end_index >= 500:
            threading.Thread(target=engine.abort, args=("stop button",)).start()

    outcome = engine.acquire(acquire(stroke(travel_mm=100.0, speed_mm_s=10.0)), view=look, stop_when=lambda _: False)
    assert (outcome.status, outcome.reason) == (RunStatus.ABORTED, "stop button")


def test_a_block_that_carries_a_fault_trips(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = open_handed()
    read = backend.sampler.read

    def faulty(cancel: threading.Event) -> Block | None:
        block = read(cancel)
        if block is None or block.first_index < 400:
            return block
        return Block(block.first_index, block.channels, Trip(TripCause.SENSOR_OPEN, "no sensor"))

    monkeypatch.setattr(backend.sampler, "read", faulty)
    outcome = engine_on(backend).acquire(acquire(stroke(travel_mm=100.0)))
    assert (outcome.status, outcome.reason) == (RunStatus.TRIPPED, "sensor open circuit: no sensor")


@pytest.mark.skipif(os.name == "nt", reason="no pty on Windows")
def test_an_enter_from_before_the_question_answers_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    keyboard, screen = os.openpty()

    class Keys(io.TextIOWrapper):
        def readline(self, size: int = -1) -> str:  # type: ignore[override]
            os.write(keyboard, b"abort\n")
            return super().readline(size)

    with Keys(os.fdopen(screen, "rb")) as typed:
        monkeypatch.setattr(sys, "stdin", typed)
        os.write(keyboard, b"\n")
        with TerminalOperator(yes=False) as person:
            assert person.ask(Prompt("Is the way free?")) is Answer.ABORT
    os.close(keyboard)
