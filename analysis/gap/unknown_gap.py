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
    coordinate, mean, error
        Coordinate, mean and its standard error over runs [the part's unit], shape `(J,)` each.
    """

    coordinate: FloatArray
    mean: FloatArray
    error: FloatArray

    @property
    def clear(self) -> bool:
        """Whether the means differ by more than their errors."""
        low, high = int(np.argmin(self.mean)), int(np.argmax(self.mean))
        return bool(np.ptp(self.mean) > TREND_SIGMAS * np.hypot(self.error[low], self.error[high]))

    @property
    def rank_correlation(self) -> float:
        """Rank correlation of means and coordinate, −1 to 1."""
        ranks = np.argsort(np.argsort(self.mean))
        return float(np.corrcoef(ranks, np.arange(self.coordinate.size))[0, 1])

    def text(self, name: str, unit: str, coordinate_unit: str) -> str:
        """Return how the residual goes along it; empty where its means do not differ."""
        if self.coordinate.size < MIN_BINS or not self.clear:
            return ""
        peak = int(np.argmax(np.abs(self.mean)))
        at_end = peak in {0, self.coordinate.size - 1}
        if abs(self.rank_correlation) >= (MONOTONIC_TO_END_CORRELATION if at_end else MONOTONIC_CORRELATION):
            verb = "grows" if self.rank_correlation > 0 else "falls"
            first, last = (self._at_bin(index, unit, coordinate_unit) for index in (0, -1))
            return f"{verb} with {name}, from {first} to {last}"
        side = "highest" if self.mean[peak] > 0 else "lowest"
        place = f"{two_digits(self.coordinate[peak])}{coordinate_unit}"
        return f"is {side} at about {place}, {_signed_two_digits(self.mean[peak])} {unit}"

    def _at_bin(self, at: int, unit: str, coordinate_unit: str) -> str:
        return f"{_signed_two_digits(self.mean[at])} {unit} at {two_digits(self.coordinate[at])}{coordinate_unit}"


def trend_of(region: GapRegion, domain: str) -> Trend | None:
    """Return the means along what belongs to a domain; None for domains that have no coordinate.

    Means are over runs, each run's blocks weighted by duration; values that are commanded are kept apart, others put
    into bins with equally many blocks.
    """
    if domain not in ("speed", "position", "time", "session", "strain"):
        return None
    inside = list(zip(region.blocks, region.masks, strict=True))
    at = np.concatenate([_domain_values(blocks, domain)[here] for blocks, here in inside])
    residual = region.unit_factor * np.concatenate([blocks.residual[here] for blocks, here in inside])
    weight = np.concatenate([blocks.weight[here] for blocks, here in inside])
    run = np.concatenate([np.full(np.count_nonzero(here), number) for number, (_, here) in enumerate(inside)])
    levels = np.unique(at)
    if levels.size > MAX_BINS:
        edges = np.unique(np.quantile(levels, np.linspace(0.0, 1.0, MAX_BINS + 1)[1:-1]))
        result = np.searchsorted(edges, at, side="right")
    else:
        result = np.searchsorted(levels, at)
    return _binned_means(result, run, at, residual, weight)


def _domain_values(blocks: ResidualBlocks, domain: str) -> FloatArray:
    match domain:
        case "speed":
            return np.full_like(blocks.residual, blocks.speed_mm_s)
        case "position":
            return np.abs(blocks.position_mm)
        case "time":
            return time_since_start(blocks)
        case "session":
            return np.full_like(blocks.residual, blocks.session_s)
        case _:
            return np.full_like(blocks.residual, blocks.strain)


def _binned_means(
    result: IndexArray,
    run: IndexArray,
    at: FloatArray,
    residual: FloatArray,
    weight: FloatArray,
) -> Trend:
    rows: list[Sequence[float]] = []
    for number in np.unique(result).tolist():
        here = result == number
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
    alternative_length
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
    alternative_length: float | None
    start: float
    share: float
    before: float
    after: float

    def text(self, unit: str) -> str:
        """Return it as a sentence."""
        way, of_way = ("along the way", "mm") if self.along_way else ("in time", "s")
        as_well, of_other = ("a time of", "s") if self.along_way else ("a way of", "mm")
        name = (
            ""
            if self.alternative_length is None
            else f" (as these runs go, as well {as_well} {two_digits(self.alternative_length)} {of_other})"
        )
        start = f"{self.start:+.2g}".replace("-", "−")
        return (
            f"It dies away {way} from the begin of steady motion, {start} {unit} over {two_digits(self.length)} "
            f"{of_way}{name}. "
            f"Beyond a straight line {two_digits(self.before)} {unit} are left without that exponential, "
            f"{two_digits(self.after)} {unit} with it."
        )


def fit_decay(region: GapRegion) -> ExponentialDecay | None:
    """Return the exponential that steady motion shows most of; None where it explains little or is but a bend."""
    runs = [
        blocks
        for blocks in region.blocks
        if blocks.contact is not Contact.STICKING and _steady_mask(blocks).sum() >= MIN_STEADY_BLOCKS
    ]
    if not runs:
        return None
    way = _best_decay(runs, [_distance_from_start(blocks, np.abs(blocks.position_mm)) for blocks in runs])
    time = _best_decay(runs, [_distance_from_start(blocks, blocks.time_s) for blocks in runs])
    fit, other, along = (way, time, True) if way.share >= time.share - MIN_SHARE_DIFFERENCE else (time, way, False)
    if fit.share < MIN_DECAY_SHARE or fit.at_end:
        return None
    return ExponentialDecay(
        length=fit.length,
        along_way=along,
        alternative_length=other.length if fit.share - other.share < MIN_SHARE_DIFFERENCE else None,
        start=region.unit_factor * float(np.median(fit.starts)),
        share=fit.share,
        before=region.unit_factor * float(np.sqrt(fit.before / len(runs))),
        after=region.unit_factor * float(np.sqrt(fit.before * (1 - fit.share) / len(runs))),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _DecayFit:
    length: float
    share: float
    before: float
    starts: FloatArray
    at_end: bool


def _steady_mask(blocks: ResidualBlocks) -> BoolArray:
    return np.asarray(blocks.phase == Phase.STEADY, dtype=np.bool_)


def _distance_from_start(blocks: ResidualBlocks, coordinate: FloatArray) -> FloatArray:
    at = coordinate[_steady_mask(blocks)]
    return np.asarray(np.abs(at - at[0]), dtype=np.float64)


def _best_decay(runs: Sequence[ResidualBlocks], since: Sequence[FloatArray]) -> _DecayFit:
    span = max(float(array.max()) for array in since)
    shortest = max(min(float(np.median(np.diff(array))) for array in since), 1e-6 * span, 1e-12)
    lengths = np.geomspace(shortest, max(MAX_DECAY_FRACTION * span, 2 * shortest), DECAY_LENGTHS)
    before = np.zeros(len(runs))
    taken, starts = np.zeros((2, len(runs), lengths.size))
    for number, (blocks, at) in enumerate(zip(runs, since, strict=True)):
        inside = _steady_mask(blocks)
        root = np.sqrt(blocks.weight[inside] / blocks.weight[inside].sum())
        line = np.linalg.qr(root[:, None] * np.stack((np.ones_like(at), at), axis=1))[0]
        values = root * blocks.residual[inside]
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


def dependence_text(where: GapLocation, region: GapRegion) -> str:
    """Return what the residual is above all a function of, how it goes, its sign, and whether runs agree on it."""
    words, name, unit = _DOMAIN_PHRASES.get(where.domain, (f"of {where.domain}", "", ""))
    wave = _periodic_text(region)
    trend = trend_of(region, where.domain) if where.runs != 1 else None
    along = trend.text(name, region.unit, unit) if trend is not None else ""
    decay = None if wave else fit_decay(region)
    said = [
        _agreement_text(where, region, words, bool(wave)),
        wave,
        f"Measured less modelled {along}." if along else "",
        "" if decay is None else decay.text(region.unit),
        _sign_text(region),
    ]
    return " ".join(label for label in said if label)


def _agreement_text(where: GapLocation, region: GapRegion, words: str, periodic: bool) -> str:
    value = where.domain_scores.get(where.domain, 0.0)
    total = sum(float((blocks.weight * blocks.deviation**2).sum()) for blocks in region.blocks)
    share = min(value * total / region.excess, 1.0) if region.excess > 0 else value
    if where.domain == "transient" and share >= MIN_COMMON_SHARE:
        return f"{share:.0%} of it is at changes of velocity and shortly after. {_transient_text(region)}".rstrip()
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


def _sign_text(region: GapRegion) -> str:
    above = whole = 0.0
    for blocks, inside in zip(region.blocks, region.masks, strict=True):
        squares = (blocks.weight * blocks.deviation**2)[inside]
        above += float(squares[blocks.residual[inside] > 0].sum())
        whole += float(squares.sum())
    share = above / whole if whole > 0 else 0.5
    if share >= ONE_SIGN_SHARE:
        return f"What is measured is higher than the model's {region.channel} nearly everywhere."
    if share <= 1 - ONE_SIGN_SHARE:
        return f"What is measured is lower than the model's {region.channel} nearly everywhere."
    return "It has both signs."


def _transient_text(region: GapRegion) -> str:
    told = [
        f"{mean:+.2g} {region.unit} while {name}".replace("-", "−")
        for phase, name in ((Phase.ACCELERATE, "accelerating"), (Phase.DECELERATE, "braking"))
        if (mean := _mean_residual(region, phase)) is not None
    ]
    return f"On average it is {' and '.join(told)}." if told else ""


def _mean_residual(region: GapRegion, phase: Phase) -> float | None:
    """Return the mean residual of a phase over runs."""
    means = [
        float(np.average(blocks.residual[here], weights=blocks.weight[here]))
        for blocks in region.blocks
        if (here := blocks.phase == phase).any()
    ]
    return region.unit_factor * float(np.mean(means)) if means else None


def _periodic_text(region: GapRegion) -> str:
    """Return period, amplitude and phase of what is periodic; empty for what is not."""
    in_position, in_time = periodic_shares(region.blocks)
    if max(in_position.max(), in_time.max()) < MIN_PERIODIC_SHARE:
        return ""
    along = in_position.max() >= in_time.max()
    rate = best_wavenumber(region.blocks) if along else float(FREQUENCIES_HZ[np.argmax(in_time)])
    waves = np.array(
        [
            _wave_amplitude(blocks, np.abs(blocks.position_mm) if along else blocks.time_s, rate)
            for blocks in region.blocks
        ]
    )
    place, unit = ("along the stroke", "mm") if along else ("in time", "s")
    periodic = f"It is periodic {place}, {1 / rate:.3g} {unit} long"
    if not waves.any():
        return f"{periodic}, which is more than any run moves steadily."
    size = float(np.median(np.abs(waves[np.abs(waves) > 0]))) * region.unit_factor
    step = abs(waves.sum()) / np.abs(waves).sum()
    begin = "at the same place" if along else "at the same time"
    phase = f", {begin} in every run" if step >= COMMON_PHASE else ", with a phase of its own in each run"
    if along and len({round(blocks.origin_mm, 1) for blocks in region.blocks}) > 1:
        # Positions count from where each run begins.
        phase = ""
    return f"{periodic}, with an amplitude of {two_digits(size)} {region.unit}{phase}."


def _wave_amplitude(blocks: ResidualBlocks, coordinate: FloatArray, rate: float) -> complex:
    """Return the wave of a run's steady motion, 0 for one that holds less than a period."""
    here = blocks.phase == Phase.STEADY
    if not here.any() or rate * np.ptp(coordinate[here]) < 1:
        return 0j
    weight, deviation = blocks.weight[here], blocks.residual[here]
    left = deviation - np.average(deviation, weights=weight)
    turned = np.exp(-2j * np.pi * rate * coordinate[here])
    return complex(2 * np.sum(weight * left * turned) / weight.sum())


_KIND_NAMES = {"coulomb": "Coulomb"}


def location_text(where: GapLocation, blocks: Sequence[ResidualBlocks]) -> str:
    """Return where the excess is, and in which runs it is not; ranges are told where they are not chance."""
    kinds = kinds_with_excess(where, blocks, NOTABLE_SHARE)
    absent = [
        name
        for name in dict.fromkeys(run.kind for run in blocks)
        if _axis_share(where, "protocol", name) < NEGLIGIBLE_SHARE
    ]
    text = f"It is in {_channels_text(where)} of {kinds_text(kinds)}{_speeds_text(where, blocks)}"
    text += _range_text(where.location("strain"), "at shear strains of", "")
    text += _range_text(where.location("position"), "between", " mm of the stroke", joiner="and")
    text += _range_text(where.location("session"), "between", " s of the session", joiner="and")
    text += f", {span}" if (span := phase_span(where)) else ""
    text += _range_text(where.location("band_hz"), "at", " Hz") if where.domain == "frequency" else ""
    text += f"; not in {kinds_text(absent, 'or')}" if absent else ""
    return f"{text}.{_single_run_text(blocks)}"


def kinds_text(kinds: Sequence[str], joiner: str = "and") -> str:
    """Return kinds of run in words."""
    called = [_KIND_NAMES.get(name, name) for name in kinds]
    listed = f" {joiner} ".join([", ".join(called[:-1]), called[-1]]) if len(called) > 1 else called[0]
    return f"{listed} runs"


def _axis_share(where: GapLocation, axis: str, name: str) -> float:
    return where.location(axis).shares.get(name, 0.0)


def _channels_text(where: GapLocation) -> str:
    shares = where.location("channel").shares
    named = sorted((name for name in shares if shares[name] >= NOTABLE_SHARE), key=lambda name: -shares[name])
    named = [name.replace("_", " ") for name in named]
    return "the " + " and the ".join(named) if named else "all channels"


def _speeds_text(where: GapLocation, blocks: Sequence[ResidualBlocks]) -> str:
    location = where.location("speed_mm_s")
    if location.low is None or location.high is None or location.p >= ALPHA:
        return ""
    levels = {run.speed_mm_s for run in blocks if run.contact is not Contact.STICKING}
    if location.low == location.high:
        return f" at {location.low:g} mm/s"
    if location.high >= max(levels):
        return f" at {location.low:g} mm/s and faster"
    if location.low <= min(levels):
        return f" up to {location.high:g} mm/s"
    return f" at {location.low:g} to {location.high:g} mm/s"


def _range_text(location: AxisLocation, before: str, after: str, joiner: str = "to") -> str:
    if location.low is None or location.high is None or location.p >= ALPHA:
        return ""
    if location.low == location.high:
        return f", {before} {location.low:.4g}{after}"
    return f", {before} {location.low:.4g} {joiner} {location.high:.4g}{after}"


def _single_run_text(blocks: Sequence[ResidualBlocks]) -> str:
    excess: dict[str, float] = {}
    for run in blocks:
        excess[run.run_id] = excess.get(run.run_id, 0.0) + float(run.excess.sum())
    if len(excess) == 1:
        return ""
    whole = sum(max(value, 0.0) for value in excess.values())
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


def nonparametric_law_text(inputs: DecisionInputs) -> str:
    """Return a sentence on the law without a name that explains more than any effect; empty where none does."""
    if not inputs.laws:
        return ""
    law = inputs.laws[0]
    best = min(
        (hypothesis for hypothesis in inputs.hypotheses if len(hypothesis.effects) == 1),
        key=lambda hypothesis: hypothesis.chi2_with_form_error,
        default=None,
    )
    gain, value = inputs.chi2 - law.chi2, 0.0 if best is None else max(inputs.chi2 - best.chi2_with_form_error, 0.0)
    if gain < MIN_NONPARAMETRIC_SHARE * max(inputs.excess, 1.0) or gain < MIN_ADVANTAGE * value:
        return ""
    beside = (
        "" if best is None else f"; {_effect_name(best.effects[0])}, in any form, {_share_of_excess(value, inputs)}"
    )
    return (
        f"A force {_LAW_PHRASES[law.name]}, in whatever way, explains {_share_of_excess(gain, inputs)} of it{beside}."
    )


def _effect_name(effect: str) -> str:
    known = catalogue()
    return known[effect].name if effect in known else effect.replace("_", " ")


def _share_of_excess(gain: float, inputs: DecisionInputs) -> str:
    return f"{min(gain / max(inputs.excess, 1.0), 1.0):.0%}"


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
    classification: Classification,
    line: SpectralLine | None,
    inputs: DecisionInputs,
) -> UnexplainedGap | None:
    """Return where it is, what it depends on and a law of it; None where everything is explained.

    Parameters
    ----------
    line
        The line that made the verdict `unknown`, where one did.
    """
    if classification.verdict is not Verdict.UNKNOWN and not classification.residual_unknown:
        return None
    if line is not None:
        return UnexplainedGap(*line_texts(line, blocks[0].channel))
    if where.runs > 1 and not any(where.location("channel").shares.values()):
        return UnexplainedGap(NOT_LOCALISABLE, nonparametric_law_text(inputs))
    region = gap_region(where, blocks)
    law = fit_gap_law(region)
    whole = classification.verdict is Verdict.UNKNOWN and not inputs.has_position_error
    said = (dependence_text(where, region), nonparametric_law_text(inputs) if whole else "")
    return UnexplainedGap(
        location=location_text(where, blocks),
        dependence=" ".join(name for name in said if name),
        expression="" if law is None else law.text,
        held_out_share=None if law is None else law.held_out_share,
    )
