"""What a plan will do before anything moves: the motion, the ranges, the time, and what forbids it."""

from PySide6.QtWidgets import QWidget

from dragrig.figures.palette import BLUE, PURPLE
from dragrig.planned import PlannedSession
from dragrig.window.plots.panel import Panel
from dragrig.window.widgets import column, fill, give_role, label, table
from dragrig.wording import duration, size

_HEADER = ("Run", "What", "Capsule", "Lowest (mm)", "Highest (mm)", "Speed (mm/s)", "Rest", "Takes", "Asks before")


class Preview(QWidget):
    """Shows a planned session; the run that is chosen in the list is drawn."""

    def __init__(self) -> None:
        super().__init__()
        self.summary = label("", "title", wrap=True)
        self.findings = label("", wrap=True)
        self.runs = table(_HEADER)
        self.runs.setAccessibleName("Runs of the plan")
        self.runs.currentCellChanged.connect(lambda at, *_: self._draw(at))
        self.position = Panel("Position", "mm")
        self.speed = Panel("Speed", "mm/s")
        self.position.hide_times()
        self.position.follow(self.speed)
        self._way = self.position.line("", BLUE, 2.5)
        self._pace = self.speed.line("", PURPLE, 2.5)
        self._session: PlannedSession | None = None
        layout = column(self.summary, self.findings, self.position.widget, self.speed.widget, self.runs, margin=8)
        for place, share in ((2, 3), (3, 2), (4, 3)):
            layout.setStretch(place, share)
        self.setLayout(layout)

    def show_session(self, session: PlannedSession) -> None:
        """Show what a plan would do."""
        self._session = session
        count = len(session.runs)
        self.summary.setText(
            f"{count} run{'' if count == 1 else 's'}, {duration(session.duration_s)}, {size(session.size_bytes)} of "
            f"{size(session.free_bytes)} free"
        )
        fine = not session.findings
        limits = f"stage limits {session.lowest_mm:g} to {session.highest_mm:g} mm"
        self.findings.setText(
            f"Nothing forbids it; {limits}." if fine else "\n".join(f"NOT ALLOWED: {one}." for one in session.findings)
        )
        give_role(self.findings, "fine" if fine else "wrong")
        fill(
            self.runs,
            [
                (
                    str(one.index),
                    one.summary,
                    one.capsule,
                    f"{one.lowest_mm:g}",
                    f"{one.highest_mm:g}",
                    f"{one.speed_mm_s:g}",
                    duration(one.wait_s) if one.wait_s else "none",
                    duration(one.duration_s),
                    one.prompt,
                )
                for one in session.runs
            ],
        )
        self.position.forget_levels()
        for level, words in ((session.lowest_mm, "lower limit"), (session.highest_mm, "upper limit")):
            self.position.level(level, words)
        if count:
            self.runs.setCurrentCell(0, 0)
            self._draw(0)

    def refuse(self, sentence: str) -> None:
        """Say why there is nothing to show."""
        self.summary.setText("This plan cannot be used yet")
        self.findings.setText(sentence)
        give_role(self.findings, "wrong")

    def _draw(self, at: int) -> None:
        if self._session is None or not 0 <= at < len(self._session.runs):
            return
        time, position, speed = self._session.runs[at].course()
        self._way.points(time, position)
        self._pace.points(time, speed)
        self.position.fit()
        self.speed.fit()
