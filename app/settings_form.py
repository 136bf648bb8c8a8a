"""Rig settings and specimen as forms; a lab's rig settings are saved to their file with its comments; free of Qt."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path

from dragrig.config import (
    UNSTATED,
    RigSettings,
    Settings,
    SettingsError,
    Specimen,
    Table,
    merge_tables,
    mistakes_in,
    nested_table,
    parse,
    read_text,
    read_toml,
)
from dragrig.rig.runfile import replace_text
from dragrig.setup import DEFAULT_SETTINGS, load_settings
from dragrig.views import (
    FieldKind,
    FieldPlace,
    Form,
    FormGroup,
    first_key_named,
    form_fields,
    parse_field,
    value_text,
)

_WHOLE = "rig"
"""Group of the settings that are in no table."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RigSettingsForm(Form):
    """Rig settings as a form; its groups are the tables of the file."""

    path: Path | None
    """The file; None for shipped settings, which cannot be changed."""
    settings: RigSettings

    def problems(self, values: Sequence[Mapping[str, str]]) -> dict[FieldPlace, str]:
        """Return the faults of these values, by group and key."""
        problems = self.misread(values)
        if problems:
            return problems
        for path, problem in mistakes_in(RigSettings, self._table(self._changes(values))).items():
            place = self._place_of(path, problem)
            problems.setdefault(place, self._in_labels(problem, place[0]))
        return problems

    def changes(self, values: Sequence[Mapping[str, str]]) -> dict[FieldPlace, str]:
        """Return the changes by these values, with the former values, by group and key."""
        own = self.values()
        return {
            (number, key): f"{text.strip() or _EMPTY} (was {own[number][key] or _EMPTY})"
            for number, texts in enumerate(values)
            for key, text in texts.items()
            if text.strip() != own[number][key].strip()
        }

    def save(self, values: Sequence[Mapping[str, str]]) -> RigSettings:
        """Write the changes by these values to the file, whose comments and other keys stay; return the settings then.

        Raises
        ------
        SettingsError
            For invalid values, shipped settings, and a file that has become invalid meanwhile; nothing is written then.
        OutputError
            When the file cannot be written.
        """
        import tomlkit

        if self.path is None:
            raise SettingsError("the shipped settings cannot be changed; make a lab folder with dragrig init.")
        for place, problem in self.problems(values).items():
            raise SettingsError(f"{self.path}: {self.field_name(place)}: {problem}.")
        read_toml(self.path)  # says what is wrong with a file that is no TOML
        document = tomlkit.parse(read_text(self.path))
        for (number, key), value in self._changes(values).items():
            table: Table = document
            for part in self.path_of(number):
                table = table.setdefault(part, tomlkit.table())  # type: ignore[assignment]  # as above
            table[key] = value
        settings = parse(RigSettings, document.unwrap(), str(self.path))
        replace_text(self.path, tomlkit.dumps(document))
        return settings

    def _changes(self, values: Sequence[Mapping[str, str]]) -> dict[FieldPlace, object]:
        own, changes = self.values(), {}
        defaults = RigSettings()
        for number, (group, texts) in enumerate(zip(self.groups, values, strict=True)):
            for field in group.fields:
                text = texts[field.key].strip()
                if text != own[number][field.key].strip():
                    group_of_it = reduce(getattr, self.path_of(number), defaults)
                    # An empty text is the default of a number or a list, and a text of its own.
                    unset = "" if field.kind is FieldKind.TEXT else group_of_it.model_dump(mode="json")[field.key]
                    changes[number, field.key] = parse_field(field, text, group.name) if text else unset
        return changes

    def _table(self, changes: Mapping[FieldPlace, object]) -> Table:
        """Return all settings with these changes."""
        table = self.settings.model_dump(mode="json", exclude_none=True)
        for (number, key), value in changes.items():
            table = merge_tables(table, nested_table((*self.path_of(number), key), value))
        return table

    def title(self, number: int) -> str:
        """Return the title of a group: Hardware, card, force."""
        return self.groups[number].name.replace("_", " ").replace(".", ", ").capitalize()

    def _in_labels(self, problem: str, number: int) -> str:
        """Return a sentence with the labels of the keys that it names, of other groups with that group."""
        for other, group in enumerate(self.groups):
            for field in group.fields:
                path = re.escape(".".join((*self.path_of(other), field.key)))
                problem = re.sub(rf"(?<![\w.]){path}(?!\w)", f"{field.name} ({self.title(other)})", problem)
        for field in self.groups[number].fields:
            if "_" in field.key:
                problem = re.sub(rf"(?<![\w.]){field.key}(?!\w)", field.name, problem)
        return problem

    def path_of(self, number: int) -> tuple[str, ...]:
        """Return the keys that lead to a group's table in the file."""
        name = self.groups[number].name
        return () if name == _WHOLE else tuple(name.split("."))

    def _place_of(self, path: tuple[str, ...], problem: str) -> FieldPlace:
        """Return the field that a mistake is about: that of its path, or the first that its sentence names."""
        places = {
            (*self.path_of(number), field.key): (number, field.key)
            for number, group in enumerate(self.groups)
            for field in group.fields
        }
        for length in range(len(path), 0, -1):
            if path[:length] in places:
                return places[path[:length]]
        for number, group in enumerate(self.groups):
            key = first_key_named(group, problem.replace(".", " ")) if self.path_of(number) == path else None
            if key is not None:
                return number, key
        # About tables among each other: it names keys with their tables.
        named = {".".join(full): place for full, place in places.items()}
        return named[min(filter(problem.__contains__, named), key=problem.index)]


_EMPTY = "empty"


def rig_settings_form(rig: str | Path | None) -> RigSettingsForm:
    """Return the settings of a rig, by file or shipped name, as a form; raises `SettingsError`."""
    settings, folder = load_settings(RigSettings, "rig", rig)
    path = Path(rig or DEFAULT_SETTINGS["rig"]).absolute() if folder is not None else None
    return RigSettingsForm(groups=tuple(_groups(settings, ())), path=path, settings=settings)


def _groups(settings: Settings, path: tuple[str, ...]) -> Iterator[FormGroup]:
    """Yield a table of the file and those in it, in the order of the file; one without keys of its own is left out."""
    fields = tuple(
        replace(field, empty="" if field.kind is FieldKind.TEXT else field.empty)
        for field in form_fields(type(settings), sweeps=False)
    )
    own = settings.model_dump(mode="json", exclude_none=True)
    values = {field.key: value_text(own[field.key]) for field in fields if field.key in own}
    about = (type(settings).__doc__ or "").strip().splitlines()[0]
    if fields:
        yield FormGroup(".".join(path) or _WHOLE, about, fields, values)
    for key in type(settings).model_fields:
        if isinstance(inner := getattr(settings, key), Settings):
            yield from _groups(inner, (*path, key))


@dataclass(frozen=True, slots=True, kw_only=True)
class SpecimenForm(Form):
    """The facts of a specimen that only somebody at the rig can state; one group; an empty field states nothing."""

    def problems(self, values: Sequence[Mapping[str, str]]) -> dict[FieldPlace, str]:
        """Return the faults of these values, by group and key."""
        if problems := self.misread(values):
            return problems
        (group,) = self.groups
        for path, problem in mistakes_in(Specimen, {"name": group.name, **group.parsed(values[0])}).items():
            key = path[0] if path else first_key_named(group, problem)
            problems[0, key or group.fields[0].key] = problem
        return problems

    def assignments(self, values: Sequence[Mapping[str, str]]) -> tuple[str, ...]:
        """Return these values as assignments, as `specimen.id="P7"`, a time of day with its date.

        Raises
        ------
        SettingsError
            For invalid values.
        """
        for place, problem in self.problems(values).items():
            raise SettingsError(f"Specimen, {self.field_name(place)}: {problem}.")
        (group,) = self.groups
        stated = group.parsed(values[0])
        # A time of day is of now, whenever the session is made.
        dated = Specimen.model_validate({"name": group.name, **stated}).model_dump(mode="json")
        return tuple(f"specimen.{key}={json.dumps(dated[key], ensure_ascii=False)}" for key in stated)


def specimen_form(*, of_campaign: bool = False) -> SpecimenForm:
    """Return an empty form of a specimen, or, `of_campaign`, of the differences from a campaign's."""
    about = f"What is left empty is recorded as {UNSTATED}."
    if of_campaign:
        about = "What is left empty is as in the campaign; a fresh piece needs an id of its own."
    fields = (
        replace(field, default="", empty="as 09:15" if field.key.endswith("_at") else "")
        for field in form_fields(Specimen, sweeps=False)
    )
    return SpecimenForm(
        groups=(FormGroup("specimen", about, tuple(field for field in fields if field.key != "name"), {}),)
    )
