"""Rig settings (stage, encoder, force sensor, guard, recording, simulated rig) and the other files of a lab folder.

A lab folder holds the rig file, a calibration history that is only appended to, and the contact that touch-off found.
"""

from pathlib import Path
from typing import Literal, Self

from pydantic import AwareDatetime, Field, model_validator

from dragrig.config.hardware import HardwareSettings
from dragrig.config.settings import Settings

RIG_FILE = "rig.toml"
CALIBRATION_FILE = "calibration.jsonl"
CONTACT_FILE = "contact.toml"


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

    root: Path = Path("runs")
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
    def _sees_the_force_limit(self) -> Self:
        if self.guard.force_limit_mN >= self.force_sensor.range_mN:
            raise ValueError(
                "guard.force_limit_mN must be below force_sensor.range_mN, or no force could trip the guard"
            )
        return self

    @model_validator(mode="after")
    def _tells_silence_from_rest(self) -> Self:
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


def rig_file_of(start: Path) -> Path | None:
    """Return the rig file of the lab folder that contains `start`, searching upwards, or None."""
    for folder in (start.absolute(), *start.absolute().parents):
        if (folder / RIG_FILE).is_file():
            return folder / RIG_FILE
    return None
