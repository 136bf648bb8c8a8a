"""Pieces of work for other processes, which leave traces in a folder."""

import os
import sys
import time
from pathlib import Path

import numpy as np

from ending import kill

PATIENCE_S = 600.0


def product(seed: int) -> bytes:
    """Do some linear algebra; return the bits of the result."""
    values = np.random.default_rng(seed).normal(size=(120, 120))
    return np.asarray(np.linalg.solve(values, values @ values.T)).tobytes()


def traced(folder_and_number: tuple[Path, int]) -> bytes:
    """Leave a trace at the beginning and at the end; the first attempt at number 3 waits to be killed."""
    folder, number = folder_and_number
    begun = len(list(folder.glob(f"{number}-begun-*")))
    (folder / f"{number}-begun-{begun}").write_text(str(os.getpid()), "utf-8")
    if number == 3 and begun == 0:
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            time.sleep(0.01)
        raise RuntimeError("nobody killed this process")
    ended = len(list(folder.glob(f"{number}-ended-*")))
    result = product(number)
    (folder / f"{number}-ended-{ended}").touch()
    return result


def deadly(number: int) -> int:
    """Take the process along for number 1."""
    if number == 1:
        kill()
    return number


def failing(number: int) -> int:
    if number == 1:
        raise ValueError("one is not liked")
    return number


def loaded(name: str) -> tuple[int, bool]:
    """Return the process, and whether a module is loaded in it."""
    return os.getpid(), name in sys.modules
