"""The two sides of a comparison: recorded runs, or the same runs as the friction model computes them."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np

from dragrig.analysis import (
    RETURN_KIND,
    Exclusion,
    Experiment,
    acquisition_of,
    incomplete_reason,
    summarise_exclusions,
    unusable_files,
)
from dragrig.analysis.comparison.comparison import ComparedRun, ComparedSide
from dragrig.config import AnalysisError, FrictionModelSettings, RunFileError
from dragrig.rig import Run, RunInfo, read_campaign, read_info, read_mark, read_run, specimen_key
from dragrig.sim_backend.effects import EffectChain, evaluation_rate_hz, evaluation_times, gut_run_state
from dragrig.sim_backend.friction import prepare

RETURN_REASON = (
    "it is a return stroke, through wall that the stroke before has just slid over; the model takes each run alone"
)


def side_from_path(path: Path, specimen: str | None = None) -> ComparedSide:
    """Take a campaign's folder or a run file as one side.

    A run file is used whatever its mark or status; both become its remark.

    Raises
    ------
    RunFileError
        When there is no such folder or file, or a file cannot be read.
    AnalysisError
        When a folder holds no usable run, or several specimens and not the named one.
    """
    name = path.resolve().name
    if not path.is_dir():
        if not path.exists():
            raise RunFileError(f"{path}: there is no such file or folder; check the path.")
        info, mark = read_info(path), read_mark(path)
        remarks = (f"it is marked bad: {mark.reason}" if mark is not None else "", incomplete_reason(info))
        run = ComparedRun(info, partial(read_run, path), "; ".join(filter(None, remarks)))
        return ComparedSide(name, (run,), (), (specimen_key(info),))
    campaign = read_campaign(path)
    left_out = unusable_files(campaign)
    chosen = _runs_of_specimen(campaign.runs, specimen, path)
    runs = []
    for info in chosen:
        mark = campaign.marks.get(info.path)
        reason = f"it is marked bad: {mark.reason}" if mark is not None else incomplete_reason(info)
        if reason:
            left_out.append(Exclusion(info.path.name, reason))
        else:
            runs.append(ComparedRun(info, partial(read_run, info.path)))
    if not runs:
        reasons = f" ({summarise_exclusions(left_out)})" if left_out else ""
        raise AnalysisError(f"{path}: holds no run that can be compared{reasons}.")
    return ComparedSide(name, tuple(runs), tuple(left_out), _specimens(chosen))


def _runs_of_specimen(infos: Sequence[RunInfo], specimen: str | None, path: Path) -> Sequence[RunInfo]:
    """Return the runs of the named specimen; all runs of a campaign that has only one specimen, whatever its name."""

    def names(info: RunInfo) -> set[str]:
        return {specimen_key(info), str(info.header.specimen.get("name"))}

    if specimen is None:
        return infos
    matching = [info for info in infos if specimen in names(info)]
    if matching or len(_specimens(infos)) < 2:
        return matching or infos
    known = sorted(set().union(*map(names, infos)))
    raise AnalysisError(f"{path}: has no run of specimen {specimen!r}, only of {', '.join(known)}.")


def side_from_runs(runs: Iterable[Run], name: str) -> ComparedSide:
    """Take runs in memory as one side; raises `AnalysisError` where none of several is complete."""
    loaded = tuple(ComparedRun(run.info, partial(_itself, run), incomplete_reason(run.info)) for run in runs)
    specimens = _specimens(run.info for run in loaded)
    if len(loaded) == 1:
        return ComparedSide(name, loaded, (), specimens)
    usable = tuple(run for run in loaded if not run.remark)
    if not usable:
        raise AnalysisError(f"{name}: holds no complete run; give runs that ended as planned.")
    left_out = tuple(Exclusion(run.file, run.remark) for run in loaded if run.remark)
    return ComparedSide(name, usable, left_out, specimens)


def model_side(recorded: ComparedSide, model: FrictionModelSettings, name: str) -> ComparedSide:
    """Take the friction model as the other side: every run simulated again on its own motion."""
    first_run_at = min((run.info.header.start_time for run in recorded.runs), default=None)

    def simulated(run: ComparedRun) -> Run:
        return resimulate(run.read(), model, first_run_at)

    return ComparedSide(
        f"model {name}",
        tuple(ComparedRun(run.info, partial(simulated, run)) for run in recorded.runs if run.info.kind != RETURN_KIND),
        tuple(Exclusion(run.file, RETURN_REASON) for run in recorded.runs if run.info.kind == RETURN_KIND),
        recorded.specimens,
        is_model=True,
    )


def resimulate(run: Run, model: FrictionModelSettings, first_run_at: datetime | None = None) -> Run:
    """Return the run with the model's force in place of the recorded one; filtered traces and checks are dropped.

    Position, command and phases stay: the model is driven by the recorded motion, so that errors of the drive
    cause no differences of the force. For the same reason effects of the model in motor and encoder are ignored.

    Parameters
    ----------
    first_run_at
        When the specimen's first run began, for effects that depend on the session's clock; default: this run.

    Raises
    ------
    AnalysisError
        One sentence, where the run lacks what the model needs.
    SettingsError
        Where the published wall parameters do not reach the strain of the run.
    """
    if run.trace.signal != "force":
        raise AnalysisError(f"it records {run.trace.signal}, which the friction model does not predict")
    experiment = Experiment(run)
    time_s = experiment.time_s
    if model.effects:
        started = run.info.header.start_time
        since_first_s = (started - (first_run_at or started)).total_seconds()
        chain = EffectChain.of(model)
        duration_s = float(time_s[-1])
        times = evaluation_times(duration_s, evaluation_rate_hz(run.trace.sample_rate_hz, duration_s))
        state = gut_run_state(acquisition_of(experiment), model, experiment.motion, times, since_first_s)
        force = chain.measured_force(state, chain.load(state), model.force_gain)
        force = np.asarray(np.interp(time_s, times, force))
    else:
        force = prepare(acquisition_of(experiment), model, experiment.motion).force(time_s)
    trace = replace(run.trace, channels={"force": force, "position": run.trace.position}, units=dict(run.trace.units))
    # A noise-free trace may stay at its largest value for long, without being clipped.
    info = replace(run.info, checks={"clipped_samples": 0})
    return replace(run, info=info, trace=trace, events=(), filtered=None)


def _itself(run: Run) -> Run:
    return run


def _specimens(infos: Iterable[RunInfo]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(map(specimen_key, infos)))
