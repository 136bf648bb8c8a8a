"""A result's document in every renderer: what each shows, and what none shows."""

import json
import pickle
import re
from dataclasses import replace

import pytest

from documents import DOCUMENT, SVG, TABLE
from dragrig.present.document import (
    Section,
)
from dragrig.present.files import drawn
from dragrig.present.html_page import render_page
from dragrig.present.numbers import duration_text, force_text, to_json_value
from dragrig.present.terminal import document_text


def test_a_terminal_shows_sentences_tables_and_remarks() -> None:
    text = document_text(DOCUMENT)
    assert text.startswith("The force grows by 20 mN.\n")
    assert "Measured at 3 speeds." in text
    assert "! marked bad: it slid" in text
    assert "See dragrig show." in text
    assert "Take care." in text
    assert re.search(r"0\.50 +101\.2 ± 0\.3 +first", text)
    assert "and 1 more" in text
    assert "! zero is off" in text
    assert re.search(r"Operator +M\. K\.", text)


def test_a_terminal_leaves_out_what_only_a_page_can_show() -> None:
    text = document_text(DOCUMENT)
    assert "How to read this" not in text
    assert "It was the first" not in text
    assert "Force against speed" not in text


def test_a_page_shows_everything_and_escapes_it() -> None:
    page = render_page(DOCUMENT)
    assert "<title>Forces of &lt;a&gt; specimen</title>" in page
    assert '<span class="badge simulated">simulated</span>runs/first' in page
    assert "How to read this" in page
    assert '<span class="file">dragrig show</span>' in page
    assert '<td class="number" data-number="101.234" data-heading="force, mN">101.2\u00a0±\u00a00.3</td>' in page
    assert '<a href="#detail">0.50</a>' in page
    assert '<details id="detail">' in page
    assert '<path d="M0 0l10 10"/>' in page
    assert 'aria-label="A rising line."' in page


@pytest.mark.parametrize("text", [document_text(DOCUMENT), render_page(DOCUMENT)], ids=["terminal", "page"])
def test_a_section_without_content_is_shown_nowhere(text: str) -> None:
    assert "Nothing to see" not in text
    assert "Note" not in text


def test_a_narrow_terminal_wraps_cells_and_loses_none() -> None:
    wide = replace(TABLE, rows=((1.0, 2.0, "a note that is longer than the window is wide"),), links=())
    document = replace(DOCUMENT, sections=(Section("wide", "", (wide,)),))
    text = document_text(document, width=40)
    assert "window" in text
    assert "…" not in text


def test_a_missing_value_is_a_dash_on_the_screen_and_empty_in_the_file() -> None:
    assert [row[1].text for row in TABLE.cells] == ["101.2 ± 0.3", "–", "–"]
    assert TABLE.csv() == "speed_mm_s,force_mN,note\r\n0.5,101.234,first\r\n2.0,,\r\n10.0,,\r\n"


def test_columns_are_selected_in_the_order_of_their_names() -> None:
    chosen = TABLE.select("note", "speed_mm_s", caption="Speeds")
    assert [column.heading for column in chosen.columns] == ["", "mm/s"]
    assert chosen.rows[0] == ("first", 0.5)


def test_figures_are_drawn_once_and_then_travel_with_the_document() -> None:
    calls: list[tuple[int, int]] = []
    copy = drawn(DOCUMENT, lambda done, total: calls.append((done, total)))
    assert [figure.drawing for figure in copy.figures()] == [SVG]
    assert calls == [(0, 3), (3, 3)], "loading matplotlib counts as two figures, drawn with the first"
    assert render_page(copy) == render_page(DOCUMENT)


def test_a_drawn_document_can_be_sent_to_another_process() -> None:
    copy = pickle.loads(pickle.dumps(drawn(DOCUMENT)))
    assert document_text(copy) == document_text(DOCUMENT)
    assert not list(copy.without("curve").figures())


@pytest.mark.parametrize(
    ("shown", "text"),
    [
        (force_text(0.00012), "0.0001 mN"),
        (force_text(0.04), "0.04 mN"),
        (force_text(0.05), "0.1 mN"),
        (force_text(0.0), "0.0 mN"),
        (duration_text(0.85), "850 ms"),
        (duration_text(0.9999), "1.0 s"),
        (duration_text(59.96), "1 min 00 s"),
    ],
)
def test_small_forces_and_times_are_written_as_a_person_would(shown: str, text: str) -> None:
    assert shown == text


def test_json_has_no_nan() -> None:
    assert json.dumps(to_json_value(DOCUMENT.data), allow_nan=False) == '{"force_mN": [101.234, null]}'
