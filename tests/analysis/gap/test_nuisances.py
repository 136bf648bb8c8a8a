"""What a nominal model may be a little wrong in without any effect: another programme's sums are no gap."""

from pathlib import Path

import numpy as np
import pytest

from diagnosed import OF_SOME
from dragrig.analysis.gap.diagnose import diagnose
from dragrig.analysis.gap.diagnosis import Verdict
from dragrig.analysis.gap.run_data import choose_runs
from dragrig.analysis.gap.studies import INTEGRATION_STEP_S, PANELS, ramp_integration_sd
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.rig.profile import FloatArray
from dragrig.sim_backend.blind import draw_campaign, write_campaign
from effect_scenes import scene
from hidden import thinned
from property_tests import thorough

SUMS_THE_CONTACT_COARSELY, STEPS_A_RAMP_COARSELY = 1839364650, 269666675


@pytest.mark.parametrize("seed", [SUMS_THE_CONTACT_COARSELY, thorough(STEPS_A_RAMP_COARSELY)])
def test_what_another_programme_sums_coarsely_is_not_seen_as_a_gap(seed: int, tmp_path: Path) -> None:
    write_campaign(thinned(draw_campaign(seed, rough=True), 3), tmp_path)
    diagnosis = diagnose(choose_runs(tmp_path), MODEL, OF_SOME)
    assert (diagnosis.verdict, diagnosis.effects) == (Verdict.NO_GAP, ())


def test_midpoints_over_the_contact_come_to_its_force_where_they_are_many() -> None:
    seen = scene("drag", until_s=3.5)
    assert seen.wall is not None
    moves = seen.slip.since_start_s > 0.05
    force = np.abs(seen.f_e[moves])
    few, many = (np.abs(seen.wall.coarse_resistance(panels)[moves] - force).max() for panels in (PANELS, 512))
    assert many < 0.1 * few
    assert 1e-3 * force.max() < few < 0.1 * force.max()


def coarse(force: FloatArray, time: FloatArray, step_s: float) -> FloatArray:
    at = np.arange(0.0, time[-1] + step_s, step_s)
    return np.interp(time, at, np.interp(at, time, force))


def test_a_ramp_between_coarse_steps_is_doubted_as_much_as_it_is_off() -> None:
    seen = scene("relaxation", until_s=1.5)
    passed = np.abs(seen.acceleration_mm_s2) > 0
    off = np.abs(coarse(seen.shear, seen.time_s, 2 * INTEGRATION_STEP_S) - seen.shear)
    expected = ramp_integration_sd(seen)
    assert not expected[~passed].any()
    assert 0.3 < np.sqrt(np.mean(expected[passed] ** 2) / np.mean(off[passed] ** 2)) < 3.0
