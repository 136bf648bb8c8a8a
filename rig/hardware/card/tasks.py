"""The two tasks that sample: analog inputs, and the encoder's counter latched by their sample clock.

The counter counts from its own start on, and the sample clock only latches it; so it is started first, and sample `k`
of both tasks is the same instant.
"""

from collections.abc import Callable
from contextlib import ExitStack

import nidaqmx
from nidaqmx.constants import AcquisitionType, EncoderType, LengthUnits, TerminalConfiguration
from nidaqmx.stream_readers import AnalogMultiChannelReader, CounterReader

from dragrig.config.hardware import AnalogInputSettings, CardSettings, EncoderInputSettings, ForceInputSettings
from dragrig.config.rig import RigSettings
from dragrig.rig.hardware.card.buffered import BufferedInput
from dragrig.rig.hardware.card.connection import Connection

PULSES_PER_PERIOD = 4
"""Counts of X4 decoding in a period of the encoder's signals.

DAQmx takes the distance of a whole period (`CI.LinEncoder.DistPerPulse`) and divides it by the decoding itself.
"""


class SampledTasks:
    """Analog inputs and encoder, reserved and ready to start; whoever makes it closes it.

    Attributes
    ----------
    analog
        Volts, force first, then the further inputs in the settings' order.
    encoder
        Position in metres since the counter's start, as counted.
    """

    def __init__(self, connection: Connection, rig: RigSettings) -> None:
        with ExitStack() as stack:
            buffer_samples = round(rig.hardware.card.buffer_s * rig.sampling.rate_hz)
            clock = rig.sampling.rate_hz, buffer_samples
            self.encoder = _encoder(connection, stack, metres_per_count(rig), clock)
            self.analog = _analog(connection, stack, clock)
            self.analog.commit()
            self.encoder.commit()
            self._tasks = stack.pop_all()

    def start(self, begin: Callable[[Callable[[], None]], None]) -> None:
        """Start the counter, then let `begin` start the sample clock."""
        self.encoder.start()
        begin(self.analog.start)

    def close(self) -> None:
        """Stop both tasks and release what they hold; raises what the driver raises, after both are closed."""
        self._tasks.close()


def metres_per_count(rig: RigSettings) -> float:
    """Return the length that DAQmx gives a count."""
    return rig.encoder.resolution_um * 1e-6


def _analog(connection: Connection, stack: ExitStack, clock: tuple[float, int]) -> BufferedInput:
    card = connection.card
    task = stack.enter_context(connection.task("analog inputs"))
    inputs: tuple[ForceInputSettings | AnalogInputSettings, ...] = (card.force, *card.inputs)
    for one in inputs:
        task.ai_channels.add_ai_voltage_chan(
            connection.terminal(one.channel),
            terminal_config=TerminalConfiguration.DIFF,
            min_val=-one.range_V,
            max_val=one.range_V,
        )
    rate_hz, buffer_samples = clock
    task.timing.cfg_samp_clk_timing(rate_hz, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=buffer_samples)
    reader = AnalogMultiChannelReader(task.in_stream)
    # The arrays are this package's own; asking the driver for their shape at every read would be calls for nothing.
    reader.verify_array_shape = False
    return BufferedInput(task, reader.read_many_sample)


def _encoder(
    connection: Connection, stack: ExitStack, metres_a_count: float, clock: tuple[float, int]
) -> BufferedInput:
    card = connection.card
    task = stack.enter_context(connection.task("encoder"))
    add_encoder(task, card, metres_a_count)
    rate_hz, buffer_samples = clock
    task.timing.cfg_samp_clk_timing(
        rate_hz,
        source=f"/{card.device}/ai/SampleClock",
        sample_mode=AcquisitionType.CONTINUOUS,
        samps_per_chan=buffer_samples,
    )
    reader = CounterReader(task.in_stream)
    reader.verify_array_shape = False
    return BufferedInput(task, reader.read_many_sample_double)


def add_encoder(
    task: nidaqmx.Task,
    card: CardSettings,
    metres_a_count: float,
    counter: str = "",
    *,
    start_m: float = 0.0,
    index: bool = False,
) -> None:
    """Let a task follow the encoder: X4, on the settings' terminals, filtered.

    Parameters
    ----------
    metres_a_count
        Length of a count.
    counter
        Another counter than the settings' one for sampling.
    start_m
        What it reads at its start.
    index
        Whether the index pulse sets it to 0.
    """
    wired = card.encoder
    channel = task.ci_channels.add_ci_lin_encoder_chan(
        f"{card.device}/{counter or wired.counter}",
        decoding_type=EncoderType.X_4,
        zidx_enable=index,
        units=LengthUnits.METERS,
        dist_per_pulse=PULSES_PER_PERIOD * metres_a_count,
        initial_pos=start_m,
    )
    channel.ci_encoder_a_input_term = f"/{card.device}/{wired.a}"
    channel.ci_encoder_b_input_term = f"/{card.device}/{wired.b}"
    if wired.z:
        channel.ci_encoder_z_input_term = f"/{card.device}/{wired.z}"
    _filter(channel, wired)


def _filter(channel: nidaqmx.task.channels.CIChannel, wired: EncoderInputSettings) -> None:
    if not wired.filter_ns:
        return
    shortest_s = wired.filter_ns * 1e-9
    channel.ci_encoder_a_input_dig_fltr_enable = True
    channel.ci_encoder_a_input_dig_fltr_min_pulse_width = shortest_s
    channel.ci_encoder_b_input_dig_fltr_enable = True
    channel.ci_encoder_b_input_dig_fltr_min_pulse_width = shortest_s
    if wired.z:
        channel.ci_encoder_z_input_dig_fltr_enable = True
        channel.ci_encoder_z_input_dig_fltr_min_pulse_width = shortest_s
