"""`dragrig gap diagnose`."""

from pathlib import Path

import click

from dragrig.cli import options
from dragrig.cli.console import is_quiet, result, result_json, say, shown_path
from dragrig.cli.progress import Meter

FILE = click.Path(path_type=Path)


@click.command("diagnose")
@click.argument("campaigns", metavar="CAMPAIGN…", type=FILE, nargs=-1, required=True)
@click.option(
    "--nominal",
    metavar="NAME|FILE",
    default="capsule",
    help="What is expected: capsule (unless given), drive, a friction model (.toml), or one's own (.py).",
)
@click.option("--without", metavar="EFFECT", multiple=True, help="Leave an effect out of the catalogue; repeatable.")
@click.option("--tolerance", "tolerance_mN", metavar="MN", type=float, help="Gap [mN] below which nothing matters.")
@click.option("--specimen", metavar="NAME", help="Name or id, where there are several; else the most measured.")
@click.option("--calibration", metavar="FILE", help="What gap calibrate wrote; what ships unless given.")
@click.option("--save-model", metavar="FILE", type=FILE, help="Where to write the model with the effect in it.")
@click.option("--report", metavar="FILE.html", type=FILE, help="Where to write the report, one HTML file.")
@options.workers("campaigns")
@options.overwrite
@options.as_json
@options.quiet
def command(
    campaigns: tuple[Path, ...],
    nominal: str,
    without: tuple[str, ...],
    tolerance_mN: float | None,
    specimen: str | None,
    calibration: str | None,
    save_model: Path | None,
    report: Path | None,
    workers: int | None,
    scheduler: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Say where a campaign differs from the model, which effect that is, and how far it closes the gap.

    CAMPAIGN is a folder of run files; it need not be complete. Several are diagnosed side by side and told in a table,
    or with --json in a line each. Of one, this prints the verdict (an effect, several, no gap, or one that no effect of
    the catalogue explains), where the gap is, the ranking with probabilities, how far the gap closes on runs that took
    no part, and what these runs cannot answer. Runs marked bad, ways back and runs that did not end
    as planned are left out. The exit code is 0 whatever the verdict; no model is written where no effect is named.
    """
    from dragrig import diagnosing
    from dragrig.cli.gap.printing import show
    from dragrig.cli.gap.several import diagnose_several
    from dragrig.cli.gap.telling import diagnosis_parts
    from dragrig.diagnosing_many import Asked
    from dragrig.gap_json import gap_document
    from dragrig.reports.files import require_room
    from dragrig.spreading import require_workers

    require_workers(workers, scheduler)
    asked = Asked(nominal, without, tolerance_mN, specimen, calibration)
    if len(campaigns) > 1:
        options.require_one(len(campaigns), save_model=save_model, report=report)
        diagnose_several(campaigns, asked, workers=workers, scheduler=scheduler, as_json=as_json)
        return
    [campaign] = campaigns
    for path in filter(None, (save_model, report)):
        require_room(path, overwrite=overwrite)
    with Meter("diagnosing", 1.0, quiet=is_quiet()) as meter:
        found = asked.diagnosed(campaign, meter.at) if scheduler is None else asked.diagnosed_there(campaign, scheduler)
    if not as_json:
        show(diagnosis_parts(found.result))
    model = None if save_model is None else diagnosing.save_model(found.result, save_model, overwrite=overwrite)
    if save_model is not None and model is None:
        say(f"{shown_path(save_model)} is not written: the verdict gives no model")
    written = None
    if report is not None:
        written = diagnosing.save_report(found.result, report, source=found.source, model=model, overwrite=overwrite)
    if as_json:
        result_json(gap_document(found.result, model=None if model is None else str(model), run_ids=found.run_ids))
        return
    for name, made in (("model", model), ("report", written)):
        if made is not None:
            result(f"{name:8}{shown_path(made)}")
