"""How true the time left is that a long command shows: `python bench/progress.py [WORK …]`, in a terminal of its own.

Each command is run in a pseudo-terminal, and each time left that it shows is compared with what it then took. Printed
is the worst factor between the two after the first tenth of the time, until the last second. In the last seconds a
command says what the time left is less than: that counts where it is more.
"""

import os
import pty
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

DRAGRIG = [sys.executable, "-m", "dragrig"]
WORKS = {
    "table": ["table", "paper"],
    "report": ["report", "paper", "--overwrite"],
    "show": ["show", "paper", "--out", "pictures", "--overwrite"],
    "filter": ["filter", "paper"],
    "export": ["export", "paper", "--out", "exported", "--overwrite"],
    "identify": ["identify", "paper", "--out", "identified", "--overwrite"],
    "diagnose": ["gap", "diagnose", "diagnose", "--report", "gap.html", "--figures", "gap", "--overwrite"],
    "next": ["gap", "next", "diagnose"],
    "isolability": ["gap", "isolability", "paper", "--report", "apart.html", "--overwrite"],
    "compare": ["compare", "paper", "--model", "paper", "--out", "compared", "--overwrite"],
    "blind": ["gap", "blind", "--cases", "4"],
    "paper": ["paper", "--out", "again", "--overwrite"],
}
"""Commands in a folder with two campaigns, of the plans `paper` and `diagnose`."""
LEFT = re.compile(rb"(less than )?(?:(\d+) h )?(?:(\d+) min )?(?:(\d+(?:\.\d+)?) s )?left")
FIRST_SHARE, LAST_S = 0.1, 1.0


@dataclass(frozen=True, slots=True)
class Shown:
    """A time left [s], when it was shown [s], and how much was left then [s]."""

    at_s: float
    said_s: float
    true_s: float
    bound: bool
    """Whether it was said as what the time left is less than."""

    @property
    def factor(self) -> float:
        """How many times too long or too short it was; a bound that holds is neither."""
        return max(1.0 if self.bound else self.said_s / self.true_s, self.true_s / self.said_s)


def watch(arguments: list[str], folder: Path) -> tuple[float, list[Shown]]:
    """Run a command; return how long it took [s], and what it showed after the first tenth of that."""
    terminal, far_end = pty.openpty()
    os.set_blocking(terminal, True)
    begun = time.monotonic()
    process = subprocess.Popen(
        [*DRAGRIG, *arguments],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=far_end,
        env={**os.environ, "COLUMNS": "160", "TERM": "xterm"},
    )
    os.close(far_end)
    said: list[tuple[float, float, bool]] = []
    while chunk := _read(terminal):
        now = time.monotonic() - begun
        for bound, hours, minutes, seconds in LEFT.findall(chunk)[-1:]:
            said_s = 3600 * float(hours or 0) + 60 * float(minutes or 0) + float(seconds or 0)
            said.append((now, said_s, bool(bound)))
    os.close(terminal)
    if process.wait() != 0:
        raise SystemExit(f"{' '.join(arguments)}: ended with {process.returncode}")
    took = time.monotonic() - begun
    judged = [
        Shown(at, max(left, LAST_S / 2), took - at, bound)
        for at, left, bound in said
        if at >= FIRST_SHARE * took and took - at >= LAST_S
    ]
    return took, judged


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 1 << 16)
    except OSError:  # the far end is closed
        return b""


def main() -> None:
    """Print a line for each command."""
    names = sys.argv[1:] or list(WORKS)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for plan in ("paper", "diagnose"):
            subprocess.run([*DRAGRIG, "run", plan, "--yes", "--quiet", "--out", plan], cwd=folder, check=True)
        print(f"{'':12} {'took':>7} {'first':>6} {'worst':>6}")
        for name in names:
            took, shown = watch(WORKS[name], folder)
            if not shown:
                print(f"{name:12} {took:5.1f} s   no time left was shown")
                continue
            worst = max(shown, key=lambda entry: entry.factor)
            print(
                f"{name:12} {took:5.1f} s {shown[0].at_s / took:6.0%} {worst.factor:6.2f}  "
                f"at {worst.at_s:.1f} s: {worst.said_s:.1f} s said, {worst.true_s:.1f} s left"
            )


if __name__ == "__main__":
    main()
