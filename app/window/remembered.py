"""What the window keeps from one day to the next."""

from PySide6.QtCore import QByteArray, QSettings


class Remembered:
    """Settings by name; what was never kept, or is of another kind, is the usual."""

    def __init__(self, settings: QSettings | None = None) -> None:
        self._settings = settings or QSettings("dragrig", "window")

    def text(self, name: str, usual: str = "") -> str:
        """Return a text."""
        value = self._settings.value(name)
        return value if isinstance(value, str) else usual

    def number(self, name: str, usual: float) -> float:
        """Return a number."""
        try:
            return float(self.text(name))
        except ValueError:
            return usual

    def shape(self, name: str) -> QByteArray | None:
        """Return a window's or a splitter's shape."""
        value = self._settings.value(name)
        return value if isinstance(value, QByteArray) else None

    def keep(self, name: str, value: str | float | QByteArray) -> None:
        """Keep a value."""
        self._settings.setValue(name, value if isinstance(value, QByteArray) else str(value))
