"""The two sides of a comparison: recorded runs, or the same runs as the friction model computes them."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np

from dragrig.analysis.comparison.comparison import ComparedRun, ComparedSide
from dragrig.analysis.estimates import Exclusion, summarise_exclusions
from dragrig.analysis.models.capsule_model import acquisition_of
from dragrig.analysis.models.experiment import Experiment
from dragrig.config.errors import AnalysisError, RunFileError, reason_of
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.runfile import read_campaign, read_info, read_mark, read_run
from dragrig.rig.runfile.campaigns import specimen_key
from dragrig.rig.runfile.model import Run, RunInfo, RunStatus
from dragrig.sim_backend.effects.chain import EffectChain, evaluation_rate_hz, evaluation_times
from dragrig.sim_backend.effects.run_state import gut_run_state
from dragrig.sim_backend.friction import prepare


def resimulate(run: Run, model: FrictionModelSettings, first_run_at: datetime | None = None) -> Run:
    """Return the run with the model's force in place of the recorded one; filter results and checks are dropped.

    Position, command and phases stay: the model is driven by the recorded motion, so that what the drive does wrong
    makes no false difference of the force. For the same reason effects of the model in motor and encoder are left out.

    Parameters
    ----------
    first_run_at
        When the specimen's first run began, for effects that go by the session's clock; this one unless given.

    Raises
    ------
    AnalysisError
        One sentence, where the run lacks what the model needs.
    SettingsError
        Where the published wall parameters do not reach the strain of the run.
    """
    if run.trace.signal != "force":
        raise AnalysisError(f"it records {run.trace.signal}, of which the friction model says nothing")
    experiment = Experiment(run)
    if model.effects:
        began = run.info.header.start_time
        force = _force_with_effects(experiment, model, (began - (first_run_at or began)).total_seconds())
    else:
        force = prepare(acquisition_of(experiment), model, experiment.motion).force(experiment.time_s)
    trace = replace(run.trace, channels={"force": force, "position": run.trace.position}, units=dict(run.trace.units))
    # A noise-free trace may stay at its largest value for long, and is not clipped for that.
    info = replace(run.info, checks={"clipped_samples": 0})
    return replace(run, info=info, trace=trace, events=(), filtered=None)


def _force_with_effects(experiment: Experiment, model: FrictionModelSettings, session_start_s: float) -> FloatArray:
    chain, time = EffectChain.of(model), experiment.time_s
    duration_s = float(time[-1])
    rate_hz = evaluation_rate_hz(experiment.run.trace.sample_rate_hz, duration_s)
    times = evaluation_times(duration_s, rate_hz)
    scene = gut_run_state(acquisition_of(experiment), model, experiment.motion, times, session_start_s)
    return np.asarray(np.interp(time, times, chain.measured_force(scene, chain.load(scene), model.force_gain)))


RETURN_STROKE_REASON = (
    "it is a way back, through wall that the stroke before has just slid over; the model takes each run alone"
)


def side_from_path(path: Path, specimen: str | None = None) -> ComparedSide:
    """Look at one side: a campaign's folder, or a run file.

    A run that is named itself is meant, whatever its mark or its ending says; both are told.

    Raises
    ------
    RunFileError
        When there is no such folder or file, or a file cannot be read.
    AnalysisError
        When a folder holds no run that can be used, or several specimens and not the one that is named.
    """
    if not path.is_dir():
        return _side_from_file(path)
    found = read_campaign(path)
    left_out = [Exclusion(one.name, reason_of(fault).removeprefix(f"{one}: ")) for one, fault in found.unreadable]
    left_out += [Exclusion(one.name, "it is a recording that was not finished") for one in found.recordings]
    marks = {one: mark.reason for one, mark in found.marks.items()}
    return _side_from_infos(str(path), _folder_name(path), found.runs, specimen, left_out, marks)


def side_from_runs(runs: Iterable[Run], name: str) -> ComparedSide:
    """Do the same with runs in memory."""
    held = list(runs)
    if len(held) == 1:
        return ComparedSide(
            name,
            (ComparedRun(held[0].info, partial(_return_run, held[0]), _incomplete_reason(held[0].info)),),
            (),
            _specimen_keys(held),
        )
    sources = tuple(
        ComparedRun(run.info, partial(_return_run, run)) for run in held if not _incomplete_reason(run.info)
    )
    left_out = tuple(
        Exclusion(run.info.path.name, _incomplete_reason(run.info)) for run in held if _incomplete_reason(run.info)
    )
    if not sources:
        raise AnalysisError(f"{name}: holds no complete run; give runs that ended as planned.")
    return ComparedSide(name, sources, left_out, _specimen_keys(held))


def model_side(real: ComparedSide, model: FrictionModelSettings, name: str) -> ComparedSide:
    """Put the friction model on the other side: every run simulated again on its own motion."""
    first = min((one.info.header.start_time for one in real.runs), default=None)
    strokes = [one for one in real.runs if one.info.kind != "return"]
    sources = [ComparedRun(one.info, partial(_read_resimulated, one, model, first)) for one in strokes]
    left_out = [Exclusion(one.file, RETURN_STROKE_REASON) for one in real.runs if one.info.kind == "return"]
    return ComparedSide(f"model {name}", tuple(sources), tuple(left_out), real.specimens, is_model=True)


def _side_from_file(path: Path) -> ComparedSide:
    if not path.exists():
        raise RunFileError(f"{path}: there is no such file or folder; check the path.")
    info, mark = read_info(path), read_mark(path)
    said = [f"it is marked bad: {mark.reason}"] if mark is not None else []
    said += [_incomplete_reason(info)] if _incomplete_reason(info) else []
    return ComparedSide(
        _folder_name(path), (ComparedRun(info, partial(read_run, path), "; ".join(said)),), (), (specimen_key(info),)
    )


def _side_from_infos(
    where: str,
    name: str,
    infos: Iterable[RunInfo],
    specimen: str | None,
    left_out: list[Exclusion],
    marks: Mapping[Path, str],
) -> ComparedSide:
    chosen = _runs_of_specimen(list(infos), specimen, where)
    sources = []
    for info in chosen:
        reason = f"it is marked bad: {marks[info.path]}" if info.path in marks else _incomplete_reason(info)
        if reason:
            left_out.append(Exclusion(info.path.name, reason))
        else:
            sources.append(ComparedRun(info, partial(read_run, info.path)))
    if not sources:
        why = f" ({summarise_exclusions(left_out)})" if left_out else ""
        raise AnalysisError(f"{where}: holds no run that can be compared{why}.")
    return ComparedSide(name, tuple(sources), tuple(left_out), tuple(dict.fromkeys(map(specimen_key, chosen))))


def _runs_of_specimen(infos: list[RunInfo], specimen: str | None, where: str) -> list[RunInfo]:
    """Take the runs of one specimen; a side that has only one is taken as it is."""
    names = {word for one in infos for word in (specimen_key(one), str(one.header.specimen.get("name")))}
    if specimen is None or (specimen not in names and len({specimen_key(one) for one in infos}) < 2):
        return infos
    if specimen not in names:
        raise AnalysisError(f"{where}: has no run of specimen {specimen!r}, only of {', '.join(sorted(names))}.")
    return [one for one in infos if specimen in {specimen_key(one), str(one.header.specimen.get("name"))}]


def _incomplete_reason(info: RunInfo) -> str:
    if info.status is RunStatus.COMPLETE:
        return ""
    return f"it is {info.status.value}, not complete" + (f" ({info.reason})" if info.reason else "")


def _read_resimulated(source: ComparedRun, model: FrictionModelSettings, first_run_at: datetime | None) -> Run:
    return resimulate(source.read(), model, first_run_at)


def _return_run(run: Run) -> Run:
    return run


def _specimen_keys(runs: Iterable[Run]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(specimen_key(run.info) for run in runs))


def _folder_name(path: Path) -> str:
    return path.resolve().name
