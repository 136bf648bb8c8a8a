"""`dragrig recover`."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.console import BAD_INPUT, complain, is_quiet, result, result_json, say
from dragrig.cli.progress import Meter

if TYPE_CHECKING:
    from dragrig.rig.runfile import Recovered


@click.command("recover")
@click.argument("places", metavar="[PLACE…]", nargs=-1, type=click.Path(path_type=Path))
@options.as_json
@options.quiet
@click.pass_context
def command(ctx: click.Context, places: tuple[Path, ...], as_json: bool) -> None:
    """Finish the runs that a crash left behind.

    PLACE is a folder, searched with everything below it, or one recording (NAME.recording.h5); the working folder
    unless given. A recording that is still being written is left alone, and so is one that cannot be read.
    """
    from dragrig.rig.runfile import Outcome, left_recordings, recover

    somewhere = places or (Path(),)
    total = sum(len(left_recordings(place)) for place in somewhere)
    found: list[Recovered] = []
    with Meter("recovering", total, quiet=is_quiet()) as meter:
        for place in somewhere:
            found += recover(place, lambda recording: meter.advance(0.0, f"recovering {recording.name}"))
            meter.advance(float(len(left_recordings(place))))
    if as_json:
        result_json(found)
    else:
        for one in found:
            if one.path is not None:
                result(f"{one.path}  {one.samples} samples")
    if not found:
        say("There is nothing to recover.")
    left = [one for one in found if one.outcome is Outcome.LEFT]
    for one in found:
        if one.outcome is not Outcome.FINISHED:
            complain(one.message)
    if left:
        ctx.exit(BAD_INPUT)
