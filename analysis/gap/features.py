"""Inputs of a verdict, the features computed from them, and the calibrated weights and thresholds."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import log, sqrt
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from dragrig.sim_backend.effects.base import confusable_effects


@dataclass(frozen=True, slots=True)
class NonparametricLaw:
    """A law that bears no name: a force that is any function of one coordinate.

    Attributes
    ----------
    name
        What it is a function of.
    chi2
        Whitened squares that remain, and what so many free values cost: twice the logarithm of the evidence.
    change_mN
        By how much it changes what is predicted: root mean square where it does.
    """

    name: Annotated[str, Field(alias="law")]
    chi2: Annotated[float, Field(alias="squares")]
    change_mN: Annotated[float, Field(alias="changed_mN")]


@dataclass(frozen=True, slots=True)
class HypothesisSummary:
    """Effects that were refitted together, and what they leave.

    Attributes
    ----------
    effects
        Their ids, in the order in which they were taken up.
    chi2, chi2_with_form_error
        Whitened squares that remain as they are, and when each may have a foreign form.
    change_mN
        By how much they change what is predicted, the nominal parameters refitted: root mean square where they act.
    periodic
        Whether one of them is periodic on the session's clock, whose phase may be lost from run to run.
    llr
        Half the squares that the last of them takes away; beside others, where these do little (`doubting`).
    chi2_without
        Squares that remain without the last one, the form of the others in the same doubt.
    rival_llr
        What the best other effect takes away in its place; 0 where there is no other.
    laws
        Beside the others: the laws without a name that leave least in the place of the last of them.
    excess_elsewhere
        What is left in runs where they add nothing, in standard deviations of chance.
    at_limit
        Whether one of them is as large as it can be, and would be larger.
    untried_lookalikes
        How many effects, which the nominal model leaves no place for and which were therefore not tried, may look the
        same in these runs.
    """

    effects: tuple[str, ...]
    chi2: Annotated[float, Field(alias="plain")]
    chi2_with_form_error: Annotated[float, Field(alias="flexible")]
    change_mN: Annotated[float, Field(alias="changed_mN")]
    periodic: bool = False
    llr: Annotated[float, Field(alias="gain")] = 0.0
    chi2_without: Annotated[float, Field(alias="left")] = 0.0
    rival_llr: Annotated[float, Field(alias="rival_gain")] = 0.0
    laws: tuple[NonparametricLaw, ...] = ()
    excess_elsewhere: Annotated[float, Field(alias="elsewhere")] = 0.0
    at_limit: bool = False
    untried_lookalikes: Annotated[int, Field(alias="untold")] = 0


@dataclass(frozen=True, slots=True)
class DecisionInputs:
    """All that a verdict is made of.

    Attributes
    ----------
    block_count, chi2
        Of the force: number of blocks, and whitened squares that the nominal model leaves.
    hypotheses
        Explanations of the force.
    mains_llr, line_llr
        Log likelihood ratios of lines at the mains' frequency and elsewhere.
    position
        Families of position errors with the share each explains, the best first.
    has_position_error
        Whether there are such errors at all.
    excluded
        Effects that were not to be considered.
    laws
        Laws of one coordinate that bear no name, the best first.
    """

    block_count: Annotated[int, Field(alias="blocks")]
    chi2: Annotated[float, Field(alias="squares")]
    hypotheses: Annotated[tuple[HypothesisSummary, ...], Field(alias="tried")] = ()
    mains_llr: Annotated[float, Field(alias="mains_gain")] = 0.0
    line_llr: Annotated[float, Field(alias="line_gain")] = 0.0
    position: tuple[tuple[str, float], ...] = ()
    has_position_error: Annotated[bool, Field(alias="strays")] = False
    excluded: Annotated[tuple[str, ...], Field(alias="without")] = ()
    laws: Annotated[tuple[NonparametricLaw, ...], Field(alias="nameless")] = ()

    @property
    def excess(self) -> float:
        """Chi-square above its expectation that the nominal model leaves."""
        return self.chi2 - self.block_count

    def document(self) -> dict[str, object]:
        """Return it as a gap report and an exam's answers store it, under the keys of their format."""
        document: dict[str, object] = TypeAdapter(DecisionInputs).dump_python(self, by_alias=True)
        return document


HAND_SET_WEIGHTS = MappingProxyType(
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
EFFECT_FEATURE = "is "
FURTHER_EFFECT_FEATURE = f"{EFFECT_FEATURE}further: "
"""Features that say no more than which effect it is begin so: of the first, and of those beside it."""
CALIBRATION_FILE = Path(__file__).with_name("calibration.json")


class GapGate(BaseModel):
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
    gate: GapGate
    weights: Mapping[str, float]

    @property
    def with_hand_set_weights(self) -> "Calibration":
        """The same thresholds with weights set by hand: campaigns of a gut teach little of a stage alone."""
        return self.model_copy(update={"weights": HAND_SET_WEIGHTS})

    def utility(self, features: Mapping[str, float]) -> float:
        """Return the logarithm of a hypothesis' odds against the unknown."""
        return sum(self.weights.get(name, 0.0) * value for name, value in features.items())


@cache
def shipped_calibration() -> Calibration:
    """Return the calibration that ships."""
    return Calibration.model_validate_json(CALIBRATION_FILE.read_text(encoding="utf-8"))


CONFUSABLE_PAIRS = frozenset(
    frozenset(pair)
    for pair in (
        ("arm_compliance", "channel_latency"),
        ("arm_compliance", "payload_inertia"),
        ("channel_latency", "payload_inertia"),
        ("payload_inertia", "stribeck"),
        ("payload_inertia", "wall_lift_off"),
        ("stribeck", "adhesion"),
        ("stribeck", "breakaway"),
        ("stribeck", "wall_inertia"),
        ("presliding", "breakaway"),
        ("wall_lift_off", "wall_inertia"),
        ("wall_lift_off", "peristalsis"),
        ("mesentery_tether", "folds"),
        ("mesentery_tether", "peristalsis"),
        ("force_drift", "peristalsis"),
        ("folds", "peristalsis"),
        ("force_hysteresis", "force_nonlinearity"),
    )
)
"""Effects that act on the same: what another form of one leaves, the other may pass for."""
EFFECTS_OF_LAW: Mapping[str, frozenset[str]] = MappingProxyType(
    {
        "place in the gut": frozenset({"mesentery_tether"}),
        "load": frozenset({"force_nonlinearity"}),
        "session": frozenset({"force_drift"}),
    }
)
"""Effects that are such a law without a name themselves: it says nothing against them."""
CHANCE_SIGMAS, NOISE_UNCERTAINTY = 2.5, 0.06
"""Squares above noise that are chance: standard deviations of χ², and the share to which noise is known at all."""
FORM_LOSS = 0.12
"""How much less, relative, the right effect may take away than a wrong one because its form is another."""
CLEAR_EXCESS_RANGE = 0.37, 55.0
"""Between these the excess over what may be chance says more, the larger it is."""
ABRUPT_EFFECTS = frozenset({"arm_compliance", "channel_latency", "payload_inertia"})
"""Effects that act where the force is steepest, of which another form leaves much; of any other it leaves little."""
ABRUPT_WEIGHT = 0.4
"""Part of what they take away that counts for a gap: jerk of a motion and steps of a programme resemble them there."""
AT_LIMIT_MIN_SHARE = 0.95
"""An effect as large as it can be that explains more than this share, just as it is, is the right one nevertheless."""
REMAINING_CHI2_RANGE = 1.0, 100.0
"""Squares above noise per block from which on what is left of a gap is more than a form makes."""
NONPARAMETRIC_CHANCE_LLR = 10.0
"""Half squares that a law without a name takes away by chance."""
FURTHER_LLR_RANGE = 5.0, 60.0
"""Half squares between which a further effect becomes sure, as far as noise goes."""
SHARE_SOFTENING = 0.02
"""Shares within this of 0 and 1 are not told from them."""


@dataclass(frozen=True, slots=True)
class HypothesisFeatures:
    """Effects that may be the ones, with what speaks for and against them."""

    effects: tuple[str, ...]
    features: Mapping[str, float]
    share: float


def hypothesis_features(inputs: DecisionInputs, tolerance_mN: float) -> tuple[HypothesisFeatures, ...]:
    """Return the explanations that change the force by more than what does not matter, and are no larger than can be.

    What would have to be larger than it can be is something else that resembles it, unless that leaves next to nothing.
    Several are not thought of where one of them resembles an effect that was left out of the search.
    """
    tried = [
        hypothesis
        for hypothesis in inputs.hypotheses
        if hypothesis.change_mN >= tolerance_mN and _is_admissible(hypothesis, inputs)
    ]
    best = max((hypothesis.llr for hypothesis in tried if len(hypothesis.effects) == 1), default=0.0)
    return tuple(_features_of(hypothesis, inputs, best) for hypothesis in tried)


def _is_admissible(hypothesis: HypothesisSummary, inputs: DecisionInputs) -> bool:
    return (
        not hypothesis.at_limit or explained_share(hypothesis.chi2, inputs) > AT_LIMIT_MIN_SHARE
    ) and not _replaces_excluded_effect(hypothesis, inputs)


def _replaces_excluded_effect(hypothesis: HypothesisSummary, inputs: DecisionInputs) -> bool:
    """Return whether several effects may do together what a single one does that was left out of the search."""
    alike = {label for name in hypothesis.effects for label in confusable_effects(name)}
    return len(hypothesis.effects) > 1 and bool(alike & set(inputs.excluded))


def chance_chi2(inputs: DecisionInputs) -> float:
    """Return squares above the number of blocks that may be chance."""
    return max(CHANCE_SIGMAS * sqrt(2.0 * inputs.block_count), NOISE_UNCERTAINTY * inputs.block_count)


def explained_share(chi2: float, inputs: DecisionInputs) -> float:
    """Return the share of the excess that is explained when so many squares remain, chance not counted as left."""
    gained = max(inputs.chi2 - chi2, 0.0)
    return gained / max(gained + _remaining_chi2(chi2, inputs), 1.0)


def _remaining_chi2(chi2: float, inputs: DecisionInputs) -> float:
    """Return the squares that remain above what may be chance."""
    return max(chi2 - inputs.block_count - chance_chi2(inputs), 0.0)


def _features_of(hypothesis: HypothesisSummary, inputs: DecisionInputs, best_llr: float) -> HypothesisFeatures:
    flexible = explained_share(hypothesis.chi2_with_form_error, inputs)
    plain = flexible if hypothesis.periodic else explained_share(hypothesis.chi2, inputs)
    by_form, clear = (
        _softened_log_odds(flexible),
        _clipped_log(inputs.excess / chance_chi2(inputs), *CLEAR_EXCESS_RANGE),
    )
    features = {
        "known": 1.0,
        "known, in a clear gap": clear,
        "plain": _softened_log_odds(plain),
        "plain, below half": min(_softened_log_odds(plain), 0.0),
        "plain, in a clear gap": clear * _softened_log_odds(plain),
        "flexible": by_form,
        "flexible, below half": min(by_form, 0.0),
        "flexible, in a clear gap": clear * by_form,
        "left elsewhere": log(1.0 + max(hypothesis.excess_elsewhere, 0.0)),
        "left, much": 0.0
        if ABRUPT_EFFECTS & set(hypothesis.effects)
        else _clipped_log(
            _remaining_chi2(hypothesis.chi2_with_form_error, inputs) / inputs.block_count, *REMAINING_CHI2_RANGE
        ),
    }
    features |= _nonparametric_features(hypothesis, inputs)
    features |= {
        f"{EFFECT_FEATURE}{hypothesis.effects[0]}": 1.0,
        **{f"{FURTHER_EFFECT_FEATURE}{name}": 1.0 for name in hypothesis.effects[1:]},
    }
    if len(hypothesis.effects) == 1:
        features["behind"] = (best_llr - hypothesis.llr) / (1.0 + FORM_LOSS * best_llr)
    else:
        features |= _further_effect_features(hypothesis, inputs)
    return HypothesisFeatures(hypothesis.effects, features, 0.5 * (plain + flexible))


def gap_weight(effect: str) -> float:
    """Return the part of what an effect takes away that counts for a gap."""
    return ABRUPT_WEIGHT if effect in ABRUPT_EFFECTS else 1.0


def largest_llr(inputs: DecisionInputs, tolerance_mN: float) -> float:
    """Return half the squares that the best explanation takes away, with a name or without, of those that matter."""
    named = [
        hypothesis.llr * gap_weight(hypothesis.effects[-1])
        for hypothesis in inputs.hypotheses
        if hypothesis.change_mN >= tolerance_mN
    ]
    nameless = [0.5 * (inputs.chi2 - law.chi2) for law in inputs.laws if law.change_mN >= tolerance_mN]
    return max((*named, *nameless, 0.0))


def _nonparametric_features(hypothesis: HypothesisSummary, inputs: DecisionInputs) -> dict[str, float]:
    """Return by how much a law without a name does better, or worse, than the effects in any form."""
    squares = min(_chi2_of_laws(inputs.laws, hypothesis.effects), default=inputs.chi2)
    gain, nameless = (0.5 * max(inputs.chi2 - value, 0.0) for value in (hypothesis.chi2_with_form_error, squares))
    over = _clipped_log((nameless + NONPARAMETRIC_CHANCE_LLR) / (gain + NONPARAMETRIC_CHANCE_LLR), 0.1, 10.0)
    fewer = (_remaining_chi2(hypothesis.chi2_with_form_error, inputs) + chance_chi2(inputs)) / (
        _remaining_chi2(min(squares, inputs.chi2), inputs) + chance_chi2(inputs)
    )
    return {
        "nameless": over,
        "nameless, better": max(over, 0.0),
        "nameless, leaves less": _clipped_log(fewer, 1.0, 100.0),
    }


def _chi2_of_laws(laws: Iterable[NonparametricLaw], effects: Sequence[str]) -> list[float]:
    """Return the squares that laws without a name leave, of those that none of the effects is."""
    return [law.chi2 for law in laws if not EFFECTS_OF_LAW.get(law.name, frozenset()) & set(effects)]


def _further_effect_features(hypothesis: HypothesisSummary, inputs: DecisionInputs) -> dict[str, float]:
    """Return what tells a further effect from what a foreign form of those before leaves."""
    *before, last = hypothesis.effects
    alike = any({name, last} in CONFUSABLE_PAIRS for name in before)
    by_law = 0.5 * (
        hypothesis.chi2_without - min(_chi2_of_laws(hypothesis.laws, [last]), default=hypothesis.chi2_without)
    )
    over_law = (
        _clipped_log(hypothesis.llr / max(by_law, NONPARAMETRIC_CHANCE_LLR), 0.1, 1.0) if hypothesis.laws else 0.0
    )
    return {
        "further": 1.0,
        "third": float(len(hypothesis.effects) > 2),
        "further: share of excess": _clipped_log(2 * hypothesis.llr / max(inputs.excess, 1.0), 1e-3, 1.0),
        "further: over its rival": _clipped_log(hypothesis.llr / max(hypothesis.rival_llr, 1.0), 0.3, 5.0),
        "further: worse than a law": over_law,
        "further: gain": _clipped_log(hypothesis.llr, *FURTHER_LLR_RANGE),
        "further: alike": float(alike),
    }


def _clipped_log(value: float, low: float, high: float) -> float:
    return log(min(max(value, low), high))


def _softened_log_odds(value: float) -> float:
    within = min(max(value, 0.0), 1.0)
    return log((within + SHARE_SOFTENING) / (1.0 - within + SHARE_SOFTENING))
