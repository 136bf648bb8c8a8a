"""How fine a record of the position is and how far it wanders at rest decide what is a motion and what is not."""

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dragrig
from diagnosed import UNADVISED, DiagnosedCampaigns
from dragrig.analysis.gap.diagnose import diagnose
from dragrig.analysis.gap.diagnosis import Verdict
from dragrig.analysis.gap.position_channel import position_errors
from dragrig.analysis.gap.run_data import choose_runs
from dragrig.analysis.models.capsule_model import MODEL
from dragrig.analysis.models.experiment import (
    MAX_WANDER_MM,
    MIN_COUNT_MM,
    Experiment,
    encoder_count_mm,
    position_wander_mm,
)
from dragrig.analysis.selection import RunSelection
from dragrig.rig.profile import FloatArray
from friction_cases import moves
from hidden import hidden
from property_tests import examples, thorough

RATE_HZ = 500.0
STROKE = moves((20.0, 5.0), (-20.0, 40.0), between=2.0)

Change = Callable[[FloatArray, np.random.Generator], FloatArray]


def stroke() -> tuple[FloatArray, FloatArray]:
    time = np.arange(STROKE.samples(RATE_HZ)) / RATE_HZ
    return time, STROKE.position(time)


def noisy(sd_mm: float) -> Change:
    return lambda position, random: position + random.normal(0.0, sd_mm, position.size)


def counted(count_mm: float) -> Change:
    return lambda position, random: np.round(position / count_mm) * count_mm


def dithering(amplitude_mm: float) -> Change:
    """Swing as a servo does that hunts for its place, at 23 Hz."""

    def changed(position: FloatArray, random: np.random.Generator) -> FloatArray:
        time = np.arange(position.size) / RATE_HZ
        return counted(MIN_COUNT_MM)(
            position + amplitude_mm * np.sin(2 * np.pi * (23 * time + random.random())), random
        )

    return changed


def with_position(
    selection: RunSelection, folder: Path, change: Change, count_mm: float = MIN_COUNT_MM
) -> RunSelection:
    """Record the same campaign with another encoder, of counts of `count_mm`."""
    folder.mkdir()
    random = np.random.default_rng(1)
    for experiment in selection.experiments:
        path = Path(shutil.copy(experiment.run.info.path, folder))
        with h5py.File(path, "r+") as file:
            position = file["entry/trace/position"]
            position[...] = change(np.asarray(position[...], dtype=np.float64), random)
            file["entry/settings"] = f"[rig.encoder]\nresolution_um = {1e3 * count_mm}\n"
    return choose_runs(folder)


@pytest.mark.parametrize(
    ("settings_toml", "count_mm"),
    [
        ("[rig.encoder]\nresolution_um = 5.0\n", 0.005),
        ("[rig.encoder]\nresolution_um = 0.1\n", MIN_COUNT_MM),
        ("[rig.encoder]\nresolution_um = -5\n", MIN_COUNT_MM),
        ("[rig.encoder]\nresolution_um = 'coarse'\n", MIN_COUNT_MM),
        ("rig = 3\n", MIN_COUNT_MM),
        ("[rig]\nname = 'ours'\n", MIN_COUNT_MM),
        ("[rig", MIN_COUNT_MM),
        ("", MIN_COUNT_MM),
    ],
)
def test_the_encoders_count_is_what_the_settings_of_the_run_say(settings_toml: str, count_mm: float) -> None:
    assert encoder_count_mm(settings_toml) == count_mm


def test_the_settings_of_a_run_are_read_as_they_are_written() -> None:
    passed, coarse = (
        choose_runs(dragrig.simulate("drag", assignments=[f"rig.encoder.resolution_um={um}"])) for um in (1.0, 5.0)
    )
    assert {experiment.count_mm for experiment in passed.experiments} == {0.001}
    assert {experiment.count_mm for experiment in coarse.experiments} == {0.005}
    assert all(experiment.follows_command for experiment in coarse.experiments)


@given(st.floats(0.0005, 0.003), st.booleans())
@settings(max_examples=examples(30), deadline=None)
def test_the_wander_is_six_standard_deviations_of_noise(sd_mm: float, knows_command: bool) -> None:
    time, command = stroke()
    position = noisy(sd_mm)(command, np.random.default_rng(3))
    assert position_wander_mm(time, position, command if knows_command else None) == pytest.approx(6 * sd_mm, rel=0.15)


def test_what_a_stage_does_as_it_comes_to_rest_is_no_wander() -> None:
    time, command = stroke()
    ringing = 0.1 * np.exp(-np.maximum(time - 5.5, 0.0) / 0.3) * np.sin(60 * np.maximum(time - 5.5, 0.0))
    position = counted(MIN_COUNT_MM)(command + ringing, np.random.default_rng())
    assert position_wander_mm(time, position, command) == position_wander_mm(
        time, counted(MIN_COUNT_MM)(command, np.random.default_rng()), command
    )
    assert position_wander_mm(time, noisy(0.1)(command, np.random.default_rng(0)), command) == MAX_WANDER_MM


@pytest.fixture
def stribeck(diagnosed: DiagnosedCampaigns) -> RunSelection:
    return diagnosed["stribeck"].selection


@pytest.fixture(scope="module")
def lagging(tmp_path_factory: pytest.TempPathFactory) -> RunSelection:
    return hidden(tmp_path_factory.mktemp("lag"), 14, "servo_lag", every=4)


ENCODERS = {
    "0.5 µm": (noisy(0.0005), MIN_COUNT_MM),
    "1 µm": (noisy(0.001), MIN_COUNT_MM),
    "2 µm": (noisy(0.002), MIN_COUNT_MM),
    "3 µm": (noisy(0.003), MIN_COUNT_MM),
    "dither": (dithering(0.004), MIN_COUNT_MM),
    "5 µm counts": (counted(0.005), 0.005),
    "10 µm counts": (counted(0.01), 0.01),
}


@pytest.mark.parametrize(
    "encoder", [name if name in {"dither", "10 µm counts"} else thorough(name) for name in ENCODERS]
)
def test_a_stage_with_a_coarse_or_noisy_encoder_still_obeys(
    stribeck: RunSelection, tmp_path: Path, encoder: str
) -> None:
    selection = with_position(stribeck, tmp_path / "other", *ENCODERS[encoder])
    moved = [experiment for experiment in selection.experiments if experiment.follows_command]
    assert len(moved) == len(selection.experiments)
    assert not any(position_error.has_position_error for position_error in position_errors(selection.experiments))


@pytest.mark.thorough
@pytest.mark.parametrize("encoder", ["2 µm", "10 µm counts"])
def test_such_an_encoder_does_not_change_the_verdict(stribeck: RunSelection, tmp_path: Path, encoder: str) -> None:
    diagnosis = diagnose(with_position(stribeck, tmp_path / "other", *ENCODERS[encoder]), MODEL, UNADVISED)
    assert (diagnosis.verdict, diagnosis.effects) == (Verdict.EFFECT, ("stribeck",))


@pytest.mark.parametrize("encoder", [thorough("1 µm"), thorough("3 µm"), "10 µm counts"])
def test_a_stage_that_lags_moves_no_more_often_for_its_encoder(
    lagging: RunSelection, tmp_path: Path, encoder: str
) -> None:
    """Every wobble that counts as a turn has a contact of its own, which costs time and memory without end."""
    before, after = lagging.experiments, with_position(lagging, tmp_path / "other", *ENCODERS[encoder]).experiments
    assert any(position_error.has_position_error for position_error in position_errors(after))
    straying = [(entry, second) for entry, second in zip(before, after, strict=True) if not second.follows_command]
    assert len(straying) > len(before) / 2
    for entry, second in straying:
        assert second.motion.breaks_s.size <= entry.motion.breaks_s.size + 4
        assert second.motion.profile.breaks_s.size <= entry.motion.profile.breaks_s.size + 4
        assert rests_of(second) == pytest.approx(rests_of(entry), abs=0.3)


def rests_of(first: Experiment) -> float:
    return float(np.diff(first.motion.breaks_s)[first.motion.signs == 0].sum())
