"""Description of a gap that no effect of the catalogue explains: where it is, what it depends on, and a law."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from dragrig.analysis.gap.classifier import Classification
from dragrig.analysis.gap.diagnosis import AxisLocation, GapLocation, UnexplainedGap, Verdict
from dragrig.analysis.gap.excess import ResidualBlocks
from dragrig.analysis.gap.features import DecisionInputs
from dragrig.analysis.gap.localise import ALPHA, FAST_HZ, FREQUENCIES_HZ, best_wavenumber, periodic_shares
from dragrig.analysis.gap.spectral_lines import SpectralLine
from dragrig.analysis.gap.unknown_law import (
    DOMINANT_SHARE,
    NEGLIGIBLE_SHARE,
    NOTABLE_SHARE,
    GapRegion,
    fit_gap_law,
    gap_region,
    kinds_with_excess,
    phase_span,
    time_since_start,
)
from dragrig.rig.arrays import BoolArray, FloatArray, IndexArray
from dragrig.rig.devices import Contact
from dragrig.rig.profile import Phase
from dragrig.sim_backend.effects.base import catalogue

MAX_BINS, MIN_BINS = 10, 3
MONOTONIC_CORRELATION, MONOTONIC_TO_END_CORRELATION = 0.85, 0.6
"""Rank correlation from which on means rise or fall; less is enough where the largest is the first or the last."""
TREND_SIGMAS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Trend:
    """Means of a residual along a coordinate.

    Attributes
    ----------
    at, mean, error
        Coordinate, mean and its standard error over runs [the part's unit], shape `(J,)` each.
    """

    at: FloatArray
    mean: FloatArray
    error: FloatArray

    @property
    def clear(self) -> bool:
        """Whether the means differ by more than their errors."""
        low, high = int(np.argmin(self.mean)), int(np.argmax(self.mean))
        return bool(np.ptp(self.mean) > TREND_SIGMAS * np.hypot(self.error[low], self.error[high]))

    @property
    def order(self) -> float:
        """Rank correlation of means and coordinate, −1 to 1."""
        ranks = np.argsort(np.argsort(self.mean))
        return float(np.corrcoef(ranks, np.arange(self.at.size))[0, 1])

    def words(self, name: str, unit: str, of: str) -> str:
        """Return how the residual goes along it; empty where its means do not differ."""
        if self.at.size < MIN_BINS or not self.clear:
            return ""
        peak = int(np.argmax(np.abs(self.mean)))
        at_end = peak in {0, self.at.size - 1}
        if abs(self.order) >= (MONOTONIC_TO_END_CORRELATION if at_end else MONOTONIC_CORRELATION):
            verb = "grows" if self.order > 0 else "falls"
            return f"{verb} with {name}, from {self._told(0, unit, of)} to {self._told(-1, unit, of)}"
        side = "highest" if self.mean[peak] > 0 else "lowest"
        return f"is {side} at about {two_digits(self.at[peak])}{of}, {_signed_two_digits(self.mean[peak])} {unit}"

    def _told(self, at: int, unit: str, of: str) -> str:
        return f"{_signed_two_digits(self.mean[at])} {unit} at {two_digits(self.at[at])}{of}"


def trend_of(part: GapRegion, domain: str) -> Trend | None:
    """Return the means along what belongs to a domain; None for domains that have no coordinate.

    Means are over runs, each run's blocks weighted by duration; values that are commanded are kept apart, others put
    into bins with equally many blocks.
    """
    if domain not in ("speed", "position", "time", "session", "strain"):
        return None
    inside = list(zip(part.blocks, part.inside, strict=True))
    at = np.concatenate([_domain_values(one, domain)[here] for one, here in inside])
    residual = part.scale * np.concatenate([one.residual[here] for one, here in inside])
    weight = np.concatenate([one.weight[here] for one, here in inside])
    run = np.concatenate([np.full(np.count_nonzero(here), number) for number, (_, here) in enumerate(inside)])
    levels = np.unique(at)
    if levels.size > MAX_BINS:
        edges = np.unique(np.quantile(levels, np.linspace(0.0, 1.0, MAX_BINS + 1)[1:-1]))
        found = np.searchsorted(edges, at, side="right")
    else:
        found = np.searchsorted(levels, at)
    return _binned_means(found, run, at, residual, weight)


def _domain_values(one: ResidualBlocks, domain: str) -> FloatArray:
    match domain:
        case "speed":
            return np.full_like(one.residual, one.speed_mm_s)
        case "position":
            return np.abs(one.position_mm)
        case "time":
            return time_since_start(one)
        case "session":
            return np.full_like(one.residual, one.session_s)
        case _:
            return np.full_like(one.residual, one.strain)


def _binned_means(
    found: IndexArray,
    run: IndexArray,
    at: FloatArray,
    residual: FloatArray,
    weight: FloatArray,
) -> Trend:
    rows: list[Sequence[float]] = []
    for number in np.unique(found).tolist():
        here = found == number
        total = np.bincount(run[here], weight[here])
        seen = total > 0
        means = np.bincount(run[here], weight[here] * residual[here])[seen] / total[seen]
        error = float(means.std(ddof=1) / np.sqrt(means.size)) if means.size > 1 else 0.0
        rows.append((float(np.average(at[here], weights=weight[here])), float(means.mean()), error))
    table = np.array(rows)
    return Trend(table[:, 0], table[:, 1], table[:, 2])


def two_digits(value: float) -> str:
    """Return a number with two digits, or without decimals."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"


def _signed_two_digits(value: float) -> str:
    return (f"{value:+.0f}" if abs(value) >= 100 else f"{value:+.2g}").replace("-", "−")


DECAY_LENGTHS = 80
MIN_STEADY_BLOCKS = 12
"""Least blocks of steady motion that an exponential is looked for in."""
MIN_DECAY_SHARE = 0.5
"""Part of the squares beyond a straight line from which on it is told."""
MAX_DECAY_FRACTION = 0.5
"""One longer than this part of the motion is no more than a bend."""
MIN_SHARE_DIFFERENCE = 0.03
"""Way and time are not told apart where the shares that they explain differ by less."""


@dataclass(frozen=True, slots=True)
class ExponentialDecay:
    """An exponential that is common to runs but for its size.

    Attributes
    ----------
    length, along_way
        Where it has fallen to 37 %: mm of the way, or s where it is one of time.
    other
        The same of the other of the two, where runs do not tell them apart; None where they do.
    start
        Its size at the begin of steady motion, median over runs [the part's unit].
    share
        Part of the squares beyond a straight line that it takes away.
    before, after
        Root mean square beyond a straight line without it and with it [the part's unit].
    """

    length: float
    along_way: bool
    other: float | None
    start: float
    share: float
    before: float
    after: float

    def words(self, unit: str) -> str:
        """Return it as a sentence."""
        way, of_way = ("along the way", "mm") if self.along_way else ("in time", "s")
        as_well, of_other = ("a time of", "s") if self.along_way else ("a way of", "mm")
        other = (
            "" if self.other is None else f" (as these runs go, as well {as_well} {two_digits(self.other)} {of_other})"
        )
        start = f"{self.start:+.2g}".replace("-", "−")
        return (
            f"It dies away {way} from the begin of steady motion, {start} {unit} over {two_digits(self.length)} "
            f"{of_way}{other}. "
            f"Beyond a straight line {two_digits(self.before)} {unit} are left without that exponential, "
            f"{two_digits(self.after)} {unit} with it."
        )


def fit_decay(part: GapRegion) -> ExponentialDecay | None:
    """Return the exponential that steady motion shows most of; None where it explains little or is but a bend."""
    runs = [
        one
        for one in part.blocks
        if one.contact is not Contact.STICKING and _steady_mask(one).sum() >= MIN_STEADY_BLOCKS
    ]
    if not runs:
        return None
    way = _best_decay(runs, [_distance_from_start(one, np.abs(one.position_mm)) for one in runs])
    time = _best_decay(runs, [_distance_from_start(one, one.time_s) for one in runs])
    found, other, along = (way, time, True) if way.share >= time.share - MIN_SHARE_DIFFERENCE else (time, way, False)
    if found.share < MIN_DECAY_SHARE or found.at_end:
        return None
    return ExponentialDecay(
        length=found.length,
        along_way=along,
        other=other.length if found.share - other.share < MIN_SHARE_DIFFERENCE else None,
        start=part.scale * float(np.median(found.starts)),
        share=found.share,
        before=part.scale * float(np.sqrt(found.before / len(runs))),
        after=part.scale * float(np.sqrt(found.before * (1 - found.share) / len(runs))),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _DecayFit:
    length: float
    share: float
    before: float
    starts: FloatArray
    at_end: bool


def _steady_mask(one: ResidualBlocks) -> BoolArray:
    return np.asarray(one.phase == Phase.STEADY, dtype=np.bool_)


def _distance_from_start(one: ResidualBlocks, coordinate: FloatArray) -> FloatArray:
    at = coordinate[_steady_mask(one)]
    return np.asarray(np.abs(at - at[0]), dtype=np.float64)


def _best_decay(runs: Sequence[ResidualBlocks], since: Sequence[FloatArray]) -> _DecayFit:
    span = max(float(one.max()) for one in since)
    shortest = max(min(float(np.median(np.diff(one))) for one in since), 1e-6 * span, 1e-12)
    lengths = np.geomspace(shortest, max(MAX_DECAY_FRACTION * span, 2 * shortest), DECAY_LENGTHS)
    before = np.zeros(len(runs))
    taken, starts = np.zeros((2, len(runs), lengths.size))
    for number, (one, at) in enumerate(zip(runs, since, strict=True)):
        inside = _steady_mask(one)
        root = np.sqrt(one.weight[inside] / one.weight[inside].sum())
        line = np.linalg.qr(root[:, None] * np.stack((np.ones_like(at), at), axis=1))[0]
        values = root * one.residual[inside]
        waves = root[:, None] * np.exp(-at[:, None] / lengths)
        values, waves = (each - line @ (line.T @ each) for each in (values, waves))
        size = np.maximum((waves**2).sum(axis=0), 1e-12)
        along = values @ waves
        before[number] = values @ values
        taken[number], starts[number] = along**2 / size, along / size
    share = taken.sum(axis=0) / max(float(before.sum()), 1e-300)
    best = int(share.argmax())
    at_end = best in {0, lengths.size - 1}
    return _DecayFit(float(lengths[best]), float(share[best]), float(before.sum()), starts[:, best], at_end)


MIN_PERIODIC_SHARE = 0.3
"""Part of all squares from which on a sine is worth telling."""
COMMON_SHARE, MIN_COMMON_SHARE = 0.6, 0.3
"""Part of a gap that other runs tell from which on it is the same in every run, and below which it is not."""
COMMON_PHASE = 0.7
"""Mean of the runs' directions in the period from which on they begin alike."""
ONE_SIGN_SHARE = 0.8

_DOMAIN_PHRASES: Mapping[str, tuple[str, str, str]] = {
    "speed": ("of speed", "speed", " mm/s"),
    "position": ("of the position along the stroke", "position", " mm"),
    "time": ("of the time since the start of a run", "time", " s"),
    "session": ("of the session's time", "session time", " s"),
    "strain": ("of strain", "strain", ""),
    "frequency": ("of frequency", "", ""),
    "transient": ("of starting and stopping", "", ""),
}
"""Domain in words, its coordinate, and the coordinate's unit."""


def dependence_text(where: GapLocation, part: GapRegion) -> str:
    """Return what the residual is above all a function of, how it goes, its sign, and whether runs agree on it."""
    words, name, unit = _DOMAIN_PHRASES.get(where.domain, (f"of {where.domain}", "", ""))
    wave = _periodic_text(part)
    trend = trend_of(part, where.domain) if where.runs != 1 else None
    along = trend.words(name, part.unit, unit) if trend is not None else ""
    decay = None if wave else fit_decay(part)
    said = [
        _agreement_text(where, part, words, bool(wave)),
        wave,
        f"Measured less modelled {along}." if along else "",
        "" if decay is None else decay.words(part.unit),
        _sign_text(part),
    ]
    return " ".join(one for one in said if one)


def _agreement_text(where: GapLocation, part: GapRegion, words: str, periodic: bool) -> str:
    told = where.domain_scores.get(where.domain, 0.0)
    total = sum(float((one.weight * one.deviation**2).sum()) for one in part.blocks)
    share = min(told * total / part.excess, 1.0) if part.excess > 0 else told
    if where.domain == "transient" and share >= MIN_COMMON_SHARE:
        return f"{share:.0%} of it is at changes of velocity and shortly after. {_transient_text(part)}".rstrip()
    if where.domain == "frequency" and share >= MIN_COMMON_SHARE:
        return f"{share:.0%} of it is faster than {FAST_HZ:g} Hz."
    if where.runs == 1:
        return ""
    if share < MIN_COMMON_SHARE and not periodic:
        return "It differs from run to run, and is not clearly a function of anything that runs have in common."
    alike = ", so that it is much the same in every run" if share >= COMMON_SHARE and not periodic else ""
    if where.domain == "session" and not periodic:
        alike = ", so that it changes slowly"
    told_by = "" if periodic else f": runs alike in it tell {share:.0%} of one another{alike}"
    return f"Above all a function {words}{told_by}."


def _sign_text(part: GapRegion) -> str:
    above = whole = 0.0
    for one, inside in zip(part.blocks, part.inside, strict=True):
        squares = (one.weight * one.deviation**2)[inside]
        above += float(squares[one.residual[inside] > 0].sum())
        whole += float(squares.sum())
    share = above / whole if whole > 0 else 0.5
    if share >= ONE_SIGN_SHARE:
        return f"What is measured is higher than the model's {part.channel} nearly everywhere."
    if share <= 1 - ONE_SIGN_SHARE:
        return f"What is measured is lower than the model's {part.channel} nearly everywhere."
    return "It has both signs."


def _transient_text(part: GapRegion) -> str:
    told = [
        f"{mean:+.2g} {part.unit} while {name}".replace("-", "−")
        for phase, name in ((Phase.ACCELERATE, "accelerating"), (Phase.DECELERATE, "braking"))
        if (mean := _mean_residual(part, phase)) is not None
    ]
    return f"On average it is {' and '.join(told)}." if told else ""


def _mean_residual(part: GapRegion, phase: Phase) -> float | None:
    """Return the mean residual of a phase over runs."""
    means = [
        float(np.average(one.residual[here], weights=one.weight[here]))
        for one in part.blocks
        if (here := one.phase == phase).any()
    ]
    return part.scale * float(np.mean(means)) if means else None


def _periodic_text(part: GapRegion) -> str:
    """Return period, amplitude and phase of what is periodic; empty for what is not."""
    in_position, in_time = periodic_shares(part.blocks)
    if max(in_position.max(), in_time.max()) < MIN_PERIODIC_SHARE:
        return ""
    along = in_position.max() >= in_time.max()
    rate = best_wavenumber(part.blocks) if along else float(FREQUENCIES_HZ[np.argmax(in_time)])
    waves = np.array(
        [_wave_amplitude(one, np.abs(one.position_mm) if along else one.time_s, rate) for one in part.blocks]
    )
    place, unit = ("along the stroke", "mm") if along else ("in time", "s")
    periodic = f"It is periodic {place}, {1 / rate:.3g} {unit} long"
    if not waves.any():
        return f"{periodic}, which is more than any run moves steadily."
    size = float(np.median(np.abs(waves[np.abs(waves) > 0]))) * part.scale
    step = abs(waves.sum()) / np.abs(waves).sum()
    begin = "at the same place" if along else "at the same time"
    phase = f", {begin} in every run" if step >= COMMON_PHASE else ", with a phase of its own in each run"
    if along and len({round(one.origin_mm, 1) for one in part.blocks}) > 1:
        # Positions count from where each run begins.
        phase = ""
    return f"{periodic}, with an amplitude of {two_digits(size)} {part.unit}{phase}."


def _wave_amplitude(one: ResidualBlocks, coordinate: FloatArray, rate: float) -> complex:
    """Return the wave of a run's steady motion, 0 for one that holds less than a period."""
    here = one.phase == Phase.STEADY
    if not here.any() or rate * np.ptp(coordinate[here]) < 1:
        return 0j
    weight, deviation = one.weight[here], one.residual[here]
    left = deviation - np.average(deviation, weights=weight)
    turned = np.exp(-2j * np.pi * rate * coordinate[here])
    return complex(2 * np.sum(weight * left * turned) / weight.sum())


_KIND_NAMES = {"coulomb": "Coulomb"}


def location_text(where: GapLocation, blocks: Sequence[ResidualBlocks]) -> str:
    """Return where the excess is, and in which runs it is not; ranges are told where they are not chance."""
    kinds = kinds_with_excess(where, blocks, NOTABLE_SHARE)
    absent = [
        one
        for one in dict.fromkeys(each.kind for each in blocks)
        if _axis_share(where, "protocol", one) < NEGLIGIBLE_SHARE
    ]
    said = f"It is in {_channels_text(where)} of {kinds_text(kinds)}{_speeds_text(where, blocks)}"
    said += _range_text(where.location("strain"), "at shear strains of", "")
    said += _range_text(where.location("position"), "between", " mm of the stroke", joiner="and")
    said += _range_text(where.location("session"), "between", " s of the session", joiner="and")
    said += f", {span}" if (span := phase_span(where)) else ""
    said += _range_text(where.location("band_hz"), "at", " Hz") if where.domain == "frequency" else ""
    said += f"; not in {kinds_text(absent, 'or')}" if absent else ""
    return f"{said}.{_single_run_text(blocks)}"


def kinds_text(kinds: Sequence[str], joiner: str = "and") -> str:
    """Return kinds of run in words."""
    called = [_KIND_NAMES.get(one, one) for one in kinds]
    listed = f" {joiner} ".join([", ".join(called[:-1]), called[-1]]) if len(called) > 1 else called[0]
    return f"{listed} runs"


def _axis_share(where: GapLocation, axis: str, name: str) -> float:
    return where.location(axis).shares.get(name, 0.0)


def _channels_text(where: GapLocation) -> str:
    shares = where.location("channel").shares
    named = sorted((one for one in shares if shares[one] >= NOTABLE_SHARE), key=lambda one: -shares[one])
    named = [one.replace("_", " ") for one in named]
    return "the " + " and the ".join(named) if named else "all channels"


def _speeds_text(where: GapLocation, blocks: Sequence[ResidualBlocks]) -> str:
    found = where.location("speed_mm_s")
    if found.low is None or found.high is None or found.p >= ALPHA:
        return ""
    levels = {one.speed_mm_s for one in blocks if one.contact is not Contact.STICKING}
    if found.low == found.high:
        return f" at {found.low:g} mm/s"
    if found.high >= max(levels):
        return f" at {found.low:g} mm/s and faster"
    if found.low <= min(levels):
        return f" up to {found.high:g} mm/s"
    return f" at {found.low:g} to {found.high:g} mm/s"


def _range_text(found: AxisLocation, before: str, after: str, joiner: str = "to") -> str:
    if found.low is None or found.high is None or found.p >= ALPHA:
        return ""
    if found.low == found.high:
        return f", {before} {found.low:.4g}{after}"
    return f", {before} {found.low:.4g} {joiner} {found.high:.4g}{after}"


def _single_run_text(blocks: Sequence[ResidualBlocks]) -> str:
    excess: dict[str, float] = {}
    for one in blocks:
        excess[one.run_id] = excess.get(one.run_id, 0.0) + float(one.excess.sum())
    if len(excess) == 1:
        return ""
    whole = sum(max(one, 0.0) for one in excess.values())
    most = max(excess, key=lambda name: excess[name])
    return f" Nearly all of it is in one run, {most}." if excess[most] >= DOMINANT_SHARE * whole > 0 else ""


MIN_NONPARAMETRIC_SHARE = 0.5
"""Part of the excess that a law must explain."""
MIN_ADVANTAGE = 1.1
"""A law is told that explains so much more than the effect most like it."""

_LAW_PHRASES: Mapping[str, str] = MappingProxyType(
    {
        "speed": "that depends on the speed alone, in all runs",
        "speed of sliding": "that depends on the speed alone, wherever something slides",
        "speed in the gut": "that depends on the speed alone, in the gut",
        "place": "that depends on the position alone, in all runs that slide or touch nothing",
        "place in the gut": "that depends on the position alone, in the gut",
        "time at rest": "that depends on the time at rest alone, in all runs",
        "time at rest in the gut": "that depends on the time at rest alone, in the gut",
        "time since start and stop": "that depends on the time since start and stop alone, in all runs",
        "time since start and stop in the gut": "that depends on the time since start and stop alone, in the gut",
        "load": "that depends on the load alone",
        "session": "that depends on the session's time alone",
        "gain of a run": "whose gain differs from run to run",
        "swing in all runs": "that swings on the session's clock, in all runs",
    }
)
"""Laws in words."""


def nonparametric_law_text(found: DecisionInputs) -> str:
    """Return a sentence on the law without a name that explains more than any effect; empty where none does."""
    if not found.nameless:
        return ""
    law = found.nameless[0]
    best = min((one for one in found.tried if len(one.effects) == 1), key=lambda one: one.flexible, default=None)
    gain, other = found.squares - law.squares, 0.0 if best is None else max(found.squares - best.flexible, 0.0)
    if gain < MIN_NONPARAMETRIC_SHARE * max(found.excess, 1.0) or gain < MIN_ADVANTAGE * other:
        return ""
    beside = "" if best is None else f"; {_effect_name(best.effects[0])}, in any form, {_share_of_excess(other, found)}"
    return f"A force {_LAW_PHRASES[law.law]}, in whatever way, explains {_share_of_excess(gain, found)} of it{beside}."


def _effect_name(effect: str) -> str:
    known = catalogue()
    return known[effect].name if effect in known else effect.replace("_", " ")


def _share_of_excess(gain: float, found: DecisionInputs) -> str:
    return f"{min(gain / max(found.excess, 1.0), 1.0):.0%}"


def line_texts(line: SpectralLine, channel: str) -> tuple[str, str]:
    """Return where a line is that no effect of the catalogue explains, and how it goes."""
    there = f"It is in the {channel.replace('_', ' ')}, also while the stage stands still"
    how = (
        f"A swing at about {line.frequency_hz:.3g} Hz with an amplitude of some {line.amplitude:.2g} mN, "
        "looked for at rest and in holds. What else there may be cannot be told beside it"
    )
    return f"{there}.", f"{how}."


NOT_LOCALISABLE = "It is too small beside noise and the scatter of repeats to say where it is."
"""Of a gap that many runs show together, and none of its parts alone."""


def describe_unexplained_gap(
    where: GapLocation,
    blocks: Sequence[ResidualBlocks],
    judged: Classification,
    swing: SpectralLine | None,
    evidence: DecisionInputs,
) -> UnexplainedGap | None:
    """Return where it is, what it depends on and a law of it; None where everything is explained.

    Parameters
    ----------
    swing
        The line that made the verdict `unknown`, where one did.
    """
    if judged.verdict is not Verdict.UNKNOWN and not judged.residual_unknown:
        return None
    if swing is not None:
        return UnexplainedGap(*line_texts(swing, blocks[0].channel))
    if where.runs > 1 and not any(where.location("channel").shares.values()):
        return UnexplainedGap(NOT_LOCALISABLE, nonparametric_law_text(evidence))
    part = gap_region(where, blocks)
    law = fit_gap_law(part)
    whole = judged.verdict is Verdict.UNKNOWN and not evidence.strays
    said = (dependence_text(where, part), nonparametric_law_text(evidence) if whole else "")
    return UnexplainedGap(
        lives_in=location_text(where, blocks),
        shape=" ".join(one for one in said if one),
        expression="" if law is None else law.text,
        held_out=None if law is None else law.held_out,
    )
