"""A plan as a form: what can be set, with unit, range and help from the schemas, and back to a plan."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from dragrig.config.base import Settings
from dragrig.config.errors import PlanError, SettingsError
from dragrig.config.library import shipped, table
from dragrig.config.loading import parse, parse_value
from dragrig.config.plan import Plan, Step
from dragrig.rig.protocols import Protocol, kinds

_UNITS = (("_mm_s2", "mm/s²"), ("_mm_s", "mm/s"), ("_mm", "mm"), ("_s", "s"), ("_mN", "mN"), ("_hz", "Hz"))
_WORDS = {
    "wait": "rest before the run",
    "rest": "standing before",
    "hold": "standing after",
    "tare": "take the zero for",
}
_HIDDEN = frozenset({"kind", "parameters"})


class FieldKind(StrEnum):
    """How a field is filled in."""

    NUMBER = "number"
    WHOLE = "whole number"
    CHOICE = "choice"
    SWITCH = "switch"
    TEXT = "text"
    LIST = "list"


@dataclass(frozen=True, slots=True)
class FormField:
    """One thing that can be set.

    Attributes
    ----------
    name
        What a person calls it, without its unit.
    limits
        The range that is allowed, in words; empty where there is none.
    sweeps
        Whether several values, separated by commas, make one run of each.
    default
        The usual value as text; empty where there is none.
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
    """One step: its kind with what that is, its fields, and their values as text."""

    kind: str
    about: str
    fields: tuple[FormField, ...]
    values: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class PlanForm:
    """A plan, filled in."""

    plan: Plan
    source: str
    steps: tuple[StepForm, ...] = field(default=())

    def filled(self, values: Sequence[Mapping[str, str]]) -> Plan:
        """Return the plan with other values in its steps.

        Raises
        ------
        PlanError, SettingsError
            For a value that cannot be read, or that a step does not allow.
        """
        steps = [{"kind": form.kind, **_values_of(form, given)} for form, given in zip(self.steps, values, strict=True)]
        data = self.plan.model_dump(mode="json", exclude_unset=True)
        return parse(Plan, {**data, "steps": steps}, self.plan.name)


def known_plans(lab: Path | None = None) -> tuple[str, ...]:
    """Return the plans there are to choose from: files of the lab folder and its folder `plans`, then shipped ones."""
    folders = () if lab is None else (lab, lab / "plans")
    files = sorted(path for folder in folders for path in folder.glob("*.toml") if _is_plan(path))
    return (*map(str, files), *shipped("plan"))


def form_of(name_or_path: str) -> PlanForm:
    """Return a plan's form.

    Raises
    ------
    SettingsError, PlanError
        When there is no such plan, or it cannot be used.
    """
    data, source = table("plan", name_or_path)
    return form_of_plan(parse(Plan, data, source), source)


def form_of_plan(plan: Plan, source: str) -> PlanForm:
    """Return the form of a plan in memory; raises `PlanError`."""
    beside = Path(source).absolute().parent if Path(source).is_file() else None
    steps = tuple(_step_form(step, f"{source}: steps[{at}]", beside) for at, step in enumerate(plan.steps))
    return PlanForm(plan, source, steps)


def _step_form(step: Step, where: str, beside: Path | None) -> StepForm:
    protocol = kinds().get(step.kind)
    if protocol is None:
        raise PlanError(f"{where}: kind = {step.kind!r} is not a kind of run.")
    fields = (*_fields(protocol, sweeps=True), *_fields(Step, sweeps=False))
    values = {one.key: _text(step.parameters[one.key]) for one in fields if one.key in step.parameters}
    own = step.model_dump(mode="json", exclude_unset=True)
    values |= {key: _text(value) for key, value in own.items() if key not in _HIDDEN and value is not None}
    if beside is not None and (beside / step.capsule).is_file():
        values["capsule"] = str(beside / step.capsule)
    return StepForm(step.kind, _about(protocol), fields, values)


def _fields(model: type[Settings], *, sweeps: bool) -> tuple[FormField, ...]:
    schema = model.model_json_schema()
    properties, shared = schema["properties"], schema.get("$defs", {})
    order = [key for key in properties if key not in _HIDDEN]
    if issubclass(model, Protocol):
        order.sort(key=lambda key: key in Protocol.model_fields)
    required = frozenset(schema.get("required", ()))
    return tuple(_field(key, _resolved(properties[key], shared), sweeps, key in required) for key in order)


def _resolved(entry: Mapping[str, object], shared: Mapping[str, object]) -> dict[str, object]:
    """Look references up, and take what a value that may be absent is when it is there."""
    found = dict(entry)
    options = found.get("anyOf")
    if isinstance(options, list):
        found |= next(one for one in options if one.get("type") != "null")
    reference = found.get("$ref")
    target = shared.get(reference.rsplit("/", 1)[-1]) if isinstance(reference, str) else None
    return {**target, **found} if isinstance(target, Mapping) else found


def _field(key: str, entry: Mapping[str, object], sweeps: bool, required: bool) -> FormField:
    stem, unit = next(((key.removesuffix(end), unit) for end, unit in _UNITS if key.endswith(end)), (key, ""))
    choices = entry.get("enum")
    kinds_of = {"number": FieldKind.NUMBER, "integer": FieldKind.WHOLE, "boolean": FieldKind.SWITCH,
                "array": FieldKind.LIST}  # fmt: skip
    kind = FieldKind.CHOICE if isinstance(choices, list) else kinds_of.get(str(entry.get("type")), FieldKind.TEXT)
    default = entry.get("default")
    return FormField(
        key=key,
        name=_WORDS.get(stem, stem).replace("accel", "acceleration").replace("_", " "),
        unit=unit,
        help=str(entry.get("description", "")),
        limits=_limits(entry, unit),
        kind=kind,
        default="" if default is None else _text(default),
        choices=tuple(map(str, choices)) if isinstance(choices, list) else (),
        sweeps=sweeps and kind in {FieldKind.NUMBER, FieldKind.WHOLE},
        required=required,
    )


def _limits(entry: Mapping[str, object], unit: str) -> str:
    low, above, high = (entry.get(one) for one in ("minimum", "exclusiveMinimum", "maximum"))
    words = [f"above {above:g}" if isinstance(above, int | float) else "",
             f"from {low:g}" if isinstance(low, int | float) else "",
             f"to {high:g}" if isinstance(high, int | float) else ""]  # fmt: skip
    said = " ".join(word for word in words if word)
    return f"{said} {unit}".strip() if said else ""


def _text(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float | int):
        return f"{value:.12g}"
    if isinstance(value, list | tuple) and all(isinstance(one, float | int) for one in value):
        return ", ".join(map(_text, value))
    if isinstance(value, list | tuple):
        return ",\n".join("{" + ", ".join(f"{key} = {_text(one)}" for key, one in row.items()) + "}" for row in value)
    return str(value)


def _values_of(form: StepForm, given: Mapping[str, str]) -> dict[str, object]:
    found = {one.key: _value(one, given.get(one.key, "").strip(), form.kind) for one in form.fields}
    return {key: value for key, value in found.items() if value is not None}


def _value(one: FormField, text: str, kind: str) -> object:
    if not text:
        return None
    match one.kind:
        case FieldKind.SWITCH:
            return text == "yes"
        case FieldKind.LIST:
            return parse_value(f"[{' '.join(text.splitlines())}]")
        case FieldKind.NUMBER | FieldKind.WHOLE:
            parts = [parse_value(part.strip()) for part in text.split(",") if part.strip()]
            if any(isinstance(part, bool | str) or not isinstance(part, int | float) for part in parts):
                raise SettingsError(f"{kind}, {one.name}: {text!r} is no number; write it as 12.5.")
            if len(parts) > 1 and not one.sweeps:
                raise SettingsError(f"{kind}, {one.name}: {text!r} are several numbers, where one is allowed.")
            return parts if len(parts) > 1 else parts[0]
        case _:
            return text


def _about(protocol: type[Protocol]) -> str:
    return (protocol.__doc__ or "").strip().splitlines()[0]


def _is_plan(path: Path) -> bool:
    try:
        data, _ = table("plan", str(path))
    except SettingsError:
        return False
    return "steps" in data
