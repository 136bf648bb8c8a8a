"""Commands on the friction model: model (its predictions), robot, identify (parameters from runs), paper."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from dragrig.cli import options
from dragrig.cli.console import (
    ProgressMeter,
    display_path,
    echo,
    print_document,
    print_json,
    print_remark,
    print_written,
    write_report,
)
from dragrig.cli.options import NUMBER
from dragrig.config import AnalysisError, SettingsError

if TYPE_CHECKING:
    from dragrig.api import FitChoices, IdentifiedFolder, PaperViscous, PaperWall
    from dragrig.config import FrictionModelSettings, RobotDrive
    from dragrig.rig import Campaign


IDENTIFY_COST, PAGE_COST = 7, 10
"""User CPU time [s] of identifying a campaign of 58 runs, and of its pictures, or its page."""
PAPER_SPEEDS = "0.5,1,2,5,10,15,20,30,40,50,60"
"""The speeds of the paper's programme."""


def _parse_speeds(context: click.Context, parameter: click.Parameter, text: str) -> tuple[float, ...]:
    speeds = options.numbers(context, parameter, text)
    if not all(speed > 0 for speed in speeds):
        raise click.BadParameter(f"{text} holds a speed that is not above 0 mm/s; write speeds as 0.5,1,2")
    return speeds


@click.command("model")
@click.option(
    "--speeds",
    metavar="V,V,…",
    default=PAPER_SPEEDS,
    callback=_parse_speeds,
    help="Speeds [mm/s] (default: the paper's).",
)
@click.option("--wall", type=click.Choice(["eq14", "table1"]), help="Wall parameters, in place of the model's own.")
@click.option(
    "--viscous", type=click.Choice(["published", "newtonian"]), help="Reading of Eq. 10, in place of the model's own."
)
@click.option("--model", "name", metavar="F|NAME", default="paper", show_default=True, help="Friction model.")
@options.effects("Add an effect to the model, as listed by dragrig gap effects; repeatable.")
@click.option("--capsule", metavar="F|NAME", default="drag", show_default=True, help="Capsule.")
@click.option("--specimen", metavar="F|NAME", default="jejunum", show_default=True, help="Specimen.")
@options.out("Folder for the pictures (default: the working folder; with --json: none).")
@options.picture_form
@options.overwrite
@options.as_json
@options.quiet
def model_command(
    speeds: tuple[float, ...],
    wall: str | None,
    viscous: str | None,
    name: str,
    effects: tuple[str, ...],
    capsule: str,
    specimen: str,
    out: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Print and draw the steady forces that the friction model predicts.

    A table of the environmental resistance f_e, the viscous friction f_v, the Coulomb friction f_c and their sum;
    pictures of them against speed, of the skew resistance along the capsule, and of the wall parameters; and where the
    paper's Eq. 14 and Table 1 disagree. The force added by effects, on the last half of a drag of 40 mm, is a column of
    its own, which the pictures do not show.
    """
    from dragrig.api import model as steady_forces
    from dragrig.config import Capsule, Specimen, find_settings
    from dragrig.present import model_document, save_figures

    settings = _load_model(name, wall, viscous, effects)
    frame = steady_forces(speeds, model=settings, capsule=capsule, specimen=specimen)
    rows = [{str(column): float(value) for column, value in row.items()} for row in frame.to_dict("records")]
    body = find_settings(Capsule, "capsule", capsule)
    thickness_mm = find_settings(Specimen, "specimen", specimen).wall_thickness_mm
    document = model_document(rows, settings, body, thickness_mm)
    # Written before anything is printed: a reader such as head ends the command.
    written = (
        tuple(save_figures(document, out or Path(), overwrite=overwrite)) if out is not None or not as_json else ()
    )
    if as_json:
        print_json(rows)
    else:
        print_document(document, as_json=False)
    for path in written:
        (print_remark if as_json else echo)(str(path))


def _load_model(name: str, wall: str | None, viscous: str | None, effects: tuple[str, ...]) -> "FrictionModelSettings":
    from dragrig.config import FrictionModelSettings, find_settings, parse
    from dragrig.setup import with_effects

    model = find_settings(FrictionModelSettings, "model", name)
    changes = {key: value for key, value in (("wall", wall), ("viscous", viscous)) if value is not None}
    changed = parse(FrictionModelSettings, model.model_dump() | changes, name) if changes else model
    return with_effects(changed, effects)


@click.command("robot")
@click.option("--robot", "name", metavar="F|NAME", default="capsubot", show_default=True, help="Robot.")
@click.option("--model", metavar="F|NAME", default="paper", show_default=True, help="Friction model, amended or not.")
@options.effects("Add an effect to the model, as listed by dragrig gap effects, and price it; repeatable.")
@click.option("--specimen", metavar="F|NAME", default="jejunum", show_default=True, help="Specimen.")
@click.option("--diagnosis", metavar="CAMPAIGN|F", help="Campaign, or amended model's file, whose effects are priced.")
@click.option("--slow", metavar="MM/S²", type=NUMBER, help="Simulate this drive: acceleration of the slow phases.")
@click.option("--fast", metavar="MM/S²", type=NUMBER, help="Acceleration of the fast phases.")
@click.option("--stroke", metavar="MM", type=NUMBER, help="Stroke of the inner mass.")
@click.option("--pause", metavar="S", type=NUMBER, default=0.0, help="Rest at the end of a period (default: 0).")
@click.option(
    "--assumptions", is_flag=True, help="Vary what is assumed of the robot over its ranges too; takes a minute more."
)
@click.option("--seed", metavar="N", type=click.IntRange(min=0), default=1, show_default=True, help="Of the search.")
@options.report
@options.figures
@options.overwrite
@options.as_json
@options.quiet
def robot_command(
    name: str,
    model: str,
    effects: tuple[str, ...],
    specimen: str,
    diagnosis: str | None,
    slow: float | None,
    fast: float | None,
    stroke: float | None,
    pause: float,
    assumptions: bool,
    seed: int,
    report: Path | None,
    figures: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Simulate a capsule robot with an inner mass, and choose its drive for the gut.

    The inner mass is pushed slowly and thrown back fast; the housing sticks, then slips. Without --slow, --fast and
    --stroke, the drives that are fastest on a hard surface and in the gut are sought within the actuator's limits. The
    price of an effect is the speed that it takes.
    """
    from dragrig.api import robot as study
    from dragrig.present import robot_document, save_figures

    drive = _robot_drive(slow, fast, stroke, pause)
    if drive is not None and assumptions:
        raise SettingsError("--assumptions seeks the drives anew; leave out --slow, --fast, --stroke and --pause.")
    with ProgressMeter("walking") as meter:
        document = robot_document(
            study(
                name,
                model=model,
                effects=effects,
                specimen=specimen,
                drive=drive,
                diagnosis=diagnosis,
                sensitivity=assumptions,
                seed=seed,
                progress=meter.at,
            )
        )
    # Written before anything is printed: a reader such as head ends the command.
    write_report(document, report, overwrite=overwrite)
    written = [] if report is None else [report]
    if figures is not None:
        written += save_figures(document, options.make_folder(figures), overwrite=overwrite)
    print_document(document, as_json=as_json)
    for path in written:
        (print_remark if as_json else echo)(display_path(path))


def _robot_drive(slow: float | None, fast: float | None, stroke: float | None, pause: float) -> "RobotDrive | None":
    given = {"slow_mm_s2": slow, "fast_mm_s2": fast, "stroke_mm": stroke}
    if all(value is None for value in given.values()):
        if pause:
            raise SettingsError("--pause belongs to a drive; give --slow, --fast and --stroke too.")
        return None
    missing = ["--" + key.split("_")[0] for key, value in given.items() if value is None]
    if missing:
        raise SettingsError(f"A drive needs --slow, --fast and --stroke; add {' and '.join(missing)}.")
    from dragrig.config import RobotDrive, parse

    return parse(RobotDrive, {**given, "pause_s": pause}, "the drive")


@click.command("paper")
@options.out("Folder for runs, report and tables.", default="paper")
@click.option("--seed", metavar="N", type=int, help="Seed of the simulated runs (default: 20120509).")
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
def paper_command(
    out: Path, seed: int | None, wall: "PaperWall", viscous: "PaperViscous", overwrite: bool, as_json: bool
) -> None:
    """Simulate the paper's programme, identify it, and write a report.

    Relaxations at four strains, the Coulomb test, blanks, and drags at 11 speeds twice, all simulated. The report is
    one HTML file with its figures inside: Table 1 beside Eq. 14 and the identified parameters, Figs. 7, 8, 9 and 11,
    the joint fit, and inconsistencies of the paper with numbers. Its tables are written as CSV too,
    and the identified model as model.toml, which dragrig run loads with --model.
    """
    from dragrig.api import PAPER_SEED, paper

    with ProgressMeter("simulating, identifying, drawing") as meter:
        made = paper(
            out,
            seed=PAPER_SEED if seed is None else seed,
            wall=wall,
            viscous=viscous,
            overwrite=overwrite,
            progress=meter.at,
        )
    if as_json:
        from dragrig.present import attributes_json, identification_json

        print_json(
            {
                **attributes_json(made, "folder", "report", "model", "tables", "runs"),
                "identification": identification_json(made.identification),
                "findings": made.findings,
            }
        )
        return
    print_remark(f"{len(made.runs)} runs, {len(made.tables)} tables, {len(made.findings)} findings")
    echo(f"report  {display_path(made.report)}\nfolder  {display_path(made.folder)}")
    if made.model is not None:
        path = display_path(made.model)
        echo(f"model   {path}")
        quoted = f'"{path}"' if " " in path else path
        print_remark(f"a dry run of this specimen: dragrig run drag --model {quoted}")


@click.command("identify")
@options.campaigns
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
@click.option(
    "--together", is_flag=True, help="Specimens of one rig as a population: mean, spread, the range of the next one."
)
@options.workers("campaigns")
@options.out("Folder for model and pictures (default: identified in the campaign; with --json: none).")
@options.report
@options.picture_form
@options.overwrite
@options.as_json
@options.quiet
def identify_command(
    campaigns: tuple[Path, ...],
    listing: "Campaign | None",
    nominal: str,
    model: str,
    wall: Literal["scaled", "fitted"],
    specimen: str | None,
    save_model: Path | None,
    together: bool,
    workers: int | None,
    scheduler: str | None,
    out: Path | None,
    report: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Identify a specimen from its runs: the friction model's parameters with their uncertainty.

    CAMPAIGN is a folder of run files (default: the newest), or run files of one. Prints which parameters the runs
    determine and which they do not; writes the model, which dragrig run loads with --model, and pictures. Runs marked
    bad, return strokes and runs that did not end
    as planned are left out. The exit code is 0 even where runs are missing, and 2 where the fit did not converge; no
    model is written then, nor where the runs determine none of its parameters.

    Several campaigns are identified in parallel and printed as a table, or with --json as one line each; each has its
    own folder in that of --out. With --together they are one population: parameters of the rig have one value for all,
    those of specimens a mean and a spread between them; a run that lies in several campaigns counts once.
    """
    from dragrig.analysis import parts_of
    from dragrig.api import (
        identified_folder,
        identify,
        identify_many,
        identify_together,
        save_identified_model,
        write_identified_files,
    )
    from dragrig.parallel import worker_count
    from dragrig.present import identification_document, identification_json, population_document

    worker_count(workers, scheduler)
    choices: FitChoices = {"nominal": nominal, "model": model, "wall": wall, "specimen": specimen}
    if together:
        if named := [name for name, path in (("--save-model", save_model), ("--out", out)) if path is not None]:
            raise SettingsError(f"{' '.join(named)}: a population has no model of its own to write; leave it out.")
        with ProgressMeter(f"identifying {len(campaigns)} campaigns") as meter:
            fitting, reporting = parts_of(meter.at, IDENTIFY_COST * len(campaigns), PAGE_COST * (report is not None))
            population = identify_together(campaigns, **choices, workers=workers, scheduler=scheduler, progress=fitting)
            document = population_document(population)
            write_report(document, report, *campaigns, overwrite=overwrite, progress=reporting)
        print_document(document, as_json=as_json)
        print_written(as_json=as_json, report=report)
        return
    if len(campaigns) > 1:
        options.require_single_campaign(len(campaigns), save_model=save_model, report=report)
        with ProgressMeter(f"identifying {len(campaigns)} campaigns") as meter:
            several = identify_many(
                campaigns,
                **choices,
                write=out is not None or not as_json,
                out=out,
                overwrite=overwrite,
                workers=workers,
                scheduler=scheduler,
                progress=meter.at,
            )
        _print_identifications(several, as_json=as_json)
        return
    [campaign] = campaigns
    if scheduler is not None:
        raise SettingsError(f"--scheduler {scheduler}: is for several campaigns, and one was given; leave it out.")
    draws = out is not None or not as_json
    with ProgressMeter("identifying") as meter:
        fitting, reporting, drawing = parts_of(
            meter.at, IDENTIFY_COST, PAGE_COST * (report is not None), PAGE_COST * draws
        )
        identified = identify(listing or campaign, **choices, progress=fitting)
        result = identified.result
        # Written before anything is printed: a reader such as head ends the command.
        document = identification_document(result)
        write_report(document, report, campaign, overwrite=overwrite, progress=reporting)
        written: list[Path] = [] if report is None else [report]
        if save_model is not None:
            written.append(save_identified_model(identified, save_model, overwrite=overwrite))
        if draws:
            with_model = save_model is None and identified.why_no_model is None
            folder = out or identified_folder(campaign)
            written += write_identified_files(
                identified, folder, with_model=with_model, overwrite=overwrite, progress=drawing
            )
    if as_json:
        print_json({**identification_json(result), "files": written})
    else:
        print_document(document, as_json=False)
        for path in written:
            echo(display_path(path))
    if result.joint is not None and not result.joint.converged:
        raise AnalysisError(f"{campaign}: {identified.why_no_model}.")


def _print_identifications(folders: "Sequence[IdentifiedFolder]", *, as_json: bool) -> None:
    """Print several campaigns as a table or lines of JSON; raises where one was not identified."""
    from dragrig.present import identification_json, identified_campaigns_document

    if as_json:
        for folder in folders:
            content = {"error": folder.why_not} if folder.result is None else identification_json(folder.result)
            print_json({"source": folder.source, **content, "files": folder.files}, indent=None)
    else:
        rows = [(folder.source, folder.result, folder.why_not) for folder in folders]
        print_document(identified_campaigns_document(rows), as_json=False)
        for path in (path for folder in folders for path in folder.files):
            echo(display_path(path))
    options.require_all_succeeded("identified", len(folders), [folder.why_not for folder in folders if folder.failed])
