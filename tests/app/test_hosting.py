"""Sessions that people and signals meddle with: prompts, Ctrl-C, and errors on the session's own thread."""

import signal
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Self

import pytest

from dragrig import hosted_session
from dragrig.config.errors import PlanError, RecordingError
from dragrig.end_signals import EndSignals, rig_open
from dragrig.hosted_session import PromptRelay, SessionOptions, run_on_worker, run_session
from dragrig.rig.operator import Answer, NullOperator, Prompt
from dragrig.rig.programme import Preflight, preflight
from dragrig.rig.reading import Reading
from dragrig.rig.runfile.model import RunHeader, RunStatus
from dragrig.rig.runfile.store import MemorySink, MemoryStore
from dragrig.rig.session import Session, SessionResult
from dragrig.setup import resolve
from ending import press


def carried_out(person: NullOperator, store: MemoryStore | None = None, *assignments: str) -> SessionResult:
    setup = resolve("drag", assignments=["travel_mm=10", "rig.data.root='.'", *assignments])
    return run_session(setup, lambda _record: nullcontext(store or MemoryStore()), SessionOptions(Path()), person)


class Interrupting(NullOperator):
    """Presses Ctrl-C, or whatever ends a program, in the middle of a run."""

    def __init__(self, press: Callable[[], object], aborted: threading.Event) -> None:
        self.press, self.aborted = press, aborted
        self.threads: set[threading.Thread] = set()

    def reads(self, reading: Reading) -> None:
        if reading.end_index > 500 and not self.threads:
            self.threads.add(threading.current_thread())
            self.press()
            # The handler runs on the main thread; the block after this one must find its word.
            assert self.aborted.wait(600.0)


@pytest.fixture
def aborted(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Set once a session is told to end."""
    abort, aborted = Session.abort, threading.Event()

    def abort_and_say_so(session: Session, reason: str) -> None:
        abort(session, reason)
        aborted.set()

    monkeypatch.setattr(Session, "abort", abort_and_say_so)
    return aborted


@pytest.mark.parametrize(("number", "reason"), [(signal.SIGINT, "Ctrl-C"), (signal.SIGTERM, "ended by SIGTERM")])
def test_a_signal_ends_the_session_in_good_order(number: signal.Signals, reason: str, aborted: threading.Event) -> None:
    before = signal.getsignal(number)
    store = MemoryStore()
    person = Interrupting(lambda: press(number), aborted)
    result = carried_out(person, store)
    assert (result.status, result.reason) == (RunStatus.ABORTED, reason)
    assert [run.info.status for run in store.runs] == [RunStatus.ABORTED]
    assert store.runs[0].trace.time[-1] < 2.0
    assert threading.main_thread() not in person.threads
    assert signal.getsignal(number) is before


def test_what_windows_ends_stops_finishes_its_run_and_closes_the_rig_before_the_process_may_end(
    aborted: threading.Event,
) -> None:
    store = MemoryStore()
    with rig_open() as signals:
        # A thread of its own, and the process ends with the function that it calls.
        windows = threading.Thread(target=signals.end, args=("the console was closed",), daemon=True)
        result = carried_out(Interrupting(windows.start, aborted), store)
        assert (result.status, result.reason) == (RunStatus.ABORTED, "the console was closed")
        assert [run.info.status for run in store.runs] == [RunStatus.ABORTED]
        assert windows.is_alive(), "the process would have ended"
    windows.join(60)
    assert not windows.is_alive()


def test_a_session_ends_though_its_abort_takes_long() -> None:
    aborted = threading.Event()

    def abort(reason: str) -> None:
        # Longer than the main thread waits for a prompt.
        threading.Event().wait(0.5)
        assert reason == "ended by SIGTERM"
        aborted.set()

    def work() -> bool:
        # The main thread is to wait for a prompt when the signal comes.
        threading.Event().wait(0.1)
        press(signal.SIGTERM)
        return aborted.wait(30)

    assert run_on_worker(work, abort, PromptRelay(NullOperator()))


class AtThePrompt(NullOperator):
    """Answers prompts with an exception, as Ctrl-C and a closed standard input do, or with a word."""

    def __init__(self, answer: Answer | BaseException) -> None:
        self.answer = answer
        self.thread: threading.Thread | None = None

    def ask(self, prompt: Prompt) -> Answer:
        self.thread = threading.current_thread()
        if isinstance(self.answer, BaseException):
            raise self.answer
        return self.answer


@pytest.mark.parametrize("answer", [KeyboardInterrupt(), EOFError(), Answer.ABORT])
def test_ctrl_c_at_a_prompt_ends_the_session(answer: Answer | BaseException) -> None:
    person = AtThePrompt(answer)
    result = carried_out(person)
    assert result.status is RunStatus.ABORTED
    assert result.runs == ()
    assert person.thread is threading.main_thread()


class PressingCtrlC(NullOperator):
    """Presses Ctrl-C while a prompt waits for words."""

    def ask(self, prompt: Prompt) -> Answer:
        press()
        # Of all waits of its main thread, Windows breaks off this one alone.
        time.sleep(5)
        return Answer.DONE


def test_ctrl_c_closes_an_open_prompt() -> None:
    result = carried_out(PressingCtrlC())
    assert (result.status, result.runs) == (RunStatus.ABORTED, ())
    assert result.reason == "ended at a prompt"


class HoldingCtrlC(NullOperator):
    """Holds Ctrl-C down from the first prompt on, until the context ends."""

    def __init__(self) -> None:
        self.let_go, self.tidy = threading.Event(), False
        self.pressing = threading.Thread(target=self.press)

    def __enter__(self) -> Self:
        # What comes before and after the session counts for nothing.
        self.before = signal.signal(signal.SIGINT, lambda *_: None)
        return self

    def __exit__(self, *_: object) -> None:
        self.let_go.set()
        self.pressing.join()
        signal.signal(signal.SIGINT, self.before)

    def press(self) -> None:
        while not self.let_go.wait(0.0005):
            press()

    def ask(self, prompt: Prompt) -> Answer:
        try:
            # Inside: the first press may come before the thread's start returns.
            self.pressing.start()
            time.sleep(30)
        finally:
            # As a terminal that is put in order again.
            threading.Event().wait(0.05)
            self.tidy = True
        return Answer.DONE


def test_a_ctrl_c_that_is_held_at_a_prompt_ends_the_session_in_good_order() -> None:
    with HoldingCtrlC() as person:
        result = carried_out(person)
    assert (result.status, result.runs) == (RunStatus.ABORTED, ())
    assert person.tidy
    assert not any(thread.name.startswith("session") for thread in threading.enumerate())


def test_a_signal_while_the_rig_is_opened_ends_the_session_before_anything_moves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def pressed(*arguments: Any, **named: Any) -> Preflight:
        press()
        return preflight(*arguments, **named)

    monkeypatch.setattr(hosted_session, "preflight", pressed)
    result = carried_out(NullOperator())
    assert (result.status, result.reason, result.runs) == (RunStatus.ABORTED, "Ctrl-C", ())


class PressingAsItGoes:
    """Something whose destructor is under way when Ctrl-C comes: Python drops what is raised there."""

    def __del__(self) -> None:
        press()
        threading.Event().wait(0.1)


@pytest.mark.parametrize("held_up_s", [0.0, 0.3])
def test_a_ctrl_c_that_meets_a_destructor_is_not_lost(monkeypatch: pytest.MonkeyPatch, held_up_s: float) -> None:
    start = threading.Thread.start

    def start_held_up(thread: threading.Thread) -> None:
        """Let the new thread run for a while before this one goes on, as a busy computer may."""
        start(thread)
        time.sleep(held_up_s)

    monkeypatch.setattr(threading.Thread, "start", start_held_up)

    def work() -> None:
        PressingAsItGoes()
        time.sleep(10)

    with EndSignals() as signals, pytest.raises(KeyboardInterrupt):
        work()
    assert signals.interrupted


def test_an_error_of_the_operator_ends_the_session() -> None:
    with pytest.raises(ZeroDivisionError):
        carried_out(AtThePrompt(ZeroDivisionError()))
    assert not any(thread.name.startswith("session") for thread in threading.enumerate())


class Refusing(MemoryStore):
    def open(self, header: RunHeader, expected_samples: int) -> MemorySink:
        raise RecordingError("no room.")


def test_an_error_of_the_session_reaches_the_caller() -> None:
    with pytest.raises(RecordingError, match="no room"):
        carried_out(NullOperator(), Refusing())


def test_an_invalid_plan_asks_no_prompt(monkeypatch: pytest.MonkeyPatch) -> None:
    person = AtThePrompt(Answer.DONE)
    with pytest.raises(PlanError, match="outside the stage's travel"):
        carried_out(person, None, "travel_mm=140")
    assert person.thread is None
