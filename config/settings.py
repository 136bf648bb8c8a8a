"""Settings: the common base class, TOML in and out, and lookup by file or shipped name.

A validation error is one sentence that names the file, the key and what is allowed.
"""

import ast
import inspect
import sys
import tomllib
from collections.abc import Collection, Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from itertools import pairwise
from pathlib import Path
from types import UnionType
from typing import TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator
from pydantic_core import ErrorDetails

from dragrig.config.errors import NO_TEXT, SettingsError
from dragrig.config.typed_numbers import number_text, read_number

_MAX_FILE_BYTES = 4 * 1024 * 1024
_MAX_TEXT_CHARACTERS = 4096
_MAX_NESTING = 32
"""Lists and tables within each other."""
_NO_NUMBER = frozenset({"float_parsing", "int_parsing"})
_EXPECTED_SHAPES = {
    "model_type": "a table of keys",
    "dict_type": "a table of keys",
    "mapping_type": "a table of keys",
    "list_type": "a list",
    "tuple_type": "a list",
}
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
        """Refuse what no run file can hold and no message can show."""
        if isinstance(value, str):
            if "\0" in value:
                raise ValueError("must not hold a zero byte")
            if len(value) > _MAX_TEXT_CHARACTERS:
                raise ValueError(f"must not be longer than {_MAX_TEXT_CHARACTERS} characters")
        return value


def field_descriptions(model: type[BaseModel]) -> dict[str, str]:
    """Return what each key of a group of settings is, as the string below it in the code says.

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
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({error.strerror}); check the path.") from error
    except UnicodeDecodeError as error:
        raise SettingsError(f"{path}: is not UTF-8 text at byte {error.start}; save it as UTF-8.") from error
    return parse_toml(text, str(path))


def parse_toml(text: str, source: str) -> Table:
    """Return the table in a text; what no settings hold is refused here, before anything walks through it.

    Raises `SettingsError` for what is not TOML, nested beyond `_MAX_NESTING`, or holds whole numbers beyond 64 bits,
    which Python's own reader takes and TOML does not have.
    """
    too_deep = f"{source}: is nested too deeply to be settings."
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"{source}: is not valid TOML: {error}.") from error
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
        raise SettingsError(describe_validation_error(error, model, source)) from error


def read_settings_file(model: type[ModelT], path: Path) -> ModelT:
    """Read and validate a settings file; raises `SettingsError`."""
    return parse(model, read_toml(path), str(path))


def describe_validation_error(error: ValidationError, model: type[BaseModel], source: str) -> str:
    """Return one sentence for a validation error: file, key, what is allowed."""
    details = error.errors(include_url=False)
    # A list that lost an invalid member counts as too short as well; that is no second mistake.
    details = [detail for detail in details if detail["type"] != "too_short"] or details
    first = next((detail for detail in details if detail["type"] == "extra_forbidden"), details[0])
    sentence = f"{source}: {_describe_detail(first, model)}"
    if len(details) > 1:
        sentence += f" (and {len(details) - 1} more mistake{'s' if len(details) > 2 else ''})"
    return sentence if sentence.endswith(("?", ".")) else sentence + "."


def mistakes_in(model: type[BaseModel], data: Mapping[str, object]) -> dict[tuple[str, ...], str]:
    """Return what is wrong in a table, by the path of the key or group that it is about; () for the whole table."""
    try:
        model.model_validate(data)
    except ValidationError as error:
        details = error.errors(include_url=False)
        return {tuple(map(str, detail["loc"])): _message(detail) for detail in reversed(details)}
    return {}


def suggestion(word: str, known: Sequence[str]) -> str:
    """Return the end of an error message: the most similar known word, or all of them when none is similar."""
    close = get_close_matches(word, known, n=1, cutoff=0.5)
    if close:
        return f"did you mean {close[0]}?"
    return f"known are {', '.join(known)}."


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
    if kind in _EXPECTED_SHAPES:
        return f"{key} must be {_EXPECTED_SHAPES[kind]}, and is {detail['input']!r:.60}"
    message = _message(detail)
    if isinstance(detail["input"], Mapping):
        return f"{key}: {message}" if key else message  # about the table's keys among each other, which it names
    return f"{key} = {detail['input']!r:.60}: {message}" if key else message


def _message(detail: ErrorDetails) -> str:
    if detail["type"] == "string_unicode":
        return NO_TEXT
    if detail["type"] in _NO_NUMBER:
        return _no_number(str(detail["input"]))
    message = detail["msg"].removeprefix("Value error, ").removeprefix("Assertion failed, ")
    return message[0].lower() + message[1:] if message[:1].isupper() and not message[1:2].isupper() else message


def _no_number(text: str) -> str:
    try:
        example = number_text(read_number(text))
    except SettingsError:
        return "is not a number; write it as 12.5"
    return f"is no number with a decimal point; write {example}"


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


def find_table(kind: str, name_or_path: str, beside: Path | None = None) -> tuple[Table, str]:
    """Read settings from a file (also relative to the folder `beside`) or by shipped name.

    Returns the table and its origin for error messages; raises `SettingsError` when there is neither.
    """
    path = Path(name_or_path)
    if path.suffix == ".toml" or len(path.parts) > 1:
        for candidate in (beside / path if beside is not None else path, path):
            if candidate.is_file():
                return read_toml(candidate), str(candidate)
        missing = "is a folder, not a file" if path.is_dir() else "there is no such file"
        raise SettingsError(f"{name_or_path}: {missing}; check the path.")
    shipped = shipped_files(kind)
    if name_or_path in shipped:
        return parse_toml(shipped[name_or_path].read_text("utf-8"), name_or_path), f"shipped {kind} {name_or_path}"
    if path.is_file():
        raise SettingsError(f"{name_or_path}: is a file whose name does not end in .toml, as one of a {kind} must.")
    missing = "is a folder" if path.is_dir() else "there is no such file"
    raise SettingsError(
        f"{name_or_path}: {missing} and no {kind} of this name; {suggestion(name_or_path, list(shipped))}"
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
