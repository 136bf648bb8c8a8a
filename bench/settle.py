"""What the loop of `dragrig gap settle` is worth on hidden campaigns, against a fixed plan.

`python bench/settle.py --cases 30 --seed 91100` hides what an exam hides (its plant, fresh seeds), begins with the
eight runs of the plan `first`, and goes on as `gap settle` does, with at most 60 % of the rig time of the plan
`diagnose`; the same campaign is then diagnosed by the runs of `diagnose`. `--plant drawn` hides forms that taught
nothing. The plant has no runs there and back: neither plan has them. A second call with the same `--out` goes on where
the first was stopped.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from plans import KINDS, diagnosed, keep, lines_of, tables

from dragrig.analysis.gap import (
    DEFAULT_UNTIL,
    Diagnosis,
    RigLimits,
    batch_budget,
    ending_of,
    mounting,
    plan_of_next_runs,
    verdict_probability,
)
from dragrig.exam.hidden_cases import DRAWN_PLANT, WRITTEN_PLANT, HiddenCase, draw_cases
from dragrig.parallel import open_executor, parallel_map
from dragrig.sim_backend.blind import CATALOGUE, RunList

SHARE, SURE = 0.6, 0.8
PAUSE_S = 5.0
"""Between batches."""


def held(diagnosis: Diagnosis, truth: Sequence[str]) -> Mapping[str, object]:
    """Return a verdict: right where it names what is hidden and nothing else; a pair where it names one of it at least.

    A wrong name is one that is not hidden.
    """
    said = set(diagnosis.effects) or {diagnosis.verdict.value}
    hidden = set(truth)
    right = said == hidden if len(hidden) == 1 else bool(said & hidden) and said <= hidden
    probability = verdict_probability(diagnosis)
    wrong_name = bool(set(diagnosis.effects) - hidden)
    return {"said": sorted(said), "right": right, "sure_and_wrong": wrong_name and probability > SURE}


def settled(case: HiddenCase) -> dict[str, object]:
    """Settle a hidden campaign, and diagnose it by the fixed plan."""
    secret = case.secret
    truth = [name if name in CATALOGUE else "unknown" for name in case.effects] or ["no_gap"]
    fixed_runs, fixed_s = tables("diagnose")
    runs, end_s = tables("first")
    batches = 0
    while True:
        left_min = (SHARE * fixed_s - end_s - PAUSE_S) / 60
        result = diagnosed(secret, RunList.of("settle", runs), batch_budget(left_min, RigLimits(kinds=KINDS)))
        ending = ending_of(result, DEFAULT_UNTIL, left_min)
        if ending is not None or result.next_experiment is None:
            break
        plan = plan_of_next_runs(result.next_experiment, mounted=mounting(str(runs[-1]["kind"])))
        more, end_s = tables(plan, end_s + PAUSE_S)
        runs, batches = [*runs, *more], batches + 1
    fixed = diagnosed(secret, RunList.of("diagnose", fixed_runs), None)
    return {
        "kind": case.kind,
        "truth": truth,
        "loop": held(result, truth),
        "fixed": held(fixed, truth),
        "share": round(60 * (end_s / 60) / fixed_s, 3),
        "runs": len(runs),
        "batches": batches,
        "ending": str(ending),
    }


def summarise(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rates with Wilson intervals."""
    from scipy.stats import binomtest

    for way in ("loop", "fixed"):
        for key in ("right", "sure_and_wrong"):
            count = sum(row[way][key] for row in rows)
            ends = binomtest(count, len(rows)).proportion_ci(method="wilson")
            print(f"{way:6s} {key:15s} {count} of {len(rows)} ({ends.low:.2f} to {ends.high:.2f})")
    only = [
        sum(row[way]["right"] > row[rest]["right"] for row in rows)
        for way, rest in (("loop", "fixed"), ("fixed", "loop"))
    ]
    print(f"right by the loop alone {only[0]}, by the fixed plan alone {only[1]}")
    shares = sorted(row["share"] for row in rows)
    print(f"rig time of the loop over that of the plan: mean {sum(shares) / len(shares):.2f}, largest {shares[-1]:.2f}")
    for ending in sorted({row["ending"] for row in rows}):
        print(f"ended: {ending} {sum(row['ending'] == ending for row in rows)}")


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=30)
    parser.add_argument("--seed", type=int, default=91100)
    parser.add_argument("--plant", choices=(WRITTEN_PLANT, DRAWN_PLANT), default=WRITTEN_PLANT)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("settle.jsonl"))
    arguments = parser.parse_args()
    there = {(row["seed"], row["plant"]) for row in lines_of(arguments.out)}
    cases = draw_cases(arguments.cases, arguments.seed, plant=arguments.plant)
    waiting = [case for case in cases if (case.seed, case.plant) not in there]

    def store(case: HiddenCase, result: dict[str, object]) -> None:
        keep(arguments.out, {"seed": case.seed, "plant": case.plant, **result})

    with open_executor(arguments.workers) as here:
        parallel_map(here, settled, waiting, store)
    summarise([row for row in lines_of(arguments.out) if row["plant"] == arguments.plant])


if __name__ == "__main__":
    main()
