"""`dragrig report`."""

from pathlib import Path

import click

from dragrig.cli import options
from dragrig.cli.console import is_quiet, result, result_json, shown_path
from dragrig.cli.progress import Meter


@click.command("report")
@click.argument("source", metavar="RUN|CAMPAIGN", type=click.Path(path_type=Path))
@click.option(
    "--out",
    "-o",
    metavar="FILE.html",
    type=click.Path(path_type=Path),
    help="Where to write it; beside the run, or in the campaign's folder, unless given.",
)
@options.overwrite
@options.as_json
@options.quiet
def command(source: Path, out: Path | None, overwrite: bool, as_json: bool) -> None:
    """Write a report on a run file or a campaign's folder, one HTML file that can be mailed.

    Of a run: force, position and speed, measures with their errors, checks, events and all settings. Of a campaign:
    steady force against speed, relaxations, every run in a table and drawn by itself, sessions, and what was left out
    and why. The file holds its figures; tables sort by any column; it prints, and is readable on a phone.
    """
    from dragrig.reporting import report

    with Meter("measuring and drawing", 1.0, quiet=is_quiet()) as meter:
        written = report(source, out, overwrite=overwrite, progress=meter.at)
    if as_json:
        result_json({"source": source, "report": written})
        return
    result(shown_path(written))
