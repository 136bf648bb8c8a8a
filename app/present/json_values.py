"""Values as JSON knows them: dataclasses become objects, NaN and infinities null."""

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from datetime import date


def to_json_value(value: object) -> object:
    """Turn a value into what JSON knows: dataclasses become objects, NaN and infinities null, the rest its text."""
    if hasattr(value, "tolist"):  # NumPy scalars and arrays, without importing NumPy
        value = value.tolist()
    match value:
        case Mapping():
            return {str(key): to_json_value(one) for key, one in value.items()}
        case list() | tuple() | set() | frozenset():
            return [to_json_value(one) for one in value]
        case _ if is_dataclass(value):
            return {one.name: to_json_value(getattr(value, one.name)) for one in fields(value)}
        case _:
            return _json_scalar(value)


def _json_scalar(value: object) -> str | float | bool | None:
    match value:
        case float():
            return value if math.isfinite(value) else None
        case None | bool() | int():
            return value
        case date():
            return value.isoformat()
        case _:
            return str(value)
