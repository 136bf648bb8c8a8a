"""Which effects are hidden in the campaigns of an exam: a balanced mix, drawn from one seed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.sim_backend.blind import CATALOGUE, OUTSIDE, Secret, draw

EXAM, LEARNING = "exam", "learning"
SHARES = {
    "full": 0.40,
    "third": 0.15,
    "tenth": 0.10,
    "none": 0.10,
    "outside": 0.10,
    "pair": 0.07,
    "rough": 0.08 * 2 / 3,
    "rough none": 0.08 / 3,
}
"""Of each kind of case; single effects go through the whole vocabulary in turn."""
MIXES = {
    EXAM: SHARES,
    LEARNING: {
        "full": 0.35,
        "third": 0.13,
        "tenth": 0.06,
        "none": 0.06,
        "outside": 0.14,
        "pair": 0.16,
        "rough": 0.07,
        "rough none": 0.03,
    },
}
"""An exam has what rigs may have; to learn from, there is more of what is hard."""


@dataclass(frozen=True, slots=True)
class Case:
    """What is to be hidden in one campaign.

    Attributes
    ----------
    kind
        One of `SHARES`: an effect at full size, a third or a tenth of it; nothing; an effect that the catalogue does
        not have; two effects; and with nominal equations that are slightly wrong, an effect or nothing.
    """

    number: int
    kind: str
    seed: int
    effects: tuple[str, ...]
    sizes: tuple[float, ...]
    rough: bool

    @property
    def name(self) -> str:
        """The number as names of folders and files have it."""
        return f"{self.number:04d}"

    @property
    def secret(self) -> Secret:
        """The campaign with all that is hidden in it."""
        return draw(self.seed, effects=self.effects, size=self.sizes, rough=self.rough)

    @property
    def single(self) -> bool:
        """Whether one effect of the catalogue is hidden."""
        return len(self.effects) == 1 and self.effects[0] in CATALOGUE


def mix(cases: int, seed: int, which: str = EXAM) -> list[Case]:
    """Return a balanced mix in random order; counts follow the shares as nearly as whole numbers allow."""
    random = np.random.default_rng(seed)
    shares = MIXES[which]
    exact = np.array([share * cases for share in shares.values()])
    counts = np.floor(exact).astype(int)
    counts[np.argsort(counts - exact)[: cases - int(counts.sum())]] += 1
    kinds = [kind for kind, count in zip(shares, counts.tolist(), strict=True) for _ in range(count)]
    singles, foreign = _in_turn(tuple(CATALOGUE), random), _in_turn(tuple(OUTSIDE), random)
    made = []
    for kind in kinds:
        effects, sizes = _hidden(kind, singles, foreign, random)
        made.append((kind, effects, sizes))
    order = random.permutation(len(made)).tolist()
    seeds = random.integers(1, 2**31, len(made)).tolist()
    return [
        Case(number, made[at][0], own, made[at][1], made[at][2], rough=made[at][0].startswith("rough"))
        for number, (at, own) in enumerate(zip(order, seeds, strict=True), 1)
    ]


def _in_turn(names: Sequence[str], random: np.random.Generator) -> Iterator[str]:
    while True:
        yield from random.permutation(np.array(names)).tolist()


def _hidden(
    kind: str, singles: Iterator[str], foreign: Iterator[str], random: np.random.Generator
) -> tuple[tuple[str, ...], tuple[float, ...]]:
    if kind in {"none", "rough none"}:
        return (), ()
    if kind == "outside":
        return (next(foreign),), (1.0,)
    if kind == "pair":
        first, second = next(singles), next(singles)
        while _place(first) == _place(second):
            second = next(singles)
        return (first, second), (1.0, 1.0 if random.random() < 0.5 else 1 / 3)
    return (next(singles),), ({"third": 1 / 3, "tenth": 1 / 10}.get(kind, 1.0),)


def _place(name: str) -> str:
    return CATALOGUE[name][0].__module__
