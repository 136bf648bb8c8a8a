"""Values as JSON knows them: dataclasses become objects, NaN and infinities null."""

from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from datetime import date
from math import isfinite
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dragrig.analysis.estimates import Exclusion


def to_json_object(values: Mapping[str, object]) -> dict[str, object]:
    """Return named values as a JSON object, without any NaN or infinity."""
    return {name: to_json_value(value) for name, value in values.items()}


def to_json_value(value: object) -> object:
    """Turn a value into what JSON knows; what is neither a number, a text nor a collection becomes its text."""
    if hasattr(value, "tolist"):  # NumPy scalars and arrays, without importing NumPy
        value = value.tolist()
    match value:
        case Mapping():
            return {str(key): to_json_value(item) for key, item in value.items()}
        case list() | tuple() | set() | frozenset():
            return [to_json_value(item) for item in value]
        case _ if is_dataclass(value):
            return {item.name: to_json_value(getattr(value, item.name)) for item in fields(value)}
        case _:
            return _scalar(value)


def _scalar(value: object) -> str | float | bool | None:
    match value:
        case float():
            return value if isfinite(value) else None
        case None | bool() | int():
            return value
        case date():
            return value.isoformat()
        case _:
            return str(value)


def exclusions_json(left_out: "Iterable[Exclusion]") -> list[dict[str, object]]:
    """Return what was left out, and why."""
    return [{"what": exclusion.item, "reason": exclusion.reason} for exclusion in left_out]
