"""Commands that examine and calibrate the diagnosis: gap blind, gap calibrate."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.analysis.gap.features import Calibration
from dragrig.cli import options
from dragrig.cli.console import ProgressMeter, display_path, is_quiet, print_json, print_result

if TYPE_CHECKING:
    from rich.console import RenderableType

    from dragrig.scoring import Rate


@click.command("blind")
@click.option("--cases", metavar="N", type=int, default=100, show_default=True, help="How many campaigns.")
@click.option("--seed", metavar="S", type=int, default=1, show_default=True, help="What they are drawn from.")
@click.option(
    "--mix",
    "kind",
    type=click.Choice(["exam", "learning"]),
    default="exam",
    show_default=True,
    help="Which campaigns: as rigs have them, or with more of what is hard, to learn from.",
)
@options.out("Folder in which all is kept, so that a second call goes on; a temporary one unless given.")
@options.workers("campaigns")
@click.option("--without-true", is_flag=True, help="Diagnose single effects again with the true one withheld.")
@click.option(
    "--report",
    metavar="FILE.html",
    type=click.Path(path_type=Path),
    help="Where to write the report, one HTML file with its pictures.",
)
@options.overwrite
@options.as_json
@options.quiet
def blind_command(
    cases: int,
    seed: int,
    kind: str,
    out: Path | None,
    workers: int | None,
    scheduler: str | None,
    without_true: bool,
    report: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Examine the diagnosis on campaigns whose hidden effect it cannot know, and say how often it was right.

    A plant of its own, which shares no formula with the catalogue, makes the campaigns. The hash of the answers is
    written first; each campaign is diagnosed by a process that is given its folder alone; then the answers are opened
    and the verdicts scored, with Wilson intervals. Two exams with one seed are the same. The exit code is 0 however
    often it was right, and 2 where campaigns could not be diagnosed.
    """
    from dragrig.config.errors import AnalysisError
    from dragrig.exam.blind_exam import gap_blind, save_exam_report
    from dragrig.present.exam import exam_parts
    from dragrig.present.files import require_writable
    from dragrig.present.terminal import print_parts

    if report is not None:
        require_writable(report, overwrite=overwrite)
    with ProgressMeter(f"examining {cases} campaigns", 1.0, quiet=is_quiet()) as meter:
        exam = gap_blind(
            cases,
            seed,
            out,
            workers=workers,
            scheduler=scheduler,
            kind=kind,
            without_true=without_true,
            progress=meter.at,
        )
    if as_json:
        print_json(exam.document())
    else:
        print_parts(exam_parts(exam.score, exam.cases, exam.seed, exam.answers_sha256))
    if report is not None:
        written = save_exam_report(exam, report, overwrite=overwrite)
        if not as_json:
            print_result(f"report  {display_path(written)}")
    if exam.failed:
        name, reason = next(iter(exam.failed.items()))
        raise AnalysisError(f"{len(exam.failed)} of {cases} campaigns were not diagnosed; of {name}: {reason}.")


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
def gap_calibrate_command(
    exams: tuple[Path, ...], save: Path | None, folds: int | None, as_json: bool, overwrite: bool
) -> None:
    """Learn when a gap is seen, and which effect it is, from exams that dragrig gap blind --out kept.

    Judge the result on an exam with another seed.
    """
    from dragrig.exam.learning import gap_calibrate, gap_cross_validate
    from dragrig.present.exam import rate_json
    from dragrig.present.files import write_text
    from dragrig.present.terminal import print_parts

    found = gap_calibrate(exams)
    in_turn = () if folds is None else gap_cross_validate(exams, folds)
    if save is not None:
        write_text(found.model_dump_json(indent=1) + "\n", save, overwrite=overwrite)
    if as_json:
        judged = {} if folds is None else {"cross_validated": [rate_json(one) for one in in_turn]}
        print_json({**found.model_dump(mode="json"), **judged})
    else:
        print_parts(_calibration_parts(found, in_turn, save))


def _calibration_parts(found: Calibration, in_turn: "Sequence[Rate]", saved: Path | None) -> "Iterator[RenderableType]":
    from dragrig.present.terminal import terminal_table

    gate = found.gate
    seeds = ", ".join(map(str, found.seeds))
    yield f"Learnt from {found.cases} campaigns with hidden effects (seeds {seeds})."
    yield (
        f"A gap is as likely as not where an effect takes away {gate.least_gain:.1f} half squares, or where "
        f"{gate.least_left:.1%} of the squares are left that none explains."
    )
    rows = [(name, f"{weight:+.2f}") for name, weight in sorted(found.weights.items())]
    yield terminal_table("Weights of what speaks for an explanation", ("feature", "weight"), rows, numbers=(1,))
    if in_turn:
        from dragrig.present.exam import RATE_HEADER, RATE_NUMBER_COLUMNS, rate_row

        title = "How often verdicts are right that the other campaigns taught"
        yield terminal_table(title, RATE_HEADER, map(rate_row, in_turn), RATE_NUMBER_COLUMNS)
    if saved is not None:
        yield f"Written to {saved}."
