"""The part of NI-DAQmx's fixed vocabulary that the card's double speaks: status codes and constants, by NI's names.

The numbers are those of NIDAQmx.h; `nidaqmx.error_codes` and `nidaqmx.constants` list the same.
"""

from enum import IntEnum


class Code(IntEnum):
    """Status codes."""

    INVALID_ATTRIBUTE_VALUE = -200077
    MIN_NOT_LESS_THAN_MAX = -200082
    INVALID_TASK = -200088
    PHYSICAL_CHAN_DOES_NOT_EXIST = -200170
    ATTRIBUTE_NOT_SUPPORTED = -200197
    INVALID_DEVICE = -200220
    BUFFER_TOO_SMALL_FOR_STRING = -200228
    READ_BUFFER_TOO_SMALL = -200229
    SAMPLES_WILL_NEVER_BE_AVAILABLE = -200278
    SAMPLES_OVERWRITTEN = -200279
    SAMPLES_NOT_YET_AVAILABLE = -200284
    REGENERATION_STOPPED = -200290
    SAMPLES_CANNOT_YET_BE_WRITTEN = -200292
    RATE_TOO_HIGH = -200332
    INVALID_TERMINAL = -89120
    NO_SAMPLE_CLOCK = -200303
    TASK_RUNNING = -200479
    WRITE_NOT_STARTED = -200472
    READ_NOT_STARTED = -200473
    INVALID_CHANNEL = -200087
    NOT_DONE = -200560
    TOO_FAST_FOR_CHANNELS = -200081
    NUMBER_OF_CHANNELS = -200524
    NO_CHANNELS = -200478
    CHANNEL_ALREADY_IN_TASK = -200489
    CHANNEL_TYPE_MISMATCH = -200430
    INVALID_VOLTAGE = -200561
    LINES_RESERVED = -200587
    DUPLICATE_TASK = -200089
    ABORTED = -88710
    DEVICE_UNPLUGGED = -201003
    DEVICE_GONE = -88705
    RESOURCE_RESERVED = -50103


class CardError(Exception):
    """What a DAQmx call answers when it fails.

    Attributes
    ----------
    code
        The negative status.
    message
        NI's kind of sentence.
    samples
        How many samples per channel were read, or written, all the same.
    """

    def __init__(self, code: int, message: str, samples: int = 0) -> None:
        super().__init__(message)
        self.code = int(code)
        self.message = message
        self.samples = samples


class ChannelKind(IntEnum):
    """What a virtual channel does."""

    ANALOG_INPUT = 10100
    ANALOG_OUTPUT = 10102
    COUNTER_INPUT = 10131
    DIGITAL_INPUT = 10151
    DIGITAL_OUTPUT = 10153


class Action(IntEnum):
    """What `control` does to a task."""

    START = 0
    STOP = 1
    VERIFY = 2
    COMMIT = 3
    RESERVE = 4
    UNRESERVE = 5
    ABORT = 6


class Quantity(IntEnum):
    """How many samples a task takes."""

    FINITE = 10178
    CONTINUOUS = 10123
    SINGLE_POINT = 12522


class Fill(IntEnum):
    """How samples of several channels lie in an array."""

    BY_CHANNEL = 0
    BY_SCAN = 1


class RelativeTo(IntEnum):
    """Where a read begins; its offset is added."""

    FIRST_SAMPLE = 10424
    CURRENT_READ_POSITION = 10425
    MOST_RECENT_SAMPLE = 10428


class Decoding(IntEnum):
    """Counts in a period of a quadrature encoder."""

    X1 = 10090
    X2 = 10091
    X4 = 10092


class Length(IntEnum):
    """Units of a linear encoder's position."""

    METERS = 10219
    INCHES = 10379
    TICKS = 10304


class Terminals(IntEnum):
    """How an analog input is wired."""

    DEFAULT = -1
    RSE = 10083
    NRSE = 10078
    DIFFERENTIAL = 10106


class Grouping(IntEnum):
    """Whether digital lines make a channel each or one together."""

    CHANNEL_PER_LINE = 0
    CHANNEL_FOR_ALL_LINES = 1


class Regeneration(IntEnum):
    """Whether an output's buffer is generated again when it is used up."""

    ALLOWED = 10097
    NOT_ALLOWED = 10158
