"""`dragrig calibrate`."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Unpack

import click

from dragrig.cli import by_hand, options
from dragrig.cli.console import result, result_json
from dragrig.cli.wording import columns

if TYPE_CHECKING:
    from dragrig.calibrating import EncoderCalibration, ForceCalibration


@click.group("calibrate", invoke_without_command=True)
@click.pass_context
def command(ctx: click.Context) -> None:
    """Calibrate force sensor or encoder; the result is added to the lab's history and holds from then on."""
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


def _numbers(context: click.Context, parameter: click.Parameter, value: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in value.split(","))
    except ValueError:
        said = f"{value!r} is no list of numbers, as 0,20,50,100"
        raise click.BadParameter(said, context, parameter) from None


@command.command("force")
@click.option("--weights", metavar="G,G,…", required=True, callback=_numbers, help="Grams to hang on, 0 for nothing.")
@click.option("--repeats", metavar="N", type=int, default=1, show_default=True, help="How often, up and down in turns.")
@click.option("--seconds", metavar="S", type=float, default=2.0, show_default=True, help="How long each is read.")
@click.option("--operator", metavar="NAME", default="", help="Who is at the rig; kept with the result.")
@click.option("--note", metavar="TEXT", default="", help="Kept with the result.")
@options.rig
@options.pace
@by_hand.yes
@options.as_json
@options.quiet
def force(
    weights: tuple[float, ...],
    repeats: int,
    seconds: float,
    operator: str,
    note: str,
    pace: options.Pace | None,
    yes: bool,
    as_json: bool,
    **rig: Unpack[options.RigOptions],
) -> None:
    """Calibrate the force sensor with known weights: asks for each, reads it, and fits a line by least squares.

    Needs at least three distinct weights. Prints the points, gain and zero with their standard errors, and the standard
    deviation of the residuals.
    """
    from dragrig import api
    from dragrig.cli.operator import Terminal

    with Terminal(yes=yes) as person:
        made = api.calibrate_force(
            weights,
            repeats=repeats,
            duration_s=seconds,
            operator=operator,
            note=note,
            pace=pace,
            person=person,
            **rig,
        )
    if as_json:
        result_json({"entry": made.entry.model_dump(), "points": made.points, "notes": made.notes})
        return
    _tell(_force_points(made), made.notes)
    result(
        f"gain {made.line.gain:.6g} ± {made.line.gain_error:.2g} mN/V, zero {made.line.zero:.2f} ± "
        f"{made.line.zero_error:.2f} mN, residual {made.line.residual:.2f} mN; kept as {made.entry.id}"
    )


@command.command("encoder")
@click.option("--travel", "travel_mm", metavar="MM", type=float, required=True, help="Way there; negative goes down.")
@click.option(
    "--measured", "measured_mm", metavar="MM", type=float, multiple=True, help="What a gauge says; repeatable."
)
@click.option("--repeats", metavar="N", type=int, default=3, show_default=True, help="How often.")
@click.option("--speed", "speed_mm_s", metavar="MM/S", type=float, default=10.0, show_default=True, help="Of the way.")
@click.option("--by-hand", is_flag=True, help="The stage is switched off, and pushed.")
@click.option("--seconds", metavar="S", type=float, default=20.0, show_default=True, help="For a push by hand.")
@click.option("--operator", metavar="NAME", default="", help="Who is at the rig; kept with the result.")
@click.option("--note", metavar="TEXT", default="", help="Kept with the result.")
@options.rig
@options.pace
@by_hand.yes
@options.as_json
@options.quiet
def encoder(
    travel_mm: float,
    measured_mm: tuple[float, ...],
    repeats: int,
    speed_mm_s: float,
    by_hand: bool,
    seconds: float,
    operator: str,
    note: str,
    pace: options.Pace | None,
    yes: bool,
    as_json: bool,
    **rig: Unpack[options.RigOptions],
) -> None:
    """Calibrate the encoder over a known travel: the stage goes there and back, and a line is fitted to the counts.

    Prints the points and the length of a count.
    """
    from dragrig import api
    from dragrig.cli.operator import Terminal

    with Terminal(yes=yes) as person:
        made = api.calibrate_encoder(
            travel_mm,
            measured_mm=measured_mm,
            repeats=repeats,
            speed_mm_s=speed_mm_s,
            by_hand=by_hand,
            duration_s=seconds,
            operator=operator,
            note=note,
            pace=pace,
            person=person,
            **rig,
        )
    if as_json:
        result_json({"entry": made.entry.model_dump(), "points": made.points, "notes": made.notes})
        return
    _tell(_encoder_points(made), made.notes)
    result(
        f"a count is {1e3 * made.line.gain:.6g} ± {1e3 * made.line.gain_error:.2g} µm, residual "
        f"{1e3 * made.line.residual:.2g} µm; kept as {made.entry.id}"
    )


def _tell(points: str, notes: Sequence[str]) -> None:
    result(points)
    for note in notes:
        result(f"NOTE {note}")


def _force_points(made: "ForceCalibration") -> str:
    header = ("weight g", "load mN", "reading V", "noise mV", "off the line mN")
    return columns(
        header,
        (
            (
                f"{one.weight_g:g}",
                f"{one.load_mN:.2f}",
                f"{one.reading.force_V:.5f}",
                f"{1e3 * one.reading.force_V_sd:.2f}",
                f"{one.load_mN - made.line.at(one.reading.force_V):+.2f}",
            )
            for one in made.points
        ),
    )


def _encoder_points(made: "EncoderCalibration") -> str:
    header = ("travel mm", "counts", "off the line µm")
    return columns(
        header,
        (
            (f"{one.travel_mm:g}", f"{one.counts:.0f}", f"{1e3 * (one.travel_mm - made.line.at(one.counts)):+.1f}")
            for one in made.points
        ),
    )
