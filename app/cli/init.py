"""`dragrig init`."""

from pathlib import Path

import click

from dragrig.cli import options
from dragrig.cli.console import result, say


@click.command("init")
@click.argument("folder", metavar="[DIR]", default=".", type=click.Path(path_type=Path))
@options.quiet
def command(folder: Path) -> None:
    """Make a lab folder: rig settings, data root, calibration history.

    Every command called in or below it takes its rig from there.
    """
    from dragrig.lab import create

    for made in create(folder):
        result(str(made))
    say("Edit the rig settings, then try: dragrig check drag")
