"""Commands on the friction model: model (what it predicts), paper (the published programme)."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.console import ProgressMeter, display_path, is_quiet, print_json, print_remark, print_result
from dragrig.present.numbers import text_columns

if TYPE_CHECKING:
    from dragrig.api.report import PaperReport, PaperViscous, PaperWall
    from dragrig.config.friction_model import FrictionModelSettings
    from dragrig.sim_backend.friction import SteadyForces


PAPER_SPEEDS = "0.5,1,2,5,10,15,20,30,40,50,60"
"""The speeds of the paper's programme."""


def _parse_speeds(context: click.Context, parameter: click.Parameter, text: str) -> tuple[float, ...]:
    del context, parameter
    try:
        speeds = tuple(float(one) for one in text.split(",") if one.strip())
    except ValueError:
        raise click.BadParameter(f"{text} is no list of numbers; write speeds in mm/s as 0.5,1,2") from None
    if not speeds or not all(math.isfinite(one) and one > 0 for one in speeds):
        raise click.BadParameter(f"{text} holds no speed, or one that is not above 0 mm/s; write speeds as 0.5,1,2")
    return speeds


@click.command("model")
@click.option(
    "--speeds",
    metavar="V,V,…",
    default=PAPER_SPEEDS,
    callback=_parse_speeds,
    help="Speeds [mm/s]; the paper's if none.",
)
@click.option("--wall", type=click.Choice(["eq14", "table1"]), help="Wall parameters, in place of the model's own.")
@click.option(
    "--viscous", type=click.Choice(["published", "newtonian"]), help="Reading of Eq. 10, in place of the model's own."
)
@click.option("--model", "name", metavar="F|NAME", default="paper", help="Friction model; paper unless given.")
@options.effects("What the simulated rig has beside it, as dragrig gap effects lists it; repeatable.")
@click.option("--capsule", metavar="F|NAME", default="drag", help="Capsule; the drag test's unless given.")
@click.option("--specimen", metavar="F|NAME", default="jejunum", help="Specimen; jejunum unless given.")
@options.out("Folder for the pictures; the working folder unless given. With --json they are drawn only if given.")
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
    """Print and draw what the friction model says of steady sliding.

    A table of the environmental resistance f_e, the viscous friction f_v, the Coulomb friction f_c and their sum;
    pictures of them against speed, of the skew resistance along the capsule, and of the wall parameters; and where
    the paper's Eq. 14 and Table 1 disagree. What effects add on the last half of a drag of 40 mm is a column of its
    own, which the pictures do not show.
    """
    import numpy as np

    from dragrig.config.settings import find_settings
    from dragrig.config.specimen import Capsule, Specimen
    from dragrig.sim_backend.friction import steady_forces

    model = _load_model(name, wall, viscous, effects)
    body = find_settings(Capsule, "capsule", capsule)
    thickness = find_settings(Specimen, "specimen", specimen).wall_thickness_mm
    rows = _steady_rows(steady_forces(speeds, model, body, thickness))
    if model.effects:
        from dragrig.sim_backend.devices.simulated_sampler import steady_effect_forces

        rows = _add_effects(rows, steady_effect_forces(np.array(speeds), model, body, thickness).tolist())
    if as_json:
        print_json(rows)
    else:
        print_result(_steady_table(rows))
        print_result(f"\n{_wall_disagreement(model)}\n")
    tell = print_remark if as_json else print_result
    if out is not None or not as_json:
        from dragrig.present.figure_files import save_figure_in
        from dragrig.present.friction_model import forces_figure, skew_figure, wall_figure

        pictures = {
            "model-forces.png": forces_figure(model, body, thickness, speeds),
            "model-skew.png": skew_figure(model, body, thickness, speeds),
            "model-wall.png": wall_figure(),
        }
        for file_name, figure in pictures.items():
            tell(str(save_figure_in(out or Path(), file_name, figure, overwrite=overwrite)))


def _load_model(name: str, wall: str | None, viscous: str | None, effects: tuple[str, ...]) -> "FrictionModelSettings":
    from dragrig.config.friction_model import FrictionModelSettings
    from dragrig.config.settings import find_settings, parse
    from dragrig.setup import with_effects

    model = find_settings(FrictionModelSettings, "model", name)
    changes = {key: value for key, value in (("wall", wall), ("viscous", viscous)) if value is not None}
    changed = parse(FrictionModelSettings, model.model_dump() | changes, name) if changes else model
    return with_effects(changed, effects)


def _steady_rows(forces: "SteadyForces") -> list[dict[str, float]]:
    names = ("speed_mm_s", "f_e_mN", "f_v_mN", "f_c_mN", "total_mN")
    values = zip(forces.speed_mm_s, forces.f_e, forces.f_v, forces.f_c, forces.total, strict=True)
    return [dict(zip(names, map(float, row), strict=True)) for row in values]


def _add_effects(rows: list[dict[str, float]], effects_mN: list[float]) -> list[dict[str, float]]:
    return [
        {**dict(list(row.items())[:-1]), "effects_mN": added, "total_mN": row["total_mN"] + added}
        for row, added in zip(rows, effects_mN, strict=True)
    ]


def _steady_table(rows: list[dict[str, float]]) -> str:
    header = ("speed mm/s", *(key.replace("_mN", " mN") for key in list(rows[0])[1:]))
    return text_columns(
        header, [(f"{row['speed_mm_s']:g}", *(f"{row[key]:.2f}" for key in list(row)[1:])) for row in rows]
    )


def _wall_disagreement(model: "FrictionModelSettings") -> str:
    from dragrig.present.friction_model import WALL_UNITS, percent_text
    from dragrig.sim_backend.friction import parameter_set_differences

    used = {"eq14": "Eq. 14", "table1": "the quadratic through Table 1", "polynomial": "the model's own polynomials"}
    rows = [
        (
            one.parameter.replace("eta", "η"),
            WALL_UNITS[one.parameter],
            f"{100 * one.strain:g} %",
            f"{one.table1:g}",
            f"{one.eq14:.4g}",
            percent_text(one.eq14_difference),
            f"{one.quadratic:.4g}",
            percent_text(one.quadratic_difference),
        )
        for one in sorted(parameter_set_differences(), key=lambda one: list(WALL_UNITS).index(one.parameter))
    ]
    return "\n".join(
        (
            "Eq. 14 (wall eq14) is not what Table 1 says; a least-squares quadratic through Table 1 (wall table1) is",
            f"closer. Differences are from Table 1. The table above uses {used[model.wall]}.",
            text_columns(("", "", "strain", "Table 1", "Eq. 14", "differs", "quadratic", "differs"), rows),
        )
    )


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
def paper_command(
    out: Path, seed: int | None, wall: "PaperWall", viscous: "PaperViscous", overwrite: bool, as_json: bool
) -> None:
    """Simulate the paper's programme, identify it, and write a report.

    Relaxations at four strains, the Coulomb test, blanks, and drags at 11 speeds twice, all simulated. The report is
    one HTML file with its figures inside: Table 1 beside Eq. 14 and what is identified, Figs. 7, 8, 9 and 11, all
    parameters from all runs at once, and what in the paper does not fit together, with numbers. Its tables are written
    as CSV too, and the identified model as model.toml, which dragrig run loads with --model.
    """
    from dragrig.api.report import PAPER_SEED, paper

    chosen = PAPER_SEED if seed is None else seed
    with ProgressMeter("simulating, identifying, drawing", 1.0, quiet=is_quiet()) as meter:
        made = paper(out, seed=chosen, wall=wall, viscous=viscous, overwrite=overwrite, progress=meter.at)
    if as_json:
        print_json(_paper_json(made))
        return
    print_remark(f"{len(made.runs)} runs, {len(made.tables)} tables, {len(made.findings)} findings")
    print_result(f"report  {display_path(made.report)}\nfolder  {display_path(made.folder)}")
    if made.model is not None:
        print_result(f"model   {display_path(made.model)}")
        path = display_path(made.model)
        quoted = f'"{path}"' if " " in path else path
        print_remark(f"a dry run of this specimen: dragrig run drag --model {quoted}")


def _paper_json(made: "PaperReport") -> dict[str, object]:
    from dragrig.present.identification import identification_json

    return {
        "folder": made.folder,
        "report": made.report,
        "model": made.model,
        "tables": made.tables,
        "runs": made.runs,
        "identification": identification_json(made.identification),
        "findings": made.findings,
    }
