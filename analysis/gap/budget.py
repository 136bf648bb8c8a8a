"""The gap as a budget: which share of it each cause has on held-out runs, and what is left.

The gap of a run is what the nominal model leaves of it when its parameters are fitted to the other runs. Fitted
together with the causes to the same other runs, the model leaves less; the difference is the sum of the causes'
contributions, each without what the nominal parameters absorb of it. A cause's share is the covariance of its
contribution with the gap, over the gap's mean square above noise: shares of all causes and the rest sum to 1.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from math import exp

import numpy as np

from dragrig.analysis.gap.design import ColumnKind, Study
from dragrig.analysis.gap.diagnosis import (
    ESTABLISHED,
    MIN_PROBABILITY,
    MODEL,
    SPECIMEN,
    SURE_EXCHANGE,
    UNEXPLAINED,
    BudgetEntry,
    Classification,
    GapBudget,
    RunContributions,
    Verdict,
)
from dragrig.analysis.gap.gap_reduction import folds_by_condition, without_own
from dragrig.analysis.gap.presence import (
    MODULATION_SD,
    CauseKind,
    CauseSet,
    Competition,
    ForceCompetition,
    Presence,
    form_laws,
    model_laws,
)
from dragrig.rig import FloatArray, IndexArray
from dragrig.sim_backend.effects import catalogue, hum_effect

BOOTSTRAP_SAMPLES = 1000
MIN_GAP_OVER_NOISE = 0.1
"""Mean square of a gap above noise, relative to noise, below which shares of it mean nothing."""
FORM_SHARE = MODULATION_SD**2
"""Share of an effect's squares that its form differs by from the catalogue's, which runs alike in form do not show."""
MAX_OWN_SIGMAS = 4.0
"""What a run itself is off by belongs to no cause, within the scatter of repeats: 1 run of 16,000 is beyond by chance.
At 2 standard deviations single relaxations of some newtons made up most of a gap that none of the causes has."""
SURE_PRESENCE = 0.9
"""Effects less likely than this may be absent in the intervals of the shares: the others are stated as there."""
OTHERS_TRUST = 0.5
"""Probability that a cause without a name, of the specimen or of the nominal model is what it seems, however sure the
competition is. Of 15 shares that these two had in 100 campaigns of the plant `drawn` (seed 77001), four were
theirs; 0.3 and 0.5 give the same intervals."""
TEMPERED = 0.5
"""Weight of the competition's log odds, as `PresenceWeights.competition`: it is surer than its forms allow."""
MAX_EXPLANATIONS = 12
"""Most likely explanations that the intervals of the shares comprise."""
EQUAL_LOG_ODDS = 3.0
"""Causes whose exchange changes the log odds by less cannot be separated: 20 to 1, as for a 95 % interval."""


@dataclass(frozen=True, slots=True, eq=False)
class _Contributions:
    """Gap and contributions of the `K` named parts of one run at its `B` blocks, without its own factors [mN]."""

    gap: FloatArray
    parts: FloatArray
    noise_variance: FloatArray
    weights_s: FloatArray
    acting: FloatArray
    """Contributions with what the nominal parameters absorb of them: none in a run where a part does not act."""

    @property
    def sums(self) -> FloatArray:
        """Duration, and time integrals of noise, gap², rest², parts · gap and parts², shape `(4 + 2 K,)`."""
        weights, rest = self.weights_s, self.gap - self.parts.sum(axis=0)
        squares = np.array([weights.sum(), weights @ self.noise_variance, weights @ self.gap**2, weights @ rest**2])
        return np.concatenate((squares, (self.parts * self.gap) @ weights, self.parts**2 @ weights))


@dataclass(frozen=True, slots=True, eq=False)
class CausesOfGap:
    """What causes the gap in the force of a campaign: all causes that may be there, and which are."""

    competition: ForceCompetition
    presence: Presence
    """Which causes are there by their competition alone."""
    effects: Mapping[str, float]
    """Probability that each effect on the force is there, by classifier and competition."""


def gap_budget(
    study: Study,
    causes: CausesOfGap,
    classification: Classification,
    in_position: Collection[str],
    fitted_position: str,
    position_share: tuple[float, tuple[float, float]] | None,
    lines_mN: Mapping[str, float],
) -> GapBudget:
    """Share the gap between its causes, in force and position.

    Parameters
    ----------
    in_position
        Effects that may be in the errors of the position; empty where it follows its command.
    fitted_position, position_share
        The effect that was fitted to the position, and its share there with the interval; empty and None for none.
    lines_mN
        Rms of the effects that are spectral lines, which block means average out.
    """
    established = {name: causes.effects[name] for name in classification.effects if name in causes.effects}
    force = force_budget(study, causes, established)
    entries, gap_mN = force.entries, force.gap_mN
    for line, rms_mN in lines_mN.items():
        if line in classification.effects:
            entries = with_line(entries, gap_mN, line, rms_mN, classification.marginal(line))
            gap_mN = float(np.hypot(gap_mN, rms_mN))
    entries = () if classification.verdict is Verdict.NO_GAP else entries
    if in_position and position_share is not None:
        share = position_share[0]
        interval = with_form_error(*position_share)
        rest = None if interval is None else (1.0 - interval[1], 1.0 - interval[0])
        if fitted_position in classification.effects:
            there = classification.marginal(fitted_position)
            entries = (
                *entries,
                BudgetEntry(fitted_position, "position", share, interval, None, presence=there),
                BudgetEntry(UNEXPLAINED, "position", 1.0 - share, rest, None),
            )
    presence = presence_of_effects(causes.effects, classification, in_position)
    return replace(force, presence=presence, entries=entries, gap_mN=gap_mN, runs=force.runs if entries else ())


def presence_of_effects(
    on_force: Mapping[str, float], classification: Classification, in_position: Collection[str]
) -> Mapping[str, float]:
    """Return the probability that each effect is there, by its id.

    Parameters
    ----------
    on_force
        Probability of each effect on the force.
    in_position
        Effects that may be in the errors of the position.
    """
    elsewhere = {name: classification.marginal(name) for name in (hum_effect().id, *in_position)}
    presence = dict.fromkeys(catalogue(), MIN_PROBABILITY) | dict(on_force) | elsewhere
    return {name: min(max(value, MIN_PROBABILITY), 1.0 - MIN_PROBABILITY) for name, value in presence.items()}


def with_line(
    entries: tuple[BudgetEntry, ...], gap_mN: float, line: str, rms_mN: float, presence: float
) -> tuple[BudgetEntry, ...]:
    """Add a spectral line, which block means average out, to the parts of the rest of the gap."""
    total = gap_mN**2 + rms_mN**2
    if total <= 0:
        return entries
    of_line = rms_mN**2 / total if entries else 1.0
    scaled = [
        replace(
            entry,
            share=entry.share * (1.0 - of_line),
            share_95ci=None
            if entry.share_95ci is None
            else (entry.share_95ci[0] * (1.0 - of_line), entry.share_95ci[1] * (1.0 - of_line)),
        )
        for entry in entries or (BudgetEntry(UNEXPLAINED, "force", 1.0, None, 0.0),)
    ]
    part = BudgetEntry(line, "force", of_line, None, rms_mN, presence=presence)
    return (*sorted((part, *scaled[:-1]), key=lambda entry: -entry.share), scaled[-1])


def force_budget(study: Study, causes: CausesOfGap, established: Mapping[str, float]) -> GapBudget:
    """Return the budget of the force alone.

    Parameters
    ----------
    established
        Probability of presence of the effects that are there.
    """
    competition, presence = causes.competition, causes.presence
    chosen = presence.most_likely_with(tuple(established), competition)
    parts = parts_of(competition, presence, chosen, established)
    weights = likely_explanations(causes, chosen, established)
    first, *others = held_out_explanations(
        study, causes, established, (chosen, *(key for key in weights if key != chosen))
    )
    unnamed = parts.pop(UNEXPLAINED, ())
    contributions, held_out = first.runs, first.held_out
    rows = np.array([run.sums for run in contributions])
    total = rows.sum(axis=0)
    duration, noise, square, rest = total[:4].tolist()
    if square - noise < MIN_GAP_OVER_NOISE * noise:
        return GapBudget(causes.effects, (), float(np.sqrt(max(square - noise, 0.0) / duration)), held_out)
    shares = (total[4 : 4 + len(parts)] / max(square - noise, 1e-12)).tolist()
    intervals = [
        with_form_error(share, interval)
        for share, interval in zip(
            (*shares, 1.0 - sum(shares)), share_intervals((first, *others), weights, tuple(parts)), strict=True
        )
    ]
    sizes = np.sqrt(total[4 + len(parts) :] / duration).tolist()
    entries = [
        BudgetEntry(
            cause,
            "force",
            shares[number],
            intervals[number],
            sizes[number],
            # That of a part with several causes is that of the most probable one.
            presence=established.get(
                cause, max(presence.probabilities[competition.causes[index].name] for index, _ in members)
            ),
            what=words_of(competition, members) if cause in {MODEL, SPECIMEN} else "",
            not_separable_from=_not_separable(cause, chosen, causes) if cause in established else (),
        )
        for number, (cause, members) in enumerate(parts.items())
    ]
    entries.sort(key=lambda entry: -entry.share)
    left_mN = float(np.sqrt(max(rest - noise, 0.0) / duration))
    left = BudgetEntry(
        UNEXPLAINED, "force", 1.0 - sum(shares), intervals[-1], left_mN, what=words_of(competition, unnamed)
    )
    gap_mN = float(np.sqrt((square - noise) / duration))
    runs = tuple(_contributions_to_run(study, index, split, tuple(parts)) for index, split in enumerate(contributions))
    return GapBudget(causes.effects, (*entries, left), gap_mN, held_out, runs)


def _contributions_to_run(study: Study, index: int, split: _Contributions, causes: Sequence[str]) -> RunContributions:
    run = study.runs[index]
    return RunContributions(
        file=run.file,
        kind=run.experiment.kind,
        label=run.label,
        channel="force",
        unit="mN",
        time_s=run.coordinates.time_s,
        width_s=split.weights_s,
        position_mm=run.coordinates.position_mm,
        gap=split.gap,
        parts=dict(zip(causes, split.parts, strict=True)),
        acting_mN=dict(zip(causes, np.sqrt((split.acting**2) @ split.weights_s / split.weights_s.sum()), strict=True)),
    )


def parts_of(
    competition: ForceCompetition, presence: Presence, chosen: CauseSet, established: Mapping[str, float]
) -> dict[str, CauseSet]:
    """Group the causes of a set into parts of the budget; what is not established belongs to the unexplained rest."""
    # A law of the coordinate that an established effect depends on is that effect in another form.
    by_presence = sorted(established, key=lambda name: established[name])
    form_of = {law: name for name in by_presence for law in (*form_laws(name), *model_laws(name))}
    parts: dict[str, CauseSet] = {}
    for index, scale in chosen:
        cause = competition.causes[index]
        likely = presence.probabilities[cause.name] > ESTABLISHED
        match cause.kind:
            case CauseKind.EFFECT if cause.name in established:
                part = cause.name
            case CauseKind.LAW | CauseKind.MODEL if cause.name in form_of:
                part = form_of[cause.name]
            case CauseKind.MODEL if likely:
                part = MODEL
            case CauseKind.RUN | CauseKind.EXCHANGE if likely:
                part = SPECIMEN
            case _:
                part = UNEXPLAINED
        parts[part] = (*parts.get(part, ()), (index, scale))
    return parts


def words_of(competition: Competition, causes: CauseSet) -> str:
    """Return the words for the causes of a set, once for causes that share them."""
    return ", ".join(dict.fromkeys(competition.causes[index].words for index, _ in causes))


def _not_separable(name: str, chosen: CauseSet, causes: CausesOfGap) -> tuple[str, ...]:
    """Return the effects that could take an effect's place in the most likely set, and the model that may share it.

    Effects that could by the competition alone, and are unlikely by all, are none.
    """
    presence, own = causes.presence, set(model_laws(name))

    def names_of(key: CauseSet) -> set[str]:
        return {causes.competition.causes[index].name for index, _ in key}

    others = names_of(chosen) - {name} - own
    rivals = {MODEL} if own & names_of(chosen) else set()
    least = presence.log_odds.get(chosen, -np.inf) - EQUAL_LOG_ODDS
    for names in (names_of(key) for key, value in presence.log_odds.items() if value > least):
        extra = names - others - own - {name}
        if names & own and name not in names:
            rivals.add(MODEL)
        if len(extra) == 1 and others <= names and name not in names:
            rivals |= {rival for rival in extra if presence.kinds[rival] is CauseKind.EFFECT}
    least_presence = exp(-EQUAL_LOG_ODDS) * causes.effects.get(name, 0.0)
    return tuple(sorted(rival for rival in rivals if rival == MODEL or causes.effects[rival] > least_presence))


@dataclass(frozen=True, slots=True, eq=False)
class _Explanation:
    """The gap of `R` runs that took no part in the fit, split by a set of causes with `J` columns."""

    causes: CauseSet
    parts: tuple[str, ...]
    members: IndexArray
    """Index of the part that each column belongs to; of unnamed ones the number of parts. Shape `(J,)`."""
    runs: tuple[_Contributions, ...]
    held_out: bool
    coefficients: FloatArray
    """Coefficients of the columns, by which each run was predicted, shape `(R, J)`."""
    moments: FloatArray
    """Time integrals of column times gap of each run, shape `(R, J)`."""
    root: FloatArray
    """Cholesky root of the posterior precision of the coefficients, all runs fitted, shape `(J, J)`."""

    def sampled_shares(self, samples: int, parts: Sequence[str], random: np.random.Generator) -> FloatArray:
        """Return shares of parts, other runs and other coefficients being as likely as these, shape `(S, K)`.

        Samples of runs that show no gap have no shares.
        """
        weights = random.dirichlet(np.ones(len(self.runs)), samples)
        noise, square = (weights @ np.array([run.sums for run in self.runs])[:, 1:3]).T
        deviations = np.linalg.solve(self.root.T, random.standard_normal((len(self.root), samples))).T
        explained = weights @ (self.coefficients * self.moments) + deviations * (weights @ self.moments)
        of_part = np.array([self.members == (self.parts.index(part) if part in self.parts else -1) for part in parts])
        shares = (
            explained @ of_part.reshape(len(parts), self.members.size).T / np.maximum(square - noise, 1e-12)[:, None]
        )
        return np.asarray(shares[square - noise > MIN_GAP_OVER_NOISE * noise])


def likely_explanations(
    causes: CausesOfGap, chosen: CauseSet, established: Mapping[str, float]
) -> dict[CauseSet, float]:
    """Return the most likely sets of causes that explain the runs, with their probabilities.

    They are the sets that the competition compared, and these without causes that may not be there: the competition is
    surer of its sets than it is right.
    """
    competition, presence = causes.competition, causes.presence

    def trust(name: str) -> float:
        if presence.kinds[name] is CauseKind.EFFECT:
            sure = established.get(name, 0.0) >= SURE_PRESENCE
            return 1.0 if sure else min(max(causes.effects[name], MIN_PROBABILITY), 1.0 - MIN_PROBABILITY)
        exchange = presence.kinds[name] is CauseKind.EXCHANGE
        return 1.0 if exchange and presence.probabilities[name] > SURE_EXCHANGE else OTHERS_TRUST

    names = {key: {competition.causes[index].name for index, _ in key} for key in (*presence.log_odds, chosen)}
    compared = {key: value for key, value in presence.log_odds.items() if names[key] >= set(established)}
    best = max(compared.values(), default=0.0)
    compared = compared or {chosen: best}
    weights: dict[CauseSet, float] = {}
    for key in sorted(compared, key=lambda key: -compared[key])[:MAX_EXPLANATIONS]:
        thinned: list[tuple[CauseSet, float]] = [((), exp(TEMPERED * (compared[key] - best)))]
        for member in key:
            there = trust(competition.causes[member[0]].name)
            thinned = [
                (kept, weight)
                for smaller, value in thinned
                for kept, weight in (((*smaller, member), value * there), (smaller, value * (1.0 - there)))
                if weight > 0
            ]
        for smaller, value in thinned:
            weights[smaller] = weights.get(smaller, 0.0) + value
    likely = sorted(weights, key=lambda key: -weights[key])[:MAX_EXPLANATIONS]
    total = sum(weights[key] for key in likely)
    return {key: weights[key] / total for key in likely}


def held_out_explanations(
    study: Study, causes: CausesOfGap, established: Mapping[str, float], sets: Sequence[CauseSet]
) -> list[_Explanation]:
    """Predict every run from fits to the others, and split its gap by each set of causes."""
    competition = causes.competition
    design = competition.design
    nuisances = design.columns_of(ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR)
    used = np.unique(np.concatenate([competition.scaled_columns(key)[0] - 1 for key in sets]))
    grams, values = [], []
    for run, whitening, rows in zip(design.runs, competition.whitenings, design.run_rows, strict=True):
        columns = np.concatenate([piece[rows] for piece in competition.pieces], axis=1)[:, used]
        own = np.column_stack((run.residual, run.columns[:, nuisances], columns))
        values.append(own)
        grams.append(whitening.gram(own))
    return [_held_out_explanation(study, causes, established, key, used, values, grams) for key in sets]


def _held_out_explanation(
    study: Study,
    causes: CausesOfGap,
    established: Mapping[str, float],
    key: CauseSet,
    used: IndexArray,
    values: Sequence[FloatArray],
    grams: Sequence[FloatArray],
) -> _Explanation:
    competition = causes.competition
    design = competition.design
    nuisances = design.columns_of(ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR)
    parts = parts_of(competition, causes.presence, key, established)
    unnamed = parts.pop(UNEXPLAINED, ())
    grouped = [*parts.values(), unnamed]
    rows, sds = competition.scaled_columns(tuple(entry for part in grouped for entry in part))
    columns, sizes = rows - 1, [sum(competition.causes[index].columns.size for index, _ in part) for part in grouped]
    members = np.repeat(np.arange(len(grouped)), sizes)
    chosen = np.append(np.arange(1 + nuisances.size), 1 + nuisances.size + np.searchsorted(used, columns))
    scales = np.append(np.ones(1 + nuisances.size), sds)
    each = [gram[np.ix_(chosen, chosen)] * np.outer(scales, scales) for gram in grams]
    folds = folds_by_condition(study)
    total = np.sum(each, axis=0)
    prior = design.prior_precision[nuisances], design.prior_mean[nuisances]
    found: dict[int, tuple[_Contributions, FloatArray, FloatArray]] = {}
    for fold in folds or (tuple(range(len(study.runs))),):
        others = total - np.sum([each[index] for index in fold], axis=0) if folds else total
        coefficients = _fold_coefficients(others, prior, nuisances.size)
        for index in fold:
            split = _split_run(
                study, competition, index, values[index][:, chosen] * scales, coefficients, members, len(parts)
            )
            found[index] = (split[0], coefficients[1], split[1])
    runs, by_run, moments = zip(*(found[index] for index in range(len(study.runs))), strict=True)
    root = np.linalg.cholesky(_fold_coefficients(total, prior, nuisances.size)[3])
    return _Explanation(
        key, tuple(parts), members, runs, bool(folds), np.array(by_run), np.array(moments), np.asarray(root)
    )


def _fold_coefficients(
    total: FloatArray, prior: tuple[FloatArray, FloatArray], nuisances: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return nominal parameters fitted alone, and of the causes: coefficients, what is absorbed of them, precision.

    Columns have unit priors; the parameters' are given as precision and mean.
    """
    precision, mean = prior
    of_nominal, of_causes = slice(1, 1 + nuisances), slice(1 + nuisances, None)
    gram = total[of_nominal, of_nominal] + np.diag(precision + 1e-10 * np.diag(total)[of_nominal])
    moments = np.column_stack((total[of_nominal, 0] + precision * mean, total[of_nominal, of_causes]))
    solved = np.asarray(np.linalg.solve(gram, moments), dtype=np.float64)
    alone, absorbed = solved[:, 0], solved[:, 1:]
    reduced = total[of_causes, of_causes] - total[of_causes, of_nominal] @ absorbed
    posterior = reduced + np.eye(len(reduced))
    moment = total[of_causes, 0] - total[of_causes, of_nominal] @ alone
    return alone, np.asarray(np.linalg.solve(posterior, moment), dtype=np.float64), absorbed, posterior


def _split_run(
    study: Study,
    competition: ForceCompetition,
    index: int,
    values: FloatArray,
    fitted: tuple[FloatArray, ...],
    members: IndexArray,
    named: int,
) -> tuple[_Contributions, FloatArray]:
    """Return the contributions to a run, and the time integral of each column times the gap."""
    alone, coefficients, absorbed, _ = fitted
    run, noise = competition.design.runs[index], study.problem.noises[index]
    nominal, causes = values[:, 1 : 1 + alone.size], values[:, 1 + alone.size :]
    gap = values[:, 0] - nominal @ alone
    columns = causes - nominal @ absorbed
    each = columns * coefficients
    parts, acting = (
        np.array([forces[:, members == number].sum(axis=1) for number in range(named)]).reshape(named, gap.size)
        for forces in (each, causes * coefficients)
    )
    # What the run itself is off by, as far as the best explanation of all runs leaves it; no more than repeats differ,
    # so that no run can make up for a cause.
    zero_sd, rest = study.problem.zero_sds[index], gap - each.sum(axis=1)
    gap = gap - (rest - without_own(rest, run.whitening, zero_sd, MAX_OWN_SIGMAS))
    blocks = study.runs[index].block_data.blocks
    variance = noise.white**2 / blocks.samples + noise.slow_sd**2 + run.motion_sd**2
    widths_s = study.runs[index].coordinates.width_s
    return _Contributions(gap, parts, variance, widths_s, acting), np.asarray((widths_s * gap) @ columns)


def with_form_error(share: float, interval: tuple[float, float] | None) -> tuple[float, float] | None:
    """Widen an interval by what the form of an effect leaves to others, or takes from them."""
    if interval is None:
        return None
    low, high = min(interval[0], share), max(interval[1], share)
    return share - float(np.hypot(share - low, FORM_SHARE)), share + float(np.hypot(high - share, FORM_SHARE))


def share_intervals(
    explanations: Sequence[_Explanation], weights: Mapping[CauseSet, float], parts: Sequence[str], seed: int = 0
) -> list[tuple[float, float] | None]:
    """Return 95 % intervals of the share of each part, and last of the rest.

    They are over what else explains the runs, over the runs, and over the coefficients that these fix.
    """
    nothing: list[tuple[float, float] | None] = [None] * (len(parts) + 1)
    if len(explanations[0].runs) < 3:
        return nothing
    random = np.random.default_rng(seed)
    sampled = [
        explanation.sampled_shares(round(BOOTSTRAP_SAMPLES * weights.get(explanation.causes, 0.0)), parts, random)
        for explanation in explanations
    ]
    shares = np.concatenate(sampled)
    if len(shares) < BOOTSTRAP_SAMPLES // 2:
        return nothing
    with_rest = np.column_stack((shares, 1.0 - shares.sum(axis=1)))
    low, high = np.quantile(with_rest, (0.025, 0.975), axis=0).tolist()
    return list(zip(low, high, strict=True))
