"""Print how often campaigns of one rig, pooled, name what is hidden in them, beside what each says alone.

`python bench/together.py [--groups 12] [--seed 81000] [--plant written|drawn] [--workers N] [--keep FOLDER]`: groups of
five campaigns of the blind plant, each on a specimen of its own, with an effect at a tenth of its size in all of them;
an effect of the rig at a third in all; the same beside an effect of the gut at a tenth; an effect of the gut at full
size in one of five; and nothing. The rates have
Wilson's 95 % intervals. `--keep` stores the evidence of each campaign, from which a second call goes on.
`--count N` instead times `dragrig.gap_diagnose_together` on the files of N campaigns of all kinds, and of a
fifth of them.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import argparse
import pickle
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from zlib import crc32

import numpy as np

import dragrig
from dragrig.analysis import find_model, no_progress
from dragrig.analysis.gap import (
    CampaignEvidence,
    PooledDiagnosis,
    Where,
    campaign_evidence,
    choose_runs,
    diagnose_together,
)
from dragrig.parallel import map_tasks
from dragrig.scoring import wilson_rate
from dragrig.sim_backend.blind import (
    CATALOGUE,
    RIG_GROUPS,
    BlindCampaign,
    draw_campaign,
    effect_group,
    write_campaign,
)
from dragrig.sim_backend.blind.effects.hidden_effect import HiddenEffect

SPECIMENS = 5
EMPTY_CAMPAIGNS = 20
SPECIMEN_SPREAD = 0.25
"""Relative spread of the size of an effect of the gut between specimens, of its logarithm."""


@dataclass(frozen=True, slots=True)
class Member:
    """One campaign: the seed of its specimen, and the effects that it shares with others, drawn from their own seed."""

    seed: int
    plant: str
    effect: str = ""
    size: float = 0.0
    effect_seed: int = 0
    of_rig: str = ""
    """An effect of the rig beside it, at a third."""

    @property
    def name(self) -> str:
        """Name that tells it from all others."""
        return f"{self.plant}-{self.seed}-{self.effect or 'none'}-{self.size:.3f}{self.of_rig}"


@dataclass(frozen=True, slots=True)
class Group:
    """Campaigns that are pooled, and where the effect is in truth; None for nowhere."""

    case: str
    effect: str
    where: Where | None
    members: tuple[Member, ...]

    @property
    def hidden(self) -> set[str]:
        """All effects that are there."""
        return {name for member in self.members for name in (member.effect, member.of_rig)} - {""}


@dataclass(frozen=True, slots=True)
class Answer:
    """What campaigns together, and each alone, say of the hidden effect and of others."""

    named: bool
    placed: bool
    false_names: int
    alone: int
    with_effect: int
    false_alone: int


def draw_groups(groups: int, seed: int, plant: str) -> list[Group]:
    """Return the groups of all cases; those with nothing share their campaigns with those with an effect in one."""
    random = np.random.default_rng(seed)
    rig = [name for name in CATALOGUE if effect_group(name) in RIG_GROUPS]
    gut = [name for name in CATALOGUE if name not in rig]
    empty = [Member(seed + number, plant) for number in range(EMPTY_CAMPAIGNS)]
    found = []
    for case, names, size, many, first in (
        ("the rig's, a third in all", rig, 1 / 3, groups // 2, 20_000),
        ("a tenth in all", tuple(CATALOGUE), 0.1, groups, 1_000),
    ):
        order = random.permutation(np.array(names)).tolist()
        for number in range(many):
            effect, at = order[number % len(order)], seed + first + 10 * number
            members = tuple(Member(at + one, plant, effect, size, at) for one in range(SPECIMENS))
            found.append(Group(case, effect, Where.ALL, members))
    order = random.permutation(np.array(gut)).tolist()
    beside = random.permutation(np.array(rig)).tolist()
    for number in range(groups // 2):
        effect, of_rig, at = order[number % len(order)], beside[number % len(beside)], seed + 60_000 + 10 * number
        members = tuple(Member(at + one, plant, effect, 0.1, at, of_rig) for one in range(SPECIMENS))
        found.append(Group("the gut's at a tenth, the rig's at a third", effect, Where.ALL, members))
    for number in range(groups):
        effect, at = order[number % len(order)], seed + 40_000 + 10 * number
        others = [empty[place] for place in random.permutation(EMPTY_CAMPAIGNS)[: SPECIMENS - 1].tolist()]
        found.append(Group("in one of five", effect, Where.ONE, (Member(at, plant, effect, 1.0, at), *others)))
    found += [
        Group("nothing", "", None, tuple(empty[first : first + SPECIMENS]))
        for first in range(0, EMPTY_CAMPAIGNS, SPECIMENS)
    ]
    return found


def other_specimen(campaign: BlindCampaign, seed: int) -> BlindCampaign:
    """Return a campaign of the same rig on another specimen, with the same hidden effects.

    Those of the rig are the same in form and parameters. Those of the gut keep their form; their size scatters between
    specimens, and what is periodic has a phase of its own. Specimen, noise, programme and variations are those of
    `draw_campaign` with the seed.
    """
    drawn = draw_campaign(seed, runs=campaign.programme, plant=campaign.plant, conditions=campaign.conditions)
    random = np.random.default_rng((seed, crc32(b"effects of another specimen")))
    effects = [
        effect if effect_group(effect.name) in RIG_GROUPS else in_other_gut(effect, random)
        for effect in campaign.effects
    ]
    return replace(drawn, effects=tuple(effects), sizes=campaign.sizes)


def in_other_gut(effect: HiddenEffect, random: np.random.Generator) -> HiddenEffect:
    """Return an effect of the gut as another specimen has it."""
    values = dict(effect.parameters)
    values["amplitude"] *= float(np.exp(SPECIMEN_SPREAD * random.standard_normal()))
    for name in values:
        if name == "phase" or name.endswith("_phase"):
            values[name] = float(random.uniform(0.0, 2 * np.pi))
    return replace(effect, parameters=values)


def write_member(member: Member, folder: Path) -> None:
    """Simulate one campaign into a folder."""
    campaign = draw_campaign(member.seed, plant=member.plant)
    if member.effect:
        names, sizes = [member.effect], [member.size]
        if member.of_rig:
            names, sizes = [*names, member.of_rig], [*sizes, 1 / 3]
        first = draw_campaign(member.effect_seed, effects=names, size=sizes, plant=member.plant)
        campaign = other_specimen(first, member.seed)
    write_campaign(campaign, folder)


def evidence_of(member: Member, keep: Path) -> CampaignEvidence:
    """Simulate and diagnose one campaign, or return what is kept of it."""
    kept = keep / f"{member.name}.pickle"
    if kept.exists():
        found = pickle.loads(kept.read_bytes())  # written by this program
        assert isinstance(found, CampaignEvidence)
        return found
    with tempfile.TemporaryDirectory(prefix="together-") as folder:
        write_member(member, Path(folder))
        evidence = campaign_evidence(member.name, choose_runs(Path(folder)), find_model("capsule"))
    kept.write_bytes(pickle.dumps(evidence))
    return evidence


def answer(group: Group, pooled: PooledDiagnosis) -> Answer:
    """Compare a pooled diagnosis with the truth."""
    established = {effect.effect: effect for effect in pooled.established}
    found = established.get(group.effect)
    placed = found is not None and found.where is group.where and (found.where is Where.ALL or found.members == (0,))
    having = pooled.campaigns[: 1 if group.where is Where.ONE else None] if group.effect else ()
    alone = sum(group.effect in campaign.effects for campaign in having)
    wrong = [name for campaign in pooled.campaigns for name in campaign.effects if name not in group.hidden]
    return Answer(found is not None, placed, len(established.keys() - group.hidden), alone, len(having), len(wrong))


def rate(count: int, of: int) -> str:
    """Return a rate with its interval."""
    found = wilson_rate("", [True] * count + [False] * (of - count))
    return f"{count} of {of} ({found.low:.2f} to {found.high:.2f})"


def print_rates(groups: Sequence[Group], answers: Sequence[Answer]) -> None:
    """Print the rates of each case, and the groups that were not right."""
    for case in dict.fromkeys(group.case for group in groups):
        here = [found for group, found in zip(groups, answers, strict=True) if group.case == case]
        print(f"{case}: {len(here)} groups")
        if case != "nothing":
            print(f"  named                {rate(sum(one.named for one in here), len(here))}")
            print(f"  and told where       {rate(sum(one.placed for one in here), len(here))}")
            print(
                f"  one campaign alone   {rate(sum(one.alone for one in here), sum(one.with_effect for one in here))}"
            )
        print(f"  groups with a wrong name {rate(sum(one.false_names > 0 for one in here), len(here))}")
        print(f"  wrong names of single campaigns {sum(one.false_alone for one in here)} in {SPECIMENS * len(here)}")


def print_times(members: Sequence[Member], workers: int | None, temporary: Path, keep: Path) -> None:
    """Print how long a fifth of the campaigns, and all of them, take together, from their files."""
    folders = [temporary / f"{number:03d}" for number in range(len(members))]
    for folder in folders:
        folder.mkdir()
    map_tasks(partial(_write, dict(zip(folders, members, strict=True))), folders, workers, None, no_progress)
    for count in (len(folders) // 5, len(folders)):
        start = perf_counter()
        pooled = dragrig.gap_diagnose_together(folders[:count], workers=workers)
        wall_s = perf_counter() - start
        print(
            f"{count} campaigns, {sum(campaign.runs for campaign in pooled.campaigns)} runs: {wall_s:.0f} s", flush=True
        )
    for member, evidence in zip(members, pooled.campaigns, strict=True):
        (keep / f"{member.name}.pickle").write_bytes(pickle.dumps(replace(evidence, source=member.name)))


def _write(members: dict[Path, Member], folder: Path) -> None:
    write_member(members[folder], folder)


def main() -> None:
    """Simulate, diagnose, pool, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--groups", type=int, default=12)
    parser.add_argument("--seed", type=int, default=81000)
    parser.add_argument("--plant", default="written")
    parser.add_argument("--workers", type=int)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--count", type=int, default=0)
    settings = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="together-") as temporary:
        keep = settings.keep or Path(temporary)
        keep.mkdir(parents=True, exist_ok=True)
        groups = draw_groups(settings.groups, settings.seed, settings.plant)
        members = list(dict.fromkeys(member for group in groups for member in group.members))
        if settings.count:
            print_times(members[: settings.count], settings.workers, Path(temporary), keep)
            return
        start = perf_counter()

        def told(done: int, of: int) -> None:
            if done % 20 == 0:
                print(f"{done} of {of} campaigns, {perf_counter() - start:.0f} s", flush=True)

        found = map_tasks(partial(evidence_of, keep=keep), members, settings.workers, None, told)
        evidence = dict(zip(members, found, strict=True))
    answers = []
    for group in groups:
        pooled = diagnose_together([replace(evidence[member], source=member.name) for member in group.members])
        answers.append(answer(group, pooled))
        told_names = ", ".join(f"{one.effect} {one.where.value}" for one in pooled.established) or "nothing"
        print(f"{group.case}: {' + '.join(sorted(group.hidden)) or '-'} → {told_names}", flush=True)
    print_rates(groups, answers)


if __name__ == "__main__":
    main()
