"""One run as a model sees it: protocol, capsule, specimen, and the measured motion with its uncertainty.

`Kinematics` is velocity and acceleration of a stage from its measured position. Twice differentiated, a position
in counts is noise; smoothed first, ramps lose their edges, and the identified mass a part of itself. A stage cannot
change its velocity at once, so the motion is modelled as pieces of constant acceleration whose velocities join, and
vanish where it rests: a chain of straight lines of velocity. The times of the joints belong to the fit, which finds
those of a programmed stroke from 1 µm counts to a small part of a sample. A motion whose acceleration changes gradually
(a polynomial, a sine, an S-curve) is no such chain: where a smoothing spline predicts samples that were held out
better, the spline is taken.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from math import comb, isfinite, log

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from dragrig.analysis import ForcePulse, Mask, SavgolKernel, attribute_number, clipped_samples, force_pulses, in_phase
from dragrig.config import AnalysisError, Capsule, Fixture, SettingsError, parse_toml
from dragrig.rig import Contact, FloatArray, IndexArray, Phase, Run, protocol_kinds
from dragrig.sim_backend.friction import (
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

START_UNKNOWN_KEY, SOURCE_KEY = "start_time_unknown", "import_sha256"
"""Attributes of an imported run: whether its start time is only its file's date, and the checksum of that file."""
DEFAULT_DWELL_S = 60.0
"""Age of the contact at the first sample where a run does not state it (the paper's programme)."""
DEFAULT_WALL_THICKNESS_MM = 2.5
MAX_FOLLOWING_COUNTS = 2.5
"""A stage whose encoder stays within this many counts of its command follows it exactly."""
WINDOW_MEAN_NOISE_SHARE = 0.25
"""Largest mean over a window that noise alone causes, relative to the wander."""
GIVING_WAY_COUNTS = 1.5
"""Encoder counts by which a stage that gives way stands off: fewer are rounding and vibration."""
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
WANDER_DIFFERENCES = 4
"""Differences of the samples of this order show their noise; of a motion of 60 Hz at 1 kHz they hold a fiftieth."""
MIN_COUNT_MM = 0.001
"""Smallest count of an encoder, and the default."""
MAX_BEND_SHARE = 0.1
"""Share of the samples at which a programmed motion bends, sampled slowly."""
FLOAT32_ROUNDING = 8 * float(np.finfo(np.float32).eps)
"""Relative rounding of differences of positions in single precision."""
MIN_JITTER_SAMPLES = 25
"""Fewer samples of steady motion do not show whether deviations are those of a clock."""
MAX_JITTER_S = 0.002
"""Times that are off by more than this are not a clock's jitter."""
JITTER_LAGS = 40
MAX_JITTER_CORRELATION, CORRELATION_SIGMAS = 0.1, 4.0
"""Largest correlation of a clock's jitter with itself at any lag, and what so many samples show of it by chance."""
JITTER_SIGMAS = 5.0
"""Largest deviation of a sample that is the clock's, in its standard deviations."""


class _EncoderSettings(BaseModel):
    resolution_um: float = Field(default=1e3 * MIN_COUNT_MM, gt=0)


class _RigSettings(BaseModel):
    encoder: _EncoderSettings = _EncoderSettings()


class _RunSettings(BaseModel):
    rig: _RigSettings = _RigSettings()


def encoder_count_mm(settings_toml: str) -> float:
    """Return the encoder's count [mm] in a run's settings, at least `MIN_COUNT_MM`, also the default."""
    try:
        settings = _RunSettings.model_validate(parse_toml(settings_toml, "the run's settings"))
    except (SettingsError, ValidationError):
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
        wander is that of white noise with the residual of a parabola in the middle of a window, or with the fourth
        differences of the samples where these are smaller.
    count_mm
        The encoder's count.

    Returns
    -------
    At least the jitter of such an encoder, and at most `MAX_WANDER_MM` beyond it.
    """
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    grid, position = resample_uniformly(time_s, position_mm)
    window = max(SMOOTHING_ORDER + 3, 2 * round(0.5 * SMOOTHING_WINDOW_S / float(grid[1])) + 1)
    jitter_mm = count_jitter_mm(count_mm)
    if position.size < 2 * window:
        return jitter_mm
    rests = None if command_mm is None else _rest_windows(grid, np.interp(grid, time_s, command_mm), window)
    if rests is None or np.count_nonzero(rests) * float(grid[1]) < MIN_REST_S:
        residual = position - SavgolKernel.of(window, SMOOTHING_ORDER, 0, 1.0).whole(position)
        # The filter's own weight of a sample in the middle of a window, for order 2 or 3, is about 9 / (4 window).
        residual_share = 1.0 - 9.0 / (4.0 * window)
        sd = 1.4826 * float(np.median(np.abs(residual))) / float(np.sqrt(residual_share))
        # A motion that the parabola does not follow, as of a motor that cogs, differs less from sample to sample.
        differences = np.diff(position, WANDER_DIFFERENCES) / np.sqrt(comb(2 * WANDER_DIFFERENCES, WANDER_DIFFERENCES))
        sd = min(sd, 1.4826 * float(np.median(np.abs(differences))))
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


def clock_jitter_s(deviation_mm: FloatArray, velocity_mm_s: FloatArray, steady: Mask, noise_mm: float) -> float | None:
    """Return the standard deviation of sampling times [s] that the deviations of a position in steady motion show.

    A sample that is late shows the position of another moment: the deviation is proportional to the speed, and
    independent from sample to sample. Lag, ripple and scale of a stage are not.

    Parameters
    ----------
    deviation_mm, velocity_mm_s
        Recorded minus commanded position, and commanded speed, shape `(N,)`.
    steady
        The samples of steady motion, shape `(N,)`.
    noise_mm
        Standard deviation of the deviation at rest.

    Returns
    -------
    0 where the deviations are correlated, or no larger than at rest at a speed that would show a jitter; None where the
    motion is too short or too slow to tell.
    """
    moving = steady & (np.abs(velocity_mm_s) > 0)
    if np.count_nonzero(moving) < MIN_JITTER_SAMPLES:
        return None
    deviation = deviation_mm[moving] - deviation_mm[moving].mean()
    variance = float(np.mean(deviation**2))
    jitter_s = float(np.sqrt(max(variance - noise_mm**2, 0.0) / np.mean(velocity_mm_s[moving] ** 2)))
    if variance <= 2.0 * noise_mm**2:
        return None
    if jitter_s > MAX_JITTER_S:
        return 0.0
    lags = range(1, min(JITTER_LAGS, deviation.size // 4) + 1)
    correlation = max(abs(float(deviation[lag:] @ deviation[:-lag])) for lag in lags) / (variance * deviation.size)
    chance = CORRELATION_SIGMAS / float(np.sqrt(deviation.size))
    return jitter_s if correlation <= MAX_JITTER_CORRELATION + chance else 0.0


def _rest_windows(grid_s: FloatArray, command_mm: FloatArray, window: int) -> Mask:
    """Mask of the windows, by their middle, in which and long before which the command stands still."""
    from scipy.ndimage import maximum_filter1d

    moving = np.append(np.diff(command_mm) != 0, False)
    last_move_s = np.maximum.accumulate(np.where(moving, grid_s, -np.inf))
    still = maximum_filter1d(moving.astype(np.uint8), window) == 0
    settled = grid_s - last_move_s > SETTLED_S + SMOOTHING_WINDOW_S
    settled[: window // 2] = settled[moving.size - window // 2 :] = False
    return np.asarray(still & settled)


def _moves_in_few_pieces(command_mm: FloatArray) -> bool:
    """Whether hardly any two neighbouring steps of an evenly sampled command differ, as they do in counts."""
    steps = np.diff(command_mm)
    bends = np.abs(np.diff(steps)) > FLOAT32_ROUNDING * float(np.abs(command_mm).max(initial=0.0))
    return bool(steps.any()) and float(np.mean(bends)) < MAX_BEND_SHARE


@dataclass(frozen=True, eq=False)
class Experiment:
    """A run with its measured motion. Times and positions count from the first sample; units mm, s, mN, g."""

    run: Run
    trusts_command: bool = False
    """Whether the command is taken as the motion even where the recorded position deviates from it."""
    computes_command: bool = False
    """Whether the command was computed by a model of the motor, so that it is not rounded."""
    calm_phases: frozenset[int] = frozenset()
    """Phases whose begin makes no pulse of the force in other runs, so that one there is a fault."""
    shared_jitter_s: float = 0.0
    """Scatter of the sampling times that other runs show."""
    soft_loop: bool = False
    """Whether some run shows that the stage's position loop gives way to the force."""
    drive_holds: bool = False
    """Whether the runs show that the motor force of a rest is anywhere within friction, as that of a position loop."""

    @property
    def kind(self) -> str:
        """Kind of run: drag, relaxation, coulomb, blank, …."""
        return self.run.info.kind

    @property
    def file(self) -> str:
        """Name of the run's file."""
        return self.run.info.path.name

    @property
    def imported(self) -> bool:
        """Whether the run was imported: its file states neither fixture nor sign convention."""
        return SOURCE_KEY in self.run.info.header.entry

    @cached_property
    def time_s(self) -> FloatArray:
        """Times of the samples from the first one on, shape `(N,)`."""
        time = np.asarray(self.run.trace.time, dtype=np.float64)
        return np.asarray(time - time[0])

    @cached_property
    def valid(self) -> Mask:
        """Which samples of the signal are numbers, within the sensor's range and no faults, shape `(N,)`."""
        return np.isfinite(self.run.trace.force) & ~clipped_samples(self.run) & ~self.faulty

    @cached_property
    def pulses(self) -> tuple[ForcePulse, ...]:
        """Impulses and dropouts of the force, and pulses at the begin of a phase."""
        return force_pulses(self.run.trace)

    @property
    def faults(self) -> tuple[ForcePulse, ...]:
        """Impulses and dropouts: pulses that the motion does not make."""
        phases = {None, *self.calm_phases}
        return tuple(pulse for pulse in self.pulses if pulse.near_phase in phases)

    @cached_property
    def faulty(self) -> Mask:
        """Which samples are of impulses and dropouts, shape `(N,)`."""
        faulty = np.zeros(self.run.trace.force.size, dtype=np.bool_)
        for pulse in self.faults:
            faulty[pulse.begin : pulse.end] = True
        return faulty

    @cached_property
    def count_mm(self) -> float:
        """The encoder's count in the run's settings, at least 1 µm."""
        return encoder_count_mm(self.run.info.header.settings_toml)

    @property
    def origin_mm(self) -> float:
        """Where on its machine the run begins; 0 where it does not say so."""
        origin = self.run.info.header.entry.get("origin_mm", 0.0)
        return float(origin) if isinstance(origin, int | float) and isfinite(origin) else 0.0

    @cached_property
    def wander_mm(self) -> float:
        """Range of the recorded position at rest, at least from one count to the next."""
        time_s, position = self.recorded
        if position.size < MIN_SAMPLES:
            return count_jitter_mm(MIN_COUNT_MM)
        command = np.asarray(self.run.trace.command, dtype=np.float64)[np.isfinite(self.run.trace.position)]
        known = bool(np.isfinite(command).all() and np.any(command != position))
        return position_wander_mm(time_s, position, command if known else None, self.count_mm)

    @property
    def clock_jitter_s(self) -> float:
        """How far the sampling times scatter, one standard deviation, by this run's motion, or else by the others'."""
        return self.shared_jitter_s if self.own_jitter_s is None else self.own_jitter_s

    @cached_property
    def own_jitter_s(self) -> float | None:
        """The scatter of the sampling times that steady motion shows; None where it is too short or slow to tell."""
        trace, time_s = self.run.trace, self.time_s
        command, position = (np.asarray(values, dtype=np.float64) for values in (trace.command, trace.position))
        known = np.isfinite(command) & np.isfinite(position)
        if np.count_nonzero(known) < MIN_SAMPLES:
            return None
        noise_mm = float(np.hypot(self.count_mm / np.sqrt(12), wander_noise_sd_mm(self.wander_mm, self.count_mm)))
        velocity = np.gradient(command[known], time_s[known])
        steady = in_phase(trace, Phase.STEADY)[known]
        return clock_jitter_s((position - command)[known], velocity, steady, noise_mm)

    @cached_property
    def follows_command(self) -> bool:
        """Whether the stage followed its command to the encoder's count, so that the command is the better record.

        A position that wanders at rest, or that a jittering clock samples, may deviate by as much more, but not for
        long. Where position and command are equal, one was derived from the other, as in foreign records; the command
        then is the better record if it moves in few pieces of constant velocity, as where all samples are whole counts.
        """
        from scipy.ndimage import uniform_filter1d

        command = np.asarray(self.run.trace.command, dtype=np.float64)
        if not np.isfinite(command).all():
            return False
        if self.trusts_command:
            return True
        time_s, position = self.recorded
        recorded = np.isfinite(self.run.trace.position)
        deviation = np.abs(position - command[recorded])
        allowed_mm = MAX_FOLLOWING_COUNTS * self.count_mm
        if float(deviation.max(initial=0.0)) <= allowed_mm:
            return bool(deviation.any()) or _moves_in_few_pieces(command)
        jitter_mm = self.clock_jitter_s * np.abs(np.gradient(command[recorded], time_s))
        wander_mm = self.wander_mm - count_jitter_mm(self.count_mm)
        if np.any(deviation > allowed_mm + wander_mm + JITTER_SIGMAS * jitter_mm):
            return False
        window = max(MIN_SAMPLES, round(SMOOTHING_WINDOW_S / float(np.median(np.diff(time_s)))))
        means_mm = np.abs(uniform_filter1d(position - command[recorded], window))
        jitter_of_means_mm = np.sqrt(np.maximum(uniform_filter1d(jitter_mm**2, window), 0.0) / window)
        largest_mm = max(allowed_mm, WINDOW_MEAN_NOISE_SHARE * self.wander_mm)
        return not np.any(means_mm > largest_mm + JITTER_SIGMAS * jitter_of_means_mm)

    @cached_property
    def gives_way(self) -> bool:
        """Whether the stage still stands off its command at the end, against the force, by more than its counts."""
        trace = self.run.trace
        if not {"force", "position"} <= set(trace.channels):
            return False
        last = slice(-max(len(trace.time) // 4, 1), None)
        off_mm = np.asarray(trace.position - trace.command, dtype=np.float64)[last]
        pull = np.asarray(trace.force[last] - trace.force[0], dtype=np.float64)
        known = np.isfinite(off_mm + pull)
        if not known.any():
            return False
        against = off_mm[known] * np.sign(np.median(pull[known]))
        return -float(np.median(against)) > GIVING_WAY_COUNTS * self.count_mm

    @cached_property
    def held_forces(self) -> tuple[float, ...]:
        """Mean motor force beyond the sensor's [mN] at rest before the motion, once the stage has settled.

        After a motion friction in presliding keeps a force as well.
        """
        trace = self.run.trace
        if "motor_force" not in trace.channels:
            return ()
        load = trace.channels.get("force", 0.0)
        own = np.asarray(trace.channels["motor_force"] - load, dtype=np.float64)
        settling = round(SETTLED_S * trace.sample_rate_hz)
        rest = own[np.flatnonzero(in_phase(trace, Phase.REST))[settling:]]
        return (float(np.mean(rest)),) if rest.size > settling and np.isfinite(rest).all() else ()

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
        return RecordedMotion.of(*self.recorded, self.wander_mm)

    @cached_property
    def unsmoothed_motion(self) -> ProfileMotion:
        """The measured motion without smoothing: straight lines, two from sample to sample, while the stage moves.

        For quantities that depend on the position and not on the sign of the speed; its velocity is as rough as the
        encoder.
        """
        if self.follows_command:
            return self.motion.profile
        return measured_motion(self.motion, *self.recorded)

    @cached_property
    def recorded(self) -> tuple[FloatArray, FloatArray]:
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
            raise AnalysisError(
                f"{self.file}: the run does not state its {', its '.join(self._not_stated(missing))}"
                + (
                    "; import it anew with --capsule, --fixture and --wall-thickness-mm, or name another model with "
                    "--nominal"
                    if self.imported
                    else ""
                )
            )
        surface = "rough" if self.contact is Contact.STICKING else "smooth"
        name = str(header.get("name") or "capsule")
        return Capsule.model_validate({"name": name, "surface": surface, **sizes})

    def _not_stated(self, missing: Sequence[str]) -> list[str]:
        """Return all that the capsule model needs of the run and nobody stated."""
        specimen = self.run.info.header.specimen
        further = ["wall's thickness"] if attribute_number(specimen, "wall_thickness_mm") is None else []
        if self.imported and self.fixture is Fixture.NONE and self.kind != "blank":
            further.append("fixture")
        return [f"capsule ({', '.join(missing)})", *further]


def session_starts(experiments: Sequence[Experiment]) -> tuple[float, ...] | None:
    """Return the time of each run's first sample since that of the first run [s]; None where it is not known.

    Stretches of one foreign file are in sequence although the date of its measurement is not known; a single one has
    nothing to be in sequence with.
    """
    headers = [experiment.run.info.header for experiment in experiments]
    undated = [header for header in headers if header.entry.get(START_UNKNOWN_KEY)]
    sources = {header.entry.get(SOURCE_KEY) for header in headers}
    if undated and (len(headers) == 1 or len(undated) < len(headers) or len(sources) > 1):
        return None
    first = min((header.start_time for header in headers), default=None)
    return () if first is None else tuple((header.start_time - first).total_seconds() for header in headers)


MAX_JOINTS = 24
"""A motion of more pieces is no programmed stroke; its joints stay where the smoothed record bends."""
SAMPLES_PER_PIECE = 64
"""Evenly spread samples of each piece that are fitted; all samples of a long steady piece add no information."""
JOINT_FREEDOM = 0.45
"""Largest move of a joint in one fit, as a share of the distance to its neighbours."""
MIN_JOINT_DISTANCE_S = 0.004
"""Start values of joints that are closer are merged."""
ROUNDING_RMS_SHARE = 0.2
"""RMS error of a position by counts or noise, over its wander."""
MAX_EVALUATIONS = 30
MAX_FITS = 4
"""Successive fits, each of which may move the joints again."""


def fit_velocity(
    motion: RecordedMotion,
    time_s: FloatArray,
    position_mm: FloatArray,
    wander_mm: float = ENCODER_JITTER_MM,
    rival_squares_mm2: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Fit a measured position.

    Parameters
    ----------
    motion
        The same record smoothed, with its rests and bends.
    time_s, position_mm
        The record, from its first sample on, shape `(N,)`.
    wander_mm
        Range of the recorded position at rest.
    rival_squares_mm2
        Mean squared residual of another description: the search for further joints ends early where it stays far above.

    Returns
    -------
    Times of the joints [s], from the start of the record to its end, and the velocity [mm/s] at each, shapes `(K,)`.
    """
    chain = _first_guess(motion)
    if len(chain.joints_s) <= MAX_JOINTS:
        chain, squares = _refine(chain, time_s, position_mm, wander_mm, rival_squares_mm2)
        if not _is_beaten(squares, rival_squares_mm2):
            chain = _simplify(chain, squares, time_s, position_mm, wander_mm)
    return chain.joints_s, chain.velocity_mm_s


@dataclass(frozen=True, slots=True, eq=False)
class _VelocityChain:
    """Joints, the velocities there, and which joints are ends of a rest."""

    joints_s: FloatArray
    velocity_mm_s: FloatArray
    resting: Mask

    def keep(self, joints: Mask) -> "_VelocityChain":
        return _VelocityChain(self.joints_s[joints], self.velocity_mm_s[joints], self.resting[joints])

    def plus(self, time_s: float) -> "_VelocityChain":
        at = int(np.searchsorted(self.joints_s, time_s))
        speed = float(np.interp(time_s, self.joints_s, self.velocity_mm_s))
        return _VelocityChain(
            np.insert(self.joints_s, at, time_s),
            np.insert(self.velocity_mm_s, at, speed),
            np.insert(self.resting, at, False),
        )

    def moved(self, time_s: FloatArray) -> FloatArray:
        """Displacement [mm] since the first joint."""
        before, after = _displacement_basis(self.joints_s, time_s)
        return np.asarray(self.velocity_mm_s @ (before + after))


def _first_guess(motion: RecordedMotion) -> _VelocityChain:
    """Take the breaks of the smoothed record, and joints just beside each rest, where its ramps may be."""
    breaks = motion.breaks_s
    rest = (motion.signs == 0) & (np.diff(breaks) >= 0.5 * SMOOTHING_WINDOW_S)
    ends = np.concatenate((breaks[:-1][rest], breaks[1:][rest]))
    beside = np.concatenate((breaks[:-1][rest] - SMOOTHING_WINDOW_S, breaks[1:][rest] + SMOOTHING_WINDOW_S))
    inside = np.array([not np.any((breaks[:-1][rest] <= time) & (time <= breaks[1:][rest])) for time in beside])
    beside = beside[(beside > breaks[0]) & (beside < breaks[-1]) & inside.astype(np.bool_)]
    times = np.union1d(np.union1d(breaks, ends), beside)
    resting = np.isin(times, ends)
    chain = _VelocityChain(times, np.where(resting, 0.0, motion.velocity(times)), resting)
    return chain.keep(_far_apart(times, resting))


def _far_apart(times: FloatArray, resting: Mask) -> Mask:
    """Mask of the joints to keep, none closer than `MIN_JOINT_DISTANCE_S`: ends of record and rests go first."""
    mask = np.zeros(len(times), dtype=np.bool_)
    mask[[0, -1]] = True
    for index in np.argsort(~resting, kind="stable"):
        mask[index] |= np.all(np.abs(times[mask] - times[index]) >= MIN_JOINT_DISTANCE_S)
    return mask


BEATEN_FACTOR, JOINTS_BEFORE_BEATEN = 4.0, 4
"""A chain whose squares exceed another description's by this factor, after so many further joints, does not hold."""


def _is_beaten(squares: float, rival_squares: float) -> bool:
    return 0.0 < BEATEN_FACTOR * rival_squares < squares


def _refine(
    chain: _VelocityChain, time_s: FloatArray, position_mm: FloatArray, wander_mm: float, rival_squares: float
) -> tuple[_VelocityChain, float]:
    """Fit a chain, adding joints while it deviates from the record by more than the wander."""
    chain, squares = _fit_chain(chain, time_s, position_mm)
    first = len(chain.joints_s)
    while squares > wander_mm**2 and len(chain.joints_s) < MAX_JOINTS:
        if len(chain.joints_s) >= first + JOINTS_BEFORE_BEATEN and _is_beaten(squares, rival_squares):
            break
        off = position_mm - chain.moved(time_s)
        off = np.abs(off - off.mean())
        off[np.abs(time_s[:, None] - chain.joints_s).min(axis=1) < MIN_JOINT_DISTANCE_S] = 0.0
        at = float(time_s[int(off.argmax())])
        finer, fewer = _fit_chain(chain.plus(at), time_s, position_mm)
        if fewer > 0.9 * squares:
            break
        chain, squares = finer, fewer
    return chain, squares


def _simplify(
    chain: _VelocityChain, squares: float, time_s: FloatArray, position_mm: FloatArray, wander_mm: float
) -> _VelocityChain:
    """Remove joints while the record does not need them (Bayesian information criterion)."""
    while (joint := _least_needed_joint(chain)) is not None:
        fewer, more = _fit_chain(chain.keep(np.arange(len(chain.joints_s)) != joint), time_s, position_mm)
        samples = SAMPLES_PER_PIECE * len(fewer.joints_s)
        if more > max(squares, (ROUNDING_RMS_SHARE * wander_mm) ** 2) * (1 + 2 * log(samples) / samples):
            break
        chain, squares = fewer, more
    return chain


def _least_needed_joint(chain: _VelocityChain) -> int | None:
    """Find the joint whose removal changes the positions least; None where only ends of rests are left."""
    time, velocity = chain.joints_s, chain.velocity_mm_s
    share = (time[1:-1] - time[:-2]) / (time[2:] - time[:-2])
    off = np.abs(velocity[1:-1] - velocity[:-2] - share * (velocity[2:] - velocity[:-2])) * (time[2:] - time[:-2])
    off[chain.resting[1:-1]] = np.inf
    if not np.isfinite(off).any():
        return None
    return int(off.argmin()) + 1


def _fit_chain(chain: _VelocityChain, time_s: FloatArray, position_mm: FloatArray) -> tuple[_VelocityChain, float]:
    """Fit velocities and times of the joints; also return the mean squared residual [mm²]."""
    from scipy.optimize import least_squares

    squares = np.inf
    for _ in range(MAX_FITS):
        edges = np.searchsorted(time_s, chain.joints_s)
        edges[-1] = len(time_s) - 1
        spread = [np.linspace(*ends, SAMPLES_PER_PIECE).astype(np.intp) for ends in pairwise(edges.tolist())]
        at = np.unique(np.concatenate(spread))
        moving = np.flatnonzero(~chain.resting)
        inner = np.arange(1, len(chain.joints_s) - 1)
        gaps = JOINT_FREEDOM * np.diff(chain.joints_s)
        free = np.concatenate(([position_mm[0]], chain.velocity_mm_s[moving]))
        start = np.concatenate((free, chain.joints_s[inner]))
        lowest = np.concatenate((np.full(len(free), -np.inf), chain.joints_s[inner] - gaps[:-1]))
        highest = np.concatenate((np.full(len(free), np.inf), chain.joints_s[inner] + gaps[1:]))
        problem = _ChainLeastSquares(chain, moving, inner, time_s[at], position_mm[at])
        done = least_squares(
            problem.residual,
            start,
            problem.jacobian,
            (lowest, highest),
            x_scale="jac",
            ftol=1e-6,
            max_nfev=MAX_EVALUATIONS,
        )
        chain = problem.chain_of(done.x)
        before, squares = squares, 2 * float(done.cost) / len(at)
        if squares > 0.99 * before:
            break
    return chain, squares


@dataclass(frozen=True, slots=True, eq=False)
class _ChainLeastSquares:
    chain: _VelocityChain
    moving: IndexArray
    inner: IndexArray
    time_s: FloatArray
    position_mm: FloatArray

    def chain_of(self, values: FloatArray) -> _VelocityChain:
        joints, velocity = self.chain.joints_s.copy(), np.zeros(len(self.chain.joints_s))
        velocity[self.moving] = values[1 : 1 + len(self.moving)]
        joints[self.inner] = values[1 + len(self.moving) :]
        return _VelocityChain(joints, velocity, self.chain.resting)

    def residual(self, values: FloatArray) -> FloatArray:
        return np.asarray(values[0] + self.chain_of(values).moved(self.time_s) - self.position_mm)

    def jacobian(self, values: FloatArray) -> FloatArray:
        chain = self.chain_of(values)
        before, after = _displacement_basis(chain.joints_s, self.time_s)
        slope = np.diff(chain.velocity_mm_s) / np.diff(chain.joints_s)
        shifted = -slope[self.inner - 1, None] * before[self.inner] - slope[self.inner, None] * after[self.inner]
        return np.vstack((np.ones((1, len(self.time_s))), (before + after)[self.moving], shifted)).T


def _displacement_basis(joints_s: FloatArray, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Displacement by 1 mm/s at one joint, before the joint and after it, shapes `(K, n)`."""
    length = np.diff(joints_s)[:, None]
    elapsed = np.clip(time_s - joints_s[:-1, None], 0.0, length)
    rising = elapsed**2 / (2 * length)
    nothing = np.zeros((1, len(time_s)))
    return np.vstack((nothing, rising)), np.vstack((elapsed - rising, nothing))


KNOT_STEP_S, MIN_SAMPLES_PER_KNOT, MAX_KNOTS = 0.004, 4, 2000
"""Distance of a spline's knots, which follows a motion of 60 Hz, as of a motor that cogs, and its limits."""
SPLINE_DEGREE, PENALISED_DERIVATIVE = 5, 3
"""A quintic spline whose third derivative is penalised has an acceleration that changes gradually."""
PENALTIES = np.geomspace(1e-6, 1e10, 17)
"""Weights of the penalty that are tried, relative to that of the data."""
HELD_OUT_FOLDS, HELD_OUT_SAMPLES = 5, 3
"""Every fifth stretch of three samples is held out at a time."""
BETTER_SIGMAS, STRETCH_SAMPLES = 4.0, 15
"""A spline is taken where it predicts held-out samples better than the chain by so much, over stretches of samples."""


@dataclass(frozen=True, slots=True, eq=False)
class _SmoothMotion:
    """A measured position as a penalised spline."""

    knots: FloatArray
    coefficients: FloatArray
    held_out_mm: FloatArray
    """Errors of the samples when they were held out, shape `(N,)`."""
    factor: FloatArray
    """Banded Cholesky factor of the normal equations, of unit noise."""
    less_smooth: FloatArray
    """Coefficients with a tenth of the penalty, which show what the penalty takes away."""

    def derivative(self, time_s: FloatArray, order: int) -> FloatArray:
        """Return a derivative at times of shape `(n,)`."""
        from scipy.interpolate import BSpline

        return np.asarray(BSpline(self.knots, self.coefficients, SPLINE_DEGREE)(time_s, nu=order))

    def acceleration_sd(self, time_s: FloatArray) -> FloatArray:
        """Return the standard deviation of the acceleration, smoothing's loss included [mm/s²], shape `(n,)`."""
        from scipy.interpolate import BSpline
        from scipy.linalg import cho_solve_banded

        identity = np.eye(len(self.coefficients))
        rows = np.asarray(BSpline(self.knots, identity, SPLINE_DEGREE)(time_s, nu=2), dtype=np.float64)
        variance = np.einsum("nk,kn->n", rows, cho_solve_banded((self.factor, True), rows.T))
        taken_away = np.abs(rows @ (self.coefficients - self.less_smooth))
        taken_away = np.maximum(taken_away, np.maximum(np.append(taken_away[1:], 0.0), np.append(0.0, taken_away[:-1])))
        random = np.sqrt(np.maximum(float(np.mean(self.held_out_mm**2)) * variance, 0.0))
        return np.asarray(np.hypot(random, taken_away))


def _fit_smooth(time_s: FloatArray, position_mm: FloatArray) -> _SmoothMotion | None:
    """Fit a spline whose penalty predicts held-out samples best; None for too short a record."""
    from scipy.interpolate import BSpline
    from scipy.linalg import cho_solve_banded, cholesky_banded
    from scipy.sparse import diags_array

    span = float(time_s[-1] - time_s[0])
    step = max(KNOT_STEP_S, MIN_SAMPLES_PER_KNOT * span / len(time_s), span / MAX_KNOTS)
    intervals = int(span / step)
    if intervals < SPLINE_DEGREE:
        return None
    width = span / intervals
    knots = time_s[0] + width * np.arange(-SPLINE_DEGREE, intervals + SPLINE_DEGREE + 1)
    knots[SPLINE_DEGREE + intervals] = max(knots[SPLINE_DEGREE + intervals], time_s[-1])
    design = BSpline.design_matrix(time_s, knots, SPLINE_DEGREE).tocsr()
    count = design.shape[1]
    weights = np.diff(np.eye(PENALISED_DERIVATIVE + 1), PENALISED_DERIVATIVE, axis=0)[0]
    differences = diags_array(
        [np.full(count - PENALISED_DERIVATIVE, weight).tolist() for weight in weights],
        offsets=np.arange(PENALISED_DERIVATIVE + 1),
        shape=(count - PENALISED_DERIVATIVE, count),
    )
    penalty = _lower_bands((differences.T @ differences).diagonal)
    fold = np.arange(len(time_s)) // HELD_OUT_SAMPLES % HELD_OUT_FOLDS
    parts = [(design[fold == number], position_mm[fold == number]) for number in range(HELD_OUT_FOLDS)]
    grams = [_lower_bands((rows.T @ rows).diagonal) for rows, _ in parts]
    moments = [rows.T @ values for rows, values in parts]
    total, moment = np.sum(grams, axis=0), np.sum(moments, axis=0)
    errors = np.zeros((len(PENALTIES), len(time_s)))
    for error, weight in zip(errors, PENALTIES, strict=True):
        for number, (rows, values) in enumerate(parts):
            factor = cholesky_banded(total - grams[number] + weight * penalty + _ridge(total), lower=True)
            error[fold == number] = rows @ cho_solve_banded((factor, True), moment - moments[number]) - values
    best = int(np.argmin((errors**2).sum(axis=1)))
    less, factor = (
        cholesky_banded(total + weight * penalty + _ridge(total), lower=True)
        for weight in (PENALTIES[max(best - 1, 0)], PENALTIES[best])
    )
    coefficients, less_smooth = (cho_solve_banded((root, True), moment) for root in (factor, less))
    return _SmoothMotion(knots, coefficients, errors[best], factor, less_smooth)


def _lower_bands(diagonal: Callable[[int], FloatArray]) -> FloatArray:
    """Return the diagonal and the bands below it, as banded solvers take them, shape `(degree + 1, n)`.

    Parameters
    ----------
    diagonal
        Returns the diagonal of a matrix by its number, 0 for the main one and negative below it.
    """
    return np.array([np.append(diagonal(-band), np.zeros(band)) for band in range(SPLINE_DEGREE + 1)])


def _ridge(bands: FloatArray) -> FloatArray:
    """Return a diagonal that keeps a coefficient without samples from being undetermined."""
    ridge = np.zeros_like(bands)
    ridge[0] = 1e-9 * bands[0].mean()
    return ridge


def _chain_held_out(chain: tuple[FloatArray, FloatArray], time_s: FloatArray, position_mm: FloatArray) -> FloatArray:
    """Return the errors of held-out samples of a chain whose joints stay where they are, shape `(N,)`."""
    joints, velocity = chain
    moving = velocity != 0
    before, after = _displacement_basis(joints, time_s)
    columns = np.vstack((np.ones((1, len(time_s))), (before + after)[moving])).T
    fold = np.arange(len(time_s)) // HELD_OUT_SAMPLES % HELD_OUT_FOLDS
    columns /= np.linalg.norm(columns, axis=0)
    gram, moment = columns.T @ columns + 1e-12 * np.eye(columns.shape[1]), columns.T @ position_mm
    errors = np.zeros(len(time_s))
    for number in range(HELD_OUT_FOLDS):
        rows, values = columns[fold == number], position_mm[fold == number]
        errors[fold == number] = rows @ np.linalg.solve(gram - rows.T @ rows, moment - rows.T @ values) - values
    return errors


def _predicts_better(errors: FloatArray, rival: FloatArray) -> bool:
    """Whether errors of held-out samples are smaller than a rival's, beyond chance; neighbours err alike."""
    gain = rival**2 - errors**2
    stretches = np.add.reduceat(gain, np.arange(0, len(gain), STRETCH_SAMPLES))
    scatter = float(stretches.std()) * float(np.sqrt(len(stretches)))
    return float(stretches.sum()) > BETTER_SIGMAS * scatter


RAMP_LENGTH_WANDERS = 4 / 3
"""Error of a ramp's length in units of the wander: a count at either end."""
GENTLE_WANDERS, TURNING_WANDERS, MAX_GENTLE_START_S = 8.0, 2.0, 0.1
"""Wanders over speed by which a smooth motion may begin before it shows, and turn, and the longest such time."""
TURNED_MM_S = 0.15
"""Speed at which a stage has turned: friction has its sign and size."""
MAX_JOINT_TIMING_S = 0.01
"""Uncertainty of a joint's time in the slowest motion."""


@dataclass(frozen=True, slots=True, eq=False)
class Kinematics:
    """A motion whose velocity is a chain of straight lines, close to each other where it is a smooth function."""

    joints_s: FloatArray
    """Times at which the lines join, from the first sample to the last, shape `(K,)`."""
    velocity_mm_s: FloatArray
    """Velocity at the joints, shape `(K,)`."""
    step_s: float
    """Time between samples."""
    wander_mm: float = ENCODER_JITTER_MM
    """Range of the recorded position at rest."""
    smooth: "SmoothAcceleration | None" = None
    """The acceleration where it is a smooth function; None where it is that of the straight lines."""

    @property
    def events_s(self) -> FloatArray:
        """Times at which a force that depends on the motion may jump or bend, shape `(E,)`."""
        return self.joints_s if self.smooth is None else self.smooth.events_s

    def velocity(self, time_s: FloatArray) -> FloatArray:
        """Velocity [mm/s] at times of shape `(n,)`."""
        return np.interp(time_s, self.joints_s, self.velocity_mm_s)

    def acceleration(self, time_s: FloatArray) -> FloatArray:
        """Acceleration [mm/s²] at times of shape `(n,)`; at a joint, that of the piece that begins there."""
        if self.smooth is not None:
            return np.interp(time_s, self.joints_s, self.smooth.acceleration_mm_s2)
        slope = np.diff(self.velocity_mm_s) / np.diff(self.joints_s)
        return np.asarray(slope[self._piece(time_s)])

    def acceleration_error(self, time_s: FloatArray) -> FloatArray:
        """Error [mm/s²] of the acceleration, one standard deviation, shape `(n,)`.

        A count more or less moves the ends of a ramp, and the errors of all its samples are equal; the error is
        widened so that samples taken as independent weigh no more than the ramp as a whole.
        """
        if self.smooth is not None:
            return np.interp(time_s, self.joints_s, self.smooth.sd_mm_s2)
        length, change = np.diff(self.joints_s), np.abs(np.diff(self.velocity_mm_s))
        fastest = np.maximum(np.abs(self.velocity_mm_s[1:]), np.abs(self.velocity_mm_s[:-1]))
        stretched = RAMP_LENGTH_WANDERS * self.wander_mm / np.maximum(fastest, 1e-9) / length
        error = change / length * np.minimum(stretched, 1.0) * np.sqrt(np.maximum(length / self.step_s, 1.0))
        return np.asarray(error[self._piece(time_s)])

    def joint_uncertainty(self, quantity: Callable[[FloatArray], FloatArray], time_s: FloatArray) -> FloatArray:
        """Return the uncertainty near the joints of a quantity computed from this motion, 0 elsewhere, shape `(n,)`.

        The side of a joint on which a sample lies is known only up to the time in which the stage moves by the
        encoder's wander, and up to one sample, for position and force need not be of the same instant.

        Parameters
        ----------
        quantity
            The quantity, at rising times.
        time_s
            Rising times.
        """
        if self.smooth is None:
            joints, speed = self.joints_s, np.abs(self.velocity_mm_s)
            fastest = np.maximum(speed, np.maximum(np.append(speed[1:], 0.0), np.append(0.0, speed[:-1])))
            timing = self.step_s + np.minimum(self.wander_mm / np.maximum(fastest, 1e-9), MAX_JOINT_TIMING_S)
            through = np.zeros(joints.size, dtype=np.bool_)
        else:
            joints, timing, through = self._turns()
        nearest = np.searchsorted(0.5 * (joints[1:] + joints[:-1]), time_s)
        shift = timing[nearest]
        change = np.zeros(len(time_s))
        unshifted = quantity(time_s)
        # Where parts of the quantity cancel after one shift, they do not after another.
        for share in (-1.0, 1.0) if self.smooth is None else (-1.0, -0.5, 0.5, 1.0):
            shifted_s = np.maximum.accumulate(time_s + share * shift)
            shifted = quantity(np.clip(shifted_s, self.joints_s[0], self.joints_s[-1]))
            change = np.maximum(change, np.abs(shifted - unshifted))
        if through.any():
            change = np.where(through[nearest], self._jumps(quantity, joints, timing)[nearest], change)
        return np.where(np.abs(time_s - joints[nearest]) <= shift, change, 0.0)

    def _jumps(
        self, quantity: Callable[[FloatArray], FloatArray], turns_s: FloatArray, timing_s: FloatArray
    ) -> FloatArray:
        """Return by how much a quantity jumps where a motion passes through zero, shape `(T,)`.

        All else of it changes with the time alone, as where a force ripples many times a second.
        """
        aside = np.clip(turns_s[:, None] + timing_s[:, None] * (-1.0, 1.0), self.joints_s[0], self.joints_s[-1])
        faster = np.maximum(np.abs(self.velocity(aside)).max(axis=1), TURNED_MM_S)
        beside_s = timing_s * TURNED_MM_S / faster
        times = np.clip(turns_s[:, None] + beside_s[:, None] * (-1.0, 1.0), self.joints_s[0], self.joints_s[-1]).ravel()
        order = np.argsort(times, kind="stable")
        values = np.empty_like(times)
        values[order] = quantity(times[order])
        return np.asarray(np.abs(np.diff(values.reshape(-1, 2), axis=1))[:, 0])

    def _turns(self) -> tuple[FloatArray, FloatArray, Mask]:
        """Return when a smooth motion starts, stops or turns, how well that is known [s], and which are turns, `(T,)`.

        Such a motion sets in so gently that it shows only after it has left the encoder's wander: where it grows with
        a power n of the time, it began n + 1 wanders over its speed before. A motion that turns without a rest passes
        through zero in a straight line.
        """
        still = self.velocity_mm_s == 0
        before, after = np.append(True, still[:-1]), np.append(still[1:], True)
        turns = np.flatnonzero(still & ~(before & after))
        turns = np.union1d(turns, [0, len(still) - 1])
        speed = np.abs(self.velocity_mm_s)
        beside = np.maximum(np.append(speed[1:], 0.0), np.append(0.0, speed[:-1]))[turns]
        through = still[turns] & ~(before | after)[turns]
        wanders = np.where(through, TURNING_WANDERS, GENTLE_WANDERS)
        gentle_s = np.minimum(wanders * self.wander_mm / np.maximum(beside, 1e-9), MAX_GENTLE_START_S)
        return self.joints_s[turns], self.step_s + np.where(beside > 0, gentle_s, 0.0), through

    def _piece(self, time_s: FloatArray) -> IndexArray:
        piece = np.searchsorted(self.joints_s, time_s, side="right") - 1
        return np.clip(piece, 0, len(self.joints_s) - 2)


@dataclass(frozen=True, slots=True, eq=False)
class SmoothAcceleration:
    """An acceleration that changes gradually, at the joints of a `Kinematics`, shapes `(K,)`."""

    acceleration_mm_s2: FloatArray
    sd_mm_s2: FloatArray
    """`acceleration_mm_s2`, `sd_mm_s2`: the acceleration and its error, one standard deviation."""
    events_s: FloatArray
    """Starts, stops, turns, and moments between them that are close enough for a force to be nearly straight."""


MAX_SMOOTHED_SAMPLES = 20_000
"""A longer record is thinned for its spline, whose knots are further apart then."""
SMOOTH_EVENTS = 24
"""Moments of a smooth motion between which a force is taken as nearly straight."""
ERROR_TIMES = 200
"""Times at which a spline's error is computed."""
FITS_REMEMBERED = 64
"""Runs whose fit is remembered, for a diagnosis and what follows it prepare the same runs several times; of records up
to `MAX_SMOOTHED_SAMPLES`, so that 20 MB are kept at most."""


def fit_kinematics(experiment: Experiment) -> Kinematics:
    """Fit the measured position of a run; raises `AnalysisError` where its motion cannot be used."""
    time_s, position = experiment.recorded
    wander_mm, step_s = experiment.wander_mm, 1.0 / experiment.run.trace.sample_rate_hz
    if len(time_s) > MAX_SMOOTHED_SAMPLES:
        return _fit_record(experiment.motion, time_s, position, wander_mm, step_s)
    return _fit_short_record(experiment.motion, time_s.tobytes(), position.tobytes(), wander_mm, step_s)


@lru_cache(maxsize=FITS_REMEMBERED)
def _fit_short_record(
    motion: RecordedMotion, time_s: bytes, position_mm: bytes, wander_mm: float, step_s: float
) -> Kinematics:
    return _fit_record(motion, np.frombuffer(time_s), np.frombuffer(position_mm), wander_mm, step_s)


def _fit_record(
    motion: RecordedMotion, time_s: FloatArray, position: FloatArray, wander_mm: float, step_s: float
) -> Kinematics:
    thinned = slice(None, None, 1 + len(time_s) // MAX_SMOOTHED_SAMPLES)
    smooth = _fit_smooth(time_s[thinned], position[thinned])
    rival = 0.0 if smooth is None else float(np.mean(smooth.held_out_mm**2))
    chain = fit_velocity(motion, time_s, position, wander_mm, rival)
    by_chain = _chain_held_out(chain, time_s[thinned], position[thinned])
    if smooth is None or not _predicts_better(smooth.held_out_mm, by_chain):
        return Kinematics(*insert_reversals(*chain), step_s, wander_mm)
    return _smooth_kinematics(smooth, motion, time_s, step_s, wander_mm)


def _smooth_kinematics(
    smooth: _SmoothMotion, motion: RecordedMotion, time_s: FloatArray, step_s: float, wander_mm: float
) -> Kinematics:
    """Return a spline as a fine chain that is still where the stage rests."""
    rest = (motion.signs == 0) & (np.diff(motion.breaks_s) >= 0.5 * SMOOTHING_WINDOW_S)
    starts, stops = motion.breaks_s[:-1][rest], motion.breaks_s[1:][rest]
    width = smooth.knots[1] - smooth.knots[0]
    fine = np.linspace(time_s[0], time_s[-1], 2 * int((time_s[-1] - time_s[0]) / width) + 2)
    joints = np.union1d(fine, np.concatenate((starts, stops)))
    joints = joints[np.append(True, np.diff(joints) > 1e-9)]
    still = np.any((joints[:, None] >= starts - 1e-9) & (joints[:, None] <= stops + 1e-9), axis=1)
    joints, velocity = insert_reversals(joints, np.where(still, 0.0, smooth.derivative(joints, 1)))
    still = np.any((joints[:, None] >= starts - 1e-9) & (joints[:, None] <= stops + 1e-9), axis=1)
    inside = still & np.append(True, still[:-1]) & np.append(still[1:], True)
    turns = joints[(velocity == 0) & ~inside]
    at = np.linspace(time_s[0], time_s[-1], ERROR_TIMES)
    # Blocks are taken as independent, the errors of an acceleration within a knot's reach are equal.
    sd = float(np.sqrt(max(width / step_s, 1.0))) * np.interp(joints, at, smooth.acceleration_sd(at))
    smooth_acceleration = SmoothAcceleration(
        np.where(still, 0.0, smooth.derivative(joints, 2)),
        np.where(still, 0.0, sd),
        np.union1d(np.linspace(time_s[0], time_s[-1], SMOOTH_EVENTS + 2), turns),
    )
    return Kinematics(joints, velocity, step_s, wander_mm, smooth_acceleration)


def insert_reversals(joints_s: FloatArray, velocity_mm_s: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Add a joint wherever a straight line of velocity crosses 0, where friction changes sign.

    None is added that rounding would put onto another joint.
    """
    before, after = velocity_mm_s[:-1], velocity_mm_s[1:]
    turning = np.flatnonzero(before * after < 0)
    share = before[turning] / (before[turning] - after[turning])
    turns_s = joints_s[turning] + share * np.diff(joints_s)[turning]
    between = (turns_s > joints_s[turning]) & (turns_s < joints_s[turning + 1])
    turning, turns_s = turning[between], turns_s[between]
    return np.insert(joints_s, turning + 1, turns_s), np.insert(velocity_mm_s, turning + 1, 0.0)
