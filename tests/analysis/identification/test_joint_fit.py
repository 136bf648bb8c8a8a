"""One fit of everything: a specimen's values come back, what runs cannot tell is said, and so is doubt."""

from math import degrees, isnan
from pathlib import Path

import h5py
import numpy as np
import pytest

import dragrig
from dragrig.analysis.identification.identification import JointFit
from dragrig.analysis.identification.identify import fit_jointly
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.analysis.selection import select_loaded_runs, select_runs
from dragrig.rig.runfile import read_run
from places import CAMPAIGN

TRUE = {
    "stiffness_scale": 1.1042,
    "e1_scale": 0.9294,
    "e2_scale": 1.0284,
    "e3_scale": 0.9517,
    "eta1_scale": 0.9675,
    "eta2_scale": 0.944,
    "friction_coefficient": 0.09,
    "mucus_scale": 1.1382,
    "force_gain": 0.9926,
    "insertion_dwell_scale": 43.6001 / 60.0,
    "contact_angle_offset_deg": degrees(1.0492) - 60.0,
}
"""What the answers of this campaign say of its specimen."""


@pytest.fixture(scope="module")
def fit() -> JointFit:
    return fit_jointly(select_runs(CAMPAIGN), MODEL)


def test_a_foreign_specimens_values_lie_within_their_intervals(fit: JointFit) -> None:
    assert fit.converged
    assert {parameter.name for parameter in fit.parameters} == set(TRUE)
    for parameter in fit.parameters:
        low, high = parameter.interval
        assert low <= TRUE[parameter.name] <= high, parameter


def test_what_runs_tell_apart_is_known_well(fit: JointFit) -> None:
    for combination in fit.combinations:
        powers = next(known.powers for known in MODEL.combinations if known.name == combination.name)
        true = float(np.prod([TRUE[name] ** power for name, power in powers.items()]))
        assert combination.interval[0] <= true <= combination.interval[1], combination
        assert combination.half_width < (0.2 if combination.name == "mucus_shown" else 0.05)


def test_nothing_is_left_where_the_model_is_right(fit: JointFit) -> None:
    assert 0.9 < fit.chi2 / fit.degrees < 1.1
    assert fit.p_value > 0.01


def test_what_no_run_shows_stays_as_it_was_assumed(fit: JointFit) -> None:
    dwell = next(parameter for parameter in fit.parameters if parameter.name == "insertion_dwell_scale")
    assert dwell.learnt < 0.05
    assert dwell.interval == pytest.approx(dwell.prior, rel=0.02)
    assert any("hardly be separated" in remark for remark in fit.remarks)


def test_drags_alone_lead_to_a_minimum_where_the_squares_jump() -> None:
    settings = ["rig.sampling.rate_hz=500", "rig.simulated.seed=7", "travel_mm=-40", "speed_mm_s=[1,5,20,40]"]
    jointly = fit_jointly(select_loaded_runs(dragrig.simulate("drag", assignments=settings)), MODEL)
    assert jointly.converged
    assert jointly.chi2 / jointly.degrees < 1.2


def test_noise_that_was_assumed_excuses_nothing(tmp_path: Path) -> None:
    source, path = CAMPAIGN / "014-drag.h5", tmp_path / "014-drag.h5"
    path.write_bytes(source.read_bytes())
    with h5py.File(path, "r+") as file:
        trace = file["entry/trace"]
        begin = int(np.argmax(trace["phase"][()] > 0))
        for name in list(trace):
            values, attributes = trace[name][()][begin:], dict(trace[name].attrs)
            if name == "force":
                # Too slow for what neighbouring samples differ by, which is all that tells noise without a rest.
                values = values + 15.0 * np.sin(2 * np.pi * np.arange(len(values)) / 700.0)
            del trace[name]
            trace.create_dataset(name, data=values).attrs.update(attributes)
    jointly = fit_jointly(select_runs(tmp_path), MODEL)
    assert isnan(jointly.p_value)
    assert jointly.chi2 / jointly.degrees > 2
    assert any("which was assumed" in remark for remark in jointly.remarks)
    (friction,) = (parameter for parameter in jointly.parameters if parameter.name == "friction_coefficient")
    with_rest = fit_jointly(select_loaded_runs([read_run(source)]), MODEL)
    (known,) = (parameter for parameter in with_rest.parameters if parameter.name == "friction_coefficient")
    assert friction.standard_error > 1.3 * known.standard_error
