"""Search for the effects that explain the force: each effect alone first, then forward selection of further ones.

An effect that is missing in the catalogue is mistaken for the one most similar to it. A nonparametric law is the force
as any smooth function of one coordinate, given by its values at knots; if such a function explains more than that
effect does, the effect is not the cause.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from dragrig.analysis.gap.design import (
    NUISANCES,
    ColumnKind,
    Design,
    ParameterPoint,
    RankedEffect,
    RunDesign,
    Study,
    gain_of_step,
    gauss_newton,
    gauss_newton_step,
    linearise,
    misfit_here,
    project_dictionary,
    rank_effects,
    schur_complement,
)
from dragrig.analysis.gap.features import NonparametricLaw
from dragrig.analysis.gap.hypothesis_fit import HypothesisFit, fit_hypothesis, rank_with_free_phases, refit_with_effect
from dragrig.analysis.gap.run_data import BlockCoordinates, RunData, rms_where_active
from dragrig.rig import Contact, FloatArray, IndexArray
from dragrig.sim_backend.effects import SlipHistory

KNOT_PRIOR_SD_MN = 30.0
"""Prior standard deviation of a law's value at a knot."""
MIN_KNOT_SPEED_MM_S = 0.3
LOG_SPEED_KNOTS = np.log(np.geomspace(MIN_KNOT_SPEED_MM_S, 62.0, 14))
LOG_TIME_KNOTS = np.log(np.geomspace(0.03, 8.0, 8))
LOAD_KNOTS, SESSION_KNOTS = 12, 8
POSITION_KNOT_STEP_MM, POSITION_KNOTS = 1.5, 30
SWING_HARMONICS = 4


def nonparametric_columns(
    runs: Sequence[RunData], predicted: Sequence[FloatArray], period_s: float
) -> Mapping[str, list[FloatArray]]:
    """Return the columns of every shared law by its name, per run, in units of their priors, shape `(B, k)`.

    Parameters
    ----------
    predicted
        Predicted block means of each run's force [mN].
    period_s
        Period of a swing that all runs share; 0 for none.
    """
    knots = _Knots.of([run.coordinates for run in runs], predicted)
    laws = [_columns_of_run(run_data, force, knots) for run_data, force in zip(runs, predicted, strict=True)]
    columns = {name: [columns_of_run[name] for columns_of_run in laws] for name in laws[0]}
    if not runs[0].has_clock:
        del columns["session"]
    if period_s > 0:
        columns["swing in all runs"] = [_harmonic_columns(run.coordinates.session_s / period_s) for run in runs]
    return columns


@dataclass(frozen=True, slots=True, eq=False)
class _Knots:
    """Knots of position, load and session time, shared by all runs of a campaign."""

    place_mm: FloatArray
    load_mN: FloatArray
    session_s: FloatArray

    @classmethod
    def of(cls, runs: Sequence[BlockCoordinates], predicted: Sequence[FloatArray]) -> "_Knots":
        position = np.concatenate([blocks.position_mm for blocks in runs])
        session, load = np.concatenate([blocks.session_s for blocks in runs]), np.concatenate(predicted)
        position_knots = int(np.clip(np.ptp(position) / POSITION_KNOT_STEP_MM, 2, POSITION_KNOTS))
        return cls(
            *(
                np.linspace(float(coordinate.min()), float(coordinate.max()) + 1e-9, count)
                for coordinate, count in ((position, position_knots), (load, LOAD_KNOTS), (session, SESSION_KNOTS))
            )
        )


def _columns_of_run(run: RunData, predicted: FloatArray, knots: _Knots) -> Mapping[str, FloatArray]:
    """Return the columns of every law at the blocks of a run, in units of their priors, shape `(B, k)`."""
    blocks, contact = run.coordinates, run.experiment.contact
    slip = SlipHistory.of(run.experiment.motion, blocks.time_s)
    slides = contact is Contact.SLIDING
    closed = slides and run.experiment.kind != "coulomb"
    moves = blocks.speed_mm_s > 0.5 * MIN_KNOT_SPEED_MM_S
    speed = _hat_functions(np.log(blocks.speed_mm_s + 1e-9), LOG_SPEED_KNOTS) * moves[:, None]
    signed_speed = speed * slip.heading[:, None]
    position = _hat_functions(blocks.position_mm, knots.place_mm)
    since_begin, since_start, since_stop = (
        _hat_functions(np.log(np.maximum(time_s, 1e-9)), LOG_TIME_KNOTS)
        for time_s in (blocks.time_s, slip.since_start_s, slip.since_stop_s)
    )
    before, after = (slip.heading == 0)[:, None], (slip.since_stop_s > 0)[:, None]
    time_at_rest = np.column_stack((since_begin * before, since_stop * after))
    since_change = np.column_stack((since_start * moves[:, None], since_stop * after))
    laws = {
        "speed": speed,
        "speed of sliding": slides * signed_speed,
        "speed in the gut": closed * signed_speed,
        "place": (contact is not Contact.STICKING) * position,
        "place in the gut": closed * position,
        "time at rest": time_at_rest,
        "time at rest in the gut": closed * time_at_rest,
        "time since start and stop": since_change,
        "time since start and stop in the gut": closed * since_change,
        "load": _hat_functions(predicted, knots.load_mN),
        "session": _hat_functions(blocks.session_s, knots.session_s),
    }
    return {name: KNOT_PRIOR_SD_MN * values for name, values in laws.items()}


def _hat_functions(coordinate: FloatArray, knots: FloatArray) -> FloatArray:
    """Return piecewise linear functions: 1 at one knot, 0 at all others, constant beyond the ends, `(B, k)`."""
    return np.stack([np.interp(coordinate, knots, unit) for unit in np.eye(knots.size)], axis=1)


def _harmonic_columns(turns: FloatArray) -> FloatArray:
    angle = 2 * np.pi * np.arange(1, SWING_HARMONICS + 1) * turns[:, None]
    return KNOT_PRIOR_SD_MN * np.hstack((np.cos(angle), np.sin(angle)))


RUN_GAIN_LAW, RUN_GAIN_PRIOR_SD = "gain of a run", 0.2
"""The law that every run has a gain of its own, and the gain's prior standard deviation."""


def fit_nonparametric_laws(
    design: Design, runs: Sequence[RunData], period_s: float = 0.0, nuisance_columns: IndexArray | None = None
) -> tuple[NonparametricLaw, ...]:
    """Fit every law beside the nuisances of a design.

    Parameters
    ----------
    design
        Linearised campaign.
    runs
        Data of its runs.
    period_s
        Period of a swing on the session clock that all runs share; 0 for none.
    nuisance_columns
        Columns of the design to project out; default: those of the nominal model.

    Returns
    -------
    laws
        All laws, by increasing chi-square.
    """
    predicted = [run.predicted for run in design.runs]
    columns = nonparametric_columns(runs, predicted, period_s)
    nuisances = (
        design.columns_of(ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR) if nuisance_columns is None else nuisance_columns
    )
    nuisance_rows = 1 + np.arange(nuisances.size)
    edges = 1 + nuisance_rows.size + np.cumsum([0, *(fitted_law[0].shape[1] for fitted_law in columns.values())])
    total = np.zeros((edges[-1] + len(predicted), edges[-1] + len(predicted)))
    for number, run in enumerate(design.runs):
        shared_columns = (
            run.residual,
            run.columns[:, nuisances],
            *(fitted_law[number] for fitted_law in columns.values()),
        )
        rows = np.append(np.arange(edges[-1]), edges[-1] + number)
        total[np.ix_(rows, rows)] += run.whitening.gram(
            np.column_stack((*shared_columns, RUN_GAIN_PRIOR_SD * predicted[number]))
        )
    complement = schur_complement(design, total, nuisances, np.arange(edges[0], len(total)), nuisance_rows)
    widths_s = np.concatenate([run_data.coordinates.width_s for run_data in runs])

    def law(name: str, low: int, high: int) -> NonparametricLaw:
        twice_log_evidence, values = _twice_log_evidence(
            complement, slice(low - nuisance_rows.size, high - nuisance_rows.size)
        )
        if name == RUN_GAIN_LAW:
            more = [RUN_GAIN_PRIOR_SD * value * force for value, force in zip(values.tolist(), predicted, strict=True)]
        else:
            more = [array @ values for array in columns[name]]
        return NonparametricLaw(
            name, float(complement[0, 0]) - twice_log_evidence, rms_where_active(np.concatenate(more), widths_s)
        )

    limits = [*edges.tolist(), len(total)]
    laws = [
        law(name, *rows_of_law) for name, rows_of_law in zip((*columns, RUN_GAIN_LAW), pairwise(limits), strict=True)
    ]
    return tuple(sorted(laws, key=lambda fitted_law: fitted_law.chi2))


def _twice_log_evidence(complement: FloatArray, rows: slice) -> tuple[float, FloatArray]:
    """Return twice the log evidence for columns in units of their priors, and their coefficients.

    The log evidence is the chi-square difference minus the Occam factor of the free values.
    """
    gram, moment = complement[rows, rows], complement[rows, 0]
    precision = gram + np.eye(gram.shape[0])
    coefficients = np.asarray(np.linalg.solve(precision, moment), dtype=np.float64)
    return float(moment @ coefficients) - float(np.linalg.slogdet(precision)[1]), coefficients


@dataclass(frozen=True, eq=False)
class ForceSearchResult:
    """All hypotheses that were fitted to the force of a campaign."""

    study: Study
    nominal: Design
    """Fit of the nominal model, with the dictionary."""
    chi2: float
    """Chi-square of the nominal model."""
    ranked: tuple[RankedEffect, ...]
    """Best variant of each effect beside the nominal model."""
    singles: tuple[HypothesisFit, ...]
    """Effects fitted alone, the best first; then effects of later steps fitted alone."""
    steps: tuple["SelectionStep", ...]
    """Steps of the forward selection."""

    @property
    def block_count(self) -> int:
        """Number of blocks: the expected chi-square of noise."""
        return sum(self.nominal.block_counts)

    @property
    def fits(self) -> tuple[HypothesisFit, ...]:
        """Fits of all hypotheses, those of single effects first."""
        return (*self.singles, *(step.fit for step in self.steps if step.fit is not None))

    @cached_property
    def fitted(self) -> Design:
        """The campaign linearised around the nominal parameters of the best hypothesis, with the dictionary.

        Far from the truth the signatures would be those of another specimen.
        """
        if not self.fits:
            return self.nominal
        best = min(self.fits, key=lambda fit: fit.chi2)
        return linearise(self.study, best.parameters.z, dictionary=True, reference=self.nominal)

    @cached_property
    def excess(self) -> float:
        """Chi-square of the nominal model above its expectation."""
        return self.chi2 - self.block_count

    def explained_share(self, chi2: float) -> float:
        """Return the share of the excess that a fit with this chi-square explains."""
        return 1.0 - (chi2 - self.block_count) / max(self.excess, 1.0)

    def merit(self, fit: HypothesisFit) -> float:
        """Return the explained share, averaged over the fits without and with form error.

        Effects periodic in session time may lose their phase between runs: for them the fit with form error counts
        alone.
        """
        exact, with_form_error = self.explained_share(fit.chi2), self.explained_share(fit.chi2_with_form_error)
        return with_form_error if fit.periodic else 0.5 * (exact + with_form_error)


@dataclass(frozen=True, slots=True, eq=False)
class SelectionStep:
    """A further effect that was tried; all numbers allow for form error of the effects before it."""

    effect: str
    """Id of the effect."""
    llr: float
    """Its log likelihood ratio beside the effects before it."""
    chi2_without: float
    """Chi-square without it."""
    laws: tuple[NonparametricLaw, ...]
    """Nonparametric laws in its place, the best first."""
    fit: HypothesisFit | None
    """Fit with it; None where its log likelihood ratio is too small."""


FORM_ERROR_SD = 0.25
"""Relative form error of an effect, one standard deviation: real effects leave 10 to 40 % of the catalogue's form."""


def inflate_by_form_error(design: Design) -> Design:
    """Return a design whose noise grows with the force of its candidates.

    Form error is largest where an effect is largest, and there a second effect is hardly separable from it. Where the
    first effect is small, a residual force cannot be its form error.
    """
    runs = zip(design.runs, design.grams, strict=True)
    inflated, grams = zip(
        *(_inflated_run(run) if run.effect_force.any() else (run, gram) for run, gram in runs), strict=True
    )
    return replace(design, runs=inflated, grams=grams)


def _inflated_run(run: RunDesign) -> tuple[RunDesign, FloatArray]:
    sd = FORM_ERROR_SD * np.abs(run.effect_force)
    whitening = run.whitening.with_form_error(sd)
    gram = whitening.gram(np.column_stack((run.residual, run.columns)))
    return replace(run, motion_sd=np.hypot(run.motion_sd, sd), whitening=whitening), gram


MAX_EFFECTS = 3
MIN_FURTHER_LLR = 11.0
"""Smaller log likelihood ratios of a further effect are noise."""
OTHER_DOMAIN_SHARE = 0.2
"""An effect of another coordinate is also tried if it reaches this share of the best one's log likelihood ratio."""


def forward_selection(search: ForceSearchResult) -> list[SelectionStep]:
    """Add one effect after another to the best single one."""
    steps: list[SelectionStep] = []
    current: HypothesisFit | None = search.singles[0]
    while current is not None and len(current.effects) < MAX_EFFECTS:
        step_candidates = _selection_steps(search, current)
        steps += step_candidates
        current = step_candidates[0].fit if step_candidates else None
    return steps


def _selection_steps(search: ForceSearchResult, current: HypothesisFit) -> list[SelectionStep]:
    """Try the best further effect, and the best of those with another coordinate."""
    point = current.parameters
    _, design, own_variants = fit_hypothesis(search.study, point, search.nominal, current.design, all_variants=True)
    inflated = inflate_by_form_error(design)
    projected = project_dictionary(inflated, inflated.total_gram(), *NUISANCES)
    for number in range(len(own_variants)):
        projected = projected.without((own_variants[number],))
    present = {candidate.effect.id for candidate in point.candidates}
    all_ranked = rank_with_free_phases(inflated, rank_effects(projected, inflated.variants))
    ranked = [best for best in all_ranked if best.effect not in present]
    steps = []
    for best in (*ranked[:1], *_best_of_other_domain(ranked, inflated, point)):
        fit = refit_with_effect(search.study, design, best, search.nominal) if best.llr > MIN_FURTHER_LLR else None
        steps.append(SelectionStep(best.effect, best.llr, projected.chi2, (), fit))
    if all(step.fit is None for step in steps):
        return steps
    nuisance_columns = np.sort(
        np.concatenate((inflated.columns_of(*NUISANCES), inflated.columns_of(ColumnKind.VARIANT)[list(own_variants)]))
    )
    laws = fit_nonparametric_laws(inflated, search.study.runs, nuisance_columns=nuisance_columns)
    return [replace(step, laws=laws) for step in steps]


def fit_together(search: ForceSearchResult, names: Sequence[str]) -> HypothesisFit | None:
    """Return the fit with these effects alone; those that no fit of the search has yet are added to the largest one."""
    wanted = set(names)
    subsets = [fit for fit in search.fits if set(fit.effects) <= wanted]
    fit = max(subsets, key=lambda subset: len(subset.effects), default=None)
    missing = wanted - set(() if fit is None else fit.effects)
    while missing:
        design = search.nominal
        if fit is not None:
            design = fit_hypothesis(search.study, fit.parameters, search.nominal, fit.design, all_variants=True)[1]
        projected = project_dictionary(design, design.total_gram(), *NUISANCES)
        ranked = rank_with_free_phases(design, rank_effects(projected, design.variants))
        best = next((entry for entry in ranked if entry.effect in missing), None)
        if best is None:
            break
        fit = refit_with_effect(search.study, design, best, search.nominal)
        missing -= set(fit.effects)
    return fit


def _best_of_other_domain(
    ranked: Sequence[RankedEffect], design: Design, point: ParameterPoint
) -> tuple[RankedEffect, ...]:
    """Return the best effect whose coordinate differs from the best one's and from those present."""
    coordinates = {variant.effect.id: variant.effect.coordinate for variant in design.variants}
    excluded = {candidate.effect.coordinate for candidate in point.candidates} | {
        coordinates[best.effect] for best in ranked[:1]
    }
    others = [best for best in ranked[1:] if coordinates[best.effect] not in excluded]
    return tuple(best for best in others[:1] if best.llr > OTHER_DOMAIN_SHARE * ranked[0].llr)


NOMINAL_STEPS = 2
"""Further steps of the nominal model alone, after derivatives were computed twice."""
MIN_EXCESS_SIGMAS = 4.0
"""Chi-square above its expectation, over the root of the number of blocks, from which a gap is suspected."""
MAX_NOMINAL_GAIN, MAX_NOMINAL_GAIN_SHARE, MAX_CONVERGING_STEPS = 4.0, 0.1, 5
"""The nominal model has converged where a step gains less chi-square than this, or than this share of the log
likelihood ratio of the best effect; or after so many steps."""
MAX_STALE_MISFIT = 60.0
"""Where derivatives and uncertainties of a nearby point make the nominal model more unlikely than this, −2 log, they
are computed anew; at 10 kHz it was 230."""
SHORTLIST = 3
MIN_SHARE_OF_BEST = 0.2
"""A candidate is fitted if it reaches this share of the best one's log likelihood ratio."""
MIN_SINGLE_LLR = 7.0
"""Smaller log likelihood ratios of a single effect are noise."""


def search_effects(study: Study, min_llr: float = MIN_SINGLE_LLR, min_share: float = 0.0) -> ForceSearchResult:
    """Fit the most likely effects on the force of a campaign, alone and together.

    Parameters
    ----------
    min_llr, min_share
        Thresholds below which an effect is not fitted: log likelihood ratio, and share of the excess.
    """
    first = gauss_newton_step(linearise(study, study.initial_z))
    second = linearise(study, first.z)
    start = gauss_newton(study, gauss_newton_step(second), NOMINAL_STEPS, second)
    search = _ranked_beside_nominal(study, start.z, second)
    if _likely_effects(search, min_llr, min_share) or search.excess > MIN_EXCESS_SIGMAS * np.sqrt(search.block_count):
        search = _with_converged_nominal(search)
    nominal, likely = search.nominal, _likely_effects(search, min_llr, min_share)
    singles = [refit_with_effect(study, nominal, best, nominal) for best in likely]
    singles.sort(key=search.merit, reverse=True)
    singles[:1] = [_relinearised(study, fit, nominal) for fit in singles[:1]]
    search = replace(search, singles=tuple(singles))
    if not singles:
        return search
    search = replace(search, steps=tuple(forward_selection(search)))
    return replace(search, singles=(*singles, *_refit_second_alone(search)))


def _ranked_beside_nominal(study: Study, z: FloatArray, reference: Design) -> ForceSearchResult:
    nominal = linearise(study, z, dictionary=True, reference=reference)
    projected = project_dictionary(nominal, nominal.total_gram(), *NUISANCES)
    ranked = rank_with_free_phases(nominal, rank_effects(projected, nominal.variants))
    return ForceSearchResult(study, nominal, projected.chi2, ranked, (), ())


def _likely_effects(search: ForceSearchResult, min_llr: float, min_share: float) -> list[RankedEffect]:
    """Return the effects to be fitted alone."""
    ranked = search.ranked
    if not ranked:
        return []
    threshold = max(min_llr, MIN_SHARE_OF_BEST * ranked[0].llr, 0.5 * min_share * search.excess)
    return [best for best in ranked[:SHORTLIST] if best.llr > threshold]


def _with_converged_nominal(search: ForceSearchResult) -> ForceSearchResult:
    """Return the search around a nominal model whose next step would gain little beside the best effect's gain.

    At high rates many blocks resolve when friction sets in, and uncertainty and derivatives change on the way. A gap
    that a further step of the nominal model would close then looks like any effect whose fit makes that step.
    """
    study = search.study
    best_llr = max((best.llr for best in search.ranked), default=0.0)
    allowed = max(MAX_NOMINAL_GAIN, MAX_NOMINAL_GAIN_SHARE * best_llr)
    design = linearise(study, search.nominal.z)
    for _ in range(MAX_CONVERGING_STEPS):
        if gain_of_step(design) < allowed:
            break
        further = linearise(study, gauss_newton_step(design).z)
        # Derivatives are of the model without the effects that it has already: their steps may lead away.
        if misfit_here(further) > misfit_here(design):
            break
        design = further
    if design.z is search.nominal.z and misfit_here(search.nominal) - misfit_here(design) < MAX_STALE_MISFIT:
        return search
    return _ranked_beside_nominal(study, design.z, design)


def _refit_second_alone(search: ForceSearchResult) -> list[HypothesisFit]:
    """Fit the second effect alone: it may make the first superfluous."""
    tried = {fit.effects[0] for fit in search.singles}
    seconds = {step.effect for step in search.steps if step.fit is not None and len(step.fit.effects) == 2}
    ranked = [best for best in search.ranked if best.effect in seconds - tried]
    return [refit_with_effect(search.study, search.nominal, best, search.nominal) for best in ranked]


def _relinearised(study: Study, fit: HypothesisFit, nominal: Design) -> HypothesisFit:
    """Fit again with derivatives at the fitted point, which may be far from where they were computed."""
    design = linearise(study, fit.parameters.z, fit.parameters.candidates)
    fits = [fit_hypothesis(study, point, nominal, design)[0] for point in (gauss_newton_step(design), fit.parameters)]
    best = min(fits, key=lambda hypothesis: hypothesis.chi2)
    return (
        replace(best, chi2_with_form_error=min(best.chi2_with_form_error, fit.chi2_with_form_error))
        if fit.periodic
        else best
    )
