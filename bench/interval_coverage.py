"""How often 95 % intervals hold the truth: `python bench/interval_coverage.py --campaigns 200`.

Each campaign has 31 runs at 500 Hz (4 relaxations, 2 blanks, Coulomb at three speeds, 11 speeds of drag twice), a
simulated specimen, run-to-run variation, noise between 1 and 2 mN and a seed of its own, and is fitted jointly.
Intervals of Wilson tell which shares are off by more than chance.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import csv
import multiprocessing
import sys
from collections.abc import Sequence
from dataclasses import astuple, fields
from functools import partial
from math import isfinite, sqrt
from statistics import fmean, median
from typing import TextIO

from known_specimens import KINDS, Outcome, Score, examine

from dragrig.analysis.estimates import NORMAL_95

LEAST, MOST = 0.91, 0.98
"""Share of intervals that should hold the truth."""


def wilson(held: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a share, from so many that held (Wilson, J. Am. Stat. Assoc. 22, 1927)."""
    share, spread = held / count, NORMAL_95**2 / count
    half = NORMAL_95 * sqrt(share * (1 - share) / count + spread / (4 * count))
    return (share + spread / 2 - half) / (1 + spread), (share + spread / 2 + half) / (1 + spread)


def line(name: str, scores: Sequence[Score]) -> str:
    """Return a row: share held, and how the deviations from the truth are distributed."""
    known = [score for score in scores if isfinite(score.deviation)]
    if not known:
        return f"  {name:26s} missing in all {len(scores)}"
    held = sum(entry.covered for entry in known)
    low, high = wilson(held, len(known))
    deviations = [entry.deviation for entry in known]
    mean = fmean(deviations)
    spread = sqrt(fmean((deviation - mean) ** 2 for deviation in deviations))
    verdict = "too few" if high < LEAST else "too many" if low > MOST else ""
    missing = f"  {len(scores) - len(known)} missing" if len(known) < len(scores) else ""
    return (
        f"  {name:26s}{held / len(known):7.1%}  {low:6.1%} to {high:6.1%}  {mean:+6.2f}  {spread:5.2f}"
        f"  {median(estimate.half_width for estimate in known):8.2%}"
        f"  {fmean(estimate.learnt for estimate in known):5.0%}  {verdict}{missing}"
    )


def report(outcomes: Sequence[Outcome]) -> None:
    """Print the table of one kind of campaigns."""
    head = f"  {'':26s}{'held':>7s}  {'95 % of the share':>16s}  {'mean':>6s}  {'sd':>5s}  {'± median':>8s}  learnt"
    settled = [outcome for outcome in outcomes if outcome.converged]
    scores = [score for entry in settled for score in entry.scores]
    for group in dict.fromkeys(score.group for score in scores):
        of_group = [score for score in scores if score.group == group]
        print(f"{group}\n{head}")
        for name in dict.fromkeys(score.name for score in of_group):
            print(line(name, [score for score in of_group if score.name == name]))
        print(line("all", of_group))
    main = [score for score in scores if score.group in {"parameter", "combination"}]
    print(line("parameters, combinations", main))
    chi2 = [run.chi2 for run in settled]
    simulated, identified = (
        [outcome.simulated_s for outcome in outcomes],
        [outcome.identified_s for outcome in outcomes],
    )
    print(
        f"{len(outcomes)} campaigns, {len(outcomes) - len(settled)} not converged; χ² per degree {fmean(chi2):.3f} "
        f"({min(chi2):.3f} to {max(chi2):.3f}), p below 0.01 in {sum(entry.p_value < 0.01 for entry in settled)}; "
        f"{fmean(simulated):.2f} s to simulate, {fmean(identified):.2f} s to identify (worst {max(identified):.2f} s)\n"
    )


def keep(file: TextIO, kind: str, outcome: Outcome) -> None:
    """Write every score as a row of CSV."""
    rows = csv.writer(file)
    if not file.tell():
        rows.writerow(["kind", "seed", "white_mN", "converged", "chi2", *(field.name for field in fields(Score))])
    before = [kind, outcome.seed, outcome.white_mN, outcome.converged, outcome.chi2]
    rows.writerows([*before, *astuple(score)] for score in outcome.scores)
    file.flush()


def arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1000, help="seed of the first campaign; the others follow")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--kinds", nargs="+", choices=sorted(KINDS), default=["usual"])
    parser.add_argument("--parts", action="store_true", help="compare what is derived beside the joint fit, too")
    parser.add_argument("--csv", type=argparse.FileType("w"), help="file for every single interval")
    return parser.parse_args()


def main() -> None:
    """Simulate, identify, compare, print."""
    options = arguments()
    seeds = range(options.seed, options.seed + options.campaigns)
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        for name in options.kinds:
            outcomes: list[Outcome] = []
            for entry in pool.imap_unordered(partial(examine, KINDS[name], parts=options.parts), seeds):
                outcomes.append(entry)
                if options.csv:
                    keep(options.csv, name, entry)
                print(f"\r{name}: {len(outcomes)} of {len(seeds)}", end="", file=sys.stderr, flush=True)
            print(f"\n== {name}: {KINDS[name]}")
            report(outcomes)


if __name__ == "__main__":
    main()
