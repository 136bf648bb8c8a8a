"""The site's reference, written from the code while the site is built: commands, settings, run file."""

from collections.abc import Iterator, Mapping

import click
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from pydantic import BaseModel
from pydantic_core import PydanticUndefined


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages."""
    for name, text in {"commands": commands(), "settings": settings(), "run-file": run_file()}.items():
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    return files


def commands() -> str:
    """Write a chapter for each command, with its arguments and options."""
    from dragrig.cli.commands import dragrig_group

    parts = ["# Commands", "Each is `dragrig COMMAND`; `--help` says the same in the terminal."]
    for command, path in _leaves(dragrig_group, "dragrig"):
        context = click.Context(command, info_name=path)
        parts += [f"## {path.removeprefix('dragrig ')}", _plain(command.help or "")]
        parts.append(f"```\n{command.get_usage(context).removeprefix('Usage: ')}\n```")
        rows = [param.get_help_record(context) for param in command.params]
        parts.append(_table(("option", "what it does"), [(f"`{row[0]}`", row[1]) for row in rows if row]))
    return _page(parts)


def _leaves(command: click.Command, path: str) -> Iterator[tuple[click.Command, str]]:
    if not isinstance(command, click.Group):
        yield command, path
        return
    context = click.Context(command)
    for name in command.list_commands(context):
        child = command.get_command(context, name)
        if child is not None:
            yield from _leaves(child, f"{path} {name}")


def settings() -> str:
    """Write a table for each group of settings, protocols included."""
    from dragrig.config.friction_model import FrictionModelSettings
    from dragrig.config.plan import Plan, PlanStep
    from dragrig.config.rig import RigSettings
    from dragrig.config.specimen import Capsule, Specimen
    from dragrig.rig.protocols import protocol_kinds

    parts = [
        "# Settings",
        "Files are TOML. A key that does not exist is answered with the nearest one that does; `--set` changes any of "
        "them for one call.",
    ]
    for title, root in {
        "Rig": RigSettings,
        "Plan": Plan,
        "Step of a plan": PlanStep,
        "Capsule": Capsule,
        "Specimen": Specimen,
        "Friction model": FrictionModelSettings,
    }.items():
        parts.append(f"## {title}")
        for name, model in _groups(root, ""):
            parts += [f"### `[{name}]`" if name else "", _first(model.__doc__), _fields(model)]
    parts += ["## Steps of a plan, by kind", "Beside the keys of every step, a step has those of its kind."]
    for kind, protocol in protocol_kinds().items():
        parts += [f"### {kind}", _first(protocol.__doc__), _fields(protocol)]
    return _page(parts)


def _groups(model: type[BaseModel], name: str) -> Iterator[tuple[str, type[BaseModel]]]:
    yield name, model
    for key, model_field in model.model_fields.items():
        if isinstance(model_field.annotation, type) and issubclass(model_field.annotation, BaseModel):
            yield from _groups(model_field.annotation, f"{name}.{key}".strip("."))


def _fields(model: type[BaseModel]) -> str:
    from dragrig.config import field_descriptions

    properties = model.model_json_schema(mode="validation").get("properties", {})
    descriptions = field_descriptions(model)
    rows = []
    for key, model_field in model.model_fields.items():
        if isinstance(model_field.annotation, type) and issubclass(model_field.annotation, BaseModel):
            continue
        required = model_field.default is PydanticUndefined and model_field.default_factory is None
        default = (
            "required" if required else "" if model_field.default is PydanticUndefined else f"`{model_field.default!s}`"
        )
        rows.append((f"`{key}`", _range(properties.get(key, {})), default, descriptions.get(key, "")))
    return _table(("key", "values", "unless given", "what it is"), rows)


def _range(schema: Mapping[str, object]) -> str:
    words = {"minimum": "from", "exclusiveMinimum": "above", "maximum": "to", "exclusiveMaximum": "below"}
    bounds = [f"{word} {schema[key]}" for key, word in words.items() if key in schema]
    if "enum" in schema or "const" in schema:
        choices = schema.get("enum", [schema.get("const")])
        return ", ".join(map(str, choices)) if isinstance(choices, list) else ""
    return ", ".join((str(schema.get("type", "")), *bounds)).strip(", ")


def run_file() -> str:
    """Write what a run file holds, from the one module that knows."""
    from dragrig.rig.runfile import schema
    from dragrig.rig.runfile.model import PHASE_NAMES, RunStatus

    parts = [
        "# Run file",
        f"One run, one HDF5 file, after the NeXus conventions: format `{schema.FORMAT}`, version "
        f"{schema.FORMAT_VERSION}. A run that is being recorded ends in `{schema.RECORDING_SUFFIX}`, and may be read "
        "meanwhile.",
        "## Attributes that every file has",
        _table(
            ("group", "attribute", "value"),
            [
                (f"`{group}`", f"`{name}`", value if isinstance(value, str) else f"a {value.__name__}")
                for table in (schema.FIXED_ATTRIBUTES, schema.REQUIRED_ATTRIBUTES)
                for group, attributes in table.items()
                for name, value in attributes.items()
            ],
        ),
        f"`{schema.RUN}` has as attributes what the NeXus standard has no place for: also `reason`, `end_time`, "
        "`operator`, `note`, `origin_mm`, `raw_sha256` and what the backend and the plan say of the run. What the "
        "standard has a place for is there as well: `title`, `start_time`, `end_time`, the groups `sample`, `user`, "
        "`instrument` and `provenance`; `nxcheck` of nexusformat has nothing to remark. In files of version 1, which "
        f"are read too, `format` and `format_version` are attributes of `/`, and those of `{schema.RUN}`, the events "
        f"and the settings are in `{schema.ENTRY}`.",
        "## Datasets of the trace",
        f"In `{schema.TRACE}`, each of as many samples as there are: `{'`, `'.join(schema.FRAME_DATASETS)}`, the "
        f"signal ({' or '.join(schema.SIGNALS)}), `position`, and the other recorded channels. Some have fixed units:",
        _table(("dataset", "unit"), [(f"`{name}`", unit) for name, unit in schema.UNITS.items()]),
        "## Phases",
        _table(("number", "phase"), [(str(number), name) for number, name in enumerate(PHASE_NAMES)]),
        "## Status of a run",
        ", ".join(f"`{status.value}`" for status in RunStatus) + ".",
        "## Numbers of a protocol",
        _table(
            ("kind", "attributes of `/entry/protocol`"),
            [(kind, ", ".join(f"`{name}`" for name in names)) for kind, names in schema.PARAMETERS_OF_KIND.items()],
        ),
        "## Events and settings",
        f"`{schema.LAYOUT.settings}` has the settings that the run was made with, as TOML. "
        f"`{schema.LAYOUT.events}` is a table of {', '.join(f'`{name}`' for name in schema.EVENT_FIELDS)}.",
        "## The checksum",
        _plain(_whole_doc()),
    ]
    return _page(parts)


def _whole_doc() -> str:
    from inspect import cleandoc

    from dragrig.rig.runfile.writer import TraceDigest

    return cleandoc(TraceDigest.__doc__ or "")


def _table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    if not rows:
        return ""
    lines = [header, ("---",) * len(header), *rows]
    return "\n".join(f"| {' | '.join(_cell(cell) for cell in row)} |" for row in lines)


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _plain(text: str) -> str:
    return text.replace("\b", "").replace("<", "&lt;").replace("[", "\\[")


def _first(doc: str | None) -> str:
    return _plain((doc or "").strip().split("\n\n")[0])


def _page(parts: list[str]) -> str:
    return "\n\n".join(part for part in parts if part) + "\n"
