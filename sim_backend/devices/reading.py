"""One acquisition's samples, handed out in blocks: computed a chunk ahead, forgotten once handed out."""

import math
from collections.abc import Mapping

from dragrig.rig.arrays import AnyFloatArray
from dragrig.sim_backend.devices.axis import Track
from dragrig.sim_backend.devices.faults import LostSamples
from dragrig.sim_backend.devices.signals import Signals

CHUNK_SAMPLES = 16_384
"""Samples computed at once: large enough for fast arrays, small enough for the processor's cache and a prompt stop.

Chunks begin at multiples of this whatever the blocks are, so the blocks' size cannot change a value.
"""


class Reading:
    """The samples of one acquisition in order. Belongs to the thread that reads."""

    def __init__(
        self, signals: Signals, samples: int, block_samples: int, sample_rate_hz: float, lost: LostSamples | None
    ) -> None:
        self._signals = signals
        self._total = samples
        self._block_samples = block_samples
        self._rate_hz = sample_rate_hz
        self._gap = None if lost is None else self.index(lost.at_s)
        self._gap_samples = 0 if lost is None else lost.samples
        self._next = 0
        self._track: Track | None = None
        self._origin_mm = 0.0
        self._chunk: Mapping[str, AnyFloatArray] = {}
        self._chunk_first = 0
        self._chunk_end = 0

    @property
    def next_index(self) -> int:
        """Index of the first sample that is not handed out."""
        return self._next

    def index(self, time_s: float) -> int:
        """Return the index of the first sample at or after a time."""
        return math.ceil(time_s * self._rate_hz - 1e-6)

    def begin_at(self, origin_mm: float) -> None:
        """Count positions from this absolute one."""
        self._origin_mm = origin_mm

    def follow(self, track: Track) -> None:
        """Compute what is not handed out yet for another track, and end where a stop has ended it."""
        if track is self._track or self._next >= self._total:
            return
        self._track = track
        self._signals.follow(track)
        self._chunk_end = self._next
        if track.stopped:
            self._total = max(self._next, self.index(track.ends_s))

    def next_end(self, limit: int | None = None) -> int:
        """Return the end of the next block, not beyond `limit`; not above `next_index` when there is none."""
        if self._next == self._gap:
            self._next += self._gap_samples
        first = self._next
        end = min(first + self._block_samples, _chunk_end(first), self._total)
        for boundary in (self._gap, limit):
            if boundary is not None and first < boundary < end:
                end = boundary
        return end

    def compute(self, end: int) -> None:
        """Have the samples before `end` ready."""
        if end <= self._chunk_end:
            return
        first = self._next
        self._chunk_end = min(_chunk_end(first), self._total)
        self._chunk = self._signals.compute(first, self._chunk_end, self._origin_mm)
        self._chunk_first = first

    def take(self, end: int) -> tuple[int, Mapping[str, AnyFloatArray]]:
        """Hand out the samples before `end`: index of the first, and views of the chunk."""
        first = self._next
        here = slice(first - self._chunk_first, end - self._chunk_first)
        self._next = end
        return first, {name: values[here] for name, values in self._chunk.items()}


def _chunk_end(index: int) -> int:
    return (index // CHUNK_SAMPLES + 1) * CHUNK_SAMPLES
