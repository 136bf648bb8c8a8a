"""Plans become runs: orders, ways back, prompts, and what is refused."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dragrig.config.errors import PlanError, SettingsError
from dragrig.config.plan import Plan
from dragrig.config.rig import RigSettings
from dragrig.config.settings import find_settings, parse, shipped_files, to_toml
from dragrig.config.specimen import Specimen
from dragrig.rig.devices import Contact, StageLimits
from dragrig.rig.programme import Programme, build_programme, preflight
from dragrig.rig.stops import Stops, assess_stops

SPECIMEN = Specimen(name="jejunum")
LIMITS = StageLimits(0.0, 150.0, 100.0, 3000.0)


def made(*steps: dict[str, object], seed: int = 0) -> Programme:
    plan = parse(Plan, {"name": "p", "seed": seed, "steps": list(steps)}, "p.toml")
    return build_programme(plan, SPECIMEN, 40.0, "p.toml")


def claimed(rig: RigSettings) -> Stops:
    """What stops the stage of a rig that nobody has tried."""
    return assess_stops(rig, None, has_timeout=True)


def kinds(programme: Programme) -> list[str]:
    return [run.protocol.kind for run in programme.runs]


@pytest.mark.parametrize("name", list(shipped_files("plan")))
def test_every_shipped_plan_can_be_carried_out(name: str, tmp_path: Path) -> None:
    programme = build_programme(find_settings(Plan, "plan", name), SPECIMEN, 40.0, name)
    report = preflight(programme, RigSettings(), LIMITS, tmp_path, name)
    assert report.findings == ()
    assert report.duration_s > 0


def test_the_papers_programme_is_whole() -> None:
    programme = build_programme(find_settings(Plan, "plan", "paper"), SPECIMEN, 40.0, "paper")
    forward = [run for run in programme.runs if run.follows < 0]
    strains = [run.shear_strain for run in forward if run.protocol.kind == "relaxation"]
    assert strains == [0.5, 1.0, 1.5, 2.0]
    assert [run.protocol.attributes()["speed_mm_s"] for run in forward if run.protocol.kind == "coulomb"] == [0.5]
    speeds = [run.protocol.attributes()["speed_mm_s"] for run in forward if run.protocol.kind == "drag"]
    eleven = [0.5, 1, 2, 5, 10, 15, 20, 30, 40, 50, 60]
    assert sorted(speeds[:11]) == eleven
    assert sorted(speeds[11:]) == eleven
    assert speeds[:11] != eleven
    assert speeds[:11] != speeds[11:]


def test_the_order_follows_from_the_seed_alone() -> None:
    step: dict[str, object] = {"kind": "drag", "speed_mm_s": [1, 2, 5, 10, 20], "order": "random", "repeats": 2}
    first, again, second = (made(step, seed=seed) for seed in (7, 7, 8))
    assert [run.protocol for run in first.runs] == [run.protocol for run in again.runs]
    assert [run.protocol for run in first.runs] != [run.protocol for run in second.runs]


def test_a_driven_way_back_is_a_run_of_its_own() -> None:
    programme = made({"kind": "drag", "speed_mm_s": 5.0, "travel_mm": 30.0, "way_back_speed_mm_s": 10.0})
    out, back = programme.runs
    assert kinds(programme) == ["drag", "return"]
    assert back.follows == out.index
    assert back.start_mm == pytest.approx(out.end_mm)
    assert back.end_mm == pytest.approx(out.start_mm)
    assert back.fixture == out.fixture


def test_a_relaxations_way_back_releases_its_strain() -> None:
    out, back = made({"kind": "relaxation", "shear_strain": 1.5}).runs
    assert (out.contact, out.sheared_from, out.shear_strain) == (Contact.STICKING, 0.0, 1.5)
    assert (back.contact, back.sheared_from) == (Contact.STICKING, 1.5)


def test_reversal_runs_stay_where_they_end_and_go_the_other_way() -> None:
    programme = made({"kind": "drag", "speed_mm_s": 5.0, "travel_mm": [40, -40], "way_back": "stay"})
    assert kinds(programme) == ["drag", "drag"]
    assert [(run.start_mm, run.end_mm) for run in programme.runs] == [(40.0, 80.0), (80.0, pytest.approx(40.0))]


def test_by_hand_asks_before_every_run_but_the_first() -> None:
    programme = made({"kind": "drag", "speed_mm_s": [1, 2], "way_back": "by_hand", "prompt": "fit"})
    back = "Return the capsule to its start by hand, outside the gut"
    assert [run.prompt for run in programme.runs] == ["fit", back]
    assert [run.start_mm for run in programme.runs] == [40.0, 40.0]


def test_a_change_of_capsule_or_fixture_asks_where_the_plan_does_not() -> None:
    programme = made(
        {"kind": "relaxation", "shear_strain": 1.0},
        {"kind": "drag", "speed_mm_s": [1, 2], "travel_mm": 20},
        {"kind": "drag", "speed_mm_s": 5, "fixture": "vacuum"},
        {"kind": "blank", "speed_mm_s": 20, "prompt": "off"},
    )
    prompts = [run.prompt for run in programme.runs if run.follows < 0]
    assert prompts == [
        "",
        "Change from capsule rough, gut in the vacuum fixture to capsule drag, gut on foam",
        "",
        "Change from capsule drag, gut on foam to capsule drag, gut in the vacuum fixture",
        "off",
    ]


def test_lists_make_every_combination() -> None:
    programme = made({"kind": "drag", "speed_mm_s": [1, 2], "travel_mm": [20, 30], "way_back": "by_hand"})
    assert [(run.protocol.attributes()["speed_mm_s"], run.end_mm - 40) for run in programme.runs] == [
        (1, 20), (1, 30), (2, 20), (2, 30),
    ]  # fmt: skip


def test_strokes_of_a_motion_are_no_sweep() -> None:
    strokes = [{"travel_mm": 20, "speed_mm_s": 5, "pause_s": 1}, {"travel_mm": -20, "speed_mm_s": 5}]
    (run,) = made({"kind": "motion", "strokes": strokes}).runs
    assert run.profile.extremes().highest_mm == pytest.approx(20)
    assert run.end_mm == pytest.approx(40.0)


@pytest.mark.parametrize(
    ("step", "words"),
    [
        ({"kind": "drog", "speed_mm_s": 5}, "did you mean drag?"),
        ({"kind": "drag", "speed_cm_s": 5}, "did you mean speed_mm_s?"),
        ({"kind": "drag", "speed_mm_s": 5, "repeat": 2}, "did you mean repeats?"),
        ({"kind": "drag", "speed_mm_s": 200}, "too short"),
        ({"kind": "drag", "speed_mm_s": float("nan")}, "finite"),
        ({"kind": "drag", "speed_mm_s": "5 mm/s"}, "number"),
        ({"kind": "drag", "speed_mm_s": -5}, "0.0001"),
        ({"kind": "drag"}, "speed_mm_s is missing"),
        ({"kind": "drag", "speed_mm_s": 5, "capsule": "rouhg"}, "did you mean rough?"),
        ({"kind": "return", "travel_mm": 5}, "way_back"),
        ({"kind": "drag", "speed_mm_s": []}, "no list of numbers"),
        ({"kind": "drag", "speed_mm_s": True}, "is no number"),
        ({"kind": "drag", "speed_mm_s": [1.0] * 200, "travel_mm": [40.0] * 200}, "more than 10000 runs"),
        ({"kind": "drag", "speed_mm_s": [1.0] * 200, "repeats": 1000}, "more than 10000 runs"),
    ],
)
def test_what_is_refused_is_refused_in_one_sentence(step: dict[str, object], words: str) -> None:
    with pytest.raises((PlanError, SettingsError)) as caught:
        made(step)
    assert words in str(caught.value)
    assert "p.toml: steps[0]" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("step", "words"),
    [
        ({"kind": "drag", "speed_mm_s": 5, "travel_mm": 120}, "from 40 to 160 mm, outside the stage's travel"),
        ({"kind": "drag", "speed_mm_s": 5, "travel_mm": -50}, "from -10 to 40 mm"),
        ({"kind": "drag", "speed_mm_s": 120}, "would reach a speed of 120 mm/s"),
        ({"kind": "relaxation", "shear_strain": 1, "ramp_accel_mm_s2": 9000}, "would reach an acceleration of 9000"),
    ],
)
def test_impossible_plans_are_found_before_anything_moves(step: dict[str, object], words: str, tmp_path: Path) -> None:
    report = preflight(made(step), RigSettings(), LIMITS, tmp_path, "p.toml")
    assert any(words in finding for finding in report.findings)
    with pytest.raises(PlanError, match=r"p\.toml"):
        report.require()


def test_the_way_that_a_stage_goes_on_without_its_program_is_told(tmp_path: Path) -> None:
    step = {"kind": "drag", "speed_mm_s": 20, "travel_mm": 60, "way_back": "stay"}
    rig = parse(RigSettings, {"hardware": {"drive": {"silence_s": 0.5}}}, "rig.toml")
    assert preflight(made(step), rig, LIMITS, tmp_path, "p.toml").remarks == ()
    report = preflight(made(step), rig, LIMITS, tmp_path, "p.toml", stops=claimed(rig))
    (remark,) = report.remarks
    # 20 mm/s for 0.5 s, and 0.07 mm to brake.
    assert "at up to 20 mm/s by up to 10.1 mm, never beyond the end of its stroke" in remark
    assert report.findings == ()
    short = preflight(made({**step, "travel_mm": 4}), rig, LIMITS, tmp_path, "p.toml", stops=claimed(rig))
    assert "by up to 3.9 mm" in short.remarks[0]


@pytest.mark.parametrize(("travel_mm", "reached"), [(95, 144.6), (-38, -7.6)])
def test_a_voltage_that_stays_on_must_not_carry_the_stage_to_an_end(
    travel_mm: float, reached: float, tmp_path: Path
) -> None:
    velocity = {"drive": {"mode": "velocity", "silence_s": 0.5}, "card": {"lines": {"heartbeat": "port1/line4"}}}
    rig = parse(RigSettings, {"hardware": velocity}, "rig.toml")
    step = {"kind": "drag", "speed_mm_s": 20, "travel_mm": travel_mm, "way_back": "stay"}
    limits = replace(LIMITS, highest_mm=140.0)
    assert preflight(made(step), rig, limits, tmp_path, "p.toml").findings == ()
    report = preflight(made(step), rig, limits, tmp_path, "p.toml", stops=claimed(rig))
    (finding,) = report.findings
    # From 0.5 mm before its end on, it brakes.
    assert f"would go on to {reached} mm, beyond the limit" in finding
    shorter = preflight(
        made({**step, "travel_mm": 0.7 * travel_mm}), rig, limits, tmp_path, "p.toml", stops=claimed(rig)
    )
    assert shorter.findings == ()


def test_a_full_disk_is_found_before_anything_moves(tmp_path: Path) -> None:
    rig = parse(RigSettings, {"recording": {"reserve_mb": 1e12}}, "rig.toml")
    report = preflight(made({"kind": "drag", "speed_mm_s": 5}), rig, LIMITS, tmp_path, "p.toml")
    assert re.search(r"\d MB free, \d+ MB needed: .* in reserve", report.findings[-1])


@given(
    st.lists(st.sampled_from([1.0, 5.0, 20.0]), min_size=1, max_size=4),
    st.integers(1, 3),
    st.sampled_from(["listed", "reversed", "random", "random_within_repeat"]),
    st.sampled_from(["driven", "by_hand", "stay"]),
)
def test_every_order_makes_the_same_runs(speeds: list[float], repeats: int, order: str, way_back: str) -> None:
    step: dict[str, object] = {
        "kind": "drag", "speed_mm_s": speeds, "travel_mm": 5.0,
        "repeats": repeats, "order": order, "way_back": way_back,
    }  # fmt: skip
    programme = made(step)
    forward = [run for run in programme.runs if run.follows < 0]
    assert sorted(run.protocol.attributes()["speed_mm_s"] for run in forward) == sorted(speeds * repeats)
    assert [run.index for run in programme.runs] == list(range(len(programme.runs)))
    for before, after in zip(programme.runs, programme.runs[1:], strict=False):
        if way_back != "by_hand":
            assert after.start_mm == pytest.approx(before.end_mm)


def test_a_plan_survives_being_written_down() -> None:
    plan = find_settings(Plan, "plan", "paper")
    import tomllib

    assert parse(Plan, tomllib.loads(to_toml(plan)), "again") == plan


def test_the_size_counts_the_channels_that_the_rig_records(tmp_path: Path) -> None:
    programme = made({"kind": "drag", "speed_mm_s": 5})
    sizes = [
        preflight(programme, RigSettings(), LIMITS, tmp_path, "p.toml", further).size_bytes for further in (None, 1, 4)
    ]
    samples = sum(run.profile.samples(RigSettings().sampling.rate_hz) for run in programme.runs)
    assert sizes[0] == sizes[1]
    assert sizes[2] - sizes[1] == 3 * 4 * samples


def test_a_session_of_days_says_how_many_and_until_when_and_what_is_in_reserve(tmp_path: Path) -> None:
    long = RigSettings().model_copy(
        update={"recording": RigSettings().recording.model_copy(update={"reserve_mb": 1e9})}
    )
    step = {"kind": "drag", "speed_mm_s": 10, "repeats": 10, "wait_s": 86_400}
    report = preflight(made(step), long, LIMITS, tmp_path, "p.toml")
    days = next(remark for remark in report.remarks if "days" in remark)
    assert re.fullmatch(r"the session takes 10\.0 days, until \d{4}-\d\d-\d\d \d\d:\d\d", days)
    (finding,) = report.findings
    assert "MB for the runs and 1e+09 MB in reserve (recording.reserve_mb)" in finding
    short = preflight(made({**step, "repeats": 1, "wait_s": 60}), RigSettings(), LIMITS, tmp_path, "p.toml")
    assert not any("days" in remark for remark in short.remarks)
