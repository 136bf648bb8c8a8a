"""Description of a gap that no effect of the catalogue explains: where it is, its dependence, and a law."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from dragrig.analysis import ForceBurst, capitalise, percent_text
from dragrig.analysis.gap.diagnosis import (
    AxisLocation,
    GapLocation,
    UnexplainedGap,
    Verdict,
    display_name,
)
from dragrig.analysis.gap.excess import ResidualBlocks
from dragrig.analysis.gap.features import DecisionInputs
from dragrig.analysis.gap.localise import FAST_HZ, FREQUENCIES_HZ, best_wavenumber, periodic_shares
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
from dragrig.rig import BoolArray, Contact, FloatArray, IndexArray, Phase

MAX_BINS, MIN_BINS = 10, 3
MONOTONIC_CORRELATION, MONOTONIC_TO_END_CORRELATION = 0.85, 0.6
"""Rank correlation above which means rise or fall; a smaller one suffices if the largest is at an end."""
TREND_SIGMAS = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Trend:
    """Mean residuals along a coordinate."""

    coordinate: FloatArray
    mean: FloatArray
    error: FloatArray
    """`coordinate`, `mean`, `error`: coordinate, mean and its standard error over runs [the region's unit], shape
    `(J,)` each.
    """

    @property
    def clear(self) -> bool:
        """Whether the means differ by more than their errors."""
        low, high = int(np.argmin(self.mean)), int(np.argmax(self.mean))
        return bool(np.ptp(self.mean) > TREND_SIGMAS * np.hypot(self.error[low], self.error[high]))

    @property
    def rank_correlation(self) -> float:
        """Rank correlation of means and coordinate, -1 to 1."""
        ranks = np.argsort(np.argsort(self.mean))
        return float(np.corrcoef(ranks, np.arange(self.coordinate.size))[0, 1])

    def text(self, name: str, unit: str, coordinate_unit: str) -> str:
        """Describe how the residual depends on the coordinate; empty where its means do not differ."""
        if self.coordinate.size < MIN_BINS or not self.clear:
            return ""
        peak = int(np.argmax(np.abs(self.mean)))
        at_end = peak in {0, self.coordinate.size - 1}
        if abs(self.rank_correlation) >= (MONOTONIC_TO_END_CORRELATION if at_end else MONOTONIC_CORRELATION):
            verb = "grows" if self.rank_correlation > 0 else "falls"
            first, last = (
                f"{_signed_two_digits(mean)} {unit} at {two_digits(coordinate)}{coordinate_unit}"
                for mean, coordinate in ((self.mean[index], self.coordinate[index]) for index in (0, -1))
            )
            return f"{verb} with {name}, from {first} to {last}"
        side = "highest" if self.mean[peak] > 0 else "lowest"
        place = f"{two_digits(self.coordinate[peak])}{coordinate_unit}"
        return f"is {side} at about {place}, {_signed_two_digits(self.mean[peak])} {unit}"


def trend_of(region: GapRegion, domain: str) -> Trend | None:
    """Return the mean residuals along the coordinate of a domain; None for domains without one.

    Means are over runs, each run's blocks weighted by duration. Commanded values are bins of their own, others are
    binned with equal numbers of blocks.
    """
    if domain not in ("speed", "position", "time", "session", "strain"):
        return None
    masked = list(zip(region.blocks, region.masks, strict=True))
    coordinate = np.concatenate([_domain_values(blocks, domain)[mask] for blocks, mask in masked])
    residual = region.unit_factor * np.concatenate([blocks.residual[mask] for blocks, mask in masked])
    weight = np.concatenate([blocks.weight[mask] for blocks, mask in masked])
    run = np.concatenate([np.full(np.count_nonzero(mask), number) for number, (_, mask) in enumerate(masked)])
    levels = np.unique(coordinate)
    if levels.size > MAX_BINS:
        edges = np.unique(np.quantile(levels, np.linspace(0.0, 1.0, MAX_BINS + 1)[1:-1]))
        bins = np.searchsorted(edges, coordinate, side="right")
    else:
        bins = np.searchsorted(levels, coordinate)
    return _binned_means(bins, run, coordinate, residual, weight)


def _domain_values(blocks: ResidualBlocks, domain: str) -> FloatArray:
    match domain:
        case "speed":
            return np.full_like(blocks.residual, blocks.speed_mm_s)
        case "position":
            return np.abs(blocks.position_mm)
        case "time":
            return time_since_start(blocks)
        case "session":
            return np.full_like(blocks.residual, (blocks.session_s or 0.0) / 60)
        case _:
            return np.full_like(blocks.residual, blocks.strain)


def _binned_means(
    bins: IndexArray, run: IndexArray, coordinate: FloatArray, residual: FloatArray, weight: FloatArray
) -> Trend:
    rows: list[Sequence[float]] = []
    for number in np.unique(bins).tolist():
        mask = bins == number
        total = np.bincount(run[mask], weight[mask])
        present = total > 0
        means = np.bincount(run[mask], weight[mask] * residual[mask])[present] / total[present]
        error = float(means.std(ddof=1) / np.sqrt(means.size)) if means.size > 1 else 0.0
        rows.append((float(np.average(coordinate[mask], weights=weight[mask])), float(means.mean()), error))
    table = np.array(rows)
    return Trend(table[:, 0], table[:, 1], table[:, 2])


def two_digits(value: float) -> str:
    """Return a number with two digits, or without decimals."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"


def _signed_two_digits(value: float) -> str:
    return (f"{value:+.0f}" if abs(value) >= 100 else f"{value:+.2g}").replace("-", "−")


DECAY_LENGTHS = 80
MIN_STEADY_BLOCKS = 12
"""Fewest blocks of steady motion for an exponential."""
MIN_DECAY_SHARE = 0.5
"""Smallest share of the squares beyond a straight line that an exponential must explain."""
MAX_DECAY_FRACTION = 0.5
"""An exponential longer than this fraction of the motion is no more than curvature."""
MAX_EXTRAPOLATION = 2.0
"""An exponential that begins at more than this many times the range of what is measured is not described."""
MIN_SHARE_DIFFERENCE = 0.03
"""Travel and time are not separable where their explained shares differ by less."""


@dataclass(frozen=True, slots=True)
class ExponentialDecay:
    """An exponential shared by all runs except for its amplitude."""

    length: float
    along_way: bool
    """`length`, `along_way`: decay length to 37 %: mm of travel, or s of time."""
    alternative_length: float | None
    """Decay length of the other coordinate where both fit equally well; otherwise None."""
    start: float
    """Amplitude at the begin of steady motion, median over runs [the region's unit]."""
    share: float
    """Explained share of the squares beyond a straight line."""
    before: float
    after: float
    """`before`, `after`: rms beyond a straight line without and with the exponential [the region's unit]."""

    def text(self, unit: str) -> str:
        """Describe it in sentences."""
        coordinate, length_unit = ("along the travel", "mm") if self.along_way else ("in time", "s")
        other_coordinate, other_unit = ("over a time of", "s") if self.along_way else ("over a travel of", "mm")
        alternative = (
            ""
            if self.alternative_length is None
            else f" (these runs fit equally well {other_coordinate} {two_digits(self.alternative_length)} {other_unit})"
        )
        start = f"{self.start:+.2g}".replace("-", "−")
        return (
            f"It decays exponentially {coordinate} from the begin of steady motion, {start} {unit} "
            f"over {two_digits(self.length)} {length_unit}{alternative}. "
            f"Residual (rms) beyond a straight line: {two_digits(self.before)} {unit} without this exponential, "
            f"{two_digits(self.after)} {unit} with it."
        )


def fit_decay(region: GapRegion) -> ExponentialDecay | None:
    """Return the best exponential in steady motion; None where it explains little or is only curvature."""
    runs = [
        blocks
        for blocks in region.blocks
        if blocks.contact is not Contact.STICKING and _steady_mask(blocks).sum() >= MIN_STEADY_BLOCKS
    ]
    if not runs:
        return None
    ways_mm = [np.cumsum(np.abs(np.diff(blocks.position_mm, prepend=blocks.position_mm[0]))) for blocks in runs]
    in_travel = _best_decay(runs, [_distance_from_start(*pair) for pair in zip(runs, ways_mm, strict=True)])
    in_time = _best_decay(runs, [_distance_from_start(blocks, blocks.time_s) for blocks in runs])
    fit, alternative, along_way = (
        (in_travel, in_time, True)
        if in_travel.share >= in_time.share - MIN_SHARE_DIFFERENCE
        else (in_time, in_travel, False)
    )
    if fit.share < MIN_DECAY_SHARE or fit.at_end:
        return None
    largest = max(float(np.ptp(blocks.residual[_steady_mask(blocks)])) for blocks in runs)
    if abs(float(np.median(fit.starts))) > MAX_EXTRAPOLATION * largest:
        return None
    return ExponentialDecay(
        length=fit.length,
        along_way=along_way,
        alternative_length=alternative.length if fit.share - alternative.share < MIN_SHARE_DIFFERENCE else None,
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
    steady = coordinate[_steady_mask(blocks)]
    return np.asarray(np.abs(steady - steady[0]), dtype=np.float64)


def _best_decay(runs: Sequence[ResidualBlocks], distances: Sequence[FloatArray]) -> _DecayFit:
    span = max(float(distance.max()) for distance in distances)
    # Blocks of a standstill are no way made.
    steps = [np.diff(distance) for distance in distances]
    shortest = max(min(float(np.median(step[step >= 0.01 * step.mean()])) for step in steps), 1e-6 * span, 1e-12)
    lengths = np.geomspace(shortest, max(MAX_DECAY_FRACTION * span, 2 * shortest), DECAY_LENGTHS)
    before = np.zeros(len(runs))
    explained, starts = np.zeros((2, len(runs), lengths.size))
    for number, (blocks, distance_of_run) in enumerate(zip(runs, distances, strict=True)):
        steady = _steady_mask(blocks)
        root = np.sqrt(blocks.weight[steady] / blocks.weight[steady].sum())
        line = np.linalg.qr(root[:, None] * np.stack((np.ones_like(distance_of_run), distance_of_run), axis=1))[0]
        values = root * blocks.residual[steady]
        exponentials = root[:, None] * np.exp(-distance_of_run[:, None] / lengths)
        values, exponentials = (columns - line @ (line.T @ columns) for columns in (values, exponentials))
        size = np.maximum((exponentials**2).sum(axis=0), 1e-12)
        moment = values @ exponentials
        before[number] = values @ values
        explained[number], starts[number] = moment**2 / size, moment / size
    share = explained.sum(axis=0) / max(float(before.sum()), 1e-300)
    best = int(share.argmax())
    at_end = best in {0, lengths.size - 1}
    return _DecayFit(float(lengths[best]), float(share[best]), float(before.sum()), starts[:, best], at_end)


MIN_PERIODIC_SHARE = 0.3
"""Smallest share of all squares for a sine to be reported."""
COMMON_SHARE, MIN_COMMON_SHARE = 0.6, 0.3
"""Share predicted from other runs above which a gap is equal in all runs, and below which it is not common."""
COMMON_PHASE = 0.7
"""Mean resultant length of the runs' phases above which they are equal."""
ONE_SIGN_SHARE = 0.8

_DOMAIN_PHRASES: Mapping[str, tuple[str, str, str]] = {
    "speed": ("of speed", "speed", " mm/s"),
    "position": ("of the position along the stroke", "position", " mm"),
    "time": ("of the time since the start of a run", "time", " s"),
    "session": ("of session time", "session time", " min"),
    "strain": ("of strain", "strain", ""),
    "frequency": ("of frequency", "", ""),
    "transient": ("of changes of velocity", "", ""),
}
"""Phrase for a domain, its coordinate, and the coordinate's unit."""


def dependence_text(where: GapLocation, region: GapRegion) -> str:
    """Describe the dependence of the residual, its sign, and whether runs agree."""
    phrase, name, unit = _DOMAIN_PHRASES.get(where.domain, (f"of {where.domain}", "", ""))
    wave = _periodic_text(region)
    trend = trend_of(region, where.domain) if where.runs != 1 else None
    trend_text = trend.text(name, region.unit, unit) if trend is not None else ""
    decay = None if wave else fit_decay(region)
    sentences = [
        _agreement_text(where, region, phrase, bool(wave)),
        wave,
        f"Measured minus modelled {trend_text}." if trend_text else "",
        "" if decay is None else decay.text(region.unit),
        _sign_text(region),
    ]
    return " ".join(sentence for sentence in sentences if sentence)


def _agreement_text(where: GapLocation, region: GapRegion, phrase: str, periodic: bool) -> str:
    score = where.domain_scores.get(where.domain, 0.0)
    total = sum(float((blocks.weight * blocks.deviation**2).sum()) for blocks in region.blocks)
    share = min(score * total / region.excess, 1.0) if region.excess > 0 else score
    if where.domain == "transient" and share >= MIN_COMMON_SHARE:
        at_changes = f"{capitalise(percent_text(share))} of it is at changes of velocity and shortly after."
        return f"{at_changes} {_transient_text(region)}".rstrip()
    if where.domain == "frequency" and share >= MIN_COMMON_SHARE:
        return f"{capitalise(percent_text(share))} of it is faster than {FAST_HZ:g} Hz."
    if where.runs == 1:
        return ""
    if share < MIN_COMMON_SHARE and not periodic:
        return "It differs from run to run and does not clearly depend on any coordinate that runs share."
    agreement = ", nearly the same in every run" if share >= COMMON_SHARE else ", in part the same in every run"
    if where.domain == "session":
        agreement = ": it changes slowly"
    return f"Mainly a function {phrase}{'' if periodic else agreement}."


def _sign_text(region: GapRegion) -> str:
    positive = total = 0.0
    for blocks, mask in zip(region.blocks, region.masks, strict=True):
        squares = (blocks.weight * blocks.deviation**2)[mask]
        positive += float(squares[blocks.residual[mask] > 0].sum())
        total += float(squares.sum())
    share = positive / total if total > 0 else 0.5
    if share >= ONE_SIGN_SHARE:
        return f"The measured {region.channel} is higher than the modelled one nearly everywhere."
    if share <= 1 - ONE_SIGN_SHARE:
        return f"The measured {region.channel} is lower than the modelled one nearly everywhere."
    return "It has both signs."


def _transient_text(region: GapRegion) -> str:
    """Say the mean residuals over runs in both phases in which the velocity changes."""
    texts = []
    for phase, name in ((Phase.ACCELERATE, "accelerating"), (Phase.DECELERATE, "braking")):
        masked = [(blocks, mask) for blocks in region.blocks if (mask := blocks.phase == phase).any()]
        means = [np.average(blocks.residual[mask], weights=blocks.weight[mask]) for blocks, mask in masked]
        if means:
            mean = region.unit_factor * float(np.mean(means))
            texts.append(f"{mean:+.2g} {region.unit} while {name}".replace("-", "−"))
    return f"On average it is {' and '.join(texts)}." if texts else ""


def _periodic_text(region: GapRegion) -> str:
    """Describe period, amplitude and phase of a periodic residual; empty for others."""
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
    periodic = f"It is periodic {place} with a period of {1 / rate:.3g} {unit}"
    if not waves.any():
        return f"{periodic}, longer than the steady motion of any run."
    amplitude = float(np.median(np.abs(waves[np.abs(waves) > 0]))) * region.unit_factor
    coherence = abs(waves.sum()) / np.abs(waves).sum()
    place_of_phase = "at the same place" if along else "at the same time"
    phase = f", {place_of_phase} in every run" if coherence >= COMMON_PHASE else ", with a different phase in each run"
    if len(region.blocks) == 1 or (along and len({round(blocks.origin_mm, 1) for blocks in region.blocks}) > 1):
        # One run has nothing to agree with; and positions count from where each run begins.
        phase = ""
    return f"{periodic} and an amplitude of {two_digits(amplitude)} {region.unit}{phase}."


def _wave_amplitude(blocks: ResidualBlocks, coordinate: FloatArray, rate: float) -> complex:
    """Return the complex amplitude in a run's steady motion; 0 for less than a period."""
    steady = blocks.phase == Phase.STEADY
    if not steady.any() or rate * np.ptp(coordinate[steady]) < 1:
        return 0j
    weight, deviation = blocks.weight[steady], blocks.residual[steady]
    residual = deviation - np.average(deviation, weights=weight)
    phasor = np.exp(-2j * np.pi * rate * coordinate[steady])
    return complex(2 * np.sum(weight * residual * phasor) / weight.sum())


_KIND_NAMES = {"coulomb": "Coulomb"}


def location_text(where: GapLocation, blocks: Sequence[ResidualBlocks]) -> str:
    """Describe where the excess is, and in which runs it is not; ranges only where significant.

    Where no place stands out beyond chance, excess is only said to be mostly there, and to be nowhere not.
    """
    kinds = kinds_with_excess(where, blocks, NOTABLE_SHARE)
    absent = [
        name
        for name in dict.fromkeys(run.kind for run in blocks)
        if where.location("protocol").shares.get(name, 0.0) < NEGLIGIBLE_SHARE
    ]
    certain = any(location.significant for location in where.locations)
    kinds_of_run = f"{kinds_text(kinds)}{_speeds_text(where)}"
    text = f"It is {'' if certain else 'mostly '}in {_channels_text(where)} of {kinds_of_run}"
    text += _range_text(where.location("strain"), "at shear strains of", "")
    text += _range_text(where.location("position"), "between", " mm of the stroke", joiner="and")
    text += _range_text(where.location("session"), "between", " min of the session", joiner="and", unit=60.0)
    text += f", {span}" if (span := phase_span(where)) else ""
    text += _range_text(where.location("band_hz"), "at", " Hz") if where.domain == "frequency" else ""
    if not certain:
        text += ", though no place stands out beyond chance"
    elif absent:
        text += f"; not in {kinds_text(absent, 'or')}"
    return f"{text}.{_single_run_text(blocks)}"


def kinds_text(kinds: Sequence[str], joiner: str = "and") -> str:
    """Return kinds of run as a phrase."""
    names = [_KIND_NAMES.get(name, name) for name in kinds]
    listed = f" {joiner} ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else names[0]
    return f"{listed} runs"


def _channels_text(where: GapLocation) -> str:
    shares = where.location("channel").shares
    named = sorted((name for name in shares if shares[name] >= NOTABLE_SHARE), key=lambda name: -shares[name])
    named = [name.replace("_", " ") for name in named]
    return "the " + " and the ".join(named) if named else "all channels"


def _speeds_text(where: GapLocation) -> str:
    location = where.location("speed_mm_s")
    if location.low is None or location.high is None or not location.significant:
        return ""
    levels = [axis_bin.low for axis_bin in location.bins if axis_bin.low is not None]
    if location.low == location.high:
        return f" at {location.low:g} mm/s"
    if location.high >= max(levels):
        return f" at {location.low:g} mm/s and faster"
    if location.low <= min(levels):
        return f" up to {location.high:g} mm/s"
    return f" at {location.low:g} to {location.high:g} mm/s"


def _range_text(location: AxisLocation, before: str, after: str, joiner: str = "to", unit: float = 1.0) -> str:
    if location.low is None or location.high is None or not location.significant:
        return ""
    low, high = location.low / unit, location.high / unit
    return f", {before} {low:.3g}{after}" if low == high else f", {before} {low:.3g} {joiner} {high:.3g}{after}"


def _single_run_text(blocks: Sequence[ResidualBlocks]) -> str:
    excess: dict[str, float] = {}
    for run in blocks:
        name = run.file or run.run_id
        excess[name] = excess.get(name, 0.0) + float(run.excess.sum())
    if len(excess) == 1:
        return ""
    total = sum(max(value, 0.0) for value in excess.values())
    largest = max(excess, key=lambda name: excess[name])
    return f" Nearly all of it is in one run, {largest}." if excess[largest] >= DOMINANT_SHARE * total > 0 else ""


MIN_NONPARAMETRIC_SHARE = 0.5
"""Share of the excess that a law must explain."""
MIN_ADVANTAGE = 1.1
"""A law is reported if it explains more than the best effect by this factor."""

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
        "session": "that depends on session time alone",
        "gain of a run": "whose gain differs from run to run",
        "swing in all runs": "that is periodic in session time, in all runs",
    }
)
"""Phrases for nonparametric laws."""


def nonparametric_law_text(inputs: DecisionInputs) -> str:
    """Describe the nonparametric law that explains more than any effect; empty for none."""
    if not inputs.laws:
        return ""
    law = inputs.laws[0]
    best = min(
        (hypothesis for hypothesis in inputs.hypotheses if len(hypothesis.effects) == 1),
        key=lambda hypothesis: hypothesis.chi2_with_form_error,
        default=None,
    )
    law_chi2_difference = inputs.chi2 - law.chi2
    effect_chi2_difference = 0.0 if best is None else max(inputs.chi2 - best.chi2_with_form_error, 0.0)
    if (
        law_chi2_difference < MIN_NONPARAMETRIC_SHARE * max(inputs.excess, 1.0)
        or law_chi2_difference < MIN_ADVANTAGE * effect_chi2_difference
    ):
        return ""
    text = (
        f"By itself, a force {_LAW_PHRASES[law.name]}, in any form, would explain "
        f"{_share_of_excess(law_chi2_difference, inputs)} of it"
    )
    if best is not None:
        effect = display_name(best.effects[0])
        text += f"; {effect}, in any form, {_share_of_excess(effect_chi2_difference, inputs)}"
    return f"{text}."


def _share_of_excess(chi2_difference: float, inputs: DecisionInputs) -> str:
    return percent_text(min(chi2_difference / max(inputs.excess, 1.0), 1.0))


def resemblance_text(inputs: DecisionInputs) -> str:
    """Say which effect the gap looks like, and why these runs do not establish it; empty for none."""
    alike = [
        hypothesis
        for hypothesis in inputs.hypotheses
        if hypothesis.not_established
        and len(hypothesis.effects) == 1
        and 2 * hypothesis.llr > MIN_NONPARAMETRIC_SHARE * max(inputs.excess, 1.0)
    ]
    if not alike:
        return ""
    best = max(alike, key=lambda hypothesis: hypothesis.llr)
    return f"It looks like {display_name(best.effects[0])}, which is not established: {best.not_established}."


NOT_LOCALISABLE = "It shows in many runs together, and in no place of them alone beyond noise and scatter of repeats."
"""Of a gap that many runs show together, and none of its parts alone."""


def describe_unexplained_gap(
    where: GapLocation,
    blocks: Sequence[ResidualBlocks],
    verdict: Verdict,
    line: SpectralLine | None,
    bursts: Sequence[ForceBurst],
    inputs: DecisionInputs,
    *,
    single_condition: bool = False,
) -> UnexplainedGap:
    """Return location, dependence and law of an unexplained gap.

    Parameters
    ----------
    line
        Spectral line because of which the verdict is `unknown`, if any.
    bursts
        Bursts of the force that are the gap, if any.
    single_condition
        Whether all runs are of one condition, which shows a form and no cause that it resembles.
    """
    if line is not None:
        return UnexplainedGap(
            f"It is in the {blocks[0].channel.replace('_', ' ')}, also while the stage is at rest.",
            f"An oscillation at about {line.frequency_hz:.3g} Hz with an amplitude of about {line.amplitude:.2g} mN, "
            "seen at rest and in holds. Other causes cannot be separated from it.",
        )
    localisable = any(where.location("channel").shares.values())
    if bursts:
        heights = [burst.height_mN for burst in bursts]
        typical, ms = two_digits(np.median(heights)), 1e3 * np.median([burst.duration_s for burst in bursts])
        return UnexplainedGap(
            "It is in bursts of the force while the motion is calm, too short for means over blocks to show them.",
            f"{len(bursts)} bursts, typically of {typical} mN for {ms:.0f} ms, up to {two_digits(max(heights))} mN: "
            "look for loose contacts and for what touches the stage.",
        )
    if where.runs > 1 and not localisable:
        return UnexplainedGap(NOT_LOCALISABLE, nonparametric_law_text(inputs))
    region = gap_region(where, blocks)
    law = fit_gap_law(region)
    entirely_unknown = verdict is Verdict.UNKNOWN and not inputs.has_position_error
    sentences = [dependence_text(where, region)]
    if entirely_unknown and not single_condition:
        sentences += [nonparametric_law_text(inputs), resemblance_text(inputs)]
    nowhere = NOT_LOCALISABLE if where.runs > 1 else ""
    return UnexplainedGap(
        location=location_text(where, blocks) if localisable else nowhere,
        dependence=" ".join(sentence for sentence in sentences if sentence),
        expression="" if law is None else law.text,
        held_out_share=None if law is None else law.held_out_share,
    )
