"""Any document in the window: the answer, a tab for each section, tables and figures."""

import pytest
from windows import require_qt

require_qt()

from PySide6.QtWidgets import QApplication, QLabel, QTableWidget, QWidget
from test_present_document import DOCUMENT
from test_present_example import example_document

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
    assert "! marked bad: it slid" in view.lead.text()


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
