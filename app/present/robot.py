"""A capsule robot laid out for a reader: its speeds, one period, what assumptions change, and the price of effects."""

from collections.abc import Sequence
from math import inf
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as MatplotlibFigure

from dragrig.analysis import capitalise
from dragrig.analysis.gap import display_name
from dragrig.analysis.robot import GUT_DRIVE, HARD_DRIVE, DrivenRobot, Price, RobotStudy, SteadyWalk
from dragrig.present import (
    BLACK,
    BLUE,
    GREY,
    SMALL_PT,
    VERMILLION,
    Document,
    Field,
    Figure,
    FormattedNumber,
    Section,
    Table,
    Text,
    TextKind,
    attributes_json,
    decimals,
    figure_style,
    new_figure,
    significant,
    tint,
)
from dragrig.sim_backend.friction import GRAVITY_M_S2
from dragrig.sim_backend.robot import MN_PER_G_MM_S2

if TYPE_CHECKING:
    from dragrig.config import RobotDrive

FORMAT, VERSION = "dragrig-robot", 1
PAPER_SPEEDS = "32 mm/s on a hard surface, 1 to 2 mm/s in the gut, 7 to 10 mm/s with a drive chosen by the model"
LABELS = {
    "housing_g": "mass of the housing, g",
    "inner_mass_g": "inner mass, g",
    "diameter_mm": "diameter, mm",
    "length_mm": "length, mm",
    "contact_angle_deg": "contact angle, °",
    "insertion_dwell_s": "time in the gut before it starts, s",
    "hard_friction_coefficient": "μ on the hard surface",
    "max_force_mN": "greatest force, mN",
    "max_stroke_mm": "greatest stroke, mm",
    "max_relative_speed_mm_s": "greatest relative speed, mm/s",
    "max_pause_s": "longest pause, s",
}
CURVE_POINTS = 1200


def robot_document(study: RobotStudy) -> Document:
    """Lay out what a robot reaches."""
    return Document(
        title=f"Robot {study.robot.name}",
        badges=("simulated",),
        answer=" ".join(robot_sentences(study)),
        sections=(
            Section("speeds", "Speed and work", (*_drive_tables(study), *_settling(study.drives))),
            Section("period", "One period", (_period_figure(study),)),
            Section("price", "The price of the gap", _price_blocks(study)),
            Section("assumptions", "What is assumed", _assumption_blocks(study)),
        ),
        data=_json(study),
    )


def robot_sentences(study: RobotStudy) -> tuple[str, ...]:
    """Say what a robot reaches, and what the dearest effect costs."""
    costs = [(-price.speed_change_mm_s, price) for price in study.prices if price.speed_change_mm_s is not None]
    alone = [(cost, price) for cost, price in costs if " " not in price.effect]
    if not alone:
        return _reached(study)
    cost, dearest = max(alone, key=lambda entry: entry[0])
    if cost <= 0:
        return (*_reached(study), "No effect takes speed.")
    return (*_reached(study), f"{_effect_name(dearest)} takes {cost:.2f} mm/s in the gut.")


def _reached(study: RobotStudy) -> tuple[str, ...]:
    named = {driven.name: driven for driven in study.drives}
    if HARD_DRIVE not in named or GUT_DRIVE not in named:
        (driven,) = study.drives
        return tuple(_speed_sentence(study, driven, on) for on in ("the hard surface", "the gut"))
    hard, gut = named[HARD_DRIVE], named[GUT_DRIVE]
    if gut.gut.speed_mm_s <= 0:
        return (_speed_sentence(study, gut, "the gut"),)
    return (
        f"In the gut the robot reaches {gut.gut.speed_mm_s:.1f} mm/s with the drive chosen for it.",
        f"With the drive that is best on the hard surface it reaches {hard.gut.speed_mm_s:.1f} mm/s, and "
        f"{hard.hard.speed_mm_s:.1f} mm/s there.",
    )


def _speed_sentence(study: RobotStudy, driven: DrivenRobot, on: str) -> str:
    walk = driven.hard if on == "the hard surface" else driven.gut
    place = "In the gut" if on == "the gut" else f"On {on}"
    if walk.walker.slips and walk.speed_mm_s:
        backwards = "backwards " if walk.speed_mm_s < 0 else ""
        return f"{place} it moves {backwards}at {abs(walk.speed_mm_s):.1f} mm/s."
    robot, drive = study.robot, walk.drive
    static = (
        robot.hard_friction_coefficient * robot.mass_g * GRAVITY_M_S2 if on == "the hard surface" else study.static_mN
    )
    force = MN_PER_G_MM_S2 * robot.inner_mass_g * max(drive.slow_mm_s2, drive.fast_mm_s2)
    if walk.walker.slips:
        return f"{place} it slips to and fro and does not move on."
    return (
        f"{place} it does not move: the actuator's force of {force:.1f} mN does not exceed the static resistance of "
        f"{static:.1f} mN."
    )


def _drive_tables(study: RobotStudy) -> tuple[Table, Table]:
    def work(walk: SteadyWalk) -> float | None:
        return None if walk.loss_uJ_mm == inf else walk.loss_uJ_mm

    return (
        Table.of(
            "drives",
            "The drives",
            study.drives,
            Field("drive", "drive", lambda driven: driven.name),
            Field("slow_mm_s2", "slow, mm/s²", lambda driven: driven.gut.drive.slow_mm_s2, decimals(0)),
            Field("fast_mm_s2", "fast, mm/s²", lambda driven: driven.gut.drive.fast_mm_s2, decimals(0)),
            Field("stroke_mm", "stroke, mm", lambda driven: driven.gut.drive.stroke_mm, decimals(1)),
            Field("pause_ms", "pause, ms", lambda driven: 1e3 * driven.gut.drive.pause_s, decimals(0)),
            Field("period_ms", "period, ms", lambda driven: 1e3 * driven.gut.drive.period_s, decimals(0)),
        ),
        Table.of(
            "walks",
            "Work is mechanical; what the actuator takes back while braking is subtracted",
            [
                (driven.name, surface, walk)
                for driven in study.drives
                for surface, walk in (("hard surface", driven.hard), ("gut", driven.gut))
            ],
            Field("drive", "drive", lambda row: row[0]),
            Field("surface", "on", lambda row: row[1]),
            Field("speed_mm_s", "speed, mm/s", lambda row: row[2].speed_mm_s, decimals(2)),
            Field("work_uJ_mm", "work, µJ/mm", lambda row: work(row[2]), significant(3)),
        ),
    )


def _settling(drives: Sequence[DrivenRobot]) -> tuple[Text, ...]:
    worst = max(walk.energy_error for driven in drives for walk in (driven.hard, driven.gut))
    blocks = [
        Text(
            f"The energy balance closes to {worst:.0e}: the actuator's work is the loss to friction and the change of "
            "kinetic energy.",
            TextKind.EXPLANATION,
        )
    ]
    for driven in drives:
        if not driven.gut.converged:
            blocks.append(
                Text(f"{capitalise(driven.name)}: the periods in the gut are not alike; the speed is a mean.")
            )
        if not driven.converged:
            blocks.append(
                Text(
                    f"{capitalise(driven.name)}: effects and walk do not agree after {driven.iterations} iterations; "
                    "the last is told."
                )
            )
    return tuple(blocks)


def _period_figure(study: RobotStudy) -> Figure:
    return Figure(
        "robot-period",
        "Force, positions and slip over one period in the gut, a column for each drive.",
        "Positions count from the period's begin; shaded is where the housing slips.",
        lambda: period_figure(study.drives, study.robot.inner_mass_g),
    )


def period_figure(drives: Sequence[DrivenRobot], inner_mass_g: float) -> MatplotlibFigure:
    """Draw force, positions and speed over the last period in the gut, with the drives side by side."""
    with figure_style():
        figure = new_figure(5.0 + 5.5 * len(drives), 8.0, "One period of the robot in the gut", narrow=len(drives) == 1)
        panels = figure.subplots(3, len(drives), sharex="col", sharey="row", squeeze=False)
        for driven, column in zip(drives, panels.T, strict=True):
            _draw_period(column.tolist(), driven.gut, inner_mass_g)
            column[0].set_title(f"{driven.name}: {driven.gut.speed_mm_s:.2f} mm/s")
        for axes, label in zip(panels[:, 0], ("Force (mN)", "Position (mm)", "Speed (mm/s)"), strict=True):
            axes.set_ylabel(label)
            low, high = axes.get_ylim()
            axes.set_ylim(low, high + 0.3 * (high - low))
            axes.legend(loc="upper right", ncols=2, fontsize=SMALL_PT, labelcolor="linecolor")
        return figure


def _draw_period(panels: Sequence[Axes], walk: SteadyWalk, inner_mass_g: float) -> None:
    force_axes, place_axes, speed_axes = panels
    period, drive = walk.last[-1], walk.drive
    time = np.linspace(0.0, drive.period_s, CURVE_POINTS)
    place, velocity, friction = walk.walker.sample(period.begin_s + time)
    relative_mm, acceleration = _relative_motion(drive, time)
    push = -MN_PER_G_MM_S2 * inner_mass_g * acceleration
    for axes in panels:
        for slip in walk.walker.slips[period.first_slip :]:
            begin, end = (1e3 * (at - period.begin_s) for at in (slip.start_s, slip.end_s))
            axes.axvspan(begin, end, color=tint(BLUE, 0.12), linewidth=0)
        axes.axhline(0.0, color=GREY, linewidth=0.8)
    against = np.where(velocity == 0, push, friction)
    force_axes.plot(1e3 * time, push, color=BLACK, label="push on the housing, −m s″")
    force_axes.plot(1e3 * time, against, color=VERMILLION, linewidth=1.8, label="friction against it")
    place_axes.plot(1e3 * time, place - period.begin_mm, color=BLUE, label="housing")
    place_axes.plot(1e3 * time, place - period.begin_mm + relative_mm, color=BLACK, linewidth=1.8, label="inner mass")
    speed_axes.plot(1e3 * time, velocity, color=BLUE, label="slip of the housing")
    speed_axes.set_xlim(0.0, 1e3 * drive.period_s)
    speed_axes.set_xlabel("Time in the period (ms)")


def _relative_motion(drive: "RobotDrive", time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return relative position and acceleration of the inner mass in a period."""
    position, acceleration = np.zeros_like(time_s), np.zeros_like(time_s)
    begin, place, speed = 0.0, 0.0, 0.0
    for duration, relative in drive.phases:
        inside = time_s >= begin
        elapsed = time_s[inside] - begin
        position[inside] = place + speed * elapsed + 0.5 * relative * elapsed**2
        acceleration[inside] = relative
        place += speed * duration + 0.5 * relative * duration**2
        speed += relative * duration
        begin += duration
    return position, acceleration


def _price_blocks(study: RobotStudy) -> tuple[Text | Table, ...]:
    if not study.prices:
        return ()
    table = Table.of(
        "prices",
        "Of the last drive above, in the gut: each effect alone, beside the same model without effects",
        study.prices,
        Field("effect", "effect", _effect_name),
        Field("speed_mm_s", "speed with it, mm/s", lambda price: price.speed_mm_s, decimals(2)),
        Field("price_mm_s", "price, mm/s", _price_cell, decimals(2)),
        Field("work_uJ_mm", "more work, µJ/mm", lambda price: price.work_change_uJ_mm, decimals(1, signed=True)),
        Field("note", "remark", lambda price: price.note),
    )
    return (
        Text(
            "The price is the forward speed that an effect takes; a negative price is speed gained, and a negative "
            "speed is backwards. ± is the standard error "
            "that follows from that of the effect's size, where a diagnosis gives one. What is periodic in position or "
            "in time enters by its mean."
        ),
        table,
    )


def _effect_name(price: Price) -> str:
    return price.effect if " " in price.effect else capitalise(display_name(price.effect))


def _price_cell(price: Price) -> float | FormattedNumber | None:
    if price.speed_change_mm_s is None:
        return None
    cost = -price.speed_change_mm_s
    if price.speed_error_mm_s is None:
        return cost
    return FormattedNumber(cost, f"{cost:.2f} ± {price.speed_error_mm_s:.2f}".replace("-", "−"))


def _assumption_blocks(study: RobotStudy) -> tuple[Text | Table, ...]:
    robot = study.robot
    if not study.sensitivities:
        return (
            Text(
                "What the robot is and what its actuator can do is assumed: "
                + ", ".join(_assumed(key, getattr(robot, key)) for key in robot.ranges)
                + "."
            ),
        )
    rows = [
        (entry.key, value, speeds)
        for entry in study.sensitivities
        for value, speeds in ((entry.low, entry.at_low), (entry.high, entry.at_high))
    ]
    table = Table.of(
        "assumptions",
        "Speeds in mm/s at both ends of each assumption's range, the others unchanged and the drives chosen anew",
        rows,
        Field("assumption", "assumption", lambda row: LABELS[row[0]]),
        Field("value", "changed to", lambda row: row[1], significant(3)),
        Field("hard_mm_s", "hard surface", lambda row: row[2][0], decimals(1)),
        Field("hard_in_gut_mm_s", "its drive in the gut", lambda row: row[2][1], decimals(1)),
        Field("gut_mm_s", "chosen for the gut", lambda row: row[2][2], decimals(1)),
    )
    assumed = ", ".join(_assumed(entry.key, entry.value) for entry in study.sensitivities)
    return (Text(f"The paper states speeds alone: {PAPER_SPEEDS}. All of this is assumed: {assumed}."), table)


def _assumed(key: str, value: float) -> str:
    """Return an assumption as it stands in a sentence: what it is, value, unit."""
    name, _, unit = LABELS[key].partition(", ")
    return f"{name} {value:g} {unit}".rstrip()


def _json(study: RobotStudy) -> dict[str, object]:
    def walk_json(walk: SteadyWalk) -> dict[str, object]:
        return {
            **attributes_json(walk, "speed_mm_s", "energy_error", loss_uJ_mm="work_uJ_mm", converged="steady"),
            **attributes_json(walk.last[-1], forwards_mm="forward_mm", backwards_mm="backward_mm"),
            "periods": len(walk.walker.periods),
        }

    return {
        "format": FORMAT,
        "version": VERSION,
        "robot": study.robot.model_dump(mode="json"),
        "model": study.model.name,
        "effects": study.effects,
        "seed": study.seed,
        "in_words": robot_sentences(study),
        "static_resistance_mN": study.static_mN,
        "drives": [
            {
                "name": driven.name,
                **driven.gut.drive.model_dump(),
                "period_ms": 1e3 * driven.gut.drive.period_s,
                "hard": walk_json(driven.hard),
                "gut": walk_json(driven.gut),
                "effects_settled": driven.converged,
            }
            for driven in study.drives
        ],
        "prices": [
            {
                **attributes_json(price, "effect", "speed_mm_s", "work_change_uJ_mm", "note"),
                "price_mm_s": None if price.speed_change_mm_s is None else -price.speed_change_mm_s,
                "standard_error_mm_s": price.speed_error_mm_s,
            }
            for price in study.prices
        ],
        "assumptions": [
            {
                **attributes_json(entry, "key", "value"),
                "range": (entry.low, entry.high),
                "speeds_mm_s": {"low": entry.at_low, "high": entry.at_high},
            }
            for entry in study.sensitivities
        ],
    }
