"""`dragrig gap next`."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import click

from dragrig.cli import options
from dragrig.cli.console import is_quiet, result, result_json, say, shown_path
from dragrig.cli.progress import Meter

if TYPE_CHECKING:
    from rich.console import RenderableType

    from dragrig.analysis.gap.planning.results import NextExperiment


@click.command("next")
@click.argument("source", metavar="CAMPAIGN|PLAN")
@click.option("--between", nargs=2, metavar="EFFECT EFFECT", help="Two effects to be told apart, at their usual sizes.")
@click.option("--minutes", metavar="MIN", type=float, default=20.0, help="Rig time that the runs may take; 20.")
@click.option(
    "--save-plan", metavar="FILE.toml", type=click.Path(path_type=Path), help="Where to write the runs as a plan."
)
@options.settings
@options.overwrite
@options.as_json
@options.quiet
def command(
    source: str,
    between: tuple[str, str] | None,
    minutes: float,
    save_plan: Path | None,
    overwrite: bool,
    as_json: bool,
    **settings: Unpack[options.SettingsOptions],
) -> None:
    """Say which runs to make next: those that separate the leading hypotheses best per minute of rig time.

    CAMPAIGN, a folder of run files, is diagnosed first, and what it leaves open is to be decided. Of a PLAN the runs
    are taken as made, and the effects that they hardly tell apart are to be told apart. Runs come from a fixed grid of
    kinds, speeds, strokes, strains, rests and reversals, one after another, the best each time, as long as they help
    and the rig time lasts. What --save-plan writes, dragrig run carries out.
    """
    from dragrig import planning
    from dragrig.cli.gap.printing import show
    from dragrig.gap_json import next_document
    from dragrig.reports.files import require_room

    if save_plan is not None:
        require_room(save_plan, overwrite=overwrite)
    with Meter("searching", 1.0, quiet=is_quiet()) as meter:
        found = planning.next_experiment(source, between=between, minutes=minutes, progress=meter.at, **settings)
    if as_json:
        result_json(next_document(found))
    elif found is None:
        result("No run of the grid would separate the leading hypotheses any better.")
    else:
        show(_parts(found))
    if save_plan is None:
        return
    if found is None:
        say(f"{shown_path(save_plan)} is not written: there is no run to recommend")
        return
    planning.save_plan(found, save_plan, overwrite=overwrite)
    if not as_json:
        result(f"plan    {shown_path(save_plan)}")


def _parts(found: "NextExperiment") -> "Iterator[RenderableType]":
    from dragrig.analysis.gap.planning.words import run_in_words, what_it_does
    from dragrig.cli.gap.printing import table

    yield found.why
    rows = [(run_in_words(one.step), f"{one.minutes:.1f}", what_it_does(one.before, one.after)) for one in found.runs]
    title = f"What to run next, {found.minutes:.1f} min of rig time in all"
    yield table(title, ("", "min", "each after those above"), rows, (1,))
