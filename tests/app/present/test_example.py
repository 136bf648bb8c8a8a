"""The module that docs/present.md shows is run as it stands there: one module, and the result is in every medium."""

import json
import re

import pytest

from documents import example_document
from dragrig.present.document import Document
from dragrig.present.html_page import render_page
from dragrig.present.numbers import to_json_value
from dragrig.present.terminal import document_text


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
    assert json.loads(json.dumps(to_json_value(document.data)))["forces_mN"]["001-drag.h5"] == 101.234
