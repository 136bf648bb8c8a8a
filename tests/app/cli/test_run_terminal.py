"""`dragrig run` at a real terminal: the force while it runs, and the key that pauses the session."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import Popen

import pytest

from driving import until

pytestmark = pytest.mark.skipif(os.name == "nt", reason="no pty on Windows")
PLAN = ("drag", "--pace", "real", "--yes", "--set", "travel_mm=10", "--set", "speed_mm_s=[5.0, 25.0]",
        "--set", "rest_s=0.2", "--set", "hold_s=0.5", "--set", "wait_s=0", "--set", "way_back=stay")  # fmt: skip


class Terminal:
    """A terminal, what was shown on it so far, and the process that it belongs to."""

    def __init__(self, process: Popen[bytes], keyboard: int) -> None:
        self.process, self._keyboard, self._shown = process, keyboard, b""

    def type(self, keys: str) -> None:
        os.write(self._keyboard, keys.encode())

    def shows(self, text: str) -> bool:
        """Whether a text was shown by now."""
        while self._has_more():
            self._shown += os.read(self._keyboard, 65536)
        return text in self._shown.decode("utf-8", "replace")

    def has_ended(self) -> bool:
        """Whether the process is over; what it shows is taken off its hands meanwhile."""
        self.shows("")
        return self.process.poll() is not None

    def echoes(self) -> bool:
        """Whether the terminal shows what is typed, as it does between commands."""
        import termios

        return bool(termios.tcgetattr(self._keyboard)[3] & termios.ECHO)

    def _has_more(self) -> bool:
        from select import select

        return bool(select([self._keyboard], [], [], 0)[0])


@contextmanager
def at_a_terminal(*arguments: str) -> Iterator[Terminal]:
    import fcntl
    import struct
    import termios

    keyboard, screen = os.openpty()
    fcntl.ioctl(screen, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 100, 0, 0))

    # A terminal that the leader of a session opens becomes its own: only then are the keys for it.
    on_terminal = ("sh", "-c", 'exec "$@" <"$0" >"$0" 2>&1', os.ttyname(screen))
    process = Popen(
        [*on_terminal, sys.executable, "-m", "dragrig", "run", *arguments],
        env=os.environ | {"TERM": "xterm-256color"},
        start_new_session=True,
    )
    try:
        yield Terminal(process, keyboard)
    finally:
        process.kill()
        process.wait()
        os.close(screen)
        os.close(keyboard)


def test_a_key_pauses_the_session_or_takes_it_back_until_the_person_goes_on(tmp_path: Path) -> None:
    out = tmp_path / "live"
    with at_a_terminal(*PLAN, "--plot", "--out", str(out)) as terminal:
        until(lambda: terminal.shows("along the way"), 60.0)
        assert terminal.shows("force (mN) against time (s)")
        terminal.type("p")
        until(lambda: terminal.shows("Pausing after this run"), 60.0)
        terminal.type("p")
        until(lambda: terminal.shows("No pause"), 60.0)
        terminal.type("p")
        until(lambda: terminal.shows("Paused. Next is"), 60.0)
        assert terminal.echoes()
        assert len(list(out.glob("*.h5"))) == 1
        terminal.type("done\n")
        until(terminal.has_ended, 60.0)
        assert terminal.process.returncode == 0
        assert terminal.shows("2 runs: 2 complete")
        assert terminal.echoes()
    assert len(list(out.glob("*.h5"))) == 2


@pytest.mark.thorough
def test_a_pause_is_taken_back_by_the_same_key(tmp_path: Path) -> None:
    with at_a_terminal(*PLAN, "--out", str(tmp_path / "live")) as terminal:
        until(lambda: terminal.shows("pauses after the run"), 60.0)
        terminal.type("p")
        until(lambda: terminal.shows("Pausing after this run"), 20.0)
        terminal.type("p")
        until(lambda: terminal.shows("No pause"), 20.0)
        until(terminal.has_ended, 60.0)
        assert terminal.process.returncode == 0
        assert not terminal.shows("Paused.")
