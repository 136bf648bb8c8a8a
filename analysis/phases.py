"""Stretches of a run that its phases set apart."""

from collections.abc import Mapping
from math import isfinite, radians, sin

import numpy as np
import numpy.typing as npt

from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Attribute, Run, Trace

Mask = npt.NDArray[np.bool_]

FRESH_WALL_KINDS = frozenset({"drag", "return"})
"""Kinds of run in which the capsule slides into wall that it has not touched yet."""
SETTLING_S = 0.1
"""Start of the steady phase that is left out of every other kind: the stage settles at its speed."""
CREEP_S = 0.1
"""End of the rest that is left out, or a quarter of a rest that is shorter than four times as long."""
HOLD_END_S = 1.0
"""The end of the hold is its last second, or its second half when it is shorter than two."""


def in_phase(trace: Trace, phase: Phase) -> Mask:
    """Tell for each sample whether it belongs to a phase."""
    return np.asarray(trace.phase == int(phase))


def at_rest(trace: Trace) -> Mask:
    """Tell which samples show the rest before the motion.

    The last of it is left out: a stage whose jerk is limited creeps off before its phase says so, too slowly for
    the encoder, and Coulomb friction is there at once.
    """
    rest = in_phase(trace, Phase.REST)
    if not rest.any():
        return rest
    begin, end = float(trace.time[rest][0]), float(trace.time[rest][-1])
    return rest & (trace.time <= end - min(CREEP_S, (end - begin) / 4))


def contact_length_mm(capsule: Mapping[str, Attribute]) -> float:
    """Axial length of the contact on the leading hemisphere, R sin α; NaN when the capsule does not say."""
    diameter, angle = capsule.get("diameter_mm"), capsule.get("contact_angle_deg")
    if isinstance(diameter, int | float) and isinstance(angle, int | float):
        return 0.5 * float(diameter) * sin(radians(float(angle)))
    return float("nan")


def steady_stretch(run: Run) -> tuple[Mask, str]:
    """Tell which samples show steady sliding, and how that was found.

    In a drag test the wall under the leading hemisphere at the start has been touched for the whole
    dwell; the force is steady once the capsule has moved by the contact length R sin α (5.6 mm for a
    capsule of 12.9 mm and 60°), when all of it has been replaced. In every other kind only the first 0.1 s of
    the steady phase is left out.
    """
    trace = run.trace
    steady = in_phase(trace, Phase.STEADY)
    if not steady.any():
        return steady, "the run has no steady phase"
    if run.info.kind not in FRESH_WALL_KINDS:
        started = float(trace.time[steady][0])
        return steady & (trace.time >= started + SETTLING_S), f"the steady phase after its first {SETTLING_S:g} s"
    length = contact_length_mm(run.info.header.capsule)
    if not isfinite(length):
        return np.zeros_like(steady), "the capsule's diameter or contact angle is not given"
    moved = np.abs(np.asarray(trace.position, dtype=np.float64) - float(trace.position[0]))
    return steady & (moved >= length), f"the steady phase after {length:.2f} mm of travel"


def end_of_hold(trace: Trace) -> Mask:
    """Tell which samples belong to the end of the hold."""
    hold = in_phase(trace, Phase.HOLD)
    if not hold.any():
        return hold
    begin, end = float(trace.time[hold][0]), float(trace.time[hold][-1])
    return hold & (trace.time >= end - min(HOLD_END_S, (end - begin) / 2))
