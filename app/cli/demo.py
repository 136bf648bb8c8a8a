"""`dragrig demo`."""

from pathlib import Path

import click

from dragrig.cli import options
from dragrig.cli.console import is_quiet, result, say, shown_path
from dragrig.cli.progress import Meter


@click.command("demo")
@click.option(
    "--out",
    "-o",
    metavar="DIR",
    default="dragrig-demo",
    show_default=True,
    type=click.Path(path_type=Path),
    help="Folder that gets a campaign.",
)
@options.quiet
def command(out: Path) -> None:
    """Run a short programme on the simulated rig and show what becomes of it.

    A blank run, a relaxation, a Coulomb test and drags at three speeds, one run file each; every trace filtered,
    exported as CSV and drawn; and a picture of the whole. Takes some seconds.
    """
    from dragrig import demo
    from dragrig.analysis.table import table
    from dragrig.cli.operator import Terminal
    from dragrig.cli.table import table_text

    say("The simulated rig makes a blank run, a relaxation, a Coulomb test and drags at three speeds:")
    with Terminal(yes=True) as person:
        made = demo.measure(out, person)
    say("Filtering, exporting and drawing every run …")
    with Meter("filtering, exporting, drawing", 1.0, quiet=is_quiet()) as meter:
        overview = demo.evaluate(made, meter.at)
    result(table_text(table(made.folder)))
    folder = shown_path(made.folder)
    result(
        f"\nrun files  {folder}\ncsv        {shown_path(made.folder / demo.TABLES)}"
        f"\npictures   {shown_path(made.folder / demo.PICTURES)}, {shown_path(overview)}"
    )
    say(f"\nLook at it: dragrig info {folder}\nYour own:   dragrig init lab, then in it: dragrig run drag")
