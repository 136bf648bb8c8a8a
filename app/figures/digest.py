"""What of each run a campaign's picture needs, so that the runs themselves need not stay in memory."""

from collections.abc import Collection
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np

from dragrig.analysis.estimates import Estimate
from dragrig.analysis.measures import measure
from dragrig.figures.relaxation import ramp_of
from dragrig.rig.arrays import AnyFloatArray, FloatArray
from dragrig.rig.profile import Phase
from dragrig.rig.runfile.model import Run, Status

STEADY_KINDS = ("drag", "coulomb", "blank")
"""Kinds of run with a steady force that stands in a campaign's picture."""
BINS = 250


def _nothing() -> FloatArray:
    return np.zeros(0)


@dataclass(frozen=True, slots=True, eq=False)
class RunDigest:
    """A run, much reduced.

    Attributes
    ----------
    good
        Whether it is complete and was not marked bad; only then the rest is filled in.
    speed_mm_s
        The speed that was set, or else measured, without sign; 0 where neither is known.
    strain
        Shear strain of a relaxation, 1 being 100 %.
    steady
        Steady force [mN] as recorded.
    x, force_mN
        A relaxation's force against the time since its ramp [s], or a drag's mean force against position [mm].
    """

    kind: str
    started: datetime
    backend: str
    specimen: str
    good: bool
    speed_mm_s: float = 0.0
    strain: float = 0.0
    steady: Estimate | None = None
    x: FloatArray = field(default_factory=_nothing)
    force_mN: FloatArray = field(default_factory=_nothing)


def digest(run: Run, bad: Collection[Path] = ()) -> RunDigest:
    """Reduce a run; `bad` holds the files of runs that were marked bad."""
    info = run.info
    good = info.status is Status.COMPLETE and info.path not in bad
    head = (info.kind, info.header.start_time, info.header.backend, str(info.header.specimen.get("name", "")), good)
    if not good:
        return RunDigest(*head)
    if info.kind == "relaxation":
        x, force = _since_the_ramp(run)
        return RunDigest(*head, strain=_number(run, "shear_strain"), x=x, force_mN=force)
    if info.kind not in STEADY_KINDS:
        return RunDigest(*head)
    measures = measure(run)
    speed = _number(run, "speed_mm_s") or measures.speed.value or 0.0
    x, force = _against_position(run) if info.kind == "drag" else (_nothing(), _nothing())
    steady = measures.steady_force if measures.steady_force.value is not None else None
    return RunDigest(*head, speed_mm_s=abs(speed), steady=steady, x=x, force_mN=force)


def _since_the_ramp(run: Run) -> tuple[FloatArray, FloatArray]:
    """Mean force in equal stretches of the logarithm of time."""
    ramp = ramp_of(run)
    if ramp is None:
        return _nothing(), _nothing()
    after = run.trace.time > ramp[1]
    log_time, force = _binned(np.log10(run.trace.time[after] - ramp[1]), run.trace.force[after])
    return np.asarray(10**log_time), force


def _against_position(run: Run) -> tuple[FloatArray, FloatArray]:
    """Mean force in equal stretches of the way, while in motion."""
    moving = (run.trace.phase > Phase.REST) & (run.trace.phase < Phase.HOLD)
    return _binned(run.trace.position[moving], run.trace.force[moving])


def _binned(x: AnyFloatArray, force: AnyFloatArray) -> tuple[FloatArray, FloatArray]:
    finite = np.isfinite(x) & np.isfinite(force)
    if not finite.any():
        return _nothing(), _nothing()
    place, weight = np.asarray(x[finite], dtype=np.float64), force[finite]
    edges = np.linspace(place.min(), place.max(), BINS + 1)
    count, _ = np.histogram(place, edges)
    sums = [np.histogram(place, edges, weights=one)[0] for one in (place, weight)]
    filled = count > 0
    return np.asarray(sums[0][filled] / count[filled]), np.asarray(sums[1][filled] / count[filled])


def _number(run: Run, name: str) -> float:
    value = run.info.header.protocol.get(name)
    return float(value) if isinstance(value, int | float) else 0.0
