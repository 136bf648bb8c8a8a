"""Excess of residuals over noise and repeatability, in bins fixed beforehand, and its significance by permutation.

Whole runs are permuted, because blocks of one run are not independent. Excess energies have long tails; therefore
their square roots, with sign, are compared. p-values are familywise over all bins of an axis, by the largest statistic
of each permutation (max-T; Westfall and Young, Resampling-Based Multiple Testing, 1993).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from dragrig.analysis import set_values
from dragrig.rig import BoolArray, Contact, FloatArray, IndexArray, Phase, PhaseArray


@dataclass(frozen=True, eq=False)
class ResidualBlocks:
    """Residuals of one channel of one run after the nominal fit: means over `B` blocks."""

    run_id: str
    """Id of the run, shared by its channels."""
    channel: str
    """`force` or `position`."""
    kind: str
    """The run's protocol."""
    contact: Contact
    """Contact between capsule and gut."""
    speed_mm_s: float
    """Commanded top speed."""
    strain: float
    """Commanded shear strain; 0 for none."""
    session_s: float | None
    """Time of the first sample on the session clock; None without a clock."""
    residual: FloatArray
    """Measured minus model [the channel's unit], shape `(B,)`."""
    noise_sd: FloatArray
    """Expected standard deviation without a gap: noise, repeatability and tolerance."""
    duration_s: FloatArray
    """Durations of the blocks."""
    time_s: FloatArray
    """Middles of the blocks, from the first sample on."""
    phase: PhaseArray
    """Phases of the blocks."""
    position_mm: FloatArray
    """Position of the stage, from the first sample on."""
    force_mN: FloatArray | None = None
    """Measured force, shape `(B,)`, where known."""
    explained: FloatArray | None = None
    """Contribution of a known effect [the channel's unit], shape `(B,)`: replaces the residual, and all of it counts as
    excess.
    """
    origin_mm: float = 0.0
    """Where on the machine the run begins."""
    file: str = ""
    """Name of its file, where it has one."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for arrays of unequal lengths, and for noise or durations that are not positive."""
        level = self.residual if self.force_mN is None else self.force_mN
        arrays = (self.residual, self.noise_sd, self.duration_s, self.time_s, self.phase, self.position_mm, level)
        if len({values.shape for values in arrays}) != 1 or self.residual.ndim != 1 or not self.residual.size:
            raise ValueError(f"Blocks of run {self.run_id} differ in their number, or there are none")
        if not (np.isfinite(self.residual).all() and (self.noise_sd > 0).all() and (self.duration_s > 0).all()):
            raise ValueError(
                f"Blocks of run {self.run_id} need finite residuals, positive noise and positive durations"
            )

    @cached_property
    def deviation(self) -> FloatArray:
        """Residual, or its explained part, in expected standard deviations, shape `(B,)`."""
        values = self.residual if self.explained is None else self.explained
        return np.asarray(values / self.noise_sd)

    @cached_property
    def weight(self) -> FloatArray:
        """Share of each block in the run's duration, shape `(B,)`."""
        return np.asarray(self.duration_s / self.duration_s.sum())

    @cached_property
    def excess(self) -> FloatArray:
        """Contribution of each block to the run's mean square deviation above its expectation, shape `(B,)`."""
        return np.asarray(self.weight * (self.deviation**2 - (self.explained is None)))


SESSION_AXIS: Final = "session"

BANDS_HZ: Final = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""Edges of the bands; the mean belongs to none."""

MIN_SPECTRUM_BLOCKS = 4


def band_powers(signal: FloatArray, rate_hz: float) -> FloatArray:
    """Return the mean square of an evenly sampled signal in each band, without its mean, shape `(n,)` to `(bands,)`.

    All bands together have the signal's variance, except above the last edge.
    """
    spectrum = np.abs(np.fft.rfft(signal - signal.mean())) ** 2 / signal.size**2
    spectrum[1:] *= 2.0
    if signal.size % 2 == 0:
        spectrum[-1] /= 2.0
    frequency = np.fft.rfftfreq(signal.size, 1 / rate_hz)
    return np.asarray(np.histogram(frequency[1:], BANDS_HZ, weights=spectrum[1:])[0])


def band_excess(blocks: ResidualBlocks) -> FloatArray:
    """Return the excess of the steady phase by band, relative to the run's expected mean square, shape `(bands,)`.

    Blocks are resampled at their median duration, with white noise.
    """
    steady = blocks.phase == Phase.STEADY
    zeros = np.zeros(len(BANDS_HZ) - 1)
    if not steady.any():
        return zeros
    share = float(blocks.weight[steady].sum())
    step = float(np.median(blocks.duration_s[steady]))
    time, value = blocks.time_s[steady], blocks.deviation[steady]
    count = int((time[-1] - time[0]) / step + 1e-6) + 1
    if count < MIN_SPECTRUM_BLOCKS:
        return zeros
    grid = time[0] + step * np.arange(count)
    nearest = np.clip(np.searchsorted(0.5 * (time[1:] + time[:-1]), grid), 0, time.size - 1)
    lines = np.histogram(np.fft.rfftfreq(count, step)[1:], BANDS_HZ)[0]
    return np.asarray(share * (band_powers(value[nearest], 1 / step) - lines / max(int(lines.sum()), 1)))


CHANNELS = ("force", "position")
PROTOCOLS = ("drag", "coulomb", "relaxation", "blank")
PHASE_NAMES = tuple(phase.name.lower() for phase in Phase)
POSITION_BINS, SESSION_BINS = 10, 8


class ComparisonBasis(StrEnum):
    """The comparison for the excess in a bin."""

    RUNS = "runs"
    """Other runs of the same kind, for bins that contain whole runs."""
    REST = "rest"
    """The rest of the run, for bins with a part of every run."""
    NOISE = "noise"
    """The expectation, for bins that differ in their noise."""


@dataclass(frozen=True, slots=True, eq=False)
class ExcessAxis:
    """One division of the excess of `R` runs into `J` bins."""

    name: str
    """Name in the report."""
    labels: tuple[str, ...]
    """Names of the bins; empty for numeric bins."""
    edges: FloatArray
    """Lower and upper end of each numeric bin, shape `(J, 2)`."""
    energy: FloatArray
    """Excess of each run in each bin, relative to the expected mean square, shape `(R, J)`."""
    duration: FloatArray
    """Share of each run's duration in each bin, shape `(R, J)`."""
    basis: ComparisonBasis
    """The comparison for the excess in a bin."""

    @property
    def ordered(self) -> bool:
        """Whether the bins are ordered."""
        return not self.labels


@dataclass(frozen=True, slots=True, eq=False)
class CampaignResiduals:
    """Blocks of each run and channel, runs in the order of their kinds."""

    ids: tuple[str, ...]
    blocks: tuple[tuple[ResidualBlocks, ...], ...]

    @classmethod
    def of(cls, blocks: Sequence[ResidualBlocks]) -> "CampaignResiduals":
        """Group blocks by run."""
        by_run: dict[str, list[ResidualBlocks]] = {}
        for run in blocks:
            by_run.setdefault(run.run_id, []).append(run)
        names = sorted(by_run, key=lambda name: (by_run[name][0].kind, by_run[name][0].session_s or 0.0, name))
        return cls(tuple(names), tuple(tuple(by_run[name]) for name in names))

    @property
    def first_channels(self) -> tuple[ResidualBlocks, ...]:
        """One channel of each run, for properties of the whole run."""
        return tuple(channels[0] for channels in self.blocks)

    @property
    def energy(self) -> FloatArray:
        """Excess of each run, shape `(R,)`."""
        return np.array([sum(float(blocks.excess.sum()) for blocks in channels) for channels in self.blocks])

    @property
    def kind_index(self) -> IndexArray:
        """Index of each run's kind, ascending, shape `(R,)`."""
        return np.asarray(np.unique([blocks.kind for blocks in self.first_channels], return_inverse=True)[1])


def excess_axes(runs: CampaignResiduals) -> tuple[ExcessAxis, ...]:
    """Return all axes of a campaign."""
    first = runs.first_channels
    moves = np.array([_moves(blocks) for blocks in first])
    return (
        _channel_axis(runs),
        _protocol_axis(runs),
        _phase_axis(runs),
        _axis_by_value("speed_mm_s", runs, np.array([blocks.speed_mm_s for blocks in first]), moves),
        _position_axis(runs),
        *_session_axes(runs),
        _axis_by_value("strain", runs, np.array([blocks.strain for blocks in first]), ~moves),
        _band_axis(runs),
    )


def _channel_axis(runs: CampaignResiduals) -> ExcessAxis:
    names = [blocks.channel for channels in runs.blocks for blocks in channels]
    labels = tuple(dict.fromkeys((*CHANNELS, *names)))
    energy, time = np.zeros((2, len(runs.ids), len(labels)))
    for row, channels in enumerate(runs.blocks):
        for blocks in channels:
            energy[row, labels.index(blocks.channel)] += blocks.excess.sum()
            time[row, labels.index(blocks.channel)] = 1.0
    return ExcessAxis("channel", labels, _no_edges(labels), energy, time, ComparisonBasis.REST)


def _protocol_axis(runs: CampaignResiduals) -> ExcessAxis:
    kinds = [blocks.kind for blocks in runs.first_channels]
    labels = tuple(dict.fromkeys((*PROTOCOLS, *kinds)))
    member = np.array(kinds)[:, None] == np.array(labels)
    return _whole_run_axis("protocol", labels, _no_edges(labels), runs, member)


def _phase_axis(runs: CampaignResiduals) -> ExcessAxis:
    energy, time = _excess_within_runs(runs, lambda blocks: blocks.phase.astype(np.intp), len(PHASE_NAMES))
    return ExcessAxis("phase", PHASE_NAMES, _no_edges(PHASE_NAMES), energy, time, ComparisonBasis.REST)


def has_session_clock(blocks: Sequence[ResidualBlocks]) -> bool:
    """Whether it is known of all runs when in the session they were made."""
    return all(run.session_s is not None for run in blocks)


def _session_axes(runs: CampaignResiduals) -> Iterator[ExcessAxis]:
    """Yield the session axis of runs with a clock."""
    if not has_session_clock(runs.first_channels):
        return
    start = np.array([blocks.session_s for blocks in runs.first_channels], dtype=np.float64)
    edges = np.linspace(float(start.min()), float(start.max()), SESSION_BINS + 1)
    index = np.clip(np.searchsorted(edges, start, side="right") - 1, 0, SESSION_BINS - 1)
    member = index[:, None] == np.arange(SESSION_BINS)
    yield _whole_run_axis(SESSION_AXIS, (), np.stack((edges[:-1], edges[1:]), axis=1), runs, member)


def _position_axis(runs: CampaignResiduals) -> ExcessAxis:
    longest = max(
        (float(np.abs(blocks.position_mm).max()) for blocks in runs.first_channels if _moves(blocks)), default=0.0
    )
    edges = np.linspace(0.0, max(round(longest, 1), 0.1), POSITION_BINS + 1)

    def index(blocks: ResidualBlocks) -> IndexArray:
        bins = np.clip(np.searchsorted(edges, np.abs(blocks.position_mm), side="right") - 1, 0, POSITION_BINS - 1)
        moving = (blocks.phase != Phase.REST) & (blocks.phase != Phase.HOLD)
        return np.asarray(np.where(moving & _moves(blocks), bins, -1))

    energy, time = _excess_within_runs(runs, index, POSITION_BINS)
    return ExcessAxis("position", (), np.stack((edges[:-1], edges[1:]), axis=1), energy, time, ComparisonBasis.REST)


def _band_axis(runs: CampaignResiduals) -> ExcessAxis:
    energy = np.array([np.sum([band_excess(blocks) for blocks in channels], axis=0) for channels in runs.blocks])
    edges = np.stack((BANDS_HZ[:-1], BANDS_HZ[1:]), axis=1)
    return ExcessAxis("band_hz", (), edges, energy, np.ones_like(energy), ComparisonBasis.NOISE)


def _moves(blocks: ResidualBlocks) -> bool:
    return blocks.contact is not Contact.STICKING


def _no_edges(labels: tuple[str, ...]) -> FloatArray:
    return np.full((len(labels), 2), np.nan)


def _axis_by_value(name: str, runs: CampaignResiduals, value: FloatArray, included: BoolArray) -> ExcessAxis:
    included = included & (value > 0)
    value = np.where(included, set_values(value), 0.0)
    levels = np.unique(value[included])
    member = included[:, None] & (value[:, None] == levels)
    shown = np.array([float(f"{level:.4g}") for level in levels])
    return _whole_run_axis(name, (), np.stack((shown, shown), axis=1).reshape(-1, 2), runs, member)


def _whole_run_axis(
    name: str, labels: tuple[str, ...], edges: FloatArray, runs: CampaignResiduals, member: BoolArray
) -> ExcessAxis:
    return ExcessAxis(
        name, labels, edges, runs.energy[:, None] * member, member.astype(np.float64), ComparisonBasis.RUNS
    )


def _excess_within_runs(
    runs: CampaignResiduals, index_of: Callable[[ResidualBlocks], IndexArray], count: int
) -> tuple[FloatArray, FloatArray]:
    """Return excess and share of the duration of each run by bin; index -1 is in no bin."""
    energy, time = np.zeros((2, len(runs.ids), count))
    for row, channels in enumerate(runs.blocks):
        for blocks in channels:
            index = index_of(blocks)
            inside = index >= 0
            energy[row] += np.bincount(index[inside], blocks.excess[inside], count)
            time[row] += np.bincount(index[inside], blocks.weight[inside], count) / len(channels)
    return energy, time


PERMUTATIONS = 999


@dataclass(frozen=True, slots=True, eq=False)
class Significance:
    """Familywise p-values of windows of adjacent bins, or of single bins where they are not ordered."""

    windows: npt.NDArray[np.intp]
    """First and last bin of each window, shape `(K, 2)`."""
    p: FloatArray
    """Probability of a statistic as large anywhere on the axis without a gap, shape `(K,)`."""

    def window_p(self, first: int, last: int) -> float:
        """Return the p-value of a window; 1 for the whole axis."""
        index = np.flatnonzero((self.windows == (first, last)).all(axis=1))
        return float(self.p[index[0]]) if index.size else 1.0

    @property
    def min_p(self) -> float:
        """Smallest p-value, the axis' own."""
        return float(self.p.min(initial=1.0))


def permutation_test(axis: ExcessAxis, stratum: IndexArray, generator: np.random.Generator) -> Significance:
    """Test all windows of an axis.

    Between runs, excess is permuted among runs of one kind (among all for the protocol axis). Within runs, the sign of
    the difference between a window and the rest of its run is flipped run by run. A window with less than the expected
    mean square is never significant.
    """
    windows = _windows(axis)
    if not windows.size:
        return Significance(windows, np.zeros(0))
    bins = np.arange(axis.energy.shape[1])[:, None]
    inside = ((bins >= windows[:, 0]) & (bins <= windows[:, 1])).astype(np.float64)
    if axis.basis is ComparisonBasis.RUNS:
        kinds = np.zeros_like(stratum) if axis.name == "protocol" else stratum
        statistic = _permutation_statistic(axis, inside, kinds, generator)
    else:
        statistic = _sign_flip_statistic(axis, inside, generator)
    has_excess = (axis.energy.sum(axis=0) @ inside) > 0
    return Significance(windows, np.where(has_excess, _familywise_p(statistic), 1.0))


def overall_p(energy: FloatArray, generator: np.random.Generator) -> float:
    """Return the p-value of the excess of all runs together, by random signs of the runs."""
    return float(_familywise_p(_sign_flip_sums(_signed_root(energy)[:, None], generator))[0])


def largest_excess_p(blocks: Sequence[ResidualBlocks]) -> float:
    """Return a p-value of the largest mean square, as if all blocks of a run were one: the most conservative test.

    Permutations of few runs cannot reach small p-values, however large their excess.
    """
    from scipy.special import chdtrc

    largest = max(1 + float(run.excess.sum()) for run in blocks)
    return min(1.0, len(blocks) * float(chdtrc(1, largest)))


def _windows(axis: ExcessAxis) -> IndexArray:
    """Return the windows that leave something outside; bins without runs are dropped."""
    count = axis.energy.shape[1]
    if not axis.ordered:
        used = np.flatnonzero(axis.duration.any(axis=0))
        return np.stack((used, used), axis=1) if used.size > 1 else np.zeros((0, 2), dtype=np.intp)
    first, last = np.triu_indices(count)
    proper = last - first < count - 1
    return np.stack((first[proper], last[proper]), axis=1)


def _permutation_statistic(
    axis: ExcessAxis, inside: FloatArray, stratum: IndexArray, generator: np.random.Generator
) -> FloatArray:
    """Return standardised sums over each window, shape `(1 + PERMUTATIONS, K)`, observed ones first."""
    included = axis.duration.sum(axis=1) > 0
    member = (axis.duration @ inside)[included]
    amplitude = _signed_root(axis.energy.sum(axis=1))[included]
    kinds = np.unique(stratum[included], return_inverse=True)[1]
    if not kinds.size:
        return np.zeros((1 + PERMUTATIONS, inside.shape[1]))
    centred = amplitude - (np.bincount(kinds, amplitude) / np.bincount(kinds))[kinds]
    order = np.argsort(kinds + generator.random((PERMUTATIONS, kinds.size)), axis=1)
    sums = np.vstack((centred, centred[order])) @ member
    spread = sums[1:].std(axis=0)
    return np.asarray(np.divide(sums, spread, out=np.zeros_like(sums), where=spread > 1e-9))


def _sign_flip_statistic(axis: ExcessAxis, inside: FloatArray, generator: np.random.Generator) -> FloatArray:
    """Return statistics of the difference between each window and the rest, shape `(1 + PERMUTATIONS, K)`."""
    time, energy = axis.duration @ inside, axis.energy @ inside
    if axis.basis is ComparisonBasis.NOISE:
        return _sign_flip_sums(_signed_root(energy), generator)
    rest_time, rest_energy = axis.duration @ (1 - inside), axis.energy @ (1 - inside)
    both = (time > 0) & (rest_time > 0)
    durations = np.where(both, time, 1.0), np.where(both, rest_time, 1.0)
    difference = _signed_root(energy / durations[0]) - np.maximum(_signed_root(rest_energy / durations[1]), 0.0)
    return _sign_flip_sums(np.where(both, difference, 0.0), generator)


def _sign_flip_sums(values: FloatArray, generator: np.random.Generator) -> FloatArray:
    """Return sums over runs divided by their root sum of squares, observed and under random signs."""
    signs = np.where(generator.random((PERMUTATIONS, values.shape[0])) < 0.5, -1.0, 1.0)
    scale = np.sqrt((values**2).sum(axis=0))
    sums = np.vstack((values.sum(axis=0), signs @ values))
    return np.asarray(np.divide(sums, scale, out=np.zeros_like(sums), where=scale > 0))


def _familywise_p(statistic: FloatArray) -> FloatArray:
    """Return single-step max-T p-values of the first row against the largest of each other row, shape `(K,)`."""
    observed, largest = statistic[0], statistic[1:].max(axis=1)
    at_least = (largest[:, None] >= observed - 1e-12).sum(axis=0)
    return np.asarray((1 + at_least) / (1 + largest.size))


def _signed_root(energy: FloatArray) -> FloatArray:
    return np.asarray(np.sign(energy) * np.sqrt(np.abs(energy)))
