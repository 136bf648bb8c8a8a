"""Rig settings (stage, encoder, force sensor, guard, recording, wiring, simulated rig) and the files of a lab folder.

A lab folder holds the rig file, a calibration history that is only appended to, the contact that touch-off found, and
the record of the guided look at the wiring. The wiring says which signal is on which terminal of the card, and how the
drive is reached; terminals of the PCI-6229 are named without the device (NI 622x Specifications, pinout).
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, AwareDatetime, Field, model_validator

from dragrig.config.lab import DEFAULT_DATA_ROOT
from dragrig.config.settings import Settings

_PFI = "an input terminal, PFI0 to PFI15, without the device's name"
_DEVICE_SEGMENT = r"[\w+-][\w.:+-]*"
_PORT = rf"(\\\\\.\\)?(?i:COM)\d+|/dev/({_DEVICE_SEGMENT}/)*{_DEVICE_SEGMENT}|socket://[^/?#\s]+:\d+"
_INPUT_RANGES_V = (0.2, 1.0, 5.0, 10.0)
_MAX_LOOP_GAIN = 0.75
"""Gain times dead time of a loop around an integrator: it oscillates at π/2, and rings above about half of that."""


def _name_like(pattern: str, description: str) -> AfterValidator:
    def validate(name: str) -> str:
        if re.fullmatch(pattern, name) is None:
            raise ValueError(f"must be {description}")
        return name

    return AfterValidator(validate)


AnalogInput = Annotated[
    str,
    _name_like(
        "ai([0-7]|1[6-9]|2[0-3])",
        "the positive input of a differential pair, ai0 to ai7 or ai16 to ai23, without the device's name",
    ),
]
AnalogOutput = Annotated[str, _name_like("ao[0-3]", "an analog output, ao0 to ao3, without the device's name")]
Counter = Annotated[str, _name_like("ctr[01]", "a counter, ctr0 or ctr1, without the device's name")]
InputTerminal = Annotated[str, _name_like("PFI([0-9]|1[0-5])", _PFI)]
OptionalInputTerminal = Annotated[str, _name_like("(PFI([0-9]|1[0-5]))?", _PFI)]
OptionalLine = Annotated[
    str,
    _name_like(
        "(port0/line([0-9]|[12][0-9]|3[01])|port[12]/line[0-7])?",
        "a digital line such as port1/line0, without the device's name; empty if not wired",
    ),
]


def shared_pin(name: str) -> str:
    """Return the input terminal whose pin a digital line shares, or any other name unchanged.

    Port 1 is PFI0 to PFI7, port 2 is PFI8 to PFI15.
    """
    match = re.fullmatch(r"port([12])/line(\d)", name)
    return f"PFI{8 * (int(match[1]) - 1) + int(match[2])}" if match else name


def find_shared_pin(names: Iterable[str]) -> tuple[str, str] | None:
    """Return the first two names that are the same pin of the card, or None; empty names are not wired."""
    seen: dict[str, str] = {}
    for name in filter(None, names):
        pin = shared_pin(name)
        if pin in seen:
            return seen[pin], name
        seen[pin] = name
    return None


def _card_range(range_V: float) -> float:
    if range_V not in _INPUT_RANGES_V:
        raise ValueError(
            f"must be one of {', '.join(f'{limit:g}' for limit in _INPUT_RANGES_V)}, the card's ranges in ± volts"
        )
    return range_V


InputRange = Annotated[float, AfterValidator(_card_range)]
"""Range of an analog input in ± volts."""


class AnalogInputSettings(Settings):
    """A further analog input, recorded on the same clock as force and position."""

    name: str = Field(pattern="^[a-z][a-z0-9_]*$")
    """Name of the channel in run files: motor_force, temperature, …."""
    channel: AnalogInput
    """Positive input on the card, such as ai1; the negative input is then ai9."""
    unit: str
    per_V: float = 1.0
    """Quantity per volt."""
    zero_V: float = 0.0
    """Voltage at which the quantity is 0."""
    range_V: InputRange = 10.0


_OVERLOAD_SHARE = 0.99


class ForceInputSettings(Settings):
    """Wiring of the force sensor; the latest entry of the calibration history overrides gain and zero."""

    channel: AnalogInput = "ai0"
    """Positive input on the card; the negative input of ai0 is ai8."""
    per_V: float = Field(default=1000.0)
    """Force per volt [mN/V], without a calibration."""
    zero_V: float = 0.0
    range_V: InputRange = 10.0
    rail_V: float = Field(default=10.0, gt=0, le=15)
    """Voltage, of either sign, at which the sensor's amplifier saturates, as measured; from 99 % of it on, or of the
    input's range, the sensor counts as overloaded."""
    unplugged: Literal["rail", "zero", "floating"] = "rail"
    """Where the input goes when the sensor's cable is pulled: to the end of its range by a pull-up, to 0 V by a
    pull-down, or anywhere, without either."""
    least_noise_uV: float = Field(default=0.0, ge=0)
    """Noise [µV] (standard deviation of means over 1 ms, from each to the next) below which the input counts as dead; 0
    for halfway, as a ratio, between the converter's own and the sensor's when it was calibrated."""

    @model_validator(mode="before")
    @classmethod
    def _read_former_keys(cls, data: object) -> object:
        """Read files with the keys that were in the place of `rail_V`."""
        if not isinstance(data, dict):
            return data
        kept = {key: value for key, value in data.items() if key not in {"overload_V", "open_V"}}
        overload_V = data.get("overload_V")
        if isinstance(overload_V, int | float):
            kept.setdefault("rail_V", round(overload_V / _OVERLOAD_SHARE, 6))
        return kept

    @model_validator(mode="after")
    def _check_gain(self) -> Self:
        if self.per_V == 0:
            raise ValueError("per_V must not be 0")
        return self

    @property
    def overload_V(self) -> float:
        """Voltage from which the sensor counts as overloaded."""
        return _OVERLOAD_SHARE * min(self.rail_V, self.range_V)

    @property
    def open_V(self) -> float:
        """Voltage from which the sensor counts as unplugged."""
        return 0.999 * self.range_V


class EncoderInputSettings(Settings):
    """Wiring of the encoder, behind a line receiver, and its counter; encoder.resolution_um is one count."""

    counter: Counter = "ctr0"
    a: InputTerminal = "PFI8"
    b: InputTerminal = "PFI10"
    z: OptionalInputTerminal = "PFI9"
    """Index pulse; empty when it is not wired."""
    z_phase: Literal["a_high_b_high", "a_high_b_low", "a_low_b_high", "a_low_b_low"] = "a_high_b_high"
    """Levels of A and B at which a high Z sets the position: one count in four. It must be one at which the encoder's Z
    is high, or the index is never found; the first is the card's default."""
    filter_ns: Literal[0, 125, 6425, 2_560_000] = 125
    """Shortest pulse that is counted; 6425 limits the speed to about 0.3 m/s."""
    reversed: bool = False
    """Whether it counts down where the stage moves up."""


class LineSettings(Settings):
    """Digital lines; empty when not wired. A broken wire reads as pressed: switches are normally closed."""

    enable: OptionalLine = "port1/line0"
    """Output: the drive's enable."""
    e_stop: OptionalLine = "port1/line1"
    """Input: low when pressed."""
    limit_low: OptionalLine = "port1/line2"
    """Input: low at the lower end of travel."""
    limit_high: OptionalLine = "port1/line3"
    """Input: low at the upper end of travel."""
    encoder_error: OptionalLine = ""
    """Input: low while the encoder's read head reports an error (E), or its wire is broken."""
    heartbeat: OptionalLine = ""
    """Output: toggled while the program runs properly; an external relay cuts the drive's power when it stops."""
    heartbeat_s: float = Field(default=0.05, gt=0, le=1)
    """Time between two edges of the heartbeat."""


class CardSettings(Settings):
    """The PCI-6229."""

    device: str = Field(default="Dev1", min_length=1)
    server: str = ""
    """Host and port of an NI gRPC device server when the card is in another computer; empty for this one."""
    buffer_s: float = Field(default=4.0, ge=1, le=60)
    """Length of the buffer between card and program."""
    oversampling: int = Field(default=0, ge=0, le=1000)
    """Samples that the card takes for each recorded one, which an anti-alias filter makes of them; 0 for as many as the
    card takes well, 1 for none."""
    force: ForceInputSettings = ForceInputSettings()
    encoder: EncoderInputSettings = EncoderInputSettings()
    lines: LineSettings = LineSettings()
    inputs: tuple[AnalogInputSettings, ...] = ()
    """Further analog inputs."""

    @model_validator(mode="after")
    def _check_terminals(self) -> Self:
        names = ["force", "position", "time", "command", "phase", *(extra.name for extra in self.inputs)]
        channels = [self.force.channel, *(extra.channel for extra in self.inputs)]
        for key, values in (("name", names), ("channel", channels)):
            if repeated := next((value for value in values if values.count(value) > 1), None):
                raise ValueError(f"inputs: {key} = {repeated!r} is used twice; each input needs its own")
        lines, encoder = self.lines, self.encoder
        wired = (lines.enable, lines.e_stop, lines.limit_low, lines.limit_high, lines.encoder_error, lines.heartbeat)
        if shared := find_shared_pin((*wired, encoder.a, encoder.b, encoder.z)):
            first, second = shared
            raise ValueError(
                f"{first} is wired to two signals under lines and encoder; each needs its own terminal"
                if first == second
                else f"{first} and {second} under lines and encoder are the same pin of the card; use another"
            )
        return self


class VelocityOutputSettings(Settings):
    """Velocity mode: the command is a voltage, and the program closes the loop on the encoder."""

    channel: AnalogOutput = "ao0"
    per_V: float = Field(default=10.0, gt=0)
    """Speed per volt [mm/s] set in the drive."""
    counter: Counter = "ctr1"
    """Counter that reads the encoder for the loop, on the same terminals as the sampled counter."""
    rate_hz: float = Field(default=1000.0, ge=100, le=10_000)
    """Samples of the voltage per second."""
    update_s: float = Field(default=0.02, gt=0, le=0.1)
    """Time between two corrections."""
    ahead: int = Field(default=3, ge=2, le=20)
    """Number of updates that the voltage is written ahead; a stop takes as long to reach the output."""
    gain_per_s: float = Field(default=5.0, ge=0, le=100)
    """Loop gain: speed per following error [1/s]."""
    lag_s: float = Field(default=0.0, ge=0, le=0.1)
    """Lag of the drive behind the voltage, which the command leads by."""

    @property
    def update_samples(self) -> int:
        """Voltages between two corrections."""
        return max(1, round(self.update_s * self.rate_hz))

    @model_validator(mode="after")
    def _check_loop_gain(self) -> Self:
        dead_s = self.update_s * (self.ahead + 1) + self.lag_s
        if self.gain_per_s * dead_s > _MAX_LOOP_GAIN:
            raise ValueError(
                f"gain_per_s must not exceed {_MAX_LOOP_GAIN / dead_s:.3g} with these update_s, ahead and lag_s, "
                "or the stage would oscillate about its command"
            )
        return self


class DriveSettings(Settings):
    """The stage's drive."""

    mode: Literal["position", "velocity"] = "position"
    """Position commands over serial, or a velocity voltage; the latter only with a heartbeat relay."""
    # Other addresses of pyserial's write files (spy://) or load modules (alt://).
    port: Annotated[str, _name_like(_PORT, "a serial port, as COM3 or /dev/ttyUSB0, or socket://host:port")] = "COM1"
    """Serial port, as COM3 or /dev/ttyUSB0, or socket://host:port."""
    dialect: str = "nikki"
    """Protocol of the drive: nikki, copley, modbus, or any module that Python can import."""
    baud: int = Field(default=38_400, ge=1200, le=4_000_000)
    parity: Literal["none", "even", "odd"] = "none"
    stop_bits: Literal[1, 2] = 1
    station: int = Field(default=1, ge=0, le=247)
    """Number of the drive on its line; copley: 0 for the drive that the cable is plugged into."""
    counts_per_mm: float = Field(default=0.0, ge=0)
    """Counts of the drive's own encoder in a millimetre; 0 for a dialect that does without."""
    thrust_N_per_A: float = Field(default=0.0, ge=0)
    """Thrust of the motor per ampere of the drive's current; 0 for a dialect that does without."""
    reply_s: float = Field(default=0.1, gt=0, le=2)
    """Longest time for a reply."""
    silence_s: float = Field(default=0.5, ge=0.05, le=5)
    """Time without a command after which the drive stops by itself, if its dialect has such a timeout."""
    thrust_limit_N: float = Field(default=20.0, gt=0)
    """Written to the drive and read back before every run."""
    homing_speed_mm_s: float = Field(default=5.0, gt=0, le=50)
    homing_direction: Literal["low", "high"] = "low"
    """Limit switch that homing moves to before it searches the index pulse."""
    velocity: VelocityOutputSettings = VelocityOutputSettings()


class HardwareSettings(Settings):
    """Settings of the real rig only."""

    card: CardSettings = CardSettings()
    drive: DriveSettings = DriveSettings()
    hang_s: float = Field(default=0.5, ge=0.1, le=5)
    """Time without the program reading its data after which a moving stage is stopped."""
    calibration_days: float = Field(default=90.0, gt=0)
    """Age from which a calibration is too old."""

    @model_validator(mode="after")
    def _check_velocity_mode(self) -> Self:
        if self.drive.mode == "velocity" and not self.card.lines.heartbeat:
            raise ValueError(
                "drive.mode = 'velocity' needs a heartbeat relay in card.lines.heartbeat, because the card holds its "
                "last voltage when the program dies"
            )
        if self.drive.mode == "velocity" and self.drive.velocity.counter == self.card.encoder.counter:
            raise ValueError("drive.velocity.counter and card.encoder.counter must differ, one ctr0 and the other ctr1")
        return self


class StageSettings(Settings):
    """The linear motor; positions are absolute, after homing."""

    model: str = "NLA-7SL"
    lowest_mm: float = 0.0
    """Lower soft limit."""
    highest_mm: float = 150.0
    """Upper soft limit."""
    start_mm: float = 40.0
    """Default start of runs."""
    start_from: Literal["home", "contact"] = "home"
    """Reference of start_mm, here and in plans: the origin, or the contact found by touch-off."""
    max_speed_mm_s: float = Field(default=100.0, gt=0, le=5000)
    max_accel_mm_s2: float = Field(default=3000.0, gt=0, le=100_000)
    stop_accel_mm_s2: float = Field(default=3000.0, gt=0, le=100_000)
    """Deceleration of a stop."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.lowest_mm <= self.highest_mm:
            raise ValueError("highest_mm must not be below lowest_mm")
        if self.start_from == "home" and not self.lowest_mm <= self.start_mm <= self.highest_mm:
            raise ValueError("start_mm must lie between lowest_mm and highest_mm")
        if self.stop_accel_mm_s2 < self.max_accel_mm_s2:
            raise ValueError("stop_accel_mm_s2 must not be below max_accel_mm_s2, or a stop would overrun the travel")
        return self


class EncoderSettings(Settings):
    """The position encoder."""

    model: str = "RGH22X"
    resolution_um: float = Field(default=1.0, gt=0, le=1000)
    """Length of one count after X4 decoding."""


class ForceSensorSettings(Settings):
    """The force sensor and its converter."""

    serial: str = ""
    range_mN: float = Field(default=10_000.0, gt=0, le=1e6)
    """Full scale, in both directions."""
    bits: int = Field(default=16, ge=8, le=32)
    accuracy_mN: float = Field(default=5.0, gt=0)


class SamplingSettings(Settings):
    """The common sample clock of all channels."""

    rate_hz: float = Field(default=1000.0, ge=10, le=250_000)
    block_s: float = Field(default=0.05, gt=0, le=0.05)
    """Length of the blocks that guard, recorder and viewers see."""
    motor_force: bool = True
    """Whether to record the motor's force as well."""


class GuardSettings(Settings):
    """When the guard stops the stage."""

    force_limit_mN: float = Field(default=8000.0, gt=0)
    position_margin_mm: float = Field(default=1.0, ge=0)
    """Allowed distance outside the profile's own range."""
    speed_factor: float = Field(default=1.5, gt=1)
    """Trip above this times the profile's highest speed …"""
    speed_margin_mm_s: float = Field(default=5.0, ge=0)
    """… plus this."""
    following_error_mm: float = Field(default=0.5, gt=0)
    """Allowed following error at standstill …"""
    following_error_per_speed_s: float = Field(default=0.05, ge=0)
    """… plus this times the speed."""
    encoder_silent_mm: float = Field(default=0.4, gt=0)
    """Trip when the command has moved by more than this, plus following_error_per_speed_s times the speed, …"""
    encoder_silent_s: float = Field(default=0.04, gt=0, le=5)
    """… and for longer than this, while the encoder showed no count."""
    encoder_error_mm: float = Field(default=0.05, gt=0)
    """Trip when the position leaves its course by more than this from a sample to the next; and mark a run in which
    drive and encoder differ at the standstill after it by more than this …"""
    encoder_error_per_mm: float = Field(default=0.0005, ge=0)
    """… plus this times its travel."""
    stale_data_s: float = Field(default=0.2, gt=0, le=5)
    """Trip when no block arrives for this long."""


class RecordingSettings(Settings):
    """Recording of runs on disk."""

    flush_s: float = Field(default=0.1, gt=0, le=0.25)
    """Longest duration of data that a crash may cost."""
    reserve_mb: float = Field(default=64.0, ge=1)
    """Free space that a run must leave, besides twice its own size; below, it stops."""


class NoiseSettings(Settings):
    """Noise of the simulated force sensor."""

    white_mN: float = Field(default=1.5, ge=0)
    slow_mN: float = Field(default=0.5, ge=0)
    """Standard deviation of the exponentially correlated part."""
    slow_correlation_s: float = Field(default=0.2, gt=0)
    zero_mN: float = Field(default=3.0, ge=0)
    """Standard deviation of the zero offset from run to run."""


class MotorSettings(Settings):
    """The simulated stage's mechanics, which its motor force shows."""

    moving_mass_g: float = Field(default=1200.0, gt=0)
    viscous_mN_s_mm: float = Field(default=4.0, ge=0)
    coulomb_mN: float = Field(default=300.0, ge=0)
    offset_mN: float = 15.0
    noise_mN: float = Field(default=8.0, ge=0)


class VariationSettings(Settings):
    """Scatter between simulated specimens and runs, as relative standard deviations."""

    specimen: bool = False
    """Whether to draw this session's specimen at random instead of using the model's values."""
    run_stiffness: float = Field(default=0.02, ge=0, le=0.5)
    run_friction: float = Field(default=0.015, ge=0, le=0.5)


class SimulatedSettings(Settings):
    """Settings of the simulated rig only."""

    seed: int = Field(default=20120509, ge=0, lt=2**63)
    noise: NoiseSettings = NoiseSettings()
    motor: MotorSettings = MotorSettings()
    variation: VariationSettings = VariationSettings()


class DataSettings(Settings):
    """Storage of run files."""

    root: Path = Path(DEFAULT_DATA_ROOT)
    """Folder of the campaigns, relative to the rig file."""


class RigSettings(Settings):
    """Settings of a rig."""

    name: str = Field(default="simulated bench", min_length=1)
    backend: str = "simulated"
    """Default backend."""
    stage: StageSettings = StageSettings()
    encoder: EncoderSettings = EncoderSettings()
    force_sensor: ForceSensorSettings = ForceSensorSettings()
    sampling: SamplingSettings = SamplingSettings()
    guard: GuardSettings = GuardSettings()
    recording: RecordingSettings = RecordingSettings()
    hardware: HardwareSettings = HardwareSettings()
    simulated: SimulatedSettings = SimulatedSettings()
    data: DataSettings = DataSettings()

    @model_validator(mode="after")
    def _guard_fits_the_sensors(self) -> Self:
        if self.guard.force_limit_mN >= self.force_sensor.range_mN:
            raise ValueError(
                "guard.force_limit_mN must be below force_sensor.range_mN, or no force could trip the guard"
            )
        if self.guard.encoder_silent_mm < 3e-3 * self.encoder.resolution_um:
            raise ValueError(
                "guard.encoder_silent_mm must be at least three counts (encoder.resolution_um), or a healthy encoder "
                "could trip the guard"
            )
        return self


class Calibration(Settings):
    """One entry of the calibration history."""

    id: str = Field(min_length=1)
    made_at: AwareDatetime
    quantity: str = Field(pattern="^(force|encoder)$")
    made_on: str = ""
    """Backend that it was made on and is valid for, which its double is not; empty for any."""
    sensor_serial: str = ""
    gain: float
    """Quantity per raw unit: mN/V for force, mm per count for the encoder."""
    gain_error: float = Field(default=0.0, ge=0)
    """Standard error of the gain; 0 where it is not known."""
    zero: float = 0.0
    """Quantity at raw value 0: mN at 0 V."""
    zero_error: float = Field(default=0.0, ge=0)
    residual: float = Field(default=0.0, ge=0)
    """Standard deviation of the fit, in the quantity's unit."""
    points: int = Field(default=0, ge=0)
    noise_uV: float = Field(default=0.0, ge=0)
    """Noise of the force input with the sensor alive, as of hardware.card.force.least_noise_uV; 0 where not known."""
    operator: str = ""
    note: str = ""


class ContactPoint(Settings):
    """The contact that the last touch-off found."""

    position_mm: float
    """Absolute position of the stage."""
    made_at: AwareDatetime
    force_mN: float
    """Change of the force at the contact."""
    operator: str = ""


class NotificationSettings(Settings):
    """How a person is told that a session ended or tripped, or that a prompt waits."""

    after_s: float = Field(default=60.0, ge=0, le=86_400)
    """Prompts that are answered sooner and sessions that end sooner are not told."""
    desktop: bool = False
    """Notification of the desktop, with its sound (needs desktop-notifier)."""
    command: tuple[str, ...] = ()
    """A program with its arguments; title and text of the message are two further ones."""
    addresses: tuple[str, ...] = ()
    """E-mail and messengers as addresses of Apprise, such as mailtos://user:password@example.org (needs apprise)."""


@dataclass(frozen=True, slots=True)
class RigCheck:
    """Result of one check of the rig."""

    name: str
    """What was checked: a device, a signal, a limit, a calibration."""
    passed: bool
    detail: str
    """What was found, and what to do where the check failed."""
    after_s: Annotated[float, Field(ge=0)] = 0.0
    """Time that the drive took to go off when this signal was taken away from it; 0 for any other check."""


class CommissioningRecord(Settings):
    """The findings of the latest guided look at the rig's wiring (`dragrig check --live`)."""

    made_at: AwareDatetime
    made_on: str
    """Backend that it was made on, which its double is not."""
    wiring: str
    """Key of the wiring in the settings that it is about."""
    operator: str = ""
    skipped: bool = False
    """Whether a person chose to measure without a look, or in spite of what it found."""
    signals: tuple[RigCheck, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether every signal was as it has to be."""
        return bool(self.signals) and all(signal.passed for signal in self.signals)
