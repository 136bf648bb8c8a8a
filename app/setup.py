"""The setup of a session: backend, pace, rig, plan, specimen, model, found by name or file and changed by --set."""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import cache
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from inspect import getattr_static
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypedDict, TypeGuard, TypeVar, Unpack

import numpy as np
import tomli_w

from dragrig.config import (
    CALIBRATION_FILE,
    NOTIFICATION_FILE,
    RIG_FILE,
    UNSTATED,
    Calibration,
    CommissioningRecord,
    DeviceError,
    DragrigError,
    EffectSettings,
    FrictionModelSettings,
    NotificationSettings,
    OutputError,
    Plan,
    PlanError,
    PlanStep,
    RigSettings,
    Settings,
    SettingsError,
    Specimen,
    Table,
    field_descriptions,
    find_settings,
    find_table,
    merge_tables,
    nested_table,
    parse,
    parse_assignment,
    parse_effects,
    refuse_unknown,
    rig_file_of,
    suggestion,
)
from dragrig.end_signals import rig_open
from dragrig.rig import (
    Backend,
    BackendRequest,
    Programme,
    RigMemory,
    RunProtocol,
    StageLimits,
    Stops,
    assess_stops,
    build_programme,
    latest_calibration,
    protocol_kinds,
    read_commissioning,
    read_contact,
    stage_limits,
    wiring_key,
)

if TYPE_CHECKING:
    from dragrig.rig import SessionRecord

Pace = Literal["fast", "real"] | float
"""As fast as possible, as fast as a real rig, or this many times faster; the last for doubles only."""
_MAX_TIMES_FASTER = 1000.0


@dataclass(frozen=True, slots=True)
class Pacing:
    """Whether a simulated clock runs in real time, and how many times faster a double runs."""

    real_time: bool
    times_faster: float = 1.0


def resolve_pace(pace: Pace | None, *, double: bool) -> Pacing:
    """Return the pacing of a rig; by default a simulated rig is fast and a double real.

    Raises
    ------
    SettingsError
        For a pace that this kind of rig does not have.
    """
    if not double:
        if pace not in {None, "fast", "real"}:
            raise SettingsError(f"pace {pace}: choose fast or real here; only a double runs a number of times faster.")
        return Pacing(real_time=pace == "real")
    times_faster = 1.0 if pace is None or pace == "real" else pace
    if isinstance(times_faster, str) or not 0 < times_faster <= _MAX_TIMES_FASTER:
        raise SettingsError(
            f"pace {pace}: that of a double is real, or a number of times faster, as 20, up to {_MAX_TIMES_FASTER:g}."
        )
    return Pacing(real_time=True, times_faster=float(times_faster))


BACKEND_GROUP = "dragrig.backends"
DOUBLE_GROUP = "dragrig.doubles"


def backend_names() -> tuple[str, ...]:
    """Return the names of all installed backends."""
    return tuple(sorted(_installed(BACKEND_GROUP, tuple(sys.path)).names))


def find_backend(name: str, *, double: bool = False) -> EntryPoint:
    """Return the entry point of a backend, or of its double, without loading it.

    Raises
    ------
    SettingsError
        For an unknown backend, or one without a double.
    """
    for entry in _installed(DOUBLE_GROUP if double else BACKEND_GROUP, tuple(sys.path)).select(name=name):
        return entry
    if double and name in backend_names():
        raise SettingsError(
            f"backend = {name!r}: has no double; choose none, or a backend that has one: "
            f"{', '.join(sorted(_installed(DOUBLE_GROUP, tuple(sys.path)).names))}."
        )
    raise SettingsError(f"backend = {name!r}: no such backend is installed; {suggestion(name, backend_names())}")


def open_backend(name: str, request: BackendRequest, *, double: bool = False) -> Backend:
    """Load a backend, or its double, and open its devices.

    Raises
    ------
    SettingsError
        For an unknown backend.
    DeviceError
        When it cannot be loaded, or returns no backend.
    """
    return _load_backend(name, double=double)(request)


@contextmanager
def opened_rig(name: str, request: BackendRequest, *, double: bool = False) -> Iterator[Backend]:
    """Open a rig, and close it whatever happens: no signal breaks off either. Raises as `open_backend`."""
    # It takes seconds, nothing is open yet, and Ctrl-C may break it off.
    open_devices = _load_backend(name, double=double)
    with rig_open(), closing(open_devices(request)) as backend:
        yield backend


def _load_backend(name: str, *, double: bool) -> Callable[[BackendRequest], Backend]:
    entry = find_backend(name, double=double)

    @contextmanager
    def explained() -> Iterator[None]:
        try:
            yield
        except DragrigError:
            raise
        except Exception as error:  # an add-on's own code can fail in any way
            raise DeviceError(
                f"backend {name} ({entry.value}) cannot be opened ({type(error).__name__}: {error}); is it installed "
                "completely?"
            ) from error

    with explained():
        factory: Callable[[BackendRequest], object] = entry.load()

    def open_devices(request: BackendRequest) -> Backend:
        with explained():
            backend = factory(request)
        if not _is_backend(backend):
            kind = type(backend).__name__
            raise DeviceError(f"backend {name} ({entry.value}) returns a {kind}, which is no backend.")
        return backend

    return open_devices


def _is_backend(candidate: object) -> TypeGuard[Backend]:
    # Not isinstance, which in Python 3.11 evaluates the properties of a rig that is not connected yet.
    members = [name for name in vars(Backend) if not name.startswith("_")]
    return all(getattr_static(candidate, name, None) is not None for name in members)


@cache
def _installed(group: str, _search_path: tuple[str, ...]) -> EntryPoints:
    """Look through the installed packages once for a search path: it takes a tenth of a short session's time."""
    return entry_points(group=group)


SettingsT = TypeVar("SettingsT", bound=Settings)

DEFAULT_SETTINGS: Mapping[str, str] = {"rig": "bench", "specimen": "jejunum", "model": "paper"}
SIMULATED_BACKEND = "simulated"
HARDWARE_BACKEND = "hardware"
"""The backend of the real rig, to which no effects can be added."""
CALIBRATED_QUANTITIES = ("force", "encoder")


AssignmentsLike = Sequence[str] | Mapping[str, object]
"""Changes of settings: `["speed_mm_s=5", "rig.stage.highest_mm=120"]`, or `{"speed_mm_s": 5}`."""


class RigChoices(TypedDict, total=False):
    """The keyword arguments of `resolve_rig`; None means the default."""

    rig: str | Path | None
    model: str | Path | FrictionModelSettings | None
    backend: str | None
    double: bool
    assignments: AssignmentsLike
    memory: RigMemory


def with_allowed_effects(
    model: FrictionModelSettings, effects: Sequence[str | EffectSettings], *, backend: str, double: bool
) -> FrictionModelSettings:
    """Return the model with further effects, checked for this rig.

    Raises
    ------
    SettingsError
        For invalid effects, and for effects on a rig that is not simulated.
    """
    if backend == HARDWARE_BACKEND and (effects or (double and model.effects)):
        where = "its double" if double else "the rig itself"
        raise SettingsError(
            f"effects act in the simulated rig, and backend {backend} is {where}; leave them out, or choose the "
            "backend simulated."
        )
    return with_effects(model, effects)


def with_effects(model: FrictionModelSettings, effects: Sequence[str | EffectSettings]) -> FrictionModelSettings:
    """Return the model with further effects; raises `SettingsError` for invalid effects."""
    further = parse_effects(effects)
    if further:
        model = model.model_copy(update={"effects": (*model.effects, *further)})
    if model.effects:
        from dragrig.sim_backend.effects import active_effects

        active_effects(model)
    return model


@dataclass(frozen=True, slots=True, kw_only=True)
class RigSetup:
    """The rig in use."""

    rig: RigSettings
    model: FrictionModelSettings
    """Friction model of a simulated rig or a double."""
    rig_folder: Path | None
    """Folder of the rig file, with data root and calibration history; None for a shipped rig."""
    backend: str
    double: bool = False
    """Whether the backend's double is used, in place of the hardware."""
    memory: RigMemory = field(default_factory=RigMemory, compare=False)

    @property
    def data_root(self) -> Path:
        """Folder of the campaigns."""
        return (self.rig_folder or Path()) / self.rig.data.root

    @property
    def limits(self) -> StageLimits:
        """The stage's limits in the settings."""
        return stage_limits(self.rig.stage)

    @property
    def made_on(self) -> str:
        """Key of this rig's calibrations: hardware, its double and the simulated rig have separate ones."""
        return f"{self.backend} double" if self.double else self.backend

    def request(self, pace: "Pace | None" = None) -> BackendRequest:
        """Return the opener of this rig; raises `SettingsError` for a pace that it does not support."""
        paced, calibrations = resolve_pace(pace, double=self.double), self.calibrations()
        return BackendRequest(
            self.rig, self.model, paced.real_time, None, calibrations, pace=paced.times_faster, memory=self.memory
        )

    def commissioning(self) -> CommissioningRecord | None:
        """Return the findings of the look at this very wiring, if there was one; raises `SettingsError` if damaged."""
        record = None if self.rig_folder is None else read_commissioning(self.rig_folder)
        if record is None or (record.made_on, record.wiring) != (self.made_on, wiring_key(self.rig)):
            return None
        return record

    def stops(self) -> Stops:
        """Return the stops that end a motion when the program fails or its link.

        Raises `SettingsError` for a damaged record of the wiring, and for a dialect of the drive that is not there.
        """
        from dragrig.rig.hardware.dialects import Lack, find_dialect

        has_timeout = Lack.SILENCE_TIMEOUT not in find_dialect(self.rig.hardware.drive.dialect).lacks
        return assess_stops(self.rig, self.commissioning(), has_timeout=has_timeout)

    def calibrations(self) -> Mapping[str, Calibration]:
        """Return the latest calibrations by quantity; raises `SettingsError` for a damaged history.

        A calibration of another force sensor than the rig's does not count.
        """
        if self.rig_folder is None:
            return {}
        serials = {"force": self.rig.force_sensor.serial, "encoder": ""}
        latest = {
            quantity: latest_calibration(self.rig_folder, quantity, self.made_on, serials[quantity])
            for quantity in CALIBRATED_QUANTITIES
        }
        return {quantity: entry for quantity, entry in latest.items() if entry is not None}


def resolve_rig(*, folder: Path | None = None, **choices: Unpack[RigChoices]) -> RigSetup:
    """Find the settings of a rig and apply the assignments.

    Parameters
    ----------
    folder
        Where to look for the lab folder (default: the working folder).
    choices
        `rig`, `model`: a file or a shipped name; by default the rig of the lab folder, or the shipped one outside of a
        lab. `backend`: by default that of the rig. `double`: whether to use its double. `assignments`: each
        `rig.key=value` or `model.key=value`. `memory`: where a simulated rig keeps position, home and contact from one
        call to the next; by default it forgets them.

    Raises
    ------
    SettingsError
        With file, key and the allowed values.
    """
    refuse_unknown(choices, RigChoices.__annotations__)
    changes = Assignments.of(choices.get("assignments", ()))
    if other := (*changes.texts["steps"], *changes.texts["plan"], *changes.texts["specimen"]):
        raise SettingsError(f"{other[0]}: without a plan, only rig.… and model.… can be changed.")
    settings, rig_folder = load_settings(RigSettings, "rig", choices.get("rig") or rig_file_of(folder or Path.cwd()))
    rig = changes.applied_to(settings, "rig")
    model = changes.applied_to(load_settings(FrictionModelSettings, "model", choices.get("model"))[0], "model")
    backend, double = choices.get("backend") or rig.backend, choices.get("double", False)
    return RigSetup(
        rig=rig,
        model=with_allowed_effects(model, (), backend=backend, double=double),
        rig_folder=rig_folder,
        backend=backend,
        double=double,
        memory=choices.get("memory") or RigMemory(),
    )


def load_settings(
    model: type[SettingsT], kind: str, choice: str | Path | SettingsT | None
) -> tuple[SettingsT, Path | None]:
    """Return settings by file or shipped name, or the default ones, and the folder of their file."""
    if isinstance(choice, model):
        return choice, None
    data, source = find_table(kind, str(choice or DEFAULT_SETTINGS[kind]))
    return parse(model, data, source), settings_folder(source)


def friction_model(choice: str | Path | FrictionModelSettings) -> FrictionModelSettings:
    """Return a friction model by name or file, or the model itself; raises `SettingsError`."""
    return load_settings(FrictionModelSettings, "model", choice)[0]


def choose_settings(
    model: type[SettingsT], kind: str, choice: str | Path | SettingsT | None, before: SettingsT | None
) -> SettingsT:
    """Return the settings chosen, else those of an earlier session, else the default ones."""
    return before if before is not None and not choice else load_settings(model, kind, choice)[0]


def settings_folder(source: str) -> Path | None:
    """Return the folder of a settings file; None for shipped settings."""
    path = Path(source)
    return path.absolute().parent if path.is_file() else None


def require_shipped_dialect(rig: RigSettings, source: str) -> RigSettings:
    """Refuse a stored rig that names a module of somebody's own, which would be run; raises `SettingsError`."""
    from dragrig.rig.hardware.dialects.base import SHIPPED_DIALECTS

    if (dialect := rig.hardware.drive.dialect) not in SHIPPED_DIALECTS:
        raise SettingsError(
            f"{source}: names the drive's dialect {dialect!r}, a module of somebody's own; run it in the folder of a "
            "lab, whose rig file says how its drive is spoken to."
        )
    return rig


_STAGE_LIMITS: Mapping[str, Callable[[float, float], float]] = {
    "lowest_mm": max,
    "highest_mm": min,
    "max_speed_mm_s": min,
    "max_accel_mm_s2": min,
}


def within_lab(rig: RigSettings, lab: RigSettings, *, hardware: bool) -> tuple[RigSettings, tuple[str, ...]]:
    """Return a rig that a run or a campaign was made with, as a lab lets it run today, and the differences from then.

    The lab's backend, data root, card and drive stand, on hardware its encoder and force sensor as well; of each two
    limits of stage and guard the stricter counts. Each difference is a phrase. Raises `SettingsError` where the
    stored rig cannot be run within the lab's limits at all.
    """
    then, now = rig.model_dump(mode="json"), lab.model_dump(mode="json")
    own = ("backend", "data", "hardware", *(("encoder", "force_sensor") if hardware else ()))
    stage = {key: stricter(then["stage"][key], now["stage"][key]) for key, stricter in _STAGE_LIMITS.items()}
    stage["stop_accel_mm_s2"] = now["stage"]["stop_accel_mm_s2"]
    guard = {key: min(then["guard"][key], limit) for key, limit in now["guard"].items()}
    today = {**then, **{key: now[key] for key in own}, "stage": {**then["stage"], **stage}, "guard": guard}
    differences = tuple(
        f"{part}.{key} is {_shown(today[part][key])} in this lab, not {_shown(then[part][key])} as then"
        for part in ("stage", "guard", "encoder", "force_sensor")
        for key in today[part]
        if today[part][key] != then[part][key]
    )
    if hardware and today["hardware"] != then["hardware"]:
        differences += ("card and drive are used as this lab's rig file says, which is not as then",)
    return parse(RigSettings, today, "the stored rig within this lab's limits"), differences


def _shown(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True, slots=True)
class Assignments:
    """Assignments sorted by the thing that they change; `texts` are the assignments as typed."""

    steps: Table
    others: Mapping[str, Table]
    texts: Mapping[str, tuple[str, ...]]

    @classmethod
    def of(cls, assignments: AssignmentsLike, step_keys: Mapping[str, object] | None = None) -> "Assignments":
        """Sort assignments, and keys of steps with their values; raises `SettingsError`."""
        tables: dict[str, Table] = {"steps": {}, "rig": {}, "model": {}, "specimen": {}, "plan": {}}
        texts: dict[str, tuple[str, ...]] = dict.fromkeys(tables, ())
        for text, path, value in _typed_changes(assignments, step_keys or {}):
            first, *rest = path if len(path) > 1 else ("steps", *path)
            if first not in tables or not rest:
                hint = f": write rig.{text}" if first in RigSettings.model_fields else ""
                raise SettingsError(f"{text}: {first} is none of rig, model, specimen and plan{hint}.")
            tables[first] = merge_tables(tables[first], nested_table(rest, value))
            texts[first] = (*texts[first], text)
        return cls(tables.pop("steps"), tables, texts)

    def applied_to(self, settings: SettingsT, name: str) -> SettingsT:
        """Return the settings with their changes."""
        if not self.others[name]:
            return settings
        data = merge_tables(settings.model_dump(mode="json", exclude_unset=True), self.others[name])
        return parse(type(settings), data, " ".join(self.texts[name]))


def _typed_changes(
    assignments: AssignmentsLike, step_keys: Mapping[str, object]
) -> Iterator[tuple[str, tuple[str, ...], object]]:
    """Yield each change as it would be typed, its path and its value."""
    if not isinstance(assignments, Mapping):
        for text in (assignments,) if isinstance(assignments, str) else assignments:
            yield text, *parse_assignment(text)
        assignments = {}
    for key, value in {**assignments, **step_keys}.items():
        plain = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
        yield f"{key}={plain}", tuple(key.split(".")), list(plain) if isinstance(plain, tuple | range) else plain


PlanLike = str | Path | Plan | Mapping[str, object] | RunProtocol
"""A plan by name or file, or as a table; a run file whose session is repeated; or the single run of a protocol."""


class StepChoices(TypedDict, total=False):
    """Keys of a plan's steps, given to every step that has them."""

    speed_mm_s: float | Sequence[float]
    travel_mm: float | Sequence[float]
    shear_strain: float | Sequence[float]
    ramp_speed_mm_s: float | Sequence[float]
    ramp_accel_mm_s2: float | Sequence[float]
    rest_s: float | Sequence[float]
    hold_s: float | Sequence[float]
    accel_mm_s2: float | Sequence[float]
    strokes: Sequence[Mapping[str, float]]
    repeats: int
    order: str
    wait_s: float
    way_back: str
    way_back_speed_mm_s: float
    start_mm: float
    tare_s: float
    prompt: str
    prompt_each: bool
    fixture: str


class SetupChoices(RigChoices, StepChoices, total=False):
    """The keyword arguments of `resolve`; None means the default."""

    specimen: str | Path | None
    capsule: str | Path | None
    effects: Sequence[str | EffectSettings]


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup(RigSetup):
    """All settings of a session."""

    plan: Plan
    plan_source: str
    """Source of the plan, for error messages."""
    plan_folder: Path | None
    """Folder that capsule files in the plan are relative to; None for a shipped plan."""
    specimen: Specimen
    contact_mm: float | None = None
    """Absolute position of the contact found by touch-off; None where it is not known."""
    differences: tuple[str, ...] = ()
    """How the rig differs from the stored one of the run or campaign that is repeated."""

    def with_rig(self, assignments: AssignmentsLike) -> "Setup":
        """Return this with assignments to the rig applied; raises `SettingsError` for any other."""
        changes = Assignments.of(assignments)
        if changes.steps or any(table for name, table in changes.others.items() if name != "rig"):
            typed = " ".join(chain(*changes.texts.values()))
            raise SettingsError(
                f"{typed}: a campaign goes on with its own plan, specimen and model, so only rig.… can be changed."
            )
        return replace(self, rig=changes.applied_to(self.rig, "rig"))

    def programme(self) -> Programme:
        """Lay out the plan's runs; raises `PlanError` or `SettingsError`."""
        stage, zero_mm = self.rig.stage, 0.0
        if stage.start_from == "contact":
            if self.contact_mm is None:
                raise SettingsError(
                    "stage.start_from = 'contact': this lab has no contact; find it with dragrig touch-off."
                )
            zero_mm = self.contact_mm
        return build_programme(self.plan, self.specimen, stage.start_mm, self.plan_source, self.plan_folder, zero_mm)


def resolve(
    plan: PlanLike,
    *,
    folder: Path | None = None,
    campaign: "SessionRecord | None" = None,
    **choices: Unpack[SetupChoices],
) -> Setup:
    """Find all settings of a session and apply the assignments.

    Parameters
    ----------
    folder
        Where to look for the lab folder (default: the working folder).
    campaign
        A session whose rig, specimen, model and backend are the defaults, whatever the plan.
    choices
        `rig`, `specimen`, `model`: a file or a shipped name, the model also as settings; by default the rig of the lab
        folder, or the shipped one outside of a lab; without a stated specimen, that of the real rig is unknown.
        `capsule`: a file or a name, for every step.
        `backend`: by default that of the rig. `double`: whether to use its double.
        `effects`: added to those of the model of the simulated rig, each as `stribeck:ratio=0.4,speed_mm_s=2`.
        `assignments`: each `key=value`; a path that begins with rig, model, specimen or plan changes that, a bare
        key every step that has it. Any other name is such a key of steps: `speed_mm_s=10`.

    Raises
    ------
    SettingsError, PlanError
        With file, key and the allowed values.
    TypeError
        For a name that is no choice and no key of any kind of step.
    """
    stored = _stored_session(plan)
    before = campaign or stored
    rig = choices.get("rig") or rig_file_of(folder or Path.cwd())
    rig_settings, rig_folder = load_settings(RigSettings, "rig", rig)
    refuse_unknown(choices, {*SetupChoices.__annotations__, *_STEP_KEYS.union(*map(_keys_of, protocol_kinds()))})
    settings = SetupChoices.__annotations__.keys() - StepChoices.__annotations__.keys()
    step_keys = {key: value for key, value in choices.items() if key not in settings}
    changes = Assignments.of(choices.get("assignments", ()), step_keys)
    if (capsule := choices.get("capsule")) is not None:
        # The plan may be elsewhere, and files in it are relative to it.
        changes.steps["capsule"] = str(Path(capsule).absolute() if Path(capsule).is_file() else capsule)
    default_backend = rig_settings.backend if campaign is None else campaign.backend
    differences: tuple[str, ...] = ()
    if before is not None and not choices.get("rig"):
        if rig is None:
            rig_settings = require_shipped_dialect(before.rig, str(plan if campaign is None else folder))
            default_backend = before.backend
        else:
            hardware = (choices.get("backend") or default_backend) == HARDWARE_BACKEND
            rig_settings, differences = within_lab(before.rig, rig_settings, hardware=hardware)
    rig_changed = changes.applied_to(rig_settings, "rig")
    backend = choices.get("backend") or (rig_changed.backend if before is None else default_backend)
    double = choices.get("double", False) or (before is not None and before.double and backend == before.backend)
    specimen_choice = choices.get("specimen")
    if specimen_choice is None and backend == HARDWARE_BACKEND and (before is None or before.backend != backend):
        # A real specimen is what somebody states; that of the simulated rig would be an invention.
        specimen_choice = UNSTATED
    if stored is None:
        base_plan, source, plan_folder = _load_plan(plan)
    else:
        base_plan, source, plan_folder = stored.plan, str(plan), stored.beside
    specimen = choose_settings(Specimen, "specimen", specimen_choice, before.specimen if before else None)
    model = choose_settings(FrictionModelSettings, "model", choices.get("model"), before.model if before else None)
    model = changes.applied_to(model, "model")
    contact = None if rig_folder is None else read_contact(rig_folder)
    return Setup(
        plan=_with_step_keys(changes.applied_to(base_plan, "plan"), changes),
        plan_source=source,
        plan_folder=plan_folder,
        rig=rig_changed,
        specimen=_of_the_past(changes.applied_to(specimen, "specimen")),
        contact_mm=contact.position_mm if contact else before.contact_mm if before else None,
        model=with_allowed_effects(model, choices.get("effects", ()), backend=backend, double=double),
        rig_folder=rig_folder,
        backend=backend,
        double=double,
        differences=differences,
        memory=choices.get("memory") or RigMemory(),
    )


def _of_the_past(specimen: Specimen) -> Specimen:
    """Return the specimen; raises `SettingsError` where it is taken or mounted only in the future."""
    for key in ("excised_at", "mounted_at"):
        moment: datetime | None = getattr(specimen, key)
        if moment is not None and moment > datetime.now().astimezone():
            raise SettingsError(
                f"specimen.{key} = {moment:%Y-%m-%d %H:%M}: lies in the future by this computer's clock; correct it."
            )
    return specimen


def _stored_session(plan: PlanLike) -> "SessionRecord | None":
    """Return the session of a run file that is given in place of a plan."""
    if not isinstance(plan, str | Path) or Path(plan).suffix != ".h5":
        return None
    from dragrig.rig import session_record_of_run

    return session_record_of_run(Path(plan))


def single_run_plan(protocol: RunProtocol) -> Plan:
    """Return the plan of a single run, without return stroke."""
    step = PlanStep.model_validate({"kind": protocol.kind, "way_back": "stay", **protocol.model_dump(mode="json")})
    return Plan(name=protocol.kind, steps=(step,))


def _load_plan(plan: PlanLike) -> tuple[Plan, str, Path | None]:
    if isinstance(plan, Plan):
        return plan, f"plan {plan.name}", None
    if isinstance(plan, RunProtocol):
        return single_run_plan(plan), plan.kind, None
    if isinstance(plan, Mapping):
        return parse(Plan, plan, "the plan"), "plan", None
    data, source = find_table("plan", str(plan))
    return parse(Plan, data, source), source, settings_folder(source)


def _with_step_keys(plan: Plan, changes: Assignments) -> Plan:
    if not changes.steps:
        return plan
    known = [_keys_of(step.kind) for step in plan.steps]
    for key in changes.steps:
        if not any(key in keys for keys in known):
            everything = sorted(set().union(*known))
            raise PlanError(f"{key}: no step of plan {plan.name} has such a key; {suggestion(key, everything)}")
    steps = [
        {**step.model_dump(mode="json", exclude_unset=True), **{k: v for k, v in changes.steps.items() if k in keys}}
        for step, keys in zip(plan.steps, known, strict=True)
    ]
    data = plan.model_dump(mode="json", exclude_unset=True)
    return parse(Plan, {**data, "steps": steps}, " ".join(changes.texts["steps"]) or plan.name)


_STEP_KEYS = frozenset(PlanStep.model_fields) - {"kind", "parameters"}


def _keys_of(kind: str) -> frozenset[str]:
    """Return the keys that a step of this kind may have."""
    protocol = protocol_kinds().get(kind)
    return _STEP_KEYS if protocol is None else _STEP_KEYS | set(protocol.model_fields)


def create_lab(folder: Path) -> tuple[Path, ...]:
    """Make a lab folder: settings of rig and notification to edit, an empty calibration history, the data root.

    Returns
    -------
    The paths made.

    Raises
    ------
    OutputError
        When `folder` cannot be written, is a lab folder already or lies in one; nothing is replaced.
    """
    if (around := rig_file_of(folder.absolute().parent)) is not None:
        raise OutputError(f"{folder}: lies in the lab {around.parent}; use that one, or name a folder outside of it.")
    rig = find_settings(RigSettings, "rig", "bench")
    history, root = folder / CALIBRATION_FILE, folder / rig.data.root
    settings = {folder / RIG_FILE: rig, folder / NOTIFICATION_FILE: NotificationSettings()}
    for existing in (path for path in (*settings, history) if path.exists()):
        raise OutputError(f"{existing}: exists already and is not changed; name another folder.")
    try:
        root.mkdir(parents=True, exist_ok=True)
        history.touch()
        for file, values in settings.items():
            file.write_text(commented_toml(values), encoding="utf-8", newline="\n")
    except OSError as error:
        raise OutputError(f"{folder}: no lab folder can be made here ({error.strerror}); name another.") from error
    return *settings, history, root


def commented_toml(settings: Settings) -> str:
    """Write settings as TOML, every key below a comment with its description."""
    return "\n".join(_commented_lines(settings, (), (type(settings).__doc__ or "").splitlines()[0])) + "\n"


def _commented_lines(settings: Settings, path: tuple[str, ...], about: str) -> Iterator[str]:
    yield f"# {about}"
    if path:
        yield f"[{'.'.join(path)}]"
    values = settings.model_dump(mode="json", exclude_none=True)
    below: dict[str, Settings] = {}
    descriptions = field_descriptions(type(settings))
    for key in type(settings).model_fields:
        value = getattr(settings, key)
        if isinstance(value, Settings):
            below[key] = value
        elif key in values:
            if key in descriptions:
                yield f"# {' '.join(descriptions[key].split())}"
            yield tomli_w.dumps({key: values[key]}).strip()
    for key, inner in below.items():
        yield ""
        yield from _commented_lines(inner, (*path, key), (type(inner).__doc__ or "").splitlines()[0])
