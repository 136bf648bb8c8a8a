"""Keeps the interpreter's own pauses short while a rig is connected."""

import gc
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def short_collections() -> Iterator[None]:
    """Let the garbage collector pass over all that is there already.

    A full collection of what the libraries loaded holds every thread for some 90 ms: long enough for a velocity's
    output to run dry, and for a motion to set out late.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
