"""`dragrig gap isolability`."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Unpack

import click

from dragrig.cli import options
from dragrig.cli.console import is_quiet, result, result_json, shown_path
from dragrig.cli.progress import Meter

if TYPE_CHECKING:
    from rich.console import RenderableType

    from dragrig.analysis.gap.isolability.results import Isolability

MOST_PAIRS = 20
"""So many pairs are told; the others are in the JSON."""


@click.command("isolability")
@click.argument("source", metavar="PLAN|CAMPAIGN")
@click.option("--without", metavar="EFFECT", multiple=True, help="Leave an effect out of the catalogue; repeatable.")
@click.option(
    "--report", metavar="FILE.html", type=click.Path(path_type=Path), help="Where to write the page, one HTML file."
)
@options.settings
@options.overwrite
@options.as_json
@options.quiet
def command(
    source: str,
    without: tuple[str, ...],
    report: Path | None,
    overwrite: bool,
    as_json: bool,
    **settings: Unpack[options.SettingsOptions],
) -> None:
    """Say which effects runs can tell apart, and how small a one they would show.

    PLAN, a file or a shipped name, is looked at before any run, by runs that the simulated rig makes of it without any
    effect. CAMPAIGN is a folder of run files. Every two effects have an angle between what they can do to the force,
    nuisances taken out: sin² of 0 means that they cannot be told apart at all, 1 that neither resembles the other. d′
    is how many standard deviations of noise stand between them at their usual size.
    """
    from dragrig import isolating
    from dragrig.cli.gap.printing import show
    from dragrig.isolability_json import isolability_document
    from dragrig.reports.files import require_room, write_text

    if report is not None:
        require_room(report, overwrite=overwrite)
    with Meter("looking", 1.0, quiet=is_quiet()) as meter:
        found = isolating.isolability(source, without=without, progress=meter.at, **settings)
    if as_json:
        result_json(isolability_document(found))
    else:
        show(_parts(found))
    if report is not None:
        from dragrig.reports.isolability.page import page

        write_text(page(found), report, overwrite=overwrite)
        if not as_json:
            result(f"report  {shown_path(report)}")


def _parts(found: "Isolability") -> "Iterator[RenderableType]":
    from dragrig.analysis.gap.isolability.sentences import isolability_sentences, least_in_words
    from dragrig.analysis.gap.sentences import name_of, sentence
    from dragrig.cli.gap.printing import table

    yield "\n".join(isolability_sentences(found))
    header = ("effect", "seen in", "d′, usual size", "usual", "smallest seen", "as mN")
    rows = [
        (
            one.effect,
            one.channel,
            f"{one.d_prime:.0f}",
            f"{one.usual:g}",
            least_in_words(one),
            "" if one.least_mN is None else f"{one.least_mN:.2g}",
        )
        for one in found.effects
    ]
    yield table("How clearly each is seen, near ones together", header, rows, (2, 3, 4, 5))
    pairs = found.pairs[:MOST_PAIRS]
    title = f"The closest pairs, {len(pairs)} of {len(found.pairs)}"
    names = ("", "", "sin²", "first by second", "second by first", "d′", "")
    told = [
        (
            name_of(one.effects[0]),
            name_of(one.effects[1]),
            f"{one.sin2:.2f}",
            *(f"{each:.2f}" for each in one.typical_sin2),
            f"{one.separation:.0f}",
            "hardly told apart" if one.confused else "",
        )
        for one in pairs
    ]
    yield table(title, names, told, (2, 3, 4, 5))
    yield "\n".join(f"! {sentence(one)}" for one in found.remarks)
