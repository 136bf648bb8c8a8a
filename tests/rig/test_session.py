"""Sessions on the simulated rig: what is made, in which order, and what happens when something goes wrong."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from dragrig.config.errors import AbortedError, DeviceError, DragrigError, TrippedError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.config.rig import RigSettings
from dragrig.config.settings import find_settings, parse
from dragrig.config.specimen import Specimen
from dragrig.rig.devices import Backend, BackendRequest
from dragrig.rig.engine import Sink
from dragrig.rig.operator import Answer, NullOperator, Prompt
from dragrig.rig.profile import Phase
from dragrig.rig.programme import PlannedRun, Programme, build_programme
from dragrig.rig.reading import Reading
from dragrig.rig.runfile.campaigns import SessionRecord
from dragrig.rig.runfile.model import Run, RunHeader, RunStatus
from dragrig.rig.runfile.store import MemoryStore
from dragrig.rig.session import CampaignProgress, Session, SessionResult
from dragrig.rig.stops import Stops, assess_stops
from dragrig.sim_backend.devices import SimulatedBackend, open_backend
from sim_faults import DriveFault, Faults, FollowError, ForceSpike, LostSamples, Runaway, StaleData, StuckEncoder
from simulated import acquire, stroke

BEGUN = datetime(2026, 5, 4, 9, 0, tzinfo=UTC)
SPECIMEN = Specimen(name="jejunum")
SHORT_DRAG: dict[str, object] = {"kind": "drag", "speed_mm_s": 20.0, "travel_mm": 20.0, "hold_s": 1.0, "prompt": "fit"}


class Scripted(NullOperator):
    """An operator who answers from a list, then says done; and a watcher who may do something at every block."""

    def __init__(self, *answers: Answer) -> None:
        self.answers = list(answers)
        self.prompts: list[str] = []
        self.waited_s = 0.0

    def ask(self, prompt: Prompt) -> Answer:
        self.prompts.append(prompt.text)
        return self.answers.pop(0) if self.answers else Answer.DONE

    def waits(self, run: PlannedRun, duration_s: float) -> None:
        self.waited_s += duration_s


def opened(faults: Faults | None = None) -> SimulatedBackend:
    return open_backend(BackendRequest(RigSettings(), FrictionModelSettings(), origin=BEGUN), faults or Faults())


def new_session(
    *steps: dict[str, object],
    person: NullOperator | None = None,
    faults: Faults | None = None,
    progress: CampaignProgress | None = None,
    store: MemoryStore | None = None,
    stops: Stops | None = None,
    backend: Backend | None = None,
    real_time: bool = False,
) -> tuple[Session, MemoryStore]:
    rig, model = RigSettings(), FrictionModelSettings()
    plan = parse(Plan, {"name": "p", "steps": list(steps)}, "p.toml")
    record = SessionRecord(begun_at=BEGUN, backend="simulated", plan=plan, specimen=SPECIMEN, model=model, rig=rig)
    backend = backend or opened(faults)
    store = store or MemoryStore()
    person = person or NullOperator()
    programme = build_programme(plan, SPECIMEN, rig.stage.start_mm, "p.toml")
    progress = progress or CampaignProgress()
    session = Session(backend, programme, record, store, person, person, progress, stops=stops, real_time=real_time)
    return session, store


def made(*steps: dict[str, object], **options: object) -> tuple[SessionResult, list[Run]]:
    session, store = new_session(*steps, **options)  # type: ignore[arg-type]
    return session.run(), store.runs


def test_a_plan_of_every_kind_is_carried_out() -> None:
    steps = [dict(step.model_dump(mode="json")) for step in find_settings(Plan, "plan", "paper").steps[:3]]
    result, runs = made(*steps, SHORT_DRAG)
    assert result.status is RunStatus.COMPLETE
    kinds = [run.info.kind for run in runs]
    assert kinds == ["relaxation", "return"] * 4 + ["blank", "return"] * 2 + ["coulomb", "return"] + ["drag", "return"]
    assert [run.info.header.order for run in runs] == list(range(len(runs)))
    assert all(run.info.status is RunStatus.COMPLETE and not run.info.reason for run in runs)
    starts = [run.info.header.start_time for run in runs]
    assert starts == sorted(starts)
    for run in runs:
        assert len(run.trace.time) == run.info.samples
        np.testing.assert_allclose(np.diff(run.trace.time), 1e-3, atol=1e-9)
        assert run.info.checks["lost_samples"] == 0
    assert {event.kind for event in runs[0].events} >= {"start", "phase", "end"}


def test_waits_are_made_and_noted_as_the_contacts_age() -> None:
    person = Scripted()
    _, runs = made({**SHORT_DRAG, "repeats": 2, "wait_s": 45.0}, person=person)
    drags = [run for run in runs if run.info.kind == "drag"]
    for run in drags:
        assert run.info.header.entry["insertion_dwell_s"] == pytest.approx(45.0, abs=0.01)
    # The half second of hold after the way back counts as rest.
    assert person.waited_s == pytest.approx(89.5, abs=0.1)
    apart = (drags[1].info.header.start_time - drags[0].info.header.start_time).total_seconds()
    assert apart > 45.0


class Watching(NullOperator):
    """Keeps what is read in rests, and what is told of them; aborts in a rest if asked to."""

    def __init__(self, *, abort_in_rest: bool = False) -> None:
        self.told: list[str] = []
        self.force: list[float] = []
        self.session: Session | None = None
        self._aborts = abort_in_rest

    def homes(self, *, over: bool) -> None:
        self.told.append("stands" if over else "homes")

    def waits(self, run: PlannedRun, duration_s: float) -> None:
        self.told.append(f"{run.summary} in {duration_s:.0f} s")

    def run_begins(self, run: PlannedRun, order: int) -> None:
        self.told.append(run.summary)

    def reads(self, reading: Reading) -> None:
        if " in " not in self.told[-1]:
            return
        assert set(reading.phase) == {Phase.REST}
        self.force.extend(reading.channels["force"].tolist())
        if self._aborts and self.session is not None:
            self.session.abort("stop button")


def test_the_contact_is_seen_to_relax_in_a_rest_in_real_time_and_the_run_begins_no_later() -> None:
    person = Watching()
    rest = {**SHORT_DRAG, "wait_s": 400.0, "way_back": "stay"}
    _, (run,) = made(rest, person=person, real_time=True)
    assert person.told == ["homes", "stands", "drag 20 mm/s in 400 s", "drag 20 mm/s in 100 s", "drag 20 mm/s"]
    assert len(person.force) == 399_000
    assert np.mean(person.force[:100]) > np.mean(person.force[2000:3000]) + 20.0 > np.mean(person.force[-1000:]) + 10.0
    assert run.info.header.entry["insertion_dwell_s"] == pytest.approx(400.0, abs=0.01)


def test_a_rest_in_real_time_is_stopped_and_guarded_as_a_run_is() -> None:
    person = Watching(abort_in_rest=True)
    person.session, store = new_session({**SHORT_DRAG, "wait_s": 45.0}, person=person, real_time=True)
    result = person.session.run()
    assert (result.status, result.reason, store.runs) == (RunStatus.ABORTED, "stop button", [])
    faults = Faults(force_spike=ForceSpike(5.0, 12_000.0), affects=lambda acquisition: acquisition.kind == "rest")
    result, runs = made({**SHORT_DRAG, "wait_s": 45.0}, faults=faults, real_time=True)
    assert (result.status, runs) == (RunStatus.TRIPPED, [])
    assert "over the limit" in result.reason


@pytest.mark.parametrize(("has_timeout", "speed_mm_s"), [(True, 20.0), (False, 1.0)])
def test_the_way_to_a_start_is_slow_where_nothing_but_a_person_would_end_it(
    has_timeout: bool, speed_mm_s: float
) -> None:
    rig = RigSettings.model_validate({"hardware": {"card": {"lines": {"enable": ""}}}})
    near_end: dict[str, object] = {**SHORT_DRAG, "start_mm": 149.0, "travel_mm": -20.0, "wait_s": 0.0}
    _, (drag, *_) = made(near_end, stops=assess_stops(rig, None, has_timeout=has_timeout))
    took_s = (drag.info.header.start_time - BEGUN).total_seconds()
    assert took_s == pytest.approx(149.0 / speed_mm_s, abs=0.2)


def test_two_sessions_with_one_seed_record_the_same_arrays() -> None:
    _, first = made(SHORT_DRAG)
    _, second = made(SHORT_DRAG)
    for earlier_run, later_run in zip(first, second, strict=True):
        for name in earlier_run.trace.channels:
            np.testing.assert_array_equal(earlier_run.trace.channels[name], later_run.trace.channels[name])


def test_a_tare_takes_the_zero_off() -> None:
    coulomb: dict[str, object] = {"kind": "coulomb", "speed_mm_s": 10.0, "travel_mm": 10.0}
    _, plain = made(coulomb)
    _, tared = made({**coulomb, "tare_s": 4.0})
    zero = plain[0].trace.force[:1000].mean()
    assert abs(zero) > 0.5
    assert abs(tared[0].trace.force[:1000].mean()) < 0.5
    assert tared[0].info.header.entry["tare_mN"] == pytest.approx(zero, abs=0.5)
    assert "tare_mN" not in plain[0].info.header.entry


def test_skip_leaves_out_what_the_prompt_prepares() -> None:
    person = Scripted(Answer.SKIP)
    result, runs = made(
        {**SHORT_DRAG, "repeats": 2}, {"kind": "blank", "speed_mm_s": 40.0, "prompt": "off"}, person=person
    )
    assert result.status is RunStatus.COMPLETE
    assert [run.info.kind for run in runs] == ["blank", "return"]


def test_redo_makes_the_run_before_again_and_marks_its_file() -> None:
    person = Scripted(Answer.DONE, Answer.REDO)
    step = {**SHORT_DRAG, "speed_mm_s": [10.0, 20.0], "prompt_each": True}
    session, store = new_session(step, person=person)
    assert session.run().status is RunStatus.COMPLETE
    speeds = [run.info.header.protocol["speed_mm_s"] for run in store.runs if run.info.kind == "drag"]
    assert speeds == [10.0, 10.0, 20.0]
    assert list(store.bad) == [0, 1]


def test_abort_at_a_prompt_ends_the_session() -> None:
    result, runs = made(SHORT_DRAG, person=Scripted(Answer.ABORT))
    assert (result.status, runs) == (RunStatus.ABORTED, [])
    with pytest.raises(AbortedError):
        result.require()


class AbortsAt(NullOperator):
    """Presses the button once a time has been recorded."""

    def __init__(self, time_s: float) -> None:
        self.time_s = time_s
        self.session: Session | None = None

    def reads(self, reading: Reading) -> None:
        if self.session is not None and reading.time[-1] >= self.time_s:
            self.session.abort("stop button")


def test_an_abort_stops_the_stage_and_keeps_what_was_recorded() -> None:
    person = AbortsAt(1.5)
    session, store = new_session(SHORT_DRAG, person=person)
    person.session = session
    result = session.run()
    assert (result.status, result.reason) == (RunStatus.ABORTED, "stop button")
    (run,) = store.runs
    assert run.info.status is RunStatus.ABORTED
    assert run.info.reason == "stop button"
    assert run.trace.time[-1] >= 1.5
    # 20 mm/s are braked within 7 ms; the record ends with the stage at rest.
    assert run.trace.time[-1] < 1.65
    assert np.ptp(run.trace.position[-2:]) < 0.003
    np.testing.assert_allclose(run.trace.position, run.trace.command, atol=0.003)
    assert "stop" in {event.kind for event in run.events}


def only_drags(acquisition: object) -> bool:
    return getattr(acquisition, "kind", "") == "drag"


@pytest.mark.parametrize(
    ("faults", "cause"),
    [
        (Faults(follow_error=FollowError(1.4, 3.0, ramp_s=0.5)), "following error"),
        (Faults(stuck_encoder=StuckEncoder(1.4)), "encoder silent"),
        (Faults(runaway=Runaway(1.4, 60.0)), "speed"),
        (Faults(runaway=Runaway(1.4, -20.0)), "following error"),
        (Faults(force_spike=ForceSpike(1.4, 9000.0)), "force"),
        (Faults(stale_data=StaleData(1.4)), "stale data"),
        (Faults(drive_fault=DriveFault(1.4)), "drive fault"),
    ],
)
def test_the_guard_trips_and_the_session_ends(faults: Faults, cause: str) -> None:
    session, store = new_session({**SHORT_DRAG, "repeats": 2}, faults=replace(faults, affects=only_drags))
    result = session.run()
    assert result.status is RunStatus.TRIPPED
    assert result.reason.startswith(cause)
    with pytest.raises(TrippedError):
        result.require()
    (run,) = store.runs
    assert run.info.status is RunStatus.TRIPPED
    assert run.info.reason.startswith(cause)
    assert len(run.trace.time) >= 1400
    events = {event.kind: event for event in run.events}
    assert "trip" in events
    if cause == "force":
        stopped_at_mm = float(np.interp(events["trip"].time_s, run.trace.time, run.trace.position))
        went_on_mm = float(events["stopped"].message.split()[0])
        assert went_on_mm == pytest.approx(abs(run.trace.position[-1] - stopped_at_mm), abs=0.03)
        assert went_on_mm > 0.05
        np.testing.assert_allclose(run.trace.position, run.trace.command, atol=0.003)
    with pytest.raises(TrippedError, match="reset"):
        session.engine.acquire(acquire(stroke()))


def test_lost_samples_are_counted_and_never_closed_up() -> None:
    faults = Faults(lost_samples=LostSamples(1.2, 30), affects=only_drags)
    result, runs = made(SHORT_DRAG, faults=faults)
    assert result.status is RunStatus.COMPLETE
    assert runs[0].info.checks["lost_samples"] == 30
    assert np.diff(runs[0].trace.time).max() == pytest.approx(0.031)


class FullStore(MemoryStore):
    """A store whose disk refuses data after a while."""

    def open(self, header: RunHeader, expected_samples: int) -> Sink:  # type: ignore[override]
        raise DragrigError("no room for another run.")


def test_when_no_record_can_be_opened_nothing_moves() -> None:
    backend = opened()
    session, _ = new_session(SHORT_DRAG, store=FullStore(), backend=backend)
    with pytest.raises(DragrigError, match="no room"):
        session.run()
    state = backend.stage.state()
    assert not state.enabled
    assert not state.moving


def test_a_clean_up_step_that_fails_keeps_no_other_from_being_made(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = opened()
    session, store = new_session(SHORT_DRAG, backend=backend)

    def refuse() -> None:
        raise DeviceError("the sampler does not let go.")

    monkeypatch.setattr(backend.sampler, "stop", refuse)
    result = session.run()
    assert result.status is RunStatus.FAILED
    assert "does not let go" in result.reason
    assert not backend.stage.state().enabled
    assert len(store.runs) == 0 or store.runs[0].info.reason


def test_a_session_goes_on_where_another_ended() -> None:
    step = {**SHORT_DRAG, "speed_mm_s": [5.0, 10.0, 20.0]}
    person = Scripted()
    session, store = new_session(step, person=person, progress=CampaignProgress(done=frozenset({0, 1}), next_order=7))
    assert session.run().status is RunStatus.COMPLETE
    assert [(run.info.kind, run.info.header.order) for run in store.runs] == [
        ("drag", 7), ("return", 8), ("drag", 9), ("return", 10),
    ]  # fmt: skip
    assert person.prompts == ["fit"]


def test_a_way_back_that_a_kill_interrupted_is_made_by_the_next_session() -> None:
    class Looks(Scripted):
        at_mm: float = -1.0
        backend: Backend

        def ask(self, prompt: Prompt) -> Answer:
            self.at_mm = self.backend.stage.state().position_mm if prompt.text == "fit" else self.at_mm
            return super().ask(prompt)

    person, backend = Looks(), opened()
    person.backend = backend
    step = {**SHORT_DRAG, "speed_mm_s": [5.0, 10.0]}
    progress = CampaignProgress(done=frozenset({0}), next_order=2)
    session, store = new_session(step, person=person, progress=progress, backend=backend)
    assert session.run().status is RunStatus.COMPLETE
    assert [(run.info.kind, run.info.header.order) for run in store.runs] == [("return", 2), ("drag", 3), ("return", 4)]
    back = store.runs[0]
    assert back.info.header.entry["way_back_of"] == 0
    # The capsule is put in where the run before ended, and comes back to where that began.
    assert person.at_mm == pytest.approx(60.0)
    assert back.info.header.entry["origin_mm"] == pytest.approx(60.0)
    assert back.trace.position[-1] == pytest.approx(-20.0, abs=0.01)


def test_every_run_carries_the_settings_it_was_made_with() -> None:
    import tomllib

    _, runs = made(SHORT_DRAG)
    again = parse(SessionRecord, tomllib.loads(runs[0].info.header.settings_toml), "settings")
    assert again.plan.steps[0].parameters["speed_mm_s"] == 20.0


class Careless(NullOperator):
    """Looks at a block and falls over."""

    def reads(self, reading: Reading) -> None:
        raise OSError("the terminal is gone")


def test_whoever_watches_does_not_get_in_the_way_of_the_run() -> None:
    result, runs = made(SHORT_DRAG, person=Careless())
    assert result.status is RunStatus.COMPLETE
    assert [event.kind for event in runs[0].events].count("view") == 1


@pytest.mark.parametrize("step", ["stop", "disable"])
def test_a_driver_that_raises_its_own_kind_of_error_wedges_nothing(monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    backend = opened()
    session, store = new_session(SHORT_DRAG, backend=backend)

    def refuse() -> None:
        raise OSError("cable pulled")

    monkeypatch.setattr(backend.stage, step, refuse)
    result = session.run()
    assert result.status is RunStatus.FAILED
    assert "cable pulled" in result.reason
    assert all(run.info.status is not RunStatus.RECORDING for run in store.runs)


def test_a_run_that_somebody_else_cut_short_is_not_complete() -> None:
    backend = opened()

    class StopsTheStage(NullOperator):
        def reads(self, reading: Reading) -> None:
            if reading.time[-1] >= 1.2:
                backend.stage.stop()

    session, store = new_session(SHORT_DRAG, person=StopsTheStage(), backend=backend)
    assert session.run().status is RunStatus.FAILED
    assert store.runs[0].info.status is RunStatus.FAILED
    assert "samples" in store.runs[0].info.reason


def test_the_stage_is_in_place_before_anybody_puts_a_capsule_in() -> None:
    backend = opened()

    class Looks(Scripted):
        at_mm: float = -1.0

        def ask(self, prompt: Prompt) -> Answer:
            if prompt.text == "fit":
                self.at_mm = backend.stage.state().position_mm
            return super().ask(prompt)

    person = Looks()
    session, _ = new_session(SHORT_DRAG, person=person, backend=backend)
    assert session.run().status is RunStatus.COMPLETE
    assert person.at_mm == pytest.approx(40.0)


class Follows(NullOperator):
    """Notes which runs are told of beforehand, and which begin."""

    def __init__(self) -> None:
        self.pending: list[int] = []
        self.begun: list[int] = []

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        self.pending = [run.index for run in pending]

    def run_begins(self, run: PlannedRun, order: int) -> None:
        self.begun.append(run.index)


@pytest.mark.parametrize(
    ("done", "left"),
    [
        (set(), [0, 1, 2, 3, 4, 5]),
        ({0, 1}, [2, 3, 4, 5]),
        ({1, 2, 3, 4, 5}, [0, 1]),
        ({0, 1, 3, 4, 5}, [2, 3]),
        ({0, 1, 2, 4, 5}, [3]),
    ],
    ids=["anew", "gone on with", "first marked bad", "middle marked bad", "way back marked bad"],
)
def test_an_observer_is_informed_beforehand_of_the_runs_to_make(done: set[int], left: list[int]) -> None:
    person = Follows()
    step = {**SHORT_DRAG, "speed_mm_s": [5.0, 10.0, 20.0]}
    session, _ = new_session(step, person=person, progress=CampaignProgress(done=frozenset(done), next_order=6))
    assert session.run().status is RunStatus.COMPLETE
    assert person.pending == person.begun == left


def test_a_run_made_again_has_its_way_back_made_again() -> None:
    session, store = new_session(SHORT_DRAG, progress=CampaignProgress(done=frozenset({1}), next_order=2))
    assert session.run().status is RunStatus.COMPLETE
    assert [run.info.kind for run in store.runs] == ["drag", "return"]
