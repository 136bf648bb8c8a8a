"""How long work tells how far it is."""

from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[int, int], None]
"""Called with how many pieces of work are done, and of how many."""


def silent(_done: int, _of: int) -> None:
    """Tell nobody."""
