"""Which causes act on the force of several campaigns, as each weighs beside the others that are there.

Effects of the rig are the same in all campaigns; those of the gut are a population with a spread. In which
campaigns a cause is, `pattern_odds` tells. Causes are chosen, the best first, each beside those chosen before it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import log

import numpy as np

from dragrig.analysis import NORMAL_95
from dragrig.analysis.gap.diagnosis import ESTABLISHED, MAX_PROBABILITY, MIN_PROBABILITY
from dragrig.analysis.gap.pattern_odds import PatternOdds, SharedInformation, independent_odds, pattern_odds
from dragrig.analysis.gap.pooled_evidence import ForceEvidence, SharedColumns, projected_out, without_forms
from dragrig.analysis.gap.presence import KEPT_VARIANCE, PRIOR_PROBABILITIES, CauseKind, log_evidence
from dragrig.rig import FloatArray, IndexArray
from dragrig.sim_backend.effects import find_effect

MAX_SHARED_COLUMNS = 6
RIG_SPREADS = (0.0, 0.05)
"""Shares of the variance by which what belongs to the rig differs between campaigns: forms seen at other specimens."""
GUT_SPREADS = (0.03, 0.2, 0.6)
LAW_SPREADS = (0.03, 0.2)
MAX_POOLED = 12
CONFUSABLE_SHARE = 0.2
"""A rival that would be there in a cause's place with more than this share of its probability is not told from it."""
LOOKALIKE_SHARE, STRANGER_SHARE, UNLIKELY_LOG_ODDS = 0.15, 0.03, -1.0
"""Other forms of an effect leave up to these shares of its log evidence to its lookalikes, and to effects that do not
resemble it: real ones leave 10 to 40 % of an effect, 1 to 16 % of its squares. An effect of less is at most so likely:
what all campaigns leave alike does not average out, however many there are."""
EXPLAINED_LOG_ODDS = 3.0
"""A lookalike of chosen effects loses more than this beside them."""
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
        first, numbers, products = self._gathered(name)
        sizes = self._common_sizes(name, numbers)
        scales = first.scales
        weight = -log(2 * len(scales) * len(spreads))
        grams, _ = without_forms(products, sizes, 0.0)
        values, vectors = np.linalg.eigh(grams.sum(axis=0))
        kept = int(np.searchsorted(np.cumsum(values[::-1]), KEPT_VARIANCE * values.sum())) + 1
        basis = vectors[:, ::-1][:, : min(kept, MAX_SHARED_COLUMNS)]
        direction = basis.sum(axis=0) if first.one_signed else None
        # Small effects show nothing of their other forms, and large ones do: all campaigns have either.
        for (at, scale), with_forms in product(enumerate(scales), (False, True)):
            grams, moments = without_forms(products, sizes, scale if with_forms else 0.0)
            offsets = np.array(
                [self._offset(campaign, name, at if with_forms else None) for campaign in self.campaigns]
            )
            gram = basis.T @ grams @ basis
            moment = moments @ basis
            for spread in spreads:
                yield weight, scale, SharedInformation.of(gram, moment, offsets, scale**2, spread, direction)

    def _offset(self, campaign: ForceEvidence, name: str, at: int | None) -> float:
        """Return the log Bayes factor of a campaign beyond that of the shared columns.

        The gain of chosen causes is no merit of this one's other forms, and no merit of the campaign's other causes.

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

    def _gathered(self, name: str) -> tuple[SharedColumns, IndexArray, FloatArray]:
        """Return a cause's columns in the first campaign that has it, their numbers in all, and their products.

        Products of residual, `n` shared columns and forms have the shape `(C, 1 + n + r, 1 + n + r)`.
        """
        having = {at: campaign.columns[name] for at, campaign in enumerate(self.campaigns) if name in campaign.columns}
        numbers = np.unique(np.concatenate([shared.numbers for shared in having.values()]))
        forms = max(shared.form_rows.size for shared in having.values())
        products = np.zeros((len(self.campaigns), 1 + numbers.size + forms, 1 + numbers.size + forms))
        for at, shared in having.items():
            rows = np.concatenate(([0], shared.rows, shared.form_rows))
            places = np.concatenate(
                (
                    [0],
                    1 + np.searchsorted(numbers, shared.numbers),
                    1 + numbers.size + np.arange(shared.form_rows.size),
                )
            )
            products[at, places[:, None], places] = self.campaigns[at].information_for(name)[rows[:, None], rows]
        return next(iter(having.values())), numbers, products

    def _common_sizes(self, name: str, numbers: IndexArray) -> FloatArray:
        """Return the size of each column at its default, the geometric mean of the campaigns, shape `(n,)`."""
        logs, counts = np.zeros(numbers.size), np.zeros(numbers.size)
        for shared in (campaign.columns[name] for campaign in self.campaigns if name in campaign.columns):
            rows = np.searchsorted(numbers, shared.numbers)
            logs[rows] += np.log(shared.sizes_mN)
            counts[rows] += 1
        return np.asarray(np.exp(logs / counts))

    def _periodic_odds(self, name: str) -> PatternOdds:
        """Return the odds of a periodic effect, whose phase and amplitude are each campaign's own."""
        first, numbers, products = self._gathered(name)
        grams, moments = without_forms(products, self._common_sizes(name, numbers), 0.0)
        pairs = np.flatnonzero(np.diff(numbers // 2) == 0)
        # Columns have sd `scale` over the root of their number: at a period there are two.
        ratio = numbers.size / 2
        rows = np.stack((pairs, pairs + 1), axis=1)
        gram = ratio * grams[:, rows[:, :, None], rows[:, None, :]]
        moment = np.sqrt(ratio) * moments[:, rows]
        by_scale = [
            log_evidence(gram.reshape(-1, 2, 2), moment.reshape(-1, 2), np.array([scale])) for scale in first.scales
        ]
        factors = [values.reshape(len(gram), -1).T for values in by_scale]
        of_rig = not find_effect(name).belongs_to_gut
        scales = np.repeat(first.scales, len(pairs)).tolist()
        return independent_odds(np.concatenate(factors), scales, of_rig=of_rig)

    def sizes(self, name: str, scale: float) -> tuple[tuple[float, float] | None, ...]:
        """Return the size of an effect in each campaign with its standard error, in the shape that fits all best.

        In the unit of its parameter of size; None where a campaign does not show it.
        """
        effect = find_effect(name)
        _, numbers, products = self._gathered(name)
        grams, moments = without_forms(products, np.ones(numbers.size), scale)
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
        default, of_best = effect.size.default, amplitude[:, best, :, 0]
        values = of_best[:, 0] if width == 1 else np.hypot(*of_best.T)
        return tuple(
            (default * float(value), abs(default) * float(information) ** -0.5) if information > 1e-9 else None
            for value, information in zip(values.tolist(), strength[:, best, 0, 0].tolist(), strict=True)
        )


def _projected_out(campaign: ForceEvidence, name: str, scale: float) -> ForceEvidence:
    shared = campaign.columns.get(name)
    if shared is None:
        return campaign
    rows = np.concatenate((shared.rows, shared.form_rows))
    sds = np.concatenate((scale / (shared.sizes_mN * np.sqrt(len(shared.rows))), np.full(shared.form_rows.size, scale)))
    if shared.one_signed is False and not shared.form_rows.size and shared.kind is CauseKind.EFFECT:
        sds = sds * np.sqrt(len(shared.rows) / 2)
    return replace(campaign, contexts=tuple(projected_out(values, rows, sds) for values in campaign.contexts))


@dataclass(frozen=True, slots=True, eq=False)
class PooledCause:
    """A cause in several campaigns."""

    odds: PatternOdds
    """In which it is, beside all other causes that are there."""
    evidence: PooledForce
    """The evidence of all campaigns beside those."""
    probability: float
    """That it is in any, its lookalikes in its place considered."""
    confusable_with: tuple[str, ...]
    """Causes that may be there in its place."""


Alone = Mapping[str, FloatArray]
"""Probability that each effect is there, from each campaign alone, shape `(C,)`."""


@dataclass(frozen=True, slots=True)
class Credibility:
    """How much is believed of the log odds that pooling gives."""

    first: Mapping[str, float]
    """Log odds of each cause beside no other."""
    alone: Alone
    """Probability that each effect is there, from each campaign alone."""
    stage_strays: bool
    """Whether the stage strays from its command in some campaign. Its errors resemble effects on the force, in all
    campaigns alike: only an effect that some campaign alone tells from them is believed."""

    def log_odds(self, name: str, odds: PatternOdds, evidence: PooledForce, chosen: Mapping[str, PatternOdds]) -> float:
        """Return the log odds that a cause is there, beside the chosen ones."""
        value = odds.total
        if name in self.alone and np.isfinite(value):
            value = self._of_effect(name, odds, evidence)
        effects = [other for other in chosen if other in self.alone]
        largest = max(effects, key=lambda other: chosen[other].total, default=None)
        if largest is None:
            return value
        shown_with_it = np.minimum(self.alone.get(name, np.zeros(1)), self.alone[largest])
        if (shown_with_it > ESTABLISHED).any():  # some campaign alone tells the two apart
            return value
        is_lookalike = self.first[name] - odds.total > EXPLAINED_LOG_ODDS
        share = LOOKALIKE_SHARE if is_lookalike else STRANGER_SHARE if name in self.alone else 0.0
        return min(value, UNLIKELY_LOG_ODDS) if odds.total < share * chosen[largest].total else value

    def _of_effect(self, name: str, odds: PatternOdds, evidence: PooledForce) -> float:
        """Return the log odds of an effect by all campaigns.

        Pooling adds nothing to the evidence of a single campaign on an effect that it alone has, and its own diagnosis
        weighs more. An effect whose size is positive is none where it comes out negative, nor is one whose mean size
        does not differ from zero: large scales leave room for sizes of either sign.
        """
        alone = np.clip(self.alone[name], MIN_PROBABILITY, MAX_PROBABILITY)
        value = odds.total
        if odds.in_one:
            probability = float(np.exp(odds.single - np.logaddexp.reduce(odds.single)) @ alone)
            value = min(value, _log_odds(probability))
        elif value > MIN_LOG_ODDS and not _has_a_size(name, evidence.sizes(name, odds.scale)):
            return -np.inf
        return min(value, _log_odds(float(alone.max()))) if self.stage_strays else value


def _has_a_size(name: str, sizes: Sequence[tuple[float, float] | None]) -> bool:
    """Return whether the mean size of an effect differs from zero, and in the direction that it can have."""
    known = [size for size in sizes if size is not None]
    if not known:
        return True
    effect, (mean, error, _) = find_effect(name), random_effects_mean(known)
    if effect.size.low >= 0 and mean < 0:
        return False
    return effect.phase is not None or abs(mean) > NORMAL_95 * error


def random_effects_mean(estimates: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
    """Return mean, its standard error, and spread of values with standard errors.

    By the method of DerSimonian and Laird (Controlled Clinical Trials 7, 1986); the spread is beyond the errors.
    """
    value, error = np.array(estimates).T
    weight = error**-2.0
    fixed = float(weight @ value / weight.sum())
    heterogeneity = float(weight @ (value - fixed) ** 2) - (len(value) - 1)
    scale = float(weight.sum() - (weight @ weight) / weight.sum())
    variance = max(heterogeneity / scale, 0.0) if len(value) > 1 and scale > 0 else 0.0
    weight = 1.0 / (error**2 + variance)
    return float(weight @ value / weight.sum()), float(weight.sum() ** -0.5), float(np.sqrt(variance))


def _log_odds(probability: float) -> float:
    return log(probability / (1.0 - probability))


def pool_force(
    campaigns: Sequence[ForceEvidence], alone: Alone, *, stage_strays: bool = False
) -> Mapping[str, PooledCause]:
    """Return how likely each shared cause is, beside the others that are there, by name; as `Credibility` weighs it."""
    nothing = PooledForce(tuple(campaigns))
    odds = {name: nothing.odds(name) for name in nothing.kinds}
    credibility = Credibility({name: value.total for name, value in odds.items()}, alone, stage_strays)
    chosen, evidence = dict[str, PatternOdds](), nothing
    beside_earlier = dict[str, PooledForce]()

    def believed() -> dict[str, float]:
        return {name: credibility.log_odds(name, value, evidence, chosen) for name, value in odds.items()}

    while len(chosen) < MAX_POOLED:
        likely = [name for name, value in believed().items() if value >= MIN_LOG_ODDS]
        if not likely:
            break
        best = max(likely, key=lambda name: odds[name].total)
        chosen[best], beside_earlier[best] = odds[best], evidence
        evidence = evidence.beside(best, odds[best])
        odds = {name: evidence.odds(name) for name in odds if name != best}
    found = {name: PooledCause(odds[name], evidence, _probability(value), ()) for name, value in believed().items()}
    rivals = tuple(name for name in odds if credibility.first[name] - odds[name].total > EXPLAINED_LOG_ODDS)
    for cause, value in _chosen_causes(chosen, rivals, beside_earlier, credibility):
        if cause in chosen or value.probability > found[cause].probability:
            found[cause] = value
    beside_effects = evidence
    if not chosen.keys() <= alone.keys():
        beside_effects = nothing
        for name in chosen.keys() & alone.keys():
            beside_effects = beside_effects.beside(name, chosen[name])
    for name in found.keys() & alone.keys():
        # What a campaign's own diagnosis names, which knows all forms, stays where no chosen effect explains it.
        if float(alone[name].max()) > max(ESTABLISHED, found[name].probability) and (
            name in chosen or credibility.first[name] - beside_effects.odds(name).total <= EXPLAINED_LOG_ODDS
        ):
            odds_alone = odds_of_own_diagnoses(alone[name], of_rig=not find_effect(name).belongs_to_gut)
            found[name] = PooledCause(odds_alone, evidence, _probability(odds_alone.total), ())
    return found


def _chosen_causes(
    chosen: Mapping[str, PatternOdds],
    rivals: Sequence[str],
    beside_earlier: Mapping[str, PooledForce],
    credibility: Credibility,
) -> Iterator[tuple[str, PooledCause]]:
    """Yield each chosen cause beside all others, and those that may be there in its place.

    Parameters
    ----------
    beside_earlier
        The evidence beside those chosen before each.
    """
    for at, name in enumerate(chosen):
        others = {cause: odds for cause, odds in chosen.items() if cause != name}
        beside = beside_earlier[name]
        for later in list(chosen)[at + 1 :]:
            beside = beside.beside(later, chosen[later])
        own = beside.odds(name)
        value = credibility.log_odds(name, own, beside, others)
        if value < own.total:
            yield name, PooledCause(own, beside, _probability(value), ())
            continue
        rival_odds = {rival: beside.odds(rival) for rival in rivals}
        logs = {rival: credibility.log_odds(rival, odds, beside, others) for rival, odds in rival_odds.items()}
        total = float(np.logaddexp.reduce([0.0, own.total, *logs.values()]))
        alike = tuple(rival for rival, log_odds in logs.items() if log_odds > own.total + log(CONFUSABLE_SHARE))
        yield name, PooledCause(own, beside, float(np.exp(own.total - total)), alike)
        for rival in alike:
            yield rival, PooledCause(rival_odds[rival], beside, float(np.exp(logs[rival] - total)), (name,))


def odds_of_own_diagnoses(alone: FloatArray, *, of_rig: bool) -> PatternOdds:
    """Return in which campaigns an effect is by the probabilities of each campaign alone, shape `(C,)`.

    That of a single campaign is never lowered: the others add nothing to it.
    """
    limited = np.clip(alone, MIN_PROBABILITY, MAX_PROBABILITY)
    own = np.array([_log_odds(probability) for probability in limited])
    joint = independent_odds((own - _log_odds(PRIOR_PROBABILITIES["effect"]))[None], (1.0,), of_rig=of_rig)
    if joint.total >= own.max():
        return joint
    return PatternOdds(-np.inf, -np.inf, np.where(own == own.max(), own, -np.inf), np.zeros(own.size), 1.0)


def _probability(log_odds: float) -> float:
    from scipy.special import expit

    return float(expit(log_odds))
