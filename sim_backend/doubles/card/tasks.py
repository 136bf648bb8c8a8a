"""Tasks of the card's double with their virtual channels and sample clocks, validated as NI's driver does."""

import math
from dataclasses import dataclass, field

import numpy as np

from dragrig.config.hardware import CardSettings
from dragrig.rig.arrays import FloatArray
from dragrig.sim_backend.doubles.card import pci6229
from dragrig.sim_backend.doubles.card.daqmx import (
    CardError,
    ChannelAttribute,
    ChannelKind,
    Decoding,
    LengthUnit,
    LineGrouping,
    Regeneration,
    SampleMode,
    StatusCode,
)
from dragrig.sim_backend.doubles.card.streams import (
    Bench,
    EncoderCounter,
    EncoderDecoding,
    InputBuffer,
    OutputWaveform,
    ReadPosition,
)

AttributeValue = int | float | bool | str | list[float]
"""What an attribute holds."""


@dataclass(slots=True, eq=False)
class VirtualChannel:
    """A virtual channel.

    Attributes
    ----------
    physical
        Name on the card: ai0, ctr0, port1/line0; of several lines, the first.
    lines
        Of a digital channel.
    range_V
        Volts to either side that an analog channel takes.
    properties
        Values of its attributes by their numbers.
    """

    name: str
    kind: ChannelKind
    physical: str
    range_V: float = 0.0
    lines: tuple[str, ...] = ()
    properties: dict[int, AttributeValue] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SampleClock:
    """A task's sample clock; `source` is empty for the card's own."""

    rate_hz: float
    source: str
    quantity: SampleMode
    samples: int

    @property
    def limit(self) -> int | None:
        """Samples per channel after which the task ends; None when it does not."""
        return self.samples if self.quantity is SampleMode.FINITE else None

    @property
    def buffer_size(self) -> int:
        """Samples per channel that the driver buffers unless told."""
        if self.quantity is SampleMode.FINITE:
            return self.samples
        for below_hz, size in ((100.0, 1_000), (10_000.0, 10_000), (1_000_000.0, 100_000)):
            if self.rate_hz <= below_hz:
                return max(size, self.samples)
        return max(1_000_000, self.samples)


@dataclass(slots=True, eq=False)
class CardTask:
    """A task: what was configured, and what runs. Only the `Engine` changes it, under its lock."""

    handle: int
    name: str
    channels: list[VirtualChannel] = field(default_factory=list)
    timing: SampleClock | None = None
    position: ReadPosition = field(default_factory=ReadPosition)
    input_buffer: int | None = None
    output_buffer: int | None = None
    regeneration: int = Regeneration.ALLOWED
    trigger: str = ""
    auto_start: bool = True
    reserved: bool = False
    running: bool = False
    origin: int = 0
    stream: InputBuffer | None = None
    counter: EncoderCounter | None = None
    waveform: OutputWaveform | None = None

    @property
    def kind(self) -> ChannelKind | None:
        """What its channels do; None without channels."""
        return self.channels[0].kind if self.channels else None

    @property
    def buffer_size(self) -> int:
        """Samples per channel between card and program."""
        if self.input_buffer:
            return self.input_buffer
        return self.timing.buffer_size if self.timing is not None else 0

    def add(self, channels: list[VirtualChannel]) -> None:
        """Add channels, all of one kind, each once; raises `CardError`."""
        for channel in channels:
            if any(channel.name == one.name for one in self.channels):
                raise CardError(StatusCode.CHANNEL_ALREADY_IN_TASK, f"Channel is in the task already: {channel.name}")
            if self.kind not in {None, channel.kind}:
                raise CardError(StatusCode.CHANNEL_TYPE_MISMATCH, f"Channel {channel.name} is of another kind.")
        self.channels.extend(channels)


def checked_sample_clock(
    task: CardTask, device: str, source: str, rate_hz: float, quantity: int, samples: int
) -> SampleClock:
    """Return a sample clock at the nearest rate that the card can make.

    Raises
    ------
    CardError
        For a rate, a terminal or a number of samples that the card does not have.
    """
    if quantity not in {SampleMode.FINITE, SampleMode.CONTINUOUS}:
        raise CardError(StatusCode.INVALID_ATTRIBUTE_VALUE, f"Sample mode {quantity} is not supported by this task.")
    if not rate_hz > 0:
        raise CardError(StatusCode.INVALID_ATTRIBUTE_VALUE, f"Sample rate must be above 0, not {rate_hz:g}.")
    if quantity == SampleMode.FINITE and samples < 1:
        raise CardError(StatusCode.INVALID_ATTRIBUTE_VALUE, "A finite task needs at least one sample per channel.")
    place = pci6229.terminal(source, device) if source and source != "OnboardClock" else ""
    match task.kind:
        case ChannelKind.ANALOG_INPUT:
            most_hz = pci6229.AI_MAX_RATE_HZ / len(task.channels)
        case ChannelKind.ANALOG_OUTPUT:
            most_hz = pci6229.AO_MAX_RATE_HZ
        case ChannelKind.COUNTER_INPUT:
            return SampleClock(rate_hz, place, SampleMode(quantity), samples)
        case None:
            raise CardError(StatusCode.NO_CHANNELS, f"Task has no channels.\n\nTask Name: {task.name}")
        case _:
            raise CardError(StatusCode.ATTRIBUTE_NOT_SUPPORTED, "These digital lines have no sample clock.")
    rate_hz = pci6229.possible_rate(rate_hz)
    if rate_hz > most_hz * (1 + 1e-9):
        code = StatusCode.RATE_TOO_HIGH if len(task.channels) == 1 else StatusCode.TOO_FAST_FOR_CHANNELS
        raise CardError(
            code, f"Sample rate {rate_hz:g} Hz is above the {most_hz:g} Hz that {len(task.channels)} channels can have."
        )
    return SampleClock(rate_hz, place, SampleMode(quantity), samples)


_VOLTS = 10348
_VOLTAGE = 10322
_LINEAR_ENCODER = 10361
_TERMINAL_ATTRIBUTES = (ChannelAttribute.CI_A_TERMINAL, ChannelAttribute.CI_B_TERMINAL, ChannelAttribute.CI_Z_TERMINAL)
_FILTER_ATTRIBUTES = (ChannelAttribute.CI_A_FILTER, ChannelAttribute.CI_B_FILTER, ChannelAttribute.CI_Z_FILTER)
_FILTER_WIDTH_ATTRIBUTES = (
    ChannelAttribute.CI_A_FILTER_S,
    ChannelAttribute.CI_B_FILTER_S,
    ChannelAttribute.CI_Z_FILTER_S,
)
_SETTABLE = frozenset(
    {
        *_TERMINAL_ATTRIBUTES,
        *_FILTER_ATTRIBUTES,
        *_FILTER_WIDTH_ATTRIBUTES,
        ChannelAttribute.CI_DECODING,
        ChannelAttribute.CI_Z_ENABLE,
        ChannelAttribute.CI_Z_VALUE,
        ChannelAttribute.CI_Z_PHASE,
        ChannelAttribute.CI_DISTANCE_PER_PULSE,
        ChannelAttribute.CI_INITIAL_POSITION,
        ChannelAttribute.CI_UNITS,
    }
)


def analog_inputs(
    device: str, physical: str, name: str, terminals: int, min_V: float, max_V: float, units: int
) -> list[VirtualChannel]:
    """Return voltage inputs; raises `CardError` for what the card does not have."""
    _refuse_custom_scale(units)
    channels = []
    for one in pci6229.physical_names(physical, device):
        place = pci6229.known(one, pci6229.AI, device)
        range_V = pci6229.input_range(place, terminals, min_V, max_V)
        properties: dict[int, AttributeValue] = {
            ChannelAttribute.AI_MAX: max_V,
            ChannelAttribute.AI_MIN: min_V,
            ChannelAttribute.AI_RANGE_HIGH: range_V,
            ChannelAttribute.AI_RANGE_LOW: -range_V,
            ChannelAttribute.AI_TERMINALS: terminals,
            ChannelAttribute.AI_MEASURES: _VOLTAGE,
        }
        channels.append(_channel(device, ChannelKind.ANALOG_INPUT, place, name, range_V, properties))
    return _with_numbered_names(channels, name)


def analog_outputs(
    device: str, physical: str, name: str, min_V: float, max_V: float, units: int
) -> list[VirtualChannel]:
    """Return voltage outputs; raises `CardError` for what the card does not have."""
    _refuse_custom_scale(units)
    if min_V >= max_V:
        raise CardError(StatusCode.MIN_NOT_LESS_THAN_MAX, f"Minimum {min_V:g} V is not less than maximum {max_V:g} V.")
    if max(abs(min_V), abs(max_V)) > pci6229.AO_RANGE_V:
        raise _unsupported("AO.Max", max(abs(min_V), abs(max_V)), f"Maximum Value: {pci6229.AO_RANGE_V:g}")
    properties: dict[int, AttributeValue] = {ChannelAttribute.AO_MAX: max_V, ChannelAttribute.AO_MIN: min_V}
    places = [pci6229.known(one, pci6229.AO, device) for one in pci6229.physical_names(physical, device)]
    channels = [
        _channel(device, ChannelKind.ANALOG_OUTPUT, place, name, pci6229.AO_RANGE_V, dict(properties))
        for place in places
    ]
    return _with_numbered_names(channels, name)


def encoder_counter(
    device: str, counter: str, name: str, properties: dict[int, AttributeValue]
) -> list[VirtualChannel]:
    """Return a counter for a linear encoder, with its attributes as created."""
    places = [pci6229.known(one, pci6229.COUNTERS, device) for one in pci6229.physical_names(counter, device)]
    if len(places) != 1:
        raise CardError(StatusCode.INVALID_ATTRIBUTE_VALUE, "A task takes one counter.")
    place = places[0]
    told: dict[int, AttributeValue] = {
        ChannelAttribute.CI_MEASURES: _LINEAR_ENCODER,
        **{
            one: f"/{device}/{pin}"
            for one, pin in zip(_TERMINAL_ATTRIBUTES, pci6229.ENCODER_TERMINALS[place], strict=True)
        },
        **dict.fromkeys(_FILTER_ATTRIBUTES, False),
        **dict.fromkeys(_FILTER_WIDTH_ATTRIBUTES, pci6229.FILTERS_S[0]),
    }
    channel = _channel(device, ChannelKind.COUNTER_INPUT, place, name, 0.0, told)
    for attribute, value in properties.items():
        set_property(channel, device, attribute, value)
    return [channel]


def digital_lines(device: str, lines: str, name: str, grouping: int, kind: ChannelKind) -> list[VirtualChannel]:
    """Return channels of digital lines, one a line or one for all."""
    found: list[str] = []
    for one in pci6229.physical_names(lines, device):
        width = pci6229.PORTS.get(one.lower())
        found += (
            [f"{one.lower()}/line{number}" for number in range(width)]
            if width
            else [pci6229.known(one, pci6229.LINES, device)]
        )
    groups = [(line,) for line in found] if grouping == LineGrouping.CHANNEL_PER_LINE else [tuple(found)]
    channels = []
    for group in groups:
        channel = _channel(device, kind, group[0], name, 0.0, {})
        channel.lines = group
        channels.append(channel)
    return _with_numbered_names(channels, name)


def set_property(channel: VirtualChannel, device: str, attribute: int, value: AttributeValue) -> None:
    """Set a channel's attribute; raises `CardError` for a value or an attribute that the card does not know."""
    if attribute not in _SETTABLE or channel.kind is not ChannelKind.COUNTER_INPUT:
        raise CardError(StatusCode.ATTRIBUTE_NOT_SUPPORTED, f"Property {attribute:#x} of {channel.name} cannot be set.")
    if attribute in _TERMINAL_ATTRIBUTES:
        value = f"/{device}/{pci6229.terminal(str(value), device)}"
    elif attribute in _FILTER_WIDTH_ATTRIBUTES and not any(
        math.isclose(float(str(value)), one) for one in pci6229.FILTERS_S
    ):
        raise _unsupported("CI.Encoder.*.DigFltr.MinPulseWidth", value, f"Possible Values: {pci6229.FILTERS_S}")
    elif attribute == ChannelAttribute.CI_DECODING and value not in list(Decoding):
        raise _unsupported("CI.Encoder.DecodingType", value, "Possible Values: X1, X2, X4")
    elif attribute == ChannelAttribute.CI_UNITS and value not in list(LengthUnit):
        raise _unsupported("CI.LinEncoder.Units", value, "Possible Values: meters, inches, ticks")
    channel.properties[attribute] = value


def encoder_decoding(channel: VirtualChannel, wiring: CardSettings) -> EncoderDecoding:
    """Return how a counter takes the encoder that is wired as `wiring` says."""
    a, b, z = (str(channel.properties[one]).rsplit("/", 1)[-1].lower() for one in _TERMINAL_ATTRIBUTES)
    wired = (wiring.encoder.a.lower(), wiring.encoder.b.lower())
    unit = LengthUnit(int(_numeric_property(channel, ChannelAttribute.CI_UNITS)))
    return EncoderDecoding(
        decoding=Decoding(int(_numeric_property(channel, ChannelAttribute.CI_DECODING))),
        unit=unit,
        distance_per_pulse=_numeric_property(channel, ChannelAttribute.CI_DISTANCE_PER_PULSE),
        initial_position=_numeric_property(channel, ChannelAttribute.CI_INITIAL_POSITION),
        index=bool(channel.properties[ChannelAttribute.CI_Z_ENABLE])
        and bool(wiring.encoder.z)
        and z == wiring.encoder.z.lower(),
        index_position=_numeric_property(channel, ChannelAttribute.CI_Z_VALUE),
        sense={wired: 1, wired[::-1]: -1}.get((a, b), 0),
    )


def wired_signal(channel: VirtualChannel, wiring: CardSettings) -> str | None:
    """Return the bench's name for what is on an analog input; None when nothing is."""
    if channel.physical == wiring.force.channel.lower():
        return "force_V"
    return next((one.name for one in wiring.inputs if one.channel.lower() == channel.physical), None)


def _channel(
    device: str, kind: ChannelKind, place: str, name: str, range_V: float, properties: dict[int, AttributeValue]
) -> VirtualChannel:
    told: dict[int, AttributeValue] = {
        ChannelAttribute.TYPE: int(kind),
        ChannelAttribute.PHYSICAL: f"{device}/{place}",
        **properties,
    }
    return VirtualChannel(name or f"{device}/{place}", kind, place, range_V, (), told)


def _with_numbered_names(channels: list[VirtualChannel], name: str) -> list[VirtualChannel]:
    if name and len(channels) > 1:
        for number, channel in enumerate(channels):
            channel.name = f"{name}{number}"
    return channels


def _numeric_property(channel: VirtualChannel, attribute: ChannelAttribute) -> float:
    value = channel.properties[attribute]
    if isinstance(value, str | list):
        raise TypeError(f"attribute {attribute!r} is no number")
    return float(value)


def _refuse_custom_scale(units: int) -> None:
    if units != _VOLTS:
        raise _unsupported("AI.Voltage.Units", units, "Possible Values: volts")


def _unsupported(name: str, value: object, possible: str) -> CardError:
    return CardError(
        StatusCode.INVALID_ATTRIBUTE_VALUE,
        "Requested value is not a supported value for this property. The property value may be invalid because it "
        f"conflicts with another property.\n\nProperty: {name}\nRequested Value: {value}\n{possible}",
    )


class AnalogSource:
    """Volts of analog inputs, as the converter tells them."""

    def __init__(self, bench: Bench, channels: list[VirtualChannel], rate_hz: float) -> None:
        self._bench = bench
        self._signals = [(wired_signal(one, bench.rig.hardware.card), one.range_V) for one in channels]
        self._rate_hz = rate_hz

    @property
    def rate_hz(self) -> float:
        """Samples per second."""
        return self._rate_hz

    def total(self) -> int:
        """Return how many samples per channel were taken."""
        return self._bench.available()

    def fetch(self, first: int, end: int) -> list[FloatArray]:
        """Return volts of each channel; 0 where nothing is wired."""
        shown = self._bench.sample(first, end)
        return [
            pci6229.quantised(shown[signal], range_V) if signal is not None else np.zeros(end - first)
            for signal, range_V in self._signals
        ]
