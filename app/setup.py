"""What a session runs with: plan, rig, specimen and model, each found by name or file and changed by assignments."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Unpack

from dragrig.config.effects import EffectSettings
from dragrig.config.errors import PlanError, SettingsError
from dragrig.config.lab import rig_file_of
from dragrig.config.library import table
from dragrig.config.loading import Table, merge, nearest, parse
from dragrig.config.model import FrictionModelSettings
from dragrig.config.plan import Plan, Step
from dragrig.config.rig import RigSettings
from dragrig.config.specimen import Specimen
from dragrig.rig.programme import Programme, build
from dragrig.rig.protocols import Protocol, kinds
from dragrig.rig.record import record_in
from dragrig.rigs import Changes, RigChoices, RigSetup, chosen, contact_in, equipped, folder_of, found_settings

PlanLike = str | Path | Plan | Protocol
"""A plan by name or file, a run file whose session is to be made again, a plan, or the one run of a protocol."""


class Choices(RigChoices, total=False):
    """The keyword arguments of `resolve`; none and None mean the usual."""

    specimen: str | Path | None
    capsule: str | Path | None
    effects: Sequence[str | EffectSettings]


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup(RigSetup):
    """All settings of a session.

    Attributes
    ----------
    plan_source
        Where the plan comes from, for error messages.
    plan_folder
        Folder that capsule files in the plan are relative to; None for a shipped plan.
    contact_mm
        Absolute position of the contact that touch-off found; None where it is not known.
    """

    plan: Plan
    plan_source: str
    plan_folder: Path | None
    specimen: Specimen
    contact_mm: float | None = None

    def with_rig(self, assignments: Sequence[str]) -> "Setup":
        """Return this with assignments to the rig applied; any other is refused with `SettingsError`."""
        changes = Changes.of(assignments)
        if changes.steps or any(found for name, found in changes.others.items() if name != "rig"):
            raise SettingsError(
                f"--set {' '.join(assignments)}: a campaign goes on with its own plan, specimen and model, so only "
                "rig.… can be changed."
            )
        return replace(self, rig=changes.laid_over(self.rig, "rig"))

    def programme(self) -> Programme:
        """Lay out the plan's runs; raises `PlanError` or `SettingsError`."""
        stage, zero_mm = self.rig.stage, 0.0
        if stage.start_from == "contact":
            if self.contact_mm is None:
                raise SettingsError(
                    "stage.start_from = 'contact': no contact is known to this lab; find it with dragrig touch-off."
                )
            zero_mm = self.contact_mm
        return build(self.plan, self.specimen, stage.start_mm, self.plan_source, self.plan_folder, zero_mm)


def resolve(plan: PlanLike, *, folder: Path | None = None, **choices: Unpack[Choices]) -> Setup:
    """Find all settings of a session and apply the assignments.

    Parameters
    ----------
    folder
        Where to look for the lab folder; the working folder unless given.
    choices
        `rig`, `specimen`, `model`: a file or a shipped name, the model settings in memory as well; the rig is the lab
        folder's unless given, and the shipped one outside of a lab. `capsule`: a file or a name, for every step.
        `backend`: the rig's own unless given. `double`: whether its double is meant.
        `effects`: what the simulated rig has beside the model's, each as `stribeck:ratio=0.4,speed_mm_s=2`.
        `assignments`: each `key=value`; a path that begins with rig, model, specimen or plan changes that, a bare
        key every step that has it.

    Raises
    ------
    SettingsError, PlanError
        One sentence that names file, key and what is allowed.
    """
    before = record_in(Path(plan)) if isinstance(plan, str | Path) and Path(plan).suffix == ".h5" else None
    rig = choices.get("rig") or rig_file_of(folder or Path.cwd())
    rig_settings, rig_folder = found_settings(RigSettings, "rig", rig)
    if before is not None and not choices.get("rig"):
        rig_settings = before.rig
    changes = Changes.of(choices.get("assignments", ()))
    capsule = choices.get("capsule")
    if capsule is not None:
        changes.steps["capsule"] = _absolute(capsule)
    base_plan, source, plan_folder = (before.plan, str(plan), before.beside) if before is not None else _plan(plan)
    specimen = chosen(Specimen, "specimen", choices.get("specimen"), before.specimen if before else None)
    model = chosen(FrictionModelSettings, "model", choices.get("model"), before.model if before else None)
    rig_changed = changes.laid_over(rig_settings, "rig")
    backend = choices.get("backend") or (before.backend if before is not None else rig_changed.backend)
    double = choices.get("double", False) or (
        before is not None and before.double and choices.get("backend") in {None, before.backend}
    )
    changed = changes.laid_over(model, "model")
    return Setup(
        plan=_with_step_keys(changes.laid_over(base_plan, "plan"), changes.steps),
        plan_source=source,
        plan_folder=plan_folder,
        rig=rig_changed,
        specimen=changes.laid_over(specimen, "specimen"),
        contact_mm=contact_in(rig_folder, before.contact_mm if before is not None else None),
        model=equipped(changed, choices.get("effects", ()), backend=backend, double=double),
        rig_folder=rig_folder,
        backend=backend,
        double=double,
    )


def plan_of(protocol: Protocol) -> Plan:
    """Return the plan of one run, without its way back."""
    step = Step.model_validate({"kind": protocol.kind, "way_back": "stay", **protocol.model_dump(mode="json")})
    return Plan(name=protocol.kind, steps=(step,))


def _plan(plan: PlanLike) -> tuple[Plan, str, Path | None]:
    if isinstance(plan, Plan):
        return plan, f"plan {plan.name}", None
    if isinstance(plan, Protocol):
        return plan_of(plan), plan.kind, None
    data, source = table("plan", str(plan))
    return parse(Plan, data, source), source, folder_of(source)


def _with_step_keys(plan: Plan, changes: Table) -> Plan:
    if not changes:
        return plan
    known = [_keys_of(step) for step in plan.steps]
    for key in changes:
        if not any(key in keys for keys in known):
            everything = sorted(set().union(*known))
            raise PlanError(f"--set {key}: no step of plan {plan.name} has such a key; {nearest(key, everything)}")
    steps = [
        merge(step.model_dump(mode="json", exclude_unset=True), {k: v for k, v in changes.items() if k in keys})
        for step, keys in zip(plan.steps, known, strict=True)
    ]
    data = plan.model_dump(mode="json", exclude_unset=True)
    return parse(Plan, {**data, "steps": steps}, "--set")


def _keys_of(step: Step) -> set[str]:
    own = set(Step.model_fields) - {"kind", "parameters"}
    protocol = kinds().get(step.kind)
    return own if protocol is None else own | set(protocol.model_fields)


def _absolute(name_or_path: str | Path) -> str:
    path = Path(name_or_path)
    return str(path.absolute()) if path.is_file() else str(name_or_path)
