"""Virtual channels as programs create them, checked as the driver checks them."""

import math

from dragrig.config.hardware import CardSettings
from dragrig.sim_backend.doubles.card import pci6229
from dragrig.sim_backend.doubles.card.attributes import Chan
from dragrig.sim_backend.doubles.card.counter import Encoder
from dragrig.sim_backend.doubles.card.daqmx import CardError, ChannelKind, Code, Decoding, Grouping, Length
from dragrig.sim_backend.doubles.card.tasks import Channel, Value

_VOLTS = 10348
_VOLTAGE = 10322
_LINEAR_ENCODER = 10361
_TERMINALS = (Chan.CI_A_TERMINAL, Chan.CI_B_TERMINAL, Chan.CI_Z_TERMINAL)
_FILTERS = (Chan.CI_A_FILTER, Chan.CI_B_FILTER, Chan.CI_Z_FILTER)
_FILTERS_S = (Chan.CI_A_FILTER_S, Chan.CI_B_FILTER_S, Chan.CI_Z_FILTER_S)
_SETTABLE = frozenset({
    *_TERMINALS, *_FILTERS, *_FILTERS_S, Chan.CI_DECODING, Chan.CI_Z_ENABLE, Chan.CI_Z_VALUE, Chan.CI_Z_PHASE,
    Chan.CI_DISTANCE_PER_PULSE, Chan.CI_INITIAL_POSITION, Chan.CI_UNITS,
})  # fmt: skip


def analog_inputs(
    device: str, physical: str, name: str, terminals: int, min_V: float, max_V: float, units: int
) -> list[Channel]:
    """Return voltage inputs; raises `CardError` for what the card does not have."""
    _refuse_scales(units)
    channels = []
    for one in pci6229.physical_names(physical, device):
        place = pci6229.known(one, pci6229.AI, device)
        range_V = pci6229.input_range(place, terminals, min_V, max_V)
        properties: dict[int, Value] = {
            Chan.AI_MAX: max_V, Chan.AI_MIN: min_V, Chan.AI_RANGE_HIGH: range_V, Chan.AI_RANGE_LOW: -range_V,
            Chan.AI_TERMINALS: terminals, Chan.AI_MEASURES: _VOLTAGE,
        }  # fmt: skip
        channels.append(_channel(device, ChannelKind.ANALOG_INPUT, place, name, range_V, properties))
    return _numbered(channels, name)


def analog_outputs(device: str, physical: str, name: str, min_V: float, max_V: float, units: int) -> list[Channel]:
    """Return voltage outputs; raises `CardError` for what the card does not have."""
    _refuse_scales(units)
    if min_V >= max_V:
        raise CardError(Code.MIN_NOT_LESS_THAN_MAX, f"Minimum {min_V:g} V is not less than maximum {max_V:g} V.")
    if max(abs(min_V), abs(max_V)) > pci6229.AO_RANGE_V:
        raise _unsupported("AO.Max", max(abs(min_V), abs(max_V)), f"Maximum Value: {pci6229.AO_RANGE_V:g}")
    properties: dict[int, Value] = {Chan.AO_MAX: max_V, Chan.AO_MIN: min_V}
    places = [pci6229.known(one, pci6229.AO, device) for one in pci6229.physical_names(physical, device)]
    channels = [
        _channel(device, ChannelKind.ANALOG_OUTPUT, place, name, pci6229.AO_RANGE_V, dict(properties))
        for place in places
    ]
    return _numbered(channels, name)


def encoder_counter(device: str, counter: str, name: str, properties: dict[int, Value]) -> list[Channel]:
    """Return a counter for a linear encoder, with its attributes as created."""
    places = [pci6229.known(one, pci6229.COUNTERS, device) for one in pci6229.physical_names(counter, device)]
    if len(places) != 1:
        raise CardError(Code.INVALID_ATTRIBUTE_VALUE, "A task takes one counter.")
    place = places[0]
    told: dict[int, Value] = {
        Chan.CI_MEASURES: _LINEAR_ENCODER,
        **{one: f"/{device}/{pin}" for one, pin in zip(_TERMINALS, pci6229.ENCODER_TERMINALS[place], strict=True)},
        **dict.fromkeys(_FILTERS, False),
        **dict.fromkeys(_FILTERS_S, pci6229.FILTERS_S[0]),
    }
    channel = _channel(device, ChannelKind.COUNTER_INPUT, place, name, 0.0, told)
    for attribute, value in properties.items():
        set_property(channel, device, attribute, value)
    return [channel]


def digital_lines(device: str, lines: str, name: str, grouping: int, kind: ChannelKind) -> list[Channel]:
    """Return channels of digital lines, one a line or one for all."""
    found: list[str] = []
    for one in pci6229.physical_names(lines, device):
        width = pci6229.PORTS.get(one.lower())
        found += (
            [f"{one.lower()}/line{number}" for number in range(width)]
            if width
            else [pci6229.known(one, pci6229.LINES, device)]
        )
    groups = [(line,) for line in found] if grouping == Grouping.CHANNEL_PER_LINE else [tuple(found)]
    channels = []
    for group in groups:
        channel = _channel(device, kind, group[0], name, 0.0, {})
        channel.lines = group
        channels.append(channel)
    return _numbered(channels, name)


def set_property(channel: Channel, device: str, attribute: int, value: Value) -> None:
    """Set a channel's attribute; raises `CardError` for a value or an attribute that the card does not know."""
    if attribute not in _SETTABLE or channel.kind is not ChannelKind.COUNTER_INPUT:
        raise CardError(Code.ATTRIBUTE_NOT_SUPPORTED, f"Property {attribute:#x} of {channel.name} cannot be set.")
    if attribute in _TERMINALS:
        value = f"/{device}/{pci6229.terminal(str(value), device)}"
    elif attribute in _FILTERS_S and not any(math.isclose(float(str(value)), one) for one in pci6229.FILTERS_S):
        raise _unsupported("CI.Encoder.*.DigFltr.MinPulseWidth", value, f"Possible Values: {pci6229.FILTERS_S}")
    elif attribute == Chan.CI_DECODING and value not in list(Decoding):
        raise _unsupported("CI.Encoder.DecodingType", value, "Possible Values: X1, X2, X4")
    elif attribute == Chan.CI_UNITS and value not in list(Length):
        raise _unsupported("CI.LinEncoder.Units", value, "Possible Values: meters, inches, ticks")
    channel.properties[attribute] = value


def encoder_of(channel: Channel, wiring: CardSettings) -> Encoder:
    """Return how a counter takes the encoder that is wired as `wiring` says."""
    a, b, z = (str(channel.properties[one]).rsplit("/", 1)[-1].lower() for one in _TERMINALS)
    wired = (wiring.encoder.a.lower(), wiring.encoder.b.lower())
    unit = Length(int(_number(channel, Chan.CI_UNITS)))
    return Encoder(
        decoding=Decoding(int(_number(channel, Chan.CI_DECODING))),
        unit=unit,
        distance_per_pulse=_number(channel, Chan.CI_DISTANCE_PER_PULSE),
        initial_position=_number(channel, Chan.CI_INITIAL_POSITION),
        index=bool(channel.properties[Chan.CI_Z_ENABLE]) and bool(wiring.encoder.z) and z == wiring.encoder.z.lower(),
        index_position=_number(channel, Chan.CI_Z_VALUE),
        sense={wired: 1, wired[::-1]: -1}.get((a, b), 0),
    )


def signal_of(channel: Channel, wiring: CardSettings) -> str | None:
    """Return the bench's name for what is on an analog input; None when nothing is."""
    if channel.physical == wiring.force.channel.lower():
        return "force_V"
    return next((one.name for one in wiring.inputs if one.channel.lower() == channel.physical), None)


def _channel(
    device: str, kind: ChannelKind, place: str, name: str, range_V: float, properties: dict[int, Value]
) -> Channel:
    told: dict[int, Value] = {Chan.TYPE: int(kind), Chan.PHYSICAL: f"{device}/{place}", **properties}
    return Channel(name or f"{device}/{place}", kind, place, range_V, (), told)


def _numbered(channels: list[Channel], name: str) -> list[Channel]:
    if name and len(channels) > 1:
        for number, channel in enumerate(channels):
            channel.name = f"{name}{number}"
    return channels


def _number(channel: Channel, attribute: Chan) -> float:
    value = channel.properties[attribute]
    if isinstance(value, str | list):
        raise TypeError(f"attribute {attribute!r} is no number")
    return float(value)


def _refuse_scales(units: int) -> None:
    if units != _VOLTS:
        raise _unsupported("AI.Voltage.Units", units, "Possible Values: volts")


def _unsupported(name: str, value: object, possible: str) -> CardError:
    return CardError(
        Code.INVALID_ATTRIBUTE_VALUE,
        "Requested value is not a supported value for this property. The property value may be invalid because it "
        f"conflicts with another property.\n\nProperty: {name}\nRequested Value: {value}\n{possible}",
    )
