"""`dragrig paper`."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.console import is_quiet, result, result_json, say, shown_path
from dragrig.cli.progress import Meter

if TYPE_CHECKING:
    from dragrig.reproducing import PaperReport, Viscous, Wall


@click.command("paper")
@click.option(
    "--out",
    "-o",
    metavar="DIR",
    default="paper",
    show_default=True,
    type=click.Path(path_type=Path),
    help="Folder for runs, report and tables.",
)
@click.option("--seed", metavar="N", type=int, help="Seed of the simulated runs; 20120509 unless given.")
@click.option(
    "--wall", type=click.Choice(["eq14", "table1"]), default="eq14", show_default=True, help="Wall parameters."
)
@click.option(
    "--viscous",
    type=click.Choice(["published", "newtonian"]),
    default="published",
    show_default=True,
    help="Reading of Eq. 10.",
)
@options.overwrite
@options.as_json
@options.quiet
def command(out: Path, seed: int | None, wall: "Wall", viscous: "Viscous", overwrite: bool, as_json: bool) -> None:
    """Simulate the paper's programme, identify it, and write a report.

    Relaxations at four strains, the Coulomb test, blanks, and drags at 11 speeds twice, all simulated. The report is
    one HTML file with its figures inside: Table 1 beside Eq. 14 and what is identified, Figs. 7, 8, 9 and 11, all
    parameters from all runs at once, and what in the paper does not fit together, with numbers. Its tables are written
    as CSV too, and the identified model as model.toml, which dragrig run loads with --model.
    """
    from dragrig.reproducing import SEED, paper

    chosen = SEED if seed is None else seed
    with Meter("simulating, identifying, drawing", 1.0, quiet=is_quiet()) as meter:
        made = paper(out, seed=chosen, wall=wall, viscous=viscous, overwrite=overwrite, progress=meter.at)
    if as_json:
        result_json(_plain(made))
        return
    say(f"{len(made.runs)} runs, {len(made.tables)} tables, {len(made.findings)} findings")
    result(f"report  {shown_path(made.report)}\nfolder  {shown_path(made.folder)}")
    if made.model is not None:
        result(f"model   {shown_path(made.model)}")
        path = shown_path(made.model)
        quoted = f'"{path}"' if " " in path else path
        say(f"a dry run of this specimen: dragrig run drag --model {quoted}")


def _plain(made: "PaperReport") -> dict[str, object]:
    from dragrig.identification_json import identification_table

    return {
        "folder": made.folder,
        "report": made.report,
        "model": made.model,
        "tables": made.tables,
        "runs": made.runs,
        "identification": identification_table(made.identification),
        "findings": made.findings,
    }
