"""How the window looks: sizes that can be read at a metre, colours that everybody can tell apart."""

from PySide6.QtGui import QColor, QFont, QFontDatabase, QPalette
from PySide6.QtWidgets import QApplication

from dragrig.figures.palette import BLACK, BLUE, GREEN, GREY, GRID, PALE, PAPER, VERMILLION

TEXT_PX, SMALL_PX, TITLE_PX, READING_PX = 15, 14, 20, 32
SURFACE = "#F3F5F7"
STOP = "#B00020"
"""Of the stop button alone; white on it stands out for every kind of colour vision, and it says STOP."""

_SHEET = f"""
* {{ font-size: {TEXT_PX}px; color: {BLACK}; }}
QMainWindow, QDialog, QWidget#page {{ background: {SURFACE}; }}
QLabel[role="title"] {{ font-size: {TITLE_PX}px; font-weight: 600; }}
QLabel[role="faint"] {{ color: {GREY}; font-size: {SMALL_PX}px; }}
QLabel[role="wrong"] {{ color: {STOP}; font-weight: 600; }}
QLabel[role="reading"] {{ font-size: {READING_PX}px; font-weight: 600; }}
QLabel[role="fine"] {{ color: #00664B; font-weight: 600; }}
QFrame[role="card"] {{ background: {PAPER}; border: 1px solid {GRID}; border-radius: 6px; }}
QFrame[role="notice"] {{ background: #FFF4D6; border: 2px solid #8A5A00; border-radius: 6px; }}
QFrame[role="trip"] {{ background: #FBE3E6; border: 3px solid {STOP}; border-radius: 6px; }}
QFrame[role="simulated"] {{ background: #E3F1FA; border: 2px dashed {BLUE}; border-radius: 6px; }}
QFrame[role="hardware"] {{ background: #FFE9D6; border: 3px solid {VERMILLION}; border-radius: 6px; }}
QPushButton, QToolButton {{ background: {PAPER}; border: 1px solid {PALE}; border-radius: 5px; padding: 7px 14px; }}
QToolButton[popupMode="2"] {{ padding-right: 30px; }}
QToolButton::menu-indicator {{ subcontrol-origin: padding; subcontrol-position: right center; right: 9px; }}
QPushButton:hover, QToolButton:hover {{ border-color: {BLUE}; }}
QPushButton:focus, QToolButton:focus {{ border: 2px solid {BLUE}; padding: 6px 13px; }}
QPushButton:disabled, QToolButton:disabled {{ color: {PALE}; background: {SURFACE}; }}
QPushButton[role="main"] {{ background: {BLUE}; color: white; font-weight: 600; border-color: {BLUE}; }}
QPushButton[role="main"]:focus {{ border: 2px solid {BLACK}; }}
QPushButton[role="main"]:disabled {{ background: {PALE}; border-color: {PALE}; color: white; }}
QPushButton[role="stop"] {{ background: {STOP}; color: white; font-size: 22px; font-weight: 800;
    border: 3px solid #6B0013; border-radius: 8px; padding: 8px 26px; }}
QPushButton[role="page"] {{ border: none; border-bottom: 4px solid transparent; border-radius: 0;
    background: transparent; font-size: 17px; padding: 10px 16px;
    min-width: 112px; }}
QPushButton[role="page"]:checked {{ border-bottom: 4px solid {BLUE}; font-weight: 700; }}
QPushButton[role="page"]:focus {{ background: #E3F1FA; }}
QLineEdit, QPlainTextEdit {{ background: {PAPER}; border: 1px solid {PALE};
    border-radius: 4px; padding: 5px 7px; selection-background-color: {BLUE}; selection-color: white; }}
QLineEdit:focus, QPlainTextEdit:focus {{ border: 2px solid {BLUE}; }}
QComboBox, QSpinBox, QDoubleSpinBox {{ min-height: 30px; }}
QComboBox QAbstractItemView {{ background: {PAPER}; selection-background-color: {BLUE}; selection-color: white; }}
QTreeWidget, QTableWidget, QListWidget {{ background: {PAPER}; border: 1px solid {GRID};
    alternate-background-color: {SURFACE};
    selection-background-color: #CFE6F5; selection-color: {BLACK}; }}
QTableWidget::item {{ padding: 0 7px; }}
QTableWidget::item:selected {{ background: #CFE6F5; color: {BLACK}; }}
QHeaderView::section {{ background: {SURFACE}; border: none; border-bottom: 1px solid {GRID}; padding: 5px 7px;
    color: {GREY}; }}
QTabBar::tab {{ background: transparent; padding: 8px 16px; border: none; color: {GREY}; }}
QTabBar::tab:selected {{ color: {BLACK}; font-weight: 600; border-bottom: 3px solid {BLUE}; }}
QTabWidget::pane {{ border: 1px solid {GRID}; border-radius: 6px; background: {PAPER}; }}
QScrollArea, QWidget#bare {{ background: transparent; border: none; }}
QProgressBar {{ background: {GRID}; border: none; border-radius: 4px; text-align: center; min-height: 22px; }}
QProgressBar::chunk {{ background: #8CC4E6; border-radius: 4px; }}
QSplitter::handle {{ background: {SURFACE}; }}
QToolTip {{ background: {BLACK}; color: white; border: none; padding: 6px; }}
QCheckBox::indicator {{ width: 18px; height: 18px; }}
QMenu {{ background: {PAPER}; border: 1px solid {PALE}; }}
QMenu::item {{ padding: 6px 22px; }}
QMenu::item:selected {{ background: {BLUE}; color: white; }}
"""
FINE = GREEN


def dress(application: QApplication) -> None:
    """Give the application its fonts, colours and sizes, alike on every machine and in dark and light desktops."""
    from importlib.resources import files

    import pyqtgraph

    font = files("matplotlib") / "mpl-data" / "fonts" / "ttf" / "DejaVuSans.ttf"
    bold = files("matplotlib") / "mpl-data" / "fonts" / "ttf" / "DejaVuSans-Bold.ttf"
    for one in (font, bold):
        QFontDatabase.addApplicationFontFromData(one.read_bytes())
    application.setStyle("Fusion")
    application.setFont(QFont("DejaVu Sans"))
    application.setPalette(_palette())
    application.setStyleSheet(_SHEET)
    pyqtgraph.setConfigOptions(background=PAPER, foreground=BLACK, antialias=False)


def _palette() -> QPalette:
    palette = QPalette(QColor(SURFACE))
    for role, colour in (
        (QPalette.ColorRole.Window, SURFACE),
        (QPalette.ColorRole.Base, PAPER),
        (QPalette.ColorRole.AlternateBase, SURFACE),
        (QPalette.ColorRole.Text, BLACK),
        (QPalette.ColorRole.WindowText, BLACK),
        (QPalette.ColorRole.ButtonText, BLACK),
        (QPalette.ColorRole.Highlight, BLUE),
        (QPalette.ColorRole.HighlightedText, PAPER),
        (QPalette.ColorRole.PlaceholderText, GREY),
    ):
        palette.setColor(role, QColor(colour))
    return palette
