"""A run as the friction model has it: the same motion, as recorded, without noise and zero offset."""

from dataclasses import replace

from dragrig.analysis.nominal.capsule_forces import acquisition_of
from dragrig.analysis.nominal.experiment import Experiment
from dragrig.config.errors import AnalysisError
from dragrig.config.model import FrictionModelSettings
from dragrig.rig.runfile.model import Run
from dragrig.sim_backend.friction import prepare


def simulated_again(run: Run, model: FrictionModelSettings) -> Run:
    """Return the run with the model's force in place of the recorded one; filter results and checks are dropped.

    Position, command and phases stay: the model is driven by the recorded motion, so that what the drive does wrong
    makes no false difference of the force.

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
    prepared = prepare(acquisition_of(experiment), model, experiment.motion)
    force = prepared.force(experiment.time_s)
    trace = replace(run.trace, channels={"force": force, "position": run.trace.position}, units=dict(run.trace.units))
    # A noise-free trace may stay at its largest value for long, and is not clipped for that.
    info = replace(run.info, checks={"clipped_samples": 0})
    return replace(run, info=info, trace=trace, events=(), filtered=None)
