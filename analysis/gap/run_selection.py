"""Selection of a campaign's runs for a diagnosis: one specimen, one force sensor, spread over the session."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dragrig.analysis.computation import Progress, no_progress
from dragrig.analysis.estimates import Exclusion
from dragrig.analysis.models.experiment import DEFAULT_DWELL_S, Experiment
from dragrig.analysis.selection import RunSelection, select_loaded_runs, select_runs
from dragrig.rig.devices import Contact
from dragrig.rig.runfile.campaigns import specimen_key
from dragrig.rig.runfile.model import Run, RunInfo, RunStatus

MAX_RUNS = 75
"""A diagnosis holds about 10 MB of each; what is in a session shows in so many."""
CONDITION_SETTINGS = ("shear_strain", "speed_mm_s", "travel_mm")


def spread_over_session(runs: Sequence[RunInfo], max_runs: int = MAX_RUNS) -> list[RunInfo]:
    """Return at most so many runs, in their order; all where there are no more.

    Conditions get equal shares, and what rare ones leave of theirs goes to the others. Within a condition runs are
    evenly spaced in time, the first and the last among them.
    """
    if len(runs) <= max_runs:
        return list(runs)
    groups: dict[tuple[object, ...], list[RunInfo]] = {}
    for info in sorted(runs, key=lambda run: run.header.start_time):
        groups.setdefault(_condition_of(info), []).append(info)
    kept: set[int] = set()
    waiting, room = sorted(groups.values(), key=len), max_runs
    for done, group in enumerate(waiting):
        share = min(len(group), max(room // (len(waiting) - done), 1))
        chosen = np.unique(np.linspace(0, len(group) - 1, share).round().astype(int)).tolist() if room > 0 else []
        kept |= {id(group[at]) for at in chosen}
        room -= len(chosen)
    return [info for info in runs if id(info) in kept]


def _condition_of(run: RunInfo) -> tuple[object, ...]:
    return run.kind, *(run.header.protocol.get(name) for name in CONDITION_SETTINGS)


def choose_runs(
    campaign: Path | Iterable[Run], specimen: str | None = None, progress: Progress = no_progress
) -> RunSelection:
    """Read the runs that a diagnosis can use.

    Where the specimen or the force sensor changes, the one with the most runs is kept: what differs between two
    specimens or two sensors would pass for an effect. Of very many runs some are taken, as a remark then says.

    Parameters
    ----------
    campaign
        A folder of run files, or runs in memory.
    specimen
        Name or id of the specimen that is meant; the one with the most runs unless given.

    Raises
    ------
    RunFileError
        When there is no such folder.
    AnalysisError
        When it holds no usable run.
    """
    if isinstance(campaign, Path):
        from dragrig.rig.runfile import read_campaign

        there = read_campaign(campaign)
        meant, others = _main_specimen(there.runs, there.good, specimen)
        usable = list[RunInfo]()

        def choice(runs: Sequence[RunInfo]) -> list[RunInfo]:
            usable.extend(runs)
            return spread_over_session(runs)

        selection = _with_count_remark(select_runs(there, meant, progress, choice), len(usable))
    else:
        runs = tuple(campaign)
        infos = [run.info for run in runs]
        meant, others = _main_specimen(infos, infos, specimen)
        selection = select_loaded_runs(runs, meant)
        kept = {
            info.path for info in spread_over_session([experiment.run.info for experiment in selection.experiments])
        }
        fewer = tuple(experiment for experiment in selection.experiments if experiment.run.info.path in kept)
        selection = _with_count_remark(replace(selection, experiments=fewer), len(selection.experiments))
    return _with_one_sensor(replace(selection, left_out=(*selection.left_out, *others)))


def _with_count_remark(selection: RunSelection, usable: int) -> RunSelection:
    if usable <= MAX_RUNS:
        return selection
    remark = (
        f"of {usable} runs {len(selection.experiments)} are diagnosed, every condition among them, spread over the "
        "session; a diagnosis of all would take much memory and say little more"
    )
    return replace(selection, remarks=(*selection.remarks, remark))


def _main_specimen(
    infos: Sequence[RunInfo], good: Sequence[RunInfo], specimen: str | None
) -> tuple[str | None, list[Exclusion]]:
    """Return the specimen that has the most good runs, and the runs of all others."""
    keys = {info.path: specimen_key(info) for info in infos}
    if specimen is not None or len(set(keys.values())) < 2:
        return specimen, []
    ended = Counter(keys[info.path] for info in good if info.status is RunStatus.COMPLETE)
    most = (ended or Counter(keys.values())).most_common(1)[0][0]
    reason = f"it is of specimen {{}}; most runs are of {most}, and --specimen names another"
    return most, [Exclusion(path.name, reason.format(key)) for path, key in keys.items() if key != most]


def _with_one_sensor(selection: RunSelection) -> RunSelection:
    serials = Counter(
        serial for experiment in selection.experiments if (serial := _entry_text(experiment, "sensor_serial"))
    )
    experiments, others = selection.experiments, list[Exclusion]()
    if len(serials) > 1:
        most = serials.most_common(1)[0][0]
        experiments = tuple(
            experiment for experiment in experiments if _entry_text(experiment, "sensor_serial") in {"", most}
        )
        others = [
            Exclusion(
                experiment.file,
                f"it was measured with force sensor {_entry_text(experiment, 'sensor_serial')}, most runs with {most}",
            )
            for experiment in selection.experiments
            if experiment not in experiments
        ]
    return replace(
        selection,
        experiments=experiments,
        left_out=(*selection.left_out, *others),
        remarks=(*selection.remarks, *_selection_remarks(experiments, several=len(serials) > 1)),
    )


def _selection_remarks(experiments: tuple[Experiment, ...], *, several: bool) -> Iterator[str]:
    calibrations = sorted({text for experiment in experiments if (text := _entry_text(experiment, "calibration_id"))})
    if len(calibrations) > 1:
        yield (
            f"the force calibration changes during the campaign ({', '.join(calibrations)}): a step of the gain may "
            "pass for an effect of the session"
        )
    nameless = sum(not _entry_text(experiment, "sensor_serial") for experiment in experiments)
    if several and nameless:
        yield f"{nameless} runs do not say with which force sensor they were measured"
    touching = [experiment for experiment in experiments if experiment.contact is not Contact.NONE]
    ageless = [experiment for experiment in touching if "insertion_dwell_s" not in experiment.run.info.header.entry]
    if ageless:
        yield (
            f"{len(ageless)} of {len(touching)} runs do not note the age of the contact: {DEFAULT_DWELL_S:g} s are "
            "assumed, and what depends on it is less certain"
        )


def _entry_text(experiment: Experiment, name: str) -> str:
    return str(experiment.run.info.header.entry.get(name, ""))
