"""Templates into pages."""

import re
from collections.abc import Mapping

from jinja2 import Environment, PackageLoader, StrictUndefined

_NUMBER_AND_UNIT = re.compile(r"(?<=\d) (?=(?:%|‰|mm|mN|kPa|Pa|ms|s|µm|Hz|g)(?!\w))")


def kept_together(text: str) -> str:
    """Let no line break come between a number and its unit."""
    return _NUMBER_AND_UNIT.sub("\u00a0", text)


def render(template: str, context: Mapping[str, object]) -> str:
    """Fill a template of this package; whatever stands in the context is escaped, and a name that is missing raises."""
    environment = Environment(
        loader=PackageLoader("dragrig.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["kept"] = kept_together
    return environment.get_template(template).render(context)
