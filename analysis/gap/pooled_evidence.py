"""Evidence of one campaign on every cause that several campaigns may share: compact evidence, to be pooled.

Coefficients that campaigns can have in common belong to columns that mean the same in all of them: the variants of an
effect at their default sizes, the functions of a free law, the directions of the nominal model. Of each campaign the
information on these is kept, after its specimen, its runs and its own likely causes were projected out; and by how much
its own competition of causes, which knows free laws and other forms, finds an effect likelier or less likely than these
columns alone.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis.gap.presence import (
    Cause,
    CauseKind,
    CauseSet,
    Competition,
    PeriodicColumns,
    Presence,
    log_evidence,
)
from dragrig.rig import FloatArray, IndexArray

POOLED_SCALES_MN = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
"""Scales of what campaigns share: many of them show less than the sensor's noise."""
POOLED_MODEL_SCALES = (1.0, 3.0, 10.0)
"""Factors on the priors of the nominal model, by which all specimens may differ from it alike."""
FORM_COLUMNS = 4
"""Directions kept in which the form of an effect may differ from the catalogue's."""
STRONG = 0.9
"""Probability from which on an effect is counted among a campaign's own causes while others are looked at."""
POOLED_KINDS = (CauseKind.EFFECT, CauseKind.LAW, CauseKind.MODEL)


@dataclass(frozen=True, slots=True, eq=False)
class SharedColumns:
    """Columns of a cause that mean the same in every campaign."""

    name: str
    """Id of an effect, or the coordinate of a free law."""
    kind: CauseKind
    """Kind of the cause."""
    numbers: IndexArray
    """Numbers of the `n` variants or functions that act in this campaign, shape `(n,)`."""
    rows: IndexArray
    """Their rows in the information, shape `(n,)`."""
    form_rows: IndexArray
    """Rows of the directions in which the form may differ, at scale 1, shape `(r,)`."""
    sizes_mN: FloatArray
    """Root mean square of each at its default size where it acts, shape `(n,)`."""
    one_signed: bool
    """Whether its size is known to be positive."""
    scales: tuple[float, ...]
    """Possible scales."""
    forms: tuple[float, ...] = ()
    """At each scale, log Bayes factor of all forms of an effect beyond that of these columns; the same length."""
    elsewhere: float = 0.0
    """How much likelier the cause becomes by the campaign's other sets of causes; negative where these explain the
    same."""
    chi2: float = 0.0
    """Sum of squares of the residual beside which `elsewhere` holds."""


@dataclass(frozen=True, slots=True, eq=False)
class ForceEvidence:
    """Information of one campaign on all shared columns."""

    contexts: tuple[FloatArray, ...]
    """Products of residual (first) and columns, whitened, beside nuisances and some set of the campaign's own causes,
    shape `(1 + C, 1 + C)` each."""
    columns: Mapping[str, SharedColumns]
    """The columns of each cause."""
    context_of: Mapping[str, int]
    """Number of the context in which each cause is looked at: beside its likely companions."""

    def information_for(self, name: str) -> FloatArray:
        """Return the information beside the likely companions of a cause."""
        return self.contexts[self.context_of[name]]


def force_evidence(
    competition: Competition, presence: Presence, periodic: Mapping[str, PeriodicColumns]
) -> ForceEvidence:
    """Return the evidence of a campaign on the causes that it may share with others."""
    strong = {
        name
        for name, value in presence.probabilities.items()
        if presence.kinds[name] is CauseKind.EFFECT and value > STRONG
    }
    best = max(presence.log_odds, key=lambda key: presence.log_odds[key])
    own_causes = tuple(
        entry
        for entry in best
        if competition.causes[entry[0]].kind is not CauseKind.EFFECT or competition.causes[entry[0]].name in strong
    )
    layout = _Layout.of(competition, periodic)
    sets = _WeighedSets.of(competition, presence, strong)
    contexts = {name: sets.context(name, _without(competition, own_causes, name)) for name in layout.columns}
    different = tuple(dict.fromkeys(contexts.values()))
    projected = {
        causes: projected_out(competition.products, *competition.scaled_columns(causes)) for causes in different
    }
    evidence = ForceEvidence(
        tuple(map(layout.information, projected.values())),
        layout.columns,
        {name: different.index(causes) for name, causes in contexts.items()},
    )
    columns = {
        name: replace(
            shared,
            forms=_form_evidence(competition, projected[contexts[name]], evidence, shared),
            elsewhere=sets.log_odds_elsewhere(name, contexts[name]) if shared.kind is CauseKind.EFFECT else 0.0,
            chi2=float(evidence.information_for(name)[0, 0]),
        )
        for name, shared in layout.columns.items()
    }
    return replace(evidence, columns=columns)


@dataclass(frozen=True, slots=True, eq=False)
class _WeighedSets:
    """The sets of causes that a campaign weighed, whose effects are its own strong ones but for one in question."""

    own: Mapping[CauseSet, float]
    """Log odds of the sets that have strong effects alone."""
    log_odds: FloatArray
    """The same values, shape `(S,)`."""
    own_with: Mapping[str, Sequence[int]]
    """Of the sets in `own`, the numbers of those that have a cause, by its name."""
    beside: Mapping[str, Sequence[tuple[CauseSet, float]]]
    """Of the sets that have a cause, all else that is in them and their log odds, by its name."""

    @classmethod
    def of(cls, competition: Competition, presence: Presence, strong: set[str]) -> "_WeighedSets":
        causes = competition.causes
        own = dict[CauseSet, float]()
        own_with, beside = defaultdict[str, list[int]](list), defaultdict[str, list[tuple[CauseSet, float]]](list)
        for key, value in presence.log_odds.items():
            named = [causes[index] for index, _ in key]
            weak = {cause.name for cause in named if cause.kind is CauseKind.EFFECT} - strong
            if len(weak) > 1:
                continue
            names = weak or {cause.name for cause in named}
            for name in names:
                beside[name].append((_without(competition, key, name), value))
                if not weak:
                    own_with[name].append(len(own))
            if not weak:
                own[key] = value
        return cls(own, np.array(list(own.values())), own_with, beside)

    def context(self, name: str, default: CauseSet) -> CauseSet:
        """Return the causes beside which a cause is looked at: those of the best set that contains it."""
        return max(self.beside.get(name, ()), key=lambda found: found[1], default=(default, 0.0))[0]

    def log_odds_elsewhere(self, effect: str, context: CauseSet) -> float:
        """Return how much likelier an effect becomes by sets of causes other than those that it is looked at beside."""
        present = self.beside.get(effect, ())
        gained = lost = 0.0
        if here := [value for others, value in present if others == context]:
            everywhere = np.logaddexp.reduce([value for _, value in present])
            gained = float(everywhere - np.logaddexp.reduce(here))
        if context in self.own:
            without = np.ones(self.log_odds.size, dtype=bool)
            without[self.own_with.get(effect, [])] = False
            lost = float(np.logaddexp.reduce(self.log_odds[without])) - self.own[context]
        return gained - lost


def _form_evidence(
    competition: Competition, products: FloatArray, evidence: ForceEvidence, shared: SharedColumns
) -> tuple[float, ...]:
    """Return the part of other forms than the shared columns in the log Bayes factor of an effect, at each scale."""
    if shared.kind is not CauseKind.EFFECT or not shared.form_rows.size:
        return (0.0,) * len(shared.scales)
    cause = next(cause for cause in competition.causes if cause.name == shared.name and cause.span is not None)
    rows = 1 + cause.columns
    gram, moment = products[np.ix_(rows, rows)] * np.outer(cause.sds, cause.sds), products[rows, 0] * cause.sds
    information = evidence.information_for(shared.name)
    of_all = log_evidence(gram, moment, np.array(shared.scales), 0.0 if cause.direction is None else cause.direction)
    of_shared = [
        log_evidence(
            *normalised(information, shared, shared.sizes_mN, scale), np.array([scale]), float(shared.one_signed)
        )
        for scale in shared.scales
    ]
    return tuple((of_all - np.concatenate(of_shared)).tolist())


def _without(competition: Competition, causes: CauseSet, name: str) -> CauseSet:
    return tuple(entry for entry in causes if competition.causes[entry[0]].name != name)


@dataclass(frozen=True, slots=True, eq=False)
class _Layout:
    """Linear combinations of the competition's columns that are shared."""

    mixing: FloatArray
    """Coefficients of the competition's columns, residual first, of each shared one, shape `(1 + C, 1 + S)`."""
    columns: Mapping[str, SharedColumns]

    @classmethod
    def of(cls, competition: Competition, periodic: Mapping[str, PeriodicColumns]) -> "_Layout":
        """Place the columns of the causes that are shared; periodic ones are taken at all their periods instead."""
        pooled = {
            cause.name: (cause, cause.span)
            for cause in competition.causes
            if cause.span is not None and cause.kind in POOLED_KINDS and cause.name not in periodic
        }
        size = len(competition.products)
        residual = np.zeros((size, 1))
        residual[0] = 1.0
        blocks, columns = [residual], dict[str, SharedColumns]()

        def placed(block: FloatArray) -> IndexArray:
            first = sum(before.shape[1] for before in blocks)
            blocks.append(block)
            return np.arange(first, first + block.shape[1])

        for name, (cause, span) in pooled.items():
            width = span.mixing.shape[1]
            block = np.zeros((size, len(span.mixing)))
            block[1 + cause.columns[:width]] = span.mixing.T
            forms = np.zeros((size, 0))
            if cause.kind is CauseKind.EFFECT:
                forms = _form_directions(competition, cause, width)
            columns[name] = SharedColumns(
                name,
                cause.kind,
                span.variants,
                placed(block),
                placed(forms),
                span.sizes_mN,
                cause.direction is not None,
                POOLED_MODEL_SCALES if cause.kind is CauseKind.MODEL else POOLED_SCALES_MN,
            )
        for name, found in periodic.items():
            acting = np.flatnonzero(found.sizes_mN > 0)
            if not acting.size:
                continue
            block = np.zeros((size, acting.size))
            block[1 + found.columns[acting], np.arange(acting.size)] = 1.0
            columns[name] = SharedColumns(
                name,
                CauseKind.EFFECT,
                acting,
                placed(block),
                np.zeros(0, dtype=np.intp),
                found.sizes_mN[acting],
                False,
                POOLED_SCALES_MN,
            )
        return cls(np.concatenate(blocks, axis=1), columns)

    def information(self, products: FloatArray) -> FloatArray:
        """Return the products of residual and shared columns by those of the competition's columns."""
        from scipy.sparse import csr_array

        mixing = csr_array(self.mixing.T)
        return np.asarray(mixing @ (mixing @ products).T, dtype=np.float32)


def projected_out(products: FloatArray, rows: IndexArray, sds: FloatArray) -> FloatArray:
    """Return the products of all columns, some of them projected out within their priors."""
    precision = products[np.ix_(rows, rows)] * np.outer(sds, sds) + np.eye(rows.size)
    explained = np.linalg.solve(np.linalg.cholesky(precision), products[rows] * sds[:, None])
    # No more precisely than the products are kept: pooling takes most of its time here.
    explained = explained.astype(products.dtype)
    return np.asarray(products - explained.T @ explained)


def _form_directions(competition: Competition, cause: Cause, core: int) -> FloatArray:
    """Return the combinations of columns in which the form may differ most beside the core, shape `(1 + C, r)`."""
    rows, sds = 1 + cause.columns[core:], cause.sds[core:]
    products = competition.products
    core_rows = 1 + cause.columns[:core]
    gram = products[np.ix_(core_rows, core_rows)]
    cross = products[np.ix_(core_rows, rows)] * sds
    left = products[np.ix_(rows, rows)] * np.outer(sds, sds)
    ridge = 1e-6 * np.trace(gram) / core * np.eye(core)
    vectors = np.linalg.eigh(left - cross.T @ np.linalg.solve(gram + ridge, cross))[1]
    chosen = vectors[:, ::-1][:, :FORM_COLUMNS]
    directions = np.zeros((len(products), chosen.shape[1]))
    directions[rows] = sds[:, None] * chosen
    return directions


def normalised(
    information: FloatArray, shared: SharedColumns, sizes_mN: FloatArray, scale: float
) -> tuple[FloatArray, FloatArray]:
    """Return information matrix and vector of a cause, its other forms at a scale integrated out.

    Each column has rms 1 mN over the root of their number, so that coefficients with standard deviation `scale` make
    a force of about that size. Shapes `(n, n)` and `(n,)`.
    """
    rows = np.concatenate(([0], shared.rows, shared.form_rows))
    gram, moment = without_forms(information[None, rows[:, None], rows].astype(np.float64), sizes_mN, scale)
    return gram[0], moment[0]


def without_forms(products: FloatArray, sizes_mN: FloatArray, scale: float) -> tuple[FloatArray, FloatArray]:
    """Return information matrices and vectors of a cause in all campaigns, as `normalised` does in one.

    Parameters
    ----------
    products
        Of residual, shared columns and other forms, shape `(C, 1 + n + r, 1 + n + r)`.
    """
    count = sizes_mN.size
    unit = 1.0 / (sizes_mN * np.sqrt(count))
    kept = products[:, : 1 + count, : 1 + count]
    if products.shape[1] > 1 + count and scale > 0:
        own = np.eye(products.shape[1] - 1 - count) + scale**2 * products[:, 1 + count :, 1 + count :]
        cross = scale * products[:, 1 + count :, : 1 + count]
        kept = kept - cross.transpose(0, 2, 1) @ np.linalg.solve(own, cross)
    return kept[:, 1:, 1:] * np.outer(unit, unit), kept[:, 1:, 0] * unit
