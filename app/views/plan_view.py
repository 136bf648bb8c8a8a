"""A plan as a form with units, ranges and help, and a preview of its runs: motion, duration, findings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from dragrig.api.measure import check
from dragrig.config.errors import PlanError, SettingsError
from dragrig.config.plan import Plan, PlanStep
from dragrig.config.settings import Settings, find_table, parse, parse_value, shipped_files
from dragrig.engine_host.messages import RigSelection
from dragrig.rig.arrays import FloatArray
from dragrig.rig.preflight import Preflight, RunPreview
from dragrig.rig.protocols import RunProtocol, protocol_kinds
from dragrig.setup import resolve_pace, resolve_rig

_UNIT_SUFFIXES = (("_mm_s2", "mm/s²"), ("_mm_s", "mm/s"), ("_mm", "mm"), ("_s", "s"), ("_mN", "mN"), ("_hz", "Hz"))
_FIELD_LABELS = {
    "wait": "wait before the run",
    "rest": "rest before the motion",
    "hold": "hold after the motion",
    "tare": "tare duration",
}
_HIDDEN_KEYS = frozenset({"kind", "parameters"})


class FieldKind(StrEnum):
    """Kind of a form field's value."""

    NUMBER = "number"
    WHOLE = "whole number"
    CHOICE = "choice"
    SWITCH = "switch"
    TEXT = "text"
    LIST = "list"


@dataclass(frozen=True, slots=True)
class FormField:
    """A field of a form.

    Attributes
    ----------
    name
        Label without the unit.
    limits
        Allowed range as text; empty without one.
    sweeps
        Whether several values, separated by commas, make one run of each.
    default
        Default value as text; empty without one.
    """

    key: str
    name: str
    unit: str
    help: str
    limits: str
    kind: FieldKind
    default: str = ""
    choices: tuple[str, ...] = ()
    sweeps: bool = False
    required: bool = False


@dataclass(frozen=True, slots=True)
class StepForm:
    """A step: its kind with a description, its fields, and their values as text."""

    kind: str
    about: str
    fields: tuple[FormField, ...]
    values: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class PlanForm:
    """A plan as a form."""

    plan: Plan
    source: str
    steps: tuple[StepForm, ...] = ()

    def filled(self, values: Sequence[Mapping[str, str]]) -> Plan:
        """Return the plan with these values in its steps.

        Raises
        ------
        PlanError, SettingsError
            For an invalid value.
        """
        steps = [
            {"kind": form.kind, **_parse_values(form, given)} for form, given in zip(self.steps, values, strict=True)
        ]
        data = self.plan.model_dump(mode="json", exclude_unset=True)
        return parse(Plan, {**data, "steps": steps}, self.plan.name)


def known_plans(lab: Path | None = None) -> tuple[str, ...]:
    """Return the available plans: those in the lab folder and in its folder `plans`, then the shipped ones."""
    folders = () if lab is None else (lab, lab / "plans")
    files = sorted(path for folder in folders for path in folder.glob("*.toml") if _is_plan(path))
    return (*map(str, files), *shipped_files("plan"))


def plan_form(name_or_path: str) -> PlanForm:
    """Return a plan's form.

    Raises
    ------
    SettingsError, PlanError
        When there is no such plan, or it is invalid.
    """
    data, source = find_table("plan", name_or_path)
    return form_from_plan(parse(Plan, data, source), source)


def form_from_plan(plan: Plan, source: str) -> PlanForm:
    """Return the form of a plan in memory; raises `PlanError`."""
    beside = Path(source).absolute().parent if Path(source).is_file() else None
    steps = tuple(_step_form(step, f"{source}: steps[{index}]", beside) for index, step in enumerate(plan.steps))
    return PlanForm(plan, source, steps)


def _step_form(step: PlanStep, where: str, beside: Path | None) -> StepForm:
    protocol = protocol_kinds().get(step.kind)
    if protocol is None:
        raise PlanError(f"{where}: kind = {step.kind!r} is not a kind of run.")
    fields = (*_form_fields(protocol, sweeps=True), *_form_fields(PlanStep, sweeps=False))
    values = {field.key: _value_text(step.parameters[field.key]) for field in fields if field.key in step.parameters}
    own = step.model_dump(mode="json", exclude_unset=True)
    values |= {key: _value_text(value) for key, value in own.items() if key not in _HIDDEN_KEYS and value is not None}
    if beside is not None and (beside / step.capsule).is_file():
        values["capsule"] = str(beside / step.capsule)
    return StepForm(step.kind, (protocol.__doc__ or "").strip().splitlines()[0], fields, values)


def _form_fields(model: type[Settings], *, sweeps: bool) -> tuple[FormField, ...]:
    schema = model.model_json_schema()
    properties, shared = schema["properties"], schema.get("$defs", {})
    order = [key for key in properties if key not in _HIDDEN_KEYS]
    if issubclass(model, RunProtocol):
        order.sort(key=lambda key: key in RunProtocol.model_fields)
    required = frozenset(schema.get("required", ()))
    return tuple(_form_field(key, _resolved_schema(properties[key], shared), sweeps, key in required) for key in order)


def _resolved_schema(entry: Mapping[str, object], shared: Mapping[str, object]) -> dict[str, object]:
    """Resolve a reference, and the type other than null of an optional value."""
    resolved = dict(entry)
    options = resolved.get("anyOf")
    if isinstance(options, list):
        resolved |= next(option for option in options if option.get("type") != "null")
    reference = resolved.get("$ref")
    target = shared.get(reference.rsplit("/", 1)[-1]) if isinstance(reference, str) else None
    return {**target, **resolved} if isinstance(target, Mapping) else resolved


def _form_field(key: str, entry: Mapping[str, object], sweeps: bool, required: bool) -> FormField:
    stem, unit = next(((key.removesuffix(end), unit) for end, unit in _UNIT_SUFFIXES if key.endswith(end)), (key, ""))
    choices = entry.get("enum")
    kinds_of = {"number": FieldKind.NUMBER, "integer": FieldKind.WHOLE, "boolean": FieldKind.SWITCH,
                "array": FieldKind.LIST}  # fmt: skip
    kind = FieldKind.CHOICE if isinstance(choices, list) else kinds_of.get(str(entry.get("type")), FieldKind.TEXT)
    default = entry.get("default")
    return FormField(
        key=key,
        name=_FIELD_LABELS.get(stem, stem).replace("accel", "acceleration").replace("_", " "),
        unit=unit,
        help=str(entry.get("description", "")),
        limits=_range_text(entry, unit),
        kind=kind,
        default="" if default is None else _value_text(default),
        choices=tuple(map(str, choices)) if isinstance(choices, list) else (),
        sweeps=sweeps and kind in {FieldKind.NUMBER, FieldKind.WHOLE},
        required=required,
    )


def _range_text(entry: Mapping[str, object], unit: str) -> str:
    low, above, high = (entry.get(bound) for bound in ("minimum", "exclusiveMinimum", "maximum"))
    bounds = [f"above {above:g}" if isinstance(above, int | float) else "",
             f"from {low:g}" if isinstance(low, int | float) else "",
             f"to {high:g}" if isinstance(high, int | float) else ""]  # fmt: skip
    text = " ".join(bound for bound in bounds if bound)
    return f"{text} {unit}".strip() if text else ""


def _value_text(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float | int):
        return f"{value:.12g}"
    if isinstance(value, list | tuple) and all(isinstance(item, float | int) for item in value):
        return ", ".join(map(_value_text, value))
    if isinstance(value, list | tuple):
        return ",\n".join(
            "{" + ", ".join(f"{key} = {_value_text(item)}" for key, item in row.items()) + "}" for row in value
        )
    return str(value)


def _parse_values(form: StepForm, given: Mapping[str, str]) -> dict[str, object]:
    values = {field.key: _parse_field(field, given.get(field.key, "").strip(), form.kind) for field in form.fields}
    return {key: value for key, value in values.items() if value is not None}


def _parse_field(field: FormField, text: str, kind: str) -> object:
    if not text:
        return None
    match field.kind:
        case FieldKind.SWITCH:
            return text == "yes"
        case FieldKind.LIST:
            return parse_value(f"[{' '.join(text.splitlines())}]")
        case FieldKind.NUMBER | FieldKind.WHOLE:
            parts = [parse_value(part.strip()) for part in text.split(",") if part.strip()]
            if any(isinstance(part, bool | str) or not isinstance(part, int | float) for part in parts):
                raise SettingsError(f"{kind}, {field.name}: {text!r} is not a number; write it as 12.5.")
            if len(parts) > 1 and not field.sweeps:
                raise SettingsError(f"{kind}, {field.name}: {text!r} is several numbers; one is allowed.")
            return parts if len(parts) > 1 else parts[0]
        case _:
            return text


def _is_plan(path: Path) -> bool:
    try:
        data, _ = find_table("plan", str(path))
    except SettingsError:
        return False
    return "steps" in data


_POINTS_PER_SEGMENT = 24


@dataclass(frozen=True, slots=True)
class SessionPreview:
    """A checked plan and the stage's limits."""

    preflight: Preflight
    lowest_mm: float
    highest_mm: float


def motion_curves(preview: RunPreview) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times [s], absolute positions [mm] and speeds [mm/s] of a run's planned motion, shape `(n,)` each."""
    run = preview.run
    profile = run.profile
    ends = np.append(profile.start_s, profile.duration_s)
    inside = np.linspace(0.0, 1.0, _POINTS_PER_SEGMENT, endpoint=False)
    time = np.append((ends[:-1, None] + np.diff(ends)[:, None] * inside).ravel(), profile.duration_s)
    return time, run.start_mm + profile.position(time), profile.velocity(time)


@dataclass(frozen=True, slots=True)
class RigDescription:
    """The rig in use, with a title in capital letters and its meaning."""

    name: str
    backend: str
    title: str
    meaning: str
    real: bool
    force_limit_mN: float
    data_root: str


def preview_session(plan: Plan | str, rig: RigSelection) -> SessionPreview:
    """Check a plan without moving anything.

    Raises
    ------
    SettingsError, PlanError, OutputError
        For invalid settings.
    """
    stage = resolve_rig(**rig.choices()).rig.stage
    return SessionPreview(check(plan, **rig.choices()), stage.lowest_mm, stage.highest_mm)


def describe_rig(rig: RigSelection) -> RigDescription:
    """Describe the rig in use; raises `SettingsError`, also for a pace it does not support."""
    setup = resolve_rig(**rig.choices())
    resolve_pace(rig.pace, double=setup.double)
    simulated = setup.backend == "simulated"
    if simulated:
        title, meaning = "SIMULATED", "nothing moves; rig and gut are simulated with the friction model"
    elif setup.double:
        title, meaning = "DOUBLE", "nothing moves; card and drive are doubles"
    else:
        title, meaning = "HARDWARE", "the real stage moves"
    return RigDescription(
        name=setup.rig.name,
        backend=setup.backend,
        title=title,
        meaning=meaning,
        real=not (simulated or setup.double),
        force_limit_mN=setup.rig.guard.force_limit_mN,
        data_root=str(setup.data_root),
    )
