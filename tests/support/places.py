"""Where the clone, the data of the tests and their helpers lie."""

from pathlib import Path

SUPPORT = Path(__file__).parent
TESTS = SUPPORT.parent
ROOT = TESTS.parent
DATA = TESTS / "data"
CAMPAIGN = DATA / "campaign"
"""Runs of every kind from somebody else's plant."""
REFERENCE = DATA / "reference"
"""Numbers of another implementation of the friction model."""
