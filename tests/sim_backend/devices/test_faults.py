"""Faults of the simulated rig show where a real one's would, and time in it behaves."""

import threading
import time
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from dragrig.config.errors import DeviceError, StaleDataError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import BackendRequest, Contact, Trip, TripCause
from dragrig.sim_backend.devices import open_backend
from sim_faults import DriveFault, Faults, FollowError, ForceSpike, LostSamples, Runaway, StaleData, StuckEncoder
from simulated import NEVER, acquire, begin, blocks, record, rest, session, settings, stroke

RUN = acquire(stroke(travel_mm=40.0, speed_mm_s=50.0, rest_s=0.1, hold_s=0.2))


def test_no_setting_can_cause_a_fault() -> None:
    words = str(RigSettings.model_json_schema()).lower()
    assert not [word for word in ("runaway", "stuck", "spike", "faults") if word in words]


def test_follow_error_shifts_the_encoder() -> None:
    healthy = record(session(), RUN)["position"]
    ill = record(session(faults=Faults(follow_error=FollowError(0.4, -2.0, ramp_s=0.1))), RUN)["position"]
    np.testing.assert_array_equal(ill[:400], healthy[:400])
    np.testing.assert_allclose(ill[500:] - healthy[500:], -2.0, atol=0.0011)


def test_stuck_encoder_repeats_itself_while_the_stage_goes_on() -> None:
    backend = session(faults=Faults(stuck_encoder=StuckEncoder(0.4)))
    position = record(backend, RUN)["position"]
    assert np.ptp(position[400:]) == 0
    assert np.ptp(position[:400]) > 5.0
    assert backend.stage.state().position_mm == pytest.approx(40.0)


def test_runaway_leaves_the_profile_until_stopped() -> None:
    backend = session(faults=Faults(runaway=Runaway(0.3, 90.0)))
    begin(backend, RUN)
    got = []
    for block in blocks(backend):
        got.append(block)
        if block.end_index == 500:
            backend.stage.stop()
    position = np.concatenate([block.channels["position"] for block in got])
    assert (position[480] - position[400]) / 0.08 == pytest.approx(90.0, abs=0.1)
    assert position[-1] - position[-2] <= 0.001
    assert len(position) < 500 + 50


def test_runaway_ends_at_the_hard_stop_beyond_the_limits() -> None:
    rig = settings(stage={"highest_mm": 50.0, "start_mm": 0.0})
    position = record(session(rig, Faults(runaway=Runaway(0.3, 90.0))), acquire(stroke(40.0, hold_s=2.0)))["position"]
    assert position[-1] == pytest.approx(55.0, abs=0.1)
    back = record(session(rig, Faults(runaway=Runaway(0.3, -90.0))), acquire(stroke(40.0, hold_s=2.0)))["position"]
    assert back[-1] == pytest.approx(-5.0, abs=0.1)


def test_lost_samples_leave_a_gap_in_the_index_and_nothing_else() -> None:
    healthy = record(session(), RUN)
    ill = record(session(faults=Faults(lost_samples=LostSamples(0.423, 37))), RUN)
    missing = np.setdiff1d(healthy.index, ill.index)
    np.testing.assert_array_equal(missing, np.arange(423, 460))
    isin = np.isin(healthy.index, ill.index)
    for name in ("force", "position", "motor_force"):
        np.testing.assert_array_equal(ill[name], healthy[name][isin])


def test_lost_samples_across_a_chunk_keep_the_noise_in_step() -> None:
    long = acquire(rest(2.0), contact=Contact.NONE)
    healthy = record(session(settings(25_000.0)), long)
    ill = record(session(settings(25_000.0), Faults(lost_samples=LostSamples(0.5, 9_000))), long)
    isin = np.isin(healthy.index, ill.index)
    assert isin.sum() == 50_000 - 9_000
    np.testing.assert_array_equal(ill["force"], healthy["force"][isin])


def test_stale_data_are_reported_after_the_guards_time() -> None:
    backend = session(settings(guard={"stale_data_s": 0.3}), Faults(stale_data=StaleData(0.42)))
    begin(backend, RUN)
    before = backend.clock.monotonic()
    got = []
    with pytest.raises(StaleDataError, match=r"0\.3 s"):
        got.extend(blocks(backend))
    begin_again = before + 0.42 + 0.3
    assert backend.clock.monotonic() == pytest.approx(begin_again, abs=1e-6)
    backend.stage.stop()
    assert backend.stage.state().position_mm > 0.0


def test_a_short_silence_delays_and_loses_nothing() -> None:
    healthy = record(session(), RUN)
    assert record(session(faults=Faults(stale_data=StaleData(0.42, 0.1))), RUN).same_as(healthy)


def test_drive_fault_brakes_tells_and_needs_switching_off() -> None:
    backend = session(faults=Faults(drive_fault=DriveFault(0.4, "overtemperature")))
    faults_seen = []
    got = record(backend, RUN, lambda _: faults_seen.append(backend.stage.state().fault))
    assert faults_seen[:7] == [None] * 7
    assert set(faults_seen[8:]) == {Trip(TripCause.DRIVE_FAULT, "the drive reports overtemperature")}
    position = got["position"]
    assert np.ptp(position[430:]) <= 0.001
    assert position[-1] < 40.0
    with pytest.raises(DeviceError, match="overtemperature"):
        backend.stage.move(stroke())
    with pytest.raises(DeviceError, match="overtemperature"):
        backend.stage.enable()
    backend.stage.disable()
    backend.stage.enable()
    assert backend.stage.state().fault is None
    backend.stage.move(stroke())


def test_a_drive_fault_that_nobody_saw_stays() -> None:
    faults = Faults(drive_fault=DriveFault(0.4), affects=lambda acquisition: acquisition is RUN)
    backend = session(faults=faults)
    record(backend, RUN)
    backend.sampler.arm(acquire(rest(0.1), kind="tare"))
    backend.sampler.start()
    list(blocks(backend))
    assert backend.stage.state().fault == Trip(TripCause.DRIVE_FAULT, "the drive reports simulated overcurrent")


def test_force_spike_is_on_the_force_alone() -> None:
    healthy = record(session(), RUN)
    ill = record(session(faults=Faults(force_spike=ForceSpike(0.4, 500.0, 0.05))), RUN)
    struck = ill["force"] - healthy["force"]
    np.testing.assert_allclose(struck[400:450], 500.0, atol=0.31)
    assert np.count_nonzero(struck) == 50
    np.testing.assert_array_equal(ill["motor_force"], healthy["motor_force"])


def test_faults_strike_only_the_chosen_acquisitions() -> None:
    faults = Faults(drive_fault=DriveFault(0.0), affects=lambda acquisition: acquisition.order == 1)
    backend = session(faults=faults)
    record(backend, acquire(stroke(), order=0))
    assert backend.stage.state().fault is None
    record(backend, acquire(stroke(), order=1))
    assert backend.stage.state().fault


def test_a_virtual_session_lasts_as_long_as_its_samples_and_begins_at_its_origin() -> None:
    origin = datetime(2026, 3, 1, 9, 0, tzinfo=UTC)
    backend = open_backend(BackendRequest(settings(), FrictionModelSettings(), origin=origin))
    backend.stage.enable()
    backend.stage.home()
    assert backend.clock.now() == origin
    record(backend, acquire(stroke(hold_s=600.0)))
    assert backend.clock.sleep(3600.0, NEVER)
    expected = timedelta(seconds=3600 + stroke(hold_s=600.0).duration_s)
    assert abs(backend.clock.now() - origin - expected) < timedelta(milliseconds=1)
    gone = threading.Event()
    gone.set()
    before = backend.clock.monotonic()
    assert not backend.clock.sleep(5.0, gone)
    assert backend.clock.monotonic() == before


def test_real_pace_does_not_drift() -> None:
    backend = session(settings(sampling={"block_s": 0.01}), real_time=True)
    profile = stroke(hold_s=0.4)
    begin(backend, acquire(profile))
    began = time.monotonic()
    late, stall_s = [], 0.0
    for block in blocks(backend):
        now = time.monotonic()
        late.append(now - began - block.end_index / 1000.0)
        time.sleep(0.004)
        stall_s += time.monotonic() - now - 0.004
    assert min(late) > -0.002
    assert min(late[-10:]) < 0.1 + stall_s
