"""What was learnt on simulated campaigns with hidden effects: thresholds, and weights of a hypothesis' features."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType

from pydantic import BaseModel, ConfigDict, Field

BY_HAND = MappingProxyType(
    {
        "known": -0.3,
        "plain": 0.7,
        "flexible": 0.4,
        "behind": -0.7,
        "further": -2.0,
        "further: alike": -2.0,
        "third": -3.0,
    }
)
"""How an effect explains as it stands counts for more where nothing is known of how foreign forms can be."""
OF_EFFECT = "is "
OF_FURTHER = f"{OF_EFFECT}further: "
"""Features that say no more than which effect it is begin so: of the first, and of those beside it."""
FILE = Path(__file__).with_name("calibration.json")


class Gate(BaseModel):
    """When a gap is seen at all.

    Attributes
    ----------
    least_gain, gain_width
        Half the squares that the best explanation takes away at which it is as likely as not, and the logistic's width.
    least_left, left_width
        The same of the excess over the number of blocks, for what no effect explains.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    least_gain: float = Field(gt=0)
    gain_width: float = Field(gt=0)
    least_left: float = Field(gt=0)
    left_width: float = Field(gt=0)


class Calibration(BaseModel):
    """Weights with where they come from.

    Attributes
    ----------
    version
        Of the file's form and of the features.
    command
        What made it.
    seeds, cases
        Of the campaigns that it was learnt on.
    gate
        When a gap is seen at all.
    weights
        Of the features; what is not named counts for nothing.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: int
    command: str
    seeds: tuple[int, ...]
    cases: int
    gate: Gate
    weights: Mapping[str, float]

    @property
    def of_any_rig(self) -> "Calibration":
        """The same thresholds with weights set by hand: campaigns of a gut teach little of a stage alone."""
        return self.model_copy(update={"weights": BY_HAND})

    def utility(self, features: Mapping[str, float]) -> float:
        """Return the logarithm of a hypothesis' odds against the unknown."""
        return sum(self.weights.get(name, 0.0) * value for name, value in features.items())


@cache
def shipped_calibration() -> Calibration:
    """Return the calibration that ships."""
    return Calibration.model_validate_json(FILE.read_text(encoding="utf-8"))
