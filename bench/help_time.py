"""How long `dragrig --help` takes as a whole process, beside the bare interpreter and a bare click."""

import statistics
import subprocess
import sys
import time

REPEATS = 15
LINES = {
    "python -c pass": ["-c", "pass"],
    "python -c 'import click'": ["-c", "import click"],
    "dragrig --help": ["-m", "dragrig", "--help"],
    "dragrig run --help": ["-m", "dragrig", "run", "--help"],
}


def seconds(arguments: list[str]) -> float:
    """Time one process."""
    begun = time.perf_counter()
    subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - begun


def main() -> None:
    """Print medians and ratios."""
    taken: dict[str, list[float]] = {name: [] for name in LINES}
    for _ in range(REPEATS):
        for name, arguments in LINES.items():
            taken[name].append(seconds(arguments))
    bare = statistics.median(taken["python -c pass"])
    print(f"{'':26} {'median':>8} {'worst':>8}  over the bare interpreter")
    for name, times in taken.items():
        middle = statistics.median(times)
        print(f"{name:26} {middle:6.3f} s {max(times):6.3f} s  {middle / bare:.1f} ×")
    print("allowed for --help: 0.3 s")


if __name__ == "__main__":
    main()
