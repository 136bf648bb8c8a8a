"""What the commands share that move the stage by hand."""

from collections.abc import Callable
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import click

from dragrig.cli.console import result, result_json, say

if TYPE_CHECKING:
    from dragrig.handling import Moved
    from dragrig.rig.devices import Side

P = ParamSpec("P")
R = TypeVar("R")


def yes(function: Callable[P, R]) -> Callable[P, R]:
    """Add `--yes`."""
    said = "Answer every question with done that asks for nobody's hands or eyes at the rig."
    return click.option("--yes", "-y", is_flag=True, help=said)(function)


def override(function: Callable[P, R]) -> Callable[P, R]:
    """Add `--override-limit`, passed on as `override`."""
    said = "Go although this side's limit switch is pressed; everything else stays watched."
    return click.option("--override-limit", "override", type=click.Choice(["low", "high"]), help=said)(function)


def side(word: str | None) -> "Side | None":
    """Return the side that `--override-limit` names."""
    from dragrig.rig.devices import Side

    return None if word is None else Side(word)


def tell(moved: "Moved", *, as_json: bool) -> None:
    """Print where the stage is, and what the guard is tripped on still."""
    if as_json:
        result_json(moved)
        return
    result(f"{moved.position_mm:.3f} mm")
    if moved.trip is not None:
        say(f"The guard stays tripped: {moved.trip.message}.")
