"""Runs that have not been made, as a study of a campaign would see them: their motion, the campaign's noise."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np

from dragrig.analysis.gap.planning.trials import Trial
from dragrig.analysis.gap.sights import LONGEST_MM, Sight
from dragrig.analysis.gap.study import Study
from dragrig.analysis.identification.joint.evidence import gather
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.config.specimen import Specimen
from dragrig.rig.arrays import AnyFloatArray
from dragrig.rig.runfile.model import Channel, Run, RunHeader, RunInfo, Status, Trace

LATER_S = 120.0
"""From the campaign's last sample to the next run."""
COUNT_MM = 0.001
HIGHEST_HZ = 1000.0
"""Faster sampling costs time and tells nothing more here."""


def imagined(study: Study, trials: Sequence[Trial]) -> Study:
    """Return the study of runs that are yet to be made, each as the first one after the campaign.

    Raises `AnalysisError` where the nominal model cannot be prepared for them.
    """
    last = max(study.sights, key=lambda one: one.session_start_s)
    experiments = experiments_after(last.experiment, trials)
    evidence = tuple(gather(experiments, study.problem.nominal, LONGEST_MM))
    count = len(evidence)
    first = last.session_start_s + float(last.experiment.time_s[-1]) + LATER_S
    starts = [first + trial.step.wait_s for trial in trials]
    problem = replace(
        study.problem,
        evidence=evidence,
        noises=(study.problem.noises[0],) * count,
        zero_sds=(max(study.problem.zero_sds),) * count,
    )
    return replace(study, problem=problem, sights=tuple(map(Sight, evidence, starts)))


def experiments_after(last: Experiment, trials: Sequence[Trial]) -> list[Experiment]:
    """Return runs that are yet to be made, each as the next one after the last of a campaign, at rest in force."""
    return [_experiment(trial, last, number) for number, trial in enumerate(trials)]


def specimen_of(study: Study) -> Specimen:
    """Return the specimen as the campaign's runs note it."""
    one = study.sights[0].experiment
    name = str(one.run.info.header.specimen.get("name") or "specimen")
    return Specimen(name=name, wall_thickness_mm=one.wall_thickness_mm)


def _experiment(trial: Trial, after: Experiment, number: int) -> Experiment:
    run, before = trial.run, after.run.info.header
    rate = min(before.sample_rate_hz, HIGHEST_HZ)
    time = np.arange(max(run.profile.samples(rate), 2)) / rate
    command = run.profile.position(time)
    channels: dict[str, AnyFloatArray] = {
        "force": np.zeros_like(time),
        "position": np.round(command / COUNT_MM) * COUNT_MM,
    }
    header = RunHeader(
        run_id=f"next-{number}",
        start_time=before.start_time + timedelta(seconds=float(after.time_s[-1]) + LATER_S),
        order=before.order + 1,
        backend=before.backend,
        kind=run.protocol.kind,
        sample_rate_hz=rate,
        channels=(Channel("force", "mN"), Channel("position", "mm")),
        entry={"insertion_dwell_s": run.wait_s},
        protocol=run.protocol.attributes(),
        capsule=run.capsule.model_dump(mode="json", exclude_none=True),
        specimen={**run.specimen.model_dump(mode="json", exclude_none=True), "fixture": run.fixture.value},
    )
    info = RunInfo(Path(f"{header.run_id}.h5"), 1, Status.COMPLETE, header, len(time))
    phase = run.profile.phase_at(time)
    return Experiment(
        Run(info, Trace(rate, "force", time, command, phase, channels, {"force": "mN", "position": "mm"}))
    )
