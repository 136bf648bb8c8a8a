"""What a person must see on every page: a tripped guard, a question, a lost engine, what went wrong."""

from collections.abc import Callable

from PySide6.QtWidgets import QFrame, QLayout, QWidget

from dragrig.engine_host.messages import Answer, Asked
from dragrig.window.widgets import button, card, column, label, row


class Notices(QWidget):
    """Frames above the page that come and go.

    Parameters
    ----------
    reset, answer, restart
        Called when a person resets the guard, answers a question (with its number), starts the engine again.
    """

    def __init__(
        self, reset: Callable[[], None], answer: Callable[[int, Answer], None], restart: Callable[[], None]
    ) -> None:
        super().__init__()
        self._answer = answer
        self._question: Asked | None = None
        self.trip_text = label("", wrap=True)
        self.reset = button("&Reset the guard", reset, "main", "Once its cause is seen to", "Ctrl+R")
        self.trip = _frame("trip", _wide(self.trip_text, self.reset))
        self.question_text = label("", "title", wrap=True)
        self.answers = {
            Answer.DONE: button("&Done", lambda: self._say(Answer.DONE), "main", "It is done: go on"),
            Answer.REDO: button("R&edo the last run", lambda: self._say(Answer.REDO), help_="Its file is marked bad"),
            Answer.SKIP: button("Ski&p", lambda: self._say(Answer.SKIP), help_="Leave out what this prepares"),
            Answer.ABORT: button("A&bort", lambda: self._say(Answer.ABORT), help_="End the session here"),
        }
        self.hands = label("", "faint")
        self.question = _frame("notice", column(self.question_text, row(self.hands, 1, *self.answers.values())))
        self.lost_text = label("", wrap=True)
        self.restart = button("Start the en&gine again", restart, "main")
        self.lost = _frame("trip", _wide(self.lost_text, self.restart))
        self.complaint_text = label("", wrap=True)
        self.dismiss = button("D&ismiss", self._dismiss, help_="Take this away")
        self.complaint = _frame("notice", _wide(self.complaint_text, self.dismiss))
        self.setLayout(column(self.lost, self.trip, self.question, self.complaint))
        for frame in (self.lost, self.trip, self.question, self.complaint):
            frame.hide()

    def latched(self, reason: str) -> None:
        """Tell what the guard is tripped on; nothing when it is armed."""
        self.trip_text.setText(f"THE GUARD IS TRIPPED: {reason.rstrip('.')}. Nothing moves until it is reset.")
        self.reset.setEnabled(True)
        self.trip.setVisible(bool(reason))

    def ask(self, asked: Asked) -> None:
        """Put a question."""
        self._question = asked
        self.question_text.setText(f"{asked.text}.")
        self.hands.setText("This needs somebody at the rig." if asked.hands else "")
        self.answers[Answer.REDO].setVisible(asked.can_redo)
        self.answers[Answer.SKIP].setVisible(asked.can_skip)
        self.question.show()

    def nothing_asked(self) -> None:
        """Take the question away."""
        self._question = None
        self.question.hide()

    def complain(self, sentence: str) -> None:
        """Say what went wrong; a second one comes below the first."""
        before = self.complaint_text.text() if self.complaint.isVisible() else ""
        lines = [*before.splitlines(), sentence][-4:]
        self.complaint_text.setText("\n".join(dict.fromkeys(lines)))
        self.complaint.show()

    def engine_lost(self, exit_code: int | None) -> None:
        """Say that the engine is gone."""
        self.nothing_asked()
        self.trip.hide()
        self.lost_text.setText(
            "THE ENGINE HAS ENDED, because it heard nothing from this window for too long: the stage was stopped, and "
            "the run under way finished."
            if exit_code == 0
            else f"THE ENGINE HAS ENDED (exit code {exit_code}). A drive that no longer hears it stops by itself; what "
            "was recorded is finished with dragrig recover, or when its campaign goes on."
        )
        self.lost.show()

    def _dismiss(self) -> None:
        self.complaint.hide()

    def _say(self, answer: Answer) -> None:
        if self._question is not None:
            self._answer(self._question.question, answer)
            self.nothing_asked()


def _frame(role: str, layout: QLayout) -> QFrame:
    return card(layout, role=role)


def _wide(text: QWidget, pressed: QWidget) -> QLayout:
    layout = row(text, pressed)
    layout.setStretch(0, 1)
    return layout
