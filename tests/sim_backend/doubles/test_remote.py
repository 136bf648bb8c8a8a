"""The doubles in another process: NI's real client over gRPC, the control socket, and how the process ends."""

import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import grpc
import nidaqmx
import nidaqmx.system
import numpy as np
import psutil
import pytest
import serial
from nidaqmx.constants import AcquisitionType, EncoderType, LengthUnits, ReadRelativeTo, TaskMode, TerminalConfiguration
from nidaqmx.errors import DaqError, DaqReadError, Error, RpcError
from nidaqmx.stream_readers import AnalogMultiChannelReader, CounterReader

from card_server import UNLIMITED_MESSAGES, CardServer
from dragrig.config.errors import DeviceError
from dragrig.config.friction_model import FrictionModelSettings
from dragrig.config.rig import CardSettings, RigSettings
from dragrig.config.settings import to_toml
from dragrig.rig.devices import Acquisition
from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.card.sampler import CardSampler
from dragrig.rig.hardware.dialects.base import Command, Halt, Parameter, Reply, Request, find_dialect
from dragrig.rig.hardware.sync import MotionSamplingSync
from dragrig.rig.profile import FloatArray, trapezoid
from dragrig.sim_backend.doubles.card.card import Card
from dragrig.sim_backend.doubles.simulated_bench import DoubleClock, FaultInjector, SimulatedBench
from driving import until
from places import SUPPORT
from remote_doubles import ControlClient, RemoteDoubles, StageStatus
from remote_server import ControlServer
from simulated import NEVER, acquire, rest, settings, stroke

INPUT = {"name": "motor_force", "channel": "ai1", "unit": "mN", "per_V": 1000.0}
METRES = 1e-6

GHOST_V = 1.01 * 10.0 / 2**15
"""Inputs that follow each other fast keep a little of the one before, here far less than a converter's step."""


def rig(rate_hz: float = 50_000.0) -> RigSettings:
    return settings(rate_hz, hardware={"card": {"inputs": [INPUT]}})


@contextmanager
def connected(port: int) -> Iterator[nidaqmx.GrpcSessionOptions]:
    with grpc.insecure_channel(f"127.0.0.1:{port}", options=UNLIMITED_MESSAGES) as channel:
        yield nidaqmx.GrpcSessionOptions(channel, "")


@pytest.fixture
def bench() -> SimulatedBench:
    return SimulatedBench(rig(), FrictionModelSettings(), DoubleClock(2.0))


@pytest.fixture
def options(bench: SimulatedBench) -> Iterator[nidaqmx.GrpcSessionOptions]:
    with CardServer(Card(bench)) as server, connected(server.port) as options:
        yield options


def analog(task: nidaqmx.Task, rate_hz: float = 50_000.0, buffer: int = 200_000) -> nidaqmx.Task:
    task.ai_channels.add_ai_voltage_chan("Dev1/ai0:1", terminal_config=TerminalConfiguration.DIFF, min_val=-10.0)
    task.timing.cfg_samp_clk_timing(rate_hz, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=buffer)
    return task


def encoder(task: nidaqmx.Task) -> nidaqmx.Task:
    task.ci_channels.add_ci_lin_encoder_chan(
        "Dev1/ctr0", decoding_type=EncoderType.X_4, units=LengthUnits.METERS, dist_per_pulse=4 * METRES
    )
    task.timing.cfg_samp_clk_timing(
        50_000.0, "/Dev1/ai/SampleClock", sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=200_000
    )
    return task


def test_a_hundred_thousand_samples_of_three_channels_are_the_worlds(
    bench: SimulatedBench, options: nidaqmx.GrpcSessionOptions
) -> None:
    block, blocks = 2500, 40
    volts, metres = np.zeros((2, block)), np.zeros(block)
    with nidaqmx.Task(grpc_options=options) as counter, nidaqmx.Task(grpc_options=options) as inputs:
        force, position = AnalogMultiChannelReader(analog(inputs).in_stream), CounterReader(encoder(counter).in_stream)
        bench.present(acquire(stroke()))
        counter.start()
        inputs.start()
        bench.follow(trapezoid(30.0, 60.0, 2000.0))
        moved = False
        for first in range(0, block * blocks, block):
            assert force.read_many_sample(volts, block, 10.0) == block
            assert position.read_many_sample_double(metres, block, 10.0) == block
            true = bench.sample(first, first + block)
            np.testing.assert_allclose(volts[0], converted(true["force_V"]), rtol=0, atol=GHOST_V)
            np.testing.assert_allclose(volts[1], converted(true["motor_force"]), rtol=0, atol=GHOST_V)
            np.testing.assert_allclose(metres / METRES, true["encoder_counts"], rtol=0, atol=1e-6)
            moved = moved or bool(np.ptp(metres))
        assert moved
        assert inputs.in_stream.total_samp_per_chan_acquired >= block * blocks


def test_a_read_may_outgrow_a_message_of_four_megabytes() -> None:
    bench = SimulatedBench(rig(), FrictionModelSettings(), DoubleClock(5.0))
    volts = np.zeros((2, 270_000))
    with CardServer(Card(bench)) as server:
        connection = Connection(bench.rig.hardware.card.model_copy(update={"server": f"127.0.0.1:{server.port}"}))
        with connection.task() as task:
            reader = AnalogMultiChannelReader(analog(task, 125_000.0, 3_000_000).in_stream)
            task.start()
            assert reader.read_many_sample(volts, 270_000, 600.0) == 270_000
            np.testing.assert_allclose(volts[0], converted(bench.sample(0, 270_000)["force_V"]), rtol=0, atol=GHOST_V)
        connection.close()


def converted(volts: FloatArray) -> FloatArray:
    """What a converter of 16 bits makes of volts within ±10 V."""
    step_V = 10.0 / 2**15
    return np.rint(volts / step_V).clip(-(2**15), 2**15 - 1) * step_V


def test_reads_from_an_absolute_index(bench: SimulatedBench, options: nidaqmx.GrpcSessionOptions) -> None:
    volts = np.zeros((2, 100))
    with nidaqmx.Task(grpc_options=options) as task:
        reader = AnalogMultiChannelReader(analog(task).in_stream)
        task.start()
        task.in_stream.relative_to = ReadRelativeTo.FIRST_SAMPLE
        task.in_stream.offset = 5000
        assert reader.read_many_sample(volts, 100, 10.0) == 100
        np.testing.assert_array_equal(volts[0], converted(bench.sample(5000, 5100)["force_V"]))


def test_what_came_before_a_timeout_is_kept(bench: SimulatedBench, options: nidaqmx.GrpcSessionOptions) -> None:
    volts = np.zeros((2, 2000))
    with nidaqmx.Task(grpc_options=options) as task:
        reader = AnalogMultiChannelReader(analog(task).in_stream)
        task.start()
        bench.faults.inject(short_reads=1)
        with pytest.raises(DaqReadError) as short:
            reader.read_many_sample(volts, 2000, 10.0)
        assert short.value.error_code == -200284
        came = short.value.samps_per_chan_read
        assert came == 1000
        second = volts.ravel()[came : 2 * came]  # the driver packs what came, so channels do not begin at rows
        np.testing.assert_array_equal(second, converted(bench.sample(0, came)["motor_force"]))
        assert reader.read_many_sample(volts, 2000, 10.0) == 2000
        np.testing.assert_array_equal(volts[0], converted(bench.sample(came, came + 2000)["force_V"]))


@pytest.mark.parametrize(
    ("trouble", "code"),
    [({"card_unplugged": True}, -201003), ({"card_gone": True}, -88705), ({"overwritten_samples": 5000}, -200279)],
)
def test_a_read_that_fails_says_which_way(
    bench: SimulatedBench, options: nidaqmx.GrpcSessionOptions, trouble: dict[str, float], code: int
) -> None:
    with nidaqmx.Task(grpc_options=options) as task:
        reader = AnalogMultiChannelReader(analog(task).in_stream)
        task.start()
        reader.read_many_sample(np.zeros((2, 100)), 100, 10.0)
        bench.faults.inject(**trouble)
        with pytest.raises(DaqReadError) as failed:
            reader.read_many_sample(np.zeros((2, 100)), 100, 10.0)
        assert failed.value.error_code == code
        bench.faults.clear()


def test_a_card_that_is_absent_or_taken_says_so(bench: SimulatedBench, options: nidaqmx.GrpcSessionOptions) -> None:
    bench.faults.inject(card_reserved=True)
    with nidaqmx.Task(grpc_options=options) as task:
        analog(task)
        with pytest.raises(DaqError) as taken:
            task.control(TaskMode.TASK_RESERVE)
    assert taken.value.error_code == -50103
    bench.faults.clear()
    bench.faults.inject(card_absent=True)
    with nidaqmx.Task(grpc_options=options) as task, pytest.raises(DaqError) as absent:
        analog(task)
    assert absent.value.error_code == -200220


def test_lines_voltage_and_the_cards_own_name(bench: SimulatedBench, options: nidaqmx.GrpcSessionOptions) -> None:
    with nidaqmx.Task(grpc_options=options) as task:
        task.di_channels.add_di_chan("Dev1/port1/line1")
        assert task.read() is True
        bench.faults.inject(e_stop_pressed=True)
        assert task.read() is False
    with nidaqmx.Task(grpc_options=options) as task:
        task.do_channels.add_do_chan("Dev1/port1/line0")
        task.write(True)
        assert bench.read_line("port1/line0")
    with nidaqmx.Task(grpc_options=options) as task:
        task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        task.write(1.5)
    device = next(iter(nidaqmx.system.System.remote(options).devices))
    assert (device.name, device.product_type) == ("Dev1", "PCI-6229")
    assert device.serial_num > 0


def test_a_task_outlives_a_client_that_died(bench: SimulatedBench) -> None:
    with CardServer(Card(bench)) as server:
        with connected(server.port) as options:
            left = analog(nidaqmx.Task("force", grpc_options=options))
            left.start()
        with connected(server.port) as options:
            with nidaqmx.Task(grpc_options=options) as task, pytest.raises(DaqError) as taken:
                analog(task).start()
            assert taken.value.error_code == -50103
            nidaqmx.Task("force", grpc_options=options).close()
            with nidaqmx.Task(grpc_options=options) as task:
                analog(task).start()


def test_a_dead_server_is_an_error_of_the_library_but_none_of_the_cards(bench: SimulatedBench) -> None:
    server = CardServer(Card(bench))
    with server, connected(server.port) as options:
        task = analog(nidaqmx.Task(grpc_options=options))
        task.start()
        server.stop()
        with pytest.raises(RpcError) as dead:
            AnalogMultiChannelReader(task.in_stream).read_many_sample(np.zeros((2, 100)), 100, 10.0)
        assert dead.value.rpc_code is grpc.StatusCode.UNAVAILABLE
        assert isinstance(dead.value, Error)
        assert not isinstance(dead.value, DaqError)


def test_without_grpc_one_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "grpc", None)
    with pytest.raises(DeviceError, match=r"install dragrig\[grpc\]\.$"):
        Connection(CardSettings(server="127.0.0.1:1")).task()


def test_an_acquisition_is_the_same_on_the_other_side() -> None:
    arguments = replace(acquire(stroke()), shear_strain=0.1, sheared_from=0.3)
    presented: list[Acquisition] = []
    with ControlServer(FaultInjector(), presented.append, standing, threading.Event()) as server:
        control = ControlClient(server.port)
        control.present(arguments)
        assert control.stage() == standing()
        control.close()
    (got,) = presented
    times = np.linspace(0, arguments.profile.duration_s, 1001)
    np.testing.assert_allclose(got.profile.position(times), arguments.profile.position(times), atol=1e-12)
    assert replace(got, profile=arguments.profile) == arguments


def standing() -> StageStatus:
    return StageStatus(position_mm=1.5, speed_mm_s=0.0, moving=False, enabled=True, homed=True, halt=Halt.STOP)


@pytest.mark.parametrize("line", [b"\n", b"{}\n", b"[1]\n", b'{"ask": "dance"}\n', b"\xff\n", b'{"ask": "present"}\n'])
def test_a_request_that_is_none_gets_a_sentence_back(line: bytes) -> None:
    with ControlServer(FaultInjector(), print, standing, threading.Event()) as server:
        assert server.reply(line).error.startswith("Control of the doubles, ")


@pytest.mark.thorough
def test_the_control_socket_sets_looks_and_refuses_and_a_bystander_sees_a_silent_programs_stage_stop() -> None:
    with RemoteDoubles(rig(1000.0), pace=2.0) as doubles, connected(card_port(doubles)) as options:
        assert doubles.control.stage().position_mm == doubles.rig().stage.start_mm
        fall_silent_in_motion(doubles, options)
        until(lambda: not doubles.control.stage().moving)
        look = doubles.control.stage()
        assert look.halt is Halt.SILENCE
        assert look.position_mm < 100.0
        assert look.speed_mm_s == 0.0
        assert look.enabled
        with nidaqmx.Task(grpc_options=options) as task:
            task.di_channels.add_di_chan("Dev1/port1/line1")
            doubles.control.set_faults(e_stop_pressed=True)
            doubles.control.set_faults(sensor_open=True)
            assert task.read() is False
            doubles.control.set_faults(e_stop_pressed=False)
            assert task.read() is True
        with pytest.raises(DeviceError, match=r"fault 'e_stop'.*e_stop_pressed"):
            doubles.control.set_faults(e_stop=True)
        with pytest.raises(DeviceError, match="fault force_added_mN"):
            doubles.control.set_faults(force_added_mN="much")
        doubles.control.shut_down()
        assert psutil.Process(doubles.process_id).wait(600) in {0, None}


@pytest.mark.thorough
def test_the_sampler_records_through_another_process_and_says_when_that_is_gone() -> None:
    with RemoteDoubles(rig(1000.0), pace=2.0) as doubles:
        connection = Connection(doubles.rig().hardware.card)
        sampler = CardSampler(connection, doubles.rig(), {}, MotionSamplingSync(), DoubleClock(2.0))
        sampler.arm(acquire(rest(0.5)))
        sampler.start()
        end = 0
        while (block := sampler.read(NEVER)) is not None:
            assert block.first_index == end
            end = block.end_index
        assert end == 500
        sampler.stop()
        sampler.arm(acquire(rest(60.0)))
        sampler.start()
        assert sampler.read(NEVER) is not None
        psutil.Process(doubles.process_id).kill()
        with pytest.raises(DeviceError, match="no NI gRPC device server answers"):
            deque(iter(lambda: sampler.read(NEVER), None), maxlen=0)
        sampler.stop()
        connection.close()


READER = """
import sys
from pathlib import Path
from simulated import NEVER, acquire, rest
from dragrig.config.errors import StaleDataError
from dragrig.config.rig import RigSettings
from dragrig.config.settings import read_settings_file
from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.card.sampler import CardSampler
from dragrig.rig.hardware.sync import MotionSamplingSync
from dragrig.sim_backend.doubles.simulated_bench import DoubleClock
rig = read_settings_file(RigSettings, Path(sys.argv[1]))
sampler = CardSampler(Connection(rig.hardware.card, 0.3), rig, {}, MotionSamplingSync(), DoubleClock())
sampler.arm(acquire(rest(3.0)))
sampler.start()
while True:
    try:
        block = sampler.read(NEVER)
    except StaleDataError:
        continue
    if block is None:
        break
    print(block.first_index, block.end_index, flush=True)
"""


@pytest.mark.thorough
def test_a_program_that_stood_still_for_longer_than_a_call_may_take_loses_no_sample(tmp_path: Path) -> None:
    with RemoteDoubles(rig(1000.0)) as doubles:
        (tmp_path / "rig.toml").write_text(to_toml(doubles.rig()), "utf-8")
        program, here = [sys.executable, "-c", READER, str(tmp_path / "rig.toml")], SUPPORT
        with subprocess.Popen(program, stdout=subprocess.PIPE, text=True, cwd=here) as reader:
            assert reader.stdout is not None
            blocks = [reader.stdout.readline()]
            for place_s in (0.01, 0.02, 0.03):
                time.sleep(place_s)  # into the wait for the next block
                psutil.Process(reader.pid).suspend()
                time.sleep(0.6)
                psutil.Process(reader.pid).resume()
                blocks.append(reader.stdout.readline())
            blocks += reader.stdout
        assert reader.returncode == 0
    first, end = zip(*(map(int, block.split()) for block in blocks if block), strict=True)
    assert first == (0, *end[:-1])
    assert end[-1] == 3000


class Caller:
    """A program that talks to the drive through its port, as far as these tests need one."""

    def __init__(self, doubles: RemoteDoubles) -> None:
        drive = doubles.rig().hardware.drive
        self._dialect, self._drive = find_dialect(drive.dialect), drive
        self._serial = serial.serial_for_url(drive.port, timeout=10.0)

    def ask(self, command: Command, parameter: Parameter | None = None, value: float | None = None) -> Reply:
        request = Request(command, parameter, value)
        [frame] = self._dialect.encode(request, self._drive)
        self._serial.write(frame)
        received = b""
        while not self._dialect.frame_length(received):
            received += self._serial.read(1)
        reply = self._dialect.decode(request, (received,), self._drive)
        assert isinstance(reply, Reply)
        assert reply.refusal is None, reply
        return reply

    def close(self) -> None:
        self._serial.close()


def fall_silent_in_motion(doubles: RemoteDoubles, options: nidaqmx.GrpcSessionOptions) -> None:
    with nidaqmx.Task(grpc_options=options) as task:
        task.do_channels.add_do_chan("Dev1/port1/line0")
        task.write(True)
    caller = Caller(doubles)
    caller.ask(Command.SET, Parameter.HOMING_SPEED_MM_S, 50.0)
    caller.ask(Command.ENABLE)
    caller.ask(Command.HOME, value=-1.0)
    status = caller.ask(Command.STATUS).status
    while status is not None and not status.homed:
        status = caller.ask(Command.STATUS).status
    for parameter, value in ((Parameter.SPEED_MM_S, 10.0), (Parameter.ACCELERATION_MM_S2, 1000.0)):
        caller.ask(Command.SET, parameter, value)
    caller.ask(Command.SET, Parameter.SILENCE_S, 0.3)
    caller.ask(Command.GO, value=140.0)
    caller.close()


def card_port(doubles: RemoteDoubles) -> int:
    return int(doubles.rig().hardware.card.server.rpartition(":")[2])


PARENT = """
import os, sys, signal
from dragrig.config.rig import RigSettings
from remote_doubles import RemoteDoubles
doubles = RemoteDoubles(RigSettings())
doubles.start()
print(doubles.process_id, flush=True)
signal.pause() if hasattr(signal, "pause") else sys.stdin.read()
"""


@pytest.mark.thorough
def test_the_doubles_end_with_the_process_that_started_them() -> None:
    program, here = [sys.executable, "-c", PARENT], SUPPORT
    with subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=here) as parent:
        assert parent.stdout is not None
        doubles = psutil.Process(int(parent.stdout.readline()))
        parent.kill()
        try:
            doubles.wait(600)
        finally:
            with suppress(psutil.NoSuchProcess):
                doubles.kill()


@pytest.mark.thorough
def test_doubles_that_cannot_start_say_so() -> None:
    with pytest.raises(DeviceError, match="before it was ready"):
        RemoteDoubles(rig(), pace=-1.0).start()
