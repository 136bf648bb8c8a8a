"""NI-DAQmx as the card's double implements it: its errors, and its attributes by NI's numbers.

The numbers are those of NIDAQmx.h; status codes and other constants are taken from `nidaqmx` itself.
"""

from enum import IntEnum

AttributeValue = int | float | bool | str


class CardError(Exception):
    """A DAQmx call that fails.

    Attributes
    ----------
    code
        The negative status; one of `nidaqmx.error_codes.DAQmxErrors`.
    message
        A sentence like NI's.
    samples
        How many samples per channel were read, or written, all the same.
    """

    def __init__(self, code: int, message: str, samples: int = 0) -> None:
        super().__init__(message)
        self.code = int(code)
        self.message = message
        self.samples = samples


class Attribute(IntEnum):
    """Attributes of the driver, the device, tasks, virtual channels, reads, writes and buffers."""

    SYSTEM_DEVICES = 0x193B
    SYSTEM_MAJOR_VERSION = 0x1272
    SYSTEM_MINOR_VERSION = 0x1923
    SYSTEM_UPDATE_VERSION = 0x2F22
    DEVICE_PRODUCT = 0x0631
    DEVICE_SERIAL = 0x0632
    TASK_NAME = 0x1276
    TASK_CHANNELS = 0x1273
    CHANNEL_TYPE = 0x187F
    CHANNEL_PHYSICAL = 0x18F5
    AI_MAX = 0x17DD
    AI_MIN = 0x17DE
    AO_MAX = 0x1186
    AO_MIN = 0x1187
    CI_MEASUREMENT = 0x18A0
    CI_A_TERMINAL = 0x219D
    CI_B_TERMINAL = 0x219E
    CI_Z_TERMINAL = 0x219F
    CI_A_FILTER = 0x21FB
    CI_A_FILTER_S = 0x21FC
    CI_B_FILTER = 0x2200
    CI_B_FILTER_S = 0x2201
    CI_Z_FILTER = 0x2205
    CI_Z_FILTER_S = 0x2206
    CLOCK_RATE = 0x1344
    READ_RELATIVE_TO = 0x190A
    READ_OFFSET = 0x190B
    READ_OVERWRITE = 0x1211
    READ_TOTAL = 0x192A
    READ_POSITION = 0x1221
    READ_CHANNELS = 0x1823
    READ_NUM_CHANNELS = 0x217B
    READ_LINES_PER_CHANNEL = 0x217C
    WRITE_REGENERATION = 0x1453
    WRITE_TOTAL = 0x192B
    WRITE_NUM_CHANNELS = 0x217E
    WRITE_LINES_PER_CHANNEL = 0x217F
    INPUT_BUFFER = 0x186C
    OUTPUT_BUFFER = 0x186D


WIDE_ATTRIBUTES = frozenset({Attribute.READ_TOTAL, Attribute.READ_POSITION, Attribute.WRITE_TOTAL})
"""Whole numbers of 64 bits in C; all others have 32."""
