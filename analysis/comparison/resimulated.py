"""A run as the friction model has it: the same motion, as recorded, without noise and zero offset."""

from dataclasses import replace
from datetime import datetime

import numpy as np

from dragrig.analysis.nominal.capsule_forces import acquisition_of
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.config.errors import AnalysisError
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.runfile.model import Run
from dragrig.sim_backend.effects.applied import Chain, computing_rate_hz, even_times
from dragrig.sim_backend.effects.scene import gut_scene
from dragrig.sim_backend.friction import prepare


def simulated_again(run: Run, model: FrictionModelSettings, first_run_at: datetime | None = None) -> Run:
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
        force = _with_effects(experiment, model, (began - (first_run_at or began)).total_seconds())
    else:
        force = prepare(acquisition_of(experiment), model, experiment.motion).force(experiment.time_s)
    trace = replace(run.trace, channels={"force": force, "position": run.trace.position}, units=dict(run.trace.units))
    # A noise-free trace may stay at its largest value for long, and is not clipped for that.
    info = replace(run.info, checks={"clipped_samples": 0})
    return replace(run, info=info, trace=trace, events=(), filtered=None)


def _with_effects(experiment: Experiment, model: FrictionModelSettings, session_start_s: float) -> FloatArray:
    chain, time = Chain.of(model), experiment.time_s
    duration_s = float(time[-1])
    rate_hz = computing_rate_hz(experiment.run.trace.sample_rate_hz, duration_s)
    times = even_times(duration_s, rate_hz)
    scene = gut_scene(acquisition_of(experiment), model, experiment.motion, times, session_start_s)
    return np.asarray(np.interp(time, times, chain.shown(scene, chain.load(scene), model.force_gain)))
