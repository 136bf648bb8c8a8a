"""The bench behind the doubles: what card and drive see of it is what the simulated rig records."""

import threading

import numpy as np
import pytest

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.rig.profile import FloatArray, Piece
from dragrig.sim_backend.doubles.simulated_bench import CONVERTER_NOISE, SWITCH_OFFSET_MM, DoubleClock, SimulatedBench
from simulated import NEVER, acquire, record, session, settings, stroke

RATE = 1000.0
PROFILE = stroke(travel_mm=20.0, speed_mm_s=40.0, rest_s=0.2, hold_s=0.3)


def new_bench(pace: float = 5.0, **groups: object) -> SimulatedBench:
    return SimulatedBench(settings(**groups), FrictionModelSettings(), DoubleClock(pace))


def moving_part() -> tuple[Piece, ...]:
    return tuple(piece for piece in PROFILE.pieces() if piece.acceleration_mm_s2 or piece.phase == 2)


def sampled(bench: SimulatedBench, samples: int) -> dict[str, FloatArray]:
    while bench.available() < samples:
        threading.Event().wait(0.01)
    return dict(bench.sample(0, samples))


def test_a_stroke_gives_what_the_simulated_rig_records_but_for_when_it_began() -> None:
    expected = record(session(), acquire(PROFILE))
    bench = new_bench()
    bench.present(acquire(PROFILE))
    bench.begin_sampling(RATE)
    bench.clock.sleep(0.2, NEVER)
    bench.follow(moving_part())
    samples = PROFILE.samples(RATE)
    got = sampled(bench, samples)
    late = int(np.argmax(got["encoder_counts"] > 0)) - int(np.argmax(expected["position"] > 0))
    assert 0 <= late < 0.2 * RATE
    np.testing.assert_allclose(got["force_V"][:200] * 1000, expected["force"][:200], atol=6e4 * CONVERTER_NOISE)
    moved = slice(late, samples)
    off = got["encoder_counts"][moved] / 1000 - expected["position"][: samples - late]
    assert np.abs(off).max() <= 40.0 / RATE + 0.002
    steady = got["force_V"][late + 450 : late + 650].mean() * 1000
    assert steady == pytest.approx(expected["force"][450:650].mean(), abs=1.0)


def test_samples_are_there_once_they_are_taken_and_not_before() -> None:
    bench = new_bench()
    with pytest.raises(ValueError, match="were not taken"):
        bench.sample(0, 1)
    bench.begin_sampling(RATE)
    with pytest.raises(ValueError, match="were not taken"):
        bench.sample(0, bench.available() + 100_000)
    assert len(sampled(bench, 50)["force_V"]) == 50
    bench.end_sampling()
    assert bench.available() == 0


def test_a_read_of_the_same_samples_again_gives_the_same() -> None:
    bench = new_bench()
    bench.begin_sampling(RATE)
    whole = sampled(bench, 200)
    again = bench.sample(50, 150)
    for name, values in again.items():
        np.testing.assert_array_equal(values, whole[name][50:150])


def test_braking_ends_the_motion_where_the_deceleration_says() -> None:
    bench = new_bench(pace=1.0)
    bench.place(10.0)
    bench.follow(moving_part())
    bench.clock.sleep(0.15, NEVER)
    speed, position = bench.speed_mm_s(), bench.position_mm()
    bench.brake(200.0)
    bench.clock.sleep(0.4, NEVER)
    assert not bench.moving
    assert speed > 0
    assert position < bench.position_mm() < 30.0
    assert bench.position_mm() == pytest.approx(position + speed**2 / 400.0, abs=2.0)


def test_limit_switches_open_beyond_the_soft_limits_and_wires_read_high_else() -> None:
    bench = new_bench()
    lines = bench.rig.hardware.card.lines
    assert [bench.read_line(line) for line in (lines.e_stop, lines.limit_low, lines.limit_high)] == [True] * 3
    bench.place(bench.rig.stage.lowest_mm - SWITCH_OFFSET_MM)
    assert not bench.read_line(lines.limit_low)
    bench.place(bench.rig.stage.highest_mm + SWITCH_OFFSET_MM)
    assert not bench.read_line(lines.limit_high)
    bench.faults.inject(e_stop_pressed=True)
    assert not bench.read_line(lines.e_stop)
    bench.write_line(lines.enable, True)
    assert bench.read_line(lines.enable)


def test_long_waits_are_passed_over_only_while_nothing_happens() -> None:
    bench = new_bench(pace=1.0)
    before = bench.clock.monotonic()
    assert bench.clock.sleep(3600.0, NEVER)
    assert bench.clock.monotonic() - before >= 3600.0
    bench.begin_sampling(RATE)
    cancel = threading.Event()
    timer = threading.Timer(0.05, cancel.set)
    timer.start()
    assert not bench.clock.sleep(3600.0, cancel)
    timer.join()


def test_mishaps_of_sensor_and_encoder_show_in_the_samples() -> None:
    bench = new_bench()
    bench.begin_sampling(RATE)
    sampled(bench, 50)
    bench.faults.inject(force_added_mN=2000.0)
    first = bench.available()
    while bench.available() < first + 50:
        threading.Event().wait(0.01)
    assert bench.sample(first, first + 50)["force_V"].mean() == pytest.approx(2.0, abs=0.05)
    bench.faults.inject(sensor_open=True)
    first = bench.available()
    while bench.available() < first + 50:
        threading.Event().wait(0.01)
    np.testing.assert_allclose(bench.sample(first, first + 50)["force_V"], 10.0, atol=60 * CONVERTER_NOISE)
