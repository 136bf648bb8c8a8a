"""The serial link, through the real pyserial, over a pseudo-terminal and over a socket."""

import os
import re
import signal
import threading
import time

import pytest
from drive_ports import DrivePort, PtyPort, SocketPort
from driving import PORTS, linked, until

from dragrig.config.errors import DeviceError
from dragrig.config.rig import DriveSettings
from dragrig.rig.hardware.dialects.base import Command, Parameter, Request
from dragrig.rig.hardware.dialects.nikki import DIALECT
from dragrig.rig.hardware.drive.link import CancelledByStopError, DriveLink, NoReplyError, RefusedError

STATUS, POSITION, STOP = Request(Command.STATUS), Request(Command.POSITION), Request(Command.STOP)
GO = Request(Command.GO, value=10.0)
REPLY_S = 0.8


@pytest.mark.parametrize("kind", PORTS)
def test_what_is_set_is_read_back(kind: type[DrivePort]) -> None:
    with linked(kind) as (drive, link):
        link.set_and_verify(Parameter.THRUST_LIMIT_N, 12.345, "hardware.drive.thrust_limit_N")
        assert drive.parameter(Parameter.THRUST_LIMIT_N) == pytest.approx(12.345)
        with pytest.raises(DeviceError, match=r"holds 100\.0 as its thrust limit .* 150 .*drive\.thrust_limit_N"):
            link.set_and_verify(Parameter.THRUST_LIMIT_N, 150.0, "hardware.drive.thrust_limit_N")
        assert 0 < link.round_trip_s < REPLY_S


def test_a_refusal_says_why() -> None:
    with (
        linked() as (_, link),
        pytest.raises(RefusedError, match=r"refuses 'go to position', because it is switched off"),
    ):
        link.exchange(GO)


@pytest.mark.parametrize("kind", PORTS)
def test_a_late_reply_answers_no_later_request(kind: type[DrivePort]) -> None:
    with linked(kind, reply_s=REPLY_S) as (drive, link):
        link.set(Parameter.THRUST_LIMIT_N, 7.0)
        link.set(Parameter.SPEED_MM_S, 9.0)
        drive.bench.faults.inject(drive_reply_late_s=1.4 * REPLY_S)
        for _ in range(2):
            # Answered, if at all, by the reply to the try before.
            link.exchange(Request(Command.READ, Parameter.THRUST_LIMIT_N))
        drive.bench.faults.clear()
        late_until_s = time.monotonic() + 2 * REPLY_S
        while time.monotonic() < late_until_s:
            reply = link.exchange(Request(Command.READ, Parameter.SPEED_MM_S))
            assert (reply.parameter, reply.value) == (Parameter.SPEED_MM_S, 9.0)


@pytest.mark.parametrize("kind", PORTS)
def test_a_reply_left_lying_is_not_taken_for_a_new_one(kind: type[DrivePort]) -> None:
    with linked(kind, reply_s=0.5) as (drive, link):
        drive.bench.faults.inject(drive_reply_late_s=1.0)
        with pytest.raises(NoReplyError):
            link._exchange_once(POSITION)
        drive.bench.faults.clear()
        drive.bench.place(drive.bench.position_mm() + 5.0)
        until(lambda: link._serial.in_waiting > 0)
        assert link.exchange(POSITION).value == pytest.approx(5.0)


def test_a_garbled_reply_is_never_believed_and_a_question_is_put_again() -> None:
    with linked(reply_s=1.0) as (drive, link):
        drive.bench.faults.inject(drive_garbled=True)
        with pytest.raises(NoReplyError, match=r"checksum.*hardware\.drive\.reply_s"):
            link.exchange(POSITION)
        repairer = threading.Timer(0.05, drive.bench.faults.clear)
        repairer.start()
        assert link.exchange(POSITION).value == pytest.approx(0.0)
        repairer.join()


def test_a_move_is_sent_once_and_a_stop_until_it_is_answered() -> None:
    with linked(reply_s=0.5) as (drive, link):
        drive.bench.faults.inject(drive_silent=True)
        with pytest.raises(NoReplyError, match="nothing came"):
            link.exchange(GO)
        assert list(drive.requests) == [GO]
        link.stop()
        until(lambda: drive.requests.count(STOP) == 2)
        with pytest.raises(NoReplyError, match="'stop'"):
            link.exchange(POSITION)
        drive.bench.faults.clear()
        before = drive.requests.count(STOP)
        link.exchange(POSITION)
        link.exchange(POSITION)
        assert drive.requests.count(STOP) == before + 1


def test_a_stop_goes_before_everything_that_waits() -> None:
    with linked() as (drive, link):
        waiting = [
            threading.Thread(target=link.set, args=(Parameter.SPEED_MM_S, float(number))) for number in range(1, 6)
        ]
        with link.reserved():
            for thread in waiting:
                thread.start()
            link.stop()
            assert not drive.requests
        for thread in waiting:
            thread.join()
        assert drive.requests[0] == STOP
        assert drive.requests.count(STOP) == 1


def test_what_was_planned_before_a_stop_is_dropped() -> None:
    with linked() as (drive, link):
        planned = link.stop_count
        link.stop()
        with pytest.raises(CancelledByStopError):
            link.exchange(GO, planned)
        link.exchange(STATUS, link.stop_count)
        assert GO not in drive.requests


@pytest.mark.skipif(os.name == "nt", reason="no SIGUSR1 on Windows")
def test_a_signal_handler_may_stop_whatever_it_interrupts() -> None:
    with linked() as (drive, link):
        before = signal.signal(signal.SIGUSR1, lambda *_: link.stop())
        ended = threading.Event()

        def shoot() -> None:
            while not ended.wait(0.0005):
                os.kill(os.getpid(), signal.SIGUSR1)

        shooter = threading.Thread(target=shoot)
        shooter.start()
        try:
            for _ in range(300):
                link.exchange(STATUS)
                link.stop()
        finally:
            ended.set()
            shooter.join()
            signal.signal(signal.SIGUSR1, before)
        assert drive.requests.count(STOP) >= 100


def first_error(link: DriveLink) -> str:
    for _ in range(100):
        try:
            link.exchange(STATUS)
        except DeviceError as error:
            return str(error)
    pytest.fail("the cable was never missed")


@pytest.mark.parametrize("kind", PORTS)
def test_a_pulled_cable_is_told_in_words_at_once_and_from_then_on(kind: type[DrivePort]) -> None:
    with linked(kind) as (drive, link):
        link.exchange(STATUS)
        drive.bench.faults.inject(drive_unplugged=True)
        # The double hangs up from a thread of its own.
        answer = first_error(link)
        assert re.search(r"failed \(.*check the cable.*hardware\.drive\.port", answer)
        assert link.port in answer
        with pytest.raises(DeviceError, match=re.escape(answer)):
            link.exchange(STATUS)
        link.stop()


@pytest.mark.parametrize("port", ["/dev/no-such-port", "socket://127.0.0.1:1", "nonsense://x"])
def test_a_port_that_is_not_there_is_told_with_its_key(port: str) -> None:
    with pytest.raises(DeviceError, match=r"cannot be opened.*hardware\.drive\.port") as error:
        DriveLink(DriveSettings(port=port), DIALECT)
    assert port in str(error.value)


@pytest.mark.skipif(os.name == "nt", reason="no pty on Windows")
def test_two_programs_do_not_share_a_port() -> None:
    with linked(PtyPort) as (_, link):
        with pytest.raises(DeviceError, match="close other programs"):
            DriveLink(DriveSettings(port=link.port), DIALECT)
        link.exchange(STATUS)


def test_a_link_that_is_closed_says_so_and_stops_nothing() -> None:
    with linked(SocketPort) as (drive, link):
        link.close()
        link.close()
        link.stop()
        with pytest.raises(DeviceError, match="closed"):
            link.exchange(STATUS)
        assert not drive.requests
