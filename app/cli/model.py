"""`dragrig model`."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from dragrig.cli import options
from dragrig.cli.console import result, result_json, say
from dragrig.cli.wording import columns

if TYPE_CHECKING:
    from dragrig.config.model import FrictionModelSettings
    from dragrig.sim_backend.friction import SteadyForces

SPEEDS = "0.5,1,2,5,10,15,20,30,40,50,60"
"""The speeds of the paper's programme."""


def _speeds(context: click.Context, parameter: click.Parameter, text: str) -> tuple[float, ...]:
    del context, parameter
    try:
        speeds = tuple(float(one) for one in text.split(",") if one.strip())
    except ValueError:
        raise click.BadParameter(f"{text} is no list of numbers; write speeds in mm/s as 0.5,1,2") from None
    if not speeds or not all(math.isfinite(one) and one > 0 for one in speeds):
        raise click.BadParameter(f"{text} holds no speed, or one that is not above 0 mm/s; write speeds as 0.5,1,2")
    return speeds


@click.command("model")
@click.option("--speeds", metavar="V,V,…", default=SPEEDS, callback=_speeds, help="Speeds [mm/s]; the paper's if none.")
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
def command(
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

    from dragrig.config.capsule import Capsule
    from dragrig.config.library import find
    from dragrig.config.specimen import Specimen
    from dragrig.sim_backend.friction import steady_forces

    model = _model(name, wall, viscous, effects)
    body = find(Capsule, "capsule", capsule)
    thickness = find(Specimen, "specimen", specimen).wall_thickness_mm
    rows = _rows(steady_forces(speeds, model, body, thickness))
    if model.effects:
        from dragrig.sim_backend.devices.steady import steady_effects

        rows = _with(rows, steady_effects(np.array(speeds), model, body, thickness).tolist())
    if as_json:
        result_json(rows)
    else:
        result(_table(rows))
        result(f"\n{_disagreement(model)}\n")
    tell = say if as_json else result
    if out is not None or not as_json:
        from dragrig.figures import forces_figure, save_in, skew_figure, wall_figure

        pictures = {
            "model-forces.png": forces_figure(model, body, thickness, speeds),
            "model-skew.png": skew_figure(model, body, thickness, speeds),
            "model-wall.png": wall_figure(),
        }
        for file_name, figure in pictures.items():
            tell(str(save_in(out or Path(), file_name, figure, overwrite=overwrite)))


def _model(name: str, wall: str | None, viscous: str | None, effects: tuple[str, ...]) -> "FrictionModelSettings":
    from dragrig.config.library import find
    from dragrig.config.loading import parse
    from dragrig.config.model import FrictionModelSettings
    from dragrig.rigs import with_effects

    model = find(FrictionModelSettings, "model", name)
    changes = {key: value for key, value in (("wall", wall), ("viscous", viscous)) if value is not None}
    changed = parse(FrictionModelSettings, model.model_dump() | changes, name) if changes else model
    return with_effects(changed, effects)


def _rows(forces: "SteadyForces") -> list[dict[str, float]]:
    names = ("speed_mm_s", "f_e_mN", "f_v_mN", "f_c_mN", "total_mN")
    values = zip(forces.speed_mm_s, forces.f_e, forces.f_v, forces.f_c, forces.total, strict=True)
    return [dict(zip(names, map(float, row), strict=True)) for row in values]


def _with(rows: list[dict[str, float]], effects_mN: list[float]) -> list[dict[str, float]]:
    return [
        {**dict(list(row.items())[:-1]), "effects_mN": added, "total_mN": row["total_mN"] + added}
        for row, added in zip(rows, effects_mN, strict=True)
    ]


def _table(rows: list[dict[str, float]]) -> str:
    header = ("speed mm/s", *(key.replace("_mN", " mN") for key in list(rows[0])[1:]))
    return columns(header, [(f"{row['speed_mm_s']:g}", *(f"{row[key]:.2f}" for key in list(row)[1:])) for row in rows])


def _disagreement(model: "FrictionModelSettings") -> str:
    from dragrig.figures.wall import UNITS, percent
    from dragrig.sim_backend.friction import disagreement

    used = {"eq14": "Eq. 14", "table1": "the quadratic through Table 1", "polynomial": "the model's own polynomials"}
    rows = [
        (
            one.parameter.replace("eta", "η"),
            UNITS[one.parameter],
            f"{100 * one.strain:g} %",
            f"{one.table1:g}",
            f"{one.eq14:.4g}",
            percent(one.eq14_difference),
            f"{one.quadratic:.4g}",
            percent(one.quadratic_difference),
        )
        for one in sorted(disagreement(), key=lambda one: list(UNITS).index(one.parameter))
    ]
    return "\n".join(
        (
            "Eq. 14 (wall eq14) is not what Table 1 says; a least-squares quadratic through Table 1 (wall table1) is",
            f"closer. Differences are from Table 1. The table above uses {used[model.wall]}.",
            columns(("", "", "strain", "Table 1", "Eq. 14", "differs", "quadratic", "differs"), rows),
        )
    )
