"""Any document in the window: the answer, a tab for each section, tables and figures."""

import re
from pathlib import Path

import pytest
from PIL import Image
from pypdf import PdfReader

from windows import require_qt

require_qt()

from PySide6.QtWidgets import QApplication, QLabel, QTableWidget, QWidget

from documents import DOCUMENT, example_document
from dragrig.present.files import drawn
from dragrig.window.widgets import DocumentView, DrawnFigure


@pytest.fixture
def view(qapp: QApplication) -> DocumentView:
    view = DocumentView()
    view.show_document(drawn(DOCUMENT), {"More": QWidget()})
    return view


def test_each_section_has_a_tab_and_the_caller_may_add_some(view: DocumentView) -> None:
    assert [view.tabs.tabText(place) for place in range(view.tabs.count())] == ["1. Forces", "More"]
    assert view.answer.text() == "The force grows by 20 mN."
    first = [text.text() for text in view.tabs.widget(0).findChildren(QLabel)]
    assert "! marked bad: it slid" in first


def test_a_table_shows_what_a_terminal_shows(view: DocumentView) -> None:
    (table,) = view.findChildren(QTableWidget)
    assert (table.rowCount(), table.columnCount()) == (2, 3)
    assert table.item(0, 1).text() == "101.2 ± 0.3"
    assert any(label.text() == "and 1 more" for label in view.findChildren(QLabel))


def test_a_figure_says_what_it_shows_to_a_screen_reader(view: DocumentView) -> None:
    (figure,) = view.findChildren(DrawnFigure)
    assert figure.accessibleName() == "A rising line."
    assert figure.heightForWidth(100) == 100


def test_another_document_takes_the_place_of_the_first(view: DocumentView) -> None:
    view.show_document(DOCUMENT.without("curve"))
    assert view.tabs.count() == 1


def test_the_result_of_the_docs_is_shown(qapp: QApplication) -> None:
    view = DocumentView()
    view.show_document(drawn(example_document()))
    (table,) = view.findChildren(QTableWidget)
    assert table.item(0, 1).text() == "101.23 ± 0.31"
    assert view.findChildren(DrawnFigure)


def test_a_figure_is_saved_as_wide_as_two_columns_of_a_journal(qapp: QApplication, tmp_path: Path) -> None:
    (drawing,) = drawn(example_document()).figures()
    figure = DrawnFigure(drawing)
    for ending in ("pdf", "svg", "png"):
        figure.save(str(tmp_path / f"curve.{ending}"))
    page = PdfReader(tmp_path / "curve.pdf").pages[0]
    assert float(page.mediabox.width) == pytest.approx(180 * 72 / 25.4, abs=1.0)
    with Image.open(tmp_path / "curve.png") as picture:
        assert picture.info["dpi"] == pytest.approx((600, 600), abs=0.1)
        assert picture.width == pytest.approx(180 / 25.4 * 600, abs=1)
        assert len(picture.convert("L").getcolors(256) or ()) > 2, "nothing is drawn"
    size = re.search(r'\bwidth="([\d.]+)pt"', (tmp_path / "curve.svg").read_text("utf-8"))
    assert size is not None
    assert float(size[1]) == pytest.approx(180 * 72 / 25.4, abs=0.1)


def test_a_figure_that_cannot_be_saved_says_so(view: DocumentView, tmp_path: Path) -> None:
    (figure,) = view.findChildren(DrawnFigure)
    figure.save(str(tmp_path / "nowhere" / "curve.pdf"))
    assert any("cannot be written" in label.text() for label in view.findChildren(QLabel))
