"""The serial link, through the real pyserial, over a pseudo-terminal and over a socket."""

import os
import re
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress

import pytest
from serial.tools.list_ports import comports

from dragrig.config.errors import DeviceError
from dragrig.config.rig import DriveSettings
from dragrig.rig.hardware.dialects.base import Command, Parameter, Request, find_dialect
from dragrig.rig.hardware.dialects.nikki import DIALECT
from dragrig.rig.hardware.drive.link import CancelledByStopError, DriveLink, NoReplyError, RefusedError
from dragrig.sim_backend.doubles.drive_double import DriveDouble
from dragrig.sim_backend.doubles.protocol_double import DoublePort
from drive_ports import DrivePort, PtyPort, SocketPort
from driving import ANY_PORT, PORTS, linked, unhindered, until
from ending import press
from property_tests import thorough

STATUS, POSITION, STOP = Request(Command.STATUS), Request(Command.POSITION), Request(Command.STOP)
GO = Request(Command.GO, value=10.0)
REPLY_S = 0.4
COPLEY = {"dialect": "copley", "station": 0, "counts_per_mm": 1000.0, "thrust_N_per_A": 8.0}
MODBUS = {"dialect": "modbus"}


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


@pytest.mark.parametrize(
    ("kind", "spoken"),
    [
        (ANY_PORT, {}), (SocketPort, COPLEY), (ANY_PORT, MODBUS),
        thorough(SocketPort, {}), thorough(DoublePort, {}), thorough(ANY_PORT, COPLEY),
    ],
)  # fmt: skip
def test_a_late_reply_answers_no_later_request(kind: type[DrivePort], spoken: dict[str, object]) -> None:
    def read_speeds() -> list[float | None]:
        read: list[float | None] = []
        with linked(kind, reply_s=REPLY_S, **spoken) as (drive, link):
            link.set(Parameter.THRUST_LIMIT_N, 7.0)
            link.set(Parameter.SPEED_MM_S, 9.0)
            drive.bench.faults.inject(drive_reply_late_s=1.4 * REPLY_S)
            # Where replies repeat the command, the one to the try before answers; where not, none is believed.
            with nullcontext() if not spoken else pytest.raises(NoReplyError):
                link.exchange(Request(Command.READ, Parameter.THRUST_LIMIT_N))
            drive.bench.faults.clear()
            late_until_s = time.monotonic() + 1.5 * REPLY_S
            while time.monotonic() < late_until_s:
                read.append(link.exchange(Request(Command.READ, Parameter.SPEED_MM_S)).value)
        return read

    # A reply that is later by a further `reply_s`, as of a double that was held up, none of these protocols tells.
    read = unhindered(read_speeds, lambda values: values == [pytest.approx(9.0)] * len(values))
    assert read == [pytest.approx(9.0)] * len(read)
    assert read


@pytest.mark.parametrize(("late_s", "spoken"), [(0.45, {}), (0.35, MODBUS)])
def test_replies_that_come_late_are_waited_for_within_the_silence_of_the_drive(
    late_s: float, spoken: dict[str, object]
) -> None:
    with linked(reply_s=0.2, silence_s=5.0, **spoken) as (drive, link):
        link.set(Parameter.SPEED_MM_S, 9.0)
        link.exchange(Request(Command.ENABLE))
        late_before = link.late_replies
        drive.bench.faults.inject(drive_reply_late_s=late_s)
        assert link.exchange(Request(Command.READ, Parameter.SPEED_MM_S)).value == pytest.approx(9.0)
        with pytest.raises(RefusedError):
            link.exchange(GO)
        assert drive.requests.count(GO) == 1
        # A request of several frames has as many replies.
        assert link.late_replies >= late_before + 2


def test_a_stop_does_not_wait_for_the_late_reply_to_a_move() -> None:
    with linked(reply_s=0.2, silence_s=5.0) as (drive, link):
        drive.bench.faults.inject(drive_silent=True)
        planned, errors = link.stop_count, list[DeviceError]()

        def go() -> None:
            try:
                link.exchange(GO, planned)
            except DeviceError as error:
                errors.append(error)

        sender = threading.Thread(target=go)
        sender.start()
        until(lambda: GO in drive.requests)
        link.stop()
        until(lambda: STOP in drive.requests)
        # Otherwise the move's reply would have been waited for until shortly before the drive stops by itself.
        assert link.unheard_s < 4.8
        drive.bench.faults.inject(drive_unplugged=True)
        sender.join()
        assert [type(error) for error in errors] == [NoReplyError]


def test_a_lost_link_is_no_late_reply_and_known_before_the_drive_stops_by_itself() -> None:
    with linked(reply_s=0.15, silence_s=0.75) as (drive, link):
        link.exchange(STATUS)
        late_before = link.late_replies
        drive.bench.faults.inject(drive_silent=True)
        began_s = time.monotonic()
        with pytest.raises(NoReplyError):
            link.exchange(STATUS)
        assert time.monotonic() - began_s >= 0.6
        assert link.unheard_s >= 0.6
        until(lambda: link.unheard_s > 0.75)
        drive.bench.faults.clear()
        link.exchange(STATUS)
        assert link.late_replies == late_before


def test_a_stop_goes_out_though_the_line_is_never_quiet_and_again_once_it_is() -> None:
    received = bytearray()
    with talker(b"v 1\r", unasked=True, hears=received) as port:
        settings = DriveSettings(port=port, reply_s=0.1, **COPLEY)
        link = DriveLink(settings, find_dialect("copley"))
        link.stop()
        until(lambda: find_dialect("copley").encode(STOP, settings)[0] in received)
        link.close()
    with linked(reply_s=REPLY_S / 2, **COPLEY) as (drive, link):
        drive.bench.faults.inject(drive_silent=True)
        with pytest.raises(NoReplyError):
            link.exchange(GO)
        link.stop()
        until(lambda: STOP in drive.requests)
        drive.bench.faults.clear()
        # Only one that is sent on a quiet line is known to be heard.
        link.exchange(POSITION)
        assert drive.requests.count(STOP) >= 2
        before = drive.requests.count(STOP)
        link.exchange(POSITION)
        assert drive.requests.count(STOP) == before


def test_a_stop_between_two_frames_of_a_move_drops_it(monkeypatch: pytest.MonkeyPatch) -> None:
    with linked(reply_s=REPLY_S, **COPLEY) as (drive, link):
        link.exchange(Request(Command.ENABLE))
        answer = drive.answer

        def answer_and_stop(frame: bytes) -> bytes:
            reply = answer(frame)
            if answer(b"g r0xca\r") == b"v 10000\r":
                link.stop()
            return reply

        monkeypatch.setattr(drive, "answer", answer_and_stop)
        with pytest.raises(CancelledByStopError):
            link.exchange(GO, link.stop_count)
        assert STOP in drive.requests
        assert GO not in drive.requests


@contextmanager
def talker(says: bytes, unasked: bool = False, hears: bytearray | None = None) -> Iterator[str]:
    """The far end of a line that says what no dialect knows: when it is asked, or all the time; its port."""
    listener = socket.create_server(("127.0.0.1", 0))

    def talk() -> None:
        client, _ = listener.accept()
        with suppress(OSError), client:
            # Unasked it never pauses for long: on a busy computer it would look as if it had ended.
            client.settimeout(1e-4 if unasked else None)
            while True:
                with suppress(TimeoutError):
                    heard = client.recv(100)
                    if not heard:
                        return
                    if hears is not None:
                        hears.extend(heard)
                with suppress(TimeoutError):
                    client.sendall(says)

    thread = threading.Thread(target=talk)
    with listener:
        thread.start()
        yield f"socket://127.0.0.1:{listener.getsockname()[1]}"
        thread.join()


@pytest.mark.parametrize("dialect", ["nikki", thorough("copley"), thorough("modbus")])
def test_bytes_that_cannot_be_read_lead_to_the_settings_in_their_order(dialect: str) -> None:
    # What a frame at twice the rate may look like.
    with talker(b"\xf8\x80\x1e\x00\xe6\x98\r\x03\xf80000") as port:
        drive = DriveSettings(port=port, reply_s=0.2, dialect=dialect, baud=19_200, parity="even", station=3)
        link = DriveLink(drive, find_dialect(dialect))
        with pytest.raises(NoReplyError) as refused:
            link.exchange(STATUS)
        link.close()
    assert re.search(
        r"13 bytes came.*in this order, hardware\.drive\.baud = 19200, parity = 'even', station = 3 and "
        rf"dialect = '{dialect}'",
        str(refused.value),
    )


def test_a_drive_that_goes_on_sending_unasked_is_told() -> None:
    with talker(b"v 1\r", unasked=True) as port:
        # Long enough that a busy computer never keeps the drive from sending for as long.
        link = DriveLink(DriveSettings(port=port, reply_s=0.2, dialect="copley"), find_dialect("copley"))
        with pytest.raises(NoReplyError, match="goes on sending without being asked"):
            link.exchange(STATUS)
        link.close()


@pytest.mark.parametrize(
    ("spoken", "message"),
    [
        ({"reply_s": 0.15}, "nothing came.*station"),
        thorough({"reply_s": 0.15, **MODBUS}, "nothing came.*station"),
        # Here the drive on the cable answers at once for the station.
        ({"reply_s": 0.5, "silence_s": 1.25, **COPLEY}, "station, which did not answer.*baud"),
    ],
)
def test_a_wrong_station_is_not_taken_for_the_drive(spoken: dict[str, object], message: str) -> None:
    with linked(program={"station": 5}, **spoken) as (drive, link):
        for request in (STATUS, GO, STOP):
            with pytest.raises(NoReplyError, match=message):
                link.exchange(request)
        assert not drive.requests


@pytest.mark.parametrize("kind", PORTS[:-1])
def test_a_reply_left_lying_is_not_taken_for_a_new_one(kind: type[DrivePort]) -> None:
    ports: list[DrivePort] = []

    def plugged_in(drive: DriveDouble) -> DrivePort:
        ports.append(kind(drive))
        return ports[-1]

    with linked(plugged_in, reply_s=0.2) as (drive, link):
        drive.bench.faults.inject(drive_reply_late_s=0.7)
        with pytest.raises(NoReplyError):
            link.exchange(POSITION)
        drive.bench.faults.clear()
        drive.bench.place(drive.bench.position_mm() + 5.0)
        until(lambda: ports[0].has_sent_all)
        assert link.exchange(POSITION).value == pytest.approx(5.0)


def test_a_garbled_reply_is_never_believed_and_a_question_is_put_again() -> None:
    with linked(reply_s=REPLY_S) as (drive, link):
        drive.bench.faults.inject(drive_garbled=True)
        with pytest.raises(NoReplyError, match=r"checksum.*hardware\.drive\.baud"):
            link.exchange(POSITION)
        repairer = threading.Timer(0.05, drive.bench.faults.clear)
        repairer.start()
        assert link.exchange(POSITION).value == pytest.approx(0.0)
        repairer.join()
        drive.bench.faults.inject(drive_garbled=True)
        with pytest.raises(NoReplyError, match=r"checksum.*shield and ground, for it was understood before"):
            link.exchange(POSITION)


def test_a_move_is_sent_once_and_a_stop_until_it_is_answered() -> None:
    with linked(reply_s=REPLY_S / 2) as (drive, link):
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
        answered = drive.requests.count(STOP)
        assert answered > before
        link.exchange(POSITION)
        assert drive.requests.count(STOP) == answered


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


def test_a_thread_with_many_requests_keeps_no_other_from_the_drive() -> None:
    with linked() as (drive, link):
        drive.bench.faults.inject(drive_reply_late_s=0.03)
        answered, ended = list[float](), threading.Event()

        def ask_again_and_again() -> None:
            while not ended.is_set():
                link.exchange(STATUS)
                answered.append(time.monotonic())

        busy = threading.Thread(target=ask_again_and_again)
        busy.start()
        try:
            until(lambda: bool(answered))
            for _ in range(5):
                before = len(answered)
                link.exchange(POSITION)
                # The request in progress, and its answer that may not be counted yet.
                assert len(answered) - before <= 2
        finally:
            ended.set()
            busy.join()


def test_what_was_planned_before_a_stop_is_dropped() -> None:
    with linked() as (drive, link):
        planned = link.stop_count
        link.stop()
        with pytest.raises(CancelledByStopError):
            link.exchange(GO, planned)
        link.exchange(STATUS, link.stop_count)
        assert GO not in drive.requests


def test_a_signal_handler_may_stop_whatever_it_interrupts() -> None:
    # A reply takes long on a busy computer with a signal every 0.5 ms; one that is lost never comes.
    with linked(reply_s=2.0) as (drive, link):
        number = signal.SIGBREAK if sys.platform == "win32" else signal.SIGUSR1
        before = signal.signal(number, lambda *_: link.stop())
        ended = threading.Event()

        def shoot() -> None:
            while not ended.wait(0.0005):
                press(number)

        shooter = threading.Thread(target=shoot)
        shooter.start()
        try:
            for _ in range(300):
                link.exchange(STATUS)
                link.stop()
        finally:
            ended.set()
            shooter.join()
            signal.signal(number, before)
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


@pytest.mark.parametrize("port", ["/dev/no-such-port", "socket://127.0.0.1:1"])
def test_a_port_that_is_not_there_is_told_with_its_key(port: str) -> None:
    with pytest.raises(DeviceError, match=r"cannot be opened.*hardware\.drive\.port") as error:
        DriveLink(DriveSettings(port=port), DIALECT)
    assert port in str(error.value)
    if "://" not in port:
        assert all(found.device in str(error.value) for found in comports())
    assert ("this computer has" in str(error.value)) is ("://" not in port)


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
