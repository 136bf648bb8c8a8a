"""How far an amended model closes the gap on fresh runs of the same specimen."""

from dataclasses import replace

import numpy as np

from dragrig.analysis.gap.candidate import Candidate
from dragrig.analysis.gap.capsule_study import CapsuleStudy
from dragrig.analysis.gap.design import lay_out
from dragrig.analysis.gap.gaps import run_gap, shrink_of
from dragrig.analysis.gap.position.errors import position_errors
from dragrig.analysis.gap.position.gap import closed_in_position
from dragrig.analysis.gap.results import Shrink
from dragrig.analysis.gap.sights import sights_of
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.identification.threads import one_thread
from dragrig.analysis.nominal.capsule import CapsuleModel
from dragrig.config.errors import AnalysisError
from dragrig.config.model import FrictionModelSettings
from dragrig.sim_backend.effects.applied import switched_on
from dragrig.sim_backend.effects.base import EncoderEffect, MotorEffect


@one_thread()
def evaluate(selection: Selection, model: FrictionModelSettings) -> Shrink:
    """Compare fresh runs with the specimen's model as it was without its effects, and with them.

    Nothing is fitted to the runs but each one's own zero.

    Raises
    ------
    AnalysisError
        Where the model has no effects, or predicts nothing of these runs.
    """
    if not model.effects:
        raise AnalysisError(f"model {model.name} has no effects, so that there is nothing to evaluate.")
    bare = model.model_copy(update={"effects": (), "diagnosed": None})
    before = bare.model_copy(update=dict(model.diagnosed.nominal)) if model.diagnosed else bare
    first = _study(selection, before)
    second = _beside(_study(selection, model), first)
    start = np.zeros(len(first.names))
    one, other = lay_out(first, start), lay_out(second, start)
    gaps = [
        run_gap(
            sight,
            first.problem.noises[number],
            other.parts[number].motion_sd,
            (one.parts[number].residual, one.parts[number].whitening),
            (other.parts[number].residual, other.parts[number].whitening),
            first.problem.zero_sds[number],
        )
        for number, sight in enumerate(first.sights)
    ]
    shrink = shrink_of(gaps)
    moved = [one for one in switched_on(model) if isinstance(one.effect, MotorEffect | EncoderEffect)]
    errors = position_errors(selection.experiments)
    if len(moved) == 1 and len(model.effects) == 1 and any(one.strays for one in errors):
        return closed_in_position(Candidate(moved[0].effect, moved[0].values), errors, shrink)
    return shrink


def _study(selection: Selection, settings: FrictionModelSettings) -> CapsuleStudy:
    return CapsuleStudy.of(selection, CapsuleModel(settings), ())


def _beside(study: CapsuleStudy, other: CapsuleStudy) -> CapsuleStudy:
    """Let a study look at the same blocks as another one, whose model bends at other moments."""
    pairs = zip(study.problem.evidence, other.problem.evidence, strict=True)
    evidence = tuple(replace(mine, blocks=theirs.blocks) for mine, theirs in pairs)
    problem = replace(
        study.problem,
        evidence=evidence,
        noises=other.problem.noises,
        zero_sds=other.problem.zero_sds,
    )
    return replace(study, problem=problem, sights=sights_of(evidence))
