"""A campaign whose effects may have another form: what is found beside them must not be made of it."""

from dataclasses import replace

import numpy as np

from dragrig.analysis.gap.design import Design, RunPart
from dragrig.rig.arrays import FloatArray

FORM_DOUBT = 0.25
"""So much of what effects add is doubted, one standard deviation: real ones leave 10 to 40 % of a catalogue's form."""


def doubting(design: Design) -> Design:
    """Return a design whose noise grows with what its candidates add.

    A foreign form leaves most where an effect is largest, and there a second one can hardly be told from it; where the
    first does little, the same force cannot be its own.
    """
    pairs = zip(design.parts, design.grams, strict=True)
    found = [_doubted(part) if part.added.any() else (part, gram) for part, gram in pairs]
    return replace(design, parts=tuple(one for one, _ in found), grams=tuple(gram for _, gram in found))


def _doubted(part: RunPart) -> tuple[RunPart, FloatArray]:
    sd = FORM_DOUBT * np.abs(part.added)
    whitening = part.whitening.doubting(sd)
    white = whitening.whole(np.column_stack((part.residual, part.columns)))
    return replace(part, motion_sd=np.hypot(part.motion_sd, sd), whitening=whitening), white.T @ white
