"""What a plan, and what the advice of a diagnosis, is worth on blind campaigns.

`python bench/plans.py compare --cases 20 --seed 7100` makes the runs of `paper` and of `diagnose` on the blind plant,
with the same hidden effects, and counts right verdicts of either. The plant has no reversals: those of `diagnose` are
left out. `python bench/plans.py advice --seed 7400` diagnoses campaigns of five first runs, then each again with these
runs made a second time, and with the runs that the diagnosis advised in at most as much rig time. `--workers` share the
cases, and a second call with the same `--out` goes on where the first was stopped.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dragrig.analysis.gap import DiagnosisOptions
from dragrig.analysis.gap.candidate_runs import ExperimentBudget, RigLimits, plan_of_next_runs
from dragrig.analysis.gap.diagnose import diagnose
from dragrig.analysis.gap.diagnosis import Diagnosis
from dragrig.analysis.gap.run_data import choose_runs
from dragrig.analysis.models.capsule_model import CapsuleModel
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.parallel import open_executor, parallel_map
from dragrig.setup import PlanLike, resolve
from dragrig.sim_backend.blind import CATALOGUE, OUTSIDE, BlindCampaign, RunList, draw_campaign, write_campaign

KINDS = ("drag", "coulomb", "relaxation", "blank")
LATER_S = 120.0
SURE = 0.8
FIRST = Plan.model_validate(
    {
        "name": "first",
        "steps": [
            {"kind": "relaxation", "shear_strain": 1.0},
            {"kind": "blank", "speed_mm_s": 40.0, "wait_s": 5.0},
            {"kind": "drag", "speed_mm_s": [20.0, 5.0, 60.0]},
        ],
    }
)
OF_THE_FORCE = tuple(name for name in CATALOGUE if name not in ("servo_lag", "velocity_ripple", "encoder_scale"))


@dataclass(frozen=True, slots=True)
class Case:
    """A hidden effect, empty for none, at a size, and the seed that all else is drawn from."""

    seed: int
    effect: str
    size: float


def tables(plan: PlanLike, begin_s: float = 0.0) -> tuple[list[Mapping[str, str | float]], float]:
    """Return a plan's runs as the plant reads them, and when the last one ends, rests and ways back counted."""
    result: list[Mapping[str, str | float]] = []
    time_s = begin_s
    for run in resolve(plan, backend="simulated").programme().runs:
        time_s += run.wait_s + run.tare_s
        settings = {key: value for key, value in run.protocol.attributes().items() if isinstance(value, str | float)}
        if run.protocol.kind in KINDS:
            result.append({**settings, "start_s": time_s, "dwell_s": run.wait_s})
        time_s += run.duration_s
    return result, time_s


def diagnosed(secret: BlindCampaign, listed: RunList, budget: ExperimentBudget | None = None) -> Diagnosis:
    """Write a campaign of the plant and diagnose it from its files alone."""
    with tempfile.TemporaryDirectory() as folder:
        write_campaign(secret, folder, runs=listed)
        options = DiagnosisOptions() if budget is None else DiagnosisOptions(next_runs=budget)
        return diagnose(choose_runs(Path(folder)), CapsuleModel(FrictionModelSettings(name="paper")), options)


def entry(diagnosis: Diagnosis, truth: Sequence[str]) -> Mapping[str, object]:
    """Return what was said and whether it is right: the name among those said, or the verdict without one."""
    text = diagnosis.effects or (diagnosis.verdict.value,)
    meant = set(truth)
    sure = max(
        (hypothesis.probability for hypothesis in diagnosis.ranking if meant <= set(hypothesis.hypothesis.split("+"))),
        default=0.0,
    )
    return {"said": list(text), "right": meant <= set(text), "alone": meant == set(text), "of_truth": round(sure, 3)}


def mix(cases: int, seed: int) -> list[Case]:
    """Return what is hidden: of ten, five at a third, two at full size, one at a tenth, one foreign, one nothing."""
    names = list(CATALOGUE)
    sizes = (1 / 3, 1 / 3, 1.0, 1 / 3, 1 / 10, 1 / 3, 1.0, 1 / 3)
    result = []
    for number in range(cases):
        place = number % 10
        if place == 8:
            result.append(Case(seed + number, list(OUTSIDE)[(3 * number) % len(OUTSIDE)], 1.0))
        elif place == 9:
            result.append(Case(seed + number, "", 0.0))
        else:
            result.append(Case(seed + number, names[(7 * number) % len(names)], sizes[place]))
    return result


def compared(case: Case) -> dict[str, object]:
    """Diagnose the same hidden effect by the runs of two plans."""
    secret = draw_campaign(case.seed, effects=[case.effect] if case.effect else None, size=case.size or 1.0)
    truth = [case.effect] if case.effect in CATALOGUE else ["unknown" if case.effect else "no_gap"]
    plans = {name: RunList.of(name, tables(name)[0]) for name in ("paper", "diagnose")}
    return {name: entry(diagnosed(secret, listed), truth) for name, listed in plans.items()}


def advised(case: Case) -> dict[str, object]:
    """Diagnose first runs, then these with the same again, and with advised runs in at most as much rig time."""
    first, ends_s = tables(FIRST)
    again, _ = tables(FIRST, ends_s + LATER_S)
    budget = ExperimentBudget(ends_s / 60, 30, limits=RigLimits(kinds=KINDS))
    secret = draw_campaign(case.seed, effects=[case.effect], size=case.size)
    before = diagnosed(secret, RunList.of("first", first), budget)
    advice = before.next_experiment
    more = [] if advice is None else tables(plan_of_next_runs(advice), ends_s + LATER_S)[0]
    return {
        "first": entry(before, [case.effect]),
        "repeated": entry(diagnosed(secret, RunList.of("first", [*first, *again])), [case.effect]),
        "advised": entry(diagnosed(secret, RunList.of("first", [*first, *more])), [case.effect]),
        "minutes": 0.0 if advice is None else round(advice.minutes, 2),
        "runs": [] if advice is None else [f"{run.step.kind} {dict(run.settings)}" for run in advice.runs],
    }


def hold(subject: str, cases: Sequence[Case], out: Path, workers: int) -> None:
    """Diagnose all cases that have no line in the results yet."""
    there = {row["seed"] for row in lines_of(out)}
    waiting = [case for case in cases if case.seed not in there]
    with open_executor(workers) as here:
        parallel_map(here, WAYS[subject].work, waiting, lambda case, result: keep(out, {**asdict(case), **result}))


def keep(out: Path, first: Mapping[str, object]) -> None:
    """Add a line to the results."""
    with out.open("a", encoding="utf-8") as file:
        file.write(json.dumps(first) + "\n")
    print(json.dumps({key: value for key, value in first.items() if key != "runs"}), flush=True)


def lines_of(out: Path) -> list[dict[str, Any]]:
    """Return the results that are there."""
    return [json.loads(line) for line in out.read_text("utf-8").splitlines()] if out.exists() else []


def summarise(out: Path, ways: Sequence[str]) -> None:
    """Print rates with Wilson intervals, by size, and how the last way differs from the one before, case by case."""
    from scipy.stats import binomtest

    lines = lines_of(out)
    sizes = sorted({round(line["size"], 3) for line in lines}, reverse=True)
    groups = [("all", lines), *((str(size), [o for o in lines if round(o["size"], 3) == size]) for size in sizes)]
    for label, remaining in groups:
        for way in ways:
            right, alone = (sum(element[way][key] for element in remaining) for key in ("right", "alone"))
            interval = binomtest(right, len(remaining)).proportion_ci(method="wilson")
            mean = sum(element[way]["of_truth"] for element in remaining) / len(remaining)
            sure = sum(element[way]["right"] and element[way]["of_truth"] > SURE for element in remaining)
            print(
                f"{label:6s} {way:9s} {right} of {len(remaining)} right ({interval.low:.2f} to {interval.high:.2f}), "
                f"{alone} alone, {sure} above {SURE}, mean probability of the truth {mean:.2f}"
            )
    before, after = ways[-2:]
    for key, minimum in (("right", 0.0), (f"right above {SURE}", SURE)):
        held = [[line[way]["right"] and line[way]["of_truth"] > minimum for way in (before, after)] for line in lines]
        won, lost = held.count([False, True]), held.count([True, False])
        chance = binomtest(won, won + lost).pvalue if won + lost else 1.0
        print(f"{key}: {won} cases with {after} only, {lost} with {before} only (sign test: p = {chance:.1g})")


@dataclass(frozen=True, slots=True)
class Way:
    """A question: what is done with a case, and which answers are set beside each other."""

    work: Callable[[Case], dict[str, object]]
    conclusions: tuple[str, ...]


WAYS = {"compare": Way(compared, ("paper", "diagnose")), "advice": Way(advised, ("first", "repeated", "advised"))}


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=tuple(WAYS))
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--seed", type=int, default=7400)
    parser.add_argument("--sizes", type=float, nargs="+", default=[1 / 3, 1.0])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("plans.jsonl"))
    arguments = parser.parse_args()
    hidden = [(size, effect) for size in arguments.sizes for effect in OF_THE_FORCE]
    of_advice = [Case(arguments.seed + number, effect, size) for number, (size, effect) in enumerate(hidden)]
    hold(
        arguments.what,
        of_advice if arguments.what == "advice" else mix(arguments.cases, arguments.seed),
        arguments.out,
        arguments.workers,
    )
    summarise(arguments.out, WAYS[arguments.what].conclusions)


if __name__ == "__main__":
    main()
