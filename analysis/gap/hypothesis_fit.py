"""One hypothesis fitted to the force: effects together, in the catalogue's form and with form error.

Effects that are periodic in session time may have a phase of their own in each run, or one phase that all runs share.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dragrig.analysis.gap.candidates import Candidate, EffectVariant, signature
from dragrig.analysis.gap.design import ColumnKind, Design, RunDesign, Study, linearise
from dragrig.analysis.gap.features import CHANCE_SIGMAS, NOISE_UNCERTAINTY
from dragrig.analysis.gap.linear_fit import (
    NUISANCES,
    LeastSquaresFit,
    ParameterPoint,
    RankedEffect,
    fit_columns,
    gauss_newton,
    joint_fit,
    project_dictionary,
    rank_effects,
)
from dragrig.analysis.gap.run_data import RunData, rms_where_active
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Coordinate, Effect
from dragrig.sim_backend.effects.run_state import RunState

TIED_HARMONICS = 4
MAX_PERIODS = 12
"""Periods about one that are looked at with all harmonics."""
SHARPNESSES = (0.0, 1.5, 4.0, 10.0)
PHASE_STEPS = 24


def free_phase_llr(design: Design, nuisances: LeastSquaresFit, pair: Sequence[int]) -> tuple[float, int]:
    """Return half the squares that a pair of shapes takes away with an amplitude and a phase in every run.

    Parameters
    ----------
    nuisances
        What was fitted beforehand and stays.
    pair
        Two shapes a quarter of a period apart, by their number in the dictionary.

    Returns
    -------
    gain, runs
        The runs in which the shapes are seen; without any such thing the gain is about their number.
    """
    rows = (1 + design.columns_of(ColumnKind.VARIANT)[list(pair)]).tolist()
    columns = 1 + nuisances.columns
    gain, runs = 0.0, 0
    for gram in design.grams:
        of_pair = gram[rows]
        own = of_pair[:, rows]
        strength = float(np.trace(own))
        if strength <= 1.0:
            continue
        along = of_pair[:, 0] - of_pair[:, columns] @ nuisances.coefficients
        gain += 0.5 * float(along @ np.linalg.solve(own + 1e-6 * strength * np.eye(2), along))
        runs += 1
    return gain, runs


@dataclass(frozen=True, slots=True, eq=False)
class CommonPhaseFit:
    """Something periodic in time that holds its phase through the session.

    Attributes
    ----------
    candidate
        The effect with the period and phase that explain most.
    llr
        Half the squares that any form of this period takes away, given by its first harmonics.
    """

    candidate: Candidate
    llr: float


def fit_common_phase(study: Study, design: Design, variant: EffectVariant) -> CommonPhaseFit:
    """Look for the period, near that of a shape, and the form that tie the runs of a session together."""
    last_s = max(float(run.coordinates.session_s.max()) for run in study.runs)
    near = variant.values[_period_name(variant)]
    # The strongest may be the first overtone of what repeats.
    longest = next(parameter for parameter in variant.effect.shapes if parameter.name == _period_name(variant)).high
    residuals = _whitened_residuals(study, design)
    periods = np.concatenate(
        [_strongest_periods(residuals, _period_grid(value, last_s)) for value in (near, 2 * near) if value <= longest]
    )
    gains = _llr_of_periods(residuals, periods, TIED_HARMONICS)
    best = int(gains.argmax())
    forms = _periodic_variants(variant, float(periods[best]))
    gram, product = np.zeros(len(forms)), np.zeros(len(forms))
    for residual in residuals:
        rows = [signature(form, residual.scene, residual.sensor_gain) for form in forms]
        white = residual.design.whitening.whiten(residual.run.block_means(np.array(rows)).T)
        gram += np.sum(white**2, axis=0)
        product += residual.values @ white
    taken = np.where(product > 0, product**2 / np.maximum(gram, 1e-12), 0.0)
    chosen = int(taken.argmax())
    form = forms[chosen]
    size = form.effect.size
    values = {**form.values, size.name: form.values[size.name] * max(product[chosen], 0.0) / max(gram[chosen], 1e-12)}
    values[size.name] = float(np.clip(values[size.name], size.low, size.high))
    return CommonPhaseFit(Candidate(form.effect, values), float(gains[best]))


@dataclass(frozen=True, slots=True, eq=False)
class _WhitenedResidual:
    run: RunData
    design: RunDesign
    scene: RunState
    sensor_gain: float
    values: FloatArray


def _whitened_residuals(study: Study, design: Design) -> list[_WhitenedResidual]:
    """Return what nuisances leave of the runs in a closed gut, whitened."""
    nuisances = fit_columns(design, design.total_gram(), *NUISANCES)
    residuals = []
    for number, (run, run_design) in enumerate(zip(study.runs, design.runs, strict=True)):
        scene, gain = study.scene(number, design.z)
        if scene.gut_closed:
            left = run_design.residual - run_design.columns[:, nuisances.columns] @ nuisances.coefficients
            residuals.append(_WhitenedResidual(run, run_design, scene, gain, run_design.whitening.whiten(left)))
    return residuals


def _strongest_periods(residuals: Sequence[_WhitenedResidual], periods_s: FloatArray) -> FloatArray:
    """Return the periods whose fundamental and first overtone take away most."""
    gains = _llr_of_periods(residuals, periods_s, 1) + _llr_of_periods(residuals, periods_s / 2, 1)
    return periods_s[np.argsort(gains)[-MAX_PERIODS:]]


def _llr_of_periods(residuals: Sequence[_WhitenedResidual], periods_s: FloatArray, harmonics: int) -> FloatArray:
    """Return half the squares that each period takes away with so many harmonics, over all runs."""
    pairs = [
        _harmonic_products(_harmonic_rows(residual, periods_s, harmonics), residual, harmonics)
        for residual in residuals
    ]
    grams, along = (np.sum([pair[index] for pair in pairs], axis=0) for index in (0, 1))
    return _llr_of_products(grams, along)


def _harmonic_rows(residual: _WhitenedResidual, periods_s: FloatArray, harmonics: int) -> FloatArray:
    """Return cosines and sines of the session's time, shape `(periods · 2 H, B)`."""
    angle = 2 * np.pi * residual.scene.session_s / periods_s[:, None]
    waves = [turn(number * angle) for number in range(1, harmonics + 1) for turn in (np.cos, np.sin)]
    return residual.run.block_means(np.stack(waves, axis=1).reshape(-1, angle.shape[1]))


def _harmonic_products(rows: FloatArray, residual: _WhitenedResidual, harmonics: int) -> tuple[FloatArray, FloatArray]:
    white = residual.design.whitening.whiten(rows.T).T.reshape(-1, 2 * harmonics, rows.shape[1])
    return white @ white.transpose(0, 2, 1), white @ residual.values


def _llr_of_products(grams: FloatArray, along: FloatArray) -> FloatArray:
    size = np.trace(grams, axis1=1, axis2=2)[:, None, None] / grams.shape[1]
    result = np.linalg.solve(grams + (1e-6 * size + 1e-12) * np.eye(grams.shape[1]), along[:, :, None])[:, :, 0]
    return np.asarray(0.5 * np.sum(result * along, axis=1))


def _periodic_variants(variant: EffectVariant, period_s: float) -> list[EffectVariant]:
    effect, phase = variant.effect, variant.effect.phase
    others = [parameter for parameter in effect.shapes if parameter.name != _period_name(variant)]
    grid = SHARPNESSES if others else (0.0,)
    turns = np.linspace(-np.pi, np.pi, PHASE_STEPS, endpoint=False)
    return [
        EffectVariant(
            effect,
            {
                **variant.values,
                _period_name(variant): period_s,
                **{parameter.name: value for parameter in others},
                **({phase.name: float(turn)} if phase is not None else {}),
            },
        )
        for value in grid
        for turn in turns
    ]


def _period_name(variant: EffectVariant) -> str:
    return next(parameter.name for parameter in variant.effect.shapes if parameter.name.startswith("period"))


def _period_grid(period_s: float, session_s: float, width: float = 0.05, max_count: int = 300) -> FloatArray:
    """Return periods about one, near enough to each other for a phase to hold through a session."""
    step = 0.15 * period_s**2 / max(session_s, period_s)
    count = int(np.clip(2 * width * period_s / step, 3, max_count))
    return np.linspace(period_s * (1 - width), period_s * (1 + width), count)


GAUSS_NEWTON_STEPS = 2
MAX_OWN_VARIANTS, MIN_OWN_LLR = 3, 8.0
"""So many further shapes of its own effect a candidate may have, each of which must take away so much."""
MIN_EFFECT_CHI2 = 1.0
"""Whitened squares that effects add to a run that they act in."""
PERIOD_SEARCH_LLR = 26.0
"""Half squares that the best of some hundred periods, in any form, takes away by chance."""


@dataclass(frozen=True, slots=True, eq=False)
class HypothesisFit:
    """Effects refitted together, and what they leave.

    Attributes
    ----------
    parameters
        Nominal parameters and effects.
    chi2
        Whitened squares that remain, and the logarithm of the covariance's determinant over the nominal model's.
    chi2_with_form_error
        Those that remain when each effect may have a foreign form: modulated, with further shapes of its own.
    change_mN
        By how much the prediction changes, the nominal parameters refitted: root mean square where it does.
    excess_elsewhere
        What is left in runs where they add nothing, in standard deviations of chance.
    design
        The campaign around the point, without modulations and further shapes.
    """

    parameters: ParameterPoint
    chi2: float
    chi2_with_form_error: float
    change_mN: float
    excess_elsewhere: float
    design: Design

    @property
    def effects(self) -> tuple[str, ...]:
        """Their ids."""
        return tuple(candidate.effect.id for candidate in self.parameters.candidates)


def refit_with_effect(study: Study, design: Design, ranked: RankedEffect, nominal: Design) -> HypothesisFit:
    """Refit an effect beside those of a design, from the shape that was ranked first."""
    z, amplitude = joint_fit(design, ranked.variants)
    shape = design.variants[ranked.variants[0]]
    if not is_periodic_in_session(shape.effect):
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
        # The steps went astray, as with a period that lost its phase; where they began is no worse than without it.
        calm = ParameterPoint(design.z, start.candidates)
        others = [fit_hypothesis(study, point, nominal, design)[0] for point in (start, calm)]
        return min((fit, *others), key=lambda hypothesis: hypothesis.chi2)
    together = fit_common_phase(study, design, shape)
    start = ParameterPoint(design.z, (*design.candidates, together.candidate))
    tried = [start, gauss_newton(study, start, GAUSS_NEWTON_STEPS, design)]
    fit = min(
        (fit_hypothesis(study, point, nominal, design)[0] for point in tried), key=lambda hypothesis: hypothesis.chi2
    )
    before = project_dictionary(design, design.total_gram(), *NUISANCES).chi2 + design.log_det - nominal.log_det
    return replace(
        fit,
        chi2_with_form_error=min(
            fit.chi2_with_form_error, before - 2 * max(together.llr - PERIOD_SEARCH_LLR, ranked.llr)
        ),
    )


def fit_hypothesis(
    study: Study,
    point: ParameterPoint,
    nominal: Design,
    reference: Design | None = None,
    *,
    all_variants: bool = False,
) -> tuple[HypothesisFit, Design, tuple[int, ...]]:
    """Return what a point explains, its design, and the further shapes of its own effects that were taken."""
    own = {candidate.effect.id for candidate in point.candidates}
    shown = (
        study if all_variants else replace(study, effects=tuple(effect for effect in study.effects if effect.id in own))
    )
    design = linearise(shown, point.z, point.candidates, reference=reference, modulated=True, dictionary=True)
    total = design.total_gram()
    plain = fit_columns(design, total, ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT)
    flexible, taken = _add_own_variants(design, total, own)
    more_det = design.log_det - nominal.log_det
    kept = design.with_columns(ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT)
    fit = HypothesisFit(
        parameters=point,
        chi2=plain.chi2 + more_det,
        chi2_with_form_error=flexible + more_det,
        change_mN=_rms_change(study, design, nominal),
        excess_elsewhere=_excess_elsewhere(design, plain),
        design=kept,
    )
    return fit, design, taken


def _rms_change(study: Study, design: Design, nominal: Design) -> float:
    """Return by how much two designs predict another force, root mean square where they do [mN]."""
    more = np.concatenate(
        [
            run.predicted + run.effect_force - run_design.predicted
            for run, run_design in zip(design.runs, nominal.runs, strict=True)
        ]
    )
    weights = np.concatenate([run_data.coordinates.width_s for run_data in study.runs])
    return rms_where_active(more, weights)


def _excess_elsewhere(design: Design, plain: LeastSquaresFit) -> float:
    """Return the excess in runs that an explanation does not reach, where another effect must act."""
    fitted = np.append(1.0, -plain.coefficients)
    rows = np.append(0, 1 + plain.columns)
    squares, blocks = 0.0, 0
    for run, gram, count in zip(design.runs, design.grams, design.block_counts, strict=True):
        if float(np.sum(run.whitening.whiten(run.effect_force) ** 2)) < MIN_EFFECT_CHI2:
            squares += float(fitted @ gram[np.ix_(rows, rows)] @ fitted)
            blocks += count
    return (squares - blocks) / max(float(np.sqrt(2.0 * blocks)), NOISE_UNCERTAINTY / CHANCE_SIGMAS * blocks, 1.0)


def _add_own_variants(design: Design, total: FloatArray, own: set[str]) -> tuple[float, tuple[int, ...]]:
    """Add further shapes of the same effects one by one; return the squares that remain and the shapes."""
    projected = project_dictionary(design, total, *NUISANCES)
    squares = projected.chi2
    taken: tuple[int, ...] = ()
    for _ in range(MAX_OWN_VARIANTS):
        ranked = [best for best in rank_effects(projected, design.variants) if best.effect in own]
        if not ranked or ranked[0].llr < MIN_OWN_LLR:
            break
        taken = (*taken, *ranked[0].variants)
        squares -= 2 * ranked[0].llr
        projected = projected.without(ranked[0].variants)
    return squares, taken


def all_periodic_in_session(fit: HypothesisFit) -> bool:
    """Whether all effects of an explanation are periodic on the session's clock."""
    return all(is_periodic_in_session(candidate.effect) for candidate in fit.parameters.candidates)


def is_periodic_in_session(effect: Effect) -> bool:
    """Whether an effect is periodic on the session's clock."""
    return effect.periodic_in is Coordinate.SESSION


def rank_with_free_phases(design: Design, ranked: tuple[RankedEffect, ...]) -> tuple[RankedEffect, ...]:
    """Let what is periodic in time have a phase of its own in every run, then look for a period that ties them."""
    pairs = _quadrature_pairs(design.variants)
    if not pairs:
        return ranked
    nuisances = fit_columns(design, design.total_gram(), *NUISANCES)
    tried = [(*free_phase_llr(design, nuisances, pair), pair) for pair in pairs]
    gain, runs, pair = max(tried, key=lambda item: item[0] - item[1])
    effect = design.variants[pair[0]].effect.id
    tied = next((best for best in ranked if best.effect == effect), None)
    # The largest of so many periods is above what one of them has by chance.
    beyond = gain - runs - 2 * np.sqrt(2 * runs * np.log(len(pairs)))
    if tied is None or beyond <= tied.llr:
        return ranked
    free = RankedEffect(effect, beyond, tied.d_prime_per_unit, pair, np.array([0.5, 0.5]))
    return tuple(sorted((free if best.effect == effect else best for best in ranked), key=lambda best: -best.llr))


def _quadrature_pairs(shapes: Sequence[EffectVariant]) -> list[tuple[int, int]]:
    """Return the pairs of shapes that are periodic in the session's time."""
    return [
        (number, number + 1)
        for number, variant in enumerate(shapes)
        if is_periodic_in_session(variant.effect) and not variant.is_quadrature and variant.effect.phase is not None
    ]
