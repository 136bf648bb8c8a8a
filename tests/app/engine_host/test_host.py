"""The engine in a process of its own: whatever becomes of its client, no sample is lost and the stage is stopped."""

import multiprocessing
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest

import add_ons
from dragrig.config import HardwareSettings
from dragrig.engine_host.messages import (
    AbortSession,
    ExamineRig,
    GuardState,
    PromptReply,
    PromptShown,
    ResetGuard,
    RigExamined,
    RigIdle,
    RigSelection,
    RunFinished,
    RunStarted,
    SessionFinished,
    SessionJob,
    SessionStarted,
    SessionWaiting,
    SilenceLimits,
    WatchRig,
)
from dragrig.engine_host.server import IdleRig
from dragrig.rig import mark_bad
from dragrig.rig.hardware.backend import RigLock
from dragrig.rig.operator import Answer
from dragrig.rig.profile import Phase
from dragrig.rig.runfile import read_campaign, read_run
from dragrig.rig.runfile.model import (
    Run,
    RunStatus,  # fmt: skip
)
from engine_clients import PATIENCE_S, Listener, hold_the_interpreter, killed_client, listening, plan


@pytest.fixture(scope="module")
def host() -> Iterator[Listener]:
    # Between tests nobody says that the client lives.
    with listening() as entry:
        yield entry


@pytest.fixture
def heard(host: Listener) -> Listener:
    """A client of a host whose guard is reset."""
    return host.armed()


def only_run(folder: Path) -> Run:
    campaign = read_campaign(folder)
    assert len(campaign.runs) == 1
    assert not campaign.recordings
    assert not campaign.unreadable
    return read_run(campaign.runs[0].path)


def require_whole(run: Run) -> None:
    """No sample is missing, from the first to the last."""
    trace = run.trace
    np.testing.assert_allclose(trace.time, np.arange(len(trace.time)) / trace.sample_rate_hz, atol=1e-9)
    assert not [event for event in run.events if event.kind == "gap"]
    assert run.info.checks["lost_samples"] == 0


def require_standing(run: Run) -> None:
    assert run.trace.phase[-1] == Phase.HOLD
    assert run.events[-1].message == run.info.reason
    assert abs(float(run.trace.position[-1]) - float(run.trace.command[-1])) < 0.01


def test_a_client_blocked_for_seconds_loses_no_sample(tmp_path: Path, heard: Listener) -> None:
    heard.client.ask(SessionJob(1, plan(10.0 / 3.0, 10.0), pace="real", out=tmp_path / "c"))
    heard.until_samples(400)
    begun_s = time.monotonic()
    hold_the_interpreter(2.5)
    assert time.monotonic() - begun_s >= 2.5
    assert heard.until(SessionFinished) == SessionFinished(1, RunStatus.COMPLETE, "", tmp_path / "c")
    run = only_run(tmp_path / "c")
    assert run.info.status is RunStatus.COMPLETE
    assert run.info.samples > 3000
    require_whole(run)


def test_killing_the_client_stops_the_stage_and_finishes_the_run(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=killed_client, args=(tmp_path / "c", there))
    process.start()
    there.close()
    host = psutil.Process(here.recv())
    process.kill()
    process.join()
    host.wait()
    run = only_run(tmp_path / "c")
    assert run.info.status is RunStatus.ABORTED
    assert "the window is gone" in run.info.reason
    assert 300 < run.info.samples < 20_000
    require_whole(run)
    require_standing(run)


def test_a_silent_client_counts_as_dead(tmp_path: Path) -> None:
    with listening(silence=SilenceLimits(PATIENCE_S, 3.0)) as heard:
        host = psutil.Process(heard.client.pid)
        heard.client.ask(SessionJob(1, plan(0.5, 20.0), pace="real", out=tmp_path / "c"))
        heard.until_samples(100)
        host.wait()
    run = only_run(tmp_path / "c")
    assert run.info.status is RunStatus.ABORTED
    assert "silent" in run.info.reason
    require_whole(run)
    require_standing(run)


def test_a_hold_within_a_run_is_no_motion_that_silence_would_end(tmp_path: Path) -> None:
    with listening(silence=SilenceLimits(2.0, PATIENCE_S)) as heard:
        held = plan(20.0, 10.0, hold_s=3.5)
        heard.client.ask(SessionJob(1, held, pace="real", out=tmp_path / "c"))
        heard.until_samples(1000)
        time.sleep(2.5)
        ended = heard.until(SessionFinished)
    assert isinstance(ended, SessionFinished)
    assert (ended.status, ended.reason) == (RunStatus.COMPLETE, "")


def test_a_session_reports_its_runs_and_its_end(tmp_path: Path, heard: Listener) -> None:
    heard.client.ask(SessionJob(7, plan(runs=2, prompt="Put it in", wait_s=3.0), out=tmp_path / "c"))
    ended = heard.until(SessionFinished)
    assert ended == SessionFinished(7, RunStatus.COMPLETE, "", tmp_path / "c")
    arguments = [entry for entry in heard.heard if isinstance(entry, PromptShown)]
    assert [button.text for button in arguments] == ["Put it in"]
    runs = [entry for entry in heard.heard if isinstance(entry, RunFinished)]
    assert [(run.order, run.status) for run in runs] == [(0, RunStatus.COMPLETE), (1, RunStatus.COMPLETE)]
    assert any(isinstance(entry, SessionWaiting) and entry.duration_s == pytest.approx(3.0) for entry in heard.heard)
    assert len(read_campaign(tmp_path / "c").runs) == 2


def test_a_resumed_campaign_reports_repeated_runs(tmp_path: Path, heard: Listener) -> None:
    short = plan(runs=3)
    heard.client.ask(SessionJob(1, short, out=tmp_path / "c"))
    heard.until(SessionFinished)
    mark_bad(read_campaign(tmp_path / "c").runs[0].path, "capsule slipped off")
    heard.client.ask(SessionJob(2, short, resume=tmp_path / "c"))
    assert heard.until(SessionFinished) == SessionFinished(2, RunStatus.COMPLETE, "", tmp_path / "c")
    [answer] = [entry for entry in heard.heard if isinstance(entry, SessionStarted) and entry.job == 2]
    made = [entry.run for entry in heard.heard if isinstance(entry, RunStarted)][3:]
    assert [run.index for run in made] == [0]
    assert answer.runs == tuple(made)


def test_an_abort_stops_the_stage_at_once_with_its_reason(tmp_path: Path, heard: Listener) -> None:
    heard.client.ask(SessionJob(1, plan(0.5, 20.0), pace="real", out=tmp_path / "c"))
    heard.until(RunStarted)
    shown = heard.until_samples(600)
    heard.client.ask(AbortSession("Escape at the window"))
    ended = heard.until(SessionFinished)
    assert isinstance(ended, SessionFinished)
    assert (ended.status, ended.reason) == (RunStatus.ABORTED, "Escape at the window")
    run = only_run(tmp_path / "c")
    assert run.info.samples < shown + 2000
    require_standing(run)


def test_an_abort_before_the_first_motion_takes_effect(tmp_path: Path, heard: Listener) -> None:
    heard.client.ask(SessionJob(1, plan(0.5, 20.0), pace="real", out=tmp_path / "c"))
    heard.client.ask(AbortSession("too early"))
    ended = heard.until(SessionFinished)
    heard.client.ask(SessionJob(2, plan(), out=tmp_path / "d"))
    later = heard.until(SessionFinished)
    assert isinstance(ended, SessionFinished)
    assert isinstance(later, SessionFinished)
    assert ended.status is RunStatus.ABORTED
    assert later.status is RunStatus.COMPLETE


def test_an_abort_at_a_prompt_ends_the_session(tmp_path: Path, heard: Listener) -> None:
    heard.answer = None
    heard.client.ask(SessionJob(1, plan(prompt="Put it in"), out=tmp_path / "c"))
    heard.until(PromptShown)
    heard.client.ask(AbortSession("never mind"))
    ended = heard.until(SessionFinished)
    assert isinstance(ended, SessionFinished)
    assert (ended.status, ended.reason) == (RunStatus.ABORTED, "never mind")


def test_a_prompt_gets_the_clients_answer(tmp_path: Path, heard: Listener) -> None:
    heard.answer = Answer.SKIP
    heard.client.ask(SessionJob(1, plan(prompt="Put it in"), out=tmp_path / "c"))
    ended = heard.until(SessionFinished)
    heard.client.ask(PromptReply(99, Answer.DONE))
    assert isinstance(ended, SessionFinished)
    assert ended.status is RunStatus.COMPLETE
    assert not [entry for entry in heard.heard if isinstance(entry, RunStarted)]


def test_a_trip_latches_until_it_is_reset(tmp_path: Path) -> None:
    rig = RigSelection(backend="simulated", assignments=("rig.guard.force_limit_mN=20",))
    with listening(rig) as heard:
        heard.client.ask(SessionJob(1, plan(), out=tmp_path / "c"))
        ended = heard.until(SessionFinished)
        latched = heard.until(GuardState)
        heard.client.ask(SessionJob(2, plan(), out=tmp_path / "d"))
        refused = heard.until(SessionFinished)
        heard.client.ask(ResetGuard())
        assert heard.until(GuardState) == GuardState("")
    assert isinstance(ended, SessionFinished)
    assert isinstance(refused, SessionFinished)
    assert isinstance(latched, GuardState)
    assert ended.status is RunStatus.TRIPPED
    assert "over the limit of 20 mN" in latched.reason
    assert refused.status is None
    assert "over the limit of 20 mN" in refused.reason
    assert not (tmp_path / "d").exists()


def test_a_plan_beyond_the_limits_is_refused(tmp_path: Path, heard: Listener) -> None:
    heard.client.ask(SessionJob(1, plan(travel_mm=900.0), out=tmp_path / "c"))
    ended = heard.until(SessionFinished)
    assert isinstance(ended, SessionFinished)
    assert ended.status is None
    assert "change travel_mm or start_mm" in ended.reason


def test_every_device_is_reported(tmp_path: Path, heard: Listener) -> None:
    heard.client.ask(ExamineRig())
    result = heard.until(RigExamined)
    assert isinstance(result, RigExamined)
    assert result.devices
    assert result.devices
    assert all(check.passed for check in result.devices)
    assert not result.error


def test_force_and_position_are_read_between_sessions_and_at_prompts(heard: Listener, tmp_path: Path) -> None:
    heard.client.ask(WatchRig(on=True))
    idle = heard.until(RigIdle)
    assert isinstance(idle, RigIdle)
    assert idle.question == 0
    assert idle.reading.force_mN is not None
    heard.answer = None
    heard.client.ask(SessionJob(1, plan(prompt="Mount the specimen"), out=tmp_path / "runs"))
    asked = heard.until(PromptShown)
    heard.client.ask(WatchRig(on=False))  # as of the times between sessions
    at_prompt = heard.until(RigIdle)
    assert isinstance(asked, PromptShown)
    assert isinstance(at_prompt, RigIdle)
    assert at_prompt.question == asked.question
    assert at_prompt.reading.position_mm == pytest.approx(40.0, abs=0.01)
    assert abs(at_prompt.reading.force_mN or 99.0) < 20  # the stage moved here, clear of the gut
    heard.client.ask(PromptReply(asked.question, Answer.DONE))
    begun = heard.until(RunStarted)
    assert isinstance(begun, RunStarted)
    assert begun.run.start_mm == 40.0
    heard.until(SessionFinished)
    heard.heard.clear()
    heard.client.ask(ExamineRig())
    heard.until(RigExamined)
    assert not [event for event in heard.heard if isinstance(event, RigIdle)]


def test_looking_takes_no_time_where_time_is_simulated(heard: Listener, tmp_path: Path) -> None:
    """Else runs would depend on how long a person takes to answer."""
    files = []
    for number, looks in enumerate((1, 5)):
        heard.answer, folder = None, tmp_path / str(number)
        heard.client.ask(SessionJob(number, plan(prompt="Mount the specimen"), out=folder))
        asked = heard.until(PromptShown)
        assert isinstance(asked, PromptShown)
        for _ in range(looks):
            heard.until(RigIdle)
        heard.client.ask(PromptReply(asked.question, Answer.DONE))
        heard.until(SessionFinished)
        files.append(only_run(folder))
    first, second = files
    np.testing.assert_array_equal(first.trace.force, second.trace.force)


SULKY = """
from contextlib import closing
from dragrig.config import DeviceError, HardwareSettings
from dragrig.rig.hardware.backend import RigLock
from dragrig.sim_backend.devices import SimulatedBackend
from dragrig.sim_backend.devices.simulated_backend import VirtualClock

class Sulky(SimulatedBackend):
    def __init__(self, request):
        super().__init__(request.rig, request.model, VirtualClock(request.origin))
        self._lock = RigLock(HardwareSettings(), "sulky")

    @property
    def needs_hands(self):
        raise DeviceError("it does not say")

    def close(self):
        self._lock.close()

hardware = double = Sulky
"""


def test_a_rig_that_fails_while_it_is_opened_to_be_read_is_given_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add_ons.install(tmp_path, monkeypatch, SULKY)
    idle = IdleRig(RigSelection(backend="handed"))
    idle.on = True
    reading = idle.look()
    assert reading is not None
    assert "does not say" in reading.problem
    idle.close()
    RigLock(HardwareSettings(), "sulky").close()
