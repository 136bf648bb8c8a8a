"""Tasks of the card's double and the virtual channels in them."""

from dataclasses import dataclass, field

from dragrig.sim_backend.doubles.card.counter import Counter
from dragrig.sim_backend.doubles.card.daqmx import CardError, ChannelKind, Code, Quantity, Regeneration
from dragrig.sim_backend.doubles.card.streams import Position, Stream
from dragrig.sim_backend.doubles.card.waveform import Waveform

Value = int | float | bool | str | list[float]
"""What an attribute holds."""


@dataclass(slots=True, eq=False)
class Channel:
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
    properties: dict[int, Value] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Timing:
    """A task's sample clock; `source` is empty for the card's own."""

    rate_hz: float
    source: str
    quantity: Quantity
    samples: int

    @property
    def limit(self) -> int | None:
        """Samples per channel after which the task ends; None when it does not."""
        return self.samples if self.quantity is Quantity.FINITE else None

    @property
    def buffer_size(self) -> int:
        """Samples per channel that the driver buffers unless told."""
        if self.quantity is Quantity.FINITE:
            return self.samples
        for below_hz, size in ((100.0, 1_000), (10_000.0, 10_000), (1_000_000.0, 100_000)):
            if self.rate_hz <= below_hz:
                return max(size, self.samples)
        return max(1_000_000, self.samples)


@dataclass(slots=True, eq=False)
class Task:
    """A task: what was configured, and what runs. Only the `Engine` changes it, under its lock."""

    handle: int
    name: str
    channels: list[Channel] = field(default_factory=list)
    timing: Timing | None = None
    position: Position = field(default_factory=Position)
    input_buffer: int | None = None
    output_buffer: int | None = None
    regeneration: int = Regeneration.ALLOWED
    trigger: str = ""
    auto_start: bool = True
    reserved: bool = False
    running: bool = False
    origin: int = 0
    stream: Stream | None = None
    counter: Counter | None = None
    waveform: Waveform | None = None

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

    def add(self, channels: list[Channel]) -> None:
        """Add channels, all of one kind, each once; raises `CardError`."""
        for channel in channels:
            if any(channel.name == one.name for one in self.channels):
                raise CardError(Code.CHANNEL_ALREADY_IN_TASK, f"Channel is in the task already: {channel.name}")
            if self.kind not in {None, channel.kind}:
                raise CardError(Code.CHANNEL_TYPE_MISMATCH, f"Channel {channel.name} is of another kind.")
        self.channels.extend(channels)
