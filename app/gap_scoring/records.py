"""What is scored: answers, diagnoses and what came of them, as their files have it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dragrig.config.errors import AnalysisError

POSITION = frozenset({"servo_lag", "velocity_ripple", "encoder_scale"})
"""Effects that show in the position channel."""
EITHER = frozenset({"channel_latency"})
"""Effects that show between the channels, so that either is right."""
SMALL = 0.2
"""Below this size an effect may be too small to see, and `no_gap` is right too."""

Verdict = Literal["effect", "several", "no_gap", "unknown"]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class Answer(_Record):
    """What is hidden in a campaign; an entry of `answers.json`."""

    verdict: Verdict
    effects: tuple[str, ...] = ()
    truth: str = ""
    form: tuple[str, ...] = ()
    size: tuple[float, ...] = ()
    nominal_slightly_wrong: bool = False

    @property
    def least(self) -> float:
        """The smallest size of its effects; 1 where sizes are not told."""
        return min(self.size, default=1.0)

    @property
    def accepted(self) -> frozenset[str]:
        """Hypotheses that are right: an effect that is too small to see may pass for no gap."""
        name = "+".join(sorted(self.effects)) if self.effects else self.verdict
        return frozenset({name, "no_gap"} if self.effects and self.least < SMALL else {name})


class Ranked(_Record):
    """A hypothesis and its probability."""

    hypothesis: str
    probability: float = Field(ge=0, le=1 + 1e-9)

    @property
    def name(self) -> str:
        """Its id, several in the order of the alphabet."""
        return "+".join(sorted(self.hypothesis.split("+")))


class Where(_Record):
    """Where the gap is, as far as it is scored."""

    channel: Mapping[str, float] = Field(default_factory=dict)


class Shrink(_Record):
    """How far a gap shrinks, as far as it is scored."""

    closed: float | None = None
    closed_95ci: tuple[float, float] | None = None


class Diagnosis(_Record):
    """What a diagnosis says, as far as it is scored."""

    verdict: Verdict
    effects: tuple[str, ...] = ()
    ranking: tuple[Ranked, ...] = ()
    confusable_with: tuple[str, ...] = ()
    where: Where = Where()
    shrink: Shrink | None = None

    @property
    def probability(self) -> float:
        """Probability of the hypothesis that stands first."""
        return max((one.probability for one in self.ranking), default=0.0)

    @property
    def named(self) -> float:
        """Probability of the likeliest hypothesis that is the name of an effect."""
        names = (one.probability for one in self.ranking if one.hypothesis not in {"no_gap", "unknown"})
        return max(names, default=0.0)

    @property
    def stated(self) -> float:
        """Probability of the verdict; that of what stands first where the ranking does not have it."""
        name = "+".join(sorted(self.effects)) or self.verdict
        return next((one.probability for one in self.ranking if one.name == name), self.probability)


@dataclass(frozen=True, slots=True)
class Case:
    """A campaign with its answer and what was said of it.

    Attributes
    ----------
    withheld
        What was said when its own effect was taken out of the catalogue; None where that was not asked.
    achieved
        How far the amended model closes the gap on fresh runs; None where there is none.
    amount
        d′ of the hidden effect; None where it was not measured.
    """

    name: str
    answer: Answer
    said: Diagnosis
    withheld: Diagnosis | None = None
    achieved: Shrink | None = None
    amount: float | None = None

    @property
    def found(self) -> bool:
        """Whether every hidden effect is named."""
        return bool(self.answer.effects) and set(self.answer.effects) <= set(self.said.effects)

    @property
    def right(self) -> bool:
        """Whether the verdict is right: all effects named, or `no_gap` or `unknown` where that is the answer."""
        if not self.answer.effects:
            return self.said.verdict == self.answer.verdict
        return self.found or (self.said.verdict == "no_gap" and self.answer.least < SMALL)

    @property
    def wrong(self) -> bool:
        """Whether the verdict misleads: not right, and not one of several effects named with no wrong one beside it."""
        part = bool(self.said.effects) and set(self.said.effects) <= set(self.answer.effects)
        return not self.right and not part

    @property
    def channel(self) -> bool:
        """Whether the channel with the largest share is the effect's."""
        shares = self.said.where.channel
        if not shares or not any(shares.values()):
            return False
        effect = self.answer.effects[0]
        return effect in EITHER or max(shares, key=lambda name: shares[name]) == (
            "position" if effect in POSITION else "force"
        )


RecordT = TypeVar("RecordT", Answer, Diagnosis, Shrink)


def read(kind: type[RecordT], given: object, name: str) -> RecordT:
    """Return what a file holds of a campaign as far as it is scored; raises `AnalysisError` where it lacks it."""
    try:
        return kind.model_validate(given)
    except ValidationError as fault:
        first = fault.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise AnalysisError(
            f"{name}: the {kind.__name__.lower()} cannot be scored because {place} is not as the report's format has "
            f"it ({first['msg'].lower()}); make it anew"
        ) from fault
