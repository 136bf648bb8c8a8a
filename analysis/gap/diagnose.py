"""A diagnosis from end to end: location of the gap, its cause, its size, and the amended model."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from time import perf_counter

import numpy as np

from dragrig.analysis import (
    NORMAL_95,
    EstimatedQuantity,
    NominalModel,
    Progress,
    RunSelection,
    no_progress,
    parts_of,
    single_blas_thread,
)
from dragrig.analysis.gap.budget import gap_budget
from dragrig.analysis.gap.design import Candidate, ColumnKind, Study, fit_columns
from dragrig.analysis.gap.diagnosis import (
    NO_GAP,
    UNKNOWN,
    Classification,
    Diagnosis,
    GapBudget,
    GapReduction,
    RankedHypothesis,
    RunContributions,
    Verdict,
    left_open,
)
from dragrig.analysis.gap.forward_selection import ForceSearchResult
from dragrig.analysis.gap.gap_reduction import held_out_improvement, share_of_position
from dragrig.analysis.gap.hypothesis_fit import HypothesisFit
from dragrig.analysis.gap.isolability import detection_limit
from dragrig.analysis.gap.localise import attribute_to_effects, localise
from dragrig.analysis.gap.next_run import Recommendation, recommend_next_run
from dragrig.analysis.gap.position_channel import PositionAnalysis, Yielding, contribution_to_position
from dragrig.analysis.gap.spectral_lines import SpectralLine, SpectralLines
from dragrig.analysis.gap.unknown_gap import describe_unexplained_gap
from dragrig.analysis.gap.weighing import DiagnosisOptions, WeighedCauses, weigh_causes
from dragrig.config import DiagnosisSummary, EffectSettings, ModelSettings
from dragrig.rig import FloatArray
from dragrig.sim_backend.effects import hum_effect


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


RESIDUAL_SHARE = 0.15
"""Unexplained share of the gap above which something is left beside named effects: forms leave less of most effects."""
CALIBRATION_NOTE = "calibrated on simulated campaigns"
WEIGHING_COST, TELLING_COST = 94, 6
"""Relative times of a diagnosis's parts."""


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
        Where the model predicts none of these runs, or a run lacks data that it needs.
    """
    weighing, telling = parts_of(progress, WEIGHING_COST, TELLING_COST)
    weighed = weigh_causes(selection, nominal, options, weighing)
    start = perf_counter()
    diagnosis = tell(weighed)
    telling(1, 1)
    return replace(diagnosis, timings_s={**weighed.timings_s, "telling": perf_counter() - start})


def tell(weighed: WeighedCauses) -> Diagnosis:
    """Tell all that follows from weighed causes."""
    study, search, position, lines = weighed.study, weighed.search, weighed.position, weighed.lines
    options, selection, fit, blocks = weighed.options, weighed.selection, weighed.fit, weighed.blocks
    classification = weighed.verdict
    reduction, traces = weighed.held_out
    where = localise(blocks, present=classification.verdict is not Verdict.NO_GAP and not weighed.bursts)
    where = attribute_to_effects(where, blocks, _named_force(study, fit, weighed.hum))
    files = tuple(run.file for run in study.runs)
    budget = _budget(weighed)
    unexplained_position = position.has_position_error and not weighed.in_position & set(classification.effects)
    residual_unknown = bool(classification.effects) and (
        unexplained_position or budget.leaves_more_than(RESIDUAL_SHARE, options.tolerance_mN)
    )
    next_runs = Recommendation()
    if options.next_runs is not None:
        next_runs = recommend_next_run(weighed, options.next_runs)
    diagnosis = Diagnosis(
        specimen=selection.specimen,
        backends=selection.backends,
        nominal=weighed.nominal.name,
        runs=len(selection.experiments),
        used_for_fit=files,
        held_out=() if reduction is None else files,
        left_out=selection.left_out,
        verdict=classification.verdict,
        effects=classification.effects,
        ranking=tuple(_ranked_hypotheses(search, position, lines, classification)),
        confusable_with=classification.confusable_with,
        residual_unknown=residual_unknown,
        detection_limit_mN=detection_limit(study, search.nominal),
        tolerance_mN=options.tolerance_mN,
        where=where,
        shrink=reduction,
        unknown=None
        if classification.verdict is not Verdict.UNKNOWN and not residual_unknown
        else describe_unexplained_gap(
            where,
            blocks,
            classification.verdict,
            weighed.unnamed_line,
            weighed.bursts,
            weighed.inputs,
            single_condition=bool(study.only_condition),
        ),
        model=amended_model(study, fit, position, lines, classification, search, reduction, selection),
        traces=traces,
        limitations=(*study.limitations(), *next_runs.limitations),
        remarks=(*selection.remarks, *_yielding_remarks(position.yielding)),
        calibration=CALIBRATION_NOTE,
        decision_inputs=weighed.inputs,
        next_experiment=next_runs.experiment,
        budget=budget,
        open_causes=next_runs.open_causes,
    )
    return left_open(diagnosis, study.only_condition) if study.only_condition else diagnosis


def _yielding_remarks(yielding: Yielding | None) -> Iterator[str]:
    if yielding is not None:
        force = yielding.channel.replace("_", " ")
        yield (
            f"the stage gives way to the {force} by up to {1e3 * yielding.most_mm:.2g} µm ({yielding.um_per_N:.2g} "
            "µm/N), as a position loop does; its motion is recorded: no gap"
        )


def _budget(weighed: WeighedCauses) -> GapBudget:
    study, position = weighed.study, weighed.position
    hum_mN = float(np.sqrt(0.5)) * weighed.lines.mains.amplitude
    fitted = "" if position.candidate is None else position.candidate.effect.id
    share = None if weighed.held_out[0] is None else share_of_position(position)
    budget = gap_budget(
        study, weighed.causes, weighed.verdict, weighed.in_position, fitted, share, {hum_effect().id: hum_mN}
    )
    if any(entry.channel == "position" for entry in budget.entries):
        return replace(budget, runs=(*budget.runs, *_contributions_in_position(study, position)))
    return budget


def _contributions_in_position(study: Study, position: PositionAnalysis) -> Iterator[RunContributions]:
    """Yield the position error of each run, and the effect's contribution to it [µm]."""
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
