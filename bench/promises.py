"""Print how often `gap evaluate` says KEPT of fresh runs with and without the promised effect.

`python bench/promises.py [--campaigns 40] [--seed 81000] [--workers N]`: campaigns of the blind plant with a single
effect at full size are diagnosed. The models of those whose effect is named are evaluated on four fresh sessions of the
same specimen: with the effect, without any, with another effect of the catalogue in its place, and with the effect at
twice its size.
"""

import argparse
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dragrig.analysis.estimates import no_progress
from dragrig.analysis.gap.evaluation import PromiseVerdict
from dragrig.parallel import map_tasks
from dragrig.scoring import wilson_rate
from dragrig.sim_backend.blind.blind_campaign import draw_campaign
from dragrig.sim_backend.blind.effects import CATALOGUE, effect_group
from dragrig.sim_backend.blind.plant import write_campaign

SESSIONS = ("with the effect", "without it", "with another one", "at twice its size")


@dataclass(frozen=True, slots=True)
class Case:
    """A hidden effect, the effect that takes its place in a fresh session, and the seed of everything else."""

    seed: int
    effect: str
    replacement: str


def draw_cases(campaigns: int, seed: int) -> Iterator[Case]:
    """Yield cases that take the effects of the catalogue in turn."""
    random = np.random.default_rng(seed)
    names = random.permutation(np.array(tuple(CATALOGUE))).tolist()
    for number in range(campaigns):
        effect = names[number % len(names)]
        others = [name for name in names if effect_group(name) != effect_group(effect)]
        yield Case(seed + number, effect, str(random.choice(others)))


def verdicts_of(case: Case) -> tuple[Case, dict[str, PromiseVerdict]]:
    """Diagnose a case and evaluate its model on four fresh sessions; empty where the effect is not named."""
    from dragrig.api import gap_diagnose, gap_evaluate

    with tempfile.TemporaryDirectory() as folder:
        campaign = Path(folder) / "campaign"
        write_campaign(draw_campaign(case.seed, effects=(case.effect,), size=1.0), campaign)
        diagnosis = gap_diagnose(campaign)
        if diagnosis.model is None or case.effect not in diagnosis.effects:
            return case, {}
        hidden = ((case.effect,), (), (case.replacement,), (case.effect,))
        sizes: tuple[float | tuple[float, ...], ...] = (1.0, (), 1.0, 2.0)
        verdicts = {}
        for session, effects, size in zip(SESSIONS, hidden, sizes, strict=True):
            fresh = Path(folder) / session
            write_campaign(draw_campaign(case.seed, effects=effects, size=size), fresh, runs="fresh")
            verdicts[session] = gap_evaluate(diagnosis.model, fresh).verdict
        return case, verdicts


def main() -> None:
    """Print the counts, and every verdict that is not the expected one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=40)
    parser.add_argument("--seed", type=int, default=81000)
    parser.add_argument("--workers", type=int)
    options = parser.parse_args()
    cases = tuple(draw_cases(options.campaigns, options.seed))
    results = map_tasks(verdicts_of, cases, options.workers, None, no_progress)
    named = [(case, verdicts) for case, verdicts in results if verdicts]
    print(f"seed {options.seed}: the effect is named in {len(named)} of {len(cases)} campaigns")
    for session in SESSIONS:
        counts = Counter(verdicts[session] for _, verdicts in named)
        kept = wilson_rate("kept", [verdicts[session] is PromiseVerdict.KEPT for _, verdicts in named])
        shown = ", ".join(f"{verdict.value} {counts[verdict]}" for verdict in PromiseVerdict)
        print(f"{session:18} {shown}   KEPT {kept.share:.0%} ({kept.low:.0%} to {kept.high:.0%})")
    for case, verdicts in named:
        for session in SESSIONS:
            expected = PromiseVerdict.KEPT if session == SESSIONS[0] else PromiseVerdict.NOT_KEPT
            if verdicts[session] is not expected:
                print(f"  {case.seed} {case.effect} {session} ({case.replacement}): {verdicts[session].value}")


if __name__ == "__main__":
    main()
