"""The command identify, for one campaign or several."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from dragrig.cli import options
from dragrig.cli.console import ProgressMeter, display_path, print_document, print_json, print_json_line, print_result
from dragrig.config.errors import AnalysisError, SettingsError

if TYPE_CHECKING:
    from dragrig.api.identify import IdentifiedFolder


@click.command("identify")
@click.argument("campaigns", metavar="CAMPAIGN…", type=click.Path(path_type=Path), nargs=-1, required=True)
@click.option(
    "--nominal",
    metavar="NAME|FILE",
    default="capsule",
    help="Model to fit: capsule (default), drive, or a Python file with a model of your own.",
)
@click.option("--model", metavar="F|NAME", default="paper", show_default=True, help="Friction model to scale.")
@click.option(
    "--wall",
    type=click.Choice(["scaled", "fitted"]),
    default="scaled",
    help="Scale the model's wall (default), or replace it by polynomials through the relaxations.",
)
@click.option("--specimen", metavar="NAME", help="Name or id, where the campaign holds several specimens.")
@click.option(
    "--save-model",
    metavar="FILE",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write the model that the simulator loads to this file, in place of the folder of --out.",
)
@options.workers("campaigns")
@options.out("Folder for model and pictures (default: identified in the campaign; with --json: none).")
@options.overwrite
@options.as_json
@options.quiet
def identify_command(
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

    CAMPAIGN is a folder of run files. Prints which parameters the runs determine and which they do not; writes the
    model, which dragrig run loads with --model, and pictures. Runs marked bad, return strokes and runs that did not end
    as planned are left out. The exit code is 0 even where runs are missing, and 2 where the fit did not converge; no
    model is written then, nor where the runs determine none of its parameters.

    Several campaigns are identified in parallel and printed as a table, or with --json as one line each; each has its
    own folder in that of --out.
    """
    from dragrig.api.identify import (
        identified_folder,
        identify,
        identify_many,
        save_identified_model,
        write_identified_files,
    )
    from dragrig.parallel import worker_count
    from dragrig.present.identification import identification_document

    worker_count(workers, scheduler)
    if len(campaigns) > 1:
        options.require_single_campaign(len(campaigns), save_model=save_model)
        with ProgressMeter(f"identifying {len(campaigns)} campaigns") as meter:
            folders = identify_many(
                campaigns,
                nominal=nominal,
                model=model,
                wall=wall,
                specimen=specimen,
                write=out is not None or not as_json,
                out=out,
                overwrite=overwrite,
                workers=workers,
                scheduler=scheduler,
                progress=meter.at,
            )
        _print_identifications(folders, as_json=as_json)
        return
    if scheduler is not None:
        raise SettingsError(f"--scheduler {scheduler}: is for several campaigns, and one was given; leave it out.")
    [campaign] = campaigns
    with ProgressMeter("identifying") as meter:
        identified = identify(campaign, nominal=nominal, model=model, wall=wall, specimen=specimen, progress=meter.at)
    result = identified.result
    document = identification_document(result)
    if not as_json:
        print_document(document, as_json=False)
    written: list[Path] = []
    if save_model is not None:
        written.append(save_identified_model(identified, save_model, overwrite=overwrite))
    if out is not None or not as_json:
        with_model = save_model is None and identified.why_no_model is None
        folder = out or identified_folder(campaign)
        written += write_identified_files(identified, folder, with_model=with_model, overwrite=overwrite)
    if as_json:
        print_json({**document.data, "files": written})
    else:
        for path in written:
            print_result(display_path(path))
    if result.joint is not None and not result.joint.converged:
        raise AnalysisError(f"{campaign}: {identified.why_no_model}.")


def _print_identifications(folders: "Sequence[IdentifiedFolder]", *, as_json: bool) -> None:
    """Print several campaigns as a table or lines of JSON; raises where one was not identified."""
    from dragrig.present.identification import identification_json, identified_campaigns_document

    if as_json:
        for folder in folders:
            content = {"error": folder.why_not} if folder.result is None else identification_json(folder.result)
            print_json_line({"source": folder.source, **content, "files": folder.files})
    else:
        rows = [(folder.source, folder.result, folder.why_not) for folder in folders]
        print_document(identified_campaigns_document(rows), as_json=False)
        for path in (path for folder in folders for path in folder.files):
            print_result(display_path(path))
    options.require_all_succeeded("identified", len(folders), [folder.why_not for folder in folders if folder.failed])
