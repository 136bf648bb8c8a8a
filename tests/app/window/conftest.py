"""A lab folder, engines that start at once, and patience, for the tests of the window."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from loaded_processes import loaded_processes
from windows import WAIT_MS, Until, lab_in

if TYPE_CHECKING:
    from pytestqt.qtbot import QtBot


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lab folder for a module's tests."""
    return lab_in(tmp_path_factory.mktemp("lab"))


@pytest.fixture(scope="module", autouse=True)
def starting_at_once() -> Iterator[None]:
    """Start engines of a process that has loaded what they need."""
    with loaded_processes():
        yield


@pytest.fixture
def until(qtbot: "QtBot") -> Until:
    """Wait until something is true, as long as a busy computer takes."""
    return lambda done: qtbot.waitUntil(done, timeout=WAIT_MS)
