"""The host's ear by itself: what is said while a request is at hand, before it, and when there is none."""

import queue
from collections.abc import Iterator
from multiprocessing import Pipe
from multiprocessing.connection import Connection

import pytest

from dragrig.engine_host.messages import (
    AbortSession,
    ExamineRig,
    PromptReply,
    ResetGuard,
    SessionJob,
    SilenceLimits,
)
from dragrig.engine_host.server import RequestReceiver
from dragrig.rig.operator import Answer

Client = Connection


@pytest.fixture
def pair() -> Iterator[tuple[Client, RequestReceiver]]:
    client, host = Pipe()
    ear = RequestReceiver(host, SilenceLimits(600.0, 600.0))
    yield client, ear
    client.close()
    while ear.next() is not None:
        pass
    host.close()


def test_an_answer_before_its_prompt_is_kept(pair: tuple[Client, RequestReceiver]) -> None:
    client, ear = pair
    client.send(ResetGuard())
    assert ear.next() == ResetGuard()

    def put() -> None:
        client.send(PromptReply(1, Answer.SKIP))
        client.send(ExamineRig())
        assert ear.next() == ExamineRig()  # so that what was sent before it has been heard

    assert ear.await_answer(1, put) is Answer.SKIP


def test_an_abort_without_a_session_aborts_no_later_request(pair: tuple[Client, RequestReceiver]) -> None:
    client, ear = pair
    client.send(AbortSession("nothing moves"))
    client.send(ResetGuard())
    assert ear.next() == ResetGuard()
    stopped: list[str] = []
    ear.stops(stopped.append)
    assert ear.await_answer(1, lambda: client.send(PromptReply(1, Answer.DONE))) is Answer.DONE
    assert stopped == []


def test_an_abort_applies_to_earlier_requests_with_its_first_reason(
    pair: tuple[Client, RequestReceiver],
) -> None:
    client, ear = pair
    first, second = SessionJob(1, "drag"), SessionJob(2, "drag")
    for request in (first, AbortSession("Escape"), AbortSession("again"), second, ExamineRig()):
        client.send(request)
    stopped: queue.SimpleQueue[tuple[int, str]] = queue.SimpleQueue()
    assert ear.next() == first
    ear.stops(lambda reason: stopped.put((1, reason)))
    assert stopped.get() == (1, "Escape")
    assert ear.await_answer(1, lambda: None) is Answer.ABORT
    ear.stops(None)
    assert ear.next() == second
    ear.stops(lambda reason: stopped.put((2, reason)))
    assert ear.await_answer(2, lambda: client.send(PromptReply(2, Answer.DONE))) is Answer.DONE
    while not stopped.empty():
        assert stopped.get() == (1, "Escape")


@pytest.fixture
def impatient() -> Iterator[tuple[Client, RequestReceiver]]:
    """An ear that minds a tenth of a second of silence while anything moves."""
    client, host = Pipe()
    ear = RequestReceiver(host, SilenceLimits(0.1, 600.0))
    yield client, ear
    client.close()
    while ear.next() is not None:
        pass
    host.close()


def test_silence_while_anything_moves_aborts_it_and_the_host_goes_on(impatient: tuple[Client, RequestReceiver]) -> None:
    client, ear = impatient
    first, second = SessionJob(1, "drag"), SessionJob(2, "drag")
    client.send(first)
    assert ear.next() == first
    stopped: queue.SimpleQueue[str] = queue.SimpleQueue()
    ear.stops(stopped.put)
    assert "did not respond while the stage could move" in stopped.get(timeout=60.0)
    ear.stops(None)
    client.send(second)
    assert ear.next() == second
    assert not ear.gone.is_set()
    assert stopped.empty()


def test_silence_where_the_stage_stands_aborts_nothing_until_it_would_move(
    impatient: tuple[Client, RequestReceiver],
) -> None:
    client, ear = impatient
    client.send(SessionJob(1, "drag"))
    ear.next()
    stopped: queue.SimpleQueue[str] = queue.SimpleQueue()
    ear.stops(stopped.put)
    ear.stands = True
    looks = 0

    def look() -> None:
        nonlocal looks
        looks += 1
        ear.stands = False  # from now on it stands because of the prompt alone
        if looks == 3:
            client.send(PromptReply(1, Answer.DONE))

    with pytest.raises(queue.Empty):
        stopped.get(timeout=0.4)
    assert ear.await_answer(1, lambda: None, look) is Answer.DONE
    assert stopped.get(timeout=60.0)
