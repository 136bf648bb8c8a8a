"""`dragrig gap calibrate`."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.analysis.gap.calibration import Calibration
from dragrig.cli import options
from dragrig.cli.console import result_json

if TYPE_CHECKING:
    from rich.console import RenderableType

FOLDER = click.Path(path_type=Path)


@click.command("calibrate")
@click.argument("exams", metavar="EXAM…", type=FOLDER, nargs=-1, required=True)
@click.option("--save", metavar="FILE", type=FOLDER, help="File for dragrig gap diagnose --calibration.")
@options.as_json
@options.overwrite
def command(exams: tuple[Path, ...], save: Path | None, as_json: bool, overwrite: bool) -> None:
    """Learn when a gap is seen, and which effect it is, from exams that dragrig gap blind --out kept.

    Judge the result on an exam with another seed.
    """
    from dragrig.cli.gap.printing import show
    from dragrig.gap_calibrating import gap_calibrate
    from dragrig.reports.files import write_text

    found = gap_calibrate(exams)
    if save is not None:
        write_text(found.model_dump_json(indent=1) + "\n", save, overwrite=overwrite)
    if as_json:
        result_json(found.model_dump(mode="json"))
    else:
        show(_parts(found, save))


def _parts(found: Calibration, saved: Path | None) -> "Iterator[RenderableType]":
    from dragrig.cli.gap.printing import table

    gate = found.gate
    seeds = ", ".join(map(str, found.seeds))
    yield f"Learnt from {found.cases} campaigns with hidden effects (seeds {seeds})."
    yield (
        f"A gap is as likely as not where an effect takes away {gate.least_gain:.1f} half squares, or where "
        f"{gate.least_left:.1%} of the squares are left that none explains."
    )
    rows = [(name, f"{weight:+.2f}") for name, weight in sorted(found.weights.items())]
    yield table("Weights of what speaks for an explanation", ("feature", "weight"), rows, numbers=(1,))
    if saved is not None:
        yield f"Written to {saved}."
