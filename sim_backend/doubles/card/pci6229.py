"""What NI's PCI-6229 has: channels, terminals, ranges, clocks. From its specifications and the M Series manual."""

import numpy as np
from nidaqmx.errors import DaqError
from nidaqmx.utils import unflatten_channel_string

from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.doubles.card.daqmx import CardError, StatusCode, TerminalConfiguration

PRODUCT = "PCI-6229"
PRODUCT_NUMBER = 0x70AA
SERIAL_NUMBER = 0x0182C0DE
DRIVER_VERSION = (25, 0, 0)

AI_RANGES_V = (0.2, 1.0, 5.0, 10.0)
AI_MAX_RATE_HZ = 250_000.0
"""Of all channels together."""
AO_RANGE_V = 10.0
AO_MAX_RATE_HZ = 833_333.0
TIMEBASE_HZ = 20e6
"""A sample clock is a whole fraction of it."""
FILTERS_S = (125e-9, 6.425e-6, 2.56e-3)
"""Shortest pulses that the digital filters of PFI terminals can be set to pass."""

AI = tuple(f"ai{number}" for number in range(32))
AI_DIFFERENTIAL = tuple(f"ai{number}" for number in (*range(8), *range(16, 24)))
"""Positive inputs of the differential pairs; the negative one of each is eight further."""
AO = tuple(f"ao{number}" for number in range(4))
COUNTERS = ("ctr0", "ctr1")
PORTS = {"port0": 32, "port1": 8, "port2": 8}
LINES = tuple(f"{port}/line{line}" for port, width in PORTS.items() for line in range(width))
ENCODER_TERMINALS = {"ctr0": ("PFI8", "PFI10", "PFI9"), "ctr1": ("PFI3", "PFI11", "PFI4")}
"""A, B and Z of each counter unless set otherwise."""
AI_SAMPLE_CLOCK = "ai/SampleClock"
TERMINALS = (*(f"PFI{number}" for number in range(16)), *(f"RTSI{number}" for number in range(8)), AI_SAMPLE_CLOCK,
             "ai/ConvertClock", "ai/StartTrigger", "ao/SampleClock", "ao/StartTrigger", "20MHzTimebase",
             "80MHzTimebase", "100kHzTimebase", "Ctr0Source", "Ctr0Gate", "Ctr0InternalOutput", "Ctr1Source",
             "Ctr1Gate", "Ctr1InternalOutput")  # fmt: skip
_BITS = 16


def physical_names(text: str, device: str) -> list[str]:
    """Return what a list of physical channels names on `device`: DEVICE/ai0:2 gives ai0, ai1, ai2.

    Raises
    ------
    CardError
        For another device (−200220) or a list that cannot be read (−200498).
    """
    try:
        names = unflatten_channel_string(text)
    except DaqError as error:
        raise CardError(error.error_code, str(error)) from error
    found = []
    for name in names:
        owner, _, rest = name.strip().lstrip("/").partition("/")
        if owner.lower() != device.lower():
            raise CardError(StatusCode.INVALID_DEVICE, f"Device identifier is invalid.\n\nDevice Specified: {owner}")
        found.append(rest)
    if not found:
        raise CardError(StatusCode.PHYSICAL_CHAN_DOES_NOT_EXIST, "Physical channel not specified.")
    return found


def known(name: str, names: tuple[str, ...], device: str) -> str:
    """Return `name` as the card spells it; raises `CardError` when it has none of the kind."""
    for one in names:
        if one.lower() == name.lower():
            return one
    raise CardError(
        StatusCode.PHYSICAL_CHAN_DOES_NOT_EXIST,
        f"Physical channel specified does not exist on this device.\n\nPhysical Channel Name: {name}\nDevice: {device}",
    )


def terminal(text: str, device: str) -> str:
    """Return the name of a terminal without its device; raises `CardError` when the card has none such."""
    plain = text.strip()
    parts = plain.lstrip("/").split("/", 1)
    if plain.startswith("/") and len(parts) == 2 and parts[0].lower() == device.lower():
        plain = parts[1]
    for one in TERMINALS:
        if one.lower() == plain.lower():
            return one
    raise CardError(
        StatusCode.INVALID_TERMINAL,
        f"Source terminal to be routed could not be found on the device.\n\nSource Terminal: {text}\nDevice: {device}",
    )


def input_range(channel: str, terminals: int, min_V: float, max_V: float) -> float:
    """Return the smallest range that takes an analog input's limits [V].

    Raises
    ------
    CardError
        For limits beyond ±10 V or the wrong way round, and for wiring that the channel does not have.
    """
    if min_V >= max_V:
        raise CardError(StatusCode.MIN_NOT_LESS_THAN_MAX, f"Minimum {min_V:g} V is not less than maximum {max_V:g} V.")
    try:
        wired = TerminalConfiguration(terminals)
    except ValueError as error:
        raise CardError(
            StatusCode.INVALID_ATTRIBUTE_VALUE, f"There is no terminal configuration {terminals}."
        ) from error
    if wired in {TerminalConfiguration.DEFAULT, TerminalConfiguration.DIFFERENTIAL} and channel not in AI_DIFFERENTIAL:
        raise CardError(
            StatusCode.INVALID_ATTRIBUTE_VALUE,
            f"Requested value is not a supported value for this property.\n\nProperty: AI.TermCfg\nChannel: {channel} "
            "has no differential pair of its own",
        )
    furthest = max(abs(min_V), abs(max_V))
    for range_V in AI_RANGES_V:
        if furthest <= range_V:
            return range_V
    raise CardError(
        StatusCode.INVALID_ATTRIBUTE_VALUE,
        f"Requested value is not a supported value for this property.\n\nProperty: AI.Max\nRequested: {furthest:g} V\n"
        f"Maximum Value: {AI_RANGES_V[-1]:g}",
    )


def quantised(volts: FloatArray, range_V: float) -> FloatArray:
    """Return volts as the converter tells them: in steps of the range's 2^−15, clipped at its ends."""
    half = 2.0 ** (_BITS - 1)
    codes = np.rint(volts * (half / range_V))
    np.clip(codes, -half, half - 1, out=codes)
    codes *= range_V / half
    return codes


def possible_rate(rate_hz: float) -> float:
    """Return the nearest rate that the card's timebase gives."""
    return TIMEBASE_HZ / max(round(TIMEBASE_HZ / rate_hz), 1)
