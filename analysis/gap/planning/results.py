"""What is recommended, as frozen values."""

from collections.abc import Mapping
from dataclasses import dataclass

from dragrig.config.plan import Step


@dataclass(frozen=True, slots=True)
class Contest:
    """Two hypotheses and how far runs set them apart.

    Attributes
    ----------
    truth, rival
        Effects; an empty rival stands for no effect at all.
    d_prime
        d′ between them with the first one there and the second one taking as much of it as it can.
    left
        Share of the first one's squares that the second one leaves.
    """

    truth: str
    rival: str
    d_prime: float
    left: float


@dataclass(frozen=True, slots=True)
class NextRun:
    """A run that is recommended.

    Attributes
    ----------
    step
        As a plan has it: kind, settings, repeats and the rest before it.
    minutes
        Rig time with rests and ways back, of all repeats.
    before, after
        The contest that it decides most, without it and with it.
    surer
        Whether all is answered well enough without it.
    """

    step: Step
    minutes: float
    before: Contest
    after: Contest
    surer: bool = False

    @property
    def settings(self) -> Mapping[str, object]:
        """The protocol's settings by name."""
        return self.step.parameters


@dataclass(frozen=True, slots=True)
class NextExperiment:
    """The run to make next, or several.

    Attributes
    ----------
    runs
        The best first.
    tried
        How many settings were compared.
    why
        Why, in plain words.
    """

    runs: tuple[NextRun, ...]
    tried: int
    why: str

    @property
    def minutes(self) -> float:
        """Rig time of all of them."""
        return sum(one.minutes for one in self.runs)
