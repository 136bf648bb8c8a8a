"""What a diagnosis says of campaigns whose records are noisy as those of rigs are, at many sampling rates.

    python bench/noises.py [--rates 50 100 250 500] [--noises white "1/f noise" jitter] [--effects folds] [--size 1.0]
                           [--seeds 4] [--first 700] [--drags] [--keep FOLDER] [--workers 1]

The blind plant makes each campaign under the conditions of these names. Without `--effects` nothing is hidden, and
every verdict but `no_gap` is wrong; with them each campaign hides one effect, and noise must not hide it. Hum that
matters is an effect of the catalogue and may be named. `--drags` makes campaigns of drags alone on the simulated rig,
of the nominal gut: `drag-sweep`, and seven speeds three times. A row per campaign, then the shares that are right.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from dragrig.sim_backend.blind import draw_campaign, write_campaign

RATES_HZ = (50, 100, 250, 500, 1000, 2000, 10_000)
OWN_RATE_HZ = 500
"""The plant's rate without any condition."""
NOISES = ("white", "1/f noise", "hum", "12 bits", "14 bits", "jitter", "impulses", "dropouts")
"""The first is the plant's own: white, with slow noise of a third of it."""
SPEED_SWEEP = """name = "speeds"
seed = 1

[[steps]]
kind = "drag"
speed_mm_s = [0.5, 2.0, 5.0, 10.0, 20.0, 40.0, 60.0]
travel_mm = 40.0
repeats = 3
order = "random"
"""


@dataclass(frozen=True, slots=True)
class Task:
    """One campaign to make and to diagnose."""

    seed: int
    rate_hz: int
    noise: str
    effect: str = ""
    size: float = 1.0
    plan: str = ""
    """Of a campaign on the simulated rig: `drag-sweep`, or `speeds`."""

    @property
    def name(self) -> str:
        """Name of its folder."""
        noise = self.noise.replace("/", "").replace(" ", "_")
        size = "" if self.size == 1.0 else f"-{self.size:g}"
        return f"{self.plan or self.effect or 'clean'}{size}-{noise}-{self.rate_hz}-{self.seed}"

    @property
    def right(self) -> tuple[str, ...]:
        """The right verdicts."""
        if self.effect:
            return (self.effect, f"{self.effect}+mains_hum") if self.noise == "hum" else (self.effect,)
        return ("no_gap", "mains_hum") if self.noise == "hum" else ("no_gap",)

    def write(self, folder: Path) -> None:
        """Make the run files."""
        folder.parent.mkdir(parents=True, exist_ok=True)
        if not self.plan:
            rate = [] if self.rate_hz == OWN_RATE_HZ else [f"{self.rate_hz} Hz"]
            noise = [] if self.noise == NOISES[0] else [self.noise]
            effects = [self.effect] if self.effect else []
            write_campaign(draw_campaign(self.seed, effects=effects, size=self.size, conditions=rate + noise), folder)
            return
        plan = self.plan
        if plan == "speeds":
            plan = str(folder.with_suffix(".toml"))
            Path(plan).write_text(SPEED_SWEEP, encoding="utf-8")
        settings = [f"rig.sampling.rate_hz={self.rate_hz}", f"rig.simulated.seed={self.seed}"]
        more = [word for setting in settings for word in ("--set", setting)]
        command = [sys.executable, "-m", "dragrig", "run", plan, "--yes", "--quiet", "--out", str(folder), *more]
        subprocess.run(command, check=True, capture_output=True)


def diagnosed(task: Task, keep: Path | None) -> tuple[str, str]:
    """Make and diagnose a campaign; return the verdict, and numbers that tell why."""
    from dragrig.analysis.gap.diagnose import diagnose
    from dragrig.analysis.gap.run_data import choose_runs
    from dragrig.analysis.models.capsule_model import MODEL

    with tempfile.TemporaryDirectory() as place:
        folder = (keep or Path(place)) / task.name
        if not folder.exists():
            task.write(folder)
        selection = choose_runs(folder)
        began = time.perf_counter()
        found = diagnose(selection, MODEL)
        spent = time.perf_counter() - began
    verdict = "+".join(found.effects) or found.verdict.value
    inputs, gap = found.decision_inputs, found.shrink
    numbers = [f"{found.ranking[0].probability:.2f}  {spent:5.1f} s"]
    if inputs is not None:
        numbers.append(f"chi2/N {inputs.chi2 / inputs.block_count:.3f}")
        numbers += ["position"] if inputs.has_position_error else []
        numbers.append(f"lines {inputs.mains_llr:.0f} {inputs.line_llr:.0f}")
        numbers += [f"{'+'.join(item.effects)} {item.llr:.1f}" for item in inputs.hypotheses[:2]]
        numbers += [f"{law.name} {0.5 * (inputs.chi2 - law.chi2):.1f}" for law in inputs.laws[:1]]
    if gap is not None:
        numbers.append(f"gap {gap.gap_before_mN:.2f} over {gap.noise_floor_mN:.2f} mN")
    numbers += [remark for remark in selection.remarks if "impulses" in remark or "dropouts" in remark][:1]
    return verdict, "  ".join(numbers)


def report(tasks: Sequence[Task], workers: int, keep: Path | None) -> None:
    """Print a row for each campaign, and shares."""
    right: dict[tuple[str, str, str], list[bool]] = defaultdict(list)
    with ProcessPoolExecutor(workers) as pool:
        for task, (verdict, numbers) in zip(tasks, pool.map(partial(diagnosed, keep=keep), tasks), strict=True):
            is_right = verdict in task.right
            kind = task.plan or task.effect or "clean"
            mark = " " if is_right else "*"
            print(f"{mark} {kind:20} {task.noise:10} {task.rate_hz:6} Hz  seed {task.seed}  {verdict:28} {numbers}")
            sys.stdout.flush()
            right[kind, task.noise, f"{task.rate_hz} Hz"].append(is_right)
    for title, part in (("kind", 0), ("noise", 1), ("rate", 2)):
        shares: dict[str, list[bool]] = defaultdict(list)
        for key, answers in right.items():
            shares[key[part]] += answers
        print("  ".join([f"{title}:", *(f"{name} {sum(rows)}/{len(rows)}" for name, rows in shares.items())]))
    answers = [answer for rows in right.values() for answer in rows]
    print(f"all: {sum(answers)} of {len(answers)} right")


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rates", type=int, nargs="*", default=list(RATES_HZ), choices=RATES_HZ)
    parser.add_argument("--noises", nargs="*", default=list(NOISES))
    parser.add_argument("--effects", nargs="*", default=[""])
    parser.add_argument("--size", type=float, default=1.0)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first", type=int, default=700)
    parser.add_argument("--drags", action="store_true")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="keep the run files here, and take those that are there")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)
    if options.drags:
        tasks = [Task(seed, OWN_RATE_HZ, NOISES[0], plan=plan) for plan in ("drag-sweep", "speeds") for seed in seeds]
    else:
        tasks = [
            Task(seed, rate, noise, effect, options.size)
            for effect in options.effects
            for noise in options.noises
            for rate in options.rates
            for seed in seeds
        ]
    report(tasks, options.workers, options.keep)


if __name__ == "__main__":
    main()
