"""Documents as HTML pages: single files with their figures inside, which need no network."""

import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from hashlib import sha256
from itertools import pairwise
from pathlib import Path
from shlex import join
from typing import TYPE_CHECKING, cast
from xml.etree import ElementTree as ET
from zlib import crc32

import numpy as np
import numpy.typing as npt
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from dragrig import present
from dragrig.analysis import Comparison, Identification, count_text, printable
from dragrig.present import Document, figure_form, svg_text
from dragrig.rig import AnyFloatArray, Campaign, Run, read_campaign, read_info, software_version

if TYPE_CHECKING:
    from dragrig.analysis.gap import Diagnosis

_NO_BREAK = re.compile(
    r"(?<=\d) (?=(?:%|‰|mm|mN|kPa|Pa|ms|s|µm|Hz|g)(?!\w))|(?<=[=<±′×]) (?=[\d−-])|(?<=\w) (?=[=<±×] )"
)
_APOSTROPHE = re.compile(r"(?<=\w)'(?=\w)")
_CODE = re.compile(r"`([^`]+)`")


def render_page(document: Document, *sources: str | Path) -> str:
    """Return a document as one HTML page, which says by which command and of which campaigns and runs it was made."""
    with figure_form(document.figure_form):
        figures = {figure.name: inline_svg(svg_text(figure), figure.shows) for figure in document.figures()}
    glyphs = {name: path for figure in figures.values() for name, path in figure.glyphs.items()}
    return render_template(
        "document.html",
        {
            "title": document.title,
            "document": document,
            "kind_of": lambda block: type(block).__name__.lower(),
            "drawings": {name: _markup(figure.element) for name, figure in figures.items()},
            "glyphs": _markup("".join(glyphs.values())),
            "origin": tuple(
                filter(None, (f"written {datetime.now().astimezone():%Y-%m-%d}", _command(), _checksum_text(sources)))
            ),
        },
    )


def _command() -> str:
    """Return the command that runs, between backticks; nothing in a program of one's own."""
    program, *arguments = sys.argv or [""]
    return f"`{join(['dragrig', *arguments])}`" if Path(program).stem == "dragrig" else ""


def _checksum_text(sources: Iterable[str | Path]) -> str:
    """Return one checksum over those of all run files, by which a page is known to be of just these samples."""
    paths = [path for source in sources if (path := Path(source)).is_dir() or path.suffix == ".h5"]
    infos = [info for path in paths for info in (read_campaign(path).runs if path.is_dir() else (read_info(path),))]
    sums = [info.raw_sha256 for info in infos if info.raw_sha256]
    digest = sha256("\n".join(sums).encode()).hexdigest()
    return f"SHA-256 of the checksums of {count_text(len(sums), 'run file')}: {digest[:16]}" if sums else ""


def notebook_html(result: object) -> str:
    """Return a run, a campaign or a result as notebooks show it: its headline, a run's force, and its first table."""
    match result:
        case Run():
            document, force = present.run_document(result), result.trace.force
        case Campaign():
            document, force = present.campaign_runs_document(result), np.zeros(0)
        case Comparison():
            document, force = present.comparison_document(result), np.zeros(0)
        case Identification():
            document, force = present.identification_document(result), np.zeros(0)
        case _:
            document, force = present.diagnosis_document(cast("Diagnosis", result)), np.zeros(0)
    table, points = next(document.tables(), None), _points(force) if force.size else ""
    return render_template("notebook.html", {"document": document, "table": table, "points": points})


def _points(force: AnyFloatArray) -> str:
    """Return a force over time as points of a line, 400 wide and 40 high."""
    few = np.asarray(force[:: max(1, force.size // 400)], dtype=np.float64)
    low, span = float(np.nanmin(few)), float(np.ptp(few[np.isfinite(few)])) or 1.0
    return " ".join(
        f"{400 * place / few.size:.0f},{39 - 38 * (value - low) / span:.1f}"
        for place, value in enumerate(few.tolist())
        if np.isfinite(value)
    )


def render_template(template: str, context: Mapping[str, object]) -> str:
    """Fill a template of this package; what stands in the context is escaped, and a name that is missing raises."""
    environment = Environment(
        loader=PackageLoader("dragrig.present", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=_finished_text,
    )
    environment.filters["prose"] = prose
    environment.filters["unbroken"] = without_breaks
    return environment.get_template(template).render({"software": software_version(), "glyphs": "", **context})


def prose(text: str) -> Markup:
    """Return a sentence as HTML: what stands between backticks as code, and no line break before a unit."""
    escaped = str(escape(_finished_text(without_breaks(text))))
    return _markup(_CODE.sub(r'<span class="file">\1</span>', escaped))


def without_breaks(text: str) -> str:
    """Let no line break come between a number and its unit, nor around an equals sign before a number."""
    return _NO_BREAK.sub("\u00a0", text)


def _finished_text(value: object) -> object:
    """Write out a text's hidden characters, which could turn its order round, and set its apostrophes."""
    return _APOSTROPHE.sub("\u2019", printable(value)) if type(value) is str else value


def _markup(html: str) -> Markup:
    return Markup(html)  # noqa: S704  # escaped above, or serialised by ElementTree


_NAMESPACE = re.compile(r"\{[^}]*\}")
_REFERENCE = re.compile(r"(^|url\()#([\w.:-]+)")
_GLYPH = re.compile(r"[A-Za-z]+[\w-]*-[0-9a-f]+$")
_NUMBER = re.compile(r"-?\d+\.\d+")
_LINE = re.compile(r"M -?[\d.]+ -?[\d.]+\s*(?:[ML] -?[\d.]+ -?[\d.]+\s*)*")
_NUMERIC_ATTRIBUTES = frozenset({"x", "y", "width", "height", "viewBox", "points", "transform"})
"""Attributes that hold nothing but numbers."""


@dataclass(frozen=True, slots=True)
class InlineSvg:
    """A figure as an element of a page, and the letters it is written with, which a page defines once."""

    element: str
    """The `svg` element."""
    glyphs: Mapping[str, str]
    """Outlines of letters by their id; equal ids are equal letters in every figure."""


def inline_svg(text: str, shows: str) -> InlineSvg:
    """Return an SVG as an element of an HTML page.

    Metadata, styles and ids that nothing refers to are left out; the other ids begin with what tells this figure from
    others. Lines are written from point to point, to a tenth of a unit. What the figure shows is its label for those
    who cannot see it.

    Parameters
    ----------
    text
        A whole SVG document, as matplotlib writes it with letters as paths.
    shows
        What is to be seen.
    """
    root = ET.fromstring(text)  # noqa: S314  # our own figure
    _strip_metadata(root)
    ids = {element.attrib["id"] for element in root.iter() if "id" in element.attrib}
    # What stands behind a `#` is a colour as well.
    wanted = ids & {
        name
        for element in root.iter()
        for value in element.attrib.values()
        if "#" in value
        for _, name in _REFERENCE.findall(value)
    }
    key = f"f{crc32(text.encode()):08x}-"
    for element in root.iter():
        _shorten_attributes(element, key, wanted)
    glyphs = dict(_extract_glyphs(root))
    size = root.attrib["viewBox"]
    root.attrib.clear()
    root.attrib.update({"viewBox": size, "role": "img", "aria-label": printable(shows)})
    return InlineSvg(_serialise(root), glyphs)


def _extract_glyphs(root: ET.Element) -> Iterator[tuple[str, str]]:
    for parent in root.iter("defs"):
        for child in list(parent):
            name = child.get("id", "")
            if _GLYPH.match(name):
                parent.remove(child)
                yield name, _serialise(child)


def _serialise(element: ET.Element) -> str:
    return ET.tostring(element, encoding="unicode").replace(" />", "/>")


def _strip_metadata(root: ET.Element) -> None:
    for element in list(root.iter()):
        element.tag = _NAMESPACE.sub("", element.tag)
        element.attrib = {_NAMESPACE.sub("", name): value for name, value in element.attrib.items()}
        element.text = element.text.strip() if element.text else None
        element.tail = None
        for child in list(element):
            if _NAMESPACE.sub("", str(child.tag)) in {"metadata", "style"}:
                element.remove(child)


def _shorten_attributes(element: ET.Element, key: str, wanted: set[str]) -> None:
    for name, value in list(element.attrib.items()):
        if name == "id":
            if value in wanted:
                element.set(name, _prefix_id(value, key))
            else:
                del element.attrib[name]
        elif name == "d":
            element.set(name, _short_path(value))
        elif name in _NUMERIC_ATTRIBUTES:
            element.set(name, _NUMBER.sub(_three_decimals, value))
        elif "#" in value:
            element.set(name, _prefix_references(value, key, wanted))


def _prefix_references(value: str, key: str, wanted: set[str]) -> str:
    """Prefix the ids that an attribute refers to, within a style as well."""
    return _REFERENCE.sub(
        lambda found: f"{found[1]}#{_prefix_id(found[2], key)}" if found[2] in wanted else found[0], value
    )


def _prefix_id(name: str, key: str) -> str:
    return name if _GLYPH.match(name) else key + name


def _short_path(data: str) -> str:
    if _LINE.fullmatch(data):
        return _relative_polyline(data)
    short = _LINE.sub(lambda line: _relative_polyline(line[0]), _NUMBER.sub(_three_decimals, data))
    return " ".join(short.split())


def _relative_polyline(line: str) -> str:
    """Write a line from point to point, in tenths, without steps that do not move."""
    fields = line.split()
    places = np.array([fields[1::3], fields[2::3]], dtype=np.float64)
    points = np.rint(10 * places).astype(np.intp).T
    begins = [number for number, kind in enumerate(fields[::3]) if kind == "M"]
    written = ""
    for begin, end in pairwise((*begins, len(points))):
        steps = np.diff(points[begin:end], axis=0)
        moves = np.asarray(steps.any(axis=1))
        moves[:1] = True
        written += f"M{_tenths_texts(points[begin])}" + (f"l{_tenths_texts(steps[moves])}" if len(steps) else "")
    return written


def _tenths_texts(values: npt.NDArray[np.intp]) -> str:
    return " ".join(map(_tenths_text, values.ravel().tolist())).replace(" -", "-")


@lru_cache(maxsize=4096)
def _tenths_text(value: int) -> str:
    return re.sub(r"^(-?)0\.", r"\1.", f"{value / 10:g}")


def _three_decimals(number: re.Match[str]) -> str:
    return f"{float(number[0]):.3f}".rstrip("0").rstrip(".")
