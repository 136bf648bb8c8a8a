"""A figure's SVG made fit to stand in a page: without what a page has once, and as short as it looks the same."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from xml.etree import ElementTree as ET
from zlib import crc32

_NAMESPACE = re.compile(r"\{[^}]*\}")
_REFERENCE = re.compile(r"#([\w.:-]+)")
_GLYPH = re.compile(r"[A-Za-z]+[\w-]*-[0-9a-f]+$")
_NUMBER = re.compile(r"-?\d+\.\d+")
_LINE = re.compile(r"M -?[\d.]+ -?[\d.]+\s*(?:[ML] -?[\d.]+ -?[\d.]+\s*)*")
_POINT = re.compile(r"([ML]) (-?[\d.]+) (-?[\d.]+)")
_KEPT_HERE = frozenset({"x", "y", "width", "height", "viewBox", "points", "transform"})
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
    _bare(root)
    wanted = {name for one in root.iter() for value in one.attrib.values() for name in _REFERENCE.findall(value)}
    key = f"f{crc32(text.encode()):08x}-"
    for one in root.iter():
        _shorten(one, key, wanted)
    glyphs = dict(_taken_out(root))
    size = root.attrib["viewBox"]
    root.attrib.clear()
    root.attrib.update({"viewBox": size, "role": "img", "aria-label": shows})
    return InlineSvg(_written(root), glyphs)


def _taken_out(root: ET.Element) -> Iterator[tuple[str, str]]:
    for parent in root.iter("defs"):
        for child in list(parent):
            name = child.get("id", "")
            if _GLYPH.match(name):
                parent.remove(child)
                yield name, _written(child)


def _written(one: ET.Element) -> str:
    return ET.tostring(one, encoding="unicode").replace(" />", "/>")


def _bare(root: ET.Element) -> None:
    for one in list(root.iter()):
        one.tag = _NAMESPACE.sub("", one.tag)
        one.attrib = {_NAMESPACE.sub("", name): value for name, value in one.attrib.items()}
        one.text = one.text.strip() if one.text else None
        one.tail = None
        for child in list(one):
            if _NAMESPACE.sub("", str(child.tag)) in {"metadata", "style"}:
                one.remove(child)


def _shorten(one: ET.Element, key: str, wanted: set[str]) -> None:
    for name, value in list(one.attrib.items()):
        if name == "id":
            if value in wanted:
                one.set(name, _named(value, key))
            else:
                del one.attrib[name]
        elif name == "d":
            one.set(name, _path(value))
        elif name in _KEPT_HERE:
            one.set(name, _NUMBER.sub(_three_places, value))
        elif "#" in value:
            one.set(name, _referring(value, key, wanted))


def _referring(value: str, key: str, wanted: set[str]) -> str:
    if not value.startswith(("#", "url(#")):
        return value
    return _REFERENCE.sub(lambda found: f"#{_named(found[1], key)}" if found[1] in wanted else found[0], value)


def _named(name: str, key: str) -> str:
    return name if _GLYPH.match(name) else key + name


def _path(data: str) -> str:
    short = _LINE.sub(lambda found: _relative(found[0]), _NUMBER.sub(_three_places, data))
    return " ".join(short.split())


def _relative(line: str) -> str:
    """Write a line from point to point, in tenths, without steps that do not move."""
    points = [(kind, round(10 * float(x)), round(10 * float(y))) for kind, x, y in _POINT.findall(line)]
    written, pen = "", (0, 0)
    for kind, x, y in points:
        if kind == "M":
            written += f"M{_pair(x, y)}l"
        elif (x, y) != pen or written.endswith("l"):
            step = _pair(x - pen[0], y - pen[1])
            written += step if written.endswith("l") or step.startswith("-") else f" {step}"
        pen = x, y
    return written.removesuffix("l")


def _pair(x: int, y: int) -> str:
    second = _tenths(y)
    return _tenths(x) + (second if second.startswith("-") else f" {second}")


def _tenths(value: int) -> str:
    return re.sub(r"^(-?)0\.", r"\1.", f"{value / 10:g}")


def _three_places(found: re.Match[str]) -> str:
    return f"{float(found[0]):.3f}".rstrip("0").rstrip(".")
