"""The simulated rig's arrays repeat bit by bit, whatever the blocks, the pace and what came before."""

import threading
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import settings as fewer
from hypothesis import strategies as st

from dragrig.rig.devices import Contact
from dragrig.sim_backend.devices.simulated_stage import evaluate_profile, profile_position
from property_tests import examples
from simulated import Recorded, acquire, begin, blocks, record, rest, session, settings, stroke

FAST = 25_000.0
"""A rate [Hz] at which a run of 2.5 s spans several chunks."""
LONG_RUN = acquire(stroke(travel_mm=80.0, rest_s=0.4, hold_s=0.5), order=3)
EFFECTS = (
    "stribeck",
    "servo_lag:lag_s=0.02",
    "velocity_ripple:pitch_mm=7",
    "arm_compliance",
    "force_hysteresis",
    "mains_hum",
    "encoder_scale",
)


@pytest.fixture(scope="module")
def reference() -> Recorded:
    return record(session(settings(FAST)), LONG_RUN)


@pytest.fixture(scope="module")
def affected() -> Recorded:
    return record(session(settings(FAST), effects=EFFECTS), LONG_RUN)


@given(block_s=st.floats(0.002, 0.05), with_tare=st.booleans(), others=st.integers(0, 2))
def test_arrays_do_not_depend_on_blocks_or_history(
    reference: Recorded, block_s: float, with_tare: bool, others: int
) -> None:
    rig = settings(sampling={"rate_hz": FAST, "block_s": block_s})
    backend = session(rig)
    for order in range(others):
        record(backend, acquire(stroke(), order=order))
        backend.stage.home()
    if with_tare:
        record(backend, acquire(rest(0.1), order=3, contact=Contact.NONE))
    again = record(backend, LONG_RUN)
    assert again.same_as(reference)
    assert max(block.samples for block in again.blocks) <= block_s * FAST + 1e-6


def test_arrays_do_not_depend_on_the_pace() -> None:
    short = acquire(stroke(), order=1)
    paced = record(session(real_time=True), short)
    assert paced.same_as(record(session(), short))


@fewer(max_examples=examples(15))
@given(block_s=st.floats(0.002, 0.05), with_tare=st.booleans())
@example(block_s=0.05, with_tare=True)
def test_effects_do_not_depend_on_blocks_or_a_tare(affected: Recorded, block_s: float, with_tare: bool) -> None:
    backend = session(settings(sampling={"rate_hz": FAST, "block_s": block_s}), effects=EFFECTS)
    if with_tare:
        record(backend, replace(acquire(rest(0.1), order=3, contact=Contact.NONE), recorded=False))
    assert record(backend, LONG_RUN).same_as(affected)


def test_effects_do_not_depend_on_the_pace() -> None:
    short = acquire(stroke(), order=1)
    paced = record(session(real_time=True, effects=EFFECTS), short)
    assert paced.same_as(record(session(effects=EFFECTS), short))


@fewer(max_examples=examples(20))
@given(blocks_before=st.integers(1, 40))
def test_a_stop_with_effects_goes_on_from_where_the_stage_is(affected: Recorded, blocks_before: int) -> None:
    backend = session(settings(FAST), effects=EFFECTS)
    stopped = record(backend, LONG_RUN, lambda count: backend.stage.stop() if count == blocks_before else None)
    handed_out = stopped.blocks[min(blocks_before, len(stopped.blocks)) - 1].end_index
    for name in ("force", "position", "motor_force"):
        np.testing.assert_array_equal(stopped[name][:handed_out], affected[name][:handed_out])
    # A tenth of a millisecond at 50 mm/s and what the ripple adds, and the encoder's count.
    moved = np.abs(np.diff(stopped["position"]))
    assert moved.max() <= 65.0 / FAST + 0.001


@pytest.mark.parametrize("changed", ["seed", "order"])
def test_seed_and_order_change_every_channel_s_noise(changed: str) -> None:
    here = record(session(), acquire(stroke(), order=0))
    rig = settings(simulated={"seed": 1}) if changed == "seed" else settings()
    there = record(session(rig), acquire(stroke(), order=1 if changed == "order" else 0))
    assert np.array_equal(here["position"], there["position"])
    for name in ("force", "motor_force"):
        assert np.mean(here[name] != there[name]) > 0.9


def test_a_tare_has_the_run_s_zero_offset_and_noise_of_its_own() -> None:
    rig = settings(simulated={"noise": {"zero_mN": 500.0, "slow_mN": 0.0}})
    backend = session(rig)
    tare = record(backend, acquire(rest(2.0), order=5, contact=Contact.NONE))["force"]
    blank = record(backend, acquire(rest(4.0), order=5, contact=Contact.NONE))["force"]
    force = record(backend, acquire(rest(4.0), order=6, contact=Contact.NONE))["force"]
    error = 1.5 / np.sqrt(2000)
    assert tare.mean() == pytest.approx(blank.mean(), abs=5 * 1.5 * error)
    assert abs(force.mean() - tare.mean()) > 20
    correlation = np.corrcoef(tare, blank[: len(tare)])[0, 1]
    assert abs(correlation) < 5 / np.sqrt(len(tare))


@given(blocks_before=st.integers(1, 40), block_s=st.floats(0.005, 0.05))
def test_a_stop_changes_only_what_was_not_handed_out(reference: Recorded, blocks_before: int, block_s: float) -> None:
    backend = session(settings(sampling={"rate_hz": FAST, "block_s": block_s}))
    stopped = record(backend, LONG_RUN, lambda count: backend.stage.stop() if count == blocks_before else None)
    handed_out = stopped.blocks[min(blocks_before, len(stopped.blocks)) - 1].end_index
    for name in ("force", "position", "motor_force"):
        np.testing.assert_array_equal(stopped[name][:handed_out], reference[name][:handed_out])
    assert np.array_equal(stopped.index, np.arange(len(stopped.index)))

    position = stopped["position"]
    speed = (position[50:] - position[:-50]) * FAST / 50
    count_mm_s = 0.001 * FAST / 50
    assert np.abs(np.diff(speed)).max() <= 3000.0 / FAST + 2 * count_mm_s
    assert abs(position[-1] - position[-2]) <= 0.001
    braking_s = 50.0 / 3000.0
    assert len(position) - handed_out <= (braking_s + 2e-4) * FAST
    assert backend.stage.state().position_mm == pytest.approx(position[-1], abs=0.0011)


def test_noise_goes_on_through_a_stop() -> None:
    rig = settings(simulated={"noise": {"zero_mN": 0.0}})
    blank = acquire(stroke(travel_mm=50.0), contact=Contact.NONE)
    whole = record(session(rig), blank)
    backend = session(rig)
    cut = record(backend, blank, lambda count: backend.stage.stop() if count == 4 else None)
    assert 200 < len(cut["force"]) < len(whole["force"])
    np.testing.assert_array_equal(cut["force"], whole["force"][: len(cut["force"])])


def test_braking_may_outlast_the_profile() -> None:
    rig = settings(simulated={"noise": {"zero_mN": 0.0}})
    # Settings forbid so weak a brake; a real stage may still turn out to have one.
    weak = rig.stage.model_copy(update={"stop_accel_mm_s2": 200.0})
    backend = session(rig.model_copy(update={"stage": weak}))
    blank = acquire(stroke(travel_mm=20.0, hold_s=0.05), contact=Contact.NONE)
    whole = record(session(settings(simulated={"noise": {"zero_mN": 0.0}})), blank)
    begin(backend, blank)
    got = []
    for block in blocks(backend):
        got.append(block)
        if block.end_index == 450:
            backend.stage.stop()
    slow = Recorded(got)
    assert len(slow["force"]) == 450 + 250 + 1 > len(whole["force"])
    np.testing.assert_array_equal(slow["force"][: len(whole["force"])], whole["force"])
    assert np.ptp(slow["position"][-2:]) <= 0.001


def test_a_stop_during_a_wait_for_samples_counts_from_the_wall_s_clock() -> None:
    backend = session(settings(sampling={"block_s": 0.05}), real_time=True)
    begin(backend, acquire(stroke(travel_mm=50.0, rest_s=0.0)))
    threading.Timer(0.125, backend.stage.stop).start()
    got = list(blocks(backend))
    assert 125 + 16 <= got[-1].end_index < 600
    assert backend.stage.state().position_mm == pytest.approx(got[-1].channels["position"][-1], abs=0.0011)


def test_memory_does_not_grow_with_the_length_of_a_run() -> None:
    def peak(hold_s: float) -> int:
        backend = session(settings(250_000.0))
        begin(backend, acquire(stroke(hold_s=hold_s)))
        tracemalloc.start()
        samples = sum(block.samples for block in blocks(backend))
        _, maximum = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert samples > hold_s * 250_000
        return maximum

    short, long = peak(0.25), peak(2.0)
    assert long < 1.1 * short + 100_000


pieces = st.lists(
    st.tuples(st.floats(1.0, 30.0), st.floats(2.0, 60.0), st.floats(100.0, 3000.0), st.booleans()),
    min_size=1,
    max_size=4,
)


@given(moves=pieces, first=st.integers(0, 3000), samples=st.integers(1, 4000))
def test_fast_evaluation_is_the_profile_s_own(
    moves: list[tuple[float, float, float, bool]], first: int, samples: int
) -> None:
    from dragrig.rig.profile import MotionProfile, Phase, stationary_piece, trapezoid

    profile = MotionProfile.from_pieces(
        piece
        for travel, speed, accel, back in moves
        for piece in (stationary_piece(0.05, Phase.REST), *trapezoid(-travel if back else travel, speed, accel))
    )
    time = np.arange(first, first + samples) / 1000.0
    motion = evaluate_profile(profile, time)
    np.testing.assert_allclose(motion.position, profile.position(time), atol=1e-9)
    np.testing.assert_allclose(motion.velocity, profile.velocity(time), atol=1e-6)
    np.testing.assert_array_equal(motion.acceleration, profile.acceleration(time))
    for end in (time[0], time[-1]):
        assert profile_position(profile, float(end)) == pytest.approx(float(profile.position(end)), abs=1e-9)
