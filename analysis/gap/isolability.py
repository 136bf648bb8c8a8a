"""Isolability: which effects a set of runs can tell apart, and the smallest effect that they would show.

Effects on the position are not whitened: an error matters only when it exceeds the encoder's count. Each is explained
by free-form model classes scored on held-out runs, as in a diagnosis.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, product
from math import sqrt
from statistics import median

import numpy as np

from dragrig.analysis import (
    Experiment,
    NominalModel,
    Progress,
    RunSelection,
    capitalise,
    count_text,
    counted,
    join_names,
    no_progress,
    single_blas_thread,
)
from dragrig.analysis.gap.design import (
    NUISANCES,
    RELATIVE_RIDGE,
    Candidate,
    ColumnKind,
    Design,
    EffectVariant,
    Study,
    forms_of,
    gauss_newton_step,
    linearise,
    project_dictionary,
    rank_effects,
)
from dragrig.analysis.gap.diagnosis import display_name
from dragrig.analysis.gap.features import gap_weight
from dragrig.analysis.gap.position_channel import (
    MIN_POSITION_SHARE,
    PositionErrors,
    position_errors,
    predicted_position_error,
    score_model_classes,
)
from dragrig.analysis.gap.run_data import rms_where_active
from dragrig.analysis.gap.spectral_lines import MIN_MAINS_LLR, detectable_line_amplitude
from dragrig.analysis.gap.studies import prepare_study
from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import Channel, Effect, catalogue

DETECTABLE_D_PRIME = 5.9
"""d′ that is nearly always detected, for effects with full weight in the gate."""
DEFAULT_TOLERANCE_MN = 0.5
"""Default tolerance: smallest relevant rms force of an effect where it acts [mN]."""
DETECTED_SHARE = 0.8
"""Share of the effects that are detectable at the detection limit."""


def required_d_prime(effect: str) -> float:
    """Return the d′ at which an effect on the force is nearly always detected."""
    return DETECTABLE_D_PRIME / sqrt(gap_weight(effect))


def detection_limit(study: Study, design: Design) -> float:
    """Return the rms force [mN], where an effect acts, above which most effects are detectable."""
    limits_mN = []
    ranked = rank_effects(project_dictionary(design, design.total_gram(), *NUISANCES), design.variants)
    for ranked_effect in ranked:
        rms = variant_rms(study, design, ranked_effect.variants[0])
        if ranked_effect.d_prime_per_unit > 0 and rms > 0:
            limits_mN.append(required_d_prime(ranked_effect.effect) / ranked_effect.d_prime_per_unit * rms)
    return (
        float(np.quantile(limits_mN, DETECTED_SHARE))
        if limits_mN
        else float(np.median([noise.white for noise in study.problem.noises]))
    )


def variant_rms(study: Study, design: Design, variant: int) -> float:
    """Return the rms force [mN] of a variant of the dictionary where it acts; 0 where it never does."""
    column = design.columns_of(ColumnKind.VARIANT)[variant]
    weights = np.concatenate([run.coordinates.width_s for run in study.runs])
    force = np.concatenate([run_design.columns[:, column] for run_design in design.runs])
    return rms_where_active(force, weights)


MIN_SIGNATURE_CHI2 = 1e-6
"""Signatures with a smaller chi-square are 0."""


@dataclass(frozen=True, slots=True)
class VariantColumns:
    """Columns of one variant in the dictionary; two in quadrature for a periodic effect."""

    effect: str
    variants: tuple[int, ...]
    one_signed: bool
    d_prime: float


@dataclass(frozen=True, eq=False)
class SignatureAngles:
    """All visible variants of the effects, and the angles between them."""

    variants: tuple[VariantColumns, ...]
    """Variants with a signature beside the nuisances."""
    cos2: FloatArray
    """Share of each variant's squares that each other variant explains, averaged over phases, shape `(F, F)`."""

    @classmethod
    def of(cls, design: Design) -> "SignatureAngles":
        """Compute the angles from a design with its dictionary."""
        gram = project_dictionary(design, design.total_gram(), *NUISANCES).gram
        variants = tuple(_variant_columns(design.variants, gram))
        basis = _orthonormal_basis(variants, gram)
        products = basis @ gram @ basis.T
        starts = np.concatenate(([0], np.cumsum([len(variant.variants) for variant in variants])[:-1])).astype(np.intp)
        if not variants:
            return cls((), np.zeros((0, 0)))
        counts = np.array([len(variant.variants) for variant in variants], dtype=np.float64)
        squares = np.add.reduceat(np.add.reduceat(products**2, starts, axis=0), starts, axis=1) / counts[:, None]
        one_signed = np.array([variant.one_signed for variant in variants])
        opposed = products[np.ix_(starts, starts)] < 0
        squares[opposed & one_signed[:, None] & one_signed[None, :]] = 0.0
        for number, variant_columns in enumerate(variants):
            if design.variants[variant_columns.variants[0]].effect.periodic_in_session:
                free_phase = _free_phase_shares(design, variant_columns.variants, basis)
                squares[:, number] = np.maximum(squares[:, number], np.add.reduceat(free_phase, starts) / counts)
        return cls(variants, np.clip(squares, 0.0, 1.0))

    @cached_property
    def effects(self) -> tuple[str, ...]:
        """Visible effects, in the catalogue's order."""
        return tuple(dict.fromkeys(variant.effect for variant in self.variants))

    def variants_of_effect(self, name: str) -> list[int]:
        """Return the indices of an effect's variants."""
        return [number for number, variant in enumerate(self.variants) if variant.effect == name]

    def sin2(self, effect: str, rival: str) -> FloatArray:
        """Return the share of each variant of an effect that the best variant of a rival leaves."""
        return np.asarray(
            1.0 - self.cos2[np.ix_(self.variants_of_effect(effect), self.variants_of_effect(rival))].max(axis=1)
        )

    def d_primes(self, name: str) -> FloatArray:
        """Return d′ of an effect's variants at the default size, shape `(variants,)`."""
        return np.array([self.variants[index].d_prime for index in self.variants_of_effect(name)])


def _variant_columns(variants: Sequence[EffectVariant], gram: FloatArray) -> list[VariantColumns]:
    visible = []
    for index in forms_of(variants):
        strength = float(np.mean(np.diag(gram)[list(index)]))
        if strength > MIN_SIGNATURE_CHI2:
            first = variants[index[0]]
            visible.append(VariantColumns(first.effect.id, index, first.one_signed, float(np.sqrt(strength))))
    return visible


def _orthonormal_basis(variants: Sequence[VariantColumns], gram: FloatArray) -> FloatArray:
    """Return the transformation that makes each variant's columns orthonormal, shape `(all columns, S)`."""
    rows = []
    for variant in variants:
        index = list(variant.variants)
        gram_of_variant = gram[np.ix_(index, index)]
        root = np.linalg.cholesky(gram_of_variant + 1e-9 * np.trace(gram_of_variant) * np.eye(len(index)))
        row = np.zeros((len(index), len(gram)))
        row[:, index] = np.linalg.inv(root)
        rows.append(row)
    return np.concatenate(rows) if rows else np.zeros((0, len(gram)))


def _free_phase_shares(design: Design, pair: Sequence[int], basis: FloatArray) -> FloatArray:
    """Return the share of each orthonormal column that a pair explains with amplitude and phase in every run.

    Effects periodic in time may lose their phase between runs; a diagnosis allows for it and may be misled by it.
    """
    nuisances, variants = 1 + design.columns_of(*NUISANCES), 1 + design.columns_of(ColumnKind.VARIANT)
    pair_rows = variants[list(pair)]
    total = design.total_gram()
    gram = total[np.ix_(nuisances, nuisances)]
    precision_matrix = gram + np.diag(design.prior_precision[nuisances - 1] + RELATIVE_RIDGE * np.diag(gram))
    grams = [
        run_gram for run_gram in design.grams if np.trace(run_gram[np.ix_(pair_rows, pair_rows)]) > MIN_SIGNATURE_CHI2
    ]
    by_nuisance = np.concatenate([run_gram[np.ix_(nuisances, pair_rows)] for run_gram in grams], axis=1)
    coefficients = np.linalg.solve(precision_matrix, by_nuisance)
    pair_gram = np.zeros((by_nuisance.shape[1],) * 2)
    for place, run_gram in enumerate(grams):
        block = slice(2 * place, 2 * place + 2)
        pair_gram[block, block] = run_gram[np.ix_(pair_rows, pair_rows)]
    pair_gram -= by_nuisance.T @ coefficients
    cross = np.concatenate([run_gram[np.ix_(variants, pair_rows)] for run_gram in grams], axis=1)
    moment = basis @ (cross - total[np.ix_(variants, nuisances)] @ coefficients)
    pair_gram += 1e-9 * np.trace(pair_gram) / len(pair_gram) * np.eye(len(pair_gram))
    return np.asarray(np.sum(moment * np.linalg.solve(pair_gram, moment.T).T, axis=1))


def order_by_similarity(names: Sequence[str], sin2: Mapping[frozenset[str], float]) -> tuple[str, ...]:
    """Order names by average linkage of their angles, similar ones adjacent."""
    from scipy.cluster.hierarchy import leaves_list, linkage

    if len(names) < 3:
        return tuple(names)
    distances = np.array([np.sqrt(sin2[frozenset(pair)]) for pair in combinations(names, 2)])
    order: list[int] = leaves_list(linkage(distances, "average", optimal_ordering=True)).tolist()
    return tuple(names[index] for index in order)


CONFUSED_POSITION_SIN2 = 1.0 - MIN_POSITION_SHARE
"""A rival of an effect on the position that leaves a smaller share of its squares may be named in its place."""
CONFUSED_SIN2 = 0.17
"""A rival that leaves a smaller share of an effect's squares is hardly distinguishable: a real effect of the same kind
deviates by up to 0.41 of the norm from the catalogue's best fit (`bench/forms.py`), hence by 0.17 of its squares."""


@dataclass(frozen=True, slots=True)
class Visibility:
    """How clearly runs show an effect."""

    effect: str
    channel: str
    """Where it is visible: `force`, `position`, or `spectrum` for a line that block means average out."""
    d_prime: float
    """At the default size, median over its variants: norm of the whitened signature with nuisances projected out."""
    usual: float
    smallest: float | None
    unit: str
    """`usual`, `smallest`, `unit`: default size, and smallest detectable size, median over its variants; None where no
    run shows it."""
    smallest_mN: float | None = None
    """Rms force of the smallest where it acts; None for effects on the position."""


@dataclass(frozen=True, slots=True)
class EffectPair:
    """Two effects and the angle between them."""

    effects: tuple[str, str]
    channel: str
    sin2: float
    """sin² of the angle: minimum over the variants of both, with signs where amplitudes have one."""
    typical_sin2: tuple[float, float]
    """Share of the first that the second leaves, median over the first's variants, and vice versa."""
    d_prime: tuple[float, float]
    """d′ between the two, each at its default size in turn and the other at its best, median over variants."""
    confused: bool
    """Whether these runs can hardly distinguish them."""

    @property
    def separation(self) -> float:
        """The smaller d′ of the two."""
        return min(self.d_prime)


@dataclass(frozen=True, slots=True)
class Isolability:
    """Which effects a set of runs can tell apart."""

    source: str
    """Name of the plan or campaign."""
    planned: bool
    """Whether the runs are still to be made."""
    runs: Mapping[str, int]
    """Number of runs by kind that a diagnosis uses."""
    duration_s: float | None
    """Rig time with rests and returns; None if unknown."""
    effects: tuple[Visibility, ...]
    """Visibility of each effect; on the force, similar effects are adjacent."""
    pairs: tuple[EffectPair, ...]
    """All pairs within a channel, the most similar first."""
    remarks: tuple[str, ...] = ()
    """Questions not analysed, a sentence each."""
    backends: tuple[str, ...] = ()
    """Where the runs come from; those of a plan are simulated."""

    def visible_in(self, channel: str) -> tuple[Visibility, ...]:
        """Return the visible effects of a channel, in order."""
        return tuple(
            visibility
            for visibility in self.effects
            if visibility.channel == channel and visibility.smallest is not None
        )

    @property
    def invisible(self) -> tuple[str, ...]:
        """Effects that no run shows at their default size."""
        return tuple(
            visibility.effect
            for visibility in self.effects
            if visibility.smallest is None or visibility.d_prime < DETECTABLE_D_PRIME
        )

    @property
    def confused(self) -> tuple[EffectPair, ...]:
        """Pairs that these runs can hardly distinguish, the most similar first."""
        return tuple(pair for pair in self.pairs if pair.confused)

    def pair(self, name: str, other_name: str) -> EffectPair | None:
        """Return the pair of two effects; None if they are not of one channel."""
        return next((pair for pair in self.pairs if set(pair.effects) == {name, other_name}), None)

    def summary(self) -> Mapping[str, float]:
        """Return the figures by which plans are compared, of effects on the force."""
        pairs = [pair for pair in self.pairs if pair.channel == "force"]
        seen = self.visible_in("force")
        ratios = [visibility.smallest / abs(visibility.usual) for visibility in seen if visibility.smallest is not None]
        return {
            "pairs": len(pairs),
            "confused": sum(pair.confused for pair in pairs),
            "below_half": sum(pair.sin2 < 0.5 for pair in pairs),
            "least_sin2": min((pair.sin2 for pair in pairs), default=float("nan")),
            "median_sin2": median([pair.sin2 for pair in pairs]) if pairs else float("nan"),
            "least_d_prime": min((pair.separation for pair in pairs), default=float("nan")),
            "median_d_prime": median([pair.separation for pair in pairs]) if pairs else float("nan"),
            "median_least_over_usual": median(ratios) if ratios else float("nan"),
            "largest_least_over_usual": max(ratios, default=float("nan")),
        }


MAX_VARIANTS = 3
"""Number of variants of a position effect that are tried, evenly spaced in its grid."""
TRIAL_PHASE_RAD = 0.7


@dataclass(frozen=True, slots=True)
class _PositionTrial:
    """One variant of a position effect: error over the detectable one, and the share left by each model class."""

    error_ratio: float
    remaining_shares: Mapping[str, float]


def position_isolability(
    experiments: Sequence[Experiment], effects: Sequence[Effect]
) -> tuple[tuple[Visibility, ...], tuple[EffectPair, ...]]:
    """Return visibility and pairs of the effects on the position."""
    runs = position_errors(experiments)
    position_effects = [effect for effect in effects if effect.channel is Channel.POSITION]
    trials = {
        acting.id: [_position_trial(candidate, runs) for candidate in _trial_candidates(acting)] if runs else []
        for acting in position_effects
    }
    visibilities = tuple(_position_visibility(acting, trials[acting.id]) for acting in position_effects)
    shown = tuple(visibility.effect for visibility in visibilities if visibility.smallest is not None)
    return visibilities, tuple(_position_pair(pair, trials) for pair in combinations(shown, 2))


def _trial_candidates(effect: Effect) -> Iterator[Candidate]:
    grid = list(product(*(parameter.start_values for parameter in effect.shapes)))
    indices = np.unique(np.linspace(0, len(grid) - 1, min(MAX_VARIANTS, len(grid))).round().astype(int)).tolist()
    phase = {} if effect.phase is None else {effect.phase.name: TRIAL_PHASE_RAD}
    for index in indices:
        shapes = {parameter.name: value for parameter, value in zip(effect.shapes, grid[index], strict=True)}
        yield Candidate(effect, {**effect.defaults, **shapes, **phase})


def _position_trial(candidate: Candidate, runs: Sequence[PositionErrors]) -> _PositionTrial:
    errors = [predicted_position_error(candidate, run) for run in runs]
    error_ratio = max(
        float(np.sqrt(np.mean(error**2))) / run.detectable_mm for run, error in zip(runs, errors, strict=True)
    )
    shifted = [replace(run, error_mm=run.error_mm + error) for run, error in zip(runs, errors, strict=True)]
    shares = {model_class.effect: 1.0 - model_class.held_out_share for model_class in score_model_classes(shifted)}
    # What these runs cannot tell from other errors, as play in one direction alone, is not looked for in them.
    return _PositionTrial(error_ratio if candidate.effect.id in shares else 0.0, shares)


def _position_visibility(effect: Effect, trials: Sequence[_PositionTrial]) -> Visibility:
    size, unit = effect.size.default, effect.size.unit
    ratios = [trial.error_ratio for trial in trials if trial.error_ratio > 0]
    if not ratios:
        return Visibility(effect.id, "position", 0.0, size, None, unit)
    return Visibility(
        effect.id, "position", DETECTABLE_D_PRIME * median(ratios), size, median(size / value for value in ratios), unit
    )


def _position_pair(pair: tuple[str, str], trials: Mapping[str, Sequence[_PositionTrial]]) -> EffectPair:
    left = [
        np.clip([trial.remaining_shares[rival] for trial in trials[truth]], 0.0, 1.0)
        for truth, rival in (pair, pair[::-1])
    ]
    d_primes = [DETECTABLE_D_PRIME * np.array([trial.error_ratio for trial in trials[truth]]) for truth in pair]
    return _pair_of_variants(pair, "position", left, d_primes, CONFUSED_POSITION_SIN2)


def _pair_of_variants(
    pair: tuple[str, str],
    channel: str,
    left: Sequence[FloatArray],
    d_primes: Sequence[FloatArray],
    confused_sin2: float,
) -> EffectPair:
    """Return a pair by the share that the rival leaves of each variant, and the variant's own d′, of both effects."""
    first, second = (float(np.median(own * np.sqrt(share))) for own, share in zip(d_primes, left, strict=True))
    sin2 = min(float(share.min()) for share in left)
    typical = float(np.median(left[0])), float(np.median(left[1]))
    confused = sin2 < confused_sin2 or min(first, second) < DETECTABLE_D_PRIME
    return EffectPair(pair, channel, sin2, typical, (first, second), confused)


NOMINAL_COST, DICTIONARY_COST, PAIRS_COST, LINES_COST, POSITION_COST = 26, 18, 7, 1, 71
"""Relative times of the parts of an isolability."""


@single_blas_thread()
def isolate(
    selection: RunSelection,
    nominal: NominalModel,
    excluded: Sequence[str] = (),
    *,
    source: str = "",
    planned: bool = False,
    duration_s: float | None = None,
    progress: Progress = no_progress,
) -> Isolability:
    """Return which effects runs of a specimen can tell apart, and the smallest detectable sizes.

    Parameters
    ----------
    excluded
        Effects to leave out.

    Raises
    ------
    AnalysisError
        Where the model predicts nothing of these runs.
    """
    effects = [effect for effect in catalogue().values() if effect.id not in excluded]
    advance = counted(progress, NOMINAL_COST + DICTIONARY_COST + PAIRS_COST + LINES_COST + POSITION_COST)
    study = prepare_study(selection, nominal, [effect for effect in effects if effect.has_force_signature])
    point = gauss_newton_step(linearise(study, study.initial_z))
    advance(NOMINAL_COST)
    design = linearise(study, point.z, dictionary=True)
    advance(DICTIONARY_COST)
    angles = SignatureAngles.of(design)
    pairs = [_force_pair(angles, pair) for pair in combinations(angles.effects, 2)]
    order = order_by_similarity(
        angles.effects, {frozenset(effect_pair.effects): effect_pair.sin2 for effect_pair in pairs}
    )
    visible = {name: _force_visibility(study, design, angles, name) for name in order}
    invisible = [
        Visibility(effect.id, "force", 0.0, effect.size.default, None, effect.size.unit)
        for effect in study.effects
        if effect.id not in visible
    ]
    advance(PAIRS_COST)
    lines = [_line_visibility(effect, selection, study.channel) for effect in effects if effect.spectral_line]
    advance(LINES_COST)
    in_position, position_pairs = position_isolability(selection.experiments, effects)
    advance(POSITION_COST)
    return Isolability(
        source=source,
        planned=planned,
        runs=dict(Counter(experiment.kind for experiment in selection.experiments)),
        duration_s=duration_s,
        effects=(*visible.values(), *invisible, *lines, *in_position),
        pairs=tuple(sorted((*pairs, *position_pairs), key=lambda effect_pair: effect_pair.sin2)),
        remarks=tuple(_isolability_remarks(selection, planned=planned)),
        backends=selection.backends,
    )


def _force_pair(angles: SignatureAngles, pair: tuple[str, str]) -> EffectPair:
    left = [angles.sin2(*pair), angles.sin2(*pair[::-1])]
    return _pair_of_variants(pair, "force", left, [angles.d_primes(name) for name in pair], CONFUSED_SIN2)


def _force_visibility(study: Study, design: Design, angles: SignatureAngles, name: str) -> Visibility:
    size = next(effect for effect in study.effects if effect.id == name).size
    variants = [angles.variants[index] for index in angles.variants_of_effect(name)]
    limits = [_smallest_visible(study, design, variant, required_d_prime(name)) for variant in variants]
    share, smallest_mN = median(limit[0] for limit in limits), median(limit[1] for limit in limits)
    d_prime = median(variant.d_prime for variant in variants)
    return Visibility(name, "force", d_prime, size.default, share * abs(size.default), size.unit, smallest_mN)


def _smallest_visible(study: Study, design: Design, variant: VariantColumns, d_prime: float) -> tuple[float, float]:
    """Return the smallest size with this d′ in default sizes, and its rms force [mN]."""
    rms = variant_rms(study, design, variant.variants[0])
    share = max(d_prime / variant.d_prime, DEFAULT_TOLERANCE_MN / rms if rms > 0 else 0.0)
    return share, share * rms


def _line_visibility(effect: Effect, selection: RunSelection, channel: str) -> Visibility:
    size, amplitude = effect.size, detectable_line_amplitude(selection.experiments, channel, MIN_MAINS_LLR)
    if amplitude is None:
        return Visibility(effect.id, "spectrum", 0.0, size.default, None, size.unit)
    return Visibility(
        effect.id,
        "spectrum",
        DETECTABLE_D_PRIME * size.default / amplitude,
        size.default,
        amplitude,
        size.unit,
        amplitude / float(np.sqrt(2)),
    )


def _isolability_remarks(selection: RunSelection, *, planned: bool) -> Iterator[str]:
    yield (
        "effects on the position and on the force are separated by the channel: the force is predicted from the "
        "measured motion, so position errors leave no gap there, and no angle between the two is given"
    )
    yield "mains hum is recognised by its frequency at rest, and no other effect resembles it"
    yield "more than two effects at once, and effects outside the catalogue, are not analysed"
    if planned:
        yield (
            "the runs are predicted by the nominal model with the simulated rig's noise; another specimen, a noisier "
            "sensor or slow prompts change the figures"
        )
    yield from selection.remarks


KIND_NAMES = {"coulomb": "Coulomb"}


def smallest_visible_text(visibility: Visibility) -> str:
    """Return the smallest detectable size with its unit."""
    if visibility.smallest is None:
        return "not detectable"
    unit = "" if visibility.unit == "1" else f" {visibility.unit}"
    return f"{visibility.smallest:.2g}{unit}"


MAX_NAMED_PAIRS = 5
"""Pairs that are not told apart and that a sentence names."""


def isolability_sentences(isolability: Isolability) -> tuple[str, ...]:
    """Return the main results, the most important sentence first."""
    return tuple(_sentences(isolability))


def _sentences(isolability: Isolability) -> Iterator[str]:
    counts = join_names(
        [count_text(number, f"{KIND_NAMES.get(kind, kind)} run") for kind, number in isolability.runs.items()]
    )
    time = "" if isolability.duration_s is None else f" in {isolability.duration_s / 60:.1f} min of rig time"
    confused, seen = isolability.confused, len(isolability.effects) - len(isolability.invisible)
    alike = {effect for pair in confused for effect in pair.effects} - set(isolability.invisible)
    told = "This plan tells" if isolability.planned else "These runs tell"
    if confused:
        pairs = "; ".join(" / ".join(map(display_name, pair.effects)) for pair in confused[:MAX_NAMED_PAIRS])
        more = f"; and {len(confused) - MAX_NAMED_PAIRS} more" if len(confused) > MAX_NAMED_PAIRS else ""
        yield f"{told} {seen - len(alike)} of {seen} effects apart from all others; not: {pairs}{more}."
    else:
        yield f"{told} all {seen} effects apart."
    yield f"{'It makes' if isolability.planned else 'They are'} {counts}{time}."
    if isolability.invisible:
        names = join_names([display_name(effect) for effect in isolability.invisible])
        yield f"{capitalise(names)} would not be detected at the default size."
    visible = isolability.visible_in("force")
    if visible:
        weakest = max(visible, key=lambda visibility: (visibility.smallest or 0.0) / abs(visibility.usual))
        yield (
            f"Hardest to detect: {display_name(weakest.effect)}, from {smallest_visible_text(weakest)} on "
            f"(default size {weakest.usual:g})."
        )
