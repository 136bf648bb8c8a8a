"""Any result's document in the window: the answer above, a tab for each section."""

from collections.abc import Iterator, Mapping

from PySide6.QtCore import QByteArray, QSize, Qt
from PySide6.QtSvgWidgets import QSvgWidget
from PySide6.QtWidgets import QScrollArea, QSizePolicy, QTableWidget, QTabWidget, QWidget

from dragrig.present.document import Block, Code, Document, Facts, Figure, Items, Section, Table, Text, TextKind
from dragrig.window.widgets import bare_widget, column, fill_table, label, named, table

MIN_FIGURE_WIDTH_PX = 520
ROW_PX = 30


class DocumentView(QWidget):
    """Shows a document whose figures are drawn already (`present.files.drawn`)."""

    def __init__(self) -> None:
        super().__init__()
        self.answer = label("", "title", wrap=True)
        self.lead = label("", wrap=True)
        self.tabs = QTabWidget()
        self.setLayout(column(self.answer, self.lead, self.tabs, stretch={2: 1}))

    def show_document(self, document: Document, pages: Mapping[str, QWidget] | None = None) -> None:
        """Show a document; `pages` are further tabs by their titles, which stay the caller's."""
        pages = pages or {}
        self.answer.setText(_plain(document.answer or document.title))
        problem = (f"! {document.problem}",) if document.problem else ()
        self.lead.setText("\n".join(map(_plain, (*problem, *document.lead))))
        self.lead.setVisible(bool(self.lead.text()))
        while self.tabs.count():
            page = self.tabs.widget(0)
            self.tabs.removeTab(0)
            if page not in pages.values():
                page.deleteLater()
        for section in document.content:
            self.tabs.addTab(_scrolling(section), section.heading or document.title)
        for title, page in pages.items():
            self.tabs.addTab(page, title)


def _scrolling(section: Section) -> QScrollArea:
    area = QScrollArea()
    area.setWidgetResizable(True)
    inside = bare_widget(column(*_widgets(section.content), 1, margin=10))
    inside.setObjectName("bare")
    area.setWidget(inside)
    return area


def _widgets(blocks: tuple[Block, ...]) -> Iterator[QWidget]:
    for block in blocks:
        match block:
            case Text() if block.kind is not TextKind.EXPLANATION:
                yield label(_plain(block.text), wrap=True)
            case Items():
                mark = "! " if block.remarks else "• "
                yield label("\n".join(f"{mark}{_plain(item)}" for item in block.items), wrap=True)
            case Facts():
                yield label("\n".join(f"{name}: {value}" for name, value in block.values.items() if value), wrap=True)
            case Code():
                yield label(block.text)
            case Table():
                yield from _table(block)
            case Figure():
                yield DrawnFigure(block)
                yield label(_plain(block.caption), "faint", wrap=True)
            case Section():
                yield label(_plain(block.heading), "title", wrap=True)
                yield from _widgets(block.content)
            case Text():
                pass


def _table(block: Table) -> Iterator[QWidget]:
    if block.caption:
        yield label(_plain(block.caption), "faint", wrap=True)
    shown = named(table([column.heading for column in block.columns]), block.caption or block.name)
    rows = block.brief_cells
    fill_table(shown, [[cell.text for cell in row] for row in rows])
    _fit_height(shown, len(rows))
    yield shown
    if block.omitted_text:
        yield label(block.omitted_text, "faint")


def _fit_height(shown: QTableWidget, rows: int) -> None:
    """Make a table as tall as its rows, so that the page scrolls and not the table in it."""
    shown.setVerticalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
    shown.verticalHeader().setDefaultSectionSize(ROW_PX)
    shown.setFixedHeight(shown.horizontalHeader().sizeHint().height() + ROW_PX * rows + 20)


class DrawnFigure(QSvgWidget):
    """A figure as wide as there is room, its proportions kept."""

    def __init__(self, figure: Figure) -> None:
        super().__init__()
        if not isinstance(figure.drawing, str):
            raise TypeError(f"the figure {figure.name} is not drawn yet; show drawn(document)")
        self.load(QByteArray(figure.drawing.encode()))
        # What is loaded brings a mode of its own.
        self.renderer().setAspectRatioMode(Qt.AspectRatioMode.KeepAspectRatio)
        self.setAccessibleName(figure.shows)
        policy = QSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Preferred)
        policy.setHeightForWidth(True)
        self.setSizePolicy(policy)
        self.setMinimumSize(QSize(MIN_FIGURE_WIDTH_PX, self.heightForWidth(MIN_FIGURE_WIDTH_PX)))

    def hasHeightForWidth(self) -> bool:
        """Whether the height follows from the width."""
        return True

    def heightForWidth(self, width: int) -> int:
        """Height at a width, in the figure's proportions."""
        size = self.renderer().defaultSize()
        return width * size.height() // max(size.width(), 1)


def _plain(text: str) -> str:
    return text.replace("`", "")
