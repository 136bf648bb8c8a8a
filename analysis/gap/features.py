"""Inputs of a verdict, the features computed from them, and the calibrated weights and thresholds."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import log, sqrt
from pathlib import Path
from types import MappingProxyType

from pydantic import BaseModel, ConfigDict, Field

from dragrig.sim_backend.effects.base import confusable_effects


@dataclass(frozen=True, slots=True)
class NonparametricLaw:
    """A law that bears no name: a force that is any function of one coordinate.

    Attributes
    ----------
    law
        What it is a function of.
    squares
        Whitened squares that remain, and what so many free values cost: twice the logarithm of the evidence.
    changed_mN
        By how much it changes what is predicted: root mean square where it does.
    """

    law: str
    squares: float
    changed_mN: float


@dataclass(frozen=True, slots=True)
class HypothesisSummary:
    """Effects that were refitted together, and what they leave.

    Attributes
    ----------
    effects
        Their ids, in the order in which they were taken up.
    plain, flexible
        Whitened squares that remain as they are, and when each may have a foreign form.
    changed_mN
        By how much they change what is predicted, the nominal parameters refitted: root mean square where they act.
    periodic
        Whether one of them is periodic on the session's clock, whose phase may be lost from run to run.
    gain
        Half the squares that the last of them takes away; beside others, where these do little (`doubting`).
    left
        Squares that remain without the last one, the form of the others in the same doubt.
    rival_gain
        What the best other effect takes away in its place; 0 where there is no other.
    laws
        Beside the others: the laws without a name that leave least in the place of the last of them.
    elsewhere
        What is left in runs where they add nothing, in standard deviations of chance.
    at_limit
        Whether one of them is as large as it can be, and would be larger.
    untold
        How many effects, which the nominal model leaves no place for and which were therefore not tried, may look the
        same in these runs.
    """

    effects: tuple[str, ...]
    plain: float
    flexible: float
    changed_mN: float
    periodic: bool = False
    gain: float = 0.0
    left: float = 0.0
    rival_gain: float = 0.0
    laws: tuple[NonparametricLaw, ...] = ()
    elsewhere: float = 0.0
    at_limit: bool = False
    untold: int = 0


@dataclass(frozen=True, slots=True)
class DecisionInputs:
    """All that a verdict is made of.

    Attributes
    ----------
    blocks, squares
        Of the force: number of blocks, and whitened squares that the nominal model leaves.
    tried
        Explanations of the force.
    mains_gain, line_gain
        Log likelihood ratios of lines at the mains' frequency and elsewhere.
    position
        Families of position errors with the share each explains, the best first.
    strays
        Whether there are such errors at all.
    without
        Effects that were not to be considered.
    nameless
        Laws of one coordinate that bear no name, the best first.
    """

    blocks: int
    squares: float
    tried: tuple[HypothesisSummary, ...] = ()
    mains_gain: float = 0.0
    line_gain: float = 0.0
    position: tuple[tuple[str, float], ...] = ()
    strays: bool = False
    without: tuple[str, ...] = ()
    nameless: tuple[NonparametricLaw, ...] = ()

    @property
    def excess(self) -> float:
        """Squares above noise that the nominal model leaves."""
        return self.squares - self.blocks


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
    def of_any_rig(self) -> "Calibration":
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


def hypothesis_features(found: DecisionInputs, tolerance_mN: float) -> tuple[HypothesisFeatures, ...]:
    """Return the explanations that change the force by more than what does not matter, and are no larger than can be.

    What would have to be larger than it can be is something else that resembles it, unless that leaves next to nothing.
    Several are not thought of where one of them resembles an effect that was left out of the search.
    """
    tried = [one for one in found.tried if one.changed_mN >= tolerance_mN and _is_admissible(one, found)]
    best = max((one.gain for one in tried if len(one.effects) == 1), default=0.0)
    return tuple(_features_of(one, found, best) for one in tried)


def _is_admissible(one: HypothesisSummary, found: DecisionInputs) -> bool:
    return (
        not one.at_limit or explained_share(one.plain, found) > AT_LIMIT_MIN_SHARE
    ) and not _replaces_excluded_effect(one, found)


def _replaces_excluded_effect(one: HypothesisSummary, found: DecisionInputs) -> bool:
    """Return whether several effects may do together what a single one does that was left out of the search."""
    alike = {other for name in one.effects for other in confusable_effects(name)}
    return len(one.effects) > 1 and bool(alike & set(found.without))


def chance_chi2(found: DecisionInputs) -> float:
    """Return squares above the number of blocks that may be chance."""
    return max(CHANCE_SIGMAS * sqrt(2.0 * found.blocks), NOISE_UNCERTAINTY * found.blocks)


def explained_share(squares: float, found: DecisionInputs) -> float:
    """Return the share of the excess that is explained when so many squares remain, chance not counted as left."""
    gained = max(found.squares - squares, 0.0)
    return gained / max(gained + _remaining_chi2(squares, found), 1.0)


def _remaining_chi2(squares: float, found: DecisionInputs) -> float:
    """Return the squares that remain above what may be chance."""
    return max(squares - found.blocks - chance_chi2(found), 0.0)


def _features_of(one: HypothesisSummary, found: DecisionInputs, best: float) -> HypothesisFeatures:
    flexible = explained_share(one.flexible, found)
    plain = flexible if one.periodic else explained_share(one.plain, found)
    by_form, clear = _softened_log_odds(flexible), _clipped_log(found.excess / chance_chi2(found), *CLEAR_EXCESS_RANGE)
    features = {
        "known": 1.0,
        "known, in a clear gap": clear,
        "plain": _softened_log_odds(plain),
        "plain, below half": min(_softened_log_odds(plain), 0.0),
        "plain, in a clear gap": clear * _softened_log_odds(plain),
        "flexible": by_form,
        "flexible, below half": min(by_form, 0.0),
        "flexible, in a clear gap": clear * by_form,
        "left elsewhere": log(1.0 + max(one.elsewhere, 0.0)),
        "left, much": 0.0
        if ABRUPT_EFFECTS & set(one.effects)
        else _clipped_log(_remaining_chi2(one.flexible, found) / found.blocks, *REMAINING_CHI2_RANGE),
    }
    features |= _nonparametric_features(one, found)
    features |= {
        f"{EFFECT_FEATURE}{one.effects[0]}": 1.0,
        **{f"{FURTHER_EFFECT_FEATURE}{name}": 1.0 for name in one.effects[1:]},
    }
    if len(one.effects) == 1:
        features["behind"] = (best - one.gain) / (1.0 + FORM_LOSS * best)
    else:
        features |= _further_effect_features(one, found)
    return HypothesisFeatures(one.effects, features, 0.5 * (plain + flexible))


def gap_weight(effect: str) -> float:
    """Return the part of what an effect takes away that counts for a gap."""
    return ABRUPT_WEIGHT if effect in ABRUPT_EFFECTS else 1.0


def largest_llr(found: DecisionInputs, tolerance_mN: float) -> float:
    """Return half the squares that the best explanation takes away, with a name or without, of those that matter."""
    named = [one.gain * gap_weight(one.effects[-1]) for one in found.tried if one.changed_mN >= tolerance_mN]
    nameless = [0.5 * (found.squares - one.squares) for one in found.nameless if one.changed_mN >= tolerance_mN]
    return max((*named, *nameless, 0.0))


def _nonparametric_features(one: HypothesisSummary, found: DecisionInputs) -> dict[str, float]:
    """Return by how much a law without a name does better, or worse, than the effects in any form."""
    squares = min(_chi2_of_laws(found.nameless, one.effects), default=found.squares)
    gain, nameless = (0.5 * max(found.squares - each, 0.0) for each in (one.flexible, squares))
    over = _clipped_log((nameless + NONPARAMETRIC_CHANCE_LLR) / (gain + NONPARAMETRIC_CHANCE_LLR), 0.1, 10.0)
    fewer = (_remaining_chi2(one.flexible, found) + chance_chi2(found)) / (
        _remaining_chi2(min(squares, found.squares), found) + chance_chi2(found)
    )
    return {
        "nameless": over,
        "nameless, better": max(over, 0.0),
        "nameless, leaves less": _clipped_log(fewer, 1.0, 100.0),
    }


def _chi2_of_laws(laws: Iterable[NonparametricLaw], effects: Sequence[str]) -> list[float]:
    """Return the squares that laws without a name leave, of those that none of the effects is."""
    return [law.squares for law in laws if not EFFECTS_OF_LAW.get(law.law, frozenset()) & set(effects)]


def _further_effect_features(one: HypothesisSummary, found: DecisionInputs) -> dict[str, float]:
    """Return what tells a further effect from what a foreign form of those before leaves."""
    *before, last = one.effects
    alike = any({name, last} in CONFUSABLE_PAIRS for name in before)
    by_law = 0.5 * (one.left - min(_chi2_of_laws(one.laws, [last]), default=one.left))
    over_law = _clipped_log(one.gain / max(by_law, NONPARAMETRIC_CHANCE_LLR), 0.1, 1.0) if one.laws else 0.0
    return {
        "further": 1.0,
        "third": float(len(one.effects) > 2),
        "further: share of excess": _clipped_log(2 * one.gain / max(found.excess, 1.0), 1e-3, 1.0),
        "further: over its rival": _clipped_log(one.gain / max(one.rival_gain, 1.0), 0.3, 5.0),
        "further: worse than a law": over_law,
        "further: gain": _clipped_log(one.gain, *FURTHER_LLR_RANGE),
        "further: alike": float(alike),
    }


def _clipped_log(value: float, low: float, high: float) -> float:
    return log(min(max(value, low), high))


def _softened_log_odds(value: float) -> float:
    within = min(max(value, 0.0), 1.0)
    return log((within + SHARE_SOFTENING) / (1.0 - within + SHARE_SOFTENING))
