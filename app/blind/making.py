"""The blind plant's side of an exam."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING

from dragrig.sim_backend.blind import make

if TYPE_CHECKING:
    from dragrig.blind.mixing import Case

BEGUN = ".begun"
"""How the name of a hidden folder ends in which runs are written that are not all there yet."""


@dataclass(frozen=True, slots=True)
class Order:
    """A campaign to be written to a folder, and a fresh session of the same specimen to another."""

    case: "Case"
    campaign: Path
    fresh: Path


def write(order: Order) -> None:
    """Write what is not there yet; a folder is there with all its runs or not at all.

    Raises
    ------
    OSError
        When a file cannot be written.
    """
    secret = order.case.secret
    for folder, runs in ((order.campaign, None), (order.fresh, "fresh")):
        if folder.is_dir():
            continue
        folder.parent.mkdir(parents=True, exist_ok=True)
        begun = Path(mkdtemp(prefix=f".{folder.name}-", suffix=BEGUN, dir=folder.parent))
        try:
            make(secret, begun, runs=runs)
            begun.chmod(0o755)
            begun.rename(folder)
        except OSError:
            if not folder.is_dir():  # else another worker was told to write the same, and was first
                raise
        finally:
            shutil.rmtree(begun, ignore_errors=True)


def clear(order: Order) -> None:
    """Remove what workers have left that were killed while they wrote a campaign or a fresh session.

    Nobody else may be at work in the exam's folder.
    """
    for folder in (order.campaign, order.fresh):
        for left in folder.parent.glob(f".{folder.name}-*{BEGUN}"):
            shutil.rmtree(left, ignore_errors=True)


def amount(case: "Case") -> float:
    """Return d′ of what is hidden: in the force, or in the position where it is larger there."""
    from dragrig.sim_backend.blind.size import size

    found = size(case.secret)
    return max(found.force, found.position)
