"""How a trace is divided into blocks: fine where the force jumps, and never into too many."""

import numpy as np
import pytest

import dragrig
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.analysis.models.experiment import Experiment
from dragrig.analysis.noise import MAX_BLOCKS, BlockMeans, average_in_blocks

SLOW = ["speed_mm_s=0.5", "travel_mm=30", "way_back=stay"]


def divided(*effects: str) -> tuple[Experiment, BlockMeans]:
    experiment = Experiment(dragrig.simulate("drag", assignments=SLOW, effects=effects)[0])
    events = MODEL.prepare(experiment)["force"].events_s
    return experiment, average_in_blocks(experiment, "force", events, jumps=True, longest_mm=0.4)


@pytest.fixture(scope="module")
def rippling() -> tuple[Experiment, BlockMeans]:
    return divided("velocity_ripple:pitch_mm=2")


def test_a_motion_of_many_bends_has_a_bounded_number_of_blocks(rippling: tuple[Experiment, BlockMeans]) -> None:
    experiment, blocks = rippling
    assert len(experiment.motion.breaks_s) > 20
    assert 200 < len(blocks.mean) <= MAX_BLOCKS
    assert int(blocks.samples.sum()) == len(experiment.time_s)


def test_blocks_stay_fine_where_the_stage_starts(rippling: tuple[Experiment, BlockMeans]) -> None:
    experiment, blocks = rippling
    start = experiment.motion.breaks_s[1]
    after = (blocks.start_s >= start - 0.002) & (blocks.start_s < start + 0.008)
    assert blocks.samples[after].tolist() == [1.0] * int(after.sum())
    assert after.sum() >= 8


def test_no_block_reaches_far_along_the_way(rippling: tuple[Experiment, BlockMeans]) -> None:
    for experiment, blocks in (rippling, divided()):
        ends = experiment.position(np.stack((blocks.start_s, blocks.end_s)))
        assert float(np.abs(ends[1] - ends[0]).max()) < 0.6
