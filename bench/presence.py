"""Print how well presence, verdict and shares of the budget hold.

`python bench/presence.py [--campaigns 60] [--seed 52000] [--plant written|drawn] [--exam] [--workers N]`: campaigns
with one effect of full, a third or a tenth of its size, with two, with none, and with effects that no catalogue has,
half of them with nominal models that are off by 5 % to 20 % or with a second specimen that nobody recorded; or, with
`--exam`, the mix of the exam: counts of right verdicts, the reliability of presence, and how far the budget's shares
of named effects are from the plant's own.
"""

import argparse
import json
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from dragrig.analysis import no_progress
from dragrig.analysis.gap import GapBudget
from dragrig.exam import hidden_cases
from dragrig.parallel import map_tasks
from dragrig.sim_backend.blind import (
    CATALOGUE,
    OUTSIDE,
    BlindCampaign,
    draw_campaign,
    effect_group,
    write_campaign,
)
from dragrig.sim_backend.blind.effect_sizes import hidden_shares

OFF = (
    *(f"{what} {share} % off" for what in ("parameters", "laws", "both") for share in (5, 10, 20)),
    *("exchanged, not recorded",) * 3,
)
BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)


@dataclass(frozen=True, slots=True)
class Case:
    """What is hidden in a campaign."""

    seed: int
    plant: str
    effects: tuple[str, ...]
    sizes: tuple[float, ...]
    conditions: tuple[str, ...]
    rough: bool = False


@dataclass(frozen=True, slots=True)
class Answer:
    """What a diagnosis says of it: the verdict, the presence of each effect on the force, and shares."""

    verdict: str
    effects: tuple[str, ...]
    probability: float
    presence: dict[str, float]
    shares: tuple["Share", ...] = ()


@dataclass(frozen=True, slots=True)
class Share:
    """A share that the budget states of an effect, and the plant's own."""

    cause: str
    channel: str
    stated: float
    interval: tuple[float, float] | None
    hidden: float
    """0 for an effect that is not there."""

    @property
    def held(self) -> bool:
        """Whether the interval holds."""
        return self.interval is not None and self.interval[0] <= self.hidden <= self.interval[1]


def shares_of(budget: GapBudget, secret: BlindCampaign) -> tuple[Share, ...]:
    """Return the shares of the effects that a budget names."""
    if not budget.entries:
        return ()
    hidden = {(one.cause, one.channel): one.share for one in hidden_shares(secret)}
    return tuple(
        Share(entry.cause, entry.channel, entry.share, entry.share_95ci, hidden.get((entry.cause, entry.channel), 0.0))
        for entry in budget.entries
        if entry.cause in CATALOGUE
    )


def draw_cases(campaigns: int, seed: int, plant: str) -> list[Case]:
    """Return cases in a fixed mix."""
    random = np.random.default_rng(seed)
    names = random.permutation(np.array(tuple(CATALOGUE))).tolist()
    foreign = random.permutation(np.array(tuple(OUTSIDE))).tolist()
    cases = []
    for number in range(campaigns):
        first = names[number % len(names)]
        second = str(random.choice([name for name in names if effect_group(name) != effect_group(first)]))
        kinds: list[tuple[tuple[str, ...], tuple[float, ...]]] = [
            ((first,), (1.0,)),
            ((first,), (1.0,)),
            ((first,), (1 / 3,)),
            ((first, second), (1.0, float(random.choice([1.0, 1 / 3])))),
            ((), ()),
            ((foreign[number % len(foreign)],), (1.0,)),
        ]
        effects, sizes = kinds[number % len(kinds)]
        conditions = (str(random.choice(OFF)),) if (number // len(kinds)) % 2 else ()
        cases.append(Case(seed + number, plant, effects, sizes, conditions))
    return cases


def answer(case: Case) -> Answer:
    """Simulate and diagnose a case."""
    from dragrig.api import gap_diagnose

    with tempfile.TemporaryDirectory() as folder:
        secret = draw_campaign(
            case.seed,
            effects=case.effects,
            size=case.sizes,
            rough=case.rough,
            plant=case.plant,
            conditions=case.conditions,
        )
        write_campaign(secret, Path(folder))
        diagnosis = gap_diagnose(folder)
    assert diagnosis.budget is not None
    assert diagnosis.decision_inputs is not None
    on_force = [name for name in diagnosis.budget.presence if name in diagnosis.decision_inputs.competition]
    return Answer(
        diagnosis.verdict.value,
        diagnosis.effects,
        diagnosis.ranking[0].probability,
        {name: diagnosis.budget.presence[name] for name in on_force},
        shares_of(diagnosis.budget, secret),
    )


def is_right(case: Case, said: Answer) -> bool:
    """Whether all hidden effects of the catalogue are named and no other, and a gap without any is not called none."""
    known = {name for name in case.effects if name in CATALOGUE}
    if not case.effects and not case.conditions:
        return said.verdict == "no_gap"
    return set(said.effects) == known and (not case.effects or said.verdict != "no_gap")


def main() -> None:
    """Print right verdicts, reliability and shares."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--campaigns", type=int, default=60)
    parser.add_argument("--seed", type=int, default=52000)
    parser.add_argument("--plant", default="written")
    parser.add_argument(
        "--exam", action="store_true", help="the mix of `dragrig gap blind`, instead of one to learn from"
    )
    parser.add_argument("--workers", type=int)
    parser.add_argument("--save", type=Path)
    options = parser.parse_args()
    if options.exam:
        cases = [
            Case(case.seed, case.plant, case.effects, case.sizes, case.conditions, case.rough)
            for case in hidden_cases.draw_cases(options.campaigns, options.seed, plant=options.plant)
        ]
    else:
        cases = draw_cases(options.campaigns, options.seed, options.plant)
    said = map_tasks(answer, cases, options.workers, None, no_progress)
    if options.save:
        rows = [{"case": asdict(case), "said": asdict(one)} for case, one in zip(cases, said, strict=True)]
        options.save.write_text(json.dumps(rows), "utf-8")
    report(cases, said)


def report(cases: Sequence[Case], said: Sequence[Answer]) -> None:
    """Print everything."""
    counts: Counter[tuple[str, bool]] = Counter()
    for case, one in zip(cases, said, strict=True):
        kind = {0: "none", 1: "one", 2: "two"}[len(case.effects)]
        kind = "outside" if set(case.effects) & set(OUTSIDE) else kind
        kind += ", model off" if case.conditions else ""
        right = is_right(case, one)
        counts[kind, right] += 1
        if not right:
            print(case.seed, kind, case.effects, case.sizes, case.conditions, "->", one.verdict, one.effects)
    for kind in sorted({kind for kind, _ in counts}):
        print(f"{kind}: right {counts[kind, True]} of {counts[kind, True] + counts[kind, False]}")
    pairs = [(case, one, name) for case, one in zip(cases, said, strict=True) for name in one.presence]
    present = np.array([name in case.effects for case, _, name in pairs], dtype=np.float64)
    stated = np.array([one.presence[name] for _, one, name in pairs])
    print(f"as stated: log loss {-np.sum(np.log(np.where(present > 0, stated, 1 - stated))):.1f}")
    report_shares([share for one in said for share in one.shares])
    for low, high in pairwise(BINS):
        inside = (stated >= low) & (stated < high + (high == 1.0))
        if inside.any():
            mean, there = stated[inside].mean(), present[inside].mean()
            print(f"stated {low:.1f} to {high:.1f}: {inside.sum()} effects, mean {mean:.3f}, there {there:.3f}")


def report_shares(shares: Sequence[Share]) -> None:
    """Print errors of the shares and how often their intervals hold."""
    if not shares:
        return
    errors = np.abs([share.stated - share.hidden for share in shares])
    known = [share for share in shares if share.interval is not None]
    half = [(share.interval[1] - share.interval[0]) / 2 for share in known if share.interval is not None]
    print(
        f"shares of {len(shares)} effects: {np.median(errors):.3f} off in the median, "
        f"{np.mean(errors <= 0.1):.0%} within 0.1; the interval holds in {sum(share.held for share in known)} of "
        f"{len(known)}, half as wide as {np.median(half):.3f} in the median"
    )
    for share in shares:
        if not share.held:
            print(
                "  missed", share.cause, share.channel, round(share.stated, 2), share.interval, round(share.hidden, 2)
            )


if __name__ == "__main__":
    main()
