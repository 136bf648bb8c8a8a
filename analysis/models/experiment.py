"""One run as a model sees it: protocol, capsule, specimen, and the measured motion with its uncertainty."""

import tomllib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from dragrig.analysis.segments import Mask, attribute_number, clipped_samples
from dragrig.config.errors import AnalysisError
from dragrig.config.specimen import Capsule, Fixture
from dragrig.rig.arrays import FloatArray
from dragrig.rig.devices import Contact
from dragrig.rig.protocols import protocol_kinds
from dragrig.rig.runfile.model import Run
from dragrig.sim_backend.friction.motion import (
    ENCODER_JITTER_MM,
    MIN_SAMPLES,
    SMOOTHING_ORDER,
    SMOOTHING_WINDOW_S,
    ProfileMotion,
    RecordedMotion,
    commanded_motion,
    measured_motion,
    resample_uniformly,
)

DEFAULT_DWELL_S = 60.0
"""Age of the contact at the first sample where a run does not state it (the paper's programme)."""
DEFAULT_WALL_THICKNESS_MM = 2.5
MAX_FOLLOWING_COUNTS = 2.5
"""A stage whose encoder stays within this many counts of its command follows it exactly."""
WINDOW_MEAN_NOISE_SHARE = 0.25
"""Largest mean over a window that noise alone causes, relative to the wander."""
SETTLED_S = 0.2
"""Time that a stage takes to stand still after its command does."""
MIN_REST_S = 0.3
"""Shorter rests, all together, do not show the wander."""
QUIETEST_SHARE = 0.25
"""Share of the windows at rest that are used, for in others a stage may still come to rest."""
QUIETEST_SPAN_SDS, TYPICAL_SPAN_SDS = 2.9, 6.0
"""Largest span of the quietest windows in white noise, in its standard deviations, and that of nearly all windows."""
MAX_WANDER_MM = 0.02
"""A larger span is a motion, unless it is from one count to the next."""
MIN_COUNT_MM = 0.001
"""Smallest count of an encoder, and the default."""


class _EncoderSettings(BaseModel):
    resolution_um: float = Field(default=1e3 * MIN_COUNT_MM, gt=0)


class _RigSettings(BaseModel):
    encoder: _EncoderSettings = _EncoderSettings()


class _RunSettings(BaseModel):
    rig: _RigSettings = _RigSettings()


def encoder_count_mm(settings_toml: str) -> float:
    """Return the encoder's count [mm] in a run's settings, at least `MIN_COUNT_MM`, also the default."""
    try:
        settings = _RunSettings.model_validate(tomllib.loads(settings_toml))
    except (tomllib.TOMLDecodeError, ValidationError):
        return MIN_COUNT_MM
    return max(1e-3 * settings.rig.encoder.resolution_um, MIN_COUNT_MM)


def position_wander_mm(
    time_s: FloatArray, position_mm: FloatArray, command_mm: FloatArray | None, count_mm: float = MIN_COUNT_MM
) -> float:
    """Return the range of a recorded position within `SMOOTHING_WINDOW_S` at rest [mm]: counts, noise, servo dither.

    Parameters
    ----------
    time_s, position_mm
        The record, shape `(N,)`: rising times from 0, finite positions.
    command_mm
        The command, shape `(N,)`, which shows the rests; None where it is not known. Then the
        wander is that of white noise with the residual of a parabola in the middle of a window.
    count_mm
        The encoder's count.

    Returns
    -------
    At least the jitter of such an encoder, and at most `MAX_WANDER_MM` beyond it.
    """
    from scipy.ndimage import maximum_filter1d, minimum_filter1d
    from scipy.signal import savgol_filter

    grid, position = resample_uniformly(time_s, position_mm)
    window = max(SMOOTHING_ORDER + 3, 2 * round(0.5 * SMOOTHING_WINDOW_S / float(grid[1])) + 1)
    jitter_mm = count_jitter_mm(count_mm)
    if position.size < 2 * window:
        return jitter_mm
    rests = None if command_mm is None else _rest_windows(grid, np.interp(grid, time_s, command_mm), window)
    if rests is None or np.count_nonzero(rests) * float(grid[1]) < MIN_REST_S:
        residual = position - savgol_filter(position, window, SMOOTHING_ORDER)
        # The filter's own weight of a sample in the middle of a window, for order 2 or 3, is about 9 / (4 window).
        residual_share = 1.0 - 9.0 / (4.0 * window)
        sd = 1.4826 * float(np.median(np.abs(residual))) / float(np.sqrt(residual_share))
    else:
        spans = maximum_filter1d(position, window) - minimum_filter1d(position, window)
        sd = float(np.quantile(spans[rests], QUIETEST_SHARE)) / QUIETEST_SPAN_SDS
    return max(jitter_mm, min(TYPICAL_SPAN_SDS * sd, MAX_WANDER_MM))


def count_jitter_mm(count_mm: float) -> float:
    """Return the wander [mm] of an encoder at rest: from one count to the next."""
    return ENCODER_JITTER_MM * count_mm / MIN_COUNT_MM


def wander_noise_sd_mm(wander_mm: float, count_mm: float) -> float:
    """Return the standard deviation [mm] of a position with this wander; 0 where it is by the counts alone."""
    return wander_mm / TYPICAL_SPAN_SDS if wander_mm > count_jitter_mm(count_mm) else 0.0


def _rest_windows(grid_s: FloatArray, command_mm: FloatArray, window: int) -> Mask:
    """Mask of the windows, by their middle, in which and long before which the command stands still."""
    from scipy.ndimage import maximum_filter1d

    moving = np.append(np.diff(command_mm) != 0, False)
    last_move_s = np.maximum.accumulate(np.where(moving, grid_s, -np.inf))
    still = maximum_filter1d(moving.astype(np.uint8), window) == 0
    settled = grid_s - last_move_s > SETTLED_S + SMOOTHING_WINDOW_S
    settled[: window // 2] = settled[moving.size - window // 2 :] = False
    return np.asarray(still & settled)


@dataclass(frozen=True, eq=False)
class Experiment:
    """A run with its measured motion. Times and positions count from the first sample; units mm, s, mN, g."""

    run: Run
    trusts_command: bool = False
    """Whether the command is taken as the motion even where the recorded position deviates from it."""
    computes_command: bool = False
    """Whether the command was computed by a model of the motor, so that it is not rounded."""

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
        return np.isfinite(self.run.trace.force) & ~clipped_samples(self.run)

    @cached_property
    def count_mm(self) -> float:
        """The encoder's count in the run's settings, at least 1 µm."""
        return encoder_count_mm(self.run.info.header.settings_toml)

    @cached_property
    def wander_mm(self) -> float:
        """Range of the recorded position at rest, at least from one count to the next."""
        time_s, position = self._recorded
        if position.size < MIN_SAMPLES:
            return count_jitter_mm(MIN_COUNT_MM)
        command = np.asarray(self.run.trace.command, dtype=np.float64)[np.isfinite(self.run.trace.position)]
        known = bool(np.isfinite(command).all() and np.any(command != position))
        return position_wander_mm(time_s, position, command if known else None, self.count_mm)

    @cached_property
    def follows_command(self) -> bool:
        """Whether the stage followed its command to the encoder's count, so that the command is the better record.

        A position that wanders at rest may deviate by as much more, but not for long. A position that equals the
        command was derived from it, as in foreign records.
        """
        from scipy.ndimage import uniform_filter1d

        command = np.asarray(self.run.trace.command, dtype=np.float64)
        if not np.isfinite(command).all():
            return False
        if self.trusts_command:
            return True
        time_s, position = self._recorded
        deviation = position - command[np.isfinite(self.run.trace.position)]
        largest_mm = float(np.abs(deviation).max(initial=0.0))
        allowed_mm = MAX_FOLLOWING_COUNTS * self.count_mm
        if largest_mm <= allowed_mm:
            return largest_mm > 0
        if largest_mm > allowed_mm + self.wander_mm - count_jitter_mm(self.count_mm):
            return False
        window = max(MIN_SAMPLES, round(SMOOTHING_WINDOW_S / float(np.median(np.diff(time_s)))))
        largest_mean_mm = float(np.abs(uniform_filter1d(deviation, window)).max())
        return largest_mean_mm <= max(allowed_mm, WINDOW_MEAN_NOISE_SHARE * self.wander_mm)

    @cached_property
    def motion(self) -> RecordedMotion:
        """The motion, as commanded where the stage followed its command, otherwise as measured.

        Raises `AnalysisError` where the record cannot be used.
        """
        if self.follows_command and self.computes_command:
            command = np.asarray(self.run.trace.command, dtype=np.float64)
            return RecordedMotion.computed(self.time_s, command - command[0])
        if self.follows_command:
            return commanded_motion(self.time_s, self.run.trace.command)
        return RecordedMotion.of(*self._recorded, self.wander_mm)

    @cached_property
    def unsmoothed_motion(self) -> ProfileMotion:
        """The measured motion without smoothing: straight lines, two from sample to sample, while the stage moves.

        For quantities that depend on the position and not on the sign of the speed; its velocity is as rough as the
        encoder.
        """
        if self.follows_command:
            return self.motion.profile
        return measured_motion(self.motion, *self._recorded)

    @cached_property
    def _recorded(self) -> tuple[FloatArray, FloatArray]:
        """Finite positions and their times."""
        position = np.asarray(self.run.trace.position, dtype=np.float64)
        finite = np.isfinite(position)
        return self.time_s[finite], position[finite]

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
        """The gut's fixture; raises `AnalysisError` for an unknown word."""
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
        known = protocol_kinds().get(self.kind)
        return Contact.SLIDING if known is None else known.contact

    @property
    def shear_strain(self) -> float:
        """Strain that a relaxation goes to, or the largest one it reached; 0 for a capsule that slides."""
        if self.contact is not Contact.STICKING:
            return 0.0
        stated = attribute_number(self.run.info.header.protocol, "shear_strain")
        if stated is not None:
            return abs(stated)
        return float(np.nanmax(np.abs(self.run.trace.position - self.run.trace.position[0]))) / self.wall_thickness_mm

    @property
    def wall_thickness_mm(self) -> float:
        """Mean thickness of the specimen's wall."""
        return attribute_number(self.run.info.header.specimen, "wall_thickness_mm") or DEFAULT_WALL_THICKNESS_MM

    @property
    def insertion_dwell_s(self) -> float:
        """Noted age of the contact at the first sample."""
        noted = attribute_number(self.run.info.header.entry, "insertion_dwell_s")
        return DEFAULT_DWELL_S if noted is None else noted

    @property
    def capsule(self) -> Capsule:
        """The capsule dummy; raises `AnalysisError` where the run does not state enough of it."""
        header = self.run.info.header.capsule
        keys = ("diameter_mm", "length_mm", "mass_g", "contact_angle_deg")
        sizes = {key: attribute_number(header, key) for key in keys}
        missing = [key for key, value in sizes.items() if value is None]
        if missing:
            raise AnalysisError(f"{self.file}: the run does not state its capsule's {' and '.join(missing)}")
        surface = "rough" if self.contact is Contact.STICKING else "smooth"
        name = str(header.get("name") or "capsule")
        return Capsule.model_validate({"name": name, "surface": surface, **sizes})
