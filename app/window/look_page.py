"""The page that shows runs: browser, overlaid traces with cursors, steady forces, export."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PySide6.QtCore import Qt, Signal
from PySide6.QtGui import QKeySequence, QShortcut
from PySide6.QtWidgets import (
    QAbstractItemView,
    QCheckBox,
    QComboBox,
    QDoubleSpinBox,
    QHeaderView,
    QLineEdit,
    QMenu,
    QSpinBox,
    QSplitter,
    QTabWidget,
    QToolButton,
    QTreeWidget,
    QTreeWidgetItem,
    QWidget,
)

from dragrig.present.palette import BLACK, CYCLE, PALE, VERMILLION, tint
from dragrig.views.run_view import (
    FORMATS,
    ShownCampaign,
    ShownRun,
    ShownTrace,
    campaigns_below,
    export_shown_runs,
    shown_campaign,
    shown_trace,
    steady_rows,
)
from dragrig.window.background import FileWorker
from dragrig.window.plots import PlotCursor, TimePlot
from dragrig.window.trace_pyramid import TracePyramid
from dragrig.window.widgets import (
    StoredSettings,
    button,
    card,
    choose_path,
    column,
    current_item,
    fill_table,
    label,
    named,
    parent_of,
    row,
    table,
    top_items,
)

_RUN_ROLE = int(Qt.ItemDataRole.UserRole)


class RunBrowser(QWidget):
    """Shows what lies below a folder; `chosen` tells the run files that are selected."""

    chosen = Signal(list)
    complained = Signal(str)
    campaign_chosen = Signal(str)

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = named(QLineEdit(str(folder)), "Folder of campaigns")
        self.folder.editingFinished.connect(self._edited)
        self.choose = button("&Folder …", self._choose, help_="Look at another folder")
        self.again = button("Refres&h", self.refresh, help_="Look what is there now", keys="F5")
        self.tree = QTreeWidget()
        self.tree.setHeaderLabels(["Run", "Status", "Begun"])
        self.tree.setAccessibleName("Campaigns and runs")
        self.tree.setSelectionMode(QAbstractItemView.SelectionMode.ExtendedSelection)
        self.tree.header().setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        self.tree.itemExpanded.connect(self._open)
        self.tree.itemSelectionChanged.connect(self._select)
        self.settings = named(table(("Setting", "Value")), "Settings of the chosen run")
        self._listing = FileWorker(self.complained.emit, self)
        self._opening = FileWorker(self.complained.emit, self)
        self._wanted: Path | None = None
        self._listed = ""
        layout = column(
            label("Runs", "title"),
            self.folder,
            row(self.choose, self.again, 1),
            self.tree,
            label("What the chosen run says of itself", "faint"),
            self.settings,
            stretch={3: 3, 5: 2},
        )
        self.setLayout(layout)

    @property
    def busy(self) -> bool:
        """Whether a folder is being read."""
        return self._listing.busy or self._opening.busy

    def refresh(self) -> None:
        """Look again what is there."""
        self._listed = self.folder.text()
        folder = Path(self._listed)
        self._listing.do(lambda: campaigns_below(folder), self._list)

    def look_at(self, folder: Path) -> None:
        """Show a campaign and select its runs."""
        self._wanted = folder
        if not folder.is_relative_to(Path(self.folder.text())):
            self.folder.setText(str(folder.parent))
        self.refresh()

    def selected(self) -> list[ShownRun]:
        """Return the runs that are selected, those of a selected campaign too."""
        found: dict[Path, ShownRun] = {}
        for item in self.tree.selectedItems():
            items = (
                [item] if item.data(0, _RUN_ROLE) is not None else [item.child(at) for at in range(item.childCount())]
            )
            runs = [one.data(0, _RUN_ROLE) for one in items]
            found |= {run.path: run for run in runs if isinstance(run, ShownRun)}
        return list(found.values())

    def campaign(self) -> Path | None:
        """Return the campaign that is chosen, or that a chosen run belongs to."""
        item = current_item(self.tree)
        if item is None:
            return None
        top = parent_of(item) or item
        return Path(top.toolTip(0))

    def close_down(self) -> None:
        """Wait for what is being read."""
        self._listing.drop()
        self._opening.drop()

    def _edited(self) -> None:
        # Qt tells of this whenever the field is left, and a new list would forget what is selected.
        if self.folder.text() != self._listed:
            self.refresh()

    def _list(self, found: object) -> None:
        folders = [one for one in found if isinstance(one, Path)] if isinstance(found, tuple) else []
        self.tree.clear()
        root = Path(self._listed)
        for folder in folders:
            name = folder.name if folder == root else str(folder.relative_to(root))
            item = QTreeWidgetItem([name, "", ""])
            item.setToolTip(0, str(folder))
            item.setChildIndicatorPolicy(QTreeWidgetItem.ChildIndicatorPolicy.ShowIndicator)
            self.tree.addTopLevelItem(item)
        wanted, self._wanted = self._wanted, None
        for item in top_items(self.tree):
            if item.toolTip(0) == str(wanted) or len(folders) == 1:
                item.setExpanded(True)
                self.tree.setCurrentItem(item)

    def _open(self, item: QTreeWidgetItem) -> None:
        if item.childCount() == 0:
            folder = Path(item.toolTip(0))
            self._opening.do_too(lambda: shown_campaign(folder), self._put)

    def _put(self, found: object) -> None:
        if not isinstance(found, ShownCampaign):
            return
        for item in top_items(self.tree):
            if item.toolTip(0) == str(found.folder) and item.childCount() == 0:
                for run in found.runs:
                    # The day stands in the campaign's name, and where the mouse is.
                    begun = run.start.split()[-1]
                    child = QTreeWidgetItem([run.words, f"BAD: {run.bad}" if run.bad else run.status, begun])
                    child.setToolTip(2, run.start)
                    child.setData(0, _RUN_ROLE, run)
                    item.addChild(child)
                if item.isSelected():
                    self._select()
        for problem in found.problems:
            self.complained.emit(problem)

    def _select(self) -> None:
        runs = self.selected()
        if runs:
            said = [(key.replace("_", " "), value) for key, value in runs[-1].settings.items() if value]
            fill_table(self.settings, said, numbers=False)
        if (folder := self.campaign()) is not None:
            self.campaign_chosen.emit(str(folder))
        self.chosen.emit(runs)

    def _choose(self) -> None:
        choose_path(self, "Folder of campaigns", self.folder.text(), self.open_folder)

    def open_folder(self, path: str) -> None:
        """Look at another folder."""
        self.folder.setText(path)
        self.refresh()


MAX_OVERLAID = 7
"""So many runs lie over each other at once, each with a colour of its own."""

_PAN_SHARE = 0.2
_CURSOR_STEPS = 200


class TraceOverlay(QWidget):
    """Draws runs; what the filter makes of them stands in the foreground, the raw trace behind it."""

    def __init__(self) -> None:
        super().__init__()
        self.traces: list[ShownTrace] = []
        self.top, self.below = TimePlot("Force", "mN"), TimePlot("Speed", "mm/s")
        self.top.hide_times()
        self.top.follow(self.below)
        self.channel = QComboBox()
        self.channel.addItems(["force"])
        self.channel.setAccessibleName("Channel")
        self.channel.currentTextChanged.connect(lambda _: self.draw())
        self.raw = QCheckBox("Ra&w")
        self.raw.setChecked(True)
        self.raw.toggled.connect(lambda _: self.draw())
        self.window_ms = QDoubleSpinBox()
        self.window_ms.setRange(1.0, 5000.0)
        self.window_ms.setValue(50.0)
        self.window_ms.setSuffix(" ms")
        self.window_ms.setKeyboardTracking(False)
        self.window_ms.setAccessibleName("Length of the filter's window")
        self.order = QSpinBox()
        self.order.setRange(0, 8)
        self.order.setValue(3)
        self.order.setAccessibleName("Order of the filter")
        self.fit = button(
            "Show a&ll", self.show_all, help_="Everything, from the first sample to the last", keys="Ctrl+0"
        )
        self.cursors = QCheckBox("&Cursors")
        self.cursors.toggled.connect(lambda shown: self._show_cursors(shown=shown))
        self.values = named(table(("Run", "At A", "At B", "B − A")), "Values at the cursors")
        self.values.setMaximumHeight(170)
        self.values.hide()
        self._pyramids: dict[tuple[int, str, bool], TracePyramid] = {}
        self._cursors = tuple(
            self.top.cursor(name, colour, lambda _: self._tell()) for name, colour in (("A", BLACK), ("B", VERMILLION))
        )
        controls = row(
            label("Channel"), self.channel, self.raw, label("Filter"), self.window_ms, label("order"), self.order, 1,
            self.cursors, self.fit,
        )  # fmt: skip
        layout = column(controls, self.top.widget, self.below.widget, self.values, margin=8, stretch={1: 3, 2: 2})
        self.setLayout(layout)
        self._listen_to_keys()

    def show_traces(self, traces: Sequence[ShownTrace]) -> None:
        """Show runs in place of those before; where the same runs were shown, what is seen of them stays."""
        same = [one.path for one in traces] == [one.path for one in self.traces]
        self.traces = list(traces)
        self._pyramids = {}
        chosen = self.channel.currentText()
        names = list(dict.fromkeys(name for one in traces for name in one.channels)) or ["force"]
        self.channel.blockSignals(True)
        self.channel.clear()
        self.channel.addItems(names)
        self.channel.setCurrentText(chosen if chosen in names else names[0])
        self.channel.blockSignals(False)
        self.draw()
        if not same:
            self.show_all()

    def draw(self) -> None:
        """Draw the lines anew."""
        name = self.channel.currentText()
        for panel in (self.top, self.below):
            panel.forget_lines()
        unit = next((one.units.get(name, "") for one in self.traces), "")
        self.top.rename(name.replace("_", " ").capitalize(), unit)
        if self.raw.isChecked():
            for at, one in enumerate(self.traces):
                if name in one.channels:
                    colour = PALE if len(self.traces) == 1 else tint(CYCLE[at % MAX_OVERLAID])
                    self._put(self.top, at, name, colour, 1.0, filtered=False)
        for at, one in enumerate(self.traces):
            colour = CYCLE[at % MAX_OVERLAID]
            # A channel that no filter was made for is shown as it is.
            self._put(self.top, at, name, colour, 2.0, filtered=name in one.filtered)
            if "speed" in one.filtered:
                self._put(self.below, at, "speed", colour, 2.0, filtered=True)
        self.top.title(*((one.words, CYCLE[at % MAX_OVERLAID]) for at, one in enumerate(self.traces)))
        for panel in (self.top, self.below):
            panel.redraw()
        self._tell()

    def show_all(self) -> None:
        """Show everything."""
        for panel in (self.below, self.top):
            panel.fit()

    def place_cursors(self, first_s: float, second_s: float) -> None:
        """Put the cursors somewhere."""
        for cursor, time_s in zip(self._cursors, (first_s, second_s), strict=True):
            cursor.place(time_s, visible=self.cursors.isChecked())

    def _listen_to_keys(self) -> None:
        first, second = self._cursors
        for keys, does in (
            ("Ctrl++", lambda: self.below.zoom(0.5)),
            ("Ctrl+-", lambda: self.below.zoom(2.0)),
            ("Ctrl+Left", lambda: self.below.pan(-_PAN_SHARE)),
            ("Ctrl+Right", lambda: self.below.pan(_PAN_SHARE)),
            ("Alt+Left", lambda: self._step(first, -1)),
            ("Alt+Right", lambda: self._step(first, 1)),
            ("Alt+Shift+Left", lambda: self._step(second, -1)),
            ("Alt+Shift+Right", lambda: self._step(second, 1)),
        ):
            QShortcut(QKeySequence(keys), self).activated.connect(does)
        self.fit.setToolTip("Everything, from the first sample to the last (Ctrl+0); Ctrl and + − ← → zoom and pan")
        self.cursors.setToolTip("Two times and their values; Alt and ← → move A, with Shift B")

    def _step(self, cursor: PlotCursor, way: int) -> None:
        if self.cursors.isChecked():
            low, high = self.top.shown()
            cursor.place(cursor.time_s + way * (high - low) / _CURSOR_STEPS)

    def _put(self, panel: TimePlot, at: int, name: str, colour: str, width: float, *, filtered: bool) -> None:
        trace = self.traces[at]
        source = trace.filtered if filtered else trace.channels
        if name not in source:
            return
        key = (at, name, filtered)
        if key not in self._pyramids:
            self._pyramids[key] = TracePyramid()
            self._pyramids[key].append(source[name])
        panel.line("", colour, width).trace(self._pyramids[key], trace.rate_hz, trace.start_s)

    def _show_cursors(self, *, shown: bool) -> None:
        low, high = self.top.shown()
        self.place_cursors(*(low + share * (high - low) for share in (0.33, 0.67)))
        self.values.setVisible(shown)
        self._tell()

    def _tell(self) -> None:
        if not self.cursors.isChecked():
            return
        name = self.channel.currentText()
        first, second = (one.time_s for one in self._cursors)
        rows = [("time (s)", f"{first:.4f}", f"{second:.4f}", f"{second - first:.4f}")]
        for one in self.traces:
            values = one.filtered.get(name, one.channels.get(name))
            if values is not None:
                a, b = (_value_at(values, (time - one.start_s) * one.rate_hz) for time in (first, second))
                rows.append(
                    (
                        f"{one.words}: {name} ({one.units.get(name, '')})",
                        _cursor_text(a),
                        _cursor_text(b),
                        _cursor_text(b - a),
                    )
                )
        fill_table(self.values, rows)


def _value_at(values: "np.ndarray[tuple[int, ...], np.dtype[np.float32]]", place: float) -> float:
    index = round(place)
    return float(values[index]) if 0 <= index < len(values) else float("nan")


def _cursor_text(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else "none"


_STEADY_HEADER = (
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

    def __init__(self, folder: Path, remembered: StoredSettings) -> None:
        super().__init__()
        self.setObjectName("page")
        self._remembered = remembered
        self.browser, self.overlay = RunBrowser(Path(remembered.text("look folder", str(folder)))), TraceOverlay()
        self.overlay.window_ms.setValue(remembered.number("filter window", 50.0))
        self.overlay.order.setValue(round(remembered.number("filter order", 3)))
        self.steady = named(table(_STEADY_HEADER), "Steady forces of the chosen runs")
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
        self._traces = FileWorker(self._refused, self)
        self._table = FileWorker(self._refused, self)
        self._exporting = FileWorker(self._refused, self)
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
        self._exporting.do_too(lambda: export_shown_runs(paths, folder, kind), self._exported)

    def _choose(self, runs: Sequence[ShownRun]) -> None:
        self._chosen = list(runs)
        self.export.setEnabled(bool(runs))
        self._load()
        paths = [one.path for one in runs]
        self._table.do(lambda: steady_rows(paths), self._show_steady)

    def _load(self) -> None:
        paths = [one.path for one in self._chosen[:MAX_OVERLAID]]
        window_s, order = 1e-3 * self.overlay.window_ms.value(), self.overlay.order.value()
        self.state.setText(f"Reading {len(paths)} runs …" if paths else "Choose runs on the left.")
        self._traces.do(lambda: tuple(shown_trace(path, window_s, order) for path in paths), self._show_traces)

    def _show_traces(self, found: object) -> None:
        traces = [one for one in found if isinstance(one, ShownTrace)] if isinstance(found, tuple) else []
        self.overlay.show_traces(traces)
        more = (
            f" of {len(self._chosen)}; {MAX_OVERLAID} lie over each other at most"
            if len(self._chosen) > MAX_OVERLAID
            else ""
        )
        self.state.setText(f"{len(traces)} run{'' if len(traces) == 1 else 's'} shown{more}.")

    def _show_steady(self, found: object) -> None:
        rows = found if isinstance(found, tuple) else ()
        fill_table(
            self.steady,
            [
                (
                    f"{one.order}  {one.kind}",
                    _decimal_text(one.speed_mm_s, 1),
                    _decimal_text(one.steady_force_mN, 2),
                    _decimal_text(one.steady_force_error_mN, 2),
                    _decimal_text(one.rest_offset_mN, 2),
                    _decimal_text(one.peak_force_mN, 2),
                    _decimal_text(one.hold_force_mN, 2),
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
        start = self._remembered.text("export folder")
        choose_path(self, f"Folder for {name} files", start, lambda path: self._export_there(path, name))

    def _export_there(self, path: str, name: str) -> None:
        self._remembered.keep("export folder", path)
        self.export_to(Path(path), name)


def _decimal_text(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
