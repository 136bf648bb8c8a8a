"""Messages between client and engine host: pickled frozen values, and live samples through a ring in shared memory."""

import ctypes
from dataclasses import dataclass, field
from multiprocessing.context import SpawnContext
from pathlib import Path
from typing import TypeAlias, cast

import numpy as np
import numpy.typing as npt

from dragrig.config import Calibration, Plan
from dragrig.present import Document
from dragrig.rig import (
    MAX_OVERRIDE_SPEED_MM_S,
    PHASE_NAMES,
    Answer,
    IdleReading,
    Reading,
    RigCheck,
    RigMemory,
    RunStatus,
    TravelEnd,
)
from dragrig.setup import Pace, RigChoices

__all__ = [
    "MAX_OVERRIDE_SPEED_MM_S",
    "PHASE_NAMES",
    "Answer",
    "IdleReading",
    "Pace",
    "RunStatus",
    "TravelEnd",
]  # types of the messages' fields, for clients that do not import the rig

HEARTBEAT_S = 0.2
"""Interval of a client's signs of life, given by the thread that would send a stop: another one proves nothing."""


@dataclass(frozen=True, slots=True)
class SilenceLimits:
    """How long the host goes on without a sign of life from its client; any request is one."""

    moving_s: float = 1.0
    """While anything moves, or may at once: then it is stopped, and what is done ends as aborted."""
    standing_s: float = 20.0
    """At any time: then the client counts as dead, and the host ends."""


SILENCE_LIMITS = SilenceLimits()


@dataclass(frozen=True, slots=True)
class RigSelection:
    """The rig of a host; None means the default, as in `dragrig.examine`."""

    rig: Path | None = None
    model: str | Path | None = None
    backend: str | None = None
    double: bool = False
    assignments: tuple[str, ...] = ()
    pace: Pace | None = None
    memory: RigMemory = field(default_factory=RigMemory, compare=False)
    """Where a simulated rig keeps what outlasts a motion; of use in the host alone."""

    def choices(self) -> RigChoices:
        """Return the keyword arguments of `dragrig.examine`."""
        return cast("RigChoices", {name: getattr(self, name) for name in RigChoices.__annotations__})


@dataclass(frozen=True, slots=True)
class SessionJob:
    """A session to carry out."""

    number: int
    """Assigned by the client."""
    plan: Plan | str
    operator: str = ""
    note: str = ""
    pace: Pace | None = None
    out: Path | None = None
    resume: Path | None = None
    """Folder of a campaign to resume, in place of the plan."""
    append: Path | None = None
    """Folder of a campaign that the runs of the plan are added to."""
    mirror: Path | None = None
    """Folder for a second copy of each finished file."""
    specimen: tuple[str, ...] = ()
    """What is stated of the specimen, as assignments: `specimen.id=P7`."""

    @property
    def campaign(self) -> Path | None:
        """The campaign that the session goes on with; None for one of its own."""
        return self.append or self.resume


@dataclass(frozen=True, slots=True)
class AbortSession:
    """Stop the stage now and end the session in good order."""

    reason: str


@dataclass(frozen=True, slots=True)
class PauseSession:
    """Wait for a person before the next run of the session, or no longer."""

    on: bool


@dataclass(frozen=True, slots=True)
class PromptReply:
    """The answer to the prompt of this number."""

    question: int
    answer: Answer


@dataclass(frozen=True, slots=True)
class ExamineRig:
    """Check every device; nothing moves."""


@dataclass(frozen=True, slots=True)
class ResetGuard:
    """Reset the guard, if every condition is clear."""


@dataclass(frozen=True, slots=True)
class HomeStage:
    """Find the stage's origin, once the person confirms."""

    override: TravelEnd | None = None
    """Side whose pressed limit switch is overridden for this one motion, which the tripped guard then allows."""


@dataclass(frozen=True, slots=True)
class JogStage:
    """Move the stage by a signed distance, once the person confirms."""

    distance_mm: float
    speed_mm_s: float
    override: TravelEnd | None = None
    """As of `HomeStage`; the distance must lead away from the switch."""


@dataclass(frozen=True, slots=True)
class TouchOffStage:
    """Approach slowly until the force changes, once the person confirms, and store the contact in the lab folder."""

    most_mm: float
    force_mN: float
    speed_mm_s: float
    back_mm: float
    operator: str = ""


HandMotion: TypeAlias = HomeStage | JogStage | TouchOffStage


@dataclass(frozen=True, slots=True)
class CalibrateForce:
    """Read the force sensor under known weights, which the person hangs on it; stores nothing."""

    weights_g: tuple[float, ...]
    repeats: int = 1
    duration_s: float = 2.0
    """Of each reading."""
    operator: str = ""
    note: str = ""


@dataclass(frozen=True, slots=True)
class CalibrateEncoder:
    """Count over a known travel, driven once the person confirms or pushed by hand; stores nothing."""

    travel_mm: float
    """Signed."""
    measured_mm: tuple[float, ...] = ()
    """What a gauge showed for every repeat, or nothing."""
    repeats: int = 3
    speed_mm_s: float = 10.0
    by_hand: bool = False
    duration_s: float = 20.0
    """Time for a push by hand."""
    operator: str = ""
    note: str = ""


CalibrationJob: TypeAlias = CalibrateForce | CalibrateEncoder


@dataclass(frozen=True, slots=True)
class StoreCalibration:
    """Add a calibration that was measured, and seen, to the lab's history; it applies from then on."""

    entry: Calibration


@dataclass(frozen=True, slots=True)
class WatchRig:
    """Read force and position whenever nothing is done, or leave the rig to other programs meanwhile."""

    on: bool


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """A sign of life."""


@dataclass(frozen=True, slots=True)
class StopHost:
    """End the process, after ending a running session."""


Request: TypeAlias = (
    SessionJob
    | AbortSession
    | PauseSession
    | PromptReply
    | ExamineRig
    | ResetGuard
    | HandMotion
    | CalibrationJob
    | StoreCalibration
    | WatchRig
    | Heartbeat
    | StopHost
)


@dataclass(frozen=True, slots=True)
class HostReady:
    """The host is up."""

    pid: int


@dataclass(frozen=True, slots=True)
class RigExamined:
    """Results of the device checks; `error` if they could not be finished."""

    devices: tuple[RigCheck, ...]
    error: str = ""


@dataclass(frozen=True, slots=True)
class GuardState:
    """Why nothing may move; empty when the guard is armed."""

    reason: str
    tripped: bool = True
    """Whether something tripped it; otherwise it has only not been reset since the start."""


@dataclass(frozen=True, slots=True)
class QueuedRun:
    """A run of a session, for a list of runs."""

    index: int
    summary: str
    wait_s: float
    duration_s: float
    start_mm: float = 0.0
    """Absolute position where it begins, to which the live positions are relative."""
    is_way_back: bool = False
    """Whether it belongs to the run before it."""


@dataclass(frozen=True, slots=True)
class SessionStarted:
    """A session started, with these runs still to make."""

    job: int
    runs: tuple[QueuedRun, ...]
    real_time: bool
    folder: Path = Path()
    """Of its campaign."""


@dataclass(frozen=True, slots=True)
class SessionWaiting:
    """A rest before a run begins, of which live samples follow where time is real."""

    run: QueuedRun
    duration_s: float


@dataclass(frozen=True, slots=True)
class StageHomes:
    """The stage moves to its origin from now on, in a sentence; or no longer, where that is empty."""

    sentence: str


@dataclass(frozen=True, slots=True)
class RunStarted:
    """A run started."""

    run: QueuedRun
    order: int


@dataclass(frozen=True, slots=True)
class RunFinished:
    """A run ended, with the warnings of its checks."""

    run: QueuedRun
    order: int
    status: RunStatus
    reason: str
    samples: int
    warnings: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SentinelCompared:
    """How far the specimen has drifted, in a sentence; `order` is the sentinel's."""

    order: int
    sentence: str


@dataclass(frozen=True, slots=True)
class RigIdle:
    """Force and position while nothing is acquired: between sessions, and while a prompt is open."""

    reading: IdleReading
    question: int = 0
    """Number of the open prompt; 0 for none."""


@dataclass(frozen=True, slots=True)
class StageMoved:
    """A motion by hand is over: the place of the stage, or the contact, in a sentence; or why it failed."""

    sentence: str
    problem: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationMeasured:
    """A calibration was measured and is not stored yet: entry and record to look at; or why it failed."""

    entry: Calibration | None
    record: Document | None
    problem: str = ""


@dataclass(frozen=True, slots=True)
class CalibrationStored:
    """A calibration is in the lab's history; or why it is not."""

    problem: str = ""


@dataclass(frozen=True, slots=True)
class PromptShown:
    """A prompt; `hands` if it needs hands or eyes at the rig."""

    question: int
    text: str
    can_redo: bool
    can_skip: bool
    hands: bool
    can_measure: bool = False


@dataclass(frozen=True, slots=True)
class MirrorStatus:
    """Number of files in the mirror, and the missing ones, each with the reason."""

    folder: Path
    copied: int
    missing: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class OperatorWarning:
    """A warning that the operator must see at once; nothing stops."""

    sentence: str


@dataclass(frozen=True, slots=True)
class SessionFinished:
    """A session ended; `status` is None if it never started, for the given reason."""

    job: int
    status: RunStatus | None
    reason: str
    folder: Path | None = None
    mirror: MirrorStatus | None = None


@dataclass(frozen=True, slots=True)
class RequestRefused:
    """A request that cannot be carried out, with the reason."""

    sentence: str


@dataclass(frozen=True, slots=True)
class HostLost:
    """The host process is gone; raised by the client itself."""

    exit_code: int | None


Event: TypeAlias = (
    HostReady
    | RigExamined
    | GuardState
    | SessionStarted
    | SessionWaiting
    | StageHomes
    | RunStarted
    | RunFinished
    | SentinelCompared
    | RigIdle
    | StageMoved
    | CalibrationMeasured
    | CalibrationStored
    | PromptShown
    | OperatorWarning
    | SessionFinished
    | RequestRefused
    | HostLost
)


RING_SAMPLES = 1 << 20
"""Size of the ring: over 17 min at 1 kHz, 4 s at 250 kHz."""
_RING_MARGIN = 1 << 14
"""Distance that a reader keeps from the oldest samples, which are overwritten while it copies."""
_FIELDS = 4
_WRITTEN, _SERIAL, _BASE, _RATE_MHZ = range(_FIELDS)
_BYTES_PER_SAMPLE = 4 + 4 + 1

RingMemory = ctypes.Array[ctypes.c_byte]
Floats = npt.NDArray[np.float32]
Phases = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class LiveSamples:
    """New samples, arrays of shape `(n,)`."""

    serial: int
    """Differs from run to run."""
    rate_hz: float
    first_index: int
    """Index of the first sample from the start of the run, lost samples included."""
    missed: int
    """Number of samples before these that were overwritten unread."""
    force: Floats
    position: Floats
    """`force`, `position`: in mN and mm; NaN where the sampler lost samples."""
    phase: Phases


def shared_memory(context: SpawnContext, samples: int = RING_SAMPLES) -> RingMemory:
    """Return memory for a ring, to be passed to a process at its start; it lives as long as both processes."""
    return context.RawArray(ctypes.c_byte, 8 * _FIELDS + _BYTES_PER_SAMPLE * samples)


class _SampleRing:
    def __init__(self, memory: RingMemory) -> None:
        self.samples = (len(memory) - 8 * _FIELDS) // _BYTES_PER_SAMPLE
        at, content = 8 * _FIELDS, memoryview(memory).cast("B")
        self.head: npt.NDArray[np.int64] = np.frombuffer(content, np.int64, _FIELDS)
        self.force: Floats = np.frombuffer(content, np.float32, self.samples, at)
        self.position: Floats = np.frombuffer(content, np.float32, self.samples, at + 4 * self.samples)
        self.phase: Phases = np.frombuffer(content, np.uint8, self.samples, at + 8 * self.samples)


class LiveRingWriter:
    """Writes samples to the ring, whose reader it never waits for; belongs to one thread."""

    def __init__(self, memory: RingMemory) -> None:
        self._ring = _SampleRing(memory)
        self._starts_run = False

    def begin(self) -> None:
        """Start another run with the next block."""
        self._starts_run = True

    def put(self, reading: Reading) -> None:
        """Write a block; takes as long as copying it."""
        head = self._ring.head
        if self._starts_run:
            self._open_run(reading)
        written, base = int(head[_WRITTEN]), int(head[_BASE])
        gap = base + reading.first_index - written
        if gap > 0:
            written = self._write(written, gap, np.float32(np.nan), np.float32(np.nan), reading.phase[:1])
        force, position = reading.channels["force"], reading.channels["position"]
        head[_WRITTEN] = self._write(written, len(force), force, position, reading.phase)

    def _open_run(self, reading: Reading) -> None:
        head, self._starts_run = self._ring.head, False
        # Odd while the fields are inconsistent.
        head[_SERIAL] += 1
        head[_BASE] = head[_WRITTEN]
        last, last_s = reading.end_index - 1, float(reading.time[-1])
        head[_RATE_MHZ] = round(1000 * (last / last_s if last > 0 and last_s > 0 else 1000.0))
        head[_SERIAL] += 1

    def _write(
        self, written: int, count: int, force: npt.ArrayLike, position: npt.ArrayLike, phase: npt.ArrayLike
    ) -> int:
        ring = self._ring
        lost = max(count - ring.samples, 0)
        places = np.arange(written + lost, written + count) % ring.samples
        for target, values in ((ring.force, force), (ring.position, position), (ring.phase, phase)):
            target[places] = np.broadcast_to(values, count)[lost:]
        return written + count


class LiveRingReader:
    """Reads new samples from the ring; any number of readers, each in one thread."""

    def __init__(self, memory: RingMemory) -> None:
        self._ring = _SampleRing(memory)
        self._cursor = 0
        self._serial = 0

    def read(self) -> LiveSamples | None:
        """Return new samples; None when there are none."""
        head = self._ring.head
        serial, base, rate, written = int(head[_SERIAL]), int(head[_BASE]), int(head[_RATE_MHZ]), int(head[_WRITTEN])
        if serial % 2 or serial == 0:
            return None
        if serial != self._serial:
            self._serial, self._cursor = serial, base
        oldest = written - self._ring.samples + min(_RING_MARGIN, self._ring.samples // 4)
        start = max(self._cursor, oldest, base)
        if written <= start:
            return None
        ring, places = self._ring, np.arange(start, written) % self._ring.samples
        force, position, phase = ring.force[places], ring.position[places], ring.phase[places]
        if int(head[_SERIAL]) != serial:
            return None
        # Samples overwritten while they were copied are dropped.
        torn = max(0, int(head[_WRITTEN]) - self._ring.samples - start)
        if torn >= written - start:
            return None
        missed = start + torn - self._cursor
        self._cursor = written
        return LiveSamples(
            serial, rate / 1000, start + torn - base, missed, force[torn:], position[torn:], phase[torn:]
        )
