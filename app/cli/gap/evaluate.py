"""`dragrig gap evaluate`."""

from pathlib import Path

import click

from dragrig.cli import options
from dragrig.cli.console import result_json

FILE = click.Path(path_type=Path)


@click.command("evaluate")
@click.argument("model", type=FILE)
@click.argument("campaign", type=FILE)
@click.option("--specimen", metavar="NAME", help="Name or id, where there are several; else the most measured.")
@options.as_json
@options.quiet
def command(model: Path, campaign: Path, specimen: str | None, as_json: bool) -> None:
    """Say how far an amended model closes the gap on fresh runs of the same specimen.

    MODEL is what dragrig gap diagnose wrote with --save-model, CAMPAIGN a folder of runs that took no part in it, best
    at other speeds.
    """
    from dragrig import diagnosing
    from dragrig.cli.gap.printing import show
    from dragrig.cli.gap.telling import shrink_parts
    from dragrig.gap_json import shrink_document

    found = diagnosing.gap_evaluate(model, campaign, specimen=specimen)
    if as_json:
        result_json(shrink_document(found))
    else:
        show(shrink_parts(found))
