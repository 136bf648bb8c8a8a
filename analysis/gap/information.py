"""The expected information of further runs on the causes of a gap, in bits.

The causes compete as in `presence`; an explanation is a set of them with its probability. Under each explanation the
force of a further run is Gaussian: its mean is the prediction of the explanation, fitted to the runs so far, and its
covariance that of noise and uncertain coefficients. The expected information is the mutual information between
which causes are there and the forces of the further runs, estimated from the distances of these Gaussians in pairs
(Kolchinsky & Tracey 2017, Entropy 19, 361).
"""

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import exp, inf, log2, sqrt
from typing import Self

import numpy as np

from dragrig.analysis.gap.design import ColumnKind, Design, Study, linearise
from dragrig.analysis.gap.diagnosis import UNEXPLAINED, OpenCauses
from dragrig.analysis.gap.forward_selection import ForceSearchResult
from dragrig.analysis.gap.presence import (
    FORM_ERROR,
    Cause,
    CauseKind,
    CauseSet,
    ColumnStore,
    Competition,
    ForceCompetition,
    collect_causes,
    judge_presence,
    products_with_causes,
)
from dragrig.rig import FloatArray, IndexArray

EVIDENCE_WEIGHT = 0.5
"""Weight of log likelihoods, of runs so far and of further ones: real effects never have the forms that are assumed, so
that a competition at full weight is too sure. The same weight as in the intervals of the budget."""
MAX_EXPLANATIONS, MAX_ALIKE = 30, 3
"""Most likely explanations that are compared, in all and of those that name the same causes."""
MIN_SIGNAL_VARIANCE, MAX_DIRECTIONS = 0.01, 40
"""Directions in which all further runs together vary by less than this, relative to noise, tell nothing."""
MIN_RUN_SIGNAL = 1e-4
MAX_NAMED = 2
"""Number of effects that a run is said to tell of, and the share of the most told of that the second must reach."""


def entropy_bits(weights: FloatArray, labels: Sequence[Hashable]) -> float:
    """Return the entropy of a label; `weights` are probabilities of the labelled items, shape `(N,)`."""
    total: dict[Hashable, float] = {}
    for label, weight in zip(labels, weights.tolist(), strict=True):
        total[label] = total.get(label, 0.0) + weight
    values = np.array([value for value in total.values() if value > 0])
    return float(-values @ np.log2(values))


IN_DOUBT = 0.9
"""An answer that is less probable is in doubt, so that any run may help."""


def bits_to_change(probabilities: Iterable[float]) -> float:
    """Return the least information of an outcome that makes another answer the likeliest; infinite for a sure one.

    So far is the nearest distribution, by its divergence (Kullback and Leibler), that gives two answers the same; 0 for
    an answer that is in doubt.
    """
    first, second, *_ = *sorted(probabilities, reverse=True), 0.0
    if first < IN_DOUBT:
        return 0.0
    left = 1.0 - (sqrt(first) - sqrt(second)) ** 2
    return -log2(left) if left > 0 else inf


def expected_bits(weights: FloatArray, distances: FloatArray, labels: Sequence[Hashable]) -> float:
    """Return the expected information on a label: between 0 and its entropy.

    Parameters
    ----------
    weights
        Probabilities of explanations, shape `(N,)`.
    distances
        Bhattacharyya distances between their predictions, shape `(N, N)`.
    labels
        The answer of each explanation; several may be the same.
    """
    numbers = {label: number for number, label in enumerate(dict.fromkeys(labels))}
    codes = np.array([numbers[label] for label in labels])
    likely = np.flatnonzero(weights)  # of an explanation that cannot be, nothing remains
    overlap = (weights * np.exp(-distances))[np.ix_(likely, likely)]
    own = np.where(codes[likely, None] == codes[likely], overlap, 0.0).sum(axis=1)
    remaining = float(weights[likely] @ np.log2(overlap.sum(axis=1) / own))
    return max(entropy_bits(weights, labels) - remaining, 0.0)


@dataclass(frozen=True, eq=False)
class BudgetForecast:
    """Explanations of a gap, and the forces of further runs under each."""

    causes: tuple[tuple[str, ...], ...]
    """Causes of the budget that each explanation names: ids of effects, and `unexplained` for unnamed ones."""
    weights: FloatArray
    """Probabilities of the `N` explanations."""
    means: FloatArray
    covariances: FloatArray
    """`means`, `covariances`: what each predicts, in `r` directions, shapes `(N, r)` and `(N, r, r)`."""
    gram: FloatArray
    """Information of the further runs chosen so far on the directions, shape `(r, r)`."""

    def with_run(self, gram: FloatArray) -> Self:
        """Add a run by its information on the directions."""
        return replace(self, gram=self.gram + gram)

    @property
    def open_bits(self) -> float:
        """Entropy of which causes are there, before any further run."""
        return entropy_bits(self.weights, self.causes)

    @property
    def bits_to_change(self) -> float:
        """Least information of an outcome that makes another set of causes the likeliest."""
        return bits_to_change(self._sets.values())

    @property
    def bits(self) -> float:
        """Expected information of the chosen runs on which causes are there."""
        return expected_bits(self.weights, self.distances, self.causes)

    def bits_about(self, cause: str) -> float:
        """Return the expected information of the chosen runs on whether a cause is there."""
        return expected_bits(self.weights, self.distances, [cause in names for names in self.causes])

    def about(self, before: Self) -> tuple[str, ...]:
        """Return the effects of whose presence the chosen runs tell most beyond those of a forecast with fewer."""
        effects = [name for name in self.names if name != UNEXPLAINED]
        gains = {name: self.bits_about(name) - before.bits_about(name) for name in effects}
        largest = max(gains.values(), default=0.0)
        ordered = sorted(gains, key=lambda name: -gains[name])
        return tuple(name for name in ordered[:MAX_NAMED] if gains[name] >= 0.5 * largest > 0.0)

    @property
    def open_causes(self) -> OpenCauses:
        """The entropy of the causes before any further run."""
        sets = self._sets
        probabilities = {name: sum(value for names, value in sets.items() if name in names) for name in self.names}
        return OpenCauses(probabilities, sets.get((), 0.0), max(sets.values()), self.open_bits)

    @property
    def _sets(self) -> dict[tuple[str, ...], float]:
        """Probability of each set of causes before any further run."""
        sets: dict[tuple[str, ...], float] = {}
        for names, weight in zip(self.causes, self.weights.tolist(), strict=True):
            sets[names] = sets.get(names, 0.0) + weight
        return sets

    @property
    def names(self) -> tuple[str, ...]:
        """All causes that any explanation names."""
        return tuple(dict.fromkeys(name for names in self.causes for name in names))

    @cached_property
    def distances(self) -> FloatArray:
        """Bhattacharyya distances between the predictions of the chosen runs, shape `(N, N)`."""
        count = len(self.weights)
        values, vectors = np.linalg.eigh(self.gram)
        kept = values > MIN_RUN_SIGNAL
        if not kept.any():
            return np.zeros((count, count))
        root = vectors[:, kept] * np.sqrt(values[kept])
        means = self.means @ root
        covariances = np.einsum("ra,irs,sb->iab", root, self.covariances, root, optimize=True) + np.eye(kept.sum())
        log_dets = _log_dets(np.linalg.cholesky(covariances))
        first, second = np.triu_indices(count, 1)
        roots = np.linalg.cholesky(0.5 * (covariances[first] + covariances[second]))
        apart = np.linalg.solve(roots, (means[first] - means[second])[:, :, None])[:, :, 0]
        spread = 0.5 * (_log_dets(roots) - 0.5 * (log_dets[first] + log_dets[second]))
        distances = np.zeros((count, count))
        distances[first, second] = EVIDENCE_WEIGHT * (0.125 * (apart**2).sum(axis=1) + spread)
        return distances + distances.T


def _log_dets(roots: FloatArray) -> FloatArray:
    return np.asarray(2.0 * np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1))


def forecast(
    search: ForceSearchResult, competition: ForceCompetition, further: Study
) -> tuple[BudgetForecast, list[FloatArray]]:
    """Return a forecast without any further run, and the information of each of some runs, to be added by `with_run`.

    Parameters
    ----------
    search, competition
        Hypotheses that were fitted to the force of the campaign, and all causes that may act on it.
    further
        Study of the further runs alone, at the same sampling.
    """
    made, added = search.fitted, linearise(further, search.fitted.z, dictionary=True)
    design = replace(
        made,
        runs=(*made.runs, *added.runs),
        grams=(*made.grams, *added.grams),
        block_counts=(*made.block_counts, *added.block_counts),
    )
    # Sizes count where an effect acts in any run: one that no run so far shows is as likely there as any.
    whitenings = (*competition.whitenings, *added.whitenings)
    store = collect_causes(search, _joined_study(search.study, further), design, whitenings)
    return _in_telling_directions(*_predicted(design, competition, store))


def _predicted(
    design: Design, competition: ForceCompetition, store: ColumnStore
) -> tuple[tuple[tuple[str, ...], ...], FloatArray, FloatArray, FloatArray, list[FloatArray]]:
    """Return explanations, probabilities, means and covariances of coefficients, and the further runs' information."""
    nuisances = design.columns_of(ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR)
    causes = store.shared_priors()
    total, products = products_with_causes(design, competition.whitenings, store.columns)
    posterior = _Posterior(total, design.prior_precision[nuisances], design.prior_mean[nuisances], causes)
    likely = _likely_explanations(Competition(causes, products))
    weights = np.array([weight for _, weight in likely])
    needed = np.unique(np.concatenate([posterior.rows(explanation) for explanation, _ in likely]))
    means, covariances = posterior.of([explanation for explanation, _ in likely], needed)
    of_causes = needed >= nuisances.size
    grams, made = [], len(competition.whitenings)
    for run, rows in zip(design.runs[made:], design.run_rows[made:], strict=True):
        values = (run.columns[:, nuisances], *(piece[rows] for piece in store.columns))
        shown = np.concatenate(values, axis=1)[:, needed]
        form_error = FORM_ERROR * np.sqrt(weights @ (means[:, of_causes] @ shown[:, of_causes].T) ** 2)
        grams.append(run.whitening.with_form_error(form_error).gram(shown))
    names = tuple(_named(causes, explanation) for explanation, _ in likely)
    return names, weights, means, covariances, grams


def _joined_study(made: Study, further: Study) -> Study:
    problem = replace(
        made.problem,
        channels=(*made.problem.channels, *further.problem.channels),
        noises=(*made.problem.noises, *further.problem.noises),
        zero_sds=(*made.problem.zero_sds, *further.problem.zero_sds),
    )
    return replace(made, problem=problem, runs=(*made.runs, *further.runs))


def _named(causes: Sequence[Cause], explanation: CauseSet) -> tuple[str, ...]:
    """Return the budget of an explanation: effects, and whether anything has no name."""
    kinds = {CauseKind.LAW: UNEXPLAINED, CauseKind.RUN: UNEXPLAINED}
    named = {
        causes[index].name if causes[index].kind is CauseKind.EFFECT else kinds.get(causes[index].kind, "")
        for index, _ in explanation
    }
    return tuple(sorted(named - {""}))


def _likely_explanations(competition: Competition) -> list[tuple[CauseSet, float]]:
    """Return the most likely explanations with their probabilities, those that name the same causes at most thrice.

    Explanations with the same causes keep their joint probability.
    """
    causes, presence = competition.causes, judge_presence(competition)
    by_name: dict[tuple[str, ...], list[tuple[float, CauseSet]]] = {}
    for explanation, log_odds in presence.log_odds.items():
        prior = sum(causes[index].log_prior_odds for index, _ in explanation)
        tempered = prior + EVIDENCE_WEIGHT * (log_odds - prior)
        by_name.setdefault(_named(causes, explanation), []).append((tempered, explanation))
    best = max(value for group in by_name.values() for value, _ in group)
    totals = {name: sum(exp(value - best) for value, _ in group) for name, group in by_name.items()}
    chosen = []
    for name in sorted(totals, key=lambda name: -totals[name])[:MAX_EXPLANATIONS]:
        alike = sorted(by_name[name], reverse=True)[:MAX_ALIKE]
        parts = np.array([exp(value - alike[0][0]) for value, _ in alike])
        shares = totals[name] * parts / parts.sum()
        chosen += [(explanation, share) for (_, explanation), share in zip(alike, shares.tolist(), strict=True)]
    chosen = sorted(chosen, key=lambda pair: -pair[1])[:MAX_EXPLANATIONS]
    total = sum(weight for _, weight in chosen)
    return [(explanation, weight / total) for explanation, weight in chosen]


@dataclass(frozen=True, slots=True, eq=False)
class _Posterior:
    """The uncertainty that the runs so far leave to the coefficients of nuisances and causes."""

    total: FloatArray
    """Products of residual (first), nuisances and columns, whitened."""
    precision: FloatArray
    mean: FloatArray
    """`precision`, `mean`: priors of the nuisances."""
    causes: tuple[Cause, ...]

    def rows(self, explanation: CauseSet) -> IndexArray:
        """Return the coefficients of nuisances and of a set's causes, which may share some."""
        columns = [self.precision.size + self.causes[index].columns for index, _ in explanation]
        return np.unique(np.concatenate((np.arange(self.precision.size), *columns)))

    def of(self, explanations: Sequence[CauseSet], needed: IndexArray) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of the needed coefficients under each explanation, zero where it has none."""
        means = np.zeros((len(explanations), needed.size))
        covariances = np.zeros((len(explanations), needed.size, needed.size))
        for number, explanation in enumerate(explanations):
            rows = self.rows(explanation)
            variances = np.zeros(len(self.total) - 1)
            for index, scale in explanation:
                cause = self.causes[index]
                variances[self.precision.size + cause.columns] += (cause.sds * cause.scales[scale]) ** 2
            nuisances = rows < self.precision.size
            precision = np.concatenate((self.precision, 1.0 / variances[rows[~nuisances]]))
            mean = np.concatenate((self.mean, np.zeros(int((~nuisances).sum()))))
            gram = EVIDENCE_WEIGHT * self.total[np.ix_(1 + rows, 1 + rows)]
            covariance = np.linalg.inv(gram + np.diag(precision + 1e-10 * np.diag(gram)))
            places = np.searchsorted(needed, rows)
            means[number, places] = covariance @ (EVIDENCE_WEIGHT * self.total[1 + rows, 0] + precision * mean)
            covariances[number][np.ix_(places, places)] = covariance
        return means, covariances


def _in_telling_directions(
    names: tuple[tuple[str, ...], ...],
    weights: FloatArray,
    means: FloatArray,
    covariances: FloatArray,
    grams: Sequence[FloatArray],
) -> tuple[BudgetForecast, list[FloatArray]]:
    """Return a forecast on the directions in which the further runs can differ, and the runs' information on them."""
    average = weights @ means
    spread = np.einsum("i,iab->ab", weights, covariances) + (means - average).T @ (weights[:, None] * (means - average))
    values, vectors = np.linalg.eigh(sum(grams[1:], grams[0]))
    kept = values > 1e-9 * values.max()
    root = vectors[:, kept] * np.sqrt(values[kept])
    signal, directions = np.linalg.eigh(root.T @ spread @ root)
    telling = np.flatnonzero(signal > MIN_SIGNAL_VARIANCE)[::-1][:MAX_DIRECTIONS]
    into = directions[:, telling].T @ root.T
    back = (vectors[:, kept] / np.sqrt(values[kept])) @ directions[:, telling]
    result = BudgetForecast(
        names,
        weights,
        (means - average) @ into.T,
        np.einsum("ra,iab,sb->irs", into, covariances, into, optimize=True),
        np.zeros((telling.size,) * 2),
    )
    return result, [back.T @ gram @ back for gram in grams]
