"""Limits of naming by the runs: effects that look like a force in motion, and questions that they cannot answer."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from dragrig.analysis.gap.design import ColumnKind, Design, fit_columns
from dragrig.analysis.gap.run_data import RunData
from dragrig.rig import Contact, FloatArray, IndexArray, Phase
from dragrig.sim_backend.effects import Coordinate, Location, SlipHistory

CONFOUNDED_SHARE = 0.8
"""Share of an effect's chi-square, beside the nominal parameters, above which it counts as confounded."""
WAY_LENGTHS = 8
"""Number of lengths over which friction may evolve, from a hundredth of the longest travel on."""
WAY_POWERS = (1, 2, 3)


def confounded_with_friction(design: Design, runs: Sequence[RunData]) -> bool:
    """Whether candidates act like friction that evolves with travel in the same way in all runs.

    Friction has the sign of the motion and vanishes at rest. Runs at several speeds, in both directions or with rests
    separate it from functions of time or of force.
    """
    effect_force = np.concatenate([run.whitening.whiten(run.effect_force) for run in design.runs])
    if not np.any(effect_force):
        return False
    rows = []
    longest = max(float(np.ptp(data.coordinates.position_mm)) for data in runs)
    for run_data, run in zip(runs, design.runs, strict=True):
        columns_of_run = np.hstack(
            (run.columns[:, design.columns_of(ColumnKind.NOMINAL)], _friction_columns(run_data, longest))
        )
        rows.append(run.whitening.whiten(columns_of_run))
    columns = np.concatenate(rows)
    norms = np.linalg.norm(columns, axis=0)
    columns = columns[:, norms > 0] / norms[norms > 0]
    nominal = np.concatenate(
        [run.whitening.whiten(run.columns[:, design.columns_of(ColumnKind.NOMINAL)]) for run in design.runs]
    )
    beside_nominal = _residual_chi2(nominal, effect_force)
    return bool(beside_nominal > 0 and _residual_chi2(columns, effect_force) < (1 - CONFOUNDED_SHARE) * beside_nominal)


def _residual_chi2(columns: FloatArray, values: FloatArray) -> float:
    return float(np.sum(_beside(columns, values) ** 2))


def _beside(columns: FloatArray, values: FloatArray) -> FloatArray:
    """Return the part of values that columns cannot represent, shape `(B,)` or `(B, m)`."""
    return np.asarray(values - columns @ np.linalg.lstsq(columns, values, rcond=1e-10)[0])


def _friction_columns(run: RunData, longest_mm: float) -> FloatArray:
    """Return smooth functions of travel with the sign of the motion, shape `(B, K)`."""
    blocks = run.coordinates
    travel = np.abs(blocks.position_mm - blocks.position_mm[0]) / max(longest_mm, 1e-12)
    measured_sign = np.sign(run.experiment.velocity(blocks.time_s))
    # An encoder of 1 µm shows the slowest motions as rest; in steady motion the run's direction is taken.
    direction = float(np.sign(blocks.position_mm[-1] - blocks.position_mm[0])) or 1.0
    sign = np.where(blocks.phase == Phase.STEADY, direction, measured_sign)
    shapes = [travel**power for power in WAY_POWERS] + [
        np.exp(-travel / length) for length in np.geomspace(0.01, 1, WAY_LENGTHS)
    ]
    return np.asarray(sign[:, None] * np.stack(shapes, axis=1))


HISTORY_S = np.geomspace(0.03, 30.0, 7)
"""Time constants of a force that changes since the last start or stop, whatever it is."""
FRICTION_SPEEDS_MM_S = np.geomspace(0.3, 100.0, 7)
"""Speeds over which friction may change."""
MIN_SIZE_SIGMAS = 3.0
"""A size that is less certain is not determined."""
MIN_FREE_BLOCKS = 20
"""With fewer blocks beyond the free functions, nothing is told apart."""
CONSISTENT_SIZES = 0.5, 2.0
"""Size of an effect beside free functions of the motion over its size in the fit, where the runs tell both apart."""


PLACE_HARMONICS = 3


@dataclass(frozen=True, slots=True)
class SizeBesideMotion:
    """Size of an effect beside any force that depends on speed, or on time or travel in motion, relative to the fit."""

    size: float
    standard_error: float
    """Scatter that nothing explains included."""

    @property
    def is_separable(self) -> bool:
        """Whether the effect shows at its size beside such a force."""
        low, high = CONSISTENT_SIZES
        return low < self.size < high and self.size > MIN_SIZE_SIGMAS * self.standard_error

    @property
    def is_contradicted(self) -> bool:
        """Whether the runs would show the effect beside such a force, and do not."""
        return self.size < CONSISTENT_SIZES[0] and MIN_SIZE_SIGMAS * self.standard_error < 1.0


def size_beside_motion(
    design: Design, runs: Sequence[RunData], number: int, periods_mm: Sequence[float] = ()
) -> SizeBesideMotion | None:
    """Return the remainder of a candidate beside free functions of the motion; None where nothing can be left.

    A relaxation or a friction law that the nominal model misses depends on the motion alone. Such a force is added as
    free functions that all runs share; an effect's gain beside these is its own.

    Parameters
    ----------
    number
        Number of the candidate.
    periods_mm
        Periods on the machine, of which the force may be any function, too.
    """
    longest = max(float(np.ptp(data.coordinates.position_mm)) for data in runs)
    columns_of_runs, pairs = [], []
    own, others = _columns_of_candidate(design, number)
    candidate = design.candidates[number]
    fitted_size = candidate.values[candidate.effect.size.name]
    for run_data, run in zip(runs, design.runs, strict=True):
        force = run.effect_force if len(design.candidates) == 1 else run.columns[:, own] * fitted_size
        nominal = run.columns[:, np.concatenate((design.columns_of(ColumnKind.NOMINAL), others))]
        free_functions = _friction_columns(run_data, longest), _history_columns(run_data)
        columns = np.hstack((nominal, *free_functions, _periodic_columns(run_data, periods_mm)))
        columns_of_runs.append(run.whitening.whiten(columns))
        pairs.append(run.whitening.whiten(np.column_stack((run.residual + force, force))))
    columns = np.concatenate(columns_of_runs)
    norms = np.linalg.norm(columns, axis=0)
    columns = columns[:, norms > 0] / norms[norms > 0]
    free = len(columns) - columns.shape[1]
    residual, effect = _beside(columns, np.concatenate(pairs)).T
    power = float(effect @ effect)
    if free < MIN_FREE_BLOCKS or power <= 0:
        return None
    size = float(residual @ effect) / power
    # What neither explains makes the size less certain.
    scatter = max(float(np.sum((residual - size * effect) ** 2)) / free, 1.0)
    return SizeBesideMotion(size, float(np.sqrt(scatter / power)))


def _periodic_columns(run: RunData, periods_mm: Sequence[float]) -> FloatArray:
    """Return the first harmonics of periods on the machine, shape `(B, K)`."""
    place = run.experiment.origin_mm + run.coordinates.position_mm
    waves = np.outer(1.0 / np.array(periods_mm, dtype=np.float64), np.arange(1, PLACE_HARMONICS + 1)).ravel()
    angle = 2 * np.pi * place[:, None] * waves
    return np.hstack((np.cos(angle), np.sin(angle)))


def _columns_of_candidate(design: Design, number: int) -> tuple[int, IndexArray]:
    """Return the column of a candidate's size, and the columns of all other candidates."""
    counts = [len(candidate.fitted_parameters) for candidate in design.candidates]
    owners = np.repeat(np.arange(len(counts)), counts)
    columns = design.columns_of(ColumnKind.EFFECT)
    candidate = design.candidates[number]
    names = [parameter.name for parameter in candidate.fitted_parameters]
    own = columns[owners == number][names.index(candidate.effect.size.name)]
    return int(own), columns[owners != number]


def _history_columns(run: RunData) -> FloatArray:
    """Return smooth functions of time since start and stop, with the sign of the motion and without, and of speed."""
    blocks = run.coordinates
    slip = SlipHistory.of(run.experiment.motion, blocks.time_s)
    moves = slip.heading * slip.moving
    since_start = np.exp(-slip.since_start_s[:, None] / HISTORY_S) * (slip.heading != 0)[:, None]
    since_stop = np.exp(-slip.since_stop_s[:, None] / HISTORY_S) * (slip.since_stop_s > 0)[:, None]
    history = np.hstack((since_start, since_stop, (slip.heading != 0)[:, None], (slip.since_stop_s > 0)[:, None]))
    speed = moves[:, None] * np.exp(-blocks.speed_mm_s[:, None] / FRICTION_SPEEDS_MM_S)
    return np.hstack((history, slip.heading[:, None] * history, speed, (moves * blocks.speed_mm_s)[:, None]))


SENSOR_PLACES = (Location.FORCE_SENSOR, Location.ACQUISITION)


def naming_obstacle(design: Design, runs: Sequence[RunData], periods_mm: Sequence[float] = ()) -> str:
    """Say why runs do not establish the candidates of a design, though they fit; empty where nothing stands against it.

    Half a sentence that follows "not established:".

    Parameters
    ----------
    periods_mm
        Periods on the machine that the runs show.
    """
    of_sensor = any(candidate.effect.location in SENSOR_PLACES for candidate in design.candidates)
    too_few = len(runs) < MIN_RUNS_TO_HOLD_OUT or len({run.condition for run in runs}) == 1
    if len(runs) == 1 or (of_sensor and too_few):
        return "nothing can be held out of so few runs or conditions"
    if any(candidate.at_limit for candidate in design.candidates):
        return "its size is at the limit of what is possible"
    added = max(float(np.abs(run.effect_force).max(initial=0.0)) for run in design.runs)
    range_mN = max(float(np.ptp(run.block_data.blocks.mean)) for run in runs)
    if added > range_mN:
        return f"it would add {added:.3g} mN, and no measured force varies by more than {range_mN:.3g} mN"
    if not _sizes_determined(design):
        return "its size is not determined"
    return sensor_obstacle(design, runs, periods_mm)


NOT_SEPARABLE = (
    "these runs do not tell it from a force that changes with speed or place, or with time or travel in motion"
)


def sensor_obstacle(
    design: Design, runs: Sequence[RunData], periods_mm: Sequence[float] = (), *, knows_specimen: bool = False
) -> str:
    """Say why runs do not establish the effects of the sensor in a design; empty where nothing stands against them.

    Parameters
    ----------
    knows_specimen
        Whether the nominal model knows how its specimen relaxes. A drift is a function of time like any other; with
        such a model it counts unless the runs show that a force that changes in motion takes its place.
    """
    for number, candidate in enumerate(design.candidates):
        effect = candidate.effect
        if effect.location not in SENSOR_PLACES:
            continue
        left = size_beside_motion(design, runs, number, periods_mm)
        if knows_specimen and effect.coordinate is Coordinate.TIME:
            if left is not None and left.is_contradicted:
                return f"beside a force that changes in motion these runs show no {effect.name}"
        elif left is None or not left.is_separable:
            return NOT_SEPARABLE
    return ""


def _sizes_determined(design: Design) -> bool:
    fit = fit_columns(design, design.total_gram(), ColumnKind.NOMINAL, ColumnKind.MODEL_ERROR, ColumnKind.EFFECT)
    errors = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    effect_errors = errors[np.searchsorted(fit.columns, design.columns_of(ColumnKind.EFFECT))].tolist()
    for candidate in design.candidates:
        names = [parameter.name for parameter in candidate.fitted_parameters]
        error, effect_errors = effect_errors[names.index(candidate.effect.size.name)], effect_errors[len(names) :]
        if abs(candidate.values[candidate.effect.size.name]) < MIN_SIZE_SIGMAS * error:
            return False
    return True


MIN_RUNS_TO_HOLD_OUT = 4
MIN_SPEEDS = 3
MOVING_MM_S = 0.01
CLEARLY_MOVING = 10.0
"""Top speed over `MOVING_MM_S` above which a slower moment is a rest."""


def general_limitations(runs: Sequence[RunData]) -> Iterator[str]:
    """Yield limitations that hold for any model."""
    if len({(run.condition, run.direction) for run in runs}) == len(runs):
        yield "No condition was repeated: repeatability is assumed, not measured."
    traces = [run.experiment.run.trace for run in runs]
    # Without a command of its own, a record has the position in its place.
    if all(np.array_equal(trace.command, trace.position, equal_nan=True) for trace in traces):
        yield "No command was recorded: nothing is known of motor effects."


def capsule_limitations(runs: Sequence[RunData]) -> Iterator[str]:
    """Yield limitations of runs with capsule and gut."""
    kinds = {run.experiment.kind for run in runs}
    speeds = {run.condition[1] for run in runs if run.experiment.kind == "drag"}
    if "relaxation" not in kinds:
        yield "No relaxation runs: nothing is known of further relaxation modes or of stiffening with strain."
    if "drag" not in kinds:
        yield "No drag runs: nothing is known of effects in a closed gut (adhesion, folds, lift-off, inertia)."
    elif len(speeds) < MIN_SPEEDS:
        yield "Fewer than three drag speeds: effects of speed cannot be separated."
    if "blank" not in kinds:
        yield "No blank runs: effects of the rig itself are seen only through the gut."
    if "coulomb" not in kinds:
        yield "No Coulomb runs: adhesion cannot be separated from friction that falls with speed."


def goes_one_way(runs: Sequence[RunData]) -> bool:
    """Whether no two moments of any runs move in opposite directions."""
    velocity = np.concatenate([run.experiment.velocity(run.block_data.blocks.nodes_s) for run in runs])
    return bool(velocity.min(initial=0.0) >= -MOVING_MM_S or velocity.max(initial=0.0) <= MOVING_MM_S)


def _rests(run: RunData) -> bool:
    """Whether the stage stands still at any time; phases need not be known, but slow motion is no rest."""
    blocks = run.coordinates
    moves = float(blocks.top_speed_mm_s[0]) > CLEARLY_MOVING * MOVING_MM_S
    return bool(np.any(blocks.phase == Phase.REST) or (moves and np.any(blocks.speed_mm_s <= MOVING_MM_S)))


def stage_limitations(runs: Sequence[RunData]) -> Iterator[str]:
    """Yield limitations of runs of the stage alone."""
    speeds = {run.typical_speed_mm_s for run in runs}
    if goes_one_way(runs):
        yield "All runs go one way: friction that depends on direction cannot be separated from other friction."
    if len(speeds) < MIN_SPEEDS:
        yield "Fewer than three speeds: effects of speed cannot be separated."
    if all(run.experiment.contact is not Contact.NONE for run in runs):
        yield "No blank runs: the stage is known no better than the load that it moves."


def own_model_limitations(
    runs: Sequence[RunData], other_channels: Sequence[str], *, declares_any: bool
) -> Iterator[str]:
    """Yield limitations of a user's model, of which one channel is explained and `other_channels` are not."""
    speeds = {run.typical_speed_mm_s for run in runs}
    if len(speeds) == 1 and goes_one_way(runs) and not any(_rests(run) for run in runs):
        yield (
            "All runs go one way at one speed without a rest: sensor effects in time cannot be separated from "
            "friction that changes along the stroke."
        )
    if not declares_any:
        yield (
            "The model does not declare the parts of its force: only effects of sensor and acquisition were tried, "
            "none of wall, interface, specimen or drive."
        )
    for name in other_channels:
        yield f"The model also predicts {name}, which was not diagnosed."
