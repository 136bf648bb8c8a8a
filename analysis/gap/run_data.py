"""Runs of a diagnosis: their selection (one specimen, one force sensor, spread over the session), and data of each.

The data are block means of the force, their prediction, and the coordinates of the blocks. `modulations` holds smooth
functions of these coordinates, of order 1. No real effect has exactly the form of the catalogue; a signature multiplied
by a sum of modulations, each with a small prior, may deviate as real effects do without becoming another effect.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from dragrig.analysis import (
    DEFAULT_DWELL_S,
    ChannelBlocks,
    Exclusion,
    Experiment,
    Progress,
    RunSelection,
    acquisition_of,
    attribute_number,
    count_text,
    no_progress,
    select_loaded_runs,
    select_runs,
    session_starts,
    set_values,
)
from dragrig.config import FrictionModelSettings
from dragrig.rig import (
    Acquisition,
    Campaign,
    Contact,
    FloatArray,
    Phase,
    Run,
    RunInfo,
    RunStatus,
    read_campaign,
    specimen_key,
)
from dragrig.sim_backend.effects import RunState, gut_run_state

MAX_RUNS = 75
"""A diagnosis needs about 10 MB per run; changes within a session show in this many runs."""
CONDITION_SETTINGS = ("shear_strain", "speed_mm_s", "travel_mm")


def spread_over_session(runs: Sequence[RunInfo], max_runs: int) -> list[RunInfo]:
    """Return at most `max_runs` runs, in their order.

    Conditions get equal shares; the rest of rare ones goes to the others. Within a condition runs are evenly spaced in
    time, including first and last.
    """
    if len(runs) <= max_runs:
        return list(runs)
    groups: dict[tuple[object, ...], list[RunInfo]] = {}
    in_time = sorted(runs, key=lambda run: run.header.start_time)
    settings = [
        set_values(attribute_number(run.header.protocol, name) or 0.0 for run in in_time) for name in CONDITION_SETTINGS
    ]
    for info, *condition in zip(in_time, *settings, strict=True):
        groups.setdefault((info.kind, *condition), []).append(info)
    selected: set[int] = set()
    by_size, remaining = sorted(groups.values(), key=len), max_runs
    for done, group in enumerate(by_size):
        share = min(len(group), max(remaining // (len(by_size) - done), 1))
        indices = np.unique(np.linspace(0, len(group) - 1, share).round().astype(int)).tolist() if remaining > 0 else []
        selected |= {id(group[index]) for index in indices}
        remaining -= len(indices)
    return [info for info in runs if id(info) in selected]


def choose_runs(
    campaign: Path | Campaign | Iterable[Run], specimen: str | None = None, progress: Progress = no_progress
) -> RunSelection:
    """Read the runs that a diagnosis can use.

    Of several specimens or force sensors the one with the most runs is kept: differences between them would be mistaken
    for effects. Very long campaigns are thinned, with a remark.

    Parameters
    ----------
    campaign
        A folder of run files, its listing by `read_campaign`, or runs in memory.
    specimen
        Name or id of the specimen; default: the one with the most runs.

    Raises
    ------
    RunFileError
        When there is no such folder.
    AnalysisError
        When it holds no usable run.
    """
    if isinstance(campaign, Path | Campaign):
        folder = read_campaign(campaign) if isinstance(campaign, Path) else campaign
        chosen_specimen, left_out, choice_remarks = _main_specimen(folder.runs, folder.good, specimen)
        usable = list[RunInfo]()

        def choice(runs: Sequence[RunInfo]) -> list[RunInfo]:
            usable.extend(runs)
            return spread_over_session(runs, MAX_RUNS)

        selection = _with_count_remark(select_runs(folder, chosen_specimen, progress, choice), len(usable))
    else:
        runs = tuple(campaign)
        infos = [run.info for run in runs]
        chosen_specimen, left_out, choice_remarks = _main_specimen(infos, infos, specimen)
        selection = select_loaded_runs(runs, chosen_specimen)
        loaded = [experiment.run.info for experiment in selection.experiments]
        paths = {info.path for info in spread_over_session(loaded, MAX_RUNS)}
        spread = tuple(experiment for experiment in selection.experiments if experiment.run.info.path in paths)
        selection = _with_count_remark(replace(selection, experiments=spread), len(selection.experiments))
    return _with_one_sensor(
        replace(selection, left_out=(*selection.left_out, *left_out), remarks=(*choice_remarks, *selection.remarks))
    )


def without_runs(selection: RunSelection, counted_elsewhere: Mapping[str, str]) -> RunSelection:
    """Return a selection without runs that count in another campaign, whose name is given by their ids."""
    kept, left_out = list[Experiment](), list[Exclusion]()
    for experiment in selection.experiments:
        elsewhere = counted_elsewhere.get(experiment.run.info.header.run_id)
        if elsewhere is None:
            kept.append(experiment)
        else:
            left_out.append(Exclusion(experiment.file, f"it is in {elsewhere} too, and counts there"))
    return replace(selection, experiments=tuple(kept), left_out=(*selection.left_out, *left_out))


def _with_count_remark(selection: RunSelection, usable: int) -> RunSelection:
    if usable <= MAX_RUNS:
        return selection
    remark = (
        f"of {usable} runs {len(selection.experiments)} are diagnosed, every condition among them, spread over the "
        "session; a diagnosis of all would need much memory and add little"
    )
    return replace(selection, remarks=(*selection.remarks, remark))


def _main_specimen(
    infos: Sequence[RunInfo], good: Sequence[RunInfo], specimen: str | None
) -> tuple[str | None, list[Exclusion], list[str]]:
    """Return the specimen with the most good runs, the runs of all others, and remarks on the choice."""
    keys = {info.path: specimen_key(info) for info in infos}
    if specimen is not None or len(set(keys.values())) < 2:
        return specimen, [], []
    complete = Counter(keys[info.path] for info in good if info.status is RunStatus.COMPLETE)
    main = (complete or Counter(keys.values())).most_common(1)[0][0]
    reason_template = f"it is of specimen {{}}; most runs are of {main}, and --specimen names another"
    counts = Counter(key for key in keys.values() if key != main)
    others = ", ".join(f"{key} ({count_text(count, 'run')})" for key, count in sorted(counts.items()))
    remark = f"the folder holds several specimens; {main} has the most runs and is diagnosed, not {others}: --specimen"
    left_out = [Exclusion(path.name, reason_template.format(key)) for path, key in keys.items() if key != main]
    return main, left_out, [f"{remark} names another"]


def _with_one_sensor(selection: RunSelection) -> RunSelection:
    serials = Counter(
        serial for experiment in selection.experiments if (serial := _entry_text(experiment, "sensor_serial"))
    )
    experiments, left_out = selection.experiments, list[Exclusion]()
    if len(serials) > 1:
        main_serial = serials.most_common(1)[0][0]
        experiments = tuple(
            experiment for experiment in experiments if _entry_text(experiment, "sensor_serial") in {"", main_serial}
        )
        left_out = [
            Exclusion(
                experiment.file,
                f"it was measured with force sensor {_entry_text(experiment, 'sensor_serial')}, "
                f"most runs with {main_serial}",
            )
            for experiment in selection.experiments
            if experiment not in experiments
        ]
    return replace(
        selection,
        experiments=experiments,
        left_out=(*selection.left_out, *left_out),
        remarks=(*selection.remarks, *_selection_remarks(experiments, several=len(serials) > 1)),
    )


def _selection_remarks(experiments: tuple[Experiment, ...], *, several: bool) -> Iterator[str]:
    calibrations = sorted({text for experiment in experiments if (text := _entry_text(experiment, "calibration_id"))})
    if len(calibrations) > 1:
        yield (
            f"the force calibration changes during the campaign ({', '.join(calibrations)}): a step of the gain may "
            "look like an effect of session time"
        )
    if len(experiments) > 1 and session_starts(experiments) is None:
        yield (
            "it is not known when each run was made (import states it by --start-time): nothing is said of changes "
            "during the session"
        )
    without_serial = sum(not _entry_text(experiment, "sensor_serial") for experiment in experiments)
    if several and without_serial:
        yield f"{without_serial} runs do not name their force sensor"
    in_contact = [experiment for experiment in experiments if experiment.contact is not Contact.NONE]
    without_dwell = [
        experiment for experiment in in_contact if "insertion_dwell_s" not in experiment.run.info.header.entry
    ]
    if without_dwell:
        yield (
            f"{len(without_dwell)} of {len(in_contact)} runs lack the contact time before motion: "
            f"{DEFAULT_DWELL_S:g} s are assumed, and effects that depend on it are less certain"
        )


def _entry_text(experiment: Experiment, name: str) -> str:
    return str(experiment.run.info.header.entry.get(name, ""))


def commanded_phase(experiment: Experiment, time_s: FloatArray) -> FloatArray:
    """Return the number of the commanded phase at times, shape `(n,)`."""
    index = np.searchsorted(experiment.time_s, time_s + 1e-9, side="right") - 1
    return np.asarray(experiment.run.trace.phase[np.clip(index, 0, None)], dtype=np.float64)


MAX_BLOCK_MM = 0.4
"""Longest block along the stroke, so that folds a few mm apart are resolved."""

MEASURED_SPEED_TOLERANCE = 0.05
"""Ratio of neighbouring measured speeds, less one, up to which the set speed was one."""
SAME_SPEED = 1.5
"""Ratio of the speeds of nine tenths and of a tenth of a motion's way up to which they are one."""


def run_noun(kind: str) -> str:
    """Return the noun for a run of a kind."""
    return {"coulomb": "a Coulomb run", "blank": "a blank run"}.get(kind, f"a {kind}")


@dataclass(frozen=True, eq=False)
class RunData:
    """The force of one run, in `B` blocks."""

    block_data: ChannelBlocks
    """Block means with the model that predicts them."""
    session_start_s: float
    """Time of the first sample on the specimen's session clock; 0 without a clock."""
    has_clock: bool = True
    """Whether it is known when in the session the run was made."""
    set_value: float | None = None
    """Commanded speed or strain, the same in runs that differ by rounding alone; None: its own."""

    @property
    def experiment(self) -> Experiment:
        """The run."""
        return self.block_data.experiment

    @property
    def file(self) -> str:
        """Name of its file."""
        return self.experiment.file

    @cached_property
    def acquisition(self) -> Acquisition:
        """Contact, capsule and motion; raises `AnalysisError` if the run does not describe its capsule."""
        return acquisition_of(self.experiment)

    def scene(self, settings: FrictionModelSettings) -> RunState:
        """Return the state that effects act on, at the nodes of the blocks, for a nominal model with these settings."""
        experiment = self.experiment
        still = experiment.unsmoothed_motion if self.acquisition.contact is Contact.STICKING else None
        state = gut_run_state(
            self.acquisition, settings, experiment.motion, self.block_data.blocks.nodes_s, self.session_start_s, still
        )
        return replace(state, origin_mm=experiment.origin_mm)

    @cached_property
    def direction(self) -> int:
        """Sign of the net travel: 1 towards positive positions, -1 towards negative ones, 0 for none."""
        moved = self.experiment.position(self.experiment.time_s[-1:]) - self.experiment.position(np.zeros(1))
        return int(np.sign(np.round(moved[0], 1)))

    def block_means(self, node_values: FloatArray) -> FloatArray:
        """Average values at nodes over blocks, shape `(…, 2 B)` to `(…, B)`."""
        return self.block_data.blocks.of(node_values)

    @cached_property
    def coordinates(self) -> "BlockCoordinates":
        """Coordinates of the blocks."""
        return BlockCoordinates.of(self)

    @cached_property
    def condition(self) -> tuple[str, float]:
        """Kind and commanded speed or strain; runs with equal conditions are repeats.

        Without a commanded speed in the header it is the measured one.
        """
        value = _commanded_value(self.experiment) if self.set_value is None else self.set_value
        if value is not None:
            return self.experiment.kind, value
        if self.experiment.contact is Contact.STICKING:
            return self.experiment.kind, 0.0
        return self.experiment.kind, self.typical_speed_mm_s

    @cached_property
    def typical_speed_mm_s(self) -> float:
        """Speed above which half of the way was made, to two digits: extremes of a measured speed are noise."""
        return float(f"{self._speeds_of_way(0.5)[0]:.2g}")

    def _speeds_of_way(self, *shares: float) -> FloatArray:
        """Return the speeds below which these shares of the way were made."""
        speed = self.coordinates.speed_mm_s
        way = speed * self.coordinates.width_s + np.finfo(float).tiny
        return np.asarray(np.quantile(speed, shares, method="inverted_cdf", weights=way))

    @property
    def label(self) -> str:
        """Its difference from others of its kind, for a reader: `0.5 mm/s`, `50 % strain`."""
        kind, value = self.condition
        return f"{100 * value:g} % strain" if kind == "relaxation" else f"{value:g} mm/s"

    @property
    def is_one_condition(self) -> bool:
        """Whether it has one speed: a motion may have strokes at several."""
        slow, fast = self._speeds_of_way(0.1, 0.9)
        return self.experiment.kind != "motion" or bool(fast < SAME_SPEED * slow)

    @property
    def condition_text(self) -> str:
        """The condition in words: `a drag at 20 mm/s`."""
        return f"{run_noun(self.experiment.kind)} at {self.label}"


@dataclass(frozen=True, slots=True, eq=False)
class BlockCoordinates:
    """Coordinates of a run's blocks, arrays of shape `(B,)`."""

    time_s: FloatArray
    width_s: FloatArray
    phase: FloatArray
    position_mm: FloatArray
    speed_mm_s: FloatArray
    top_speed_mm_s: FloatArray
    since_event_s: FloatArray
    session_s: FloatArray

    @classmethod
    def of(cls, run: RunData) -> "BlockCoordinates":
        """Evaluate them in the middle of each block."""
        experiment, blocks = run.experiment, run.block_data.blocks
        middle = blocks.middle_s
        speed = np.abs(experiment.velocity(middle))
        events = np.concatenate(([-np.inf], experiment.motion.breaks_s[1:-1]))
        latest = events[np.searchsorted(events, middle + 1e-9, side="right") - 1]
        return cls(
            time_s=middle,
            width_s=np.maximum(blocks.end_s - blocks.start_s, 1e-6),
            phase=commanded_phase(experiment, middle),
            position_mm=experiment.position(middle),
            speed_mm_s=speed,
            top_speed_mm_s=np.full_like(middle, speed.max(initial=0.0)),
            since_event_s=np.where(np.isfinite(latest), middle - latest, middle),
            session_s=run.session_start_s + middle,
        )


def run_data_of(channel_blocks: Mapping[str, ChannelBlocks] | tuple[ChannelBlocks, ...]) -> tuple[RunData, ...]:
    """Return the runs whose force is predicted, on one session clock."""
    channels = tuple(channel_blocks.values()) if isinstance(channel_blocks, Mapping) else channel_blocks
    starts = session_starts([data.experiment for data in channels])
    commanded = [_commanded_value(data.experiment) for data in channels]
    shared = dict(zip(commanded, set_values(value or 0.0 for value in commanded), strict=True)) | {None: None}
    runs = tuple(
        RunData(data, start, has_clock=starts is not None, set_value=shared[value])
        for data, start, value in zip(channels, starts or (0.0,) * len(channels), commanded, strict=True)
    )
    alike = set_values((run.condition[1] for run in runs), MEASURED_SPEED_TOLERANCE)
    return tuple(
        replace(run, set_value=value) if run.set_value is None else run for run, value in zip(runs, alike, strict=True)
    )


def _commanded_value(experiment: Experiment) -> float | None:
    protocol = experiment.run.info.header.protocol
    speed = attribute_number(protocol, "speed_mm_s")
    return attribute_number(protocol, "shear_strain") if speed is None else speed


LOG_SPEED_CENTRE, LOG_SPEED_HALF_RANGE = 1.6, 2.4
"""Maps speeds from 0.5 to 60 mm/s to -1 to 1."""
MIN_SPEED_MM_S = 0.3
TRAVEL_HALF_RANGE_MM = 20.0
STRAIN_CENTRE, STRAIN_HALF_RANGE = 1.25, 0.75


def smooth_modulations(runs: Sequence[RunData]) -> tuple[FloatArray, ...]:
    """Return the modulations at the blocks of each run, shape `(K, B)` each."""
    last_s = max(float(run.coordinates.session_s.max()) for run in runs)
    return tuple(_modulations_of_run(run, max(last_s, 1.0)) for run in runs)


def _modulations_of_run(run: RunData, last_s: float) -> FloatArray:
    blocks = run.coordinates
    ones = np.ones_like(blocks.time_s)
    sticks = run.experiment.contact is Contact.STICKING
    slides = 0.0 * ones if sticks else ones
    top = slides * _log_speed(blocks.top_speed_mm_s)
    position = slides * np.clip(blocks.position_mm / TRAVEL_HALF_RANGE_MM - 1.0, -1.2, 1.2)
    since_event = np.clip((np.log(blocks.since_event_s + 2e-3) + 2.0) / 4.0, -1.2, 1.2)
    strain = (run.condition[1] - STRAIN_CENTRE) / STRAIN_HALF_RANGE * (ones - slides)
    rows = (
        top,
        _legendre_2(top) * slides,
        position,
        _legendre_2(position) * slides,
        since_event,
        2.0 * blocks.session_s / last_s - ones if run.has_clock else 0.0 * ones,
        strain,
        slides * _log_speed(blocks.speed_mm_s),
        ones * (run.experiment.kind == "coulomb"),
        ones - slides,
        ones * (run.experiment.contact is Contact.NONE),
        (blocks.phase == Phase.HOLD) * ones,
        ((blocks.phase == Phase.ACCELERATE) | (blocks.phase == Phase.DECELERATE)) * ones,
    )
    return np.stack(rows)


def _log_speed(speed_mm_s: FloatArray) -> FloatArray:
    scaled = (np.log(speed_mm_s + MIN_SPEED_MM_S) - LOG_SPEED_CENTRE) / LOG_SPEED_HALF_RANGE
    return np.asarray(np.clip(scaled, -1.5, 1.5))


def _legendre_2(value: FloatArray) -> FloatArray:
    return np.asarray(1.5 * value**2 - 0.5)


ACTIVE_SHARE = 0.1
"""An effect is active where it exceeds this share of its maximum."""


def rms_where_active(values: FloatArray, weights: FloatArray) -> float:
    """Return the weighted root mean square of values `(B,)` where they are active; 0 where they never are."""
    active = np.abs(values) > ACTIVE_SHARE * np.abs(values).max(initial=1e-12)
    if not active.any():
        return 0.0
    return float(np.sqrt(weights[active] @ values[active] ** 2 / weights[active].sum()))
