"""The rig's effects say in numbers what they are named after."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dragrig.sim_backend.effects.base import EncoderEffect, MotorEffect, SensorEffect, find_effect
from effect_scenes import SESSION_S, changed, scene, sized


def sensor(name: str) -> SensorEffect:
    effect = find_effect(name)
    assert isinstance(effect, SensorEffect)
    return effect


def motor(name: str) -> MotorEffect:
    effect = find_effect(name)
    assert isinstance(effect, MotorEffect)
    return effect


@given(lag_s=st.floats(0.001, 0.2), frequency_hz=st.floats(0.5, 50.0), damping=st.floats(0.2, 0.9))
def test_a_lagging_stage_is_its_lag_behind_at_constant_speed(lag_s: float, frequency_hz: float, damping: float) -> None:
    time = np.arange(0.0, 40.0, 0.01)
    values = {"lag_s": lag_s, "frequency_hz": frequency_hz, "damping": damping}
    moved = motor("servo_lag").stage_position(time, 3.0 * time, values)
    assert 3.0 * time[-1] - moved[-1] == pytest.approx(3.0 * lag_s, rel=1e-3)
    assert moved.min() >= -1e-9


def test_a_lightly_damped_loop_overshoots_and_settles_where_it_should() -> None:
    time = np.arange(0.0, 4.0, 0.001)
    command = np.clip(10.0 * time, 0.0, 5.0)
    values = {"lag_s": 0.02, "frequency_hz": 4.0, "damping": 0.25}
    moved = motor("servo_lag").stage_position(time, command, values)
    assert moved.max() > 5.02
    assert moved[-1] == pytest.approx(5.0, abs=1e-3)


def test_a_ripple_is_a_function_of_position_alone() -> None:
    position = np.linspace(0.0, 20.0, 2001)
    values = {"amplitude_mm": 0.05, "pitch_mm": 4.0, "phase_rad": 0.3}
    fast, slow = (motor("velocity_ripple").stage_position(position / v, position, values) for v in (60.0, 0.5))
    assert fast == pytest.approx(slow)
    ripple = fast - position
    assert ripple[:1600] == pytest.approx(ripple[400:2000], abs=1e-9)
    assert ripple[0] == 0.0
    assert np.ptp(ripple) == pytest.approx(0.1, rel=1e-3)


def test_an_arm_rings_at_its_frequency_when_the_force_steps_and_shows_the_force_in_the_end() -> None:
    seen = scene("coulomb")
    values = {"share": 1.0, "frequency_hz": 10.0, "damping": 0.05, "by_force": 1.0}
    shown = sensor("arm_compliance").measured_force(seen, seen.nominal, values)
    after = seen.slip.since_stop_s
    ringing = (after > 0.01) & (after < 0.5)
    crossings = np.flatnonzero(np.diff(np.sign(shown[ringing])))
    period = 2 * np.median(np.diff(seen.time_s[ringing][crossings]))
    assert period == pytest.approx(0.1, abs=0.004)
    assert shown[-1] == pytest.approx(seen.nominal[-1], abs=0.5)


def test_a_stiff_arm_with_a_mass_is_a_payload() -> None:
    seen = scene("blank")
    stiff = {"share": 0.03, "frequency_hz": 100.0, "damping": 0.7, "by_force": 0.0}
    arm = changed(find_effect("arm_compliance"), seen, stiff)
    payload = changed(find_effect("payload_inertia"), seen, {"mass_g": 30.0, "lag_s": 0.0})
    assert payload.max() == pytest.approx(30e-3 * 400.0)
    late = np.diff(seen.acceleration_mm_s2, prepend=0.0) == 0
    assert arm[late].max() == pytest.approx(payload.max(), rel=0.1)
    assert arm @ payload > 0.8 * np.linalg.norm(arm) * np.linalg.norm(payload)


def test_a_loop_of_force_is_as_wide_as_the_play_says() -> None:
    effect = sensor("force_hysteresis")
    up = np.linspace(0.0, 300.0, 601)
    force = np.concatenate((up, up[::-1]))
    shown = effect.measured_force(scene("blank"), force, {"half_width_mN": 7.0, "reversal_mN": 10.0})
    assert shown[300] == pytest.approx(force[300] - 7.0, abs=1e-3)
    assert shown[-301] == pytest.approx(force[-301] + 7.0, abs=1e-3)


def test_the_force_comes_as_much_later_as_its_channel_is_late() -> None:
    seen = scene("drag")
    effect = sensor("channel_latency")
    late = effect.measured_force(seen, seen.nominal, {"latency_s": 0.02})
    early = effect.measured_force(seen, seen.nominal, {"latency_s": -0.02})
    assert late[10:] == pytest.approx(seen.nominal[:-10])
    assert early[:-10] == pytest.approx(seen.nominal[10:])


def test_hum_is_on_the_session_s_clock() -> None:
    seen = scene("blank")
    values = {"amplitude_mN": 4.0, "frequency_hz": 50.0, "phase_rad": 0.7}
    hum = changed(find_effect("mains_hum"), seen, values)
    assert hum[0] == pytest.approx(4.0 * np.sin(2 * np.pi * 50.0 * SESSION_S + 0.7))
    assert hum[10:] == pytest.approx(hum[:-10], abs=1e-6)  # 10 samples of 2 ms


@pytest.mark.parametrize("warm_up_s", [2.0, 30.0, 3000.0])
def test_the_zero_has_crept_by_what_is_said_after_a_minute(warm_up_s: float) -> None:
    seen = scene("relaxation")
    crept = changed(find_effect("force_drift"), seen, {"drift_mN_min": 12.0, "warm_up_s": warm_up_s})
    assert crept[0] == 0.0
    assert (np.diff(crept) >= 0).all()
    whole = 12.0 * (1 - np.exp(-seen.time_s[-1] / warm_up_s)) / (1 - np.exp(-60.0 / warm_up_s))
    assert crept[-1] == pytest.approx(whole)


def test_gain_and_scale_are_off_by_what_is_said() -> None:
    force = np.array([-500.0, 0.0, 250.0, 500.0])
    shown = sensor("force_nonlinearity").measured_force(scene("blank"), force, {"gain_error": 0.08, "power": 1.0})
    assert shown == pytest.approx([-540.0, 0.0, 260.0, 540.0])
    encoder = find_effect("encoder_scale")
    assert isinstance(encoder, EncoderEffect)
    assert encoder.counted_position(force, force, sized(encoder, 1.0)) == pytest.approx(1.002 * force)


def test_a_drive_that_runs_heavier_one_way_does_so_by_twice_the_asymmetry() -> None:
    effect = find_effect("direction_asymmetry")
    seen = scene("coulomb")
    added = changed(effect, seen, {"asymmetry": 0.1})
    assert added == pytest.approx(0.1 * np.abs(seen.nominal))
    assert effect.nominal == "drive"


@given(play_mm=st.floats(0.01, 2.0), taken_up=st.floats(0.0, 1.0))
def test_backlash_leaves_the_payload_behind_by_the_play_after_each_reversal(play_mm: float, taken_up: float) -> None:
    time = np.arange(0.0, 4.0, 0.001)
    command = 10.0 * np.abs(1.0 - np.abs(time % 2.0 - 1.0))
    values = {"play_mm": play_mm, "taken_up": taken_up}
    moved = motor("backlash").stage_position(time, command, values)
    forwards, backwards, again = (float((moved - command)[round(1000 * at)]) for at in (0.9, 1.9, 2.9))
    assert moved[0] == command[0]
    assert forwards == pytest.approx(-play_mm * (1.0 - taken_up), abs=1e-9)
    assert backwards - forwards == pytest.approx(play_mm, abs=1e-9)
    assert again == pytest.approx(forwards, abs=1e-9)
    faster = motor("backlash").stage_position(0.1 * time, command, values)
    assert (faster == moved).all()
