"""The queue on the screen: sessions with their runs below them, progress, time left."""

from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import QHeaderView, QProgressBar, QTreeWidget, QTreeWidgetItem, QWidget

from dragrig.engine_host.messages import RunLine, Status
from dragrig.window.run.queue_model import Entry, Queue, Stage
from dragrig.window.widgets import button, column, current_item, label, parent_of, row
from dragrig.wording import duration

_HEADER = ("Session", "Runs", "Takes", "State")
_NUMBER = int(Qt.ItemDataRole.UserRole)


class QueueView(QWidget):
    """Shows a queue and lets its waiting sessions be moved and taken out."""

    chosen_folder = Signal(str)
    """The folder of a finished session that a person wants to look at."""

    def __init__(self, queue: Queue) -> None:
        super().__init__()
        self._queue = queue
        self._shown: list[tuple[object, ...]] = []
        self.tree = QTreeWidget()
        self.tree.setHeaderLabels(list(_HEADER))
        self.tree.setAccessibleName("Queue of sessions")
        self.tree.setAlternatingRowColors(True)
        self.tree.header().setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        self.tree.itemDoubleClicked.connect(lambda item, _: self._look(item))
        self.progress = QProgressBar()
        self.progress.setRange(0, 1000)
        self.progress.setAccessibleName("Progress of the session under way")
        self.up = button("&Up", lambda: self._move(-1), help_="Make the chosen session earlier")
        self.down = button("Do&wn", lambda: self._move(1), help_="Make the chosen session later")
        self.out = button("Re&move", self._remove, help_="Take the chosen session out of the queue")
        self.clear = button("C&lear finished", self._clear, help_="Forget sessions that are over; their files stay")
        self.look = button("Loo&k at it", self._look_at_chosen, help_="Show the chosen session's runs")
        buttons = row(self.up, self.down, self.out, self.clear, 1, self.look)
        self.setLayout(column(label("Queue", "title"), self.progress, self.tree, buttons))
        self.show_queue()

    def show_queue(self) -> None:
        """Bring the screen to what the queue is now."""
        state = [self._state(one) for one in self._queue.entries]
        if state != self._shown:
            self._shown = state
            self._rebuild()
        self._tell_progress()

    def _state(self, entry: Entry) -> tuple[object, ...]:
        moving = entry.under_way.index if entry.under_way is not None else -1
        return entry.job.number, entry.stage, len(entry.runs), tuple(entry.ended), moving, entry.reason

    def _tell_progress(self) -> None:
        entry = self._queue.current
        waiting = sum(one.stage is Stage.WAITING for one in self._queue.entries)
        if entry is None:
            self.progress.setValue(0)
            told = f"{waiting} waiting, {duration(self._queue.left_s)}" if waiting else "nothing waits"
            self.progress.setFormat(f"not running; {told}")
            return
        self.progress.setValue(round(1000 * entry.share))
        more = f"; {waiting} more waiting, {duration(self._queue.left_s)} in all" if waiting else ""
        # A dry run's rests take no time, and nobody knows how fast it is.
        left = f", {duration(entry.left_s)} left" if entry.real_time else ""
        self.progress.setFormat(f"{entry.title}: run {entry.place} of {entry.count}{left}{more}")

    def _rebuild(self) -> None:
        chosen = self._chosen()
        self.tree.clear()
        for entry in self._queue.entries:
            told = f"{entry.stage.value}{f': {entry.reason}' if entry.reason else ''}{_mirror_state(entry)}"
            item = QTreeWidgetItem([entry.title, str(entry.count), duration(entry.seconds), told])
            item.setData(0, _NUMBER, entry.job.number)
            item.setToolTip(3, told)
            self.tree.addTopLevelItem(item)
            for run in entry.runs:
                item.addChild(QTreeWidgetItem([f"{run.index}  {run.summary}", "", duration(run.duration_s),
                                               _run_state(entry, run)]))  # fmt: skip
            missing = entry.mirror.missing if entry.mirror is not None else ()
            for name, why in missing:
                item.addChild(QTreeWidgetItem([name, "", "", f"NOT IN THE MIRROR: {why}"]))
            item.setExpanded(entry.stage is Stage.RUNNING or bool(missing))
            if entry is chosen:
                self.tree.setCurrentItem(item)

    def _chosen(self) -> Entry | None:
        item = current_item(self.tree)
        while item is not None and (above := parent_of(item)) is not None:
            item = above
        number = item.data(0, _NUMBER) if item is not None else None
        return next((one for one in self._queue.entries if one.job.number == number), None)

    def _move(self, by: int) -> None:
        if (entry := self._chosen()) is not None:
            self._queue.move(entry, by)
            self.show_queue()

    def _remove(self) -> None:
        if (entry := self._chosen()) is not None:
            self._queue.remove(entry)
            self.show_queue()

    def _clear(self) -> None:
        self._queue.clear_finished()
        self.show_queue()

    def _look(self, item: QTreeWidgetItem) -> None:
        self.tree.setCurrentItem(item)
        self._look_at_chosen()

    def _look_at_chosen(self) -> None:
        entry = self._chosen() or next((one for one in reversed(self._queue.entries) if one.folder), None)
        if entry is not None and entry.folder:
            self.chosen_folder.emit(entry.folder)


def _run_state(entry: Entry, run: RunLine) -> str:
    ended = entry.ended.get(run.index)
    if ended is None:
        return "moving" if entry.under_way is not None and entry.under_way.index == run.index else ""
    told = [ended.status.value, *([ended.reason] if ended.status is not Status.COMPLETE else [])]
    return "; ".join((*told, *(f"NOTE {one}" for one in ended.warnings)))


def _mirror_state(entry: Entry) -> str:
    found = entry.mirror
    if found is None:
        return ""
    if found.missing:
        return f"; {len(found.missing)} of {found.copied + len(found.missing)} files NOT IN THE MIRROR {found.folder}"
    return f"; all {found.copied} files in the mirror {found.folder}"
