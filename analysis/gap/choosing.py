"""Which runs of a campaign a diagnosis takes: those of one specimen and one force sensor."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from dragrig.analysis.gap.spreading import MOST_RUNS, spread
from dragrig.analysis.identification.results import LeftOut
from dragrig.analysis.identification.selection import Selection, select, select_from
from dragrig.analysis.nominal.experiment import USUAL_DWELL_S, Experiment
from dragrig.analysis.progress import Progress, silent
from dragrig.rig.devices import Contact
from dragrig.rig.runfile.campaigns import specimen_key
from dragrig.rig.runfile.model import Run, RunInfo, Status


def choose(campaign: Path | Iterable[Run], specimen: str | None = None, progress: Progress = silent) -> Selection:
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
        from dragrig.rig.runfile import campaign as look

        there = look(campaign)
        meant, others = _specimen(there.runs, there.good, specimen)
        usable = list[RunInfo]()

        def choice(runs: Sequence[RunInfo]) -> list[RunInfo]:
            usable.extend(runs)
            return spread(runs)

        found = _remarked(select(there, meant, progress, choice), len(usable))
    else:
        runs = tuple(campaign)
        infos = [run.info for run in runs]
        meant, others = _specimen(infos, infos, specimen)
        found = select_from(runs, meant)
        kept = {info.path for info in spread([one.run.info for one in found.experiments])}
        fewer = tuple(one for one in found.experiments if one.run.info.path in kept)
        found = _remarked(replace(found, experiments=fewer), len(found.experiments))
    return _of_one_sensor(replace(found, left_out=(*found.left_out, *others)))


def _remarked(found: Selection, usable: int) -> Selection:
    if usable <= MOST_RUNS:
        return found
    remark = (
        f"of {usable} runs {len(found.experiments)} are diagnosed, every condition among them, spread over the "
        "session; a diagnosis of all would take much memory and say little more"
    )
    return replace(found, remarks=(*found.remarks, remark))


def _specimen(
    infos: Sequence[RunInfo], good: Sequence[RunInfo], specimen: str | None
) -> tuple[str | None, list[LeftOut]]:
    """Return the specimen that has the most good runs, and the runs of all others."""
    keys = {info.path: specimen_key(info) for info in infos}
    if specimen is not None or len(set(keys.values())) < 2:
        return specimen, []
    ended = Counter(keys[info.path] for info in good if info.status is Status.COMPLETE)
    most = (ended or Counter(keys.values())).most_common(1)[0][0]
    reason = f"it is of specimen {{}}; most runs are of {most}, and --specimen names another"
    return most, [LeftOut(path.name, reason.format(key)) for path, key in keys.items() if key != most]


def _of_one_sensor(found: Selection) -> Selection:
    serials = Counter(serial for one in found.experiments if (serial := _told(one, "sensor_serial")))
    kept, others = found.experiments, list[LeftOut]()
    if len(serials) > 1:
        most = serials.most_common(1)[0][0]
        kept = tuple(one for one in kept if _told(one, "sensor_serial") in {"", most})
        others = [
            LeftOut(one.file, f"it was measured with force sensor {_told(one, 'sensor_serial')}, most runs with {most}")
            for one in found.experiments
            if one not in kept
        ]
    return replace(
        found,
        experiments=kept,
        left_out=(*found.left_out, *others),
        remarks=(*found.remarks, *_remarks(kept, several=len(serials) > 1)),
    )


def _remarks(kept: tuple[Experiment, ...], *, several: bool) -> Iterator[str]:
    calibrations = sorted({told for one in kept if (told := _told(one, "calibration_id"))})
    if len(calibrations) > 1:
        yield (
            f"the force calibration changes during the campaign ({', '.join(calibrations)}): a step of the gain may "
            "pass for an effect of the session"
        )
    nameless = sum(not _told(one, "sensor_serial") for one in kept)
    if several and nameless:
        yield f"{nameless} runs do not say with which force sensor they were measured"
    touching = [one for one in kept if one.contact is not Contact.NONE]
    ageless = [one for one in touching if "insertion_dwell_s" not in one.run.info.header.entry]
    if ageless:
        yield (
            f"{len(ageless)} of {len(touching)} runs do not note the age of the contact: {USUAL_DWELL_S:g} s are "
            "assumed, and what depends on it is less certain"
        )


def _told(one: Experiment, name: str) -> str:
    return str(one.run.info.header.entry.get(name, ""))
