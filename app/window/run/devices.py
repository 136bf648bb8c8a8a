"""The state of every device, as a look at the rig finds it."""

from collections.abc import Callable

from PySide6.QtWidgets import QWidget

from dragrig.engine_host.messages import Examined
from dragrig.window.widgets import button, column, fill, label, row, table


class DevicesView(QWidget):
    """Shows what the last look at the rig found; nothing moves for a look."""

    def __init__(self, look: Callable[[], None]) -> None:
        super().__init__()
        self._ask = look
        self._words = "Not looked at yet."
        self._looks = self._busy = False
        self.verdict = ""
        self.told = label(self._words, "faint", wrap=True)
        self.devices = table(("", "Device", "What was found"))
        self.devices.setAccessibleName("State of every device")
        self.again = button("Look agai&n", self.look, help_="Look at every device; nothing moves")
        self.setLayout(column(row(self.told, 1, self.again), self.devices, margin=8))

    def look(self) -> None:
        """Have the rig looked at."""
        self._looks = True
        self._ask()
        self._show_state()

    def show_found(self, found: Examined) -> None:
        """Show what was found."""
        self._looks = False
        fill(self.devices, [("ok" if one.fine else "NOT", one.what, one.detail) for one in found.devices])
        wrong = sum(not one.fine for one in found.devices)
        self.verdict = "NOT FOUND" if found.error else f"{wrong} NOT FINE" if wrong else "all fine"
        self._words = found.error or f"{len(found.devices)} things looked at, {self.verdict}."
        self._show_state()

    def give_up(self) -> None:
        """Nobody is there who could look."""
        self._looks = False
        self._show_state()

    def busy(self, *, busy: bool) -> None:
        """While a session is under way its devices are not looked at."""
        self._busy = busy
        self._show_state()

    def _show_state(self) -> None:
        self.again.setEnabled(not (self._busy or self._looks))
        if self._busy:
            self.told.setText("A session is under way: the guard looks at every block. This was found before.")
        else:
            self.told.setText("Looking at every device …" if self._looks else self._words)
