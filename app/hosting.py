"""Hosting what moves a rig: it runs on a thread of its own, while the calling thread hears signals and asks people.

The calling thread wakes every few milliseconds, because on Windows nothing else lets it hear Ctrl-C.
"""

import queue
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Event as Signal
from types import FrameType
from typing import TypeVar

from dragrig.rig.people import Answer, Operator, Prompt

ResultT = TypeVar("ResultT")

_WAKE_S = 0.02
_ENDING = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")


@dataclass(slots=True)
class _Question:
    prompt: Prompt
    answered: Signal = field(default_factory=Signal)
    answer: Answer = Answer.ABORT


class HandedOver:
    """An operator whom a session asks on its own thread and who answers on the one that hosts it."""

    def __init__(self, operator: Operator) -> None:
        self._operator = operator
        self._questions: queue.SimpleQueue[_Question] = queue.SimpleQueue()

    def ask(self, prompt: Prompt) -> Answer:
        """Put a prompt to the hosting thread and wait for the answer."""
        question = _Question(prompt)
        self._questions.put(question)
        question.answered.wait()
        return question.answer

    def answer_next(self, within_s: float) -> None:
        """Answer one prompt if there is one; Ctrl-C at a prompt ends the session."""
        try:
            question = self._questions.get(timeout=within_s)
        except queue.Empty:
            return
        try:
            with _signals_raise():
                question.answer = self._operator.ask(question.prompt)
        except (KeyboardInterrupt, EOFError):
            question.answer = Answer.ABORT
        finally:
            question.answered.set()


def host(work: Callable[[], ResultT], abort: Callable[[str], None], operator: HandedOver) -> ResultT:
    """Run what moves a rig to its end and return what it returns.

    Parameters
    ----------
    work
        Made on a thread of its own, as `Session.run`.
    abort
        Asks it for an end in good order: Ctrl-C and the other signals that end a program call it.

    Raises
    ------
    DragrigError
        What `work` raises.
    """
    results: list[ResultT] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            results.append(work())
        except BaseException as error:  # noqa: BLE001  # raised again on the calling thread
            errors.append(error)

    worker = threading.Thread(target=run, name="session")
    with _signals_call(abort):
        worker.start()
        try:
            while worker.is_alive():
                operator.answer_next(_WAKE_S)
        finally:
            if worker.is_alive():
                abort("its host failed")
            worker.join()
    if errors:
        raise errors[0]
    return results[0]


@contextmanager
def _signals_call(abort: Callable[[str], None]) -> Iterator[None]:
    def heard(number: int, frame: FrameType | None) -> None:
        del frame
        abort("Ctrl-C" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}")

    with _handling(heard):
        yield


@contextmanager
def _signals_raise() -> Iterator[None]:
    with _handling(signal.default_int_handler):
        yield


@contextmanager
def _handling(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may handle signals
        return
    present = [signal.Signals[name] for name in _ENDING if name in signal.Signals.__members__]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        # Under nohup a session outlives its terminal.
        present.remove(signal.SIGHUP)
    before = {number: signal.signal(number, handler) for number in present}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, signal.SIG_DFL if earlier is None else earlier)
