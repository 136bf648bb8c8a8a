"""What a plan, and what the advice of a diagnosis, is worth on blind campaigns.

`python bench/plans.py compare --cases 20 --seed 7100` makes the runs of `paper` and of `diagnose` on the blind plant,
with the same hidden effects, and counts right verdicts of either. The plant has no reversals: those of `diagnose` are
left out. `python bench/plans.py advice --seed 7200` diagnoses thin campaigns, then each again with the same runs made a
second time, and with the runs that the diagnosis advised in as much rig time.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from dragrig.analysis.gap.choosing import choose
from dragrig.analysis.gap.diagnose import Options, diagnose
from dragrig.analysis.gap.planning.search import Budget
from dragrig.analysis.gap.planning.trials import Limits
from dragrig.analysis.gap.planning.writing import plan_of
from dragrig.analysis.gap.results import Diagnosis
from dragrig.analysis.nominal.capsule import CapsuleModel
from dragrig.config.model import FrictionModelSettings
from dragrig.config.plan import Plan
from dragrig.setup import PlanLike, resolve
from dragrig.sim_backend.blind import CATALOGUE, OUTSIDE, Listed, Secret, draw, make

Table = Mapping[str, str | float]
KINDS = ("drag", "coulomb", "relaxation", "blank")
LATER_S = 120.0
THIN = Plan.model_validate(
    {
        "name": "thin",
        "steps": [
            {"kind": "relaxation", "shear_strain": [1.0, 2.0]},
            {"kind": "blank", "speed_mm_s": 40.0, "wait_s": 5.0},
            {"kind": "drag", "speed_mm_s": [1.0, 20.0, 5.0, 60.0]},
        ],
    }
)
DOUBTFUL = (
    "stribeck", "adhesion", "wall_lift_off", "wall_inertia", "film_depletion", "hyperelastic_wall",
    "extra_relaxation", "payload_inertia", "presliding", "breakaway", "mesentery_tether", "force_drift",
)  # fmt: skip


def tables(plan: PlanLike, begin_s: float = 0.0) -> tuple[list[Table], float]:
    """Return a plan's runs as the plant reads them, and when the last one ends, rests and ways back counted."""
    found: list[Table] = []
    time_s = begin_s
    for run in resolve(plan, backend="simulated").programme().runs:
        time_s += run.wait_s + run.tare_s
        settings = {key: value for key, value in run.protocol.attributes().items() if isinstance(value, str | float)}
        if run.protocol.kind in KINDS:
            found.append({**settings, "start_s": time_s, "dwell_s": run.wait_s})
        time_s += run.duration_s
    return found, time_s


def told(secret: Secret, listed: Listed, budget: Budget | None = None) -> Diagnosis:
    """Write a campaign of the plant and diagnose it from its files alone."""
    with tempfile.TemporaryDirectory() as folder:
        make(secret, folder, runs=listed)
        options = Options() if budget is None else Options(next_runs=budget)
        return diagnose(choose(Path(folder)), CapsuleModel(FrictionModelSettings(name="paper")), options)


def entry(diagnosis: Diagnosis, truth: Sequence[str]) -> dict[str, object]:
    """Return what was said and whether it is right: the name among those said, or the verdict without one."""
    said = diagnosis.effects or (diagnosis.verdict.value,)
    meant = set(truth)
    sure = max((one.probability for one in diagnosis.ranking if meant <= set(one.hypothesis.split("+"))), default=0.0)
    return {"said": list(said), "right": meant <= set(said), "alone": meant == set(said), "of_truth": round(sure, 3)}


def mix(cases: int) -> list[tuple[str, float]]:
    """Return what is hidden: of ten, five at a third, two at full size, one at a tenth, one foreign, one nothing."""
    names = list(CATALOGUE)
    sizes = (1 / 3, 1 / 3, 1.0, 1 / 3, 1 / 10, 1 / 3, 1.0, 1 / 3)
    found = []
    for number in range(cases):
        place = number % 10
        if place == 8:
            found.append((list(OUTSIDE)[(3 * number) % len(OUTSIDE)], 1.0))
        elif place == 9:
            found.append(("", 0.0))
        else:
            found.append((names[(7 * number) % len(names)], sizes[place]))
    return found


def compare(cases: int, seed: int, out: Path) -> None:
    """Diagnose the same hidden effects by the runs of two plans."""
    plans = {name: Listed.of(name, tables(name)[0]) for name in ("paper", "diagnose")}
    for number, (effect, size) in enumerate(mix(cases)):
        secret = draw(seed + number, effects=[effect] if effect else None, size=size or 1.0)
        truth = [effect] if effect in CATALOGUE else ["unknown" if effect else "no_gap"]
        found = {name: entry(told(secret, listed), truth) for name, listed in plans.items()}
        keep(out, {"seed": seed + number, "hidden": effect, "size": size, **found})
    summarise(out, ("paper", "diagnose"))


def advice(seed: int, out: Path, sizes: Sequence[float]) -> None:
    """Diagnose thin campaigns, then the same with their runs again, and with advised runs in as much rig time."""
    first, ends_s = tables(THIN)
    again, _ = tables(THIN, ends_s + LATER_S)
    budget = Budget(ends_s / 60, 30, limits=Limits(kinds=KINDS))
    cases = [(name, size) for size in sizes for name in DOUBTFUL]
    for number, (effect, size) in enumerate(cases):
        secret = draw(seed + number, effects=[effect], size=size)
        thin = told(secret, Listed.of("thin", first), budget)
        advised = thin.next_experiment
        more = [] if advised is None else tables(plan_of(advised), ends_s + LATER_S)[0]
        found = {
            "thin": entry(thin, [effect]),
            "repeated": entry(told(secret, Listed.of("thin", [*first, *again])), [effect]),
            "advised": entry(told(secret, Listed.of("thin", [*first, *more])), [effect]),
        }
        minutes = 0.0 if advised is None else round(advised.minutes, 2)
        told_runs = [] if advised is None else [f"{one.step.kind} {dict(one.settings)}" for one in advised.runs]
        one = {"seed": seed + number, "hidden": effect, "size": size, "minutes": minutes, "runs": told_runs, **found}
        keep(out, one)
    summarise(out, ("thin", "repeated", "advised"))


def keep(out: Path, one: Mapping[str, object]) -> None:
    """Add a line to the results."""
    with out.open("a", encoding="utf-8") as file:
        file.write(json.dumps(one) + "\n")
    print(json.dumps({key: value for key, value in one.items() if key != "runs"}), flush=True)


def summarise(out: Path, ways: Sequence[str]) -> None:
    """Print rates with Wilson intervals, by size."""
    from scipy.stats import binomtest

    lines = [json.loads(line) for line in out.read_text("utf-8").splitlines()]
    sizes = sorted({round(one["size"], 3) for one in lines}, reverse=True)
    for label, kept in [
        ("all", lines),
        *((str(size), [o for o in lines if round(o["size"], 3) == size]) for size in sizes),
    ]:
        for way in ways:
            right = sum(one[way]["right"] for one in kept)
            interval = binomtest(right, len(kept)).proportion_ci(method="wilson")
            sure = sum(one[way]["of_truth"] for one in kept) / len(kept)
            alone = sum(one[way]["alone"] for one in kept)
            print(
                f"{label:6s} {way:9s} {right} of {len(kept)} right ({interval.low:.2f} to {interval.high:.2f}), "
                f"{alone} alone, mean probability of the truth {sure:.2f}"
            )


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("compare", "advice", "score"))
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--seed", type=int, default=7100)
    parser.add_argument("--sizes", type=float, nargs="+", default=[1 / 3, 1.0])
    parser.add_argument("--out", type=Path, default=Path("plans.jsonl"))
    given = parser.parse_args()
    if given.what == "compare":
        compare(given.cases, given.seed, given.out)
    elif given.what == "advice":
        advice(given.seed, given.out, given.sizes)
    else:
        ways = ("thin", "repeated", "advised") if "thin" in given.out.read_text("utf-8") else ("paper", "diagnose")
        summarise(given.out, ways)


if __name__ == "__main__":
    main()
