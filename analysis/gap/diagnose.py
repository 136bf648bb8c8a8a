"""A diagnosis from end to end: location of the gap, its cause, its size, and the amended model."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np

from dragrig.analysis import (
    NORMAL_95,
    EstimatedQuantity,
    Experiment,
    MovingLine,
    NominalModel,
    Progress,
    RunSelection,
    counted,
    estimate_noise,
    no_progress,
    repeat_differences,
    single_blas_thread,
)
from dragrig.analysis.gap.budget import CausesOfGap, gap_budget
from dragrig.analysis.gap.candidate_runs import ExperimentBudget
from dragrig.analysis.gap.classifier import (
    MIN_LLR_BESIDE_POSITION,
    Judgement,
    as_misjudged_noise,
    judge,
    mains_hum_present,
    unknown_because_of_line,
    unknown_by_excess_alone,
)
from dragrig.analysis.gap.design import Candidate, ColumnKind, Study, fit_columns
from dragrig.analysis.gap.diagnosis import (
    ALPHA,
    NO_GAP,
    UNKNOWN,
    Classification,
    Diagnosis,
    GapBudget,
    GapLocation,
    GapReduction,
    RankedHypothesis,
    RunContributions,
    RunTraces,
    Verdict,
)
from dragrig.analysis.gap.features import (
    DecisionInputs,
    HypothesisSummary,
    NonparametricLaw,
    VerdictCalibration,
    shipped_calibration,
)
from dragrig.analysis.gap.forward_selection import (
    ForceSearchResult,
    fit_nonparametric_laws,
    fit_together,
    search_effects,
)
from dragrig.analysis.gap.gap_reduction import (
    RunGap,
    force_residual_blocks,
    gap_of_run,
    held_out_improvement,
    position_residual_blocks,
    predict_held_out,
    reduction_over_runs,
    traces_of_run,
)
from dragrig.analysis.gap.hypothesis_fit import HypothesisFit, converged
from dragrig.analysis.gap.isolability import DEFAULT_TOLERANCE_MN, detection_limit
from dragrig.analysis.gap.localise import attribute_to_effects, localise
from dragrig.analysis.gap.next_run import Recommendation, recommend_next_run
from dragrig.analysis.gap.position_channel import (
    PositionAnalysis,
    analyse_position,
    contribution_to_position,
    position_gap_reduction,
    share_of_position,
)
from dragrig.analysis.gap.presence import judge_presence, prepare_competition
from dragrig.analysis.gap.spectral_lines import (
    SpectralLine,
    SpectralLines,
    correct_known_motion,
    find_moving_line,
    find_spectral_lines,
    known_effects,
    lines_beyond_known,
    lines_that_matter,
    moving_line_remark,
)
from dragrig.analysis.gap.studies import CapsuleStudy, prepare_study
from dragrig.analysis.gap.unknown_gap import describe_unexplained_gap
from dragrig.config import DiagnosisSummary, EffectSettings, ModelSettings
from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import catalogue, hum_effect


def add_hum_to_noise(study: Study, experiments: Sequence[Experiment], lines: SpectralLines) -> Study:
    """Return a study whose noise includes the mains hum that was found, at its frequency.

    Hum treated as white noise would make short blocks too noisy and long ones too quiet.
    """
    if not mains_hum_present(lines.mains.llr, lines.non_mains.llr):
        return study
    problem = study.problem
    repeats = repeat_differences(problem.channels, study.channel, problem.nominal)
    noise = estimate_noise(experiments, study.channel, lines.mains.amplitude, lines.mains.frequency_hz, repeats)
    noises = tuple(noise for _ in problem.noises)
    return replace(study, problem=replace(problem, noises=noises))


def add_moving_line_to_noise(study: Study, line: MovingLine | None) -> Study:
    """Return a study whose blocks know of a line that motion adds."""
    if line is None:
        return study
    channels = tuple(replace(blocks, moving_line=line) for blocks in study.problem.channels)
    return replace(study, problem=replace(study.problem, channels=channels))


MAX_FURTHER_LAWS = 3
"""Number of nonparametric laws that are stored in place of a further effect."""


def decision_inputs(
    search: ForceSearchResult, position: PositionAnalysis, lines: SpectralLines, excluded: tuple[str, ...]
) -> DecisionInputs:
    """Return the inputs of the verdict; `excluded` are effects left out of the search."""
    study = search.study
    hypotheses = []
    for fit in search.singles:
        chi2 = fit.chi2_with_form_error if fit.periodic else fit.chi2
        hypotheses.append(_summary(fit, study, 0.5 * (search.chi2 - chi2), search.chi2))
    for step in search.steps:
        if step.fit is not None:
            laws = step.laws[:MAX_FURTHER_LAWS]
            numbers = step.llr, step.chi2_without, laws
            hypotheses.append(_summary(step.fit, study, *numbers))
    return DecisionInputs(
        block_count=search.block_count,
        chi2=search.chi2,
        hypotheses=tuple(hypotheses),
        mains_llr=lines.mains.llr,
        line_llr=lines.non_mains.llr,
        position=position.shares if position.has_position_error else (),
        has_position_error=position.has_position_error,
        moves_astray=position.has_position_error and not position.is_recording_error,
        excluded=excluded,
        laws=fit_nonparametric_laws(search.nominal, search.study.runs, _swing_period_s(search.singles)),
    )


def _swing_period_s(singles: Sequence[HypothesisFit]) -> float:
    """Return the period of an effect that is periodic in session time; 0 for none."""
    periodic = (
        candidate for fit in singles for candidate in fit.parameters.candidates if candidate.effect.periodic_in_session
    )
    return next((candidate.values[candidate.effect.period_parameter] for candidate in periodic), 0.0)


def _summary(
    fit: HypothesisFit,
    study: Study,
    llr: float,
    chi2_without: float,
    laws: tuple[NonparametricLaw, ...] = (),
) -> HypothesisSummary:
    return HypothesisSummary(
        effects=fit.effects,
        chi2=fit.chi2,
        chi2_with_form_error=fit.chi2_with_form_error,
        change_mN=fit.change_mN,
        periodic=fit.periodic,
        llr=llr,
        chi2_without=chi2_without,
        laws=laws,
        excess_elsewhere=fit.excess_elsewhere,
        at_limit=any(candidate.at_limit for candidate in fit.parameters.candidates),
        untried_lookalikes=study.untried_lookalikes(fit.design),
        not_established=study.naming_obstacle(fit.design),
    )


def hypothesis_parameters(
    name: str, fit: HypothesisFit | None, position: PositionAnalysis, lines: SpectralLines
) -> tuple[EstimatedQuantity, ...]:
    """Return the fitted parameters of a hypothesis with their errors."""
    quantities: list[EstimatedQuantity] = []
    if fit is not None:
        solution = fit_columns(
            fit.design, fit.design.total_gram(), ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT
        )
        errors = np.sqrt(np.maximum(np.diag(solution.covariance), 0.0))
        effect_errors = errors[np.searchsorted(solution.columns, fit.design.columns_of(ColumnKind.EFFECT))].tolist()
        several = len(fit.parameters.candidates) > 1
        for candidate in fit.parameters.candidates:
            errors_of_candidate, effect_errors = (
                effect_errors[: len(candidate.fitted_parameters)],
                effect_errors[len(candidate.fitted_parameters) :],
            )
            quantities += _quantities(candidate, errors_of_candidate, several)
    position_effect = position.candidate
    if position_effect is not None and position_effect.effect.id in name.split("+"):
        quantities += _quantities(position_effect, position.standard_errors, "+" in name)
    if name == hum_effect().id:
        errors = np.array([0.5 * lines.mains.amplitude**0.5, 0.5])
        units = {parameter.name: parameter.unit for parameter in hum_effect().parameters}
        quantities += [
            _quantity(parameter, units[parameter], value, error)
            for (parameter, value), error in zip(_hum_values(lines).items(), errors.tolist(), strict=True)
        ]
    return tuple(quantities)


def _hum_values(lines: SpectralLines) -> dict[str, float]:
    """Return the parameters of hum that a spectral line has; its phase differs from run to run."""
    hum, line = hum_effect(), lines.mains
    return {hum.size.name: line.amplitude, hum.period_parameter: line.source_hz}


def _quantities(candidate: Candidate, errors: Sequence[float], several: bool) -> Iterator[EstimatedQuantity]:
    for parameter, error in zip(candidate.fitted_parameters, errors, strict=True):
        name = f"{candidate.effect.id}.{parameter.name}" if several else parameter.name
        yield _quantity(name, parameter.unit, candidate.values[parameter.name], error)


def _quantity(name: str, unit: str, value: float, error: float) -> EstimatedQuantity:
    half = NORMAL_95 * error
    return EstimatedQuantity(name, unit, value, error, (value - half, value + half))


PARAMETER_DIGITS = 6


def amended_model(
    study: Study,
    fit: HypothesisFit | None,
    position: PositionAnalysis,
    lines: SpectralLines,
    classification: Classification,
    search: ForceSearchResult,
    reduction: GapReduction | None,
    selection: RunSelection,
) -> ModelSettings | None:
    """Return the model of these runs with the named effects; None without any, or where it cannot have them."""
    if not classification.effects:
        return None
    z = search.nominal.z if fit is None else fit.parameters.z
    settings = study.amended_settings(z)
    if settings is None:
        return None
    effects = list(settings.effects)
    if fit is not None:
        effects += [candidate.settings for candidate in fit.parameters.candidates]
    if position.candidate is not None and position.candidate.effect.id in classification.effects:
        effects.append(position.candidate.settings)
    if hum_effect().id in classification.effects:
        effects.append(EffectSettings(id=hum_effect().id, parameters=_hum_values(lines)))
    rounded = [
        EffectSettings(
            id=effect.id, parameters={name: _rounded_value(value) for name, value in effect.parameters.items()}
        )
        for effect in effects
    ]
    interval = None if reduction is None else reduction.closed_95ci
    diagnosed = DiagnosisSummary(
        specimen=selection.specimen,
        verdict=classification.verdict.value,
        effects=classification.effects,
        probability=_rounded_value(classification.probabilities.get("+".join(classification.effects), 0.0)),
        runs=len(study.runs),
        promised=None if reduction is None or reduction.closed is None else _rounded_value(reduction.closed),
        promised_95ci=None if interval is None else (_rounded_value(interval[0]), _rounded_value(interval[1])),
        nominal=_rounded_values(study, search.nominal.z),
        run_ids=tuple(experiment.run.info.header.run_id for experiment in selection.experiments),
    )
    return settings.with_values(_rounded_values(study, z)).model_copy(
        update={"name": "amended", "effects": tuple(rounded), "diagnosed": diagnosed}
    )


def _rounded_values(study: Study, z: FloatArray) -> dict[str, float]:
    return {name: _rounded_value(value) for name, value in study.values(z).items()}


def _rounded_value(value: float) -> float:
    return float(np.format_float_scientific(value, precision=PARAMETER_DIGITS)) if value else 0.0


SLOW_LINE_HZ, MIN_SLOW_LINE_LLR = 4.9, 300.0
"""Slow noise resembles lines below this frequency with smaller log likelihood ratios: at most 38 in 500 simulated
campaigns."""
MAX_GAP_OVER_FLOOR = 1.05
"""A gap up to this multiple of its floor equals it."""
RESIDUAL_SHARE = 0.15
"""Unexplained share of the gap above which something is left beside named effects: forms leave less of most effects."""
CALIBRATION_NOTE = "calibrated on simulated campaigns"
PREPARING_COST, SEARCH_COST, COMPETITION_COST, ASSEMBLY_COST = 26, 34, 34, 6
"""Relative times of a diagnosis's parts."""
MIN_LLR_AND_SHARE_WITH_MOTION_ERROR = 0.5 * MIN_LLR_BESIDE_POSITION, 0.3
"""Where the stage has position errors, motion errors mimic small force effects: thresholds of Δχ²/2 and of the share of
the excess for an effect to be fitted."""


@dataclass(frozen=True, slots=True)
class DiagnosisOptions:
    """Options of a diagnosis."""

    excluded: tuple[str, ...] = ()
    """Effects to leave out."""
    tolerance_mN: float = DEFAULT_TOLERANCE_MN
    """Smallest relevant rms force of an effect where it acts."""
    next_runs: ExperimentBudget | None = field(default_factory=ExperimentBudget)
    """Limits of the next experiment; default: one run of the short grid. None recommends none."""
    calibration: VerdictCalibration | None = None
    """Gate and weights of the verdict; default: the shipped ones."""


@dataclass(frozen=True, slots=True, eq=False)
class DiagnosisWithCauses:
    """A diagnosis, and the evidence behind it that several campaigns are pooled by."""

    diagnosis: Diagnosis
    causes: CausesOfGap
    """What competes for the gap in the force."""
    position: PositionAnalysis
    """What competes for the errors of the position."""
    lines: SpectralLines
    """Strongest spectral lines of the rests."""


def diagnose(
    selection: RunSelection,
    nominal: NominalModel,
    options: DiagnosisOptions | None = None,
    progress: Progress = no_progress,
) -> Diagnosis:
    """Diagnose the gap between the runs of a specimen and a nominal model.

    Raises
    ------
    AnalysisError
        Where the model predicts none of these runs, or a run lacks data that it needs.
    """
    return _diagnose(selection, nominal, options, progress, poolable=False).diagnosis


def diagnose_with_causes(
    selection: RunSelection,
    nominal: NominalModel,
    options: DiagnosisOptions | None = None,
    progress: Progress = no_progress,
) -> DiagnosisWithCauses:
    """Return what campaigns are pooled by, and their diagnosis; it does not say how far the gap closes."""
    return _diagnose(selection, nominal, options, progress, poolable=True)


@single_blas_thread()
def _diagnose(
    selection: RunSelection,
    nominal: NominalModel,
    options: DiagnosisOptions | None,
    progress: Progress,
    *,
    poolable: bool,
) -> DiagnosisWithCauses:
    settings = options or DiagnosisOptions()
    start = perf_counter()
    advance = counted(progress, PREPARING_COST + SEARCH_COST + COMPETITION_COST + ASSEMBLY_COST)
    effects = [effect for effect in catalogue().values() if effect.id not in settings.excluded]
    known = known_effects(nominal)
    selection = correct_known_motion(selection, known)
    position = analyse_position(selection.experiments, effects)
    study = prepare_study(
        _with_trusted_motion(selection, position), nominal, [effect for effect in effects if effect.has_force_signature]
    )
    lines = lines_beyond_known(_without_slow_lines(find_spectral_lines(selection.experiments, study.channel)), known)
    moving_line = find_moving_line(selection.experiments, study.channel)
    study = add_moving_line_to_noise(study, moving_line)
    if moving_line is not None and moving_line.amplitude >= np.sqrt(2.0) * settings.tolerance_mN:
        selection = replace(selection, remarks=(*selection.remarks, moving_line_remark(moving_line)))
    studied = perf_counter()
    advance(PREPARING_COST)
    with_hum = add_hum_to_noise(study, selection.experiments, lines)
    search = (
        search_effects(with_hum, *MIN_LLR_AND_SHARE_WITH_MOTION_ERROR)
        if position.has_position_error
        else search_effects(with_hum)
    )
    advance(SEARCH_COST)
    lines = lines_that_matter(lines, settings.tolerance_mN)
    inputs = decision_inputs(search, position, lines, settings.excluded)
    competition = prepare_competition(search, all_periods=poolable)
    present = judge_presence(competition)
    inputs = replace(inputs, competition=present.probabilities)
    calibration = _calibration_for(study, settings)
    judgement = judge(inputs, settings.tolerance_mN, calibration)
    causes = CausesOfGap(competition, present, judgement.presence)
    classified = perf_counter()
    advance(COMPETITION_COST)
    diagnosis = _assembled_diagnosis(
        selection, nominal, settings, study, search, position, lines, judgement, inputs, causes, hold_out=not poolable
    )
    advance(ASSEMBLY_COST)
    timings = {
        "reading and position": studied - start,
        "explaining": classified - studied,
        "telling": perf_counter() - classified,
    }
    return DiagnosisWithCauses(replace(diagnosis, timings_s=timings), causes, position, lines)


def _without_slow_lines(lines: SpectralLines) -> SpectralLines:
    """Drop lines that may be slow noise."""
    slow = lines.non_mains.frequency_hz <= SLOW_LINE_HZ and lines.non_mains.llr < MIN_SLOW_LINE_LLR
    return SpectralLines(lines.mains, replace(lines.non_mains, llr=0.0) if slow else lines.non_mains)


def _with_trusted_motion(selection: RunSelection, position: PositionAnalysis) -> RunSelection:
    """Take the command as the true motion where only the record of the position is wrong."""
    if not position.is_recording_error:
        return selection
    return replace(
        selection, experiments=tuple(replace(experiment, trusts_command=True) for experiment in selection.experiments)
    )


def _calibration_for(study: Study, options: DiagnosisOptions) -> VerdictCalibration:
    calibration = options.calibration or shipped_calibration()
    return calibration if isinstance(study, CapsuleStudy) else calibration.with_hand_set_weights


def _named_fit(search: ForceSearchResult, classification: Classification) -> HypothesisFit | None:
    """Return the fit with the named effects on the force."""
    on_force = {effect.id for effect in search.study.effects}
    fit = fit_together(search, [name for name in classification.effects if name in on_force])
    return None if fit is None else converged(search.study, fit, search.nominal)


def _assembled_diagnosis(
    selection: RunSelection,
    nominal: NominalModel,
    options: DiagnosisOptions,
    study: Study,
    search: ForceSearchResult,
    position: PositionAnalysis,
    lines: SpectralLines,
    judgement: Judgement,
    inputs: DecisionInputs,
    causes: CausesOfGap,
    *,
    hold_out: bool,
) -> Diagnosis:
    classification = judgement.verdict
    fit = _named_fit(search, classification)
    hum = lines.mains if hum_effect().id in classification.effects else replace(lines.mains, amplitude=0.0)
    line = lines.non_mains if unknown_because_of_line(inputs, classification) else None
    blocks = [*force_residual_blocks(study, search.nominal, options.tolerance_mN, line or hum)]
    blocks += position_residual_blocks(position.runs)
    where = localise(blocks, present=classification.verdict is not Verdict.NO_GAP)
    by_excess = unknown_by_excess_alone(inputs, classification, options.tolerance_mN, _calibration_for(study, options))
    reduction, traces = (
        _held_out_reduction(study, search, fit, position, classification) if hold_out or by_excess else (None, ())
    )
    if by_excess and _is_within_noise(where, reduction):
        classification = as_misjudged_noise(classification)
        where = localise(blocks, present=False)
    where = attribute_to_effects(where, blocks, _named_force(study, fit, hum))
    files = tuple(run.file for run in study.runs)
    budget = _budget(study, causes, classification, position, reduction, lines)
    if classification.effects:
        in_position = {model_class.effect for model_class in position.model_classes}
        unexplained_position = position.has_position_error and not in_position & set(classification.effects)
        left_over = unexplained_position or budget.leaves_more_than(RESIDUAL_SHARE, options.tolerance_mN)
        classification = replace(classification, residual_unknown=left_over)
    next_runs = Recommendation()
    if options.next_runs is not None:
        next_runs = recommend_next_run(study, search, position, classification, options.next_runs)
    return Diagnosis(
        specimen=selection.specimen,
        backends=selection.backends,
        nominal=nominal.name,
        runs=len(selection.experiments),
        used_for_fit=files,
        held_out=files if len(files) > 1 else (),
        left_out=selection.left_out,
        verdict=classification.verdict,
        effects=classification.effects,
        ranking=tuple(_ranked_hypotheses(search, position, lines, classification)),
        confusable_with=classification.confusable_with,
        residual_unknown=classification.residual_unknown,
        detection_limit_mN=detection_limit(study, search.nominal),
        tolerance_mN=options.tolerance_mN,
        where=where,
        shrink=reduction,
        unknown=describe_unexplained_gap(where, blocks, classification, line, inputs),
        model=amended_model(study, fit, position, lines, classification, search, reduction, selection),
        traces=traces,
        limitations=(*study.limitations(), *next_runs.limitations),
        remarks=selection.remarks,
        calibration=CALIBRATION_NOTE,
        decision_inputs=inputs,
        next_experiment=next_runs.experiment,
        budget=budget,
        open_causes=next_runs.open_causes,
    )


def _is_within_noise(where: GapLocation, reduction: GapReduction | None) -> bool:
    """Whether a gap is no larger than its own floor, and concentrated nowhere: noise that is a little misjudged."""
    small = reduction is not None and reduction.gap_before_mN <= MAX_GAP_OVER_FLOOR * reduction.noise_floor_mN
    return small and where.p >= ALPHA


def _budget(
    study: Study,
    causes: CausesOfGap,
    classification: Classification,
    position: PositionAnalysis,
    reduction: GapReduction | None,
    lines: SpectralLines,
) -> GapBudget:
    in_position = {model_class.effect for model_class in position.model_classes if position.has_position_error}
    probabilities = {name: classification.marginal(name) for name in in_position}
    hum_mN = float(np.sqrt(0.5)) * lines.mains.amplitude
    fitted = "" if position.candidate is None else position.candidate.effect.id
    share = None if reduction is None else share_of_position(position)
    budget = gap_budget(study, causes, classification, probabilities, fitted, share, {hum_effect().id: hum_mN})
    if any(entry.channel == "position" for entry in budget.entries):
        return replace(budget, runs=(*budget.runs, *_contributions_in_position(study, position)))
    return budget


def _contributions_in_position(study: Study, position: PositionAnalysis) -> Iterator[RunContributions]:
    """Yield the position error of each run, and what the effect on the position adds to it [µm]."""
    candidate, labels = position.candidate, {run.file: run.label for run in study.runs}
    if candidate is None:
        return
    for run in position.runs:
        experiment = run.experiment
        yield RunContributions(
            file=experiment.file,
            kind=experiment.kind,
            label=labels.get(experiment.file, experiment.file),
            channel="position",
            unit="µm",
            time_s=run.time_s,
            width_s=np.ones_like(run.time_s),
            position_mm=run.command_mm,
            gap=1e3 * run.error_mm,
            parts={candidate.effect.id: 1e3 * contribution_to_position(candidate, run)},
        )


def _named_force(study: Study, fit: HypothesisFit | None, hum: SpectralLine) -> list[FloatArray]:
    """Return the force of the named effects by block; of hum its rms."""
    if fit is not None:
        return [run.effect_force for run in fit.design.runs]
    return [np.full(run_data.coordinates.width_s.size, hum.amplitude / np.sqrt(2.0)) for run_data in study.runs]


def _held_out_reduction(
    study: Study,
    search: ForceSearchResult,
    fit: HypothesisFit | None,
    position: PositionAnalysis,
    classification: Classification,
) -> tuple[GapReduction | None, tuple[RunTraces, ...]]:
    held_out = predict_held_out(search, fit)
    if held_out is None:
        return None, ()
    design = search.nominal if fit is None else fit.design
    gaps: list[RunGap] = []
    for number, run in enumerate(study.runs):
        gaps.append(
            gap_of_run(
                run,
                study.problem.noises[number],
                search.nominal.runs[number].motion_sd,
                (held_out.before[number], search.nominal.runs[number].whitening),
                (held_out.after[number], design.runs[number].whitening),
                study.problem.zero_sds[number],
                study.informative_blocks(number, search.nominal.runs[number].motion_sd),
            )
        )
    reduction = reduction_over_runs(gaps)
    if position.candidate is not None and position.candidate.effect.id in classification.effects and fit is None:
        reduction = position_gap_reduction(position, reduction)
    return reduction, tuple(map(traces_of_run, gaps))


def _ranked_hypotheses(
    search: ForceSearchResult, position: PositionAnalysis, lines: SpectralLines, classification: Classification
) -> Iterator[RankedHypothesis]:
    fits = {"+".join(fit.effects): fit for fit in search.fits}
    names = (
        [ranked.effect for ranked in search.ranked]
        + [model_class.effect for model_class in position.model_classes]
        + [hum_effect().id, NO_GAP, UNKNOWN]
    )
    probabilities = {**dict.fromkeys(names, 0.0), **classification.probabilities}
    total = sum(probabilities.values())
    for name, probability in sorted(probabilities.items(), key=lambda pair: -pair[1]):
        fit = fits.get(name)
        yield RankedHypothesis(
            name,
            probability / total,
            hypothesis_parameters(name, fit, position, lines),
            None if fit is None else held_out_improvement(search, fit),
        )
