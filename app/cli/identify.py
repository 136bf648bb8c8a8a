"""The command identify, for one campaign or several."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from dragrig.cli import options
from dragrig.cli.console import ProgressMeter, display_path, print_json, print_json_line, print_result
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
    from dragrig.present.identification import identification_json, identification_text

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
    if not as_json:
        print_result(identification_text(result))
    written: list[Path] = []
    if save_model is not None:
        written.append(save_identified_model(identified, save_model, overwrite=overwrite))
    if out is not None or not as_json:
        with_model = save_model is None and identified.why_no_model is None
        folder = out or identified_folder(campaign)
        written += write_identified_files(identified, folder, with_model=with_model, overwrite=overwrite)
    if as_json:
        print_json({**identification_json(result), "files": written})
    else:
        for path in written:
            print_result(display_path(path))
    if result.joint is not None and not result.joint.converged:
        raise AnalysisError(f"{campaign}: {identified.why_no_model}.")


def _print_identifications(folders: "Sequence[IdentifiedFolder]", *, as_json: bool) -> None:
    """Print several campaigns as a table or lines of JSON; raises where one was not identified."""
    from dragrig.present.identification import identification_json
    from dragrig.present.terminal import print_parts, terminal_table

    if as_json:
        for folder in folders:
            content = {"error": folder.why_not} if folder.result is None else identification_json(folder.result)
            print_json_line({"source": folder.source, **content, "files": folder.files})
    else:
        fits = [folder.result.joint for folder in folders if folder.result is not None]
        names = list(dict.fromkeys(parameter.name for fit in fits if fit is not None for parameter in fit.parameters))
        rows = [(folder.source, *_parameter_cells(folder, names)) for folder in folders]
        title = "Value ± standard error of each campaign's joint fit; - is not determined by its runs"
        print_parts([terminal_table(title, ("campaign", *names), rows, range(1, len(names) + 1))])
        for folder in folders:
            if folder.why_not:
                print_result(f"! {folder.why_not}")
            for path in folder.files:
                print_result(display_path(path))
    options.require_all_succeeded("identified", len(folders), [folder.why_not for folder in folders if folder.failed])


def _parameter_cells(folder: "IdentifiedFolder", names: Sequence[str]) -> Iterator[str]:
    from dragrig.present.document import rounded_to_error

    joint = None if folder.result is None else folder.result.joint
    determined = {}
    if joint is not None and joint.converged:
        determined = {parameter.name: parameter for parameter in joint.parameters if parameter.determined}
    for name in names:
        if name not in determined:
            yield "-"
            continue
        value, error = determined[name].value, determined[name].standard_error
        yield f"{rounded_to_error(value, error)} ± {rounded_to_error(error, error)}"
