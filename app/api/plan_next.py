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
from dragrig.analysis.selection import RunSelection
from dragrig.api.diagnose import diagnosis_options
from dragrig.api.measure import simulate
from dragrig.config.errors import SettingsError
from dragrig.config.settings import suggestion, to_toml
from dragrig.present.files import write_text
from dragrig.setup import PlanLike, SetupChoices, resolve

DEFAULT_MINUTES, MAX_RUNS = 20.0, 30


@dataclass(frozen=True, slots=True, eq=False)
class RunsToIsolate:
    """The runs of a campaign, or those that a plan would make.

    Attributes
    ----------
    nominal
        The model that is expected.
    planned
        Whether the runs are yet to be made.
    duration_s
        Rig time, of a plan.
    """

    selection: RunSelection
    nominal: CapsuleModel
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
    """Determine which effects a plan (before any run) or a campaign can tell apart, and its detection limits.

    Parameters
    ----------
    plan_or_campaign
        A campaign's folder; or a plan by name or file, a `Plan`, or a protocol, whose runs are then simulated without
        any effect.
    without
        Effects of the catalogue to leave out.
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
    >>> result = dragrig.isolability("paper")  # doctest: +SKIP
    >>> result.pair("stribeck", "adhesion").sin2  # doctest: +SKIP
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
    """Return the runs of a campaign, or simulate those of a plan; raises as `isolability`."""
    choices["backend"] = "simulated"
    if isinstance(plan_or_campaign, str | Path) and Path(plan_or_campaign).is_dir():
        specimen = choices.get("specimen")
        selection = choose_runs(Path(plan_or_campaign), None if specimen is None else str(specimen))
        model = resolve("drag", model=choices.get("model"), backend="simulated").model
        return RunsToIsolate(selection, CapsuleModel(model), str(plan_or_campaign), planned=False, duration_s=None)
    setup = resolve(plan_or_campaign, **choices)
    selection = choose_runs(simulate(plan_or_campaign, **choices))
    duration_s = setup.programme().duration_s
    return RunsToIsolate(selection, CapsuleModel(setup.model), setup.plan.name, planned=True, duration_s=duration_s)


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
        A campaign's folder, which is diagnosed first; or a plan, whose runs are taken as made and whose most similar
        effects are to be separated.
    between
        Two effects to separate, at their default sizes, in place of the leading hypotheses.
    minutes
        Rig time available, rests and return strokes included.
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
    >>> experiment = dragrig.next_experiment("runs/first")  # doctest: +SKIP
    >>> experiment.reason, experiment.runs[0].settings  # doctest: +SKIP
    """
    from dragrig.analysis.gap.diagnose import DiagnosisOptions, diagnose
    from dragrig.analysis.gap.next_run_force import recommend_for_pair

    if not (isfinite(minutes) and minutes > 0):
        raise SettingsError(f"--minutes {minutes:g}: a rig time is a number of minutes above 0.")
    if between is not None:
        _require_two_effects(between)
    budget = ExperimentBudget(minutes, MAX_RUNS, limits=_stage_range(choices.get("rig")))
    runs = runs_to_isolate(plan_or_campaign, **choices)
    if between is None and not runs.planned:
        return diagnose(runs.selection, runs.nominal, DiagnosisOptions(next_runs=budget), progress).next_experiment
    return recommend_for_pair(runs.selection, runs.nominal, between, budget)


def save_next_plan(experiment: NextExperiment, path: Path, *, overwrite: bool = False) -> Path:
    """Write the runs as a plan file; raises `OutputError` when the file exists or cannot be written."""
    from dragrig.analysis.gap.candidate_runs import plan_of_next_runs

    return write_text(to_toml(plan_of_next_runs(experiment)), path, overwrite=overwrite)


def _stage_range(rig: str | Path | None) -> RigLimits:
    setup = resolve("drag", rig=rig, backend="simulated")
    stage = setup.limits
    return RigLimits(stage.highest_mm - setup.rig.stage.start_mm, stage.speed_mm_s, stage.acceleration_mm_s2)


def _require_two_effects(between: tuple[str, str]) -> None:
    from dragrig.sim_backend.effects.base import catalogue

    known = [effect.id for effect in catalogue().values() if effect.has_force_signature]
    for name in between:
        if name not in known:
            raise SettingsError(
                f"--between {name}: is no effect on the force that runs can show; {suggestion(name, known)}"
            )
    if between[0] == between[1]:
        raise SettingsError(f"--between {between[0]} {between[1]}: name two effects that differ.")
