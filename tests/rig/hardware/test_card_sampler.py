"""The sampler on the card's double, through the real nidaqmx."""

import re
import subprocess
import sys
import threading
import time
from contextlib import closing
from datetime import UTC, datetime

import numpy as np
import pytest
from nidaqmx.errors import DaqError

from card_bench import CardRig, card_rig, indices, joined
from dragrig.config.errors import DeviceError, OverrunError, SettingsError, StaleDataError
from dragrig.config.rig import Calibration, CardSettings, GuardSettings, RigSettings
from dragrig.rig.devices import MAX_BLOCK_S, TripCause
from dragrig.rig.hardware.backend import check_card
from dragrig.rig.hardware.card.connection import Connection, device_error
from dragrig.rig.hardware.card.scaling import Scaling
from dragrig.rig.hardware.card.tasks import SampledTasks
from dragrig.rig.hardware.lines import CardLines, SwitchStates
from dragrig.rig.profile import AnyFloatArray, FloatArray, MotionProfile
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.simulated_bench import SimulatedBench
from property_tests import thorough
from simulated import NEVER, PATIENT, acquire, rest, settings, stroke

INPUTS = [
    {"name": "motor_force", "channel": "ai1", "unit": "mN", "per_V": 1000.0},
    {"name": "temperature", "channel": "ai2", "unit": "degC", "per_V": 10.0, "zero_V": 0.5, "range_V": 5.0},
]
REACHED = pytest.mark.parametrize("remote", [False, True], ids=["through the driver", "through a server"])


def wired(rate_hz: float = 1000.0, **card: object) -> RigSettings:
    """A rig whose every sample is recorded; with `oversampling` 0 as it is by default."""
    return settings(rate_hz, guard=PATIENT["guard"], hardware={"card": {"oversampling": 1, **card}})


def assert_converted(got: AnyFloatArray, volts: FloatArray, gain: float, zero: float, range_V: float = 10.0) -> None:
    """A 16-bit converter rounds volts to its step; the noise is wider, so that a shift by a sample shows."""
    step = 2 * range_V / 2**16
    assert volts.std() > step / 10
    np.testing.assert_allclose(got, volts * gain + zero, rtol=1e-6, atol=0.6 * step * abs(gain))


def calibration(quantity: str, gain: float, zero: float = 0.0) -> Calibration:
    return Calibration(id=quantity, made_at=datetime.now(UTC), quantity=quantity, gain=gain, zero=zero)


@pytest.mark.parametrize("reversed_", [False, True])
def test_force_and_position_are_the_same_instants(reversed_: bool) -> None:
    rig = wired(encoder={"reversed": reversed_}, force={"per_V": 500.0, "zero_V": 0.25}, inputs=INPUTS)
    profile = stroke(travel_mm=5.0)
    with card_rig(rig) as under_test:
        got = under_test.record(profile)
        bench, index = under_test.bench, indices(got)
        counts = bench.at("encoder_counts", index)
        volts, motor, warm = (bench.at(name, index) for name in ("force_V", "motor_force", "temperature"))
    assert index.tolist() == list(range(profile.samples(1000.0)))
    assert joined(got, "position")[-1] == pytest.approx(5.0, abs=0.01)
    np.testing.assert_array_equal(joined(got, "position"), counts * (-0.001 if reversed_ else 0.001))
    assert_converted(joined(got, "force"), volts, 500.0, -125.0)
    assert_converted(joined(got, "motor_force"), motor, 1000.0, 0.0)
    np.testing.assert_allclose(joined(got, "temperature"), (warm - 0.5) * 10.0, atol=0.001)
    for block in got:
        assert 0 < block.samples <= MAX_BLOCK_S * 1000.0
        assert block.fault is None
        assert list(block.channels) == ["force", "position", "motor_force", "temperature"]
        for name, values in block.channels.items():
            assert values.dtype == (np.float64 if name == "position" else np.float32)
            with pytest.raises(ValueError, match="read-only"):
                values[0] = 0


def test_the_stage_hears_when_the_first_sample_was() -> None:
    with card_rig(wired()) as under_test:
        under_test.sampler.arm(acquire(rest(0.1)))
        assert under_test.sync.armed
        assert under_test.sync.first_sample is None
        before_s = under_test.bench.clock.monotonic()
        under_test.sampler.start()
        after_s = under_test.bench.clock.monotonic()
        first = under_test.sync.first_sample
        assert first is not None
        assert before_s <= first.at_s - first.uncertainty_s <= first.at_s + first.uncertainty_s <= after_s
        under_test.sampler.stop()
        assert not under_test.sync.armed


def test_calibrations_stand_before_settings() -> None:
    rig = wired(force={"per_V": 500.0, "zero_V": 0.25})
    made = {"force": calibration("force", -800.0, 12.0), "encoder": calibration("encoder", 0.00101)}
    with card_rig(rig, made) as under_test:
        assert under_test.sampler.force_range_mN == (-7988.0, 8012.0)
        got = under_test.record(stroke())
        volts = under_test.bench.at("force_V", indices(got))
        counts = under_test.bench.at("encoder_counts", indices(got))
    assert_converted(joined(got, "force"), volts, -800.0, 12.0)
    np.testing.assert_allclose(joined(got, "position"), counts * 0.00101, rtol=1e-12)


@REACHED
def test_overrun_is_a_trip_and_a_gap_of_known_length(remote: bool) -> None:
    with card_rig(wired(), remote=remote) as under_test:
        faults = under_test.bench.faults
        got = under_test.record(stroke(travel_mm=20.0), lambda _: faults.inject(overwritten_samples=90))
        index = indices(got)
        counts = under_test.bench.at("encoder_counts", index)
        volts = under_test.bench.at("force_V", index)
    gaps = np.flatnonzero(np.diff(index) > 1)
    assert len(gaps) == 1
    gap = int(index[gaps[0] + 1] - index[gaps[0]] - 1)
    assert gap >= 90
    assert index[-1] == stroke(travel_mm=20.0).samples(1000.0) - 1
    faults = [block.fault for block in got if block.fault is not None]
    assert [fault.cause for fault in faults] == [TripCause.OVERRUN]
    assert f"{gap} samples" in faults[0].message
    assert got[[block.fault is not None for block in got].index(True)].first_index == index[gaps[0] + 1]
    np.testing.assert_array_equal(joined(got, "position"), counts * 0.001)
    assert_converted(joined(got, "force"), volts, 1000.0, 0.0)


def test_what_is_lost_at_the_very_end_is_told_too() -> None:
    with card_rig(wired()) as under_test:
        under_test.begin(rest(0.1), moves=False)
        assert under_test.sampler.read(NEVER) is not None
        under_test.bench.faults.inject(overwritten_samples=500)
        with pytest.raises(DeviceError, match="lost"):
            list(under_test.blocks())


@REACHED
def test_reads_that_time_out_lose_nothing(remote: bool) -> None:
    profile = stroke(travel_mm=10.0)
    with card_rig(wired(inputs=INPUTS), remote=remote) as under_test:
        under_test.bench.faults.inject(short_reads=4)
        got = under_test.record(profile)
        index = indices(got)
        counts = under_test.bench.at("encoder_counts", index)
        volts = under_test.bench.at("force_V", index)
        motor = under_test.bench.at("motor_force", index)
    assert min(block.samples for block in got) < 50
    assert index.tolist() == list(range(profile.samples(1000.0)))
    np.testing.assert_array_equal(joined(got, "position"), counts * 0.001)
    assert_converted(joined(got, "force"), volts, 1000.0, 0.0)
    assert_converted(joined(got, "motor_force"), motor, 1000.0, 0.0)


def test_silence_is_stale_data() -> None:
    rig = RigSettings.model_validate({"guard": {"stale_data_s": 0.8}})
    with card_rig(rig) as under_test:
        under_test.begin(rest(60.0), moves=False)
        began_s = time.monotonic()
        assert under_test.sampler.read(NEVER) is not None
        under_test.bench.faults.inject(card_stalled=True)
        with pytest.raises(StaleDataError, match=r"0\.8 s"):
            list(under_test.blocks())
        assert time.monotonic() - began_s > 0.7
        under_test.sampler.stop()
        under_test.bench.faults.clear()
        assert indices(under_test.record(rest(0.1)))[-1] == 99


class FreezingCard(Card):
    """A card whose driver freezes before every read, for `freeze_s`."""

    def __init__(self, bench: SimulatedBench) -> None:
        super().__init__(bench)
        self.freeze_s = 0.0
        self.thawed = threading.Event()

    def read_analog_f64(self, task: int, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        self.thawed.wait(self.freeze_s)
        return super().read_analog_f64(task, samples, timeout_s, fill, out)


def first_fault(under_test: CardRig) -> TripCause | None:
    try:
        faults = (block.fault for block in under_test.blocks())
        return next((fault.cause for fault in faults if fault is not None), None)
    except OverrunError:
        return TripCause.OVERRUN
    except StaleDataError:
        return TripCause.STALE_DATA


@pytest.mark.parametrize("freeze_s", [0.13, thorough(0.3), 1.0])
def test_short_freezes_of_the_driver_add_up_to_stale_data(freeze_s: float) -> None:
    """Each read brings samples, so that none of the waits is long; and yet the guard sees an ever older stage."""
    cards: list[FreezingCard] = []

    def freezing(bench: SimulatedBench) -> Card:
        cards.append(FreezingCard(bench))
        return cards[0]

    rig = RigSettings.model_validate({"guard": {"stale_data_s": 0.5}})
    with card_rig(rig, card=freezing) as under_test:
        under_test.begin(rest(4.0), moves=False)
        assert under_test.sampler.read(NEVER) is not None
        cards[0].freeze_s = freeze_s
        assert first_fault(under_test) is TripCause.STALE_DATA
        cards[0].freeze_s = 0.0


@pytest.mark.parametrize("lost", [1, thorough(60), 300, thorough(3000), 30_000])
def test_an_overrun_of_any_length_is_one(lost: int) -> None:
    # Of these lengths at 1 kHz two are longer than the time, which is longer than a busy machine holds a process up.
    rig = RigSettings.model_validate({"guard": {"stale_data_s": 2.5}, "hardware": {"card": {"oversampling": 1}}})
    with card_rig(rig) as under_test:
        under_test.begin(rest(60.0), moves=False)
        assert under_test.sampler.read(NEVER) is not None
        under_test.bench.faults.inject(overwritten_samples=lost)
        assert first_fault(under_test) is TripCause.OVERRUN


@pytest.mark.parametrize("trouble", [{"card_unplugged": True}, {"card_gone": True}], ids=["unplugged", "gone"])
def test_card_unplugged_in_motion_is_told_and_the_next_run_is_possible(trouble: dict[str, bool]) -> None:
    with card_rig(wired()) as under_test:
        under_test.begin(stroke(travel_mm=100.0))
        got = [under_test.sampler.read(NEVER)]
        under_test.bench.faults.inject(**trouble)
        with pytest.raises(DeviceError, match=r"card Dev1 .*unplugged.*NI MAX") as raises:
            got.extend(under_test.blocks())
        assert "\n" not in str(raises.value)
        assert str(raises.value).count(". ") == 0
        with pytest.raises(DeviceError, match="unplugged"):
            under_test.sampler.read(NEVER)
        under_test.stop_stage()
        under_test.sampler.stop()
        assert under_test.sampler.read(NEVER) is None
        under_test.bench.faults.clear()
        under_test.settle()
        assert indices(under_test.record(rest(0.1)))[-1] == 99


def test_card_taken_by_another_program_or_absent() -> None:
    with card_rig(wired()) as under_test:
        under_test.bench.faults.inject(card_reserved=True)
        with pytest.raises(DeviceError, match="taken by another program"):
            under_test.sampler.arm(acquire(rest(0.1)))
        under_test.bench.faults.clear()
        under_test.bench.faults.inject(card_absent=True)
        with pytest.raises(DeviceError, match=r"hardware\.card\.device"):
            under_test.sampler.arm(acquire(rest(0.1)))
        under_test.bench.faults.clear()
        assert indices(under_test.record(rest(0.1)))[-1] == 99


@pytest.mark.thorough
def test_without_nis_driver_one_sentence_says_what_to_install() -> None:
    script = (
        "from dragrig.config.errors import DeviceError\n"
        "from dragrig.config.rig import RigSettings\n"
        "from dragrig.rig.devices import WallClock\n"
        "from dragrig.rig.hardware.card.connection import Connection\n"
        "from dragrig.rig.hardware.card.sampler import CardSampler\n"
        "from dragrig.rig.hardware.sync import MotionSamplingSync\n"
        "rig = RigSettings()\n"
        "sampler = CardSampler(Connection(rig.hardware.card), rig, {}, MotionSamplingSync(), WallClock())\n"
        "try:\n"
        "    sampler.measure(0.1)\n"
        "except DeviceError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    if not done.stdout:
        pytest.skip("NI's driver is installed here")
    assert "install it from ni.com/downloads" in done.stdout
    assert len(done.stdout.splitlines()) == 1
    assert done.stderr == ""


def test_server_that_is_not_there_is_named() -> None:
    with (
        card_rig(wired(server="127.0.0.1:9")) as under_test,
        pytest.raises(DeviceError, match=r"127\.0\.0\.1:9 \(hardware\.card\.server\)"),
    ):
        under_test.sampler.arm(acquire(rest(0.1)))


def test_what_a_killed_program_left_at_the_server_does_not_hold_the_card() -> None:
    with card_rig(wired(), remote=True) as under_test, closing(Connection(under_test.connection.card)) as killed:
        CardLines(killed)
        SampledTasks(killed, under_test.rig, 1000.0).start(lambda start: start())
        assert indices(under_test.record(rest(0.1)))[-1] == 99
        CardLines(under_test.connection).close()


def test_stop_from_another_thread_ends_a_read_and_the_next_run_begins() -> None:
    with card_rig(wired()) as under_test:
        under_test.begin(rest(60.0), moves=False)
        assert under_test.sampler.read(NEVER) is not None
        stopper = threading.Thread(target=under_test.sampler.stop)
        stopper.start()
        list(under_test.blocks())
        stopper.join()
        under_test.sampler.stop()
        assert under_test.sampler.read(NEVER) is None
        assert indices(under_test.record(rest(0.1)))[-1] == 99


class HangingCard(Card):
    """A card whose driver does not return while `hangs` is set."""

    def __init__(self, bench: SimulatedBench) -> None:
        super().__init__(bench)
        self.hangs = False
        self.released = threading.Event()

    def read_analog_f64(self, task: int, samples: int, timeout_s: float, fill: int, out: FloatArray) -> int:
        if self.hangs:
            self.released.wait(600.0)
        return super().read_analog_f64(task, samples, timeout_s, fill, out)


@pytest.mark.parametrize(
    ("brakes_mm_s2", "profile"),
    [(3000.0, stroke(travel_mm=100.0, speed_mm_s=10.0)), (50.0, stroke(travel_mm=25.0, speed_mm_s=50.0))],
    ids=["hard", "beyond the profile's end"],
)
def test_sampling_goes_on_until_a_stopped_stage_stands(brakes_mm_s2: float, profile: MotionProfile) -> None:
    stage = {"max_accel_mm_s2": min(brakes_mm_s2, 3000.0), "stop_accel_mm_s2": brakes_mm_s2}
    with card_rig(RigSettings.model_validate({"stage": stage})) as under_test:
        under_test.begin(profile)
        got = [under_test.sampler.read(NEVER) for _ in range(3)]
        under_test.stop_stage()
        got.extend(under_test.blocks())
        under_test.sampler.stop()
        under_test.settle()
        stands_mm = under_test.bench.position_mm() - under_test.rig.stage.start_mm
    assert (len(indices(got)) > profile.samples(1000.0)) is (brakes_mm_s2 < 100.0)
    assert joined(got, "position")[-1] == pytest.approx(stands_mm, abs=0.002)
    assert np.ptp(joined(got, "position")[-10:]) == 0.0


def test_samples_that_a_slow_driver_held_back_reach_to_the_standstill() -> None:
    cards: list[HangingCard] = []

    def hanging(bench: SimulatedBench) -> Card:
        cards.append(HangingCard(bench))
        return cards[0]

    with card_rig(wired(), card=hanging) as under_test:
        under_test.begin(stroke(travel_mm=100.0, speed_mm_s=50.0))
        got = [under_test.sampler.read(NEVER)]
        cards[0].hangs = True
        under_test.bench.clock.sleep(0.3, NEVER)
        under_test.stop_stage()
        under_test.settle()
        cards[0].hangs = False
        cards[0].released.set()
        got.extend(under_test.blocks())
        under_test.sampler.stop()
        stands_mm = under_test.bench.position_mm() - under_test.rig.stage.start_mm
    assert joined(got, "position")[-1] == pytest.approx(stands_mm, abs=0.002)


def test_stage_stopped_before_the_first_sample_leaves_nothing_to_read() -> None:
    with card_rig(wired()) as under_test:
        under_test.sampler.arm(acquire(stroke()))
        under_test.sync.set_stop_requested()
        under_test.sampler.start()
        assert under_test.sampler.read(NEVER) is None


@pytest.mark.parametrize(
    ("trouble", "cause", "words"),
    [
        ({"force_added_mN": 9950.0}, TripCause.SENSOR_OVERLOAD, "ai0 .* overloaded"),
        ({"sensor_open": True}, TripCause.SENSOR_OPEN, "ai0 .* unplugged"),
    ],
)
def test_sensor_overloaded_or_cut_off_is_a_fault_of_its_block(
    trouble: dict[str, float], cause: TripCause, words: str
) -> None:
    with card_rig(wired()) as under_test:
        got = under_test.record(rest(0.4), lambda _: under_test.bench.faults.inject(**trouble))
    faults = [block.fault for block in got]
    assert faults[0] is None
    assert faults[-1] is not None
    assert faults[-1].cause is cause
    assert faults[-1].message
    assert re.search(words, faults[-1].message)


def test_driver_that_does_not_return_hangs_neither_stop_nor_the_program() -> None:
    cards: list[HangingCard] = []

    def hanging(bench: SimulatedBench) -> Card:
        cards.append(HangingCard(bench))
        return cards[0]

    rig = RigSettings.model_validate({"guard": {"stale_data_s": 0.5}, "hardware": {"hang_s": 0.5}})
    with card_rig(rig, card=hanging) as under_test:
        under_test.begin(rest(60.0), moves=False)
        assert under_test.sampler.read(NEVER) is not None
        cards[0].hangs = True
        with pytest.raises(StaleDataError):
            list(under_test.blocks())
        with pytest.raises(DeviceError, match=r"has not returned"):
            under_test.sampler.stop()
        under_test.sampler.stop()
        with pytest.raises(DeviceError, match="still reserved"):
            under_test.sampler.arm(acquire(rest(0.1)))
        cards[0].hangs = False
        cards[0].released.set()
        for thread in threading.enumerate():
            if thread.name == "card reader":
                thread.join()
        assert indices(under_test.record(rest(0.1)))[-1] == 99


def test_measurement_gives_raw_volts_and_directed_counts() -> None:
    with card_rig(wired(encoder={"reversed": True}, force={"per_V": 500.0, "zero_V": 0.25})) as under_test:
        under_test.bench.follow(stroke(travel_mm=2.0, rest_s=0.1).pieces())
        reading = under_test.sampler.measure(0.5)
        volts = under_test.bench.at("force_V", np.arange(reading.samples))
    assert reading.samples == 500
    assert reading.force_V == pytest.approx(volts.mean(), abs=1e-4)
    assert reading.force_V_sd == pytest.approx(volts.std(), rel=0.02)
    assert reading.counts_end - reading.counts_begin == pytest.approx(2000, abs=2)


def test_a_measurement_ends_soon_after_it_is_cancelled() -> None:
    cancel = threading.Event()
    cancel.set()
    with card_rig(wired()) as under_test:
        reading = under_test.sampler.measure(0.5, cancel)
        assert 0 < reading.samples < 500
        assert under_test.sampler.measure(0.1).samples == 100


def test_what_the_card_cannot_convert_is_refused_with_the_rate_that_it_can() -> None:
    with (
        pytest.raises(SettingsError, match=r"83,333"),
        card_rig(wired(100_000.0, inputs=INPUTS)),
    ):
        pass


@pytest.mark.parametrize(
    ("card", "complaint"),
    [
        ({"force": {"range_V": 4.0}}, "range_V"),
        ({"inputs": [INPUTS[0], {**INPUTS[0], "channel": "ai3"}]}, "motor_force"),
        ({"inputs": [{**INPUTS[0], "channel": "ai0"}]}, "ai0"),
        ({"inputs": [{**INPUTS[0], "name": "position"}]}, "position"),
    ],
)
def test_wiring_that_contradicts_itself_is_refused(card: dict[str, object], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        wired(**card)


def test_switches_are_normally_closed() -> None:
    with card_rig(wired(lines={"heartbeat": "port1/line4"})) as under_test:
        bench = under_test.bench
        lines = CardLines(under_test.connection)
        assert lines.read_switches() == SwitchStates()
        bench.faults.inject(e_stop_pressed=True)
        assert lines.read_switches() == SwitchStates(e_stop=True)
        bench.faults.clear()
        bench.faults.inject(limit_low_pressed=True, limit_high_pressed=True)
        assert lines.read_switches() == SwitchStates(limit_low=True, limit_high=True)
        bench.faults.clear()
        lines.set_enable(True)
        assert bench.read_line("port1/line0")
        beats = []
        for _ in range(3):
            lines.toggle_heartbeat()
            beats.append(bench.read_line("port1/line4"))
        assert beats == [True, False, True]
        bench.faults.inject(card_unplugged=True)
        with pytest.raises(DeviceError, match="its switches are read: it was unplugged"):
            lines.read_switches()
        bench.faults.clear()
        lines.close()
        lines.close()
        assert not bench.read_line("port1/line0")
        # As a program that was killed leaves it: whoever opens the lines next clears it first.
        bench.write_line("port1/line0", True)
        again = CardLines(under_test.connection)
        assert not bench.read_line("port1/line0")
        assert again.read_switches() == SwitchStates()
        again.close()


def test_lines_that_are_not_wired_are_left_alone() -> None:
    unwired = {"enable": "", "e_stop": "", "limit_low": "", "limit_high": "port1/line3", "heartbeat": ""}
    with card_rig(wired(lines=unwired)) as under_test:
        under_test.bench.faults.inject(e_stop_pressed=True, limit_low_pressed=True, limit_high_pressed=True)
        lines = CardLines(under_test.connection)
        lines.set_enable(True)
        lines.toggle_heartbeat()
        assert lines.read_switches() == SwitchStates(limit_high=True)
        lines.close()


@pytest.mark.parametrize(
    ("stale_s", "pace", "troubles"),
    [
        (
            5.0,
            5.0,
            (
                ({"sensor_open": True}, "force sensor", "unplugged"),
                ({"force_added_mN": 3000.0}, "force sensor", "hanging"),
                ({"e_stop_pressed": True}, "switches", "emergency stop"),
                ({"card_absent": True}, "card", "Dev1"),
                ({"card_reserved": True}, "card", "another program"),
            ),
        ),
        (1.0, 1.0, (({"card_stalled": True}, "card", "no sample"),)),
    ],
)
def test_a_check_without_moving_finds_what_is_wrong(
    stale_s: float, pace: float, troubles: tuple[tuple[dict[str, float], str, str], ...]
) -> None:
    rig = wired().model_copy(update={"guard": GuardSettings(stale_data_s=stale_s)})
    with card_rig(rig, pace=pace) as under_test, closing(CardLines(under_test.connection)) as lines:

        def look() -> dict[str, tuple[bool, str]]:
            scaling = Scaling.from_settings(rig, {})
            checks = check_card(under_test.connection, rig, under_test.sampler, scaling, lines)
            return {check.name: (check.passed, check.detail) for check in checks}

        state = look()
        assert all(ok for ok, _ in state.values()), state
        assert "PCI-6229" in state["card"][1]
        assert "zero" in state["force sensor"][1]
        faults = under_test.bench.faults
        for trouble, subject, words in troubles:
            faults.inject(**trouble)
            ok, detail = look()[subject]
            assert not ok, trouble
            assert words in detail
            faults.clear()


@pytest.mark.parametrize("code", [-200361, -200141, -200279])
def test_samples_lost_on_their_way_are_told_as_such(code: int) -> None:
    answer = str(device_error(DaqError("The manual says more.", code), CardSettings(), "it samples"))
    assert "lost samples" in answer
    assert str(code) in answer
