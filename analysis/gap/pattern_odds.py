"""In which of several campaigns a cause is: in all, in some, or in one, by the evidence of each.

Its coefficients in campaign `c` are `β_c = μ + δ_c`, where `μ` and `δ_c` are Gaussian with variances `(1 - ρ) s²` and
`ρ s²` (a random-effects model; Gelman & Hill, Data Analysis Using Regression and Multilevel Models, 2007). The evidence
that a cause is in some campaigns and in no others follows by linear algebra from the compact evidence of each.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log

import numpy as np

from dragrig.analysis.gap.presence import PRIOR_PROBABILITIES, CauseKind, log_evidence
from dragrig.rig import BoolArray, FloatArray

PATTERN_PRIORS: Mapping[bool, tuple[float, float, float]] = {True: (0.8, 0.1, 0.1), False: (0.5, 0.25, 0.25)}
"""Prior probabilities that an effect which is there is in all, some, or one; where it is the rig's, and the gut's."""
PREVALENCES = (0.1, 0.3, 0.5, 0.7, 0.9)
MIN_CAMPAIGNS_FOR_SOME = 3
"""Of fewer campaigns an effect is in all or in one."""
ORDERINGS = 2
"""Orders of the campaigns by their evidence, each at the mean of the best set of the order before."""
SETTINGS_SEARCHED = 5
"""Most promising scales and spreads at which sets of some campaigns are looked for."""


@dataclass(frozen=True, slots=True, eq=False)
class PatternOdds:
    """In which of `C` campaigns a cause is, as log posterior odds against its absence from all."""

    everywhere: float
    """In all of them."""
    some: float
    """In at least two but not all; -inf where that cannot be."""
    single: FloatArray
    """In one campaign alone, shape `(C,)`."""
    members: FloatArray
    """Probability that it is in each campaign, given that it is in some, shape `(C,)`."""
    scale: float
    """Its most likely scale."""

    @property
    def total(self) -> float:
        """Log odds that it is in any campaign."""
        return float(np.logaddexp.reduce([self.everywhere, self.some, *self.single]))

    @property
    def in_one(self) -> bool:
        """Whether it is most likely in a single campaign, if in any."""
        return float(np.logaddexp.reduce(self.single)) > max(self.everywhere, self.some)


@dataclass(frozen=True, slots=True, eq=False)
class SharedInformation:
    """Information of all campaigns on one cause for one scale and spread."""

    gram: FloatArray
    """Of the shared mean, shape `(C, k, k)`, own deviations integrated out."""
    moment: FloatArray
    """The same, shape `(C, k)`."""
    constant: FloatArray
    """Log evidence that does not depend on the mean, shape `(C,)`."""
    mean_variance: float
    """Prior variance of the mean."""
    direction: FloatArray | None
    """Direction in which the mean must be positive, shape `(k,)`; None for either sign."""

    @classmethod
    def of(
        cls,
        gram: FloatArray,
        moment: FloatArray,
        offsets: FloatArray,
        variance: float,
        spread: float,
        direction: FloatArray | None,
    ) -> "SharedInformation":
        """Return it from the information of each campaign on its own coefficients.

        Parameters
        ----------
        gram, moment
            Information matrices and vectors, shapes `(C, k, k)` and `(C, k)`.
        offsets
            Log evidence of each campaign beyond these, shape `(C,)`.
        variance, spread
            Prior variance of a coefficient, and the share of it that is each campaign's own.
        """
        own = spread * variance
        shrunk = np.eye(gram.shape[1]) + own * gram
        solved = np.linalg.solve(shrunk, np.concatenate((gram, moment[:, :, None]), axis=2))
        reduced, vector = np.asarray(solved[:, :, :-1]), np.asarray(solved[:, :, -1], dtype=np.float64)
        constant = offsets + 0.5 * own * np.einsum("ck,ck->c", moment, vector) - 0.5 * np.linalg.slogdet(shrunk)[1]
        return cls(0.5 * (reduced + reduced.transpose(0, 2, 1)), vector, constant, (1.0 - spread) * variance, direction)

    def evidence(self, gram: FloatArray, moment: FloatArray, constant: FloatArray) -> FloatArray:
        """Return the log evidence of sums over sets of campaigns, shapes `(P, k, k)`, `(P, k)` and `(P,)`."""
        size = np.array([self.mean_variance**0.5])
        return constant + log_evidence(gram, moment, size, 0.0 if self.direction is None else self.direction)

    def of_members(self, members: BoolArray) -> float:
        """Return the log evidence that the cause is in some campaigns and in no others."""
        sums = (values[members].sum(axis=0)[None] for values in (self.gram, self.moment, self.constant))
        return float(self.evidence(*sums)[0])

    def gains(self, members: BoolArray) -> FloatArray:
        """Return the log evidence of each campaign for the cause at the mean that some campaigns have, shape `(C,)`."""
        width = self.gram.shape[1]
        precision = np.eye(width) + self.mean_variance * self.gram[members].sum(axis=0)
        mean = self.mean_variance * np.linalg.solve(precision, self.moment[members].sum(axis=0))
        return np.asarray(self.constant + self.moment @ mean - 0.5 * np.einsum("k,ckl,l->c", mean, self.gram, mean))


def _some_evidence(setting: SharedInformation, singles: FloatArray) -> tuple[float, FloatArray]:
    """Return the log evidence of at least two campaigns but not all, and the probability of each to be among them.

    Sets are summed over about the mean of the best one, which is found along orders of the campaigns by their gains.
    """
    count = len(singles)
    if count < MIN_CAMPAIGNS_FOR_SOME:
        return -np.inf, np.ones(count)
    best_value, best = -np.inf, np.ones(count, dtype=bool)
    for start in (np.ones(count, dtype=bool), singles == singles.max()):
        members = start
        for _ in range(ORDERINGS):
            order = np.argsort(-setting.gains(members), kind="stable")
            # Of the first 2, 3, … campaigns in this order, but not of all.
            sums = (np.cumsum(each[order], axis=0) for each in (setting.gram, setting.moment, setting.constant))
            values = setting.evidence(*sums)[1:-1]
            size = 2 + int(np.argmax(values))
            members = np.zeros(count, dtype=bool)
            members[order[:size]] = True
            if values[size - 2] > best_value:
                best_value, best = float(values[size - 2]), members
    gains = setting.gains(best)
    of_best = float(gains[best].sum())
    total, members = _over_prevalences(gains[None])
    return best_value - of_best + float(total[0]), members[0]


def _over_prevalences(gains: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean over prevalences of the evidence `(H,)`, as its log, and each campaign's probability `(H, C)`.

    Whether a cause is in a campaign, `gains` tell, its log Bayes factors there, shape `(H, C)`.
    """
    prevalences = np.array(PREVALENCES)[:, None, None]
    with_cause = np.log(prevalences) + gains
    each = np.logaddexp(with_cause, np.log1p(-prevalences))
    sums = each.sum(axis=2)
    total = np.logaddexp.reduce(sums, axis=0)
    members = np.einsum("ph,phc->hc", np.exp(sums - total), np.exp(with_cause - each))
    return total - log(len(PREVALENCES)), members


def pattern_odds(
    settings: Sequence[tuple[float, float, SharedInformation]], kind: CauseKind, *, of_rig: bool
) -> PatternOdds:
    """Return in which campaigns a cause is.

    Parameters
    ----------
    settings
        Log prior weight, scale, and information of each scale and spread.
    """
    everyone = np.ones(len(settings[0][2].constant), dtype=bool)
    weights = np.array([weight for weight, _, _ in settings])
    everywhere = weights + [setting.of_members(everyone) for _, _, setting in settings]
    scales = [scale for _, scale, _ in settings]
    if kind is not CauseKind.EFFECT:
        nowhere = np.full((len(settings), everyone.size), -np.inf)
        return _joined(kind, everywhere, nowhere[:, 0], nowhere, np.ones(nowhere.shape), scales)
    singles = np.array([setting.evidence(setting.gram, setting.moment, setting.constant) for _, _, setting in settings])
    some = np.full(len(settings), -np.inf)
    members = np.ones((len(settings), everyone.size))
    promising = np.maximum(everywhere, weights + np.maximum(singles, 0.0).sum(axis=1))
    for at in np.argsort(-promising)[:SETTINGS_SEARCHED].tolist():
        some[at], members[at] = _some_evidence(settings[at][2], singles[at])
    return _joined(kind, everywhere, weights + some, weights[:, None] + singles, members, scales, of_rig=of_rig)


def independent_odds(log_factors: FloatArray, scales: Sequence[float], *, of_rig: bool) -> PatternOdds:
    """Return in which campaigns an effect is that has nothing but a scale, and maybe a period, in common.

    Parameters
    ----------
    log_factors
        Log Bayes factor of the effect in each campaign for `H` hypotheses, equally likely, shape `(H, C)`.
    scales
        Scale of each hypothesis.
    """
    count = log_factors.shape[1]
    weight = -log(len(log_factors))
    some, members = np.full(len(log_factors), -np.inf), np.ones(log_factors.shape)
    if count >= MIN_CAMPAIGNS_FOR_SOME:
        some, members = _over_prevalences(log_factors)
    return _joined(
        CauseKind.EFFECT,
        weight + log_factors.sum(axis=1),
        weight + some,
        weight + log_factors,
        members,
        scales,
        of_rig=of_rig,
    )


def _joined(
    kind: CauseKind,
    everywhere: FloatArray,
    some: FloatArray,
    singles: FloatArray,
    members: FloatArray,
    scales: Sequence[float],
    *,
    of_rig: bool = False,
) -> PatternOdds:
    """Return the odds over all settings, of log evidence `(H,)`, `(H,)`, `(H, C)` and members `(H, C)`."""
    prior = PRIOR_PROBABILITIES[kind]
    base = log(prior / (1 - prior))
    in_all, in_some, in_one = PATTERN_PRIORS[of_rig] if kind is CauseKind.EFFECT else (1.0, 0.0, 0.0)
    if singles.shape[1] < MIN_CAMPAIGNS_FOR_SOME:
        in_all, in_some = in_all + in_some, 0.0
    shares = np.exp(some - np.logaddexp.reduce(some)) if np.isfinite(some).any() else np.full(len(some), 1 / len(some))
    peak = np.logaddexp(np.logaddexp(everywhere, some), singles.max(axis=1))
    return PatternOdds(
        base + _log(in_all) + float(np.logaddexp.reduce(everywhere)),
        base + _log(in_some) + float(np.logaddexp.reduce(some)),
        base + _log(in_one / singles.shape[1]) + np.logaddexp.reduce(singles, axis=0),
        shares @ members,
        scales[int(np.argmax(peak))],
    )


def _log(value: float) -> float:
    return log(value) if value > 0 else -np.inf
