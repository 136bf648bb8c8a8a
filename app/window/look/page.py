"""The page that looks at runs."""

from collections.abc import Sequence
from pathlib import Path

from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import QFileDialog, QMenu, QSplitter, QTabWidget, QToolButton, QWidget

from dragrig.looking import FORMATS, ShownRun, ShownTrace, export, shown_trace, steady_rows
from dragrig.window.background import Background
from dragrig.window.look.browser import Browser
from dragrig.window.look.overlay import MOST, Overlay
from dragrig.window.remembered import Remembered
from dragrig.window.widgets import card, column, fill, label, row, table

_STEADY = (
    "Run",
    "Speed (mm/s)",
    "Steady force (mN)",
    "±",
    "At rest (mN)",
    "Peak (mN)",
    "Hold (mN)",
    "Status",
    "Remark",
)


class LookPage(QWidget):
    """Browser, overlay, steady table, export."""

    complained = Signal(str)
    told = Signal(str)

    def __init__(self, folder: Path, remembered: Remembered) -> None:
        super().__init__()
        self.setObjectName("page")
        self._remembered = remembered
        self.browser, self.overlay = Browser(Path(remembered.text("look folder", str(folder)))), Overlay()
        self.overlay.window_ms.setValue(remembered.number("filter window", 50.0))
        self.overlay.order.setValue(round(remembered.number("filter order", 3)))
        self.steady = table(_STEADY)
        self.steady.setAccessibleName("Steady forces of the chosen runs")
        self.state = label("Choose runs on the left; several lie over each other.", "faint")
        self.export = QToolButton()
        self.export.setText("E&xport")
        self.export.setToolTip("Write the chosen runs for other programs")
        self.export.setPopupMode(QToolButton.ToolButtonPopupMode.InstantPopup)
        self.menu = QMenu(self)
        for name in FORMATS:
            self.menu.addAction(f"{name} …", lambda chosen=name: self._choose_place(chosen))
        self.export.setMenu(self.menu)
        self.export.setEnabled(False)
        self.tabs = QTabWidget()
        self.tabs.addTab(self.overlay, "&Traces")
        self.tabs.addTab(self.steady, "&Steady forces")
        self._chosen: list[ShownRun] = []
        self._traces = Background(self._refused, self)
        self._table = Background(self._refused, self)
        self._exporting = Background(self._refused, self)
        whole = QSplitter(Qt.Orientation.Horizontal)
        whole.addWidget(card(self.browser))
        right = QWidget()
        right.setLayout(column(row(self.state, 1, self.export), self.tabs))
        whole.addWidget(right)
        whole.setSizes([450, 1000])
        whole.setStretchFactor(1, 1)
        self.setLayout(column(whole, margin=8))
        self.browser.chosen.connect(self._choose)
        self.browser.complained.connect(self.complained.emit)
        self.overlay.window_ms.valueChanged.connect(lambda _: self._load())
        self.overlay.order.valueChanged.connect(lambda _: self._load())
        self.browser.refresh()

    def look_at(self, folder: Path) -> None:
        """Show a campaign."""
        self.browser.look_at(folder)

    def keep(self) -> None:
        """Remember what is chosen, and wait for what is being read."""
        self._remembered.keep("look folder", self.browser.folder.text())
        self._remembered.keep("filter window", self.overlay.window_ms.value())
        self._remembered.keep("filter order", float(self.overlay.order.value()))
        self.browser.close_down()
        for one in (self._traces, self._table):
            one.drop()
        self._exporting.finish()

    def export_to(self, folder: Path, name: str) -> None:
        """Write the chosen runs into a folder."""
        paths, kind = [one.path for one in self._chosen], FORMATS[name]
        self.state.setText(f"Writing {len(paths)} runs …")
        self._exporting.do_too(lambda: export(paths, folder, kind), self._exported)

    def _choose(self, runs: Sequence[ShownRun]) -> None:
        self._chosen = list(runs)
        self.export.setEnabled(bool(runs))
        self._load()
        paths = [one.path for one in runs]
        self._table.do(lambda: steady_rows(paths), self._show_steady)

    def _load(self) -> None:
        paths = [one.path for one in self._chosen[:MOST]]
        window_s, order = 1e-3 * self.overlay.window_ms.value(), self.overlay.order.value()
        self.state.setText(f"Reading {len(paths)} runs …" if paths else "Choose runs on the left.")
        self._traces.do(lambda: tuple(shown_trace(path, window_s, order) for path in paths), self._show_traces)

    def _show_traces(self, found: object) -> None:
        traces = [one for one in found if isinstance(one, ShownTrace)] if isinstance(found, tuple) else []
        self.overlay.show_traces(traces)
        more = f" of {len(self._chosen)}; {MOST} lie over each other at most" if len(self._chosen) > MOST else ""
        self.state.setText(f"{len(traces)} run{'' if len(traces) == 1 else 's'} shown{more}.")

    def _show_steady(self, found: object) -> None:
        rows = found if isinstance(found, tuple) else ()
        fill(
            self.steady,
            [
                (
                    f"{one.order}  {one.kind}",
                    _said(one.speed_mm_s, 1),
                    _said(one.steady_force_mN, 2),
                    _said(one.steady_force_error_mN, 2),
                    _said(one.rest_offset_mN, 2),
                    _said(one.peak_force_mN, 2),
                    _said(one.hold_force_mN, 2),
                    f"BAD: {one.mark}" if one.bad else one.status,
                    one.remark,
                )
                for one in rows
            ],
        )

    def _exported(self, found: object) -> None:
        paths = found if isinstance(found, tuple) else ()
        where = paths[0].parent if paths else ""
        self.state.setText(f"{len(paths)} file{'' if len(paths) == 1 else 's'} written to {where}.")

    def _refused(self, sentence: str) -> None:
        self.state.setText(sentence)
        self.complained.emit(sentence)

    def _choose_place(self, name: str) -> None:
        dialog = QFileDialog(self, f"Folder for {name} files", self._remembered.text("export folder"))
        dialog.setOption(QFileDialog.Option.DontUseNativeDialog)
        dialog.setFileMode(QFileDialog.FileMode.Directory)
        dialog.fileSelected.connect(lambda path: self._export_there(path, name))
        dialog.open()

    def _export_there(self, path: str, name: str) -> None:
        self._remembered.keep("export folder", path)
        self.export_to(Path(path), name)


def _said(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
