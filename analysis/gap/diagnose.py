"""A diagnosis from one end to the other: where, which, how much."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np

from dragrig.analysis.gap.amended import amended_model
from dragrig.analysis.gap.calibration import Calibration, shipped_calibration
from dragrig.analysis.gap.capsule_study import CapsuleStudy
from dragrig.analysis.gap.evidence import Evidence
from dragrig.analysis.gap.explain import explain
from dragrig.analysis.gap.explanation import Explanation
from dragrig.analysis.gap.findings import Findings
from dragrig.analysis.gap.gaps import RunGap, run_gap, shrink_of
from dragrig.analysis.gap.gathering import evidence_of
from dragrig.analysis.gap.hearing import with_heard_hum
from dragrig.analysis.gap.held_out import improvement, leave_out
from dragrig.analysis.gap.judging import CLEAR_BESIDE, NO_GAP, UNKNOWN, Judgement, judge, tells_unknown
from dragrig.analysis.gap.known import HUM, beyond_known, known_effects, with_known_motion
from dragrig.analysis.gap.lines import Line, Lines, find_lines
from dragrig.analysis.gap.planning.after import next_after, nothing_further
from dragrig.analysis.gap.planning.search import Budget
from dragrig.analysis.gap.position.finding import PositionFinding, find_position
from dragrig.analysis.gap.position.gap import position_gap
from dragrig.analysis.gap.residuals import force_blocks, position_blocks
from dragrig.analysis.gap.results import Diagnosis, Ranked, RunView, Shrink, Verdict
from dragrig.analysis.gap.seen import TOLERANCE_MN, would_have_seen
from dragrig.analysis.gap.studies import study_of
from dragrig.analysis.gap.study import Study
from dragrig.analysis.gap.tables import parameters_of, views_of
from dragrig.analysis.gap.unknown import unknown_gap
from dragrig.analysis.gap.where import attributed, locate
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.identification.threads import one_thread
from dragrig.analysis.nominal.protocol import NominalModel
from dragrig.analysis.progress import Progress, silent
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.effects.base import Effect, ForceEffect, SensorEffect
from dragrig.sim_backend.effects.catalogue import catalogue

SLOW_LINE_HZ, LEAST_SLOW_LINE = 4.9, 300.0
"""Slow noise passes for lines below this frequency, with gains below that: 38 at most in 500 simulated campaigns."""
CALIBRATION = "calibrated on simulated campaigns"
STEPS = 6
BESIDE_MOTION = 0.5 * CLEAR_BESIDE, 0.3
"""Where the stage strays, what its motion leaves uncertain is no effect unless one takes away so many half squares
beforehand, and this share of it."""


@dataclass(frozen=True, slots=True)
class Options:
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
    tolerance_mN: float = TOLERANCE_MN
    next_runs: Budget = field(default_factory=Budget)
    calibration: Calibration | None = None


@one_thread()
def diagnose(
    selection: Selection, nominal: NominalModel, options: Options | None = None, progress: Progress = silent
) -> Diagnosis:
    """Diagnose the gap between the runs of a specimen and a nominal model.

    Raises
    ------
    AnalysisError
        Where the model predicts nothing of these runs, or a run lacks what it needs.
    """
    asked = options or Options()
    began = perf_counter()
    progress(0, STEPS)
    effects = [one for one in catalogue().values() if one.id not in asked.without]
    known = known_effects(nominal)
    selection = with_known_motion(selection, known)
    position = find_position(selection.experiments, effects)
    progress(1, STEPS)
    study = study_of(_trusting(selection, position), nominal, [one for one in effects if _in_force(one)])
    lines = beyond_known(_audible(find_lines(selection.experiments, study.channel)), known)
    prepared = perf_counter()
    heard = with_heard_hum(study, selection.experiments, lines)
    found = explain(heard, *BESIDE_MOTION) if position.present else explain(heard)
    progress(4, STEPS)
    evidence = evidence_of(found, position, lines, asked.without)
    judged = judge(evidence, asked.tolerance_mN, _calibration(study, asked))
    explained = perf_counter()
    diagnosis = _told(selection, nominal, asked, study, found, position, lines, judged, evidence)
    progress(STEPS, STEPS)
    timings = {
        "reading and position": prepared - began,
        "explaining": explained - prepared,
        "telling": perf_counter() - explained,
    }
    return replace(diagnosis, timings_s=timings)


def _in_force(effect: Effect) -> bool:
    return isinstance(effect, ForceEffect | SensorEffect) and effect.id != HUM


def _audible(lines: Lines) -> Lines:
    """Leave out what may be slow noise."""
    slow = lines.other.frequency_hz <= SLOW_LINE_HZ and lines.other.gain < LEAST_SLOW_LINE
    return Lines(lines.mains, replace(lines.other, gain=0.0) if slow else lines.other)


def _trusting(selection: Selection, position: PositionFinding) -> Selection:
    """Let the motion be the command's where only the record of the position is wrong."""
    if not position.recorded_wrongly:
        return selection
    return replace(selection, experiments=tuple(replace(one, trusts_command=True) for one in selection.experiments))


def _calibration(study: Study, asked: Options) -> Calibration:
    weights = asked.calibration or shipped_calibration()
    return weights if isinstance(study, CapsuleStudy) else weights.of_any_rig


def _chosen(found: Findings, judged: Judgement) -> Explanation | None:
    """Return the explanation that has the effects of the force that were named."""
    named = {name for name in judged.effects if name != HUM}
    tried = [*found.singles, *(one.together for one in found.steps if one.together is not None)]
    fitting = [one for one in tried if set(one.effects) <= named]
    return max(fitting, key=lambda one: len(one.effects), default=None)


def _told(
    selection: Selection,
    nominal: NominalModel,
    asked: Options,
    study: Study,
    found: Findings,
    position: PositionFinding,
    lines: Lines,
    judged: Judgement,
    evidence: Evidence,
) -> Diagnosis:
    chosen = _chosen(found, judged)
    hum = lines.mains if HUM in judged.effects else replace(lines.mains, amplitude=0.0)
    swing = lines.other if tells_unknown(evidence, judged) else None
    blocks = [*force_blocks(study, found.nominal, asked.tolerance_mN, swing or hum)]
    blocks += position_blocks(position.runs)
    where = locate(blocks, present=judged.verdict is not Verdict.NO_GAP)
    where = attributed(where, blocks, _added(study, chosen, hum))
    shrink, views = _shrunk(study, found, chosen, position, judged)
    files = tuple(one.file for one in study.sights)
    of_force = judge(replace(evidence, position=(), strays=False), asked.tolerance_mN, _calibration(study, asked))
    next_run = next_after(study, found, position, judged, of_force, asked.next_runs)
    return Diagnosis(
        specimen=selection.specimen,
        nominal=nominal.name,
        runs=len(selection.experiments),
        used_for_fit=files,
        held_out=files if len(files) > 1 else (),
        left_out=selection.left_out,
        verdict=judged.verdict,
        effects=judged.effects,
        ranking=tuple(_ranking(found, position, lines, judged)),
        confusable_with=judged.confusable_with,
        residual_unknown=judged.residual_unknown,
        would_have_seen_mN=would_have_seen(study, found.nominal),
        tolerance_mN=asked.tolerance_mN,
        where=where,
        shrink=shrink,
        unknown=unknown_gap(where, blocks, judged, swing, evidence),
        model=amended_model(study, chosen, position, lines, judged, found, shrink, selection.specimen),
        views=views,
        cannot_answer=(*study.open_questions(), *nothing_further(study, position, judged, next_run)),
        remarks=selection.remarks,
        calibration=CALIBRATION,
        evidence=evidence,
        next_experiment=next_run,
    )


def _added(study: Study, chosen: Explanation | None, hum: Line) -> list[FloatArray]:
    """Return what the named effects add to the force, block by block, of hum its root mean square."""
    if chosen is not None:
        return [part.added for part in chosen.design.parts]
    return [np.full(one.coordinates.width_s.size, hum.amplitude / np.sqrt(2.0)) for one in study.sights]


def _shrunk(
    study: Study, found: Findings, chosen: Explanation | None, position: PositionFinding, judged: Judgement
) -> tuple[Shrink | None, tuple[RunView, ...]]:
    left = leave_out(found, chosen)
    if left is None:
        return None, ()
    design = found.nominal if chosen is None else chosen.design
    gaps: list[RunGap] = []
    for number, sight in enumerate(study.sights):
        gaps.append(
            run_gap(
                sight,
                study.problem.noises[number],
                found.nominal.parts[number].motion_sd,
                (left.before[number], found.nominal.parts[number].whitening),
                (left.after[number], design.parts[number].whitening),
                study.problem.zero_sds[number],
                study.counted(number, found.nominal.parts[number].motion_sd),
            )
        )
    shrink = shrink_of(gaps)
    if position.candidate is not None and position.candidate.effect.id in judged.effects and chosen is None:
        shrink = position_gap(position, shrink)
    return shrink, views_of(gaps)


def _ranking(found: Findings, position: PositionFinding, lines: Lines, judged: Judgement) -> Iterator[Ranked]:
    explained = {"+".join(one.effects): one for one in found.singles}
    explained |= {"+".join(one.together.effects): one.together for one in found.steps if one.together is not None}
    known = [one.effect for one in found.ranked] + [one.effect for one in position.families] + [HUM, NO_GAP, UNKNOWN]
    whole = {**dict.fromkeys(known, 0.0), **judged.probabilities}
    sums = sum(whole.values())
    for name, probability in sorted(whole.items(), key=lambda pair: -pair[1]):
        one = explained.get(name)
        yield Ranked(
            name,
            probability / sums,
            parameters_of(name, one, position, lines),
            None if one is None else improvement(found, one),
        )
