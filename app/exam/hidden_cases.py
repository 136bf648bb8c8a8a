"""The cases of an exam: what is hidden in each campaign, in shares that a mix prescribes.

Two plants make them. `written` has a few forms of each effect, which are written down: exams to learn from. `drawn` has
laws drawn at random; its specimens may be exchanged, its campaigns incomplete, its nominal model off and its noise of
another kind: exams to judge by, which nobody may tune to.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from dragrig.sim_backend.blind import (
    CATALOGUE,
    IN_DRAGS,
    IN_ONE_STROKE,
    OUTSIDE,
    PLANTS,
    BlindCampaign,
    draw_campaign,
    effect_group,
)

EXAM_MIX, LEARNING_MIX, CONDITIONS_MIX, MOTION_MIX = "exam", "learning", "conditions", "motion"
WRITTEN_PLANT, DRAWN_PLANT = PLANTS
_Shares = Mapping[str, float]
EXAM_SHARES: _Shares = MappingProxyType(
    {
        "full": 0.40,
        "third": 0.15,
        "tenth": 0.10,
        "none": 0.10,
        "outside": 0.10,
        "pair": 0.07,
        "rough": 0.08 * 2 / 3,
        "rough none": 0.08 / 3,
    }
)
"""Share of each kind of case; single effects cycle through the whole catalogue of the plant."""
CONDITION_SHARES: _Shares = MappingProxyType(
    {
        "full": 0.22,
        "third": 0.08,
        "tenth": 0.05,
        "none": 0.04,
        "outside": 0.08,
        "pair": 0.10,
        "rough": 0.03,
        "rough none": 0.02,
        "incomplete": 0.04,
        "incomplete none": 0.03,
        "programme": 0.04,
        "programme none": 0.02,
        "exchanged": 0.02,
        "exchanged none": 0.03,
        "model off": 0.05,
        "model off none": 0.04,
        "noise": 0.04,
        "noise none": 0.07,
    }
)
"""The same with circumstances; a kind with `none` has nothing hidden, under the same condition."""
MIXES: Mapping[str, _Shares] = MappingProxyType(
    {
        EXAM_MIX: EXAM_SHARES,
        LEARNING_MIX: {
            "full": 0.35,
            "third": 0.13,
            "tenth": 0.06,
            "none": 0.06,
            "outside": 0.14,
            "pair": 0.16,
            "rough": 0.07,
            "rough none": 0.03,
        },
        CONDITIONS_MIX: CONDITION_SHARES,
        MOTION_MIX: {"motion": 0.5, "motion third": 0.15, "motion tenth": 0.1, "motion none": 0.25},
    }
)
"""An exam has campaigns as rigs may have them; to learn from, there are more hard cases, and under conditions a third
is incomplete, of another programme, noise or specimen, or has a nominal model that is off. In the last, every stage
moves as drives do."""
CONDITIONS_OF: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "incomplete": ("drags only", "three speeds", "no relaxations", "one run", "no blanks"),
        "programme": ("other programme", "other capsule", "other programme", "250 Hz", "1000 Hz"),
        "exchanged": ("exchanged, not recorded", "exchanged"),
        "motion": ("jerk-limited", "position loop", "position loop"),
        "model off": tuple(f"{what} {part} % off" for part in (10, 5, 20) for what in ("parameters", "laws", "both")),
        "noise": (
            *("1/f noise", "jitter", "hum", "12 bits", "impulses", "100 Hz", "dropouts"),
            *("14 bits", "50 Hz", "2000 Hz", "13 bits", "10000 Hz", "15 bits"),
        ),
    }
)
"""Conditions that a kind of case takes in turn."""


@dataclass(frozen=True, slots=True)
class HiddenCase:
    """What is hidden in one campaign."""

    number: int
    kind: str
    """One of `EXAM_SHARES`: an effect at full size, a third or a tenth of it; nothing; an effect that the catalogue
    does not have; two effects; and with nominal equations that are slightly wrong, an effect or nothing. Or one of
    `CONDITION_SHARES`, or of the mix of motions.
    """
    seed: int
    effects: tuple[str, ...]
    sizes: tuple[float, ...]
    rough: bool
    plant: str = WRITTEN_PLANT
    conditions: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The number as in names of folders and files."""
        return f"{self.number:04d}"

    @property
    def secret(self) -> BlindCampaign:
        """The campaign with its hidden effects."""
        return draw_campaign(
            self.seed,
            effects=self.effects,
            size=self.sizes,
            rough=self.rough,
            plant=self.plant,
            conditions=self.conditions,
        )

    @property
    def single(self) -> bool:
        """Whether one effect of the catalogue is hidden."""
        return len(self.effects) == 1 and self.effects[0] in CATALOGUE


def draw_cases(cases: int, seed: int, which: str = EXAM_MIX, plant: str = WRITTEN_PLANT) -> list[HiddenCase]:
    """Return a balanced mix in random order; counts follow the shares as nearly as whole numbers allow.

    The drawn plant always has conditions.
    """
    random = np.random.default_rng(seed)
    shares = MIXES[CONDITIONS_MIX if plant == DRAWN_PLANT and which != MOTION_MIX else which]
    exact = np.array([share * cases for share in shares.values()])
    counts = np.floor(exact).astype(int)
    counts[np.argsort(counts - exact)[: cases - int(counts.sum())]] += 1
    kinds = [kind for kind, count in zip(shares, counts.tolist(), strict=True) for _ in range(count)]
    foreign_names = ("outside",) if plant == DRAWN_PLANT else tuple(OUTSIDE)
    singles, foreign = _shuffled_cycle(tuple(CATALOGUE), random), _shuffled_cycle(foreign_names, random)
    hidden = [(kind, *_draw_effects(kind, singles, foreign, random)) for kind in kinds]
    order = random.permutation(len(hidden)).tolist()
    seeds = random.integers(1, 2**31, len(hidden)).tolist()
    found = [
        HiddenCase(number, kind, case_seed, effects, sizes, rough=kind.startswith("rough"), plant=plant)
        for number, (case_seed, (kind, effects, sizes)) in enumerate(
            zip(seeds, (hidden[place] for place in order), strict=True), 1
        )
    ]
    return _with_conditions(found, random) if plant == DRAWN_PLANT or which in {CONDITIONS_MIX, MOTION_MIX} else found


def _shuffled_cycle(names: Sequence[str], random: np.random.Generator) -> Iterator[str]:
    while True:
        yield from random.permutation(np.array(names)).tolist()


def _draw_effects(
    kind: str, singles: Iterator[str], foreign: Iterator[str], random: np.random.Generator
) -> tuple[tuple[str, ...], tuple[float, ...]]:
    if kind.endswith("none"):
        return (), ()
    if kind == "outside":
        return (next(foreign),), (1.0,)
    if kind == "pair":
        first, second = next(singles), next(singles)
        while effect_group(first) == effect_group(second):
            second = next(singles)
        return (first, second), (1.0, 1.0 if random.random() < 0.5 else 1 / 3)
    return (next(singles),), ({"third": 1 / 3, "tenth": 1 / 10}.get(kind.removeprefix("motion "), 1.0),)


def _with_conditions(cases: Sequence[HiddenCase], random: np.random.Generator) -> list[HiddenCase]:
    """Give each case the next condition of its kind, and an effect that the campaign can show."""
    turns = {kind: _shuffled_cycle(names, random) for kind, names in CONDITIONS_OF.items()}
    with_conditions = []
    for case in cases:
        turn = turns["motion"] if case.kind.startswith("motion") else turns.get(case.kind.removesuffix(" none"))
        if turn is None:
            with_conditions.append(case)
            continue
        condition, shown = next(turn), case.effects
        if case.effects and condition in {"one run", "drags only"}:
            names = IN_ONE_STROKE if condition == "one run" else IN_DRAGS
            shown = (str(random.choice(names)),)
        with_conditions.append(replace(case, effects=shown, conditions=(condition,)))
    return with_conditions


FINEST_MEASURED_HZ = 500.0


def hidden_amounts(case: HiddenCase) -> Mapping[str, object]:
    """Return the larger d′ of the hidden effects, in the force or in the position, and the share of each cause.

    A campaign that is sampled faster is measured as at 500 Hz.
    """
    from dragrig.sim_backend.blind.effect_sizes import effect_size, hidden_shares, nuisance_directions

    secret = case.secret
    runs = tuple(replace(run, rate_hz=min(run.rate_hz, FINEST_MEASURED_HZ)) for run in secret.runs)
    secret = replace(secret, runs=runs)
    directions = nuisance_directions(secret)
    size = effect_size(secret, directions)
    budget = [
        {
            "cause": share.cause,
            "channel": share.channel,
            "share": share.share,
            "rms": share.rms,
            "refitted_rms": share.refitted_rms,
            "unit": "mm" if share.channel == "position" else "mN",
            "runs": list(share.run_rms),
        }
        for share in hidden_shares(secret, directions)
    ]
    return {"d": max(size.force, size.position), "budget": budget}
