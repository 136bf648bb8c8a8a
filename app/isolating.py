"""Which effects a plan or a campaign can tell apart."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Unpack

from dragrig.analysis.gap.choosing import choose
from dragrig.analysis.gap.isolability.results import Isolability
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.nominal.capsule import CapsuleModel
from dragrig.analysis.nominal.protocol import NominalModel
from dragrig.analysis.progress import Progress, silent
from dragrig.diagnosing import options_of
from dragrig.measuring import simulate
from dragrig.setup import Choices, PlanLike, resolve


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
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

    selection: Selection
    nominal: NominalModel
    source: str
    planned: bool
    duration_s: float | None


def isolability(
    plan_or_campaign: PlanLike,
    *,
    without: Sequence[str] = (),
    progress: Progress = silent,
    **choices: Unpack[Choices],
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
    from dragrig.analysis.gap.isolability.isolate import isolate

    options_of(without, None)
    runs = runs_of(plan_or_campaign, **choices)
    return isolate(
        runs.selection,
        runs.nominal,
        without,
        source=runs.source,
        planned=runs.planned,
        duration_s=runs.duration_s,
        progress=progress,
    )


def runs_of(plan_or_campaign: PlanLike, **choices: Unpack[Choices]) -> Runs:
    """Return the runs of a campaign, or make those of a plan on the simulated rig; raises as `isolability`."""
    if isinstance(plan_or_campaign, str | Path) and Path(plan_or_campaign).is_dir():
        specimen = choices.get("specimen")
        selection = choose(Path(plan_or_campaign), None if specimen is None else str(specimen))
        model = resolve("drag", model=choices.get("model"), backend="simulated").model
        return Runs(selection, CapsuleModel(model), str(plan_or_campaign), planned=False, duration_s=None)
    choices["backend"] = "simulated"
    setup = resolve(plan_or_campaign, **choices)
    made = simulate(plan_or_campaign, **choices)
    name = setup.plan.name
    return Runs(choose(made), CapsuleModel(setup.model), name, planned=True, duration_s=setup.programme().duration_s)
