"""The gap as a budget: which share of it each cause has on held-out runs, and what is left.

The gap of a run is what the nominal model leaves of it when its parameters are fitted to the other runs. Fitted
together with the causes to the same other runs, the model leaves less; the difference is the sum of the causes'
contributions, each without what the nominal parameters absorb of it. A cause's share is the covariance of its
contribution with the gap, over the gap's mean square above noise: shares of all causes and the rest sum to 1.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis import Whitening
from dragrig.analysis.gap.design import ColumnKind, Study
from dragrig.analysis.gap.diagnosis import ESTABLISHED, MODEL, SPECIMEN, UNEXPLAINED, BudgetEntry
from dragrig.analysis.gap.gap_reduction import folds_by_condition
from dragrig.analysis.gap.presence import CauseKind, CauseSet, Competition, Presence
from dragrig.rig import FloatArray, IndexArray

MIN_RUNS_HELD_OUT = 4
BOOTSTRAP_SAMPLES = 1000
MIN_GAP_OVER_NOISE = 0.1
"""Mean square of a gap above noise, relative to noise, below which shares of it mean nothing."""
EQUAL_LOG_ODDS = 3.0
"""Causes whose exchange changes the log odds by less cannot be separated: 20 to 1, as for a 95 % interval."""


@dataclass(frozen=True, slots=True, eq=False)
class _Contributions:
    """Gap, contributions of `K` parts, and rest of one run at its `B` blocks, without the run's zero [mN]."""

    gap: FloatArray
    parts: FloatArray
    noise_variance: FloatArray
    weights_s: FloatArray

    @property
    def sums(self) -> FloatArray:
        """Duration, and time integrals of noise, gap², parts · gap and parts², shape `(3 + 2 K,)`."""
        weights = self.weights_s
        with_gap, squares = (self.parts * self.gap) @ weights, self.parts**2 @ weights
        return np.concatenate(
            ([weights.sum(), weights @ self.noise_variance, weights @ self.gap**2], with_gap, squares)
        )


def force_budget(
    study: Study, competition: Competition, presence: Presence, established: Mapping[str, float]
) -> tuple[tuple[BudgetEntry, ...], float, bool]:
    """Return the parts of the force's gap, the gap's rms above noise [mN], and whether runs were held out.

    Parameters
    ----------
    established
        Probability of presence of the effects that are there.
    """
    chosen = presence.most_likely_with(tuple(established), competition)
    parts = _parts_of(competition, presence, chosen, established)
    contributions, held_out = _held_out_contributions(study, competition, list(parts.values()))
    rows = np.array([run.sums for run in contributions])
    total = rows.sum(axis=0)
    duration, noise, square = total[:3].tolist()
    if square - noise < MIN_GAP_OVER_NOISE * noise:
        return (), float(np.sqrt(max(square - noise, 0.0) / duration)), held_out
    shares = _shares(rows[None])[0]
    intervals = _share_intervals(rows)
    sizes = np.sqrt(total[3 + len(parts) :] / duration)
    # The rest has no column of its own: its mean square is what the parts leave of the gap.
    rest = [float(np.sum(run.weights_s * (run.gap - run.parts.sum(axis=0)) ** 2)) for run in contributions]
    rest_mN = float(np.sqrt(max(sum(rest) - noise, 0.0) / duration))
    entries = [
        BudgetEntry(
            cause,
            "force",
            float(shares[number]),
            intervals[number],
            float(sizes[number]),
            presence=established.get(cause, presence_of_part(presence, competition, parts[cause])),
            what=_words_of(competition, parts[cause]) if cause in {MODEL, SPECIMEN} else "",
            not_separable_from=_not_separable(cause, chosen, competition, presence) if cause in established else (),
        )
        for number, cause in enumerate(parts)
        if cause != UNEXPLAINED
    ]
    entries.sort(key=lambda entry: -entry.share)
    unnamed = parts.get(UNEXPLAINED, ())
    index = list(parts).index(UNEXPLAINED) if unnamed else -1
    share = 1.0 - sum(entry.share for entry in entries)
    size = float(np.hypot(sizes[index], rest_mN)) if unnamed else rest_mN
    left = BudgetEntry(UNEXPLAINED, "force", share, intervals[-1], size, what=_words_of(competition, unnamed))
    return (*entries, left), float(np.sqrt((square - noise) / duration)), held_out


def presence_of_part(presence: Presence, competition: Competition, causes: CauseSet) -> float:
    """Return the probability of the most probable cause of a part."""
    return max(presence.probabilities[competition.causes[index].name] for index, _ in causes)


def _parts_of(
    competition: Competition, presence: Presence, chosen: CauseSet, established: Mapping[str, float]
) -> dict[str, CauseSet]:
    """Group the causes of a set into parts of the budget; what is not established belongs to the unexplained rest."""
    parts: dict[str, CauseSet] = {}
    for index, scale in chosen:
        cause = competition.causes[index]
        likely = presence.probabilities[cause.name] > ESTABLISHED
        match cause.kind:
            case CauseKind.EFFECT if cause.name in established:
                part = cause.name
            case CauseKind.MODEL if likely:
                part = MODEL
            case CauseKind.RUN if likely:
                part = SPECIMEN
            case _:
                part = UNEXPLAINED
        parts[part] = (*parts.get(part, ()), (index, scale))
    return parts


def _words_of(competition: Competition, causes: CauseSet) -> str:
    return ", ".join(dict.fromkeys(competition.causes[index].name for index, _ in causes))


def _not_separable(name: str, chosen: CauseSet, competition: Competition, presence: Presence) -> tuple[str, ...]:
    """Return the effects that could take an effect's place in the most likely set."""
    causes = competition.causes
    others = {causes[index].name for index, _ in chosen} - {name}
    best = max((value for key, value in presence.log_odds.items() if key == chosen), default=-np.inf)
    rivals: dict[str, None] = {}
    for key, value in presence.log_odds.items():
        names = {causes[index].name for index, _ in key}
        extra = names - others
        if len(extra) == 1 and others <= names and value > best - EQUAL_LOG_ODDS:
            rival = next(iter(extra))
            if rival != name and presence.kinds[rival] is CauseKind.EFFECT:
                rivals[rival] = None
    return tuple(sorted(rivals))


def _held_out_contributions(
    study: Study, competition: Competition, parts: Sequence[CauseSet]
) -> tuple[list[_Contributions], bool]:
    """Predict every run from fits to the others, and split its gap into the parts of a set of causes."""
    design = competition.design
    nuisances = design.columns_of(ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR)
    columns, sds, members = _columns_of_parts(competition, parts)
    grams, values = [], []
    first = 0
    for run, whitening in zip(design.runs, competition.whitenings, strict=True):
        rows = slice(first, first + run.residual.size)
        first = rows.stop
        own = np.column_stack((run.residual, run.columns[:, nuisances], competition.columns[rows][:, columns] * sds))
        white = whitening.whiten(own)
        values.append(own)
        grams.append(white.T @ white)
    folds = folds_by_condition(study)
    held_out = len(study.runs) >= MIN_RUNS_HELD_OUT and len(folds) > 1
    total = np.sum(grams, axis=0)
    prior = design.prior_precision[nuisances], design.prior_mean[nuisances]
    contributions: dict[int, _Contributions] = {}
    for fold in folds if held_out else (tuple(range(len(study.runs))),):
        others = total - np.sum([grams[index] for index in fold], axis=0) if held_out else total
        coefficients = _fold_coefficients(others, prior, nuisances.size)
        for index in fold:
            contributions[index] = _split_run(study, competition, index, values[index], coefficients, members)
    return [contributions[index] for index in range(len(study.runs))], held_out


def _columns_of_parts(competition: Competition, parts: Sequence[CauseSet]) -> tuple[IndexArray, FloatArray, IndexArray]:
    """Return the columns of all parts, the prior sds of their coefficients, and the part that each belongs to."""
    columns, sds, members = [np.zeros(0, dtype=np.intp)], [np.zeros(0)], [np.zeros(0, dtype=np.intp)]
    for number, part in enumerate(parts):
        rows, sds_of_part = competition.scaled_columns(part)
        columns.append(rows - 1)
        sds.append(sds_of_part)
        members.append(np.full(rows.size, number))
    return np.concatenate(columns), np.concatenate(sds), np.concatenate(members)


def _fold_coefficients(
    total: FloatArray, prior: tuple[FloatArray, FloatArray], nuisances: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return nominal parameters fitted alone, coefficients of the causes, and what the parameters absorb of these.

    Columns have unit priors; the parameters' are given as precision and mean.
    """
    precision, mean = prior
    of_nominal, of_causes = slice(1, 1 + nuisances), slice(1 + nuisances, None)
    gram = total[of_nominal, of_nominal] + np.diag(precision + 1e-10 * np.diag(total)[of_nominal])
    moments = np.column_stack((total[of_nominal, 0] + precision * mean, total[of_nominal, of_causes]))
    solved = np.asarray(np.linalg.solve(gram, moments), dtype=np.float64)
    alone, absorbed = solved[:, 0], solved[:, 1:]
    reduced = total[of_causes, of_causes] - total[of_causes, of_nominal] @ absorbed
    moment = total[of_causes, 0] - total[of_causes, of_nominal] @ alone
    coefficients = np.asarray(np.linalg.solve(reduced + np.eye(len(reduced)), moment), dtype=np.float64)
    return alone, coefficients, absorbed


def _split_run(
    study: Study,
    competition: Competition,
    index: int,
    values: FloatArray,
    fitted: tuple[FloatArray, FloatArray, FloatArray],
    members: IndexArray,
) -> _Contributions:
    alone, coefficients, absorbed = fitted
    run, noise = competition.design.runs[index], study.problem.noises[index]
    nominal, causes = values[:, 1 : 1 + alone.size], values[:, 1 + alone.size :]
    gap = values[:, 0] - nominal @ alone
    each = (causes - nominal @ absorbed) * coefficients
    count = int(members.max(initial=-1)) + 1
    parts = np.stack([each[:, members == number].sum(axis=1) for number in range(count)]) if count else each.T[:0]
    zeroed = _without_zero(np.column_stack((gap, parts.T)), run.whitening, study.problem.zero_sds[index])
    blocks = study.runs[index].block_data.blocks
    # Scatter of repeats belongs to the floor: factors fitted to each run would take an effect out with them.
    variance = noise.white**2 / blocks.samples + noise.slow**2 + run.motion_sd**2 + run.repeat_sd**2
    weights = study.runs[index].coordinates.width_s
    return _Contributions(zeroed[:, 0], zeroed[:, 1:].T, variance, weights)


def _without_zero(values: FloatArray, whitening: Whitening, zero_sd: float) -> FloatArray:
    """Take out the run's zero, fitted together with its factors, of gap and contributions alike, shape `(B, m)`.

    Linear, so that contributions still sum to the gap.
    """
    if zero_sd <= 0:
        return values
    run_effects = whitening.run_effects
    precision = np.eye(run_effects.shape[1]) + run_effects.T @ run_effects
    factors = np.linalg.solve(precision, run_effects.T @ whitening.whiten_noise(values))
    return np.asarray(values - zero_sd * factors[0])


def _shares(rows: FloatArray) -> FloatArray:
    """Return the shares of all parts in each sample of runs, `(S, R, 3 + 2 K)` to `(S, K)`."""
    total = rows.sum(axis=1)
    parts = (rows.shape[2] - 3) // 2
    gap = np.maximum(total[:, 2] - total[:, 1], 1e-12)
    return np.asarray(total[:, 3 : 3 + parts] / gap[:, None])


def _share_intervals(rows: FloatArray, seed: int = 0) -> list[tuple[float, float] | None]:
    """Return bootstrap intervals over whole runs for each part, and last for the rest."""
    parts = (rows.shape[1] - 3) // 2
    if len(rows) < 3:
        return [None] * (parts + 1)
    samples = rows[np.random.default_rng(seed).integers(len(rows), size=(BOOTSTRAP_SAMPLES, len(rows)))]
    noise, square = samples.sum(axis=1)[:, 1:3].T
    # Samples of runs that show no gap have no shares.
    shares = _shares(samples[square - noise > MIN_GAP_OVER_NOISE * noise])
    if len(shares) < BOOTSTRAP_SAMPLES // 2:
        return [None] * (parts + 1)
    with_rest = np.column_stack((shares, 1.0 - shares.sum(axis=1)))
    low, high = np.quantile(with_rest, (0.025, 0.975), axis=0).tolist()
    return list(zip(low, high, strict=True))
