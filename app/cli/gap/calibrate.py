"""`dragrig gap calibrate`."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.analysis.gap.calibration import Calibration
from dragrig.cli import options
from dragrig.cli.console import result_json

if TYPE_CHECKING:
    from rich.console import RenderableType

    from dragrig.gap_scoring.rates import Rate

FOLDER = click.Path(path_type=Path)


@click.command("calibrate")
@click.argument("exams", metavar="EXAM…", type=FOLDER, nargs=-1, required=True)
@click.option("--save", metavar="FILE", type=FOLDER, help="File for dragrig gap diagnose --calibration.")
@click.option(
    "--folds",
    metavar="K",
    type=click.IntRange(min=2),
    help="Judge each of so many parts of the campaigns by what the others teach, and say how often that is right.",
)
@options.as_json
@options.overwrite
def command(exams: tuple[Path, ...], save: Path | None, folds: int | None, as_json: bool, overwrite: bool) -> None:
    """Learn when a gap is seen, and which effect it is, from exams that dragrig gap blind --out kept.

    Judge the result on an exam with another seed.
    """
    from dragrig.cli.gap.printing import show
    from dragrig.gap_calibrating import gap_calibrate, gap_cross_validate
    from dragrig.gap_scoring.document import rate_table
    from dragrig.reports.files import write_text

    found = gap_calibrate(exams)
    in_turn = () if folds is None else gap_cross_validate(exams, folds)
    if save is not None:
        write_text(found.model_dump_json(indent=1) + "\n", save, overwrite=overwrite)
    if as_json:
        judged = {} if folds is None else {"cross_validated": [rate_table(one) for one in in_turn]}
        result_json({**found.model_dump(mode="json"), **judged})
    else:
        show(_parts(found, in_turn, save))


def _parts(found: Calibration, in_turn: "Sequence[Rate]", saved: Path | None) -> "Iterator[RenderableType]":
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
    if in_turn:
        from dragrig.cli.gap.rate_rows import RATE_HEADER, RATE_NUMBERS, rate_row

        title = "How often verdicts are right that the other campaigns taught"
        yield table(title, RATE_HEADER, map(rate_row, in_turn), RATE_NUMBERS)
    if saved is not None:
        yield f"Written to {saved}."
