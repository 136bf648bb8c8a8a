"""HTML pages from templates: single files that need no network."""

import re
from collections.abc import Mapping

from jinja2 import Environment, PackageLoader, StrictUndefined

from dragrig.present.document import InlineFigure, shared_glyphs
from dragrig.rig.session import software_version

_NO_BREAK = re.compile(r"(?<=\d) (?=(?:%|‰|mm|mN|kPa|Pa|ms|s|µm|Hz|g)(?!\w))|(?<=[=<]) (?=[\d−-])|(?<=\w) (?=[=<] )")
_APOSTROPHE = re.compile(r"(?<=\w)'(?=\w)")


def without_breaks(text: str) -> str:
    """Let no line break come between a number and its unit, nor around an equals sign before a number."""
    return _NO_BREAK.sub("\u00a0", text)


def typographic_apostrophes(value: object) -> object:
    """Set the apostrophes of a text as a printer does."""
    return _APOSTROPHE.sub("\u2019", value) if type(value) is str else value


def render_template(template: str, context: Mapping[str, object]) -> str:
    """Fill a template of this package into a page that needs nothing but itself.

    Whatever stands in the context is escaped, and a name that is missing raises. The letters of all `pictures` stand in
    the page once.

    Parameters
    ----------
    context
        What the template names: its `title` at least, and its `pictures` by name.
    """
    pictures = context.get("pictures", {})
    drawn = pictures.values() if isinstance(pictures, Mapping) else ()
    shared = {
        "software": software_version(),
        "glyphs": shared_glyphs(one for one in drawn if isinstance(one, InlineFigure)),
    }
    environment = Environment(
        loader=PackageLoader("dragrig.present", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=typographic_apostrophes,
    )
    environment.filters["kept"] = without_breaks
    return environment.get_template(template).render({**shared, **context})
