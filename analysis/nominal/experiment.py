"""One run as a model sees it: what was done, to what, and the motion that was measured."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dragrig.analysis.clipping import clipped
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
from dragrig.sim_backend.friction.recorded import RecordedMotion

USUAL_DWELL_S = 60.0
"""Age of the contact at the first sample where a run does not say (the paper's programme)."""
USUAL_WALL_MM = 2.5
FOLLOWS_MM = 0.0025
"""A stage whose encoder of 1 µm counts stays within this of its command is where it was told to be."""


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
    def obeyed(self) -> bool:
        """Whether the stage followed its command to the encoder's count, so that the command is the better record.

        One that equals the position was made of it, as for records from elsewhere.
        """
        position = np.asarray(self.run.trace.position, dtype=np.float64)
        command = np.asarray(self.run.trace.command, dtype=np.float64)
        off = np.abs(position - command)[np.isfinite(position)]
        if self.trusts_command and np.isfinite(command).all():
            return True
        return bool(np.isfinite(command).all() and 0 < off.max(initial=0.0) <= FOLLOWS_MM)

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
        position = np.asarray(self.run.trace.position, dtype=np.float64)
        seen = np.isfinite(position)
        return RecordedMotion.of(self.time_s[seen], position[seen])

    @cached_property
    def followed(self) -> ProfileMotion:
        """The measured motion without any smoothing: straight lines, two from sample to sample, while the stage moves.

        For what depends on the position and not on the sign of the speed; its velocity is as rough as the encoder.
        """
        if self.obeyed:
            return self.motion.fine
        position = np.asarray(self.run.trace.position, dtype=np.float64)
        seen = np.isfinite(position)
        return measured_motion(self.motion, self.time_s[seen], position[seen])

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


def _number(value: Attribute | None) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        return None
    return float(value)
