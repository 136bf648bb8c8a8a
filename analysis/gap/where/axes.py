"""The bins, fixed beforehand by the plan, and how much of each run's excess lies in each of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from dragrig.analysis.gap.where.bands import BANDS_HZ, band_excess
from dragrig.analysis.gap.where.blocks import ResidualBlocks
from dragrig.rig.arrays import BoolArray, FloatArray
from dragrig.rig.devices import Contact
from dragrig.rig.profile import Phase

CHANNELS = ("force", "position")
PROTOCOLS = ("drag", "coulomb", "relaxation", "blank")
PHASES = tuple(one.name.lower() for one in Phase)
POSITION_BINS, SESSION_BINS = 10, 8

IndexArray = npt.NDArray[np.intp]


class Against(StrEnum):
    """What the excess in a bin is compared with."""

    RUNS = "runs"
    """Other runs of the same kind, where a run lies in one bin as a whole."""
    REST = "rest"
    """The rest of the run, where every run has a part in the bin."""
    NOISE = "noise"
    """What is expected, where bins differ in what noise has in them."""


@dataclass(frozen=True, slots=True, eq=False)
class Axis:
    """One way to divide the excess of `R` runs into `J` bins.

    Attributes
    ----------
    name
        As in the report.
    labels
        Names of the bins, or none where `edges` has their ends.
    edges
        Lower and upper end of each bin, shape `(J, 2)`.
    energy
        Excess of each run in each bin, in units of the expected mean square, shape `(R, J)`.
    time
        Part of each run's duration in each bin, shape `(R, J)`.
    against
        What the excess in a bin is compared with.
    """

    name: str
    labels: tuple[str, ...]
    edges: FloatArray
    energy: FloatArray
    time: FloatArray
    against: Against

    @property
    def ordered(self) -> bool:
        """Whether neighbouring bins belong together."""
        return not self.labels


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """The runs of a campaign in order of their kinds, with the blocks of each run's channels."""

    ids: tuple[str, ...]
    blocks: tuple[tuple[ResidualBlocks, ...], ...]

    @classmethod
    def of(cls, blocks: Sequence[ResidualBlocks]) -> "Runs":
        """Gather channels by run."""
        by_run: dict[str, list[ResidualBlocks]] = {}
        for one in blocks:
            by_run.setdefault(one.run_id, []).append(one)
        names = sorted(by_run, key=lambda name: (by_run[name][0].kind, by_run[name][0].session_s, name))
        return cls(tuple(names), tuple(tuple(by_run[name]) for name in names))

    @property
    def first(self) -> tuple[ResidualBlocks, ...]:
        """One channel of each run, for what belongs to the run as a whole."""
        return tuple(channels[0] for channels in self.blocks)

    @property
    def energy(self) -> FloatArray:
        """Excess of each run, shape `(R,)`."""
        return np.array([sum(float(one.excess.sum()) for one in channels) for channels in self.blocks])

    @property
    def stratum(self) -> IndexArray:
        """Number of each run's kind, rising, shape `(R,)`."""
        return np.asarray(np.unique([one.kind for one in self.first], return_inverse=True)[1])


def axes_of(runs: Runs) -> tuple[Axis, ...]:
    """Return all axes of a campaign."""
    return (_channel(runs), _protocol(runs), _phase(runs), _speed(runs), _position(runs), _session(runs),
            _strain(runs), _band(runs))  # fmt: skip


def _channel(runs: Runs) -> Axis:
    names = [one.channel for channels in runs.blocks for one in channels]
    labels = tuple(dict.fromkeys((*CHANNELS, *names)))
    energy, time = np.zeros((2, len(runs.ids), len(labels)))
    for row, channels in enumerate(runs.blocks):
        for one in channels:
            energy[row, labels.index(one.channel)] += one.excess.sum()
            time[row, labels.index(one.channel)] = 1.0
    return Axis("channel", labels, _no_edges(labels), energy, time, Against.REST)


def _protocol(runs: Runs) -> Axis:
    kinds = [one.kind for one in runs.first]
    labels = tuple(dict.fromkeys((*PROTOCOLS, *kinds)))
    member = np.array(kinds)[:, None] == np.array(labels)
    return _whole("protocol", labels, _no_edges(labels), runs, member)


def _phase(runs: Runs) -> Axis:
    energy, time = _within(runs, lambda one: one.phase.astype(np.intp), len(PHASES))
    return Axis("phase", PHASES, _no_edges(PHASES), energy, time, Against.REST)


def _speed(runs: Runs) -> Axis:
    moves = np.array([one.contact is not Contact.STICKING for one in runs.first])
    return _by_value("speed_mm_s", runs, np.array([one.speed_mm_s for one in runs.first]), moves)


def _strain(runs: Runs) -> Axis:
    sticks = np.array([one.contact is Contact.STICKING for one in runs.first])
    return _by_value("strain", runs, np.array([one.strain for one in runs.first]), sticks)


def _session(runs: Runs) -> Axis:
    start = np.array([one.session_s for one in runs.first])
    edges = np.linspace(float(start.min()), float(start.max()), SESSION_BINS + 1)
    index = np.clip(np.searchsorted(edges, start, side="right") - 1, 0, SESSION_BINS - 1)
    member = index[:, None] == np.arange(SESSION_BINS)
    return _whole("session", (), np.stack((edges[:-1], edges[1:]), axis=1), runs, member)


def _position(runs: Runs) -> Axis:
    longest = max((float(np.abs(one.position_mm).max()) for one in runs.first if _moves(one)), default=0.0)
    edges = np.linspace(0.0, max(round(longest, 1), 0.1), POSITION_BINS + 1)

    def index(one: ResidualBlocks) -> IndexArray:
        found = np.clip(np.searchsorted(edges, np.abs(one.position_mm), side="right") - 1, 0, POSITION_BINS - 1)
        under_way = (one.phase != Phase.REST) & (one.phase != Phase.HOLD)
        return np.asarray(np.where(under_way & _moves(one), found, -1))

    energy, time = _within(runs, index, POSITION_BINS)
    return Axis("position", (), np.stack((edges[:-1], edges[1:]), axis=1), energy, time, Against.REST)


def _band(runs: Runs) -> Axis:
    energy = np.array([sum((band_excess(one) for one in channels), start=_NO_BANDS) for channels in runs.blocks])
    edges = np.stack((BANDS_HZ[:-1], BANDS_HZ[1:]), axis=1)
    return Axis("band_hz", (), edges, energy, np.ones_like(energy), Against.NOISE)


_NO_BANDS = np.zeros(len(BANDS_HZ) - 1)


def _moves(one: ResidualBlocks) -> bool:
    return one.contact is not Contact.STICKING


def _no_edges(labels: tuple[str, ...]) -> FloatArray:
    return np.full((len(labels), 2), np.nan)


def _by_value(name: str, runs: Runs, value: FloatArray, taking_part: BoolArray) -> Axis:
    levels = np.unique(value[taking_part & (value > 0)])
    member = (value[:, None] == levels) & taking_part[:, None]
    return _whole(name, (), np.stack((levels, levels), axis=1), runs, member)


def _whole(name: str, labels: tuple[str, ...], edges: FloatArray, runs: Runs, member: BoolArray) -> Axis:
    return Axis(name, labels, edges, runs.energy[:, None] * member, member.astype(np.float64), Against.RUNS)


def _within(runs: Runs, index_of: Callable[[ResidualBlocks], IndexArray], count: int) -> tuple[FloatArray, FloatArray]:
    """Return excess and part of the duration of each run by bin; an index of −1 is in no bin."""
    energy, time = np.zeros((2, len(runs.ids), count))
    for row, channels in enumerate(runs.blocks):
        for one in channels:
            index = index_of(one)
            inside = index >= 0
            energy[row] += np.bincount(index[inside], one.excess[inside], count)
            time[row] += np.bincount(index[inside], one.weight[inside], count) / len(channels)
    return energy, time
