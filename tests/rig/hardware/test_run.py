"""Whole sessions through the real rig's code, on doubles of card and drive: what a newcomer sees with `--double`."""

import gc
import io
import json
import sys
import threading
from ctypes.util import find_library
from pathlib import Path

import numpy as np
import pytest

import dragrig
from dragrig.cli import main
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import BackendRequest
from dragrig.rig.operator import Answer, NullOperator, Prompt
from dragrig.rig.runfile import read_campaign
from dragrig.rig.runfile.model import Run, RunStatus
from dragrig.sim_backend.doubles.backend import DoubleBackend

pytestmark = pytest.mark.usefixtures("finished_here")

PLAN = """
name = "short"

[[steps]]
kind = "relaxation"
shear_strain = 0.5
ramp_speed_mm_s = 10.0
hold_s = 0.5
wait_s = 2.0
rest_s = 0.3
prompt = "Fit a specimen"

[[steps]]
kind = "drag"
speed_mm_s = 10.0
travel_mm = 10.0
hold_s = 0.5
wait_s = 2.0
rest_s = 0.3
prompt = "Lay the gut on the foam"
"""
SWIFT = (
    "rig.hardware.drive.homing_speed_mm_s=50",
    "rig.stage.start_mm=5",
    # A busy machine may start a motion late by a good part of a second.
    "rig.guard.following_error_mm=50",
    "rig.guard.encoder_silent_mm=50",
    "rig.guard.stale_data_s=5",
    "rig.hardware.hang_s=5",
    "rig.hardware.drive.reply_s=2",
    "rig.hardware.drive.silence_s=5",
)
NOISE_MN = 1.6


class Hands(NullOperator):
    def __init__(self) -> None:
        self.prompts: list[str] = []

    def ask(self, prompt: Prompt) -> Answer:
        self.prompts.append(prompt.text)
        return Answer.DONE


@pytest.fixture
def plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "short.toml"
    path.write_text(PLAN, "utf-8")
    return path


def lateness_s(first: Run, second: Run) -> float:
    half = 0.5 * float(second.trace.position[-1])
    times = []
    for run in (first, second):
        way = run.trace.position * np.sign(half)
        times.append(float(np.interp(abs(half), np.maximum.accumulate(way), run.trace.time)))
    return times[0] - times[1]


def test_a_plan_on_the_doubles_gives_the_simulated_rigs_files_to_within_noise(plan: Path) -> None:
    hands = Hands()
    real = dragrig.run(plan, backend="hardware", double=True, pace=2.0, out="real", person=hands, assignments=SWIFT)
    real.session.require()
    simulated = dragrig.run(plan, backend="simulated", out="simulated", assignments=SWIFT)
    assert len([text for text in hands.prompts if text in {"Fit a specimen", "Lay the gut on the foam"}]) == 2
    pairs = list(zip(read_campaign(Path("real")).runs, read_campaign(Path("simulated")).runs, strict=True))
    assert [run.kind for run, _ in pairs] == ["relaxation", "return", "drag", "return"]
    for one_info, other_info in pairs:
        run, second = dragrig.load(one_info.path), dragrig.load(other_info.path)
        assert one_info.status is other_info.status is RunStatus.COMPLETE
        assert one_info.samples == other_info.samples
        assert one_info.checks["lost_samples"] == 0
        late = lateness_s(run, second)
        assert abs(late) <= float(one_info.header.entry["command_t0_uncertainty_s"]) + 0.002
        at = second.trace.time + late
        sampled = at <= run.trace.time[-1]
        position = np.interp(at, run.trace.time, run.trace.position)
        np.testing.assert_allclose(position[sampled], second.trace.position[sampled], atol=0.004)
        changes = second.trace.time[1:][np.diff(second.trace.phase.astype(int)) != 0]
        quiet = np.abs(second.trace.time[:, None] - changes).min(axis=1) > 0.05
        quiet &= sampled
        off = (np.interp(at, run.trace.time, run.trace.force) - second.trace.force)[quiet]
        assert abs(float(off.mean())) < 1.5 * NOISE_MN
        assert float(off.std()) < 2 * NOISE_MN
    assert simulated.session.status is RunStatus.COMPLETE
    entry = pairs[0][0].header.entry
    assert str(entry["anti_alias_filter"]).startswith("low-pass FIR of 251 taps at 25 times the recorded rate")
    assert (entry["scan_order"], entry["card_rate_hz"]) == ("force", 25_000.0)
    assert (pairs[0][0].header.backend, entry["double"], entry["card_product"]) == ("simulated", "hardware", "PCI-6229")
    assert "inserted_at" in entry


def test_yes_never_answers_what_asks_for_hands(
    plan: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", str(plan), "--backend", "hardware", "--double", "--yes", "--json", "--out", "c"]
    monkeypatch.setattr(sys, "stdin", io.StringIO("d\n"))
    code = main([*words, *(word for entry in SWIFT for word in ("--set", entry))])
    output = capsys.readouterr()
    assert code == 3
    assert json.loads(output.out)["runs"] == []
    assert "hands" in output.err


@pytest.mark.skipif(find_library("nidaqmx") is not None, reason="this computer has NI's driver")
def test_the_rig_without_its_driver_says_in_one_sentence_what_to_install(
    plan: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", str(plan), "--backend", "hardware"]) == 5
    errors = capsys.readouterr().err
    assert "NI-DAQmx" in errors
    assert "install" in errors
    assert "--double" in errors
    assert "\n" not in errors.strip()


def test_a_connected_rig_is_held_by_no_long_garbage_collection(monkeypatch: pytest.MonkeyPatch) -> None:
    collect, running, thawed = gc.collect, [], []

    def collected() -> int:
        running.append([thread.name for thread in threading.enumerate()])
        return collect()

    monkeypatch.setattr(gc, "collect", collected)
    monkeypatch.setattr(gc, "unfreeze", lambda: thawed.append(True))
    request = BackendRequest(RigSettings(), FrictionModelSettings())
    frozen_before = gc.get_freeze_count()
    objects: list[list[None]] = [[] for _ in range(10_000)]
    double = DoubleBackend(request)
    try:
        assert gc.get_freeze_count() >= frozen_before + len(objects)
        # Nor is the drive that is already monitored, whose heartbeat relay would open.
        assert "drive monitor" in [thread.name for thread in threading.enumerate()]
        (names,) = running
        assert "drive monitor" not in names
        assert not thawed
    finally:
        double.close()
    assert thawed
