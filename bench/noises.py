"""What a diagnosis says of campaigns whose sensors are noisy as real ones are, at many sampling rates.

    python bench/noises.py [--rates 50 100 250 500 1000 2000 10000] [--noises white pink bits12 hum jitter]
                           [--effects folds] [--size 1.0] [--seeds 4] [--first 700] [--drags] [--keep FOLDER]

The blind plant makes each campaign without noise at a fine step; sampling, noise and rounding are done here. Without
`--effects` nothing is hidden, and every verdict but `no_gap` is wrong; with them each campaign hides one effect, and
noise must not hide it. `--drags` makes campaigns of drags alone on the simulated rig (`drag-sweep`, and seven speeds
three times), of the nominal gut. A row per campaign, a table of the shares that are right at the end.
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
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from unittest.mock import patch
from zlib import crc32

import numpy as np
from scipy.signal import lfilter

from dragrig.sim_backend.blind import BlindCampaign, Floats, draw_campaign, plant, run_plans, write_campaign
from dragrig.sim_backend.blind.blind_campaign import NoiseLevels

RATES_HZ = (50.0, 100.0, 250.0, 500.0, 1000.0, 2000.0, 10_000.0)
MIN_FINE_HZ = 2000.0
"""The plant's own step is at most this coarse; slower records are samples of it."""
RANGE_MN = 20_000.0
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
class Noise:
    """How a sensor, a converter and a clock disturb the record."""

    pink: float = 0.0
    """1/f noise from 0.02 Hz on, standard deviation over the white noise's."""
    bits: int = 16
    hum_mN: float = 0.0
    jitter_s: float = 0.0
    in_motion: float = 1.0
    """White noise in motion over that at rest."""
    ripple_mN: float = 0.0
    """Torque ripple of the drive's controller: 37 Hz while it moves, with a phase that wanders."""
    impulses_mN: float = 0.0
    """Size of single wrong samples, three in a run."""
    dropouts: int = 0
    """Samples that read 0, in two stretches of a run."""


NOISES = {
    "white": Noise(),
    "pink": Noise(pink=1.0),
    "bits12": Noise(bits=12),
    "bits14": Noise(bits=14),
    "hum": Noise(hum_mN=2.0),
    "jitter": Noise(jitter_s=0.0002),
    "motion": Noise(in_motion=2.0),
    "ripple": Noise(ripple_mN=3.0),
    "impulses": Noise(impulses_mN=150.0),
    "dropouts": Noise(dropouts=8),
}


def pink_noise(samples: int, rate_hz: float, random: np.random.Generator) -> Floats:
    """Return noise whose power falls with frequency, of unit standard deviation in a long record."""
    spectrum = np.fft.rfft(random.standard_normal(2 * samples))
    frequency = np.fft.rfftfreq(2 * samples, 1 / rate_hz)
    gain = 1 / np.sqrt(np.maximum(frequency, 0.02))
    gain[0] = 0.0
    values = np.fft.irfft(spectrum * gain)[:samples]
    weights = np.sum(gain[1:-1] ** 2) * 2 + gain[-1] ** 2
    return np.asarray(values / np.sqrt(weights / (2 * samples)))


def slow_noise(samples: int, rate_hz: float, levels: NoiseLevels, random: np.random.Generator) -> Floats:
    """Return the plant's exponentially correlated noise."""
    decay = float(np.exp(-1 / (rate_hz * levels.correlation_s)))
    innovations = levels.slow_mN * np.sqrt(1 - decay**2) * random.standard_normal(samples)
    innovations[0] = levels.slow_mN * random.standard_normal()
    return np.asarray(lfilter([1.0], [1.0, -decay], innovations))


def disturbed(
    force: Floats, moving: Floats, rate_hz: float, levels: NoiseLevels, noise: Noise, random: np.random.Generator
) -> Floats:
    """Add noise to the force of one run at its samples, and round it."""
    n = force.size
    t = np.arange(n) / rate_hz
    white = levels.white_mN * np.where(moving > 0, noise.in_motion, 1.0) * random.standard_normal(n)
    total = force + white + slow_noise(n, rate_hz, levels, random)
    total += noise.pink * levels.white_mN * pink_noise(n, rate_hz, random)
    total += noise.hum_mN * np.sin(2 * np.pi * (50.0 * t + random.random()))
    wander = np.cumsum(random.standard_normal(n)) / np.sqrt(rate_hz)
    total += noise.ripple_mN * moving * np.sin(2 * np.pi * 37.0 * t + 2.0 * wander)
    if noise.impulses_mN:
        total[random.integers(0, n, 3)] += noise.impulses_mN * random.choice([-1.0, 1.0], 3)
    for start in random.integers(0, n - noise.dropouts, 2 if noise.dropouts else 0):
        total[start : start + noise.dropouts] = 0.0
    step = RANGE_MN / 2**noise.bits
    return np.asarray(np.round(total / step) * step)


def recorded(campaign: BlindCampaign, index: int, rate_hz: float, noise: Noise) -> plant.PlantRecord:
    """Return a run as a noisy rig records it."""
    plan, variation = campaign.runs[index], campaign.variations[index]
    fine_hz = rate_hz * max(1, round(MIN_FINE_HZ / rate_hz))
    with patch.object(plant, "RATE_HZ", fine_hz), patch.object(run_plans, "RATE_HZ", fine_hz):
        fine = plant.noise_free_run(campaign, index)
    random = np.random.default_rng((campaign.seed, index, crc32(b"noises")))
    samples = round(fine.time.size * rate_hz / fine_hz)
    stated = np.arange(samples) / rate_hz
    sampled = stated + noise.jitter_s * random.standard_normal(samples)
    force, position = (np.interp(sampled, fine.time, values) for values in (fine.force, fine.position))
    phase = run_plans.sample_phases(plan, stated)
    moving = np.asarray((phase > 0) & (phase < 4), dtype=np.float64)
    force = disturbed(force + variation.zero_mN, moving, rate_hz, campaign.noise, noise, random)
    position = position + plant.VIBRATION_MM * random.standard_normal(samples)
    count = plant.ENCODER_COUNT_MM
    command = np.interp(stated, fine.time, fine.command)
    return plant.PlantRecord(plan, stated, force, np.round(position / count) * count, command, phase)


@dataclass(frozen=True, slots=True)
class Task:
    """One campaign to make and to diagnose."""

    seed: int
    rate_hz: float
    noise: str
    effect: str = ""
    size: float = 1.0
    plan: str = ""
    """Of a campaign on the simulated rig: `drag-sweep`, or `speeds`."""

    @property
    def expected(self) -> str:
        """The right verdict."""
        return self.effect or "no_gap"

    def write(self, folder: Path) -> None:
        """Make the run files."""
        if self.plan:
            plan = self.plan
            if plan == "speeds":
                plan = str(folder.with_suffix(".toml"))
                Path(plan).write_text(SPEED_SWEEP, encoding="utf-8")
            settings = [f"rig.sampling.rate_hz={self.rate_hz:g}", f"rig.simulated.seed={self.seed}"]
            more = [word for setting in settings for word in ("--set", setting)]
            command = [sys.executable, "-m", "dragrig", "run", plan, "--yes", "--quiet", "--out", str(folder), *more]
            subprocess.run(command, check=True, capture_output=True)
            return
        effects = [self.effect] if self.effect else []
        with ExitStack() as stack:
            for module in (plant, run_plans):
                stack.enter_context(patch.object(module, "RATE_HZ", self.rate_hz))
            campaign = draw_campaign(self.seed, effects=effects, size=self.size)
            make = partial(recorded, rate_hz=self.rate_hz, noise=NOISES[self.noise])
            stack.enter_context(patch.object(plant, "recorded_run", make))
            write_campaign(campaign, folder)


def diagnosed(task: Task, keep: Path | None) -> tuple[Task, str, bool, str]:
    """Make and diagnose a campaign; return the verdict, whether it is right, and a line of numbers."""
    from dragrig.analysis.gap.diagnose import diagnose
    from dragrig.analysis.gap.run_data import choose_runs
    from dragrig.analysis.models.capsule_model import MODEL

    name = f"{task.plan or task.effect or 'clean'}-{task.noise}-{task.rate_hz:g}-{task.seed}"
    with tempfile.TemporaryDirectory() as place:
        folder = (keep or Path(place)) / name
        if not folder.exists():
            folder.parent.mkdir(parents=True, exist_ok=True)
            task.write(folder)
        began = time.perf_counter()
        found = diagnose(choose_runs(folder), MODEL)
        spent = time.perf_counter() - began
    verdict = "+".join(found.effects) or found.verdict.value
    inputs, gap = found.decision_inputs, found.shrink
    numbers = f"{found.ranking[0].probability:.2f}  {spent:5.1f} s"
    if inputs is not None:
        numbers += f"  chi2/N {inputs.chi2 / inputs.block_count:.3f}{'  position' if inputs.has_position_error else ''}"
        numbers += f"  lines {inputs.mains_llr:.0f} {inputs.line_llr:.0f}"
        best = [f"{'+'.join(item.effects)} {item.llr:.1f}" for item in inputs.hypotheses[:2]]
        laws = [f"{law.name} {0.5 * (inputs.chi2 - law.chi2):.1f}" for law in inputs.laws[:1]]
        numbers += f"  {', '.join(best + laws)}"
    if gap is not None:
        numbers += f"  gap {gap.gap_before_mN:.2f} over {gap.noise_floor_mN:.2f} mN"
    return task, verdict, verdict == task.expected, numbers


def report(tasks: Sequence[Task], workers: int, keep: Path | None) -> None:
    """Print a row for each campaign, and shares."""
    right: dict[tuple[str, str, str], list[bool]] = defaultdict(list)
    with ProcessPoolExecutor(workers) as pool:
        for task, verdict, is_right, numbers in pool.map(partial(diagnosed, keep=keep), tasks):
            kind = task.plan or task.effect or "clean"
            mark = " " if is_right else "*"
            print(f"{mark} {kind:20} {task.noise:9} {task.rate_hz:6g} Hz  seed {task.seed}  {verdict:28} {numbers}")
            sys.stdout.flush()
            right[kind, task.noise, f"{task.rate_hz:g} Hz"].append(is_right)
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
    parser.add_argument("--rates", type=float, nargs="*", default=list(RATES_HZ))
    parser.add_argument("--noises", nargs="*", default=list(NOISES), choices=list(NOISES))
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
        tasks = [Task(seed, 500.0, "white", plan=plan) for plan in ("drag-sweep", "speeds") for seed in seeds]
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
