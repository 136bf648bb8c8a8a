"""The operator at the terminal: answers prompts, sees a session's progress and force, and pauses it with a key."""

import os
import shutil
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from threading import Event as Signal
from types import TracebackType
from typing import TYPE_CHECKING, Self

import click
import numpy as np

from dragrig.analysis import printable
from dragrig.cli.console import ProgressMeter, echo, is_quiet
from dragrig.config import DragrigError, reason_of
from dragrig.present import duration_text
from dragrig.rig import (
    HOMING,
    AcquisitionOutcome,
    Answer,
    Drift,
    LiveReading,
    PlannedRun,
    Programme,
    Prompt,
    Reading,
    RigCheck,
    RunStatus,
)

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderResult

PAUSE_KEY = "p"
_PLOT_ROWS = 14
_MAX_STRETCHES = 512
"""More than a terminal has columns: beyond it, stretches of a long run are joined in pairs."""
_KEY_POLL_S = 0.1
_LIVE_LINE_S = 0.1


class TerminalOperator:
    """Prints a session's prompts, progress and checks on standard error, and reads answers from standard input.

    Parameters
    ----------
    yes
        Answer every prompt that needs no hands with done.
    plot
        Show the force of the run in progress above the bar.
    """

    def __init__(self, *, yes: bool, plot: bool = False) -> None:
        self.pause = Signal()
        """Set by the person's key: the session waits before its next run."""
        self._keys = KeyWatch(self._key_pressed)
        self._plot = ForcePlot() if plot else None
        self._pause_wanted = False
        self._yes = yes
        self._real_time = False
        # Read here: the session's own thread has no click context.
        self._quiet = is_quiet()
        self._meter = ProgressMeter("", 1.0, quiet=self._quiet)
        self._pending: Sequence[PlannedRun] = ()
        self._seen_s = 0.0
        self._order = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._keys.end()
        self._meter.__exit__(kind, error, trace)

    @property
    def attended(self) -> bool:
        """Whether a person answers prompts that need no hands."""
        return not self._yes or self._pause_wanted

    def ask(self, prompt: Prompt) -> Answer:
        """Print a prompt and read the answer; its first letter is enough, an empty line means done.

        `--yes` answers every prompt that needs no hands at the rig, but not the one after the pause key.
        """
        if self._yes and not prompt.hands and not self._pause_wanted:
            return Answer.DONE
        self._pause_wanted = False
        watched = self._keys.end()
        try:
            return self._answer(prompt)
        finally:
            if watched:
                self._keys.begin()

    def _answer(self, prompt: Prompt) -> Answer:
        self._meter.pause()
        names = ", ".join(f"[{answer.value[0]}]{answer.value[1:]}" for answer in prompt.choices)
        echo(f"\n{_wrapped(f'{prompt.text}.')}", err=True)
        if prompt.run is not None and prompt.run.mounting not in prompt.text:
            echo(_wrapped(f"  Next run: {prompt.run.mounting}."), err=True)
        if prompt.hands:
            _discard_typed_input()
        while True:
            with LiveLine(prompt.look):
                echo(f"  {names}: ", err=True, newline=False)
                line = sys.stdin.readline() if sys.stdin is not None else ""  # None when it was closed before the start
            if not line:
                why = "this needs hands at the rig" if prompt.hands else "--yes answers every such prompt with done"
                echo(f"\nNobody answers on standard input; {why}.", err=True)
                return Answer.ABORT
            typed = line.strip().lower() or Answer.DONE.value
            for answer in prompt.choices:
                if answer.value.startswith(typed):
                    return answer

    def show_finding(self, finding: RigCheck) -> None:
        """Print the finding on a signal."""
        if not self._quiet:
            echo(f"  {'ok' if finding.passed else 'FAILED'}: {finding.name}: {finding.detail}.", err=True)

    def begins(self, programme: Programme, pending: Sequence[PlannedRun], *, real_time: bool) -> None:
        """Start the progress bar."""
        self._real_time = real_time
        self._pending = pending
        self._meter = ProgressMeter(programme.plan.name, self._duration_s(pending), quiet=self._quiet, above=self._plot)
        if self._keys.begin() and real_time:
            self._meter.say(f"  {PAUSE_KEY} pauses after the run in progress, Ctrl-C ends the session")

    def homes(self, *, over: bool) -> None:
        """Print that the stage moves, in real time."""
        if self._real_time and not over:
            self._meter.say(f"  {HOMING}")

    def waits(self, run: PlannedRun, duration_s: float) -> None:
        """Print how long the contact rests, in real time."""
        self._begin_plot()
        if self._real_time:
            self._meter.say(f"  rest before {run.summary}: {duration_text(duration_s)}")

    def _begin_plot(self) -> None:
        self._seen_s = 0.0
        if self._plot is not None:
            self._plot.clear()

    def run_begins(self, run: PlannedRun, order: int) -> None:
        """Show which run the bar is at."""
        self._begin_plot()
        # Runs before it were made or skipped, and it may be made again.
        before = [earlier for earlier in self._pending if earlier.index < run.index]
        rest_s = run.wait_s if self._real_time else 0.0
        self._order = order
        label = f"{len(before) + 1} of {len(self._pending)}: run {order}, {run.summary}"
        self._meter.to(self._duration_s(before) + rest_s, label)

    def reads(self, reading: Reading) -> None:
        """Advance the bar."""
        now = float(reading.time[-1])
        if self._plot is not None:
            self._plot.add(reading)
        self._meter.advance(now - self._seen_s)
        self._seen_s = now

    def run_ends(self, run: PlannedRun, outcome: AcquisitionOutcome) -> None:
        """Print one line: how the run ended, and its checks."""
        checks = outcome.checks.values
        results = []
        if "rest_offset_mN" in checks:
            results.append(f"at rest {checks['rest_offset_mN']:+z.1f} mN, noise {checks['rest_noise_mN']:.1f} mN")
        results.append(f"following error {1000 * float(checks['following_error_mm']):.1f} µm")
        line = f"{self._order:3d}  {run.summary:22} {outcome.status.value:9} {', '.join(results)}"
        reason = [outcome.reason] if outcome.status is not RunStatus.COMPLETE else []
        self._meter.say("; ".join((line, *reason, *(f"NOTE {warning}" for warning in outcome.checks.warnings))))

    def sentinel_compared(self, drift: Drift) -> None:
        """Print how far the specimen has drifted, unless a prompt says it at once."""
        if not drift.needs_decision:
            self._meter.say(f"     {drift}")
        elif self._yes and not self._pause_wanted:
            self._meter.say(f"     NOTE {drift}; --yes goes on, and the run's note says so")

    def _key_pressed(self, key: str) -> None:
        if key.lower() != PAUSE_KEY:
            return
        self._pause_wanted = not self._pause_wanted
        if self._pause_wanted:
            self.pause.set()
            self._meter.say(f"  Pausing after this run and its way back; {PAUSE_KEY} again goes on without")
        else:
            self.pause.clear()
            self._meter.say("  No pause")

    def _duration_s(self, runs: Iterable[PlannedRun]) -> float:
        return sum(run.duration_s + (run.wait_s if self._real_time else 0.0) for run in runs)


class ForcePlot:
    """The force of the run in progress against time, in a terminal's letters. Any thread may add or draw."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._stretches = np.empty((0, 3))
        """Time, smallest and largest force of each stretch."""
        self._joined = 1
        """Blocks in a stretch."""
        self._open: list[tuple[float, float, float]] = []
        self._now = ""

    def clear(self) -> None:
        """Begin a run."""
        with self._lock:
            self._stretches, self._joined, self._open, self._now = np.empty((0, 3)), 1, [], ""

    def add(self, reading: Reading) -> None:
        """Add a block."""
        force = reading.channels["force"]
        block = float(reading.time[-1]), float(force.min()), float(force.max())
        with self._lock:
            self._now = (
                f"force {float(force[-1]):+.1f} mN at {float(reading.channels['position'][-1]):+.2f} mm along the way, "
                f"{block[0]:.1f} s"
            )
            self._open.append(block)
            if len(self._open) < self._joined:
                return
            times, lowest, highest = zip(*self._open, strict=True)
            self._open = []
            self._stretches = np.vstack((self._stretches, (times[-1], min(lowest), max(highest))))
            if len(self._stretches) == _MAX_STRETCHES:
                pairs = self._stretches.reshape(-1, 2, 3)
                joined = (pairs[:, 1, 0], pairs[:, :, 1].min(axis=1), pairs[:, :, 2].max(axis=1))
                self._stretches, self._joined = np.column_stack(joined), 2 * self._joined

    def __rich_console__(self, console: "Console", options: "ConsoleOptions") -> "RenderResult":
        """Yield the plot in the width of a terminal; nothing before the first stretches."""
        from rich.text import Text

        with self._lock:
            stretches, now = self._stretches, self._now
        if len(stretches) < 2:  # a line
            return
        yield Text.from_ansi(self._drawn(stretches, options.max_width))
        yield Text(f"  {now}")

    def _drawn(self, stretches: np.ndarray[tuple[int, ...], np.dtype[np.float64]], width: int) -> str:
        import plotext

        plotext.clear_figure()
        plotext.theme("clear")
        plotext.plot_size(width, _PLOT_ROWS)
        plotext.title("force (mN) against time (s)")
        # From the smallest to the largest of each stretch: a single curve would leave peaks out.
        plotext.plot(np.repeat(stretches[:, 0], 2).tolist(), stretches[:, 1:].ravel().tolist(), marker="braille")
        return str(plotext.build())


class LiveLine:
    """A line above an open prompt that shows the rig as it changes, from a thread of its own, in a terminal alone.

    Parameters
    ----------
    look
        Reads the rig; called by this thread alone until the context ends. None shows nothing.
    """

    def __init__(self, look: Callable[[], LiveReading] | None) -> None:
        self._look = look if sys.stderr.isatty() and sys.stdin is not None and sys.stdin.isatty() else None
        self._ended = Signal()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> None:
        if self._look is not None:
            echo(err=True)  # the line's place
            self._thread = threading.Thread(target=self._show, args=(self._look,), name="live line", daemon=True)
            self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def _show(self, look: Callable[[], LiveReading]) -> None:
        while not self._ended.wait(_LIVE_LINE_S):
            try:
                text = look().text
            except DragrigError as error:
                text = reason_of(error)
            if self._ended.is_set():
                # The answer's Enter has moved the cursor: the line above is the answer now.
                return
            columns = shutil.get_terminal_size().columns
            # To the line above and back to where the answer is typed.
            shown = printable(text)[: columns - 3]
            click.echo(f"\x1b7\x1b[1A\r\x1b[2K  {shown}\x1b8", err=True, nl=False)  # noqa: TID251  # drives the cursor


class KeyWatch:
    """Calls a function with each key typed at the terminal, from a thread of its own.

    Nothing is read while another program has the terminal, or where there is none: to touch the terminal from the
    background would stop this program.
    """

    def __init__(self, pressed: Callable[[str], None]) -> None:
        self._pressed = pressed
        self._ended = Signal()
        self._thread: threading.Thread | None = None

    def begin(self) -> bool:
        """Watch from here on; return False where no key can be seen."""
        if self._thread is not None or not (_is_own_terminal() and sys.stderr.isatty()):
            return self._thread is not None
        self._ended = Signal()
        restore = _take_single_keys()
        self._thread = threading.Thread(target=self._watch, args=(self._ended, restore), name="keys", daemon=True)
        self._thread.start()
        return True

    def end(self) -> bool:
        """Watch no longer, and leave the terminal as it was; return whether it was watched. Safe to call twice."""
        watched, self._thread = self._thread, None
        if watched is None:
            return False
        self._ended.set()
        watched.join()
        return True

    def _watch(self, ended: Signal, restore: Callable[[], None]) -> None:
        try:
            for key in _typed_keys(ended):
                self._pressed(key)
        finally:
            restore()


def _wrapped(text: str) -> str:
    """Break a text between words where a terminal would break it within them."""
    if not sys.stderr.isatty():
        return text
    return click.wrap_text(text, width=shutil.get_terminal_size().columns)


def _is_own_terminal() -> bool:
    """Tell whether standard input is a terminal whose keys are for this program."""
    if sys.stdin is None or not sys.stdin.isatty():
        return False
    return sys.platform == "win32" or os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()


def _typed_keys(ended: Signal) -> Iterator[str]:
    """Yield each key as it is typed, without Enter, until `ended` is set."""
    if sys.platform == "win32":
        import msvcrt

        while not ended.wait(_KEY_POLL_S):
            while msvcrt.kbhit():
                yield msvcrt.getwch()
    else:
        from select import select

        terminal = sys.stdin.fileno()
        while not ended.is_set():
            if not _is_own_terminal():
                ended.wait(_KEY_POLL_S)
            elif select([terminal], [], [], _KEY_POLL_S)[0]:
                typed = os.read(terminal, 1)
                if not typed:
                    return
                yield typed.decode("ascii", "replace")


def _take_single_keys() -> Callable[[], None]:
    """Have the terminal pass keys on without Enter and without showing them; return the end of that."""
    if sys.platform == "win32":
        return lambda: None
    import termios
    import tty

    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    # Without a flush: what was typed already is for this program too.
    tty.setcbreak(terminal, termios.TCSADRAIN)

    def restore() -> None:
        if _is_own_terminal():
            termios.tcsetattr(terminal, termios.TCSADRAIN, before)

    return restore


def _discard_typed_input() -> None:
    """Discard keys typed before the prompt: an Enter too many must not start a motion."""
    if not sys.stdin.isatty():
        return
    if sys.platform == "win32":
        import msvcrt

        while msvcrt.kbhit():
            msvcrt.getwch()
    else:
        import termios

        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)
