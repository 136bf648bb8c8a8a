"""Inputs of a verdict, the features computed from them, and what is learnt: weights and thresholds."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from math import log, sqrt
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from dragrig.sim_backend.effects import Effect, catalogue, confusable_effects, similar_effects


@dataclass(frozen=True, slots=True)
class NonparametricLaw:
    """A fit of the force as any smooth function of one coordinate."""

    name: Annotated[str, Field(alias="law")]
    """The coordinate."""
    chi2: Annotated[float, Field(alias="squares")]
    """Minus twice the log evidence: chi-square plus the Occam factor of the free values."""
    change_mN: Annotated[float, Field(alias="changed_mN")]
    """Rms force of the law where it acts."""


EXCHANGE = "exchange of the specimen"
"""Name of a cause: runs after it are of another specimen, and nobody recorded that."""
EQUAL_SHARE = 0.05
"""Difference of the explained shares of the excess within which one hypothesis explains as much as another."""
MANY_LOOKALIKES = 20
"""Causes of which any may look like an effect that runs do not establish: as many as a catalogue has."""


@dataclass(frozen=True, slots=True)
class HypothesisSummary:
    """Numbers of a hypothesis that the verdict uses."""

    effects: tuple[str, ...]
    """Ids of its effects, in the order of selection."""
    chi2: Annotated[float, Field(alias="plain")]
    """Chi-square without form error of the effects."""
    chi2_with_form_error: Annotated[float, Field(alias="flexible")]
    change_mN: Annotated[float, Field(alias="changed_mN")]
    """Rms change of the prediction, nominal parameters refitted, where it changes."""
    periodic: bool = False
    """Whether one of the effects is periodic in session time, so that its phase may be lost between runs."""
    llr: Annotated[float, Field(alias="gain")] = 0.0
    """Log likelihood ratio of the last effect; beside others with their form error (`inflate_by_form_error`)."""
    chi2_without: Annotated[float, Field(alias="left")] = 0.0
    """Chi-square without the last effect, with the same form error."""
    laws: tuple[NonparametricLaw, ...] = ()
    """Best nonparametric laws in place of the last of several effects."""
    excess_elsewhere: Annotated[float, Field(alias="elsewhere")] = 0.0
    """Excess chi-square in runs without any force of the effects, in standard deviations of chance."""
    at_limit: bool = False
    """Whether an effect has its largest possible size."""
    untried_lookalikes: Annotated[int, Field(alias="untold")] = 0
    """Number of effects that could not be tried with this nominal model and may look alike in these runs."""
    not_established: str = ""
    """Why these runs do not establish its effects although they fit, half a sentence; empty where they may."""

    @property
    def lookalikes(self) -> int:
        """Number of other causes that look like its effects in these runs, each as likely as they are."""
        return max(self.untried_lookalikes, MANY_LOOKALIKES if self.not_established else 0)


@dataclass(frozen=True, slots=True)
class DecisionInputs:
    """All numbers that a verdict is based on."""

    block_count: Annotated[int, Field(alias="blocks")]
    """Number of blocks of the force."""
    chi2: Annotated[float, Field(alias="squares")]
    """Chi-square of the nominal model."""
    hypotheses: Annotated[tuple[HypothesisSummary, ...], Field(alias="tried")] = ()
    """Hypotheses that were fitted to the force."""
    mains_llr: Annotated[float, Field(alias="mains_gain")] = 0.0
    """Log likelihood ratio of a spectral line at the mains frequency."""
    line_llr: Annotated[float, Field(alias="line_gain")] = 0.0
    """Log likelihood ratio of a line elsewhere."""
    position: tuple[tuple[str, float], ...] = ()
    """Effects by the model class of the position error, with their held-out shares, the best first."""
    has_position_error: Annotated[bool, Field(alias="strays")] = False
    """Whether the position deviates from the command."""
    excluded: Annotated[tuple[str, ...], Field(alias="without")] = ()
    """Effects left out of the search."""
    laws: Annotated[tuple[NonparametricLaw, ...], Field(alias="nameless")] = ()
    """Nonparametric laws beside the nominal model, the best first."""
    moves_astray: bool = False
    """Whether the stage itself deviates, not only its record."""
    competition: Mapping[str, float] = field(default_factory=dict)
    """Probability that each cause is there by the competition of causes, unnamed ones included; empty where it was not
    judged."""
    by_model: Mapping[str, float] = field(default_factory=dict)
    """Probability by the same that the nominal model's own laws are in the place of an effect."""

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
"""For a stage alone and models of one's own, about which campaigns of a gut teach little: with weights learnt there,
measured motors and dampers get a latency, a payload and a drift that nobody has published. The exact form counts
more where the size of form errors is not known from training."""
CALIBRATION_FILE = Path(__file__).with_name("calibration.json")


class GapGate(BaseModel):
    """Probability that a gap exists at all, as logistic functions."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    least_gain: float = Field(gt=0)
    gain_width: float = Field(gt=0)
    """`least_gain`, `gain_width`: log likelihood ratio of the best hypothesis at probability 0.5, and width of the
    logistic.
    """
    least_left: float = Field(gt=0)
    left_width: float = Field(gt=0)
    """`least_left`, `left_width`: the same for the excess over the number of blocks, for gaps that no effect explains.
    """


class PresenceWeights(BaseModel):
    """Log odds that an effect on the force is there: a constant, and weights of two log odds.

    Neither estimate is enough: the classifier takes one effect for another where the nominal model is wrong, the
    competition of causes adds effects where one large effect has another form.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    constant: float
    classifier: float
    competition: float


class VerdictCalibration(BaseModel):
    """What is learnt from campaigns with known hidden effects, with its origin. No number is of a single effect."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: int
    """Version of file format and features."""
    command: str
    """Command that made it."""
    seeds: tuple[int, ...]
    """Seeds of the training campaigns."""
    cases: int
    """Their number."""
    gate: GapGate
    """Probability that a gap exists."""
    weights: Mapping[str, float]
    """Weight of each feature; features not named have weight 0."""
    presence: PresenceWeights
    """How classifier and competition decide together whether an effect is there."""

    @property
    def with_hand_set_weights(self) -> "VerdictCalibration":
        """The same gate and presence with hand-set weights."""
        return self.model_copy(update={"weights": HAND_SET_WEIGHTS})

    def utility(self, features: Mapping[str, float]) -> float:
        """Return the log odds of a hypothesis against `unknown`."""
        return sum(self.weights.get(name, 0.0) * value for name, value in features.items())


@cache
def shipped_calibration() -> VerdictCalibration:
    """Return the shipped calibration."""
    return VerdictCalibration.model_validate_json(CALIBRATION_FILE.read_text(encoding="utf-8"))


CHANCE_SIGMAS, NOISE_UNCERTAINTY = 2.5, 0.06
"""Chi-square above its expectation counts as chance up to 2.5 standard deviations, or the relative uncertainty of the
noise level."""
FORM_LOSS = 0.12
"""Relative log likelihood ratio that the right effect may lose to a wrong one because of its form error."""
CLEAR_EXCESS_RANGE = 0.37, 55.0
"""Range of the ratio of excess to chance over which a gap becomes clear."""
ABRUPT_WEIGHT = 0.4
"""Weight of abrupt effects in the gate: jerk of a motion and integration steps resemble them."""
AT_LIMIT_MIN_SHARE = 0.95
"""An effect at its limit is admitted only if it explains more than this share in its exact form."""
REMAINING_CHI2_RANGE = 1.0, 100.0
"""Range of remaining chi-square per block beyond which form error is no explanation."""
NONPARAMETRIC_CHANCE_LLR = 10.0
"""Log likelihood ratio that a nonparametric law reaches by chance."""
FURTHER_LLR_RANGE = 5.0, 60.0
"""Range of the log likelihood ratio over which a further effect becomes certain."""
SHARE_SOFTENING = 0.02
"""Shares closer than this to 0 or 1 are not distinguished from them."""


@dataclass(frozen=True, slots=True)
class HypothesisFeatures:
    """A hypothesis with its features and the share of the excess that it explains."""

    effects: tuple[str, ...]
    features: Mapping[str, float]
    share: float


def hypothesis_features(inputs: DecisionInputs, tolerance_mN: float) -> tuple[HypothesisFeatures, ...]:
    """Return the features of all admissible hypotheses with a relevant change of the force.

    A hypothesis at its size limit is something else that resembles it, unless it leaves next to nothing. Several
    effects are not considered where one of them is confusable with an excluded effect.
    """
    admissible = [
        hypothesis
        for hypothesis in inputs.hypotheses
        if hypothesis.change_mN >= tolerance_mN and _is_admissible(hypothesis, inputs)
    ]
    singles = [(single, _share_of(single, inputs)) for single in admissible if len(single.effects) == 1]

    def best_llr(hypothesis: HypothesisSummary) -> float:
        # What is not established puts nothing behind it that explains as much.
        enough = _share_of(hypothesis, inputs) + EQUAL_SHARE
        rivals = (rival.llr for rival, share in singles if not rival.lookalikes or share > enough)
        return max((hypothesis.llr, *rivals))

    return tuple(_features_of(hypothesis, inputs, best_llr(hypothesis)) for hypothesis in admissible)


def _exact_share(hypothesis: HypothesisSummary, inputs: DecisionInputs) -> float:
    return explained_share(hypothesis.chi2_with_form_error if hypothesis.periodic else hypothesis.chi2, inputs)


def _share_of(hypothesis: HypothesisSummary, inputs: DecisionInputs) -> float:
    """Return the share of the excess that a hypothesis explains, averaged over the forms without and with error."""
    return 0.5 * (_exact_share(hypothesis, inputs) + explained_share(hypothesis.chi2_with_form_error, inputs))


def _is_admissible(hypothesis: HypothesisSummary, inputs: DecisionInputs) -> bool:
    if hypothesis.at_limit and explained_share(hypothesis.chi2, inputs) <= AT_LIMIT_MIN_SHARE:
        return False
    confusable = {alias for effect in hypothesis.effects for alias in confusable_effects(effect)}
    return len(hypothesis.effects) == 1 or not confusable & set(inputs.excluded)


def chance_chi2(inputs: DecisionInputs) -> float:
    """Return the chi-square above its expectation that may be chance."""
    return max(CHANCE_SIGMAS * sqrt(2.0 * inputs.block_count), NOISE_UNCERTAINTY * inputs.block_count)


def explained_share(chi2: float, inputs: DecisionInputs) -> float:
    """Return the share of the excess that is explained at this chi-square; chance counts as explained."""
    explained = max(inputs.chi2 - chi2, 0.0)
    return explained / max(explained + _remaining_chi2(chi2, inputs), 1.0)


def _remaining_chi2(chi2: float, inputs: DecisionInputs) -> float:
    """Return the chi-square above expectation and chance."""
    return max(chi2 - inputs.block_count - chance_chi2(inputs), 0.0)


def _features_of(hypothesis: HypothesisSummary, inputs: DecisionInputs, best_llr: float) -> HypothesisFeatures:
    form_error_odds = _softened_log_odds(explained_share(hypothesis.chi2_with_form_error, inputs))
    clear = _clipped_log(inputs.excess / chance_chi2(inputs), *CLEAR_EXCESS_RANGE)
    features = {
        "known": 1.0,
        "plain": _softened_log_odds(_exact_share(hypothesis, inputs)),
        "flexible": form_error_odds,
        "flexible, below half": min(form_error_odds, 0.0),
        "flexible, in a clear gap": clear * form_error_odds,
        "left elsewhere": log(1.0 + max(hypothesis.excess_elsewhere, 0.0)),
        "left, much": 0.0
        if any(effect.abrupt for effect in _catalogued(hypothesis.effects))
        else _clipped_log(
            _remaining_chi2(hypothesis.chi2_with_form_error, inputs) / inputs.block_count, *REMAINING_CHI2_RANGE
        ),
        **_nonparametric_features(hypothesis, inputs),
    }
    if len(hypothesis.effects) == 1:
        features["behind"] = (best_llr - hypothesis.llr) / (1.0 + FORM_LOSS * best_llr)
    else:
        features |= _further_effect_features(hypothesis, inputs)
    return HypothesisFeatures(hypothesis.effects, features, _share_of(hypothesis, inputs))


def gap_weight(effect: str) -> float:
    """Return the weight of an effect's log likelihood ratio in the gate."""
    return ABRUPT_WEIGHT if any(known.abrupt for known in _catalogued([effect])) else 1.0


def largest_llr(inputs: DecisionInputs, tolerance_mN: float) -> float:
    """Return the largest weighted log likelihood ratio of relevant effects and nonparametric laws."""
    effects = [
        hypothesis.llr * gap_weight(hypothesis.effects[-1])
        for hypothesis in inputs.hypotheses
        if hypothesis.change_mN >= tolerance_mN
    ]
    laws = [0.5 * (inputs.chi2 - law.chi2) for law in inputs.laws if law.change_mN >= tolerance_mN]
    return max((*effects, *laws, 0.0))


def _nonparametric_features(hypothesis: HypothesisSummary, inputs: DecisionInputs) -> dict[str, float]:
    """Return how much better the best nonparametric law explains the gap than the effects."""
    law_chi2 = min(_chi2_of_laws(inputs.laws, hypothesis.effects), default=inputs.chi2)
    llr, law_llr = (0.5 * max(inputs.chi2 - chi2, 0.0) for chi2 in (hypothesis.chi2_with_form_error, law_chi2))
    log_ratio = _clipped_log((law_llr + NONPARAMETRIC_CHANCE_LLR) / (llr + NONPARAMETRIC_CHANCE_LLR), 0.1, 10.0)
    remaining_ratio = (_remaining_chi2(hypothesis.chi2_with_form_error, inputs) + chance_chi2(inputs)) / (
        _remaining_chi2(min(law_chi2, inputs.chi2), inputs) + chance_chi2(inputs)
    )
    return {
        "nameless, better": max(log_ratio, 0.0),
        "nameless, leaves less": _clipped_log(remaining_ratio, 1.0, 100.0),
    }


def _chi2_of_laws(laws: Iterable[NonparametricLaw], effects: Sequence[str]) -> list[float]:
    """Return the chi-square of laws that are not equivalent to one of the effects."""
    own_laws = {effect.free_law for effect in _catalogued(effects)}
    return [law.chi2 for law in laws if law.name not in own_laws]


def _catalogued(effects: Iterable[str]) -> list[Effect]:
    known = catalogue()
    return [known[name] for name in effects if name in known]


def _further_effect_features(hypothesis: HypothesisSummary, inputs: DecisionInputs) -> dict[str, float]:
    """Return features that separate a further effect from form error of the effects before it."""
    *others, last = hypothesis.effects
    similar = any(name in similar_effects(last) for name in others)
    law_llr = 0.5 * (
        hypothesis.chi2_without - min(_chi2_of_laws(hypothesis.laws, [last]), default=hypothesis.chi2_without)
    )
    log_ratio = (
        _clipped_log(hypothesis.llr / max(law_llr, NONPARAMETRIC_CHANCE_LLR), 0.1, 1.0) if hypothesis.laws else 0.0
    )
    return {
        "further": 1.0,
        "third": float(len(hypothesis.effects) > 2),
        "further: share of excess": _clipped_log(2 * hypothesis.llr / max(inputs.excess, 1.0), 1e-3, 1.0),
        "further: worse than a law": log_ratio,
        "further: gain": _clipped_log(hypothesis.llr, *FURTHER_LLR_RANGE),
        "further: alike": float(similar),
    }


def _clipped_log(value: float, low: float, high: float) -> float:
    return log(min(max(value, low), high))


def _softened_log_odds(value: float) -> float:
    within = min(max(value, 0.0), 1.0)
    return log((within + SHARE_SOFTENING) / (1.0 - within + SHARE_SOFTENING))
