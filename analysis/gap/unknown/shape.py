"""What a gap is a function of and how, as sentences."""

from collections.abc import Mapping

import numpy as np

from dragrig.analysis.gap.unknown.decay import decay_of
from dragrig.analysis.gap.unknown.part import Part
from dragrig.analysis.gap.unknown.trend import told, trend_of
from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.analysis.gap.where.domain import FAST_HZ
from dragrig.analysis.gap.where.periodic import FREQUENCIES_HZ, best_wave, periodic_shares
from dragrig.analysis.gap.where.results import Where
from dragrig.rig.arrays import FloatArray
from dragrig.rig.profile import Phase

PERIODIC = 0.3
"""Part of all squares from which on a sine is worth telling."""
ALIKE, OTHERWISE = 0.6, 0.3
"""Part of a gap that other runs tell from which on it is the same in every run, and below which it is not."""
IN_STEP = 0.7
"""Mean of the runs' directions in the period from which on they begin alike."""
ONE_SIGN = 0.8

_OF: Mapping[str, tuple[str, str, str]] = {
    "speed": ("of speed", "speed", " mm/s"),
    "position": ("of the position along the stroke", "position", " mm"),
    "time": ("of the time since the start of a run", "time", " s"),
    "session": ("of the session's time", "session time", " s"),
    "strain": ("of strain", "strain", ""),
    "frequency": ("of frequency", "", ""),
    "transient": ("of starting and stopping", "", ""),
}
"""Domain in words, its coordinate, and the coordinate's unit."""


def shape(where: Where, part: Part) -> str:
    """Return what the residual is above all a function of, how it goes, its sign, and whether runs agree on it."""
    words, name, unit = _OF.get(where.domain, (f"of {where.domain}", "", ""))
    wave = _wave(part)
    trend = trend_of(part, where.domain) if where.runs != 1 else None
    along = trend.words(name, part.unit, unit) if trend is not None else ""
    decay = None if wave else decay_of(part)
    said = [
        _agreement(where, part, words, bool(wave)),
        wave,
        f"Measured less modelled {along}." if along else "",
        "" if decay is None else decay.words(part.unit),
        _sign(part),
    ]
    return " ".join(one for one in said if one)


def _agreement(where: Where, part: Part, words: str, periodic: bool) -> str:
    told = where.domain_scores.get(where.domain, 0.0)
    total = sum(float((one.weight * one.deviation**2).sum()) for one in part.blocks)
    share = min(told * total / part.excess, 1.0) if part.excess > 0 else told
    if where.domain == "transient" and share >= OTHERWISE:
        return f"{share:.0%} of it is at changes of velocity and shortly after. {_starts_and_stops(part)}".rstrip()
    if where.domain == "frequency" and share >= OTHERWISE:
        return f"{share:.0%} of it is faster than {FAST_HZ:g} Hz."
    if where.runs == 1:
        return ""
    if share < OTHERWISE and not periodic:
        return "It differs from run to run, and is not clearly a function of anything that runs have in common."
    alike = ", so that it is much the same in every run" if share >= ALIKE and not periodic else ""
    if where.domain == "session" and not periodic:
        alike = ", so that it changes slowly"
    told_by = "" if periodic else f": runs alike in it tell {share:.0%} of one another{alike}"
    return f"Above all a function {words}{told_by}."


def _sign(part: Part) -> str:
    above = whole = 0.0
    for one, inside in zip(part.blocks, part.inside, strict=True):
        squares = (one.weight * one.deviation**2)[inside]
        above += float(squares[one.residual[inside] > 0].sum())
        whole += float(squares.sum())
    share = above / whole if whole > 0 else 0.5
    if share >= ONE_SIGN:
        return f"What is measured is higher than the model's {part.channel} nearly everywhere."
    if share <= 1 - ONE_SIGN:
        return f"What is measured is lower than the model's {part.channel} nearly everywhere."
    return "It has both signs."


def _starts_and_stops(part: Part) -> str:
    told = [
        f"{mean:+.2g} {part.unit} while {name}".replace("-", "−")
        for phase, name in ((Phase.ACCELERATE, "accelerating"), (Phase.DECELERATE, "braking"))
        if (mean := _mean(part, phase)) is not None
    ]
    return f"On average it is {' and '.join(told)}." if told else ""


def _mean(part: Part, phase: Phase) -> float | None:
    """Return the mean residual of a phase over runs."""
    means = [
        float(np.average(one.residual[here], weights=one.weight[here]))
        for one in part.blocks
        if (here := one.phase == phase).any()
    ]
    return part.scale * float(np.mean(means)) if means else None


def _wave(part: Part) -> str:
    """Return period, amplitude and phase of what is periodic; empty for what is not."""
    in_position, in_time = periodic_shares(part.blocks)
    if max(in_position.max(), in_time.max()) < PERIODIC:
        return ""
    along = in_position.max() >= in_time.max()
    rate = best_wave(part.blocks) if along else float(FREQUENCIES_HZ[np.argmax(in_time)])
    waves = np.array([_amplitude(one, np.abs(one.position_mm) if along else one.time_s, rate) for one in part.blocks])
    place, unit = ("along the stroke", "mm") if along else ("in time", "s")
    periodic = f"It is periodic {place}, {1 / rate:.3g} {unit} long"
    if not waves.any():
        return f"{periodic}, which is more than any run moves steadily."
    size = float(np.median(np.abs(waves[np.abs(waves) > 0]))) * part.scale
    step = abs(waves.sum()) / np.abs(waves).sum()
    begin = "at the same place" if along else "at the same time"
    phase = f", {begin} in every run" if step >= IN_STEP else ", with a phase of its own in each run"
    if along and len({round(one.origin_mm, 1) for one in part.blocks}) > 1:
        # Positions count from where each run begins.
        phase = ""
    return f"{periodic}, with an amplitude of {told(size)} {part.unit}{phase}."


def _amplitude(one: ResidualBlocks, coordinate: FloatArray, rate: float) -> complex:
    """Return the wave of a run's steady motion, 0 for one that holds less than a period."""
    here = one.phase == Phase.STEADY
    if not here.any() or rate * np.ptp(coordinate[here]) < 1:
        return 0j
    weight, deviation = one.weight[here], one.residual[here]
    left = deviation - np.average(deviation, weights=weight)
    turned = np.exp(-2j * np.pi * rate * coordinate[here])
    return complex(2 * np.sum(weight * left * turned) / weight.sum())
