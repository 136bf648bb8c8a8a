"""Run files finished without a second process, for tests that make runs."""

import multiprocessing.spawn  # noqa: F401  # it keeps the interpreter that it finds
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def finished_here() -> Iterator[None]:
    """Have this process finish its run files, as it does wherever the finisher's cannot be started.

    To start that takes longer than a quick session itself.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "executable", "no interpreter")
        yield
