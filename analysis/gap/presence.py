"""Which causes of a gap are there, each judged beside all others that may be there, the unnamed ones included.

The force after the nominal model is taken as a sum of causes, of which each may be there or not. A cause is a Gaussian
random function of the runs: columns with independent standard normal coefficients, times a scale in mN that is itself
unknown. An effect of the catalogue is its own law, a smooth modulation of it, and a part of the free law of its
coordinate; an unnamed cause is a free function of one coordinate at one place; the nominal model's own parameters
and laws may be off by more than their priors allow. With Gaussian noise the evidence of each set of causes follows
by linear algebra (Bayesian variable selection; O'Hagan & Forster, Kendall's Advanced Theory of Statistics 2B, ch. 9),
and the probability that a cause is there is the sum over all sets that contain it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from math import log

import numpy as np

from dragrig.analysis import Whitening, solve_lower
from dragrig.analysis.gap.design import (
    NUISANCES,
    Candidate,
    ColumnKind,
    Design,
    EffectVariant,
    Study,
    added_force,
    chain_with,
    nominal_residuals,
    parameter_derivatives,
    project_dictionary,
    schur_complement,
    score_variants,
)
from dragrig.analysis.gap.features import EXCHANGE
from dragrig.analysis.gap.forward_selection import KNOT_PRIOR_SD_MN, ForceSearchResult, nonparametric_columns
from dragrig.analysis.gap.run_data import rms_where_active
from dragrig.rig import BoolArray, FloatArray, IndexArray
from dragrig.sim_backend.effects import Coordinate, Effect, Location, Role, find_effect

SCALES_MN = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""Scales of an effect or an unnamed law, equally likely: from the noise of the sensor to a relaxation's newtons. Of an
effect larger than that, another cause would make up the rest."""
MAX_PRIOR_SHARES = 5
"""Scales that share a prior probability; further, larger ones add to it, and make no small effect less likely."""
MODEL_SCALES = (3.0, 10.0, 30.0)
"""Factors on the priors of the nominal model: with priors of 2 % to 15 %, a model off by up to half."""
RUN_GAIN_SCALES = (0.03, 0.1, 0.3)
"""Relative scatter of a gain that each run has of its own, beyond that of the nominal model."""
EXCHANGE_SCALES = (1.0, 3.0)
"""Factors on the priors of a specimen, within which the runs after an exchange differ from those before. Specimens of
ten times the prior, or with numerics of their own, would be a free force of the later runs: a wall that lifts off at
the speeds that come last."""
EXCHANGES_TRIED = 3
"""Most likely runs before which the specimen was exchanged."""
MIN_RUNS_BEFORE_EXCHANGE = 5
"""A specimen whose first runs differ from its later ones is preconditioned, and nobody exchanged it."""
MODULATION_SD = 0.3
"""Smooth relative deviation of a real effect from the catalogue's law: real ones leave 10 to 40 % of its form."""
FREE_LAW_SD = 0.3
"""The same for the free law of the effect's own coordinate."""
FORM_LAWS: Mapping[Coordinate, tuple[str, ...]] = {
    Coordinate.SPEED: ("speed", "speed of sliding", "speed in the gut"),
    Coordinate.POSITION: ("place", "place in the gut"),
    Coordinate.SESSION: ("session",),
    Coordinate.STRAIN: ("load",),
    Coordinate.TIME: ("time at rest", "time at rest in the gut"),
    Coordinate.TRANSIENT: ("time since start and stop", "time since start and stop in the gut"),
}
"""Free laws of each coordinate, the one in the closed gut last."""
PARAMETERS, LAWS, IN_RELAXATIONS = "parameters of the model", "laws of the model", " in relaxations"
_SHEARED = PARAMETERS + IN_RELAXATIONS, LAWS + IN_RELAXATIONS
MODEL_LAWS: Mapping[tuple[Location, Coordinate], tuple[str, ...]] = {
    (Location.WALL, Coordinate.STRAIN): (PARAMETERS, LAWS, *_SHEARED),
    (Location.SPECIMEN, Coordinate.SESSION): _SHEARED,
}
"""Parts of the nominal model that act at a place as functions of a coordinate: its moduli over strain, and errors in
relaxations alone, which have a time of their own in the session."""
FORM_ERROR = 0.25
"""Error of each block relative to the gap there: what no smooth function of any coordinate covers."""
PRIOR_PROBABILITIES = {"effect": 0.08, "law": 0.03, "run": 0.03, "exchange": 0.003, "model": 0.15}
"""Prior probability of each cause by kind: of 25 effects about two, a wrong model in every second campaign. Files say
which specimen a run was made on, so that an exchange which they do not tell of is rare."""
KEPT_VARIANCE, MAX_CORE_COLUMNS = 0.999, 8
"""The variants of an effect span a space, of which this share of the whitened variance is kept."""
PERIODS_TRIED = 4
"""Best periods of a periodic effect, beside the nominal model and beside the best effect."""
SMOOTHING_BLOCKS = 5
MAX_CAUSES = 6
MAX_SETS_EXPANDED = 40
LOG_ODDS_WINDOW = 7.0
"""Sets are expanded down to these log odds against the best one: less likely ones cannot change a probability by more
than 0.1 % each."""


def form_laws(effect: str) -> tuple[str, ...]:
    """Return the free laws of the coordinate that an effect depends on."""
    return FORM_LAWS.get(find_effect(effect).coordinate, ())


def model_laws(effect: str) -> tuple[str, ...]:
    """Return the causes of the nominal model that act where an effect does, as functions of its coordinate.

    They are one question: runs tell them apart by less than the form error of an effect.
    """
    known = find_effect(effect)
    return MODEL_LAWS.get((known.location, known.coordinate), ())


class CauseKind(StrEnum):
    """Kind of a cause."""

    EFFECT = "effect"
    LAW = "law"
    RUN = "run"
    EXCHANGE = "exchange"
    MODEL = "model"


@dataclass(frozen=True, slots=True, eq=False)
class Cause:
    """A cause that may be there."""

    name: str
    """Id of an effect, or what an unnamed cause is a function of; several causes of a name exclude each other."""
    kind: CauseKind
    columns: IndexArray
    """Indices of its `k` columns."""
    sds: FloatArray
    """Prior standard deviations of their coefficients at scale 1, shape `(k,)`."""
    scales: tuple[float, ...]
    """Its possible scales."""
    direction: FloatArray | None = None
    """Direction of the coefficients in which it must be positive, shape `(k,)`; None for causes of either sign."""
    alternatives: int = 1
    """Number of causes of this name, among which its prior probability is shared."""
    detail: str = ""
    """Where or when it acts, to be said after its name."""
    span: "VariantSpan | None" = None
    """What its first columns are in all campaigns alike: variants of an effect, or functions of a free law, by their
    numbers; None of an effect that was fitted, and of an exchange.
    """

    @property
    def words(self) -> str:
        """Name with where or when it acts."""
        return f"{self.name} {self.detail}".rstrip()

    @property
    def log_prior_odds(self) -> float:
        """Prior log odds of one scale of this cause."""
        prior = PRIOR_PROBABILITIES[self.kind]
        return log(prior / (1 - prior)) - log(min(len(self.scales), MAX_PRIOR_SHARES) * self.alternatives)


@dataclass(frozen=True, slots=True, eq=False)
class VariantSpan:
    """Variants of an effect, or functions of a law, in terms of the first `k` columns of a cause."""

    variants: IndexArray
    """Their numbers among the variants of the effect, shape `(n,)`."""
    mixing: FloatArray
    """Coefficients of the columns that make up each variant at its default size, shape `(n, k)`."""
    sizes_mN: FloatArray
    """Root mean square of each variant at its default size where it acts, shape `(n,)`."""


CauseSet = tuple[tuple[int, int], ...]
"""Indices of causes, each with the index of its scale, ascending."""


@dataclass(frozen=True, slots=True, eq=False)
class Competition:
    """All causes that may be there, with what decides between them."""

    causes: tuple[Cause, ...]
    products: FloatArray
    """Products of residual (first) and columns, whitened, nuisances projected out, shape `(1 + C, 1 + C)`."""

    def scaled_columns(self, causes: CauseSet) -> tuple[IndexArray, FloatArray]:
        """Return the rows of a set's columns in `products`, and the prior sds of their coefficients."""
        rows = [1 + self.causes[index].columns for index, _ in causes]
        sds = [self.causes[index].sds * self.causes[index].scales[scale] for index, scale in causes]
        return np.concatenate((*rows, np.zeros(0, dtype=np.intp))), np.concatenate((*sds, np.zeros(0)))


@dataclass(frozen=True, slots=True, eq=False)
class ForceCompetition(Competition):
    """Causes of the gap in the force."""

    pieces: tuple[FloatArray, ...]
    """Columns at all blocks of all runs [mN per unit], side by side, of shape `(N, k)` each."""
    whitenings: tuple[Whitening, ...]
    """Whitening of each run, the form error included."""
    design: Design
    """Campaign around the parameters of the best hypothesis, with its nuisances."""
    periodic: Mapping[str, "PeriodicColumns"]
    """Of each periodic effect, its variants at all periods; empty where they were not asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class PeriodicColumns:
    """All variants of a periodic effect, two of each period, at their default sizes."""

    columns: IndexArray
    """Their columns, shape `(n,)`, those of a period one after the other."""
    sizes_mN: FloatArray
    """Root mean square of each where it acts, shape `(n,)`."""


class ColumnStore:
    """Collects columns and the causes that they belong to."""

    def __init__(self) -> None:
        self.columns: list[FloatArray] = []
        self.causes: list[Cause] = []
        self.periodic: Mapping[str, PeriodicColumns] = {}
        self._count = 0

    def add(self, columns: FloatArray) -> IndexArray:
        """Add columns of a cause that follows; return their indices."""
        self.columns.append(columns)
        self._count += columns.shape[1]
        return np.arange(self._count - columns.shape[1], self._count)

    def add_free(self, name: str, kind: CauseKind, columns: FloatArray, scales: tuple[float, ...]) -> IndexArray:
        """Add a cause whose columns all have prior sd 1 at scale 1, without those of zeros; return its columns."""
        kept = np.flatnonzero(np.abs(columns).sum(axis=0) > 0)
        added = self.add(columns[:, kept])
        if added.size:
            span = VariantSpan(kept, np.eye(added.size), np.ones(added.size))
            self.causes.append(Cause(name, kind, added, np.ones(added.size), scales, span=span))
        return added

    def columns_at(self, indices: IndexArray) -> FloatArray:
        """Return some columns, shape `(N, k)`."""
        starts = np.cumsum([0, *(block.shape[1] for block in self.columns)])
        owners = np.searchsorted(starts, indices, side="right") - 1
        pairs = zip(owners.tolist(), (indices - starts[owners]).tolist(), strict=True)
        return np.column_stack([self.columns[owner][:, column] for owner, column in pairs])

    def shared_priors(self) -> tuple[Cause, ...]:
        """Return all causes; those of a name share its prior probability."""
        names = [cause.name for cause in self.causes]
        return tuple(
            replace(cause, alternatives=max(cause.alternatives, names.count(cause.name))) for cause in self.causes
        )


def prepare_competition(search: ForceSearchResult, *, all_periods: bool = False) -> ForceCompetition:
    """Return all causes that may act on the force of a campaign, beside its nominal model.

    `all_periods` adds the columns of periodic effects at all periods, which campaigns are pooled by.
    """
    design = search.fitted
    whitenings = form_error_whitenings(design, search.nominal)
    store = collect_causes(search, search.study, design, whitenings, all_periods=all_periods)
    return _compete(design.with_columns(ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR), whitenings, store)


def form_error_whitenings(design: Design, nominal: Design) -> tuple[Whitening, ...]:
    """Return the whitening of each run, with the form error of what the nominal model leaves of it."""
    from scipy.ndimage import uniform_filter1d

    squares = (uniform_filter1d(left**2, SMOOTHING_BLOCKS, mode="nearest") for left in nominal_residuals(nominal))
    sizes = (np.sqrt(np.maximum(square, 0.0)) for square in squares)
    return tuple(run.whitening.with_form_error(FORM_ERROR * size) for run, size in zip(design.runs, sizes, strict=True))


def collect_causes(
    search: ForceSearchResult,
    study: Study,
    design: Design,
    whitenings: tuple[Whitening, ...],
    *,
    all_periods: bool = False,
) -> ColumnStore:
    """Return unnamed causes, effects as the dictionary has them and as they were fitted, and exchanges.

    Parameters
    ----------
    study, design, whitenings
        The runs that were searched, and further ones after them that may not have been made.
    all_periods
        Whether to add the columns of periodic effects at all periods, of which only the likely ones become causes.
    """
    store = ColumnStore()
    fits = sorted(search.fits, key=lambda fit: fit.chi2)
    free_laws = dict(_add_unnamed_causes(store, study, design))
    effects = _EffectCauses(store, study, design, whitenings, free_laws)
    for variants, alternatives in _variant_groups(search, design):
        effects.add_variants(variants, alternatives)
    fitted = [(candidate, fit.parameters.z) for fit in fits for candidate in fit.parameters.candidates]
    first_fitted = len(store.causes)
    for candidate, z in fitted:
        effects.add_fitted(candidate, z)
    best = store.causes[first_fitted : first_fitted + (len(fits[0].parameters.candidates) if fits else 0)]
    of_best = np.concatenate((np.zeros(0, dtype=np.intp), *(cause.columns for cause in best)))
    _add_exchanges(store, study, design, whitenings, np.unique(of_best), len(search.study.runs))
    if all_periods:
        store.periodic = effects.periodic_columns()
    return store


def _compete(design: Design, whitenings: tuple[Whitening, ...], store: ColumnStore) -> ForceCompetition:
    _, products = products_with_causes(design, whitenings, store.columns)
    return ForceCompetition(store.shared_priors(), products, tuple(store.columns), whitenings, design, store.periodic)


def products_with_causes(
    design: Design, whitenings: Sequence[Whitening], pieces: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return products of residual (first), nuisances and causes over the runs that have a whitening.

    Then those of residual and causes alone, the nuisances projected out.
    """
    nuisances = design.columns_of(ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR)
    total = np.zeros((1 + nuisances.size + sum(piece.shape[1] for piece in pieces),) * 2)
    for run, whitening, rows in zip(design.runs, whitenings, design.run_rows, strict=False):
        values = (run.residual[:, None], run.columns[:, nuisances], *(piece[rows] for piece in pieces))
        whitening.add_gram(total, np.concatenate(values, axis=1))
    of_causes, of_nuisances = np.arange(1 + nuisances.size, len(total)), 1 + np.arange(nuisances.size)
    return total, schur_complement(design, total, nuisances, of_causes, of_nuisances)


def _add_unnamed_causes(store: ColumnStore, study: Study, design: Design) -> Iterator[tuple[str, IndexArray]]:
    """Add free laws, gains of the runs, and errors of the model; yield the columns of each free law by its name."""
    predicted = [run.predicted for run in design.runs]
    for name, by_run in nonparametric_columns(study.runs, predicted, 0.0).items():
        values = np.concatenate(by_run) / KNOT_PRIOR_SD_MN
        yield name, store.add_free(name, CauseKind.LAW, values, SCALES_MN)
    force = np.concatenate(predicted)[:, None]
    of_run = np.repeat(np.arange(len(predicted)), [values.size for values in predicted])
    store.add_free(
        "gain of a run", CauseKind.RUN, force * (of_run[:, None] == np.arange(len(predicted))), RUN_GAIN_SCALES
    )
    for name, columns in _model_columns(study, design):
        store.add_free(name, CauseKind.MODEL, columns, MODEL_SCALES)


def _model_columns(study: Study, design: Design) -> Iterator[tuple[str, FloatArray]]:
    """Yield the directions in which the nominal model may be off, of all runs alike and of the relaxations alone.

    What is wrong in the relaxations need not be wrong in the drags: other strains, and another clamping.
    """
    sheared = np.concatenate(
        [np.full(run.coordinates.time_s.size, run.experiment.kind == "relaxation") for run in study.runs]
    )
    for name, kind in ((PARAMETERS, ColumnKind.NOMINAL), (LAWS, ColumnKind.MODEL_ERROR)):
        columns = np.concatenate(design.run_columns(kind))
        yield name, columns
        yield name + IN_RELAXATIONS, columns * sheared[:, None]


def _add_exchanges(
    store: ColumnStore, study: Study, design: Design, whitenings: Sequence[Whitening], fitted: IndexArray, made: int
) -> None:
    """Add the most likely exchanges that nobody recorded: all later runs are of a specimen with own parameters.

    Parameters
    ----------
    fitted
        Columns of the best explanation, beside which exchanges are looked for as well as without.
    made
        Number of runs that were made; further ones are after any exchange.
    """
    if made <= MIN_RUNS_BEFORE_EXCHANGE or not all(run.has_clock for run in study.runs[:made]):
        return
    nuisances = design.columns_of(ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR)
    own = np.flatnonzero(np.isin(nuisances, design.columns_of(ColumnKind.NOMINAL)))
    by_time = sorted(range(made), key=lambda index: study.runs[index].session_start_s)
    of_run = np.repeat(np.arange(len(design.runs)), [run.residual.size for run in design.runs])
    beside = store.columns_at(fitted) if fitted.size else np.zeros((of_run.size, 0))
    grams = []
    for index in by_time:
        run = design.runs[index]
        values = np.column_stack((run.residual, run.columns[:, nuisances], beside[of_run == index]))
        grams.append(whitenings[index].gram(values))
    later = np.cumsum(grams[::-1], axis=0)[::-1]
    chosen: dict[int, None] = {}
    for count in {0, fitted.size}:
        rows = np.arange(1 + nuisances.size + count)
        total = later[0][np.ix_(rows, rows)]
        tails = (tail[np.ix_(rows, rows)] for tail in later[MIN_RUNS_BEFORE_EXCHANGE:])
        evidence = np.array([_exchange_evidence(design, nuisances, own, total, tail) for tail in tails])
        likely = np.argsort(evidence)[::-1][:EXCHANGES_TRIED]
        chosen |= dict.fromkeys((MIN_RUNS_BEFORE_EXCHANGE + likely).tolist())
    columns = np.concatenate([run.columns[:, nuisances[own]] for run in design.runs])
    for boundary in chosen:
        later_runs = np.isin(of_run, by_time[boundary:]) | (of_run >= made)
        added = store.add(columns * later_runs[:, None])
        sds, when = np.ones(added.size), f"after run {boundary}"
        store.causes.append(
            Cause(
                EXCHANGE,
                CauseKind.EXCHANGE,
                added,
                sds,
                EXCHANGE_SCALES,
                alternatives=made - MIN_RUNS_BEFORE_EXCHANGE,
                detail=when,
            )
        )


def _exchange_evidence(
    design: Design, nuisances: IndexArray, own: IndexArray, total: FloatArray, later: FloatArray
) -> float:
    """Return the largest log evidence for other parameters in some runs.

    Parameters
    ----------
    own
        Which of the nuisances are a specimen's own.
    total, later
        Gram matrices of residual, nuisances, and `f` columns that are there as well, of all runs and of those.
    """
    size, first = nuisances.size, len(total)
    steps = np.block([[total, later[:, 1 + own]], [later[1 + own], later[np.ix_(1 + own, 1 + own)]]])
    products = schur_complement(design, steps, nuisances, np.arange(1 + size, len(steps)), np.arange(1, 1 + size))
    beside = np.arange(1, first - size)
    if beside.size:
        root = np.linalg.cholesky(products[np.ix_(beside, beside)] + np.eye(beside.size) / SCALES_MN[-1] ** 2)
        explained = np.linalg.solve(root, products[beside])
        products = products - explained.T @ explained
    rows = np.arange(first - size, len(products))
    return float(log_evidence(products[np.ix_(rows, rows)], products[rows, 0], np.array(EXCHANGE_SCALES)).max())


def _variant_groups(search: ForceSearchResult, design: Design) -> Iterator[tuple[tuple[int, ...], int]]:
    """Yield the variants that make up each cause, and how many causes the effect could have.

    All shapes of an effect span one cause. Periods are tried one by one: their sum would be any function at all.
    """
    projected = project_dictionary(search.nominal, search.nominal.total_gram(), *NUISANCES)
    scored = score_variants(projected, design.variants)
    beside_best = scored
    if scored.any():
        best = next(ranked for ranked in search.ranked if scored[ranked.variants[0]] > 0)
        beside_best = score_variants(projected.without(best.variants), design.variants)
    by_effect: dict[str, list[int]] = {}
    for index, variant in enumerate(design.variants):
        by_effect.setdefault(variant.effect.id, []).append(index)
    for indices in by_effect.values():
        effect = design.variants[indices[0]].effect
        if effect.phase is None:
            yield tuple(indices), 1
            continue
        groups: dict[float, list[int]] = {}
        for index in indices:
            groups.setdefault(design.variants[index].values[effect.period_parameter], []).append(index)
        chosen: dict[tuple[int, ...], None] = {}
        for llr in (scored, beside_best):
            ordered = sorted(groups.values(), key=lambda group: -float(llr[group].max()))
            chosen |= {tuple(group): None for group in ordered[:PERIODS_TRIED]}
        for group in chosen:
            yield group, len(groups)


class _EffectCauses:
    """Adds causes that are effects of the catalogue."""

    def __init__(
        self,
        store: ColumnStore,
        study: Study,
        design: Design,
        whitenings: tuple[Whitening, ...],
        free_laws: Mapping[str, IndexArray],
    ) -> None:
        self._store, self._study, self._design, self._whitenings = store, study, design, whitenings
        self._free_laws = free_laws
        self._widths_s = np.concatenate([run.coordinates.width_s for run in study.runs])
        self._in_closed_gut = np.concatenate(
            [
                np.full(run.residual.size, scene.gut_closed)
                for run, (scene, _) in zip(design.runs, study.scenes(design.z), strict=True)
            ]
        )
        self._modulations = np.concatenate([values.T for values in study.modulations])
        self._signatures = np.concatenate(design.run_columns(ColumnKind.VARIANT))
        names = [variant.effect.id for variant in design.variants]
        self._first = {name: names.index(name) for name in names}

    def periodic_columns(self) -> Mapping[str, PeriodicColumns]:
        """Add the variants of periodic effects at all periods; return which columns they are."""
        found = {}
        for name, first in self._first.items():
            variants = [at for at, variant in enumerate(self._design.variants) if variant.effect.id == name]
            if self._design.variants[first].effect.phase is not None:
                values = self._signatures[:, variants]
                found[name] = PeriodicColumns(self._store.add(values), self._sizes(values))
        return found

    def _sizes(self, values: FloatArray) -> FloatArray:
        return np.array([rms_where_active(column, self._widths_s) for column in values.T])

    def add_variants(self, variants: Sequence[int], alternatives: int) -> None:
        """Add the space that variants span; each has rms 1 mN where it acts."""
        values = self._signatures[:, list(variants)]
        sizes = self._sizes(values)
        acting = sizes > 0
        if not acting.any():
            return
        scales = sizes[acting] * np.sqrt(acting.sum())
        values = values[:, acting] / scales
        white = self._whitened(values)
        variances, vectors = np.linalg.eigh(white.T @ white)
        variances, vectors = variances[::-1], vectors[:, ::-1]
        kept = int(np.searchsorted(np.cumsum(variances), KEPT_VARIANCE * variances.sum())) + 1
        vectors = vectors[:, : min(kept, MAX_CORE_COLUMNS)]
        variant: EffectVariant = self._design.variants[variants[0]]
        direction = vectors.sum(axis=0) if variant.one_signed else None
        modulated = 1 if variant.effect.phase is None else 2
        numbers = np.array(variants, dtype=np.intp)[acting] - self._first[variant.effect.id]
        span = VariantSpan(numbers, scales[:, None] * vectors, sizes[acting])
        self._add(variant.effect, values @ vectors, direction, modulated, alternatives, span)

    def add_fitted(self, candidate: Candidate, z: FloatArray) -> None:
        """Add an effect with fitted parameters, and its derivatives by the uncertain ones."""
        study, chain = self._study, self._study.chain
        force, slopes = [], []
        for run, (scene, gain) in zip(study.runs, study.scenes(z), strict=True):
            change = added_force(chain_with([candidate], chain), scene, gain) - added_force(chain, scene, gain)
            force.append(run.block_means(change))
            slopes.append(run.block_means(parameter_derivatives([candidate], chain, scene, gain)).T)
        values = np.concatenate(force)
        size = rms_where_active(values, self._widths_s)
        if size == 0.0:
            return
        parameters = candidate.fitted_parameters
        shapes = [index for index, parameter in enumerate(parameters) if parameter.role is not Role.SIZE]
        sds = 0.5 * np.minimum(candidate.prior_sds(), [1.0 if p.role is Role.PHASE else np.inf for p in parameters])
        core = np.column_stack((values, (np.concatenate(slopes) * sds)[:, shapes])) / size
        core = core[:, np.abs(core).sum(axis=0) > 0]
        direction = np.eye(core.shape[1])[0] if candidate.effect.size.low >= 0 else None
        self._add(candidate.effect, core, direction, 1, 1)

    def _free_law_of(self, effect: Effect, core: FloatArray) -> IndexArray:
        """Return the columns of the free law of an effect's coordinate, in the closed gut for effects of it alone."""
        laws = [law for law in FORM_LAWS.get(effect.coordinate, ()) if law in self._free_laws]
        if not laws:
            return np.zeros(0, dtype=np.intp)
        beyond = np.any(core[~self._in_closed_gut] != 0)
        return self._free_laws[laws[-2 if beyond and len(laws) > 1 else -1]]

    def _whitened(self, values: FloatArray) -> FloatArray:
        pairs = zip(self._whitenings, self._design.run_rows, strict=True)
        return np.concatenate([whitening.whiten(values[rows]) for whitening, rows in pairs])

    def _add(
        self,
        effect: Effect,
        core: FloatArray,
        direction: FloatArray | None,
        modulated: int,
        alternatives: int,
        span: VariantSpan | None = None,
    ) -> None:
        forms = [MODULATION_SD * column[:, None] * self._modulations for column in core.T[:modulated]]
        own = self._store.add(np.concatenate((core, *forms), axis=1))
        free = self._free_law_of(effect, core)
        columns = np.concatenate((own, free))
        sds = np.concatenate((np.ones(own.size), np.full(free.size, FREE_LAW_SD)))
        signed = None if direction is None else np.append(direction, np.zeros(columns.size - direction.size))
        self._store.causes.append(
            Cause(effect.id, CauseKind.EFFECT, columns, sds, SCALES_MN, signed, alternatives, span=span)
        )


@dataclass(frozen=True, slots=True, eq=False)
class Presence:
    """Probabilities of causes, and the sets of causes that they come from."""

    probabilities: Mapping[str, float]
    """Probability that each cause is there, by name, of all that were tried."""
    kinds: Mapping[str, CauseKind]
    """Kind of each cause."""
    log_odds: Mapping[CauseSet, float]
    """Log posterior odds of every set that was compared, against the empty one."""
    by_model: Mapping[str, float] = field(default_factory=dict)
    """Probability that the nominal model's own laws are in the place of an effect, which is not there itself."""

    def most_likely_with(self, names: Sequence[str], competition: Competition) -> CauseSet:
        """Return the most likely set with causes of these names; missing ones are added at their best scale."""
        wanted = set(names)
        causes = competition.causes

        def missing(key: CauseSet) -> int:
            return len(wanted - {causes[index].name for index, _ in key})

        chosen = min(self.log_odds, key=lambda key: (missing(key), -self.log_odds[key]))
        for _ in range(missing(chosen)):
            present = {causes[index].name for index, _ in chosen}
            larger = [
                (value, key)
                for key, value in _SetEvidence(competition).with_further_cause(chosen)
                if any(causes[index].name in wanted - present for index, _ in key)
            ]
            chosen = max(larger, default=(0.0, chosen))[1]
        return chosen


def judge_presence(competition: Competition) -> Presence:
    """Return the probability that each cause is there.

    Sets are compared from the empty one on: the most likely set whose neighbours are not known is expanded by every
    further cause and by leaving out each of its own, until all likely sets are known.
    """
    evidence = _SetEvidence(competition)
    log_odds: dict[CauseSet, float] = {(): 0.0}
    expanded: set[CauseSet] = set()
    for _ in range(MAX_SETS_EXPANDED):
        best = max(log_odds.values())
        open_sets = [key for key, value in log_odds.items() if key not in expanded and value > best - LOG_ODDS_WINDOW]
        if not open_sets:
            break
        current = max(open_sets, key=lambda key: log_odds[key])
        expanded.add(current)
        if len(current) < MAX_CAUSES:
            for larger, value in evidence.with_further_cause(current):
                log_odds.setdefault(larger, value)
        for dropped in range(len(current)):
            smaller = current[:dropped] + current[dropped + 1 :]
            if smaller not in log_odds:
                log_odds[smaller] = evidence.reduced(smaller)[1]
    return presence_of(competition.causes, log_odds)


def presence_of(causes: Sequence[Cause], log_odds: Mapping[CauseSet, float]) -> Presence:
    """Return the probability that each cause is there, by the log posterior odds of the sets that were compared."""
    values = np.array(list(log_odds.values()))
    weights = np.exp(values - values.max())
    weights /= weights.sum()
    probabilities = dict.fromkeys((cause.name for cause in causes), 0.0)
    laws = {cause.name: set(model_laws(cause.name)) for cause in causes if cause.kind is CauseKind.EFFECT}
    by_model = dict.fromkeys((effect for effect, own in laws.items() if own), 0.0)
    for key, weight in zip(log_odds, weights.tolist(), strict=True):
        names = {causes[index].name for index, _ in key}
        for name in names:
            probabilities[name] += weight
        for effect in by_model.keys() - names:
            # An exchange is a function of the session, too, and leaves the question open between more than two.
            if names & laws[effect] and not (EXCHANGE in names and find_effect(effect).varies_in_session):
                by_model[effect] += weight
    return Presence(
        {name: min(value, 1.0) for name, value in probabilities.items()},
        {cause.name: cause.kind for cause in causes},
        log_odds,
        by_model,
    )


@dataclass(frozen=True)
class _SetEvidence:
    """Evidence of sets of causes against none."""

    competition: Competition

    @cached_property
    def _padded(self) -> tuple[IndexArray, FloatArray, BoolArray, FloatArray]:
        """Rows, sds and directions of all causes, padded to one length, shape `(K, k)`, and which are no padding."""
        causes = self.competition.causes
        width = max(cause.columns.size for cause in causes)
        rows = np.zeros((len(causes), width), dtype=np.intp)
        sds, directions = np.zeros((2, len(causes), width))
        for number, cause in enumerate(causes):
            rows[number, : cause.columns.size] = 1 + cause.columns
            sds[number, : cause.columns.size] = cause.sds
            if cause.direction is not None:
                directions[number, : cause.columns.size] = cause.direction
        return rows, sds, sds > 0, directions

    def with_further_cause(self, causes: CauseSet) -> Iterator[tuple[CauseSet, float]]:
        """Yield the set with every further cause at every scale, with its log posterior odds."""
        competition = self.competition
        explained, before = self.reduced(causes)
        present = {competition.causes[index].name for index, _ in causes}
        rows, sds, used, directions = self._padded
        grams = competition.products[rows[:, :, None], rows[:, None, :]]
        moments = competition.products[rows, 0]
        if causes:
            by_cause = explained[:, rows]
            grams = grams - np.einsum("ska,skb->kab", by_cause, by_cause, optimize=True)
            moments = moments - np.einsum("ska,s->ka", by_cause, explained[:, 0])
        grams = grams * (sds[:, :, None] * sds[:, None, :])
        moments = moments * sds
        numbers = [number for number, cause in enumerate(competition.causes) if cause.name not in present]
        for scale in range(max(len(cause.scales) for cause in competition.causes)):
            chosen = [number for number in numbers if scale < len(competition.causes[number].scales)]
            sizes = np.array([competition.causes[number].scales[scale] for number in chosen])
            gains = log_evidence(grams[chosen], moments[chosen], sizes, directions[chosen] * used[chosen])
            for number, gain in zip(chosen, gains.tolist(), strict=True):
                larger = tuple(sorted((*causes, (number, scale))))
                yield larger, before + gain + competition.causes[number].log_prior_odds

    def reduced(self, causes: CauseSet) -> tuple[FloatArray, float]:
        """Return what a set explains of all products, as a root of shape `(s, 1 + C)`, and its log posterior odds."""
        products = self.competition.products
        rows, sds = self.competition.scaled_columns(causes)
        if not rows.size:
            return np.zeros((0, len(products))), 0.0
        precision = products[np.ix_(rows, rows)] * np.outer(sds, sds) + np.eye(rows.size)
        root = np.asarray(np.linalg.cholesky(precision), dtype=np.float64)
        explained = solve_lower(root, products[rows] * sds[:, None])
        value = 0.5 * float(explained[:, 0] @ explained[:, 0]) - float(np.log(np.diag(root)).sum())
        value += sum(self.competition.causes[index].log_prior_odds for index, _ in causes)
        return explained, value + self._log_sign_probability(causes, root, explained[:, 0])

    def _log_sign_probability(self, causes: CauseSet, root: FloatArray, solved: FloatArray) -> float:
        """Return the log probability that one-signed causes are positive, against one half a priori."""
        from scipy.special import log_ndtr

        total, first = 0.0, 0
        for index, _ in causes:
            cause = self.competition.causes[index]
            if cause.direction is not None:
                direction = np.zeros(len(root))
                direction[first : first + cause.columns.size] = cause.direction
                white = solve_lower(root, direction)
                total += float(log_ndtr(white @ solved / np.sqrt(white @ white))) + log(2.0)
            first += cause.columns.size
        return total


def log_evidence(
    grams: FloatArray, moments: FloatArray, sizes: FloatArray, directions: FloatArray | float = 0.0
) -> FloatArray:
    """Return the log evidence of each cause at a scale against its absence, shape `(K,)`.

    Parameters
    ----------
    grams, moments
        Shapes `(K, k, k)` and `(K, k)`, or of one cause at all scales `(k, k)` and `(k,)`.
    sizes
        Scales, shape `(K,)`, or `(1,)` for all causes.
    directions
        Direction in which a cause must be positive, shape `(K, k)` or `(k,)`; zeros for either sign.
    """
    from scipy.special import log_ndtr

    width = grams.shape[-1]
    scaled = grams * (sizes**2)[:, None, None] + np.eye(width)
    # In the root of a matrix with a border stands what solves for the border, whose corner only has to be large enough.
    bordered = np.zeros((len(scaled), width + 2, width + 2))
    bordered[:, :width, :width], sides = scaled, bordered[:, width:, :width]
    sides[:, 0], sides[:, 1] = moments * sizes[:, None], directions
    bordered[:, width:, width:] = (1.0 + (sides**2).sum(axis=(1, 2)))[:, None, None] * np.eye(2)
    bordered = np.linalg.cholesky(bordered)  # which reads the lower triangle alone
    roots, fitted, along = bordered[:, :width, :width], bordered[:, width, :width], bordered[:, width + 1, :width]
    values = 0.5 * (fitted**2).sum(axis=1) - np.log(np.diagonal(roots, axis1=1, axis2=2)).sum(axis=1)
    spread = np.sqrt((along**2).sum(axis=1))
    signed = spread > 0
    ratio = np.divide((fitted * along).sum(axis=1), spread, out=np.zeros_like(spread), where=signed)
    return np.asarray(np.where(signed, values + log_ndtr(ratio) + log(2.0), values))
