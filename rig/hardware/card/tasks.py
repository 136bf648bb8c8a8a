"""NI-DAQmx tasks of the card: sampled analog inputs and encoder, position counter, velocity output.

The encoder's counter counts from its own start on, and the analog inputs' sample clock only latches it; so it is
started first, and sample `k` of both tasks is the same instant.

A voltage output is a waveform that is generated while it is written: clocked by the card, never repeated. The card
holds its last voltage when a task ends, for any reason; so a waveform ends at 0 V, and an underflow is followed by
a single write of 0 V.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass

import nidaqmx
import numpy as np
from nidaqmx.constants import (
    AcquisitionType,
    EncoderType,
    EncoderZIndexPhase,
    LengthUnits,
    OverwriteMode,
    ReadRelativeTo,
    RegenerationMode,
    TaskMode,
    TerminalConfiguration,
)
from nidaqmx.errors import DaqError, DaqReadError, RpcError
from nidaqmx.stream_readers import AnalogMultiChannelReader, CounterReader
from nidaqmx.stream_writers import AnalogSingleChannelWriter

from dragrig.config import AnalogInputSettings, CardSettings, DeviceError, ForceInputSettings, RigSettings
from dragrig.rig import FloatArray
from dragrig.rig.hardware.card.connection import (
    OVERWRITTEN_CODE,
    READ_TIMEOUT_CODE,
    Connection,
    driver_errors_wrapped,
    has_lost_reply,
)

_CALL_TIMEOUT_S = 0.1
_PART_S, _MAX_WAIT_S = 0.05, 1.0
PULSES_PER_PERIOD = 4
"""Counts of X4 decoding in a period of the encoder's signals.

DAQmx takes the distance of a whole period (`CI.LinEncoder.DistPerPulse`) and divides it by the decoding itself.
"""

_INDEX_PHASES = {
    "a_high_b_high": EncoderZIndexPhase.AHIGH_BHIGH,
    "a_high_b_low": EncoderZIndexPhase.AHIGH_BLOW,
    "a_low_b_high": EncoderZIndexPhase.ALOW_BHIGH,
    "a_low_b_low": EncoderZIndexPhase.ALOW_BLOW,
}

StreamRead = Callable[[FloatArray, int, float], int]
"""Reads samples of each channel: array, number of samples, longest wait [s]; returns how many arrived."""


class OverwrittenError(Exception):
    """The next sample is no longer in the buffer."""


class LostReplyError(Exception):
    """The server's reply did not come in time, and with it samples that it had read."""


class BufferedInput:
    """A continuous task with its samples counted from the first. Belongs to one thread at a time.

    Parameters
    ----------
    task
        Configured, with a sample clock.
    stream_read
        The read method of a stream reader of this task.
    """

    def __init__(self, task: nidaqmx.Task, stream_read: StreamRead) -> None:
        self._task = task
        self._stream_read = stream_read
        self._skipped = self._reply_lost = False
        # So that samples that were not fetched in time cost a gap and not the rest of the run.
        task.in_stream.overwrite = OverwriteMode.OVERWRITE_UNREAD_SAMPLES

    def commit(self) -> None:
        """Reserve and program everything, so that the start takes no time."""
        self._task.control(TaskMode.TASK_COMMIT)

    def start(self) -> None:
        """Start the task: the first sample is taken at the next edge of the sample clock."""
        self._task.start()

    @property
    def acquired(self) -> int:
        """Number of samples taken since the start."""
        return int(self._task.in_stream.total_samp_per_chan_acquired)

    def read(self, into: FloatArray, samples: int, timeout_s: float) -> int:
        """Read up to `samples` of each channel; return how many arrived in time.

        A short read leaves them contiguous at the beginning of `into`, channel after channel.

        Raises
        ------
        OverwrittenError
            When the next sample was overwritten: call `skip_to`.
        LostReplyError
            When it is not known how far the server read: call `skip_to` with the next sample. A program that stood
            still finds a call's time over when it goes on, so only the second one in a row is the server's silence.
        """
        try:
            arrived = self._stream_read(into, samples, timeout_s)
        except DaqError as error:
            if error.error_code == OVERWRITTEN_CODE:
                raise OverwrittenError from error
            if error.error_code != READ_TIMEOUT_CODE:
                raise
            arrived = error.samps_per_chan_read if isinstance(error, DaqReadError) else 0
        except RpcError as error:
            if self._reply_lost or not has_lost_reply(error):
                raise
            self._reply_lost = True
            raise LostReplyError from error
        self._reply_lost = False
        if self._skipped and arrived:
            self._read_from(ReadRelativeTo.CURRENT_READ_POSITION, 0)
            self._skipped = False
        return int(arrived)

    def skip_to(self, index: int) -> None:
        """Continue reading at the sample of this index."""
        self._read_from(ReadRelativeTo.FIRST_SAMPLE, index)
        self._skipped = True

    def _read_from(self, point: ReadRelativeTo, offset: int) -> None:
        stream = self._task.in_stream
        stream.relative_to = point
        stream.offset = offset


READ_TIMEOUT_S = 0.1
"""Longest wait of one call of the driver, twice a block: shorter ones stall it, longer ones delay a stop."""


@dataclass(frozen=True, slots=True, eq=False)
class SampleBatch:
    """Consecutive samples, as views of buffers that the next fetch overwrites."""

    first_index: int
    """Index of the first sample since the start."""
    lost: int
    """How many samples before it are lost."""
    volts: FloatArray
    counts: FloatArray
    """`volts`, `counts`: shape `(inputs, n)` and `(n,)`; `n` is 0 when nothing arrived in time."""
    force_input: FloatArray
    """Volts of the force input that arrived since the batch before, as the card converted them, shape `(m,)`."""

    @property
    def samples(self) -> int:
        """How many samples there are of every channel."""
        return len(self.counts)


class SampleFetcher:
    """Reads both tasks block by block into buffers of its own. Belongs to one thread.

    Parameters
    ----------
    inputs
        How many analog inputs there are.
    count_length_m
        Length that the encoder's task assigns to a count.
    """

    def __init__(
        self, analog: BufferedInput, encoder: BufferedInput, inputs: int, block_samples: int, count_length_m: float
    ) -> None:
        self._analog, self._encoder = analog, encoder
        self._inputs = inputs
        self._count_length_m = count_length_m
        self._volts = np.empty(inputs * block_samples)
        self._counts = np.empty(block_samples)
        self._volts_held = self._counts_held = 0
        self.next_index = 0
        """Index of the next sample."""
        self.lost = 0
        """How many samples before `next_index` are lost and not yet reported by a `SampleBatch`."""

    @property
    def acquired(self) -> int:
        """How many samples the card has taken."""
        return self._analog.acquired

    def fetch(self, samples: int) -> SampleBatch:
        """Return the next samples, at most `samples`, fewer or none when they do not arrive in `READ_TIMEOUT_S`.

        Samples that only one of the tasks has delivered so far are held for the next call.
        """
        try:
            if not self._volts_held:
                self._volts_held = self._analog.read(self._volts_view(samples), samples, READ_TIMEOUT_S)
            missing = self._volts_held - self._counts_held
            if missing:
                into = self._counts[self._counts_held : self._volts_held]
                self._counts_held += self._encoder.read(into, missing, READ_TIMEOUT_S)
        except OverwrittenError:
            self.skip_to_newest()
        except LostReplyError:
            self._analog.skip_to(self.next_index + self._volts_held)
            self._encoder.skip_to(self.next_index + self._counts_held)
        return self._complete_batch()

    def skip_to_newest(self) -> None:
        """Pass over the samples in the card, which count as lost."""
        newest = max(self._analog.acquired, self._encoder.acquired, self.next_index + 1)
        self.lost += newest - self.next_index
        self.next_index = newest
        self._volts_held = self._counts_held = 0
        self._analog.skip_to(newest)
        self._encoder.skip_to(newest)

    def _complete_batch(self) -> SampleBatch:
        samples = self._volts_held if self._counts_held == self._volts_held else 0
        counts = self._counts[:samples]
        # DAQmx returns lengths; a count is a whole number.
        counts /= self._count_length_m
        np.rint(counts, out=counts)
        volts = self._volts_view(samples)
        batch = SampleBatch(self.next_index, self.lost if samples else 0, volts, counts, volts[0])
        if samples:
            self.next_index += samples
            self._volts_held = self._counts_held = self.lost = 0
        return batch

    def _volts_view(self, samples: int) -> FloatArray:
        return self._volts[: self._inputs * samples].reshape(self._inputs, samples)


@dataclass(frozen=True, slots=True)
class ScanTiming:
    """The card's clocks, nearest to the requested ones: whole fractions of its time bases."""

    rate_hz: float
    """Samples per second of every input."""
    conversion_s: float
    """Time from the conversion of an input to that of the next in a scan; 0 with the force input alone."""


class SampledTasks:
    """Analog inputs and encoder, reserved and ready to start; the caller closes them.

    Parameters
    ----------
    rate_hz
        Samples per second that are asked of the card.
    """

    def __init__(self, connection: Connection, rig: RigSettings, rate_hz: float) -> None:
        card = connection.card
        with ExitStack() as stack:
            self.encoder = _encoder_input(connection, stack, rig, rate_hz)
            """Position in metres since the counter's start."""
            task = stack.enter_context(connection.task("analog inputs"))
            self.analog = _analog_input(task, connection, (card.force, *card.inputs), rate_hz, card.buffer_s)
            """Volts, force first, then the further inputs in the settings' order."""
            self.analog.commit()
            self.encoder.commit()
            # A driver need not know the convert clock of a card that converts its only input once a sample.
            conversion_s = 1.0 / float(task.timing.ai_conv_rate) if card.inputs else 0.0
            self.timing = ScanTiming(float(task.timing.samp_clk_rate), conversion_s)
            """The clocks as they are."""
            self._tasks = stack.pop_all()

    def start(self, start_clock: Callable[[Callable[[], None]], None]) -> None:
        """Start the counter, then let `start_clock` start the analog inputs; their clock latches it."""
        self.encoder.start()
        start_clock(self.analog.start)

    def close(self) -> None:
        """Stop both tasks and release their resources; raises the driver's errors, after both are closed."""
        self._tasks.close()


def metres_per_count(rig: RigSettings) -> float:
    """Return the length that DAQmx assigns to a count."""
    return rig.encoder.resolution_um * 1e-6


def _analog_input(
    task: nidaqmx.Task,
    connection: Connection,
    channels: Sequence[ForceInputSettings | AnalogInputSettings],
    rate_hz: float,
    buffer_s: float,
) -> BufferedInput:
    for channel in channels:
        task.ai_channels.add_ai_voltage_chan(
            connection.terminal(channel.channel),
            terminal_config=TerminalConfiguration.DIFF,
            min_val=-channel.range_V,
            max_val=channel.range_V,
        )
    _set_sample_clock(task, rate_hz, buffer_s)
    reader = AnalogMultiChannelReader(task.in_stream)
    # The arrays are this package's own; asking the driver for their shape at every read would be wasted calls.
    reader.verify_array_shape = False
    return BufferedInput(task, reader.read_many_sample)


def read_force_alone(connection: Connection, rate_hz: float, duration_s: float) -> tuple[FloatArray, float]:
    """Return the force input's volts over a while, and their rate; no other task may sample. Raises as the driver."""
    card = connection.card
    with connection.task("analog inputs") as task:
        force = _analog_input(task, connection, (card.force,), rate_hz, card.buffer_s)
        force.commit()
        rate = float(task.timing.samp_clk_rate)
        volts = np.empty(round(duration_s * rate))
        force.start()
        part, arrived = round(_PART_S * rate), 0
        until_s = time.monotonic() + duration_s + _MAX_WAIT_S
        while arrived < len(volts) and time.monotonic() < until_s:
            wanted = min(part, len(volts) - arrived)
            arrived += force.read(volts[arrived : arrived + wanted], wanted, READ_TIMEOUT_S)
    return volts[:arrived], rate


def _encoder_input(connection: Connection, stack: ExitStack, rig: RigSettings, rate_hz: float) -> BufferedInput:
    task = stack.enter_context(connection.task("encoder"))
    add_encoder_channel(task, connection.card, metres_per_count(rig))
    _set_sample_clock(task, rate_hz, connection.card.buffer_s, source=f"/{connection.card.device}/ai/SampleClock")
    reader = CounterReader(task.in_stream)
    reader.verify_array_shape = False
    return BufferedInput(task, reader.read_many_sample_double)


def _set_sample_clock(task: nidaqmx.Task, rate_hz: float, buffer_s: float, source: str = "") -> None:
    task.timing.cfg_samp_clk_timing(
        rate_hz, source=source, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=round(buffer_s * rate_hz)
    )


def add_encoder_channel(
    task: nidaqmx.Task,
    card: CardSettings,
    metres_a_count: float,
    counter: str = "",
    *,
    start_m: float = 0.0,
    index: bool = False,
) -> None:
    """Add the encoder to a task: X4 decoding, on the settings' terminals, with digital filters.

    Parameters
    ----------
    metres_a_count
        Length of a count.
    counter
        Default: the settings' counter for sampling.
    start_m
        Position at the task's start.
    index
        Whether the index pulse sets the position to 0.
    """
    encoder = card.encoder
    channel = task.ci_channels.add_ci_lin_encoder_chan(
        f"{card.device}/{counter or encoder.counter}",
        decoding_type=EncoderType.X_4,
        zidx_enable=index,
        zidx_phase=_INDEX_PHASES[encoder.z_phase],
        units=LengthUnits.METERS,
        dist_per_pulse=PULSES_PER_PERIOD * metres_a_count,
        initial_pos=start_m,
    )
    for signal, terminal in (("a", encoder.a), ("b", encoder.b), ("z", encoder.z)):
        if terminal:
            setattr(channel, f"ci_encoder_{signal}_input_term", f"/{card.device}/{terminal}")
            if encoder.filter_ns:
                setattr(channel, f"ci_encoder_{signal}_input_dig_fltr_enable", True)
                setattr(channel, f"ci_encoder_{signal}_input_dig_fltr_min_pulse_width", encoder.filter_ns * 1e-9)


class PositionCounter:
    """A second counter on the encoder, read on demand, that runs from `begin` to `close`.

    Parameters
    ----------
    counter
        Such as ctr1.
    mm_per_count
        Signed: negative where the encoder counts down while the stage goes up.
    """

    def __init__(self, connection: Connection, counter: str, mm_per_count: float) -> None:
        self._connection = connection
        self._counter = counter
        self._metres_per_count = abs(mm_per_count) / 1000.0
        self._mm_per_metre = 1000.0 if mm_per_count > 0 else -1000.0
        self._task: nidaqmx.Task | None = None

    def begin(self, position_mm: float, *, index: bool = False) -> None:
        """Start counting from the stage's present position; with `index`, the index pulse sets the position to 0.

        Raises `DeviceError` when the card refuses.
        """
        self.close()
        card = self._connection.card
        with driver_errors_wrapped(card, "the position counter is started"), ExitStack() as stack:
            task = stack.enter_context(self._connection.task("position counter"))
            start_m = position_mm / self._mm_per_metre
            add_encoder_channel(task, card, self._metres_per_count, self._counter, start_m=start_m, index=index)
            task.start()
            stack.pop_all()
        self._task = task

    def read(self) -> float:
        """Return the position now [mm]; raises `DeviceError` when the card refuses."""
        task = self._task
        with driver_errors_wrapped(self._connection.card, "the position is read"):
            return 0.0 if task is None else float(task.read(timeout=_CALL_TIMEOUT_S)) * self._mm_per_metre

    def close(self) -> None:
        """Release the counter. Safe to call twice."""
        task, self._task = self._task, None
        if task is not None:
            with driver_errors_wrapped(self._connection.card, "the position counter is released"):
                task.close()


AO_RANGE_V = 10.0
AI_START_TRIGGER = "ai/StartTrigger"
"""The edge with which the card takes the first sample of force and position."""
UNDERFLOW_CODES = frozenset({-200290, -200621, -200018, -200016})
"""Status codes of an output whose next sample was due and had not been written."""
_AO_TASK_NAME = "velocity output"
_BUFFER_FACTOR = 4
"""Buffer of the waveform over what is written ahead, so that a write never waits for space."""


class UnderflowError(DeviceError):
    """The next voltage of a waveform was due and had not been written."""


class VoltageOutput:
    """One analog output of the card. Belongs to one thread at a time; the caller ends its waveform.

    Parameters
    ----------
    channel
        Such as ao0.
    rate_hz
        Voltages per second.
    ahead_samples
        How many voltages are written ahead at most.
    """

    def __init__(self, connection: Connection, channel: str, rate_hz: float, ahead_samples: int) -> None:
        self._connection = connection
        self._channel = connection.terminal(channel)
        self._rate_hz = rate_hz
        self._buffer_samples = _BUFFER_FACTOR * ahead_samples
        self._task: nidaqmx.Task | None = None
        self._writer: AnalogSingleChannelWriter | None = None
        self.written = 0
        """Number of voltages of the present waveform that were written."""

    @property
    def generated(self) -> int:
        """Number of voltages of the present waveform that were put out; 0 while it waits for its trigger.

        Raises
        ------
        UnderflowError
            When the buffer ran empty.
        DeviceError
            When the card refuses.
        """
        task = self._task
        if task is None:
            return self.written
        with self._errors_wrapped("the velocity is put out"):
            return int(task.out_stream.total_samp_per_chan_generated)

    def begin(self, volts: FloatArray, trigger: str = "") -> None:
        """Start a new waveform with its first voltages: at once, or at the first edge of a terminal of the card.

        Parameters
        ----------
        volts
            Contiguous, shape `(n,)`, at least as many as are to be written ahead.
        trigger
            Such as ai/StartTrigger; empty for at once.

        Raises
        ------
        DeviceError
            When the card refuses.
        """
        card = self._connection.card
        self.written = 0
        with driver_errors_wrapped(card, "the velocity output is prepared"), ExitStack() as stack:
            task = stack.enter_context(self._connection.task(_AO_TASK_NAME))
            self._add_channel(task)
            task.timing.cfg_samp_clk_timing(
                self._rate_hz, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=self._buffer_samples
            )
            task.out_stream.regen_mode = RegenerationMode.DONT_ALLOW_REGENERATION
            task.out_stream.output_buf_size = self._buffer_samples
            if trigger:
                task.triggers.start_trigger.cfg_dig_edge_start_trig(f"/{card.device}/{trigger}")
            writer = AnalogSingleChannelWriter(task.out_stream, auto_start=False)
            writer.verify_array_shape = False
            writer.write_many_sample(volts, timeout=_CALL_TIMEOUT_S)
            task.start()
            stack.pop_all()
        self._task, self._writer, self.written = task, writer, len(volts)

    def write(self, volts: FloatArray) -> None:
        """Append voltages, a contiguous array of shape `(n,)`; raises as `generated` does."""
        if self._writer is None:
            raise DeviceError("the velocity output has no waveform to append to: begin one first.")
        with self._errors_wrapped("the velocity is written"):
            self._writer.write_many_sample(volts, timeout=_CALL_TIMEOUT_S)
        self.written += len(volts)

    def end(self) -> None:
        """End the waveform where it is; the card holds its present voltage. Safe to call twice."""
        task, self._task, self._writer = self._task, None, None
        if task is None:
            return
        with driver_errors_wrapped(self._connection.card, "the velocity output is released"), task, suppress(DaqError):
            # A waveform whose buffer ran empty refuses to stop, and is cleared all the same.
            task.stop()

    def zero(self) -> None:
        """End the waveform and put out 0 V now.

        Raises `DeviceError` when the card refuses: then the voltage is unknown.
        """
        # An error of the waveform is reported elsewhere, or does not matter: 0 V does.
        with suppress(DeviceError):
            self.end()
        with (
            driver_errors_wrapped(self._connection.card, "0 V are put out"),
            self._connection.task(_AO_TASK_NAME) as task,
        ):
            self._add_channel(task)
            writer = AnalogSingleChannelWriter(task.out_stream, auto_start=True)
            writer.write_many_sample(np.zeros(1), timeout=_CALL_TIMEOUT_S)

    def _add_channel(self, task: nidaqmx.Task) -> None:
        task.ao_channels.add_ao_voltage_chan(self._channel, min_val=-AO_RANGE_V, max_val=AO_RANGE_V)

    @contextmanager
    def _errors_wrapped(self, doing: str) -> Iterator[None]:
        card = self._connection.card
        with driver_errors_wrapped(card, doing):
            try:
                yield
            except DaqError as error:
                if error.error_code not in UNDERFLOW_CODES:
                    raise
                raise UnderflowError(
                    f"card {card.device} ran out of velocity setpoints, because this computer did not write them in "
                    "time: end other programs, or raise hardware.drive.velocity.ahead or update_s of the rig file "
                    f"(NI-DAQmx {error.error_code})."
                ) from error
