"""TOML in and out, with errors that name file, key and what is allowed."""

import tomllib
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from types import UnionType
from typing import TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from dragrig.config.errors import SettingsError

Table = dict[str, object]
ModelT = TypeVar("ModelT", bound=BaseModel)

_LARGEST_FILE = 4 * 1024 * 1024
_SHAPES = {
    "model_type": "a table of keys",
    "dict_type": "a table of keys",
    "mapping_type": "a table of keys",
    "list_type": "a list",
    "tuple_type": "a list",
}


def read_toml(path: Path) -> Table:
    """Read a TOML file.

    Raises
    ------
    SettingsError
        When it cannot be read, is not text, or is not TOML.
    """
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise SettingsError(f"{path}: larger than 4 MB, which no settings file is; check the path.")
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise SettingsError(f"{path}: cannot be read ({error.strerror}); check the path.") from error
    except UnicodeDecodeError as error:
        raise SettingsError(f"{path}: is not UTF-8 text at byte {error.start}; save it as UTF-8.") from error
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"{path}: is not valid TOML: {error}.") from error
    except RecursionError as error:
        raise SettingsError(f"{path}: is nested too deeply to be a settings file.") from error


def to_toml(settings: BaseModel) -> str:
    """Write settings as TOML text that `parse` reads back to an equal value; absent values are left out."""
    import tomli_w

    return tomli_w.dumps(settings.model_dump(mode="json", exclude_none=True))


def parse(model: type[ModelT], data: Mapping[str, object], source: str) -> ModelT:
    """Validate a table as `model`.

    Parameters
    ----------
    source
        Where the table comes from, for the error message: a path, or `--set`.

    Raises
    ------
    SettingsError
        One sentence about the first thing that is wrong, and how many more there are.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise SettingsError(describe(error, model, source)) from error


def load(model: type[ModelT], path: Path) -> ModelT:
    """Read and validate a settings file; raises `SettingsError`."""
    return parse(model, read_toml(path), str(path))


def describe(error: ValidationError, model: type[BaseModel], source: str) -> str:
    """One sentence for a validation error: file, key, what is allowed."""
    details = error.errors(include_url=False)
    # A list that lost a broken member counts as too short; that is no second mistake.
    details = [one for one in details if one["type"] != "too_short"] or details
    first = next((one for one in details if one["type"] == "extra_forbidden"), details[0])
    sentence = f"{source}: {_describe_one(first, model)}"
    if len(details) > 1:
        sentence += f" (and {len(details) - 1} more mistake{'s' if len(details) > 2 else ''})"
    return sentence if sentence.endswith(("?", ".")) else sentence + "."


def nearest(word: str, known: Sequence[str]) -> str:
    """End a sentence with the nearest known word, or with all of them when none is near."""
    close = get_close_matches(word, known, n=1, cutoff=0.5)
    if close:
        return f"did you mean {close[0]}?"
    return f"known are {', '.join(known)}."


def merge(table: Mapping[str, object], changes: Mapping[str, object]) -> Table:
    """Return `table` with `changes` laid over it, table by table."""
    merged = dict(table)
    for key, value in changes.items():
        below = merged.get(key)
        merged[key] = merge(below, value) if isinstance(below, Mapping) and isinstance(value, Mapping) else value
    return merged


def parse_value(text: str) -> object:
    """Read the right side of `--set key=value`: a TOML value, or else the text itself."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def parse_assignment(text: str) -> tuple[tuple[str, ...], object]:
    """Split `a.b=3` into its path and its value; raises `SettingsError`."""
    key, equals, value = text.partition("=")
    path = tuple(part.strip() for part in key.split("."))
    if not equals or not all(path):
        raise SettingsError(f"--set {text}: is not of the form key=value, as in speed_mm_s=5.")
    return path, parse_value(value.strip())


def nested(path: Sequence[str], value: object) -> Table:
    """Return the table that holds `value` at `path`."""
    for key in reversed(path):
        value = {key: value}
    return value  # type: ignore[return-value]  # path has at least one key


def _describe_one(detail: ErrorDetails, model: type[BaseModel]) -> str:
    key = _spell(detail["loc"])
    kind = detail["type"]
    if kind == "extra_forbidden":
        parent = _model_at(model, detail["loc"][:-1])
        known = sorted(parent.model_fields) if parent is not None else []
        return f"{key} is not a known key; {nearest(str(detail['loc'][-1]), known)}" if known else f"{key} is unknown"
    if kind == "missing":
        return f"{key} is missing"
    if kind in _SHAPES:
        return f"{key} must be {_SHAPES[kind]}, and is {detail['input']!r:.60}"
    message = detail["msg"].removeprefix("Value error, ").removeprefix("Assertion failed, ")
    message = message[0].lower() + message[1:] if message[:1].isupper() and not message[1:2].isupper() else message
    if isinstance(detail["input"], Mapping):
        return f"{key}: {message}" if key else message  # about the table's keys among each other, which it names
    return f"{key} = {detail['input']!r:.60}: {message}" if key else message


def _spell(location: Sequence[int | str]) -> str:
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def _model_at(model: type[BaseModel], location: Sequence[int | str]) -> type[BaseModel] | None:
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
            found = _model_in(inner)
            if found is not None:
                return found
    return None
