"""A stage that gives way to the force under its position loop: no gap, for its motion is recorded, unless far."""

from dataclasses import replace
from pathlib import Path

import pytest

from dragrig.analysis import select_runs
from dragrig.analysis.gap.position_channel import PositionAnalysis, analyse_position
from dragrig.sim_backend.blind.blind_campaign import draw_campaign
from dragrig.sim_backend.blind.plant import write_campaign
from dragrig.sim_backend.blind.run_plans import StageLoop, in_session
from dragrig.sim_backend.effects.base import catalogue

SEED = 205
LOOP = StageLoop(natural_hz=30.0, damping=0.7, mass_kg=2.5, scale_error_mm=1e-4)


def position_under(loop: StageLoop, folder: Path, *effects: str) -> PositionAnalysis:
    campaign = draw_campaign(SEED, effects=effects, conditions=["jerk-limited"])
    chosen = [run for run in campaign.runs if run.kind in {"relaxation", "blank"} or run.speed_mm_s == 60.0]
    runs = in_session([replace(run, hold_s=3.0) for run in chosen])
    write_campaign(replace(campaign, runs=runs, stage=loop), folder)
    return analyse_position(select_runs(folder).experiments, tuple(catalogue().values()))


def test_a_stage_that_gives_way_by_micrometres_has_no_position_error(tmp_path: Path) -> None:
    position = position_under(LOOP, tmp_path)
    assert not position.has_position_error
    assert position.yields_mm == pytest.approx(1600 / (2.5 * 188.5**2), rel=0.3)


def test_a_stage_that_gives_way_further_than_a_position_loop_has(tmp_path: Path) -> None:
    position = position_under(replace(LOOP, mass_kg=0.05), tmp_path)
    assert position.has_position_error
    assert position.yields_mm == 0


def test_a_stage_that_lags_is_told_beside_its_loop(tmp_path: Path) -> None:
    position = position_under(LOOP, tmp_path, "servo_lag")
    assert position.has_position_error
    assert position.model_classes[0].effect == "servo_lag"
