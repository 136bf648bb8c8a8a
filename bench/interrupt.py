"""Ctrl-C at any moment, once and in storms: how many programs hang, and what they leave.

Run `python bench/interrupt.py [NUMBER] [--load 2] [--seed 1]`. Real `dragrig` processes run, jog, home, calibrate and
watch, on the simulated rig and on doubles, some of them at a prompt that nobody answers. At a random moment, from their
start to beyond their end, SIGINT comes once, twice, again every half second, or every 30 ms as from a key that is held,
and in one of six cases SIGTERM once. A process that has not ended 10 s after the first signal is late, as on a busy
machine; one that has not after 90 s hangs, and says where.

Printed are, for each case, how many processes there were, how many hung, printed a traceback, ended by an exit code
that is none of the program's, left a process, a lock or a recording behind, and whether the campaign could be resumed.
A signal in the first moments, before the program's own code is loaded, ends Python itself, which may print a traceback:
these are counted apart.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import psutil

from dragrig.config.errors import DragrigError
from dragrig.session_state import session_lock
from dragrig.setup import create_lab

LATE_S, HANG_S = 10.0, 90.0
HELD_KEY_S, AGAIN_S, TWICE_S = 0.03, 0.5, 0.08
COMPILED = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
COMPILED["PYTHONPYCACHEPREFIX"] = str(Path(tempfile.gettempdir()) / "dragrig-bytecode")
"""Where bytecode must not be written beside its source, each process would compile all that it imports."""
EXIT_CODES = {0, 2, 3, 4, 5}
"""Exit codes of the program, as `dragrig run --help` has them."""
START_S = 3.0
ORPHANS_S = 0.5
"""What a process had started may outlive it by as long."""
LOADED = ("in run_command_line", "dragrig: ")
"""What shows that the program itself was running."""
SLOWLY = ("--set", "wait_s=0", "--set", "rest_s=0.2", "--set", "speed_mm_s=4", "--set", "travel_mm=12")
DOUBLE = ("--backend", "hardware", "--double")
SCENES: dict[str, tuple[Sequence[str], str, float]] = {
    "run": (("run", "drag", "--yes", "--pace", "real", *SLOWLY, "--out", "{out}", "--json"), "", 6.0),
    "run, at a prompt": (("run", "drag", "--out", "{out}", "--json"), "", 4.0),
    "run on doubles": (("run", "drag", *DOUBLE, *SLOWLY, "--out", "{out}", "--json"), "d\n" * 9, 12.0),
    "run on doubles, at a prompt": (("run", "drag", *DOUBLE, *SLOWLY, "--out", "{out}"), "", 5.0),
    "jog": (("jog", "30", "--speed", "10", "--yes", "--pace", "real"), "", 5.0),
    "jog on doubles": (("jog", "20", "--speed", "10", *DOUBLE), "d\n" * 9, 9.0),
    "home": (("home", "--yes", "--pace", "real"), "", 4.0),
    "calibrate, at a prompt": (("calibrate", "force", "--weights", "0,20,50", *DOUBLE), "d\n" * 2, 7.0),
    "watch": (("watch", "{watched}"), "", 4.0),
}
"""Command, what is typed, and for how long it takes, about."""
WAYS = ("once", "twice", "again", "held", "held", "SIGTERM")


@dataclass(frozen=True, slots=True)
class Ended:
    """How a process ended."""

    scene: str
    way: str
    moment_s: float
    code: int
    errors: str
    ended_after_s: float
    left: str
    resumed: bool

    @property
    def hung(self) -> bool:
        """Whether it did not end by itself."""
        return self.ended_after_s >= HANG_S

    @property
    def early(self) -> bool:
        """Whether Python was still loading the program."""
        loaded = any(place in self.errors for place in LOADED)
        killed = self.code in {-signal.SIGINT, -signal.SIGTERM} and self.moment_s < START_S
        return not loaded and ("Traceback" in self.errors or "runpy" in self.errors or killed)

    @property
    def traced(self) -> bool:
        """Whether it printed a traceback of its own."""
        return not self.early and ("Traceback" in self.errors or "Exception ignored" in self.errors)

    @property
    def odd(self) -> bool:
        """Whether it ended by another exit code than the program's."""
        # Ctrl-C while Python loads a module by way of a string: it ends by the signal, the sentence being said.
        by_python = self.code == -signal.SIGINT and "dragrig: aborted" in self.errors
        return self.code not in EXIT_CODES and not (self.early or self.hung or by_python)


def sent(process: "subprocess.Popen[bytes]", way: str) -> float:
    """Send signals until the process ends, `HANG_S` at most; return after how long it did."""
    number = signal.SIGTERM if way == "SIGTERM" else signal.SIGINT
    pause_s = {"held": HELD_KEY_S, "again": AGAIN_S, "twice": TWICE_S}.get(way, HANG_S)
    times = {"once": 1, "SIGTERM": 1, "twice": 2}.get(way, 10**6)
    began_s = time.monotonic()
    until_s = began_s + HANG_S
    while process.poll() is None and time.monotonic() < until_s:
        if times > 0:
            process.send_signal(number)
            times -= 1
        try:
            process.wait(min(pause_s if times else HANG_S, max(until_s - time.monotonic(), 0.01)))
        except subprocess.TimeoutExpired:
            continue
    return time.monotonic() - began_s


def left_behind(process: "subprocess.Popen[bytes]", out: Path) -> str:
    """Say what a process left: processes of its session, the campaign's lock, recordings."""
    left = []
    time.sleep(ORPHANS_S)
    for other in psutil.process_iter():
        try:
            of_it = os.getsid(other.pid) == process.pid and other.pid != process.pid
            if of_it and other.status() != psutil.STATUS_ZOMBIE:
                left.append(f"process {other.name()}")
                other.kill()
        except (OSError, psutil.Error):
            continue
    if out.is_dir():
        try:
            with session_lock(out):
                pass
        except DragrigError:
            left.append("lock")
        left.extend(path.name for path in out.iterdir() if "recording" in path.name or path.name.endswith(".part"))
    return ", ".join(left)


@dataclass(frozen=True, slots=True)
class Case:
    """What is started, and how and when it is interrupted."""

    number: int
    scene: str
    way: str
    moment_s: float
    resumes: bool


def cases(number: int, only: str, seed: int) -> Iterator[Case]:
    """Draw cases, each scene in turn."""
    draw, scenes = random.Random(seed), [name for name in SCENES if only in name]
    for index in range(number):
        scene, way = scenes[index % len(scenes)], draw.choice(WAYS)
        resumes = scene.startswith("run") and "doubles" not in scene and draw.random() < 0.25
        yield Case(index, scene, way, draw.uniform(0.0, SCENES[scene][2]), resumes)


def interrupted(case: Case, lab: Path, watched: Path) -> Ended:
    """Start a program, interrupt it, and see what became of it."""
    words, typed, _ = SCENES[case.scene]
    out = lab / f"campaign-{case.number}"
    command = [word.format(out=out.name, watched=watched) for word in words]
    with tempfile.TemporaryFile() as printed, tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, "-X", "faulthandler", "-m", "dragrig", *command],
            cwd=lab,
            env=COMPILED,
            stdin=subprocess.PIPE,
            stdout=printed,
            stderr=errors,
            start_new_session=True,
        )
        assert process.stdin is not None
        process.stdin.write(typed.encode())
        process.stdin.flush()
        with suppress(subprocess.TimeoutExpired):
            process.wait(case.moment_s)
        ended_after_s = sent(process, case.way)
        if process.poll() is None:
            process.send_signal(signal.SIGABRT)  # faulthandler prints where every thread is
            process.wait()
        process.stdin.close()
        errors.seek(0)
        said = errors.read().decode(errors="replace")
    left = left_behind(process, out)
    goes_on = not case.resumes or resumed(lab, out)
    return Ended(case.scene, case.way, case.moment_s, process.returncode, said, ended_after_s, left, goes_on)


def resumed(lab: Path, out: Path) -> bool:
    """Whether a campaign that was interrupted goes on to its end; True where there is none."""
    if not list(out.glob("session-*.toml")):
        return True
    words = ["run", "--resume", out.name, "--yes", "--pace", "fast"]
    command = [sys.executable, "-m", "dragrig", *words]
    return not subprocess.run(command, cwd=lab, env=COMPILED, capture_output=True, check=False, timeout=300).returncode


@contextmanager
def load(processes: int) -> Iterator[None]:
    """Keep the machine busy."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()


@contextmanager
def long_campaign(lab: Path) -> Iterator[Path]:
    """Have a campaign under way that is watched."""
    words = ["run", "drag", "--yes", "--pace", "real", "--set", "wait_s=86400", "--out", "watched", "--quiet"]
    process = subprocess.Popen([sys.executable, "-m", "dragrig", *words], cwd=lab, env=COMPILED)
    try:
        yield lab / "watched"
    finally:
        process.kill()
        process.wait()


def print_table(ended: Sequence[Ended]) -> None:
    """Print a row for each case, and what was wrong in full."""
    print("| case | processes | hung | late | traceback | other exit code | left | not resumed | in Python's start |")
    print("|---|---|---|---|---|---|---|---|---|")
    for name in (*SCENES, "all"):
        made = [each for each in ended if name in {each.scene, "all"}]
        codes = ", ".join(
            f"{count} × {code}" for code, count in Counter(each.code for each in made if each.odd).items()
        )
        print(
            f"| {name} | {len(made)} | {sum(each.hung for each in made)} | "
            f"{sum(LATE_S < each.ended_after_s < HANG_S for each in made)} | {sum(each.traced for each in made)} | "
            f"{codes or 0} | {sum(bool(each.left) for each in made)} | {sum(not each.resumed for each in made)} | "
            f"{sum(each.early for each in made)} |"
        )
    for each in ended:
        if each.hung or each.left or each.traced or each.odd or not each.resumed:
            print(f"\n{each.scene}, {each.way}, at {each.moment_s:.2f} s: code {each.code}, left {each.left or '-'}")
            print(each.errors[-3000:])


def main() -> None:
    """Interrupt many programs and print what became of them."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("number", type=int, nargs="?", default=500)
    options.add_argument("--load", type=int, default=2, help="busy processes during the second half")
    options.add_argument("--at-once", type=int, default=4)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--only", default="", metavar="TEXT", help="cases that hold this")
    chosen = options.parse_args()
    drawn = list(cases(chosen.number, chosen.only, chosen.seed))
    ended = list[Ended]()
    with tempfile.TemporaryDirectory() as folder:
        lab = Path(folder) / "lab"
        create_lab(lab)
        half = len(drawn) // 2
        with long_campaign(lab) as watched, ThreadPoolExecutor(chosen.at_once) as pool:
            for processes, some in ((0, drawn[:half]), (chosen.load, drawn[half:])):
                with load(processes):
                    ended += pool.map(partial(interrupted, lab=lab, watched=watched), some)
    print(f"Python {sys.version.split()[0]}, signals at random moments of {len(ended)} processes\n")
    print_table(ended)


if __name__ == "__main__":
    main()
