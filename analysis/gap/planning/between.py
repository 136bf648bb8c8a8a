"""What would set two effects apart beside some runs, made or planned, each of them at its usual size."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from dragrig.analysis.gap.capsule_study import CapsuleStudy
from dragrig.analysis.gap.design import Design, lay_out
from dragrig.analysis.gap.isolability.angles import Angles
from dragrig.analysis.gap.isolability.results import CLOSE
from dragrig.analysis.gap.planning.contests import Ground, Question, Truth
from dragrig.analysis.gap.planning.force import search_in_force
from dragrig.analysis.gap.planning.imagined import specimen_of
from dragrig.analysis.gap.planning.recommend import experiment_of, limits_of
from dragrig.analysis.gap.planning.results import NextExperiment
from dragrig.analysis.gap.planning.search import Budget
from dragrig.analysis.gap.planning.trials import many
from dragrig.analysis.gap.refit import stepped
from dragrig.analysis.gap.study import Study
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.identification.threads import one_thread
from dragrig.analysis.nominal.capsule import CapsuleModel
from dragrig.config.errors import AnalysisError
from dragrig.sim_backend.effects.base import ForceEffect, SensorEffect
from dragrig.sim_backend.effects.catalogue import catalogue

HUM = "mains_hum"
MOST_PAIRS = 3
"""So many of the closest pairs are looked at where none is named."""


@one_thread()
def next_between(
    selection: Selection, nominal: CapsuleModel, pair: tuple[str, str] | None, budget: Budget
) -> NextExperiment | None:
    """Recommend runs that set effects apart.

    Parameters
    ----------
    pair
        Two effects of the force; those that the runs hardly tell apart unless given, the closest if there are none.

    Raises
    ------
    AnalysisError
        Where the runs show one of the two not at all and no run could be compared with.
    """
    effects = [one for one in catalogue().values() if isinstance(one, ForceEffect | SensorEffect) and one.id != HUM]
    study = CapsuleStudy.of(selection, nominal, effects)
    point = stepped(lay_out(study, study.start))
    wanted = study if pair is None else replace(study, effects=tuple(one for one in study.effects if one.id in pair))
    design = lay_out(wanted, point.z, dictionary=True)
    angles = Angles.of(design)
    pairs = [pair] if pair is not None else list(_closest(angles))
    lacking = sorted({name for one in pairs for name in one} - set(angles.effects))
    if lacking:
        raise AnalysisError(f"{lacking[0]}: these runs do not show it at all; begin with a plan that does, as paper.")
    limits = budget.limits or limits_of(study)
    trials = [one for one in many(specimen_of(study)) if limits.allow(one)]
    asked = _questions(wanted, design, angles, pairs)
    return experiment_of(search_in_force(wanted, design, asked, trials, budget), len(trials))


def _closest(angles: Angles) -> Iterator[tuple[str, str]]:
    names = angles.effects
    apart = {
        (one, other): float(min(angles.sin2(one, other).min(), angles.sin2(other, one).min()))
        for place, one in enumerate(names)
        for other in names[place + 1 :]
    }
    ordered = sorted(apart, key=lambda pair: apart[pair])
    close = [pair for pair in ordered if apart[pair] < CLOSE]
    yield from (close or ordered[:1])[:MOST_PAIRS]


def _questions(study: Study, design: Design, angles: Angles, pairs: Sequence[tuple[str, str]]) -> tuple[Question, ...]:
    """Ask of each pair both ways, with the form of the first that the second comes nearest to."""
    named = {name for pair in pairs for name in pair}
    ground = Ground.of(design, [one.id for one in study.effects if one.id in named])
    asked = []
    for pair in pairs:
        for truth, rival in (pair, pair[::-1]):
            nearest = angles.of_effect(truth)[int(np.argmin(angles.sin2(truth, rival)))]
            own = [place for place, shape in enumerate(design.shapes) if shape.effect.id == truth]
            before = [place for place, shape in enumerate(ground.shapes) if shape.effect.id == truth]
            columns = tuple(before[own.index(place)] for place in angles.forms[nearest].shapes)
            amplitude = np.zeros(len(columns))
            amplitude[0] = 1.0
            asked.append(Question(Truth(truth, columns, amplitude), rival, 1.0))
    return tuple(asked)
