"""One run as a model sees it: what was done, to what, and the motion that was measured."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dragrig.analysis.clipping import clipped
from dragrig.analysis.nominal.wander import COUNT_MM, count_of, jitter_of, wander_of
from dragrig.analysis.phases import Mask
from dragrig.config.capsule import Capsule
from dragrig.config.errors import AnalysisError
from dragrig.config.specimen import Fixture
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Contact
from dragrig.rig.protocols import kinds
from dragrig.rig.runfile.model import Attribute, Run
from dragrig.sim_backend.friction.commanded import commanded_motion
from dragrig.sim_backend.friction.measured import measured_motion
from dragrig.sim_backend.friction.motion import ProfileMotion
from dragrig.sim_backend.friction.recorded import FEWEST, WINDOW_S, RecordedMotion

USUAL_DWELL_S = 60.0
"""Age of the contact at the first sample where a run does not say (the paper's programme)."""
USUAL_WALL_MM = 2.5
FOLLOWS_COUNTS = 2.5
"""A stage whose encoder stays within so many counts of its command is where it was told to be."""

BY_CHANCE = 0.25
"""The mean of a window is off by less than this part of the wander, if by noise alone."""


@dataclass(frozen=True, eq=False)
class Experiment:
    """A run with its measured motion. Times and positions count from the first sample; units mm, s, mN, g."""

    run: Run
    trusts_command: bool = False
    """Whether the command is the motion even where the record of the position says otherwise."""
    computes_command: bool = False
    """Whether the command is where a model of the motor takes the stage, so that nothing of it was rounded."""

    @property
    def kind(self) -> str:
        """Kind of run: drag, relaxation, coulomb, blank, …."""
        return self.run.info.kind

    @property
    def file(self) -> str:
        """Name of the run's file."""
        return self.run.info.path.name

    @cached_property
    def time_s(self) -> FloatArray:
        """Times of the samples from the first one on, shape `(N,)`."""
        time = np.asarray(self.run.trace.time, dtype=np.float64)
        return np.asarray(time - time[0])

    @cached_property
    def valid(self) -> Mask:
        """Which samples of the signal are numbers and within the sensor's range, shape `(N,)`."""
        return np.isfinite(self.run.trace.force) & ~clipped(self.run)

    @cached_property
    def count_mm(self) -> float:
        """The encoder's count as the run's settings tell it, at least 1 µm."""
        return count_of(self.run.info.header.settings_toml)

    @cached_property
    def wander_mm(self) -> float:
        """How far the recorded position wanders at rest, at least from one count to the next."""
        time_s, position = self._seen
        if position.size < FEWEST:
            return jitter_of(COUNT_MM)
        command = np.asarray(self.run.trace.command, dtype=np.float64)[np.isfinite(self.run.trace.position)]
        known = bool(np.isfinite(command).all() and np.any(command != position))
        return wander_of(time_s, position, command if known else None, self.count_mm)

    @cached_property
    def obeyed(self) -> bool:
        """Whether the stage followed its command to the encoder's count, so that the command is the better record.

        A position that wanders at rest may be off as much further, but not for long. One that equals the command was
        made of it, as for records from elsewhere.
        """
        command = np.asarray(self.run.trace.command, dtype=np.float64)
        if not np.isfinite(command).all():
            return False
        if self.trusts_command:
            return True
        time_s, position = self._seen
        off = position - command[np.isfinite(self.run.trace.position)]
        furthest = float(np.abs(off).max(initial=0.0))
        follows_mm = FOLLOWS_COUNTS * self.count_mm
        if furthest <= follows_mm:
            return furthest > 0
        if furthest > follows_mm + self.wander_mm - jitter_of(self.count_mm):
            return False
        return _smoothed(time_s, off) <= max(follows_mm, BY_CHANCE * self.wander_mm)

    @cached_property
    def motion(self) -> RecordedMotion:
        """The motion, as commanded where the stage obeyed and else as measured.

        Raises `AnalysisError` where the record cannot be used.
        """
        if self.obeyed and self.computes_command:
            command = np.asarray(self.run.trace.command, dtype=np.float64)
            return RecordedMotion.exact(self.time_s, command - command[0])
        if self.obeyed:
            return commanded_motion(self.time_s, self.run.trace.command)
        return RecordedMotion.of(*self._seen, self.wander_mm)

    @cached_property
    def followed(self) -> ProfileMotion:
        """The measured motion without any smoothing: straight lines, two from sample to sample, while the stage moves.

        For what depends on the position and not on the sign of the speed; its velocity is as rough as the encoder.
        """
        if self.obeyed:
            return self.motion.fine
        return measured_motion(self.motion, *self._seen)

    @cached_property
    def _seen(self) -> tuple[FloatArray, FloatArray]:
        """Times at which a position was recorded, and it."""
        position = np.asarray(self.run.trace.position, dtype=np.float64)
        seen = np.isfinite(position)
        return self.time_s[seen], position[seen]

    def position(self, time_s: FloatArray) -> FloatArray:
        """Measured position [mm], smoothed."""
        return self.motion.position(time_s)

    def velocity(self, time_s: FloatArray) -> FloatArray:
        """Velocity [mm/s] of the smoothed position."""
        return self.motion.velocity(time_s)

    def acceleration(self, time_s: FloatArray) -> FloatArray:
        """Acceleration [mm/s²] of the smoothed position, constant in pieces."""
        pieces = self.motion.pieces()
        index = np.searchsorted(pieces.start_s, time_s, side="right") - 1
        return np.asarray(pieces.acceleration_mm_s2[np.maximum(index, 0)])

    @property
    def fixture(self) -> Fixture:
        """What held the gut; raises `AnalysisError` for a word that is not known."""
        word = str(self.run.info.header.specimen.get("fixture", ""))
        try:
            return Fixture(word)
        except ValueError:
            raise AnalysisError(
                f"{self.file}: specimen fixture {word!r} is none of {', '.join(Fixture)}; import the run again with one"
            ) from None

    @property
    def contact(self) -> Contact:
        """How capsule and gut meet in a run of this kind."""
        if self.fixture is Fixture.NONE:
            return Contact.NONE
        known = kinds().get(self.kind)
        return Contact.SLIDING if known is None else known.contact

    @property
    def shear_strain(self) -> float:
        """Strain that a relaxation goes to, or the largest one it reached; 0 for a capsule that slides."""
        if self.contact is not Contact.STICKING:
            return 0.0
        said = _number(self.run.info.header.protocol.get("shear_strain"))
        if said is not None:
            return abs(said)
        return float(np.nanmax(np.abs(self.run.trace.position - self.run.trace.position[0]))) / self.wall_thickness_mm

    @property
    def wall_thickness_mm(self) -> float:
        """Mean thickness of the specimen's wall."""
        return _number(self.run.info.header.specimen.get("wall_thickness_mm")) or USUAL_WALL_MM

    @property
    def insertion_dwell_s(self) -> float:
        """Noted age of the contact at the first sample."""
        noted = _number(self.run.info.header.entry.get("insertion_dwell_s"))
        return USUAL_DWELL_S if noted is None else noted

    @property
    def capsule(self) -> Capsule:
        """The capsule dummy; raises `AnalysisError` where the run does not say enough of it."""
        header = self.run.info.header.capsule
        sizes = {key: _number(header.get(key)) for key in ("diameter_mm", "length_mm", "mass_g", "contact_angle_deg")}
        lacking = [key for key, value in sizes.items() if value is None]
        if lacking:
            raise AnalysisError(f"{self.file}: the run does not say its capsule's {' and '.join(lacking)}")
        surface = "rough" if self.contact is Contact.STICKING else "smooth"
        name = str(header.get("name") or "capsule")
        return Capsule.model_validate({"name": name, "surface": surface, **sizes})


def _smoothed(time_s: FloatArray, values: FloatArray) -> float:
    """Return the largest mean over a window, whatever its sign."""
    from scipy.ndimage import uniform_filter1d

    window = max(FEWEST, round(WINDOW_S / float(np.median(np.diff(time_s)))))
    return float(np.abs(uniform_filter1d(values, window)).max())


def _number(value: Attribute | None) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        return None
    return float(value)
