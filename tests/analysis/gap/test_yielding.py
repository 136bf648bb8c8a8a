"""A stage that gives way to the force under its position loop: no gap, for its motion is recorded, unless far."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dragrig.analysis import Experiment, select_runs
from dragrig.analysis.gap.position_channel import PositionAnalysis, analyse_position
from dragrig.sim_backend.blind.blind_campaign import draw_campaign
from dragrig.sim_backend.blind.plant import write_campaign
from dragrig.sim_backend.blind.run_plans import StageLoop, in_session
from dragrig.sim_backend.effects.base import catalogue

SEED = 205
LOOP = StageLoop(natural_hz=30.0, damping=0.7, mass_kg=2.5, scale_error_mm=1e-4)


def runs_under(loop: StageLoop, folder: Path, *effects: str) -> tuple[Experiment, ...]:
    campaign = draw_campaign(SEED, effects=effects, conditions=["jerk-limited"])
    chosen = [run for run in campaign.runs if run.kind in {"relaxation", "blank"} or run.speed_mm_s == 60.0]
    runs = in_session([replace(run, hold_s=3.0) for run in chosen])
    write_campaign(replace(campaign, runs=runs, stage=loop), folder)
    return select_runs(folder).experiments


def position_of(runs: tuple[Experiment, ...]) -> PositionAnalysis:
    return analyse_position(runs, tuple(catalogue().values()))


@pytest.fixture(scope="module")
def soft(tmp_path_factory: pytest.TempPathFactory) -> tuple[Experiment, ...]:
    return runs_under(LOOP, tmp_path_factory.mktemp("soft"))


def test_a_stage_that_gives_way_by_micrometres_has_no_position_error(soft: tuple[Experiment, ...]) -> None:
    position = position_of(soft)
    assert not position.has_position_error
    assert position.yielding is not None
    assert position.yielding.most_mm == pytest.approx(1600 / (2.5 * 188.5**2), rel=0.3)


def test_a_stage_that_gives_way_further_than_a_position_loop_has(tmp_path: Path) -> None:
    position = position_of(runs_under(replace(LOOP, mass_kg=0.05), tmp_path))
    assert position.has_position_error
    assert position.yielding is None


def test_a_stage_that_lags_is_told_beside_its_loop(tmp_path: Path) -> None:
    position = position_of(runs_under(LOOP, tmp_path, "servo_lag"))
    assert position.has_position_error
    assert position.model_classes[0].effect == "servo_lag"


def test_every_run_knows_of_a_soft_loop_that_relaxations_alone_show(
    soft: tuple[Experiment, ...], tmp_path: Path
) -> None:
    assert {run.kind for run in soft if run.gives_way} == {"relaxation"}
    assert all(run.soft_loop for run in soft)
    assert not any(run.soft_loop for run in runs_under(replace(LOOP, natural_hz=200.0), tmp_path))


def test_the_shear_follows_a_stage_that_creeps_back_as_its_load_relaxes(soft: tuple[Experiment, ...]) -> None:
    run = [run for run in soft if run.gives_way][-1]
    assert not run.follows_command
    position, before_end_s = np.asarray(run.run.trace.position, dtype=np.float64), run.time_s[-1] - run.time_s
    followed = run.unsmoothed_motion.position(run.time_s)
    early, late = (before_end_s > 2.6) & (before_end_s < 2.9), before_end_s < 1.0
    assert position[late].mean() - position[early].mean() > 1.5e-3
    for part in (early, late):
        assert followed[part].mean() == pytest.approx(position[part].mean(), abs=3e-4)
