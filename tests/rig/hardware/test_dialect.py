"""The dialects of drives: each says what it declares, and nothing damaged passes where there is a checksum."""

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dragrig.cli import main
from dragrig.config.errors import SettingsError
from dragrig.config.rig import DriveSettings
from dragrig.rig.hardware.dialects import copley, modbus, nikki
from dragrig.rig.hardware.dialects.base import (
    Command,
    Dialect,
    FrameError,
    Halt,
    Lack,
    Parameter,
    Refusal,
    Reply,
    Request,
    Status,
    find_dialect,
    fitting_dialect,
)
from dragrig.rig.runfile import read_campaign
from dragrig.rig.runfile.model import RunStatus
from dragrig.setup import create_lab
from dragrig.sim_backend.doubles.drive_sides import DriveSide, find_drive_side
from dragrig.sim_backend.doubles.protocol_double import DoublePort
from drive_ports import DrivePort, SocketPort
from driving import ANY_PORT, Stall, driven, until
from modbus_peer import PymodbusPort
from places import ROOT
from property_tests import thorough
from simulated import settings, stroke

UNITS = {"counts_per_mm": 1000.0, "thrust_N_per_A": 8.0}
RELAY = {"heartbeat": "port1/line4"}
SETTINGS = {
    "nikki": DriveSettings(),
    "copley": DriveSettings(dialect="copley", station=0, **UNITS),
    "modbus": DriveSettings(dialect="modbus"),
}
DRIVES = pytest.mark.parametrize("drive", SETTINGS.values(), ids=SETTINGS)
WITH_CHECKSUM = pytest.mark.parametrize(
    "drive", [drive for drive in SETTINGS.values() if Lack.CHECKSUM not in find_dialect(drive.dialect).lacks]
)
WITH_STATION = pytest.mark.parametrize("drive", [SETTINGS["nikki"], SETTINGS["modbus"]], ids=["nikki", "modbus"])
PLAIN = [Command.STATUS, Command.POSITION, Command.ENABLE, Command.DISABLE, Command.CLEAR_ALARM, Command.STOP]
NUMBERS = st.integers(-(10**8), 10**8).map(lambda steps: steps / 10_000)
PARAMETERS = st.sampled_from(Parameter)
REQUESTS = st.one_of(
    st.sampled_from(PLAIN).map(Request),
    PARAMETERS.map(lambda first: Request(Command.READ, first)),
    PARAMETERS.flatmap(lambda first: NUMBERS.map(lambda value: Request(Command.SET, first, value))),
    NUMBERS.map(lambda value: Request(Command.GO, value=value)),
    st.sampled_from([-1.0, 1.0]).map(lambda towards: Request(Command.HOME, value=towards)),
)
STATUSES = st.builds(Status, st.booleans(), st.booleans(), st.booleans(), st.integers(0, 19), st.sampled_from(Halt))
TELLING = {Command.GO, Command.HOME, Command.STOP, Command.SET, Command.READ, Command.POSITION, Command.DISABLE}


def said(dialect: Dialect, side: DriveSide, request: Request, drive: DriveSettings, act: Callable[[Request], Reply]
         ) -> tuple[Reply, tuple[bytes, ...]]:  # fmt: skip
    """Have a conversation without a line in between; return the reply and the drive's frames."""
    replies: tuple[bytes, ...] = ()
    frames = list(dialect.encode(request, drive))
    while frames:
        frame = frames.pop(0)
        assert side.frame_length(frame) == len(frame)
        assert side.frame_length(frame[:-1]) == 0
        replies = (*replies, side.answer(frame, act))
        assert dialect.frame_length(replies[-1]) == len(replies[-1])
        assert dialect.frame_length(replies[-1][:-1]) == 0
        reply = dialect.decode(request, replies, drive)
        if isinstance(reply, bytes):
            frames = [reply]
        elif reply is not None:
            return reply, replies
    pytest.fail("the conversation had no end")


def switched_on(dialect: Dialect, drive: DriveSettings) -> DriveSide:
    side = find_drive_side(dialect, drive)
    said(dialect, side, Request(Command.ENABLE), drive, Scripted(Reply()).act)
    return side


def is_spoken(dialect: Dialect, request: Request) -> bool:
    return request.parameter is not Parameter.SILENCE_S or Lack.SILENCE_TIMEOUT not in dialect.lacks


def fits(request: Request, drive: DriveSettings) -> bool:
    try:
        find_dialect(drive.dialect).encode(request, drive)
    except FrameError:
        return False
    return True


class Scripted:
    """A drive that remembers what it was asked, and answers as a test says."""

    def __init__(self, reply: Reply) -> None:
        self.reply = reply
        self.held: dict[Parameter | None, float] = {}
        self.asked: list[Request] = []

    def act(self, request: Request) -> Reply:
        self.asked.append(request)
        if request.command is Command.STATUS:
            return Reply(status=self.reply.status or Status(True, True, False, 0, Halt.TARGET))
        if request.command in {Command.READ, Command.POSITION}:
            return Reply(self.reply.value if self.reply.value is not None else 0.0)
        return Reply(refusal=self.reply.refusal)


@DRIVES
@given(REQUESTS)
def test_every_request_reaches_the_drive(drive: DriveSettings, request: Request) -> None:
    dialect = find_dialect(drive.dialect)
    if not is_spoken(dialect, request) or not fits(request, drive):
        return
    scripted = Scripted(Reply())
    side = switched_on(dialect, drive)
    reply, _ = said(dialect, side, request, drive, scripted.act)
    assert reply.refusal is None
    if request.command in TELLING:
        [heard] = [asked for asked in scripted.asked if asked.command is request.command][:1]
        assert heard.parameter is request.parameter
        if request.value is not None:
            step = dialect.resolution(request.parameter or Parameter.LOWEST_MM, drive)
            assert heard.value == pytest.approx(request.value, abs=0.51 * step)


@DRIVES
@given(NUMBERS.map(lambda value: value / 10), st.sampled_from(Parameter))
def test_every_number_comes_back(drive: DriveSettings, value: float, parameter: Parameter) -> None:
    dialect = find_dialect(drive.dialect)
    side = find_drive_side(dialect, drive)
    for request in (Request(Command.POSITION), Request(Command.READ, parameter)):
        # What is in two registers was not written to both here.
        if is_spoken(dialect, request) and len(dialect.encode(request, drive)) == 1:
            reply, _ = said(dialect, side, request, drive, Scripted(Reply(value)).act)
            step = dialect.resolution(request.parameter or Parameter.LOWEST_MM, drive)
            assert reply.value == pytest.approx(value, abs=0.51 * step)


@DRIVES
@given(STATUSES)
def test_every_status_comes_back(drive: DriveSettings, status: Status) -> None:
    dialect = find_dialect(drive.dialect)
    side = switched_on(dialect, drive)
    reply, _ = said(dialect, side, Request(Command.STATUS), drive, Scripted(Reply(status=status)).act)
    assert reply.status is not None
    assert (reply.status.homed, reply.status.moving, reply.status.alarm) == (status.homed, status.moving, status.alarm)
    assert reply.status.enabled == (status.enabled and not (status.alarm and drive.dialect == "copley"))
    told = {Halt.TARGET, Halt.STOP} if not (status.moving or status.alarm) and status.enabled else set()
    if drive.dialect != "copley" or status.halt in told:  # which does not say more
        assert reply.status.halt is status.halt


@DRIVES
def test_nothing_moves_before_the_last_frame_of_a_motion(drive: DriveSettings) -> None:
    dialect = find_dialect(drive.dialect)
    for request in (Request(Command.GO, value=3.0), Request(Command.HOME, value=-1.0)):
        side, scripted = switched_on(dialect, drive), Scripted(Reply())
        *before, last = dialect.encode(request, drive)
        for frame in before:
            side.answer(frame, scripted.act)
        assert not scripted.asked
        side.answer(last, scripted.act)
        assert scripted.asked == [request]


@DRIVES
def test_a_refused_motion_is_told(drive: DriveSettings) -> None:
    dialect = find_dialect(drive.dialect)
    for request in (Request(Command.GO, value=3.0), Request(Command.HOME, value=-1.0)):
        moving = Scripted(Reply(refusal=Refusal.MOVING))
        reply, _ = said(dialect, switched_on(dialect, drive), request, drive, moving.act)
        assert reply == Reply(refusal=Refusal.MOVING)


@DRIVES
@given(st.one_of(st.binary(max_size=80), st.binary(max_size=20).map(lambda inner: b"\x0201" + inner + b"\x030000")),
       REQUESTS)  # fmt: skip
def test_any_bytes_are_a_frame_or_one_kind_of_error(drive: DriveSettings, noise: bytes, request: Request) -> None:
    dialect = find_dialect(drive.dialect)
    if fits(request, drive):
        try:
            dialect.decode(request, (noise,), drive)
        except FrameError as error:
            assert str(error)  # noqa: PT017  # most bytes are no frame, and a few may be
    assert 0 <= dialect.frame_length(noise) <= max(len(noise), 256)


@WITH_CHECKSUM
@given(REQUESTS, st.data())
def test_no_single_changed_byte_passes(drive: DriveSettings, request: Request, data: st.DataObject) -> None:
    dialect = find_dialect(drive.dialect)
    if not fits(request, drive):
        return
    side = find_drive_side(dialect, drive)
    _, frames = said(dialect, side, request, drive, Scripted(Reply()).act)

    def damaged(frame: bytes) -> bytes:
        place = data.draw(st.integers(0, len(frame) - 1))
        return frame[:place] + bytes([frame[place] ^ data.draw(st.integers(1, 255))]) + frame[place + 1 :]

    with pytest.raises(FrameError):
        dialect.decode(request, (*frames[:-1], damaged(frames[-1])), drive)
    deaf = Scripted(Reply())
    assert side.answer(damaged(dialect.encode(request, drive)[0]), deaf.act) == b""
    assert not deaf.asked


@WITH_STATION
@given(REQUESTS)
def test_another_station_neither_answers_nor_is_listened_to(drive: DriveSettings, request: Request) -> None:
    dialect = find_dialect(drive.dialect)
    if not fits(request, drive):
        return
    other = drive.model_copy(update={"station": 2})
    side = find_drive_side(dialect, other)
    assert side.answer(dialect.encode(request, drive)[0], Scripted(Reply()).act) == b""
    _, frames = said(dialect, side, request, other, Scripted(Reply()).act)
    with pytest.raises(FrameError, match="station"):
        dialect.decode(request, frames[:1], drive)


def test_a_node_behind_a_copley_drive_that_does_not_answer_is_told() -> None:
    drive = SETTINGS["copley"].model_copy(update={"station": 3})
    side = find_drive_side(copley.DIALECT, SETTINGS["copley"])
    [frame] = copley.DIALECT.encode(Request(Command.STOP), drive)
    assert frame == b"3 t 0\r"
    with pytest.raises(FrameError, match="station"):
        copley.DIALECT.decode(Request(Command.STOP), (side.answer(frame, Scripted(Reply()).act),), drive)


@pytest.mark.parametrize("request_", [Request(Command.POSITION), Request(Command.READ, Parameter.SPEED_MM_S)])
def test_a_dialect_that_repeats_the_command_takes_no_answer_to_another_request(request_: Request) -> None:
    dialect, drive = nikki.DIALECT, SETTINGS["nikki"]
    assert Lack.REPEATED_COMMAND not in dialect.lacks
    side = find_drive_side(dialect, drive)
    _, frames = said(dialect, side, Request(Command.READ, Parameter.HIGHEST_MM), drive, Scripted(Reply(3.0)).act)
    with pytest.raises(FrameError, match="instead"):
        dialect.decode(request_, frames, drive)


@DRIVES
@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e9])
def test_a_value_that_no_frame_holds_is_refused(drive: DriveSettings, value: float) -> None:
    with pytest.raises(FrameError, match="fit"):
        find_dialect(drive.dialect).encode(Request(Command.GO, value=value), drive)


@pytest.mark.parametrize(
    ("command", "parameter", "value"),
    [(Command.GO, None, None), (Command.STOP, None, 1.0), (Command.READ, None, None),
     (Command.STATUS, Parameter.SPEED_MM_S, None)],
)  # fmt: skip
def test_a_request_says_all_it_has_to_and_no_more(
    command: Command, parameter: Parameter | None, value: float | None
) -> None:
    with pytest.raises(ValueError, match="comes with"):
        Request(command, parameter, value)


def test_a_move_is_never_sent_twice() -> None:
    assert not Request(Command.GO, value=1.0).repeatable
    assert not Request(Command.HOME, value=-1.0).repeatable
    assert Request(Command.STOP).repeatable


def test_a_dialect_is_found_by_name() -> None:
    for name, module in (("nikki", nikki), ("copley", copley), ("modbus", modbus)):
        assert find_dialect(name) is module.DIALECT
        assert find_dialect(module.__name__) is module.DIALECT
        assert not module.DIALECT.verified
    for name, complaint in (("nobody", "not known"), ("../x", "no module"), ("dragrig.rig.devices", "DIALECT")):
        with pytest.raises(SettingsError, match=complaint):
            find_dialect(name)


# What a drive lacks, and what has to stand in for it.


@pytest.mark.parametrize(
    ("lines", "missing"),
    [({}, "card.lines.heartbeat must"), ({**RELAY, "enable": ""}, "card.lines.enable must"),
     ({"enable": ""}, "card.lines.heartbeat and hardware.card.lines.enable must")],
)  # fmt: skip
def test_a_drive_without_a_silence_timeout_is_refused_without_relay_and_enable_line(
    lines: dict[str, str], missing: str
) -> None:
    rig = settings(hardware={"card": {"lines": lines}, "drive": {"dialect": "copley", **UNITS}})
    with pytest.raises(SettingsError) as refused:
        fitting_dialect(rig.hardware)
    assert missing in str(refused.value)
    assert "heartbeat relay" in str(refused.value)
    assert str(refused.value).count(". ") == 0


def test_the_refusal_is_one_sentence_at_the_command_line_before_anything_is_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    values = {"dialect": "copley", **UNITS}
    words = [word for key, value in values.items() for word in ("--set", f"rig.hardware.drive.{key}={value}")]
    # Without its double, for a device that is looked for would be missed first.
    assert main(["run", "drag", "--backend", "hardware", *words]) != 0
    [line] = capsys.readouterr().err.splitlines()
    assert "card.lines.heartbeat must be wired" in line
    assert "does not stop by itself when it hears nothing" in line


def test_a_drive_without_a_silence_timeout_is_taken_with_relay_and_enable_line() -> None:
    rig = settings(hardware={"card": {"lines": RELAY}, "drive": {"dialect": "copley", **UNITS}})
    assert fitting_dialect(rig.hardware) is copley.DIALECT
    for nothing_lacking in ("nikki", "modbus"):
        assert fitting_dialect(settings(hardware={"drive": {"dialect": nothing_lacking}}).hardware)


def test_units_that_a_dialect_needs_are_asked_for() -> None:
    rig = settings(hardware={"card": {"lines": RELAY}, "drive": {"dialect": "copley", "counts_per_mm": 1000.0}})
    with pytest.raises(SettingsError, match=r"hardware\.drive\.thrust_N_per_A is not set"):
        fitting_dialect(rig.hardware)


def test_a_mode_that_a_dialect_does_not_know_is_refused() -> None:
    drive = {"dialect": "copley", "mode": "velocity", **UNITS}
    rig = settings(hardware={"card": {"lines": RELAY}, "drive": drive})
    with pytest.raises(SettingsError, match=r"hardware\.drive\.mode = 'velocity' is not possible .* copley"):
        fitting_dialect(rig.hardware)


def test_a_register_map_without_the_timeout_declares_that_it_is_lacking() -> None:
    registers = dict(modbus.RegisterMap().parameters)
    del registers[Parameter.SILENCE_S]
    assert Lack.SILENCE_TIMEOUT in modbus.ModbusDialect(modbus.RegisterMap(parameters=registers)).lacks
    assert Lack.SILENCE_TIMEOUT not in modbus.DIALECT.lacks


# Frames as the public documents print them.


def test_copleys_commands_are_those_of_its_guide() -> None:
    drive = SETTINGS["copley"]
    for request, frames in (
        (Request(Command.GO, value=12.5), (b"s r0xca 12500\r", b"g r0xca\r", b"t 1\r")),
        (Request(Command.STOP), (b"t 0\r",)),
        (Request(Command.SET, Parameter.SPEED_MM_S, 20.0), (b"s r0xcb 200000\r",)),
        (Request(Command.SET, Parameter.ACCELERATION_MM_S2, 500.0), (b"s r0xcc 50000\r", b"s r0xcd 50000\r")),
        (Request(Command.SET, Parameter.THRUST_LIMIT_N, 20.0), (b"s r0x21 250\r",)),
        (Request(Command.ENABLE), (b"s r0xc8 0\r", b"s r0x24 21\r", b"g r0xa0\r")),
    ):
        assert copley.DIALECT.encode(request, drive) == frames
    assert copley.DIALECT.decode(Request(Command.POSITION), (b"v -1234\r",), drive) == Reply(-1.234)
    parsing = copley.DIALECT.decode(Request(Command.STOP), (b"e 33\r",), drive)
    assert parsing == Reply(refusal=Refusal.UNKNOWN)
    with pytest.raises(FrameError, match="value"):
        copley.DIALECT.decode(Request(Command.POSITION), (b"ok\r",), drive)


@pytest.mark.parametrize(
    ("said_to_it", "answer"),
    [("s r 0xca 1000", "e 33"), ("g r0xca x y", "v 0"), ("q", "e 3"), ("s r0x32 5", "e 11"), ("g r0x1ff", "e 9"),
     ("0 g r0xca", "v 0"), ("4 g r0xca", "e 32"), ("s r0xca 99999999999", "e 10"), ("s r0xca 0x10", "ok"),
     ("t 1", "e 25"), ("t", "e 25")],
)  # fmt: skip
def test_copleys_double_answers_as_the_guide_has_it(said_to_it: str, answer: str) -> None:
    side = find_drive_side(copley.DIALECT, SETTINGS["copley"])
    assert side.answer(said_to_it.encode() + b"\r", Scripted(Reply()).act) == answer.encode() + b"\r"


def test_a_copley_target_that_the_drive_holds_otherwise_is_not_started() -> None:
    go = Request(Command.GO, value=12.5)
    held = copley.DIALECT.decode(go, (b"ok\r", b"v 12500\r"), SETTINGS["copley"])
    damaged = copley.DIALECT.decode(go, (b"ok\r", b"v 92500\r"), SETTINGS["copley"])
    assert (held, damaged) == (None, Reply(refusal=Refusal.BAD_VALUE))


def test_copley_ramps_that_differ_verify_nothing() -> None:
    read = Request(Command.READ, Parameter.ACCELERATION_MM_S2)
    same = copley.DIALECT.decode(read, (b"v 100\r", b"v 100\r"), SETTINGS["copley"])
    other = copley.DIALECT.decode(read, (b"v 100\r", b"v 900\r"), SETTINGS["copley"])
    assert isinstance(same, Reply)
    assert same.value == pytest.approx(1.0)
    assert isinstance(other, Reply)
    assert other.value != other.value  # not a number


def test_the_modbus_frame_is_that_of_the_standards_example() -> None:
    dialect = modbus.ModbusDialect(modbus.RegisterMap(status=0x006B))
    drive = DriveSettings(dialect="modbus", station=17)
    assert dialect.encode(Request(Command.STATUS), drive) == (bytes.fromhex("11 03 00 6B 00 03 76 87"),)
    assert dialect.pause_s(DriveSettings(baud=9600)) == pytest.approx(3.5 * 11 / 9600)
    assert dialect.pause_s(DriveSettings(baud=115_200)) == pytest.approx(1.75e-3)


# A stage on each, over the line.

SPOKEN: dict[str, dict[str, object]] = {
    "copley": {"dialect": "copley", "station": 0, "reply_s": 0.3, **UNITS},
    "modbus": {"dialect": "modbus", "station": 7},
}


@pytest.mark.parametrize(
    ("spoken", "kind"),
    [
        ("copley", ANY_PORT), thorough("copley", SocketPort), thorough("copley", DoublePort),
        thorough("modbus", ANY_PORT), ("modbus", SocketPort), thorough("modbus", DoublePort),
    ],
)  # fmt: skip
def test_a_stage_is_homed_moved_and_stopped(spoken: str, kind: type[DrivePort]) -> None:
    with driven(kind, **SPOKEN[spoken]) as rig:
        rig.ready().stage.move(stroke(travel_mm=2.0))
        until(lambda: not rig.sync.moving)
        assert rig.stage.state().position_mm == pytest.approx(2.0, abs=2e-3)
        rig.stage.move(stroke(travel_mm=100.0))
        until(lambda: rig.bench.position_mm() > 3.0)
        rig.stage.stop()
        until(lambda: not rig.bench.moving)
        assert rig.bench.position_mm() < 100.0
        assert rig.drive.status.halt is Halt.STOP


def test_a_drive_without_a_silence_timeout_is_never_asked_for_one() -> None:
    with driven(ANY_PORT, **SPOKEN["copley"]) as rig:
        rig.ready().stage.move(stroke(travel_mm=2.0))
        until(lambda: not rig.sync.moving)
        written = {request.parameter for request in rig.drive.requests}
        assert Parameter.THRUST_LIMIT_N in written
        assert Parameter.SILENCE_S not in written


def test_a_start_in_several_frames_is_as_certain_as_its_last_one() -> None:
    with driven(ANY_PORT, **SPOKEN["copley"]) as rig:
        rig.ready().bench.faults.inject(drive_reply_late_s=0.05)
        with Stall() as stall:
            rig.sample(stroke(travel_mm=2.0, rest_s=0.6))
            until(lambda: not rig.sync.moving)
        rig.bench.faults.clear()
        # Three frames, of which the last takes 0.05 s; the stage's threads and the double's may all be late.
        assert 0.025 < rig.stage.start_uncertainty_s < 0.1 + 3 * stall.longest_s
        assert rig.drive.requests[-1] == Request(Command.GO, value=2.0)


@pytest.mark.parametrize(("fault", "halt"), [({"drive_alarm": "a short circuit"}, Halt.ALARM)])
def test_an_alarm_is_told_in_the_dialects_words(fault: dict[str, str], halt: Halt) -> None:
    with driven(ANY_PORT, **SPOKEN["copley"]) as rig:
        rig.ready().stage.move(stroke(travel_mm=100.0))
        until(lambda: rig.bench.moving)
        rig.bench.faults.inject(**fault)
        until(lambda: rig.stage.fault is not None)
        assert rig.stage.fault is not None
        assert "a short circuit" in rig.stage.fault.message
        until(lambda: not rig.bench.moving)
        assert rig.drive.status.halt is halt


def test_a_server_that_nobody_here_wrote_drives_the_stage_in_modbus() -> None:
    with driven(PymodbusPort, **SPOKEN["modbus"]) as rig:
        rig.ready().stage.move(stroke(travel_mm=2.0))
        until(lambda: not rig.sync.moving)
        assert rig.stage.state().position_mm == pytest.approx(2.0, abs=2e-3)
        refused = rig.link.dialect.encode(Request(Command.GO, value=151.0), rig.devices.settings.hardware.drive)
        assert len(refused) == 2
        with pytest.raises(Exception, match="soft limits"):
            rig.link.exchange(Request(Command.GO, value=151.0))


# The page that tells how to write another one, followed to the letter.

PAGE = (ROOT / "docs" / "drive-dialect.md").read_text("utf-8")
PATIENT = {"homing_speed_mm_s": 50.0, "reply_s": 2.0, "silence_s": 5.0, "stale_data_s": 5.0, "hang_s": 5.0,
           "following_error_mm": 50.0, "encoder_silent_mm": 50.0}  # fmt: skip
"""For a busy machine is no fault of the page's."""


def on_the_page(language: str) -> str:
    [block] = re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    return str(block)


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """A lab folder with the page's module and its line in the rig file."""
    create_lab(tmp_path)
    (tmp_path / "line_dialect.py").write_text(on_the_page("python"), "utf-8")
    rig = (tmp_path / "rig.toml").read_text("utf-8")
    table, line = on_the_page("toml").strip().splitlines()
    assert table in rig
    changes = {**{key: f"{key} = {value}" for key, value in PATIENT.items()}, "dialect": line}
    for key, changed in changes.items():
        rig, count = re.subn(rf"^{key} = .*$", changed, rig, flags=re.MULTILINE)
        assert count == 1, key
    (tmp_path / "rig.toml").write_text(rig, "utf-8")
    return tmp_path


@pytest.mark.thorough
@pytest.mark.skipif(os.name == "nt", reason="the page's commands are those of a Unix shell")
def test_the_page_followed_to_the_letter_makes_a_run_in_a_dialect_of_ones_own(lab: Path) -> None:
    commands = on_the_page("sh")
    assert [line.split()[0] for line in commands.strip().splitlines()] == ["export", "dragrig", "dragrig"]
    done = subprocess.run(
        ["bash", "-e"], cwd=lab, env={**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"},
        input=commands.replace('"A. Person"', '"A. Person" <<< $\'\\n\\n\\n\\n\\n\\n\''),
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    runs = read_campaign(next((lab / "runs").iterdir())).runs
    assert [(run.kind, run.status) for run in runs] == [
        ("drag", RunStatus.COMPLETE),
        ("return", RunStatus.COMPLETE),
    ]
    assert runs[0].header.entry["drive_dialect"] == "line_dialect"


def test_the_pages_dialect_holds_what_it_declares(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(lab))
    drive = DriveSettings(dialect="line_dialect")
    dialect = find_dialect("line_dialect")
    monkeypatch.delitem(sys.modules, "line_dialect")
    assert dialect.lacks == frozenset()
    moving = Reply(status=Status(True, False, True, 2, Halt.NONE))
    for request in (
        Request(Command.STATUS),
        Request(Command.GO, value=1.5),
        Request(Command.READ, Parameter.SILENCE_S),
    ):
        side = find_drive_side(dialect, drive)
        scripted = Scripted(moving)
        reply, frames = said(dialect, side, request, drive, scripted.act)
        assert scripted.asked == [request]
        assert reply.status == (moving.status if request.command is Command.STATUS else None)
        for place in range(len(frames[0])):
            for flip in (1, 0x20, 0x80):
                damaged = frames[0][:place] + bytes([frames[0][place] ^ flip]) + frames[0][place + 1 :]
                with pytest.raises(FrameError):
                    dialect.decode(request, (damaged,), drive)
        with pytest.raises(FrameError, match="instead"):
            dialect.decode(Request(Command.POSITION), frames, drive)
        with pytest.raises(FrameError, match="station"):
            dialect.decode(request, frames, drive.model_copy(update={"station": 2}))
    with pytest.raises(FrameError, match="fit"):
        dialect.encode(Request(Command.GO, value=float("nan")), drive)


def test_a_module_without_a_drives_side_is_told_when_a_double_is_to_speak_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mute_dialect.py").write_text(on_the_page("python").replace("DRIVE_SIDE = ", "ANOTHER = "), "utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(SettingsError, match=r"without a DRIVE_SIDE.*docs/drive-dialect\.md"):
        find_drive_side(find_dialect("mute_dialect"), DriveSettings(dialect="mute_dialect"))
    monkeypatch.delitem(sys.modules, "mute_dialect")
