"""Engines that start at once, for the tests of their host."""

from collections.abc import Iterator

import pytest

from loaded_processes import loaded_processes


@pytest.fixture(scope="module", autouse=True)
def starting_at_once() -> Iterator[None]:
    """Start engines of a process that has loaded what they need."""
    with loaded_processes():
        yield
