"""`dragrig identify`."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from dragrig.cli import options
from dragrig.cli.console import is_quiet, result, result_json, shown_path
from dragrig.cli.progress import Meter
from dragrig.config.errors import AnalysisError

if TYPE_CHECKING:
    from dragrig.identifying import IdentifiedCampaign


@click.command("identify")
@click.argument("campaign", type=click.Path(path_type=Path))
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
@options.out("Folder for model and pictures; identified beside the runs unless given. With --json only if given.")
@options.overwrite
@options.as_json
@options.quiet
def command(
    campaign: Path,
    nominal: str,
    model: str,
    wall: Literal["scaled", "fitted"],
    specimen: str | None,
    save_model: Path | None,
    out: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Identify a specimen from its runs: the friction model's parameters with their uncertainty.

    CAMPAIGN is a folder of run files. Prints what the runs determine and what they do not; writes the model, which
    dragrig run loads with --model, and pictures. Runs marked bad, ways back and runs that did not end as planned are
    left out. The exit code is 0 even where runs are lacking, and 2 where the fit did not converge; no model is written
    then, nor where the runs determine nothing of it.
    """
    from dragrig import identifying
    from dragrig.cli.identification import identification_text
    from dragrig.identification_json import identification_table

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
        written += _write(found, out or _beside(campaign), with_model=with_model, overwrite=overwrite)
    if as_json:
        result_json({**identification_table(found.result), "files": written})
    else:
        for path in written:
            result(shown_path(path))
    if found.result.joint is not None and not found.result.joint.converged:
        raise AnalysisError(f"{campaign}: {found.why_no_model}.")


def _write(found: "IdentifiedCampaign", folder: Path, *, with_model: bool, overwrite: bool) -> list[Path]:
    from dragrig import identifying

    written = []
    if with_model:
        name = "model.toml" if found.nominal.name == "capsule" else f"{found.nominal.name}.toml"
        path = options.made_folder(folder) / name
        written.append(identifying.save_model(found, path, overwrite=overwrite))
    written += identifying.pictures(found, folder, overwrite=overwrite)
    return written


def _beside(campaign: Path) -> Path:
    """Return a new folder for what was identified; measured data often lie where nothing may be added."""
    first = campaign / "identified" if os.access(campaign, os.W_OK) else Path(f"{campaign.resolve().name}-identified")
    folder, number = first, 1
    while folder.exists():
        number += 1
        folder = first.with_name(f"{first.name}-{number}")
    return folder
