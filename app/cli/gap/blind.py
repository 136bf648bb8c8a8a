"""`dragrig gap blind`."""

from pathlib import Path

import click

from dragrig.cli import options
from dragrig.cli.console import is_quiet, result, result_json, shown_path
from dragrig.cli.progress import Meter


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
def command(
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
    from dragrig.blind.exam import save_report
    from dragrig.blind.holding import gap_blind
    from dragrig.cli.gap.blind_telling import exam_parts
    from dragrig.cli.gap.printing import show
    from dragrig.config.errors import AnalysisError
    from dragrig.reports.files import require_room

    if report is not None:
        require_room(report, overwrite=overwrite)
    with Meter(f"examining {cases} campaigns", 1.0, quiet=is_quiet()) as meter:
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
        result_json(exam.document())
    else:
        show(exam_parts(exam))
    if report is not None:
        written = save_report(exam, report, overwrite=overwrite)
        if not as_json:
            result(f"report  {shown_path(written)}")
    if exam.failed:
        name, reason = next(iter(exam.failed.items()))
        raise AnalysisError(f"{len(exam.failed)} of {cases} campaigns were not diagnosed; of {name}: {reason}.")
