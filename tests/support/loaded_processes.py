"""Processes forked of one that has loaded what an engine needs, which takes each of them seconds otherwise."""

import multiprocessing
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess

import pytest

ENGINE = (
    "unaided_engine",
    "dragrig.engine_host.server",
    "dragrig.sim_backend.devices.simulated_backend",
    "dragrig.rig.protocols.kinds",
    "filelock",
    "dragrig.analysis.measures",
)


@contextmanager
def loaded_processes() -> Iterator[None]:
    """Start engines and diagnoses in this way as long as this lasts, where the system can.

    Engines of programs that tests start as processes of their own are spawned, as they are for people.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        yield
        return
    multiprocessing.set_forkserver_preload(list(ENGINE))
    context = multiprocessing.get_context("forkserver")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(multiprocessing, "get_context", lambda _: context)
        yield


@contextmanager
def command(*words: str) -> Iterator[BaseProcess]:
    """Have `dragrig` called with these words by a process of its own, which is killed at the end."""
    from dragrig.cli import main

    with loaded_processes():
        process = multiprocessing.get_context("spawn").Process(target=main, args=(list(words),))
        process.start()
    try:
        yield process
    finally:
        process.kill()
        process.join()
