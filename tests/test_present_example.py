"""The module that docs/present.md shows is run as it stands there: one module, and the result is in every medium."""

import json
import re
from pathlib import Path

import pytest

from dragrig.present.document import Document
from dragrig.present.html_page import render_page
from dragrig.present.terminal import document_text

PAGE = Path(__file__).parents[1] / "docs" / "present.md"
FORCES = {"001-drag.h5": (101.234, 0.31), "002-drag.h5": (87.5, 0.42)}


def example_document() -> Document:
    """Build the document that the page's module makes of two runs."""
    shown = re.search(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    assert shown is not None
    module: dict[str, object] = {"__name__": "forces"}
    exec(compile(shown[1], str(PAGE), "exec"), module)  # our own page
    build = module["forces_document"]
    assert callable(build)
    made = build(FORCES)
    assert isinstance(made, Document)
    return made


@pytest.fixture(scope="module")
def document() -> Document:
    return example_document()


def test_the_terminal_shows_it(document: Document) -> None:
    text = document_text(document)
    assert text.startswith("The largest force is that of 001-drag.h5.")
    assert re.search(r"001-drag\.h5 +101\.23 ± 0\.31", text)


def test_the_page_shows_it_with_its_figure(document: Document) -> None:
    page = render_page(document)
    assert "87.50\u00a0±\u00a00.42" in page
    assert 'aria-label="A bar for each run: its mean force."' in page


def test_json_has_its_exact_numbers(document: Document) -> None:
    assert json.loads(json.dumps(document.data))["forces_mN"]["001-drag.h5"] == 101.234
