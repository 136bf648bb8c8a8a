"""Campaigns of one rig together: which effects are in all of them, in some, or in one, and how large in each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from dragrig.analysis import NORMAL_95, Exclusion, NominalModel, RunSelection, join_names, single_blas_thread
from dragrig.analysis.gap.classifier import hum_log_odds
from dragrig.analysis.gap.diagnosis import ESTABLISHED, Verdict, display_name
from dragrig.analysis.gap.pattern_odds import PatternOdds
from dragrig.analysis.gap.pooled_evidence import ForceEvidence, force_evidence
from dragrig.analysis.gap.pooled_force import PooledCause, odds_of_own_diagnoses, pool_force, random_effects_mean
from dragrig.analysis.gap.presence import PRIOR_PROBABILITIES, CauseKind
from dragrig.analysis.gap.weighing import DiagnosisOptions, weigh_causes
from dragrig.config import AnalysisError
from dragrig.sim_backend.effects import find_effect, hum_effect

MIN_CAMPAIGNS = 2
STRAYING = (
    "the stage strays from its command ({}): pooling does not tell small effects on the force from errors of its "
    "motion, and names none that no campaign shows alone"
)
FAINT_HUM = "mains hum is no gap of any campaign alone: below the tolerance there, or not sure"


class Where(StrEnum):
    """In which of the campaigns an effect is."""

    ALL = "all"
    SOME = "some"
    ONE = "one"


@dataclass(frozen=True, slots=True)
class PopulationSize:
    """The size of an effect in the campaigns that have it."""

    parameter: str
    """Name of the effect's size."""
    unit: str
    mean: float
    """Over the campaigns that have it."""
    standard_error: float
    spread: float
    """Standard deviation between campaigns, beyond their errors."""
    campaigns: tuple[tuple[float, float] | None, ...]
    """Size in each campaign with its standard error; None where these runs do not show it. All other shapes are those
    that fit all campaigns best."""

    @property
    def interval_95(self) -> tuple[float, float]:
        """95 % interval of the mean."""
        half = NORMAL_95 * self.standard_error
        return self.mean - half, self.mean + half


@dataclass(frozen=True, slots=True)
class PooledEffect:
    """An effect in several campaigns."""

    effect: str
    """Its id."""
    of_rig: bool
    """Whether it belongs to the rig; else to the gut."""
    probability: float
    """That it is in any campaign."""
    where: Where
    """In which campaigns it most likely is, if in any."""
    where_probabilities: Mapping[Where, float]
    """Of each pattern, if it is in any."""
    presence: tuple[float, ...]
    """Probability that it is in each campaign."""
    alone: tuple[float, ...]
    """The same from each campaign alone."""
    size: PopulationSize | None
    """None where no campaign shows any."""
    confusable_with: tuple[str, ...] = ()
    """Effects that these campaigns cannot tell from it."""

    @property
    def established(self) -> bool:
        """Whether it is named."""
        return self.probability > ESTABLISHED

    @property
    def members(self) -> tuple[int, ...]:
        """Numbers of the campaigns that have it, from 0."""
        if self.where is Where.ALL:
            return tuple(range(len(self.presence)))
        if self.where is Where.ONE:
            return (int(np.argmax(self.presence)),)
        return tuple(at for at, value in enumerate(self.presence) if value > ESTABLISHED)


@dataclass(frozen=True, slots=True, eq=False)
class CampaignEvidence:
    """The evidence of one campaign, alone and to be pooled."""

    source: str
    """Its folder."""
    specimen: str
    runs: int
    """Number of runs."""
    verdict: Verdict
    """Of its diagnosis alone, as are effects and probability."""
    effects: tuple[str, ...]
    probability: float
    """NaN for an open verdict."""
    presence: Mapping[str, float]
    """Probability that each effect is there, from this campaign alone."""
    force: ForceEvidence
    """Its evidence on the force."""
    line_sizes: Mapping[str, tuple[float, float]]
    """Sizes and standard errors of effects that are found in position or spectrum, by id."""
    hum_log_odds: float = -np.inf
    """Of hum of any size: below the tolerance it is no gap of one campaign, and yet the rig's."""
    backends: tuple[str, ...] = ()
    nominal: str = ""
    left_out: tuple[Exclusion, ...] = ()
    """Runs that were not used."""
    remarks: tuple[str, ...] = ()
    """Of the choice of runs."""
    only_condition: str = ""
    """Condition of the runs in words where they have no other; else empty."""


@single_blas_thread()
def campaign_evidence(
    source: str, selection: RunSelection, nominal: NominalModel, options: DiagnosisOptions | None = None
) -> CampaignEvidence:
    """Return the evidence of a campaign, the runs of a folder, alone and to be pooled; raises as `diagnose`."""
    weighed = weigh_causes(selection, nominal, options, all_periods=True)
    selection, verdict, competition = weighed.selection, weighed.verdict, weighed.causes.competition
    only_condition = weighed.study.only_condition
    sizes = dict[str, tuple[float, float]]()
    candidate, line = weighed.position.candidate, weighed.faint_lines.mains
    if candidate is not None:
        at = candidate.fitted_parameters.index(candidate.effect.size)
        sizes[candidate.effect.id] = candidate.values[candidate.effect.size.name], weighed.position.standard_errors[at]
    log_odds_of_hum = -np.inf
    if hum_effect().id not in weighed.options.excluded and line.llr > 0 and line.amplitude > 0:
        log_odds_of_hum = hum_log_odds(line.llr, weighed.faint_lines.non_mains.llr)
        sizes[hum_effect().id] = line.amplitude, line.amplitude / float(np.sqrt(2 * line.llr))
    probabilities, total = verdict.probabilities, sum(verdict.probabilities.values())
    stated = "+".join(verdict.effects) or verdict.verdict.value
    return CampaignEvidence(
        source,
        selection.specimen,
        len(selection.experiments),
        Verdict.OPEN if only_condition else verdict.verdict,
        () if only_condition else verdict.effects,
        np.nan if only_condition else probabilities.get(stated, max(probabilities.values(), default=0.0)) / total,
        weighed.presence,
        force_evidence(competition, weighed.causes.presence, competition.periodic),
        sizes,
        log_odds_of_hum,
        selection.backends,
        nominal.name,
        selection.left_out,
        selection.remarks,
        only_condition,
    )


@dataclass(frozen=True, slots=True, eq=False)
class PooledDiagnosis:
    """The diagnosis of several campaigns of one rig together."""

    campaigns: tuple[CampaignEvidence, ...]
    """The evidence of each alone."""
    effects: tuple[PooledEffect, ...]
    """All effects that were looked for, the most probable first."""
    unnamed: Mapping[str, float]
    """Probability of each shared deviation without a name, of the model or a free law, those above one half."""
    remarks: tuple[str, ...] = ()
    """Remarks on the choice of campaigns and runs."""

    @property
    def only_condition(self) -> str:
        """Condition in words of all runs of all campaigns where they have no other; else empty."""
        first = self.campaigns[0].only_condition
        return first if all(campaign.only_condition == first for campaign in self.campaigns) else ""

    @property
    def established(self) -> tuple[PooledEffect, ...]:
        """Effects that are named, the rig's first; none from a single condition."""
        named = [effect for effect in self.effects if effect.established and not self.only_condition]
        return tuple(sorted(named, key=lambda effect: (not effect.of_rig, effect.where is not Where.ALL)))


def diagnose_together(campaigns: Sequence[CampaignEvidence], remarks: Sequence[str] = ()) -> PooledDiagnosis:
    """Say which effects are in all, some, or one of several campaigns of a rig.

    Raises
    ------
    AnalysisError
        For fewer than two campaigns.
    """
    if len(campaigns) < MIN_CAMPAIGNS:
        raise AnalysisError("there are no two campaigns to pool: name two or more whose runs differ.")
    names = dict.fromkeys(name for campaign in campaigns for name in campaign.presence)
    by_odds = [_effect_by_odds(name, campaigns) for name in names if not find_effect(name).has_force_signature]
    named = [name for campaign in campaigns for name in campaign.effects]
    named += [effect.effect for effect in by_odds if effect.established]
    straying = dict.fromkeys(name for name in named if find_effect(name).moves_stage)
    alone = {name: np.array([campaign.presence.get(name, 0.0) for campaign in campaigns]) for name in names}
    pooled = pool_force([campaign.force for campaign in campaigns], alone, stage_strays=bool(straying))
    if any(
        effect.effect == hum_effect().id and effect.established and max(effect.alone) <= ESTABLISHED
        for effect in by_odds
    ):
        remarks = (*remarks, FAINT_HUM)
    if straying:
        remarks = (*remarks, STRAYING.format(join_names([display_name(name) for name in straying])))
    effects = [
        _pooled_effect(name, cause, campaigns)
        for name, cause in pooled.items()
        if cause.evidence.kinds[name] is CauseKind.EFFECT
    ]
    effects += by_odds
    unnamed = {
        name: cause.probability
        for name, cause in pooled.items()
        if cause.evidence.kinds[name] is not CauseKind.EFFECT and cause.probability > ESTABLISHED
    }
    return PooledDiagnosis(
        tuple(campaigns), tuple(sorted(effects, key=lambda effect: -effect.probability)), unnamed, tuple(remarks)
    )


def _pooled_effect(name: str, cause: PooledCause, campaigns: Sequence[CampaignEvidence]) -> PooledEffect:
    effect = _with_patterns(name, cause.odds, cause.probability, campaigns)
    sizes = cause.evidence.sizes(name, cause.odds.scale)
    alike = tuple(rival for rival in cause.confusable_with if cause.evidence.kinds[rival] is CauseKind.EFFECT)
    return replace(effect, size=_population(name, sizes, effect.members), confusable_with=alike)


def _with_patterns(
    name: str, odds: PatternOdds, probability: float, campaigns: Sequence[CampaignEvidence]
) -> PooledEffect:
    logs = {Where.ALL: odds.everywhere, Where.SOME: odds.some, Where.ONE: float(np.logaddexp.reduce(odds.single))}
    shares = {where: float(np.exp(value - odds.total)) for where, value in logs.items()}
    single = np.exp(odds.single - odds.total)
    presence = probability * np.clip(shares[Where.ALL] + shares[Where.SOME] * odds.members + single, 0.0, 1.0)
    return PooledEffect(
        name,
        not find_effect(name).belongs_to_gut,
        probability,
        max(shares, key=lambda where: shares[where]),
        shares,
        tuple(presence.tolist()),
        tuple(campaign.presence.get(name, 0.0) for campaign in campaigns),
        None,
    )


def _effect_by_odds(name: str, campaigns: Sequence[CampaignEvidence]) -> PooledEffect:
    """Pool an effect of the position or of the spectrum by the evidence of each campaign alone."""
    from scipy.special import expit

    alone = np.array([campaign.presence.get(name, PRIOR_PROBABILITIES["effect"]) for campaign in campaigns])
    if name == hum_effect().id:
        alone = np.maximum(alone, expit([campaign.hum_log_odds for campaign in campaigns]))
    odds = odds_of_own_diagnoses(alone, of_rig=not find_effect(name).belongs_to_gut)
    effect = _with_patterns(name, odds, float(expit(odds.total)), campaigns)
    sizes = [campaign.line_sizes.get(name) for campaign in campaigns]
    return replace(effect, size=_population(name, sizes, effect.members))


def _population(
    name: str, sizes: Sequence[tuple[float, float] | None], members: Sequence[int]
) -> PopulationSize | None:
    """Return mean and spread of the sizes of those campaigns that have the effect."""
    known = [size for at in members if (size := sizes[at]) is not None]
    if not known:
        return None
    parameter = find_effect(name).size
    mean, error, spread = random_effects_mean(known)
    return PopulationSize(parameter.name, parameter.unit, mean, error, spread, tuple(sizes))
