"""The rig that is meant: settings found by name or file and changed by assignments, backend, lab folder."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypedDict, TypeVar, Unpack

from dragrig.config.base import Settings
from dragrig.config.effects import EffectSettings, effects_of
from dragrig.config.errors import SettingsError
from dragrig.config.lab import Calibration, rig_file_of
from dragrig.config.library import table
from dragrig.config.loading import Table, merge, nested, parse, parse_assignment
from dragrig.config.model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig import calibration, contact
from dragrig.rig.devices import StageLimits

SettingsT = TypeVar("SettingsT", bound=Settings)

DEFAULTS: Mapping[str, str] = {"rig": "bench", "specimen": "jejunum", "model": "paper"}
HARDWARE = "hardware"
"""The backend of the real rig, whose effects are its own."""
QUANTITIES = ("force", "encoder")
"""What is calibrated."""


class RigChoices(TypedDict, total=False):
    """The keyword arguments of `resolve_rig`; none and None mean the usual."""

    rig: str | Path | None
    model: str | Path | FrictionModelSettings | None
    backend: str | None
    double: bool
    assignments: Sequence[str]


def equipped(
    model: FrictionModelSettings, effects: Sequence[str | EffectSettings], *, backend: str, double: bool
) -> FrictionModelSettings:
    """Return the model with further effects, checked where they will act.

    Raises
    ------
    SettingsError
        For effects that cannot be, and those for a rig that is not the simulated one.
    """
    if backend == HARDWARE and (effects or (double and model.effects)):
        where = "its double" if double else "the rig itself"
        raise SettingsError(
            f"--effect: effects act in the simulated rig, and backend {backend} is {where}; leave them out, or name "
            "--backend simulated."
        )
    return with_effects(model, effects)


def with_effects(model: FrictionModelSettings, effects: Sequence[str | EffectSettings]) -> FrictionModelSettings:
    """Return the model with further effects; raises `SettingsError` for effects that cannot be."""
    further = effects_of(effects)
    if further:
        model = model.model_copy(update={"effects": (*model.effects, *further)})
    if model.effects:
        from dragrig.sim_backend.effects.applied import switched_on

        switched_on(model)
    return model


@dataclass(frozen=True, slots=True, kw_only=True)
class RigSetup:
    """Everything that says which rig is meant.

    Attributes
    ----------
    model
        Friction model of a simulated rig, and of a double of the real one.
    rig_folder
        Folder of the rig file, with data root and calibration history; None for a shipped rig.
    double
        Whether the double of the backend is meant, in place of the hardware.
    """

    rig: RigSettings
    model: FrictionModelSettings
    rig_folder: Path | None
    backend: str
    double: bool = False

    @property
    def data_root(self) -> Path:
        """Folder of the campaigns."""
        return (self.rig_folder or Path()) / self.rig.data.root

    @property
    def limits(self) -> StageLimits:
        """What the settings say that the stage can do."""
        stage = self.rig.stage
        return StageLimits(stage.lowest_mm, stage.highest_mm, stage.max_speed_mm_s, stage.max_accel_mm_s2)

    @property
    def made_on(self) -> str:
        """What calibrations made on this rig are kept under: those of the hardware and of its double are no others'."""
        return f"{self.backend} double" if self.double else self.backend

    def calibrations(self) -> Mapping[str, Calibration]:
        """Return the calibrations that hold now, by quantity; raises `SettingsError` for a damaged history.

        That of another force sensor than the rig's holds for nothing here.
        """
        if self.rig_folder is None:
            return {}
        serials = {"force": self.rig.force_sensor.serial}
        found = {
            one: calibration.latest(self.rig_folder, one, self.made_on, serials.get(one, "")) for one in QUANTITIES
        }
        return {quantity: entry for quantity, entry in found.items() if entry is not None}


def resolve_rig(*, folder: Path | None = None, **choices: Unpack[RigChoices]) -> RigSetup:
    """Find the settings of a rig and apply the assignments.

    Parameters
    ----------
    folder
        Where to look for the lab folder; the working folder unless given.
    choices
        `rig`, `model`: a file or a shipped name; the rig is the lab folder's unless given, and the shipped one outside
        of a lab. `backend`: the rig's own unless given. `double`: whether its double is meant. `assignments`: each
        `rig.key=value` or `model.key=value`.

    Raises
    ------
    SettingsError
        One sentence that names file, key and what is allowed.
    """
    changes = Changes.of(choices.get("assignments", ()))
    if changes.steps or changes.others["plan"] or changes.others["specimen"]:
        raise SettingsError("--set: without a plan, only rig.… and model.… can be changed.")
    settings, rig_folder = found_settings(RigSettings, "rig", choices.get("rig") or rig_file_of(folder or Path.cwd()))
    rig = changes.laid_over(settings, "rig")
    model = changes.laid_over(found_settings(FrictionModelSettings, "model", choices.get("model"))[0], "model")
    backend, double = choices.get("backend") or rig.backend, choices.get("double", False)
    return RigSetup(
        rig=rig,
        model=equipped(model, (), backend=backend, double=double),
        rig_folder=rig_folder,
        backend=backend,
        double=double,
    )


def found_settings(
    model: type[SettingsT], kind: str, given: str | Path | SettingsT | None
) -> tuple[SettingsT, Path | None]:
    """Return settings by file or shipped name, the usual ones for none, and the folder of their file."""
    if isinstance(given, model):
        return given, None
    data, source = table(kind, str(given or DEFAULTS[kind]))
    return parse(model, data, source), folder_of(source)


def chosen(
    model: type[SettingsT], kind: str, given: str | Path | SettingsT | None, before: SettingsT | None
) -> SettingsT:
    """Return what was chosen; otherwise what a session had before, or the usual."""
    return before if before is not None and not given else found_settings(model, kind, given)[0]


def contact_in(rig_folder: Path | None, before_mm: float | None = None) -> float | None:
    """Return the absolute position of the contact that a lab keeps now, or else the one that was known before."""
    kept = contact.read(rig_folder) if rig_folder is not None else None
    return before_mm if kept is None else kept.position_mm


def folder_of(source: str) -> Path | None:
    """Return the folder of the file that settings come from; None for shipped ones."""
    path = Path(source)
    return path.absolute().parent if path.is_file() else None


@dataclass(frozen=True, slots=True)
class Changes:
    """Assignments by what they change; `texts` are the assignments as they were typed."""

    steps: Table
    others: Mapping[str, Table]
    texts: Mapping[str, tuple[str, ...]]

    @classmethod
    def of(cls, assignments: Sequence[str]) -> "Changes":
        """Sort assignments; raises `SettingsError`."""
        steps: Table = {}
        others: dict[str, Table] = {"rig": {}, "model": {}, "specimen": {}, "plan": {}}
        texts: dict[str, tuple[str, ...]] = dict.fromkeys(others, ())
        for text in (assignments,) if isinstance(assignments, str) else assignments:
            (first, *rest), value = parse_assignment(text)
            if not rest:
                steps[first] = value
            elif first in others:
                others[first] = merge(others[first], nested(rest, value))
                texts[first] = (*texts[first], text)
            else:
                raise SettingsError(f"--set {text}: {first} is none of rig, model, specimen and plan.")
        return cls(steps, others, texts)

    def laid_over(self, settings: SettingsT, name: str) -> SettingsT:
        """Return the settings with the changes that are meant for them."""
        if not self.others[name]:
            return settings
        data = merge(settings.model_dump(mode="json", exclude_unset=True), self.others[name])
        return parse(type(settings), data, f"--set {' '.join(self.texts[name])}")
