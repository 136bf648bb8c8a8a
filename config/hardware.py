"""Wiring of the real rig: which signal is on which terminal of the card, and how the drive is reached.

Terminals of the PCI-6229 are named without the device (NI 622x Specifications, pinout).
"""

import re
from collections.abc import Iterable
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from dragrig.config.settings import Settings

_LAST_LINE_OF_PORT = {0: 31, 1: 7, 2: 7}


def _terminal_number(text: str, pattern: str, largest: int) -> int | None:
    found = re.fullmatch(pattern + r"(\d{1,2})", text)
    return int(found[1]) if found and int(found[1]) <= largest else None


def _analog_input(channel: str) -> str:
    number = _terminal_number(channel, "ai", 31)
    if number is None or number % 16 > 7:
        raise ValueError(
            "must be the positive input of a differential pair, ai0 to ai7 or ai16 to ai23, without the device's name"
        )
    return channel


def _analog_output(channel: str) -> str:
    if _terminal_number(channel, "ao", 3) is None:
        raise ValueError("must be an analog output, ao0 to ao3, without the device's name")
    return channel


def _counter(name: str) -> str:
    if _terminal_number(name, "ctr", 1) is None:
        raise ValueError("must be a counter, ctr0 or ctr1, without the device's name")
    return name


def _input_terminal(name: str) -> str:
    if _terminal_number(name, "PFI", 15) is None:
        raise ValueError("must be an input terminal, PFI0 to PFI15, without the device's name")
    return name


def _line(name: str) -> str:
    port, _, number = name.removeprefix("port").partition("/line")
    port_known = name.startswith("port") and port in {str(one) for one in _LAST_LINE_OF_PORT}
    if not port_known or _terminal_number(number, "", _LAST_LINE_OF_PORT[int(port)]) is None:
        raise ValueError("must be a digital line such as port1/line0, without the device's name; empty if not wired")
    return name


def _optional_input_terminal(name: str) -> str:
    return name and _input_terminal(name)


def _optional_line(name: str) -> str:
    return name and _line(name)


AnalogInput = Annotated[str, AfterValidator(_analog_input)]
AnalogOutput = Annotated[str, AfterValidator(_analog_output)]
Counter = Annotated[str, AfterValidator(_counter)]
InputTerminal = Annotated[str, AfterValidator(_input_terminal)]
OptionalInputTerminal = Annotated[str, AfterValidator(_optional_input_terminal)]
OptionalLine = Annotated[str, AfterValidator(_optional_line)]


def shared_pin(name: str) -> str:
    """Spell a digital line as the input terminal whose pin it shares; any other name as it is.

    Port 1 is PFI0 to PFI7, port 2 is PFI8 to PFI15.
    """
    found = re.fullmatch(r"port([12])/line(\d)", name)
    return f"PFI{8 * (int(found[1]) - 1) + int(found[2])}" if found else name


def find_shared_pin(names: Iterable[str]) -> tuple[str, str] | None:
    """Return two of the names that are one pin of the card, if there are any; empty names are not wired."""
    seen: dict[str, str] = {}
    for name in filter(None, names):
        if shared_pin(name) in seen:
            return seen[shared_pin(name)], name
        seen[shared_pin(name)] = name
    return None


_INPUT_RANGES_V = (0.2, 1.0, 5.0, 10.0)
_MAX_LOOP_GAIN = 0.75
"""Gain times dead time of a loop around an integrator: it swings for ever at 1.57, rings above about half of that."""


def _card_range(range_V: float) -> float:
    if range_V not in _INPUT_RANGES_V:
        raise ValueError(
            f"must be one of {', '.join(f'{one:g}' for one in _INPUT_RANGES_V)}, the card's ranges to either side"
        )
    return range_V


InputRange = Annotated[float, AfterValidator(_card_range)]
"""Volts to either side that an analog input of the card takes."""


class AnalogInputSettings(Settings):
    """A further analog input, recorded beside force and position on the same clock."""

    name: str = Field(pattern="^[a-z][a-z0-9_]*$")
    """Name of the channel in run files: motor_force, temperature, …."""
    channel: AnalogInput
    """Positive input on the card, such as ai1; its negative one is ai9."""
    unit: str
    per_V: float = 1.0
    """Quantity per volt."""
    zero_V: float = 0.0
    """Volts at which the quantity is 0."""
    range_V: InputRange = 10.0


class ForceInputSettings(Settings):
    """The force sensor's wires; the calibration history's latest entry overrides gain and zero."""

    channel: AnalogInput = "ai0"
    """Positive input on the card; its negative one is ai8."""
    per_V: float = Field(default=1000.0)
    """Force per volt [mN/V] until a calibration says better."""
    zero_V: float = 0.0
    range_V: InputRange = 10.0
    overload_V: float = Field(default=9.9, gt=0, le=10.5)
    """From so many volts on, to either side, the sensor counts as overloaded."""
    open_V: float = Field(default=9.99, gt=0, le=10.6)
    """From so many volts on, the amplifier is at its rail: a wire is broken or the sensor unplugged."""

    @model_validator(mode="after")
    def _tells(self) -> Self:
        if self.per_V == 0:
            raise ValueError("per_V must not be 0")
        if self.open_V < self.overload_V:
            raise ValueError("open_V must not be below overload_V")
        if self.open_V > self.range_V:
            raise ValueError("open_V must not be above range_V, or no broken wire could be seen")
        return self


class EncoderInputSettings(Settings):
    """The encoder's wires, behind a line receiver, and its counter; encoder.resolution_um is the length of a count."""

    counter: Counter = "ctr0"
    a: InputTerminal = "PFI8"
    b: InputTerminal = "PFI10"
    z: OptionalInputTerminal = "PFI9"
    """Index pulse; empty when it is not wired."""
    filter_ns: Literal[0, 125, 6425, 2_560_000] = 125
    """Shortest pulse that counts; 6425 limits the speed to about 0.3 m/s."""
    reversed: bool = False
    """Whether it counts down where the stage goes up."""


class LineSettings(Settings):
    """Digital lines; an empty one is not wired. A broken wire reads as pressed: switches are normally closed."""

    enable: OptionalLine = "port1/line0"
    """Out: the drive's enable."""
    e_stop: OptionalLine = "port1/line1"
    """In: low when pressed."""
    limit_low: OptionalLine = "port1/line2"
    """In: low at the lower end of travel."""
    limit_high: OptionalLine = "port1/line3"
    """In: low at the upper end of travel."""
    heartbeat: OptionalLine = ""
    """Out: toggled while the program is well; an external relay takes the drive's power when it stops."""
    heartbeat_s: float = Field(default=0.05, gt=0, le=1)
    """Time between two edges of the heartbeat."""


class CardSettings(Settings):
    """The PCI-6229."""

    device: str = Field(default="Dev1", min_length=1)
    server: str = ""
    """Host and port of an NI gRPC device server when the card is in another computer; empty for this one."""
    buffer_s: float = Field(default=4.0, ge=1, le=60)
    """Length of the buffer between card and program."""
    force: ForceInputSettings = ForceInputSettings()
    encoder: EncoderInputSettings = EncoderInputSettings()
    lines: LineSettings = LineSettings()
    inputs: tuple[AnalogInputSettings, ...] = ()
    """Further analog inputs."""

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        names = ["force", "position", "time", "command", "phase", *(one.name for one in self.inputs)]
        channels = [self.force.channel, *(one.channel for one in self.inputs)]
        for what, values in (("name", names), ("channel", channels)):
            if twice := next((value for value in values if values.count(value) > 1), None):
                raise ValueError(f"inputs: {what} = {twice!r} is there already; each input needs its own")
        lines, encoder = self.lines, self.encoder
        wired = (lines.enable, lines.e_stop, lines.limit_low, lines.limit_high, lines.heartbeat)
        if both := find_shared_pin((*wired, encoder.a, encoder.b, encoder.z)):
            one, other = both
            raise ValueError(
                f"{one} is wired to two signals under lines and encoder; give each a terminal of its own"
                if one == other
                else f"{one} and {other} under lines and encoder are one and the same pin of the card; use another"
            )
        return self


class VelocityOutputSettings(Settings):
    """Velocity mode: the command as a voltage, the loop closed here on the encoder."""

    channel: AnalogOutput = "ao0"
    per_V: float = Field(default=10.0, gt=0)
    """Speed per volt [mm/s] that the drive is set to."""
    counter: Counter = "ctr1"
    """Counter that reads the encoder for the loop; the same terminals as the sampled one."""
    rate_hz: float = Field(default=1000.0, ge=100, le=10_000)
    """Samples of the voltage per second."""
    update_s: float = Field(default=0.02, gt=0, le=0.1)
    """Time between two corrections."""
    ahead: int = Field(default=3, ge=2, le=20)
    """How many updates the voltage is written ahead: a stop takes as long to reach the output."""
    gain_per_s: float = Field(default=5.0, ge=0, le=100)
    """Speed added per distance from the command [1/s]."""
    lag_s: float = Field(default=0.0, ge=0, le=0.1)
    """How long the drive takes to follow the voltage; the command runs ahead by so much."""

    @property
    def update_samples(self) -> int:
        """Voltages between two corrections."""
        return max(1, round(self.update_s * self.rate_hz))

    @model_validator(mode="after")
    def _settles(self) -> Self:
        dead_s = self.update_s * (self.ahead + 1) + self.lag_s
        if self.gain_per_s * dead_s > _MAX_LOOP_GAIN:
            raise ValueError(
                f"gain_per_s must not exceed {_MAX_LOOP_GAIN / dead_s:.3g} with these update_s, ahead and lag_s, "
                "or the stage would swing about its command"
            )
        return self


class DriveSettings(Settings):
    """The stage's drive."""

    mode: Literal["position", "velocity"] = "position"
    """Position commands over serial, or a velocity voltage; the latter only with a heartbeat relay."""
    port: str = Field(default="COM1", min_length=1)
    """Serial port, or socket://host:port."""
    dialect: str = "nikki"
    """How the drive is spoken to: a module of dragrig.rig.hardware.dialects, or any other that Python can import."""
    baud: int = Field(default=38_400, ge=1200, le=4_000_000)
    parity: Literal["none", "even", "odd"] = "none"
    stop_bits: Literal[1, 2] = 1
    station: int = Field(default=1, ge=0, le=99)
    reply_s: float = Field(default=0.1, gt=0, le=2)
    """How long a reply may take."""
    silence_s: float = Field(default=0.5, ge=0.05, le=5)
    """After so long without a command the drive stops by itself."""
    thrust_limit_N: float = Field(default=20.0, gt=0)
    """Written to the drive and read back before every run."""
    homing_speed_mm_s: float = Field(default=5.0, gt=0, le=50)
    homing_direction: Literal["low", "high"] = "low"
    """Limit switch that homing goes to before it looks for the index pulse."""
    velocity: VelocityOutputSettings = VelocityOutputSettings()


class HardwareSettings(Settings):
    """What only the real rig needs."""

    card: CardSettings = CardSettings()
    drive: DriveSettings = DriveSettings()
    hang_s: float = Field(default=0.5, ge=0.1, le=5)
    """The stage is stopped when the program has not looked at its data for so long while it moves."""
    calibration_days: float = Field(default=90.0, gt=0)
    """Age from which a calibration counts as too old."""

    @model_validator(mode="after")
    def _can_be_stopped(self) -> Self:
        if self.drive.mode == "velocity" and not self.card.lines.heartbeat:
            raise ValueError(
                "drive.mode = 'velocity' needs a heartbeat relay in card.lines.heartbeat, because the card holds its "
                "last voltage when the program dies"
            )
        if self.drive.mode == "velocity" and self.drive.velocity.counter == self.card.encoder.counter:
            raise ValueError("drive.velocity.counter and card.encoder.counter must be two, one ctr0 and the other ctr1")
        return self
