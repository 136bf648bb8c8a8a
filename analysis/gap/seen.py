"""The smallest effect that runs would have shown."""

from math import sqrt

import numpy as np

from dragrig.analysis.gap.acting import rms_where_acting
from dragrig.analysis.gap.design import Design, Part
from dragrig.analysis.gap.ranking import rank
from dragrig.analysis.gap.solving import NUISANCES, project
from dragrig.analysis.gap.study import Study
from dragrig.analysis.gap.weighing import counts

SEEN = 5.9
"""d′ that is found nearly always where all that an effect takes away counts for a gap."""
TOLERANCE_MN = 0.5
"""What an effect must add [mN], root mean square where it acts, to matter, unless a person says otherwise."""
MOST = 0.8
"""Share of the effects that would be seen at the size that is told."""


def needed(effect: str) -> float:
    """Return the d′ of an effect on the force that is found nearly always."""
    return SEEN / sqrt(counts(effect))


def would_have_seen(study: Study, design: Design) -> float:
    """Return the force [mN], root mean square where an effect acts, from which on most effects would be seen."""
    sizes = []
    ranked = rank(project(design, design.total(), *NUISANCES), design.shapes)
    for one in ranked:
        rms = acting_rms(study, design, one.shapes[0])
        if one.per_unit > 0 and rms > 0:
            sizes.append(needed(one.effect) / one.per_unit * rms)
    return float(np.quantile(sizes, MOST)) if sizes else float(np.median([one.white for one in study.problem.noises]))


def acting_rms(study: Study, design: Design, shape: int) -> float:
    """Return the root mean square [mN] of a shape of the dictionary where it acts; 0 where it does nowhere."""
    column = design.of(Part.SHAPE)[shape]
    weights = np.concatenate([one.coordinates.width_s for one in study.sights])
    more = np.concatenate([part.columns[:, column] for part in design.parts])
    return rms_where_acting(more, weights)
