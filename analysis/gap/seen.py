"""The smallest effect that runs would have shown."""

import numpy as np

from dragrig.analysis.gap.design import Design, Part
from dragrig.analysis.gap.ranking import rank
from dragrig.analysis.gap.solving import NUISANCES, project
from dragrig.analysis.gap.study import Study

SEEN = 5.0
"""d′ that is found nearly always."""
ACTING = 0.1
MOST = 0.8
"""Share of the effects that would be seen at the size that is told."""


def would_have_seen(study: Study, design: Design) -> float:
    """Return the force [mN], root mean square where an effect acts, from which on most effects would be seen."""
    sizes = []
    ranked = rank(project(design, design.total(), *NUISANCES), design.shapes)
    columns = design.of(Part.SHAPE)
    weights = np.concatenate([one.coordinates.width_s for one in study.sights])
    for one in ranked:
        more = np.concatenate([part.columns[:, columns[one.shapes[0]]] for part in design.parts])
        acting = np.abs(more) > ACTING * np.abs(more).max(initial=1e-12)
        if one.per_unit <= 0 or not acting.any():
            continue
        rms = float(np.sqrt(weights[acting] @ more[acting] ** 2 / weights[acting].sum()))
        sizes.append(SEEN / one.per_unit * rms)
    return float(np.quantile(sizes, MOST)) if sizes else float(np.median([one.white for one in study.problem.noises]))
