"""Where the clone, the data of the tests and their helpers lie, and copies of the campaign's runs."""

import shutil
from pathlib import Path

SUPPORT = Path(__file__).parent
TESTS = SUPPORT.parent
ROOT = TESTS.parent
DATA = TESTS / "data"
CAMPAIGN = DATA / "campaign"
"""Runs of every kind from somebody else's plant."""
REFERENCE = DATA / "reference"
"""Numbers of another implementation of the friction model."""


def copied_runs(folder: Path, *names: str) -> Path:
    """Copy some runs of the campaign into a new folder."""
    folder.mkdir()
    for name in names:
        shutil.copy(CAMPAIGN / name, folder)
    return folder
