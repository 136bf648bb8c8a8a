"""`dragrig mark`."""

import click

from dragrig.cli import options
from dragrig.cli.console import result, result_json


@click.command("mark")
@options.inputs
@click.option("--bad", metavar="REASON", help="Why the runs are not to be used.")
@click.option("--good", is_flag=True, help="Take the mark back.")
@options.as_json
def command(inputs: tuple[str, ...], bad: str | None, good: bool, as_json: bool) -> None:
    """Mark runs as bad, or take the mark back.

    RUN is a run file, a pattern or a campaign's folder. The mark is kept beside the run file, which stays as it is;
    filter, export, table and everything later leave marked runs out or say so.
    """
    if good == (bad is not None):
        raise click.UsageError("Give either --bad REASON or --good", click.get_current_context())
    from dragrig.inputs import run_files
    from dragrig.rig.runfile import mark_bad, read_info, unmark

    paths = run_files(inputs)
    for path in paths:
        read_info(path)  # nothing is marked unless everything named is a run
    for path in paths:
        if bad is not None:
            mark_bad(path, bad)
        else:
            unmark(path)
    if as_json:
        result_json([{"file": path, "bad": bad} for path in paths])
    else:
        for path in paths:
            result(f"{path}  {f'bad: {bad}' if bad is not None else 'good'}")
