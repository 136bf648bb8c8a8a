"""Commands that move the stage by hand or calibrate: home, jog, touch-off, calibrate."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Unpack

import click

from dragrig.cli import options
from dragrig.cli import options as by_hand
from dragrig.cli.console import print_json, print_remark, print_result
from dragrig.present.numbers import text_columns

if TYPE_CHECKING:
    from dragrig.api.stage import EncoderCalibration, ForceCalibration


@click.command("home")
@by_hand.override_limit
@options.rig
@options.pace
@by_hand.yes
@options.as_json
@options.quiet
def home_command(
    override: str | None, pace: options.Pace | None, yes: bool, as_json: bool, **rig: Unpack[options.RigOptions]
) -> None:
    """Find the stage's origin; says before what will move, and asks.

    Prints where the stage then is.
    """
    import dragrig as api
    from dragrig.cli.operator import TerminalOperator

    with TerminalOperator(yes=yes) as person:
        by_hand.print_move(
            api.home(override=by_hand.limit_side(override), pace=pace, person=person, **rig), as_json=as_json
        )


@click.command("jog", context_settings={"ignore_unknown_options": True})
@click.argument("distance_mm", metavar="MM", type=float)
@click.option("--speed", "speed_mm_s", metavar="MM/S", type=float, help="10 unless given; 2 off a limit switch.")
@by_hand.override_limit
@options.rig
@options.pace
@by_hand.yes
@options.as_json
@options.quiet
def jog_command(
    distance_mm: float,
    speed_mm_s: float | None,
    override: str | None,
    pace: options.Pace | None,
    yes: bool,
    as_json: bool,
    **rig: Unpack[options.RigOptions],
) -> None:
    """Move the stage by MM, as 5 or -2.5; says before from where to where, and asks.

    Guarded as a run is, and not recorded. Prints where the stage then is.
    """
    import dragrig as api
    from dragrig.cli.operator import TerminalOperator

    with TerminalOperator(yes=yes) as person:
        moved = api.jog(distance_mm, speed_mm_s, override=by_hand.limit_side(override), pace=pace, person=person, **rig)
    by_hand.print_move(moved, as_json=as_json)


@click.command("touch-off")
@click.option("--force", "force_mN", metavar="MN", type=float, default=20.0, show_default=True, help="Change sought.")
@click.option("--speed", "speed_mm_s", metavar="MM/S", type=float, default=1.0, show_default=True, help="Of the way.")
@click.option(
    "--most",
    "most_mm",
    metavar="MM",
    type=float,
    default=20.0,
    show_default=True,
    help="Go so far at most; negative goes down.",
)
@click.option("--back", "back_mm", metavar="MM", type=float, default=0.0, show_default=True, help="Go back by so much.")
@click.option("--operator", metavar="NAME", default="", help="Who is at the rig; kept with the contact.")
@options.rig
@options.pace
@by_hand.yes
@options.as_json
@options.quiet
def touch_off_command(
    force_mN: float,
    speed_mm_s: float,
    most_mm: float,
    back_mm: float,
    operator: str,
    pace: options.Pace | None,
    yes: bool,
    as_json: bool,
    **rig: Unpack[options.RigOptions],
) -> None:
    """Approach slowly until the force has changed against its value at rest; says before how far, and asks.

    The contact is kept in the lab folder. With stage.start_from = "contact" in the rig settings, start_mm of plans
    counts from it; limits stay absolute.
    """
    import dragrig as api
    from dragrig.cli.operator import TerminalOperator

    with TerminalOperator(yes=yes) as person:
        found = api.touch_off(
            most_mm,
            force_mN=force_mN,
            speed_mm_s=speed_mm_s,
            back_mm=back_mm,
            operator=operator,
            pace=pace,
            person=person,
            **rig,
        )
    if as_json:
        print_json(found.model_dump())
    else:
        print_result(f"contact at {found.position_mm:.3f} mm, where the force changed by {found.force_mN:.1f} mN")
        print_remark("Kept as contact.toml in the lab folder.")


@click.group("calibrate", invoke_without_command=True)
@click.pass_context
def calibrate_group(ctx: click.Context) -> None:
    """Calibrate force sensor or encoder; the result is added to the lab's history and holds from then on."""
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


def _parse_numbers(context: click.Context, parameter: click.Parameter, value: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in value.split(","))
    except ValueError:
        said = f"{value!r} is no list of numbers, as 0,20,50,100"
        raise click.BadParameter(said, context, parameter) from None


@calibrate_group.command("force")
@click.option(
    "--weights", metavar="G,G,…", required=True, callback=_parse_numbers, help="Grams to hang on, 0 for nothing."
)
@click.option("--repeats", metavar="N", type=int, default=1, show_default=True, help="How often, up and down in turns.")
@click.option("--seconds", metavar="S", type=float, default=2.0, show_default=True, help="How long each is read.")
@click.option("--operator", metavar="NAME", default="", help="Who is at the rig; kept with the result.")
@click.option("--note", metavar="TEXT", default="", help="Kept with the result.")
@options.rig
@options.pace
@by_hand.yes
@options.as_json
@options.quiet
def calibrate_force_command(
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
    import dragrig as api
    from dragrig.cli.operator import TerminalOperator

    with TerminalOperator(yes=yes) as person:
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
        print_json({"entry": made.entry.model_dump(), "points": made.points, "notes": made.notes})
        return
    _print_points(_force_point_table(made), made.notes)
    print_result(
        f"gain {made.line.gain:.6g} ± {made.line.gain_error:.2g} mN/V, zero {made.line.zero:.2f} ± "
        f"{made.line.zero_error:.2f} mN, residual {made.line.residual:.2f} mN; kept as {made.entry.id}"
    )


@calibrate_group.command("encoder")
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
def calibrate_encoder_command(
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
    import dragrig as api
    from dragrig.cli.operator import TerminalOperator

    with TerminalOperator(yes=yes) as person:
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
        print_json({"entry": made.entry.model_dump(), "points": made.points, "notes": made.notes})
        return
    _print_points(_encoder_point_table(made), made.notes)
    print_result(
        f"a count is {1e3 * made.line.gain:.6g} ± {1e3 * made.line.gain_error:.2g} µm, residual "
        f"{1e3 * made.line.residual:.2g} µm; kept as {made.entry.id}"
    )


def _print_points(points: str, notes: Sequence[str]) -> None:
    print_result(points)
    for note in notes:
        print_result(f"NOTE {note}")


def _force_point_table(made: "ForceCalibration") -> str:
    header = ("weight g", "load mN", "reading V", "noise mV", "off the line mN")
    return text_columns(
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


def _encoder_point_table(made: "EncoderCalibration") -> str:
    header = ("travel mm", "counts", "off the line µm")
    return text_columns(
        header,
        (
            (f"{one.travel_mm:g}", f"{one.counts:.0f}", f"{1e3 * (one.travel_mm - made.line.at(one.counts)):+.1f}")
            for one in made.points
        ),
    )
