"""Which runs to make next: for a campaign after its diagnosis, or beside a plan's runs."""

from math import isfinite
from pathlib import Path
from typing import Unpack

from dragrig.analysis.gap.planning.results import NextExperiment
from dragrig.analysis.gap.planning.search import Budget
from dragrig.analysis.gap.planning.trials import Limits
from dragrig.analysis.nominal.capsule import CapsuleModel
from dragrig.analysis.progress import Progress, silent
from dragrig.config.errors import SettingsError
from dragrig.config.loading import nearest, to_toml
from dragrig.isolating import runs_of
from dragrig.reports.files import write_text
from dragrig.setup import Choices, PlanLike, resolve

MINUTES, MOST_RUNS = 20.0, 30


def next_experiment(
    plan_or_campaign: PlanLike,
    *,
    between: tuple[str, str] | None = None,
    minutes: float = MINUTES,
    progress: Progress = silent,
    **choices: Unpack[Choices],
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
    from dragrig.analysis.gap.choosing import choose
    from dragrig.analysis.gap.diagnose import Options, diagnose
    from dragrig.analysis.gap.planning.between import next_between

    if not (isfinite(minutes) and minutes > 0):
        raise SettingsError(f"--minutes {minutes:g}: a rig time is a number of minutes above 0.")
    if between is not None:
        _require_two(between)
    campaign = isinstance(plan_or_campaign, str | Path) and Path(plan_or_campaign).is_dir()
    choices["backend"] = "simulated"
    budget = Budget(minutes, MOST_RUNS, limits=_limits(**choices))
    if campaign and between is None and isinstance(plan_or_campaign, str | Path):
        specimen = choices.get("specimen")
        selection = choose(Path(plan_or_campaign), None if specimen is None else str(specimen))
        model = CapsuleModel(resolve("drag", model=choices.get("model"), backend="simulated").model)
        return diagnose(selection, model, Options(next_runs=budget), progress).next_experiment
    runs = runs_of(plan_or_campaign, **choices)
    if not isinstance(runs.nominal, CapsuleModel):
        return None
    return next_between(runs.selection, runs.nominal, between, budget)


def save_plan(found: NextExperiment, path: Path, *, overwrite: bool = False) -> Path:
    """Write the runs as a plan file; raises `OutputError` when the file is there already, or the folder refuses."""
    from dragrig.analysis.gap.planning.writing import plan_of

    return write_text(to_toml(plan_of(found)), path, overwrite=overwrite)


def _limits(**choices: Unpack[Choices]) -> Limits:
    setup = resolve("drag", rig=choices.get("rig"), backend="simulated")
    stage = setup.limits
    return Limits(stage.highest_mm - setup.rig.stage.start_mm, stage.speed_mm_s, stage.acceleration_mm_s2)


def _require_two(between: tuple[str, str]) -> None:
    from dragrig.sim_backend.effects.base import ForceEffect, SensorEffect
    from dragrig.sim_backend.effects.catalogue import catalogue

    known = [one.id for one in catalogue().values() if isinstance(one, ForceEffect | SensorEffect)]
    for name in between:
        if name not in known or name == "mains_hum":
            raise SettingsError(f"--between {name}: is no effect of the force that runs tell; {nearest(name, known)}")
    if between[0] == between[1]:
        raise SettingsError(f"--between {between[0]} {between[1]}: name two effects that differ.")
