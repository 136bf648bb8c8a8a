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
    MAINS_HUM,
    SpectralLine,
    SpectralLines,
    correct_known_motion,
    find_spectral_lines,
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
from dragrig.sim_backend.effects.base import Effect, ForceEffect, SensorEffect, catalogue


def add_hum_to_noise(study: Study, experiments: Sequence[Experiment], lines: SpectralLines) -> Study:
    """Return a study whose noise has the hum of the mains where it was found: a line of a known frequency.

    Hum that is taken for white noise makes short blocks noisier than noise, and long ones less noisy.
    """
    if not mains_hum_present(lines.mains.gain, lines.other.gain):
        return study
    noise = estimate_noise(experiments, study.channel, lines.mains.amplitude, lines.mains.frequency_hz)
    noises = tuple(noise for _ in study.problem.noises)
    return replace(study, problem=replace(study.problem, noises=noises))


MAX_FURTHER_LAWS = 3
"""Laws without a name that are kept of those tried in the place of a further effect."""


def decision_inputs(
    found: ForceSearchResult, position: PositionAnalysis, lines: SpectralLines, without: tuple[str, ...]
) -> DecisionInputs:
    """Return what a verdict is made of; `without` are the effects that were not to be considered."""
    untold = found.study.untold
    tried = [replace(_single_summary(one, found.squares), untold=untold(one.design)) for one in found.singles]
    joint = [(one, one.together) for one in found.steps if one.together is not None]
    tried += [replace(_joint_summary(*one), untold=untold(one[1].design)) for one in joint]
    return DecisionInputs(
        blocks=found.blocks,
        squares=found.squares,
        tried=tuple(tried),
        mains_gain=lines.mains.gain,
        line_gain=lines.other.gain,
        position=tuple((one.effect, one.held_out) for one in position.families) if position.present else (),
        strays=position.present,
        without=without,
        nameless=fit_nonparametric_laws(found.nominal, found.study.sights, _swing_period_s(found.singles)),
    )


def _swing_period_s(singles: Sequence[HypothesisFit]) -> float:
    """Return the period of what swings on the session's clock; 0 where nothing does."""
    swinging = (each for one in singles for each in one.point.candidates if is_periodic_in_session(each.effect))
    return next((value for each in swinging for name, value in each.values.items() if name.startswith("period")), 0.0)


def _single_summary(one: HypothesisFit, squares: float) -> HypothesisSummary:
    gain = 0.5 * (squares - (one.flexible if _has_periodic_effect(one) else one.plain))
    return replace(_summary_of_fit(one), gain=gain, left=squares)


def _joint_summary(step: SelectionStep, one: HypothesisFit) -> HypothesisSummary:
    return replace(
        _summary_of_fit(one),
        gain=step.gain,
        left=step.left,
        rival_gain=step.rival_gain,
        laws=step.laws[:MAX_FURTHER_LAWS],
    )


def _summary_of_fit(one: HypothesisFit) -> HypothesisSummary:
    return HypothesisSummary(
        effects=one.effects,
        plain=one.plain,
        flexible=one.flexible,
        changed_mN=one.changed_mN,
        periodic=_has_periodic_effect(one),
        elsewhere=one.elsewhere,
        at_limit=any(each.at_limit for each in one.point.candidates),
    )


def _has_periodic_effect(one: HypothesisFit) -> bool:
    return any(is_periodic_in_session(each.effect) for each in one.point.candidates)


def hypothesis_parameters(
    name: str, one: HypothesisFit | None, position: PositionAnalysis, lines: SpectralLines
) -> tuple[EstimatedQuantity, ...]:
    """Return the parameters of a hypothesis with their errors; none for what has none."""
    found: list[EstimatedQuantity] = []
    if one is not None:
        solution = fit_columns(one.design, one.design.total(), ColumnKind.NOMINAL, ColumnKind.DETAIL, ColumnKind.EFFECT)
        errors = np.sqrt(np.maximum(np.diag(solution.covariance), 0.0))
        own = errors[np.searchsorted(solution.columns, one.design.of(ColumnKind.EFFECT))].tolist()
        several = len(one.point.candidates) > 1
        for candidate in one.point.candidates:
            mine, own = own[: len(candidate.fitted)], own[len(candidate.fitted) :]
            found += _quantities(candidate, mine, several)
    moved = position.candidate
    if moved is not None and moved.effect.id in name.split("+"):
        found += _quantities(moved, position.standard_errors, "+" in name)
    if name == "mains_hum":
        found.append(_quantity("amplitude_mN", "mN", lines.mains.amplitude, 0.5 * lines.mains.amplitude**0.5))
        found.append(_quantity("frequency_hz", "Hz", lines.mains.frequency_hz, 0.5))
    return tuple(found)


def _quantities(candidate: Candidate, errors: Sequence[float], several: bool) -> Iterator[EstimatedQuantity]:
    for one, error in zip(candidate.fitted, errors, strict=True):
        name = f"{candidate.effect.id}.{one.name}" if several else one.name
        yield _quantity(name, one.unit, candidate.values[one.name], error)


def _quantity(name: str, unit: str, value: float, error: float) -> EstimatedQuantity:
    half = NORMAL_95 * error
    return EstimatedQuantity(name, unit, value, error, (value - half, value + half))


def traces_of_runs(gaps: Sequence[RunGap]) -> tuple[RunTraces, ...]:
    """Return each run as it was measured and as both models have it."""
    return tuple(_traces_of_run(one) for one in gaps)


def _traces_of_run(one: RunGap) -> RunTraces:
    sight, at = one.sight, one.sight.coordinates
    kind, value = sight.condition
    measured = sight.evidence.blocks.mean
    label = f"{value:g} × strain" if kind == "relaxation" else f"{value:g} mm/s"
    return RunTraces(
        file=sight.file,
        kind=kind,
        label=label,
        channel=sight.evidence.channel,
        unit="mN",
        time_s=at.time_s,
        position_mm=at.position_mm,
        measured=measured,
        before=measured - one.before,
        after=measured - one.after,
    )


HUM_EFFECT = "mains_hum"
PARAMETER_DIGITS = 6


def amended_model(
    study: Study,
    chosen: HypothesisFit | None,
    position: PositionAnalysis,
    lines: SpectralLines,
    judged: Classification,
    found: ForceSearchResult,
    shrink: GapReduction | None,
    specimen: str,
) -> FrictionModelSettings | None:
    """Return this specimen's friction model with the effects that were named; None where none was or can be."""
    if not judged.effects:
        return None
    z = found.nominal.z if chosen is None else chosen.point.z
    settings = study.simulator(z)
    if settings is None:
        return None
    effects = list(settings.effects)
    if chosen is not None:
        effects += [one.settings for one in chosen.point.candidates]
    if position.candidate is not None and position.candidate.effect.id in judged.effects:
        effects.append(position.candidate.settings)
    if HUM_EFFECT in judged.effects:
        hum = {"amplitude_mN": lines.mains.amplitude, "frequency_hz": lines.mains.frequency_hz}
        effects.append(EffectSettings(id=HUM_EFFECT, parameters=hum))
    rounded = [
        EffectSettings(id=one.id, parameters={name: _rounded_value(value) for name, value in one.parameters.items()})
        for one in effects
    ]
    diagnosed = DiagnosisSummary(
        specimen=specimen,
        verdict=judged.verdict.value,
        effects=judged.effects,
        probability=_rounded_value(judged.probabilities.get("+".join(judged.effects), 0.0)),
        runs=len(study.sights),
        promised=None if shrink is None or shrink.closed is None else _rounded_value(shrink.closed),
        nominal=_rounded_values(study, found.nominal.z),
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
    without
        Effects that are not to be considered.
    tolerance_mN
        What an effect must add, root mean square where it acts, to matter.
    next_runs
        What the next runs that are recommended may take; one run of a dozen unless given.
    calibration
        Thresholds and weights of the verdict; the shipped ones unless given.
    """

    without: tuple[str, ...] = ()
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
    effects = [one for one in catalogue().values() if one.id not in asked.without]
    known = known_effects(nominal)
    selection = correct_known_motion(selection, known)
    position = analyse_position(selection.experiments, effects)
    progress(1, DIAGNOSIS_STEPS)
    study = prepare_study(
        _with_trusted_motion(selection, position), nominal, [one for one in effects if _acts_on_force(one)]
    )
    lines = lines_beyond_known(_without_slow_lines(find_spectral_lines(selection.experiments, study.channel)), known)
    prepared = perf_counter()
    heard = add_hum_to_noise(study, selection.experiments, lines)
    found = search_effects(heard, *MIN_LLR_AND_SHARE_WITH_MOTION_ERROR) if position.present else search_effects(heard)
    progress(4, DIAGNOSIS_STEPS)
    evidence = decision_inputs(found, position, lines, asked.without)
    judged = classify(evidence, asked.tolerance_mN, _calibration_for(study, asked))
    explained = perf_counter()
    diagnosis = _assembled_diagnosis(selection, nominal, asked, study, found, position, lines, judged, evidence)
    progress(DIAGNOSIS_STEPS, DIAGNOSIS_STEPS)
    timings = {
        "reading and position": prepared - began,
        "explaining": explained - prepared,
        "telling": perf_counter() - explained,
    }
    return replace(diagnosis, timings_s=timings)


def _acts_on_force(effect: Effect) -> bool:
    return isinstance(effect, ForceEffect | SensorEffect) and effect.id != MAINS_HUM


def _without_slow_lines(lines: SpectralLines) -> SpectralLines:
    """Leave out what may be slow noise."""
    slow = lines.other.frequency_hz <= SLOW_LINE_HZ and lines.other.gain < MIN_SLOW_LINE_LLR
    return SpectralLines(lines.mains, replace(lines.other, gain=0.0) if slow else lines.other)


def _with_trusted_motion(selection: RunSelection, position: PositionAnalysis) -> RunSelection:
    """Let the motion be the command's where only the record of the position is wrong."""
    if not position.recorded_wrongly:
        return selection
    return replace(selection, experiments=tuple(replace(one, trusts_command=True) for one in selection.experiments))


def _calibration_for(study: Study, asked: DiagnosisOptions) -> Calibration:
    weights = asked.calibration or shipped_calibration()
    return weights if isinstance(study, CapsuleStudy) else weights.of_any_rig


def _named_fit(found: ForceSearchResult, judged: Classification) -> HypothesisFit | None:
    """Return the explanation that has the effects of the force that were named."""
    named = {name for name in judged.effects if name != MAINS_HUM}
    tried = [*found.singles, *(one.together for one in found.steps if one.together is not None)]
    fitting = [one for one in tried if set(one.effects) <= named]
    return max(fitting, key=lambda one: len(one.effects), default=None)


def _assembled_diagnosis(
    selection: RunSelection,
    nominal: NominalModel,
    asked: DiagnosisOptions,
    study: Study,
    found: ForceSearchResult,
    position: PositionAnalysis,
    lines: SpectralLines,
    judged: Classification,
    evidence: DecisionInputs,
) -> Diagnosis:
    chosen = _named_fit(found, judged)
    hum = lines.mains if MAINS_HUM in judged.effects else replace(lines.mains, amplitude=0.0)
    swing = lines.other if unknown_because_of_line(evidence, judged) else None
    blocks = [*force_residual_blocks(study, found.nominal, asked.tolerance_mN, swing or hum)]
    blocks += position_residual_blocks(position.runs)
    where = localise(blocks, present=judged.verdict is not Verdict.NO_GAP)
    where = attribute_to_effects(where, blocks, _named_force(study, chosen, hum))
    shrink, views = _held_out_reduction(study, found, chosen, position, judged)
    files = tuple(one.file for one in study.sights)
    of_force = classify(
        replace(evidence, position=(), strays=False), asked.tolerance_mN, _calibration_for(study, asked)
    )
    next_run = recommend_next_run(study, found, position, judged, of_force, asked.next_runs)
    return Diagnosis(
        specimen=selection.specimen,
        nominal=nominal.name,
        runs=len(selection.experiments),
        used_for_fit=files,
        held_out=files if len(files) > 1 else (),
        left_out=selection.left_out,
        verdict=judged.verdict,
        effects=judged.effects,
        ranking=tuple(_ranked_hypotheses(found, position, lines, judged)),
        confusable_with=judged.confusable_with,
        residual_unknown=judged.residual_unknown,
        would_have_seen_mN=detection_limit(study, found.nominal),
        tolerance_mN=asked.tolerance_mN,
        where=where,
        shrink=shrink,
        unknown=describe_unexplained_gap(where, blocks, judged, swing, evidence),
        model=amended_model(study, chosen, position, lines, judged, found, shrink, selection.specimen),
        views=views,
        cannot_answer=(*study.open_questions(), *reasons_for_no_run(study, position, judged, next_run)),
        remarks=selection.remarks,
        calibration=CALIBRATION_NOTE,
        evidence=evidence,
        next_experiment=next_run,
    )


def _named_force(study: Study, chosen: HypothesisFit | None, hum: SpectralLine) -> list[FloatArray]:
    """Return what the named effects add to the force, block by block, of hum its root mean square."""
    if chosen is not None:
        return [part.added for part in chosen.design.parts]
    return [np.full(one.coordinates.width_s.size, hum.amplitude / np.sqrt(2.0)) for one in study.sights]


def _held_out_reduction(
    study: Study,
    found: ForceSearchResult,
    chosen: HypothesisFit | None,
    position: PositionAnalysis,
    judged: Classification,
) -> tuple[GapReduction | None, tuple[RunTraces, ...]]:
    left = predict_held_out(found, chosen)
    if left is None:
        return None, ()
    design = found.nominal if chosen is None else chosen.design
    gaps: list[RunGap] = []
    for number, sight in enumerate(study.sights):
        gaps.append(
            gap_of_run(
                sight,
                study.problem.noises[number],
                found.nominal.parts[number].motion_sd,
                (left.before[number], found.nominal.parts[number].whitening),
                (left.after[number], design.parts[number].whitening),
                study.problem.zero_sds[number],
                study.counted(number, found.nominal.parts[number].motion_sd),
            )
        )
    shrink = reduction_over_runs(gaps)
    if position.candidate is not None and position.candidate.effect.id in judged.effects and chosen is None:
        shrink = position_gap_reduction(position, shrink)
    return shrink, traces_of_runs(gaps)


def _ranked_hypotheses(
    found: ForceSearchResult, position: PositionAnalysis, lines: SpectralLines, judged: Classification
) -> Iterator[RankedHypothesis]:
    explained = {"+".join(one.effects): one for one in found.singles}
    explained |= {"+".join(one.together.effects): one.together for one in found.steps if one.together is not None}
    known = (
        [one.effect for one in found.ranked] + [one.effect for one in position.families] + [MAINS_HUM, NO_GAP, UNKNOWN]
    )
    whole = {**dict.fromkeys(known, 0.0), **judged.probabilities}
    sums = sum(whole.values())
    for name, probability in sorted(whole.items(), key=lambda pair: -pair[1]):
        one = explained.get(name)
        yield RankedHypothesis(
            name,
            probability / sums,
            hypothesis_parameters(name, one, position, lines),
            None if one is None else held_out_improvement(found, one),
        )
