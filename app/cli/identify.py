"""The command identify, for one campaign or several."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from dragrig.cli import options
from dragrig.cli.console import ProgressMeter, display_path, is_quiet, print_json, print_result
from dragrig.config.errors import AnalysisError, SettingsError
from dragrig.present.json_values import to_json_value

if TYPE_CHECKING:
    from dragrig.api.identify import IdentifiedFolder


def identify_campaigns(
    campaigns: Sequence[Path],
    *,
    nominal: str,
    model: str,
    wall: Literal["scaled", "fitted"],
    specimen: str | None,
    workers: int | None,
    scheduler: str | None,
    out: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Identify campaigns side by side and print what was found, in their order."""
    from dragrig.api.identify import identify_many

    with ProgressMeter(f"identifying {len(campaigns)} campaigns", 1.0, quiet=is_quiet()) as meter:
        found = identify_many(
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
    if as_json:
        for line in campaign_json_lines(found):
            print_result(line)
    else:
        _print_campaigns(found)
    failed = [one for one in found if one.failed]
    if failed:
        told = failed[0].why_not.rstrip(".") + (f"; and {len(failed) - 1} more" if failed[1:] else "")
        raise AnalysisError(f"{len(failed)} of {len(found)} campaigns were not identified: {told}.")


def require_several_campaigns(scheduler: str | None) -> None:
    """Raise `SettingsError` where a cluster is to share out a single campaign."""
    if scheduler is not None:
        raise SettingsError(f"--scheduler {scheduler}: shares out campaigns, and one was given; leave it out.")


def campaign_json_lines(found: "Sequence[IdentifiedFolder]") -> Iterator[str]:
    """Yield a line for each campaign: what `--json` says of one, with its folder as `source`, or an `error`."""
    from dragrig.present.identification import identification_json

    for one in found:
        told = {"error": one.why_not} if one.result is None else identification_json(one.result)
        yield json.dumps(to_json_value({"source": one.source, **told, "files": one.files}), allow_nan=False)


def _print_campaigns(found: "Sequence[IdentifiedFolder]") -> None:
    from dragrig.present.terminal import print_parts, terminal_table

    fits = [one.result.joint for one in found if one.result is not None and one.result.joint is not None]
    names = list(dict.fromkeys(parameter.name for fit in fits for parameter in fit.parameters))
    rows = [(one.source, *_campaign_cells(one, names)) for one in found]
    title = "Value ± standard error of each campaign's joint fit; - is not determined by its runs"
    print_parts([terminal_table(title, ("campaign", *names), rows, range(1, len(names) + 1))])
    for one in found:
        if one.why_not:
            print_result(f"! {one.why_not}")
        for path in one.files:
            print_result(display_path(path))


def _campaign_cells(one: "IdentifiedFolder", names: Sequence[str]) -> Iterator[str]:
    from dragrig.present.document import rounded_to_error

    joint = None if one.result is None else one.result.joint
    known = {} if joint is None else {each.name: each for each in joint.parameters if each.determined}
    for name in names:
        if name not in known or joint is None or not joint.converged:
            yield "-"
            continue
        value, error = known[name].value, known[name].standard_error
        yield f"{rounded_to_error(value, error)} ± {rounded_to_error(error, error)}"


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

    CAMPAIGN is a folder of run files. Prints what the runs determine and what they do not; writes the model, which
    dragrig run loads with --model, and pictures. Runs marked bad, ways back and runs that did not end as planned are
    left out. The exit code is 0 even where runs are lacking, and 2 where the fit did not converge; no model is written
    then, nor where the runs determine nothing of it.

    Several campaigns are identified side by side and told in a table, or with --json in a line each; each has its own
    folder in that of --out.
    """
    from dragrig.api import identify as identifying
    from dragrig.api.identify import identified_folder, write_identified_files
    from dragrig.parallel import worker_count
    from dragrig.present.identification import identification_json, identification_text

    worker_count(workers, scheduler)
    if len(campaigns) > 1:
        options.require_single_campaign(len(campaigns), save_model=save_model)
        identify_campaigns(
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
    require_several_campaigns(scheduler)
    [campaign] = campaigns
    with ProgressMeter("identifying", 1.0, quiet=is_quiet()) as meter:
        found = identifying.identify(
            campaign, nominal=nominal, model=model, wall=wall, specimen=specimen, progress=meter.at
        )
    if not as_json:
        print_result(identification_text(found.result))
    written: list[Path] = []
    if save_model is not None:
        written.append(identifying.save_identified_model(found, save_model, overwrite=overwrite))
    if out is not None or not as_json:
        with_model = save_model is None and found.why_no_model is None
        written += write_identified_files(
            found, out or identified_folder(campaign), with_model=with_model, overwrite=overwrite
        )
    if as_json:
        print_json({**identification_json(found.result), "files": written})
    else:
        for path in written:
            print_result(display_path(path))
    if found.result.joint is not None and not found.result.joint.converged:
        raise AnalysisError(f"{campaign}: {found.why_no_model}.")
