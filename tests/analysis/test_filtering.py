"""The filter of run files."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from dragrig.analysis.savgol import SavgolSettings, default_filter_settings, filter_file, filter_run, smooth
from dragrig.config.errors import AnalysisError
from dragrig.rig.runfile import read_run, verify
from dragrig.rig.runfile.model import Run
from places import CAMPAIGN

DRAG, RELAXATION = CAMPAIGN / "014-drag.h5", CAMPAIGN / "001-relaxation.h5"


def with_gap(run: Run, keep: list[slice]) -> Run:
    """Lose the samples outside of some slices, as a sampler does: the time jumps."""
    concatenate = np.concatenate([np.arange(len(run.trace.time))[piece] for piece in keep])
    trace = run.trace
    channels = {name: values[concatenate] for name, values in trace.channels.items()}
    shorter = replace(
        trace,
        time=trace.time[concatenate],
        command=trace.command[concatenate],
        phase=trace.phase[concatenate],
        channels=channels,
    )
    return replace(run, trace=shorter)


def test_force_is_smoothed_and_speed_measured() -> None:
    run = read_run(DRAG)
    filtered = filter_run(run).trace
    trace = run.trace
    assert set(filtered.channels) == {"force", "speed"}
    assert filtered.units["force"] == "mN"
    assert filtered.units["speed"] == "mm/s"
    assert filtered.parameters["window_samples"] == 25
    assert filtered.parameters["order"] == 3
    rest = np.asarray(trace.force[:500], dtype=np.float64)
    jumps = np.std(np.diff(rest)) / np.std(np.diff(filtered.channels["force"][:500]))
    assert jumps > 5
    steady = trace.phase == 2
    assert np.abs(filtered.channels["speed"][steady][25:-25] - 60).max() < 0.05
    assert np.abs(filtered.channels["speed"][:480]).max() < 0.05


def test_white_noise_comes_down_three_times_at_the_usual_setting() -> None:
    white = np.random.default_rng(2).normal(0, 1.5, 50_000)
    for rate in (500.0, 1000.0):
        assert white.std() / smooth(white, rate, default_filter_settings(rate)).values.std() > 3


def test_a_filtered_run_keeps_its_raw_trace_and_what_the_filter_said(tmp_path: Path) -> None:
    path = Path(shutil.copy(RELAXATION, tmp_path))
    before = read_run(path)
    filtered = filter_file(path)
    after = read_run(path)
    np.testing.assert_array_equal(after.trace.force, before.trace.force)
    assert after.filtered is not None
    np.testing.assert_array_equal(after.filtered.channels["force"], filtered.trace.channels["force"])
    assert after.filtered.parameters["window_s"] == 0.05
    assert any("short beside the window" in event.message for event in after.events)
    filter_file(path, SavgolSettings(window_samples=11, order=2))
    again = read_run(path)
    assert again.filtered is not None
    assert again.filtered.parameters["window_samples"] == 11
    assert verify(path).stored == verify(path).computed or not verify(path).stored
    with h5py.File(path) as file:
        assert file["entry/filtered"].attrs["NX_class"] == "NXdata"
        assert file["entry/filtered"].attrs["signal"] == "force"


def test_gaps_are_not_crossed_and_short_pieces_said_once() -> None:
    run = with_gap(read_run(DRAG), [slice(0, 600), slice(700, 710), slice(800, None)])
    result = filter_run(run)
    force = result.trace.channels["force"]
    assert np.flatnonzero(np.isnan(force)).tolist() == list(range(600, 610))
    (event,) = (event for event in result.events if "shorter than the window" in event.message)
    assert event.time_s == run.trace.time[600]
    assert result.trace.parameters["unfiltered_samples"] == 10
    assert "10 samples" in str(result.trace.parameters["remarks"])


def test_a_derivative_has_its_unit_and_leaves_the_speed_alone() -> None:
    run = read_run(DRAG)
    filtered = filter_run(run, SavgolSettings(window_s=0.05, order=2, derivative=1)).trace
    assert filtered.units["force"] == "mN/s^1"
    assert filtered.units["speed"] == "mm/s"
    level = filter_run(run, SavgolSettings(window_s=0.05, order=0)).trace
    assert np.abs(level.channels["speed"][600:800] - 60).max() < 0.05


def test_a_low_rate_gets_a_longer_usual_window() -> None:
    assert default_filter_settings(7.4).samples(7.4) == 7
    assert default_filter_settings(500.0).samples(500.0) == 25


def test_a_window_that_does_not_fit_names_the_run() -> None:
    with pytest.raises(AnalysisError, match=r"014-drag\.h5: A filter window of 9001 samples is longer than the whole"):
        filter_run(read_run(DRAG), SavgolSettings(window_samples=9001))


def test_naming_the_filter_loads_no_heavy_library() -> None:
    script = (
        "import sys, dragrig.analysis as a, dragrig.analysis.importing\n"
        "a.SavgolSettings, a.filter_run, a.measure, a.export_run, a.TableRow, a.SavgolStream, a.__all__\n"
        "print([m for m in ('scipy', 'pandas', 'h5py', 'pyarrow', 'pydantic', 'nptdms') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
