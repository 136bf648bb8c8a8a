"""Run files finished without a second process, for the tests that make runs."""

from collections.abc import Iterator

import pytest

import finishing


@pytest.fixture(scope="module")
def finished_here() -> Iterator[None]:
    """Have this process finish its run files, as it does wherever the finisher's cannot be started.

    To start that takes longer than a quick session itself.
    """
    with finishing.finished_here():
        yield
