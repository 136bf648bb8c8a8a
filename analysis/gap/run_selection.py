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
"""A diagnosis needs about 10 MB per run; changes within a session show in this many runs."""
CONDITION_SETTINGS = ("shear_strain", "speed_mm_s", "travel_mm")


def spread_over_session(runs: Sequence[RunInfo], max_runs: int = MAX_RUNS) -> list[RunInfo]:
    """Return at most `max_runs` runs, in their order.

    Conditions get equal shares; what rare ones leave goes to the others. Within a condition runs are evenly spaced in
    time, including first and last.
    """
    if len(runs) <= max_runs:
        return list(runs)
    groups: dict[tuple[object, ...], list[RunInfo]] = {}
    for info in sorted(runs, key=lambda run: run.header.start_time):
        groups.setdefault(_condition_of(info), []).append(info)
    selected: set[int] = set()
    by_size, remaining = sorted(groups.values(), key=len), max_runs
    for done, group in enumerate(by_size):
        share = min(len(group), max(remaining // (len(by_size) - done), 1))
        indices = np.unique(np.linspace(0, len(group) - 1, share).round().astype(int)).tolist() if remaining > 0 else []
        selected |= {id(group[index]) for index in indices}
        remaining -= len(indices)
    return [info for info in runs if id(info) in selected]


def _condition_of(run: RunInfo) -> tuple[object, ...]:
    return run.kind, *(run.header.protocol.get(name) for name in CONDITION_SETTINGS)


def choose_runs(
    campaign: Path | Iterable[Run], specimen: str | None = None, progress: Progress = no_progress
) -> RunSelection:
    """Read the runs that a diagnosis can use.

    Of several specimens or force sensors the one with the most runs is kept: differences between them would be mistaken
    for effects. Very long campaigns are thinned, with a remark.

    Parameters
    ----------
    campaign
        A folder of run files, or runs in memory.
    specimen
        Name or id of the specimen; default: the one with the most runs.

    Raises
    ------
    RunFileError
        When there is no such folder.
    AnalysisError
        When it holds no usable run.
    """
    if isinstance(campaign, Path):
        from dragrig.rig.runfile import read_campaign

        folder = read_campaign(campaign)
        chosen_specimen, left_out = _main_specimen(folder.runs, folder.good, specimen)
        usable = list[RunInfo]()

        def choice(runs: Sequence[RunInfo]) -> list[RunInfo]:
            usable.extend(runs)
            return spread_over_session(runs)

        selection = _with_count_remark(select_runs(folder, chosen_specimen, progress, choice), len(usable))
    else:
        runs = tuple(campaign)
        infos = [run.info for run in runs]
        chosen_specimen, left_out = _main_specimen(infos, infos, specimen)
        selection = select_loaded_runs(runs, chosen_specimen)
        paths = {
            info.path for info in spread_over_session([experiment.run.info for experiment in selection.experiments])
        }
        spread = tuple(experiment for experiment in selection.experiments if experiment.run.info.path in paths)
        selection = _with_count_remark(replace(selection, experiments=spread), len(selection.experiments))
    return _with_one_sensor(replace(selection, left_out=(*selection.left_out, *left_out)))


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
) -> tuple[str | None, list[Exclusion]]:
    """Return the specimen with the most good runs, and the runs of all others."""
    keys = {info.path: specimen_key(info) for info in infos}
    if specimen is not None or len(set(keys.values())) < 2:
        return specimen, []
    complete = Counter(keys[info.path] for info in good if info.status is RunStatus.COMPLETE)
    main = (complete or Counter(keys.values())).most_common(1)[0][0]
    reason_template = f"it is of specimen {{}}; most runs are of {main}, and --specimen names another"
    return main, [Exclusion(path.name, reason_template.format(key)) for path, key in keys.items() if key != main]


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
