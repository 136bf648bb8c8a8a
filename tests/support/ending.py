"""Signals to this program, and the end of others that hear nothing of it, as every system has them."""

import os
import signal
import sys

import psutil


def press(number: signal.Signals = signal.SIGINT) -> None:
    """Have this program take a signal, from any of its threads: to kill itself by one would end it on Windows."""
    if sys.platform == "win32":
        signal.raise_signal(number)
    else:
        os.kill(os.getpid(), number)


def kill(pid: int | None = None) -> None:
    """End a process, or this one, as nothing can be put in order before."""
    psutil.Process(pid).kill()


def was_killed(exit_code: int | None) -> bool:
    """Tell by its exit code whether a process was killed by `kill`, or by `Popen.kill`, which Windows tells apart."""
    return exit_code in ({1, signal.SIGTERM} if sys.platform == "win32" else {-signal.SIGKILL})
