"""The views of the window, made in other processes and threads: plans, runs and diagnoses; free of Qt."""

import json
import multiprocessing
import re
import signal
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache
from math import inf
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from dragrig import config
from dragrig.analysis import (
    Progress,
    TableRow,
    count_text,
    filter_run,
    gap_starts,
    table_row,
    unreadable_row,
)
from dragrig.analysis.gap import Diagnosis, SettleRecord
from dragrig.api import ExportFormatName, check, check_setup, filter_settings, run_query
from dragrig.catalogue import ask_runs
from dragrig.engine_host import RigSelection
from dragrig.present import UNIT_SUFFIXES, Document, attribute_texts, drawn, start_position_mm, unused_path
from dragrig.rig import (
    AnyFloatArray,
    Campaign,
    FloatArray,
    Preflight,
    Run,
    RunInfo,
    RunPreview,
    RunProtocol,
    SessionRecord,
    latest_session_record,
    protocol_kinds,
    read_campaign,
    read_info,
    read_mark,
    read_note,
    read_run,
    recover,
    session_record_of_run,
    specimen_key,
)
from dragrig.run_listing import CampaignSummary, RunListing, RunQuery
from dragrig.setup import resolve_pace, resolve_rig

_VOLT_KEYS = frozenset({"zero_V", "range_V", "rail_V"})
"""Keys in volts; one that ends in per_V is not."""
_FIELD_LABELS = {
    "wait": "wait before the run",
    "rest": "rest before the motion",
    "hold": "hold after the motion",
    "tare": "tare duration",
    "per_V": "per volt",
}
_HIDDEN_KEYS = frozenset({"kind", "parameters"})


class FieldKind(StrEnum):
    """Kind of a form field's value."""

    NUMBER = "number"
    NUMBERS = "numbers"
    CHOICE = "choice"
    SWITCH = "switch"
    TEXT = "text"
    LIST = "list"


@dataclass(frozen=True, slots=True)
class FormField:
    """A field of a form."""

    key: str
    name: str
    """Label without the unit."""
    help: str
    kind: FieldKind
    allowed: config.NumberRange = config.ANY_NUMBER
    """Of a number, or of each of several."""
    default: str = ""
    """Default value as text; empty without one."""
    choices: tuple[str | int, ...] = ()
    sweeps: bool = False
    """Whether several values, separated by commas, make one run of each."""
    required: bool = False
    empty: str = "default"
    """What stands in an empty field."""

    @property
    def unit(self) -> str:
        """Unit of a number, or of each of several."""
        return self.allowed.unit

    @property
    def limits(self) -> str:
        """Allowed range as text; empty without one."""
        return str(self.allowed)


@dataclass(frozen=True, slots=True)
class FormGroup:
    """Fields that belong together, as those of a step: their name with a description, and their values as text."""

    name: str
    """Kind of a step, table of a settings file."""
    about: str
    fields: tuple[FormField, ...]
    values: Mapping[str, str]

    def parsed(self, texts: Mapping[str, str]) -> dict[str, object]:
        """Return the values that texts state by key, without empty ones; raises `SettingsError` as `parse_field`."""
        values = {field.key: parse_field(field, texts.get(field.key, "").strip(), self.name) for field in self.fields}
        return {key: value for key, value in values.items() if value is not None}


FieldPlace: TypeAlias = tuple[int, str]
"""Number of a group, from 0, and the key of one of its fields."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Form:
    """Groups of fields."""

    groups: tuple[FormGroup, ...] = ()

    def values(self) -> list[dict[str, str]]:
        """Return the values of every group as text; a value left out has its default."""
        return [
            {field.key: group.values.get(field.key, field.default) for field in group.fields} for group in self.groups
        ]

    def misread(self, values: Sequence[Mapping[str, str]]) -> "dict[FieldPlace, str]":
        """Return the faults of texts that are no values of their fields at all, by group and key."""
        problems: dict[FieldPlace, str] = {}
        for number, (group, texts) in enumerate(zip(self.groups, values, strict=True)):
            for field in group.fields:
                try:
                    parse_field(field, texts.get(field.key, "").strip(), group.name)
                except config.SettingsError as error:
                    problems[number, field.key] = str(error).split(": ", 1)[-1]
        return problems

    def field_name(self, place: "FieldPlace") -> str:
        """Return the label of a field, without its unit."""
        number, key = place
        return next(field.name for field in self.groups[number].fields if field.key == key).capitalize()


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanForm(Form):
    """A plan as a form, whose groups are its steps."""

    plan: config.Plan
    source: str

    def place_of(self, sentence: str, step: int | None = None) -> "FieldPlace | None":
        """Return step and key of the field that an error is about: the first that it names; None where it names none.

        Parameters
        ----------
        step
            The step, where the sentence does not say.
        """
        named = re.search(r"steps\[(\d+)\]", sentence)
        number = int(named[1]) if named else step
        if number is None:
            number = 0 if len(self.groups) == 1 else None
        if number is None or number >= len(self.groups):
            return None
        key = first_key_named(self.groups[number], sentence)
        return None if key is None else (number, key)

    def filled(self, values: Sequence[Mapping[str, str]]) -> config.Plan:
        """Return the plan with these values in its steps.

        Raises
        ------
        PlanError, SettingsError
            For an invalid value.
        """
        steps = [{"kind": step.name, **step.parsed(texts)} for step, texts in zip(self.groups, values, strict=True)]
        data = self.plan.model_dump(mode="json", exclude_unset=True)
        return config.parse(config.Plan, {**data, "steps": steps}, self.plan.name)


def known_plans(lab: Path | None = None) -> dict[str, str]:
    """Return descriptions of plans, or their mistakes, by file or shipped name: the lab's, then other shipped ones."""
    own = {} if lab is None else config.lab_plans(lab)
    shipped = [name for name in config.shipped_files("plan") if name not in own]
    return {name: _description(name) for name in (*map(str, own.values()), *shipped)}


def _description(plan: str) -> str:
    """Return a plan's description, or its mistake."""
    try:
        return str(config.find_table("plan", plan)[0].get("description", ""))
    except config.SettingsError as error:
        return str(error)


def plan_form(name_or_path: str) -> PlanForm:
    """Return a plan's form; raises `SettingsError` or `PlanError` when there is no such plan, or it is invalid."""
    data, source = config.find_table("plan", name_or_path)
    return form_from_plan(config.parse(config.Plan, data, source), source)


def form_from_plan(plan: config.Plan, source: str) -> PlanForm:
    """Return the form of a plan in memory; raises `PlanError`."""
    beside = Path(source).absolute().parent if Path(source).is_file() else None
    steps = tuple(_step_form(step, f"{source}: steps[{index}]", beside) for index, step in enumerate(plan.steps))
    return PlanForm(plan=plan, source=source, groups=steps)


def first_key_named(group: FormGroup, sentence: str) -> str | None:
    """Return the first key of a group that a sentence names; None where it names none."""
    found = {field.key: re.search(rf"\b{field.key}\b", sentence) for field in group.fields}
    starts = {key: match.start() for key, match in found.items() if match is not None}
    return min(starts, key=starts.__getitem__) if starts else None


def _step_form(step: config.PlanStep, where: str, beside: Path | None) -> FormGroup:
    protocol = protocol_kinds().get(step.kind)
    if protocol is None:
        raise config.PlanError(f"{where}: kind = {step.kind!r} is not a kind of run.")
    fields = (*form_fields(protocol, sweeps=True), *form_fields(config.PlanStep, sweeps=False))
    values = {field.key: value_text(step.parameters[field.key]) for field in fields if field.key in step.parameters}
    own = step.model_dump(mode="json", exclude_unset=True)
    values |= {key: value_text(value) for key, value in own.items() if key not in _HIDDEN_KEYS and value is not None}
    if beside is not None and (beside / step.capsule).is_file():
        values["capsule"] = str(beside / step.capsule)
    return FormGroup(step.kind, (protocol.__doc__ or "").strip().splitlines()[0], fields, values)


@cache
def form_fields(model: type[config.Settings], *, sweeps: bool) -> tuple[FormField, ...]:
    """Return the fields of a settings class from its schema, without its inner groups.

    Parameters
    ----------
    sweeps
        Whether several numbers, separated by commas, make a run of each.
    """
    schema = model.model_json_schema()
    properties, shared = schema["properties"], schema.get("$defs", {})
    kinds = {key: field.annotation for key, field in model.model_fields.items()}
    groups = {key for key, kind in kinds.items() if isinstance(kind, type) and issubclass(kind, config.Settings)}
    order = [key for key in properties if key not in _HIDDEN_KEYS | groups]
    if issubclass(model, RunProtocol):
        order.sort(key=lambda key: key in RunProtocol.model_fields)
    required, about = frozenset(schema.get("required", ())), config.field_descriptions(model)
    return tuple(
        _form_field(
            key, _resolved_schema(properties[key], shared), about.get(key, ""), sweeps=sweeps, required=key in required
        )
        for key in order
    )


def _resolved_schema(entry: Mapping[str, object], shared: Mapping[str, object]) -> dict[str, object]:
    """Resolve a reference, and the type other than null of an optional value."""
    resolved = dict(entry)
    options = resolved.get("anyOf")
    if isinstance(options, list):
        resolved |= next(option for option in options if option.get("type") != "null")
    reference = resolved.get("$ref")
    target = shared.get(reference.rsplit("/", 1)[-1]) if isinstance(reference, str) else None
    return {**target, **resolved} if isinstance(target, Mapping) else resolved


def _form_field(key: str, entry: Mapping[str, object], description: str, *, sweeps: bool, required: bool) -> FormField:
    stem, unit = next(
        ((key.removesuffix(end), unit) for end, unit in UNIT_SUFFIXES.items() if key.endswith(end)), (key, "")
    )
    if key in _VOLT_KEYS:
        stem, unit = key.removesuffix("_V"), "V"
    choices = entry.get("enum")
    kinds_of = {"number": FieldKind.NUMBER, "integer": FieldKind.NUMBER, "boolean": FieldKind.SWITCH,
                "array": FieldKind.LIST}  # fmt: skip
    kind = FieldKind.CHOICE if isinstance(choices, list) else kinds_of.get(str(entry.get("type")), FieldKind.TEXT)
    default = entry.get("default")
    return FormField(
        key=key,
        name=_FIELD_LABELS.get(stem, stem).replace("accel", "acceleration").replace("_", " "),
        help=description,
        kind=kind,
        allowed=_range(entry, unit),
        default="" if default is None else value_text(default),
        choices=tuple(choices) if isinstance(choices, list) else (),
        sweeps=sweeps and kind is FieldKind.NUMBER,
        required=required,
    )


def _range(entry: Mapping[str, object], unit: str) -> config.NumberRange:
    low, above, high = (entry.get(bound) for bound in ("minimum", "exclusiveMinimum", "maximum"))
    lowest = above if isinstance(above, int | float) else low
    return config.NumberRange(
        unit,
        float(lowest) if isinstance(lowest, int | float) else -inf,
        float(high) if isinstance(high, int | float) else inf,
        above_lowest=isinstance(above, int | float),
        whole=entry.get("type") == "integer",
    )


def value_text(value: object) -> str:
    """Return a value as a form has it; a list of tables in TOML."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return config.number_text(value)
    if isinstance(value, list | tuple) and all(isinstance(item, float | int) for item in value):
        return ", ".join(map(value_text, value))

    def toml(item: object) -> str:
        return json.dumps(item, ensure_ascii=False) if isinstance(item, str | bool) else value_text(item)

    if isinstance(value, list | tuple):
        return ",\n".join("{" + ", ".join(f"{key} = {toml(item)}" for key, item in row.items()) + "}" for row in value)
    return str(value)


def parse_field(field: FormField, text: str, group: str) -> object:
    """Return the value of a field's text, None for none; raises `SettingsError` for a text that is no value."""
    if not text:
        return None
    match field.kind:
        case FieldKind.SWITCH:
            return text == "yes"
        case FieldKind.LIST:
            tables = config.parse_value(f"[{' '.join(text.splitlines())}]")
            if isinstance(tables, str):
                example = "{key = 12.5, …} with commas between, and decimals with a point"
                raise config.SettingsError(f"{group}, {field.name}: cannot be read; write {example}.")
            return tables
        case FieldKind.NUMBER | FieldKind.NUMBERS:
            return _parse_number(field, text, group)
        case FieldKind.CHOICE:
            return next((choice for choice in field.choices if str(choice) == text), text)
        case _:
            return text


def _parse_number(field: FormField, text: str, group: str) -> float | list[float]:
    try:
        if field.kind is FieldKind.NUMBER and not field.sweeps:
            return config.read_number(text, field.allowed)
        numbers = list(config.read_numbers(text, field.allowed))
    except config.SettingsError as error:
        raise config.SettingsError(f"{group}, {field.name}: {error}") from None
    return numbers if field.kind is FieldKind.NUMBERS or len(numbers) > 1 else numbers[0]


_POINTS_PER_SEGMENT = 24


@dataclass(frozen=True, slots=True)
class SessionPreview:
    """A checked plan and the stage's limits."""

    preflight: Preflight
    lowest_mm: float
    highest_mm: float
    conditions: str = ""
    """Capsule, fixture and order of each step, in one sentence."""


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
    lowest_mm: float
    highest_mm: float
    """`lowest_mm`, `highest_mm`: the stage's limits, absolute."""
    max_speed_mm_s: float
    max_accel_mm_s2: float
    data_root: str


@dataclass(frozen=True, slots=True, eq=False)
class CampaignToExtend:
    """A campaign that runs are to be added to, as it was when it was read."""

    latest: SessionRecord
    """Its latest session."""
    before: Campaign
    """Its runs."""
    running: bool = False
    """Whether that session is still under way."""

    @property
    def summary(self) -> str:
        """Number of runs, specimens, and when the last run ended, in a line."""
        runs = self.before.runs
        if not runs:
            return "no runs yet"
        specimens = ", ".join(sorted({specimen_key(run) for run in runs}))
        ended = max(run.end_time or run.header.start_time for run in runs)
        return f"{count_text(len(runs), 'run')}, specimen {specimens}, until {ended.astimezone():%Y-%m-%d %H:%M}"


def campaign_to_extend(folder: Path) -> CampaignToExtend:
    """Read a campaign that runs are to be added to; raises `RunFileError`, `SettingsError` where there is none."""
    from dragrig.session_state import is_session_running

    latest, _ = latest_session_record(folder)
    return CampaignToExtend(latest, read_campaign(folder), is_session_running(folder))


def last_heard(folder: Path) -> str:
    """Return when and at which run a session that was cut off was last heard of, by the state file in its campaign."""
    from dragrig.session_state import is_session_running, read_state

    state = read_state(folder)
    if state is None:
        return "before its first run"
    run = f"at run {state.order}, {state.run}" if state.run else "before its first run"
    running = "; it runs in another window, or is just being ended" if is_session_running(folder) else ""
    made = f", {state.made} of {state.runs} in all" if state.made else ""
    return f"at {state.since.astimezone():%Y-%m-%d %H:%M}, {run}{made}{running}"


def preview_session(
    plan: config.Plan | str, rig: RigSelection, specimen: Sequence[str] = (), campaign: CampaignToExtend | None = None
) -> SessionPreview:
    """Check a plan without moving anything.

    Parameters
    ----------
    specimen
        The stated facts of the specimen, as assignments.
    campaign
        The campaign that the runs are added to (default: a campaign of their own).

    Raises
    ------
    SettingsError, PlanError, OutputError
        For invalid settings, and such as do not suit the campaign.
    """
    choices = replace(rig, assignments=(*rig.assignments, *specimen)).choices()
    steps = plan.steps if isinstance(plan, config.Plan) else plan_form(plan).plan.steps
    if campaign is None:
        stage = resolve_rig(**rig.choices()).rig.stage
        checked = check(plan, **choices)
        return SessionPreview(checked, stage.lowest_mm, stage.highest_mm, _conditions(checked, steps))
    from dragrig.campaign_session import setup_to_append

    try:
        setup, remarks = setup_to_append(plan, campaign.latest, campaign.before, running=campaign.running, **choices)
    except config.SettingsError as error:
        raise config.SettingsError(_in_words_of_the_form(str(error))) from error
    folder, stage = campaign.before.folder, setup.rig.stage
    checked = check_setup(setup, folder)
    checked = replace(checked, remarks=(*map(_in_words_of_the_form, remarks), *checked.remarks))
    conditions = f"Added to {folder.name}; {_conditions(checked, steps)}"
    return SessionPreview(checked, stage.lowest_mm, stage.highest_mm, conditions)


def _in_words_of_the_form(sentence: str) -> str:
    """Return a sentence about a specimen's id with the place in the form, instead of the option of the command."""
    return sentence.replace("--set specimen.id=P8", "P8 under Specimen").replace(
        "--set specimen.id=…", "an id under Specimen"
    )


def _conditions(checked: Preflight, steps: Sequence[config.PlanStep]) -> str:
    """Say the facts that no curve shows: capsule, fixture and order of each step."""
    parts = []
    for number, step in enumerate(steps):
        runs = [preview.run for preview in checked.previews if preview.run.step == number]
        capsules = ", ".join(dict.fromkeys(run.capsule.name for run in runs))
        fixtures = ", ".join(dict.fromkeys(run.fixture.value for run in runs))
        where = f"Step {number + 1}: " if len(steps) > 1 else ""
        parts.append(f"{where}capsule {capsules}, fixture {fixtures}, order {step.order.value.replace('_', ' ')}")
    return "; ".join(parts) + "."


def describe_rig(rig: RigSelection) -> RigDescription:
    """Describe the rig in use; raises `SettingsError`, also for a pace it does not support."""
    setup = resolve_rig(**rig.choices())
    resolve_pace(rig.pace, double=setup.double)
    simulated = setup.backend == "simulated"
    if simulated:
        title, meaning = "SIMULATED", "no hardware: everything you see is simulated"
    elif setup.double:
        title, meaning = "DOUBLE", "no hardware: card and drive are simulated (doubles)"
    else:
        title, meaning = "HARDWARE", "the real stage moves"
    return RigDescription(
        name=setup.rig.name,
        backend=setup.backend,
        title=title,
        meaning=meaning,
        real=not (simulated or setup.double),
        force_limit_mN=setup.rig.guard.force_limit_mN,
        lowest_mm=setup.rig.stage.lowest_mm,
        highest_mm=setup.rig.stage.highest_mm,
        max_speed_mm_s=setup.rig.stage.max_speed_mm_s,
        max_accel_mm_s2=setup.rig.stage.max_accel_mm_s2,
        data_root=str(setup.data_root),
    )


FormT = TypeVar("FormT", bound=Form)
RIG_LIMIT = "the rig's limit"


def within_rig(form: FormT, rig: RigDescription) -> FormT:
    """Return a form whose speeds and accelerations are refused beyond the limits of the rig."""
    most = {"speed_mm_s": rig.max_speed_mm_s, "accel_mm_s2": rig.max_accel_mm_s2}

    def limited(field: FormField) -> FormField:
        limit = next((limit for end, limit in most.items() if field.key.endswith(end)), inf)
        return replace(field, allowed=field.allowed.within(-inf, limit, RIG_LIMIT))

    groups = tuple(replace(group, fields=tuple(map(limited, group.fields))) for group in form.groups)
    return replace(form, groups=groups)


FORMATS: Mapping[str, ExportFormatName] = {
    "CSV": "csv", "Parquet": "parquet", "MATLAB": "mat", "NumPy": "npz", "LabVIEW TDMS": "tdms",
}  # fmt: skip
"""Export formats by name."""
_MAX_DEPTH = 3


@dataclass(frozen=True, slots=True)
class ShownRun:
    """A run file in the browser, with all its settings."""

    path: Path
    order: int
    label: str
    status: str
    bad: str
    note: str
    start: str
    settings: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class ShownCampaign:
    """A folder of run files; `problems` lists the files that cannot be read.

    `recordings` are being made, or were left by a crash.
    """

    folder: Path
    runs: tuple[ShownRun, ...]
    problems: tuple[str, ...]
    recordings: tuple[Path, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class ShownTrace:
    """A run's trace at even times, NaN for lost samples; arrays of shape `(N,)`."""

    path: Path
    label: str
    rate_hz: float
    start_s: float
    run: Run
    """What is shown, as recorded."""
    even: tuple[npt.NDArray[np.intp], int] | None
    """Each sample's index on the even time axis, and the length of that; None where no sample is lost."""
    channels: Mapping[str, npt.NDArray[np.float32]]
    filtered: Mapping[str, npt.NDArray[np.float32]]
    units: Mapping[str, str]
    limits_mm: tuple[float, float] | None = None
    """The stage's limits when the run was made, absolute as its positions; None where they are not known."""

    def along(self, axis: str) -> npt.NDArray[np.float32] | None:
        """Return position or speed at each sample; None where the run has none."""
        return self.filtered.get(axis, self.channels.get(axis))


@dataclass(frozen=True, slots=True)
class ListedCampaign:
    """A folder with run files in a list: what is in it, and which of its runs were asked for, None for all."""

    folder: Path
    about: str
    found: frozenset[str] | None = None


def campaigns_below(folder: Path, words: str = "") -> tuple[ListedCampaign, ...]:
    """Return this folder and those below that hold run files, in descending order of name.

    `words` ask for some runs, as options of `dragrig find` do: a kind, a specimen, an operator, a day, bad or good.
    """
    if not folder.is_dir():
        return ()

    def listed(listing: RunListing) -> tuple[ListedCampaign, ...]:
        summaries = {summary.folder: summary for summary in listing.summaries()}
        found = listing.found(query_of_words(words, listing.kinds(), summaries.values())) if words.strip() else None
        return tuple(
            ListedCampaign(
                path,
                str(summaries.get(path, "")),
                None if found is None else frozenset(found[path]),
            )
            for path in reversed(listing.folders(with_files=True))
            if len(path.relative_to(folder).parts) < _MAX_DEPTH and (found is None or path in found)
        )

    return ask_runs(folder, listed)


def query_of_words(words: str, kinds: Iterable[str], campaigns: Iterable[CampaignSummary]) -> RunQuery:
    """Return which runs are asked for by words in any order; any further word is part of an operator's name."""
    specimens = {name.casefold() for campaign in campaigns for name in campaign.specimens}
    known, marks = {kind.casefold() for kind in kinds}, {"bad": True, "good": False}
    asked: dict[str, str] = {"specimen": "", "kind": "", "operator": "", "since": ""}
    marked: bool | None = None
    for word in words.casefold().split():
        if word in marks:
            marked = marks[word]
        elif re.fullmatch(r"\d{4}-\d\d-\d\d", word):
            asked["since"] = word
        else:
            key = "kind" if word in known else "specimen" if word in specimens else "operator"
            asked[key] = f"{asked[key]} {word}".strip()
    return run_query(**asked, until=asked["since"], bad=marked)


def shown_campaign(folder: Path) -> ShownCampaign:
    """Read the runs' settings of a campaign; raises `RunFileError`."""
    campaign = ask_runs(folder, lambda listing: listing.campaign())
    runs = tuple(
        _shown_run(info, bad.reason if (bad := campaign.marks.get(info.path)) else "") for info in campaign.runs
    )
    problems = tuple(str(error) for _, error in campaign.unreadable)
    return ShownCampaign(folder, runs, problems, campaign.recordings)


def recover_runs(folders: Sequence[Path]) -> tuple[str, ...]:
    """Finish the recordings that a crash left in these folders, as `dragrig recover` does; return why some were not.

    Raises `RunFileError`.
    """
    recordings = (recording for folder in folders for recording in recover(folder))
    return tuple(recording.message for recording in recordings if recording.message)


def shown_trace(path: Path, window_s: float | None = None, order: int | None = None) -> ShownTrace:
    """Read a run's trace and filter it; raises `RunFileError`, and `AnalysisError` for an impossible filter."""
    info = read_info(path)
    run = read_run(path, info)
    even = _even_grid(run)
    shown = ShownTrace(
        path=path,
        label=_run_label(info),
        rate_hz=run.trace.sample_rate_hz,
        start_s=float(run.trace.time[0]) if len(run.trace.time) else 0.0,
        run=run,
        even=even,
        channels=_shown_channels(run.trace.channels, even, start_position_mm(info)),
        filtered={},
        units=run.trace.units,
        limits_mm=_limits_mm(path),
    )
    return filtered_anew(shown, window_s, order)


def filtered_anew(
    shown: ShownTrace, window_s: float | None = None, order: int | None = None, force: str | None = None
) -> ShownTrace:
    """Filter a trace in another way, all forces or one, without reading its file.

    Raises `AnalysisError` for an impossible filter.
    """
    settings = filter_settings(shown.rate_hz, window_s, None, order, 0)
    smooth = filter_run(shown.run, settings, None if force is None else (force,), for_display=True).trace
    return replace(
        shown,
        filtered=_shown_channels(smooth.channels, shown.even, start_position_mm(shown.run.info)),
        units={**shown.run.trace.units, **smooth.units},
    )


def _limits_mm(path: Path) -> tuple[float, float] | None:
    # An imported run has no session, and that of an old one may not be readable any more.
    with suppress(config.RunFileError, config.SettingsError):
        stage = session_record_of_run(path).rig.stage
        return stage.lowest_mm, stage.highest_mm
    return None


def _shown_channels(
    channels: Mapping[str, AnyFloatArray], even: tuple[npt.NDArray[np.intp], int] | None, origin_mm: float
) -> dict[str, npt.NDArray[np.float32]]:
    """Return channels at even times, the position absolute as everywhere that a person reads it."""
    shown = {name: _on_even_grid(values, even) for name, values in channels.items()}
    if "position" in shown:
        shown["position"] = shown["position"] + np.float32(origin_mm)
    return shown


def steady_rows(paths: Sequence[Path]) -> tuple[TableRow, ...]:
    """Measure runs; an unreadable file has a row with the error."""

    def measured(path: Path) -> TableRow:
        try:
            bad = read_mark(path)
            return table_row(read_run(path), bad.reason if bad else None)
        except config.RunFileError as error:
            return unreadable_row(path, error)

    return tuple(map(measured, paths))


def _shown_run(info: RunInfo, bad: str) -> ShownRun:
    header, note = info.header, read_note(info.path)
    settings = {"noted": note, "file": info.path.name, "status": info.status.value, "reason": info.reason,
                "backend": header.backend, "samples": str(info.samples),
                "rate": f"{header.sample_rate_hz:g} Hz"}  # fmt: skip
    for group in (header.protocol, header.capsule, header.specimen, header.entry, info.checks):
        settings |= attribute_texts(group)
    start = f"{header.start_time:%Y-%m-%d %H:%M:%S}"
    return ShownRun(info.path, header.order, _run_label(info), info.status.value, bad, note, start, settings)


def _run_label(info: RunInfo) -> str:
    protocol = info.header.protocol
    speed, strain = protocol.get("speed_mm_s"), protocol.get("shear_strain")
    value = f" {speed:g} mm/s" if isinstance(speed, int | float) else ""
    value = f" {100 * strain:g} %" if isinstance(strain, int | float) else value
    return f"{info.header.order}  {info.kind}{value}"


def _even_grid(run: Run) -> tuple[npt.NDArray[np.intp], int] | None:
    time, rate = run.trace.time, run.trace.sample_rate_hz
    if len(time) == 0 or len(gap_starts(time, rate)) == 0:
        return None
    indices = np.maximum.accumulate(np.rint((time - time[0]) * rate).astype(np.intp))
    return indices, int(indices[-1]) + 1


def _on_even_grid(values: AnyFloatArray, even: tuple[npt.NDArray[np.intp], int] | None) -> npt.NDArray[np.float32]:
    if even is None:
        return np.asarray(values, dtype=np.float32)
    indices, length = even
    on_grid = np.full(length, np.nan, np.float32)
    on_grid[indices] = values
    return on_grid


class CampaignWork(StrEnum):
    """The products of a campaign, each made in a process of its own."""

    DIAGNOSE = "diagnose"
    IDENTIFY = "identify"
    REPORT = "report"
    SETTLE = "settle"


@dataclass(frozen=True, slots=True)
class DiagnosisTask:
    """A campaign and its nominal model, as of `dragrig gap diagnose`, `dragrig identify` or `dragrig report`."""

    campaign: str
    nominal: str = "capsule"
    work: CampaignWork = CampaignWork.DIAGNOSE
    minutes: float | None = None
    """To settle: rig time of further runs; None goes on after a batch, with the time that is left."""
    mirror: Path | None = None
    """To settle: folder for a second copy of the decisions."""


@dataclass(frozen=True, slots=True)
class DiagnosisProgress:
    """How much is done, and of how much."""

    done: int
    total: int


@dataclass(frozen=True, slots=True, eq=False)
class CompletedDiagnosis:
    """A diagnosis and its document, whose figures are drawn; runs before and after are left to the window."""

    diagnosis: Diagnosis
    document: Document


@dataclass(frozen=True, slots=True, eq=False)
class CompletedIdentification:
    """An identification as a document whose figures are drawn, and the files written: model and pictures."""

    document: Document
    files: tuple[Path, ...]


@dataclass(frozen=True, slots=True)
class FurtherRuns:
    """Runs that settle a campaign's gap, and why."""

    folder: Path
    plan: config.Plan
    minutes: float
    """Rig time."""
    count: int
    reason: str
    resumes: bool
    """Whether they have begun, and the missing ones are to be made."""


@dataclass(frozen=True, slots=True, eq=False)
class CompletedSettleStep:
    """The decision about a campaign: the runs to make next, or why there are none.

    The diagnosis is None where runs that were decided on before are missing.
    """

    completed: CompletedDiagnosis | None
    record: SettleRecord
    sentence: str
    runs: FurtherRuns | None
    problems: tuple[str, ...] = ()
    """What could not be copied to the mirror."""


@dataclass(frozen=True, slots=True)
class CompletedReport:
    """A report that was written."""

    path: Path


@dataclass(frozen=True, slots=True)
class DiagnosisFailed:
    """Why there is no result."""

    sentence: str


DiagnosisEvent: TypeAlias = (
    DiagnosisProgress
    | CompletedDiagnosis
    | CompletedIdentification
    | CompletedReport
    | CompletedSettleStep
    | DiagnosisFailed
)


class DiagnosisProcess:
    """A running diagnosis, identification or report; belongs to one thread, which it never blocks."""

    def __init__(self, task: DiagnosisTask) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, child_end = context.Pipe(duplex=False)
        self._over = False
        arguments = (child_end, task)
        self._process = context.Process(target=_run_diagnosis, args=arguments, name="dragrig-diagnosis", daemon=True)
        self._process.start()
        child_end.close()

    def events(self) -> Iterator[DiagnosisEvent]:
        """Yield new events; the last is a result or a failure."""
        try:
            while not self._over and self._connection.poll(0):
                event: DiagnosisEvent = self._connection.recv()
                self._over = not isinstance(event, DiagnosisProgress)
                yield event
        except (EOFError, OSError):
            self._over = True
            self._process.join(1.0)
            yield DiagnosisFailed(f"the work ended unexpectedly (exit code {self._process.exitcode}); try again")

    def cancel(self) -> None:
        """Kill the process, which reads files, and writes its products whole and at its end."""
        self._over = True
        self._process.terminate()
        self._process.join(5.0)
        self._connection.close()


def completed(diagnosis: Diagnosis, source: str = "") -> CompletedDiagnosis:
    """Draw the figures of a diagnosis, which takes matplotlib, here and not in the window's process."""
    from dragrig.present import diagnosis_document

    document = diagnosis_document(diagnosis, source=source).without("before-after")
    return CompletedDiagnosis(diagnosis, drawn(document))


def _identified(task: DiagnosisTask, progress: Progress) -> CompletedIdentification:
    """Identify a campaign and write model and pictures, as `dragrig identify` does."""
    from dragrig.api import identified_folder, identify, write_identified_files
    from dragrig.present import identification_document

    identified = identify(task.campaign, nominal=task.nominal, progress=progress)
    result = identified.result
    folder, why_not = identified_folder(Path(task.campaign)), identified.why_no_model
    files = write_identified_files(identified, folder, with_model=why_not is None, overwrite=False)
    document = identification_document(result)
    lead = (*document.lead, f"Written to {folder}: {', '.join(path.name for path in files)}.")
    return CompletedIdentification(drawn(replace(document, problem=why_not or "", lead=lead)), files)


def _reported(task: DiagnosisTask, progress: Progress) -> CompletedReport:
    """Write the report on a campaign beside those written before."""
    from dragrig.api import default_report_file, report

    target = unused_path(default_report_file(Path(task.campaign)), ".html")
    return CompletedReport(report(task.campaign, target, progress=progress))


def _diagnosed(task: DiagnosisTask, progress: Progress) -> CompletedDiagnosis:
    from dragrig.api import gap_diagnose

    return completed(gap_diagnose(task.campaign, nominal=task.nominal, progress=progress), task.campaign)


def _settled_step(task: DiagnosisTask, progress: Progress) -> CompletedSettleStep:
    """Decide on the next runs as `dragrig gap settle` does, and write it into the campaign."""
    from dragrig.api import (
        after_diagnosis,
        has_begun,
        lacks_runs,
        mirrored_decisions,
        read_settle_record,
        settle_request,
        take_up_settling,
    )
    from dragrig.present import settlement_document, step_sentence

    folder, shown = Path(task.campaign).absolute(), None
    record = read_settle_record(folder) if task.minutes is None else take_up_settling(folder, task.minutes)
    if not lacks_runs(folder, record):
        result = settle_request(folder, record, task.nominal).diagnose(folder, progress).result
        record = after_diagnosis(folder, record, result)
        document = settlement_document(record, result, source=task.campaign).without("before-after")
        shown = CompletedDiagnosis(result, drawn(document))
    problems: list[str] = []
    with mirrored_decisions(folder, task.mirror, problems.append) as write:
        write(record)
    batch, over = record.batches[-1], len(record.steps) == len(record.batches)
    begun = not over and has_begun(folder, record)
    runs = FurtherRuns(folder, batch.plan, batch.minutes, len(batch.runs), batch.reason, begun)
    return CompletedSettleStep(shown, record, step_sentence(record), None if over else runs, tuple(problems))


_WORK: Mapping[
    CampaignWork,
    Callable[
        [DiagnosisTask, Progress], CompletedDiagnosis | CompletedIdentification | CompletedReport | CompletedSettleStep
    ],
] = {
    CampaignWork.DIAGNOSE: _diagnosed,
    CampaignWork.IDENTIFY: _identified,
    CampaignWork.REPORT: _reported,
    CampaignWork.SETTLE: _settled_step,
}


def _run_diagnosis(connection: "Connection[DiagnosisEvent, object]", task: DiagnosisTask) -> None:
    def progress(done: int, total: int) -> None:
        connection.send(DiagnosisProgress(done, total))

    # Ctrl-C in the terminal goes to the window too, which then cancels this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The connection is closed once the window is gone.
    with suppress(OSError):
        try:
            connection.send(_WORK[task.work](task, progress))
        except config.DragrigError as error:
            connection.send(DiagnosisFailed(str(error)))
