"""Campaigns of one rig together: which effects are in all of them, in some, or in one, and how large in each.

What belongs to the rig is the same in all campaigns; what belongs to the gut is a population with a spread. In which
campaigns a cause is, `pattern_odds` tells. Causes compete: they are chosen one by one, each beside those chosen before
it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from itertools import product
from math import log

import numpy as np

from dragrig.analysis import NORMAL_95, Exclusion
from dragrig.analysis.gap.classifier import MOTION_ERROR_LOG_ODDS
from dragrig.analysis.gap.diagnose import DiagnosisWithCauses
from dragrig.analysis.gap.diagnosis import ESTABLISHED, MAX_PROBABILITY, MIN_PROBABILITY, Verdict
from dragrig.analysis.gap.pattern_odds import PatternOdds, SharedInformation, independent_odds, pattern_odds
from dragrig.analysis.gap.pooled_evidence import ForceEvidence, SharedColumns, force_evidence
from dragrig.analysis.gap.presence import KEPT_VARIANCE, PRIOR_PROBABILITIES, CauseKind
from dragrig.config import AnalysisError
from dragrig.rig import FloatArray, IndexArray
from dragrig.sim_backend.effects import find_effect, hum_effect

MAX_SHARED_COLUMNS = 6
RIG_SPREADS = (0.0, 0.05)
"""Shares of the variance by which what belongs to the rig differs between campaigns: forms seen at other specimens."""
GUT_SPREADS = (0.03, 0.2, 0.6)
LAW_SPREADS = (0.03, 0.2)
MAX_POOLED = 12
MIN_CAMPAIGNS = 2
CONFUSABLE_SHARE = 0.2
"""A rival that would be there in a cause's place with more than this share of its probability is not told from it."""
FORM_SHARE, UNLIKELY_LOG_ODDS = 0.15, -1.0
"""Other forms of a cause leave up to this share of its log evidence to its lookalikes: real ones leave 10 to 40 % of an
effect, 1 to 16 % of its squares. A lookalike of less is at most so likely."""
EXPLAINED_LOG_ODDS = 3.0
"""An effect that loses more than this beside chosen ones is what these are taken for in some campaign alone."""
MIN_LOG_ODDS = 0.0
"""Causes are chosen while the best further one is at least as likely there as not."""


@dataclass(frozen=True, eq=False)
class PooledForce:
    """The evidence of several campaigns on the force, some causes projected out."""

    campaigns: tuple[ForceEvidence, ...]
    chosen: tuple[str, ...] = ()

    @cached_property
    def kinds(self) -> Mapping[str, CauseKind]:
        """Kind of each cause."""
        return {name: shared.kind for campaign in self.campaigns for name, shared in campaign.columns.items()}

    def beside(self, name: str, odds: PatternOdds) -> "PooledForce":
        """Return the evidence beside a cause, of which each campaign that has it has its own size and form.

        Where it is in more than one campaign, it is allowed for in all.
        """
        alone = int(np.argmax(odds.single)) if odds.in_one else None
        campaigns = [
            _projected_out(campaign, name, odds.scale) if alone is None or at == alone else campaign
            for at, campaign in enumerate(self.campaigns)
        ]
        return PooledForce(tuple(campaigns), (*self.chosen, name))

    def odds(self, name: str) -> PatternOdds:
        """Return in which campaigns a cause is, beside those chosen."""
        kind = self.kinds[name]
        effect = find_effect(name) if kind is CauseKind.EFFECT else None
        of_rig = effect is not None and not effect.belongs_to_gut
        if effect is not None and effect.phase is not None:
            return self._periodic_odds(name)
        spreads = LAW_SPREADS if effect is None else RIG_SPREADS if of_rig else GUT_SPREADS
        return pattern_odds(list(self._settings(name, spreads)), kind, of_rig=of_rig)

    def _settings(self, name: str, spreads: Sequence[float]) -> Iterator[tuple[float, float, SharedInformation]]:
        having = [campaign.columns.get(name) for campaign in self.campaigns]
        found = [shared for shared in having if shared is not None]
        numbers = np.unique(np.concatenate([shared.numbers for shared in found]))
        sizes = _common_sizes(found, numbers)
        scales = found[0].scales
        weight = -log(2 * len(scales) * len(spreads))
        products = self._gathered(name, numbers)
        grams, _ = _without_forms(products, sizes, 0.0)
        values, vectors = np.linalg.eigh(grams.sum(axis=0))
        kept = int(np.searchsorted(np.cumsum(values[::-1]), KEPT_VARIANCE * values.sum())) + 1
        basis = vectors[:, ::-1][:, : min(kept, MAX_SHARED_COLUMNS)]
        direction = basis.sum(axis=0) if found[0].one_signed else None
        # Small effects show nothing of their other forms, and large ones do: all campaigns have either.
        for (at, scale), with_forms in product(enumerate(scales), (False, True)):
            grams, moments = _without_forms(products, sizes, scale if with_forms else 0.0)
            offsets = np.array(
                [self._offset(campaign, name, at if with_forms else None) for campaign in self.campaigns]
            )
            gram = basis.T @ grams @ basis
            moment = moments @ basis
            for spread in spreads:
                yield weight, scale, SharedInformation.of(gram, moment, offsets, scale**2, spread, direction)

    def _offset(self, campaign: ForceEvidence, name: str, at: int | None) -> float:
        """Return the log Bayes factor of a campaign beyond that of the shared columns.

        What chosen causes explain is no merit of this one's other forms, and no merit of the campaign's other causes.

        Parameters
        ----------
        at
            Number of the scale whose other forms count; None for the catalogue's form alone.
        """
        shared = campaign.columns.get(name)
        if shared is None:
            return 0.0
        forms = 0.0 if at is None else shared.forms[at]
        if not self.chosen:
            return forms + shared.elsewhere
        explained = 0.5 * (shared.chi2 - float(campaign.information_for(name)[0, 0]))
        return min(forms, 0.0) + min(shared.elsewhere + explained, 0.0)

    def _gathered(self, name: str, numbers: IndexArray) -> FloatArray:
        """Return the products of residual, shared columns and forms of a cause, shape `(C, 1 + n + r, 1 + n + r)`."""
        having = [campaign.columns.get(name) for campaign in self.campaigns]
        forms = max(shared.form_rows.size for shared in having if shared is not None)
        products = np.zeros((len(having), 1 + numbers.size + forms, 1 + numbers.size + forms))
        for campaign, shared, into in zip(self.campaigns, having, products, strict=True):
            if shared is None:
                continue
            rows = np.concatenate(([0], shared.rows, shared.form_rows))
            places = np.concatenate(
                (
                    [0],
                    1 + np.searchsorted(numbers, shared.numbers),
                    1 + numbers.size + np.arange(shared.form_rows.size),
                )
            )
            into[places[:, None], places] = campaign.information_for(name)[rows[:, None], rows]
        return products

    def _periodic_odds(self, name: str) -> PatternOdds:
        """Return the odds of a periodic effect, whose phase and amplitude are each campaign's own."""
        having = [campaign.columns.get(name) for campaign in self.campaigns]
        found = [shared for shared in having if shared is not None]
        numbers = np.unique(np.concatenate([shared.numbers for shared in found]))
        grams, moments = _without_forms(self._gathered(name, numbers), _common_sizes(found, numbers), 0.0)
        pairs = np.flatnonzero(np.diff(numbers // 2) == 0)
        # Columns have sd `scale` over the root of their number: at a period there are two.
        ratio = numbers.size / 2
        rows = np.stack((pairs, pairs + 1), axis=1)
        gram = ratio * grams[:, rows[:, :, None], rows[:, None, :]]
        moment = np.sqrt(ratio) * moments[:, rows]
        factors = []
        for scale in found[0].scales:
            root = np.linalg.cholesky(np.eye(2) + scale**2 * gram)
            fitted = np.linalg.solve(root, scale * moment[..., None])[..., 0]
            log_det = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
            factors.append((0.5 * (fitted**2).sum(axis=-1) - log_det).T)
        of_rig = not find_effect(name).belongs_to_gut
        scales = np.repeat(found[0].scales, len(pairs)).tolist()
        return independent_odds(np.concatenate(factors), scales, of_rig=of_rig)

    def sizes(self, name: str, scale: float) -> tuple[tuple[float, float] | None, ...]:
        """Return the size of an effect in each campaign with its standard error, in the shape that fits all best.

        In the unit of its parameter of size; None where a campaign does not show it.
        """
        effect = find_effect(name)
        found = [campaign.columns[name] for campaign in self.campaigns if name in campaign.columns]
        numbers = np.unique(np.concatenate([shared.numbers for shared in found]))
        grams, moments = _without_forms(self._gathered(name, numbers), np.ones(numbers.size), scale)
        grams, moments = grams * numbers.size, moments * np.sqrt(numbers.size)
        width = 1 if effect.phase is None else 2
        firsts = np.flatnonzero(np.isin(numbers + width - 1, numbers) & (numbers % width == 0))
        rows = firsts[:, None] + np.arange(width)
        gram = grams[:, rows[:, :, None], rows[:, None, :]]
        strength = np.trace(gram, axis1=-2, axis2=-1)[..., None, None] / width
        amplitude = np.linalg.solve(
            gram + 1e-9 * strength * np.eye(width) + 1e-12 * np.eye(width), moments[:, rows, None]
        )
        best = int(np.argmax(np.einsum("cvi,cvi->v", amplitude[..., 0], moments[:, rows])))
        default = effect.size.default
        return tuple(
            (default * float(value), abs(default) * float(information) ** -0.5) if information > 1e-9 else None
            for value, information in zip(
                _amplitude(amplitude[:, best, :, 0]).tolist(), strength[:, best, 0, 0].tolist(), strict=True
            )
        )


def _without_forms(products: FloatArray, sizes_mN: FloatArray, scale: float) -> tuple[FloatArray, FloatArray]:
    """Return information matrices and vectors of a cause in all campaigns, as `normalised` does in one."""
    count = sizes_mN.size
    unit = 1.0 / (sizes_mN * np.sqrt(count))
    kept = products[:, : 1 + count, : 1 + count]
    if products.shape[1] > 1 + count and scale > 0:
        own = np.eye(products.shape[1] - 1 - count) + scale**2 * products[:, 1 + count :, 1 + count :]
        cross = scale * products[:, 1 + count :, : 1 + count]
        kept = kept - cross.transpose(0, 2, 1) @ np.linalg.solve(own, cross)
    return kept[:, 1:, 1:] * np.outer(unit, unit), kept[:, 1:, 0] * unit


def _amplitude(values: FloatArray) -> FloatArray:
    return np.asarray(values[:, 0] if values.shape[1] == 1 else np.hypot(*values.T))


def _common_sizes(found: Sequence[SharedColumns], numbers: IndexArray) -> FloatArray:
    """Return the size of each column at its default, the geometric mean of the campaigns, shape `(n,)`."""
    logs, counts = np.zeros(numbers.size), np.zeros(numbers.size)
    for shared in found:
        rows = np.searchsorted(numbers, shared.numbers)
        logs[rows] += np.log(shared.sizes_mN)
        counts[rows] += 1
    return np.asarray(np.exp(logs / counts))


def _projected_out(campaign: ForceEvidence, name: str, scale: float) -> ForceEvidence:
    shared = campaign.columns.get(name)
    if shared is None:
        return campaign
    rows = np.concatenate((shared.rows, shared.form_rows))
    sds = np.concatenate((scale / (shared.sizes_mN * np.sqrt(len(shared.rows))), np.full(shared.form_rows.size, scale)))
    if shared.one_signed is False and not shared.form_rows.size and shared.kind is CauseKind.EFFECT:
        sds = sds * np.sqrt(len(shared.rows) / 2)
    return replace(campaign, contexts=tuple(_without(values, rows, sds) for values in campaign.contexts))


def _without(information: FloatArray, rows: IndexArray, sds: FloatArray) -> FloatArray:
    precision = np.eye(rows.size) + information[np.ix_(rows, rows)] * np.outer(sds, sds)
    explained = np.linalg.solve(np.linalg.cholesky(precision), information[rows] * sds[:, None])
    return np.asarray(information - explained.T @ explained, dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class PooledCause:
    """A cause in several campaigns.

    Attributes
    ----------
    odds
        In which it is, beside all other causes that are there.
    evidence
        What all campaigns say beside those.
    probability
        That it is in any, its lookalikes in its place considered.
    confusable_with
        Causes that may be there in its place.
    """

    odds: PatternOdds
    evidence: PooledForce
    probability: float
    confusable_with: tuple[str, ...]


Alone = Mapping[str, FloatArray]
"""Probability that each effect is there, from each campaign alone, shape `(C,)`."""


def credible_log_odds(name: str, odds: PatternOdds, evidence: PooledForce, alone: Alone) -> float:
    """Return the log odds that a cause is there which the campaigns support.

    Pooling adds nothing to what a single campaign says of an effect that it alone has, and its own diagnosis weighs
    more; an effect whose size is positive is none where it comes out negative.
    """
    if name not in alone or not np.isfinite(odds.total):
        return odds.total
    if odds.in_one:
        single = np.exp(odds.single - np.logaddexp.reduce(odds.single))
        probability = float(single @ np.clip(alone[name], MIN_PROBABILITY, MAX_PROBABILITY))
        return min(odds.total, log(probability / (1 - probability)))
    if odds.total > MIN_LOG_ODDS and find_effect(name).size.low >= 0:
        value, weight = 0.0, 0.0
        for size in filter(None, evidence.sizes(name, odds.scale)):
            value, weight = value + size[0] / size[1] ** 2, weight + size[1] ** -2
        if value < 0:
            return -np.inf
    return odds.total


def pool_force(campaigns: Sequence[ForceEvidence], alone: Alone) -> Mapping[str, PooledCause]:
    """Return how likely each shared cause is, beside the others that are there, by name."""
    nothing = PooledForce(tuple(campaigns))
    first = {name: nothing.odds(name) for name in nothing.kinds}
    chosen, evidence, odds = dict[str, PatternOdds](), nothing, first

    def believed(name: str) -> float:
        log_odds = credible_log_odds(name, odds[name], evidence, alone)
        effects = [value.total for name, value in chosen.items() if nothing.kinds[name] is CauseKind.EFFECT]
        if _is_form_error(first[name].total, odds[name].total, effects):
            return min(log_odds, UNLIKELY_LOG_ODDS)
        return log_odds

    while len(chosen) < MAX_POOLED:
        likely = [name for name in odds if believed(name) >= MIN_LOG_ODDS]
        if not likely:
            break
        best = max(likely, key=lambda name: odds[name].total)
        chosen[best] = odds[best]
        evidence = evidence.beside(best, odds[best])
        odds = {name: evidence.odds(name) for name in odds if name != best}
    found = {name: PooledCause(odds[name], evidence, _logistic(believed(name)), ()) for name in odds}
    rivals = tuple(name for name in odds if first[name].total - odds[name].total > EXPLAINED_LOG_ODDS)
    for name in found.keys() & alone.keys() - set(rivals):
        likely_alone = float(alone[name].max())
        # What a campaign's own diagnosis names, and no chosen cause explains, stays.
        if likely_alone > max(ESTABLISHED, found[name].probability):
            found[name] = PooledCause(_in_one(alone[name]), evidence, likely_alone, ())
    for cause, value in _chosen_causes(chosen, rivals, nothing, alone):
        if cause in chosen or value.probability > found[cause].probability:
            found[cause] = value
    return found


def _is_form_error(first: float, beside: float, chosen: Sequence[float]) -> bool:
    """Return whether a cause is what another form of a chosen one leaves, by its log odds alone and beside these."""
    explained = first - beside > EXPLAINED_LOG_ODDS
    return explained and beside < FORM_SHARE * max(chosen, default=0.0)


def _chosen_causes(
    chosen: Mapping[str, PatternOdds], further: Sequence[str], nothing: PooledForce, alone: Alone
) -> Iterator[tuple[str, PooledCause]]:
    """Yield each chosen cause beside all others, and those that may be there in its place."""
    for name in chosen:
        beside = nothing
        for other in chosen:
            beside = beside if other == name else beside.beside(other, chosen[other])
        yield from _chosen_cause(name, further, beside, alone)


def _chosen_cause(
    name: str, further: Sequence[str], beside: PooledForce, alone: Alone
) -> Iterator[tuple[str, PooledCause]]:
    """Yield a chosen cause, and those that may be there in its place."""
    own = beside.odds(name)
    value = credible_log_odds(name, own, beside, alone)
    if value < own.total:
        yield name, PooledCause(own, beside, _logistic(value), ())
        return
    rivals = {rival: beside.odds(rival) for rival in further}
    logs = {rival: credible_log_odds(rival, odds, beside, alone) for rival, odds in rivals.items()}
    total = float(np.logaddexp.reduce([0.0, own.total, *logs.values()]))
    alike = tuple(rival for rival, log_odds in logs.items() if log_odds > own.total + log(CONFUSABLE_SHARE))
    yield name, PooledCause(own, beside, float(np.exp(own.total - total)), alike)
    for rival in alike:
        yield rival, PooledCause(rivals[rival], beside, float(np.exp(logs[rival] - total)), (name,))


def _less_likely(probability: float, stage_strays: bool) -> float:
    limited = min(max(probability, 1e-12), 1.0 - 1e-12)
    return _logistic(log(limited / (1 - limited)) - stage_strays * MOTION_ERROR_LOG_ODDS)


def _in_one(alone: FloatArray) -> PatternOdds:
    """Return the odds of an effect that only one campaign shows, by its own diagnosis."""
    limited = np.clip(alone, MIN_PROBABILITY, MAX_PROBABILITY)
    return PatternOdds(-np.inf, -np.inf, np.log(limited / (1 - limited)), np.zeros(alone.size), 1.0)


def _logistic(value: float) -> float:
    return float(1.0 / (1.0 + np.exp(-np.clip(value, -40.0, 40.0))))


class Where(StrEnum):
    """In which of the campaigns an effect is."""

    ALL = "all"
    SOME = "some"
    ONE = "one"


@dataclass(frozen=True, slots=True)
class PopulationSize:
    """The size of an effect in the campaigns that have it.

    Attributes
    ----------
    parameter, unit
        Of the effect's size.
    mean, standard_error
        Over the campaigns that have it.
    spread
        Standard deviation between campaigns, beyond their errors.
    campaigns
        Size in each campaign with its standard error; None where these runs do not show it. All other shapes are those
        that fit all campaigns best.
    """

    parameter: str
    unit: str
    mean: float
    standard_error: float
    spread: float
    campaigns: tuple[tuple[float, float] | None, ...]

    @property
    def interval_95(self) -> tuple[float, float]:
        """95 % interval of the mean."""
        half = NORMAL_95 * self.standard_error
        return self.mean - half, self.mean + half


@dataclass(frozen=True, slots=True)
class PooledEffect:
    """An effect in several campaigns.

    Attributes
    ----------
    effect
        Its id.
    of_rig
        Whether it belongs to the rig; else to the gut.
    probability
        That it is in any campaign.
    where
        In which campaigns it most likely is, if in any.
    where_probabilities
        Of each pattern, if it is in any.
    presence
        Probability that it is in each campaign.
    alone
        The same from each campaign alone.
    size
        None where no campaign shows any.
    confusable_with
        Effects that these campaigns cannot tell from it.
    """

    effect: str
    of_rig: bool
    probability: float
    where: Where
    where_probabilities: Mapping[Where, float]
    presence: tuple[float, ...]
    alone: tuple[float, ...]
    size: PopulationSize | None
    confusable_with: tuple[str, ...] = ()

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
    """What one campaign says, alone and to be pooled.

    Attributes
    ----------
    source, specimen, runs
        Folder, specimen, and number of runs.
    verdict, effects, probability
        Of its diagnosis alone.
    presence
        Probability that each effect is there, from this campaign alone.
    force
        Its evidence on the force.
    line_sizes
        Sizes and standard errors of effects that are found in position or spectrum, by id.
    left_out
        Runs that were not used.
    remarks
        Of the choice of runs.
    """

    source: str
    specimen: str
    runs: int
    verdict: Verdict
    effects: tuple[str, ...]
    probability: float
    presence: Mapping[str, float]
    force: ForceEvidence
    line_sizes: Mapping[str, tuple[float, float]]
    backends: tuple[str, ...] = ()
    nominal: str = ""
    left_out: tuple[Exclusion, ...] = ()
    remarks: tuple[str, ...] = ()


def campaign_evidence(source: str, weighed: DiagnosisWithCauses) -> CampaignEvidence:
    """Return what one campaign, a folder's runs, says alone and to be pooled."""
    diagnosis, causes = weighed.diagnosis, weighed.causes
    competition = causes.competition
    presence = {} if diagnosis.budget is None else dict(diagnosis.budget.presence)
    sizes = dict[str, tuple[float, float]]()
    candidate, line = weighed.position.candidate, weighed.lines.mains
    if candidate is not None:
        at = candidate.fitted_parameters.index(candidate.effect.size)
        sizes[candidate.effect.id] = candidate.values[candidate.effect.size.name], weighed.position.standard_errors[at]
    if line.llr > 0 and line.amplitude > 0:
        sizes[hum_effect().id] = line.amplitude, line.amplitude / float(np.sqrt(2 * line.llr))
    stated = "+".join(diagnosis.effects) or diagnosis.verdict.value
    probabilities = {ranked.hypothesis: ranked.probability for ranked in diagnosis.ranking}
    return CampaignEvidence(
        source,
        diagnosis.specimen,
        diagnosis.runs,
        diagnosis.verdict,
        diagnosis.effects,
        probabilities.get(stated, max(probabilities.values(), default=0.0)),
        presence,
        force_evidence(competition, causes.presence, competition.periodic),
        sizes,
        diagnosis.backends,
        diagnosis.nominal,
        diagnosis.left_out,
        diagnosis.remarks,
    )


@dataclass(frozen=True, slots=True, eq=False)
class PooledDiagnosis:
    """The diagnosis of several campaigns of one rig together.

    Attributes
    ----------
    campaigns
        What each says alone.
    effects
        All effects that were looked for, the most probable first.
    unnamed
        Probability of each shared deviation without a name, of the model or a free law, those above one half.
    remarks
        What the reader should know of the choice of campaigns and runs.
    """

    campaigns: tuple[CampaignEvidence, ...]
    effects: tuple[PooledEffect, ...]
    unnamed: Mapping[str, float]
    remarks: tuple[str, ...] = ()

    @property
    def established(self) -> tuple[PooledEffect, ...]:
        """Effects that are named, the rig's first."""
        named = [effect for effect in self.effects if effect.established]
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
    alone = {name: np.array([campaign.presence.get(name, 0.0) for campaign in campaigns]) for name in names}
    pooled = pool_force([campaign.force for campaign in campaigns], alone)
    # Errors of the motion resemble small effects on the force.
    strays = any(find_effect(name).moves_stage for campaign in campaigns for name in campaign.effects)
    effects = [
        _pooled_effect(name, replace(cause, probability=_less_likely(cause.probability, strays)), campaigns)
        for name, cause in pooled.items()
        if cause.evidence.kinds[name] is CauseKind.EFFECT
    ]
    on_force = {effect.effect for effect in effects}
    elsewhere = [name for name in names if name not in on_force and not find_effect(name).has_force_signature]
    effects += [_effect_by_odds(name, campaigns) for name in elsewhere]
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
    logs = {
        Where.ALL: odds.everywhere,
        Where.SOME: odds.some,
        Where.ONE: float(np.logaddexp.reduce(odds.single)),
    }
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
    """Pool an effect of the position or of the spectrum by what each campaign alone makes of it."""
    prior = PRIOR_PROBABILITIES["effect"]
    alone = np.clip([campaign.presence.get(name, prior) for campaign in campaigns], MIN_PROBABILITY, MAX_PROBABILITY)
    factors = np.log(alone / (1 - alone)) - log(prior / (1 - prior))
    odds = independent_odds(factors[None], (1.0,), of_rig=not find_effect(name).belongs_to_gut)
    effect = _with_patterns(name, odds, _logistic(odds.total), campaigns)
    sizes = [campaign.line_sizes.get(name) for campaign in campaigns]
    return replace(effect, size=_population(name, sizes, effect.members))


def _population(
    name: str, sizes: Sequence[tuple[float, float] | None], members: Sequence[int]
) -> PopulationSize | None:
    """Return mean and spread of sizes by the method of DerSimonian and Laird (Controlled Clinical Trials 7, 1986)."""
    known = [size for at in members if (size := sizes[at]) is not None]
    if not known:
        return None
    parameter = find_effect(name).size
    value, error = np.array(known).T
    weight = error**-2.0
    fixed = float(weight @ value / weight.sum())
    heterogeneity = float(weight @ (value - fixed) ** 2) - (len(known) - 1)
    scale = float(weight.sum() - (weight @ weight) / weight.sum())
    variance = max(heterogeneity / scale, 0.0) if len(known) > 1 and scale > 0 else 0.0
    weight = 1.0 / (error**2 + variance)
    return PopulationSize(
        parameter.name,
        parameter.unit,
        float(weight @ value / weight.sum()),
        float(weight.sum() ** -0.5),
        float(np.sqrt(variance)),
        tuple(sizes),
    )
