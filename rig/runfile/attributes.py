"""Attributes as they come out of a file, checked against the layout."""

import math
from collections.abc import Mapping
from datetime import datetime
from uuid import UUID

import h5py
import numpy as np

from dragrig.rig.runfile import schema
from dragrig.rig.runfile.model import Attribute, Status

LONGEST_LIST = 256
"""An attribute with more values than this is damaged; asking for them could take all memory."""
LARGEST_VALUE_BYTES = 1 << 16
SCALAR_CLASSES = frozenset({h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.STRING, h5py.h5t.ENUM})


class LayoutError(ValueError):
    """A file that breaks the layout; the message names the place, its reader names the file."""


def group_at(file: h5py.File, path: str) -> h5py.Group:
    """Return a group that must exist."""
    found = file.get(path)
    if not isinstance(found, h5py.Group):
        raise LayoutError(f"the group {path} is missing")
    return found


def dataset_at(file: h5py.File, path: str) -> h5py.Dataset:
    """Return a dataset that must exist."""
    found = file.get(path)
    if not isinstance(found, h5py.Dataset):
        raise LayoutError(f"the dataset {path} is missing")
    return found


def attributes_of(holder: h5py.Group | h5py.Dataset) -> dict[str, Attribute]:
    """Return all attributes as plain Python values; a list becomes comma-separated text."""
    return {str(name): attribute_of(holder, name) for name in holder.attrs}


def attribute_of(holder: h5py.Group | h5py.Dataset, name: str) -> Attribute:
    """Return one attribute as a plain Python value."""
    attribute = holder.attrs.get_id(name)
    shape, kind = attribute.shape, attribute.get_type()
    if shape is not None and math.prod(shape) > LONGEST_LIST:
        raise LayoutError(f"the attribute {name} of {holder.name} claims {math.prod(shape)} values")
    if kind.get_class() not in SCALAR_CLASSES or kind.get_size() > LARGEST_VALUE_BYTES:
        raise LayoutError(f"the attribute {name} of {holder.name} is neither text nor number")
    return plain(holder.attrs[name])


def plain(value: object) -> Attribute:
    """Turn what h5py returns for an attribute into text, a number or a truth value."""
    if isinstance(value, h5py.Empty):
        return ""
    if isinstance(value, np.ndarray):
        items = value.ravel().tolist()
        return plain(items[0]) if len(items) == 1 else ", ".join(str(plain(item)) for item in items)
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value if isinstance(value, str | float | int | bool) else str(value)


def checked_attributes(file: h5py.File, path: str) -> dict[str, Attribute]:
    """Return the attributes of a group after making sure that those the layout asks for are there and fit."""
    found = attributes_of(file["/"] if path == "/" else group_at(file, path))
    for name, fixed in schema.FIXED_ATTRIBUTES.get(path, {}).items():
        if name not in found:
            raise LayoutError(f"{path} lacks the attribute {name}")
        if found[name] != fixed:
            raise LayoutError(f"the attribute {name} of {path} is {found[name]!r} instead of {fixed!r}")
    check_attributes(path, found)
    return found


def check_attributes(path: str, found: Mapping[str, Attribute]) -> None:
    """Make sure that a group has the attributes that the layout asks of it, each of the right type."""
    for name, kind in schema.REQUIRED_ATTRIBUTES.get(path, {}).items():
        if name not in found:
            raise LayoutError(f"{path} lacks the attribute {name}")
        check_type(path, name, found[name], kind)
    if path == schema.PROTOCOL:
        for name in schema.PARAMETERS_OF_KIND.get(str(found["kind"]), ()):
            if name not in found:
                raise LayoutError(f"{path} lacks the attribute {name}, which the kind {found['kind']} needs")
            check_type(path, name, found[name], float)


def check_type(path: str, name: str, value: Attribute, kind: type) -> None:
    """Make sure that an attribute is text, a whole number or a number that is not infinite."""
    if kind is str:
        fits = isinstance(value, str) and bool(value)
    elif kind is int:
        fits = isinstance(value, int) and not isinstance(value, bool) and value >= 0
    else:
        fits = isinstance(value, int | float) and not isinstance(value, bool) and not math.isinf(value)
    if not fits:
        wanted = {str: "text", int: "a whole number from 0", float: "a number"}[kind]
        raise LayoutError(f"the attribute {name} of {path} is {value!r} instead of {wanted}")


def positive_rate(value: Attribute) -> float:
    """Return a sample rate [Hz]."""
    rate = float(value)
    if not (math.isfinite(rate) and rate > 0):
        raise LayoutError(f"the attribute sample_rate_hz of {schema.TRACE} is {rate} instead of a positive number")
    return rate


def moment(name: str, value: Attribute) -> datetime:
    """Return a time of day that must carry its offset."""
    try:
        parsed = datetime.fromisoformat(str(value))
    except ValueError:
        parsed = None
    if parsed is None or parsed.tzinfo is None:
        raise LayoutError(f"the attribute {name} of /entry is {value!r} instead of an ISO 8601 time with its offset")
    return parsed


def one_of(path: str, name: str, value: Attribute, allowed: tuple[str, ...]) -> str:
    """Return a text that must be one of a few."""
    if value not in allowed:
        raise LayoutError(f"the attribute {name} of {path} is {value!r} instead of one of {', '.join(allowed)}")
    return str(value)


def status_of(value: Attribute) -> Status:
    """Return how a run ended."""
    return Status(one_of(schema.ENTRY, "status", value, tuple(Status)))


def run_id_of(value: Attribute) -> str:
    """Return a run's identity, which must be a UUID."""
    try:
        UUID(str(value))
    except ValueError:
        raise LayoutError(f"the attribute run_id of /entry is {value!r} instead of a UUID") from None
    return str(value)
