"""Ctrl-C and the other signals that end a program: who takes them, and that none breaks off work that must be finished.

A signal may come at any instruction of the main thread, and again every 30 ms while the key is held. So whatever is
opened, closed or written here is broken off by none of them: a signal ends the work, which then ends in good order.

Windows has no signal for a closed console, a logoff and a shutdown: it calls a function on a thread of its own, and
ends the process once that returns, or after 5 s.
"""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from types import FrameType
from typing import Self

if sys.platform == "win32":
    import ctypes
    from ctypes import wintypes

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")
_ONE_PRESS_S = 2.0
"""A key that is held, or pressed again and again, counts once in this time."""
_DROPPED_S = 0.01
"""When what was raised in vain is raised again."""
_CONSOLE_ENDS = {2: "the console was closed", 5: "the user was logged off", 6: "the computer was shut down"}
"""What Windows tells a console's programs (wincon.h: CTRL_CLOSE_EVENT and following), but for Ctrl-C and Ctrl-Break."""
_Handler = Callable[[int, FrameType | None], object] | int | None


class EndSignals:
    """Takes the signals that end a program, while its context lasts; on a thread that is not the main one, nothing.

    By itself it raises `KeyboardInterrupt`, as Python does, and not again while that unwinds. Inside `rig_open` it
    raises at an open prompt alone: elsewhere a signal aborts the motion, and one that comes while nothing can be
    aborted is kept for the next motion.

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
        self._system, self._told, self._system_reason, self._left = ExitStack(), False, "", threading.Event()
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
        self._left.set()
        # Windows takes a handler back once it has returned.
        self._system.close()

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
        """Begin work that no signal may break off."""
        if not self._opened:
            self.reason = ""
        self._opened += 1
        if sys.platform == "win32" and self._earlier and not self._told:
            self._told = True
            self._system.enter_context(_told_of_ends(self.end))

    def close_rig(self) -> None:
        """End work that no signal may break off."""
        self._opened -= 1
        if self.reason:
            self._ending_since_s = time.monotonic()

    def end(self, reason: str) -> None:
        """End the work as a signal does, on another thread than the main one; returns once the context is left."""
        self._system_reason = reason
        _interrupt_main_thread()
        if sys.platform == "win32" and self._at_prompt:
            _cancel_reading()
        self._left.wait()

    def _take(self, number: int, frame: FrameType | None) -> None:
        del frame
        pressed = "Ctrl-C" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}"
        if not self._opened:
            if time.monotonic() - self._ending_since_s >= _ONE_PRESS_S:
                self._ending_since_s, self.interrupted = time.monotonic(), True
                raise KeyboardInterrupt
            return
        self.reason = self.reason or self._system_reason or pressed
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
        self._ending_since_s, returning = -_ONE_PRESS_S, threading.Event()

        def press_again() -> None:
            # On a busy computer this thread may run before the one that started it goes on here.
            returning.wait()
            time.sleep(_DROPPED_S)
            _interrupt_main_thread()

        try:
            threading.Thread(target=press_again, daemon=True).start()
        finally:
            returning.set()


def _interrupt_main_thread() -> None:
    """Raise SIGINT so that the main thread's wait ends as well, from any thread."""
    if sys.platform == "win32":
        signal.raise_signal(signal.SIGINT)
    else:
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)


if sys.platform == "win32":
    _THREAD_TERMINATE, _WM_QUIT, _WM_ENDSESSION, _ENDSESSION_LOGOFF, _GWLP_WNDPROC = 1, 0x12, 0x16, 1 << 31, -4

    @contextmanager
    def _told_of_ends(end: Callable[[str], None]) -> Iterator[None]:
        """Have Windows call `end` with why it ends this process; it ends it when that returns, or after 5 s."""
        kernel32 = ctypes.WinDLL("kernel32")

        @ctypes.WINFUNCTYPE(wintypes.BOOL, wintypes.DWORD)  # type: ignore[untyped-decorator]
        def console_ends(event: int) -> bool:
            if event in _CONSOLE_ENDS:
                end(_CONSOLE_ENDS[event])
            return event in _CONSOLE_ENDS

        kernel32.SetConsoleCtrlHandler(console_ends, True)
        windows = threading.Thread(target=_watch_hidden_window, args=(end,), name="end of Windows", daemon=True)
        windows.start()
        try:
            yield
        finally:
            kernel32.SetConsoleCtrlHandler(console_ends, False)
            while windows.is_alive():
                # In vain until it waits for messages.
                ctypes.WinDLL("user32").PostThreadMessageW(windows.native_id, _WM_QUIT, None, None)
                windows.join(_DROPPED_S)

    def _cancel_reading() -> None:
        """End the main thread's wait for a line of the console, which a signal of this program's own does not end."""
        kernel32 = ctypes.WinDLL("kernel32")
        kernel32.OpenThread.restype = wintypes.HANDLE
        main_thread = wintypes.HANDLE(kernel32.OpenThread(_THREAD_TERMINATE, False, threading.main_thread().native_id))
        kernel32.CancelSynchronousIo(main_thread)
        kernel32.CloseHandle(main_thread)

    def _watch_hidden_window(end: Callable[[str], None]) -> None:
        """Call `end` at a logoff and a shutdown, of which Windows tells no console program that has loaded user32."""
        user32 = ctypes.WinDLL("user32")
        arguments = (wintypes.HWND, wintypes.UINT, wintypes.WPARAM, wintypes.LPARAM)
        user32.DefWindowProcW.argtypes = arguments
        user32.DefWindowProcW.restype = user32.CreateWindowExW.restype = ctypes.c_ssize_t

        @ctypes.WINFUNCTYPE(ctypes.c_ssize_t, *arguments)  # type: ignore[untyped-decorator]
        def take(window: int, message: int, ends: int, how: int) -> int:
            if message == _WM_ENDSESSION and ends:
                end(_CONSOLE_ENDS[5 if how & _ENDSESSION_LOGOFF else 6])
            return int(user32.DefWindowProcW(window, message, ends, how))

        window = user32.CreateWindowExW(0, "STATIC", "dragrig", 0, 0, 0, 0, 0, None, None, None, None)
        user32.SetWindowLongPtrW.argtypes = (wintypes.HWND, ctypes.c_int, ctypes.c_void_p)
        user32.SetWindowLongPtrW(window, _GWLP_WNDPROC, ctypes.cast(take, ctypes.c_void_p))
        message = wintypes.MSG()
        while user32.GetMessageW(ctypes.byref(message), None, 0, 0) > 0:
            user32.DispatchMessageW(ctypes.byref(message))


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
