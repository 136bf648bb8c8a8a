"""Which effects a plan or a campaign can isolate, and which runs to make next."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Unpack

from dragrig.analysis.computation import Progress, no_progress
from dragrig.analysis.gap.candidate_runs import ExperimentBudget, RigLimits
from dragrig.analysis.gap.diagnosis import NextExperiment
from dragrig.analysis.gap.isolability import Isolability
from dragrig.analysis.gap.run_selection import choose_runs
from dragrig.analysis.models.capsule_model import CapsuleModel
from dragrig.analysis.models.nominal_model import NominalModel
from dragrig.analysis.selection import RunSelection
from dragrig.api.diagnose import diagnosis_options
from dragrig.api.measure import simulate
from dragrig.config.errors import SettingsError
from dragrig.config.settings import suggestion, to_toml
from dragrig.present.files import write_text
from dragrig.setup import PlanLike, SetupChoices, resolve


@dataclass(frozen=True, slots=True, eq=False)
class RunsToIsolate:
    """Runs to be looked at: those of a campaign, or those that a plan would make.

    Attributes
    ----------
    nominal
        What is expected of them.
    planned
        Whether they are yet to be made.
    duration_s
        Rig time, of a plan.
    """

    selection: RunSelection
    nominal: NominalModel
    source: str
    planned: bool
    duration_s: float | None


def isolability(
    plan_or_campaign: PlanLike,
    *,
    without: Sequence[str] = (),
    progress: Progress = no_progress,
    **choices: Unpack[SetupChoices],
) -> Isolability:
    """Say which effects a plan, before any run, or a campaign can tell apart, and how small a one it would show.

    Parameters
    ----------
    plan_or_campaign
        A campaign's folder; or a plan by name or file, a `Plan`, or a protocol, whose runs are then made on the
        simulated rig without any effect.
    without
        Effects of the catalogue that are not to be considered.
    choices
        As of `check`: rig, specimen, model, capsule, assignments; of a campaign, `specimen` names one of several and
        `model` is the friction model.

    Raises
    ------
    AnalysisError
        When there is no usable run.
    SettingsError, PlanError, RunFileError
        When plan, campaign or settings cannot be used.

    Examples
    --------
    >>> import dragrig
    >>> found = dragrig.isolability("paper")  # doctest: +SKIP
    >>> found.pair("stribeck", "adhesion").sin2  # doctest: +SKIP
    """
    from dragrig.analysis.gap.isolability import isolate

    diagnosis_options(without, None)
    runs = runs_to_isolate(plan_or_campaign, **choices)
    return isolate(
        runs.selection,
        runs.nominal,
        without,
        source=runs.source,
        planned=runs.planned,
        duration_s=runs.duration_s,
        progress=progress,
    )


def runs_to_isolate(plan_or_campaign: PlanLike, **choices: Unpack[SetupChoices]) -> RunsToIsolate:
    """Return the runs of a campaign, or make those of a plan on the simulated rig; raises as `isolability`."""
    if isinstance(plan_or_campaign, str | Path) and Path(plan_or_campaign).is_dir():
        specimen = choices.get("specimen")
        selection = choose_runs(Path(plan_or_campaign), None if specimen is None else str(specimen))
        model = resolve("drag", model=choices.get("model"), backend="simulated").model
        return RunsToIsolate(selection, CapsuleModel(model), str(plan_or_campaign), planned=False, duration_s=None)
    choices["backend"] = "simulated"
    setup = resolve(plan_or_campaign, **choices)
    made = simulate(plan_or_campaign, **choices)
    name = setup.plan.name
    return RunsToIsolate(
        choose_runs(made), CapsuleModel(setup.model), name, planned=True, duration_s=setup.programme().duration_s
    )


DEFAULT_MINUTES, MAX_RUNS = 20.0, 30


def next_experiment(
    plan_or_campaign: PlanLike,
    *,
    between: tuple[str, str] | None = None,
    minutes: float = DEFAULT_MINUTES,
    progress: Progress = no_progress,
    **choices: Unpack[SetupChoices],
) -> NextExperiment | None:
    """Search for the runs that would separate the leading hypotheses best per minute of rig time.

    Parameters
    ----------
    plan_or_campaign
        A campaign's folder, which is diagnosed first; or a plan, whose runs are taken as made and whose closest effects
        are to be told apart.
    between
        Two effects to be told apart, at their usual sizes, in place of the leading ones.
    minutes
        Rig time that the runs may take, rests and ways back included.
    choices
        As of `check`; the rig's limits are kept.

    Returns
    -------
    None where no run would help.

    Raises
    ------
    AnalysisError
        When there is no usable run, or the runs do not show an effect at all.
    SettingsError, PlanError, RunFileError
        When plan, campaign or settings cannot be used.

    Examples
    --------
    >>> import dragrig
    >>> found = dragrig.next_experiment("runs/first")  # doctest: +SKIP
    >>> found.why, found.runs[0].settings  # doctest: +SKIP
    """
    from dragrig.analysis.gap.diagnose import DiagnosisOptions, diagnose
    from dragrig.analysis.gap.next_run_force import recommend_for_pair
    from dragrig.analysis.gap.run_selection import choose_runs

    if not (isfinite(minutes) and minutes > 0):
        raise SettingsError(f"--minutes {minutes:g}: a rig time is a number of minutes above 0.")
    if between is not None:
        _require_two_effects(between)
    campaign = isinstance(plan_or_campaign, str | Path) and Path(plan_or_campaign).is_dir()
    choices["backend"] = "simulated"
    budget = ExperimentBudget(minutes, MAX_RUNS, limits=_stage_range(**choices))
    if campaign and between is None and isinstance(plan_or_campaign, str | Path):
        specimen = choices.get("specimen")
        selection = choose_runs(Path(plan_or_campaign), None if specimen is None else str(specimen))
        model = CapsuleModel(resolve("drag", model=choices.get("model"), backend="simulated").model)
        return diagnose(selection, model, DiagnosisOptions(next_runs=budget), progress).next_experiment
    runs = runs_to_isolate(plan_or_campaign, **choices)
    if not isinstance(runs.nominal, CapsuleModel):
        return None
    return recommend_for_pair(runs.selection, runs.nominal, between, budget)


def save_next_plan(found: NextExperiment, path: Path, *, overwrite: bool = False) -> Path:
    """Write the runs as a plan file; raises `OutputError` when the file is there already, or the folder refuses."""
    from dragrig.analysis.gap.candidate_runs import plan_of_next_runs

    return write_text(to_toml(plan_of_next_runs(found)), path, overwrite=overwrite)


def _stage_range(**choices: Unpack[SetupChoices]) -> RigLimits:
    setup = resolve("drag", rig=choices.get("rig"), backend="simulated")
    stage = setup.limits
    return RigLimits(stage.highest_mm - setup.rig.stage.start_mm, stage.speed_mm_s, stage.acceleration_mm_s2)


def _require_two_effects(between: tuple[str, str]) -> None:
    from dragrig.sim_backend.effects.base import ForceEffect, SensorEffect, catalogue

    known = [one.id for one in catalogue().values() if isinstance(one, ForceEffect | SensorEffect)]
    for name in between:
        if name not in known or name == "mains_hum":
            raise SettingsError(
                f"--between {name}: is no effect of the force that runs tell; {suggestion(name, known)}"
            )
    if between[0] == between[1]:
        raise SettingsError(f"--between {between[0]} {between[1]}: name two effects that differ.")
