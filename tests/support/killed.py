"""Recording processes that are killed, and what is left of their runs.

`python killed.py PATH [JSON]` is the victim: it records at a real-time pace and says on standard output
when it had handed over which sample. `kill_after` kills it from outside; `die_at` has it kill itself in the
middle of a named step.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from dragrig.rig import recover
from dragrig.rig.runfile import finish, finisher, read_run, recorder, schema, writer
from dragrig.rig.runfile.model import RunEnding, RunEvent, RunStatus
from dragrig.rig.runfile.recorder import Recorder
from ending import kill, was_killed
from runfiles import START, arrays, header

BLOCK_S = 0.005
STEPS = {
    "making": (recorder, "write_header"),
    "opening": (h5py.h5f, "open"),
    "appending": (recorder.RecordingFile, "append"),
    "flushing": (recorder.RecordingFile, "flush"),
    "noting": (recorder.RecordingFile, "append_events"),
    "closing": (recorder.RecordingFile, "close"),
    "copying": (finisher, "create_column"),
    "syncing": (writer, "move_into_place"),
    "placed": (finisher, "remove_file"),
}


@dataclass(frozen=True, slots=True)
class Loss:
    """What a kill cost.

    Attributes
    ----------
    offered, kept
        Samples handed over before the kill, and those in the recovered file.
    lost_s
        Wall time from the handing over of the first lost sample to the kill; 0 when none was lost.
    stall_s
        Longest time that the victim itself was kept from its pace by the machine.
    """

    offered: int
    kept: int
    lost_s: float
    stall_s: float


def victim(path: Path, rate_hz: float, seconds: float, die_at: str, times: int) -> None:
    """Record at pace until killed or done."""
    if die_at:
        _die(*STEPS[die_at], times)
    per_block = round(rate_hz * BLOCK_S)
    with Recorder(path, header(rate_hz=rate_hz), reserve_bytes=0) as recorder:
        begun = time.monotonic()
        for number in range(round(seconds / BLOCK_S)):
            time.sleep(max(0.0, begun + (number + 1) * BLOCK_S - time.monotonic()))
            recorder.offer(number * per_block, arrays(number * per_block, per_block, rate_hz))
            if number % 10 == 0:
                recorder.event(RunEvent(number * BLOCK_S, "tick", str(number)))
            _say((number + 1) * per_block)
        left = recorder.close(RunEnding(RunStatus.COMPLETE, "as planned", START))
    finish(left)


def _say(samples: int) -> None:
    os.write(1, f"{samples} {time.monotonic()!r}\n".encode())


def _die(owner: object, name: str, times: int) -> None:
    """Have the process kill itself when a step has been taken `times` times."""
    step: Callable[..., object] = getattr(owner, name)
    taken = 0

    def deadly(*text: object, **named: object) -> object:
        nonlocal taken
        taken += 1
        result = step(*text, **named)
        if taken >= times:
            kill()
        return result

    setattr(owner, name, deadly)


def run_victim(
    path: Path,
    *,
    kill_after_s: float | None = None,
    in_a_flush: bool = False,
    rate_hz: float = 1000.0,
    seconds: float = 5.0,
    die_at: str = "",
    times: int = 1,
) -> tuple[list[tuple[int, float]], float]:
    """Run a victim to its death; return what it said and when it was killed.

    With `in_a_flush` the kill waits for the next time that the recording changes.
    """
    dumps = json.dumps([rate_hz, seconds, die_at, times])
    with subprocess.Popen([sys.executable, __file__, str(path), dumps], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        first = process.stdout.readline()
        if kill_after_s is not None:
            time.sleep(kill_after_s)
            file = schema.recording_path(path)
            before = file.stat().st_mtime_ns
            while in_a_flush and file.stat().st_mtime_ns == before and process.poll() is None:
                pass
            killed = time.monotonic()
            process.kill()
        rest = process.stdout.read()
        if kill_after_s is None:
            killed = time.monotonic()
    assert was_killed(process.returncode), process.returncode
    lines = [line.split() for line in (first + rest).decode().splitlines()]
    return [(int(samples), float(moment)) for samples, moment in lines], killed


def loss_of(path: Path, message: list[tuple[int, float]], killed: float, rate_hz: float = 1000.0) -> Loss:
    """Recover a victim's run, make sure of every sample in it, and say what is missing."""
    assert [result for result in recover(path.parent) if result.path is None] == []
    run = read_run(path)
    remaining = run.info.samples
    trace = {"time": run.trace.time, "command": run.trace.command, "phase": run.trace.phase, **run.trace.channels}
    for name, values in arrays(0, remaining, rate_hz).items():
        np.testing.assert_array_equal(trace[name], values, err_msg=name)
    lost = next((moment for samples, moment in message if samples > remaining), killed)
    stall = float(np.diff([moment for _, moment in message], prepend=message[0][1], append=killed).max())
    return Loss(message[-1][0], remaining, killed - lost, stall)


if __name__ == "__main__":
    victim(Path(sys.argv[1]), *json.loads(sys.argv[2]))
