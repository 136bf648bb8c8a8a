"""The PCI-6229 as NI's driver sees it: errors, attributes, channels, terminals, ranges and clocks, validated alike.

From the card's specifications and the M Series manual. The numbers of attributes are those of NIDAQmx.h; status codes
and other constants are taken from `nidaqmx` itself.
"""

import math
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from nidaqmx.constants import ChannelType, EncoderZIndexPhase, LineGrouping, TerminalConfiguration, UsageTypeCI
from nidaqmx.error_codes import DAQmxErrors as Status
from nidaqmx.errors import DaqError
from nidaqmx.utils import unflatten_channel_string

from dragrig.rig import FloatArray

AttributeValue = int | float | bool | str


class CardError(Exception):
    """A DAQmx call that fails, with a sentence like NI's."""

    def __init__(self, code: int, message: str, samples: int = 0) -> None:
        super().__init__(message)
        self.code = int(code)
        """The negative status, of `nidaqmx.error_codes.DAQmxErrors`."""
        self.message = message
        self.samples = samples
        """Samples per channel that were read, or written, all the same."""


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
    CONVERT_RATE = 0x1848
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


PRODUCT = "PCI-6229"
SERIAL_NUMBER = 0x0182C0DE
DRIVER_VERSION = 25

AI_RANGES_V = (0.2, 1.0, 5.0, 10.0)
AI_MAX_RATE_HZ = 250_000.0
"""Of all channels together."""
AO_RANGE_V = 10.0
AO_MAX_RATE_HZ = 833_333.0
TIMEBASE_HZ = 20e6
"""A sample clock is a whole fraction of it."""
CONVERT_S, CONVERT_PADDING_S = 4e-6, 10e-6
"""Shortest time between two inputs of a scan, and how much longer the driver makes it where the sample rate allows."""
SETTLING = ((4e-6, 90e-6), (5e-6, 30e-6), (7e-6, 15e-6), (14e-6, 0.1e-6))
"""What is left of the input before, as a share of the step between both, after a time between two inputs [s]; nothing
from the last one on.
"""
FILTERS_S = (125e-9, 6.425e-6, 2.56e-3)
"""Minimum pulse widths that the digital filters of PFI terminals can be set to."""

AI = tuple(f"ai{number}" for number in range(32))
AI_DIFFERENTIAL = tuple(f"ai{number}" for number in (*range(8), *range(16, 24)))
"""Positive inputs of the differential pairs; the negative one of each is eight further."""
AO = tuple(f"ao{number}" for number in range(4))
COUNTERS = ("ctr0", "ctr1")
LINES = tuple(
    f"{port}/line{line}" for port, width in (("port0", 32), ("port1", 8), ("port2", 8)) for line in range(width)
)
ENCODER_TERMINALS = {"ctr0": ("PFI8", "PFI10", "PFI9"), "ctr1": ("PFI3", "PFI11", "PFI4")}
"""A, B and Z of each counter by default."""
AI_SAMPLE_CLOCK = "ai/SampleClock"
AI_START_TRIGGER = "ai/StartTrigger"
TERMINALS = (*(f"PFI{number}" for number in range(16)), AI_SAMPLE_CLOCK, AI_START_TRIGGER)
_HALF_CODES = 2.0**15

_TERMINAL_ATTRIBUTES = (Attribute.CI_A_TERMINAL, Attribute.CI_B_TERMINAL, Attribute.CI_Z_TERMINAL)
INDEX_PHASES = {
    "a_high_b_high": EncoderZIndexPhase.AHIGH_BHIGH,
    "a_high_b_low": EncoderZIndexPhase.AHIGH_BLOW,
    "a_low_b_high": EncoderZIndexPhase.ALOW_BHIGH,
    "a_low_b_low": EncoderZIndexPhase.ALOW_BLOW,
}
_FILTER_ATTRIBUTES = (Attribute.CI_A_FILTER, Attribute.CI_B_FILTER, Attribute.CI_Z_FILTER)
_FILTER_WIDTH_ATTRIBUTES = (Attribute.CI_A_FILTER_S, Attribute.CI_B_FILTER_S, Attribute.CI_Z_FILTER_S)


@dataclass(slots=True, eq=False)
class VirtualChannel:
    """A virtual channel."""

    name: str
    kind: ChannelType
    physical: str
    """Name on the card: ai0, ctr0, port1/line0."""
    range_V: float = 0.0
    """Largest voltage, of either sign, of an analog channel."""
    properties: dict[int, AttributeValue] = field(default_factory=dict)
    """Values of its attributes by their numbers."""


@dataclass(frozen=True, slots=True)
class EncoderChannel:
    """How a counter measures the encoder: X4 decoding, in metres."""

    count_m: float
    """Length of a count."""
    start_m: float
    """Position at the counter's start."""
    index: bool
    index_m: float
    """`index`, `index_m`: whether the index pulse sets the position, and to what."""
    index_phase: EncoderZIndexPhase
    """State of A and B in which it does."""


def analog_channels(
    device: str, kind: ChannelType, physical: str, name: str, terminals: int, min_V: float, max_V: float
) -> list[VirtualChannel]:
    """Return voltage inputs or outputs; raises `CardError` for channels that the card does not have."""
    if min_V >= max_V:
        raise CardError(Status.MIN_NOT_LESS_THAN_MAX, f"Minimum {min_V:g} V is not less than maximum {max_V:g} V.")
    is_input = kind is ChannelType.ANALOG_INPUT
    largest_V, ranges_V = max(abs(min_V), abs(max_V)), AI_RANGES_V if is_input else (AO_RANGE_V,)
    range_V = next((range_V for range_V in ranges_V if largest_V <= range_V), None)
    if range_V is None:
        raise _unsupported("Max", largest_V, f"Maximum Value: {ranges_V[-1]:g}")
    limits = (Attribute.AI_MIN, Attribute.AI_MAX) if is_input else (Attribute.AO_MIN, Attribute.AO_MAX)
    channels = []
    for place in _places(physical, AI if is_input else AO, device):
        if is_input and place not in AI_DIFFERENTIAL:
            raise _unsupported("AI.TermCfg", terminals, f"{place} has no differential pair of its own")
        channels.append(_channel(device, kind, place, name, dict(zip(limits, (min_V, max_V), strict=True)), range_V))
    if is_input and terminals not in {TerminalConfiguration.DEFAULT.value, TerminalConfiguration.DIFF.value}:
        raise _unsupported("AI.TermCfg", terminals, "Possible Values: differential")
    return channels


def encoder_counter(device: str, counter: str, name: str) -> VirtualChannel:
    """Return a counter for a linear encoder, with its terminals by default."""
    (place,) = _places(counter, COUNTERS, device)
    terminals = zip(_TERMINAL_ATTRIBUTES, ENCODER_TERMINALS[place], strict=True)
    properties: dict[int, AttributeValue] = {
        Attribute.CI_MEASUREMENT: UsageTypeCI.POSITION_LINEAR_ENCODER.value,
        **{attribute: f"/{device}/{terminal}" for attribute, terminal in terminals},
        **dict.fromkeys(_FILTER_ATTRIBUTES, False),
        **dict.fromkeys(_FILTER_WIDTH_ATTRIBUTES, FILTERS_S[0]),
    }
    return _channel(device, ChannelType.COUNTER_INPUT, place, name, properties)


def digital_lines(device: str, kind: ChannelType, lines: str, name: str, grouping: int) -> list[VirtualChannel]:
    """Return channels of one digital line each."""
    places = _places(lines, LINES, device)
    if len(places) > 1 and grouping != LineGrouping.CHAN_PER_LINE.value:
        raise _unsupported("line grouping", grouping, "Possible Values: one channel per line")
    return [_channel(device, kind, place, name, {}) for place in places]


def set_property(channel: VirtualChannel, device: str, attribute: int, value: AttributeValue) -> None:
    """Set a counter's attribute; raises `CardError` for a value or an attribute that the card does not know."""
    if attribute in _TERMINAL_ATTRIBUTES:
        value = f"/{device}/{find_terminal(str(value), device)}"
    elif attribute in _FILTER_WIDTH_ATTRIBUTES:
        if not any(math.isclose(float(str(value)), width_s) for width_s in FILTERS_S):
            raise _unsupported("CI.Encoder.*.DigFltr.MinPulseWidth", value, f"Possible Values: {FILTERS_S}")
    elif attribute not in _FILTER_ATTRIBUTES:
        raise CardError(Status.ATTR_NOT_SUPPORTED, f"Property {attribute:#x} of {channel.name} cannot be set.")
    channel.properties[attribute] = value


def encoder_terminals(channel: VirtualChannel) -> tuple[str, str, str]:
    """Return the terminals of A, B and Z in lower case, without the device."""
    a, b, z = (str(channel.properties[attribute]).rsplit("/", 1)[-1].lower() for attribute in _TERMINAL_ATTRIBUTES)
    return a, b, z


def find_terminal(text: str, device: str) -> str:
    """Return the name of a terminal without its device; raises `CardError` when the card has none such."""
    wanted = text.strip().lower().removeprefix(f"/{device.lower()}/")
    for terminal in TERMINALS:
        if terminal.lower() == wanted:
            return terminal
    raise CardError(
        Status.INVALID_ROUTING_SOURCE_TERMINAL_NAME_ROUTING,
        f"Source terminal to be routed could not be found on the device.\n\nSource Terminal: {text}\nDevice: {device}",
    )


def quantised(volts: FloatArray, range_V: float) -> FloatArray:
    """Return volts as the converter reads them: in steps of the range's 2^−15, clipped at its ends."""
    codes = np.rint(volts * (_HALF_CODES / range_V))
    np.clip(codes, -_HALF_CODES, _HALF_CODES - 1, out=codes)
    codes *= range_V / _HALF_CODES
    return codes


def convert_interval(rate_hz: float, inputs: int) -> float:
    """Return the time between two inputs of a scan, as the driver chooses it [s]."""
    return min(CONVERT_S + CONVERT_PADDING_S, 1.0 / (rate_hz * inputs))


def with_ghosts(volts: list[FloatArray], interval_s: float) -> list[FloatArray]:
    """Return the inputs of scans as the converter sees them: each with the remainder of the one before it."""
    if len(volts) < 2 or interval_s >= SETTLING[-1][0]:
        return volts
    times_s, shares = np.array(SETTLING).T
    share = float(np.exp(np.interp(interval_s, times_s, np.log(shares))))
    return [values + share * (before - values) for before, values in zip([volts[-1], *volts], volts, strict=False)]


def nearest_rate(rate_hz: float) -> float:
    """Return the nearest rate that the card's timebase gives."""
    return TIMEBASE_HZ / max(round(TIMEBASE_HZ / rate_hz), 1)


def _places(physical: str, names: tuple[str, ...], device: str) -> list[str]:
    """Return the names of a list of physical channels on `device`: DEVICE/ai0:2 gives ai0, ai1, ai2."""
    try:
        channels = unflatten_channel_string(physical)
    except DaqError as error:
        raise CardError(error.error_code, str(error)) from error
    places = []
    for channel in channels:
        owner, _, wanted = channel.strip().lstrip("/").partition("/")
        if owner.lower() != device.lower():
            raise CardError(Status.INVALID_DEVICE_ID, f"Device identifier is invalid.\n\nDevice Specified: {owner}")
        if wanted.lower() not in names:
            raise CardError(
                Status.PHYSICAL_CHAN_DOES_NOT_EXIST,
                "Physical channel specified does not exist on this device.\n\n"
                f"Physical Channel Name: {wanted}\nDevice: {device}",
            )
        places.append(wanted.lower())
    return places


def _channel(
    device: str, kind: ChannelType, place: str, name: str, properties: dict[int, AttributeValue], range_V: float = 0.0
) -> VirtualChannel:
    common: dict[int, AttributeValue] = {
        Attribute.CHANNEL_TYPE: kind.value,
        Attribute.CHANNEL_PHYSICAL: f"{device}/{place}",
    }
    return VirtualChannel(name or f"{device}/{place}", kind, place, range_V, common | properties)


def _unsupported(name: str, value: object, possible: str) -> CardError:
    return CardError(
        Status.INVALID_ATTRIBUTE_VALUE,
        "Requested value is not a supported value for this property. The property value may be invalid because it "
        f"conflicts with another property.\n\nProperty: {name}\nRequested Value: {value}\n{possible}",
    )
