"""Making a lab folder."""

from collections.abc import Iterator
from pathlib import Path

import tomli_w

from dragrig.config.errors import OutputError
from dragrig.config.rig import CALIBRATION_FILE, RIG_FILE, RigSettings
from dragrig.config.settings import Settings, find_settings


def create_lab(folder: Path) -> tuple[Path, ...]:
    """Make a lab folder: rig settings to edit, an empty calibration history and the data root.

    Returns
    -------
    The paths made.

    Raises
    ------
    OutputError
        When `folder` cannot be written or is a lab folder already; nothing is replaced.
    """
    rig = find_settings(RigSettings, "rig", "bench")
    rig_file, history, root = folder / RIG_FILE, folder / CALIBRATION_FILE, folder / rig.data.root
    for existing in (path for path in (rig_file, history) if path.exists()):
        raise OutputError(f"{existing}: exists already and is not changed; name another folder.")
    try:
        root.mkdir(parents=True, exist_ok=True)
        with history.open("x", encoding="utf-8"), rig_file.open("x", encoding="utf-8", newline="\n") as text:
            text.write(commented_toml(rig))
    except OSError as error:
        raise OutputError(f"{folder}: no lab folder can be made here ({error.strerror}); name another.") from error
    return rig_file, history, root


def commented_toml(settings: Settings) -> str:
    """Write settings as TOML, every key below a comment with its description."""
    return "\n".join(_commented_lines(settings, (), (type(settings).__doc__ or "").splitlines()[0])) + "\n"


def _commented_lines(settings: Settings, path: tuple[str, ...], about: str) -> Iterator[str]:
    yield f"# {about}"
    if path:
        yield f"[{'.'.join(path)}]"
    values = settings.model_dump(mode="json", exclude_none=True)
    below: dict[str, Settings] = {}
    for key, field in type(settings).model_fields.items():
        value = getattr(settings, key)
        if isinstance(value, Settings):
            below[key] = value
        elif key in values:
            if field.description:
                yield f"# {' '.join(field.description.split())}"
            yield tomli_w.dumps({key: values[key]}).strip()
    for key, inner in below.items():
        yield ""
        yield from _commented_lines(inner, (*path, key), (type(inner).__doc__ or "").splitlines()[0])
