"""Templates into pages."""

from collections.abc import Mapping

from jinja2 import Environment, PackageLoader, StrictUndefined


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
    return environment.get_template(template).render(context)
