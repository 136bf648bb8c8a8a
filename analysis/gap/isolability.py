"""Isolability: which effects a set of runs can tell apart, and the smallest effect that they would show.

Effects on the position are not whitened: an error matters only when it exceeds the encoder's count. Each is explained
by free-form model classes scored on held-out runs, as in a diagnosis.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, groupby, product
from math import sqrt
from statistics import median

import numpy as np

from dragrig.analysis.computation import Progress, no_progress, single_blas_thread
from dragrig.analysis.gap.candidates import Candidate, EffectVariant
from dragrig.analysis.gap.classifier import MIN_MAINS_LLR, MIN_POSITION_SHARE
from dragrig.analysis.gap.design import ColumnKind, Design, Study, linearise
from dragrig.analysis.gap.diagnosis_text import capitalise, count_text, display_name, join_names
from dragrig.analysis.gap.features import gap_weight
from dragrig.analysis.gap.hypothesis_fit import is_periodic_in_session
from dragrig.analysis.gap.linear_fit import (
    NUISANCES,
    RELATIVE_RIDGE,
    gauss_newton_step,
    project_dictionary,
    rank_effects,
)
from dragrig.analysis.gap.position_channel import (
    PositionErrors,
    position_errors,
    predicted_position_error,
    score_model_classes,
)
from dragrig.analysis.gap.run_data import rms_where_active
from dragrig.analysis.gap.spectral_lines import detectable_line_amplitude
from dragrig.analysis.gap.studies import prepare_study
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.models.nominal_model import NominalModel
from dragrig.analysis.selection import RunSelection
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Channel, Effect, catalogue

DETECTABLE_D_PRIME = 5.9
"""d′ that is found nearly always where all that an effect takes away counts for a gap."""
DEFAULT_TOLERANCE_MN = 0.5
"""What an effect must add [mN], root mean square where it acts, to matter, unless a person says otherwise."""
DETECTED_SHARE = 0.8
"""Share of the effects that would be seen at the size that is told."""


def required_d_prime(effect: str) -> float:
    """Return the d′ of an effect on the force that is found nearly always."""
    return DETECTABLE_D_PRIME / sqrt(gap_weight(effect))


def detection_limit(study: Study, design: Design) -> float:
    """Return the force [mN], root mean square where an effect acts, from which on most effects would be seen."""
    sizes = []
    ranked = rank_effects(project_dictionary(design, design.total_gram(), *NUISANCES), design.variants)
    for best in ranked:
        rms = variant_rms(study, design, best.variants[0])
        if best.d_prime_per_unit > 0 and rms > 0:
            sizes.append(required_d_prime(best.effect) / best.d_prime_per_unit * rms)
    return (
        float(np.quantile(sizes, DETECTED_SHARE))
        if sizes
        else float(np.median([noise.white for noise in study.problem.noises]))
    )


def variant_rms(study: Study, design: Design, shape: int) -> float:
    """Return the root mean square [mN] of a shape of the dictionary where it acts; 0 where it does nowhere."""
    column = design.columns_of(ColumnKind.VARIANT)[shape]
    weights = np.concatenate([run.coordinates.width_s for run in study.runs])
    more = np.concatenate([run_design.columns[:, column] for run_design in design.runs])
    return rms_where_active(more, weights)


MIN_SIGNATURE_CHI2 = 1e-6
"""Whitened squares below this are nothing."""


@dataclass(frozen=True, slots=True)
class VariantColumns:
    """One shape of an effect; what is periodic has two columns a quarter of a period apart."""

    effect: str
    variants: tuple[int, ...]
    one_signed: bool
    d_prime: float


@dataclass(frozen=True, eq=False)
class SignatureAngles:
    """All forms that runs show, and the angles between them.

    Attributes
    ----------
    variants
        Those that leave anything beside nuisances.
    cos2
        Share of each form's squares that each other form takes away, phases averaged over, shape `(F, F)`.
    """

    variants: tuple[VariantColumns, ...]
    cos2: FloatArray

    @classmethod
    def of(cls, design: Design) -> "SignatureAngles":
        """Compute them from a design with its dictionary."""
        gram = project_dictionary(design, design.total_gram(), *NUISANCES).gram
        forms = tuple(_variant_columns(design.variants, gram))
        basis = _orthonormal_basis(forms, gram)
        products = basis @ gram @ basis.T
        starts = np.concatenate(([0], np.cumsum([len(variant.variants) for variant in forms])[:-1])).astype(np.intp)
        if not forms:
            return cls((), np.zeros((0, 0)))
        counts = np.array([len(variant.variants) for variant in forms], dtype=np.float64)
        squares = np.add.reduceat(np.add.reduceat(products**2, starts, axis=0), starts, axis=1) / counts[:, None]
        one_sided = np.array([variant.one_signed for variant in forms])
        opposed = products[np.ix_(starts, starts)] < 0
        squares[opposed & one_sided[:, None] & one_sided[None, :]] = 0.0
        for number, form in enumerate(forms):
            if is_periodic_in_session(design.variants[form.variants[0]].effect):
                free = _free_phase_shares(design, form.variants, basis)
                squares[:, number] = np.maximum(squares[:, number], np.add.reduceat(free, starts) / counts)
        return cls(forms, np.clip(squares, 0.0, 1.0))

    @cached_property
    def effects(self) -> tuple[str, ...]:
        """Effects that are seen, in the catalogue's order."""
        return tuple(dict.fromkeys(variant.effect for variant in self.variants))

    def variants_of_effect(self, name: str) -> list[int]:
        """Return the numbers of an effect's forms."""
        return [number for number, variant in enumerate(self.variants) if variant.effect == name]

    def sin2(self, effect: str, rival: str) -> FloatArray:
        """Return what the best of a rival's forms leaves of each form of an effect, shape `(forms,)`."""
        return np.asarray(
            1.0 - self.cos2[np.ix_(self.variants_of_effect(effect), self.variants_of_effect(rival))].max(axis=1)
        )

    def d_primes(self, name: str) -> FloatArray:
        """Return d′ of an effect's forms at the usual size, shape `(forms,)`."""
        return np.array([self.variants[index].d_prime for index in self.variants_of_effect(name)])


def _variant_columns(shapes: Sequence[EffectVariant], gram: FloatArray) -> list[VariantColumns]:
    variants = []
    for _, group in groupby(enumerate(shapes), key=lambda pair: (pair[1].effect.id, pair[1].quadrature_key)):
        index = tuple(number for number, _ in group)
        strength = float(np.mean(np.diag(gram)[list(index)]))
        if strength > MIN_SIGNATURE_CHI2:
            first = shapes[index[0]]
            variants.append(VariantColumns(first.effect.id, index, first.one_signed, float(np.sqrt(strength))))
    return variants


def _orthonormal_basis(forms: Sequence[VariantColumns], gram: FloatArray) -> FloatArray:
    """Return what makes the columns of each form orthonormal, shape `(columns of all forms, S)`."""
    rows = []
    for variant in forms:
        index = list(variant.variants)
        own = gram[np.ix_(index, index)]
        root = np.linalg.cholesky(own + 1e-9 * np.trace(own) * np.eye(len(index)))
        made = np.zeros((len(index), len(gram)))
        made[:, index] = np.linalg.inv(root)
        rows.append(made)
    return np.concatenate(rows) if rows else np.zeros((0, len(gram)))


def _free_phase_shares(design: Design, pair: Sequence[int], basis: FloatArray) -> FloatArray:
    """Return the share of each orthonormal column that a pair takes away with an amplitude and phase in every run.

    What is periodic in time may lose its phase from run to run; a diagnosis allows for it, and so may be misled by it.
    """
    nuisances, shapes = 1 + design.columns_of(*NUISANCES), 1 + design.columns_of(ColumnKind.VARIANT)
    own = shapes[list(pair)]
    total = design.total_gram()
    gram = total[np.ix_(nuisances, nuisances)]
    whole = gram + np.diag(design.prior_precision[nuisances - 1] + RELATIVE_RIDGE * np.diag(gram))
    grams = [values for values in design.grams if np.trace(values[np.ix_(own, own)]) > MIN_SIGNATURE_CHI2]
    by_nuisance = np.concatenate([values[np.ix_(nuisances, own)] for values in grams], axis=1)
    taken = np.linalg.solve(whole, by_nuisance)
    array = np.zeros((by_nuisance.shape[1],) * 2)
    for place, values in enumerate(grams):
        at = slice(2 * place, 2 * place + 2)
        array[at, at] = values[np.ix_(own, own)]
    array -= by_nuisance.T @ taken
    across = np.concatenate([values[np.ix_(shapes, own)] for values in grams], axis=1)
    along = basis @ (across - total[np.ix_(shapes, nuisances)] @ taken)
    array += 1e-9 * np.trace(array) / len(array) * np.eye(len(array))
    return np.asarray(np.sum(along * np.linalg.solve(array, along.T).T, axis=1))


def order_by_similarity(names: Sequence[str], sin2: Mapping[frozenset[str], float]) -> tuple[str, ...]:
    """Order names by average linkage of their angles, the leaves turned so that near ones are neighbours."""
    from scipy.cluster.hierarchy import leaves_list, linkage

    if len(names) < 3:
        return tuple(names)
    apart = np.array([np.sqrt(sin2[frozenset(pair)]) for pair in combinations(names, 2)])
    order: list[int] = leaves_list(linkage(apart, "average", optimal_ordering=True)).tolist()
    return tuple(names[index] for index in order)


CONFUSED_SIN2 = 0.17
"""A rival that leaves no more of an effect's squares than this is hardly told from it.

The best fit of the catalogue's forms leaves up to 0.41 of the norm of what a foreign form of the same effect does
(`bench/forms.py`), hence 0.17 of its squares.
"""


@dataclass(frozen=True, slots=True)
class Visibility:
    """How clearly runs show an effect.

    Attributes
    ----------
    channel
        Where it is seen: `force`, `position`, or `spectrum` for a line that block means take out.
    d_prime
        At its usual size, median over its shapes: the norm of its whitened signature once nuisances are taken out.
    usual, smallest, unit
        The usual size, and the smallest that would be seen, median over its shapes; None where no run shows it.
    smallest_mN
        Root mean square of the smallest where it acts; None in the position.
    """

    effect: str
    channel: str
    d_prime: float
    usual: float
    smallest: float | None
    unit: str
    smallest_mN: float | None = None


@dataclass(frozen=True, slots=True)
class EffectPair:
    """Two effects and how far apart they are.

    Attributes
    ----------
    sin2
        sin² of the angle between what the two can do: the least over the shapes of both, signs kept where there is one.
    typical_sin2
        What the second leaves of the first in the median over the first's shapes, and the other way round.
    d_prime
        d′ between the two with each at its usual size in turn, median over its shapes, the other at its best.
    confused
        Whether these runs hardly tell them apart.
    """

    effects: tuple[str, str]
    channel: str
    sin2: float
    typical_sin2: tuple[float, float]
    d_prime: tuple[float, float]
    confused: bool

    @property
    def separation(self) -> float:
        """The smaller d′ of the two."""
        return min(self.d_prime)


@dataclass(frozen=True, slots=True)
class Isolability:
    """What some runs can tell apart.

    Attributes
    ----------
    source
        Plan or campaign.
    planned
        Whether the runs are yet to be made.
    runs
        Number of runs by kind, of those that a diagnosis uses.
    duration_s
        Rig time with rests and ways back; None where it is not known.
    effects
        How clearly each is seen; those of the force stand so that near ones are neighbours.
    pairs
        All pairs within a channel, the closest first.
    remarks
        What was not looked at, a sentence each.
    """

    source: str
    planned: bool
    runs: Mapping[str, int]
    duration_s: float | None
    effects: tuple[Visibility, ...]
    pairs: tuple[EffectPair, ...]
    remarks: tuple[str, ...] = ()

    def of_channel(self, channel: str) -> tuple[Visibility, ...]:
        """Return the effects of a channel that runs show, in their order."""
        return tuple(
            visibility
            for visibility in self.effects
            if visibility.channel == channel and visibility.smallest is not None
        )

    @property
    def invisible(self) -> tuple[str, ...]:
        """Effects that no run shows at their usual size."""
        return tuple(
            visibility.effect
            for visibility in self.effects
            if visibility.smallest is None or visibility.d_prime < DETECTABLE_D_PRIME
        )

    @property
    def confused(self) -> tuple[EffectPair, ...]:
        """Pairs that these runs hardly tell apart, the closest first."""
        return tuple(pair for pair in self.pairs if pair.confused)

    def pair(self, name: str, label: str) -> EffectPair | None:
        """Return two effects' pair; None where they are not of one channel."""
        return next((pair for pair in self.pairs if set(pair.effects) == {name, label}), None)

    def summary(self) -> Mapping[str, float]:
        """Return what two plans are compared by, of the force's effects."""
        pairs = [pair for pair in self.pairs if pair.channel == "force"]
        seen = self.of_channel("force")
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


def effect_pairs(names: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Yield every pair once."""
    return combinations(names, 2)


MAX_VARIANTS = 3
"""So many shapes of an effect are tried, evenly chosen from its grid."""
TRIAL_PHASE_RAD = 0.7


@dataclass(frozen=True, slots=True)
class _PositionTrial:
    """One shape of an effect: the largest error over what is noticed, and the share that each free form leaves."""

    error_ratio: float
    remaining_shares: Mapping[str, float]


def position_isolability(
    experiments: Sequence[Experiment], effects: Sequence[Effect]
) -> tuple[tuple[Visibility, ...], tuple[EffectPair, ...]]:
    """Return how clearly runs show each effect of the position, and how far apart these are."""
    runs = position_errors(experiments)
    acting = [effect for effect in effects if effect.channel is Channel.POSITION]
    tried = {
        one.id: [_position_trial(candidate, runs) for candidate in _trial_candidates(one)] if runs else []
        for one in acting
    }
    visible = tuple(_position_visibility(one, tried[one.id]) for one in acting)
    shown = tuple(visibility.effect for visibility in visible if visibility.smallest is not None)
    return visible, tuple(_position_pair(pair, tried) for pair in effect_pairs(shown))


def _trial_candidates(effect: Effect) -> Iterator[Candidate]:
    grid = list(product(*(parameter.start_values for parameter in effect.shapes)))
    chosen = np.unique(np.linspace(0, len(grid) - 1, min(MAX_VARIANTS, len(grid))).round().astype(int)).tolist()
    phase = {} if effect.phase is None else {effect.phase.name: TRIAL_PHASE_RAD}
    for place in chosen:
        shapes = {parameter.name: value for parameter, value in zip(effect.shapes, grid[place], strict=True)}
        yield Candidate(effect, {**effect.defaults, **shapes, **phase})


def _position_trial(candidate: Candidate, runs: Sequence[PositionErrors]) -> _PositionTrial:
    errors = [predicted_position_error(candidate, run) for run in runs]
    clearest = max(float(np.sqrt(np.mean(more**2))) / run.detectable_mm for run, more in zip(runs, errors, strict=True))
    strays = [replace(run, error_mm=run.error_mm + more) for run, more in zip(runs, errors, strict=True)]
    return _PositionTrial(
        clearest, {model_class.effect: 1.0 - model_class.held_out_share for model_class in score_model_classes(strays)}
    )


def _position_visibility(effect: Effect, tried: Sequence[_PositionTrial]) -> Visibility:
    size, unit = effect.size.default, effect.size.unit
    ratios = [trial.error_ratio for trial in tried if trial.error_ratio > 0]
    if not ratios:
        return Visibility(effect.id, "position", 0.0, size, None, unit)
    return Visibility(
        effect.id, "position", DETECTABLE_D_PRIME * median(ratios), size, median(size / value for value in ratios), unit
    )


def _position_pair(pair: tuple[str, str], tried: Mapping[str, Sequence[_PositionTrial]]) -> EffectPair:
    name, label = pair
    left = [
        [min(max(trial.remaining_shares[rival], 0.0), 1.0) for trial in tried[truth]]
        for truth, rival in (pair, (label, name))
    ]
    shifts = [
        median(
            DETECTABLE_D_PRIME * trial.error_ratio * float(np.sqrt(share))
            for trial, share in zip(tried[truth], shares, strict=True)
        )
        for truth, shares in zip(pair, left, strict=True)
    ]
    sin2 = min(*left[0], *left[1])
    confused = sin2 < 1.0 - MIN_POSITION_SHARE or min(shifts) < DETECTABLE_D_PRIME
    return EffectPair(pair, "position", sin2, (median(left[0]), median(left[1])), (shifts[0], shifts[1]), confused)


ISOLABILITY_STEPS = 4


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
    """Say which effects the runs of a specimen can tell apart, and how small a one they would show.

    Parameters
    ----------
    excluded
        Effects that are not to be considered.

    Raises
    ------
    AnalysisError
        Where the model predicts nothing of these runs.
    """
    effects = [effect for effect in catalogue().values() if effect.id not in excluded]
    progress(0, ISOLABILITY_STEPS)
    study = prepare_study(selection, nominal, [effect for effect in effects if effect.has_force_signature])
    point = gauss_newton_step(linearise(study, study.initial_z))
    progress(1, ISOLABILITY_STEPS)
    design = linearise(study, point.z, dictionary=True)
    progress(2, ISOLABILITY_STEPS)
    angles = SignatureAngles.of(design)
    pairs = [_force_pair(angles, pair) for pair in effect_pairs(angles.effects)]
    order = order_by_similarity(
        angles.effects, {frozenset(effect_pair.effects): effect_pair.sin2 for effect_pair in pairs}
    )
    seen = {name: _force_visibility(study, design, angles, name) for name in order}
    hidden = [_invisible(effect) for effect in study.effects if effect.id not in seen]
    progress(3, ISOLABILITY_STEPS)
    lines = [_line_visibility(effect, selection, study.channel) for effect in effects if effect.spectral_line]
    in_position, more = position_isolability(selection.experiments, effects)
    progress(ISOLABILITY_STEPS, ISOLABILITY_STEPS)
    return Isolability(
        source=source,
        planned=planned,
        runs=dict(Counter(experiment.kind for experiment in selection.experiments)),
        duration_s=duration_s,
        effects=(*seen.values(), *hidden, *lines, *in_position),
        pairs=tuple(sorted((*pairs, *more), key=lambda effect_pair: effect_pair.sin2)),
        remarks=tuple(_isolability_remarks(selection, planned=planned)),
    )


def _force_pair(angles: SignatureAngles, pair: tuple[str, str]) -> EffectPair:
    label, other = pair
    left = angles.sin2(label, other), angles.sin2(other, label)
    apart = [float(np.median(angles.d_primes(name) * np.sqrt(share))) for name, share in zip(pair, left, strict=True)]
    sin2 = float(min(left[0].min(), left[1].min()))
    typical = float(np.median(left[0])), float(np.median(left[1]))
    return EffectPair(
        pair, "force", sin2, typical, (apart[0], apart[1]), sin2 < CONFUSED_SIN2 or min(apart) < DETECTABLE_D_PRIME
    )


def _force_visibility(study: Study, design: Design, angles: SignatureAngles, name: str) -> Visibility:
    size = next(effect for effect in study.effects if effect.id == name).size
    forms = [angles.variants[index] for index in angles.variants_of_effect(name)]
    pairs = [_smallest_visible(study, design, variant, required_d_prime(name)) for variant in forms]
    share, least_mN = median(pair[0] for pair in pairs), median(pair[1] for pair in pairs)
    d_prime = median(variant.d_prime for variant in forms)
    return Visibility(name, "force", d_prime, size.default, share * abs(size.default), size.unit, least_mN)


def _smallest_visible(study: Study, design: Design, form: VariantColumns, d_prime: float) -> tuple[float, float]:
    """Return the smallest size, with such a d′, over the usual one, and its root mean square [mN]."""
    rms = variant_rms(study, design, form.variants[0])
    share = max(d_prime / form.d_prime, DEFAULT_TOLERANCE_MN / rms if rms > 0 else 0.0)
    return share, share * rms


def _invisible(effect: Effect) -> Visibility:
    return Visibility(effect.id, "force", 0.0, effect.size.default, None, effect.size.unit)


def _line_visibility(effect: Effect, selection: RunSelection, channel: str) -> Visibility:
    size, least = effect.size, detectable_line_amplitude(selection.experiments, channel, MIN_MAINS_LLR)
    if least is None:
        return Visibility(effect.id, "spectrum", 0.0, size.default, None, size.unit)
    return Visibility(
        effect.id,
        "spectrum",
        DETECTABLE_D_PRIME * size.default / least,
        size.default,
        least,
        size.unit,
        least / float(np.sqrt(2)),
    )


def _isolability_remarks(selection: RunSelection, *, planned: bool) -> Iterator[str]:
    yield (
        "an effect of the position and one of the force are told apart by the channel: the force is predicted from the "
        "measured motion, so that a stage that strays leaves no gap there, and no angle between the two is given"
    )
    yield "mains hum is told by its frequency where the stage stands still, and has no near one among the others"
    yield "more than two effects at once, and what the catalogue does not have, are not looked at"
    if planned:
        yield (
            "the runs are predicted by the nominal model with the simulated rig's noise; another specimen, a louder "
            "sensor or prompts that take long change the figures"
        )
    yield from selection.remarks


KIND_NAMES = {"coulomb": "Coulomb"}


def isolability_sentences(isolability: Isolability) -> tuple[str, ...]:
    """Return what matters most, the first sentence first."""
    return tuple(_sentences(isolability))


def smallest_visible_text(visibility: Visibility) -> str:
    """Spell the smallest size that would be seen, with its unit."""
    if visibility.smallest is None:
        return "not at all"
    unit = "" if visibility.unit == "1" else f" {visibility.unit}"
    return f"{visibility.smallest:.2g}{unit}"


def pair_text(pair: EffectPair) -> str:
    """Name two effects and say how far apart they are."""
    return (
        f"{join_names([display_name(name) for name in pair.effects])} (sin² {pair.sin2:.2f}, d′ {pair.separation:.0f})"
    )


def _sentences(isolability: Isolability) -> Iterator[str]:
    made = "would make" if isolability.planned else "are"
    counts = join_names(
        [count_text(number, f"{KIND_NAMES.get(kind, kind)} run") for kind, number in isolability.runs.items()]
    )
    time = "" if isolability.duration_s is None else f" in {isolability.duration_s / 60:.1f} min of rig time"
    confused = isolability.confused
    if confused:
        yield (
            f"{count_text(len(confused), 'pair')} of effects {'is' if len(confused) == 1 else 'are'} hardly told apart "
            f"by these runs: {join_names([pair_text(pair) for pair in confused])}."
        )
    else:
        yield "These runs tell every two effects of the catalogue apart."
    yield f"These {made} {counts}{time}." if not isolability.planned else f"The plan {made} {counts}{time}."
    if isolability.invisible:
        names = join_names([display_name(effect) for effect in isolability.invisible])
        yield f"{capitalise(names)} would not be seen at the usual size."
    force = [visibility for visibility in isolability.of_channel("force") if visibility.smallest is not None]
    if force:
        weakest = max(force, key=lambda visibility: (visibility.smallest or 0.0) / abs(visibility.usual))
        yield (
            f"The least visible is {display_name(weakest.effect)}: from {smallest_visible_text(weakest)} on, "
            f"where it usually is {weakest.usual:g}."
        )
