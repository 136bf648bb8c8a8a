"""Ctrl-C and the other signals that end a program: who takes them, and that none breaks off what must be finished.

A signal may come at any instruction of the main thread, and again every 30 ms while the key is held. So whatever is
opened, closed or written here is broken off by none of them: a signal ends the work, which then ends in good order.
"""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from types import FrameType
from typing import Self

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
_ONE_PRESS_S = 2.0
"""A key that is held, or pressed again and again, counts once in this time."""
_DROPPED_S = 0.01
"""When what was raised in vain is raised again."""
_Handler = Callable[[int, FrameType | None], object] | int | None


class EndSignals:
    """Takes the signals that end a program, while its context lasts; on a thread that is not the main one, nothing.

    By itself it raises `KeyboardInterrupt`, as Python does, and not again while that unwinds. Inside `rig_open` it
    raises at an open prompt alone: elsewhere a signal aborts what moves, and one that comes while nothing can be
    aborted is kept for what begins next.

    Parameters
    ----------
    last
        Whether the process ends with the context: then no further Ctrl-C is taken, for the interpreter would print it.
    """

    def __init__(self, *, last: bool = False) -> None:
        self._last = last
        self._earlier: dict[signal.Signals, _Handler] = {}
        self._abort: Callable[[str], None] | None = None
        self._opened = 0
        self._at_prompt = False
        self._ending_since_s = -_ONE_PRESS_S
        self._report_unraisable = sys.unraisablehook
        self.interrupted = False
        """Whether `KeyboardInterrupt` was raised outside of `rig_open`: an error that follows may be made of it."""
        self.reason = ""
        """The first signal that came while a rig was open; empty while none did."""

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in _present_signals():
                self._earlier[number] = signal.signal(number, self._take)
            self._report_unraisable, sys.unraisablehook = sys.unraisablehook, self._raise_later
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._earlier.items():
            is_last = self._last and number is signal.SIGINT
            signal.signal(number, signal.SIG_IGN if is_last else signal.SIG_DFL if handler is None else handler)
        if self._earlier:
            sys.unraisablehook = self._report_unraisable

    @contextmanager
    def aborting(self, abort: Callable[[str], None]) -> Iterator[None]:
        """Have a signal call `abort` with its reason; one that came before is passed on now."""
        self._abort = abort
        try:
            if self.reason:
                abort(self.reason)
            yield
        finally:
            self._abort = None

    @contextmanager
    def prompting(self) -> Iterator[None]:
        """Have the next signal raise `KeyboardInterrupt`; one that came before raises it now."""
        self._at_prompt = True
        try:
            if self.reason:
                raise KeyboardInterrupt
            yield
        finally:
            self._at_prompt = False

    def open_rig(self) -> None:
        """Begin what no signal may break off."""
        if not self._opened:
            self.reason = ""
        self._opened += 1

    def close_rig(self) -> None:
        """End what no signal may break off."""
        self._opened -= 1
        if self.reason:
            self._ending_since_s = time.monotonic()

    def _take(self, number: int, frame: FrameType | None) -> None:
        del frame
        reason = "Ctrl-C" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
        if not self._opened:
            if time.monotonic() - self._ending_since_s >= _ONE_PRESS_S:
                self._ending_since_s, self.interrupted = time.monotonic(), True
                raise KeyboardInterrupt
            return
        self.reason = self.reason or reason
        if self._at_prompt:
            # Once: the next one would meet whoever clears up after this one.
            self._at_prompt = False
            raise KeyboardInterrupt
        if self._abort is not None:
            self._abort(self.reason)

    def _raise_later(self, unraisable: "sys.UnraisableHookArgs", /) -> None:
        if unraisable.exc_type is not KeyboardInterrupt:
            self._report_unraisable(unraisable)
            return
        # It was raised where Python drops what is raised, in a destructor or a callback, and would be lost; so it would
        # be here, which is such a place too.
        self._ending_since_s = -_ONE_PRESS_S
        later = threading.Timer(_DROPPED_S, signal.raise_signal, (signal.SIGINT,))
        later.daemon = True
        later.start()


def _present_signals() -> list[signal.Signals]:
    present = [signal.Signals[name] for name in _NAMES if name in signal.Signals.__members__]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
        # Under nohup a session outlives its terminal.
        present.remove(signal.SIGHUP)
    return present


@contextmanager
def rig_open() -> Iterator[EndSignals]:
    """Let no signal break off opening, use and closing of a rig; inside another `rig_open` it is part of that."""
    taking = getattr(signal.getsignal(signal.SIGINT), "__self__", None)
    on_main_thread = threading.current_thread() is threading.main_thread()
    with nullcontext(taking) if isinstance(taking, EndSignals) and on_main_thread else EndSignals() as signals:
        signals.open_rig()
        try:
            yield signals
        finally:
            signals.close_rig()
