"""Campaigns and their runs in a tree, with what a run says of itself."""

from pathlib import Path

from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import (
    QAbstractItemView,
    QFileDialog,
    QHeaderView,
    QLineEdit,
    QTreeWidget,
    QTreeWidgetItem,
    QWidget,
)

from dragrig.looking import ShownCampaign, ShownRun, campaigns_below, shown_campaign
from dragrig.window.background import Background
from dragrig.window.widgets import button, column, current_item, fill, label, parent_of, row, table, top_items

_RUN = int(Qt.ItemDataRole.UserRole)


class Browser(QWidget):
    """Shows what lies below a folder; `chosen` tells the run files that are selected."""

    chosen = Signal(list)
    complained = Signal(str)
    campaign_chosen = Signal(str)

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = QLineEdit(str(folder))
        self.folder.setAccessibleName("Folder of campaigns")
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
        self.settings = table(("Setting", "Value"))
        self.settings.setAccessibleName("Settings of the chosen run")
        self._listing = Background(self.complained.emit, self)
        self._opening = Background(self.complained.emit, self)
        self._wanted: Path | None = None
        self._listed = ""
        layout = column(
            label("Runs", "title"), self.folder, row(self.choose, self.again, 1), self.tree,
            label("What the chosen run says of itself", "faint"), self.settings,
        )  # fmt: skip
        layout.setStretch(3, 3)
        layout.setStretch(5, 2)
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
            items = [item] if item.data(0, _RUN) is not None else [item.child(at) for at in range(item.childCount())]
            runs = [one.data(0, _RUN) for one in items]
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
                    child.setData(0, _RUN, run)
                    item.addChild(child)
                if item.isSelected():
                    self._select()
        for problem in found.problems:
            self.complained.emit(problem)

    def _select(self) -> None:
        runs = self.selected()
        if runs:
            said = [(key.replace("_", " "), value) for key, value in runs[-1].settings.items() if value]
            fill(self.settings, said, numbers=False)
        if (folder := self.campaign()) is not None:
            self.campaign_chosen.emit(str(folder))
        self.chosen.emit(runs)

    def _choose(self) -> None:
        dialog = QFileDialog(self, "Folder of campaigns", self.folder.text())
        dialog.setOption(QFileDialog.Option.DontUseNativeDialog)
        dialog.setFileMode(QFileDialog.FileMode.Directory)
        dialog.fileSelected.connect(self.open_folder)
        dialog.open()

    def open_folder(self, path: str) -> None:
        """Look at another folder."""
        self.folder.setText(path)
        self.refresh()
