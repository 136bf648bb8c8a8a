"""From runs, made or planned, to what they can tell apart."""

from collections import Counter
from collections.abc import Iterator, Sequence
from statistics import median

import numpy as np

from dragrig.analysis.gap.design import Design, lay_out
from dragrig.analysis.gap.isolability.angles import Angles, Form
from dragrig.analysis.gap.isolability.ordering import neighbours
from dragrig.analysis.gap.isolability.position import position_isolability
from dragrig.analysis.gap.isolability.results import CLOSE, Isolability, Pair, Visibility, pairs_of
from dragrig.analysis.gap.judging import LEAST_LINE
from dragrig.analysis.gap.known import HUM
from dragrig.analysis.gap.lines import least_line
from dragrig.analysis.gap.refit import stepped
from dragrig.analysis.gap.seen import SEEN, TOLERANCE_MN, acting_rms, needed
from dragrig.analysis.gap.studies import study_of
from dragrig.analysis.gap.study import Study
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.identification.threads import one_thread
from dragrig.analysis.nominal.protocol import NominalModel
from dragrig.analysis.progress import Progress, silent
from dragrig.sim_backend.effects.base import Effect, ForceEffect, SensorEffect
from dragrig.sim_backend.effects.catalogue import catalogue

STEPS = 4


@one_thread()
def isolate(
    selection: Selection,
    nominal: NominalModel,
    without: Sequence[str] = (),
    *,
    source: str = "",
    planned: bool = False,
    duration_s: float | None = None,
    progress: Progress = silent,
) -> Isolability:
    """Say which effects the runs of a specimen can tell apart, and how small a one they would show.

    Parameters
    ----------
    without
        Effects that are not to be considered.

    Raises
    ------
    AnalysisError
        Where the model predicts nothing of these runs.
    """
    effects = [one for one in catalogue().values() if one.id not in without]
    progress(0, STEPS)
    study = study_of(selection, nominal, [one for one in effects if _in_force(one)])
    point = stepped(lay_out(study, study.start))
    progress(1, STEPS)
    design = lay_out(study, point.z, dictionary=True)
    progress(2, STEPS)
    angles = Angles.of(design)
    pairs = [_pair(angles, pair) for pair in pairs_of(angles.effects)]
    order = neighbours(angles.effects, {frozenset(one.effects): one.sin2 for one in pairs})
    seen = {name: _visibility(study, design, angles, name) for name in order}
    hidden = [_unseen(one) for one in study.effects if one.id not in seen]
    progress(3, STEPS)
    lines = [_line(one, selection, study.channel) for one in effects if one.id == HUM]
    in_position, more = position_isolability(selection.experiments, effects)
    progress(STEPS, STEPS)
    return Isolability(
        source=source,
        planned=planned,
        runs=dict(Counter(one.kind for one in selection.experiments)),
        duration_s=duration_s,
        effects=(*seen.values(), *hidden, *lines, *in_position),
        pairs=tuple(sorted((*pairs, *more), key=lambda one: one.sin2)),
        remarks=tuple(_remarks(selection, planned=planned)),
    )


def _in_force(effect: Effect) -> bool:
    return isinstance(effect, ForceEffect | SensorEffect) and effect.id != HUM


def _pair(angles: Angles, pair: tuple[str, str]) -> Pair:
    one, other = pair
    left = angles.sin2(one, other), angles.sin2(other, one)
    apart = [float(np.median(angles.d_primes(name) * np.sqrt(share))) for name, share in zip(pair, left, strict=True)]
    sin2 = float(min(left[0].min(), left[1].min()))
    typical = float(np.median(left[0])), float(np.median(left[1]))
    return Pair(pair, "force", sin2, typical, (apart[0], apart[1]), sin2 < CLOSE or min(apart) < SEEN)


def _visibility(study: Study, design: Design, angles: Angles, name: str) -> Visibility:
    size = next(one for one in study.effects if one.id == name).size
    forms = [angles.forms[one] for one in angles.of_effect(name)]
    found = [_least(study, design, one, needed(name)) for one in forms]
    share, least_mN = median(one[0] for one in found), median(one[1] for one in found)
    d_prime = median(one.d_prime for one in forms)
    return Visibility(name, "force", d_prime, size.usual, share * abs(size.usual), size.unit, least_mN)


def _least(study: Study, design: Design, form: Form, d_prime: float) -> tuple[float, float]:
    """Return the smallest size, with such a d′, over the usual one, and its root mean square [mN]."""
    rms = acting_rms(study, design, form.shapes[0])
    share = max(d_prime / form.d_prime, TOLERANCE_MN / rms if rms > 0 else 0.0)
    return share, share * rms


def _unseen(effect: Effect) -> Visibility:
    return Visibility(effect.id, "force", 0.0, effect.size.usual, None, effect.size.unit)


def _line(effect: Effect, selection: Selection, channel: str) -> Visibility:
    size, least = effect.size, least_line(selection.experiments, channel, LEAST_LINE)
    if least is None:
        return Visibility(effect.id, "spectrum", 0.0, size.usual, None, size.unit)
    return Visibility(
        effect.id, "spectrum", SEEN * size.usual / least, size.usual, least, size.unit, least / float(np.sqrt(2))
    )


def _remarks(selection: Selection, *, planned: bool) -> Iterator[str]:
    yield (
        "an effect of the position and one of the force are told apart by the channel: the force is predicted from the "
        "measured motion, so that a stage that strays leaves no gap there, and no angle between the two is given"
    )
    yield "mains hum is told by its frequency where the stage stands still, and has no near one among the others"
    yield "more than two effects at once, and what the catalogue does not have, are not looked at"
    if planned:
        yield (
            "the runs are predicted by the nominal model with the simulated rig's noise; another specimen, a louder "
            "sensor or prompts that take long change the figures"
        )
    yield from selection.remarks
