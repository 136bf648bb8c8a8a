"""Print how often `gap evaluate` says KEPT of fresh runs with and without the promised effect.

`python bench/promises.py [--campaigns 40] [--seed 81000] [--keep FOLDER] [--workers N]`: campaigns with a single effect
at full size, of both blind plants and of stages under a position loop in turn, are diagnosed. The models of those whose
effect is named are evaluated on fresh sessions of the same specimen: with the effect at no, half, its own and twice its
size, and with another effect of the catalogue in its place. `--keep` keeps campaigns and models for the next time.

`python bench/promises.py --drives N` does the same with N stages whose motor cogs, their force explained by
`--nominal drive`; in place of another effect the ripple is in the force with which a position loop holds the stage.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from dragrig.analysis.estimates import no_progress
from dragrig.analysis.gap.evaluation import ModelEvaluation, PromiseVerdict
from dragrig.parallel import map_tasks
from dragrig.scoring import wilson_rate
from dragrig.sim_backend.blind.blind_campaign import draw_campaign
from dragrig.sim_backend.blind.effects import CATALOGUE, effect_group
from dragrig.sim_backend.blind.plant import write_campaign
from drives import cogging, held_by_a_loop

PLANTS: tuple[tuple[str, tuple[str, ...]], ...] = (("written", ()), ("drawn", ()), ("drawn", ("position loop",)))
"""Plants and their conditions, in turn."""
KEPT, ANOTHER, STANDSTILLS = "its own size", "another effect", "standstills alone"
SESSIONS = {"no size": 0.0, "half its size": 0.5, KEPT: 1.0, "twice its size": 2.0, ANOTHER: 1.0}


@dataclass(frozen=True, slots=True)
class Case:
    """A hidden effect, the effect that takes its place in a fresh session, and the seed of everything else."""

    seed: int
    effect: str
    replacement: str
    plant: str
    conditions: tuple[str, ...]
    folder: Path

    def write(self, effect: str, size: float, folder: Path, runs: str) -> None:
        """Write a session with an effect of some size, unless it is there."""
        if not folder.exists():
            secret = draw_campaign(
                self.seed,
                effects=(effect,) if size else (),
                size=size if size else (),
                plant=self.plant,
                conditions=self.conditions,
                runs=runs,
            )
            write_campaign(secret, folder)


def draw_cases(campaigns: int, seed: int, folder: Path) -> Iterator[Case]:
    """Yield cases that take the effects of the catalogue, and the plants, in turn."""
    random = np.random.default_rng(seed)
    names = random.permutation(np.array(tuple(CATALOGUE))).tolist()
    for number in range(campaigns):
        effect = names[number % len(names)]
        others = [name for name in names if effect_group(name) != effect_group(effect)]
        plant, conditions = PLANTS[number % len(PLANTS)]
        yield Case(
            seed + number, effect, str(random.choice(others)), plant, conditions, folder / f"{seed + number}-{effect}"
        )


def evaluations_of(case: Case) -> dict[str, ModelEvaluation]:
    """Diagnose a case and evaluate its model on fresh sessions; empty where the effect is not named."""
    from dragrig.api import gap_diagnose, gap_evaluate
    from dragrig.api.gap import save_amended_model

    model, unnamed = case.folder / "amended.toml", case.folder / "unnamed.txt"
    if not (model.exists() or unnamed.exists()):
        case.write(case.effect, 1.0, case.folder / "campaign", "practice")
        diagnosis = gap_diagnose(case.folder / "campaign")
        if diagnosis.model is None or case.effect not in diagnosis.effects:
            unnamed.write_text(f"{diagnosis.verdict}\n", "utf-8")
        else:
            save_amended_model(diagnosis, model)
    if unnamed.exists():
        return {}
    evaluations = {}
    for session, size in SESSIONS.items():
        effect = case.effect if session != ANOTHER else case.replacement
        case.write(effect, size, case.folder / session, "fresh")
        evaluations[session] = gap_evaluate(model, case.folder / session)
    return evaluations


def drive_evaluations(number: int) -> dict[str, ModelEvaluation]:
    """Diagnose a stage that cogs, and evaluate its model on fresh runs; empty where cogging is not named."""
    import dragrig

    random = np.random.default_rng(number)
    amplitude_mN, pitch_mm = float(random.uniform(10.0, 60.0)), float(random.uniform(2.0, 15.0))
    sessions = []
    for seed, speeds in ((2 * number, [5, 15, 30, 60]), (2 * number + 1, [8, 20, 45])):
        with tempfile.TemporaryDirectory() as folder:
            plan = Path(folder) / "stage.toml"
            steps = (f'[[steps]]\nkind = "blank"\nspeed_mm_s = {speeds}\ntravel_mm = {way}\n' for way in (25, -25))
            plan.write_text('name = "stage"\n' + "".join(steps), "utf-8")
            sessions.append(
                dragrig.simulate(str(plan), assignments=[f"rig.simulated.seed={seed}", "rig.sampling.rate_hz=500"])
            )
    diagnosis = dragrig.gap_diagnose(cogging(sessions[0], amplitude_mN, pitch_mm), nominal="drive")
    if diagnosis.model is None or "cogging" not in diagnosis.effects:
        return {}
    fresh = {name: cogging(sessions[1], size * amplitude_mN, pitch_mm) for name, size in SESSIONS.items()}
    fresh[STANDSTILLS] = held_by_a_loop(sessions[1], 5 * amplitude_mN, pitch_mm)
    del fresh[ANOTHER]
    return {name: dragrig.gap_evaluate(diagnosis.model, runs) for name, runs in fresh.items()}


def main() -> None:
    """Print the counts, and every verdict that is not the expected one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=40)
    parser.add_argument("--seed", type=int, default=81000)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--drives", type=int, default=0)
    parser.add_argument("--workers", type=int)
    options = parser.parse_args()
    if options.drives:
        seeds = range(options.seed, options.seed + options.drives)
        results = map_tasks(drive_evaluations, seeds, options.workers, None, no_progress)
        print_verdicts([(f"{seed} drive", found) for seed, found in zip(seeds, results, strict=True)])
        return
    with tempfile.TemporaryDirectory() as temporary:
        cases = tuple(draw_cases(options.campaigns, options.seed, options.keep or Path(temporary)))
        results = map_tasks(evaluations_of, cases, options.workers, None, no_progress)
    words = [f"{case.seed} {case.plant} {case.effect} (or {case.replacement})" for case in cases]
    print_verdicts(list(zip(words, results, strict=True)))


def print_verdicts(results: Sequence[tuple[str, dict[str, ModelEvaluation]]]) -> None:
    """Print the verdicts of each session, and all that are not as they should be."""
    named = [(case, evaluations) for case, evaluations in results if evaluations]
    print(f"the effect is named in {len(named)} of {len(results)} campaigns")
    for session in named[0][1] if named else ():
        verdicts = [evaluations[session].verdict for _, evaluations in named]
        kept = wilson_rate("kept", [verdict is PromiseVerdict.KEPT for verdict in verdicts])
        shown = ", ".join(f"{verdict.value} {verdicts.count(verdict)}" for verdict in PromiseVerdict)
        print(f"{session:17} {shown}   KEPT {kept.share:.0%} ({kept.low:.0%} to {kept.high:.0%})")
    for case, evaluations in named:
        for session, evaluation in evaluations.items():
            expected = PromiseVerdict.KEPT if session == KEPT else PromiseVerdict.NOT_KEPT
            if evaluation.verdict is not expected:
                sizes = ", ".join(
                    f"{size.effect} {size.size:.2f} ({size.low:.2f} to {size.high:.2f}, d' {size.d_prime:.0f})"
                    for size in evaluation.sizes
                )
                print(f"  {case}, {session}: {evaluation.verdict.value}; {sizes}")
                print(f"      explained {evaluation.explained}, promised {evaluation.promised}")


if __name__ == "__main__":
    main()
