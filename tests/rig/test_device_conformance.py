"""What every rig's devices must do, whatever is behind them. A new backend is one more entry of `RIGS`."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from dragrig.config.errors import DeviceError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.devices import MAX_BLOCK_S, Backend, BackendRequest, read_idle
from dragrig.rig.profile import AnyFloatArray, FloatArray, MotionProfile, Phase, Piece
from dragrig.sim_backend.devices import open_backend
from dragrig.sim_backend.doubles.backend import open_backend as open_double
from driving import Room, is_back, until
from property_tests import thorough
from simulated import NEVER, PATIENT, acquire, begin, blocks, record, rest, settings, stroke
from voltage_bench import LEAD_S, open_voltage_rig, velocity_rig


@dataclass(frozen=True)
class RigUnderTest:
    open: Callable[[RigSettings], Backend]
    position_tolerance_mm: float
    paced: bool
    """Whether its clock is the wall's."""
    lag_s: float = 0.0
    """How much earlier or later than the first sample a motion may begin."""
    late_s: float = 0.0
    """How much later a motion may begin where a busy machine is late to ask for it."""
    creep_counts: int = 1
    """How many counts a stage at rest may move in 0.2 s."""

    @property
    def slack_s(self) -> float:
        """How long a motion waits, or is sampled after its end, where the clock does not wait for a busy machine."""
        return 0.6 if self.paced else 0.05

    @property
    def stops_within_s(self) -> float:
        """How long after a stop it may sample; a busy machine is late to ask a rig whose clock is the wall's."""
        return 5.0 if self.paced else 0.3

    def follows(self, position: AnyFloatArray, profile: MotionProfile, time_s: FloatArray) -> None:
        """Positions are the profile's, but for the lag."""
        if self.late_s:
            half_mm, fine_s = 0.5 * position.max(), np.arange(0.0, profile.duration_s, 1e-4)
            late_s = np.interp(half_mm, position, time_s) - np.interp(half_mm, profile.position(fine_s), fine_s)
            assert -self.lag_s <= late_s <= self.late_s
            assert np.abs(position - profile.position(time_s - late_s)).max() <= self.position_tolerance_mm
            return
        bounds = [profile.position(time_s + lag) for lag in np.linspace(-self.lag_s, self.lag_s, 21)]
        assert (position >= np.min(bounds, axis=0) - self.position_tolerance_mm).all()
        assert (position <= np.max(bounds, axis=0) + self.position_tolerance_mm).all()


def on_doubles(**spoken: object) -> Callable[[RigSettings], Backend]:
    """The real rig's code on doubles; the drive speaks as its settings say, and has a heartbeat relay."""

    def open_rig(rig: RigSettings) -> Backend:
        lines = rig.hardware.card.lines.model_copy(update={"heartbeat": "port1/line4", "heartbeat_s": 1.0})
        card = rig.hardware.card.model_copy(update={"lines": lines})
        swift = rig.hardware.drive.model_copy(update={"homing_speed_mm_s": 50.0, **spoken})
        hardware = rig.hardware.model_copy(update={"drive": swift, "card": card})
        wired = rig.model_copy(update={"hardware": hardware})
        backend = open_double(BackendRequest(wired, FrictionModelSettings()))
        backend.bench.place(1.0)  # near its index pulse, for a short way home
        return backend

    return open_rig


def by_voltage(rig: RigSettings) -> Backend:
    voltage = velocity_rig(heartbeat_s=1.0)
    return open_voltage_rig(voltage.model_copy(update={"sampling": rig.sampling}))


def simulated(real_time: bool) -> Callable[[RigSettings], Backend]:
    return lambda rig: open_backend(BackendRequest(rig, FrictionModelSettings(), real_time=real_time))


RIGS = {
    "simulated": RigUnderTest(simulated(real_time=False), position_tolerance_mm=0.001, paced=False),
    "simulated at real pace": RigUnderTest(simulated(real_time=True), position_tolerance_mm=0.001, paced=True),
    "hardware on its doubles": RigUnderTest(
        on_doubles(), position_tolerance_mm=0.002, paced=True, lag_s=0.06, late_s=5.0
    ),
    "hardware with a drive that lacks whatever may be lacking": RigUnderTest(
        # Its line has to be quiet for a reply's time before the first request.
        on_doubles(dialect="copley", station=0, counts_per_mm=1000.0, thrust_N_per_A=8.0, reply_s=0.5),
        position_tolerance_mm=0.002,
        paced=True,
        lag_s=0.06,
        late_s=5.0,
    ),
    # A stage that is told speeds stands when it moves by 1.5 counts or less per update of 30 ms.
    "hardware by voltage on its doubles": RigUnderTest(
        by_voltage, position_tolerance_mm=0.1, paced=True, lag_s=LEAD_S + 0.01, creep_counts=10
    ),
}


# What is theirs alone is in the line: tests/rig/hardware/test_dialect.py, test_serial_stage.py, test_velocity_stage.py,
# and tests/sim_backend/devices/test_repeats.py.
LONG = {
    "simulated at real pace",
    "hardware with a drive that lacks whatever may be lacking",
    "hardware by voltage on its doubles",
}


@pytest.fixture(
    scope="module",
    params=[thorough(rig) if name in LONG else rig for name, rig in RIGS.items()],
    ids=RIGS.keys(),
)
def rig(request: pytest.FixtureRequest) -> RigUnderTest:
    return request.param


@pytest.fixture(scope="module")
def room(rig: RigUnderTest) -> Iterator[Room[Backend]]:
    def homed() -> Backend:
        backend = rig.open(settings(**PATIENT))
        backend.stage.enable()
        backend.stage.home()
        return backend

    room = Room(homed)
    yield room
    room.clear()


@pytest.fixture
def cold(rig: RigUnderTest, room: Room[Backend]) -> Iterator[Backend]:
    """A rig that was just opened."""
    room.clear()
    backend = rig.open(settings(**PATIENT))
    yield backend
    backend.close()


@pytest.fixture
def backend(rig: RigUnderTest, room: Room[Backend]) -> Iterator[Backend]:
    """A rig that is homed, on and at its zero."""
    backend = room.rig()
    yield backend
    if not rig.lag_s:
        # A simulated one is homed in no time.
        room.clear()
        return
    backend.sampler.stop()
    backend.stage.stop()
    until(lambda: not backend.stage.state().moving)
    backend.stage.enable()
    near_mm = min(0.01, 0.5 * rig.position_tolerance_mm)
    until(lambda: is_back(backend.stage, lambda away_mm: stroke(travel_mm=-away_mm), near_mm))


def wait_for(rig: RigUnderTest, backend: Backend, profile: MotionProfile) -> None:
    """Wait as long as a motion takes, and where it began late until it is over."""
    backend.clock.sleep(profile.duration_s, NEVER)
    if rig.late_s:
        until(lambda: not backend.stage.state().moving)


def test_is_a_backend_that_says_what_it_is(cold: Backend) -> None:
    assert isinstance(cold, Backend)
    assert cold.name
    assert {"sensor_serial"} <= cold.description().keys()
    assert cold.clock.now().utcoffset() is not None
    assert [channel.name for channel in cold.sampler.channels][:2] == ["force", "position"]
    lowest, highest = cold.sampler.force_range_mN
    assert lowest < 0 < highest
    assert cold.stage.limits.lowest_mm < cold.stage.limits.highest_mm


def test_nothing_moves_that_is_off_or_lost(cold: Backend) -> None:
    with pytest.raises(DeviceError, match="enable"):
        cold.stage.move(stroke())
    with pytest.raises(DeviceError, match="enable"):
        cold.stage.home()
    cold.stage.enable()
    with pytest.raises(DeviceError, match="home"):
        cold.stage.move(stroke())
    assert cold.stage.state().enabled
    assert not cold.stage.state().homed
    cold.stage.home()
    cold.stage.disable()
    assert not cold.stage.state().enabled
    with pytest.raises(DeviceError, match="enable"):
        cold.stage.move(stroke())


def test_force_and_position_can_be_read_between_acquisitions(cold: Backend) -> None:
    assert read_idle(cold, 0.0).position_mm is None
    cold.stage.enable()
    cold.stage.home()
    until(lambda: not cold.stage.state().moving)
    reading = read_idle(cold, 0.1)
    assert reading.problem == ""
    assert reading.position_mm == pytest.approx(cold.stage.state().position_mm, abs=0.1)
    assert abs(reading.force_mN or 99.0) < 20.0
    cold.sampler.arm(acquire(rest(0.1)))
    assert "stop it before a measurement" in read_idle(cold, 0.1).problem


def test_stop_is_allowed_at_any_time_and_twice(rig: RigUnderTest, cold: Backend) -> None:
    cold.stage.stop()
    cold.stage.enable()
    cold.stage.stop()
    cold.stage.home()
    cold.stage.stop()
    begin(cold, acquire(stroke(travel_mm=100.0, speed_mm_s=10.0)))
    cold.sampler.read(NEVER)
    cold.stage.stop()
    cold.clock.sleep(0.4, NEVER)
    cold.stage.stop()
    ended = sum(block.samples for block in blocks(cold))
    assert ended <= rig.stops_within_s * cold.sampler.sample_rate_hz
    cold.stage.stop()
    assert cold.sampler.read(NEVER) is None
    cold.sampler.stop()
    cold.stage.disable()
    cold.stage.stop()
    cold.close()
    cold.close()
    cold.stage.stop()


def test_sampler_insists_on_its_order_of_calls(cold: Backend) -> None:
    with pytest.raises(DeviceError, match="arm"):
        cold.sampler.read(NEVER)
    with pytest.raises(DeviceError, match="arm"):
        cold.sampler.start()
    cold.sampler.arm(acquire(stroke()))
    with pytest.raises(DeviceError, match="start"):
        cold.sampler.read(NEVER)
    with pytest.raises(DeviceError, match="stop"):
        cold.sampler.arm(acquire(stroke()))
    cold.sampler.start()
    with pytest.raises(DeviceError, match="arm"):
        cold.sampler.start()
    cold.sampler.stop()
    cold.sampler.stop()
    assert cold.sampler.read(NEVER) is None
    cold.sampler.arm(acquire(stroke()))


def test_blocks_are_short_contiguous_and_read_only(rig: RigUnderTest, backend: Backend) -> None:
    profile = stroke()
    got = record(backend, acquire(profile))
    expected = 0
    for block in got.blocks:
        assert block.first_index == expected
        assert 0 < block.samples <= MAX_BLOCK_S * backend.sampler.sample_rate_hz
        assert list(block.channels) == [channel.name for channel in backend.sampler.channels]
        for values in block.channels.values():
            assert values.shape == (block.samples,)
            with pytest.raises(ValueError, match="read-only"):
                values[0] = 0
        expected = block.end_index
    assert expected == profile.samples(backend.sampler.sample_rate_hz)
    time_s = got.index / backend.sampler.sample_rate_hz
    rig.follows(got["position"], profile, time_s)
    assert got["force"].dtype == np.float32


def test_sampler_may_start_before_the_stage(rig: RigUnderTest, backend: Backend) -> None:
    profile = stroke(rest_s=rig.slack_s, hold_s=rig.slack_s)
    backend.sampler.arm(acquire(profile))
    backend.sampler.start()
    backend.stage.move(profile)
    last = list(blocks(backend))[-1]
    assert last.end_index == profile.samples(backend.sampler.sample_rate_hz)
    assert last.channels["position"][-1] == pytest.approx(5.0, abs=rig.position_tolerance_mm)


def test_sampling_without_motion_stands_still(rig: RigUnderTest, backend: Backend) -> None:
    profile = rest(0.1)
    backend.sampler.arm(acquire(profile, kind="tare"))
    backend.sampler.start()
    got = list(blocks(backend))
    assert got[-1].end_index == profile.samples(backend.sampler.sample_rate_hz)
    assert max(np.abs(block.channels["position"]).max() for block in got) <= rig.position_tolerance_mm


def test_positions_count_from_where_the_run_started(rig: RigUnderTest, backend: Backend) -> None:
    there = stroke(travel_mm=7.0, rest_s=rig.slack_s)
    backend.stage.move(there)
    assert backend.stage.state().moving
    wait_for(rig, backend, there)
    state = backend.stage.state()
    assert not state.moving
    assert state.position_mm == pytest.approx(7.0, abs=rig.position_tolerance_mm)
    got = record(backend, acquire(stroke(travel_mm=-5.0, hold_s=rig.slack_s)))
    assert got["position"][0] == pytest.approx(0.0, abs=rig.position_tolerance_mm)
    assert got["position"][-1] == pytest.approx(-5.0, abs=rig.position_tolerance_mm)
    assert backend.stage.state().position_mm == pytest.approx(2.0, abs=2 * rig.position_tolerance_mm)


def test_one_motion_at_a_time(rig: RigUnderTest, backend: Backend) -> None:
    profile = stroke(rest_s=rig.slack_s)
    backend.stage.move(profile)
    with pytest.raises(DeviceError, match="moving"):
        backend.stage.move(profile)
    with pytest.raises(DeviceError, match="moves"):
        backend.sampler.arm(acquire(profile))
    wait_for(rig, backend, profile)
    backend.stage.move(stroke(travel_mm=-5.0))


def test_sampler_measures_raw_values_between_acquisitions(rig: RigUnderTest, backend: Backend) -> None:
    backend.sampler.arm(acquire(rest(0.1)))
    with pytest.raises(DeviceError, match="stop"):
        backend.sampler.measure(0.1)
    backend.sampler.stop()
    reading = backend.sampler.measure(0.2)
    assert reading.samples == pytest.approx(0.2 * backend.sampler.sample_rate_hz, abs=1)
    assert abs(reading.force_V) < 0.1
    assert 0 < reading.force_V_sd < 0.1
    assert abs(reading.counts_end - reading.counts_begin) <= rig.creep_counts
    assert record(backend, acquire(rest(0.1))).blocks[-1].end_index == 0.1 * backend.sampler.sample_rate_hz


def test_motion_beyond_the_limits_is_refused(backend: Backend) -> None:
    for profile, complaint in (
        (stroke(travel_mm=160.0, speed_mm_s=100.0), "travel"),
        (stroke(travel_mm=-1.0, speed_mm_s=10.0), "travel"),
        (stroke(travel_mm=20.0, speed_mm_s=101.0), "speed"),
        (stroke(accel_mm_s2=3001.0), "acceleration"),
        (MotionProfile.from_pieces([Piece(0.1, 100.0, Phase.ACCELERATE)]), "standstill"),
        (MotionProfile.from_pieces([Piece(0.1, float("nan"), Phase.ACCELERATE)]), "travel"),
    ):
        with pytest.raises(DeviceError, match=complaint):
            backend.stage.move(profile)
        assert not backend.stage.state().moving


def test_stop_from_another_thread_ends_the_run_at_a_standstill(rig: RigUnderTest, backend: Backend) -> None:
    profile = stroke(travel_mm=100.0, speed_mm_s=10.0)
    begin(backend, acquire(profile))
    got = []
    stopper = threading.Thread(target=backend.stage.stop)
    for block in blocks(backend):
        got.append(block)
        if len(got) == 3:
            stopper.start()
            stopper.join()
    rate = backend.sampler.sample_rate_hz
    position = np.concatenate([block.channels["position"] for block in got])
    assert [block.first_index for block in got[1:]] == [block.end_index for block in got[:-1]]
    handed_out = got[2].end_index
    rig.follows(position[:handed_out], profile, np.arange(handed_out) / rate)
    assert handed_out < len(position) <= handed_out + rig.stops_within_s * rate
    # Positions are whole counts, and their difference in mm is off by rounding.
    assert position[-1] - position[-2] <= 2 * rig.position_tolerance_mm + 1e-9
    assert backend.stage.state().position_mm == pytest.approx(position[-1], abs=2 * rig.position_tolerance_mm)
    backend.sampler.stop()
    again = record(backend, acquire(stroke(hold_s=rig.slack_s), order=1))
    assert again["position"][-1] == pytest.approx(5.0, abs=rig.position_tolerance_mm)


def test_stop_before_the_first_sample_cancels_the_motion(rig: RigUnderTest, backend: Backend) -> None:
    profile = stroke()
    backend.sampler.arm(acquire(profile))
    backend.stage.move(profile)
    backend.stage.stop()
    backend.sampler.start()
    assert sum(block.samples for block in blocks(backend)) <= 2
    assert backend.stage.state().position_mm == pytest.approx(0.0, abs=rig.position_tolerance_mm)


def test_switching_off_stops(rig: RigUnderTest, backend: Backend) -> None:
    begin(backend, acquire(stroke(travel_mm=100.0, speed_mm_s=10.0)))
    backend.sampler.read(NEVER)
    backend.stage.disable()
    ended = sum(block.samples for block in blocks(backend))
    assert ended <= rig.stops_within_s * backend.sampler.sample_rate_hz


def test_cancel_ends_any_wait_long_before_it_is_over(rig: RigUnderTest, backend: Backend) -> None:
    cancel, profile = threading.Event(), stroke(travel_mm=100.0, speed_mm_s=10.0)
    begin(backend, acquire(profile))
    timer = threading.Timer(0.12, cancel.set)
    timer.start()
    end = 0
    while (block := backend.sampler.read(cancel)) is not None:
        end = block.end_index
    if rig.paced:
        assert end < profile.samples(backend.sampler.sample_rate_hz)
    timer.join()
    assert backend.sampler.read(cancel) is None

    cancel.clear()
    timer = threading.Timer(0.12, cancel.set)
    timer.start()
    began_s = backend.clock.monotonic()
    slept = backend.clock.sleep(600.0, cancel)
    timer.join()
    assert slept is not rig.paced
    assert slept or backend.clock.monotonic() < began_s + 600.0
