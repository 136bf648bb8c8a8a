"""Matplotlib figures as PNG or SVG files and as inline SVG elements of a page; equal figures give equal bytes."""

import io
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from xml.etree import ElementTree as ET
from zlib import crc32

from markupsafe import Markup
from matplotlib.figure import Figure

from dragrig.config.errors import OutputError
from dragrig.present.document import InlineFigure
from dragrig.present.drawing import figure_style
from dragrig.rig.runfile.filesystem import remove_quietly

FORMATS = {".png": {"Software": "dragrig"}, ".svg": {"Date": None, "Creator": "dragrig"}}
"""Endings of files that can be written, and what such a file says of itself: never when it was made."""


def save_figure(figure: Figure, path: Path, overwrite: bool = False) -> Path:
    """Write a picture as PNG or SVG, by its name's ending, and return the path.

    Raises
    ------
    OutputError
        When the ending is another one, the file exists and may not be replaced, or the folder cannot be written to.
    """
    ending = path.suffix.lower()
    if ending not in FORMATS:
        raise OutputError(f"{path}: a picture is written as {' or '.join(FORMATS)}; change the name's ending.")
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: is there already; choose another name or say --overwrite.")
    content = io.BytesIO()
    with figure_style():
        figure.savefig(content, format=ending[1:], metadata=FORMATS[ending])
    try:
        _write_whole(content.getvalue(), path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose a folder that can.") from error
    return path


def save_figure_in(folder: Path, name: str, figure: Figure, overwrite: bool = False) -> Path:
    """Write a picture under a name that nobody chose: where it is taken, a number is added to it.

    The folder is made if there is none. Raises as `save_figure` does.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise OutputError(f"{folder}: is a file; name a folder for the pictures.") from error
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror}); choose another folder.") from error
    path = folder / name
    return save_figure(figure, path if overwrite else _unused_path(path), overwrite)


def _unused_path(path: Path) -> Path:
    names = (path if number == 1 else path.with_stem(f"{path.stem}-{number}") for number in count(1))
    return next(name for name in names if not name.exists())


def _write_whole(content: bytes, path: Path) -> None:
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        unfinished.write_bytes(content)
        unfinished.replace(path)
    finally:
        remove_quietly(unfinished)


_NAMESPACE = re.compile(r"\{[^}]*\}")
_REFERENCE = re.compile(r"#([\w.:-]+)")
_GLYPH = re.compile(r"[A-Za-z]+[\w-]*-[0-9a-f]+$")
_NUMBER = re.compile(r"-?\d+\.\d+")
_LINE = re.compile(r"M -?[\d.]+ -?[\d.]+\s*(?:[ML] -?[\d.]+ -?[\d.]+\s*)*")
_POINT = re.compile(r"([ML]) (-?[\d.]+) (-?[\d.]+)")
_NUMERIC_ATTRIBUTES = frozenset({"x", "y", "width", "height", "viewBox", "points", "transform"})
"""Attributes that hold nothing but numbers."""


@dataclass(frozen=True, slots=True)
class InlineSvg:
    """A figure as an element of a page, and the letters it is written with, which a page defines once.

    Attributes
    ----------
    element
        The `svg` element.
    glyphs
        Outlines of letters by their id; equal ids are equal letters in every figure.
    """

    element: str
    glyphs: Mapping[str, str]


def inline_svg(text: str, shows: str) -> InlineSvg:
    """Return an SVG as an element of an HTML page.

    Metadata, styles and ids that nothing refers to are left out; the other ids begin with what tells this figure from
    others. Lines are written from point to point, to a tenth of a unit. What the figure shows is said to those who
    cannot see it.

    Parameters
    ----------
    text
        A whole SVG document, as matplotlib writes it with letters as paths.
    shows
        What is to be seen.
    """
    root = ET.fromstring(text)  # noqa: S314  # our own figure
    _strip_metadata(root)
    wanted = {name for one in root.iter() for value in one.attrib.values() for name in _REFERENCE.findall(value)}
    key = f"f{crc32(text.encode()):08x}-"
    for one in root.iter():
        _shorten_attributes(one, key, wanted)
    glyphs = dict(_extract_glyphs(root))
    size = root.attrib["viewBox"]
    root.attrib.clear()
    root.attrib.update({"viewBox": size, "role": "img", "aria-label": shows})
    return InlineSvg(_serialise(root), glyphs)


def _extract_glyphs(root: ET.Element) -> Iterator[tuple[str, str]]:
    for parent in root.iter("defs"):
        for child in list(parent):
            name = child.get("id", "")
            if _GLYPH.match(name):
                parent.remove(child)
                yield name, _serialise(child)


def _serialise(one: ET.Element) -> str:
    return ET.tostring(one, encoding="unicode").replace(" />", "/>")


def _strip_metadata(root: ET.Element) -> None:
    for one in list(root.iter()):
        one.tag = _NAMESPACE.sub("", one.tag)
        one.attrib = {_NAMESPACE.sub("", name): value for name, value in one.attrib.items()}
        one.text = one.text.strip() if one.text else None
        one.tail = None
        for child in list(one):
            if _NAMESPACE.sub("", str(child.tag)) in {"metadata", "style"}:
                one.remove(child)


def _shorten_attributes(one: ET.Element, key: str, wanted: set[str]) -> None:
    for name, value in list(one.attrib.items()):
        if name == "id":
            if value in wanted:
                one.set(name, _prefix_id(value, key))
            else:
                del one.attrib[name]
        elif name == "d":
            one.set(name, _short_path(value))
        elif name in _NUMERIC_ATTRIBUTES:
            one.set(name, _NUMBER.sub(_three_decimals, value))
        elif "#" in value:
            one.set(name, _prefix_references(value, key, wanted))


def _prefix_references(value: str, key: str, wanted: set[str]) -> str:
    if not value.startswith(("#", "url(#")):
        return value
    return _REFERENCE.sub(lambda found: f"#{_prefix_id(found[1], key)}" if found[1] in wanted else found[0], value)


def _prefix_id(name: str, key: str) -> str:
    return name if _GLYPH.match(name) else key + name


def _short_path(data: str) -> str:
    short = _LINE.sub(lambda found: _relative_polyline(found[0]), _NUMBER.sub(_three_decimals, data))
    return " ".join(short.split())


def _relative_polyline(line: str) -> str:
    """Write a line from point to point, in tenths, without steps that do not move."""
    points = [(kind, round(10 * float(x)), round(10 * float(y))) for kind, x, y in _POINT.findall(line)]
    written, pen = "", (0, 0)
    for kind, x, y in points:
        if kind == "M":
            written += f"M{_point_text(x, y)}l"
        elif (x, y) != pen or written.endswith("l"):
            step = _point_text(x - pen[0], y - pen[1])
            written += step if written.endswith("l") or step.startswith("-") else f" {step}"
        pen = x, y
    return written.removesuffix("l")


def _point_text(x: int, y: int) -> str:
    second = _tenths_text(y)
    return _tenths_text(x) + (second if second.startswith("-") else f" {second}")


def _tenths_text(value: int) -> str:
    return re.sub(r"^(-?)0\.", r"\1.", f"{value / 10:g}")


def _three_decimals(found: re.Match[str]) -> str:
    return f"{float(found[0]):.3f}".rstrip("0").rstrip(".")


def inline_figure(figure: Figure, shows: str, caption: str) -> InlineFigure:
    """Return a figure as SVG, sharp at any size and on paper; the same figure gives the same SVG."""
    content = io.BytesIO()
    with figure_style():
        figure.savefig(content, format="svg", metadata=FORMATS[".svg"])
    drawn = inline_svg(content.getvalue().decode("utf-8"), shows)
    return InlineFigure(Markup(drawn.element), caption, drawn.glyphs)  # noqa: S704  # serialised by ElementTree
