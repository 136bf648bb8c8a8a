"""The application and its main window: rig banner, pages, stop button, notices."""

import gc
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from PySide6.QtCore import QEvent, QObject, QSize, Qt, QTimer
from PySide6.QtGui import QCloseEvent, QKeyEvent, QKeySequence
from PySide6.QtWidgets import (
    QAbstractSpinBox,
    QApplication,
    QButtonGroup,
    QComboBox,
    QLabel,
    QMainWindow,
    QStackedWidget,
    QVBoxLayout,
    QWidget,
)

from dragrig import engine_host
from dragrig.config import DragrigError
from dragrig.end_signals import rig_open
from dragrig.engine_host import Answer
from dragrig.views import FurtherRuns, PlanForm, describe_rig
from dragrig.window.background import EngineLink
from dragrig.window.diagnose_page import DiagnosePage
from dragrig.window.look_page import LookPage
from dragrig.window.rig_page import RigPage
from dragrig.window.run_page import RunPage
from dragrig.window.widgets import (
    ElidedLabel,
    MessageText,
    StoredSettings,
    Topic,
    apply_style,
    ask_room_for_shown_page,
    bare_widget,
    button,
    card,
    column,
    label,
    row,
    scrolling,
    set_role,
)

COLLECT_INTERVAL_MS = 200
_LEAST_MEANING_PX = 16
"""The banner's title says what matters; the rest of it gives way to the buttons."""
_SHOW, _WHEEL, _POLISH = QEvent.Type.Show, QEvent.Type.Wheel, QEvent.Type.Polish
_FILTERED = frozenset({_SHOW, _WHEEL, _POLISH, QEvent.Type.KeyPress, QEvent.Type.ShortcutOverride})
MIN_WIDTH_PX, MIN_HEIGHT_PX = 940, 500
"""A Full HD screen at twice the size has 960 by 540; nothing that is shown asks for more."""


class GuiThreadCollector(QObject):
    """Collects cyclic garbage on the GUI thread, in place of the interpreter.

    The interpreter collects on whichever thread happens to allocate. On a thread that reads files it would destroy
    plots that the GUI thread is drawing: each then waits for the other's lock for ever, and the window, with its stop
    button, hangs.
    """

    def __init__(self, parent: QObject) -> None:
        super().__init__(parent)
        self._timer = QTimer(self)
        self._timer.setInterval(COLLECT_INTERVAL_MS)
        self._timer.timeout.connect(self._collect)

    def begin(self) -> None:
        """Take collection over from the interpreter."""
        gc.disable()
        self._timer.start()

    def end(self) -> None:
        """Return collection to the interpreter."""
        self._timer.stop()
        gc.enable()

    def _collect(self) -> None:
        gc.disable()  # another window, closed meanwhile, may have returned it
        counts, limits = gc.get_count(), gc.get_threshold()
        for generation in (2, 1, 0):
            if counts[generation] > limits[generation]:
                gc.collect(generation)
                return


_MAX_COMPLAINTS, _PASSING_MS = 4, 30_000
NOT_ARMED = "Nothing can move yet. Check: path clear, hands out, e-stop in reach. Then press Reset the guard."
_NOTICE_PX = 6
"""Around what a notice says: it takes its room from the page."""


class NoticeBar(QWidget):
    """Notices above the page: tripped guard, prompt, lost engine, errors; a long one is scrolled.

    Parameters
    ----------
    answer, restart, go_on
        Called when the operator answers a prompt (with its number), restarts the engine, decides whether a session
        that was cut off is gone on with.
    """

    def __init__(
        self, answer: Callable[[int, Answer], None], restart: Callable[[], None], go_on: Callable[[bool], None]
    ) -> None:
        super().__init__()
        self._answer = answer
        self._prompt: engine_host.PromptShown | None = None
        self._complaints: dict[str, tuple[str, str]] = {}
        self.trip_text = MessageText(most_lines=2)
        self.trip = card(self.trip_text, role="trip", margin=_NOTICE_PX)
        self.prompt_text = MessageText("prompt")
        self.answers = {
            Answer.DONE: button("&Done", lambda: self._reply(Answer.DONE), "main", "Continue the session"),
            Answer.REDO: button("R&edo the last run", lambda: self._reply(Answer.REDO), help_="Its file is marked bad"),
            Answer.SKIP: button("Ski&p", lambda: self._reply(Answer.SKIP), help_="Skip the run being prepared"),
            Answer.MEASURE: button(
                "&Measure it again", lambda: self._reply(Answer.MEASURE), help_="Make the sentinel once more"
            ),
            Answer.ABORT: button("A&bort", lambda: self._reply(Answer.ABORT), help_="End the session"),
        }
        self.hands = ElidedLabel("This must be done by hand at the rig.", "faint")
        self.hands.hide()
        words = column(self.prompt_text, self.hands)
        words.setSpacing(0)
        self.prompt = card(row(words, *self.answers.values(), stretch={0: 1}), role="notice", margin=_NOTICE_PX)
        self.lost_text = MessageText(most_lines=2)
        self.restart = button("Start the en&gine again", restart, "main", "Restart the process that controls the rig")
        self.lost = card(row(self.lost_text, self.restart, stretch={0: 1}), role="trip", margin=_NOTICE_PX)
        self.cut_off_text = MessageText(most_lines=2)
        self.go_on = button("Go on with it", lambda: go_on(True), "main", "Make its missing runs", "Ctrl+Shift+G")
        self.leave = button("Leave it", lambda: go_on(False), help_="It counts as aborted", keys="Ctrl+Shift+L")
        self.cut_off = card(
            row(self.cut_off_text, self.go_on, self.leave, stretch={0: 1}), role="notice", margin=_NOTICE_PX
        )
        self.homing_text = MessageText("prompt")
        self.homing = card(self.homing_text, role="notice", margin=_NOTICE_PX)
        self.passing = QTimer(self, singleShot=True)
        self.passing.timeout.connect(partial(self.settle, Topic.PASSING))
        self.complaint_text = MessageText(most_lines=2)
        self.dismiss = button("D&ismiss", self._dismiss, help_="Hide this message")
        self.complaint = card(row(self.complaint_text, self.dismiss, stretch={0: 1}), role="notice", margin=_NOTICE_PX)
        notices = (self.lost, self.trip, self.prompt, self.homing, self.cut_off, self.complaint)
        below = column(*notices)
        below.setSpacing(4)
        self.setLayout(below)
        for frame in notices:
            frame.hide()

    def show_guard(self, guard: engine_host.GuardState) -> None:
        """Show why nothing may move, as an alarm only where something tripped the guard; hide when it is armed."""
        tripped = f"GUARD TRIPPED: {guard.reason.rstrip('.')}. Nothing moves until the guard is reset."
        self.trip_text.setText(tripped if guard.tripped else NOT_ARMED)
        set_role(self.trip, "trip" if guard.tripped else "calm")
        self.trip.setVisible(bool(guard.reason))

    def ask(self, prompt: engine_host.PromptShown) -> None:
        """Show a prompt."""
        self._prompt = prompt
        self.prompt_text.setText(f"{prompt.text}.")
        self.answers[Answer.DONE].setText("&Done" if prompt.hands else "Continue (&D)")
        self.hands.setVisible(prompt.hands)
        self.answers[Answer.REDO].setVisible(prompt.can_redo)
        self.answers[Answer.SKIP].setVisible(prompt.can_skip)
        self.answers[Answer.MEASURE].setVisible(prompt.can_measure)
        self.prompt.show()

    def show_homing(self, sentence: str) -> None:
        """Show that the stage finds its origin, in the prompt's place; hide for no sentence."""
        self.homing_text.setText(f"{sentence}. STOP (Esc) stops it.")
        self.homing.setVisible(bool(sentence))

    def hide_prompt(self) -> None:
        """Hide the prompt."""
        self._prompt = None
        self.prompt.hide()

    def show_cut_off(self, sentence: str) -> None:
        """Show which session was cut off; hide for none."""
        self.cut_off_text.setText(sentence)
        self.cut_off.setVisible(bool(sentence))

    def complain(self, sentence: str, topic: str = Topic.ANY) -> None:
        """Show an error, with the time, below those already shown, the last four at most."""
        self._complaints.pop(sentence, None)
        self._complaints[sentence] = (time.strftime("%H:%M:%S"), topic)
        if topic == Topic.PASSING:
            self.passing.start(_PASSING_MS)
        for oldest in list(self._complaints)[:-_MAX_COMPLAINTS]:
            del self._complaints[oldest]
        self._show_complaints()

    def settle(self, topic: str) -> None:
        """Hide the errors of a topic: they are no longer true."""
        self._complaints = {sentence: kept for sentence, kept in self._complaints.items() if kept[1] != topic}
        self._show_complaints()

    def engine_lost(self, exit_code: int | None) -> None:
        """Show that the engine is gone."""
        self.hide_prompt()
        self.homing.hide()
        self.trip.hide()
        self.lost_text.setText(
            "ENGINE STOPPED: this window did not respond for too long; the engine stopped the stage, finished the run "
            "and ended."
            if exit_code == 0
            else f"ENGINE LOST: the process that controls the rig ended (exit code {exit_code}). Without a heartbeat "
            "the drive stops by itself. Finish the recording with dragrig recover, or by resuming the campaign."
        )
        self.lost.show()

    def _dismiss(self) -> None:
        self._complaints = {}
        self._show_complaints()

    def _show_complaints(self) -> None:
        lines = (f"{at}  {sentence}" for sentence, (at, _) in self._complaints.items())
        self.complaint_text.setText("\n".join(lines))
        self.complaint.setVisible(bool(self._complaints))

    def _reply(self, answer: Answer) -> None:
        if self._prompt is not None:
            self._answer(self._prompt.question, answer)
            self.hide_prompt()


class _AnyHeight(QVBoxLayout):
    """A layout of what can be lower than it would like to be.

    An area that scrolls would give a page with wrapped text the height that it likes at its width, and not the least.
    """

    def hasHeightForWidth(self) -> bool:
        """Whether the height follows from the width."""
        return False


class MainWindow(QMainWindow):
    """The main window.

    Parameters
    ----------
    rig
        The rig, for as long as the window is open.
    lab
        Lab folder with plans and data.
    silence
        How long the engine goes on without a sign of life from the window.
    """

    def __init__(
        self,
        rig: engine_host.RigSelection,
        lab: Path | None = None,
        stored: StoredSettings | None = None,
        silence: engine_host.SilenceLimits = engine_host.SILENCE_LIMITS,
    ) -> None:
        super().__init__()
        self._collector = GuiThreadCollector(self)
        self._collector.begin()
        self._stored = stored or StoredSettings()
        self.description = describe_rig(rig)
        # What the banner says holds as long as the window is open, whatever the rig file says meanwhile.
        rig = self._rig = replace(rig, backend=self.description.backend)
        self.engine = EngineLink(rig, self, silence)
        self.reset = button(
            "&Reset the guard", self._reset, "main", "Allow motion again once the cause is removed", "Ctrl+R"
        )
        self.reset.setEnabled(False)
        self.run = RunPage(self.engine, rig, self.description, lab, self._stored)
        self.notices = NoticeBar(self._reply, self._restart, self.run.decide_cut_off)
        self.look = LookPage(Path(self.description.data_root), self._stored)
        self.diagnose = DiagnosePage(self._stored, lambda: self.run.new.chosen_mirror)
        cancel = partial(self.run.stop, "cancelled by operator")
        self.rig = RigPage(rig, self._calibrate, cancel, self.run.new.operator.text)
        self.rig.calibrate.set_limits(self.description)
        self.rig_meaning = ElidedLabel("", "faint")
        self.rig_meaning.setMinimumWidth(_LEAST_MEANING_PX)
        self.pages = QStackedWidget()
        stop = partial(self.run.stop, "stopped by operator (stop button)")
        self.stop_button = button("STOP (Esc)", stop, "stop", "Stop the stage at once")
        self.stop_button.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.guard = label("guard: starting", "faint")
        self._page_buttons = QButtonGroup(self)
        self._closing = False
        self._settings_remark = ""
        self._lay_out(
            {
                "Run": (self.run, "Plan and run sessions"),
                "View runs": (self.look, "Recorded runs: traces, steady forces, export"),
                "Diagnose": (self.diagnose, "Where, why and how far runs and model differ"),
                "Rig": (self.rig, "Settings of the rig, calibration of its sensors"),
            }
        )
        self.engine.event_received.connect(self.take)
        self.engine.event_received.connect(self._follow_calibration)
        self.run.complained.connect(self.notices.complain)
        self.run.settled.connect(self.notices.settle)
        self.run.cut_off.connect(self.notices.show_cut_off)
        for page, topic in ((self.look, Topic.LOOK), (self.diagnose, Topic.DIAGNOSIS)):
            page.complained.connect(partial(self.notices.complain, topic=topic))
            page.begun.connect(partial(self.notices.settle, topic))
        self.run.look_at.connect(self._look_at)
        self.run.running_changed.connect(lambda _: self._follow_rig())
        self.rig.settings.saved.connect(self._settings_saved)
        self.rig.calibrate.finished.connect(self.run.write_log)
        for offer in (self.diagnose.offer, self.run.new.destination.offer):
            self.look.browser.campaign_chosen.connect(offer)
        self.diagnose.next_experiment.connect(self._offer_next)
        self.diagnose.further_runs.connect(self._add_to_campaign)
        self.run.session_over.connect(self.diagnose.session_over)
        application = QApplication.instance()
        if application is not None:
            application.installEventFilter(self)
        self._show_description()
        self._follow_rig()
        self._restore()
        self.run.show_cut_off()

    def go_to(self, page: QWidget) -> None:
        """Show a page."""
        self.pages.setCurrentWidget(page)
        ask_room_for_shown_page(self.pages)
        chosen = self._page_buttons.button(self.pages.indexOf(page))
        chosen.setChecked(True)
        chosen.setFocus()

    def take(self, event: engine_host.Event) -> None:
        """Handle an event of the engine."""
        match event:
            case engine_host.HostReady():
                self.notices.lost.hide()
                self.run.devices.check()
            case engine_host.GuardState(reason, tripped):
                self.notices.hide_prompt()
                self.notices.show_guard(event)
                self.reset.setEnabled(bool(reason))
                state, role = ("TRIPPED", "wrong") if tripped else ("NOT ARMED", "changed")
                self.guard.setText(f"guard: {state if reason else 'armed'}")
                set_role(self.guard, role if reason else "fine")
                if not reason:
                    self.notices.settle(Topic.GUARD)
            case engine_host.StageHomes(sentence):
                self.notices.show_homing(sentence)
            case engine_host.PromptShown():
                self.notices.ask(event)
                QApplication.alert(self)
            case engine_host.SessionFinished() | engine_host.StageMoved() | engine_host.CalibrationMeasured():
                self.notices.hide_prompt()
                self.notices.show_homing("")
                self.notices.settle(Topic.CLOSING)
            case engine_host.RequestRefused(sentence):
                self.notices.hide_prompt()
                self.notices.complain(sentence, Topic.GUARD)
                self.reset.setEnabled(True)
            case engine_host.HostLost(exit_code):
                self.reset.setEnabled(False)
                self.guard.setText("guard: no engine")
                set_role(self.guard, "wrong")
                self.notices.engine_lost(exit_code)
            case _:
                pass

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Stop the stage on Escape wherever the focus is, also in a dialog; keep the wheel off fields in passing.

        Tooltips are shown as text: Qt takes a note of somebody else's that looks like HTML for it.
        """
        if event.type() not in _FILTERED:  # nearly all, and all come here
            return False
        if event.type() is _POLISH and isinstance(watched, QLabel) and watched.inherits("QTipLabel"):
            watched.setTextFormat(Qt.TextFormat.PlainText)
        if isinstance(watched, QComboBox | QAbstractSpinBox) and event.type() in {_SHOW, _WHEEL}:
            # A wheel would give it the focus first.
            watched.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
            if event.type() is _WHEEL and not watched.hasFocus():
                # What is around it scrolls instead.
                event.ignore()
                return True
        if event.type() is QEvent.Type.ShortcutOverride and self._undoes_form(watched, event):
            event.ignore()
            return True
        if isinstance(event, QKeyEvent) and event.key() == Qt.Key.Key_Escape and self.run.rig_busy:
            if event.type() is QEvent.Type.KeyPress:
                self.run.stop("stopped by operator (Esc)")
            event.accept()
            return True
        return False

    def _undoes_form(self, watched: QObject, event: QEvent) -> bool:
        """Whether a key is the form's own undo, which takes back changes of lists and switches too."""
        inside = isinstance(watched, QWidget) and self.run.new.editor.isAncestorOf(watched)
        return inside and isinstance(event, QKeyEvent) and event.matches(QKeySequence.StandardKey.Undo)

    def close_in_order(self, reason: str) -> None:
        """Close the window whatever is running: the stage is stopped first, and the run finished."""
        self._closing = True
        if self.run.rig_busy:
            self.run.stop(reason)
        self.close()

    def closeEvent(self, event: QCloseEvent) -> None:
        """End the engine in good order; a running session must be stopped first."""
        if self.run.rig_busy and not self._closing:
            what = (
                "A session is running"
                if self.run.session_running
                else "A calibration is under way"
                if self.run.calibrating
                else "The stage is being moved by hand"
            )
            self.notices.complain(f"{what}: stop it (Esc), then close the window.", Topic.CLOSING)
            event.ignore()
            return
        self._stored.keep("geometry", self.saveGeometry())
        self._stored.keep("page", str(self.pages.currentIndex()))
        self.run.keep()
        self.look.keep()
        self.diagnose.keep()
        self.setEnabled(False)
        self.engine.close()
        application = QApplication.instance()
        if application is not None:
            application.removeEventFilter(self)
        self._collector.end()
        super().closeEvent(event)

    def _look_at(self, folder: str) -> None:
        self.go_to(self.look)
        self.look.look_at(Path(folder))

    def _offer_next(self, name: str, plan: PlanForm) -> None:
        self.run.offer_and_queue(name, plan)
        self.go_to(self.run)

    def _add_to_campaign(self, runs: FurtherRuns) -> None:
        self.go_to(self.run)
        self.run.add_to_campaign(runs)

    def _reset(self) -> None:
        self.reset.setEnabled(False)
        self.engine.ask(engine_host.ResetGuard())

    def _reply(self, question: int, answer: Answer) -> None:
        self.run.answered = question
        self.run.live.readings.end_motion("preparing")
        self.engine.ask(engine_host.PromptReply(question, answer))

    def _restart(self) -> None:
        self.notices.lost.hide()
        self.engine.restart()
        # Until the new engine says so itself.
        starting = engine_host.GuardState("the engine is starting", tripped=False)
        self.take(starting)
        self.run.await_engine(starting.reason)

    def _calibrate(self, request: engine_host.Request) -> None:
        self.notices.settle(Topic.HAND)
        self.run.set_calibrating(calibrating=self.rig.calibrate.busy)
        self.engine.ask(request)

    def _follow_calibration(self, event: engine_host.Event) -> None:
        calibrate = self.rig.calibrate
        match event:
            case engine_host.CalibrationMeasured(_, _, problem):
                calibrate.show_result(event)
                if problem:
                    self.notices.complain(problem, Topic.HAND)
            case engine_host.CalibrationStored():
                calibrate.show_stored(event)
            case engine_host.HostLost():
                calibrate.end("The engine has ended; nothing is stored.")
            case _:
                return
        self.run.set_calibrating(calibrating=calibrate.busy)

    def _settings_saved(self, remark: str) -> None:
        """Start the engine again with the settings that were saved, now or once nothing runs."""
        self.run.restart_due, self._settings_remark = True, remark
        self.rig.settings.state.setText("Saved. The engine starts again with these settings as soon as nothing runs.")
        self._follow_rig()

    def _follow_rig(self) -> None:
        """Allow calibrations while nothing else is done, and start the engine again if that is due."""
        run = self.run
        if run.restart_due and not run.rig_busy and not self._closing:
            run.restart_due = False
            self._use_saved_settings()
        idle = not (run.session_running or run.hand.busy or self.engine.lost)
        self.rig.calibrate.allow(idle=idle, armed=run.armed, in_lab=self.rig.settings.in_lab)

    def _use_saved_settings(self) -> None:
        try:
            self.description = describe_rig(self._rig)
        except DragrigError as error:
            self.notices.complain(str(error))
            return
        self._show_description()
        self.run.describe(self.description)
        self.rig.calibrate.set_limits(self.description)
        self._restart()
        sentence = "Saved, and the engine started again: reset the guard before anything moves."
        self.rig.settings.state.setText(f"{sentence} {self._settings_remark}".strip())

    def _show_description(self) -> None:
        rig = self.description
        self.setWindowTitle(f"dragrig: {rig.name}, {rig.title}")
        self.rig_meaning.setText(f"{rig.name}: {rig.meaning}")

    def _lay_out(self, pages: dict[str, tuple[QWidget, str]]) -> None:
        top = row(margin=6)
        for index, (name, (page, content)) in enumerate(pages.items()):
            self.pages.addWidget(page)
            number, show = index + 1, partial(self.go_to, page)
            opener = button(f"&{number}  {name}", show, "page", content, f"Ctrl+{number}")
            opener.setCheckable(True)
            self._page_buttons.addButton(opener, index)
            top.addWidget(opener)
        rig = self.description
        banner = card(
            row(label(rig.title, "title"), self.rig_meaning, stretch={1: 1}),
            role="hardware" if rig.real else "simulated",
        )
        banner.setContentsMargins(0, -4, 0, -4)
        banner.setAccessibleName(f"{rig.title}: {rig.meaning}")
        top.addWidget(banner, 1)
        top.addWidget(self.reset)
        top.addWidget(self.stop_button)
        state = row(self.guard, self.run.live.readings, stretch={1: 1})
        state.setContentsMargins(10, 0, 10, 4)
        shown = _AnyHeight()
        shown.setContentsMargins(0, 0, 0, 0)
        shown.addWidget(self.pages)
        # A page that needs more room than there is scrolls; what is above it stays.
        self.room = scrolling(shown)
        body = column(top, state, self.notices, self.room, stretch={3: 1})
        body.setSpacing(0)
        self.setCentralWidget(bare_widget(body))
        self.setMinimumSize(MIN_WIDTH_PX, MIN_HEIGHT_PX)

    def _restore(self) -> None:
        shape = self._stored.shape("geometry")
        if shape is None or not self.restoreGeometry(shape):
            room = self.screen().availableGeometry().size()
            usual = QSize(1440, 960)
            self.resize(usual.boundedTo(room))
            if usual.boundedTo(room) != usual:
                # Only the desktop knows how high its title bar is.
                self.setWindowState(Qt.WindowState.WindowMaximized)
        index = round(self._stored.number("page", 0))
        self.go_to(self.pages.widget(index) if 0 <= index < self.pages.count() else self.run)


def qt_application() -> QApplication:
    """Return the application of this process, with the window's style."""
    running = QApplication.instance()
    application = running if isinstance(running, QApplication) else QApplication(sys.argv[:1])
    application.setApplicationName("dragrig")
    apply_style(application)
    return application


def show_window(rig: engine_host.RigSelection, lab: Path | None) -> int:
    """Show the window until it is closed; return the exit code.

    Raises `SettingsError` when the rig's settings cannot be used.
    """
    application = qt_application()
    window = MainWindow(rig, lab)
    window.show()
    # Python handles a signal when the engine's timer next runs Python code.
    with rig_open() as signals, signals.aborting(window.close_in_order):
        return int(application.exec())
