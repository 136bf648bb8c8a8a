"""Settings: the common base class, TOML in and out, and lookup by file or shipped name.

A validation error is one sentence that names the file, the key and the allowed values.
"""

import ast
import inspect
import re
import sys
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from itertools import pairwise
from pathlib import Path
from types import UnionType
from typing import Self, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ModelWrapValidatorHandler, ValidationError, field_validator, model_validator
from pydantic_core import ErrorDetails

from dragrig.config.errors import NO_TEXT, SettingsError
from dragrig.config.lab import read_text, rig_file_of
from dragrig.config.typed_numbers import number_text, read_number

_MAX_FILE_BYTES = 4 * 1024 * 1024
_MAX_TEXT_CHARACTERS = 4096
_MAX_NESTING = 32
"""Lists and tables within each other."""
_NO_NUMBER = frozenset({"float_parsing", "int_parsing", "float_type", "int_type"})
_TABLE, _LIST = "must be a table of keys", "must be a list, in brackets"
_TIME = "is not a time; write it as 2026-05-04T09:15:00+02:00"
_SENTENCES = {
    "model_type": _TABLE,
    "dict_type": _TABLE,
    "mapping_type": _TABLE,
    "list_type": _LIST,
    "tuple_type": _LIST,
    "string_type": "must be text, in quotes",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
    "finite_number": "must be a number that is not infinite",
    "greater_than": "must be above {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than": "must be below {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "string_too_short": "must not be empty",
    "too_short": "must have {min_length} or more entries, and has {actual_length}",
    "too_long": "must have no more than {max_length} entries",
    "datetime_type": _TIME,
    "datetime_parsing": _TIME,
    "datetime_from_date_parsing": _TIME,
    "timezone_aware": "must have an offset from UTC, as 2026-05-04T09:15:00+02:00",
    "string_unicode": NO_TEXT,
}
"""What is wrong, by pydantic's type of error, whose context fills the braces."""
_TOML_MISTAKES: tuple[tuple[str, Callable[[re.Match[str]], str]], ...] = (
    (r"\[\[?[\w.\s-]+\]?", lambda m: f"the brackets do not match; write {_bracketed(m[0])}"),
    (r"([\w.-]+)\s*=", lambda m: f"{m[1]} has no value; give it one, or leave the line out"),
    (r"([\w.-]+)\s*=\s*([-+]?\d+),(\d+)", lambda m: f"decimals have a point; write {m[1]} = {m[2]}.{m[3]}"),
    (r"([\w.-]+)\s*=\s*([-+.\d]+(?:,\s*[-+.\d]+)+)", lambda m: f"a list has brackets; write {m[1]} = [{m[2]}]"),
    (r"([\w.-]+)\s*=\s*([-+]?[\d.]+)\s*[^\W\d_].*", lambda m: f"a number has no unit; write {m[1]} = {m[2]}"),
    (r"([\w.-]+)\s*=\s*([^\W\d_][^\"'#]*)", lambda m: f'text has quotes; write {m[1]} = "{m[2].strip()}"'),
    (r"([\w.-]+)\s*=\s*\"([^\"]*\\[^\"]*)\"", lambda m: f"a text with \\ has single quotes; write {m[1]} = '{m[2]}'"),
    (r"([\w.-]+)\s*=\s*([\"'])[^\"']*", lambda m: f"the quotes are not closed; end the text with {m[2]}"),
    (r"([\w.-]+)\s*=\s*\[[^\]]*", lambda _: "the list is not closed; end it with ]"),
    (r"([\w.-]+)\s*[: ]\s*([^=]+)", lambda m: f"a key and its value have = between them; write {m[1]} = {m[2]}"),
)
"""Lines that are no TOML, and how they are written; the first that fits counts."""
SHIPPED_FOLDERS = {
    "rig": "rigs",
    "capsule": "capsules",
    "specimen": "specimens",
    "model": "models",
    "plan": "plans",
    "robot": "robots",
}


class Settings(BaseModel):
    """A frozen group of settings: unknown keys, NaN and infinities are refused."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        defer_build=True,
        allow_inf_nan=False,
        str_strip_whitespace=True,
        validate_default=True,
    )

    @field_validator("*", mode="after")
    @classmethod
    def _bounded_text(cls, value: object) -> object:
        """Refuse text that no run file can hold and no message can show."""
        if isinstance(value, str):
            if "\0" in value:
                raise ValueError("must not hold a zero byte")
            if len(value) > _MAX_TEXT_CHARACTERS:
                raise ValueError(f"must not be longer than {_MAX_TEXT_CHARACTERS} characters")
        return value


class GatheredSettings(Settings):
    """Settings whose further keys are gathered in their `parameters`."""

    @model_validator(mode="wrap")
    @classmethod
    def _gather_parameters(cls, data: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if not isinstance(data, Mapping):
            return handler(data)
        own = {key: value for key, value in data.items() if key in cls.model_fields}
        parameters = own.get("parameters", {})
        if len(own) < len(data) and isinstance(parameters, Mapping):
            own["parameters"] = {**parameters, **{key: value for key, value in data.items() if key not in own}}
        return handler(own)


def field_descriptions(model: type[BaseModel]) -> dict[str, str]:
    """Return the meaning of each key of a group of settings, as the string below it in the code says.

    Read when a form or a page asks: pydantic's `use_attribute_docstrings` reads it whenever the program starts, which
    takes as long as loading pydantic itself.
    """
    descriptions: dict[str, str] = {}
    for base in reversed(model.__mro__):
        definition = _class_definitions(base.__module__).get(base.__qualname__)
        for statement, below in pairwise(definition.body if definition is not None else ()):
            match statement, below:
                case ast.AnnAssign(target=ast.Name(key)), ast.Expr(ast.Constant(str(text))):
                    descriptions[key] = inspect.cleandoc(text)
    return {key: descriptions[key] for key in model.model_fields if key in descriptions}


@cache
def _class_definitions(module: str) -> dict[str, ast.ClassDef]:
    """Return the classes of a module by name; none where its source is not at hand, as in a session of Python."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (KeyError, OSError, TypeError):
        return {}
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


Table = dict[str, object]
ModelT = TypeVar("ModelT", bound=BaseModel)


def read_toml(path: Path) -> Table:
    """Read a TOML file; raises `SettingsError` when it cannot be read, is not text, or is not TOML."""
    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise SettingsError(f"{path}: larger than 4 MB, which no settings file is; check the path.")
        text = read_text(path)
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({error.strerror}); check the path.") from error
    except UnicodeDecodeError as error:
        raise SettingsError(f"{path}: is not UTF-8 text at byte {error.start}; save it as UTF-8.") from error
    return parse_toml(text, str(path))


def parse_toml(text: str, source: str) -> Table:
    """Return the table in a text; content of no settings is refused here, before anything walks through it.

    Raises `SettingsError` for a text that is not TOML, nested beyond `_MAX_NESTING`, or holds whole numbers beyond 64
    bits, which Python's own reader takes and TOML does not have.
    """
    too_deep = f"{source}: is nested too deeply to be settings."
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"{source}: is not valid TOML{_toml_mistake(text, str(error))}.") from error
    except RecursionError as error:
        raise SettingsError(too_deep) from error
    except ValueError as error:  # a whole number of thousands of digits
        raise SettingsError(f"{source}: holds a number that is too long: {error}.") from error
    level: list[object] = [table]
    for _ in range(_MAX_NESTING):
        if not level:
            return table
        if any(isinstance(value, int) and not -(2**63) <= value < 2**63 for value in level):
            raise SettingsError(f"{source}: holds a whole number of more than 64 bits, which TOML does not have.")
        level = [entry for value in level for entry in _members(value)]
    raise SettingsError(too_deep)


def _toml_mistake(text: str, reason: str) -> str:
    """Return where a text is no TOML, the line, and how it is written, as ", line 3, kind = drag: text has quotes"."""
    lines = [line.partition("#")[0].strip()[:_MAX_TEXT_CHARACTERS] for line in text.splitlines()]
    place = re.search(r"at line (\d+)", reason)
    last = min(int(place[1]) if place else len(lines), len(lines))
    if "overwrite" in reason or "twice" in reason:
        return f", line {last}, {lines[last - 1]:.60}: is there already; leave one of the two out"
    # A list or a text that is not closed is seen at what follows it.
    written = [number for number in range(last, 0, -1) if lines[number - 1]][:2]
    for number in written:
        line = lines[number - 1]
        fitting = ((re.fullmatch(pattern, line), say) for pattern, say in _TOML_MISTAKES)
        if not _is_toml(line) and (hint := next((say(found) for found, say in fitting if found is not None), "")):
            return f", line {number}, {line:.60}: {hint}"
    unclosed = "Unclosed" in reason
    parser = "what was opened above is not closed; end it with ]" if unclosed else re.sub(r"\s*\(at .*\)", "", reason)
    return f", line {written[0]}, {lines[written[0] - 1]:.60}: {parser}" if written else f": {parser}"


def _is_toml(line: str) -> bool:
    try:
        tomllib.loads(line)
    except (ValueError, RecursionError):
        return False
    return True


def _bracketed(line: str) -> str:
    name = line.strip("[] ")
    return f"[[{name}]]" if line.startswith("[[") or line.endswith("]]") else f"[{name}]"


def _members(value: object) -> Collection[object]:
    match value:
        case dict():
            return value.values()
        case list():
            return value
    return ()


def to_toml(settings: BaseModel) -> str:
    """Write settings as TOML text that `parse` reads back to an equal value; absent values are left out."""
    import tomli_w

    return tomli_w.dumps(settings.model_dump(mode="json", exclude_none=True))


def parse(model: type[ModelT], data: Mapping[str, object], source: str) -> ModelT:
    """Validate a table as `model`.

    Parameters
    ----------
    source
        Origin of the table for the error message: a path, or the changes as typed.

    Raises
    ------
    SettingsError
        With one sentence about the first mistake, and the number of others.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        needed = [key for key, field in model.model_fields.items() if field.is_required()]
        if not data and len(needed) > 1:
            raise SettingsError(f"{source}: is empty; it needs {' and '.join(needed)}.") from error
        raise SettingsError(describe_validation_error(error, model, source)) from error


def read_settings_file(model: type[ModelT], path: Path) -> ModelT:
    """Read and validate a settings file; raises `SettingsError`."""
    return parse(model, read_toml(path), str(path))


def describe_validation_error(error: ValidationError, model: type[BaseModel], source: str) -> str:
    """Return one sentence for a validation error: file, key, allowed values."""
    details = error.errors(include_url=False)
    # A list that lost an invalid member counts as too short as well; that is no second mistake.
    details = [detail for detail in details if detail["type"] != "too_short"] or details
    first = next((detail for detail in details if detail["type"] == "extra_forbidden"), details[0])
    sentence = f"{source}: {_describe_detail(first, model)}"
    if len(details) > 1:
        sentence += f" (and {len(details) - 1} more mistake{'s' if len(details) > 2 else ''})"
    return sentence if sentence.endswith(("?", ".")) else sentence + "."


def mistakes_in(model: type[BaseModel], data: Mapping[str, object]) -> dict[tuple[str, ...], str]:
    """Return the faults of a table, by the path of the key or group that it is about; () for the whole table."""
    try:
        model.model_validate(data)
    except ValidationError as error:
        details = error.errors(include_url=False)
        return {tuple(map(str, detail["loc"])): _message(detail) for detail in reversed(details)}
    return {}


def suggestion(word: str, known: Sequence[str]) -> str:
    """Return the end of an error message: the most similar known word, or all of them when none is similar."""
    return _nearest(word, known) or f"known are {', '.join(known)}."


def refuse_unknown(keywords: Iterable[str], known: Iterable[str]) -> None:
    """Raise `TypeError` for a keyword argument that nothing takes, with the most similar one that something does."""
    if unknown := sorted(set(keywords).difference(known)):
        raise TypeError(f"{unknown[0]} is not an argument; {suggestion(unknown[0], sorted(known))}")


def merge_tables(table: Mapping[str, object], changes: Mapping[str, object]) -> Table:
    """Return `table` with `changes` merged into it, table by table."""
    merged = dict(table)
    for key, value in changes.items():
        old = merged.get(key)
        merged[key] = merge_tables(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return merged


def parse_value(text: str) -> object:
    """Return the value of `--set key=value`: a TOML value, or else the text itself."""
    try:
        return parse_toml(f"value = {text}", "")["value"]
    except SettingsError:
        return text


def parse_assignment(text: str) -> tuple[tuple[str, ...], object]:
    """Split `a.b=3` into its path and its value; raises `SettingsError`."""
    key, equals, value = text.partition("=")
    path = tuple(part.strip() for part in key.split("."))
    if not equals or not all(path) or len(path) > _MAX_NESTING:
        raise SettingsError(f"{text}: is not of the form key=value, as in speed_mm_s=5.")
    return path, parse_value(value.strip())


def nested_table(path: Sequence[str], value: object) -> Table:
    """Return the table that holds `value` at `path`."""
    for key in reversed(path):
        value = {key: value}
    return value  # type: ignore[return-value]  # path has at least one key


def _describe_detail(detail: ErrorDetails, model: type[BaseModel]) -> str:
    location = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in detail["loc"])
    key = "".join(location).removeprefix(".")
    kind = detail["type"]
    if kind == "extra_forbidden":
        parent = _model_at(model, detail["loc"][:-1])
        known = sorted(parent.model_fields) if parent is not None else []
        return (
            f"{key} is not a known key; {suggestion(str(detail['loc'][-1]), known)}" if known else f"{key} is unknown"
        )
    if kind == "missing":
        return f"{key} is missing"
    if kind in {"tuple_type", "list_type"} and isinstance(detail["input"], Mapping):
        return f"{key} must be a list: begin each entry with [[{key}]]"
    message = _message(detail)
    if isinstance(detail["input"], Mapping):
        return f"{key}: {message}" if key else message  # about the table's keys among each other, which it names
    return f"{key} = {detail['input']!r:.60}: {message}" if key else message


def _message(detail: ErrorDetails) -> str:
    kind, value = detail["type"], str(detail["input"])
    if kind in _NO_NUMBER:
        return _no_number(value)
    if kind == "int_from_float":
        return "must be a whole number"
    if kind in {"literal_error", "enum"}:
        allowed = [word.strip("'") for word in re.split(r", | or ", str(detail["ctx"]["expected"]))]
        return f"is not one of {', '.join(allowed)}" + (f"; {near}" if (near := _nearest(value, allowed)) else "")
    if kind == "string_pattern_mismatch":
        plain = re.sub(r"[^\w.-]+", "-", value).strip("-") or "my-name"
        lower = "A-Z" not in detail["ctx"]["pattern"] and "\\w" not in detail["ctx"]["pattern"]
        return f"a name has letters, digits, . _ and - alone; write {plain.lower() if lower else plain}"
    if kind in _SENTENCES:
        return _SENTENCES[kind].format(**detail.get("ctx", {}))
    message = (
        detail["msg"]
        .replace("Input should be", "must be")
        .removeprefix("Value error, ")
        .removeprefix("Assertion failed, ")
    )
    return message[0].lower() + message[1:] if message[:1].isupper() and not message[1:2].isupper() else message


def _no_number(text: str) -> str:
    try:
        example = number_text(read_number(text))
    except SettingsError:
        number = re.match(r"\s*([-+]?\d+(?:[.,]\d+)?)\s*[^\W\d_%°]", text)
        return (
            f"is not a number; write {number[1].replace(',', '.')} alone"
            if number
            else "is not a number; write it as 12.5"
        )
    return f"is no number with a decimal point; write {example}"


def _nearest(word: str, known: Sequence[str]) -> str:
    close = get_close_matches(word, known, n=1, cutoff=0.5)
    return f"did you mean {close[0]}?" if close else ""


def _model_at(model: type[BaseModel], location: Sequence[int | str]) -> type[BaseModel] | None:
    """Return the model of the group at a place in a table, or None where there is none."""
    current: type[BaseModel] | None = model
    for part in location:
        if isinstance(part, int):
            continue
        if current is None or part not in current.model_fields:
            return None
        current = _model_in(current.model_fields[part].annotation)
    return current


def _model_in(annotation: object) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) in (Union, UnionType, tuple, list):
        for inner in get_args(annotation):
            if (model := _model_in(inner)) is not None:
                return model
    return None


def shipped_files(kind: str) -> dict[str, Traversable]:
    """Return the shipped files of a kind (rig, capsule, specimen, model, plan, robot), by name."""
    folder = resources.files("dragrig.config") / "files" / SHIPPED_FOLDERS[kind]
    files = {entry.name.removesuffix(".toml"): entry for entry in folder.iterdir() if entry.name.endswith(".toml")}
    return dict(sorted(files.items()))


def lab_plans(lab: Path) -> dict[str, Path]:
    """Return the plans in a lab folder and its folder `plans` by name: the files that have steps or cannot be read.

    A file with a mistake is still the plan of its name: a shipped one in its place would move the stage otherwise.
    """
    files = (path for folder in (lab, lab / "plans") for path in sorted(folder.glob("*.toml")))
    return {path.stem: path for path in files if _may_be_plan(path)}


def _may_be_plan(path: Path) -> bool:
    try:
        return "steps" in read_toml(path)
    except SettingsError:
        return True


def find_table(kind: str, name_or_path: str, beside: Path | None = None) -> tuple[Table, str]:
    """Read settings from a file (also relative to the folder `beside`) or by name: a plan of the lab, or shipped.

    Returns the table and its origin for error messages; raises `SettingsError` when there is neither.
    """
    path = Path(name_or_path)
    if path.suffix == ".toml" or len(path.parts) > 1:
        for candidate in (beside / path if beside is not None else path, path):
            if candidate.is_file():
                return read_toml(candidate), str(candidate)
        missing = "is a folder, not a file" if path.is_dir() else "there is no such file"
        raise SettingsError(f"{name_or_path}: {missing}; check the path.")
    rig_file = rig_file_of(Path()) if kind == "plan" else None
    own = {} if rig_file is None else lab_plans(rig_file.parent)
    if name_or_path in own:
        return read_toml(own[name_or_path]), str(own[name_or_path])
    shipped = shipped_files(kind)
    if name_or_path in shipped:
        return parse_toml(shipped[name_or_path].read_text("utf-8"), name_or_path), f"shipped {kind} {name_or_path}"
    if path.is_file():
        raise SettingsError(f"{name_or_path}: is a file whose name does not end in .toml, as one of a {kind} must.")
    missing = "is a folder" if path.is_dir() else "there is no such file"
    raise SettingsError(
        f"{name_or_path}: {missing} and no {kind} of this name; {suggestion(name_or_path, [*own, *shipped])}"
    )


def find_settings(model: type[ModelT], kind: str, name_or_path: str, beside: Path | None = None) -> ModelT:
    """Read settings from a file or by shipped name and validate them; raises `SettingsError`."""
    data, source = find_table(kind, name_or_path, beside)
    return parse(model, data, source)


def absolute_if_file(name_or_path: str) -> str:
    """Return a file as an absolute path, for processes with another working folder, and a name unchanged."""
    path = Path(name_or_path)
    is_name = not path.suffix and len(path.parts) < 2
    return str(path.absolute()) if path.is_file() and not is_name else name_or_path
