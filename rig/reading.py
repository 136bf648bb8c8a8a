"""Blocks joined by what was commanded: what guard, recorder, checks and viewers see."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dragrig.rig.arrays import AnyFloatArray, FloatArray, PhaseArray, read_only
from dragrig.rig.devices import Block
from dragrig.rig.profile import MotionProfile

_AHEAD = 16_384


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """A block with its time, command and phase; every array read-only, shape `(n,)`.

    `channels` holds what the block does, with the tare taken off the force.
    """

    first_index: int
    time: FloatArray
    command: AnyFloatArray
    phase: PhaseArray
    channels: Mapping[str, AnyFloatArray]

    @property
    def end_index(self) -> int:
        """Index after the last sample."""
        return self.first_index + len(self.time)

    def arrays(self) -> Mapping[str, AnyFloatArray | PhaseArray]:
        """Return all datasets of the run file's trace."""
        return {"time": self.time, "command": self.command, "phase": self.phase, **self.channels}


@dataclass(frozen=True, slots=True)
class Look:
    """What guard and checks both need of a block, worked out once."""

    lowest_mm: float
    highest_mm: float
    least_mN: float
    greatest_mN: float
    following_mm: float

    @classmethod
    def at(cls, block: Block, command: AnyFloatArray) -> "Look":
        """Take the extremes of position and raw force, and the largest distance from the command."""
        force, position = block.channels["force"], block.channels["position"]
        return cls(
            lowest_mm=float(np.minimum.reduce(position)),
            highest_mm=float(np.maximum.reduce(position)),
            least_mN=float(np.minimum.reduce(force)),
            greatest_mN=float(np.maximum.reduce(force)),
            following_mm=float(np.maximum.reduce(np.abs(position - command))),
        )


class CommandTape:
    """Time, command and phase of a profile's samples, worked out in long stretches and handed out in slices."""

    def __init__(self, profile: MotionProfile, rate_hz: float, tare_mN: float = 0.0) -> None:
        self._profile = profile
        self._rate_hz = rate_hz
        self._tare_mN = np.float32(tare_mN)
        self._from = 0
        self._time: FloatArray = np.zeros(0)
        self._command: AnyFloatArray = np.zeros(0, np.float32)
        self._phase: PhaseArray = np.zeros(0, np.uint8)

    def replace(self, profile: MotionProfile) -> None:
        """Go on with another profile, as after a stop."""
        self._profile = profile
        self._time = self._time[:0]

    def join(self, block: Block) -> Reading:
        """Put a block beside its command."""
        if not self._from <= block.first_index <= block.end_index <= self._from + len(self._time):
            self._work_out(block.first_index, block.samples)
        start = block.first_index - self._from
        stop = start + block.samples
        channels = dict(block.channels)
        if self._tare_mN:
            channels["force"] = block.channels["force"] - self._tare_mN
            read_only(channels["force"])
        return Reading(
            first_index=block.first_index,
            time=self._time[start:stop],
            command=self._command[start:stop],
            phase=self._phase[start:stop],
            channels=channels,
        )

    def _work_out(self, first: int, samples: int) -> None:
        self._from = first
        self._time = np.arange(first, first + max(_AHEAD, samples)) / self._rate_hz
        self._command = self._profile.position(self._time).astype(np.float32)
        self._phase = self._profile.phase_at(self._time)
        for array in (self._time, self._command, self._phase):
            read_only(array)
