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
        self.verdict = ""
        self.told = label("Not looked at yet.", "faint", wrap=True)
        self.devices = table(("", "Device", "What was found"))
        self.devices.setAccessibleName("State of every device")
        self.again = button("Look agai&n", self.look, help_="Look at every device; nothing moves")
        self.setLayout(column(row(self.told, 1, self.again), self.devices, margin=8))

    def look(self) -> None:
        """Have the rig looked at."""
        self.again.setEnabled(False)
        self.told.setText("Looking at every device …")
        self._ask()

    def show_found(self, found: Examined) -> None:
        """Show what was found."""
        self.again.setEnabled(True)
        fill(self.devices, [("ok" if one.fine else "NOT", one.what, one.detail) for one in found.devices])
        wrong = sum(not one.fine for one in found.devices)
        self.verdict = "NOT FOUND" if found.error else f"{wrong} NOT FINE" if wrong else "all fine"
        self.told.setText(found.error or f"{len(found.devices)} things looked at, {self.verdict}.")

    def busy(self, *, busy: bool) -> None:
        """While a session is under way its devices are not looked at."""
        self.again.setEnabled(not busy)
        if busy:
            self.told.setText("A session is under way: the guard looks at every block. This was found before.")
