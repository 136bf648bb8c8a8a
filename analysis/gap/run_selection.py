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


def spread_over_session(runs: Sequence[RunInfo], most: int = MAX_RUNS) -> list[RunInfo]:
    """Return at most so many runs, in their order; all where there are no more.

    Conditions get equal shares, and what rare ones leave of theirs goes to the others. Within a condition runs are
    evenly spaced in time, the first and the last among them.
    """
    if len(runs) <= most:
        return list(runs)
    groups: dict[tuple[object, ...], list[RunInfo]] = {}
    for one in sorted(runs, key=lambda run: run.header.start_time):
        groups.setdefault(_condition_of(one), []).append(one)
    kept: set[int] = set()
    waiting, room = sorted(groups.values(), key=len), most
    for done, group in enumerate(waiting):
        share = min(len(group), max(room // (len(waiting) - done), 1))
        chosen = np.unique(np.linspace(0, len(group) - 1, share).round().astype(int)).tolist() if room > 0 else []
        kept |= {id(group[at]) for at in chosen}
        room -= len(chosen)
    return [one for one in runs if id(one) in kept]


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

        found = _with_count_remark(select_runs(there, meant, progress, choice), len(usable))
    else:
        runs = tuple(campaign)
        infos = [run.info for run in runs]
        meant, others = _main_specimen(infos, infos, specimen)
        found = select_loaded_runs(runs, meant)
        kept = {info.path for info in spread_over_session([one.run.info for one in found.experiments])}
        fewer = tuple(one for one in found.experiments if one.run.info.path in kept)
        found = _with_count_remark(replace(found, experiments=fewer), len(found.experiments))
    return _with_one_sensor(replace(found, left_out=(*found.left_out, *others)))


def _with_count_remark(found: RunSelection, usable: int) -> RunSelection:
    if usable <= MAX_RUNS:
        return found
    remark = (
        f"of {usable} runs {len(found.experiments)} are diagnosed, every condition among them, spread over the "
        "session; a diagnosis of all would take much memory and say little more"
    )
    return replace(found, remarks=(*found.remarks, remark))


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


def _with_one_sensor(found: RunSelection) -> RunSelection:
    serials = Counter(serial for one in found.experiments if (serial := _entry_text(one, "sensor_serial")))
    kept, others = found.experiments, list[Exclusion]()
    if len(serials) > 1:
        most = serials.most_common(1)[0][0]
        kept = tuple(one for one in kept if _entry_text(one, "sensor_serial") in {"", most})
        others = [
            Exclusion(
                one.file,
                f"it was measured with force sensor {_entry_text(one, 'sensor_serial')}, most runs with {most}",
            )
            for one in found.experiments
            if one not in kept
        ]
    return replace(
        found,
        experiments=kept,
        left_out=(*found.left_out, *others),
        remarks=(*found.remarks, *_selection_remarks(kept, several=len(serials) > 1)),
    )


def _selection_remarks(kept: tuple[Experiment, ...], *, several: bool) -> Iterator[str]:
    calibrations = sorted({told for one in kept if (told := _entry_text(one, "calibration_id"))})
    if len(calibrations) > 1:
        yield (
            f"the force calibration changes during the campaign ({', '.join(calibrations)}): a step of the gain may "
            "pass for an effect of the session"
        )
    nameless = sum(not _entry_text(one, "sensor_serial") for one in kept)
    if several and nameless:
        yield f"{nameless} runs do not say with which force sensor they were measured"
    touching = [one for one in kept if one.contact is not Contact.NONE]
    ageless = [one for one in touching if "insertion_dwell_s" not in one.run.info.header.entry]
    if ageless:
        yield (
            f"{len(ageless)} of {len(touching)} runs do not note the age of the contact: {DEFAULT_DWELL_S:g} s are "
            "assumed, and what depends on it is less certain"
        )


def _entry_text(one: Experiment, name: str) -> str:
    return str(one.run.info.header.entry.get(name, ""))
