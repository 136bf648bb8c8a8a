"""Attributes of tasks, channels and devices that the card's double knows: numbers and types as in NIDAQmx.h."""

from enum import IntEnum


class Chan(IntEnum):
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


class Read(IntEnum):
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


class Write(IntEnum):
    """Of writing."""

    REGENERATION = 0x1453
    SPACE = 0x1460
    TOTAL = 0x192B
    POSITION = 0x1458
    NUM_CHANNELS = 0x217E
    LINES_PER_CHANNEL = 0x217F


class Buffer(IntEnum):
    """Of buffers."""

    INPUT = 0x186C
    INPUT_ONBOARD = 0x230A
    OUTPUT = 0x186D


class Clock(IntEnum):
    """Of timing."""

    RATE = 0x1344
    MAX_RATE = 0x22C8
    SOURCE = 0x1852
    TYPE = 0x1347
    QUANTITY = 0x1300
    SAMPLES = 0x1310


class OfTask(IntEnum):
    """Of tasks."""

    NAME = 0x1276
    CHANNELS = 0x1273
    NUM_CHANNELS = 0x2181
    DEVICES = 0x230E
    NUM_DEVICES = 0x29BA
    COMPLETE = 0x1274


class Device(IntEnum):
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


class System(IntEnum):
    """Of the driver."""

    MAJOR = 0x1272
    MINOR = 0x1923
    UPDATE = 0x2F22
    DEVICES = 0x193B
    TASKS = 0x1267
    CHANNELS = 0x1265
    SCALES = 0x1266


_TYPES: dict[str, dict[str, tuple[IntEnum, ...]]] = {
    "task": {
        "string": (OfTask.NAME, OfTask.CHANNELS, OfTask.DEVICES),
        "uint32": (OfTask.NUM_CHANNELS, OfTask.NUM_DEVICES),
        "bool": (OfTask.COMPLETE,),
    },
    "chan": {
        "string": (Chan.PHYSICAL, Chan.CI_A_TERMINAL, Chan.CI_B_TERMINAL, Chan.CI_Z_TERMINAL),
        "int32": (Chan.TYPE, Chan.AI_TERMINALS, Chan.AI_MEASURES, Chan.CI_MEASURES, Chan.CI_DECODING,
                  Chan.CI_Z_PHASE, Chan.CI_UNITS),
        "uint32": (Chan.CI_COUNT,),
        "bool": (Chan.CI_Z_ENABLE, Chan.CI_A_FILTER, Chan.CI_B_FILTER, Chan.CI_Z_FILTER),
        "double": (Chan.AI_MAX, Chan.AI_MIN, Chan.AI_RANGE_HIGH, Chan.AI_RANGE_LOW, Chan.AO_MAX, Chan.AO_MIN,
                   Chan.CI_Z_VALUE, Chan.CI_A_FILTER_S, Chan.CI_B_FILTER_S, Chan.CI_Z_FILTER_S,
                   Chan.CI_DISTANCE_PER_PULSE, Chan.CI_INITIAL_POSITION),
    },
    "read": {
        "string": (Read.CHANNELS,),
        "int32": (Read.RELATIVE_TO, Read.OFFSET, Read.OVERWRITE),
        "uint32": (Read.AVAILABLE, Read.NUM_CHANNELS, Read.LINES_PER_CHANNEL, Read.DEFAULT_SAMPLES),
        "uint64": (Read.TOTAL, Read.POSITION),
        "bool": (Read.AUTO_START, Read.ALL_AVAILABLE),
    },
    "write": {
        "int32": (Write.REGENERATION,),
        "uint32": (Write.SPACE, Write.NUM_CHANNELS, Write.LINES_PER_CHANNEL),
        "uint64": (Write.TOTAL, Write.POSITION),
    },
    "buffer": {"uint32": (Buffer.INPUT, Buffer.INPUT_ONBOARD, Buffer.OUTPUT)},
    "timing": {
        "string": (Clock.SOURCE,),
        "int32": (Clock.TYPE, Clock.QUANTITY),
        "uint64": (Clock.SAMPLES,),
        "double": (Clock.RATE, Clock.MAX_RATE),
    },
    "device": {
        "string": (Device.PRODUCT, Device.TERMINALS, Device.AI, Device.AO, Device.CI, Device.CO, Device.DI_LINES,
                   Device.DI_PORTS, Device.DO_LINES, Device.DO_PORTS),
        "int32": (Device.CATEGORY, Device.BUS),
        "uint32": (Device.SERIAL, Device.PRODUCT_NUMBER),
        "bool": (Device.SIMULATED,),
        "double": (Device.AI_MAX_SINGLE_RATE, Device.AI_MAX_RATE),
        "double[]": (Device.AI_RANGES, Device.AO_RANGES),
    },
    "system": {
        "string": (System.DEVICES, System.TASKS, System.CHANNELS, System.SCALES),
        "uint32": (System.MAJOR, System.MINOR, System.UPDATE),
    },
}  # fmt: skip


def type_of(group: str, attribute: int) -> str | None:
    """Return the C type of an attribute's value; None for one that the double does not know.

    It is one of int32, uint32, uint64, bool, double, string and double[].
    """
    for name, attributes in _TYPES.get(group, {}).items():
        if attribute in attributes:
            return name
    return None
