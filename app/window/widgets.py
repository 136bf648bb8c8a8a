"""Style sheet, small widgets that every page uses, the view of a result's document, settings stored between days."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TypeVar

from PySide6 import QtGui, QtWidgets
from PySide6.QtCore import QBuffer, QByteArray, QIODevice, QMarginsF, QPoint, QRect, QSettings, QSize, QSizeF, Qt
from PySide6.QtSvg import QSvgRenderer
from PySide6.QtSvgWidgets import QSvgWidget

from dragrig import present
from dragrig.analysis import printable
from dragrig.config import DragrigError, OutputError, SettingsError, read_number
from dragrig.present import BLACK, BLUE, GREEN, GREY, GRID, PALE, PAPER, PURPLE, VERMILLION

WidgetT = TypeVar("WidgetT", bound=QtWidgets.QWidget)
TEXT_PX, SMALL_PX, TITLE_PX, READING_PX = 15, 14, 20, 22
SURFACE_COLOUR = "#F3F5F7"
STOP_COLOUR = "#B00020"
"""For the stop button alone; with white text, legible with any colour vision."""

_DARK_COLOURS = {
    BLACK: "#E8EBEE", PAPER: "#1D2125", SURFACE_COLOUR: "#14171A", GREY: "#A3ACB6", GRID: "#3A424A", PALE: "#66717D",
    BLUE: "#2E8BD0", VERMILLION: "#F0803C", GREEN: "#2BBF94", PURPLE: "#D685B4", STOP_COLOUR: "#E5405A",
    "#00664B": "#4CCBA3", "#FFF4D6": "#3A3217", "#8A5A00": "#D9A53A", "#FBE3E6": "#43191F", "#E3F1FA": "#16324A",
    "#FFE9D6": "#42260F", "#CFE6F5": "#1F4663", "#8CC4E6": "#2E6C96",
}  # fmt: skip
"""What stands on a dark desktop in place of each colour."""


def desktop_is_dark() -> bool:
    """Whether the desktop has a dark theme now."""
    return QtGui.QGuiApplication.styleHints().colorScheme() is Qt.ColorScheme.Dark


def themed(colours: str) -> str:
    """Return a colour, or a text with colours, as a dark desktop has them where the desktop is dark."""
    if not desktop_is_dark():
        return colours
    return re.sub("#[0-9A-F]{6}", lambda colour: _DARK_COLOURS.get(colour[0], colour[0]), colours)


_STYLE_SHEET = f"""
* {{ font-size: {TEXT_PX}px; color: {BLACK}; }}
QMainWindow, QDialog, QWidget#page {{ background: {SURFACE_COLOUR}; }}
QLabel[role="title"] {{ font-size: {TITLE_PX}px; font-weight: 600; }}
QLabel[role="faint"] {{ color: {GREY}; font-size: {SMALL_PX}px; }}
QLabel[role="wrong"] {{ color: {STOP_COLOUR}; font-weight: 600; }}
QLabel[role="reading"], QLabel[role="old reading"] {{ font-size: {READING_PX}px; font-weight: 600; }}
QLabel[role="old reading"] {{ color: {PALE}; }}
QLabel[role="changed"] {{ color: {BLUE}; font-weight: 600; }}
QLabel[role="fine"] {{ color: #00664B; font-weight: 600; }}
QFrame[role="card"] {{ background: {PAPER}; border: 1px solid {GRID}; border-radius: 6px; }}
QFrame[role="notice"] {{ background: #FFF4D6; border: 2px solid #8A5A00; border-radius: 6px; }}
QFrame[role="trip"] {{ background: #FBE3E6; border: 3px solid {STOP_COLOUR}; border-radius: 6px; }}
QFrame[role="calm"] {{ background: #E3F1FA; border: 2px solid {BLUE}; border-radius: 6px; }}
QFrame[role="simulated"] {{ background: #E3F1FA; border: 2px dashed {BLUE}; border-radius: 6px; }}
QFrame[role="hardware"] {{ background: #FFE9D6; border: 3px solid {VERMILLION}; border-radius: 6px; }}
QPushButton, QToolButton {{ background: {PAPER}; border: 1px solid {PALE}; border-radius: 5px; padding: 7px 14px; }}
QToolButton[popupMode="2"] {{ padding-right: 30px; }}
QToolButton::menu-indicator {{ subcontrol-origin: padding; subcontrol-position: right center; right: 9px; }}
QPushButton:hover, QToolButton:hover {{ border-color: {BLUE}; }}
QPushButton:focus, QToolButton:focus {{ border: 2px solid {BLUE}; padding: 6px 13px; }}
QPushButton:disabled, QToolButton:disabled {{ color: {PALE}; background: {SURFACE_COLOUR}; }}
QPushButton[role="main"] {{ background: {BLUE}; color: white; font-weight: 600; border-color: {BLUE}; }}
QPushButton[role="main"]:focus {{ border: 2px solid {BLACK}; }}
QPushButton[role="main"]:disabled {{ background: {GRID}; border-color: {GRID}; color: {GREY}; }}
QPushButton[role="stop"] {{ background: {STOP_COLOUR}; color: white; font-size: 22px; font-weight: 800;
    border: 3px solid #6B0013; border-radius: 8px; padding: 6px 18px; }}
QPushButton[role="page"] {{ border: none; border-bottom: 4px solid transparent; border-radius: 0;
    background: transparent; font-size: 17px; padding: 8px 5px; }}
QPushButton[role="page"]:checked {{ border-bottom: 4px solid {BLUE}; color: {BLUE}; }}
QPushButton[role="page"]:focus {{ background: #E3F1FA; }}
QLineEdit, QPlainTextEdit {{ background: {PAPER}; border: 1px solid {PALE};
    border-radius: 4px; padding: 5px 7px; selection-background-color: {BLUE}; selection-color: white; }}
QLineEdit:focus, QPlainTextEdit:focus {{ border: 2px solid {BLUE}; }}
QComboBox, QAbstractSpinBox {{ min-height: 30px; }}
QAbstractSpinBox[role="wrong"] {{ color: {STOP_COLOUR}; font-weight: 600; }}
QComboBox QAbstractItemView {{ background: {PAPER}; selection-background-color: {BLUE}; selection-color: white; }}
QTreeWidget, QTableWidget, QListWidget {{ background: {PAPER}; border: 1px solid {GRID};
    alternate-background-color: {SURFACE_COLOUR};
    selection-background-color: #CFE6F5; selection-color: {BLACK}; }}
QTableWidget::item {{ padding: 0 7px; }}
QTreeView::item {{ padding: 3px 0; }}
QComboBox QTreeView::item {{ padding: 3px 6px; }}
QTableWidget::item:selected {{ background: #CFE6F5; color: {BLACK}; }}
QHeaderView::section {{ background: {SURFACE_COLOUR}; border: none; border-bottom: 1px solid {GRID}; padding: 5px 7px;
    color: {GREY}; }}
QTabBar::tab {{ background: transparent; padding: 8px 11px; border: none; color: {GREY}; }}
QTabBar QToolButton {{ padding: 0; }}
QTabBar::tab:selected {{ color: {BLACK}; font-weight: 600; border-bottom: 3px solid {BLUE}; }}
QTabWidget::pane {{ border: 1px solid {GRID}; border-radius: 6px; background: {PAPER}; }}
QScrollArea, QWidget#bare {{ background: transparent; border: none; }}
QPlainTextEdit#message {{ background: transparent; border: none; padding: 0; }}
QPlainTextEdit#message[role="prompt"] {{ font-size: 17px; font-weight: 600; }}
QPlainTextEdit#message[role="wrong"] {{ color: {STOP_COLOUR}; font-weight: 600; }}
QPlainTextEdit#message[role="fine"] {{ color: #00664B; font-weight: 600; }}
QProgressBar {{ background: {GRID}; border: none; border-radius: 4px; text-align: center; min-height: 22px; }}
QProgressBar::chunk {{ background: #8CC4E6; border-radius: 4px; }}
QSplitter::handle {{ background: {SURFACE_COLOUR}; }}
QToolTip {{ background: {BLACK}; color: {PAPER}; border: none; padding: 6px; }}
QCheckBox::indicator {{ width: 18px; height: 18px; }}
QCheckBox::indicator:unchecked {{ background: {PAPER}; border: 1px solid {PALE}; border-radius: 3px; }}
QMenu {{ background: {PAPER}; border: 1px solid {PALE}; }}
QMenu::item {{ padding: 6px 22px; }}
QMenu::item:selected {{ background: {BLUE}; color: white; }}
"""


def apply_style(application: QtWidgets.QApplication) -> None:
    """Set fonts and sizes, the same on every machine, and the colours of a light or a dark desktop, as it changes."""
    from importlib.resources import files

    font = files("matplotlib") / "mpl-data" / "fonts" / "ttf" / "DejaVuSans.ttf"
    bold = files("matplotlib") / "mpl-data" / "fonts" / "ttf" / "DejaVuSans-Bold.ttf"
    for file in (font, bold):
        QtGui.QFontDatabase.addApplicationFontFromData(file.read_bytes())
    application.setStyle("Fusion")
    application.setFont(QtGui.QFont("DejaVu Sans"))
    application.styleHints().colorSchemeChanged.connect(lambda _: _colour(application))
    _colour(application)


def _colour(application: QtWidgets.QApplication) -> None:
    palette = QtGui.QPalette(QtGui.QColor(themed(SURFACE_COLOUR)))
    for role, colour in (
        (QtGui.QPalette.ColorRole.Window, SURFACE_COLOUR),
        (QtGui.QPalette.ColorRole.Base, PAPER),
        (QtGui.QPalette.ColorRole.AlternateBase, SURFACE_COLOUR),
        (QtGui.QPalette.ColorRole.Text, BLACK),
        (QtGui.QPalette.ColorRole.WindowText, BLACK),
        (QtGui.QPalette.ColorRole.ButtonText, BLACK),
        (QtGui.QPalette.ColorRole.Highlight, BLUE),
        (QtGui.QPalette.ColorRole.HighlightedText, PAPER),
        (QtGui.QPalette.ColorRole.PlaceholderText, GREY),
    ):
        palette.setColor(role, QtGui.QColor(themed(colour)))
    application.setPalette(palette)
    application.setStyleSheet(themed(_STYLE_SHEET))


_NUMBER_TEXT = re.compile(r"[-−+]?[\d.]+( \S+){0,3}")


def label(text: str = "", role: str = "", *, wrap: bool = False) -> QtWidgets.QLabel:
    """Return a label with selectable text; `role` is one of the style sheet."""
    made = QtWidgets.QLabel(text)
    made.setProperty("role", role)
    made.setWordWrap(wrap)
    made.setTextFormat(Qt.TextFormat.PlainText)
    made.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    if wrap:
        made.setSizePolicy(QtWidgets.QSizePolicy.Policy.Preferred, QtWidgets.QSizePolicy.Policy.Minimum)
    return made


class ElidedLabel(QtWidgets.QLabel):
    """A line that gives way: cut off with dots where there is no room, and whole in its tooltip."""

    def __init__(self, text: str = "", role: str = "") -> None:
        super().__init__(text)
        self.setProperty("role", role)
        self.setTextFormat(Qt.TextFormat.PlainText)
        self.setToolTip(text)

    def setText(self, text: str) -> None:
        """Show a text."""
        super().setText(text)
        self.setToolTip(text)

    def minimumSizeHint(self) -> QSize:
        """Room for a few letters."""
        return QSize(min(_MIN_ELIDED_PX, super().minimumSizeHint().width()), super().minimumSizeHint().height())

    def paintEvent(self, _event: QtGui.QPaintEvent) -> None:
        """Draw as much of the text as there is room for."""
        painter = QtGui.QPainter(self)
        inside = self.contentsRect()
        line = self.text().replace("\n", " ")
        text = self.fontMetrics().elidedText(line, Qt.TextElideMode.ElideRight, inside.width())
        painter.setPen(self.palette().color(self.foregroundRole()))
        painter.drawText(inside, int(self.alignment()), text)


_MIN_ELIDED_PX = 60


class MessageText(QtWidgets.QPlainTextEdit):
    """A message of any length, which can be selected: wrapped, also within a long path, and scrolled beyond some lines.

    Parameters
    ----------
    most_lines
        So many lines are shown at once; it is as tall as its text, but no taller.
    """

    def __init__(self, role: str = "", most_lines: int = 3) -> None:
        super().__init__()
        self._most_lines = most_lines
        self.setObjectName("message")
        self.setProperty("role", role)
        self.setReadOnly(True)
        self.setTabChangesFocus(True)
        self.setFrameShape(QtWidgets.QFrame.Shape.NoFrame)
        self.setWordWrapMode(QtGui.QTextOption.WrapMode.WrapAtWordBoundaryOrAnywhere)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.document().setDocumentMargin(0)
        self.setSizePolicy(QtWidgets.QSizePolicy.Policy.Ignored, QtWidgets.QSizePolicy.Policy.Fixed)

    def text(self) -> str:
        """Return the text."""
        return self.toPlainText()

    def setText(self, text: str) -> None:
        """Show a text."""
        if text != self.toPlainText():
            self.setPlainText(text)
        self.setAccessibleName(text)
        self._fit()

    def resizeEvent(self, event: QtGui.QResizeEvent) -> None:
        """Wrap the text anew."""
        super().resizeEvent(event)
        self._fit()

    def _fit(self) -> None:
        self.ensurePolished()
        lines = self._lines()
        shown = min(lines, self._most_lines)
        # Only a text that is not shown whole is worth a stop of the Tab key, for the keys that scroll it.
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus if lines > shown else Qt.FocusPolicy.NoFocus)
        self.setFixedHeight(self.fontMetrics().lineSpacing() * shown + 1)

    def _lines(self) -> int:
        """Count the lines at the present width; Qt counts those of a hidden text as unwrapped."""
        text = self.document().clone()
        text.setTextWidth(max(self.viewport().width(), 1))
        return round(text.size().height() / self.fontMetrics().lineSpacing())


class FlowLayout(QtWidgets.QLayout):
    """Widgets side by side, and on further lines where there is no room."""

    def __init__(self, spacing: int = 8) -> None:
        super().__init__()
        self._items: list[QtWidgets.QLayoutItem] = []
        self.setSpacing(spacing)
        self.setContentsMargins(0, 0, 0, 0)

    def addItem(self, item: QtWidgets.QLayoutItem) -> None:
        """Append an item."""
        self._items.append(item)

    def count(self) -> int:
        """Return the number of items."""
        return len(self._items)

    def itemAt(self, index: int) -> QtWidgets.QLayoutItem | None:
        """Return an item, None beyond the last."""
        return self._items[index] if 0 <= index < len(self._items) else None

    def takeAt(self, index: int) -> QtWidgets.QLayoutItem | None:  # type: ignore[override]  # as Qt calls it
        """Remove an item."""
        return self._items.pop(index) if 0 <= index < len(self._items) else None

    def expandingDirections(self) -> Qt.Orientation:
        """Grow in no direction."""
        return Qt.Orientation(0)

    def hasHeightForWidth(self) -> bool:
        """Whether the height follows from the width."""
        return True

    def heightForWidth(self, width: int) -> int:
        """Height of all lines at a width."""
        return self._place(QRect(0, 0, width, 0), move=False)

    def setGeometry(self, rectangle: QRect) -> None:
        """Place the items."""
        super().setGeometry(rectangle)
        self._place(rectangle, move=True)

    def sizeHint(self) -> QSize:
        """Room for all on one line."""
        shown = [item.sizeHint() for item in self._items if not item.isEmpty()]
        width = sum(size.width() + self.spacing() for size in shown) - self.spacing()
        return QSize(max(width, 0), max((size.height() for size in shown), default=0))

    def minimumSize(self) -> QSize:
        """Room for the widest item."""
        shown = [item.minimumSize() for item in self._items if not item.isEmpty()]
        return QSize(max((size.width() for size in shown), default=0), max((s.height() for s in shown), default=0))

    def _place(self, rectangle: QRect, *, move: bool) -> int:
        y = rectangle.y()
        for line in self._lines(rectangle.width()):
            height = max(size.height() for _, size in line)
            x = rectangle.x()
            for item, size in line:
                if move:
                    item.setGeometry(QRect(QPoint(x, y + (height - size.height()) // 2), size))
                x += size.width() + self.spacing()
            y += height + self.spacing()
        return max(y - self.spacing() - rectangle.y(), 0)

    def _lines(self, width: int) -> list[list[tuple[QtWidgets.QLayoutItem, QSize]]]:
        lines: list[list[tuple[QtWidgets.QLayoutItem, QSize]]] = []
        used = width
        for item in self._items:
            if item.isEmpty():
                continue
            size = item.sizeHint().boundedTo(QSize(max(width, item.minimumSize().width()), _ANY_PX))
            if not lines or used + size.width() > width:
                lines.append([])
                used = 0
            lines[-1].append((item, size))
            used += size.width() + self.spacing()
        return lines


_ANY_PX = 1 << 20


def flow(*widgets: QtWidgets.QWidget) -> QtWidgets.QWidget:
    """Return widgets side by side, on as many lines as they need."""
    layout = FlowLayout()
    for widget in widgets:
        layout.addWidget(widget)
    made = bare_widget(layout)
    policy = QtWidgets.QSizePolicy(QtWidgets.QSizePolicy.Policy.Preferred, QtWidgets.QSizePolicy.Policy.Minimum)
    policy.setHeightForWidth(True)
    made.setSizePolicy(policy)
    return made


def scrolling(content: QtWidgets.QWidget | QtWidgets.QLayout, *, across: bool = True) -> QtWidgets.QScrollArea:
    """Return content in an area that scrolls where there is less room than it needs; sideways only with `across`."""
    area = QtWidgets.QScrollArea()
    area.setWidgetResizable(True)
    area.setFrameShape(QtWidgets.QFrame.Shape.NoFrame)
    if isinstance(content, QtWidgets.QLayout):
        content = bare_widget(content)
        content.setObjectName("bare")
    area.setWidget(content)
    if not across:
        area.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
    return area


def button(
    text: str, pressed: Callable[[], None], role: str = "", help_: str = "", keys: str = ""
) -> QtWidgets.QPushButton:
    """Return a button; its tooltip is `help_` with the shortcut `keys`."""
    made = QtWidgets.QPushButton(text)
    made.setProperty("role", role)
    made.setAutoDefault(False)
    made.clicked.connect(lambda _checked=False: pressed())
    if keys:
        # Not the button's own shortcut, which would replace its Alt letter.
        QtGui.QShortcut(QtGui.QKeySequence(keys), made).activated.connect(made.click)
    made.setToolTip(f"{help_} ({keys})" if keys and help_ else help_ or keys)
    made.setAccessibleName(text.replace("&", ""))
    return made


def named(widget: WidgetT, name: str) -> WidgetT:
    """Set a widget's accessible name, and return the widget."""
    widget.setAccessibleName(name)
    return widget


def row(
    *widgets: QtWidgets.QWidget | QtWidgets.QLayout | int, margin: int = 0, stretch: Mapping[int, int] | None = None
) -> QtWidgets.QHBoxLayout:
    """Return widgets side by side; a number is a spacer, and `stretch` maps positions to stretch factors."""
    made = QtWidgets.QHBoxLayout()
    _fill_layout(made, widgets, margin, stretch or {})
    return made


def column(
    *widgets: QtWidgets.QWidget | QtWidgets.QLayout | int, margin: int = 0, stretch: Mapping[int, int] | None = None
) -> QtWidgets.QVBoxLayout:
    """Return widgets one below the other, otherwise as `row`."""
    made = QtWidgets.QVBoxLayout()
    _fill_layout(made, widgets, margin, stretch or {})
    return made


def card(
    *widgets: QtWidgets.QWidget | QtWidgets.QLayout | int, role: str = "card", margin: int = 10
) -> QtWidgets.QFrame:
    """Return a framed group."""
    made = QtWidgets.QFrame()
    made.setProperty("role", role)
    made.setLayout(column(*widgets, margin=margin))
    return made


def split(
    left: QtWidgets.QWidget, right: QtWidgets.QWidget, sizes: Sequence[int], stored: "StoredSettings", name: str
) -> QtWidgets.QSplitter:
    """Return two parts side by side, whose border is where a person left it."""
    made = QtWidgets.QSplitter(Qt.Orientation.Horizontal)
    for part in (left, right):
        made.addWidget(part)
    made.setStretchFactor(0, 1)
    made.setStretchFactor(1, 3)
    made.setSizes(sizes)
    made.setChildrenCollapsible(False)
    if (state := stored.shape(f"{name} border")) is not None:
        made.restoreState(state)
    made.splitterMoved.connect(lambda *_: stored.keep(f"{name} border", made.saveState()))
    return made


def ask_room_for_shown_page(stack: QtWidgets.QStackedWidget | QtWidgets.QTabWidget) -> None:
    """Let only the page that is shown ask for room."""
    for at in range(stack.count()):
        policy = (
            QtWidgets.QSizePolicy.Policy.Preferred
            if at == stack.currentIndex()
            else QtWidgets.QSizePolicy.Policy.Ignored
        )
        stack.widget(at).setSizePolicy(policy, policy)


def tabs_of(*pages: tuple[QtWidgets.QWidget, str]) -> QtWidgets.QTabWidget:
    """Return pages as tabs, of which only the one that is shown asks for room."""
    made = QtWidgets.QTabWidget()
    for page, title in pages:
        made.addTab(page, title)
    ask_room_for_shown_page(made)
    made.currentChanged.connect(lambda _: ask_room_for_shown_page(made))
    return made


def bare_widget(layout: QtWidgets.QLayout) -> QtWidgets.QWidget:
    """Return an unstyled widget with this layout."""
    made = QtWidgets.QWidget()
    made.setLayout(layout)
    return made


def set_role(widget: QtWidgets.QWidget, role: str) -> None:
    """Change a widget's role and style."""
    if (widget.property("role") or "") != role:
        widget.setProperty("role", role)
        widget.style().unpolish(widget)
        widget.style().polish(widget)


def table(header: Sequence[str]) -> QtWidgets.QTableWidget:
    """Return a read-only table with selectable rows."""
    made = QtWidgets.QTableWidget(0, len(header))
    made.setHorizontalHeaderLabels(list(header))
    made.verticalHeader().hide()
    made.setEditTriggers(QtWidgets.QAbstractItemView.EditTrigger.NoEditTriggers)
    made.setSelectionBehavior(QtWidgets.QAbstractItemView.SelectionBehavior.SelectRows)
    made.setAlternatingRowColors(True)
    made.setShowGrid(False)
    made.setTabKeyNavigation(False)
    made.horizontalHeader().setSectionResizeMode(QtWidgets.QHeaderView.ResizeMode.ResizeToContents)
    made.horizontalHeader().setStretchLastSection(True)
    made.horizontalHeader().setHighlightSections(False)
    made.horizontalHeader().setDefaultAlignment(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter)
    # Where the columns before it leave no room, the last has this width.
    made.horizontalHeader().ensurePolished()
    made.horizontalHeader().setDefaultSectionSize(made.horizontalHeader().sectionSizeHint(len(header) - 1))
    return made


def fill_table(target: QtWidgets.QTableWidget, rows: Sequence[Sequence[str]], *, numbers: bool = True) -> None:
    """Fill a table with text; numbers are aligned right, except in the last column or without `numbers`."""
    columns = target.horizontalHeader()
    # Else each text would have its whole column measured again: minutes for some hundred rows.
    columns.setSectionResizeMode(QtWidgets.QHeaderView.ResizeMode.Fixed)
    target.setRowCount(len(rows))
    for row_index, cells in enumerate(rows):
        for index, text in enumerate(map(printable, cells)):
            item = QtWidgets.QTableWidgetItem(text)
            item.setToolTip(text)
            # The last column takes the remaining width.
            if numbers and index < len(cells) - 1 and _NUMBER_TEXT.fullmatch(text):
                item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
            target.setItem(row_index, index, item)
    columns.setSectionResizeMode(QtWidgets.QHeaderView.ResizeMode.ResizeToContents)


def current_item(tree: QtWidgets.QTreeWidget) -> QtWidgets.QTreeWidgetItem | None:
    """Return the current item; the types of Qt say there always is one."""
    return tree.currentItem()


def top_items(tree: QtWidgets.QTreeWidget) -> list[QtWidgets.QTreeWidgetItem]:
    """Return the top-level items."""
    items = (tree.topLevelItem(index) for index in range(tree.topLevelItemCount()))
    return [item for item in items if item is not None]


def parent_of(item: QtWidgets.QTreeWidgetItem) -> QtWidgets.QTreeWidgetItem | None:
    """Return the parent item, if any."""
    return item.parent()


def _fill_layout(
    layout: QtWidgets.QHBoxLayout | QtWidgets.QVBoxLayout,
    widgets: Sequence[QtWidgets.QWidget | QtWidgets.QLayout | int],
    margin: int,
    stretch: Mapping[int, int],
) -> None:
    layout.setContentsMargins(margin, margin, margin, margin)
    layout.setSpacing(8)
    for index, widget in enumerate(widgets):
        if isinstance(widget, int):
            layout.addStretch(widget)
        elif isinstance(widget, QtWidgets.QWidget):
            layout.addWidget(widget, stretch.get(index, 0))
        else:
            layout.addLayout(widget, stretch.get(index, 0))


def choose_path(
    parent: QtWidgets.QWidget,
    title: str,
    start: str,
    chosen: Callable[[str], None],
    *,
    filter_: str = "",
    folder: bool = True,
    new_file: str = "",
) -> None:
    """Ask for a folder, for an existing file of the types in `filter_`, or for a new file that ends in `new_file`."""
    dialog = QtWidgets.QFileDialog(parent, title, start, filter_)
    # The system's own dialog would keep Escape from the stop.
    dialog.setOption(QtWidgets.QFileDialog.Option.DontUseNativeDialog)
    dialog.setFileMode(
        QtWidgets.QFileDialog.FileMode.Directory if folder else QtWidgets.QFileDialog.FileMode.ExistingFile
    )
    if new_file:
        dialog.setAcceptMode(QtWidgets.QFileDialog.AcceptMode.AcceptSave)
        dialog.setFileMode(QtWidgets.QFileDialog.FileMode.AnyFile)
        dialog.setDefaultSuffix(new_file)
    dialog.fileSelected.connect(chosen)
    dialog.open()


class Topic(StrEnum):
    """What a complaint is about: it goes away by itself once this is settled."""

    ANY = "any"
    """Until it is dismissed."""
    SESSION = "session"
    """Until the next session starts."""
    PASSING = "passing"
    """Until the next session starts, or half a minute is over: the person did it."""
    HAND = "by hand"
    """Until the next motion by hand or calibration starts."""
    CLOSING = "closing"
    """Until no session is running."""
    GUARD = "guard"
    """Until the guard is armed."""
    LOOK = "look"
    """Until other runs are read."""
    DIAGNOSIS = "diagnosis"
    """Until the next diagnosis starts."""


class StoredSettings:
    """Settings stored between sessions; a missing or invalid one has its default."""

    def __init__(self, settings: QSettings | None = None) -> None:
        self._settings = settings or QSettings("dragrig", "window")

    def text(self, name: str, default: str = "") -> str:
        """Return a text."""
        value = self._settings.value(name)
        return value if isinstance(value, str) else default

    def number(self, name: str, default: float) -> float:
        """Return a number."""
        try:
            return read_number(self.text(name))
        except SettingsError:
            return default

    def shape(self, name: str) -> QByteArray | None:
        """Return the geometry of a window, or the state of a border."""
        value = self._settings.value(name)
        return value if isinstance(value, QByteArray) else None

    def keep(self, name: str, value: str | float | QByteArray, *, at_once: bool = False) -> None:
        """Store a value; on disk before this returns where `at_once` says so."""
        self._settings.setValue(name, value if isinstance(value, QByteArray) else str(value))
        if at_once:
            self._settings.sync()


MIN_FIGURE_WIDTH_PX = 520
ROW_PX = 30


class DocumentView(QtWidgets.QWidget):
    """Shows a document whose figures are drawn already (`present.files.drawn`)."""

    def __init__(self) -> None:
        super().__init__()
        self.answer = label("", "title", wrap=True)
        self.tabs = QtWidgets.QTabWidget()
        self.setLayout(column(self.answer, self.tabs, stretch={1: 1}))

    def show_document(self, document: present.Document, pages: Mapping[str, QtWidgets.QWidget] | None = None) -> None:
        """Show a document; `pages` are further tabs by their titles, which stay the caller's."""
        pages = pages or {}
        self.answer.setText(_plain(document.answer or document.title))
        problem = (f"! {document.problem}",) if document.problem else ()
        # It scrolls with the first tab: above them all it would take the room of a figure.
        lead = [label(_plain(sentence), wrap=True) for sentence in (*problem, *document.lead)]
        while self.tabs.count():
            page = self.tabs.widget(0)
            self.tabs.removeTab(0)
            if page not in pages.values():
                page.deleteLater()
        for section in document.content:
            area = scrolling(column(*(() if self.tabs.count() else lead), *_widgets(section.content), 1, margin=10))
            self.tabs.addTab(area, _plain(section.heading or "Result"))
        for title, page in pages.items():
            self.tabs.addTab(page, title)
        # A single section without a heading says nothing that the answer does not.
        self.tabs.tabBar().setVisible(self.tabs.count() > 1 or any(section.heading for section in document.content))


def _widgets(blocks: tuple[present.Block, ...]) -> Iterator[QtWidgets.QWidget]:
    for block in blocks:
        match block:
            case present.Text() if block.kind is not present.TextKind.EXPLANATION:
                yield label(_plain(block.text), wrap=True)
            case present.Items():
                mark = "! " if block.remarks else "• "
                yield label("\n".join(f"{mark}{_plain(item)}" for item in block.items), wrap=True)
            case present.Facts():
                facts = (f"{name}: {value}" for name, value in block.values.items() if value)
                yield label(printable("\n".join(facts)), wrap=True)
            case present.Code():
                yield label(printable(block.text))
            case present.Table():
                yield from _table(block)
            case present.Figure():
                figure = DrawnFigure(block)
                yield figure
                yield label(_plain(block.caption), "faint", wrap=True)
                yield figure.saving
            case present.Section():
                yield label(_plain(block.heading), "title", wrap=True)
                yield from _widgets(block.content)
            case present.Text():
                pass


def _table(block: present.Table) -> Iterator[QtWidgets.QWidget]:
    if block.caption:
        yield label(_plain(block.caption), "faint", wrap=True)
    shown = named(table([column.heading for column in block.columns]), block.caption or block.name)
    rows = block.brief_cells
    fill_table(shown, [[cell.text for cell in row] for row in rows])
    fit_height(shown, len(rows))
    yield shown
    if block.omitted_text:
        yield label(block.omitted_text, "faint")


def fit_height(shown: QtWidgets.QTableWidget, rows: int, row_px: int = ROW_PX) -> None:
    """Make a table as tall as its rows, so that the page scrolls and not the table in it."""
    shown.setVerticalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
    shown.verticalHeader().setDefaultSectionSize(row_px)
    shown.setFixedHeight(shown.horizontalHeader().sizeHint().height() + row_px * rows + 20)


_PICTURES: Mapping[str, str] = {"pdf": "PDF", "svg": "SVG", "png": f"PNG, {present.PRINT_DPI} dpi"}
"""Endings of the files that a figure can be saved in, and what they are called."""


def require_ending(ending: str, known: Iterable[str]) -> None:
    """Raise `OutputError` for the ending of a file that a picture cannot be saved in."""
    if ending not in known:
        raise OutputError(f".{ending}: a picture is saved as {', '.join(known)}; change the name's ending.")


def ask_where(parent: QtWidgets.QWidget, name: str, ending: str, save: Callable[[str], None]) -> None:
    """Ask for the file that a picture is saved in."""
    types = f"{ending.upper()} (*.{ending})"
    choose_path(parent, "Save the picture", f"{name}.{ending}", save, filter_=types, folder=False, new_file=ending)


def save_picture(path: str, content: Callable[[str], bytes]) -> str:
    """Write a picture as its name's ending says; return a sentence on the outcome."""
    try:
        present.write_picture(content(Path(path).suffix.lower().removeprefix(".")), Path(path))
    except DragrigError as error:
        return str(error)
    return f"Saved: {path}"


def picture_of_width(svg: str, width_mm: float, ending: str) -> bytes:
    """Return a drawn figure as the content of a PDF, SVG or PNG file, so wide in print.

    Raises `OutputError` for another ending.
    """
    require_ending(ending, _PICTURES)
    if ending == "svg":
        return present.svg_of_width(svg, width_mm).encode()
    renderer = QSvgRenderer(QByteArray(svg.encode()))
    drawn_size = renderer.defaultSize()
    size_mm = QSizeF(width_mm, width_mm * drawn_size.height() / max(drawn_size.width(), 1))
    content = QBuffer()
    content.open(QIODevice.OpenModeFlag.WriteOnly)
    if ending == "pdf":
        page = QtGui.QPdfWriter(content)
        page.setPageSize(
            QtGui.QPageSize(size_mm, QtGui.QPageSize.Unit.Millimeter, "", QtGui.QPageSize.SizeMatchPolicy.ExactMatch)
        )
        page.setPageMargins(QMarginsF(0.0, 0.0, 0.0, 0.0))
        _paint(renderer, page)
    else:
        dots_per_mm = present.PRINT_DPI / 25.4
        picture = QtGui.QImage((size_mm * dots_per_mm).toSize(), QtGui.QImage.Format.Format_RGB32)
        picture.setDotsPerMeterX(round(1000 * dots_per_mm))
        picture.setDotsPerMeterY(round(1000 * dots_per_mm))
        picture.fill(Qt.GlobalColor.white)
        _paint(renderer, picture)
        return png_of(picture)
    return bytes(content.data().data())


def png_of(picture: QtGui.QImage) -> bytes:
    """Return a picture as the content of a PNG file."""
    content = QBuffer()
    QtGui.QImageWriter(content, QByteArray(b"png")).write(picture)
    return bytes(content.data().data())


def _paint(renderer: QSvgRenderer, on: QtGui.QPaintDevice) -> None:
    painter = QtGui.QPainter(on)
    renderer.render(painter)
    painter.end()


class DrawnFigure(QSvgWidget):
    """A figure as wide as there is room, its proportions kept."""

    def __init__(self, figure: present.Figure) -> None:
        super().__init__()
        if not isinstance(figure.drawing, str):
            raise TypeError(f"the figure {figure.name} is not drawn yet; show drawn(document)")
        self.load(QByteArray(figure.drawing.encode()))
        # What is loaded brings a mode of its own.
        self.renderer().setAspectRatioMode(Qt.AspectRatioMode.KeepAspectRatio)
        self.setAccessibleName(figure.shows)
        policy = QtWidgets.QSizePolicy(QtWidgets.QSizePolicy.Policy.Expanding, QtWidgets.QSizePolicy.Policy.Preferred)
        policy.setHeightForWidth(True)
        self.setSizePolicy(policy)
        self.setMinimumSize(QSize(MIN_FIGURE_WIDTH_PX, self.heightForWidth(MIN_FIGURE_WIDTH_PX)))
        self._svg = figure.drawing
        self._answer = label("", "faint", wrap=True)
        width = f"The figure {present.DOUBLE_COLUMN_MM:.0f} mm wide, which fits two columns of most journals"
        self.saving = bare_widget(
            row(
                *(
                    button(f"Save as {words}…", partial(ask_where, self, figure.name, ending, self.save), "", width)
                    for ending, words in _PICTURES.items()
                ),
                self._answer,
                stretch={len(_PICTURES): 1},
            )
        )
        """What saves it."""

    def save(self, path: str) -> None:
        """Write the figure as its name's ending says, as wide as two columns of a journal, and say what came of it."""
        self._answer.setText(
            save_picture(path, lambda ending: picture_of_width(self._svg, present.DOUBLE_COLUMN_MM, ending))
        )

    def hasHeightForWidth(self) -> bool:
        """Whether the height follows from the width."""
        return True

    def heightForWidth(self, width: int) -> int:
        """Height at a width, in the figure's proportions."""
        size = self.renderer().defaultSize()
        return width * size.height() // max(size.width(), 1)


def _plain(text: str) -> str:
    return printable(text.replace("`", ""))
