"""Print how often `gap evaluate` says KEPT of fresh runs with and without the promised effect.

`python bench/promises.py [--campaigns 40] [--seed 81000] [--keep FOLDER] [--workers N]`: campaigns with a single effect
at full size, of both blind plants and of stages under a position loop in turn, are diagnosed. The models of those whose
effect is named are evaluated on fresh sessions of the same specimen: with the effect at no, half, its own and twice its
size, and with another effect of the catalogue in its place. `--keep` keeps campaigns and models for the next time.
"""

import argparse
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dragrig.analysis.estimates import no_progress
from dragrig.analysis.gap.evaluation import ModelEvaluation, PromiseVerdict
from dragrig.parallel import map_tasks
from dragrig.scoring import wilson_rate
from dragrig.sim_backend.blind.blind_campaign import draw_campaign
from dragrig.sim_backend.blind.effects import CATALOGUE, effect_group
from dragrig.sim_backend.blind.plant import write_campaign

PLANTS: tuple[tuple[str, tuple[str, ...]], ...] = (("written", ()), ("drawn", ()), ("drawn", ("position loop",)))
"""Plants and their conditions, in turn."""
KEPT = "its own size"
SESSIONS = {"no size": 0.0, "half its size": 0.5, KEPT: 1.0, "twice its size": 2.0, "another effect": 1.0}


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
        effect = case.effect if session != "another effect" else case.replacement
        case.write(effect, size, case.folder / session, "fresh")
        evaluations[session] = gap_evaluate(model, case.folder / session)
    return evaluations


def main() -> None:
    """Print the counts, and every verdict that is not the expected one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=40)
    parser.add_argument("--seed", type=int, default=81000)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--workers", type=int)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        cases = tuple(draw_cases(options.campaigns, options.seed, options.keep or Path(temporary)))
        results = map_tasks(evaluations_of, cases, options.workers, None, no_progress)
    named = [(case, evaluations) for case, evaluations in zip(cases, results, strict=True) if evaluations]
    print(f"seed {options.seed}: the effect is named in {len(named)} of {len(cases)} campaigns")
    for session in SESSIONS:
        counts = Counter(evaluations[session].verdict for _, evaluations in named)
        kept = wilson_rate("kept", [evaluations[session].verdict is PromiseVerdict.KEPT for _, evaluations in named])
        shown = ", ".join(f"{verdict.value} {counts[verdict]}" for verdict in PromiseVerdict)
        print(f"{session:15} {shown}   KEPT {kept.share:.0%} ({kept.low:.0%} to {kept.high:.0%})")
    for case, evaluations in named:
        for session, evaluation in evaluations.items():
            expected = PromiseVerdict.KEPT if session == KEPT else PromiseVerdict.NOT_KEPT
            if evaluation.verdict is not expected:
                sizes = ", ".join(
                    f"{size.effect} {size.size:.2f} ({size.low:.2f} to {size.high:.2f}, d' {size.d_prime:.0f})"
                    for size in evaluation.sizes
                )
                what = case.replacement if session == "another effect" else case.effect
                print(f"  {case.seed} {case.plant} {what}, {session}: {evaluation.verdict.value}; {sizes}; ")
                print(f"      explained {evaluation.explained}, promised {evaluation.promised}")


if __name__ == "__main__":
    main()
