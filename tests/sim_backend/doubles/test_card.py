"""The PCI-6229's double: real nidaqmx on it through C function pointers, as on NI's library."""

import ctypes
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import nidaqmx
import numpy as np
import pytest
from nidaqmx._lib import lib_importer
from nidaqmx.constants import (
    AcquisitionType,
    EncoderType,
    LengthUnits,
    LineGrouping,
    OverwriteMode,
    ReadRelativeTo,
    RegenerationMode,
    TaskMode,
    TerminalConfiguration,
)
from nidaqmx.errors import DaqError, DaqFunctionNotSupportedError, DaqReadError
from nidaqmx.stream_readers import AnalogMultiChannelReader, CounterReader
from nidaqmx.stream_writers import AnalogSingleChannelWriter

from dragrig.config.friction_model import FrictionModelSettings
from dragrig.rig.profile import FloatArray, trapezoid
from dragrig.sim_backend.doubles import c_library
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.card.pci6229 import CardError
from dragrig.sim_backend.doubles.card.tasks import InputBuffer
from dragrig.sim_backend.doubles.simulated_bench import CONVERTER_NOISE, DoubleClock, SimulatedBench
from simulated import NEVER, settings

CONTINUOUS = AcquisitionType.CONTINUOUS
RATE = 1000.0
STEP_V = 10.0 / 2**15
TASK_STEP_V = 5.0 / 2**15
"""A task that says no range gets ±5 V."""
NOISE_V = 6 * 10.0 * CONVERTER_NOISE
CLOCK = "/Dev1/ai/SampleClock"
TEMPERATURE = {"name": "temperature", "channel": "ai1", "unit": "degC", "per_V": 10.0}


class WatchedBench(SimulatedBench):
    """A bench that knows the voltages that its outputs hold."""

    def put_out(self, output: str, volts: FloatArray, rate_hz: float, at_s: float) -> None:
        super().put_out(output, volts, rate_hz, at_s)
        if not rate_hz:
            self.held_V = {**getattr(self, "held_V", {}), output: float(volts[-1])}


@contextmanager
def card_on(pace: float = 10.0) -> Iterator[tuple[WatchedBench, Card]]:
    # The bench keeps its samples for as long as the card's buffer, so that a test can ask for the truth afterwards.
    rig = settings(RATE, hardware={"card": {"buffer_s": 60.0, "inputs": [TEMPERATURE]}})
    bench = WatchedBench(rig, FrictionModelSettings(), DoubleClock(pace))
    card = Card(bench)
    with c_library.installed(card):
        yield bench, card


@contextmanager
def inputs(
    channels: str = "Dev1/ai0", rate: float = RATE, samples: int = 4000, **limits: float
) -> Iterator[nidaqmx.Task]:
    with nidaqmx.Task() as task:
        task.ai_channels.add_ai_voltage_chan(channels, terminal_config=TerminalConfiguration.DIFF, **limits)
        task.timing.cfg_samp_clk_timing(rate, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=samples)
        yield task


@contextmanager
def encoder(clocked: bool = True, counter: str = "Dev1/ctr0", **options: object) -> Iterator[nidaqmx.Task]:
    answer = {"decoding_type": EncoderType.X_4, "units": LengthUnits.METERS, "dist_per_pulse": 4e-6} | options
    with nidaqmx.Task() as task:
        task.ci_channels.add_ci_lin_encoder_chan(counter, **answer)
        if clocked:
            task.timing.cfg_samp_clk_timing(
                RATE, source=CLOCK, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=4000
            )
        yield task


def volts(task: nidaqmx.Task, samples: int, channels: int = 1, timeout: float = 10.0) -> FloatArray:
    out = np.zeros((channels, samples))
    assert AnalogMultiChannelReader(task.in_stream).read_many_sample(out, samples, timeout) == samples
    return out


def positions(task: nidaqmx.Task, samples: int, timeout: float = 10.0) -> FloatArray:
    out = np.zeros(samples)
    assert CounterReader(task.in_stream).read_many_sample_double(out, samples, timeout) == samples
    return out


def code_of(call: Callable[[], object]) -> int:
    with pytest.raises(DaqError) as caught:
        call()
    assert str(caught.value.error_code) in str(caught.value)
    assert len(str(caught.value)) > 30
    return caught.value.error_code


def wait_until(met: Callable[[], bool]) -> None:
    end = time.monotonic() + 600
    while not met():
        assert time.monotonic() < end
        threading.Event().wait(0.002)


@pytest.mark.parametrize("moves", [False, True])
def test_force_and_encoder_are_the_benchs_sample_for_sample(moves: bool) -> None:
    with card_on() as (bench, _), encoder() as ci, inputs("Dev1/ai0:1") as ai:
        ci.start()
        ai.start()
        if moves:
            bench.follow(trapezoid(3.0, 40.0, 2000.0))
        read = [(volts(ai, 50, 2), positions(ci, 50)) for _ in range(10)]
        truth = bench.sample(0, 500)
    force, temperature = np.concatenate([entry for entry, _ in read], axis=1)
    position = np.concatenate([entry for _, entry in read])
    np.testing.assert_array_equal(force, np.rint(truth["force_V"] / TASK_STEP_V) * TASK_STEP_V)
    np.testing.assert_allclose(temperature, 3.7, atol=NOISE_V)
    np.testing.assert_allclose(position, truth["encoder_counts"] * 1e-6, atol=1e-12)
    assert np.ptp(position) == pytest.approx(3e-3 if moves else 0.0, abs=1e-9)


def test_a_counter_started_after_the_inputs_is_behind_by_what_it_missed() -> None:
    with card_on() as (bench, _), encoder() as ci, inputs() as ai:
        ai.start()
        bench.follow(trapezoid(100.0, 1000.0, 100.0))
        wait_until(lambda: bench.available() > 100)
        ci.start()
        late = positions(ci, 200)
        bench.faults.inject(card_stalled=True)
        truth = bench.sample(0, bench.available())["encoder_counts"]
        behind = ai.in_stream.total_samp_per_chan_acquired - ci.in_stream.total_samp_per_chan_acquired
    steps = np.rint(np.diff(late) * 1e6)
    result = [at for at in range(len(truth) - 200) if np.array_equal(np.diff(truth[at : at + 200]), steps)]
    assert result == [pytest.approx(behind, abs=1)]
    assert behind >= 100


def test_a_counter_gets_no_sample_while_no_input_is_sampled() -> None:
    with card_on(), encoder() as ci:
        ci.start()
        with pytest.raises(DaqReadError) as caught:
            positions(ci, 10, timeout=0.05)
        assert (caught.value.error_code, caught.value.samps_per_chan_read) == (-200284, 0)
        with inputs() as ai:
            ai.start()
            volts(ai, 30)
        assert len(positions(ci, 20)) == 20


def test_what_the_counter_latched_can_be_read_after_the_inputs_ended_and_goes_on_with_them() -> None:
    with card_on() as (bench, _), encoder() as ci:
        ci.start()
        with inputs() as ai:
            ai.start()
            bench.follow(trapezoid(1.0, 40.0, 2000.0))
            wait_until(lambda: not bench.moving)
            volts(ai, 100)
            latched = ci.in_stream.total_samp_per_chan_acquired
        first = positions(ci, latched)
        assert first[0] == 0
        assert first[-1] == pytest.approx(1e-3)
        with inputs() as ai:
            ai.start()
            assert set(positions(ci, 20)) == {first[-1]}


def test_wires_decide_what_a_counter_counts() -> None:
    with card_on() as (bench, _), encoder(clocked=False, initial_pos=7e-6) as ci:
        channel = ci.ci_channels[0]
        wired = channel.ci_encoder_a_input_term, channel.ci_encoder_b_input_term
        assert wired == ("/Dev1/PFI8", "/Dev1/PFI10")
        read_um = []
        for terminals in (wired, wired[::-1], ("PFI0", "PFI1")):
            channel.ci_encoder_a_input_term, channel.ci_encoder_b_input_term = terminals
            ci.start()
            bench.place(bench.position_mm() + 0.005)
            read_um.append(1e6 * ci.read())
            ci.stop()
        assert read_um == pytest.approx([12.0, 2.0, 7.0])


def test_the_index_pulse_sets_the_position() -> None:
    index = {"zidx_enable": True, "zidx_val": 0.1, "initial_pos": 5.0}
    with card_on() as (bench, _), encoder(**index) as ci, inputs() as ai:
        bench.place(-0.5)
        ci.start()
        ai.start()
        bench.follow(trapezoid(1.5, 40.0, 2000.0))
        read = [positions(ci, 25)]
        while read[-1][-1] > 1.0:  # the index was not passed yet
            read.append(positions(ci, 25))
        got = np.concatenate(read)
        counts = bench.sample(0, len(got))["encoder_counts"] - 500
        volts(ai, len(got))
    assert counts[0] < 0 < counts[-1]
    np.testing.assert_allclose(got, np.where(counts < 0, 5.0 + (counts + 500) * 1e-6, 0.1 + counts * 1e-6), atol=1e-9)


def test_the_index_pulse_is_not_missed_between_two_looks() -> None:
    with card_on() as (bench, _), encoder(clocked=False, zidx_enable=True) as ci:
        bench.place(-0.5)
        ci.start()
        assert ci.read() == pytest.approx(0.0)
        bench.place(2.0)
        assert ci.read() == pytest.approx(2e-3)


def test_digital_lines_are_read_and_set_on_demand() -> None:
    with card_on() as (bench, _), ExitStack() as stack:
        di, do = (stack.enter_context(nidaqmx.Task()) for _ in range(2))
        di.di_channels.add_di_chan("Dev1/port1/line1:3", line_grouping=LineGrouping.CHAN_PER_LINE)
        do.do_channels.add_do_chan("Dev1/port1/line0")
        assert di.read() == [True, True, True]
        bench.faults.inject(e_stop_pressed=True)
        assert di.read() == [False, True, True]
        do.write(True)
        assert (do.read(), bench.read_line("port1/line0")) == (True, True)
        port = stack.enter_context(nidaqmx.Task())
        port.do_channels.add_do_chan("Dev1/port2/line0:3", line_grouping=LineGrouping.CHAN_PER_LINE)
        port.write([False, True, False, True])
        assert [bench.read_line(f"port2/line{line}") for line in range(4)] == [False, True, False, True]
        assert port.read() == [False, True, False, True]
        do.start()
        with nidaqmx.Task() as task:
            task.do_channels.add_do_chan("Dev1/port1/line0")
            assert code_of(lambda: task.write(False)) == -200587
    assert bench.read_line("port1/line0")


def test_an_output_holds_its_last_voltage_when_its_task_is_gone() -> None:
    with card_on() as (bench, _):
        with nidaqmx.Task() as ao:
            ao.ao_channels.add_ao_voltage_chan("Dev1/ao0")
            ao.write(1.5)
            assert code_of(lambda: ao.write(10.5)) == -200561
        assert bench.held_V == {"ao0": 1.5}


def test_a_waveform_that_runs_dry_stops_and_holds() -> None:
    with card_on(pace=1.0) as (bench, _), nidaqmx.Task() as ao:
        ao.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        ao.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        ao.out_stream.regen_mode = RegenerationMode.DONT_ALLOW_REGENERATION
        ao.out_stream.output_buf_size = 500
        writer = AnalogSingleChannelWriter(ao.out_stream)
        ramp = np.linspace(0.0, 2.0, 500)
        assert writer.write_many_sample(ramp) == 500
        ao.start()
        assert writer.write_many_sample(ramp[:50]) == 50
        assert ao.out_stream.total_samp_per_chan_generated >= 50
        wait_until(lambda: ao.out_stream.total_samp_per_chan_generated == 550)
        bench.clock.sleep(0.01, NEVER)
        assert code_of(lambda: writer.write_many_sample(ramp)) == -200290
        assert bench.held_V == {"ao0": ramp[49]}
    assert bench.held_V == {"ao0": ramp[49]}


def test_volts_are_clipped_at_the_range() -> None:
    for force_mN, clipped_V in ((7000.0, 5.0 - 5.0 / 2**15), (-7000.0, -5.0)):
        with card_on() as (bench, _), inputs(min_val=-4.0, max_val=4.0) as ai:
            bench.faults.inject(force_added_mN=force_mN)
            ai.start()
            assert set(volts(ai, 3)[0]) == {clipped_V}


def test_the_card_is_found_and_says_what_it_is() -> None:
    with card_on() as (bench, _):
        system = nidaqmx.system.System.local()
        (card,) = system.devices
        assert (card.name, card.product_type) == ("Dev1", "PCI-6229")
        assert card.serial_num > 0
        bench.faults.inject(card_absent=True)
        assert list(system.devices) == []
        assert code_of(lambda: card.product_type) == -200220


def test_the_driver_is_what_it_was_before_once_the_double_is_gone() -> None:
    before = lib_importer._windll, lib_importer._cdll, lib_importer._encoding
    with card_on():
        assert lib_importer._windll is not before[0]
    assert (lib_importer._windll, lib_importer._cdll, lib_importer._encoding) == before


def add_input(channel: str, **options: object) -> Callable[[nidaqmx.Task], object]:
    return lambda task: task.ai_channels.add_ai_voltage_chan(channel, **options)


def set_clock(rate: float, **options: object) -> Callable[[nidaqmx.Task], object]:
    def configure(task: nidaqmx.Task) -> None:
        task.ai_channels.add_ai_voltage_chan("Dev1/ai0:2")
        task.timing.cfg_samp_clk_timing(rate, **options)

    return configure


def set_encoder(**attributes: object) -> Callable[[nidaqmx.Task], object]:
    def configure(task: nidaqmx.Task) -> None:
        channel = task.ci_channels.add_ci_lin_encoder_chan("Dev1/ctr0")
        for name, value in attributes.items():
            setattr(channel, f"ci_encoder_{name}", value)

    return configure


@pytest.mark.parametrize(
    ("code", "wrong"),
    [
        (-200220, add_input("Dev2/ai0")),
        (-200170, add_input("Dev1/ai32")),
        (-200170, lambda task: task.ci_channels.add_ci_lin_encoder_chan("Dev1/ctr2")),
        (-200170, lambda task: task.di_channels.add_di_chan("Dev1/port1/line8")),
        (-200077, add_input("Dev1/ai0", min_val=-11.0, max_val=11.0)),
        (-200082, add_input("Dev1/ai0", min_val=1.0, max_val=-1.0)),
        (-200077, add_input("Dev1/ai8", terminal_config=TerminalConfiguration.DIFF)),
        (-200489, lambda task: [add_input("Dev1/ai0")(task) for _ in range(2)]),
        (-200430, lambda task: [add_input("Dev1/ai0")(task), task.ao_channels.add_ao_voltage_chan("Dev1/ao0")]),
        (-200077, lambda task: task.ao_channels.add_ao_voltage_chan("Dev1/ao0", min_val=-12.0, max_val=12.0)),
        (-200081, set_clock(90_000.0)),
        (-200077, set_clock(-1.0)),
        (-200077, set_clock(1000.0, sample_mode=AcquisitionType.HW_TIMED_SINGLE_POINT)),
        (-89120, set_clock(1000.0, source="/Dev1/PFI99")),
        (-89120, set_encoder(a_input_term="/Dev1/PFI16")),
        (-200077, set_encoder(a_input_dig_fltr_min_pulse_width=1e-6)),
        (-200303, lambda task: [set_encoder()(task), task.timing.cfg_samp_clk_timing(1000.0, sample_mode=CONTINUOUS),
                                task.start()]),
        (-200478, lambda task: task.start()),
        (-200478, lambda task: task.timing.cfg_samp_clk_timing(1000.0)),
        (-200479, lambda task: [add_input("Dev1/ai0")(task), task.start(), add_input("Dev1/ai1")(task)]),
        (-200197, lambda task: task.in_stream.overloaded_chans_exist),
        (-200089, lambda task: nidaqmx.Task(task.name)),
        (-200472, lambda task: [task.do_channels.add_do_chan("Dev1/port1/line0"), task.write(True, auto_start=False)]),
    ],
)  # fmt: skip
def test_a_wrong_configuration_is_refused_with_the_drivers_code(
    code: int, wrong: Callable[[nidaqmx.Task], object]
) -> None:
    with card_on(), nidaqmx.Task() as task:
        assert code_of(lambda: wrong(task)) == code


def test_the_full_rate_of_three_channels_is_taken() -> None:
    with card_on(), inputs("Dev1/ai0:2", rate=83_333.0) as ai:
        assert ai.timing.samp_clk_rate == pytest.approx(83_333.0, rel=1e-5)


def test_inputs_and_counters_belong_to_one_task_at_a_time() -> None:
    with card_on() as (bench, _), inputs("Dev1/ai1") as second, encoder() as ci, encoder() as third:
        with inputs() as ai:
            ai.control(TaskMode.TASK_RESERVE)
            ci.start()
            assert code_of(second.start) == -50103
            assert code_of(third.start) == -50103
            with encoder(counter="Dev1/ctr1", clocked=False) as neighbour:
                neighbour.start()
        second.start()
        second.stop()
        bench.faults.inject(card_reserved=True)
        assert code_of(second.start) == -50103


@pytest.mark.parametrize(("trouble", "code"), [("card_unplugged", -201003), ("card_gone", -88705)])
def test_a_waiting_read_hears_at_once_that_the_card_is_gone(trouble: str, code: int) -> None:
    with card_on() as (bench, _), inputs(samples=100_000) as ai:
        ai.start()
        codes: list[int] = []
        reader = threading.Thread(target=lambda: codes.append(code_of(lambda: volts(ai, 90_000, timeout=3600.0))))
        reader.start()
        wait_until(lambda: ai.in_stream.total_samp_per_chan_acquired > 0)
        bench.faults.inject(**{trouble: True})
        reader.join(600)
        assert codes == [code]
        assert code_of(ai.stop) == code
        with nidaqmx.Task() as task:
            assert code_of(lambda: task.di_channels.add_di_chan("Dev1/port1/line1")) == code
        bench.faults.clear()
        ai.start()
        assert volts(ai, 5).shape == (1, 5)


def test_a_stop_ends_a_read_that_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, read = threading.Event(), InputBuffer.read

    def announced_read(
        buffer: InputBuffer, first: int, samples: int, timeout_s: float, short_reads: int
    ) -> tuple[int, CardError | None]:
        # The card's lock is held from here until the read waits, so that a stop comes later.
        reading.set()
        return read(buffer, first, samples, timeout_s, short_reads)

    monkeypatch.setattr(InputBuffer, "read", announced_read)
    with card_on() as (_, _), inputs(samples=100_000) as ai:
        ai.start()
        codes: list[int] = []
        reader = threading.Thread(target=lambda: codes.append(code_of(lambda: volts(ai, 90_000, timeout=3600.0))))
        reader.start()
        assert reading.wait(600)
        ai.stop()
        reader.join(600)
        assert codes == [-88710]


def test_a_timeout_leaves_what_came_at_the_arrays_beginning() -> None:
    with card_on() as (bench, _), inputs("Dev1/ai0:1") as ai:
        ai.start()
        wait_until(lambda: bench.available() > 40)
        bench.faults.inject(card_stalled=True)
        there = ai.in_stream.total_samp_per_chan_acquired
        out = np.full((2, there + 60), np.nan)
        with pytest.raises(DaqReadError) as caught:
            AnalogMultiChannelReader(ai.in_stream).read_many_sample(out, there + 60, 0.05)
        assert (caught.value.error_code, caught.value.samps_per_chan_read) == (-200284, there)
        truth = bench.sample(0, there + 10)["force_V"]
        force, temperature = out.ravel()[: 2 * there].reshape(2, there)
        np.testing.assert_allclose(force, truth[:there], atol=STEP_V)
        np.testing.assert_allclose(temperature, 3.7, atol=NOISE_V)
        bench.faults.clear()
        np.testing.assert_allclose(volts(ai, 10, 2)[0], truth[there:], atol=STEP_V)


def test_a_short_read_happens_as_often_as_told() -> None:
    with card_on() as (bench, _), inputs() as ai:
        bench.faults.inject(short_reads=1)
        ai.start()
        with pytest.raises(DaqReadError) as caught:
            volts(ai, 50)
        assert caught.value.samps_per_chan_read == 25
        np.testing.assert_allclose(volts(ai, 50)[0], bench.sample(25, 75)["force_V"], atol=STEP_V)


def test_what_nobody_read_in_time_is_lost_and_the_rest_found_by_its_index() -> None:
    with card_on(pace=5.0) as (bench, _), inputs(samples=2000) as ai:
        ai.in_stream.input_buf_size = 2000
        ai.in_stream.overwrite = OverwriteMode.OVERWRITE_UNREAD_SAMPLES
        ai.start()
        first = volts(ai, 50)
        wait_until(lambda: bench.available() > 2500)
        bench.faults.inject(card_stalled=True)
        assert code_of(lambda: volts(ai, 50)) == -200279
        assert code_of(lambda: volts(ai, 50)) == -200279
        total = ai.in_stream.total_samp_per_chan_acquired
        truth = bench.sample(0, total)["force_V"]
        ai.in_stream.relative_to, ai.in_stream.offset = ReadRelativeTo.FIRST_SAMPLE, total - 400
        result = volts(ai, 100)
        ai.in_stream.relative_to, ai.in_stream.offset = ReadRelativeTo.CURRENT_READ_POSITION, 0
        further = volts(ai, 100)
    for got, index in ((first, 0), (result, total - 400), (further, total - 300)):
        np.testing.assert_allclose(got[0], truth[index : index + got.shape[1]], atol=STEP_V)


def test_a_loss_can_be_made_to_happen_in_both_tasks() -> None:
    with card_on() as (bench, _), encoder() as ci, inputs() as ai:
        for task in (ci, ai):
            task.in_stream.overwrite = OverwriteMode.OVERWRITE_UNREAD_SAMPLES
            task.start()
        volts(ai, 50)
        positions(ci, 50)
        bench.faults.inject(overwritten_samples=120)
        for task, read in ((ai, volts), (ci, positions)):
            assert code_of(lambda read=read, task=task: read(task, 50)) == -200279
            task.in_stream.relative_to, task.in_stream.offset = ReadRelativeTo.FIRST_SAMPLE, 170
            assert read(task, 50).shape[-1] == 50
            assert task.in_stream.curr_read_pos == 220


def test_arrays_that_ni_would_not_take_are_refused() -> None:
    with card_on(), inputs() as ai:
        ai.start()
        reader = AnalogMultiChannelReader(ai.in_stream)
        for wrong in (np.zeros((1, 50), np.float32), np.zeros((1, 100))[:, ::2]):
            reader.verify_array_shape = False
            with pytest.raises(ctypes.ArgumentError):
                reader.read_many_sample(wrong, 50, 1.0)
        assert code_of(lambda: reader.read_many_sample(np.zeros((1, 20)), 50, 1.0)) == -200229


def test_a_function_that_the_double_lacks_is_called_unsupported() -> None:
    with card_on(), inputs() as ai, pytest.raises(DaqFunctionNotSupportedError, match="RegisterEveryNSamplesEvent"):
        ai.register_every_n_samples_acquired_into_buffer_event(50, lambda *_: 0)
