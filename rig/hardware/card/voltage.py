"""An analog output as a waveform that is generated while it is written: clocked by the card, never repeated.

The card holds its last voltage when a task ends, whatever ended it; so a waveform ends at 0 V, and one that ran dry is
followed by a single 0 V at once.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

import nidaqmx
import numpy as np
from nidaqmx.constants import AcquisitionType, RegenerationMode
from nidaqmx.errors import DaqError
from nidaqmx.stream_writers import AnalogSingleChannelWriter

from dragrig.config.errors import DeviceError
from dragrig.config.hardware import CardSettings
from dragrig.rig.arrays import FloatArray
from dragrig.rig.hardware.card.connection import Connection
from dragrig.rig.hardware.card.faults import told_in_words

RANGE_V = 10.0
SAMPLING_STARTS = "ai/StartTrigger"
"""The edge with which the card takes the first sample of force and position."""
RAN_DRY = frozenset({-200290, -200621, -200018, -200016})
"""Status codes of an output that was due and had not been written."""
_ROLE = "velocity output"
_TIMEOUT_S = 0.1
_BUFFERS = 4


class UnderflowError(DeviceError):
    """A voltage was due that nobody had written."""


class VoltageOutput:
    """One output of the card. Belongs to one thread at a time; whoever makes it closes it.

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
        self._buffer_samples = _BUFFERS * ahead_samples
        self._task: nidaqmx.Task | None = None
        self._writer: AnalogSingleChannelWriter | None = None
        self.written = 0
        """Voltages of the present waveform that were written."""

    @property
    def generated(self) -> int:
        """Return how many voltages of the present waveform were put out; 0 while it waits for its trigger.

        Raises
        ------
        UnderflowError
            When it ran dry.
        DeviceError
            When the card refuses.
        """
        task = self._task
        if task is None:
            return self.written
        with told_in_words(self._connection.card, "the velocity is put out"), _dry_in_words(self._connection.card):
            return int(task.out_stream.total_samp_per_chan_generated)

    def begin(self, volts: FloatArray, trigger: str = "") -> None:
        """Put out a new waveform from its first voltages on: now, or with the first edge of a terminal of the card.

        Parameters
        ----------
        volts
            Contiguous, shape `(n,)`, at least what is to be written ahead.
        trigger
            Such as ai/StartTrigger; empty for now.

        Raises
        ------
        DeviceError
            When the card refuses.
        """
        card = self._connection.card
        self.written = 0
        with told_in_words(card, "the velocity output is prepared"), ExitStack() as stack:
            task = stack.enter_context(self._connection.task(_ROLE))
            task.ao_channels.add_ao_voltage_chan(self._channel, min_val=-RANGE_V, max_val=RANGE_V)
            task.timing.cfg_samp_clk_timing(
                self._rate_hz, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=self._buffer_samples
            )
            task.out_stream.regen_mode = RegenerationMode.DONT_ALLOW_REGENERATION
            task.out_stream.output_buf_size = self._buffer_samples
            if trigger:
                task.triggers.start_trigger.cfg_dig_edge_start_trig(f"/{card.device}/{trigger}")
            writer = AnalogSingleChannelWriter(task.out_stream, auto_start=False)
            writer.verify_array_shape = False
            writer.write_many_sample(volts, timeout=_TIMEOUT_S)
            task.start()
            stack.pop_all()
        self._task, self._writer, self.written = task, writer, len(volts)

    def write(self, volts: FloatArray) -> None:
        """Append voltages, a contiguous array of shape `(n,)`.

        Raises
        ------
        UnderflowError
            When it ran dry.
        DeviceError
            When the card refuses.
        """
        if self._writer is None:
            raise DeviceError("the velocity output was not begun.")
        with told_in_words(self._connection.card, "the velocity is written"), _dry_in_words(self._connection.card):
            self._writer.write_many_sample(volts, timeout=_TIMEOUT_S)
        self.written += len(volts)

    def end(self) -> None:
        """End the waveform where it is; the card holds the voltage that it puts out now. Twice is once."""
        task, self._task, self._writer = self._task, None, None
        if task is None:
            return
        with told_in_words(self._connection.card, "the velocity output is released"), task, suppress(DaqError):
            # A waveform that ran dry refuses to stop, and is cleared all the same.
            task.stop()

    def zero(self) -> None:
        """End the waveform and put out 0 V now.

        Raises
        ------
        DeviceError
            When the card refuses: then the voltage is unknown.
        """
        # What is wrong with the waveform is known already, or does not matter: 0 V does.
        with suppress(DeviceError):
            self.end()
        with told_in_words(self._connection.card, "0 V are put out"), self._connection.task(_ROLE) as task:
            task.ao_channels.add_ao_voltage_chan(self._channel, min_val=-RANGE_V, max_val=RANGE_V)
            writer = AnalogSingleChannelWriter(task.out_stream, auto_start=True)
            writer.write_many_sample(np.zeros(1), timeout=_TIMEOUT_S)


@contextmanager
def _dry_in_words(card: CardSettings) -> Iterator[None]:
    try:
        yield
    except DaqError as error:
        if error.error_code not in RAN_DRY:
            raise
        raise UnderflowError(
            f"card {card.device} ran out of velocity to put out, because this computer did not write it in time: end "
            "other programs, or raise hardware.drive.velocity.ahead or update_s of the rig file "
            f"(NI-DAQmx {error.error_code})."
        ) from error
