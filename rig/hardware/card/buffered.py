"""One task's buffer of samples: reads with finite timeouts that keep what came, and a leap after a loss."""

from collections.abc import Callable

import nidaqmx
from nidaqmx.constants import OverwriteMode, ReadRelativeTo, TaskMode
from nidaqmx.errors import DaqError, DaqReadError

from dragrig.rig.arrays import FloatArray
from dragrig.rig.hardware.card.faults import NOT_YET_THERE, OVERWRITTEN

Read = Callable[[FloatArray, int, float], int]
"""Read so many samples of each channel into an array, waiting at most so many seconds; return how many there are."""


class OverwrittenError(Exception):
    """The next sample is no longer in the buffer."""


class BufferedInput:
    """A continuous task whose samples are counted from its first one. Belongs to one thread at a time.

    Parameters
    ----------
    task
        Configured, with a sample clock.
    read
        How a stream reader of this task reads.
    """

    def __init__(self, task: nidaqmx.Task, read: Read) -> None:
        self._task = task
        self._read = read
        self._leapt = False
        # So that samples that nobody fetched in time cost a gap and not the rest of the run.
        task.in_stream.overwrite = OverwriteMode.OVERWRITE_UNREAD_SAMPLES

    def commit(self) -> None:
        """Reserve and program everything, so that the start takes no time."""
        self._task.control(TaskMode.TASK_COMMIT)

    def start(self) -> None:
        """Take the first sample at the next edge of the sample clock."""
        self._task.start()

    @property
    def acquired(self) -> int:
        """How many samples were taken since the start."""
        return int(self._task.in_stream.total_samp_per_chan_acquired)

    def read(self, into: FloatArray, samples: int, timeout_s: float) -> int:
        """Read up to `samples` of each channel; return how many came in time.

        A short read leaves them together at the beginning of `into`, channel after channel.

        Raises
        ------
        OverwrittenError
            When the next sample is lost: leap over the loss.
        """
        try:
            came = self._read(into, samples, timeout_s)
        except DaqError as error:
            if error.error_code == OVERWRITTEN:
                raise OverwrittenError from error
            if error.error_code != NOT_YET_THERE:
                raise
            came = error.samps_per_chan_read if isinstance(error, DaqReadError) else 0
        if self._leapt and came:
            self._read_from(ReadRelativeTo.CURRENT_READ_POSITION, 0)
            self._leapt = False
        return int(came)

    def leap_to(self, index: int) -> None:
        """Go on reading at the sample of this index."""
        self._read_from(ReadRelativeTo.FIRST_SAMPLE, index)
        self._leapt = True

    def _read_from(self, point: ReadRelativeTo, offset: int) -> None:
        stream = self._task.in_stream
        stream.relative_to = point
        stream.offset = offset
