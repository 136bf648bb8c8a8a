"""The window: banner of the rig, pages, stop button, notices."""

from collections.abc import Callable
from pathlib import Path

from PySide6.QtCore import QEvent, QObject, Qt
from PySide6.QtGui import QCloseEvent, QKeyEvent
from PySide6.QtWidgets import QApplication, QButtonGroup, QMainWindow, QStackedWidget, QWidget

from dragrig.engine_host.messages import (
    SILENCE_S,
    Answer,
    Asked,
    Ended,
    Event,
    Latched,
    Lost,
    Ready,
    Refused,
    Reply,
    Reset,
    RigTerms,
    Warned,
)
from dragrig.plan_forms import PlanForm
from dragrig.planned import rig_in_words
from dragrig.window.diagnose.page import DiagnosePage
from dragrig.window.engine_link import EngineLink
from dragrig.window.look.page import LookPage
from dragrig.window.notices import Notices
from dragrig.window.remembered import Remembered
from dragrig.window.run.page import RunPage
from dragrig.window.tidying import Tidying
from dragrig.window.widgets import button, card, column, holder, label, row


class MainWindow(QMainWindow):
    """What an experimenter keeps open all day.

    Parameters
    ----------
    rig
        Which rig it is for, for as long as it is open.
    lab
        Lab folder whose plans and data are offered.
    silence_s
        How long the engine bears a window that is held up before it stops the stage.
    """

    def __init__(
        self,
        rig: RigTerms,
        lab: Path | None = None,
        remembered: Remembered | None = None,
        silence_s: float = SILENCE_S,
    ) -> None:
        super().__init__()
        self._tidying = Tidying(self)
        self._tidying.begin()
        self._remembered = remembered or Remembered()
        self.words = rig_in_words(rig)
        self.setWindowTitle(f"dragrig: {self.words.name}, {self.words.title}")
        self.engine = EngineLink(rig, self, silence_s)
        self.notices = Notices(self._reset, self._reply, self._restart)
        self.run = RunPage(self.engine, rig, self.words, lab, self._remembered)
        self.look = LookPage(Path(self.words.data_root), self._remembered)
        self.diagnose = DiagnosePage(self._remembered)
        self.pages = QStackedWidget()
        self.stop_button = button("STOP  (Esc)", self._stop_pressed, "stop", "Stop the stage at once")
        self.stop_button.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.guard = label("guard: starting", "faint")
        self._page_buttons = QButtonGroup(self)
        self._closes = False
        self._lay_out({"Run": self.run, "Look": self.look, "Diagnose": self.diagnose})
        self.engine.said.connect(self.take)
        for page in (self.run, self.look, self.diagnose):
            page.complained.connect(self.notices.complain)
        self.run.look_at.connect(self._look_at)
        self.look.browser.campaign_chosen.connect(self.diagnose.offer)
        self.diagnose.next_experiment.connect(self._offer_next)
        application = QApplication.instance()
        if application is not None:
            application.installEventFilter(self)
        self._recall()

    def go_to(self, page: QWidget) -> None:
        """Show a page."""
        self.pages.setCurrentWidget(page)
        chosen = self._page_buttons.button(self.pages.indexOf(page))
        chosen.setChecked(True)
        chosen.setFocus()

    def take(self, event: Event) -> None:
        """Hear what the engine says."""
        match event:
            case Ready():
                self.notices.lost.hide()
                self.run.devices.look()
            case Latched(reason):
                self.notices.nothing_asked()
                self.notices.latched(reason)
                self.guard.setText("guard: TRIPPED" if reason else "guard: armed")
            case Asked():
                self.notices.ask(event)
                QApplication.alert(self)
            case Ended():
                self.notices.nothing_asked()
            case Warned(sentence):
                self.notices.complain(sentence)
            case Refused(sentence):
                self.notices.nothing_asked()
                self.notices.complain(sentence)
                self.notices.reset.setEnabled(True)
            case Lost(exit_code):
                self.guard.setText("guard: no engine")
                self.notices.engine_lost(exit_code)
            case _:
                pass

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Let Escape stop the stage wherever the focus is, also in a dialog."""
        pressed = event.type() in {QEvent.Type.KeyPress, QEvent.Type.ShortcutOverride}
        if pressed and isinstance(event, QKeyEvent) and event.key() == Qt.Key.Key_Escape and self.run.under_way:
            if event.type() is QEvent.Type.KeyPress:
                self.run.stop("Escape at the window")
            event.accept()
            return True
        return super().eventFilter(watched, event)

    def close_in_order(self, reason: str) -> None:
        """Close the window whatever is under way: the stage is stopped first, and the run finished."""
        self._closes = True
        if self.run.under_way:
            self.run.stop(reason)
        self.close()

    def closeEvent(self, event: QCloseEvent) -> None:
        """End the engine in good order; while a session is under way, only a stop comes before."""
        if self.run.under_way and not self._closes:
            self.notices.complain("A session is under way: stop it (Esc), then close the window.")
            event.ignore()
            return
        self._remembered.keep("geometry", self.saveGeometry())
        self._remembered.keep("page", str(self.pages.currentIndex()))
        self.run.new.keep()
        self.look.keep()
        self.diagnose.keep()
        self.setEnabled(False)
        self.engine.close()
        application = QApplication.instance()
        if application is not None:
            application.removeEventFilter(self)
        self._tidying.end()
        super().closeEvent(event)

    def _look_at(self, folder: str) -> None:
        self.go_to(self.look)
        self.look.look_at(Path(folder))

    def _offer_next(self, name: str, plan: PlanForm) -> None:
        self.run.offer_and_queue(name, plan)
        self.go_to(self.run)

    def _stop_pressed(self) -> None:
        self.run.stop("the stop button at the window")

    def _reset(self) -> None:
        self.notices.reset.setEnabled(False)
        self.engine.ask(Reset())

    def _reply(self, question: int, answer: Answer) -> None:
        self.engine.ask(Reply(question, answer))

    def _restart(self) -> None:
        self.notices.lost.hide()
        self.engine.restart()

    def _lay_out(self, pages: dict[str, QWidget]) -> None:
        top = row(margin=8)
        for at, (name, page) in enumerate(pages.items()):
            self.pages.addWidget(page)
            made = button(f"&{at + 1}  {name}", _show(self, page), "page", f"The page {name}", f"Ctrl+{at + 1}")
            made.setCheckable(True)
            self._page_buttons.addButton(made, at)
            top.addWidget(made)
        banner = card(
            label(f"{self.words.title}", "title"), label(f"{self.words.name}: {self.words.meaning}", "faint"),
            role="hardware" if self.words.real else "simulated", across=True,
        )  # fmt: skip
        banner.setAccessibleName(f"{self.words.title}: {self.words.meaning}")
        top.addStretch(1)
        top.addWidget(banner)
        top.addWidget(self.guard)
        top.addStretch(1)
        top.addWidget(self.stop_button)
        body = column(top, self.notices, self.pages)
        body.setStretch(2, 1)
        body.setSpacing(0)
        self.setCentralWidget(holder(body))

    def _recall(self) -> None:
        shape = self._remembered.shape("geometry")
        if shape is None or not self.restoreGeometry(shape):
            self.resize(1440, 960)
        place = round(self._remembered.number("page", 0))
        self.go_to(self.pages.widget(place) if 0 <= place < self.pages.count() else self.run)


def _show(window: MainWindow, page: QWidget) -> Callable[[], None]:
    return lambda: window.go_to(page)
