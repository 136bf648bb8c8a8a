"""The capsule robot: its motion against an independent integration, its energy, and its wall against the model's."""

import json
from copy import deepcopy
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from dragrig.analysis.robot import fastest_drive, place_of, steady_walk, study_robot
from dragrig.cli.model_commands import robot_command
from dragrig.config import (
    DragrigError,
    Fixture,
    FrictionModelSettings,
    RobotDrive,
    RobotSettings,
    SettingsError,
    Specimen,
    find_settings,
    parse,
    parse_effects,
)
from dragrig.rig import Acquisition, Contact, FloatArray, MotionProfile
from dragrig.sim_backend.friction import RecordedMotion, prepare
from dragrig.sim_backend.robot import energy_error, gut, hard_ground, walk
from property_tests import examples, thorough

ROBOT = find_settings(RobotSettings, "robot", "capsubot")
MODEL = FrictionModelSettings()


def independent_speed(robot: RobotSettings, drive: RobotDrive, periods: int) -> float:
    """Integrate x'' = (−m s'' − μ N sign x') / (M + m) with events at stops; mean speed of the last third."""
    total, friction = robot.mass_g, robot.hard_friction_coefficient * robot.mass_g * 9806.65
    position, velocity, time, places = 0.0, 0.0, 0.0, [0.0]

    def stop(_: float, state: FloatArray) -> float:
        return float(state[1])

    stop.terminal = True  # type: ignore[attr-defined]  # read by solve_ivp
    for _ in range(periods):
        for duration, relative in drive.phases:
            push, end = -robot.inner_mass_g * relative, time + duration
            while end - time > 1e-12:
                if velocity == 0.0:
                    if abs(push) <= friction:
                        time = end
                        break
                    sign = np.sign(push)
                else:
                    sign = np.sign(velocity)
                acceleration = (push - sign * friction) / total
                # Events at the start itself are avoided by a small step along the motion.
                step = min(1e-9, 0.5 * (end - time))
                begin = (
                    position + velocity * step + 0.5 * acceleration * step**2,
                    velocity + acceleration * step,
                )
                solved = solve_ivp(
                    lambda _, state, a=acceleration: (state[1], a),
                    (time + step, end),
                    begin,
                    events=stop,
                    rtol=1e-9,
                    atol=1e-12,
                )
                time = float(solved.t[-1])
                position, velocity = (float(value) for value in solved.y[:, -1])
                if solved.status == 1:
                    velocity = 0.0
            time = end
        places.append(position)
    first = 2 * periods // 3
    return (places[-1] - places[first]) / ((periods - first) * drive.period_s)


@pytest.mark.parametrize(
    ("slow", "fast", "stroke", "pause", "friction"),
    [
        pytest.param(2800, 17000, 6.0, 0.0, 0.1, id="sticks while the mass is pushed slowly"),
        pytest.param(4000, 17000, 6.0, 0.0, 0.1, id="slips back"),
        pytest.param(8000, 17000, 6.0, 0.02, 0.1, id="slips back, with a pause"),
        pytest.param(1000, 9000, 3.0, 0.0, 0.2, id="rests in between"),
        pytest.param(9000, 17000, 8.0, 0.0, 0.01, id="never rests"),
    ],
)
def test_speed_on_a_hard_surface_is_that_of_an_independent_integration(
    slow: float, fast: float, stroke: float, pause: float, friction: float
) -> None:
    robot = ROBOT.model_copy(update={"housing_g": 13.0, "inner_mass_g": 7.0, "hard_friction_coefficient": friction})
    drive = RobotDrive(slow_mm_s2=slow, fast_mm_s2=fast, stroke_mm=stroke, pause_s=pause)
    periods = walk(robot, drive, hard_ground(robot), 12).periods
    speed = (periods[-1].end_mm - periods[8].begin_mm) / (4 * drive.period_s)
    assert speed == pytest.approx(independent_speed(robot, drive, 12), rel=1e-3)


drives = st.builds(
    RobotDrive,
    slow_mm_s2=st.floats(500, 15000),
    fast_mm_s2=st.floats(2000, 20000),
    stroke_mm=st.floats(0.5, 8.0),
    pause_s=st.sampled_from([0.0, 0.01, 0.05]),
)


@given(drive=drives)
@settings(max_examples=examples(15), deadline=None)
def test_energy_balance_closes_on_both_surfaces(drive: RobotDrive) -> None:
    for surface, periods in ((hard_ground(ROBOT), 5), (gut(ROBOT, MODEL, 2.5), 4)):
        made = walk(ROBOT, drive, surface, periods)
        assert energy_error(made.periods) < 1e-6
        # The loss by a rule of its own, on the motion as it is drawn.
        for slip in made.slips[-3:]:
            time = np.linspace(slip.start_s, slip.end_s, 4001)
            _, velocity, friction = slip.at(time)
            assert np.trapezoid(friction * velocity, time) == pytest.approx(slip.loss_uJ, rel=1e-4, abs=1e-7)


@given(drive=drives)
@settings(max_examples=examples(20), deadline=None)
def test_a_slip_begins_where_another_ends_and_goes_one_way(drive: RobotDrive) -> None:
    made = walk(ROBOT, drive, hard_ground(ROBOT), 6)
    for before, after in pairwise(made.slips):
        assert after.start_s >= before.end_s - 1e-9
        assert after.start_mm == pytest.approx(before.end_mm, abs=1e-9)
        goes_on = after.start_s - before.end_s < 1e-9 and before.end_speed_mm_s > 1e-6
        assert after.start_speed_mm_s == (pytest.approx(before.end_speed_mm_s) if goes_on else 0.0)
    assert all(slip.speed_mm_s.min() > -1e-6 for slip in made.slips)


@pytest.mark.parametrize(
    ("slow", "fast"), [thorough(6000, 16000), (16000, 15000)], ids=["forwards alone", "to and fro"]
)
def test_a_walk_copies_its_periods_once_they_are_the_same(slow: float, fast: float) -> None:
    drive = RobotDrive(slow_mm_s2=slow, fast_mm_s2=fast, stroke_mm=10)
    copied = walk(ROBOT, drive, gut(ROBOT, MODEL, 2.5), 30)
    assert not copied.settled_periods  # not before the wall under it is its own
    while not copied.settled_periods and len(copied.periods) < 150:
        copied.period()
    assert copied.settled_periods
    simulated = replace(deepcopy(copied), may_copy=False, settled_periods=0)
    for _ in range(20):
        assert copied.period().travel_mm == pytest.approx(simulated.period().travel_mm, rel=1e-8)
    assert copied.periods[-1].loss_uJ == pytest.approx(simulated.periods[-1].loss_uJ, rel=1e-8)
    assert copied.slips[-1].since_s == pytest.approx(simulated.slips[-1].since_s, rel=1e-9)
    time = simulated.time_s - drive.period_s * np.linspace(1.0, 0.0, 50)
    for drawn, made in zip(copied.sample(time), simulated.sample(time), strict=True):
        assert drawn == pytest.approx(made, rel=1e-6, abs=1e-6)
    assert copied.resistance.difference(simulated.resistance) < 1e-6
    assert copied.since_s == pytest.approx(simulated.since_s, rel=1e-9)


def test_a_weak_drive_does_not_move_it() -> None:
    static_mN = gut(ROBOT, MODEL, 2.5).at_rest()(0.0)
    weak, strong = (
        RobotDrive(slow_mm_s2=500, fast_mm_s2=share * 1e3 * static_mN / ROBOT.inner_mass_g, stroke_mm=3)
        for share in (0.99, 1.05)
    )
    assert not walk(ROBOT, weak, gut(ROBOT, MODEL, 2.5), 3).slips
    assert walk(ROBOT, strong, gut(ROBOT, MODEL, 2.5), 3).slips


def test_resistance_in_the_gut_is_that_of_the_friction_model_on_the_same_motion() -> None:
    drive = RobotDrive(slow_mm_s2=6000, fast_mm_s2=16000, stroke_mm=10)
    made = walk(ROBOT, drive, gut(ROBOT, MODEL, 2.5), 8)
    time = np.unique(np.concatenate([np.linspace(slip.start_s, slip.end_s, 60) for slip in made.slips]))
    time = np.append(0.0, time[np.append(True, np.diff(time) > 1e-8)])
    motion = RecordedMotion.computed(time, made.sample(time)[0])
    acquisition = Acquisition(
        run_id="robot",
        order=0,
        kind="robot",
        profile=MotionProfile.from_pieces(()),
        capsule=ROBOT.capsule,
        specimen=find_settings(Specimen, "specimen", "jejunum"),
        fixture=Fixture.FOAM,
        contact=Contact.SLIDING,
        insertion_dwell_s=ROBOT.insertion_dwell_s,
    )
    exact = MODEL.model_copy(update={"regularisation_mm_s": 1e-6})
    forces = prepare(acquisition, exact, motion)
    for slip in made.slips[-3:]:
        inside = np.linspace(slip.start_s, slip.end_s, 40)[4:-4]
        _, _, friction = slip.at(inside)
        assert forces.components(inside).total == pytest.approx(friction, rel=3e-3)


@pytest.mark.parametrize(("slow", "fast", "leading"), [(15000, 16000, 1), (16000, 13000, -1)])
def test_a_short_reversal_keeps_the_leading_hemisphere_and_a_long_one_does_not(
    slow: float, fast: float, leading: int
) -> None:
    surface = gut(ROBOT, MODEL, 2.5)
    made = walk(ROBOT, RobotDrive(slow_mm_s2=slow, fast_mm_s2=fast, stroke_mm=10.8), surface, 12, may_copy=False)
    back = [slip.end_travel_mm for slip in made.slips if slip.direction < 0]
    assert max(back) > 0.05
    assert surface.leading == leading


def test_an_added_force_slows_the_walk_and_a_rig_effect_has_no_price() -> None:
    drive = RobotDrive(slow_mm_s2=6000, fast_mm_s2=16000, stroke_mm=10)
    specimen = find_settings(Specimen, "specimen", "jejunum")
    amended = MODEL.model_copy(update={"effects": parse_effects(("adhesion:force_mN=3", "mains_hum"))})
    study = study_robot(ROBOT, MODEL, specimen, drive=drive, diagnosed=amended)
    tack, hum = study.prices
    assert tack.speed_change_mm_s is not None
    assert -2.0 < tack.speed_change_mm_s < -0.1
    assert hum.speed_mm_s is None
    assert "no price" in hum.note


def test_the_drive_of_the_hard_surface_is_as_fast_as_in_the_paper() -> None:
    hard = partial(hard_ground, ROBOT)
    drive = fastest_drive(ROBOT, hard, 1)
    assert ROBOT.why_not(drive) == ""
    assert steady_walk(ROBOT, drive, hard).speed_mm_s == pytest.approx(32, rel=0.02)


@pytest.mark.thorough
def test_the_gut_needs_a_drive_of_its_own() -> None:
    """The paper: the hard surface's drive is slow in the gut, and one chosen for it at least three times as fast."""
    hard = partial(hard_ground, ROBOT)
    inside = partial(gut, ROBOT, MODEL, 2.5)
    hard_drive = fastest_drive(ROBOT, hard, 1)
    start = hard_drive.model_copy(update={"slow_mm_s2": 0.8 * ROBOT.max_acceleration_mm_s2})
    found = fastest_drive(ROBOT, inside, 1, place_of(ROBOT, start))
    assert ROBOT.why_not(found) == ""
    slow, fast = (steady_walk(ROBOT, drive, inside).speed_mm_s for drive in (hard_drive, found))
    assert fast > 3 * slow > 0


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"housing_g": -1.0, "ranges": {}}, "housing_g"),
        ({"ranges": {"housing_g": (20.0, 30.0)}}, "does not hold"),
        ({"ranges": {"houssing_g": (1.0, 30.0)}}, "housing_g"),
    ],
)
def test_a_robot_that_cannot_be_is_refused_by_name(changes: dict[str, object], names: str) -> None:
    with pytest.raises(SettingsError, match=names):
        parse(RobotSettings, {**ROBOT.model_dump(), **changes}, "own.toml")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--slow", "3000"), "add --fast and --stroke"),
        (("--slow", "3000", "--fast", "90000", "--stroke", "5"), "fast_mm_s2 is 9e+04"),
        (("--slow", "3000", "--fast", "9000", "--stroke", "0"), "stroke_mm"),
        (("--effect", "stribek"), "did you mean stribeck"),
        (("--robot", "nobody"), "known are capsubot"),
    ],
)
def test_a_wrong_request_is_answered_in_a_sentence(arguments: tuple[str, ...], says: str) -> None:
    result = CliRunner().invoke(robot_command, list(arguments))
    assert isinstance(result.exception, DragrigError)
    assert says in str(result.exception)


def test_a_drive_too_weak_for_the_gut_is_told_with_both_forces() -> None:
    result = CliRunner().invoke(robot_command, ["--slow", "500", "--fast", "5000", "--stroke", "5", "--json"])
    told = json.loads(result.stdout)
    assert "In the gut it does not move: the actuator's force of 25.0 mN" in told["in_words"][1]
    assert told["drives"][0]["gut"]["speed_mm_s"] == 0


BACKWARDS = ("--slow", "16000", "--fast", "4000", "--stroke", "10.8", "--json")


def test_a_robot_that_a_drive_moves_backwards_is_told_so() -> None:
    told = json.loads(CliRunner().invoke(robot_command, BACKWARDS).stdout)
    assert "In the gut it moves backwards at 4." in told["in_words"][1]


@pytest.mark.thorough
def test_a_robot_that_moves_backwards_has_a_price_that_says_so() -> None:
    told = json.loads(CliRunner().invoke(robot_command, [*BACKWARDS, "--effect", "stribeck"]).stdout)
    [price] = told["prices"]
    assert price["speed_mm_s"] < 0
    assert price["note"] == "the robot moves backwards with it"
