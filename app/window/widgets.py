"""Small widgets that every page is made of."""

import re
from collections.abc import Callable, Sequence

from PySide6.QtCore import Qt
from PySide6.QtGui import QKeySequence, QShortcut
from PySide6.QtWidgets import (
    QAbstractItemView,
    QFrame,
    QHBoxLayout,
    QHeaderView,
    QLabel,
    QLayout,
    QPushButton,
    QSizePolicy,
    QTableWidget,
    QTableWidgetItem,
    QTreeWidget,
    QTreeWidgetItem,
    QVBoxLayout,
    QWidget,
)

_NUMBER = re.compile(r"[-−+]?[\d.]+( \S+){0,3}")


def label(text: str = "", role: str = "", *, wrap: bool = False) -> QLabel:
    """Return a label that can be read out and copied; `role` is one of the theme's."""
    made = QLabel(text)
    made.setProperty("role", role)
    made.setWordWrap(wrap)
    made.setTextFormat(Qt.TextFormat.PlainText)
    made.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    if wrap:
        made.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Minimum)
    return made


def button(text: str, pressed: Callable[[], None], role: str = "", help_: str = "", keys: str = "") -> QPushButton:
    """Return a button; `keys` is its shortcut, which its help tells."""
    made = QPushButton(text)
    made.setProperty("role", role)
    made.setAutoDefault(False)
    made.clicked.connect(lambda _checked=False: pressed())
    if keys:
        # Not the button's own shortcut, which would take the place of its letter.
        QShortcut(QKeySequence(keys), made).activated.connect(made.click)
    told = f"{help_} ({keys})" if keys and help_ else help_ or keys
    made.setToolTip(told)
    made.setAccessibleName(text.replace("&", ""))
    return made


def row(*widgets: QWidget | QLayout | int, margin: int = 0) -> QHBoxLayout:
    """Return widgets side by side; a number is a stretch."""
    made = QHBoxLayout()
    _fill(made, widgets, margin)
    return made


def column(*widgets: QWidget | QLayout | int, margin: int = 0) -> QVBoxLayout:
    """Return widgets one below the other; a number is a stretch."""
    made = QVBoxLayout()
    _fill(made, widgets, margin)
    return made


def card(*widgets: QWidget | QLayout | int, role: str = "card", across: bool = False) -> QFrame:
    """Return a framed group."""
    made = QFrame()
    made.setProperty("role", role)
    made.setLayout(row(*widgets, margin=10) if across else column(*widgets, margin=10))
    return made


def holder(layout: QLayout) -> QWidget:
    """Return a bare widget with this layout."""
    made = QWidget()
    made.setLayout(layout)
    return made


def give_role(widget: QWidget, role: str) -> None:
    """Change a widget's role, and its looks with it."""
    widget.setProperty("role", role)
    widget.style().unpolish(widget)
    widget.style().polish(widget)


def table(header: Sequence[str]) -> QTableWidget:
    """Return a table to read and to select rows of."""
    made = QTableWidget(0, len(header))
    made.setHorizontalHeaderLabels(list(header))
    made.verticalHeader().hide()
    made.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
    made.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
    made.setAlternatingRowColors(True)
    made.setShowGrid(False)
    made.setTabKeyNavigation(False)
    made.horizontalHeader().setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
    made.horizontalHeader().setStretchLastSection(True)
    made.horizontalHeader().setHighlightSections(False)
    made.horizontalHeader().setDefaultAlignment(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter)
    return made


def fill(target: QTableWidget, rows: Sequence[Sequence[str]], *, numbers: bool = True) -> None:
    """Put rows of text into a table; what reads as a number stands to the right, where there are columns of numbers."""
    target.setRowCount(len(rows))
    for at, cells in enumerate(rows):
        for place, text in enumerate(cells):
            item = QTableWidgetItem(text)
            item.setToolTip(text)
            # The last column is as wide as is left.
            if numbers and place < len(cells) - 1 and _NUMBER.fullmatch(text):
                item.setTextAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
            target.setItem(at, place, item)


def current_item(tree: QTreeWidget) -> QTreeWidgetItem | None:
    """Return the item that the keyboard is at; Qt's own types forget that there may be none."""
    return tree.currentItem()


def top_items(tree: QTreeWidget) -> list[QTreeWidgetItem]:
    """Return the items that lie under no other."""
    found = (tree.topLevelItem(at) for at in range(tree.topLevelItemCount()))
    return [item for item in found if item is not None]


def parent_of(item: QTreeWidgetItem) -> QTreeWidgetItem | None:
    """Return the item that this one lies under."""
    return item.parent()


def _fill(layout: QHBoxLayout | QVBoxLayout, widgets: Sequence[QWidget | QLayout | int], margin: int) -> None:
    layout.setContentsMargins(margin, margin, margin, margin)
    layout.setSpacing(8)
    for one in widgets:
        if isinstance(one, int):
            layout.addStretch(one)
        elif isinstance(one, QWidget):
            layout.addWidget(one)
        else:
            layout.addLayout(one)
