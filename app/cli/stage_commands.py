"""Commands that move the stage by hand or calibrate: home, jog, touch-off, calibrate."""

from typing import Unpack

import click

from dragrig.cli import options
from dragrig.cli.console import echo, print_document, print_json, print_remark
from dragrig.cli.options import NUMBER


@click.command("home")
@options.override_limit
@options.rig_session
def home_command(override: str | None, yes: bool, as_json: bool, **rig: "Unpack[options.StageOptions]") -> None:
    """Find the stage's origin; announces the motion and asks first. Prints the stage's position."""
    from dragrig.api import home
    from dragrig.cli.operator import TerminalOperator

    with TerminalOperator(yes=yes) as person:
        move = home(override=options.limit_side(override), person=person, **rig)
    options.print_move(move, as_json=as_json)


@click.command("jog", context_settings={"ignore_unknown_options": True})
@click.argument("distance_mm", metavar="MM", type=NUMBER)
@click.option("--speed", "speed_mm_s", metavar="MM/S", type=NUMBER, help="Default: 10; 2 off a limit switch.")
@options.override_limit
@options.rig_session
def jog_command(
    distance_mm: float,
    speed_mm_s: float | None,
    override: str | None,
    yes: bool,
    as_json: bool,
    **rig: "Unpack[options.StageOptions]",
) -> None:
    """Move the stage by MM, as 5 or -2.5; announces the motion and asks first. Prints the stage's position.

    Guarded as a run is, and not recorded.
    """
    from dragrig.api import jog
    from dragrig.cli.operator import TerminalOperator

    side = options.limit_side(override)
    with TerminalOperator(yes=yes) as person:
        move = jog(distance_mm, speed_mm_s, override=side, person=person, **rig)
    options.print_move(move, as_json=as_json)


@click.command("touch-off")
@click.option(
    "--force",
    "force_mN",
    metavar="MN",
    type=NUMBER,
    default=20.0,
    show_default=True,
    help="Force change that counts as contact.",
)
@click.option(
    "--speed", "speed_mm_s", metavar="MM/S", type=NUMBER, default=1.0, show_default=True, help="Approach speed."
)
@click.option(
    "--most", "most_mm", metavar="MM", type=NUMBER, default=20.0, show_default=True, help="Longest travel, signed."
)
@click.option(
    "--back", "back_mm", metavar="MM", type=NUMBER, default=0.0, show_default=True, help="Way back after the contact."
)
@click.option("--operator", metavar="NAME", default="", help="Operator's name, stored with the contact.")
@options.rig_session
def touch_off_command(
    force_mN: float,
    speed_mm_s: float,
    most_mm: float,
    back_mm: float,
    yes: bool,
    as_json: bool,
    **session: "Unpack[options.OperatorOptions]",
) -> None:
    """Approach slowly until the force has changed from its value at rest; announces the motion and asks first.

    The contact is stored in the lab folder. With stage.start_from = "contact" in the rig settings, start_mm of plans
    counts from it; limits stay absolute.
    """
    from dragrig.api import touch_off
    from dragrig.cli.operator import TerminalOperator

    with TerminalOperator(yes=yes) as person:
        contact = touch_off(
            most_mm, force_mN=force_mN, speed_mm_s=speed_mm_s, back_mm=back_mm, person=person, **session
        )
    if as_json:
        print_json(contact.model_dump())
    else:
        echo(f"contact at {contact.position_mm:.3f} mm, where the force changed by {contact.force_mN:.1f} mN")
        print_remark("Stored as contact.toml in the lab folder.")


@click.group("calibrate", invoke_without_command=True)
@click.pass_context
def calibrate_command(ctx: click.Context) -> None:
    """Calibrate force sensor or encoder; the result is added to the lab's history and applies from then on."""
    if ctx.invoked_subcommand is None:
        echo(ctx.get_help())


@calibrate_command.command("force")
@click.option(
    "--weights",
    metavar="G,G,…",
    required=True,
    callback=options.numbers,
    help="Weights in grams; 0 is the empty sensor.",
)
@click.option(
    "--repeats", metavar="N", type=int, default=1, show_default=True, help="Number of series, up and down alternately."
)
@click.option("--seconds", metavar="S", type=NUMBER, default=2.0, show_default=True, help="Duration of each reading.")
@options.session_notes("with the result")
@options.rig_session
def calibrate_force_command(
    weights: tuple[float, ...],
    repeats: int,
    seconds: float,
    yes: bool,
    as_json: bool,
    **session: "Unpack[options.CalibrationOptions]",
) -> None:
    """Calibrate the force sensor with known weights: asks for each, reads it, fits a line by least squares.

    Needs at least three distinct weights. Prints the points, gain and zero with their standard errors, and the standard
    deviation of the residuals.
    """
    from dragrig.api import calibrate_force
    from dragrig.cli.operator import TerminalOperator
    from dragrig.present import sensor_calibration_document

    with TerminalOperator(yes=yes) as person:
        calibration = calibrate_force(weights, repeats=repeats, duration_s=seconds, person=person, **session)
    document = sensor_calibration_document(calibration.entry, calibration.points, calibration.line, calibration.notes)
    print_document(document, as_json=as_json)


@calibrate_command.command("encoder")
@click.option("--travel", "travel_mm", metavar="MM", type=NUMBER, required=True, help="Travel, signed.")
@click.option(
    "--measured",
    "measured_mm",
    metavar="MM",
    type=NUMBER,
    multiple=True,
    help="Travel that a gauge showed; repeatable.",
)
@click.option("--repeats", metavar="N", type=int, default=3, show_default=True, help="Number of travels.")
@click.option(
    "--speed", "speed_mm_s", metavar="MM/S", type=NUMBER, default=10.0, show_default=True, help="Speed of travel."
)
@click.option("--by-hand", is_flag=True, help="Switch the stage off and push it.")
@click.option("--seconds", metavar="S", type=NUMBER, default=20.0, show_default=True, help="Time for a push by hand.")
@options.session_notes("with the result")
@options.rig_session
def calibrate_encoder_command(
    travel_mm: float,
    measured_mm: tuple[float, ...],
    repeats: int,
    speed_mm_s: float,
    by_hand: bool,
    seconds: float,
    yes: bool,
    as_json: bool,
    **session: "Unpack[options.CalibrationOptions]",
) -> None:
    """Calibrate the encoder over a known travel: the stage goes there and back; a line is fitted to the counts.

    Prints the points and the length of a count.
    """
    from dragrig.api import calibrate_encoder
    from dragrig.cli.operator import TerminalOperator
    from dragrig.present import sensor_calibration_document

    with TerminalOperator(yes=yes) as person:
        calibration = calibrate_encoder(
            travel_mm,
            measured_mm=measured_mm,
            repeats=repeats,
            speed_mm_s=speed_mm_s,
            by_hand=by_hand,
            duration_s=seconds,
            person=person,
            **session,
        )
    document = sensor_calibration_document(calibration.entry, calibration.points, calibration.line, calibration.notes)
    print_document(document, as_json=as_json)
