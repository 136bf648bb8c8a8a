"""What the fault tests share: the real rig's program before doubles, struck while the stage moves.

The program under test is either the API on a thread of this process, or `dragrig run` as a process of its own, which
doubles in a third process outlive. What it tells is held against docs/faults.md.
"""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np

import dragrig as api
from card_server import CardServer
from dragrig.campaign_session import Made
from dragrig.config.errors import DragrigError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.config.settings import to_toml
from dragrig.rig.engine import AcquisitionOutcome
from dragrig.rig.hardware.dialects.base import Halt
from dragrig.rig.hardware.drive.trial import PULSE_MM
from dragrig.rig.operator import Answer, NullOperator, Prompt
from dragrig.rig.programme import PlannedRun
from dragrig.rig.reading import Reading
from dragrig.rig.runfile import read_campaign, read_run
from dragrig.rig.runfile.model import Run, RunStatus
from dragrig.sim_backend.doubles.c_library import installed
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.drive_double import make_drive_double
from dragrig.sim_backend.doubles.simulated_bench import ActiveFaults, DoubleClock, SimulatedBench
from drive_ports import SocketPort
from places import ROOT
from remote_doubles import DoublePorts, StageStatus, with_double_ports
from remote_server import inject_faults, stage_status
from simulated import settings

START_MM = 5.0
TRAVEL_MM = 18.0
SPEED_MM_S = 6.0
PLAN = f"""name = "one-drag"

[[steps]]
kind = "drag"
speed_mm_s = {SPEED_MM_S}
travel_mm = {TRAVEL_MM}
rest_s = 0.1
hold_s = 0.5
wait_s = 0.0
way_back = "stay"
"""
MOVED_MM = 0.1
STRUCK_FROM_MM = START_MM + PULSE_MM + 0.5
PATIENCE_S = 600.0
_LOOK_S = 0.05
DOCS = ROOT / "docs" / "faults.md"

# As patient as may be set, so that a busy machine is no fault.
PATIENT = {
    "guard.stale_data_s": 5.0,
    "guard.following_error_mm": 100.0,
    "guard.encoder_silent_mm": 100.0,
    "hardware.hang_s": 5.0,
    "hardware.drive.silence_s": 5.0,
    "hardware.drive.reply_s": 2.0,
}
RIG = settings(
    backend="hardware",
    name="rig under test",
    stage={"start_mm": START_MM},
    guard={key.removeprefix("guard."): value for key, value in PATIENT.items() if key.startswith("guard.")},
    hardware={
        "drive": {"homing_speed_mm_s": 50.0, "reply_s": 2.0, "silence_s": 5.0},
        "card": {"buffer_s": 20.0, "lines": {"encoder_error": "port1/line5"}},
        "hang_s": 5.0,
    },
)
# A test that waits for the rig to lose patience says for what, and has the stage travel far enough for that: a busy
# machine may be late by a good part of a second, and the rig loses patience after two.
FAR_MM = 36.0
FAR = f"travel_mm={FAR_MM}"
SOON_STALE = (FAR, "rig.guard.stale_data_s=2.0")
SOON_STUCK = (FAR, "rig.guard.encoder_silent_mm=0.4", "rig.guard.encoder_silent_s=2.0")
SOON_HUNG = (FAR, "rig.hardware.hang_s=2.0")
SOON_UNANSWERED = (FAR, "rig.hardware.drive.reply_s=0.4")
SOON_SILENT = (FAR, "rig.hardware.drive.silence_s=2.0")
# A reply is awaited for nearly as long as the silence, and only once that is over for no longer than this.
SOON_CUT_OFF = (*SOON_SILENT, "rig.hardware.drive.reply_s=0.05")


def sentence(fault: str) -> re.Pattern[str]:
    """What docs/faults.md has the person see; `…` stands for whatever differs from case to case."""
    rows = [line.split("|")[1:-1] for line in DOCS.read_text("utf-8").splitlines() if line.startswith("|")]
    (shown,) = [row[1].strip(" `") for row in rows if row[0].strip() == fault and row[1].strip().startswith("`")]
    return re.compile(".+?".join(re.escape(part) for part in shown.split("…")), re.DOTALL)


class Person(NullOperator):
    """Does at once whatever is asked, and knows how far the run is."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.noted: list[str] = []
        self.samples = 0
        self.saw_motion = False

    def ask(self, prompt: Prompt) -> Answer:
        self.asked.append(prompt.text)
        return Answer.DONE

    def run_begins(self, run: PlannedRun, order: int) -> None:
        self.samples, self.saw_motion = 0, False

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        self.noted += outcome.checks.warnings

    def reads(self, reading: Reading) -> None:
        self.samples = reading.end_index
        self.saw_motion = self.saw_motion or float(reading.channels["position"].max()) > MOVED_MM


class NearDoubles:
    """Doubles in this process, with the face of `RemoteDoubles` and its control socket."""

    def __init__(self, rig: RigSettings) -> None:
        self._given = rig
        self._bench = SimulatedBench(rig, FrictionModelSettings(), DoubleClock())
        self._drive = make_drive_double(self._bench)
        self._port = ""
        self._open = ExitStack()

    def __enter__(self) -> Self:
        self._plug_in(Card(self._bench))
        self._open.enter_context(self._drive)
        self._port = self._open.enter_context(SocketPort(self._drive)).address
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    @property
    def control(self) -> Self:
        return self

    def rig(self) -> RigSettings:
        drive = self._given.hardware.drive.model_copy(update={"port": self._port})
        return self._given.model_copy(update={"hardware": self._given.hardware.model_copy(update={"drive": drive})})

    def stage(self) -> StageStatus:
        return stage_status(self._drive)

    def set_faults(self, **faults: Any) -> None:
        inject_faults(self._bench.faults, faults)

    def _plug_in(self, card: Card) -> None:
        self._open.enter_context(installed(card))


class ServedDoubles(NearDoubles):
    """Doubles in this process that programs in others reach, the card at its server, and that outlive these."""

    def rig(self) -> RigSettings:
        return with_double_ports(self._given, DoublePorts(card=self._server.port, drive=self._port, control=0))

    def _plug_in(self, card: Card) -> None:
        self._server = self._open.enter_context(CardServer(card))


@dataclass
class Bench:
    """Doubles, and a lab folder whose rig they are."""

    doubles: NearDoubles
    lab: Path
    _folders: int = field(default=0)

    def folder(self) -> Path:
        self._folders += 1
        return self.lab / f"campaign-{self._folders}"

    def look(self) -> StageStatus:
        return self.doubles.control.stage()

    def inject(self, **faults: Any) -> None:
        self.doubles.control.set_faults(**faults)

    def repair(self) -> None:
        self.inject(**asdict(ActiveFaults()))

    def until(self, true: Callable[[StageStatus], bool], while_: Callable[[], bool] = lambda: True) -> StageStatus:
        """Look at the stage until something is true of it."""
        until_s, pause = time.monotonic() + PATIENCE_S, threading.Event()
        while time.monotonic() < until_s:
            look = self.look()
            if true(look):
                return look
            assert while_(), f"the program ended before: {look}"
            pause.wait(_LOOK_S)
        raise AssertionError(f"the stage never got there: {look}")

    def until_under_way(
        self, while_: Callable[[], bool] = lambda: True, from_mm: float = STRUCK_FROM_MM
    ) -> StageStatus:
        """Wait until the stage is in the middle of the drag: come from its start, and beyond the trial's pulse."""
        self.until(lambda look: look.position_mm < STRUCK_FROM_MM, while_)
        return self.until(lambda look: look.speed_mm_s > 0 and look.position_mm >= from_mm, while_)


@contextmanager
def bench(lab: Path, kind: type[NearDoubles] = NearDoubles) -> Iterator[Bench]:
    with kind(RIG) as doubles:
        (lab / "rig.toml").write_text(to_toml(doubles.rig()), "utf-8")
        (lab / "plan.toml").write_text(PLAN, "utf-8")
        yield Bench(doubles, lab)


@dataclass
class Ended:
    """How a session ended, and how the stage was then."""

    folder: Path
    status: RunStatus
    reason: str
    exit_code: int
    message: str
    stage: StageStatus


class Running:
    """The API on a thread."""

    def __init__(self, bench: Bench, folder: Path, work: Callable[[Person], Made]) -> None:
        self.bench, self.folder, self.person = bench, folder, Person()
        self._made: list[Made] = []
        self._raised: list[Exception] = []
        self._work = work
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def until_under_way(self) -> StageStatus:
        return self.bench.until_under_way(lambda: self.alive or self.reported())

    def reported(self) -> bool:
        raise AssertionError(self.end())

    def inject(self, **faults: Any) -> StageStatus:
        self.until_under_way()
        # On a busy machine samples arrive later than the stage moves.
        look = self.bench.until(lambda _: self.person.saw_motion, lambda: self.alive or self.reported())
        self.bench.inject(**faults)
        return look

    def end(self) -> Ended:
        self._thread.join(PATIENCE_S)
        assert not self.alive
        if self._raised:
            error = self._raised[0]
            assert isinstance(error, DragrigError), error
            return Ended(self.folder, RunStatus.FAILED, str(error), error.exit_code, str(error), self.bench.look())
        session = self._made[0].session
        try:
            session.require()
        except DragrigError as error:
            answer, code = str(error), error.exit_code
        else:
            answer, code = "", 0
        return Ended(self.folder, session.status, session.reason, code, answer, self.bench.look())

    def _run(self) -> None:
        try:
            self._made.append(self._work(self.person))
        except Exception as error:  # noqa: BLE001  # raised again, or judged, where it is ended
            self._raised.append(error)


def begin(bench: Bench, **choices: Any) -> Running:
    folder = choices.pop("out", None) or bench.folder()
    arguments = {"rig": bench.lab / "rig.toml", **choices}
    return Running(
        bench, folder, lambda person: api.run(bench.lab / "plan.toml", out=folder, person=person, **arguments)
    )


def resume(bench: Bench, folder: Path) -> Running:
    patient = [f"rig.{key}={value}" for key, value in PATIENT.items()]
    return Running(bench, folder, lambda person: api.resume(folder, person=person, assignments=patient))


class Program:
    """`dragrig run` as a process, with somebody at the keyboard who says done to everything."""

    def __init__(self, bench: Bench, *words: str, **environment: str) -> None:
        self.bench = bench
        self.process = subprocess.Popen(
            [sys.executable, "-m", "dragrig", "run", *words, "--json"],
            cwd=bench.lab, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env={**os.environ, "PYTHONFAULTHANDLER": "1", **environment},
        )  # fmt: skip
        assert self.process.stdin is not None
        self.process.stdin.write("done\n" * 20)
        self.process.stdin.flush()

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def until_under_way(self, from_mm: float = STRUCK_FROM_MM) -> StageStatus:
        return self.bench.until_under_way(lambda: self.alive or self.reported(), from_mm)

    def reported(self) -> bool:
        raise AssertionError(self.process.communicate())

    def end(self) -> tuple[int, Any, str]:
        """Exit code, what it printed as a result, and the last line that it told the person."""
        try:
            printed, answer = self.process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired as error:
            # It tells where each of its threads is.
            self.process.send_signal(signal.SIGABRT)
            raise AssertionError(self.process.communicate()[1]) from error
        lines = [line for line in answer.splitlines() if line]
        return (
            self.process.returncode,
            json.loads(printed) if printed else None,
            lines[-1].removeprefix("dragrig: ") if lines else "",
        )

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


def only_run(folder: Path) -> Run:
    (info,) = read_campaign(folder).runs
    return read_run(info.path)


def assert_kept(run: Run, samples: int) -> None:
    """Everything up to a sample is there, on time, and the position is the true one."""
    assert run.info.samples >= samples
    np.testing.assert_allclose(run.trace.time, np.arange(run.info.samples) / 1000.0, atol=1e-9)
    assert float(run.trace.position.max()) > MOVED_MM


def assert_stopped(struck: StageStatus, stage: StageStatus, halt: Halt, travel_mm: float = TRAVEL_MM) -> None:
    """It stands, short of its target, for this reason."""
    assert not stage.moving
    assert stage.speed_mm_s == 0
    assert stage.halt is halt
    assert struck.position_mm <= stage.position_mm < START_MM + travel_mm - 0.1


def assert_goes_on(bench: Bench, folder: Path) -> None:
    """With the fault repaired, the campaign goes on to its end."""
    bench.repair()
    ended = resume(bench, folder).end()
    assert (ended.status, ended.exit_code) == (RunStatus.COMPLETE, 0), ended.message
    (made,) = (info for info in read_campaign(folder).runs if info.status is RunStatus.COMPLETE)
    assert made.header.order == len(read_campaign(folder).runs) - 1
    assert made.checks["lost_samples"] == 0


def assert_reported(fault: str, ended: Ended, run: Run) -> None:
    """The person and the file hear the same one sentence, the one that the docs show."""
    assert sentence(fault).fullmatch(ended.message), ended.message
    assert ended.reason.startswith(run.info.reason)
    assert ended.message.count("\n") == 0
    kinds = {event.kind: event.message for event in run.events}
    assert run.info.reason.startswith(kinds["trip" if ended.status is RunStatus.TRIPPED else "stop"].rstrip("…"))
