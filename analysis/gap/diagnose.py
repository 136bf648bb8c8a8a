"""A diagnosis from end to end: location of the gap, its cause, its size, and the amended model."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np

from dragrig.analysis.computation import Progress, no_progress, single_blas_thread
from dragrig.analysis.estimates import NORMAL_95, EstimatedQuantity
from dragrig.analysis.gap.candidate_runs import ExperimentBudget
from dragrig.analysis.gap.candidates import Candidate
from dragrig.analysis.gap.classifier import (
    MIN_LLR_BESIDE_POSITION,
    NO_GAP,
    UNKNOWN,
    Classification,
    classify,
    mains_hum_present,
    unknown_because_of_line,
)
from dragrig.analysis.gap.design import ColumnKind, Study
from dragrig.analysis.gap.diagnosis import Diagnosis, GapReduction, RankedHypothesis, RunTraces, Verdict
from dragrig.analysis.gap.features import Calibration, DecisionInputs, HypothesisSummary, shipped_calibration
from dragrig.analysis.gap.forward_selection import ForceSearchResult, SelectionStep, search_effects
from dragrig.analysis.gap.gap_reduction import (
    RunGap,
    force_residual_blocks,
    gap_of_run,
    held_out_improvement,
    position_residual_blocks,
    predict_held_out,
    reduction_over_runs,
)
from dragrig.analysis.gap.hypothesis_fit import HypothesisFit, is_periodic_in_session
from dragrig.analysis.gap.isolability import DEFAULT_TOLERANCE_MN, detection_limit
from dragrig.analysis.gap.linear_fit import fit_columns
from dragrig.analysis.gap.localise import attribute_to_effects, localise
from dragrig.analysis.gap.next_run_position import reasons_for_no_run, recommend_next_run
from dragrig.analysis.gap.nonparametric import fit_nonparametric_laws
from dragrig.analysis.gap.position_channel import PositionAnalysis, analyse_position, position_gap_reduction
from dragrig.analysis.gap.spectral_lines import (
    SpectralLine,
    SpectralLines,
    correct_known_motion,
    find_spectral_lines,
    hum_effect,
    known_effects,
    lines_beyond_known,
)
from dragrig.analysis.gap.studies import CapsuleStudy, prepare_study
from dragrig.analysis.gap.unknown_gap import describe_unexplained_gap
from dragrig.analysis.inference.noise import estimate_noise
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.models.nominal_model import NominalModel
from dragrig.analysis.selection import RunSelection
from dragrig.config.friction_model import DiagnosisSummary, EffectSettings, FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import catalogue


def add_hum_to_noise(study: Study, experiments: Sequence[Experiment], lines: SpectralLines) -> Study:
    """Return a study whose noise has the hum of the mains where it was found: a line of a known frequency.

    Hum that is taken for white noise makes short blocks noisier than noise, and long ones less noisy.
    """
    if not mains_hum_present(lines.mains.llr, lines.other.llr):
        return study
    noise = estimate_noise(experiments, study.channel, lines.mains.amplitude, lines.mains.frequency_hz)
    noises = tuple(noise for _ in study.problem.noises)
    return replace(study, problem=replace(study.problem, noises=noises))


MAX_FURTHER_LAWS = 3
"""Laws without a name that are kept of those tried in the place of a further effect."""


def decision_inputs(
    search: ForceSearchResult, position: PositionAnalysis, lines: SpectralLines, excluded: tuple[str, ...]
) -> DecisionInputs:
    """Return what a verdict is made of; `excluded` are the effects that were not to be considered."""
    untold = search.study.untried_lookalikes
    tried = [
        replace(_single_summary(fit, search.chi2), untried_lookalikes=untold(fit.design)) for fit in search.singles
    ]
    joint = [(step, step.fit) for step in search.steps if step.fit is not None]
    tried += [replace(_joint_summary(*pair), untried_lookalikes=untold(pair[1].design)) for pair in joint]
    return DecisionInputs(
        block_count=search.block_count,
        chi2=search.chi2,
        hypotheses=tuple(tried),
        mains_llr=lines.mains.llr,
        line_llr=lines.other.llr,
        position=tuple((model_class.effect, model_class.held_out_share) for model_class in position.model_classes)
        if position.has_position_error
        else (),
        has_position_error=position.has_position_error,
        excluded=excluded,
        laws=fit_nonparametric_laws(search.nominal, search.study.runs, _swing_period_s(search.singles)),
    )


def _swing_period_s(singles: Sequence[HypothesisFit]) -> float:
    """Return the period of what swings on the session's clock; 0 where nothing does."""
    swinging = (
        candidate
        for fit in singles
        for candidate in fit.parameters.candidates
        if is_periodic_in_session(candidate.effect)
    )
    return next((candidate.values[candidate.effect.period_parameter] for candidate in swinging), 0.0)


def _single_summary(fit: HypothesisFit, squares: float) -> HypothesisSummary:
    gain = 0.5 * (squares - (fit.chi2_with_form_error if _has_periodic_effect(fit) else fit.chi2))
    return replace(_summary_of_fit(fit), llr=gain, chi2_without=squares)


def _joint_summary(step: SelectionStep, fit: HypothesisFit) -> HypothesisSummary:
    return replace(
        _summary_of_fit(fit),
        llr=step.llr,
        chi2_without=step.chi2_without,
        rival_llr=step.rival_llr,
        laws=step.laws[:MAX_FURTHER_LAWS],
    )


def _summary_of_fit(fit: HypothesisFit) -> HypothesisSummary:
    return HypothesisSummary(
        effects=fit.effects,
        chi2=fit.chi2,
        chi2_with_form_error=fit.chi2_with_form_error,
        change_mN=fit.change_mN,
        periodic=_has_periodic_effect(fit),
        excess_elsewhere=fit.excess_elsewhere,
        at_limit=any(candidate.at_limit for candidate in fit.parameters.candidates),
    )


def _has_periodic_effect(fit: HypothesisFit) -> bool:
    return any(is_periodic_in_session(candidate.effect) for candidate in fit.parameters.candidates)


def hypothesis_parameters(
    name: str, fit: HypothesisFit | None, position: PositionAnalysis, lines: SpectralLines
) -> tuple[EstimatedQuantity, ...]:
    """Return the parameters of a hypothesis with their errors; none for what has none."""
    quantities: list[EstimatedQuantity] = []
    if fit is not None:
        solution = fit_columns(
            fit.design, fit.design.total_gram(), ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT
        )
        errors = np.sqrt(np.maximum(np.diag(solution.covariance), 0.0))
        own = errors[np.searchsorted(solution.columns, fit.design.columns_of(ColumnKind.EFFECT))].tolist()
        several = len(fit.parameters.candidates) > 1
        for candidate in fit.parameters.candidates:
            mine, own = own[: len(candidate.fitted_parameters)], own[len(candidate.fitted_parameters) :]
            quantities += _quantities(candidate, mine, several)
    moved = position.candidate
    if moved is not None and moved.effect.id in name.split("+"):
        quantities += _quantities(moved, position.standard_errors, "+" in name)
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
    return {hum.size.name: line.amplitude, hum.period_parameter: line.frequency_hz}


def _quantities(candidate: Candidate, errors: Sequence[float], several: bool) -> Iterator[EstimatedQuantity]:
    for parameter, error in zip(candidate.fitted_parameters, errors, strict=True):
        name = f"{candidate.effect.id}.{parameter.name}" if several else parameter.name
        yield _quantity(name, parameter.unit, candidate.values[parameter.name], error)


def _quantity(name: str, unit: str, value: float, error: float) -> EstimatedQuantity:
    half = NORMAL_95 * error
    return EstimatedQuantity(name, unit, value, error, (value - half, value + half))


def traces_of_runs(gaps: Sequence[RunGap]) -> tuple[RunTraces, ...]:
    """Return each run as it was measured and as both models have it."""
    return tuple(_traces_of_run(gap) for gap in gaps)


def _traces_of_run(gap: RunGap) -> RunTraces:
    run, at = gap.run, gap.run.coordinates
    kind, value = run.condition
    measured = run.block_data.blocks.mean
    label = f"{value:g} × strain" if kind == "relaxation" else f"{value:g} mm/s"
    return RunTraces(
        file=run.file,
        kind=kind,
        label=label,
        channel=run.block_data.channel,
        unit="mN",
        time_s=at.time_s,
        position_mm=at.position_mm,
        measured=measured,
        before=measured - gap.before,
        after=measured - gap.after,
    )


PARAMETER_DIGITS = 6


def amended_model(
    study: Study,
    chosen: HypothesisFit | None,
    position: PositionAnalysis,
    lines: SpectralLines,
    classification: Classification,
    search: ForceSearchResult,
    shrink: GapReduction | None,
    specimen: str,
) -> FrictionModelSettings | None:
    """Return this specimen's friction model with the effects that were named; None where none was or can be."""
    if not classification.effects:
        return None
    z = search.nominal.z if chosen is None else chosen.parameters.z
    settings = study.amended_settings(z)
    if settings is None:
        return None
    effects = list(settings.effects)
    if chosen is not None:
        effects += [candidate.settings for candidate in chosen.parameters.candidates]
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
    diagnosed = DiagnosisSummary(
        specimen=specimen,
        verdict=classification.verdict.value,
        effects=classification.effects,
        probability=_rounded_value(classification.probabilities.get("+".join(classification.effects), 0.0)),
        runs=len(study.runs),
        promised=None if shrink is None or shrink.closed is None else _rounded_value(shrink.closed),
        nominal=_rounded_values(study, search.nominal.z),
    )
    return settings.model_copy(
        update={
            **_rounded_values(study, z),
            "name": "amended",
            "effects": tuple(rounded),
            "diagnosed": diagnosed,
            "identified": None,
        }
    )


def _rounded_values(study: Study, z: FloatArray) -> dict[str, float]:
    return {name: _rounded_value(value) for name, value in study.values(z).items()}


def _rounded_value(value: float) -> float:
    return float(np.format_float_scientific(value, precision=PARAMETER_DIGITS)) if value else 0.0


SLOW_LINE_HZ, MIN_SLOW_LINE_LLR = 4.9, 300.0
"""Slow noise passes for lines below this frequency, with gains below that: 38 at most in 500 simulated campaigns."""
CALIBRATION_NOTE = "calibrated on simulated campaigns"
DIAGNOSIS_STEPS = 6
MIN_LLR_AND_SHARE_WITH_MOTION_ERROR = 0.5 * MIN_LLR_BESIDE_POSITION, 0.3
"""Where the stage strays, what its motion leaves uncertain is no effect unless one takes away so many half squares
beforehand, and this share of it."""


@dataclass(frozen=True, slots=True)
class DiagnosisOptions:
    """What a diagnosis is asked for.

    Attributes
    ----------
    excluded
        Effects that are not to be considered.
    tolerance_mN
        What an effect must add, root mean square where it acts, to matter.
    next_runs
        What the next runs that are recommended may take; one run of a dozen unless given.
    calibration
        Thresholds and weights of the verdict; the shipped ones unless given.
    """

    excluded: tuple[str, ...] = ()
    tolerance_mN: float = DEFAULT_TOLERANCE_MN
    next_runs: ExperimentBudget = field(default_factory=ExperimentBudget)
    calibration: Calibration | None = None


@single_blas_thread()
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
        Where the model predicts nothing of these runs, or a run lacks what it needs.
    """
    asked = options or DiagnosisOptions()
    began = perf_counter()
    progress(0, DIAGNOSIS_STEPS)
    effects = [effect for effect in catalogue().values() if effect.id not in asked.excluded]
    known = known_effects(nominal)
    selection = correct_known_motion(selection, known)
    position = analyse_position(selection.experiments, effects)
    progress(1, DIAGNOSIS_STEPS)
    study = prepare_study(
        _with_trusted_motion(selection, position), nominal, [effect for effect in effects if effect.has_force_signature]
    )
    lines = lines_beyond_known(_without_slow_lines(find_spectral_lines(selection.experiments, study.channel)), known)
    prepared = perf_counter()
    heard = add_hum_to_noise(study, selection.experiments, lines)
    search = (
        search_effects(heard, *MIN_LLR_AND_SHARE_WITH_MOTION_ERROR)
        if position.has_position_error
        else search_effects(heard)
    )
    progress(4, DIAGNOSIS_STEPS)
    evidence = decision_inputs(search, position, lines, asked.excluded)
    classification = classify(evidence, asked.tolerance_mN, _calibration_for(study, asked))
    explained = perf_counter()
    diagnosis = _assembled_diagnosis(
        selection, nominal, asked, study, search, position, lines, classification, evidence
    )
    progress(DIAGNOSIS_STEPS, DIAGNOSIS_STEPS)
    timings = {
        "reading and position": prepared - began,
        "explaining": explained - prepared,
        "telling": perf_counter() - explained,
    }
    return replace(diagnosis, timings_s=timings)


def _without_slow_lines(lines: SpectralLines) -> SpectralLines:
    """Leave out what may be slow noise."""
    slow = lines.other.frequency_hz <= SLOW_LINE_HZ and lines.other.llr < MIN_SLOW_LINE_LLR
    return SpectralLines(lines.mains, replace(lines.other, llr=0.0) if slow else lines.other)


def _with_trusted_motion(selection: RunSelection, position: PositionAnalysis) -> RunSelection:
    """Let the motion be the command's where only the record of the position is wrong."""
    if not position.is_recording_error:
        return selection
    return replace(
        selection, experiments=tuple(replace(experiment, trusts_command=True) for experiment in selection.experiments)
    )


def _calibration_for(study: Study, options: DiagnosisOptions) -> Calibration:
    weights = options.calibration or shipped_calibration()
    return weights if isinstance(study, CapsuleStudy) else weights.with_hand_set_weights


def _named_fit(search: ForceSearchResult, classification: Classification) -> HypothesisFit | None:
    """Return the explanation that has the effects of the force that were named."""
    named = {name for name in classification.effects if name != hum_effect().id}
    tried = [*search.singles, *(step.fit for step in search.steps if step.fit is not None)]
    fitting = [fit for fit in tried if set(fit.effects) <= named]
    return max(fitting, key=lambda fit: len(fit.effects), default=None)


def _assembled_diagnosis(
    selection: RunSelection,
    nominal: NominalModel,
    options: DiagnosisOptions,
    study: Study,
    search: ForceSearchResult,
    position: PositionAnalysis,
    lines: SpectralLines,
    classification: Classification,
    evidence: DecisionInputs,
) -> Diagnosis:
    chosen = _named_fit(search, classification)
    hum = lines.mains if hum_effect().id in classification.effects else replace(lines.mains, amplitude=0.0)
    swing = lines.other if unknown_because_of_line(evidence, classification) else None
    blocks = [*force_residual_blocks(study, search.nominal, options.tolerance_mN, swing or hum)]
    blocks += position_residual_blocks(position.runs)
    where = localise(blocks, present=classification.verdict is not Verdict.NO_GAP)
    where = attribute_to_effects(where, blocks, _named_force(study, chosen, hum))
    shrink, views = _held_out_reduction(study, search, chosen, position, classification)
    files = tuple(run.file for run in study.runs)
    of_force = classify(
        replace(evidence, position=(), has_position_error=False), options.tolerance_mN, _calibration_for(study, options)
    )
    next_run = recommend_next_run(study, search, position, classification, of_force, options.next_runs)
    return Diagnosis(
        specimen=selection.specimen,
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
        shrink=shrink,
        unknown=describe_unexplained_gap(where, blocks, classification, swing, evidence),
        model=amended_model(study, chosen, position, lines, classification, search, shrink, selection.specimen),
        traces=views,
        limitations=(*study.limitations(), *reasons_for_no_run(study, position, classification, next_run)),
        remarks=selection.remarks,
        calibration=CALIBRATION_NOTE,
        decision_inputs=evidence,
        next_experiment=next_run,
    )


def _named_force(study: Study, chosen: HypothesisFit | None, hum: SpectralLine) -> list[FloatArray]:
    """Return what the named effects add to the force, block by block, of hum its root mean square."""
    if chosen is not None:
        return [run.effect_force for run in chosen.design.runs]
    return [np.full(run_data.coordinates.width_s.size, hum.amplitude / np.sqrt(2.0)) for run_data in study.runs]


def _held_out_reduction(
    study: Study,
    search: ForceSearchResult,
    chosen: HypothesisFit | None,
    position: PositionAnalysis,
    classification: Classification,
) -> tuple[GapReduction | None, tuple[RunTraces, ...]]:
    left = predict_held_out(search, chosen)
    if left is None:
        return None, ()
    design = search.nominal if chosen is None else chosen.design
    gaps: list[RunGap] = []
    for number, run in enumerate(study.runs):
        gaps.append(
            gap_of_run(
                run,
                study.problem.noises[number],
                search.nominal.runs[number].motion_sd,
                (left.before[number], search.nominal.runs[number].whitening),
                (left.after[number], design.runs[number].whitening),
                study.problem.zero_sds[number],
                study.informative_blocks(number, search.nominal.runs[number].motion_sd),
            )
        )
    shrink = reduction_over_runs(gaps)
    if position.candidate is not None and position.candidate.effect.id in classification.effects and chosen is None:
        shrink = position_gap_reduction(position, shrink)
    return shrink, traces_of_runs(gaps)


def _ranked_hypotheses(
    search: ForceSearchResult, position: PositionAnalysis, lines: SpectralLines, classification: Classification
) -> Iterator[RankedHypothesis]:
    explained = {"+".join(fit.effects): fit for fit in search.singles}
    explained |= {"+".join(step.fit.effects): step.fit for step in search.steps if step.fit is not None}
    known = (
        [ranked.effect for ranked in search.ranked]
        + [model_class.effect for model_class in position.model_classes]
        + [hum_effect().id, NO_GAP, UNKNOWN]
    )
    whole = {**dict.fromkeys(known, 0.0), **classification.probabilities}
    sums = sum(whole.values())
    for name, probability in sorted(whole.items(), key=lambda pair: -pair[1]):
        fit = explained.get(name)
        yield RankedHypothesis(
            name,
            probability / sums,
            hypothesis_parameters(name, fit, position, lines),
            None if fit is None else held_out_improvement(search, fit),
        )
