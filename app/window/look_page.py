"""The page of recorded runs: browser, overlaid traces with cursors, steady forces, export."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from PySide6.QtCore import QFileSystemWatcher, QSignalBlocker, Qt, QTimer, Signal
from PySide6.QtGui import QColor, QKeySequence, QShortcut
from PySide6.QtWidgets import (
    QAbstractItemView,
    QCheckBox,
    QComboBox,
    QHeaderView,
    QLineEdit,
    QMenu,
    QToolButton,
    QTreeWidget,
    QTreeWidgetItem,
    QWidget,
)

from dragrig.analysis import SpeedMean, TableRow, mean_per_speed
from dragrig.api import export, mark
from dragrig.config import NumberRange
from dragrig.present import BLACK, CYCLE, PALE, PAPER, VERMILLION, campaign_table_document, tint
from dragrig.views import (
    FORMATS,
    ListedCampaign,
    ShownCampaign,
    ShownRun,
    ShownTrace,
    campaigns_below,
    filtered_anew,
    recover_runs,
    shown_campaign,
    shown_trace,
    steady_rows,
)
from dragrig.window.background import FileWorker
from dragrig.window.forms import NumberField
from dragrig.window.plots import PlotCursor, TimePlot
from dragrig.window.prepared_traces import DrawingKey, PreparedTraces
from dragrig.window.trace_pyramid import TraceCrossings, TracePath, TracePyramid
from dragrig.window.widgets import (
    STOP_COLOUR,
    DocumentView,
    StoredSettings,
    bare_widget,
    button,
    card,
    choose_path,
    column,
    current_item,
    fill_table,
    fit_height,
    flow,
    label,
    named,
    parent_of,
    row,
    scrolling,
    split,
    table,
    tabs_of,
    themed,
    top_items,
)

RECORDING, UNREADABLE = "–  a recording", "–  unreadable"
"""Names of files that are no runs that can be read."""
_RUN_ROLE = int(Qt.ItemDataRole.UserRole)
_BROWSER_PX = 405
_FOLLOW_DELAY_MS = 500
"""A file is finished in several steps; the list is read again once they are over."""


class RunBrowser(QWidget):
    """The campaigns and runs in a folder, as they are made; `chosen` carries the selected runs."""

    chosen = Signal(list)
    complained = Signal(str)
    campaign_chosen = Signal(str)

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = named(QLineEdit(str(folder)), "Folder of campaigns")
        self.folder.editingFinished.connect(self._folder_edited)
        self.choose = button("&Folder …", self._choose_folder, help_="Open another folder")
        self.again = button("Refres&h", self.refresh, help_="Read the folder again", keys="F5")
        self.words_to_find = named(QLineEdit(), "Find runs")
        self.words_to_find.setPlaceholderText("find: kind, specimen, operator, day (2026-05-04), bad or good")
        self.words_to_find.setClearButtonEnabled(True)
        self.words_to_find.returnPressed.connect(self.refresh)
        self._found: dict[Path, frozenset[str] | None] = {}
        self.tree = QTreeWidget()
        self.tree.setHeaderLabels(["Run", "Started", "Status"])
        self.tree.setAccessibleName("Campaigns and runs")
        self.tree.setSelectionMode(QAbstractItemView.SelectionMode.ExtendedSelection)
        self.tree.header().setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        self.tree.header().setSectionResizeMode(2, QHeaderView.ResizeMode.Stretch)
        self.tree.itemExpanded.connect(self._load_runs)
        self.tree.itemSelectionChanged.connect(self._selection_changed)
        self.words = named(QLineEdit(), "Why the selected runs are bad, or a note on them")
        self.words.setPlaceholderText("why bad, or a note")
        self.bad = button("&Mark bad", self._mark, help_="Evaluations leave the selected runs out, for this reason")
        self.good = button("&Unmark", lambda: self._mark(bad=False), help_="The selected runs are good after all")
        self.note = button("&Note", self._note, help_="Note this on the selected runs; nothing removes their notes")
        self.recover = button("Reco&ver", self._recover, help_="Finish the recordings that a crash left")
        self._marking = FileWorker(self.complained.emit, self)
        self.settings = named(table(("Setting", "Value")), "Settings of the selected run")
        self._listing = FileWorker(self.complained.emit, self)
        self._opening = FileWorker(self.complained.emit, self)
        self._campaign_to_select: Path | None = None
        self._listed_folder = ""
        self.changes = QFileSystemWatcher(self)
        self._again_soon = QTimer(self)
        self._again_soon.setSingleShot(True)
        self._again_soon.setInterval(_FOLLOW_DELAY_MS)
        # Which nobody has asked for: a recording under way is nothing to report.
        self._again_soon.timeout.connect(lambda: self._read(quiet=True))
        self.words_to_find.textChanged.connect(lambda _: self._again_soon.start())
        self.changes.directoryChanged.connect(lambda _: self._again_soon.start())
        layout = column(
            row(self.folder, self.choose, self.again, stretch={0: 1}),
            self.words_to_find,
            self.tree,
            self.words,
            flow(self.bad, self.good, self.note, self.recover),
            self.settings,
            stretch={2: 3, 5: 2},
        )
        self.setLayout(layout)
        self.setMinimumWidth(_BROWSER_PX)
        self._show_what_can_be_done([])

    @property
    def busy(self) -> bool:
        """Whether a folder is being read."""
        return self._listing.busy or self._opening.busy

    def refresh(self) -> None:
        """Read the folder and its open campaigns again; what is selected stays, if it is still there."""
        if self.folder.text() != self._listed_folder:
            self.tree.clear()
        self._listed_folder = self.folder.text()
        self._again_soon.stop()  # it would take this reading's place, and tell nothing
        self._read()

    def _read(self, *, quiet: bool = False) -> None:
        folder, words = Path(self._listed_folder), self.words_to_find.text()
        self._listing.do(lambda: campaigns_below(folder, words), lambda listed: self._show_folders(listed, quiet=quiet))

    def look_at(self, folder: Path) -> None:
        """Show a campaign and select its runs."""
        self._campaign_to_select = folder
        if not folder.is_relative_to(Path(self.folder.text())):
            self.folder.setText(str(folder.parent))
        self.refresh()

    def selected(self) -> list[ShownRun]:
        """Return the selected runs, including those of selected campaigns."""
        selected: dict[Path, ShownRun] = {}
        for item in self.tree.selectedItems():
            own = item.data(0, _RUN_ROLE)
            runs = [own] if isinstance(own, ShownRun) else [run for at, run in _runs_of(item) if not at.isHidden()]
            selected |= {run.path: run for run in runs}
        return list(selected.values())

    def campaign(self) -> Path | None:
        """Return the folder of the current campaign, or of the current run."""
        item = current_item(self.tree)
        if item is None:
            return None
        top = parent_of(item) or item
        return Path(top.toolTip(0))

    def close_down(self) -> None:
        """Finish reading."""
        self._again_soon.stop()
        self.changes.blockSignals(True)
        self._listing.drop()
        self._opening.drop()
        self._marking.finish()

    def _mark(self, *, bad: bool = True) -> None:
        paths, reason = [run.path for run in self.selected()], self.words.text() if bad else None
        self._marking.do_too(lambda: mark(paths, bad=reason, good=reason is None), self._marked)

    def _note(self) -> None:
        paths, text = [run.path for run in self.selected()], self.words.text()
        self._marking.do_too(lambda: mark(paths, note=text), self._marked)

    def _marked(self, paths: Sequence[Path]) -> None:
        self.words.clear()
        for folder in dict.fromkeys(path.parent for path in paths):
            self._read_runs(folder, quiet=True)

    def _recover(self) -> None:
        folders = [Path(item.toolTip(0)) for item in top_items(self.tree) if _has_recordings(item)]

        def recovered(problems: Sequence[str]) -> None:
            for problem in problems:
                self.complained.emit(problem)
            for folder in folders:
                self._read_runs(folder, quiet=True)

        self._marking.do_too(lambda: recover_runs(folders), recovered)

    def _show_what_can_be_done(self, runs: Sequence[ShownRun]) -> None:
        for control in (self.words, self.bad, self.note):
            control.setEnabled(bool(runs))
        self.good.setEnabled(any(run.bad for run in runs))
        self.recover.setEnabled(any(map(_has_recordings, top_items(self.tree))))

    def _folder_edited(self) -> None:
        # Qt emits this whenever the field loses focus; a new list would lose the selection.
        if self.folder.text() != self._listed_folder:
            self.refresh()

    def _show_folders(self, listed: Sequence[ListedCampaign], *, quiet: bool = False) -> None:
        root, folders = Path(self._listed_folder), [campaign.folder for campaign in listed]
        self._found = {campaign.folder: campaign.found for campaign in listed}
        if (words := self.words_to_find.text()) and not listed and not quiet:
            self.complained.emit(f"{words}: no run is of all that; write a kind, specimen, operator, day, bad or good.")
        self._watch(root, folders)
        shown = {item.toolTip(0): item for item in top_items(self.tree)}
        for gone in shown.keys() - set(map(str, folders)):
            self.tree.takeTopLevelItem(self.tree.indexOfTopLevelItem(shown[gone]))
        for at, campaign in enumerate(listed):
            folder = campaign.folder
            if (item := shown.get(str(folder))) is None:
                item = QTreeWidgetItem([folder.name if folder == root else str(folder.relative_to(root)), "", ""])
                item.setToolTip(0, str(folder))
                item.setChildIndicatorPolicy(QTreeWidgetItem.ChildIndicatorPolicy.ShowIndicator)
                self.tree.insertTopLevelItem(at, item)
            elif item.childCount():
                self._read_runs(folder, quiet=quiet)
            item.setText(2, campaign.about)
            item.setToolTip(2, campaign.about)
        to_select, self._campaign_to_select = self._campaign_to_select, None
        for item in top_items(self.tree):
            if item.toolTip(0) == str(to_select) or (len(folders) == 1 and not shown):
                item.setExpanded(True)
                self.tree.setCurrentItem(item)

    def _watch(self, root: Path, folders: Sequence[Path]) -> None:
        # A folder becomes a campaign only with its first run, and the data root only with its first campaign.
        around = {root, *(folder.parent for folder in folders)} if root.is_dir() else {root.parent}
        inside = {folder for parent in around if root.is_dir() for folder in parent.iterdir()}
        wanted = {str(folder) for folder in (*around, *inside, *folders) if folder.is_dir()}
        watched = self.changes.directories()
        if left := list(wanted.difference(watched)):
            self.changes.addPaths(left)
        if left := [folder for folder in watched if folder not in wanted]:
            self.changes.removePaths(left)

    def _load_runs(self, item: QTreeWidgetItem) -> None:
        if item.childCount() == 0:
            self._read_runs(Path(item.toolTip(0)))

    def _read_runs(self, folder: Path, *, quiet: bool = False) -> None:
        self._opening.do_too(lambda: shown_campaign(folder), lambda campaign: self._show_runs(campaign, quiet=quiet))

    def _show_runs(self, campaign: ShownCampaign, *, quiet: bool = False) -> None:
        item = next((item for item in top_items(self.tree) if item.toolTip(0) == str(campaign.folder)), None)
        if item is not None:
            before = self.selected()
            with QSignalBlocker(self.tree):
                _fill_campaign(item, campaign, self._found.get(campaign.folder))
            self.recover.setEnabled(any(map(_has_recordings, top_items(self.tree))))
            # What is selected may be gone, or have been marked; or a selected campaign has more runs.
            if self.selected() != before:
                self._selection_changed()
        for problem in campaign.problems if not quiet else ():
            self.complained.emit(problem)

    def _selection_changed(self) -> None:
        runs = self.selected()
        self._show_what_can_be_done(runs)
        if runs:
            settings = [(key, value) for key, value in runs[-1].settings.items() if value]
            fill_table(self.settings, settings, numbers=False)
        if (folder := self.campaign()) is not None:
            self.campaign_chosen.emit(str(folder))
        self.chosen.emit(runs)

    def _choose_folder(self) -> None:
        choose_path(self, "Folder of campaigns", self.folder.text(), self.open_folder)

    def open_folder(self, path: str) -> None:
        """Show another folder."""
        self.folder.setText(path)
        self.refresh()


def _fill_campaign(item: QTreeWidgetItem, campaign: ShownCampaign, found: frozenset[str] | None) -> None:
    """Show the runs of a campaign, all or those found; the items of those shown before stay."""
    shown = {run.path: child for child, run in _runs_of(item)}
    for other in [item.child(at) for at in range(item.childCount())]:
        if not isinstance(other.data(0, _RUN_ROLE), ShownRun):
            item.removeChild(other)
    for gone in shown.keys() - {run.path for run in campaign.runs}:
        item.removeChild(shown[gone])
    for at, run in enumerate(campaign.runs):
        child = shown.get(run.path)
        if child is None:
            child = QTreeWidgetItem()
            item.insertChild(at, child)
        # The date is in the campaign's name, and in the tooltip.
        started = run.start.split()[-1]
        state = "; ".join(filter(None, (f"BAD: {run.bad}" if run.bad else run.status, run.note)))
        for column_at, text in enumerate((run.label, started, state)):
            child.setText(column_at, text)
        child.setToolTip(2, state)
        child.setToolTip(1, run.start)
        child.setData(0, _RUN_ROLE, run)
        child.setForeground(2, QColor(themed(STOP_COLOUR if run.bad else BLACK)))
        child.setHidden(found is not None and run.path.name not in found)

    no_runs = [(RECORDING, f"{path.name}: being recorded, or left by a crash") for path in campaign.recordings]
    for name, why in (*no_runs, *((UNREADABLE, problem) for problem in campaign.problems)):
        left = QTreeWidgetItem([name, "", why.split(": ", 1)[-1]])
        left.setToolTip(2, why)
        item.addChild(left)


def _has_recordings(item: QTreeWidgetItem) -> bool:
    return any(item.child(at).text(0) == RECORDING for at in range(item.childCount()))


def _runs_of(item: QTreeWidgetItem) -> list[tuple[QTreeWidgetItem, ShownRun]]:
    children = map(item.child, range(item.childCount()))
    return [(child, run) for child in children if isinstance(run := child.data(0, _RUN_ROLE), ShownRun)]


_AXIS_UNITS = {"time": "s", "position": "mm", "speed": "mm/s"}
MAX_OVERLAID = 7
"""Maximum number of runs overlaid, each in its own colour."""

AXES = ("time", "position", "speed")
"""What traces can be drawn against."""
_PAN_SHARE = 0.2
_CURSOR_STEPS, _CURSOR_ROW_PX = 200, 24


@dataclass(frozen=True, slots=True)
class _Line:
    panel: TimePlot
    key: DrawingKey
    colour: str
    width: float


class TraceOverlay(QWidget):
    """Traces of several runs, filtered in front of raw, against time, position or speed."""

    def __init__(self) -> None:
        super().__init__()
        self.traces: list[ShownTrace] = []
        self.channel_plot, self.speed_plot = TimePlot("Force", "mN"), TimePlot("Speed", "mm/s")
        self.channel_plot.hide_times()
        self.channel_plot.follow(self.speed_plot)
        self.channel = QComboBox()
        self.channel.addItems(["force"])
        self.channel.setAccessibleName("Channel")
        self.channel.currentTextChanged.connect(lambda _: self.draw())
        self.axis = named(QComboBox(), "Horizontal axis")
        self.axis.addItems(AXES)
        self.axis.setToolTip("Against the position, drags at several speeds lie over each other along the way")
        self.axis.currentTextChanged.connect(lambda _: self._change_axis())
        self.raw = QCheckBox("Ra&w data")
        self.raw.setChecked(True)
        self.raw.toggled.connect(lambda _: self.draw())
        self.window_ms = NumberField("Filter window length", NumberRange("ms", 1.0, 5000.0), 50.0)
        self.order = NumberField("Filter order", NumberRange("", 0, 8, whole=True), 3)
        self.fit = button("Show a&ll", self.show_all, help_="Show all samples", keys="Ctrl+0")
        self.cursors = QCheckBox("&Cursors")
        self.cursors.toggled.connect(lambda shown: self._show_cursors(shown=shown))
        self.values = named(table(("Run", "At A", "At B", "B − A")), "Values at the cursors")
        self.values.hide()
        self.prepared = PreparedTraces(self)
        self.prepared.ready.connect(self._draw_prepared)
        self._once_drawn: Callable[[], None] | None = None
        self.cursor_lines = tuple(
            self.channel_plot.cursor(name, colour, lambda _: self._show_cursor_values())
            for name, colour in (("A", BLACK), ("B", VERMILLION))
        )
        filter_ = bare_widget(
            row(label("Filter window"), self.window_ms, self.window_ms.unit, label("order"), self.order)
        )
        shown = bare_widget(row(label("Channel"), self.channel, label("against"), self.axis))
        controls = flow(shown, self.raw, self.cursors, filter_, self.fit)
        for panel, height_px in ((self.channel_plot, 150), (self.speed_plot, 100)):
            panel.widget.setMinimumHeight(height_px)
        plots = column(self.channel_plot.widget, self.speed_plot.widget, stretch={0: 6, 1: 4})
        problems = self.window_ms.problem, self.order.problem
        # What the cursors say stays in view: where there is little room, it is the lower plot that is scrolled to.
        self.setLayout(column(controls, *problems, scrolling(plots), self.values, margin=8, stretch={3: 1}))
        self._add_shortcuts()

    def show_traces(self, traces: Sequence[ShownTrace]) -> None:
        """Show runs; the zoom stays if they are the same runs as before."""
        same = [trace.path for trace in traces] == [trace.path for trace in self.traces]
        self.traces = list(traces)
        self.prepared.show(traces)
        chosen = self.channel.currentText()
        names = list(dict.fromkeys(name for trace in traces for name in trace.channels)) or ["force"]
        self.channel.blockSignals(True)
        self.channel.clear()
        self.channel.addItems(names)
        self.channel.setCurrentText(chosen if chosen in names else names[0])
        self.channel.blockSignals(False)
        self.draw()
        if not same:
            self._do_once_drawn(self.show_all)

    def draw(self) -> None:
        """Draw the chosen channel."""
        name = self.channel.currentText()
        for panel in (self.channel_plot, self.speed_plot):
            panel.remove_lines()
        unit = next((trace.units.get(name, "") for trace in self.traces), "")
        self.channel_plot.set_quantity(name.replace("_", " ").capitalize(), unit)
        lines = tuple(self._lines(name))
        drawings = self.prepared.of([*dict.fromkeys(line.key for line in lines), *self._crossings()])
        for line in lines:
            match drawings.get(line.key):
                case TracePyramid() as pyramid:
                    trace = self.traces[line.key.index]
                    line.panel.line("", line.colour, line.width).trace(pyramid, trace.rate_hz, trace.start_s)
                case TracePath() as path:
                    line.panel.line("", line.colour, line.width).path(path)
        self._draw_limits(self.channel_plot, shown=name == "position")
        self._draw_limits(self.speed_plot, shown=self.axis.currentText() == "speed")
        self.channel_plot.title(
            *((self._legend_text(trace), CYCLE[index % MAX_OVERLAID]) for index, trace in enumerate(self.traces))
        )
        for panel in (self.channel_plot, self.speed_plot):
            panel.redraw()
        self._show_cursor_values()

    def _lines(self, name: str) -> Iterator[_Line]:
        """Yield the lines of the chosen channel, those in front last."""
        axis = self.axis.currentText()
        if self.raw.isChecked():
            for index in range(len(self.traces)):
                colour = PALE if len(self.traces) == 1 else tint(CYCLE[index % MAX_OVERLAID], paper=themed(PAPER))
                yield _Line(self.channel_plot, DrawingKey(index, name, "raw", axis), colour, 1.0)
        for index, trace in enumerate(self.traces):
            colour = CYCLE[index % MAX_OVERLAID]
            # A channel without a filtered copy is shown raw.
            kind: Literal["raw", "filtered"] = "filtered" if name in trace.filtered else "raw"
            yield _Line(self.channel_plot, DrawingKey(index, name, kind, axis), colour, 2.0)
            below = DrawingKey(index, *(("position", "raw") if axis == "speed" else ("speed", "filtered")), axis)
            yield _Line(self.speed_plot, below, colour, 2.0)

    def _crossings(self) -> Sequence[DrawingKey]:
        """Return what the cursors look values up in."""
        axis = self.axis.currentText()
        if axis == "time" or not self.cursors.isChecked():
            return ()
        return [DrawingKey(index, "", "crossings", axis) for index in range(len(self.traces))]

    def _do_once_drawn(self, action: Callable[[], None]) -> None:
        """Do something now, and again when all lines are there."""
        self._once_drawn = action if self.prepared.busy else None
        action()

    def _draw_prepared(self) -> None:
        action, self._once_drawn = self._once_drawn, None
        self.draw()
        if action is not None:
            self._do_once_drawn(action)

    def _draw_limits(self, panel: TimePlot, *, shown: bool) -> None:
        """Draw the stage's limits into a plot of positions, where they are in view."""
        panel.remove_levels()
        limits = dict.fromkeys(trace.limits_mm for trace in self.traces if trace.limits_mm is not None)
        for lowest_mm, highest_mm in limits if shown else ():
            panel.stage_limits(lowest_mm, highest_mm, in_view=False)

    def _legend_text(self, trace: ShownTrace) -> str:
        axis = self.axis.currentText()
        return trace.label if axis == "time" or trace.along(axis) is not None else f"{trace.label} (no {axis})"

    def show_all(self) -> None:
        """Show all samples."""
        for panel in (self.speed_plot, self.channel_plot):
            panel.fit()

    def place_cursors(self, first_s: float, second_s: float) -> None:
        """Move both cursors."""
        for cursor, time_s in zip(self.cursor_lines, (first_s, second_s), strict=True):
            cursor.place(time_s, visible=self.cursors.isChecked())

    def _add_shortcuts(self) -> None:
        first, second = self.cursor_lines
        for keys, action in (
            ("Ctrl++", lambda: self.speed_plot.zoom(0.5)),
            ("Ctrl+-", lambda: self.speed_plot.zoom(2.0)),
            ("Ctrl+Left", lambda: self.speed_plot.pan(-_PAN_SHARE)),
            ("Ctrl+Right", lambda: self.speed_plot.pan(_PAN_SHARE)),
            ("Alt+Left", lambda: self._step(first, -1)),
            ("Alt+Right", lambda: self._step(first, 1)),
            ("Alt+Shift+Left", lambda: self._step(second, -1)),
            ("Alt+Shift+Right", lambda: self._step(second, 1)),
        ):
            QShortcut(QKeySequence(keys), self).activated.connect(action)
        self.fit.setToolTip("Show all samples (Ctrl+0). Ctrl with + or − zooms, Ctrl with ← or → pans.")
        self.cursors.setToolTip("Values at two times and their difference. Alt with ← or → moves A, Alt with Shift B.")

    def _step(self, cursor: PlotCursor, direction: int) -> None:
        if self.cursors.isChecked():
            low, high = self.channel_plot.shown()
            cursor.place(cursor.time_s + direction * (high - low) / _CURSOR_STEPS)

    def _change_axis(self) -> None:
        axis = self.axis.currentText()
        self.speed_plot.set_x_quantity(axis.capitalize(), _AXIS_UNITS[axis])
        self.speed_plot.set_quantity(*(("Position", "mm") if axis == "speed" else ("Speed", "mm/s")))
        self.draw()
        self._do_once_drawn(self._fit_cursors)

    def _fit_cursors(self) -> None:
        self.show_all()
        self._show_cursors(shown=self.cursors.isChecked())

    def _show_cursors(self, *, shown: bool) -> None:
        low, high = self.channel_plot.shown()
        self.place_cursors(*(low + share * (high - low) for share in (0.33, 0.67)))
        self.values.setVisible(shown)
        self._show_cursor_values()

    def _show_cursor_values(self) -> None:
        if not self.cursors.isChecked():
            return
        name = self.channel.currentText()
        first, second = (cursor.time_s for cursor in self.cursor_lines)
        axis, crossings = self.axis.currentText(), self.prepared.of(self._crossings())
        rows = [(f"{axis} ({_AXIS_UNITS[axis]})", f"{first:.4f}", f"{second:.4f}", f"{second - first:.4f}")]
        for index, trace in enumerate(self.traces):
            values = trace.filtered.get(name, trace.channels.get(name))
            if values is not None:
                known = crossings.get(DrawingKey(index, "", "crossings", axis))
                # Along another axis nothing can be looked up before its crossings are known.
                places: tuple[int | None, ...] = (None, None)
                if isinstance(known, TraceCrossings):
                    places = known.first(first), known.first(second)
                elif axis == "time":
                    places = tuple(round((at - trace.start_s) * trace.rate_hz) for at in (first, second))
                a, b = (
                    float(values[at]) if at is not None and 0 <= at < len(values) else float("nan") for at in places
                )
                title = f"{trace.label}: {name} ({trace.units.get(name, '')})"
                rows.append((title, _cursor_text(a), _cursor_text(b), _cursor_text(b - a)))
        fill_table(self.values, rows)
        fit_height(self.values, len(rows), _CURSOR_ROW_PX)


def _cursor_text(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else "no sample"


class SteadyView(QWidget):
    """Steady forces of runs: means against speed, drawn with their intervals, and tables of means and runs."""

    def __init__(self) -> None:
        super().__init__()
        self.plot, self.view = TimePlot("Steady − rest", "mN"), DocumentView()
        self.plot.set_x_quantity("Speed", "mm/s")
        self.plot.widget.setMinimumHeight(240)
        self.rows: Sequence[TableRow] = ()
        self.setLayout(column(self.plot.widget, self.view, margin=8, stretch={0: 1, 1: 1}))

    def show_rows(self, rows: Sequence[TableRow]) -> None:
        """Show what was measured of some runs."""
        self.rows = rows
        self.view.show_document(campaign_table_document(rows))
        of_series: dict[str, list[SpeedMean]] = {}
        for mean in mean_per_speed([run for run in rows if run.kind != "return"]):
            way = "" if mean.direction > 0 else " back"
            of_series.setdefault(f"{mean.specimen}, {mean.kind}{way}", []).append(mean)
        self.plot.remove_lines()
        legend = [(name, CYCLE[at % len(CYCLE)]) for at, name in enumerate(of_series)]
        for name, colour in legend:
            x = np.log10([mean.speed_mm_s for mean in of_series[name]])
            y = np.array([abs(mean.steady_above_rest_mN) for mean in of_series[name]])
            half = np.array([mean.half_width_95_mN or 0.0 for mean in of_series[name]])
            self.plot.line("", colour, marked=True).points(x, y)
            bars = np.column_stack((y - half, y + half, np.full(len(y), np.nan)))
            self.plot.line("", colour, 1.0).points(np.repeat(x, 3), bars.ravel())
        speeds = {mean.speed_mm_s for means in of_series.values() for mean in means}
        self.plot.name_places({float(np.log10(speed)): f"{speed:.3g}" for speed in speeds})
        self.plot.title(*legend)
        self.plot.fit()
        self.plot.zoom(1.12)  # room for the numbers of the outermost speeds


class LookPage(QWidget):
    """Browser, traces, steady forces, export."""

    complained = Signal(str)
    begun = Signal()
    """Other runs are read: errors of those before are no longer true."""

    def __init__(self, folder: Path, stored: StoredSettings) -> None:
        super().__init__()
        self.setObjectName("page")
        self._stored = stored
        self.browser, self.overlay = RunBrowser(Path(stored.text("look folder", str(folder)))), TraceOverlay()
        self.overlay.window_ms.put(stored.number("filter window", 50.0))
        self.overlay.order.put(stored.number("filter order", 3))
        self.steady = SteadyView()
        self.state = label("Select runs on the left; several are overlaid.", "faint")
        self.export = QToolButton()
        self.export.setText("E&xport")
        self.export.setToolTip("Export the selected runs to files for other programs")
        self.export.setPopupMode(QToolButton.ToolButtonPopupMode.InstantPopup)
        self.menu = QMenu(self)
        for name in FORMATS:
            self.menu.addAction(f"{name} …", lambda chosen=name: self._choose_export_folder(chosen))
        self.export.setMenu(self.menu)
        self.export.setEnabled(False)
        self.tabs = tabs_of((self.overlay, "&Traces"), (self.steady, "&Steady forces"))
        self._selected: list[ShownRun] = []
        self._traces = FileWorker(self._refused, self)
        self._table = FileWorker(self._refused, self)
        self.exporting = FileWorker(self._refused, self)
        self.export.setMaximumHeight(34)  # of the bar of tabs
        self.tabs.setCornerWidget(bare_widget(row(self.state, self.export)))
        self.setLayout(column(split(card(self.browser), self.tabs, (400, 600), stored, "look"), margin=8))
        self.browser.chosen.connect(self._show_selected)
        self.browser.complained.connect(self.complained.emit)
        self.overlay.prepared.refused.connect(self._refused)
        self.overlay.window_ms.entered.connect(lambda _: self._filter())
        self.overlay.order.entered.connect(lambda _: self._filter())
        self.overlay.channel.currentTextChanged.connect(lambda _: self._filter_other())
        self.browser.refresh()

    def look_at(self, folder: Path) -> None:
        """Show a campaign."""
        self.browser.look_at(folder)

    def keep(self) -> None:
        """Store the settings, and finish reading and writing."""
        self._stored.keep("look folder", self.browser.folder.text())
        self._stored.keep("filter window", self.overlay.window_ms.entered_value)
        self._stored.keep("filter order", self.overlay.order.entered_value)
        self.browser.close_down()
        self.overlay.prepared.drop()
        self._traces.drop()
        self._table.drop()
        self.exporting.finish()

    def export_to(self, folder: Path, name: str) -> None:
        """Write the selected runs to a folder."""
        paths, kind = [run.path for run in self._selected], FORMATS[name]
        self.state.setText("Exporting the selected runs …")
        self.exporting.do_too(
            lambda: [file for path in paths for file in export(path, folder, format=kind)], self._exported
        )

    def _show_selected(self, runs: Sequence[ShownRun]) -> None:
        self._selected = list(runs)
        self.begun.emit()
        self.export.setEnabled(bool(runs))
        self._load()
        paths = [run.path for run in runs]
        self._table.do(lambda: steady_rows(paths), self.steady.show_rows)

    def _filter(self) -> None:
        """Filter in another way what is shown; what is only selected is read first."""
        shown, (window_s, order) = tuple(self.overlay.traces), self._filter_values
        force = self.overlay.channel.currentText()
        if [trace.path for trace in shown] != [run.path for run in self._selected[:MAX_OVERLAID]]:
            self._load()
            return
        anew = partial(filtered_anew, window_s=window_s, order=order, force=force)
        self._traces.do(lambda: tuple(map(anew, shown)), self._show_traces)

    def _filter_other(self) -> None:
        """Filter a force that is only now chosen."""
        chosen = self.overlay.channel.currentText()
        if any(trace.units.get(chosen) == "mN" and chosen not in trace.filtered for trace in self.overlay.traces):
            self._filter()

    @property
    def _filter_values(self) -> tuple[float, int]:
        return 1e-3 * self.overlay.window_ms.entered_value, int(self.overlay.order.entered_value)

    def _load(self) -> None:
        paths, (window_s, order) = [run.path for run in self._selected[:MAX_OVERLAID]], self._filter_values
        self.state.setText("Reading the selected runs …" if paths else "Select runs on the left.")
        self._traces.do(lambda: tuple(shown_trace(path, window_s, order) for path in paths), self._show_traces)

    def _show_traces(self, traces: Sequence[ShownTrace]) -> None:
        self.overlay.show_traces(traces)
        hidden = len(self._selected) > MAX_OVERLAID
        more = f" of {len(self._selected)}; at most {MAX_OVERLAID} are overlaid" if hidden else ""
        self.state.setText(f"{len(traces)} run{'' if len(traces) == 1 else 's'} shown{more}.")

    def _exported(self, paths: Sequence[Path]) -> None:
        folder = paths[0].parent if paths else ""
        self.state.setText(f"{len(paths)} file{'' if len(paths) == 1 else 's'} written to {folder}.")

    def _refused(self, sentence: str) -> None:
        self.state.setText(sentence)
        self.complained.emit(sentence)

    def _choose_export_folder(self, name: str) -> None:
        start = self._stored.text("export folder")
        choose_path(self, f"Folder for {name} files", start, lambda path: self._store_and_export(path, name))

    def _store_and_export(self, path: str, name: str) -> None:
        self._stored.keep("export folder", path)
        self.export_to(Path(path), name)
