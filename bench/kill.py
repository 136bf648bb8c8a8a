"""A hundred recording processes killed with SIGKILL: how many runs survive, and what is lost at most.

Run `python bench/kill.py [KILLS]`. A third is killed at random moments, a third while the recording is being
written, a third in the middle of a step of recording or finishing. Every sample of every recovered run is
compared with what was handed over. Loss is wall time from the handing over of the first lost sample to the kill.
"""

import random
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from dragrig.rig import recover
from dragrig.rig.runfile import verify
from killed import STEPS, Loss, loss_of, run_victim

BOUND_S = 0.25
RATES_HZ = (1000.0, 50_000.0, 250_000.0)
BEFORE_THE_FIRST_SAMPLE = {"making", "opening"}


def kill(folder: Path, way: str, draw: random.Random) -> Loss | None:
    """Kill one process; return its loss, or None when it had handed over nothing yet."""
    path, rate_hz = folder / "run.h5", draw.choice(RATES_HZ)
    if way in STEPS:
        times = draw.randint(1, 6) if way in {"appending", "flushing", "noting"} else 1
        text, killed = run_victim(path, seconds=1.0, die_at=way, times=times, rate_hz=rate_hz)
    else:
        moment = draw.uniform(0.0, 1.5)
        text, killed = run_victim(path, kill_after_s=moment, in_a_flush=way == "in a flush", rate_hz=rate_hz)
    if not text:
        recover(folder)
        return None
    loss = loss_of(path, text, killed, rate_hz)
    if not verify(path).holds or recover(folder):
        raise SystemExit(f"{path}: does not verify, or recovering again found more")
    return loss


def main() -> None:
    """Kill, recover, count."""
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else 102
    draw = random.Random(1)
    ways: Counter[str] = Counter()
    losses: list[Loss] = []
    steps = list(STEPS)
    for number in range(kills):
        way = ("at random", "in a flush", steps[number // 3 % len(steps)])[number % 3]
        with tempfile.TemporaryDirectory() as folder:
            loss = kill(Path(folder), way, draw)
        ways[way] += 1
        if loss is not None:
            losses.append(loss)
    before = kills - len(losses)
    worst = max(losses, key=lambda loss: loss.lost_s)
    print(f"{kills} processes killed: {', '.join(f'{count} {way}' for way, count in ways.items())}")
    print(f"  {len(losses)} of {kills - before} runs survive with every sample right; {before} had not begun")
    print(f"  worst loss {worst.lost_s:.3f} s (bar: {BOUND_S} s), {worst.offered - worst.kept} samples;"
          f" the machine kept that process waiting for up to {worst.stall_s:.3f} s")  # fmt: skip
    if any(loss.lost_s > BOUND_S for loss in losses):
        raise SystemExit(f"{sum(loss.lost_s > BOUND_S for loss in losses)} runs lost more than the bar")


if __name__ == "__main__":
    main()
