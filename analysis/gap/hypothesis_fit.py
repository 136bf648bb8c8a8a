"""One hypothesis fitted to the force: effects together, in the catalogue's form and with form error.

Effects that are periodic in session time may have a phase of their own in each run, or one phase that all runs share.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis.gap.design import (
    NUISANCES,
    Candidate,
    ColumnKind,
    Design,
    EffectVariant,
    LeastSquaresFit,
    ParameterPoint,
    RankedEffect,
    RunDesign,
    Study,
    fit_columns,
    forms_of,
    gauss_newton,
    gauss_newton_step,
    joint_fit,
    linearise,
    project_dictionary,
    rank_effects,
    signature,
)
from dragrig.analysis.gap.features import CHANCE_SIGMAS, NOISE_UNCERTAINTY
from dragrig.analysis.gap.run_data import RunData, rms_where_active
from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import RunState

TIED_HARMONICS = 4
MAX_PERIODS = 12
"""Number of best periods that are evaluated with all harmonics."""
SHARPNESSES = (0.0, 1.5, 4.0, 10.0)
PHASE_STEPS = 24


def free_phase_llr(design: Design, nuisances: LeastSquaresFit, pair: Sequence[int]) -> tuple[float, int]:
    """Return the log likelihood ratio of a pair of variants with an amplitude and a phase in every run.

    Parameters
    ----------
    nuisances
        Fit of the nuisances, held fixed.
    pair
        Indices of two variants in quadrature in the dictionary.

    Returns
    -------
    llr, runs
        Log likelihood ratio, and the number of runs that show the variants; in noise alone the first is about the
        second.
    """
    rows = (1 + design.columns_of(ColumnKind.VARIANT)[list(pair)]).tolist()
    columns = 1 + nuisances.columns
    llr, runs = 0.0, 0
    for gram in design.grams:
        pair_rows = gram[rows]
        gram_of_pair = pair_rows[:, rows]
        strength = float(np.trace(gram_of_pair))
        if strength <= 1.0:
            continue
        moment = pair_rows[:, 0] - pair_rows[:, columns] @ nuisances.coefficients
        llr += 0.5 * float(moment @ np.linalg.solve(gram_of_pair + 1e-6 * strength * np.eye(2), moment))
        runs += 1
    return llr, runs


def fit_common_phase(study: Study, design: Design, variant: EffectVariant) -> tuple[Candidate, float]:
    """Search for the period near a variant's, and the waveform, that all runs of a session share.

    Return the effect with the best period and phase, and the log likelihood ratio of any waveform with this period, up
    to its first harmonics.
    """
    last_s = max(float(run.coordinates.session_s.max()) for run in study.runs)
    period = variant.values[variant.effect.period_parameter]
    # The strongest period may be the first overtone of the true one.
    max_period = np.inf if variant.effect.period is None else variant.effect.period.high
    residuals = _whitened_residuals(study, design)
    periods = np.concatenate(
        [
            _strongest_periods(residuals, _period_grid(trial, last_s))
            for trial in (period, 2 * period)
            if trial <= max_period
        ]
    )
    llrs = _llr_of_periods(residuals, periods, TIED_HARMONICS)
    best = int(llrs.argmax())
    variants = _periodic_variants(variant, float(periods[best]))
    gram, product = np.zeros(len(variants)), np.zeros(len(variants))
    for residual in residuals:
        rows = [signature(best_variant, residual.scene, residual.sensor_gain) for best_variant in variants]
        whitened = residual.design.whitening.whiten(residual.run.block_means(np.array(rows)).T)
        gram += np.sum(whitened**2, axis=0)
        product += residual.values @ whitened
    chi2_differences = np.where(product > 0, product**2 / np.maximum(gram, 1e-12), 0.0)
    index = int(chi2_differences.argmax())
    best_variant = variants[index]
    size = best_variant.effect.size
    values = {
        **best_variant.values,
        size.name: best_variant.values[size.name] * max(product[index], 0.0) / max(gram[index], 1e-12),
    }
    values[size.name] = float(np.clip(values[size.name], size.low, size.high))
    return Candidate(best_variant.effect, values), float(llrs[best])


@dataclass(frozen=True, slots=True, eq=False)
class _WhitenedResidual:
    run: RunData
    design: RunDesign
    scene: RunState
    sensor_gain: float
    values: FloatArray


def _whitened_residuals(study: Study, design: Design) -> list[_WhitenedResidual]:
    """Return the whitened residuals of runs in a closed gut after the nuisance fit."""
    nuisances = fit_columns(design, design.total_gram(), *NUISANCES)
    residuals = []
    for number, (run, run_design) in enumerate(zip(study.runs, design.runs, strict=True)):
        scene, gain = study.scene(number, design.z)
        if scene.gut_closed:
            residual = run_design.residual - run_design.columns[:, nuisances.columns] @ nuisances.coefficients
            residuals.append(_WhitenedResidual(run, run_design, scene, gain, run_design.whitening.whiten(residual)))
    return residuals


def _strongest_periods(residuals: Sequence[_WhitenedResidual], periods_s: FloatArray) -> FloatArray:
    """Return the periods with the largest log likelihood ratio of fundamental and first overtone."""
    llrs = _llr_of_periods(residuals, periods_s, 1) + _llr_of_periods(residuals, periods_s / 2, 1)
    return periods_s[np.argsort(llrs)[-MAX_PERIODS:]]


def _llr_of_periods(residuals: Sequence[_WhitenedResidual], periods_s: FloatArray, harmonics: int) -> FloatArray:
    """Return the log likelihood ratio of each period with some harmonics, over all runs."""
    width = 2 * harmonics
    grams, moments = np.zeros((periods_s.size, width, width)), np.zeros((periods_s.size, width))
    for residual in residuals:
        angle = 2 * np.pi * residual.scene.session_s / periods_s[:, None]
        waves = [function(harmonic * angle) for harmonic in range(1, harmonics + 1) for function in (np.cos, np.sin)]
        rows = residual.run.block_means(np.stack(waves, axis=1).reshape(-1, angle.shape[1]))
        whitened = residual.design.whitening.whiten(rows.T).T.reshape(-1, width, rows.shape[1])
        grams += whitened @ whitened.transpose(0, 2, 1)
        moments += whitened @ residual.values
    size = np.trace(grams, axis1=1, axis2=2)[:, None, None] / width
    coefficients = np.linalg.solve(grams + (1e-6 * size + 1e-12) * np.eye(width), moments[:, :, None])[:, :, 0]
    return np.asarray(0.5 * np.sum(coefficients * moments, axis=1))


def _periodic_variants(variant: EffectVariant, period_s: float) -> list[EffectVariant]:
    effect, phase = variant.effect, variant.effect.phase
    others = [parameter for parameter in effect.shapes if parameter.name != variant.effect.period_parameter]
    grid = SHARPNESSES if others else (0.0,)
    phases = np.linspace(-np.pi, np.pi, PHASE_STEPS, endpoint=False)
    return [
        EffectVariant(
            effect,
            {
                **variant.values,
                variant.effect.period_parameter: period_s,
                **{parameter.name: sharpness for parameter in others},
                **({phase.name: float(phase_rad)} if phase is not None else {}),
            },
        )
        for sharpness in grid
        for phase_rad in phases
    ]


def _period_grid(period_s: float, session_s: float, width: float = 0.05, max_count: int = 300) -> FloatArray:
    """Return periods around a period, close enough to keep phase through a session."""
    step = 0.15 * period_s**2 / max(session_s, period_s)
    count = int(np.clip(2 * width * period_s / step, 3, max_count))
    return np.linspace(period_s * (1 - width), period_s * (1 + width), count)


GAUSS_NEWTON_STEPS = 2
MAX_FURTHER_STEPS = 8
MIN_CHI2_OF_STEP = 4.0
"""A step that lowers chi-square by less moves no parameter by two standard errors."""
MIN_STEP_SHARE = 0.3
"""A step that leads too far is tried at a half and a quarter of its length."""
MAX_OWN_VARIANTS, MIN_OWN_LLR = 3, 8.0
"""Number of further variants of its own effect that a candidate may have, and the log likelihood ratio that each must
add."""
MIN_EFFECT_CHI2 = 1.0
"""Whitened sum of squares that effects add to a run above which they act in it."""
PERIOD_SEARCH_LLR = 26.0
"""Log likelihood ratio that the best of several hundred periods, in any waveform, reaches by chance."""


@dataclass(frozen=True, slots=True, eq=False)
class HypothesisFit:
    """Effects fitted together with the nominal model."""

    parameters: ParameterPoint
    """Nominal parameters and effects."""
    chi2: float
    """Chi-square plus the log determinant of the covariance relative to the nominal model's."""
    chi2_with_form_error: float
    """The same with form error: modulations, and further variants of the same effects."""
    change_mN: float
    """Rms change of the prediction, nominal parameters refitted, where it changes; at most the effects' own force."""
    excess_elsewhere: float
    """Excess chi-square in runs without any force of the effects, in standard deviations of chance."""
    design: Design
    """Design around the point, without modulations and further variants."""

    @property
    def effects(self) -> tuple[str, ...]:
        """Ids of the effects."""
        return tuple(candidate.effect.id for candidate in self.parameters.candidates)

    @property
    def periodic(self) -> bool:
        """Whether one of the effects is periodic in session time, so that its phase may be lost between runs."""
        return any(candidate.effect.periodic_in_session for candidate in self.parameters.candidates)


def refit_with_effect(study: Study, design: Design, ranked: RankedEffect, nominal: Design) -> HypothesisFit:
    """Fit an effect together with those of a design, starting from its best variant."""
    z, amplitude = joint_fit(design, ranked.variants)
    variant = design.variants[ranked.variants[0]]
    if not variant.effect.periodic_in_session:
        candidate = ranked.candidate(design.variants, amplitude)
        start = ParameterPoint(z, (*design.candidates, candidate))
        fit = fit_hypothesis(study, gauss_newton(study, start, GAUSS_NEWTON_STEPS, design), nominal, design)[0]
        before = (
            fit_columns(design, design.total_gram(), ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT).chi2
            + design.log_det
            - nominal.log_det
        )
        if fit.chi2 < before:
            return fit
        # Gauss-Newton diverged, as when a period loses its phase; the starting points are no worse than no effect.
        start_at_design = ParameterPoint(design.z, start.candidates)
        fallbacks = [fit_hypothesis(study, point, nominal, design)[0] for point in (start, start_at_design)]
        return min((fit, *fallbacks), key=lambda hypothesis: hypothesis.chi2)
    common, common_llr = fit_common_phase(study, design, variant)
    start = ParameterPoint(design.z, (*design.candidates, common))
    points = [start, gauss_newton(study, start, GAUSS_NEWTON_STEPS, design)]
    fit = min(
        (fit_hypothesis(study, point, nominal, design)[0] for point in points), key=lambda hypothesis: hypothesis.chi2
    )
    before = project_dictionary(design, design.total_gram(), *NUISANCES).chi2 + design.log_det - nominal.log_det
    return replace(
        fit,
        chi2_with_form_error=min(
            fit.chi2_with_form_error, before - 2 * max(common_llr - PERIOD_SEARCH_LLR, ranked.llr)
        ),
    )


def converged(study: Study, fit: HypothesisFit, nominal: Design) -> HypothesisFit:
    """Take further steps from a fit until its effects explain no more at their own values.

    To compare hypotheses, chi-square after one more linear step is enough, and the values one step short of it. Of
    effects that stand out by far that step may double the size.
    """
    if fit.periodic:
        return fit
    design, best = _at(study, fit.parameters)
    point = fit.parameters
    share = 1.0
    for _ in range(MAX_FURTHER_STEPS):
        following = _between(point, gauss_newton_step(design), share)
        trial, chi2 = _at(study, following)
        if chi2 < best - MIN_CHI2_OF_STEP:
            point, best, design, share = following, chi2, trial, 1.0
        elif share < MIN_STEP_SHARE:
            break
        else:
            share *= 0.5
    return fit if point is fit.parameters else fit_hypothesis(study, point, nominal)[0]


def _between(point: ParameterPoint, other: ParameterPoint, share: float) -> ParameterPoint:
    """Return the point that lies so far on the way to another one."""
    candidates = tuple(
        replace(old, values={name: value + share * (new.values[name] - value) for name, value in old.values.items()})
        for old, new in zip(point.candidates, other.candidates, strict=True)
    )
    return ParameterPoint(np.asarray(point.z + share * (other.z - point.z)), candidates)


def _at(study: Study, point: ParameterPoint) -> tuple[Design, float]:
    """Return the design at a point, and chi-square there with the nominal parameters alone fitted."""
    design = linearise(study, point.z, point.candidates)
    nominal_alone = fit_columns(design, design.total_gram(), ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR)
    return design, nominal_alone.chi2 + design.log_det


def fit_hypothesis(
    study: Study,
    point: ParameterPoint,
    nominal: Design,
    reference: Design | None = None,
    *,
    all_variants: bool = False,
) -> tuple[HypothesisFit, Design, tuple[int, ...]]:
    """Return the fit at a point, its design, and the further variants of its own effects that were added."""
    ids = {candidate.effect.id for candidate in point.candidates}
    restricted = (
        study if all_variants else replace(study, effects=tuple(effect for effect in study.effects if effect.id in ids))
    )
    design = linearise(restricted, point.z, point.candidates, reference=reference, modulated=True, dictionary=True)
    total = design.total_gram()
    linear_fit = fit_columns(design, total, ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT)
    chi2_with_form_error, added_variants = _add_own_variants(design, total, ids)
    log_det = design.log_det - nominal.log_det
    reduced = design.with_columns(ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT)
    fit = HypothesisFit(
        parameters=point,
        chi2=linear_fit.chi2 + log_det,
        chi2_with_form_error=chi2_with_form_error + log_det,
        change_mN=_rms_change(study, design, nominal),
        excess_elsewhere=_excess_elsewhere(design, linear_fit),
        design=reduced,
    )
    return fit, design, added_variants


def _rms_change(study: Study, design: Design, nominal: Design) -> float:
    """Return the rms difference of two designs' predictions where they differ, at most the effects' own force [mN].

    Where friction sets in, nominal parameters that hardly differ change single short blocks by much.
    """
    difference = np.concatenate(
        [
            run.predicted + run.effect_force - run_design.predicted
            for run, run_design in zip(design.runs, nominal.runs, strict=True)
        ]
    )
    weights = np.concatenate([run_data.coordinates.width_s for run_data in study.runs])
    own = np.concatenate([run.effect_force for run in design.runs])
    return min(rms_where_active(difference, weights), rms_where_active(own, weights))


def _excess_elsewhere(design: Design, linear_fit: LeastSquaresFit) -> float:
    """Return the excess in runs that the effects do not reach, where another effect must act."""
    coefficients = np.append(1.0, -linear_fit.coefficients)
    rows = np.append(0, 1 + linear_fit.columns)
    chi2, block_count = 0.0, 0
    for run, gram, count in zip(design.runs, design.grams, design.block_counts, strict=True):
        if float(np.sum(run.whitening.whiten(run.effect_force) ** 2)) < MIN_EFFECT_CHI2:
            chi2 += float(coefficients @ gram[np.ix_(rows, rows)] @ coefficients)
            block_count += count
    return (chi2 - block_count) / max(
        float(np.sqrt(2.0 * block_count)), NOISE_UNCERTAINTY / CHANCE_SIGMAS * block_count, 1.0
    )


def _add_own_variants(design: Design, total: FloatArray, ids: set[str]) -> tuple[float, tuple[int, ...]]:
    """Add further variants of the same effects one at a time; return chi-square and the variants."""
    projected = project_dictionary(design, total, *NUISANCES)
    chi2 = projected.chi2
    added: tuple[int, ...] = ()
    for _ in range(MAX_OWN_VARIANTS):
        ranked = [best for best in rank_effects(projected, design.variants) if best.effect in ids]
        if not ranked or ranked[0].llr < MIN_OWN_LLR:
            break
        added = (*added, *ranked[0].variants)
        chi2 -= 2 * ranked[0].llr
        projected = projected.without(ranked[0].variants)
    return chi2, added


def rank_with_free_phases(design: Design, ranked: tuple[RankedEffect, ...]) -> tuple[RankedEffect, ...]:
    """Rank periodic effects with a phase of their own in each run, unless a common phase ranks higher."""
    pairs = [
        form
        for form in forms_of(design.variants)
        if len(form) > 1 and design.variants[form[0]].effect.periodic_in_session
    ]
    if not pairs:
        return ranked
    nuisances = fit_columns(design, design.total_gram(), *NUISANCES)
    scored = [(*free_phase_llr(design, nuisances, pair), pair) for pair in pairs]
    llr, runs, pair = max(scored, key=lambda item: item[0] - item[1])
    effect = design.variants[pair[0]].effect.id
    common_phase = next((best for best in ranked if best.effect == effect), None)
    # Correction for the search: the largest of many periods exceeds what one has by chance.
    corrected_llr = llr - runs - 2 * np.sqrt(2 * runs * np.log(len(pairs)))
    if common_phase is None or corrected_llr <= common_phase.llr:
        return ranked
    free_phase = RankedEffect(effect, corrected_llr, common_phase.d_prime_per_unit, pair, np.array([0.5, 0.5]))
    return tuple(sorted((free_phase if best.effect == effect else best for best in ranked), key=lambda best: -best.llr))
