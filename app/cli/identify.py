"""`dragrig identify`."""

from pathlib import Path
from typing import Literal

import click

from dragrig.cli import options
from dragrig.cli.console import is_quiet, result, result_json, shown_path
from dragrig.cli.progress import Meter
from dragrig.config.errors import AnalysisError


@click.command("identify")
@click.argument("campaigns", metavar="CAMPAIGN…", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option(
    "--nominal",
    metavar="NAME|FILE",
    default="capsule",
    help="Model that is fitted: capsule (unless given), drive, or a Python file with one's own.",
)
@click.option("--model", metavar="F|NAME", default="paper", help="Friction model to count from; paper unless given.")
@click.option(
    "--wall",
    type=click.Choice(["scaled", "fitted"]),
    default="scaled",
    help="Scale the model's wall (unless given), or replace it by polynomials through the relaxations.",
)
@click.option("--specimen", metavar="NAME", help="Name or id, where the campaign holds several specimens.")
@click.option(
    "--save-model",
    metavar="FILE",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Where to write the model that the simulator loads, in place of the folder of --out.",
)
@options.workers("campaigns")
@options.out("Folder for model and pictures; identified beside the runs unless given. With --json only if given.")
@options.overwrite
@options.as_json
@options.quiet
def command(
    campaigns: tuple[Path, ...],
    nominal: str,
    model: str,
    wall: Literal["scaled", "fitted"],
    specimen: str | None,
    save_model: Path | None,
    workers: int | None,
    scheduler: str | None,
    out: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Identify a specimen from its runs: the friction model's parameters with their uncertainty.

    CAMPAIGN is a folder of run files. Prints what the runs determine and what they do not; writes the model, which
    dragrig run loads with --model, and pictures. Runs marked bad, ways back and runs that did not end as planned are
    left out. The exit code is 0 even where runs are lacking, and 2 where the fit did not converge; no model is written
    then, nor where the runs determine nothing of it.

    Several campaigns are identified side by side and told in a table, or with --json in a line each; each has its own
    folder in that of --out.
    """
    from dragrig import identifying
    from dragrig.cli.identification import identification_text
    from dragrig.cli.identified_several import identify_several, require_several
    from dragrig.identification_json import identification_table
    from dragrig.identifying_many import beside, write_files
    from dragrig.spreading import require_workers

    require_workers(workers, scheduler)
    if len(campaigns) > 1:
        options.require_one(len(campaigns), save_model=save_model)
        identify_several(
            campaigns,
            nominal=nominal,
            model=model,
            wall=wall,
            specimen=specimen,
            workers=workers,
            scheduler=scheduler,
            out=out,
            overwrite=overwrite,
            as_json=as_json,
        )
        return
    require_several(scheduler)
    [campaign] = campaigns
    with Meter("identifying", 1.0, quiet=is_quiet()) as meter:
        found = identifying.identify(
            campaign, nominal=nominal, model=model, wall=wall, specimen=specimen, progress=meter.at
        )
    if not as_json:
        result(identification_text(found.result))
    written: list[Path] = []
    if save_model is not None:
        written.append(identifying.save_model(found, save_model, overwrite=overwrite))
    if out is not None or not as_json:
        with_model = save_model is None and found.why_no_model is None
        written += write_files(found, out or beside(campaign), with_model=with_model, overwrite=overwrite)
    if as_json:
        result_json({**identification_table(found.result), "files": written})
    else:
        for path in written:
            result(shown_path(path))
    if found.result.joint is not None and not found.result.joint.converged:
        raise AnalysisError(f"{campaign}: {found.why_no_model}.")
