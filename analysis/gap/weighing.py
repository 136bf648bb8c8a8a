"""What causes the gap of one campaign, weighed: all that a verdict stands on, before anything is told of it.

A diagnosis tells all of it; campaigns that are pooled hand on their causes alone. What only some of these need is made
when it is first asked for.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from time import perf_counter

import numpy as np

from dragrig.analysis import (
    Experiment,
    ForceBurst,
    MovingLine,
    NominalModel,
    Progress,
    RunSelection,
    counted,
    estimate_noise,
    force_bursts,
    no_progress,
    repeat_differences,
    single_blas_thread,
)
from dragrig.analysis.gap.budget import CausesOfGap, presence_of_effects
from dragrig.analysis.gap.candidate_runs import ExperimentBudget
from dragrig.analysis.gap.classifier import (
    Judgement,
    judge,
    mains_hum_present,
    unknown_because_of_line,
    unknown_by_excess_alone,
    with_verdict,
)
from dragrig.analysis.gap.design import Study
from dragrig.analysis.gap.diagnosis import ALPHA, Classification, GapReduction, RunTraces, Verdict
from dragrig.analysis.gap.excess import ResidualBlocks
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
    force_residual_blocks,
    gap_of_run,
    position_gap_reduction,
    position_residual_blocks,
    predict_held_out,
    reduction_over_runs,
    traces_of_run,
)
from dragrig.analysis.gap.hypothesis_fit import HypothesisFit, converged
from dragrig.analysis.gap.isolability import DEFAULT_TOLERANCE_MN
from dragrig.analysis.gap.localise import localise
from dragrig.analysis.gap.position_channel import PositionAnalysis, analyse_position
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
from dragrig.sim_backend.effects import catalogue, hum_effect


def _with_hum(study: Study, experiments: Sequence[Experiment], lines: SpectralLines) -> Study:
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


def _with_moving_line(study: Study, line: MovingLine | None) -> Study:
    """Return a study whose blocks know of a line that motion adds."""
    if line is None:
        return study
    channels = tuple(replace(blocks, moving_line=line) for blocks in study.problem.channels)
    return replace(study, problem=replace(study.problem, channels=channels))


MAX_FURTHER_LAWS = 3
"""Number of nonparametric laws that are stored in place of a further effect."""


def _decision_inputs(
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
            hypotheses.append(_summary(step.fit, study, step.llr, step.chi2_without, laws))
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
    fit: HypothesisFit, study: Study, llr: float, chi2_without: float, laws: tuple[NonparametricLaw, ...] = ()
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


SLOW_LINE_HZ, MIN_SLOW_LINE_LLR = 4.9, 300.0
"""Slow noise resembles lines below this frequency with smaller log likelihood ratios: at most 38 in 500 simulated
campaigns."""
MIN_BURSTS = 4
"""Chance makes none in a campaign; a door that slams, or a hand on the table, makes one or two."""
MAX_GAP_OVER_FLOOR = 1.05
"""A gap up to this multiple of its floor equals it."""
PREPARING_COST, SEARCH_COST, COMPETITION_COST = 26, 34, 34
"""Relative times of its parts."""
MIN_LLR_AND_SHARE_WITH_MOTION_ERROR = 30.0, 0.3
"""Where the stage has position errors, motion errors mimic small force effects: thresholds of Δχ²/2 and of the share of
the excess for an effect to be fitted."""


def equals_noise(gap_mN: float, floor_mN: float, place_p: float) -> bool:
    """Whether a gap is no larger than its own floor, and concentrated nowhere, by the p-value of its place."""
    return gap_mN <= MAX_GAP_OVER_FLOOR * floor_mN and place_p >= ALPHA


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


@dataclass(frozen=True, eq=False)
class WeighedCauses:
    """The causes that may act in one campaign, and how likely each is."""

    selection: RunSelection
    """Its runs, their known motion corrected."""
    nominal: NominalModel
    options: DiagnosisOptions
    study: Study
    """The runs as the nominal model predicts them; hum is no part of the noise."""
    search: ForceSearchResult
    """Effects on the force that were fitted."""
    position: PositionAnalysis
    """What competes for the errors of the position."""
    lines: SpectralLines
    """Strongest spectral lines of the rests, none below the tolerance."""
    faint_lines: SpectralLines
    """Strongest lines of any size."""
    inputs: DecisionInputs
    """What the judgement is made of."""
    judgement: Judgement
    """Verdict and presence by classifier and competition."""
    causes: CausesOfGap
    """What competes for the gap in the force."""
    timings_s: Mapping[str, float]
    """Time of each part so far."""

    @cached_property
    def fit(self) -> HypothesisFit | None:
        """Fit with the effects on the force that the judgement names; None without any."""
        on_force = {effect.id for effect in self.study.effects}
        fit = fit_together(self.search, [name for name in self.judgement.verdict.effects if name in on_force])
        return None if fit is None else converged(self.study, fit, self.search.nominal)

    @property
    def hum(self) -> SpectralLine:
        """The hum that the judgement names, of amplitude 0 for none."""
        named = hum_effect().id in self.judgement.verdict.effects
        return self.lines.mains if named else replace(self.lines.mains, amplitude=0.0)

    @property
    def unnamed_line(self) -> SpectralLine | None:
        """The line without a name for which the verdict is unknown; None for none."""
        return self.lines.non_mains if unknown_because_of_line(self.inputs, self.judgement.verdict) else None

    @cached_property
    def blocks(self) -> Sequence[ResidualBlocks]:
        """Deviations from the nominal model in force and position."""
        force = force_residual_blocks(
            self.study, self.search.nominal, self.options.tolerance_mN, self.unnamed_line or self.hum
        )
        return (*force, *position_residual_blocks(self.position.runs))

    @cached_property
    def held_out(self) -> tuple[GapReduction | None, tuple[RunTraces, ...]]:
        """How far the named effects close the gap in runs that took no part in the fit, and its traces."""
        study, nominal, fit, position = self.study, self.search.nominal, self.fit, self.position
        predicted = predict_held_out(self.search, fit)
        if not predicted:
            return None, ()
        design = nominal if fit is None else fit.design
        gaps = [
            gap_of_run(
                run,
                study.problem.noises[number],
                nominal.runs[number].motion_sd,
                (before, nominal.runs[number].whitening),
                (after, design.runs[number].whitening),
                study.problem.zero_sds[number],
                study.informative_blocks(number, nominal.runs[number].motion_sd),
            )
            for number, (run, (before, after)) in enumerate(zip(study.runs, predicted, strict=True))
        ]
        reduction = reduction_over_runs(gaps)
        named = self.judgement.verdict.effects
        if position.candidate is not None and position.candidate.effect.id in named and fit is None:
            reduction = position_gap_reduction(position, reduction)
        return reduction, tuple(map(traces_of_run, gaps))

    @cached_property
    def verdict(self) -> Classification:
        """The verdict: the judgement's, but that noise which is a little misjudged is no gap, and bursts are one."""
        return with_verdict(self._verdict_of_means, Verdict.UNKNOWN) if self.bursts else self._verdict_of_means

    @cached_property
    def _verdict_of_means(self) -> Classification:
        judged, tolerance_mN = self.judgement.verdict, self.options.tolerance_mN
        calibration = _calibration_for(self.study, self.options)
        if not unknown_by_excess_alone(self.inputs, judged, tolerance_mN, calibration):
            return judged
        reduction, where = self.held_out[0], localise(self.blocks, present=True)
        noise = reduction is not None and equals_noise(reduction.gap_before_mN, reduction.noise_floor_mN, where.p)
        return with_verdict(judged, Verdict.NO_GAP) if noise else judged

    @cached_property
    def bursts(self) -> tuple[ForceBurst, ...]:
        """Bursts beyond the tolerance where nothing else is a gap; none of fewer than `MIN_BURSTS`."""
        if self._verdict_of_means.verdict is not Verdict.NO_GAP:
            return ()
        of_runs = (force_bursts(run.run.trace, run.valid) for run in self.selection.experiments)
        bursts = tuple(burst for found in of_runs for burst in found if burst.height_mN > self.options.tolerance_mN)
        return bursts if len(bursts) >= MIN_BURSTS else ()

    @property
    def in_position(self) -> frozenset[str]:
        """Effects that may be in the errors of the position; none where it follows its command."""
        classes = self.position.model_classes if self.position.has_position_error else ()
        return frozenset(model_class.effect for model_class in classes)

    @property
    def presence(self) -> Mapping[str, float]:
        """Probability that each effect is there, by its id."""
        return presence_of_effects(self.causes.effects, self.verdict, self.in_position)


@single_blas_thread()
def weigh_causes(
    selection: RunSelection,
    nominal: NominalModel,
    options: DiagnosisOptions | None = None,
    progress: Progress = no_progress,
    *,
    all_periods: bool = False,
) -> WeighedCauses:
    """Weigh what causes the gap between the runs of a specimen and a nominal model.

    Parameters
    ----------
    all_periods
        Whether periodic effects compete at all their periods, as several campaigns share them; else at the best.

    Raises
    ------
    AnalysisError
        Where the model predicts none of these runs, or a run lacks data that it needs.
    """
    settings = options or DiagnosisOptions()
    start = perf_counter()
    advance = counted(progress, PREPARING_COST + SEARCH_COST + COMPETITION_COST)
    effects = [effect for effect in catalogue().values() if effect.id not in settings.excluded]
    known = known_effects(nominal)
    selection = correct_known_motion(selection, known)
    position = analyse_position(selection.experiments, effects)
    study = prepare_study(
        _with_trusted_motion(selection, position), nominal, [effect for effect in effects if effect.has_force_signature]
    )
    lines = lines_beyond_known(_without_slow_lines(find_spectral_lines(selection.experiments, study.channel)), known)
    moving_line = find_moving_line(selection.experiments, study.channel)
    study = _with_moving_line(study, moving_line)
    if moving_line is not None and moving_line.amplitude >= np.sqrt(2.0) * settings.tolerance_mN:
        selection = replace(selection, remarks=(*selection.remarks, moving_line_remark(moving_line)))
    studied = perf_counter()
    advance(PREPARING_COST)
    with_hum = _with_hum(study, selection.experiments, lines)
    search = (
        search_effects(with_hum, *MIN_LLR_AND_SHARE_WITH_MOTION_ERROR)
        if position.has_position_error
        else search_effects(with_hum)
    )
    advance(SEARCH_COST)
    faint_lines, lines = lines, lines_that_matter(lines, settings.tolerance_mN)
    inputs = _decision_inputs(search, position, lines, settings.excluded)
    competition = prepare_competition(search, all_periods=all_periods)
    present = judge_presence(competition)
    inputs = replace(inputs, competition=present.probabilities, by_model=present.by_model)
    judgement = judge(inputs, settings.tolerance_mN, _calibration_for(study, settings))
    causes = CausesOfGap(competition, present, judgement.presence)
    timings_s = {"reading and position": studied - start, "explaining": perf_counter() - studied}
    advance(COMPETITION_COST)
    return WeighedCauses(
        selection, nominal, settings, study, search, position, lines, faint_lines, inputs, judgement, causes, timings_s
    )


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
