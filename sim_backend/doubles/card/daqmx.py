"""NI-DAQmx's status codes, constants and attributes that the card's double implements, with NI's names and numbers.

The numbers are those of NIDAQmx.h; `nidaqmx.error_codes` and `nidaqmx.constants` list the same.
"""

from enum import IntEnum


class StatusCode(IntEnum):
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


class TaskAction(IntEnum):
    """What `control` does to a task."""

    START = 0
    STOP = 1
    VERIFY = 2
    COMMIT = 3
    RESERVE = 4
    UNRESERVE = 5
    ABORT = 6


class SampleMode(IntEnum):
    """How many samples a task takes."""

    FINITE = 10178
    CONTINUOUS = 10123
    SINGLE_POINT = 12522


class FillMode(IntEnum):
    """How samples of several channels lie in an array."""

    BY_CHANNEL = 0
    BY_SCAN = 1


class ReadRelativeTo(IntEnum):
    """Where a read begins; its offset is added."""

    FIRST_SAMPLE = 10424
    CURRENT_READ_POSITION = 10425
    MOST_RECENT_SAMPLE = 10428


class Decoding(IntEnum):
    """Counts in a period of a quadrature encoder."""

    X1 = 10090
    X2 = 10091
    X4 = 10092


class LengthUnit(IntEnum):
    """Units of a linear encoder's position."""

    METERS = 10219
    INCHES = 10379
    TICKS = 10304


class TerminalConfiguration(IntEnum):
    """How an analog input is wired."""

    DEFAULT = -1
    RSE = 10083
    NRSE = 10078
    DIFFERENTIAL = 10106


class LineGrouping(IntEnum):
    """Whether digital lines make a channel each or one together."""

    CHANNEL_PER_LINE = 0
    CHANNEL_FOR_ALL_LINES = 1


class Regeneration(IntEnum):
    """Whether an output's buffer is generated again when it is used up."""

    ALLOWED = 10097
    NOT_ALLOWED = 10158


class ChannelAttribute(IntEnum):
    """Of virtual channels."""

    TYPE = 0x187F
    PHYSICAL = 0x18F5
    AI_MAX = 0x17DD
    AI_MIN = 0x17DE
    AI_RANGE_HIGH = 0x1815
    AI_RANGE_LOW = 0x1816
    AI_TERMINALS = 0x1097
    AI_MEASURES = 0x0695
    AO_MAX = 0x1186
    AO_MIN = 0x1187
    CI_MEASURES = 0x18A0
    CI_COUNT = 0x0148
    CI_DECODING = 0x21E6
    CI_Z_ENABLE = 0x0890
    CI_Z_VALUE = 0x0888
    CI_Z_PHASE = 0x0889
    CI_A_TERMINAL = 0x219D
    CI_B_TERMINAL = 0x219E
    CI_Z_TERMINAL = 0x219F
    CI_A_FILTER = 0x21FB
    CI_A_FILTER_S = 0x21FC
    CI_B_FILTER = 0x2200
    CI_B_FILTER_S = 0x2201
    CI_Z_FILTER = 0x2205
    CI_Z_FILTER_S = 0x2206
    CI_DISTANCE_PER_PULSE = 0x0911
    CI_INITIAL_POSITION = 0x0915
    CI_UNITS = 0x18A9


class ReadAttribute(IntEnum):
    """Of reading."""

    RELATIVE_TO = 0x190A
    OFFSET = 0x190B
    OVERWRITE = 0x1211
    AVAILABLE = 0x1223
    TOTAL = 0x192A
    POSITION = 0x1221
    AUTO_START = 0x1826
    ALL_AVAILABLE = 0x1215
    CHANNELS = 0x1823
    NUM_CHANNELS = 0x217B
    LINES_PER_CHANNEL = 0x217C
    DEFAULT_SAMPLES = 0x31E8


class WriteAttribute(IntEnum):
    """Of writing."""

    REGENERATION = 0x1453
    SPACE = 0x1460
    TOTAL = 0x192B
    POSITION = 0x1458
    NUM_CHANNELS = 0x217E
    LINES_PER_CHANNEL = 0x217F


class BufferAttribute(IntEnum):
    """Of buffers."""

    INPUT = 0x186C
    INPUT_ONBOARD = 0x230A
    OUTPUT = 0x186D


class TimingAttribute(IntEnum):
    """Of timing."""

    RATE = 0x1344
    MAX_RATE = 0x22C8
    SOURCE = 0x1852
    TYPE = 0x1347
    QUANTITY = 0x1300
    SAMPLES = 0x1310


class TaskAttribute(IntEnum):
    """Of tasks."""

    NAME = 0x1276
    CHANNELS = 0x1273
    NUM_CHANNELS = 0x2181
    DEVICES = 0x230E
    NUM_DEVICES = 0x29BA
    COMPLETE = 0x1274


class DeviceAttribute(IntEnum):
    """Of devices."""

    PRODUCT = 0x0631
    SERIAL = 0x0632
    PRODUCT_NUMBER = 0x231D
    SIMULATED = 0x22CA
    CATEGORY = 0x29A9
    BUS = 0x2326
    TERMINALS = 0x2A40
    AI = 0x231E
    AO = 0x231F
    CI = 0x2324
    CO = 0x2325
    DI_LINES = 0x2320
    DI_PORTS = 0x2321
    DO_LINES = 0x2322
    DO_PORTS = 0x2323
    AI_MAX_SINGLE_RATE = 0x298C
    AI_MAX_RATE = 0x298D
    AI_RANGES = 0x2990
    AO_RANGES = 0x299B


class SystemAttribute(IntEnum):
    """Of the driver."""

    MAJOR = 0x1272
    MINOR = 0x1923
    UPDATE = 0x2F22
    DEVICES = 0x193B
    TASKS = 0x1267
    CHANNELS = 0x1265
    SCALES = 0x1266


WIDE_ATTRIBUTES = frozenset(
    {
        ("read", ReadAttribute.TOTAL),
        ("read", ReadAttribute.POSITION),
        ("write", WriteAttribute.TOTAL),
        ("write", WriteAttribute.POSITION),
        ("timing", TimingAttribute.SAMPLES),
    }
)
"""Whole numbers of 64 bits in C; all others have 32."""
