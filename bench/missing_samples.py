"""Samples that do not come: for how long, and over how many millimetres, the stage goes on without one.

Run `python bench/missing_samples.py [--rounds 2] [--mode velocity] [--relay]`. A motion at 20 mm/s is made by the
real rig's code in a process of its own, on doubles in another one, while one of three is held up in a pattern of pieces
of 20 ms to 1 s: the card, which samples and delivers nothing; the program, stopped from outside; or its interpreter,
which a thread holds for itself. Missing is the time since the newest sample that the guard has seen, while the stage
moves.

The bar: where the card delivers nothing, the stage stands `guard.stale_data_s` and 100 ms after the newest sample. A
program that does not run can stop nothing: then the drive does so after `hardware.drive.silence_s`, or the heartbeat
relay after three beats, and the bar is the later of both times and 100 ms. In velocity mode what is written ahead comes
to the bar. A pattern in which less than `stale_data_s`
is missing at any time needs no stop.
"""

import argparse
import ctypes
import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from reaction import ACQUISITION, SPEED_MM_S

from dragrig.config.errors import DeviceError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.config.settings import read_settings_file, to_toml
from dragrig.rig.devices import BackendRequest
from dragrig.rig.engine import Engine
from dragrig.rig.guard import Guard
from dragrig.rig.hardware.backend import HardwareBackend, open_backend
from dragrig.rig.reading import Reading
from remote_doubles import RemoteDoubles

BRAKING_S = 0.1
"""What the bar leaves for noticing, the stop's way to the drive, and braking."""
RELAY_BEATS = 3
ATTEMPTS = 5
AHEAD = 6
"""Updates that are written ahead in velocity mode: a stop takes as long to reach the output, beside the 100 ms."""
STANDING_MM_S = 0.05
LOOK_S = 0.001
Pattern = Sequence[tuple[float, float]]
"""Seconds held and not held, alternately."""


def patterns() -> dict[str, Pattern]:
    """Return all patterns by their names, which give milliseconds."""
    random = np.random.default_rng(1)
    single = {f"{held}": [(held / 1000, 3.0)] for held in (20, 50, 100, 150, 180, 250, 300, 500, 700, 1000)}
    pairs = ((20, 20), (50, 10), (100, 20), (130, 20), (180, 20), (190, 100), (250, 20), (450, 20), (900, 100))
    bursts = {f"{held}, {free} free": [(held / 1000, free / 1000)] * 40 for held, free in pairs}
    drawn = {
        f"at random {low} to {high}": [tuple(random.uniform(low, high, 2) / 1000) for _ in range(40)]
        for low, high in ((20, 150), (20, 300), (20, 1000))
    }
    return single | bursts | drawn


def work(rig_file: Path) -> None:
    """Make a motion for each line on standard input, and print when which sample was seen."""
    rig = read_settings_file(RigSettings, rig_file)
    with closing(open_backend(BackendRequest(rig, FrictionModelSettings()))) as backend:
        requests, holding = threading.Event(), ctypes.PyDLL(None)

        def listen() -> None:
            for line in sys.stdin:
                word, _, value = line.partition(" ")
                if word == "hold":
                    holding.usleep(int(value))  # called without letting go of the interpreter
                else:
                    requests.set()

        threading.Thread(target=listen, daemon=True).start()
        while True:
            guard, seen = Guard(rig.guard, 1e-3 * rig.encoder.resolution_um), list[tuple[float, int]]()
            make_ready(backend, guard)
            print(json.dumps("ready"), flush=True)
            requests.wait()
            requests.clear()

            def note(reading: Reading, seen: list[tuple[float, int]] = seen) -> None:
                seen.append((time.monotonic(), reading.end_index))

            outcome = Engine(backend, rig, guard).acquire(ACQUISITION, view=note)
            print(json.dumps([outcome.status.value, outcome.reason, seen]), flush=True)


def make_ready(backend: HardwareBackend, guard: Guard) -> None:
    """Home, again where doubles in a process of their own kept the velocity output waiting for too long."""
    for attempt in itertools.count(1):
        backend.stage.disable()
        guard.reset(backend.stage.state())
        try:
            backend.stage.enable()
            backend.stage.home()
        except DeviceError:
            if attempt == ATTEMPTS:
                raise
        else:
            return


@dataclass(frozen=True, slots=True)
class Held:
    """What a pattern did: the longest time without a sample, the way meanwhile, and how the run ended."""

    missing_s: float
    blind_mm: float
    stopped: bool
    reason: str


class Observer:
    """Holds something up in a pattern while a motion is made, and looks at the stage."""

    def __init__(self, doubles: RemoteDoubles, program: "subprocess.Popen[str]") -> None:
        self._doubles, self._program = doubles, program

    def answer(self) -> object:
        """Return what the program prints next."""
        assert self._program.stdout is not None
        line = self._program.stdout.readline()
        if not line:
            raise SystemExit("the program under test has ended; its own message says why")
        return json.loads(line)

    def say(self, line: str) -> None:
        """Tell the program something."""
        assert self._program.stdin is not None
        self._program.stdin.write(f"{line}\n")
        self._program.stdin.flush()

    def hold(self, what: str, held_s: float, *, on: bool) -> None:
        """Begin or end to hold something up."""
        if what == "card":
            self._doubles.control.set_faults(card_stalled=on)
        elif what == "program":
            os.kill(self._program.pid, signal.SIGSTOP if on else signal.SIGCONT)
        elif on:
            self.say(f"hold {round(1e6 * held_s)}")

    def observe(self, what: str, pattern: Pattern) -> Held:
        """Make a motion with a pattern in the middle of it; again where it ended before its first sample."""
        for _ in range(ATTEMPTS):
            if (held := self._observe(what, pattern)) is not None:
                return held
        raise SystemExit(f"no motion came to its first sample in {ATTEMPTS} attempts")

    def _observe(self, what: str, pattern: Pattern) -> Held | None:
        assert self.answer() == "ready"
        self.say("go")
        steps = [(held_s, on) for pair in pattern for on, held_s in zip((True, False), pair, strict=True)]
        begins = [0.0, *accumulate(held_s for held_s, _ in steps)]
        looks, began_s, done = list[tuple[float, float, float]](), float("inf"), 0
        while True:
            before_s, stage = time.monotonic(), self._doubles.control.stage()
            looks.append(((before_s + time.monotonic()) / 2, stage.position_mm, stage.speed_mm_s))
            if began_s == float("inf"):
                began_s = time.monotonic() + 0.1 if stage.speed_mm_s > SPEED_MM_S - 0.1 else began_s
            elif not stage.moving and abs(stage.speed_mm_s) < STANDING_MM_S:
                break
            while done < len(steps) and time.monotonic() >= began_s + begins[done]:
                self.hold(what, *steps[done][:1], on=steps[done][1])
                done += 1
            time.sleep(LOOK_S)
        self.hold(what, 0.0, on=False)
        answer = self.answer()
        assert isinstance(answer, list)
        _, reason, seen = answer
        return measured(looks, seen, reason) if seen else None


def measured(looks: list[tuple[float, float, float]], seen: list[tuple[float, int]], reason: str) -> Held:
    """Return what was missing in a motion that was looked at."""
    time_s, position_mm, speed_mm_s = np.array(looks).T
    arrived_s, end = np.array(seen, np.float64).T
    # The sample that was seen soonest says when the first one was taken, to within the few ms that it took.
    taken_s = end / RATE_HZ + float(np.min(arrived_s - end / RATE_HZ))
    newest_s = np.concatenate(([arrived_s[0]], taken_s))[np.searchsorted(arrived_s, time_s, side="right")]
    moving = (np.abs(speed_mm_s) > STANDING_MM_S) & (time_s > arrived_s[0])
    missing_s = np.where(moving, time_s - newest_s, 0.0)
    travel_mm = np.where(moving, np.abs(position_mm - np.interp(newest_s, time_s, position_mm)), 0.0)
    stopped = bool(position_mm[-1] < ACQUISITION.profile.position(1e9) + START_MM - 0.1)
    return Held(float(missing_s.max()), float(travel_mm.max()), stopped, reason)


START_MM = 0.0
RATE_HZ = 1000.0


def rig_settings(mode: str, silence_s: float, *, relay: bool) -> RigSettings:
    """Return the rig as it is by default, but for what is asked."""
    lines = {"heartbeat": "port1/line4"} if relay or mode == "velocity" else {}
    # On a busy computer the output runs dry with less.
    velocity = {"ahead": AHEAD, "gain_per_s": 2.0}
    drive = {"mode": mode, "silence_s": silence_s, "homing_speed_mm_s": 50.0, "velocity": velocity}
    return RigSettings.model_validate(
        {
            "sampling": {"rate_hz": RATE_HZ},
            "stage": {"start_mm": 1.0},
            "hardware": {"drive": drive, "card": {"lines": lines, "buffer_s": 20.0}},
        }
    )


def bar_s(what: str, rig: RigSettings) -> float:
    """Return how long samples may be missing while the stage moves."""
    lines, drive = rig.hardware.card.lines, rig.hardware.drive
    alone_s = RELAY_BEATS * lines.heartbeat_s if lines.heartbeat else drive.silence_s
    written_s = AHEAD * drive.velocity.update_s if drive.mode == "velocity" else 0.0
    return max(rig.guard.stale_data_s + written_s, alone_s if what != "card" else 0.0) + BRAKING_S


def print_table(observe: Callable[[str, Pattern], Held], rig: RigSettings, rounds: int, only: str) -> int:
    """Print a row for each pattern and what is held up; return how many do not hold the bar."""
    failed = 0
    print("| held up | ms | missing at worst | way meanwhile | bar | stopped | reason |")
    print("|---|---|---|---|---|---|---|")
    for what in ("card", "program", "interpreter"):
        limit_s = bar_s(what, rig)
        for name, pattern in patterns().items():
            if only not in f"{what}, {name}":
                continue
            made = [observe(what, pattern) for _ in range(rounds)]
            worst_s = max(each.missing_s for each in made)
            needless = sum(each.stopped and each.missing_s < rig.guard.stale_data_s - 0.06 for each in made)
            missed = sum(each.missing_s > limit_s for each in made)
            failed += missed
            reasons = ", ".join(sorted(Counter(each.reason.partition(":")[0] for each in made if each.reason)))
            note = f" **{missed} too late**" * bool(missed) + f" **{needless} needless**" * bool(needless)
            print(
                f"| {what} | {name} | {1000 * worst_s:.0f} ms | {max(each.blind_mm for each in made):.1f} mm | "
                f"{1000 * limit_s:.0f} ms | {sum(each.stopped for each in made)} of {rounds}{note} | {reasons} |",
                flush=True,
            )
    return failed


def main() -> None:
    """Print the table, and how many motions went on for too long."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--rounds", type=int, default=2)
    options.add_argument("--mode", choices=("position", "velocity"), default="position")
    options.add_argument("--silence", type=float, default=0.5, help="hardware.drive.silence_s")
    options.add_argument("--relay", action="store_true", help="with a heartbeat relay, which velocity mode always has")
    options.add_argument("--only", default="", metavar="TEXT", help="rows that hold this, such as 'card, at random'")
    options.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    chosen = options.parse_args()
    if chosen.work is not None:
        work(chosen.work)
        return
    given = rig_settings(chosen.mode, chosen.silence, relay=chosen.relay)
    with RemoteDoubles(given) as doubles, tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rig.toml"
        file.write_text(to_toml(doubles.rig()), "utf-8")
        command = [sys.executable, __file__, "--work", str(file)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as program:
            try:
                failed = print_table(Observer(doubles, program).observe, given, chosen.rounds, chosen.only)
            finally:
                program.kill()
    print(f"{failed} motions went on without samples for longer than the bar ({chosen.mode} mode)")


if __name__ == "__main__":
    main()
