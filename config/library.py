"""Settings by name or by file: what ships, and what a person has."""

from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel

from dragrig.config.errors import SettingsError
from dragrig.config.loading import Table, nearest, parse, read_toml

ModelT = TypeVar("ModelT", bound=BaseModel)

FOLDERS = {"rig": "rigs", "capsule": "capsules", "specimen": "specimens", "model": "models", "plan": "plans"}


def shipped(kind: str) -> dict[str, Traversable]:
    """Return the shipped files of a kind (rig, capsule, specimen, model, plan), by name."""
    folder = resources.files("dragrig.config") / "files" / FOLDERS[kind]
    found = {entry.name.removesuffix(".toml"): entry for entry in folder.iterdir() if entry.name.endswith(".toml")}
    return dict(sorted(found.items()))


def table(kind: str, name_or_path: str, beside: Path | None = None) -> tuple[Table, str]:
    """Find settings and read them: a file first (also relative to `beside`), then a shipped name.

    Returns
    -------
    The table, and where it comes from, for error messages.

    Raises
    ------
    SettingsError
        When there is neither, naming the nearest shipped one.
    """
    import tomllib

    path = _file(name_or_path, beside)
    if path is not None:
        return read_toml(path), str(path)
    ships = shipped(kind)
    if name_or_path in ships:
        return tomllib.loads(ships[name_or_path].read_text("utf-8")), f"shipped {kind} {name_or_path}"
    raise SettingsError(
        f"{name_or_path}: there is no such file and no {kind} of this name; {nearest(name_or_path, list(ships))}"
    )


def find(model: type[ModelT], kind: str, name_or_path: str, beside: Path | None = None) -> ModelT:
    """Find settings by file or shipped name and validate them; raises `SettingsError`."""
    data, source = table(kind, name_or_path, beside)
    return parse(model, data, source)


def from_anywhere(name_or_path: str) -> str:
    """Return a name as it is, and a file so that a process with another working folder finds it."""
    path = Path(name_or_path)
    is_name = not path.suffix and len(path.parts) < 2
    return str(path.absolute()) if path.is_file() and not is_name else name_or_path


def _file(name_or_path: str, beside: Path | None) -> Path | None:
    if not name_or_path:
        return None
    given = Path(name_or_path)
    looks_like_a_file = given.suffix == ".toml" or len(given.parts) > 1
    if not looks_like_a_file:
        return None
    near = beside / given if beside is not None else given
    for candidate in (near, given):
        if candidate.is_file():
            return candidate
    raise SettingsError(f"{name_or_path}: there is no such file; check the path.")
