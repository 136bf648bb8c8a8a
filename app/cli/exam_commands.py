"""Commands that examine and calibrate the diagnosis: gap blind, gap calibrate."""

from pathlib import Path

import click

from dragrig.cli import options
from dragrig.cli.console import ProgressMeter, display_path, print_document, print_json, print_result


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
    from dragrig.present.exam import exam_document
    from dragrig.present.files import require_writable

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
        print_document(exam_document(exam.score, exam.cases, exam.seed, exam.answers_sha256), as_json=False)
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
    from dragrig.present.exam import calibration_document
    from dragrig.present.files import write_text

    calibration = gap_calibrate(exams)
    rates = None if folds is None else gap_cross_validate(exams, folds)
    if save is not None:
        write_text(calibration.model_dump_json(indent=1) + "\n", save, overwrite=overwrite)
    print_document(calibration_document(calibration, rates), as_json=as_json)
    if save is not None and not as_json:
        print_result(f"calibration  {display_path(save)}")
