"""The plan `diagnose`: no longer than `paper`, better at telling apart, and on the blind plant."""

from dataclasses import replace
from pathlib import Path

import pytest

import dragrig
from dragrig.analysis.gap.run_data import choose_runs
from dragrig.config.plan import Plan, PlanStep
from dragrig.rig.programme import Programme
from dragrig.setup import resolve
from dragrig.sim_backend.blind import RunList, draw_campaign, parallel_session, write_campaign
from dragrig.sim_backend.blind.plant import recorded_run
from dragrig.sim_backend.effects.base import catalogue
from listed_runs import table

HANDS_S = 120.0


def programme(name: str) -> Programme:
    return resolve(name, backend="simulated").programme()


def test_it_takes_no_more_rig_time_than_paper_even_where_prompts_take_two_minutes() -> None:
    took = {name: dragrig.check(name).duration_s for name in ("paper", "diagnose")}
    prompts = {name: sum(bool(run.prompt) for run in programme(name).runs) for name in took}
    assert took["diagnose"] + HANDS_S * prompts["diagnose"] <= took["paper"] + HANDS_S * prompts["paper"]


def test_it_has_what_a_diagnosis_needs() -> None:
    runs = [run for run in programme("diagnose").runs if run.follows < 0]
    kinds = [run.protocol.kind for run in runs]
    assert kinds[0] == kinds[-1] == "relaxation"
    sentinels = [place for place, run in enumerate(runs) if run.note == "sentinel"]
    assert len(sentinels) >= 3
    assert len({runs[place].protocol.summary() for place in sentinels}) == 1
    assert sentinels[-1] - sentinels[0] > len(runs) / 3
    accelerations = {run.profile.extremes().acceleration_mm_s2 for run in runs if run.protocol.kind == "blank"}
    assert len(accelerations) >= 3
    speeds = {run.profile.extremes().speed_mm_s for run in runs if run.protocol.kind == "coulomb"}
    assert len(speeds) >= 4
    assert any(run.profile.extremes().lowest_mm < run.profile.extremes().highest_mm and run.end_mm == run.start_mm
               for run in runs if run.protocol.kind == "motion")  # fmt: skip


@pytest.mark.thorough
def test_its_coulomb_runs_tell_friction_from_tack_better_than_those_of_paper() -> None:
    pair = ("stribeck", "adhesion")
    others = [name for name in catalogue() if name not in pair]
    drags = PlanStep(kind="drag", parameters={"speed_mm_s": [2.0, 20.0], "travel_mm": 10.0})

    def beside_drags(name: str) -> Plan:
        plan = resolve(name, backend="simulated").plan
        return plan.model_copy(update={"steps": (*(step for step in plan.steps if step.kind == "coulomb"), drags)})

    apart = {
        name: dragrig.gap_isolability(beside_drags(name), without=others).pair(*pair) for name in ("paper", "diagnose")
    }
    assert apart["paper"] is not None
    assert apart["diagnose"] is not None
    assert apart["diagnose"].sin2 > 1.5 * apart["paper"].sin2


def test_the_plant_makes_a_list_of_runs(tmp_path: Path) -> None:
    secret = draw_campaign(7, effects=["stribeck"])
    listed = RunList.of("mine", [table("relaxation", 60.0), table("drag", 200.0, speed_mm_s=20.0, dwell_s=10.0)])
    write_campaign(secret, tmp_path / "mine", runs=listed)
    experiments = choose_runs(tmp_path / "mine").experiments
    assert [experiment.kind for experiment in experiments] == ["relaxation", "drag"]
    assert [experiment.insertion_dwell_s for experiment in experiments] == [60.0, 10.0]
    assert (
        experiments[1].run.info.header.start_time - experiments[0].run.info.header.start_time
    ).total_seconds() == 140.0
    with pytest.raises(ValueError, match="no runs of kind motion"):
        RunList.of("mine", [table("motion", 0.0)])
    with pytest.raises(ValueError, match="go forward"):
        RunList.of("mine", [table("drag", 0.0, travel_mm=-40.0)])


def test_a_run_of_a_list_is_the_plants_own_with_its_rest_before(tmp_path: Path) -> None:
    secret = draw_campaign(7)
    first = next(run for run in secret.runs if run.kind == "drag")
    aged = [RunList("mine", (replace(first, order=0, dwell_s=dwell),)) for dwell in (60.0, 60.0, 0.5)]
    entry, same, fresher = (recorded_run(parallel_session(secret, entry), 0) for entry in aged)
    assert (entry.force == same.force).all()
    # Wall that has relaxed for less pushes harder before the capsule moves on.
    start = (entry.time > 1.0) & (entry.time < 1.2)
    assert abs(fresher.force[start]).mean() > abs(entry.force[start]).mean()
