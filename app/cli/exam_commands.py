"""Commands that examine and calibrate the diagnosis: gap blind, gap calibrate."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.console import ProgressMeter, display_path, print_json, print_result

if TYPE_CHECKING:
    from rich.console import RenderableType

    from dragrig.analysis.gap.features import Calibration
    from dragrig.scoring import Rate


@click.command("blind")
@click.option("--cases", metavar="N", type=int, default=100, show_default=True, help="Number of campaigns.")
@click.option("--seed", metavar="S", type=int, default=1, show_default=True, help="Seed of the campaigns.")
@click.option(
    "--mix",
    "kind",
    type=click.Choice(["exam", "learning"]),
    default="exam",
    show_default=True,
    help="Mix of campaigns: as rigs have them, or with more hard cases, to learn from.",
)
@options.out("Folder of the exam, which a second call continues (default: a temporary one).")
@options.workers("campaigns")
@click.option("--without-true", is_flag=True, help="Diagnose single effects again with the true one withheld.")
@click.option(
    "--report",
    metavar="FILE.html",
    type=click.Path(path_type=Path),
    help="Write the report to this file.",
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
    """Examine how often the diagnosis is right, on simulated campaigns whose hidden effect it cannot know.

    A separate plant, which shares no equation with the catalogue, simulates the campaigns. The hash of the answers is
    written first; each campaign is diagnosed by a process that gets its folder alone; then the answers are opened and
    the verdicts scored, with Wilson intervals. Two exams with the same seed are identical. The exit code is 0 whatever
    the score, and 2 where campaigns could not be diagnosed.
    """
    from dragrig.config.errors import AnalysisError
    from dragrig.exam.blind_exam import gap_blind, save_exam_report
    from dragrig.present.exam import exam_parts
    from dragrig.present.files import require_writable
    from dragrig.present.terminal import print_parts

    if report is not None:
        require_writable(report, overwrite=overwrite)
    with ProgressMeter(f"examining {cases} campaigns") as meter:
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
        save_exam_report(exam, report, overwrite=overwrite)
        if not as_json:
            print_result(f"report  {display_path(report)}")
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
    help="Cross-validate with this number of folds, and print the rates.",
)
@options.as_json
@options.overwrite
def gap_calibrate_command(
    exams: tuple[Path, ...], save: Path | None, folds: int | None, as_json: bool, overwrite: bool
) -> None:
    """Learn the verdict's thresholds and weights from exams that dragrig gap blind --out wrote.

    Judge the result on an exam with another seed.
    """
    from dragrig.exam.learning import gap_calibrate, gap_cross_validate
    from dragrig.present.exam import rate_json
    from dragrig.present.files import write_text
    from dragrig.present.terminal import print_parts

    calibration = gap_calibrate(exams)
    rates = () if folds is None else gap_cross_validate(exams, folds)
    if save is not None:
        write_text(calibration.model_dump_json(indent=1) + "\n", save, overwrite=overwrite)
    if as_json:
        validation = {} if folds is None else {"cross_validated": [rate_json(rate) for rate in rates]}
        print_json({**calibration.model_dump(mode="json"), **validation})
    else:
        print_parts(_calibration_parts(calibration, rates, save))


def _calibration_parts(
    calibration: "Calibration", rates: "Sequence[Rate]", saved: Path | None
) -> "Iterator[RenderableType]":
    from dragrig.present.exam import RATE_HEADER, RATE_NUMBER_COLUMNS, rate_row
    from dragrig.present.terminal import terminal_table

    gate = calibration.gate
    seeds = ", ".join(map(str, calibration.seeds))
    yield f"Learnt from {calibration.cases} campaigns with hidden effects (seeds {seeds})."
    yield (
        f"Probability of a gap is 0.5 where an effect explains Δχ²/2 = {gate.least_gain:.1f}, or where "
        f"{gate.least_left:.1%} of χ² stays unexplained."
    )
    rows = [(name, f"{weight:+.2f}") for name, weight in sorted(calibration.weights.items())]
    yield terminal_table("Weights of the evidence for an explanation", ("feature", "weight"), rows, numbers=(1,))
    if rates:
        title = "Cross-validation: how often verdicts learnt from the other campaigns are right"
        yield terminal_table(title, RATE_HEADER, map(rate_row, rates), RATE_NUMBER_COLUMNS)
    if saved is not None:
        yield f"Written to {saved}."
